"""Expected squared error of an image by cause, as a closed form of factors, patterns, light, noise and scene.

With lambda fixed the image is linear in the frames, and the basis V is orthonormal, so that the squared error of the
image is that of its coefficients F o W, F = sigma / (sigma^2 + lambda) (:mod:`mitsim.reconstruct.uncertainty`). Noise
adds F^2 times its variance in W. What is not noise follows from five data of one scene, whose reflectance is given in
cells, c a side of a projector pixel:

* *pixels*: the true coefficients x of the pixels' means, which a perfect image has;
* *fine*: data of all cells through the camera's best separable term, over sigma x where cells of a pixel are equal;
* *full*: the same through all terms of the shadow, as diffraction of several wavelengths makes them;
* *seen*: data of the light as it was traced, which also has other depths and light over several surfaces;
* *black*: light that black pixels of the projector leak into all frames.

Regularisation removes (1 - F sigma) x, detail inside pixels adds F (fine - sigma x), terms that the factors lack
F (full - fine), light from elsewhere F (seen - full), and black pixels F black. A scene is a mean and, for a prior, the
mean squares S of the cosine coefficients of its detail (orthonormal DCT), which are independent: with the operators
A_L, A_R and B_L, B_R of two data in cosines, the expected product of coefficient (a, b) is sum_kl A_L[a, k] B_L[a, k]
S[k, l] A_R[b, l] B_R[b, l]. Each cause has half of its cross terms with others, so that the causes add up to the whole.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from scipy.fft import dct

from mitsim.core.arrays import FloatArray, SeparableTerm
from mitsim.reconstruct.accumulation import pattern_response
from mitsim.reconstruct.solver import RISK_POWER, Pair, Prepared, best_lambda, prepare
from mitsim.reconstruct.uncertainty import frame_variances, kind_responses

SHOT, DARK, READ, UNEVEN = "shot_noise", "dark_current", "read_noise", "speckle_and_nonuniformity"
SESSION, AMBIENT, DETAIL, DIFFRACTION = "calibration_noise", "ambient_light", "detail", "diffraction"
ELSEWHERE, BLACK, REGULARISATION = "depth_and_indirect", "black_level", "regularisation_bias"


@dataclass(frozen=True, eq=False)
class Scene:
    """Mean (c n, c n') of a scene's reflectance in cells, and mean squares of the cosine coefficients of its detail.

    ``beyond`` is light over several surfaces relative to that of the cells; it only adds to the noise.
    """

    mean: FloatArray
    power: FloatArray | None = None
    beyond: float = 0.0

    def pixels(self, cells: int) -> FloatArray:
        """Return the mean by projector pixel, of ``cells`` a side each."""
        rows, columns = (size // cells for size in self.mean.shape)
        return np.asarray(self.mean.reshape(rows, cells, columns, cells).mean(axis=(1, 3)))

    @classmethod
    def prior(cls, size: int, mean: float, variance: float, length: float) -> Scene:
        """Return a scene of ``size`` cells a side whose covariance is exp(-distance / ``length`` [cells]) a side."""
        place, cosines = np.arange(size), dct(np.eye(size), axis=0, norm="ortho")
        covariance = np.exp(-np.abs(place[:, None] - place) / length)
        along = np.einsum("ka,ab,kb->k", cosines, covariance, cosines, optimize=True)
        return cls(np.full((size, size), mean), variance * np.outer(along, along))


@dataclass(frozen=True, eq=False)
class Camera:
    """Calibrated factors (m, n) and (m', n') [(electrons / s)^(1/2)], and the true shadow of cells.

    ``best`` (m, c n) and ``terms`` are the separable term whose means over the cells of a pixel are the factors, and
    all terms. ``leak`` is the light of a black projector pixel over that of a white one.
    """

    factors: Pair
    best: SeparableTerm
    terms: Sequence[SeparableTerm]
    centre: bool = False
    leak: float = 0.0

    @property
    def cells(self) -> int:
        """Return the cells along a side of a projector pixel."""
        return int(self.best[0].shape[1] // self.factors[0].shape[1])

    @cached_property
    def pixel_terms(self) -> list[Pair]:
        """Return all terms (m, n) and (m', n') of the shadow by projector pixel."""
        means = [[side.reshape(len(side), -1, self.cells).mean(axis=2) for side in term] for term in self.terms]
        return [(left, right) for left, right in means]

    def brightest(self, scene: Scene, patterns: Pair, ambient: FloatArray | float = 0.0) -> float:
        """Return the light of the brightest pixel of all shots [electrons / s]."""
        pixels, signed = (1 + scene.beyond) * scene.pixels(self.cells), any((side < 0).any() for side in patterns)
        dark = seen_frame(self.pixel_terms, pixels)
        leaking, most = self.leak * dark + ambient, 0.0
        for rows, columns in product(patterns[0].T.astype(np.float64), patterns[1].T.astype(np.float64)):
            shown = seen_frame(self.pixel_terms, pixels * np.outer(rows, columns))
            shots = ((dark + shown) / 2, (dark - shown) / 2) if signed else (shown,)
            most = max(most, *(float((shot + leaking).max()) for shot in shots))
        return most


def seen_frame(terms: Sequence[SeparableTerm], light: FloatArray) -> FloatArray:
    """Return the frame (m, m') of the ``light`` of scene pixels (n, n') through ``terms``."""
    rows, columns = np.flatnonzero(light.any(axis=1)), np.flatnonzero(light.any(axis=0))
    lit = light[np.ix_(rows, columns)]
    return sum((left[:, rows] @ lit @ right[:, columns].T for left, right in terms), np.zeros((1, 1)))


@dataclass(frozen=True)
class Noise:
    """Noise of a single frame, and of the factors.

    Attributes
    ----------
    seconds
        Exposure time [s].
    dark, read
        Dark current [electrons / s], and variance of reading and rounding [electrons^2].
    uneven
        Variance of each pixel's light relative to itself, by speckle and nonuniform response.
    factors
        Standard deviation of each number of the left and of the right factor.
    ambient, ambient_shots
        Ambient light (m, m') [electrons / s], and the shots of its frame, which is subtracted from all; 0 for none.
    """

    seconds: float
    dark: float = 0.0
    read: float = 0.0
    uneven: float = 0.0
    factors: tuple[float, float] = (0.0, 0.0)
    ambient: FloatArray | None = None
    ambient_shots: int = 0


@dataclass(frozen=True, eq=False)
class Errors:
    """Expected squared error of an image by cause, its mean over all pixels, and the lambda of the image."""

    causes: Mapping[str, float]
    lam: float

    @property
    def total(self) -> float:
        return float(sum(self.causes.values()))

    @property
    def psnr_db(self) -> float:
        return decibels(self.total)

    @property
    def largest(self) -> str:
        """Return the largest cause in words."""
        return max(self.causes, key=lambda name: self.causes[name]).replace("_", " ")


def decibels(square: float) -> float:
    """Return a mean squared error of reflectance as PSNR [dB], infinite for none."""
    return float(-10 * np.log10(square)) if square > 0 else float("inf")


_Data = Sequence[Pair] | FloatArray
"""Separable operators, (r, c n) and (r', c n'), whose sum makes coefficients of a scene in cells; or these (r, r')."""


class Predictor:
    """Expected errors of the images of a ``camera`` under ``patterns`` (n, K) and (n', K'), by lambda."""

    def __init__(
        self, camera: Camera, patterns: Pair, scene: Scene, noise: Noise, seen: FloatArray | None = None
    ) -> None:
        self.seen, self.camera, self.scene, self.noise = seen, camera, scene, noise
        self.patterns = (np.asarray(patterns[0], np.float64), np.asarray(patterns[1], np.float64))
        self.signed = any(bool((side < 0).any()) for side in patterns)
        self.prepared: Prepared = prepare(*camera.factors, *self.patterns, centre=camera.centre)
        self._sides, self._c = (self.prepared.left, self.prepared.right), camera.cells
        self._lit_pixels = (1 + scene.beyond) * scene.pixels(self._c)
        # Both shots of a signed pattern light every pixel once.
        self._lighting = [np.ones_like(side) if self.signed else side for side in self.patterns]

    def calibrated(self, factors: tuple[float, float]) -> Predictor:
        """Return the predictor with other deviations of the factors; what does not depend on them is shared."""
        _ = self._moments  # shared from now on
        other = copy(self)
        other.noise = replace(self.noise, factors=factors)
        for name in ("lambdas", "_variances"):
            vars(other).pop(name, None)
        return other

    def errors(self, lam: float | None = None) -> Errors:
        """Return the errors at ``lam``; None for the lambda that the solver chooses by itself."""
        lam = self.automatic if lam is None else lam
        causes = {name: float(each.sum()) / self.prepared.unknowns for name, each in self._by_coefficient(lam).items()}
        # Nothing shows the part of the scene beyond the basis.
        causes[REGULARISATION] += max(self._energy - float(self._moments[0, 0].sum()), 0.0) / self.prepared.unknowns
        return Errors(causes, lam)

    def session_scatter(self, lam: float) -> float:
        """Return the standard deviation of the squared error between sessions, relative to its mean.

        A session adds normal errors x of covariance C to the errors e of other causes, whose signs are taken as random.
        The sum of squares of e + x then has the variance 2 tr C^2 + 4 sum_i C_ii e_i^2 (Searle, Linear Models, 1971,
        section 2.5). Noise of a factor is correlated only between coefficients of one row, or of one column.
        """
        square, variance, errors = np.square(self.prepared.gain(lam)), 0.0, self._by_coefficient(lam)
        for axis, weights in enumerate((square, square.T)):
            variances, data = self._factor_data(axis)
            light = self._mean_of(data) if axis == 0 else self._mean_of(data).T
            for own, weight in zip(variances, weights, strict=True):
                variance += 2 * float(own @ np.square((light * weight) @ light.T) @ own)
        both = np.square(square) * self._of_factor(0) * self._of_factor(1).T
        others = np.sum([each for name, each in errors.items() if name != SESSION], axis=0)
        variance += 4 * float(np.sum(both + errors[SESSION] * others))
        return float(np.sqrt(variance)) / self.prepared.unknowns / self.errors(lam).total

    @property
    def automatic(self) -> float:
        """Return the lambda of the solver.

        It lies between the :attr:`lambdas`, because a solver learns of light from elsewhere only what does not fit; in
        four scenes with depth it was their geometric mean within a factor of 2.
        """
        known, every = self.lambdas
        return float(np.sqrt(known * every)) if known > 0 else every

    @cached_property
    def lambdas(self) -> tuple[float, float]:
        """Return the lambdas of the least error as a solver estimates it, without and with light from elsewhere.

        A solver weights the errors as :func:`automatic_lambda` does, and takes all that is not the pixels' light for
        noise, whose sign it does not know.
        """
        moments, sigma = self._moments, self.prepared.sigma
        weights, scale = sigma**RISK_POWER, float(np.square(sigma.max()))
        left, right = (float(np.square(side).sum(axis=1).mean()) for side in self.patterns)
        least = replace(self.prepared, noise=self.noise.factors, light=(left, right)).least_lambda

        def best(last: int) -> float:
            noise = np.sum([*self._variances.values()], axis=0)
            for number in range(1, last + 1):  # the squared steps from sigma x to fine, full and seen data
                of = sigma if number == 1 else 1.0
                cross, before = moments[number, number - 1], moments[number - 1, number - 1]
                noise += moments[number, number] - 2 * of * cross + of * of * before

            def risk(lam: float) -> float:
                errors = np.square(lam / (np.square(sigma) + lam)) * moments[0, 0] if lam else np.zeros_like(sigma)
                return float(np.vdot(weights, errors + np.square(self.prepared.gain(lam)) * noise))

            return max(best_lambda(risk, scale), least)

        every = best(last=3)
        return (every if self.seen is None else best(last=2)), every

    def _by_coefficient(self, lam: float) -> dict[str, FloatArray]:
        sigma, gain = self.prepared.sigma, self.prepared.gain(lam)
        kept, zero, square = gain * sigma, np.zeros_like(sigma), np.square(gain)
        found = {name: square * variance for name, variance in self._variances.items()}
        # By cause the weights of pixels, fine, full, seen and black, whose sum is the error of the whole.
        parts = {
            DETAIL: (-kept, gain, zero, zero, zero),
            DIFFRACTION: (zero, -gain, gain, zero, zero),
            ELSEWHERE: (zero, zero, -gain, gain, zero),
            BLACK: (zero, zero, zero, zero, gain),
            REGULARISATION: (kept - 1, zero, zero, zero, zero),
        }
        whole = [np.sum(each, axis=0) for each in zip(*parts.values(), strict=True)]
        beside = [sum(other * self._moments[i, j] for j, other in enumerate(whole)) for i in range(len(whole))]
        return found | {name: sum(map(np.multiply, weights, beside), zero) for name, weights in parts.items()}

    # ---- Data of the scene

    @cached_property
    def _moments(self) -> dict[tuple[int, int], FloatArray]:
        full = self._data_of(self.camera.terms)
        seen = full if self.seen is None else self.seen
        left, right = (self._in_cells(side.basis.T) for side in self._sides)
        data = [[(left, right)], self._data_of([self.camera.best]), full, seen, self._black_data()]
        found = dict[tuple[int, int], FloatArray]()
        for i, j in product(range(len(data)), repeat=2):
            found[i, j] = found[j, i] if j < i else self._expected(data[i], data[j])
        return found

    def _expected(self, first: _Data, second: _Data) -> FloatArray:
        total, power = self._mean_of(first) * self._mean_of(second), self.scene.power
        if power is not None:
            for (a, b), (c, d) in product(*(map(_in_cosines, data) for data in (first, second))):
                total = total + (a * c) @ power @ (b * d).T
        return total

    def _mean_of(self, data: _Data) -> FloatArray:
        if isinstance(data, np.ndarray):
            return data
        return np.asarray(sum((left @ self.scene.mean @ right.T for left, right in data), np.zeros((1, 1))))

    def _black_data(self) -> _Data:
        leak, (left, right) = 0.0 if self.signed else self.camera.leak / self._c**2, self._sides
        return [(leak * left.common.T @ a, right.common.T @ b) for a, b in self.camera.terms]

    def _data_of(self, terms: Sequence[SeparableTerm]) -> _Data:
        shown = [np.repeat(side, self._c, axis=0) / self._c for side in self.patterns]
        each = ([pattern_response(*one) for one in zip(self._sides, term, shown, strict=True)] for term in terms)
        return [(left, right) for left, right in each]

    def _in_cells(self, rows: FloatArray) -> FloatArray:
        return np.repeat(rows, self._c, axis=1) / self._c

    # ---- Noise

    @cached_property
    def _variances(self) -> dict[str, FloatArray]:
        noise, sigma, sides, shots = self.noise, self.prepared.sigma, self._sides, 2 if self.signed else 1
        rows, columns = self.light
        found = {
            SHOT: frame_variances(sides, rows / noise.seconds, columns / noise.seconds),
            DARK: np.full(sigma.shape, shots * noise.dark / noise.seconds),
            READ: np.full(sigma.shape, shots * noise.read / noise.seconds**2),
            UNEVEN: np.full(sigma.shape, noise.uneven * self._frame_square),
            SESSION: self._of_factor(0) + self._of_factor(1).T,
            AMBIENT: np.zeros_like(sigma),
        }
        if noise.ambient is not None:
            every = np.full((*rows.shape[:2], 1), shots / noise.seconds)
            shot = frame_variances(sides, every * noise.ambient.mean(axis=1), every * noise.ambient.mean(axis=0))
            if noise.ambient_shots and not self.signed:
                share = (noise.ambient + noise.dark + noise.read / noise.seconds) / noise.seconds / noise.ambient_shots
                left, right = (np.square(side.common) for side in sides)
                shot = shot + np.outer(share.mean(axis=1) @ left, share.mean(axis=0) @ right) / share.mean()
            found[AMBIENT] = shot
        return found

    @cached_property
    def light(self) -> Pair:
        """Return the mean light of all frames by row (K, K', m) and by column (K, K', m') [electrons / s]."""
        (left_lit, right_lit), pixels, rows, columns = self._lighting, self._lit_pixels, 0.0, 0.0
        for left, right in self.camera.pixel_terms:
            down = pixels.T @ (left_lit * left.mean(axis=0)[:, None])
            across = pixels @ (right_lit * right.mean(axis=0)[:, None])
            rows = rows + np.einsum("mp,pi,pj->ijm", left, left_lit, across, optimize=True)
            columns = columns + np.einsum("mq,qj,qi->ijm", right, right_lit, down, optimize=True)
        return np.asarray(rows), np.asarray(columns)

    @property
    def _frame_square(self) -> float:
        """Return the mean square of a frame's light, without the detail that a prior has."""
        total, pixels = 0.0, self._lit_pixels
        left_lit, right_lit = (side @ side.T for side in self._lighting)
        for (a, b), (c, d) in product(self.camera.pixel_terms, repeat=2):
            total += float(np.vdot(pixels, ((a.T @ c) * left_lit) @ pixels @ ((d.T @ b) * right_lit)))
        frames = self.patterns[0].shape[1] * self.patterns[1].shape[1]
        return total / float(frames * self._sides[0].sensor_size * self._sides[1].sensor_size)

    def _of_factor(self, axis: int) -> FloatArray:
        """Return the variance (r, r') of W by independent noise of a factor, sum_p rho[a, p] (X V S)[p, b]^2."""
        variances, data = self._factor_data(axis)
        seen = self._expected(data, data)
        return variances @ (seen if axis == 0 else seen.T)

    def _factor_data(self, axis: int) -> tuple[FloatArray, Sequence[Pair]]:
        """Return the variances s^2 rho (r, n) of a factor's noise, and the operator of its light X V S (n, r')."""
        own, other = self._sides[axis], self._sides[1 - axis]
        responses, of_kind = kind_responses(own, self.patterns[axis])
        through = self._in_cells(np.eye(own.scene_size)), self._in_cells(other.response.T)
        return self.noise.factors[axis] ** 2 * responses @ of_kind, [through if axis == 0 else through[::-1]]

    @property
    def _energy(self) -> float:
        left, right = (self._in_cells(np.eye(side.scene_size)) for side in self._sides)
        return float(self._expected([(left, right)], [(left, right)]).sum())


def _in_cosines(pair: Pair) -> Pair:
    return dct(pair[0], axis=1, norm="ortho"), dct(pair[1], axis=1, norm="ortho")
