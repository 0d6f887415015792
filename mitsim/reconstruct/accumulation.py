"""Shots and factors in; the factorised model, sums of all frames and of their noise, and energies beside these, out.

*What factors lack.* A camera whose shadow is no single product, as of waves behind a FlatCam or MURA mask, adds sum_k
L_k (P_ij o X) R_k^T to the frames that Phi_L (P_ij o X) Phi_R^T explains. With G_kl = L_k^T L_l and H_kl = R_l^T R_k
its energy over all patterns is ::

    sum_kl <X, (G_kl o P_L P_L^T) X (H_kl o P_R P_R^T)>

of which |T|^2 lies in the model's range, T = sum_k (sum_i U_Li^T L_k diag(p_i)) X (sum_j U_Rj^T R_k diag(q_j))^T being
what coefficients W take for image.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np

from mitsim.core.arrays import FloatArray, SeparableTerm
from mitsim.core.job import Cost, Limits
from mitsim.core.manifests import Digital, FactorNoise, RunManifest
from mitsim.core.runs import Capture, Measurement
from mitsim.reconstruct.factorisation import Side
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.request import BYTES_A_NUMBER, TIKHONOV, keeps_frames, slab_numbers
from mitsim.reconstruct.solution import Solution
from mitsim.reconstruct.solver import Accumulator, Prepared
from mitsim.reconstruct.solvers import SOLVERS, Solver
from mitsim.reconstruct.subpixel import Model

# ---- Noise of frames ----


class FrameNoise:
    """Noise of all measurements of a run, as its manifest states the sensor.

    Parameters
    ----------
    manifest
        of the run.
    ambient
        (m,) and (m',) mean noise variance by sensor row, and by sensor column, of the ambient frame that was taken off
        every shot [(electrons/s)^2]: one draw, common to all; None without one.

    Attributes
    ----------
    variance
        (K, K') mean noise variance of a datum of each pattern by its own shots [(electrons/s)^2].
    rows, columns
        (K, K', m) and (K, K', m') the same of each sensor row, and of each sensor column.
    light_error
        standard error of single projector pixels' light in simulated frames, 1 is the board's; 0: not stated.
    power, light
        sum of the squares of all shots [(electrons/s)^2], and (m, m') of all shots [electrons/s].
    means
        (K, K') mean light of each pattern's shots [electrons/s].
    shots, saturated, readings
        shots of a pattern; readings at the full well or the ADC's end, and all of them.
    factor
        largest whole number that divides all digital numbers; 1 where they are not whole.
    """

    def __init__(self, manifest: RunManifest, ambient: tuple[FloatArray, FloatArray] | None = None) -> None:
        self._digital = manifest.digital
        self.ambient = ambient
        self.light_error = manifest.light_error or 0.0
        self._sampling, self._systematic = manifest.mc_error or 0.0, _number(manifest.plan, "systematic_error")
        counts = len(manifest.patterns.P_L[0]), len(manifest.patterns.P_R[0])
        self.variance: FloatArray = np.zeros(counts)
        self.means: FloatArray = np.zeros(counts)
        self.rows: FloatArray
        self.columns: FloatArray
        self.rows, self.columns = (np.zeros((*counts, 0)) for _ in range(2))
        self.power, self.shots, self.saturated, self.readings = 0.0, 1, 0, 0
        self.factor = 0
        self.light: FloatArray = np.zeros((0, 0))

    @property
    def stated(self) -> bool:
        """Whether all of the sensor's noise is known; otherwise :attr:`variance` is that of its light alone."""
        return self._digital.noise_is_stated

    @property
    def rendering(self) -> float:
        """Energy of what simulated frames are off by, as they state it: Monte Carlo error and discretisation."""
        return float((self._sampling**2 + self._systematic**2) * self.power)

    @property
    def discretisation(self) -> float:
        """The part of :attr:`rendering` that :attr:`light_error` does not tell; all of it where that is not stated."""
        return float(self._systematic**2 * self.power) if self.light_error else self.rendering

    def of(self, light: FloatArray | float, shots: int) -> FloatArray:
        """Noise variance [(electrons/s)^2] of a measurement, with that of the frame that was taken off it.

        Parameters
        ----------
        light, shots
            sum of its shots [electrons/s], any shape, and their number.
        """
        # The difference of a pair has no ambient frame.
        ambient = float(self.ambient[0].mean()) if self.ambient and shots == 1 else 0.0
        return self._own(light, shots) + ambient

    def add(self, measurement: Measurement) -> None:
        """Count in one ``measurement``."""
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
        self.factor = math.gcd(self.factor, measurement.factor)
        self.saturated += measurement.saturated
        self.readings += shots * measurement.frame.size

    def _own(self, light: FloatArray | float, shots: int) -> FloatArray:
        return np.maximum(self._digital.variance(light, shots), 0.0)


def _number(plan: dict[str, Any] | None, name: str) -> float:
    """A number of a ``plan``, which is others' and may say anything; 0 without it."""
    value = (plan or {}).get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        return 0.0
    return float(value)


# ---- Energies beside the image: noise of factors, and separable terms that they lack ----


def factor_energy(
    prepared: Prepared, patterns: tuple[FloatArray, FloatArray], noise: FactorNoise, image: FloatArray
) -> float:
    """Energy that noisy factors add to all frames of an image, less what the fit takes up.

    Frames move by d_L (P_ij o X) Phi_R^T with d_L the error of Phi_L, independent numbers of variance s^2: in the mean
    by m s^2 sum_ij ||(P_ij o X) Phi_R^T||^2 = m s^2 sum_p |P_L[p]|^2 ||X[p] V_R S_R||^2; and by the same of the other
    side.

    Parameters
    ----------
    prepared, patterns
        the factorised model, and P_L (n, K) and P_R (n', K').
    noise
        of its factors.
    image
        (n, n').
    """
    left, right = prepared.left, prepared.right
    total = 0.0
    sides = (left, right, patterns[0], noise.left, image), (right, left, patterns[1], noise.right, image.T)
    for own, other, lit, deviation, seen in sides:
        spread = np.square(seen @ other.response).sum(axis=1)
        spare = 1 - own.rank / own.data_rows
        total += own.sensor_size * deviation**2 * spare * float(np.square(lit).sum(axis=1) @ spread)
    return total


@dataclass(frozen=True, eq=False)
class Lack:
    """What ``terms`` beside a ``model``'s factors, centred as these are, do to its ``image`` (n, n'); one or more."""

    model: Model
    terms: tuple[SeparableTerm, ...]
    image: FloatArray

    @property
    def energy(self) -> float:
        """Energy that they put into all frames outside of the model's range."""
        left, right = (lit @ lit.T for lit in self.model.patterns)
        total = 0.0
        for a, b in self.terms:
            for c, d in self.terms:
                total += float(np.vdot(self.image, ((a.T @ c) * left) @ self.image @ ((d.T @ b) * right)))
        return max(total - float(np.square(self.struck).sum()), 0.0)

    @cached_property
    def struck(self) -> FloatArray:
        """(r, r') what they add to the coefficients W of all frames."""
        sides, patterns = self.model.sides, self.model.patterns
        return np.asarray(
            sum(
                _term_response(sides[0], a, patterns[0]) @ self.image @ _term_response(sides[1], b, patterns[1]).T
                for a, b in self.terms
            )
        )


def _term_response(side: Side, term: FloatArray, patterns: FloatArray) -> FloatArray:
    """(r, n) sum_i U_i^T L diag(p_i), of one side of a ``term`` L (m, n) and its ``patterns`` (n, K)."""
    seen = np.zeros((len(side.singular), term.shape[1]))
    for slab, lit in zip(side.slabs, patterns.T, strict=True):
        seen[slab.columns] += (slab.matrix.T @ term) * lit
    return seen


# ---- Frames added up ----


@dataclass(frozen=True, eq=False)
class Accumulation:
    """A run's frames added up.

    Attributes
    ----------
    shots, factors, solver
        of which, and for what image.
    model
        that the frames are of, factorised.
    frames, noise
        sums of all frames, and of their noise.
    kept
        the frames themselves while they are few; all or none.
    coefficients
        by pattern, what its frame adds to W (c, c'), while the frames are kept.
    iterative
        what the method is told besides (:attr:`mitsim.reconstruct.request.ImageRequest.iterative`).
    """

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
        """The factorised model."""
        return self.model.prepared

    @property
    def digital(self) -> Digital:
        """How numbers of the frames were read."""
        return self.shots.manifest.digital

    @property
    def weights(self) -> FloatArray:
        """(r, r') W of all frames."""
        problem = self.prepared.problem(self.frames)
        return np.where(problem.sigma > 0, problem.projected, 0.0)

    def measurements_again(self) -> Iterable[Measurement]:
        """All measurements once more: those that are kept, or reads them."""
        return self.kept or self.shots.pattern_measurements()

    def solution(self, lam: float | Literal["auto"]) -> Solution:
        """Their image at ``lam``."""
        return self.solver.compute(self.prepared, self.frames, lam, **self.iterative)

    def lack(self, image: FloatArray) -> Lack | None:
        """What the factors are known to lack of the camera, of an ``image`` (n, n'); None where nothing is known."""
        return Lack(self.model, self.factors.lacking, image) if self.factors.lacking else None

    def factor_energy(self, image: FloatArray) -> float | None:
        """What the factors' noise adds to all frames of an ``image`` (n, n'); None where it is not stated."""
        stated = self.factors.manifest.noise
        return factor_energy(self.prepared, self.shots.patterns, stated, image) if stated else None


def accumulate(shots: Capture, factors: Factors, solver: Solver = SOLVERS[TIKHONOV], **iterative: Any) -> Accumulation:
    """The model of shots and factors factorised, and every frame added.

    Parameters
    ----------
    shots, factors
        that fit each other.
    solver, **iterative
        of the image that they are for, as in :class:`Accumulation`.

    Raises
    ------
    MitsimError
        when that takes more memory than is free, or a frame cannot be read.
    """
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
    model = Model(prepared, factors.sides, shots.patterns)
    return Accumulation(shots, factors, solver, model, frames, noise, tuple(kept), coefficients, iterative)


def check_factorising(shots: Capture, factors: Factors, solver: Solver) -> None:
    """MitsimError where factorising the model takes more memory than is free.

    Parameters
    ----------
    shots, factors
        the patterns, and the camera.
    solver
        that the model is for.
    """
    cost = Cost(memory_bytes=BYTES_A_NUMBER * slab_numbers(shots, factors, whole=solver.whole))
    cost.check(f"{shots.name}: factorising its patterns", Limits())
