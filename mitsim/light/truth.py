"""Apparent reflectance, the image that a perfect reconstruction shows, with its standard error.

It is each projector pixel's flux of direct light toward the sensor over that of the calibration board, with its own
random streams, so that an error of the frames is never an error of the truth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.board import before_board
from mitsim.bench.effects import Physics, names
from mitsim.core.arrays import FloatArray, mean_of_neighbours
from mitsim.core.seeds import integer
from mitsim.devices.session import load_recipe
from mitsim.light.cost_model import BOARD_SAMPLES, MOST_RAYS, MOST_SAMPLES, TRUTH_GROUPS, TRUTH_PART, TRUTH_SAMPLES
from mitsim.light.settings import Settings
from mitsim.transport.direct import FluxTracer, IntArray

_FINEST = 1e-4
_BOARD_PART = 0.5
_RATE = 2.0
"""Power of the samples with which a pixel's variance falls: 1 random, 2 about an edge, 3 over smooth light."""
_ANYWHERE = 0.01
_AIM = 0.98
_DOUBLINGS, _AT_ONCE = 8, 4


@dataclass(frozen=True, eq=False)
class Truth:
    reflectance: FloatArray
    standard_error: FloatArray
    board_flux: FloatArray
    rays: int

    @property
    def error(self) -> float:
        return float(np.sqrt(np.square(self.standard_error).mean()))

    def error_of(self, flux_error: FloatArray) -> float:
        """Return the rms error that sampling leaves in any image, from the frames' ``flux_error`` (n^2,)."""
        return float(_rms(_over(flux_error, self.board_flux)))


def trace_truth(bench: Apparatus, settings: Settings, seed: int, flux_error: FloatArray) -> Truth:
    """Trace until the truth's standard error, rms over the image, is a sixth of the frames', or 1e-4.

    ``flux_error`` (n^2,) is the standard error of each projector pixel's direct light in the frames [W m^-2].
    """
    (truth,) = trace_truths(bench, settings, seed, flux_error[None])
    return truth


def trace_truths(bench: Apparatus, settings: Settings, seed: int, flux_errors: FloatArray) -> list[Truth]:
    effects = names(lambda effect: effect.in_truth) & settings.effects
    board = _Flux(before_board(bench, load_recipe().board_reflectance), effects, seed, "board", BOARD_SAMPLES)
    unit = board.mean
    target = np.maximum(TRUTH_PART * _rms(_over(flux_errors, unit)), _FINEST)
    board.refine(unit, _BOARD_PART * target, np.ones(unit.shape[1]))
    scene = _Flux(bench, effects, seed, "scene", TRUTH_SAMPLES)
    likely = np.square(_over(flux_errors, unit)).sum(axis=0)
    scene.refine(unit, float(np.sqrt(1 - _BOARD_PART**2)) * target, likely)
    reflectance = _over(scene.mean, board.mean)
    error = np.hypot(_over(scene.standard_error, board.mean), reflectance * _over(board.standard_error, board.mean))
    shape, rays = (bench.n, bench.n), scene.rays + board.rays
    lines = zip(reflectance, error, board.mean, strict=True)
    return [Truth(own.reshape(shape), its.reshape(shape), flux, rays) for own, its, flux in lines]


class _Flux:
    def __init__(self, bench: Apparatus, effects: frozenset[str], seed: int, name: str, samples: int) -> None:
        physics, loaded, pixels = Physics.with_effects(bench, effects), bench.loaded, bench.n**2
        setup = replace(bench.setup, projector=physics.projector, geometry=physics.geometry)
        self._tracer = FluxTracer(setup, loaded.glossy)
        self._seed = integer(seed, "truth", name)
        lines = len(bench.lines.shares) if physics.projector.by_line and bench.lines else 1
        self._sums, self._samples = np.zeros((lines, TRUTH_GROUPS, pixels)), np.zeros(pixels, np.int64)
        self._shape, self._first = (bench.n, bench.n), samples
        self._sample(np.full(pixels, samples))

    @property
    def rays(self) -> int:
        return int(TRUTH_GROUPS * self._samples.sum())

    @property
    def mean(self) -> FloatArray:
        return np.asarray(self._sums.mean(axis=1) / self._samples)

    @property
    def standard_error(self) -> FloatArray:
        return np.asarray(self._sums.std(axis=1, ddof=1) / self._samples / np.sqrt(TRUTH_GROUPS))

    def refine(self, unit: FloatArray, target: FloatArray, likely: FloatArray) -> None:
        """Trace more where that reduces the error most, until every line meets its target or needs too many rays.

        ``likely`` (n^2,) has variances from other knowledge, because a pixel whose samples happen to agree would get no
        more.
        """
        # An edge goes on in the next pixel, where all samples so far may have missed it.
        likely = likely + mean_of_neighbours(likely.reshape(self._shape)).ravel()
        likely += _ANYWHERE * likely.mean() or 1.0
        most = max(MOST_RAYS, MOST_SAMPLES * len(unit)) // TRUTH_GROUPS
        while ((error := _rms(_over(self.standard_error, unit))) > target).any():
            part = float(np.square(_AIM * target / np.maximum(error, np.finfo(float).tiny)).min())
            wanted = _allot(likely, self._samples, self._first, part, most)
            if (wanted == self._samples).all():
                return
            self._sample(wanted)

    def _sample(self, wanted: IntArray) -> None:
        pixels = np.flatnonzero(wanted > self._samples)
        done, more = self._samples[pixels], (wanted - self._samples)[pixels]
        block = int(np.gcd.reduce(more))
        blocks = more // block
        place = np.repeat(np.arange(len(pixels)), blocks)
        within = np.arange(len(place)) - np.repeat(np.cumsum(blocks) - blocks, blocks)
        starts = done[place] + block * within
        light = self._tracer.sums(self._seed, TRUTH_GROUPS, pixels[place], starts, block)
        for groups, parts in zip(self._sums, light, strict=True):
            for sums, part in zip(groups, parts, strict=True):
                sums += np.bincount(pixels[place], part, len(sums))
        self._samples = wanted


def _allot(likely: FloatArray, samples: IntArray, first: int, part: float, most: int) -> IntArray:
    doublings = np.arange(_DOUBLINGS)
    left = (likely * (samples / first) ** -_RATE)[:, None] * 2.0 ** (-_RATE * doublings)
    gain, cost = (1 - 2.0**-_RATE) * left, samples[:, None] * 2.0**doublings
    best = np.argsort(-(gain / cost), axis=None, kind="stable")
    enough = int(np.searchsorted(np.cumsum(gain.ravel()[best]), (1 - part) * left[:, 0].sum())) + 1
    accuracy_for_time = int(np.searchsorted(np.cumsum(cost.ravel()[best]), most - samples.sum(), side="right"))
    made = np.bincount(best[: min(enough, accuracy_for_time)] // _DOUBLINGS, minlength=len(likely))
    return np.asarray(samples << np.minimum(made, _AT_ONCE))


def _over(flux: FloatArray, unit: FloatArray) -> FloatArray:
    return np.divide(flux, unit, out=np.zeros_like(flux), where=unit > 0)


def _rms(values: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.square(values).mean(axis=-1)))
