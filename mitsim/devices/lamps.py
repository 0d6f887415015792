"""Light of lamps as a camera counts it: its quantum efficiency in; what light of every wavelength is worth, out.

A camera counts photons, whatever their wavelength: light of spectral irradiance E(lambda) makes

    e = (t A / h c) integral E(lambda) eta(lambda) lambda dlambda

electrons in a pixel of area A and efficiency eta. That is as many as an irradiance E_l of one line makes,

    E_l = integral E(lambda) eta(lambda) lambda dlambda / (eta(lambda_l) lambda_l),

in which lamps' light is added to a line's own. Behind colour filters each pixel has the eta of its own filter, and all
lines shine at once: a count is shared among them as their power is (:func:`line_units`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mitsim.core.arrays import ByValue, FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.manifests import MOST_LINES
from mitsim.devices.projector import Lines, Spectrum
from mitsim.devices.sensor import EfficiencyCurve, SensorModel

SPECTRA_NM = 360.0, 830.0
"""Wavelengths that Mitsuba's spectra are of: CIE's."""
_PLACES = 4701
"""Places of the table of a response: in steps of 0.1 nm the corners of a measured curve are rounded by 1e-4 of it."""
_PLANES = 0, 1, 2, 3
"""Of the pixels of 2 x 2 filters, row by row."""
Band = tuple[float, float]
"""First and last wavelength [nm]."""


@dataclass(frozen=True, eq=False)
class Response(ByValue):
    """What light of each wavelength counts in a camera's pixels, or in those under filters of one colour.

    Attributes
    ----------
    counts
        (k,) electrons a photon times the wavelength [nm], evenly over :data:`SPECTRA_NM`; outside ``range_nm`` as if
        the efficiency stayed what it is at the end.
    range_nm
        wavelengths that are counted [nm].
    beyond_nm
        of a curve that goes on where Mitsuba's spectra end: integral of efficiency and wavelength beyond, over its
        value at the end [nm]; else 0.
    planes
        numbers, row by row, of those of each 2 x 2 pixels that it is of; all of a camera without a mosaic.
    """

    counts: FloatArray
    range_nm: Band
    beyond_nm: float = 0.0
    planes: tuple[int, ...] = _PLANES

    def __post_init__(self) -> None:
        self._hold(counts=np.array(self.counts, dtype=np.float64))

    @classmethod
    def of(cls, sensor: SensorModel) -> Response:
        """Of a ``sensor`` without a mosaic; one number of efficiency is that at every wavelength.

        MitsimError for a sensor whose efficiency is not known, or not at any wavelength of :data:`SPECTRA_NM`.
        """
        curve = sensor.quantum_efficiency_curve
        if curve is None:
            return cls(sensor.efficiency(SPECTRA_NM[0]) * np.linspace(*SPECTRA_NM, _PLACES), SPECTRA_NM)
        return cls._along(curve, sensor)

    @classmethod
    def of_each(cls, sensor: SensorModel) -> tuple[Response, ...]:
        """Of a ``sensor`` with a mosaic the pixels under filters of each colour; else of all. MitsimError as
        :meth:`of`."""
        if sensor.mosaic is None:
            return (cls.of(sensor),)
        colours = {name: getattr(sensor.mosaic_curves, name) for name in dict.fromkeys(sensor.mosaic)}
        return tuple(
            cls._along(curve, sensor, tuple(plane for plane in _PLANES if sensor.mosaic[plane] == name))
            for name, curve in colours.items()
        )

    @classmethod
    def _along(cls, curve: EfficiencyCurve, sensor: SensorModel, planes: tuple[int, ...] = _PLANES) -> Response:
        """Of a ``curve`` of a ``sensor``, which some ``planes`` have."""
        wavelengths = np.linspace(*SPECTRA_NM, _PLACES)
        known, efficiency = np.array(curve.wavelengths_nm), np.array(curve.efficiency)
        first, last = max(SPECTRA_NM[0], known[0]), min(SPECTRA_NM[1], known[-1])
        if not first < last:
            raise MitsimError(
                f"sensor {sensor.name!r}: its curve of quantum efficiency is of {known[0]:g} to {known[-1]:g} nm, and "
                f"lamps' spectra are of {SPECTRA_NM[0]:g} to {SPECTRA_NM[1]:g} nm; switch lamps off with -ambient"
            )
        counts = np.interp(wavelengths, known, efficiency) * wavelengths
        farther = np.linspace(SPECTRA_NM[1], max(SPECTRA_NM[1], known[-1]), _PLACES)
        unseen = np.interp(farther, known, efficiency) * farther
        beyond = float(np.trapezoid(unseen, farther) / unseen[0]) if unseen[0] > 0 else 0.0
        return cls(counts, (float(first), float(last)), beyond, planes)

    @property
    def part(self) -> float:
        """Part of the sensor's pixels that it is of."""
        return len(self.planes) / len(_PLANES)

    def bands(self, count: int, part: int = 0, parts: int = 1) -> tuple[Band, ...]:
        """Equal bands of what is counted [nm].

        Parameters
        ----------
        count
            of them.
        part, parts
            number, from 0, of the only part of each band that is meant, and into how many it is cut.
        """
        first, last = self.range_nm
        edges = first + (last - first) * np.arange(count * parts + 1) / (count * parts)
        return tuple((float(edges[place]), float(edges[place + 1])) for place in range(part, count * parts, parts))


