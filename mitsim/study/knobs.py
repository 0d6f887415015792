"""One knob at a time: from a plan to trials that differ from it in one choice, and to their frames and seconds."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mitsim.capture import pilot
from mitsim.capture.bench import Bench
from mitsim.capture.choice import counted
from mitsim.capture.effects import names, present
from mitsim.capture.evidence import COUNTED, GROUPS, Evidence, Part, Settings
from mitsim.capture.light import Light, Sampling, Target, trace_light
from mitsim.capture.plan import Plan, SceneFacts, decide
from mitsim.capture.prices import paces_of, tracing_seconds
from mitsim.capture.simulation import Simulation
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.optics.frames import ExpectedFrames
from mitsim.rig.patterns import PatternFamily

CELLS, ANCHORS, LAYERS = (1, 2, 4), (1, 2, 3, 5), (1, 2, 4, 8)
"""Cells of a pixel and anchors a side, and layers: each about halves the error of the one before."""
LINE_WIDTH_NM = 2.0
"""Assumed width of a laser diode's line, for the finer spectrum."""
SAMPLES = (1, 8, 64)
"""Steps of 8, over which the error of independent samples falls by 2.8."""


@dataclass(frozen=True)
class Trial:
    """One setting of the factored estimator: what was turned, to what, and the bench and plan that it makes; ``target``
    is the error to stop at where it is not the plan's own."""

    knob: str
    setting: str
    bench: Bench
    plan: Plan
    target: Target | None = None


def at_once(expected: ExpectedFrames) -> float:
    """A target that any error of the ``expected`` frames meets: sampling stops after its first round."""
    return float("inf")


def sampled(settings: Settings, samples: int) -> Settings:
    """``settings`` whose first round takes so many ``samples`` of a projector pixel and of a cell in each group."""
    each = float(samples)
    return replace(
        settings,
        direct_samples=each,
        anchored_samples=each / 8,
        indirect_samples=each,
        from_camera_samples=each,
        followed_samples=each / 8,
        occluded_samples=each / 8,
    )


def reformed(light: Light, absent: frozenset[str]) -> Light:
    """The same ``light``, traced no further, whose frames are formed with the effects ``absent`` at their neutral
    values: of such as need no light to be traced anew."""
    simulation = light.simulation
    settings = replace(simulation.settings, effects=simulation.settings.effects - absent)
    return replace(light, simulation=Simulation(simulation.bench, settings))


def trials(bench: Bench, plan: Plan, evidence: Evidence, patience: float) -> Iterator[Trial]:
    """A plan with one knob turned.

    Parameters
    ----------
    bench, plan, evidence
        where the knobs stand at first, and what the pilot found there.
    patience
        what would be traced for longer, and for longer than the plan itself, is left out [s].
    """
    now = plan.settings
    longest = max(patience, _tracing(now, evidence))
    choices: list[tuple[str, str, Settings, Target | None]] = [
        ("samples", f"{GROUPS * samples} samples", sampled(now, samples), at_once) for samples in SAMPLES
    ]
    choices += [("cells", f"{cells}x{cells} a pixel", replace(now, subdivision=cells), None) for cells in CELLS]
    choices += [("anchors", f"{anchors}x{anchors}", _with_anchors(now, anchors), None) for anchors in ANCHORS]
    if len(evidence.layers) > 1:
        depths = {layers: evidence.layers[layers] for layers in LAYERS if layers in evidence.layers}
        choices += [
            ("layers", str(count), replace(now, layers=each if count > 1 else ()), None)
            for count, each in depths.items()
        ]
    bounces = frozenset({"interreflection"})
    choices.append(("bounces", "one reflection", replace(now, effects=now.effects - bounces), None))
    choices.append(("bounces", "all, roulette", replace(now, effects=now.effects | bounces), None))
    for knob, setting, settings, target in choices:
        if _tracing(settings, evidence) <= longest:
            yield Trial(knob, setting, bench, replace(plan, settings=settings), target)
    for setting, lit in _lights(bench):
        yield Trial("wavelengths", setting, lit, plan)


def without(settings: Settings, present: frozenset[str]) -> Iterator[tuple[str, Settings]]:
    """The name of each effect of those ``present`` that shows in expected frames, and ``settings`` without it; numbers
    fall to one."""
    for name in sorted(present & names(lambda effect: effect.in_frames)):
        yield name, replace(settings, effects=settings.effects - {name})
    if settings.anchors > 1:
        yield "anchors", replace(settings, anchors=1, occluded_anchors=1)
    if len(settings.depths) > 1:
        yield "layers", replace(settings, layers=())


