"""Direct light from the projector's side: how much, from which pixel, to which anchor, seen where.

Boards have closed forms; gates on Monte Carlo means are five standard deviations of independent seeds.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry
from mitsim.light.light import trace_truth
from mitsim.light.settings import Settings
from mitsim.optics.image_formation import anchor_positions
from mitsim.transport import integrator
from mitsim.transport.direct import DirectTracer, FluxTracer
from mitsim.transport.records import DIRECT, PathSamples
from tests.hard.hard_light import gauss, glossy, lobe

pytestmark = pytest.mark.usefixtures("variant")
N, Z, RADIANCE = 16, 400.0, 0.5 * 111000 / 400**2
SIGMAS, SEEDS, SEVEN, HALF_SENSOR = 5.0, 8, 7.0, 3.2


def tracer(bench: Bench, anchors: int = 1, geometry: CameraGeometry | None = None, **lens: float) -> DirectTracer:
    projector = replace(bench.projector_optics, **lens)
    return DirectTracer(replace(bench.setup, projector=projector, geometry=geometry or bench.geometry), anchors)


@pytest.fixture(scope="module")
def white(shared_scene: Callable[..., Path], variant: str) -> Bench:
    return open_bench(shared_scene("white"), variant)


@pytest.fixture(scope="module")
def large(shared_scene: Callable[..., Path], variant: str) -> Bench:
    """A sensor of 40 mm (pixels of 0.625 mm): its anchors see the board from clearly different places."""
    return open_bench(shared_scene("large", pitch=0.625, fov=30), variant, for_render=True)


def falloff(tau_row: np.ndarray, tau_column: np.ndarray, row: float = 0.0, column: float = 0.0) -> np.ndarray:
    return (1 + np.square(tau_row - row / Z) + np.square(tau_column - column / Z)) ** -2


def expected(row: float = 0.0, column: float = 0.0, exponent: float = 0.0) -> np.ndarray:
    """(n^2,) irradiance of each projector pixel at a sensor point: L times the integral of its tan-angles' falloff."""
    node, weight = np.polynomial.legendre.leggauss(4)
    tau = ((np.arange(N) + 0.5)[:, None] + node / 2) * 0.3 / N - 0.15
    value = falloff(tau.ravel()[:, None], tau.ravel()[None, :], row, column) ** (1 + exponent / 4)
    weights = np.tile(weight * 0.15 / N, N)
    cells = (weights[:, None] * value * weights[None, :]).reshape(N, 4, N, 4).sum(axis=(1, 3))
    return RADIANCE * cells.ravel()


def by_pixel(found: PathSamples, samples: int) -> np.ndarray:
    return np.bincount(found.pixel, found.value, minlength=N * N) / samples


def test_every_pixels_light_is_its_irradiance_at_every_anchor(large: Bench) -> None:
    """Pixel by pixel and anchor by anchor. The falloff inside a pixel is all that varies between rays."""
    found = tracer(large, 2).trace(3, 0, 16)
    positions = anchor_positions(2, large.geometry.half_width)
    for a, b in np.ndindex(2, 2):
        mine = found.where((found.anchor_row == a) & (found.anchor_column == b))
        light, truth = by_pixel(mine, 16), expected(positions[a], positions[b])
        # It changes by 2 % over a pixel at most; sixteen stratified points leave a twentieth of that.
        assert np.abs(light / truth - 1).max() < 1.5e-3
        assert light.sum() == pytest.approx(truth.sum(), rel=1e-4)


def test_a_pixel_is_seen_where_it_lights_the_board(white: Bench) -> None:
    """Directions in index coordinates: row r from -0.15 + r 0.3/n on, and evenly over the pixel."""
    found = tracer(white).trace(1, 0, 64)
    row, column = np.divmod(found.pixel, N)
    inside = (found.row + 0.15) * N / 0.3 - row, (found.column + 0.15) * N / 0.3 - column
    for place in inside:
        assert place.min() > -1e-4 and place.max() < 1 + 1e-4
        assert np.histogram(place, 8, (0, 1))[0].std() < 0.02 * len(place) / 8
    assert 1 / found.inverse_depth == pytest.approx(np.full(len(found.value), 400.0), rel=1e-6)
    assert (found.kind == DIRECT).all() and not found.anchor_row.any() and not found.anchor_column.any()


def test_a_spread_sensor_is_the_mean_over_it(large: Bench) -> None:
    """Random points of the sensor, accumulated as one anchor: the mean of the irradiance over the sensor."""
    spread = DirectTracer(large.setup, 1, spread=True)
    totals = np.array([by_pixel(spread.trace(seed, 0, 16), 16).sum() for seed in range(8)])
    node, weight = np.polynomial.legendre.leggauss(4)
    half = large.geometry.half_width
    mean = sum(v * w / 4 * expected(half * x, half * y).sum() for x, v in zip(node, weight, strict=True)
               for y, w in zip(node, weight, strict=True))  # fmt: skip
    error = totals.std(ddof=1) / np.sqrt(8)
    assert abs(totals.mean() - mean) < 7 * error + 1e-5 * mean  # five sigma of the t distribution of 7 degrees
    assert error < 1e-3 * mean


