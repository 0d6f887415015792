"""What is simulated, and how finely; and what the pilot measured, by which that is chosen."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import NonNegative, Positive
from mitsim.core.parallel import in_threads

Number = float | FloatArray
Count = Annotated[int, Field(ge=1, le=4096)]
"""Of a plan's file: anchors, cells or pixels a side; the largest projector has as many pixels."""
Index = Annotated[int, Field(ge=0, lt=4096**2)]
"""The same of its pixels."""
GROUPS = 4
"""Independent estimates of the light, whose spread is the Monte Carlo error: of light of many paths, whose noise is of
many kinds, four tell it as well as more (docs/physics.md), and each takes its own accumulating, forming and probing."""
PATHS_AT_ONCE = 2**21
"""Paths whose light is held in memory at a time."""
FOLLOWED_WIDTH = 4
"""Projector pixels a side of a cell for what several anchors see of followed light beyond its mean: little light, of
many anchors. Where coarse light has finer cells, so has this."""
CELLS_OF_COARSE = 4
"""Fine cells a side of a cell of coarse light, where it has all layers: at accuracies of 1e-3 and above it then lies in
one cell a projector pixel, at 3e-4 in two a side."""
MOST_PATHS = 2**32
"""Limit of one light's paths: half an hour on two cores, at which sampling stops and says so."""


class Estimate(NamedTuple):
    """A relative error: the best ``value`` for it, and the ``bound`` that it stays below at 95 %."""

    value: float
    bound: float


# -------- What is simulated, and how finely


@dataclass(frozen=True)
class SharpPixels:
    """Projector pixels whose direct light comes over lobes too sharp for the anchors of all others.

    Attributes
    ----------
    pixels
        their numbers, increasing.
    anchors
        points a side of the sensor that their light is connected to.
    window
        first and last tan-angle of their light along rows, then along columns.
    left
        error that interpolation between these points leaves, relative to all light.
    """

    pixels: tuple[Index, ...]
    anchors: Count
    window: tuple[float, float, float, float]
    left: NonNegative = 0.0


