"""The way through flat panes against Snell's law, Fresnel's formulas and a root search in float64, all written anew.

Expected: rays from a point cross planes of glass in a known order; ``scipy`` finds the direction that arrives, and the
solid angle for each area comes from directions a little aside, so nothing is shared but the scene. Tolerances are those
of float32 places (3e-5 mm at 400 mm) unless stated.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from scipy.optimize import fsolve

from mitsim.api.bench import Bench, open_bench
from mitsim.transport.transmission import Passage, flat_panes, refracted_way

pytestmark = pytest.mark.usefixtures("variant")
WALL = 440.0
GLASS = '<bsdf type="dielectric"><float name="int_ior" value="1.5"/><float name="ext_ior" value="1"/></bsdf>'
Plane = tuple[np.ndarray, np.ndarray, float]


def slab(z: float, thickness: float, turn: float = 0.0, x: float = 0.0, half: float = 90.0) -> str:
    return f"""<shape type="cube"><transform name="to_world"><scale x="{half}" y="{half}" z="{thickness / 2}"/>
        <rotate y="1" angle="{turn}"/><translate x="{x}" z="{z}"/></transform>{GLASS}</shape>"""


def face(z: float, turn: float, inward: bool, half: float = 90.0) -> str:
    """A rectangle whose normal looks out of the glass, which lies at larger z where ``inward``."""
    return f"""<shape type="rectangle"><transform name="to_world"><scale x="{half}" y="{half}"/>
        <rotate y="1" angle="{turn + 180 * inward}"/><translate z="{z}"/></transform>{GLASS}</shape>"""


def normal(turn: float) -> np.ndarray:
    return np.array([np.sin(np.radians(turn)), 0, np.cos(np.radians(turn))])


def planes_of_slab(z: float, thickness: float, turn: float, x: float = 0.0) -> list[Plane]:
    """Met from larger z: into the glass, and out of it."""
    n, middle = normal(turn), np.array([x, 0, z])
    return [(middle + n * thickness / 2, n, 1.5), (middle - n * thickness / 2, n, 1 / 1.5)]


SCENES: dict[str, tuple[str, list[Plane]]] = {
    "one pane": (slab(220, 6), planes_of_slab(220, 6, 0)),
    "two panes, both slanted": (
        slab(220, 6, 12) + slab(300, 10, -25),
        planes_of_slab(300, 10, -25) + planes_of_slab(220, 6, 12),
    ),
    "a wedge of two faces": (
        face(230, 3, True) + face(250, -6, False),
        [(np.array([0, 0, 250.0]), normal(-6), 1.5), (np.array([0, 0, 230.0]), normal(3), 1 / 1.5)],
    ),
}


def follow(start: np.ndarray, direction: np.ndarray, planes: Sequence[Plane]) -> tuple[np.ndarray, np.ndarray, float]:
    """Place and direction behind the last plane, and the transmittance of unpolarised light."""
    place, d, part = start, direction / np.linalg.norm(direction), 1.0
    for point, n, eta in planes:
        place = place + d * ((point - place) @ n) / (d @ n)
        n = -n * np.sign(d @ n)
        c = -d @ n
        inside = np.sqrt(1 - (1 - c**2) / eta**2)
        s, p = (c - eta * inside) / (c + eta * inside), (eta * c - inside) / (eta * c + inside)
        part *= 1 - (s**2 + p**2) / 2
        d = d / eta + (c / eta - inside) * n
    return place, d, part


def expected(start: np.ndarray, target: np.ndarray, planes: Sequence[Plane]) -> tuple[np.ndarray, np.ndarray, float]:
    """Direction, apparent point and transmittance."""
    facing = (target - start) / np.linalg.norm(target - start)
    u = np.cross(facing, [0.0, 1.0, 0.0])
    u /= np.linalg.norm(u)
    v = np.cross(facing, u)

    def miss(turn: np.ndarray, plane: np.ndarray) -> np.ndarray:
        place, d, _ = follow(start, facing + turn[0] * u + turn[1] * v, planes)
        return place + d * ((target - place) @ plane) / (d @ plane) - target

    turn = fsolve(lambda turn: [miss(turn, facing) @ u, miss(turn, facing) @ v], [0.0, 0.0], xtol=1e-13)
    direction = facing + turn[0] * u + turn[1] * v
    direction /= np.linalg.norm(direction)
    _, arriving, part = follow(start, direction, planes)
    a = np.cross(direction, [0.0, 1.0, 0.0])
    a /= np.linalg.norm(a)
    b, step = np.cross(direction, a), 1e-5

    def hit(turned: np.ndarray) -> np.ndarray:
        place, d, _ = follow(start, turned, planes)
        return place + d * ((target - place) @ arriving) / (d @ arriving)

    moved = [(hit(direction + step * w) - hit(direction - step * w)) / (2 * step) for w in (a, b)]
    area = np.linalg.norm(np.cross(*moved))
    assert np.linalg.norm(hit(direction) - target) < 1e-8
    return direction, target - arriving * np.sqrt(area), part


@pytest.fixture(scope="module")
def scene(shared_scene: Callable[..., Path], variant: str) -> Callable[..., Bench]:
    count = iter(range(100))
    return lambda extra: open_bench(shared_scene(f"pane{next(count)}", extra=extra, sheet_z=WALL))


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "one pane" else ()) for name in SCENES]
)
def test_the_way_is_snells(scene: Callable[..., Bench], name: str) -> None:
    """To a sensor's corner and to a projector 60 mm aside, from nine places of the wall."""
    extra, planes = SCENES[name]
    loaded = scene(extra).loaded
    x, y = (axis.ravel() for axis in np.meshgrid([-40.0, 3.0, 50.0], [-35.0, 2.0, 40.0]))
    ray = mi.Ray3f(mi.Point3f(x, y, WALL - 5), mi.Vector3f(0, 0, 1))
    passage, si = Passage(loaded.scene), loaded.scene.ray_intersect(ray)
    for target in (np.array([3.0, -3.0, 0.0]), np.array([60.0, 0.0, 0.0])):
        way = refracted_way(passage, si, mi.Point3f(target), mi.Bool(True))
        found = [np.array(part, dtype=np.float64) for part in (way.direction, way.apparent, way.part, way.open)]
        assert found[3].all()
        for i, start in enumerate(np.stack([x, y, np.full(9, WALL)], axis=1)):
            direction, apparent, part = expected(start, target, planes)
            assert found[0][:, i] == pytest.approx(direction, abs=3e-6)
            # The area is a product of differentials: 1e-6 of 400 mm; along the line of sight it is looser.
            assert found[1][:, i] == pytest.approx(apparent, abs=2e-3)
            assert found[2].ravel()[i] == pytest.approx(part, rel=1e-5)
        assert np.array(way.eta) == pytest.approx(np.ones(9), rel=1e-6)


