"""The projector as the tracer sees it: a pinhole, a lens and a blurred spot, against the stock emitter and geometry.

Points of the scene are made by hand, so no scene and no camera is in the way. Gates on means of random numbers are five
standard deviations at fixed seeds; everything else holds path by path within float32 rounding.
"""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsim.transport import plugins
from mitsim.transport.connect import (
    Connection,
    LensHit,
    PinholeRays,
    ProjectorConnector,
    ProjectorOptics,
    ProjectorRays,
)
from mitsim.transport.plugins.base import generator
from tests.aperture import aperture_scene_parts
from tests.unit.transport.closed_forms import stock_projector

pytestmark = pytest.mark.usefixtures("variant")
SCALE, N, SIGMAS, SAMPLES = 111000.0, 128, 5.0, 2**16
PLACE = (60.0, -5.0, 2.0)
STEP = 0.3 / N
"""Pixel over distance: fov_axis x has tan 0.3 on either side of the axis, for 2 n pixels."""


def emitter(turn: float = 0.0, canvas: np.ndarray | None = None, place: tuple[float, ...] = PLACE) -> Any:
    return stock_projector(N, SCALE, place, turn, canvas)


def connector(light: Any = None, n: int = N, first_column: int = N, **lens: float) -> ProjectorConnector:
    return ProjectorConnector(
        ProjectorOptics(light or emitter(), n, 0, first_column, (N, 2 * N), **{"focus": 400.0, **lens})
    )


def at(points: np.ndarray) -> Any:
    si = dr.zeros(mi.SurfaceInteraction3f, len(points))
    si.p = mi.Point3f(*points.T.astype(np.float32))
    return si


def connected(connector: ProjectorConnector, points: np.ndarray, seed: int = 3) -> Connection:
    rng = generator(mi.UInt32(seed), dr.arange(mi.UInt32, len(points)))
    return connector.connect(at(points), rng, mi.Bool(True))


def lens_hit(made: ProjectorConnector, ray: Any, reach: Any = np.inf) -> LensHit:
    return made.hit(ray, mi.Float(reach), generator(mi.UInt32(1), mi.UInt32(0)), mi.Bool(True))


def numbers(value: Any) -> np.ndarray:
    return np.array(value, dtype=np.float64).ravel()


def board(z: float, count: int = 4000, seed: int = 1) -> np.ndarray:
    """Points on the plane z = const. (of the world), inside the light of an unturned projector's window."""
    rng, depth = np.random.default_rng(seed), z - PLACE[2]
    x, y = PLACE[0] - rng.uniform(0.015, 0.285, count) * depth, PLACE[1] + rng.uniform(-0.135, 0.135, count) * depth
    return np.stack([x, y, np.full(count, z)], axis=1)


def repeated(point: tuple[float, float, float]) -> np.ndarray:
    return np.tile(point, (SAMPLES, 1))


# ---- the pinhole, and the limits of lens and blur


def test_pixels_are_the_windows_rows_and_columns() -> None:
    """Row 0 at +y, column 0 at +x: the window spans x = 60 - 120 .. 60 and y = -5 +- 60 at 400 mm from the lens."""
    row, column = np.divmod(np.arange(N * N), N)
    step = STEP * 400
    points = np.stack([60 - (column + 0.5) * step, -5 + (N / 2 - row - 0.5) * step, np.full(N * N, 402.0)], axis=1)
    found = connected(connector(), points)
    assert np.array_equal(numbers(found.pixel), np.arange(N * N))


@pytest.mark.parametrize("turn", [0.0, 7.0])
@pytest.mark.parametrize("lens", [{"aperture": 1e-4}, {"blur": 1e-4}, {"aperture": 1e-4, "blur": 1e-4}])
@pytest.mark.parametrize("z", [250.0, 400.0, 800.0])
def test_a_small_lens_and_a_small_spot_are_the_pinhole(turn: float, lens: dict[str, float], z: float) -> None:
    light, points = emitter(turn), board(z)
    sharp, found = connected(connector(light), points), connected(connector(light, **lens), points)
    both = numbers(sharp.valid).astype(bool) & numbers(found.valid).astype(bool)
    assert (numbers(sharp.valid) != numbers(found.valid)).mean() < 2e-3, "but for the window's edge"
    assert both.mean() > 0.5
    assert numbers(found.weight)[both] == pytest.approx(numbers(sharp.weight)[both], rel=2e-4)
    directions = [np.array(one.direction, dtype=np.float64)[:, both] for one in (sharp, found)]
    assert np.abs(directions[0] - directions[1]).max() < 1e-5
    assert (numbers(found.pixel)[both] != numbers(sharp.pixel)[both]).mean() < 5e-3, "but for pixels' edges"


