"""A projector's light: a TOML file, checked to a frozen model with the spectrum of its photons."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from statistics import NormalDist, mean
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from mitsim.core.arrays import ByValue, FloatArray
from mitsim.core.colour_files import MOST_LINES
from mitsim.core.configuration import Configuration
from mitsim.core.errors import MitsimError
from mitsim.devices.sensor import SensorModel

_FIELDS = 4
"""Of a chessboard, a side (IEC 61947-1, ANSI IT7.228)."""


# -------- Spectra and lines


@dataclass(frozen=True, eq=False)
class Spectrum(ByValue):
    """Wavelengths (w,) [nm] and the shares (w,) of the photons at each, which sum to 1; read-only."""

    wavelengths_nm: FloatArray
    weights: FloatArray

    def __post_init__(self) -> None:
        self._hold(wavelengths_nm=np.array(self.wavelengths_nm, float), weights=np.array(self.weights, float))

    @property
    def mean(self) -> Spectrum:
        return Spectrum(np.array([np.sum(self.wavelengths_nm * self.weights)]), np.ones(1))


@dataclass(frozen=True)
class Lines:
    """Spectral lines, all along one path; ``shares`` of the power sum to 1 unless some lines are left out."""

    wavelengths_nm: tuple[float, ...]
    shares: tuple[float, ...]

    @property
    def several(self) -> bool:
        return len(self.wavelengths_nm) > 1

    @property
    def single(self) -> tuple[Lines, ...]:
        return tuple(Lines((nm,), (share,)) for nm, share in zip(self.wavelengths_nm, self.shares, strict=True))

    @property
    def apart(self) -> tuple[Lines, ...]:
        """Return each line at its own place; the other places have its wavelength without power."""
        size, pairs = len(self.shares), zip(self.wavelengths_nm, self.shares, strict=True)
        alone = [(nm, tuple(share * (at == place) for at in range(size))) for place, (nm, share) in enumerate(pairs)]
        return tuple(Lines((nm,) * size, shares) for nm, shares in alone)

    def bands(self, count: int) -> tuple[Lines, ...]:
        """Return the ``count`` bands that leave the least power off their mean; MitsimError for too many."""
        lit: dict[float, float] = {}
        for wavelength, share in sorted(zip(self.wavelengths_nm, self.shares, strict=True)):
            if share > 0:
                lit[wavelength] = lit.get(wavelength, 0.0) + share
        size = len(lit)
        if not 1 <= count <= size:
            raise MitsimError(f"{count} bands of {size} lines of light: give 1 to {size}")
        shares, waves = np.array([*lit.values()]), np.array([*lit])
        power, first, second = (np.append(0, np.cumsum(shares * waves**k)) for k in range(3))
        start, end = np.meshgrid(np.arange(size + 1), np.arange(size + 1), indexing="ij")
        own, mean, square = (part[end] - part[start] for part in (power, first, second))
        spread = np.where(end > start, square - mean**2 / np.where(end > start, own, 1), np.inf)
        least, cuts = spread[0], []
        for _ in range(count - 1):
            through = least[:, None] + spread
            cuts.append(through.argmin(axis=0))
            least = through.min(axis=0)
        edges = [size]
        for cut in reversed(cuts):
            edges.insert(0, int(cut[edges[0]]))
        edges.insert(0, 0)
        return tuple(Lines((*lit,)[a:b], (*lit.values(),)[a:b]) for a, b in pairwise(edges))


# -------- A projector

Nanometres = Annotated[float, Field(ge=1, le=1e6)]
"""Wavelength [nm]: from soft X-rays to a millimetre."""
Share = Annotated[float, Field(ge=0, le=1e6)]
"""Power beside the other lines' power: a millionth is none."""


