"""The effect plan: from measured evidence and an accuracy to what is simulated, why, and what it costs.

Accuracy is the relative rms error of the expected frames, ``||a - b|| / ||b||`` over all frames and pixels. The
discretisations (anchors, cells, depth) may use most of that budget and sampling gets the rest; the cheapest combination
that fits is taken. Effects that this version cannot simulate are listed too, so that no one takes their absence for a
finding.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

from mitsim.core.errors import MitsimError

State = Literal["exact", "approximate", "off"]
LOWEST_ACCURACY, HIGHEST_ACCURACY = 1e-6, 0.3
_SYSTEMATIC_SHARE = 0.8
_SAMPLING_MARGIN = 0.95
_FEWEST_BATCHES = 8.0
_NOMINAL_PACE = 5e-3, 8e-8
"""Seconds a batch and a path, on two cores."""
_SECONDS_PER_FRAME = 2.5e-3


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

    ``anchors`` a side of the sensor, ``subdivision`` cells a side of a projector pixel, ``depth`` [mm] of the light,
    ``sampling_target`` relative Monte Carlo error at which sampling stops, ``systematic_error`` what the
    discretisations are predicted to leave. ``warnings`` say why a result will be flagged.
    """

    accuracy: float
    effects: tuple[Effect, ...]
    predicted_seconds: float
    anchors: int
    subdivision: int
    depth: float
    sampling_target: float
    systematic_error: float
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class SceneFacts:
    """What the plan must know of a scene besides the pilot's evidence."""

    other_emitters: int
    fresnel_number: float
    wavelength_nm: float
    keystone: float
    field_stop_cuts: bool = False


def check_accuracy(accuracy: float) -> float:
    """The accuracy, or MitsimError when it is outside what the estimator can promise."""
    if not LOWEST_ACCURACY <= accuracy <= HIGHEST_ACCURACY:
        raise MitsimError(
            f"--accuracy {accuracy}: give a relative error from {LOWEST_ACCURACY:g} to {HIGHEST_ACCURACY:g}"
        )
    return accuracy


def decide(
    accuracy: float,
    anchor_error: Mapping[int, float],
    cell_error: Mapping[int, float],
    sampling_error: Mapping[int, float],
    cells: Mapping[int, int],
    seconds_per_batch: float,
    seconds_per_path: float,
    depth: float,
    depth_error: float,
    captures: int,
    facts: SceneFacts,
) -> Plan:
    """Choose anchors and cells for ``accuracy``.

    ``anchor_error`` by anchors a side; ``cell_error``, ``sampling_error`` (one path a cell) and ``cells`` (number in
    the grid) by cells a side of a projector pixel; ``captures`` is the number of frames.
    """
    check_accuracy(accuracy)

    def systematic(anchors: int, subdivision: int) -> float:
        return math.hypot(anchor_error[anchors], cell_error[subdivision])

    def room(anchors: int, subdivision: int) -> float:
        """What is left of the squared budget for sampling."""
        left = systematic(anchors, subdivision)
        # Where the discretisation alone breaks the budget, sampling far below it would buy nothing.
        return max(accuracy**2 - left**2, (0.5 * left) ** 2)

    def batches(anchors: int, subdivision: int) -> float:
        return max(_FEWEST_BATCHES, sampling_error[subdivision] ** 2 / room(anchors, subdivision))

    def seconds(anchors: int, subdivision: int, batch: float, path: float) -> float:
        work = batches(anchors, subdivision) * (batch + anchors**2 * cells[subdivision] * path)
        return work + captures * anchors * _SECONDS_PER_FRAME

    # Chosen by a nominal pace: the measured one differs from run to run, and settings must not.
    choices = sorted(
        product(anchor_error, cell_error), key=lambda choice: seconds(choice[0], choice[1], *_NOMINAL_PACE)
    )
    fitting = [choice for choice in choices if systematic(*choice) <= _SYSTEMATIC_SHARE * accuracy]
    anchors, subdivision = fitting[0] if fitting else min(choices, key=lambda choice: systematic(*choice))
    left = systematic(anchors, subdivision)
    measured = seconds_per_batch, seconds_per_path
    extra = batches(anchors, subdivision) * (anchors**2 - 1) * cells[subdivision] * seconds_per_path
    warnings = _warnings(accuracy, left, depth_error, facts)
    effects = (
        _anchor_effect(anchors, anchor_error, accuracy, extra),
        Effect(
            "tan-angle cells",
            "approximate",
            f"{subdivision}x{subdivision} cells a projector pixel leave {cell_error[subdivision]:.1e}",
            cell_error[min(cell_error)],
            0.0,
        ),
        _depth_effect(depth, depth_error, accuracy),
        *_keystone_effect(facts),
        *_fixed_effects(facts),
    )
    return Plan(
        accuracy=accuracy,
        effects=effects,
        predicted_seconds=seconds(anchors, subdivision, *measured),
        anchors=anchors,
        subdivision=subdivision,
        depth=depth,
        sampling_target=_SAMPLING_MARGIN * math.sqrt(room(anchors, subdivision)),
        systematic_error=math.hypot(left, depth_error),
        warnings=warnings,
    )


