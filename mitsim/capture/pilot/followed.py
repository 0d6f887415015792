"""Light over several surfaces, in mirrors and of lamps, from one point of the sensor or several: what one changes."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

from scipy import sparse

from mitsim.capture.bench import Bench
from mitsim.capture.evidence import LOOKS, Effort, Noise, Part, Settings
from mitsim.capture.pilot.looks import Sample, ladder, noise, norm
from mitsim.capture.simulation import Simulation
from mitsim.core.arrays import FloatArray
from mitsim.core.seeds import integer
from mitsim.optics.frames import ExpectedFrames, Filed
from mitsim.rig.patterns import Lighting
from mitsim.transport.histogram import Deposits

FOLLOWED_LADDER = (1, 2, 3, 5)
"""Numbers of anchors that are tried."""
_FIRST_JUDGE = 1
"""Index of the number that judges at first."""
_FEW_ANCHORS = 2
"""Anchors whose noise is measured."""


class FollowedLight:
    """The frames with fewer anchors for light that is followed; to every anchor go the same paths.

    Parameters
    ----------
    bench, everything
        what is traced, and settings with all its effects on.
    sample
        shots and samples.
    accuracy
        where the search for enough may stop.
    seed
        root of the random streams.
    """

    def __init__(self, bench: Bench, everything: Settings, sample: Sample, accuracy: float, seed: int) -> None:
        self.bench, self.everything, self.sample, self.accuracy = bench, everything, sample, accuracy
        self._seeds = [integer(seed, "pilot", "followed", look) for look in range(LOOKS)]

    @cached_property
    def changes(self) -> dict[Part, FloatArray]:
        """Change of the frames by every number of anchors that was tried; none where there is no such light."""
        if not norm(self._frames(1)):
            return {}
        found = ladder(FOLLOWED_LADDER, self._frames, _FIRST_JUDGE, self.accuracy)
        return {Part("followed_anchors", count): change for count, change in found.items()}

    def effort(self, light: float) -> Effort:
        """Monte Carlo error of one estimate of what a few anchors see beyond their mean, relative to all ``light``."""
        if not self.changes:
            return Effort.none()
        simulation, labels, samples = self._simulation(_FEW_ANCHORS), self.sample.lighting.labels, self.sample.followed
        beyond = [simulation.file_at_anchors(look, labels, samples).followed for look in self._few]
        error = noise(self._formed(simulation, beyond))
        lanes = sum(tracer.lanes for tracer in simulation.at_anchors if tracer is not None)
        return Effort(Noise(error / light if light else 0.0, samples, 0.5), lanes // _FEW_ANCHORS**2)

    @cached_property
    def _few(self) -> list[Deposits]:
        return self._traced(self._simulation(_FEW_ANCHORS))

    def _frames(self, anchors: int) -> FloatArray:
        simulation, labels = self._simulation(anchors), self.sample.lighting.labels
        traced = self._few if anchors == _FEW_ANCHORS else self._traced(simulation)
        filed = [simulation.followed.file(look, labels, self.sample.followed) for look in traced]
        return self._formed(simulation, filed)

    def _simulation(self, anchors: int) -> Simulation:
        return Simulation(self.bench, replace(self.everything, followed_anchors=anchors))

    def _traced(self, simulation: Simulation) -> list[Deposits]:
        """Light to every anchor, look by look."""
        tracers = [tracer for tracer in simulation.at_anchors if tracer is not None]
        samples = self.sample.followed
        return [Deposits.joined([tracer.trace(seed, 0, samples) for tracer in tracers]) for seed in self._seeds]

    def _formed(self, simulation: Simulation, lights: list[sparse.csr_array]) -> FloatArray:
        """(looks, shots, pixels, columns) frames of light to every anchor."""
        rows, lighting = self.sample.rows, Lighting(self.sample.rows, self.sample.lighting.weights)
        filed = Filed(simulation.followed.optics, tuple(light[: len(rows)] for light in lights))
        lamps = Filed(simulation.followed_ambient.optics, tuple(light[len(rows) :] for light in lights))
        ambient = [lamps] if simulation.physics.lamps else []
        return ExpectedFrames([filed], lighting, 0, ambient).by_group(self.sample.columns)
