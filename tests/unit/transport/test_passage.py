"""Where rays that pass surfaces go on."""

from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsim.api.bench import open_bench
from mitsim.core.errors import MitsimError
from mitsim.scene.load import LoadedScene
from mitsim.transport.transmission import Passage
from tests.physics.passages import THIN, plate
from tests.unit.transport.test_panes import slab

pytestmark = pytest.mark.usefixtures("variant")
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
    assert "the reference sees what stands at least 0.039 mm" in str(loaded(slab(398 - 0.02, 4)).unfit.reference)


def test_a_foil_of_glass_is_too_thin_for_the_reference(loaded: Scene) -> None:
    unfit = loaded(slab(350, 0.02)).unfit
    assert unfit.factored is None and unfit.reference is not None


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
    parameters["vertex_positions"] = mi.Float(corners.ravel().astype(np.float32))
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
