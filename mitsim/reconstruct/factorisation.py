"""One side of the model factorised: from a factor Phi and its pattern columns P to singular values and slabs.

With K patterns p_i, the stacked matrix B = [Phi diag(p_1); ...; Phi diag(p_K)] (m K, n) holds all that one
side contributes: the paper's A = Phi^T Phi o P P^T (arXiv 2111.12862, eq. 7) is B^T B. Forming A squares the
condition number, so B itself is factorised, B = U S V^T, and row block i of U is kept as *slab* i: what
frames of pattern i are projected on.

Where P P^T vanishes between groups of scene pixels, B falls apart into *blocks* that are factorised alone,
and slab i touches only the blocks that pattern i lights.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt
from scipy.sparse.csgraph import connected_components

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError

IndexArray = npt.NDArray[np.intp]
Method = Literal["svd", "gram"]
Structure = Literal["auto", "block", "full"]
Strips = tuple[slice, ...]
StripHalves = tuple[Strips, Strips]
_STRIPS = 8
"""Strips of sensor rows that alternate between the two halves: some on either side of all that varies slowly over the
sensor, and each wider than a feature of the mask or a neighbour's crosstalk."""


@dataclass(frozen=True, eq=False)
class Group:
    """Scene pixels factorised together, and their pattern rows as ``weights psi^T`` where they are of rank one.

    ``pixels`` (c,), ``patterns`` (c, K), ``shared`` is (weights (c,), psi (K,)) or None.
    """

    pixels: IndexArray
    patterns: FloatArray
    shared: tuple[FloatArray, FloatArray] | None

    def lights(self, index: int) -> bool:
        """Whether pattern ``index`` lights any of these pixels."""
        return bool(self.patterns[:, index].any() if self.shared is None else self.shared[1][index])


@dataclass(frozen=True, eq=False)
class Slab:
    """What one pattern index contributes: ``matrix`` (m, c) and the ``columns`` (c of them) it fills in W."""

    columns: slice | IndexArray
    matrix: FloatArray


