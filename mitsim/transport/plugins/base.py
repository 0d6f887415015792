"""Common parts of plugins and tracers: arrays on the host, coordinates, and random numbers.

Index coordinates grow as rows and columns of images do: row = -y, column = -x in Mitsuba's camera frame.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import device_array

Surface: TypeAlias = "mi.SurfaceInteraction3f"
Light: TypeAlias = "mi.UnpolarizedSpectrum"
Numbers: TypeAlias = "mi.Float | FloatArray"
Draw: TypeAlias = "tuple[mi.BSDFSample3f, mi.Spectrum]"
Value: TypeAlias = "tuple[mi.Spectrum, mi.Float]"
LIGHT = "calibration", "mp_cl1.toml"
"""The usual projector."""

# -------- Between Dr.Jit and NumPy


def host_values(values: mi.Float, count: int) -> npt.NDArray[Any]:
    array = np.array(values)
    array = array.astype(np.float64) if array.dtype.kind == "f" else array
    return np.broadcast_to(array.reshape(-1), (count,))


def vectors(values: mi.Vector3f, count: int) -> FloatArray:
    return np.stack([host_values(part, count) for part in (values.x, values.y, values.z)], axis=1)


def channels(spectrum: Light, count: int) -> FloatArray:
    return np.stack([host_values(spectrum[i], count) for i in range(len(spectrum))], axis=1)


def device_vectors(vectors: FloatArray) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Copy vectors (k, 3) to the device, gathered from one array.

    Dr.Jit compiles kernels that read arrays in place anew for each alignment, which differs for nearly every k (50 ms
    each).
    """
    flat = device_array(mi.Float, vectors)
    first = 3 * dr.arange(mi.UInt32, len(vectors))
    x, y, z = (dr.gather(mi.Float, flat, first + part) for part in range(3))
    return x, y, z


# -------- Coordinates


def rows_columns(x: Numbers, y: Numbers) -> tuple[Numbers, Numbers]:
    return -y, -x


def x_y(row: Numbers, column: Numbers) -> tuple[Numbers, Numbers]:
    return -column, -row


def turn_and_origin(transform: mi.AffineTransform4f) -> tuple[FloatArray, FloatArray]:
    matrix = np.array(transform.matrix, dtype=np.float64).reshape(4, 4, -1)[..., 0]
    return matrix[:3, :3], matrix[:3, 3]


# -------- Random numbers of the factored estimator
#
# Random numbers of the factored estimator: from a seed, a stream and a sample's index to points of the unit square.
#
# The first two dimensions (where a path leaves its cell) follow a scrambled Sobol sequence: the samples of one cell
# stratify, so an average over a cell that several projector pixels share converges faster than 1/sqrt(samples). Owen's
# scrambling (hashed, Laine and Karras 2011) is seeded for each stream, so streams are independent and every estimate is
# unbiased. The other dimensions are plain random numbers.

_SEQUENCE_BITS = 20


def generator(seed: mi.UInt32, stream: mi.UInt32) -> mi.PCG32:
    """Return an independent PCG32 for each stream of a seed; the cipher TEA scatters neighbours, as in Mitsuba."""
    state, sequence = mi.sample_tea_32(seed, stream)
    return mi.PCG32(initstate=mi.UInt64(state), initseq=mi.UInt64(sequence))


def streams(seed: int | mi.UInt32, stream: mi.UInt32, sample: mi.UInt32) -> tuple[mi.PCG32, mi.PCG32]:
    shared = dr.opaque(mi.UInt32, seed) if isinstance(seed, int) else seed
    return generator(shared, stream), generator(shared ^ (sample * 0x9E3779B9 + 1), stream)


def sobol_point(index: mi.UInt32, rng: mi.PCG32) -> mi.Point2f:
    first = _scramble(dr.brev(index), rng.next_uint32())
    second = _scramble(_second_dimension(index), rng.next_uint32())
    return mi.Point2f(_unit(first), _unit(second))


def shuffle(index: mi.UInt32, rng: mi.PCG32) -> mi.UInt32:
    """Permute the numbers of samples so that each aligned block of 2^m is again one.

    Their :func:`stratified` points are as even as those of ``index`` and independent of them, so two pairs of
    dimensions pad to four (Burley 2020, "Practical hash-based Owen scrambling", section 4).
    """
    return _scramble(index, rng.next_uint32())


def _second_dimension(index: mi.UInt32) -> mi.UInt32:
    """Return dimension 2 of Sobol's sequence, 32-bit fixed point: direction numbers of the polynomial x + 1.

    Bit b of the index counts (1 + S)^b, with S the shift by one digit. So the reversed bits are a polynomial in S that
    is taken at 1 + S: as (1 + S)^k is 1 + S^k for k = 2^j, modulo 2, of 2 k coefficients the upper k add to the lower.
    """
    result = dr.brev(index & (2**_SEQUENCE_BITS - 1))
    for k, upper in ((16, 0x0000FFFF), (8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        result ^= (result & upper) << k
    return result


def _scramble(bits: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Apply nested uniform scrambling: a hash of the bits above flips each bit."""
    x = dr.brev(bits) + seed
    for multiplier in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        x ^= x * multiplier
    return dr.brev(x)


def _unit(bits: mi.UInt32) -> mi.Float:
    return mi.Float(bits >> 8) * (1 / 2**24)


def panchromatic(radiance: Light) -> mi.Float:
    # dr.mean would write the number of lanes into the kernel: another kernel for each number of paths.
    return dr.sum(radiance) / len(radiance)


def split_by_line(light: Light, lines: int) -> list[mi.Float]:
    return [panchromatic(light)] if lines == 1 else [light[line] / len(light) for line in range(lines)]


# -------- Materials


def bsdf_class() -> type:
    """Return the base of our BSDFs; one without ``eval_pdf`` of its own is a delta, which no given direction meets."""

    class ModelBSDF(mi.BSDF):  # type: ignore[misc]
        name: str
        model: object

        def eval_pdf(self, *turn: Any) -> Value:
            return mi.Spectrum(0), mi.Float(0)

        def eval(self, *turn: Any) -> mi.Spectrum:
            return self.eval_pdf(*turn)[0]

        def pdf(self, *turn: Any) -> mi.Float:
            return self.eval_pdf(*turn)[1]

        def to_string(self) -> str:
            return f"{self.name}[{self.model}]"

    return ModelBSDF


def adjoint(bsdf: mi.BSDF, ctx: mi.BSDFContext, si: Surface, wo: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
    """Return the value for light from ``si.wi`` seen from ``wo``, with the cosine of ``wo``."""
    seen = mi.SurfaceInteraction3f(si)
    seen.wi = wo
    context = mi.BSDFContext(mi.TransportMode.Radiance, ctx.type_mask, ctx.component)
    value = bsdf.eval(context, seen, si.wi, active & (si.wi.z != 0))
    return dr.select(si.wi.z != 0, value * dr.abs(wo.z / si.wi.z), 0)
