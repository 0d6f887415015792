"""Values of a loaded scene's bitmaps and meshes: what a file can hold that no light and no surface can.

OpenEXR holds NaN, infinity, negative numbers and reflectances above 1, and Mitsuba takes them without a word; so do
meshes, whose vertices have colours too. The renderer would spread one such texel over every frame.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.errors import MitsimError
from mitsim.scene.guard.limits import Range

_ANY = Range(-np.inf, np.inf)
_ROUNDING = 1e-5
"""A reflectance of 1 after conversion of colours by single precision."""


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
                place = _place(key, values, wrong, file[1] if file else key)
                words = f" of {limit.low:g} to {limit.high:g}{limit.hint}" if limit is not _ANY else ""
                raise MitsimError(f"{path}: {place}; allowed are finite numbers{words}")


def _place(key: str, values: npt.NDArray[np.float32], wrong: npt.NDArray[np.bool_], file: str) -> str:
    """What holds the first wrong number, and where."""
    at = np.argwhere(wrong)[0]
    name, _, last = key.rpartition(".")
    if values.ndim != 3:
        return f"mesh {name}: number {at[0]} of its {last} is {values[tuple(at)]:g}"
    texel = f"{name.rpartition('.')[2]} of the texel in row {at[0]}, column {at[1]}"
    count = int(wrong.any(axis=2).sum())
    return f"bitmap {file}: {texel} is {values[tuple(at)]:g} ({count} such texels)"
