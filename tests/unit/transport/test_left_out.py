"""Light that no tracer finds is measured: by a plane mirror that light meets twice, in closed form; not by windows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.devices.patterns import Lighting
from mitsim.planner.planner import make_plan
from mitsim.transport.connect import OpticalSetup, ProjectorOptics
from mitsim.transport.from_camera import FromCameraTracer
from mitsim.transport.integrator import IndirectTracer, Paths
from mitsim.transport.missed import Highlights, LeftOut, highlights, left_out_light
from mitsim.transport.records import CellGrid, aligned_grid
from tests.physics.hidden_light import SCENES
from tests.physics.test_mirror import SCALE, MirrorBench, N
from tests.unit.transport.test_panes import BALL, WALL, slab

PLACES = np.array([[12.3, 5.1, 371.0], [-31.7, 20.9, 388.3], [2.6, -33.2, 362.9]])


def found(alpha: float, radius: float, **more: dict) -> Highlights:
    gloss = {"type": "roughconductor", "distribution": "ggx", "alpha": alpha, "material": "none"}
    balls = {
        f"ball{i}": {"type": "sphere", "center": place.tolist(), "radius": radius, "bsdf": gloss}
        for i, place in enumerate(PLACES)
    }
    scene = MirrorBench((60, 0, 0)).scene("open", 64, **balls, **more)
    projector = ProjectorOptics(scene.emitters()[0], N, 0, N, (N, 2 * N))
    camera = scene.sensors()[0]
    return highlights(OpticalSetup(scene, camera, projector, camera.geometry))


@pytest.mark.parametrize(("alpha", "radius"), [(0.003, 0.4), (0.003, 5.0), (0.01, 0.02)])
def test_light_is_that_of_mirror_balls(variant: str, alpha: float, radius: float) -> None:
    """A ball spreads E pi r^2 evenly over all directions, whatever its narrow lobe: E r^2 / 4 d^2 on the sensor.

    GGX lobes have alpha^2 / (t^2 + alpha^2) of their light beyond an angle t, and there a density of alpha^2 / (4 pi
    (t^2 + alpha^2)^2): below 10, which is left to connections, sqrt(40 pi) alpha of it. (Planted: points
    stand for a tenth more of the ball.)
    """
    to = PLACES - [60, 0, 0]
    cosine, far = to[:, 2] / np.linalg.norm(to, axis=1), np.linalg.norm(PLACES, axis=1)
    expected = np.pi * SCALE / to[:, 2] ** 2 / cosine * radius**2 / 4 * PLACES[:, 2] / far**3
    expected *= 1 - np.sqrt(40 * np.pi) * alpha
    light = found(alpha, radius)
    assert light.irradiance == pytest.approx(expected, rel=0.03)
    # A spot of some alpha r is met in proportion.
    hits = np.square(light.irradiance) / light.moments
    pixel = (2 * 0.15 / N * to[:, 2]) ** 2
    assert (hits < 4 * np.pi * (alpha * radius) ** 2 / pixel).all() and (
        hits > 0.1 * (alpha * radius) ** 2 / pixel
    ).all()


def test_what_is_hidden_counts_for_nothing(variant: str) -> None:
    """By a card before the sensor's view of the first ball; none are glossy enough at a roughness of 0.3."""
    card = {"type": "sphere", "center": (PLACES[0] / 2).tolist(), "radius": 3.0}
    hidden, open_ = found(0.01, 0.4, card=card).irradiance, found(0.01, 0.4).irradiance
    assert hidden[0] == 0 and hidden[1:] == pytest.approx(open_[1:])
    assert not found(0.3, 0.4).irradiance.any()


# -------- left out

pytestmark = pytest.mark.usefixtures("variant")
SEEDS, NONE = 4, 1e-9
PILOTS = 30 / 64
"""Hits that a sample must make: 30 in the 64 of the pilot's shortest look at 16 x 16 projector pixels."""
MIRROR = """<shape type="rectangle"><transform name="to_world"><scale x="115" y="115"/><rotate y="1" angle="90"/>
    <translate x="-40" z="315"/></transform>
    <bsdf type="conductor"><string name="material" value="none"/></bsdf></shape>"""


