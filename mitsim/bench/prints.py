"""Pictures on the prints of a bench, and whether one tracing serves every picture.

Light of a flat diffuse sheet that stands alone is linear in the reflectance of each point, and comes directly from
there to the sensor. Light of a white sheet times the picture is then that of the picture. Light over several surfaces
contains products of reflectances, and is traced for each picture.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.bench.board import camera_place
from mitsim.core.environment import keep_scenes
from mitsim.core.errors import MitsimError
from mitsim.transport.plugins.base import host_values
from mitsim.transport.projector import PinholeRays

if TYPE_CHECKING:
    from mitsim.bench.apparatus import Apparatus

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
    for surface, names in _prints(bench):
        for name in names:
            values = np.ones(np.shape(surface[name]))
            surface[name] = _as_stored(surface[name], values) if name.endswith(_BITMAP) else 1.0
        surface.update()


@keep_scenes()
def show_picture(bench: Apparatus, reflectance: npt.NDArray[np.float64]) -> None:
    """Put a picture on all prints: each point takes the reflectance of the projector's pixel that lights it.

    Points beyond the window take the nearest pixel. ``reflectance`` is (n, n). Raises MitsimError for a scene without a
    print, or one whose bitmap has colours or is turned.
    """
    rays, n = PinholeRays(bench.projector_optics, [None]), bench.n
    for surface, names in _prints(bench):
        for name in names:
            if not name.endswith(_BITMAP):
                raise MitsimError(
                    f"{bench.loaded.path}: has no printed surface (a reflectance by bitmap) to put pictures on; give "
                    "one its texture"
                )
            shape, turned = np.shape(surface[name]), surface[name.replace(".data", ".to_uv")]
            if shape[2] != 1 or not np.array_equal(np.array(turned.matrix), np.eye(3)):
                raise MitsimError(
                    f"{bench.loaded.path}: a print has {shape[2]} channels, or a turned bitmap; give a raw grey one"
                )
            row, column = np.divmod(np.arange(shape[0] * shape[1]), shape[1])
            texel = mi.Point2f(*((np.stack([column, row]) + 0.5) / [[shape[1]], [shape[0]]]).astype(np.float32))
            places = surface.shape.eval_parameterization(texel).p
            world = np.stack([host_values(axis, len(row)) for axis in (places.x, places.y, places.z)], axis=1)
            at = np.nan_to_num(rays.points(world.astype(np.float64))[0])
            pixel = np.clip(np.floor(at), 0, n - 1).astype(np.int64)
            surface[name] = _as_stored(surface[name], reflectance[pixel[:, 0], pixel[:, 1]].reshape(shape))
        surface.update()


class _Surface:
    def __init__(self, shape: mi.Shape) -> None:
        self.shape, self._parameters = shape, mi.traverse(shape)

    def __getitem__(self, name: str) -> Any:
        return self._parameters[name]

    def __setitem__(self, name: str, value: Any) -> None:
        self._parameters[name] = value

    def names(self, ending: str | tuple[str, ...]) -> list[str]:
        return [name for name in self._parameters.keys() if name.endswith(ending)]  # noqa: SIM118 - it is no dict

    def update(self) -> None:
        self._parameters.update()


def _prints(bench: Apparatus) -> list[tuple[_Surface, list[str]]]:
    every = [_Surface(shape) for shape in bench.loaded.scene.shapes() if shape.bsdf()]
    found = [(surface, names) for surface in every if (names := surface.names(_BITMAP))]
    if not found and len(every) == 1:
        found = [(every[0], every[0].names(_PLAIN))]
    if not any(names for _, names in found):
        raise MitsimError(
            f"{bench.loaded.path}: none of its {len(every)} surfaces has a print (a reflectance by bitmap) to put "
            "pictures on; give one a bitmap"
        )
    return found


def _as_stored(before: Any, values: npt.NDArray[np.float64]) -> Any:
    whole = np.asarray(before).dtype == np.uint8
    stored = np.rint(_LARGEST_CODE * values).astype(np.uint8) if whole else values.astype(np.float32)
    return type(before)(stored)
