"""The way through flat panes against Snell's law, Fresnel's formulas and a root search in float64, all written anew.

Expected: rays from a point cross planes of glass in a known order; ``scipy`` finds the direction that arrives, and the
solid angle for each area comes from directions a little aside, so nothing is shared but the scene. Tolerances are those
of float32 places (3e-5 mm at 400 mm) unless stated.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.optimize import fsolve

from mitsim.api.bench import Bench, open_bench
from mitsim.core.environment import device_array
from mitsim.core.errors import MitsimError
from mitsim.scene.load import LoadedScene
from mitsim.transport.transmission import Passage, flat_panes, refracted_way
from tests.physics.passages import THIN, plate

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


# -------- Where rays that pass surfaces go on
#
# Where rays that pass surfaces go on.

Scene = Callable[..., LoadedScene]


@pytest.fixture
def loaded(small_scene: Callable[..., Path], variant: str) -> Scene:
    """The small scene's sheet at 400 mm, with more."""
    return lambda extra: open_bench(small_scene(extra=extra, integrator="volpath"), variant).loaded


@pytest.mark.parametrize("gap", [0.0, 1e-3, -1e-3])
@pytest.mark.parametrize("glass", [slab(398, 4), plate(400, THIN, 60), plate(400, '<bsdf type="null"/>', 60)])
def test_contact_is_refused(loaded: Scene, glass: str, gap: float) -> None:
    moved = glass.replace('z="398"', f'z="{398 - gap}"').replace('z="400"', f'z="{400 - gap}"')
    with pytest.raises(
        MitsimError, match=r"small.xml:\d+: shape: got another surface at a distance of .* the factored"
    ):
        loaded(moved)


def test_a_gap_that_mitsuba_skips_is_the_references_refusal(loaded: Scene) -> None:
    for z, refused in ((398 - 0.02, True), (398 - 0.06, False)):
        unfit = loaded(slab(z, 4)).unfit
        assert unfit.factored is None and (unfit.reference is not None) == refused
    assert "the reference needs 0.039 mm between" in str(loaded(slab(398 - 0.02, 4)).unfit.reference)


def test_what_touches_along_a_line_or_in_a_point_is_no_contact(loaded: Scene) -> None:
    ball = '<shape type="sphere"><point name="center" x="3" y="2" z="356"/><float name="radius" value="10"/></shape>'
    crossing = plate(340, THIN, 25, turn=20) + plate(340, "", 25, turn=-10)
    unfit = loaded(slab(368, 4) + ball + crossing).unfit
    assert unfit.factored is None and unfit.reference is None


# -------- passage


def test_a_ray_gets_on_beside_a_long_thin_triangle() -> None:
    """Of triangles of 136 x 0.007 mm, a wire's, Mitsuba has points behind the ray's start; a ray that went on from
    there would meet them for ever. (Planted: the surface's point as Mitsuba has it.)"""
    wire = mi.Mesh("wire", vertex_count=3, face_count=1)
    parameters = mi.traverse(wire)
    corners = np.array([[94.29, -22.52, 369.56], [-37.09, 14.19, 353.72], [-37.09, 14.197, 353.72]])
    parameters["vertex_positions"] = device_array(mi.Float, corners)
    parameters["faces"] = mi.UInt32([0, 1, 2])
    parameters.update()
    passage = Passage(mi.load_dict({"type": "scene", "wire": wire}))
    # Rays from 0.76 um before points of the triangle, along directions that go down the wire as well.
    rng = np.random.default_rng(0)
    weights = rng.dirichlet(np.ones(3), 20000)
    down = corners[1] - corners[0]
    direction = down / np.linalg.norm(down) + 0.3 * rng.normal(size=(20000, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, np.newaxis]
    ray = mi.Ray3f(mi.Point3f((weights @ corners - 7.6e-4 * direction).T), mi.Vector3f(direction.T))
    met = passage.next_surface(ray, mi.Bool(True))
    plain = passage.scene.ray_intersect(ray)
    found = np.array(met.is_valid()) & (np.array(met.t) < 1)
    behind = np.array(dr.dot(plain.p - ray.o, ray.d)) <= 0
    assert (behind & found).sum() > 20
    assert (np.array(dr.dot(met.p - ray.o, ray.d))[found] >= 0).all()
    assert np.array_equal(np.array(met.p)[:, ~behind], np.array(plain.p)[:, ~behind])


def test_light_inside_a_thin_rod_does_not_come_out_of_its_side() -> None:
    """A rod of radius 2 at 380 mm: nothing behind it is seen from its points, and rays into it meet it again.

    20000 points of one seed. (Planted: rays that start as far along their direction; 6 % of both.)
    """
    rod = {"type": "cylinder", "p0": [-3, -60, 378], "p1": [3, 60, 381], "radius": 2.0, "bsdf": {"type": "dielectric"}}
    passage, rng = Passage(mi.load_dict({"type": "scene", "rod": rod})), np.random.default_rng(0)
    aims = np.stack([rng.uniform(-1.8, 1.8, 20000), rng.uniform(-30, 30, 20000), np.full(20000, 379.5)])
    si = passage.scene.ray_intersect(mi.Ray3f(mi.Point3f(0), dr.normalize(mi.Vector3f(aims))))
    onward = rng.normal(size=(3, 20000))
    direction = dr.normalize(mi.Vector3f(onward))
    inward = np.array(si.is_valid() & (dr.dot(si.n, direction) < 0) & (dr.abs(direction.y) < 0.9))
    seen, _ = passage.between(si, si.p + 100 * direction, mi.Bool(True))
    met = passage.scene.ray_intersect(passage.onward(si, direction))
    assert inward.sum() > 5000
    assert np.array(seen)[inward].mean() < 1e-3
    assert (~np.array(met.is_valid()))[inward].mean() < 1e-3
