"""Frames and factors of a projector's lines in; an image of every line behind filters, and colours of images, out.

*Mosaics.* Every shot shows all lines at once, and each pixel of a 2 x 2 cell sees them through its own filter: with
plane p the pixels (a::2, b::2) and w_pl how much of line l they see,

    Y_ij[a::2, b::2] = sum_l w_pl  Phi_Ll[a::2] (P_ij o X_l) Phi_Rl[b::2]^T,

exactly, with factors sub-sampled and nothing interpolated. :class:`JointMosaic` takes all planes for all lines
together,

    min_X  sum_ij,p ||Y_ij,p - model||^2 + lambda sum_l ||X_l||^2,

by conjugate gradients on the normal equations, which for products of patterns are sums of separable terms:

    (N X)_l = sum_p,l' w_pl w_pl' [(P_L P_L^T) o (Phi_Ll[a::2]^T Phi_Ll'[a::2])] X_l' [the same of columns]^T.

Preconditioner: the same with one pair of factors for all lines, which its eigenvectors make diagonal. Where the lines'
factors are equal and rows of either parity alike, it is exact, and the first step is the solution.

*Colours.* Reflectances at lines come in, CIE XYZ and sRGB of the same surface in daylight (D65) go out. An image of a
line is relative to the calibration's board, so white is balanced: a white board has reflectance 1 at every line. A
colour-correction matrix M (3, L) takes the reflectances r of L lines to the tristimulus values that the whole spectrum
has under D65, XYZ = M r. Three numbers do not tell a spectrum: M is the least-squares fit over a chart whose patches'
spectra are known, with the white board held at the white of D65 (white-point preserving least squares, Finlayson and
Drew, Color Imaging Conference 1997). Colour-matching functions (CIE 1931, 2 degrees), illuminants and charts are those
of colour-science.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import single_threaded_blas
from mitsim.reconstruct.solution import Solution

# ---- Images of all lines behind a mosaic of filters ------------------------------------------------------------------


PLANES = ((0, 0), (0, 1), (1, 0), (1, 1))
"""First row and column of each plane of 2 x 2 filters, row by row."""
_TOLERANCE = 1e-7
"""Residual of the normal equations, relative to their right side, at which an image's last visible digit is still."""
_MOST_STEPS = 1000
"""Of conjugate gradients; some hundred are taken at the best lambda."""


