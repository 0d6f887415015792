"""The effect plan: from measured evidence and an accuracy to what is simulated, why, and what it costs.

Accuracy is the relative rms error of the expected frames, ``||a - b|| / ||b||`` over all frames and pixels. An effect
is simulated when leaving it out would change the frames by more than that. Discretisations of effects that are on (how
many anchors, layers, cells) each take a part of the budget, and sampling gets what is left of its square.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from mitsim.capture.evidence import FOLLOWED, GROUPS, PHYSICAL, Evidence, Settings
from mitsim.core.errors import MitsimError

State = Literal["exact", "approximate", "off"]
LOWEST_ACCURACY, HIGHEST_ACCURACY = 1e-6, 0.3
SWITCHES = ("anchors", "layers", *PHYSICAL)
_RESIDUAL = 0.5
_FLOOR = 0.7
"""Sampling may always take this part of the accuracy, however much of it the rest has spent."""
_SAMPLING_MARGIN = 0.95
_FLAGGED = 1.5
"""Every effect is held to the accuracy by itself; their sum is reported, and flagged above this much of it."""
_FEWEST_DIRECT = 8.0
"""Samples a projector pixel: few are cheap, and a spectrum or a texture wants more than the frames' error tells."""
_COARSE = 0.4


@dataclass(frozen=True)
class Effect:
    """One row of the plan; ``error_if_off`` is None where no prediction was made, ``seconds`` is the extra cost."""

    name: str
    state: State
    reason: str
    error_if_off: float | None
    seconds: float


@dataclass(frozen=True)
class Plan:
    """Settings of the factored estimator for one capture, with their reasons.

    ``sampling_target`` is the relative Monte Carlo error at which sampling stops, ``systematic_error`` what everything
    left out or made coarse is predicted to leave. ``warnings`` say why a result will be flagged.
    """

    accuracy: float
    effects: tuple[Effect, ...]
    predicted_seconds: float
    settings: Settings
    sampling_target: float
    systematic_error: float
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class SceneFacts:
    """What the plan must know of the devices besides the pilot's evidence.

    ``absent`` gives the reason why an effect has nothing to act on; ``notes`` what to say of one that has.
    """

    absent: Mapping[str, str]
    notes: Mapping[str, str]
    keystone: float
    warnings: tuple[str, ...] = ()


def check_accuracy(accuracy: float) -> float:
    """The accuracy, or MitsimError when it is outside what the estimator can promise."""
    if not LOWEST_ACCURACY <= accuracy <= HIGHEST_ACCURACY:
        raise MitsimError(
            f"--accuracy {accuracy}: give a relative error from {LOWEST_ACCURACY:g} to {HIGHEST_ACCURACY:g}"
        )
    return accuracy


def parse_effects(text: str) -> dict[str, bool]:
    """``+ambient,-diffraction`` as {name: on}; MitsimError for a name that is no effect, or a missing sign."""
    chosen: dict[str, bool] = {}
    for word in filter(None, (part.strip() for part in text.split(","))):
        if word[0] not in "+-" or word[1:] not in SWITCHES:
            raise MitsimError(
                f"--effects {text!r}: {word!r} is not +NAME or -NAME; the names are {', '.join(SWITCHES)}"
            )
        if chosen.get(word[1:], word[0] == "+") != (word[0] == "+"):
            raise MitsimError(f"--effects {text!r}: {word[1:]} is switched both on and off; keep one")
        chosen[word[1:]] = word[0] == "+"
    return chosen


