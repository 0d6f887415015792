"""Measurements, the factorised model and its fit in; out come frames that are not what they say, by number and fault.

A frame is suspected where it is off by more than noise, and by more than the other frames are: a scene that does not
fit has all its frames off. It is named where one fault explains what it is off by. The halves of signed patterns add up
to the same frame for all of them, which predicts each half by the other without any model.

*Brightness under dots.* No pixel is in two frames, so that half of a frame's light fits as well; but dots:k are k^2
samples of one picture.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from mitsim.core.arrays import FloatArray, sum_of_squares
from mitsim.reconstruct.causes import STEPS, Cause, Reading
from mitsim.reconstruct.factorisation import group_pixels
from mitsim.reconstruct.fault_explanations import Explanations
from mitsim.reconstruct.frame_faults import CHANCE, OFF, BoolArray, Fault, FrameFault, FrameSums, LeaveOneOut, Pattern

_MORE = 4.0
"""Times the median frame's unexplained energy from which a frame is suspected: chosen, as one that is wrong puts part
of its energy into the others where patterns overlap."""
_MOST_BAD = 0.25
"""Of all patterns: above it the run is another than it says, and no single frames are at fault."""
_FURTHER, _TRIED = 4.0, 3
"""In place of :data:`CHANCE`, once one frame is suspected; and the most frames of which it is tried which one puts the
others off: chosen, only what a fault explains is named."""
_NEGATIVE = 0.5
"""Mean reflectance of pixels that are lit alike, over the largest such mean, below which less the image is negative:
chosen, no noise of a picture that shows anything is as large."""
_ODD = 0.1
"""Of the light of a signed pair, by which that of another pair differs that is none: half of it or more."""
_COSTS, _FEWEST_PAIRS = 0.5, 4
"""Of the noise's energy, from which a lamp of other power from shot to shot is named: uncertainties are then a fifth
too small; and the fewest pairs that tell a median."""
_MEDIAN_SQUARE = 0.455
"""Median of the square of a normal number of variance 1."""
_QUIET, _AVERAGED = 0.5, 0.01
"""Part of the sensor's noise, without rounding, that frames may have at least: half where numbers are digital, stated
gains are that wrong; where they are not, means of up to 100 shots may have been given."""


class FrameCheck(LeaveOneOut):
    """Finds the frames of a run that are not what they say."""

    def all_off(self, sums: FrameSums, beside_noise: float) -> bool:
        """Whether the typical frame is off, and not single ones; ``sums`` and ``beside_noise`` as :meth:`faults` takes
        them."""
        noise = self.noise.variance * self.size * self.prepared.spare
        share = beside_noise * sums.power / max(float(sums.power.sum()), np.finfo(float).tiny)
        part = np.maximum(sums.residual - noise - share, 0.0) / np.maximum(sums.power, np.finfo(float).tiny)
        return bool(np.median(part) > OFF**2)

    def faults(self, sums: FrameSums, beside_noise: float, fits: bool = True) -> tuple[FrameFault, ...]:
        """The frames at fault.

        Parameters
        ----------
        sums
            of all measurements.
        beside_noise
            energy that rendering, the factors' noise and print put into all of them.
        fits
            whether what frames predict counts only where they fit; not of a scene whose depths are known to differ.
        """
        found = [*self._same(sums), *self._clipped_frames(sums), *self._noiseless(sums)]
        suspects = self._suspects(sums, beside_noise)
        if suspects is None:  # too many
            return tuple(found or self._flicker(sums))
        named = self._explain(sums, beside_noise, fits, *suspects) if suspects[0] else []
        if not named and not found:
            return tuple(self._flicker(sums))
        # What is known without the model is said where that does not say more; of clipped frames it explains the rest.
        clipped = {number for fault in found if fault.fault is Fault.CLIPPED for number in fault.numbers}
        named = [fault for fault in named if not clipped & set(fault.numbers)]
        known = clipped | {number for fault in named for number in fault.numbers}
        return (*(each for each in found if each.fault is Fault.CLIPPED or not known & set(each.numbers)), *named)

    def _suspects(self, sums: FrameSums, beside_noise: float) -> tuple[dict[Pattern, bool], FloatArray] | None:
        """Patterns that are off, each with whether its brightness alone is, and W with these as the others predict
        them; None where too many are. The parameters are those of :meth:`faults`."""
        bad: dict[Pattern, bool] = {}
        weights, count = self.weights, self.noise.variance.size
        while candidates := self._off(sums, weights, beside_noise, bad, _FURTHER if bad else CHANCE):
            if len(bad) + 1 > max(1, _MOST_BAD * count):
                return None
            if count == 1:
                return dict(candidates), weights
            # Where patterns overlap a frame puts others off: it is the one without which the rest fits best.
            several = not (self.exclusive or self.signed)
            least = np.inf
            for pattern, by_brightness in candidates[: _TRIED if several else 1]:
                rest, explained = self.without((*bad, pattern))
                noise = float(self.noise.variance[pattern]) * self.size * self.prepared.spare
                if (left := noise - float(sums.energy[pattern]) - explained) < least:
                    least, found = left, (pattern, by_brightness, rest)
            bad[found[0]], weights = found[1:]
            sums = self.sums_against(weights, bad)
        return bad, weights

    def _explain(
        self, sums: FrameSums, beside_noise: float, fits: bool, bad: dict[Pattern, bool], weights: FloatArray
    ) -> list[FrameFault]:
        """Faults of patterns that are suspected, :meth:`_suspects` as :meth:`faults` takes its parameters."""
        explanations = Explanations(self, bad, weights)
        if not fits:
            return explanations.faults(-np.inf)
        good = self.all_but(bad)
        variance, energy, total = self.noise.variance[good], float(sums.energy[good].sum()), float(sums.power.sum())
        beside = beside_noise * float(sums.power[good].sum()) / max(total, np.finfo(float).tiny)
        off = energy + explanations.others_left - float(variance.sum()) * self.size * self.prepared.spare - beside
        chance = CHANCE / 2 * float(np.sqrt(2 * self.size * np.square(variance).sum()))
        return explanations.faults(off if off > max(chance, (OFF / 2) ** 2 * energy) else 0.0)

    def out_of_step(self, sums: FrameSums) -> Reading | None:
        """How signed shots are a step beside their patterns, as ``sums`` of their light tell, if they are.

        That of two halves is the same for all patterns; most is that of the half that lights all pixels.
        """
        if self._whole is None or self.noise.variance.size < 4:
            return None
        whole = self.number[(*self._whole, 1)]
        light = np.zeros(len(self.shots))
        for pattern, halves in sums.halves.items():
            for sign, half in zip((1, -1), halves, strict=True):
                light[self.number[(*pattern, sign)]] = half

        def odd(step: int) -> int:
            pairs: dict[Pattern, float] = {}
            for number, shot in enumerate(self.shots):
                pattern = shot.row, shot.column
                pairs[pattern] = pairs.get(pattern, 0.0) + light[(number + step) % len(light)]
            totals = np.array(list(pairs.values()))
            return int((np.abs(totals - np.median(totals)) > _ODD * abs(np.median(totals))).sum())

        if odd(0) > 1:
            for step, words in ((1, STEPS[0]), (-1, STEPS[1])):
                if odd(step) == 0 and int(np.argmax(np.roll(light, -step))) == whole:
                    return Reading(Cause.ORDER, f"the frames are {words}")
        return None

    def whole(self) -> FloatArray | None:
        """(m, m') the sum of a signed pattern's halves, as the model has it of the pattern of +1 alone; None without
        that."""
        return None if self._whole is None else self.prepared.frame(self.weights, self._whole)

    def negative(self) -> Reading | None:
        """That signed patterns were taken the wrong way round, if they were: pixels that are always lit alike then have
        a negative reflectance in the mean, where noise is averaged."""
        if not self.signed or max(self._periods) < 2:
            return None
        image = self.image(self.weights)
        rows, columns = (group_pixels(side, "block") for side in self.patterns)
        means = np.array([[image[np.ix_(row.pixels, column.pixels)].mean() for column in columns] for row in rows])
        if means.min() > -_NEGATIVE * np.abs(means).max():
            return None
        words = "the image is negative: the halves of signed pairs are exchanged, or their frames in another order"
        return Reading(Cause.ORDER, words)

    def _off(
        self, sums: FrameSums, weights: FloatArray, beside_noise: float, bad: dict[Pattern, bool], level: float
    ) -> list[tuple[Pattern, bool]]:
        """Patterns that are off, the most first, and whether their brightness alone is.

        Parameters
        ----------
        sums, weights
            of all, and W of those that are not ``bad``.
        beside_noise
            as :meth:`faults` takes it.
        bad
            patterns that are suspected already.
        level
            standard deviations of noise by which others must be off.
        """
        good = self.all_but(bad)
        if not good.any():
            return []
        noise = self.noise.variance * self.size
        chance = level * self.noise.variance * np.sqrt(2 * self.size)
        share = beside_noise * sums.power / max(float(sums.power.sum()), np.finfo(float).tiny)
        others = max(good.sum() - 1, 1)
        # Behind a mask with a constant term most of a frame's light says nothing, and is no part of what it is off by.
        whole = sums.energy if self.prepared.centre else sums.power
        tests = [(sums.residual, whole, noise * self.prepared.spare + share, chance)]
        if self.signed:
            mean = float(noise[good].mean())
            tests.append((sums.sums, sums.power, noise + mean / others + share, 2 * chance))
        parts = np.zeros(good.shape)
        for energy, whole, expected, allowed in tests:
            power = np.maximum(whole, np.median(whole[good]))
            beyond = np.where(good, np.maximum(energy - expected, 0.0), 0.0)
            part = beyond / np.maximum(power, np.finfo(float).tiny)
            usual = float(np.median(part[good])) if good.sum() > 2 else 0.0
            off = good & (beyond > allowed) & (part > max(OFF**2, _MORE * usual))
            parts = np.maximum(parts, np.where(off, part, 0.0))
        if parts.any():
            order = np.argsort(-parts, axis=None, kind="stable")[: np.count_nonzero(parts)]
            rows, columns = np.unravel_index(order, parts.shape)
            return [((int(row), int(column)), False) for row, column in zip(rows, columns, strict=True)]
        if self.exclusive:
            ratio = odd_brightness(self, weights, good)
            return [] if ratio is None else [(ratio, True)]
        # The only frame may have no more light than noise makes.
        least = CHANCE * float(np.sqrt(self.noise.variance[0, 0] / self.size))
        return [((0, 0), True)] if good.size == 1 and abs(self.noise.means[0, 0]) < least else []

    def _same(self, sums: FrameSums) -> Iterable[FrameFault]:
        """Shots that are one and the same frame, noise and all."""
        if not self.noise.variance.any():
            return
        for digest, shots in sums.digests.items():
            if digest and len(shots) > 1:
                numbers = [self.number[(*pattern, (1 - 2 * half) if self.signed else 0)] for pattern, half in shots]
                yield self.fault(Fault.REPEATED, numbers, "are one and the same")

    def _clipped_frames(self, sums: FrameSums) -> Iterable[FrameFault]:
        """Shots with many readings at their largest number; where most have, it is the end of the sensor's range."""
        if len(sums.clipped) <= max(1, _MOST_BAD * len(self.shots)):
            for (pattern, half), count in sums.clipped.items():
                numbers = [self.number[(*pattern, (1 - 2 * half) if self.signed else 0)]]
                yield self.fault(Fault.CLIPPED, numbers, f"has {count} readings at its largest number")

    def _flicker(self, sums: FrameSums) -> Iterable[FrameFault]:
        """All shots, where the sums of signed pairs, which are one and the same light, tell that the lamp's power
        differs from shot to shot by what costs more than part of the noise."""
        powers = [(pattern, *power) for pattern, power in sums.powers.items()]
        if len(powers) < _FEWEST_PAIRS or not self.manifest.digital.noise_is_stated:
            return
        variance = np.array([self.noise.variance[pattern] for pattern, *_ in powers])
        common, apart, whole, difference, square = np.array([power for _, *power in powers]).T
        # Behind a mask with a constant term the solver takes part of the light alone.
        taken = np.array([sums.energy[pattern] for pattern, *_ in powers]) / difference
        cost = taken * (np.square(common) * difference + np.square(apart) * whole)
        noise = np.maximum(variance * self.size, np.finfo(float).tiny)
        # What noise makes of it, where halves are alike, or one is black for the most part.
        chance = taken * variance * (np.square(whole) + np.square(difference)) / square
        times = float(np.median(cost / noise)) / _MEDIAN_SQUARE
        if times > _COSTS + CHANCE * float(np.median(chance / noise)):
            differ = 100 * float(np.sqrt(np.square(common).mean() + np.square(apart).mean()))
            yield self.fault(
                Fault.FLICKER,
                list(range(len(self.shots))),
                f"differ by {differ:.2g} % in their lamp's power, as sums of pairs tell, which puts {times:.2g} times "
                "the noise into the image: use a steadier lamp, or expose for whole periods of it",
            )

    def _noiseless(self, sums: FrameSums) -> Iterable[FrameFault]:
        """Frames with less noise than their sensor has: only where readings can show it."""
        digital = self.manifest.digital
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
        expected = np.where(shows, own * self.size * self.prepared.spare, 1.0)
        least = _QUIET if digital.step_dn else _AVERAGED
        quiet = shows & (
            sums.residual / expected < least * (1 - CHANCE * np.sqrt(2 / (self.size * self.prepared.spare)))
        )
        numbers = [n for n, shot in enumerate(self.shots) if quiet[shot.row, shot.column]]
        if numbers:
            part = float(sums.residual[quiet].sum() / expected[quiet].sum())
            has = f"{'have' if len(numbers) > 1 else 'has'} {part:.2g} of the noise that the sensor makes"
            yield self.fault(Fault.NOISELESS, numbers, has)


# ---- A frame whose pixels differ in brightness from their neighbours -------------------------------------------------


_SPREADS, _LEAST, _TIMES_OTHERS = 4.0, 0.08, 2.0
"""Standard deviations, as half of the frames tell them, by which a frame's brightness may differ from what its
neighbours predict, the least such part that is named, and times what any other frame differs by: chosen, of 49 normal
numbers one is so far away, and twice as far as any other, once in 800 runs."""
_FEW = 2.5
"""The least part times the number of frames: half of so few frames do not tell a spread."""
_BRIGHT_ENOUGH = 0.2
"""Of the mean predicted reflectance, from which a pixel counts when it is compared with its neighbours."""
_FEWEST_PIXELS = 8
"""Pixels of a frame that its neighbours predict, below which their median is chance."""


def odd_brightness(check: LeaveOneOut, weights: FloatArray, good: BoolArray) -> Pattern | None:
    """The ``good`` pattern whose brightness differs most from what its pixels' neighbours predict, if it does.

    The median of its pixels must differ, which highlights and edges do not move, its light as a whole to the same
    side, and by more than the others': stripes as fine as the dots make others differ as well.

    Parameters
    ----------
    check, weights
        of the run, and W of its measurements.
    good
        (K, K') which of them count.
    """
    image, lit = check.image(weights), check.lit_pixels(good)
    near = check.neighbours(image, lit)
    least = max(_LEAST, _FEW / good.size)
    middles = {pattern: _median(seen / payload) for pattern, seen, payload in _beside(check, image, near, good)}
    if len(middles) < 3:
        return None
    first = max(middles, key=lambda pattern: abs(_away(middles[pattern], middles)))
    if abs(_away(middles[first], middles)) < least / 2:
        return None
    (own,) = ((seen, payload) for pattern, seen, payload in _beside(check, image, near, good) if pattern == first)
    # Its neighbours are off by what it is off.
    lit[np.ix_(*(side[:, index] != 0 for side, index in zip(check.patterns, first, strict=True)))] = False
    near = check.neighbours(image, lit)
    middles, wholes = dict[Pattern, float](), dict[Pattern, float]()
    for pattern, seen, payload in _beside(check, image, near, good):
        if pattern != first:
            middles[pattern], wholes[pattern] = (
                _median(seen / payload),
                float(np.vdot(seen, payload)) / sum_of_squares(payload),
            )
    if len(middles) < 3:
        return None
    ratios = own[0] / own[1]
    middle, away = _median(ratios), np.array([abs(_away(ratio, middles)) for ratio in middles.values()])
    # The standard error of a median is 1.2533 times that of a mean, and a standard deviation 1.4826 times the
    # median deviation of normal numbers.
    error = 1.2533 * 1.4826 * _median(np.abs(ratios - middle)) / np.sqrt(ratios.size)
    spread = float(np.hypot(1.4826 * _median(away), error / max(_median(np.array(list(middles.values()))), 1e-300)))
    darker, whole = _away(middle, middles), _away(float(np.vdot(*own)) / sum_of_squares(own[1]), wholes)
    least = max(least, _SPREADS * spread, _TIMES_OTHERS * float(away.max()))
    return first if abs(darker) > least and darker * whole > 0 else None


def _beside(
    check: LeaveOneOut, image: FloatArray, near: FloatArray, good: BoolArray
) -> Iterator[tuple[Pattern, FloatArray, FloatArray]]:
    """Of each ``good`` pattern the pixels of an ``image`` and what is ``near`` them, where that is bright."""
    bright = near > _BRIGHT_ENOUGH * max(float(near.mean()), 0.0)
    lit = [[np.flatnonzero(column) for column in side.T] for side in check.patterns]
    for row, column in np.ndindex(good.shape):
        place = np.ix_(lit[0][row], lit[1][column])
        chosen = bright[place]
        if good[row, column] and np.count_nonzero(chosen) >= _FEWEST_PIXELS:
            yield (row, column), image[place][chosen], near[place][chosen]


def _median(values: FloatArray) -> float:
    # np.median takes four times as long for so few.
    return float(np.partition(values, len(values) // 2)[len(values) // 2])


def _away(ratio: float, ratios: dict[Pattern, float]) -> float:
    """Part by which a ``ratio`` is below the median of all, negative, or that above it."""
    part = ratio / max(_median(np.array(list(ratios.values()))), 1e-300)
    return 1 - 1 / part if part > 1 else part - 1
