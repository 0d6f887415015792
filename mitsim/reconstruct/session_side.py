"""Vectors of one side's stripe patterns in; those that are out of their place put back, those that are wrong left out.

What a pattern's vector should be, the others predict, as all are of one moving shadow (:class:`MovingShadow`). Where
that is a shadow of nothing, and columns are independent, nothing is predicted and nothing is found.

Column j of a factor is the mask's shadow from scene line j, which moves over the sensor as the line does: column j + 1
is column j moved by ``step`` pixels. At each spatial frequency columns are thus a phase that grows with j, times what
varies slowly from line to line (light falls off, obliquity): a polynomial of j. Detail finer than the pixels shows at a
frequency of its own, and moves at the step that it has. Least squares in these few numbers predict each pattern's
vector u_i = Phi h_i from all others. That columns are alike would not show which way the shadow moves: of two patterns
that are sine and cosine of one period, exchanged frames of one turn it round.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.devices.session import SIDES, UNIFORM, Half, Side
from mitsim.reconstruct.estimate_factors import StripeSums

# ---- Vectors of patterns as one moving shadow has them ---------------------------------------------------------------


_MOVES = (0, -1), (1, -1), (-1, -1), (2, -1)
"""Turns and sign of the frequencies that pixels show as k in [0, pi]: itself, 2 pi - k, whose phase is mirrored,
2 pi + k and 4 pi - k. Without them the finest stripes, of masks of two pixels a feature, seem to move the other way."""
_FINE = 0.4
"""Pixels a line from which the lines resolve no 4 pi - k, of 1.5 periods a pixel or more. Without it, good cameras of
0.25 pixels a line had a deviation of 152 in their finest stripes; with it 18 at most. Of 32 lines it would leave too
few to predict with."""
_DEGREE = 3
"""Of the polynomial, where there are lines enough: falloff and obliquity of 120 mm at 400 mm are even and smooth."""
_LINES = 8
"""Scene lines for each of a polynomial's numbers, at least: three of them leave most lines to predict with."""
_FREQUENCIES = 64
"""Spatial frequencies that are looked at, of all that there are, evenly: more show the same, and cost time."""
_TAPER = 0.15
"""Part of the sensor that fades out at each end, where a moving shadow leaves and another comes in; chosen: 0.08 does
as well, without it 2 of 600 planted exchanges were missed."""
_FARTHEST = 0.6
"""Part of the sensor that the shadow moves by at most, from the first scene line to the last: more leaves little that
both show."""
_ROUNDING = 1e-12
"""Squared deviation, as a part of the vectors' mean square, that vectors without noise have."""

_FITS_OF_UNKNOWN = 3
"""Times that unknown patterns are fitted one after the other: they hardly hang on each other."""

ComplexArray = npt.NDArray[np.complex128]


