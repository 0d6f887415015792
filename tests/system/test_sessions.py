"""`mitsim run`: the steps of a session file, each in its folder; the file that repeats a folder; and a session that
goes on."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mitsim as ms
from mitsim.core.exr import read_frame
from tests.system.refusals import Call, Refused


@pytest.fixture(scope="module")
def imaged(call: Call, lab: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An image of the laboratory's frames."""
    place: Path = tmp_path_factory.mktemp("imaged") / "smooth"
    call("reconstruct", lab.run, "--calibration", lab.calibration, "-o", place, "--method", "tv", "--lambda", "2e8")
    return place


def numbers_in(folder: Path) -> dict[str, np.ndarray]:
    """Channels of all files of numbers in a ``folder``, by place and name."""
    found = {}
    for path in sorted(folder.rglob("*.exr")):
        channels = read_frame(path)[0]
        found |= {f"{path.relative_to(folder)}:{name}": values for name, values in channels.items()}
    return found


def test_an_image_tells_the_session_that_repeats_it(call: Call, lab: Any, imaged: Path) -> None:
    """Frames, calibration, and how it was solved for."""
    told = call("run", "--from", imaged, "--json")
    assert told.code == 0 and told.payload["warnings"] == [] and told.payload["output"] is None
    tables = told.payload["session"].split("\n\n")
    assert tables[1:] == [
        f'[scene]\nscene = "{lab.scene}"\ncamera = "{lab.camera}"\nprojector = "{lab.projector}"',
        '[capture]\npatterns = "dots:4"\naccuracy = 0.005\nseed = 0',
        "[calibrate]\nseed = 0\naccuracy = 0.005",
        '[[reconstruct]]\nlambda = 200000000.0\nmethod = "tv"\noutput = "smooth"\n',
    ]
    alone = call("run", "--from", lab.calibration, "--json").payload["session"]
    assert "[calibrate]" in alone and "[capture]" not in alone


def test_what_was_changed_since_is_told(call: Call, lab: Any, tmp_path: Path) -> None:
    """A flagged session file, by exit status 1."""
    run = lab.copy("run", tmp_path / "run")
    manifest = json.loads((run / "manifest.json").read_text())
    manifest["configuration"]["scene_sha256"] = "0"
    manifest["configuration"]["sensor"]["bits"] = 10
    (run / "manifest.json").write_text(json.dumps(manifest))
    told = call("run", "--from", run, "-o", tmp_path / "again.toml")
    assert (
        told.code == 1
        and f"{lab.scene} was changed since" in told.err
        and "differs from that in the manifest" in told.err
    )
    assert "# " + f"{lab.scene} was changed since" in (tmp_path / "again.toml").read_text()


def test_what_no_session_makes_is_refused(refused: Refused, lab: Any, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert "holds nothing that a session file repeats" in refused("run", "--from", "empty")
    assert "runs nothing" in refused("run", "--from", lab.run, "--resume")
    assert "give one of both" in refused("run", "x.toml", "--from", lab.run)
    assert "give a session file, or --from FOLDER" in refused("run")
    assert "did you mean demo? " in refused("run", "dmeo")
    assert "-D 'x': give TABLE.FIELD=VALUE" in refused("run", "demo", "-D", "x")
    assert "capture.patterns: 'dotz'" in refused("run", "demo", "-D", "capture.patterns=dotz", "-o", "new")


def test_a_session_predicts_as_the_verb_does(call: Call, lab: Any, tmp_path: Path) -> None:
    """(Planted: the recipe not read; the patterns of the default.)"""
    recipe = 'board_reflectance = 0.9\nexposure_fraction = 2e-3\nsigned_capture = "uniform"\nsource = "a lamp"\n'
    scene = f'[scene]\nscene = "{lab.scene}"\ncamera = "{lab.camera}"\nprojector = "{lab.projector}"\n'
    (tmp_path / "recipe.toml").write_text(recipe)
    (tmp_path / "s.toml").write_text(f'{scene}[predict]\npatterns = "dots:4"\n[predict.recipe]\n{recipe}')
    devices = lab.scene, "--camera", lab.camera, "--projector", lab.projector
    asked = call("predict", *devices, "--patterns", "dots:4", "--recipe", tmp_path / "recipe.toml", "--json")
    done = call("run", tmp_path / "s.toml", "-o", tmp_path / "out", "--json", "--no-pictures")
    found = json.loads((tmp_path / "out" / "predict" / "prediction.json").read_text())
    assert found["psnr"] == asked.payload["psnr"] and found["causes"] == asked.payload["causes"]
    assert done.payload["steps"][0]["says"] == f"Predicted image under dots:4, PSNR {found['psnr']:.1f} dB"
    again = call("run", tmp_path / "s.toml", "-o", tmp_path / "out", "--resume", "--json", "--no-pictures")
    assert done.code == again.code == asked.code and again.payload["steps"][0]["left_alone"]


@pytest.mark.slow
def test_a_session_file_repeats_a_figure_bit_by_bit(call: Call, lab: Any, imaged: Path, tmp_path: Path) -> None:
    """Frames, truth, factors and image of three commands, by one file; and what is finished is left alone: by the same
    file nothing is written, and of another request nothing is lost."""
    ms.session_of(imaged).save(tmp_path / "again.toml")
    done = call("run", tmp_path / "again.toml", "-o", tmp_path / "out", "--json", "--no-pictures")
    assert done.code == 0, done.err
    assert done.payload.keys() == {"headline", "steps", "output", "page", "warnings"}
    keys = {"step", "output", "says", "warnings", "seconds", "page", "left_alone"}
    assert [each.keys() == keys and each["output"] for each in done.payload["steps"]] == [
        "run",
        "calibration",
        "smooth",
    ]
    for before, folder in ((lab.run, "run"), (lab.calibration, "calibration"), (imaged, "smooth")):
        ours, theirs = numbers_in(tmp_path / "out" / folder), numbers_in(before)
        assert ours.keys() == theirs.keys() and theirs
        assert all(np.array_equal(ours[name], values) for name, values in theirs.items()), folder
    times = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*.exr")}
    told = call("run", tmp_path / "out" / "session.toml", "-o", tmp_path / "out", "--resume", "--json")
    assert all(each["left_alone"] for each in told.payload["steps"])
    assert (tmp_path / "out" / "run" / "report.html").is_file()
    assert re.search(
        r"<title>Session out: \w+, [^<]+, \d{4}-\d\d-\d\d ", (tmp_path / "out" / "report.html").read_text()
    )
    other = call("run", tmp_path / "again.toml", "-o", tmp_path / "out", "--resume", "-D", "capture.seed=1")
    assert "holds a run of another configuration (seed differ)" in other.refusal
    assert "seed = 1" not in (tmp_path / "out" / "session.toml").read_text()
    assert times == {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*.exr")}
