"""Check of a calibration session by measurement, and the error that its faults leave in the factors.

Three redundancies hold for every good session. The two frames of a pair add up to one frame for all patterns. The
responses of one side are the shadow of one mask that moves (:mod:`mitsim.reconstruct.moving_shadow`). Both sides share
the lamp and the time.

Therefore the sum S_k of each pair is fitted over all pixels and in time::

    S_k = S + c_k U + d_k R_k + l R_(k-1) + s_k . grad U + a_k . (1, y, x)

with S the usual sum, U the response to uniform light, and R_k that to pattern k. c is the lamp's power, d the unequal
power of both halves, l the lag, s the camera's motion in pixels, and a the ambient light. The change of ambient light
within a pair is measured in the response, across the common vector. Only three acts change the factors: the sign of a
response is turned, one frame of a pair replaces both, and responses are divided by the lamp's power. Each is accepted
if the moving shadow, estimated afterwards, agrees. Every other fault is refused or counts in the stated error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.devices.session import SIDES, UNIFORM, Half, Side
from mitsim.reconstruct.estimate_factors import (
    LARGEST_ERROR,
    AmbientLight,
    Estimate,
    PairLight,
    StripeSums,
    block_means,
    factors_of_sums,
    without_plane,
)
from mitsim.reconstruct.moving_shadow import MovingShadow

Single = npt.NDArray[np.float32]
MOST_FAULTS = 0.1
"""Part of the patterns that may be wrong before the session is refused: with more, the usual sum is in doubt."""
_MATTERS = 0.5
"""Error over that by noise from which it is reported: both in quadrature are 12 % more."""
_DEVIATIONS = 8.0
"""Robust deviations from the other pairs that make a fault: noise alone goes so far in one session of 10^12."""
_SURE = 5.0
"""Standard deviations at which a pooled number counts as measured."""
_LIKELY = 2.0
"""The same from which its variance counts in the stated error."""
_ALONE = 0.9
"""Unequal power d / c from which only one frame of a pair has light."""
_SLIGHT = 0.02
"""Change of a single frame's power that is not reported by itself: a lamp's flicker makes as much."""
_NEAR = 5
"""Pairs next in time that give the sum which a wrong pair should have had."""
_UNEXPLAINED = 0.05
"""Part of a response's energy, beyond the others' noise, that no separable camera explains where it is a fault: 22 %
of its amplitude."""
_NOISY = 4.0
"""Robust scatter of misfits, over that by noise, up to which they are noise: of 60 good sides none has 1.5."""
_WRONG, _UNLIKE = 40.0, 0.03
"""Squared deviation of a vector from the predicted one, in that of the median pattern and as a part of its own square,
from which a pattern is wrong: of 600 good sides of 64 and 260 of 128 patterns none has more than 17 and 20 of both."""
_FOREIGN = 0.5, 15.0, 15.0
"""Part of a pattern that disagrees, the same in standard errors, and its deviation from which it is wrong too, in noisy
sessions: good ones have 0.93 at 30 and a deviation of 10 (128 patterns), 0.1 at 18 and 17 (64 patterns); swapped
patterns have about 1 at 17 and more, and a deviation of 20."""
_KNOWN = 5.0, 25.0
"""Squared deviation, as a part of its own square, of a pattern that the others determine: 4 if its sign is wrong, and
thousands if they do not; and the deviation from which that does not matter."""
_TURNED = 0.7
"""Part of its deviation that turning a pattern's sign must remove from all patterns."""
_LEAST = 3.0
"""The same in deviations of the median pattern."""
_FEW_LINES, _LINE = 30, 0.15
"""Lines beside those at the ends that predict each other, and the squared deviation of one from the prediction, over
the mean square, from which it is wrong: good cameras of 24 lines reach 0.43."""
_DARK, _LIT = (0.02, 0.3), 0.1
"""Light of a dead sensor row over that of its neighbours at most, and in centred frames, where it has their mean with
the sign turned; and theirs over the median row's at least."""
_NAMED = 12
"""Frames that a message names; the others are counted."""


# ---- Helper functions ------------------------------------------------------------------------------------------------


def robust_scatter(values: FloatArray, middle: float = 0.0) -> float:
    """Return the standard deviation of normal ``values`` about their ``middle`` by the median, which outliers do not
    move."""
    return 1.4826 * float(np.median(np.abs(values - middle)))


def odd_responses(misfits: FloatArray, energies: FloatArray, numbers: int) -> npt.NDArray[np.intp]:
    """Return the responses that no separable camera explains, where it explains the others.

    Parameters
    ----------
    misfits, energies
        (N,) of all responses of a side, with their noise: squares that no common shape explains, and all.
    numbers
        of a response.
    """
    middle = float(np.median(misfits))
    scatter = robust_scatter(misfits, middle)
    excess = misfits - middle - max(_UNEXPLAINED * float(np.median(energies)), _DEVIATIONS * scatter)
    # Where no separable camera explains any, one that is no worse than others says nothing.
    least = 4 * middle if scatter > _NOISY * middle * float(np.sqrt(2 / numbers)) else 0.0
    return np.flatnonzero((excess > _UNEXPLAINED * energies) & (misfits >= least))


