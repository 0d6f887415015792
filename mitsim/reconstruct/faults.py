"""Measurements, the factorised model and its fit in; out come frames that are not what they say, by number and fault.

Each frame is foretold from the others. Where patterns overlap the model does it: a pattern is left out of the sums W,
and its own part is put in again as the rest tells it, until that stands still. Under shifting dots no pixel is in two
frames, so that any frame fits itself; but dots:k are k^2 samples of one light, and a frame's brightness follows from
its pixels' neighbours. The halves of signed patterns add up to the same frame for all of them, which foretells each
half by the other without any model.

A frame is suspected where it is off by more than noise, and by more than the other frames are: a scene that does not
fit has all its frames off. It is named where one fault explains what it is off by.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import fft
from scipy.ndimage import uniform_filter
from scipy.optimize import minimize_scalar

from mitsim.core.arrays import FloatArray
from mitsim.core.manifests import RunManifest
from mitsim.core.measurement import Measurement
from mitsim.reconstruct.accumulator import centred
from mitsim.reconstruct.noise import FrameNoise
from mitsim.reconstruct.sides import group_pixels
from mitsim.reconstruct.solver import Prepared

Pattern = tuple[int, int]
BoolArray = npt.NDArray[np.bool_]

CHANCE = 6.0
"""Standard deviations of a frame's noise energy that are left to chance: 1e-9 for each of up to 65536 shots."""
_OFF = 7e-3
"""Part of a frame, rms, by which it may be off: twice what all measurements together may, as print is not averaged."""
_MORE = 4.0
"""Times the median frame's unexplained energy from which a frame is suspected: chosen, as one that is wrong puts part
of its energy into the others where patterns overlap."""
_EXPLAINS = 0.2
"""Part of what a frame is off by that a fault may leave: chosen, with room for what the others foretell badly."""
_MOST_BAD = 0.25
"""Of all patterns: above it the run is another than it says, and no single frames are at fault."""
_HINT, _FURTHER, _TRIED = 2.5, 4.0, 3
"""In place of :data:`CHANCE` where all frames together are off by half of that, and once one frame is suspected: only
what a fault then explains is named; and the most frames of which it is tried which one puts the others off."""
_LIKELY, _LEFT = 60.0, 3.0
"""Variances of a datum that a fault must explain, twice the logarithm of a likelihood ratio of 1e13: some of them are
searched for among 10^4; and the standard deviations of noise that it may leave."""
_SETTLED, _MOST_STEPS = 0.1, 100
"""Of :data:`CHANCE`, the energy below which a step of foretelling changes nothing that counts; and the most steps,
which patterns that know nothing of each other do not need: chosen."""
_STEPS = 12
"""Rounds in which patterns left out are foretold from the rest: each brings what overlapping patterns know to a half or
less of its distance."""
_SCALE_SPREADS, _SCALE_LEAST, _SCALE_OTHERS = 4.0, 0.08, 2.0
"""Standard deviations, as half of the frames tell them, by which a frame's brightness may differ from what its
neighbours foretell, the least such part that is named, and times what any other frame differs by: chosen, of 49 normal
numbers one is as far away once in 20 000 runs."""
_FEW = 2.5
"""The least part times the number of frames: half of so few frames do not tell a spread."""
_BRIGHT_ENOUGH = 0.2
"""Of the mean foretold reflectance, from which a pixel counts when it is compared with its neighbours."""
_MOST_PAIRS = 6
"""Pairs of which it is tried which half is wrong: 64 images."""
_FEWEST_PIXELS = 8
"""Pixels of a frame that its neighbours foretell, below which their median is chance."""
_DARK = 0.1
"""Of the light that is foretold, below which a frame or a row of it is black."""
_LEAST_LOST = 0.02
"""Part of a frame's rows, or columns, that are lost before it is said; a dead line is less."""
_NEGATIVE = 0.5
"""Mean reflectance of pixels that are lit alike, over the largest such mean, below which less the image is negative:
chosen, no noise of a picture that shows anything is as large."""
_ODD = 0.1
"""Of the light of a signed pair, by which that of another pair differs that is none: half of it or more."""
STEPS = (
    "one step late: each shot shows the pattern of the shot before",
    "one step early: each shot shows the pattern of the next",
)
"""Ways in which shots are a step beside their patterns."""
_REACH = 24
"""Sensor pixels that frames are moved by in search of a shift."""
_ROUNDING = 1e-20
"""Of a frame's energy, by which the halves of two pairs differ that were the same numbers."""
_QUIET, _AVERAGED = 0.5, 0.01
"""Part of the sensor's noise, without rounding, that frames may have at least: half where numbers are digital, stated
gains are that wrong; where they are not, means of up to 100 shots may have been given."""


class Fault(Enum):
    """What may be wrong with frames; the value is what is said of them."""

    BLACK = "black"
    DIM = "dim"
    BRIGHT = "too bright"
    REPEATED = "a repeat of another"
    SWAPPED = "exchanged"
    MISPLACED = "of another pattern"
    HALF_LOST = "partly lost"
    SHIFTED = "shifted"
    CLIPPED = "clipped"
    NOISELESS = "free of noise"


@dataclass(frozen=True)
class FrameFault:
    """A ``fault`` of the shots of some ``numbers``, in ``files``, from 0 in the manifest's order; ``words`` say it."""

    fault: Fault
    numbers: tuple[int, ...]
    files: tuple[str, ...]
    words: str

    def __str__(self) -> str:
        return self.words

    def summary(self) -> dict[str, Any]:
        """For result.json."""
        return {
            "fault": self.fault.name.lower(),
            "frames": list(self.numbers),
            "files": list(self.files),
            "words": self.words,
        }


