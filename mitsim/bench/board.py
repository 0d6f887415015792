"""Surfaces that are put before a bench: the white board of a calibration, and pictures on its prints."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.bench.apparatus import Opened, check_depth
from mitsim.core.arrays import FloatArray
from mitsim.core.environment import keep_scenes
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.devices.session import BoardShape
from mitsim.scene.check import Unfit
from mitsim.transport.connect import PinholeRays
from mitsim.transport.plugins.base import host_values, turn_and_origin

if TYPE_CHECKING:
    from mitsim.bench.apparatus import Apparatus

_BEYOND = 1.1
"""Half side of a board without a stated size, relative to what the sensor's edge sees."""
_GRAZING = 0.05
"""Least cosine by which a board without a stated size recedes from a ray."""
CELLS = 64
"""Facets per side of a bowed board, within 1/4096 of the bow of the paraboloid."""
_INSIDE = 1e-3
"""Distance in projector pixels from a pixel's corners to the rays that are tried."""


def before_board(
    bench: Opened, reflectance: float, shape: BoardShape | None = None, depth: float | None = None
) -> Opened:
    """Return the devices of a bench before a diffuse board; see :meth:`mitsim.api.bench.Bench.with_board`."""
    if not 0 <= reflectance <= 1:
        raise ArgumentError("reflectance", f"{reflectance:g}: give a number from 0 to 1")
    where, shape = bench.geometry.scene_distance if depth is None else check_depth(depth), shape or BoardShape()
    geometry, loaded = bench.geometry, bench.loaded
    half = _BEYOND * (geometry.tan_half_fov * where + geometry.half_width)
    steep = math.hypot(*(math.tan(math.radians(tilt)) for tilt in (shape.tilt_row_deg, shape.tilt_column_deg)))
    if shape.size_mm is not None:
        half = shape.size_mm / 2
    elif steep:  # along the slope a ray of tan-angle u meets the board at u z / (cos - u sin) from its middle
        angle, corner = math.atan(steep), math.sqrt(2) * half / where
        half = half * math.sqrt(2) / max(math.cos(angle) - corner * math.sin(angle), _GRAZING)
    bsdf = {"type": "diffuse", "reflectance": {"type": "uniform", "value": reflectance}}
    turned, camera = np.eye(4), np.eye(4)
    turned[:3, :3] = turn_of(shape)
    camera[:3, :3], camera[:3, 3] = camera_place(bench)
    middle = mi.ScalarAffineTransform4f().translate([0, 0, where])
    place = middle @ mi.ScalarAffineTransform4f(turned.tolist())
    world = mi.ScalarAffineTransform4f(camera.tolist())
    to_world = world @ place.rotate([0, 1, 0], 180).scale([half, half, 1])
    board: Any = {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}
    if shape.bow_mm:
        board = _bowed_mesh(shape, half, np.array((world @ place).matrix, dtype=np.float64), bsdf)
    scene = mi.load_dict({"type": "scene", "camera": loaded.camera, "projector": loaded.projector, "board": board})
    bare = replace(loaded, scene=scene, lamps=(), small_lamps=(), mirrors=False, glossy=False, in_view=False)
    alone = replace(bare, unfit=Unfit(), shapes=(), coloured=(), parting=())
    stated = {"reflectance": reflectance, "depth_mm": where, **shape.model_dump()}
    return replace(bench, loaded=alone, board=stated)


def turn_of(shape: BoardShape) -> FloatArray:
    """Return the (3, 3) rotation of a board of that ``shape`` in the camera's frame.

    It is the smallest rotation with the board's slopes, so that no axis comes first: its plane is z = tan(tilt_row)
    s_row + tan(tilt_column) s_column, with s_row = -y and s_column = -x.
    """
    slope = np.array([-math.tan(math.radians(tilt)) for tilt in (shape.tilt_column_deg, shape.tilt_row_deg)])
    steep = float(np.linalg.norm(slope))
    if steep == 0:
        return np.eye(3)
    angle = math.atan(steep)
    uphill = slope / steep
    # Rodrigues' formula about the level line: points uphill of the middle move away along z.
    axis = np.array([uphill[1], -uphill[0], 0.0])
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross)