class MovingShadow:
    """What patterns' vectors predict of each other.

    Parameters
    ----------
    vectors
        (m, N) u_i.
    signs
        (n, N) H.
    unknown
        patterns whose vectors do not count: what fits the others best is taken for them.

    Attributes
    ----------
    step
        sensor pixels that the shadow moves by from one column to the next.
    deviations
        (N,) mean squared deviation of a vector from what the others predict, in that of the median pattern.
    unlike
        (N,) the same squared deviation as a part of the vector's own square.
    amended
        (N,) squared length of what was taken for unknown vectors less those that were given.
    first_line
        squared length of the first column's deviation from the others, which errors that all patterns share make, and
        of the median column's.
    by_exchange
        (N,) what -u_i in place of u_i takes off the squared deviations of all vectors, in the same unit.
    """

    def __init__(self, vectors: FloatArray, signs: FloatArray, unknown: Collection[int] = ()) -> None:
        pixels, (n, count) = len(vectors), signs.shape
        taper = _taper(pixels)
        self._spectra, angles, stride = _spectra(vectors, taper)
        spectra = self._spectra
        columns = spectra @ signs.T / count
        self.step = _step(columns, angles, pixels)
        modes = _modes(angles, self.step, n)
        turned = np.ascontiguousarray(modes.conj().transpose(0, 2, 1))
        # Patterns as they show in the modes, real and imaginary parts (frequencies, 2 modes, N).
        parts = np.concatenate([turned.real, turned.imag], axis=1)
        self._shown = (parts.reshape(-1, n) @ (signs / count)).reshape(*parts.shape[:2], count)
        self._signs = signs
        self._own = own = self._joint(n / count**2, self._shown)
        self._left = self._beyond(modes, turned, columns)
        # Sums over positive frequencies, twice, are those over as many sensor rows as the taper leaves.
        whole = 2 * stride / float(np.square(taper).sum())
        self.first_line = _first_line(modes, self._left @ signs.T, whole)
        before = spectra.copy() if unknown else spectra
        for index in [*unknown] * _FITS_OF_UNKNOWN:
            spectra[:, index] -= self._left[:, index] / own[:, index]
            self._left = self._beyond(modes, turned, spectra @ signs.T / count)
        self.amended = whole * np.square(np.abs(spectra - before)).sum(axis=0)
        squares = np.square(np.abs(spectra)).sum(axis=0)
        deviations = (np.square(np.abs(self._left)) / own).sum(axis=0)
        self._unit = (float(np.median(deviations)) + _ROUNDING * float(squares.mean()) / count) or 1.0
        self.deviations = deviations / self._unit
        self.unlike = np.square(np.abs(self._left / own)).sum(axis=0) / np.maximum(squares, np.finfo(np.float64).tiny)
        gains = np.real(spectra.conj() * self._left) - np.square(np.abs(spectra)) * own
        self.by_exchange = 4 * gains.sum(axis=0) / self._unit

    def _beyond(self, modes: ComplexArray, turned: ComplexArray, columns: ComplexArray) -> ComplexArray:
        """(frequencies, N) what no mode explains of ``columns`` (frequencies, n), by pattern."""
        rest = columns - np.matmul(modes, np.matmul(turned, columns[..., None]))[..., 0]
        return np.asarray(rest @ self._signs / self._signs.shape[1])

    @staticmethod
    def _joint(size: FloatArray | float, shown: FloatArray) -> FloatArray:
        """(frequencies, patterns) squared length of patterns beyond the modes, of their whole ``size`` (patterns,) and
        of what they have ``shown`` of the modes (frequencies, 2 modes, patterns)."""
        return np.asarray(np.maximum(size - np.einsum("kri,kri->ki", shown, shown), 1e-9 * size))

    def by_swap(self, places: list[tuple[int, int]]) -> FloatArray:
        """What swapping two vectors takes off the squared deviations of all, for each pair of ``places``."""
        first, second = np.transpose(places)
        moved = self._spectra[:, second] - self._spectra[:, first]
        left = self._left[:, first] - self._left[:, second]
        n, count = self._signs.shape
        product = np.einsum("ji,ji->i", self._signs[:, first], self._signs[:, second])
        size = self._joint(2 * (n - product) / count**2, self._shown[..., first] - self._shown[..., second])
        change = 2 * np.real(moved.conj() * left) + np.square(np.abs(moved)) * size
        return np.asarray(-change.sum(axis=0) / self._unit)

    def by_scale(self) -> FloatArray:
        """(N,) what it takes off to scale a frame that is shown against the uniform one, whose vector is u_i + u_0, for
        each pattern."""
        shown = self._spectra + self._spectra[:, :1]
        pull = np.real(shown.conj() * self._left).sum(axis=0)
        size = np.maximum((np.square(np.abs(shown)) * self._own).sum(axis=0), np.finfo(np.float64).tiny)
        return np.asarray(np.square(pull) / size / self._unit)


def shadow_step(factor: FloatArray) -> float:
    """Sensor pixels that the shadow in a ``factor`` (m, n) moves by from one column to the next."""
    spectra, angles, _ = _spectra(factor, _taper(len(factor)))
    return _step(spectra, angles, len(factor))


