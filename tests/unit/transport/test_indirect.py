"""Indirect light from the projector's side, against a sphere and a mirror that have closed forms.

Gates on Monte Carlo means are seven standard errors of eight independent seeds: five sigma of the t distribution.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.transport.connect import SensorPoints
from mitsim.transport.from_camera import FromCameraTracer
from mitsim.transport.integrator import IndirectTracer, Paths
from mitsim.transport.records import (
    DIRECT,
    INDIRECT,
    Bundle,
    CellGrid,
    DeviceAccumulator,
    PathSamples,
    aligned_grid,
)
from tests.unit.transport.closed_forms import mean, seen

pytestmark = pytest.mark.usefixtures("variant")


@dataclass(frozen=True)
class Alone(SensorPoints):
    """One anchor of several."""

    of_several: SensorPoints | None = None
    index: int = 0

    def at(self, row: mi.UInt32, column: mi.UInt32, rng: mi.PCG32) -> mi.Point3f:
        assert self.of_several is not None
        # Opaque numbers, so that all anchors share one compiled kernel.
        down, right = (dr.opaque(type(row), place) for place in divmod(self.index, self.of_several.anchors))
        return self.of_several.at(row + down, column + right, rng)


@pytest.fixture(scope="module")
def beside(shared_scene: Callable[..., Path], variant: str) -> Bench:
    """A mirror before the upper half of a shiny wall, and a large sensor."""
    return open_bench(
        shared_scene("beside", extra=CORNER + BEFORE, pitch=0.375, mask_feature=0.3), variant, for_render=True
    )


def anchored(bench: Bench, points: SensorPoints) -> IndirectTracer:
    return IndirectTracer(bench.setup, Paths(True, True), points=points)


def compared(bench: Bench) -> tuple[int, list[str]]:
    """Fewest entries of a kind at an anchor, and what differs between paths to all anchors and to each alone."""
    points = SensorPoints(bench.geometry.half_width, 3)
    together, fewest, different = anchored(bench, points).trace(4, 0, 32), 2**30, []
    for index in range(points.count):
        alone = anchored(bench, Alone(points.half_width, of_several=points, index=index)).trace(4, 0, 32)
        at = together.where((together.anchor_row == index // 3) & (together.anchor_column == index % 3))
        for kind in (DIRECT, INDIRECT):
            mine, own = at.where(at.kind == kind), alone.where(alone.kind == kind)
            fewest = min(fewest, mine.value.size)
            names = ("pixel", "value", "row", "column", "inverse_depth", "lines")
            different += [name for name in names if not np.array_equal(getattr(mine, name), getattr(own, name))]
    return fewest, different


def test_a_path_is_the_same_at_every_anchor(beside: Bench) -> None:
    """Followed once for all anchors, it brings each what it would bring it alone, bit for bit. (Planted: the number
    that draws of caustics for that of indirect light; what the first anchor keeps joined to the light of all; the last
    anchor left out.)"""
    fewest, different = compared(beside)
    assert fewest > 100 and not different


@pytest.mark.parametrize("launch", [2**22, 9 * 512 + 5])
def test_accumulators_hold_what_anchors_are_brought(
    beside: Bench, launch: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The light that is handed out, by anchor and class of pixels; the same units however paths are launched. (Planted:
    rows for columns of anchors; launches that begin with the first path again.)"""
    points = SensorPoints(beside.geometry.half_width, 3)
    tracer, labels = anchored(beside, points), np.arange(N**2) % 5
    windows = [(low / 2, high / 2) for low, high in beside.windows]  # some light lies outside
    bundle = Bundle(aligned_grid(*windows, 2 * N, 1, 0.0), 3, (400.0, 300.0))
    whole, parts = (DeviceAccumulator(bundle, labels, tracer.board) for _ in range(2))
    caustics, host = tracer.trace(4, 0, 8, whole), tracer.trace(4, 0, 8)
    units = np.array(whole.sums)
    monkeypatch.setattr(IndirectTracer, "paths_per_launch", launch)
    again = PathSamples.join([tracer.trace(4, first, 4, parts) for first in (0, 4)])
    assert units.any() and np.array_equal(np.array(parts.sums), units)
    for name in ("kind", "pixel", "anchor_row", "anchor_column", "value"):
        assert np.array_equal(getattr(again, name), getattr(caustics, name)), name
    assert np.array_equal(caustics.value, host.value[host.kind == DIRECT]) and caustics.value.size
    expected = bundle.accumulate(host.where(host.kind == INDIRECT), labels)
    found, received, outside = whole.fetch()[0].light()
    indirect = host.where(host.kind == INDIRECT)
    assert 0 < outside == pytest.approx(bundle.outside(indirect), rel=1e-5)
    assert received == pytest.approx(indirect.value.sum(), rel=1e-6)
    # Which layer light is accumulated in is drawn: all layers together are the same.
    by_place = [np.asarray(light.toarray()).reshape(light.shape[0], 2, -1).sum(axis=1) for light in (expected, found)]
    near = np.isclose(*by_place, rtol=1e-5, atol=1e-7 * by_place[0].max())
    # Rounding moves what lies on the edge of a cell.
    assert (by_place[0] > 0).sum() > 500 and near.mean() > 0.999
    assert by_place[1].sum() == pytest.approx(by_place[0].sum(), rel=1e-5)


