"""Files that others wrote: a path in, its bytes out, of a plain file no larger than it may be."""

from __future__ import annotations

import math
import os
import stat
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from mitsim.core.errors import MitsimError

_silence = threading.RLock()
MOST_SIDE = 16384
"""Pixels a side of the largest picture that is read: of the largest sensor and environment map that are simulated."""
MOST_PIXELS = 1 << 26
"""Of a frame or other picture, 8192 x 8192: sixteen times the largest sensors that coded masks are used with (2048 a
side); an import of one predicts 1.7 GB and takes 2.5 s of processor time. Of a larger sensor a region or binned frames
are read."""
FRAME_LIMITS = f"at most {MOST_SIDE} pixels a side and {MOST_PIXELS} in all"
"""For messages."""


def fits_a_frame(shape: Sequence[int]) -> bool:
    """Whether a picture of this ``shape`` (rows, columns) is no larger than a frame may be."""
    return max(shape, default=0) <= MOST_SIDE and math.prod(shape) <= MOST_PIXELS


def check_plain(path: Path | str, what: str = "file") -> os.stat_result:
    """The status of the plain file ``path``, called ``what`` in errors. MitsimError when it cannot be looked at, or is
    a folder, pipe or device, from which reading may never end."""
    try:
        status = os.stat(path)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise MitsimError(f"{what} {path}: cannot be read ({reason}); check the path") from error
    if stat.S_ISDIR(status.st_mode):
        raise MitsimError(f"{what} {path}: cannot be read (Is a directory); check the path")
    if not stat.S_ISREG(status.st_mode):
        raise MitsimError(f"{what} {path}: cannot be read (a pipe or device, no plain file); check the path")
    return status


def resolved(path: Path | str) -> Path:
    """Where ``path`` leads, links followed as far as they lead: ``Path.resolve`` raises RuntimeError for one that leads
    to itself, before Python 3.13."""
    return Path(os.path.realpath(path))


@contextmanager
def stderr_silenced() -> Iterator[None]:
    """What native code writes to stderr of a damaged file, past Python, goes nowhere: it raises too. One thread at a
    time, so that two do not restore each other's stream."""
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
    """The UTF-8 text of the plain file ``path``. MitsimError as ``check_plain``, and for over ``most`` bytes;
    ValueError when it is no UTF-8."""
    size = check_plain(path).st_size
    if size > most:
        raise MitsimError(f"file {path}: has {size} bytes; at most {most} are allowed")
    try:
        with open(path, "rb") as file:
            return file.read(most).decode("utf-8")
    except OSError as error:
        raise MitsimError(f"file {path}: cannot be read ({error.strerror}); check the path") from error
