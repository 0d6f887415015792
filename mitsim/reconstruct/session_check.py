"""Check of a calibration session by measurement, and the error that its faults leave in the factors.

Three redundancies hold for every good session. The two frames of a pair add up to one frame for all patterns. The
responses of one side are the shadow of one mask that moves (:mod:`mitsim.reconstruct.moving_shadow`). Both sides share
the lamp and the time.

Therefore the sum S_k of each pair is fitted over all pixels and in time::

    S_k = S + c_k U + d_k R_k + l_k R_(k-1) + q_k R_k^2 + s_k . grad U + a_k . (1, y, x) + b_k . B

with S the usual sum, U the response to uniform light, R_k that to pattern k, and B shapes found in the residual. c is
the lamp's power, d the unequal power of both halves, l the lag, q the bend of the response to light, s the camera's
motion in pixels, and a the ambient light. The change of ambient light within a pair is measured in the response, across
the common vector. Only three acts change the factors: the sign of a response is turned, one frame of a pair replaces
both, and responses are divided by the lamp's power. Each is accepted if the moving shadow, estimated afterwards, agrees.
Every other fault is refused or counts in the stated error.
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
    Estimate,
    PairLight,
    StripeSums,
    ambient_energy,
    ambient_shapes,
    block_means,
    factors_of_sums,
    inverse_slope,
    without_plane,
)
from mitsim.reconstruct.moving_shadow import MovingShadow

MOST_FAULTS = 0.1
"""Part of the patterns that may be wrong before the session is refused: with more, the usual sum is in doubt."""
_MATTERS = 0.5
"""Error over that by noise from which it is reported: both in quadrature are 12 % more."""
_DEVIATIONS = 8.0
"""Robust deviations from the other pairs that make a fault: noise alone goes so far in one session of 10^12."""
_SURE = 5.0
"""Standard deviations at which a pooled number counts as measured."""
_ALONE = 0.9
"""Unequal power d / c from which only one frame of a pair has light."""
_SLIGHT = 0.02
"""Change of a single frame's power that is not reported by itself: a lamp's flicker makes as much."""
_NEAR = 5
"""Pairs next in time that give the sum which a wrong pair should have had."""
_SHAPES = 2
"""Shapes that are looked for in the residual of the sums: a cloud, hot columns; a band's sine and cosine."""
_ENOUGH = 16, 64
"""Patterns, and sensor rows, from which the moving shadow predicts patterns."""
_UNEXPLAINED = 0.05
"""Part of a response's energy, beyond the others' noise, that no separable camera explains where it is a fault: 22 %
of its amplitude."""
_NOISY = 4.0
"""Robust scatter of misfits, over that by noise, up to which they are noise: of 60 good sides none has 1.5."""
_WRONG, _UNLIKE = 40.0, 0.1
"""Squared deviation of a vector from the predicted one, in that of the median pattern and as a part of its own square,
from which a pattern is wrong: of 600 good sides of 64 and 260 of 128 patterns none has more than 17 and 20 of both."""
_TURNED = 0.7
"""Part of its deviation that turning a pattern's sign must remove from all patterns."""
_LEAST = 3.0
"""The same in deviations of the median pattern."""
_LINE = 0.15
"""Squared deviation of a column from what the others predict, over the mean square, from which a line is wrong."""
_DARK = 0.1
"""Light of a sensor row over that of its neighbours below which it is dead."""
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
    values: FloatArray, variances: FloatArray, good: npt.NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray, float]:
    """Return ``values`` shrunk to 0 by their own ``variances``, the squared error that is left of each, and the variance
    that they share, 0 where it cannot be told from 0.

    The variance of the true values is that of all ``good`` ones beyond the noise; where it cannot be told from 0, no
    value is changed. A value that is sure by itself is kept.
    """
    beyond = np.square(values) - variances
    middle = max(float(np.median((beyond / variances)[good])), 0.0)
    usual = good & (beyond < _DEVIATIONS**2 * (1 + middle) * variances)
    pooled = 0.0
    for _ in range(4):
        weights = np.where(usual, 1 / np.square(variances + pooled), 0.0)
        total = max(float(weights.sum()), np.finfo(np.float64).tiny)
        pooled = max(float(np.dot(weights, beyond)) / total, 0.0)
    sure = pooled > _SURE * np.sqrt(2 * np.dot(np.square(weights), np.square(variances))) / total
    prior = np.maximum(pooled if sure else 0.0, np.where(beyond > _SURE**2 * variances, beyond, 0.0))
    weight = prior / np.maximum(prior + variances, np.finfo(np.float64).tiny)
    return weight * values, np.where(prior > 0, weight * variances, pooled), pooled if sure else 0.0


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
    step
        between two numbers of a frame, as the responses have it; 0: none.
    wrong
        frames that are known to be wrong, and why.
    """

    order: Sequence[Half]
    name: Callable[[Half], str] = frame_words
    saturated: bool = False
    unsteady: bool = False
    step: float = 0.0
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
        done = f"frames are divided by its power, and {self.remaining:.1e} is left" if self.corrected else "not corrected"
        if self.drift:
            yield (
                f"lamp: its power drifts by {self.drift:+.1%} over the session, a factor error of "
                f"{self.drift_cost:.1e} if nothing is done; {done}: let it warm up"
            )
        if self.flicker:
            yield (
                f"lamp: its power flickers by {self.flicker:.2%} from frame to frame, a factor error of "
                f"{self.flicker_cost:.1e} if nothing is done; {done}: use a steadier one, or expose for whole periods"
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
    left_out
        responses of each side whose misfit is not counted.
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
    left_out: tuple[int, int] = (0, 0)
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
        return factors_of_sums(*self.sums, signs, noise, self.left_out, self.extra)

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
    errors by their reason, ``uncounted`` responses whose misfit does not count, ``axis`` 0 for horizontal stripes."""

    def __init__(self, sums: StripeSums, other: StripeSums, axis: int) -> None:
        self.sums, self.uniform, self.axis = sums, other.common, axis
        self.side: Side = SIDES[axis]
        self.vectors = sums.vectors.copy()
        self.extras: dict[str, float] = {}
        self.uncounted: set[int] = set()
        self.pairs = PairLight.together(sums.pairs) if sums.pairs else None
        self.misfits = sums.misfits.copy()
        if self.pairs is not None and not sums.centre:  # ambient light that changes within pairs is no noise
            self.misfits -= ambient_energy(sums.common, len(self.vectors), self.pairs.ambient)
        self.variance = float(np.median(self.misfits)) / max(len(self.vectors) * (len(sums.common) - 1), 1)
        self.noise = self.variance * len(self.vectors) / float(np.dot(sums.common, sums.common))

    @property
    def size(self) -> float:
        return max(float(np.square(self.vectors).sum()), 1e-300)

    def add(self, reason: str, energy: float) -> None:
        self.extras[reason] = self.extras.get(reason, 0.0) + max(energy, 0.0)

    def result(self) -> StripeSums:
        if not self.uncounted and np.array_equal(self.vectors, self.sums.vectors):
            return self.sums
        kept = np.setdiff1d(np.arange(self.sums.done), sorted(self.uncounted))
        misfit, energy = float(self.misfits[kept].sum()), float(self.sums.energies[kept].sum())
        return replace(self.sums, vectors=self.vectors, misfit=misfit, energy=energy)