class Coherence(Configuration):
    beam_radius_mm: float | None = Field(default=None, ge=1e-3, le=1e3)
    """1/e^2 radius of a scanned beam's spot [mm]; none: all is lit at once.

    A micrometre, less than any grain, to a metre, which is all at once."""
    polarisation: float = Field(default=0.0, ge=0, le=1)
    """Degree of polarisation of the scattered light; 0: paper, paint; 1: metal."""
    roughness_um: float | None = Field(default=None, ge=0, le=1e6)
    """Surface's height, standard deviation [um]; none: lines speckle apart."""
    linewidth_nm: float = Field(default=0.0, ge=0, le=1e3)
    """Standard deviation of each line [nm]; needs roughness_um.

    Laser diodes have some 1."""

    @model_validator(mode="after")
    def _a_linewidth_needs_a_roughness(self) -> Coherence:
        if self.linewidth_nm and self.roughness_um is None:
            raise ValueError(f"linewidth_nm: got {self.linewidth_nm:g} without roughness_um; give both")
        return self


class ProjectorModel(Configuration):
    """A projector's light and lens, and where their numbers come from.

    Ranges hold every device known, with room. The fields from ``luminous_flux_lm`` on are not simulated: from them
    follows the power that scenes state, irradiance = flux / efficacy / area of the picture.
    """

    name: str
    """Name of the projector in reports."""
    effective_wavelength_nm: Nanometres
    """Single wavelength with the same number of photons per watt [nm]."""
    wavelengths_nm: tuple[Nanometres, ...] = Field(default=(), strict=False, max_length=256)
    """Spectral lines [nm]; none: the effective wavelength.

    A lamp's visible spectrum in steps of 2 nm has 200; each costs a shadow of its own."""
    radiant_shares: tuple[Share, ...] = Field(default=(), strict=False)
    """Power of each line, relative to their sum."""
    contrast_ratio: float = Field(default=math.inf, gt=1, allow_inf_nan=True)
    """Light of a white pixel over that of a black one.

    Without an upper end: inf is a black that is black."""
    tone_curve: float | Annotated[tuple[float, ...], Field(strict=False, max_length=65536)] = 1.0
    """Exponent of light against grey level, such as 2.2; or the light of evenly spaced levels, from 0 to 1.

    Only patterns from files have grey levels; 1 is light in proportion to them."""
    ansi_contrast: float | None = Field(default=None, gt=1)
    """Light in the white fields of a 4 x 4 chessboard over that in the black ones; none: the lens scatters nothing.

    IEC 61947-1; projectors have 100 to 1000."""
    glare_spread: float = Field(default=0.25, ge=0.1, le=2)
    """Standard deviation of the light that the lens scatters, over the side of the picture.

    A tenth: half a field of the chessboard; 2: nearly even over the picture."""
    aperture_radius_mm: float = Field(default=0.0, ge=0, le=1000)
    """Radius of the lens [mm]; 0: pinhole.

    Lenses for the largest screens have some 100."""
    focus_mm: float | None = Field(default=None, ge=1, le=1e7)
    """Distance of the sharp plane [mm]; none: scene_distance.

    A millimetre, for microscopes, to 10 km."""
    speckle_contrast: float = Field(default=0.0, ge=0, le=1)
    """Speckle contrast of one sensor pixel's light; see docs/effects.md.

    1 is speckle fully developed; more needs light that is not laser light."""
    speckle: Coherence | None = None
    """Table from which the contrast is computed, in place of a number."""
    blur_pixels: float = Field(default=0.0, ge=0, le=16)
    """Standard deviation of a pixel's spot [pixels].

    16 leaves 0.7 % of the contrast of stripes of 16 pixels: a projector with fewer pixels than it says."""
    luminous_flux_lm: float | None = Field(default=None, ge=1e-3, le=1e6)
    """Light of a white picture [lm].

    The largest cinemas have 75 000."""
    luminous_efficacy_lm_per_w: float | None = Field(default=None, ge=0, le=684)
    """Luminous efficacy of the light [lm/W].

    683 at most, at 555 nm."""
    radiant_flux_w: float | None = Field(default=None, ge=1e-9, le=1e5)
    """Power of a white picture's light [W].

    The largest cinemas have some 300."""
    throw_ratio: float | None = Field(default=None, ge=0.01, le=100)
    """Distance of the picture over its width.

    0.2 beside the screen, 15 across a hall."""
    columns: int | None = Field(default=None, ge=1, le=65536)
    """Columns of the device's own raster."""
    rows: int | None = Field(default=None, ge=1, le=65536)
    """Rows of the device's own raster."""
    pixel_aspect: float = Field(default=1.0, ge=0.1, le=10)
    """Width of a pixel of this raster on the scene, divided by its height; 1: square.

    0.1 to 10: a picture of 16:9 in a raster ten times too wide or too high."""
    laser_class: Literal["1", "1C", "1M", "2", "2M", "3R", "3B", "4"] | None = None
    """Class printed on the device (IEC 60825-1)."""
    assumed: tuple[str, ...] = Field(default=(), strict=False)
    """Fields without a public measurement."""
    derived: tuple[str, ...] = Field(default=(), strict=False)
    """Fields computed from others."""
    source: str = ""
    """Source of the numbers."""

    @model_validator(mode="after")
    def _fields_fit_together(self) -> ProjectorModel:
        if len(self.wavelengths_nm) != len(self.radiant_shares):
            problem = f"{len(self.wavelengths_nm)} wavelengths_nm and {len(self.radiant_shares)} radiant_shares"
            raise ValueError(f"{problem}; give one share a line")
        if self.radiant_shares and not sum(self.radiant_shares) > 0:
            raise ValueError("radiant_shares are all 0; at least one line must have power")
        if self.speckle is not None and "speckle_contrast" in self.model_fields_set:
            raise ValueError(f"got speckle_contrast {self.speckle_contrast:g} and the table speckle; give one of them")
        curve = self.tone_curve
        if isinstance(curve, tuple):
            fits = (*curve[:1], *curve[-1:]) == (0, 1) and all(before <= after for before, after in pairwise(curve))
        else:
            fits = 0.1 <= curve <= 10
        if not fits:
            raise ValueError("tone_curve: give an exponent from 0.1 to 10, or two or more lights that rise from 0 to 1")
        if self.ansi_contrast is not None and not self.ansi_contrast < self.contrast_ratio:
            problem = f"ansi_contrast: got {self.ansi_contrast:g}"
            raise ValueError(f"{problem}, and black pixels leave {self.contrast_ratio:g} (contrast_ratio); give less")
        if not self.glare < 1:
            problem = f"ansi_contrast: got {self.ansi_contrast:g}, which a lens that scatters all light exceeds at"
            raise ValueError(f"{problem} glare_spread {self.glare_spread:g}; give more")
        unknown = [name for name in (*self.assumed, *self.derived) if name not in type(self).model_fields]
        if unknown:
            raise ValueError(f"assumed and derived list fields of this file, and {unknown[0]!r} is none")
        return self

    @property
    def black_level(self) -> float:
        return 1 / self.contrast_ratio

    @property
    def grey_light(self) -> tuple[float, ...]:
        """Return the light of each of 256 grey levels, between black (0) and white (1)."""
        levels, curve = np.arange(256) / 255, self.tone_curve
        light = levels**curve if isinstance(curve, float) else np.interp(levels, np.linspace(0, 1, len(curve)), curve)
        return tuple(np.round(light, 12).tolist())  # powers differ in their last digits between processors

    @property
    def glare(self) -> float:
        """Return the part of a pixel's light that the lens scatters, from the ``ansi_contrast``.

        ``even`` is left of an even picture at the middles of four fields, and ``fields`` of one that alternates
        between +1 and -1.
        """
        if self.ansi_contrast is None:
            return 0.0
        shares: list[list[float]] = []
        for field in range(_FIELDS):
            place = NormalDist((field + 0.5) / _FIELDS, self.glare_spread)
            shares.append([b - a for a, b in pairwise(place.cdf(edge / _FIELDS) for edge in range(_FIELDS + 1))])
        even = mean(map(sum, shares))
        fields = mean(sum(p * (-1) ** (k - own) for k, p in enumerate(parts)) for own, parts in enumerate(shares))
        contrast, black = self.ansi_contrast, self.black_level
        white, dark = ((1 + black) / 2 * even**2 + sign * (1 - black) / 2 * fields**2 for sign in (1, -1))
        direct = 1 - contrast * black
        return float(direct / (direct + contrast * dark - white))

    @property
    def lines(self) -> Lines:
        shares = self.radiant_shares or (1.0,)
        total = sum(shares)
        return Lines(self.wavelengths_nm or (self.effective_wavelength_nm,), tuple(share / total for share in shares))

    def at(self, wavelength_nm: float) -> ProjectorModel:
        alone = {"wavelengths_nm": (wavelength_nm,), "radiant_shares": (1.0,), "effective_wavelength_nm": wavelength_nm}
        return self.model_copy(update=alone)

    @property
    def traced_lines(self) -> Lines:
        lines = self.lines
        if len(lines.shares) > MOST_LINES:
            problem = f"colour: projector {self.name} has {len(lines.shares)} lines, and a path carries {MOST_LINES}"
            raise MitsimError(f"{problem}; give bands, bands:{MOST_LINES} at most, or leave colour out")
        return lines

    def in_bands(self, count: int) -> ProjectorModel:
        found = []
        for band in self.lines.bands(count):
            # The mean carries as many photons per watt as the band, to a picometre.
            mean = round(float(np.average(band.wavelengths_nm, weights=band.shares)), 3)
            found.append((mean if band.several else band.wavelengths_nm[0], sum(band.shares)))
        waves, shares = zip(*found, strict=True)
        return self.model_copy(update={"wavelengths_nm": waves, "radiant_shares": shares})

    @property
    def spectrum(self) -> Spectrum:
        wavelengths = np.array(self.lines.wavelengths_nm)
        photons = np.array(self.radiant_shares or (1.0,)) * wavelengths
        return Spectrum(wavelengths, photons / photons.sum())


