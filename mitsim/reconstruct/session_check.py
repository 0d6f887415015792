"""Check of a calibration session by measurement, and the error that its faults leave in the factors.

In every good session, the two frames of a pair add up to one frame for all patterns, the responses of one side are the
shadow of one moving mask, and both sides share lamp and time. Therefore the sum s_k of each pair, projected on the
common vector as its response u_k is, is fitted over the sensor's rows (or columns) y and in time::

    s_k = s + c_k u + d_k u_k + l u_(k-1) + m_k u' + a_k + b_k y

with s the side's usual sum, u the response to uniform light, c the lamp's power, d the unequal power of the two
frames, l the lag, m the camera's motion in pixels, and a, b the ambient light. Only three repairs change the factors,
each accepted if the moving shadow agrees afterwards: a response's sign is turned, one frame replaces a pair, and
responses are divided by the lamp's power. Every other fault is refused or counts in the stated error.

*The moving shadow.* Column j + 1 of a factor is column j moved by ``step`` pixels. At each spatial frequency the
columns are therefore a phase that grows with j, times a polynomial of j (falloff, obliquity). Detail finer than the
pixels is aliased. The part of the columns outside these modes is zero but for noise, so that each pattern's vector u_i
= Phi h_i can be compared with all others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.devices.session import SIDES, UNIFORM, Half, Side
from mitsim.reconstruct.factors import LARGEST_ERROR, AmbientLight, Estimate, StripeSums, factors_of_sums
from mitsim.reconstruct.solver import robust_scatter

# ---- The moving shadow ----------------------------------------------------------------------------------------------

_TURNS = 0, 1, -1, 2, -2, 3, -3, 4, -4, 5, -5, 6
"""Turns of the frequencies 2 pi t - k that pixels alias to k in [0, pi]; a pixel as wide as some features of the mask
needs most of them."""
_LINES = 8
_ENOUGH = 16, 40
_PREDICTED = 0.15
"""Limit of the relative squared deviation of a tenth of the patterns: 0.03 with three exchanged pairs of 32."""

ComplexArray = npt.NDArray[np.complex128]


class MovingShadow:
    """Deviation of patterns' ``vectors`` (m, N) from those that the other patterns predict.

    Parameters
    ----------
    unknown
        Patterns whose vectors are replaced by those that fit the others best.

    Attributes
    ----------
    deviations, unlike : (N,) arrays
        Squared deviation from the prediction, in units of the median pattern's, and over the vector's square.
    shares, sure : (N,) arrays
        Disagreeing part of a vector, and the same in standard errors: 0 if right, 2 if its sign is wrong, 1 if
        unrelated.
    by_turning : (N,) array
        Decrease of all deviations if the sign of one pattern is turned.
    lines : (n,) array
        Squared deviation of each column from the prediction, over the mean square of columns.
    """

    def __init__(self, vectors: FloatArray, signs: FloatArray, unknown: Sequence[int] = ()) -> None:
        n, count = signs.shape
        signs = signs / np.sqrt(count)
        taper = np.square(np.sin(np.pi * (np.arange(len(vectors)) + 0.5) / len(vectors)))
        spectra = np.fft.rfft((vectors - taper @ vectors / taper.sum()) * taper[:, None], axis=0)[1:]
        stride = -(-len(spectra) // 64)
        self.angles: FloatArray = 2 * np.pi * np.arange(1, len(spectra) + 1)[::stride] / len(vectors)
        spectra = spectra[::stride]
        columns = spectra @ signs.T
        # The step of the shadow from column to column is the one whose phases have most power.
        power = np.square(np.abs(np.fft.fft(columns, 8 * n, axis=1)))
        most = int(0.6 * len(vectors))
        steps = np.linspace(-most, most, 40 * most + 1) / n
        places = np.rint(-np.outer(steps, self.angles) * (8 * n / (2 * np.pi))).astype(np.int64) % (8 * n)
        step = float(steps[int(np.argmax(power[np.arange(len(self.angles)), places].sum(axis=1)))])
        # The modes are these phases, and those of aliases, times slow polynomials.
        degree = max(min(3, n // _LINES - 1), 0)
        slow = np.polynomial.legendre.legvander(np.linspace(-1, 1, n), degree)
        # Aliases that nearly coincide at this step are one alias.
        near = 0.5 - 1 / n
        turns = [t for i, t in enumerate(_TURNS) if all(abs((t - u) * step % 1 - 0.5) < near for u in _TURNS[:i])]
        aliases = 2 * np.pi * np.array(turns[: max(1, 3 * n // _LINES // (degree + 1))]) - self.angles[:, None]
        phases = np.exp(1j * step * aliases[:, None] * np.arange(n)[:, None])
        modes = np.asarray(np.linalg.qr((phases[..., None] * slow[:, None]).reshape(len(phases), n, -1))[0])
        turned = modes.conj().transpose(0, 2, 1)
        # Squared length of each pattern's stripes beyond the modes.
        own = np.maximum(n / count - np.square(np.abs(np.matmul(turned, signs))).sum(axis=1), 1e-9)
        left = np.zeros_like(spectra)
        for index in [0, *[*unknown] * 3]:
            spectra[:, index] -= left[:, index] / own[:, index]
            columns = spectra @ signs.T
            rest = columns - np.matmul(modes, np.matmul(turned, columns[..., None]))[..., 0]
            left = rest @ signs
        self.spectra, self._left, self._own = spectra, left, own
        squares = np.square(np.abs(spectra))
        deviations = (np.square(np.abs(left)) / own).sum(axis=0)
        self._unit = (float(np.median(deviations)) + 1e-12 * float(squares.sum(axis=0).mean())) or 1.0
        self.deviations = deviations / self._unit
        self.unlike = np.square(np.abs(left / own)).sum(axis=0) / np.maximum(squares.sum(axis=0), 1e-300)
        self.shares, variances = self.along(spectra)
        self.sure = self.shares / np.sqrt(variances)
        self.by_turning = 2 * (self.shares - 1) / (variances * len(own))
        enough = count >= _ENOUGH[0] and len(vectors) >= _ENOUGH[1]
        self.predicts = enough and float(np.quantile(self.unlike, 0.1)) < _PREDICTED
        kept = np.maximum(1 - np.square(np.abs(modes)).sum(axis=2), 1e-9)
        seen = (kept * np.square(np.abs(columns)).mean(axis=1, keepdims=True)).sum(axis=0)
        lines = (np.square(np.abs(rest)) / kept).sum(axis=0) / np.maximum(seen, 1e-300)
        self.lines = lines * (kept.mean(axis=0) > 0.1)

    def along(self, shapes: ComplexArray) -> tuple[FloatArray, FloatArray]:
        size = np.maximum((np.square(np.abs(shapes)) * self._own).sum(axis=0), 1e-300)
        # The deviation at each frequency is complex: half of its noise is along the shape.
        return np.real(shapes.conj() * self._left).sum(axis=0) / size, self._unit / len(self._own) / 2 / size


MOST_FAULTS = 0.1
_MATTERS = 0.5
_DEVIATIONS = 8.0
"""Robust deviations from the other pairs that make a fault; chance alone reaches them in one session of 10^12."""
_STRAYS = 4.265
"""Standard deviations from which places move: one side in 1e5 by chance."""
_SURE = 5.0
_SLIGHT = 0.02
_WRONG, _UNLIKE = 40.0, 0.03
"""Two squared deviations from which a pattern is wrong: none of 860 good sides of 64 or 128 patterns exceeds 20 in
both."""
_FOREIGN = 0.5, 15.0, 15.0
"""Limits of a foreign pattern: good ones have 0.25 at 6 (64 patterns), swapped ones about 1 at 23 and 30."""
_TURNED = 0.7
_LINE = 0.15
"""Limit of a line's squared deviation over the mean square: good cameras of 32 lines reach 0.003."""
_LIT = 0.1
_NAMED = 12
_UNKNOWN_LIGHT = "pairs add up to light that changes in an unknown way; check ambient light, lamp and sensor"
_EVEN = "responses hold even light that changes from pattern to pattern; darken the room, and mount the mask straight"
_PHOTONS = "photon noise of bright pixels; use more light"
_LAMP = "the lamp's power changes; use a steadier one"
_BENT = "numbers are not in proportion to light; switch gamma and other processing off, or use a shorter exposure"
_POWER = "frames are of different power; use a steadier lamp, or pairs"
_OFFSET = "the uniform frame does not fit those of patterns; keep lamp and ambient light steady, or take pairs"
_REPLACED = "a frame of a pair is wrong; take it again"
_UNEQUAL = "the two do not have the sum that other pairs have"


