import json
import os
from pathlib import Path

import numpy as np
import pytest

from mitsim.core import manifest
from mitsim.core.errors import MitsimError


def test_json_comes_back(tmp_path: Path) -> None:
    written = {
        "array": np.array([[1.5, 2.0]]),
        "count": np.int64(2**40),
        "where": Path("a/b"),
        "pair": (1, True),
        "none": None,
        "worst": np.inf,
        "name": "µm",
    }
    manifest.write_json(tmp_path / "m.json", written)
    assert manifest.read_json(tmp_path / "m.json") == {
        "array": [[1.5, 2.0]],
        "count": 2**40,
        "where": "a/b",
        "pair": [1, True],
        "none": None,
        "worst": None,
        "name": "µm",
    }
    assert [item.name for item in tmp_path.iterdir()] == ["m.json"]


def test_what_json_cannot_hold_is_refused_and_the_old_file_stays(tmp_path: Path) -> None:
    manifest.write_json(tmp_path / "m.json", {"a": 1})
    with pytest.raises(TypeError, match="object"):
        manifest.write_json(tmp_path / "m.json", {"a": object()})
    assert manifest.read_json(tmp_path / "m.json") == {"a": 1}


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    manifest.write_json(tmp_path / "m.json", {"a": 1})

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(MitsimError, match="No space left"):
        manifest.write_json(tmp_path / "m.json", {"a": 2})
    assert json.loads((tmp_path / "m.json").read_text()) == {"a": 1}
    assert len(list(tmp_path.iterdir())) == 1


def test_reading_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(MitsimError, match=r"m\.json: cannot be read"):
        manifest.read_json(tmp_path / "m.json")
    (tmp_path / "m.json").write_text('{"a": ')
    with pytest.raises(MitsimError, match=r"m\.json: not valid JSON"):
        manifest.read_json(tmp_path / "m.json")


def test_prepare_output_makes_the_folder(tmp_path: Path) -> None:
    assert manifest.prepare_output(str(tmp_path / "run")) == tmp_path / "run"
    assert (tmp_path / "run").is_dir()
    manifest.prepare_output(tmp_path / "run")  # empty: still free
    (tmp_path / "run" / "frame").touch()
    with pytest.raises(MitsimError, match="holds files already"):
        manifest.prepare_output(tmp_path / "run")
    manifest.prepare_output(tmp_path / "run", overwrite=True)
    assert (tmp_path / "run" / "frame").exists()


def test_prepare_output_refuses_before_work(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path, reason in [
        (tmp_path / "no" / "run", "does not exist"),
        (tmp_path / "file", "is a file"),
        (tmp_path / "file" / "run", "does not exist"),
    ]:
        with pytest.raises(MitsimError, match=reason):
            manifest.prepare_output(path)


def test_prepare_output_for_a_file(tmp_path: Path) -> None:
    path = tmp_path / "frame.exr"
    assert manifest.prepare_output(path, kind="file") == path
    assert not path.exists()
    path.touch()
    with pytest.raises(MitsimError, match="exists already"):
        manifest.prepare_output(path, kind="file")
    manifest.prepare_output(path, overwrite=True, kind="file")
    with pytest.raises(MitsimError, match="is a folder"):
        manifest.prepare_output(tmp_path, kind="file")


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_a_place_that_takes_no_files_is_refused(kind: str) -> None:
    # /proc takes no new files from anyone, root included.
    if not Path("/proc/self").is_dir():
        pytest.skip("needs /proc")
    with pytest.raises(MitsimError, match="output /proc/mitsim"):
        manifest.prepare_output(Path("/proc/mitsim"), kind=kind)


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_a_folder_without_write_access_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    # Root may write anywhere, so the read-only file system is played.
    def refuse(dir: Path) -> None:
        raise OSError(30, f"Read-only file system: {dir}")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    path = tmp_path / "frame.exr" if kind == "file" else tmp_path
    with pytest.raises(MitsimError, match="not writable"):
        manifest.prepare_output(path, kind=kind)


def test_versions_names_what_decides_the_numbers() -> None:
    versions = manifest.versions()
    assert {"mitsim", "mitsuba", "drjit", "numpy", "python"} <= set(versions)
    assert versions["numpy"] == np.__version__