def test_a_ball_casts_its_shadow(small_scene: Callable[..., Path]) -> None:
    """Points of the sheet that the ball hides from the projector are not lit, those it hides from the camera not seen.

    The ball (radius 20 at z = 200) hides x^2 + y^2 < 40^2 or so of the sheet from the camera, and a place near
    x = -60 from the projector at x = 60.
    """
    ball = '<shape type="sphere"><point name="center" x="0" y="0" z="200"/><float name="radius" value="20"/></shape>'
    found = tracer(open_bench(small_scene(extra=ball))).trace(0, 0, 16)
    sheet = found.inverse_depth < 1 / 395
    x, y = -found.column[sheet] / found.inverse_depth[sheet], -found.row[sheet] / found.inverse_depth[sheet]
    assert not (np.hypot(x, y) < 39.5).any() and (np.hypot(x, y) < 42).any()
    assert not (np.hypot(x + 59, y) < 36).any(), "the shadow beside it"
    assert (np.abs(1 / found.inverse_depth[~sheet] - 190) < 11).all() and (~sheet).mean() > 0.02


def test_the_field_stop_cuts(small_scene: Callable[..., Path]) -> None:
    found = tracer(open_bench(small_scene(fov=10))).trace(0, 0, 4)
    stop = np.tan(np.radians(5))
    assert np.abs(found.row).max() <= stop * (1 + 1e-6) and np.abs(found.row).max() > 0.95 * stop
    assert np.abs(found.column).max() <= stop * (1 + 1e-6)


def test_the_pixels_response(white: Bench) -> None:
    """cos^n, as the geometry says: the falloff's power grows by n/4."""
    geometry = white.geometry.model_copy(update={"angular_exponent": 6.0})
    light = by_pixel(tracer(white, 1, geometry).trace(2, 0, 16), 16)
    assert light == pytest.approx(expected(exponent=3.0 * 4 / 2), rel=2e-3)
    assert by_pixel(tracer(white).trace(2, 0, 16), 16) == pytest.approx(expected(), rel=1e-3)


@pytest.mark.parametrize("lens", [{"aperture": 4.0, "focus": 200.0}, {"blur": 0.7}])
def test_lens_and_spot_keep_a_pixels_light_and_spread_it(white: Bench, lens: dict[str, float]) -> None:
    """Circle of radius a |z - f| / f = 4 mm on the sheet; a normal spot of 0.7 pixels of 7.5 mm. Pixel (8, 8)."""
    found = tracer(white, **lens).trace(1, 0, 4096)
    mine = found.where(found.pixel == 8 * N + 8)
    assert mine.value.sum() / 4096 == pytest.approx(expected()[8 * N + 8], rel=2e-3)
    spread = 4.0**2 / 4 if "aperture" in lens else (0.7 * 7.5) ** 2
    for place in (mine.row, mine.column):
        assert np.var(place * 400) == pytest.approx(7.5**2 / 12 + spread, rel=SIGMAS * np.sqrt(2 / 4096))
        assert np.mean(place * 400) == pytest.approx(3.75, abs=SIGMAS * 8 / 64)


def test_light_that_is_not_a_number_is_refused(small_scene: Callable[..., Path]) -> None:
    # Put there after loading: a file that says NaN is refused before Mitsuba sees it.
    bench = open_bench(small_scene())
    parameters = mi.traverse(bench.loaded.projector)
    parameters["scale"] = float("nan")
    parameters.update()
    with pytest.raises(MitsimError, match="NaN"):
        tracer(bench).trace(0)


def test_chosen_pixels_are_traced_as_among_all(white: Bench) -> None:
    chosen = np.array([3, 17, 250])
    some = DirectTracer(white.setup, 1, pixels=chosen)
    assert some.paths_per_sample == 3
    mine, whole = some.trace(5, 0, 4), tracer(white).trace(5, 0, 4)
    expected = whole.where(np.isin(whole.pixel, chosen))
    assert np.array_equal(np.sort(mine.pixel), np.sort(expected.pixel)) and len(mine.value) == 12
    for name in ("value", "row", "column"):
        assert np.sort(getattr(mine, name)) == pytest.approx(np.sort(getattr(expected, name)), rel=1e-6)


