"""The bench: files that fit together, and the board in place of the scene."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
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