def too_many(patterns: int, count: int) -> bool:
    """Return True if so many wrong ``patterns`` leave a session of ``count`` a side in doubt."""
    return patterns > max(2, MOST_FAULTS * 2 * count)


def frame_words(half: Half) -> str:
    """Return which frame of a session a ``half`` is, in words."""
    side, index, sign = half
    return f"{side} stripes {index} of sign {sign:+d}" if sign != UNIFORM else f"{side} stripes {index}"


def _shrunk(
    values: FloatArray, variances: FloatArray, good: npt.NDArray[np.bool_], least: FloatArray | float = 0.0
) -> tuple[FloatArray, FloatArray, float]:
    """Return ``values`` shrunk to 0 by their own ``variances``, the squared error that is left of each, and the
    variance that they share, 0 where it cannot be told from 0.

    The variance that all ``good`` values have beyond their noise is the prior of each; where it cannot be told from 0,
    no value is changed. A value that is sure by itself is kept. The prior's variance is at ``least`` so much.
    """
    beyond, pooled, tiny = np.square(values) - variances, 0.0, np.finfo(np.float64).tiny
    middle = max(float(np.median((beyond / variances)[good])), 0.0)
    usual = good & (beyond < _DEVIATIONS**2 * (1 + middle) * variances)
    for _ in range(4):
        weights = np.where(usual, 1 / np.square(variances + pooled), 0.0)
        total = max(float(weights.sum()), tiny)
        pooled = max(float(np.dot(weights, beyond)) / total, 0.0)
    deviation = float(np.sqrt(2 * np.dot(np.square(weights), np.square(variances)))) / total
    pooled, sure = pooled * (pooled > _LIKELY * deviation), pooled > _SURE * deviation
    prior = np.maximum(np.maximum(least, pooled if sure else 0.0), np.where(beyond > _SURE**2 * variances, beyond, 0.0))
    weight = prior / np.maximum(prior + variances, tiny)
    return weight * values, np.where(prior > 0, weight * variances, pooled), pooled if sure else 0.0


def _pooled_mean(values: FloatArray, variances: FloatArray) -> float:
    """Return the mean of all pairs' ``values``, 0 where it cannot be told from 0."""
    usable = variances > 0
    middle = float(np.median(values[usable]))
    usable &= np.abs(values - middle) <= _DEVIATIONS * max(robust_scatter(values[usable], middle), 1e-300)
    weights = 1 / variances[usable]
    mean = float(np.average(values[usable], weights=weights))
    scatter = float(np.average(np.square(values[usable] - mean), weights=weights))
    return mean if abs(mean) > _SURE * np.sqrt(scatter / usable.sum()) else 0.0


def _least_squares(shapes: Single, values: Single) -> tuple[FloatArray, FloatArray, Single]:
    """Return the coefficients of ``shapes`` (f, P) in ``values`` (P,), their variances for noise of variance 1 (0 for a
    shape that is zero), and the residual."""
    products = (shapes @ shapes.T).astype(np.float64)
    sizes = np.sqrt(np.diag(products))
    scale = np.where(sizes > 0, sizes, np.inf)
    inverse = np.linalg.pinv(products / np.outer(scale, scale), rcond=1e-6, hermitian=True) / np.outer(scale, scale)
    found = inverse @ (shapes @ values)
    return found, np.diag(inverse), values - found.astype(np.float32) @ shapes


# ---- Results ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SessionConditions:
    """How a session was taken.

    Attributes
    ----------
    order
        frames as they were taken.
    name
        of a frame.
    saturated
        whether frames have saturated pixels, which make many pairs add up to less; those sessions are flagged for it,
        and not refused.
    unsteady
        whether it is stated that the lamp is, so that its power is neither divided out nor reported.
    wrong
        frames that are known to be wrong, and why.
    """

    order: Sequence[Half]
    name: Callable[[Half], str] = frame_words
    saturated: bool = False
    unsteady: bool = False
    wrong: Mapping[Half, str] = field(default_factory=dict)


@dataclass(frozen=True)
class SessionFault:
    """One pattern, or one of its frames, that was wrong and is mended.

    Attributes
    ----------
    side, index
        of the pattern.
    sign
        of the frame; None: both frames.
    kind
        ``exchanged``, ``power`` or ``replaced``.
    detail
        the same in words, after the frame's name.
    repair
        what is done about it, in words.
    other
        always None; older manifests have a frame here.
    cost
        relative error of its factor that this leaves beyond the noise.
    """

    side: Side
    index: int
    sign: int | None
    kind: str
    detail: str
    repair: str
    other: Half | None = None
    cost: float = 0.0

    def _names(self, name: Callable[[Half], str]) -> list[str]:
        return [name((self.side, self.index, sign)) for sign in ((1, -1) if self.sign is None else (self.sign,))]

    def words(self, name: Callable[[Half], str]) -> str:
        """Return a sentence; ``name`` gives the name of a frame."""
        cost = f", at a factor error of {self.cost:.1e}" if self.cost else ""
        return f"frames: {' and '.join(self._names(name))}: {self.detail}; {self.repair}{cost}"

    def for_manifest(self, name: Callable[[Half], str]) -> dict[str, Any]:
        """Return the fault for a manifest; ``name`` gives the name of a frame."""
        return {"frames": self._names(name), **asdict(self)}


