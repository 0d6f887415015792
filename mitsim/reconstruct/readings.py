"""Other readings of a run's frames: turned frames, shots in another order, numbers with a tone curve, and lag.

Each reading is fitted by the same factorised model, on a part of the sensor that is large enough to decide. Its misfit
is the energy of numbers that the model leaves, in the numbers as they were read: for light g(y) of numbers y, the model
H g(y) is mapped back by the inverse of g. All misfits are therefore compared with the same noise.

A reading is offered if it explains nearly all that the frames as they are leave unexplained. All readings that fit as
well as the best one within noise are offered, because a symmetric camera cannot decide between them: with equal masks
on both sides, transposed frames and shots of a loop over columns leave the same misfit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.optimize import minimize_scalar

from mitsim.core.arrays import FloatArray, sum_of_squares
from mitsim.devices.patterns import shot_orders
from mitsim.reconstruct.accumulation import Accumulation
from mitsim.reconstruct.factorisation import IndexArray, group_pixels
from mitsim.reconstruct.residuals import CHANCE, TINY
from mitsim.reconstruct.solver import Prepared, prepare

_FITS, _AT_MOST = 0.05, 2e-2
"""Part of the unexplained energy, and of the measurements, rms, that a reading may leave."""
_ALIKE, _ROWS = 0.02, 4.0
"""Relative difference of misfits up to which two readings fit alike; and sensor rows for each scene row, at least, of
the part of the sensor that decides."""
_EXPONENTS, _LAGS, _LINEAR, _NO_LAG = (0.3, 3.0), (0.0, 0.5), 0.05, 2e-3
"""Ranges of the tone curve's exponent, and of the part of a frame that is left of the one before; and difference of an
exponent's logarithm from zero, and lag, that are no readings of their own."""
_LAMBDA, _NEGATIVE = 1e-3, 0.5
"""Lambda, over the largest sigma^2, of the image whose mean is looked at; and the part of its largest mean by which an
image is negative: noise of no picture that shows anything is as large."""
_MULTIPLIED, _LEAST_MULTIPLIED = 0.15, 1.5
"""Chi-square of multiplied numbers over their factor, and at least: their shot noise is that many times too large, and
0.3 of it if the black level was multiplied, too."""

_TURNS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "as they are": lambda frame: frame,
    "upside down, their rows reversed": lambda frame: frame[::-1],
    "mirrored, their columns reversed": lambda frame: frame[:, ::-1],
    "turned by 180 degrees": lambda frame: frame[::-1, ::-1],
    "transposed, their rows and columns exchanged": lambda frame: frame.T,
    "turned by 90 degrees counter-clockwise": lambda frame: np.rot90(frame, -1),
    "turned by 90 degrees clockwise": lambda frame: np.rot90(frame),
    "transposed about the other diagonal": lambda frame: frame[::-1, ::-1].T,
}
"""States of frames, and the turns that bring them back."""
_KEPT, _TAKEN = "as they are", ""
_STEPS = {
    "late": "the frames are one step late: each shot shows the pattern of the shot before",
    "early": "the frames are one step early: each shot shows the pattern of the next",
}


@dataclass(frozen=True)
class Reading:
    """A reading of the data that restores the fit, and the part of the measurements, rms, that it ``left``.

    ``order`` is an argument of `mitsim import --order`.
    """

    words: str
    left: float = 0.0
    order: str | None = None

    def summary(self) -> dict[str, object]:
        """Return the entry of result.json."""
        return {"words": self.words, "order": self.order, "unexplained": self.left}


def multiple(factor: int, chi_square: float) -> Reading | None:
    """Return the reading of numbers that were multiplied by a ``factor``, if the ``chi_square`` shows it."""
    if factor < 2 or not chi_square > max(_MULTIPLIED * factor, _LEAST_MULTIPLIED):
        return None
    bits = "" if factor & (factor - 1) else f", as of fewer bits that were moved up by {factor.bit_length() - 1}"
    return Reading(f"the numbers are divided by {factor}, because all of them are multiples of {factor}{bits}")


def pixel_groups(patterns: tuple[FloatArray, FloatArray]) -> list[list[IndexArray]]:
    """Return the scene rows and the scene columns that are lit alike, group by group, of ``patterns`` P_L and P_R."""
    return [[group.pixels for group in group_pixels(side)] for side in patterns]


