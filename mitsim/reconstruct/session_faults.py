"""Sums over a calibration session's responses in; frames that are not what they should be, and sums without them, out.

Three things hold for every good session, whatever the camera: the two frames of a pair add up to one frame for all
patterns (:class:`Pairs`), the lamp is one lamp (:mod:`mitsim.reconstruct.session_lamp`), and columns of a factor are
one mask's moving shadow (:mod:`mitsim.reconstruct.session_side`).

The two frames of a pair add up to one frame for all patterns, so that a frame which is black, dim, half lost, a repeat,
shifted or clipped shows in the sum. What the sums share is the lamp's power, in the order of the session.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.devices.session import SIDES, Half, Side
from mitsim.reconstruct.estimate_factors import Estimate, PairLight, StripeSums, factors_of_sums
from mitsim.reconstruct.session_lamp import MATTERS, Lamp, end_to_end, flickers, lamp_of_frames, trend_of
from mitsim.reconstruct.session_side import (
    DARK,
    MOST_FAULTS,
    SessionFault,
    SideCheck,
    frame_words,
    name_by_light,
    robust_scatter,
    too_many,
)

# ---- Pairs of frames, which add up to one frame for all patterns -----------------------------------------------------


_DEVIATIONS = 8.0
"""Deviations from the rest, by their own robust scatter, that make a fault: noise alone goes so far in one session of
10^12."""
_LEAST = 2e-3
"""Change of a pair's light that counts: that of one frame by 0.4 %, which costs less than most sessions' noise."""
_EXCESS = 2.0
"""Squared deviation of a pair's sum, over that of the others, that counts at least."""
_OUT_OF_STEP = 0.05
"""Scatter of the sums of frames and their other neighbours, over that of pairs' sums, below which frames are one step
out of order: 0.7 and more in 48 sides that are in order, whatever their faults, noise alone where they are not."""
_TURNS = 3
"""Steps in which noise and flicker, which hang on each other, are found: a fourth changes no digit."""
_ROUNDING = 1e-6
"""Part of the light that counts as noise at least: rounding of sums of single frames leaves 1e-12, of pairs of factors
in single precision 1e-7."""
_RANDOM = 2 / 3
"""Variance of a pair's difference, in squared steps, that noise of half a step and rounding make: with more the mean of
rounding is 0 within 1 %."""
_LINEAR = 0.02
"""Deviation of a pair's sum, rms, as a part of its light, that a camera may make which is not linear: where no fault's
name explains it, none is said. A linearity of 0.03 makes 0.5 % in most pairs, 1 % in uniform ones."""
_EXPLAINED = 0.05
"""Part of a faulty frame's squared deviation that the fault's name may leave unexplained."""
_SHIFTS = 8
"""Rows or columns by which a frame is tried to be shifted."""
_FITS = 4.0
"""Mean squared deviation, in that of a good pair's sum, up to which a name fits."""
_BOTH = 36.0
"""Squared deviation of a frame's light from the usual, in four times its robust scatter, that makes it no frame to
predict the other by."""


@dataclass(frozen=True)
class SessionConditions:
    """How a session was taken.

    Attributes
    ----------
    order
        frames as they were taken.
    name
        of a frame.
    clipped
        whether many of a frame's pixels share its largest number.
    saturated
        whether frames have saturated pixels, which make many pairs add up to less; those sessions are flagged for it,
        and not refused.
    unsteady
        whether it is stated that the lamp is, so that its power is neither divided out nor said.
    step
        between two numbers of a frame, as the responses have it.
    wrong
        frames that are known to be wrong, and why.
    """

    order: Sequence[Half]
    name: Callable[[Half], str] = frame_words
    clipped: Callable[[Half], bool] = lambda half: False
    saturated: bool = False
    unsteady: bool = False
    step: float = 0.0
    wrong: Mapping[Half, str] = field(default_factory=dict)


class _Frame(NamedTuple):
    """One frame of a session: the ``number`` of its side, 0 or 1, its ``pattern`` and its ``sign``."""

    number: int
    pattern: int
    sign: int

    @property
    def half(self) -> int:
        """Its place in its pair."""
        return 0 if self.sign > 0 else 1

    @property
    def other(self) -> _Frame:
        """The other frame of its pair."""
        return self._replace(sign=-self.sign)


