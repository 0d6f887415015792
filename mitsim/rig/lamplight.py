"""Light of lamps as a camera counts it: its quantum efficiency in; what light of every wavelength is worth, out.

A camera counts photons, whatever their wavelength: light of spectral irradiance E(lambda) makes

    e = (t A / h c) integral E(lambda) eta(lambda) lambda dlambda

electrons in a pixel of area A and efficiency eta. That is as many as an irradiance E_l of one line makes,

    E_l = integral E(lambda) eta(lambda) lambda dlambda / (eta(lambda_l) lambda_l),

in which lamps' light is added to a line's own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mitsim.core.arrays import ByValue, FloatArray
from mitsim.core.errors import MitsimError
from mitsim.rig.projector import Lines, Spectrum
from mitsim.rig.sensor import SensorModel

SPECTRA_NM = 360.0, 830.0
"""Wavelengths that Mitsuba's spectra are of: CIE's."""
_PLACES = 4701
"""Places of the table of a response: in steps of 0.1 nm the corners of a measured curve are rounded by 1e-4 of it."""
Band = tuple[float, float]
"""First and last wavelength [nm]."""


@dataclass(frozen=True, eq=False)
class Response(ByValue):
    """What light of each wavelength counts in a camera.

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
    """

    counts: FloatArray
    range_nm: Band
    beyond_nm: float = 0.0

    def __post_init__(self) -> None:
        self._hold(counts=np.array(self.counts, dtype=np.float64))

    @classmethod
    def of(cls, sensor: SensorModel) -> Response:
        """Of a ``sensor`` without a mosaic; one number of efficiency is that at every wavelength.

        MitsimError for a sensor whose efficiency is not known, or not at any wavelength of :data:`SPECTRA_NM`.
        """
        wavelengths = np.linspace(*SPECTRA_NM, _PLACES)
        curve = sensor.quantum_efficiency_curve
        if curve is None:
            return cls(sensor.efficiency(wavelengths[0]) * wavelengths, SPECTRA_NM)
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
        return cls(counts, (float(first), float(last)), beyond)

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
class Lamplight(ByValue):
    """A scene's lamps, as its camera counts them.

    Attributes
    ----------
    response
        of the camera.
    bands
        wavelengths that light is told apart by [nm].
    spectra, shares
        of each band: wavelengths at which the mask diffracts its light, and (bands,) its part of all.
    unknown
        part of the light, or more, that the camera would count if its efficiency went on as it ends, and that is in no
        frame.
    """

    response: Response
    bands: tuple[Band, ...]
    spectra: tuple[Spectrum, ...] = ()
    shares: FloatArray | None = None
    unknown: float = 0.0

    @property
    def whole(self) -> Spectrum:
        """All bands in one."""
        shares = np.ones(len(self.spectra)) / len(self.spectra) if self.shares is None else self.shares
        wavelengths = [spectrum.wavelengths_nm for spectrum in self.spectra]
        weights = [share * spectrum.weights for share, spectrum in zip(shares, self.spectra, strict=True)]
        return Spectrum(np.concatenate(wavelengths), np.concatenate(weights))


def line_units(sensor: SensorModel, lines: Lines) -> tuple[float, ...]:
    """Irradiance [W m^-2] of each of the ``lines`` that makes as many electrons as a count of 1 of the ``sensor``.

    MitsimError for a line that it does not see.
    """
    units = []
    for wavelength in lines.wavelengths_nm:
        efficiency = sensor.efficiency(wavelength)
        if efficiency == 0:
            raise MitsimError(
                f"sensor {sensor.name!r}: is blind at {wavelength:g} nm, a line of the projector; use another camera"
            )
        units.append(1 / (efficiency * wavelength))
    return tuple(units)
