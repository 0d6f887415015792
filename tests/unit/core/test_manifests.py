"""Manifests: strict, versioned, and with the limits of what writes them."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from mitsim.core.errors import MitsimError
from mitsim.core.files import read_json, write_json
from mitsim.core.manifests import (
    MOST_PIXELS,
    MOST_SHOTS,
    CalibrationManifest,
    Digital,
    Patterns,
    RunManifest,
    read_manifest,
)
from mitsim.devices.patterns import PatternFamily, parse_patterns
from mitsim.devices.sensor import SensorModel

RUN: dict[str, Any] = {
    "kind": "capture",
    "format": 1,
    "status": "complete",
    "camera": {"name": "bench"},
    "digital": {"exposure_s": 1, "gain_dn_per_e": 0.125, "black_level_dn": 160, "dark_current_e_per_s": 6},
    "patterns": {"P_L": [[1]], "P_R": [[1]], "captures": [{"file": "a.exr", "row": 0, "column": 0, "sign": 0}]},
}
CAL: dict[str, Any] = {"kind": "calibration", "format": 1, "status": "complete", "camera": {"name": "bench"}}


def changed(data: dict[str, Any], path: str, value: object) -> dict[str, Any]:
    data = copy.deepcopy(data)
    *parents, last = path.split(".")
    part: Any = data
    for key in parents:
        part = part[int(key) if key.isdigit() else key]
    part[last] = value
    return data


def read(folder: Path, data: dict[str, Any]) -> RunManifest | CalibrationManifest:
    write_json(folder / "manifest.json", data)
    return read_manifest(folder, RunManifest if data["kind"] == "capture" else CalibrationManifest)


@pytest.mark.parametrize(
    ("data", "path", "value", "words"),
    [
        (RUN, "digital.exposure_s", True, "digital.exposure_s: got True; give a number"),
        (RUN, "digital.exposure_s", "1", "digital.exposure_s: got '1'"),
        (RUN, "patterns.captures.0.row", False, "captures.0.row: got False"),
        (RUN, "patterns.captures.0.sign", True, "captures.0.sign: got True"),
        (RUN, "patterns.P_L", [[True]], "P_L.0.0: got True"),
        (RUN, "format", 2, "format: got 2; give a number from 1 to 1"),
        (RUN, "format", True, "format: got True"),
        (RUN, "warnings", "too dark", "warnings: got 'too dark'"),
        (RUN, "mc_error", "0", "mc_error: got '0'"),
        (RUN, "warning", ["too dark"], "warning: got ['too dark'], no such field; did you mean warnings?"),
        (RUN, "digital.exposure", 1, "digital.exposure: got 1, no such field; did you mean exposure_s?"),
        (RUN, "patterns.captures.0.colum", 1, "colum: got 1, no such field; did you mean column?"),
        (CAL, "centre", 1, "centre: got 1"),
        (CAL, "board_reflectance", True, "board_reflectance: got True"),
        (CAL, "center", True, "center: got True, no such field; did you mean centre?"),
    ],
)  # fmt: skip
def test_what_is_not_meant_is_refused(
    tmp_path: Path, data: dict[str, Any], path: str, value: object, words: str
) -> None:
    read(tmp_path, data)
    with pytest.raises(MitsimError) as caught:
        read(tmp_path, changed(data, path, value))
    assert words in str(caught.value)


@pytest.mark.parametrize("data", [RUN, CAL], ids=["run", "cal"])
def test_a_folder_without_a_format_is_read_as_version_0_3_0_did(tmp_path: Path, data: dict[str, Any]) -> None:
    """Fields that mitsim does not know are others'; those that it knows keep their rules."""
    old = {key: value for key, value in data.items() if key != "format"} | {"operator": "M. Curie"}
    assert read(tmp_path, old) == read(tmp_path, data)
    with pytest.raises(MitsimError, match="warnings: got 3"):
        read(tmp_path, {**old, "warnings": 3})


def test_captures_of_one_file_are_refused(tmp_path: Path) -> None:
    """Two shots cannot be one frame, nor a shot the ambient frame."""
    captures = [{"file": "a.exr", "row": row, "column": 0, "sign": 0} for row in range(2)]
    patterns = {"P_L": [[1.0, 0.0], [0.0, 1.0]], "P_R": [[1.0], [1.0]], "captures": captures}
    with pytest.raises(MitsimError, match=r"captures.1: names 'a.exr', as captures.0 does"):
        read(tmp_path, {**RUN, "patterns": patterns})
    captures[1]["file"] = "b.exr"
    read(tmp_path, {**RUN, "patterns": patterns})
    with pytest.raises(MitsimError, match=r"ambient_frame: names 'b.exr', a capture's file"):
        read(tmp_path, {**RUN, "patterns": patterns, "ambient_frame": {"file": "b.exr", "shots": 1}})


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    run = read(tmp_path, RUN)
    write_json(tmp_path / "manifest.json", run)
    assert read_manifest(tmp_path, RunManifest) == run
    assert json.loads((tmp_path / "manifest.json").read_text())["format"] == 1


def limits(model: Any, field: str) -> tuple[float, float]:
    schema = TypeAdapter(model).json_schema()["properties"][field]
    return schema.get("minimum", schema.get("exclusiveMinimum")), schema.get("maximum", schema.get("exclusiveMaximum"))


@pytest.mark.parametrize("field", ["black_level_dn", "dark_current_e_per_s", "gain_dn_per_e"])
def test_a_reader_takes_every_camera_that_a_writer_takes(field: str) -> None:
    """Black level and dark current of a binned pixel are binning^2 times a pixel's: 1e12 of one made a RUN folder that
    `reconstruct` refused."""
    binned = 1 if field == "gain_dn_per_e" else limits(SensorModel, "binning")[1] ** 2
    (least, most), (least_read, most_read) = limits(SensorModel, field), limits(Digital, field)
    assert least_read <= least and most_read >= most * binned


def test_patterns_that_no_reader_takes_are_refused_before_work() -> None:
    """257 x 257 dots, or a projector of 5000 pixels, made a RUN folder that `reconstruct` refused."""
    with pytest.raises(MitsimError, match=rf"patterns 'dots:257': are 66049 shots; a run has at most {MOST_SHOTS}"):
        parse_patterns("dots:257", 300)
    dots = np.eye(300, 257, dtype=np.int8)
    family = PatternFamily("dots:257", dots, dots)
    with pytest.raises(MitsimError, match=rf"patterns 'dots:257': captures: .* at most {MOST_SHOTS}"):
        Patterns.of(family, ["a.exr"] * 257**2)
    row = np.ones((MOST_PIXELS + 1, 1), dtype=np.int8)
    with pytest.raises(MitsimError, match=rf"n: got {MOST_PIXELS + 1}|at most {MOST_PIXELS}"):
        Patterns.of(PatternFamily("uniform", row, row), ["a.exr"])


@pytest.mark.slow
def test_the_largest_manifest_that_is_written_is_read(tmp_path: Path) -> None:
    """65536 shots of 4096 x 256 patterns."""
    family = parse_patterns("dots:256", MOST_PIXELS)
    patterns = Patterns.of(family, [f"frame_{index:05d}.exr" for index in range(MOST_SHOTS)])
    checksums = {shot.file: "0" * 64 for shot in patterns.captures}
    manifest = RunManifest.model_validate({**RUN, "patterns": patterns, "checksums": checksums, "seconds": {"a": 1.0}})
    write_json(tmp_path / "manifest.json", manifest)
    assert read_json(tmp_path / "manifest.json")["patterns"]["n"] == MOST_PIXELS