@dataclass(frozen=True, eq=False)
class CountedLamps(ByValue):
    """A scene's lamps, as its camera counts them.

    Attributes
    ----------
    responses
        of the camera's pixels; of those under each colour of filters, if it has a mosaic.
    bands
        wavelengths that light is told apart by [nm]: four of each response.
    spectra, shares
        of each band: wavelengths at which the mask diffracts its light, and (bands,) its part of what all pixels count.
    unknown
        part of the light, or more, that the camera would count if its efficiency went on as it ends, and that is in no
        frame; of several responses the largest.
    units
        wavelength [nm] of each line of the projector, and its irradiance [W m^-2] that a count of 1 stands for.
    """

    responses: tuple[Response, ...]
    bands: tuple[Band, ...]
    spectra: tuple[Spectrum, ...] = ()
    shares: FloatArray | None = None
    unknown: float = 0.0
    units: tuple[tuple[float, float], ...] = ()

    @property
    def range_nm(self) -> Band:
        """Wavelengths that all pixels count [nm]."""
        firsts, lasts = zip(*(response.range_nm for response in self.responses), strict=True)
        return max(firsts), min(lasts)

    def rows(self, response: int) -> slice:
        """Those of the bands that are of a ``response``, by its number."""
        return slice(response * MOST_LINES, (response + 1) * MOST_LINES)

    def units_of(self, lines: Lines) -> tuple[float, ...]:
        """Irradiance [W m^-2] of each of the projector's ``lines`` for a count of 1."""
        known = dict(self.units)
        return tuple(known[wavelength] for wavelength in lines.wavelengths_nm)

    @property
    def whole(self) -> Spectrum:
        """All bands in one."""
        shares = np.ones(len(self.spectra)) / len(self.spectra) if self.shares is None else self.shares
        wavelengths = [spectrum.wavelengths_nm for spectrum in self.spectra]
        weights = [share * spectrum.weights for share, spectrum in zip(shares, self.spectra, strict=True)]
        return Spectrum(np.concatenate(wavelengths), np.concatenate(weights))


def line_units(sensor: SensorModel, lines: Lines) -> tuple[float, ...]:
    """Irradiance [W m^-2] of each of the ``lines`` at which the ``sensor`` counts 1.

    Behind a mosaic the lines have parts of the count, as of their power, that make as many in the mean over all pixels:
    s_l / sum_k s_k w_k lambda_k, with w_k the electrons a photon of line k. A line's own light is then as much beside
    its part of the lamps' as all light of the projector is beside all of theirs. MitsimError for a line that the sensor
    does not see; behind a mosaic, where it sees none.
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
            raise MitsimError(
                f"sensor {sensor.name!r}: is blind at {wavelength:g} nm, a line of the projector; use another camera"
            )
        units.append(1 / (efficiency * wavelength))
    return tuple(units)
