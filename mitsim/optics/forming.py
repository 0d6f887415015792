"""Forming frames: estimates of light and the optics that it passes in; frames of mixtures of its rows out.

A *basis* is a matrix (b, rows) of mixtures. Its frames are formed by the closed form of
:mod:`mitsim.optics.image_formation`; shots that are sums of few frames of a basis are then added up
(:class:`Mixture`). Beside each frame its *replicates*, those of single groups of the light, are seen by probing
vectors alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import sparse

from mitsim.core.arrays import FloatArray
from mitsim.core.parallel import in_threads
from mitsim.core.seeds import stream
from mitsim.optics.image_formation import Entries, FrameOptics

_FEW = 2
"""Classes a shot, beside what all shots light alike, up to which adding up their frames takes less than a product of
matrices: a twentieth for dots whose black pixels leak."""
_COLUMNS = 2**14
"""Columns of a product at a time: how a product is cut shows in its last bits, so not by the number of threads."""
_MOST_COLUMNS = 2**22
"""Places of light from which a product is worked out on those that are lit: SciPy takes 16 bytes for each of all, and
20 to add two unsorted matrices."""


@dataclass(frozen=True, eq=False)
class AccumulatedLight:
    """Light and the optics that forms it.

    Attributes
    ----------
    optics
        fits the cells that the light is accumulated in.
    groups
        independent estimates of the light, (rows, cells) each; their mean is used.
    """

    optics: FrameOptics
    groups: tuple[sparse.csr_array, ...]


def form_frames(
    lights: Sequence[AccumulatedLight], basis: sparse.csr_array, probes: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Frames of mixtures of light, and its replicates times probes.

    Parameters
    ----------
    lights
        of the same rows; their frames add up.
    basis
        (b, rows) mixtures.
    probes
        (m', probes) of :func:`probe_vectors`; None: no replicates.

    Returns
    -------
    (b, m, m') frames, and (b, m * groups * probes) of single groups.
    """
    shape, groups = lights[0].optics.frame_shape, len(lights[0].groups)
    mixed, count = _mix_lights(lights, basis), basis.shape[0]
    frames = np.zeros((count, *shape))
    probed = np.zeros((count, shape[0] * groups * (0 if probes is None else probes.shape[1])))

    def form(row: int) -> None:
        for number, (optics, parts) in enumerate(mixed):
            frame, seen = optics.frame_and_products(
                [_row(part, row) for part in parts], probes, None if number else frames[row]
            )
            if number:
                frames[row] += frame
            probed[row] += seen.ravel()

    in_threads(form, range(count))
    return frames, probed


