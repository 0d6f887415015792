"""What the accuracy study found: rows, parts and the judge's own error in; JSON, text and figures out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from matplotlib.figure import Figure

from mitsim.study.accuracy import figures
from mitsim.study.spreads import Extra, Spread, times

SOLVER = "mitsim study solver"
"""Where the part that no scene changes is measured."""


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

    def seconds_at(self, error: float) -> float:
        """Seconds of an unbiased estimator for another ``error``: it falls with 1/sqrt(samples)."""
        return self.spread.median * (self.error / error) ** 2

    def reaching(self, error: float) -> Row:
        """The row of the same estimator at the samples that would leave another ``error``."""
        more = (self.error / error) ** 2
        said = f"error falls with 1/sqrt(samples) from {self.setting}"
        setting = f"{float(self.setting.split()[0]) * more:.0e} spp"
        spread, noise = self.spread * more, self.mc_error / more**0.5
        return replace(self, setting=setting, spread=spread, error=error, mc_error=noise, extrapolated=said)

    def payload(self) -> dict[str, Any]:
        """As JSON."""
        known = {name: value for name, value in asdict(self).items() if name != "spread"}
        return {**known, **times(self.spread), "extrapolated": bool(self.extrapolated), "by": self.extrapolated}

    def line(self) -> str:
        """For people."""
        note = f"  extrapolated: {self.extrapolated}" if self.extrapolated else "  *" if self.on_front else ""
        return (
            f"{self.estimator:>9} {self.setting:<28} {self.spread!s:<36} error {self.error:.1e}  "
            f"Monte Carlo {self.mc_error:.1e}{note}"
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
        told = extra is not None and not extra.within_noise
        return {
            "name": self.name,
            "error_if_off": self.error_if_off,
            "error_bound": self.error_bound,
            "seconds": extra.median if extra is not None and told else None,
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


@dataclass(frozen=True)
class AccuracyFindings:
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

    def figures(self) -> dict[str, Figure]:
        """Error against the time of whole runs, and what each part buys for how much."""
        return {
            "accuracy.png": figures.front(self.rows, self.judge.error, self.sensor_noise),
            "effects.png": figures.parts(self.effects, self.parts_accuracy),
        }
