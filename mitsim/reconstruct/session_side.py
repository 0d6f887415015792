"""Vectors of one side's stripe patterns in; those that are out of their place put back, those that are wrong left out.

What a pattern's vector should be, the others predict, as all are of one moving shadow
(:mod:`mitsim.reconstruct.moving_shadow`). Where that is a shadow of nothing, and columns are independent, nothing is
predicted and nothing is found.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.devices import session
from mitsim.devices.session import SIDES, UNIFORM, Half
from mitsim.reconstruct.estimate_factors import StripeSums
from mitsim.reconstruct.faults import DARK, SessionFault, frame_words, name_by_light, robust_scatter
from mitsim.reconstruct.moving_shadow import MovingShadow

MOST_FAULTS = 0.1
"""Part of the patterns that may be wrong before the session is refused: with more, what most share is in doubt."""
_ENOUGH = 16, 64
"""Patterns, and sensor rows, from which columns' covariance is known well enough."""
_DEVIATIONS = 8.0
"""Deviations of a misfit from the others, by their robust scatter, that make a fault."""
_UNEXPLAINED = 0.05
"""Part of a response's energy, beyond the others' noise, that no separable camera explains where it is a fault: 22 %
of its amplitude."""
_NOISY = 4.0
"""Robust scatter of misfits, over that by noise, up to which they are noise: of 60 good sides none has 1.5."""
_FAR = 10.0
"""Squared deviation of a vector from the predicted one, in that of the median pattern, from which it is suspected."""
_WRONG, _UNLIKE = 40.0, 0.1
"""The same, and that deviation as a part of the vector's own square, from which it is wrong whatever it shows: of 600
good sides of 64 and 260 of 128 patterns none has more than 17 and 20 of such a part; nearly all that show other stripes
have both, the rest cost little more than the noise."""
_FAR_LINE, _SHARED = 20.0, 0.2
"""Squared deviation of the first scene line's column, in that of the median one and of what noise makes of it, from
which the frame that all patterns are held against is wrong, as its error is in that column alone; and the uniform
frame's part of the variance of 2 Y - U. Of 56 good sides none has 16; a uniform frame of 0.95 or 1.05 of its light
makes 26 at least."""
SLIGHT = 0.03
"""Part of its light by which a frame without a pair must differ to be named dim, or bright, six times what half a
percent of flicker makes; what less costs is in the stated error."""
_REST = 0.1
"""Part of a dim frame's squared deviation, once it is divided by its part, up to which it was dim, and no more is wrong
with it than what does not follow the light: at half the exposure, half the dark signal."""
_GAIN = 3.0
"""What putting patterns in their place must take off the squared deviations, in that of the median one, at least."""
_EXPLAINED = 0.7
"""What that is at least of the squared deviation of the pattern that is wrong. Of two, it is more than either's: one
that is black, dim or a repeat fits better in another's place, but the other one not in its."""
_TRIED = 64
"""Patterns among which swaps are tried, those that deviate most."""
_SAME = 4.0
"""Squared distance of two vectors, in the noise of one, up to which they show the same: noise makes 2."""
_SEEN = 64.0
"""Squared length of a vector, over its noise, from which another that equals it is no chance: both are seen."""
_FLOOR = 0.02
"""Relative error of a factor that its columns' covariance is taken to have at least, as it is no exact law; chosen."""
_TURNS = 8
"""Steps that predict left-out patterns with a covariance free of them, which has their predicted variance in their
place; where another pattern of the same period is known, each step takes off half of the error."""


