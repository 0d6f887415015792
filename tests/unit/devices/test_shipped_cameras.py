"""Each shipped camera serves for what its file says, and capture names what the others lack."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import mitsim
from mitsim.api.bench import open_bench
from mitsim.bench import apparatus as opening
from mitsim.core.configuration import shipped_path
from mitsim.core.errors import MitsimError
from mitsim.devices.sensor import load_sensor

SERVES = re.compile(r"^# Serves: ([a-z, ]+)\. ", flags=re.M)
SENSORS = sorted(
    path
    for path in Path(shipped_path("calibration")).glob("*.toml")
    if "full_well_e" in path.read_text(encoding="utf-8")
)


def serves(camera: Path) -> list[str]:
    found = SERVES.findall(camera.read_text(encoding="utf-8").split("\nname = ")[0])
    assert len(found) == 1, f"{camera} says in its head what it serves for"
    return str(found[0]).split(", ")


@pytest.mark.parametrize("camera", SENSORS, ids=lambda path: path.stem)
def test_a_camera_captures_as_its_file_says(camera: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before a scene is loaded. (Seen failing: files that said nothing. Planted: one without efficiency let pass.)"""
    asked: list[Any] = []
    monkeypatch.setattr(opening, "_load", lambda *_, **options: asked.append(options["sensor"]) or loaded())
    sensor, verbs = load_sensor(camera), serves(camera)
    assert "characterise" in verbs and {*verbs} <= {"capture", "sense", "characterise"}
    assert sensor.sensor_only == ("capture" not in verbs) == ("Sensor only" in camera.read_text(encoding="utf-8"))
    assert ("sense" in verbs) == sensor.states_efficiency
    if "capture" in verbs and sensor.mosaic is None:
        assert open_bench("photograph", camera=camera).devices.sensor == sensor and asked == [sensor]
        return
    with pytest.raises(MitsimError) as caught:
        open_bench("photograph", camera=camera)
    lacking = "--colour mosaic" if sensor.mosaic else "sensor only: its file states no quantum_efficiency"
    assert lacking in str(caught.value) and not asked


def loaded() -> Any:
    camera = SimpleNamespace(geometry=None)
    return SimpleNamespace(camera=camera, parting=(), own={}, sensor_note="", path=Path("scene.xml"))


