"""Rays of the projector, what counts as a mirror, and beams through glass, blends and other chains."""

import mitsuba as mi
import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.optics.fft_shadow import geometric_samplers
from mitsim.optics.frames import specular_frames
from mitsim.transport.connect import ProjectorOptics, shines_in
from mitsim.transport.specular import SpecularRays, trace_specular_chains
from tests.unit.transport.closed_forms import stock_projector

pytestmark = pytest.mark.usefixtures("variant")
N, SCALE = 8, 111000.0
CONDUCTOR = {"type": "conductor"}


def emitter(n: int = N, to_world: "mi.ScalarAffineTransform4f | None" = None) -> "mi.Emitter":
    canvas = np.zeros((n + 3, 2 * n + 1))
    canvas[1 : 1 + n, 2 : 2 + n] = np.linspace(0.5, 1, n)[:, None]
    place = {} if to_world is None else {"to_world": to_world}
    return stock_projector(n, SCALE, (20, 0, 0), canvas=canvas, fov=30, **place)


def projector(scene: "mi.Scene", n: int = N) -> ProjectorOptics:
    return ProjectorOptics(scene.emitters()[0], n, 1, 2, (n + 3, 2 * n + 1))


def scene_with(**shapes: dict) -> "mi.Scene":
    film = {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    camera = {"type": "mitsim_lensless", "mask": "open", "pixel_pitch": 0.1, "film": film, "fov": 40}
    return mi.load_dict({"type": "scene", "camera": camera, "light": emitter(), **shapes})


def plane(x: float, z: float, bsdf: dict, half: float = 60.0, toward: float = -1.0) -> dict:
    t = mi.ScalarAffineTransform4f()
    to_world = t.look_at(origin=[x, 0, z], target=[x, 0, z + toward], up=[0, 1, 0]) @ t.scale([half, half, 1])
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}


def flux(scene: "mi.Scene", **settings: int) -> float:
    camera = scene.sensors()[0]
    beams = trace_specular_chains(scene, camera, projector(scene), **settings)
    geometry = camera.geometry
    found = specular_frames(beams, geometry, geometric_samplers(geometry), np.zeros(N * N, np.int64))
    return float(found.irradiance.sum() * geometry.pixel_pitch**2)


def test_no_mirror_no_beams_and_a_depth_of_at_least_one(variant: str) -> None:
    scene = scene_with(sheet=plane(0, 400, {"type": "diffuse"}))
    beams = trace_specular_chains(scene, scene.sensors()[0], projector(scene))
    assert len(beams) == 0 and beams.unresolved == 0
    with pytest.raises(MitsimError, match="max_depth of specular chains is 0"):
        trace_specular_chains(scene, scene.sensors()[0], projector(scene), max_depth=0)


def fresnel(cosine: float, eta: float) -> float:
    """Unpolarised reflectance of glass."""
    inside = np.sqrt(1 - (1 - cosine**2) / eta**2)
    s, p = (cosine - eta * inside) / (cosine + eta * inside), (eta * cosine - inside) / (eta * cosine + inside)
    return float((s**2 + p**2) / 2)


COSINE = float(np.cos(np.arctan(10 / 400)))
GLASS = fresnel(COSINE, 1.5)


DIELECTRIC = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
HALF = {"type": "mitsim_mask", "opacity": 0.5, "bsdf": CONDUCTOR}
BLEND = {"type": "mitsim_blendbsdf", "weight": 0.25}
MIRROR = {"type": "twosided", "bsdf": CONDUCTOR}
PARTS = {
    "grey": ({"type": "conductor", "specular_reflectance": {"type": "uniform", "value": 0.3}}, 0.3),
    "front": ({"type": "mitsim_twosided", "front": CONDUCTOR, "back": {"type": "diffuse"}}, 1.0),
    "back": ({"type": "mitsim_twosided", "front": {"type": "diffuse"}, "back": CONDUCTOR}, 0.0),
    "blend": ({**BLEND, "a": {"type": "diffuse"}, "b": CONDUCTOR}, 0.25),
    "two mirrors": (
        {**BLEND, "a": {"type": "twosided", "in": {**CONDUCTOR, "specular_reflectance": 0.4}}, "b": HALF},
        0.75 * 0.4 + 0.25 * 0.5,
    ),
    "mask": ({"type": "mitsim_mask", "opacity": 0.25, "bsdf": MIRROR}, 0.25),
    "whole mask": ({"type": "mitsim_mask", "opacity": 1.0, "bsdf": MIRROR}, 1.0),
    "half glass": ({**HALF, "bsdf": DIELECTRIC}, GLASS / 2),
    "plastic": ({**DIELECTRIC, "type": "plastic"}, GLASS),
    "glass": (DIELECTRIC, GLASS),
    "pane": ({**DIELECTRIC, "type": "thindielectric"}, 2 * GLASS / (1 + GLASS)),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "half glass" else ()) for name in PARTS]
)
def test_each_material_sends_on_its_part(name: str) -> None:
    """Choices between materials are those that :mod:`mitsim.scene.load` puts in place of Mitsuba's."""
    full, (bsdf, part) = flux(scene_with(sheet=plane(0, 400, CONDUCTOR))), PARTS[name]
    assert full > 0
    # The reflectance of glass changes by less than 1e-4 over the window's small part that meets the sensor.
    assert flux(scene_with(sheet=plane(0, 400, bsdf))) == pytest.approx(part * full, rel=1e-3)


