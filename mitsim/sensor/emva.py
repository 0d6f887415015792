"""The figures of EMVA 1288 release 4.0, from statistics of flat and dark frames, real or simulated.

Statistics may have leading axes, for many sessions at once.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray

QUANTISATION = 1 / 12
"""Variance of rounding [DN^2] (EMVA 1288, "noise model")."""
LEAST_DARK = 0.24
"""Least variance [DN^2] of dark frames, because rounding hides less (EMVA 1288 4.0, "minimal temporal
standard deviation").
"""
HIDDEN = 1e-3
"""Variance [DN^2] of dark frames below which one reading in a thousand is another code."""
MOST_FITTED, LINEAR = 0.7, (0.05, 0.95)
"""Fractions of saturation for the fit of the gain and for linearity (EMVA 1288 4.0)."""
LINE = 3
"""Least number of points that show how straight a line is."""
SPLIT = ("total", "row", "column", "pixel")
_CODES = 65_536
"""Larger codes are folded, which keeps the frequencies of rational factors."""
_BLURRED = 0.52
"""Standard deviations of noise in a period from which an even histogram holds less than 5e-3 of that period."""
_QUIET = 0.99
"""Fraction of pixels at one code from which two frames may be equal by chance."""


@dataclass(frozen=True)
class Stack:
    """Mean [DN] and spatial variances [DN^2] of averaged frames: by pixel, by row mean and by column mean."""

    mean: FloatArray
    total: FloatArray
    rows: FloatArray
    columns: FloatArray

    def parts(self, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the variances (total, row, column, pixel) [DN^2] for frames of shape (M, N) (EMVA 1288 4.0)."""
        m, n = shape
        pixel = m * n / (m * n - m - n) * (self.total - self.rows - self.columns)
        return self.total, self.rows - pixel / n, self.columns - pixel / m, pixel


@dataclass(frozen=True)
class Session:
    """Statistics of one characterisation: S sets of frames.

    Attributes
    ----------
    photons, exposure_s : (S,) photons on a pixel, or light in any unit, and exposure [s].
    mean, variance, rows : (..., S) mean [DN], temporal variance [DN^2] and its part shared by rows.
    dark, bright : sets for nonuniformity, in the dark and near half of saturation.
    saturates, rounded : True if the brightest set is saturated, and if the frames are whole numbers.
    """

    shape: tuple[int, int]
    photons: FloatArray
    exposure_s: FloatArray
    mean: FloatArray
    variance: FloatArray
    rows: FloatArray
    dark: int
    bright: int
    dark_stack: Stack
    bright_stack: Stack
    saturates: bool = True
    rounded: bool = True

    @property
    def lit(self) -> npt.NDArray[np.intp]:
        order = np.argsort(self.photons, kind="stable")
        return np.asarray(order[self.photons[order] > 0])

    @property
    def unlit(self) -> npt.NDArray[np.intp]:
        order = np.argsort(self.exposure_s, kind="stable")
        return np.asarray(order[self.photons[order] == 0])

    def transfer(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return photons (L,) of lit sets, and their signal and variance (..., L) less the dark of their exposure."""
        lit, unlit = self.lit, np.array([self.dark, *(index for index in self.unlit if index != self.dark)])
        dark = unlit[np.abs(self.exposure_s[unlit] - self.exposure_s[lit][:, None]).argmin(axis=1)]
        signal, noise = (each[..., lit] - each[..., dark] for each in (self.mean, self.variance))
        return self.photons[lit], signal, noise


@dataclass(frozen=True, eq=False)
class Alike:
    """Statistics of frames under equal conditions.

    Attributes
    ----------
    mean, variance, rows, variance_error
        Mean [DN], temporal variance [DN^2], its part shared by rows, and the standard error of the variance.
    cut
        Fractions of all numbers that are 0, and that are the largest code.
    flicker
        Standard deviation of the frames' means beyond noise [DN].
    neighbours
        Correlation of the noise of neighbours in a row and in a column.
    comb
        Amplitude and period [DN] of a pattern in the codes; 1 if every other code is missing.
    digests
        Checksum of each frame; empty for a frame with nearly all pixels at one code.
    """

    count: int
    shape: tuple[int, int]
    mean: float
    variance: float
    rows: float
    stack: Stack
    variance_error: float
    cut: tuple[float, float]
    flicker: float
    neighbours: tuple[float, float]
    comb: tuple[float, float]
    digests: tuple[bytes, ...]
    light: float
    exposure_s: float

    @property
    def mean_error(self) -> float:
        rows = max(self.rows, 0.0)
        own = max(self.variance - rows, 0.0)
        return math.sqrt((own / math.prod(self.shape) + rows / self.shape[0]) / self.count)


def alike(
    frames: Iterable[npt.ArrayLike], largest: float = math.inf, light: float = 0.0, exposure_s: float = 0.0
) -> Alike:
    """Return statistics of frames (M, N) [DN] under equal conditions, one frame at a time.

    The temporal variance of two frames is <(a - b)^2>/2 - (<a> - <b>)^2/2, without fixed patterns and drift.
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
        raise ValueError(f"alike: {count} frames cannot show temporal noise; give 2 or more")
    own = (squares - np.square(total) / count) / (count - 1)
    variance = float(own.sum()) / (m * n - 1)
    shared = (float(np.var(lines, axis=0, ddof=1).sum()) / (m - 1) - variance / n) * n / (n - 1)
    mean = float(first.mean() + np.mean(means))
    about = first + total / count
    about -= about.mean()
    parts = np.square(about).sum() / (m * n - 1), *(np.square(about.mean(axis=k)).mean() for k in (1, 0))
    left = (np.asarray(part - variance / count / k) for part, k in zip(parts, (1, n, m), strict=True))
    rows = max(shared, 0.0)
    noise = math.sqrt(max(variance - rows, 0.0))
    # Spread over the pixels' variances, which noise that rows share moves together.
    spread = float(own.var()) + (4 * max(variance - rows, 0.0) * rows + 2 * rows**2 * n) / (count - 1)
    drift = float(np.var(means, ddof=1)) - (variance - rows) / (m * n) - rows / m
    difference = difference - difference.mean(axis=1, keepdims=True)
    difference -= difference.mean(axis=0)
    power = float(np.square(difference).mean()) or math.inf
    beside, below = (difference[:, 1:] * difference[:, :-1]).mean(), (difference[1:] * difference[:-1]).mean()
    return Alike(
        count, (m, n), mean, variance, shared, Stack(np.asarray(mean), *left), math.sqrt(spread / (m * n)),
        (ends[0] / count / m / n, ends[1] / count / m / n), math.sqrt(max(drift, 0.0)),
        (float(beside) / power, float(below) / power),
        _comb(codes, noise) if math.isfinite(largest) else (0.0, 1.0), tuple(digests), light, exposure_s,
    )  # fmt: skip


def _comb(codes: FloatArray, noise: float) -> tuple[float, float]:
    """Return amplitude and period [DN] of the strongest pattern in a histogram (codes,) of readings with noise.

    The characteristic function vanishes at high frequencies, unless codes never occur or occur too often.
    """
    first = math.ceil(_BLURRED / noise * len(codes)) if noise else len(codes)
    if first > len(codes) // 2:
        return 0.0, 1.0
    waves = np.abs(np.fft.rfft(codes))[first:] / codes.sum()
    strongest = int(np.argmax(waves > 0.9999 * waves.max()))
    return float(waves[strongest]), len(codes) / (first + strongest)


def figures(session: Session) -> dict[str, FloatArray]:
    """Compute the figures (...) of a session by name.

    `row_noise` [e-^2], `dsnu_PART` [e-^2] and `prnu_PART` [1] are variances, which may be negative. `dark_current`
    follows from means, `saturation_capacity` from the largest variance and `full_well` from the brightest frames.
    Figures that the frames do not determine are left out.
    """
    photons, signal, noise = session.transfer()
    variance, unlit = session.variance, session.unlit
    full = np.full(1, np.inf)
    peak = variance[..., session.lit].argmax(axis=-1)
    if session.saturates:
        full = np.take_along_axis(signal, peak[..., None], axis=-1)
    fitted = signal <= MOST_FITTED * full
    gain = _slope(signal, noise, fitted)
    efficiency = _slope(np.broadcast_to(photons, signal.shape), signal, fitted) / gain
    times = session.exposure_s[unlit]
    about = times - times.mean()
    current, rise = ((each[..., unlit] * about).sum(axis=-1) / max(np.square(about).sum(), 1e-300)
                     for each in (session.mean, variance))  # fmt: skip
    still = variance[..., session.dark]
    if len(np.unique(session.exposure_s[session.lit])) >= LINE:
        still = variance[..., unlit].mean(axis=-1) - rise * times.mean()
    still = np.maximum(still, LEAST_DARK) - QUANTISATION if session.rounded else np.maximum(still, 0)
    found = {
        "system_gain": gain,
        "quantum_efficiency": efficiency,
        "dark_noise": np.sqrt(still) / gain,
        "row_noise": session.rows[..., session.dark] / gain**2,
    }
    if session.saturates:
        found |= {"saturation_capacity": efficiency * photons[peak], "full_well": signal[..., -1] / gain}
    top = full if session.saturates else signal[..., -1:]
    used = (signal >= LINEAR[0] * top) & (signal <= (LINEAR[1] if session.saturates else 1) * top)
    if used.sum(axis=-1).min() >= LINE:
        found["linearity_min"], found["linearity_max"] = _linearity(photons, signal, used)
    if np.ptp(times) > 0 and variance[..., unlit].max() > HIDDEN:
        found |= {"dark_current": current / gain, "dark_current_by_variance": rise / gain**2}
    dim, bright = session.dark_stack, session.bright_stack
    contrast = bright.mean - dim.mean
    for name, off, on in zip(SPLIT, dim.parts(session.shape), bright.parts(session.shape), strict=True):
        found[f"dsnu_{name}"] = off / gain**2
        found[f"prnu_{name}"] = (on - off) / contrast**2
    return found


def _slope(x: FloatArray, y: FloatArray, used: npt.NDArray[np.bool_]) -> FloatArray:
    return np.asarray((x * y * used).sum(axis=-1) / (np.square(x) * used).sum(axis=-1))


def _linearity(photons: FloatArray, signal: FloatArray, used: npt.NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Return the least and the largest relative deviation (...) of `signal` (..., S) from a line.

    The line minimises squared relative deviations (EMVA 1288 4.0, "linearity").
    """
    weight = used / np.square(np.where(used, signal, 1.0))
    first = weight * photons
    parts = weight, weight * photons**2, weight * signal, first * signal
    total, second, value, cross = (part.sum(axis=-1) for part in parts)
    first = first.sum(axis=-1)
    slope = (total * cross - first * value) / (total * second - first**2)
    line = ((value - slope * first) / total)[..., None] + slope[..., None] * photons
    off = np.where(used, (signal - line) / np.where(used, line, 1.0), 0.0)
    return np.where(used, off, np.inf).min(axis=-1), np.where(used, off, -np.inf).max(axis=-1)
