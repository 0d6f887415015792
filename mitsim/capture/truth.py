"""What a perfect image would show: from a bench and how well frames know its light to apparent reflectance and error.

Apparent reflectance is each projector pixel's flux of direct light toward the sensor over that of the calibration
board. Both fluxes have random streams of their own, so an error of the frames is never one of the truth as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter

from mitsim.capture.bench import Bench
from mitsim.capture.effects import Physics, names
from mitsim.capture.evidence import GROUPS, LANES_AT_ONCE, Settings
from mitsim.capture.prices import BOARD_SAMPLES, MOST_RAYS, MOST_SAMPLES, TRUTH_PART, TRUTH_SAMPLES
from mitsim.core.arrays import FloatArray
from mitsim.core.seeds import integer
from mitsim.rig.recipe import load_recipe
from mitsim.transport.flux import FluxTracer

_FINEST = 1e-4
"""Standard error below which the truth is not refined: 80 dB, where no image of a sensor with a full well comes."""
_BOARD_PART = 0.5
"""Of the truth's error, what the board may bring: a quarter of its square, for a surface that converges quickly."""
_GAIN = 0.75
"""Part of its variance that a pixel loses when its samples are doubled: 0.5 of random points, 0.87 of stratified ones
over smooth light. Too high a guess costs another round, too low a one some rays."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Apparent reflectance of every projector pixel, 1 = the calibration board.

    Attributes
    ----------
    reflectance, standard_error
        (n, n) and what sampling may have moved it by.
    board_flux
        (n^2,) direct light of each projector pixel on the sensor, over the board [W m^-2].
    rays
        that were traced for both fluxes.
    """

    reflectance: FloatArray
    standard_error: FloatArray
    board_flux: FloatArray
    rays: int

    @property
    def error(self) -> float:
        """Standard error, root mean square over the image."""
        return float(np.sqrt(np.square(self.standard_error).mean()))

    def error_of(self, flux_error: FloatArray) -> float:
        """What sampling leaves in any image, rms over it: the standard error ``flux_error`` (n^2,) [W m^-2] of the
        frames' own light, over the board's."""
        return _rms(_over(flux_error, self.board_flux))


def trace_truth(bench: Bench, settings: Settings, seed: int, flux_error: FloatArray) -> Truth:
    """Trace until the truth's standard error, rms over the image, is a sixth of the frames', or 1e-4.

    Parameters
    ----------
    bench, settings
        the scene, and what of lens and pixels is simulated.
    seed
        root of the random streams.
    flux_error
        (n^2,) standard error of each projector pixel's direct light in the frames [W m^-2]: what sampling alone leaves
        in any image of them.
    """
    effects = names(lambda effect: effect.in_truth) & settings.effects
    board = _Flux(bench.with_board(load_recipe().board_reflectance), effects, seed, "board", BOARD_SAMPLES)
    unit = board.mean
    target = max(TRUTH_PART * _rms(_over(flux_error, unit)), _FINEST)
    board.refine(unit, _BOARD_PART * target)
    scene = _Flux(bench, effects, seed, "scene", TRUTH_SAMPLES)
    scene.refine(unit, float(np.sqrt(1 - _BOARD_PART**2)) * target)
    reflectance = _over(scene.mean, board.mean)
    error = np.hypot(_over(scene.standard_error, board.mean), reflectance * _over(board.standard_error, board.mean))
    shape = (bench.n, bench.n)
    return Truth(reflectance.reshape(shape), error.reshape(shape), board.mean, scene.rays + board.rays)


class _Flux:
    """Direct light of every projector pixel on the sensor, in independent groups; sampled where that helps most."""

    def __init__(self, bench: Bench, effects: frozenset[str], seed: int, name: str, samples: int) -> None:
        physics, loaded, pixels = Physics.simulated(bench, effects), bench.loaded, bench.n**2
        self._tracer = FluxTracer(loaded.scene, loaded.camera, physics.projector, physics.geometry, loaded.glossy)
        self._seeds = [integer(seed, "truth", name, group) for group in range(GROUPS)]
        self._sums, self._samples = np.zeros((GROUPS, pixels)), np.zeros(pixels)
        self._shape, self.rays = (bench.n, bench.n), 0
        self._sample(np.arange(pixels), 0, samples)

    @property
    def mean(self) -> FloatArray:
        """(n^2,) [W m^-2]."""
        return np.asarray(self._sums.mean(axis=0) / self._samples)

    @property
    def standard_error(self) -> FloatArray:
        """(n^2,) of the mean, from the spread of the groups [W m^-2]."""
        return np.asarray(self._sums.std(axis=0, ddof=1) / self._samples / np.sqrt(GROUPS))

    def refine(self, unit: FloatArray, target: float) -> None:
        """Double the samples of the pixels where that brings most, until the standard error in units ``unit`` (n^2,),
        rms over the image, meets the ``target``, or too many rays would be needed."""
        while True:
            variance = np.square(_over(self.standard_error, unit))
            excess = variance.sum() - target**2 * len(variance)
            if excess <= 0:
                return
            # An edge goes on in the next pixel, where all samples so far may have missed it.
            likely = variance + uniform_filter(variance.reshape(self._shape), 3, mode="nearest").ravel()
            by_gain = np.argsort(-likely / self._samples, kind="stable")
            enough = int(np.searchsorted(_GAIN * np.cumsum(variance[by_gain]), excess)) + 1
            pixels = np.sort(by_gain[:enough])
            most = max(MOST_RAYS, MOST_SAMPLES * len(variance))
            if self.rays + GROUPS * self._samples[pixels].sum() > most:
                return
            for done in np.unique(self._samples[pixels]).astype(int):
                self._sample(pixels[self._samples[pixels] == done], done, done)

    def _sample(self, pixels: np.ndarray[tuple[int], np.dtype[np.int64]], first: int, samples: int) -> None:
        tracer, at_once = self._tracer.at(pixels), max(1, LANES_AT_ONCE // len(pixels))
        for sums, seed in zip(self._sums, self._seeds, strict=True):
            for start in range(first, first + samples, at_once):
                sums[pixels] += tracer.sums(seed, start, min(at_once, first + samples - start))
        self._samples[pixels] += samples
        self.rays += GROUPS * samples * len(pixels)


def _over(flux: FloatArray, unit: FloatArray) -> FloatArray:
    """``flux`` (n^2,) in units ``unit`` (n^2,); 0 where there is no unit, as the board has no light there."""
    return np.divide(flux, unit, out=np.zeros_like(flux), where=unit > 0)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.square(values).mean()))
