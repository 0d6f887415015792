"""Each effect, the anchors, layers, cells and lines left out in turn: a stand in; the error that is left, and the
seconds that each part takes, out."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

from mitsim.capture.bench import Bench
from mitsim.capture.choice import predicted
from mitsim.capture.effects import present
from mitsim.capture.evidence import Estimate, Part, Settings
from mitsim.capture.plan import Plan
from mitsim.capture.simulation import Simulation
from mitsim.study.accuracy.findings import PartCost
from mitsim.study.accuracy.judge import Judge
from mitsim.study.knobs import Stand, Trial, at_once, one_line, stacked, warmed, without
from mitsim.study.metrics import relative_error
from mitsim.study.spreads import Budget, Timed

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
    trial: Trial
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
        full = _filled(self._plan.settings, stand.finest(self._plan).settings)
        self.accuracy, self.seconds, settings = _sampled(stand, full)
        self.full = replace(self._plan, settings=settings)
        self._whole = self._timed(Trial("parts", "all", stand.bench, self.full, at_once))
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
        stand, evidence = self._stand, self._stand.evidence
        for name, less in without(settings, frozenset(present(stand.bench))):
            known = _NUMBERS.get(name, name)
            part = Part(known, 1) if known in evidence.ladders else Part(known)
            yield self._without(name, evidence.error(part), stand.bench, replace(self.full, settings=less))
        if len(stand.bench.spectrum.weights) > 1:
            mono = one_line(stand.bench)
            light = self._judge.light
            seen = replace(light, simulation=Simulation(mono, light.simulation.settings))
            shots = stand.few_shots
            frames, _ = stacked(seen.frames(stand.family.lighting.shots(shots), self._judge.facts.seed))
            error = relative_error(frames, self._judge.frames[shots])
            yield self._without(_LINES, Estimate(error, error), mono, self.full)

    def _without(self, name: str, error: Estimate, bench: Bench, plan: Plan) -> _Left:
        trial = Trial("parts", f"no {name}", bench, plan, at_once)
        return _Left(name, error, trial, self._timed(trial))

    def _timed(self, trial: Trial) -> Timed:
        """The light of a ``trial`` and its frames, with kernels compiled before the first time."""
        stand = self._stand
        ready = warmed(stand, trial)

        def again() -> float:
            """Seconds of transport and optics."""
            ready()
            started = time.perf_counter()
            stacked(stand.trace(trial, stand.seed).frames(stand.family.lighting, stand.seed))
            return time.perf_counter() - started

        return Timed(again)


def _filled(now: Settings, finer: Settings) -> Settings:
    """The settings ``now`` with what they leave out as ``finer`` ones have it."""
    return replace(
        now,
        effects=finer.effects,
        anchors=max(now.anchors, finer.anchors if now.anchors == 1 else 1),
        followed_anchors=max(now.followed_anchors, finer.followed_anchors if now.followed_anchors == 1 else 1),
        followed_width=finer.followed_width if now.followed_anchors == 1 else now.followed_width,
        occluded_anchors=max(now.occluded_anchors, finer.occluded_anchors if now.occluded_anchors == 1 else 1),
        layers=now.layers or finer.layers,
        subdivision=max(now.subdivision, finer.subdivision if now.subdivision == 1 else 1),
    )


def _sampled(stand: Stand, settings: Settings) -> tuple[float, float, Settings]:
    """The finest accuracy whose samples take at most _LONGEST_S at fixed paces, these seconds, and the settings."""
    for accuracy in _ACCURACIES:
        choice = predicted(accuracy, stand.evidence, settings, {})
        if choice.work <= _LONGEST_S:
            break
    return accuracy, choice.work, choice.settings


def _has(settings: Settings, name: str) -> bool:
    """Whether ``settings`` have a part."""
    numbers = {
        "anchors": settings.anchors,
        "layers": len(settings.depths),
        "cells": settings.subdivision,
        "followed-anchors": settings.followed_anchors,
        _LINES: 2,
    }
    return numbers[name] > 1 if name in numbers else name in settings.effects
