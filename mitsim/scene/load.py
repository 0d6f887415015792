"""From a scene file to a loaded Mitsuba scene with its camera geometry and its projector grid, or one clear refusal."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mitsuba as mi
from defusedxml import ElementTree as SafeTree
from defusedxml.common import DefusedXmlException

from mitsim.core.errors import MitsimError
from mitsim.scene.projector import ProjectorGrid, locate_projector

SENSOR_PLUGIN = "mitsim_lensless"
_DEEPEST = 16
_RESERVED = ("path", "parallel", "update_scene", "variant")


@dataclass(frozen=True)
class LoadedScene:
    """A scene ready for transport.

    ``camera`` is the Mitsuba sensor (it carries ``geometry``), ``projector`` the emitter and ``grid`` the projector's
    pixels; both are None only when the file was opened for ``render``, which needs no projector.
    """

    path: Path
    scene: Any
    camera: Any
    projector: Any
    grid: ProjectorGrid | None
    other_emitters: int

    @property
    def pixels(self) -> ProjectorGrid:
        """The projector's grid; for scenes opened with ``needs_projector`` it is always there."""
        if self.grid is None:
            raise MitsimError(f"{self.path}: the scene was opened without its projector")
        return self.grid


def check_file(path: Path, defines: Mapping[str, str]) -> None:
    """Refuse a file that is missing, is no well-formed scene XML, or lacks a parameter named by ``-D``."""
    if not path.is_file():
        raise MitsimError(f"{path}: no such scene file; give the path of a Mitsuba scene XML")
    try:
        _check_depth(path)
        root = SafeTree.parse(path, forbid_dtd=True).getroot()
    except ElementTree.ParseError as error:
        line, column = error.position
        raise MitsimError(
            f"{path}:{line}: not well-formed XML (column {column}: {str(error).split(':')[0]}); mend the file"
        ) from None
    except DefusedXmlException as error:
        raise MitsimError(f"{path}: DTDs and entities are not allowed in a scene ({error}); remove them") from None
    except (OSError, UnicodeDecodeError) as error:
        raise MitsimError(f"{path}: cannot be read ({error}); check the file") from None
    if root.tag != "scene":
        raise MitsimError(f"{path}:1: the root element is <{root.tag}>; a Mitsuba scene starts with <scene>")
    known = {element.get("name", "") for element in root.iter("default")}
    for name in defines:
        if name not in known or name in _RESERVED:
            raise MitsimError(
                f"-D {name}={defines[name]}: {path} has no <default name={name!r}>; "
                f"it knows {', '.join(sorted(known)) or 'none'}"
            )


def _check_depth(path: Path) -> None:
    """Refuse deep nesting before anything recursive sees it: it overflows Mitsuba's stack, or takes for ever."""
    depth = 0
    for event, element in SafeTree.iterparse(path, events=("start", "end"), forbid_dtd=True):
        depth += 1 if event == "start" else -1
        if depth > _DEEPEST:
            raise MitsimError(f"{path}: elements are nested over {_DEEPEST} deep (<{element.tag}>); flatten the scene")


def load_scene(path: Path, defines: Mapping[str, str] | None = None, needs_projector: bool = True) -> LoadedScene:
    """Load a scene XML into the current variant; the plugin ``mitsim_lensless`` must be registered.

    Raises
    ------
    MitsimError
        one line that names the file for anything wrong with it.
    """
    defines = dict(defines or {})
    check_file(path, defines)
    try:
        scene = mi.load_file(str(path), parallel=False, **defines)
    except MitsimError:
        raise
    except (RuntimeError, ValueError, TypeError, KeyError) as error:
        raise MitsimError(f"{path}: Mitsuba refuses the scene: {_one_line(error)}") from None
    cameras = [sensor for sensor in scene.sensors() if hasattr(sensor, "geometry")]
    if len(cameras) != 1:
        raise MitsimError(f'{path}: {len(cameras)} sensors of type "{SENSOR_PLUGIN}"; a scene needs exactly one')
    emitters = list(scene.emitters())
    projectors = [emitter for emitter in emitters if emitter.class_name() == "Projector"]
    if not needs_projector:
        return LoadedScene(path, scene, cameras[0], None, None, len(emitters))
    if len(projectors) != 1:
        raise MitsimError(
            f'{path}: {len(projectors)} emitters of type "projector"; coded illumination needs exactly one'
        )
    grid = locate_projector(str(path), projectors[0], cameras[0])
    return LoadedScene(path, scene, cameras[0], projectors[0], grid, len(emitters) - 1)


def _one_line(error: BaseException) -> str:
    """The last sentence of a Mitsuba message: its first lines repeat the place in Mitsuba's own source."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", str(error))
    lines = [re.sub(r"\s+", " ", line).strip(" -*│╰╭─") for line in text.splitlines()]
    lines = [re.sub(r"^\d{4}-\d\d-\d\d [\d:]+ \w+ +\w* *\[[^\]]*\] *", "", line) for line in lines if line]
    if "Traceback" in text:  # raised by our own plugin: the last line says what, the rest is Python's stack
        lines = [re.sub(r" Traceback .*", "", lines[0]), re.sub(r"^[\w.]*Error: ", "", lines[-1])]
    return " ".join(lines)[:400] if lines else type(error).__name__
