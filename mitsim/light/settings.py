"""Settings of a simulation, and the pilot's measurements by which they are chosen."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import NonNegative, Positive
from mitsim.core.parallel import in_threads

Number = float | FloatArray
Count = Annotated[int, Field(ge=1, le=4096)]
"""Anchors, cells or pixels along an axis in a plan's file; the largest projector has as many pixels."""
Index = Annotated[int, Field(ge=0, lt=4096**2)]
"""Number of a projector pixel in a plan's file."""
GROUPS = 4
"""Independent estimates of the light, whose spread is the Monte Carlo error (four suffice: docs/physics.md)."""
PATHS_AT_ONCE = 2**21
"""Paths whose light is held in memory at a time."""
FOLLOWED_WIDTH = 4
"""Projector pixels along a cell for followed light beyond its mean, which is little light of many anchors."""
CELLS_OF_COARSE = 4
"""Fine cells along a cell of coarse light with all layers: one cell a projector pixel at accuracies from 1e-3."""
MOST_PATHS = 2**32
"""Paths at which sampling stops and is flagged: half an hour on two cores."""


class Estimate(NamedTuple):
    """A relative error: its best ``value``, and the ``bound`` that it stays below at 95 %."""

    value: float
    bound: float


# -------- Settings


@dataclass(frozen=True)
class SharpPixels:
    """Projector pixels whose direct light comes over lobes too sharp for the anchors of all others.

    ``window`` has first and last tan-angle of their light along rows, then along columns.
    """

    pixels: tuple[Index, ...]
    anchors: Count
    window: tuple[float, float, float, float]
    left: NonNegative = 0.0


