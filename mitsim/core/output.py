"""Places to write to: checked before any work, held against other processes, and filled with whole files only."""

import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

from filelock import FileLock, Timeout

from mitsim.core.errors import MitsimError

LOCK = ".mitsim.lock"
"""Held, in a folder, by the process that writes there; a killed process leaves the file behind, but not the lock."""


@contextmanager
def whole_file(path: Path | str) -> Iterator[Path]:
    """A name beside ``path`` to write to; on leaving it takes the place of ``path``, and after an error it is removed.

    Raises MitsimError when the file cannot be written.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}.part")
    try:
        yield part
        os.replace(part, path)
    except OSError as error:
        raise MitsimError(
            f"file {path}: cannot be written ({error.strerror or error}); choose a writable folder with room"
        ) from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def sweep(folder: Path) -> None:
    """Remove what killed processes left half-written in a folder that this one holds."""
    for part in folder.glob(".*.part"):
        part.unlink(missing_ok=True)


def prepare_output(path: Path | str, overwrite: bool = False, kind: Literal["folder", "file"] = "folder") -> Path:
    """Make sure, before any work, that output can be written to `path`; returns it as a Path.

    A folder is created if its parent exists. Nothing is deleted: `overwrite` only allows a folder that
    holds files already, or an existing file. Raises MitsimError when the parent is missing, or the place is
    not writable, is of the other kind, or holds something and `overwrite` is off.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise MitsimError(f"output {path}: the folder {path.parent} does not exist; create it or choose another")
    if kind == "file":
        _prepare_file(path, overwrite)
    else:
        _prepare_folder(path, overwrite)
    return path


@contextmanager
def output_folder(path: Path | str, overwrite: bool = False) -> Iterator[Path]:
    """`prepare_output` for the time of a work, in which no other process may claim the folder; one made for nothing
    is taken away when the work fails. Raises MitsimError also when another process holds it.
    """
    new = not Path(path).exists()
    folder = prepare_output(path, overwrite)
    try:
        with _locked(folder):
            prepare_output(path, overwrite)  # nobody finished a work there between the first look and the lock
            yield folder
    except BaseException:
        if new:
            with suppress(OSError):  # not empty: what was written stays
                folder.rmdir()
        raise


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise MitsimError(f"output {folder}: another mitsim is writing there; wait for it, or choose another") from None
    try:
        yield
    finally:
        (folder / LOCK).unlink(missing_ok=True)  # before the lock is given back: who waits for it looks for the name
        lock.release()


def _prepare_file(path: Path, overwrite: bool) -> None:
    if path.is_dir():
        raise MitsimError(f"output {path}: is a folder, but a file is to be written; give a file name")
    if path.exists() and not overwrite:
        raise MitsimError(f"output {path}: exists already; remove it or choose another name")
    _try_writing(path, path.parent)


def _prepare_folder(path: Path, overwrite: bool) -> None:
    if path.exists() and not path.is_dir():
        raise MitsimError(f"output {path}: is a file, but a folder is needed; choose another name")
    try:
        path.mkdir(exist_ok=True)
        occupied = any(item.name != LOCK for item in path.iterdir())
    except OSError as error:
        raise MitsimError(f"output {path}: cannot be used ({error.strerror}); choose another place") from error
    if occupied and not overwrite:
        raise MitsimError(f"output {path}: the folder holds files already; choose a new one or empty it")
    _try_writing(path, path)


def _try_writing(path: Path, folder: Path) -> None:
    # Permission bits do not tell (root, read-only mounts, quotas): only a file that was really written does.
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"mitsim")
    except OSError as error:
        raise MitsimError(
            f"output {path}: the folder {folder} is not writable ({error.strerror}); choose another place"
        ) from error
