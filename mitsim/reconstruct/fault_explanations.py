"""Frames that are suspected in; the fault of each out that explains what it is off by.

A fault is named that leaves a small part of it, or noise alone, and is likelier than chance by far. Of a signed pattern
whose halves' sum is off one half is wrong: which, is found here.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np
from scipy import fft
from scipy.optimize import minimize_scalar

from mitsim.core.arrays import FloatArray, sum_of_squares
from mitsim.reconstruct.frame_faults import CHANCE, OFF, BoolArray, Fault, FrameFault, LeaveOneOut, Pattern

_EXPLAINS = 0.2
"""Part of what a frame is off by that a fault may leave: chosen, with room for what the others predict badly."""
_LEFT = 3.0
"""Standard deviations of noise that a fault may leave."""
_FILL_ROUNDS = 12
"""Rounds in which patterns left out are predicted from the rest: each brings what overlapping patterns know to a half
or less of its distance."""
_MOST_PAIRS = 6
"""Pairs of which it is tried which half is wrong: 64 images."""
_LIKELY = 60.0
"""Variances of a datum that a fault must explain, twice the logarithm of a likelihood ratio of 1e13: some of them are
searched for among 10^4."""
_OTHERS = 0.05
"""Of what a frame is off by, the most that all others may be that no fault explains: of two cards beside the calibrated
distance, which turn the sign of patterns that they move by half a period, others are off by a sixth."""
_BY_PREDICTION = Fault.SWAPPED, Fault.MISPLACED, Fault.DIM, Fault.BRIGHT, Fault.SHIFTED
"""Faults that are told by what the other frames predict alone, and so where the scene fits."""
_DARK = 0.1
"""Of the light that is predicted, below which a frame or a row of it is black."""
_LEAST_LOST = 0.02
"""Part of a frame's rows, or columns, that are lost before it is said; a dead line is less."""
_REACH = 24
"""Sensor pixels that frames are moved by in search of a shift."""
_ROUNDING = 1e-20
"""Of a frame's energy, by which the halves of two pairs differ that were the same numbers."""


Window = tuple[Any, ...]
"""Rows and columns of the sensor."""