# -------- Light of lamps as a camera counts it
#
# A camera's quantum efficiency gives the weight of light of every wavelength.
#
# A camera counts photons, whatever their wavelength: light of spectral irradiance E(lambda) makes
#
#     e = (t A / h c) integral E(lambda) eta(lambda) lambda dlambda
#
# electrons in a pixel of area A and efficiency eta. That is as many as an irradiance E_l of one line makes,
#
#     E_l = integral E(lambda) eta(lambda) lambda dlambda / (eta(lambda_l) lambda_l),
#
# in which lamps' light is added to a line's own. Behind colour filters each pixel has the eta of its own filter, and
# all lines shine at once: a count is shared among them as their power is (:func:`line_units`).

SPECTRA_NM = 360.0, 830.0
"""Wavelengths that Mitsuba's spectra are of: CIE's."""
_PLACES = 4701
_PLANES = 0, 1, 2, 3
Band = tuple[float, float]
"""First and last wavelength [nm]."""


@dataclass(frozen=True, eq=False)
class Response(ByValue):
    """Response of a camera's pixels, or of those under filters of one colour, to light of each wavelength.

    ``counts`` (k,) are electrons a photon times the wavelength [nm], evenly over :data:`SPECTRA_NM`; outside
    ``range_nm`` with the efficiency of the end. ``beyond_nm`` is the integral of efficiency and wavelength beyond
    Mitsuba's spectra, over its value at the end. ``planes`` are the numbers of its pixels in each 2 x 2.
    """

    counts: FloatArray
    range_nm: Band
    beyond_nm: float = 0.0
    planes: tuple[int, ...] = _PLANES

    def __post_init__(self) -> None:
        self._hold(counts=np.array(self.counts, dtype=np.float64))

    @classmethod
    def of_each(cls, sensor: SensorModel) -> tuple[Response, ...]:
        """Return the response of a ``sensor`` under each of its filters; one number of efficiency counts everywhere.

        Raises MitsimError for a sensor without a known efficiency in :data:`SPECTRA_NM`.
        """
        wavelengths, found = np.linspace(*SPECTRA_NM, _PLACES), list[Response]()
        if sensor.mosaic is None and sensor.quantum_efficiency_curve is None:
            return (cls(sensor.efficiency(SPECTRA_NM[0]) * wavelengths, SPECTRA_NM),)
        filters = sensor.mosaic or " " * len(_PLANES)
        for name in dict.fromkeys(filters):
            curve: Any = getattr(sensor.mosaic_curves, name, sensor.quantum_efficiency_curve)
            known, efficiency = np.array(curve.wavelengths_nm), np.array(curve.efficiency)
            first, last = max(SPECTRA_NM[0], known[0]), min(SPECTRA_NM[1], known[-1])
            if not first < last:
                curve_nm, lamps_nm = f"{known[0]:g} to {known[-1]:g} nm", f"{SPECTRA_NM[0]:g} to {SPECTRA_NM[1]:g} nm"
                problem = f"sensor {sensor.name!r}: its curve of quantum efficiency is of {curve_nm}"
                raise MitsimError(f"{problem}, and lamps' spectra are of {lamps_nm}; switch lamps off with -ambient")
            counts = np.interp(wavelengths, known, efficiency) * wavelengths
            farther = np.linspace(SPECTRA_NM[1], max(SPECTRA_NM[1], known[-1]), _PLACES)
            unseen = np.interp(farther, known, efficiency) * farther
            beyond = float(np.trapezoid(unseen, farther) / unseen[0]) if unseen[0] > 0 else 0.0
            planes = tuple(plane for plane in _PLANES if filters[plane] == name)
            found.append(cls(counts, (float(first), float(last)), beyond, planes))
        return tuple(found)

    @property
    def part(self) -> float:
        return len(self.planes) / len(_PLANES)

    def bands(self, count: int, part: int = 0, parts: int = 1) -> tuple[Band, ...]:
        first, last = self.range_nm
        edges = first + (last - first) * np.arange(count * parts + 1) / (count * parts)
        return tuple((float(edges[place]), float(edges[place + 1])) for place in range(part, count * parts, parts))


