"""Loading a scene file: a Mitsuba scene with its camera geometry and projector grid, or a refusal in one line."""

from __future__ import annotations

import re
import tempfile
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import keep_scenes
from mitsim.core.errors import MitsimError
from mitsim.core.prepare import fit_square, read_reflectance
from mitsim.scene import tree
from mitsim.scene.check import PICTURE, CheckedScene, check_file, looking_beside
from mitsim.scene.headers import check_obj, check_ply
from mitsim.scene.limits import Range, Unfit
from mitsim.scene.outline import Tag
from mitsim.scene.window import ProjectorGrid, locate_projector

if TYPE_CHECKING:
    from mitsim.devices.sensor import SensorModel

SENSOR_PLUGIN = "mitsim_lensless"
_SMALL_LAMPS = ("DirectionalEmitter", "PointLight", "SpotLight")
_FLAT, _TURNED = ("Rectangle", "Disk"), 1e-6
"""Flat shapes, and the difference between parallel normals in single precision."""


@dataclass(frozen=True)
class LoadedScene:
    """A scene ready for transport; ``projector`` and ``grid`` are None only for ``render``.

    Attributes
    ----------
    files
        All files that Mitsuba read, the scene first.
    mirrors, glossy
        True if a surface reflects or refracts into single directions, or into lobes.
    shapes
        Tags of ``scene.shapes()``; empty if one tag gave several shapes.
    small_lamps
        Lamps that no path can hit, with their tags.
    coloured, parting
        Tags of objects that may depend on wavelength, and of dispersive glass.
    notes
        Changes to the scene that render it correctly.
    one_way
        True if no surface sees another.
    sensor_note
        Difference between the sensor of a camera file and the scene's.
    in_view
        True if a projector shines directly on the sensor; such light is traced like that of mirrors.
    """

    path: Path
    files: tuple[Path, ...]
    scene: mi.Scene
    camera: mi.Sensor
    projector: mi.Emitter | None
    grid: ProjectorGrid | None
    lamps: tuple[mi.Emitter, ...]
    mirrors: bool
    glossy: bool
    unfit: Unfit
    shapes: tuple[Tag, ...]
    small_lamps: tuple[tuple[mi.Emitter, Tag], ...]
    coloured: tuple[Tag, ...]
    parting: tuple[Tag, ...] = ()
    samples: int | None = None
    notes: tuple[str, ...] = ()
    one_way: bool = False
    sensor_note: str | None = None
    own: Mapping[str, str] = field(default_factory=dict)
    in_view: bool = False

    @property
    def pixels(self) -> ProjectorGrid:
        if self.grid:
            return self.grid
        found = [emitter for emitter in self.scene.emitters() if emitter.class_name() == "Projector"]
        if len(found) != 1:
            raise _one_projector(self.path, found)
        return locate_projector(str(self.path), found[0], self.camera)

    @cached_property
    def hairy(self) -> bool:
        return any(shape.bsdf() and holds_hair(shape.bsdf().flags()) for shape in self.scene.shapes())

    @cached_property
    def smoothed(self) -> bool:
        return any(_is_smoothed(shape) for shape in self.scene.shapes())


