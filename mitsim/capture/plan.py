"""The effect plan: from measured evidence and an accuracy to what is simulated, why, and what it costs.

Accuracy is the relative rms error of the expected frames, ``||a - b|| / ||b||`` over all frames and pixels. An effect
is simulated when leaving it out would change the frames by more than that. Discretisations of effects that are on (how
many anchors, layers, cells) each take a part of the budget, and sampling gets what is left of its square.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from mitsim.capture.effects import EFFECTS, Effect, names
from mitsim.capture.evidence import GROUPS, Effort, Evidence, Settings
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.pictures import table

if TYPE_CHECKING:
    from mitsim.capture.bench import Bench
    from mitsim.capture.request import Request
    from mitsim.core.resources import Cost

State = Literal["exact", "approximate", "off"]
LOWEST_ACCURACY, HIGHEST_ACCURACY = 1e-6, 0.3
"""Below, single precision in the renderer (6e-8 a connection) and the pilot's samples tell nothing; above, no frame is
worth its name."""
_RESIDUAL = 0.5
"""Part of the accuracy that one discretisation may leave: a quarter of its square."""
_FLOOR = 0.7
"""Lower bound of the sampling error budget, as a part of the accuracy: half of its square."""
_SAMPLING_MARGIN = 0.95
"""Sampling aims below its budget, because its error is itself known to a few percent from eight captures."""
_FLAGGED = 1.5
"""A systematic error above this much of the accuracy is flagged: each effect is held to the accuracy by itself, and two
that just meet it add up to 1.41."""
_FEWEST_DIRECT = 8.0
"""Samples a projector pixel: few are cheap, and a spectrum or a texture wants more than the frames' error tells."""
_COARSE = 0.4
"""Part of the accuracy that coarse cells may leave, below ``_RESIDUAL`` because they hold several kinds of light."""


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
class Plan:
    """Settings of the factored estimator for one capture, with their reasons.

    Attributes
    ----------
    accuracy
        relative error asked for.
    effects
        a row for each effect and discretisation.
    predicted_seconds
        of transport and optics.
    settings
        what is simulated, and how finely.
    sampling_target
        relative Monte Carlo error at which sampling stops.
    systematic_error
        what everything left out or made coarse is predicted to leave, relative.
    warnings
        why a result will be flagged.
    request, cost
        what it is for, and what that takes; None where it was decided without them.
    """

    accuracy: float
    effects: tuple[PlanRow, ...]
    predicted_seconds: float
    settings: Settings
    sampling_target: float
    systematic_error: float
    warnings: tuple[str, ...]
    request: Request | None = None
    cost: Cost | None = None

    def row(self, name: str) -> PlanRow:
        """What is said of the effect or discretisation called ``name``; MitsimError when there is none."""
        rows = {row.name: row for row in self.effects}
        if name not in rows:
            raise MitsimError(f"plan: no row {name!r}; there are {', '.join(rows)}")
        return rows[name]

    def block(self) -> dict[str, Any]:
        """The plan as JSON holds it."""
        settings = {**asdict(self.settings), "effects": sorted(self.settings.effects)}
        own = replace(self, request=None, cost=None)
        return {**{name: value for name, value in asdict(own).items() if value is not None}, "settings": settings}

    def payload(self) -> dict[str, Any]:
        """What the command line reports."""
        keys = ("effects", "accuracy", "predicted_seconds", "settings", "warnings")
        block = {**self.block(), "warnings": self.warnings}
        cost = {"memory": self.cost.memory_bytes, "disk": self.cost.disk_bytes} if self.cost else {}
        return {
            **{key: block[key] for key in keys},
            "sampling_target": self.sampling_target,
            "systematic_error": self.systematic_error,
            **{f"predicted_{what}_bytes": count for what, count in cost.items()},
        }

    def __repr__(self) -> str:
        states = ", ".join(f"{row.name} {row.state}" for row in self.effects if row.state != "off")
        return f"Plan(accuracy {self.accuracy:g}: {states})"

    def _repr_html_(self) -> str:
        cells = [
            (row.name, row.state, row.reason, _shown(row.error_if_off), f"{row.seconds:.2f}") for row in self.effects
        ]
        facts = (
            "Error if off: relative rms change of the frames without the effect.",
            f"Predicted: {self.predicted_seconds:.2f} s. "
            f"What is left out or made coarse adds up to {self.systematic_error:.1e}.",
        )
        headings = ("effect", "state", "reason", "error if off", "time [s]")
        return table(f"Plan at accuracy {self.accuracy:g}", headings, cells, (*facts, *self.warnings), numbers=2)


