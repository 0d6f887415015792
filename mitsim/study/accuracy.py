"""`mitsim study accuracy`: what accuracy costs in time, for both estimators and the solver, on one scene.

Rows vary one knob at a time from the plan at QUOTED, and whole plans. Every row is held against the *judge*: a factored
answer of its own seed with every effect of the scene, more anchors, layers, cells and samples than the finest plan. Its
Monte Carlo error and the discretisation that it is predicted to leave are stated; below them no error means anything.

The reference is measured on one frame of the family, and its time counted for all. It has a geometric mask and a
perfect black, so its judge is the same light formed that way; it is unbiased, so its error falls with 1/sqrt(samples),
by which it is extrapolated. Seconds are transport and optics for all frames, kernels compiled beforehand. Accuracies
that the plan predicts to take longer than PATIENCE are left out and named.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.capture import pilot
from mitsim.capture.bench import Bench
from mitsim.capture.evidence import Evidence, Settings
from mitsim.capture.light import Light, collect
from mitsim.capture.plan import Plan, SceneFacts, decide
from mitsim.capture.render import projected, reference
from mitsim.capture.request import Exposure
from mitsim.capture.run import NoiseTarget
from mitsim.capture.simulation import Simulation
from mitsim.core.arrays import FloatArray, Progress, silent
from mitsim.core.errors import MitsimError
from mitsim.core.manifest import write_json
from mitsim.core.output import output_folder, whole_file
from mitsim.core.versions import versions
from mitsim.optics.frames import ExpectedFrames
from mitsim.rig.patterns import PatternFamily
from mitsim.study import plots
from mitsim.study.knobs import Variant, at_once, sampled, variants, without
from mitsim.study.metrics import relative_error
from mitsim.study.solver_cost import SolverRow, solver_costs

ACCURACIES = (3e-2, 1e-2, 3e-3, 1e-3, 3e-4)
SAMPLES = (16, 64, 256)
QUOTED = 1e-3
PATIENCE = 10.0
_JUDGE_MARGIN = 3.0
_EFFECT_SAMPLES = 8
_NOT_IN_REFERENCE = frozenset({"diffraction", "black-level", "mask-thickness"})
_SERIES = {
    "accuracy": "plan at an accuracy",
    "bounces": "bounces, wavelengths",
    "wavelengths": "bounces, wavelengths",
    "spp": "reference",
}


@dataclass(frozen=True)
class Row:
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
class EffectRow:
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
class AccuracyStudy:
    """All that was measured, and how much longer the reference would take for the factored error at QUOTED."""

    scene: str
    patterns: str
    rows: tuple[Row, ...]
    effects: tuple[EffectRow, ...]
    solver: tuple[SolverRow, ...]
    judge: JudgeFacts
    sensor_noise: float | None
    speedup_at_equal_error: float
    left_out: tuple[str, ...]
    output: str

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
            f"Plots: accuracy.png, effects.png, solver.png in {self.output}",
        ]


def study_accuracy(bench: Bench, output: Path | str, patterns: str, seed: int, progress: Progress) -> AccuracyStudy:
    """Measure error against time and write accuracy.json, accuracy.png, effects.png and solver.png to ``output``.

    Raises
    ------
    MitsimError
        for patterns that do not fit, an output that cannot be written, or a scene without light.
    """
    # Only an earlier study is replaced.
    with output_folder(output, overwrite=(Path(output) / "accuracy.json").is_file()) as folder:
        study = _Study(bench, bench.family(patterns, seed), seed, progress)
        found = replace(study.run(), patterns=patterns, output=str(folder))
        series: dict[str, list[plots.Point]] = {}
        for row in found.rows:
            series.setdefault(_SERIES.get(row.knob, row.knob), []).append((row.seconds, row.error))
        figures = {
            "accuracy.png": plots.pareto(series, noise=found.sensor_noise, apart=(_SERIES["bounces"],)),
            "effects.png": plots.effect_costs([(e.name, e.error_if_off, e.seconds) for e in found.effects], QUOTED),
            "solver.png": plots.solver_costs(found.solver),
        }
        for name, figure in figures.items():
            with whole_file(folder / name) as part:
                figure.savefig(part, dpi=150, format="png")
        write_json(folder / "accuracy.json", {**found.payload(), "seed": seed, "versions": versions()})
        return found


class _Study:
    """One scene and family, with what the pilot found of them."""

    def __init__(self, bench: Bench, family: PatternFamily, seed: int, progress: Progress) -> None:
        self.bench, self.family, self.seed, self.progress = bench, family, seed, progress
        self.labels, self.weights = family.lighting
        self.evidence: Evidence = pilot.measure(bench, self.labels, self.weights, min(ACCURACIES), seed)
        self.plans = {accuracy: self._plan(accuracy) for accuracy in ACCURACIES}

    def run(self) -> AccuracyStudy:
        """Every row; the caller names patterns and folder."""
        chosen = [a for a, plan in self.plans.items() if plan.predicted_seconds <= PATIENCE or a == QUOTED]
        slow = tuple(
            f"accuracy {a:g} (predicted {plan.predicted_seconds:.0f} s)"
            for a, plan in self.plans.items()
            if a not in chosen
        )
        started = time.perf_counter()
        finest = self._finest(self.plans[min(chosen)])
        light = collect(self.bench, finest, self.labels, self.weights, self.seed + 1, self.progress)
        expected = light.frames(self.labels, self.weights, self.seed + 1)
        judge, judge_error = _stack(expected)
        facts = JudgeFacts(judge_error, self._left(finest.settings), time.perf_counter() - started, self.seed + 1)
        rows = [self._row(Variant("accuracy", f"accuracy {a:g}", self.bench, self.plans[a]), judge) for a in chosen]
        rows += [
            self._row(variant, judge) for variant in variants(self.bench, self.plans[QUOTED], self.evidence, PATIENCE)
        ]
        rows += list(self._reference(light))
        front = plots.pareto_front([(row.seconds, row.error) for row in rows])
        quoted = next(row for row in rows if row.setting == f"accuracy {QUOTED:g}")
        best = rows[-1]
        return AccuracyStudy(
            scene=str(self.bench.loaded.path),
            patterns="",
            rows=tuple(replace(row, on_front=(row.seconds, row.error) in front) for row in rows),
            effects=tuple(self._effects(finest.settings.effects)),
            solver=solver_costs(self.seed, self.progress),
            judge=facts,
            sensor_noise=self._sensor_noise(expected),
            speedup_at_equal_error=best.seconds * (best.error / quoted.error) ** 2 / quoted.seconds,
            left_out=slow,
            output="",
        )

    def _plan(self, accuracy: float) -> Plan:
        return decide(accuracy, self.evidence, len(self.weights), SceneFacts.of(self.bench))

    def _finest(self, plan: Plan) -> Plan:
        """Everything on, and one step finer than ``plan`` in each number."""
        evidence, now = self.evidence, plan.settings
        anchors = next((count for count in evidence.anchor_error if count > now.anchors), now.anchors)
        layers = next((count for count in evidence.layer_error if count > len(now.depths)), len(now.depths))
        cells = next((count for count in evidence.cell_error if count > now.subdivision), now.subdivision)
        settings = replace(
            now,
            anchors=anchors,
            layers=evidence.layers[layers] if layers > 1 else (),
            subdivision=cells,
            effects=frozenset(pilot.applicable(self.bench)),
            coarse_cells=cells,
            coarse_layers=True,
        )
        return replace(plan, settings=settings, sampling_target=plan.accuracy / _JUDGE_MARGIN)

    def _left(self, settings: Settings) -> float:
        """What these settings are predicted to leave besides noise."""
        evidence = self.evidence
        parts = (
            evidence.anchor_error[settings.anchors],
            evidence.layer_error[len(settings.depths)],
            evidence.cell_error[settings.subdivision],
        )
        return float(np.linalg.norm(parts))

    def _row(self, variant: Variant, judge: FloatArray) -> Row:
        seconds, frames, mc_error = self._timed(variant)
        error = relative_error(frames, judge)
        return Row("factored", variant.knob, variant.setting, seconds, error, mc_error)

    def _timed(self, variant: Variant) -> tuple[float, FloatArray, float]:
        """Seconds, frames and Monte Carlo error; one sample beforehand compiles the kernels."""
        bench, plan = variant.bench, variant.plan
        once = replace(plan, settings=sampled(plan.settings, 1))
        collect(bench, once, self.labels, self.weights, self.seed, by_pixel=False, target=at_once)
        started = time.perf_counter()
        light = collect(
            bench, plan, self.labels, self.weights, self.seed, self.progress, by_pixel=False, target=variant.target
        )
        frames, mc_error = _stack(light.frames(self.labels, self.weights, self.seed))
        return time.perf_counter() - started, frames, mc_error

    def _effects(self, names: frozenset[str]) -> Iterator[EffectRow]:
        """Each effect that the scene has, switched off; as many samples with and without, so that noise cancels."""
        plan = self.plans[QUOTED]
        full = replace(plan, settings=replace(sampled(plan.settings, _EFFECT_SAMPLES), effects=names))
        seconds, frames, _ = self._timed(Variant("effects", "all", self.bench, full, at_once))
        for name, settings in without(full.settings, names):
            changed = Variant("effects", f"no {name}", self.bench, replace(full, settings=settings), at_once)
            less, other, _ = self._timed(changed)
            yield EffectRow(name, relative_error(other, frames), seconds - less)

    def _reference(self, light: Light) -> Iterator[Row]:
        """Against the judge's own light with the physics that the reference has."""
        index = len(self.family.captures) // 2
        settings = light.simulation.settings
        plain = Simulation(self.bench, replace(settings, effects=settings.effects - _NOT_IN_REFERENCE))
        shown = self.weights[[index]]
        judge, _ = _stack(replace(light, simulation=plain).frames(self.labels, shown, self.seed + 1))
        with projected(self.bench, self.family.light(self.family.captures[index])):
            reference(self.bench.loaded, SAMPLES[0], self.seed, silent)
            for spp in SAMPLES:
                started = time.perf_counter()
                found = reference(self.bench.loaded, spp, self.seed, self.progress)
                seconds = (time.perf_counter() - started) * len(self.family.captures)
                error = relative_error(found.mean.mean(axis=2), judge[0])
                yield Row("reference", "spp", f"{spp} spp", seconds, error, found.mc_error)

    def _sensor_noise(self, expected: ExpectedFrames) -> float | None:
        """Relative noise of the sensor at equal peak; None for a camera without a full well."""
        if not np.isfinite(self.bench.sensor.full_well_e):
            return None
        return NoiseTarget(self.bench, Exposure(), 1.0, self.seed)(expected)


def _stack(expected: ExpectedFrames) -> tuple[FloatArray, float]:
    """All frames (captures, pixels, pixels) and their Monte Carlo error."""
    found = list(expected)
    frames = np.stack([frame.irradiance for frame in found])
    if not frames.any():
        raise MitsimError("all frames are dark; nothing can be compared")
    noise = sum(frame.variance * frame.irradiance.size for frame in found)
    return frames, float(np.sqrt(noise / np.square(frames).sum()))