def bowed_surface(shape: BoardShape, half: float) -> tuple[FloatArray, FloatArray]:
    """Return points and normals (CELLS + 1, CELLS + 1, 3) of a bowed board: z = bow (x^2 + y^2) / half^2.

    They are in the board's own frame, with the camera's side towards -z; ``half`` is half of its side [mm].
    """
    line = np.linspace(-half, half, CELLS + 1)
    x, y = np.meshgrid(line, line)
    part = shape.bow_mm / half**2
    normals = np.stack([2 * part * x, 2 * part * y, -np.ones_like(x)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.stack([x, y, part * (x**2 + y**2)], axis=-1), normals


@keep_scenes()
def missed_pixels(bench: Apparatus) -> int:
    """Return the projector pixels that do not light a whole piece of the board as the camera sees it."""
    n = bench.n
    rays, eye = PinholeRays(bench.projector_optics, [None]), camera_place(bench)[1]
    row, column = np.divmod(np.arange(n * n), n)
    missed = np.zeros(n * n, dtype=bool)
    for down, right in itertools.product((_INSIDE, 1 - _INSIDE), repeat=2):
        directions = rays.directions(np.stack([row + down, column + right], axis=1))
        ray = mi.Ray3f(mi.Point3f(rays.origin.tolist()), mi.Vector3f(directions.T.astype(np.float32)))
        met = bench.loaded.scene.ray_intersect(ray)
        facing = (dr.dot(met.n, -ray.d) > 0) & (dr.dot(met.n, mi.Point3f(eye.tolist()) - met.p) > 0)
        missed |= ~host_values(met.is_valid() & facing, n * n)
    return int(np.count_nonzero(missed))


def camera_place(bench: Apparatus) -> tuple[FloatArray, FloatArray]:
    """Return the (3, 3) rotation and (3,) position [mm] of the camera in the world."""
    return turn_and_origin(bench.loaded.camera.world_transform())


def _bowed_mesh(shape: BoardShape, half: float, place: FloatArray, bsdf: dict[str, Any]) -> mi.Mesh:
    points, normals = bowed_surface(shape, half)
    side = CELLS + 1
    corner = (np.arange(CELLS)[:, None] * side + np.arange(CELLS)).reshape(-1, 1)
    # Both triangles of a facet turn their front to -z, where the camera is.
    faces = np.concatenate([corner + [0, side, 1], corner + [1, side, side + 1]])
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh("board", side * side, len(faces), has_vertex_normals=True, props=properties)
    arrays = mi.traverse(mesh)
    arrays["vertex_positions"] = (points.reshape(-1, 3) @ place[:3, :3].T + place[:3, 3]).ravel()
    arrays["vertex_normals"] = (normals.reshape(-1, 3) @ place[:3, :3].T).ravel()
    arrays["faces"] = faces.ravel()
    arrays.update()
    return mesh


# -------- Pictures on prints

_PARALLEL = 1e-6
"""Sine of a sheet's tilt that counts as rounding."""


@keep_scenes()
def show_white(bench: Apparatus) -> None:
    """Make the print of a bench reflect all light.

    MitsimError if the light of a picture is not that of the white print times the picture. Light of a flat diffuse
    sheet that stands alone is linear in the reflectance of each point, and comes directly from there to the sensor.
    Light over several surfaces contains products of reflectances.
    """
    loaded, shapes, why = bench.loaded, bench.loaded.scene.shapes(), ""
    sheet, held = shapes[0], mi.traverse(shapes[0])
    diffuse = int(mi.BSDFFlags.DiffuseReflection) | int(mi.BSDFFlags.FrontSide) | int(mi.BSDFFlags.BackSide)
    normal = np.array(sheet.sample_position(0.0, mi.Point2f(0.5)).n, dtype=np.float64).ravel()
    names = [name for name in held.keys() if name.endswith(("reflectance.data", "reflectance.value"))]  # noqa: SIM118
    if len(shapes) != 1:
        why = f"the scene has {len(shapes)} surfaces, which light each other"
    elif sheet.class_name() != "Rectangle" or sheet.bsdf().flags() & ~diffuse or not names:
        why = "the scene's surface is no flat diffuse sheet with a reflectance"
    elif np.linalg.norm(np.cross(normal, camera_place(bench)[0][:, 2])) > _PARALLEL:
        why = "the sheet is not parallel to the sensor, so cells of light lie across the picture's pixels"
    elif len(loaded.lamps) > len(loaded.small_lamps):
        why = "the camera may see a lamp of the scene itself"
    if why:
        raise MitsimError(f"{loaded.path}: {why}; pairs are made of one flat diffuse sheet that faces the sensor")
    for name in names:
        before = np.asarray(held[name])
        white = np.full(before.shape, 255 if before.dtype == np.uint8 else 1, before.dtype)
        held[name] = type(held[name])(white) if name.endswith(".data") else 1.0
    held.update()
