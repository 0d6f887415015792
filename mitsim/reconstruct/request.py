"""How an image is asked for: method, lambda, focus and margin in; a refusal out, before the solver is imported."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from mitsim.core.errors import ArgumentError, MitsimError

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
