"""Every kind of file that is written, where there is no room: one line that names it, and nothing is left of it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.core.exr import write_frame
from mitsim.core.files import write_json, write_text
from mitsim.devices.sensor import SensorModel, load_sensor
from mitsim.exchange.formats import export, import_file
from mitsim.exchange.other_programs import draw_family
from mitsim.studies.framework.campaign import Store
from mitsim.studies.framework.experiment import Found, Point, Setup
from tests.exchanged import Made, made
from tests.unit.core.test_hdf5file import room

pytestmark = pytest.mark.robustness("Faults")

ROOM = 2000
"""Bytes; each file below is larger."""
NOISE = np.random.default_rng(4).random((64, 64))


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("bench")
    bench = made(folder, ambient=True)
    export(bench.run, "hdf5", folder / "run.h5", bench.calibration)
    return bench


def sensor() -> SensorModel:
    return load_sensor(Path(__file__).parents[2] / "calibration" / "imx249.toml")


def sensed(path: Path) -> None:
    from mitsim.acquire.sense import sense

    sense(NOISE, sensor()).save(path)


def exported(format: str, name: str, **more: str) -> Callable[[Made, Path], object]:
    calibrated = format in ("hdf5", "mat")
    return lambda bench, place: export(
        bench.run, format, place / name, bench.calibration if calibrated else None, **more
    )


WRITERS: dict[str, Callable[[Made, Path], object]] = {
    "HDF5 of export": exported("hdf5", "a.h5"),
    "MAT of export": exported("mat", "a.mat"),
    "pictures of export": exported("png", "a", projector="mp_cl1"),
    "folder of import": lambda bench, place: import_file(bench.run.parent / "run.h5", place / "a"),
    "pictures of patterns": lambda _, place: draw_family(place / "a", "dots:3", 96, "mp_cl1"),
    "OpenEXR": lambda _, place: write_frame(place / "a.exr", {"Y": NOISE.astype(np.float32)}, {}),
    "OpenEXR of sense": lambda _, place: sensed(place / "a.exr"),
    "NPY of sense": lambda _, place: sensed(place / "a.npy"),
    "PNG of sense": lambda _, place: sensed(place / "a.png"),
    "NPZ of a study": lambda _, place: Store(place).save(Point.of(Setup("a"), b=1), Found((), {"a": NOISE})),
    "JSON": lambda _, place: write_json(place / "a.json", NOISE),
    "HTML": lambda _, place: write_text(place / "a.html", "a" * (ROOM + 1)),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk(
    bench: Made, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """(Planted: a writer that leaves what it began; numpy's own sentence, which names neither file nor cause.)"""
    # Python keeps byte code that was cut short, and fails on it ever after.
    monkeypatch.setattr("sys.dont_write_bytecode", True)
    # Write once with room, because Dr.Jit compiles kernels on the way and complains if it cannot keep them.
    WRITERS[name](bench, tmp_path)
    for path in tmp_path.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    capfd.readouterr()
    with room(ROOM), pytest.raises(MitsimError, match="cannot be written") as reported:
        WRITERS[name](bench, tmp_path)
    message = str(reported.value)
    assert str(tmp_path) in message and "room" in message and message.isprintable()
    assert not [*tmp_path.iterdir()]
    assert capfd.readouterr().err == ""
