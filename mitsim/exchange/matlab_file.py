"""Arrays and texts by name in; a MATLAB file of version 5 out, and back."""

from __future__ import annotations

import math
import os
import struct
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.output import whole_file
from mitsim.core.plainfile import check_plain
from mitsim.core.resources import Cost, Limits

Variables = Mapping[str, Any]
LARGEST_VARIABLE = (1 << 31) - 1
"""Bytes of an array in a file of version 5."""
_HEAD = 128
"""Bytes before the first variable: a text, the version and the order of bytes."""
_HDF5, _HDF5_MARK = 2, b"\x89HDF\r\n\x1a\n"
"""Version of a file that is an HDF5 file behind its head."""
_MATRIX, _COMPRESSED = 14, 15
"""Kinds of elements: an array, and one that is packed."""
_COMPLEX = 0x08
"""Bit of an array's flags: its numbers are complex."""
_BYTES_OF = {4: 4, 6: 8, 7: 4, 8: 1, 9: 1, 10: 2, 11: 2, 12: 4, 13: 4, 14: 8, 15: 8}
"""Bytes of a number that SciPy reads, by class: letters, double, single, whole numbers of 8 to 64 bits."""
_BEGINNING = 4096
"""Bytes of a variable that its flags, shape and name lie in; a name has 63 letters at most."""
_PADDING = 16
"""Bytes after a variable's shape and name that are no numbers: a tag, and what fills up to 8."""
_MOST_VARIABLES = 10_000
"""Of a file; a run in 16 colours has 200."""
_COPIES = 3
"""Arrays of a variable's size that are held at once: as stored, of its class, and as a run's."""


def write_variables(path: Path, variables: Variables) -> None:
    """Write ``variables`` to a MATLAB file at ``path``, whole or not at all.

    MitsimError for an array that is larger than such files hold.
    """
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


def names_in(path: Path) -> frozenset[str]:
    """Names of the arrays and texts in the MATLAB file ``path``; MitsimError as for :func:`read_variables`."""
    return frozenset(_looked_into(path, _arrays_in))


def read_variables(path: Path) -> dict[str, Any]:
    """The arrays of real numbers and the texts of the MATLAB file ``path``, by name; cells, structures and objects,
    which files of `mitsim export` and FlatCam have none of, are not looked into.

    MitsimError for a file that is missing, damaged, of version 7.3 or 4, or that takes more memory than is free.
    """
    from scipy.io import loadmat

    arrays = _looked_into(path, _arrays_in)
    Cost(memory_bytes=_COPIES * sum(arrays.values())).check(f"{path}", Limits())
    return dict(_looked_into(path, lambda file: loadmat(file, variable_names=[*arrays])))


def _arrays_in(file: BinaryIO) -> dict[str, int]:
    """Bytes that each array of real numbers and each text of an open MATLAB ``file`` takes, by name.

    SciPy's readers allocate what a file claims, and call themselves for each cell within a cell until the process
    ends. Here no more than the beginning of each variable is unpacked, after "MAT-File Format" (MathWorks).
    """
    head = file.read(_HEAD)
    mark = head[_HEAD - 2 :]
    if head.startswith(_HDF5_MARK):
        raise NotImplementedError
    if len(head) < _HEAD or mark not in (b"IM", b"MI"):
        raise ValueError("it does not begin as one of version 5")
    order = "<" if mark == b"IM" else ">"
    if struct.unpack(f"{order}H", head[_HEAD - 4 : _HEAD - 2])[0] >> 8 == _HDF5:
        raise NotImplementedError
    two, found = f"{order}2I", dict[str, int]()
    end = file.seek(0, os.SEEK_END)
    place = _HEAD
    while place + 8 <= end:
        file.seek(place)
        kind, length = struct.unpack(two, file.read(8))
        place += 8 + length
        if place > end:
            raise ValueError("it ends within a variable")
        beginning = file.read(min(length, _BEGINNING))
        if kind == _COMPRESSED:
            beginning = zlib.decompressobj().decompress(beginning, _BEGINNING)
            kind, length = struct.unpack_from(two, beginning)
            beginning = beginning[8:]
        if kind != _MATRIX:
            raise ValueError(f"it holds an element of the kind {kind}")
        named = _array(beginning, length, order)
        if named is not None:
            if named[0] in found or len(found) == _MOST_VARIABLES:
                raise ValueError(f"it holds {named[0]!r} twice, or over {_MOST_VARIABLES} variables")
            found[named[0]] = named[1]
    return found