def frame_words(half: Half) -> str:
    return f"{half[0]} stripes {half[1]}" + f" of sign {half[2]:+d}" * (half[2] != UNIFORM)


# ---- Results ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SessionFault:
    """One mended pattern or frame; a manifest has it with these keys.

    ``kind`` is ``exchanged``, ``power`` or ``replaced``, and ``cost`` the relative error of the factor that remains
    beyond the noise. ``sign`` is None for both frames; ``other`` is None, except in older manifests.
    """

    frames: list[str]
    side: Side
    index: int
    sign: int | None
    kind: str
    detail: str
    repair: str
    cost: float = 0.0
    other: None = None

    def __str__(self) -> str:
        cost = f", at a factor error of {self.cost:.1e}" if self.cost else ""
        return f"frames: {' and '.join(self.frames)}: {self.detail}; {self.repair}{cost}"


@dataclass
class CheckedSession:
    """Sums of a session after the check; the same objects that came in where nothing was mended.

    ``lamp`` has the ``drift`` over the session, the ``flicker`` from frame to frame (parts of its power), and relative
    errors of the factors; None if the projector is steady. ``extra`` is the squared error of each side's vectors.
    """

    sums: tuple[StripeSums, StripeSums]
    faults: list[SessionFault] = field(default_factory=list)
    lamp: dict[str, float] | None = None
    doubts: list[str] = field(default_factory=list)
    extra: tuple[float, float] = (0.0, 0.0)

    def estimate(self, signs: FloatArray, noise: float | None) -> Estimate:
        return factors_of_sums(*self.sums, signs, noise, self.extra)

    @property
    def warnings(self) -> tuple[str, ...]:
        return (*map(str, self.faults), *self.doubts)