def hole(half: float) -> dict:
    """An opacity of 200 x 200 texels with a square hole in the middle, ``half`` its side in texels."""
    opaque = np.ones((200, 200, 1), np.float32)
    opaque[100 - int(half) : 100 + int(half), 100 - int(half) : 100 + int(half)] = 0
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(opaque), "raw": True, "filter_type": "nearest"}
    return {"type": "mask", "opacity": texture, "bsdf": {"type": "diffuse"}}


@pytest.mark.parametrize(
    ("card", "part"),
    [
        ({"type": "mask", "opacity": 0.75, "bsdf": {"type": "diffuse"}}, 0.25),
        (hole, 1.2**2 / 6.4**2),
        ({"type": "diffuse"}, 0.0),
    ],
    ids=["thin", "hole", "closed"],
)
def test_a_projector_in_view_shines_on_the_sensor(variant: str, card: object, part: float) -> None:
    """The irradiance pi scale texture / z^2 at 800 mm of the window's mean pixel row, through a card halfway.

    A hole of 0.6 mm lights 1.2 mm of the sensor's 6.4, and the pinhole lies on the axis. (Planted: rays over no surface
    are dropped, as they were: 0 for all three.)
    """
    toward = mi.ScalarAffineTransform4f().look_at(origin=[0, 0, 800], target=[0, 0, 0], up=[0, 1, 0])
    sheet = plane(0, 400, hole(3) if card is hole else card, 10, 1.0)
    camera = scene_with().sensors()[0]
    scene = mi.load_dict({"type": "scene", "camera": camera, "light": emitter(100, toward), "card": sheet})
    camera, optics = scene.sensors()[0], ProjectorOptics(scene.emitters()[0], 100, 1, 2, (103, 201))
    beams = trace_specular_chains(scene, camera, optics)
    terms = geometric_samplers(camera.geometry)
    found = specular_frames(beams, camera.geometry, terms, np.zeros(100**2, np.int64)).irradiance
    assert found.sum() / 64**2 == pytest.approx(part * np.pi * SCALE * 0.75 / 800**2, rel=0.02)
    assert shines_in(scene, camera, optics.emitter) is (part > 0)


def test_a_slab_of_glass_shifts_the_ray_by_snells_law(variant: str) -> None:
    slab = {
        "type": "cube",
        "to_world": mi.ScalarAffineTransform4f().translate([0, 0, 200]).scale([70, 70, 10]),
        "bsdf": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0},
    }
    scene = scene_with(sheet=plane(0, 400, CONDUCTOR), slab=slab)
    tracer = SpecularRays(scene, scene.sensors()[0], projector(scene), 5)
    point = np.array([[4.5, 7.3]])
    found = tracer.follow(point)
    x, y, z = tracer.rays.directions(point)[0]
    sine = np.hypot(x, y)
    inside = np.tan(np.arcsin(sine / 1.5))
    # Out and back: 2 x 400 mm, of which 2 x 20 mm at the smaller angle.
    reach = (2 * 380 * sine / z + 2 * 20 * inside) / sine
    expected = -(tracer.rays.origin[:2] + reach * np.array([x, y]))[::-1]
    brightest = int(np.argmax(np.where(np.abs(found.sensor - expected).max(axis=1) < 0.5, found.throughput, 0)))
    assert found.sensor[brightest] == pytest.approx(expected, abs=2e-5)


def test_a_rim_is_followed_down_and_points_stand_for_the_rest(variant: str) -> None:
    """Half the sensor sees a mirror's edge, a straight line: a 32nd of a sensor pixel is unsure."""
    whole, half = scene_with(sheet=plane(0, 400, CONDUCTOR)), scene_with(sheet=plane(70, 400, CONDUCTOR, 60))
    beams = trace_specular_chains(half, half.sensors()[0], projector(half))
    assert beams.unresolved == 0 and 0 < beams.error < 1e-3 * flux(whole)
    assert flux(half) == pytest.approx(flux(whole) / 2, rel=1 / 32 / 32)


def test_a_painted_mirror_is_divided_where_its_paint_ends(variant: str) -> None:
    paint = np.where(np.arange(64)[:, None, None] < 32, 0.9, 0.1).astype(np.float32) * np.ones((1, 64, 1), np.float32)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(paint), "raw": True, "filter_type": "nearest"}
    scene = scene_with(sheet=plane(0, 400, {"type": "conductor", "specular_reflectance": bitmap}))
    whole = flux(scene_with(sheet=plane(0, 400, CONDUCTOR)))
    assert flux(scene) == pytest.approx(0.5 * whole, rel=5e-3)
    camera = scene.sensors()[0]
    beams = trace_specular_chains(scene, camera, projector(scene))
    frame = specular_frames(
        beams, camera.geometry, geometric_samplers(camera.geometry), np.zeros(N * N, np.int64)
    ).irradiance
    rows = np.sort(frame[0].mean(axis=1))
    assert rows[30] == pytest.approx(rows[0], rel=1e-2) and rows[33] == pytest.approx(9 * rows[0], rel=1e-2)
