"""Image quality against closed forms, and the one reader of the truth."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.core.manifests import Digital, Patterns, RunManifest, ShotFile
from mitsim.core.runs import Capture
from mitsim.metrics import Quality, psnr, relative_error, ssim, truth_error_for, truth_for

RNG = np.random.default_rng(11)
TRUTH = RNG.uniform(0.05, 0.9, (24, 20))


def test_psnr_of_a_constant_error_is_its_decibel() -> None:
    assert psnr(TRUTH + 0.1, TRUTH) == pytest.approx(20.0)
    assert psnr(TRUTH, TRUTH) == float("inf")


def test_psnr_fits_no_gain_and_no_offset_and_clips_nothing() -> None:
    """Values far outside 0..1 count in full: mean((3 T - T)^2) = 4 mean(T^2)."""
    assert psnr(3.0 * TRUTH, TRUTH) == pytest.approx(-10 * np.log10(4 * np.mean(TRUTH**2)))


def test_ssim_is_one_for_equal_and_follows_the_formula_for_flat_images() -> None:
    """Flat images of means a, b have structure term 1: SSIM = (2ab + c1) / (a^2 + b^2 + c1), c1 = 0.01^2."""
    assert ssim(TRUTH, TRUTH) == pytest.approx(1.0)
    a, b, c1 = 0.3, 0.6, 1e-4
    flat = np.full((9, 9), a), np.full((9, 9), b)
    assert ssim(*flat) == pytest.approx((2 * a * b + c1) / (a * a + b * b + c1))


def test_quality_of_an_image_smaller_than_the_window_has_no_ssim() -> None:
    assert Quality.of(TRUTH + 0.1, TRUTH) == Quality(psnr(TRUTH + 0.1, TRUTH), ssim(TRUTH + 0.1, TRUTH))
    assert Quality.of(TRUTH[:6] + 0.1, TRUTH[:6]) == Quality(pytest.approx(20.0), None)  # type: ignore[arg-type]


def test_refusals_are_one_line_that_names_the_trouble() -> None:
    broken = TRUTH.copy()
    broken[0, :3] = np.nan
    for call, words in (
        (lambda: psnr(TRUTH, TRUTH[1:]), "image is 24 x 20, truth 23 x 20"),
        (lambda: psnr(broken, TRUTH), "image has 3 values that are not finite"),
        (lambda: ssim(TRUTH, broken), "truth has 3 values"),
        (lambda: ssim(TRUTH[:6], TRUTH[:6]), "6 x 20 pixels; needs at least 7 x 7"),
    ):
        with pytest.raises(MitsimError, match=words) as caught:
            call()
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("truth_error", "text"),
    [
        (None, "PSNR 20.00 dB, SSIM 0.900"),
        (1e-3, "PSNR 20.00 dB, SSIM 0.900, truth good to 60.0 dB"),
        (0.04, "PSNR 20.00 dB, SSIM 0.900, truth good to 28.0 dB, which limits the PSNR"),
        (0.0, "PSNR 20.00 dB, SSIM 0.900, truth good to inf dB"),
    ],
)
def test_quality_says_how_good_the_truth_is(truth_error: float | None, text: str) -> None:
    """It limits an image when it makes more than a tenth of the squared error: 0.04^2 of 0.1^2."""
    quality = Quality(20.0, 0.9, truth_error)
    assert str(quality) == text and quality.limited_by_truth == ("limits" in text)
    assert Quality.of(TRUTH + 0.1, TRUTH, truth_error).truth_error == truth_error


@pytest.mark.parametrize(("board", "expected"), [(None, 0.5), (0.9, 0.55)])
def test_truth_follows_the_board_of_the_calibration(board: float | None, expected: float) -> None:
    """A sheet that is 0.5 of a 0.99 board is 0.55 of a 0.9 board."""
    values = np.full((3, 4), 0.5, dtype=np.float32)
    shots = Capture(manifest(), memory={"truth.exr": ({"reflectance": values}, {"board_reflectance": 0.99})})
    truth = truth_for(shots, board)
    assert truth_error_for(shots, board) is None, "0.4.0 did not state it"
    wrong = {"reflectance": values, "standard_error": np.full_like(values, 0.03)}
    stated = Capture(manifest(), memory={"truth.exr": (wrong, {"board_reflectance": 0.99})})
    assert truth_error_for(stated, board) == pytest.approx(0.03 * expected / values.max(), rel=1e-6)
    assert truth is not None and truth.dtype == np.float64 and truth == pytest.approx(expected)


def manifest() -> RunManifest:
    return RunManifest(
        camera={},
        digital=Digital(exposure_s=1.0, gain_dn_per_e=1.0, black_level_dn=0.0, dark_current_e_per_s=0.0),
        patterns=Patterns(P_L=((1.0,),), P_R=((1.0,),), captures=(ShotFile(file="a.exr", row=0, column=0, sign=0),)),
    )


def test_relative_error_is_a_ratio_of_norms() -> None:
    assert relative_error(np.array([[3.0, 0.0]]), np.array([[3.0, 4.0]])) == pytest.approx(0.8)
