"""What opening a bench asks of its files and of the scene's loader: nothing is loaded here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from mitsim.api.bench import open_bench
from mitsim.bench import apparatus as opening
from mitsim.core.configuration import shipped_path
from mitsim.core.errors import MitsimError

PITCHES = 0.01172, 0.01172
"""Of the shipped camera's pixels, binned 2 x 2 [mm]."""
SMALL = "<scene version='3.0.0'><default name='albedo' value='0.5'/><default name='mask' value='open'/></scene>"


@dataclass
class Loader:
    """Stands for the scene's loader: what it was asked for, and what is worn before the sensor."""

    pitches: tuple[float, float] = PITCHES
    mask: Any = None

    def __post_init__(self) -> None:
        self.asked: list[Any] = []
        self.worn: list[Any] = []

    def loaded(self, variant: str, path: Path, defines: Any, **options: bool) -> Any:
        self.asked.append((variant, path, dict(defines), options))
        geometry = SimpleNamespace(pitches=self.pitches)
        camera = SimpleNamespace(geometry=geometry, wear=self.worn.append)
        note = "" if "sensor" in options else None
        return SimpleNamespace(camera=camera, path=path, parting=(), own={}, sensor_note=note)


@pytest.fixture
def loader(monkeypatch: pytest.MonkeyPatch) -> Iterator[Loader]:
    found = Loader()
    monkeypatch.setattr(opening, "_load", found.loaded)
    monkeypatch.setattr("mitsim.devices.camera.load_mask", lambda path: found.mask)
    yield found


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "own.xml"
    path.write_text(SMALL)
    return path


@pytest.fixture
def camera(tmp_path: Path) -> Callable[..., Path]:
    """The shipped camera's file with other lines."""

    def write(**changes: str) -> Path:
        stated = shipped_path("calibration", "imx249.toml").read_text().splitlines()
        kept = [line for line in stated if line.partition(" =")[0] not in changes]
        path = tmp_path / "own.toml"
        path.write_text("\n".join([*(f"{name} = {value}" for name, value in changes.items() if value), *kept]))
        return path

    return write


def test_files_outside_a_scenes_folder_are_refused_unless_allowed(tmp_path: Path) -> None:
    """(Planted: allowed if nothing is said.)"""
    path = tmp_path / "in" / "own.xml"
    path.parent.mkdir()
    path.write_text("<scene version='3.0.0'><include filename='../more.xml'/></scene>")
    (tmp_path / "more.xml").write_text(SMALL)
    assert opening.check_scene(path, {}, True) == path
    with pytest.raises(MitsimError, match=r"more\.xml"):
        opening.check_scene(path, {})


def test_devices_are_camera_and_projector(tmp_path: Path) -> None:
    """By name, by file, and the shipped ones. (Planted: one for the other.)"""
    usual = opening.check_devices(None, None)
    assert [path.name for path in usual] == ["imx249.toml", "mp_cl1.toml"]
    own = tmp_path / "own.toml"
    own.write_text(usual[0].read_text(encoding="utf-8"), encoding="utf-8")
    assert opening.check_devices(own, None) == (own, usual[1]) and opening.check_devices(None, own) == (usual[0], own)
    for devices in (("none", None), (None, "none")):
        with pytest.raises(MitsimError, match="none"):
            opening.check_devices(*devices)


@pytest.mark.parametrize(
    ("pitches", "reported"),
    [
        ((0.01172, 0.011733), "pixel pitch is 11.72 um, but .* has 11.733 um"),
        ((0.011707, 0.01172), "row pitch is 11.72 um, but .* has 11.707 um"),
        ((0.011731, 0.011709), None),
    ],
)
def test_pitches_are_a_scenes(loader: Loader, scene: Path, pitches: tuple[float, float], reported: str | None) -> None:
    """Along columns and down the rows. (Planted: one for the other; a shorter pitch let pass.)"""
    loader.pitches = pitches
    if reported is None:
        open_bench(scene)
        return
    with pytest.raises(MitsimError, match=reported):
        open_bench(scene)
    open_bench(scene, for_render=True)


def test_pixels_of_a_named_camera_are_the_scenes(loader: Loader, scene: Path, camera: Callable[..., Path]) -> None:
    """Its sensor goes to the loader, and goes there again. (Planted: left out where a bench is opened anew.)"""
    tall = camera(row_pitch_um="7.0")
    bench = open_bench(scene, camera=tall)
    assert loader.asked[-1][3]["sensor"] == bench.sensor
    assert bench.sensor.pitches_mm == pytest.approx((0.014, 0.01172), rel=1e-12)
    opening.reopen(bench, "llvm_ad_rgb")
    assert loader.asked[-1][3] == {"outside": True, "sensor": bench.sensor}


def test_a_camera_blind_to_the_projector_is_refused(loader: Loader, scene: Path, camera: Callable[..., Path]) -> None:
    """Before the scene is loaded; a scene to render counts no electrons. Filters wait for lines: they are checked where
    these are told apart. (Planted: filters refused in a variant that tells lines apart; taken in one that does not.)"""
    plain = camera(quantum_efficiency="")
    with pytest.raises(MitsimError, match=r"camera .*own\.toml: .*efficiency"):
        open_bench(scene, camera=plain)
    assert not loader.asked
    open_bench(scene, camera=plain, for_render=True)
    filters = camera(quantum_efficiency="", mosaic='"RGGB"', binning="1")
    table = "\n[mosaic_curves.{}]\nwavelengths_nm = [400.0, 700.0]\nefficiency = [0.5, 0.5]\n"
    curves = "".join(map(table.format, "RGB"))
    filters.write_text(filters.read_text() + curves)
    loader.pitches = 0.00586, 0.00586
    open_bench(scene, "llvm_ad_spectral", filters)
    with pytest.raises(MitsimError, match="mosaic"):
        open_bench(scene, "llvm_ad_mono", filters)
    with pytest.raises(MitsimError, match="efficiency"):
        open_bench(scene, "llvm_ad_spectral", camera(quantum_efficiency=""))


def test_a_mask_of_the_camera_is_worn_and_is_the_only_one(loader: Loader, scene: Path) -> None:
    """(Planted: the mask left off when a bench is opened anew; both taken.)"""
    seen: list[Any] = []
    worn = lambda geometry, folder: seen.append((geometry.pitches, folder)) or "mask"  # noqa: E731
    loader.mask = SimpleNamespace(put_on=worn, distance_mm=None)
    bench = open_bench(scene, albedo=0.25)
    folder = opening.check_devices(None, None)[0].parent
    assert loader.worn == ["mask"] and seen == [(PITCHES, folder)]
    with pytest.raises(MitsimError, match="was set to 'mura' as well; give one of the two"):
        open_bench(scene, mask="mura")
    other = opening.reopen(bench, "llvm_ad_rgb")
    assert loader.worn == ["mask", "mask"] and other.variant == "llvm_ad_rgb" and other.devices is bench.devices
    assert loader.asked[-1] == ("llvm_ad_rgb", scene, {"albedo": "0.25"}, {"outside": True})
    assert other.loaded is not bench.loaded
