"""Values of a loaded scene's bitmaps and meshes: what a file can hold that no light and no surface can.

OpenEXR holds NaN, infinity, negative numbers and reflectances above 1, and Mitsuba takes them without a word; so do
meshes. The renderer would spread one such texel over every frame.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.errors import MitsimError

_MESH = (".vertex_positions", ".vertex_normals", ".vertex_texcoords")
_LIGHT = ("irradiance", "radiance", "intensity")
_REFLECTANCES = ("reflectance", "transmittance", "albedo", "base_color")
_ROUNDING = 1e-5
"""A reflectance of 1 after conversion of colours."""


def check_texels(path: Path, scene: Any) -> None:
    """Refuse a scene with a bitmap of impossible light or reflectance, or a bitmap or mesh that is not finite.

    Raises
    ------
    MitsimError
        one line with the bitmap's file name, the texel and its value.
    """
    parameters = mi.traverse(scene)
    for key in parameters.keys():  # noqa: SIM118 - SceneParameters is no dict
        if key.endswith(".data"):
            _check_bitmap(path, key, np.array(parameters[key]), parameters.properties[key][2])
        elif key.endswith(_MESH):
            _check_mesh(path, key, np.array(parameters[key]))


def _check_bitmap(path: Path, key: str, texels: npt.NDArray[np.floating[Any]], owner: Any) -> None:
    if texels.ndim != 3 or texels.dtype.kind != "f":
        return  # Mitsuba may keep bitmaps of 8 bits as they are: those hold nothing impossible
    what = key.split(".")[-2]
    wrong, rule = ~np.isfinite(texels), "give finite numbers"
    if not wrong.any() and what.endswith((*_LIGHT, *_REFLECTANCES)):
        wrong, rule = texels < 0, "light and reflectance are at least 0"
    if not wrong.any() and what.endswith(_REFLECTANCES):
        wrong, rule = texels > 1 + _ROUNDING, "nothing reflects more than 1"
    if wrong.any():
        row, column, channel = np.argwhere(wrong)[0]
        named = re.search(r'name = "([^"]*)"', str(owner))
        raise MitsimError(
            f"{path}: bitmap {named[1] if named else key}: {what} of the texel in row {row}, column {column} is "
            f"{texels[row, column, channel]:g} ({int(wrong.any(axis=2).sum())} such texels); {rule}"
        )


def _check_mesh(path: Path, key: str, values: npt.NDArray[np.floating[Any]]) -> None:
    wrong = np.flatnonzero(~np.isfinite(values))
    if wrong.size:
        name, _, field = key.rpartition(".")
        raise MitsimError(
            f"{path}: mesh {name}: number {wrong[0]} of its {field} is {values[wrong[0]]:g}; give finite numbers"
        )