def _shown(error: float | None) -> str:
    return "-" if error is None else f"{error:.1e}" if error else "0"


@dataclass(frozen=True)
class SceneFacts:
    """What a plan says of a bench's devices besides the pilot's evidence.

    Attributes
    ----------
    notes
        what to say of an effect that the bench has, by name.
    keystone
        how far the projector's window is off a square [projector pixels].
    warnings
        what the model of the devices does not cover.
    """

    notes: Mapping[str, str]
    keystone: float
    warnings: tuple[str, ...] = ()

    @classmethod
    def of(cls, bench: Bench) -> SceneFacts:
        """The facts of ``bench``."""
        geometry, warnings = bench.geometry, []
        if bench.field_stop_cuts:
            warnings.append(
                "the field stop (fov) cuts into the projector's window for part of the sensor; its edge is blurred "
                "over the anchors, so open it or accept an error there"
            )
        if geometry.wall_shift_features >= 1:
            warnings.append(
                f"mask_thickness {geometry.mask_thickness} mm shifts the far face by "
                f"{geometry.wall_shift_features:.1f} features at the field stop; the two-face model holds below 1"
            )
        longest = float(bench.spectrum.wavelengths_nm.max())
        if geometry.mask_feature * 1e6 < longest:
            warnings.append(
                f"mask_feature {geometry.mask_feature:g} mm is below the wavelength of {longest:.0f} nm; scalar theory "
                "of masks needs features above it, so the shadow is a guess"
            )
        notes = {name: effect.note(bench) for name, effect in EFFECTS.items()}
        return cls(notes, bench.loaded.pixels.keystone, tuple(warnings))


def check_accuracy(accuracy: float) -> float:
    """``accuracy``, or ArgumentError when it is outside what the estimator can promise."""
    if not LOWEST_ACCURACY <= accuracy <= HIGHEST_ACCURACY:
        raise ArgumentError(
            "accuracy", f"{accuracy}: give a relative error from {LOWEST_ACCURACY:g} to {HIGHEST_ACCURACY:g}"
        )
    return accuracy


def decide(
    accuracy: float, evidence: Evidence, shots: int, facts: SceneFacts, switches: Mapping[str, bool] | None = None
) -> Plan:
    """Choose effects, anchors, layers and cells.

    Parameters
    ----------
    accuracy
        relative rms error of the expected frames.
    evidence
        what the pilot measured.
    shots
        frames of the family, for the time that forming them takes.
    facts
        what to say of the devices.
    switches
        effects that the user switches on or off, by name.
    """
    check_accuracy(accuracy)
    switches = switches or {}
    on = frozenset(name for name in EFFECTS if switches.get(name, evidence.effect_error.get(name, 0.0) > accuracy))
    anchors = _count(evidence.anchor_error, accuracy, switches.get("anchors"))
    layers = _count(evidence.layer_error, accuracy, switches.get("layers"))
    cells = next(
        (choice for choice, error in evidence.cell_error.items() if error <= _RESIDUAL * accuracy),
        min(evidence.cell_error, key=lambda choice: evidence.cell_error[choice]),
    )
    settings = Settings(
        depth=evidence.depth,
        anchors=anchors,
        layers=evidence.layers[layers] if layers > 1 else (),
        subdivision=cells,
        effects=on,
    )
    coarse = _coarse(evidence, settings, accuracy)
    settings = replace(settings, coarse_cells=coarse.cells, coarse_layers=coarse.layers)
    parts = {
        f"anchors ({anchors}x{anchors})": evidence.anchor_error[anchors],
        f"layers ({layers})": evidence.layer_error[layers],
        f"cells ({cells}x{cells})": evidence.cell_error[cells],
        "coarse cells": coarse.error,
        "light over sharp lobes": evidence.unresolved,
        "light over mirrors or curved glass both ways (left out)": evidence.left_out,
        **{f"{name} (off)": error for name, error in evidence.effect_error.items() if name not in on},
    }
    systematic = math.hypot(*parts.values())
    target = _SAMPLING_MARGIN * math.sqrt(max(accuracy**2 - systematic**2, (_FLOOR * accuracy) ** 2))
    cost = _Cost(evidence, allocate_samples(evidence, settings, target), shots)
    rows = (
        _anchors(evidence, accuracy, cost),
        _layers(evidence, accuracy, cost),
        _cells(evidence, settings),
        *(_row(effect, accuracy, cost, facts, name in switches) for name, effect in EFFECTS.items()),
        *_fixed(facts),
    )
    return Plan(
        accuracy=accuracy,
        effects=rows,
        predicted_seconds=cost.total,
        settings=cost.settings,
        sampling_target=target,
        systematic_error=systematic,
        warnings=facts.warnings + _warnings(accuracy, systematic, parts, evidence.unresolved),
    )


