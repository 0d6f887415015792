"""MATLAB files: the paper's and FlatCam's variables mean what they say, SciPy and Octave read them, and back."""

from __future__ import annotations

import shutil
import struct
import subprocess
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import loadmat, savemat, whosmat

import mitsim as ms
from mitsim.core import arrays
from mitsim.core.errors import MitsimError
from mitsim.exchange.formats import export, import_file
from tests.exchanged import CASES, COLUMNS, ROWS, made


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


OCTAVE = """
a = load('all.mat');
X = double(a.truth);
found = a.data_coded(:,:,1,2) - a.measBg;
expected = a.phi_left * ((a.PL(:,1) * a.PR(:,2)') .* X) * a.phi_right';
printf('%.17g %.17g %d %d %s\\n', sum(found(:)), sum(expected(:)), size(found, 1), size(a.PR, 2),
  class(a.run_manifest));
"""


@pytest.mark.skipif(shutil.which("octave-cli") is None, reason="GNU Octave is not installed")
@pytest.mark.parametrize("case", ["signed", "ambient"])
def test_octave_reads_what_is_written(case: str, tmp_path: Path) -> None:
    bench = made(tmp_path, **CASES[case])
    export(bench.run, "mat", tmp_path / "all.mat", bench.calibration)
    call = ["octave-cli", "--quiet", "--norc", "--eval", OCTAVE]
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found, expected, rows, last, kind = done.stdout.split()
    held = loadmat(tmp_path / "all.mat")
    lit = np.outer(held["PL"][:, 0], held["PR"][:, 1]) * held["truth"].astype(np.float64)
    assert float(found) == pytest.approx(np.sum(held["data_coded"][:, :, 0, 1] - held["measBg"]), rel=1e-12)
    assert float(expected) == pytest.approx(np.sum(held["phi_left"] @ lit @ held["phi_right"].T), rel=1e-9)
    assert (int(rows), int(last), kind) == (ROWS, held["PR"].shape[1], "char")


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
    with pytest.raises(MitsimError, match="holds no run"):
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
    for packed in (False, True):
        savemat(tmp_path / "a.mat", known, do_compression=packed, long_field_names=True)
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