@dataclass(frozen=True, eq=False)
class JointMosaic:
    """The model of a camera with a mosaic, for one family of patterns.

    Attributes
    ----------
    lefts, rights
        (lines, m, n) and (lines, m', n') factors of each line; m and m' even.
    weights
        (4, lines) of each plane of :data:`PLANES` for each line: what its pixels see of the light that the factors are
        of.
    P_L, P_R
        (n, K) and (n', K') pattern columns.
    """

    lefts: FloatArray
    rights: FloatArray
    weights: FloatArray
    P_L: FloatArray
    P_R: FloatArray

    def __post_init__(self) -> None:
        lines = len(self.lefts)
        for name, sides, patterns in (("left", self.lefts, self.P_L), ("right", self.rights, self.P_R)):
            if sides.ndim != 3 or len(sides) != lines or sides.shape[1] % 2 or sides.shape[2] != len(patterns):
                raise MitsimError(
                    f"mosaic: {name} factors are {sides.shape} for patterns of {len(patterns)} scene pixels; give "
                    f"{lines} factors of an even number of sensor pixels, a column for each scene pixel"
                )
        if self.weights.shape != (len(PLANES), lines):
            raise MitsimError(
                f"mosaic: weights are {self.weights.shape}; give one for each of 4 planes and {lines} lines"
            )

    @property
    def shape(self) -> tuple[int, int, int]:
        """(lines, n, n') of the images."""
        return len(self.lefts), self.lefts.shape[2], self.rights.shape[2]

    def frame(self, images: FloatArray, row: int, column: int) -> FloatArray:
        """The frame (m, m') of one pattern.

        Parameters
        ----------
        images
            (lines, n, n').
        row, column
            of the pattern.
        """
        rows, columns = np.flatnonzero(self.P_L[:, row]), np.flatnonzero(self.P_R[:, column])
        lit = images[:, rows[:, None], columns] * self.P_L[rows, row][:, None] * self.P_R[columns, column]
        seen = self.lefts[:, :, rows] @ lit @ self.rights[:, :, columns].transpose(0, 2, 1)
        return np.asarray((self._filters(seen.shape[1:]) * seen).sum(axis=0))

    def gather(self, frame: FloatArray, row: int, column: int) -> FloatArray:
        """Adjoint of :meth:`frame`: (lines, n, n') of a ``frame`` (m, m').

        Parameters
        ----------
        frame
            measured under one pattern.
        row, column
            of the pattern.
        """
        rows, columns = np.flatnonzero(self.P_L[:, row]), np.flatnonzero(self.P_R[:, column])
        seen = self._filters(frame.shape) * frame
        lit = self.lefts[:, :, rows].transpose(0, 2, 1) @ seen @ self.rights[:, :, columns]
        images = np.zeros(self.shape)
        images[:, rows[:, None], columns] = lit * self.P_L[rows, row][:, None] * self.P_R[columns, column]
        return images

    def normal(self, images: FloatArray) -> FloatArray:
        """(lines, n, n') of A^T A ``images``, for all patterns together."""
        left, right = self._grams
        found = np.zeros(self.shape)
        for other in range(self.shape[0]):
            seen = left[:, :, other] @ images[other]  # (parity, line, n, n')
            for plane, (a, b) in enumerate(PLANES):
                both = self.weights[plane] * self.weights[plane, other]
                found += both[:, None, None] * (seen[a] @ right[b, :, other].transpose(0, 2, 1))
        return found

    @property
    def scale(self) -> float:
        """Largest eigenvalue of the preconditioner, what lambda is relative to."""
        (rows, _), (columns, _), (lines, _) = self._spectra
        return float(rows.max() * columns.max() * lines.max())

    @single_threaded_blas()
    def solve(self, gathered: FloatArray, lam: float) -> Solution:
        """Images (lines, n, n') of least squares.

        Parameters
        ----------
        gathered
            (lines, n, n') sum of :meth:`gathered` over all frames.
        lam
            lambda above 0, in the unit of (Phi_L Phi_R)^2.

        Raises
        ------
        MitsimError
            for lambda that is not above 0.
        """
        if not 0 < lam < np.inf:
            raise MitsimError(f"lambda is {lam}; give a finite number above 0")
        # With SciPy's linear algebra, which a capture behind filters does without: 14 MB of addresses.
        from mitsim.reconstruct.convolution import conjugate_gradients

        return conjugate_gradients(
            self.normal, gathered, lam, lambda images: self._precondition(images, lam), _TOLERANCE, _MOST_STEPS
        )

    def _precondition(self, images: FloatArray, lam: float) -> FloatArray:
        (rows, left), (columns, right), (lines, mixed) = self._spectra
        turned = np.tensordot(mixed.T, left.T @ images @ right, axes=1)
        turned /= lines[:, None, None] * np.outer(rows, columns) + lam
        return np.asarray(np.tensordot(mixed, left @ turned @ right.T, axes=1))

    @cached_property
    def _grams(self) -> tuple[FloatArray, FloatArray]:
        """(2, lines, lines, n, n) for rows and for columns: by parity, what pairs of lines share under all patterns."""
        return _grams(self.lefts, self.P_L), _grams(self.rights, self.P_R)

    @cached_property
    def _spectra(self) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """Eigenvalues and vectors of the preconditioner's three parts: rows, columns and lines."""
        rows, columns = (np.einsum("plljk->jk", grams) / (2 * self.shape[0]) for grams in self._grams)
        spectra = [np.linalg.eigh(part) for part in (rows, columns, self.weights.T @ self.weights)]
        return tuple((np.maximum(values, 0), vectors) for values, vectors in spectra)

    def _filters(self, shape: Sequence[int]) -> FloatArray:
        """(lines, m, m') what each pixel sees of each line."""
        return behind(self.weights, shape)