@dataclass(frozen=True)
class Settings:
    """Effects that are simulated, and the numbers of anchors, layers, cells and samples.

    Anchors are points along an axis of the sensor to which light is followed; ``occluded`` pixels have their own.

    Attributes
    ----------
    depth
        Mean depth of the light, 1 / mean(1/z) [mm], at which cells are aligned with the projector's pixels.
    layers
        Depths [mm], far to near, between which light is split; one for a flat scene.
    subdivision
        Cells along a projector pixel.
    samples
        Predicted samples of each group by pass, for each projector pixel, or for each cell of light from the camera.
    coarse_layers
        True if indirect light, and direct light beyond its mean over the anchors, has all layers and finer cells.
    shared
        True if neighbouring pixels share the second points of indirect light (:mod:`mitsim.transport.path_reuse`).
    repeats
        (blocks^2,) paths of each block of pixels in a sample of indirect light; empty for one path of each pixel.
    reach
        Largest tan-angle, seen from the sensor's centre, at which light of near surfaces is received, or None.
    raster
        True if frames are correlations with a mask's shadow on a raster, by FFT.
    """

    depth: Positive
    anchors: Count = 1
    layers: tuple[Positive, ...] = ()
    subdivision: Count = 1
    effects: frozenset[str] = frozenset()
    samples: Mapping[str, NonNegative] = field(default_factory=dict, hash=False)
    followed_anchors: Count = 1
    coarse_layers: bool = False
    shared: bool = False
    repeats: tuple[Index, ...] = ()
    reach: Positive | None = None
    sharp: SharpPixels | None = None
    occluded: tuple[Index, ...] = ()
    occluded_anchors: Count = 1
    raster: bool = False
    raster_cells: Index = 0

    @property
    def depths(self) -> tuple[float, ...]:
        return self.layers or (self.depth,)

    @property
    def coarse_cells(self) -> int:
        return max(self.subdivision // CELLS_OF_COARSE, 1) if self.coarse_layers else 1

    @property
    def followed_width(self) -> int:
        return max(FOLLOWED_WIDTH // self.coarse_cells, 1) if self.followed_anchors > 1 else 1

    @property
    def with_own_anchors(self) -> tuple[int, ...]:
        return self.occluded if self.occluded_anchors > 1 else ()


# -------- Measurements of the pilot

COUNTED = ("anchors", "layers", "cells", "followed_anchors", "occluded_anchors")
"""Numbers that a plan chooses: points of the sensor a side for direct light, depths, cells a side of a projector pixel,
points a side for light that is followed over several surfaces or from the camera, and for occluded pixels."""
_FEWEST_SAMPLES = 1e-3
"""Samples of light without noise, above 0 because costs are ratios."""
_AT_ONCE = 2**13
"""Entries of frames that are multiplied at a time: some megabytes instead of a hundred."""
REPLICATES = 4
"""Independent replicates of the pilot, the fewest whose spread is a usable standard error."""
SURE = 2.35
"""Standard errors from an estimate to its 95 % bound: Student's distribution with ``REPLICATES`` - 1 degrees."""
RASTER_RATE = 1.5
"""Power of the cells along a pixel with which a raster's error falls (measured from 6 to 12 cells: 1.4 to 2.9)."""


@dataclass(frozen=True)
class SampleCost:
    """Monte Carlo error of a pass: ``error`` at ``samples`` a cell, falling with samples^-rate, and paths a sample."""

    error: float
    samples: float
    paths: int
    rate: float = 0.5

    @classmethod
    def relative(cls, error: float, light: float, samples: int, paths: int, rate: float = 0.5) -> SampleCost:
        return cls(error / light if light else 0.0, samples, paths, rate)

    @property
    def variance(self) -> float:
        return self.samples * self.error**2

    def samples_for(self, target: Number) -> Number:
        if self.error <= 0:
            return _FEWEST_SAMPLES + 0 * target
        return self.samples * (self.error / target) ** (1 / self.rate)

    def error_left(self, samples: Number) -> Number:
        return self.error * (samples / self.samples) ** -self.rate


@dataclass(frozen=True, order=True)
class Approximation:
    name: str
    count: int = 0


WIDE = Approximation("followed_width", FOLLOWED_WIDTH)
"""Cells of several projector pixels, in one layer, for followed light beyond its mean."""


@dataclass(frozen=True, eq=False)
class ErrorCovariance:
    """Changes of the frames by approximations, as inner products between independent replicates.

    They give the change by any sum of approximations, without the replicates' noise. ``products`` (replicates,
    replicates, parts, parts) are relative to the squared norm of all light; those of a replicate with itself are not
    used.
    """

    parts: tuple[Approximation, ...]
    products: FloatArray

    @classmethod
    def between(cls, seen: Mapping[Approximation, FloatArray], energy: float) -> ErrorCovariance:
        flat = [change.reshape(REPLICATES, -1) for change in seen.values()]

        def multiply(first: int) -> FloatArray:
            some = np.concatenate([change[:, first : first + _AT_ONCE] for change in flat])
            return np.asarray(some @ some.T)

        count = len(flat) * REPLICATES
        parts = in_threads(multiply, range(0, flat[0].shape[1] if flat else 0, _AT_ONCE))
        pairs = sum(parts, np.zeros((count, count))).reshape(len(flat), REPLICATES, len(flat), REPLICATES)
        products = np.ascontiguousarray(pairs.transpose(1, 3, 0, 2))
        return cls(tuple(seen), products / energy if energy > 0 else products)

    def squared_errors(self, chosen: FloatArray) -> tuple[FloatArray, FloatArray]:
        replicates, places = len(self.products), np.arange(len(self.products))
        others = [self.products[place, places != place].sum(axis=0) for place in places]
        of_look = np.array([np.einsum("mp,mp->m", chosen @ products, chosen) for products in others])
        # Each pair is one of either replicate's.
        total, kept = of_look.sum(axis=0) / 2, replicates * (replicates - 1) / 2
        without = (total - of_look) / (kept - replicates + 1)
        spread = np.sqrt((replicates - 1) * np.square(without - without.mean(axis=0)).mean(axis=0))
        return total / kept, spread

    def estimate(self, parts: Collection[Approximation]) -> Estimate:
        chosen = np.array([[part in parts for part in self.parts]], dtype=np.float64)
        squared, spread = (float(values[0]) for values in self.squared_errors(chosen))
        least = max(squared, 0.0)
        return Estimate(math.sqrt(least), math.sqrt(least + SURE * spread))


@dataclass(frozen=True)
class Forming:
    """Quantities that determine the cost of forming frames, besides settings.

    Pairs are without diffraction and with it; pixels and cells are along an axis. ``lit`` is the part of the rows of
    cells that have light in a frame, ``drawing`` the time of a shadow's layer [s]. With ``correlated``, frames are
    never sums of separable terms; with ``parted``, lines share no paths.
    """

    pixels: float
    cells: int
    lit: float
    terms: float
    shots: int
    classes: int
    geometric_terms: float = 1.0
    correlated: tuple[bool, bool] = (False, False)
    phases: float = 16.0
    largest_terms: tuple[float, float] = (math.inf, math.inf)
    drawing: tuple[float, float] = (0.0, 0.0)
    lines: int = 1
    parted: bool = False
    occluded: tuple[float, float] = (1.0, 1.0)


@dataclass(frozen=True)
class Drawn:
    error: Estimate | None = None
    needed: bool = False
    cells: tuple[int, ...] = (4,)

    def error_left(self, cells: int) -> Estimate | None:
        finer = (cells or self.cells[0]) / self.cells[0]
        return self.error and Estimate(*(error * finer**-RASTER_RATE for error in self.error))


@dataclass(frozen=True)
class PilotResult:
    """Measurements of short runs of a scene (:mod:`mitsim.planner.pilot`), with the fields of :class:`Settings`.

    All errors are relative.

    Attributes
    ----------
    changes
        Changes of the frames by omitting each effect, by each number of anchors, layers and cells that was tried, and
        by one coarse cell a pixel, or one layer.
    spread
        Cost of direct light to random points of the sensor instead of its centre.
    apart
        Error of omitting each effect that is drawn with the sensor's noise.
    unresolved, left_out
        Parts of the direct light in lobes that sampling would miss, and of all light that no tracer finds.
    unresolved_specular
        Part of all light that comes over mirrors alone and whose place on the sensor is unknown.
    hits
        Rays that bring all direct light if each projector pixel sends one, if these are few; else infinite.
    """

    depth: float
    layers: Mapping[int, tuple[float, ...]]
    changes: ErrorCovariance
    sample_costs: Mapping[str, SampleCost]
    spread: SampleCost
    forming: Forming
    apart: Mapping[str, float] = field(default_factory=dict)
    unresolved: float = 0.0
    left_out: float = 0.0
    unresolved_specular: float = 0.0
    shared: bool = False
    repeats: tuple[int, ...] = ()
    reach: float | None = None
    sharp: SharpPixels | None = None
    occluded: tuple[int, ...] = ()
    raster: tuple[Drawn, Drawn] = (Drawn(), Drawn())
    hits: float = math.inf

    def forms(self, waves: bool) -> tuple[int, ...]:
        drawn = self.raster[waves]
        if drawn.error is None:
            return (drawn.cells[0] if drawn.needed else 0,)
        return drawn.cells if drawn.needed else (0, *drawn.cells)

    def error(self, *parts: Approximation) -> Estimate:
        apart = sum(self.apart.get(part.name, 0.0) ** 2 for part in parts)
        value, bound = self.changes.estimate(parts)
        return Estimate(math.hypot(value, math.sqrt(apart)), math.hypot(bound, math.sqrt(apart)))

    @cached_property
    def effects(self) -> dict[str, Estimate]:
        measured = [part.name for part in self.changes.parts if part.count == 0]
        return {name: self.error(Approximation(name)) for name in (*measured, *self.apart)}

    @cached_property
    def ladders(self) -> dict[str, dict[int, Estimate]]:
        found: dict[str, dict[int, Estimate]] = {name: {} for name in COUNTED}
        for part in sorted(part for part in self.changes.parts if part.name in COUNTED):
            found[part.name][part.count] = self.error(part)
        return {name: errors or {1: Estimate(0.0, 0.0)} for name, errors in found.items()}