@dataclass(frozen=True, eq=False)
class _Suspect:
    """What was read at a pattern that is suspected: a shot, or of a signed pattern whose halves' sum is right both.

    Attributes
    ----------
    numbers
        of its shots.
    pattern
        that it is of.
    raw, frame
        (m, m') its light, and that as the solver takes it.
    predicted
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
    predicted: FloatArray | None
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


class Explanations:
    """Faults of patterns that are suspected.

    Parameters
    ----------
    check
        of the run.
    bad
        the patterns, each with whether its brightness alone is off.
    weights
        W, with these as the others predict them.

    Attributes
    ----------
    others_left
        energy that the model leaves of patterns that are not suspected, less all of theirs.
    """

    def __init__(self, check: LeaveOneOut, bad: dict[Pattern, bool], weights: FloatArray) -> None:
        self._check, self._model, self._bad, self._weights = check, check.prepared, bad, weights
        self._measured = check.measurements(bad)
        self._total = check.noise.light
        self._predicted = {pattern: self._model.frame(weights, pattern) for pattern in bad}
        self._rest = check.rest(self._measured)
        self.others_left = self._energy_left({}, weights)

    # ---- what frames leave

    def _together(self, frames: dict[Pattern, FloatArray]) -> FloatArray:
        """W of the patterns that are not suspected, and of these ``frames`` of others; of the rest as predicted."""
        weights = self._rest.copy()
        for pattern, predicted in self._predicted.items():
            weights[self._model.places(pattern)] += self._model.weights(frames.get(pattern, predicted), pattern)
        return np.where(self._check.sigma > 0, weights, 0.0)

    def _energy_left(self, frames: dict[Pattern, FloatArray], weights: FloatArray) -> float:
        """Energy that ``frames`` of suspected patterns leave of all, but for a constant, their W being ``weights``."""
        light = sum(sum_of_squares(frames.get(pattern, predicted)) for pattern, predicted in self._predicted.items())
        return light - sum_of_squares(weights)

    def _beyond(self, frames: dict[Pattern, FloatArray], variance: float) -> float:
        """Energy beyond noise that all frames are off by with these, at a ``variance`` of a datum."""
        left = self._energy_left(frames, self._together(frames)) - self.others_left
        return left - sum(frame.size for frame in frames.values()) * variance * self._model.spare

    def _energy_filled(self, one: _Suspect, raw: FloatArray, known: BoolArray) -> float:
        """Energy beyond noise that ``raw`` light in the place of ``one`` leaves where it is ``known``; elsewhere it may
        be anything."""
        known = np.broadcast_to(known, raw.shape)
        fit, means = self._predicted[one.pattern], np.zeros(())
        if self._model.centre:
            means = np.where(known, raw, np.median(raw[known]))
            means = means - self._model.as_solved(means)
        for _ in range(_FILL_ROUNDS):
            filled = np.where(known, raw, fit + means)
            frame = self._model.as_solved(filled)
            means = filled - frame
            weights = self._together({one.pattern: frame})
            fit = self._model.frame(weights, one.pattern)
        left = self._energy_left({one.pattern: frame}, weights) - self.others_left
        # The noise of a frame is that of its mean light, which what is lost makes too little.
        variance = max(one.variance, float(self._check.noise.of(float(raw[known].mean()), 1)))
        return left - float(known.sum()) * variance * self._model.spare

    # ---- what was read

    def _plain_suspect(self, pattern: Pattern) -> _Suspect:
        check, light = self._check, self._measured[pattern].frame
        frame, variance = self._model.as_solved(light), float(check.noise.variance[pattern])
        if check.exclusive or len(self._bad) == check.noise.variance.size:
            predicted, off = None, self._outside(frame, pattern, variance)
        else:
            predicted, off = self._predicted[pattern], self._beyond({pattern: frame}, variance)
        return _Suspect((check.number[(*pattern, 0)],), pattern, light, frame, predicted, variance, off)

    def _signed_suspects(self) -> list[_Suspect]:
        """Of patterns whose sum is off the half that is wrong; of others the difference."""
        check = self._check
        good = max(check.noise.variance.size - len(self._bad), 1)
        total = self._total - sum(each.light for each in self._measured.values())
        mean = total / good
        found, off = [], dict[Pattern, float]()
        for pattern, each in self._measured.items():
            variance = float(check.noise.variance[pattern]) * (1 + 1 / good)
            beyond = sum_of_squares(each.light - mean) - each.light.size * variance
            if beyond > CHANCE * variance * np.sqrt(2 * each.light.size) and beyond > OFF**2 * each.power:
                off[pattern] = beyond
                continue
            numbers = tuple(check.number[(*pattern, sign)] for sign in (1, -1))
            predicted, frame = self._predicted[pattern], self._model.as_solved(each.frame)
            beyond = self._beyond({pattern: frame}, variance)
            found.append(_Suspect(numbers, pattern, each.frame, frame, predicted, variance, beyond))
        for pattern, sign in self._wrong_halves(off, mean).items():
            each, variance = self._measured[pattern], float(check.noise.variance[pattern]) * (1 + 1 / good)
            half, other = (each.light + sign * each.frame) / 2, (each.light - sign * each.frame) / 2
            number = check.number[(*pattern, sign)]
            left, right = (side[:, index] for side, index in zip(check.patterns, pattern, strict=True))
            if (1 + sign * np.outer(left, right)).any():  # it lights any pixel
                found.append(_Suspect((number,), pattern, half, half, mean - other, variance, off[pattern]))
        return found

    def _wrong_halves(self, off: dict[Pattern, float], mean: FloatArray) -> dict[Pattern, int]:
        """Sign of the half that is wrong of each pattern that is ``off``, by that energy, the ``mean`` of halves' sums.

        The other half predicts it either way, and no pattern of +-1 tells another's coefficients. First come those
        that explain each other, as frames that are exchanged; then those that make the image vary least from pixel to
        pixel, as coefficients that are wrong are a comb over all of it.
        """
        check, patterns = self._check, list(off)[:_MOST_PAIRS]

        def are_exchanged(one: tuple[Pattern, int], other: tuple[Pattern, int]) -> bool:
            # Of a half each.
            noise = mean.size * float(check.noise.variance[one[0]] + check.noise.variance[other[0]]) / 2
            apart = (halves[one] + halves[other[0], -other[1]] - mean, halves[other] + halves[one[0], -one[1]] - mean)
            most = max(_EXPLAINS * min(off[one[0]], off[other[0]]), _LEFT * noise * float(np.sqrt(2 / mean.size)))
            return max(sum_of_squares(each) for each in apart) - noise < most

        halves = {
            (pattern, sign): (each.light + sign * each.frame) / 2
            for pattern, each in self._measured.items()
            for sign in (1, -1)
        }
        ranked = []
        for signs in product((1, -1), repeat=len(patterns)):
            wrong = list(zip(patterns, signs, strict=True))
            frames = {
                pattern: self._model.as_solved(sign * (mean - 2 * halves[pattern, -sign])) for pattern, sign in wrong
            }
            image = check.image(self._together(frames))
            variation = float(sum(np.abs(np.diff(image, axis=axis)).sum() for axis in (0, 1)))
            ranked.append((-sum(are_exchanged(*pair) for pair in combinations(wrong, 2)), variation, wrong))
        return dict(min(ranked)[2])

    # ---- fits

    def _energy_outside(self, part: FloatArray, left: FloatArray, right: FloatArray, variance: float) -> float:
        """Energy of ``part`` of a frame beyond noise that two orthonormal ranges leave."""
        explained = sum_of_squares(left.T @ part @ right)
        return sum_of_squares(part) - explained - self._model.spare * part.size * variance

    def _outside(self, frame: FloatArray, pattern: Pattern, variance: float) -> float:
        """Energy of a ``frame`` beyond noise that no light of the pixels of a ``pattern`` explains."""
        left, right = (slab.matrix for slab in self._model.slabs(pattern))
        return self._energy_outside(frame, left, right, variance)

    def _ranges(self, pattern: Pattern, rows: Any, columns: Any) -> tuple[FloatArray, FloatArray]:
        """Orthonormal ranges of a ``pattern`` on part of the sensor's ``rows`` and ``columns``."""
        bases = []
        for slab, kept in zip(self._model.slabs(pattern), (rows, columns), strict=True):
            part = slab.matrix[kept]
            if self._model.centre:
                part = np.concatenate([part, np.ones((len(part), 1))], axis=1)
            bases.append(np.linalg.qr(part)[0])
        return bases[0], bases[1]

    def _part_left(self, one: _Suspect, window: Window, still: Window, variance: float) -> float:
        """Energy beyond noise of a ``variance`` of a ``window`` of the sensor's rows and columns, held against what is
        known of it, or of another, ``still`` one."""
        part = one.raw[window]
        if one.predicted is not None:
            return sum_of_squares(self._model.as_solved(part - one.predicted[still])) - part.size * variance
        return self._energy_outside(part, *self._ranges(one.pattern, *still), variance)

    def faults(self, others_off: float) -> list[FrameFault]:
        """One for each that is found; ``others_off`` is the energy beyond noise by which patterns are off that are not
        suspected."""
        check = self._check
        seen = self._signed_suspects() if check.signed else [self._plain_suspect(pattern) for pattern in self._bad]
        repeats = self._repeats(seen)
        explained: list[list[_Named]] = []
        for one in seen:
            same = [each for each in repeats.get(one.numbers, []) if each.left == -np.inf]
            chance = _LEFT * one.variance * np.sqrt(2 * one.frame.size)
            fits = [
                each
                for each in (*same, *self._candidates(one))
                if each.left <= max(_EXPLAINS * one.off, chance) and one.off - each.left > _LIKELY * one.variance
            ]
            explained.append(sorted(fits, key=lambda each: each.left))
        others_off += sum(max(one.off, 0.0) for one, fits in zip(seen, explained, strict=True) if not fits)
        named = [
            [
                each
                for each in fits
                if each.fault not in _BY_PREDICTION or others_off <= _OTHERS * one.off or each.left == -np.inf
            ]
            or repeats.get(one.numbers, [])[:1]
            for one, fits in zip(seen, explained, strict=True)
        ]
        return list(self._pairs(named))

    # ---- what explains it

    def _candidates(self, one: _Suspect) -> Iterable[_Named]:
        if len(one.numbers) == 2:
            yield from self._exchange(one)
            return
        if self._is_black(one):
            yield _Named(-np.inf, Fault.BLACK, one.numbers, "holds no light")
        if one.predicted is None and self._bad[one.pattern]:
            yield from self._by_neighbours(one)
            return
        yield from self._lost_part(one)
        yield from self._scale(one)
        yield from self._elsewhere(one)
        yield from self._shift(one)

    def _is_black(self, one: _Suspect) -> bool:
        """Whether a shot is as even, and as dark, as a sensor without light."""
        count = self._check.noise.variance.size
        light = one.predicted if one.predicted is not None else self._total / count
        if count == 1 and self._bad[one.pattern]:
            return True
        dark = float(self._check.manifest.digital.variance(0.0))
        spread, expected = float(one.raw.var()) - dark, float(light.var())
        return bool(spread < _DARK**2 * expected + dark and one.raw.mean() < _DARK * abs(light.mean()) + np.sqrt(dark))

    def _by_neighbours(self, one: _Suspect) -> Iterable[_Named]:
        check = self._check
        if not check.exclusive:
            return
        payload = self._weights[self._model.places(one.pattern)]
        ratio = float(np.vdot(self._model.weights(one.frame, one.pattern), payload)) / max(
            sum_of_squares(payload), 1e-300
        )
        fault = Fault.DIM if ratio < 1 else Fault.BRIGHT
        words = f"holds {ratio:.2f} of the light that its neighbours' pixels tell"
        yield _Named(-np.inf, fault, one.numbers, words)

    def _scale(self, one: _Suspect) -> Iterable[_Named]:
        if one.predicted is None:
            return
        ratio = float(np.vdot(one.frame, one.predicted)) / max(sum_of_squares(one.predicted), 1e-300)
        left = sum_of_squares(one.frame - ratio * one.predicted) - one.frame.size * one.variance
        if ratio > 0 and not self._check.signed:
            ratio, left = self._least_scale(one, ratio)
        if ratio > 0:
            fault = Fault.DIM if ratio < 1 else Fault.BRIGHT
            yield _Named(left, fault, one.numbers, f"holds {ratio:.2f} of the light that the other frames tell")

    def _least_scale(self, one: _Suspect, start: float) -> tuple[float, float]:
        """The part of its light that a frame has, and what it leaves divided by that."""

        def rest(ratio: float) -> float:
            return self._beyond({one.pattern: one.frame / ratio}, one.variance / ratio**2) * ratio**2

        found = minimize_scalar(rest, bounds=(0.3 * start, min(3 * start, 10.0)), method="bounded")
        return float(found.x), float(found.fun)

    def _lost_part(self, one: _Suspect) -> Iterable[_Named]:
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
            if one.predicted is None or self._check.signed:
                window = (kept, slice(None)) if axis == 0 else (slice(None), kept)
                # The noise of a frame is that of its mean light, which what is lost makes too little.
                variance = max(one.variance, float(self._check.noise.of(float(one.raw[window].mean()), 1)))
                left = self._part_left(one, window, window, variance)
            else:
                left = self._energy_filled(one, one.raw, kept[:, None] if axis == 0 else kept[None, :])
            yield _Named(left, Fault.HALF_LOST, one.numbers, f"has no light in sensor {name} {first} to {last - 1}")

    def _elsewhere(self, one: _Suspect) -> Iterable[_Named]:
        """Another pattern than that of its place: of all patterns under dots, else of those that are suspected."""
        check = self._check
        if one.predicted is None:
            others = [other for other in np.ndindex(check.noise.variance.shape) if other != one.pattern]
            if not others:
                return
            left, best = min((self._outside(one.frame, other, one.variance), other) for other in others)
            yield self._of_pattern(left, one, check.number[(*best, 0)])
            return
        for other in self._bad:
            if other == one.pattern:
                continue
            if not check.signed:  # of two that are suspected each may be the other's
                there = self._model.as_solved(self._measured[other].frame)
                yield self._of_pattern(self._exchange_energy(one, other, there), one, check.number[(*other, 0)])
                continue
            each = self._measured[other]
            for sign in (1, -1):  # the other half of that pattern tells this one
                partner = (each.light - sign * each.frame) / 2
                mean = one.predicted + (self._measured[one.pattern].light - one.raw)
                left = sum_of_squares(one.frame - (mean - partner)) - one.frame.size * one.variance
                yield self._of_pattern(left, one, check.number[(*other, sign)])

    def _exchange_energy(self, one: _Suspect, other: Pattern, there: FloatArray) -> float:
        """Energy of :attr:`_Suspect.off` that is left when a frame and that of an ``other`` pattern, ``there``, are
        exchanged."""
        variance = (one.variance + float(self._check.noise.variance[other])) / 2
        own = self._beyond({one.pattern: one.frame, other: there}, variance)
        left = self._beyond({one.pattern: there, other: one.frame}, variance)
        return left / own * one.off if own > 0 else np.inf

    def _of_pattern(self, left: float, one: _Suspect, *place: int) -> _Named:
        words = f"{'hold' if len(place) > 1 else 'holds'} the light of the pattern of frame {place[0]}"
        return _Named(left, Fault.MISPLACED, one.numbers, words, place)

    def _exchange(self, one: _Suspect) -> Iterable[_Named]:
        """Both halves of signed patterns: the two exchanged, or those of another pattern."""
        yield _Named(self._beyond({one.pattern: -one.frame}, one.variance), Fault.SWAPPED, one.numbers, "are exchanged")
        for other in self._bad:
            if other != one.pattern:
                there = self._model.as_solved(self._measured[other].frame)
                left = self._exchange_energy(one, other, there)
                yield self._of_pattern(left, one, *(self._check.number[(*other, sign)] for sign in (1, -1)))

    def _shift(self, one: _Suspect) -> Iterable[_Named]:
        """Moved over the sensor by whole pixels."""
        reach = min(_REACH, *(side // 8 for side in one.frame.shape))
        if reach < 1:
            return
        shift = (
            self._by_range(one, reach) if one.predicted is None else _correlation_shift(one.frame, one.predicted, reach)
        )
        if shift == (0, 0):
            return
        if one.predicted is not None and not self._check.signed:
            # Frames of a smooth mask correlate beside their shift: from there on it is what leaves least.
            left, (rows, columns) = self._put_back(one, shift), shift
            for _ in range(reach):
                beside = [(rows + down, columns + across) for down in (-1, 0, 1) for across in (-1, 0, 1)]
                within = [each for each in beside if each != (rows, columns) and max(map(abs, each)) <= reach]
                best, place = min((self._put_back(one, each), each) for each in within)
                if best >= left:
                    break
                left, (rows, columns) = best, place
            if (rows, columns) != (0, 0):
                yield _shift_fault(one, left, rows, columns)
            return
        ends = tuple(slice(reach + step, size - reach + step) for step, size in zip(shift, one.raw.shape, strict=True))
        still = tuple(slice(reach, size - reach) for size in one.raw.shape)
        moved, unmoved = (self._part_left(one, window, still, one.variance) for window in (ends, still))
        if unmoved > 0:
            yield _shift_fault(one, moved / unmoved * one.off, *shift)

    def _put_back(self, one: _Suspect, shift: tuple[int, int]) -> float:
        """Energy beyond noise that a frame leaves that is moved back by a ``shift``, rows and columns."""
        known = [np.zeros(size, dtype=np.bool_) for size in one.raw.shape]
        for line, step in zip(known, shift, strict=True):
            line[max(-step, 0) : len(line) - max(step, 0)] = True
        return self._energy_filled(one, np.roll(one.raw, (-shift[0], -shift[1]), (0, 1)), np.outer(*known))

    def _by_range(self, one: _Suspect, reach: int) -> tuple[int, int]:
        """The shift that puts most of a frame into the range of its pattern: of rows, then of columns, as a shift along
        one side of the sensor does not move the other's range."""
        still = [slice(reach, size - reach) for size in one.raw.shape]
        found = []
        for axis, basis in enumerate(self._ranges(one.pattern, *still)):
            frame = one.raw if axis == 0 else one.raw.T
            parts = {}
            for step in range(-reach, reach + 1):
                lines = frame[reach + step : len(frame) - reach + step]
                parts[step] = sum_of_squares(basis.T @ lines) / max(sum_of_squares(lines), 1e-300)
            found.append(max(parts, key=lambda step: (parts[step], -abs(step))))
        return found[0], found[1]

    # ---- frames that go together

    def _repeats(self, seen: list[_Suspect]) -> dict[tuple[int, ...], list[_Named]]:
        """Shots that are equal to another, but for noise."""
        check = self._check
        found: dict[tuple[int, ...], list[_Named]] = {}
        for each in check.data.measurements_again():
            pattern = each.row, each.column
            signs = (1, -1) if each.shots == 2 else (0,)
            variance = float(check.noise.variance[pattern])
            for sign in signs:
                shot = (each.light + sign * each.frame) / 2 if sign else each.frame
                number = check.number[(*pattern, sign)]
                for one in seen:
                    if len(one.numbers) > 1 or number in one.numbers:
                        continue
                    apart = sum_of_squares(one.raw - shot)
                    beyond = apart - shot.size * (one.variance + variance / len(signs))
                    if apart < _ROUNDING * sum_of_squares(shot):
                        beyond = -np.inf
                    if beyond < 0.5 * _EXPLAINS * one.off and beyond < CHANCE * one.variance * np.sqrt(8 * shot.size):
                        words = f"repeats frame {number} ({check.shots[number].file})"
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
                yield self._check.fault(Fault.SWAPPED, (*pair.numbers, *pair.place), "are exchanged")
            else:
                yield self._check.fault(best.fault, best.numbers, best.words)


def _shift_fault(one: _Suspect, left: float, rows: int, columns: int) -> _Named:
    words = f"is shifted by {rows} rows and {columns} columns of the sensor"
    return _Named(left, Fault.SHIFTED, one.numbers, words)


def _correlation_shift(frame: FloatArray, predicted: FloatArray, reach: int) -> tuple[int, int]:
    """The shift (rows, columns) by which ``frame`` is most like what was ``predicted``, up to ``reach``."""
    shape = [fft.next_fast_len(size + reach) for size in frame.shape]
    spectra = [fft.rfft2(values - values.mean(), shape) for values in (frame, predicted)]
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
