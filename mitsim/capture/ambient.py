"""The ambient frame of a capture: lamps' light alone in, the mean of some noisy shots of it out.

It is taken with the projector off, not with a black pattern: it then holds what the lamps bring and nothing else, and a
run less its ambient frame has the expectation of the same run in a dark room. The light that black pixels leak stays in
the frames, as there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mitsim.capture.exposer import Exposer, frames_at_once
from mitsim.core.arrays import FloatArray
from mitsim.core.manifests import MOST_SHOTS
from mitsim.core.parallel import in_threads
from mitsim.optics.frames import ExpectedFrames
from mitsim.rig.patterns import PatternFamily

AmbientChoice = Literal["auto", "yes", "no"]
_PART = 1 / 16
"""Part of an image's noise variance that its ambient frame may bring, 0.26 dB: an exposure for every further tenth of a
decibel would be better spent on the frames."""


def is_taken(choice: AmbientChoice, family: PatternFamily, expected: ExpectedFrames) -> bool:
    """Whether a capture takes an ambient frame.

    Parameters
    ----------
    choice
        what was asked for; ``auto`` takes it where lamps are on and the family has frames that show them.
    family
        a signed one needs none: in the difference of two shots ambient light cancels, and so would an ambient frame.
    expected
        the family's frames.
    """
    return choice == "yes" or (choice == "auto" and expected.has_ambient and not family.signed)


def shots_for(family: PatternFamily) -> int:
    """Shots that an ambient frame is the mean of, so that its noise is at most a sixteenth of the image's variance.

    An ambient frame is no noisier than a frame with the projector on, but its noise is the same in all frames of a
    ``family``. Where patterns p_i are disjoint, as shifting dots, every scene pixel sees it once, like that of its own
    frame; where they are alike it adds up, by |sum_i p_i|^2 / sum_i |p_i|^2 on either side.
    """
    alike = 1.0
    for side in (family.left, family.right):
        patterns = side.astype(np.float64)
        alike *= float(np.square(patterns.sum(axis=1)).sum() / np.square(patterns).sum())
    return min(max(1, math.ceil(alike / _PART)), MOST_SHOTS)


@dataclass(frozen=True, eq=False)
class AmbientFrame:
    """Mean of some shots with the projector off.

    Attributes
    ----------
    shots
        that were averaged.
    electrons
        (rows, columns) expected in each, without dark current.
    digital
        (rows, columns) mean digital numbers.
    saturated
        whether a pixel reached the full well or the ADC's end in a shot.
    """

    shots: int
    electrons: FloatArray
    digital: FloatArray
    saturated: bool

    @classmethod
    def exposed(cls, exposer: Exposer, expected: ExpectedFrames, shots: int) -> AmbientFrame:
        """The mean of noisy shots, each with streams of its own.

        Parameters
        ----------
        exposer, expected
            camera and exposure of a family's frames, and these.
        shots
            to average.
        """
        electrons = exposer.electrons(expected.projector_off)
        total, saturated = np.zeros_like(electrons), False
        step = frames_at_once(electrons.size)
        for start in range(0, shots, step):
            names = [("ambient", shot) for shot in range(start, min(start + step, shots))]
            for digital in in_threads(lambda name: exposer.digital(electrons, *name), names):
                total += digital
                saturated |= exposer.saturated(digital, electrons)
        return cls(shots, electrons, total / shots, saturated)


def taken_off(exposer: Exposer, family: PatternFamily, expected: ExpectedFrames) -> FloatArray | float:
    """What a user of frames takes off each of them [electrons/s], from an ambient frame if they need one.

    Parameters
    ----------
    exposer, family, expected
        camera and exposure, patterns, and their frames without noise.
    """
    if not is_taken("auto", family, expected):
        return 0.0
    return exposer.rate(AmbientFrame.exposed(exposer, expected, shots_for(family)).digital)
