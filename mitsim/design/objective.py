"""Expected error of a camera as a function of its separable mask code, with its gradient.

A factor is F = T I with a sparse T, whose rows are pairs of sensor pixel and projector pixel, and the light I behind
the mask, a sum of squared fields that are linear in the code; in geometric optics a field is the code itself.
The derivative F' by the position of a projector pixel is linear in I likewise. Therefore the gradient of
:func:`mitsim.design.expected.expected_error` with respect to the code is exact. Ambient light is a product of
profiles along both axes; its noise is that of its mean over the sensor.

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
from scipy.fft import fft, ifft, next_fast_len
from scipy.sparse import csr_array, eye_array, kron

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


_Weights = tuple[FloatArray, FloatArray, FloatArray]


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
    ``frame_s`` is the exposure time of one frame, and ``session_e`` are electrons of the brightest pixel of a session.
    With ``signal_e``, the mean electrons of a pixel and frame, exposures are of equal light instead: a mask that
    transmits less is exposed for longer. No pixel gets more than ``most_e``: a mask that transmits more is exposed for
    a shorter time. ``ambient_shots`` are those of the ambient frame that is subtracted from all frames. 0 is none.
    """

    gain: float
    frame_s: float
    session_e: float
    read_noise_e: float
    dark_e_per_s: float
    signal_e: float = 0.0
    most_e: float = math.inf
    ambient_shots: float = 0.0


