"""export, import and transport on the command line: keys, sentences, statuses; the image of a run that went out and
came back, and its frames formed of a file of its light."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import mitsim as ms
from mitsim.core.exr import read_frame
from tests.exchanged import frame_of
from tests.system.refusals import Call, Refused, mentions

EXPORTED = {"format", "frames", "pairs", "calibration", "notes", "output"}
IMPORTED = {"headline", "frames", "output", "calibration_output", "holds", "left_out", "report", "notes", "warnings"}


def image(call: Call, run: Path, calibration: Path, to: Path) -> np.ndarray:
    assert call("reconstruct", run, "--calibration", calibration, "-o", to).code in (0, 1)
    return read_frame(to / "image.exr")[0]["reflectance"]


def test_out_and_back(call: Call, lab: Any, tmp_path: Path) -> None:
    name = "all.h5"
    out = call("export", lab.run, "--format", "hdf5", "--calibration", lab.calibration, "-o", tmp_path / name, "--json")
    assert out.code == 0 and out.payload.keys() == EXPORTED and out.payload["frames"] == 16
    back = call("import", tmp_path / name, "-o", tmp_path / "run", "--calibration-output", tmp_path / "cal", "--json")
    assert back.code == 0 and back.payload.keys() == IMPORTED and back.payload["holds"] == ["run", "calibration"]
    assert back.payload["headline"].startswith("Captured 16 frames of 64 x 64 pixels, total error up to ")
    again = image(call, tmp_path / "run", tmp_path / "cal", tmp_path / "b")
    assert np.array_equal(again, image(call, lab.run, lab.calibration, tmp_path / "a"))


def test_pictures_and_frames_again(call: Call, lab: Any, tmp_path: Path) -> None:
    """By the line that export prints, with the names put in."""
    out = call("export", lab.run, "--format", "png", "-o", tmp_path / "out", "--projector", "mp_cl1", "--json")
    assert out.code == 0, out.err
    line = out.payload["notes"][0].split("mitsim ")[1]
    names = {"NAME": lab.camera, "CAL": lab.calibration, "RUN": tmp_path / "run"}
    back = call(*(names.get(word, word) for word in line.split()), "--json")
    assert back.code == 0 and back.payload.keys() == {*IMPORTED, "shape", "divided_by", "planes"}
    assert back.payload["headline"] == "Imported 16 frames of 64 x 64 pixels"
    assert back.payload["shape"] == [64, 64] and "truth" in back.payload["left_out"]
    again = image(call, tmp_path / "run", lab.calibration, tmp_path / "b")
    assert np.array_equal(again, image(call, lab.run, lab.calibration, tmp_path / "a"))


def test_refusals(refused: Refused, lab: Any) -> None:
    mentions(refused("export", lab.run, "--format", "xml", "-o", "new"), "--format 'xml'", "hdf5, mat, torch, png")
    mentions(refused("export", lab.run, "--format", "flatcam", "-o", "new"), "--format 'flatcam'")
    mentions(refused("export", lab.calibration, "--format", "hdf5", "-o", "new"), "holds a calibration")
    mentions(refused("export", lab.run, "--format", "hdf5", "-o", "new", "--projector", "mp_cl1"), "--projector")
    frames = "import", lab.run.parent
    mentions(refused(*frames), "give -o RUN")
    mentions(refused(*frames, "-o", "new"), "--patterns is not given, nor is camera, nor is exposure")
    given = "--patterns", "dots:4", "--camera", lab.camera
    mentions(refused(*frames, "-o", "new", *given), "--exposure is not given")
    mentions(refused(*frames, "-o", "new", *given, "--exposure", 0), "--exposure 0")
    mentions(refused(*frames, "-o", "new", *given, "--exposure", 1), "--calibration is not given", "--projector-pixels")
    mentions(refused(*frames, "-o", "new", *given, "--exposure", 1, "--shape", "3"), "--shape")
    mentions(refused("import", "none.h5", "-o", "new"), "none.h5", "cannot be read")
    mentions(refused("import", "none.h5", "-o", "new", "--exposure", 1), "--exposure", "leave it out")


def test_light_in_a_file_makes_the_frames_of_a_capture(call: Call, lab: Any, tmp_path: Path) -> None:
    """By the lines of docs/exchange.md: of the same seed to single precision, as capture traces the same paths; of
    another seed within the error that both files state: the square of their difference, over what both state of it,
    varies by 0.2 among pairs of seeds. (Planted: the error of one group, other electrons a joule.)"""
    shots = ms.load_run(lab.run)
    for seed in (0, 1):
        options = "--patterns", "dots:4", "-o", tmp_path / f"{seed}.h5", "--seed", seed, "--json"
        done = call("transport", *lab.arguments, *options)
        assert done.code == 0, done.err
        payload = done.payload
        assert payload.keys() == {
            *("n", "shape", "entries", "accuracy", "mc_error", "total_error_bound", "lost_light", "paths", "seed"),
            *("variant", "bytes", "seconds", "warnings", "output", "kernels"),
        }
        assert payload["shape"] == [64, 64] and payload["mc_error"] < payload["total_error_bound"] <= 0.005
    with h5py.File(tmp_path / "0.h5") as file:
        unit = file.attrs["electrons_per_j_m2"]
        assert file.attrs["mc_error"] == pytest.approx(payload["mc_error"], rel=0.5)
    square = error = energy = apart = 0.0
    for shot in shots.manifest.patterns.captures:
        left, right = shots.patterns
        pattern = np.outer(left[:, shot.row], right[:, shot.column])
        (frame, own), (other, others) = (frame_of(tmp_path / f"{seed}.h5", pattern) for seed in (0, 1))
        expected = shots.read(shot.file)[0]["electrons"] / shots.manifest.digital.exposure_s
        energy += float(np.square(expected).sum())
        apart += float(np.square(frame * unit - expected).sum())
        square += float(np.square(frame - other).sum())
        error += float((own**2 + others**2).sum())
    assert np.sqrt(apart / energy) < 1e-6
    assert square / error == pytest.approx(1, abs=0.6), "three standard deviations"


def test_patterns_are_drawn(call: Call, tmp_path: Path) -> None:
    stripes = "stripes", "-o", tmp_path / "s", "--camera", "imx249", "--exposure", 0.02, "--projector-pixels", 4
    for arguments, count in ((("dots:2", "-o", tmp_path / "d"), 4), (stripes, 16)):
        done = call("patterns", *arguments, "--json")
        assert done.code == 0, done.err
        assert done.payload.keys() == {"patterns", "n", "pictures", "projector", "session", "output"}
        assert done.payload["pictures"] == count == len(list(Path(arguments[2]).glob("patterns/pattern_*.png")))
    assert done.payload["session"] == str(tmp_path / "s" / "session.json")


def test_patterns_that_cannot_be_drawn(refused: Refused) -> None:
    mentions(refused("patterns", "stripes", "-o", "new"), "--camera is missing")
    mentions(refused("patterns", "dots:2", "-o", "new", "--exposure", 1), "--exposure 1.0", "only for stripes")
    mentions(refused("patterns", "dots:2", "-o", "new", "--projector-pixels", 0), "--projector-pixels")
