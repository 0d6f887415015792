"""HDF5 and MATLAB files of runs: folders come back to the byte, frames are read one at a time, no file leads astray.

The paper's and FlatCam's variables mean what they say, and SciPy and Octave read them.
"""

from __future__ import annotations

import json
import os
import shutil
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.io import loadmat, savemat, whosmat

import mitsim as ms
from mitsim.core import arrays
from mitsim.core.errors import MitsimError
from mitsim.core.exr import read_frame, write_frame
from mitsim.exchange import packed
from mitsim.exchange.formats import export, import_file
from mitsim.exchange.packed import load_hdf5
from tests.coloured import mosaic_folders
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


# ---- Coloured runs, and runs behind filters ----


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
    with pytest.raises(MitsimError, match="contains no calibration"):
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


# ---- MATLAB files ----


@pytest.mark.parametrize("case", CASES)
def test_the_papers_variables_are_its_model(case: str, tmp_path: Path) -> None:
    """phi_left (P o X) phi_right' = data_coded - measBg for every pattern, but for the noise, a few digital numbers."""
    bench = made(tmp_path, **CASES[case])
    export(bench.run, "mat", tmp_path / "all.mat", bench.calibration)
    held = loadmat(tmp_path / "all.mat")
    left, right = held["PL"], held["PR"]
    assert held["data_coded"].shape == (ROWS, COLUMNS, left.shape[1], right.shape[1])
    for i in range(left.shape[1]):
        for j in range(right.shape[1]):
            lit = np.outer(left[:, i], right[:, j]) * bench.scene
            found = held["data_coded"][:, :, i, j] - held["measBg"]
            expected = held["phi_left"] @ lit @ held["phi_right"].T
            # Shot and read noise of some 1e4 electrons: 40 DN at most; a wrong scale, sign or order is hundreds.
            assert np.abs(found - expected).mean() < 0.05 * np.abs(expected).mean() + 30


def test_a_file_that_is_no_flatcams_is_refused_and_no_folder_is_left(tmp_path: Path) -> None:
    """A run goes back by HDF5 alone."""
    sides = {"P1b": np.ones((50, 16)), "Q1b": np.ones((62, 18))}

    def refused(words: str, channel: str | None = "b", **values: object) -> None:
        savemat(tmp_path / "a.mat", {name: v for name, v in {**sides, **values}.items() if v is not None})
        with pytest.raises(MitsimError, match=words):
            import_file(tmp_path / "a.mat", None, tmp_path / "cal", channel)
        assert not (tmp_path / "cal").exists()

    refused("channel is not given, .* take runs back by the format hdf5", channel=None)
    refused("P1gr is missing", channel="gr")
    refused("Q1b is missing", Q1b=None)
    refused("P1b is <U4 of shape", P1b="none")
    refused(r"P1b is float64 of shape \(16, 50\); a matrix of sensor pixels x fewer", P1b=np.ones((16, 50)))
    (tmp_path / "text.mat").write_text("P1b")
    with pytest.raises(MitsimError, match="no MATLAB file"):
        import_file(tmp_path / "text.mat", None, tmp_path / "cal", "b")
    with h5py.File(tmp_path / "new.mat", "w") as file:
        file["P1b"] = sides["P1b"]
    with pytest.raises(MitsimError, match="no MATLAB file"):
        import_file(tmp_path / "new.mat", None, tmp_path / "cal", "b")


def test_a_run_larger_than_such_a_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrays, "LARGEST_VARIABLE", 1000)
    with pytest.raises(MitsimError, match=r"data_coded takes .* hdf5"):
        export(made(tmp_path).run, "mat", tmp_path / "all.mat")
    assert not (tmp_path / "all.mat").exists()