def check_session(
    sums: tuple[StripeSums, StripeSums],
    signs: FloatArray,
    order: Sequence[Half],
    name: Callable[[Half], str] = frame_words,
    saturated: bool = False,
    unsteady: bool = False,
    stated: tuple[StripeSums, StripeSums] | None = None,
) -> CheckedSession:
    """Check a session, make repairs that a check afterwards confirms, and add remaining errors to the stated error.

    ``order`` and ``name`` are those of the frames. The lamp's power is not divided out of a session whose lamp is
    stated as ``unsteady``. Light that noise-free responses of the ``stated`` camera contain, too, is not ambient.
    Raises MitsimError for faults that cannot be mended, with the frames that do not fit.
    """
    check = _Check(sums, signs, order, name)
    for own, expected in zip(check.sides, stated or (), strict=False):
        own.ambient = own.ambient - expected.ambient
    if not check.paired:
        apart = abs(check.sides[0].power - check.sides[1].power)
        for own in check.sides:
            check.subtract_ambient(own, np.ones(check.count, dtype=bool))
            own.add(_POWER, (apart / 2) ** 2 * own.size * (apart > _SLIGHT))
    elif not check.correct_pairs(saturated, unsteady):
        return check.found
    for own in check.sides:
        check.check_shadow(own)
    check.judge()
    return check.found


# ---- Statistics ------------------------------------------------------------------------------------------------------


def _shrunk(
    values: FloatArray, variances: FloatArray, good: npt.NDArray[np.bool_], least: FloatArray | float = 0.0
) -> tuple[FloatArray, FloatArray, float]:
    """Return ``values`` shrunk to 0 by their ``variances``, the remaining squared errors, and the shared variance.

    The variance of the ``good`` values beyond their noise is the prior; nothing changes where it is insignificant.
    """
    beyond, pooled = np.square(values) - variances, 0.0
    middle = max(float(np.median((beyond / variances)[good])), 0.0)
    usual = good & (beyond < _DEVIATIONS**2 * (1 + middle) * variances)
    for _ in range(4):
        weights = usual / np.square(variances + pooled)
        pooled = max(float(np.average(beyond, weights=weights)), 0.0)
    deviation = float(np.sqrt(2 * np.square(weights * variances).sum()) / weights.sum())
    sure = pooled * (pooled > _SURE * deviation)
    prior = np.maximum(np.maximum(least, sure), np.where(beyond > _SURE**2 * variances, beyond, 0.0))
    weight = prior / (prior + variances)
    return weight * values, np.where(prior > 0, weight * variances, sure), sure


# ---- The check -------------------------------------------------------------------------------------------------------


