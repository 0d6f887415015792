"""One specimen of a camera: a model and a frame's size in, what is fixed in space out, the same in every frame.

Offsets, responses and dark currents of single pixels, rows and columns (EMVA 1288 4.0, "spatial nonuniformity") and
defects follow from the model's `pattern_seed` and the size of a frame alone. Numbers are per superpixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.seeds import stream
from mitsim.devices.sensor import SensorModel

Map = npt.NDArray[np.float32]
"""(rows, columns) numbers of seven digits, more than any is known to."""
_MOST_MAPS = 2
"""Specimens that are kept: frames of a run have one size, and a test's may have two."""


@dataclass(frozen=True, eq=False)
class Specimen:
    """What is fixed in space of a camera; None is no difference between pixels.

    Attributes
    ----------
    offset_e
        (rows, columns) what a pixel reads beyond the black level without charge [electrons]; mean 0.
    response
        (rows, columns) a pixel's response to light over the mean of undamaged ones; 0 is dead.
    dark_e_per_s
        (rows, columns) dark current at the sensor's temperature, hot pixels' too.
    hot, dead
        how many superpixels have a hot pixel, and a dead one.
    """

    offset_e: Map | None
    response: Map | None
    dark_e_per_s: Map | None
    hot: int = 0
    dead: int = 0


@lru_cache(maxsize=_MOST_MAPS)
def specimen(model: SensorModel, shape: tuple[int, int]) -> Specimen:
    """The specimen that ``model.pattern_seed`` names, for frames of ``shape`` (rows, columns)."""
    hot, dead = (_defects(model, shape, kind) for kind in ("hot", "dead"))
    return Specimen(
        offset_e=_parts(model, shape, "offset", model.offset_parts),
        response=_response(model, shape, dead),
        dark_e_per_s=_dark_current(model, shape, hot),
        hot=0 if hot is None else int(np.count_nonzero(hot)),
        dead=0 if dead is None else int(np.count_nonzero(dead)),
    )


def response_variance(model: SensorModel) -> float:
    """Variance over pixels of the ``model``'s response, whose mean is that of undamaged pixels (1) less dead ones.

    With p of the pixels dead, b^2 in a superpixel: (1 + sum s^2) (q^2 + p q / b^2) - q^2, q = 1 - p.
    """
    dead, alive = model.dead_pixels, 1 - model.dead_pixels
    spread = sum(part**2 for part in model.response_parts)
    return (1 + spread) * (alive**2 + dead * alive / model.binning**2) - alive**2


def dark_current_variance(model: SensorModel) -> float:
    """Variance over superpixels of the ``model``'s dark current [(electrons/s)^2]: b^2 (s^2 + p (1 - p) h^2)."""
    hot = model.hot_pixels * (1 - model.hot_pixels) * model.hot_dark_current_e_per_s**2
    return (model.binning * model.dark_factor) ** 2 * (model.dark_current_spread_e_per_s**2 + hot)


def mean_dark_current(model: SensorModel) -> float:
    """Mean over superpixels of the ``model``'s dark current, hot pixels' too [electrons/s]."""
    hot = model.hot_pixels * model.hot_dark_current_e_per_s * model.binning**2 * model.dark_factor
    return model.superpixel_dark_current_e_per_s + hot


def _parts(model: SensorModel, shape: tuple[int, int], name: str, parts: tuple[float, float, float]) -> Map | None:
    """Sum of independent normal parts by pixel, row and column, of these standard deviations; None without any."""
    if not any(parts):
        return None
    total = np.zeros(shape, dtype=np.float32)
    sizes = shape, (shape[0], 1), (1, shape[1])
    for deviation, kind, size in zip(parts, ("pixel", "row", "column"), sizes, strict=True):
        if deviation:
            total += deviation * stream(model.pattern_seed, name, kind).standard_normal(size, dtype=np.float32)
    return total


def _response(model: SensorModel, shape: tuple[int, int], dead: Map | None) -> Map | None:
    spread = _parts(model, shape, "response", model.response_parts)
    if spread is None and dead is None:
        return None
    response = np.ones(shape, dtype=np.float32) if spread is None else np.maximum(1 + spread, np.float32(0))
    return response if dead is None else np.asarray(response * (1 - dead / model.binning**2), dtype=np.float32)


def _dark_current(model: SensorModel, shape: tuple[int, int], hot: Map | None) -> Map | None:
    """Gamma distributed, which is never below zero, and whose sums over the pixels that are binned are gamma too."""
    if not model.dark_current_spread_e_per_s and hot is None:
        return None
    mean, spread = model.dark_current_e_per_s, model.dark_current_spread_e_per_s
    if spread:
        drawn = stream(model.pattern_seed, "dark current").standard_gamma((mean * model.binning / spread) ** 2, shape)
        dark = (spread**2 / mean) * drawn
    else:
        dark = np.full(shape, mean * model.binning**2)
    if hot is not None:
        dark += model.hot_dark_current_e_per_s * hot
    return np.asarray(model.dark_factor * dark, dtype=np.float32)


def _defects(model: SensorModel, shape: tuple[int, int], kind: str) -> Map | None:
    """How many pixels of each superpixel are ``hot`` or ``dead``; None where the model has none of this ``kind``."""
    part = model.hot_pixels if kind == "hot" else model.dead_pixels
    if not part:
        return None
    count = math.prod(shape)
    pixels = count * model.binning**2
    chosen = stream(model.pattern_seed, kind).choice(pixels, round(part * pixels), replace=False)
    return np.bincount(chosen % count, minlength=count).reshape(shape).astype(np.float32)


def neighbours(light: FloatArray, part: float) -> FloatArray:
    """``light`` (rows, columns) of which each pixel's four neighbours have got a ``part``, a quarter each.

    Beyond the edge lies what lies at the edge, so even light stays even.
    """
    around = np.pad(light, 1, mode="edge")
    shared = around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:]
    return np.asarray((1 - part) * light + (part / 4) * shared)