def probe_frames(
    lights: Sequence[AccumulatedLight], basis: sparse.csr_array, probes: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Replicates of mixtures of light, without the frames themselves.

    Parameters
    ----------
    lights, basis, probes
        as for :func:`form_frames`.

    Returns
    -------
    (b, m * groups * probes) of single groups, and (b, lights, groups, groups) inner products of their differences.
    """
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


def _mix_lights(
    lights: Sequence[AccumulatedLight], basis: sparse.csr_array
) -> list[tuple[FrameOptics, list[sparse.csr_array]]]:
    """Mixtures ``basis`` (b, rows) of each group of each light, with the light's optics."""
    mixed = [(light.optics, [_product(basis, group) for group in light.groups]) for light in lights]
    for _, parts in mixed:
        for part in parts:
            part.sort_indices()
    return mixed


def _product(basis: sparse.csr_array, light: sparse.csr_array) -> sparse.csr_array:
    """``basis @ light``; ``light`` itself where each row stays what it is."""
    if basis.nnz == len(basis.indices) == basis.shape[1] and not (basis - sparse.eye_array(*basis.shape)).nnz:
        return light
    if light.shape[1] <= _MOST_COLUMNS:
        return basis @ light
    places, indices = np.unique(light.indices, return_inverse=True)
    lit = sparse.csr_array((light.data, indices, light.indptr), shape=(light.shape[0], max(len(places), 1)))
    product = (basis @ lit).tocsr()
    # SciPy adds matrices of sorted rows entry by entry, and others by way of all their columns.
    product.sort_indices()
    wide = places[product.indices] if len(places) else product.indices
    return sparse.csr_array((product.data, wide, product.indptr), shape=(basis.shape[0], light.shape[1]))


def _row(matrix: sparse.csr_array, row: int) -> Entries:
    inside = slice(matrix.indptr[row], matrix.indptr[row + 1])
    return matrix.indices[inside], matrix.data[inside]


# -------- Shots as sums of frames that are held


@dataclass(frozen=True, eq=False)
class Mixture:
    """Shots as sums of frames that are held.

    Attributes
    ----------
    weights
        (shots, b) of each held frame in each shot.
    least
        (b,) parts of them that all shots have and are added once.
    own
        the weights less these.
    """

    weights: FloatArray
    least: FloatArray
    own: sparse.csr_array

    @property
    def sparse(self) -> bool:
        """Whether shots have few frames of their own: adding them up then takes less than a product of matrices."""
        return bool(self.own.nnz <= _FEW * len(self.weights))

    @cached_property
    def one_each(self) -> bool:
        """Whether every shot has one held frame, and every held frame one shot."""
        shots, held = self.own.shape
        alone = np.array_equal(np.diff(self.own.indptr), np.ones(shots))
        return shots == held and alone and np.array_equal(np.sort(self.own.indices), np.arange(held))

    def in_place(self, basis: FloatArray) -> Sequence[FloatArray]:
        """All shots of which :attr:`one_each` holds, bit for bit as :meth:`shots` has them, where the frames of the
        ``basis`` (b, ...) lay: those are overwritten, for no memory is as dear as new memory."""
        common = mix_frames(self.least[None], basis)[0] if self.least.any() else None

        def weigh_in_place(shot: int) -> FloatArray:
            (number,), (weight,) = _row(self.own, shot)
            frame: FloatArray = basis[number]
            if weight != 1:
                frame *= weight
            if common is not None:
                frame += common
            return frame

        return in_threads(weigh_in_place, range(len(self.weights)))

    def shots(self, basis: FloatArray, start: int, stop: int) -> Sequence[FloatArray]:
        """Shots of the frames that are held; some may be of these themselves.

        Parameters
        ----------
        basis
            (b, ...) frames that are held.
        start, stop
            numbers of shots.
        """
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
    """Pairs of complementary shots: those to form, and how all shots follow from them. A shot equals a formed one, or
    is the light of all pixels less a formed one.

    Patterns of +1 and -1 are shown as two shots that add up to the light of all pixels (of Hadamard patterns the first
    is that light), so half of the shots need no product of matrices. None where ``weights`` (shots, classes) have
    other values than two, or more pairs of shots than classes.
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
    """(shots, ...) sums of a basis by weights.

    Parameters
    ----------
    weights
        (shots, b).
    basis
        (b, ...) arrays.
    out
        (shots, ...) for the result, which may be the first of the basis itself; a new array if not given.
    """
    flat = basis.reshape(len(basis), -1)
    mixed = np.empty((len(weights), flat.shape[1])) if out is None else out.reshape(len(weights), -1)

    def part(start: int) -> None:
        inside = slice(start, start + _COLUMNS)
        mixed[:, inside] = weights @ flat[:, inside]

    in_threads(part, range(0, flat.shape[1], _COLUMNS))
    return mixed.reshape(len(weights), *basis.shape[1:])


# -------- Replicates
#
# Replicates: frames of independent groups of light in, the Monte Carlo error of their mean and its bound out.
#
# Squared norms are estimated without bias from products with random signs (Hutchinson's estimator), because forming as
# many frames as there are groups would cost more than the frames themselves.

PROBES = 8
"""Random signs beside the constant vector; chosen so that probing costs less than a frame (:func:`probe_vectors`)."""
_STUDENT = 12.706205, 4.302653, 3.182446
"""97.5 % quantiles of Student's t with 1, 2 and 3 degrees of freedom, and with more the last, which is larger."""
_OF_ONE_KIND = 0.625
"""Power of the part of one kind of noise with which the squared bound grows. The bound of four groups then holds in 95
to 99 % of draws with 1 to 500 equal kinds, and in 93 to 95 % where one kind has a tenth to nine tenths of the noise
beside many small ones. A power of 0.75 gives 91 % there, and 1 gives 89 %."""


def probe_vectors(pixels: int, seed: int) -> FloatArray:
    """(pixels, 1 + 8) vectors v with E sum |A v|^2 = ||A||^2: the constant one exactly, the rest by random signs.

    Most of a frame's error is common to its columns, and a few signs alone would see that part with 12 % scatter.

    Parameters
    ----------
    pixels, seed
        columns of a frame, and of the signs.
    """
    constant = np.full((pixels, 1), pixels**-0.5)
    signs = stream(seed, "probe").choice((-1.0, 1.0), size=(pixels, PROBES)) / PROBES**0.5
    return np.concatenate([constant, signs - constant @ (constant.T @ signs)], axis=1)


def noise_of_groups(probed: FloatArray, rows: int, groups: int) -> FloatArray:
    """Return the (groups, groups) inner products of the differences of groups' frames from their mean.

    Not products of matrices, because BLAS adds up in an order that depends on its threads.

    Parameters
    ----------
    probed
        (rows * groups * probes,) the groups' frames times :func:`probe_vectors`.
    rows, groups
        of a frame, and of the light.
    """
    by_group = probed.reshape(rows, groups, -1)
    off = by_group - by_group.mean(axis=1, keepdims=True)
    return np.asarray(np.einsum("rgp,rhp->gh", off, off))


def bound_of(products: FloatArray, energy: float) -> float:
    """Return the 95 % bound of a relative Monte Carlo error.

    The error that was made is one draw, and its estimate another. How far the bound lies above the estimate depends on
    how many kinds of noise there are. All groups differ alike where there are many: then the inner products of their
    differences have G - 1 equal eigenvalues. Of a single kind, all differences are multiples of one frame, and the
    bound is that of Student's t with G - 1 degrees of freedom. In between, the squared bound grows with the squared
    norm of the products, and faster at first, because three differences do not always show a kind that has most of the
    noise.

    Parameters
    ----------
    products
        (G, G) inner products of what the G groups bring to the error; their trace is its square, not yet relative.
    energy
        squared norm of the frames.
    """
    variance, freedom = float(np.trace(products)), len(products) - 1
    if not energy or not variance or not freedom:
        return 0.0
    one, norm = _STUDENT[min(freedom, len(_STUDENT)) - 1] ** 2, float(np.square(products).sum())
    part = (freedom * norm / variance**2 - 1) / (freedom - 1) if freedom > 1 else 1.0
    return math.sqrt((1 + (one - 1) * max(part, 0.0) ** _OF_ONE_KIND) * variance / energy)
