"""The first line of every result: its main figure, and the main reason if it is flagged; and each reason once."""

from __future__ import annotations

import pytest

from mitsim.core.headline import calibration_headline, each_once, frames_headline, headline, image_headline


@pytest.mark.parametrize(
    ("reason", "label"),
    [
        ("Rank deficient: 3 of 64 directions are not measured; use more patterns", "rank deficient"),
        ("saturation: 3 frames have pixels at the full well; expose for less", "saturation"),
        ("In the calibration, factors are rank deficient: 3 of 64; calibrate again", "in the calibration, factors are "
         "rank deficient"),
        ("the total error is up to 2.1e-02 (95 %); the accuracy 0.01 was not reached", "the total error is up to "
         "2.1e-02 (95 %)"),
        ("PSNR 30 dB cannot be reached under dots:2: noise", "PSNR 30 dB cannot be reached under dots:2"),
    ],
)  # fmt: skip
def test_a_flagged_headline_ends_with_the_label_of_its_first_reason(reason: str, label: str) -> None:
    """Without remedy, figures and a second sentence. (Planted: the last reason; the whole reason.)"""
    assert headline("Made", (reason, "other: reason")) == f"Made. Flagged: {label}"
    assert headline("Made") == "Made"


def test_headlines_name_what_was_made_and_its_main_figure() -> None:
    """The largest error of several lines; PSNR before the stated uncertainty. (Planted: the first line's error.)"""
    run = {"frames": 49, "shape": (512, 256), "total_error_bound": 1e-3}
    assert frames_headline([run]) == "Captured 49 frames of 512 x 256 pixels, total error up to 1.0e-03"
    assert frames_headline([run, {**run, "total_error_bound": 2e-3}]) == (
        "Captured 49 frames of 512 x 256 pixels in each of 2 lines, total error up to 2.0e-03"
    )
    assert frames_headline([{**run, "frames": 1, "total_error_bound": None}]) == "Imported 1 frame of 512 x 256 pixels"
    made = {"n": 64, "phi_error": None, "predicted_phi_error": 2e-3}
    assert calibration_headline([made]) == "Calibrated 64 x 64 pixels, factor error 2.0e-03"
    image = {"shape": (64, 32), "uncertainty": 2e-3}
    assert image_headline(image) == "Reconstructed 64 x 32 pixels, standard uncertainty 2.0e-03"
    assert image_headline({**image, "psnr": 31.0, "channels": [1, 2, 3]}) == (
        "Reconstructed 64 x 32 pixels in each of 3 lines, PSNR 31.00 dB"
    )


def test_each_reason_appears_once_with_the_parts_that_have_it() -> None:
    """Numbers may differ, and an inherited reason is the same one. (Planted: numbers compared; origins kept.)"""
    found = {
        "r": ["misfit: 1.2% of the frames; look at them", "In the capture, saturation: 3 frames; expose for less."],
        "g": ["misfit: 1.3% of the frames; look at them", "Dim. Expose for longer."],
    }
    assert each_once(found) == (
        "misfit: 1.2% of the frames; look at them",
        "In r, saturation: 3 frames; expose for less",
        "In g, dim. Expose for longer",
    )
    session = {"run": ["saturation: 3 frames; expose for less"], "image": each_once(found)}
    assert [text for text in each_once(session) if "saturation" in text] == [
        "In run, saturation: 3 frames; expose for less"
    ]
    assert each_once({"": ["A", "a."]}) == ("A",)
    planes = {name: ["In the calibration, dim"] for name in ("r", "g")}
    assert each_once({**planes, "b": []}) == ("In r and g, dim",) and each_once(planes) == ("dim",)
    assert each_once({"the capture": ["dim"]}) == ("In the capture, dim",)
