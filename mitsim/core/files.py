"""Output places that are checked before work, locked against other processes, and filled with whole files only."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shutil
import stat
import tempfile
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from pydantic_core import to_jsonable_python

from mitsim.core.errors import MitsimError, cut

LOCK = ".mitsim.lock"
"""The writing process holds a lock on it; a killed process leaves the file but not the lock. A file's lock is a hidden
file beside it."""
_NAME_BYTES = 120
"""Keeps names of hidden files below the limit of 255 bytes."""
_KINDS = {stat.S_IFCHR: "a device", stat.S_IFBLK: "a device", stat.S_IFIFO: "a named pipe", stat.S_IFSOCK: "a socket"}
_LONGEST_HEAD = 1 << 20
FRAMES = "frame_*.exr"
"""Files that an unfinished capture has completed."""
PAIRS = "pairs.json"
"""Manifest of a store of pairs."""


@contextmanager
def whole_file(path: Path | str) -> Iterator[Path]:
    """Yield a temporary name that replaces ``path`` on leaving and is removed after an error.

    MitsimError if the file cannot be written or is no plain file. A link's target is replaced.
    """
    path = Path(path)
    _check_name(path)
    _check_plain(path)
    target = resolve(path)
    if target.is_symlink():
        raise MitsimError(f"file {path}: cannot be written (it is a link that leads to itself); remove it")
    part = _beside(target, f".{os.getpid()}-{threading.get_ident()}.part")
    try:
        yield part
        os.replace(part, target)
    except OSError as error:
        raise MitsimError(
            f"file {path}: cannot be written ({error.strerror or error}); choose a writable folder with room"
        ) from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def write_bytes(path: Path | str, data: bytes) -> str:
    """Write ``data``, whole or not at all, and return the SHA-256; MitsimError if that fails."""
    with whole_file(path) as part:
        part.write_bytes(data)
    return hashlib.sha256(data).hexdigest()


def write_text(path: Path | str, text: str) -> None:
    try:
        data = text.encode()
    except UnicodeEncodeError as error:
        raise MitsimError(f"file {path}: {error.object[error.start]!r} is no character of UTF-8; remove it") from None
    write_bytes(path, data)


PAGE, PICTURES = "report.html", "pictures"


def remove_page(folder: Path) -> None:
    (folder / PAGE).unlink(missing_ok=True)
    for picture in (folder / PICTURES).glob("*.png"):
        picture.unlink()
    with suppress(OSError):  # none, or it holds what others put there
        (folder / PICTURES).rmdir()


_PART = ".*.part"
_UNFINISHED = ".mitsim.part"
"""Marks a folder whose files must appear together until all are there."""


def sweep(folder: Path) -> None:
    """Remove half-written files of killed processes from a ``folder`` that this process has locked."""
    for part in (*folder.glob(_PART), *(folder / PICTURES).glob(_PART)):
        part.unlink(missing_ok=True)


def prepare_output(path: Path | str, overwrite: bool = False, kind: Literal["folder", "file"] = "folder") -> Path:
    """Check, before any work, that output can be written, and create a missing folder; nothing is deleted.

    MitsimError if the parent is missing, or the place is not writable, is of the other kind, holds something without
    ``overwrite``, or has a name that is not UTF-8, which OpenEXR cannot open.
    """
    path = Path(path)
    _check_name(path)
    if not path.parent.is_dir():
        raise MitsimError(f"output {path}: the folder {path.parent} does not exist; create it or choose another")
    place = path.parent if kind == "file" else path
    if kind == "file":
        if path.is_dir():
            raise MitsimError(f"output {path}: is a folder, but a file is to be written; give a file name")
        _check_plain(path)
        if path.exists() and not overwrite:
            raise MitsimError(f"output {path}: exists already; remove it or choose another name")
    elif path.exists() and not path.is_dir():
        raise MitsimError(f"output {path}: is a file, but a folder is needed; choose another name")
    else:
        try:
            path.mkdir(exist_ok=True)
            occupied = any(item.name != LOCK and not item.match(_PART) for item in path.iterdir())
        except OSError as error:
            raise MitsimError(f"output {path}: cannot be used ({error.strerror}); choose another place") from error
        if occupied and not overwrite:
            remedy = "choose a new folder, or empty this one; commands replace earlier results with --overwrite"
            with suppress(MitsimError, ValueError, RecursionError, AttributeError):  # a killed work left its manifest
                manifest = path / (PAIRS if (path / PAIRS).is_file() else "manifest.json")
                if json.loads(read_text(manifest, _LONGEST_HEAD)).get("status") == "incomplete":
                    remedy = "continue with resume=True"
            raise MitsimError(f"output {path}: the folder holds files already; {remedy}")
    # Permission bits do not show everything (root, read-only mounts, quotas): only a file that was really written does.
    try:
        with tempfile.TemporaryFile(dir=place) as file:
            file.write(b"mitsim")
    except OSError as error:
        raise MitsimError(
            f"output {path}: the folder {place} is not writable ({error.strerror}); choose another place"
        ) from error
    return path


def _check_name(path: Path) -> None:
    try:
        os.fspath(path.absolute()).encode()
    except UnicodeEncodeError:
        raise MitsimError(f"output {path}: is not UTF-8 text; choose a folder with another name") from None


def check_output(path: Path | str, overwrite: bool = False, kind: Literal["folder", "file"] = "folder") -> None:
    """Refuse the same as :func:`prepare_output`, before slow imports, and leave nothing behind."""
    new = not os.path.lexists(path)
    try:
        prepare_output(path, overwrite, kind)
    finally:
        if new and kind == "folder":
            with suppress(OSError):
                os.rmdir(path)


@contextmanager
def output_folder(path: Path | str, overwrite: bool = False) -> Iterator[Path]:
    """Lock an output folder, and remove a new one if the work fails before writing.

    MitsimError as for :func:`prepare_output`, and if another process has locked the folder.
    """
    new = not Path(path).exists()
    folder = prepare_output(path, overwrite)
    try:
        with _lock(folder, folder / LOCK):
            prepare_output(path, overwrite)  # nobody finished a work there between the first look and the lock
            sweep(folder)
            yield folder
    except BaseException:
        if new:
            with suppress(OSError):  # not empty: what was written stays
                folder.rmdir()
        raise


@contextmanager
def output_file(path: Path | str, overwrite: bool = False) -> Iterator[Path]:
    """Lock an output file; MitsimError as for :func:`output_folder`."""
    path = prepare_output(path, overwrite, "file")
    target = resolve(path)
    with _lock(path, _beside(target, LOCK)):
        own = re.compile(re.escape(_beside(target, "").name) + r"\.[0-9]+-[0-9]+\.part")
        for part in filter(lambda each: own.fullmatch(each.name), target.parent.glob(_PART)):  # of killed processes
            part.unlink(missing_ok=True)
        yield prepare_output(path, overwrite, "file")  # nobody wrote it between the first look and the lock


def check_apart(path: Path | str, inputs: Iterable[Path | str]) -> None:
    """Raise MitsimError if the output ``path`` is one of ``inputs``, or a file in an input folder."""
    place = resolve(path)
    for each in map(Path, inputs):
        same = place == resolve(each) or (place.exists() and each.exists() and place.samefile(each))
        if same or (each.is_dir() and place.exists() and place.is_relative_to(resolve(each))):
            raise MitsimError(f"output {path}: would replace {each}, which is read; choose another name")


@contextmanager
def replaced(path: Path, marks: Iterable[str]) -> Iterator[None]:
    """Move a folder with an earlier result aside while a new one is made, and back if none is begun.

    A result has a file or a ``kind`` of ``marks``. Files and the working folder stay where they are, so that they are
    refused as an output. MitsimError for a folder with other content, and if another process writes there.
    """
    place = resolve(path)
    aside = _beside(place, ".replaced")
    free = not place.is_dir() or all(item.name == LOCK for item in place.iterdir())
    if free or (place / _UNFINISHED).is_file() or Path.cwd().is_relative_to(place):
        yield
        return
    if not _is_result(place, marks):
        words = "holds files already, but no earlier result of this command, which alone is replaced"
        raise MitsimError(f"output {path}: the folder {words}; choose another folder")
    if os.path.lexists(aside):  # a killed process left it
        shutil.rmtree(aside)
    with _lock(path, place / LOCK):
        os.replace(place, aside)
    try:
        yield
    finally:
        if os.path.lexists(place):
            shutil.rmtree(aside)
        else:
            os.replace(aside, place)


def _is_result(folder: Path, marks: Iterable[str]) -> bool:
    found = {name for name in marks if (folder / name).is_file()}
    for name in ("manifest.json", "colour.json", "session.json"):
        with suppress(MitsimError, AttributeError):  # missing, damaged, or no object
            found.add(read_json(folder / name).get("kind"))
    return not found.isdisjoint(marks)


@contextmanager
def whole_folder(path: Path | str) -> Iterator[Path]:
    """Lock a new or empty folder whose files appear together or, after an error, not at all.

    The next process removes files of a killed one. MitsimError as for :func:`output_folder`.
    """
    if (Path(path) / _UNFINISHED).is_file():
        with _lock(Path(path), Path(path) / LOCK):
            _empty(Path(path))
    with output_folder(path) as folder:
        (folder / _UNFINISHED).touch()
        try:
            yield folder
        except BaseException:
            _empty(folder)
            raise
        (folder / _UNFINISHED).unlink(missing_ok=True)


def _empty(folder: Path) -> None:
    for item in sorted(folder.iterdir(), key=lambda item: item.name == _UNFINISHED):  # the mark last
        if item.name != LOCK:
            shutil.rmtree(item) if item.is_dir() and not item.is_symlink() else item.unlink()


def _beside(path: Path, ending: str) -> Path:
    name = path.name.encode()[:_NAME_BYTES].decode(errors="ignore")
    return path.with_name(f".{name}{ending}")


def _check_plain(path: Path) -> None:
    """Raise MitsimError if ``path`` is a device, pipe or socket, which a file would replace."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        kind = _KINDS.get(stat.S_IFMT(mode), "no plain file")
        raise MitsimError(f"output {path}: is {kind}, which a file would replace; give the name of a file")


