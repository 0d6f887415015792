"""The bench: files that fit together, and the board in place of the scene."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.bench.apparatus import Apparatus, check_depth
from mitsim.core.errors import ArgumentError
from mitsim.devices.camera import CameraGeometry, Devices
from mitsim.devices.projector import Coherence, ProjectorModel
from mitsim.light.passes import Simulation
from mitsim.light.settings import Settings

pytestmark = pytest.mark.usefixtures("variant")


def test_identity_and_provenance(small_scene: Callable[..., Path]) -> None:
    path = small_scene()
    bench = open_bench(path, albedo="0.7")
    assert repr(bench) == "Bench(scenes/small.xml: Sony IMX249, binned 2x2 with 64 x 64 pixels, Sony MP-CL1)"
    identity, provenance = bench.identity(), bench.provenance()
    assert identity["geometry"]["pixels"] == 64 and identity["projector"]["n"] == 16
    assert provenance["defines"] == {"albedo": "0.7"} and provenance["scene"] == str(path)
    # The same camera before another scene is the same camera.
    assert open_bench(path).identity() == identity
    assert open_bench(small_scene("other", mask_distance=2.5)).identity() != identity
    # Its light is what the mask diffracts: that of one line is other light. (Planted: left out.)
    assert identity["projector"]["lines_nm"] == [638.0, 520.0, 445.0]
    assert identity["projector"]["radiant_shares"] == [0.4757, 0.3348, 0.1895]
    red = replace(bench, devices=replace(bench.devices, projector=bench.projector.at(638.0))).identity()
    assert red["projector"] == {**identity["projector"], "lines_nm": [638.0], "radiant_shares": [1.0]}


@pytest.mark.parametrize("pose", [None, "0 0 1 50 0 1 0 -20 -1 0 0 30 0 0 0 1"])
def test_parallax_tells_the_window_at_any_depth(small_scene: Callable[..., Path], pose: str | None) -> None:
    """60 mm beside the camera, square to it: the same for both edges, to Mitsuba's single precision."""
    bench = open_bench(small_scene(**({"pose": pose} if pose else {})))
    parallax = bench.parallax
    assert parallax.row_mm == pytest.approx((0, 0), abs=1e-3)
    assert parallax.column_mm == pytest.approx((-60, -60), abs=1e-3)
    rows, columns = bench.windows_at(330.0)
    shift = 1 / 330 - 1 / parallax.depth_mm
    assert rows == pytest.approx(np.add(parallax.row_tan, np.multiply(parallax.row_mm, shift)), abs=1e-6)
    assert columns == pytest.approx(np.add(parallax.column_tan, np.multiply(parallax.column_mm, shift)), abs=1e-6)


def test_parallax_of_a_region_is_seen_from_its_middle(small_scene: Callable[..., Path]) -> None:
    """Which lies 7 rows above and 8 columns beyond the axis. (Planted: seen from the axis.)"""
    bench = open_bench(small_scene())
    camera = bench.geometry.model_copy(update={"roi": (10, 20, 30, 40)})
    parallax = replace(bench, devices=replace(bench.devices, camera=camera)).parallax
    shift = 1 / 330 - 1 / parallax.depth_mm
    seen = (parallax.row_tan, parallax.row_mm), (parallax.column_tan, parallax.column_mm)
    for (tangents, edges), pixels, window in zip(seen, (-7, 8), bench.windows_at(330.0), strict=True):
        expected = np.array(window) - pixels * 0.01172 / 330
        assert np.add(tangents, np.multiply(edges, shift)) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("pose", [None, "0 0 1 50 0 1 0 -20 -1 0 0 30 0 0 0 1"])
def test_the_board_faces_the_camera_wherever_it_stands(small_scene: Callable[..., Path], pose: str | None) -> None:
    """Its light is that of a sheet of that reflectance on the aligned plane, even where the scene has none."""
    place = {} if pose is None else {"pose": pose}
    bench = open_bench(small_scene(sheet_z=330, **place))
    sheet = open_bench(small_scene("sheet", **place), albedo="0.9")

    def light(which: Bench) -> np.ndarray:
        simulation = Simulation(which, Settings(depth=400.0, subdivision=2))
        return simulation.accumulate("direct", simulation.direct.trace(4, 0, 4), np.arange(16**2), 4)["fine"].toarray()

    board, known = light(bench.with_board(0.9)), light(sheet)
    assert known.sum() > 0
    assert np.abs(board - known).sum() < 2e-4 * known.sum()


