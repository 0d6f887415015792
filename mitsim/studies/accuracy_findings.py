"""What the accuracy study found: rows, parts and the judge's own error in; JSON, text and figures out."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, ClassVar

from matplotlib.figure import Figure

from mitsim.report.plots import FONT, Cost, costs, error_bars, stacked_bars
from mitsim.studies.framework.page import Part
from mitsim.studies.framework.run import Findings

SOLVER = "python benchmarks/solver.py --forms"
"""Command that measures the time of the solver, which depends on no scene."""


@dataclass(frozen=True)
class Row:
    """One setting of one estimator.

    Attributes
    ----------
    estimator, knob, setting
        ``factored``: a whole run; ``reference``: all frames of the scene's own integrator.
    spread
        wall seconds; of the reference those of one frame, times their number.
    error, mc_error
        against the judge, whose noise is taken off, and the row's own Monte Carlo error.
    accuracies
        that lead to this run.
    extrapolated
        "" where all was measured; else what was not.
    on_front
        no other measured row is as good in less time.
    stages
        of a whole run: seconds by stage, the median of each; those of starting and opening first.
    """

    estimator: str
    knob: str
    setting: str
    spread: Spread
    error: float
    mc_error: float
    accuracies: tuple[float, ...] = ()
    extrapolated: str = ""
    on_front: bool = False
    stages: Mapping[str, float] = field(default_factory=dict)

    def seconds_at(self, error: float) -> float:
        """Seconds of an unbiased estimator for another ``error``: it falls with 1/sqrt(samples)."""
        return self.spread.median * (self.error / error) ** 2

    def reaching(self, error: float) -> Row:
        """The row of the same estimator at the samples that would leave another ``error``."""
        more = (self.error / error) ** 2
        text = f"error falls with 1/sqrt(samples) from {self.setting}"
        setting = f"{float(self.setting.split()[0]) * more:.0e} spp"
        spread, noise = self.spread * more, self.mc_error / more**0.5
        return replace(self, setting=setting, spread=spread, error=error, mc_error=noise, extrapolated=text)

    def payload(self) -> dict[str, Any]:
        """As JSON."""
        known = {name: value for name, value in asdict(self).items() if name != "spread"}
        return {**known, **times(self.spread), "extrapolated": bool(self.extrapolated), "by": self.extrapolated}

    def line(self) -> str:
        """For people."""
        plan = f", plan {self.stages['plan']:.2g} s of it" if "plan" in self.stages else ""
        note = f"  extrapolated: {self.extrapolated}" if self.extrapolated else "  *" if self.on_front else ""
        return (
            f"{self.estimator:>9} {self.setting:<28} {self.spread!s:<36} error {self.error:.1e}  "
            f"Monte Carlo {self.mc_error:.1e}{plan}{note}"
        )


@dataclass(frozen=True)
class PartCost:
    """One part left out where all others are in.

    Attributes
    ----------
    name
        an effect, ``anchors``, ``layers``, ``cells``, ``followed-anchors``, ``lines`` of the projector, or surfaces.
    error_if_off, error_bound
        what leaving it out changes in the frames, relative, by the pilot's looks (``lines``: by the judge's light); at
        most, at 95 %.
    with_it, without
        seconds of transport and optics of all frames; None where that was not timed.
    in_plan
        whether the plan at the quoted accuracy has it.
    of
        the part that it is a share of; "" for one by itself.
    """

    name: str
    error_if_off: float
    error_bound: float
    with_it: Spread | None
    without: Spread | None
    in_plan: bool
    of: str = ""

    @property
    def label(self) -> str:
        """Its name among all."""
        return f"{self.of}: {self.name}" if self.of else self.name

    @property
    def extra(self) -> Extra | None:
        """What it takes."""
        return Extra.between(self.with_it, self.without) if self.with_it and self.without else None

    @property
    def cost(self) -> str:
        """That in words."""
        if self.extra is None:
            return "not timed"
        return f"{self.extra}, {'once' if self.repeats == 1 else f'{self.repeats} runs each'}"

    @property
    def repeats(self) -> int:
        """Of the one that was measured less often."""
        return min(self.with_it.repeats, self.without.repeats) if self.with_it and self.without else 0

    def payload(self) -> dict[str, Any]:
        """As JSON; ``seconds`` is None where noise hides it or nobody timed it."""
        extra = self.extra
        measured = extra is not None and not extra.within_noise
        return {
            "name": self.name,
            "error_if_off": self.error_if_off,
            "error_bound": self.error_bound,
            "seconds": extra.median if extra is not None and measured else None,
            "least_s": max(extra.least, 0.0) if extra else None,
            "most_s": max(extra.most, 0.0) if extra else None,
            "within_noise": None if extra is None else extra.within_noise,
            "repeats": self.repeats,
            "in_plan": self.in_plan,
            "of": self.of,
        }


@dataclass(frozen=True)
class JudgeFacts:
    """How far the judge is to be trusted: Monte Carlo error, predicted discretisation, what it took."""

    mc_error: float
    systematic_error: float
    seconds: float
    seed: int

    @property
    def error(self) -> float:
        """All in all."""
        return float((self.mc_error**2 + self.systematic_error**2) ** 0.5)


# -------- All rows in, text, figures and page out


@dataclass(frozen=True)
class AccuracyFindings(Findings):
    """All that was measured, and what did not fit in the time.

    Attributes
    ----------
    rows
        whole runs, then the reference.
    effects, parts_accuracy
        parts, shares of one after it, and the accuracy whose samples they were timed with.
    judge
        what errors are held against.
    sensor_noise
        relative, at equal peak; None for a camera without a full well.
    opening
        seconds of starting and opening the scene, which every whole run counts; empty where nobody timed them.
    speedup_at_equal_error
        how much longer the reference would take for the error of the run at ``quoted``, over that run's transport and
        optics; None where the reference was left out.
    left_out
        what did not fit, with the seconds that it was predicted to take.
    quoted, took
        the default accuracy, and seconds of the study.
    """

    rows: tuple[Row, ...]
    effects: tuple[PartCost, ...]
    parts_accuracy: float
    judge: JudgeFacts
    sensor_noise: float | None
    opening: Mapping[str, float]
    speedup_at_equal_error: float | None
    left_out: tuple[str, ...]
    quoted: float
    took: float
    title: ClassVar[str] = "What accuracy costs in time"

    def payload(self) -> dict[str, Any]:
        """The JSON of the command line."""
        return {
            **{name: getattr(self, name) for name in ("sensor_noise", "speedup_at_equal_error", "left_out", "took")},
            "rows": [row.payload() for row in self.rows],
            "effects": [part.payload() for part in self.effects],
            "parts_accuracy": self.parts_accuracy,
            "judge": asdict(self.judge),
            "opening": dict(self.opening),
            "extrapolated": "rows whose `extrapolated` is true were not measured; `by` says what was",
            "solver": SOLVER,
        }

    def lines(self) -> list[str]:
        """For people."""
        parts = [
            f"{part.label:<27} error without it {part.error_if_off:.1e} (at 95 % below {part.error_bound:.1e}), "
            f"time {part.cost}"
            f"{'' if part.in_plan else f'; not in the plan at {self.quoted:g}'}"
            for part in self.effects
        ]
        noise = [f"The sensor's noise is {self.sensor_noise:.1e} at equal peak."] if self.sensor_noise else []
        at = f"At the error of the run at {self.quoted:g} the reference would take"
        speedup, opening = self.speedup_at_equal_error, sum(self.opening.values())
        equal = [f"{at} {speedup:.1e} times as long (extrapolated)."] if speedup else []
        counted = f"opening the scene ({opening:.1f} s, once)" if opening else "planning (opening was not timed)"
        return [
            f"Whole runs, from {counted} to the last file; the reference, light alone:",
            *(row.line() for row in self.rows),
            "* nothing measured is as good in less time",
            f"Parts of transport and optics, at the samples of {self.parts_accuracy:g}:",
            *parts,
            f"The judge's own error: Monte Carlo {self.judge.mc_error:.1e}, taken off above, discretisation "
            f"predicted {self.judge.systematic_error:.1e} ({self.judge.seconds:.1f} s).",
            *noise,
            *equal,
            *(f"Left out, too slow: {name}" for name in self.left_out),
            f"What the solver's precision costs is the same for all scenes: {SOLVER}",
        ]

    @property
    def message(self) -> str:
        """What the run at the default accuracy takes, and how much longer the reference would."""
        own = [row for row in self.rows if self.quoted in row.accuracies]
        run = f"At {self.quoted:g} a run takes {own[0].spread.median:.1f} s" if own else ""
        speedup = self.speedup_at_equal_error
        more = f"the reference would take {float(f'{speedup:.2g}'):g} times as long as its light" if speedup else ""
        return "; ".join(part for part in (run, more) if part)

    def parts(self) -> Sequence[Part]:
        """Of the page: whole runs and the reference, and parts of the light."""
        runs = [
            (row.estimator, row.setting, f"{row.spread.median:.2g}", f"{row.error:.1e}", f"{row.mc_error:.1e}",
             row.extrapolated or ("best for its time" if row.on_front else ""))
            for row in self.rows
        ]  # fmt: skip
        light = [
            (part.label, f"{part.error_if_off:.1e}", f"{part.error_bound:.1e}", part.cost,
             "yes" if part.in_plan else "no")
            for part in self.effects
        ]  # fmt: skip
        noise = f" The sensor's noise is {self.sensor_noise:.1e} at equal peak." if self.sensor_noise else ""
        return [
            Part(
                "Whole runs and the reference",
                "Factored: a whole run, from opening the scene to the last file. Reference: all frames of the scene's "
                "own integrator, light alone. Errors are of the noise-free frames against the judge, whose own is "
                f"{self.judge.error:.1e}.{noise}",
                ("Estimator", "Setting", "Wall time [s]", "Error [1]", "Monte Carlo error [1]", ""),
                tuple(runs),
                ("accuracy.png", "stages.png"),
                tuple(f"Left out, too slow: {name}." for name in self.left_out),
            ),
            Part(
                "Parts of the light",
                "What the frames would be off by without each part alone, what that is below at 95 %, what the part "
                f"takes at the samples of {self.parts_accuracy:g}, and whether the plan at {self.quoted:g} has it.",
                ("Part", "Error without it [1]", "Below [1]", "Time", "Planned"),
                tuple(light),
                ("effects.png",),
            ),
        ]

    def figures(self) -> dict[str, Figure]:
        """Error against the time of whole runs, the stages of these, and what each part buys for how much."""
        panels: dict[str, list[Cost]] = {}
        for row in self.rows:
            whole = row.estimator == "factored"
            title = "opening the scene to the last file" if whole else "light alone; one frame was measured"
            seconds = row.spread.median, row.spread.least, row.spread.most
            cost = Cost(
                "whole runs" if whole else "reference, extrapolated",
                row.error,
                seconds,
                row.setting.removeprefix("accuracy "),
                not row.extrapolated,
            )
            panels.setdefault(title, []).append(cost)
        levels = {"error of what all is compared with": self.judge.error}
        levels |= {"sensor noise, exposure equal peak": self.sensor_noise} if self.sensor_noise else {}
        drawn = {"accuracy.png": costs(panels, "relative error of the frames [1]", levels)}
        runs = {row.setting: row.stages for row in self.rows if row.stages}
        drawn |= {"stages.png": stacked_bars(runs, "wall time [s]")}
        return drawn | {"effects.png": part_chart(self.effects, self.parts_accuracy)}


def part_chart(parts: Sequence[PartCost], accuracy: float) -> Figure:
    """The error that is left without each of some ``parts``, and what it is below at 95 %, by the part's name and the
    seconds that it takes with the samples of an ``accuracy``."""
    names = [
        f"{part.label}, {'not timed' if part.extra is None else part.extra}{'' if part.in_plan else ', not planned'}"
        for part in parts
    ]
    errors, bounds = (
        dict(zip(names, [getattr(part, name) for part in parts], strict=True))
        for name in ("error_if_off", "error_bound")
    )
    figure = error_bars(errors, bounds=bounds)
    figure.suptitle(f"Error that is left without each part of the light, and its time at {accuracy:g}", fontsize=FONT)
    return figure


# -------- Repeated times in, what they tell out

ROUNDS = 3
"""Fewest repeats that have a middle between a least and a most."""
_ALIKE = 0.1
"""Part of a time that two single runs of the same work differ by on an idle machine, and more on a busy one."""


@dataclass(frozen=True)
class Spread:
    """Seconds of so many ``repeats`` of the same work: ``median``, ``least`` and ``most``."""

    median: float
    least: float
    most: float
    repeats: int

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Spread:
        """Of measured ``seconds``, at least one."""
        return cls(statistics.median(seconds), min(seconds), max(seconds), len(seconds))

    def __add__(self, more: float) -> Spread:
        return Spread(self.median + more, self.least + more, self.most + more, self.repeats)

    def __mul__(self, factor: float) -> Spread:
        return Spread(self.median * factor, self.least * factor, self.most * factor, self.repeats)

    def __str__(self) -> str:
        if self.repeats == 1:
            return f"{self.median:.3g} s (once)"
        return f"{self.median:.3g} s ({self.least:.3g} to {self.most:.3g}, {self.repeats} runs)"


@dataclass(frozen=True)
class Extra:
    """Seconds that work takes beyond work without a part of it: a difference of two spreads.

    ``least`` and ``most`` are the ends that both spreads allow. Where ``least`` is not above 0 the part costs nothing
    that these repeats could tell.
    """

    median: float
    least: float
    most: float

    @classmethod
    def between(cls, with_it: Spread, without: Spread) -> Extra:
        """The difference of two spreads; single runs may be a tenth off either way.

        Parameters
        ----------
        with_it, without
            of the same work with and without the part.
        """
        wide, narrow = (_widen(each) for each in (with_it, without))
        return cls(with_it.median - without.median, wide.least - narrow.most, wide.most - narrow.least)

    @property
    def within_noise(self) -> bool:
        """Whether the difference may be chance."""
        return self.least <= 0

    def __str__(self) -> str:
        if self.within_noise:
            return f"within noise (at most {max(self.most, 0.0):.2g} s)"
        return f"{self.median:.2g} s ({self.least:.2g} to {self.most:.2g})"


def _widen(spread: Spread) -> Spread:
    """A single run with the spread that it was not given."""
    if spread.repeats > 1:
        return spread
    return Spread(spread.median, (1 - _ALIKE) * spread.median, (1 + _ALIKE) * spread.median, 1)


@dataclass
class Timed:
    """Work that can be done ``again``, which gives its seconds, and the ``seconds`` of each time so far."""

    again: Callable[[], float]
    seconds: list[float] = field(default_factory=list)

    @property
    def spread(self) -> Spread:
        """Of what was measured."""
        return Spread.of(self.seconds)


class Budget:
    """Wall seconds that a study may take, from now on, and what did not fit in them.

    ``seconds`` is all that it may take; ``slower`` what work takes here over what it is predicted to, by what was seen.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._started = time.perf_counter()
        self.left_out: list[str] = []
        self.slower = 1.0

    @property
    def left(self) -> float:
        """Seconds that are left."""
        return self.seconds - (time.perf_counter() - self._started)

    def saw(self, taken: float, predicted: float) -> None:
        """Work has ``taken`` so many seconds and was ``predicted`` to take others; a faster machine is not believed."""
        self.slower = max(taken / predicted, 1.0)

    def allows(self, name: str, seconds: float, share: float = 1.0, kept: float = 0.0) -> bool:
        """Whether work of so many predicted seconds fits; what does not is kept under its ``name``.

        Parameters
        ----------
        name, seconds
            of the work.
        share, kept
            part of what is left that it may take, less seconds that are kept for other work.
        """
        left = share * self.left - kept
        if seconds <= left:
            return True
        self.left_out.append(f"{name} (predicted {seconds:.0f} s, {max(left, 0.0):.0f} s were left)")
        return False

    def repeat(self, works: Iterable[Timed]) -> None:
        """Do all ``works`` again, round by round, so that a busy moment does not fall on one alone, and the shortest
        first, as long as there is time."""
        ordered = sorted(works, key=lambda work: work.spread.median)
        for _ in range(ROUNDS - 1):
            for work in ordered:
                if work.spread.most <= self.left:
                    work.seconds.append(work.again())


def times(spread: Spread) -> dict[str, float | int]:
    """A ``spread`` as JSON rows hold it: ``seconds``, ``least_s``, ``most_s``, ``repeats``."""
    found = asdict(spread)
    return {"seconds": found["median"], "least_s": found["least"], "most_s": found["most"], "repeats": found["repeats"]}
