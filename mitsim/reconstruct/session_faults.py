"""Sums over a calibration session's responses in; frames that are not what they should be, and sums without them, out.

Three things hold for every good session, whatever the camera. *The two frames of a pair add up to one frame for all
patterns*, so that a frame which is black, dim, half lost, a repeat, shifted or clipped shows in the sum, and the other
half foretells what it should have been. *The lamp is one lamp*: what these sums share is its power, in the order of the
session. *Columns of a factor vary as the shadow of one mask*: their covariance depends on their distance alone, so that
each pattern's vector u_i = Phi h_i is foretold by all others (conditional mean of a Gaussian process; Rasmussen and
Williams 2006, eq. 2.19), and a pattern that is out of its place, or whose halves are exchanged, makes columns that
change as its code does. Where columns are independent, the last one foretells nothing and flags nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.reconstruct.calibration import Estimate, StripeSums, factors_of_sums
from mitsim.rig.order import SIDES, UNIFORM, Half, Side

MOST_FAULTS = 0.1
"""Part of the patterns that may be wrong before the session is refused: with more, what most share is in doubt."""
_MATTERS = 0.5
"""Error by the lamp, over that by noise, from which it is corrected and said: both in quadrature are 12 % more."""
_DEVIATIONS = 8.0
"""Deviations from the rest, by their own robust scatter, that make a fault: noise alone goes so far in one session of
10^12."""
_LEAST = 2e-3
"""Change of a pair's light that counts: that of one frame by 0.4 %, which costs less than most sessions' noise."""
_EXCESS = 2.0
"""Squared deviation of a pair's sum, over that of the others, that counts at least."""
_EXPLAINED = 0.05
"""Part of a faulty frame's squared deviation that the fault's name may leave unexplained."""
_DARK = 0.03
"""Light of a black frame, as a part of what it should have: stray light and the projector's own black level."""
_SHIFTS = 8
"""Rows or columns by which a frame is tried to be shifted."""
_SMOOTH_FLOOR = 0.02
"""Relative error of a factor that its columns' covariance is taken to have at least: it is no exact law of any mask
(light falls off, pixels have edges); chosen."""
_GAIN, _REMOVED = 0.25, 0.55
"""What putting patterns in their place must take off the summed squared deviations, a sensor row, and as a part of
their own, for the likelihood to decide alone: chosen, a right move takes off nearly all of them."""
_LIKELIER, _ALIKE = 2.0, 0.8
"""Logarithm of the likelihood, a sensor row, that an exchange or swap must add to be said where nothing else shows it,
and by which the next one must be worse for it to be put back: in 192 good sides of ideal cameras of 32 to 128
pixels none adds more than 1.3, and in 768 with one exchange or swap a wrong one was ahead by 0.6 at most."""
_SEEN = 64.0
"""Squared length of a vector, over its noise, from which another that equals it is no chance: both are seen."""
_TRIED = 6
"""Exchanges, and swaps, that are tried."""
_ENOUGH = 16, 64
"""Patterns, and sensor rows, from which a covariance of columns is known well enough."""
_FAR = 5.0
"""Root mean square deviation of a pattern from what others foretell, in that of its foretold error, that makes a fault:
chosen, as columns are no exact Gaussian process."""
_UNEXPLAINED = 0.05
"""Part of a response's energy, beyond the others' noise, that no separable camera explains where it is a fault: 22 %
of its amplitude."""


@dataclass(frozen=True)
class Fault:
    """One pattern, or one of its frames, that is not what it should be.

    Attributes
    ----------
    side, index
        of the pattern.
    sign
        of the frame; None: both frames.
    kind
        ``black``, ``dim``, ``bright``, ``half lost``, ``repeated``, ``shifted``, ``clipped``, ``exchanged``,
        ``swapped``, ``wrong``.
    detail
        the same in words, after the frame's name.
    other
        the frame that it repeats, or the pattern that it is swapped with.
    repair
        what is done about it, in words.
    """

    side: Side
    index: int
    sign: int | None
    kind: str
    detail: str
    repair: str
    other: Half | None = None

    def _names(self, name: Callable[[Half], str]) -> list[str]:
        """Names of its frames."""
        return [name((self.side, self.index, sign)) for sign in ((1, -1) if self.sign is None else (self.sign,))]

    def words(self, name: Callable[[Half], str]) -> str:
        """A sentence; ``name`` says which frame it is."""
        names = " and ".join(self._names(name))
        other = f" ({name(self.other)})" if self.other is not None and self.other[2] != UNIFORM else ""
        return f"frames: {names}: {self.detail}{other}; {self.repair}"

    def listed(self, name: Callable[[Half], str]) -> dict[str, Any]:
        """The same for a manifest; ``name`` says which frame it is."""
        return {"frames": self._names(name), **asdict(self)}