@keep_scenes()
def load_scene(
    path: Path,
    defines: Mapping[str, str] | None = None,
    needs_projector: bool = True,
    outside: bool = False,
    sensor: SensorModel | None = None,
) -> LoadedScene:
    """Load a scene XML into the current variant; the plugin ``mitsim_lensless`` must be registered.

    ``needs_projector`` refuses a scene without exactly one projector, or one that the factored estimator cannot render.
    Pitch and format of a ``sensor`` replace the scene's. ``outside`` allows files outside the scene's folder.

    Raises MitsimError of one line that names the file, for any fault.
    """
    checked = check_file(path, defines or {}, outside, mi.variant())
    if needs_projector and checked.unfit.factored is not None:
        raise checked.unfit.factored
    checked.config.variant = mi.variant()
    sensor_note = None if sensor is None else tree.fit_film(checked, sensor)
    with with_own_files(checked), looking_beside(checked.outline):
        moved = tree.move_to_camera(checked.outline, checked.state)
        notes = tree.emit_by_faces(checked)  # before thin shapes are meshes, too
        with tree.with_thin_shapes_as_meshes(checked.outline, checked.state):
            tree.put_wrappers(checked.state)
            scene = mi.parser.instantiate(checked.config, checked.state)
    for mesh, materials in checked.unread.items():
        if materials:
            warnings.warn(f"mesh {mesh}: its materials ({materials}) are not read; it has the scene's", stacklevel=2)
    tree.check_meshes(moved, scene)
    _add_up_normals(scene, checked.without_normals)
    # Texels are checked after normals were added up, because Mitsuba's own normals once had a NaN.
    check_texels(path, scene, checked.limits)
    cameras = [sensor for sensor in scene.sensors() if hasattr(sensor, "geometry")]
    if len(cameras) != 1:
        raise MitsimError(f'{path}: {len(cameras)} sensors of type "{SENSOR_PLUGIN}"; a scene needs exactly one')
    emitters, shapes, unfit = list(scene.emitters()), scene.shapes(), checked.unfit
    projectors = [emitter for emitter in emitters if emitter.class_name() == "Projector"]
    for projector in projectors:
        scale = float(np.array(mi.traverse(projector)["scale"]).ravel()[0])
        if scale < 0:
            raise MitsimError(f"{path}: the projector's scale: got {scale:g}; light is at least 0")
    if needs_projector and len(projectors) != 1:
        raise _one_projector(path, projectors)
    grid = None
    if len(projectors) == 1:
        try:
            grid = locate_projector(str(path), projectors[0], cameras[0])
        except MitsimError:
            if needs_projector:
                raise
    small = [emitter for emitter in emitters if emitter.class_name() in _SMALL_LAMPS]
    mirrors, glossy = _mirrors_and_gloss(scene, unfit)
    flat = all(shape.class_name() in _FLAT and shape.bsdf() for shape in shapes)
    one_sided = flat and not any(mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.BackSide) for shape in shapes)
    normals = [np.array(shape.sample_position(0.0, mi.Point2f(0.5)).n).ravel() for shape in shapes if one_sided]
    devices = cameras[0], projectors[0] if grid else None, grid
    lamps = tuple(emitter for emitter in emitters if grid is None or emitter.class_name() != "Projector")
    tags = checked.shapes if len(checked.shapes) == len(shapes) else ()
    small_lamps = tuple(zip(small, checked.small_lamps, strict=True))
    facts: dict[str, Any] = {name: getattr(checked, name) for name in ("coloured", "parting", "samples", "own")}
    facts |= {"one_way": bool(normals) and float(np.ptp(normals, axis=0).max()) < _TURNED, "notes": notes}
    facts |= {"mirrors": mirrors, "glossy": glossy, "unfit": unfit, "shapes": tags, "small_lamps": small_lamps}
    return LoadedScene(path, checked.files, scene, *devices, lamps, sensor_note=sensor_note, **facts)


def _one_projector(path: Path, found: Sequence[mi.Emitter]) -> MitsimError:
    return MitsimError(f"{path}: needs one emitter of type projector, the file has {len(found) or 'none'}")


def _mirrors_and_gloss(scene: mi.Scene, unfit: Unfit) -> tuple[bool, bool]:
    flags = [shape.bsdf().flags() for shape in scene.shapes() if shape.bsdf()]
    mirror = int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.DeltaTransmission)
    mirrors = any(own & mirror for own in flags) or unfit.instances is not None
    hidden = any(shape.class_name() == "Instance" for shape in scene.shapes())
    return mirrors, hidden or any(mi.has_flag(own, mi.BSDFFlags.Glossy) for own in flags)


def holds_hair(flags: Any) -> Any:
    """Return True for ``flags`` of a material that is, or holds, hair."""
    both = int(mi.BSDFFlags.NonSymmetric) | int(mi.BSDFFlags.Null)
    return (flags & both) == both


_SMOOTH_BY_CLASS = ("Instance", "SDFGrid")
_PARALLEL = 0.9999
"""Cosine between normals of a face and of its vertices that counts as flat."""


