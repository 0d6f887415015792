"""Request for an image, its checks, and its predicted cost, without importing the solver."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mitsim.core.errors import ArgumentError, MitsimError, short_text

if TYPE_CHECKING:
    from mitsim.core.manifests import Parallax
    from mitsim.core.runs import Capture
    from mitsim.reconstruct.factors import Factors

TIKHONOV, MARKOV, NONNEGATIVE, TV = METHODS = ("tikhonov", "markov", "nonnegative", "tv")
"""Names of :data:`mitsim.reconstruct.solvers.SOLVERS`."""
MODEL = ".pt"
"""Ending of a trained network's file, which may replace the name of a method."""
MOST_REDUCED = 1024
"""Largest number of pixels a side that become one, as for ``psf_reduce``."""
_MOST = 1e100
"""Largest number of a request, whose square is finite."""
Bounds = tuple[float, float]
"""Least and largest number of an image; -inf and inf: any."""
IMAGE_FILE, PICTURE_FILE, RESULT_FILE = "image.exr", "image.png", "result.json"
"""Files of an image."""


def holds_image(folder: Path) -> bool:
    """Return True if a ``folder`` holds an image, finished or not."""
    return (folder / IMAGE_FILE).is_file() or (folder / RESULT_FILE).is_file()


@dataclass(frozen=True)
class ImageRequest:
    """Request for an image; ArgumentError for a combination that no image is made by.

    Attributes
    ----------
    lam
        Lambda >= 0 in the unit of (Phi_L Phi_R)^2, for ``tv`` the weight of the total variation; "auto" chooses it from
        the data.
    method
        One of :data:`METHODS`, or a :class:`mitsim.reconstruct.solvers.Solver`, such as a trained network, which has no
        lambda.
    focus
        Depth of the scene [mm]; "auto": that of the least misfit; "map": one for each projector pixel; None: the
        calibrated one.
    margin
        Cells round the projector's window that are solved for too, and left out of the image.
    depth_range
        Nearest and farthest depth [mm] for "auto" and "map"; None: a quarter of 1/z either way of the calibrated one.
    bounds
        Least and largest number of the image, for ``nonnegative`` and ``tv``; None: 0 and inf for ``nonnegative`` and
        by a point spread function, any for ``tv``.
    iterations
        Largest number of steps, for ``nonnegative`` and ``tv``; None: the method's own.
    """

    lam: float | Literal["auto"] = "auto"
    method: Any = TIKHONOV
    focus: float | Literal["auto", "map"] | None = None
    margin: int = 0
    depth_range: tuple[float, float] | None = None
    bounds: Bounds | None = None
    iterations: int | None = None

    def __post_init__(self) -> None:
        lam: float | str = self.lam
        focus: float | str | None = self.focus
        method, margin = self.name, self.margin
        if isinstance(self.method, str) and method not in METHODS:
            raise ArgumentError(
                "method",
                f"{method!r}: use {', '.join(METHODS)} or the file of a trained network, which ends in {MODEL}",
            )
        if lam != "auto" and not isinstance(self.method, str):
            raise ArgumentError("lam", f"{lam}: {method} has none; leave it out")
        if lam != "auto" and (isinstance(lam, str) or not 0 <= lam <= _MOST):
            raise ArgumentError(
                "lam", f"{short_text(lam)}: give a finite number of at least 0, or auto; at most {_MOST:g}"
            )
        if not (focus is None or self.looks_for_depth) and (isinstance(focus, str) or not 0 < focus <= _MOST):
            raise ArgumentError("focus", f"{short_text(focus)}: give a depth above 0 mm, auto or map")
        if self.depth_range is not None:
            self._check_range(self.depth_range)
        if self.bounds is not None:
            self._check_bounds(self.bounds)
        steps: Any = self.iterations
        if steps is not None and (isinstance(steps, bool) or not isinstance(steps, int) or steps < 1):
            raise ArgumentError("iterations", f"{short_text(steps)}: give a whole number, at least 1")
        for name, value in self.iterative.items():
            if method not in (NONNEGATIVE, TV):
                raise ArgumentError(name, f"{value}: come with method {NONNEGATIVE} or {TV}; {method} has none")
        if focus == "map" and method != TIKHONOV:
            raise ArgumentError("method", f"{method}: depths by pixel come with tikhonov alone")
        if isinstance(margin, bool) or not isinstance(margin, int) or margin < 0:
            raise ArgumentError("margin", f"{short_text(margin)}: give a whole number of cells, at least 0")
        if margin and (focus is not None or method != TIKHONOV):
            raise ArgumentError(
                "margin", f"{margin}: comes with tikhonov at the calibrated depth alone; leave out focus"
            )

    def _check_range(self, ends: Any) -> None:
        two = isinstance(ends, (tuple, list)) and len(ends) == 2
        real = two and all(isinstance(end, (int, float)) and not isinstance(end, bool) for end in ends)
        if not (real and 0 < ends[0] < ends[1] <= _MOST):
            raise ArgumentError("depth_range", f"{short_text(ends)}: give two depths above 0 mm, the nearer one first")
        if not self.looks_for_depth:
            raise ArgumentError("depth_range", f"{ends}: comes with focus auto or map alone, which look for depths")

    def _check_bounds(self, ends: Any) -> None:
        two = isinstance(ends, (tuple, list)) and len(ends) == 2
        real = two and all(isinstance(end, (int, float)) and not isinstance(end, bool) for end in ends)
        within = real and all(abs(end) <= _MOST or abs(end) == math.inf for end in ends)
        if not (real and ends[0] < ends[1] and ends[0] <= _MOST and ends[1] >= -_MOST and within):
            raise ArgumentError("bounds", f"{short_text(ends)}: give two numbers, the smaller one first")

    @property
    def iterative(self) -> dict[str, Any]:
        """Given options of ``bounds`` and ``iterations``."""
        given = {"bounds": self.bounds, "iterations": self.iterations}
        return {name: value for name, value in given.items() if value is not None}

    @property
    def plain(self) -> dict[str, Any]:
        """Entries of :attr:`iterative` for JSON."""
        return {**self.iterative, **({} if self.bounds is None else {"bounds": plain_bounds(self.bounds)})}

    @property
    def name(self) -> str:
        """Method name."""
        return str(self.method if isinstance(self.method, str) else self.method.name)

    @property
    def looks_for_depth(self) -> bool:
        """Whether depths are found from the frames."""
        return self.focus in ("auto", "map")

    def check_point_spread(self, reduce: int) -> None:
        """Raise ArgumentError for options that no image by a point spread function is made by."""
        if isinstance(reduce, bool) or not isinstance(reduce, int) or not 1 <= reduce <= MOST_REDUCED:
            raise ArgumentError("reduce", f"{reduce}: give a whole number, 1 to {MOST_REDUCED}")
        for name, neutral in (("focus", None), ("margin", 0)):
            value = getattr(self, name)
            if value != neutral:
                raise ArgumentError(name, f"{value}: comes with a calibration, not with a point spread function")
        if self.name not in (TIKHONOV, NONNEGATIVE, TV):
            raise ArgumentError(
                "method",
                f"{self.name}: comes with a calibration; by a point spread function use {TIKHONOV}, {NONNEGATIVE} or "
                f"{TV}",
            )

    def inputs(self, shots: Capture, factors: Factors) -> dict[str, Any]:
        """Return what decides an image: the request, and fingerprints of its ``shots`` and ``factors``."""
        asked: dict[str, Any] = {
            "run": shots.fingerprint,
            "calibration": factors.fingerprint,
            "lambda": self.lam,
            "method": self.name,
        }
        asked |= {} if self.focus is None else {"focus": self.focus}
        asked |= {} if self.depth_range is None else {"depth_range": list(self.depth_range)}
        asked |= self.plain
        return {**asked, "margin": self.margin} if self.margin else asked