@dataclass(frozen=True)
class Lamp:
    """How the projector's power changes over the session.

    Attributes
    ----------
    drift
        from the session's begin to its end, as a part of its mean.
    flicker
        from frame to frame, rms, as a part of it.
    drift_cost, flicker_cost
        relative error of both factors that each would leave, or leaves, in them.
    remaining
        the error that is left after correction.
    corrected
        whether factors are corrected for it.
    """

    drift: float = 0.0
    flicker: float = 0.0
    drift_cost: float = 0.0
    flicker_cost: float = 0.0
    remaining: float = 0.0
    corrected: bool = False

    def listed(self) -> dict[str, float] | None:
        """The same for a manifest; None of a steady one."""
        return asdict(self) if self.drift or self.flicker else None

    def warnings(self) -> Iterator[str]:
        """What is said of an unsteady lamp."""
        left = f"frames are divided by its power, and {self.remaining:.1e} is left"
        if self.drift:
            yield (
                f"lamp: its power drifts by {self.drift:+.1%} over the session, a factor error of "
                f"{self.drift_cost:.1e} if nothing is done; {left}: let it warm up"
            )
        if self.flicker:
            yield (
                f"lamp: its power flickers by {self.flicker:.2%} from frame to frame, a factor error of "
                f"{self.flicker_cost:.1e} if nothing is done; {left}, as pairs "
                "do not tell how their two frames differ: use a steadier one, or expose for whole periods"
            )


@dataclass
class Checked:
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
    faults: list[Fault] = field(default_factory=list)
    lamp: Lamp = Lamp()
    left_out: tuple[int, int] = (0, 0)
    extra: tuple[float, float] = (0.0, 0.0)

    def wrong_uniform(self) -> set[Side]:
        """Sides whose first response, which the uniform one is taken from, is wrong."""
        return {fault.side for fault in self.faults if fault.index == 0}

    @staticmethod
    def other_uniform(wrong: set[Side]) -> Side:
        """The side whose uniform response is right; MitsimError where both are ``wrong``."""
        right = [side for side in SIDES if side not in wrong]
        if not right:
            raise MitsimError(
                "the uniform frames of horizontal and of vertical stripes, number 0 of each, are both wrong; take them "
                "again"
            )
        return right[0]

    def estimate(self, signs: FloatArray, noise: float | None) -> Estimate:
        """Factors of what can be believed.

        Parameters
        ----------
        signs
            (n, N) H.
        noise
            as ``stated_noise`` of :func:`mitsim.reconstruct.calibration.factors_of_sums`.
        """
        return factors_of_sums(*self.sums, signs, noise, self.left_out, self.extra)

    def warnings(self, name: Callable[[Half], str]) -> tuple[str, ...]:
        """A sentence for each fault; ``name`` says which frame it is."""
        return (*(fault.words(name) for fault in self.faults), *self.lamp.warnings())

    def listed(self, name: Callable[[Half], str]) -> list[dict[str, Any]]:
        """Faults for a manifest; ``name`` says which frame it is."""
        return [fault.listed(name) for fault in self.faults]


def check_session(
    sums: tuple[StripeSums, StripeSums],
    signs: FloatArray,
    order: Sequence[Half],
    clipped: Callable[[Half], bool] = lambda half: False,
    uniform_given: bool = False,
    saturated: bool = False,
) -> Checked:
    """What of a session can be believed.

    Parameters
    ----------
    sums
        of horizontal and of vertical stripes, all in.
    signs
        (n, N) H.
    order
        frames as they were taken.
    clipped
        whether many of a frame's pixels share its largest number.
    uniform_given
        whether the sums were made with the uniform response of a side that is right. If not, and one of the two is
        wrong, nothing else is judged.
    saturated
        whether frames have saturated pixels, which make many pairs add up to less; those sessions are flagged for it,
        and not refused.

    Raises
    ------
    MitsimError
        where too many frames are wrong.
    """
    work = [_Side(own, signs) for own in sums]
    lamp = Lamp()
    if all(own.pairs is not None for own in sums):
        pairs = _Pairs(work, order, clipped)
        if saturated and pairs.many:
            return Checked(sums)
        lamp = pairs.check()
    at_first = [fault for own in work for fault in own.faults if fault.index == 0]
    if at_first and not uniform_given:
        return Checked(sums, at_first)
    for own in work:
        own.check_order()
    faults = [fault for own in work for fault in own.faults]
    count = signs.shape[1]
    wrong = {(fault.side, fault.index) for fault in faults}
    if len(wrong) > max(2, MOST_FAULTS * 2 * count):
        first = faults[0]
        raise MitsimError(
            f"{len(wrong)} of {2 * count} patterns of the session are not what they should be, first {first.side} "
            f"stripes {first.index}: {first.detail}; too many to leave out: check the order of the frames, and take "
            "the session again"
        )
    return Checked(
        (work[0].result(), work[1].result()),
        faults,
        lamp,
        (len(work[0].uncounted), len(work[1].uncounted)),
        (float(work[0].extras.sum()), float(work[1].extras.sum())),
    )