def left_out_of(bench: Bench, seed: int, paths: int = 2**21) -> LeftOut:
    grid = cells(bench)
    return left_out_light(bench.setup, grid, seed, paths // (grid.shape[0] * grid.shape[1]))


def cells(bench: Bench) -> CellGrid:
    return aligned_grid(*bench.windows, 64, 1, bench.geometry.tan_half_fov + 0.01)


def left_out(bench: Bench, fewest: float = np.inf, paths: int = 2**21) -> tuple[float, float]:
    """Mean over seeds, and its standard error; ``fewest`` hits of a sample tell of a lobe."""
    light = [left_out_of(bench, seed, paths).unseen(fewest, NONE)[0] for seed in range(SEEDS)]
    return float(np.mean(light)), float(np.std(light, ddof=1) / np.sqrt(SEEDS))


@pytest.mark.parametrize("name", ["own mirror", pytest.param("another mirror", marks=pytest.mark.slow)])
def test_light_that_no_tracer_finds_is_known_at_every_seed(tmp_path: Path, name: str) -> None:
    """By a judge of its own in float64; a wall turned by 30 degrees fills its cubes to 0.94.

    Paths into a lens in the pinhole's place met the first one once or twice in 2^20, or never. (Planted: half the rays
    of each cube are not counted; what landed is not divided by the rays' cosine.)
    """
    scene = SCENES[name]
    bench, expected = open_bench(scene.write(tmp_path, "hidden"), for_render=True), scene.light()
    found = [left_out_of(bench, seed, 2**18).unseen(np.inf, NONE)[0] for seed in range(3)]
    assert found == pytest.approx([expected] * 3, rel=0.12)


def gloss(place: str, alpha: float) -> str:
    rough = f'<string name="distribution" value="ggx"/><float name="alpha" value="{alpha}"/>'
    metal = f'<bsdf type="roughconductor"><string name="material" value="none"/>{rough}</bsdf>'
    return f'<shape type="rectangle"><transform name="to_world">{place}</transform>{metal}</shape>'


SEEN = '<scale x="20" y="60"/><rotate y="1" angle="180"/><translate x="-10" z="400"/>'
LIT = '<scale x="8" y="30"/><rotate y="1" angle="186.23"/><translate x="-25" z="400"/>'


@pytest.mark.parametrize(
    ("place", "cosine", "way"), [(SEEN, 1.0, 800.0), pytest.param(LIT, 0.961, 817.0, marks=pytest.mark.slow)]
)
def test_a_sharp_lobe_over_a_mirror_is_left_out(
    shared_scene: Callable[..., Path], place: str, cosine: float, way: float
) -> None:
    """Seen in the mirror x = -40, and lit over it: nearly mirrors, so E = pi scale / cos^3 / way^2 of the unfolded way.

    The lens blurs the window's edge, and the camera's obliquity is 1: to a fifth. Of a broad lobe, which the pilot's
    64 samples meet, only what is lit and seen in the mirror is left out, a few percent.
    """
    path = shared_scene(f"lobe{way}", extra=MIRROR + gloss(place, 1e-3), sheet_z=-500, fov=30)
    bench, expected = open_bench(path, for_render=True), np.pi * 111000 / cosine**3 / way**2
    found, error = left_out(bench, PILOTS, 2**19)
    assert error < 0.05 * expected and found == pytest.approx(expected, rel=0.2)
    broad = shared_scene(f"broad{way}", extra=MIRROR + gloss(place, 0.1), sheet_z=-500, fov=30)
    assert left_out(open_bench(broad, for_render=True), PILOTS, 2**19)[0] < 0.06 * expected
    if place == LIT:
        plan = make_plan(bench, Lighting.uniform(16), 1e-1, 1, {"interreflection": False, "diffraction": False})
        assert plan.warnings and plan.systematic_error > 0.1, plan.warnings


@pytest.mark.parametrize("alpha", [1e-2, 1e-1])
@pytest.mark.parametrize("place", [SEEN, LIT], ids=["seen", "lit"])
def test_hits_are_those_of_the_tracer_that_would_find_the_light(
    shared_scene: Callable[..., Path], place: str, alpha: float
) -> None:
    """L^2 over the second moment of its connections, which it hands out; both to a few percent, and the lens' blur.

    (Planted: pi too much in either side's connection.)
    """
    name = f"hits{place == SEEN}{alpha}"
    bench = open_bench(shared_scene(name, extra=MIRROR + gloss(place, alpha), sheet_z=-500, fov=30), for_render=True)
    if place == LIT:
        tracer = IndirectTracer(bench.setup, Paths(True, False))
    else:
        tracer = FromCameraTracer(bench.setup, cells(bench), Paths(mirrors=True))
    samples = 2**21 // tracer.paths_per_sample
    connected = tracer.trace(0, 0, samples).value
    light, moment = connected.sum() / samples, np.square(connected).sum() / samples
    reported = left_out_of(bench, 0)
    plate = int(np.argmax(reported.lobes))
    assert reported.lobes[plate] == pytest.approx(light, rel=0.1)
    assert reported.hits[plate] == pytest.approx(light**2 / moment, rel=0.3)


def test_windows_leave_nothing_out(shared_scene: Callable[..., Path]) -> None:
    """But what is reflected inside of them on both ways, R^2 = 1.6e-3 each."""
    bench = open_bench(shared_scene("window", extra=slab(220, 6, 20), sheet_z=WALL))
    assert left_out_of(bench, 0).unseen(np.inf, NONE)[0] < 1e-5 * 0.02


@pytest.mark.slow
def test_it_is_told_over_which_mirror(shared_scene: Callable[..., Path]) -> None:
    """A ball of glass, not a mirror out of the way before it, nor the pane behind it that all light passes; 2^18 paths,
    seed 0."""
    ball = BALL.replace('value="5"', 'value="60"')
    shapes = MIRROR.replace('x="-40" z="315"', 'x="-300" z="315"'), ball, slab(200, 4)
    path = shared_scene("named", extra="\n".join(shapes), sheet_z=WALL)
    bench = open_bench(path)
    _, place = left_out_of(bench, 0, 2**18).unseen(NONE, NONE)
    assert place is not None
    tag = bench.loaded.shapes[place]
    assert tag.attributes["type"] == "sphere" == bench.loaded.scene.shapes()[place].class_name().lower()
    assert tag.line == 1 + path.read_text(encoding="utf-8").split('<shape type="sphere"')[0].count("\n")