class SideCheck:
    """One side of a session while it is checked: ``vectors`` (m, N) as they are repaired so far.

    Attributes
    ----------
    sums, signs
        as they came in; H (n, N).
    side
        ``horizontal`` or ``vertical``.
    vectors
        (m, N) as repaired so far.
    faults
        that were found.
    uncounted
        responses whose misfit does not count.
    unknown
        patterns whose vector the others must predict.
    extras
        (N,) squared error of each vector beyond its noise.
    parts, errors
        (N,) of its light that each frame without a pair has, and squared error of its vector once it is divided by it.
    shaken
        how the power of the lamp that they are of scatters, as a part of it.
    """

    def __init__(self, sums: StripeSums, signs: FloatArray) -> None:
        """Of one side's ``sums``, of patterns ``signs`` H (n, N)."""
        self.sums, self.signs = sums, signs
        self.side: session.Side = "horizontal" if sums.side == SIDES[0] else "vertical"
        self.vectors = sums.vectors
        self.faults: list[SessionFault] = []
        self.uncounted: set[int] = set()
        self.unknown: set[int] = set()
        self._settled: set[int] = set()
        self._dims: dict[int, float] = {}
        self.extras = np.zeros(sums.vectors.shape[1])
        self.shaken = 0.0
        self.parts, self.errors = np.ones((2, len(self.extras)))

    @property
    def length(self) -> int:
        """Sensor rows, or columns."""
        return len(self.vectors)

    @property
    def pairs(self) -> bool:
        """Whether a pattern has two frames."""
        return self.sums.pairs is not None

    @property
    def variance(self) -> float:
        """Noise variance of a number of a response, from their median misfit."""
        spare = self.length * (len(self.sums.common) - 1)
        return float(np.median(self.sums.misfits)) / max(spare, 1)

    @property
    def noise(self) -> float:
        """Squared noise of one pattern's vector, all numbers together."""
        return self.variance * self.length / float(np.dot(self.sums.common, self.sums.common))

    @property
    def enough(self) -> bool:
        """Whether columns are known well enough to predict patterns."""
        return self.signs.shape[1] >= _ENOUGH[0] and self.length >= _ENOUGH[1]

    def far(self) -> npt.NDArray[np.bool_]:
        """(N,) whether patterns are not what the others predict, or left out."""
        shadow = MovingShadow(self.vectors, self.signs, self.unknown)
        far = (shadow.deviations > _WRONG) & (shadow.unlike > _UNLIKE)
        far[list(self.unknown)] = True
        return np.asarray(far, bool)

    def change(self, index: int, vector: FloatArray) -> None:
        """Put a ``vector`` in place of that of pattern ``index``."""
        if self.vectors is self.sums.vectors:
            self.vectors = self.vectors.copy()
        self.vectors[:, index] = vector

    def result(self) -> StripeSums:
        """The sums with what was changed."""
        if self.vectors is self.sums.vectors and not self.uncounted:
            return self.sums
        kept = np.setdiff1d(np.arange(self.sums.done), sorted(self.uncounted))
        return replace(
            self.sums,
            vectors=self.vectors,
            misfit=float(self.sums.misfits[kept].sum()),
            energy=float(self.sums.energies[kept].sum()),
        )

    def check(self, unsteady: bool = False, name: Callable[[Half], str] = frame_words) -> None:
        """Find patterns that show no stripes, are out of their place or are not what others predict.

        Parameters
        ----------
        unsteady
            whether the lamp is known to be: frames against one uniform one may then be of any light.
        name
            of a frame.
        """
        self._check_misfits()
        count = self.signs.shape[1]
        if not self.enough:
            for index in self.unknown:  # nothing predicts them: their error is then their size, which the others' tells
                self.extras[index] = self._size(index)
                self.change(index, np.zeros(self.length))
            return
        if self.unknown:
            self._predict_unknown()
        steady = self.pairs or not unsteady
        for _ in range(int(MOST_FAULTS * count) + 2):
            shadow = MovingShadow(self.vectors, self.signs, self.unknown)
            line, usual = shadow.first_line
            usual += _SHARED * self.noise + self.shaken**2 * float(np.square(self.vectors[:, 0]).sum())
            if steady and not self.pairs and line > _FAR_LINE * usual:
                raise MitsimError(
                    f"frames: {name((self.side, 0, UNIFORM))}, or a dark frame, is not of the light that patterns of "
                    "its side are of; look at these, and take the session again"
                )
            if not self._mend(shadow, steady):
                break

    def leave_out_known(self, wrong: Mapping[Half, str]) -> None:
        """Leave patterns without pairs out that are known to be ``wrong``; MitsimError for a uniform frame."""
        for (side, index, sign), detail in wrong.items():
            if side != self.side:
                continue
            if sign == UNIFORM:
                raise MitsimError(f"{side} stripes: of their uniform frame, {detail}; take the session again")
            self._do_without(index, "wrong", f"is wrong: {detail}")

    def _do_without(self, index: int, kind: str, detail: str, other: Half | None = None) -> None:
        """A pattern is left out, and what others predict will come in its place."""
        self.add(index, kind, detail, "it is left out", other)
        self.unknown.add(index)
        self.uncounted.add(index)

    def _check_misfits(self) -> None:
        """Responses that hold much that no separable camera explains, where the others do not."""
        misfits, energies = self.sums.misfits, self.sums.energies
        middle = float(np.median(misfits))
        scatter = robust_scatter(misfits, middle)
        excess = misfits - middle - max(_UNEXPLAINED * float(np.median(energies)), _DEVIATIONS * scatter)
        # Where no separable camera explains any, one that is no worse than others says nothing.
        noise = middle * float(np.sqrt(2 / self.length / len(self.sums.common)))
        least = 4 * middle if scatter > _NOISY * noise else 0.0
        for index in np.flatnonzero((excess > _UNEXPLAINED * energies) & (misfits >= least)):
            if index in self.uncounted or index in self.unknown:
                continue
            part = misfits[index] / energies[index]
            detail = f"no {self.side} stripes: {part:.0%} of their response is of other shape"
            # One frame for the mean of many is of other noise alone.
            self._do_without(int(index), *(self._repeat_of(int(index)) or ("wrong", detail)))

    def add(
        self, index: int, kind: str, detail: str, repair: str, other: Half | None = None, sign: int | None = None
    ) -> None:
        """Note a fault.

        Parameters
        ----------
        index, kind, detail, repair, other
            as :class:`mitsim.reconstruct.faults.SessionFault` has them.
        sign
            of the frame of a pair that is at fault; None: both.
        """
        sign = sign if self.pairs else 1
        self.faults.append(SessionFault(self.side, index, sign, kind, detail, repair, other))

    # ---- patterns that do not fit the others -------------------------------------------------------------------------

    def _mend(self, shadow: MovingShadow, steady: bool) -> bool:
        """Whether a pattern was wrong: the one whose exchange or swap makes most fit, or, of ``steady`` light, that
        fits least."""
        fixed = np.zeros(self.sums.done, dtype=bool)
        fixed[[0, *self.unknown]] = True
        deviations = np.where(fixed, 0.0, shadow.deviations)
        if steady and not self.pairs and self._one_frame(shadow, deviations):
            return True
        worst = int(np.argmax(np.where(shadow.unlike > _UNLIKE, deviations, 0.0)))
        fixed[list(self._settled)] = True
        exchanges = np.where(fixed | (shadow.by_exchange < _EXPLAINED * deviations), -np.inf, shadow.by_exchange)
        flip = int(np.argmax(exchanges))
        gain, places = float(exchanges[flip]), [flip]
        swapped = self._best_swap(shadow, np.where(fixed, -np.inf, deviations))
        if swapped is not None and swapped[0] > gain:
            gain, places = swapped
        if gain > max(_GAIN, _EXPLAINED * deviations[worst] if shadow.unlike[worst] > _UNLIKE else 0.0):
            self._put_in_place(places)
        elif steady and deviations[worst] > _WRONG and shadow.unlike[worst] > _UNLIKE:
            before = [fault for fault in self.faults if fault.index == worst and worst in self._dims]
            if before and deviations[worst] < _REST * self._dims[worst]:
                self._leave_out(worst, before[0].kind, before[0].detail)
            else:
                self._leave_out(worst, "wrong", "no stripes as the other patterns foretell them")
        else:
            return False
        return True

    def _one_frame(self, shadow: MovingShadow, deviations: FloatArray) -> bool:
        """Whether a frame that is shown against a uniform one was black, the same as another, or dim."""
        far = np.flatnonzero(deviations > _FAR)
        uniform = self.vectors[:, 0]
        for index in far[np.argsort(-deviations[far])]:
            own = self.vectors[:, index]
            if np.linalg.norm(own + uniform) / 2 < DARK * np.linalg.norm(uniform):
                self._leave_out(int(index), "black", "is black")
                return True
            if repeated := self._repeat_of(int(index)):
                self._leave_out(int(index), *repeated)
                return True
        gains, light = shadow.by_scale(), self.parts
        explained = (deviations > 0) & (gains > _EXPLAINED * deviations)
        gains = np.where(explained & (np.abs(light - 1) > SLIGHT) & (light > DARK) & (light < 2), gains, 0.0)
        gains[list(self._settled)] = 0.0
        index = int(np.argmax(gains))
        worst = float(np.max(np.where(shadow.unlike > _UNLIKE, deviations, 0.0)))
        if gains[index] <= max(_FAR, _EXPLAINED * worst):
            return False
        self._settled.add(index)
        self._dims[index] = float(deviations[index])
        part = float(light[index])
        self.change(index, (self.vectors[:, index] + uniform) / part - uniform)
        self.extras[index] = self.errors[index] + max(1 / part**2 - 1, 0.0) * self.noise
        self.add(index, *name_by_light(part), "its numbers are divided by that")
        return True

    def _repeat_of(self, index: int) -> tuple[str, str, Half] | None:
        """Kind, words and the other frame where one that is shown against a uniform one is the same as another."""
        own = self.vectors[:, index]
        away = np.square(own[:, None] - self.vectors).sum(axis=0)
        away[index] = np.inf
        nearest = int(np.argmin(away))
        if self.pairs or away[nearest] > _SAME * self.noise or np.square(own).sum() < _SEEN * self.noise:
            return None
        return "repeated", f"repeats {self.side} stripes {nearest}", (self.side, nearest, 1)

    @staticmethod
    def _best_swap(shadow: MovingShadow, deviations: FloatArray) -> tuple[float, list[int]] | None:
        """What a swap of two that deviate takes off at most, and which two; None where there are no two."""
        far = np.flatnonzero(deviations > _FAR / 2)
        tried = np.sort(far[np.argsort(-deviations[far])[:_TRIED]])
        pairs = [(int(one), int(other)) for place, one in enumerate(tried) for other in tried[place + 1 :]]
        if not pairs:
            return None
        gains = shadow.by_swap(pairs)
        least = [max(deviations[one], deviations[other]) for one, other in pairs]
        gains = np.where(gains < least, -np.inf, gains)
        best = int(np.argmax(gains))
        return float(gains[best]), [*pairs[best]]

    def _put_in_place(self, places: list[int]) -> None:
        """Exchange the frames of one pattern, or swap two."""
        first, *rest = places
        moved = self.vectors.copy()
        moved[:, places] = self.vectors[:, places[::-1]] if rest else -self.vectors[:, places]
        self.vectors = moved
        self._settled.update(places)
        if rest:
            detail = f"in the place of {self.side} stripes {rest[0]}, and those in theirs"
            self.add(first, "swapped", detail, "both count in their right order", (self.side, rest[0], UNIFORM))
        elif not self.pairs:
            self.add(first, "exchanged", "shows black where white should be", "it counts with its sign")
        elif not self._turn_fault(first):
            self.add(first, "exchanged", "in each other's place", "they count in their right order")

    def _turn_fault(self, index: int) -> bool:
        """Whether a pattern's faulty frame is the other one of its pair: a frame may repeat the other, or that it."""
        for place, fault in enumerate(self.faults):
            if fault.index == index and fault.sign is not None:
                other, detail = fault.other, fault.detail
                if other is not None and other[:2] == (self.side, index):
                    other = self.side, index, fault.sign
                    detail = f"repeats {frame_words(other)}"
                self.faults[place] = replace(fault, sign=-fault.sign, detail=detail, other=other)
                return True
        return False

    def _leave_out(self, index: int, kind: str, detail: str, other: Half | None = None) -> None:
        """Put what the others predict in place of a pattern."""
        self.faults = [fault for fault in self.faults if fault.index != index]
        self._do_without(index, kind, detail, other)
        self._predict_unknown()

    # ---- what others predict of a pattern ---------------------------------------------------------------------------

    def _size(self, index: int) -> float:
        """Mean squared length of the other patterns' vectors, but for the uniform one."""
        others = np.delete(self.vectors, [0, index], axis=1)
        return float(np.square(others).sum(axis=0).mean()) if others.size else 0.0

    def _predict_unknown(self) -> None:
        """In place of patterns that are left out comes what others predict, and the error of that counts.

        That is of columns as they are, as a moving shadow predicts nothing at the sensor's ends; where it does, what
        both differ by is an error too: a period that no other pattern has is known by the motion alone.
        """
        for index in sorted(self.unknown):
            self._predict(index)
        amended = MovingShadow(self.vectors, self.signs, self.unknown).amended
        for index in self.unknown:
            self.extras[index] = min(max(self.extras[index], float(amended[index])), self._size(index))

    def _predict(self, index: int) -> None:
        """The same of one pattern."""
        self.change(index, np.zeros(self.length))
        variance = 0.0
        for _ in range(_TURNS):
            precision = self._precision(index, variance)
            row = precision[index].copy()
            variance, row[index] = float(1 / row[index]), 0.0
            self.change(index, -self.vectors @ row * variance)
        self.extras[index] = variance * self.length

    def _precision(self, index: int, variance: float) -> FloatArray:
        """(N, N) inverse covariance of the patterns' vectors, that of columns being a function of their distance; the
        vector of a pattern has a ``variance`` round what it is."""
        n, count = self.signs.shape
        columns = self.vectors @ self.signs.T / count
        covariance = columns.T @ columns / self.length
        covariance += variance / count**2 * np.outer(self.signs[:, index], self.signs[:, index])
        by_distance = np.array([np.trace(covariance, lag) / (n - lag) for lag in range(n)])
        values, modes = np.linalg.eigh(by_distance[np.abs(np.subtract.outer(np.arange(n), np.arange(n)))])
        values = np.maximum(values, 0.0) + _FLOOR**2 * by_distance[0] * n / count
        shown = self.signs.T @ modes
        whole = (shown * values) @ shown.T
        if not whole.any():
            return np.eye(count)
        # Where H has more columns than rows and nothing is noise, patterns depend on each other to the last digit.
        whole[np.diag_indices(count)] += (self.noise + self.extras) / self.length
        whole[np.diag_indices(count)] += 1e-9 * np.trace(whole) / count
        return np.asarray(np.linalg.inv(whole))