def decide(
    accuracy: float, evidence: Evidence, captures: int, facts: SceneFacts, forced: Mapping[str, bool] | None = None
) -> Plan:
    """Choose effects, anchors, layers and cells for ``accuracy``; ``forced`` overrides effects by name."""
    check_accuracy(accuracy)
    forced = forced or {}
    on = frozenset(name for name in PHYSICAL if forced.get(name, evidence.effect_error.get(name, 0.0) > accuracy))
    anchors = _count(evidence.anchor_error, accuracy, forced.get("anchors"))
    layers = _count(evidence.layer_error, accuracy, forced.get("layers"))
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
    left_out = {name: error for name, error in evidence.effect_error.items() if name not in on}
    left = math.hypot(
        evidence.anchor_error[anchors],
        evidence.layer_error[layers],
        evidence.cell_error[cells],
        coarse.error,
        evidence.unresolved,
        *left_out.values(),
    )
    target = _SAMPLING_MARGIN * math.sqrt(max(accuracy**2 - left**2, (_FLOOR * accuracy) ** 2))
    cost = _Cost(evidence, settings, captures, target)
    settings = cost.settings
    effects = (
        _anchors(anchors, evidence, accuracy, cost),
        _layers(layers, evidence, accuracy, cost),
        _cells(cells, evidence),
        *(_physical(name, name in on, evidence, facts, accuracy, cost, forced) for name in PHYSICAL),
        *_fixed(facts),
    )
    return Plan(
        accuracy=accuracy,
        effects=effects,
        predicted_seconds=cost.total,
        settings=settings,
        sampling_target=target,
        systematic_error=left,
        warnings=facts.warnings + _warnings(accuracy, left, evidence, left_out, anchors, layers, cells),
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
    # Indirect and ambient light is seen from the sensor's centre alone.
    seen = sum(evidence.effect_error.get(name, 0.0) for name in settings.effects & {"interreflection", "ambient"})
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
    chosen = next((one for one in choices if one.error <= _COARSE * accuracy), best)
    return replace(chosen, error=math.hypot(centre, chosen.error))


class _Cost:
    """Seconds of a capture with some settings, by the paces that the pilot measured."""

    def __init__(self, evidence: Evidence, settings: Settings, captures: int, target: float) -> None:
        self.evidence, self.captures = evidence, captures
        many = settings.anchors > 1
        efforts = {
            "direct": evidence.direct,
            "anchored": replace(evidence.anchored, paths=evidence.anchored.paths * settings.anchors**2 * many),
        }
        if settings.effects & FOLLOWED:
            efforts |= {"indirect": evidence.indirect, "other": evidence.other}
        # The fewest paths for a sum of variances; not the least time, for settings must not depend on the pace.
        parts = {name: math.sqrt(effort.variance * effort.paths) for name, effort in efforts.items()}
        single, whole = target * math.sqrt(GROUPS), sum(parts.values())
        samples = {
            f"{name}_samples": max(
                _FEWEST_DIRECT if name == "direct" else 1.0,
                effort.noise.samples_for(single * math.sqrt(parts[name] / whole)) if parts[name] else 0.0,
            )
            for name, effort in efforts.items()
        }
        self.settings: Settings = replace(settings, **samples)  # type: ignore[arg-type]

    @property
    def total(self) -> float:
        waves = "diffraction" in self.settings.effects
        return (
            self.evidence.connecting(self.settings, self.settings.anchors)
            + self.evidence.following(self.settings)
            + self.forming(self.settings.anchors, len(self.settings.depths), waves)
        )

    def forming(self, anchors: int, layers: int, waves: bool) -> float:
        """Half of a frame's time goes with its rows of cells; anchors add rows in coarse cells (measured)."""
        coarse = (layers if self.settings.coarse_layers else 1) * self.settings.coarse_cells
        parts = (anchors if anchors > 1 else 0) + ("interreflection" in self.settings.effects)
        rows = (1 + layers * self.settings.subdivision) / 2 + parts * coarse / 4
        terms = 1.0 if waves else 1 / self.evidence.terms
        return self.captures * self.evidence.seconds_per_frame * rows * terms


def _count(errors: Mapping[int, float], accuracy: float, forced: bool | None) -> int:
    """One if that is good enough, else the fewest that leave a part of the accuracy (failing that, the most known)."""
    if forced is False or (forced is None and errors[1] <= accuracy):
        return 1
    several = [count for count in sorted(errors) if count > 1]
    return next((count for count in several if errors[count] <= _RESIDUAL * accuracy), several[-1] if several else 1)


def _anchors(anchors: int, evidence: Evidence, accuracy: float, cost: _Cost) -> Effect:
    errors = evidence.anchor_error
    if anchors == 1:
        reason = f"falloff, gloss and parallax over the sensor: one anchor leaves {errors[1]:.1e}"
        return Effect("anchors", "off", f"{reason} of {accuracy:g} allowed", errors[1], 0.0)
    reason = f"falloff, gloss and parallax: {anchors}x{anchors} anchors leave {errors[anchors]:.1e}"
    waves, layers = "diffraction" in cost.settings.effects, len(cost.settings.depths)
    seconds = evidence.connecting(cost.settings, anchors) - evidence.connecting(cost.settings, 1)
    seconds += cost.forming(anchors, layers, waves) - cost.forming(1, layers, waves)
    return Effect("anchors", "approximate", reason, errors[1], seconds)


def _layers(layers: int, evidence: Evidence, accuracy: float, cost: _Cost) -> Effect:
    errors = evidence.layer_error
    if layers == 1:
        reason = (
            f"the light is seen at {evidence.depth:.1f} mm; one layer leaves {errors[1]:.1e} of {accuracy:g} allowed"
        )
        return Effect("layers", "off", reason, errors[1], 0.0)
    far, near = evidence.layers[layers][0], evidence.layers[layers][-1]
    reason = f"the light is seen from {near:.0f} to {far:.0f} mm; {layers} layers leave {errors[layers]:.1e}"
    seconds = cost.forming(cost.settings.anchors, layers, "diffraction" in cost.settings.effects)
    return Effect("layers", "approximate", reason, errors[1], seconds * (1 - 1 / layers))


def _cells(cells: int, evidence: Evidence) -> Effect:
    reason = f"{cells}x{cells} cells of even light a projector pixel leave {evidence.cell_error[cells]:.1e}"
    return Effect("cells", "approximate", reason, max(evidence.cell_error.values()), 0.0)


def _physical(
    name: str,
    on: bool,
    evidence: Evidence,
    facts: SceneFacts,
    accuracy: float,
    cost: _Cost,
    forced: Mapping[str, bool],
) -> Effect:
    error = evidence.effect_error.get(name)
    if error is None:
        reason = facts.absent.get(name, "nothing in the scene calls for it")
        return Effect(name, "exact" if on else "off", reason, 0.0, 0.0)
    note = facts.notes.get(name, "")
    reason = f"left out, the frames change by {error:.1e}; {accuracy:g} allowed"
    if name in forced:
        reason = f"by --effects; {reason}"
    if note:
        reason = f"{note}; {reason}"
    state: State = "exact" if on else "off"
    return Effect(name, state, reason, error, _seconds(name, cost) if on else 0.0)


def _seconds(name: str, cost: _Cost) -> float:
    anchors, layers = cost.settings.anchors, len(cost.settings.depths)
    if name in FOLLOWED:
        return cost.evidence.following(cost.settings)
    if name == "diffraction":
        return cost.forming(anchors, layers, True) - cost.forming(anchors, layers, False)
    return 0.0


def _fixed(facts: SceneFacts) -> tuple[Effect, ...]:
    keystone = (
        f"the projector's window is {facts.keystone:.1f} of its pixels off a square; responses are not separable"
        if facts.keystone
        else "the projector faces the aligned plane squarely"
    )
    return (
        Effect("keystone", "exact", keystone, None, 0.0),
        Effect(
            "spectrum", "off", "one panchromatic reflectance; wavelengths differ in the mask's shadow only", None, 0.0
        ),
        Effect("sensor-noise", "exact", "Poisson, full well, read noise and quantisation of each frame", None, 0.0),
    )


def _warnings(
    accuracy: float,
    left: float,
    evidence: Evidence,
    left_out: Mapping[str, float],
    anchors: int,
    layers: int,
    cells: int,
) -> tuple[str, ...]:
    if left <= _FLAGGED * accuracy:
        return ()
    if evidence.unresolved > accuracy:
        return (
            f"{evidence.unresolved:.0%} of the direct light comes over lobes too sharp to sample, and the frames lack "
            "most of it; give those surfaces more roughness, or make them perfect mirrors (conductor)",
        )
    parts = {
        f"{anchors}x{anchors} anchors": evidence.anchor_error[anchors],
        f"{layers} layer{'s' if layers > 1 else ''}": evidence.layer_error[layers],
        "cells": evidence.cell_error[cells],
        **{f"no {name}": error for name, error in left_out.items()},
    }
    worst = sorted(parts, key=lambda name: -parts[name])[:2]
    said = " and ".join(f"{name} ({parts[name]:.1e})" for name in worst)
    return (f"what is left out or made coarse adds up to {left:.1e}, above the accuracy {accuracy:g}: mostly {said}",)