def test_without_glass_the_way_is_straight(scene: Callable[..., Bench]) -> None:
    """And an opaque card closes it; so it does behind a pane."""
    black = """<shape type="rectangle"><transform name="to_world"><scale x="10" y="10"/><translate x="20" z="{z}"/>
        </transform><bsdf type="diffuse"/></shape>"""
    for extra, glass in ((black.format(z=300), False), (black.format(z=300) + slab(220, 6), True)):
        loaded = scene(extra).loaded
        ray = mi.Ray3f(mi.Point3f([0.0, 30.0], [0.0, 0.0], WALL - 5), mi.Vector3f(0, 0, 1))
        passage, si = Passage(loaded.scene), loaded.scene.ray_intersect(ray)
        way = refracted_way(passage, si, mi.Point3f(0, 0, 0), mi.Bool(True))
        assert np.array(way.open).tolist() == [True, False]
        if not glass:
            assert np.array(way.apparent)[:, 0] == pytest.approx([0, 0, WALL], abs=1e-3)
            assert np.array(way.part).ravel()[0] == 1


BALL = f'<shape type="sphere"><float name="radius" value="5"/><point name="center" x="0" y="0" z="300"/>{GLASS}</shape>'


@pytest.mark.parametrize(
    ("extra", "panes"),
    [
        (slab(220, 6), 1),
        (face(230, 3, True) + face(250, -6, False), 2),
        (BALL, 0),
        (slab(220, 6).replace("dielectric", "roughdielectric"), 0),
        (slab(220, 6).replace("cube", "cylinder"), 0),
        ('<shape type="disk"><transform name="to_world"><translate z="250"/></transform>' + GLASS + "</shape>", 1),
    ],
)
def test_what_counts_as_a_pane(scene: Callable[..., Bench], extra: str, panes: int) -> None:
    loaded = scene(extra).loaded
    assert len(flat_panes(loaded.scene)) == panes
    assert Passage(loaded.scene).open == bool(panes)


@pytest.mark.parametrize(("depth", "panes"), [(0.0, 1), (5.0, 0)])
def test_meshes_that_are_flat(variant: str, depth: float, panes: int) -> None:
    """A sheet of two triangles is a pane; folded along its diagonal it is none."""
    mesh = mi.Mesh("sheet", 4, 2)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float([0, 0, 0, 1, 0, 0, 1, 1, depth, 0, 1, 0])
    parameters["faces"] = mi.UInt32([0, 1, 2, 0, 2, 3])
    parameters.update()
    mesh.set_bsdf(mi.load_dict({"type": "dielectric"}))
    assert len(flat_panes(mi.load_dict({"type": "scene", "sheet": mesh}))) == panes
