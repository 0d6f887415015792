"""Separate the spectral lines in frames behind colour filters, and compute colours of images.

*Mosaics.* Every shot shows all lines at once, and each pixel of a 2 x 2 cell sees them through its own filter. Plane p
has the pixels (a::2, b::2), whose response to line l is w_pl. Therefore

    Y_ij[a::2, b::2] = sum_l w_pl  Phi_Ll[a::2] (P_ij o X_l) Phi_Rl[b::2]^T,

which is exact, because factors are sub-sampled and nothing is interpolated. :class:`JointMosaic` minimises

    sum_ij,p ||Y_ij,p - model||^2 + lambda sum_l ||X_l||^2

by conjugate gradients on the normal equations, which for products of patterns are sums of separable terms:

    (N X)_l = sum_p,l' w_pl w_pl' [(P_L P_L^T) o (Phi_Ll[a::2]^T Phi_Ll'[a::2])] X_l' [the same of columns]^T.

The preconditioner has one pair of factors for all lines, so that its eigenvectors make it diagonal. It is exact where
the lines' factors are equal and rows of both parities are alike.

*Colours.* An image of a line is relative to the calibration's board, so that a white board has reflectance 1 at every
line. A matrix M (3, L) converts the reflectances r of L lines to the tristimulus values under daylight (D65), XYZ = M
r. Because a few numbers do not determine a spectrum, M is a least-squares fit over a chart of known spectra, with the
white board held at the white of D65 (white-point preserving least squares, Finlayson and Drew, Color Imaging
Conference 1997). Colour-matching functions (CIE 1931, 2 degrees), illuminants and charts are those of colour-science.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import single_threaded_blas

if TYPE_CHECKING:
    from mitsim.reconstruct.solver import Solution

# ---- Images of all lines behind a mosaic of filters ------------------------------------------------------------------


PLANES = ((0, 0), (0, 1), (1, 0), (1, 1))


@dataclass(frozen=True, eq=False)
class JointMosaic:
    """Model of a camera with a mosaic of filters, for one family of patterns.

    ``lefts`` (lines, m, n) and ``rights`` (lines, m', n') are the factors of each line, with even m and m';
    ``weights`` (4, lines) are the responses of each plane to each line.
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
            words = f"weights are {self.weights.shape}; give one for each of 4 planes and {lines} lines"
            raise MitsimError(f"mosaic: {words}")

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self.lefts), self.lefts.shape[2], self.rights.shape[2]

    def frame(self, images: FloatArray, row: int, column: int) -> FloatArray:
        rows, columns = np.flatnonzero(self.P_L[:, row]), np.flatnonzero(self.P_R[:, column])
        lit = images[:, rows[:, None], columns] * self.P_L[rows, row][:, None] * self.P_R[columns, column]
        seen = self.lefts[:, :, rows] @ lit @ self.rights[:, :, columns].transpose(0, 2, 1)
        return np.asarray((behind(self.weights, seen.shape[1:]) * seen).sum(axis=0))

    def gather(self, frame: FloatArray, row: int, column: int) -> FloatArray:
        rows, columns = np.flatnonzero(self.P_L[:, row]), np.flatnonzero(self.P_R[:, column])
        seen = behind(self.weights, frame.shape) * frame
        lit = self.lefts[:, :, rows].transpose(0, 2, 1) @ seen @ self.rights[:, :, columns]
        images = np.zeros(self.shape)
        images[:, rows[:, None], columns] = lit * self.P_L[rows, row][:, None] * self.P_R[columns, column]
        return images

    def normal(self, images: FloatArray) -> FloatArray:
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
        (rows, _), (columns, _), (lines, _) = self._spectra
        return float(rows.max() * columns.max() * lines.max())

    @single_threaded_blas()
    def solve(self, gathered: FloatArray, lam: float) -> Solution:
        """Solve for the images (lines, n, n') by least squares; MitsimError unless lambda is above 0."""
        if not 0 < lam < np.inf:
            raise MitsimError(f"lambda is {lam}; give a finite number above 0")
        # Imported here because a capture behind filters needs no linear algebra of SciPy.
        from mitsim.reconstruct.point_spread import conjugate_gradients

        (rows, left), (columns, right), (lines, mixed) = self._spectra

        def precondition(images: FloatArray) -> FloatArray:
            turned = np.tensordot(mixed.T, left.T @ images @ right, axes=1)
            turned /= lines[:, None, None] * np.outer(rows, columns) + lam
            return np.asarray(np.tensordot(mixed, left @ turned @ right.T, axes=1))

        return conjugate_gradients(self.normal, gathered, lam, precondition, 1e-7, 1000)

    @cached_property
    def _grams(self) -> list[FloatArray]:
        found = []
        for sides, patterns in ((self.lefts, self.P_L), (self.rights, self.P_R)):
            halves, shared = (sides[:, parity::2] for parity in (0, 1)), patterns @ patterns.T
            found.append(np.stack([shared * (half.transpose(0, 2, 1)[:, None] @ half[None]) for half in halves]))
        return found

    @cached_property
    def _spectra(self) -> tuple[tuple[FloatArray, FloatArray], ...]:
        rows, columns = (np.einsum("plljk->jk", grams) / (2 * self.shape[0]) for grams in self._grams)
        spectra = [np.linalg.eigh(part) for part in (rows, columns, self.weights.T @ self.weights)]
        return tuple((np.maximum(values, 0), vectors) for values, vectors in spectra)


