"""The factored estimator's light: how much, from which projector pixel, into which cell; and its variance.

Gates on Monte Carlo means are five standard deviations of independent batches with fixed seeds.
"""

from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsim.capture.bench import Bench, open_bench
from mitsim.capture.light import grid_for
from mitsim.core.errors import MitsimError
from mitsim.core.seeds import integer
from mitsim.optics.camera import anchor_positions
from mitsim.optics.frames import ExpectedFrames, FrameOptics
from mitsim.scene.patterns import parse_patterns
from mitsim.transport import factored
from mitsim.transport.factored import Tracer

pytestmark = pytest.mark.usefixtures("variant")
N, Z, RADIANCE = 16, 400.0, 0.5 * 111000 / 400**2
SIGMAS = 5.0


def tracer(bench: Bench, subdivision: int = 2, anchors: int = 1, common: bool = False) -> Tracer:
    return Tracer(
        bench.loaded.scene, bench.loaded.camera, bench.source, grid_for(bench, subdivision), anchors, common=common
    )


@pytest.fixture(scope="module")
def white(shared_scene: Callable[..., Path], variant: str) -> Bench:
    return open_bench(shared_scene("white"), variant)


@pytest.fixture(scope="module")
def large(shared_scene: Callable[..., Path], variant: str) -> Bench:
    """A sensor of 40 mm (pixels of 0.625 mm): its anchors see the board from clearly different places."""
    return open_bench(shared_scene("large", pitch=0.625, fov=23), variant, check_camera=False)


def falloff(tau_row: np.ndarray, tau_column: np.ndarray, row: float, column: float) -> np.ndarray:
    return (1 + np.square(tau_row - row / Z) + np.square(tau_column - column / Z)) ** -2


def test_light_of_a_board_is_its_irradiance_cell_by_cell(large: Bench) -> None:
    """Sum over projector pixels against L (1 + |tau - a/z|^2)^-2 dtau from each of four anchors."""
    trace = tracer(large, subdivision=1, anchors=2)
    cells = trace.grid.shape[0]
    total = np.mean([np.asarray(trace.batch(seed).light.sum(axis=0)).ravel() for seed in range(8)], axis=0)
    light = total.reshape(2, cells, 2, cells)
    edges = trace.grid.rows.edges
    middle = (edges[:-1] + edges[1:]) / 2
    inside = np.abs(middle) < 0.15
    assert inside.sum() == N
    positions = anchor_positions(2, large.geometry.half_width)
    ratios = []
    for a, b in np.ndindex(2, 2):
        tau_row, tau_column = np.meshgrid(middle[inside], middle[inside], indexing="ij")
        expected = RADIANCE * falloff(tau_row, tau_column, positions[a], positions[b]) * (0.3 / N) ** 2
        ratios.append(light[a][inside][:, b][:, inside] / expected)
        assert not light[a][~inside][:, b].any() and not light[a][:, b][:, ~inside].any()
    # The falloff changes by up to 2 % over a cell: eight jittered points leave 0.6 % / sqrt(8) a cell at most.
    assert np.abs(np.array(ratios) - 1).max() < 0.012
    assert abs(np.mean(ratios) - 1) < 3e-4


def test_total_light_is_the_irradiance(white: Bench) -> None:
    trace = tracer(white, subdivision=8)
    totals = np.array([trace.batch(seed).light.sum() for seed in range(10)])
    node, weight = np.polynomial.legendre.leggauss(12)
    expected = RADIANCE * 0.15**2 * float(weight @ falloff(0.15 * node[:, None], 0.15 * node[None, :], 0, 0) @ weight)
    error = totals.std(ddof=1) / np.sqrt(10)
    # Float32 edges of window and cells: a tenth of a percent of a cell's width, 1e-5 of the window.
    assert 2 * SIGMAS * error < 0.01 * expected
    assert abs(totals.mean() - expected) < SIGMAS * error + 2e-5 * expected


