"""A run in one HDF5 file: folders come back to the byte, frames are read one at a time, and no file leads astray."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import mitsim as ms
from mitsim.core.errors import MitsimError
from mitsim.core.exr import read_frame, write_frame
from mitsim.exchange import packed
from mitsim.exchange.formats import export, import_file
from mitsim.exchange.packed import load_hdf5
from tests.exchanged import CASES, COLUMNS, ROWS, SCENE, Made, bytes_of, made


@pytest.fixture
def bench(tmp_path: Path) -> Made:
    return made(tmp_path, ambient=True)


def exported(bench: Made, tmp_path: Path) -> Path:
    export(bench.run, "hdf5", tmp_path / "all.h5", bench.calibration)
    return tmp_path / "all.h5"


def damaged(path: Path, channel: str, shot: int) -> Path:
    with h5py.File(path, "r") as file:
        place, size = file[f"run/shots/{channel}"].id.get_chunk_info(shot)[2:4]
    content = bytearray(path.read_bytes())
    content[place + size // 2] ^= 0xFF
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("case", CASES)
def test_folders_come_back_to_the_byte(case: str, tmp_path: Path) -> None:
    """Frames, truth, ambient frame, metadata and manifests. (Planted: metadata of frames left out; the manifest written
    from its model, which puts `null` where a field is not stated.)"""
    bench = made(tmp_path, **CASES[case])
    # As other programs write it: what comes back is the file, not what its model says.
    manifest = json.loads((bench.calibration / "manifest.json").read_text())
    (bench.calibration / "manifest.json").write_text(json.dumps({key: manifest[key] for key in sorted(manifest)}))
    result = import_file(exported(bench, tmp_path), tmp_path / "run 2", tmp_path / "cal 2")
    assert bytes_of(tmp_path / "run 2") == bytes_of(bench.run)
    assert bytes_of(tmp_path / "cal 2") == bytes_of(bench.calibration)
    assert result["holds"] == ["run", "calibration"] and result["left_out"] == []


def test_the_layout_is_that_of_the_documentation(bench: Made, tmp_path: Path) -> None:
    shots = ms.load_run(bench.run)
    with h5py.File(exported(bench, tmp_path), "r") as file:
        assert file.attrs["mitsim_exchange"] == 1
        assert file["run/shots/DN"].shape == (6, ROWS, COLUMNS) and file["run/shots/DN"].chunks == (1, ROWS, COLUMNS)
        assert np.array_equal(file["run/shots/DN"], shots.dn)
        assert np.array_equal(file["run/P_R"], shots.patterns[1]) and file["run/P_L"].shape == (SCENE[0], 2)
        assert file["run/pattern"][4].tolist() == [1, 1, 0]
        assert json.loads(file["run/metadata"][4])["index"] == 4
        assert np.array_equal(file["run/truth/reflectance"], bench.scene.astype(np.float32))
        assert file["calibration/right/factor"].shape == (COLUMNS, SCENE[1])
        assert file["run/manifest"][()].tobytes().decode() == (bench.run / "manifest.json").read_text()


def test_a_shot_is_read_without_the_others(bench: Made, tmp_path: Path) -> None:
    """(Planted: the stack fetched as a whole.)"""
    path = damaged(exported(bench, tmp_path), "DN", 3)
    with load_hdf5(path) as (folders, *_):
        run = folders.parts[""]
        names = [shot.file for shot in run.manifest.patterns.captures]
        for index in (0, 1, 2, 4, 5):
            assert np.array_equal(run.read(names[index])[0]["DN"], read_frame(bench.run / names[index])[0]["DN"])
        with pytest.raises(MitsimError, match="damaged"):
            run.read(names[3])


def test_a_damaged_file_leaves_no_folder(bench: Made, tmp_path: Path) -> None:
    """Not the calibration's either, which was whole. (Planted: each folder finished before the next.)"""
    path = damaged(exported(bench, tmp_path), "electrons", 5)
    with pytest.raises(MitsimError, match="damaged"):
        import_file(path, tmp_path / "run 2", tmp_path / "cal 2")
    assert not (tmp_path / "run 2").exists() and not (tmp_path / "cal 2").exists()


def put(name: str, change: Callable[[Any], Any]) -> Callable[[h5py.File], None]:
    """Put in the place of an array what ``change`` makes of it."""

    def edit(file: h5py.File) -> None:
        held = file[name][()] if isinstance(file[name], h5py.Dataset) else None
        del file[name]
        file[name] = change(held)

    return edit