# ---- the lens


@pytest.mark.parametrize("z", [250.0, 400.0, 800.0])
def test_irradiance_on_a_plane_does_not_depend_on_the_lens(z: float) -> None:
    """weight x cos is pi scale / z^2 for every path from every lens point: an even picture has no vignette."""
    found = connected(connector(aperture=8.0, focus=300.0), board(z))
    lit = numbers(found.valid).astype(bool)
    cosine = -np.array(found.direction, dtype=np.float64)[2]
    assert lit.mean() > 0.8
    expected = np.pi * SCALE / (z - PLACE[2]) ** 2
    assert (numbers(found.weight) * cosine)[lit] == pytest.approx(np.full(lit.sum(), expected), rel=2e-4)


@pytest.mark.parametrize(("z", "focus"), [(602.0, 400.0), (302.0, 400.0), (802.0, 200.0)])
def test_defocus_spreads_a_point_over_the_geometric_circle(z: float, focus: float) -> None:
    """A point at depth z sees the focus plane through the lens: a disk of radius a |1 - focus/z| there."""
    depth = z - PLACE[2]
    found = connected(connector(aperture=9.0, focus=focus), repeated((25.0, 0.0, z)))
    assert numbers(found.valid).all()
    radius = 9.0 * abs(1 - focus / depth) / (STEP * focus)
    assert radius > 3
    row, column = np.divmod(numbers(found.pixel), N)
    for index in (row, column):
        # Uniform disk: variance r^2/4 along an axis, and 1/12 from rounding to whole pixels.
        assert np.var(index) == pytest.approx(radius**2 / 4 + 1 / 12, rel=0.02)
        assert np.ptp(index) == pytest.approx(2 * radius, abs=1.6)
    sharp = connected(connector(), repeated((25.0, 0.0, z))[:1])
    centre = np.divmod(numbers(sharp.pixel)[0], N)
    assert abs(row.mean() - centre[0]) < 0.51 and abs(column.mean() - centre[1]) < 0.51


def test_light_found_by_chance_is_that_of_a_connection() -> None:
    """A ray through a lens point, and the connection to that point: the same radiance, density and pixel."""
    values = np.random.default_rng(5).uniform(0.2, 1, (N, 2 * N))
    made = connector(emitter(4.0, values), aperture=6.0, focus=300.0)
    points = board(350.0)
    found = connected(made, points)
    ray = mi.Ray3f(at(points).p, found.direction)
    hit = lens_hit(made, ray)
    inner = numbers(found.valid).astype(bool) & numbers(hit.met).astype(bool)
    assert inner.mean() > 0.6 and (numbers(found.valid)[~inner] == 0).mean() > 0.99
    assert numbers(hit.pdf)[inner] == pytest.approx(numbers(found.pdf)[inner], rel=1e-3)
    same = numbers(hit.pixel)[inner] == numbers(found.pixel)[inner]
    assert same.mean() > 0.98, "float32 at pixels' edges"
    expected = (numbers(found.weight) * numbers(found.pdf))[inner][same]
    assert numbers(hit.radiance)[inner][same] == pytest.approx(expected, rel=2e-3)


def test_the_radiance_is_that_of_the_reference_estimators_projector() -> None:
    """Plugin ``mitsim_projector``, whose disk a ray meets: radiance texel by texel (random texels tell them apart)."""
    plugins.register()
    light = emitter(4.0, np.random.default_rng(5).uniform(0.2, 1, (N, 2 * N)))
    made = connector(light, aperture=6.0, focus=300.0)
    points = board(350.0)
    found = connected(made, points)
    scene = mi.load_dict({"type": "scene", **aperture_scene_parts(light, 6.0, 300.0)})
    ray = mi.Ray3f(at(points).p, found.direction)
    si = scene.ray_intersect(ray)
    expected = numbers(si.emitter(scene).eval(si))
    hit = lens_hit(made, ray)
    lit = numbers(hit.met).astype(bool) & numbers(found.valid).astype(bool)
    ratio = numbers(hit.radiance)[lit] / expected[lit]
    assert lit.mean() > 0.6
    assert np.quantile(np.abs(ratio - 1), 0.98) < 2e-3