@dataclass(frozen=True)
class Lamp:
    """Power of the projector over the session.

    Attributes
    ----------
    drift
        change from the session's begin to its end, as a part of its mean.
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

    def for_manifest(self) -> dict[str, float] | None:
        """Return the lamp for a manifest; None if it is steady."""
        return asdict(self) if self.drift or self.flicker else None

    def warnings(self) -> Iterator[str]:
        """Yield a sentence on drift and on flicker, where there is any."""
        drift, flicker = (
            f"drifts by {self.drift:+.1%} over the session",
            f"flickers by {self.flicker:.2%} between frames",
        )
        for size, words, cost, remedy in (
            (self.drift, drift, self.drift_cost, "let it warm up"),
            (self.flicker, flicker, self.flicker_cost, "use a steadier one, or expose for whole periods"),
        ):
            if size:
                yield (
                    f"lamp: its power {words}, a factor error of {cost:.1e} if nothing is done; frames are divided by "
                    f"its power, and {self.remaining:.1e} is left: {remedy}"
                )


@dataclass
class CheckedSession:
    """Sums of a session after the check.

    Attributes
    ----------
    sums
        of horizontal and vertical stripes, faults mended; the very ones that came in where nothing was mended.
    faults
        in the order of the sides and patterns.
    lamp
        how steady it is.
    doubts
        sentences on errors that are not mended and count in the stated error.
    extra
        squared error of each side's vectors beyond their noise.
    uniform
        (rows, columns) uniform response that all patterns share, where that of the uniform frames is wrong: the session
        must then be read again with this one. None where it is right.
    """

    sums: tuple[StripeSums, StripeSums]
    faults: list[SessionFault] = field(default_factory=list)
    lamp: Lamp = field(default_factory=Lamp)
    doubts: list[str] = field(default_factory=list)
    extra: tuple[float, float] = (0.0, 0.0)
    uniform: FloatArray | None = None

    def estimate(self, signs: FloatArray, noise: float | None) -> Estimate:
        """Return the factors.

        Parameters
        ----------
        signs
            (n, N) H.
        noise
            as ``stated_noise`` of :func:`mitsim.reconstruct.estimate_factors.factors_of_sums`.
        """
        return factors_of_sums(*self.sums, signs, noise, self.extra)

    def warnings(self, name: Callable[[Half], str]) -> tuple[str, ...]:
        """Return a sentence for each fault and doubt; ``name`` gives the name of a frame."""
        return (*(fault.words(name) for fault in self.faults), *self.lamp.warnings(), *self.doubts)

    def faults_for_manifest(self, name: Callable[[Half], str]) -> list[dict[str, Any]]:
        """Return the faults for a manifest; ``name`` gives the name of a frame."""
        return [fault.for_manifest(name) for fault in self.faults]


def check_session(
    sums: tuple[StripeSums, StripeSums], signs: FloatArray, taken: SessionConditions, uniform_given: bool = False
) -> CheckedSession:
    """Check a session, mend what can be mended with a check afterwards, and add what is left to the stated error.

    Parameters
    ----------
    sums
        of horizontal and of vertical stripes, all in.
    signs
        (n, N) H.
    taken
        how the session was taken.
    uniform_given
        whether the sums were made with the ``uniform`` response of an earlier check. If not, and the uniform frames of
        one side are wrong, nothing else is judged.

    Raises
    ------
    MitsimError
        for faults that cannot be mended, with the frames that do not fit, or "all frames".
    """
    return _Check(sums, signs, taken).result(uniform_given)


# ---- The check -------------------------------------------------------------------------------------------------------


class _Side:
    """One side of a session while it is checked: ``vectors`` (m, N) as they are mended so far, ``extras`` squared
    errors by their reason, ``axis`` 0 for horizontal stripes."""

    def __init__(self, sums: StripeSums, other: StripeSums, axis: int) -> None:
        self.sums, self.uniform, self.axis = sums, other.common, axis
        self.side: Side = SIDES[axis]
        self.vectors, self.misfits = sums.vectors.copy(), sums.misfits.copy()
        self.extras: dict[str, float] = {}
        self.square = float(np.dot(sums.common, sums.common))
        if sums.pairs:
            self.pairs = PairLight.together(sums.pairs)
            if not sums.centre:  # ambient light that changes within pairs is no noise
                self.ambient = AmbientLight(sums.common, len(self.vectors))
                self.misfits -= self.ambient.energies(self.pairs.ambient)
        self.variance = float(np.median(self.misfits)) / max(len(self.vectors) * (len(sums.common) - 1), 1)
        self.noise = self.variance * len(self.vectors) / self.square
        light = np.square(self.vectors).sum(axis=1)
        around = np.pad(light, 1, constant_values=np.inf)
        around = np.minimum(around[:-2], around[2:])
        self.dead = np.flatnonzero((light < _DARK[sums.centre] * around) & (around > _LIT * np.median(light)))
        self.lost = float(around[self.dead].sum())

    @property
    def size(self) -> float:
        return max(float(np.square(self.vectors).sum()), 1e-300)

    def shadow(self, signs: FloatArray, unknown: Sequence[int] = ()) -> MovingShadow:
        vectors = self.vectors.copy()
        last = len(vectors) - 1
        vectors[self.dead] = (vectors[(self.dead - 1).clip(0)] + vectors[(self.dead + 1).clip(max=last)]) / 2
        return MovingShadow(vectors, signs, unknown)

    def add(self, reason: str, energy: float) -> None:
        self.extras[reason] = self.extras.get(reason, 0.0) + max(energy, 0.0)

    def result(self) -> StripeSums:
        if np.array_equal(self.vectors, self.sums.vectors):
            return self.sums
        return replace(self.sums, vectors=self.vectors, misfit=float(self.misfits.sum()))


class _Check:
    """A session while it is checked. Pairs of both sides are numbered one after the other."""

    def __init__(self, sums: tuple[StripeSums, StripeSums], signs: FloatArray, taken: SessionConditions) -> None:
        self.sums, self.signs, self.taken, self.count = sums, signs, taken, signs.shape[1]
        self.sides = [_Side(sums[axis], sums[1 - axis], axis) for axis in (0, 1)]
        self.paired, self.centre = all(own.pairs for own in sums), sums[0].centre
        self.faults: list[SessionFault] = []
        self.doubts = {"power": "frames are of different power; use a steadier lamp, or pairs"}
        self.lamp, self.ambient_moved = Lamp(), 0.0

    def _halves(self, own: _Side, index: int) -> list[Half]:
        return [(own.side, index, sign) for sign in ((1, -1) if self.paired else (1,))]

    def _of(self, own: _Side, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return those of the ``values`` (2 N, ...) that belong to a side."""
        return values[own.axis * self.count : (own.axis + 1) * self.count]

    def _noise(self) -> float:
        return float(np.sqrt(sum(own.noise * self.count / own.size for own in self.sides)))

    def _refuse(self, wrong: Sequence[tuple[_Side, int]], reason: str) -> NoReturn:
        """Raise MitsimError that names the frames of ``wrong`` patterns."""
        names = [self.taken.name(half) for own, index in wrong for half in self._halves(own, index)]
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        raise MitsimError(f"frames: {', '.join(names[:_NAMED])}{more}: {reason}; take them again")

    def result(self, uniform_given: bool) -> CheckedSession:
        uniform = None
        if self.paired:
            bad = self._fit_sums()
            if self.taken.saturated and too_many(int(bad.sum()), self.count):
                return CheckedSession(self.sums)
            wrong = [(own, int(index)) for own in self.sides for index in np.flatnonzero(self._of(own, bad))]
            if too_many(len(wrong), self.count):
                raise MitsimError(
                    f"all frames: the two frames of {len(wrong)} of {2 * self.count} patterns do not add up to what "
                    f"others do; check their order, that nothing moves (by {self.moved:.1g} pixels, as it seems), and "
                    "that numbers are in proportion to light"
                )
            uniforms = [(own, 0) for own, index in wrong if index == 0]
            if len(uniforms) == 2:
                self._refuse(uniforms, "the uniform frames of both sides do not add up to what others do")
            if uniforms and not uniform_given:
                doubt = f"frames: the uniform frames of {uniforms[0][0].side} stripes are wrong; take them again"
                return CheckedSession(self.sums, doubts=[doubt], uniform=self._uniform())
            self._correct()
            powers, deviations = self.values[[0, self.count], 1], np.sqrt(self.variances[[0, self.count], 1])
            # Ambient light or power that differ in the uniform frames are in the vectors that all responses share.
            if not uniform_given and (
                abs(powers[0] - powers[1]) > max(_SLIGHT, _DEVIATIONS * deviations.max())
                or self.ambient_moved > (_MATTERS * self._noise()) ** 2
            ):
                uniform = self._uniform()
            self._report()
            for own, index in wrong:
                self._use_one_frame(own, index)
        elif self.taken.wrong:
            known = sorted({(SIDES.index(side), index) for side, index, _ in self.taken.wrong})
            self._refuse([(self.sides[axis], index) for axis, index in known], next(iter(self.taken.wrong.values())))
        parts = [
            abs(float(np.dot(own.vectors[:, 0], own.uniform) / np.dot(own.uniform, own.uniform))) for own in self.sides
        ]
        apart = abs(parts[0] - parts[1])  # both sides' uniform responses are one
        for own in self.sides:
            if not self.paired and apart > _SLIGHT:
                own.add("power", (apart / 2) ** 2 * own.size)
            if len(own.dead):
                own.add("dead", own.lost)
                word = "row" if own.axis == 0 else "column"
                self.doubts["dead"] = f"sensor {word} {own.dead[0]} shows no light; check the sensor"
            self._check_shadow(own)
        return self._judge(uniform)

    # ---- sums of pairs -----------------------------------------------------------------------------------------------

    def _fit_sums(self) -> npt.NDArray[np.bool_]:
        """Fit the sums of all pairs; return (2 N,) whether pairs do not fit."""
        places = {half: place for place, half in enumerate(self.taken.order)}
        halves = [self._halves(own, index) for own in self.sides for index in range(self.count)]
        self.times = np.array([np.mean([places[half] for half in each]) for each in halves]) / len(places)
        sums = np.concatenate([own.pairs.blocks for own in self.sides])
        lit = sums.mean(axis=0)  # noise of light is larger where there is more
        bright = float(np.mean(lit**3) / (np.mean(lit) * np.mean(lit**2))) if lit.min() >= 0 else 1.0
        if self.centre:
            sums -= sums.mean(axis=2, keepdims=True)
            sums -= sums.mean(axis=1, keepdims=True)
        self.shape, sums = sums.shape[1:], sums.reshape(len(sums), -1)
        self.along = [block_means(own.uniform) for own in self.sides]
        self.squares = [max(float(np.square(each).sum()), 1e-300) for each in self.along[::-1]]
        moved = [block_means(np.gradient(own.uniform)) for own in self.sides]
        fixed = [np.outer(*self.along), np.outer(moved[0], self.along[1]), np.outer(self.along[0], moved[1])]
        if not self.centre:
            (y, x), (one, same) = ([make(k) for k in self.shape] for make in (lambda k: np.linspace(-1, 1, k), np.ones))
            fixed += [np.outer(one, same), np.outer(y, same), np.outer(one, x)]
        shown = [block_means(own.sums.vectors) for own in self.sides]
        left, right = np.einsum("ik,j->kij", shown[0], self.along[1]), np.einsum("i,jk->kij", self.along[0], shown[1])
        responses = np.concatenate([left, right]).reshape(len(sums), -1).astype(np.float32)
        first = np.arange(2) * self.count
        lagged, self.own_before = np.zeros_like(sums), np.zeros(len(sums))
        numbers = {half: number for number, each in enumerate(halves) for half in each}
        for last, half in zip(self.taken.order, self.taken.order[1:], strict=False):
            if numbers[last] == numbers[half]:
                self.own_before[numbers[half]] += last[2] / 2
            elif last[1]:  # the uniform pattern's light looks like the lamp's power
                lagged[numbers[half]] += np.float32(last[2] / 2) * responses[numbers[last]]
        responses[first] = 0.0  # the uniform pattern has one lit frame
        usual, shapes = np.median(sums, axis=0), np.stack(fixed).reshape(len(fixed), -1).astype(np.float32)
        found = [
            _least_squares(np.vstack([responses[k], shapes, lagged[k]]), one - usual) for k, one in enumerate(sums)
        ]
        self.values, variances, rest = (np.stack(part) for part in zip(*found, strict=True))
        self.lag = _pooled_mean(self.values[:, -1], variances[:, -1])
        sums -= usual + np.median(rest, axis=0) + np.float32(self.lag) * lagged
        found = [_least_squares(np.vstack([responses[k], shapes]), one) for k, one in enumerate(sums)]
        self.values, variances, rest = (np.stack(part) for part in zip(*found, strict=True))
        order, few = np.argsort(self.times), max(4, len(sums) // 16)
        self.ends = np.stack([np.median(self.values[part, 2:4], axis=0) for part in (order[:few], order[-few:])])
        self.moved = float(np.abs(self.ends[1] - self.ends[0]).max())
        squared = np.square(rest).mean(axis=1)
        area = np.prod([len(own.vectors) for own in self.sides]) / rest.shape[1]
        noise = min(float(np.median(squared)), min(own.variance for own in self.sides) / area)
        noise = max(noise, 1e-13 * float(np.square(usual).mean()))
        self.variances, spent = variances * noise * bright, variances.shape[1]
        # Deviations along the common vector are errors of the response's vector, whatever their cause.
        excess, alone = [], []
        for own in self.sides:
            expected = noise / self.squares[own.axis] * len(own.vectors) * (1 - spent / self.shape[own.axis])
            expected *= 1 + np.pi / 2 / len(sums)  # the usual sum is a median
            deviation = expected * np.sqrt(2 * self.count / self.shape[own.axis])
            energy = self._energy_along(own, rest)
            excess.append((energy - expected) * ((energy - expected).sum() > _SURE * deviation))
            alone.append(energy / max(expected, 1e-300))
        self.excess = np.concatenate(excess)
        bad = np.abs(self.values[:, 0]) > _ALONE  # one frame is black, so that power cannot be divided out
        bad[[numbers[half] for half in self.taken.wrong]] = True
        for measure in (squared / noise, np.concatenate(alone)):
            middle = max(float(np.median(measure)), 1.0)
            bad |= measure > max(2 * middle, middle + _DEVIATIONS * robust_scatter(measure, middle))
        self.good = ~bad
        return np.asarray(bad)

    def _energy_along(self, own: _Side, rest: FloatArray) -> FloatArray:
        """Return (N,) squared length of the vectors that the residuals ``rest`` of a side have along the common one."""
        frames, common = self._of(own, rest).reshape(-1, *self.shape), self.along[1 - own.axis]
        vectors = (frames @ common if own.axis == 0 else common @ frames) / self.squares[own.axis]
        if self.centre:
            vectors = vectors - vectors.mean(axis=1, keepdims=True)
        return np.asarray(np.square(vectors).sum(axis=1) * len(own.vectors) / self.shape[own.axis])

    def _uniform(self) -> FloatArray:
        """Return the uniform response whose vectors are those that the other patterns share, and whose size is that of
        the uniform frames that fit."""
        right, left = (
            own.pairs.across[used].sum(axis=0) / np.square(without_plane(own.sums.vectors[:, used])).sum()
            for own, used in ((own, self._of(own, self.good)) for own in self.sides)
        )
        sizes = []
        for own, vector, common in zip(self.sides, (left, right), (right, left), strict=True):
            # D_0 = g vector common^T and ambient light, projected on the common vector of the sums.
            parts = np.column_stack([vector, np.vander(np.linspace(-1, 1, len(vector)), 2)])
            share = float(np.dot(common, own.sums.common)) / own.square
            sizes.append(abs(float(np.linalg.lstsq(parts, own.sums.vectors[:, 0], rcond=None)[0][0])) / share)
        return np.asarray(np.outer(left, right) * np.mean(np.array(sizes)[self.good[:: self.count]]))

    # ---- what the sums show of lamp, lag, bend, motion and ambient light ---------------------------------------------

    def _correct(self) -> None:
        """Subtract ambient light, divide by the lamp's power, and count what is left as errors."""
        for own in self.sides:
            own.add("sums", float(self._of(own, self.excess * self.good).sum()))
            if not self.centre:
                self._subtract_ambient(own)
            # A lagging frame has 1 - 1.5 l of its response and -l / 2 of the one before; a factor is its root.
            own.add("lag", self.lag**2 * (0.75**2 + 0.5**2) * own.size)
            # Differences of neighbours: those of every second pixel do not see the finest detail.
            steep = self._of(own, self.good) * np.square(np.diff(own.vectors, axis=0)).sum(axis=0)
            moves = self.values[:, 2 + own.axis]
            away = np.square(moves - np.median(moves[self.good])) / self.variances[:, 2 + own.axis]
            if np.mean(away[self.good]) > 1 + _SURE * np.sqrt(2 / self.good.sum()):
                ends = self.ends[:, own.axis]
                own.add("motion", max(float(np.square(self._of(own, moves) - end) @ steep) for end in ends))
        self.doubts |= {
            "lag": f"each frame holds {self.lag:.1%} of the one before; wait longer between frames",
            "bend": "numbers are not in proportion to light; switch gamma and other processing off, expose for less",
            "motion": f"camera or mask move by {self.moved:.2g} pixels; fasten them",
            "sums": "pairs add up to light that changes in an unknown way; check ambient light, lamp and sensor",
        }
        if not self.taken.unsteady:
            self._divide()

    def _subtract_ambient(self, own: _Side) -> None:
        """Subtract the change of ambient light within pairs from the vectors."""
        good, light = self._of(own, self.good), own.ambient
        for found, effect, scale in zip(own.pairs.ambient.T, light.effects, light.variances, strict=True):
            kept, left, _ = _shrunk(found, np.full(self.count, own.variance * scale), good)
            own.vectors -= np.outer(effect, kept)
            size = float(np.square(effect).sum())
            own.add("ambient", float(left.sum()) * size)
            self.ambient_moved += float(np.square(kept)[good].sum()) * size / own.size

    def _divide(self) -> None:
        """Divide vectors by the lamp's power in their frames, c + d in Y+ and c - d in Y-.

        D' = c D + d U and S = c U + d D are measured, and S = (c - d^2 / c) U + (d / c) D' is fitted.
        """
        power, ratio = self.values[:, 1], self.values[:, 0] - self.lag * self.own_before
        first = np.arange(2) * self.count
        unit = 1 / max(1 - float(np.mean(power[first])), 0.1)
        usable = self.good
        sure = usable & (np.square(ratio) > _SURE**2 * self.variances[:, 0])
        both = (1 + power * unit) / (1 - np.where(sure, np.square(ratio), 0.0))
        degree, kept = min(3, max(len(np.unique(self.times)) // 4, 0)), usable
        for _ in range(4):
            trend = np.polynomial.Polynomial.fit(self.times[kept], both[kept], degree)(self.times)
            away = np.abs(both - trend)
            kept = usable & (away <= _DEVIATIONS * max(robust_scatter(away[usable]), 1e-12))
        both, trend = both / float(np.mean(trend)), trend / float(np.mean(trend))
        variances = self.variances[:, 1] * unit**2
        drifts = np.var(trend) > _SURE**2 * np.median(variances) * (degree + 1) / usable.sum()
        trend = trend if drifts else np.ones(len(both))
        own_power, left, shaken = _shrunk(both - trend, variances, usable)
        patterned = self.variances[:, 0] > 0
        # A single frame of other power changes both alike.
        ratio_variances, alike = np.where(patterned, self.variances[:, 0], 1.0), np.square(own_power)
        ratio, left_ratio, uneven = _shrunk(ratio, ratio_variances, usable & patterned, alike)
        own_power, ratio = np.where(usable, own_power, 0.0), np.where(usable & patterned, ratio, 0.0)
        powers, flicker = trend + own_power, float(np.sqrt(shaken + uneven))
        mean = float(np.sqrt(np.mean(powers[first])))
        # Two uniform frames that differ from the sums alike show no lamp: numbers are not in proportion to light.
        bent = own_power[first] / trend[first]
        bent = float(np.abs(bent).min()) if bent[0] * bent[1] > 0 else 0.0
        costs = np.zeros(2)
        for own in self.sides:
            size, whole, energies = own.size, float(np.square(own.uniform).sum()), np.square(own.vectors).sum(axis=0)
            c, d, slow, keep = (self._of(own, each) for each in (powers, powers * ratio, trend, usable))
            costs += [np.square(slow - 1) @ energies / size, (np.square(c - slow) @ energies + d @ d * whole) / size]
            own.vectors = (own.vectors - np.outer(own.uniform / mean**2, d)) / c * mean
            noise = own.noise * float((1 / np.square(c) - 1)[keep].clip(0).sum())
            lost = self._of(own, left) * energies + self._of(own, left_ratio * patterned) * whole
            # The factors are those of the mean power; a capture may have any that the session had.
            range_ = float(np.abs(trend - 1).max()) / 2
            own.add("lamp", noise + float(lost[keep].sum()) + range_**2 * own.size)
            own.add("bend", bent**2 / 2 * own.size * (bent > max(_SLIGHT / 2, 3 * flicker)))
            parts = np.stack([(1 + sign * self._of(own, ratio)) * c / slow - 1 for sign in (1, -1)])
            parts[1, 0] = 0.0  # the uniform pattern has one lit frame
            wrong = np.abs(parts) > np.maximum(max(_SLIGHT, _DEVIATIONS * flicker), 4 * np.abs(parts[::-1]))
            for half, index in zip(*np.nonzero(wrong & keep), strict=True):
                detail = f"it has {1 + parts[half, index]:.3g} of its light"
                repair = "its response is divided by that"
                self.faults.append(SessionFault(own.side, int(index), 1 - 2 * int(half), "power", detail, repair))
        drift, flickers = (float(cost) if cost > _MATTERS * self._noise() else 0.0 for cost in np.sqrt(costs))
        change = float(trend[np.argmax(self.times)] - trend[np.argmin(self.times)])
        remaining = float(np.sqrt(sum(own.extras["lamp"] / own.size for own in self.sides)))
        corrected = bool(drift or flickers)
        self.lamp = Lamp(change * bool(drift), flicker * bool(flickers), drift, flickers, remaining, corrected)

    # ---- the moving shadow -------------------------------------------------------------------------------------------

    def _use_one_frame(self, own: _Side, index: int) -> None:
        """Replace a response by twice one of its frames less the usual sum; refused unless the moving shadow agrees."""
        known = [half[2] for half in self.taken.wrong if half[:2] == (own.side, index)]
        reason = "the two do not add up to what others do"
        reason = f"is wrong: {self.taken.wrong[own.side, index, known[0]]}" if known else reason
        own.misfits[index] = np.median(own.misfits)
        if index == 0:
            own.vectors[:, 0] = own.uniform
            repair = "those of the other side replace them"
            self.faults.append(SessionFault(own.side, 0, None, "replaced", reason, repair))
            return
        times = self._of(own, self.times)
        right = np.flatnonzero(self._of(own, self.good))
        near = right[np.argsort(np.abs(times[right] - times[index]))[:_NEAR]]
        away = own.pairs.light[:, index] - np.median(own.pairs.light[:, near], axis=1)
        tried, scores = {}, dict[int, float]()
        for wrong in known or (1, -1):
            own.vectors[:, index] = tried[wrong] = own.sums.vectors[:, index] - wrong * away
            shadow = own.shadow(self.signs)
            fits = shadow.deviations[index] <= _WRONG or shadow.unlike[index] <= _UNLIKE
            if len(known) < 2 and fits and (known or shadow.predicts):
                scores[wrong] = float(shadow.deviations[index])
        if not scores:
            self._refuse([(own, index)], reason)
        sign = min(scores, key=lambda wrong: scores[wrong])
        own.vectors[:, index] = tried[sign]
        # Twice one frame less the usual sum has the noise of both halves once more, and that of the sum.
        error = 1.5 * own.noise
        if len(scores) > 1 and scores[sign] > scores[-sign] / 2:  # the shadow does not decide between the frames
            error += float(np.square(away).sum())
        own.add("replaced", error)
        repair, cost = "the other frame of its pair replaces it", float(np.sqrt(error / own.size))
        self.faults.append(SessionFault(own.side, index, sign, "replaced", reason, repair, cost=cost))

    def _check_shadow(self, own: _Side) -> None:
        """Turn the signs of patterns whose two frames are exchanged; refuse patterns and lines that are foreign."""
        sums, turned, foreign = own.sums, set[int](), list[int]()
        odd = odd_responses(own.misfits, sums.energies, len(own.vectors) * len(sums.common))
        if len(odd):
            self._refuse([(own, int(index)) for index in odd], f"they show no {own.side} stripes")

        def turn(indices: Sequence[int]) -> None:
            own.vectors[:, indices] *= -1
            turned.symmetric_difference_update(indices)

        if np.dot(own.vectors[:, 0], own.uniform) < 0:
            turn([0])
        for _ in range(int(MOST_FAULTS * self.count) + 3):
            shadow = own.shadow(self.signs, foreign)
            if not shadow.predicts:
                break
            doubtful = (shadow.deviations > _WRONG) & (shadow.unlike > _UNLIKE)
            known = (shadow.unlike < _KNOWN[0]) | (shadow.deviations > _KNOWN[1])
            known &= shadow.deviations > _FOREIGN[2]
            doubtful |= known & (shadow.shares > _FOREIGN[0]) & (shadow.sure > _FOREIGN[1])
            far = np.where(doubtful, shadow.deviations, 0.0)
            gains = np.where(shadow.by_turning > _TURNED * shadow.deviations, shadow.by_turning, 0.0)
            far[[0, *foreign]] = gains[foreign] = 0.0
            best = int(np.argmax(gains))
            if gains[best] > max(_LEAST, _TURNED * far.max()):
                turn([best] if best else range(1, self.count))  # the light decides on the sign of pattern 0
            elif far.any():
                foreign.append(int(np.argmax(far)))
            else:
                break
        else:
            raise MitsimError(f"all frames: many of the {own.side} stripes are in no order; check their order")
        if foreign and (doubts := self._report()):
            raise MitsimError(f"all frames: {doubts[0]}, and most patterns disagree; take the session again")
        if foreign:
            wrong = [(own, index) for index in sorted(foreign)]
            self._refuse(wrong, f"they show other {own.side} stripes than the other patterns predict")
        if not shadow.predicts and 0 < len(turned) < self.count:
            self._refuse([(own, index) for index in turned], "they are in each other's place")
        all_pairs = len(turned) == self.count
        for index in [0] if all_pairs else sorted(turned):
            detail = (
                f"in each other's place, as in all pairs of {own.side} stripes"
                if all_pairs
                else "in each other's place"
            )
            repair = "they count in their right order"
            sign = None if self.paired else 1
            self.faults.append(SessionFault(own.side, index, sign, "exchanged", detail, repair))
        # The lines at the ends are predicted from one side only, and few lines hardly predict each other.
        inner = shadow.lines[1:-1]
        if shadow.predicts and len(inner) > _FEW_LINES and inner.max() > _LINE:
            raise MitsimError(
                f"all frames: line {1 + int(np.argmax(inner))} of the {own.side} stripes is not as bright as its "
                "neighbours predict; check the projector, uniform and dark frames, and take the session again"
            )
        if shadow.predicts and not self.paired:
            shown = np.square(own.vectors + own.vectors[:, :1]).sum(axis=0)
            squares, variances = np.square(shadow.powers()[0]), shadow.powers()[1]
            counted = (squares > _SLIGHT**2) | (np.median(squares / variances) > _LIKELY**2)
            own.add("power", float(((squares - variances) * counted)[1:] @ shown[1:]))

    def _report(self) -> list[str]:
        """Return sentences on the errors that matter, the largest first; MitsimError for more than a tenth."""
        reasons = {reason for own in self.sides for reason in own.extras}
        energies = {each: sum(own.extras.get(each, 0.0) / own.size for own in self.sides) for each in reasons}
        order, total = sorted(reasons, key=lambda each: -energies[each]), float(np.sqrt(sum(energies.values())))
        if total > LARGEST_ERROR:
            reason = self.doubts.get(order[0], "power or ambient light change too much")
            raise MitsimError(
                f"all frames: {reason}: an error of {total:.0%} is left in the factors, allowed are "
                f"{LARGEST_ERROR:.0%}; take the session again"
            )
        most = (_MATTERS * self._noise()) ** 2
        return [
            f"{self.doubts[each]}; the stated error includes {np.sqrt(energies[each]):.1e} for it"
            for each in order
            if each in self.doubts and energies[each] > most
        ]

    def _judge(self, uniform: FloatArray | None) -> CheckedSession:
        """Report the errors that matter."""
        doubts, noise = [f"session: {words}" for words in self._report()], self._noise()
        if self.ambient_moved > (_MATTERS * noise) ** 2:
            doubts.append(
                f"session: ambient light changes between the two frames of pairs, a factor error of "
                f"{np.sqrt(self.ambient_moved):.1e} if nothing is done; it is subtracted: darken the room"
            )
        first, second = self.sides
        return CheckedSession(
            (first.result(), second.result()),
            sorted(self.faults, key=lambda fault: (SIDES.index(fault.side), fault.index)),
            self.lamp,
            doubts,
            (sum(first.extras.values()), sum(second.extras.values())),
            uniform,
        )
