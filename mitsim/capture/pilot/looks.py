"""Frames in a few independent looks: what is compared in, relative changes without the noise's own energy out.

Looks see the same change with independent noise, so the mean product of two different ones estimates its square.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mitsim.capture.evidence import Part
from mitsim.capture.filing import FiledLight
from mitsim.capture.simulation import Simulation
from mitsim.core.arrays import FloatArray, Labels
from mitsim.rig.patterns import Lighting

_SHOTS, _MOST_SHOTS, _SHOWN = 4, 16, 1024
"""Shots of the family that the pilot looks at: patterns of a family differ little, and each costs its forming; but more
where they show fewer pixels than this all together, which are no fair sample of the scene, or a mirror does."""
_COLUMNS = 64
"""Columns of pixels that the pilot looks at: a frame's neighbours are alike, and each column costs its forming."""
_GOLDEN = (math.sqrt(5) - 1) / 2
"""Steps by it never meet a mask's features in one phase."""
_PIXELS = 64**2
"""Few pixels are sampled more often, until they take as many samples as so many pixels."""
_MOST_PATHS = 2**20
"""Paths of one look that are held at a time: 60 MB."""
_SHARP_PATHS = 2**18
"""Paths of sharp pixels in one look: each is filed in four cells, again and again."""
_MOST_SHARP = 256
"""Samples of a sharp pixel in a look: its error is then 3e-3 (plates of roughness 1e-3 and 1e-4)."""
_OCCLUDED, _MOST_OCCLUDED, _FEWEST_OCCLUDED = 2**9, 2**11, 4
"""Points on occluded pixels in a first look, each seen from up to 32 x 32 anchors, the most in any (2^21 connections,
some 0.5 GB in four looks), and the fewest of one pixel."""
EVEN_CELLS = 0.25
"""Half as large cells leave this much of the error where light is smooth: they are of second order."""
_UNKNOWN_GAIN = 0.5
"""What a step leaves of the one before where that is not known, or not small."""
GOOD_ENOUGH = 0.3
"""Part of the accuracy below which a finer step is not tried: its square is a tenth of the budget's."""


