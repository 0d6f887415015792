"""Positions of a bench's parts, boards put before it, whether its frames can give an image, and two pictures of it.

Positions are in the camera's frame [mm]: +z to the scene, +y up, +x to the left of a viewer along +z.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.bench.apparatus import Apparatus, Opened, check_depth
from mitsim.core.arrays import FloatArray
from mitsim.core.environment import device_array, keep_scenes
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.devices.mask import Mask
from mitsim.devices.patterns import PatternFamily
from mitsim.devices.session import BoardShape
from mitsim.optics.shadow import Directions, ShadowGeometry
from mitsim.scene.check import Unfit
from mitsim.scene.load import why_dark
from mitsim.transport.connect import PinholeRays
from mitsim.transport.direct import DirectTracer
from mitsim.transport.plugins.base import channels, device_vectors, host_values, turn_and_origin, vectors

_TRIANGLES = 40_000
"""Triangles into which meshes are divided that have fewer, so that corners show their prints."""
_GRID = 48
"""Cells per side of a shape without faces, by its surface parameters."""
_BOX = np.array([
    *([0, 1, 3], [0, 3, 2], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4]),
    *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 3, 7], [1, 7, 5]),
])  # fmt: skip
"""Triangles of a box's eight corners."""
_FILL = 0.2
"""Part of a preview's light from a lamp at its camera, so that surroundings of the window are visible."""
_PIXELS, _SAMPLES, _TURNS = 320, 32, 4
"""Pixels per side, samples per pixel and surfaces of a path of a preview."""
_WHITE = 99.5
"""Percentile that a preview shows as white, because mirrored light may be a thousand times as bright."""
_ASIDE = (0.6, 0.55, -0.75)
"""Direction from the window to the free camera: left, above and in front."""
_MARGIN = 1.5
"""Width of the free view relative to the window."""
_EDGES = 2
"""Rays per side of a pixel that show its surfaces."""
_NEAR, _FAR = 1e-3, 1e7
"""Near and far clip of a preview [mm]."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A shape of the scene as triangles.

    Attributes
    ----------
    name
        Name in the scene, or its kind.
    points
        (k, 3) corners [mm].
    triangles
        (m, 3) indices of corners.
    reflectance
        (k, 1 or 3) diffuse reflectance at the corners, 0 to 1; 0.5 where the material has none.
    is_lamp
        True if it emits.
    """

    name: str
    points: FloatArray
    triangles: npt.NDArray[np.int64]
    reflectance: FloatArray
    is_lamp: bool


@dataclass(frozen=True, eq=False)
class Layout:
    """Positions of all parts of a bench.

    Attributes
    ----------
    surfaces
        Shapes of the scene.
    projector
        (3,) position of the projector's pinhole.
    window
        (4, 3) corners of the projector's window on the aligned plane, in order around it.
    lamps
        (3,) positions of lamps without a surface, by name.
    seen
        Number of projector pixels whose light the camera's centre sees directly.
    depths
        Nearest and farthest depth [mm] of this light, or None.
    moves
        Rows and columns of projector pixels by which 1/mm of 1/z moves the window.
    obstacles
        Reasons why no calibration can give an image of this bench.
    """

    surfaces: tuple[Surface, ...]
    projector: FloatArray
    window: FloatArray
    lamps: dict[str, FloatArray]
    seen: int
    depths: tuple[float, float] | None
    moves: tuple[float, float]
    obstacles: tuple[str, ...]

    @property
    def parallax(self) -> tuple[float, float]:
        """Return rows and columns of projector pixels by which the window moves between nearest and farthest light."""
        return (0.0, 0.0) if self.depths is None else self.parallax_between(*self.depths)

    def parallax_between(self, near: float, far: float) -> tuple[float, float]:
        """Return the movement of the window between the depths ``near`` and ``far`` [mm]."""
        step = 1 / near - 1 / far
        return self.moves[0] * step, self.moves[1] * step

    def window_at(self, depth: float) -> FloatArray:
        """Return the (4, 3) corners of the window on the plane at ``depth`` [mm]."""
        rays = self.window - self.projector
        return np.asarray(self.projector + rays * ((depth - self.projector[2]) / rays[:, 2])[:, None])


