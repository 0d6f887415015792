"""Light over several surfaces, in mirrors and of lamps, from one point of the sensor or several: what one changes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from mitsim.capture.bench import Bench
from mitsim.capture.evidence import LOOKS, Effort, Noise, Part, Settings
from mitsim.capture.filing import Tray
from mitsim.capture.pilot.looks import EVEN_CELLS, Sample, heavy_paths, known, ladder, noise, norm
from mitsim.capture.simulation import Simulation
from mitsim.core.arrays import FloatArray
from mitsim.core.seeds import integer
from mitsim.transport.histogram import Deposits
from mitsim.transport.lamps import Together
from mitsim.transport.paths import Tracer

FOLLOWED_LADDER = (1, 2, 3, 5, 8, 12)
"""Numbers of anchors that are tried."""
WIDTHS = (1, 2, 4)
"""Projector pixels a side of a cell that are tried: what anchors see beyond their mean is little light, and need not be
as fine as all of it; wider cells hold light of many anchors in memory."""
_AT_ONCE = 2**20
"""Connections that are traced at a time: 0.5 GB while they are filed."""
_FIRST_JUDGE = 1
"""Index of the number that judges at first."""
_FEW_ANCHORS = 2
"""Anchors whose noise is measured."""


class FollowedLight:
    """The frames with fewer anchors for light that is followed; to every anchor go the same paths.

    Of one wavelength, as :class:`mitsim.capture.pilot.direct.AnchoredLight` has them.

    Parameters
    ----------
    bench, everything
        what is traced, and settings with all its effects on.
    sample
        shots and samples.
    tolerance
        norm of a change at which the search for enough may stop.
    seed
        root of the random streams.
    layers
        depths [mm] that judge one layer; none for a flat scene.
    lit
        whether other looks found any such light.
    """

    def __init__(
        self,
        bench: Bench,
        everything: Settings,
        sample: Sample,
        tolerance: float,
        seed: int,
        layers: tuple[float, ...] = (),
        lit: bool = True,
    ) -> None:
        self.bench, self.everything, self.sample, self.tolerance = bench, everything, sample, tolerance
        self._layers, self._lit = layers, lit
        self._seeds = [integer(seed, "pilot", "followed", look) for look in range(LOOKS)]

    @cached_property
    def changes(self) -> dict[Part, FloatArray]:
        """Change of the frames by every number of anchors that was tried; none where there is no such light."""
        if not self._lit or not self._tracers(self._simulation()) or not norm(self._frames(1)):
            return {}
        found = ladder(FOLLOWED_LADDER, self._frames, _FIRST_JUDGE, self.tolerance)
        anchors = {Part("followed_anchors", count): change for count, change in found.items()}
        # Where the judge was never judged, few anchors serve, and their light is held in any cells.
        return {**anchors, **self._widths} if len(found) > _FIRST_JUDGE + 1 else anchors

    def efforts(self, light: float) -> tuple[Effort, Effort]:
        """Monte Carlo error of one estimate of what a few anchors see beyond their mean, relative to all ``light``, of
        indirect light from the projector's side, and of what is followed from the camera."""
        tracers = self._simulation().at_anchors
        if not self.changes:
            return Effort.none(), Effort.none()
        every = self._beyond_mean()
        if None in tracers:
            seen = every, every
        else:
            simulation = self._simulation(followed_anchors=_FEW_ANCHORS)
            from_camera = self._beyond(simulation, self._few_by_tracer[1])
            seen = every - from_camera, from_camera
        errors = (noise(each) / light if light else 0.0 for each in seen)
        indirect, camera = (
            Effort(Noise(error, self.sample.followed, 0.5), tracer.lanes) if tracer else Effort.none()
            for error, tracer in zip(errors, tracers, strict=True)
        )
        return indirect, camera

    def with_more(self, light: float, samples: int) -> Effort:
        """That of what is followed from the camera, by looks of so many ``samples``; ``light`` as for those."""
        simulation = self._simulation(followed_anchors=_FEW_ANCHORS)
        tracer = simulation.at_anchors[1]
        if tracer is None or not self.changes or not light:
            return Effort.none()
        seen = [heavy_paths(tracer, integer(seed, "heavy"), samples) for seed in self._seeds]
        frames = self._beyond(simulation, seen, samples=samples)
        # The heaviest paths come to one anchor of several: each connection counts.
        found = Noise.among(frames, light, samples, np.concatenate([look.value for look in seen]))
        return Effort(found, self._simulation().at_anchors[1].lanes)  # type: ignore[union-attr]

    @property
    def _widths(self) -> dict[Part, FloatArray]:
        """Change of the frames by every width of cells for what a few anchors see beyond their mean."""
        one = self._beyond_mean()
        missing = (self._beyond_mean(coarse_cells=2) - one) / (1 - EVEN_CELLS)
        layered = self._beyond_mean(coarse_layers=True, layers=self._layers) if self._layers else one
        wide = {width: layered + missing - self._beyond_mean(followed_width=width) for width in WIDTHS[1:]}
        return {Part("followed_width", width): change for width, change in {1: missing, **wide}.items()}

    @known
    def _beyond_mean(self, **cells: Any) -> FloatArray:
        """Frames of what a few anchors see beyond their mean, in such ``cells``."""
        simulation = self._simulation(followed_anchors=_FEW_ANCHORS, **cells)
        return self._beyond(simulation, self._few, None if cells else self._frames(_FEW_ANCHORS))

    def _beyond(
        self,
        simulation: Simulation,
        looks: list[Deposits],
        frames: FloatArray | None = None,
        samples: int | None = None,
    ) -> FloatArray:
        """Frames of light to a few anchors beyond its mean, in a ``simulation``; of all of it, where they are known."""
        weights = simulation.mean_weights(_FEW_ANCHORS)
        mean = [look.averaged(weights) for look in looks]
        trays = simulation.followed, simulation.followed_ambient
        frames = self._formed(trays, looks, samples) if frames is None else frames
        return frames - self._formed((trays[0].of_mean, trays[1].of_mean), mean, samples)

    @cached_property
    def _few(self) -> list[Deposits]:
        """Light to a few anchors, look by look."""
        return self._joined(self._few_by_tracer)

    @cached_property
    def _few_by_tracer(self) -> list[list[Deposits]]:
        """The same by tracer."""
        tracers, samples = self._tracers(self._simulation(followed_anchors=_FEW_ANCHORS)), self.sample.followed
        return [tracer.trace_looks(self._seeds, samples) for tracer in tracers]

    @staticmethod
    def _joined(traced: Iterable[list[Deposits]]) -> list[Deposits]:
        """Light of several tracers together, look by look."""
        return [Deposits.joined(looks) for looks in zip(*traced, strict=True)]

    @known
    def _frames(self, anchors: int) -> FloatArray:
        simulation, samples = self._simulation(followed_anchors=anchors), self.sample.followed
        tracers = self._tracers(simulation)
        each = max(1, _AT_ONCE // sum(tracer.lanes for tracer in tracers))
        parts = [(first, min(each, samples - first)) for first in range(0, samples, each)]

        trays = simulation.followed, simulation.followed_ambient
        if anchors == _FEW_ANCHORS:
            return self._formed(trays, self._few)
        found = []
        for part in parts:
            first, some = part
            traced = [
                tracer.trace_looks(self._seeds, some)
                if some == samples
                else [tracer.trace(seed, first, some) for seed in self._seeds]
                for tracer in tracers
            ]
            found.append(self._formed(trays, self._joined(traced)))
        return np.asarray(sum(found))

    def _simulation(self, **numbers: Any) -> Simulation:
        return self.sample.simulation(self.bench, replace(self.everything, **numbers), one_line=True)

    @staticmethod
    def _tracers(simulation: Simulation) -> list[Tracer | Together]:
        return [tracer for tracer in simulation.at_anchors if tracer is not None]

    def _formed(self, trays: tuple[Tray, Tray], looks: list[Deposits], samples: int | None = None) -> FloatArray:
        """(looks, shots, places, places) frames of the projector's light, and lamps', in ``trays``; of so many
        ``samples``, if not of as many as others."""
        samples = samples or self.sample.followed
        frames = self.sample.frames(trays[0], looks, samples)
        return frames + self.sample.lamps(trays[1], looks, samples) if self.bench.loaded.lamps else frames
