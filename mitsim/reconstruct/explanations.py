"""Frames that are suspected in; the fault of each out that explains what it is off by.

A fault is named that leaves a small part of it, or noise alone, and is likelier than chance by far.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy import fft
from scipy.optimize import minimize_scalar

from mitsim.core.arrays import FloatArray, sum_of_squares
from mitsim.reconstruct.framefault import Fault, FrameFault
from mitsim.reconstruct.leaveoneout import CHANCE, BoolArray, Pattern
from mitsim.reconstruct.suspects import EXPLAINS, LEFT, Seen, Suspects

_LIKELY = 60.0
"""Variances of a datum that a fault must explain, twice the logarithm of a likelihood ratio of 1e13: some of them are
searched for among 10^4."""
_OTHERS = 0.05
"""Of what a frame is off by, the most that all others may be that no fault explains: of two cards beside the calibrated
distance, which turn the sign of patterns that they move by half a period, others are off by a sixth."""
_FORETOLD = Fault.SWAPPED, Fault.MISPLACED, Fault.DIM, Fault.BRIGHT, Fault.SHIFTED
"""Faults that are told by what the other frames foretell alone, and so where the scene fits."""
_DARK = 0.1
"""Of the light that is foretold, below which a frame or a row of it is black."""
_LEAST_LOST = 0.02
"""Part of a frame's rows, or columns, that are lost before it is said; a dead line is less."""
_REACH = 24
"""Sensor pixels that frames are moved by in search of a shift."""
_ROUNDING = 1e-20
"""Of a frame's energy, by which the halves of two pairs differ that were the same numbers."""


class _Named(NamedTuple):
    """A ``fault`` of the frames of some ``numbers``, in ``words``; what it leaves of what they are off by, and
    the ``place`` whose light they hold."""

    left: float
    fault: Fault
    numbers: tuple[int, ...]
    words: str
    place: tuple[int, ...] = ()