@keep_scenes()
def layout_of(bench: Apparatus) -> Layout:
    """Determine the layout of a ``bench`` with one ray per projector pixel."""
    from mitsim.reconstruct.depth import pixels_of_parallax  # here: a capture needs none of the solver

    loaded, geometry, n = bench.loaded, bench.geometry, bench.n
    turn, origin = camera_place(bench)
    rays = PinholeRays(bench.projector_optics, [None])
    projector = (rays.origin - origin) @ turn
    ends = rays.directions(np.array([[0, 0], [0, n], [n, n], [n, 0]], dtype=np.float64)) @ turn
    window = projector + ends * ((geometry.scene_distance - projector[2]) / ends[:, 2])[:, None]
    seen, depths = seen_light(bench)
    row, column = (max(map(abs, pixels_of_parallax(bench.parallax, axis, n)[:2])) for axis in (0, 1))
    lamps = {}
    for emitter, tag in loaded.small_lamps:
        held, name = mi.traverse(emitter), tag.attributes.get("id") or tag.attributes.get("type", "lamp")
        if "position" in held:
            place = np.array(held["position"], dtype=np.float64).ravel()
        elif "to_world" in held and emitter.class_name() != "DirectionalEmitter":
            place = turn_and_origin(held["to_world"])[1]
        else:
            continue
        lamps[f"{name}, line {tag.line}"] = (place - origin) @ turn
    tags, shapes, surfaces = loaded.shapes, loaded.scene.shapes(), list[Surface]()
    areas = [float(np.array(shape.surface_area()).ravel()[0]) if shape.is_mesh() else 0.0 for shape in shapes]
    for number, shape in enumerate(shapes):
        name = shape.id()
        if not name or name.startswith("_"):
            kind = tags[number].attributes.get("type", "shape") if tags else shape.class_name().lower()
            name = f"{kind} {number + 1}"
        if shape.is_mesh():
            wanted = _TRIANGLES * areas[number] / max(sum(areas), 1e-30)
            points, triangles, reflectance = _triangles_of_mesh(shape, wanted)
        else:
            points, triangles, reflectance = _triangles_without_faces(shape)
        if len(triangles):
            surfaces.append(Surface(name, (points - origin) @ turn, triangles, reflectance, bool(shape.is_emitter())))
    return Layout(tuple(surfaces), projector, window, lamps, seen, depths, (row, column), obstacles(bench))


# -------- Surfaces as triangles


def _triangles_of_mesh(mesh: mi.Mesh, wanted: float) -> tuple[FloatArray, npt.NDArray[np.int64], FloatArray]:
    count = mesh.face_count()
    # Of each corner: place, place in the texture, and number of its face.
    parts = np.zeros((count, 3, 6))
    parts[..., 3:5], parts[..., 5] = [[0, 0], [1, 0], [0, 1]], np.arange(count)[:, None]
    for number, corner in enumerate(mesh.face_indices(dr.arange(mi.UInt32, count))):
        parts[:, number, :3] = vectors(mesh.vertex_position(corner), count)
        if mesh.has_vertex_texcoords():
            parts[:, number, 3:5] = np.array(mesh.vertex_texcoord(corner)).T
    while count and 4 * len(parts) <= wanted:
        a, b, c = parts.swapaxes(0, 1)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        parts = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3, 6)
    corners, triangles = np.unique(parts.reshape(-1, 6), axis=0, return_inverse=True)
    at = dr.zeros(mi.SurfaceInteraction3f, len(corners))
    at.p, at.wi = mi.Point3f(*device_vectors(corners[:, :3])), mi.Vector3f(0, 0, 1)
    at.uv = mi.Point2f(corners[:, 3:5].T.astype(np.float32))
    at.shape, at.prim_index = mi.ShapePtr(mesh), device_array(mi.UInt32, corners[:, 5])
    return corners[:, :3], triangles.reshape(-1, 3), _reflectance(mesh.bsdf(), at, len(corners))