@dataclass(frozen=True)
class _Coarse:
    """Cells and layers of the light that is small or smooth, and the error that they and one anchor for it leave."""

    cells: int
    layers: bool
    error: float


def _coarse(evidence: Evidence, settings: Settings, accuracy: float) -> _Coarse:
    """The coarsest choice that fits: its error counts only for the part of the light that is filed in it."""
    part = evidence.anchor_error[1] if settings.anchors > 1 else 0.0
    from_centre = settings.effects & names(lambda effect: effect.from_centre)
    seen = sum(evidence.effect_error.get(name, 0.0) for name in EFFECTS if name in from_centre)
    centre = min(seen, 1.0) * evidence.anchor_error[1] / (evidence.direct_part or 1.0)
    if "interreflection" in settings.effects:
        part = math.hypot(part, evidence.effect_error["interreflection"])
    count = len(settings.depths)
    choices = [
        _Coarse(cells, layers, part * math.hypot(error, evidence.layer_error[count if layers else 1]))
        for cells, error in evidence.cell_error.items()
        for layers in ((False, True) if count > 1 else (False,))
    ]
    best = min(choices, key=lambda choice: choice.error)
    chosen = next((choice for choice in choices if choice.error <= _COARSE * accuracy), best)
    return replace(chosen, error=math.hypot(centre, chosen.error))


def allocate_samples(evidence: Evidence, settings: Settings, target: float) -> Settings:
    """The samples that a Monte Carlo error is predicted to need, put into settings.

    The fewest paths for a sum of variances; not the least time, for settings must not depend on the pace.

    Parameters
    ----------
    evidence
        noise of each kind of light.
    settings
        what is simulated.
    target
        relative Monte Carlo error.
    """
    paths = evidence.anchored.paths * settings.anchors**2 * (settings.anchors > 1)
    efforts: dict[str, Effort] = {"direct": evidence.direct, "anchored": replace(evidence.anchored, paths=paths)}
    if settings.effects & names(lambda effect: effect.followed):
        efforts |= {"indirect": evidence.indirect, "from_camera": evidence.from_camera}
    parts = {name: math.sqrt(effort.variance * effort.paths) for name, effort in efforts.items()}
    single, whole = target * math.sqrt(GROUPS), sum(parts.values())
    samples = {
        f"{name}_samples": max(
            _FEWEST_DIRECT if name == "direct" else 1.0,
            effort.noise.samples_for(single * math.sqrt(parts[name] / whole)) if parts[name] else 0.0,
        )
        for name, effort in efforts.items()
    }
    return replace(settings, **samples)  # type: ignore[arg-type]


@dataclass(frozen=True)
class _Cost:
    """Seconds of a capture with some settings, by the paces that the pilot measured."""

    evidence: Evidence
    settings: Settings
    shots: int

    @property
    def total(self) -> float:
        connecting = self.evidence.connecting(self.settings, self.settings.anchors)
        return connecting + self.evidence.following(self.settings) + self.forming()

    def forming(self, anchors: int | None = None, layers: int | None = None, waves: bool | None = None) -> float:
        """Seconds of forming all frames, with a change where one is given.

        Half of a frame's time goes with its rows of cells; anchors add rows in coarse cells (measured).
        """
        anchors = anchors or self.settings.anchors
        layers = layers or len(self.settings.depths)
        waves = bool(self.settings.effects & names(lambda effect: effect.in_shadow)) if waves is None else waves
        coarse = (layers if self.settings.coarse_layers else 1) * self.settings.coarse_cells
        parts = (anchors if anchors > 1 else 0) + ("interreflection" in self.settings.effects)
        rows = (1 + layers * self.settings.subdivision) / 2 + parts * coarse / 4
        terms = 1.0 if waves else 1 / self.evidence.terms
        return self.shots * self.evidence.seconds_per_frame * rows * terms

    def of(self, effect: Effect) -> float:
        """Seconds that an effect takes which is on."""
        if effect.followed:
            return self.evidence.following(self.settings)
        return self.forming(waves=True) - self.forming(waves=False) if effect.in_shadow else 0.0


