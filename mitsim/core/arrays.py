"""Arrays that several rooms exchange, and NPY, NPZ, HDF5 and MATLAB files.

A header's claims are compared with the file before memory is allocated, and files are never mapped, because a mapped
file that is cut short ends the process. HDF5 is written through Python, because its own writer fails on a full disk.
"""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import fields
from io import FileIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from mitsim.core.errors import MitsimError, reason_of
from mitsim.core.files import MOST_PIXELS, check_plain, whole_file
from mitsim.core.job import Cost, Limits

FloatArray = npt.NDArray[np.float64]
SeparableTerm = tuple[FloatArray, FloatArray]
"""Left (m, n) and right (m', n') factor of one product of an operator from scene pixels to a sensor."""
Labels = npt.NDArray[np.int64]


def sum_of_squares(values: FloatArray) -> float:
    """Return the sum of squares in a fixed order of additions, unlike BLAS."""
    flat = np.ravel(values, order="K")  # as they lie in memory: transposed ones are not copied
    return float(np.einsum("i,i->", flat, flat))


def mean_of_neighbours(values: FloatArray) -> FloatArray:
    """Return the mean over 3 x 3 neighbours, edges repeated (importing scipy takes 50 ms)."""
    for _ in ("rows", "columns"):
        wide = np.pad(values, ((1, 1), (0, 0)), mode="edge")
        values = ((wide[:-2] + wide[1:-1] + wide[2:]) / 3).T
    return values


class ByValue:
    """Mixin for dataclasses (with ``eq=False``) that compare by their values, arrays by their bytes."""

    def _values(self) -> tuple[object, ...]:
        values = (getattr(self, field.name) for field in fields(self))  # type: ignore[arg-type]
        return tuple(value.tobytes() if isinstance(value, np.ndarray) else value for value in values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ByValue) and type(other) is type(self) and other._values() == self._values()

    def __hash__(self) -> int:
        return hash(self._values())

    def _hold(self, **arrays: npt.NDArray[np.generic]) -> None:
        for name, array in arrays.items():
            array.flags.writeable = False
            object.__setattr__(self, name, array)


# -------- NumPy's files

_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
"""Later versions only add field names in UTF-8, which arrays of numbers do not have."""
_PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_MOST_ARRAYS = 10_000
_AGAIN = 2
"""Bytes of memory for each byte of an NPZ: the unpacked data and the array."""


def npy_header(file: BinaryIO, size: int) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return shape and type of an NPY file of ``size`` bytes, and go back to its beginning, for :func:`numpy.load`.

    ValueError if the header is invalid, or claims Python objects or another number of bytes than follow.
    """
    read = _HEADERS.get(np.lib.format.read_magic(file))
    if read is None:
        raise ValueError("it is no array of numbers")
    try:
        shape, _, dtype = read(file)
    except Exception as error:  # of a damaged header NumPy raises whatever Python does on reading it as a literal
        raise error if isinstance(error, ValueError) else ValueError("its header is damaged") from None
    claimed, there = math.prod(shape) * dtype.itemsize, size - file.tell()
    if dtype.hasobject:
        raise ValueError("it holds objects of Python, which are code")
    if claimed != there:
        raise ValueError(f"its header claims {claimed} bytes of numbers, and {there} follow it")
    file.seek(0)
    return shape, dtype


def read_npz(file: BinaryIO, name: Path | str) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of an NPZ ``file``, called ``name`` in messages.

    ValueError if it is damaged or holds other types than numbers and texts; MitsimError if memory is too small.
    """
    try:
        with zipfile.ZipFile(file) as packed:
            parts = packed.infolist()
            if len(parts) > _MOST_ARRAYS or any(part.compress_type not in _PACKINGS for part in parts):
                raise ValueError(f"it holds more than {_MOST_ARRAYS} arrays, or such as NumPy does not write")
            Cost(memory_bytes=_AGAIN * sum(part.file_size for part in parts)).check(f"file {name}", Limits())
            arrays = {}
            for part in parts:
                data = io.BytesIO(packed.read(part))
                npy_header(data, part.file_size)
                arrays[part.filename.removesuffix(".npy")] = np.load(data, allow_pickle=False)
            return arrays
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OverflowError) as error:
        raise ValueError(reason_of(error)) from error


