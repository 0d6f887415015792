"""Explanation of a dark scene: the reason why light of the projector does not reach the camera.

A few hundred rays go from the projector through its window, or through the part of it that contains the scene, and
from the points that they hit to the sensor's centre. Holes, filters and glass let them pass.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.scene.load import LoadedScene

_RAYS = 24
"""Rays per side: they hit anything larger than a 24th of the window."""
_FAR = 3.0
"""Multiple of the aligned plane's distance beyond which a scene counts as too far."""
_SMALL = 1e-2
"""Part of the aligned plane's distance below which a scene is assumed to be in metres."""
_MOST_SHAPES = 64
"""Shapes that are aimed at one by one; each takes milliseconds."""
_MOST_PASSED = 16
"""Surfaces that a ray passes: eight panes of two faces."""


def why_dark(loaded: LoadedScene) -> str:
    """Return what is wrong with a scene of which the sensor sees nothing, and the remedy."""
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
