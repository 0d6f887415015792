"""Colours of reflectances at lines: white stays white, the matrix is the best there is, truth is the spectra's own."""

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.reconstruct.colour import ColourModel, chart, delta_e, linear_srgb, white_xyz

LINES = (638.0, 520.0, 445.0)


@pytest.mark.parametrize("lines", [(562.0,), LINES, (430.0, 480.0, 530.0, 590.0, 650.0)])
def test_a_white_board_is_white(lines: tuple[float, ...]) -> None:
    model = ColourModel.of_lines(lines)
    assert np.allclose(model.xyz(np.ones(len(lines))), white_xyz(), rtol=1e-12)
    # sRGB's own matrix is given to four digits.
    assert np.allclose(linear_srgb(model.xyz(np.full(len(lines), 0.5))), 0.5, atol=2e-4)


def test_the_matrix_is_the_least_squares_one_that_keeps_white() -> None:
    """Against the solution of the optimum's own conditions, with a multiplier for white (Karush, Kuhn and Tucker)."""
    patches, ones = chart().at(LINES), np.ones((1, 3))
    conditions = np.block([[patches.T @ patches, ones.T], [ones, np.zeros((1, 1))]])
    right = np.concatenate([patches.T @ chart().xyz, white_xyz()[None]])
    expected = np.linalg.solve(conditions, right)[:3].T
    assert np.allclose(ColourModel.of_lines(LINES).matrix, expected, rtol=1e-9)


def test_colours_that_a_matrix_can_tell_are_told_exactly() -> None:
    """Patches that are a picture of their own colours: the fitted matrix undoes the mixing."""
    mixing = np.array([[0.6, 0.3, 0.1], [0.2, 0.7, 0.1], [0.1, 0.1, 0.8]])
    model = ColourModel.fit(LINES, chart().xyz / white_xyz() @ mixing.T, "a picture")
    found = model.xyz(chart().xyz / white_xyz() @ mixing.T)
    assert np.allclose(found, chart().xyz, atol=1e-12) and delta_e(found, chart().xyz).max() < 1e-9


def test_the_truth_is_the_spectrum_in_daylight() -> None:
    """The sum over the measured wavelengths, from the published tables; off by their ends beyond the spectra."""
    import colour

    waves = chart().wavelengths_nm
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    light = np.array([colour.SDS_ILLUMINANTS["D65"][wave] for wave in waves])
    seen = np.array([observer[wave] for wave in waves]) * light[:, None]
    assert np.allclose(chart().spectra @ seen / seen.sum(axis=0) * white_xyz(), chart().xyz, atol=3e-4)


def test_the_difference_of_greys_is_that_of_their_lightness() -> None:
    """Delta E 2000 of colours without chroma is |L1 - L2| / S_L, S_L of their mean lightness (CIE 142)."""
    white, level = white_xyz(), np.array([0.18, 0.4])
    first, second = 116 * np.cbrt(level) - 16
    mean = (first + second) / 2
    scale = 1 + 0.015 * (mean - 50) ** 2 / np.sqrt(20 + (mean - 50) ** 2)
    assert delta_e(level[0] * white, level[1] * white) == pytest.approx(abs(first - second) / scale, rel=1e-6)
    assert np.isfinite(delta_e(-0.01 * white, level[0] * white)), "noise below black"
    assert linear_srgb(white) == pytest.approx(np.ones(3), abs=2e-4)


def test_lines_that_no_eye_sees_are_refused() -> None:
    with pytest.raises(MitsimError, match=r"a line has 1064 nm, and the chart's spectra are of 380 to 780 nm"):
        ColourModel.of_lines((520.0, 1064.0))
    with pytest.raises(MitsimError, match=r"patches are \(24, 2\) with 0 values"):
        ColourModel.fit(LINES, chart().at(LINES[:2]), "a picture")
    with pytest.raises(MitsimError, match="with 1 values that are not finite"):
        ColourModel.fit(LINES, np.where(np.arange(72).reshape(24, 3) == 5, np.nan, 0.5), "a picture")


def test_reflectances_are_the_charts_own_and_straight_between() -> None:
    """(Planted: twice as much.)"""
    waves, spectra = chart().wavelengths_nm, chart().spectra
    assert np.array_equal(chart().at(waves), spectra)
    np.testing.assert_allclose(chart().at((waves[1:] + waves[:-1]) / 2), (spectra[:, 1:] + spectra[:, :-1]) / 2)
