"""Light by projector pixel and a side's stripes in; the expected frame of every stripe pattern out.

Where frames of single lines can be held, those of patterns are mixed from them: by :class:`ExpectedFrames` up to 256
lines, and here beyond. Otherwise they are formed in lots: which pixels each of 512 patterns lights would be 2 GiB.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from mitsim.capture.light import Light
from mitsim.core.arrays import FloatArray
from mitsim.core.parallel import in_threads
from mitsim.optics.frames import Frame, at_once, mixes
from mitsim.rig.camera import side_of
from mitsim.rig.patterns import Lighting

_LINES_BYTES = 7 * 2**28
"""Frames of lines that are held at most, as of classes that are mixed."""
_COLUMNS = 2**14
"""Pixels of a product at a time: how a product is cut shows in its last bits, so not by the number of threads."""


def lines_held(lines: int, patterns: int, pixels: float) -> bool:
    """Whether frames of lines are held to be mixed into those of patterns.

    Parameters
    ----------
    lines, patterns
        how many there are of a side.
    pixels
        a side of the sensor.
    """
    return mixes(lines, patterns, pixels) or (patterns >= lines and 8 * lines * pixels**2 <= _LINES_BYTES)


def stripe_frames(
    light: Light, stripes: Lighting, seed: int, shape: tuple[int, int], first: int
) -> Iterator[tuple[int, Frame]]:
    """Numbers and frames of patterns, without what black pixels leak.

    The same bits whatever is the first. Frames come without a Monte Carlo error.

    Parameters
    ----------
    light, seed
        by projector pixel, and the seed of its probes.
    stripes
        line of each projector pixel, and the power 0 or 1 of each line in every pattern.
    shape
        rows and columns of a frame.
    first
        number of the first pattern.
    """
    count, n = stripes.weights.shape
    lines, pixels = None, side_of(shape)
    if lines_held(n, count, pixels) and not mixes(n, count, pixels):
        lines = _lines(light, Lighting(stripes.labels, np.eye(n)), seed, shape)
    # Lots that hang on the sensor alone: what is formed together shows in the last bits.
    step = count if mixes(n, count, pixels) else at_once(pixels)
    for start in range(0, count, step):
        numbers = np.arange(start, min(start + step, count))
        if numbers[-1] < first:
            continue
        if lines is None:
            frames: Iterator[Frame] = iter(light.frames(stripes.shots(numbers), seed, leaking=False))
        else:
            frames = (Frame(frame, 0.0, 0.0, 0.0) for frame in _mixed(stripes.weights[numbers], lines, shape))
        yield from (item for item in zip(numbers.tolist(), frames, strict=True) if item[0] >= first)


def _lines(light: Light, lines: Lighting, seed: int, shape: tuple[int, int]) -> FloatArray | None:
    """(lines, m m') frames of single lines; None where one lost light below zero, which patterns would lack."""
    frames = np.empty((len(lines.weights), math.prod(shape)))
    for start in range(0, len(frames), step := at_once(side_of(shape))):
        numbers = np.arange(start, min(start + step, len(frames)))
        for number, frame in zip(numbers, light.frames(lines.shots(numbers), seed, leaking=False), strict=True):
            if frame.removed:
                return None
            frames[number] = frame.irradiance.ravel()
    return frames


def _mixed(weights: FloatArray, lines: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """(patterns, m, m') sums of ``lines`` (lines, m m') by ``weights`` (patterns, lines), for frames of a ``shape``."""
    mixed = np.empty((len(weights), lines.shape[1]))

    def part(start: int) -> None:
        inside = slice(start, start + _COLUMNS)
        mixed[:, inside] = weights @ lines[:, inside]

    in_threads(part, range(0, lines.shape[1], _COLUMNS))
    return mixed.reshape(-1, *shape)