def _is_smoothed(shape: mi.Shape) -> bool:
    if not shape.is_mesh() or not shape.has_vertex_normals():
        return shape.class_name() in _SMOOTH_BY_CLASS
    # Rectangles and cubes are meshes without the parameters of one.
    held = shape.faces_buffer(), shape.vertex_positions_buffer(), shape.vertex_normals_buffer()
    faces, positions, normals = (np.array(each).reshape(-1, 3) for each in held)
    corners = positions[faces].astype(np.float64)
    own = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cosines = np.abs((normals[faces] * own[:, None]).sum(axis=2))
    return bool((cosines < _PARALLEL * np.linalg.norm(own, axis=1)[:, None]).any())


# -------- Values of a loaded scene's bitmaps and meshes
# OpenEXR files and colours of vertices may hold NaN, infinity, negative numbers and reflectances above 1, which
# Mitsuba accepts. The renderer would spread one such texel over every frame.

_ANY = Range(-np.inf, np.inf)
_ROUNDING = 1e-5


_WHOLE = 2.0**40
"""Whole number for a normal of length 1: a vertex may have a million faces."""


def _add_up_normals(scene: mi.Scene, without_normals: frozenset[str]) -> None:
    """Compute vertex normals of meshes without normals such that every load gives the same bits.

    Mitsuba adds them up in 32 bits in the order of its threads.
    """
    parameters = mi.traverse(scene)
    for key in parameters.keys():  # noqa: SIM118 - SceneParameters is no dict
        if key.rpartition(".")[2] == "vertex_normals":
            mesh = parameters.properties[key][2]
            files = re.search(r'name = "([^"]*)"', str(mesh))
            if files and mesh.has_vertex_normals() and without_normals.issuperset(files[1].split(" + ")):
                parameters[key] = dr.ravel(_vertex_normals(mesh))
    parameters.update()


def _vertex_normals(mesh: mi.Mesh) -> mi.Normal3f:
    """Return vertex normals weighted by the angles of the faces (Thuermer and Wuethrich 1998, as in Mitsuba).

    Whole numbers are summed because their order does not matter. A zero sum gives Mitsuba's default normal.
    """
    corners = mesh.face_indices(dr.arange(mi.UInt32, mesh.face_count()))
    points = [mesh.vertex_position(corner) for corner in corners]
    across = dr.normalize(dr.cross(points[1] - points[0], points[2] - points[0]))
    sums = [dr.zeros(mi.Int64, mesh.vertex_count()) for _ in range(3)]
    for corner, here, after, before in zip(
        corners, points, points[1:] + points[:1], points[2:] + points[:2], strict=True
    ):
        angle = dr.unit_angle(dr.normalize(after - here), dr.normalize(before - here))
        weighted = across * angle * _WHOLE
        for total, value in zip(sums, weighted, strict=True):
            dr.scatter_reduce(dr.ReduceOp.Add, total, mi.Int64(dr.round(value)), corner, dr.isfinite(value))
    added = mi.Vector3f(*map(mi.Float, sums))
    return dr.select(dr.squared_norm(added) > 0, mi.Normal3f(dr.normalize(added)), mi.Normal3f(1, 0, 0))


