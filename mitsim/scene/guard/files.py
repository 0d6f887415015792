"""The files of a scene: where each one lies, that it is a plain file in the scene's folder, and a list of all."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Protocol

from mitsim.core.errors import MitsimError

_NATIVE = (".so", ".dylib", ".dll")
_MOST_BYTES = 512 << 20


class Asking(Protocol):
    """The place in a scene that names a file."""

    path: Path

    def refusal(self, what: str, value: object, rule: str) -> MitsimError:
        """One line with the place."""


class SceneFiles:
    """What one scene may read; ``used`` lists it in the order in which the scene names it.

    ``outside`` allows files that lie outside the scene's folder.
    """

    def __init__(self, scene: Path, outside: bool = False) -> None:
        self.folder = scene.parent
        self.outside = outside
        self.used: dict[Path, None] = {}

    def scene(self, path: Path) -> Path:
        """The scene itself; MitsimError when it is no plain file, or when native code lies where Mitsuba looks."""
        if not path.is_file():
            raise MitsimError(f"{path}: no such scene file; give the path of a Mitsuba scene XML")
        self.used[path] = None
        # Mitsuba looks for a plugin in the folder "plugins" beside the scene and in the working folder, its own last.
        for folder in (path.parent, Path()):
            _check_native(path, folder)
        return path

    def included(self, asking: Asking, name: str) -> Path:
        """A file of ``<include>`` or of ``<spectrum filename>``: its name counts from the file that names it."""
        path = self._found(asking, asking.path.parent, name)
        _check_native(asking.path, path.parent)
        return path

    def resource(self, asking: Asking, name: str) -> Path:
        """A bitmap or mesh: Mitsuba looks for it from the scene's folder, also where an included file names it."""
        return self._found(asking, self.folder, name)

    def _found(self, asking: Asking, folder: Path, name: str) -> Path:
        path = folder / name
        try:
            status = path.stat()
            inside = path.resolve().is_relative_to(self.folder.resolve())
        except (OSError, ValueError, RuntimeError):
            raise asking.refusal("filename", repr(name), f"no such file in {folder}; mend the name") from None
        if not (inside or self.outside):
            rule = f"files lie in the scene's folder {self.folder}; copy it there, or use --allow-outside-files"
            raise asking.refusal("filename", repr(name), rule)
        if not stat.S_ISREG(status.st_mode) or not 0 < status.st_size <= _MOST_BYTES:
            rule = f"a plain file of 1 byte to {_MOST_BYTES >> 20} MiB is needed"
            raise asking.refusal("filename", repr(name), rule)
        self.used[path] = None
        return path


def _check_native(scene: Path, folder: Path) -> None:
    try:
        beside = [entry for entry in os.scandir(folder) if entry.name.lower() == "plugins" and entry.is_dir()]
        libraries = [Path(entry.path) for place in beside for entry in os.scandir(place.path)]
    except OSError as error:
        raise MitsimError(f"{scene}: {error.filename}: cannot be read ({error.strerror}); check the folder") from None
    for library in sorted(libraries):
        if library.suffix.lower() in _NATIVE:
            raise MitsimError(f"{scene}: {library} would run native code; move it away from the scene")
