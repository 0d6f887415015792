"""One estimate of the light of a scene: sparse matrices of light by grid, which add up and divide as numbers do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import reduce
from operator import add
from typing import Any

import numpy as np
from scipy import sparse

from mitsim.core.arrays import FloatArray

MEAN_GRIDS = ("fine", "indirect")
"""Grids of what the sensor sees on average."""


@dataclass(frozen=True, eq=False)
class LightEstimate:
    """Light by grid (:data:`mitsim.light.grids.GRIDS`), (classes + 1, places) each, the last row ambient light
    [W m^-2], or one of the last for each band of its wavelengths.

    Attributes
    ----------
    light
        by the name of the grid; of all grids.
    received, outside
        all light, a mean over the sensor without its mask, and what of it came from beyond all cells: it is in no
        frame [W m^-2].
    flux
        (n^2,) irradiance of each projector pixel's direct light on the sensor, its mean, without the mask [W m^-2];
        None where no pass told it.
    """

    light: Mapping[str, sparse.csr_array]
    received: float = 0.0
    outside: float = 0.0
    flux: FloatArray | None = None

    def __getitem__(self, grid: str) -> sparse.csr_array:
        return self.light[grid]

    def __add__(self, other: LightEstimate) -> LightEstimate:
        return LightEstimate(*(_sum(getattr(self, each.name), getattr(other, each.name)) for each in fields(self)))

    def __truediv__(self, count: float) -> LightEstimate:
        return LightEstimate(*(_divided(getattr(self, each.name), count) for each in fields(self)))

    def with_light(self, light: Mapping[str, sparse.csr_array]) -> LightEstimate:
        """The same with other ``light`` in some grids."""
        return replace(self, light={**self.light, **light})

    @property
    def rows(self) -> int:
        """Classes, and rows of ambient light."""
        return int(self.light[MEAN_GRIDS[0]].shape[0])

    @property
    def totals(self) -> FloatArray:
        """(rows,) light of each row, a mean over the sensor, but for pixels that are traced apart [W m^-2]."""
        return np.asarray(reduce(add, (self.light[grid].sum(axis=1) for grid in MEAN_GRIDS)), dtype=np.float64)


def _sum(one: Any, other: Any) -> Any:
    """Of numbers, matrices, or several of them; a matrix to which nothing is added is not copied."""
    if one is None or other is None:
        return one if other is None else other
    if isinstance(one, Mapping):
        return {name: _sum(light, other[name]) for name, light in one.items()}
    if not isinstance(one, sparse.csr_array) or (one.nnz and other.nnz):
        return one + other
    return one if one.nnz else other


def _divided(light: Any, count: float) -> Any:
    """Numbers or matrices over ``count``; SciPy would copy where a matrix has its light, which lines may share."""
    if light is None:
        return None
    if isinstance(light, Mapping):
        return {name: _divided(each, count) for name, each in light.items()}
    if not isinstance(light, sparse.csr_array):
        return light / count
    return sparse.csr_array((light.data * (1 / count), light.indices, light.indptr), shape=light.shape)