@dataclass(frozen=True, eq=False)
class Side:
    """Factorised side of the model.

    Attributes
    ----------
    basis
        (n, r) right singular vectors V of B (for ``gram``: eigenvectors of A).
    singular
        (r,) singular values of B, numerically zero ones set to exactly 0. r = min(n, rows of B) over the
        blocks.
    slabs
        one a pattern index.
    projected
        True: slabs are rows of U. False (``gram``): slabs are Phi diag(p_i), and W is the paper's Q.
    pattern_count, sensor_size, scene_size, data_rows
        K; m; n; independent data rows, m K (less K once frames are centred).
    dual
        (n, r) V' with B = U S V'^T; None: V' is the basis, which is orthonormal
        (:mod:`mitsim.reconstruct.solver` has others).
    spread
        condition of what the basis is made with, which magnifies rounding; 1 of an orthonormal one.
    """

    basis: FloatArray
    singular: FloatArray
    slabs: tuple[Slab, ...]
    projected: bool
    pattern_count: int
    sensor_size: int
    scene_size: int
    data_rows: int
    dual: FloatArray | None = None
    spread: float = 1.0

    @cached_property
    def response(self) -> FloatArray:
        """B^T U (n, r): what the coefficients see of light of each scene pixel."""
        return _frozen(self.duals * self.singular)

    @property
    def duals(self) -> FloatArray:
        """V' (n, r) of B = U S V'^T."""
        return self.basis if self.dual is None else self.dual

    @property
    def common(self) -> FloatArray:
        """(m, r) sum of all slabs: how each coefficient takes what is common to all frames."""
        total = np.zeros((self.sensor_size, self.accumulated_size))
        for slab in self.slabs:
            total[:, slab.columns] += slab.matrix
        return total

    def columns(self, index: int) -> IndexArray:
        """Places in W of what pattern ``index`` contributes."""
        return np.arange(self.accumulated_size)[self.slabs[index].columns]

    @property
    def rank(self) -> int:
        """Number of singular values above the rank cut."""
        return int(np.count_nonzero(self.singular))

    @property
    def condition(self) -> float:
        """cond(A): (largest / smallest singular value of B)**2; inf when rank deficient."""
        if self.rank < self.scene_size:
            return float("inf")
        return float((self.singular.max() / self.singular.min()) ** 2)

    @property
    def accumulated_size(self) -> int:
        """Length of this side of W."""
        return len(self.singular) if self.projected else self.scene_size

    @cached_property
    def halves(self) -> StripHalves:
        """Sensor rows of the two halves that :mod:`mitsim.reconstruct.regularisation` holds against each other, as
        strips: an array of them would copy each frame that it picks from."""
        width = -(-self.sensor_size // _STRIPS)
        strips = tuple(slice(first, first + width) for first in range(0, self.sensor_size, width))
        return strips[::2], strips[1::2]

    @cached_property
    def first_half(self) -> FloatArray:
        """G = U_0^T U_0 (r, r), with U_0 the rows of U in the first half of the sensor: what that half sees of W."""
        gram = np.zeros((self.accumulated_size, self.accumulated_size))
        for index, slab in enumerate(self.slabs):
            rows = np.concatenate([slab.matrix[strip] for strip in self.halves[0]])
            columns = self.columns(index)
            gram[np.ix_(columns, columns)] += rows.T @ rows
        if self.projected:
            return gram
        scale = np.divide(1.0, self.singular, out=np.zeros_like(self.singular), where=self.singular > 0)
        return np.asarray(scale[:, None] * (self.basis.T @ gram @ self.basis) * scale)


def pattern_blocks(patterns: FloatArray) -> tuple[IndexArray, ...]:
    """Groups of scene pixels between which P P^T vanishes: the connected components of its nonzero pattern.

    ``patterns`` is P (n, K). Whole-number patterns are multiplied in integers, so that orthogonal rows give
    an exact zero; for others two pixels are held apart only if no pattern lights both. Order: by first
    pixel.
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


def group_pixels(patterns: FloatArray, structure: Structure) -> tuple[Group, ...]:
    """What of the factorisation depends on ``patterns`` (n, K) alone; ``structure`` full makes one group."""
    if structure == "full":
        return (Group(np.arange(len(patterns)), patterns, None),)
    return tuple(Group(block, patterns[block], _rank_one(patterns[block])) for block in pattern_blocks(patterns))


def factorise(
    phi: FloatArray,
    patterns: FloatArray,
    groups: tuple[Group, ...],
    method: Method,
    structure: Structure,
    centred: bool,
) -> Side:
    """Factorise one side.

    Parameters
    ----------
    phi, patterns
        (m, n) and (n, K), checked.
    groups
        of the patterns.
    method, structure
        as for :func:`mitsim.reconstruct.solver.prepare`.
    centred
        whether frames lose row and column means.
    """
    sensor, scene = phi.shape
    build = _factorise_svd if method == "svd" else _factorise_gram
    basis, singular, slabs = build(phi, patterns, groups, structure)
    return Side(
        basis=_frozen(basis),
        singular=_frozen(singular),
        slabs=slabs,
        projected=method == "svd",
        pattern_count=patterns.shape[1],
        sensor_size=sensor,
        scene_size=scene,
        data_rows=(sensor - centred) * patterns.shape[1],
    )


def _factorise_svd(
    phi: FloatArray, patterns: FloatArray, groups: tuple[Group, ...], structure: Structure
) -> tuple[FloatArray, FloatArray, tuple[Slab, ...]]:
    """SVD of B block by block: basis, singular values, slabs."""
    parts = [_block_svd(phi[:, group.pixels], group) for group in groups]
    singular = np.concatenate([part[1] for part in parts])
    starts = np.concatenate(([0], np.cumsum([len(part[1]) for part in parts])))
    basis = np.zeros((phi.shape[1], len(singular)))
    for group, part, start, stop in zip(groups, parts, starts[:-1], starts[1:], strict=True):
        basis[group.pixels, start:stop] = part[2].T
    # Rank cut of numpy.linalg.matrix_rank, against the largest value of the whole side, not of the block.
    longest = max(phi.shape[0] * patterns.shape[1], phi.shape[1])
    singular[singular <= singular.max() * longest * np.finfo(np.float64).eps] = 0.0
    slabs = []
    for index in range(patterns.shape[1]):
        lit = [b for b, group in enumerate(groups) if structure == "full" or group.lights(index)]
        columns = np.concatenate([np.arange(starts[b], starts[b + 1]) for b in lit] or [np.arange(0)])
        pieces = [parts[b][0][index] for b in lit] or [np.zeros((phi.shape[0], 0))]
        slabs.append(Slab(_as_slice(columns), _frozen(np.concatenate(pieces, axis=1))))
    return basis, singular, tuple(slabs)


def _block_svd(phi: FloatArray, group: Group) -> tuple[tuple[FloatArray, ...], FloatArray, FloatArray]:
    """U cut into K slabs (m, r), singular values (r,) and V^T (r, n) of one block's stacked matrix."""
    patterns = group.patterns
    if group.shared is not None:
        # B = psi (x) Phi diag(w): the SVD of one slab serves all, whatever K.
        weights, psi = group.shared
        norm = float(np.linalg.norm(psi))
        left, singular, right = _svd(phi * weights)
        scale = psi / (norm or 1.0)
        return tuple(_scale(left, factor) for factor in scale), singular * norm, right
    # Phi = Q R once: B = (I (x) Q) [R diag(p_1); R diag(p_2); ...] is then as short as R, and as accurate.
    q, small = np.linalg.qr(phi)
    stacked = np.concatenate([small * column for column in patterns.T])
    left, singular, right = _svd(stacked)
    return tuple(q @ slab for slab in np.split(left, patterns.shape[1])), singular, right


def _scale(matrix: FloatArray, factor: float) -> FloatArray:
    """matrix * factor without the work for 1, and with no columns for 0: a dark block is never read."""
    if factor == 0.0:
        return matrix[:, :0]
    return matrix if factor == 1.0 else matrix * factor


def _rank_one(patterns: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """(w, psi) with patterns = w psi^T exactly, or None: rows that are multiples of one another."""
    lit_rows = np.flatnonzero(patterns.any(axis=1))
    if len(lit_rows) == 0:
        return np.zeros(len(patterns)), np.zeros(patterns.shape[1])
    psi = patterns[lit_rows[0]]
    pivot = int(np.flatnonzero(psi)[0])
    weights = patterns[:, pivot] / psi[pivot]
    return (weights, psi) if np.array_equal(np.outer(weights, psi), patterns) else None


def _svd(matrix: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Thin SVD (LAPACK gesdd, which takes a QR first when the matrix is tall).

    numpy's LAPACK, not scipy's: the two wheels carry two thread pools, which on a busy machine wait for
    each other (2.5 s instead of 15 ms was seen on 2 cores).
    """
    left, singular, right = np.linalg.svd(matrix, full_matrices=False)
    return left, singular, right


def _factorise_gram(
    phi: FloatArray, patterns: FloatArray, groups: tuple[Group, ...], structure: Structure
) -> tuple[FloatArray, FloatArray, tuple[Slab, ...]]:
    """Eigen-decomposition of A block by block (the paper's way), and slabs Phi diag(p_i)."""
    scene = phi.shape[1]
    basis, eigenvalues = np.zeros((scene, scene)), np.zeros(scene)
    start = 0
    for block in (group.pixels for group in groups):
        gram = (phi[:, block].T @ phi[:, block]) * (patterns[block] @ patterns[block].T)
        values, vectors = np.linalg.eigh(gram)
        stop = start + len(block)
        eigenvalues[start:stop] = values
        basis[block, start:stop] = vectors
        start = stop
    # A has no negative eigenvalues: what falls below its rounding error carries no information.
    eigenvalues[eigenvalues <= eigenvalues.max() * scene * np.finfo(np.float64).eps] = 0.0
    slabs = []
    for column in patterns.T:
        columns = np.arange(scene) if structure == "full" else np.flatnonzero(column)
        slabs.append(Slab(_as_slice(columns), _frozen(phi[:, columns] * column[columns])))
    return basis, np.sqrt(eigenvalues), tuple(slabs)


def _as_slice(columns: IndexArray) -> slice | IndexArray:
    """Equally spaced columns as a slice: basic indexing is then a view, twice as fast."""
    if len(columns) == 0:
        return slice(0, 0)
    step = int(columns[1] - columns[0]) if len(columns) > 1 else 1
    if (np.diff(columns) == step).all():
        return slice(int(columns[0]), int(columns[-1]) + 1, step)
    return columns


def _frozen(array: FloatArray) -> FloatArray:
    array = np.ascontiguousarray(array)
    array.flags.writeable = False
    return array


def check_choices(method: str, structure: str) -> None:
    """MitsimError unless ``method`` and ``structure`` are known."""
    for name, chosen, known in (("method", method, get_args(Method)), ("structure", structure, get_args(Structure))):
        if chosen not in known:
            raise MitsimError(f"solver {name} is {chosen!r}; use one of {', '.join(known)}")
