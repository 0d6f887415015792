"""Expected error of a camera as a function of its separable mask code, with its gradient.

A factor is F = T I with a sparse T, whose rows are pairs of sensor pixel and projector pixel, and the light I behind
the mask. In geometric optics I is the code itself; for waves it is a sum of squared fields that are linear in the code.
The derivative F' by the position of a projector pixel is linear in I likewise. Therefore the gradient of
:func:`mitsim.design.expected.expected_error` with respect to the code is exact. Ambient light is neglected.

The bias of regularisation is that of given scenes. For the noise of factors and for detail inside pixels, a scene is a
mean and stationary detail with the covariance sigma^2 rho^(|p - p'| + |q - q'|) of the solver ``markov``. Between its
pixels such a scene is an Ornstein-Uhlenbeck process. Its first moment inside a pixel of unit width has the
variance sigma^2 (1 - rho) / 60 to first order in 1 - rho.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.seeds import stream
from mitsim.design.expected import Cause, expected_error
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.projector import Spectrum
from mitsim.optics.diffraction import ComplexArray, edge_wave
from mitsim.optics.shadow import Directions, ShadowGeometry, trapezoid_weights

_MOMENT = 1 / 60
_MOST = 1 << 26
"""Features times grid cells of a side; a GiB."""
_CELLS = 16
"""Grid cells in sqrt(lambda D)."""
_BRIGHT = 0.5
"""Standard deviations by which the scene about the brightest pixel of a frame is brighter than its mean."""
_SCENES = 4
"""Scenes that stand for a prior."""
_STEP = 0.25
"""Part of a projector pixel by which directions move for a derivative."""


@dataclass(frozen=True)
class Prior:
    """Mean and standard deviation of a scene's reflectance, and correlation of neighbouring pixels."""

    mean: float = 0.4
    deviation: float = 0.2
    correlation: float = 0.95

    def covariance(self, n: int) -> FloatArray:
        return self.correlation ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))

    def draw(self, shape: tuple[int, int], seed: int) -> list[FloatArray]:
        """Return scenes of the prior: their bias scatters by some hundredths, because they have many coefficients."""
        random, roots = stream(seed, "prior"), [np.linalg.cholesky(self.covariance(n)) for n in shape]
        normal = random.standard_normal((_SCENES, *shape))
        return [self.mean + self.deviation * roots[0] @ each @ roots[1].T for each in normal]


@dataclass(frozen=True)
class Light:
    """Light and electronics of a capture and of its calibration session.

    ``gain`` is in electrons per second from a projector pixel on a sensor pixel without a mask, for a reflectance of 1.
    ``frame_s`` and ``session_frame_s`` are exposure times of one frame. With ``signal_e``, the mean electrons of a
    pixel and frame, exposures are of equal light instead: a mask that transmits less is exposed for longer. No pixel
    gets more than ``most_e``: a mask that transmits more is exposed for a shorter time.
    """

    gain: float
    frame_s: float
    session_frame_s: float
    read_noise_e: float
    dark_e_per_s: float
    signal_e: float | None = None
    most_e: float = math.inf


