"""One bench under one choice of settings in; its tracers, and the frames of light that was filed, out.

An effect that is off takes its neutral value here and nowhere else: a pinhole for the lens, a thin mask, a geometric
shadow. :mod:`mitsim.capture.pilot` switches effects on and off to see what they are worth; :mod:`mitsim.capture.light`
samples the choice that the plan made.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from mitsim.capture.effects import Physics
from mitsim.capture.evidence import LANES_AT_ONCE, whole
from mitsim.capture.filing import FiledLight, Trays
from mitsim.core.arrays import FloatArray, Labels
from mitsim.optics.frames import ClassFrames, ExpectedFrames
from mitsim.rig.patterns import Lighting
from mitsim.transport.aimed import AimedTracer
from mitsim.transport.direct import DirectTracer
from mitsim.transport.from_camera import FromCameraTracer, Paths
from mitsim.transport.histogram import Bundle, Deposits
from mitsim.transport.indirect import IndirectTracer
from mitsim.transport.lamps import Counted, LampTracer, Together
from mitsim.transport.ledger import Ledger, LitSums
from mitsim.transport.neighbours import NeighbourTracer
from mitsim.transport.receiver import SensorPoints

FromCamera = FromCameraTracer | Together
"""What follows light from the camera's side."""
AT_ANCHORS = ("indirect at anchors", "from camera at anchors")
"""Names of the stages that follow light to every anchor."""
_FEWEST_AT_ONCE = 2**18
"""Paths that are held in memory at a time at least, 130 MB: so many take far longer than launching them."""


@dataclass(frozen=True)
class Stage:
    """A tracer, the samples of it that the plan predicted, how its light is filed, and its random stream's name.

    ``file`` takes deposits, labels and the number of samples. ``ledgers`` makes, from labels and a number of lines,
    what light of each line is filed in on the device, where that has room and pays, and ``file_ledger`` takes one, its
    sums on the host, labels and the number of samples; none for other light.
    """

    tracer: DirectTracer | IndirectTracer | FromCamera
    predicted: float
    file: Callable[[Deposits, Labels, int], FiledLight]
    stream: str
    ledgers: Callable[[Labels, int], tuple[Ledger, ...]] = lambda labels, lines: ()
    file_ledger: Callable[[Ledger, LitSums, Labels, int], FiledLight] | None = None

    def trace(self, seed: int, first: int, samples: int, ledgers: Sequence[Ledger] = ()) -> Deposits:
        """Light of some samples, but for what is filed in the ``ledgers``.

        Parameters
        ----------
        seed, first, samples
            as for :meth:`mitsim.transport.paths.Tracer.trace`.
        ledgers
            of :attr:`ledgers`.
        """
        if not ledgers or not isinstance(self.tracer, DirectTracer | IndirectTracer):
            return self.tracer.trace(seed, first, samples)
        return self.tracer.trace_into(ledgers, seed, first, samples)


