"""The plan of a capture, as an object, as JSON for the command line, and in a file."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import pydantic

from mitsim.bench.effects import EFFECTS
from mitsim.bench.request import Request
from mitsim.core.configuration import Configuration, Drawn, refusal, takes
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, cut
from mitsim.core.files import MOST_BYTES, json_text, plain, read_json, write_text
from mitsim.core.images import from_above, table
from mitsim.core.job import Cost
from mitsim.light.settings import Estimate, Settings
from mitsim.version import __version__

if TYPE_CHECKING:
    from matplotlib.axes import Axes

State = Literal["exact", "approximate", "off"]
_REPORTED = (
    "effects", "accuracy", "predicted_seconds", "predicted", "settings", "warnings", "predicted_range",
    "sampling_target", "systematic_error", "systematic_bound", "asked_seconds", "colour", "notes",
)  # fmt: skip
"""Keys of the command line's JSON, besides bytes; those that plans no longer have are null."""
FORMAT = 1
"""Version of a plan's file."""


@dataclass(frozen=True)
class PlanRow:
    name: str
    state: State
    reason: str
    error_if_off: float | None
    seconds: float


@dataclass(frozen=True)
class Plan:
    """Settings of the factored estimator for one capture, with their reasons.

    Attributes
    ----------
    effects
        A row for each effect and each number.
    predicted_seconds, predicted
        Time from start to finish, and seconds by stage.
    accuracy, sampling_target
        Relative error that is to be kept, and the Monte Carlo error at which sampling stops.
    systematic_error, systematic_bound
        Predicted relative error of all that is left out or made coarse, with signs, and its 95 % bound.
    warnings, notes
        Reasons why a result will be flagged, and choices that were made safely instead of measured more closely.
    request, cost, made_of
        Request, predicted cost, and properties of the bench that the plan depends on; None without a request.
    asked_seconds
        Time of the whole run that decided the accuracy; None if the accuracy was asked for.
    colour
        ``chosen`` of the ``candidates`` mono and lines, with the error that each leaves; None if nothing was to choose.
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
    request: Request | None = None
    cost: Cost | None = None
    asked_seconds: float | None = None
    colour: Mapping[str, Any] | None = None
    notes: tuple[str, ...] = ()
    made_of: Mapping[str, Any] | None = None

    @check_arguments
    def row(self, name: str) -> PlanRow:
        """Return the row of the effect or number ``name``; raise MitsimError if there is none."""
        rows = {row.name: row for row in self.effects}
        if name not in rows:
            raise MitsimError(f"plan: no row {name!r}; there are {', '.join(rows)}")
        return rows[name]

    def total(self, noise: Estimate) -> Estimate:
        """Return the total error of frames with the Monte Carlo error ``noise``."""
        systematic = self.systematic_error, self.systematic_bound
        return Estimate(*(math.hypot(*both) for both in zip(systematic, noise, strict=True)))

    @check_arguments
    def taking(self, **seconds: float) -> Plan:
        """Return the plan with other predicted ``seconds`` of some stages."""
        stages = {**self.predicted, **seconds}
        return replace(self, predicted=stages, predicted_seconds=sum(stages.values()))

    def block(self) -> dict[str, Any]:
        from mitsim.light.passes import PASSES  # with what traces them: a plan that is read needs no renderer

        samples = {f"{row.key or row.name}_samples": row.predicted_samples(self.settings) for row in PASSES.values()}
        derived = {name: getattr(self.settings, name) for name in ("coarse_cells", "followed_width")}
        settings = {**asdict(self.settings), "effects": sorted(self.settings.effects), **derived, **samples}
        del settings["samples"]
        own = replace(self, request=None, cost=None, made_of=None)
        return {**{name: value for name, value in asdict(own).items() if value is not None}, "settings": settings}

    # ---- In a file, and for another bench

    @check_arguments
    def save(self, path: Path | str) -> Path:
        """Write the plan to the JSON file ``path``, which is replaced as a whole, and return it.

        Raises MitsimError for a plan without a request, or if the file cannot be written.
        """
        known = self.known_request
        asked = {name: getattr(known, name) for name in ("patterns", "seconds", "seed", "effects")}
        asked |= known.model_dump(mode="json", exclude_unset=True)
        settings = {**asdict(self.settings), "effects": sorted(self.settings.effects)}
        own = plain({**asdict(replace(self, request=None)), "settings": settings, "request": asked})
        text = json_text({"kind": "plan", "format": FORMAT, "sha256": _digest(own), "plan": own})
        if len(text) > MOST_BYTES:
            raise MitsimError(f"plan {path}: would take {len(text)} bytes, and at most {MOST_BYTES} are read; keep it")
        write_text(path, text)
        return Path(path)

    @staticmethod
    @check_arguments
    def load(path: Path | str) -> Plan:
        """Load the plan in the file ``path`` that :meth:`save` or ``mitsim plan -o`` wrote.

        Raises MitsimError for a file that cannot be read, contains no plan, was changed or written by another version.
        """
        data, where = read_json(path), f"plan {path}"
        if not isinstance(data, dict) or data.get("kind") != "plan":
            raise MitsimError(f"{where}: is no file of a plan; give one that `mitsim plan -o` wrote")
        writer: Any = data
        for name in ("plan", "made_of", "version", "mitsim"):
            writer = writer.get(name) if isinstance(writer, dict) else None
        if writer != __version__:
            raise MitsimError(f"{where}: was made by mitsim {cut(str(writer))}, and this is {__version__}; plan anew")
        try:
            file = PlanFile.model_validate_json(json.dumps(data))
        except pydantic.ValidationError as error:
            raise refusal(PlanFile, error, where) from error
        except MitsimError as error:  # of the request
            raise MitsimError(f"{where}: plan.request: {error}") from error
        unknown = sorted(file.plan.settings.effects - set(EFFECTS))
        if unknown:
            raise MitsimError(f"{where}: plan.settings.effects: no effect {cut(unknown[0])!r}; plan anew")
        if file.sha256 != _digest(data["plan"]):
            raise MitsimError(
                f"{where}: was changed since mitsim wrote it; plan anew, or change it in Python and save it"
            )
        return file.plan

    @property
    def known_request(self) -> Request:
        if self.request is None:
            raise ArgumentError("plan", "was decided without a request; make it by bench.plan")
        return self.request

    @check_arguments
    def request_with(self, changes: Mapping[str, Any]) -> Request:
        """Return the request with other values of some fields.

        Raises MitsimError for an invalid value, or one that needs another plan.
        """
        planned = self.known_request
        request = planned.with_values(**changes)
        for name in ("accuracy", "seconds", "effects"):
            if getattr(request, name) != getattr(planned, name):
                raise ArgumentError(name, f"{_words(getattr(request, name))}: {self.made_for(name)}")
        return request

    def made_for(self, name: str) -> str:
        return f"the plan was made for {_words(getattr(self.known_request, name))}; plan anew"

    @check_arguments
    def check_made_of(self, deciding: Mapping[str, Any]) -> None:
        """Raise ArgumentError, with the difference, for a plan of a bench with other ``deciding`` properties."""
        if self.made_of is None:
            raise ArgumentError("plan", "was decided without a bench; make it by bench.plan")
        for what, here in deciding.items():
            differs = _difference(self.made_of.get(what), here)
            if differs is not None:
                place, planned, found = differs
                one, other = (
                    "none" if value is None else cut(str(value).partition(", sha256")[0], 60)
                    for value in (planned, found)
                )
                alike = what == "scene" or one == other  # checksums, or what is cut before it differs
                differs_by = f"the content of {place.strip()} differs" if alike else (f"{place}{one} then, {other} now")
                raise ArgumentError(
                    "plan",
                    f"was made for another {what}: {differs_by}; use the same {what}, or plan again (only seed, "
                    "exposure, sensor noise and output may differ)",
                )

    def payload(self) -> dict[str, Any]:
        block = {**self.block(), "warnings": self.warnings}
        cost = {"memory": self.cost.memory_bytes, "disk": self.cost.disk_bytes} if self.cost else {}
        return {
            **{key: block.get(key) for key in _REPORTED},
            **{f"predicted_{what}_bytes": count for what, count in cost.items()},
        }

    @takes(Drawn)
    def plot(self, quantity: Literal["error", "seconds"] = "error", ax: Axes | None = None, **figure: Any) -> Axes:
        """Draw the error of omitting each effect, or the seconds of each stage, and return the axes."""
        return from_above("report.plots", "draw_plan")(self, quantity, ax, **figure)

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
            f"Predicted: {self.predicted_seconds:.2f} s. Omitted and approximated effects add an error of "
            f"{self.systematic_error:.1e}, at most {self.systematic_bound:.1e}.",
        )
        headings = ("effect", "state", "reason", "error if off", "time [s]")
        return table(
            f"Plan at accuracy {self.accuracy:g}", headings, cells, (*facts, *self.notes, *self.warnings), numbers=2
        )


# ---- Files of plans


class PlanFile(Configuration, defer_build=True):
    kind: Literal["plan"]
    """Kind of file."""
    format: int = pydantic.Field(ge=1, le=FORMAT)
    """Version of this format."""
    sha256: str
    """Checksum of `plan` as JSON with sorted keys; a file that was changed is refused."""
    plan: Plan
    """Fields of `mitsim.Plan`, with its request and the bench's properties."""


def _digest(own: Any) -> str:
    return hashlib.sha256(json.dumps(own, sort_keys=True).encode()).hexdigest()


def _difference(one: Any, other: Any, place: str = "") -> tuple[str, Any, Any] | None:
    if isinstance(one, dict) and isinstance(other, dict):
        one, other = ({**each, "mask": each.get("mask_plate") or each.get("mask")} for each in (one, other))
        each = (_difference(one.get(name), other.get(name), f"{name} ") for name in dict.fromkeys([*one, *other]))
        return next(filter(None, each), None)
    return None if one == other else (place, one, other)


def _words(value: Any) -> str:
    if isinstance(value, dict):
        return ",".join(f"{'+' if on else '-'}{name}" for name, on in value.items()) or "none"
    return repr(value)