@pytest.mark.parametrize("angle", [0.0, -0.4])
def test_a_plane_of_a_real_flatcams_calibration(angle: float, tmp_path: Path) -> None:
    """Its factors are of frames without means; how far frames are turned is told, and kept. (Planted: P1 and Q1 changed
    places; factors that are not said to be centred.)"""
    rng = np.random.default_rng(5)
    sides = {
        f"{stem}{name}": rng.normal(size=size)
        for stem, size in (("P1", (50, 16)), ("Q1", (62, 18)))
        for name in ("r", "gb", "gr", "b")
    }
    savemat(tmp_path / "calib.mat", {**sides, "cSize": [[50.0, 62.0]], "angle": angle})
    result = import_file(tmp_path / "calib.mat", None, tmp_path / "cal", "gr")
    factors = ms.load_calibration(tmp_path / "cal")
    assert np.array_equal(factors.left, sides["P1gr"].astype(np.float32)) and factors.right.shape == (62, 18)
    assert factors.manifest.centre and factors.manifest.board_reflectance is None
    assert result["holds"] == ["calibration"] and result["output"] is None
    assert not result["warnings"] and factors.ok and bool(result["notes"]) == bool(angle)
    assert factors.manifest.configuration == ({"turn_deg": angle} if angle else {})
    import_file(tmp_path / "calib.mat", None, tmp_path / "cals", "all")
    for name in ("r", "gb", "gr", "b"):
        factors = ms.load_calibration(tmp_path / "cals" / name)
        assert np.array_equal(factors.right, sides[f"Q1{name}"].astype(np.float32))
        assert factors.manifest.camera == {"name": "calib", "channel": name}
    with pytest.raises(MitsimError, match="use r, gb, gr, b"):
        import_file(tmp_path / "calib.mat", None, tmp_path / "cal 2", "green")
    with pytest.raises(MitsimError, match="contains no run"):
        import_file(tmp_path / "calib.mat", tmp_path / "run", None, "r")


def element(kind: int, content: bytes, order: str = "<") -> bytes:
    """An element of a MATLAB file of version 5."""
    return struct.pack(f"{order}2I", kind, len(content)) + content + bytes(-len(content) % 8)


def matrix(name: bytes, kind: int, sides: tuple[int, ...], content: bytes, flags: int = 0, order: str = "<") -> bytes:
    """An array of a class; its ``content`` are elements."""
    shape = struct.pack(f"{order}{len(sides)}i", *sides)
    head = element(6, struct.pack(f"{order}2I", flags << 8 | kind, 0), order)
    return element(14, head + element(5, shape, order) + element(1, name, order) + content, order)


def mat(*parts: bytes, packed: bool = False, order: str = "<") -> bytes:
    """A MATLAB file of these elements."""
    mark = b"IM" if order == "<" else b"MI"
    held = [element(15, zlib.compress(part))[: 8 + len(zlib.compress(part))] if packed else part for part in parts]
    return b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack(f"{order}H", 0x100) + mark + b"".join(held)


def nested(depth: int) -> bytes:
    """A cell in a cell in a cell."""
    held = b""
    for _ in range(depth):
        held = matrix(b"", 1, (1, 1), held)
    return held


NUMBER = element(9, struct.pack("<d", 2.5))


@pytest.mark.parametrize("packed", [False, True])
def test_what_is_no_array_is_not_looked_into(tmp_path: Path, packed: bool) -> None:
    """SciPy calls itself for every cell in a cell until the process ends. (Planted: all variables read, which did.)"""
    deep = matrix(b"deep", 1, (1, 1), nested(8000)) if packed else matrix(b"deep", 1, (1, 1), nested(3000))
    others = (
        deep,
        matrix(b"record", 2, (1, 1), element(5, struct.pack("<i", 8)) + element(1, b"a\0\0\0\0\0\0\0") + NUMBER),
        matrix(b"call", 16, (1, 1), matrix(b"", 6, (1, 1), NUMBER)),
        matrix(b"wave", 6, (1, 1), NUMBER + NUMBER, flags=0x08),
        matrix(b"scarce", 5, (1, 1), NUMBER),
    )
    (tmp_path / "a.mat").write_bytes(mat(*others, matrix(b"P1b", 6, (1, 1), NUMBER), packed=packed))
    assert {name: value for name, value in arrays.read_variables(tmp_path / "a.mat").items() if name[0] != "_"} == {
        "P1b": [[2.5]]
    }


