"""The shadow of one mask that moves over the sensor: how well the patterns' vectors of one side agree with it.

Column j of a factor is the mask's shadow from scene line j, and column j + 1 is column j moved by ``step`` pixels. At
each spatial frequency the columns are therefore a phase that grows with j, times an amplitude that varies slowly from
line to line (falloff, obliquity): a polynomial of j. Detail finer than the pixels appears at another frequency, and
moves at the step of its own. The part of the columns outside these modes is zero but for noise, so that each pattern's
vector u_i = Phi h_i can be compared with the vectors of all others. The comparison needs the motion, because the sine
and the cosine of one period are as alike if the shadow moves the other way.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray

_MOVES = (0, -1), (1, -1), (-1, -1), (2, -1)
"""Turns and sign of the frequencies that pixels show as k in [0, pi]: itself, 2 pi - k, whose phase is mirrored,
2 pi + k and 4 pi - k. Without them the finest stripes, of masks of two pixels a feature, seem to move the other way."""
_DEGREE = 3
"""Degree of the polynomial, where there are lines enough: falloff and obliquity of 120 mm at 400 mm are even and
smooth."""
_LINES = 8
"""Scene lines for each number of a polynomial, at least: three polynomials leave most lines to predict with."""
_FREQUENCIES = 64
"""Spatial frequencies that are compared, evenly chosen: more show the same, and cost time."""
_FARTHEST = 0.6
"""Part of the sensor that the shadow moves by at most, from the first scene line to the last: more leaves little that
both show."""
_ENOUGH = 16, 40
"""Patterns, and sensor rows, from which their shadows are compared."""
_PREDICTED = 0.15
"""Squared deviation of a pattern, as a part of its own square, that a tenth of the patterns must not exceed: it is 0.03
with three exchanged pairs of 32, and 0.3 where a shadow of 16 lines moves by two pixels a line and predicts nothing."""
_KNOWN = 0.1
"""Part of a column beyond the modes from which the others predict it: at the ends of few lines it is less."""
_ROUNDING = 1e-12
"""Squared deviation, as a part of the vectors' mean square, that vectors without noise have."""
_FITS = 3
"""Times that unknown patterns are fitted one after the other: they hardly depend on each other."""

ComplexArray = npt.NDArray[np.complex128]


class MovingShadow:
    """Deviation of patterns' vectors from the vectors that the other patterns predict.

    Parameters
    ----------
    vectors
        (m, N) u_i.
    signs
        (n, N) H.
    unknown
        patterns whose vectors do not count: the vectors that fit the others best replace them.

    Attributes
    ----------
    deviations
        (N,) mean squared deviation of a vector from the predicted one, in units of the median pattern's.
    unlike
        (N,) the same squared deviation as a part of the vector's own square.
    shares, sure
        (N,) part of its vector by which each pattern disagrees, and the same in standard errors: 0 if it is right, 2 if
        its sign is wrong, 1 if it has nothing in common with the predicted vector.
    by_turning
        (N,) decrease of all patterns' squared deviations if the sign of one is turned, in the same units.
    predicts
        whether patterns are predicted: few lines, whose shadows have little in common, predict nothing.
    lines
        (n,) squared deviation of each column from what the others predict, in units of the mean square of columns: 1
        for a column that is missing, 0 where the others predict nothing.
    """

    def __init__(self, vectors: FloatArray, signs: FloatArray, unknown: Sequence[int] = ()) -> None:
        n, count = signs.shape
        signs = signs / np.sqrt(count)
        spectra, self._angles = _spectra(vectors)
        columns = spectra @ signs.T
        modes = _modes(self._angles, _step(columns, self._angles, len(vectors)), n)
        turned = modes.conj().transpose(0, 2, 1)
        # Squared length of each pattern's stripes beyond the modes.
        own = np.maximum(n / count - np.square(np.abs(np.matmul(turned, signs))).sum(axis=1), 1e-9)
        left = np.zeros_like(spectra)
        for index in [0, *[*unknown] * _FITS]:
            spectra[:, index] -= left[:, index] / own[:, index]
            columns = spectra @ signs.T
            rest = columns - np.matmul(modes, np.matmul(turned, columns[..., None]))[..., 0]
            left = rest @ signs
        self._spectra, self._left, self._own = spectra, left, own
        squares = np.square(np.abs(spectra))
        deviations = (np.square(np.abs(left)) / own).sum(axis=0)
        self._unit = (float(np.median(deviations)) + _ROUNDING * float(squares.sum(axis=0).mean())) or 1.0
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
        self.lines = lines * (kept.mean(axis=0) > _KNOWN)

    def along(self, shapes: ComplexArray) -> tuple[FloatArray, FloatArray]:
        """Return (N,) the sizes of the ``shapes`` (frequencies, N) in the deviations, and their variances."""
        size = np.maximum((np.square(np.abs(shapes)) * self._own).sum(axis=0), 1e-300)
        # The deviation at each frequency is complex: half of its noise is along the shape.
        return np.real(shapes.conj() * self._left).sum(axis=0) / size, self._unit / len(self._own) / 2 / size

    def powers(self) -> tuple[FloatArray, FloatArray]:
        """Return (N,) 1 - 1 / p and its variance, where p (u_i + u_0) - u_0 is the vector of a frame of power p."""
        return self.along(self._spectra + self._spectra[:, :1])

    def moves(self) -> tuple[FloatArray, FloatArray]:
        """Return (N,) the pixels that each pattern's shadow has moved by against the others, and their variances."""
        return self.along(-1j * self._angles[:, None] * self._spectra)