class _Side:
    """One side of a session while it is checked: ``vectors`` (m, N) as they are repaired so far."""

    def __init__(self, sums: StripeSums, signs: FloatArray) -> None:
        self.sums, self.signs = sums, signs
        self.side: Side = "horizontal" if sums.side == SIDES[0] else "vertical"
        self.vectors = sums.vectors
        self.faults: list[Fault] = []
        self.uncounted: set[int] = set()
        self.unknown: set[int] = set()
        self.settled: set[int] = set()
        self.extras = np.zeros(sums.vectors.shape[1])
        self.shaken = np.zeros(sums.vectors.shape[1])

    @property
    def length(self) -> int:
        return len(self.vectors)

    @property
    def noise(self) -> float:
        """Squared noise of one pattern's vector, all numbers together, from the responses' median misfit."""
        spare = self.length * (len(self.sums.common) - 1)
        squared = float(np.median(self.sums.misfits)) / max(spare, 1)
        return squared * self.length / float(np.dot(self.sums.common, self.sums.common))

    def change(self, index: int, vector: FloatArray) -> None:
        """Put a ``vector`` in place of a pattern's own."""
        if self.vectors is self.sums.vectors:
            self.vectors = self.vectors.copy()
        self.vectors[:, index] = vector

    def rescale(self, factor: float) -> None:
        """Make the uniform response's share in all vectors smaller by ``factor``, and them larger."""
        self.vectors = self.vectors * factor

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

    # ---- columns vary as those of one mask do ------------------------------------------------------------------------

    def check_order(self) -> None:
        """Patterns that are out of their place, and those that others foretell otherwise."""
        self._check_misfits()
        count = self.signs.shape[1]
        if count < _ENOUGH[0] or self.length < _ENOUGH[1]:
            for index in self.unknown:
                self._forget(index)
            return
        for index in sorted(self.unknown):
            self._foretell(index)
        if self.sums.pairs is None:
            self._check_fit()
            return
        for _ in range(int(MOST_FAULTS * count) + 2):
            if not self._put_in_place():
                break

    def _check_misfits(self) -> None:
        """Responses that hold much that no separable camera explains, where the others do not."""
        misfits, energies = self.sums.misfits, self.sums.energies
        middle = float(np.median(misfits))
        scatter = 1.4826 * float(np.median(np.abs(misfits - middle)))
        excess = misfits - middle - max(_UNEXPLAINED * float(np.median(energies)), _DEVIATIONS * scatter)
        for index in np.flatnonzero(excess > _UNEXPLAINED * energies):
            if index in self.uncounted or index in self.unknown:
                continue
            if np.median(misfits / np.maximum(energies, 1e-300)) > _UNEXPLAINED and misfits[index] < 4 * middle:
                continue
            part = misfits[index] / energies[index]
            detail = f"shows no {self.side} stripes: {part:.0%} of its response is of other shape"
            self._add(int(index), "wrong", detail, "it is left out")
            self.unknown.add(int(index))
            self.uncounted.add(int(index))

    def _precision(self, errors: FloatArray) -> FloatArray:
        """(N, N) inverse covariance of the patterns' vectors, that of columns being a function of their distance;
        ``errors`` (N,) are variances beside their noise."""
        n, count = self.signs.shape
        columns = self.vectors @ self.signs.T / count
        covariance = columns.T @ columns / self.length
        by_distance = np.array([np.trace(covariance, lag) / (n - lag) for lag in range(n)])
        lags = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
        values, modes = np.linalg.eigh(by_distance[lags])
        values = np.maximum(values, 0.0) + _SMOOTH_FLOOR**2 * by_distance[0] * n / count
        shown = self.signs.T @ modes
        whole = (shown * values) @ shown.T
        if not whole.any():
            return np.eye(count)
        # Where H has more columns than rows and nothing is noise, patterns depend on each other to the last digit.
        whole[np.diag_indices(count)] += self.noise / self.length + errors + 1e-9 * np.trace(whole) / count
        return np.asarray(np.linalg.inv(whole))

    def _parts(self) -> list[tuple[FloatArray, FloatArray]]:
        """Inverse covariances and Gram matrices (N, N) a sensor row of the vectors across, and along, uniform light,
        which is where flicker has its error."""
        gram = self.vectors.T @ self.vectors / self.length
        if not self.shaken.any():
            return [(self._precision(self.extras / self.length), gram)]
        uniform = self.vectors[:, 0] / np.linalg.norm(self.vectors[:, 0])
        along = uniform @ self.vectors
        alone = np.outer(along, along) / self.length
        others = (self.extras - self.shaken) / self.length
        return [(self._precision(others), gram - alone), (self._precision(others + self.shaken), alone)]

    def _forget(self, index: int) -> None:
        """Leave a pattern out where nothing foretells it; its error is then its own size, which the others' tells."""
        others = np.delete(self.vectors[:, 1:], index - 1, axis=1) if index else self.vectors[:, 1:]
        self.extras[index] = float(np.square(others).sum(axis=0).mean()) if others.size else 0.0
        self.change(index, np.zeros(self.length))

    def _foretell(self, index: int) -> None:
        """Leave a pattern out: in its place comes what the others foretell, and the error of that counts."""
        vector, variance = self._foretold(index)
        self.change(index, vector)
        self.extras[index] = variance * self.length

    def _foretold(self, index: int) -> tuple[FloatArray, float]:
        """(m,) what the others foretell of a pattern's vector, and the variance of each number."""
        kept = self.vectors
        self.vectors = kept.copy()
        self.vectors[:, index] = 0.0
        variance = 0.0
        for _ in range(_TURNS):
            precision = self._precision(self.extras / self.length)
            row = precision[index].copy()
            variance, row[index] = 1 / row[index], 0.0
            self.vectors[:, index] = -self.vectors @ row * variance
        vector, self.vectors = self.vectors[:, index], kept
        return vector, float(variance)

    def _put_in_place(self) -> bool:
        """Whether a pattern was out of its place, the one whose exchange or swap makes columns most alike."""
        parts = self._parts()
        fixed = [0, *self.unknown, *self.settled]
        flips = np.sum([_by_exchange(*part) for part in parts], axis=0)
        swaps = np.sum([_by_swap(*part) for part in parts], axis=0)
        if self.sums.pairs is None:
            flips[:] = -np.inf
        flips[fixed] = -np.inf
        swaps[fixed], swaps[:, fixed] = -np.inf, -np.inf
        np.fill_diagonal(swaps, -np.inf)
        deviations = np.zeros(self.sums.done)
        for precision, gram in parts:
            deviations += np.einsum("ij,jk,ik->i", precision, gram, precision) / np.diag(precision)
        flip = int(np.argmax(flips))
        pair = sorted(int(number) for number in np.unravel_index(int(np.argmax(swaps)), swaps.shape))
        seen = any(
            gain > max(_GAIN, _REMOVED * float(deviations[places].sum()))
            for gain, places in ((flips[flip], [flip]), (swaps[tuple(pair)], pair))
        )
        tried = self._likeliest(flips, swaps)
        if tried and tried[0][0] > (0.0 if seen else _LIKELIER):
            return self._moved([places for gain, places in tried if gain > tried[0][0] - _ALIKE])
        deviations[fixed] = 0.0
        worst = int(np.argmax(deviations))
        return bool(deviations[worst] > _FAR**2) and self._doubt(worst)

    def _check_fit(self) -> None:
        """MitsimError where a pattern without pairs is black, shows what another does or does not fit.

        A wrong one changes the covariance, and the uniform frame is in all, so that which one it is, is not sure enough
        to leave it out.
        """
        sizes = np.square(self.vectors).sum(axis=0)
        away = sizes[:, None] + sizes - 2 * self.vectors.T @ self.vectors
        away[:, sizes < _SEEN * self.noise] = np.inf
        away[np.tril_indices(len(away))] = np.inf
        one, other = (int(k) for k in np.unravel_index(int(np.argmin(away)), away.shape))
        if away[one, other] < 4 * self.noise:
            raise MitsimError(f"{self.side} stripes {one} and {other} show the same: take the session again")
        dark = np.square(self.vectors + self.vectors[:, :1]).sum(axis=0) / 4
        black = int(np.argmin(dark))
        if dark[black] < _DARK**2 * sizes[0]:
            raise MitsimError(f"{self.side} stripes {black}: the frame is black; take the session again")
        (precision, gram), *_ = self._parts()
        deviations = np.einsum("ij,jk,ik->i", precision, gram, precision) / np.diag(precision)
        deviations[0] = 0.0
        worst = int(np.argmax(deviations))
        if deviations[worst] > _FAR**2:
            raise MitsimError(
                f"{self.side} stripes {worst} do not fit the other patterns, and of all they fit least; patterns "
                "against one uniform frame do not tell which frame is wrong: look at this one and at those that are "
                "far from their neighbours, and take the session again, in pairs if you can"
            )

    def _likelihood(self) -> float:
        """Logarithm of the vectors' likelihood, a sensor row, by the covariance that they themselves have."""
        parts = self._parts()
        weights = [1.0] if len(parts) == 1 else [1 - 1 / self.length, 1 / self.length]
        found = 0.0
        for weight, (precision, gram) in zip(weights, parts, strict=True):
            found += weight * float(np.linalg.slogdet(precision)[1]) - float(np.sum(precision * gram))
        return found / 2

    def _likeliest(self, flips: FloatArray, swaps: FloatArray) -> list[tuple[float, list[int]]]:
        """What putting patterns in their place adds to the likelihood, largest first, of the exchanges and swaps that
        promise most: of each, the covariance that results decides, as that of all has the fault in it."""
        upper = np.where(np.triu(np.ones(swaps.shape, dtype=bool)), swaps, -np.inf)
        pairs = np.argsort(-upper, axis=None)[:_TRIED]
        places = [[int(index)] for index in np.argsort(-flips)[:_TRIED] if np.isfinite(flips[index])]
        places += [
            [int(k) for k in np.unravel_index(one, upper.shape)] for one in pairs if np.isfinite(upper.flat[one])
        ]
        kept, before, found = self.vectors, self._likelihood(), []
        for moved in places:
            self.vectors = _moved(kept, moved)
            found.append((self._likelihood() - before, moved))
        self.vectors = kept
        return sorted(found, reverse=True)

    def _moved(self, names: list[list[int]]) -> bool:
        """Exchange the halves of a pattern, or swap two, as the likeliest of ``names`` says; leave all that are named
        out where there are more. In either case other patterns may be wrong too."""
        first, *rest = names[0]
        if len(names) > 1:
            self._leave_out(names)
            return True
        self.vectors = _moved(self.vectors, names[0])
        self.settled.update(names[0])
        if rest:
            detail = f"is swapped with {self.side} stripes {rest[0]}"
            self._add(first, "swapped", detail, "both count in their right order", (self.side, rest[0], UNIFORM))
        elif not self._turned(first):
            self._add(first, "exchanged", "has its two frames exchanged", "they count in their right order")
        return True

    def _leave_out(self, names: list[list[int]]) -> None:
        """Leave all patterns out that ``names`` name, which fit as well: any of them may be the wrong one."""
        said = " or ".join(
            f"{self.side} stripes {name[0]} has its two frames exchanged"
            if len(name) == 1
            else f"{self.side} stripes {name[0]} and {name[1]} are swapped"
            for name in names
        )
        doubted = list(dict.fromkeys(index for name in names for index in name))
        self.unknown.update(doubted)
        self.uncounted.update(doubted)
        for index in doubted:
            self._forget(index)
        for _ in range(_TURNS):
            for index in doubted:
                self._foretell(index)
        for index in doubted:
            kind = next("swapped" if len(name) == 2 else "exchanged" for name in names if index in name)
            self._add(index, kind, f"is in doubt: {said}, which cannot be told apart", "it is left out")

    def _turned(self, index: int) -> bool:
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

    def _doubt(self, index: int) -> bool:
        """Leave a pattern out that does not fit the others."""
        vector, variance = self._foretold(index)
        own = self.vectors[:, index]
        if np.square(own - vector).mean() < _FAR**2 * variance:
            return False
        kind, detail, other = self._named(index, own, vector, variance)
        self.unknown.add(index)
        self.uncounted.add(index)
        self._foretell(index)
        self._add(index, kind, detail, "it is left out", other)
        return True

    def _named(self, index: int, own: FloatArray, vector: FloatArray, variance: float) -> tuple[str, str, Half | None]:
        """What a pattern against one uniform frame shows instead of what is foretold of it."""
        light = self.vectors[:, 0]
        shown, foretold = (own + light) / 2, (vector + light) / 2
        size = float(np.linalg.norm(foretold))
        part = float(np.dot(shown, foretold)) / size**2 if size else 0.0
        away = np.square(own[:, None] - self.vectors).mean(axis=0)
        away[index] = np.inf
        nearest = int(np.argmin(away))
        noise = self.noise / self.length
        if np.linalg.norm(shown) < _DARK * size:
            return "black", "is black", None
        if away[nearest] < 4 * noise:
            return "repeated", f"repeats {self.side} stripes {nearest}", (self.side, nearest, 1)
        if np.square(shown - part * foretold).mean() < max(
            4 * variance, _EXPLAINED * np.square(shown - foretold).mean()
        ):
            return *_dim(part), None
        return "wrong", "does not fit the other patterns", None

    def _add(self, index: int, kind: str, detail: str, repair: str, other: Half | None = None) -> None:
        sign = None if self.sums.pairs is not None else 1
        self.faults.append(Fault(self.side, index, sign, kind, detail, repair, other))


