"""One knob at a time: from a plan to trials that differ from it in one choice, and to their frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mitsim.bench.bench import Apparatus
from mitsim.bench.effects import names, present
from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.devices.patterns import PatternFamily
from mitsim.light.light import SampledLight, Sampling, Target, trace_light
from mitsim.light.pass_table import PASSES
from mitsim.light.passes import Simulation
from mitsim.light.pilot_result import COUNTED, Evidence, Part
from mitsim.light.plan import Plan
from mitsim.light.settings import Settings
from mitsim.optics.frames import ExpectedFrames
from mitsim.planner import pilot
from mitsim.planner.choose import counted
from mitsim.planner.explain import SceneFacts, decide

_FEW_SHOTS = 8
"""Shots whose frames tell what changes all of them: they differ by a few percent."""


@dataclass(frozen=True)
class Trial:
    """One setting of the factored estimator: what was turned, to what, and the bench and plan that it makes; ``target``
    is the error to stop at where it is not the plan's own."""

    knob: str
    setting: str
    bench: Apparatus
    plan: Plan
    target: Target | None = None


def at_once(expected: ExpectedFrames) -> float:
    """A target that any error of the ``expected`` frames meets: sampling stops after its first round."""
    return float("inf")


def sampled(settings: Settings, samples: int) -> Settings:
    """``settings`` whose first round takes so many ``samples`` of a projector pixel and of a cell in each group."""
    each = {name: samples / 8 if row.anchors else float(samples) for name, row in PASSES.items() if name != "sharp"}
    return replace(settings, samples={**settings.samples, **each})


def reformed(light: SampledLight, absent: frozenset[str]) -> SampledLight:
    """The same ``light``, traced no further, whose frames are formed with the effects ``absent`` at their neutral
    values: of such as need no light to be traced anew."""
    simulation = light.simulation
    settings = replace(simulation.settings, effects=simulation.settings.effects - absent)
    return replace(light, simulation=Simulation(simulation.bench, settings))


def without(settings: Settings, present: frozenset[str]) -> Iterator[tuple[str, Settings]]:
    """The name of each effect of those ``present`` that shows in expected frames, and ``settings`` without it; numbers
    fall to one."""
    for name in sorted(present & names(lambda effect: effect.in_frames)):
        yield name, replace(settings, effects=settings.effects - {name})
    if settings.anchors > 1:
        yield "anchors", replace(settings, anchors=1, occluded_anchors=1)
    if settings.followed_anchors > 1:
        yield "followed-anchors", replace(settings, followed_anchors=1, followed_width=1)
    if len(settings.depths) > 1:
        yield "layers", replace(settings, layers=())
    if settings.subdivision > 1:
        yield "cells", replace(settings, subdivision=1, coarse_cells=1)


def one_line(bench: Apparatus) -> Apparatus:
    """``bench`` with a projector of its effective wavelength alone."""
    model = bench.projector
    changes = {"wavelengths_nm": (model.effective_wavelength_nm,), "radiant_shares": (1.0,)}
    return replace(bench, rig=replace(bench.rig, projector=model.model_copy(update=changes)))


@dataclass(frozen=True, eq=False)
class Stand:
    """What all trials share: scene, family, seed and job, and what the pilot found of them down to ``accuracy``."""

    bench: Apparatus
    family: PatternFamily
    seed: int
    job: Job
    accuracy: float

    @cached_property
    def look(self) -> pilot.Look:
        """The pilot's."""
        return pilot.Look(self.bench, self.family.lighting, self.accuracy, self.seed)

    @cached_property
    def evidence(self) -> Evidence:
        """Of the pilot."""
        return self.look.evidence

    @cached_property
    def few_shots(self) -> Labels:
        """Numbers of some shots, evenly spread."""
        return np.unique(np.linspace(0, len(self.family.shots) - 1, _FEW_SHOTS).astype(np.int64))

    def plan(self, accuracy: float) -> Plan:
        """What the evidence calls for at an ``accuracy``."""
        return decide(accuracy, self.evidence, SceneFacts.of(self.bench))

    def finest(self, plan: Plan) -> Plan:
        """Everything on, and one step finer than ``plan`` in each number."""
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
        return replace(plan, settings=settings)

    def discretisation(self, settings: Settings) -> float:
        """Relative error that the numbers in ``settings`` are predicted to leave."""
        return self.evidence.error(*(Part(*both) for both in zip(COUNTED, counted(settings), strict=True))).value

    def trace(self, trial: Trial, seed: int) -> SampledLight:
        """Light of a ``trial``, by the family's classes, from a ``seed``."""
        sampling = Sampling(by_pixel=False, target=trial.target)
        return trace_light(trial.bench, trial.plan, self.family.lighting, seed, sampling, self.job.progress)


def warmed(stand: Stand, trial: Trial) -> Callable[[], None]:
    """What compiles the kernels of a ``trial`` at a ``stand`` by one sample, the first time that it is called."""
    done: list[bool] = []

    def ready() -> None:
        """Trace one sample, once."""
        if not done:
            once = replace(trial.plan, settings=sampled(trial.plan.settings, 1))
            stand.trace(replace(trial, plan=once, target=at_once), stand.seed)
            done.append(True)

    return ready


def stacked(expected: ExpectedFrames) -> tuple[FloatArray, float]:
    """All ``expected`` frames (shots, pixels, pixels) and their relative Monte Carlo error. MitsimError when all are
    dark."""
    formed = list(expected)
    frames = np.stack([frame.irradiance for frame in formed])
    if not frames.any():
        raise MitsimError("all frames are dark; nothing can be compared")
    noise = sum(frame.variance * frame.irradiance.size for frame in formed)
    return frames, float(np.sqrt(noise / np.square(frames).sum()))