def unloaded(projector: dict[str, Any], **geometry: Any) -> Apparatus:
    """Return a bench without a scene, whose 16 x 16 projector pixels are 2.5 mm high and 10 mm wide at 400 mm."""
    pixels = SimpleNamespace(
        n=16, row_tan=(0.05, 0.15), column_tan=(-0.25, 0.15), first_row=2.0, first_column=3.0, canvas=(30, 40)
    )
    camera: Any = CameraGeometry(pixels=64, columns=32, **geometry)
    model = ProjectorModel(name="test", effective_wavelength_nm=562.0, **projector)
    loaded: Any = SimpleNamespace(pixels=pixels, projector=None, parting=())
    return Apparatus(loaded, Devices(camera, SimpleNamespace(), model, ""), "llvm_ad_mono", {})  # type: ignore[arg-type]


def test_a_depth_is_before_the_camera() -> None:
    assert check_depth(0.25) == 0.25
    for depth in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(ArgumentError, match="above 0"):
            check_depth(depth)


def test_the_field_stop_cuts_what_the_sensors_edge_does_not_see() -> None:
    """The window's farthest column is at a tangent of 0.25, and the sensor's edge sees it at 16 pixels / 400 mm more.
    One axis is enough for a cut, and the rows of this window are far inside. (Planted: both axes; a distance less.)"""
    edge = 0.25 + 16 * 0.01172 / 400
    for tangent, cuts in ((edge * (1 - 1e-6), True), (edge * (1 + 1e-6), False)):
        bench = unloaded({}, fov=2 * math.degrees(math.atan(tangent)))
        assert bench.field_stop_cuts == cuts


def test_speckle_is_stated_or_the_rms_over_shots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stated contrast is returned. Otherwise the contrast is the root mean square over every third of 18 shots, from
    pixels of 2.5 mm x 10 mm, and is computed once. (Planted: pixels' sides exchanged; shots from the last one.)"""
    assert unloaded({"speckle_contrast": 0.02}).speckle() == 0.02
    asked: list[tuple[Any, np.ndarray]] = []

    def contrast_of(devices: Devices, pixels_mm: tuple[float, float], lit: np.ndarray) -> float:
        asked.append((pixels_mm, lit))
        return len(asked) / 10

    monkeypatch.setattr("mitsim.optics.frames.contrast_of", contrast_of)
    bench = unloaded({"speckle": Coherence(beam_radius_mm=0.5)})
    family = bench.family("dots:3x6")
    expected = math.sqrt(np.mean(np.square(np.arange(1, 7) / 10)))
    assert bench.speckle(family) == bench.speckle(family) == pytest.approx(expected, rel=1e-12)
    assert [sizes for sizes, _ in asked] == [pytest.approx((2.5, 10.0), rel=1e-12)] * 6
    for (_, lit), shot in zip(asked, family.shots[::3], strict=True):
        assert np.array_equal(lit, family.light(shot))
    assert bench.speckle() == pytest.approx(0.7) and asked[-1][1].shape == (16, 16) and asked[-1][1].all()


def test_tracers_get_the_projectors_glare() -> None:
    """The lens keeps all but the glare, which it spreads over a quarter of 16 pixels: ANSI contrast is the mean of
    white and black fields of a chessboard. (Planted: more light than the lamp gives.)"""
    bench = unloaded({"ansi_contrast": 50.0, "glare_spread": 0.25, "blur_pixels": 0.5})
    optics = bench.projector_optics
    assert (optics.share, optics.glare_spread) == (1 - bench.projector.glare, 4.0) and 0 < bench.projector.glare < 0.1
    assert (optics.n, optics.canvas, optics.focus, optics.blur) == (16, (30, 40), 400.0, 0.5)


def test_waves_need_openings_wider_than_half_of_every_wavelength() -> None:
    """The mask's openings are two features wide on average. Openings of 250 nm are wide enough for 445 nm only.
    (Planted: the shortest wavelength decides.)"""
    for feature, wide in ((1.25e-4, False), (0.06, True)):
        bench = unloaded({"wavelengths_nm": (445.0, 638.0), "radiant_shares": (0.5, 0.5)}, mask_feature=feature)
        assert (bench.waves is not None) == wide
