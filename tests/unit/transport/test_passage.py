"""Where rays that pass surfaces go on."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsim.transport.transmission import Passage

pytestmark = pytest.mark.usefixtures("variant")


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
