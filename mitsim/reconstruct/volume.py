"""Light of a scene by projector pixel and depth, from frames of shifting dots.

Where a net, a thin edge or a pane shares a projector pixel with a surface behind it, no single depth explains the
frames. So each pixel p has a reflectance X_pz at each of a few depths z (Zheng, Hua, Sankaranarayanan and Asif,
arXiv 2108.07966, with dots in place of mask patterns):

    Y_ij = sum_z L_z (P_ij o X_z) R_z^T

with the calibrated factors moved to each depth (:mod:`mitsim.reconstruct.depth`). Neighbouring depths differ by one
projector pixel of parallax. A pixel's sum over depths is its reflectance, and its mean depth lies between them.

*Weights.* Each side has a mean Gram matrix G of all depths' factors, (r, r) in the frames' common basis. With V and g
the eigenvectors and eigenvalues of G, frames and factors are multiplied by (g + 0.1 g_max)^(-1/2) V^T. Directions of
small g, which hold most of the detail, else need thousands of steps of conjugate gradients instead of a hundred.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import Capture
from mitsim.reconstruct.depth import (
    CommonBasis,
    DepthMap,
    are_dots,
    best_depth,
    parallax_of,
    period_of_dots,
    shifts_searched,
)
from mitsim.reconstruct.descent import Array, minimise
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.misfit import GROSS
from mitsim.reconstruct.request import TIKHONOV, TV, ImageRequest
from mitsim.reconstruct.solver import Solution, Status, Verdict, check_lambda
from mitsim.reconstruct.solvers import Prior

_FLOOR = 0.1
"""Part of the largest eigenvalue that is added: 0.01 and 0.001 amplify noise and cost cards 4 and 11 dB."""
_WEIGHT, _RIDGE = 1.2, 1e-3
"""TV's weight in units of the gradient's noise, and lambda over the mean square of a pixel's light."""
_ITERATIONS, _TOLERANCE = 300, 0.02
_MOST_PLANES, _END = 256, 0.02
_LEAST_PERIOD, _WITHIN = 4, 0.49
_MISFIT = 0.04
"""Part of the frames within the factors' space: cameras as calibrated leave up to 0.036, because surfaces lie between
the depths. A sensor that moved by a pixel leaves 0.06, and a mask 50 um farther 0.033."""


class Planes:
    """Operator from volumes (D, n, n') to weighted frames (K, K', r, r') in units of a pixel's light."""

    precision = np.float32

    def __init__(self, basis: CommonBasis, shifts: FloatArray) -> None:
        self.scene, self._lit = (len(shifts), *basis.shape), list[list[Array]]()
        self._roots, self._vectors, sides, power = list[FloatArray](), list[FloatArray](), list[list[FloatArray]](), 1.0
        for axis, patterns in enumerate(basis.patterns):
            planes = np.stack([basis.side(axis, shift) for shift in shifts])
            energies, vectors = np.linalg.eigh(np.einsum("zrp,zsp->rs", planes, planes, optimize=True))
            self._roots.append(np.sqrt(np.maximum(energies, 0.0) + _FLOOR * energies[-1]))
            self._vectors.append(vectors)
            planes = np.matmul(vectors.T / self._roots[-1][:, None], planes)
            self._lit.append([np.flatnonzero(column) for column in patterns.T])
            sides.append([planes[:, :, lit] * patterns[lit, k] for k, lit in enumerate(self._lit[-1])])
            power *= sum(float(np.square(each).sum()) for each in sides[-1]) / (len(shifts) * len(patterns))
        self.unit = math.sqrt(power)
        self._left, right = ([(each / power**0.25).astype(np.float32) for each in side] for side in sides)
        # Lit columns of all depths side by side (D c', r'), so that one product sums over depths.
        self._right = [np.ascontiguousarray(each.transpose(0, 2, 1).reshape(-1, each.shape[1])) for each in right]

    def weigh(self, stack: FloatArray) -> Array:
        """Return the weighted frames of a ``stack`` (K, r, K', r')."""
        (left, right), (first, second) = self._vectors, self._roots
        seen = np.matmul(np.matmul(left.T, stack.transpose(0, 2, 1, 3)), right)
        return np.asarray(seen / (self.unit * np.outer(first, second)), np.float32)

    def energy(self, weighted: Array) -> float:
        """Return the energy of ``weighted`` frames before they were weighted."""
        return float(np.square(weighted * (self.unit * np.outer(*self._roots))).sum())

    def noise(self, deviation: float) -> float:
        """Return the deviation of weighted frames whose frames have ``deviation``."""
        weights = [float(np.mean(1 / np.square(roots))) for roots in self._roots]
        return deviation * math.sqrt(math.prod(weights)) / self.unit

    def image_of(self, scene: Array) -> Array:
        size = self._left[0].shape[1]
        frames = np.empty((len(self._left), len(self._right), size, self._right[0].shape[1]), np.float32)
        for own, left, rows in zip(frames, self._left, self._lit[0], strict=True):
            seen = np.matmul(left, scene[:, rows])
            for frame, right, columns in zip(own, self._right, self._lit[1], strict=True):
                np.matmul(seen[:, :, columns].transpose(1, 0, 2).reshape(size, -1), right, out=frame)
        return frames

    def correlate(self, frames: Array) -> Array:
        """Return the adjoint (D, n, n') of :meth:`image_of`."""
        volume, size = np.zeros(self.scene, np.float32), self._left[0].shape[1]
        for own, left, rows in zip(frames, self._left, self._lit[0], strict=True):
            seen = np.zeros((self.scene[0], size, self.scene[2]), np.float32)
            for frame, right, columns in zip(own, self._right, self._lit[1], strict=True):
                seen[:, :, columns] += (frame @ right.T).reshape(size, self.scene[0], -1).transpose(1, 0, 2)
            volume[:, rows] += np.matmul(left.transpose(0, 2, 1), seen)
        return volume

    def preconditioner(self, ridge: float, slope_weight: float) -> Callable[[Array], Array]:
        return lambda volume: volume

    def half_size(self) -> None:
        return None