class Simulation(Trays):
    """A bench with settings: what is traced, and frames of what was filed; tracers are prepared when they are first
    asked for. Its parameters are those of :class:`mitsim.capture.filing.Trays`.
    """

    @cached_property
    def direct(self) -> DirectTracer:
        """Follows direct light from the projector to the sensor's centre, or to all of it where anchors are used."""
        return self._direct(1, spread=self.settings.anchors > 1)

    @property
    def spread(self) -> DirectTracer:
        """Follows direct light to random points of the sensor."""
        return self._direct(1, spread=True)

    @cached_property
    def anchored(self) -> DirectTracer | None:
        """The same to every anchor, but for occluded pixels."""
        settings = self.settings
        return self._direct(settings.anchors, settings.with_own_anchors) if settings.anchors > 1 else None

    @cached_property
    def anchored_occluded(self) -> DirectTracer | None:
        """Follows direct light of occluded pixels to anchors of their own; none where there are none."""
        settings = self.settings
        others = np.setdiff1d(np.arange(self.bench.n**2), settings.with_own_anchors)
        return self._direct(settings.occluded_anchors, others) if settings.with_own_anchors else None

    @cached_property
    def apart(self) -> AimedTracer | None:
        """Follows direct light of the sharp pixels to their anchors; none where there are none."""
        loaded, physics, sharp = self.bench.loaded, self.physics, self.settings.sharp
        if sharp is None:
            return None
        parts = loaded.scene, loaded.camera, physics.projector, sharp.anchors, physics.geometry
        return AimedTracer(*parts, np.array(sharp.pixels))

    def _direct(self, anchors: int, without: Labels | tuple[int, ...] = (), spread: bool = False) -> DirectTracer:
        """Of all pixels that are not traced apart, ``without`` some."""
        loaded, physics, sharp = self.bench.loaded, self.physics, self.settings.sharp
        absent = np.union1d(without, sharp.pixels if sharp else ()).astype(np.int64)
        pixels = np.setdiff1d(np.arange(self.bench.n**2), absent) if len(absent) else None
        return DirectTracer(loaded.scene, loaded.camera, physics.projector, anchors, physics.geometry, spread, pixels)

    @cached_property
    def indirect(self) -> IndirectTracer | None:
        """Follows light over several surfaces from the projector to the sensor's centre, or to all of it where it has
        anchors; none where there is none."""
        tracer, repeats = self._indirect(self._mean_points, self.settings.shared), self.settings.repeats
        return tracer.repeating(repeats) if tracer and repeats else tracer

    @cached_property
    def from_camera(self) -> FromCamera | None:
        """Follows all other light, from the same points; none where there is none."""
        return self._from_camera(self._mean_points)

    @property
    def at_anchors(self) -> tuple[IndirectTracer | None, FromCamera | None]:
        """Both, to every anchor of followed light."""
        points = self._points(self.settings.followed_anchors)
        return self._indirect(points), self._from_camera(points)

    @property
    def _mean_points(self) -> SensorPoints:
        return self._points(1, self.settings.followed_anchors > 1)

    @property
    def lamps_apart(self) -> bool:
        """Whether lamps' paths are followed for no light of the projector."""
        return not self._from_camera_of_projector

    @property
    def _from_camera_of_projector(self) -> bool:
        return self.physics.mirrors or (self.physics.interreflection and self.bench.loaded.glossy)

    def _points(self, anchors: int, spread: bool = False) -> SensorPoints:
        return SensorPoints(self.physics.geometry.half_width, anchors, spread, self.settings.depth)

    def _indirect(self, points: SensorPoints, shared: bool = False) -> IndirectTracer | None:
        loaded, physics = self.bench.loaded, self.physics
        paths = physics.mirrors, physics.interreflection
        if not any(paths):
            return None
        parts = loaded.scene, loaded.camera, physics.projector, *paths, physics.geometry, points
        return NeighbourTracer(*parts) if shared else IndirectTracer(*parts)

    def _from_camera(self, points: SensorPoints) -> FromCamera | None:
        loaded, physics, lamplight = self.bench.loaded, self.physics, self.bench.lamplight
        of_projector = self._from_camera_of_projector
        if not (physics.lamps or of_projector):
            return None
        paths = Paths(physics.mirrors, physics.interreflection, physics.lamps)
        parts = loaded.scene, loaded.camera, physics.projector
        tracer = FromCameraTracer(*parts, self.aim, paths, physics.geometry, points)
        if lamplight is None or not physics.lamps:
            return tracer
        # Lamps have wavelengths of their own, and filters of each colour count them on their own.
        units = lamplight.units_of(self.bench.projector.lines)
        lamps: list[FromCameraTracer] = []
        for number, response in enumerate(lamplight.responses):
            rows = lamplight.rows(number)
            own = [unit * response.part for unit in units]
            lamps.append(LampTracer(tracer, Counted(response, lamplight.bands[rows], own, rows.start)))
        if of_projector:
            lamps.insert(0, FromCameraTracer(*parts, self.aim, replace(paths, emitters=()), physics.geometry, points))
        return lamps[0] if len(lamps) == 1 else Together(*lamps)

    def follow(self, seed: int, samples: int) -> Deposits:
        """Light of :attr:`indirect` and :attr:`from_camera` in ``samples`` of each from ``seed``, to be filed."""
        tracers = [tracer for tracer in (self.indirect, self.from_camera) if tracer is not None]
        return Deposits.joined([tracer.trace(seed, 0, samples) for tracer in tracers])

    def smooth_ledgers(self, labels: Labels, lines: int) -> tuple[Ledger, ...]:
        """What indirect light of each of ``lines`` is filed in by class in ``labels`` (n^2,), where it has room."""
        return self._ledgers(self.indirect, self.smooth.bundle, labels, lines)

    def anchors_ledgers(self, labels: Labels, lines: int) -> tuple[Ledger, ...]:
        """The same of indirect light at anchors, as :meth:`smooth_ledgers` takes ``labels`` and ``lines``."""
        return self._ledgers(self.indirect, self.followed.bundle, labels, lines)

    def coarse_ledgers(self, labels: Labels, lines: int) -> tuple[Ledger, ...]:
        """The same of direct light at anchors, where its paths are many for its cells.

        Parameters
        ----------
        labels, lines
            as for :meth:`smooth_ledgers`.
        """
        return self._ledgers(self.anchored, self.coarse.bundle, labels, lines, self.settings.anchored_samples)

    def sharp_ledgers(self, labels: Labels, lines: int) -> tuple[Ledger, ...]:
        """The same of :attr:`apart`, whose pixels have a row each.

        Parameters
        ----------
        labels, lines
            as for :meth:`smooth_ledgers`; rows do not hang on classes.
        """
        del labels
        sharp, rows = self.settings.sharp, np.zeros(self.bench.n**2, dtype=np.int64)
        if sharp is not None:
            rows[list(sharp.pixels)] = np.arange(len(sharp.pixels))
        return self._ledgers(self.apart, self.sharp.bundle, rows, lines, self.settings.sharp_samples)

    @staticmethod
    def _ledgers(
        tracer: DirectTracer | IndirectTracer | None,
        bundle: Bundle,
        labels: Labels,
        lines: int,
        samples: float = math.inf,
    ) -> tuple[Ledger, ...]:
        """Ledgers of what a ``tracer`` finds in so many samples; none where it has none, or no room."""
        if tracer is None or not Ledger.holds(bundle, labels, lines, samples * tracer.lanes):
            return ()
        return Ledger.of_lines(lines, bundle, labels, tracer.board)

    def tracers(self) -> dict[str, Stage]:
        """What is traced: samples a group is predicted to need, and how the light is filed, by name."""
        settings = self.settings
        stages = {"direct": Stage(self.direct, settings.direct_samples, self.file_direct, "direct")}
        if self.anchored is not None:
            own = self.coarse_ledgers, partial(self.file_beyond, "coarse")
            stages["anchored"] = Stage(self.anchored, settings.anchored_samples, self.file_anchored, "anchored", *own)
        if self.anchored_occluded is not None:
            stages["occluded"] = Stage(
                self.anchored_occluded, settings.occluded_samples, self.file_occluded, "occluded"
            )
        if self.apart is not None:
            device = self.sharp_ledgers, self.file_sharp_sums
            stages["sharp"] = Stage(self.apart, settings.sharp_samples, self.file_sharp, "sharp", *device)
        if self.indirect is not None:
            samples, device = settings.indirect_samples, (self.smooth_ledgers, self.file_smooth)
            stages["indirect"] = Stage(self.indirect, samples, self.file_followed, "indirect", *device)
        if self.from_camera is not None:
            # The stream keeps the name that it had in 0.3.0, so that the same seed gives the same frames.
            samples = settings.from_camera_samples
            stages["from_camera"] = Stage(self.from_camera, samples, self.file_followed, "other")
        if settings.followed_anchors > 1:
            file, names = self.file_at_anchors, AT_ANCHORS
            indirect, from_camera = self.at_anchors
            if indirect is not None:
                own = self.anchors_ledgers, partial(self.file_beyond, "followed")
                stages[names[0]] = Stage(indirect, settings.followed_samples, file, names[0], *own)
            if from_camera is not None:
                stages[names[1]] = Stage(from_camera, settings.followed_from_camera_samples, file, names[1])
        return stages

    @cached_property
    def paths_at_once(self) -> int:
        """Paths whose light is held in memory at a time: as many as a stage is predicted to need, within limits; rounds
        that turn out to need more take no more memory."""
        stages = self.tracers().items()
        most = max(int(whole(name, stage.predicted)) * stage.tracer.lanes for name, stage in stages)
        lanes = max(stage.tracer.lanes for _, stage in stages)
        return max(min(max(most, _FEWEST_AT_ONCE), LANES_AT_ONCE), lanes)

    def glint_frames(self, labels: Labels) -> ClassFrames | None:
        """Frames of the projector's glint by class in ``labels`` (n^2,); None without such light.

        It is a pinhole's light, whatever the projector's lens.
        """
        if not self.physics.mirrors:
            return None
        found = self.bench.glint.frames(labels, self.physics.geometry, self.physics.spectrum)
        if found is None or self.places is None:
            return found
        return replace(found, irradiance=found.irradiance[:, self.places[0]][:, :, self.places[1]])

    def expected(
        self,
        groups: Sequence[FiledLight],
        rows: Labels,
        lighting: Lighting,
        seed: int,
        leaking: bool = True,
        probed: FloatArray | None = None,
    ) -> ExpectedFrames:
        """Expected frames of all shots of a lighting.

        Parameters
        ----------
        groups
            independent estimates of the light.
        rows
            (groups' rows,) class of ``lighting`` that each row of the estimates belongs to.
        lighting
            the shots.
        seed
            of the probes that tell the Monte Carlo error.
        leaking
            whether black pixels leak, so that every shot lights all of them; without, shots of few pixels form faster.
        probed
            what the frames of other shots say of the same classes, as :class:`ExpectedFrames` takes it.
        """
        return expected_of([(self, groups)], rows, lighting, seed, leaking, probed)


