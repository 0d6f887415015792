"""Random numbers of the factored estimator: from a seed, a stream and a sample's index to points of the unit square.

The first two dimensions (where a path leaves its cell) follow a scrambled Sobol sequence: the samples of one cell
stratify, so an average over a cell that several projector pixels share converges faster than 1/sqrt(samples). Owen's
scrambling (hashed, Laine and Karras 2011) is seeded for each stream, so streams are independent and every estimate is
unbiased. The other dimensions are plain random numbers.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

_SEQUENCE_BITS = 20
"""Bits of a sample's number that count: 2^20 samples of a stream differ; each bit costs every sample a step."""


def generator(seed: mi.UInt32, stream: mi.UInt32) -> mi.PCG32:
    """An independent PCG32 for each ``stream`` of a ``seed``; the cipher TEA scatters neighbours, as in Mitsuba."""
    state, sequence = mi.sample_tea_32(seed, stream)
    return mi.PCG32(initstate=mi.UInt64(state), initseq=mi.UInt64(sequence))


def streams(seed: int | mi.UInt32, stream: mi.UInt32, sample: mi.UInt32) -> tuple[mi.PCG32, mi.PCG32]:
    """Two generators for one sample of a stream.

    Parameters
    ----------
    seed, stream
        of the one that all the stream's samples share, which :func:`stratified` scrambles them by; one seed, or one for
        each lane.
    sample
        number of the sample, which has the other for its own.
    """
    shared = seed_of(seed)
    return generator(shared, stream), generator(shared ^ (sample * 0x9E3779B9 + 1), stream)


def seed_of(seed: int | mi.UInt32) -> mi.UInt32:
    """One ``seed``, the same kernel for any, or one for each lane."""
    return dr.opaque(mi.UInt32, seed) if isinstance(seed, int) else seed


def stratified(index: mi.UInt32, rng: mi.PCG32) -> mi.Point2f:
    """Point ``index`` of a Sobol sequence in the unit square, scrambled by numbers drawn from ``rng``."""
    first = _scramble(dr.brev(index), rng.next_uint32())
    second = _scramble(_second_dimension(index), rng.next_uint32())
    return mi.Point2f(_unit(first), _unit(second))


def shuffled(index: mi.UInt32, rng: mi.PCG32) -> mi.UInt32:
    """Numbers of samples in another order, drawn from ``rng``, in which each aligned block of 2^m is again one.

    :func:`stratified` points of them are as even as those of ``index`` and independent of these, so two pairs of
    dimensions pad to four (Burley 2020, "Practical hash-based Owen scrambling", section 4).
    """
    return _scramble(index, rng.next_uint32())


def _second_dimension(index: mi.UInt32) -> mi.UInt32:
    """Dimension 2 of Sobol's sequence, 32-bit fixed point: direction numbers of the polynomial x + 1."""
    result, direction = mi.UInt32(0), 1 << 31
    for bit in range(_SEQUENCE_BITS):
        result = dr.select((index & (1 << bit)) != 0, result ^ direction, result)
        direction ^= direction >> 1
    return result


def _scramble(bits: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Nested uniform scrambling: each bit is flipped by a hash of those above it."""
    x = dr.brev(bits) + seed
    for multiplier in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        x ^= x * multiplier
    return dr.brev(x)


def _unit(bits: mi.UInt32) -> mi.Float:
    """[0, 1) from the upper 24 bits, all that a float32 holds."""
    return mi.Float(bits >> 8) * (1 / 2**24)


def panchromatic(radiance: mi.UnpolarizedSpectrum) -> mi.Float:
    """One number for a spectrum of ``radiance``, by a flat response: the mean over channels, or over wavelengths that
    have the weights of :func:`mitsim.transport.connect.sample_wavelengths`."""
    return dr.mean(radiance)


def split_by_line(light: mi.UnpolarizedSpectrum, lines: int) -> list[mi.Float]:
    """Light of each of several ``lines``, or of all in one, whose weights ``light`` has as :func:`panchromatic` takes
    them."""
    return [panchromatic(light)] if lines == 1 else [light[line] / len(light) for line in range(lines)]