def check_texels(path: Path, scene: mi.Scene, limits: Mapping[str, Range]) -> None:
    """Raise MitsimError for bitmaps and meshes with values outside ``limits`` by use, or that are not finite.

    The message has the file or mesh, the texel and its value.
    """
    parameters = mi.traverse(scene)
    for key in parameters.keys():  # noqa: SIM118 - SceneParameters is no dict
        name, _, last = key.rpartition(".")
        if last == "data" or last.startswith(("vertex_", "face_")):
            values = np.array(parameters[key])
            if values.dtype.kind != "f":
                continue  # Mitsuba may keep bitmaps of 8 bits as they are: those hold nothing impossible
            held = str(parameters.properties[key][2])
            if mi.is_spectral and (last.endswith("_color") or ("raw = 0" in held and values.shape[-1] == 3)):
                continue  # coefficients of smooth spectra in Mitsuba's model: of any, they lie within 0 and 1
            file = re.search(r'name = "([^"]*)"', held)
            named = file[1] if file else name
            # Mitsuba names a texture by its parameter, and a referenced texture by a number.
            limit = limits.get(named if last == "data" else last) or limits.get(name.rpartition(".")[2], _ANY)
            wrong = ~np.isfinite(values) | (values < limit.low) | (values > limit.high + _ROUNDING)
            if wrong.any():
                at, value, count = np.argwhere(wrong)[0], values[wrong][0], wrong.any(axis=-1).sum()
                place = f"mesh {named}: number {at[0]} of its {last} is {value:g}"
                if values.ndim == 3:
                    texel = f"the texel in row {at[0]}, column {at[1]}"
                    place = f"bitmap {named}: {texel} is {value:g} ({count} such texels)"
                words = f" of {limit.low:g} to {limit.high:g}{limit.hint}" if limit is not _ANY else ""
                raise MitsimError(f"{path}: {place}; allowed are finite numbers{words}")


# -------- Pictures and meshes that a user names
#
# Pictures and meshes of the user in the tree of a checked scene, converted to files that Mitsuba reads.
#
# A picture becomes the reflectances of a sheet (:func:`mitsim.core.prepare.read_reflectance`), in the middle of a
# square. A mesh is moved and scaled before the scene's own ``to_world`` acts: its longest side is 1, it stands on the
# plane y = 0, and the middle of its box is over the origin.

_BEHIND = 0.01
"""Part of a mesh's corners whose normal may oppose the winding, because of slivers."""
_CODE_ROUNDING = 1e-9
"""Rounding of 8-bit codes that were divided by 255 and are multiplied again."""


@contextmanager
def with_own_files(checked: CheckedScene) -> Iterator[None]:
    """Prepare the files that the user named; the prepared files exist within the context.

    Raises MitsimError for a picture that is no reflectance, a mesh without faces or with normals that point inwards,
    and if files cannot be written.
    """
    with ExitStack() as stack:
        for node in checked.state.nodes:
            name = str(node.props["filename"]) if "filename" in node.props else ""
            if name not in checked.own:
                continue
            if checked.own[name] != PICTURE:
                checked.unread[name] = _stand(node.props, Path(name))
                continue
            square = fit_square(read_reflectance(Path(name)))
            codes = np.rint(255 * square)
            # Whole codes are written as in a shipped print, so that the same picture gives the same frames.
            whole = bool(np.abs(codes - 255 * square).max() < _CODE_ROUNDING)
            made = Path(stack.enter_context(tempfile.TemporaryDirectory())) / f"picture{'.png' if whole else '.exr'}"
            values = codes.astype(np.uint8) if whole else square.astype(np.float32)
            try:
                mi.Bitmap(values[..., None]).write(str(made))
            except RuntimeError as error:
                rule = "set TMPDIR to another folder"
                raise MitsimError(f"picture {name}: {made} cannot be written ({error}); {rule}") from None
            node.props["filename"], node.props["raw"] = str(made), True
        yield