class CodedSide:
    """One axis of a camera as a function of a mask code (N,), and patterns (n, k) along that axis.

    The light behind the mask is the code itself, in features, or for waves sum_l w_l |H_l a|^2 on a grid, with the
    lines l of a ``spectrum``. Pixels take means of that light.
    """

    def __init__(
        self,
        camera: CameraGeometry,
        axis: int,
        directions: Directions,
        features: int,
        patterns: FloatArray,
        spectrum: Spectrum | None = None,
    ) -> None:
        shadow = ShadowGeometry.of(camera, camera.scene_distance).along(axis)
        self.shape, self.features = (len(shadow.pixel_centres_mm), len(directions.centres)), features
        squared = np.square(directions.centres - shadow.pixel_centres_mm[:, None] / camera.scene_distance)
        loss = (1 + squared) ** -2.0 * camera.angular_response(squared) * camera.pixel_fill_factor
        own, seen = shadow.from_mask(directions, axis)
        reach = float(np.abs(own.crossings(seen)).max()) + own.half_pixel + 2 * own.half_cell(seen)
        _check_size(camera, features, features)
        lines = (np.arange(features + 1) - features / 2) * camera.mask_feature
        self._waves = list[tuple[float, ComplexArray]]()
        cell, count = camera.mask_feature, features
        if spectrum is not None:
            products = spectrum.wavelengths_nm * 1e-6 * shadow.distance_mm * shadow.shrink
            cell = float(products.min() ** 0.5 / _CELLS)
            count = 2 * int(np.ceil(reach / cell))
            _check_size(camera, features, count * len(products))
            places = (np.arange(count) + 0.5 - count / 2) * cell
            for product, weight in zip(products, spectrum.weights, strict=True):
                steps = _step_fields(places[:, None] - lines, float(product), cell)
                self._waves.append((float(weight), steps[:, :-1] - steps[:, 1:]))

        def means(shift: float) -> csr_array:
            moved = Directions(directions.centres + shift * directions.width, directions.width)
            own, seen = shadow.from_mask(moved, axis)
            half = np.asarray(own.half_pixel / cell), np.asarray(own.half_cell(seen) / cell)
            every = zip(*trapezoid_weights(own.crossings(seen) / cell, *half, count), strict=True)
            places, values = (np.stack(each, axis=-1).reshape(loss.size, -1) for each in every)
            values = values * loss.ravel()[:, None]
            rows = np.broadcast_to(np.arange(loss.size)[:, None], places.shape)
            inside = (places >= 0) & (places < count) & (values != 0)
            return csr_array((values[inside], (rows[inside], places[inside])), shape=(loss.size, count))

        self._means = means(0.0)
        self._moved = (means(_STEP) - means(-_STEP)) / (2 * _STEP)
        self._show(patterns)
        self.used = np.flatnonzero(np.abs(lines[:-1] + camera.mask_feature / 2) < reach + camera.mask_feature / 2)

    def _show(self, patterns: FloatArray) -> None:
        self.patterns = patterns
        self.gram = patterns @ patterns.T
        self.squared = self.gram @ self.gram

    def lit_by(self, lit: str) -> CodedSide:
        """Return the side under the cyclic patterns of a code."""
        other = copy(self)
        other._show(cyclic_patterns(lit, self.shape[1]))
        return other

    def __call__(self, code: FloatArray) -> Factor:
        fields = [(weight, matrix, matrix @ code) for weight, matrix in self._waves]
        light = sum((weight * (u.real**2 + u.imag**2) for weight, _, u in fields), 0.0) if fields else code

        def back(by_factor: FloatArray, by_derivative: FloatArray) -> FloatArray:
            by_light = self._means.T @ by_factor.ravel() + self._moved.T @ by_derivative.ravel()
            if not fields:
                return np.asarray(by_light)
            parts = (2 * weight * np.real((u.conj() * by_light) @ matrix) for weight, matrix, u in fields)
            return np.asarray(sum(parts, np.zeros(len(code))))

        values, slopes = ((each @ light).reshape(self.shape) for each in (self._means, self._moved))
        return Factor(values, slopes, back)


@dataclass(frozen=True, eq=False)
class Factor:
    """Factor (m, n), its derivative by the position of a projector pixel, and the gradient of both by the code."""

    values: FloatArray
    moved: FloatArray
    back: Callable[[FloatArray, FloatArray], FloatArray]


def cyclic_patterns(lit: str, n: int) -> FloatArray:
    """Return patterns (n, P) of 0 and 1: a code of P characters that repeats along n pixels, shifted by 0 to P - 1."""
    places = (np.arange(n)[:, None] - np.arange(len(lit))) % len(lit)
    return np.asarray(np.array([float(each) for each in lit])[places])


def _check_size(camera: CameraGeometry, features: int, cells: int) -> None:
    """Refuse a side whose waves or transmissions would be more than :data:`_MOST` numbers."""
    if features * cells > _MOST:
        place = f"features of {camera.mask_feature * 1e3:g} um, {camera.mask_distance:g} mm from the sensor"
        problem = f"goal: {place}, are {features} a side on {cells} grid cells, which is too much for a search"
        raise MitsimError(f"{problem}; use larger feature_um, and mask_distance_mm of a few mm")


def _step_fields(x: FloatArray, product: float, cell: float) -> ComplexArray:
    """Return the field behind an edge at distances ``x`` [mm], as :class:`mitsim.optics.diffraction.EdgeWaves`."""
    fade = product / (2 * cell)
    wave = edge_wave(np.maximum(np.abs(x), 1e-9) * (2 / product) ** 0.5)
    wave *= np.square(np.cos(np.pi / 2 * np.clip(4 * np.abs(x) / fade - 3, 0, 1)))
    return np.asarray(np.where(x > 0, 1 + wave, -wave))