class Explanations(Suspects):
    """Faults of patterns that are suspected."""

    def faults(self, others_off: float) -> list[FrameFault]:
        """One for each that is found; ``others_off`` is the energy beyond noise by which patterns are off that are not
        suspected."""
        check = self._check
        seen = self._signed() if check.signed else [self._plain(pattern) for pattern in self._bad]
        repeats = self._repeats(seen)
        explained: list[list[_Named]] = []
        for one in seen:
            same = [each for each in repeats.get(one.numbers, []) if each.left == -np.inf]
            chance = LEFT * one.variance * np.sqrt(2 * one.frame.size)
            fits = [
                each
                for each in (*same, *self._tried(one))
                if each.left <= max(EXPLAINS * one.off, chance) and one.off - each.left > _LIKELY * one.variance
            ]
            explained.append(sorted(fits, key=lambda each: each.left))
        others_off += sum(max(one.off, 0.0) for one, fits in zip(seen, explained, strict=True) if not fits)
        named = [
            [
                each
                for each in fits
                if each.fault not in _FORETOLD or others_off <= _OTHERS * one.off or each.left == -np.inf
            ]
            or repeats.get(one.numbers, [])[:1]
            for one, fits in zip(seen, explained, strict=True)
        ]
        return list(self._pairs(named))

    # ---- what explains it

    def _tried(self, one: Seen) -> Iterable[_Named]:
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

    def _is_black(self, one: Seen) -> bool:
        """Whether a shot is as even, and as dark, as a sensor without light."""
        count = self._check.noise.variance.size
        light = one.foretold if one.foretold is not None else self._total / count
        if count == 1 and self._bad[one.pattern]:
            return True
        dark = float(self._check.manifest.digital.variance(0.0))
        spread, expected = float(one.raw.var()) - dark, float(light.var())
        return bool(spread < _DARK**2 * expected + dark and one.raw.mean() < _DARK * abs(light.mean()) + np.sqrt(dark))

    def _by_neighbours(self, one: Seen) -> Iterable[_Named]:
        check = self._check
        if not check.exclusive:
            return
        told = self._weights[check.columns(*one.pattern)]
        ratio = float(np.vdot(check.projected(one.frame, *one.pattern), told)) / max(sum_of_squares(told), 1e-300)
        fault = Fault.DIM if ratio < 1 else Fault.BRIGHT
        words = f"holds {ratio:.2f} of the light that its neighbours' pixels tell"
        yield _Named(-np.inf, fault, one.numbers, words)

    def _scaled(self, one: Seen) -> Iterable[_Named]:
        if one.foretold is None:
            return
        ratio = float(np.vdot(one.frame, one.foretold)) / max(sum_of_squares(one.foretold), 1e-300)
        left = sum_of_squares(one.frame - ratio * one.foretold) - one.frame.size * one.variance
        if ratio > 0 and not self._check.signed:
            ratio, left = self._least_scale(one, ratio)
        if ratio > 0:
            fault = Fault.DIM if ratio < 1 else Fault.BRIGHT
            yield _Named(left, fault, one.numbers, f"holds {ratio:.2f} of the light that the other frames tell")

    def _least_scale(self, one: Seen, start: float) -> tuple[float, float]:
        """The part of its light that a frame has, and what it leaves divided by that."""

        def left(ratio: float) -> float:
            return self._beyond({one.pattern: one.frame / ratio}, one.variance / ratio**2) * ratio**2

        found = minimize_scalar(left, bounds=(0.3 * start, min(3 * start, 10.0)), method="bounded")
        return float(found.x), float(found.fun)

    def _part_lost(self, one: Seen) -> Iterable[_Named]:
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
            if one.foretold is None or self._check.signed:
                left = self._outside_of_part(one, kept, axis)
            else:
                left = self._filled(one, one.raw, kept[:, None] if axis == 0 else kept[None, :])
            yield _Named(left, Fault.HALF_LOST, one.numbers, f"has no light in sensor {name} {first} to {last - 1}")

    def _elsewhere(self, one: Seen) -> Iterable[_Named]:
        """Another pattern than that of its place: of all patterns under dots, else of those that are suspected."""
        check = self._check
        if one.foretold is None:
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
                there = check.as_solved(self._measured[other].frame)
                yield self._of_pattern(self._crossed(one, other, there), one, check.number[(*other, 0)])
                continue
            each = self._measured[other]
            for sign in (1, -1):  # the other half of that pattern tells this one
                partner = (each.light - sign * each.frame) / 2
                mean = one.foretold + self._partner(one)
                left = sum_of_squares(one.frame - (mean - partner)) - one.frame.size * one.variance
                yield self._of_pattern(left, one, check.number[(*other, sign)])

    def _crossed(self, one: Seen, other: Pattern, there: FloatArray) -> float:
        """Energy of :attr:`Seen.off` that is left when a frame and that of an ``other`` pattern, ``there``, are
        exchanged."""
        variance = (one.variance + float(self._check.noise.variance[other])) / 2
        own = self._beyond({one.pattern: one.frame, other: there}, variance)
        left = self._beyond({one.pattern: there, other: one.frame}, variance)
        return left / own * one.off if own > 0 else np.inf

    def _partner(self, one: Seen) -> FloatArray:
        """The other half of a signed pattern's shot."""
        return np.asarray(self._measured[one.pattern].light - one.raw)

    def _of_pattern(self, left: float, one: Seen, *place: int) -> _Named:
        words = f"{'hold' if len(place) > 1 else 'holds'} the light of the pattern of frame {place[0]}"
        return _Named(left, Fault.MISPLACED, one.numbers, words, place)

    def _exchanged(self, one: Seen) -> Iterable[_Named]:
        """Both halves of signed patterns: the two exchanged, or those of another pattern."""
        if one.foretold is None:
            return
        yield _Named(self._beyond({one.pattern: -one.frame}, one.variance), Fault.SWAPPED, one.numbers, "are exchanged")
        for other in self._bad:
            if other != one.pattern:
                there = self._check.as_solved(self._measured[other].frame)
                left = self._crossed(one, other, there)
                yield self._of_pattern(left, one, *(self._check.number[(*other, sign)] for sign in (1, -1)))

    def _moved(self, one: Seen) -> Iterable[_Named]:
        """Moved over the sensor by whole pixels."""
        reach = min(_REACH, *(side // 8 for side in one.frame.shape))
        if reach < 1:
            return
        shift = self._by_range(one, reach) if one.foretold is None else _correlated(one.frame, one.foretold, reach)
        if shift == (0, 0):
            return
        if one.foretold is not None and not self._check.signed:
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

    def _put_back(self, one: Seen, shift: tuple[int, int]) -> float:
        """Energy beyond noise that a frame leaves that is moved back by a ``shift``, rows and columns."""
        known = [np.zeros(size, dtype=np.bool_) for size in one.raw.shape]
        for line, step in zip(known, shift, strict=True):
            line[max(-step, 0) : len(line) - max(step, 0)] = True
        return self._filled(one, np.roll(one.raw, (-shift[0], -shift[1]), (0, 1)), np.outer(*known))

    def _by_range(self, one: Seen, reach: int) -> tuple[int, int]:
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

    def _repeats(self, seen: list[Seen]) -> dict[tuple[int, ...], list[_Named]]:
        """Shots that are equal to another, but for noise."""
        check = self._check
        found: dict[tuple[int, ...], list[_Named]] = {}
        for each in check.measured():
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
                    if beyond < 0.5 * EXPLAINS * one.off and beyond < CHANCE * one.variance * np.sqrt(8 * shot.size):
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
