"""Reflectances at a projector's spectral lines in; CIE XYZ and sRGB of the same surface in daylight (D65) out.

An image of a line is relative to the calibration's board, so white is balanced: a white board has reflectance 1 at
every line. A colour-correction matrix M (3, L) takes the reflectances r of L lines to the tristimulus values that the
whole spectrum has under D65, XYZ = M r. Three numbers do not tell a spectrum: M is the least-squares fit over a chart
whose patches' spectra are known, with the white board held at the white of D65 (white-point preserving least squares,
Finlayson and Drew, Color Imaging Conference 1997). Colour-matching functions (CIE 1931, 2 degrees), illuminants and
charts are those of colour-science.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError

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
        return cls.fitted(wavelengths_nm, chart().at(wavelengths_nm), f"{CHART}, spectra at the lines")

    @classmethod
    def fitted(cls, wavelengths_nm: Sequence[float], patches: npt.ArrayLike, fitted_on: str) -> ColourModel:
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

    def srgb(self, reflectances: npt.ArrayLike) -> FloatArray:
        """(..., 3) linear sRGB of ``reflectances`` (..., lines), 1 = the board; beyond 0..1 where sRGB ends."""
        return linear_srgb(self.xyz(reflectances))

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