# -------- indirect

N, SEEDS, SIGMAS = 16, 8, 7.0
SPHERE = """<shape type="sphere"><float name="radius" value="1000"/><boolean name="flip_normals" value="true"/>
    {bsdf}</shape>"""
MATT = '<bsdf type="diffuse"><spectrum name="reflectance" value="0.5"/></bsdf>'
# Half of the turns from a lobe of alpha 0.05: both sides find a part of the light.
SHINY = f"""<bsdf type="blendbsdf"><float name="weight" value="0.5"/>{MATT}
    <bsdf type="roughconductor"><string name="material" value="none"/><float name="alpha" value="0.05"/>
        <spectrum name="specular_reflectance" value="0.5"/></bsdf></bsdf>"""
# A mirror wall at x = -40 mm, from 305 to 385 mm, before the sheet at 400 mm.
MIRROR = """<shape type="rectangle"><transform name="to_world"><scale x="40" y="40"/><rotate y="1" angle="90"/>
        <translate x="-40" z="345"/></transform>
        <bsdf type="conductor"><string name="material" value="none"/></bsdf></shape>"""
BEFORE = MIRROR.replace('x="-40"', 'x="-29" y="40"')


def tracer(bench: Bench, mirrors: bool = False, interreflection: bool = True) -> IndirectTracer:
    return IndirectTracer(bench.setup, Paths(mirrors, interreflection))


@pytest.fixture(scope="module")
def hollow(shared_scene: Callable[..., Path], variant: str) -> Bench:
    """Camera and projector inside a diffuse sphere; the sheet is far outside."""
    return open_bench(shared_scene("dome", extra=SPHERE.format(bsdf=MATT), sheet_z=3000), variant)


def test_a_hollow_sphere_is_lit_evenly_by_its_own_light(hollow: Bench) -> None:
    """Indirect light in a diffuse sphere is even: E = Phi rho / (A (1 - rho)), Phi being the projector's flux.

    Phi = pi scale (0.3)^2, the window's area at unit distance; every pixel has its equal part of it.
    """
    flux = np.pi * 111000 * 0.3**2
    radiance = 0.5 / np.pi * flux * 0.5 / (4 * np.pi * 1000**2 * (1 - 0.5))
    expected = radiance * seen(hollow.geometry.tan_half_fov)
    trace = tracer(hollow)
    found = [trace.trace(seed, 0, 2048) for seed in range(SEEDS)]
    assert all((one.kind == INDIRECT).all() for one in found)
    total, error = mean(np.array([one.value.sum() / 2048 for one in found]))
    assert SIGMAS * error < 0.1 * expected
    assert abs(total - expected) < SIGMAS * error
    light = np.mean([np.bincount(one.pixel, one.value, minlength=N * N) for one in found], axis=0).reshape(N, N)
    for part in (light[:8], light[8:], light[:, :8], light[:, 8:]):
        assert part.sum() / 2048 == pytest.approx(expected / 2, rel=0.06)
    # Even over the directions too, whatever pixel the light came from.
    place = np.concatenate([one.row for one in found]), np.concatenate([one.column for one in found])
    assert abs(place[0].mean()) < 0.01 and abs(place[1].mean()) < 0.01
    assert np.abs(1 / found[0].inverse_depth - 1000).max() < 40


