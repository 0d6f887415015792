"""Loading a scene file: a Mitsuba scene with its camera geometry and projector grid, or a refusal in one line."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.environment import keep_scenes
from mitsim.core.errors import MitsimError
from mitsim.scene import tree
from mitsim.scene.check import check_file, looking_beside
from mitsim.scene.limits import Range, Unfit
from mitsim.scene.outline import Tag
from mitsim.scene.own_files import with_own_files
from mitsim.scene.window import ProjectorGrid, locate_projector

if TYPE_CHECKING:
    from mitsim.devices.sensor import SensorModel

SENSOR_PLUGIN = "mitsim_lensless"
_SMALL_LAMPS = ("DirectionalEmitter", "PointLight", "SpotLight")
"""Mitsuba's classes of lamps that no path can hit."""
_FLAT, _TURNED = ("Rectangle", "Disk"), 1e-6
"""Mitsuba's flat shapes, and the difference between normals that counts as parallel: single precision makes 1e-7."""


@dataclass(frozen=True)
class LoadedScene:
    """A scene ready for transport.

    Attributes
    ----------
    files
        All files that Mitsuba read, the scene first.
    camera, projector, grid
        Mitsuba sensor (with ``geometry``), emitter and projector pixels; the last two are None only for ``render``.
    lamps
        All other emitters.
    mirrors, glossy
        True if a surface reflects or refracts into single directions, or into lobes.
    unfit
        Estimators that must refuse the scene, with reasons.
    shapes
        Tags of ``scene.shapes()`` in that order; empty if one tag gave several shapes.
    small_lamps
        Lamps that no path can hit, with their tags.
    coloured, parting
        Tags of objects that may depend on wavelength, and of dispersive glass.
    samples
        ``sample_count`` of the camera's sampler, or None.
    notes
        Changes that were made to the scene to render it correctly.
    one_way
        True if no surface sees another, because all are flat, reflect on one side and face the same way.
    sensor_note
        Difference between the sensor of a camera file and the scene's; None if the scene's is used.
    own
        Parameters whose files the user named, by path.
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
        """Return the projector's grid; raise MitsimError with the reason if there is none."""
        return self.grid or locate_projector(str(self.path), _only_projector(self.path, self.scene), self.camera)

    @cached_property
    def hairy(self) -> bool:
        """Return True if a surface is hair, but for those in instances."""
        return any(shape.bsdf() and holds_hair(shape.bsdf().flags()) for shape in self.scene.shapes())

    @cached_property
    def smoothed(self) -> bool:
        """Return True if a surface has shading normals that differ from its own, or an instance may hide one."""
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

    Parameters
    ----------
    path
        Scene XML.
    defines
        Values of its parameters by name.
    needs_projector
        Refuse a scene without exactly one projector, or one that the factored estimator cannot render.
    outside
        Allow files outside the scene's folder.
    sensor
        Sensor whose pitch and format replace the scene's; None keeps them.

    Raises
    ------
    MitsimError
        One line that names the file, for any fault.
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
    # After normals were added up: once Mitsuba's own had a NaN, which loading the same files again did not.
    check_texels(path, scene, checked.limits)
    cameras = [sensor for sensor in scene.sensors() if hasattr(sensor, "geometry")]
    if len(cameras) != 1:
        raise MitsimError(f'{path}: {len(cameras)} sensors of type "{SENSOR_PLUGIN}"; a scene needs exactly one')
    emitters = list(scene.emitters())
    projectors = _projectors(scene)
    for projector in projectors:
        scale = float(np.array(mi.traverse(projector)["scale"]).ravel()[0])
        if scale < 0:
            raise MitsimError(f"{path}: the projector's scale: got {scale:g}; light is at least 0")
    if needs_projector:
        _only_projector(path, scene)
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
        _faces_one_way(scene),
        sensor_note,
        checked.own,
    )


def _projectors(scene: mi.Scene) -> list[mi.Emitter]:
    return [emitter for emitter in scene.emitters() if emitter.class_name() == "Projector"]


def _only_projector(path: Path, scene: mi.Scene) -> mi.Emitter:
    found = _projectors(scene)
    if len(found) != 1:
        raise MitsimError(f"{path}: needs one emitter of type projector, the file has {len(found) or 'none'}")
    return found[0]