def _stand(props: mi.Properties, path: Path) -> str:
    kinds = {".ply": check_ply, ".obj": check_obj}
    kind = path.suffix.lower()
    if kind not in kinds:
        raise MitsimError(f"object {path}: ends in {kind or 'nothing'}; read are .ply (triangles) and .obj")
    try:
        smooth, unread = kinds[kind](path)
        mesh = mi.load_dict({"type": kind[1:], "filename": str(path)})
    except (ValueError, RuntimeError, OSError) as error:
        said = str(error).strip().splitlines()[-1]
        raise MitsimError(f"object {path}: the file {said}") from None
    props.set_plugin_name(kind[1:])
    props["filename"] = str(path)
    props["face_normals"] = not smooth  # Mitsuba would smooth the edges of a mesh that states no normals
    _, sides = tree.tilts(props)
    behind = int((sides < 0).sum())
    if behind > _BEHIND * sides.size:
        problem = f"object {path}: the normals of {behind} of {sides.size} corners face against the way that their"
        raise MitsimError(f"{problem} faces are wound; recompute normals outwards, or export without")
    corners = np.array(mi.traverse(mesh)["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    longest = float((high - low).max())
    if longest <= 0:
        raise MitsimError(f"object {path}: all its vertices are one point; export the mesh again")
    middle = (low + high) / 2
    upright = np.diag([1 / longest, 1 / longest, 1 / longest, 1.0])
    upright[:3, 3] = -np.array([middle[0], low[1], middle[2]]) / longest
    props["to_world"] = mi.ScalarAffineTransform4d(tree.placement_of(props) @ upright)
    return unread


# -------- Why a scene is dark
#
# Explanation of a dark scene: the reason why light of the projector does not reach the camera.
#
# A few hundred rays go from the projector through its window, or through the part of it that contains the scene, and
# from the points that they hit to the sensor's centre. Holes, filters and glass let them pass.

_RAYS = 24
"""Rays per side: they hit anything larger than a 24th of the window."""
_FAR = 3.0
"""Multiple of the aligned plane's distance beyond which a scene counts as too far."""
_SMALL = 1e-2
_MOST_SHAPES = 64
_MOST_PASSED = 16


def why_dark(loaded: LoadedScene) -> str:
    geometry, grid = loaded.camera.geometry, loaded.pixels
    to_world = loaded.camera.world_transform()
    projector_to_world = mi.traverse(loaded.projector)["to_world"]
    start = projector_to_world @ mi.Point3f(0)
    window = grid.row_tan, grid.column_tan
    boxes = [loaded.scene.bbox(), *(shape.bbox() for shape in loaded.scene.shapes()[:_MOST_SHAPES])]
    parts = [_part_with(box, loaded, to_world.inverse() @ start) for box in boxes]
    for part in (window, *filter(None, parts)):
        rows, columns = (low + (high - low) * (np.arange(_RAYS) + 0.5) / _RAYS for low, high in part)
        y, x = (-geometry.scene_distance * edges.ravel() for edges in np.meshgrid(rows, columns, indexing="ij"))
        plane = to_world @ mi.Point3f(x, y, geometry.scene_distance)
        if not _is_any((projector_to_world.inverse() @ plane).z > 0):
            return "the projector looks away from the scene, whose aligned plane lies behind it; turn the projector"
        towards = dr.normalize(plane - start)
        si = _meet_opaque(loaded.scene, mi.Ray3f(start, towards), None)
        met = np.array(si.is_valid()).ravel()
        if met.any():
            break
        if _is_any(loaded.scene.ray_test(mi.Ray3f(start, towards))):
            return "all that the projector's rays meet lets light pass; put something opaque behind it"
    else:
        return _where_scene_lies(loaded, to_world, any(parts[1:]))
    back = mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.BackSide)
    centre = to_world @ mi.Point3f(0)
    lit = si.is_valid() & (back | (si.wi.z > 0))
    facing = lit & (back | (dr.dot(si.n, centre - si.p) * dr.sign(dr.dot(si.n, start - si.p)) > 0))
    if not _is_any(lit) or not _is_any(facing):
        which = "camera" if _is_any(lit) else "projector"
        met_by = f"{met.sum()} of {met.size} rays of the projector meet a surface, and it turns its back to the {which}"
        remedy = "flip its normals or put its material in <bsdf type='twosided'>"
        return f"{met_by}: a mesh wound the wrong way; {remedy}"
    seen = np.array(to_world.inverse() @ si.p).reshape(3, -1)[:, np.array(facing).ravel()]
    slope = np.abs(seen[:2] / seen[2]).max(axis=0)
    if seen[2].max() <= geometry.mask_distance:
        return f"what is lit lies at z = {seen[2].max():.4g} mm, not in front of the mask; move the scene along +z"
    if slope.min() > geometry.tan_half_fov:
        off = f"{np.degrees(np.arctan(slope.min())):.3g} degrees off the axis or more, and the stop (fov) lets"
        remedy = f"{geometry.fov / 2:g} degrees pass; turn the camera or widen fov"
        return f"what is lit lies outside the field stop: {off} {remedy}"
    if not _is_any(facing & ~_meet_opaque(loaded.scene, si.spawn_ray_to(centre), centre).is_valid()):
        return "something hides from the camera what is lit; move it out of the way"
    if part is not window:
        extents = [(own[1] - own[0]) / (whole[1] - whole[0]) for own, whole in zip(part, window, strict=True)]
        spans = f"{min(extents):.1e} of the window only, {min(extents) * grid.n:.1e} projector pixels"
        remedy = "give the projector a narrower fov, or a larger target"
        return f"what is lit spans {spans}: too few rays meet it; {remedy}"
    return "what is lit lies edge-on, is hidden or reflects nothing; turn it, move it or check its material"


def _part_with(box: mi.BoundingBox3f, loaded: LoadedScene, start: mi.Point3f) -> tuple[tuple[float, float], ...] | None:
    distance = loaded.camera.geometry.scene_distance
    if not box.valid():
        return None
    corners = _corners(box, loaded.camera.world_transform())
    origin = np.array(start).reshape(3, 1)
    ahead = corners[2] > origin[2]
    if not ahead.all() or distance <= origin[2, 0] or corners[2].min() > _FAR * distance:
        return None
    on_plane = origin + (corners - origin) * (distance - origin[2]) / (corners[2] - origin[2])
    grid, part = loaded.pixels, []
    for (low, high), tangents in zip((grid.row_tan, grid.column_tan), -on_plane[[1, 0]] / distance, strict=True):
        first, last = max(low, float(tangents.min())), min(high, float(tangents.max()))
        if first > last:
            return None
        part.append((first, last))
    return tuple(part)


def _corners(box: mi.BoundingBox3f, to_world: mi.Transform4f) -> FloatArray:
    corners = np.array([list(box.corner(i)) for i in range(8)]).T
    return np.array(to_world.inverse() @ mi.Point3f(corners)).reshape(3, -1)


def _meet_opaque(scene: mi.Scene, ray: mi.Ray3f, target: mi.Point3f | None) -> mi.SurfaceInteraction3f:
    si = scene.ray_intersect(ray)
    for _ in range(_MOST_PASSED):
        clear = mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.DeltaTransmission)
        passing = si.is_valid() & (clear | (dr.max(si.bsdf().eval_null_transmission(si)) > 0))
        if not _is_any(passing):
            break
        onward = si.spawn_ray(ray.d) if target is None else si.spawn_ray_to(target)
        si = dr.select(passing, scene.ray_intersect(onward, passing), si)
    return si