@contextmanager
def _lock(path: Path, name: Path) -> Iterator[None]:
    from filelock import FileLock, Timeout  # here: it takes 20 ms to import, and no refusal needs it

    lock = FileLock(name)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise MitsimError(f"output {path}: another mitsim is writing there; wait for it, or choose another") from None
    try:
        yield
    finally:
        name.unlink(missing_ok=True)  # before the lock is given back: who waits for it looks for the name
        lock.release()


# -------- JSON files

MOST_BYTES = 32 << 20
"""A little more than the largest manifest of a capture: 65536 shots of 4096 x 256 patterns make 29 MB."""


def plain(value: Any) -> Any:
    """Convert to JSON types; NaN and infinities become null, TypeError for unknown types."""
    if hasattr(value, "model_dump"):  # because pydantic would keep its infinities
        value = value.model_dump()
    return to_jsonable_python(value, inf_nan_mode="null", fallback=_known)


def _known(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else dict(value)


def json_text(obj: Any) -> str:
    return json.dumps(plain(obj), indent=1, allow_nan=False) + "\n"


def write_json(path: Path | str, obj: Any) -> None:
    write_text(path, json_text(obj))


def parse_json(text: str) -> Any:
    """Parse JSON; ValueError if it is invalid, repeats a key, or is nested too deep."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        unique: dict[str, Any] = {}
        for key, value in pairs:
            if key in unique:
                raise ValueError(f"key {cut(key)!r} is there twice")
            unique[key] = value
        return unique

    try:
        return json.loads(text, object_pairs_hook=once)
    except RecursionError:
        raise ValueError("it is nested too deep") from None


BYTE_ORDER_MARK = "\ufeff"
"""Editors of Windows begin files with it."""


def read_json(path: Path | str) -> Any:
    """Return the object in a JSON file of at most 32 MiB; MitsimError if it is unreadable, invalid or repeats a key."""
    try:
        return parse_json(read_text(path, MOST_BYTES).removeprefix(BYTE_ORDER_MARK))
    except ValueError as error:
        raise MitsimError(f"file {path}: not valid JSON ({error}); write or copy it again") from error


# -------- Files that others wrote

_silence = threading.RLock()
MOST_SIDE = 16384
"""Pixels a side of the largest sensor or environment map."""
MOST_PIXELS = 1 << 26
"""Pixels of a frame, 8192 x 8192: sixteen times the largest sensors used with coded masks. An import of one frame takes
1.7 GB and 2.5 s; of a larger sensor, a region or binned frames are read."""
FRAME_LIMITS = f"at most {MOST_SIDE} pixels a side and {MOST_PIXELS} in all"


def fits_a_frame(shape: Sequence[int]) -> bool:
    return max(shape, default=0) <= MOST_SIDE and math.prod(shape) <= MOST_PIXELS


def check_plain(path: Path | str, what: str = "file") -> os.stat_result:
    """Return the status of a plain file; MitsimError if it is missing, or a folder, pipe or device."""
    try:
        status = os.stat(path)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise MitsimError(f"{what} {path}: cannot be read ({reason}); check the path") from error
    if not stat.S_ISREG(status.st_mode):
        kind = "Is a directory" if stat.S_ISDIR(status.st_mode) else "a pipe or device, no plain file"
        raise MitsimError(f"{what} {path}: cannot be read ({kind}); check the path")
    return status


def resolve(path: Path | str) -> Path:
    """Follow links; a link to itself does not raise, unlike ``Path.resolve`` before Python 3.13."""
    return Path(os.path.realpath(path))


@contextmanager
def stderr_silenced() -> Iterator[None]:
    """Suppress lines that native code writes to stderr about a damaged file, because Python raises an error, too.

    Only one thread at a time may do so, or two would restore each other's stream.
    """
    with _silence:
        stderr = os.dup(2)
        try:
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), 2)
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)


def read_text(path: Path | str, most: int) -> str:
    """Return a plain file's text; MitsimError for over ``most`` bytes, ValueError if it is not UTF-8."""
    size = check_plain(path).st_size
    if size > most:
        raise MitsimError(f"file {path}: has {size} bytes; at most {most} are allowed")
    try:
        with open(path, "rb") as file:
            return file.read(most).decode("utf-8")
    except OSError as error:
        raise MitsimError(f"file {path}: cannot be read ({error.strerror}); check the path") from error