def negative(prepared: Prepared, groups: list[list[IndexArray]], weights: FloatArray) -> bool:
    """Return True if pixels that are lit alike have a negative reflectance in the mean, where noise is averaged.

    Parameters
    ----------
    prepared, weights
        the model, and W (r, r') of all frames.
    groups
        of :func:`pixel_groups`.
    """
    sigma = prepared.sigma
    image = prepared.image(weights * sigma / (np.square(sigma) + _LAMBDA * float(sigma.max()) ** 2 + TINY))
    means = np.array([[image[np.ix_(rows, columns)].mean() for columns in groups[1]] for rows in groups[0]])
    return bool(means.min() < -_NEGATIVE * np.abs(means).max())


def find_readings(data: Accumulation, ratio: float, beside: float) -> tuple[Reading, ...]:
    """Return the readings that restore the fit of a run, the best first; empty if none does.

    Parameters
    ----------
    data
        the run.
    ratio
        measured over stated variance of the noise.
    beside
        energy of all measurements that rendering, calibration and print add.
    """
    run = _Part(data)
    if run.prepared.spare <= 0:
        return ()
    noise = ratio * float(data.noise.variance.sum()) * run.size * run.prepared.spare
    whole = max(run.energy, TINY)
    allowed = noise + beside * run.energy / max(float(data.frames.energy), TINY)
    chance = CHANCE * noise * float(np.sqrt(2 / max(run.size * data.noise.variance.size * run.prepared.spare, 1)))
    now = run.misfit(run.shots())  # infinite if the image is negative
    unexplained = min(max(now - allowed, 0.0), whole)
    if unexplained <= chance / 2:
        return ()
    limit = allowed + max(min(_FITS * unexplained, _AT_MOST**2 * whole), min(chance, unexplained / 2))
    turns, orders = ([(turn, _TAKEN) for turn in run.turns], [(_KEPT, order) for order in run.orders])
    stages = map(run.moved, turns + orders), map(run.moved, product(run.turns, run.orders)), run.curves()
    good: list[Reading] = []
    for stage in stages:
        good = good or sorted((each for each in stage if each.left < limit), key=lambda each: each.left)
    alike = [each for each in good if each.left <= good[0].left * (1 + _ALIKE) + chance]
    return tuple(replace(each, left=float(np.sqrt(max(each.left - allowed, 0.0) / whole))) for each in alike)