def _triangles_without_faces(shape: mi.Shape) -> tuple[FloatArray, npt.NDArray[np.int64], FloatArray]:
    """Return a shape on a grid of its surface parameters, or its bounding box where Mitsuba has none."""
    line = np.linspace(1e-6, 1 - 1e-6, _GRID + 1).astype(np.float32)  # The middle of a disk is undefined.
    u, v = (device_array(mi.Float, axis) for axis in np.meshgrid(line, line))
    corner = (np.arange(_GRID)[:, None] * len(line) + np.arange(_GRID)).reshape(-1, 1)
    triangles = np.concatenate([corner + [0, 1, len(line)], corner + [1, len(line) + 1, len(line)]])
    try:
        at = shape.eval_parameterization(mi.Point2f(u, v))
        if host_values(at.is_valid(), len(line) ** 2).all():
            return vectors(at.p, len(line) ** 2), triangles, _reflectance(shape.bsdf(), at, len(line) ** 2)
    except RuntimeError:
        pass
    box = shape.bbox()
    ends = np.array([box.min, box.max], dtype=np.float64).reshape(2, 3)
    return np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1).reshape(-1, 3), _BOX, np.full((8, 1), 0.5)


def _reflectance(bsdf: Any, at: mi.SurfaceInteraction3f, count: int) -> FloatArray:
    try:
        diffuse = channels(mi.unpolarized_spectrum(bsdf.eval_diffuse_reflectance(at)), count)
    except (RuntimeError, NotImplementedError, AttributeError):  # materials need not know it
        return np.full((count, 1), 0.5)
    if diffuse.shape[1] != 3:
        diffuse = diffuse.mean(axis=1, keepdims=True)
    return np.clip(np.nan_to_num(diffuse, nan=0.5), 0, 1)


# -------- Pictures of the bench in its own light


@dataclass(frozen=True, eq=False)
class Preview:
    """View of a bench by a pinhole camera.

    Attributes
    ----------
    picture
        (rows, columns, 1 or 3) linear light, 0 black, 1 white (also where there is nothing).
    place
        (4, 4) transform from the bench's frame to this camera's.
    half_tan
        Tangent of half the field angle.
    """

    picture: FloatArray
    place: FloatArray
    half_tan: float

    def project(self, points: FloatArray) -> FloatArray:
        """Return (k, 2) columns and rows of ``points`` (k, 3) [mm] in the picture; NaN behind the camera."""
        local = points @ self.place[:3, :3].T + self.place[:3, 3]
        rows, columns = self.picture.shape[:2]
        ahead = np.where(local[:, 2:] > 0, local[:, 2:], np.nan)
        part = 0.5 - local[:, :2] / ahead / (2 * self.half_tan)
        return np.asarray(part * [columns, rows] - 0.5)


@keep_scenes()
def previews(bench: Apparatus, layout: Layout) -> tuple[Preview, Preview]:
    """Render the views from the sensor through the field stop, and from a free camera.

    The projector shows white, and a weak lamp at the camera lights the rest.
    """
    turn, origin = camera_place(bench)
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = turn, origin
    middle, aside = layout.window.mean(axis=0), np.eye(4)
    aside[:3, 3] = middle + np.array(_ASIDE) / np.linalg.norm(_ASIDE) * bench.geometry.scene_distance
    ahead = middle - aside[:3, 3]
    ahead /= np.linalg.norm(ahead)
    left = np.cross([0.0, 1.0, 0.0], ahead)
    left /= np.linalg.norm(left)
    aside[:3, :3] = np.stack([left, np.cross(ahead, left), ahead], axis=1)
    lit = np.concatenate([layout.window, *map(layout.window_at, layout.depths or ())])
    local = (lit - aside[:3, 3]) @ aside[:3, :3]
    wide = 2 * float(np.degrees(np.arctan(_MARGIN * np.abs(local[:, :2] / local[:, 2:]).max())))
    scene = bench.loaded.scene
    return _preview(scene, world, np.eye(4), bench.geometry.fov), _preview(scene, world, aside, wide)


