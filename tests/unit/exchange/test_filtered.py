"""Runs behind colour filters exchanged: frames, lines and factors come back to the bit, and mean what the page says."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat, savemat

import mitsim as ms
from mitsim.core.errors import MitsimError
from mitsim.exchange import labelled
from mitsim.exchange.formats import export, import_file
from mitsim.reconstruct.colour import behind
from tests.coloured import WEIGHTS, mosaic_folders
from tests.unit.exchange.test_coloured import octave, whole

LINES = "638nm", "520nm", "445nm"


@pytest.fixture(scope="module", params=[False, True], ids=["dark", "lit"])
def folders(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """In a dark room, and under a lamp that every filter counts for itself."""
    return mosaic_folders(tmp_path_factory.mktemp("filters"), "dots:2", lamp=request.param)


def same_folders(again: Path, first: Path) -> None:
    """To the bit; the frames' numbers at least, where a file keeps no metadata of them."""
    found, expected = whole(again), whole(first)
    assert np.array_equal(ms.load_run(again).dn, ms.load_run(first).dn)
    assert found[""]["colour.json"] == expected[""].pop("colour.json") and found[""].keys() >= expected[""].keys()
    assert {name: found[name] for name in found if name} == {name: expected[name] for name in expected if name}


@pytest.mark.parametrize(("format", "name"), [("hdf5", "all.h5"), ("mat", "all.mat")])
def test_folders_come_back(format: str, name: str, folders: tuple[Path, Path], tmp_path: Path) -> None:
    """Frames, every line's truth and factors, and colour.json. (Planted: the first line's truth for all.)"""
    run, calibration = folders
    payload = export(run, format, tmp_path / name, calibration)
    result = import_file(tmp_path / name, tmp_path / "run", tmp_path / "cal")
    same_folders(tmp_path / "run", run)
    assert whole(tmp_path / "cal") == whole(calibration)
    assert payload["frames"] == result["frames"] == 4 and result["holds"] == ["run", "calibration"]


@pytest.mark.parametrize(("format", "name"), [("hdf5", "all.h5"), ("mat", "all.mat")])
def test_a_run_without_truths_and_calibration(format: str, name: str, tmp_path: Path) -> None:
    """As of a real camera."""
    run, _ = mosaic_folders(tmp_path, "dots:2", truths=False)
    export(run, format, tmp_path / name)
    import_file(tmp_path / name, tmp_path / "run 2")
    same_folders(tmp_path / "run 2", run)
    with pytest.raises(MitsimError, match="holds no calibration"):
        import_file(tmp_path / name, tmp_path / "run 3", tmp_path / "cal 3")


def expected_of(held: dict[str, np.ndarray], i: int, j: int) -> np.ndarray:
    """What the page says that `data_coded` less `measBg` is, of the file's own variables."""
    light = np.outer(held["PL"][:, i], held["PR"][:, j])
    seen = [held[f"phi_left_{name}"] @ (light * held[f"truth_{name}"]) @ held[f"phi_right_{name}"].T for name in LINES]
    return np.einsum("lij,lij->ij", behind(held["weights"], seen[0].shape), seen)


def test_the_variables_are_the_papers_model_behind_filters(folders: tuple[Path, Path], tmp_path: Path) -> None:
    """(Planted: rows and columns of the filters changed places.)"""
    export(folders[0], "mat", tmp_path / "all.mat", folders[1])
    held = loadmat(tmp_path / "all.mat")
    assert np.array_equal(held["weights"], WEIGHTS)
    found = held["data_coded"][:, :, 1, 0] - held["measBg"]
    # Shot noise of 3e4 electrons is 0.6 %.
    assert np.abs(found - expected_of(held, 1, 0)).mean() < 0.01 * found.mean()


@octave
def test_octave_reads_and_writes_every_line(folders: tuple[Path, Path], tmp_path: Path) -> None:
    export(folders[0], "mat", tmp_path / "all.mat", folders[1])
    script = """
a = load('all.mat');
seen = 0;
names = {'638nm', '520nm', '445nm'};
for l = 1:3
  lit = (a.PL(:,2) * a.PR(:,1)') .* double(a.(['truth_' names{l}]));
  filters = repmat(reshape(a.weights(:,l), 2, 2)', size(a.measBg) / 2);
  seen = seen + filters .* (a.(['phi_left_' names{l}]) * lit * a.(['phi_right_' names{l}])');
end
printf('%.17g', sum(seen(:)));
save('-v7', 'again.mat', '-struct', 'a');
"""
    call = ["octave-cli", "--quiet", "--norc", "--eval", script]
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == pytest.approx(expected_of(loadmat(tmp_path / "all.mat"), 1, 0).sum(), rel=1e-9)
    import_file(tmp_path / "again.mat", tmp_path / "run", tmp_path / "cal")
    same_folders(tmp_path / "run", folders[0])
    assert whole(tmp_path / "cal") == whole(folders[1])


def test_tensors_are_of_all_lines(folders: tuple[Path, Path], tmp_path: Path) -> None:
    """Sums of the lines, each by its own factors and weights, are what was measured, but for noise."""
    torch = pytest.importorskip("torch")
    export(folders[0], "torch", tmp_path / "run.pt", folders[1])
    held = {name: each.numpy() for name, each in torch.load(tmp_path / "run.pt", weights_only=True).items()}
    assert np.array_equal(held["y"], labelled.measurements(ms.load_run(folders[0])))
    columns, rows = held["P_R"].shape[1], held["y"].shape[1:]
    for index, frame in enumerate(held["y"]):
        lit = np.outer(held["P_L"][:, index // columns], held["P_R"][:, index % columns]) * held["x"]
        lines = held["left"] @ lit @ held["right"].transpose(0, 2, 1) * behind(held["weights"], rows)
        assert np.abs(lines.sum(0) - frame).mean() < 0.01 * held["y"].mean()


def test_pictures_know_no_filters(folders: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(MitsimError, match=r"is behind colour filters, of which png .*; use hdf5, mat, torch"):
        export(folders[0], "png", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_does_not_fit_is_refused_and_no_folder_is_left(folders: tuple[Path, Path], tmp_path: Path) -> None:
    other = shutil.copytree(folders[1], tmp_path / "other")
    (other / "colour.json").write_text((other / "colour.json").read_text().replace("520", "521"))
    with pytest.raises(MitsimError, match="calibrate each line of this projector"):
        export(folders[0], "hdf5", tmp_path / "all.h5", other)
    export(folders[0], "mat", tmp_path / "all.mat", folders[1])
    held = {key: value for key, value in loadmat(tmp_path / "all.mat").items() if not key.startswith("__")}
    colours = json.loads(held["mosaic_run"].item())
    wrong = [{**line, "name": "frame_00000.exr"} for line in colours["channels"]]
    cases = {
        "RGGB": {**held, "mosaic_run": json.dumps({**colours, "mosaic": "RGB"})},
        "give each of the four": {**held, "mosaic_run": json.dumps({**colours, "weights": [[1.0]] * 4})},
        "a line is called frame_00000.exr": {
            **held,
            "mosaic_run": json.dumps({**colours, "channels": [wrong[0], *colours["channels"][1:]]}),
        },
        "has calibrations of 638nm, 445nm": {key: held[key] for key in held if key != "calibration_manifest_520nm"},
    }
    for words, variables in cases.items():
        savemat(tmp_path / "bad.mat", variables, long_field_names=True)
        with pytest.raises(MitsimError, match=words):
            import_file(tmp_path / "bad.mat", tmp_path / "run", tmp_path / "cal")
        assert not (tmp_path / "run").exists() and not (tmp_path / "cal").exists()