@pytest.mark.parametrize("order", ["<", ">"])
def test_arrays_are_listed_as_scipy_lists_them(tmp_path: Path, order: str) -> None:
    known = {
        "a": np.arange(6.0).reshape(2, 3),
        "text": "one \u00b5m",
        "small": np.int8([[3]]),
        "a_very_long_name_of_a_variable_as_of_a_line_phi_left_638nm": np.zeros((3, 4, 5), np.float32),
        "yes": np.array([[True, False]]),
        "none": np.zeros((0, 4)),
    }
    for small in (False, True):
        savemat(tmp_path / "a.mat", known, do_compression=small, long_field_names=True)
        found = arrays.read_variables(tmp_path / "a.mat")
        assert {name for name in found if name[:2] != "__"} == {name for name, *_ in whosmat(tmp_path / "a.mat")}
        assert all(np.array_equal(found[name], np.atleast_2d(value)) or name == "text" for name, value in known.items())
    number = element(9, struct.pack(f"{order}d", 2.5), order)
    (tmp_path / "b.mat").write_bytes(mat(matrix(b"P1b", 6, (1, 1), number, order=order), order=order))
    assert arrays.read_variables(tmp_path / "b.mat")["P1b"] == [[2.5]]


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    ("part", "reason"),
    [
        (matrix(b"P1b", 6, (1 << 20, 1 << 20), NUMBER), "claims a shape"),
        (matrix(b"P1b", 6, (1, -1), NUMBER), "claims a shape"),
        (matrix(b"P1b", 6, (1, 1), element(9, bytes(1 << 24))), "more bytes than its shape"),
        (matrix(b"P1b", 6, (1, 1), struct.pack("<2I", 9, 1 << 31) + bytes(8)), "more bytes than its shape"),
        (matrix(b"P" * 5000, 6, (1, 1), NUMBER), "takes 5000 bytes"),
        (matrix(b"P1b", 6, (1,) * 2000, NUMBER), "takes 8000 bytes"),
        (matrix(b"P1b", 6, (1, 1), NUMBER) * 2, "twice"),
        (element(3, b"abcd"), "of the kind 3"),
        (struct.pack("<2I", 14, 1 << 30), "ends within a variable"),
    ],
)
def test_what_claims_more_than_it_holds_is_refused(tmp_path: Path, part: bytes, reason: str, packed: bool) -> None:
    """Some kB that would become gigabytes. (Planted: SciPy's reader alone.)"""
    parts = (part[: len(part) // 2], part[len(part) // 2 :]) if reason == "twice" else (part,)
    if packed and reason.startswith("ends"):
        return  # packed, the claim is of an array without a beginning
    (tmp_path / "a.mat").write_bytes(mat(*parts, packed=packed))
    with pytest.raises(MitsimError, match=r"no MATLAB file|is missing"):
        import_file(tmp_path / "a.mat", None, tmp_path / "cal", "b")


def test_a_packed_bomb_is_refused_by_what_it_claims(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """16 MiB of zeros in 32 kB, all of it true."""
    sides = {f"{stem}b": np.zeros((1 << 10, 1 << 10)) for stem in ("P1", "Q1")}
    savemat(tmp_path / "a.mat", sides, do_compression=True)
    assert (tmp_path / "a.mat").stat().st_size < 1 << 15
    monkeypatch.setattr("mitsim.core.job.free_memory", lambda: 2**25)
    with pytest.raises(MitsimError, match=r"a\.mat: would take about 48 MiB of memory; allowed are 28.8 MiB"):
        import_file(tmp_path / "a.mat", None, tmp_path / "cal", "b")