def _preview(scene: mi.Scene, world: FloatArray, place: FloatArray, angle: float) -> Preview:
    kind = "luminance" if mi.is_monochromatic else "rgb"
    film = {"type": "hdrfilm", "width": _PIXELS, "height": _PIXELS, "pixel_format": kind, "rfilter": {"type": "box"}}
    pose = mi.ScalarAffineTransform4f((world @ place).tolist())
    lens = {"type": "perspective", "fov": angle, "near_clip": _NEAR, "far_clip": _FAR, "to_world": pose}
    sensor = mi.load_dict({**lens, "film": {**film, "sample_border": False}})
    integrator = mi.load_dict({"type": "path", "max_depth": _TURNS, "hide_emitters": True})
    light = np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=_SAMPLES, seed=0), dtype=np.float64)
    light = np.nan_to_num(light.reshape(_PIXELS, _PIXELS, -1))
    side = _PIXELS * _EDGES
    column, row = np.meshgrid((np.arange(side) + 0.5) / side, (np.arange(side) + 0.5) / side)
    places = mi.Point2f(*(device_array(mi.Float, axis) for axis in (column, row)))
    ray, _ = sensor.sample_ray_differential(0.0, 0.5, places, mi.Point2f(0.5))
    met = scene.ray_intersect(ray)
    hit = host_values(met.is_valid(), side * side).astype(float)[:, None]
    cosine = np.abs(host_values(dr.dot(met.sh_frame.n, ray.d), side * side))[:, None]
    lamp = _reflectance(met.bsdf(ray), met, side * side) * cosine * hit
    by_lamp, full = (
        np.asarray(values.reshape(_PIXELS, _EDGES, _PIXELS, _EDGES, -1).mean(axis=(1, 3))) for values in (lamp, hit)
    )
    empty = 1 - full
    white = float(np.percentile(light[light > 0], _WHITE)) if light.any() else 1.0
    shown = np.clip(light / white, 0, 1) * (1 - _FILL) + _FILL * by_lamp if light.any() else by_lamp
    shown = np.asarray(shown * (1 - empty) + empty)
    return Preview(shown, np.asarray(np.linalg.inv(place)), float(np.tan(np.radians(angle / 2))))


# -------- Surfaces that are put before a bench: the white board of a calibration, and pictures on its prints

_BEYOND = 1.1
"""Half side of a board without a stated size, relative to what the sensor's edge sees."""
_GRAZING = 0.05
"""Least cosine by which a board without a stated size recedes from a ray."""
_CELLS = 64
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
    slope = [-math.tan(math.radians(tilt)) for tilt in (shape.tilt_column_deg, shape.tilt_row_deg)]
    steep, turned, camera = math.hypot(*slope[::-1]), np.eye(4), np.eye(4)
    if shape.size_mm is not None:
        half = shape.size_mm / 2
    elif steep:  # along the slope a ray of tan-angle u meets the board at u z / (cos - u sin) from its middle
        angle, corner = math.atan(steep), math.sqrt(2) * half / where
        half = half * math.sqrt(2) / max(math.cos(angle) - corner * math.sin(angle), _GRAZING)
    if steep:
        # The smallest rotation with the board's slopes, so that no axis comes first: its plane is
        # z = tan(tilt_row) s_row + tan(tilt_column) s_column, with s_row = -y and s_column = -x.
        steepest = float(np.linalg.norm(slope))
        angle, uphill = math.atan(steepest), np.array(slope) / steepest
        # Rodrigues' formula about the level line: points uphill of the middle move away along z.
        axis = np.array([uphill[1], -uphill[0], 0.0])
        cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        turned[:3, :3] = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    bsdf = {"type": "diffuse", "reflectance": {"type": "uniform", "value": reflectance}}
    camera[:3, :3], camera[:3, 3] = camera_place(bench)
    place = mi.ScalarAffineTransform4f().translate([0, 0, where]) @ mi.ScalarAffineTransform4f(turned.tolist())
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


