"""Frames added up for the solver, with their noise, and with light that the model lacks.

*Terms that factors lack.* A camera whose shadow is no single product, for example behind a FlatCam mask with
diffraction, adds sum_k L_k (P_ij o X) R_k^T to the frames. With G_kl = L_k^T L_l and H_kl = R_l^T R_k the energy of
these terms over all patterns is ::

    sum_kl <X, (G_kl o P_L P_L^T) X (H_kl o P_R P_R^T)>

of which |T|^2 lies in the model's range, T = sum_k (sum_i U_Li^T L_k diag(p_i)) X (sum_j U_Rj^T R_k diag(q_j))^T.

*Print within a projector pixel.* Fine print has its light a dipole d beside the pixel's centre, which changes frames by
Phi_L (P_ij o d) Phi_R'^T, Phi_R' being the slope of Phi_R along its columns, and likewise for rows. The image shows the
dipole of its ramp, g / 12, but not finer print. Halves of the sensor's columns disagree about it: W_0 - G W contains
sum_j (U_0j - U_j G)^T Phi_R' diag(p_j) d^T. For independent dipoles its energy is a multiple of the energy of the error
in the image, so that the disagreement beyond noise gives the error of the image, place by place. A surface beside the
calibrated distance moves light likewise and is included."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from scipy.ndimage import gaussian_filter

from mitsim.core.arrays import FloatArray, SeparableTerm
from mitsim.core.job import Cost, Limits
from mitsim.core.manifests import FactorNoise, RunManifest
from mitsim.core.runs import Ambient, Capture, Measurement
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.request import BYTES_A_NUMBER, TIKHONOV, keeps_frames, slab_numbers
from mitsim.reconstruct.solver import Accumulator, Halves, Pair, Prepared, Side, Solution, half_spread
from mitsim.reconstruct.solvers import SOLVERS, Solver

EDGES = 2.9
"""Energy of edges over that of the ramp: a dipole t (1 - t) / 2 has the mean square 1/120; slopes around it add 1/346.
"""
PRINT = (1 + EDGES) / 2
CHANCE = 6.0
"""Standard deviations that are left to chance: once in 10^7 images of 64 tiles."""
TINY = 1e-300
OFF = 7e-3
"""Part of a frame, rms, by which it may be off: twice what all measurements together may, as print is not averaged."""


@dataclass(frozen=True, eq=False)
class Model:
    prepared: Prepared
    factors: Pair
    patterns: Pair

    @property
    def sides(self) -> tuple[Side, Side]:
        return self.prepared.left, self.prepared.right

    @cached_property
    def slopes(self) -> Pair:
        return factor_slope(self.factors[0]), factor_slope(self.factors[1])

    @cached_property
    def moved(self) -> Pair:
        left, right = zip(self.sides, self.slopes, self.patterns, strict=True)
        return offset_responses(*left), offset_responses(*right)


def print_energy(model: Model, image: FloatArray) -> float:
    """Return the energy outside a ``model``'s range of print within projector pixels, for an ``image`` (n, n').

    Light of slope g a pixel moves the frames by Phi_L (P_ij o g / 12) Phi_R'^T. With C = S_L V_L^T g / 12 that is
    sum_pq (C^T C o P_R P_R^T o Phi_R'^T Phi_R')[p, q] in all, of which |C T|^2 is in the range, T being
    :func:`offset_responses`; likewise for the other side.
    """
    total = 0.0
    own = tuple(zip(model.sides, model.slopes, model.patterns, model.moved, strict=True))
    for (other, *_), (_, slope, lit, moved), seen in (own[0], own[1], image), (own[1], own[0], image.T):
        if seen.shape[1] > 1:
            along = other.response.T @ np.gradient(seen, axis=1) / 12
            everything = np.sum((along.T @ along) * (lit @ lit.T) * (slope.T @ slope))
            total += float(everything - np.square(along @ moved.sum(axis=0)).sum())
    return EDGES * max(total, 0.0)


def offset_responses(side: Side, slope: FloatArray, patterns: FloatArray) -> FloatArray:
    total = np.zeros((2, slope.shape[1], len(side.singular)))
    for half, strips in zip(total, side.halves, strict=True):
        own = np.concatenate([slope[strip] for strip in strips]).T if strips else np.zeros((slope.shape[1], 0))
        for column, slab in zip(patterns.T, side.slabs, strict=True):
            seen = np.concatenate([slab.matrix[strip] for strip in strips]) if strips else slab.matrix[:0]
            half[:, slab.columns] += column[:, None] * (own @ seen)
    return total


def factor_slope(factor: FloatArray) -> FloatArray:
    """Return the change Phi' (m, n) of a ``factor`` (m, n) by scene pixel.

    A fast shadow's slope is computed along the sensor, because neighbours in the scene may be a feature of the mask
    apart.
    """
    rows, columns = factor.shape
    if columns == 1:
        return np.zeros_like(factor)
    if rows <= 2:
        return np.asarray(np.gradient(factor, axis=1))
    # The shift [sensor pixels] from each scene pixel to the next is where their correlation peaks, by a parabola.
    shadows = np.ascontiguousarray((factor - factor.mean(axis=0)).T)  # transforms are faster along lines of memory
    spectra = np.fft.rfft(shadows, 2 * rows)
    correlation = np.fft.irfft((spectra[1:] * spectra[:-1].conj()).sum(axis=0), 2 * rows)
    place = int(np.argmax(correlation))
    before, peak, after = correlation[np.arange(place - 1, place + 2) % (2 * rows)]
    if peak > 0.5 * float(np.square(shadows).sum()) and before + after < 2 * peak:
        whole = place if place < rows else place - 2 * rows
        shift = whole + 0.5 * float((before - after) / (before - 2 * peak + after))
        if abs(shift) >= 1:
            return np.asarray(-shift * np.gradient(factor, axis=0))
    return np.asarray(np.gradient(factor, axis=1))


def disagreement(model: Model, gain: FloatArray, halves: Halves, known: Pair) -> FloatArray:
    """Return the variance (n, n') of an image by the disagreement of the sensor's halves; 0 where it may be chance.

    ``known`` are the variances (n, n') by errors that change from sensor row to row, and from column to column.
    """
    total = np.zeros_like(known[0])
    sides = model.sides, model.sides[::-1]
    for axis, ((own, other), response, variance) in enumerate(zip(sides, model.moved, known, strict=True)):
        weights, light = np.square(gain.T if axis else gain), np.square(other.response).sum(axis=0)
        whole = response.sum(axis=0)
        parts = whole, response[0] - whole @ own.first_half
        struck, expected = (float(np.square(part).sum(axis=0) @ weights @ light) for part in parts)
        # White noise of variance v has the energy v sum G^2 in the image and v sum (spread G^2) in the difference.
        spread = half_spread(own.first_half)[:, None] * weights
        level = float(variance.sum() / weights.sum())
        difference = gain * halves.differences[axis]
        beyond = float(np.square(difference).sum()) - level * float(spread.sum())
        chance = level * float(np.sqrt(2 * np.square(spread).sum()))
        if expected > 0.01 * struck and beyond > 3.0 * chance:
            excess = np.square(model.prepared.image(difference)) - variance * float(spread.sum() / weights.sum())
            total += struck / expected * gaussian_filter(excess, 2.0, mode="nearest")
    return np.maximum(total, 0.0)


# ---- Noise of frames ----


class FrameNoise:
    """Noise of all measurements of a run, as its manifest states the sensor.

    Variances [(electrons/s)^2] of the ``ambient`` frame are by sensor row (m,) and column (m',); those of patterns (K,
    K'), ``rows`` (K, K', m) and ``columns`` (K, K', m') do not include it. ``light_error`` is the relative error of
    single projector pixels' light in simulated frames. Such an error is one of the image, so that its energy
    ``explained`` leaves no residual.
    """

    def __init__(self, manifest: RunManifest, ambient: Pair | None = None) -> None:
        self._digital = manifest.digital
        self.ambient = ambient
        self.light_error = manifest.light_error or 0.0
        stated: Any = (manifest.plan or {}).get("systematic_error")
        known = isinstance(stated, (int, float)) and not isinstance(stated, bool) and np.isfinite(stated)
        self._sampling, self._systematic = manifest.mc_error or 0.0, float(stated) if known else 0.0
        counts = len(manifest.patterns.P_L[0]), len(manifest.patterns.P_R[0])
        self.variance: FloatArray = np.zeros(counts)
        self.means: FloatArray = np.zeros(counts)
        self.rows: FloatArray = np.zeros((*counts, 0))
        self.columns: FloatArray = np.zeros((*counts, 0))
        self.power, self.shots, self.saturated, self.readings = 0.0, 1, 0, 0
        self.explained = 0.0
        self.light: FloatArray = np.zeros((0, 0))

    @property
    def stated(self) -> bool:
        return self._digital.noise_is_stated

    @property
    def rendering(self) -> float:
        """Energy of rendering errors that no image explains."""
        return max(self._sampling**2 * self.power - self.explained, 0.0) + self._systematic**2 * self.power

    @property
    def discretisation(self) -> float:
        return float(self._systematic**2 * self.power) if self.light_error else self.rendering

    @property
    def coarse(self) -> float:
        """Relative error that a simulation states of its frames; 0 if it is no more than that of a camera."""
        error = float(np.sqrt(self.discretisation / max(self.power, TINY)))
        return error if error > OFF else 0.0

    def of(self, light: FloatArray | float, shots: int) -> FloatArray:
        # The difference of a pair has no ambient frame.
        ambient = float(self.ambient[0].mean()) if self.ambient and shots == 1 else 0.0
        return self._own(light, shots) + ambient

    def chance(self, pixels: float) -> float:
        """Return the excess by chance of the chi-square of so many ``pixels`` in all measurements.

        The energy of normal noise of variance v in n data varies by sqrt(2 n) v.
        """
        return CHANCE * float(np.sqrt(2 * np.square(self.variance).sum() / pixels) / max(self.variance.sum(), TINY))

    def add(self, measurement: Measurement) -> None:
        pattern, light, shots = (measurement.row, measurement.column), measurement.light, measurement.shots
        if not self.rows.size:
            self.rows, self.columns = (np.zeros((*self.variance.shape, size)) for size in light.shape)
            self.light = np.zeros(light.shape)
        self.light += light
        by_row, by_column = light.mean(axis=1), light.mean(axis=0)
        self.means[pattern] = mean = float(by_row.mean())
        self.variance[pattern] = self._own(mean, shots)
        self.rows[pattern], self.columns[pattern] = self._own(by_row, shots), self._own(by_column, shots)
        self.power += measurement.power
        self.shots = shots
        self.saturated += measurement.saturated
        self.readings += shots * measurement.frame.size

    def _own(self, light: FloatArray | float, shots: int) -> FloatArray:
        return np.maximum(self._digital.variance(light, shots), 0.0)


# ---- Energies beside the image: noise of factors, and separable terms that they lack ----


def factor_energy(prepared: Prepared, patterns: Pair, noise: FactorNoise, image: FloatArray) -> float:
    """Return the energy that ``noise`` of the factors adds to all frames, less the part that the fit takes up.

    With d_L the error of Phi_L, independent numbers of variance s^2, frames move by d_L (P_ij o X) Phi_R^T: in the mean
    by m s^2 sum_p |P_L[p]|^2 ||X[p] V_R S_R||^2, and likewise for the other side.
    """
    left, right = prepared.left, prepared.right
    total = 0.0
    sides = (left, right, patterns[0], noise.left, image), (right, left, patterns[1], noise.right, image.T)
    for own, other, lit, deviation, seen in sides:
        spread = np.square(seen @ other.response).sum(axis=1)
        spare = 1 - own.rank / own.data_rows
        total += own.sensor_size * deviation**2 * spare * float(np.square(lit).sum(axis=1) @ spread)
    return total


def pattern_response(side: Side, factor: FloatArray, patterns: FloatArray) -> FloatArray:
    """Return sum_i U_i^T L diag(p_i) (r, n): the data of each scene pixel's light through a ``factor`` L (m, n)."""
    seen = np.zeros((len(side.singular), factor.shape[1]))
    for slab, lit in zip(side.slabs, patterns.T, strict=True):
        seen[slab.columns] += (slab.matrix.T @ factor) * lit
    return seen


def lacking_light(model: Model, terms: Sequence[SeparableTerm], image: FloatArray) -> tuple[FloatArray, float]:
    """Return the data (r, r') of an ``image`` by ``terms`` that the factors lack, and their energy beyond the range."""
    left, right = (lit @ lit.T for lit in model.patterns)
    struck, energy = np.zeros_like(model.prepared.sigma), 0.0
    for term in terms:
        for c, d in terms:
            energy += float(np.vdot(image, ((term[0].T @ c) * left) @ image @ ((d.T @ term[1]) * right)))
        first, second = map(pattern_response, model.sides, term, model.patterns)
        struck += first @ image @ second.T
    return struck, max(energy - float(np.square(struck).sum()), 0.0)


# ---- Frames added up ----


class DerivedCapture(Capture):
    def __init__(
        self,
        whole: Capture,
        part: tuple[slice, slice] = (slice(None), slice(None)),
        sensor: tuple[int, int] | None = None,
    ) -> None:
        super().__init__(whole.manifest, whole.folder)
        self.whole, self._part, self._sensor = whole, part, sensor

    @cached_property
    def patterns(self) -> Pair:
        return self.whole.patterns

    @cached_property
    def ambient(self) -> Ambient | None:
        whole = self.whole.ambient
        return whole and Ambient(whole.rate[self._part], whole.variance[self._part], whole.shots)

    def pattern_measurements(self, shape: tuple[int, int] | None = None) -> Iterator[Measurement]:
        for each in self.whole.pattern_measurements(self._sensor or shape):
            yield replace(each, frame=each.frame[self._part], light=each.light[self._part])


@dataclass(frozen=True, eq=False)
class Accumulation:
    shots: Capture
    factors: Factors
    solver: Solver
    model: Model
    frames: Accumulator
    noise: FrameNoise
    kept: tuple[Measurement, ...]
    coefficients: Mapping[tuple[int, int], FloatArray] = field(default_factory=dict)
    iterative: Mapping[str, Any] = field(default_factory=dict)

    @property
    def prepared(self) -> Prepared:
        return self.model.prepared

    @property
    def weights(self) -> FloatArray:
        problem = self.prepared.problem(self.frames)
        return np.where(problem.sigma > 0, problem.projected, 0.0)

    @property
    def lit_everywhere(self) -> tuple[int, int] | None:
        lit = [np.flatnonzero((side > 0).all(axis=0)) for side in self.shots.patterns]
        return (int(lit[0][0]), int(lit[1][0])) if all(map(len, lit)) else None

    def measurements_again(self) -> Iterable[Measurement]:
        return self.kept or self.shots.pattern_measurements()

    def solution(self, lam: float | Literal["auto"]) -> Solution:
        return self.solver.compute(self.prepared, self.frames, lam, **self.iterative)

    def lack(self, image: FloatArray) -> tuple[FloatArray, float] | None:
        return lacking_light(self.model, self.factors.lacking, image) if self.factors.lacking else None

    def factor_energy(self, image: FloatArray) -> float | None:
        stated = self.factors.manifest.noise
        return factor_energy(self.prepared, self.shots.patterns, stated, image) if stated else None


def accumulate(shots: Capture, factors: Factors, solver: Solver = SOLVERS[TIKHONOV], **iterative: Any) -> Accumulation:
    """Factorise the model and add every frame; MitsimError where memory is short or a frame unreadable."""
    check_factorising(shots, factors, solver)
    prepared = solver.init(factors, shots.patterns)
    # The difference of a pair has no ambient frame.
    signed = any(shot.sign for shot in shots.manifest.patterns.captures)
    variance = None if signed or shots.ambient is None else shots.ambient.variance
    ambient = None if variance is None else (variance.mean(axis=1), variance.mean(axis=0))
    noise = FrameNoise(shots.manifest, ambient)
    frames, kept = prepared.accumulator(), list[Measurement]()
    coefficients: dict[tuple[int, int], FloatArray] = {}
    few = keeps_frames(shots, factors)
    for measurement in shots.pattern_measurements((len(factors.left), len(factors.right))):
        own = frames.add(measurement.frame, measurement.row, measurement.column)
        noise.add(measurement)
        if few:
            kept.append(measurement)
            coefficients[measurement.row, measurement.column] = own
    noise.explained = noise.light_error**2 * float(np.square(prepared.sigma).sum())
    model = Model(prepared, factors.sides, shots.patterns)
    return Accumulation(shots, factors, solver, model, frames, noise, tuple(kept), coefficients, iterative)


def check_factorising(shots: Capture, factors: Factors, solver: Solver) -> None:
    cost = Cost(memory_bytes=BYTES_A_NUMBER * slab_numbers(shots, factors, whole=solver.whole))
    cost.check(f"{shots.name}: factorising its patterns", Limits())