def _where_scene_lies(loaded: LoadedScene, to_world: mi.Transform4f, within: bool) -> str:
    distance, box = loaded.camera.geometry.scene_distance, loaded.scene.bbox()
    if not box.valid():
        return "the scene has no surfaces; add a shape"
    corners = _corners(box, to_world)
    low, high = corners.min(axis=1), corners.max(axis=1)
    place = ", ".join(f"{axis} = {a:.4g} to {b:.4g}" for axis, a, b in zip("xyz", low, high, strict=True))
    where = f"no ray of the projector's window meets the scene, which lies at {place} mm of the camera"
    if np.abs([low, high]).max() < _SMALL * distance:
        return f"{where}: this looks like metres, and 1 unit is 1 mm; scale it by 1000"
    if low[2] > _FAR * distance:
        return f"{where}: too far, for the bench is aligned to {distance:g} mm; move it nearer or set scene_distance"
    if high[2] <= 0:
        return f"{where}: behind the camera, which looks along +z; move the scene or turn the camera"
    if within:
        problem = f"{where}: within the window, but {_RAYS} x {_RAYS} rays at each of its shapes miss them"
        return f"{problem}; give the projector a narrower fov, or a larger target"
    rows, columns = loaded.pixels.row_tan, loaded.pixels.column_tan
    x, y = (f"{-distance * edges[1]:.4g} to {-distance * edges[0]:.4g}" for edges in (columns, rows))
    window = f"x = {x}, y = {y}"
    return f"{where}: outside the window, {window} mm at {distance:g} mm; move the scene or turn the projector"


def _is_any(mask: mi.Bool) -> bool:
    return bool(np.array(mask).any())