def _bowed_mesh(shape: BoardShape, half: float, place: FloatArray, bsdf: dict[str, Any]) -> mi.Mesh:
    """Return the mesh of a bowed board, z = bow (x^2 + y^2) / half^2 in its own frame, the camera towards -z."""
    line = np.linspace(-half, half, _CELLS + 1)
    x, y = np.meshgrid(line, line)
    part = shape.bow_mm / half**2
    points = np.stack([x, y, part * (x**2 + y**2)], axis=-1)
    normals = np.stack([2 * part * x, 2 * part * y, -np.ones_like(x)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    side = _CELLS + 1
    corner = (np.arange(_CELLS)[:, None] * side + np.arange(_CELLS)).reshape(-1, 1)
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


# -------- Whether frames can give an image, from geometry alone and before any light is simulated

_SEEN = 0.25
"""Part of the projector's pixels that must be visible; shipped scenes have 0.96 to 1, and 0.75 beside a mirror."""
MOST_LOST = 0.3
"""Part of the mask without factors (rms) from which a calibration is refused: a tenth of the light's energy."""
_SEPARABLE = 0.01
"""Residual of a separable mask, as :data:`mitsim.reconstruct.factors.SEPARABLE_RESIDUAL`."""
_PLACES = 256
"""Points of the mask per axis that are compared; the singular values take 20 ms."""


class Fault(NamedTuple):
    """Reason without image, remedy, and the missing part of the image; 1 if no image can be solved for."""

    reason: str
    remedy: str
    lost: float = 1.0


def obstacles(bench: Apparatus, family: PatternFamily | None = None) -> tuple[str, ...]:
    """Return why no calibration can give an image, with the remedy, one sentence per reason; () if it can.

    Parameters
    ----------
    bench
        Scene, camera and projector.
    family
        Patterns of the frames; None if they are not known yet, so that data are not counted.
    """
    found = [mask_fault(bench), family and shortage(bench, family)]
    if not bench.loaded.mirrors:
        (seen, _), every = seen_light(bench), bench.n**2
        if not seen:
            found.insert(0, Fault("no light of the projector reaches the camera", why_dark(bench.loaded)))
        elif seen < _SEEN * every:
            part = f"{seen} of {every} projector pixels ({seen / every:.1%})"
            reason = f"the camera sees the light of {part}, and the rest of the image is empty"
            place = f"{bench.geometry.scene_distance:g} mm, where the projector's window lies in the camera's view"
            remedy = f"move the scene to {place}, or make it larger"
            found.insert(0, Fault(reason, remedy))
    return tuple(f"{fault.reason}; {fault.remedy}" for fault in found if fault)


# ---- The scene ----


@keep_scenes()
def seen_light(bench: Apparatus) -> tuple[int, tuple[float, float] | None]:
    """Return the number of projector pixels that light points visible from the sensor's centre, and their depths.

    The nearest and farthest depth [mm] are None if there is none. One ray is traced per pixel.
    """
    light = DirectTracer(bench.setup, 1).trace(0, 0, 1)
    inverse = light.inverse_depth[light.value > 0]
    depths = (1 / float(inverse.max()), 1 / float(inverse.min())) if len(inverse) else None
    return len(np.unique(light.pixel[light.value > 0])), depths


def seen_depths(bench: Apparatus) -> FloatArray:
    """Return the mean depth (n, n) [mm] of each projector pixel's light that the sensor's centre sees, nan if none."""
    light = DirectTracer(bench.setup, 1).trace(0, 0, 16)
    seen, count = light.value > 0, bench.n**2
    hits = np.bincount(light.pixel[seen], minlength=count)
    total = np.bincount(light.pixel[seen], 1 / light.inverse_depth[seen], count)
    found: FloatArray = np.where(hits > 0, total / np.maximum(hits, 1), np.nan)
    return found.reshape(bench.n, bench.n)


# ---- The mask ----


def mask_fault(bench: Apparatus) -> Fault | None:
    """Return why the mask of a ``bench`` has no two factors, even without diffraction and tilt; None if it has.

    The part of the mask that the sensor sees is compared with the best product of a row and a column profile, with and
    without the means that a solver subtracts.
    """
    geometry, mask = bench.geometry, bench.geometry.build_mask()
    crossings = _crossings(bench)
    rows, columns = (np.linspace(each.min(), each.max(), _PLACES) for each in crossings)
    seen = mask.transmission(rows[:, None], columns)
    centred = seen - seen.mean(axis=0) - seen.mean(axis=1)[:, None] + seen.mean()
    residual = min(_beyond_one(seen), _beyond_one(centred))
    if residual <= _SEPARABLE:
        return None
    own = 0.0 if isinstance(mask, Mask) else min(mask.residuals)
    if own > residual / 2:
        problem = f"the mask ({geometry.mask_words}) is not separable: frames can be captured, but the best separable"
        remedy = 'use kind = "separable" in its table [mask]'
        return Fault(f"{problem} mask misses {own:.0%} of its shadow, and so do images", remedy, residual)
    needed = 2 * max(float(np.abs(each).max()) for each in crossings)
    if mask.flaws.turn_deg:
        turned = f"the mask ({geometry.mask_words}) is not separable as it is mounted, because the best separable"
        return Fault(f"{turned} mask misses {residual:.0%} of its shadow", "mount it straight", residual)
    covers = f"covers {mask.extent_mm:.2g} mm of the {needed:.2g} mm that the sensor sees through it"
    reason = f"the mask {covers}, so that its edge makes {residual:.0%} of the responses not separable"
    least, feature = math.ceil(needed / mask.feature_mm), f"{mask.feature_mm * 1e3:g} um"
    return Fault(reason, f"use at least {least} features of {feature}, or larger ones", residual)


def _beyond_one(values: FloatArray) -> float:
    energy = np.square(np.linalg.svd(values, compute_uv=False))
    return float(np.sqrt(energy[1:].sum() / energy.sum())) if energy.sum() > 0 else 0.0


def _crossings(bench: Apparatus) -> list[FloatArray]:
    """Where rays from each sensor row, and column, to both ends of the window cross the mask, from its centre [mm]."""
    geometry = bench.geometry
    shadow = ShadowGeometry.of(geometry, geometry.scene_distance)
    rays = [shadow.along(k).crossings(Directions(np.array(edges), 0.0)) for k, edges in enumerate(bench.windows)]
    return [each - own for each, own in zip(rays, geometry.mask_offset, strict=True)]


# ---- Data and unknowns ----


def shortage(bench: Apparatus, family: PatternFamily) -> Fault | None:
    """Return why frames of a ``bench`` under a ``family`` are too few, or None if they suffice.

    Data are counted on the sensor rows and columns that the mask lights, and unknowns on the projector pixels that any
    pattern lights. Behind colour filters, every line of the light has its own unknowns.
    """
    geometry, n = bench.geometry, bench.n
    half = geometry.build_mask().extent_mm / 2
    crossed = [(each.min(axis=1) <= half) & (each.max(axis=1) >= -half) for each in _crossings(bench)]
    lit = [int(np.count_nonzero(each)) - geometry.centred for each in crossed]
    patterns = family.left.shape[1], family.right.shape[1]
    lines = len(bench.lines.wavelengths_nm) if bench.filters and bench.lines else 1
    needed = [int(np.count_nonzero(side.any(axis=1))) for side in (family.left, family.right)]
    ranks = [min(rows * count, most) for rows, count, most in zip(lit, patterns, needed, strict=True)]
    data, rank = math.prod(lit) * math.prod(patterns), math.prod(ranks) * lines
    if data > rank and ranks == needed:
        return None
    least = " x ".join(str(n // max(rows, 1) + 1) for rows in lit)
    return Fault(
        ("noise cannot be distinguished from the image" if data <= rank else "the image is not determined")
        + f": {patterns[0]} x {patterns[1]} patterns ({family.name}) on {lit[0]} x {lit[1]} sensor pixels that the "
        f"mask lights give {patterns[0] * lit[0]} x {patterns[1] * lit[1]} numbers for {n} x {n} unknowns"
        f"{f' of each of {lines} lines' if lines > 1 else ''}",
        f"use at least {least} patterns, or more sensor pixels",
        1.0 if data <= rank else 1 - math.prod(ranks) / math.prod(needed),
    )
