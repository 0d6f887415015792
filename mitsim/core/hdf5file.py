"""HDF5 files: a path in, a file to fill out, which takes its place when all of it was written, or leaves nothing.

HDF5's own writer cannot close a file on a disk that is full: it says so many times on stderr, and once more when the
program ends, or ends it. Here it writes through Python, which keeps the error until the file is closed.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsim.core.output import whole_file

if TYPE_CHECKING:
    import h5py


@contextmanager
def whole_hdf5(path: Path | str) -> Iterator[h5py.File]:
    """An HDF5 file that takes the place of ``path`` on leaving; after an error nothing of it is left.

    MitsimError when it cannot be written, as on a full disk.
    """
    import h5py  # here: it takes 50 ms to import, and most work writes none

    with whole_file(path) as part, open(part, "w+b", buffering=0) as disk:
        kept = _Kept(disk)
        try:
            with h5py.File(kept, "w", track_order=True) as file:
                yield file
        except Exception as error:  # of what it could not read again, where it could not write
            raise kept.error or error from None
        if kept.error is not None:
            raise kept.error


class _Kept:
    """A file whose first error in writing is kept as ``error``: what follows is dropped, as if it were written."""

    def __init__(self, disk: FileIO) -> None:
        self._disk = disk
        self.error: OSError | None = None
        self.tell, self.seek, self.read = disk.tell, disk.seek, disk.read  # by which h5py knows an open file

    def write(self, data: Any) -> int:
        """Write ``data``; returns its length."""
        return self._tried(self._whole, memoryview(data).cast("B"), memoryview(data).nbytes)

    def truncate(self, size: int) -> int:
        """Make the file ``size`` bytes long; returns that."""
        return self._tried(self._disk.truncate, size, size)

    def flush(self) -> None:
        """Nothing waits: it is not buffered here."""

    def readinto(self, buffer: Any) -> int:
        """Fill a ``buffer``, with zeros where nothing was written; returns its length."""
        view = memoryview(buffer).cast("B")
        found = self._disk.readinto(view) or 0
        view[found:] = bytes(len(view) - found)
        return len(view)

    def _whole(self, view: memoryview) -> None:
        while view:
            view = view[self._disk.write(view) :]

    def _tried(self, work: Any, argument: Any, result: int) -> int:
        try:
            if self.error is None:
                work(argument)
        except OSError as error:
            self.error = error
        return result