def _array(beginning: bytes, length: int, order: str) -> tuple[str, int] | None:
    """Name and bytes of an array of real numbers or a text that begins so, of ``length`` bytes in the file; None of
    another. ValueError where it claims other bytes than its shape has."""
    flags, place = _element(beginning, 0, order)
    (flag,) = struct.unpack_from(f"{order}I", flags)
    size = _BYTES_OF.get(flag & 0xFF)
    if size is None or flag >> 8 & _COMPLEX:
        return None
    dimensions, place = _element(beginning, place, order)
    name, place = _element(beginning, place, order)
    sides = struct.unpack(f"{order}{len(dimensions) // 4}i", dimensions)
    count = math.prod(sides)
    if len(sides) < 2 or min(sides) < 0 or count * size > LARGEST_VARIABLE:
        raise ValueError(f"its variable {name[:80]!r} claims a shape of {sides[:8]}")
    # Numbers are stored as the smallest type that holds them, and never as a larger one than they are of.
    stored, _ = _tag(beginning, place, order)
    if stored > count * size or length > place + count * size + _PADDING:
        raise ValueError(f"its variable {name[:80]!r} claims more bytes than its shape has")
    return name.decode("ascii"), count * size


def _tag(data: bytes, place: int, order: str) -> tuple[int, int]:
    """Bytes of an element's content at a ``place``, and where it begins."""
    kind, length = struct.unpack_from(f"{order}2I", data, place)
    return (kind >> 16, place + 4) if kind >> 16 else (length, place + 8)


def _element(data: bytes, place: int, order: str) -> tuple[bytes, int]:
    """Content of an element at a ``place``, and where the next one begins."""
    length, start = _tag(data, place, order)
    if start + length > len(data):
        raise ValueError(f"a name or shape in it takes {length} bytes")
    return data[start : start + length], place + 8 if start == place + 4 else start + -(-length // 8) * 8


def _looked_into(path: Path, look: Callable[..., Any]) -> Any:
    check_plain(path)
    try:
        with open(path, "rb") as file:
            return look(file)
    except NotImplementedError:
        raise MitsimError(f"{path}: is HDF5 (version 7.3); save it in MATLAB with -v7, or name an export .h5") from None
    except Exception as error:  # SciPy's reader raises of all kinds
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MitsimError(f"{path}: damaged, or no MATLAB file ({reason}); write or copy it again") from error


def text_in(variables: Variables, name: str, path: Path) -> str:
    """A text of a file.

    Parameters
    ----------
    variables
        of the file.
    name
        of the one that is wanted.
    path
        of the file, for messages.

    Raises
    ------
    MitsimError
        where there is none.
    """
    value = np.asarray(variables.get(name))
    if value.dtype.kind != "U" or value.size != 1:
        raise MitsimError(
            f"{path}: has no text {name}, so it is not of `mitsim export`; it holds "
            f"{', '.join(key for key in variables if not key.startswith('__'))}"
        )
    return str(value.item())


def array_in(variables: Variables, name: str, shape: tuple[int, ...], path: Path) -> npt.NDArray[Any]:
    """An array of a file.

    Parameters
    ----------
    variables
        of the file.
    name, shape
        of the one that is wanted; MATLAB drops axes of length 1 at the end.
    path
        of the file, for messages.

    Raises
    ------
    MitsimError
        where it is missing, or not of real numbers in that shape.
    """
    array = np.asarray(variables.get(name))
    if array.dtype.kind not in "uif" or array.size != math.prod(shape):
        told = f"is {array.dtype} of shape {array.shape}" if name in variables else "is missing"
        raise MitsimError(f"{path}: {name} {told}; numbers of shape {shape} are needed")
    return array.reshape(shape, order="F")


def matrix_in(variables: Variables, name: str, path: Path) -> FloatArray:
    """A matrix of a file, of any size.

    Parameters
    ----------
    variables
        of the file.
    name
        of the one that is wanted.
    path
        of the file, for messages.

    Raises
    ------
    MitsimError
        where it is missing, or no matrix of real numbers.
    """
    matrix = np.asarray(variables.get(name))
    if matrix.ndim != 2 or matrix.dtype.kind not in "uif":
        raise MitsimError(
            f"{path}: {name} is {'no matrix of numbers' if name in variables else 'missing'}; write it again"
        )
    return matrix.astype(np.float64)