def behind(weights: FloatArray, shape: Sequence[int]) -> FloatArray:
    return np.tile(weights.T.reshape(-1, 2, 2), (1, shape[0] // 2, shape[1] // 2))


# ---- Colours of images of lines --------------------------------------------------------------------------------------


CHART = "ColorChecker N Ohta"
"""Name, in colour-science, of N. Ohta's measured spectra of the ColorChecker's 24 patches, as in
scenes/colour_checker."""
_OBSERVER, _WHITE = "CIE 1931 2 Degree Standard Observer", "D65"


@dataclass(frozen=True, eq=False)
class Chart:
    """Patches of known reflectance (patches, w), with CIE XYZ (patches, 3) under D65."""

    names: tuple[str, ...]
    wavelengths_nm: FloatArray
    spectra: FloatArray
    xyz: FloatArray

    def at(self, wavelengths_nm: Sequence[float]) -> FloatArray:
        """Interpolate the reflectances (patches, lines) linearly at ``wavelengths_nm``, as Mitsuba does."""
        first, last = self.wavelengths_nm[0], self.wavelengths_nm[-1]
        outside = next((wave for wave in wavelengths_nm if not first <= wave <= last), None)
        if outside is not None:
            words = f"a line has {outside:g} nm, and the chart's spectra are of {first:g} to {last:g} nm"
            raise MitsimError(f"colour: {words}; colour needs lines that the eye sees")
        return np.array([np.interp(wavelengths_nm, self.wavelengths_nm, spectrum) for spectrum in self.spectra])


@cache
def chart() -> Chart:
    colour = _colour()
    spectra = colour.SDS_COLOURCHECKERS[CHART]
    names = tuple(name.split(" (")[0] for name in spectra)
    values = list(spectra.values())
    observer, white = colour.MSDS_CMFS[_OBSERVER], colour.SDS_ILLUMINANTS[_WHITE]
    with colour.utilities.suppress_warnings(colour_runtime_warnings=True):  # that spectra end at 380 and 780 nm
        # XYZ of reflectances, Y = 1 for a perfect reflector (ASTM E308).
        of = [colour.sd_to_XYZ(each, observer, white) / 100 for each in (*values, colour.sd_ones(values[0].shape))]
    *patches, perfect = (np.asarray(each, dtype=np.float64) for each in of)
    # The sum over wavelengths gives a perfect reflector the white in five digits; this makes it exact.
    xyz = np.array(patches) * (white_xyz() / perfect)
    return Chart(names, np.array(values[0].wavelengths), np.array([each.values for each in values]), xyz)


def white_xyz() -> FloatArray:
    return np.asarray(_colour().xy_to_XYZ(_colour().CCS_ILLUMINANTS[_OBSERVER][_WHITE]), dtype=np.float64)


def daylight(wavelengths_nm: npt.ArrayLike) -> FloatArray:
    """Return the power of D65 at ``wavelengths_nm`` (multiples of 5, 300 to 780), relative to that at 560 nm."""
    light = _colour().SDS_ILLUMINANTS[_WHITE]
    return np.asarray(light[np.asarray(wavelengths_nm, dtype=np.float64)], dtype=np.float64) / 100


@dataclass(frozen=True, eq=False)
class ColourModel:
    """Conversion of reflectances at lines to XYZ under D65 by ``matrix`` (3, lines), which keeps white boards white."""

    wavelengths_nm: tuple[float, ...]
    matrix: FloatArray
    fitted_on: str

    @classmethod
    def of_lines(cls, wavelengths_nm: Sequence[float]) -> ColourModel:
        return cls.fit(wavelengths_nm, chart().at(wavelengths_nm), f"{CHART}, spectra at the lines")

    @classmethod
    def fit(cls, wavelengths_nm: Sequence[float], patches: npt.ArrayLike, fitted_on: str) -> ColourModel:
        values = np.asarray(patches, dtype=np.float64)
        expected = len(chart().names), len(wavelengths_nm)
        if values.shape != expected or not np.isfinite(values).all():
            lost = np.count_nonzero(~np.isfinite(values))
            words = f"patches are {values.shape} with {lost} values that are not finite"
            raise MitsimError(f"colour: {words}; give {expected[0]} patches of {expected[1]} lines")
        # Minimises ||values M^T - XYZ|| with M (1, ..., 1)^T = white: M = white (1, ..., 1) / L + C B^T with free C,
        # where the columns of B (L, L - 1) are orthonormal and orthogonal to (1, ..., 1).
        lines = values.shape[1]
        even = np.outer(white_xyz(), np.full(lines, 1 / lines))
        basis = np.linalg.svd(np.ones((1, lines)))[2][1:].T
        free = np.linalg.lstsq(values @ basis, chart().xyz - values @ even.T, rcond=None)[0]
        return cls(tuple(map(float, wavelengths_nm)), np.asarray(even + free.T @ basis.T), fitted_on)

    @classmethod
    def of_channels(cls, names: Sequence[str], wavelengths_nm: Sequence[float], white: FloatArray) -> ColourModel:
        """Return the conversion of lines of which ``white`` is white: r, g and b are sRGB's, others spectral lines."""
        if {name[0] for name in names} == {*"rgb"}:
            rows = np.array([[name[0] == each for name in names] for each in "rgb"], dtype=np.float64)
            screen = np.linalg.inv(_colour().RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB)
            matrix = screen @ (rows / rows.sum(axis=1, keepdims=True))
        else:
            matrix = cls.of_lines(wavelengths_nm).matrix
        return cls(tuple(map(float, wavelengths_nm)), np.asarray(matrix / white), "the light of the point as white")

    def xyz(self, reflectances: npt.ArrayLike) -> FloatArray:
        return np.asarray(np.asarray(reflectances, dtype=np.float64) @ self.matrix.T)

    def summary(self) -> dict[str, Any]:
        return {"matrix": self.matrix, "matrix_fitted_on": self.fitted_on, "illuminant": _WHITE}


def linear_srgb(xyz: npt.ArrayLike) -> FloatArray:
    """Convert ``xyz`` (..., 3) under D65 to linear sRGB (IEC 61966-2-1) without clipping."""
    return np.asarray(np.asarray(xyz, dtype=np.float64) @ _colour().RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB.T)


def delta_e(xyz: npt.ArrayLike, reference: npt.ArrayLike) -> FloatArray:
    colour = _colour()
    white = colour.CCS_ILLUMINANTS[_OBSERVER][_WHITE]
    # CIELAB ends at black, so negative noise has no colour.
    labs = (colour.XYZ_to_Lab(np.maximum(np.asarray(each, dtype=np.float64), 0), white) for each in (xyz, reference))
    return np.asarray(colour.delta_E(*labs, method="CIE 2000"), dtype=np.float64)


def _colour() -> Any:
    import colour  # imported here because it takes a second

    return colour