def expected_of(
    parts: Sequence[tuple[Simulation, Sequence[FiledLight]]],
    rows: Labels,
    lighting: Lighting,
    seed: int,
    leaking: bool = True,
    probed: FloatArray | None = None,
) -> ExpectedFrames:
    """Expected frames of light in several parts.

    Parameters
    ----------
    parts
        simulations of one rig, each with the light that it filed; black pixels leak as the first says, glint is that of
        the last.
    rows, lighting, seed, leaking, probed
        as for :meth:`Simulation.expected`.
    """
    light = emitted(parts[0][0].physics, lighting, leaking)
    filed = [simulation.filed(groups, len(rows)) for simulation, groups in parts]
    lights, ambient = ([each for part in filed for each in part[kind]] for kind in (0, 1))
    glint = parts[-1][0].glint_frames(lighting.labels)
    return ExpectedFrames(lights, Lighting(rows, light), seed, ambient, glint, probed)


def emitted(physics: Physics, lighting: Lighting, leaking: bool = True) -> FloatArray:
    """(shots, classes) light of each class of pixels in each shot, as a part of its full power.

    Parameters
    ----------
    physics
        of the projector.
    lighting, leaking
        as for :meth:`Simulation.expected`.
    """
    black = physics.black_level if leaking else 0.0
    return np.asarray(black + (1 - black) * lighting.weights)
