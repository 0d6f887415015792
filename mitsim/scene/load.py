"""From a scene file to a loaded Mitsuba scene with its camera geometry and its projector grid, or one clear refusal."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import keep_scenes, one_thread
from mitsim.core.errors import MitsimError
from mitsim.scene.check import check_file, looking_beside
from mitsim.scene.limits import Range, Unfit
from mitsim.scene.outline import Tag
from mitsim.scene.tree import check_meshes, emit_by_faces, move_to_camera, with_thin_shapes_as_meshes

SENSOR_PLUGIN = "mitsim_lensless"
_SMALL_LAMPS = ("DirectionalEmitter", "PointLight", "SpotLight")
"""Mitsuba's classes of the lamps that no path runs into."""


@dataclass(frozen=True)
class LoadedScene:
    """A scene ready for transport.

    ``camera`` is the Mitsuba sensor (it carries ``geometry``), ``projector`` the emitter and ``grid`` the projector's
    pixels; both are None only when the file was opened for ``render``, which needs no projector. ``lamps`` are all
    other emitters; ``mirrors`` tells whether a surface reflects or bends light into single directions, ``glossy``
    whether one sends it into lobes. ``files`` lists all that Mitsuba read, the scene first; ``unfit`` says which
    estimators must refuse it; ``shapes`` are the tags of ``scene.shapes()``, in that order, or none where one tag gave
    several; ``small_lamps`` are lamps that no path runs into, with their tags; ``coloured`` are tags of what may
    differ by wavelength, none of a scene in greys, ``parting`` of glass that sends each wavelength its own way;
    ``samples`` is the ``sample_count`` of the camera's sampler, None where it has none; ``notes`` say what was changed
    of the scene to render it rightly.
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

    @property
    def pixels(self) -> ProjectorGrid:
        """The projector's grid; for scenes opened with ``needs_projector`` it is always there."""
        if self.grid is None:
            raise MitsimError(f"{self.path}: the scene was opened without its projector")
        return self.grid


@keep_scenes()
def load_scene(
    path: Path, defines: Mapping[str, str] | None = None, needs_projector: bool = True, outside: bool = False
) -> LoadedScene:
    """Load a scene XML into the current variant; the plugin ``mitsim_lensless`` must be registered.

    Parameters
    ----------
    path
        the scene's XML.
    defines
        values of its parameters by name.
    needs_projector
        refuse a scene without exactly one projector, or one that the factored estimator cannot render.
    outside
        allow files outside the scene's folder.

    Raises
    ------
    MitsimError
        one line that names the file for anything wrong with it.
    """
    checked = check_file(path, defines or {}, outside, mi.variant())
    if needs_projector and checked.unfit.factored is not None:
        raise checked.unfit.factored
    checked.config.variant = mi.variant()
    moved = move_to_camera(checked.outline, checked.state)
    with looking_beside(checked.outline):
        notes = emit_by_faces(checked)  # before thin shapes are meshes, too
        with with_thin_shapes_as_meshes(checked.outline, checked.state):
            scene = mi.parser.instantiate(checked.config, checked.state)
    check_texels(path, scene, checked.limits)
    check_meshes(moved, scene)
    _add_up_normals(scene, checked.without_normals)
    cameras = [sensor for sensor in scene.sensors() if hasattr(sensor, "geometry")]
    if len(cameras) != 1:
        raise MitsimError(f'{path}: {len(cameras)} sensors of type "{SENSOR_PLUGIN}"; a scene needs exactly one')
    emitters = list(scene.emitters())
    projectors = [emitter for emitter in emitters if emitter.class_name() == "Projector"]
    for projector in projectors:
        scale = float(np.array(mi.traverse(projector)["scale"]).ravel()[0])
        if scale < 0:
            raise MitsimError(f"{path}: the projector's scale: got {scale:g}; light is at least 0")
    if needs_projector and len(projectors) != 1:
        raise MitsimError(
            f'{path}: {len(projectors)} emitters of type "projector"; coded illumination needs exactly one'
        )
    grid = None
    if len(projectors) == 1:
        try:
            grid = locate_projector(str(path), projectors[0], cameras[0])
        except MitsimError:
            if needs_projector:
                raise
    small = [emitter for emitter in emitters if emitter.class_name() in _SMALL_LAMPS]
    return LoadedScene(
        path,
        checked.files,
        scene,
        cameras[0],
        projectors[0] if grid else None,
        grid,
        tuple(emitter for emitter in emitters if grid is None or emitter.class_name() != "Projector"),
        *_mirrors_and_gloss(scene, checked.unfit),
        checked.unfit,
        checked.shapes if len(checked.shapes) == len(scene.shapes()) else (),
        tuple(zip(small, checked.small_lamps, strict=True)),
        checked.coloured,
        checked.parting,
        checked.samples,
        notes,
    )