def test_sums_are_those_of_what_is_traced(large: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """By pixel and anchor, in launches that end within a sample. (Planted: rows and columns of anchors exchanged.)"""
    chosen = np.array([3, 17, 250])
    some = DirectTracer(large.setup, 2, pixels=chosen)
    seen = some.trace(5, 0, 3)
    place = (np.searchsorted(chosen, seen.pixel) * 2 + seen.anchor_row) * 2 + seen.anchor_column
    monkeypatch.setattr(integrator.Tracer, "paths_per_launch", 7)
    found = some.sums(5, 3)
    assert np.allclose(found, np.bincount(place, seen.value, 12).reshape(3, 2, 2), rtol=1e-6)
    assert (found > 0).all() and not np.allclose(found, found.transpose(0, 2, 1), rtol=1e-3)


# -------- Flux on the sensor as a whole
#
# Flux on the sensor as a whole over lobes of any roughness, against quadrature and against plain connections.
#
# Gates on means of eight seeds are seven standard errors (t distribution of 7 degrees of freedom: 2e-4), plus what is
# stated; each test says how narrow they are.

HOLE = """<shape type="rectangle"><transform name="to_world"><scale x="80" y="80"/><rotate y="1" angle="180"/>
    <translate x="30" z="250"/></transform><bsdf type="mask"><float name="opacity" value="{}"/>
    <bsdf type="diffuse"><spectrum name="reflectance" value="0"/></bsdf></bsdf></shape>"""


@pytest.fixture
def plated(small_scene: Callable[..., Path], variant: str) -> Callable[..., Bench]:
    """A plate of some roughness alone before a sensor of 6.4 mm, behind a black card of some opacity."""

    def load(alpha: float, opacity: float | None = None) -> Bench:
        parts = glossy(alpha, sheet=False)
        extra = parts.pop("extra") + ("" if opacity is None else HOLE.format(opacity))
        return open_bench(
            small_scene("flux", n=N, mask="open", pitch=0.1, extra=extra, **parts), variant, for_render=True
        )

    return load


LIT = (N * np.arange(6, 10)[:, None] + np.array([2, 3, 4, 5, 10, 11, 12, 13])).ravel()
"""Pixels about those that the plate mirrors into the sensor; beyond them lies 1e-3 of a GGX lobe of 1e-3."""


def flux(plated: Bench, glossy: bool, samples: int, pixels: np.ndarray | None = None) -> tuple[float, float]:
    tracer = FluxTracer(plated.setup, glossy)
    pixels = np.arange(N * N) if pixels is None else pixels
    sums = tracer.sums(0, SEEDS, pixels, np.zeros_like(pixels), samples)[0].sum(axis=1) / samples
    return float(np.mean(sums)), float(np.std(sums, ddof=1) / np.sqrt(SEEDS))


def over_the_sensor(alpha: float) -> float:
    """Mean irradiance over the sensor, by quadrature."""
    node, weight = gauss(-HALF_SENSOR, HALF_SENSOR, 6)
    weight = weight / weight.sum()
    return float(weight @ np.array([[lobe(alpha, row, column) for column in node] for row in node]) @ weight)


@pytest.mark.parametrize("alpha", [pytest.param(3e-2, marks=pytest.mark.slow), 1e-4])
def test_flux_over_lobes_is_that_of_quadrature(plated: Callable[..., Bench], alpha: float) -> None:
    """Connections alone are off by more than the gate, or noisier (seen failing without sampled turns)."""
    found, error = flux(plated(alpha), True, 512) if alpha > 1e-3 else flux(plated(alpha), True, 2**14, LIT)
    gate, expected = SEVEN * error + 1e-3 * found, over_the_sensor(alpha)
    assert gate < 0.04 * expected
    assert abs(found - expected) < gate, f"{found / expected - 1:+.2%}, gate {gate / expected:.2%}"


def test_truth_over_a_sharp_lobe_is_exact_to_its_standard_error(plated: Callable[..., Bench]) -> None:
    """All pixels together; their errors are independent."""
    plate = plated(1e-3)
    first = trace_truth(plate, Settings(400.0), 9, np.full(N * N, np.inf))
    # Frames are off where another seed's truth is, by 5 % of the board: they tell where the lobe is.
    error = first.standard_error.ravel() * first.board_flux
    truth = trace_truth(plate, Settings(400.0), 0, 0.05 / first.error * error)
    found = float((truth.reflectance.ravel() * truth.board_flux).sum())
    error = float(np.linalg.norm(truth.standard_error.ravel() * truth.board_flux))
    assert 0 < SEVEN * error < 0.05 * found
    assert abs(found - over_the_sensor(1e-3)) < SEVEN * error + 1e-3 * found


def test_sums_are_those_of_blocks_however_they_are_traced(
    plated: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A long block is two short ones, in any order and number of launches; groups and pixels have streams of their own.

    (Planted: a sample's number without the block's first; the same stream in all groups.)
    """
    devices = plated(0.3, 0.5)
    tracer = FluxTracer(devices.setup, True)
    first = np.full_like(LIT, 3)
    whole = tracer.sums(5, 2, LIT, first, 40)[0]
    lit = whole[0] > 0
    assert lit.sum() > 12 and (whole[0] != whole[1])[lit].all()
    pixels, starts = np.concatenate([LIT[::-1], LIT]), np.concatenate([first + 20, first])
    halves = tracer.sums(5, 2, pixels, starts, 20)[0]
    assert halves[:, : len(LIT)][:, ::-1] + halves[:, len(LIT) :] == pytest.approx(whole, rel=1e-12)
    monkeypatch.setattr(FluxTracer, "paths_per_launch", 3 * 40 + 1)
    np.testing.assert_allclose(tracer.sums(5, 2, LIT, first, 40)[0], whole, rtol=1e-6)
