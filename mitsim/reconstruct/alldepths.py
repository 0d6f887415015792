"""Shots and factors in; out come the measurements and the factors of all depths, on bases that these depths share.

Columns of neighbouring depths are much alike: a few hundred vectors span all of them, and what of a frame lies outside
is not explained at any depth. So frames are read once and kept small.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError
from mitsim.core.measurement import Measurement
from mitsim.core.runs import Capture
from mitsim.reconstruct.accumulator import centred, centred_columns
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.focus import LEAST_PART, FactorOfDepths, stated_parallax
from mitsim.reconstruct.noise import FrameNoise
from mitsim.reconstruct.sides import Group

RANGE = 0.25
"""Depths that are looked for where no range is given, as a part of 1/z: 320 to 533 mm for 400. A baseline of 60 mm
moves light by an eighth of a window of 0.3 rad."""
_LEFT_OUT = 1e-6
"""Part of the factors' energy that the common basis of all depths may leave out: below their noise's."""
_STILL, _BETWEEN = 2.0, 4
"""Projector pixels of parallax up to which dots have a basis of their own along an axis, as depth hardly moves their
shadows there: a quarter of the vectors (54 of 200, 20 of 126), where more parallax leaves none out; and depths a pixel
that these are made of, as no neighbour's column makes up for one between."""


class AllDepths:
    """Frames of a capture, and factors of any depth within a range.

    Parameters
    ----------
    shots, factors
        of the same camera; MitsimError for factors without parallax.
    shifts
        least and largest change of 1/z [1/mm]; ArgumentError where too little of the sensor knows all these depths.
    groups
        scene pixels along both axes that patterns light apart (:func:`mitsim.reconstruct.sides.group_pixels`): where
        each pattern lights one group, its frames may be on a basis of that alone, and so are the columns of
        :meth:`side`. None: all frames of an axis share one.

    Attributes
    ----------
    parallax, patterns
        of the factors and the shots.
    noise
        of the measurements on the whole sensor.
    frames, stack
        measurements on the bases, one by one and all in one (K, r, K', r').
    energy, outside
        squared norm of the measurements on the part of the sensor where all depths are known, and what of it no depth
        explains.
    data, part
        their number, and what part of the sensor they are of.
    """

    def __init__(
        self,
        shots: Capture,
        factors: Factors,
        shifts: tuple[float, float],
        groups: tuple[tuple[Group, ...], tuple[Group, ...]] | None = None,
    ) -> None:
        self.parallax, self.patterns = stated_parallax(factors), shots.patterns
        self._sides = tuple(
            FactorOfDepths(side, self.parallax, axis) for axis, side in enumerate((factors.left, factors.right))
        )
        self._centre = factors.manifest.centre
        self._parts, self._bases = [], list[_Basis]()
        for axis, side in enumerate(self._sides):
            pixels = (shifts[1] - shifts[0]) * side.reach
            alone = _alone(groups[axis], self.patterns[axis]) if groups and pixels <= _STILL else None
            tried = np.linspace(*shifts, max(int(np.ceil(pixels * (_BETWEEN if alone else 1))) + 1, 2))
            found = [side.at(shift) for shift in tried]
            part = slice(max(each.start for _, each in found), min(each.stop for _, each in found))
            if part.stop - part.start < LEAST_PART * len(side.factor):
                near, far = (1 / (1 / self.parallax.depth_mm + shift) for shift in reversed(shifts))
                raise ArgumentError(
                    "depth_range",
                    f"{near:.4g} to {far:.4g} mm: {max(part.stop - part.start, 0)} of {len(side.factor)} sensor rows "
                    f"or columns know the shadow at all of these depths; give a range nearer to the calibrated "
                    f"{self.parallax.depth_mm:g} mm",
                )
            self._parts.append(part)
            self._bases.append(_Basis([self._own(columns[part]) for columns, _ in found], alone))
        self.energy, kept = 0.0, list[Measurement]()
        left, right = self._bases
        self.stack = np.zeros((self.patterns[0].shape[1], left.size, self.patterns[1].shape[1], right.size))
        self.noise = FrameNoise(shots.manifest)
        for each in shots.measured((len(factors.left), len(factors.right))):
            frame = each.frame[self._parts[0], self._parts[1]]
            frame = centred(frame) if self._centre else frame
            self.energy += float(np.square(frame).sum())
            self.noise.add(each)
            small = self.stack[each.row, :, each.column]
            small[:] = left.of(each.row).T @ frame @ right.of(each.column)
            kept.append(Measurement(small, each.row, each.column, small, each.shots, 0))
        self.frames = tuple(kept)
        self.outside = self.energy - sum(float(np.square(each.frame).sum()) for each in kept)
        sizes = [part.stop - part.start for part in self._parts]
        self.data = len(kept) * sizes[0] * sizes[1]
        self.part = sizes[0] * sizes[1] / (len(factors.left) * len(factors.right))

    @property
    def shape(self) -> tuple[int, int]:
        """Scene pixels along both axes."""
        return self._sides[0].factor.shape[1], self._sides[1].factor.shape[1]

    def side(self, axis: int, shift: float | FloatArray) -> FloatArray:
        """(r, n) factor of an ``axis`` on its basis, 1/z changed by ``shift`` [1/mm] for all pixels or for each."""
        return self._bases[axis].seen(self._own(self._moved(axis, shift)))

    def widened(self, axis: int, pixels: int) -> FloatArray:
        """(r, ``pixels`` + n + ``pixels``) columns of an ``axis`` on its basis, with those that light beside the window
        has: of the outermost pixels, moved there by their depth."""
        edges = self.edges(axis)
        before, beyond = (self._moved(axis, offset / edges) for offset in (-pixels, pixels))
        count = before.shape[1]
        columns = np.hstack([before[:, :pixels], self._moved(axis, 0.0), beyond[:, count - pixels :]])
        return self._bases[axis].seen(self._own(columns))

    def edges(self, axis: int) -> FloatArray:
        """(n,) projector pixels along an ``axis`` that a change of 1/z by 1/mm moves the light of each."""
        return self._sides[axis].edges

    def reach(self, axis: int) -> float:
        """Projector pixels that a change of 1/z by 1/mm moves what some sensor pixel sees, along an ``axis``."""
        return self._sides[axis].reach

    def smoothing(self, shift: float) -> float:
        """Variance of noise in the factors at 1/z changed by ``shift`` [1/mm], over that of the calibrated ones."""
        return float(np.mean([side.noise(shift) ** 2 for side in self._sides]))

    def _moved(self, axis: int, shift: float | FloatArray) -> FloatArray:
        return self._sides[axis].at(shift)[0][self._parts[axis]]

    def _own(self, columns: FloatArray) -> FloatArray:
        return centred_columns(columns) if self._centre else columns


