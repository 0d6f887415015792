"""Sums over a calibration session's responses in; frames that are not what they should be, and sums without them, out.

Three things hold for every good session, whatever the camera: the two frames of a pair add up to one frame for all
patterns (:mod:`mitsim.reconstruct.session_pairs`), the lamp is one lamp (:mod:`mitsim.reconstruct.session_lamp`), and
columns of a factor are one mask's moving shadow (:mod:`mitsim.reconstruct.session_side`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.devices.session import SIDES, Half, Side
from mitsim.reconstruct.estimate_factors import Estimate, StripeSums, factors_of_sums
from mitsim.reconstruct.faults import Lamp, SessionFault, frame_words
from mitsim.reconstruct.session_lamp import lamp_of_frames
from mitsim.reconstruct.session_pairs import Pairs
from mitsim.reconstruct.session_side import MOST_FAULTS, SideCheck


@dataclass
class CheckedSession:
    """Sums of a session as they can be believed.

    Attributes
    ----------
    sums
        of horizontal and vertical stripes, faults repaired; the very ones that came in where there is none.
    faults
        in the order of the sides and patterns.
    lamp
        how steady it is.
    left_out
        responses of each side whose misfit is not counted.
    extra
        squared error of each side's vectors beyond their noise.
    """

    sums: tuple[StripeSums, StripeSums]
    faults: list[SessionFault] = field(default_factory=list)
    lamp: Lamp = field(default_factory=Lamp)
    left_out: tuple[int, int] = (0, 0)
    extra: tuple[float, float] = (0.0, 0.0)

    def wrong_uniform(self) -> set[Side]:
        """Sides whose first response, which the uniform one is taken from, is wrong."""
        return {fault.side for fault in self.faults if fault.index == 0}

    @staticmethod
    def other_uniform(wrong: set[Side]) -> Side:
        """The side whose uniform response is right; MitsimError where both are ``wrong``."""
        right = [side for side in SIDES if side not in wrong]
        if not right:
            raise MitsimError(
                "the uniform frames of horizontal and of vertical stripes, number 0 of each, are both wrong; take them "
                "again"
            )
        return right[0]

    def estimate(self, signs: FloatArray, noise: float | None) -> Estimate:
        """Factors of what can be believed.

        Parameters
        ----------
        signs
            (n, N) H.
        noise
            as ``stated_noise`` of :func:`mitsim.reconstruct.estimate_factors.factors_of_sums`.
        """
        return factors_of_sums(*self.sums, signs, noise, self.left_out, self.extra)

    def warnings(self, name: Callable[[Half], str]) -> tuple[str, ...]:
        """A sentence for each fault; ``name`` says which frame it is."""
        return (*(fault.words(name) for fault in self.faults), *self.lamp.warnings())

    def listed(self, name: Callable[[Half], str]) -> list[dict[str, Any]]:
        """Faults for a manifest; ``name`` says which frame it is."""
        return [fault.listed(name) for fault in self.faults]


@dataclass(frozen=True)
class SessionConditions:
    """How a session was taken.

    Attributes
    ----------
    order
        frames as they were taken.
    name
        of a frame.
    clipped
        whether many of a frame's pixels share its largest number.
    saturated
        whether frames have saturated pixels, which make many pairs add up to less; those sessions are flagged for it,
        and not refused.
    unsteady
        whether it is stated that the lamp is, so that its power is neither divided out nor said.
    step
        between two numbers of a frame, as the responses have it.
    wrong
        frames that are known to be wrong, and why.
    """

    order: Sequence[Half]
    name: Callable[[Half], str] = frame_words
    clipped: Callable[[Half], bool] = lambda half: False
    saturated: bool = False
    unsteady: bool = False
    step: float = 0.0
    wrong: Mapping[Half, str] = field(default_factory=dict)


def check_session(
    sums: tuple[StripeSums, StripeSums], signs: FloatArray, taken: SessionConditions, uniform_given: bool = False
) -> CheckedSession:
    """What of a session can be believed.

    Parameters
    ----------
    sums
        of horizontal and of vertical stripes, all in.
    signs
        (n, N) H.
    taken
        how.
    uniform_given
        whether the sums were made with the uniform response of a side that is right. If not, and one of the two is
        wrong, nothing else is judged.

    Raises
    ------
    MitsimError
        where too many frames are wrong.
    """
    work = [SideCheck(own, signs) for own in sums]
    lamp = Lamp()
    if all(own.pairs is not None for own in sums):
        pairs = Pairs(work, taken.order, taken.clipped, taken.step, taken.wrong)
        if taken.saturated and pairs.many:
            return CheckedSession(sums)
        lamp = pairs.check(not taken.unsteady)
        pairs.repair(lamp)
    else:
        for own in work:
            own.leave_out_known(taken.wrong)
    at_first = [fault for own in work for fault in own.faults if fault.index == 0]
    if at_first and not uniform_given:
        return CheckedSession(sums, at_first)
    if not taken.unsteady and all(own.enough and not own.pairs for own in work):
        lamp = lamp_of_frames(work, taken.order, taken.step)
    for own in work:
        own.check(taken.unsteady, taken.name)
    faults = [
        replace(fault, cost=float(np.sqrt(own.extras[fault.index] / max(np.square(own.vectors).sum(), 1e-300))))
        for own in work
        for fault in own.faults
    ]
    count = signs.shape[1]
    patterns = {(fault.side, fault.index) for fault in faults}
    if len(patterns) > max(2, MOST_FAULTS * 2 * count):
        first = faults[0]
        raise MitsimError(
            f"{len(patterns)} of {2 * count} patterns of the session are not what they should be, first {first.side} "
            f"stripes {first.index}: {first.detail}; too many to leave out: check the order of the frames, and take "
            "the session again"
        )
    return CheckedSession(
        (work[0].result(), work[1].result()),
        faults,
        lamp,
        (len(work[0].uncounted), len(work[1].uncounted)),
        (float(work[0].extras.sum()), float(work[1].extras.sum())),
    )
