"""HDF5 files on a disk that is full: one line, nothing left, nothing said beside, whenever the room ends."""

from __future__ import annotations

import resource
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest

from mitsim.core.arrays import whole_hdf5
from mitsim.core.errors import MitsimError

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
