"""Light by its order, the surfaces that turned it: closed forms in a sphere, and sums that are the whole.

Gates on Monte Carlo means are seven standard errors of eight independent seeds: five sigma of the t distribution.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.transport.from_camera import FromCameraTracer
from mitsim.transport.indirect import IndirectTracer
from mitsim.transport.integrator import ANY, FollowingTracer, Paths
from mitsim.transport.path_reuse import PathReuseTracer
from mitsim.transport.records import AMBIENT, DIRECT, INDIRECT, PathSamples, aligned_grid
from tests.unit.transport.closed_forms import mean, seen
from tests.unit.transport.test_indirect import CORNER, MATT, MIRROR, SPHERE

pytestmark = pytest.mark.usefixtures("variant")
N, SEEDS, SIGMAS, RHO = 16, 8, 7.0, 0.5
SKY = '<emitter type="constant"><spectrum name="radiance" value="20"/></emitter>'


@pytest.mark.slow
@pytest.mark.parametrize("kind", [IndirectTracer, PathReuseTracer])
def test_each_reflection_in_a_sphere_keeps_the_albedo(
    shared_scene: Callable[..., Path], kind: type[IndirectTracer]
) -> None:
    """Light of order k is even in a diffuse sphere: E_k = Phi rho^k / (pi A) for k >= 2, Phi being the projector's."""
    bench = open_bench(shared_scene(f"orders_{kind.__name__}", extra=SPHERE.format(bsdf=MATT), sheet_z=3000))
    all_orders = kind(bench.setup, Paths(False, True))
    second = np.pi * 111000 * 0.3**2 * RHO**2 / np.pi / (4 * np.pi * 1000**2) * seen(bench.geometry.tan_half_fov)
    for (fewest, most), part in {(2, 2): 1.0, (3, 3): RHO, (3, ANY): RHO / (1 - RHO)}.items():
        tracer = all_orders.of_orders(fewest, most)
        total, error = mean(np.array([tracer.trace(seed, 0, 128).value.sum() / 128 for seed in range(SEEDS)]))
        assert SIGMAS * error < 0.4 * part * second, "a count that is off by one halves the light"
        assert abs(total - part * second) < SIGMAS * error, (fewest, most)
    assert not all_orders.of_orders(1, 1).trace(0, 0, 4).value.any(), "direct light is another tracer's"


@pytest.fixture(scope="module")
def hall(shared_scene: Callable[..., Path], variant: str) -> Bench:
    """A sheet, a shiny wall, a mirror, and a sky; before a lens of 30 mm where one is asked for."""
    return open_bench(shared_scene("hall", extra=CORNER + MIRROR.replace("-40", "60") + SKY), variant)


def tracers(bench: Bench) -> dict[str, FollowingTracer]:
    """Of both sides."""
    lens = replace(bench.setup, projector=replace(bench.projector_optics, aperture=30.0))
    grid = aligned_grid(*bench.windows, N, 1, bench.geometry.tan_half_fov)
    paths = Paths(mirrors=True, interreflection=True, emitters=bench.loaded.lamps)
    return {
        "projector": IndirectTracer(bench.setup, Paths(True, True)),
        "neighbours": PathReuseTracer(bench.setup, Paths(False, True)),
        "camera": FromCameraTracer(bench.setup, grid, paths),
        "lens": FromCameraTracer(lens, grid, paths),
    }


@pytest.mark.parametrize(
    "name", ["projector", "lens", *(pytest.param(name, marks=pytest.mark.slow) for name in ("neighbours", "camera"))]
)
def test_orders_add_up_to_all_light(hall: Bench, name: str) -> None:
    """Path by path, so pixel by pixel to the rounding: direct light in mirrors, indirect light, that of lamps.

    (Planted: a path that ends before it runs into the sky; an order that is kept with the one before; light to the sky
    that is kept of any order; second points of neighbours likewise.)
    """
    tracer, samples = tracers(hall)[name], 128 if name == "camera" else 16  # of which few come so far
    parts = {order: tracer.of_orders(order, order).trace(1, 0, samples) for order in (0, 1, 2, 3)}
    parts[4] = tracer.of_orders(4, ANY).trace(1, 0, samples)
    every = tracer.trace(1, 0, samples)
    for kind in (DIRECT, INDIRECT, AMBIENT):
        whole = by_path(every, kind, name)
        summed = sum(by_path(each, kind, name) for each in parts.values())
        np.testing.assert_allclose(summed, whole, rtol=1e-4, atol=1e-6 * whole.max())
    assert {*parts[0].kind} <= {AMBIENT} and {*parts[1].kind} <= {DIRECT, AMBIENT}
    for order in (2, 3, 4):
        assert INDIRECT in parts[order].kind and DIRECT not in parts[order].kind


def test_the_sky_is_seen_or_lights_the_sheet_once(shared_scene: Callable[..., Path]) -> None:
    """Around a sheet of albedo 0.5, |x|, |y| < 64 mm at 400 mm: all sky of radiance 20 is order 0, all sheet order 1.

    Paths find the sky by connections and by running into it, which share the light of the sheet. (Planted: what is run
    into counted as one surface more; the sky's share of connections left out.)
    """
    bench = open_bench(shared_scene("sky", extra=SKY))
    tracer = tracers(bench)["camera"]
    sheet, stop = seen(64 / 400), seen(bench.geometry.tan_half_fov)
    for order, expected in enumerate((20 * (stop - sheet), 10 * sheet)):
        found = [tracer.of_orders(order, order).trace(seed, 0, 64) for seed in range(SEEDS)]
        total, error = mean(np.array([light.value.sum() / 64 for light in found]))
        assert SIGMAS * error < 0.1 * expected
        assert abs(total - expected) < SIGMAS * error
    assert not tracer.of_orders(2, ANY).trace(0, 0, 64).value.any()


def by_path(light: PathSamples, kind: int, side: str) -> np.ndarray:
    """Light of a ``kind`` by where its paths start: pixels of the projector, or cells of the camera's view."""
    kept = light.where(light.kind == kind)
    if side in ("projector", "neighbours"):
        return np.bincount(kept.pixel, kept.value, N * N)
    return np.histogram2d(kept.row, kept.column, 2 * [np.linspace(-0.4, 0.4, 41)], weights=kept.value)[0]
