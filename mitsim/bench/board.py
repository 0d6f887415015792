"""Surfaces that are put before a bench: the white board of a calibration, and pictures on its prints."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.bench.apparatus import Opened, check_depth
from mitsim.core.arrays import FloatArray
from mitsim.core.environment import keep_scenes
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.devices.session import BoardShape
from mitsim.scene.limits import Unfit
from mitsim.transport.plugins.base import host_values, turn_and_origin
from mitsim.transport.projector import PinholeRays

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
#
# Pictures on the prints of a bench, and whether one tracing serves every picture.
#
# Light of a flat diffuse sheet that stands alone is linear in the reflectance of each point, and comes directly from
# there to the sensor. Light of a white sheet times the picture is then that of the picture. Light over several surfaces
# contains products of reflectances, and is traced for each picture.

_PARALLEL = 1e-6
"""Sine of a sheet's tilt that counts as rounding."""
_BITMAP, _PLAIN = ("reflectance.data", "diffuse_reflectance.data"), "reflectance.value"
"""Endings of Mitsuba's parameter names for the reflectance of a print, and of an even surface."""
_LARGEST_CODE = 255
"""8-bit code of reflectance 1."""


def traced_anew(bench: Apparatus) -> str:
    """Return why light must be traced anew for each picture; empty if light of white prints can be multiplied."""
    loaded, shapes = bench.loaded, bench.loaded.scene.shapes()
    if len(shapes) != 1:
        return f"the scene has {len(shapes)} surfaces, which light each other"
    (sheet,) = shapes
    diffuse = int(mi.BSDFFlags.DiffuseReflection) | int(mi.BSDFFlags.FrontSide) | int(mi.BSDFFlags.BackSide)
    if sheet.class_name() != "Rectangle" or sheet.bsdf().flags() & ~diffuse:
        return "the scene's surface is no flat diffuse sheet"
    normal = np.array(sheet.sample_position(0.0, mi.Point2f(0.5)).n, dtype=np.float64).ravel()
    if np.linalg.norm(np.cross(normal, camera_place(bench)[0][:, 2])) > _PARALLEL:
        return "the sheet is not parallel to the sensor, so cells of light lie across the picture's pixels"
    if len(loaded.lamps) > len(loaded.small_lamps):
        return "the camera may see a lamp of the scene itself"
    return ""


@keep_scenes()
def show_white(bench: Apparatus) -> None:
    """Make all printed surfaces, or the only surface, reflect all light; raise MitsimError without either."""
    for _, held, names in _prints(bench):
        for name in names:
            values = np.ones(np.shape(held[name]))
            held[name] = _as_stored(held[name], values) if name.endswith(_BITMAP) else 1.0
        held.update()


@keep_scenes()
def show_picture(bench: Apparatus, reflectance: npt.NDArray[np.float64]) -> None:
    """Put a picture on all prints: each point takes the reflectance of the projector's pixel that lights it.

    Points beyond the window take the nearest pixel. ``reflectance`` is (n, n). Raises MitsimError for a scene without a
    print, or one whose bitmap has colours or is turned.
    """
    rays, n = PinholeRays(bench.projector_optics, [None]), bench.n
    for sheet, held, names in _prints(bench):
        for name in names:
            if not name.endswith(_BITMAP):
                problem = f"{bench.loaded.path}: has no printed surface (a reflectance by bitmap) to put pictures on"
                raise MitsimError(f"{problem}; give one its texture")
            shape, turned = np.shape(held[name]), held[name.replace(".data", ".to_uv")]
            if shape[2] != 1 or not np.array_equal(np.array(turned.matrix), np.eye(3)):
                problem = f"{bench.loaded.path}: a print has {shape[2]} channels, or a turned bitmap"
                raise MitsimError(f"{problem}; give a raw grey one")
            row, column = np.divmod(np.arange(shape[0] * shape[1]), shape[1])
            texel = mi.Point2f(*((np.stack([column, row]) + 0.5) / [[shape[1]], [shape[0]]]).astype(np.float32))
            places = sheet.eval_parameterization(texel).p
            world = np.stack([host_values(axis, len(row)) for axis in (places.x, places.y, places.z)], axis=1)
            at = np.nan_to_num(rays.points(world.astype(np.float64))[0])
            pixel = np.clip(np.floor(at), 0, n - 1).astype(np.int64)
            held[name] = _as_stored(held[name], reflectance[pixel[:, 0], pixel[:, 1]].reshape(shape))
        held.update()


def _prints(bench: Apparatus) -> list[tuple[mi.Shape, Any, list[str]]]:
    """Return each shape that has a print, or the only shape, with its parameters and the names of its reflectances."""
    every = [(shape, mi.traverse(shape)) for shape in bench.loaded.scene.shapes() if shape.bsdf()]

    def named(ending: str | tuple[str, ...]) -> list[tuple[mi.Shape, Any, list[str]]]:
        found = [(shape, held, [name for name in held.keys() if name.endswith(ending)]) for shape, held in every]  # noqa: SIM118 - no dict
        return [(shape, held, names) for shape, held, names in found if names]

    found = named(_BITMAP) or (named(_PLAIN) if len(every) == 1 else [])
    if not found:
        problem = f"{bench.loaded.path}: none of its {len(every)} surfaces has a print to put pictures on"
        raise MitsimError(f"{problem}; give one a reflectance by bitmap")
    return found


def _as_stored(before: Any, values: npt.NDArray[np.float64]) -> Any:
    whole = np.asarray(before).dtype == np.uint8
    stored = np.rint(_LARGEST_CODE * values).astype(np.uint8) if whole else values.astype(np.float32)
    return type(before)(stored)
