"""Vectors of one side's stripe patterns in; how well each fits the others as columns that are one mask's shadow, out.

Column j of a factor is the mask's shadow from scene line j, which moves over the sensor as the line does: column j + 1
is column j moved by ``step`` pixels. At each spatial frequency columns are thus a phase that grows with j, times what
varies slowly from line to line (light falls off, obliquity): a polynomial of j. Detail finer than the pixels shows at a
frequency of its own, and moves at the step that it has. Least squares in these few numbers predict each pattern's
vector u_i = Phi h_i from all others. That columns are alike would not show which way the shadow moves: of two patterns
that are sine and cosine of one period, exchanged frames of one turn it round.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray

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

_TURNS = 3
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
        # A frame's mean light is no part of the shadow's shape, and centred frames have none.
        spectra = np.fft.rfft(vectors * taper[:, None], axis=0)[1:]
        stride = -(-len(spectra) // _FREQUENCIES)
        angles = 2 * np.pi * np.arange(1, len(spectra) + 1)[::stride] / pixels
        self._spectra = spectra = spectra[::stride]
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
        for index in [*unknown] * _TURNS:
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
