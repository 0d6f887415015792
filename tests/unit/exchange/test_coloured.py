"""Coloured runs and runs behind filters exchanged: every line comes back to the bit, or is refused in a line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.exchange.formats import export, import_file
from tests.coloured import mosaic_folders
from tests.exchanged import bytes_of, made

LINES = {"638nm": 638.0, "520nm": 520.0, "445.5nm": 445.5}


@dataclass(frozen=True)
class Coloured:
    """Folders of a run and of a calibration."""

    run: Path
    calibration: Path


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Coloured:
    """Three lines whose frames and factors differ: one without an ambient frame, two at other scales of light."""
    place = tmp_path_factory.mktemp("coloured")
    found = Coloured(place / "run", place / "cal")
    for folder, kind in ((found.run, "colour-run"), (found.calibration, "colour-calibration")):
        folder.mkdir()
        channels = [{"name": name, "wavelength_nm": wavelength} for name, wavelength in LINES.items()]
        # Letter by letter as another program may have written it.
        (folder / "colour.json").write_text(json.dumps({"channels": channels, "kind": kind, "by": "ä"}))
    for scale, name in enumerate(LINES, start=1):
        bench = made(place / f"of {name}", ambient=scale > 1, scale=float(scale))
        bench.run.rename(found.run / name)
        bench.calibration.rename(found.calibration / name)
    return found


@pytest.fixture
def coloured(kept: Coloured, tmp_path: Path) -> Coloured:
    """A copy that a test may change."""
    return Coloured(shutil.copytree(kept.run, tmp_path / "run"), shutil.copytree(kept.calibration, tmp_path / "cal"))


def whole(folder: Path) -> dict[str, dict[str, bytes]]:
    """All files of a coloured folder, by the folder that they are in."""
    parts = [path for path in folder.iterdir() if path.is_dir()]
    return {"": bytes_of(folder), **{path.name: bytes_of(path) for path in parts}}


def test_folders_come_back_to_the_byte_by_hdf5(coloured: Coloured, tmp_path: Path) -> None:
    """(Planted: the first line's frames written for all; colour.json written from its model.)"""
    payload = export(coloured.run, "hdf5", tmp_path / "all.h5", coloured.calibration)
    result = import_file(tmp_path / "all.h5", tmp_path / "run 2", tmp_path / "cal 2")
    assert whole(tmp_path / "run 2") == whole(coloured.run)
    assert whole(tmp_path / "cal 2") == whole(coloured.calibration)
    assert payload["frames"] == result["frames"] == 18 and result["holds"] == ["run", "calibration"]


def test_calibrations_of_other_lines_are_refused(coloured: Coloured, tmp_path: Path) -> None:
    with pytest.raises(MitsimError, match=r"is coloured, but .* is not; give a line's folder"):
        export(coloured.run / "638nm", "hdf5", tmp_path / "x.h5", coloured.calibration)
    with pytest.raises(MitsimError, match=r"holds no colour.json"):
        export(coloured.run, "hdf5", tmp_path / "x.h5", coloured.calibration / "638nm")
    (coloured.calibration / "colour.json").write_text(
        (coloured.calibration / "colour.json").read_text().replace("520", "521")
    )
    with pytest.raises(MitsimError, match="calibrate each line of this projector"):
        export(coloured.run, "hdf5", tmp_path / "x.h5", coloured.calibration)
    assert not (tmp_path / "x.h5").exists()


@pytest.mark.parametrize("format", ["mat", "torch", "png"])
def test_other_formats_hold_one_line(format: str, coloured: Coloured, tmp_path: Path) -> None:
    """(Planted: the first line written for all.)"""
    with pytest.raises(MitsimError, match=f"has several spectral lines, and {format} holds one; use hdf5, or a line's"):
        export(coloured.run, format, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_run_behind_filters_comes_back(tmp_path: Path) -> None:
    """Frames, every line's truth and factors, and colour.json; without truths and calibration, too. (Planted: the first
    line's truth for all.)"""
    run, calibration = mosaic_folders(tmp_path, "dots:2")
    payload = export(run, "hdf5", tmp_path / "a.h5", calibration)
    result = import_file(tmp_path / "a.h5", tmp_path / "run 1", tmp_path / "cal 1")
    assert whole(tmp_path / "run 1") == whole(run) and whole(tmp_path / "cal 1") == whole(calibration)
    assert payload["frames"] == result["frames"] == 4 and result["holds"] == ["run", "calibration"]
    (bare := tmp_path / "bare").mkdir()
    run, _ = mosaic_folders(bare, "dots:2", truths=False)
    export(run, "hdf5", tmp_path / "b.h5")
    import_file(tmp_path / "b.h5", tmp_path / "run 2")
    assert whole(tmp_path / "run 2") == whole(run)
    with pytest.raises(MitsimError, match="holds no calibration"):
        import_file(tmp_path / "b.h5", tmp_path / "run 3", tmp_path / "cal 3")


def test_a_file_that_lost_a_line_leaves_no_folder(coloured: Coloured, tmp_path: Path) -> None:
    def edit(file: h5py.File, name: str, change: Callable[[bytes], bytes]) -> None:
        text = change(file[name][()].tobytes())
        del file[name]
        file[name] = np.frombuffer(text, np.uint8)

    cases: dict[str, Callable[[h5py.File], None]] = {
        "/lines/520nm is missing": lambda file: file.__delitem__("lines/520nm"),
        "has no calibration of 520nm": lambda file: file.__delitem__("lines/520nm/calibration"),
        "not valid JSON": lambda file: edit(file, "colour-run", lambda _: b"{"),
        "holds a colour-calibration": lambda file: edit(
            file, "colour-run", lambda _: file["colour-calibration"][()].tobytes()
        ),
        "called colour.json": lambda file: edit(
            file, "colour-run", lambda text: text.replace(b"520nm", b"colour.json")
        ),
    }
    for words, change in cases.items():
        export(coloured.run, "hdf5", tmp_path / "bad.h5", coloured.calibration, overwrite=True)
        with h5py.File(tmp_path / "bad.h5", "r+") as file:
            change(file)
        with pytest.raises(MitsimError, match=words):
            import_file(tmp_path / "bad.h5", tmp_path / "run 2", tmp_path / "cal 2")
        assert not (tmp_path / "run 2").exists() and not (tmp_path / "cal 2").exists()