class CodedSide:
    """One axis of a camera as a function of a mask code (N,), and patterns (n, k) along that axis.

    The light behind the mask is sum_l w_l |h_l * a|^2 on a grid, with the lines l of a ``spectrum`` and the field h
    behind a single feature; without a spectrum it is a^2 in features. Pixels take means of that light. ``lamps`` are
    directions of ambient light with their light, relative to that of a white projector pixel.
    """

    def __init__(
        self,
        camera: CameraGeometry,
        axis: int,
        directions: Directions,
        features: int,
        patterns: FloatArray,
        spectrum: Spectrum | None = None,
        lamps: Sequence[tuple[Directions, FloatArray]] = (),
    ) -> None:
        shadow = ShadowGeometry.of(camera, camera.scene_distance).along(axis)
        pixels, self.features, feature = shadow.pixel_centres_mm, features, camera.mask_feature
        own, seen = shadow.from_mask(directions, axis)
        reach = float(np.abs(own.crossings(seen)).max()) + own.half_pixel + 2 * own.half_cell(seen)
        self._weights, products, parts, spans = np.ones(1), np.zeros(1), 1, features
        if spectrum is not None:
            products = spectrum.wavelengths_nm * 1e-6 * shadow.distance_mm * shadow.shrink
            self._weights, parts = spectrum.weights, math.ceil(_CELLS * feature / float(products.min()) ** 0.5)
            spans = 2 * math.ceil(reach / feature)
        cell, count = feature / parts, spans * parts
        _check_size(camera, features, count * len(products))
        # A cell is a part of a feature, so that fields of one part of all features are a convolution of the code.
        places = (
            np.arange(-(features - 1) * parts, count, dtype=np.float64) + 0.5 - (count - features * parts) / 2
        ) * cell
        edges = places, places - feature
        fields = np.stack([np.subtract(*(_step_fields(x, by, cell) for x in edges)) for by in products.tolist()])
        self._size, self._inside = next_fast_len(features + spans - 1), slice(features - 1, features + spans - 1)
        self._spectra = fft(fields.reshape(len(products), -1, parts).swapaxes(1, 2), self._size)

        def means(directions: Directions, shift: float = 0.0) -> csr_array:
            """Return the means (c m, count) of light by direction and pixel."""
            squared = np.square(directions.centres[:, None] - pixels / camera.scene_distance)
            loss = (1 + squared) ** -2.0 * camera.angular_response(squared) * camera.pixel_fill_factor
            moved = Directions(directions.centres + shift * directions.width, directions.width)
            own, seen = shadow.from_mask(moved, axis)
            half = np.asarray(own.half_pixel / cell), np.asarray(own.half_cell(seen) / cell)
            every = zip(*trapezoid_weights(own.crossings(seen).T / cell, *half, count), strict=True)
            places, values = (np.stack(each, axis=-1).reshape(loss.size, -1) for each in every)
            values = values * loss.ravel()[:, None]
            rows = np.broadcast_to(np.arange(loss.size)[:, None], places.shape)
            inside = (places >= 0) & (places < count) & (values != 0)
            return csr_array((values[inside], (rows[inside], places[inside])), shape=(loss.size, count))

        self._means, self._lamps = means(directions), csr_array((len(pixels), count))
        self._moved = (means(directions, _STEP) - means(directions, -_STEP)) / (2 * _STEP)
        for beyond, light in lamps:
            self._lamps += kron(light[None, :], eye_array(len(pixels))).tocsr() @ means(beyond)
        self._show(patterns)
        middles = (np.arange(features) + 0.5 - features / 2) * feature
        self.used = np.flatnonzero(np.abs(middles) < reach + feature / 2)

    def _show(self, patterns: FloatArray) -> None:
        """Group projector pixels by patterns if each has its own, which makes M block diagonal.

        ``pixels`` (groups, size) are filled up with others that are not ``real``, and ``lit`` are the patterns of each
        group, (groups, size, patterns).
        """
        self.patterns = patterns
        one_each = bool((np.count_nonzero(patterns, axis=1) == 1).all())
        groups = [np.flatnonzero(each) for each in (patterns.T if one_each else np.ones((1, len(patterns))))]
        size = max(map(len, groups))
        self.pixels = np.array([np.resize(each, size) for each in groups], dtype=np.intp)
        self.real = np.arange(size) < np.array([[len(each)] for each in groups])
        shown = np.arange(patterns.shape[1]).reshape(len(groups), 1, -1)
        self.lit = patterns[self.pixels[:, :, None], shown] * self.real[:, :, None]
        self.gram = self.lit @ self.lit.mT
        self.squared, total = self.gram @ self.gram, self.lit.sum(axis=2)
        self.summed = total[:, :, None] * total[:, None, :]
        self.overlap = np.square(total).sum() / np.square(self.lit).sum()

    def grouped(self, matrix: FloatArray) -> FloatArray:
        """Return the blocks (groups, size, size) of a matrix (n, n)."""
        return np.asarray(matrix[self.pixels[:, :, None], self.pixels[:, None, :]])

    def lit_by(self, lit: str) -> CodedSide:
        """Return the side under the cyclic patterns of a code."""
        other = copy(self)
        other._show(cyclic_patterns(lit, len(self.patterns)))
        return other

    def __call__(self, code: FloatArray) -> Factor:
        fields = ifft(self._spectra * fft(code, self._size))[..., self._inside]
        light = np.tensordot(self._weights, fields.real**2 + fields.imag**2, 1).T.ravel()

        def back(by_factor: FloatArray, by_derivative: FloatArray, by_ambient: FloatArray) -> FloatArray:
            by_light = self._means.T @ by_factor.ravel() + self._moved.T @ by_derivative.ravel()
            by_light += self._lamps.T @ by_ambient
            by_fields = np.zeros((*fields.shape[:2], self._size), dtype=complex)
            by_fields[..., self._inside] = fields * by_light.reshape(-1, fields.shape[1]).T
            by_fields = np.tensordot(self._weights, fft(by_fields) * self._spectra.conj(), 1).sum(axis=0)
            return np.asarray(2 * ifft(by_fields).real[: self.features])

        values, slopes = ((each @ light).reshape(len(self.patterns), -1) for each in (self._means, self._moved))
        own, moved = values[self.pixels], slopes[self.pixels]
        cross, bright, ambient = own @ own.mT, self.lit.mT @ own, self._lamps @ light
        shot, detail = np.zeros_like(cross), own @ moved.mT * self.gram
        for pattern, seen in zip(np.moveaxis(self.lit, 2, 0), np.moveaxis(bright, 1, 0), strict=True):
            stack = own * pattern[..., None]
            shot += (stack * seen[:, None]) @ stack.mT
        gram, reused, summed = cross * self.gram, cross * self.squared, cross * self.summed
        dimmed = (own * ambient) @ own.mT * self.gram
        matrices = gram, shot, reused, detail @ detail.mT, dimmed, summed
        return Factor(values, ambient, back, own, moved, bright, detail, matrices)


