"""Factorisation of one side of the model: singular values and slabs from a factor Phi and its pattern columns P.

With K patterns p_i, the stacked matrix B = [Phi diag(p_1); ...; Phi diag(p_K)] (m K, n) describes one side: the paper's
A = Phi^T Phi o P P^T (arXiv 2111.12862, eq. 7) is B^T B. Forming A squares the condition number, so B = U S V^T itself
is factorised, and row block i of U is kept as *slab* i, on which frames of pattern i are projected.

Where P P^T vanishes between groups of scene pixels, each *block* of B is factorised alone, and slab i contains only the
blocks that pattern i lights.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse.csgraph import connected_components

from mitsim.core.arrays import FloatArray

IndexArray = npt.NDArray[np.intp]
Strips = tuple[slice, ...]
StripHalves = tuple[Strips, Strips]
_STRIPS = 8


@dataclass(frozen=True, eq=False)
class Group:
    """Scene pixels (c,) factorised together; ``shared`` is (weights (c,), psi (K,)) if patterns are weights psi^T."""

    pixels: IndexArray
    patterns: FloatArray
    shared: tuple[FloatArray, FloatArray] | None

    def lights(self, index: int) -> bool:
        return bool(self.patterns[:, index].any() if self.shared is None else self.shared[1][index])


@dataclass(frozen=True, eq=False)
class Slab:
    columns: slice | IndexArray
    matrix: FloatArray


@dataclass(frozen=True, eq=False)
class Side:
    """Factorised side of the model: right singular vectors ``basis`` (n, r) and singular values (r,) of B.

    Numerically zero singular values are exactly 0. ``data_rows`` is m K, less K once frames are centred. ``dual`` (n,
    r) is V' with B = U S V'^T, None if V' is the basis. ``spread`` is the condition of the matrix that makes the
    basis, which magnifies rounding.
    """

    basis: FloatArray
    singular: FloatArray
    slabs: tuple[Slab, ...]
    pattern_count: int
    sensor_size: int
    scene_size: int
    data_rows: int
    dual: FloatArray | None = None
    spread: float = 1.0

    @cached_property
    def response(self) -> FloatArray:
        """B^T U (n, r), the response of the coefficients to each scene pixel."""
        return _frozen(self.duals * self.singular)

    @property
    def duals(self) -> FloatArray:
        return self.basis if self.dual is None else self.dual

    @property
    def common(self) -> FloatArray:
        total = np.zeros((self.sensor_size, len(self.singular)))
        for slab in self.slabs:
            total[:, slab.columns] += slab.matrix
        return total

    def columns(self, index: int) -> IndexArray:
        return np.arange(len(self.singular))[self.slabs[index].columns]

    @property
    def rank(self) -> int:
        return int(np.count_nonzero(self.singular))

    @property
    def condition(self) -> float:
        if self.rank < self.scene_size:
            return float("inf")
        return float((self.singular.max() / self.singular.min()) ** 2)

    @cached_property
    def halves(self) -> StripHalves:
        """Sensor rows of the two halves as strips, because an index array would copy each frame."""
        width = -(-self.sensor_size // _STRIPS)
        strips = tuple(slice(first, first + width) for first in range(0, self.sensor_size, width))
        return strips[::2], strips[1::2]

    @cached_property
    def first_half(self) -> FloatArray:
        """G = U_0^T U_0 (r, r), with U_0 the rows of U in the first half of the sensor."""
        gram = np.zeros((len(self.singular), len(self.singular)))
        for index, slab in enumerate(self.slabs):
            rows = np.concatenate([slab.matrix[strip] for strip in self.halves[0]])
            columns = self.columns(index)
            gram[np.ix_(columns, columns)] += rows.T @ rows
        return gram


def pattern_blocks(patterns: FloatArray) -> tuple[IndexArray, ...]:
    """Return the groups of scene pixels between which P P^T vanishes, sorted by their first pixel.

    Whole-number ``patterns`` P (n, K) are multiplied in integers, so that orthogonal rows give an exact zero.
    Otherwise two pixels are separated only if no pattern lights both.
    """
    kinds, kind = np.unique(patterns, axis=0, return_inverse=True)
    whole = np.rint(kinds)
    if np.array_equal(whole, kinds) and np.abs(whole).max(initial=0) < 2**24:
        linked = (whole.astype(np.int64) @ whole.astype(np.int64).T) != 0
    else:
        lit = (kinds != 0).astype(np.int64)
        linked = (lit @ lit.T) != 0
    count, label = connected_components(linked, directed=False)
    found = [np.flatnonzero(label[kind.ravel()] == block) for block in range(count)]
    return tuple(sorted(found, key=lambda block: int(block[0])))


def group_pixels(patterns: FloatArray) -> tuple[Group, ...]:
    groups = []
    for block in pattern_blocks(patterns):
        lit, own = np.flatnonzero(patterns[block].any(axis=1)), patterns[block]
        psi = own[lit[0]] if len(lit) else np.zeros(own.shape[1])
        weights = np.zeros(len(own))
        if len(lit):
            pivot = int(np.flatnonzero(psi)[0])
            weights = own[:, pivot] / psi[pivot]
        groups.append(Group(block, own, (weights, psi) if np.array_equal(np.outer(weights, psi), own) else None))
    return tuple(groups)


def factorise(phi: FloatArray, patterns: FloatArray, groups: tuple[Group, ...], centred: bool = False) -> Side:
    sensor, scene = phi.shape
    parts = [_block_svd(phi[:, group.pixels], group) for group in groups]
    singular = np.concatenate([part[1] for part in parts])
    starts = np.concatenate(([0], np.cumsum([len(part[1]) for part in parts])))
    basis = np.zeros((scene, len(singular)))
    for group, part, start, stop in zip(groups, parts, starts[:-1], starts[1:], strict=True):
        basis[group.pixels, start:stop] = part[2].T
    # Rank cut of numpy.linalg.matrix_rank, against the largest value of the whole side, not of the block.
    longest = max(sensor * patterns.shape[1], scene)
    singular[singular <= singular.max() * longest * np.finfo(np.float64).eps] = 0.0
    slabs = []
    for index in range(patterns.shape[1]):
        lit = [b for b, group in enumerate(groups) if group.lights(index)]
        columns = np.concatenate([np.arange(starts[b], starts[b + 1]) for b in lit] or [np.arange(0)])
        pieces = [parts[b][0][index] for b in lit] or [np.zeros((sensor, 0))]
        # Equally spaced columns are a slice, because basic indexing is a view and twice as fast.
        step = int(columns[1] - columns[0]) if len(columns) > 1 else 1
        even = slice(int(columns[0]), int(columns[-1]) + 1, step) if len(columns) else slice(0, 0)
        places = even if (np.diff(columns) == step).all() else columns
        slabs.append(Slab(places, _frozen(np.concatenate(pieces, axis=1))))
    return Side(
        basis=_frozen(basis),
        singular=_frozen(singular),
        slabs=tuple(slabs),
        pattern_count=patterns.shape[1],
        sensor_size=sensor,
        scene_size=scene,
        data_rows=(sensor - centred) * patterns.shape[1],
    )


def _block_svd(phi: FloatArray, group: Group) -> tuple[tuple[FloatArray, ...], FloatArray, FloatArray]:
    """Return the slabs, singular values and right vectors of a group's stacked matrix.

    The SVD is numpy's, because scipy's wheel has a second thread pool (2.5 s instead of 15 ms on a busy machine).
    """
    patterns = group.patterns
    if group.shared is not None:
        # B = psi (x) Phi diag(w): the SVD of one slab serves all, whatever K.
        weights, psi = group.shared
        norm = float(np.linalg.norm(psi))
        left, singular, right = np.linalg.svd(phi * weights, full_matrices=False)
        scale = psi / (norm or 1.0)
        # Without the work for 1, and without columns for 0.
        scaled = (left[:, :0] if k == 0.0 else left if k == 1.0 else left * k for k in scale)
        return tuple(scaled), singular * norm, right
    # Phi = Q R once: B = (I (x) Q) [R diag(p_1); R diag(p_2); ...] is then as short as R, and as accurate.
    q, small = np.linalg.qr(phi)
    stacked = np.concatenate([small * column for column in patterns.T])
    left, singular, right = np.linalg.svd(stacked, full_matrices=False)
    return tuple(q @ slab for slab in np.split(left, patterns.shape[1])), singular, right


def _frozen(array: FloatArray) -> FloatArray:
    array = np.ascontiguousarray(array)
    array.flags.writeable = False
    return array