class _Part:
    """A run's shots on a part of the sensor, with the model of this part."""

    def __init__(self, data: Accumulation) -> None:
        manifest = data.shots.manifest
        sides, patterns = (data.factors.left, data.factors.right), data.shots.patterns
        steps = [max(int(len(side) / (_ROWS * side.shape[1])), 1) for side in sides]
        self._part = tuple(slice(None, None, step) for step in steps)
        left, right = (np.asarray(side)[part] for side, part in zip(sides, self._part, strict=True))
        self.prepared: Prepared = prepare(left, right, *patterns, centre=data.prepared.centre)
        self._groups, self._captures = pixel_groups(patterns), manifest.patterns.captures
        self._signed, self._dark = data.noise.shots == 2, data.digital.dark_current_e_per_s
        number = {(shot.row, shot.column, shot.sign): index for index, shot in enumerate(self._captures)}
        self._frames: list[FloatArray] = [np.zeros(())] * len(number)
        for each in data.measurements_again():
            for sign in (1, -1) if self._signed else (0,):
                light = (each.light + sign * each.frame) / 2 if sign else each.frame
                self._frames[number[each.row, each.column, sign]] = light.astype(np.float32)
        shape, taken = self._frames[0].shape, np.arange(len(number))
        self.turns = [name for name, turn in _TURNS.items() if turn(np.zeros(shape, bool)).shape == shape][1:]
        self._orders = {_TAKEN: taken, **shot_orders(manifest.patterns, manifest.order)}
        self._orders |= {"late": np.roll(taken, -1), "early": np.roll(taken, 1)}
        distinct = {tuple(order): name for name, order in reversed(self._orders.items())}
        self.orders = [name for name in distinct.values() if name != _TAKEN]
        self.size = len(left) * len(right)
        self.energy = self._weights(self.shots())[1]

    def moved(self, change: tuple[str, str]) -> Reading:
        """Return the reading of a turn of the frames and an order of the shots, with the energy that it leaves."""
        turn, order = change
        parts = [] if turn == _KEPT else [f"the frames are {turn}"]
        parts += [] if order == _TAKEN else [_STEPS.get(order, f"the shots were taken in the order {order}")]
        known = None if order == _TAKEN or order in _STEPS else order
        return Reading(" and ".join(parts), self.misfit(self.shots(turn, order)), known)

    def curves(self) -> Iterator[Reading]:
        """Yield the best tone curve and the best lag, each with the energy that it leaves."""
        shots = self.shots()

        def misfit_of_lag(part: float) -> float:
            earlier = [np.zeros_like(shots[0]), *shots[:-1]]
            now = [(own - part * before) / (1 - part) for own, before in zip(shots, earlier, strict=True)]
            return min(self.misfit(now), self.energy) * (1 - part) ** 2  # the search needs finite numbers

        if not self.prepared.centre:  # without means of rows and columns, no number is known
            best = minimize_scalar(self._bent_misfit, bounds=np.log(_EXPONENTS), args=(shots,), method="bounded")
            words = f"the numbers went through a tone curve: they are the light to the power of {np.exp(-best.x):.2g}"
            if abs(best.x) > _LINEAR:
                yield Reading(words, float(best.fun))
        if not self._signed:
            best = minimize_scalar(misfit_of_lag, bounds=_LAGS, method="bounded")
            if best.x > _NO_LAG:
                yield Reading(f"the sensor lags: each frame holds {best.x:.1%} of the frame before", float(best.fun))

    def shots(self, turn: str = _KEPT, order: str = _TAKEN) -> list[FloatArray]:
        """Return this part of all shots, their frames brought back by a ``turn`` and taken in another ``order``."""
        frames = (_TURNS[turn](self._frames[index])[self._part] for index in self._orders[order])
        return [np.ascontiguousarray(frame, dtype=np.float64) for frame in frames]

    def misfit(self, shots: Sequence[FloatArray]) -> float:
        """Return the energy that the model leaves of ``shots``; infinite where the image is negative in the mean."""
        weights, energy = self._weights(shots)
        return float("inf") if negative(self.prepared, self._groups, weights) else energy - sum_of_squares(weights)

    def _weights(self, shots: Sequence[FloatArray]) -> tuple[FloatArray, float]:
        """Return W (r, r') of all measurements, and their energy; of a signed pattern, of the halves' difference."""
        weights, energy = np.zeros_like(self.prepared.sigma), 0.0
        frames: dict[tuple[int, int], FloatArray] = {}
        for capture, light in zip(self._captures, shots, strict=True):
            pattern = capture.row, capture.column
            frames[pattern] = frames.get(pattern, 0.0) + (capture.sign or 1) * light
        for pattern, frame in frames.items():
            seen = self.prepared.as_solved(frame)
            weights[self.prepared.places(pattern)] += self.prepared.weights(seen, pattern)
            energy += sum_of_squares(seen)
        return np.where(self.prepared.sigma > 0, weights, 0.0), energy

    def _bent_misfit(self, logarithm: float, shots: Sequence[FloatArray]) -> float:
        """Return the misfit, in numbers as they were read, of light that is a power of them, exp(``logarithm``)."""
        exponent, spare = float(np.exp(logarithm)), self.prepared.spare
        top = max(float(shot.max()) for shot in shots) + self._dark or 1.0

        def bend(values: FloatArray, power: float) -> FloatArray:
            return np.asarray(np.sign(values) * np.abs(values) ** power)

        even = bend(np.array(self._dark / top), exponent)
        linear = [bend((shot + self._dark) / top, exponent) - even for shot in shots]
        weights, _ = self._weights(linear)
        # The halves of a pair are known by their sum, which is the same for all pairs.
        mean, total = 2 * np.mean(linear, axis=0), 0.0
        for capture, shot in zip(self._captures, shots, strict=True):
            model = self.prepared.frame(weights, (capture.row, capture.column))
            model = (mean + capture.sign * model) / 2 if self._signed else model
            total += sum_of_squares(shot + self._dark - top * bend(model + even, 1 / exponent))
        return total * 2 * spare / (1 + spare) if self._signed else total