@dataclass(frozen=True)
class Settings:
    """What is simulated, and how finely.

    Attributes
    ----------
    depth
        where the light is seen, 1 / mean(1/z) [mm]; the cells are aligned with the projector's pixels there.
    anchors
        points a side of the sensor from which radiance is evaluated.
    layers
        depths [mm], far to near, between which light is split; one for a flat scene.
    subdivision
        cells a side of a projector pixel.
    effects
        names of those that are simulated (:mod:`mitsim.bench.effects`).
    samples
        that each group is predicted to need, by the name of the pass (:mod:`mitsim.light.passes`): of a projector
        pixel, or of a cell of what is followed from the camera. Below 1, one is traced; so it is where nothing is said.
    followed_anchors
        points a side of the sensor that light over several surfaces, or in mirrors, is followed to.
    coarse_layers
        whether coarse light has all layers and finer cells: indirect light, and what anchors see of direct light beyond
        its mean.
    shared
        whether neighbouring pixels share the second points of indirect light (:mod:`mitsim.transport.path_reuse`).
    repeats
        (blocks^2,) paths that each block of pixels takes in a sample of indirect light
        (:mod:`mitsim.transport.indirect`); none: one of each pixel.
    reach
        largest tan-angle, seen from the sensor's centre, at which light of near surfaces is received; None: no more
        than of light at ``depth``.
    sharp
        pixels whose direct light is traced apart.
    occluded, occluded_anchors
        projector pixels whose light is hidden from part of the sensor, increasing, and points a side from which what
        the sensor sees of them beyond the mean is evaluated. With one point they are pixels like the others.
    raster
        whether frames are correlations with a mask's shadow on a raster, by FFT, and not sums of separable terms.
    raster_cells
        cells of that raster along a pixel; 0: as few as a raster has.
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
        """Depth of each layer [mm]; the one depth of a flat scene."""
        return self.layers or (self.depth,)

    @property
    def coarse_cells(self) -> int:
        """Cells a side of a projector pixel for coarse light."""
        return max(self.subdivision // CELLS_OF_COARSE, 1) if self.coarse_layers else 1

    @property
    def followed_width(self) -> int:
        """Projector pixels a side of a cell for what anchors of followed light see beyond its mean, in one layer."""
        return max(FOLLOWED_WIDTH // self.coarse_cells, 1) if self.followed_anchors > 1 else 1

    @property
    def with_own_anchors(self) -> tuple[int, ...]:
        """Occluded pixels, where they have anchors of their own."""
        return self.occluded if self.occluded_anchors > 1 else ()


# -------- What the pilot measured, by which a plan is made

COUNTED = ("anchors", "layers", "cells", "followed_anchors", "occluded_anchors")
"""Numbers that a plan chooses: points of the sensor a side for direct light, depths, cells a side of a projector pixel,
points a side for light that is followed over several surfaces or from the camera, and for occluded pixels."""
_FEWEST_SAMPLES = 1e-3
"""Samples of light without noise: next to none, and above 0 because costs are ratios."""
_AT_ONCE = 2**13
"""Entries of frames that are multiplied at a time: some megabytes, where all of them are a hundred."""
REPLICATES = 4
"""Independent replicates of the pilot, the fewest whose spread tells a standard error worth its name."""
SURE = 2.35
"""Standard errors from an estimate to its 95 % bound: Student's distribution with ``REPLICATES`` - 1 degrees of
freedom."""
RASTER_RATE = 1.5
"""Power of a raster's cells along a pixel that its error falls with: from 6 to 12 cells, in frames of dots, 1.4 (a
picture of light) to 2.9 (a mask turned by 0.3 degrees)."""


@dataclass(frozen=True)
class Noise:
    """Monte Carlo error of one estimate: ``error`` at ``samples`` a cell, falling with samples^-rate; ``spread`` is the
    relative variance of its square among estimates, 0 where many paths make it; ``heavy`` the number of equal paths
    that would make it as unevenly, infinite where nobody counted them."""

    error: float
    samples: float
    rate: float
    spread: float = 0.0
    heavy: float = math.inf

    @classmethod
    def among(cls, seen: FloatArray, light: float, samples: int, paths: FloatArray) -> Noise:
        """Of one of several replicates, by random paths of which few may be heavy.

        Parameters
        ----------
        seen
            (replicates, ...) frames.
        light
            norm of the frames of all light, which the error is relative to.
        samples
            of a replicate.
        paths
            light that each path of all replicates brought.
        """
        energies = np.square(seen - seen.mean(axis=0)).reshape(len(seen), -1).sum(axis=1)
        mean = float(energies.mean())
        spread = float(energies.var(ddof=1)) / mean**2 if mean else 0.0
        squares = np.square(paths)
        heavy = float(squares.sum()) ** 2 / float(np.square(squares).sum() or 1.0)
        return cls(math.sqrt(float(energies.sum()) / (len(seen) - 1)) / light, samples, 0.5, spread, heavy)

    def samples_for(self, target: Number) -> Number:
        """Samples a cell at which the error is ``target``."""
        if self.error <= 0:
            return _FEWEST_SAMPLES + 0 * target
        return self.samples * (self.error / target) ** (1 / self.rate)

    def error_left(self, samples: Number) -> Number:
        """The error at so many ``samples`` a cell."""
        return self.error * (samples / self.samples) ** -self.rate


@dataclass(frozen=True)
class SampleCost:
    """What one kind of light takes: its noise relative to all light, paths in a sample, and seconds to trace and
    accumulate a path, 0 where nobody has timed it."""

    noise: Noise
    paths: int
    seconds: float = 0.0

    @classmethod
    def none(cls) -> SampleCost:
        """Of light that there is none of."""
        return cls(Noise(0.0, 1, 0.5), 0)

    @classmethod
    def relative(cls, error: float, light: float, samples: int, paths: int, rate: float = 0.5) -> SampleCost:
        """Of replicates of so many ``samples`` that are off by an ``error``, where frames of all light have the norm
        ``light``.

        Parameters
        ----------
        error, light, samples
            as above; nothing is known to be noisy where there is no light.
        paths, rate
            of a sample, and the power of the samples that the error falls with.
        """
        return cls(Noise(error / light if light else 0.0, samples, rate), paths)

    @property
    def variance(self) -> float:
        """Relative variance of one sample, where the error falls with the square root of their number."""
        return self.noise.samples * self.noise.error**2


@dataclass(frozen=True, order=True)
class Approximation:
    """What a plan may leave out (an effect; ``count`` 0), or a number that it may choose (anchors, layers, cells)."""

    name: str
    count: int = 0


WIDE = Approximation("followed_width", FOLLOWED_WIDTH)
"""Cells of several projector pixels, in one layer, for what anchors see of followed light."""


@dataclass(frozen=True, eq=False)
class ErrorCovariance:
    """What each part changes in the frames, as inner products between independent replicates: the sum of any of them,
    with its signs, without the replicates' noise.

    Attributes
    ----------
    parts
        what was changed.
    products
        (replicates, replicates, parts, parts) inner products of the changes, relative to the squared norm of all light;
        those of a replicate with itself hold its noise, and are not used.
    """

    parts: tuple[Approximation, ...]
    products: FloatArray

    @classmethod
    def between(cls, seen: Mapping[Approximation, FloatArray], energy: float) -> ErrorCovariance:
        """Of changes (replicates, ...) that were ``seen`` of frames whose squared norm is ``energy``."""
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
        """(m,) squared changes by m sums of parts and their standard errors, from ``chosen`` (m, parts) weights.

        The mean product of two different replicates, and its jackknife over replicates.
        """
        replicates, places = len(self.products), np.arange(len(self.products))
        others = [self.products[place, places != place].sum(axis=0) for place in places]
        of_look = np.array([np.einsum("mp,mp->m", chosen @ products, chosen) for products in others])
        # Each pair is one of either replicate's.
        total, kept = of_look.sum(axis=0) / 2, replicates * (replicates - 1) / 2
        without = (total - of_look) / (kept - replicates + 1)
        spread = np.sqrt((replicates - 1) * np.square(without - without.mean(axis=0)).mean(axis=0))
        return total / kept, spread

    def estimate(self, parts: Collection[Approximation]) -> Estimate:
        """Relative change of the frames by all ``parts`` together; parts that were not measured change nothing."""
        chosen = np.array([[part in parts for part in self.parts]], dtype=np.float64)
        squared, spread = (float(values[0]) for values in self.squared_errors(chosen))
        least = max(squared, 0.0)
        return Estimate(math.sqrt(least), math.sqrt(least + SURE * spread))


@dataclass(frozen=True)
class Forming:
    """What forming frames depends on besides settings.

    Attributes
    ----------
    pixels, cells
        a side of the sensor, and of the grid with one cell a projector pixel.
    lit
        part of the rows of cells that hold light in a frame.
    terms, geometric_terms
        of the wave-optical shadow, and of the geometric one.
    shots, classes
        of the family.
    product
        seconds of a multiplication in a large product of matrices, on all processors; 0 where nobody has timed it.
    correlated
        whether frames without diffraction, and with it, are always correlations with a shadow on a raster, and never
        sums of separable terms.
    phases
        raster cells that a pixel has at least, where a shadow is drawn on one.
    largest_terms
        terms that hold a shadow that must be drawn on a raster, without diffraction and with it; infinite where they
        are too many, and where it need not.
    drawing
        seconds of drawing a shadow on as few, without diffraction and with it, for each layer.
    lines
        each with frames of its own.
    parted
        whether glass sends each line its own way, so that they share no paths.
    occluded
        parts of the projector's rows and of its columns that occluded pixels lie in.
    """

    pixels: float
    cells: int
    lit: float
    terms: float
    shots: int
    classes: int
    product: float = 0.0
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
    """A mask's shadow on a raster: what that leaves of the frames, None where it is none to choose, whether there is no
    other way, and numbers of raster cells along a pixel, of which the first leaves that."""

    error: Estimate | None = None
    needed: bool = False
    cells: tuple[int, ...] = (4,)

    def error_left(self, cells: int) -> Estimate | None:
        """What a raster of so many ``cells`` a pixel leaves; 0: the fewest."""
        finer = (cells or self.cells[0]) / self.cells[0]
        return self.error and Estimate(*(error * finer**-RASTER_RATE for error in self.error))


@dataclass(frozen=True)
class PilotResult:
    """What a short replicate at the scene measured (:mod:`mitsim.planner.pilot`); all errors are relative.

    Attributes
    ----------
    depth, layers
        depth of the light [mm]; candidates for the layers' depths, by their number.
    changes
        of the frames by each effect that the bench has when it is left out, by each number of anchors, layers and
        cells that was tried, and by one coarse cell a pixel, or one layer, for light that lies in coarse cells.
    sample_costs
        what each pass takes, by its name (:mod:`mitsim.light.passes`); of light at anchors: paths to one of them.
    spread
        what direct light takes that goes to random points of the sensor, and not to its centre.
    forming
        how frames are formed.
    apart
        effects that are no part of the expected frames, with the independent error of leaving each out.
    unresolved
        part of the direct light in lobes that sampling would miss (:mod:`mitsim.transport.missed`).
    shared, repeats
        as in :class:`mitsim.light.settings.Settings`, where that takes less for as little noise: what indirect light
        takes is then of that.
    left_out
        light that no tracer finds, over that and what is found (:mod:`mitsim.transport.missed`).
    unresolved_specular
        light over mirrors alone whose place on the sensor is not known, over all light.
    mirror
        place, among the scene's shapes, of what most of that comes over.
    reach, sharp, occluded
        as in :class:`mitsim.light.settings.Settings`.
    raster
        what a shadow on a raster leaves of the frames, without diffraction and with it (:class:`Drawn`).
    hits
        rays that bring all direct light if each projector pixel sends one, where these are few; else infinite.
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
    mirror: int | None = None
    shared: bool = False
    repeats: tuple[int, ...] = ()
    reach: float | None = None
    sharp: SharpPixels | None = None
    occluded: tuple[int, ...] = ()
    raster: tuple[Drawn, Drawn] = (Drawn(), Drawn())
    hits: float = math.inf

    def with_sample_costs(self, found: Mapping[str, SampleCost]) -> PilotResult:
        """The same, where some passes take what was ``found``."""
        return replace(self, sample_costs={**self.sample_costs, **found})

    def forms(self, waves: bool) -> tuple[int, ...]:
        """Raster cells along a pixel that frames may be formed of, 0 for a sum of terms; with ``waves`` or not."""
        drawn = self.raster[waves]
        if drawn.error is None:
            return (drawn.cells[0] if drawn.needed else 0,)
        return drawn.cells if drawn.needed else (0, *drawn.cells)

    def error(self, *parts: Approximation) -> Estimate:
        """Relative change of the frames by all ``parts`` together."""
        apart = sum(self.apart.get(part.name, 0.0) ** 2 for part in parts)
        value, bound = self.changes.estimate(parts)
        return Estimate(math.hypot(value, math.sqrt(apart)), math.hypot(bound, math.sqrt(apart)))

    @cached_property
    def effects(self) -> dict[str, Estimate]:
        """Error of leaving out each effect that the bench has."""
        measured = [part.name for part in self.changes.parts if part.count == 0]
        return {name: self.error(Approximation(name)) for name in (*measured, *self.apart)}

    @cached_property
    def ladders(self) -> dict[str, dict[int, Estimate]]:
        """Error of each number of anchors, layers and cells that was tried, fewest first."""
        found: dict[str, dict[int, Estimate]] = {name: {} for name in COUNTED}
        for part in sorted(part for part in self.changes.parts if part.name in COUNTED):
            found[part.name][part.count] = self.error(part)
        return {name: errors or {1: Estimate(0.0, 0.0)} for name, errors in found.items()}
