"""Coloured runs exchanged: every line comes back to the bit, and what no format holds is refused in a line."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image
from scipy.io import loadmat, savemat

import mitsim as ms
from mitsim.core.errors import MitsimError
from mitsim.exchange import labelled
from mitsim.exchange.capture_list import CaptureList, RealCapture
from mitsim.exchange.formats import export, import_file
from mitsim.exchange.real import import_capture
from tests.exchanged import COLUMNS, ROWS, SCENE, Made, bytes_of, made
from tests.unit.exchange.test_real import known

octave = pytest.mark.skipif(shutil.which("octave-cli") is None, reason="GNU Octave is not installed")
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


def test_folders_come_back_by_mat(coloured: Coloured, tmp_path: Path) -> None:
    """All but the expected electrons. (Planted: all lines read by the first one's ending.)"""
    export(coloured.run, "mat", tmp_path / "all.mat", coloured.calibration)
    import_file(tmp_path / "all.mat", tmp_path / "run 2", tmp_path / "cal 2")
    assert whole(tmp_path / "cal 2") == whole(coloured.calibration)
    assert (tmp_path / "run 2" / "colour.json").read_bytes() == (coloured.run / "colour.json").read_bytes()
    for name in LINES:
        same_run(coloured.run / name, tmp_path / "run 2" / name)


def test_each_line_has_the_papers_variables(coloured: Coloured, tmp_path: Path) -> None:
    """phi_left_638nm (P o X) phi_right_638nm' = data_coded_638nm - measBg_638nm, of no other line."""
    export(coloured.run, "mat", tmp_path / "all.mat", coloured.calibration)
    held = loadmat(tmp_path / "all.mat")
    for end in ("638nm", "520nm", "445_5nm"):
        lit = np.outer(held[f"PL_{end}"][:, 1], held[f"PR_{end}"][:, 2]) * held[f"truth_{end}"]
        found = held[f"data_coded_{end}"][:, :, 1, 2] - held[f"measBg_{end}"]
        expected = held[f"phi_left_{end}"] @ lit @ held[f"phi_right_{end}"].T
        assert found.sum() == pytest.approx(expected.sum(), rel=0.02)


@octave
def test_octave_reads_and_writes_every_line(coloured: Coloured, tmp_path: Path) -> None:
    export(coloured.run, "mat", tmp_path / "all.mat", coloured.calibration)
    script = """
a = load('all.mat');
found = a.data_coded_520nm(:,:,2,3) - a.measBg_520nm;
expected = a.phi_left_520nm * ((a.PL_520nm(:,2) * a.PR_520nm(:,3)') .* double(a.truth_520nm)) * a.phi_right_520nm';
printf('%.17g %.17g\\n', sum(found(:)), sum(expected(:)));
save('-v7', 'again.mat', '-struct', 'a');
"""
    call = ["octave-cli", "--quiet", "--norc", "--eval", script]
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found, expected = (float(number) for number in done.stdout.split())
    assert found == pytest.approx(expected, rel=0.02)
    import_file(tmp_path / "again.mat", tmp_path / "run 2", tmp_path / "cal 2")
    assert whole(tmp_path / "cal 2") == whole(coloured.calibration)
    for name in LINES:
        assert np.array_equal(ms.load_run(tmp_path / "run 2" / name).dn, ms.load_run(coloured.run / name).dn)


def test_tensors_have_an_axis_of_lines(coloured: Coloured, tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    export(coloured.run, "torch", tmp_path / "run.pt", coloured.calibration)
    held = torch.load(tmp_path / "run.pt", weights_only=True)
    assert held["wavelengths_nm"].tolist() == [*LINES.values()]
    assert held["y"].shape == (3, 6, ROWS, COLUMNS) and held["x"].shape == (3, *SCENE)
    for index, name in enumerate(LINES):
        shots, factors = ms.load_run(coloured.run / name), ms.load_calibration(coloured.calibration / name)
        assert np.array_equal(held["y"][index].numpy(), labelled.measurements(shots))
        assert np.array_equal(held["left"][index].numpy(), factors.left)


def test_lines_under_other_patterns_are_no_tensor(
    coloured: Coloured, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """(Planted: their patterns not compared; the first line's stand for all.)"""
    monkeypatch.setitem(sys.modules, "torch", ModuleType("torch"))  # refused before torch is needed
    place = coloured.run / "520nm" / "manifest.json"
    manifest = json.loads(place.read_text())
    manifest["patterns"]["P_L"] = manifest["patterns"]["P_L"][::-1]
    place.write_text(json.dumps(manifest))
    with pytest.raises(MitsimError, match="lines differ in their patterns; use the format hdf5"):
        export(coloured.run, "torch", tmp_path / "run.pt", coloured.calibration)
    assert not (tmp_path / "run.pt").exists()


def same_run(first: Path, again: Path) -> None:
    """All of a run but the expected electrons."""
    one, other = ms.load_run(first), ms.load_run(again)
    assert (
        np.array_equal(other.dn, one.dn) and other.dn.dtype == one.dn.dtype and np.array_equal(other.truth, one.truth)
    )
    assert (other.ambient is None) == (one.ambient is None) and other.fingerprint == one.fingerprint


def test_pictures_of_every_line_are_read_again(coloured: Coloured, tmp_path: Path) -> None:
    """By the notes of the export, with the names put in. (Planted: the first line's frames for all.)"""
    known(Made(coloured.run / "638nm", coloured.calibration / "638nm", np.zeros(SCENE)))  # writes its camera's file
    projector = tmp_path / "projector.toml"
    projector.write_text('name = "p"\neffective_wavelength_nm = 550.0\ncolumns = 96\nrows = 54\n')
    notes = export(coloured.run, "png", tmp_path / "out", projector=str(projector))["notes"]
    assert (tmp_path / "out" / "colour.json").read_bytes() == (coloured.run / "colour.json").read_bytes()
    assert notes[0] == f"Begin with: mkdir RUN; cp {tmp_path / 'out' / 'colour.json'} RUN"
    (tmp_path / "run 2").mkdir()
    for name, note in zip(LINES, notes[1:], strict=False):
        with Image.open(tmp_path / "out" / name / "frames" / "frame_00005.png") as picture:
            assert np.array_equal(np.array(picture), ms.load_run(coloured.run / name).dn[5])
        words = note.split("mitsim import ")[1].split()
        options = dict(zip(words[1::2], words[2::2], strict=True))
        assert options["-o"] == f"RUN/{name}" and options["--calibration"] == f"CAL/{name}"
        ambient = {"ambient": options["--ambient-frame"], "ambient_shots": 5} if "--ambient-frame" in options else {}
        about = RealCapture(
            CaptureList(patterns=options["--patterns"], **ambient), str(coloured.run / "camera.toml"),
            float(options["--exposure"]), coloured.calibration / name,
        )  # fmt: skip
        import_capture(Path(words[0]), tmp_path / "run 2" / name, about)
        first, again = ms.load_run(coloured.run / name), ms.load_run(tmp_path / "run 2" / name)
        assert np.array_equal(again.dn, first.dn) and (again.ambient is None) == (first.ambient is None)
        assert again.manifest.patterns.captures == first.manifest.patterns.captures


def test_calibrations_of_other_lines_are_refused(coloured: Coloured, tmp_path: Path) -> None:
    with pytest.raises(MitsimError, match=r"is coloured, but .* is not; give a line's folder"):
        export(coloured.run / "638nm", "mat", tmp_path / "x.mat", coloured.calibration)
    with pytest.raises(MitsimError, match=r"holds no colour.json"):
        export(coloured.run, "mat", tmp_path / "x.mat", coloured.calibration / "638nm")
    (coloured.calibration / "colour.json").write_text(
        (coloured.calibration / "colour.json").read_text().replace("520", "521")
    )
    with pytest.raises(MitsimError, match="calibrate each line of this projector"):
        export(coloured.run, "hdf5", tmp_path / "x.h5", coloured.calibration)
    assert not (tmp_path / "x.h5").exists()


def renamed(coloured: Coloured, name: str, new: str) -> None:
    for folder in (coloured.run, coloured.calibration):
        place = folder / "colour.json"
        place.write_text(place.read_text().replace(f'"{name}"', f'"{new}"'))
        (folder / name).rename(folder / new)


@pytest.mark.parametrize("new", ["red", "445_5nm", "4" + "5" * 31])
def test_a_line_that_no_variable_can_end_in_goes_by_hdf5(new: str, coloured: Coloured, tmp_path: Path) -> None:
    """One that begins with a letter may end another variable; two names may be the same to MATLAB; one is too long."""
    renamed(coloured, "520nm", new)
    with pytest.raises(MitsimError, match="no variable of MATLAB can end in"):
        export(coloured.run, "mat", tmp_path / "all.mat", coloured.calibration)
    export(coloured.run, "hdf5", tmp_path / "all.h5", coloured.calibration)
    import_file(tmp_path / "all.h5", tmp_path / "run 2", tmp_path / "cal 2")
    assert whole(tmp_path / "run 2") == whole(coloured.run)


def test_a_file_that_lost_a_line_leaves_no_folder(coloured: Coloured, tmp_path: Path) -> None:
    export(coloured.run, "mat", tmp_path / "all.mat", coloured.calibration)
    held = {key: value for key, value in loadmat(tmp_path / "all.mat").items() if not key.startswith("__")}
    cases = {
        "run_manifest": {key: value for key, value in held.items() if not key.endswith("520nm")},
        "calibrations of 638nm, 445.5nm": {key: held[key] for key in held if key != "calibration_manifest_520nm"},
        "holds a colour-calibration": {**held, "colour_run": held["colour_calibration"]},
        "not valid JSON": {**held, "colour_run": "{"},
        "called colour.json": {**held, "colour_run": str(held["colour_run"].item()).replace("520nm", "colour.json")},
    }
    for words, variables in cases.items():
        savemat(tmp_path / "bad.mat", variables, long_field_names=True)
        with pytest.raises(MitsimError, match=words):
            import_file(tmp_path / "bad.mat", tmp_path / "run 2", tmp_path / "cal 2")
        assert not (tmp_path / "run 2").exists() and not (tmp_path / "cal 2").exists()
