"""Each effect, the anchors, layers, cells and lines left out in turn: a stand in; the error that is left, and the
seconds that each part takes, out."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property, reduce
from operator import add

import numpy as np

from mitsim.acquire.exposure import NoiseTarget
from mitsim.acquire.reference import render, show_pattern
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import EFFECTS, Physics, names, present
from mitsim.bench.request import Exposure
from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.devices.patterns import PatternFamily
from mitsim.light.light import SampledLight, Sampling, Target, trace_light, traced_again
from mitsim.light.passes import PASSES
from mitsim.light.plan import Plan
from mitsim.light.sampling import first_samples
from mitsim.light.settings import (
    COUNTED,
    GROUPS,
    REPLICATES,
    Approximation,
    ErrorCovariance,
    Estimate,
    PilotResult,
    Settings,
)
from mitsim.light.simulation import Simulation
from mitsim.metrics import relative_error
from mitsim.optics.frames import ExpectedFrames
from mitsim.planner import pilot
from mitsim.planner.choose import counts_of, predicted_candidate
from mitsim.planner.planner import SceneFacts, explain_plan
from mitsim.studies.ablation import MOST, OfOrders, ablations, reform
from mitsim.studies.accuracy_findings import Budget, JudgeFacts, PartCost, Row, Spread, Timed

_LONGEST_S = 3.5
"""Seconds of light with all parts in: a dozen parts are then timed once in less than the study has."""
_ACCURACIES = (1e-3, 3e-3, 1e-2, 3e-2, 0.1)
"""Whose samples are tried, the default first."""
_LINES = "lines"
_NUMBERS = {"followed-anchors": "followed_anchors"}
"""Parts that the pilot calls otherwise."""


@dataclass(frozen=True, eq=False)
class _Left:
    """One part left out: by itself, what that changes, and how long the light takes."""

    name: str
    error: Estimate
    timed: Timed


class Parts:
    """All parts in, and each left out in turn, with as many samples, in one round.

    Parameters
    ----------
    stand, judge
        scene and family, and light that needs no tracing to be formed otherwise.

    Attributes
    ----------
    full, accuracy, seconds
        the plan with all parts in, the accuracy whose samples it has, and the seconds that these are predicted to take.
    """

    def __init__(self, stand: Stand, judge: Judge) -> None:
        self._stand, self._judge = stand, judge
        self._plan = stand.plan(stand.accuracy)
        full = _fill(self._plan.settings, stand.finest(self._plan).settings)
        self.accuracy, self.seconds, settings = _choose_samples(stand, full)
        self.full = replace(self._plan, settings=settings)
        self._whole = self._time(stand.bench, self.full)
        self._left = sorted(self._parts(settings), key=lambda part: -part.error.value)

    def measure(self, budget: Budget, share: float) -> None:
        """Time all parts in, and each left out, the one that matters most first, as far as the time goes.

        Parameters
        ----------
        budget, share
            time that is left, and the part of it that all of them may take.
        """
        kept = max(budget.left, 0.0) * (1 - share)
        for name, timed in (("all", self._whole), *((part.name, part.timed) for part in self._left)):
            # The rehearsal that compiles kernels takes about as long as the work.
            predicted_s = 2 * (self._whole.spread.most if self._whole.seconds else budget.slower * self.seconds)
            if budget.allows(f"time of {name}", predicted_s, kept=kept):
                timed.seconds.append(timed.again())

    @property
    def timed(self) -> list[Timed]:
        """What can be repeated."""
        return [timed for timed in (self._whole, *(part.timed for part in self._left)) if timed.seconds]

    @property
    def costs(self) -> tuple[PartCost, ...]:
        """What each part buys and takes, those first that matter most."""
        return tuple(
            PartCost(
                name=part.name,
                error_if_off=part.error.value,
                error_bound=part.error.bound,
                with_it=self._whole.spread if self._whole.seconds else None,
                without=part.timed.spread if part.timed.seconds else None,
                in_plan=_has(self._plan.settings, part.name),
            )
            for part in self._left
        )

    def _parts(self, settings: Settings) -> Iterator[_Left]:
        stand, pilot_result = self._stand, self._stand.pilot_result
        for name, less in ablations(settings, frozenset(present(stand.bench))):
            known = _NUMBERS.get(name, name)
            part = Approximation(known, 1) if known in pilot_result.ladders else Approximation(known)
            yield self._without(name, pilot_result.error(part), stand.bench, replace(self.full, settings=less))
        if len(stand.bench.spectrum.weights) > 1:
            mono = one_line(stand.bench)
            light = self._judge.light
            seen = replace(light, simulation=Simulation(mono, light.simulation.settings))
            shots = stand.few_shots
            frames, _ = stack_frames(seen.frames(stand.family.lighting.shots(shots), self._judge.facts.seed))
            error = relative_error(frames, self._judge.frames[shots])
            yield self._without(_LINES, Estimate(error, error), mono, self.full)

    def _without(self, name: str, error: Estimate, bench: Apparatus, plan: Plan) -> _Left:
        return _Left(name, error, self._time(bench, plan))

    def _time(self, bench: Apparatus, plan: Plan) -> Timed:
        """The light of a ``plan`` and its frames, with kernels compiled before the first time."""
        stand = self._stand

        @cache
        def warm_up() -> None:
            once = replace(plan, settings=with_samples(plan.settings, 1))
            stand.trace(once, stand.seed, bench, at_once)

        def again() -> float:
            """Seconds of transport and optics."""
            warm_up()
            started = time.perf_counter()
            light = stand.trace(plan, stand.seed, bench, at_once)
            stack_frames(light.frames(stand.family.lighting, stand.seed))
            return time.perf_counter() - started

        return Timed(again)


def _fill(now: Settings, finer: Settings) -> Settings:
    """The settings ``now`` with what they leave out as ``finer`` ones have it."""
    return replace(
        now,
        effects=finer.effects,
        anchors=max(now.anchors, finer.anchors if now.anchors == 1 else 1),
        followed_anchors=max(now.followed_anchors, finer.followed_anchors if now.followed_anchors == 1 else 1),
        occluded_anchors=max(now.occluded_anchors, finer.occluded_anchors if now.occluded_anchors == 1 else 1),
        layers=now.layers or finer.layers,
        subdivision=max(now.subdivision, finer.subdivision if now.subdivision == 1 else 1),
    )


def _choose_samples(stand: Stand, settings: Settings) -> tuple[float, float, Settings]:
    """The finest accuracy whose samples take at most _LONGEST_S at fixed paces, these seconds, and the settings."""
    for accuracy in _ACCURACIES:
        choice = predicted_candidate(accuracy, stand.pilot_result, settings, {})
        if choice.work <= _LONGEST_S:
            break
    return accuracy, choice.work, choice.settings


def _has(settings: Settings, name: str) -> bool:
    numbers = {
        "anchors": settings.anchors,
        "layers": len(settings.depths),
        "cells": settings.subdivision,
        "followed-anchors": settings.followed_anchors,
        _LINES: 2,
    }
    return numbers[name] > 1 if name in numbers else name in settings.effects


# -------- The answer that errors are held against

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
    light: SampledLight
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
        light = stand.trace(finest, seed)
        expected = light.frames(stand.family.lighting, seed)
        frames, mc_error = stack_frames(expected)
        facts = JudgeFacts(mc_error, stand.discretisation(finest.settings), time.perf_counter() - started, seed)
        return cls(stand, light, expected, frames, facts)

    def error(self, frames: FloatArray) -> float:
        """Relative error of all ``frames``, without the judge's own noise: seeds differ, so squares add. At least half
        that noise, below which chance decides."""
        distance, noise = relative_error(frames, self.frames), self.facts.mc_error
        return max(math.sqrt(max(distance**2 - noise**2, 0.0)), noise / 2)

    def reference(self, budget: Budget) -> Iterator[Row]:
        """Rows that compare the reference with light that has the same effects, as far as the ``budget`` goes."""
        stand, shots = self.stand, self.stand.family.shots
        index, bench = len(shots) // 2, stand.bench
        lighting = stand.family.lighting.shots([index])
        with show_pattern(bench, stand.family.light(shots[index])):
            started = time.perf_counter()
            render(bench, "reference", _SAMPLES[0], 1e-3, stand.seed)  # compiles the kernels
            predicted_s = time.perf_counter() - started
            answer: FloatArray | None = None
            for spp in _SAMPLES:
                if not budget.allows(f"reference at {spp} spp", predicted_s, _SHARE):
                    return
                if answer is None:
                    answer, _ = stack_frames(self.of_reference().frames(lighting, self.facts.seed))
                rendered = render(bench, "reference", spp, 1e-3, stand.seed, job=stand.job)
                one, predicted_s = rendered.facts["seconds"], _GROWTH * rendered.facts["seconds"]
                error = relative_error(rendered.mean.mean(axis=2), answer[0])
                note = f"one of {len(shots)} frames was measured, {one:.2g} s" if len(shots) > 1 else ""
                spread = Spread.of([one]) * len(shots)
                yield Row("reference", "spp", f"{spp} spp", spread, error, rendered.mc_error, extrapolated=note)

    def of_reference(self) -> SampledLight:
        """The same light without what the reference lacks; traced anew where that has shaped it."""
        stand, plan, absent = self.stand, self.light.plan, names(lambda effect: not effect.in_reference)
        if not any(EFFECTS[name].retraced(Physics.of(stand.bench)) for name in absent & plan.settings.effects):
            return reform(self.light, absent)
        plain = replace(plan, settings=replace(plan.settings, effects=plan.settings.effects - absent))
        return stand.trace(plain, self.facts.seed)

    @cached_property
    def sensor_noise(self) -> float | None:
        """Relative noise of the sensor at equal peak; None for a camera without a full well."""
        if not np.isfinite(self.stand.bench.sensor.full_well_e):
            return None
        return NoiseTarget(self.stand.bench.devices, Exposure(), 1.0)(self.expected)


def _within(stand: Stand, plan: Plan, seconds: float) -> tuple[Plan, float]:
    """The ``plan`` with the least noise whose light is predicted to take at most so many ``seconds``, or with the
    noise of its accuracy, and what its light takes."""
    accuracy = plan.accuracy / _FINEST_OVER
    while True:
        # What its numbers leave is stated; sampling alone is given the time.
        choice = predicted_candidate(accuracy, stand.pilot_result, plan.settings, {})
        if choice.work <= seconds or accuracy > plan.accuracy:
            return replace(plan, settings=choice.settings, sampling_target=choice.target), choice.work
        accuracy *= _STEP


# -------- Light over two, three, four and more surfaces

PARENT = "interreflection"
"""The effect that this light is a share of."""
_ORDERS = {"2 surfaces": (2, 2), "3 surfaces": (3, 3), "4 surfaces": (4, 4), "5 or more": (5, MOST)}
"""Rows, and the orders of light of each. Each surface keeps its albedo of the light at most: beyond four little is
left."""
_FEWER = 4
"""Times fewer samples than the seconds are measured with tell what light changes in the frames: to a few percent of
itself, as an order is traced alone."""


class Orders:
    """Light by the number of surfaces that turn it, mirrors not counted, where the plan follows it.

    What an order changes is told by light of that order alone, in independent looks; what it takes, by following light
    to that order over following it to the one before, frames of followed light included.

    Parameters
    ----------
    stand, judge
        scene and family, and frames that changes are relative to.
    parts
        whose settings and samples the light has.
    """

    def __init__(self, stand: Stand, judge: Judge, parts: Parts) -> None:
        self._stand, self._judge, self._settings = stand, judge, parts.full.settings
        simulation = Simulation(stand.bench, self._settings)
        self._samples, self._whole_s = first_samples(simulation), parts.seconds
        self._changes: ErrorCovariance | None = None
        self._followed: dict[int, Timed] = {}

    def measure(self, budget: Budget, share: float) -> None:
        """What each order changes, and then what it takes, as far as the time goes.

        Parameters
        ----------
        budget, share
            time that is left, and the part of it that all of them may take.
        """
        if PARENT not in self._stand.plan(self._stand.accuracy).settings.effects:
            return
        kept, whole = max(budget.left, 0.0) * (1 - share), budget.slower * self._whole_s
        if not budget.allows("light by surfaces", (1 + len(_ORDERS) / _FEWER) * whole, kept=kept):
            return
        # This compiles the one kernel of all orders, too.
        changes = {Approximation(name): self._looks(*orders) for name, orders in _ORDERS.items()}
        energy = float(np.square(self._judge.frames[self._stand.few_shots]).sum())
        self._changes = ErrorCovariance.between(changes, energy)
        for last in (1, *(most for _, most in _ORDERS.values())):
            most = "all" if last == MOST else "one" if last == 1 else f"up to {last}"
            if budget.allows(f"time of light followed over {most}", whole, kept=kept):
                timed = self._followed[last] = Timed(self._following(last))
                timed.seconds.append(timed.again())

    @property
    def timed(self) -> list[Timed]:
        """What can be repeated."""
        return list(self._followed.values())

    @property
    def costs(self) -> tuple[PartCost, ...]:
        """What each order buys and takes, the first one first; none where the plan follows no light."""
        if self._changes is None:
            return ()
        return tuple(
            PartCost(
                name,
                *self._changes.estimate([Approximation(name)]),
                with_it=self._spread(most),
                without=self._spread(fewest - 1),
                in_plan=True,
                of=PARENT,
            )
            for name, (fewest, most) in _ORDERS.items()
        )

    def _spread(self, last: int) -> Spread | None:
        return self._followed[last].spread if last in self._followed else None

    def _light(self, simulation: Simulation, samples: Mapping[str, int]) -> SampledLight:
        again = replace(self._judge.light, seed=self._stand.seed, samples=samples)
        return traced_again(again, simulation, "orders")

    def _looks(self, fewest: int, most: int) -> FloatArray:
        """(REPLICATES, shots, pixels, pixels) frames of some shots by light of some orders alone."""
        fewer = {name: max(1, samples // _FEWER) for name, samples in self._samples.items()}
        light = self._light(OfOrders(self._stand.bench, self._settings, fewest, most), fewer)
        replicates = [
            reduce(add, light.groups[look::REPLICATES]) / (GROUPS // REPLICATES) for look in range(REPLICATES)
        ]
        shots = self._stand.family.lighting.shots(self._stand.few_shots)
        formed = [replace(light, groups=(look,)).frames(shots, self._stand.seed) for look in replicates]
        return np.array([[frame.irradiance for frame in frames] for frames in formed])

    def _following(self, last: int) -> Callable[[], float]:
        """Seconds of light that is followed over at most so many surfaces, and of its frames."""
        bench, settings = self._stand.bench, self._settings
        if last == 1:
            plain = replace(settings, effects=settings.effects - {PARENT})
            simulation = OfOrders(bench, plain, 0, MOST)
            if not simulation.passes:
                return lambda: 0.0
            self._light(simulation, dict.fromkeys(self._samples, 1))  # compiles its kernels
        else:
            simulation = OfOrders(bench, settings, 0, last)

        def again() -> float:
            started = time.perf_counter()
            light = self._light(simulation, self._samples)
            for _ in light.frames(self._stand.family.lighting, self._stand.seed):
                pass
            return time.perf_counter() - started

        return again


# -------- One knob at a time

_FEW_SHOTS = 8
"""Shots whose frames tell what changes all of them: they differ by a few percent."""


def at_once(expected: ExpectedFrames) -> float:
    """A target that any error of the ``expected`` frames meets: sampling stops after its first round."""
    return float("inf")


def with_samples(settings: Settings, samples: int) -> Settings:
    """``settings`` whose first round takes so many ``samples`` of a projector pixel and of a cell in each group."""
    each = {name: samples / 8 if row.anchors else float(samples) for name, row in PASSES.items() if name != "sharp"}
    return replace(settings, samples={**settings.samples, **each})


def one_line(bench: Apparatus) -> Apparatus:
    """``bench`` with a projector of its effective wavelength alone."""
    model = bench.projector
    changes = {"wavelengths_nm": (model.effective_wavelength_nm,), "radiant_shares": (1.0,)}
    return replace(bench, devices=replace(bench.devices, projector=model.model_copy(update=changes)))


@dataclass(frozen=True, eq=False)
class Stand:
    """What all trials share: scene, family, seed and job, and what the pilot found of them down to ``accuracy``."""

    bench: Apparatus
    family: PatternFamily
    seed: int
    job: Job
    accuracy: float

    @cached_property
    def pilot_runs(self) -> pilot.PilotRuns:
        """The pilot's."""
        return pilot.PilotRuns(self.bench, self.family.lighting, self.accuracy, self.seed)

    @cached_property
    def pilot_result(self) -> PilotResult:
        """Of the pilot."""
        return self.pilot_runs.pilot_result

    @cached_property
    def few_shots(self) -> Labels:
        """Numbers of some shots, evenly spread."""
        return np.unique(np.linspace(0, len(self.family.shots) - 1, _FEW_SHOTS).astype(np.int64))

    def plan(self, accuracy: float) -> Plan:
        """What the pilot result calls for at an ``accuracy``."""
        return explain_plan(accuracy, self.pilot_result, SceneFacts.of(self.bench))

    def finest(self, plan: Plan) -> Plan:
        """Everything on, and one step finer than ``plan`` in each number."""
        pilot_result, now = self.pilot_result, plan.settings
        anchors, layers, cells, followed, occluded = (
            next((finer for finer in pilot_result.ladders[name] if finer > count), count)
            for name, count in zip(COUNTED, counts_of(now), strict=True)
        )
        settings = replace(
            now,
            anchors=anchors,
            layers=pilot_result.layers[layers] if layers > 1 else (),
            subdivision=cells,
            effects=frozenset(present(self.bench)),
            followed_anchors=followed,
            occluded_anchors=occluded,
            coarse_layers=True,
        )
        return replace(plan, settings=settings)

    def discretisation(self, settings: Settings) -> float:
        """Relative error that the numbers in ``settings`` are predicted to leave."""
        return self.pilot_result.error(
            *(Approximation(*both) for both in zip(COUNTED, counts_of(settings), strict=True))
        ).value

    def trace(
        self, plan: Plan, seed: int, bench: Apparatus | None = None, target: Target | None = None
    ) -> SampledLight:
        """Light by the family's classes.

        Parameters
        ----------
        plan, seed
            of the light.
        bench
            another one than the stand's own.
        target
            error to stop at where it is not the plan's own.
        """
        sampling = Sampling(by_pixel=False, target=target)
        return trace_light(bench or self.bench, plan, self.family.lighting, seed, sampling, self.job.progress)


def stack_frames(expected: ExpectedFrames) -> tuple[FloatArray, float]:
    """All ``expected`` frames (shots, pixels, pixels) and their relative Monte Carlo error. MitsimError when all are
    dark."""
    formed = list(expected)
    frames = np.stack([frame.irradiance for frame in formed])
    if not frames.any():
        raise MitsimError("all frames are dark; nothing can be compared")
    noise = sum(frame.variance * frame.irradiance.size for frame in formed)
    return frames, float(np.sqrt(noise / np.square(frames).sum()))
