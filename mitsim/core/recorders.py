"""Shots of a run in, as they are exposed; its files out, whole or not at all: in memory, or in a folder.

Both recorders take the same calls; :class:`mitsim.core.runs.Capture` reads what they kept.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.exr import Channels, Metadata, Value, checksum, read_frame, write_frame
from mitsim.core.files import output_folder, remove_page
from mitsim.core.manifests import MANIFEST, RunHead, RunManifest, read_head, read_manifest, write_manifest

TRUTH, AMBIENT, CLOSING = "truth.exr", "ambient.exr", "closing.exr"


def frame_name(index: int) -> str:
    """File name of shot number ``index`` in its run folder."""
    return f"frame_{index:05d}.exr"


class Recorder:
    """Keeps what a run writes, file by file, from any thread: in memory, or, as :class:`RunFolder`, on disk.

    Attributes
    ----------
    folder
        where the files lie; None in memory.
    files
        channels and metadata by file name, in memory alone.
    """

    folder: Path | None = None

    def __init__(self) -> None:
        self.files: dict[str, tuple[Channels, Metadata]] = {}

    def begin(self) -> None:
        """Begin to write: all input has been checked."""

    def keeps(self, index: int) -> bool:
        """Whether shot number ``index`` is there already; it then counts as written. Never in memory."""
        return False

    def write(self, name: str, channels: Channels, metadata: Metadata) -> None:
        """Write a file of the run, whole or not at all.

        Parameters
        ----------
        name
            of the file.
        channels, metadata
            of it, (rows, columns) each.
        """
        self.files[name] = channels, metadata

    def write_frame(self, index: int, channels: Channels, metadata: Metadata) -> None:
        """Write one shot.

        Parameters
        ----------
        index
            its number.
        channels, metadata
            of its file, (rows, columns) each.
        """
        self.write(frame_name(index), channels, {**self._identity(index, channels), **metadata})

    def write_truth(self, reflectance: FloatArray, board: float, standard_error: FloatArray | None = None) -> None:
        """Write the truth.

        Parameters
        ----------
        reflectance, board
            (n, n), relative to a board of that reflectance.
        standard_error
            (n, n) of it, where known.
        """
        known = {"reflectance": reflectance, "standard_error": standard_error}
        channels = {name: values.astype(np.float32) for name, values in known.items() if values is not None}
        self.write(TRUTH, channels, {"board_reflectance": board})

    def finish(self, manifest: RunManifest) -> RunManifest:
        """The ``manifest`` of the finished run, with what only the recorder knows."""
        return manifest

    def _identity(self, index: int, channels: Channels) -> dict[str, Value]:
        """What tells a frame on disk from others; nothing in memory."""
        return {}


class RunFolder(Recorder):
    """Keeps a run in a folder, whole, resumable and checked; made by :func:`claim_run`.

    A frame is kept on resume when it is the one that a finished run's checksum names, or, in an interrupted run, when
    it is readable, carries this run's digest, and its pixels have the checksum that was noted with it.
    """

    folder: Path

    def __init__(self, folder: Path, head: RunHead, known: Mapping[str, str]) -> None:
        """A run in its folder.

        Parameters
        ----------
        folder, head
            where it lies, and the configuration.
        known
            checksums of an earlier, finished run, by file name.
        """
        super().__init__()
        self.folder, self.head = folder, head
        self._known, self._checksums, self._lock = known, dict[str, str](), threading.Lock()

    def begin(self) -> None:
        """Mark the folder as an unfinished run of this configuration."""
        remove_page(self.folder)
        configuration, digest = self.head.configuration, self.head.configuration_sha256
        head = RunHead(status="incomplete", configuration=configuration, configuration_sha256=digest)
        write_manifest(self.folder, head)

    def keeps(self, index: int) -> bool:
        """Whether shot number ``index`` is there already; it then counts as written."""
        name = frame_name(index)
        path = self.folder / name
        if not path.is_file():
            return False
        actual = checksum(path)
        same = self._known[name] == actual if name in self._known else self._is_ours(path, index)
        if same:
            self._note(name, actual)
        return same

    def finish(self, manifest: RunManifest) -> RunManifest:
        """Write the ``manifest`` of the finished run, with checksums; returns it."""
        checksums = dict(sorted(self._checksums.items()))
        manifest = manifest.model_copy(update={"status": "complete", "checksums": checksums})
        write_manifest(self.folder, manifest)
        return manifest

    def write(self, name: str, channels: Channels, metadata: Metadata) -> None:
        """Write a file of the run, whole or not at all.

        Parameters
        ----------
        name, channels, metadata
            as for :meth:`Recorder.write`.
        """
        self._note(name, write_frame(self.folder / name, channels, metadata))

    def _note(self, name: str, value: str) -> None:
        with self._lock:
            self._checksums[name] = value

    def _is_ours(self, path: Path, index: int) -> bool:
        try:
            channels, metadata = read_frame(path)
        except MitsimError:
            return False
        return all(metadata.get(key) == value for key, value in self._identity(index, channels).items())

    def _identity(self, index: int, channels: Channels) -> dict[str, Value]:
        """What tells a frame from one of another run, another place in this one, or one that was damaged."""
        return {"run": self.head.configuration_sha256, "index": index, "pixels_sha256": _pixels(channels)}


def _pixels(channels: Channels) -> str:
    """SHA-256 of the channels' names and values: in an interrupted run no manifest holds checksums of files yet."""
    digest = hashlib.sha256()
    for name, values in sorted(channels.items()):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(values).data)
    return digest.hexdigest()


@contextmanager
def claim_run(path: Path, head: RunHead, resume: bool) -> Iterator[RunFolder]:
    """A folder for a run, checked before any work; if that fails before writing, a new folder is removed.

    Parameters
    ----------
    path
        of the folder.
    head
        the configuration of the run.
    resume
        whether the folder may hold an unfinished or finished run of the same configuration.

    Raises
    ------
    MitsimError
        for a place that cannot be written, that holds something else, or, with ``resume``, another configuration.
    """
    known: Mapping[str, str] = {}
    again = resume and (path / MANIFEST).is_file()
    if again:
        known = check_same(path, head)
    with output_folder(path, overwrite=again) as folder:
        yield RunFolder(folder, head, known)


def check_same(path: Path, head: RunHead) -> Mapping[str, str]:
    """Checksums of the frames in ``path`` of a finished run that ``head`` begins; none of an interrupted one.

    MitsimError for a run of another configuration.
    """
    before = read_head(path)
    if before.configuration_sha256 != head.configuration_sha256:
        changed = [key for key, value in head.configuration.items() if before.configuration.get(key) != value]
        raise MitsimError(
            f"resume=True: {path} holds a run of another configuration ({', '.join(changed) or 'unknown'} differ); "
            "use the same options, or another folder"
        )
    return read_manifest(path, RunManifest).checksums if before.status == "complete" else {}
