"""Request of an image: its options, their checks, and its cost, before the solver is imported."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from mitsim.core.configuration import QUALITY, Options, option, validated_by
from mitsim.core.errors import ArgumentError, MitsimError, short_text

if TYPE_CHECKING:
    from mitsim.core.manifests import Parallax
    from mitsim.core.runs import Capture
    from mitsim.reconstruct.factors import Factors

TIKHONOV, MARKOV, NONNEGATIVE, TV = METHODS = ("tikhonov", "markov", "nonnegative", "tv")
MODEL, LIST = ".pt", ".toml"
"""Endings of a trained network, and of a list of point spread functions."""
MOST_REDUCED = 1024
_MOST = 1e100
Bounds = tuple[float, float]
IMAGE_FILE, PICTURE_FILE, RESULT_FILE = "image.exr", "image.png", "result.json"


def holds_image(folder: Path) -> bool:
    return (folder / IMAGE_FILE).is_file() or (folder / RESULT_FILE).is_file()


def method_names() -> str:
    notes = {MARKOV: f"{MARKOV} (assumes similar neighbouring pixels, for noisy frames)"}
    return ", ".join([*(notes.get(name, name) for name in METHODS), f"or MODEL{MODEL}, a network of `mitsim train`"])


def _two(name: str, rule: str, low: float | None = None, high: float | None = None) -> Callable[[str], Any]:
    def read(text: str) -> tuple[float, float]:
        first, colon, last = text.partition(":")
        try:
            if colon:
                return float(first or low), float(last or high)  # type: ignore[arg-type]
        except (ValueError, TypeError):
            pass
        raise ArgumentError(name, f"{text!r}: {rule}")

    return read


def _two_numbers(ends: Any) -> tuple[float, float] | None:
    if ends is None:
        return None
    real = isinstance(ends, (tuple, list)) and [type(end) in (int, float) for end in ends] == [True, True]
    if not real:
        raise MitsimError(f"{short_text(ends)}: give two numbers, the smaller one first")
    return float(ends[0]), float(ends[1])


Two = Annotated[Any, validated_by(_two_numbers)]


class ImageRequest(Options):
    """Options of an image."""

    PANEL = QUALITY
    VERB = "reconstruct"

    lam: float | Literal["auto"] = option("auto", "regularisation strength, or auto", "--lambda", metavar="auto|VALUE")
    """lambda >= 0 in the unit of (Phi_L Phi_R)^2, for ``tv`` the weight of the total variation."""
    method: Any = option(TIKHONOV, method_names(), metavar="NAME|MODEL.pt", kind=str, complete=lambda: METHODS)
    """One of :data:`METHODS`, or a :class:`mitsim.reconstruct.solvers.Solver`, such as a trained network."""
    focus: float | Literal["auto", "map", "volume"] | None = option(
        None,
        "depth of the scene [mm]; auto: estimate it; map: estimate one for each pixel, from dots patterns; volume: "
        "several for each pixel; by default the depth of the calibration",
        metavar="auto|MM|map|volume",
    )
    depth_range: Two = option(
        None,
        "with focus auto, map or volume: nearest and farthest depth to try [mm]; by default 1/z differs by at most a "
        "quarter from that of the calibration, and with volume its parallax by at most half a period of the dots",
        metavar="A:B",
        read=_two("depth_range", "give the nearest and the farthest depth [mm], such as 350:450"),
    )
    bounds: Two = option(
        None,
        "with nonnegative or tv: least and largest value of the image, such as 0:1 or 0:; by default 0: with "
        "nonnegative and with a point spread function",
        metavar="LOW:HIGH",
        read=_two("bounds", "give the least and the largest number, such as 0:1 or 0:", -math.inf, math.inf),
    )
    iterations: int | None = option(
        None,
        "with nonnegative or tv: limit of the iterations; by default 5000, or 300 with --psf (1000 for "
        "depths) or --focus volume",
        min=1,
        metavar="N",
    )

    def model_post_init(self, context: object) -> None:
        lam: Any = self.lam
        focus: Any = self.focus
        if not isinstance(self.method, str) and not hasattr(self.method, "name"):
            raise ArgumentError("method", f"{short_text(self.method)}: give a method's name or a solver")
        method = self.name
        if isinstance(self.method, str) and method not in METHODS:
            allowed = f"{', '.join(METHODS)} or the file of a trained network, which ends in {MODEL}"
            raise ArgumentError("method", f"{method!r}: use {allowed}")
        if lam != "auto" and not isinstance(self.method, str):
            raise ArgumentError("lam", f"{lam}: {method} has none; leave it out")
        if lam != "auto" and not 0 <= lam <= _MOST:
            words = f"give a finite number of at least 0, or auto; at most {_MOST:g}"
            raise ArgumentError("lam", f"{short_text(lam)}: {words}")
        if not (focus is None or self.looks_for_depth or 0 < focus <= _MOST):
            raise ArgumentError("focus", f"{short_text(focus)}: give a depth above 0 mm, auto, map or volume")
        if ends := self.depth_range:
            if not 0 < ends[0] < ends[1] <= _MOST:
                raise ArgumentError("depth_range", f"{ends}: give two depths above 0 mm, the smaller one first")
            if not self.looks_for_depth:
                raise ArgumentError("depth_range", f"{ends}: comes with focus auto, map or volume alone")
        if ends := self.bounds:
            within = all(abs(end) <= _MOST or abs(end) == math.inf for end in ends)
            if not (within and ends[0] < ends[1] and ends[0] <= _MOST and ends[1] >= -_MOST):
                raise ArgumentError("bounds", f"{ends}: give two numbers, the smaller one first")
        for name, value in self.iterative.items():
            if method not in (NONNEGATIVE, TV):
                raise ArgumentError(name, f"{value}: come with method {NONNEGATIVE} or {TV}; {method} has none")
        if focus == "volume" and method not in (TIKHONOV, NONNEGATIVE, TV):
            raise ArgumentError("method", f"{method}: volumes come with {TIKHONOV}, {NONNEGATIVE} or {TV}")
        if focus == "map" and method != TIKHONOV:
            raise ArgumentError("method", f"{method}: depths by pixel come with tikhonov alone")

    @property
    def iterative(self) -> dict[str, Any]:
        given = {"bounds": self.bounds, "iterations": self.iterations}
        return {name: value for name, value in given.items() if value is not None}

    @property
    def plain(self) -> dict[str, Any]:
        found = self.iterative
        if self.bounds is not None:
            found["bounds"] = [end if math.isfinite(end) else None for end in self.bounds]
        return found

    @property
    def name(self) -> str:
        return str(self.method if isinstance(self.method, str) else self.method.name)

    @property
    def looks_for_depth(self) -> bool:
        return self.focus in ("auto", "map", "volume")

    def check_point_spread(self, reduce: int) -> None:
        if isinstance(reduce, bool) or not isinstance(reduce, int) or not 1 <= reduce <= MOST_REDUCED:
            raise ArgumentError("reduce", f"{reduce}: give a whole number, 1 to {MOST_REDUCED}")
        if self.focus is not None:
            raise ArgumentError("focus", f"{self.focus}: comes with a calibration, not with a point spread function")
        if self.name not in (TIKHONOV, NONNEGATIVE, TV):
            allowed = f"by a point spread function use {TIKHONOV}, {NONNEGATIVE} or {TV}"
            raise ArgumentError("method", f"{self.name}: comes with a calibration; {allowed}")

    def inputs(self, shots: Capture, factors: Factors) -> dict[str, Any]:
        asked: dict[str, Any] = {"run": shots.fingerprint, "calibration": factors.fingerprint}
        asked |= {"lambda": self.lam, "method": self.name}
        asked |= {} if self.focus is None else {"focus": self.focus}
        asked |= {} if self.depth_range is None else {"depth_range": list(self.depth_range)}
        return {**asked, **self.plain}


def check_parallax(parallax: Parallax | None, calibration: str) -> Parallax:
    if parallax is None:
        words = "does not state its parallax, which focus needs; calibrate again, or add it to the manifest"
        raise MitsimError(f"calibration {calibration}: {words}")
    return parallax


def check_joint(lam: float | str) -> None:
    if lam != "auto" and (isinstance(lam, str) or not 0 < lam <= _MOST):
        raise ArgumentError("lam", f"{short_text(lam)}: behind colour filters give a finite number above 0, or auto")


# ---- Cost of a Tikhonov image ----------------------------------------------------------------------------------------

KEPT_NUMBERS = 1 << 24
"""Pixels of all measurements up to which they are kept for a second look: 64 of 512 x 512, at most 256 MiB."""
BYTES_A_NUMBER = 32.0
"""Memory for each number of the factors' slabs, with the copies that factorising makes."""
_FRAMES, _KEPT = 16.0, 2.0
"""Frames in double precision that are held at once, and of each measurement that is kept."""
_BASE_BYTES = 1e8
_READ_S, _ADD_S, _JUDGE_S = 3.5e-8, 1.5e-8, 2e-8
"""Seconds for a pixel of a frame, on one processor: read, added up, and compared with the model."""
_SHOT_S = 4e-3
_PRODUCT_S = 6e-10
_PLAIN_S = 0.05


