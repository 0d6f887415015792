"""Run and calibration folders that are damaged, unfinished or of another camera are refused, and stay as they are."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsim.api.bench import open_bench
from mitsim.core.exr import checksum, read_frame, write_frame
from tests.system.refusals import Refused, mentions

Edit = Callable[[dict[str, Any]], object]


@pytest.fixture
def run(lab: Any, tmp_path: Path) -> Path:
    """A copy of the laboratory's run, to be damaged."""
    return lab.copy("run", tmp_path / "run")


@pytest.fixture
def calibration(lab: Any, tmp_path: Path) -> Path:
    """A copy of the laboratory's calibration, to be damaged."""
    return lab.copy("calibration", tmp_path / "calibration")


def edit(folder: Path, change: Edit) -> None:
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(manifest))


def rewrite(path: Path, change: Callable[[np.ndarray], np.ndarray], **rename: str) -> None:
    """The frame with every channel changed; a well-formed file of other content."""
    channels, metadata = read_frame(path)
    write_frame(path, {rename.get(name, name): change(values) for name, values in channels.items()}, metadata)


# ---- that do not fit each other --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("numbers", "fragments"),
    [
        ({"mask": "flatcam"}, ["geometry.mask ", "flatcam", "separable"]),
        ({"mask_distance": 2.5}, ["geometry.mask_distance", "2.5", "2.0"]),
        ({"scene_distance": 380}, ["geometry.scene_distance", "380", "400"]),
        ({"n": 8}, ["projector.", "8", "16"]),
        ({"pixels": 32}, ["geometry.pixels", "32", "64"]),
        ({"pitch": 0.00586, "binning": 1}, ["geometry.pixel_pitch", "0.00586", "0.01172"]),
        ({"gain": 0.25}, ["sensor.gain_dn_per_e", "0.25", "0.125"]),
        ({"wavelength": "red projector"}, ["projector.name", "red projector", "test projector"]),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_calibration_of_another_camera(
    refused: Refused, lab: Any, tmp_path: Path, numbers: dict[str, Any], fragments: list[str]
) -> None:
    """Factors of the laboratory's, or of other shapes, under the identity of another camera."""
    numbers = dict(numbers)
    camera, projector = tmp_path / "camera.toml", tmp_path / "projector.toml"
    text = lab.camera.read_text().replace("binning = 2", f"binning = {numbers.pop('binning', 2)}")
    camera.write_text(text.replace("gain_dn_per_e = 0.125", f"gain_dn_per_e = {numbers.pop('gain', 0.125)}"))
    name = numbers.pop("wavelength", "test projector")
    projector.write_text(lab.projector.read_text().replace("test projector", name))
    bench = open_bench(lab.write_scene("other", **numbers), camera=camera, projector=projector)
    other = lab.copy("calibration", tmp_path / "other")
    for side in ("left", "right"):
        rewrite(other / f"{side}.exr", lambda factor: np.resize(factor, (bench.geometry.pixels, bench.n)))

    def another(manifest: dict[str, Any]) -> None:
        manifest["camera"] = json.loads(json.dumps(bench.identity()))
        manifest["checksums"] = {name: checksum(other / name) for name in manifest["checksums"]}

    edit(other, another)
    line = refused("reconstruct", lab.run, "--calibration", "other")
    mentions(line, "calibration other", str(lab.run), *fragments)


def test_a_run_is_no_calibration_and_vice_versa(refused: Refused, lab: Any, tmp_path: Path) -> None:
    mentions(refused("reconstruct", lab.run, "--calibration", lab.run), str(lab.run), "capture, not a calibration")
    line = refused("reconstruct", lab.calibration, "--calibration", lab.calibration)
    mentions(line, str(lab.calibration), "calibration, not a capture")


def test_folders_that_are_not_there(refused: Refused, lab: Any, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("mine")
    for name in ("nowhere", "file"):
        mentions(refused("reconstruct", name, "--calibration", lab.calibration), name, "mitsim capture")
        mentions(refused("reconstruct", lab.run, "--calibration", name), name, "mitsim calibrate")
    mentions(refused("reconstruct", "empty", "--calibration", lab.calibration), "empty/manifest.json")
    mentions(refused("reconstruct", lab.run, "--calibration", "empty"), "empty/manifest.json")


# ---- manifests -------------------------------------------------------------------------------------------------------


NAN, GONE = float("nan"), object()


def put(*path: str | int, value: object = GONE) -> Edit:
    """An edit of a manifest: the item at ``path`` becomes ``value``, or is removed without one."""

    def change(manifest: Any) -> None:
        for key in path[:-1]:
            manifest = manifest[key]
        if value is GONE:
            del manifest[path[-1]]
        else:
            manifest[path[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "fragments"),
    [
        (put("status", value="incomplete"), ["incomplete", "resume"]),
        (put("patterns"), ["patterns: is missing"]),
        (put("camera"), ["camera: is missing"]),
        (put("patterns", "captures", 2), ["1 of 16 patterns", "(0, 2)"]),
        (put("patterns", "captures", 2, "file", value=None), ["captures", "file", "None"]),
        (put("patterns", "captures", 2, "sign", value=1), ["(0, 2)", "signs [1]"]),
        (put("checksums", "frame_00003.exr", value="0" * 64), ["frame_00003.exr", "checksum"]),
    ],
)
def test_a_run_manifest_with_a_mistake(
    refused: Refused, lab: Any, run: Path, change: Edit, fragments: list[str]
) -> None:
    edit(run, change)
    mentions(refused("reconstruct", "run", "--calibration", lab.calibration), "run", *fragments)


@pytest.mark.parametrize(
    ("change", "fragments"),
    [
        (put("status", value="incomplete"), ["incomplete"]),
        (put("camera"), ["camera: is missing"]),
        (put("camera", "sensor"), ["sensor.name is not stated", "calibrate the run's camera"]),
        (put("checksums", "left.exr", value="0" * 64), ["left.exr", "checksum"]),
    ],
)
def test_a_calibration_manifest_with_a_mistake(
    refused: Refused, lab: Any, calibration: Path, change: Edit, fragments: list[str]
) -> None:
    edit(calibration, change)
    mentions(refused("reconstruct", lab.run, "--calibration", "calibration"), "calibration", *fragments)


# ---- frames ----------------------------------------------------------------------------------------------------------

FRAME = "frame_00005.exr"


def test_a_refusal_keeps_an_earlier_image(refused: Refused, call: Callable[..., Any], lab: Any, run: Path) -> None:
    assert call("reconstruct", run, "--calibration", lab.calibration).code == 0
    assert (run / "reconstruction" / "image.exr").is_file()
    (run / FRAME).unlink()
    mentions(refused("reconstruct", "run", "--calibration", lab.calibration), FRAME)