@dataclass(frozen=True, eq=False, kw_only=True)
class Volume(DepthMap):
    """Reflectances ``slices`` (D, n, n') at ``depths_mm`` (D,); ``image`` is their sum, ``mm`` their mean depth.

    ``confidence`` is the largest part of a pixel's light at two neighbouring depths.
    """

    slices: FloatArray
    depths_mm: FloatArray
    solution: Solution

    def __str__(self) -> str:
        ends = f"{self.depths_mm.min():.4g} to {self.depths_mm.max():.4g} mm"
        return f"focus: a volume of {len(self.slices)} depths from {ends}"


def _check_default(shots: Capture, factors: Factors, period: float, pixel: float) -> None:
    if period < _LEAST_PERIOD * pixel:
        raise ArgumentError(
            "depth_range",
            f"none: the dots repeat within {_LEAST_PERIOD} projector pixels of parallax; use dots of a longer period "
            "along the baseline, such as dots:7x16, or give the nearest and the farthest depth",
        )
    middle, found = 1 / parallax_of(factors).depth_mm, best_depth(shots, factors).mm
    if abs(1 / found - middle) > period / 2:
        here, there = (
            f"{1 / (about + _WITHIN * period):.4g}:{1 / (about - _WITHIN * period):.4g}"
            for about in (middle, 1 / found)
        )
        raise ArgumentError(
            "depth_range",
            f"none: the range is then {here} mm, a period of the dots about the calibrated depth, but the scene seems "
            f"to be at {found:.4g} mm; give a range, such as {there}",
        )