class _Fault(NamedTuple):
    """What may be wrong with a frame, and the mean squared deviation that it leaves unexplained."""

    rest: float
    kind: str
    detail: str
    other: Half | None = None


_Parts = tuple[FloatArray, FloatArray, FloatArray]
"""What is known of one frame, in deviations of a pair's noise: means of its rows, of its columns, and its vector."""


class Pairs:
    """Pairs of both ``sides``, whose frames were ``taken`` in some order."""

    def __init__(self, sides: list[SideCheck], taken: SessionConditions) -> None:
        self.sides, self.taken, self.count = sides, taken, sides[0].sums.done
        self.pairs = [PairLight.together(own.sums.pairs) for own in sides]
        self.before = dict(zip(taken.order[1:], taken.order, strict=False))
        places = {half: place / max(len(taken.order) - 1, 1) for place, half in enumerate(taken.order)}
        self.times = np.array(
            [[places[own.side, index, sign] for sign in (1, -1)] for own in sides for index in range(self.count)]
        ).mean(axis=1)
        halves = [
            np.concatenate([np.hstack([own.rows[:, half], own.columns[:, half]]) for own in self.pairs])
            for half in (0, 1)
        ]
        both = halves[0] + halves[1]
        self.ambient_and_all = np.median(both, axis=0)
        self.common = self._uniform()
        # Of a pair, what its dark frame has of ambient light.
        light = float(self.ambient_and_all.sum())
        self.dark = (1 - float(self.common.sum()) / light) / 2 if light else 0.0
        # Ambient light is in every sum, and no part of the lamp's power.
        away = both - self.ambient_and_all
        self.power = 1 + away @ self.common / _square(self.common)
        self.trend, self.scatter, self.steady = trend_of(self.times, self.power)
        self.lights = [np.median(own.light, axis=1) for own in self.pairs]
        self.uniforms = [other.sums.common for other in reversed(sides)]
        rests = [away - (self.power - 1)[:, None] * self.common]
        differences = [_across(halves[0] - halves[1], self.common)]
        for own, pairs, middle, along in zip(sides, self.pairs, self.lights, self.uniforms, strict=True):
            rests.append(_across((pairs.light - middle[:, None]).T, along))
            differences.append(_across(own.sums.vectors.T, along))
        self.excess = self._find_noise(rests, differences)
        bad = self._find_bad()
        self.good = ~bad
        # A camera that is not linear by a percent makes sums that differ by its squares: no frame is wrong there.
        self.slight = self.excess * self.floor < _LINEAR**2 * np.square(self.ambient_and_all).mean()
        self.many = bool((bad & ~self.slight).sum() > max(2.0, MOST_FAULTS * len(bad)))

    def _find_noise(self, rests: list[FloatArray], differences: list[FloatArray]) -> FloatArray:
        """(2 N,) mean squared deviations of pairs' sums, over the noise, which is found with the lamp's flicker: of
        what is left of sums (``rests``) of both frames' means, and of either side's vectors, and of their
        ``differences``."""
        # Rounding of a pair's sum that no noise makes random is one for all its pixels of like light.
        step = self.taken.step
        alike = step / np.sqrt(6) if min(own.variance for own in self.sides) < _RANDOM * step**2 else 0.0
        rounding = max(_ROUNDING**2 * float(np.square(self.ambient_and_all).mean()), alike**2)
        shares = [float(np.abs(along).sum() / _square(along)) for along in self.uniforms]
        least = [rounding * share**2 for share in (1.0, *shares)]
        self.flicker, self.floor, self.light_noise = 0.0, 1.0, [1.0, 1.0]

        def unshaken() -> list[FloatArray]:
            levels = self.floor, *self.light_noise
            each = zip(rests, differences, levels, strict=True)
            return [_unshaken(rest, difference, self.flicker, noise) for rest, difference, noise in each]

        for _ in range(_TURNS):  # noise and flicker hang on each other
            self.floor, *self.light_noise = map(max, [float(np.median(each)) for each in unshaken()], least)
            # Means of rows and of columns share the frame's mean and its noise: twice independent ones' variance.
            self.noise = float(
                np.sqrt(2 * self.floor / _square(self.common) + alike**2 / np.square(self.common).mean())
            )
            self.flicker = float(np.sqrt(max(self.scatter**2 - self.noise**2, 0.0)))
            if not flickers(self.scatter, self.noise, len(self.power)):
                self.flicker = 0.0
                break
        of_means, *of_vectors = unshaken()
        vectors = [each / noise for each, noise in zip(of_vectors, self.light_noise, strict=True)]
        return np.maximum(of_means / self.floor, np.concatenate(vectors))

    def _find_bad(self) -> npt.NDArray[np.bool_]:
        """(2 N,) whether pairs differ from the others in power, or in what they add up to, or are known to be wrong."""
        middle = max(float(np.median(self.excess)), 1.0)
        scatter = robust_scatter(self.excess, middle)
        bad = np.abs(self.power - self.trend) > max(_DEVIATIONS * max(self.scatter, self.noise), _LEAST)
        bad |= self.excess > max(_EXCESS * middle, middle + _DEVIATIONS * scatter)
        known = {(side, index) for side, index, _ in self.taken.wrong}
        bad |= [(own.side, index) in known for own in self.sides for index in range(self.count)]
        return np.asarray(bad)

    def _uniform(self) -> FloatArray:
        """Means of rows and columns of the lamp's light: the response to the uniform pattern, of two that which differs
        less from all pairs' light, but for even ambient light."""
        found = []
        for own in self.pairs:
            light = np.concatenate([part[0, 0] - part[0, 1] for part in (own.rows, own.columns)])
            light = light if light.sum() >= 0 else -light
            found.append((float(np.std(light - self.ambient_and_all)), light))
        return min(found, key=lambda one: one[0])[1]

    def side_of(self, number: int, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Those of the ``values`` (2 N,) that belong to the side of a ``number``, 0 or 1."""
        return values[number * self.count : (number + 1) * self.count]

    def check(self, steady: bool = True) -> Lamp:
        """How steady the lamp is, where it should be ``steady``; MitsimError where too many pairs are wrong, or frames
        are out of step: where most pairs are wrong alike, they are what noise is found from, and none stands out."""
        for own, along in zip(self.sides, (self.pairs[0].rows, self.pairs[1].columns), strict=True):
            if _out_of_step(along):
                raise MitsimError(
                    f"the two frames of patterns of {own.side} stripes do not add up to what others do, but each frame "
                    "does with its other neighbour: frames are one step out of order; correct their names"
                )
        if self.many:
            raise MitsimError(
                f"the two frames of {int((~self.good).sum())} of {len(self.good)} patterns do not add up to what "
                "others do; check the order of the frames and what was shown, and take the session again"
            )
        return self._correct() if steady else Lamp()

    # ---- the lamp ----------------------------------------------------------------------------------------------------

    def _correct(self) -> Lamp:
        """How steady the lamp is; vectors are divided by its power where that matters."""
        good, mean = self.good, float(self.power[self.good].mean())
        powers, trend = self.power / mean, self.trend / mean
        # A pair's sum shares both frames' flicker.
        flicker = float(np.sqrt(2)) * self.flicker
        costs = []
        for number, own in enumerate(self.sides):
            inside = self.side_of(number, good)
            vectors = own.vectors[:, inside]
            size = max(float(np.sum(np.square(vectors))), 1e-300)
            moved = float(np.sum(np.square(vectors * (self.side_of(number, trend) - 1)[inside])))
            # Each frame's own power: half of it scales the response, half adds the uniform frame to it.
            added = inside.sum() * float(np.square(self.uniforms[number]).sum()) * self.flicker**2
            costs.append((moved / size, added / size + self.flicker**2, own.noise * self.count / size))
        moved, shaken, noise = (float(np.sqrt(np.sum(part))) for part in zip(*costs, strict=True))
        drifts = bool(np.ptp(trend) > _DEVIATIONS * self.steady and moved > MATTERS * noise)
        shakes = bool(flicker and shaken > MATTERS * noise)
        if not drifts and not shakes:
            return Lamp()
        used = powers if shakes else trend
        # The uniform response is the mean of both sides' first ones, which had a power of their own.
        scale = float(np.sqrt((used[0] + used[self.count]) / 2)) if good[0] and good[self.count] else 1.0
        remaining = 0.0
        for number, own in enumerate(self.sides):
            self._divide(number, own, self.side_of(number, used), flicker if shakes else 0.0)
            own.vectors = own.vectors * scale
            remaining += float(own.extras.sum() / np.sum(np.square(own.vectors)))
        drift, moved = (end_to_end(self.times, trend), moved) if drifts else (0.0, 0.0)
        flicker, shaken = (flicker, shaken) if shakes else (0.0, 0.0)
        return Lamp(drift, flicker, moved, shaken, float(np.sqrt(remaining)), corrected=True)

    def _divide(self, number: int, own: SideCheck, powers: FloatArray, flicker: float) -> None:
        """Divide a side's vectors by the power of their frames; what flicker leaves in them counts as their error.

        Y(+1) = (1 + d) g P and Y(-1) = (1 - d) g (U - P) add up to g (U + d u), which tells d by the vector u of the
        response, the better the longer that is; its least squares are taken with the flicker's own variance as prior.
        """
        pairs, uniform = self.pairs[number], self.uniforms[number]
        noise, whole = self.light_noise[number], float(np.dot(uniform, uniform))
        for index in np.flatnonzero(self.side_of(number, self.good)):
            vector = own.vectors[:, index] / float(powers[index])
            if index and flicker:
                rest = (pairs.light[:, index] - self.lights[number]) / float(powers[index])
                rest = rest - float(np.dot(rest, uniform)) / whole * uniform
                # The sum's power, which the response is divided by, has d times this share of the response in it.
                share = float(np.dot(vector, uniform)) / whole
                across = vector - share * uniform
                known = float(np.dot(across, across)) + 2 * noise / flicker**2
                half = float(np.dot(rest, across)) / known
                vector = vector * (1 + half * share) - half * uniform
                own.extras[index] += noise / known * whole
            own.change(int(index), vector)

    # ---- which frame of a pair is wrong

    def repair(self, lamp: Lamp) -> None:
        """Name the faulty frames of wrong pairs, and put what their pairs predict in the place of those; all that is
        right is divided by the power of the ``lamp`` where that is corrected for."""
        for place in np.flatnonzero(~self.good):
            self._repair(int(place // self.count), int(place % self.count), lamp)
        for number, (own, pairs) in enumerate(zip(self.sides, self.pairs, strict=True)):
            fluxes = pairs.rows.mean(axis=2)
            if self.good[number * self.count] and fluxes[0, 0] < fluxes[0, 1]:
                own.add(0, "exchanged", "in each other's place", "they count in their right order")

    def _measured_parts(self, frame: _Frame) -> _Parts:
        """A frame, in deviations of a pair's noise."""
        number, index, sign = frame
        pairs, scale = self.pairs[number], 1 / np.sqrt(self.floor)
        vector = (pairs.light[:, index] + sign * self.sides[number].sums.vectors[:, index]) / 2
        rows, columns = pairs.rows[index, frame.half] * scale, pairs.columns[index, frame.half] * scale
        return rows, columns, vector / np.sqrt(self.light_noise[number])

    def _predicted_parts(self, frame: _Frame) -> _Parts:
        """What the other frame of its pair predicts of a frame."""
        number, more = frame.number, self._power(frame) - 1
        rows, columns, vector = self._measured_parts(frame.other)
        both = (self.ambient_and_all + more * self.common) * (1 / np.sqrt(self.floor))
        light = (self.lights[number] + more * self.uniforms[number]) / np.sqrt(self.light_noise[number])
        return both[: len(rows)] - rows, both[len(rows) :] - columns, light - vector

    def _power(self, frame: _Frame) -> float:
        """The lamp's trend at a frame."""
        return float(self.side_of(frame.number, self.trend)[frame.pattern])

    def _flux(self, frame: _Frame) -> float:
        """Light of a frame over that of all light."""
        rows = self.pairs[frame.number].rows[frame.pattern, frame.half]
        whole = float((self.ambient_and_all + (self._power(frame) - 1) * self.common)[: rows.size].mean())
        return float(rows.mean() / whole) if whole else 0.0

    def _usual(self, number: int) -> tuple[float, float]:
        """The flux of half the light, and its robust deviation."""
        good = self.side_of(number, self.good)
        fluxes = [self._flux(_Frame(number, index, 1)) for index in range(1, self.count) if good[index]]
        middle = float(np.median(fluxes)) if fluxes else 0.5
        return middle, max(robust_scatter(np.array(fluxes), middle) if fluxes else 0.0, 1e-3)

    def _repair(self, number: int, index: int, lamp: Lamp) -> None:
        """Name the faulty frame of a pair, and take its vector from the other one."""
        own, (usual, deviation) = self.sides[number], self._usual(number)
        known = [sign for sign in (1, -1) if (own.side, index, sign) in self.taken.wrong]
        found = []
        for frame in (_Frame(number, index, 1), _Frame(number, index, -1)):
            right = usual if frame.sign < 0 else 1 - usual
            if index == 0:
                right = 1 - self.dark if frame.sign < 0 else self.dark
            penalty = ((self._flux(frame.other) - right) / (4 * deviation)) ** 2
            found.append((penalty, frame.sign, self._fault(frame)))
        found.sort(key=lambda one: (one[1] not in known, one[2].rest + one[0]))
        penalty, sign, fault = found[0]
        if known:
            fault = _Fault(0.0, "wrong", f"is wrong: {self.taken.wrong[own.side, index, sign]}")
        elif fault.kind == "wrong" and self.slight[number * self.count + index]:
            return
        own.uncounted.add(index)
        if len(known) == 2 or (not known and penalty > _BOTH and found[1][0] > _BOTH):
            if index:
                own.unknown.add(index)
            else:  # by definition, where it is the other side's that all vectors are projected on
                own.change(0, self.uniforms[number])
            detail = f"{fault.detail}, and the other frame of its pair is wrong too"
            own.add(index, fault.kind, detail, "both are left out", fault.other)
            return
        power = float(self.side_of(number, self.trend)[index])
        sound = (self.pairs[number].light[:, index] - sign * own.sums.vectors[:, index]) / 2
        both = self.lights[number] + (power - 1) * self.uniforms[number]
        corrected = power / float(self.power[self.good].mean()) if lamp.corrected else 1.0
        own.change(index, -sign * (2 * sound - both) / corrected)
        own.extras[index] += own.noise
        repair = "it is left out, and predicted by the other frame of its pair"
        own.add(index, fault.kind, fault.detail, repair, fault.other, sign)

    def _fault(self, frame: _Frame) -> _Fault:
        """The fault that leaves least of a frame unexplained, of those that explain it."""
        shown, expected = self._measured_parts(frame), self._predicted_parts(frame)
        seen, reported = np.concatenate(shown), np.concatenate(expected)
        size = float(np.dot(reported, reported))
        part = float(np.dot(seen, reported)) / size if size else 0.0
        flux = float(shown[0].sum() / expected[0].sum()) if expected[0].sum() else 0.0
        if frame.pattern == 0 and frame.sign < 0 and self.dark < DARK:
            flux = part = 1.0  # a dark frame of a dark room
        if self.taken.clipped((self.sides[frame.number].side, frame.pattern, frame.sign)) and flux > DARK:
            return _Fault(1.0, "clipped", "is clipped: many of its pixels share its largest number")
        even = (np.ptp(own) < DARK * 2 * np.ptp(other) + 12 for own, other in zip(shown, expected, strict=True))
        if flux < DARK and all(even):
            return _Fault(1.0, "black", "is black")
        tried = [_Fault(float(np.square(seen - part * reported).mean()), *name_by_light(part))]
        tried += [*_losses(shown, expected), *self._repeats(frame, shown), *_shifts(frame.number, shown, expected)]
        best = min(tried, key=lambda fault: fault.rest)
        if best.rest > max(_FITS, _EXPLAINED * float(np.square(seen - reported).mean())):
            return _Fault(best.rest, "wrong", "is not what the other frame of its pair foretells")
        return best

    def _repeats(self, frame: _Frame, shown: _Parts) -> Iterator[_Fault]:
        """Other frames that it equals."""
        number, index, sign = frame
        scale = 1 / np.sqrt(self.floor)
        before = self.before.get((self.sides[number].side, index, sign))
        for place, (own, pairs) in enumerate(zip(self.sides, self.pairs, strict=True)):
            for half, signed in ((0, 1), (1, -1)):
                away = np.square(pairs.rows[:, half] * scale - shown[0]).sum(axis=1)
                away += np.square(pairs.columns[:, half] * scale - shown[1]).sum(axis=1)
                numbers = len(shown[0]) + len(shown[1])
                if place == number:
                    vectors = (pairs.light + signed * own.sums.vectors) / 2 / np.sqrt(self.light_noise[number])
                    away += np.square(vectors - shown[2][:, None]).sum(axis=0)
                    numbers += len(shown[2])
                    if signed == sign:
                        away[index] = np.inf
                else:
                    away[np.arange(self.count) != (before[1] if before and before[0] == own.side else -1)] = np.inf
                if signed < 0:
                    away[0] = np.inf  # dark, as a black frame is
                nearest = int(np.argmin(away))
                other: Half = (own.side, nearest, signed)
                yield _Fault(float(away[nearest]) / numbers, "repeated", f"repeats {frame_words(other)}", other)


def _losses(shown: _Parts, expected: _Parts) -> Iterator[_Fault]:
    """A frame that ends early or begins late, along its rows or columns."""
    for seen, whole, word in zip(shown, expected, ("rows", "columns"), strict=False):
        missing, there = (np.insert(np.cumsum(np.square(each)), 0, 0.0) for each in (seen, seen - whole))
        missing_after, there_after = (
            np.append(np.cumsum(np.square(each)[::-1])[::-1], 0.0) for each in (seen, seen - whole)
        )
        for cost, first in ((there + missing_after, False), (missing + there_after, True)):
            cut = int(np.argmin(cost[1:-1])) + 1
            lost = (cut if first else len(seen) - cut) / len(seen)
            detail = f"lost its {'first' if first else 'last'} {word}, {lost:.0%} of them"
            yield _Fault(float(cost[cut]) / len(seen), "half lost", detail)


def _shifts(number: int, shown: _Parts, expected: _Parts) -> Iterator[_Fault]:
    """A frame, of the side of a ``number``, that is moved by some rows or columns."""
    vector, whole = shown[2], expected[2]
    for axis, word in ((0, "rows"), (1, "columns")):
        length = len(shown[axis])
        if length < 4 * _SHIFTS:
            continue
        inner = slice(_SHIFTS, length - _SHIFTS)
        still = np.square(shown[1 - axis] - expected[1 - axis])
        # Across its stripes a frame's vector moves; along them it becomes shorter.
        part = float(np.dot(vector, whole)) / max(float(np.dot(whole, whole)), 1e-300)
        third = np.square(vector - part * whole)
        for shift in (*range(-_SHIFTS, 0), *range(1, _SHIFTS + 1)):
            moved = np.square(shown[axis] - np.roll(expected[axis], shift))[inner]
            if axis == number and len(vector) == length:
                third = np.square(vector - np.roll(whole, shift))[inner]
            rest = float(np.concatenate([moved, still, third]).mean())
            yield _Fault(rest, "shifted", f"is shifted by {abs(shift)} of its {word}")


def _out_of_step(along: FloatArray) -> bool:
    """Whether most frames of a side, whose means ``along`` its factor are (N, 2, pixels), add up to the same with the
    neighbour that is of another pattern, and with the other one of their pair do not."""
    next_one, this = along[:-1, 1] + along[1:, 0], along[:, 0] + along[:, 1]
    apart = [float(np.median(np.square(each - np.median(each, axis=0)).mean(axis=1))) for each in (next_one, this)]
    # Two patterns have a single such sum, which is its own median.
    return len(along) > 2 and apart[0] < _OUT_OF_STEP * apart[1]


def _square(vector: FloatArray) -> float:
    """Squared length of a ``vector`` that is divided by."""
    return max(float(np.dot(vector, vector)), 1e-300)


def _across(values: FloatArray, along: FloatArray) -> FloatArray:
    """``values`` (pairs, numbers) without their parts ``along`` a vector."""
    return values - np.outer(values @ along / _square(along), along)


def _unshaken(rests: FloatArray, differences: FloatArray, flicker: float, noise: float) -> FloatArray:
    """(pairs,) mean squared ``rests`` (pairs, numbers) of sums, less what flicker makes of the two frames'
    ``differences`` (pairs, numbers): d of it, whose deviation is the ``flicker``, at a variance ``noise`` a number."""
    squared = np.square(rests).sum(axis=1)
    if flicker:
        weight = noise / flicker**2
        along = np.einsum("ij,ij->i", rests, differences)
        squared = squared - np.square(along) / (np.square(differences).sum(axis=1) + weight)
    return np.asarray(squared / rests.shape[1])


# ---- A session that is checked ---------------------------------------------------------------------------------------


@dataclass
class CheckedSession:
    """Sums of a session as they can be believed.

    Attributes
    ----------
    sums
        of horizontal and vertical stripes, faults repaired; the very ones that came in where there is none.
    faults
        in the order of the sides and patterns.
    lamp
        how steady it is.
    left_out
        responses of each side whose misfit is not counted.
    extra
        squared error of each side's vectors beyond their noise.
    """

    sums: tuple[StripeSums, StripeSums]
    faults: list[SessionFault] = field(default_factory=list)
    lamp: Lamp = field(default_factory=Lamp)
    left_out: tuple[int, int] = (0, 0)
    extra: tuple[float, float] = (0.0, 0.0)

    def right_uniform(self) -> Side | None:
        """Where the first response of a side is wrong, which the uniform one is taken from, the other side; None where
        none is wrong, MitsimError where both are."""
        wrong = {fault.side for fault in self.faults if fault.index == 0}
        right = [side for side in SIDES if side not in wrong]
        if not right:
            raise MitsimError(
                "the uniform frames of horizontal and of vertical stripes, number 0 of each, are both wrong; take them "
                "again"
            )
        return right[0] if wrong else None

    def estimate(self, signs: FloatArray, noise: float | None) -> Estimate:
        """Factors of what can be believed.

        Parameters
        ----------
        signs
            (n, N) H.
        noise
            as ``stated_noise`` of :func:`mitsim.reconstruct.estimate_factors.factors_of_sums`.
        """
        return factors_of_sums(*self.sums, signs, noise, self.left_out, self.extra)

    def warnings(self, name: Callable[[Half], str]) -> tuple[str, ...]:
        """A sentence for each fault; ``name`` says which frame it is."""
        return (*(fault.words(name) for fault in self.faults), *self.lamp.warnings())

    def faults_for_manifest(self, name: Callable[[Half], str]) -> list[dict[str, Any]]:
        """Faults for a manifest; ``name`` says which frame it is."""
        return [fault.for_manifest(name) for fault in self.faults]


def check_session(
    sums: tuple[StripeSums, StripeSums], signs: FloatArray, taken: SessionConditions, uniform_given: bool = False
) -> CheckedSession:
    """What of a session can be believed.

    Parameters
    ----------
    sums
        of horizontal and of vertical stripes, all in.
    signs
        (n, N) H.
    taken
        how.
    uniform_given
        whether the sums were made with the uniform response of a side that is right. If not, and one of the two is
        wrong, nothing else is judged.

    Raises
    ------
    MitsimError
        where too many frames are wrong.
    """
    work = [SideCheck(own, signs) for own in sums]
    lamp = Lamp()
    if all(own.pairs for own in work):
        pairs = Pairs(work, taken)
        if taken.saturated and pairs.many:
            return CheckedSession(sums)
        lamp = pairs.check(not taken.unsteady)
        pairs.repair(lamp)
    else:
        for own in work:
            own.leave_out_known(taken.wrong)
    at_first = [fault for own in work for fault in own.faults if fault.index == 0]
    if at_first and not uniform_given:
        return CheckedSession(sums, at_first)
    if not taken.unsteady and all(own.enough and not own.pairs for own in work):
        lamp = lamp_of_frames(work, taken.order, taken.step)
    for own in work:
        own.check(taken.unsteady, taken.name)
    faults = [
        replace(fault, cost=float(np.sqrt(own.extras[fault.index] / max(np.square(own.vectors).sum(), 1e-300))))
        for own in work
        for fault in own.faults
    ]
    count = signs.shape[1]
    patterns = {(fault.side, fault.index) for fault in faults}
    if too_many(len(patterns), count):
        first = faults[0]
        raise MitsimError(
            f"{len(patterns)} of {2 * count} patterns are not what they should be, too many to leave out; the first, "
            f"{first.side} stripes {first.index}: {first.detail}; check the frames' order, and take them again"
        )
    return CheckedSession(
        (work[0].result(), work[1].result()),
        faults,
        lamp,
        (len(work[0].uncounted), len(work[1].uncounted)),
        (float(work[0].extras.sum()), float(work[1].extras.sum())),
    )
