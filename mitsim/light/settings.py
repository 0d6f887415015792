"""What is simulated, and how finely: what pilot, plan and passes have in common."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from mitsim.core.arrays import FloatArray

Number = float | FloatArray
GROUPS = 4
"""Independent estimates of the light, whose spread is the Monte Carlo error: of light of many paths, whose noise is of
many kinds, four tell it as well as more (docs/physics.md), and each takes its own accumulating, forming and probing."""
PATHS_AT_ONCE = 2**21
"""Paths whose light is held in memory at a time."""
MOST_PATHS = 2**32
"""Limit of one light's paths: half an hour on two cores, at which sampling stops and says so."""


class Estimate(NamedTuple):
    """A relative error: the best ``value`` for it, and the ``bound`` that it stays below at 95 %."""

    value: float
    bound: float


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

    pixels: tuple[int, ...]
    anchors: int
    window: tuple[float, float, float, float]
    left: float = 0.0


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
    followed_width
        projector pixels a side of a cell for what they see beyond their mean, in one layer; 1: as ``coarse_cells`` and
        ``coarse_layers`` say.
    coarse_cells, coarse_layers
        cells a side of a projector pixel for what anchors see beyond their mean and for indirect light, and whether
        they have all layers or one.
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

    depth: float
    anchors: int = 1
    layers: tuple[float, ...] = ()
    subdivision: int = 1
    effects: frozenset[str] = frozenset()
    samples: Mapping[str, float] = field(default_factory=dict, hash=False)
    followed_anchors: int = 1
    followed_width: int = 1
    coarse_cells: int = 1
    coarse_layers: bool = False
    shared: bool = False
    repeats: tuple[int, ...] = ()
    reach: float | None = None
    sharp: SharpPixels | None = None
    occluded: tuple[int, ...] = ()
    occluded_anchors: int = 1
    raster: bool = False
    raster_cells: int = 0

    @property
    def depths(self) -> tuple[float, ...]:
        """Depth of each layer [mm]; the one depth of a flat scene."""
        return self.layers or (self.depth,)

    @property
    def with_own_anchors(self) -> tuple[int, ...]:
        """Occluded pixels, where they have anchors of their own."""
        return self.occluded if self.occluded_anchors > 1 else ()