def shadow_step(factor: FloatArray) -> float:
    """Return the sensor pixels that the shadow in a ``factor`` (m, n) moves by from one column to the next."""
    return _step(*_spectra(factor), len(factor))


def _spectra(columns: FloatArray) -> tuple[ComplexArray, FloatArray]:
    """Return (frequencies, n) spectra of ``columns`` (m, n), and the frequencies' angles a pixel.

    Columns fade out at the ends, where a moving shadow leaves and another comes in, and have no mean light, which does
    not move. Without both, the deviations of good cameras are up to 400 times those by noise; with both, up to 5 times.
    """
    taper = np.square(np.sin(np.pi * (np.arange(len(columns)) + 0.5) / len(columns)))
    spectra = np.fft.rfft((columns - taper @ columns / taper.sum()) * taper[:, None], axis=0)[1:]
    stride = -(-len(spectra) // _FREQUENCIES)
    return spectra[::stride], 2 * np.pi * np.arange(1, len(spectra) + 1)[::stride] / len(columns)


def _modes(angles: FloatArray, step: float, n: int) -> ComplexArray:
    """Return (frequencies, n, modes) orthonormal modes of the columns' spectra at frequencies of so many ``angles``."""
    degree = max(min(_DEGREE, n // _LINES - 1), 0)
    slow = np.polynomial.legendre.legvander(np.linspace(-1, 1, n), degree)
    moves = _MOVES[: max(1, 3 * n // _LINES // (degree + 1))]
    phases = [np.exp(1j * step * np.outer(2 * np.pi * turns + sign * angles, np.arange(n))) for turns, sign in moves]
    return np.asarray(np.linalg.qr(np.concatenate([phase[..., None] * slow for phase in phases], axis=2))[0])


def _step(columns: ComplexArray, angles: FloatArray, pixels: int) -> float:
    """Return the pixels by which ``columns`` move from one to the next, whose reversal makes their sum largest."""
    n = columns.shape[1]
    length = 8 * n
    power = np.square(np.abs(np.fft.fft(columns, length, axis=1)))
    most = int(_FARTHEST * pixels)
    steps = np.linspace(-most, most, 40 * most + 1) / n
    places = np.rint(-np.outer(steps, angles) * (length / (2 * np.pi))).astype(np.int64) % length
    return float(steps[int(np.argmax(power[np.arange(len(angles)), places].sum(axis=1)))])
