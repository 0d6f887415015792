"""Flat and dark frames of a camera in, the figures of EMVA 1288 release 4.0 out; frames may be real or simulated.

Photon transfer: pairs of flat frames over a ladder of light tell the system gain, quantum efficiency, saturation and
linearity; pairs of dark frames over a series of exposures the dark current; stacks of dark and of half-bright frames
the nonuniformity, split into rows, columns and pixels. Statistics may have leading axes: many sessions at once.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray

QUANTISATION = 1 / 12
"""Variance of rounding [DN^2] (EMVA 1288, "noise model")."""
LEAST_DARK = 0.24
"""Variance [DN^2] of dark frames below which rounding hides their noise: it counts as this much, an upper limit of
0.4 DN for the noise (EMVA 1288 4.0, "limit for minimal temporal standard deviation")."""
HIDDEN = 1e-3
"""Variance [DN^2] of all dark frames below which one reading in a thousand is another code, and none tells a current:
chosen below what any camera of 0.2 DN of noise has."""
MOST_FITTED, LINEAR = 0.7, (0.05, 0.95)
"""Parts of saturation: gain and responsivity are fitted up to 70 %, linearity from 5 to 95 % (EMVA 1288 4.0)."""
LINE = 3
"""Least points of a line that tell how straight it is."""
_CODES = 65_536
"""Codes of a histogram; numbers of more bits are folded, which keeps the frequencies that rational factors make."""
_BLURRED = 0.52
"""Standard deviations of noise in a period from which an even histogram holds less than 5e-3 of that period."""
_QUIET = 0.99
"""Part of a frame's pixels of one code from which two frames may be equal by chance."""
SPLIT = ("total", "row", "column", "pixel")
"""Parts of a nonuniformity."""


@dataclass(frozen=True)
class Pair:
    """Of two frames under the same light: mean (...) [DN], temporal variance, and its part that rows share [DN^2]."""

    mean: FloatArray
    variance: FloatArray
    rows: FloatArray


