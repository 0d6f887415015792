"""Direct light that is accumulated on the device: what the host accumulates of the same paths, place by place."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.light.passes import LightEstimate, Simulation
from mitsim.light.settings import Settings, SharpPixels

pytestmark = pytest.mark.usefixtures("variant")
N, SAMPLES = 16, 96
BALL = """<shape type="sphere"><point name="center" x="10" y="5" z="330"/><float name="radius" value="20"/>
    <bsdf type="roughconductor"><string name="material" value="none"/>
    <float name="alpha" value="0.05"/></bsdf></shape>"""
SETTINGS = Settings(
    depth=380.0,
    anchors=3,
    layers=(400.0, 350.0, 310.0),
    coarse_layers=True,
    subdivision=2,
    # A window that holds most of the light of these pixels, and not all.
    sharp=SharpPixels(tuple(range(50, 200, 7)), 3, (-0.03, 0.05, -0.03, 0.05)),
    samples={"anchor_residual": SAMPLES, "sharp": 1000.0},
)


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path], variant: str) -> Bench:
    """A ball before the sheet, seen by a sensor of 6.4 mm."""
    return open_bench(shared_scene("ball", n=N, pitch=0.1, extra=BALL), variant, for_render=True)


def both(simulation: Simulation, name: str, labels: np.ndarray) -> tuple[LightEstimate, LightEstimate]:
    """Light of a pass by the host and by the device."""
    each = simulation.passes[name]
    path_samples, accumulator = each.trace(3, 0, SAMPLES), simulation.accumulator(name, labels, 1)
    assert accumulator is not None
    rest = each.trace(3, 0, SAMPLES, accumulator)
    assert not len(rest.value) and len(path_samples.value) > 1000
    (sums,) = accumulator.fetch()
    host, device = (simulation.accumulate(name, found, labels, SAMPLES) for found in (path_samples, sums))
    return host, device


@pytest.mark.parametrize("name", ["anchor_residual", "sharp"])
def test_the_device_adds_up_what_the_host_does(bench: Bench, name: str) -> None:
    """Light between layers and between cells is split, not drawn. (Planted: rows and columns of anchors exchanged; the
    nearer layer's part for the farther; the first cell of two alone; what lies outside accumulated as the first
    anchor's; pixels' rows for classes'.)"""
    labels = np.random.default_rng(1).integers(0, 5, N * N)
    host, device = both(Simulation(bench, SETTINGS), name, labels)
    expected, found = (light[name].toarray() for light in (host, device))
    assert found.shape == expected.shape and np.count_nonzero(expected) > 500
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=2e-5 * np.abs(expected).max())
    assert np.abs(found - expected).sum() < 2e-5 * np.abs(expected).sum()
    if name == "sharp":
        assert 0 < host.outside < 0.5 * host.received
        assert (device.received, device.outside) == pytest.approx((host.received, host.outside), rel=1e-5)
        np.testing.assert_allclose(device.flux, host.flux, rtol=1e-5, atol=1e-7 * host.flux.max())


def test_few_paths_for_many_cells_are_left_to_the_host(bench: Bench) -> None:
    """An accumulator would be mostly empty. (Planted: always an accumulator.)"""
    labels = np.arange(N * N) % 49
    names = "anchor_residual", "sharp"
    few = Simulation(bench, replace(SETTINGS, samples=dict.fromkeys(names, 1.0)))
    many = Simulation(bench, replace(SETTINGS, samples=dict.fromkeys(names, 1000.0)))
    assert all(few.accumulator(name, labels, 1) is None for name in names)
    assert all(many.accumulator(name, labels, 3) is not None for name in names)


def test_the_middle_of_the_sharpest_lobe_is_light(bench: Bench, variant: str) -> None:
    """Accumulators refuse what is no light; what the sharpest lobe of Mitsuba brings is, and what is dim is not rounded
    away. (Planted: light compared to a board's own; `_LOBE` of 2^20.)"""
    simulation = Simulation(bench, SETTINGS)
    tracer = simulation.anchored
    assert tracer is not None
    lobe = mi.load_dict({"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": 1e-6})
    square = dr.zeros(mi.SurfaceInteraction3f)
    square.wi = mi.Vector3f(0, 0, 1)
    brightest = math.pi * float(np.max(np.array(lobe.eval(mi.BSDFContext(), square, mi.Vector3f(0, 0, 1)))))
    assert brightest > 2e7
    board = tracer.setup.board
    accumulator = simulation.accumulator("anchor_residual", np.zeros(N * N, dtype=np.int64), 1)
    for place, light in enumerate([10 * brightest * board, 1e-5 * board]):
        accumulator.add([mi.Float(light)], mi.UInt32(0), mi.UInt32(place))
    accumulated, *_ = accumulator.fetch()[0].light()
    np.testing.assert_allclose(accumulated.toarray()[0, :2] / board, [10 * brightest, 1e-5], rtol=0.02)
