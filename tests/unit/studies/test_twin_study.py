"""The page, table and figures of twins; diffusers are found by their statistics."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from mitsim.core.errors import MitsimError
from mitsim.reconstruct.shifted_codes import Pose
from mitsim.studies.framework.run import run_study
from mitsim.studies.twin_capture import Learned
from mitsim.studies.twin_diffuser import (
    _BLURS,
    _CORRELATIONS_MM,
    _HAZES,
    _MOVES_MM,
    PITCH_MM,
    TRACED,
    DiffuserTwin,
    _land,
    fit,
    frequencies,
    lit_square,
    read_spread,
    spread_of,
)
from mitsim.studies.twin_frame import CAUSES, Twin
from mitsim.studies.twin_study import TwinFindings
from mitsim.transport.plugins.diffuser import random_relief
from tests.unit.studies.test_twin_capture import made, made_codes


def test_a_spread_of_light_by_hand() -> None:
    """Of one bright pixel in 400: contrast sqrt(399), all light in the brightest twentieth; a wave's power is in its
    band."""
    point = np.zeros((20, 20))
    point[3, 4] = 1
    assert spread_of(point).contrast == pytest.approx(399**0.5)
    assert spread_of(point).brightest == pytest.approx(1)
    wave = 1 + 0.5 * np.cos(2 * np.pi * 0.1 * np.arange(200))[:, None] * np.ones(200)
    found = spread_of(wave).spectrum
    assert frequencies()[np.argmax(found)] == pytest.approx(0.1, rel=0.2)
    noise = 1 + np.random.default_rng(0).standard_normal((200, 200))
    assert spread_of(noise).spectrum[9:] == pytest.approx(np.ones(5), rel=0.12)


def test_numbers_of_a_spectrum_are_found_again() -> None:
    """One on the grid, blurred and with an even part, is found as that."""
    draws = np.random.default_rng(1)
    grid = np.exp(draws.standard_normal((3, 4, len(frequencies()))))
    blur, haze = float(_BLURS[3]), float(_HAZES[4])
    measured = grid[2, 1] * np.exp(-((2 * np.pi * frequencies() * blur) ** 2)) * (1 - haze) ** 2
    assert fit(measured, grid) == pytest.approx((2, 1, blur, haze))


def test_rays_of_a_weak_relief_fall_as_its_curvature_says() -> None:
    """Light over its mean is 1 - move (h_xx + h_yy) to first order: correlation of both, noise of rays
    smoothed."""
    relief, count, move = random_relief(6.0, 0.8, 0.1, 4), 128, 0.02
    light = ndimage.gaussian_filter(_land(relief, move, count, 0), 3)
    spread = np.gradient(relief.slope_x, axis=0) + np.gradient(relief.slope_y, axis=1)
    at = ((np.arange(count) + 0.5 - count / 2) * PITCH_MM / relief.side_mm + 0.5) * (len(spread) - 1)
    seen = spread[np.ix_(at.round().astype(int), at.round().astype(int))]
    assert np.corrcoef(light.ravel(), seen.ravel())[0, 1] < -0.9


def test_a_picture_without_a_wide_lit_part_is_refused() -> None:
    light = np.zeros((300, 400))
    light[130:170, 180:220] = 1
    with pytest.raises(MitsimError, match="its lit part is"):
        lit_square(light)
    light[40:260, 90:310] = 1
    assert min(lit_square(light).shape) >= 140 and (lit_square(light) == 1).all()


def diffuser_twin() -> DiffuserTwin:
    draws = np.random.default_rng(0)
    lights = [1 + 0.3 * draws.random((160, 160)) for _ in range(TRACED + 1)]
    numbers = float(_CORRELATIONS_MM[1]), float(_MOVES_MM[2]), 0.4, 0.1
    spreads = tuple(map(spread_of, lights))
    return DiffuserTwin(lights[0], lights[1], *numbers, spreads, (0.01, 0.01, 0.1, 0.05))


def twin(seed: int) -> Twin:
    measured = made(seed, made_codes())
    noise = 0.2 * np.random.default_rng(seed).standard_normal(measured.frame.shape)
    measured = replace(measured, noise=noise, level=measured.level + noise)
    parts = dict.fromkeys(CAUSES, 1 / len(CAUSES))
    return Twin(measured, measured.frame, measured.level, 1.0, 0.7, parts, 0.02)


@pytest.mark.usefixtures("draft_figures")
def test_findings_have_a_page_a_table_and_figures(tmp_path: Path) -> None:
    """Every figure that the page names is there, and what cannot be known stands on it."""
    learned = {"fc_6": Learned(Pose("turned", (0.6, 0.7)), made_codes())}
    found = TwinFindings((twin(6), twin(7)), learned, diffuser_twin())
    run_study("twin", lambda *_: found, None, tmp_path / "out")
    written = {path.name for path in (tmp_path / "out").iterdir()}
    named = {name for part in found.parts() for name in part.figures}
    assert written == {"twin.json", "twin.html", *named} == {"twin.json", "twin.html", *found.figures()}
    page = (tmp_path / "out" / "twin.html").read_text(encoding="utf-8")
    assert "other scene" in page and "only the product" in page and page.count("<img") == len(named)
    kept = json.loads((tmp_path / "out" / "twin.json").read_text(encoding="utf-8"))
    assert [row["frame"] for row in kept["captures"]] == ["fc_6 gb", "fc_7 gb"] and kept["not_known"]
    assert kept["diffuser"]["contrast"].keys() == {"measured", "simulated", "scatter"}
    assert kept["learned"]["fc_6"]["scale"] == [0.6, 0.7] and not found.warnings


def test_twins_that_are_not_to_be_trusted_say_so() -> None:
    """An image that is not the frame's, a bad rendering, and images that may lie otherwise: a line each. (Planted: the
    other scene's correlation left out of the comparison.)"""
    swapped, coarse = replace(twin(6), other=1.01), replace(twin(7), render_error=0.2)
    unsure = {"fc_7": Learned(Pose("turned", (0.6, 0.7), 0.001, False), made_codes())}
    said = TwinFindings((swapped, coarse), unsure, None).warnings
    assert [line.split(":")[0] for line in said] == ["fc_7", "fc_6 gb", "fc_7 gb"]
    assert "its own image" in said[1] and "20% off" in said[2]


def test_a_point_spread_function_of_colours_is_refused(tmp_path: Path) -> None:
    Image.new("RGB", (300, 300)).save(tmp_path / "psf.tif")
    with pytest.raises(MitsimError, match=r"psf\.tif: is in colour; give"):
        read_spread(tmp_path / "psf.tif")
