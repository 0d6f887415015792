"""The run folder of a capture: configuration in, frames and manifest on disk that are whole, resumable and checked."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.errors import MitsimError
from mitsim.core.framefile import Channel, Value, checksum, read_frame, write_frame
from mitsim.core.manifest import read_json, write_json
from mitsim.core.output import output_folder, sweep

MANIFEST = "manifest.json"
TRUTH = "truth.exr"


def frame_name(index: int) -> str:
    """File name of a capture in its run folder."""
    return f"frame_{index:05d}.exr"


class RunFolder:
    """One run on disk; ``digest`` identifies its configuration.

    A frame is kept on resume when it is the one that a finished run's checksum names, or, in an interrupted run, when
    it is readable, carries this run's digest, and its pixels have the checksum that was noted with it.
    """

    def __init__(self, path: Path, digest: str, configuration: Mapping[str, Any], known: Mapping[str, str]) -> None:
        self.path, self.digest, self.configuration = path, digest, configuration
        self._known, self._checksums, self._lock = known, dict[str, str](), threading.Lock()

    def begin(self) -> None:
        """Mark the folder as an unfinished run of this configuration, and clear what a killed process left."""
        sweep(self.path)
        write_json(self.path / MANIFEST, {**self._head(), "status": "incomplete"})

    def keeps(self, index: int) -> bool:
        """Whether the frame is there already; it then counts as written."""
        name = frame_name(index)
        path = self.path / name
        if not path.is_file():
            return False
        found = checksum(path)
        kept = self._known[name] == found if name in self._known else self._is_ours(path, index)
        if kept:
            self._note(name, found)
        return kept

    def write_frame(self, index: int, channels: Mapping[str, Channel], metadata: Mapping[str, Value]) -> None:
        """Write one frame, whole or not at all."""
        self._write(frame_name(index), channels, {**self._identity(index, channels), **metadata})

    def write_truth(self, reflectance: npt.NDArray[np.float64], board: float) -> None:
        """Write the truth (n, n), relative to a board of that reflectance."""
        self._write(TRUTH, {"reflectance": reflectance.astype(np.float32)}, {"board_reflectance": board})

    def finish(self, content: Mapping[str, Any]) -> None:
        """Write the manifest of the finished run."""
        checksums = dict(sorted(self._checksums.items()))
        write_json(self.path / MANIFEST, {**self._head(), "status": "complete", **content, "checksums": checksums})

    def _head(self) -> dict[str, Any]:
        return {"kind": "capture", "configuration": self.configuration, "configuration_sha256": self.digest}

    def _write(self, name: str, channels: Mapping[str, Channel], metadata: Mapping[str, Value]) -> None:
        write_frame(self.path / name, channels, metadata)
        self._note(name, checksum(self.path / name))

    def _note(self, name: str, value: str) -> None:
        with self._lock:
            self._checksums[name] = value

    def _is_ours(self, path: Path, index: int) -> bool:
        try:
            channels, metadata = read_frame(path)
        except MitsimError:
            return False
        return all(metadata.get(key) == value for key, value in self._identity(index, channels).items())

    def _identity(self, index: int, channels: Mapping[str, Channel]) -> dict[str, Value]:
        """What tells a frame from one of another run, another place in this one, or one that was damaged."""
        return {"run": self.digest, "index": index, "pixels_sha256": _pixels(channels)}


def _pixels(channels: Mapping[str, Channel]) -> str:
    """SHA-256 of the channels' names and values: in an interrupted run no manifest holds checksums of files yet."""
    digest = hashlib.sha256()
    for name, values in sorted(channels.items()):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


@contextmanager
def claimed(path: Path, digest: str, configuration: Mapping[str, Any], resume: bool) -> Iterator[RunFolder]:
    """A folder for a run, checked before any work; a folder made for nothing is taken away again.

    Raises
    ------
    MitsimError
        for a place that cannot be written, that holds something else, or, with ``resume``, another configuration.
    """
    known: Mapping[str, str] = {}
    again = resume and (path / MANIFEST).is_file()
    if again:
        known = _checked(path, digest, configuration)
    with output_folder(path, overwrite=again) as folder:
        yield RunFolder(folder, digest, configuration, known)


def _checked(path: Path, digest: str, configuration: Mapping[str, Any]) -> Mapping[str, str]:
    """Checksums of the frames of a finished run of the same configuration; none of an interrupted one."""
    found = read_json(path / MANIFEST)
    if not isinstance(found, dict) or found.get("kind") != "capture":
        raise MitsimError(f"--resume: {path}/{MANIFEST} is not that of a capture; use another folder")
    if found.get("configuration_sha256") != digest:
        before = found.get("configuration")
        before = before if isinstance(before, dict) else {}
        changed = [key for key, value in configuration.items() if before.get(key) != value]
        raise MitsimError(
            f"--resume: {path} holds a run of another configuration ({', '.join(changed) or 'unknown'} differ); "
            "use the same options, or another folder"
        )
    checksums = found.get("checksums")
    return checksums if isinstance(checksums, dict) else {}