class _Side:
    def __init__(self, sums: StripeSums, other: StripeSums, axis: int) -> None:
        self.sums, self.uniform, self.axis = sums, other.common, axis
        self.side: Side = SIDES[axis]
        self.vectors, self.misfits = sums.vectors.copy(), sums.misfits.copy()
        self.extras: dict[str, float] = {}
        self.light, self.ambient = AmbientLight(sums.common, len(self.vectors)), sums.ambient
        self.misfits -= self.light.energies(sums.ambient)  # ambient light that changes within pairs is no noise
        self.variance = float(np.median(self.misfits)) / max(len(self.vectors) * (len(sums.common) - 1), 1)
        self.noise = self.variance * len(self.vectors) / float(np.dot(sums.common, sums.common))
        # Bright pixels have more weight in the vectors, and more photon noise than the mean pixel.
        bright = np.abs(sums.common) ** (0.0 if sums.centre else 1.0)
        self.peaked = float(np.mean(bright**3) / (np.mean(bright) * np.mean(bright**2) + 1e-300))
        # The uniform frames of this side against the mean of both sides': their power, and their place in pixels.
        self.shapes = np.stack([self.uniform, np.gradient(self.uniform)])
        own = np.linalg.lstsq(self.shapes.T, self.vectors[:, 0], rcond=None)[0]
        self.power, self.place = own * np.sign(own[0])

    @property
    def size(self) -> float:
        return max(float(np.square(self.vectors).sum()), 1e-300)

    def result(self) -> StripeSums:
        if np.array_equal(self.vectors, self.sums.vectors):
            return self.sums
        return replace(self.sums, vectors=self.vectors, misfit=float(self.misfits.sum()))

    def add(self, reason: str, energy: float) -> None:
        self.extras[reason] = self.extras.get(reason, 0.0) + max(energy, 0.0)

    def add_motion(self, places: FloatArray, variances: FloatArray, times: FloatArray) -> None:
        few, late = max(2, len(times) // 8), np.argsort(times)
        ends = np.array([np.median(places[late[:few]]), np.median(places[late[-few:]]), -self.place])
        away = np.square(np.append(places, ends[2]) - np.median(places)) / np.append(variances, 2 * variances.max())
        # The cube root of a mean square is nearly normal (Wilson and Hilferty 1931), also for few patterns.
        spread = 2 / (9 * away.size)
        if np.cbrt(away.mean()) > 1 - spread + _STRAYS * np.sqrt(spread):
            beyond = [np.average(np.square(places - end) - variances, weights=1 / variances) for end in ends]
            # Differences of neighbours: those of every second pixel do not see the finest detail.
            energy = float(max(beyond)) * float(np.square(np.diff(self.vectors, axis=0)).sum())
            self.add(f"camera or mask move by {np.ptp(ends):.2g} pixels; fasten them", energy)

    def fit_sums(self) -> tuple[FloatArray, ...]:
        shapes = self.shapes
        if not self.sums.centre:
            shapes = np.stack([*shapes, np.ones_like(self.uniform), np.linspace(-1, 1, len(self.uniform))])
        inverse = np.linalg.pinv(shapes)
        responses = self.sums.vectors.T.copy()
        responses[0] = 0.0  # the uniform pattern has one lit frame
        values, parts = self.sums.lights.T @ inverse, responses @ inverse
        rest, responses = self.sums.lights.T - values @ shapes, responses - parts @ shapes
        rest -= np.median(rest, axis=0)
        sizes = np.maximum(np.square(responses).sum(axis=1), 1e-30)
        ratios = (rest * responses).sum(axis=1) / sizes
        rest -= ratios[:, None] * responses
        values -= ratios[:, None] * parts
        squares, spare = np.square(rest).sum(axis=1), max(len(self.uniform) - len(shapes) - 1, 1)
        noise = min(float(np.median(squares)) / spare, self.peaked * self.noise / len(self.vectors))
        self.add(_PHOTONS, (noise * len(self.vectors) - self.noise) * len(squares))
        noise = max(noise, 1e-13 * float(np.square(self.uniform).mean()))
        # Steady ambient light of any shape is in all sums, and not in the uniform response, which sets the zero.
        measured = *(values[:, :2] - values[0, :2] + (self.power, self.place)).T, ratios
        # Bright rows have more photon noise.
        bright = np.median(np.square(rest), axis=0) + 1e-300
        bright /= bright.mean()
        of_ratio = np.maximum(np.square(responses) @ bright, 1e-30) / np.square(sizes)
        of_shapes = (bright @ np.square(inverse[:, :2]))[:, None] + np.square(parts[:, :2].T) * of_ratio
        variances = noise * np.stack([*of_shapes, of_ratio])
        # Deviations along the common vector are errors of the response's vector, whatever their cause.
        beyond = squares - noise * spare * (1 + np.pi / 4 / len(squares))  # the usual sum is a median
        excess = beyond * (beyond.sum() > _SURE * noise * np.sqrt(2 * spare * len(squares)))
        middle = max(float(np.median(squares)), noise * spare)
        bad = squares > middle + _DEVIATIONS * max(robust_scatter(squares), middle * np.sqrt(2 / spare))
        return bad | self.odd() | (np.abs(ratios) > 0.9), excess, *measured, *variances  # no division by power 0

    def odd(self) -> npt.NDArray[np.bool_]:
        least = 0.05 * np.maximum(self.sums.energies, np.median(self.sums.energies))
        middle = float(np.median(self.misfits))
        # Few misfits hardly show their scatter, which is that of squares of noise at least.
        scatter = max(robust_scatter(self.misfits), float(np.sqrt(2 * self.variance * max(middle, 0.0))))
        return np.asarray(self.misfits - middle > np.maximum(least, _DEVIATIONS * scatter))


class _Check:
    def __init__(
        self, sums: tuple[StripeSums, StripeSums], signs: FloatArray, order: Sequence[Half], name: Callable[[Half], str]
    ) -> None:
        self.signs, self.name, self.count = signs, name, signs.shape[1]
        self.sides = [_Side(sums[axis], sums[1 - axis], axis) for axis in (0, 1)]
        self.paired = all(own.sums.lights.size for own in self.sides)
        self.found = CheckedSession(sums)
        self.refused: list[tuple[Half, str]] = []
        self.times, self.last = np.zeros((2, 2, self.count))
        for place, (side, index, sign) in enumerate(order):
            self.times[SIDES.index(side), index], self.last[SIDES.index(side), index] = place / len(order), sign
        self.noise = float(np.sqrt(sum(own.noise * self.count / own.size for own in self.sides)))

    def _halves(self, own: _Side, index: int) -> list[Half]:
        return [(own.side, index, sign) for sign in ((1, -1) if self.paired else (1,))]

    def _refuse(self, own: _Side, index: int, reason: str) -> None:
        self.refused += [(half, reason) for half in self._halves(own, index)]

    def _mend(self, own: _Side, index: int, sign: int | None, words: tuple[str, str, str], cost: float = 0.0) -> None:
        names = [self.name(half) for half in self._halves(own, index) if sign in (None, half[2])]
        self.found.faults.append(SessionFault(names, own.side, index, sign, *words, cost))

    # ---- what the sums of pairs show of lamp, lag, bend, motion and ambient light ------------------------------------

    def correct_pairs(self, saturated: bool, unsteady: bool) -> bool:
        bad, excess, *measured = np.stack([own.fit_sums() for own in self.sides], axis=1)
        if saturated and bad.any():
            return False
        self.good = bad == 0
        self.powers, places, self.ratios, *self.variances = measured
        # A frame that holds light of the one before makes all pairs unequal alike; wide stripes show it best.
        lags = (-2 * self.last * self.ratios)[self.variances[2] < np.median(self.variances[2])]
        lag = float(np.median(lags))
        lag *= self.count >= 16 and abs(lag) > _SURE * 1.25 * robust_scatter(lags) / np.sqrt(lags.size)
        self.ratios += lag * self.last / 2
        if bad.sum() > max(2, MOST_FAULTS * 2 * self.count):
            moved = np.ptp(np.where(self.good, places, 0.0), axis=1).max()
            raise MitsimError(
                f"all frames: the two frames of {bad.sum():.0f} of {2 * self.count} patterns do not have the sum that "
                f"other pairs have; check their order, that nothing moves ({moved:.1g} pixels), that no frame holds "
                f"light of the one before ({lag:.1%}), and that numbers are in proportion to light"
            )
        for axis in np.flatnonzero(bad[:, 0]).tolist():  # all others hang on it
            self._refuse(self.sides[axis], 0, _UNEQUAL)
        self.judge()
        for axis, (own, good) in enumerate(zip(self.sides, self.good, strict=True)):
            own.add(_UNKNOWN_LIGHT, float(excess[axis][good].sum()))
            # A lagging frame has 1 - 1.5 l of its response and -l / 2 of the one before; a factor is its root.
            words = f"each frame holds {lag:.1%} of the one before; wait longer between frames"
            own.add(words, lag**2 * (0.75**2 + 0.5**2) * own.size)
            self.subtract_ambient(own, good)
            own.add_motion(places[axis][good], self.variances[1][axis][good], self.times[axis][good])
        if not unsteady:
            self._divide()
        for axis, index in zip(*np.nonzero(bad), strict=True):
            own = self.sides[axis]
            apart = np.abs(self.times[axis] - self.times[axis, index]) + ~self.good[axis]
            usual = np.median(own.sums.lights[:, np.argsort(apart)[:5]], axis=1)
            away, misfits = own.sums.lights[:, index] - usual, dict[int, float]()
            for wrong in (1, -1):
                own.vectors[:, index] = own.sums.vectors[:, index] - wrong * away
                shadow = MovingShadow(own.vectors, self.signs)
                misfits[wrong] = min(float(shadow.deviations[index]) / _WRONG, float(shadow.unlike[index]) / _UNLIKE)
            sign = min(misfits, key=lambda wrong: misfits[wrong])
            if shadow.predicts and 2 * misfits[sign] < misfits[-sign] and misfits[sign] <= 1:
                own.misfits[index] = np.median(own.misfits)
                own.vectors[:, index] = own.sums.vectors[:, index] - sign * away
                # Twice one frame less the usual sum has the noise of both halves once more, and that of the sum.
                own.add(_REPLACED, 1.5 * own.noise)
                mended = "replaced", _UNEQUAL, "the other frame of its pair replaces it"
                self._mend(own, int(index), sign, mended, float(np.sqrt(1.5 * own.noise / own.size)))
            elif not own.odd()[index]:  # the moving shadow's check refuses those of odd light
                self._refuse(own, int(index), _UNEQUAL)
        return True

    def subtract_ambient(self, own: _Side, good: npt.NDArray[np.bool_]) -> None:
        for found, effect, scale in zip(own.ambient.T, own.light.effects, own.light.variances, strict=True):
            variance = own.variance * scale
            # Without pairs, all responses share the uniform and dark frames, a third of their noise at most.
            shared = 0.0 if self.paired else float(np.median(found))
            kept, left, _ = _shrunk(found - shared, np.full(self.count, variance), good)
            kept += shared * (shared**2 > _SURE**2 * variance / 3)
            own.vectors -= np.outer(effect, kept)
            size, changed = float(np.square(effect).sum()), np.square(kept)[good]
            # In the uniform frames it changes the vector that all responses share.
            common = 2 * max(np.median(changed), good[0] * kept[0] ** 2) / np.square(own.uniform).sum() * own.size
            own.add(_EVEN, float(left.sum() + common) * size)

    def _divide(self) -> None:
        """Divide vectors by the lamp's power in their frames, c + d in Y+ and c - d in Y-.

        D' = c D + d U and S = c U + d D are measured, and S = (c - d^2 / c) U + (d / c) D' is fitted.
        """
        usable, times, (variances, _, ratio_variances) = self.good, self.times, self.variances
        sure = usable & (np.square(self.ratios) > _SURE**2 * ratio_variances)
        powers, usual = self.powers / (1 - np.where(sure, np.square(self.ratios), 0.0)), usable
        for _ in range(2):  # the second time without single frames of other power
            # Noise of the uniform frames is common to a side, so that only a slope within both sides is a drift.
            centred = [np.where(usual, values, 0.0) for values in (times, powers)]
            counts = np.maximum(usual.sum(axis=1, keepdims=True), 1)
            centred = [each - usual * each.sum(axis=1, keepdims=True) / counts for each in centred]
            slope = float(np.vdot(*centred)) / max(float(np.square(centred[0]).sum()), 1e-300)
            rest = float(np.square(centred[1] - slope * centred[0]).sum()) / max(usual.sum() - 3, 1)
            drifts = slope**2 * np.square(centred[0]).sum() > _SURE**2 * rest
            line = np.polyval(np.polyfit(times[usual], powers[usual], int(drifts)), times)
            away = powers - line - np.median((powers - line)[usable])
            usual = usable & (np.abs(away) <= _DEVIATIONS * robust_scatter(away[usable]) + 1e-12)
        powers, line = powers / np.mean(line), line / np.mean(line)
        # The step from one side to the other is known as well as the uniform frames are.
        powers, left, _ = _shrunk(powers - 1, 5.0 * variances, usable)
        powers = 1 + powers * usable
        # A single frame of other power changes both alike.
        single = np.square(powers - line) * (powers != 1)
        ratios, left_ratio, uneven = _shrunk(self.ratios, ratio_variances, usable, single)
        left_ratio[:, 0], ratios = 0.0, ratios * usable
        flicker = float(np.sqrt(_shrunk(powers - line, variances, usable)[2] + uneven))
        mean = float(np.sqrt(np.mean(powers[:, 0])))
        # Two uniform frames that differ from the sums alike show no lamp: numbers are not in proportion to light.
        bent = max(float(np.abs(powers[:, 0] / line[:, 0] - 1).min()) - flicker, 0.0)
        costs = {"drift_cost": 0.0, "flicker_cost": 0.0}
        for own, c, ratio, slow, keep in zip(self.sides, powers, ratios, line, usable, strict=True):
            size, whole, energies = own.size, float(np.square(own.uniform).sum()), np.square(own.vectors).sum(axis=0)
            d = c * ratio
            costs["drift_cost"] += np.square(slow - 1) @ energies / size
            costs["flicker_cost"] += (np.square(c - slow) @ energies + d @ d * whole) / size
            own.vectors = (own.vectors - np.outer(own.uniform / mean**2, d)) / c * mean
            lost = own.noise * (1 / np.square(c) - 1).clip(0) + left[own.axis] * energies + left_ratio[own.axis] * whole
            # The factors are those of the mean power; a capture may have any that the session had.
            own.add(_LAMP, float(lost[keep].sum()) + np.square(line - 1).max() / 4 * own.size)
            own.add(_BENT, bent**2 / 2 * own.size)
            parts = np.stack([(1 + sign * ratio) * c / slow - 1 for sign in (1, -1)])
            parts[1, 0] = 0.0  # the uniform pattern has one lit frame
            wrong = np.abs(parts) > np.maximum(max(_SLIGHT, _DEVIATIONS * flicker), 4 * np.abs(parts[::-1]))
            for half, index in zip(*np.nonzero(wrong & keep), strict=True):
                detail = f"it has {1 + parts[half, index]:.3g} of its light"
                self._mend(own, int(index), 1 - 2 * int(half), ("power", detail, "its response is divided by that"))
        if max(costs.values()) > (_MATTERS * self.noise) ** 2 and (flicker or np.ptp(powers[usual])):
            drift = float(line.flat[np.argmax(times)] - line.flat[np.argmin(times)])
            costs["remaining"] = sum(own.extras[_LAMP] / own.size for own in self.sides)
            costs = {name: float(np.sqrt(value)) for name, value in costs.items()}
            self.found.lamp = dict(drift=drift, flicker=flicker, **costs, corrected=True)
            cost = np.hypot(costs["drift_cost"], costs["flicker_cost"])
            self.found.doubts.append(
                f"lamp: its power drifts by {drift:+.1%} over the session and flickers by {flicker:.2%}, an error of "
                f"{cost:.1e}; factors are divided by it, and {costs['remaining']:.1e} is left: use a steadier lamp"
            )

    # ---- the moving shadow -------------------------------------------------------------------------------------------

    def check_shadow(self, own: _Side) -> None:
        foreign = list[int]()
        turned = (np.arange(self.count) == 0) & (np.dot(own.vectors[:, 0], own.uniform) < 0)
        own.vectors[:, turned] *= -1
        for _ in range(int(MOST_FAULTS * self.count) + 3):
            shadow = MovingShadow(own.vectors, self.signs, foreign)
            if not shadow.predicts:
                break
            doubtful = (shadow.deviations > _WRONG) & (shadow.unlike > _UNLIKE)
            doubtful |= (shadow.shares > _FOREIGN[0]) & (shadow.sure > _FOREIGN[1]) & (shadow.deviations > _FOREIGN[2])
            far = shadow.deviations * doubtful
            gains = shadow.by_turning * (shadow.by_turning > _TURNED * shadow.deviations)
            far[[0, *foreign]] = gains[foreign] = 0.0
            best = int(np.argmax(gains))
            if gains[best] > max(_SURE, _TURNED * far.max()):
                which = [best] if best else slice(1, None)  # the light decides on the sign of pattern 0
                own.vectors[:, which] *= -1
                turned[which] ^= True
            elif far.any():
                foreign.append(int(np.argmax(far)))
            else:
                break
        else:
            foreign = [*range(self.count)]
        for index in foreign:
            self._refuse(own, index, f"they show other {own.side} stripes than the other patterns predict")
        for index in [0] if turned.all() else np.flatnonzero(turned).tolist():
            if not shadow.predicts:
                self._refuse(own, index, "they are in each other's place")
            detail = "in each other's place" + f", as in all pairs of {own.side} stripes" * int(turned.all())
            self._mend(own, index, None if self.paired else 1, ("exchanged", detail, "they count in their right order"))
        for index in np.flatnonzero(own.odd()).tolist():
            self._refuse(own, index, f"they show light that no {own.side} stripes cast")
        light = np.square(own.vectors).sum(axis=1)
        lower, upper = np.sort([np.roll(light, 1), np.roll(light, -1)], axis=0)
        dark = light < (0.3 * lower if own.sums.centre else 3 * own.noise * self.count / len(light))
        # Light of lines alternates from pattern to pattern, and that of a hot pixel does not.
        hot = (_LIT * light > upper) & (np.square(own.vectors.mean(axis=1)) * self.count > 0.2 * light)
        strange = dark & (lower > _LIT * np.median(light)) | hot
        where = f"sensor {('row', 'column')[own.axis]} {np.argmax(strange)}"
        words = f"{where} shows no light, or too much; check the sensor"
        own.add(words, float(np.maximum(light, lower)[strange].sum()))
        if foreign or strange.any() or not shadow.predicts:
            return
        # The lines at the ends are predicted from one side only.
        line = 1 + int(np.argmax(shadow.lines[1:-1]))
        words = f"line {line} of the {own.side} stripes is not as bright as its neighbours predict; check the projector"
        own.add(words, shadow.lines[line] / len(shadow.lines) * own.size * (shadow.lines[line] > _LINE))
        if not self.paired:
            # The first line is +1 in all patterns, and every other one as often -1: light that all share is there.
            offset = shadow.lines[0] / len(shadow.lines) * own.size
            own.add(_OFFSET, 4 * offset * (offset > 3 * own.noise * self.count))  # smooth light is seen in part
            places, variances = shadow.along(-1j * shadow.angles[:, None] * shadow.spectra)
            own.add_motion(places[1:], variances[1:], self.times[own.axis][1:])
            shown = np.square(own.vectors + own.vectors[:, :1]).sum(axis=0)
            # 1 - 1 / p, where p (u_i + u_0) - u_0 is the vector of a frame of power p.
            powers, variances = shadow.along(shadow.spectra + shadow.spectra[:, :1])
            squares = np.square(powers)
            counted = (squares > _SLIGHT**2) | (np.median(squares / variances) > 4)
            own.add(_POWER, float(((squares - variances) * counted)[1:] @ shown[1:]))

    # ---- the result --------------------------------------------------------------------------------------------------

    def judge(self) -> None:
        found, sides = self.found, self.sides
        reasons = {**sides[0].extras, **sides[1].extras}
        energies = {why: sum(own.extras.get(why, 0.0) / own.size for own in sides) for why in reasons}
        order, total = sorted(energies, key=lambda why: -energies[why]), float(np.sqrt(sum(energies.values())))
        least = (_MATTERS * self.noise) ** 2
        doubts = [why for why in order if why not in (_LAMP, _REPLACED, _PHOTONS) and energies[why] > least]
        if total > LARGEST_ERROR or (self.refused and doubts):
            raise MitsimError(f"all frames: {order[0]}: it leaves a factor error of {total:.0%}; take them again")
        if self.refused:
            reason = self.refused[0][1]
            names = [self.name(half) for half, why in self.refused if why == reason]
            listed = ", ".join(names[:_NAMED]) + f" and {len(names) - _NAMED} more" * (len(names) > _NAMED)
            every = "all " * (len(self.refused) > 2 * max(2, MOST_FAULTS * self.count))
            raise MitsimError(f"{every}frames: {listed}: {reason}; take them again")
        words = "session: {}; the stated error includes {:.1e} for it"
        found.doubts += [words.format(why, np.sqrt(energies[why])) for why in doubts]
        found.faults.sort(key=lambda fault: (SIDES.index(fault.side), fault.index))
        left, right = (own.result() for own in sides)
        found.sums, found.extra = (left, right), (sum(sides[0].extras.values()), sum(sides[1].extras.values()))
