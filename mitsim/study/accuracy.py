"""`mitsim study accuracy`: what accuracy costs in time, for both estimators and the solver, on one scene.

Rows vary one knob at a time from the plan at QUOTED, and whole plans. Every row is held against the *judge*: a factored
answer of its own seed with every effect of the scene, more anchors, layers, cells and samples than the finest plan. Its
Monte Carlo error and the discretisation that it is predicted to leave are stated; below them no error means anything.

The reference is measured on one frame of the family, and its time counted for all. It lacks some effects, so its judge
is light without them; it is unbiased, so its error falls with 1/sqrt(samples), by which it is extrapolated. Seconds are
transport and optics for all frames, kernels compiled beforehand. Accuracies that the plan predicts to take longer than
PATIENCE are left out and named.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mitsim.capture.bench import Bench
from mitsim.capture.effects import EFFECTS, Physics, names, present
from mitsim.capture.exposer import NoiseTarget
from mitsim.capture.light import Light
from mitsim.capture.plan import Plan
from mitsim.capture.render import projected
from mitsim.capture.request import Exposure, Request
from mitsim.core.arrays import FloatArray
from mitsim.core.job import Job
from mitsim.optics.frames import ExpectedFrames
from mitsim.study import plots
from mitsim.study.knobs import Stand, Trial, at_once, reformed, sampled, stacked, trials, without
from mitsim.study.metrics import relative_error
from mitsim.study.solver_cost import SolverRow, time_solver

ACCURACIES = (3e-2, 1e-2, 3e-3, 1e-3, 3e-4)
"""Two steps a decade, from a first look to below the sensor's noise."""
QUOTED = 1e-3
"""The default accuracy."""
PATIENCE = 10.0
"""Seconds of one row: the whole study then takes a minute or two."""
_SAMPLES = (16, 64, 256)
"""Samples a pixel of the reference, each half the error of the one before."""
_JUDGE_MARGIN = 3.0
"""The judge's noise is a third of the finest plan's, which then shows to a twentieth of its own."""
_EFFECT_SAMPLES = 8
"""The same paths with and without an effect: few tell their difference."""
_SERIES = {
    "accuracy": "plan at an accuracy",
    "bounces": "bounces, wavelengths",
    "wavelengths": "bounces, wavelengths",
    "spp": "reference",
}
"""Knobs that share a colour in the figure, or are called otherwise there."""


@dataclass(frozen=True)
class Measured:
    """One setting of one estimator: wall seconds for all frames, error against the judge, own Monte Carlo error.

    ``on_front``: no other row is as good in less time.
    """

    estimator: str
    knob: str
    setting: str
    seconds: float
    error: float
    mc_error: float
    on_front: bool = False


@dataclass(frozen=True)
class EffectCost:
    """One effect switched off where all others are on: change of the frames (the same paths), and seconds it takes."""

    name: str
    error_if_off: float
    seconds: float


@dataclass(frozen=True)
class JudgeFacts:
    """How far the judge is to be trusted: Monte Carlo error, predicted discretisation, what it took."""

    mc_error: float
    systematic_error: float
    seconds: float
    seed: int


@dataclass(frozen=True)
class AccuracyFindings:
    """All that was measured, what was too slow for it, and how much longer the reference would take for the factored
    error at QUOTED; ``sensor_noise`` is relative, at equal peak, and None for a camera without a full well."""

    rows: tuple[Measured, ...]
    effects: tuple[EffectCost, ...]
    solver: tuple[SolverRow, ...]
    judge: JudgeFacts
    sensor_noise: float | None
    speedup_at_equal_error: float
    left_out: tuple[str, ...]

    def payload(self) -> dict[str, Any]:
        """The JSON of the command line."""
        return {**asdict(self), "extrapolated": "reference error falls with 1/sqrt(samples)"}

    def lines(self) -> list[str]:
        """For people."""
        table = [
            f"{row.estimator:>10} {row.knob:<12} {row.setting:<28} {row.seconds:9.3f} s  error {row.error:.1e}  "
            f"Monte Carlo {row.mc_error:.1e}{'  *' if row.on_front else ''}"
            for row in self.rows
        ]
        effects = [
            f"{effect.name} buys {effect.error_if_off:.1e} for {effect.seconds:.2f} s"
            for effect in sorted(self.effects, key=lambda effect: -effect.error_if_off)
        ]
        noise = [f"The sensor's noise is {self.sensor_noise:.1e} at equal peak."] if self.sensor_noise else []
        return [
            *table,
            "* nothing measured is as good in less time",
            *effects,
            f"The judge's own error: Monte Carlo {self.judge.mc_error:.1e}, discretisation predicted "
            f"{self.judge.systematic_error:.1e} ({self.judge.seconds:.1f} s).",
            *noise,
            f"At the error of the factored estimator at {QUOTED:g} the reference would take "
            f"{self.speedup_at_equal_error:.1e} times as long (extrapolated by 1/sqrt(samples)).",
            *(f"Left out, too slow: {name}" for name in self.left_out),
        ]

    def figures(self) -> dict[str, Figure]:
        """Error against time, what each effect buys, and what the solver's precision costs."""
        series: dict[str, list[plots.Point]] = {}
        for row in self.rows:
            series.setdefault(_SERIES.get(row.knob, row.knob), []).append((row.seconds, row.error))
        errors = {effect.name: effect.error_if_off for effect in self.effects}
        seconds = {effect.name: effect.seconds for effect in self.effects}
        return {
            "accuracy.png": plots.pareto(series, noise=self.sensor_noise, apart=(_SERIES["bounces"],)),
            "effects.png": plots.error_bars(errors, QUOTED, seconds),
            "solver.png": plots.solver_costs(self.solver),
        }