def test_each_cell_is_lit_by_the_projector_pixel_that_it_lies_in(white: Bench) -> None:
    trace = tracer(white, subdivision=2)
    light = trace.batch(3).light.tocoo()
    row, column = np.divmod(light.col, trace.grid.shape[1])
    before = (trace.grid.shape[0] - 2 * N) // 2
    pixel = (row - before) // 2 * N + (column - before) // 2
    wrong = light.data[pixel != light.row].sum() / light.data.sum()
    assert wrong < 1e-4, "only rays within a float32 rounding of an edge may stray"
    assert len(np.unique(light.row)) == N * N


def test_a_patch_of_the_print_darkens_its_own_cells(small_scene: Callable[..., Path]) -> None:
    reflectance = np.full((N, N), 255)
    reflectance[1, 4] = 0  # texels of 8 mm: y in 48..56, x in 24..32
    bench = open_bench(small_scene(reflectance=reflectance))
    trace = tracer(bench, subdivision=4)
    light = np.asarray(trace.batch(1).light.sum(axis=0)).reshape(trace.grid.shape)
    middle = [(axis.edges[:-1] + axis.edges[1:]) / 2 * Z for axis in (trace.grid.rows, trace.grid.columns)]
    y, x = -middle[0], -middle[1]
    inside_y, inside_x = (y > 49.5) & (y < 54.5), (x > 25.5) & (x < 30.5)
    assert inside_y.sum() >= 2 and inside_x.sum() >= 2
    assert not light[np.ix_(inside_y, inside_x)].any()
    # One column further, and mirrored: lit.
    assert (light[np.ix_(inside_y, (x > 34) & (x < 38))] > 0).all()
    assert (light[np.ix_((y < -49.5) & (y > -54.5), inside_x)] > 0).all()
    assert (light[np.ix_(inside_y, (x < -25.5) & (x > -30.5))] > 0).all()


def test_batches_are_reproducible_and_differ_by_seed(white: Bench) -> None:
    trace = tracer(white)
    first, again, other = (trace.batch(seed).light for seed in (1, 1, 2))
    assert (first != again).nnz == 0
    assert (first != other).nnz > 0.9 * first.nnz
    assert trace.lanes == trace.grid.shape[0] * trace.grid.shape[1]


def test_common_random_numbers_make_anchors_comparable(large: Bench) -> None:
    cells = grid_for(large, 1).shape

    def differences(common: bool) -> float:
        light = tracer(large, 1, 2, common).batch(1).light.sum(axis=0)
        block = np.asarray(light).reshape(2, cells[0], 2, cells[1])
        ratio = block[0, :, 0][3:-3, 3:-3] / block[0, :, 1][3:-3, 3:-3]
        return float(np.diff(ratio, axis=0).std())

    assert differences(True) < 0.6 * differences(False)


def test_depth_of_the_light(small_scene: Callable[..., Path], white: Bench) -> None:
    sample = tracer(white).batch(0)
    assert 1 / sample.depth_mean == pytest.approx(400, rel=1e-6)
    assert sample.depth_spread * 400 < 1e-5
    near = open_bench(small_scene(sheet_z=350))
    assert 1 / tracer(near).batch(0).depth_mean == pytest.approx(350, rel=1e-6)


def test_light_is_filed_where_it_was_reflected_not_where_it_was_aimed(small_scene: Callable[..., Path]) -> None:
    """A sheet at 200 mm, half the rig's distance: a projector pixel lands where the camera sees it there.

    At 200 mm the window spans x = 60 - 90 tan-halves: x from 0 to 60 mm, y from -30 to 30, that is column tan-angles
    -0.30 to 0 seen from the camera, rows -0.15 to 0.15.
    """
    bench = open_bench(small_scene(sheet_z=200, fov=40))
    trace = tracer(bench, subdivision=2)
    light = trace.batch(0).light
    edges = trace.grid.columns.edges
    middle = (edges[:-1] + edges[1:]) / 2
    by_column = np.asarray(light.sum(axis=0)).reshape(trace.grid.shape).sum(axis=0)
    lit = middle[by_column > 0.01 * by_column.max()]
    size = trace.grid.columns.size
    assert lit.min() == pytest.approx(-0.30, abs=size) and lit.max() == pytest.approx(0.0, abs=size)
    left = np.asarray(light[[8 * N]].sum(axis=0)).reshape(trace.grid.shape).sum(axis=0)
    assert np.average(middle, weights=left) == pytest.approx(-0.30 + 0.15 / N, abs=size)