@dataclass(frozen=True, eq=False)
class Factor:
    """Factor (n, m), ambient light (m,), and the code's gradient from those by factor, derivative and ambient light.

    By groups of pixels are the factor and its derivative by the position of a projector pixel (groups, size, m), light
    under each pattern (groups, k, m), and the matrices of the causes of error (groups, size, size).
    """

    values: FloatArray
    ambient: FloatArray
    back: Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
    own: FloatArray
    moved: FloatArray
    bright: FloatArray
    detail: FloatArray
    matrices: tuple[FloatArray, ...]


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
    """Return the field behind an edge at distances ``x`` [mm], as :class:`mitsim.optics.diffraction.EdgeWaves`.

    ``product`` is wavelength times distance [mm^2]; 0 for rays.
    """
    if not product:
        return (x > 0).astype(np.complex128)
    fade = product / (2 * cell)
    wave = edge_wave(np.maximum(np.abs(x), 1e-9) * (2 / product) ** 0.5)
    wave *= np.square(np.cos(np.pi / 2 * np.clip(4 * np.abs(x) / fade - 3, 0, 1)))
    return np.asarray(np.where(x > 0, 1 + wave, -wave))


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
        rows, columns = (side.grouped(self.prior.covariance(len(side.patterns))) for side in self.sides)
        return rows, columns

    @cached_property
    def _scenes(self) -> list[FloatArray]:
        places = np.ix_(*(side.pixels.ravel() for side in self.sides))
        real = np.outer(*(side.real.ravel() for side in self.sides))
        return [scene[places] * real for scene in self.scenes]

    def frame_s(self, codes: Sequence[FloatArray]) -> float:
        """Return the exposure time of a frame [s]."""
        return self._exposure([side(code) for side, code in zip(self.sides, codes, strict=True)])[0]

    def _exposure(self, factors: Sequence[Factor]) -> tuple[float, Sequence[_Weights] | None]:
        """Return the exposure time [s], and the derivatives of its logarithm by both sides; None if it is fixed.

        The derivative by a factor is a product of weights (n,) and (m,); that by ambient light is (m,).
        """
        light, prior, means, peaks = self.light, self.prior, list[_Weights](), list[_Weights]()
        for side, factor in zip(self.sides, factors, strict=True):
            bright, one = side.patterns.T @ factor.values, np.ones(len(factor.ambient))
            pattern, pixel = np.unravel_index(np.argmax(bright), bright.shape)
            at = (one * (np.arange(len(one)) == each) for each in (pixel, np.argmax(factor.ambient)))
            means.append((side.patterns.mean(axis=1), one / len(one), 0 * one))
            peaks.append((side.patterns[:, pattern], next(at), next(at)))

        def exposed(electrons: float, reflectance: float, weights: list[_Weights]) -> tuple[float, list[_Weights]]:
            lit, lamps = list[float](), list[float]()
            for factor, (a, b, c) in zip(factors, weights, strict=True):
                lit.append(float(a @ factor.values @ b))
                lamps.append(float(c @ factor.ambient))
            bright = reflectance * lit[0] * lit[1] + lamps[0] * lamps[1]
            each = zip(weights, lit[::-1], lamps[::-1], strict=True)
            slopes = [(a * (-reflectance * x / bright), b, c * (-y / bright)) for (a, b, c), x, y in each]
            return electrons / (light.gain * bright), slopes

        limit = exposed(light.most_e, prior.mean + _BRIGHT * prior.deviation, peaks)
        asked = exposed(light.signal_e, prior.mean, means) if light.signal_e else (light.frame_s, None)
        return limit if limit[0] < asked[0] else asked

    def of_equal_light(self, codes: Sequence[FloatArray]) -> Objective:
        """Return the objective for exposures with as much light as a mask of these codes has."""
        scale = replace(self, light=replace(self.light, signal_e=1.0)).frame_s(codes)
        return replace(self, light=replace(self.light, signal_e=self.light.frame_s / scale))

    def lit_by(self, lit: str) -> Objective:
        """Return the objective for cyclic patterns of a code, as many as the patterns before, in the same time."""
        rows = self.sides[0].lit_by(lit)
        sides = rows, (rows if self.sides[0] is self.sides[1] else self.sides[1].lit_by(lit))
        light = self.light
        for new, old in zip(sides, self.sides, strict=True):
            brighter, more = new.patterns.mean() / old.patterns.mean(), new.overlap / old.overlap
            # Equal light is that of one mask for all.
            light = replace(light, signal_e=light.signal_e * brighter, ambient_shots=light.ambient_shots * more)
        return replace(self, sides=sides, light=light)

    def __call__(self, codes: Sequence[FloatArray], lam: float | None = None, slopes: bool = False) -> Value:
        light, prior, sides = self.light, self.prior, self.sides
        first = sides[0](codes[0])
        alike = sides[0] is sides[1] and codes[0] is codes[1]
        stacks = first, (first if alike else sides[1](codes[1]))
        factors = [stack.values for stack in stacks]
        gram, shot, reused, inside, dimmed, summed = zip(*(each.matrices for each in stacks), strict=True)
        covariances, one = self._covariances, [np.eye(side.pixels.shape[1]) for side in sides]
        second = [prior.mean**2 + prior.deviation**2 * each for each in covariances]
        seconds, exposed = self._exposure(stacks)
        electrons = light.gain * seconds
        noise = light.read_noise_e**2 / electrons**2 + light.dark_e_per_s / light.gain / electrons
        lamps = [float(stack.ambient.mean()) for stack in stacks]
        once, ambient = 1 / light.ambient_shots if light.ambient_shots else 0.0, lamps[0] * lamps[1] / electrons
        # A side's numbers are means over the other's response, and so is the light of both shots of a pair.
        common = [factor.sum(axis=0) for factor in factors]
        norms = [float(each @ each) for each in common]
        full, peaks = [float(each.mean()) for each in common], [float(each.max()) for each in common]
        cubed = [float(np.sum(each**3)) / norm for each, norm in zip(common, norms, strict=True)]
        session = light.session_e / (peaks[0] * peaks[1])
        read, dark = 2 * light.read_noise_e**2 / session**2, 2 * light.dark_e_per_s / light.gain / session
        errors = [(read + dark + full[k] * cubed[1 - k] / session) / len(factors[k]) / norms[1 - k] for k in (0, 1)]
        moment = prior.deviation**2 * (1 - prior.correlation) * _MOMENT
        causes = [
            Cause("dark_and_read_noise", (1, 1), (one[0], one[1]), noise),
            Cause("shot_noise", (0, 0), shot, prior.mean / electrons),
            Cause("calibration_noise", (0, 2), (reused[0], second[1]), errors[0]),
            Cause("calibration_noise", (2, 0), (second[0], reused[1]), errors[1]),
            Cause("print_detail", (0, 2), (inside[0], covariances[1]), moment),
            Cause("print_detail", (2, 0), (covariances[0], inside[1]), moment),
            Cause("ambient_light", (0, 0), dimmed, 1 / electrons),
            Cause("ambient_light", (0, 0), summed, (noise + ambient) * once),
        ]
        found = expected_error(gram, causes, self._scenes, lam, slopes)
        pixels = len(factors[0]) * len(factors[1])
        value = Value({name: part / pixels for name, part in found.parts.items()}, found.lam)
        if not slopes:
            return value
        by_weight, of, gradients = found.per_weight, found.of_matrices, list[FloatArray]()
        by_exposure = (by_weight[1] * prior.mean + by_weight[6]) / electrons + by_weight[7] * once * ambient
        by_exposure += (by_weight[0] + by_weight[7] * once) * (noise + (light.read_noise_e / electrons) ** 2)
        for k, other in ((0, 1), (1, 0)):
            stack, side, factor = stacks[k], sides[k], factors[k]
            by_cross = found.of_gram[k] * side.gram + of[2 + k][k] * side.squared + of[7][k] * side.summed
            by_detail = 2 * of[4 + k][k] @ stack.detail * side.gram
            by_own = 2 * by_cross @ stack.own + by_detail @ stack.moved
            for pattern, light_of in zip(np.moveaxis(side.lit, 2, 0), np.moveaxis(stack.bright, 1, 0), strict=True):
                seen = (pattern[..., None] * of[1][k] * pattern[:, None]) @ stack.own
                by_light = (stack.own * seen).sum(axis=1)
                by_own += 2 * light_of[:, None] * seen + pattern[..., None] * by_light[:, None]
            seen = (of[6][k] * side.gram) @ stack.own
            by_own += 2 * stack.ambient * seen
            by_ambient = (stack.own * seen).sum(axis=(0, 1))
            by_ambient += by_weight[7] * once * lamps[other] / electrons / len(by_ambient)
            by_factor, by_derivative = np.zeros_like(factor), np.zeros_like(factor)
            by_factor[side.pixels[side.real]] = by_own[side.real]
            by_derivative[side.pixels[side.real]] = (by_detail.mT @ stack.own)[side.real]
            if exposed is not None:
                by_factor -= by_exposure * np.outer(*exposed[k][:2])
                by_ambient -= by_exposure * exposed[k][2]
            by_errors = [by_weight[2 + side] / len(factors[side]) / norms[1 - side] for side in (0, 1)]
            by_session = [2 * read + dark + full[side] * cubed[1 - side] / session for side in (0, 1)]
            # The error of the other factor falls with the norm of this side's common response.
            by_cubed = (3 * common[k] - 2 * cubed[k]) * common[k] / norms[k]
            by_common = by_errors[other] * full[other] / session * by_cubed
            by_common -= 2 * by_weight[2 + other] * errors[other] / norms[k] * common[k]
            by_common += by_errors[k] * cubed[other] / session / len(by_common)
            by_common[np.argmax(common[k])] += float(np.dot(by_errors, by_session)) / peaks[k]
            by_factor += by_common
            gradients.append(stack.back(by_factor, by_derivative, by_ambient) / pixels)
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
