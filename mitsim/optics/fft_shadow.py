"""Shadow of masks without few separable terms, drawn on a raster of square cells.

A sensor pixel as seen on the mask is a whole number of cells, whose values are means. A point at depth z and tan-angle
tau shades sensor point u by the raster's value at s = u (1 - d/z) + d tau. Means over cells add a variance of h^2 / 6
to an edge. A twelfth of the second difference along each axis is subtracted, which corrects half of it. The field
behind a mask of several terms is a sum: each term contributes the product of two 1-D fields
(:mod:`mitsim.optics.diffraction`). Its |U|^2 is averaged over points in each cell, and over the spectral lines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import scipy

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import in_threads
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.mask import NO_FLAWS, Flaws, Mask, Plate, Term
from mitsim.devices.projector import Spectrum
from mitsim.optics.diffraction import EdgeWaves, grid_step, wave_profiles
from mitsim.optics.shadow import Directions, Places, SeparableTerms, ShadowGeometry, Steps, blurred_step

_CELLS_PER_PIXEL = 6
"""Raster cells along a pixel: with 4 the error doubles (tests/physics/test_raster.py). In pixels of 12 um, random masks
of 1 and 4 um features err by 2e-4 and 1e-3 in waves at 6.
"""
_FEW_CELLS = 2
_LEFT_BEYOND = 1e-3
_LARGEST = 8192
"""Cells per side: 512 MiB."""
_POINTS, _LATTICE = 16, 7
_POINTS_PER_FRESNEL_LENGTH = 80
"""Points in sqrt(lambda D) at which waves are squared; the error is about 3e-4 (tests/physics/test_raster.py)."""
_MOST_WAVE_POINTS = 1 << 16
"""Largest number of points per side: a minute per line."""
_MOST_WAVE_TERMS = 2.0**39
"""Largest number of points times terms: 40 processor seconds per line (mitsim.light.cost_model)."""
_LEAST_WAVE_POINTS = 2
"""Least number of points along a cell."""
_GRID_CELLS = 3
"""Least number of the field's grid cells between points."""
_AROUND = 8
CORRELATION_PRODUCTS = 30.0
"""Cost of a correlation in multiplications per pixel and phase, for each pair of anchors and layer
(benchmarks/masks.py).
"""
RASTERS_KEPT = 8
_FIELDS_AT_ONCE = 8
"""Fields that are computed together."""
_AT_ONCE = 2**20


def raster(geometry: CameraGeometry, depth: float, spectrum: Spectrum | None = None) -> Plate:
    """Return the shadow of a point at ``depth`` [mm] as a plate of square cells; geometric if ``spectrum`` is None.

    Raises MitsimError if the raster has too many cells, or waves behind the mask cannot be computed.
    """
    # Both choices of the user give one cache entry, so that a run has the raster of its plan.
    chosen = {"mask_fft": False, "mask_cells": cells_per_pixel(geometry)}
    return draw_raster(geometry.model_copy(update=chosen), depth, spectrum)


@lru_cache(maxsize=RASTERS_KEPT)
def draw_raster(geometry: CameraGeometry, depth: float, spectrum: Spectrum | None) -> Plate:
    mask, shadow = geometry.build_mask(), ShadowGeometry.of(geometry, depth)
    assert isinstance(mask, Plate), "other masks have a closed form"
    step = geometry.pixel_pitch * shadow.shrink / cells_per_pixel(geometry)
    count = cells_a_side(geometry, spectrum, shadow.shrink)
    if count > _LARGEST:
        problem = f"{mask.words}: its shadow needs a raster of {count} cells a side, more than {_LARGEST}"
        raise MitsimError(f"{problem}; take fewer pixels, larger features, or a mask of one or two separable terms")
    if mask.irradiance:
        values = _resample(mask, step, count)
    elif spectrum is None:
        values = sharpen((_turned_means if mask.flaws.turn_deg else _resample)(mask, step, count))
    else:
        values = sharpen(_waves(replace(shadow, mask=mask.amplitude), spectrum, step, count))
    active = int(min(geometry.active_sides) / geometry.pixel_pitch * cells_per_pixel(geometry))
    flaws = Flaws(mask.blur_mm if spectrum is None else 0.0)
    return Plate(step, values, mask.words, flaws=flaws, irradiance=True, averaged=max(active, 1))


