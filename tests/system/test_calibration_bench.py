"""`mitsim calibrate --plan` and `--model`, from the command line: what they print, write and refuse."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.system.refusals import Call, Refused, mentions

pytestmark = pytest.mark.usefixtures("kept_plans")


def test_a_ceiling_ends_with_status_one_and_a_line(call: Call, lab: Any) -> None:
    done = call("calibrate", *lab.arguments, "--plan", "--psnr", 90, "--patterns", "uniform", "--quiet")
    assert done.code == 1
    (line,) = [line for line in done.err.splitlines() if "is not reached" in line]
    mentions(line, "90 dB is not reached under uniform", "without noise", "improve the capture")


def test_modelled_factors_are_a_calibration_that_says_so(call: Call, lab: Any, tmp_path: Path) -> None:
    """The small sensor sees no difference of distance and size, so one is held."""
    fit = "mask_distance,mask_shift_row,mask_shift_column"
    options = "--model", "wave", "--frames-used", 8, "--fit", fit, "-o", tmp_path / "cal", "--json", "--quiet"
    done = call("calibrate", *lab.arguments, *options)
    assert done.code == 0, done.err
    reported, written = done.payload, json.loads((tmp_path / "cal" / "manifest.json").read_text())
    assert reported["frames"] == 8 and reported["model"] == "wave"
    parameters = written["modelled"]["parameters"]
    fitted, held = parameters["mask_distance"], parameters["magnification"]
    assert abs(fitted["value"] - 2) < 5 * fitted["standard_error"]
    assert (held["value"], held["standard_error"]) == (1, None)
    image = call("reconstruct", lab.run, "--calibration", tmp_path / "cal", "-o", tmp_path / "image", "--json")
    measured = call("reconstruct", lab.run, "--calibration", lab.calibration, "-o", tmp_path / "other", "--json")
    assert image.code == 0 and image.payload["psnr"] > measured.payload["psnr"] - 1


REFUSED = [
    (("--plan",), ("the PSNR that the image is to reach",)),
    (("--plan", "--psnr", 0), ("--psnr 0", "1 to 100 dB")),
    (("--plan", "--psnr", 20, "--patterns", "stars"), ("stars",)),
    (("--plan", "--psnr", 20, "--resume"), ("--resume",)),
    (("--plan", "--psnr", 20, "--model", "wave"), ("--model", "by --plan-session")),
    (("--psnr", 20), ("--psnr", "by scene")),
    (("--model", "ray"), ("--model 'ray'", "geometric or wave")),
    (("--model", "wave", "--frames-used", 1), ("--frames-used 1", "2 or more")),
    (("--model", "wave", "--fit", "tilt"), ("--fit 'tilt'", "mask_distance")),
    (("--model", "wave", "--fit", "mask_shift_row,projector_row"), ("--fit mask_shift_row,projector_row", "fit one")),
    (("--model", "wave", "--resume"), ("--resume",)),
]


@pytest.mark.parametrize(("options", "fragments"), REFUSED)
def test_what_goes_together_with_nothing_is_refused(
    refused: Refused, lab: Any, options: tuple[object, ...], fragments: tuple[str, ...]
) -> None:
    mentions(refused("calibrate", *lab.arguments, "-o", "new.toml", *options), *fragments)


def test_a_calibration_without_a_folder_or_a_model_without_a_scene_is_refused(refused: Refused, lab: Any) -> None:
    mentions(refused("calibrate", *lab.arguments), "Missing option '-o' / '--output'")
    mentions(refused("calibrate", "--model", "wave", "-o", "new"), "--model: give the scene too")