@pytest.mark.parametrize("camera", [path for path in SENSORS if load_sensor(path).rows], ids=lambda path: path.stem)
def test_pixels_are_the_cameras(camera: Path, small_scene: Callable[..., Path], tmp_path: Path, variant: str) -> None:
    """A file of two lines that stands on a sensor alone captures with it: its pitch, rows and columns, whatever the
    scene's film is. (Planted: columns for rows; the scene's pitch kept; the window of its film kept;
    a bench in another variant without the camera's sensor.)"""
    own, sensor = tmp_path / "own.toml", load_sensor(camera)
    own.write_text(f'base = "{camera.stem}"\nquantum_efficiency = 0.5\nbinning = 16\n')
    scene = small_scene()
    window = "".join(f'<integer name="crop_{name}" value="2"/>' for name in ("offset_x", "offset_y", "width", "height"))
    scene.write_text(scene.read_text().replace("<rfilter", f"{window}<rfilter"))
    with pytest.warns(UserWarning, match=f"{sensor.rows // 16} x {sensor.columns // 16} pixels of "):
        bench = open_bench(scene, variant, camera=own)
    assert bench.sensor.quantum_efficiency == 0.5 and bench.sensor.mosaic is None
    assert bench.geometry.shape == (sensor.rows // 16, sensor.columns // 16) and bench.geometry.roi is None
    assert bench.geometry.pitches == pytest.approx((16e-3 * sensor.pixel_pitch_um,) * 2, rel=1e-12)
    for each in (bench, bench.in_variant(variant)):
        assert [*each.loaded.camera.film().size()] == [sensor.columns // 16, sensor.rows // 16]
        assert each.geometry == each.loaded.camera.geometry == bench.geometry


def test_a_base_that_is_no_camera_is_told_with_all_cameras(tmp_path: Path) -> None:
    """And with no projector or list, which lie beside them. (Planted: every file of the shelf.)"""
    (tmp_path / "own.toml").write_text('base = "imx251"\n')
    with pytest.raises(MitsimError, match=r"base: got 'imx251', .* did you mean imx255\?") as refusal:
        load_sensor(tmp_path / "own.toml")
    assert "mp_cl1" not in str(refusal.value) and "session" not in str(refusal.value)


def test_a_sensor_has_no_more_rows_than_its_base(tmp_path: Path) -> None:
    """(Planted: let pass: frames of rows that no such sensor has.)"""
    (tmp_path / "own.toml").write_text('base = "imx250"\nrows = 4000\nbinning = 4\n')
    with pytest.raises(MitsimError, match=r"rows: got 4000, but imx250 has \d+; give no more"):
        load_sensor(tmp_path / "own.toml")


@pytest.mark.parametrize(("camera", "projector"), [("session", None), ("mp_cl1", None), (None, "imx249")])
def test_a_shipped_file_of_another_kind_is_no_device(camera: str | None, projector: str | None) -> None:
    """The refusal lists devices of the right kind only. (Seen: eight mistakes in session.toml, each with 38 fields.
    Planted: any file of the folder.)"""
    kind, known = ("camera", "imx249, imx249_rggb") if camera else ("projector", "mp_cl1")
    with pytest.raises(MitsimError, match=f"{kind} {camera or projector}: .*shipped {kind}s are {known}") as refusal:
        opening.check_devices(camera, projector)
    assert "session," not in str(refusal.value) and "flatcam" not in str(refusal.value)


def test_a_camera_file_states_mask_and_distance(tmp_path: Path, variant: str) -> None:
    """The camera file replaces the scene's own distance with a note, also in another variant, and the user's -D is
    refused unless it is the same. (Planted: the scene's distance kept; -D overridden; no note.)"""
    own = tmp_path / "own.toml"
    mask = '[mask]\nkind = "separable"\nfeature_mm = 0.06\norder = 9\n'
    own.write_text(f'base = "small"\n{mask}distance_mm = 1.5\n')
    with pytest.warns(UserWarning, match="mask: 1.5 mm before the sensor, as its camera file says, in place of the"):
        bench = open_bench("photograph", variant, camera=own)
    for each in (bench, bench.in_variant(variant)):
        assert each.geometry.mask_distance == each.loaded.camera.geometry.mask_distance == 1.5
    with pytest.raises(MitsimError, match=r"has distance_mm 1.5, and mask_distance was set to 3; give one of the two"):
        open_bench("photograph", variant, camera=own, mask_distance=3)
    with pytest.warns(UserWarning) as notes:
        assert open_bench("photograph", variant, camera=own, mask_distance=1.5).geometry.mask_distance == 1.5
    assert "mask:" not in str(notes[0].message)
    own.write_text(f'base = "small"\n{mask}')
    with pytest.warns(UserWarning):
        assert open_bench("photograph", variant, camera=own, mask_distance=3).geometry.mask_distance == 3


def test_the_small_camera_does_the_main_job() -> None:
    """Capture, calibration and images of the photograph at the usual accuracy, none of them flagged.

    (Planted: 64 pixels a side, with which one uniform frame gives no noise estimate.)"""
    with pytest.warns(UserWarning, match="160 x 160 pixels of 35.16"):
        bench = open_bench("photograph", camera="small")
    light, factors = bench.light(), bench.calibrate()
    assert factors.ok and not factors.warnings
    for family, least in (("dots:7", 44), ("uniform", 22)):
        shots = light.expose(family)
        image = mitsim.reconstruct(shots, factors)
        assert image.ok and mitsim.psnr(image.image, shots.truth) > least
