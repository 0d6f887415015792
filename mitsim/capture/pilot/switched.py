"""All effects at once, and each of them switched off: how much the frames change, and what followed light takes."""

from __future__ import annotations

import time
from collections.abc import Collection
from dataclasses import replace

from mitsim.capture.bench import Bench
from mitsim.capture.effects import DIRECT, EFFECTS, FOLLOWED, Effect
from mitsim.capture.evidence import Effort, Noise, Settings
from mitsim.capture.pilot.halves import Halves, Sample, difference, noise, norm
from mitsim.capture.simulation import Simulation
from mitsim.core.seeds import integer
from mitsim.transport import histogram
from mitsim.transport.histogram import Deposits

_SHARP_RATE = 0.7
"""Power of the samples that the error of sharp light falls with: stratified over a pixel, but its lobes are narrow."""
_KINDS = {"indirect": histogram.INDIRECT, "ambient": histogram.AMBIENT}


class SwitchedEffects:
    """A bench with all effects; direct and followed light are traced once and reused where they can be.

    Parameters
    ----------
    bench, everything
        what is traced, and settings with all its effects on.
    sample
        shots and samples.
    seed
        root of the random streams.
    """

    def __init__(self, bench: Bench, everything: Settings, sample: Sample, seed: int) -> None:
        self.bench, self.everything, self.sample = bench, everything, sample
        self.seeds = tuple(integer(seed, "pilot", "effects", half) for half in range(2))
        self.simulation = Simulation(bench, everything)
        self.direct, self.followed = self._direct(self.simulation), self._follow(self.simulation)
        self.sharp = self._sharp(self.simulation)
        self.frames = self._form(self.simulation, self.direct, self.followed, self.sharp)

    @property
    def light(self) -> float:
        """Norm of the frames of all light."""
        return norm(self.frames)

    def errors(self, names: Collection[str]) -> dict[str, float]:
        """Relative change of the frames when each effect of ``names`` is left out."""
        errors = {}
        for name in names:
            effect = EFFECTS[name]
            errors[name] = difference(self._without(effect), self.frames) if effect.in_frames else self._drawn()
        return errors

    def _drawn(self) -> float:
        """Speckle, which is drawn with the sensor's noise: its contrast is its relative error."""
        return self.simulation.physics.speckle

    def effort(self, name: str) -> Effort:
        """Monte Carlo error of one estimate by the tracer ``name``, relative to all light, and what it takes."""
        stage = self.simulation.tracers().get(name)
        if stage is None:
            return Effort.none()
        samples, lanes = self.sample.followed, stage.tracer.lanes
        started = time.perf_counter()
        deposits = tuple(stage.tracer.trace(seed, 0, samples) for seed in self.seeds)
        pace = (time.perf_counter() - started) / (2 * lanes * samples)
        none = tuple(Deposits.none() for _ in self.seeds)
        error = noise(self._form(self.simulation, none, deposits, none), self.light)
        return Effort(Noise(error, samples, 0.5), lanes, pace)

    def sharp_effort(self) -> Effort:
        """The same of sharp pixels, from the halves that are there; the error is taken to fall with the root."""
        tracer = self.simulation.apart
        if tracer is None:
            return Effort.none()
        samples, none = self.sample.sharp(self.simulation), (Deposits.none(), Deposits.none())
        started = time.perf_counter()
        tracer.trace(self.seeds[0], 0, samples)
        pace = (time.perf_counter() - started) / (tracer.lanes * samples)
        error = noise(self._form(self.simulation, none, none, self.sharp), self.light)
        return Effort(Noise(error, samples, _SHARP_RATE), tracer.lanes, pace)

    def _without(self, effect: Effect) -> Halves:
        simulation = Simulation(self.bench, replace(self.everything, effects=self.everything.effects - {effect.name}))
        retraced = effect.retraced(simulation.physics)
        direct, sharp = self.direct, self.sharp
        if DIRECT in retraced:
            direct, sharp = self._direct(simulation), self._sharp(simulation)
        if FOLLOWED in retraced:
            followed = self._follow(simulation)
        elif effect.kind:
            left_out = _KINDS[effect.kind]
            followed = tuple(deposits.where(deposits.kind != left_out) for deposits in self.followed)
        else:
            followed = self.followed
        return self._form(simulation, direct, followed, sharp)

    def _direct(self, simulation: Simulation) -> tuple[Deposits, ...]:
        return tuple(simulation.direct.trace(seed, 0, self.sample.direct) for seed in self.seeds)

    def _follow(self, simulation: Simulation) -> tuple[Deposits, ...]:
        return tuple(simulation.follow(seed, self.sample.followed) for seed in self.seeds)

    def _sharp(self, simulation: Simulation) -> tuple[Deposits, ...]:
        tracer = simulation.apart
        if tracer is None:
            return tuple(Deposits.none() for _ in self.seeds)
        return tuple(tracer.trace(seed, 0, self.sample.sharp(simulation)) for seed in self.seeds)

    def _form(self, simulation: Simulation, *parts: tuple[Deposits, ...]) -> Halves:
        """Frames of two halves; ``parts`` are direct, followed and sharp light."""
        halves = [
            self.sample.frames(simulation, direct, self.sample.direct, *more)
            for direct, *more in zip(*parts, strict=True)
        ]
        return halves[0], halves[1]
