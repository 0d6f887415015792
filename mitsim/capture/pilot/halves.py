"""Frames in two independent halves: what is compared in, relative changes without the noise's own energy out.

Halves A and B see the same change with independent noise, so ``<a_A - b_A, a_B - b_B>`` estimates ``||a - b||^2``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from mitsim.capture.simulation import Simulation
from mitsim.core.arrays import FloatArray, Labels
from mitsim.rig.patterns import Lighting
from mitsim.transport.histogram import Deposits

Halves = tuple[FloatArray, FloatArray]
"""(shots, pixels, pixels) frames, twice, with independent noise."""
_SHOTS = 4
"""Shots of the family that the pilot looks at: patterns of a family differ little, and each costs its forming."""
_PIXELS = 64**2
"""Few pixels are sampled more often, until they take as many samples as so many pixels."""
_SHARP_PATHS = 2**21
"""Connections of sharp pixels, some 0.2 s."""
_GOOD_ENOUGH = 0.3
"""Part of the accuracy below which a finer step is not tried: its square is a tenth of the budget's."""


@dataclass(frozen=True)
class Sample:
    """The shots that the pilot looks at, and how many samples it takes to."""

    lighting: Lighting

    @classmethod
    def of(cls, lighting: Lighting) -> Sample:
        """A few shots of ``lighting``, evenly spread."""
        shots = len(lighting.weights)
        return cls(lighting.shots(np.unique(np.linspace(0, shots - 1, min(shots, _SHOTS)).astype(int))))

    @property
    def rows(self) -> Labels:
        """Class of each row of light that is filed by class."""
        return np.arange(self.lighting.weights.shape[1])

    @property
    def shown(self) -> Labels:
        """Projector pixels that the shots show."""
        return np.flatnonzero((self.lighting.weights != 0).any(axis=0)[self.lighting.labels])

    @property
    def fine(self) -> int:
        """Samples a shown pixel to tell cells and layers apart."""
        return 16 * max(1, _PIXELS // len(self.shown))

    @property
    def anchored(self) -> int:
        """Samples a shown pixel to tell anchors apart."""
        return self.fine // 4

    @property
    def direct(self) -> int:
        """Samples a projector pixel to tell effects apart."""
        return 4 * max(1, _PIXELS // len(self.lighting.labels))

    @property
    def followed(self) -> int:
        """Samples a projector pixel of indirect light, and a cell of light that is followed from the camera."""
        return self.direct // 2

    def sharp(self, simulation: Simulation) -> int:
        """Samples of each pixel that a ``simulation`` traces apart."""
        paths = simulation.apart.lanes if simulation.apart else 1
        return min(max(_SHARP_PATHS // paths, 4), self.fine)

    def frames(
        self,
        simulation: Simulation,
        direct: Deposits,
        samples: int,
        followed: Deposits | None = None,
        sharp: Deposits | None = None,
    ) -> FloatArray:
        """(shots, pixels, pixels) frames.

        Parameters
        ----------
        simulation
            what forms them.
        direct, samples
            direct light, and its samples.
        followed
            light over more surfaces or from the camera.
        sharp
            direct light of sharp pixels.
        """
        labels = self.lighting.labels
        light = simulation.file_direct(direct, labels, samples)
        if followed is not None:
            light = light + simulation.file_followed(followed, labels, self.followed)
        if sharp is not None:
            light = light + simulation.file_sharp(sharp, labels, self.sharp(simulation))
        frames = simulation.expected([light], self.rows, self.lighting, 0)
        return np.stack([frame.irradiance for frame in frames])


def ladder(steps: Iterable[int], frames: Callable[[int], Halves], first: int, accuracy: float) -> Mapping[int, float]:
    """Relative error of each step against the finest that was tried.

    Parameters
    ----------
    steps
        numbers from coarse to fine.
    frames
        of a step.
    first
        index of the step that judges at first; finer ones are tried until the one before the judge is good enough.
    accuracy
        of the capture.
    """
    counts = list(steps)
    tried = {count: frames(count) for count in counts[: first + 1]}
    while True:
        before, judge = list(tried)[-2:]
        errors = {count: difference(halves, tried[judge]) for count, halves in tried.items() if count != judge}
        if errors[before] <= _GOOD_ENOUGH * accuracy or judge == counts[-1]:
            break
        following = counts[counts.index(judge) + 1]
        tried[following] = frames(following)
    # The judge's own error: what the last step gained, once more.
    earlier = list(tried)[-3]
    gain = errors[before] / errors[earlier] if errors[earlier] > 0 else 1.0
    return {**errors, judge: errors[before] * min(gain, 1.0)}


def difference(changed: Halves, judge: Halves) -> float:
    """||``changed`` - ``judge``|| / ||``judge``||."""
    energy = float((judge[0] * judge[1]).sum())
    product = float(((changed[0] - judge[0]) * (changed[1] - judge[1])).sum())
    return math.sqrt(max(product, 0.0) / energy) if energy > 0 else 0.0


def norm(halves: Halves) -> float:
    """Norm of the frames in ``halves``, without their noise."""
    return math.sqrt(max(float((halves[0] * halves[1]).sum()), 0.0))


def noise(halves: Halves, light: float) -> float:
    """Error of one of the ``halves``, relative to frames of the norm ``light``."""
    return math.sqrt(float(np.square(halves[0] - halves[1]).sum()) / 2) / light if light else 0.0
