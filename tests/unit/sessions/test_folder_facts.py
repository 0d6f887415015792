"""`mitsim show`: folders of every kind are described from their JSON files, and all others are refused in a line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import typer.main

import mitsim as ms
from mitsim.cli import app
from mitsim.report.reconstruct_run import reconstruct
from tests.exchanged import made


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run, a calibration and an image of them."""
    place = tmp_path_factory.mktemp("facts")
    bench = made(place / "made")
    for name, folder in (("run", bench.run), ("cal", bench.calibration)):
        shutil.copytree(folder, place / name)
    reconstruct(place / "run", place / "cal", place / "image")
    return place


def change(folder: Path, file: str, **values: Any) -> Path:
    """Write ``values`` into a JSON file of a ``folder``, which is made if it is new."""
    folder.mkdir(exist_ok=True)
    path = folder / file
    known = json.loads(path.read_text()) if path.is_file() else {}
    path.write_text(json.dumps({**known, **values}))
    return folder


def test_runs_calibrations_and_images_state_their_numbers(kept: Path) -> None:
    """(Planted: a key of another file; the next command of another kind; a folder's name left out.)"""
    run, cal, image = (ms.show(kept / name) for name in ("run", "cal", "image"))
    assert (run.kind, cal.kind, image.kind) == ("run", "calibration", "image")
    assert run.finished and run.numbers["frames"] == 6 and run.numbers["exposure_s"] == 0.0213
    assert run.next[0] == f"mitsim reconstruct {kept / 'run'} --calibration CAL"
    assert cal.next[0] == f"mitsim reconstruct RUN --calibration {kept / 'cal'}"
    result = json.loads((kept / "image" / "result.json").read_text())
    assert image.numbers["psnr_db"] == result["psnr"] and image.numbers["run"] == str(kept / "run")
    assert repr(run) == "; ".join(run.lines()) and "\n" not in repr(run)


def test_flagged_and_interrupted_work_is_said(kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With status 1. (Planted: status 0; next commands of an interrupted run.)"""
    flagged = change(shutil.copytree(kept / "run", tmp_path / "run"), "manifest.json", warnings=["the lamp was off"])
    begun = change(tmp_path / "begun", "manifest.json", kind="capture", status="incomplete", configuration={})
    program = typer.main.get_command(app)
    for folder, words in ((flagged, "the lamp was off"), (begun, "the work was interrupted")):
        assert program.main(["show", str(folder), "--json"], standalone_mode=False) == 1
        out, err = capsys.readouterr()
        assert words in err and any(words in text for text in json.loads(out)["warnings"])
    assert not ms.show(begun).finished and not ms.show(begun).next and "not finished" in repr(ms.show(begun))
    assert program.main(["show", str(kept / "cal")], standalone_mode=False) == 0


def test_other_kinds_are_known_by_their_files(kept: Path, tmp_path: Path) -> None:
    """Also those whose numbers are in folders inside. (Planted: warnings of parts left out; a study known by its name
    alone; steps of a characterised camera read as a session's.)"""
    claims = [{"verdict": "confirmed"}, {"verdict": "not decided"}]
    study = ms.show(change(tmp_path / "a", "sweep.json", kind="sweep", study="sweep", points=3, claims=claims))
    assert study.kind == "study" and study.numbers["claims"] == "2 (confirmed, not decided)"
    steps = [{"output": "run", "warnings": []}, {"output": "cal", "warnings": ["noisy"]}]
    session = ms.show(change(tmp_path / "b", "session.json", kind="session", steps=steps))
    assert session.numbers["steps"] == "2 (run, cal)" and session.warnings == ("cal: noisy",)
    pairs = ms.show(change(tmp_path / "c", "pairs.json", kind="pairs", count=8, patterns="dots:3"))
    assert pairs.numbers == {"patterns": "dots:3", "pairs": 8} and pairs.next[0].startswith("mitsim train")
    assert ms.show(change(tmp_path / "d", "characterise.json", kind="characterise", steps=50)).kind.endswith("camera")
    lines = change(tmp_path / "e", "colour.json", kind="colour-run", channels=[{"name": "638nm"}, {"name": "520nm"}])
    for name in ("638nm", "520nm"):
        change(shutil.copytree(kept / "run", lines / name), "manifest.json", warnings=["dim"])
    assert ms.show(lines).kind == "colour run" and ms.show(lines).warnings == ("520nm: dim", "638nm: dim")
    assert ms.show(lines).next[0].startswith("mitsim reconstruct")
    shutil.copytree(kept / "cal", tmp_path / "f" / "395.5")
    assert ms.show(tmp_path / "f").kind == "calibration" and "395.5" in ms.show(tmp_path / "f").numbers


@pytest.mark.parametrize(
    ("file", "text", "words"),
    [
        ("letter.txt", "mine", "holds no results of mitsim"),
        ("own.json", '{"kind": "other"}', "holds no results of mitsim"),
        ("own.json", "[1, 2]", "holds no results of mitsim"),
        ("manifest.json", "{", "not valid JSON"),
        ("manifest.json", '{"kind": "capture", "status": "complete"}', "manifest.json: has"),
        ("session.json", '{"kind": "session", "steps": 3}', "is not that of a session"),
        ("colour.json", '{"kind": "colour-image", "channels": [3]}', "is not that of a colour image"),
    ],
)
def test_foreign_and_damaged_folders_are_refused(tmp_path: Path, file: str, text: str, words: str) -> None:
    """(Planted: an exception of Python for a list of numbers.)"""
    (tmp_path / file).write_text(text)
    with pytest.raises(ms.MitsimError, match=words):
        ms.show(tmp_path)
    for path, reason in ((tmp_path / "nosuch", "no such folder"), (tmp_path / file, "is a file")):
        with pytest.raises(ms.MitsimError, match=reason):
            ms.show(path)