def _mirrors_and_gloss(scene: mi.Scene, unfit: Unfit) -> tuple[bool, bool]:
    flags = [shape.bsdf().flags() for shape in scene.shapes() if shape.bsdf()]
    mirror = int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.DeltaTransmission)
    mirrors = any(own & mirror for own in flags) or unfit.instances is not None
    hidden = any(shape.class_name() == "Instance" for shape in scene.shapes())
    return mirrors, hidden or any(mi.has_flag(own, mi.BSDFFlags.Glossy) for own in flags)


def holds_hair(flags: Any) -> Any:
    """Return True if the ``flags`` of a material, a number or one per lane, are those of hair or of what holds it."""
    both = int(mi.BSDFFlags.NonSymmetric) | int(mi.BSDFFlags.Null)
    return (flags & both) == both


def _faces_one_way(scene: mi.Scene) -> bool:
    normals = list[npt.NDArray[np.generic]]()
    for shape in scene.shapes():
        bsdf = shape.bsdf()
        if shape.class_name() not in _FLAT or not bsdf or mi.has_flag(bsdf.flags(), mi.BSDFFlags.BackSide):
            return False
        normals.append(np.array(shape.sample_position(0.0, mi.Point2f(0.5)).n).ravel())
    return bool(normals) and float(np.ptp(normals, axis=0).max()) < _TURNED


_SMOOTH_BY_CLASS = ("Instance", "SDFGrid")
"""Mitsuba's classes of shapes whose shading normals are, or may be, interpolated, and which are no meshes."""
_PARALLEL = 0.9999
"""Cosine between the normals of a face and of its vertices above which the face is flat to rounding: half a degree."""


def _is_smoothed(shape: mi.Shape) -> bool:
    if not shape.is_mesh() or not shape.has_vertex_normals():
        return shape.class_name() in _SMOOTH_BY_CLASS
    # Rectangles and cubes are meshes that tell no parameters of one.
    held = shape.faces_buffer(), shape.vertex_positions_buffer(), shape.vertex_normals_buffer()
    faces, positions, normals = (np.array(each).reshape(-1, 3) for each in held)
    corners = positions[faces].astype(np.float64)
    own = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cosines = np.abs((normals[faces] * own[:, None]).sum(axis=2))
    return bool((cosines < _PARALLEL * np.linalg.norm(own, axis=1)[:, None]).any())


# -------- Values of a loaded scene's bitmaps and meshes
# OpenEXR holds NaN, infinity, negative numbers and reflectances above 1, and Mitsuba takes them without a word; so do
# meshes, whose vertices have colours too. The renderer would spread one such texel over every frame.

_ANY = Range(-np.inf, np.inf)
_ROUNDING = 1e-5
"""A reflectance of 1 after conversion of colours by single precision."""


_WHOLE = 2.0**40
"""Whole number for a normal of length 1: fine enough for 32 bits, and a vertex may have a million faces."""


def _add_up_normals(scene: mi.Scene, without_normals: frozenset[str]) -> None:
    """Compute vertex normals of meshes without normals such that every load gives the same bits.

    Mitsuba adds them up over faces in 32 bits, in the order of its threads. Merged shapes of which some have normals of
    their own stay as they are.
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

    The sums are whole numbers, whose order does not matter. A zero sum gives Mitsuba's normal for a vertex without
    faces.
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
    """Refuse bitmaps and meshes with impossible light or reflectance, or numbers that are not finite.

    Parameters
    ----------
    path
        Scene XML, for the message.
    scene
        The loaded scene.
    limits
        Allowed ranges by the name of the use.

    Raises
    ------
    MitsimError
        One line with the file or mesh, the texel and its value.
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
            # Mitsuba calls a texture by its parameter, and one that is referenced by a number.
            limit = limits.get(named if last == "data" else last) or limits.get(name.rpartition(".")[2], _ANY)
            wrong = ~np.isfinite(values) | (values < limit.low) | (values > limit.high + _ROUNDING)
            if wrong.any():
                at, value, count = np.argwhere(wrong)[0], values[wrong][0], wrong.any(axis=-1).sum()
                place = f"mesh {named}: number {at[0]} of its {last} is {value:g}"
                if values.ndim == 3:
                    place = (
                        f"bitmap {named}: the texel in row {at[0]}, column {at[1]} is {value:g} ({count} such texels)"
                    )
                words = f" of {limit.low:g} to {limit.high:g}{limit.hint}" if limit is not _ANY else ""
                raise MitsimError(f"{path}: {place}; allowed are finite numbers{words}")
