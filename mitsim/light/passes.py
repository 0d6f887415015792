"""Passes in which light is traced: for each its tracer, the grid of its light, and its cost.

Everything that enumerates light reads :data:`PASSES`. A new pass is a row here, and its tracer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Literal

import numpy as np

from mitsim.bench.effects import names
from mitsim.core.arrays import Labels
from mitsim.light.grids import Grids
from mitsim.light.settings import Number, Settings
from mitsim.transport.connect import OpticalSetup, SensorPoints
from mitsim.transport.direct import AimedTracer, DirectTracer
from mitsim.transport.from_camera import CombinedTracer, FromCameraTracer, LampResponse, LampTracer
from mitsim.transport.indirect import IndirectTracer
from mitsim.transport.integrator import Paths
from mitsim.transport.path_reuse import PathReuseTracer

# -------- What traces

FromCamera = FromCameraTracer | CombinedTracer
PassTracer = DirectTracer | IndirectTracer | FromCamera


class Tracers(Grids):
    """Tracers of a bench with settings.

    Attributes
    ----------
    divides
        Divide light that shading normals make heavy between both sides. Off for a short pilot, which would meet few
        paths of the camera's part.
    """

    divides = True

    @cached_property
    def setup(self) -> OpticalSetup:
        return replace(self.bench.setup, projector=self.physics.projector, geometry=self.physics.geometry)

    # ---- Direct light

    @cached_property
    def direct(self) -> DirectTracer:
        """Direct light to the sensor's centre, or to all of the sensor where anchors are used."""
        return self._direct(1, spread=self.settings.anchors > 1)

    @property
    def spread(self) -> DirectTracer:
        return self._direct(1, spread=True)

    @cached_property
    def anchored(self) -> DirectTracer | None:
        settings = self.settings
        return self._direct(settings.anchors, settings.with_own_anchors) if settings.anchors > 1 else None

    @cached_property
    def anchored_occluded(self) -> DirectTracer | None:
        """Direct light of occluded pixels to anchors of their own."""
        settings = self.settings
        others = np.setdiff1d(np.arange(self.bench.n**2), settings.with_own_anchors)
        return self._direct(settings.occluded_anchors, others) if settings.with_own_anchors else None

    @cached_property
    def sharp(self) -> AimedTracer | None:
        sharp = self.settings.sharp
        return AimedTracer(self.setup, sharp.anchors, np.array(sharp.pixels)) if sharp else None

    def _direct(self, anchors: int, without: Labels | tuple[int, ...] = (), spread: bool = False) -> DirectTracer:
        sharp = self.settings.sharp
        absent = np.union1d(without, sharp.pixels if sharp else ()).astype(np.int64)
        pixels = np.setdiff1d(np.arange(self.bench.n**2), absent) if len(absent) else None
        return DirectTracer(self.setup, anchors, spread, pixels)

    # ---- Light that is followed further

    @cached_property
    def indirect(self) -> IndirectTracer | None:
        """Light over several surfaces, to the points of :attr:`direct`."""
        tracer, repeats = self._indirect(self._mean_points, self.settings.shared), self.settings.repeats
        return tracer.with_adaptive_counts(repeats) if tracer and repeats else tracer

    @cached_property
    def from_camera(self) -> FromCamera | None:
        """All other light, from the same points."""
        return self._from_camera(self._mean_points)

    @cached_property
    def at_anchors(self) -> tuple[IndirectTracer | None, FromCamera | None]:
        """Both to every anchor of followed light."""
        points = self._points(self.settings.followed_anchors)
        return self._indirect(points), self._from_camera(points)

    # ---- Light that the projector's lens scatters

    @cached_property
    def glare(self) -> CombinedTracer | None:
        scattered = replace(self.setup, projector=self.setup.projector.scattered)
        if scattered.projector.share == 0:
            return None
        direct = DirectTracer(scattered, 1, self.settings.anchors > 1)
        indirect = self._indirect(self._mean_points, setup=scattered)
        return CombinedTracer(*filter(None, (direct, indirect)))

    @property
    def _mean_points(self) -> SensorPoints:
        return self._points(1, self.settings.followed_anchors > 1)

    @property
    def lamps_apart(self) -> bool:
        """True if lamps' paths carry no light of the projector."""
        return not self._from_camera_of_projector

    @property
    def _from_camera_of_projector(self) -> bool:
        return self.physics.mirrors or (self.physics.interreflection and self.bench.loaded.glossy) or self._steep

    @property
    def _steep(self) -> bool:
        loaded = self.bench.loaded
        return self.physics.interreflection and ((self.divides and loaded.smoothed) or loaded.hairy)

    def _points(self, anchors: int, spread: bool = False) -> SensorPoints:
        return SensorPoints(self.physics.geometry.half_width, anchors, spread, self.settings.depth)

    def _indirect(
        self, points: SensorPoints, shared: bool = False, setup: OpticalSetup | None = None
    ) -> IndirectTracer | None:
        # Light that the lens scatters is followed from the projector alone.
        paths = Paths(self.physics.mirrors, self.physics.interreflection, steep=self._steep and setup is None)
        if not (paths.mirrors or paths.interreflection):
            return None
        return (PathReuseTracer if shared else IndirectTracer)(setup or self.setup, paths, points)

    def _from_camera(self, points: SensorPoints) -> FromCamera | None:
        physics, counted_lamps = self.physics, self.bench.counted_lamps
        of_projector = self._from_camera_of_projector
        if not (physics.lamps or of_projector):
            return None
        paths = Paths(physics.mirrors, physics.interreflection, physics.lamps, self._steep)
        tracer = FromCameraTracer(self.setup, self.aim, paths, points)
        if counted_lamps is None or not physics.lamps:
            return tracer
        # Lamps have wavelengths of their own, and filters of each colour count them on their own.
        units = counted_lamps.units_of(self.bench.projector.lines)
        lamps: list[FromCameraTracer] = []
        for number, response in enumerate(counted_lamps.responses):
            rows = counted_lamps.rows(number)
            own = [unit * response.part for unit in units]
            lamps.append(LampTracer(tracer, LampResponse(response, counted_lamps.bands[rows], own, rows.start)))
        if of_projector:
            lamps.insert(0, FromCameraTracer(self.setup, self.aim, replace(paths, emitters=()), points))
        return lamps[0] if len(lamps) == 1 else CombinedTracer(*lamps)


