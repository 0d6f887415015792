"""Projector pixels that are hidden from part of the sensor: which they are, by geometry, and their anchors' worth.

A card stands 60 mm before the sheet. A point of the sheet is hidden from the points of the sensor that see the card in
front of it, so the pixels at the card's penumbra, seen from the sensor, are seen by part of it only.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.core.seeds import integer
from mitsim.devices.patterns import Lighting, parse_patterns
from mitsim.light.passes import Simulation, expected_of
from mitsim.light.settings import Settings
from mitsim.planner.pilot import occluded_pixels
from mitsim.planner.planner import make_plan

pytestmark = pytest.mark.usefixtures("variant")
N, Z, NEAR, HALF = 48, 400.0, 340.0, 4.8
"""Projector pixels of 2.5 mm on the sheet; the card's penumbra is 1.7 mm wide."""
LEFT, RIGHT, LOW, HIGH = -21.0, 16.0, -13.0, 28.0
CARD = f"""<shape type="rectangle"><transform name="to_world"><rotate y="1" angle="180"/>
    <scale x="{(RIGHT - LEFT) / 2}" y="{(HIGH - LOW) / 2}"/>
    <translate x="{(LEFT + RIGHT) / 2}" y="{(LOW + HIGH) / 2}" z="{NEAR}"/></transform>
    <bsdf type="diffuse"><spectrum name="reflectance" value="0.3"/></bsdf></shape>"""
NUMBERS = {"n": N, "pitch": 2 * HALF / 64}


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path], variant: str) -> Bench:
    return open_bench(shared_scene("occluded", extra=CARD, **NUMBERS), variant, for_render=True)


def hidden(points: int = 9, places: int = 15) -> tuple[np.ndarray, np.ndarray]:
    """(n, n) whether any point of a pixel is seen by part of the sensor only, and range of its light over the sensor.

    From geometry alone: pixels of 2.5 mm on the sheet, rays of a pinhole at x = 60 mm, straight lines to the sensor;
    rows and columns of pixels run against y and x.
    """
    grid = (np.arange(points) + 0.5) / points
    across = 0.15 * Z * (2 * (np.arange(N)[:, None] + grid).ravel() / N - 1)
    y, x = -across[:, None], -across[None, :]
    near = NEAR / Z

    def covered(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return (x > LEFT) & (x < RIGHT) & (y > LOW) & (y < HIGH)

    on_sheet = ~covered(60 + (x - 60) * near, y * near)
    seen = np.zeros((places, places, N * points, N * points), dtype=bool)
    for a, b in np.ndindex(places, places):
        v, u = (HALF * (2 * place / (places - 1) - 1) for place in (a, b))
        seen[a, b] = ~covered(u + (x - u) * near, v + (y - v) * near) & on_sheet
    partly = seen.any(axis=(0, 1)) & on_sheet & ~seen.all(axis=(0, 1))
    light = seen.reshape(places, places, N, points, N, points).mean(axis=(3, 5))
    return partly.reshape(N, points, N, points).any(axis=(1, 3)), np.ptp(light, axis=(0, 1))


@pytest.mark.parametrize("seed", [0, 1])
def test_pixels_are_found_where_geometry_hides_them_in_part(bench: Bench, seed: int) -> None:
    """At 1e-3, of all that are hidden in part those that matter, and no other. (Planted: one look, without neighbours;
    the rest of the pixels told as found.)"""
    partly, by = hidden()
    found = np.zeros((N, N), dtype=bool)
    found.flat[list(occluded_pixels(Simulation(bench, Settings(depth=Z)), 1e-3, seed))] = True
    assert 60 < partly.sum() < N**2 / 8
    assert not (found & ~partly).any()
    assert found[by > 0.2].all() and (by > 0.2).sum() > 25


def test_a_sheet_alone_hides_nothing(small_scene: Callable[..., Path]) -> None:
    assert occluded_pixels(Simulation(open_bench(small_scene(n=16)), Settings(depth=Z)), 1e-3, 0) == ()


def frames(bench: Bench, settings: Settings, samples: int = 32) -> np.ndarray:
    """(shots, pixels, pixels) of four shots, from the same points whatever the anchors."""
    lighting = parse_patterns("dots:3", N).lighting.shots([0, 4])
    made, light = Simulation(bench, settings), None
    for name, each in made.passes.items():
        count = samples if name == "direct" else samples // 8
        seen = each.tracer.trace(integer(5, each.row.stream == "direct"), 0, count)
        filed = made.accumulate(name, seen, lighting.labels, count)
        light = filed if light is None else light + filed
    return np.stack([frame.irradiance for frame in expected_of([(made, [light])], np.arange(9), lighting, 0)])


def test_anchors_of_their_own_do_what_as_many_do_for_all(bench: Bench) -> None:
    """Three anchors for all pixels leave much that 12 for all show; with 12 for these pixels alone, next to nothing.

    The points on the surfaces are the same. (Planted: what they see accumulated with its mean; no samples of theirs.)
    """
    few = Settings(depth=Z, anchors=3, layers=(Z, NEAR), coarse_layers=True)
    pixels = occluded_pixels(Simulation(bench, few), 1e-4, 3)
    judge = frames(bench, replace(few, anchors=12))
    light = np.linalg.norm(judge)
    without = np.linalg.norm(frames(bench, few) - judge) / light
    own = np.linalg.norm(frames(bench, replace(few, occluded=pixels, occluded_anchors=12)) - judge) / light
    assert without > 3e-4, "the scene has to call for it"
    assert own < without / 100


def test_the_plan_gives_them_anchors_and_the_others_few(bench: Bench) -> None:
    family = parse_patterns("dots:3", N)
    plan = make_plan(bench, family.lighting, 1e-3, 0)
    settings = plan.settings
    assert settings.occluded and settings.occluded_anchors >= 3 and 2 <= settings.anchors <= 3
    assert not plan.warnings
    row = plan.row("occluded-anchors")
    assert row.state == "approximate" and row.reason.startswith(f"{len(settings.occluded)} projector pixels are hidden")
    loose = make_plan(bench, Lighting.uniform(N), 0.1, 0)
    assert loose.row("occluded-anchors").state == "off" and loose.settings.with_own_anchors == ()
