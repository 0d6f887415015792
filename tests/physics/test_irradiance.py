"""Irradiance on the sensor against an integral done by quadrature, and where things land, without the package's optics.

Renderings use fixed seeds. Every gate on a Monte Carlo mean is five standard deviations (chance 6e-7 each), with the
standard deviation taken from the pixels themselves: a box filter makes them independent. Where a gate is meant to catch
a 1 % error, the test asserts that 1 % is more than twice the gate.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.devices.camera import CameraGeometry
from mitsim.devices.patterns import Lighting
from mitsim.optics.shadow import Directions
from mitsim.optics.terms import shadow_terms

pytestmark = pytest.mark.usefixtures("variant")
SCALE, Z, ALBEDO = 111000.0, 400.0, 0.5
RADIANCE = ALBEDO * SCALE / Z**2  # E = pi scale / z^2 on a plane that faces the projector; L = albedo E / pi
WINDOW = 0.15
SIGMAS = 5.0


def quadrature(half_width: float, low: float = -WINDOW, high: float = WINDOW) -> float:
    """Irradiance of the open sensor, mean over it: L times the integral of (1 + |tau - u/z|^2)^-2 over the window."""
    node, weight = np.polynomial.legendre.leggauss(12)
    tau, dtau = (low + high) / 2 + node * (high - low) / 2, weight * (high - low) / 2
    u, du = node * half_width, weight / 2
    t = tau[:, None] - u[None, :] / Z
    squared, measure = np.square(t).ravel(), np.outer(dtau, du).ravel()
    falloff = (1 + squared[:, None] + squared[None, :]) ** -2
    return float(RADIANCE * measure @ falloff @ measure)


def test_the_quadrature_is_the_known_view_factor() -> None:
    # Small square, half-angle t: integral of (1 + |t|^2)^-2 over it = 2 t / sqrt(1 + t^2) * 2 atan(t / sqrt(1 + t^2)),
    # pi times the view factor of a square from its axis (four corner squares; Howell, catalogue B-3).
    root = np.sqrt(1 + WINDOW**2)
    assert quadrature(1e-9) == pytest.approx(RADIANCE * 4 * WINDOW / root * np.arctan(WINDOW / root), rel=1e-12)


def render(path: Path, spp: int = 64, seed: int = 1) -> np.ndarray:
    import mitsuba as mi

    from mitsim.scene.load import load_scene

    return np.array(mi.render(load_scene(path).scene, spp=spp, seed=seed), dtype=np.float64)[..., 0]


def mean_and_error(frame: np.ndarray) -> tuple[float, float]:
    """Mean, and its standard deviation from the spread of pixels (falloff over this sensor is below 1e-4)."""
    return float(frame.mean()), float(frame.std(ddof=1) / np.sqrt(frame.size))


@pytest.mark.parametrize("integrator", ["path", "volpath"])
def test_irradiance_of_a_lambertian_plane(small_scene: Callable[..., Path], integrator: str) -> None:
    options = "" if integrator == "direct" else '<integer name="max_depth" value="2"/>'
    path = small_scene(mask="open", integrator=integrator, integrator_options=options)
    mean, error = mean_and_error(render(path, spp=128))
    expected = quadrature(64 * 0.01172 / 2)
    assert 2 * SIGMAS * error < 0.01 * expected, "too few samples to see 1 %"
    assert abs(mean - expected) < SIGMAS * error


def test_irradiance_falls_off_across_a_large_sensor(small_scene: Callable[..., Path]) -> None:
    # A sensor of 240 mm, and a field stop that all of it sees the window through: corners get a quarter less.
    pixels, pitch, spp = 16, 15.0, 16384
    path = small_scene(mask="open", mask_order=11, mask_feature=0.2, pixels=pixels, pitch=pitch, fov=50)
    frame = render(path, spp)
    # Two Gauss points a pixel and side.
    points = ((np.arange(pixels)[:, None] - 7.5 + np.array([-1, 1]) / (2 * np.sqrt(3))) * pitch).ravel()
    fine = np.array([[at(row, column) for column in points] for row in points])
    expected = fine.reshape(pixels, 2, pixels, 2).mean(axis=(1, 3))
    assert expected[0, 0] < 0.8 * expected[7, 7]
    # Spread of one path: it meets the window with probability (0.3 / 2 tan 25)^2 = 0.103.
    deviation = np.sqrt(1 / 0.103 - 1) / np.sqrt(spp)
    assert np.abs(frame / expected - 1).max() < SIGMAS * deviation * 1.3
    shape = expected - expected.mean()
    slope = (frame * shape).sum() / np.square(shape).sum()
    slope_error = deviation * expected.mean() / np.linalg.norm(shape)
    assert SIGMAS * slope_error < 0.25
    assert abs(slope - 1) < SIGMAS * slope_error


def at(row: float, column: float) -> float:
    """Irradiance of the open sensor at one point (index coordinates, mm)."""
    node, weight = np.polynomial.legendre.leggauss(16)
    tau, d = node * WINDOW, weight * WINDOW
    squared = np.square(tau - row / Z)[:, None] + np.square(tau - column / Z)[None, :]
    return float(RADIANCE * d @ (1 + squared) ** -2 @ d)


@pytest.mark.parametrize("mask", ["separable", "flatcam"])
def test_masked_mean_is_that_of_the_closed_form_shadow(small_scene: Callable[..., Path], mask: str) -> None:
    path = small_scene(mask=mask)
    first, second = render(path, spp=256, seed=1), render(path, spp=256, seed=2)
    mean, error = float((first + second).mean() / 2), mean_and_error((first - second) / 2)[1]
    geometry = CameraGeometry(mask=mask, pixels=64)
    edges = np.linspace(-WINDOW, WINDOW, 65)
    centre, size = (edges[:-1] + edges[1:]) / 2, edges[1] - edges[0]
    falloff = (1 + np.square(centre)[:, None] + np.square(centre)[None, :]) ** -2
    terms = shadow_terms(geometry, Directions.cells(edges), Directions.cells(edges), Z)
    expected = RADIANCE * size**2 * sum((left @ falloff @ right.T).mean() for left, right in terms)
    # Two passes: half their difference is free of the mask's pattern on the sensor.
    assert 2 * SIGMAS * error < 0.03 * expected
    assert abs(mean - expected) < SIGMAS * error


def test_devices_that_move_as_one_see_the_same(small_scene: Callable[..., Path]) -> None:
    plain = render(small_scene("plain"), spp=64)
    # A third of a turn about the diagonal (1, 1, 1), which permutes the axes, then a shift.
    moved = render(small_scene("moved", pose="0 0 1 30 1 0 0 -25 0 1 0 70 0 0 0 1"), spp=64)
    # The same paths; float32 lets a few of 262 144 change a feature of the mask or miss the window's edge.
    assert np.abs(moved - plain).max() < 0.5 * plain.mean()
    assert np.linalg.norm(moved - plain) < 0.01 * np.linalg.norm(plain)
    assert moved.mean() == pytest.approx(plain.mean(), rel=1e-4)


# ---- where things land: a pinhole image, worked out by hand in world coordinates


PINHOLE = {"mask_order": 2, "mask_feature": 0.05, "n": 16}
# The code of order 2 is 1 1 0: an opening of 0.1 mm whose centre lies half a feature toward +x and +y.
OPENING = 0.025


def image_of(x: float, y: float) -> tuple[float, float]:
    """(row, column) on the sensor, in pixels, where the pinhole at OPENING casts the point (x, y, Z)."""
    u = [(OPENING - 2 * place / Z) / (1 - 2 / Z) for place in (y, x)]
    return tuple(32 - 0.5 - coordinate / 0.01172 for coordinate in u)  # row 0 at +y, column 0 at +x


def centroid(frame: np.ndarray) -> tuple[float, float]:
    row, column = np.indices(frame.shape)
    return float((frame * row).sum() / frame.sum()), float((frame * column).sum() / frame.sum())


def factored_frame(path: Path, light: np.ndarray) -> np.ndarray:
    """Frame of the factored estimator when projector pixel (r, c) emits ``light[r, c]`` of its power."""
    from mitsim.api.bench import open_bench
    from mitsim.light.passes import Simulation, expected_of
    from mitsim.light.settings import Settings

    simulation = Simulation(open_bench(path), Settings(depth=Z, subdivision=4))
    labels = np.arange(light.size)
    groups = [simulation.accumulate("direct", simulation.direct.trace(seed, 0, 16), labels, 16) for seed in range(4)]
    lighting = Lighting(labels, light.reshape(1, -1))
    return next(iter(expected_of([(simulation, groups)], labels, lighting, 0))).irradiance


PIXELS = [(0, 0), (0, 15), (3, 11)]


@pytest.mark.parametrize("pixel", [PIXELS[0], *(pytest.param(pixel, marks=pytest.mark.slow) for pixel in PIXELS[1:])])
def test_a_projector_pixel_lands_where_it_should(small_scene: Callable[..., Path], pixel: tuple[int, int]) -> None:
    canvas = np.zeros((16, 32))
    canvas[pixel[0], 16 + pixel[1]] = 255
    row, column = image_of(60 - (pixel[1] + 0.5) * 7.5, 60 - (pixel[0] + 0.5) * 7.5)
    assert (row > 32) == (pixel[0] < 8), "a pinhole image stands on its head"
    light = (canvas[:, 16:] / 255).copy()
    found = centroid(factored_frame(small_scene("white", **PINHOLE), light))
    assert found == pytest.approx((row, column), abs=0.1)
    # A few hundred paths hit a spot of 11 pixels: their centroid is good to 0.2 pixels.
    found = centroid(render(small_scene("one", canvas=canvas, **PINHOLE), spp=2048))
    assert found == pytest.approx((row, column), abs=1.0)


def test_a_bright_patch_of_the_scene_lands_where_it_should(small_scene: Callable[..., Path]) -> None:
    reflectance = np.zeros((16, 16))
    reflectance[2, 1] = 255  # texels of 8 mm on the 128 mm sheet: centre at y = 44, x = 52, top left
    path = small_scene(reflectance=reflectance, **PINHOLE)
    expected = image_of(52.0, 44.0)
    assert expected[0] > 45 and expected[1] > 50 and expected[1] > expected[0] + 2
    assert centroid(factored_frame(path, np.ones((16, 16)))) == pytest.approx(expected, abs=0.1)
    assert centroid(render(path, spp=2048)) == pytest.approx(expected, abs=1.0)


def test_a_field_stop_inside_the_window_dims_both_estimators(small_scene: Callable[..., Path]) -> None:
    """A stop of 14 degrees sees tan-angles to 0.123 of the window's 0.15: two thirds of the light."""
    path = small_scene(mask="open", fov=14)
    mean, _ = mean_and_error(render(path, spp=64))
    assert mean == pytest.approx(quadrature(64 * 0.01172 / 2, -0.12278, 0.12278), rel=0.01)
    assert factored_frame(path, np.ones((16, 16))).mean() == pytest.approx(mean, rel=0.02)