def renamed(text: np.ndarray) -> np.ndarray:
    return np.frombuffer(text.tobytes().replace(b'"frame_00002.exr"', b'"manifest.json"  '), np.uint8)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda file: file.attrs.pop("mitsim_exchange"), "no HDF5 file of `mitsim export`"),
        (lambda file: file.attrs.update(mitsim_exchange=2), "mitsim_exchange is 2"),
        (put("run/truth", lambda _: h5py.ExternalLink("/etc/passwd", "/")), "/run/truth is a link"),
        (put("run/shots/DN", lambda frames: frames[:5]), "6 x rows x columns"),
        (put("run/manifest", renamed), "a frame is called 'manifest.json'"),
    ],
)
def test_a_file_that_is_no_run_is_refused(bench: Made, tmp_path: Path, edit: Any, words: str) -> None:
    path = exported(bench, tmp_path)
    with h5py.File(path, "a") as file:
        edit(file)
    with pytest.raises(MitsimError, match=words):
        import_file(path, tmp_path / "run 2")
    assert not (tmp_path / "run 2").exists()


def test_frames_that_differ_in_shape_are_refused_and_no_file_is_left(bench: Made, tmp_path: Path) -> None:
    manifest = json.loads((bench.run / "manifest.json").read_text())
    (bench.run / "manifest.json").write_text(json.dumps({**manifest, "checksums": {}}))
    write_frame(bench.run / "frame_00003.exr", {"DN": np.ones((3, 4), np.uint32)}, {})
    with pytest.raises(MitsimError, match=r"frame_00003.exr: holds DN \(uint32 3 4\)"):
        exported(bench, tmp_path)
    assert not (tmp_path / "all.h5").exists() and not list(tmp_path.glob(".*"))


def test_checksums_follow_the_bytes_that_were_written(bench: Made, tmp_path: Path) -> None:
    """Where OpenEXR writes otherwise the folder is still one that can be read."""
    run = packed.pack_run(bench.run)
    other = packed.Packed(run.manifest, run.text, run.names, lambda name: (run.read(name)[0], {}), run.place)
    (tmp_path / "run 2").mkdir()
    other.fill(tmp_path / "run 2")
    shots = ms.load_run(tmp_path / "run 2")
    assert np.array_equal(shots.dn, ms.load_run(bench.run).dn)
    assert shots.manifest.checksums != run.manifest.checksums


@pytest.mark.parametrize(
    ("name", "made_so", "words"),
    [
        ("run/shots/DN", {"shape": (6, 8000, 8000), "dtype": "u4", "chunks": (1, 8000, 8000)}, "not all is stored"),
        ("run/manifest", {"shape": (1 << 40,), "dtype": "u1", "chunks": (1 << 20,)}, "not all is stored"),
        ("run/manifest", {"shape": None, "dtype": "u1"}, "manifest is empty"),
        ("run/truth/reflectance", {"data": np.zeros((9, 9), "f4"), "compression": "lzf"}, "filters other than gzip"),
        ("run/truth/reflectance", {"data": np.zeros((9, 9), "f4")}, "truth.exr is no frame .*all must be one"),
    ],
)
def test_what_is_not_stored_takes_no_memory(
    bench: Made, tmp_path: Path, name: str, made_so: dict[str, Any], words: str
) -> None:
    """It would be read as zeros, terabytes of them. (Planted: read as h5py gives it; one test took 6 GB.)"""
    path = exported(bench, tmp_path)
    with h5py.File(path, "r+") as file:
        del file[name]
        file.create_dataset(name, **made_so)
    with pytest.raises(MitsimError, match=words):
        import_file(path, tmp_path / "run 2")
    assert not (tmp_path / "run 2").exists()


def test_a_file_that_is_cut_while_it_is_read_is_refused(bench: Made, tmp_path: Path) -> None:
    """Packed or plain: HDF5 reads zeros behind the end. (Planted: no look at the size; the last frames are black.)"""
    path = exported(bench, tmp_path)
    with h5py.File(path, "r+") as file:
        frames = file["run/shots/DN"][()]
        del file["run/shots/DN"]
        file["run/shots/DN"] = frames
    with load_hdf5(path) as (folders, *_):
        run = folders.parts[""]
        names = run.names
        run.read(names[5])
        os.truncate(path, path.stat().st_size - 100)
        with pytest.raises(MitsimError, match="cut short while it was read"):
            run.read(names[5])
