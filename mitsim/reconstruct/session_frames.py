"""A pair whose frames do not add up as others do in; which of the two is wrong, and what the other foretells, out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.devices.session import Half
from mitsim.reconstruct.session_findings import DARK, Lamp, SessionFault, dimmed, frame_words
from mitsim.reconstruct.session_pairs import Pairs
from mitsim.reconstruct.session_side import SideCheck

_EXPLAINED = 0.05
"""Part of a faulty frame's squared deviation that the fault's name may leave unexplained."""
_SHIFTS = 8
"""Rows or columns by which a frame is tried to be shifted."""
_FITS = 4.0
"""Mean squared deviation, in that of a good pair's sum, up to which a name fits."""
_BOTH = 36.0
"""Squared deviation of a frame's light from the usual, in four times its robust scatter, that makes it no frame to
foretell the other by."""


@dataclass(frozen=True, eq=False)
class _Shown:
    """What is known of one frame, in deviations of a pair's noise: ``parts`` are means of its rows, of its columns, and
    its vector."""

    parts: tuple[FloatArray, FloatArray, FloatArray]

    @property
    def all(self) -> FloatArray:
        return np.concatenate(self.parts)


class WrongPairs:
    """Those of a ``session``'s pairs that are wrong."""

    def __init__(self, session: Pairs) -> None:
        """Of a ``session`` whose lamp is known."""
        self.session = session

    def repair(self, lamp: Lamp) -> None:
        """Name their faulty frames, and put what their pairs foretell in the place of those; all that is right is
        divided by the power of the ``lamp`` where that is corrected for."""
        for place in np.flatnonzero(~self.session.good):
            self._repair(
                self.session.sides[place // self.session.count],
                int(place // self.session.count),
                int(place % self.session.count),
                lamp,
            )
        for number, (own, pairs) in enumerate(zip(self.session.sides, self.session.pairs, strict=True)):
            fluxes = pairs.rows.mean(axis=2)
            if self.session.good[number * self.session.count] and fluxes[0, 0] < fluxes[0, 1]:
                own.faults.append(
                    SessionFault(
                        own.side,
                        0,
                        None,
                        "exchanged",
                        "in each other's place",
                        "they count in their right order",
                    )
                )

    def _shown(self, number: int, index: int, sign: int) -> _Shown:
        """A frame, in deviations of a pair's noise."""
        own, pairs = self.session.sides[number].sums, self.session.pairs[number]
        vector = (pairs.light[:, index] + (1 if sign > 0 else -1) * own.vectors[:, index]) / 2
        half = 0 if sign > 0 else 1
        scale = 1 / np.sqrt(self.session.floor)
        return _Shown(
            (
                pairs.rows[index, half] * scale,
                pairs.columns[index, half] * scale,
                vector / np.sqrt(self.session.light_noise[number]),
            )
        )

    def _expected(self, number: int, index: int, sign: int) -> _Shown:
        """What the other frame of its pair foretells of a frame."""
        more = float(self.session.side_of(number, self.session.trend)[index]) - 1
        other = self._shown(number, index, -sign).parts
        rows = len(other[0])
        scale = 1 / np.sqrt(self.session.floor)
        both = (self.session.ambient_and_all + more * self.session.common) * scale
        vector = (self.session.lights[number] + more * self.session.uniforms[number]) / np.sqrt(
            self.session.light_noise[number]
        )
        return _Shown((both[:rows] - other[0], both[rows:] - other[1], vector - other[2]))

    def _flux(self, number: int, index: int, sign: int) -> float:
        """Light of a frame over that of all light."""
        more = float(self.session.side_of(number, self.session.trend)[index]) - 1
        rows = self.session.pairs[number].rows[index, 0 if sign > 0 else 1]
        whole = float((self.session.ambient_and_all + more * self.session.common)[: rows.size].mean())
        return float(rows.mean() / whole) if whole else 0.0

    def _usual(self, number: int) -> tuple[float, float]:
        """The flux of half the light, and its robust deviation."""
        fluxes = [
            self._flux(number, index, 1)
            for index in range(1, self.session.count)
            if self.session.good[number * self.session.count + index]
        ]
        middle = float(np.median(fluxes)) if fluxes else 0.5
        return middle, max(1.4826 * float(np.median(np.abs(np.asarray(fluxes) - middle))) if fluxes else 0.0, 1e-3)

    def _repair(self, own: SideCheck, number: int, index: int, lamp: Lamp) -> None:
        """Name the faulty frame of a pair, and take its vector from the other one."""
        usual, deviation = self._usual(number)
        found = []
        for sign in (1, -1):
            kept = self._flux(number, index, -sign)
            right = usual if sign < 0 else 1 - usual
            if index == 0:
                right = 1 - self.session.dark if sign < 0 else self.session.dark
            penalty = ((kept - right) / (4 * deviation)) ** 2
            rest, kind, detail, other = self._best(number, index, sign)
            found.append((rest + penalty, penalty, sign, kind, detail, other))
        known = [sign for sign in (1, -1) if (own.side, index, sign) in self.session.wrong]
        found.sort(key=lambda one: (one[2] not in known, one[0]))
        _, penalty, sign, kind, detail, other = found[0]
        if known:
            kind, detail, other = "wrong", f"is wrong: {self.session.wrong[own.side, index, sign]}", None
        elif kind == "wrong" and self.session.slight[number * self.session.count + index]:
            return
        own.uncounted.add(index)
        if len(known) == 2 or (not known and penalty > _BOTH and found[1][1] > _BOTH):
            if index:
                own.unknown.add(index)
            else:  # by definition, where it is the other side's that all vectors are projected on
                own.change(0, self.session.uniforms[number])
            own.faults.append(
                SessionFault(
                    own.side,
                    index,
                    None,
                    kind,
                    f"{detail}, and the other frame of its pair is wrong too",
                    "both are left out",
                    other,
                )
            )
            return
        power = float(self.session.side_of(number, self.session.trend)[index])
        light, vector = self.session.pairs[number].light[:, index], own.sums.vectors[:, index]
        sound = (light - sign * vector) / 2
        both = self.session.lights[number] + (power - 1) * self.session.uniforms[number]
        corrected = power / float(self.session.power[self.session.good].mean()) if lamp.corrected else 1.0
        own.change(index, -sign * (2 * sound - both) / corrected)
        own.extras[index] += own.noise
        own.faults.append(
            SessionFault(
                own.side,
                index,
                sign,
                kind,
                detail,
                "it is left out, and foretold by the other frame of its pair",
                other,
            )
        )

    def _best(self, number: int, index: int, sign: int) -> tuple[float, str, str, Half | None]:
        """The name that leaves least of a frame unexplained, mean squared deviations, of those that explain it."""
        shown, expected = self._shown(number, index, sign), self._expected(number, index, sign)
        whole = float(np.square(shown.all - expected.all).mean())
        names: list[tuple[float, str, str, Half | None]] = []
        size = float(np.dot(expected.all, expected.all))
        part = float(np.dot(shown.all, expected.all)) / size if size else 0.0
        flux = float(shown.parts[0].sum() / expected.parts[0].sum()) if expected.parts[0].sum() else 0.0
        if index == 0 and sign < 0 and self.session.dark < DARK:
            flux = part = 1.0  # a dark frame of a dark room
        if self.session.clipped((self.session.sides[number].side, index, sign)) and flux > DARK:
            return 1.0, "clipped", "is clipped: many of its pixels share its largest number", None
        if flux < DARK and all(
            np.ptp(each) < DARK * 2 * np.ptp(whole_part) + 12
            for each, whole_part in zip(shown.parts, expected.parts, strict=True)
        ):
            return 1.0, "black", "is black", None
        names.append((float(np.square(shown.all - part * expected.all).mean()), *dimmed(part), None))
        names += self._lost(shown, expected)
        names += self._repeats(number, index, sign, shown)
        names += self._shifted(number, shown, expected)
        rest, kind, detail, other = min(names, key=lambda one: one[0])
        if rest > max(_FITS, _EXPLAINED * whole):
            return rest, "wrong", "is not what the other frame of its pair foretells", None
        return rest, kind, detail, other

    @staticmethod
    def _lost(shown: _Shown, expected: _Shown) -> Iterator[tuple[float, str, str, Half | None]]:
        """A frame that ends early or begins late, along its rows or columns."""
        for axis, word in ((0, "rows"), (1, "columns")):
            seen, whole = shown.parts[axis], expected.parts[axis]
            missing, there = np.square(seen), np.square(seen - whole)
            ahead = np.concatenate([[0.0], np.cumsum(there)])
            behind = np.concatenate([np.cumsum(missing[::-1])[::-1], [0.0]])
            early = ahead + behind
            late = np.concatenate([[0.0], np.cumsum(missing)]) + np.concatenate([np.cumsum(there[::-1])[::-1], [0.0]])
            for cost, first in ((early, False), (late, True)):
                cut = int(np.argmin(cost[1:-1])) + 1
                rest = float(cost[cut]) / len(seen)
                lost = (cut if first else len(seen) - cut) / len(seen)
                yield rest, "half lost", f"lost its {'first' if first else 'last'} {word}, {lost:.0%} of them", None

    def _repeats(
        self, number: int, index: int, sign: int, shown: _Shown
    ) -> Iterator[tuple[float, str, str, Half | None]]:
        """Other frames that it equals."""
        for place, own in enumerate(self.session.sides):
            scale = 1 / np.sqrt(self.session.floor)
            pairs = self.session.pairs[place]
            for half, signed in ((0, 1), (1, -1)):
                away = np.square(pairs.rows[:, half] * scale - shown.parts[0]).sum(axis=1)
                away += np.square(pairs.columns[:, half] * scale - shown.parts[1]).sum(axis=1)
                numbers = len(shown.parts[0]) + len(shown.parts[1])
                if place == number:
                    vectors = (pairs.light + signed * own.sums.vectors) / 2 / np.sqrt(self.session.light_noise[number])
                    away += np.square(vectors - shown.parts[2][:, None]).sum(axis=0)
                    numbers += len(shown.parts[2])
                    if signed == sign:
                        away[index] = np.inf
                if signed < 0:
                    away[0] = np.inf  # dark, as a black frame is
                if place != number:
                    before = self.session.before.get((self.session.sides[number].side, index, sign))
                    away[np.arange(self.session.count) != (before[1] if before and before[0] == own.side else -1)] = (
                        np.inf
                    )
                nearest = int(np.argmin(away))
                other: Half = (own.side, nearest, signed)
                yield float(away[nearest]) / numbers, "repeated", f"repeats {frame_words(other)}", other

    def _shifted(self, number: int, shown: _Shown, expected: _Shown) -> Iterator[tuple[float, str, str, Half | None]]:
        """A frame that is moved by some rows or columns."""
        for axis, word in ((0, "rows"), (1, "columns")):
            length = len(shown.parts[axis])
            if length < 4 * _SHIFTS:
                continue
            inner = slice(_SHIFTS, length - _SHIFTS)
            still = np.square(shown.parts[1 - axis] - expected.parts[1 - axis])
            vector, whole = shown.parts[2], expected.parts[2]
            # Across its stripes a frame's vector moves; along them it becomes shorter.
            part = float(np.dot(vector, whole)) / max(float(np.dot(whole, whole)), 1e-300)
            scaled = np.square(vector - part * whole)
            for shift in (*range(-_SHIFTS, 0), *range(1, _SHIFTS + 1)):
                moved = np.square(shown.parts[axis] - np.roll(expected.parts[axis], shift))[inner]
                third = scaled
                if axis == number and len(vector) == length:
                    third = np.square(vector - np.roll(whole, shift))[inner]
                rest = float(np.concatenate([moved, still, third]).mean())
                yield rest, "shifted", f"is shifted by {abs(shift)} of its {word}", None
