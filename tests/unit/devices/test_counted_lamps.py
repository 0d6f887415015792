"""Lamps' light by wavelength, as cameras and filters of known efficiency count it: closed forms of the tables alone."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.devices.projector import SPECTRA_NM, CountedLamps, Lines, Response, Spectrum, line_units
from tests.invented import sensor

FILTERS = {"G": (400.0, 700.0), "B": (390.0, 650.0), "R": (300.0, 900.0)}
"""Ends [nm] of the curves of a camera's filters, GBRG."""


def test_lines_behind_filters_share_a_count_as_their_power() -> None:
    """Together they make as many electrons of a pixel in the mean. (Planted: each line all of it.)"""
    ends = {"R": 0.0, "G": 0.2, "B": 0.4}
    curves = {name: {"wavelengths_nm": [390.0, 610.0], "efficiency": [0.4, last]} for name, last in ends.items()}
    change = {"quantum_efficiency": None, "mosaic": "RGGB", "mosaic_curves": curves, "binning": 1}
    behind, lines = sensor(**change), Lines((600.0, 400.0), (0.75, 0.25))
    units, mean = line_units(behind, lines), np.mean(behind.planes(lines.wavelengths_nm), axis=0)
    assert units[0] / units[1] == pytest.approx(3)
    assert sum(mean * units * np.array(lines.wavelengths_nm)) == pytest.approx(1)
    blind = {name: {"wavelengths_nm": [390.0, 395.0, 610.0], "efficiency": [0.4, 0, 0]} for name in "RGB"}
    with pytest.raises(MitsimError, match="is blind to all lines of the projector"):
        line_units(sensor(**{**change, "mosaic_curves": blind}), Lines((600.0, 500.0), (0.75, 0.25)))


def test_a_curve_that_goes_on_beyond_spectra_says_how_far() -> None:
    """Efficiency 0.5 at 830 nm, falling to 0 at 1030 nm: integral of eta lambda over eta lambda there."""
    curve = {"wavelengths_nm": [400.0, 830.0, 1030.0], "efficiency": [0.5, 0.5, 0.0]}
    response = Response.of_each(sensor(quantum_efficiency=None, quantum_efficiency_curve=curve))[0]
    at = np.linspace(830, 1030, 20001)
    exact = np.trapezoid(0.5 * (1030 - at) / 200 * at, at) / (0.5 * 830)
    assert response.range_nm == (400.0, 830.0) and response.beyond_nm == pytest.approx(exact, rel=1e-6)
    blind = {"wavelengths_nm": [400.0, 830.0, 1030.0], "efficiency": [0.5, 0.0, 0.5]}  # nothing to be relative to
    assert Response.of_each(sensor(quantum_efficiency=None, quantum_efficiency_curve=blind))[0].beyond_nm == 0


def test_a_camera_that_sees_no_spectrum_is_refused() -> None:
    curve = {"wavelengths_nm": [900.0, 1700.0], "efficiency": [0.5, 0.5]}
    blind = sensor(quantum_efficiency=None, quantum_efficiency_curve=curve)
    with pytest.raises(MitsimError, match="of 900 to 1700 nm, and lamps' spectra are of 360 to 830 nm; switch"):
        Response.of_each(blind)
    half = {"wavelengths_nm": [400.0, 500.0, 700.0], "efficiency": [0.5, 0.0, 0.0]}
    with pytest.raises(MitsimError, match="is blind at 600 nm, a line of the projector"):
        line_units(sensor(quantum_efficiency=None, quantum_efficiency_curve=half), Lines((600.0,), (1.0,)))


def test_each_colour_of_filters_counts_in_its_own_pixels() -> None:
    """Electrons a photon times the wavelength, at the curve's ends on either side of it, in the pixels of that colour.
    (Planted: ends beyond Mitsuba's spectra; all planes for each.)"""
    curves = {
        name: {"wavelengths_nm": [first, 500.0, last], "efficiency": [0.1, 0.6, 0.2]}
        for name, (first, last) in FILTERS.items()
    }
    camera = sensor(quantum_efficiency=None, mosaic="GBRG", mosaic_curves=curves, binning=1)
    found = Response.of_each(camera)
    assert [each.planes for each in found] == [(0, 3), (1,), (2,)]
    assert [each.part for each in found] == [0.5, 0.25, 0.25]
    assert [each.range_nm for each in found] == [(400, 700), (390, 650), SPECTRA_NM]
    for each, (first, last) in zip(found, FILTERS.values(), strict=True):
        at = np.linspace(*SPECTRA_NM, len(each.counts))
        assert each.counts == pytest.approx(at * np.interp(at, [first, 500, last], [0.1, 0.6, 0.2]), rel=1e-12)
    assert [each.beyond_nm for each in found[:2]] == [0, 0] and found[2].beyond_nm > 50
    (bare,) = Response.of_each(sensor(quantum_efficiency=0.5))
    assert bare.planes == (0, 1, 2, 3) and bare.part == 1


def test_lamps_have_four_rows_of_each_response() -> None:
    """(Planted: rows of the one before; ranges of any response in the place of all.)"""
    responses = tuple(Response(np.ones(2), ends) for ends in ((400.0, 700.0), (420.0, 650.0), (390.0, 600.0)))
    units = ((638.0, 1.0), (520.0, 2.0), (445.0, 3.0))
    spectra = tuple(Spectrum(np.array([at, at + 10]), np.array([0.25, 0.75])) for at in (500.0, 600.0))
    found = CountedLamps(responses, (), spectra, np.array([0.4, 0.6]), units=units)
    assert found.range_nm == (420, 600) and [found.rows(number) for number in range(2)] == [slice(0, 4), slice(4, 8)]
    assert found.units_of(Lines((445.0, 638.0), (0.5, 0.5))) == (3.0, 1.0)
    assert list(found.whole.wavelengths_nm) == [500, 510, 600, 610]
    assert found.whole.weights == pytest.approx([0.1, 0.3, 0.15, 0.45])
    assert CountedLamps(responses, (), spectra).whole.weights == pytest.approx([0.125, 0.375, 0.125, 0.375])
