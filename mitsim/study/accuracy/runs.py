"""Whole runs of `mitsim capture`: accuracies in; seconds from opening the scene to the last file, and error, out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from mitsim.capture.cost import frame_seconds
from mitsim.capture.effects import present
from mitsim.capture.evidence import Settings, whole
from mitsim.capture.request import Request
from mitsim.capture.run import capture
from mitsim.core.arrays import FloatArray
from mitsim.core.job import Job
from mitsim.core.runs import Capture
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.study.accuracy.findings import Row
from mitsim.study.accuracy.judge import Judge
from mitsim.study.knobs import Stand
from mitsim.study.spreads import Budget, Timed


@dataclass(frozen=True, eq=False)
class _Run:
    """One run and its repeats: the ``accuracies`` that lead to it, its frames' error, and seconds of light alone."""

    accuracies: tuple[float, ...]
    timed: Timed
    light: list[float]
    found: list[tuple[float, float]]


class Runs:
    """Whole runs at several accuracies, each measured at least once.

    Parameters
    ----------
    stand, request, judge
        scene and family, what else is asked of a run, and what its frames are held against.
    opening
        seconds that count for every run.
    """

    def __init__(self, stand: Stand, request: Request, judge: Judge, opening: float) -> None:
        self._stand, self._judge, self._opening = stand, judge, opening
        # Speckle is drawn anew in every frame and is no error of the light.
        off = {"speckle": False} if "speckle" in present(stand.bench) else {}
        self._request = request.changed(effects={**request.effects, **off})
        self._runs: list[_Run] = []

    def measure(
        self, accuracies: Sequence[float], budget: Budget, share: float, whatever_it_takes: float | None = None
    ) -> None:
        """Run each of the ``accuracies`` once that fits and was not run; those that lead to the same settings are one.

        Parameters
        ----------
        accuracies
            all that the study knows: some of them may share their settings.
        budget, share
            time that is left, and the part of it that one run may take.
        whatever_it_takes
            run the group of this accuracy alone, and without asking for time.
        """
        known = {accuracy for run in self._runs for accuracy in run.accuracies}
        for group, predicted in sorted(self._groups(accuracies), key=lambda group: group[1]):
            first = whatever_it_takes in group
            if known.intersection(group) or (whatever_it_takes is not None and not first):
                continue
            name = f"accuracy {_listed(group)}"
            if first or budget.allows(name, budget.slower * predicted, share):
                run = self._begun(group)
                run.timed.seconds.append(run.timed.again())
                self._runs.append(run)
                budget.saw(run.timed.spread.median, predicted)

    @property
    def timed(self) -> list[Timed]:
        """What can be repeated."""
        return [run.timed for run in self._runs]

    @property
    def rows(self) -> list[Row]:
        """Of all runs, the loosest first."""
        return [
            Row(
                "factored",
                "accuracy",
                f"accuracy {_listed(run.accuracies)}",
                run.timed.spread + self._opening,
                *run.found[0],
                accuracies=run.accuracies,
            )
            for run in sorted(self._runs, key=lambda run: -min(run.accuracies))
        ]

    def light_seconds(self, accuracy: float) -> float:
        """Seconds of transport and optics of the run at an ``accuracy``."""
        return next(median(run.light) for run in self._runs if accuracy in run.accuracies)

    def _groups(self, accuracies: Sequence[float]) -> Iterator[tuple[tuple[float, ...], float]]:
        """Accuracies by the settings that they lead to, and the seconds that a run of them is predicted to take."""
        groups: dict[Settings, list[float]] = {}
        lit: dict[Settings, float] = {}
        for accuracy in sorted(accuracies, reverse=True):
            plan = self._stand.plan(accuracy)
            settings = _begun_with(plan.settings)
            groups.setdefault(settings, []).append(accuracy)
            lit[settings] = plan.predicted_seconds
        around = self._stand.look.seconds + sum(
            frame_seconds(self._stand.bench, len(self._stand.family.shots)).values()
        )
        for settings, group in groups.items():
            yield tuple(group), lit[settings] + around

    def _begun(self, accuracies: tuple[float, ...]) -> _Run:
        """A run at the tightest of its ``accuracies`` that was not made yet."""
        request = self._request.changed(accuracy=min(accuracies))
        light: list[float] = []
        found: list[tuple[float, float]] = []

        def again() -> float:
            """Seconds of the run."""
            job = Job()
            with TemporaryDirectory(prefix="mitsim-study-") as folder:
                shots = capture(self._stand.bench, request, job, Path(folder) / "run")
                seconds = job.clock.seconds()
                if not found:
                    error = self._judge.error(self._irradiance(shots))
                    found.append((error, shots.manifest.mc_error or 0.0))
            light.append(seconds["transport"] + seconds["optics"])
            return seconds["total"]

        return _Run(accuracies, Timed(again), light, found)

    def _irradiance(self, shots: Capture) -> FloatArray:
        """(shots, pixels, pixels) expected irradiance that a capture was exposed to [W m^-2]."""
        rig = self._stand.bench.rig
        unit = electrons_from_irradiance(1.0, shots.exposure_s, rig.sensor, rig.projector.effective_wavelength_nm)
        return np.asarray(shots.electrons, dtype=np.float64) / unit


def _begun_with(settings: Settings) -> Settings:
    """The same ``settings`` with the samples that are taken: parts of one are as good as a whole one."""
    end = "_samples"
    named = (each.name for each in fields(settings) if each.name.endswith(end))
    taken: dict[str, Any] = {name: float(whole(name.removesuffix(end), getattr(settings, name))) for name in named}
    return replace(settings, **taken)


def _listed(accuracies: Sequence[float]) -> str:
    return ", ".join(f"{accuracy:g}" for accuracy in accuracies)
