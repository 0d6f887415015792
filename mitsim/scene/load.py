"""From a scene file to a loaded Mitsuba scene with its camera geometry and its projector grid, or one clear refusal."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mitsim.core.errors import MitsimError
from mitsim.scene.guard.check import check_file
from mitsim.scene.projector import ProjectorGrid, locate_projector
from mitsim.scene.texels import check_texels

SENSOR_PLUGIN = "mitsim_lensless"


@dataclass(frozen=True)
class LoadedScene:
    """A scene ready for transport.

    ``camera`` is the Mitsuba sensor (it carries ``geometry``), ``projector`` the emitter and ``grid`` the projector's
    pixels; both are None only when the file was opened for ``render``, which needs no projector. ``lamps`` are all
    other emitters; ``mirrors`` tells whether a surface reflects or transmits light in single directions, ``glossy``
    whether one does in lobes. ``files`` lists all that Mitsuba read, the scene first.
    """

    path: Path
    files: tuple[Path, ...]
    scene: Any
    camera: Any
    projector: Any
    grid: ProjectorGrid | None
    lamps: tuple[Any, ...]
    mirrors: bool
    glossy: bool

    @property
    def pixels(self) -> ProjectorGrid:
        """The projector's grid; for scenes opened with ``needs_projector`` it is always there."""
        if self.grid is None:
            raise MitsimError(f"{self.path}: the scene was opened without its projector")
        return self.grid


def load_scene(
    path: Path, defines: Mapping[str, str] | None = None, needs_projector: bool = True, outside: bool = False
) -> LoadedScene:
    """Load a scene XML into the current variant; the plugin ``mitsim_lensless`` must be registered.

    Files outside the scene's folder are read only when ``outside`` is set.

    Raises
    ------
    MitsimError
        one line that names the file for anything wrong with it.
    """
    defines = dict(defines or {})
    files = check_file(path, defines, outside)
    try:
        # Without optimize, for that merges rectangles of one material into a mesh that has lost their boxes and names.
        scene = mi.load_file(str(path), parallel=False, optimize=False, **defines)
    except MitsimError:
        raise
    except (RuntimeError, ValueError, TypeError, KeyError) as error:
        line = re.search(r"\(line (\d+), col", str(error))
        place = f"{path}:{line[1]}" if line and str(path) in str(error) else path
        raise MitsimError(f"{place}: Mitsuba refuses the scene: {_one_line(error)}") from None
    check_texels(path, scene)
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
    if grid is None:
        return LoadedScene(path, files, scene, cameras[0], None, None, tuple(emitters), *_polished(scene))
    lamps = tuple(emitter for emitter in emitters if emitter.class_name() != "Projector")
    return LoadedScene(path, files, scene, cameras[0], projectors[0], grid, lamps, *_polished(scene))


def _polished(scene: Any) -> tuple[bool, bool]:
    """Whether a surface of the scene has a delta component, and whether one has a glossy component."""
    flags = [shape.bsdf().flags() for shape in scene.shapes() if shape.bsdf()]
    delta, glossy = mi.BSDFFlags.Delta, mi.BSDFFlags.Glossy
    return any(mi.has_flag(one, delta) for one in flags), any(mi.has_flag(one, glossy) for one in flags)


def _one_line(error: BaseException) -> str:
    """The last sentence of a Mitsuba message: its first lines repeat the place in Mitsuba's own source."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", str(error))
    lines = [re.sub(r"\s+", " ", line).strip(" -*│╰╭─") for line in text.splitlines()]
    lines = [re.sub(r"^\d{4}-\d\d-\d\d [\d:]+ \w+ +\w* *\[[^\]]*\] *", "", line) for line in lines if line]
    if "Traceback" in text:  # raised by our own plugin: the last line says what, the rest is Python's stack
        lines = [re.sub(r" Traceback .*", "", lines[0]), re.sub(r"^[\w.]*Error: ", "", lines[-1])]
    return " ".join(lines)[:400] if lines else type(error).__name__
