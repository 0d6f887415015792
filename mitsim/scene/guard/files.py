"""The files of a scene: where each one lies, that it is a plain file in the scene's folder, and a list of all."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING

from mitsim.core.errors import MitsimError

if TYPE_CHECKING:
    from mitsim.scene.guard.outline import Tag

_NATIVE = (".so", ".dylib", ".dll")
_MOST_BYTES = 512 << 20
"""An environment map of 8192 x 4096 texels of float32, as large as one may be, has 400 MiB."""
_MOST_SPECTRUM = 1 << 20
"""Some 50 000 lines; measured spectra have 1000."""


class SceneFiles:
    """What one scene may read; ``used`` lists it, the scene first.

    Parameters
    ----------
    scene
        the scene's XML; all else lies in its folder.
    outside
        allows files outside that folder.
    """

    def __init__(self, scene: Path, outside: bool = False) -> None:
        self.folder = scene.parent
        self.outside = outside
        self.used: dict[Path, None] = {}

    def scene(self, path: Path) -> Path:
        """``path`` itself; MitsimError when it is no plain file, or when native code lies where Mitsuba looks."""
        if not path.is_file():
            raise MitsimError(f"{path}: no such scene file; give the path of a Mitsuba scene XML")
        self.used[path] = None
        # Mitsuba looks for a plugin in the folder "plugins" beside the scene and in the working folder, its own last.
        for folder in (path.parent, Path()):
            _check_native(path, folder)
        return path

    def included(self, tag: Tag, name: str) -> Path:
        """The file ``name`` of the ``<include>`` at ``tag``, beside the file that names it; MitsimError as a
        resource."""
        path = self._found(tag, tag.path.parent, name)
        _check_native(tag.path, path.parent)
        return path

    def spectrum(self, tag: Tag, folder: Path, name: str) -> None:
        """Allow the file of a spectrum; MitsimError as for :meth:`resource`.

        Parameters
        ----------
        tag, name
            that asks for it, and by which name.
        folder
            where Mitsuba looks for it first.
        """
        if self._found(tag, folder, name).stat().st_size > _MOST_SPECTRUM:
            raise tag.refusal("filename", repr(name), "the file is over 1 MiB; a spectrum is smaller")

    def resource(self, tag: Tag, name: str) -> Path:
        """The bitmap or mesh ``name`` at ``tag``: Mitsuba looks for it from the scene's folder, also where an included
        file names it. MitsimError when it lies elsewhere, or is no plain file of at most 512 MiB."""
        return self._found(tag, self.folder, name)

    def _found(self, tag: Tag, folder: Path, name: str) -> Path:
        path = folder / name
        try:
            status = path.stat()
            inside = path.resolve().is_relative_to(self.folder.resolve())
        except (OSError, ValueError, RuntimeError):
            raise tag.refusal("filename", repr(name), f"no such file in {folder}; mend the name") from None
        if not (inside or self.outside):
            rule = f"files lie in the scene's folder {self.folder}; copy it there, or use --allow-outside-files"
            raise tag.refusal("filename", repr(name), rule)
        if not stat.S_ISREG(status.st_mode) or not 0 < status.st_size <= _MOST_BYTES:
            rule = f"a plain file of 1 byte to {_MOST_BYTES >> 20} MiB is needed"
            raise tag.refusal("filename", repr(name), rule)
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
