"""Frames of mixtures of light, formed by the closed form of :mod:`mitsim.optics.image_formation`.

A *basis* is a matrix (b, rows) of mixtures of rows of light. *Replicates*, the frames of single groups of the light,
are only multiplied by probing vectors and never formed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from mitsim.core.arrays import FloatArray
from mitsim.core.parallel import in_threads
from mitsim.core.seeds import stream
from mitsim.optics.image_formation import Entries, FrameOptics

_FEW = 2
_COLUMNS = 2**14
"""Columns per product. The size is fixed because it affects the last bits, which must not depend on the threads."""
_MOST_COLUMNS = 2**22
"""Places of light above which a product is computed on lit places only, because SciPy takes 36 bytes per place."""


@dataclass(frozen=True, eq=False)
class AccumulatedLight:
    optics: FrameOptics
    groups: tuple[sparse.csr_array, ...]


Lights = Sequence[AccumulatedLight]
Formed = tuple[FloatArray, FloatArray]
"""Frames, and their products with random signs."""


def form_frames(lights: Lights, basis: sparse.csr_array, probes: FloatArray | None) -> Formed:
    """Form (b, m, m') frames of mixtures ``basis`` (b, rows), and products of groups' frames with ``probes``.

    The products are (b, m * groups * probes), of ``probes`` (m', probes) from :func:`probe_vectors`; None for none.
    """
    shape, groups = lights[0].optics.frame_shape, len(lights[0].groups)
    mixed, count = _mix_lights(lights, basis), basis.shape[0]
    frames = np.zeros((count, *shape))
    probed = np.zeros((count, shape[0] * groups * (0 if probes is None else probes.shape[1])))

    def form(row: int) -> None:
        for number, (optics, parts) in enumerate(mixed):
            estimates, out = [_row(part, row) for part in parts], None if number else frames[row]
            frame, seen = optics.frame_and_products(estimates, probes, out)
            if number:
                frames[row] += frame
            probed[row] += seen.ravel()

    in_threads(form, range(count))
    return frames, probed


def probe_frames(lights: Lights, basis: sparse.csr_array, probes: FloatArray) -> Formed:
    """Return (b, m * groups * probes) replicates, and inner products (b, lights, groups, groups) of differences."""
    rows, groups = lights[0].optics.frame_shape[0], len(lights[0].groups)
    mixed, count = _mix_lights(lights, basis), basis.shape[0]
    probed, noise = np.zeros((count, rows * groups * probes.shape[1])), np.zeros((count, len(lights), groups, groups))

    def probe(row: int) -> None:
        for number, (optics, parts) in enumerate(mixed):
            estimates = [_row(part, row) for part in parts]
            if not any(len(places) for places, _ in estimates):
                continue
            seen = optics.probe(estimates, probes)
            noise[row, number] = noise_of_groups(seen, rows, groups)
            probed[row] += seen.ravel()

    in_threads(probe, range(count))
    return probed, noise


def _mix_lights(lights: Lights, basis: sparse.csr_array) -> list[tuple[FrameOptics, list[sparse.csr_array]]]:
    mixed = [(light.optics, [_product(basis, group) for group in light.groups]) for light in lights]
    for part in (part for _, parts in mixed for part in parts):
        part.sort_indices()
    return mixed


def _product(basis: sparse.csr_array, light: sparse.csr_array) -> sparse.csr_array:
    if basis.nnz == len(basis.indices) == basis.shape[1] and not (basis - sparse.eye_array(*basis.shape)).nnz:
        return light
    if light.shape[1] <= _MOST_COLUMNS:
        return basis @ light
    places, indices = np.unique(light.indices, return_inverse=True)
    lit = sparse.csr_array((light.data, indices, light.indptr), shape=(light.shape[0], max(len(places), 1)))
    product = (basis @ lit).tocsr()
    # SciPy adds matrices of sorted rows entry by entry, and other matrices over all their columns.
    product.sort_indices()
    wide = places[product.indices] if len(places) else product.indices
    return sparse.csr_array((product.data, wide, product.indptr), shape=(basis.shape[0], light.shape[1]))


def _row(matrix: sparse.csr_array, row: int) -> Entries:
    inside = slice(matrix.indptr[row], matrix.indptr[row + 1])
    return matrix.indices[inside], matrix.data[inside]


# -------- Shots as sums of frames in memory


@dataclass(frozen=True, eq=False)
class Mixture:
    """Shots as ``weights`` (shots, b) of frames; ``least`` (b,) is shared by all shots, ``own`` is the rest."""

    weights: FloatArray
    least: FloatArray
    own: sparse.csr_array

    @property
    def sparse(self) -> bool:
        return bool(self.own.nnz <= _FEW * len(self.weights))

    def shots(self, basis: FloatArray, start: int, stop: int) -> Sequence[FloatArray]:
        if not self.sparse:
            return list(mix_frames(self.weights[start:stop], basis))
        common = mix_frames(self.least[None], basis)[0] if self.least.any() else None

        def add_up(shot: int) -> FloatArray:
            numbers, weights = _row(self.own, shot)
            if common is None and list(weights) == [1]:
                return np.asarray(basis[numbers[0]])
            total = np.zeros(basis.shape[1:]) if common is None else common.copy()
            for number, weight in zip(numbers, weights, strict=True):
                if weight == -1:
                    total -= basis[number]
                else:
                    total += basis[number] if weight == 1 else weight * basis[number]
            return total

        return in_threads(add_up, range(start, stop))


def pair_shots(weights: FloatArray) -> tuple[FloatArray, Mixture] | None:
    """Find pairs of complementary shots, which add up to the light of all pixels and halve the matrix product.

    Return None where ``weights`` (shots, classes) have other than two values, or more pairs than classes.
    """
    low, high = float(weights.min()), float(weights.max())
    lit = weights == high
    if not low < high or np.any(weights[~lit] != low):
        return None
    chosen: dict[bytes, int] = {}
    kept: list[npt.NDArray[np.bool_]] = []
    numbers, left = np.empty(len(weights), int), np.empty(len(weights), bool)
    for shot, row in enumerate(lit):
        key, other = row.tobytes(), (~row).tobytes()
        if key not in chosen and other not in chosen:
            chosen[key if row.any() else other] = len(kept)
            kept.append(row if row.any() else ~row)
        left[shot] = key not in chosen
        numbers[shot] = chosen[other if left[shot] else key]
    everything = chosen.get(np.ones(weights.shape[1], bool).tobytes())
    if everything is None or len(kept) > weights.shape[1]:
        return None
    by_pair = np.zeros((len(weights), len(kept)))
    by_pair[left, everything] = (low + high) / high
    by_pair[np.arange(len(weights)), numbers] += np.where(left, -1.0, 1.0)
    mixture = Mixture(by_pair, np.zeros(len(kept)), sparse.csr_array(by_pair))
    return np.where(np.array(kept), high, low), mixture


def mix_frames(weights: FloatArray, basis: FloatArray, out: FloatArray | None = None) -> FloatArray:
    flat = basis.reshape(len(basis), -1)
    mixed = np.empty((len(weights), flat.shape[1])) if out is None else out.reshape(len(weights), -1)

    def part(start: int) -> None:
        inside = slice(start, start + _COLUMNS)
        mixed[:, inside] = weights @ flat[:, inside]

    in_threads(part, range(0, flat.shape[1], _COLUMNS))
    return mixed.reshape(len(weights), *basis.shape[1:])


# -------- Replicates
#
# Monte Carlo error of the mean of frames of independent groups of light, and its bound.
#
# Squared norms are estimated without bias from products with random signs (Hutchinson's estimator), because forming as
# many frames as there are groups would cost more than the frames themselves.

PROBES = 8
"""Random signs beside the constant vector; probing then costs less than a frame."""
_STUDENT = 12.706205, 4.302653, 3.182446
"""97.5 % quantiles of Student's t with 1, 2, 3 and more degrees of freedom."""
_OF_ONE_KIND = 0.625
"""Power of the share of one kind of noise with which the squared bound grows: with four groups it holds in 93 to 99 %
of draws (91 % for a power of 0.75).
"""


def probe_vectors(pixels: int, seed: int) -> FloatArray:
    """Return (pixels, 1 + 8) vectors v with E sum |A v|^2 = ||A||^2: a constant one, and random signs.

    The constant vector is exact because most of a frame's error is common to its columns.
    """
    constant = np.full((pixels, 1), pixels**-0.5)
    signs = stream(seed, "probe").choice((-1.0, 1.0), size=(pixels, PROBES)) / PROBES**0.5
    return np.concatenate([constant, signs - constant @ (constant.T @ signs)], axis=1)


def noise_of_groups(probed: FloatArray, rows: int, groups: int) -> FloatArray:
    """Return the (groups, groups) inner products of the differences of groups' frames from their mean.

    No matrix product is used because the order in which BLAS adds depends on its threads.
    """
    by_group = probed.reshape(rows, groups, -1)
    off = by_group - by_group.mean(axis=1, keepdims=True)
    return np.asarray(np.einsum("rgp,rhp->gh", off, off))


def bound_of(products: FloatArray, energy: float) -> float:
    """Return the 95 % bound of a relative error from (G, G) inner ``products`` and the frames' squared norm.

    With many kinds of noise, the products have G - 1 equal eigenvalues. With one kind, the bound is that of Student's t
    with G - 1 degrees of freedom. In between, the squared bound grows with the squared norm of the products.
    """
    variance, freedom = float(np.trace(products)), len(products) - 1
    if not energy or not variance or not freedom:
        return 0.0
    one, norm = _STUDENT[min(freedom, len(_STUDENT)) - 1] ** 2, float(np.square(products).sum())
    part = (freedom * norm / variance**2 - 1) / (freedom - 1) if freedom > 1 else 1.0
    return math.sqrt((1 + (one - 1) * max(part, 0.0) ** _OF_ONE_KIND) * variance / energy)
