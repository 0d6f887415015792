"""Closed form of image formation: irradiance on every sensor pixel from light per (layer, anchor, tan-angle cell).

The shadow of a cell is separable, and so is the interpolation between anchors. The frame of one light distribution T is
``sum over layers and mask terms of L T R^T``, where the rows of T run over (anchor row, cell row) and its columns over
(anchor column, cell column). Only rows and columns that hold light enter the product. Behind a mask that is drawn on a
raster (:mod:`mitsim.optics.fft_shadow`), the frame of each pair of anchors is a correlation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import pairwise, product, starmap

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.parallel import in_threads
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.mask import FEW, RASTER_LEFT_OUT, Plate
from mitsim.devices.projector import Spectrum
from mitsim.optics.fft_shadow import (
    CORRELATION_PRODUCTS,
    RASTERS_KEPT,
    Correlation,
    cells_per_pixel,
    raster,
    terms_of_raster,
)
from mitsim.optics.shadow import Directions, Places, SeparableTerms, ShadowGeometry, lagrange_weights
from mitsim.optics.terms import shadow_terms

IntArray = npt.NDArray[np.integer]
Entries = tuple[IntArray, FloatArray]
"""Increasing indices into (layers, rows, columns), and the light [W m^-2] at each."""
_FILLED = 1 / 8
"""Part of all places above which light is laid out whole."""
_keep_shadow = lru_cache(maxsize=24)(shadow_terms)
SUMMED_BYTES = 2**28

_JUDGED = 64
_FINER = 2


# -------- One layer behind a mask, as terms or on a raster


@dataclass(frozen=True, eq=False)
class _Lit:
    rows: IntArray
    columns: IntArray
    lights: FloatArray

    @property
    def mean(self) -> FloatArray:
        return np.asarray(self.lights[0] if len(self.lights) == 1 else self.lights.mean(axis=0))


@dataclass(frozen=True, eq=False)
class _Terms:
    """One layer behind a mask of separable terms."""

    terms: SeparableTerms
    weights: tuple[FloatArray, FloatArray]

    def frame(self, lit: _Lit, out: FloatArray | None = None) -> FloatArray:
        lefts, rights = zip(*self._factors(lit), strict=True)
        # The cheaper order of the two products: fewer lit rows or fewer lit columns next to the sensor's side.
        if len(lefts[0]) < len(rights[0]):
            return np.matmul(_stack(lefts).T, _stack([lit.mean @ right for right in rights]), out=out)
        return np.matmul(_stack([lit.mean.T @ left for left in lefts]).T, _stack(rights), out=out)

    def probe(self, lit: _Lit, vectors: FloatArray | None) -> FloatArray:
        count, rows, columns = lit.lights.shape
        flat, total = lit.lights.reshape(count * rows, columns), np.zeros(())
        for left, right in self._factors(lit):
            seen = (flat @ (right if vectors is None else right @ vectors)).reshape(count, rows, -1)
            total = total + left.T @ np.moveaxis(seen, 0, 1).reshape(rows, -1)
        return total

    def _factors(self, lit: _Lit) -> list[tuple[FloatArray, FloatArray]]:
        return list(zip(self._side(0, lit.rows), self._side(1, lit.columns), strict=True))

    def _side(self, axis: int, places: IntArray) -> list[FloatArray]:
        every = self.weights[axis].shape[1] * self.terms[0][axis].shape[1]
        if len(places) == every and axis in self._whole:
            return self._whole[axis]
        anchor, cell = np.divmod(places, self.terms[0][axis].shape[1])
        weights = self.weights[axis].T[anchor]
        picked = [weights * term[axis].T[cell] for term in self.terms]
        return self._whole.setdefault(axis, picked) if len(places) == every else picked

    @cached_property
    def _whole(self) -> dict[int, list[FloatArray]]:
        return {}


@dataclass(frozen=True, eq=False)
class _Raster:
    """One layer behind a mask on a raster, as a sum of the largest terms (``summed``) or a correlation."""

    shadow: tuple[CameraGeometry, Directions, Directions, float, Spectrum | None]
    weights: tuple[FloatArray, FloatArray]
    places: Places | None
    summed: _Terms | None

    @cached_property
    def correlation(self) -> Correlation:
        return _correlation(*self.shadow)

    def frame(self, lit: _Lit, out: FloatArray | None = None) -> FloatArray:
        if self.summed and self._sums_take_less(self.summed, lit):
            return self.summed.frame(lit, out)
        return np.positive(self._image(lit, lit.mean), out=out)

    def probe(self, lit: _Lit, vectors: FloatArray | None) -> FloatArray:
        if self.summed and self._sums_take_less(self.summed, lit, vectors):
            return self.summed.probe(lit, vectors)
        seen = in_threads(partial(self._image, lit), lit.lights)
        return np.concatenate([frame if vectors is None else frame @ vectors for frame in seen], axis=1)

    def _sums_take_less(self, summed: _Terms, lit: _Lit, vectors: FloatArray | None = None) -> bool:
        geometry, *both, _, _ = self.shadow
        (near, far), (rows, columns) = sorted((len(lit.rows), len(lit.columns))), map(len, self.weights)
        across = columns if vectors is None else vectors.shape[1]
        held = 8 * len(summed.terms) * (near + far) * max(rows, columns)
        sides = zip((lit.rows, lit.columns), both, strict=True)
        pairs = math.prod(len(np.unique(places // len(each.centres))) for places, each in sides)
        correlation = CORRELATION_PRODUCTS * pairs * cells_per_pixel(geometry) ** 2 * math.prod(geometry.frame_shape)
        return 0 < held <= SUMMED_BYTES and len(summed.terms) * near * (far + rows) * across < correlation

    def _image(self, lit: _Lit, light: FloatArray) -> FloatArray:
        cells = [len(each.centres) for each in self.shadow[1:3]]
        (row_anchor, row), (column_anchor, column) = map(np.divmod, (lit.rows, lit.columns), cells)
        by_row, by_column = self.weights
        total = np.zeros((len(by_row), len(by_column)))
        for first, second in product(np.unique(row_anchor), np.unique(column_anchor)):
            inside = row_anchor == first, column_anchor == second
            part = light[np.ix_(*inside)]
            if part.any():
                seen = self.correlation.image(part, row[inside[0]], column[inside[1]])
                seen = seen if self.places is None else seen[np.ix_(*self.places)]
                total += by_row[:, first, None] * seen * by_column[:, second]
        return total


_Layer = _Raster | _Terms


class FrameOptics:
    """The closed form, prepared once; applying it changes nothing.

    ``depths`` of the layers are in mm, and ``anchors`` are the points per side of the sensor from which light is seen.
    ``spectrum`` is None for a geometric shadow. ``places`` are increasing rows and columns of a frame; None for all.
    """

    def __init__(
        self,
        geometry: CameraGeometry,
        rows: Directions,
        columns: Directions,
        depths: Sequence[float],
        anchors: int,
        spectrum: Spectrum | None = None,
        places: Places | None = None,
    ) -> None:
        positions = anchor_positions(anchors, geometry.half_width)
        centres = [geometry.centres(axis) for axis in (0, 1)]
        if places is not None:
            centres = [own[np.asarray(chosen)] for own, chosen in zip(centres, places, strict=True)]
        weights = anchor_weights(positions, centres[0]), anchor_weights(positions, centres[1])

        def layer(depth: float) -> _Layer:
            if geometry.is_correlated(spectrum is not None):
                shadow, summed = (geometry, rows, columns, depth, spectrum), None
                if geometry.is_drawn(spectrum is not None):
                    drawn, sides = raster(geometry, depth, spectrum), zip(weights, (rows, columns), strict=True)
                    numbers = sum(len(side) * len(each.centres) for side, each in sides)
                    # The terms up to 1e-4 of light are summed unless they exceed the memory limit.
                    if 8 * number_of_terms(drawn) * numbers <= SUMMED_BYTES:
                        cast = replace(ShadowGeometry.of(geometry, depth), mask=drawn)
                        others = geometry.pixel_fill_factor, places, drawn.terms
                        summed = _Terms(terms_of_raster(cast, rows, columns, *others), weights)
                return _Raster(shadow, weights, places, summed)
            many = geometry.mask_terms > FEW or geometry.mask_motion is not None
            form = shadow_terms if many else _keep_shadow
            return _Terms(form(geometry, rows, columns, depth, spectrum, places), weights)

        self._prepare([layer(depth) for depth in depths], (len(rows.centres), len(columns.centres)))

    @classmethod
    def of_terms(cls, layers: Sequence[SeparableTerms], weights: tuple[FloatArray, FloatArray]) -> FrameOptics:
        found = cls.__new__(cls)
        cells = layers[0][0][0].shape[1], layers[0][0][1].shape[1]
        found._prepare([_Terms(terms, weights) for terms in layers], cells)
        return found

    def _prepare(self, layers: Sequence[_Layer], cells: tuple[int, int]) -> None:
        self._layers, self.cells = layers, cells
        self.weights = layers[0].weights
        (rows, self.anchors), (columns, _) = (each.shape for each in self.weights)
        self.frame_shape = rows, columns
        self.shape = (self.anchors * cells[0], self.anchors * cells[1])

    @property
    def terms(self) -> list[SeparableTerms] | None:
        found = [layer.terms for layer in self._layers if isinstance(layer, _Terms)]
        return found if len(found) == len(self._layers) else None

    def frame(self, flat: IntArray, light: FloatArray) -> FloatArray:
        """Return the (m, m') irradiance of ``light`` [W m^-2] at increasing indices into (layers, *shape)."""
        return self.frame_and_products([(flat, light)], None)[0]

    def probe(self, estimates: Sequence[Entries], vectors: FloatArray | None = None) -> FloatArray:
        """Return the (m, estimates * probes) products of frames with ``vectors`` without forming the frames."""
        rows, columns = self.frame_shape
        total = np.zeros((rows, len(estimates) * (columns if vectors is None else vectors.shape[1])))
        for layer, lit in self._lit_layers(estimates):
            total += layer.probe(lit, vectors)
        return total

    def frame_and_products(
        self, estimates: Sequence[Entries], vectors: FloatArray | None, out: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the (m, m') mean frame of ``estimates``, and (m, estimates * probes) products of each one's.

        ``out``, if given, has to hold zeros.
        """
        probes = 0 if vectors is None else vectors.shape[1]
        frame, probed = None, np.zeros((self.frame_shape[0], len(estimates) * probes))
        for layer, lit in self._lit_layers(estimates, together=vectors is None):
            frame = layer.frame(lit, out) if frame is None else np.add(frame, layer.frame(lit), out=frame)
            if vectors is not None:
                probed += layer.probe(lit, vectors)
        if frame is None:
            frame = np.zeros(self.frame_shape) if out is None else out
        return frame, probed

    def _lit_layers(self, estimates: Sequence[Entries], together: bool = False) -> Iterator[tuple[_Layer, _Lit]]:
        size, split = self.shape[0] * self.shape[1], []
        for every, light in estimates:
            starts = np.arange(len(self._layers) + 1, dtype=every.dtype) * every.dtype.type(size)
            inside = starmap(slice, pairwise(np.searchsorted(every, starts)))
            split.append([(every[part] - start, light[part]) for start, part in zip(starts, inside, strict=False)])
        for of_depth, parts in zip(self._layers, zip(*split, strict=True), strict=True):
            most = max(len(place) for place, _ in parts)
            if not most:
                continue
            rows, columns = (np.arange(count) for count in self.shape)
            flat = [place for place, _ in parts]
            if most < _FILLED * self.shape[0] * self.shape[1]:  # only rows and columns that hold light
                places = [np.divmod(place, self.shape[1]) for place in flat]
                lit = tuple(np.zeros(count, bool) for count in self.shape)
                for place in places:
                    lit[0][place[0]], lit[1][place[1]] = True, True
                rows, columns = np.flatnonzero(lit[0]), np.flatnonzero(lit[1])
                row_of, column_of = (np.cumsum(lit[0]) - 1) * len(columns), np.cumsum(lit[1]) - 1
                flat = [row_of[row] + column_of[column] for row, column in places]
            lights = np.zeros((1 if together else len(parts), len(rows) * len(columns)))
            for number, (place, (_, values)) in enumerate(zip(flat, parts, strict=True)):
                lights[0 if together else number, place] += values
            if together:
                lights /= len(parts)
            yield of_depth, _Lit(rows, columns, lights.reshape(-1, len(rows), len(columns)))


def raster_error(
    geometry: CameraGeometry,
    rows: Directions,
    columns: Directions,
    depth: float,
    spectrum: Spectrum | None,
    light: FloatArray,
) -> tuple[float, bool]:
    """Return the relative rms error of a raster's frame on a few pixels about the axis.

    The second value is True if the reference is the sum of the mask's terms, and False if it is a raster of half the
    cells.
    """
    side = min(*geometry.shape, _JUDGED)
    few = geometry.model_copy(update={"pixels": side, "rows": None, "columns": None, "roi": None})
    row, column = (np.arange(len(each.centres)) for each in (rows, columns))

    def frame(finer: int) -> FloatArray:
        drawn = few.model_copy(update={"mask_cells": finer * cells_per_pixel(few)})
        shadow = replace(ShadowGeometry.of(drawn, depth), mask=raster(drawn, depth, spectrum))
        if finer == 1 and not known and math.isfinite(number_of_terms(raster(drawn, depth, spectrum))):
            # The frame is formed as in a run, so that the error includes the terms that are left out.
            return sum_of(terms_of_raster(shadow, rows, columns, drawn.pixel_fill_factor, None, shadow.mask.terms))
        return Correlation(shadow, rows, columns, drawn.pixel_fill_factor).image(light, row, column)

    def sum_of(terms: SeparableTerms) -> FloatArray:
        return np.asarray(sum(left @ light @ right.T for left, right in terms))

    known = not few.is_drawn(spectrum is not None)
    coarse = frame(1)
    judge = sum_of(shadow_terms(few, rows, columns, depth, spectrum)) if known else frame(_FINER)
    energy = float(np.square(judge).sum())
    error = float(np.sqrt(np.square(coarse - judge).sum() / energy)) if energy else 0.0
    return error, known


def number_of_terms(drawn: Plate) -> float:
    return drawn.largest.count if drawn.largest.left_out <= RASTER_LEFT_OUT else math.inf


@lru_cache(maxsize=RASTERS_KEPT)
def _correlation(
    geometry: CameraGeometry, rows: Directions, columns: Directions, depth: float, spectrum: Spectrum | None
) -> Correlation:
    shadow = replace(ShadowGeometry.of(geometry, depth), mask=raster(geometry, depth, spectrum))
    return Correlation(shadow, rows, columns, geometry.pixel_fill_factor)


def _stack(parts: Sequence[FloatArray]) -> FloatArray:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


# -------- Points of the sensor from which radiance is evaluated, and the weights that interpolate between them


def anchor_positions(count: int, half_width: float) -> FloatArray:
    """Return the coordinates of anchors on a sensor of ``half_width``: Chebyshev nodes."""
    k = np.arange(count)
    return -half_width * np.cos(np.pi * (2 * k + 1) / (2 * count))


def anchor_weights(anchors: Sequence[float] | FloatArray, at: FloatArray) -> FloatArray:
    return np.stack(lagrange_weights(at, np.asarray(anchors, dtype=np.float64)), axis=1)
