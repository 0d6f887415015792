"""Dr.Jit values on the host: from arrays of the renderer, which may hold one number for all lanes, to NumPy's."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray

if TYPE_CHECKING:
    import mitsuba as mi


def per_lane(values: mi.Float, count: int) -> npt.NDArray[Any]:
    """(count,) of a Dr.Jit array ``values`` of ``count`` numbers or one; real numbers in double precision."""
    array = np.array(values)
    array = array.astype(np.float64) if array.dtype.kind == "f" else array
    return np.broadcast_to(array.reshape(-1), (count,))


def vectors(values: mi.Vector3f, count: int) -> FloatArray:
    """(``count``, 3) of a Dr.Jit vector ``values``."""
    return np.stack([per_lane(part, count) for part in (values.x, values.y, values.z)], axis=1)


def channels(spectrum: mi.UnpolarizedSpectrum, count: int) -> FloatArray:
    """(``count``, channels) of a ``spectrum``."""
    return np.stack([per_lane(spectrum[i], count) for i in range(len(spectrum))], axis=1)