@dataclass(frozen=True)
class ImageCost:
    """Predicted ``seconds`` by stage of an image, and the largest ``memory_bytes``."""

    seconds: dict[str, float]
    memory_bytes: float

    @classmethod
    def of(cls, shots: Capture, factors: Factors) -> ImageCost:
        pixels = float(len(factors.left) * len(factors.right))
        count, (left, right) = len(shots.manifest.patterns.captures), shots.patterns
        measured = left.shape[1] * right.shape[1]
        kept = keeps_frames(shots, factors)
        reading, judging = count * (pixels * _READ_S + _SHOT_S), measured * pixels * _JUDGE_S
        solving = sum(len(factor) * factor.shape[1] ** 2 * _PRODUCT_S for factor in (factors.left, factors.right))
        held = 8.0 * pixels * (_FRAMES + _KEPT * measured * kept)
        return cls(
            seconds={
                "accumulate": solving + reading + measured * pixels * _ADD_S,
                "solve": _PLAIN_S,
                "misfit": (0.0 if kept else reading) + judging,
                "uncertainty": _PLAIN_S + solving,
            },
            memory_bytes=_BASE_BYTES + held + BYTES_A_NUMBER * slab_numbers(shots, factors),
        )


def keeps_frames(shots: Capture, factors: Factors) -> bool:
    left, right = shots.patterns
    return bool(left.shape[1] * right.shape[1] * len(factors.left) * len(factors.right) <= KEPT_NUMBERS)


def slab_numbers(shots: Capture, factors: Factors, whole: bool = False) -> float:
    sides = zip((factors.left, factors.right), shots.patterns, strict=True)
    slabs = (len(factor) * (lit.size if whole else int((lit != 0).sum())) + factor.size for factor, lit in sides)
    return float(sum(slabs))