# -------- The table

FOLLOWED = names(lambda effect: effect.followed)
"""Effects whose light is followed over several surfaces or from the camera."""


@dataclass(frozen=True)
class Pass:
    """Row of the table of passes.

    Attributes
    ----------
    stream
        Name of the random stream, which never changes, so that the same seed gives the same frames.
    unit_cost
        Time of a path, or of a connection to one anchor [s].
    grid, indirect_grid
        Grid of its light, and of its light over several surfaces if another.
    anchors
        Setting that counts its anchors. The pass then accumulates the residual over their mean.
    effects
        Effects of which one requires the pass; empty if always traced.
    even
        True if samples are points of a Sobol sequence alone, so that their number matters.
    variance_rate
        Power of the samples with which the variance falls.
    flux
        True if the pass measures the flux of each projector pixel.
    device
        Add light on the device: ``room`` if the sums fit, ``pays`` if it also saves time; None for the host.
    pilot
        Run of the pilot that measures its noise.
    key
        Key of its samples in plans, if not its name.
    """

    name: str
    stream: str
    tracer: Callable[[Tracers], PassTracer | None]
    unit_cost: float
    grid: str
    indirect_grid: str = ""
    anchors: str = ""
    effects: frozenset[str] = frozenset()
    even: bool = False
    variance_rate: float = 1.0
    flux: bool = False
    device: Literal["", "room", "pays"] = ""
    pilot: str = "effects"
    key: str = ""

    @property
    def samples_key(self) -> str:
        return f"{self.key or self.name}_samples"

    @property
    def grids(self) -> tuple[str, ...]:
        """All grids of its light; the last is the one on the device."""
        return tuple(filter(None, (self.grid, self.indirect_grid)))

    def called_for(self, effects: frozenset[str]) -> bool:
        return not self.effects or bool(self.effects & effects)

    def predicted_samples(self, settings: Settings) -> float:
        return settings.samples.get(self.name, 1.0)

    def whole(self, samples: Number) -> Number:
        least = np.maximum(samples, 1.0)
        return even(least) if self.even else np.ceil(least)

    def connections(self, counts: object) -> Number:
        """Return the connections of each path; 0 for a residual over one anchor."""
        if not self.anchors:
            return 1.0
        count = np.asarray(getattr(counts, self.anchors), dtype=np.float64)
        return np.asarray(count**2 * (count > 1))


def even(samples: Number) -> Number:
    """Return the next 2^k or 3 * 2^k, because so many points of a Sobol sequence are evenly spread."""
    power = np.exp2(np.floor(np.log2(np.maximum(samples, 1.0))))
    found = np.where(samples <= power, power, np.where((samples <= 1.5 * power) & (power > 1), 1.5 * power, 2 * power))
    return found if isinstance(samples, np.ndarray) else float(found)


_ROWS = (
    Pass("direct", "direct", lambda made: made.direct, 1.8e-7, "fine",
         even=True, variance_rate=1.5, flux=True, pilot="cells"),
    Pass("anchor_residual", "anchored", lambda made: made.anchored, 1.6e-7, "anchor_residual",
         even=True, anchors="anchors", device="pays", pilot="anchors", key="anchored"),
    Pass("penumbra", "occluded", lambda made: made.anchored_occluded, 5e-7, "penumbra",
         even=True, anchors="occluded_anchors", pilot="occluded", key="occluded"),
    Pass("sharp", "sharp", lambda made: made.sharp, 3e-7, "sharp",
         even=True, flux=True, device="pays"),
    Pass("indirect", "indirect", lambda made: made.indirect, 1.2e-7, "fine", "indirect",
         effects=FOLLOWED, device="room"),
    Pass("from_camera", "other", lambda made: made.from_camera, 2e-7, "fine", "indirect",
         effects=FOLLOWED),
    Pass("indirect_residual", "indirect at anchors", lambda made: made.at_anchors[0], 1.3e-7, "indirect_residual",
         effects=FOLLOWED, anchors="followed_anchors", device="room", pilot="followed", key="followed"),
    Pass("camera_residual", "from camera at anchors", lambda made: made.at_anchors[1], 1.3e-7, "indirect_residual",
         effects=FOLLOWED, anchors="followed_anchors", pilot="followed", key="followed_from_camera"),
    Pass("glare", "glare", lambda made: made.glare, 3e-7, "fine", "indirect",
         effects=frozenset({"glare"})),
)  # fmt: skip
"""Frames are added in this order. Unit costs are near the times of eight shipped scenes on two cores; only their ratios
matter."""


def table_of(*rows: Pass) -> Mapping[str, Pass]:
    for what in ("name", "stream"):
        values = [getattr(row, what) for row in rows]
        twice = next((value for value in values if values.count(value) > 1), None)
        if twice is not None:
            raise ValueError(f"two passes have the {what} {twice!r}")
    return MappingProxyType({row.name: row for row in rows})


PASSES = table_of(*_ROWS)
EVEN = frozenset(row.name for row in PASSES.values() if row.even)