def _mirrors_and_gloss(scene: mi.Scene, unfit: Unfit) -> tuple[bool, bool]:
    """Whether a surface of the scene is a mirror or bends light, and whether one has a glossy component.

    An instance hides its materials: what is glossy there is looked for by rays, so it may be.
    """
    flags = [shape.bsdf().flags() for shape in scene.shapes() if shape.bsdf()]
    mirror = int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.DeltaTransmission)
    mirrors = any(own & mirror for own in flags) or unfit.instances is not None
    hidden = any(shape.class_name() == "Instance" for shape in scene.shapes())
    return mirrors, hidden or any(mi.has_flag(own, mi.BSDFFlags.Glossy) for own in flags)


# -------- Values of a loaded scene's bitmaps and meshes
# OpenEXR holds NaN, infinity, negative numbers and reflectances above 1, and Mitsuba takes them without a word; so do
# meshes, whose vertices have colours too. The renderer would spread one such texel over every frame.

_ANY = Range(-np.inf, np.inf)
_ROUNDING = 1e-5
"""A reflectance of 1 after conversion of colours by single precision."""


def _add_up_normals(scene: mi.Scene, without_normals: frozenset[str]) -> None:
    """Give meshes of files ``without_normals`` those of one thread, the same at every loading.

    A vertex has the sum over its faces, in 32 bits. Mitsuba adds it up in the order in which threads come to the faces.
    Of shapes that are merged, some with normals of their own, all stay as they are.
    """
    parameters, meshes = mi.traverse(scene), []
    for key in parameters.keys():  # noqa: SIM118 - SceneParameters is no dict
        if key.rpartition(".")[2] == "vertex_normals":
            mesh = parameters.properties[key][2]
            files = re.search(r'name = "([^"]*)"', str(mesh))
            if files and mesh.has_vertex_normals() and without_normals.issuperset(files[1].split(" + ")):
                meshes.append(mesh)
    if meshes:
        with one_thread():
            for mesh in meshes:
                mesh.recompute_vertex_normals()


def check_texels(path: Path, scene: mi.Scene, limits: Mapping[str, Range]) -> None:
    """Refuse a scene with a bitmap or mesh of impossible light or reflectance, or of numbers that are not finite.

    Parameters
    ----------
    path
        the scene's XML, for the message.
    scene
        what Mitsuba loaded from it.
    limits
        what the texels of a bitmap and the numbers of a mesh may be, by the name of what they are used for.

    Raises
    ------
    MitsimError
        one line with the bitmap's file name or the mesh, the texel or number and its value.
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
            file = re.search(r'name = "([^"]*)"', held) if last == "data" else None
            # Mitsuba calls a texture by its parameter, and one that is referenced by a number.
            limit = limits.get(file[1] if file else last) or limits.get(name.rpartition(".")[2], _ANY)
            wrong = ~np.isfinite(values) | (values < limit.low) | (values > limit.high + _ROUNDING)
            if wrong.any():
                place = _place_of_wrong(key, values, wrong, file[1] if file else key)
                words = f" of {limit.low:g} to {limit.high:g}{limit.hint}" if limit is not _ANY else ""
                raise MitsimError(f"{path}: {place}; allowed are finite numbers{words}")


def _place_of_wrong(key: str, values: npt.NDArray[np.float32], wrong: npt.NDArray[np.bool_], file: str) -> str:
    """What holds the first wrong number, and where."""
    at = np.argwhere(wrong)[0]
    name, _, last = key.rpartition(".")
    if values.ndim != 3:
        return f"mesh {name}: number {at[0]} of its {last} is {values[tuple(at)]:g}"
    texel = f"{name.rpartition('.')[2]} of the texel in row {at[0]}, column {at[1]}"
    count = int(wrong.any(axis=2).sum())
    return f"bitmap {file}: {texel} is {values[tuple(at)]:g} ({count} such texels)"


# -------- Darkness: what keeps the projector's light from the camera
#
# Why a scene is dark: a loaded scene in, the sentence out that says what keeps the projector's light from the camera.
#
# A few hundred rays go from the projector through its window, or, where they miss all, through the part of it that the
# scene lies in, and from what they meet to the sensor's centre; holes, filters and glass let them pass.

_RAYS = 24
"""Rays a side: they meet anything larger than a 24th of the window."""
_FAR = 3.0
"""Beyond so many times the aligned plane's distance, a scene is called too far: the window is three times as wide."""
_SMALL = 1e-2
"""Part of the aligned plane's distance below which a whole scene is taken for one in metres; theirs is 1e-3."""
_MOST_SHAPES = 64
"""Shapes that are aimed at one by one, where no ray at all of them together meets one: each takes milliseconds."""
_MOST_PASSED = 16
"""Surfaces that a ray passes: eight panes of two faces."""