def cells_a_side(geometry: CameraGeometry, spectrum: Spectrum | None, shrink: float = 1.0) -> int:
    """Return the cells per side for the visible part of the mask and the light that waves carry beyond.

    An edge sends lambda D / (4 pi^2 x) of light, as a length, beyond x; a mean opening has two edges per axis.
    """
    mask, step = geometry.build_mask(), geometry.pixel_pitch * shrink / cells_per_pixel(geometry)
    assert isinstance(mask, Plate)
    half = mask.flaws.reach(mask.extent_mm) / 2
    if spectrum is not None and not mask.irradiance:
        product = float(spectrum.wavelengths_nm.max()) * 1e-6 * geometry.mask_distance
        half += product / (np.pi**2 * mask.opening_mm * _LEFT_BEYOND)
    return 2 * int(np.ceil(min(geometry.mask_reach, half) / step))


def check_waves(geometry: CameraGeometry, spectrum: Spectrum) -> None:
    """Raise MitsimError if waves behind this mask would take longer than a minute per line."""
    mask = geometry.build_mask()
    if not isinstance(mask, Plate) or mask.irradiance or not geometry.is_drawn(waves=True):
        return
    step = geometry.pixel_pitch / cells_per_pixel(geometry)
    lines = [float(line) for line in spectrum.wavelengths_nm]
    points = cells_a_side(geometry, spectrum) * max(points_per_cell(nm, geometry.mask_distance, step) for nm in lines)
    terms = mask.amplitude.most_terms
    if terms * float(points) ** 2 * mask.amplitude.uneven_part > _MOST_WAVE_TERMS:
        problem = f"{mask.words}: waves of {len(mask.values)} features a side, in {terms} terms, take minutes a line"
        remedy = "use --effects=-diffraction, for its geometric shadow, or give larger features or fewer pixels"
        raise MitsimError(f"{problem} of light; {remedy}")


def points_per_cell(wavelength_nm: float, distance_mm: float, step_mm: float) -> int:
    apart = (wavelength_nm * 1e-6 * distance_mm) ** 0.5 / _POINTS_PER_FRESNEL_LENGTH
    return max(int(np.ceil(step_mm / apart)), _LEAST_WAVE_POINTS)


def cells_per_pixel(geometry: CameraGeometry) -> int:
    return geometry.mask_cells or _CELLS_PER_PIXEL


def with_few_cells(geometry: CameraGeometry, spectrum: Spectrum | None) -> CameraGeometry:
    """Return a camera with a third of the raster cells per pixel, for frames that are only compared."""
    drawn = geometry.is_correlated(spectrum is not None)
    return geometry.model_copy(update={"mask_cells": _FEW_CELLS}) if drawn else geometry


def sharpen(values: FloatArray) -> FloatArray:
    """Return (n, n) means over cells, corrected to second order for their blur."""
    for _ in ("rows", "columns"):
        padded = np.pad(values, ((1, 1), (0, 0)))
        values = (values - (padded[2:] - 2 * values + padded[:-2]) / 12).T
    return values