def test_all_anchors_see_a_point_in_the_same_cell(shared_scene: Callable[..., Path]) -> None:
    """A sheet off the aligned plane: rays are aimed past its points by up to a quarter of a cell, filed where they hit.

    Anchors lie at +-14 mm; 14 mm (1/350 - 1/400) is 0.005 in tan-angle, one cell of this grid.
    """
    bench = open_bench(shared_scene("off", pitch=0.625, sheet_z=350), check_camera=False)
    trace = tracer(bench, subdivision=4, anchors=2)
    rows, columns = trace.grid.shape
    light = sum(trace.batch(seed).light for seed in range(8))[[5 * N + 9]].todense().reshape(2, rows, 2, columns)
    row_middle, column_middle = (np.arange(count) + 0.5 for count in (rows, columns))
    centre = np.array(
        [
            (np.average(row_middle, weights=block.sum(axis=1)), np.average(column_middle, weights=block.sum(axis=0)))
            for block in (np.asarray(light[a, :, b]) for a, b in np.ndindex(2, 2))
        ]
    )
    assert np.ptp(centre, axis=0).max() < 0.35, "in cells; by aim it would be 2"


def test_light_that_is_not_a_number_is_refused(small_scene: Callable[..., Path]) -> None:
    # Put there after loading: a file that says NaN is refused before Mitsuba sees it.
    bench = open_bench(small_scene())
    parameters = mi.traverse(bench.loaded.projector)
    parameters["scale"] = float("nan")
    parameters.update()
    with pytest.raises(MitsimError, match="NaN"):
        tracer(bench).batch(0)


def test_a_batch_in_many_launches_is_the_same_batch(large: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    trace = tracer(large, 1, 2)
    whole = trace.batch(6)
    monkeypatch.setattr(factored, "LANES_PER_LAUNCH", 300)
    parts = trace.batch(6)
    assert trace.lanes > 900
    assert np.array_equal(whole.light.indices, parts.light.indices)
    assert np.allclose(whole.light.data, parts.light.data, rtol=1e-5)
    assert parts.depth_mean == pytest.approx(whole.depth_mean, rel=1e-6)


def test_the_predicted_variance_is_the_actual_one(small_scene: Callable[..., Path]) -> None:
    """Squared error against a 40 times better answer, over its prediction, is 1 on average within its own error."""
    print_ = np.random.default_rng(8).integers(20, 256, (40, 40))
    bench = open_bench(small_scene(reflectance=print_))
    trace = tracer(bench, subdivision=1)
    family = parse_patterns("dots:4", N)
    labels, weights = family.classes()
    optics = FrameOptics(bench.geometry, trace.grid.rows.edges, trace.grid.columns.edges, Z, 1)
    seeds, groups = 24, 8
    lights = [
        [trace.batch(integer(5, "variance", seed, group)).light for group in range(groups)] for seed in range(seeds)
    ]
    total = sum(sum(light[1:], light[0]) for light in lights)
    extra = 16 * groups
    for index in range(extra):
        total = total + trace.batch(integer(5, "truth", index)).light
    truth = np.stack(
        [f.irradiance for f in ExpectedFrames(optics, [total / (seeds * groups + extra)], labels, weights, 0)]
    )
    actual, predicted = [], []
    for seed, light in enumerate(lights):
        found = list(ExpectedFrames(optics, light, labels, weights, seed))
        actual.append(sum(np.square(f.irradiance - t).sum() for f, t in zip(found, truth, strict=True)))
        predicted.append(sum(f.variance * f.irradiance.size for f in found))
    # The truth contains these seeds (1/40 of it each): it is nearer to them than it should be, by that part.
    ratio = np.sum(actual) / np.sum(predicted) / (1 - groups / (seeds * groups + extra))
    residual = np.array(actual) - ratio * np.array(predicted)
    deviation = residual.std(ddof=1) / np.sqrt(seeds) / np.mean(predicted)
    assert SIGMAS * deviation < 0.6, "a variance wrong by a factor of two has to show"
    assert abs(ratio - 1) < SIGMAS * deviation