@dataclass(frozen=True, eq=False)
class CountedLamps(ByValue):
    """A scene's lamps as its camera counts them, in four ``bands`` [nm] of each response.

    ``spectra`` are the wavelengths of diffraction, and ``shares`` the part of the counts, per band. ``unknown`` is the
    largest part of the light that would count if the efficiency did not end. ``units`` are wavelength [nm] and
    irradiance [W m^-2] for a count of 1, per line of the projector.
    """

    responses: tuple[Response, ...]
    bands: tuple[Band, ...]
    spectra: tuple[Spectrum, ...] = ()
    shares: FloatArray | None = None
    unknown: float = 0.0
    units: tuple[tuple[float, float], ...] = ()

    @property
    def range_nm(self) -> Band:
        firsts, lasts = zip(*(response.range_nm for response in self.responses), strict=True)
        return max(firsts), min(lasts)

    def rows(self, response: int) -> slice:
        return slice(response * MOST_LINES, (response + 1) * MOST_LINES)

    def units_of(self, lines: Lines) -> tuple[float, ...]:
        known = dict(self.units)
        return tuple(known[wavelength] for wavelength in lines.wavelengths_nm)

    @property
    def whole(self) -> Spectrum:
        shares = np.ones(len(self.spectra)) / len(self.spectra) if self.shares is None else self.shares
        wavelengths = [spectrum.wavelengths_nm for spectrum in self.spectra]
        weights = [share * spectrum.weights for share, spectrum in zip(shares, self.spectra, strict=True)]
        return Spectrum(np.concatenate(wavelengths), np.concatenate(weights))


def line_units(sensor: SensorModel, lines: Lines) -> tuple[float, ...]:
    """Return the irradiance [W m^-2] of each of the ``lines`` at which the ``sensor`` counts 1.

    Behind a mosaic the lines share the count as they share power, s_l / sum_k s_k w_k lambda_k, with w_k the electrons
    a photon of line k. MitsimError where the sensor does not see the lines.
    """
    if sensor.mosaic is not None:
        mean = np.mean(sensor.planes(lines.wavelengths_nm), axis=0)
        counted = float(np.dot(lines.shares, mean * lines.wavelengths_nm))
        if counted == 0:
            raise MitsimError(f"sensor {sensor.name!r}: is blind to all lines of the projector; use another camera")
        return tuple(share / counted for share in lines.shares)
    units = []
    for wavelength in lines.wavelengths_nm:
        efficiency = sensor.efficiency(wavelength)
        if efficiency == 0:
            raise MitsimError(f"sensor {sensor.name!r}: is blind at {wavelength:g} nm, a line of the projector")
        units.append(1 / (efficiency * wavelength))
    return tuple(units)
