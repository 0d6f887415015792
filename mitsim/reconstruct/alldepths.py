"""Shots and factors in; out come the measurements and the factors of all depths, on bases that these depths share.

Columns of neighbouring depths are much alike: a few hundred vectors span all of them, and what of a frame lies outside
is not explained at any depth. So frames are read once and kept small.
"""

from __future__ import annotations

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError
from mitsim.core.measurement import Measurement
from mitsim.core.runs import Capture
from mitsim.reconstruct.accumulator import centred, centred_columns
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.focus import LEAST_PART, FactorOfDepths, stated_parallax
from mitsim.reconstruct.noise import FrameNoise

RANGE = 0.25
"""Depths that are looked for where no range is given, as a part of 1/z: 320 to 533 mm for 400. A baseline of 60 mm
moves light by an eighth of a window of 0.3 rad."""
_LEFT_OUT = 1e-6
"""Part of the factors' energy that the common basis of all depths may leave out: below their noise's."""


class AllDepths:
    """Frames of a capture, and factors of any depth within a range.

    Parameters
    ----------
    shots, factors
        of the same camera; MitsimError for factors without parallax.
    shifts
        least and largest change of 1/z [1/mm]; ArgumentError where too little of the sensor knows all these depths.

    Attributes
    ----------
    parallax, patterns
        of the factors and the shots.
    noise
        of the measurements on the whole sensor.
    frames
        measurements on the bases.
    energy, outside
        squared norm of the measurements on the part of the sensor where all depths are known, and what of it no depth
        explains.
    data, part
        their number, and what part of the sensor they are of.
    """

    def __init__(self, shots: Capture, factors: Factors, shifts: tuple[float, float]) -> None:
        self.parallax, self.patterns = stated_parallax(factors), shots.patterns
        self._sides = tuple(
            FactorOfDepths(side, self.parallax, axis) for axis, side in enumerate((factors.left, factors.right))
        )
        self._centre = factors.manifest.centre
        self._parts, self._bases = [], list[FloatArray]()
        for side in self._sides:
            tried = np.linspace(*shifts, max(int(np.ceil((shifts[1] - shifts[0]) * side.reach)) + 1, 2))
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
            self._bases.append(_basis([self._own(columns[part]) for columns, _ in found]))
        self.energy, kept = 0.0, list[Measurement]()
        self.noise = FrameNoise(shots.manifest)
        for each in shots.measured((len(factors.left), len(factors.right))):
            frame = each.frame[self._parts[0], self._parts[1]]
            frame = centred(frame) if self._centre else frame
            self.energy += float(np.square(frame).sum())
            self.noise.add(each)
            small = self._bases[0].T @ frame @ self._bases[1]
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
        return np.asarray(self._bases[axis].T @ self._own(self._moved(axis, shift)))

    def widened(self, axis: int, pixels: int) -> FloatArray:
        """(r, ``pixels`` + n + ``pixels``) columns of an ``axis`` on its basis, with those that light beside the window
        has: of the outermost pixels, moved there by their depth."""
        edges = self.edges(axis)
        before, beyond = (self._moved(axis, offset / edges) for offset in (-pixels, pixels))
        count = before.shape[1]
        columns = np.hstack([before[:, :pixels], self._moved(axis, 0.0), beyond[:, count - pixels :]])
        return np.asarray(self._bases[axis].T @ self._own(columns))

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


def _basis(factors: list[FloatArray]) -> FloatArray:
    """(m, r) orthonormal columns that span those of all ``factors``, but for a part of their energy."""
    energies, vectors = np.linalg.eigh(sum(factor @ factor.T for factor in factors))
    lost = np.cumsum(np.maximum(energies, 0.0))
    return np.asarray(vectors[:, lost > _LEFT_OUT * lost[-1]])
