"""Measurements in, how far noise and rendering may have moved them out: mean variance by pattern, and by source."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.manifests import FactorNoise, RunManifest
from mitsim.core.runs import Measurement
from mitsim.reconstruct.solver import Prepared


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


def _number(plan: dict[str, Any] | None, name: str) -> float:
    """A number of a ``plan``, which is others' and may say anything; 0 without it."""
    value = (plan or {}).get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        return 0.0
    return float(value)