# ---- two frames of a pair add up to one frame for all patterns -------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Shown:
    """What is known of one frame, in deviations of a pair's noise: ``parts`` are means of its rows, of its columns, and
    its vector."""

    parts: tuple[FloatArray, FloatArray, FloatArray]

    @property
    def all(self) -> FloatArray:
        return np.concatenate(self.parts)


class _Pairs:
    """Pairs of both ``sides``, frames in the ``order`` in which they were taken."""

    def __init__(self, sides: list[_Side], order: Sequence[Half], clipped: Callable[[Half], bool]) -> None:
        self.sides, self.clipped = sides, clipped
        self.pairs = [own.sums.pairs for own in sides if own.sums.pairs is not None]
        self.count = sides[0].sums.done
        places = {half: place for place, half in enumerate(order)}
        self.before = dict(zip(order[1:], order, strict=False))
        span = max(len(order) - 1, 1)
        self.times = np.array(
            [[places[own.side, index, sign] / span for sign in (1, -1)] for own in sides for index in range(self.count)]
        )
        self.rows = np.concatenate([own.rows.sum(axis=1) for own in self.pairs])
        self.columns = np.concatenate([own.columns.sum(axis=1) for own in self.pairs])
        both = np.hstack([self.rows, self.columns])
        self.ambient_and_all = np.median(both, axis=0)
        self.common = self._uniform()
        # Of a pair, what its dark frame has of ambient light.
        light = float(self.ambient_and_all.sum())
        self.dark = (1 - float(self.common.sum()) / light) / 2 if light else 0.0
        size = max(float(np.dot(self.common, self.common)), 1e-300)
        away = both - self.ambient_and_all
        # Ambient light is in every sum, and no part of the lamp's power.
        self.power = 1 + away @ self.common / size
        self.lights = [np.median(own.light, axis=1) for own in self.pairs]
        self.uniforms = [other.sums.common for other in reversed(sides)]
        rests = [away - (self.power - 1)[:, None] * self.common]
        halves = [
            np.concatenate([np.hstack([own.rows[:, half], own.columns[:, half]]) for own in self.pairs])
            for half in (0, 1)
        ]
        self.trend, self.scatter, self.steady = _trend(self.times.mean(axis=1), self.power)
        differences = [halves[0] - halves[1]]
        for number, own in enumerate(self.pairs):
            along, vectors = self.uniforms[number], sides[number].sums.vectors
            rest = (own.light - self.lights[number][:, None]).T
            rest = rest - np.outer(rest @ along / max(float(np.dot(along, along)), 1e-300), along)
            rests.append(rest)
            differences.append(vectors.T)
        for number, along in enumerate((self.common, *self.uniforms)):
            share = differences[number] @ along / max(float(np.dot(along, along)), 1e-300)
            differences[number] = differences[number] - np.outer(share, along)
        least = (_ROUNDING * float(np.sqrt(np.square(self.ambient_and_all).mean()))) ** 2
        self.flicker, self.floor = 0.0, 1.0
        self.light_noise = [1.0, 1.0]
        for _ in range(_TURNS):  # noise and flicker hang on each other
            found = [
                _unshaken(rest, difference, self.flicker, noise)
                for rest, difference, noise in zip(
                    rests, differences, [self.floor, *self.light_noise] if self.flicker else [1.0] * 3, strict=True
                )
            ]
            self.floor, *self.light_noise = (max(float(np.median(each)), least) for each in found)
            # Means of rows and of columns share the frame's mean and its noise: twice independent ones' variance.
            self.noise = float(np.sqrt(2 * self.floor / size))
            self.flicker = float(np.sqrt(max(self.scatter**2 - self.noise**2, 0.0)))
            if self.scatter < _FLICKERS * self.noise:
                self.flicker = 0.0
                break
        found = [
            _unshaken(rest, difference, self.flicker, noise) / noise
            for rest, difference, noise in zip(rests, differences, [self.floor, *self.light_noise], strict=True)
        ]
        self.excess = np.maximum(found[0], np.concatenate(found[1:]))
        away_from_trend = np.abs(self.power - self.trend)
        middle = float(np.median(self.excess))
        scatter = 1.4826 * float(np.median(np.abs(self.excess - middle)))
        bad = away_from_trend > max(_DEVIATIONS * max(self.scatter, self.noise), _LEAST)
        bad |= self.excess > max(_EXCESS * middle, middle + _DEVIATIONS * scatter)
        self.good = ~bad
        # A camera that is not linear by a percent makes sums that differ by its squares: no frame is wrong there.
        self.slight = self.excess * self.floor < _LINEAR**2 * np.square(self.ambient_and_all).mean()
        self.many = bool((bad & ~self.slight).sum() > max(2.0, MOST_FAULTS * len(bad)))

    def _uniform(self) -> FloatArray:
        """Means of rows and columns of the lamp's light: the response to the uniform pattern, of two that which differs
        less from all pairs' light, but for even ambient light."""
        found = []
        for own in self.pairs:
            light = np.concatenate([part[0, 0] - part[0, 1] for part in (own.rows, own.columns)])
            light = light if light.sum() >= 0 else -light
            found.append((float(np.std(light - self.ambient_and_all)), light))
        return min(found, key=lambda one: one[0])[1]

    def _of(self, number: int, values: FloatArray) -> FloatArray:
        """Those of the ``values`` (2 N,) that belong to a side."""
        return np.asarray(values[number * self.count : (number + 1) * self.count])

    def check(self) -> Lamp:
        """Find faulty frames, put what their pairs foretell in their place, and find how steady the lamp is."""
        bad = ~self.good
        if self.many:
            self._refuse(int(bad.sum()))
        lamp = self._correct()
        for place in np.flatnonzero(bad):
            self._repair(self.sides[place // self.count], int(place // self.count), int(place % self.count), lamp)
        for own, pairs in zip(self.sides, self.pairs, strict=True):
            fluxes = pairs.rows.mean(axis=2)
            if self.good[self.sides.index(own) * self.count] and fluxes[0, 0] < fluxes[0, 1]:
                own.faults.append(
                    Fault(
                        own.side,
                        0,
                        None,
                        "exchanged",
                        "has its two frames exchanged",
                        "they count in their right order",
                    )
                )
        return lamp

    def _refuse(self, wrong: int) -> None:
        """MitsimError: so many pairs are wrong."""
        own = self.pairs[0].rows
        next_one, this = own[:-1, 1] + own[1:, 0], own.sum(axis=1)
        apart = [float(np.median(np.square(each - np.median(each, axis=0)).mean(axis=1))) for each in (next_one, this)]
        remedy = "check the order of the frames and what was shown, and take the session again"
        if apart[0] < _EXPLAINED * apart[1]:
            remedy = (
                "but each frame does with its other neighbour: frames are one step out of order; correct their names"
            )
        raise MitsimError(
            f"the two frames of {wrong} of {len(self.good)} patterns do not add up to what others do; {remedy}"
        )

    # ---- the lamp ----------------------------------------------------------------------------------------------------

    def _correct(self) -> Lamp:
        """How steady the lamp is; vectors are divided by its power where that matters."""
        good, mean = self.good, float(self.power[self.good].mean())
        powers, trend = self.power / mean, self.trend / mean
        # A pair's sum shares both frames' flicker.
        flicker = float(np.sqrt(2)) * self.flicker
        costs = []
        for number, own in enumerate(self.sides):
            inside = self._of(number, good)
            vectors = own.vectors[:, inside]
            size = max(float(np.sum(np.square(vectors))), 1e-300)
            moved = float(np.sum(np.square(vectors * (self._of(number, trend) - 1)[inside])))
            # Each frame's own power: half of it scales the response, half adds the uniform frame to it.
            added = inside.sum() * float(np.square(self.uniforms[number]).sum()) * self.flicker**2
            costs.append((moved / size, added / size + self.flicker**2, own.noise * self.count / size))
        moved, shaken, noise = (float(np.sqrt(np.sum(part))) for part in zip(*costs, strict=True))
        drifts = bool(np.ptp(trend) > _DEVIATIONS * self.steady and moved > _MATTERS * noise)
        flickers = bool(flicker and shaken > _MATTERS * noise)
        if not drifts and not flickers:
            return Lamp()
        used = powers if flickers else trend
        # The uniform response is the mean of both sides' first ones, which had a power of their own.
        scale = float(np.sqrt((used[0] + used[self.count]) / 2)) if good[0] and good[self.count] else 1.0
        remaining = 0.0
        for number, own in enumerate(self.sides):
            self._divided(number, own, self._of(number, used), flicker if flickers else 0.0)
            own.rescale(scale)
            remaining += float(own.extras.sum() / np.sum(np.square(own.vectors)))
        return Lamp(
            drift=_end_to_end(self.times.mean(axis=1), trend) if drifts else 0.0,
            flicker=flicker if flickers else 0.0,
            drift_cost=moved if drifts else 0.0,
            flicker_cost=shaken if flickers else 0.0,
            remaining=float(np.sqrt(remaining)),
            corrected=True,
        )

    def _divided(self, number: int, own: _Side, powers: FloatArray, flicker: float) -> None:
        """Divide a side's vectors by the power of their frames; what flicker leaves in them counts as their error.

        Y(+1) = (1 + d) g P and Y(-1) = (1 - d) g (U - P) add up to g (U + d u), which tells d by the vector u of the
        response, the better the longer that is; its least squares are taken with the flicker's own variance as prior.
        """
        pairs, uniform = self.pairs[number], self.uniforms[number]
        noise, whole = self.light_noise[number], float(np.dot(uniform, uniform))
        for index in np.flatnonzero(self._of(number, self.good)):
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
                own.shaken[index] = noise / known * whole
                own.extras[index] += own.shaken[index]
            elif index:
                vector = vector - self._slope(number, int(index)) * uniform
            own.change(int(index), vector)

    def _slope(self, number: int, index: int) -> float:
        """Half the difference of a drifting lamp's power in the two frames of a pair, as a part of it."""
        place = number * self.count + index
        before, after = self.times[place]
        times = self.times.mean(axis=1)
        near = np.argsort(np.abs(times - times[place]))[: min(9, len(times))]
        if np.ptp(times[near]) == 0:
            return 0.0
        gradient = np.polyfit(times[near], self.trend[near], 1)[0]
        return float(gradient * (before - after) / 2 / self.trend[place])

    # ---- one faulty pair ---------------------------------------------------------------------------------------------

    def _shown(self, number: int, index: int, sign: int) -> _Shown:
        """A frame, in deviations of a pair's noise."""
        own, pairs = self.sides[number].sums, self.pairs[number]
        vector = (pairs.light[:, index] + (1 if sign > 0 else -1) * own.vectors[:, index]) / 2
        half = 0 if sign > 0 else 1
        scale = 1 / np.sqrt(self.floor)
        return _Shown(
            (
                pairs.rows[index, half] * scale,
                pairs.columns[index, half] * scale,
                vector / np.sqrt(self.light_noise[number]),
            )
        )

    def _expected(self, number: int, index: int, sign: int) -> _Shown:
        """What the other frame of its pair foretells of a frame."""
        more = float(self._of(number, self.trend)[index]) - 1
        other = self._shown(number, index, -sign).parts
        rows = len(other[0])
        scale = 1 / np.sqrt(self.floor)
        both = (self.ambient_and_all + more * self.common) * scale
        vector = (self.lights[number] + more * self.uniforms[number]) / np.sqrt(self.light_noise[number])
        return _Shown((both[:rows] - other[0], both[rows:] - other[1], vector - other[2]))

    def _flux(self, number: int, index: int, sign: int) -> float:
        """Light of a frame over that of all light."""
        more = float(self._of(number, self.trend)[index]) - 1
        rows = self.pairs[number].rows[index, 0 if sign > 0 else 1]
        whole = float((self.ambient_and_all + more * self.common)[: rows.size].mean())
        return float(rows.mean() / whole) if whole else 0.0

    def _usual(self, number: int) -> tuple[float, float]:
        """The flux of half the light, and its robust deviation."""
        fluxes = [
            self._flux(number, index, 1) for index in range(1, self.count) if self.good[number * self.count + index]
        ]
        middle = float(np.median(fluxes)) if fluxes else 0.5
        return middle, max(1.4826 * float(np.median(np.abs(np.asarray(fluxes) - middle))) if fluxes else 0.0, 1e-3)

    def _repair(self, own: _Side, number: int, index: int, lamp: Lamp) -> None:
        """Name the faulty frame of a pair, and take its vector from the other one."""
        usual, deviation = self._usual(number)
        found = []
        for sign in (1, -1):
            kept = self._flux(number, index, -sign)
            right = usual if sign < 0 else 1 - usual
            if index == 0:
                right = 1 - self.dark if sign < 0 else self.dark
            penalty = ((kept - right) / (4 * deviation)) ** 2
            rest, kind, detail, other = self._best(number, index, sign)
            found.append((rest + penalty, penalty, sign, kind, detail, other))
        found.sort(key=lambda one: one[0])
        _, penalty, sign, kind, detail, other = found[0]
        if kind == "wrong" and self.slight[number * self.count + index]:
            return
        own.uncounted.add(index)
        if penalty > _BOTH and found[1][1] > _BOTH:
            if index:
                own.unknown.add(index)
            else:  # by definition, where it is the other side's that all vectors are projected on
                own.change(0, self.uniforms[number])
            own.faults.append(
                Fault(
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
        power = float(self._of(number, self.trend)[index])
        light, vector = self.pairs[number].light[:, index], own.sums.vectors[:, index]
        sound = (light - sign * vector) / 2
        both = self.lights[number] + (power - 1) * self.uniforms[number]
        corrected = power / float(self.power[self.good].mean()) if lamp.corrected else 1.0
        own.change(index, -sign * (2 * sound - both) / corrected)
        own.extras[index] += own.noise
        own.faults.append(
            Fault(
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
        if index == 0 and sign < 0 and self.dark < _DARK:
            flux = part = 1.0  # a dark frame of a dark room
        if self.clipped((self.sides[number].side, index, sign)) and flux > _DARK:
            return 1.0, "clipped", "is clipped: many of its pixels share its largest number", None
        if flux < _DARK and all(
            np.ptp(each) < _DARK * 2 * np.ptp(whole_part) + 12
            for each, whole_part in zip(shown.parts, expected.parts, strict=True)
        ):
            return 1.0, "black", "is black", None
        names.append((float(np.square(shown.all - part * expected.all).mean()), *_dim(part), None))
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
        for place, own in enumerate(self.sides):
            scale = 1 / np.sqrt(self.floor)
            pairs = self.pairs[place]
            for half, signed in ((0, 1), (1, -1)):
                away = np.square(pairs.rows[:, half] * scale - shown.parts[0]).sum(axis=1)
                away += np.square(pairs.columns[:, half] * scale - shown.parts[1]).sum(axis=1)
                numbers = len(shown.parts[0]) + len(shown.parts[1])
                if place == number:
                    vectors = (pairs.light + signed * own.sums.vectors) / 2 / np.sqrt(self.light_noise[number])
                    away += np.square(vectors - shown.parts[2][:, None]).sum(axis=0)
                    numbers += len(shown.parts[2])
                    if signed == sign:
                        away[index] = np.inf
                if signed < 0:
                    away[0] = np.inf  # dark, as a black frame is
                if place != number:
                    before = self.before.get((self.sides[number].side, index, sign))
                    away[np.arange(self.count) != (before[1] if before and before[0] == own.side else -1)] = np.inf
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


_ROUNDING = 1e-6
"""Part of the light that counts as noise at least: rounding of sums of single frames leaves 1e-12, of pairs of factors
in single precision 1e-7."""
_LINEAR = 0.02
"""Deviation of a pair's sum, rms, as a part of its light, that a camera may make which is not linear: where no fault's
name explains it, none is said. A linearity of 0.03 makes 0.5 % in most pairs, 1 % in uniform ones."""
_FLICKERS = 2.0
"""Robust scatter of the pairs' power over that by noise, which is known to 20 %, that is flicker."""
_FITS = 4.0
"""Mean squared deviation, in that of a good pair's sum, up to which a name fits."""
_BOTH = 36.0
"""Squared deviation of a frame's light from the usual, in four times its robust scatter, that makes it no frame to
foretell the other by."""


def _unshaken(rests: FloatArray, differences: FloatArray, flicker: float, noise: float) -> FloatArray:
    """(pairs,) mean squared ``rests`` (pairs, numbers) of sums, less what flicker makes of the two frames'
    ``differences`` (pairs, numbers): d of it, whose deviation is the ``flicker``, at a variance ``noise`` a number."""
    squared = np.square(rests).sum(axis=1)
    if flicker:
        weight = noise / flicker**2
        along = np.einsum("ij,ij->i", rests, differences)
        squared = squared - np.square(along) / (np.square(differences).sum(axis=1) + weight)
    return np.asarray(squared / rests.shape[1])


def _trend(times: FloatArray, power: FloatArray) -> tuple[FloatArray, float, float]:
    """A smooth power (pairs,) over the ``times``, the robust scatter round it, and the deviation of its two ends.

    A parabola, fitted again without what is far from it.
    """
    away = np.abs(power - np.median(power))
    kept = away <= max(6 * float(np.median(away)), 1e-12)
    degree = min(2, max(len(np.unique(times)) - 2, 0))
    found, scatter = np.full(power.shape, float(np.median(power))), 0.0
    for _ in range(8):
        if kept.sum() <= degree + 1:
            break
        found = np.polyval(np.polyfit(times[kept], power[kept], degree), times)
        away = np.abs(power - found)
        scatter = 1.4826 * float(np.median(away))
        again = away <= max(4 * scatter, 1e-12)
        if (again == kept).all():
            break
        kept = again
    return found, scatter, 3 * scatter / float(np.sqrt(max(kept.sum(), 1)))


def _end_to_end(times: FloatArray, trend: FloatArray) -> float:
    first, last = int(np.argmin(times)), int(np.argmax(times))
    return float(trend[last] - trend[first])


def frame_words(half: Half) -> str:
    """Which frame of a session a ``half`` is, in words."""
    side, index, sign = half
    return f"{side} stripes {index} of sign {sign:+d}" if sign != UNIFORM else f"{side} stripes {index}"


_TURNS = 3
"""Steps that foretell a left-out pattern with a covariance free of it: a fourth changes no digit."""


def _moved(vectors: FloatArray, places: list[int]) -> FloatArray:
    """The ``vectors`` (m, N) with one pattern's halves exchanged, or with two patterns swapped."""
    found = vectors.copy()
    found[:, places] = -vectors[:, places] if len(places) == 1 else vectors[:, places[::-1]]
    return found


def _by_exchange(precision: FloatArray, gram: FloatArray) -> FloatArray:
    """(N,) what -u_i for u_i takes off sum_jk precision_jk gram_jk, for each i."""
    both = precision * gram
    return np.asarray(4 * (both.sum(axis=1) - np.diag(both)))


def _by_swap(precision: FloatArray, gram: FloatArray) -> FloatArray:
    """(N, N) what swapping u_i and u_j takes off it."""
    product = precision @ gram
    k, g, own = np.diag(precision), np.diag(gram), np.diag(product)
    kept = own[:, None] + own[None, :] - (k * g)[:, None] - (k * g)[None, :] - 2 * precision * gram
    swapped = product + product.T - (k[:, None] + k[None, :]) * gram - precision * (g[:, None] + g[None, :])
    # Both sums leave out the two patterns themselves, whose own terms follow.
    change = 2 * (swapped - kept)
    change += k[:, None] * g[None, :] + k[None, :] * g[:, None] - (k * g)[:, None] - (k * g)[None, :]
    return np.asarray(-change)


def _dim(part: float) -> tuple[str, str]:
    kind = "dim" if part < 1 else "bright"
    return kind, f"is {kind}: it has {part:.3g} of its light"
