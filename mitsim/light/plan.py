"""The effect plan: what was chosen and predicted in; what people and the command line read of it out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

from mitsim.bench.request import Request
from mitsim.core.errors import MitsimError, check_arguments
from mitsim.core.images import table
from mitsim.core.spectral_manifests import MONO
from mitsim.light.settings import Estimate, Settings

if TYPE_CHECKING:
    from mitsim.core.job import Cost

State = Literal["exact", "approximate", "off"]
_REPORTED = (
    "effects", "accuracy", "predicted_seconds", "predicted", "settings", "warnings", "predicted_range",
    "sampling_target", "systematic_error", "systematic_bound", "asked_seconds", "colour", "notes",
)  # fmt: skip
"""What the command line says of a plan, besides bytes."""


@dataclass(frozen=True)
class PlanRow:
    """One row of a plan.

    Attributes
    ----------
    name, state, reason
        of an effect or discretisation; a sentence.
    error_if_off
        relative change of the frames without it; None where no prediction was made.
    seconds
        what it adds.
    """

    name: str
    state: State
    reason: str
    error_if_off: float | None
    seconds: float


@dataclass(frozen=True)
class ColourCandidate:
    """One way to simulate the colours of a projector's light.

    Attributes
    ----------
    name
        ``mono``, ``bands:K`` or ``lines``.
    error
        what it leaves of the light's lines in direct light: relative rms error of the noise-free frames in electrons,
        of the worst band; None where that was not looked for.
    seconds
        predicted, from start to finish.
    """

    name: str
    error: float | None
    seconds: float


@dataclass(frozen=True)
class ColourChoice:
    """Which of several ways is taken.

    Attributes
    ----------
    chosen
        its name.
    candidates
        all of them, the cheapest first.
    """

    chosen: str
    candidates: tuple[ColourCandidate, ...]

    @property
    def taken(self) -> ColourCandidate:
        """The one that is chosen."""
        return next(each for each in self.candidates if each.name == self.chosen)

    def later(self, seconds: float) -> ColourChoice:
        """The same, every way by so many ``seconds`` longer."""
        return replace(self, candidates=tuple(replace(e, seconds=e.seconds + seconds) for e in self.candidates))

    @property
    def words(self) -> str:
        """What is said of it in one line."""
        errors = ", ".join(
            f"{each.name} {'not known' if each.error is None else f'{each.error:.1e}' if each.error else '0'}"
            for each in self.candidates
        )
        return f"Colour: {self.chosen} (error that each leaves: {errors})"


@dataclass(frozen=True)
class Plan:
    """Settings of the factored estimator for one capture, with their reasons.

    Attributes
    ----------
    accuracy
        relative error that is to be kept.
    effects
        a row for each effect and discretisation.
    predicted_seconds
        from start to finish, the sum of ``predicted``.
    settings
        what is simulated, and how finely.
    sampling_target
        relative Monte Carlo error at which sampling stops.
    systematic_error, systematic_bound
        what everything left out or made coarse is predicted to leave, with its signs, relative; at most, at 95 %.
    warnings
        why a result will be flagged.
    predicted
        seconds by stage.
    predicted_range
        between which nine of ten runs end, where few heavy paths bring most of the noise, so that their samples are not
        known; None where ``predicted_seconds`` tells it.
    request, cost
        what it is for, and what that takes; None where it was decided without them.
    asked_seconds
        for the whole run, of which the accuracy is the finest that they buy; None where the accuracy was asked for.
    colour
        what was weighed for the light's colours; None where that was not asked for.
    notes
        what was chosen without looking as closely as it could be, and why.
    """

    accuracy: float
    effects: tuple[PlanRow, ...]
    predicted_seconds: float
    settings: Settings
    sampling_target: float
    systematic_error: float
    systematic_bound: float
    warnings: tuple[str, ...]
    predicted: Mapping[str, float] = field(default_factory=dict)
    predicted_range: tuple[float, float] | None = None
    request: Request | None = None
    cost: Cost | None = None
    asked_seconds: float | None = None
    colour: ColourChoice | None = None
    notes: tuple[str, ...] = ()

    @check_arguments
    def row(self, name: str) -> PlanRow:
        """What is said of the effect or discretisation called ``name``; MitsimError when there is none."""
        rows = {row.name: row for row in self.effects}
        if name not in rows:
            raise MitsimError(f"plan: no row {name!r}; there are {', '.join(rows)}")
        return rows[name]

    def total(self, noise: Estimate) -> Estimate:
        """Error of frames with this Monte Carlo error, ``noise``, all in all."""
        systematic = self.systematic_error, self.systematic_bound
        return Estimate(*(math.hypot(*both) for both in zip(systematic, noise, strict=True)))

    @check_arguments
    def taking(self, **seconds: float) -> Plan:
        """The same plan, with the ``seconds`` of more stages in its prediction."""
        stages = {**self.predicted, **seconds}
        more = sum(stages.values()) - sum(self.predicted.values())
        colour = self.colour and self.colour.later(more)
        least, most = self.predicted_range or (0.0, 0.0)
        ends = self.predicted_range and (least + more, most + more)
        return replace(
            self, predicted=stages, predicted_seconds=sum(stages.values()), predicted_range=ends, colour=colour
        )

    def block(self) -> dict[str, Any]:
        """The plan as JSON holds it."""
        from mitsim.light.passes import PASSES  # with what traces them: a plan that is read needs no renderer

        samples = {row.samples_key: row.predicted_samples(self.settings) for row in PASSES.values()}
        settings = {**asdict(replace(self.settings, samples={})), "effects": sorted(self.settings.effects), **samples}
        del settings["samples"]
        own = replace(self, request=None, cost=None, colour=self.colour or self._uncoloured)
        return {**{name: value for name, value in asdict(own).items() if value is not None}, "settings": settings}

    def payload(self) -> dict[str, Any]:
        """What the command line reports."""
        block = {**self.block(), "warnings": self.warnings}
        cost = {"memory": self.cost.memory_bytes, "disk": self.cost.disk_bytes} if self.cost else {}
        return {
            **{key: block.get(key) for key in _REPORTED},
            **{f"predicted_{what}_bytes": count for what, count in cost.items()},
        }

    @property
    def range_words(self) -> str:
        """What is said of the range of seconds in one line; nothing where there is none."""
        if self.predicted_range is None:
            return ""
        least, most = self.predicted_range
        return (
            "Few heavy paths over sharp gloss bring most of the noise, so the samples are not known beforehand: "
            f"nine of ten such runs take {least:.0f} to {most:.0f} s."
        )

    @property
    def _uncoloured(self) -> ColourChoice | None:
        """Monochrome frames, where nothing else was asked for; None of light of some lines."""
        row = next((row for row in self.effects if row.name == "spectrum"), None)
        if row is None or row.state != "off":
            return None
        return ColourChoice(MONO, (ColourCandidate(MONO, row.error_if_off, self.predicted_seconds),))

    def __repr__(self) -> str:
        states = ", ".join(f"{row.name} {row.state}" for row in self.effects if row.state != "off")
        return f"Plan(accuracy {self.accuracy:g}: {states})"

    def _repr_html_(self) -> str:
        cells = [
            (
                row.name,
                row.state,
                row.reason,
                "-" if row.error_if_off is None else f"{row.error_if_off:.1e}" if row.error_if_off else "0",
                f"{row.seconds:.2f}",
            )
            for row in self.effects
        ]
        facts = (
            "Error if off: relative rms change of the frames without the effect.",
            f"Predicted: {self.predicted_seconds:.2f} s. {self.range_words} What is left out or made coarse adds up to "
            f"{self.systematic_error:.1e}, at most {self.systematic_bound:.1e}.",
        )
        headings = ("effect", "state", "reason", "error if off", "time [s]")
        return table(
            f"Plan at accuracy {self.accuracy:g}", headings, cells, (*facts, *self.notes, *self.warnings), numbers=2
        )