def _anchor_effect(anchors: int, errors: Mapping[int, float], accuracy: float, seconds: float) -> Effect:
    if anchors == 1:
        reason = f"one anchor leaves {errors[1]:.1e}, within {accuracy:g}"
        return Effect("anchors (falloff, gloss, parallax)", "off", reason, errors[1], 0.0)
    reason = f"{anchors}x{anchors} anchors leave {errors[anchors]:.1e}; one would leave {errors[1]:.1e}"
    return Effect("anchors (falloff, gloss, parallax)", "approximate", reason, errors[1], seconds)


def _depth_effect(depth: float, error: float, accuracy: float) -> Effect:
    if error <= _SYSTEMATIC_SHARE * accuracy:
        reason = f"the lit surface lies at {depth:.2f} mm; one layer leaves {error:.1e}"
    else:
        reason = f"the lit depth varies about {depth:.1f} mm and this version has one layer: about {error:.1e} wrong"
    return Effect("depth layers", "off", reason, error, 0.0)


def _keystone_effect(facts: SceneFacts) -> Sequence[Effect]:
    if facts.keystone == 0:
        return ()
    reason = f"rendered; corners lie {facts.keystone:.1f} projector pixels off a square, so responses are not separable"
    return (Effect("projector keystone", "exact", reason, None, 0.0),)


def _fixed_effects(facts: SceneFacts) -> Sequence[Effect]:
    ambient = (
        f"{facts.other_emitters} other emitter(s) in the scene are left out: not in this version"
        if facts.other_emitters
        else "the projector is the only emitter"
    )
    fresnel = (
        f"not in this version; a mask feature's Fresnel number is {facts.fresnel_number:.1f} "
        f"at {facts.wavelength_nm:.0f} nm, so the real shadow differs"
    )
    missing = "not in this version"
    return (
        Effect("ambient light", "off", ambient, None if facts.other_emitters else 0.0, 0.0),
        Effect("interreflection", "off", "not in this version: light is followed over one reflection", None, 0.0),
        Effect("mask diffraction", "off", fresnel, None, 0.0),
        Effect("projector aperture, blur, black level", "off", missing, None, 0.0),
        Effect("mask thickness, pixel angular response", "off", missing, None, 0.0),
        Effect("sensor noise", "exact", "Poisson, full well, read noise, quantisation drawn for each frame", None, 0.0),
    )


def _warnings(accuracy: float, left: float, depth_error: float, facts: SceneFacts) -> tuple[str, ...]:
    found = []
    if left > accuracy:
        found.append(f"anchors and cells leave {left:.1e}, more than the accuracy {accuracy:g} asked for")
    if depth_error > _SYSTEMATIC_SHARE * accuracy:
        found.append(f"the scene has depth: one layer leaves about {depth_error:.1e}; layers are not in this version")
    if facts.field_stop_cuts:
        found.append(
            "the field stop (fov) cuts into the projector's window for part of the sensor; its edge is blurred over "
            "the anchors, so open it or accept an error there"
        )
    if facts.other_emitters:
        found.append(
            f"{facts.other_emitters} emitter(s) beside the projector are left out; ambient light is not in this version"
        )
    return tuple(found)