def searched(factors: Factors, depth_range: tuple[float, float] | None) -> tuple[float, float]:
    """Least and largest change of 1/z [1/mm] of the depths that are looked for.

    Parameters
    ----------
    factors
        with their parallax.
    depth_range
        nearest and farthest depth [mm], ArgumentError where the mask is beyond the nearest; None: :data:`RANGE`.
    """
    parallax = stated_parallax(factors)
    if depth_range is None:
        return -RANGE / parallax.depth_mm, RANGE / parallax.depth_mm
    near, far = depth_range
    if near <= parallax.mask_distance_mm:
        raise ArgumentError(
            "depth_range", f"{near:g} to {far:g} mm: begin above {parallax.mask_distance_mm:g} mm, where the mask is"
        )
    return 1 / far - 1 / parallax.depth_mm, 1 / near - 1 / parallax.depth_mm


def _alone(groups: tuple[Group, ...], patterns: FloatArray) -> list[tuple[npt.NDArray[np.intp], list[int]]] | None:
    """Scene pixels of each group, and which of the ``patterns`` (n, K) light it; None where one lights several."""
    lit = np.array([[group.lights(index) for index in range(patterns.shape[1])] for group in groups])
    if len(groups) == 1 or (lit.sum(axis=0) > 1).any():
        return None
    return [(group.pixels, [int(k) for k in np.flatnonzero(own)]) for group, own in zip(groups, lit, strict=True)]


class _Basis:
    """Orthonormal vectors (m, ``size``) that span the columns of all ``factors`` (m, n) but for a part of their energy;
    of those pixels that are lit ``alone``, where that is given, each with its patterns."""

    def __init__(self, factors: list[FloatArray], alone: list[tuple[npt.NDArray[np.intp], list[int]]] | None) -> None:
        self._alone = alone or [(np.arange(factors[0].shape[1]), [])]
        found = [np.linalg.eigh(sum(own @ own.T for own in (f[:, px] for f in factors))) for px, _ in self._alone]
        lost = [np.cumsum(np.maximum(energies, 0.0)) for energies, _ in found]
        self.size = max(int((each > _LEFT_OUT * each[-1]).sum()) for each in lost)
        self._vectors = [vectors[:, -self.size :] for _, vectors in found]
        self._by_pattern = {
            index: vectors
            for (_, indices), vectors in zip(self._alone, self._vectors, strict=True)
            for index in indices
        }

    def of(self, index: int) -> FloatArray:
        """(m, size) vectors for frames of pattern ``index``."""
        return self._by_pattern.get(index, self._vectors[0])

    def seen(self, columns: FloatArray) -> FloatArray:
        """(size, n) the ``columns`` (m, n) on the basis of each."""
        if len(self._vectors) == 1:
            return np.asarray(self._vectors[0].T @ columns)
        seen = np.zeros((self.size, columns.shape[1]))
        for (pixels, _), vectors in zip(self._alone, self._vectors, strict=True):
            seen[:, pixels] = vectors.T @ columns[:, pixels]
        return seen