CORNER = f"""<shape type="rectangle"><transform name="to_world"><scale x="60" y="60"/><rotate y="1" angle="90"/>
    <translate x="-30" z="360"/></transform>{SHINY.replace("0.05", "0.2")}</shape>"""


@pytest.mark.parametrize("anchors", [1, 3])
def test_a_caustic_is_direct_light_where_the_mirror_throws_it(shared_scene: Callable[..., Path], anchors: int) -> None:
    """A mirror wall x = -40 throws light on the sheet, which seems to come from the projector's image at x = -140.

    Each ray carries pi scale (0.3 / n)^2 to its place on the sheet, wherever that is, and the sheet sends the camera
    0.5 / pi cos^2 / r^2 of it, from wherever on the sensor.
    """
    bench = open_bench(shared_scene("caustic", extra=MIRROR))
    points = SensorPoints(bench.geometry.half_width, anchors)
    found = IndirectTracer(bench.setup, Paths(True, False), points=points).trace(2, 0, 64)
    assert {*found.anchor_row, *found.anchor_column} == set(range(anchors))
    assert found.value.size > 1000 and (found.kind == DIRECT).all()
    places = np.stack([-found.column, -found.row, np.ones(found.value.size)], axis=1) / found.inverse_depth[:, None]
    assert places[:, 2] == pytest.approx(np.full(len(places), 400), rel=1e-5)
    # The way from the image to a lit place goes through the mirror, and through the pixel's part of the image.
    image = np.array([-140.0, 0, 0])
    way = (places - image) / (places[:, :1] - image[0])
    mirror = image + 100 * way
    assert np.abs(mirror[:, 1]).max() < 40.01 and np.abs(mirror[:, 2] - 345).max() < 40.01
    row, column = np.divmod(found.pixel, N)
    slope_x, slope_y = way[:, 0] / way[:, 2], way[:, 1] / way[:, 2]
    assert np.abs(slope_y - (0.15 - (row + 0.5) / N * 0.3)).max() < 0.1501 / N
    assert np.abs(slope_x - (column + 0.5) / N * 0.3).max() < 0.152 / N
    at = np.stack([-points.positions[found.anchor_column], -points.positions[found.anchor_row]], axis=1)
    r2 = np.square(places[:, :2] - at).sum(axis=1) + np.square(places[:, 2])
    expected = np.pi * 111000 * (0.3 / N) ** 2 * 0.5 / np.pi * 400**2 / r2**2
    assert found.value == pytest.approx(expected, rel=1e-4)


# -------- Light followed from the camera
#
# Light followed from the camera: ambient light, against scenes in which it has a closed form.
#
# What it adds to the projector's light is in test_indirect.py and tests/physics/test_mirror.py.
#
# Gates on Monte Carlo means are seven standard errors of eight independent seeds: five sigma of the t distribution.

SKY = '<emitter type="constant"><spectrum name="radiance" value="2"/></emitter>'


@pytest.fixture(scope="module")
def outdoors(shared_scene: Callable[..., Path], variant: str) -> Bench:
    """The sheet, |x|, |y| < 64 mm at 400 mm, under an even sky."""
    return open_bench(shared_scene("outdoors", extra=SKY), variant)


def grid(bench: Bench) -> CellGrid:
    return aligned_grid(*bench.windows, N, 1, bench.geometry.tan_half_fov)


def camera_tracer(bench: Bench, **followed: object) -> FromCameraTracer:
    return FromCameraTracer(bench.setup, grid(bench), Paths(**followed))


def test_light_that_the_projectors_side_finds_is_not_followed(hollow: Bench) -> None:
    """Matt surfaces turn no light sharply: every path ends at the first."""
    assert not camera_tracer(hollow, interreflection=True).trace(0, 0, 2).value.size
    assert not camera_tracer(hollow).trace(0, 0, 2).value.size