@dataclass(eq=False)
class FrameSums:
    """Energies by pattern, (K, K') each, gathered as measurements are held against a model.

    ``residual``, ``power``, ``energy``: what is left of a pattern's measurement, sum of the squares of its shots, and
    of the measurement as the solver takes it. ``sums``: of signed
    patterns, energy by which the halves' sum differs from that of all others. ``halves``: light of a signed pattern's
    shots. ``digests``: patterns, and which of their shots, by a number that frames which are one and the same share.
    ``clipped``: of the shots that are, readings at their largest number.
    """

    counts: tuple[int, int]
    residual: FloatArray = field(init=False)
    power: FloatArray = field(init=False)
    energy: FloatArray = field(init=False)
    sums: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self.residual, self.power, self.energy = (np.zeros(self.counts) for _ in range(3))
        self.sums = np.zeros(self.counts)
        self.digests: dict[int, list[tuple[Pattern, int]]] = {}
        self.clipped: dict[tuple[Pattern, int], int] = {}
        self.halves: dict[Pattern, tuple[float, float]] = {}

    def add(self, measurement: Measurement, residual: float, power: float, energy: float, total: FloatArray) -> None:
        """Count in one measurement.

        Parameters
        ----------
        measurement
            which pattern it is of.
        residual, power, energy
            of what is left of it, of its shots, and of itself as the solver takes it.
        total
            (rows, columns) light of all patterns' shots.
        """
        pattern = measurement.row, measurement.column
        self.residual[pattern], self.power[pattern], self.energy[pattern] = residual, power, energy
        for half, (digest, clipped) in enumerate(zip(measurement.digests, measurement.clipped, strict=True)):
            self.digests.setdefault(digest, []).append((pattern, half))
            if clipped:
                self.clipped[pattern, half] = clipped
        if measurement.shots == 2:
            light, difference = float(measurement.light.sum()), float(measurement.frame.sum())
            self.halves[pattern] = (light + difference) / 2, (light - difference) / 2
        others = self.residual.size - 1
        if measurement.shots == 2 and others:
            # light - (total - light) / others
            beyond = (measurement.light * (1 + others) - total) / others
            self.sums[pattern] = _energy(beyond)