@single_threaded_blas()
def solve_volume(
    shots: Capture, factors: Factors, request: ImageRequest, lam: float | Literal["auto"] = "auto"
) -> Volume:
    """Return the light by projector pixel and depth under shifting dots.

    Raises MitsimError for other patterns, and without parallax.
    """
    if not all(map(are_dots, shots.patterns)):
        raise MitsimError("focus volume: needs shifting dots, such as dots:7x16, whose displacement depends on depth")
    ends, inverse = shifts_searched(factors, request.depth_range), 1 / parallax_of(factors).depth_mm
    period = period_of_dots(factors, shots.patterns)
    if request.depth_range is None:
        # Frames hardly distinguish depths that are a period of the dots apart.
        ends = max(ends[0], -period / 2), min(ends[1], period / 2)
    basis = CommonBasis(shots, factors, ends)
    pixel = 1 / max(side.reach for side in basis.sides)
    if request.depth_range is None:
        _check_default(shots, factors, period, pixel)
    count = math.ceil((ends[1] - ends[0]) / pixel) + 1
    if count > _MOST_PLANES:
        raise MitsimError(f"focus volume: the range has {count} depths, at most {_MOST_PLANES} are solved; narrow it")
    shifts, doubt = np.linspace(*ends, count), ""
    if ends[1] - ends[0] > period:
        doubt = (
            f"Depths are ambiguous: parallax spans {(ends[1] - ends[0]) / pixel:.1f} projector pixels in this range, "
            f"and the dots repeat after {period / pixel:.0f}; use dots of a longer period along the baseline, or give "
            "a narrower range with --depth-range NEAR:FAR or depth_range."
        )
    planes, method = Planes(basis, shifts), request.name
    frames, bounds = planes.weigh(basis.stack), request.bounds or ((0.0, math.inf) if method != TIKHONOV else None)
    noise = planes.noise(float(np.sqrt(basis.noise.variance.mean())))
    known = (_WEIGHT * noise if method == TV else _RIDGE) if lam == "auto" else check_lambda(lam)
    prior = Prior(known, 0.0, bounds or Prior.bounds) if method == TV else Prior(0.0, known, bounds or Prior.bounds)
    found = minimise(planes, frames, prior, request.iterations or _ITERATIONS, _TOLERANCE)
    inside, variance = planes.energy(planes.image_of(found.image) - frames), float(basis.noise.variance.mean())
    left_over = basis.outside + inside
    parts = (left_over - variance * basis.data, GROSS), (inside - variance * basis.stack.size, _MISFIT)
    unexplained = [(math.sqrt(max(part, 0.0) / (basis.energy or 1.0)), most) for part, most in parts]
    slices = found.image.astype(np.float64)
    depths_mm = 1 / (inverse + shifts)
    light = slices.sum(axis=(1, 2))
    # Without bounds, noise gives slices light of either sign.
    least = max(_END * float(light.sum()), -float(light.min()))
    at_end = any(light[end] > max(light[inner], least) for end, inner in ((0, 1), (-1, -2))) if count > 1 else False
    if at_end and not doubt:
        doubt = (
            f"End of range: light piles up at an end of {depths_mm.min():.4g} to {depths_mm.max():.4g} mm, so that the "
            "scene may lie outside; give a wider range with --depth-range NEAR:FAR or depth_range, and dots of a "
            "period as long."
        )
    if any(part > most for part, most in unexplained) and not doubt:
        doubt = (
            f"Misfit: {unexplained[0][0]:.0%} of the frames is left unexplained; check that the camera is the "
            "calibrated one, and give the range of the scene's depths."
        )
    lowered = f"the last half of {found.iterations} iterations lowered the objective by {found.fall:.1%}"
    status = Status(Verdict.SOLVED, f"Solved: a reflectance for each projector pixel at {count} depths; {lowered}")
    if found.fall > _TOLERANCE:
        status = Status(Verdict.NOT_CONVERGED, f"Not converged: {lowered} or more", "allow more iterations")
    image = slices.sum(axis=0)
    mm, confidence = mean_depth(slices, depths_mm, 1 / inverse)
    residual = math.sqrt(left_over / basis.energy) if basis.energy else 0.0
    solution = Solution(image, known, residual, status, None, found.iterations, found.objective)
    sizes = left_over, basis.energy, basis.data, basis.part
    range_mm = float(depths_mm.min()), float(depths_mm.max())
    return Volume(
        image, mm, confidence, known, *sizes, doubt, range_mm,
        slices=slices, depths_mm=depths_mm, solution=solution,
    )  # fmt: skip


def mean_depth(
    slices: FloatArray, depths_mm: FloatArray, dark_mm: float, least: float = float(np.finfo(np.float32).eps)
) -> tuple[FloatArray, FloatArray]:
    """Return the mean depth (n, n') of ``slices`` (D, n, n') and its confidence.

    Pixels with less than the part ``least`` of the brightest pixel's light have ``dark_mm``, and no confidence.
    """
    weights = np.maximum(slices, 0.0)
    total = weights.sum(axis=0)
    dark = total <= least * float(total.max())
    share = np.where(dark, 0.0, weights / np.where(dark, 1.0, total))
    # Neighbouring depths share the light of a surface between them.
    pairs = share[:-1] + share[1:] if len(slices) > 1 else share
    return np.where(dark, dark_mm, np.tensordot(depths_mm, share, axes=1)), pairs.max(axis=0)
