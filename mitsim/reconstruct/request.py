"""How an image is asked for: method, lambda, focus and margin in; a refusal out, before the solver is imported."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from mitsim.core.errors import ArgumentError, MitsimError

if TYPE_CHECKING:
    from mitsim.core.manifests import Parallax
    from mitsim.core.runs import Capture
    from mitsim.reconstruct.factors import Factors

TIKHONOV, MARKOV, TV = METHODS = ("tikhonov", "markov", "tv")
"""Of solving: names of :data:`mitsim.reconstruct.solvers.SOLVERS`."""
IMAGE_FILE = "image.exr"
"""By which a folder is known to hold an image."""


@dataclass(frozen=True)
class ImageRequest:
    """How an image is asked for. ArgumentError for what no image is made by.

    Attributes
    ----------
    lam
        lambda >= 0 in the unit of (Phi_L Phi_R)^2, for ``tv`` the weight of the total variation; ``auto`` chooses it
        from the data.
    method
        one of :data:`METHODS`.
    focus
        depth of the scene [mm]; ``auto``: that which leaves least of the measurements unexplained; ``map``: one for
        each projector pixel; None: the calibrated one.
    margin
        cells round the projector's window that are solved for too, and left out of the image.
    depth_range
        nearest and farthest depth [mm] that ``auto`` and ``map`` look for; None: a quarter of 1/z either way of the
        calibrated one.
    """

    lam: float | Literal["auto"] = "auto"
    method: str = TIKHONOV
    focus: float | Literal["auto", "map"] | None = None
    margin: int = 0
    depth_range: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        lam: float | str = self.lam
        focus: float | str | None = self.focus
        method, margin = self.method, self.margin
        if method not in METHODS:
            raise ArgumentError("method", f"{method!r}: use {', '.join(METHODS[:-1])} or {METHODS[-1]}")
        if lam != "auto" and (isinstance(lam, str) or not 0 <= lam < math.inf):
            raise ArgumentError("lam", f"{lam}: give a finite number of at least 0, or auto")
        if not (focus is None or self.looks_for_depth) and (isinstance(focus, str) or not 0 < focus < math.inf):
            raise ArgumentError("focus", f"{focus}: give a depth above 0 mm, auto or map")
        if self.depth_range is not None:
            self._check_range(self.depth_range)
        if focus == "map" and method != TIKHONOV:
            raise ArgumentError("method", f"{method}: depths by pixel come with tikhonov alone")
        if isinstance(margin, bool) or not isinstance(margin, int) or margin < 0:
            raise ArgumentError("margin", f"{margin}: give a whole number of cells, at least 0")
        if margin and (focus is not None or method != TIKHONOV):
            raise ArgumentError(
                "margin", f"{margin}: comes with tikhonov at the calibrated depth alone; leave out focus"
            )

    def _check_range(self, ends: Any) -> None:
        two = isinstance(ends, (tuple, list)) and len(ends) == 2
        real = two and all(isinstance(end, (int, float)) and not isinstance(end, bool) for end in ends)
        if not (real and 0 < ends[0] < ends[1] < math.inf):
            raise ArgumentError("depth_range", f"{ends}: give two depths above 0 mm, the nearer one first")
        if not self.looks_for_depth:
            raise ArgumentError("depth_range", f"{ends}: comes with focus auto or map alone, which look for depths")

    @property
    def looks_for_depth(self) -> bool:
        """Whether depths are found from the frames."""
        return self.focus in ("auto", "map")

    def inputs(self, shots: Capture, factors: Factors) -> dict[str, Any]:
        """What decides an image: this, and fingerprints of its ``shots`` and ``factors``."""
        asked: dict[str, Any] = {
            "run": shots.fingerprint,
            "calibration": factors.fingerprint,
            "lambda": self.lam,
            "method": self.method,
        }
        asked |= {} if self.focus is None else {"focus": self.focus}
        asked |= {} if self.depth_range is None else {"depth_range": list(self.depth_range)}
        return {**asked, "margin": self.margin} if self.margin else asked


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