def why_dark(loaded: LoadedScene) -> str:
    """What is wrong with a scene of which the sensor sees nothing, and what to do.

    Parameters
    ----------
    loaded
        a scene with its projector.
    """
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
        return (
            f"{met.sum()} of {met.size} rays of the projector meet a surface, and it turns its back to the {which}: a "
            "mesh wound the wrong way; flip its normals or put its material in <bsdf type='twosided'>"
        )
    seen = np.array(to_world.inverse() @ si.p).reshape(3, -1)[:, np.array(facing).ravel()]
    slope = np.abs(seen[:2] / seen[2]).max(axis=0)
    if seen[2].max() <= geometry.mask_distance:
        return f"what is lit lies at z = {seen[2].max():.4g} mm, not in front of the mask; move the scene along +z"
    if slope.min() > geometry.tan_half_fov:
        return (
            f"what is lit lies outside the field stop: {np.degrees(np.arctan(slope.min())):.3g} degrees off the axis "
            f"or more, and the stop (fov) lets {geometry.fov / 2:g} degrees pass; turn the camera or widen fov"
        )
    if not _is_any(facing & ~_meet_opaque(loaded.scene, si.spawn_ray_to(centre), centre).is_valid()):
        return "something hides from the camera what is lit; move it out of the way"
    if part is not window:
        extents = [(own[1] - own[0]) / (whole[1] - whole[0]) for own, whole in zip(part, window, strict=True)]
        return (
            f"what is lit spans {min(extents):.1e} of the window only, {min(extents) * grid.n:.1e} projector pixels: "
            "too few rays meet it; give the projector a narrower fov, or a larger target"
        )
    return "what is lit lies edge-on, is hidden or reflects nothing; turn it, move it or check its material"


_Edges = tuple[tuple[float, float], tuple[float, float]]
"""First and last tan-angle of rows and of columns on the aligned plane."""


def _part_with(box: mi.BoundingBox3f, loaded: LoadedScene, start: mi.Point3f) -> _Edges | None:
    """The part of the window through which rays from ``start``, in the camera's frame, may meet a ``box``; None where
    there is none."""
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
    return part[0], part[1]


def _corners(box: mi.BoundingBox3f, to_world: mi.Transform4f) -> FloatArray:
    """(3, 8) corners of a ``box`` in the camera's frame."""
    corners = np.array([list(box.corner(i)) for i in range(8)]).T
    return np.array(to_world.inverse() @ mi.Point3f(corners)).reshape(3, -1)


def _meet_opaque(scene: mi.Scene, ray: mi.Ray3f, target: mi.Point3f | None) -> mi.SurfaceInteraction3f:
    """What rays meet that lets no light pass, before their ``target`` if there is one; panes are taken for thin."""
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
    """Where the scene lies, when no ray of the projector meets it; ``within`` tells whether the box of a shape lies in
    the window."""
    distance, box = loaded.camera.geometry.scene_distance, loaded.scene.bbox()
    if not box.valid():
        return "the scene has no surfaces; add a shape"
    low, high = _extent(_corners(box, to_world))
    place = ", ".join(f"{axis} = {a:.4g} to {b:.4g}" for axis, a, b in zip("xyz", low, high, strict=True))
    where = f"no ray of the projector's window meets the scene, which lies at {place} mm of the camera"
    if np.abs([low, high]).max() < _SMALL * distance:
        return f"{where}: this looks like metres, and 1 unit is 1 mm; scale it by 1000"
    if low[2] > _FAR * distance:
        return f"{where}: too far, for the bench is aligned to {distance:g} mm; move it nearer or set scene_distance"
    if high[2] <= 0:
        return f"{where}: behind the camera, which looks along +z; move the scene or turn the camera"
    if within:
        return (
            f"{where}: within the window, but {_RAYS} x {_RAYS} rays at each of its shapes miss them; give the "
            "projector a narrower fov, or a larger target"
        )
    rows, columns = loaded.pixels.row_tan, loaded.pixels.column_tan
    window = ", ".join(
        f"{axis} = {-distance * edges[1]:.4g} to {-distance * edges[0]:.4g}"
        for axis, edges in (("x", columns), ("y", rows))
    )
    return f"{where}: outside the window, {window} mm at {distance:g} mm; move the scene or turn the projector"


