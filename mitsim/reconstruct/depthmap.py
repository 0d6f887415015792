"""Shots under shifting dots and factors in; a depth for each projector pixel, and the image in focus everywhere, out.

The start is where most light of each pixel arrives (:mod:`mitsim.reconstruct.arrivals`). Then the model is each pixel's
own: columns of both factors at its own depth (:mod:`mitsim.reconstruct.pixeldepths`). It is linear in (X, X o d), d a
change of 1/z, so each Gauss-Newton step, the d of neighbours pooled, is one closed-form solve for each frame. Last,
single pixels beside an edge take the depth on its other side where that explains more. Steps end when they leave no
less.

A displacement by a whole period of the dots is the neighbour's: depths whose parallax spans more are not told.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter, maximum_filter, median_filter, minimum_filter

from mitsim.core.arrays import FloatArray
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import Capture
from mitsim.reconstruct.alldepths import searched
from mitsim.reconstruct.arrivals import LAMBDAS, MEDIAN, OFFSETS, STEP, Arrivals
from mitsim.reconstruct.depth import Alternative, best_depth, by_chance
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.focus import stated_parallax
from mitsim.reconstruct.misfit import Balance, Misfit
from mitsim.reconstruct.noise import FrameNoise
from mitsim.reconstruct.pixeldepths import PixelDepths
from mitsim.reconstruct.status import Status, Verdict

_STEPS, _STEP_POOLED = 4, 3.0
"""Gauss-Newton steps at most, and the standard deviation [pixels] over which changes of depth are pooled: with 2 and
1.5 noise of dark pixels spreads (cookie_bag 29.7, 29.2, 28.8 dB)."""
_ROUNDS, _BESIDE = 4, 5
"""Rounds at most in which single pixels take another depth of the 5 x 5 around them: pooling rounds the edges of cards,
and what lies a pixel or two beside is then the depth of what is there."""
_SURE = 25.0
"""Variances of a datum that a pixel must explain more to take another depth: 5 standard deviations."""
_RIVAL, _ASTRAY = 2.0, 0.05
"""Starts that leave less than twice as much as the best one must not place more than this part of the told pixels half
a period beside it: two cards under dots too near to each other come out either way, and 1.8 times as much is left."""
_TOLD = 0.5
"""Confidence from which a pixel's depth counts as told: twice as much light arrives there as anywhere else."""
_SPARE = 2.0
"""Projector pixels of the period that told depths must leave free, or they may be another's by a whole period: as many
as a dot's image is wide. With one, two cards that span 3 of 4 pixels came out 2 dB worse than at one depth."""


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Depths by projector pixel, and the image that they give.

    Attributes
    ----------
    image
        (n, n') reflectance.
    mm
        (n, n') depth.
    confidence
        (n, n') 1 less what arrives at the second place over what arrives at the first; 0 where nothing does.
    lam
        lambda of the image.
    left_over, energy, data
        energy that image and depths leave of the measurements, all of their energy, and their number.
    part
        of the sensor, which these measurements are of.
    doubt
        why it is not to be trusted, or nothing.
    range_mm
        nearest and farthest depth that were looked for.
    smoothing
        variance of the factors' noise at these depths, over that of the calibrated ones.
    """

    image: FloatArray
    mm: FloatArray
    confidence: FloatArray
    lam: float
    left_over: float
    energy: float
    data: int
    part: float
    doubt: str = ""
    range_mm: tuple[float, float] | None = None
    smoothing: float = 1.0

    def __str__(self) -> str:
        if self.doubt:
            return "focus: no depths are told; the image is that of the calibrated one"
        said = self.summary()
        depths = f"{said['least_mm']:.4g} to {said['most_mm']:.4g} mm, median {said['median_mm']:.4g}"
        return f"focus: depths of {depths}, told for {said['told_part']:.0%} of pixels"

    @property
    def residual(self) -> float:
        """||Y - model|| / ||Y|| over all frames."""
        return float(np.sqrt(self.left_over / self.energy))

    @property
    def status(self) -> Status:
        """Solved: dots leave fewer unknowns in a frame than the sensor has data."""
        return Status(Verdict.SOLVED, "Solved: a depth and a reflectance for each projector pixel")

    @property
    def alternatives(self) -> tuple[Alternative, ...]:
        """None: depths by pixel that may be others are not told at all."""
        return ()

    @property
    def told(self) -> np.ndarray:
        """(n, n') whether each depth is told."""
        return np.asarray(self.confidence >= _TOLD)

    def misfit(self, noise: FrameNoise, factor_energy: float | None, print_energy: float) -> Misfit:
        """What of the measurements fits no image at these depths, over the sensor as a whole.

        Parameters
        ----------
        noise
            of all measurements.
        factor_energy
            what noise of the calibrated factors adds to all frames; None: not stated.
        print_energy
            what print within a pixel may add to them.
        """
        spare = 1 - 2 * self.image.size / self.data  # a reflectance and a depth for each pixel
        variance = float(noise.variance.mean()) * self.data * spare
        expected = variance + self.part * (noise.rendering + self.smoothing * (factor_energy or 0.0))
        whole = self.left_over, self.energy, expected, self.data / noise.variance.size
        residual, energy, allowed, pixels = (np.array([[value]]) for value in whole)
        balance = Balance(residual, energy, allowed, pixels, factor_energy is not None)
        return balance.misfit(noise, self.part * print_energy)[0]

    def channels(self) -> dict[str, npt.NDArray[np.float32]]:
        """As a file has it: depth [mm], and confidence."""
        return {"depth_mm": self.mm.astype(np.float32), "confidence": self.confidence.astype(np.float32)}

    def summary(self) -> dict[str, float]:
        """What result.json and the command line's JSON say of it."""
        told = self.mm[self.told] if self.told.any() else self.mm
        low, middle, high = (float(value) for value in np.percentile(told, (1, 50, 99)))
        return {"least_mm": low, "median_mm": middle, "most_mm": high, "told_part": float(self.told.mean())}


@single_threaded_blas()
def depth_map(
    shots: Capture,
    factors: Factors,
    lam: float | Literal["auto"] = "auto",
    depth_range: tuple[float, float] | None = None,
) -> DepthMap:
    """The depth of each projector pixel, and the image with all of them in focus.

    Parameters
    ----------
    shots
        under shifting dots.
    factors
        of the same camera, with their parallax.
    lam
        of the image; ``auto``: what its own residual asks for.
    depth_range
        nearest and farthest depth [mm] that are looked for; None: a quarter of 1/z either way of the calibrated one.

    Raises
    ------
    MitsimError
        for other patterns than dots, a rig without parallax, a calibration that does not state it, or a frame that
        cannot be read.
    """
    return _Search(shots, factors, depth_range).found(lam)


class _Search:
    """Depths by pixel, and what they leave of all measurements."""

    def __init__(self, shots: Capture, factors: Factors, depth_range: tuple[float, float] | None) -> None:
        # Of a flat scene far from the calibrated depth dots of any period tell the rest.
        self._ends = searched(factors, depth_range)
        inverse = 1 / stated_parallax(factors).depth_mm
        self._plane = best_depth(shots, factors, (1 / (inverse + self._ends[1]), 1 / (inverse + self._ends[0])))
        self._middle = (self._ends[0] + self._ends[1]) / 2
        # A start, so in doubt any of several depths will do; but an end of the range is the depth of nothing.
        self._start = self._middle if self._plane.at_end else 1 / self._plane.mm - inverse
        self._arrivals = Arrivals(shots, factors, self._ends, max(abs(self._start), abs(self._middle)))
        self._all, self.width, self.pixel = self._arrivals.depths, self._arrivals.width, self._arrivals.pixel
        self._pixels = PixelDepths(self._all, self._arrivals.reach, STEP * self.pixel)

    def found(self, lam: float | Literal["auto"]) -> DepthMap:
        """The depths that explain most, and the image at ``lam``; in doubt the calibrated one everywhere."""
        middle = self._middle / self.pixel
        tried = {(look, middle): self._left_over(self._arrivals.most(look, middle)[0]) for look in LAMBDAS}
        if self._arrivals.limited:
            look = min(tried, key=lambda start: tried[start])[0]
            plane = self._start / self.pixel
            offsets = {start + offset for start in (middle, plane) for offset in (0.0, *OFFSETS)} - {middle}
            tried |= {(look, offset): self._left_over(self._arrivals.most(look, offset)[0]) for offset in offsets}
        start = min(tried, key=lambda start: tried[start])
        rivals = [other for other, left_over in tried.items() if left_over < _RIVAL * tried[start]]
        shift, confidence = self._arrivals.most(*start)
        shift = self._sharpened(self._refined(shift, start[1] * self.pixel, tried[start]))
        doubt = self._doubt(shift, confidence, rivals)
        if doubt:
            shift, confidence = np.zeros(shift.shape), np.zeros(shift.shape)
        solved = self._pixels.solve(shift, None if lam == "auto" else lam)
        solved = self._pixels.final(shift, solved) if lam == "auto" else solved
        z = 1 / (1 / self._all.parallax.depth_mm + shift)
        known = self._all.energy, self._all.data, self._all.part
        inverse = 1 / self._all.parallax.depth_mm
        range_mm = 1 / (inverse + self._ends[1]), 1 / (inverse + self._ends[0])
        smoothing = self._all.smoothing(float(np.median(shift)))
        return DepthMap(solved.image, z, confidence, solved.lam, solved.left_over, *known, doubt, range_mm, smoothing)

    def _doubt(self, shift: FloatArray, confidence: FloatArray, rivals: Sequence[tuple[float, float]]) -> str:
        """Why depths are not to be trusted, or nothing.

        Parameters
        ----------
        shift, confidence
            changes of 1/z by pixel, and how sure each is.
        rivals
            starts (look, offset) that explain nearly as much as that of these.
        """
        told = confidence >= _TOLD
        found = self._pixels.solve(shift)
        variance, unknowns = self._pixels.variance(found), 2 * shift.size
        less = found.left_over - self._left_over(np.zeros(shift.shape))
        # Of a sheet at the calibrated depth either may leave more.
        if not told.any() or less > by_chance(less, variance, unknowns):
            return "Depths by pixel explain no more of the measurements than the calibrated one, which the image is of."
        span = float(np.ptp(np.percentile(shift[told], (1, 99))))
        astray = max(
            float((np.abs(self._arrivals.most(*rival)[0] - shift)[told] > self.width / 2).mean()) for rival in rivals
        )
        spared = not self._arrivals.limited or self.width - span >= _SPARE * self.pixel
        if not spared or astray > _ASTRAY:
            return (
                f"Parallax seems to span {span / self.pixel:.1f} projector pixels, and these dots tell "
                f"{self.width / self.pixel:.0f} apart: depths may be off by a whole period, so the image is that of "
                "the calibrated one. Use dots of a longer period along the baseline, such as dots:7x16."
            )
        ties = [(other.mm, other.difference**2 * self._all.energy) for other in self._plane.alternatives]
        others = [f"{mm:.1f}" for mm, more in ties if more < by_chance(more, variance, unknowns)]
        if others:
            return (
                f"Depths may be off by a whole period of the dots: {self._plane.mm:.1f} or {' or '.join(others)} mm "
                "explain a flat scene as well, so the image is that of the calibrated one. Use dots of a longer period "
                "along the baseline, or give the range of depths."
            )
        return ""

    def _left_over(self, shift: FloatArray) -> float:
        return self._pixels.solve(shift).left_over

    def _refined(self, shift: FloatArray, offset: float, left_over: float) -> FloatArray:
        """The ``shift`` after steps that leave less and less."""
        for _ in range(_STEPS):
            image, moved = self._pixels.step(shift, self.pixel)
            weight = gaussian_filter(np.square(image), _STEP_POOLED)
            change = gaussian_filter(image * moved, _STEP_POOLED) / np.maximum(weight, np.finfo(float).tiny)
            half = self.width / 2
            ahead = np.clip(shift + self.pixel * np.clip(change, -1, 1), offset - half, offset + half)
            ahead = median_filter(ahead, MEDIAN)
            now = self._left_over(ahead)
            if now >= left_over:
                break
            shift, left_over = ahead, now
        return shift

    def _sharpened(self, shift: FloatArray) -> FloatArray:
        """The ``shift`` with edges where they are, as long as that leaves less and less."""
        solved = self._pixels.solve(shift)
        for _ in range(_ROUNDS):
            others = [of(shift, _BESIDE) for of in (minimum_filter, maximum_filter, median_filter)]
            gains = self._pixels.gains(shift, solved.image, others)
            sure = gains.max(axis=0) > _SURE * self._pixels.variance(solved)
            ahead = np.where(sure, np.choose(gains.argmax(axis=0), others), shift)
            now = self._pixels.solve(ahead)
            if now.left_over >= solved.left_over:
                break
            shift, solved = ahead, now
        return shift
