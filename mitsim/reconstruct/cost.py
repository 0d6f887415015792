"""A capture's frames and a calibration's factors, as sizes, in; seconds by stage and memory of an image out, before it
is begun."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mitsim.core.runs import Capture
from mitsim.reconstruct.factors import Factors

KEPT_NUMBERS = 1 << 24
"""Pixels of all measurements up to which they are kept for a second look: 64 of 512 x 512, at most 256 MiB."""
BYTES_A_NUMBER = 32.0
"""Memory for each number of the factors' slabs: itself, and the copies that factorising makes."""
_FRAMES, _KEPT = 16.0, 2.0
"""Frames in double precision that are held at once: one as it is read (its file, channels, numbers, rates), its
residual and squares, and sums that tell causes; and of each measurement that is kept."""
_BASE_BYTES = 1e8
"""What the solver's libraries take, and the tables of uncertainty."""
_READ_S, _ADD_S, _JUDGE_S = 3.5e-8, 1.5e-8, 2e-8
"""A pixel of a frame, on one processor: read and checked, added up, and held against the model."""
_SHOT_S = 4e-3
"""A shot of any size."""
_PRODUCT_S = 6e-10
"""A multiplication of an SVD, of which one of (m, c) takes m c^2: dozens."""
_PLAIN_S = 0.05
"""Of any image of few pixels."""


@dataclass(frozen=True)
class ImageCost:
    """What an image takes: ``seconds`` by stage as it will state them, and ``memory_bytes`` at most."""

    seconds: dict[str, float]
    memory_bytes: float


def predict_cost(shots: Capture, factors: Factors) -> ImageCost:
    """What the Tikhonov image of ``shots`` by ``factors`` takes, at the calibrated depth."""
    pixels = float(len(factors.left) * len(factors.right))
    count, (left, right) = len(shots.manifest.patterns.captures), shots.patterns
    measured = left.shape[1] * right.shape[1]
    kept = keeps_frames(shots, factors)
    reading, judging = count * (pixels * _READ_S + _SHOT_S), measured * pixels * _JUDGE_S
    solving = sum(len(factor) * factor.shape[1] ** 2 * _PRODUCT_S for factor in (factors.left, factors.right))
    held = 8.0 * pixels * (_FRAMES + _KEPT * measured * kept)
    return ImageCost(
        seconds={
            "accumulate": solving + reading + measured * pixels * _ADD_S,
            "solve": _PLAIN_S,
            "misfit": (0.0 if kept else reading) + judging,
            "uncertainty": _PLAIN_S + solving,
        },
        memory_bytes=_BASE_BYTES + held + BYTES_A_NUMBER * slab_numbers(shots, factors),
    )


def keeps_frames(shots: Capture, factors: Factors) -> bool:
    """Whether the measurements of ``shots`` are so few numbers that they are not read twice; ``factors`` tell the
    sensor's pixels."""
    left, right = shots.patterns
    return bool(left.shape[1] * right.shape[1] * len(factors.left) * len(factors.right) <= KEPT_NUMBERS)


def slab_numbers(shots: Capture, factors: Factors, whole: bool = False) -> float:
    """Numbers of the factors and of all slabs that they are factorised into.

    Parameters
    ----------
    shots, factors
        the patterns, and the camera.
    whole
        whether every pattern's slab has all coefficients, not those of the pixels that it lights alone.
    """
    sides = zip((factors.left, factors.right), shots.patterns, strict=True)
    return float(
        sum(
            len(factor) * (patterns.size if whole else np.count_nonzero(patterns)) + factor.size
            for factor, patterns in sides
        )
    )
