"""Blocks of projector pixels whose indirect light is followed more often than that of others.

From how noisy each block's light is to how many paths each takes in a sample, and from a lane to its block. With m_b
the second moment of a path's light, paths in proportion to sqrt(m_b) leave the least variance for their number; a
sample holds the mean of a block's paths, so that the light stays what it is whatever the numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray, mean_of_neighbours

SIDE = 4
"""Pixels a side of a block, below the 7 of usual shifting dots, whose classes then differ."""
MEMBERS = SIDE**2
"""Pixels of a block."""
_MOST = 8
"""Paths of a pixel in a sample, at most: what a short look takes for noisy may be a single path."""
_SCALES = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)
"""Paths of a block of mean noise that are tried: whole numbers fit one scale better than another."""


def blocks_of(pixels: int) -> int:
    """Blocks a side of ``pixels``."""
    return -(-pixels // SIDE)


def block_moments(pixel: npt.NDArray[np.int64], light: FloatArray, pixels: int) -> FloatArray:
    """(blocks, blocks) sums of squares of ``light`` by the block of its ``pixel``.

    Parameters
    ----------
    pixel, light
        (m,) of paths.
    pixels
        of the projector, a side.
    """
    row, column = np.divmod(pixel, pixels)
    count = blocks_of(pixels)
    place = row // SIDE * count + column // SIDE
    return np.asarray(np.bincount(place, np.square(light), count**2).reshape(count, count), dtype=np.float64)


def chosen_repeats(moments: FloatArray) -> npt.NDArray[np.int64]:
    """(blocks, blocks) paths of each block's pixels in a sample, of the least variance times cost.

    ``moments`` (blocks, blocks) are smoothed over neighbours first; blocks without light count a tenth of the mean.
    """
    if not moments.any():
        return np.ones(moments.shape, dtype=np.int64)
    smooth = mean_of_neighbours(moments)
    wanted = np.sqrt(smooth + 0.1 * smooth.mean())
    tried = [np.clip(np.rint(scale * wanted / wanted.mean()), 1, _MOST).astype(np.int64) for scale in _SCALES]
    return min(tried, key=lambda repeats: float(np.prod(effect_of(repeats, smooth))))


def effect_of(repeats: npt.NDArray[np.int64], moments: FloatArray) -> tuple[float, float]:
    """Variance and paths of a sample with ``repeats``, each over those without, by ``moments`` of the light."""
    total = float(moments.sum())
    return float((moments / repeats).sum()) / total if total else 1.0, float(repeats.mean())


@dataclass(frozen=True, eq=False)
class Turns:
    """Which block, or pixel, each of a sample's units of paths belongs to.

    Attributes
    ----------
    unit, turn, count
        (units,) its number, which of its paths in the sample this is, and how many there are.
    """

    unit: mi.UInt32
    turn: mi.UInt32
    count: mi.UInt32

    @classmethod
    def of(cls, repeats: npt.NDArray[np.int64]) -> Turns:
        """Those of units that have so many ``repeats`` (units,)."""
        unit = np.repeat(np.arange(len(repeats)), repeats)
        starts = np.cumsum(repeats) - repeats
        turn = np.arange(len(unit)) - starts[unit]
        return cls(*(mi.UInt32(each.astype(np.uint32)) for each in (unit, turn, repeats[unit])))

    def __len__(self) -> int:
        return int(dr.width(self.unit))

    def at(self, index: mi.UInt32, sample: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.Float]:
        """Unit, number of its own sample, and weight of entry ``index`` in ``sample``."""
        unit, turn, count = (dr.gather(mi.UInt32, each, index) for each in (self.unit, self.turn, self.count))
        return unit, sample * count + turn, dr.rcp(mi.Float(count))


def by_pixel(repeats: Sequence[int], pixels: int) -> npt.NDArray[np.int64]:
    """(pixels^2,) repeats of each pixel, from those of the blocks row by row.

    Parameters
    ----------
    repeats
        of (blocks^2,) blocks.
    pixels
        a side.
    """
    count = blocks_of(pixels)
    whole = np.kron(np.reshape(repeats, (count, count)), np.ones((SIDE, SIDE), dtype=np.int64))
    return np.ascontiguousarray(whole[:pixels, :pixels]).ravel()