def _turned_means(mask: Plate, step: float, count: int) -> FloatArray:
    corners = (np.arange(count) - count / 2) * step
    down = (np.arange(_POINTS) + 0.5) / _POINTS * step
    across = (np.arange(_POINTS) * _LATTICE % _POINTS + 0.5) / _POINTS * step
    means = np.zeros((count, count))
    rows = max(1, _AT_ONCE // count)
    for start in range(0, count, rows):
        some = slice(start, start + rows)
        for row, column in zip(down, across, strict=True):
            means[some] += mask.transmission(corners[some, None] + row, corners[None] + column)
    means /= _POINTS
    return means


def _resample(mask: Plate, step: float, count: int) -> FloatArray:
    lines, start = mask.lines, -count * step / 2
    cells = [Steps(lines[k : k + 2], np.ones(1)).cell_means(start, step, count) for k in range(len(mask.values))]
    along = np.stack(cells, axis=1)
    return np.asarray(along @ mask.values @ along.T)


def _waves(shadow: ShadowGeometry, spectrum: Spectrum, step: float, count: int) -> FloatArray:
    mask = cast("Plate", shadow.mask)
    if mask.blur_mm:
        problem = f"{mask.words}: the waves behind a blurred mask of more than one separable term are not worked out"
        raise MitsimError(f"{problem}; use --effects=-diffraction for its geometric shadow")
    if mask.flaws.turn_deg:
        # Waves turn with the mask.
        even = replace(shadow, mask=replace(mask, flaws=NO_FLAWS))
        whole = 2 * int(np.ceil(count / 2**0.5)) + _AROUND
        middles = np.asarray(np.arange(count) + 0.5 - count / 2)
        places = np.stack(mask.flaws.turned_back(middles[:, None], middles)) + (whole - 1) / 2
        light = _waves(even, spectrum, step, whole)
        return np.asarray(scipy.ndimage.map_coordinates(light, places, order=3, mode="nearest"))
    total = np.zeros((count, count))
    for wavelength, share in zip(spectrum.wavelengths_nm, spectrum.weights, strict=True):
        total += share * _intensity(shadow, mask, float(wavelength), step, count)
    return total


def _intensity(shadow: ShadowGeometry, mask: Plate, wavelength_nm: float, step: float, count: int) -> FloatArray:
    distance = shadow.distance_mm * shadow.shrink
    points = points_per_cell(wavelength_nm, distance, step)
    if count * points > _MOST_WAVE_POINTS:
        problem = f"mask {shadow.distance_mm:g} mm from the sensor: its waves need {count * points} points a side"
        raise MitsimError(f"{problem}, more than {_MOST_WAVE_POINTS}; move it off the sensor, or take fewer pixels")
    between = max(int(np.ceil(step / points / grid_step(shadow, wavelength_nm))), _GRID_CELLS)
    half = count * step / 2
    span = half + mask.extent_mm / 2 + step
    waves = EdgeWaves(wavelength_nm, distance, step / points / between, count * points * between, span, single=True)
    terms, axes = mask.terms, (1,) if mask.symmetric else (1, 2)
    profiles = [Steps.between(term[axis], mask.lines) for axis in axes for term in terms]

    def fields(start: int) -> npt.NDArray[np.complex64]:
        several = waves.fields(profiles[start : start + _FIELDS_AT_ONCE], -half)
        return np.stack([_means_at_points(field, between).astype(np.complex64) for field in several])

    seen = np.concatenate(in_threads(fields, range(0, len(profiles), _FIELDS_AT_ONCE)))
    weights = np.array([weight for weight, *_ in terms], dtype=np.complex64)
    rows, columns = (weights[:, None] * seen[: len(terms)]).T, seen[-len(terms) :]
    mirrored = mask.mirrored
    kept = [count // 2 if half_alone else count for half_alone in mirrored]
    columns = columns[:, : kept[1] * points]
    means = np.empty(kept)
    at_once = max(1, _AT_ONCE // max(columns.shape[1], 1) // points)

    def square(start: int) -> None:
        some, beyond = slice(start, min(start + at_once, kept[0])), start if mask.symmetric else 0
        field = rows[some.start * points : some.stop * points] @ columns[:, beyond * points :]
        light = np.square(field.real) + np.square(field.imag)
        down = light.reshape(-1, points, light.shape[1]).sum(axis=1)
        blocks = sum(down[:, place::points].astype(np.float64) for place in range(points))
        means[some, beyond:] = blocks / points**2
        if mask.symmetric:
            means[beyond:, some] = means[some, beyond:].T

    in_threads(square, range(0, kept[0], at_once))
    if mirrored[0]:
        means = np.concatenate((means, means[::-1]))
    return np.concatenate((means, means[:, ::-1]), axis=1) if mirrored[1] else means


def _means_at_points(field: npt.NDArray[np.complex128], between: int) -> npt.NDArray[np.complex128]:
    """Return the (n,) means of a ``field`` (n * between,), corrected to second order.

    Means are used because sampled fringes would add up where the code's lattice meets that of the points.
    """
    means = field.reshape(-1, between).mean(axis=1)
    means[1:-1] -= np.diff(means, 2) / 24
    power = float(np.square(np.abs(means)).mean())
    return np.asarray(means * (np.square(np.abs(field)).mean() / power) ** 0.5) if power else means


# -------- Frames behind a mask drawn on a raster
# A sensor pixel is a whole number q of raster cells. With w the part of raster cell a that pixel and light cell weigh
# (two boxes, one after the other), pixel i sees raster cell a from light cell c with w(a - q i, c): what holds for
# one pixel holds for all. The light is spread over the raster by those weights, X = D_row T D_column^T, and the frame
# is a correlation, worked out for each of the q x q phases of the raster::
#
#     frame[i, j] = sum_ab X[a, b] V[a + q i, b + q j]
#
# The result is exact for the raster up to rounding in single precision, 1e-6 of a frame's mean; the sum of separable
# terms gives the same (tests/unit/optics/test_correlation.py).

_Phases = npt.NDArray[np.complex64]
_APART = 8
"""Step in pixels of the first lit pixel, so that light in cells of other sizes reuses the raster's spectra."""


class Correlation:
    def __init__(self, shadow: ShadowGeometry, rows: Directions, columns: Directions, fill_factor: float = 1.0) -> None:
        sides = _Side.both(shadow, rows, columns)
        self.shape = sides[0].pixels, sides[1].pixels
        self._phases, self._fill_factor = (sides[0].phases, sides[1].phases), fill_factor
        firsts, spreads = list[int](), list[npt.NDArray[np.float32]]()
        for side in sides:
            every = _APART * side.phases
            before = side.first % every
            behind = -(before + len(side.weights)) % every
            firsts.append(side.first - before)
            spreads.append(np.pad(side.weights, ((before, behind), (0, 0))).astype(np.float32))
        self._spread = spreads
        reach = max(len(spread) // phases for spread, phases in zip(spreads, self._phases, strict=True))
        self._size = tuple(scipy.fft.next_fast_len(pixels + reach - 1, real=True) for pixels in self.shape)
        self._spectra = _spectra(cast("Plate", shadow.mask), tuple(firsts), self._size, self._phases)

    def image(self, light: FloatArray, rows: npt.ArrayLike, columns: npt.ArrayLike) -> FloatArray:
        left, right = self._spread[0][:, np.asarray(rows)], self._spread[1][:, np.asarray(columns)]
        brightest = float(np.abs(light).max()) or 1.0
        cells = _by_phase(left @ (light / brightest).astype(np.float32) @ right.T, self._phases)
        total = np.zeros(self._spectra.shape[2:], dtype=np.complex64)
        # Phases are computed one after the other, so that each stays in a processor's cache.
        for phase in np.ndindex(*self._phases):
            seen = scipy.fft.fft(scipy.fft.rfft(cells[phase], self._size[1]), self._size[0], axis=0, overwrite_x=True)
            total += np.multiply(np.conjugate(seen, out=seen), self._spectra[phase], out=seen)
        frame = scipy.fft.irfft2(total, self._size)[: self.shape[0], : self.shape[1]]
        return np.asarray(frame * np.float64(self._fill_factor * brightest))


def _by_phase(cells: npt.NDArray[Any], phases: tuple[int, int]) -> npt.NDArray[Any]:
    rows, columns = phases
    return cells.reshape(len(cells) // rows, rows, -1, columns).transpose(1, 3, 0, 2)


@lru_cache(maxsize=RASTERS_KEPT)
def _spectra(drawn: Plate, firsts: tuple[int, ...], size: tuple[int, ...], phases: tuple[int, int]) -> _Phases:
    along = [count * each for count, each in zip(size, phases, strict=True)]
    seen = _part(_part(drawn.values, firsts[0], along[0]).T, firsts[1], along[1]).T.astype(np.float32)
    return np.stack([scipy.fft.rfft2(np.ascontiguousarray(row)) for row in _by_phase(seen, phases)])


@dataclass(frozen=True, eq=False)
class _Side:
    pixels: int
    phases: int
    first: int
    weights: FloatArray

    @classmethod
    def both(cls, shadow: ShadowGeometry, rows: Directions, columns: Directions) -> list[_Side]:
        return [cls.of(*shadow.from_mask(directions, axis)) for axis, directions in enumerate((rows, columns))]

    @classmethod
    def of(cls, shadow: ShadowGeometry, directions: Directions) -> _Side:
        pixels = len(shadow.pixel_centres_mm)
        length = shadow.pixel_centres_mm[-1] - shadow.pixel_centres_mm[0]
        step = length * shadow.shrink / max(pixels - 1, 1) / shadow.mask.feature_mm
        phases = max(round(step), 1)
        cell, blur, count = shadow.mask.feature_mm, shadow.mask.blur_mm, len(cast("Plate", shadow.mask).values)
        halves = shadow.half_pixel / cell, shadow.half_cell(directions) / cell
        crossings = (shadow.shrink * shadow.pixel_centres_mm[0] + shadow.distance_mm * directions.centres) / cell
        crossings = crossings + count / 2
        reach = sum(halves) + 8.3 * blur / cell
        first = int(np.floor(crossings.min() - reach))
        count = -(-(int(np.ceil(crossings.max() + reach)) - first) // phases) * phases
        edges = first + np.arange(count + 1)
        below = blurred_step(edges[:, None] - crossings, halves[0], halves[1], blur / cell)
        return cls(pixels, phases, first, np.diff(below, axis=0))

    def factor(self, profile: FloatArray, places: npt.NDArray[np.intp]) -> FloatArray:
        seen = _part(profile[:, None], self.first, self.phases * (self.pixels - 1) + len(self.weights))[:, 0]
        windows = np.lib.stride_tricks.sliding_window_view(seen, len(self.weights))
        return np.asarray(windows[self.phases * places] @ self.weights)


def terms_of_raster(
    shadow: ShadowGeometry,
    rows: Directions,
    columns: Directions,
    fill_factor: float,
    places: Places | None,
    terms: Sequence[Term],
) -> SeparableTerms:
    sides = _Side.both(shadow, rows, columns)
    at = [np.arange(side.pixels) if places is None else np.asarray(places[axis]) for axis, side in enumerate(sides)]

    def factors(term: Term) -> tuple[FloatArray, FloatArray]:
        weight, row, column = term
        return fill_factor * weight * sides[0].factor(row, at[0]), sides[1].factor(column, at[1])

    return in_threads(factors, terms)


def _part(values: FloatArray, first: int, count: int) -> FloatArray:
    result = np.zeros((count, values.shape[1]))
    low, high = max(first, 0), min(first + count, len(values))
    result[low - first : max(high, low) - first] = values[low : max(high, low)]
    return result


# -------- Samplers of a mask: functions that return means
# A term is ``(weight, row sampler, column sampler)``. A sampler takes arrays of centres s and widths w (mm, index
# coordinates in the mask plane) and of tan-angles t, and gives the mean over each [s - w/2, s + w/2] of a mask
# profile for light that comes under t. :func:`geometric_samplers` makes them for a thin mask's geometric shadow,
# where t does not matter; profiles of thick masks and wave-optical ones fit as well.

Sampler = Callable[[FloatArray, FloatArray], FloatArray]
"""Function of places s and widths [mm] that returns means of a profile over [s - width/2, s + width/2]."""
SampledTerm = tuple[float, Sampler, Sampler]
"""Weight, and samplers of rows and of columns."""
SampledTerms = list[SampledTerm]


class ProfileSampler:
    """Exact means of a piecewise constant (N,) ``profile`` from ``start_mm`` (None: centred), zero outside."""

    def __init__(
        self, profile: npt.ArrayLike, feature_mm: float, start_mm: float | None = None, centre_mm: float = 0.0
    ) -> None:
        self._values = np.concatenate(([0.0], np.asarray(profile, dtype=np.float64), [0.0]))
        self._sums = np.cumsum(self._values)
        self._feature, self._count = feature_mm, len(self._values) - 2
        self._start = (-self._count / 2 if start_mm is None else start_mm / feature_mm) + centre_mm / feature_mm

    def __call__(self, s: FloatArray, width: FloatArray) -> FloatArray:
        centre, half = s / self._feature - self._start, np.abs(width) / self._feature / 2
        low, high = centre - half, centre + half
        first, last = self._index(low), self._index(high)
        # Two cut features and the part between: without a part between, no large sums are subtracted.
        parts = self._values[first] * (first - low) + self._values[last] * (high - last + 1)
        parts += self._sums[np.maximum(last - 1, first)] - self._sums[first]
        return np.asarray(np.where(first == last, self._values[first], parts / np.where(half > 0, 2 * half, 1)))

    def _index(self, x: FloatArray) -> npt.NDArray[np.intp]:
        return np.clip(np.floor(x), -1, self._count).astype(np.intp) + 1


def wave_samplers(geometry: CameraGeometry, spectrum: Spectrum, depth: float, tau: Sequence[float]) -> SampledTerms:
    """Return the wave-optical shadow of a source at ``depth`` [mm] and tan-angles ``tau`` as samplers."""
    if geometry.is_drawn(spectrum is not None):
        return _of_plate(raster(geometry, depth, spectrum), geometry.mask_offset)
    shadow = ShadowGeometry.of(geometry, depth)
    reach = geometry.half_width + geometry.mask_distance * geometry.tan_half_fov + max(geometry.pitches)
    terms: list[SampledTerm] = []
    for wavelength, share in zip(spectrum.wavelengths_nm, spectrum.weights, strict=True):

        def axis(of: int, wavelength: float = float(wavelength)) -> list[tuple[float, ProfileSampler]]:
            centre = geometry.mask_offset[of]
            low, high = -reach - centre, reach - centre
            profiles, start, step = wave_profiles(shadow, wavelength, low, high, tau[of] - centre / depth)
            return [(weight, ProfileSampler(profile, step, start, centre)) for weight, profile in profiles]

        both = zip(axis(0), axis(1), strict=True)
        terms += [(float(share) * weight, row, column) for (weight, row), (_, column) in both]
    return terms


def geometric_samplers(geometry: CameraGeometry) -> list[SampledTerm]:
    drawn = geometry.is_drawn(waves=False)
    mask = raster(geometry, geometry.scene_distance) if drawn else geometry.build_mask()
    return _of_plate(mask, geometry.mask_offset)


def _of_plate(mask: Mask | Plate, centre: tuple[float, float]) -> list[SampledTerm]:
    def sampler(profile: FloatArray, at: float) -> Sampler:
        if not mask.blur_mm:
            return ProfileSampler(profile, mask.feature_mm, centre_mm=at)
        steps = Steps.between(profile, mask.lines + at, mask.blur_mm)
        return lambda s, width: steps.over(s, np.abs(width) / 2)

    row, column = centre
    return [(weight, sampler(rows, row), sampler(columns, column)) for weight, rows, columns in mask.terms]