def _lights(bench: Bench) -> Iterator[tuple[str, Bench]]:
    """One effective wavelength, the projector's lines, and each of them as three of a line's width."""
    model = bench.projector
    lines = model.wavelengths_nm or (model.effective_wavelength_nm,)
    shares = model.radiant_shares or (1.0,)
    finer = tuple(line + step * LINE_WIDTH_NM / 3 for line in lines for step in (-1, 0, 1))
    choices = {
        "1 wavelength": ((model.effective_wavelength_nm,), (1.0,)),
        f"{len(lines)} line(s), the projector's": (lines, shares),
        f"{len(finer)}, lines {LINE_WIDTH_NM:g} nm wide": (finer, tuple(s / 3 for s in shares for _ in range(3))),
    }
    for name, (wavelengths, parts) in choices.items():
        changes = {"wavelengths_nm": wavelengths, "radiant_shares": parts}
        yield name, replace(bench, rig=replace(bench.rig, projector=model.model_copy(update=changes)))


def _with_anchors(settings: Settings, anchors: int) -> Settings:
    """``settings`` with so many anchors; those of occluded pixels stay, but one is one for all."""
    return replace(settings, anchors=anchors, occluded_anchors=settings.occluded_anchors if anchors > 1 else 1)


def _tracing(settings: Settings, evidence: Evidence) -> float:
    """Seconds of tracing what the settings predict, at the pilot's pace."""
    return sum(tracing_seconds(evidence, settings, paces_of(evidence)).values())


@dataclass(frozen=True, eq=False)
class Stand:
    """What all trials share: scene, family, seed and job, and what the pilot found of them down to ``accuracy``."""

    bench: Bench
    family: PatternFamily
    seed: int
    job: Job
    accuracy: float

    @cached_property
    def evidence(self) -> Evidence:
        """Of the pilot."""
        return pilot.measure(self.bench, self.family.lighting, self.accuracy, self.seed)

    def plan(self, accuracy: float) -> Plan:
        """What the evidence calls for at an ``accuracy``."""
        return decide(accuracy, self.evidence, SceneFacts.of(self.bench))

    def finest(self, plan: Plan, margin: float) -> Plan:
        """Everything on, one step finer than ``plan`` in each number, and its accuracy over ``margin`` of noise."""
        evidence, now = self.evidence, plan.settings
        anchors, layers, cells, followed, occluded, _ = (
            next((finer for finer in evidence.ladders[name] if finer > count), count)
            for name, count in zip(COUNTED, counted(now), strict=True)
        )
        settings = replace(
            now,
            anchors=anchors,
            layers=evidence.layers[layers] if layers > 1 else (),
            subdivision=cells,
            effects=frozenset(present(self.bench)),
            followed_anchors=followed,
            followed_width=max(now.followed_width // 2, 1),
            occluded_anchors=occluded,
            coarse_cells=min(2 * now.coarse_cells, cells),
            coarse_layers=True,
        )
        return replace(plan, settings=settings, sampling_target=plan.accuracy / margin)

    def discretisation(self, settings: Settings) -> float:
        """Relative error that the numbers in ``settings`` are predicted to leave."""
        return self.evidence.error(*(Part(*both) for both in zip(COUNTED, counted(settings), strict=True))).value

    def trace(self, trial: Trial, seed: int) -> Light:
        """Light of a ``trial``, by the family's classes, from a ``seed``."""
        sampling = Sampling(by_pixel=False, target=trial.target)
        return trace_light(trial.bench, trial.plan, self.family.lighting, seed, sampling, self.job.progress)

    def timed(self, trial: Trial) -> tuple[float, FloatArray, float]:
        """Seconds of a ``trial``, its frames and Monte Carlo error; one sample beforehand compiles the kernels."""
        once = replace(trial.plan, settings=sampled(trial.plan.settings, 1))
        self.trace(replace(trial, plan=once, target=at_once), self.seed)
        started = time.perf_counter()
        frames, mc_error = stacked(self.trace(trial, self.seed).frames(self.family.lighting, self.seed))
        return time.perf_counter() - started, frames, mc_error


def stacked(expected: ExpectedFrames) -> tuple[FloatArray, float]:
    """All ``expected`` frames (shots, pixels, pixels) and their relative Monte Carlo error. MitsimError when all are
    dark."""
    formed = list(expected)
    frames = np.stack([frame.irradiance for frame in formed])
    if not frames.any():
        raise MitsimError("all frames are dark; nothing can be compared")
    noise = sum(frame.variance * frame.irradiance.size for frame in formed)
    return frames, float(np.sqrt(noise / np.square(frames).sum()))