def measure(bench: Bench, request: Request, job: Job) -> AccuracyFindings:
    """Error against time.

    MitsimError for patterns that do not fit, or a scene without light.

    Parameters
    ----------
    bench, request, job
        the scene, patterns and seed (accuracies are the study's own), and who is told how far the work is.
    """
    stand = Stand(bench, bench.family(request.patterns, request.seed), request.seed, job, min(ACCURACIES))
    plans = {accuracy: stand.plan(accuracy) for accuracy in ACCURACIES}
    chosen = [a for a, plan in plans.items() if plan.predicted_seconds <= PATIENCE or a == QUOTED]
    quoted = plans[QUOTED]
    judge = _Judge.trace(stand, plans[min(chosen)])
    tried = [Trial("accuracy", f"accuracy {a:g}", bench, plans[a]) for a in chosen]
    tried += trials(bench, quoted, stand.evidence, PATIENCE)
    rows = [judge.row(trial) for trial in tried]
    plan_row = next(row for row in rows if row.setting == f"accuracy {QUOTED:g}")
    rows += list(judge.reference())
    finest = rows[-1]
    front = plots.pareto_front([(row.seconds, row.error) for row in rows])
    return AccuracyFindings(
        rows=tuple(replace(row, on_front=(row.seconds, row.error) in front) for row in rows),
        effects=tuple(_effects(stand, quoted)),
        solver=time_solver(request.seed, job.progress),
        judge=judge.facts,
        sensor_noise=judge.sensor_noise,
        speedup_at_equal_error=finest.seconds * (finest.error / plan_row.error) ** 2 / plan_row.seconds,
        left_out=tuple(
            f"accuracy {a:g} (predicted {plan.predicted_seconds:.0f} s)" for a, plan in plans.items() if a not in chosen
        ),
    )


@dataclass(frozen=True, eq=False)
class _Judge:
    """The answer that rows are held against: its light, expected frames, and how far it is to be trusted."""

    stand: Stand
    light: Light
    expected: ExpectedFrames
    frames: FloatArray
    facts: JudgeFacts

    @classmethod
    def trace(cls, stand: Stand, plan: Plan) -> _Judge:
        """One step finer than ``plan``, with a seed of its own."""
        started, seed = time.perf_counter(), stand.seed + 1
        finest = stand.finest(plan, _JUDGE_MARGIN)
        light = stand.trace(Trial("judge", "", stand.bench, finest), seed)
        expected = light.frames(stand.family.lighting, seed)
        frames, mc_error = stacked(expected)
        facts = JudgeFacts(mc_error, stand.discretisation(finest.settings), time.perf_counter() - started, seed)
        return cls(stand, light, expected, frames, facts)

    def row(self, trial: Trial) -> Measured:
        """One setting of the factored estimator."""
        seconds, frames, mc_error = self.stand.timed(trial)
        error = relative_error(frames, self.frames)
        return Measured("factored", trial.knob, trial.setting, seconds, error, mc_error)

    def reference(self) -> Iterator[Measured]:
        """The reference, against light with the effects that it has."""
        stand, shots = self.stand, self.stand.family.shots
        index, bench = len(shots) // 2, stand.bench
        lighting = stand.family.lighting.shots([index])
        answer, _ = stacked(self.of_reference().frames(lighting, self.facts.seed))
        with projected(bench, stand.family.light(shots[index])):
            bench.render("reference", _SAMPLES[0], seed=stand.seed)  # compiles the kernels
            for spp in _SAMPLES:
                rendered = bench.render("reference", spp, seed=stand.seed, job=stand.job)
                seconds = rendered.facts["seconds"] * len(shots)
                error = relative_error(rendered.mean.mean(axis=2), answer[0])
                yield Measured("reference", "spp", f"{spp} spp", seconds, error, rendered.mc_error)

    def of_reference(self) -> Light:
        """The same light without what the reference lacks; traced anew where that has shaped it."""
        stand, plan, absent = self.stand, self.light.plan, names(lambda effect: not effect.in_reference)
        if not any(EFFECTS[name].retraced(Physics.of(stand.bench)) for name in absent & plan.settings.effects):
            return reformed(self.light, absent)
        plain = replace(plan, settings=replace(plan.settings, effects=plan.settings.effects - absent))
        return stand.trace(Trial("judge", "reference", stand.bench, plain), self.facts.seed)

    @property
    def sensor_noise(self) -> float | None:
        """Relative noise of the sensor at equal peak; None for a camera without a full well."""
        if not np.isfinite(self.stand.bench.sensor.full_well_e):
            return None
        return NoiseTarget(self.stand.bench.rig, Exposure(), 1.0)(self.expected)


def _effects(stand: Stand, plan: Plan) -> Iterator[EffectCost]:
    """Each effect that the scene has, switched off; as many samples with and without, so that noise cancels."""
    everything = frozenset(present(stand.bench))
    full = replace(plan, settings=replace(sampled(plan.settings, _EFFECT_SAMPLES), effects=everything))
    seconds, frames, _ = stand.timed(Trial("effects", "all", stand.bench, full, at_once))
    for name, settings in without(full.settings, everything):
        trial = Trial("effects", f"no {name}", stand.bench, replace(full, settings=settings), at_once)
        fewer_seconds, without_it, _ = stand.timed(trial)
        yield EffectCost(name, relative_error(without_it, frames), seconds - fewer_seconds)