def test_rays_that_miss_the_lens() -> None:
    made = connector(aperture=6.0)
    origin = np.array([[40.0, 0.0, 400.0]] * 4)
    target = np.array(PLACE) + np.array([[0, 0, 0], [6.1, 0, 0], [0, 0, 0], [0, 0, 0]])
    direction = target - origin
    reach = np.linalg.norm(direction, axis=1)
    direction /= reach[:, None]
    direction[2] *= -1  # away from the lens
    reach[3] *= 0.9  # something is in between
    reach[:3] *= 1.1
    ray = mi.Ray3f(mi.Point3f(*origin.T), mi.Vector3f(*direction.T))
    met = numbers(lens_hit(made, ray, reach).met)
    assert met.tolist() == [1, 0, 0, 0]
    behind = mi.Ray3f(mi.Point3f(60, -5, -300), mi.Vector3f(0, 0, 1))
    assert not numbers(lens_hit(made, behind).met).any()


# ---- the spot


@pytest.mark.parametrize("blur", [1.5, 4.0])
@pytest.mark.parametrize("z", [302.0, 602.0])
@pytest.mark.parametrize("turn", [0.0, 6.0])
def test_a_blurred_pixel_has_the_stated_deviation(blur: float, z: float, turn: float) -> None:
    """A normal spot: standard deviation in projector pixels at any depth, on rows and columns alike."""
    made = connector(emitter(turn), blur=blur)
    depth = z - PLACE[2]
    middle = np.tan(np.arctan(0.15) - np.radians(turn))  # of the window, whose axis is turned
    point = (60 - middle * depth, -5.0, z)
    row, column = np.divmod(numbers(connected(made, repeated(point)).pixel), N)
    variance = blur**2 + 1 / 12
    gate = SIGMAS * np.sqrt(2 / SAMPLES)
    for index in (row, column):
        assert abs(np.var(index) / variance - 1) < gate
        assert np.mean(np.abs(index - index.mean()) < blur) == pytest.approx(0.683, abs=0.16 / blur)
    assert abs(np.corrcoef(row, column)[0, 1]) < SIGMAS / np.sqrt(SAMPLES)
    centre = np.divmod(numbers(connected(connector(emitter(turn)), repeated(point)[:1]).pixel)[0], N)
    assert abs(row.mean() - centre[0]) < 0.55 and abs(column.mean() - centre[1]) < 0.55


# -------- One map from pixels to rays, areas and flux
#
# One map from the projector's pixels to rays, areas and flux: its uses in the renderer's and in NumPy's numbers agree.
#
# Planted: rows and columns exchanged in ``pixel_at``, and an area of the canvas instead of a pixel, fail.

SMALL = 16


@pytest.fixture
def projector(variant: str) -> ProjectorOptics:
    """A turned one, every texel of another brightness; the window lies off the canvas's centre."""
    canvas = np.random.default_rng(2).uniform(0.2, 1, (SMALL + 4, 2 * (SMALL + 4)))
    return ProjectorOptics(stock_projector(SMALL + 4, 111000.0, PLACE, 7.0, canvas), SMALL, 3, 21, canvas.shape)


def test_rays_areas_and_flux_are_of_one_map(projector: ProjectorOptics) -> None:
    pixel = np.arange(SMALL * SMALL)
    paths_per_sample, rng = mi.UInt32(pixel), generator(mi.UInt32(1), mi.UInt32(0))
    wavelengths = dr.zeros(mi.Ray3f).wavelengths
    rays, pinhole = ProjectorRays(projector), PinholeRays(projector, [None])
    ray = rays.sample(paths_per_sample, mi.Point2f(0.5), rng, wavelengths)
    centres = np.stack(np.divmod(pixel, SMALL), axis=1) + 0.5
    direction = np.array(ray.d, dtype=np.float64).T
    assert np.abs(direction - pinhole.directions(centres)).max() < 2e-7
    flux = np.array(rays.flux(paths_per_sample, wavelengths), dtype=np.float64).ravel()
    assert flux == pytest.approx(pinhole.power[:, 0] * pinhole.area, rel=2e-5)
    assert len(np.unique(flux)) == SMALL * SMALL
    si = dr.zeros(mi.SurfaceInteraction3f, SMALL * SMALL)
    si.p = mi.Point3f((pinhole.origin + 500 * direction).T.astype(np.float32))
    connection = ProjectorConnector(projector).connect(si, rng, mi.Bool(True))
    assert np.array_equal(np.array(connection.pixel), pixel)
