"""Arrays and texts by name in; a MATLAB file of version 5 out, and back."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.output import whole_file
from mitsim.core.plainfile import check_plain

Variables = Mapping[str, Any]
LARGEST_VARIABLE = (1 << 31) - 1
"""Bytes of an array in a file of version 5."""


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
    """Names of the variables in the MATLAB file ``path``; MitsimError as for :func:`read_variables`."""
    from scipy.io import whosmat

    return frozenset(name for name, *_ in _looked_into(path, whosmat))


def read_variables(path: Path) -> dict[str, Any]:
    """The variables of the MATLAB file ``path``.

    MitsimError for a file that is missing, damaged or of version 7.3.
    """
    from scipy.io import loadmat

    return dict(_looked_into(path, loadmat))


def _looked_into(path: Path, look: Callable[..., Any]) -> Any:
    check_plain(path)
    try:
        with open(path, "rb") as file:
            return look(file)
    except NotImplementedError:
        raise MitsimError(f"{path}: is of version 7.3; save it in MATLAB with -v7") from None
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