@dataclass(frozen=True)
class Sample:
    """The shots and columns of pixels that the pilot looks at, and how many samples it takes to.

    ``effort`` multiplies the samples of the first, shortest look.
    """

    lighting: Lighting
    columns: Labels
    effort: int = 1

    @classmethod
    def of(cls, lighting: Lighting, pixels: int, mirrors: bool) -> Sample:
        """A few shots of a family and columns of the sensor, evenly spread.

        Parameters
        ----------
        lighting
            the family.
        pixels
            of the sensor, a side.
        mirrors
            whether a shot's light may be that of few of the pixels that it shows, in a mirror.
        """
        shots, count = len(lighting.weights), min(pixels, _COLUMNS)
        columns = (np.arange(count) + (np.arange(count) * _GOLDEN) % 1) * pixels / count
        lit = np.bincount(lighting.labels, minlength=lighting.weights.shape[1]) @ (lighting.weights[0] != 0)
        few = _MOST_SHOTS if mirrors else _SHOWN // max(int(lit), 1)
        wanted = min(max(_SHOTS, few), _MOST_SHOTS, shots)
        chosen = np.unique(np.linspace(0, shots - 1, wanted).astype(int))
        return cls(lighting.shots(chosen), columns.astype(np.int64))

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
        """Samples a shown pixel to tell cells and layers apart, in each look."""
        return self._within(4 * self.effort * max(1, _PIXELS // len(self.shown)), len(self.shown))

    @property
    def anchored(self) -> int:
        """Samples a shown pixel to tell anchors apart, in each look."""
        return max(1, self.fine // 4)

    @property
    def direct(self) -> int:
        """Samples a projector pixel to tell effects apart, in each look."""
        pixels = len(self.lighting.labels)
        return self._within(2 * self.effort * max(1, _PIXELS // pixels), pixels)

    @property
    def followed(self) -> int:
        """Samples a projector pixel of indirect light, and a cell of light that is followed from the camera."""
        return max(1, self.direct // 2)

    def occluded(self, pixels: int) -> int:
        """Samples of each of so many occluded ``pixels``, in each look."""
        return max(_FEWEST_OCCLUDED, min(self.effort * _OCCLUDED, _MOST_OCCLUDED) // max(pixels, 1))

    def sharp(self, simulation: Simulation) -> int:
        """Samples of each pixel that a ``simulation`` traces apart, in each look."""
        paths = simulation.apart.lanes if simulation.apart else 1
        return min(max(_SHARP_PATHS // paths, 4), _MOST_SHARP)

    def _within(self, samples: int, pixels: int) -> int:
        return max(1, min(samples, _MOST_PATHS // pixels))

    def frames(self, simulation: Simulation, lights: Sequence[FiledLight]) -> FloatArray:
        """(looks, shots, pixels, columns) frames of each look's light among ``lights``, formed by a ``simulation``."""
        return simulation.expected(lights, self.rows, self.lighting, 0).by_group(self.columns)


def ladder(
    steps: Iterable[int], frames: Callable[[int], FloatArray], first: int, tolerance: float, least_gain: float = 0.0
) -> Mapping[int, FloatArray]:
    """Change of the frames from each step to what ever finer ones come to.

    Each step is taken to gain as much over the one before as the last two did: what the finest leaves of the sum.

    Parameters
    ----------
    steps
        numbers from coarse to fine.
    frames
        (looks, ...) of a step.
    first
        index of the step that judges at first; finer ones are tried until the one before the judge is good enough.
    tolerance
        norm of the change by a finer step below which none is tried.
    least_gain
        what a step leaves at least of the one before, where that is known.
    """
    counts = list(steps)
    tried = {count: frames(count) for count in counts[: first + 1]}
    while True:
        *earlier, before, judge = tried
        last = tried[judge] - tried[before]
        gain = _gain(norm(last), norm(tried[before] - tried[earlier[-1]])) if earlier else _UNKNOWN_GAIN
        rest = max(gain, least_gain) / (1 - max(gain, least_gain))
        if (1 + rest) * norm(last) <= tolerance or judge == counts[-1]:
            break
        following = counts[counts.index(judge) + 1]
        tried[following] = frames(following)
    limit = tried[judge] + rest * last
    return {count: limit - found for count, found in tried.items()}


def _gain(last: float, before: float) -> float:
    """Size of the last step over the one before; at most as much as noise may feign."""
    return min(last / before, _UNKNOWN_GAIN) if before > 0 else _UNKNOWN_GAIN


def coarsened(
    name: str, frames: Callable[[int, tuple[float, ...]], FloatArray], layers: tuple[float, ...]
) -> dict[Part, FloatArray]:
    """Change of the frames by one coarse cell a pixel for light called ``name``, and by one layer for it.

    Parameters
    ----------
    name
        of the light.
    frames
        (looks, ...) that it makes in so many coarse cells a side of a pixel and such layers.
    layers
        depths [mm] that judge the one; none for a flat scene.
    """
    one, two = frames(1, ()), frames(2, ())
    changes = {Part(f"{name} cells", 1): (two - one) / (1 - EVEN_CELLS)}
    return {**changes, Part(f"{name} layers", 1): frames(1, layers) - one} if layers else changes


def product(one: FloatArray, other: FloatArray) -> float:
    """Inner product of ``one`` and the ``other`` (looks, ...), mean over pairs of different looks."""
    looks = len(one)
    # Sums by numpy: those of BLAS depend on the number of its threads in the last bits.
    whole = float((one.sum(axis=0) * other.sum(axis=0)).sum())
    return (whole - float((one * other).sum())) / (looks * (looks - 1))


def norm(seen: FloatArray) -> float:
    """Norm of frames ``seen`` in looks, without their noise."""
    return math.sqrt(max(product(seen, seen), 0.0))


def noise(seen: FloatArray) -> float:
    """Norm of the error of one look of frames ``seen``."""
    return math.sqrt(float(np.square(seen - seen.mean(axis=0)).sum()) / (len(seen) - 1))
