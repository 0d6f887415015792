"""Image within bounds from frames, patterns and a measured point spread function.

A diffuser before a bare sensor casts one pattern of light h from every scene point, shifted by its place (Antipa et
al., Optica 5, 1, 2018). One scene pixel shifts h by one sensor pixel. Under the pattern P_i (arXiv 2111.12862, section
"Coded Illumination with Nonseparable Systems") the frame is Y_i = crop(h * (P_i o X)). Minimised over all X within
bounds (:mod:`mitsim.reconstruct.descent`) is

    P(X) = 1/2 sum_i ||Y_i - crop(h * (P_i o X))||^2 + weight TV(X) + ridge / 2 ||X||^2 .

docs/convolutional.md states the size of the scene, the automatic weight and the check of the fit.

**Dots.** Under dots of period k no pixel is in two frames, so that the normal equations fall into k^2 independent
systems, one for the n^2/k^2 pixels of each *class* that shines together, as in the paper's equation 8. Where the sensor
gets all light, the matrix of a class is a section of one convolution with h's autocorrelation at every k-th place,

    G[p, p'] = sum over sensor pixels s of h[s - p] h[s - p'],       p - p' a multiple of k,

and is solved on grids of 2n/k pixels a side.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy import fft
from scipy.ndimage import affine_transform, gaussian_filter, maximum_filter
from scipy.optimize import minimize

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, cut
from mitsim.core.headline import each_once
from mitsim.core.images import reduce_frame
from mitsim.core.job import Cost, Job, Limits
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import Capture
from mitsim.core.seeds import stream
from mitsim.devices.camera import load_psf
from mitsim.devices.patterns import PatternFamily
from mitsim.reconstruct.descent import Array, minimise
from mitsim.reconstruct.light_list import Lights, blend, load_lights
from mitsim.reconstruct.reconstruct import (
    MOST_SCALE,
    MOST_TURN_DEG,
    POINT_SPREAD,
    Mending,
    PointSpreadFit,
    Reconstruction,
)
from mitsim.reconstruct.request import LIST, TIKHONOV, TV, Bounds, ImageRequest
from mitsim.reconstruct.solver import Solution, Status, Verdict, check_lambda
from mitsim.reconstruct.solvers import Prior
from mitsim.reconstruct.volume import Volume, mean_depth

Operator = Callable[[FloatArray], FloatArray]
Change = Callable[[FloatArray], Mending]
Pair = tuple[FloatArray, FloatArray]

_LEAST_SIDE = 32


# ---- The camera ------------------------------------------------------------------------------------------------------


@dataclass(eq=False)
class ShiftedLight:
    """Camera whose scene points all cast one pattern of light ``psf`` (k, k'), or one of several (D, k, k').

    Several are those of a scene (D, n, n') of D depths or, with ``places`` (D, 2) [pixels, from the middle of the
    frame], of a scene (n, n') whose points cast their :func:`blend`.
    ``patterns`` are P_L (n, K) and P_R (n', K'), or None for uniform light. ``seen`` (m, m') is 0 for held-out pixels.
    ``scene`` and ``whole`` are the sizes of the scene and of its light, whose first pixel is ``origin`` on the sensor;
    ``window`` is the part of the scene that is the image. Light that wraps round ``grid`` lands beside the sensor.
    """

    psf: FloatArray
    sensor: tuple[int, int]
    patterns: tuple[FloatArray, FloatArray] | None = None
    precision: Any = np.float64
    seen: Array | None = None
    places: FloatArray | None = None
    scene: tuple[int, ...] = field(init=False)
    whole: tuple[int, int] = field(init=False)
    origin: tuple[int, int] = field(init=False)
    window: tuple[slice, ...] = field(init=False)
    count: int = field(init=False)
    grid: tuple[int, int] = field(init=False)

    def __post_init__(self) -> None:
        if self.psf.ndim not in (2, 3) or not np.isfinite(self.psf).all() or not self.psf.any(axis=(-2, -1)).all():
            raise MitsimError(f"point spread function of shape {self.psf.shape}: give finite rows x columns, not all 0")
        (rows, columns), (m, n), self.count = self.psf.shape[-2:], self.sensor, 1
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
        self._plane = self.scene
        sides = zip(self._plane, self.whole, self.origin, self.sensor, strict=True)
        least = (max(scene, whole - origin, origin + size) for scene, whole, origin, size in sides)
        down, across = (fft.next_fast_len(each, real=True) for each in least)
        self.grid = down, across
        for size, most in zip(self.sensor, self.whole, strict=True):
            if size > most:
                raise MitsimError(
                    f"frames of {self.sensor[0]} x {self.sensor[1]} pixels: light reaches {self.whole[0]} x "
                    f"{self.whole[1]} of them; give a point spread function of the frames' pixels, or patterns of more"
                )
        if self.deep:
            self.scene, self.window = (len(self.psf), *self.scene), (slice(None), *self.window)

    @property
    def deep(self) -> bool:
        return self.psf.ndim == 3 and self.places is None

    @classmethod
    def of(cls, psf: FloatArray, n: int, sensor: tuple[int, int] | None = None) -> ShiftedLight:
        if n < 1:
            raise MitsimError(f"scene of {n} pixels a side; give at least 1")
        rows, columns = (size + n - 1 for size in psf.shape)
        return cls(psf, sensor or (rows, columns), (np.ones((n, 1)), np.ones((n, 1))))

    def under(self, family: PatternFamily) -> ShiftedLight:
        if (family.n, family.n) != self._plane:
            sizes = f"patterns of {family.n} pixels a side for a scene of {self._plane[0]}"
            raise MitsimError(f"{sizes}; both need the same")
        return replace(self, patterns=(family.left.astype(np.float64), family.right.astype(np.float64)))

    def check_frames(self, frames: Array) -> None:
        if frames.shape != (self.count, *self.sensor) or not np.isfinite(frames).all():
            size = f"{self.count} of {self.sensor[0]} x {self.sensor[1]}"
            raise MitsimError(f"frames of shape {frames.shape}: give {size} finite numbers")

    def image_of(self, scene: Array) -> Array:
        frames = np.empty((self.count, *self.sensor), self.precision)
        rows, columns = self._crop
        for frame, light in zip(frames, self._lights, strict=True):
            seen = np.zeros((), self.spectrum.dtype)
            for part, weight, spectrum in self._parts(scene, light):
                one = fft.rfft2(part if weight is None else weight * part, self.grid)
                one *= spectrum
                seen = seen + one
            # Rows beside the sensor are not made: a quarter of the time.
            frame[:] = fft.irfft(fft.ifft(seen, axis=0, overwrite_x=True)[rows], self.grid[1])[:, columns]
        return frames if self.seen is None else frames * self.seen

    def correlate(self, frames: Array) -> Array:
        """Return the adjoint, a scene, of :meth:`image_of` for ``frames`` (K K', m, m')."""
        (rows, columns), total = self._plane, np.zeros(self.scene, self.precision)
        placed = np.zeros((self.sensor[0], self.grid[1]), self.precision)
        for frame, light in zip(frames, self._lights, strict=True):
            placed[:, self._crop[1]] = frame
            seen = np.zeros(self.spectrum.shape[-2:], self.spectrum.dtype)
            seen[self._crop[0]] = fft.rfft(placed)
            seen = fft.fft(seen, axis=0, overwrite_x=True)
            for own, weight, spectrum in self._parts(total, light):
                part = fft.irfft2(seen * spectrum.conj(), self.grid)[:rows, :columns]
                own += part if weight is None else weight * part
        return total

    def half_size(self) -> ShiftedLight | None:
        """Return the camera at half the size; None under patterns, with held-out pixels, or if too small."""
        small = min(*self.psf.shape[-2:], *self.sensor) // 2 < _LEAST_SIDE
        return None if small or self.patterns is not None or self.seen is not None else self.reduce(2)

    def reduce(self, factor: int) -> ShiftedLight:
        rows, columns = (size // factor for size in self.sensor)
        places = None if self.places is None else self.places / factor
        return replace(self, psf=factor**2 * reduce_frame(self.psf, factor), sensor=(rows, columns), places=places)

    def double(self, smaller: Array) -> Array:
        """Return the scene of a ``smaller`` one of :meth:`half_size`, linear between its pixels.

        Pixel p of the smaller image is at 2 p + 1 for light of an even number of pixels, at 2 p + 2 for an odd one.
        """
        image = np.zeros(self.scene, self.precision)
        place = image[..., self.psf.shape[-2] % 2 :, self.psf.shape[-1] % 2 :]
        for axis in (-2, -1):
            smaller = np.repeat(smaller, 2, axis=axis)
            before = np.roll(smaller, 1, axis=axis)
            smaller = (smaller + before) / 2
        rows, columns = (min(sizes) for sizes in zip(place.shape[-2:], smaller.shape[-2:], strict=True))
        place[..., :rows, :columns] = smaller[..., :rows, :columns]
        return image

    def preconditioner(self, ridge: float, slope_weight: float) -> Operator:
        """Return the division by |H|^2 + mu + ridge - slope_weight Laplacian under uniform light, else the identity.

        With D depths the divisor is, for each frequency, the matrix d 1 + conj(H) H^T of rank one beside d = mu + ridge
        - slope_weight Laplacian, whose inverse is that of Sherman and Morrison.
        """
        if self.patterns is not None:
            return lambda image: image
        power, deep = np.square(np.abs(self.spectrum)), self.deep
        power = power.mean(axis=0) if self.places is not None else power.sum(axis=0) if deep else power
        total = (np.zeros_like(power) if deep else power) + (1.0 if deep else 10.0) * self._power + ridge
        if slope_weight:
            rows, columns = (2 - 2 * np.cos(2 * np.pi * np.arange(size) / size) for size in self.grid)
            # A slice has two neighbours.
            total += slope_weight * (rows[:, None] + columns[: power.shape[1]] + (2 if deep else 0))
        divisor = np.asarray(1 / total, self.precision)
        shared = np.asarray(1 / (total + power), self.precision)

        def divide(image: Array) -> Array:
            rows, columns = self._plane
            left = fft.rfft2(image, self.grid)
            if deep:
                left -= self.spectrum.conj() * (shared * (self.spectrum * left).sum(axis=0))
            left *= divisor
            return np.asarray(fft.irfft2(left, self.grid)[..., :rows, :columns])

        return divide

    @property
    def _power(self) -> float:
        return float(np.square(self.psf).sum()) / (1 if self.psf.ndim == 2 else len(self.psf))

    @property
    def column_power(self) -> float:
        power = self._power
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

    @cached_property
    def _blend(self) -> Array:
        """Return the weights (D, n, n') of the lights at each place of the scene."""
        assert self.places is not None
        sides = zip(self._plane, self.origin, self.psf.shape[-2:], self.sensor, strict=True)
        rows, columns = (np.arange(n) - origin + (k - m) / 2 for n, origin, k, m in sides)
        return blend(self.places, rows, columns).astype(self.precision)

    def _parts(self, scene: Array, light: Array | None) -> Iterable[tuple[Array, Array | None, Array]]:
        """Return parts of a ``scene`` under one pattern, their weights, and the spectra that they are seen by."""
        if self.psf.ndim == 2:
            return [(scene, light, self.spectrum)]
        if self.deep:
            return ((part, light, spectrum) for part, spectrum in zip(scene, self.spectrum, strict=True))
        weights = (weight if light is None else light * weight for weight in self._blend)
        return ((scene, weight, spectrum) for weight, spectrum in zip(weights, self.spectrum, strict=True))


# ---- Noise, weight and misfit ----------------------------------------------------------------------------------------

_RIDGE, _WEIGHT = 50.0, 1.2
"""Lambda over the mean square of a pixel's light, by relative error; TV's weight in units of the gradient's error."""
_DEEP, _MOST, _MOST_DEEP = 0.2, 300, 1000
"""Weight of volumes over that of images (lambda: its square), whose slices are darker; steps of images and volumes."""
_LIT = 0.05
"""Part of the brightest pixel's light from which a pixel has a depth."""
_SIDE, _STEPS = 128, 60
_HALVES = range(-16, 7)
TURNED = {"turned by 180 degrees": (-1, -1), "mirrored left to right": (1, -1), "mirrored upside down": (-1, 1)}


def frame_noise(frame: Array) -> float:
    """Return the noise by mixed second differences (Immerkaer, Comput. Vis. Image Underst. 64, 1996)."""
    if min(frame.shape) < 3:
        return 0.0
    bent = np.diff(np.diff(frame, n=2, axis=0), n=2, axis=1)
    # The 9 weights have squares of 36 in all; half of normal numbers are below 0.6745 deviations.
    return float(np.median(np.abs(bent))) / 6 / 0.6745


def _shrink(light: ShiftedLight, frames: Array) -> tuple[ShiftedLight, Array, int]:
    factor = 1 if light.patterns else max(min(*light.sensor, *light.psf.shape[-2:]) // _SIDE, 1)
    return light.reduce(factor), reduce_frame(frames, factor), factor


def frame_error(light: ShiftedLight, frames: Array) -> float:
    """Return the deviation of ``frames`` (K K', m, m') from the light that a model explains.

    It is their noise or, if clearly larger, the noise whose ridge predicts held-out pixels best.
    """
    mean = float(frames.mean())
    if mean <= 0:
        raise MitsimError(f"frame of mean {mean:g}: lambda cannot be chosen; check exposure and black level")
    noise = math.sqrt(float(np.mean([frame_noise(frame) ** 2 for frame in frames])))
    if light.patterns is not None:
        return noise
    small, seen, _ = _shrink(light, frames)
    row, column = np.indices(small.sensor) // max(min(small.sensor) // 12, 1)
    counted = (row + 3 * column) % 8 > 0
    part = replace(small, seen=counted.astype(small.precision))

    @cache
    def error(half: int) -> float:
        prior = Prior(ridge=10 ** (half / 2) * small.column_power, bounds=(0.0, math.inf))
        scene = minimise(part, seen * part.seen, prior, _STEPS, 0.02).image
        return float(np.square((small.image_of(scene) - seen)[:, ~counted]).sum())

    best = 0
    while best in _HALVES and error(lower := min((best - 1, best + 1), key=error)) < error(best):
        best = lower
    before, here, after = (error(half) for half in (best - 1, best, best + 1))
    # The vertex of the parabola through these three.
    place = best + (before - after) / 2 / max(before - 2 * here + after, 1e-300)
    level = mean * 10 ** (place / 2) / _RIDGE
    return level if level > 2.0 * noise else noise


def find_fit(light: ShiftedLight, frames: Array, variance: float | None) -> PointSpreadFit:
    small, seen, factor = _shrink(light, frames)
    rows, columns = (max(size // 16, 1) for size in seen.shape[1:])
    strips = [strip for frame in seen for strip in np.array_split(frame, rows)]
    tiles = [tile for strip in strips for tile in np.array_split(strip, columns, axis=1)]
    measured = float(np.mean([frame_noise(tile) ** 2 for tile in tiles])) if variance is None else variance / factor**2
    noise = max(measured, 1e-300)
    error = math.hypot(math.sqrt(noise), 0.01 * float(seen.mean()))

    def cost(psf: FloatArray, rough: float) -> tuple[float, float]:
        camera = replace(small, psf=np.ascontiguousarray(psf))
        prior = Prior(weight=rough * error * math.sqrt(camera.column_power), bounds=(0.0, math.inf))
        found = minimise(camera, seen, prior, 2 * _STEPS, 0.002)
        return found.objective, float(np.mean(np.square(camera.image_of(found.image) - seen))) / noise

    rough, fine = (3.0, 0.3)
    (objective, left), (alternative, chi_square) = cost(small.psf, rough), cost(small.psf, fine)
    rough, objective = (fine, alternative) if left > 4.0 else (rough, objective)
    others = {name: cost(copy, rough)[0] for name, copy in other_readings(small.psf).items()}
    reading = min(others, key=lambda name: others[name], default="")
    depths = len(small.psf) if small.deep else 0
    without = [cost(np.delete(small.psf, k, 0), fine)[0] / max(alternative, 1e-300) for k in range(depths)]
    energy = max(float(np.mean(np.square(seen, dtype=np.float64))), 1e-300)
    rows, columns = light.psf.shape[-2:]
    middles = [
        [float(np.average(place, weights=np.abs(each))) for place in np.indices((rows, columns))]
        for each in light.psf.reshape(-1, rows, columns)
    ]
    off = max(middles, key=lambda each: max(abs(2 * each[0] / (rows - 1) - 1), abs(2 * each[1] / (columns - 1) - 1)))
    return PointSpreadFit(
        chi_square=chi_square,
        unexplained=math.sqrt(max(chi_square - 1, 0.0) * noise / energy),
        stated=variance is not None,
        gain=others[reading] / max(objective, 1e-300) if others else None,
        reading=reading,
        off=(off[0] - (rows - 1) / 2, off[1] - (columns - 1) / 2),
        size=(rows, columns),
        without=tuple(without),
    )


def other_readings(psf: FloatArray) -> dict[str, FloatArray]:
    """Return mirrored and rotated copies of ``psf`` that differ from it by more than a shift."""
    others, grid = dict[str, FloatArray](), [2 * size for size in psf.shape[-2:]]
    for name, (down, across) in TURNED.items():
        copy = psf[..., ::down, ::across]
        shared = (fft.rfft2(psf, grid) * fft.rfft2(copy, grid).conj()).reshape(-1, grid[0], grid[1] // 2 + 1)
        shifted = fft.irfft2(shared.sum(axis=0), grid)
        if shifted.max() < 0.9 * math.sqrt(float(np.square(psf).sum() * np.square(copy).sum())):
            others[name] = copy
    return others


# ---- A wrong light mended --------------------------------------------------------------------------------------------
# Scale, rotation and shift of a wrong point spread function, fitted to the frames that it shall explain.
#
# Minimised over the numbers t is J(t) = min over X >= 0 of 1/2 ||A(t) X - Y||^2 + w TV(X), in which A(t) is the camera
# whose point spread function is turned and scaled about the middle of its picture (variable projection, Golub and
# Pereyra, SIAM J. Numer. Anal. 10, 1973): first on a grid with a small frame, then by the simplex of Nelder and Mead.
# Under patterns the sum of all frames is that frame, of the scene X sum_i P_i.
#
# **Shift.** Under uniform light a shift is unknown, because it explains the frame as well with an image that is shifted
# back. Patterns have known places. Candidates are where images of frames, each as under uniform light, correlate with
# their patterns; each is fitted to a few frames. Dots differ from dots a period beside them by the scene's edge alone,
# so that the shift is used only if every other candidate costs clearly more.
#
# **Blur.** Interpolation of light whose lines are as thin as a pixel blurs these lines, except where pixels fall on
# pixels, so that J depends on t by this as well: the true light cost 0.86 to 0.9 times as much as its interpolation,
# and fits were off by up to 3 errors. Therefore light and frames are blurred by one Gaussian before the fit (0.99 to 1
# times), and the frames' edges, which lack light from beyond, are cut off.
#
# **Errors.** By the envelope theorem dJ/dt is the sum over pixels of residual times d(A X)/dt. With V its covariance,
# from sums over blocks of the sensor, and H the second derivatives of J, the covariance of t is H^-1 V H^-1 (Huber
# 1967), which holds for residuals that are no white noise, too. Regularisation prefers bright small lights. This bias
# is the fit to simulated frames of the image that was found; it is subtracted. It also counts as an error, because it
# is too small where the image is smoother than the scene. Rotation of a ring shows nowhere: then J bends more than a
# fixed image allows, by its iterations' error alone, and the errors are infinite. Errors of the model and false minima
# change with the blur: a fit with more blur that begins there must stay within the errors.

_SCALES, _TURNS = np.linspace(1 - MOST_SCALE, 1 + MOST_SCALE, 7), np.linspace(-MOST_TURN_DEG, MOST_TURN_DEG, 7)
_COARSE, _FINE, _SOFT = (48, 24, 0.7), (160, 60, 0.7), (160, 60, 1.4)
"""Largest shorter side [pixels] of light and frames, steps of each image, and blur [pixels]: grid and two fits."""
_EVALUATIONS, _BLOCKS = 60, 8
_FRAMES, _CANDIDATES, _TRIES = 2, 9, 24
"""Patterns a side whose frames show the shift, shifts that are tried, and evaluations for each."""


def turn(psf: FloatArray, found: Mending) -> FloatArray:
    """Return ``psf`` (k, k') scaled, rotated and shifted as ``found``, with the same sum."""
    down, across = TURNED.get(found.reading, (1, 1))
    angle = math.radians(found.rotation_deg)
    inverse = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]) / found.scale
    middle = (np.array(psf.shape) - 1) / 2
    offset = middle - inverse @ (middle + np.array(found.shift_px or (0.0, 0.0)))
    moved = np.maximum(affine_transform(psf[::down, ::across], inverse, offset, order=3), 0.0)
    return np.asarray(moved * (psf.sum() / max(moved.sum(), 1e-300)))


class _Cost:
    """J of blurred frames (K, m, m') by a ``camera``, averaged over ``factor``^2 pixels."""

    def __init__(self, camera: ShiftedLight, frames: Array, most: int, steps: int, blur: float) -> None:
        self.steps, (rows, columns) = steps, camera.sensor
        self.factor = 1 if camera.patterns else -(-min(*camera.sensor, *camera.psf.shape) // most)
        self.blur, self.edge, self.size = blur * self.factor, math.ceil(3 * blur) * self.factor, frames.shape
        self.frames, self.noise = self.soften(frames), math.sqrt(float(np.mean([frame_noise(f) ** 2 for f in frames])))
        sensor = rows - 2 * self.edge, columns - 2 * self.edge
        self.camera = replace(camera, psf=gaussian_filter(camera.psf, self.blur, mode="constant"), sensor=sensor)
        error, given = math.hypot(self.noise / self.factor, 0.01 * float(self.frames.mean())), self.light(Mending())
        self.prior = Prior(weight=error * math.sqrt(given.column_power), bounds=(0.0, math.inf))

    def soften(self, frames: Array) -> Array:
        inner = slice(self.edge, -self.edge)
        blurred = (gaussian_filter(frame, self.blur)[inner, inner] for frame in frames)
        return np.stack([reduce_frame(frame, self.factor) for frame in blurred])

    def light(self, found: Mending) -> ShiftedLight:
        turned = replace(self.camera, psf=turn(self.camera.psf, found))
        return turned.reduce(self.factor) if self.factor > 1 else turned

    def __call__(self, found: Mending) -> float:
        return self.terms(found)[0]

    def terms(self, found: Mending) -> tuple[float, float]:
        """Return J and its first term."""
        light = self.light(found)
        best = minimise(light, self.frames, self.prior, self.steps, 0.0)
        return best.objective, float(np.square(light.image_of(best.image) - self.frames).sum()) / 2

    def least(self, make: Change, start: FloatArray, unit: FloatArray, evaluations: int) -> FloatArray:
        """Return the two numbers of ``make`` of least J; ``unit`` moves light by about a pixel."""
        simplex = start + unit * np.array([[-0.5, -0.5], [1.0, 0.0], [0.0, 1.0]])
        options = {"initial_simplex": simplex, "maxfev": evaluations, "xatol": 0.01 * unit.min(), "fatol": 0.0}
        return np.asarray(minimize(lambda place: self(make(place)), start, method="Nelder-Mead", options=options).x)

    def fit(self, make: Change, start: FloatArray, unit: FloatArray, evaluations: int) -> Pair:
        """Return the two numbers of ``make`` of least J, and their errors."""
        best = self.least(make, start, unit, evaluations)
        around = np.array(list(product((-0.5, 0.0, 0.5), repeat=2)))
        rows, columns = around.T
        terms = np.stack([np.ones(9), rows, columns, rows**2 / 2, columns**2 / 2, rows * columns], axis=1)

        def parabola() -> FloatArray:
            costs = [self(make(best + unit * each)) for each in around]
            return np.asarray(np.linalg.lstsq(terms, costs, rcond=None)[0])

        _, down, across, *bent = parabola()
        curved = np.array([[bent[0], bent[2]], [bent[2], bent[1]]])
        light = self.light(make(best))
        image = minimise(light, self.frames, self.prior, self.steps, 0.0).image
        residual = light.image_of(image) - self.frames
        ends = [[self.light(make(best + sign * step)) for sign in (1, -1)] for step in 0.1 * np.diag(unit)]
        moves = np.stack([after.image_of(image) - before.image_of(image) for after, before in ends]) / 0.2
        # Images adapt to a change of the light, so that J bends less than squares with a fixed image.
        most = np.tensordot(moves, moves, axes=((1, 2, 3), (1, 2, 3)))
        if np.linalg.eigvalsh(curved)[0] <= 0 or np.linalg.eigvalsh(most - curved)[0] <= 0:
            return best, np.full(2, math.inf)
        inverse = np.linalg.inv(curved)
        strips = np.array_split(residual * moves, _BLOCKS, axis=2)
        tiles = [tile.sum(axis=(1, 2, 3)) for strip in strips for tile in np.array_split(strip, _BLOCKS, axis=3)]
        noise = self.soften(self.noise * stream(0, "mend").standard_normal(self.size))
        seen, self.frames = self.frames, np.asarray(residual + self.frames + noise, self.frames.dtype)
        bias, self.frames = -inverse @ parabola()[1:3], seen
        moved = np.clip(-inverse @ np.array([down, across]) - bias, -1.0, 1.0)
        covariance = inverse @ np.cov(np.transpose(tiles)) @ inverse * len(tiles) + np.outer(bias, bias)
        return best + unit * moved, unit * np.sqrt(np.diag(covariance))


def find_mending(camera: ShiftedLight, frames: Array) -> Mending:
    """Return the change by which the light of ``camera`` explains ``frames`` (K K', m, m') best."""
    if camera.psf.ndim > 2 or any(side.shape[1] < 2 or side.min() < 0 for side in camera.patterns or ()):
        raise MitsimError("lists, stripes, single patterns and numbers below 0 in patterns are not mended; omit this")
    if (least := min(*camera.sensor, *camera.psf.shape)) < _LEAST_SIDE:
        raise MitsimError(f"frames and light of {least} pixels a side: {_LEAST_SIDE} are needed to mend a light")
    if frames.mean() <= 0:
        raise MitsimError(f"frames of mean {frames.mean():g}: no light can be mended; check exposure and black level")
    whole, total = replace(camera, patterns=None), frames.sum(axis=0, keepdims=True)
    coarse, fine = _Cost(whole, total, *_COARSE), _Cost(whole, total, *_FINE)
    readings = ["", *other_readings(camera.psf)]
    grid = [Mending(scale, degrees, reading=reading) for reading, scale, degrees in product(readings, _SCALES, _TURNS)]
    start = min([*sorted(grid, key=coarse)[:5], Mending()], key=fine)

    def turned(place: FloatArray) -> Mending:
        # A light that shrinks to a point explains every frame by an image as blurred (Levin et al., CVPR 2009).
        scale = float(np.clip(place[0], 1 - MOST_SCALE, 1 + MOST_SCALE))
        return replace(start, scale=scale, rotation_deg=float(np.clip(place[1], -MOST_TURN_DEG, MOST_TURN_DEG)))

    # A step moves the edge of the light by one pixel.
    unit = 2 / max(camera.psf.shape) * np.array([1.0, math.degrees(1.0)])
    place, errors = fine.fit(turned, np.array([start.scale, start.rotation_deg]), unit * fine.factor, _EVALUATIONS)
    soft = _Cost(whole, total, *_SOFT).fit(turned, place, unit * fine.factor, 1)
    found = replace(turned(place), scale_error=float(errors[0]), rotation_error=float(errors[1]))
    found = replace(found, cost=fine(found) / fine(Mending()), apart=_apart((place, errors), soft))
    return found if camera.patterns is None else _shifted(camera, camera.patterns, frames, found)


def _apart(one: Pair, other: Pair) -> float:
    far = np.max(np.abs(one[0] - other[0]) / np.maximum(np.hypot(one[1], other[1]), 1e-300))
    return float(far) if np.isfinite(other[1]).all() else math.inf


def _shifted(camera: ShiftedLight, patterns: Pair, frames: Array, found: Mending) -> Mending:
    """Return ``found`` with the shift by which the light explains ``frames`` under patterns best."""
    (left, right), sensor, middle = patterns, camera.sensor, (np.array(camera.psf.shape) - 1) / 2
    lit = frames.reshape(left.shape[1], right.shape[1], *sensor)[-_FRAMES:, -_FRAMES:].reshape(-1, *sensor)
    left, right = left[:, -_FRAMES:], right[:, -_FRAMES:]
    few = replace(camera, patterns=(left, right))
    whole = replace(camera, psf=turn(camera.psf, found), patterns=None)
    lights = np.array([np.outer(row, column) for row in left.T for column in right.T])
    size = whole.scene[0] + camera.scene[0], whole.scene[1] + camera.scene[1]
    prior, likely = Prior(ridge=1e-2 * whole.column_power, bounds=(0.0, math.inf)), np.zeros(size)
    for frame, light in zip(lit, lights - lights.mean(axis=0), strict=True):
        image = minimise(whole, frame[None], prior, _FINE[1], 0.0).image
        likely += fft.ifft2(fft.fft2(image, size) * fft.fft2(light, size).conj()).real
    peaks = np.where(maximum_filter(likely, 3, mode="wrap") == likely, likely, 0.0)
    lags = np.stack(np.unravel_index(np.argsort(peaks, axis=None)[-_CANDIDATES:], size), axis=1)
    starts = (lags - 2 * middle + few.origin + np.array(size) // 2) % size - np.array(size) // 2

    def make(place: FloatArray) -> Mending:
        return replace(found, shift_px=(float(place[0]), float(place[1])))

    sharp, pixel = _Cost(few, lit, *_FINE), np.ones(2)
    tried = np.array([sharp.least(make, start, pixel, _TRIES) for start in starts])
    costs = np.array([sharp.terms(make(place)) for place in tried])
    best = np.argmin(costs[:, 0])
    place, errors = sharp.fit(make, tried[best], pixel, _TRIES)
    apart = max(found.apart, _apart((place, errors), _Cost(few, lit, *_SOFT).fit(make, place, pixel, 1)))
    # TV prefers light at the edge of the scene, beyond which it counts no step: therefore the first term decides, too.
    others = (costs / costs[best])[(np.abs(tried - tried[best]) > 1.0).any(axis=1)]
    # Wrong scale and rotation move light that lies off the middle.
    off = np.array([np.average(each, weights=camera.psf) for each in np.indices(camera.psf.shape)]) - middle
    errors = np.hypot(errors, np.hypot(found.scale_error * off, math.radians(found.rotation_error) * off[::-1]))
    found = replace(make(place), shift_error=(float(errors[0]), float(errors[1])), apart=apart)
    return replace(found, cost=sharp(found) / sharp(Mending()), rival=float(others.min()) if others.size else None)


# ---- The image -------------------------------------------------------------------------------------------------------


def automatic_weight(light: ShiftedLight, frames: Array, method: str) -> float:
    """Return lambda, or the weight of the total variation, for ``frames`` (K K', m, m')."""
    part = _DEEP if light.deep else 1.0
    if method == TV:
        return part * _WEIGHT * frame_error(light, frames) * math.sqrt(light.column_power)
    if light.patterns is None:
        return part**2 * _RIDGE * frame_error(light, frames) / float(frames.mean()) * light.column_power
    raise MitsimError("lambda auto: is chosen under uniform light alone; under patterns give lambda as a number")


def solve_point_spread(
    light: ShiftedLight,
    frames: Array,
    method: str,
    lam: float | Literal["auto"] = "auto",
    bounds: Bounds | None = None,
    iterations: int | None = None,
    tolerance: float = 0.02,
) -> Solution:
    """Return the image, or volume, of all frames (K K', m, m')."""
    light.check_frames(frames)
    iterations = (_MOST_DEEP if light.deep else _MOST) if iterations is None else iterations
    if iterations < 1:
        raise MitsimError(f"iterations are {iterations}; give at least 1")
    prior = Prior(bounds=bounds or (Prior.bounds if method == TIKHONOV else (0.0, math.inf)))
    frames = frames.astype(light.precision)
    known = automatic_weight(light, frames, method) if lam == "auto" else check_lambda(lam)
    prior = replace(prior, weight=known) if method == TV else replace(prior, ridge=known)
    energy = float(np.vdot(frames, frames))
    found = minimise(light, frames, prior, iterations, tolerance)
    residual = light.image_of(found.image) - frames
    figures = f"Objective {found.objective:.4g}."
    lowered = f"the last half of {found.iterations} iterations lowered the objective by {found.fall:.1%}"
    if found.fall <= tolerance:
        status = Status(Verdict.SOLVED, f"Converged: {lowered}", "", figures)
    else:
        remedy = "take a larger lambda, or allow more iterations"
        status = Status(Verdict.NOT_CONVERGED, f"Not converged: {lowered} or more", remedy, figures)
    image = np.asarray(found.image[light.window], np.float64)
    share = math.sqrt(float(np.vdot(residual, residual)) / energy) if energy else 0.0
    return Solution(image, prior.weight or prior.ridge, share, status, None, found.iterations, found.objective)


# ---- From a run ------------------------------------------------------------------------------------------------------


@check_arguments
def reconstruct_psf(
    shots: Capture,
    psf: Path | str | FloatArray,
    reduce: int = 1,
    lam: float | Literal["auto"] = "auto",
    method: str = TIKHONOV,
    bounds: Bounds | None = None,
    iterations: int | None = None,
    mend: bool = False,
) -> Reconstruction:
    """Recover the image of a camera whose scene points all cast one pattern of light, each shifted by its place.

    One scene pixel shifts it by one pixel of the frames. Under uniform light the image is as large as the sensor, and
    under patterns as large as these.

    Parameters
    ----------
    shots
        Capture in memory, or of :func:`mitsim.core.runs.load_run`.
    psf
        Light (k, k') of a scene pixel, or a picture of it (:func:`mitsim.devices.camera.load_psf`), of the same
        pixels as the frames; or a list of several (:mod:`mitsim.reconstruct.light_list`), LIST.toml, by depth, which
        gives a volume, or by place in the field.
    reduce
        Pixels a side, of frames and of the picture, that become one.
    lam
        Lambda >= 0 in the unit of the point spread function squared, for ``tv`` the weight of the total variation;
        "auto" chooses it from the frames.
    method
        ``tikhonov``, ``nonnegative`` or ``tv``.
    bounds
        Least and largest number of the image [electrons/s], for ``nonnegative`` and ``tv``; None: 0 and inf.
    iterations
        Largest number of steps, for ``nonnegative`` and ``tv``; None: 300.
    mend
        Fit scale, rotation, orientation and, under patterns, shift of the point spread function to the frames first.

    Raises
    ------
    MitsimError
        For a picture without light, frames that do not fit, too little memory, and another lambda, method or bounds.
    """
    asked = ImageRequest(lam=lam, method=method, bounds=bounds, iterations=iterations)
    return reconstruct_psf_request(shots, psf, reduce, asked, mend=mend)


@single_threaded_blas()
def reconstruct_psf_request(
    shots: Capture,
    psf: Path | str | FloatArray | Lights,
    reduce: int,
    request: ImageRequest,
    job: Job | None = None,
    mend: bool = False,
) -> Reconstruction:
    request.check_point_spread(reduce)
    seen = SeenFrames(shots, lights_of(psf, reduce), reduce, job)
    if mend:
        seen.mend()
    return seen.image(request, request.lam)


class SeenFrames:
    """Frames (K K', m, m') of a run, and the camera that sees them by the ``lights`` of points.

    ``reduce`` x ``reduce`` pixels of the frames become one, as those of the lights did.
    """

    def __init__(self, shots: Capture, lights: Lights, reduce: int, job: Job | None = None) -> None:
        self.shots, self.lights, self.reduce = shots, lights, reduce
        self._clock, self._saturated, variance = (job or Job()).apart("").clock, 0, 0.0
        with self._clock.stage("read"):
            (left, right), digital = shots.patterns, shots.manifest.digital
            rows, columns = shots.read(shots.manifest.patterns.captures[0].file)[0]["DN"].shape
            if min(rows, columns) < reduce:
                raise MitsimError(f"{shots.name}: frames of {rows} x {columns} pixels; reduce by less than {reduce}")
            uniform = all(side.shape[1] == 1 and bool((side == 1).all()) for side in (left, right))
            sensor = rows // reduce, columns // reduce
            patterns = None if uniform else shots.patterns
            camera = ShiftedLight(lights.light, sensor, patterns, np.float32, places=lights.places)
            several = lights.count if camera.deep else 1 + lights.count / 4
            numbers = camera.grid[0] * camera.grid[1] * several + camera.count * sensor[0] * sensor[1]
            Cost(memory_bytes=4.0 * 24 * numbers).check(f"{shots.name}: its image", Limits())
            frames = np.empty((camera.count, *sensor), np.float32)
            for each in shots.pattern_measurements((rows, columns)):
                frames[each.row * right.shape[1] + each.column] = reduce_frame(each.frame, reduce)
                self._saturated += each.saturated
                variance += float(np.mean(np.maximum(digital.variance(each.light, each.shots), 0.0)))
        self._variance = variance / reduce**2 / camera.count if digital.noise_is_stated else None
        self.camera, self.frames = camera, frames
        self._mended: Mending | None = None

    def mend(self, known: Mending | None = None) -> Mending:
        """Change the light as the frames, or those of another line, show; return the change."""
        with self._clock.stage("mend"):
            self._mended = found = known or find_mending(self.camera, self.frames)
            if found.is_better:
                self.camera = replace(self.camera, psf=turn(self.lights.light, found))
        return found

    def image(self, request: ImageRequest, lam: float | Literal["auto"]) -> Reconstruction:
        """Return the image with ``lam``, which may be that of several lines."""
        with self._clock.stage("solve"):
            solution = solve_point_spread(self.camera, self.frames, request.name, lam, **request.iterative)
        with self._clock.stage("misfit"):
            fit = replace(find_fit(self.camera, self.frames, self._variance), mended=self._mended)
        status, focus, depths, doubt = fit.judge(solution.status), None, self.lights.depths_mm, self.lights.doubt
        if depths is not None:
            slices, energy = solution.image, float(np.square(self.frames, dtype=np.float64).sum())
            doubt = fit.doubt_of(slices, depths)
            solution = replace(solution, image=slices.sum(axis=0))
            mm, confidence = mean_depth(slices, depths, float(depths.mean()), _LIT)
            focus = Volume(
                solution.image, mm, confidence, solution.lam, solution.residual**2 * energy, energy, self.frames.size,
                1.0, doubt, (float(depths[0]), float(depths[-1])), slices=slices, depths_mm=depths, solution=solution,
            )  # fmt: skip
        flags = [*filter(None, [doubt]), *each_once({"the capture": self.shots.warnings})]
        if self._saturated:
            flags.append(f"{self._saturated} readings are at the full well or the ADC's end: use a shorter exposure.")
        return Reconstruction(
            **{**vars(solution), "status": replace(status, flags=(*status.flags, *flags))},
            fit=fit,
            focus=focus,
            seconds={stage: spent for stage, spent in self._clock.seconds().items() if stage != "total"},
            inputs=psf_inputs(self.shots, self.lights, self.reduce, request, self._mended is not None),
        )


def psf_inputs(
    shots: Capture, lights: Lights, reduce: int, request: ImageRequest, mend: bool = False
) -> dict[str, Any]:
    digest = hashlib.sha256(f"{lights.light.shape}".encode() + np.ascontiguousarray(lights.light).tobytes())
    for where in (lights.depths_mm, lights.places):
        digest.update(b"" if where is None else f"{where.shape}".encode() + where.tobytes())
    asked = {"run": shots.fingerprint, POINT_SPREAD: digest.hexdigest(), "reduce": reduce, "lambda": request.lam}
    asked["method"] = request.method
    return {**asked, **request.plain, **({"mend": True} if mend else {})}


def lights_of(psf: Path | str | FloatArray | Lights, reduce: int) -> Lights:
    if isinstance(psf, Lights):
        return psf
    if isinstance(psf, (str, Path)):
        path = Path(psf)
        return load_lights(path, reduce) if path.suffix.lower() == LIST else Lights(load_psf(path, reduce))
    light = np.asarray(psf)
    if light.dtype.kind not in "uif":
        raise ArgumentError("psf", f"{cut(repr(psf))}: give rows x columns of real numbers, or a picture's path")
    light = light.astype(np.float64)
    if light.ndim != 2 or min(light.shape) < reduce:
        raise ArgumentError("psf", f"shape {light.shape}: give rows x columns, at least {reduce} a side")
    return Lights(reduce_frame(light, reduce))


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