def _count(errors: Mapping[int, float], accuracy: float, switch: bool | None) -> int:
    """One if that is good enough, else the fewest that leave a part of the accuracy (failing that, the most known)."""
    if switch is False or (switch is None and errors[1] <= accuracy):
        return 1
    several = [count for count in sorted(errors) if count > 1]
    return next((count for count in several if errors[count] <= _RESIDUAL * accuracy), several[-1] if several else 1)


def _anchors(evidence: Evidence, accuracy: float, cost: _Cost) -> PlanRow:
    errors, anchors = evidence.anchor_error, cost.settings.anchors
    if anchors == 1:
        reason = f"falloff, gloss and parallax over the sensor: one anchor leaves {errors[1]:.1e}"
        return PlanRow("anchors", "off", f"{reason} of {accuracy:g} allowed", errors[1], 0.0)
    reason = f"falloff, gloss and parallax: {anchors}x{anchors} anchors leave {errors[anchors]:.1e}"
    seconds = evidence.connecting(cost.settings, anchors) - evidence.connecting(cost.settings, 1)
    return PlanRow("anchors", "approximate", reason, errors[1], seconds + cost.forming() - cost.forming(anchors=1))


def _layers(evidence: Evidence, accuracy: float, cost: _Cost) -> PlanRow:
    errors, layers = evidence.layer_error, len(cost.settings.depths)
    if layers == 1:
        left = f"one layer leaves {_shown(errors[1])} of {accuracy:g} allowed"
        reason = f"the light is seen at {evidence.depth:.1f} mm; {left}"
        return PlanRow("layers", "off", reason, errors[1], 0.0)
    far, near = cost.settings.depths[0], cost.settings.depths[-1]
    reason = f"the light is seen from {near:.0f} to {far:.0f} mm; {layers} layers leave {errors[layers]:.1e}"
    return PlanRow("layers", "approximate", reason, errors[1], cost.forming() * (1 - 1 / layers))


def _cells(evidence: Evidence, settings: Settings) -> PlanRow:
    cells = settings.subdivision
    reason = f"{cells}x{cells} cells of even light a projector pixel leave {evidence.cell_error[cells]:.1e}"
    return PlanRow("cells", "approximate", reason, max(evidence.cell_error.values()), 0.0)


def _row(effect: Effect, accuracy: float, cost: _Cost, facts: SceneFacts, by_user: bool) -> PlanRow:
    on = effect.name in cost.settings.effects
    state: State = "exact" if on else "off"
    error = cost.evidence.effect_error.get(effect.name)
    if error is None:
        return PlanRow(effect.name, state, effect.absent or "nothing in the scene calls for it", 0.0, 0.0)
    said = [facts.notes.get(effect.name, ""), "switched by the user" if by_user else ""]
    said.append(f"left out, the frames change by {_shown(error)}; {accuracy:g} allowed")
    return PlanRow(effect.name, state, "; ".join(filter(None, said)), error, cost.of(effect) if on else 0.0)


def _fixed(facts: SceneFacts) -> tuple[PlanRow, ...]:
    keystone = (
        f"the projector's window is {facts.keystone:.1f} of its pixels off a square; responses are not separable"
        if facts.keystone
        else "the projector faces the aligned plane squarely"
    )
    spectrum = "one panchromatic reflectance; wavelengths differ in the mask's shadow only"
    noise = "Poisson, full well, read noise and quantisation of each frame"
    return (
        PlanRow("keystone", "exact" if facts.keystone else "off", keystone, None, 0.0),
        PlanRow("spectrum", "off", spectrum, None, 0.0),
        PlanRow("sensor-noise", "exact", noise, None, 0.0),
    )


def _warnings(accuracy: float, systematic: float, parts: Mapping[str, float], unresolved: float) -> tuple[str, ...]:
    if systematic <= _FLAGGED * accuracy:
        return ()
    if unresolved > accuracy:
        return (
            f"{unresolved:.0%} of the direct light comes over lobes too sharp to sample, and the frames lack "
            "most of it; give those surfaces more roughness, or make them perfect mirrors (conductor)",
        )
    largest = max(parts, key=lambda name: parts[name])
    return (
        f"predicted systematic error {systematic:.1e} exceeds the requested {accuracy:g}; "
        f"largest: {largest}, {parts[largest]:.1e}",
    )