# -------- HDF5 files

PACKED: dict[str, Any] = {"shuffle": True, "compression": "gzip", "compression_opts": 1, "fletcher32": True}
"""Filters that every HDF5 library has. Higher levels of gzip take thrice the time and do not shrink noise."""
_MOST_CHUNK = 4 * MOST_PIXELS
_MOST_ITEMS, _DEEPEST = 100_000, 16


@contextmanager
def whole_hdf5(path: Path | str) -> Iterator[Any]:
    """Open an HDF5 file that replaces ``path`` on leaving, or is removed after an error; MitsimError on a full disk."""
    import h5py  # here: it takes 50 ms to import, and most work writes none

    with whole_file(path) as part, _FirstErrorFile(part, "w+") as kept:
        try:
            with h5py.File(kept, "w", track_order=True) as file:
                yield file
        except Exception as error:  # of what it could not read again, where it could not write
            raise kept.error or error from None
        if kept.error is not None:
            raise kept.error


@contextmanager
def checked_hdf5(path: Path, copies: Callable[[Any], float], known: set[object] | None = None) -> Iterator[Any]:
    """Check all content of an HDF5 file, then open it for reading; every HDF5 input is opened here.

    HDF5 follows links to other files, unpacks data that claim to be a million times larger, and reads data that were
    never stored as zeros. MitsimError refuses such content, damaged files, and files that do not fit into memory.

    Parameters
    ----------
    copies
        Bytes of memory that the caller needs for each byte of an h5py.Dataset; 0 for a dataset that the caller checks.
    known
        Identities of files already checked and unchanged since; the file is added.
    """
    import h5py

    allowed = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
    state, found, known = check_plain(path), 0, set() if known is None else known
    mark = path, state.st_ino, state.st_size, state.st_mtime_ns

    def look(group: Any, depth: int) -> Iterator[float]:
        nonlocal found
        for name in group:
            found, place = found + 1, f"{path}: {group.name.rstrip('/')}/{name}"
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise MitsimError(f"{place} is a link; write the data themselves into the file")
            if found > _MOST_ITEMS or depth > _DEEPEST:
                raise MitsimError(f"{path}: holds over {_MOST_ITEMS} items or {_DEEPEST} levels; keep the data alone")
            item = group[name]
            if isinstance(item, h5py.Group):
                yield from look(item, depth + 1)
            elif isinstance(item, h5py.Dataset) and item.shape is not None:
                filters, chunk, kind = item.id.get_create_plist(), item.chunks, item.dtype
                used = [filters.get_filter(index)[0] for index in range(filters.get_nfilters())]
                pieces = (
                    math.prod(-(-side // part) for side, part in zip(item.shape, chunk, strict=True)) if chunk else 0
                )
                # Chunks that were never stored are read as the fill value: black frames, of any size.
                stored = item.id.get_num_chunks() == pieces if chunk else item.id.get_storage_size() >= item.nbytes
                wrong = {
                    "lies in another file": item.is_virtual or item.external,
                    "is packed by filters other than gzip, or twice": {*used} - allowed or len({*used}) < len(used),
                    "is stored in pieces of over 256 MiB": math.prod(chunk or ()) * kind.itemsize > _MOST_CHUNK,
                    f"claims {item.shape}, of which not all is stored": not stored,
                }
                for reason in filter(wrong.get, wrong):
                    raise MitsimError(f"{place} {reason}; write the data themselves into the file")
                # Each text of a dataset may be the whole file.
                yield copies(item) * item.size * (state.st_size if kind.hasobject else kind.itemsize)

    with ExitStack() as stack:
        with hdf5_errors(path):
            file = stack.enter_context(h5py.File(path, "r"))
            if mark not in known:
                Cost(memory_bytes=sum(look(file, 1))).check(f"file {path}", Limits())
                known.add(mark)
        yield file


@contextmanager
def hdf5_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, RuntimeError, ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
        raise MitsimError(f"{path}: damaged, or no HDF5 file ({reason_of(error)}); write or copy it again") from error


class _FirstErrorFile(FileIO):
    """Unbuffered file that keeps its first writing error as ``error`` and then drops all data."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        length = len(view)
        try:
            while view and self.error is None:
                view = view[super().write(view) :]
        except OSError as error:
            self.error = error
        return length

    def truncate(self, size: int | None = None) -> int:
        try:
            return self.tell() if self.error else super().truncate(size)
        except OSError as error:
            self.error = error
        return size or 0

    def readinto(self, buffer: Any) -> int:
        """Fill a ``buffer``, with zeros where nothing was written."""
        view = memoryview(buffer).cast("B")
        found = super().readinto(view) or 0
        view[found:] = bytes(len(view) - found)
        return len(view)


# -------- MATLAB files of version 5

LARGEST_VARIABLE = (1 << 31) - 1
"""Largest array in a MATLAB file of version 5 [bytes]."""
_NUMBERS = {"double", "single", "logical", "char"} | {f"{sign}int{8 << k}" for sign in ("", "u") for k in range(4)}
_MOST_VARIABLES = 10_000
_COPIES = 3
"""Arrays of a variable's size held at once: as stored, in its class, and as used here."""


def write_variables(path: Path, variables: Mapping[str, Any]) -> None:
    """Write a MATLAB file, whole or not at all; MitsimError for arrays above 2 GiB."""
    from scipy.io import savemat

    for name, values in variables.items():
        if getattr(values, "nbytes", 0) > LARGEST_VARIABLE:
            raise MitsimError(
                f"{path}: {name} takes {values.nbytes / 2**30:.3g} GiB, and MATLAB files of version 5 hold 2; "
                "use the format hdf5"
            )
    # A descriptor: given a name, savemat puts .mat behind it.
    with whole_file(path) as part, part.open("wb") as file:
        savemat(file, dict(variables), do_compression=True, long_field_names=True)


def read_variables(path: Path) -> dict[str, Any]:
    """Return the real arrays and texts of a MATLAB file of version 5; other classes are skipped.

    MitsimError for a file that is missing, damaged, of version 7.3, or does not fit into memory.
    """
    from scipy.io import loadmat, whosmat

    check_plain(path)
    try:
        with open(path, "rb") as file:
            listed = whosmat(file)  # by headers alone, because SciPy allocates whatever a file claims
            known = {name: math.prod(shape or ()) for name, shape, kind in listed if kind in _NUMBERS}
            if len(listed) > _MOST_VARIABLES or len({name for name, *_ in listed}) < len(listed):
                raise ValueError(f"it holds a variable twice, or over {_MOST_VARIABLES}")
            if max(known.values(), default=0) > LARGEST_VARIABLE:
                raise ValueError("a variable claims more than 2 GiB")
            Cost(memory_bytes=_COPIES * 8 * sum(known.values())).check(f"{path}", Limits())
            file.seek(0)
            found = loadmat(file, variable_names=[*known])
        return {name: values for name, values in found.items() if getattr(values, "dtype", np.dtype("U")).kind != "c"}
    except MitsimError:
        raise
    except NotImplementedError:
        raise MitsimError(f"{path}: is HDF5, or of version 7.3; save it in MATLAB with -v7") from None
    except Exception as error:  # SciPy's reader raises of all kinds
        raise MitsimError(f"{path}: damaged, or no MATLAB file ({reason_of(error)}); write or copy it again") from error