def plain_bounds(bounds: Bounds) -> list[float | None]:
    """Return ``bounds`` for JSON, with None for an infinite end."""
    return [end if math.isfinite(end) else None for end in bounds]


def check_parallax(parallax: Parallax | None, calibration: str) -> Parallax:
    """Return the ``parallax`` of a ``calibration``, or raise MitsimError if it states none."""
    if parallax is None:
        raise MitsimError(
            f"calibration {calibration}: does not state its parallax, which focus and margin need; calibrate again, or "
            "add it to the manifest"
        )
    return parallax


def check_joint(lam: float | str) -> None:
    """Raise ArgumentError for a lambda that runs behind colour filters are not solved with."""
    if lam != "auto" and (isinstance(lam, str) or not 0 < lam <= _MOST):
        raise ArgumentError("lam", f"{short_text(lam)}: behind colour filters give a finite number above 0, or auto")


# ---- What a Tikhonov image takes -------------------------------------------------------------------------------------

KEPT_NUMBERS = 1 << 24
"""Largest number of pixels of all measurements that are kept for a second pass: 64 frames of 512 x 512."""
BYTES_A_NUMBER = 32.0
"""Memory for each number of the factors' slabs, with the copies of the factorisation."""
_FRAMES, _KEPT = 16.0, 2.0
"""Frames in double precision that are in memory at once, and for each kept measurement."""
_BASE_BYTES = 1e8
"""Memory of the solver's libraries, and of the tables of uncertainty."""
_READ_S, _ADD_S, _JUDGE_S = 3.5e-8, 1.5e-8, 2e-8
"""Seconds for a pixel of a frame: reading, adding, and comparing with the model."""
_SHOT_S = 4e-3
"""Seconds for a shot of any size."""
_PRODUCT_S = 6e-10
"""Seconds for a multiplication of an SVD, which needs m c^2 of them for (m, c)."""
_PLAIN_S = 0.05
"""Seconds for an image of few pixels."""


@dataclass(frozen=True)
class ImageCost:
    """Predicted seconds by stage, and largest memory."""

    seconds: dict[str, float]
    memory_bytes: float


def predict_cost(shots: Capture, factors: Factors) -> ImageCost:
    """Return the cost of the Tikhonov image of ``shots`` by ``factors`` at the calibrated depth."""
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
    """Return True if the measurements of ``shots`` are so few numbers that they are kept."""
    left, right = shots.patterns
    return bool(left.shape[1] * right.shape[1] * len(factors.left) * len(factors.right) <= KEPT_NUMBERS)


def slab_numbers(shots: Capture, factors: Factors, whole: bool = False) -> float:
    """Return the number of numbers in factors and slabs; ``whole`` slabs have all coefficients."""
    sides = zip((factors.left, factors.right), shots.patterns, strict=True)
    return float(
        sum(
            len(factor) * (patterns.size if whole else int((patterns != 0).sum())) + factor.size
            for factor, patterns in sides
        )
    )