@dataclass(frozen=True, eq=False)
class _Stack:
    """Factor of a side, its light (m, k) under each pattern, and the matrices (n, n) of the causes of error."""

    factor: Factor
    bright: FloatArray
    gram: FloatArray
    detail: FloatArray
    inside: FloatArray
    reused: FloatArray
    shot: FloatArray

    @classmethod
    def of(cls, side: CodedSide, code: FloatArray) -> _Stack:
        made = side(code)
        factor, cross = made.values, made.values.T @ made.values
        bright, shot = factor @ side.patterns, np.zeros_like(cross)
        for pattern, light in zip(side.patterns.T, bright.T, strict=True):
            lit = np.flatnonzero(pattern)
            stack = factor[:, lit] * pattern[lit]
            shot[np.ix_(lit, lit)] += (stack * light[:, None]).T @ stack
        detail = (factor.T @ made.moved) * side.gram
        return cls(made, bright, cross * side.gram, detail, detail @ detail.T, cross * side.squared, shot)


@dataclass(frozen=True, eq=False)
class Objective:
    """Expected mean squared error of images as a function of the codes of both sides.

    Regularisation acts on ``scenes``; other causes need the mean and covariance of a ``prior`` alone.
    """

    sides: tuple[CodedSide, CodedSide]
    light: Light
    prior: Prior
    scenes: Sequence[FloatArray]

    @cached_property
    def _covariances(self) -> tuple[FloatArray, FloatArray]:
        rows, columns = (self.prior.covariance(side.shape[1]) for side in self.sides)
        return rows, columns

    def frame_s(self, codes: Sequence[FloatArray]) -> float:
        """Return the exposure time of a frame [s]."""
        made = [_Stack.of(side, code) for side, code in zip(self.sides, codes, strict=True)]
        return self._exposure((made[0], made[1]))[0]

    def _exposure(self, stacks: tuple[_Stack, _Stack]) -> tuple[float, list[FloatArray] | None]:
        """Return the exposure time [s], and the derivatives of its logarithm by both factors, None if it is fixed."""
        light, seconds, slopes = self.light, self.light.frame_s, None
        if light.signal_e is not None:
            shown = [side.patterns.mean(axis=1) for side in self.sides]
            lit = [float(stack.factor.values.mean(axis=0) @ c) for stack, c in zip(stacks, shown, strict=True)]
            seconds = light.signal_e / (light.gain * self.prior.mean * lit[0] * lit[1])
            each = zip(stacks, shown, lit, strict=True)
            slopes = [np.broadcast_to(-c / (len(s.bright) * at), s.factor.values.shape) for s, c, at in each]
        places = [np.unravel_index(np.argmax(stack.bright), stack.bright.shape) for stack in stacks]
        peaks = [float(stack.bright[place]) for stack, place in zip(stacks, places, strict=True)]
        bright = light.gain * (self.prior.mean + _BRIGHT * self.prior.deviation) * peaks[0] * peaks[1]
        if seconds * bright <= light.most_e:
            return seconds, slopes
        slopes = [np.zeros(stack.factor.values.shape) for stack in stacks]
        for slope, side, (row, pattern), peak in zip(slopes, self.sides, places, peaks, strict=True):
            slope[row] = -side.patterns[:, pattern] / peak
        return light.most_e / bright, slopes

    def of_equal_light(self, codes: Sequence[FloatArray]) -> Objective:
        """Return the objective for exposures with as much light as a mask of these codes has."""
        scale = replace(self, light=replace(self.light, signal_e=1.0)).frame_s(codes)
        return replace(self, light=replace(self.light, signal_e=self.light.frame_s / scale))

    def lit_by(self, lit: str) -> Objective:
        """Return the objective for cyclic patterns of a code, as many as the patterns before, in the same time."""
        rows = self.sides[0].lit_by(lit)
        sides = rows, (rows if self.sides[0] is self.sides[1] else self.sides[1].lit_by(lit))
        signal_e = self.light.signal_e
        if signal_e is not None:  # that of the mask by which light is equal
            for new, old in zip(sides, self.sides, strict=True):
                signal_e *= new.patterns.mean() / old.patterns.mean()
        return replace(self, sides=sides, light=replace(self.light, signal_e=signal_e))

    def __call__(self, codes: Sequence[FloatArray], lam: float | None = None, slopes: bool = False) -> Value:
        light, prior, sides = self.light, self.prior, self.sides
        first = _Stack.of(sides[0], codes[0])
        alike = sides[0] is sides[1] and codes[0] is codes[1]
        stacks = first, (first if alike else _Stack.of(sides[1], codes[1]))
        factors = [stack.factor.values for stack in stacks]
        grams = [stack.gram for stack in stacks]
        even, ones = ([form(len(gram)) for gram in grams] for form in (lambda n: np.ones((n, n)), np.eye))
        covariances = self._covariances
        second = [prior.mean**2 * j + prior.deviation**2 * k for j, k in zip(even, covariances, strict=True)]
        seconds, exposed = self._exposure(stacks)
        electrons, session = light.gain * seconds, light.gain * light.session_frame_s
        noise = light.read_noise_e**2 / electrons**2 + light.dark_e_per_s / light.gain / electrons
        full = [float(factor.mean(axis=0).sum()) for factor in factors]
        response = (light.read_noise_e**2 + light.dark_e_per_s * light.session_frame_s) / session**2
        response = 2 * (response + full[0] * full[1] / 2 / session)  # both shots of a pair
        common = [factor.sum(axis=1) for factor in factors]
        norms = [float(each @ each) for each in common]
        scale = [1 / gram.shape[0] for gram in grams]
        errors = [response * scale[0] / norms[1], response * scale[1] / norms[0]]
        moment = prior.deviation**2 * (1 - prior.correlation) * _MOMENT
        causes = [
            Cause("dark_and_read_noise", (1, 1), (ones[0], ones[1]), noise),
            Cause("shot_noise", (0, 0), (stacks[0].shot, stacks[1].shot), prior.mean / electrons),
            Cause("calibration_noise", (0, 2), (stacks[0].reused, second[1]), errors[0]),
            Cause("calibration_noise", (2, 0), (second[0], stacks[1].reused), errors[1]),
            Cause("print_detail", (0, 2), (stacks[0].inside, covariances[1]), moment),
            Cause("print_detail", (2, 0), (covariances[0], stacks[1].inside), moment),
        ]
        found = expected_error((grams[0], grams[1]), causes, self.scenes, lam, slopes)
        pixels = grams[0].shape[0] * grams[1].shape[0]
        value = Value({name: part / pixels for name, part in found.parts.items()}, found.lam)
        if not slopes:
            return value
        by_weight = found.per_weight
        gradients = []
        for own, other in ((0, 1), (1, 0)):
            stack = stacks[own]
            side, factor, moved = sides[own], factors[own], stack.factor.moved
            of = found.of_matrices
            by_cross = found.of_gram[own] * side.gram + of[2 + own][own] * side.squared
            by_detail = 2 * of[4 + own][own] @ stack.detail * side.gram
            by_factor = 2 * factor @ by_cross + moved @ by_detail.T
            by_derivative = factor @ by_detail
            for pattern, light_of in zip(side.patterns.T, stack.bright.T, strict=True):
                seen = factor * pattern @ of[1][own] * pattern
                by_factor += 2 * light_of[:, None] * seen + np.einsum("ij,ij->i", factor, seen)[:, None] * pattern
            rows = len(factor)
            if exposed is not None:
                by_exposure = by_weight[0] * (noise + (light.read_noise_e / electrons) ** 2)
                by_factor -= (by_exposure + by_weight[1] * prior.mean / electrons) * exposed[own]
            by_response = sum(by_weight[2 + k] * errors[k] for k in (0, 1)) / response
            by_factor += by_response / session * full[other] / rows
            # The error of the other factor falls with the norm of this side's common response.
            by_factor += (-2 * by_weight[2 + other] * errors[other] / norms[own]) * common[own][:, None]
            gradients.append(stack.factor.back(by_factor, by_derivative) / pixels)
        return Value(value.parts, found.lam, (gradients[0], gradients[1]))


@dataclass(frozen=True, eq=False)
class Value:
    """Expected mean squared error by cause, lambda, and the gradients (N,) with respect to both codes."""

    parts: dict[str, float]
    lam: float
    slopes: tuple[FloatArray, ...] = ()

    @property
    def total(self) -> float:
        return sum(self.parts.values())

    @property
    def psnr_db(self) -> float:
        return float(-10 * np.log10(self.total))