class FrameCheck:
    """Foretells each frame of a run from its others.

    Parameters
    ----------
    prepared, weights
        the factorised model, and W of all measurements.
    lam
        lambda of its image.
    patterns
        P_L (n, K) and P_R (n', K').
    manifest
        of the run.
    noise
        of its measurements.
    measured
        reads all measurements once more.
    """

    def __init__(
        self,
        prepared: Prepared,
        weights: FloatArray,
        lam: float,
        patterns: tuple[FloatArray, FloatArray],
        manifest: RunManifest,
        noise: FrameNoise,
        measured: Callable[[], Iterable[Measurement]],
    ) -> None:
        self.prepared, self.weights, self.noise = prepared, weights, noise
        self.manifest, self.measured = manifest, measured
        self._patterns, self._digital = patterns, manifest.digital
        self._shots = manifest.patterns.captures
        self._number = {(shot.row, shot.column, shot.sign): index for index, shot in enumerate(self._shots)}
        self._signed = any(shot.sign for shot in self._shots)
        all_lit = [np.flatnonzero((side > 0).all(axis=0)) for side in patterns]
        self._whole = (int(all_lit[0][0]), int(all_lit[1][0])) if self._signed and all(map(len, all_lit)) else None
        sigma = np.outer(prepared.left.singular, prepared.right.singular)
        self._sigma = sigma
        self._kept = np.divide(np.square(sigma), np.square(sigma) + lam, out=np.zeros_like(sigma), where=sigma > 0)
        self._periods = tuple(len(group_pixels(side, "block")) for side in patterns)
        lit = [(side != 0).sum(axis=1) for side in patterns]
        self._exclusive = bool(max(lit[0]) == 1 and max(lit[1]) == 1) and noise.variance.size > 1
        self._size = prepared.left.sensor_size * prepared.right.sensor_size
        self._spare = prepared.spare

    # ---- suspicion

    def all_off(self, sums: FrameSums, beside_noise: float) -> bool:
        """Whether the typical frame is off, and not single ones; ``sums`` and ``beside_noise`` as :meth:`faults` takes
        them."""
        noise = self.noise.variance * self._size * self._spare
        share = beside_noise * sums.power / max(float(sums.power.sum()), np.finfo(float).tiny)
        part = np.maximum(sums.residual - noise - share, 0.0) / np.maximum(sums.power, np.finfo(float).tiny)
        return bool(np.median(part) > _OFF**2)

    def faults(self, sums: FrameSums, beside_noise: float, hinted: bool = False) -> tuple[FrameFault, ...]:
        """The frames at fault.

        Parameters
        ----------
        sums
            of all measurements.
        beside_noise
            energy that rendering, the factors' noise and print put into all of them.
        hinted
            whether frames are suspected from less on, as together they are off by a little.
        """
        found = [*self._same(sums), *self._clipped(sums), *self._noiseless(sums)]
        suspects = self._suspects(sums, beside_noise, CHANCE)
        if suspects and not suspects[0] and hinted:
            suspects = self._suspects(sums, beside_noise, _HINT)
        if suspects is None:  # too many
            return tuple(found)
        named = _Namer(self, *suspects).faults() if suspects[0] else []
        # What is known without the model is said where that does not say more; of clipped frames it explains the rest.
        clipped = {number for fault in found if fault.fault is Fault.CLIPPED for number in fault.numbers}
        named = [fault for fault in named if not clipped & set(fault.numbers)]
        known = clipped | {number for fault in named for number in fault.numbers}
        return (*(each for each in found if each.fault is Fault.CLIPPED or not known & set(each.numbers)), *named)

    def _suspects(
        self, sums: FrameSums, beside_noise: float, level: float
    ) -> tuple[dict[Pattern, bool], FloatArray] | None:
        """Patterns that are off, each with whether its brightness alone is, and W with these as the others foretell
        them; None where too many are.

        Parameters
        ----------
        sums, beside_noise
            as :meth:`faults` takes them.
        level
            standard deviations of noise from which the first is suspected.
        """
        bad: dict[Pattern, bool] = {}
        weights, count = self.weights, self.noise.variance.size
        while candidates := self._off(sums, weights, beside_noise, bad, min(level, _FURTHER) if bad else level):
            if len(bad) + 1 > max(1, _MOST_BAD * count):
                return None
            if count == 1:
                return dict(candidates), weights
            # Where patterns overlap a frame puts others off: it is the one without which the rest fits best.
            several = not (self._exclusive or self._signed)
            least = np.inf
            for pattern, by_brightness in candidates[: _TRIED if several else 1]:
                rest, explained = self._without((*bad, pattern))
                noise = float(self.noise.variance[pattern]) * self._size * self._spare
                if (left := noise - float(sums.energy[pattern]) - explained) < least:
                    least, found = left, (pattern, by_brightness, rest)
            bad[found[0]], weights = found[1:]
            sums = self._gathered(weights, bad)
        return bad, weights

    def out_of_step(self, sums: FrameSums) -> str:
        """How signed shots are a step beside their patterns, as ``sums`` of their light tell, or nothing.

        That of two halves is the same for all patterns; most is that of the half that lights all pixels.
        """
        if self._whole is None or self.noise.variance.size < 4:
            return ""
        whole = self._number[(*self._whole, 1)]
        light = np.zeros(len(self._shots))
        for pattern, halves in sums.halves.items():
            for sign, half in zip((1, -1), halves, strict=True):
                light[self._number[(*pattern, sign)]] = half

        def odd(step: int) -> int:
            pairs: dict[Pattern, float] = {}
            for number, shot in enumerate(self._shots):
                pattern = shot.row, shot.column
                pairs[pattern] = pairs.get(pattern, 0.0) + light[(number + step) % len(light)]
            totals = np.array(list(pairs.values()))
            return int((np.abs(totals - np.median(totals)) > _ODD * abs(np.median(totals))).sum())

        if odd(0) > 1:
            for step, words in ((1, STEPS[0]), (-1, STEPS[1])):
                if odd(step) == 0 and int(np.argmax(np.roll(light, -step))) == whole:
                    return words
        return ""

    def whole(self) -> FloatArray | None:
        """(m, m') the sum of a signed pattern's halves, as the model has it of the pattern of +1 alone; None without
        that."""
        return None if self._whole is None else self._frame(self.weights, *self._whole)

    def negative(self) -> str:
        """Why signed patterns were taken the wrong way round, or nothing: pixels that are always lit alike then have a
        negative reflectance in the mean, where noise is averaged."""
        if not self._signed or max(self._periods) < 2:
            return ""
        image = self._image(self.weights)
        rows, columns = (group_pixels(side, "block") for side in self._patterns)
        means = np.array([[image[np.ix_(row.pixels, column.pixels)].mean() for column in columns] for row in rows])
        if means.min() > -_NEGATIVE * np.abs(means).max():
            return ""
        return "the image is negative: the halves of signed pairs are exchanged, or their frames in another order"

    def _off(
        self, sums: FrameSums, weights: FloatArray, beside_noise: float, bad: dict[Pattern, bool], level: float
    ) -> list[tuple[Pattern, bool]]:
        """Patterns that are off, the most first, and whether their brightness alone is.

        Parameters
        ----------
        sums, weights
            of all, and W of those that are not ``bad``.
        beside_noise, level
            as :meth:`_suspects` takes them.
        bad
            patterns that are suspected already.
        """
        good = np.ones(self.noise.variance.shape, dtype=np.bool_)
        for pattern in bad:
            good[pattern] = False
        if not good.any():
            return []
        noise = self.noise.variance * self._size
        chance = level * self.noise.variance * np.sqrt(2 * self._size)
        share = beside_noise * sums.power / max(float(sums.power.sum()), np.finfo(float).tiny)
        others = max(good.sum() - 1, 1)
        # Behind a mask with a constant term most of a frame's light says nothing, and is no part of what it is off by.
        whole = sums.energy if self.prepared.centre else sums.power
        tests = [(sums.residual, whole, noise * self._spare + share, chance)]
        if self._signed:
            mean = float(noise[good].mean())
            tests.append((sums.sums, sums.power, noise + mean / others + share, 2 * chance))
        parts = np.zeros(good.shape)
        for energy, whole, expected, allowed in tests:
            power = np.maximum(whole, np.median(whole[good]))
            beyond = np.where(good, np.maximum(energy - expected, 0.0), 0.0)
            part = beyond / np.maximum(power, np.finfo(float).tiny)
            usual = float(np.median(part[good])) if good.sum() > 2 else 0.0
            off = good & (beyond > allowed) & (part > max(_OFF**2, _MORE * usual))
            parts = np.maximum(parts, np.where(off, part, 0.0))
        if parts.any():
            order = np.argsort(-parts, axis=None, kind="stable")[: np.count_nonzero(parts)]
            rows, columns = np.unravel_index(order, parts.shape)
            return [((int(row), int(column)), False) for row, column in zip(rows, columns, strict=True)]
        if self._exclusive:
            ratio = self._brightness(weights, good)
            return [] if ratio is None else [(ratio, True)]
        return [((0, 0), True)] if good.size == 1 and self._is_dark() else []

    def _is_dark(self) -> bool:
        """Whether the only frame has no more light than noise makes."""
        return bool(abs(self.noise.means[0, 0]) < CHANCE * float(np.sqrt(self.noise.variance[0, 0] / self._size)))

    def _brightness(self, weights: FloatArray, good: BoolArray) -> Pattern | None:
        """The ``good`` pattern whose brightness differs most from what its pixels' neighbours foretell, if it does.

        The median of its pixels must differ, which highlights and edges do not move, its light as a whole to the same
        side, and by more than the others': stripes as fine as the dots make others differ as well.
        """
        image, lit = self._image(weights), self._lit(good)
        near = self._neighbours(image, lit)
        least = max(_SCALE_LEAST, _FEW / good.size)
        middles = {pattern: _median(seen / told) for pattern, seen, told in self._beside(image, near, good)}
        if len(middles) < 3:
            return None
        first = max(middles, key=lambda pattern: abs(_away(middles[pattern], middles)))
        if abs(_away(middles[first], middles)) < least / 2:
            return None
        (own,) = ((seen, told) for pattern, seen, told in self._beside(image, near, good) if pattern == first)
        # Its neighbours are off by what it is off.
        lit[np.ix_(*(side[:, index] != 0 for side, index in zip(self._patterns, first, strict=True)))] = False
        near = self._neighbours(image, lit)
        middles, wholes = dict[Pattern, float](), dict[Pattern, float]()
        for pattern, seen, told in self._beside(image, near, good):
            if pattern != first:
                middles[pattern], wholes[pattern] = _median(seen / told), float(np.vdot(seen, told)) / _energy(told)
        if len(middles) < 3:
            return None
        ratios = own[0] / own[1]
        middle, away = _median(ratios), np.array([abs(_away(ratio, middles)) for ratio in middles.values()])
        # The standard error of a median is 1.2533 times that of a mean, and a standard deviation 1.4826 times the
        # median deviation of normal numbers.
        error = 1.2533 * 1.4826 * _median(np.abs(ratios - middle)) / np.sqrt(ratios.size)
        spread = float(np.hypot(1.4826 * _median(away), error / max(_median(np.array(list(middles.values()))), 1e-300)))
        darker, whole = _away(middle, middles), _away(float(np.vdot(*own)) / _energy(own[1]), wholes)
        least = max(least, _SCALE_SPREADS * spread, _SCALE_OTHERS * float(away.max()))
        return first if abs(darker) > least and darker * whole > 0 else None

    def _beside(
        self, image: FloatArray, near: FloatArray, good: BoolArray
    ) -> Iterator[tuple[Pattern, FloatArray, FloatArray]]:
        """Of each ``good`` pattern the pixels of an ``image`` and what is ``near`` them, where that is bright."""
        bright = near > _BRIGHT_ENOUGH * max(float(near.mean()), 0.0)
        lit = [[np.flatnonzero(column) for column in side.T] for side in self._patterns]
        for row, column in np.ndindex(good.shape):
            place = np.ix_(lit[0][row], lit[1][column])
            chosen = bright[place]
            if good[row, column] and np.count_nonzero(chosen) >= _FEWEST_PIXELS:
                yield (row, column), image[place][chosen], near[place][chosen]

    def _same(self, sums: FrameSums) -> Iterable[FrameFault]:
        """Shots that are one and the same frame, noise and all."""
        if not self.noise.variance.any():
            return
        for digest, shots in sums.digests.items():
            if digest and len(shots) > 1:
                numbers = [self._number[(*pattern, (1 - 2 * half) if self._signed else 0)] for pattern, half in shots]
                yield self._fault(Fault.REPEATED, numbers, "are one and the same")

    def _clipped(self, sums: FrameSums) -> Iterable[FrameFault]:
        """Shots with many readings at their largest number; where most have, it is the end of the sensor's range."""
        if len(sums.clipped) <= max(1, _MOST_BAD * len(self._shots)):
            for (pattern, half), count in sums.clipped.items():
                numbers = [self._number[(*pattern, (1 - 2 * half) if self._signed else 0)]]
                yield self._fault(Fault.CLIPPED, numbers, f"has {count} readings at its largest number")

    def _noiseless(self, sums: FrameSums) -> Iterable[FrameFault]:
        """Frames with less noise than their sensor has: only where readings can show it."""
        digital = self._digital
        if not digital.noise_is_stated:
            return
        light = self.noise.means
        rounding = ((digital.step_dn or 0.0) / digital.gain_dn_per_e / digital.exposure_s) ** 2 / 12 * self.noise.shots
        own = self.noise.variance - rounding
        # Digital numbers of one reading: its noise, and how far it is above the end of its range.
        deviation = np.sqrt(np.maximum(own, 0) / self.noise.shots) * digital.exposure_s * digital.gain_dn_per_e
        above = (light / self.noise.shots) * digital.exposure_s * digital.gain_dn_per_e + digital.black_level_dn
        shows = (deviation > 0.5 * (digital.step_dn or 0.0)) & (above > 3 * deviation) & (own > 0)
        shows &= self.noise.saturated < 1e-3 * max(self.noise.readings, 1)
        expected = np.where(shows, own * self._size * self._spare, 1.0)
        least = _QUIET if digital.step_dn else _AVERAGED
        quiet = shows & (sums.residual / expected < least * (1 - CHANCE * np.sqrt(2 / (self._size * self._spare))))
        numbers = [n for n, shot in enumerate(self._shots) if quiet[shot.row, shot.column]]
        if numbers:
            part = float(sums.residual[quiet].sum() / expected[quiet].sum())
            has = f"{'have' if len(numbers) > 1 else 'has'} {part:.2g} of the noise that the sensor makes"
            yield self._fault(Fault.NOISELESS, numbers, has)

    # ---- foretelling

    def _columns(self, row: int, column: int) -> Any:
        """Where the coefficients of a pattern are in W."""
        places = [
            np.arange(side.accumulated_size)[side.slabs[index].columns]
            for side, index in ((self.prepared.left, row), (self.prepared.right, column))
        ]
        return np.ix_(*places)

    def _frame(self, weights: FloatArray, row: int, column: int) -> FloatArray:
        """(m, m') the frame of a pattern by ``weights``."""
        left, right = self.prepared.left.slabs[row], self.prepared.right.slabs[column]
        return np.asarray(left.matrix @ weights[left.columns][:, right.columns] @ right.matrix.T)

    def _own(self, frame: FloatArray, row: int, column: int) -> FloatArray:
        """What a ``frame`` of a pattern adds to W at its columns."""
        left, right = self.prepared.left.slabs[row], self.prepared.right.slabs[column]
        return np.asarray(left.matrix.T @ frame @ right.matrix)

    def _image(self, weights: FloatArray) -> FloatArray:
        """(n, n') image of W at the image's lambda."""
        filtered = np.divide(self._kept * weights, self._sigma, out=np.zeros_like(weights), where=self._sigma > 0)
        return self.prepared.image(filtered)

    def _seen(self, image: FloatArray) -> FloatArray:
        """W of an ``image`` without noise."""
        duals = [side.basis if side.dual is None else side.dual for side in (self.prepared.left, self.prepared.right)]
        return np.asarray(self._sigma * (duals[0].T @ image @ duals[1]))

    def _lit(self, good: BoolArray) -> BoolArray:
        """(n, n') pixels that a ``good`` pattern lights."""
        left, right = ((side != 0).astype(np.float64) for side in self._patterns)
        return np.asarray(left @ good @ right.T > 0)

    def _neighbours(self, image: FloatArray, lit: BoolArray) -> FloatArray:
        """(n, n') mean of each pixel's neighbours, along sides with several groups, that are ``lit``."""
        size = [3 if period > 1 else 1 for period in self._periods]
        light, count = (
            uniform_filter(values, size, mode="constant") * np.prod(size) - values
            for values in (image * lit, lit.astype(np.float64))
        )
        return np.asarray(np.divide(light, count, out=np.zeros_like(light), where=count > 0.5))

    def _measurements(self, patterns: Iterable[Pattern]) -> dict[Pattern, Measurement]:
        wanted = set(patterns)
        return {key: each for each in self.measured() if (key := (each.row, each.column)) in wanted}

    def _centred(self, frame: FloatArray) -> FloatArray:
        return centred(frame) if self.prepared.centre else frame

    def _without(self, bad: tuple[Pattern, ...]) -> tuple[FloatArray, float]:
        """W of all patterns, the ``bad`` ones as the others foretell them, and what it explains of these others'
        energy."""
        rest = self.weights.copy()
        for pattern, measurement in self._measurements(bad).items():
            rest[self._columns(*pattern)] -= self._own(self._centred(measurement.frame), *pattern)
        good = np.ones(self.noise.variance.shape, dtype=np.bool_)
        for pattern in bad:
            good[pattern] = False
        image = self._image(self.weights)
        if not self._exclusive and max(self._periods) > 1:
            # One pattern of +-1 that is wrong is a comb of the dots' period, without a mean.
            image = uniform_filter(image, self._periods, mode="nearest")
        lit = self._lit(good)
        image = np.where(lit, image, self._neighbours(image, lit))
        weights = self._seen(image)
        grams = {
            pattern: (
                self.prepared.left.slabs[pattern[0]].matrix.T @ self.prepared.left.slabs[pattern[0]].matrix,
                self.prepared.right.slabs[pattern[1]].matrix.T @ self.prepared.right.slabs[pattern[1]].matrix,
            )
            for pattern in bad
        }

        def of_bad(values: FloatArray) -> FloatArray:
            own = np.zeros_like(values)
            for pattern, (left, right) in grams.items():
                places = self._columns(*pattern)
                own[places] += left @ values[places] @ right
            return own

        if self._exclusive:
            weights = np.asarray(rest + of_bad(weights))
            return weights, float(np.vdot(weights, rest))
        # W - of_bad(W) = rest are the normal equations of the good ones: conjugate gradients after Hestenes and Stiefel
        # (1952), until a step brings these frames less than chance does.
        enough = _SETTLED * CHANCE * float(self.noise.variance.mean()) * np.sqrt(2 * self._size)
        left_over = rest + of_bad(weights) - weights
        step, squared = left_over.copy(), _energy(left_over)
        for _ in range(_MOST_STEPS):
            moved = step - of_bad(step)
            curvature = float(np.vdot(step, moved))
            if not curvature > 0:
                break
            length = squared / curvature
            weights = weights + length * step
            if length * squared < enough:
                break
            left_over -= length * moved
            before, squared = squared, _energy(left_over)
            step = left_over + squared / before * step
        return weights, float(np.vdot(weights, rest))

    def _gathered(self, weights: FloatArray, bad: Iterable[Pattern]) -> FrameSums:
        """Sums of all measurements against other ``weights``; the light of all is that of those not ``bad``."""
        sums = FrameSums((self.noise.variance.shape[0], self.noise.variance.shape[1]))
        total = np.zeros(0)
        if self._signed:
            total = sum((each.light for each in self._measurements(self._good(bad)).values()), start=np.zeros(()))
        others = max(self.noise.variance.size - len(set(bad)), 2)
        for each in self.measured():
            pattern, frame = (each.row, each.column), self._centred(each.frame)
            residual = frame - self._frame(weights, each.row, each.column)
            sums.residual[pattern], sums.power[pattern] = _energy(residual), each.power
            sums.energy[pattern] = _energy(frame)
            if self._signed:
                sums.sums[pattern] = _energy((each.light * others - total) / (others - 1))
        return sums

    def _good(self, bad: Iterable[Pattern]) -> set[Pattern]:
        return set(np.ndindex(self.noise.variance.shape)) - set(bad)

    # ---- names

    def _fault(self, fault: Fault, numbers: Iterable[int], words: str) -> FrameFault:
        numbers = tuple(sorted(numbers))
        files = tuple(self._shots[number].file for number in numbers)
        return FrameFault(fault, numbers, files, f"{listed(numbers, files)} {words}")


