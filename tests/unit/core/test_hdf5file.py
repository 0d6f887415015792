"""HDF5 files on a disk that is full: one line, nothing left, nothing said beside, whenever the room ends."""

from __future__ import annotations

import resource
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest

from mitsim.core.arrays import checked_hdf5, whole_hdf5
from mitsim.core.errors import MitsimError
from mitsim.exchange.packed import load_hdf5
from mitsim.learn.pair_store import PairStore, is_shard

NOISE = np.random.default_rng(3).integers(0, 256, 40_000, np.uint8)


def written(path: Path) -> None:
    """Some tens of kB of groups, attributes, packed chunks and texts."""
    with whole_hdf5(path) as file:
        file.attrs["layout"] = 1
        for number in range(8):
            group = file.create_group(f"g{number}", track_order=True)
            group.create_dataset("noise", data=NOISE[: 5000 * number + 1], compression="gzip", fletcher32=True)
            group.create_dataset("plain", data=NOISE[: 3000 * number + 1].astype(float))
            group.create_dataset("text", data=np.array(["a" * 900] * 4, object), dtype=h5py.string_dtype())


@contextmanager
def room(size: int) -> Iterator[None]:
    """No file may become larger than ``size``, as on a full disk: Python is told so by EFBIG."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_room_that_ends_anywhere(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """(Planted: the path given to h5py, which then says it seven times, and ends the process for some sizes.)"""
    written(tmp_path / "whole.h5")
    size = (tmp_path / "whole.h5").stat().st_size
    for left in (0, 1, 100, 3000, *range(4096, size, 23_456), size - 1):
        with room(left), pytest.raises(MitsimError, match=r"a\.h5: cannot be written \(File too large\); choose"):
            written(tmp_path / "a.h5")
    with room(size):
        written(tmp_path / "a.h5")
    assert {path.name for path in tmp_path.iterdir()} == {"a.h5", "whole.h5"}
    with h5py.File(tmp_path / "a.h5") as file:
        assert np.array_equal(file["g7/noise"][()], NOISE[:35_001]) and file["g3/text"][2] == b"a" * 900
    assert capfd.readouterr().err == ""


def test_the_program_ends_in_peace_after_a_full_disk(tmp_path: Path) -> None:
    """HDF5 tries to write again when Python ends, and may end it by a signal."""
    lines = (
        "from tests.unit.core.test_hdf5file import *",
        "from mitsim.core.errors import MitsimError",
        "try:",
        "    with room(70_000): written(Path('a.h5'))",
        "except MitsimError as error: print(error)",
    )
    environment = {"PYTHONPATH": str(Path(__file__).parents[3])}
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "") and "cannot be written" in done.stdout
    assert not [*tmp_path.iterdir()]


def test_an_error_of_what_fills_it_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyError), whole_hdf5(tmp_path / "a.h5") as file:
        file.create_group("a")
        raise KeyError
    assert not [*tmp_path.iterdir()]


# ---- Files that lead elsewhere or claim more than they hold ----------------------------------------------------------


def packed_twice(file: h5py.File) -> None:
    """Write 4 MB of zeros that gzip packs twice, to some hundred bytes."""
    filters = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    filters.set_chunk((1 << 22,))
    filters.set_deflate(9)
    filters.set_deflate(9)
    space = h5py.h5s.create_simple((1 << 22,))
    made = h5py.h5d.create(file.id, b"x", h5py.h5t.NATIVE_UINT8, space, filters)
    made.write(h5py.h5s.ALL, h5py.h5s.ALL, np.zeros(1 << 22, np.uint8))


def virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((4,), "f8")
    layout[:] = h5py.VirtualSource(
        h5py.File(Path(file.filename).parent / "other.h5", "w").create_dataset("a", (4,), "f8")
    )
    file.create_virtual_dataset("x", layout)


def in_itself(file: h5py.File) -> None:
    file["a/b"] = file.create_group("a")


def large_pieces(file: h5py.File) -> None:
    made = file.create_dataset("x", (9,), "u1", chunks=(1 << 29,), maxshape=(None,), compression="gzip")
    made.id.write_direct_chunk((0,), zlib.compress(b"0"))


HOSTILE: dict[str, tuple[Callable[[h5py.File], object], str]] = {
    "a link to another file": (lambda f: f.update({"x": h5py.ExternalLink("other.h5", "/a")}), "/x is a link"),
    "a link within": (lambda f: f.update({"x": h5py.SoftLink("/a")}), "/x is a link"),
    "a link in a group": (lambda f: f.create_group("g").update({"x": h5py.SoftLink("/a")}), "/g/x is a link"),
    "data of another file": (
        lambda f: f.create_dataset("x", (4,), "f8", external=[("/etc/passwd", 0, 32)]), "/x lies in another file"),
    "virtual data": (virtual, "/x lies in another file"),
    "nothing stored": (lambda f: f.create_dataset("x", (1 << 33,), "f8", chunks=(1 << 20,)), "not all is stored"),
    "half stored": (
        lambda f: f.create_dataset("x", (2, 9), "f8", chunks=(1, 9)).__setitem__(0, 1.0), "not all is stored"),
    "another filter": (lambda f: f.create_dataset("x", data=[1.0], compression="lzf"), "filters other than gzip"),
    "packed twice": (packed_twice, "filters other than gzip, or twice"),
    "a group in itself": (in_itself, "items or 16 levels"),
    "pieces too large": (large_pieces, "pieces of over 256 MiB"),
}  # fmt: skip
READERS: dict[str, Callable[[Path], object]] = {
    "run": lambda path: load_hdf5(path).__enter__(),
    "pairs": lambda path: PairStore(path.parent, None)._file(Stub(path.name)).__enter__(),  # type: ignore[arg-type]
}


class Stub:
    """A shard of which a store asks the file alone."""

    def __init__(self, file: str) -> None:
        self.file = file


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("what", HOSTILE)
def test_a_file_that_leads_astray_is_refused_by_every_reader(tmp_path: Path, what: str, reader: str) -> None:
    """(Planted: no look at links; links of the first level alone; two filters of one kind; no look at storage.)"""
    make, words = HOSTILE[what]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        make(file)
    with pytest.raises(MitsimError, match=rf"a\.h5: .*({words})") as refusal:
        READERS[reader](tmp_path / "a.h5")
    assert "\n" not in str(refusal.value) and not is_shard(tmp_path / "a.h5", "", 0)


def test_what_would_not_fit_the_memory_is_refused(tmp_path: Path) -> None:
    """Before it is read: zeros that gzip packs to a thousandth, and texts that all are one text. (Planted: bytes of the
    first level alone; a text counted by its 16 bytes.)"""
    many = np.zeros(1 << 24, np.uint8)
    with h5py.File(tmp_path / "zeros.h5", "w") as file:
        file.create_group("g").create_dataset("x", data=many, chunks=(1 << 20,), compression="gzip")
    with h5py.File(tmp_path / "texts.h5", "w") as file:
        file.create_group("g").create_dataset("x", data=["a" * 4096] * 1000, dtype=h5py.string_dtype())
    for name in ("zeros.h5", "texts.h5"):
        with checked_hdf5(tmp_path / name, lambda _: 1.0) as file:
            assert file["g/x"].size in (1000, 1 << 24)
        with (
            pytest.raises(MitsimError, match=rf"file .*{name}: would take about .* of memory"),
            checked_hdf5(tmp_path / name, lambda _: 1e5),
        ):
            pass
    known = set[object]()
    with checked_hdf5(tmp_path / "zeros.h5", lambda _: 0.0, known), h5py.File(tmp_path / "b.h5", "w"):
        pass
    with checked_hdf5(tmp_path / "zeros.h5", lambda _: 1e5, known):  # and a file that did not change is known
        pass
    with h5py.File(tmp_path / "zeros.h5", "a") as file:
        file["y"] = h5py.SoftLink("/g/x")
    with pytest.raises(MitsimError, match="/y is a link"), checked_hdf5(tmp_path / "zeros.h5", len, known):
        pass


def test_no_other_code_opens_an_hdf5_file() -> None:
    """But ``core/arrays.py``. (Planted: h5py.File in the pairs' store.)"""
    package = Path(__file__).parents[3] / "mitsim"
    found = {path.name for path in package.rglob("*.py") if "h5py.File(" in path.read_text(encoding="utf-8")}
    assert found == {"arrays.py"}
