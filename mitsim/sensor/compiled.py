"""Stages of a frame as one compiled kernel: arrays and random streams in, numbers of every pixel out.

Once light is known, noise is most of what a frame costs: two normal deviates a pixel and some twenty operations. Dr.Jit
makes one kernel of them for all processors, which takes a quarter of the time of numpy in as many threads.

Deviates are found by counter (Philox; Salmon, Moraes, Dror and Shaw 2011, "Parallel random numbers: as easy as 1, 2,
3"): a pixel has its own, whatever is drawn for others and on however many threads. A counter gives four of them, so a
lane of the kernel has four pixels, a quarter of a block apart. Deviates are float32, all else is float64.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import compiled_arrays

LANE = 4
"""Pixels of a lane: the deviates that a counter gives."""
_BLOCK = 2**22
"""Pixels that go through the stages at a time: 32 MiB of each array, where a sensor may have 2^28."""
_turn = threading.Lock()
"""Held while stages are described and run: threads that take turns at each operation take twice as long."""

Numbers = Mapping[str, float | tuple[float, ...] | None]
"""What all pixels share, by name."""


def operations(values: Any) -> ModuleType:
    """Where minimum, sqrt, square, round and clip of ``values`` are: in numpy, or, for arrays of its own, in Dr.Jit."""
    return np if isinstance(values, np.ndarray | float) else compiled_arrays()[0]


def by_pixel(
    stages: Callable[..., Any],
    numbers: Numbers,
    arrays: Sequence[FloatArray | float | None],
    streams: Sequence[np.random.Generator],
    dtype: npt.DTypeLike = np.float64,
) -> npt.NDArray[Any]:
    """(pixels,) what ``stages`` make of every pixel.

    Parameters
    ----------
    stages
        of a namespace of the numbers, a value of each of the arrays, and a normal deviate of each of the streams. It is
        called with Dr.Jit's arrays and describes what to do; it need not be the same function twice.
    numbers
        what all pixels share; other values need no new kernel.
    arrays
        (pixels,) each, the first at least; or floats that all pixels share; None stays None.
    streams
        each gives the key of its deviates, in one draw.
    dtype
        of the result, np.uint32 or np.float64.
    """
    keys = [int(stream.bit_generator.random_raw()) for stream in streams]
    size = len(arrays[0])  # type: ignore[arg-type]
    result = np.empty(size, dtype)
    for start in range(0, size, _BLOCK):
        block = slice(start, min(start + _BLOCK, size))
        parts = [values[block] if isinstance(values, np.ndarray) else values for values in arrays]
        with _turn:
            _run(stages, numbers, parts, keys, start // LANE, result[block])
    return result


def _run(
    stages: Callable[..., Any],
    numbers: Numbers,
    arrays: Sequence[FloatArray | float | None],
    keys: Sequence[int],
    first: int,
    result: npt.NDArray[Any],
) -> None:
    """Fill the ``result`` of one block, whose first lane is ``first``."""
    dr, types = compiled_arrays()
    quarter = -(-len(result) // LANE)

    def shared(value: float | None) -> Any:
        return None if value is None else dr.opaque(types.Float64, value, 1)

    def quarters(values: FloatArray | float | None) -> Sequence[Any]:
        if not isinstance(values, np.ndarray):
            return [shared(values)] * LANE
        if len(values) < LANE * quarter:
            values = np.pad(values, (0, LANE * quarter - len(values)), mode="edge")
        return [types.Float64(part) for part in values.reshape(LANE, quarter)]

    every = SimpleNamespace(**{
        name: tuple(map(shared, value)) if isinstance(value, tuple) else shared(value)
        for name, value in numbers.items()
    })  # fmt: skip
    lane = dr.opaque(types.UInt32, first, 1) + dr.arange(types.UInt32, quarter)
    deviates = [types.Philox4x32(dr.opaque(types.UInt64, key, 1), lane).next_float32x4_normal() for key in keys]
    values = [quarters(array) for array in arrays]
    kind = types.UInt32 if result.dtype == np.uint32 else types.Float64
    filled = [
        kind(stages(every, *(value[k] for value in values), *(types.Float64(four[k]) for four in deviates)))
        for k in range(LANE)
    ]
    dr.eval(filled)
    dr.sync_thread()
    for k, part in enumerate(filled):
        room = result[k * quarter : (k + 1) * quarter]
        room[...] = np.asarray(part)[: len(room)]