def behind(weights: FloatArray, shape: Sequence[int]) -> FloatArray:
    """(lines, m, m') what each pixel of a sensor counts of each line.

    Parameters
    ----------
    weights
        (4, lines) of each plane of :data:`PLANES`.
    shape
        (m, m'), both even.
    """
    return np.tile(weights.T.reshape(-1, 2, 2), (1, shape[0] // 2, shape[1] // 2))


def _grams(sides: FloatArray, patterns: npt.NDArray[np.floating]) -> FloatArray:
    shared = patterns @ patterns.T
    halves = (sides[:, parity::2] for parity in (0, 1))
    return np.stack([shared * (half.transpose(0, 2, 1)[:, None] @ half[None]) for half in halves])


# ---- Colours of images of lines --------------------------------------------------------------------------------------


CHART = "ColorChecker N Ohta"
"""Chart of the training set: N. Ohta's measured spectra of the ColorChecker's 24 patches, 380 to 780 nm in steps of
5 nm, as scenes/colour_checker has them; in colour-science, SDS_COLOURCHECKERS."""
_OBSERVER, _WHITE = "CIE 1931 2 Degree Standard Observer", "D65"


@dataclass(frozen=True, eq=False)
class Chart:
    """Patches of known spectra.

    Attributes
    ----------
    names
        of the patches.
    wavelengths_nm
        (w,) where the spectra are given [nm].
    spectra
        (patches, w) reflectances.
    xyz
        (patches, 3) CIE XYZ under D65; a perfect reflector has Y = 1.
    """

    names: tuple[str, ...]
    wavelengths_nm: FloatArray
    spectra: FloatArray
    xyz: FloatArray

    def at(self, wavelengths_nm: Sequence[float]) -> FloatArray:
        """(patches, lines) reflectances at ``wavelengths_nm``, straight between the measured ones, as Mitsuba has them.

        MitsimError for a wavelength outside the measured ones.
        """
        first, last = self.wavelengths_nm[0], self.wavelengths_nm[-1]
        outside = next((wave for wave in wavelengths_nm if not first <= wave <= last), None)
        if outside is not None:
            raise MitsimError(
                f"colour: a line has {outside:g} nm, and the chart's spectra are of {first:g} to {last:g} nm; "
                "colour needs lines that the eye sees"
            )
        return np.array([np.interp(wavelengths_nm, self.wavelengths_nm, spectrum) for spectrum in self.spectra])


@cache
def chart() -> Chart:
    """The chart of the training set, :data:`CHART`."""
    colour = _colour()
    spectra = colour.SDS_COLOURCHECKERS[CHART]
    names = tuple(name.split(" (")[0] for name in spectra)
    values = list(spectra.values())
    white = white_xyz()
    xyz = np.array([_tristimulus(spectrum) for spectrum in values])
    # The sum over wavelengths gives a perfect reflector the white up to its fifth digit, and exactly so after this.
    xyz *= white / _tristimulus(colour.sd_ones(values[0].shape))
    return Chart(names, np.array(values[0].wavelengths), np.array([each.values for each in values]), xyz)


def _tristimulus(spectrum: Any) -> FloatArray:
    """(3,) XYZ of a reflectance ``spectrum`` under D65, Y = 1 for a perfect reflector (ASTM E308)."""
    colour = _colour()
    with colour.utilities.suppress_warnings(colour_runtime_warnings=True):  # that spectra end at 380 and 780 nm
        found = colour.sd_to_XYZ(spectrum, colour.MSDS_CMFS[_OBSERVER], colour.SDS_ILLUMINANTS[_WHITE]) / 100
    return np.asarray(found, dtype=np.float64)


@cache
def _white_xy() -> tuple[float, float]:
    x, y = _colour().CCS_ILLUMINANTS[_OBSERVER][_WHITE]
    return float(x), float(y)


def white_xyz() -> FloatArray:
    """(3,) XYZ of the white board in D65, Y = 1."""
    return np.asarray(_colour().xy_to_XYZ(_white_xy()), dtype=np.float64)


def daylight(wavelengths_nm: npt.ArrayLike) -> FloatArray:
    """Power of D65 at ``wavelengths_nm`` in steps of 5 nm, 300 to 780, relative to that at 560 nm."""
    light = _colour().SDS_ILLUMINANTS[_WHITE]
    return np.asarray(light[np.asarray(wavelengths_nm, dtype=np.float64)], dtype=np.float64) / 100


@dataclass(frozen=True, eq=False)
class ColourModel:
    """What takes reflectances at lines to colours.

    Attributes
    ----------
    wavelengths_nm
        of the lines [nm].
    matrix
        (3, lines) to XYZ under D65; of a white board, Y = 1 and D65's chromaticity.
    fitted_on
        the chart, and where its patches' reflectances came from.
    """

    wavelengths_nm: tuple[float, ...]
    matrix: FloatArray
    fitted_on: str

    @classmethod
    def of_lines(cls, wavelengths_nm: Sequence[float]) -> ColourModel:
        """The fixed model of lines at ``wavelengths_nm``: fitted on the spectra of the chart :data:`CHART` themselves.

        MitsimError for lines beyond the chart's spectra.
        """
        return cls.fit(wavelengths_nm, chart().at(wavelengths_nm), f"{CHART}, spectra at the lines")

    @classmethod
    def fit(cls, wavelengths_nm: Sequence[float], patches: npt.ArrayLike, fitted_on: str) -> ColourModel:
        """The model that brings the patches of a picture of the chart nearest to their colours, in XYZ.

        Parameters
        ----------
        wavelengths_nm
            of the lines [nm].
        patches
            (24, lines) reflectances of the chart's patches.
        fitted_on
            where these came from.

        Raises
        ------
        MitsimError
            for another number of patches or lines, or values that are not finite.
        """
        values = np.asarray(patches, dtype=np.float64)
        expected = len(chart().names), len(wavelengths_nm)
        if values.shape != expected or not np.isfinite(values).all():
            raise MitsimError(
                f"colour: patches are {values.shape} with {np.count_nonzero(~np.isfinite(values))} values that are not "
                f"finite; give {expected[0]} patches of {expected[1]} lines"
            )
        return cls(tuple(map(float, wavelengths_nm)), _white_preserving(values, chart().xyz, white_xyz()), fitted_on)

    def xyz(self, reflectances: npt.ArrayLike) -> FloatArray:
        """(..., 3) CIE XYZ under D65 of ``reflectances`` (..., lines); nothing is clipped."""
        return np.asarray(np.asarray(reflectances, dtype=np.float64) @ self.matrix.T)

    def summary(self) -> dict[str, Any]:
        """For colour.json and the command line's JSON."""
        return {"matrix": self.matrix, "matrix_fitted_on": self.fitted_on, "illuminant": _WHITE}


def linear_srgb(xyz: npt.ArrayLike) -> FloatArray:
    """(..., 3) linear sRGB (IEC 61966-2-1) of ``xyz`` (..., 3) under D65; nothing is clipped."""
    return np.asarray(np.asarray(xyz, dtype=np.float64) @ _colour().RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB.T)


def delta_e(xyz: npt.ArrayLike, reference: npt.ArrayLike) -> FloatArray:
    """(...) colour difference CIE Delta E 2000 of ``xyz`` (..., 3) to a ``reference`` (..., 3), both under D65."""
    colour = _colour()
    # CIELAB ends at black: of noise below it, the negative part is no colour.
    labs = (
        colour.XYZ_to_Lab(np.maximum(np.asarray(each, dtype=np.float64), 0), _white_xy()) for each in (xyz, reference)
    )
    return np.asarray(colour.delta_E(*labs, method="CIE 2000"), dtype=np.float64)


def _white_preserving(values: FloatArray, xyz: FloatArray, white: FloatArray) -> FloatArray:
    """(3, lines) M of least ||values M^T - xyz|| with M (1, ..., 1)^T = white.

    M = white (1, ..., 1) / L + C B^T, the columns of B (L, L - 1) orthonormal and orthogonal to (1, ..., 1); C is free.

    Parameters
    ----------
    values
        (patches, L) reflectances.
    xyz
        (patches, 3) colours.
    white
        (3,) of the board.
    """
    lines = values.shape[1]
    even = np.outer(white, np.full(lines, 1 / lines))
    basis = np.linalg.svd(np.ones((1, lines)))[2][1:].T
    free = np.linalg.lstsq(values @ basis, xyz - values @ even.T, rcond=None)[0]
    return np.asarray(even + free.T @ basis.T)


def _colour() -> Any:
    """colour-science."""
    import colour  # here: it takes a second

    return colour
