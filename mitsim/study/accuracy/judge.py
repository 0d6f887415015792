"""The answer that errors are held against: a stand and seconds in; light, frames, their own error, and the reference's
rows out."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mitsim.capture.choice import predicted
from mitsim.capture.effects import EFFECTS, Physics, names
from mitsim.capture.exposer import NoiseTarget
from mitsim.capture.light import Light
from mitsim.capture.plan import Plan
from mitsim.capture.render import projected
from mitsim.capture.request import Exposure
from mitsim.core.arrays import FloatArray
from mitsim.optics.frames import ExpectedFrames
from mitsim.study.accuracy.findings import JudgeFacts, Row
from mitsim.study.knobs import Stand, Trial, reformed, stacked
from mitsim.study.metrics import relative_error
from mitsim.study.spreads import Budget, Spread

_FINEST_OVER = 10.0
"""The judge's noise is a tenth of the quoted accuracy where time allows, so that runs ten times finer show."""
_STEP = 1.25
"""Between the noises that are tried: predictions of time are no better."""
_SAMPLES = (16, 64)
"""Samples a pixel of the reference, the second at half the error of the first: that it falls so is seen."""
_SHARE = 0.25
"""Of what is left, what a step of the reference may take: repeats of all else are worth more."""
_GROWTH = 5.0
"""Time of a step of the reference over that of the one before: four times the samples, and some more."""


@dataclass(frozen=True, eq=False)
class Judge:
    """The answer that rows are held against: its light, expected frames, and how far it is to be trusted."""

    stand: Stand
    light: Light
    expected: ExpectedFrames
    frames: FloatArray
    facts: JudgeFacts

    @classmethod
    def trace(cls, stand: Stand, plan: Plan, seconds: float) -> Judge:
        """The answer that so much time buys, with a seed of its own.

        Parameters
        ----------
        stand, plan
            the scene, and a plan that the judge is finer than.
        seconds
            at fixed paces.
        """
        started, seed = time.perf_counter(), stand.seed + 1
        finest, work = _within(stand, stand.finest(plan), seconds)
        if work > seconds:
            # With a plan's own numbers; what they leave is stated with the judge.
            finest, _ = _within(stand, plan, seconds)
        light = stand.trace(Trial("judge", "", stand.bench, finest), seed)
        expected = light.frames(stand.family.lighting, seed)
        frames, mc_error = stacked(expected)
        facts = JudgeFacts(mc_error, stand.discretisation(finest.settings), time.perf_counter() - started, seed)
        return cls(stand, light, expected, frames, facts)

    def error(self, frames: FloatArray) -> float:
        """Relative error of all ``frames``, without the judge's own noise: seeds differ, so squares add. At least half
        that noise, below which chance decides."""
        distance, noise = relative_error(frames, self.frames), self.facts.mc_error
        return max(math.sqrt(max(distance**2 - noise**2, 0.0)), noise / 2)

    def reference(self, budget: Budget) -> Iterator[Row]:
        """Rows of the reference, against light with the effects that it has, as far as the ``budget`` goes."""
        stand, shots = self.stand, self.stand.family.shots
        index, bench = len(shots) // 2, stand.bench
        lighting = stand.family.lighting.shots([index])
        with projected(bench, stand.family.light(shots[index])):
            started = time.perf_counter()
            bench.render("reference", _SAMPLES[0], seed=stand.seed)  # compiles the kernels
            predicted_s = time.perf_counter() - started
            answer: FloatArray | None = None
            for spp in _SAMPLES:
                if not budget.allows(f"reference at {spp} spp", predicted_s, _SHARE):
                    return
                if answer is None:
                    answer, _ = stacked(self.of_reference().frames(lighting, self.facts.seed))
                rendered = bench.render("reference", spp, seed=stand.seed, job=stand.job)
                one, predicted_s = rendered.facts["seconds"], _GROWTH * rendered.facts["seconds"]
                error = relative_error(rendered.mean.mean(axis=2), answer[0])
                said = f"one of {len(shots)} frames was measured, {one:.2g} s" if len(shots) > 1 else ""
                spread = Spread.of([one]) * len(shots)
                yield Row("reference", "spp", f"{spp} spp", spread, error, rendered.mc_error, extrapolated=said)

    def of_reference(self) -> Light:
        """The same light without what the reference lacks; traced anew where that has shaped it."""
        stand, plan, absent = self.stand, self.light.plan, names(lambda effect: not effect.in_reference)
        if not any(EFFECTS[name].retraced(Physics.of(stand.bench)) for name in absent & plan.settings.effects):
            return reformed(self.light, absent)
        plain = replace(plan, settings=replace(plan.settings, effects=plan.settings.effects - absent))
        return stand.trace(Trial("judge", "reference", stand.bench, plain), self.facts.seed)

    @cached_property
    def sensor_noise(self) -> float | None:
        """Relative noise of the sensor at equal peak; None for a camera without a full well."""
        if not np.isfinite(self.stand.bench.sensor.full_well_e):
            return None
        return NoiseTarget(self.stand.bench.rig, Exposure(), 1.0)(self.expected)


def _within(stand: Stand, plan: Plan, seconds: float) -> tuple[Plan, float]:
    """The ``plan`` with the least noise whose light is predicted to take at most so many ``seconds``, or with the
    noise of its accuracy, and what its light takes."""
    accuracy = plan.accuracy / _FINEST_OVER
    while True:
        # What its numbers leave is stated; sampling alone is given the time.
        choice = predicted(accuracy, stand.evidence, plan.settings, {})
        if choice.work <= seconds or accuracy > plan.accuracy:
            return replace(plan, settings=choice.settings, sampling_target=choice.target), choice.work
        accuracy *= _STEP
