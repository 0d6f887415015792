"""Image within bounds from frames, patterns and a measured point spread function.

A diffuser before a bare sensor casts one pattern of light h from every scene point, shifted by its place (Antipa et
al., Optica 5, 1, 2018). One scene pixel shifts h by one sensor pixel. Under the pattern P_i (arXiv 2111.12862, section
"Coded Illumination with Nonseparable Systems") the frame is Y_i = crop(h * (P_i o X)). Minimised over all X within
bounds is

    P(X) = 1/2 sum_i ||Y_i - crop(h * (P_i o X))||^2 + weight TV(X) + ridge / 2 ||X||^2

**Scene.** Under uniform light the scene is everything that can put light on the sensor: frames of m pixels and h of k
have m + k - 1 scene pixels a side. The image is its middle, as large as the sensor. Under patterns the scene is
theirs, and dark beyond.

**Method.** Passes of a few steps of conjugate gradients in the pixels that bounds leave free are each followed by a
projection on the bounds (Moré and Toraldo, SIAM J. Optim. 1, 1991). Because |H|^2 spans seven decades, steps are
preconditioned by a division by |H|^2 + mu and start from the image at half the size. TV is quadratic for small slopes,
and in each pass replaced by the quadratic that touches it. The iterations end where the last half of all steps has
lowered the objective by at most ``tolerance`` of itself (Strakos and Tichy, ETNA 13, 2002).

**Dots.** Under dots of period k no pixel is in two frames, so that the normal equations fall into k^2 independent
systems, one for the n^2/k^2 pixels of each *class* that shines together, as in the paper's equation 8. Where the sensor
gets all light, the matrix of a class is a section of one convolution with h's autocorrelation at every k-th place,

    G[p, p'] = sum over sensor pixels s of h[s - p] h[s - p'],       p - p' a multiple of k,

and is solved on grids of 2n/k pixels a side.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import fft

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import PatternFamily
from mitsim.reconstruct.solution import Solution, Status, Verdict
from mitsim.reconstruct.solver import check_lambda
from mitsim.reconstruct.solvers import Prior, lengths, slopes_adjoint, slopes_of

Array = npt.NDArray[Any]
Operator = Callable[[FloatArray], FloatArray]

_MU = 10.0
_COARSE_STEPS, _LEAST_SIDE = 60, 32
_SMOOTH = 1e-3
_FIRST_SMOOTH, _SHARPENED = 10.0, 0.3
"""Smoothing slope of the first pass, and its ratio between passes; large weights otherwise need five times the steps.
"""
_PASS, _PASS_UNBOUND = 6, 12
_NOTHING = 1e-300
_FEWEST = 1e-12


# ---- The camera ------------------------------------------------------------------------------------------------------


@dataclass(eq=False)
class ShiftedLight:
    """Camera whose scene points all cast one pattern of light ``psf`` (k, k').

    ``patterns`` are P_L (n, K) and P_R (n', K'), or None for uniform light. ``seen`` (m, m') is 0 for held-out pixels.
    ``scene`` and ``whole`` are the sizes of the scene and of its light, whose first pixel is ``origin`` on the sensor;
    ``window`` is the part of the scene that is the image. Light that wraps round ``grid`` lands beside the sensor.
    """

    psf: FloatArray
    sensor: tuple[int, int]
    patterns: tuple[FloatArray, FloatArray] | None = None
    precision: Any = np.float64
    seen: Array | None = None
    scene: tuple[int, int] = field(init=False)
    whole: tuple[int, int] = field(init=False)
    origin: tuple[int, int] = field(init=False)
    window: tuple[slice, slice] = field(init=False)
    count: int = field(init=False)
    grid: tuple[int, int] = field(init=False)

    def __post_init__(self) -> None:
        if self.psf.ndim != 2 or not np.isfinite(self.psf).all() or not self.psf.any():
            raise MitsimError(f"point spread function of shape {self.psf.shape}: give finite rows x columns, not all 0")
        (rows, columns), (m, n), self.count = self.psf.shape, self.sensor, 1
        self.scene, self.window = (m + rows - 1, n + columns - 1), (slice(None), slice(None))
        if self.patterns is None:
            up, before = (rows - 1) // 2, (columns - 1) // 2
            self.window = slice(up, up + m), slice(before, before + n)
        else:
            left, right = self.patterns
            self.scene, self.count = (len(left), len(right)), left.shape[1] * right.shape[1]
        self.whole = self.scene[0] + rows - 1, self.scene[1] + columns - 1
        self.origin = (self.whole[0] - m) // 2, (self.whole[1] - n) // 2
        self._crop = slice(self.origin[0], self.origin[0] + m), slice(self.origin[1], self.origin[1] + n)
        sides = zip(self.scene, self.whole, self.origin, self.sensor, strict=True)
        down, across = (
            fft.next_fast_len(max(scene, whole - origin, origin + size), real=True)
            for scene, whole, origin, size in sides
        )
        self.grid = down, across
        for size, most in zip(self.sensor, self.whole, strict=True):
            if size > most:
                raise MitsimError(
                    f"frames of {self.sensor[0]} x {self.sensor[1]} pixels: light reaches {self.whole[0]} x "
                    f"{self.whole[1]} of them; give a point spread function of the frames' pixels, or patterns of more"
                )

    @classmethod
    def of(cls, psf: FloatArray, n: int, sensor: tuple[int, int] | None = None) -> ShiftedLight:
        if n < 1:
            raise MitsimError(f"scene of {n} pixels a side; give at least 1")
        rows, columns = (size + n - 1 for size in psf.shape)
        return cls(psf, sensor or (rows, columns), (np.ones((n, 1)), np.ones((n, 1))))

    def under(self, family: PatternFamily) -> ShiftedLight:
        if (family.n, family.n) != self.scene:
            raise MitsimError(
                f"patterns of {family.n} pixels a side for a scene of {self.scene[0]}; both need the same"
            )
        return replace(self, patterns=(family.left.astype(np.float64), family.right.astype(np.float64)))

    def check_frames(self, frames: Array) -> None:
        if frames.shape != (self.count, *self.sensor) or not np.isfinite(frames).all():
            raise MitsimError(
                f"frames of shape {frames.shape}: give {self.count} of {self.sensor[0]} x {self.sensor[1]} finite "
                "numbers"
            )

    def image_of(self, scene: Array) -> Array:
        frames = np.empty((self.count, *self.sensor), self.precision)
        rows, columns = self._crop
        for frame, light in zip(frames, self._lights, strict=True):
            seen = fft.rfft2(scene if light is None else light * scene, self.grid)
            seen *= self.spectrum
            # Rows beside the sensor are not made: a quarter of the time.
            frame[:] = fft.irfft(fft.ifft(seen, axis=0, overwrite_x=True)[rows], self.grid[1])[:, columns]
        return frames if self.seen is None else frames * self.seen

    def correlate(self, frames: Array) -> Array:
        """Return the adjoint (n, n') of :meth:`image_of` for ``frames`` (K K', m, m')."""
        (rows, columns), total = self.scene, np.zeros(self.scene, self.precision)
        placed = np.zeros((self.sensor[0], self.grid[1]), self.precision)
        for frame, light in zip(frames, self._lights, strict=True):
            placed[:, self._crop[1]] = frame
            seen = np.zeros_like(self.spectrum)
            seen[self._crop[0]] = fft.rfft(placed)
            seen = fft.fft(seen, axis=0, overwrite_x=True) * self.spectrum.conj()
            part = fft.irfft2(seen, self.grid)[:rows, :columns]
            total += part if light is None else light * part
        return total

    def half_size(self) -> ShiftedLight | None:
        """Return the camera at half the size; None under patterns, with held-out pixels, or if too small."""
        small = min(*self.psf.shape, *self.sensor) // 2 < _LEAST_SIDE
        return None if small or self.patterns is not None or self.seen is not None else self.reduce(2)

    def reduce(self, factor: int) -> ShiftedLight:
        rows, columns = (size // factor for size in self.sensor)
        return replace(self, psf=factor**2 * reduce_frame(self.psf, factor), sensor=(rows, columns))

    def double(self, smaller: Array) -> Array:
        """Return the image (n, n') of a ``smaller`` one of :meth:`half_size`, linear between its pixels.

        Pixel p of the smaller image is at 2 p + 1 for light of an even number of pixels, at 2 p + 2 for an odd one.
        """
        image = np.zeros(self.scene, self.precision)
        place = image[tuple(slice(k % 2, None) for k in self.psf.shape)]
        for axis in (0, 1):
            smaller = np.repeat(smaller, 2, axis=axis)
            before = np.roll(smaller, 1, axis=axis)
            smaller = (smaller + before) / 2
        rows, columns = (min(sizes) for sizes in zip(place.shape, smaller.shape, strict=True))
        place[:rows, :columns] = smaller[:rows, :columns]
        return image

    def divisor(self, ridge: float, slope_weight: float) -> Array:
        """Return 1 / (|H|^2 + mu + ridge - slope_weight Laplacian), the preconditioner under uniform light."""
        total = np.square(np.abs(self.spectrum)) + _MU * float(np.square(self.psf).sum()) + ridge
        if slope_weight:
            rows, columns = (2 - 2 * np.cos(2 * np.pi * np.arange(size) / size) for size in self.grid)
            total += slope_weight * (rows[:, None] + columns[: total.shape[1]])
        return np.asarray(1 / total, self.precision)

    @property
    def column_power(self) -> float:
        power = float(np.square(self.psf).sum())
        if self.patterns is None:
            return power
        left, right = (float(np.square(side).sum(axis=1).mean()) for side in self.patterns)
        return power * left * right

    @cached_property
    def spectrum(self) -> Array:
        return np.asarray(fft.rfft2(self.psf.astype(self.precision), self.grid))

    @property
    def _lights(self) -> Iterable[Array | None]:
        if self.patterns is None:
            return [None]
        left, right = (side.T.astype(self.precision) for side in self.patterns)
        return (np.outer(row, column) for row in left for column in right)


def reduce_frame(frame: Array, reduce: int) -> Array:
    rows, columns = (size // reduce for size in frame.shape)
    blocks = frame[: rows * reduce, : columns * reduce].reshape(rows, reduce, columns, reduce)
    return np.asarray(blocks.mean(axis=(1, 3)), frame.dtype)


# ---- The objective at one image --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _State:
    light: ShiftedLight
    prior: Prior
    image: Array
    residual: Array
    smooth: float

    @cached_property
    def _slopes(self) -> Array:
        return lengths(slopes_of(self.image))

    @cached_property
    def objective(self) -> float:
        squares = _dot(self.residual, self.residual) + self.prior.ridge * _dot(self.image, self.image)
        if not self.prior.weight:
            return squares / 2
        return squares / 2 + self.prior.weight * float(self._slopes.sum(dtype=np.float64))

    @cached_property
    def smoothed(self) -> float:
        if not self.prior.weight:
            return self.objective
        low = np.minimum(self._slopes, self.smooth)
        flattened = float(low.sum(dtype=np.float64)) - _dot(low, low) / (2 * self.smooth)
        return self.objective - self.prior.weight * flattened

    @cached_property
    def gradient(self) -> Array:
        return self.light.correlate(self.residual) + self.bend(self.image)

    def bend(self, direction: Array) -> Array:
        bent = self.prior.ridge * direction
        if self.prior.weight:
            stiffness = self.prior.weight / np.maximum(self._slopes, self.smooth)
            bent += slopes_adjoint(slopes_of(direction) * stiffness)
        return bent

    @property
    def free(self) -> npt.NDArray[np.bool_]:
        low, high = self.prior.bounds
        free = np.ones(self.image.shape, dtype=bool)
        if math.isfinite(low):
            free &= (self.image > low) | (self.gradient < 0)
        if math.isfinite(high):
            free &= (self.image < high) | (self.gradient > 0)
        return free

    def move(self, direction: Array, seen: Array, length: float) -> _State:
        image = self.image + length * direction
        if not self.prior.bounded:
            return replace(self, image=image, residual=self.residual + length * seen)
        np.clip(image, *self.prior.bounds, out=image)
        return replace(self, image=image, residual=self.residual + self.light.image_of(image - self.image))

    @cached_property
    def _divisor(self) -> Array:
        return self.light.divisor(self.prior.ridge, self.prior.weight / self.smooth if self.prior.weight else 0.0)

    def divide(self, image: Array) -> Array:
        if self.light.patterns is not None:
            return image
        rows, columns = image.shape
        turned = fft.rfft2(image, self.light.grid) * self._divisor
        return np.asarray(fft.irfft2(turned, self.light.grid)[:rows, :columns])


def _dot(first: Array, second: Array) -> float:
    return float(np.vdot(first, second))


# ---- Minimising ------------------------------------------------------------------------------------------------------


class Minimum(NamedTuple):
    """Image (n, n') of the whole scene near the minimum; ``fall`` is the objective's in the last half of the steps."""

    image: Array
    iterations: int
    objective: float
    fall: float


def minimise(light: ShiftedLight, frames: Array, prior: Prior, iterations: int, tolerance: float) -> Minimum:
    """Return the image whose objective falls by at most ``tolerance`` of itself in the last half of the steps."""
    state, spent, fall = _descend(_start(light, frames, prior), iterations, tolerance)
    return Minimum(state.image, spent, state.objective, fall)


def _start(light: ShiftedLight, frames: Array, prior: Prior) -> _State:
    low, high = prior.bounds
    smaller = light.half_size()
    if smaller:
        # Half as many pixels a side: TV of the same scene is a half, squares are a quarter.
        half = replace(prior, weight=prior.weight / 2)
        found = _descend(
            _start(smaller, np.stack([reduce_frame(each, 2) for each in frames]), half), _COARSE_STEPS, 0.0
        )[0]
        image = light.double(found.image)
    else:
        image = np.zeros(light.scene, light.precision)
    image = np.clip(image, low, high)
    start = _State(light, prior, image, light.image_of(image) - frames, 0.0)
    if prior.weight and not smaller:
        # Least squares first: they tell how bright the scene is.
        unweighted = replace(start, prior=replace(prior, weight=0.0))
        found = _descend(unweighted, 2 * _PASS, 0.0)[0]
        start = replace(found, prior=prior)
    peak = float(np.abs(start.image).max())
    return replace(start, smooth=_SMOOTH * peak or _SMOOTH)


def _descend(state: _State, iterations: int, tolerance: float) -> tuple[_State, int, float]:
    sharp, most = state.smooth, _PASS if state.prior.bounded else _PASS_UNBOUND
    state = replace(state, smooth=_FIRST_SMOOTH * sharp)
    spent, fall, objectives = 0, math.inf, [(0, state.objective)]
    while spent < iterations and fall > tolerance:
        direction, seen, promised = _pass(state, min(most, iterations - spent))
        length, following = 1.0, state.move(direction, seen, 1.0)
        while following.smoothed > state.smoothed and length > _FEWEST:
            length /= 2
            following = state.move(direction, seen, length)
        still = promised <= 0 or length <= _FEWEST
        ended = still and state.smooth == sharp
        if not still:
            state, spent = following, min(spent + most, iterations)
            objectives.append((spent, state.objective))
        state = replace(state, smooth=max(_SHARPENED * state.smooth, sharp))
        if ended or (len(objectives) > 2 and state.smooth == sharp):
            earlier = next(objective for steps, objective in reversed(objectives) if 2 * steps <= spent)
            fall = max(earlier - state.objective, promised) / max(state.objective, _NOTHING)
        if ended:
            break
    return state, spent, fall


def _pass(state: _State, steps: int) -> tuple[Array, Array, float]:
    free = state.free
    left = np.where(free, state.gradient, 0)
    total, seen = np.zeros_like(left), np.zeros_like(state.residual)
    direction, power, promised = np.zeros_like(left), math.inf, 0.0
    for step in range(steps):
        turned = state.divide(left) * free
        before, power = power, _dot(left, turned)
        if power <= 0:
            break
        direction = (power / before) * direction - turned
        ahead, bent = state.light.image_of(direction), state.bend(direction)
        length = power / max(_dot(ahead, ahead) + _dot(direction, bent), _NOTHING)
        total += length * direction
        seen += length * ahead
        promised += length * power / 2
        if step < steps - 1:
            bent += state.light.correlate(ahead)
            bent *= free
            left += length * bent
    return total, seen, promised


# ---- The misfit ------------------------------------------------------------------------------------------------------

_BETTER, _EQUAL = 0.85, 0.98
"""Cost ratios of the best turned copy below which it is recommended, and below which the light is wrong."""
_LEAST_GAIN, _RISE, _NOISY = 1.015, 0.02, 1.2
"""Least cost ratio of right light: the first times chi-square to the second; noise explains frames below the last."""
_OFF = 1 / 8
_GROSS, _GROSS_CHI_SQUARE = 0.1, 4.0


@dataclass(frozen=True)
class PointSpreadFit:
    """Fit of frames to a point spread function.

    ``gain`` is the cost of the best turned or mirrored copy (``reading``) over that of the light as given, None where
    all are alike. ``off`` is the distance [rows, columns] from the middle of the picture to the light's centre.
    """

    chi_square: float
    unexplained: float
    stated: bool
    gain: float | None
    reading: str
    off: tuple[float, float]
    size: tuple[int, int]

    @property
    def fault(self) -> tuple[str, str]:
        left = (
            f"{self.unexplained:.1%} of the frames is left unexplained, {self.chi_square:.3g} times the noise's energy"
        )
        same = "use the light of one point as this camera sees it, as it lies in the frames"
        if self.gain is not None and self.gain < _BETTER:
            return f"Misfit: the point spread function fits better {self.reading}; {left}", f"turn it so, or {same}"
        least = _EQUAL if self.chi_square < _NOISY else _LEAST_GAIN * self.chi_square**_RISE
        if self.gain is not None and self.gain < least:
            return f"Misfit: the point spread function fits no better as given than {self.reading}; {left}", same
        if self.unexplained > _GROSS and self.chi_square > _GROSS_CHI_SQUARE:
            return f"Misfit: {left}", same
        rows, columns = self.off
        if max(abs(rows) / self.size[0], abs(columns) / self.size[1]) > _OFF:
            return (
                f"Misfit: the point's light is centred {rows:+.0f} rows and {columns:+.0f} columns from the middle of "
                "its picture, and the image is displaced as much",
                "take the picture of a point in the middle of the field, or shift it there",
            )
        return "", ""

    @property
    def gist(self) -> str:
        return f"{self.unexplained:.1%} unexplained"

    def __str__(self) -> str:
        noise = "its stated noise" if self.stated else "noise, measured from the frames"
        cost = "" if self.gain is None else f"; turned or mirrored, the light costs {self.gain:.3g} times as much"
        return f"misfit: {self.unexplained:.1e} unexplained, chi-square {self.chi_square:.3g} against {noise}{cost}"

    def summary(self) -> dict[str, Any]:
        sentence, _ = self.fault
        return {
            "chi_square": self.chi_square,
            "unexplained": self.unexplained,
            "noise_stated": self.stated,
            "flagged": bool(sentence),
            "turned_cost": self.gain,
            "reading": self.reading if self.gain is not None and self.gain < _BETTER else None,
            "off_centre": list(self.off),
        }

    def judge(self, status: Status) -> Status:
        sentence, remedy = self.fault
        if not sentence:
            return status
        if not status.verdict.good:
            return replace(status, flags=(*status.flags, f"{sentence}; {remedy}."))
        return replace(status, verdict=Verdict.MISFIT, sentence=sentence, remedy=remedy)


# ---- Least squares of many frames: conjugate gradients, and the classes of dots --------------------------------------


def solve_iteratively(
    camera: ShiftedLight,
    frames: FloatArray,
    lam: float,
    tolerance: float = 1e-6,
    iterations: int = 500,
    watch: Callable[[FloatArray], bool] | None = None,
) -> Solution:
    """Return the least squares with lambda ||X||^2 of all frames (K K', m, m') under any patterns."""
    camera.check_frames(frames)
    target = camera.correlate(frames)
    return conjugate_gradients(
        lambda image: camera.correlate(camera.image_of(image)), target, lam, None, tolerance, iterations, watch
    )


def conjugate_gradients(
    normal: Operator,
    target: FloatArray,
    lam: float | str,
    inverse: Operator | None = None,
    tolerance: float = 1e-6,
    most: int = 500,
    watch: Callable[[FloatArray], bool] | None = None,
) -> Solution:
    """Solve (``normal`` + lambda) X = ``target`` (Hestenes and Stiefel 1952).

    The preconditioner ``inverse`` is symmetric and positive. Steps end early when ``watch`` returns True.
    """
    lam = check_lambda(lam)
    image, left = np.zeros_like(target), target
    size = float(np.linalg.norm(target)) or 1.0
    turned = inverse(left) if inverse else left
    direction, power, spent = turned, float(np.vdot(left, turned)), 0
    residual = float(np.linalg.norm(left)) / size
    while residual > tolerance and spent < most:
        spent += 1
        moved = normal(direction) + lam * direction
        step = power / float(np.vdot(direction, moved))
        image, left = image + step * direction, left - step * moved
        residual = float(np.linalg.norm(left)) / size
        if watch and watch(image):
            break
        turned = inverse(left) if inverse else left
        before, power = power, float(np.vdot(left, turned))
        direction = turned + power / before * direction
    figures = f"Residual of the normal equations {residual:.0e} after {spent} iterations."
    if residual > tolerance:
        remedy = "allow more iterations, a larger tolerance or a larger lambda"
        status = Status(Verdict.NOT_CONVERGED, f"Not converged to {tolerance:g}", remedy, figures)
    else:
        status = Status(Verdict.SOLVED, "Solved", "", figures)
    return Solution(image, lam, residual, status, iterations=spent)


class DotClasses:
    """A ``camera`` that gets all light, under shifting dots of period ``k``; 1 is uniform light."""

    def __init__(self, camera: ShiftedLight, k: int) -> None:
        self.camera, self.k, self._n = camera, k, camera.scene[0]
        if not 1 <= k <= self._n:
            raise MitsimError(f"dots of period {k}: give 1 to {self._n}, the scene's pixels a side")
        if camera.sensor != camera.whole:
            raise MitsimError(f"sensor of {camera.sensor}: classes of dots are solved where it gets all light")
        self._side = -(-self._n // k)
        self._grid = [fft.next_fast_len(-(-size // k)) for size in camera.whole]
        self._spectrum = fft.fft2(camera.psf, tuple(k * size for size in self._grid))
        power = self._fold(np.square(np.abs(self._spectrum))).real
        self.largest = float(power.max())
        size = fft.next_fast_len(2 * self._side - 1, real=True)
        steps = (np.arange(size) + size // 2) % size - size // 2
        near = np.abs(steps) < self._side
        rows, columns = (steps % length for length in self._grid)
        self._kernel = fft.rfft2(np.where(np.outer(near, near), fft.ifft2(power).real[np.ix_(rows, columns)], 0.0))
        self._size = size, size

    def project(self, frames: FloatArray) -> FloatArray:
        """Return the right side (n, n) of the normal equations of all frames (k^2, m, m')."""
        replace(self.camera, patterns=(np.ones((self._n, self.k)),) * 2).check_frames(frames)
        weight, (rows, columns) = self._spectrum.conj(), self.camera.sensor
        classes = np.empty((self.k, self.k, self._side, self._side))
        for (a, b), frame in zip(product(range(self.k), repeat=2), frames, strict=True):
            placed = np.zeros(weight.shape)
            # Moved so that the class's first pixel is the first number.
            placed[:rows, :columns] = frame
            placed = np.roll(placed, (-a, -b), axis=(0, 1))
            light = fft.ifft2(self._fold(fft.fft2(placed) * weight))
            classes[a, b] = light.real[: self._side, : self._side]
        return self._join(classes)

    def solve(self, projected: FloatArray, lam: float, tolerance: float = 1e-6) -> Solution:
        return conjugate_gradients(self._normal, projected, lam, None, tolerance)

    def _normal(self, image: FloatArray) -> FloatArray:
        room = self._side * self.k - self._n
        padded = np.pad(image, ((0, room), (0, room)))
        classes = padded.reshape(self._side, self.k, self._side, self.k).transpose(1, 3, 0, 2)
        whole = fft.irfft2(fft.rfft2(classes, self._size) * self._kernel, self._size)
        return self._join(whole[..., : self._side, : self._side])

    def _fold(self, spectrum: Array) -> Array:
        rows, columns = self._grid
        return np.asarray(spectrum.reshape(self.k, rows, self.k, columns).mean(axis=(0, 2)))

    def _join(self, classes: FloatArray) -> FloatArray:
        size = self._side * self.k
        return np.ascontiguousarray(classes.transpose(2, 0, 3, 1).reshape(size, size)[: self._n, : self._n])
