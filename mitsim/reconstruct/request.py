"""How an image is asked for: method, lambda, focus and margin in; a refusal out, before the solver is imported."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.runs import Capture
from mitsim.reconstruct.factors import Factors

if TYPE_CHECKING:
    from mitsim.core.manifests import Parallax


TIKHONOV, MARKOV, TV = METHODS = ("tikhonov", "markov", "tv")
"""Of solving."""
IMAGE_FILE = "image.exr"
"""By which a folder is known to hold an image."""


def check_asked(
    lam: float | str,
    method: str,
    focus: float | str | None,
    margin: int,
    depth_range: tuple[float, float] | None = None,
) -> None:
    """ArgumentError for what :func:`mitsim.reconstruct.reconstruct.reconstruct` does not take.

    Parameters
    ----------
    lam, method, focus, margin, depth_range
        as there.
    """
    if method not in METHODS:
        raise ArgumentError("method", f"{method!r}: use {', '.join(METHODS[:-1])} or {METHODS[-1]}")
    if lam != "auto" and (isinstance(lam, str) or not 0 <= lam < math.inf):
        raise ArgumentError("lam", f"{lam}: give a finite number of at least 0, or auto")
    if focus is not None and focus not in ("auto", "map") and (isinstance(focus, str) or not 0 < focus < math.inf):
        raise ArgumentError("focus", f"{focus}: give a depth above 0 mm, auto or map")
    if depth_range is not None:
        _check_range(depth_range, focus)
    if focus == "map" and method != TIKHONOV:
        raise ArgumentError("method", f"{method}: depths by pixel come with tikhonov alone")
    if isinstance(margin, bool) or not isinstance(margin, int) or margin < 0:
        raise ArgumentError("margin", f"{margin}: give a whole number of cells, at least 0")
    if margin and (focus is not None or method != TIKHONOV):
        raise ArgumentError("margin", f"{margin}: comes with tikhonov at the calibrated depth alone; leave out focus")


def _check_range(depth_range: Any, focus: float | str | None) -> None:
    """ArgumentError for a ``depth_range`` that is none, or where no depth is looked for."""
    two = isinstance(depth_range, (tuple, list)) and len(depth_range) == 2
    real = two and all(isinstance(end, (int, float)) and not isinstance(end, bool) for end in depth_range)
    if not (real and 0 < depth_range[0] < depth_range[1] < math.inf):
        raise ArgumentError("depth_range", f"{depth_range}: give two depths above 0 mm, the nearer one first")
    if focus not in ("auto", "map"):
        raise ArgumentError("depth_range", f"{depth_range}: comes with focus auto or map alone, which look for depths")


def check_parallax(parallax: Parallax | None, calibration: str) -> Parallax:
    """The ``parallax`` that a ``calibration`` states; MitsimError where it states none."""
    if parallax is None:
        raise MitsimError(
            f"calibration {calibration}: does not state its parallax, which focus and margin need; calibrate again, or "
            "add it to the manifest"
        )
    return parallax


def check_joint(lam: float | str) -> None:
    """ArgumentError for a lambda ``lam`` that runs behind colour filters are not solved with."""
    if lam != "auto" and (isinstance(lam, str) or not 0 < lam < math.inf):
        raise ArgumentError("lam", f"{lam}: behind colour filters give a finite number above 0, or auto")


# -------- A capture's frames and a calibration's factors, as sizes, in

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
class Predicted:
    """What an image takes: ``seconds`` by stage as it will state them, and ``memory_bytes`` at most."""

    seconds: dict[str, float]
    memory_bytes: float


def predicted(shots: Capture, factors: Factors) -> Predicted:
    """What the Tikhonov image of ``shots`` by ``factors`` takes, at the calibrated depth."""
    pixels = float(len(factors.left) * len(factors.right))
    count, (left, right) = len(shots.manifest.patterns.captures), shots.patterns
    measured = left.shape[1] * right.shape[1]
    kept = is_kept(shots, factors)
    reading, judging = count * (pixels * _READ_S + _SHOT_S), measured * pixels * _JUDGE_S
    solving = sum(len(factor) * factor.shape[1] ** 2 * _PRODUCT_S for factor in (factors.left, factors.right))
    held = 8.0 * pixels * (_FRAMES + _KEPT * measured * kept)
    return Predicted(
        seconds={
            "accumulate": solving + reading + measured * pixels * _ADD_S,
            "solve": _PLAIN_S,
            "misfit": (0.0 if kept else reading) + judging,
            "uncertainty": _PLAIN_S + solving,
        },
        memory_bytes=_BASE_BYTES + held + BYTES_A_NUMBER * slab_numbers(shots, factors),
    )


def is_kept(shots: Capture, factors: Factors) -> bool:
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
