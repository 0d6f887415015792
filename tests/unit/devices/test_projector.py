"""Projector files: what is in them is checked, what is unknown is refused, and the spectrum counts photons."""

import math
from collections.abc import Sequence
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mitsim.core.configuration import load_model, validate
from mitsim.core.errors import MitsimError
from mitsim.devices.projector import Lines, ProjectorModel

BASE = {"name": "test", "effective_wavelength_nm": 550.0}


@pytest.mark.parametrize(
    ("given", "rule"),
    [
        *(({"blur_pixels": 300.0}, "from 0 to 16"), ({"aperture_radius_mm": 1e4}, "from 0 to 1000")),
        *(({"focus_mm": math.inf}, "give a finite number"), ({"effective_wavelength_nm": 0.0}, "from 1 to 1e")),
        *(({"ansi_contrast": 1.0}, "above 1"), ({"luminous_efficacy_lm_per_w": 900.0}, "from 0 to 684")),
        *(({"laser_class": "5"}, "'3R'"), ({"wavelengths_nm": [550.0]}, "one share a line")),
        ({"ansi_contrast": 100.0, "contrast_ratio": 100.0}, r"got 100, and black pixels leave 100 \(contrast_ratio\)"),
        ({"ansi_contrast": 1.2, "glare_spread": 0.1}, "got 1.2, which a lens that scatters all light exceeds"),
    ],
)
def test_a_value_of_no_device_is_refused_with_its_rule(given: dict[str, object], rule: str) -> None:
    with pytest.raises(MitsimError, match=rf"^here: [^\n]*{next(iter(given))}[^\n]*{rule}[^\n]*$"):
        validate(ProjectorModel, {**BASE, **given}, "here")


@pytest.mark.parametrize(("contrast", "black", "spread"), [(200.0, 0.0, 0.25), (20.0, 2e-3, 0.25), (6.0, 0.01, 0.1)])
def test_a_scattered_chessboard_has_the_ansi_contrast(contrast: float, black: float, spread: float) -> None:
    """Scattered by SciPy's Gaussian, 80 points a side; the middles lie between four of them."""
    ratio = 1 / black if black else math.inf
    model = ProjectorModel(**BASE, contrast_ratio=ratio, ansi_contrast=contrast, glare_spread=spread)
    side, field = 80, 20
    white = np.add.outer(np.arange(side) // field, np.arange(side) // field) % 2 == 1
    board = np.where(white, 1.0, black)
    spots = gaussian_filter(np.pad(board, 2 * side), spread * side, mode="constant", truncate=8.0)
    light = (1 - model.glare) * board + model.glare * spots[2 * side : -2 * side, 2 * side : -2 * side]
    middles = [place for start in range(field // 2 - 1, side, field) for place in (start, start + 1)]
    seen, bright = light[np.ix_(middles, middles)], white[np.ix_(middles, middles)]
    assert seen[bright].mean() / seen[~bright].mean() == pytest.approx(contrast, rel=3e-3)


@pytest.mark.parametrize(
    ("field", "least", "most"),
    [
        ("glare_spread", 0.1, 2.0),
        ("aperture_radius_mm", 0.0, 1000.0),
        ("focus_mm", 1.0, 1e7),
        ("blur_pixels", 0.0, 16.0),
    ],
)
def test_numbers_are_taken_up_to_the_limits_that_their_refusals_state(field: str, least: float, most: float) -> None:
    """(Planted: another number for each limit.)"""
    for value in (least, most):
        assert getattr(validate(ProjectorModel, {**BASE, field: value}, "here"), field) == value
    for value in (least - 1e-4, most + 1e-4):
        with pytest.raises(MitsimError, match=f"{field}.*from {least:g} to"):
            validate(ProjectorModel, {**BASE, field: value}, "here")


def test_lines_apart_have_one_wavelength_and_keep_their_power() -> None:
    """A variant of three lines traces each wavelength with all its slots. (Planted: one line called several.)"""
    lines = Lines((638.0, 520.0, 445.0), (0.5, 0.3, 0.2))
    assert lines.several and not Lines((638.0,), (1.0,)).several
    assert [line.wavelengths_nm for line in lines.apart] == [(nm,) * 3 for nm in lines.wavelengths_nm]
    assert np.sum([line.shares for line in lines.apart], axis=0) == pytest.approx(lines.shares)


def test_a_spectrum_is_of_photons_and_some_line_has_power() -> None:
    """Shares are relative to their sum; all 0 gave weights of nan."""
    lines = {**BASE, "wavelengths_nm": [450.0, 600.0]}
    with pytest.raises(MitsimError, match="radiant_shares are all 0; at least one line must have power"):
        validate(ProjectorModel, {**lines, "radiant_shares": [0.0, 0.0]}, "here")
    spectrum = validate(ProjectorModel, {**lines, "radiant_shares": [2.0, 3.0]}, "here").spectrum
    assert spectrum.weights == pytest.approx([180 / 540, 360 / 540])
    assert validate(ProjectorModel, BASE, "here").spectrum.wavelengths_nm.tolist() == [550.0]


def test_speckle_is_a_number_or_a_table(tmp_path: Path) -> None:
    path = tmp_path / "laser.toml"
    head = 'name = "laser"\neffective_wavelength_nm = 562.0\n'
    path.write_text(head + "[speckle]\nroughness_um = 20.0\nlinewidth_nm = 1.0\n")
    model = load_model(path, ProjectorModel)
    assert model.speckle and model.speckle.linewidth_nm == 1.0
    for text, words in (
        ("speckle_contrast = 0.0\n[speckle]\n", "got speckle_contrast 0 and the table speckle; give one"),
        ("[speckle]\nlinewidth_nm = 1.0\n", "got 1 without roughness_um; give both"),
        ("[speckle]\npolarization = 1.0\n", "did you mean polarisation"),
    ):
        path.write_text(head + text)
        with pytest.raises(MitsimError, match=words):
            load_model(path, ProjectorModel)


LED = Lines((630.0, 460.0, 450.0, 440.0, 620.0), (0.2, 0.1, 0.3, 0.1, 0.3))


def spread(bands: Sequence[Lines]) -> float:
    """Power times squared distance from the band's mean."""
    return sum(
        share * (wave - np.average(band.wavelengths_nm, weights=band.shares)) ** 2
        for band in bands
        for wave, share in zip(band.wavelengths_nm, band.shares, strict=True)
    )


def test_no_other_cuts_leave_less_of_the_power_off_its_bands_mean() -> None:
    """Against all cuts of nine random lines (planted: cuts by the widest gap)."""
    rng = np.random.default_rng(3)
    for count in (1, 2, 3, 4):
        waves, shares = sorted(rng.uniform(400, 700, 9).tolist()), rng.uniform(0.1, 1, 9).tolist()
        lines = Lines((*waves[3:], *waves[:3]), (*shares[3:], *shares[:3]))

        every = combinations(range(1, 9), count - 1)
        least = min(spread([Lines(waves[a:b], shares[a:b]) for a, b in pairwise((0, *at, 9))]) for at in every)
        assert len(lines.bands(count)) == count and spread(lines.bands(count)) == pytest.approx(least)