@dataclass(frozen=True, eq=False)
class _Seen:
    """What was read at a pattern that is suspected: a shot, or of a signed pattern whose halves' sum is right both.

    Attributes
    ----------
    numbers
        of its shots.
    pattern
        that it is of.
    raw, frame
        (m, m') its light, and that as the solver takes it.
    foretold
        (m, m') the same as the other frames tell it; None: they do not.
    variance
        of a datum of ``frame``, and of what it is held against.
    off
        energy beyond noise that it is off by.
    """

    numbers: tuple[int, ...]
    pattern: Pattern
    raw: FloatArray
    frame: FloatArray
    foretold: FloatArray | None
    variance: float
    off: float


class _Named(NamedTuple):
    """A ``fault`` of the frames of some ``numbers``, in ``words``; what it leaves of what they are off by, and
    the ``place`` whose light they hold."""

    left: float
    fault: Fault
    numbers: tuple[int, ...]
    words: str
    place: tuple[int, ...] = ()


class _Namer:
    """Faults of the patterns that a ``check`` suspects; ``bad`` and ``weights`` are as there."""

    def __init__(self, check: FrameCheck, bad: dict[Pattern, bool], weights: FloatArray) -> None:
        self._check, self._bad, self._weights = check, bad, weights
        self._measured = check._measurements(bad)
        self._total = check.noise.light
        self._foretold = {pattern: check._frame(weights, *pattern) for pattern in bad}
        self._rest = check.weights.copy()
        for pattern, each in self._measured.items():
            self._rest[check._columns(*pattern)] -= check._own(check._centred(each.frame), *pattern)
        self._least = self._left({}, weights)

    def faults(self) -> list[FrameFault]:
        """One for each that is found."""
        check = self._check
        seen = self._signed() if check._signed else [self._plain(pattern) for pattern in self._bad]
        repeats = self._repeats(seen)
        named: list[list[_Named]] = []
        for one in seen:
            same = [each for each in repeats.get(one.numbers, []) if each.left == -np.inf]
            chance = _LEFT * one.variance * np.sqrt(2 * one.frame.size)
            fits = [
                each
                for each in (*same, *self._tried(one))
                if each.left <= max(_EXPLAINS * one.off, chance) and one.off - each.left > _LIKELY * one.variance
            ]
            named.append(sorted(fits, key=lambda each: each.left) or repeats.get(one.numbers, [])[:1])
        return list(self._pairs(named))

    # ---- what frames leave

    def _together(self, frames: dict[Pattern, FloatArray]) -> FloatArray:
        """W of the patterns that are not suspected, and of these ``frames`` of others; of the rest as foretold."""
        weights = self._rest.copy()
        for pattern, foretold in self._foretold.items():
            weights[self._check._columns(*pattern)] += self._check._own(frames.get(pattern, foretold), *pattern)
        return np.where(self._check._sigma > 0, weights, 0.0)

    def _left(self, frames: dict[Pattern, FloatArray], weights: FloatArray) -> float:
        """Energy that ``frames`` of suspected patterns leave of all, but for a constant, their W being ``weights``."""
        light = sum(_energy(frames.get(pattern, foretold)) for pattern, foretold in self._foretold.items())
        return light - _energy(weights)

    def _beyond(self, frames: dict[Pattern, FloatArray], variance: float) -> float:
        """Energy beyond noise that all frames are off by with these, at a ``variance`` of a datum."""
        left = self._left(frames, self._together(frames)) - self._least
        return left - sum(frame.size for frame in frames.values()) * variance * self._check._spare

    def _filled(self, one: _Seen, raw: FloatArray, known: BoolArray) -> float:
        """Energy beyond noise that ``raw`` light in the place of ``one`` leaves where it is ``known``; elsewhere it may
        be anything."""
        known = np.broadcast_to(known, raw.shape)
        fit, means = self._foretold[one.pattern], np.zeros(())
        if self._check.prepared.centre:
            means = np.where(known, raw, np.median(raw[known]))
            means = means - self._level(means)
        for _ in range(_STEPS):
            filled = np.where(known, raw, fit + means)
            frame = self._level(filled)
            means = filled - frame
            weights = self._together({one.pattern: frame})
            fit = self._check._frame(weights, *one.pattern)
        left = self._left({one.pattern: frame}, weights) - self._least
        # The noise of a frame is that of its mean light, which what is lost makes too little.
        variance = max(one.variance, float(self._check.noise.of(float(raw[known].mean()), 1)))
        return left - float(known.sum()) * variance * self._check._spare

    # ---- what was read

    def _plain(self, pattern: Pattern) -> _Seen:
        check, measurement = self._check, self._measured[pattern]
        number, frame = check._number[(*pattern, 0)], check._centred(measurement.frame)
        variance = float(check.noise.variance[pattern])
        foretold = (
            None
            if check._exclusive or len(self._bad) == check.noise.variance.size
            else check._frame(self._weights, *pattern)
        )
        if foretold is None:
            off = self._outside(frame, pattern, variance)
            return _Seen((number,), pattern, measurement.frame, frame, None, variance, off)
        off = self._beyond({pattern: frame}, variance)
        return _Seen((number,), pattern, measurement.frame, frame, foretold, variance, off)

    def _signed(self) -> list[_Seen]:
        """Of patterns whose sum is off the half that is wrong; of others the difference."""
        check = self._check
        good = max(check.noise.variance.size - len(self._bad), 1)
        total = self._total - sum(each.light for each in self._measured.values())
        mean = total / good
        found, off = [], dict[Pattern, float]()
        for pattern, each in self._measured.items():
            variance = float(check.noise.variance[pattern]) * (1 + 1 / good)
            beyond = _energy(each.light - mean) - each.light.size * variance
            if beyond > CHANCE * variance * np.sqrt(2 * each.light.size) and beyond > _OFF**2 * each.power:
                off[pattern] = beyond
                continue
            numbers = tuple(check._number[(*pattern, sign)] for sign in (1, -1))
            foretold, frame = check._frame(self._weights, *pattern), check._centred(each.frame)
            beyond = self._beyond({pattern: frame}, variance)
            found.append(_Seen(numbers, pattern, each.frame, frame, foretold, variance, beyond))
        for pattern, sign in self._wrong_halves(off, mean).items():
            each, variance = self._measured[pattern], float(check.noise.variance[pattern]) * (1 + 1 / good)
            half, other = (each.light + sign * each.frame) / 2, (each.light - sign * each.frame) / 2
            number = check._number[(*pattern, sign)]
            if self._is_lit(pattern, sign):
                found.append(_Seen((number,), pattern, half, half, mean - other, variance, off[pattern]))
        return found

    def _wrong_halves(self, off: dict[Pattern, float], mean: FloatArray) -> dict[Pattern, int]:
        """Sign of the half that is wrong of each pattern that is ``off``, by that energy, the ``mean`` of halves' sums.

        The other half foretells it either way, and no pattern of +-1 tells another's coefficients. First come those
        that explain each other, as frames that are exchanged; then those that make the image vary least from pixel to
        pixel, as coefficients that are wrong are a comb over all of it.
        """
        check, patterns = self._check, list(off)[:_MOST_PAIRS]

        def exchanged(one: tuple[Pattern, int], other: tuple[Pattern, int]) -> bool:
            noise = mean.size * float(check.noise.variance[one[0]] + check.noise.variance[other[0]])
            apart = (halves[one] + halves[other[0], -other[1]] - mean, halves[other] + halves[one[0], -one[1]] - mean)
            most = max(_EXPLAINS * min(off[one[0]], off[other[0]]), _LEFT * noise * float(np.sqrt(2 / mean.size)))
            return max(_energy(each) for each in apart) - noise < most

        halves = {
            (pattern, sign): (each.light + sign * each.frame) / 2
            for pattern, each in self._measured.items()
            for sign in (1, -1)
        }
        ranked = []
        for signs in product((1, -1), repeat=len(patterns)):
            wrong = list(zip(patterns, signs, strict=True))
            frames = {pattern: check._centred(sign * (mean - 2 * halves[pattern, -sign])) for pattern, sign in wrong}
            image = check._image(self._together(frames))
            variation = float(sum(np.abs(np.diff(image, axis=axis)).sum() for axis in (0, 1)))
            ranked.append((-sum(exchanged(*pair) for pair in combinations(wrong, 2)), variation, wrong))
        return dict(min(ranked)[2])

    def _is_lit(self, pattern: Pattern, sign: int) -> bool:
        """Whether the half of that ``sign`` of a signed pattern lights any pixel."""
        left, right = (side[:, index] for side, index in zip(self._check._patterns, pattern, strict=True))
        return bool((1 + sign * np.outer(left, right)).any())

    # ---- what explains it

    def _tried(self, one: _Seen) -> Iterable[_Named]:
        if len(one.numbers) == 2:
            yield from self._exchanged(one)
            return
        if self._is_black(one):
            yield _Named(-np.inf, Fault.BLACK, one.numbers, "holds no light")
        if one.foretold is None and self._bad[one.pattern]:
            yield from self._by_neighbours(one)
            return
        yield from self._part_lost(one)
        yield from self._scaled(one)
        yield from self._elsewhere(one)
        yield from self._moved(one)

    def _is_black(self, one: _Seen) -> bool:
        """Whether a shot is as even, and as dark, as a sensor without light."""
        count = self._check.noise.variance.size
        light = one.foretold if one.foretold is not None else self._total / count
        if count == 1 and self._bad[one.pattern]:
            return True
        dark = float(self._check._digital.variance(0.0))
        spread, expected = float(one.raw.var()) - dark, float(light.var())
        return bool(spread < _DARK**2 * expected + dark and one.raw.mean() < _DARK * abs(light.mean()) + np.sqrt(dark))

    def _by_neighbours(self, one: _Seen) -> Iterable[_Named]:
        check = self._check
        if not check._exclusive:
            return
        told = self._weights[check._columns(*one.pattern)]
        ratio = float(np.vdot(check._own(one.frame, *one.pattern), told)) / max(_energy(told), 1e-300)
        fault = Fault.DIM if ratio < 1 else Fault.BRIGHT
        words = f"holds {ratio:.2f} of the light that its neighbours' pixels tell"
        yield _Named(-np.inf, fault, one.numbers, words)

    def _scaled(self, one: _Seen) -> Iterable[_Named]:
        if one.foretold is None:
            return
        ratio = float(np.vdot(one.frame, one.foretold)) / max(_energy(one.foretold), 1e-300)
        left = _energy(one.frame - ratio * one.foretold) - one.frame.size * one.variance
        if ratio > 0 and not self._check._signed:
            ratio, left = self._least_scale(one, ratio)
        if ratio > 0:
            fault = Fault.DIM if ratio < 1 else Fault.BRIGHT
            yield _Named(left, fault, one.numbers, f"holds {ratio:.2f} of the light that the other frames tell")

    def _least_scale(self, one: _Seen, start: float) -> tuple[float, float]:
        """The part of its light that a frame has, and what it leaves divided by that."""

        def left(ratio: float) -> float:
            return self._beyond({one.pattern: one.frame / ratio}, one.variance / ratio**2) * ratio**2

        found = minimize_scalar(left, bounds=(0.3 * start, min(3 * start, 10.0)), method="bounded")
        return float(found.x), float(found.fun)

    def _part_lost(self, one: _Seen) -> Iterable[_Named]:
        """Rows, or columns, without light side by side."""
        for axis, name in ((0, "rows"), (1, "columns")):
            lines, usual = one.raw.mean(axis=1 - axis), self._total.mean(axis=1 - axis)
            if self._check.noise.variance.size == 1:
                usual = np.full_like(usual, np.percentile(lines, 90))
            ratio = lines / np.where(usual > 0, usual, np.inf)
            lost = np.abs(ratio) < _DARK * max(float(np.percentile(ratio, 75)), 0.0)
            lost |= (lines < 0) & (usual > 0) & (ratio < 0)
            first, last = _longest(lost)
            if not max(_LEAST_LOST * len(lines), 2) <= last - first < 0.9 * len(lines):
                continue
            kept = np.ones(len(lines), dtype=np.bool_)
            kept[first:last] = False
            if one.foretold is None or self._check._signed:
                left = self._outside_of_part(one, kept, axis)
            else:
                left = self._filled(one, one.raw, kept[:, None] if axis == 0 else kept[None, :])
            yield _Named(left, Fault.HALF_LOST, one.numbers, f"has no light in sensor {name} {first} to {last - 1}")

    def _elsewhere(self, one: _Seen) -> Iterable[_Named]:
        """Another pattern than that of its place: of all patterns under dots, else of those that are suspected."""
        check = self._check
        if one.foretold is None:
            others = [other for other in np.ndindex(check.noise.variance.shape) if other != one.pattern]
            if not others:
                return
            left, best = min((self._outside(one.frame, other, one.variance), other) for other in others)
            yield self._of_pattern(left, one, check._number[(*best, 0)])
            return
        for other in self._bad:
            if other == one.pattern:
                continue
            if not check._signed:  # of two that are suspected each may be the other's
                there = check._centred(self._measured[other].frame)
                yield self._of_pattern(self._crossed(one, other, there), one, check._number[(*other, 0)])
                continue
            each = self._measured[other]
            for sign in (1, -1):  # the other half of that pattern tells this one
                partner = (each.light - sign * each.frame) / 2
                mean = one.foretold + self._partner(one)
                left = _energy(one.frame - (mean - partner)) - one.frame.size * one.variance
                yield self._of_pattern(left, one, check._number[(*other, sign)])

    def _crossed(self, one: _Seen, other: Pattern, there: FloatArray) -> float:
        """Energy of :attr:`_Seen.off` that is left when a frame and that of an ``other`` pattern, ``there``, are
        exchanged."""
        variance = (one.variance + float(self._check.noise.variance[other])) / 2
        own = self._beyond({one.pattern: one.frame, other: there}, variance)
        left = self._beyond({one.pattern: there, other: one.frame}, variance)
        return left / own * one.off if own > 0 else np.inf

    def _partner(self, one: _Seen) -> FloatArray:
        """The other half of a signed pattern's shot."""
        return np.asarray(self._measured[one.pattern].light - one.raw)

    def _of_pattern(self, left: float, one: _Seen, *place: int) -> _Named:
        words = f"{'hold' if len(place) > 1 else 'holds'} the light of the pattern of frame {place[0]}"
        return _Named(left, Fault.MISPLACED, one.numbers, words, place)

    def _exchanged(self, one: _Seen) -> Iterable[_Named]:
        """Both halves of signed patterns: the two exchanged, or those of another pattern."""
        if one.foretold is None:
            return
        yield _Named(self._beyond({one.pattern: -one.frame}, one.variance), Fault.SWAPPED, one.numbers, "are exchanged")
        for other in self._bad:
            if other != one.pattern:
                there = self._check._centred(self._measured[other].frame)
                left = self._crossed(one, other, there)
                yield self._of_pattern(left, one, *(self._check._number[(*other, sign)] for sign in (1, -1)))

    def _moved(self, one: _Seen) -> Iterable[_Named]:
        """Moved over the sensor by whole pixels."""
        reach = min(_REACH, *(side // 8 for side in one.frame.shape))
        if reach < 1:
            return
        shift = self._by_range(one, reach) if one.foretold is None else _correlated(one.frame, one.foretold, reach)
        if shift == (0, 0):
            return
        if one.foretold is not None and not self._check._signed:
            # Frames of a smooth mask correlate beside their shift: from there on it is what leaves least.
            left, (rows, columns) = self._put_back(one, shift), shift
            for _ in range(reach):
                beside = [(rows + down, columns + across) for down in (-1, 0, 1) for across in (-1, 0, 1)]
                within = [each for each in beside if each != (rows, columns) and max(map(abs, each)) <= reach]
                best, place = min((self._put_back(one, each), each) for each in within)
                if best >= left:
                    break
                left, (rows, columns) = best, place
            if (rows, columns) == (0, 0):
                return
            words = f"is shifted by {rows} rows and {columns} columns of the sensor"
            yield _Named(left, Fault.SHIFTED, one.numbers, words)
            return
        ends = [slice(reach + step, size - reach + step) for step, size in zip(shift, one.raw.shape, strict=True)]
        still = [slice(reach, size - reach) for size in one.raw.shape]
        moved, unmoved = (self._inside(one, window, still) for window in (ends, still))
        if unmoved > 0:
            rows, columns = shift
            words = f"is shifted by {rows} rows and {columns} columns of the sensor"
            yield _Named(moved / unmoved * one.off, Fault.SHIFTED, one.numbers, words)

    def _put_back(self, one: _Seen, shift: tuple[int, int]) -> float:
        """Energy beyond noise that a frame leaves that is moved back by a ``shift``, rows and columns."""
        known = [np.zeros(size, dtype=np.bool_) for size in one.raw.shape]
        for line, step in zip(known, shift, strict=True):
            line[max(-step, 0) : len(line) - max(step, 0)] = True
        return self._filled(one, np.roll(one.raw, (-shift[0], -shift[1]), (0, 1)), np.outer(*known))

    # ---- fits

    def _fit(self, frame: FloatArray, pattern: Pattern) -> FloatArray:
        """(m, m') the part of a ``frame`` in the range of a ``pattern``."""
        left, right = (slab.matrix for slab in self._slabs(pattern))
        return np.asarray(left @ (left.T @ frame @ right) @ right.T)

    def _slabs(self, pattern: Pattern) -> tuple[Any, Any]:
        prepared = self._check.prepared
        return prepared.left.slabs[pattern[0]], prepared.right.slabs[pattern[1]]

    def _outside(self, frame: FloatArray, pattern: Pattern, variance: float) -> float:
        """Energy of a ``frame`` beyond noise that no light of the pixels of a ``pattern`` explains."""
        return _energy(frame) - _energy(self._check._own(frame, *pattern)) - self._check._spare * frame.size * variance

    def _ranges(self, pattern: Pattern, rows: Any, columns: Any) -> tuple[FloatArray, FloatArray]:
        """Orthonormal ranges of a ``pattern`` on part of the sensor's ``rows`` and ``columns``."""
        bases = []
        for slab, kept in zip(self._slabs(pattern), (rows, columns), strict=True):
            part = slab.matrix[kept]
            if self._check.prepared.centre:
                part = np.concatenate([part, np.ones((len(part), 1))], axis=1)
            bases.append(np.linalg.qr(part)[0])
        return bases[0], bases[1]

    def _outside_of_part(self, one: _Seen, kept: BoolArray, axis: int) -> float:
        """Energy beyond noise that is off in the ``kept`` rows (``axis`` 0) or columns of the sensor."""
        window = (kept, slice(None)) if axis == 0 else (slice(None), kept)
        part = one.raw[window]
        # The noise of a frame is that of its mean light, which what is lost makes too little.
        variance = max(one.variance, float(self._check.noise.of(float(part.mean()), 1)))
        if one.foretold is not None:
            return _energy(self._level(part - one.foretold[window])) - part.size * variance
        left, right = self._ranges(one.pattern, *window)
        return _energy(part) - _energy(left.T @ part @ right) - self._check._spare * part.size * variance

    def _level(self, part: FloatArray) -> FloatArray:
        return centred(part) if self._check.prepared.centre else part

    def _inside(self, one: _Seen, window: list[slice], still: list[slice]) -> float:
        """Energy beyond noise of a ``window`` of the sensor, held against the ``still`` middle of it."""
        part = one.raw[window[0], window[1]]
        if one.foretold is not None:
            return _energy(self._level(part - one.foretold[still[0], still[1]])) - part.size * one.variance
        left, right = self._ranges(one.pattern, *still)
        return _energy(part) - _energy(left.T @ part @ right) - self._check._spare * part.size * one.variance

    def _by_range(self, one: _Seen, reach: int) -> tuple[int, int]:
        """The shift that puts most of a frame into the range of its pattern: of rows, then of columns, as a shift along
        one side of the sensor does not move the other's range."""
        still = [slice(reach, size - reach) for size in one.raw.shape]
        found = []
        for axis, basis in enumerate(self._ranges(one.pattern, *still)):
            frame = one.raw if axis == 0 else one.raw.T
            parts = {}
            for step in range(-reach, reach + 1):
                lines = frame[reach + step : len(frame) - reach + step]
                parts[step] = _energy(basis.T @ lines) / max(_energy(lines), 1e-300)
            found.append(max(parts, key=lambda step: (parts[step], -abs(step))))
        return found[0], found[1]

    # ---- frames that go together

    def _repeats(self, seen: list[_Seen]) -> dict[tuple[int, ...], list[_Named]]:
        """Shots that are equal to another, but for noise."""
        check = self._check
        found: dict[tuple[int, ...], list[_Named]] = {}
        for each in check.measured():
            pattern = each.row, each.column
            signs = (1, -1) if each.shots == 2 else (0,)
            variance = float(check.noise.variance[pattern])
            for sign in signs:
                shot = (each.light + sign * each.frame) / 2 if sign else each.frame
                number = check._number[(*pattern, sign)]
                for one in seen:
                    if len(one.numbers) > 1 or number in one.numbers:
                        continue
                    apart = _energy(one.raw - shot)
                    beyond = apart - shot.size * (one.variance + variance / len(signs))
                    if apart < _ROUNDING * _energy(shot):
                        beyond = -np.inf
                    if beyond < 0.5 * _EXPLAINS * one.off and beyond < CHANCE * one.variance * np.sqrt(8 * shot.size):
                        words = f"repeats frame {number} ({check._shots[number].file})"
                        found.setdefault(one.numbers, []).append(_Named(beyond, Fault.REPEATED, one.numbers, words))
        return found

    def _pairs(self, named: list[list[_Named]]) -> Iterable[FrameFault]:
        """The first of each that is ``named``; but frames that hold each other's light as one fault."""
        places, done = {(each.numbers, each.place) for fits in named for each in fits}, set[tuple[int, ...]]()
        for fits in named:
            if not fits or fits[0].numbers in done:
                continue
            best = fits[0]
            pair = next((each for each in fits if best.left > -np.inf and (each.place, each.numbers) in places), None)
            if pair:
                done |= {pair.numbers, pair.place}
                yield self._check._fault(Fault.SWAPPED, (*pair.numbers, *pair.place), "are exchanged")
            else:
                yield self._check._fault(best.fault, best.numbers, best.words)


def _median(values: FloatArray) -> float:
    # np.median takes four times as long for so few.
    return float(np.partition(values, len(values) // 2)[len(values) // 2])


def _away(ratio: float, ratios: dict[Pattern, float]) -> float:
    """Part by which a ``ratio`` is below the median of all, negative, or that above it."""
    part = ratio / max(_median(np.array(list(ratios.values()))), 1e-300)
    return 1 - 1 / part if part > 1 else part - 1


def _correlated(frame: FloatArray, foretold: FloatArray, reach: int) -> tuple[int, int]:
    """The shift (rows, columns) by which ``frame`` is most like what was ``foretold``, up to ``reach``."""
    shape = [fft.next_fast_len(size + reach) for size in frame.shape]
    spectra = [fft.rfft2(values - values.mean(), shape) for values in (frame, foretold)]
    alike = fft.irfft2(spectra[0] * spectra[1].conj(), shape)
    steps = np.arange(-reach, reach + 1)
    place = np.unravel_index(int(np.argmax(alike[np.ix_(steps, steps)])), (len(steps),) * 2)
    return int(steps[place[0]]), int(steps[place[1]])


def _longest(lost: BoolArray) -> tuple[int, int]:
    """First of the longest run of ``lost`` lines, and the first after it."""
    ends = np.flatnonzero(np.diff(np.concatenate([[False], lost, [False]]).astype(np.int8)))
    if not len(ends):
        return 0, 0
    runs = ends.reshape(-1, 2)
    first, last = runs[np.argmax(runs[:, 1] - runs[:, 0])]
    return int(first), int(last)


def listed(numbers: tuple[int, ...], files: tuple[str, ...]) -> str:
    """Frames by their ``numbers`` and ``files``, the first few."""
    shown = ", ".join(f"{number} ({file})" for number, file in zip(numbers[:4], files[:4], strict=True))
    more = f" and {len(numbers) - 4} more" if len(numbers) > 4 else ""
    return f"frame{'s' if len(numbers) > 1 else ''} {shown}{more}"


def _energy(values: FloatArray) -> float:
    flat = np.ascontiguousarray(values).ravel()
    return float(np.dot(flat, flat))