def _extent(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    return points.min(axis=1), points.max(axis=1)


def _is_any(mask: mi.Bool) -> bool:
    return bool(np.array(mask).any())


# -------- The projector's pixel grid
#
# The projector's pixel grid: from a stock ``projector`` emitter to n x n pixels and the directions they light.
#
# The emitter's texture in the scene file is its all-white frame: the rectangle of lit texels is the *window* that the
# patterns use, n x n pixels, and the dark texels around it are canvas. A window off the canvas's centre is a lens
# shift, as real projectors have it, and casts no keystone. Rows and columns follow the project's convention (row 0 at
# +y, column 0 at +x for one looking along +z), which is also how Mitsuba lays texels out for an unrotated projector.

_NO_KEYSTONE = 1e-3
"""Projector pixels: chosen so that what rounding makes of a shifted lens is none; it shows in no frame."""


_MOST_ACROSS = 16384
"""Projector pixels across the camera's field: light is collected in cells of their size, and the shadow of so many
takes 67 MB for a sensor of 512 pixels and one layer. The paper's geometry has 150; a fov of 1e-6 degrees took 24 GB."""


@dataclass(frozen=True)
class Window:
    """Window of n x n projector pixels in a canvas.

    Attributes
    ----------
    n
        pixels a side of the window.
    first_row, first_column
        canvas texel of the window's pixel (0, 0); between texels where a picture has drifted.
    canvas
        (rows, columns) of the whole texture.
    """

    n: int
    first_row: float
    first_column: float
    canvas: tuple[int, int]


@dataclass(frozen=True)
class ProjectorGrid(Window):
    """A projector's window, and where it lands on the camera's aligned plane.

    Attributes
    ----------
    row_tan, column_tan
        (first edge, last edge) of the window as tan-angles y/z and x/z from the camera, index coordinates, on the plane
        at the camera's scene distance (bounding box when the projector casts a keystone).
    keystone
        largest departure of the window's corners from that box, in projector pixels; 0 for a shifted lens.
    """

    row_tan: tuple[float, float]
    column_tan: tuple[float, float]
    keystone: float


def locate_projector(where: str, projector: mi.Emitter, camera: mi.Sensor) -> ProjectorGrid:
    """Find the lit window of a projector and its place in front of a camera.

    Parameters
    ----------
    where
        what an error begins with, the scene's path.
    projector
        a stock emitter whose bitmap shows the window.
    camera
        the sensor, which carries its geometry.

    Raises
    ------
    MitsimError
        when the texture is no bitmap with a lit square window, or it does not light the camera's aligned plane.
    """
    parameters = mi.traverse(projector)
    if "irradiance.data" not in parameters:
        raise MitsimError(
            f"{where}: the projector's irradiance is not a bitmap; "
            "give a raw bitmap texture whose white texels are the projector's pixels"
        )
    texels = np.array(parameters["irradiance.data"])
    lit = texels.reshape(texels.shape[0], texels.shape[1], -1).max(axis=-1) > 0
    rows, columns = np.flatnonzero(lit.any(axis=1)), np.flatnonzero(lit.any(axis=0))
    if not rows.size:
        raise MitsimError(f"{where}: the projector's bitmap is all black; its white texels are the projector's pixels")
    height, width = int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1
    if height != width or not lit[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].all():
        raise MitsimError(
            f"{where}: the lit texels of the projector's bitmap span {height}x{width} and must fill a square; "
            "paint the window white"
        )
    z = camera.geometry.scene_distance
    window = Window(width, int(rows[0]), int(columns[0]), (int(lit.shape[0]), int(lit.shape[1])))
    corners = _window_corners(where, projector, camera, window, z)
    low, high = corners.min(axis=0), corners.max(axis=0)
    span = float((high - low).min())
    across = 2 * camera.geometry.tan_half_fov * width / span if span > 0 else np.inf
    if across > _MOST_ACROSS:
        raise MitsimError(
            f"{where}: the camera's field is {across:.3g} pixels of the projector wide; at most {_MOST_ACROSS} are "
            "simulated, so widen the projector's fov, or narrow the camera's"
        )
    ideal = np.array([[low[0], low[1]], [low[0], high[1]], [high[0], low[1]], [high[0], high[1]]])
    keystone = float(np.abs((corners - ideal) / (high - low)).max()) * width
    return ProjectorGrid(
        **vars(window),
        row_tan=(float(low[0]), float(high[0])),
        column_tan=(float(low[1]), float(high[1])),
        keystone=keystone if keystone > _NO_KEYSTONE else 0.0,
    )


def window_at(
    where: str, projector: mi.Emitter, camera: mi.Sensor, grid: ProjectorGrid, depth: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Row and column tan-angles (first edge, last edge) of the window on a plane in front of the camera.

    Parameters
    ----------
    where, projector, camera
        as in :func:`locate_projector`, whose result is ``grid``.
    grid
        the window on the projector's canvas.
    depth
        distance of the plane [mm].

    Raises
    ------
    MitsimError
        when the projector does not light the plane.
    """
    corners = _window_corners(where, projector, camera, grid, depth)
    (top, left), (bottom, right) = corners.min(axis=0), corners.max(axis=0)
    return (float(top), float(bottom)), (float(left), float(right))


def straightening(
    where: str, projector: mi.Emitter, camera: mi.Sensor, grid: ProjectorGrid, depth: float
) -> FloatArray:
    """(3, 3) homography that takes tan-angles (row, column, 1) on the plane at ``depth`` to where the same projector
    pixel would lie if the window filled its bounding box evenly: what takes a keystone out.

    Parameters
    ----------
    where, projector, camera, grid, depth
        as in :func:`window_at`.

    Raises
    ------
    MitsimError
        when the projector does not light the plane.
    """
    corners = _window_corners(where, projector, camera, grid, depth)
    low, high = corners.min(axis=0), corners.max(axis=0)
    return _homography(corners, np.where([[0, 0], [0, 1], [1, 0], [1, 1]], high, low))


def _window_corners(where: str, projector: mi.Emitter, camera: mi.Sensor, window: Window, z: float) -> FloatArray:
    """(4, 2) tan-angles (row, column) of the window's corners on the plane at ``z``, in index coordinates.

    Between that plane and the projector's image lies a homography; four probes of the emitter determine it.
    """
    half = 0.25 * z  # any four points do
    probes = np.array([[half, half], [half, -half], [-half, half], [-half, -half]])
    interaction = dr.zeros(mi.SurfaceInteraction3f, len(probes))
    interaction.p = camera.world_transform() @ mi.Point3f(probes[:, 0], probes[:, 1], z)
    sample, _ = projector.sample_direction(interaction, mi.Point2f(0.5))
    uv = np.array(sample.uv, dtype=np.float64).T
    uv = uv.T if uv.shape[0] == 2 and uv.shape[1] == len(probes) else uv
    homography = _homography(uv, probes) if np.isfinite(uv).all() else np.full((3, 3), np.nan)
    rows = (window.first_row + window.n * np.array([0, 0, 1, 1])) / window.canvas[0]
    columns = (window.first_column + window.n * np.array([0, 1, 0, 1])) / window.canvas[1]
    mapped = np.stack([columns, rows, np.ones(4)], axis=1) @ homography.T
    points = mapped[:, :2] / mapped[:, 2:]
    if not np.isfinite(points).all():
        raise MitsimError(
            f"{where}: the projector does not light the plane at {z:g} mm from the camera; aim it at the scene"
        )
    return np.stack([-points[:, 1] / z, -points[:, 0] / z], axis=1)


def _homography(source: FloatArray, target: FloatArray) -> FloatArray:
    """3 x 3 matrix that maps four points (x, y) of ``source`` to ``target`` (direct linear transform)."""
    rows = []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows.append([x, y, 1, 0, 0, 0, -u * x, -u * y, -u])
        rows.append([0, 0, 0, x, y, 1, -v * x, -v * y, -v])
    return np.asarray(np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3))