def _spectra(columns: FloatArray, taper: FloatArray) -> tuple[ComplexArray, FloatArray, int]:
    """(frequencies, n) of tapered ``columns`` (m, n), angles of the frequencies a pixel, and how many are passed over
    from one to the next."""
    # A frame's mean light is no part of the shadow's shape, and centred frames have none.
    spectra = np.fft.rfft(columns * taper[:, None], axis=0)[1:]
    stride = -(-len(spectra) // _FREQUENCIES)
    return spectra[::stride], 2 * np.pi * np.arange(1, len(spectra) + 1)[::stride] / len(columns), stride


def _modes(angles: FloatArray, step: float, n: int) -> ComplexArray:
    """(frequencies, n, modes) orthonormal: how columns' spectra at spatial frequencies of so many ``angles`` (a pixel)
    may vary with the scene line."""
    degree = max(min(_DEGREE, n // _LINES - 1), 0)
    slow = np.polynomial.legendre.legvander(np.linspace(-1, 1, n), degree)
    fine = abs(step) < _FINE and n >= _LINES // 2 * len(_MOVES) * (degree + 1)
    moves = _MOVES if fine else _MOVES[:-1]
    phases = [np.exp(1j * step * np.outer(2 * np.pi * turns + sign * angles, np.arange(n))) for turns, sign in moves]
    return np.asarray(np.linalg.qr(np.concatenate([phase[..., None] * slow for phase in phases], axis=2))[0])


def _first_line(modes: ComplexArray, rest: ComplexArray, whole: float) -> tuple[float, float]:
    """Squared length of the first of columns beyond what the others predict, and of the median one, of the ``rest``
    (frequencies, n) that modes leave of them; sums times ``whole``."""
    kept = np.maximum(1 - np.square(np.abs(modes)).sum(axis=2), 1e-3)
    lines = whole * np.square(np.abs(rest / kept)).sum(axis=0)
    return float(lines[0]), float(np.median(lines))


def _taper(pixels: int) -> FloatArray:
    length = max(int(_TAPER * pixels), 1)
    taper = np.ones(pixels)
    taper[:length] = np.square(np.sin(np.pi / 2 * (np.arange(length) + 0.5) / length))
    return taper * taper[::-1]


def _step(columns: ComplexArray, angles: FloatArray, pixels: int) -> float:
    """Pixels that spectra of ``columns`` (frequencies, n) move by from one to the next: those that, moved back, add up
    to most."""
    n = columns.shape[1]
    length = 8 * n
    power = np.square(np.abs(np.fft.fft(columns, length, axis=1)))
    rows = np.arange(len(angles))

    def sums(steps: FloatArray) -> FloatArray:
        places = np.rint(-np.outer(steps, angles) * (length / (2 * np.pi))).astype(np.int64) % length
        return np.asarray(power[rows, places].sum(axis=1))

    most = int(_FARTHEST * pixels)
    coarse = np.arange(-most, most + 1) / n
    best = coarse[int(np.argmax(sums(coarse)))]
    fine = best + np.linspace(-1, 1, 41) / n
    return float(fine[int(np.argmax(sums(fine)))])


# ---- Faults of a session, and how they are said ----------------------------------------------------------------------


DARK = 0.03
"""Light of a black frame, as a part of what it should have: stray light and the projector's own black level."""


def robust_scatter(values: FloatArray, middle: float = 0.0) -> float:
    """Standard deviation of normal ``values`` about their ``middle``, by the median, which a few others do not move."""
    return 1.4826 * float(np.median(np.abs(values - middle)))


@dataclass(frozen=True)
class SessionFault:
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

    def _names(self, name: Callable[[Half], str], index: int) -> list[str]:
        """Names of a pattern's frames, both or that of its sign."""
        return [name((self.side, index, sign)) for sign in ((1, -1) if self.sign is None else (self.sign,))]

    def words(self, name: Callable[[Half], str]) -> str:
        """A sentence; ``name`` says which frame it is."""
        others = []
        if self.other is not None:
            others = self._names(name, self.other[1]) if self.other[2] == UNIFORM else [name(self.other)]
        other = f" ({' and '.join(others)})" if others else ""
        cost = f", at a factor error of {self.cost:.1e}" if self.cost else ""
        names = " and ".join(self._names(name, self.index))
        return f"frames: {names}: {self.detail}{other}; {self.repair}{cost}"

    def for_manifest(self, name: Callable[[Half], str]) -> dict[str, Any]:
        """The same for a manifest; ``name`` says which frame it is."""
        return {"frames": self._names(name, self.index), **asdict(self)}


def frame_words(half: Half) -> str:
    """Which frame of a session a ``half`` is, in words."""
    side, index, sign = half
    return f"{side} stripes {index} of sign {sign:+d}" if sign != UNIFORM else f"{side} stripes {index}"


def name_by_light(part: float) -> tuple[str, str]:
    """Kind and words of a frame with a ``part`` of its light."""
    kind = "dim" if part < 1 else "bright"
    return kind, f"is {kind}: it has {part:.3g} of its light"


# ---- One side's patterns ---------------------------------------------------------------------------------------------


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


def odd_responses(misfits: FloatArray, energies: FloatArray, numbers: int) -> npt.NDArray[np.intp]:
    """Responses that hold much that no separable camera explains, where the others do not.

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
    """Whether so many wrong ``patterns`` leave a session of ``count`` a side in doubt."""
    return patterns > max(2, MOST_FAULTS * 2 * count)


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
        self.side: Side = "horizontal" if sums.side == SIDES[0] else "vertical"
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
        return bool(self.sums.pairs)

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
        for index in odd_responses(misfits, energies, self.length * len(self.sums.common)):
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
            as :class:`SessionFault` has them.
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