class _Check:
    """A session while it is checked. Pairs of both sides are numbered one after the other."""

    def __init__(self, sums: tuple[StripeSums, StripeSums], signs: FloatArray, taken: SessionConditions) -> None:
        self.signs, self.taken, self.count = signs, taken, signs.shape[1]
        self.sides = [_Side(sums[axis], sums[1 - axis], axis) for axis in (0, 1)]
        self.paired = all(own.pairs is not None for own in self.sides)
        self.faults: list[SessionFault] = []
        self.doubts: dict[str, str] = {}
        self.lamp, self.ambient_moved = Lamp(), 0.0
        places = {half: place / max(len(taken.order) - 1, 1) for place, half in enumerate(taken.order)}
        self.times = np.array([
            np.mean([places[half] for half in self._halves(own, index) if half in places])
            for own in self.sides
            for index in range(self.count)
        ])  # fmt: skip
        self.enough = self.count >= _ENOUGH[0] and min(len(own.vectors) for own in self.sides) >= _ENOUGH[1]

    def _halves(self, own: _Side, index: int) -> list[Half]:
        return [(own.side, index, sign) for sign in ((1, -1) if self.paired else (1,))]

    def _refuse(self, wrong: Sequence[tuple[_Side, int]], reason: str, remedy: str = "take them again") -> NoReturn:
        """Raise MitsimError that names the frames of patterns."""
        names = [self.taken.name(half) for own, index in wrong for half in self._halves(own, index)]
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        raise MitsimError(f"frames: {', '.join(names[:_NAMED])}{more}: {reason}; {remedy}")

    def _of(self, own: _Side, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return values[own.axis * self.count : (own.axis + 1) * self.count]

    def result(self, uniform_given: bool) -> CheckedSession:
        sums, contaminated = (self.sides[0].sums, self.sides[1].sums), None
        if self.paired:
            bad = self._check_sums()
            if self.taken.saturated and too_many(int(bad.sum()), self.count):
                return CheckedSession(sums)
            wrong = [(own, int(index)) for own in self.sides for index in np.flatnonzero(self._of(own, bad))]
            if too_many(len(wrong), self.count):
                raise MitsimError(
                    f"all frames: the two frames of {len(wrong)} of {2 * self.count} patterns do not add up to what "
                    "others do; check the frames' order and what was shown, and take the session again"
                )
            uniforms = [own for own, index in wrong if index == 0]
            if len(uniforms) == 2:
                self._refuse([(own, 0) for own in uniforms], "the uniform frames of both sides do not add up")
            if uniforms and not uniform_given:
                names = [self.taken.name(half) for half in self._halves(uniforms[0], 0)]
                doubt = f"frames: {' and '.join(names)}: the uniform frames of one side are wrong"
                return CheckedSession(sums, doubts=[doubt], uniform=self._uniform(1 - uniforms[0].axis))
            self._correct()
            contaminated = None if uniform_given or not self._is_contaminated() else self._uniform()
            for own, index in wrong:
                self._use_one_frame(own, index, bad)
        elif self.taken.wrong:
            wrong_ones = {(self.sides[SIDES.index(side)], index) for side, index, _ in self.taken.wrong}
            self._refuse(sorted(wrong_ones, key=lambda one: (one[0].axis, one[1])), next(iter(self.taken.wrong.values())))
        for own in self.sides:
            self._check_shadow(own)
            self._count_rounding(own)
            self._count_dark_rows(own)
        return self._judge(contaminated)

    # ---- sums of pairs -----------------------------------------------------------------------------------------------

    def _check_sums(self) -> npt.NDArray[np.bool_]:
        """Fit the sums of all pairs; return (2 N,) whether pairs do not fit."""
        a, v = (own.uniform for own in self.sides)
        self.centre = self.sides[0].sums.centre
        blocks = np.concatenate([own.pairs.blocks for own in self.sides if own.pairs]).astype(np.float64)
        if self.centre:
            rows, columns = blocks.mean(axis=2, keepdims=True), blocks.mean(axis=1, keepdims=True)
            blocks += blocks.mean(axis=(1, 2), keepdims=True) - rows - columns
        self.shape, sums = blocks.shape[1:], blocks.reshape(len(blocks), -1)
        self.along = block_means(a, 0), block_means(v, 0)
        moved = [block_means(np.gradient(each), 0) for each in (a, v)]
        y, x = (np.linspace(-1, 1, length) for length in self.shape)
        common = [np.outer(*self.along), np.outer(moved[0], self.along[1]), np.outer(self.along[0], moved[1])]
        if not self.centre:
            common += [np.ones(self.shape), np.outer(y, np.ones(len(x))), np.outer(np.ones(len(y)), x)]
        shown = [block_means(own.sums.vectors, 0) for own in self.sides]
        squares = sum(
            np.outer(*(np.square(each).mean(axis=1) if number == own.axis else np.square(self.along[number])
                       for number, each in enumerate((shown[0], shown[1]))))
            for own in self.sides
        ) / 2  # fmt: skip

        def response(axis: int, index: int) -> FloatArray:
            own = shown[axis][:, index]
            return np.outer(own, self.along[1]) if axis == 0 else np.outer(self.along[0], own)

        before = dict(zip(self.taken.order[1:], self.taken.order, strict=False))
        usual, self.good = np.median(sums, axis=0), np.ones(len(sums), bool)
        self.lag = self.bend = 0.0
        shapes: list[FloatArray] = []
        for turn in range(2 + _SHAPES):
            found = [
                self._fit(own, index, sums[own.axis * self.count + index] - usual, response, before, common + shapes, squares, not turn)
                for own in self.sides for index in range(self.count)
            ]  # fmt: skip
            rest = np.stack([each[2] for each in found])
            self.values, variances = (np.stack([each[part] for each in found]) for part in (0, 1))
            if not turn:
                usual = usual + np.median(rest, axis=0)
                self.lag, self.bend = (self._pooled(self.values[:, -part], variances[:, -part]) for part in (2, 1))
            else:
                shape = self._shape_in(rest) if len(shapes) < _SHAPES else None
                if shape is None:
                    break
                shapes.append(shape)
        squared = np.square(rest).mean(axis=1)
        area = np.prod([len(own.vectors) for own in self.sides]) / rest.shape[1]
        noise = min(float(np.median(squared)), min(own.variance for own in self.sides) / area)
        noise = max(noise, 1e-14 * float(np.square(usual).mean()))
        self.variances = variances * noise
        # Deviations along the common vector are errors of the response's vector, whatever their cause.
        shape_part = self.values[:, 1 + len(common) :] @ np.array([each.ravel() for each in shapes]).reshape(len(shapes), -1) if shapes else 0.0
        excess, alone = [], []
        for own in self.sides:
            common_vector = self.along[1 - own.axis]
            square = float(np.dot(common_vector, common_vector))

            def energy(values: FloatArray, own: _Side = own, along: FloatArray = common_vector, square: float = square) -> FloatArray:
                frames = values.reshape(-1, *self.shape)
                projected = (frames @ along if own.axis == 0 else along @ frames) / square
                projected = projected - projected.mean(axis=1, keepdims=True) if self.centre else projected
                return np.asarray(np.square(projected).sum(axis=1) * len(own.vectors) / self.shape[own.axis])

            expected = noise / square * len(own.vectors) * (1 - len(found[0][0]) / self.shape[own.axis])
            excess.append(energy(self._of(own, rest + shape_part)) - expected)
            alone.append(energy(self._of(own, rest)) / max(expected, 1e-300))
        self.excess = np.concatenate(excess)
        bad = np.zeros(len(squared), bool)
        for measure in (squared / noise, np.concatenate(alone)):
            middle = max(float(np.median(measure)), 1.0)
            bad |= measure > np.maximum(2 * middle, middle + _DEVIATIONS * robust_scatter(measure, middle))
        known = {(side, index) for side, index, _ in self.taken.wrong}
        bad |= [(own.side, index) in known for own in self.sides for index in range(self.count)]
        self.good = ~bad
        return np.asarray(bad)

    def _fit(self, own, index, sums, response, before, common, squares, pool):
        """Fit the deviation of one pair's sum; return the coefficients of R_k, the ``common`` shapes and, to ``pool``
        them, R_(k-1) and R_k^2, which are known otherwise; their variances for noise of variance 1, and the residual."""
        first = response(own.axis, index) if index else np.zeros(self.shape)
        lagged = np.zeros(self.shape)
        for half in self._halves(own, index):
            if (last := before.get(half)) and last[:2] != half[:2]:
                lagged = lagged + last[2] / 2 * response(SIDES.index(last[0]), last[1])
        bent = np.square(first) - squares if index else first
        parts = [first, *common, *([lagged, bent] if pool else [])]
        shapes = np.stack([part.ravel() for part in parts])
        sizes = np.sqrt(np.square(shapes).sum(axis=1))
        shapes /= np.where(sizes > 0, sizes, 1.0)[:, None]
        inverse = np.linalg.pinv(shapes @ shapes.T, rcond=1e-9, hermitian=True)
        if not pool and (self.lag or self.bend):
            sums = sums - (self.lag * lagged + self.bend * bent).ravel()
        values = inverse @ (shapes @ sums)
        scale = np.where(sizes > 0, sizes, np.inf)
        return values / scale, np.diag(inverse) / scale**2, sums - values @ shapes

    def _shape_in(self, rest: FloatArray) -> FloatArray | None:
        """Return a shape that the residuals ``rest`` of many pairs share; None if there is none."""
        values, vectors = np.linalg.eigh(rest @ rest.T)
        noise = float(np.median(np.square(rest).mean(axis=1)))
        edge = noise * (np.sqrt(rest.shape[1]) + np.sqrt(len(rest))) ** 2
        for place in (-1, -2, -3):
            part = np.square(vectors[:, place])
            if values[place] > 1.3 * edge and 1 / np.square(part).sum() > 2 * MOST_FAULTS * len(rest):
                return np.asarray((vectors[:, place] @ rest).reshape(self.shape))
        return None

    # ---- the uniform response ----------------------------------------------------------------------------------------

    def _is_contaminated(self) -> bool:
        """Return True if ambient light or power differ in the uniform frames so much that all vectors suffer."""
        powers = [self.values[own.axis * self.count, 1] for own in self.sides]
        return bool(abs(powers[0] - powers[1]) > _SLIGHT or self.ambient_moved > (_MATTERS * self._noise()) ** 2)

    def _uniform(self, alone: int | None = None) -> FloatArray:
        """Return the uniform response whose vectors are those that the other patterns share, and whose size is that of
        the uniform frames of both sides, or of one ``alone``."""
        found = []
        for own in self.sides:
            assert own.pairs is not None
            used = self._of(own, self.good)
            found.append(own.pairs.across[used].sum(axis=0) / np.square(without_plane(own.sums.vectors[:, used])).sum())
        right, left = found
        sizes = []
        for own, vector, common in zip(self.sides, (left, right), (right, left), strict=True):
            # D_0 = g vector common^T and ambient light, projected on the common vector of the sums.
            parts = np.column_stack([vector, np.vander(np.linspace(-1, 1, len(vector)), 2)])
            share = float(np.dot(common, own.sums.common) / np.dot(own.sums.common, own.sums.common))
            sizes.append(abs(float(np.linalg.lstsq(parts, own.sums.vectors[:, 0], rcond=None)[0][0])) / share)
        return np.outer(left, right) * (np.mean(sizes) if alone is None else sizes[alone])

    # ---- what the sums show of lamp, lag, bend, motion and ambient light ---------------------------------------------

    def _correct(self) -> None:
        """Subtract ambient light, divide by the lamp's power, and count what is left as errors."""
        good = self.good
        for own in self.sides:
            own.add("sums", float(self._of(own, self.excess)[self._of(own, good)].sum()))
            if not self.centre:
                self._subtract_ambient(own)
        self._count_lag_and_bend(self.lag, 2 * self.bend)
        self._count_motion(self.values[:, 2:4], self.variances[:, 2:4])
        if not self.taken.unsteady:
            self._divide(self.lag)

    def _pooled(self, values: FloatArray, variances: FloatArray) -> float:
        """Return the mean of all pairs' ``values``, 0 where it cannot be told from 0."""
        usable = variances > 0
        if usable.sum() < 2:
            return 0.0
        middle = float(np.median(values[usable]))
        usable &= np.abs(values - middle) <= _DEVIATIONS * max(robust_scatter(values[usable], middle), 1e-300)
        weights = 1 / variances[usable]
        mean = float(np.dot(weights, values[usable]) / weights.sum())
        scatter = float(np.dot(weights, np.square(values[usable] - mean)) / weights.sum())
        return mean if abs(mean) > _SURE * np.sqrt(scatter / usable.sum()) else 0.0

    def _subtract_ambient(self, own: _Side) -> None:
        """Subtract the change of ambient light within pairs from the vectors."""
        assert own.pairs is not None
        common, found = own.sums.common, own.pairs.ambient
        across, along, inverse = ambient_shapes(common, len(own.vectors))
        parts = np.array([1.0, 0.0]) @ self._shares(common), np.array([0.0, 1.0]) @ self._shares(common)
        effects = np.stack([np.full(len(along), parts[0]), along * parts[0], np.full(len(along), parts[1])])
        scales = np.array([inverse[0, 0] / len(along), inverse_slope(across, along), inverse[1, 1] / len(along)])
        moved = 0.0
        for part in range(3):
            noise = np.full(self.count, own.variance * scales[part])
            kept, left, _ = _shrunk(found[:, part], noise, self._of(own, self.good))
            own.vectors -= np.outer(effects[part], kept)
            own.add("ambient", float(left.sum() * np.square(effects[part]).sum()))
            moved += float(np.square(kept).sum() * np.square(effects[part]).sum())
        self.ambient_moved += moved / own.size

    @staticmethod
    def _shares(common: FloatArray) -> FloatArray:
        """Return what the shapes 1 and x add to a vector that is projected on the ``common`` one."""
        shapes = np.stack([np.ones(len(common)), np.linspace(-1, 1, len(common))])
        return np.asarray(shapes @ common / np.dot(common, common))

    def _count_lag_and_bend(self, lag: float, bend: float) -> None:
        for own in self.sides:
            # A lagging frame has 1 - 1.5 l of its response and -l / 2 of the one before; a factor is its root.
            own.add("lag", lag**2 * (0.75**2 + 0.5**2) * own.size)
            common = own.sums.common
            cube = float(np.sum(common**3) / np.dot(common, common))
            own.add("bend", (bend * cube) ** 2 * float(np.square(own.uniform[:, None] * own.vectors).sum()))
        self.doubts["lag"] = f"each frame holds {lag:.1%} of the one before; wait longer between frames"
        self.doubts["bend"] = "numbers are not in proportion to light; switch gamma and other processing off, expose for less"

    def _count_motion(self, values: FloatArray, variances: FloatArray) -> None:
        first = np.argsort(self.times)[: max(4, len(values) // 16)]
        last = np.argsort(self.times)[-max(4, len(values) // 16) :]
        moved = 0.0
        for own in self.sides:
            steep = np.square(np.gradient(own.vectors, axis=0)).sum(axis=0)
            here, good = self._of(own, values[:, own.axis]), self._of(own, self.good)
            noise = self._of(own, variances[:, own.axis])
            energies = []
            for ends in (first, last):
                start = float(np.median(values[ends, own.axis]))
                energies.append(float(((np.square(here - start) - noise) * steep)[good].sum()))
            own.add("motion", max(energies))
            moved = max(moved, float(np.ptp(here[good])) if good.any() else 0.0)
        self.doubts["motion"] = f"camera or mask move by {moved:.2g} pixels; fasten them"

    def _divide(self, lag: float) -> None:
        """Divide vectors by the lamp's power in each frame, which Y+ has 1 + d / c of, and Y- 1 - d / c."""
        good, unequal, power = self.good, self.values[:, 0].copy(), self.values[:, 1]
        for own in self.sides:
            for index in range(self.count):
                before = dict(zip(self.taken.order[1:], self.taken.order, strict=False))
                last = [before.get(half) for half in self._halves(own, index)]
                own_part = sum(half[2] for half in last if half and half[:2] == (own.side, index))
                unequal[own.axis * self.count + index] -= lag * own_part / 2
        first = [own.axis * self.count for own in self.sides]
        unit = 1 / max(1 - float(np.mean(power[first])), 0.1)
        alone = np.abs(unequal) > _ALONE
        usable = good & ~alone
        both = (1 + power * unit) / np.where(alone, 1.0, 1 - np.square(unequal))
        variances = self.variances[:, 1] * unit**2
        degree = min(3, max(len(np.unique(self.times)) // 4, 0))
        kept = usable.copy()
        for _ in range(4):
            trend = np.polynomial.Polynomial.fit(self.times[kept], both[kept], degree)(self.times)
            away = np.abs(both - trend)
            kept = usable & (away <= _DEVIATIONS * max(robust_scatter(away[usable]), 1e-12))
        both, trend = both / float(np.mean(trend)), trend / float(np.mean(trend))
        changes = float(np.var(trend[usable])) > _SURE**2 * float(np.median(variances)) * (degree + 1) / usable.sum()
        trend = trend if changes else np.ones(len(both))
        deviations, left, shaken = _shrunk(both - trend, variances, usable)
        patterned = self.variances[:, 0] > 0  # the uniform pattern has one lit frame
        unequal, left_unequal, uneven = _shrunk(unequal, np.where(patterned, self.variances[:, 0], 1.0), usable & patterned)
        powers = np.where(usable, trend + deviations, trend)
        unequal = np.where(usable, unequal, 0.0)
        mean, flickers = float(np.sqrt(np.mean(powers[first]))), float(np.sqrt(shaken + uneven))
        costs = np.zeros(2)
        for own in self.sides:
            c, ratio = self._of(own, powers), self._of(own, unequal).copy()
            ratio[0] = 0.0
            size, whole = own.size, float(np.square(own.uniform).sum())
            energies = np.square(own.vectors).sum(axis=0)
            keep = self._of(own, usable)
            costs += (
                float(np.square(self._of(own, trend) - 1)[keep] @ energies[keep]) / size,
                float((np.square(c - self._of(own, trend)) @ energies + np.square(ratio).sum() * whole) / size),
            )
            noise = own.noise * float((np.square(1 / np.where(keep, c, 1.0)) - 1)[keep].clip(0).sum())
            own.vectors = (own.vectors - np.outer(own.uniform / mean**2, ratio * c)) / c * mean
            own.add("lamp", noise + float(self._of(own, left)[keep] @ energies[keep] + self._of(own, left_unequal)[keep][1:].sum() * whole))
            for index in np.flatnonzero(keep):
                part = float(c[index] / self._of(own, trend)[index])
                self._name_power(own, int(index), part, float(ratio[index]), max(_SLIGHT, _DEVIATIONS * flickers))
        drift, flicker = np.sqrt(costs)
        order = np.argsort(self.times)
        change = float(trend[order[-1]] - trend[order[0]]) if changes else 0.0
        if changes:  # the factors are those of the mean power; the capture may have any
            for own in self.sides:
                own.add("lamp", (float(np.abs(trend[usable] - 1).max()) / 2) ** 2 * own.size)
        # Two uniform frames that both differ from the sums alike are no lamp: light and numbers are not in proportion.
        own_parts = (powers / trend)[first] - 1
        bent = float(np.abs(own_parts).min()) if own_parts[0] * own_parts[1] > 0 else 0.0
        if bent > max(_SLIGHT / 2, 3 * flickers):
            for own in self.sides:
                own.add("bend", (bent / 2) ** 2 * own.size)
        noise = self._noise()
        remaining = float(np.sqrt(sum(own.extras["lamp"] / own.size for own in self.sides)))
        self.lamp = Lamp(
            change if drift > _MATTERS * noise else 0.0,
            flickers if flicker > _MATTERS * noise else 0.0,
            float(drift), float(flicker), remaining, bool(drift or flicker),
        )  # fmt: skip

    def _name_power(self, own: _Side, index: int, power: float, ratio: float, least: float) -> None:
        """Report a frame whose own power differs from the lamp's by more than the ``least``."""
        each = {1: power * (1 + ratio) - 1, -1: power * (1 - ratio) - 1}
        sign = max(each, key=lambda one: abs(each[one]))
        if abs(each[sign]) > least and (index == 0 or abs(each[-sign]) < abs(each[sign]) / 4):
            detail = f"it has {1 + each[sign]:.3g} of its light"
            self.faults.append(SessionFault(own.side, index, sign, "power", detail, "its response is divided by that"))

    def _noise(self) -> float:
        return float(np.sqrt(sum(own.noise * self.count / own.size for own in self.sides)))

    # ---- the moving shadow -------------------------------------------------------------------------------------------

    def _use_one_frame(self, own: _Side, index: int, bad: npt.NDArray[np.bool_]) -> None:
        """Replace a response by twice one of its frames less the usual sum; refused unless the moving shadow agrees."""
        assert own.pairs is not None
        known = [sign for side, place, sign in self.taken.wrong if (side, place) == (own.side, index)]
        reason = self.taken.wrong[own.side, index, known[0]] if known else "the two do not add up to what others do"
        own.uncounted.add(index)
        if index == 0:
            own.vectors[:, 0] = own.uniform
            self.faults.append(SessionFault(own.side, 0, None, "replaced", reason, "those of the other side replace them"))
            return
        times, right = self._of(own, self.times), ~self._of(own, bad)
        near = np.flatnonzero(right)[np.argsort(np.abs(times[right] - times[index]))[:_NEAR]]
        usual = np.median(own.pairs.light[:, near], axis=1)
        away = own.pairs.light[:, index] - usual
        tried = {-sign: own.sums.vectors[:, index] + sign * away for sign in (1, -1) if -sign not in known or len(known) == 2}
        scores = {}
        for wrong, vector in ({} if len(known) == 2 or not self.enough else tried).items():
            own.vectors[:, index] = vector
            shadow = MovingShadow(own.vectors, self.signs)
            scores[wrong] = float(shadow.deviations[index]), float(shadow.unlike[index])
        fits = {wrong: score for wrong, score in scores.items() if score[0] <= _WRONG or score[1] <= _UNLIKE}
        if not fits:
            self._refuse([(own, index)], reason)
        sign = min(fits, key=lambda wrong: scores[wrong][0])
        own.vectors[:, index] = tried[sign]
        # Twice one frame less the usual sum has the noise of both halves once more, and that of the sum.
        error = 1.5 * own.noise
        if len(fits) > 1 and scores[sign][0] > scores[-sign][0] / 2:  # the shadow does not decide between the frames
            error += float(np.square(away).sum())
        own.add("replaced", error)
        cost = float(np.sqrt(error / own.size))
        repair = "the other frame of its pair replaces it"
        self.faults.append(SessionFault(own.side, index, sign, "replaced", reason, repair, cost=cost))

    def _check_shadow(self, own: _Side) -> None:
        """Turn the signs of patterns whose two frames are exchanged; refuse patterns and lines that are foreign."""
        sums, turned = own.sums, set[int]()
        odd = odd_responses(sums.misfits, sums.energies, len(own.vectors) * len(sums.common))
        if foreign := [int(index) for index in odd if index not in own.uncounted]:
            self._refuse([(own, index) for index in foreign], f"they show no {own.side} stripes")

        def turn(indices: Sequence[int]) -> None:
            own.vectors[:, indices] *= -1
            turned.symmetric_difference_update(indices)

        if np.dot(own.vectors[:, 0], own.uniform) < 0:
            turn([0])
        if self.enough:
            foreign = []
            for _ in range(int(MOST_FAULTS * self.count) + 3):
                shadow = MovingShadow(own.vectors, self.signs, foreign)
                far = np.where((shadow.deviations > _WRONG) & (shadow.unlike > _UNLIKE), shadow.deviations, 0.0)
                gains = np.where(shadow.by_turning > _TURNED * shadow.deviations, shadow.by_turning, 0.0)
                far[[0, *foreign]] = gains[foreign] = 0.0
                best = int(np.argmax(gains))
                if gains[0] > _WRONG and shadow.unlike[0] > _UNLIKE:
                    turn(range(1, self.count))  # the sign of pattern 0 is known
                elif best and gains[best] > max(_LEAST, _TURNED * far.max()):
                    turn([best])
                elif far.any():
                    foreign.append(int(np.argmax(far)))
                else:
                    break
            if foreign:
                wrong = [(own, index) for index in sorted(foreign)]
                self._refuse(wrong, f"not the {own.side} stripes that the others foretell")
            if shadow.lines.max() > _LINE:
                line = int(np.argmax(shadow.lines))
                raise MitsimError(
                    f"all frames: line {line} of the {own.side} stripes is not as bright as its neighbours foretell; check "
                    "the uniform and dark frames and the projector, and take the session again"
                )
        elif turned and len(turned) < self.count:
            self._refuse([(own, index) for index in turned], "they are in each other's place")
        if len(turned) > max(2, MOST_FAULTS * self.count) and len(turned) < self.count:
            raise MitsimError("all frames: the frames of many patterns are exchanged; check their order")
        for index in sorted(turned):
            detail, repair = "in each other's place", "they count in their right order"
            self.faults.append(SessionFault(own.side, index, None, "exchanged", detail, repair))
        if not self.paired and self.enough:
            shown = np.square(own.vectors + own.vectors[:, :1]).sum(axis=0)[1:]
            own.add("power", float(np.square(shadow.powers()[1:]) @ shown))
            self.doubts["power"] = "frames are of different power; use a steadier lamp, or pairs"

    def _count_rounding(self, own: _Side) -> None:
        """Count the rounding of numbers that noise does not make random: its mean over noise of a standard deviation s,
        in steps, is a sine of the light of the amplitude exp(-2 pi^2 s^2) / pi, alike in pixels of like light."""
        if self.taken.step:
            noise = max(own.variance / 2 / self.taken.step**2 - 1 / 12, 0.0)
            bias = 2 * (self.taken.step * np.exp(-2 * np.pi**2 * noise) / np.pi) ** 2 / 2
            common = own.sums.common
            alike = float(np.square(common.sum()) / np.square(np.dot(common, common)))
            own.add("rounding", bias * alike * len(own.vectors) * self.count)
        self.doubts["rounding"] = "steps between numbers are larger than the noise; use more bits or more gain"

    def _count_dark_rows(self, own: _Side) -> None:
        """Count sensor rows or columns without light between neighbours that have it."""
        light = np.square(own.vectors).sum(axis=1)
        around = np.minimum(light[:-2], light[2:])
        dark = np.flatnonzero(light[1:-1] < _DARK * around)
        own.add("dark", float(around[dark].sum()))
        if len(dark):
            word = "row" if own.axis == 0 else "column"
            self.doubts["dark"] = f"sensor {word} {dark[0] + 1} shows no light; check the sensor"

    def _judge(self, uniform: FloatArray | None) -> CheckedSession:
        """Add up the errors; MitsimError where they are more than a tenth."""
        reasons = {reason for own in self.sides for reason in own.extras}
        costs = {reason: float(np.sqrt(sum(own.extras.get(reason, 0.0) / own.size for own in self.sides))) for reason in reasons}
        self.doubts["sums"] = "pairs add up to light that changes in an unknown way; check ambient light, lamp and sensor"
        worst = [reason for reason in sorted(costs, key=lambda one: -costs[one]) if reason in self.doubts]
        total = float(np.sqrt(sum(cost**2 for cost in costs.values())))
        if total > LARGEST_ERROR:
            raise MitsimError(
                f"all frames: {self.doubts[worst[0]] if worst else 'power and ambient light change'}: an error of "
                f"{total:.0%} is left in the factors, allowed are {LARGEST_ERROR:.0%}; take the session again"
            )
        doubts = []
        if self.ambient_moved > (_MATTERS * self._noise()) ** 2:
            doubts.append(
                f"session: ambient light changes between the two frames of pairs, a factor error of "
                f"{np.sqrt(self.ambient_moved):.1e} if nothing is done; it is subtracted: darken the room"
            )
        doubts += [
            f"session: {self.doubts[reason]}; the stated error includes {costs[reason]:.1e} for it"
            for reason in worst
            if costs[reason] > _MATTERS * self._noise()
        ]
        sums = self.sides[0].result(), self.sides[1].result()
        left_out = len(self.sides[0].uncounted), len(self.sides[1].uncounted)
        extra = sum(self.sides[0].extras.values()), sum(self.sides[1].extras.values())
        order = sorted(self.faults, key=lambda fault: (SIDES.index(fault.side), fault.index))
        return CheckedSession(sums, order, self.lamp, doubts, left_out, extra, uniform)