@dataclass(frozen=True)
class Stack:
    """Of the mean of L frames, all (...).

    Attributes
    ----------
    mean
        of all pixels [DN].
    total
        spatial variance of all pixels [DN^2], as all variances without what is left of temporal noise.
    rows, columns
        variance of the means of rows, and of columns.
    """

    mean: FloatArray
    total: FloatArray
    rows: FloatArray
    columns: FloatArray

    def parts(self, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Variances (total, row, column, pixel) [DN^2] for frames of a ``shape`` of M rows and N columns.

        A pixel's part is left in the means of rows as 1/N of it, and of columns as 1/M (EMVA 1288 4.0, "row, column and
        pixel spatial variances").
        """
        m, n = shape
        pixel = m * n / (m * n - m - n) * (self.total - self.rows - self.columns)
        return self.total, self.rows - pixel / n, self.columns - pixel / m, pixel


@dataclass(frozen=True)
class Session:
    """What the frames of one characterisation say, in S sets that were taken alike.

    Attributes
    ----------
    shape
        rows and columns of the frames.
    photons
        (S,) mean photons that fall on a pixel, or light in any unit; 0 in the dark.
    exposure_s
        (S,) of each set [s].
    pairs
        (..., S) means and temporal variances.
    dark, bright
        which sets tell nonuniformity: one in the dark, one near half of saturation.
    dark_stack, bright_stack
        of these.
    saturates
        whether the brightest set is saturated.
    rounded
        whether the frames are whole numbers.
    """

    shape: tuple[int, int]
    photons: FloatArray
    exposure_s: FloatArray
    pairs: Pair
    dark: int
    bright: int
    dark_stack: Stack
    bright_stack: Stack
    saturates: bool = True
    rounded: bool = True

    @property
    def lit(self) -> npt.NDArray[np.intp]:
        """Sets under light, by light."""
        order = np.argsort(self.photons, kind="stable")
        return np.asarray(order[self.photons[order] > 0])

    @property
    def unlit(self) -> npt.NDArray[np.intp]:
        """Sets in the dark, by exposure."""
        order = np.argsort(self.exposure_s, kind="stable")
        return np.asarray(order[self.photons[order] == 0])

    @property
    def partners(self) -> npt.NDArray[np.intp]:
        """For each set under light, one in the dark of its exposure: that of the nonuniformity where it is."""
        unlit = np.array([self.dark, *(index for index in self.unlit if index != self.dark)])
        off = np.abs(self.exposure_s[unlit] - self.exposure_s[self.lit][:, None])
        return np.asarray(unlit[off.argmin(axis=1)])

    def transfer(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of the sets under light, by light: photons (L,), and signal (..., L) [DN] and variance
        [DN^2] less the dark."""
        lit, dark = self.lit, self.partners
        mean, variance = self.pairs.mean, self.pairs.variance
        return self.photons[lit], mean[..., lit] - mean[..., dark], variance[..., lit] - variance[..., dark]


@dataclass(frozen=True, eq=False)
class Alike:
    """What frames say that were taken alike: same light, same exposure.

    Attributes
    ----------
    count, shape
        of the frames.
    pair, stack
        temporal and spatial statistics.
    variance_error
        standard error of the temporal variance [DN^2], from how it varies over the pixels.
    cut
        parts of all numbers that are 0, and that are the largest code.
    flicker
        standard deviation of the frames' means beyond what noise makes [DN].
    neighbours
        correlation of the noise of neighbours in a row, and in a column: 0 where electrons are counted.
    comb
        largest amplitude of a periodic pattern in the histogram of codes, of periods that noise blurs in an even ADC,
        and that period [DN]. Every other code missing has an amplitude of 1.
    digests
        checksum of each frame; empty for a frame with nearly all pixels at one code.
    """

    count: int
    shape: tuple[int, int]
    pair: Pair
    stack: Stack
    variance_error: float
    cut: tuple[float, float]
    flicker: float
    neighbours: tuple[float, float]
    comb: tuple[float, float] = (0.0, 1.0)
    digests: tuple[bytes, ...] = ()

    @property
    def mean_error(self) -> float:
        """Standard error of the mean that noise makes [DN]."""
        rows = max(float(self.pair.rows), 0.0)
        own = max(float(self.pair.variance) - rows, 0.0)
        return math.sqrt((own / math.prod(self.shape) + rows / self.shape[0]) / self.count)


def alike(frames: Iterable[npt.ArrayLike], largest: float = math.inf) -> Alike:
    """Statistics of ``frames`` (M, N) [DN] that were taken alike; they are looked at one after the other.

    The temporal variance is that of each pixel about its mean, of frames less their own means: free of all that is
    fixed in space, and of a drift of the light. Of two frames it is <(a - b)^2>/2 - (<a> - <b>)^2/2.

    Parameters
    ----------
    frames
        two or more; ValueError for fewer.
    largest
        code of the ADC's end.
    """
    means, lines, ends = list[float](), list[FloatArray](), np.zeros(2)
    codes, digests = np.zeros(_CODES), list[bytes]()
    first: FloatArray = np.zeros((0, 0))
    total = squares = last = difference = first
    for frame in frames:
        values = np.asarray(frame, dtype=np.float64)
        if not means:
            first, total, squares, last = values, *(np.zeros(values.shape) for _ in range(3))
        ends += np.count_nonzero(values <= 0), np.count_nonzero(values >= largest)
        numbers = np.bincount(np.rint(values).astype(np.int64).ravel() % _CODES, minlength=_CODES)
        codes += numbers
        digests.append(b"" if numbers.max() > _QUIET * values.size else hashlib.blake2b(values.tobytes()).digest())
        off = values - first  # squares of small numbers keep their digits
        means.append(float(off.mean()))
        off -= means[-1]
        total += off
        squares += np.square(off)
        lines.append(off.mean(axis=1))
        difference, last = off - last, off
    count, (m, n) = len(means), first.shape
    if count < 2:
        raise ValueError(f"alike: {count} frames tell no temporal noise; give 2 or more")
    own = (squares - np.square(total) / count) / (count - 1)
    variance = float(own.sum()) / (m * n - 1)
    shared = (float(np.var(lines, axis=0, ddof=1).sum()) / (m - 1) - variance / n) * n / (n - 1)
    pair = Pair(*map(np.asarray, (first.mean() + np.mean(means), variance, shared)))
    about = first + total / count
    about -= about.mean()
    parts = np.square(about).sum() / (m * n - 1), *(np.square(about.mean(axis=k)).mean() for k in (1, 0))
    stack = Stack(
        pair.mean, *(np.asarray(part - variance / count / k) for part, k in zip(parts, (1, n, m), strict=True))
    )
    rows = max(shared, 0.0)
    # Of the pixels' variances, which rows that share noise move together (see `mitsim.studies.emva_frames`).
    spread = float(own.var()) + (4 * max(variance - rows, 0.0) * rows + 2 * rows**2 * n) / (count - 1)
    drift = float(np.var(means, ddof=1)) - (variance - rows) / (m * n) - rows / m
    return Alike(
        count, (m, n), pair, stack, math.sqrt(spread / (m * n)), (ends[0] / count / m / n, ends[1] / count / m / n),
        math.sqrt(max(drift, 0.0)), _neighbours(difference),
        _comb(codes, math.sqrt(max(variance - rows, 0.0))) if math.isfinite(largest) else (0.0, 1.0), tuple(digests),
    )  # fmt: skip


def _comb(codes: FloatArray, noise: float) -> tuple[float, float]:
    """Return amplitude and period [DN] of the strongest pattern in a histogram (codes,) of readings with a ``noise``.

    The characteristic function of readings with noise vanishes at high frequencies. Codes that never occur or occur
    too often, as after scaling or with a stuck bit, bring it back.
    """
    first = math.ceil(_BLURRED / noise * len(codes)) if noise else len(codes)
    if first > len(codes) // 2:
        return 0.0, 1.0
    waves = np.abs(np.fft.rfft(codes))[first:] / codes.sum()
    strongest = int(np.argmax(waves > 0.9999 * waves.max()))
    return float(waves[strongest]), len(codes) / (first + strongest)


def _neighbours(noise: FloatArray) -> tuple[float, float]:
    """Correlation of neighbours in a row, and in a column, of ``noise`` less what rows and columns share."""
    noise = noise - noise.mean(axis=1, keepdims=True)
    noise -= noise.mean(axis=0)
    power = float(np.square(noise).mean())
    if not power:
        return 0.0, 0.0
    return float((noise[:, 1:] * noise[:, :-1]).mean()) / power, float((noise[1:] * noise[:-1]).mean()) / power


def pairs_of(pairs: Sequence[Pair]) -> Pair:
    """``pairs`` side by side, (count,) each."""
    return Pair(*(np.array([getattr(pair, name) for pair in pairs]) for name in ("mean", "variance", "rows")))


def figures(session: Session) -> dict[str, FloatArray]:
    """The figures (...) of a ``session``, by name; variances may come out below zero, where there is nothing to find.

    `system_gain` [DN/e-], `quantum_efficiency` [e-/photon], `dark_noise` [e-], `saturation_capacity` (at the largest
    variance) and `full_well` (of the brightest frames) [e-], `linearity_min` and `linearity_max` [1], `dark_current`
    (by means) and `dark_current_by_variance` [e-/s]; as variances `row_noise` [e-^2], `dsnu_PART` [e-^2] and
    `prnu_PART` [1] for each PART of :data:`SPLIT`. What the frames do not tell is left out: saturation where nothing is
    saturated, linearity of fewer than three steps, dark current of one exposure or all one code.
    """
    photons, signal, noise = session.transfer()
    variance, unlit = session.pairs.variance, session.unlit
    dark = Pair(*(getattr(session.pairs, name)[..., session.dark] for name in ("mean", "variance", "rows")))
    peak = variance[..., session.lit].argmax(axis=-1)
    full = np.take_along_axis(signal, peak[..., None], axis=-1) if session.saturates else np.full(1, np.inf)
    fitted = signal <= MOST_FITTED * full
    gain = _slope(signal, noise, fitted)
    efficiency = _slope(np.broadcast_to(photons, signal.shape), signal, fitted) / gain
    times = session.exposure_s[unlit]
    about = times - times.mean()
    slopes = [
        (values[..., unlit] * about).sum(axis=-1) / max(np.square(about).sum(), 1e-300)
        for values in (session.pairs.mean, variance)
    ]
    still = dark.variance
    if len(np.unique(session.exposure_s[session.lit])) >= LINE:
        still = variance[..., unlit].mean(axis=-1) - slopes[1] * times.mean()
    still = np.maximum(still, LEAST_DARK) - QUANTISATION if session.rounded else np.maximum(still, 0)
    found = {
        "system_gain": gain,
        "quantum_efficiency": efficiency,
        "dark_noise": np.sqrt(still) / gain,
        "row_noise": dark.rows / gain**2,
    }
    if session.saturates:
        found |= {"saturation_capacity": efficiency * photons[peak], "full_well": signal[..., -1] / gain}
    top = full if session.saturates else signal[..., -1:]
    used = (signal >= LINEAR[0] * top) & (signal <= (LINEAR[1] if session.saturates else 1) * top)
    if used.sum(axis=-1).min() >= LINE:
        low, high = _linearity(photons, signal, used)
        found |= {"linearity_min": low, "linearity_max": high}
    if np.ptp(times) > 0 and variance[..., unlit].max() > HIDDEN:
        found |= {"dark_current": slopes[0] / gain, "dark_current_by_variance": slopes[1] / gain**2}
    dim, bright = session.dark_stack, session.bright_stack
    contrast = bright.mean - dim.mean
    for name, off, on in zip(SPLIT, dim.parts(session.shape), bright.parts(session.shape), strict=True):
        found[f"dsnu_{name}"] = off / gain**2
        found[f"prnu_{name}"] = (on - off) / contrast**2
    return found


def _slope(x: FloatArray, y: FloatArray, used: npt.NDArray[np.bool_]) -> FloatArray:
    """Slope (...) of the least squares line from the origin of ``y`` over ``x`` (..., S), where they are ``used``."""
    return np.asarray((x * y * used).sum(axis=-1) / (np.square(x) * used).sum(axis=-1))


def _linearity(photons: FloatArray, signal: FloatArray, used: npt.NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Least and largest relative deviation (...) of ``signal`` from a line over ``photons``, where they are ``used``.

    The line's squared *relative* deviations are least (EMVA 1288 4.0, "linearity"): weights 1 / signal^2.
    """
    weight = used / np.square(np.where(used, signal, 1.0))
    total, first = weight.sum(axis=-1), (weight * photons).sum(axis=-1)
    second, value = (weight * photons**2).sum(axis=-1), (weight * signal).sum(axis=-1)
    cross = (weight * photons * signal).sum(axis=-1)
    slope = (total * cross - first * value) / (total * second - first**2)
    line = ((value - slope * first) / total)[..., None] + slope[..., None] * photons
    off = np.where(used, (signal - line) / np.where(used, line, 1.0), 0.0)
    return np.where(used, off, np.inf).min(axis=-1), np.where(used, off, -np.inf).max(axis=-1)
