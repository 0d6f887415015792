"""Irradiance on every sensor pixel from beams that mirrors carry to the sensor.

A beam is a quadrilateral of one projector pixel's window with a known flux. Its four corner rays give the place where
it lands, and quantities between them are bilinear. A beam is cut into boxes of at most half a sensor pixel, and each
box gives the pixels that it overlaps their part of the flux times the mask's mean. Because boxes tile the beam, flux is
conserved. Coordinates are centred index coordinates (s_row = -y, s_col = -x) in mm.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray, Labels
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.projector import Spectrum
from mitsim.optics.fft_shadow import SampledTerm, geometric_samplers, wave_samplers
from mitsim.optics.frames import ClassFrames
from mitsim.optics.image_formation import IntArray

_BOXES_AT_ONCE = 2**18
_POINT = 1e-9
_ASKEW_BOXES = 2
"""Factor of boxes per side for an askew beam, which otherwise shows a moire of 1 %."""


@dataclass(frozen=True, eq=False)
class Beams:
    """Bundles of rays that reach the sensor plane; the last index of each pair is (row, column).

    ``flux`` (q,) is that of projector ``pixel`` (q,), row * n + column, at full power [W m^-2 mm^2]. ``sensor`` (q, 2,
    2, 2) are the points where the corner rays cross the sensor plane [mm], ``tangent`` their tan-angles in index
    coordinates, and ``throughput`` (q, 2, 2) the part of the light that remains. ``unresolved`` is flux whose place was
    not found, and ``error`` the standard error of the flux from beams that an edge cuts.
    """

    pixel: IntArray
    flux: FloatArray
    sensor: FloatArray
    tangent: FloatArray
    throughput: FloatArray
    unresolved: float
    error: float = 0.0

    def __len__(self) -> int:
        return len(self.pixel)

    @property
    def delivered(self) -> FloatArray:
        return np.asarray(self.flux * self.throughput.mean(axis=(1, 2)))

    @property
    def wide(self) -> npt.NDArray[np.bool_]:
        return np.asarray((np.ptp(self.sensor.reshape(len(self), 4, 2), axis=1) > 0).any(axis=1))

    @property
    def inverse_depth(self) -> FloatArray:
        """Return (q, 2) 1/z [1/mm] of the virtual source, from dt/du = -1/z at the beam's centre."""
        return -_slope(self.sensor, self.tangent)


@dataclass(frozen=True, eq=False)
class SpecularFrames(ClassFrames):
    """Irradiance by mirrors, one frame for each class of projector pixels that reaches the sensor.

    ``lit_pixels`` are the projector pixels whose light meets the sensor. ``flux`` is that on the sensor without the
    mask [W m^-2 mm^2], ``unresolved`` the part that is left out, and ``error`` the standard error of the rest.
    """

    lit_pixels: IntArray
    flux: float
    unresolved: float
    error: float


def specular_frames(
    beams: Beams, geometry: CameraGeometry, terms: Sequence[SampledTerm], labels: IntArray, boxes_per_pixel: int = 2
) -> SpecularFrames:
    """Form the frames of the classes that mirrors bring to the sensor.

    ``labels`` (n * n,) are the classes of projector pixels, and ``terms`` samplers of the mask; ``[]`` gives no light.
    At least 2 ``boxes_per_pixel`` are needed, because a box turned by 45 degrees must not reach a third pixel.
    """
    labels = np.asarray(labels)
    corners = beams.sensor.reshape(len(beams), 4, 2)
    on_sensor = (corners.max(axis=1) > -geometry.half_width) & (corners.min(axis=1) < geometry.half_width)
    reached = np.flatnonzero(on_sensor.all(axis=1))
    classes = np.unique(labels[beams.pixel[reached]])
    shape = geometry.frame_shape
    frames = np.zeros((len(classes), *shape))
    total, lit = 0.0, np.zeros(len(labels), dtype=bool)
    for cut in _cuts(beams, reached, min(geometry.pitches) / boxes_per_pixel):
        # ---- Boxes that the sensor sees within the field stop: place, size and tangent at the middle, and flux
        corners, tangents = beams.sensor[cut.beams], beams.tangent[cut.beams]
        place, tangent = _bilinear(corners, cut.a, cut.b), _bilinear(tangents, cut.a, cut.b)
        along, across = _gradients(corners, cut.a, cut.b)
        extent = np.hypot(along * cut.size[0], across * cut.size[1])
        extent = np.maximum(extent, _POINT * min(geometry.pitches))
        seen = (np.abs(place) < geometry.half_width + extent / 2).all(axis=-1)
        seen &= (np.abs(tangent) <= geometry.tan_half_fov).all(axis=-1)
        throughput = _bilinear(beams.throughput[cut.beams][..., None], cut.a, cut.b)[..., 0]
        light = (beams.flux[cut.beams, None, None] * throughput)[seen] * (cut.size[0] * cut.size[1])
        owner = np.broadcast_to(np.arange(len(cut.beams))[:, None, None], seen.shape)[seen]
        place, extent, tangent = place[seen], extent[seen], tangent[seen]
        squared = np.square(tangent[:, 0]) + np.square(tangent[:, 1])
        light = light * (geometry.pixel_fill_factor * geometry.angular_response(squared))
        magnification = (1 + geometry.mask_distance * _slope(corners, tangents))[owner]
        pixels = beams.pixel[cut.beams[owner]]
        slot, within = np.searchsorted(classes, labels[pixels]), 0.0

        # ---- By axis, the two pixels that a box meets, its part in each, and its place and width on the mask
        both: list[list[tuple[IntArray, FloatArray, FloatArray, FloatArray]]] = [[], []]
        for axis, step in np.ndindex(2, 2):
            active_part, pitch = math.sqrt(geometry.pixel_fill_factor), geometry.pitches[axis]
            first = 0 if geometry.roi is None else geometry.roi[axis]
            middle = place[:, axis] / pitch + geometry.shape[axis] / 2 - first
            width = extent[:, axis] / pitch
            low, high = middle - width / 2, middle + width / 2
            pixel = np.floor(low).astype(np.int64) + step
            low = np.maximum(low, pixel + (1 - active_part) / 2)
            high = np.minimum(high, pixel + (1 + active_part) / 2)
            share = np.maximum(high - low, 0) / width
            share[(pixel < 0) | (pixel >= geometry.frame_shape[axis])] = 0
            grown = magnification[:, axis]
            offset = ((low + high) / 2 - middle) * pitch
            shadow = place[:, axis] + geometry.mask_distance * tangent[:, axis] + grown * offset
            both[axis].append((pixel, share, shadow, np.abs(grown) * share * width * pitch))
        rows, columns = both
        shadows = [
            (weight, [by_row(*piece[2:]) for piece in rows], [by_column(*piece[2:]) for piece in columns])
            for weight, by_row, by_column in terms
        ]
        for i, (row, row_share, *_) in enumerate(rows):
            for j, (column, column_share, *_) in enumerate(columns):
                flux = light * row_share * column_share
                within += float(flux.sum())
                met = np.flatnonzero(flux)
                passed = np.zeros(len(met))
                for weight, left, right in shadows:
                    passed = passed + weight * left[i][met] * right[j][met]
                flat = (slot[met] * shape[0] + row[met]) * shape[1] + column[met]
                np.add.at(frames.reshape(-1), flat, flux[met] * passed)
        total += within
        lit[pixels] = True
    used, area = np.isin(classes, labels[lit]), math.prod(geometry.active_sides)
    lit_classes, lit_frames = classes[used].astype(np.int64), frames[used] / area
    return SpecularFrames(lit_classes, lit_frames, np.flatnonzero(lit), total, beams.unresolved, beams.error)


class _Cut(NamedTuple):
    beams: IntArray
    a: FloatArray
    b: FloatArray
    size: tuple[float, float]


def _cuts(beams: Beams, reached: IntArray, box: float) -> Iterator[_Cut]:
    """Yield all boxes of the beams ``reached``, no side longer than ``box`` [mm], in portions that fit into memory.

    Numbers of boxes are rounded up to three leading bits, so that many beams share one. Askew beams get up to three
    times as many, because boxes then overlap and leave gaps.
    """
    corners = beams.sensor[reached]
    sides = [np.diff(corners, axis=axis).reshape(len(reached), 2, 2) for axis in (1, 2)]
    length = np.stack([np.linalg.norm(side, axis=-1).max(axis=1) for side in sides], axis=1)
    longest = length.max(axis=1)
    askew = np.max([np.abs(side).min(axis=-1).max(axis=1) for side in sides], axis=0)
    askew /= np.where(longest > 0, longest, 1)
    need = np.maximum(length / box * (1 + _ASKEW_BOXES * np.minimum(4 * askew, 1))[:, None], 1)
    quarter = 2 ** np.maximum(np.floor(np.log2(need)) - 2, 0)
    counts = (np.ceil(need / quarter) * quarter).astype(np.int64)
    for rows, columns in np.unique(counts, axis=0).tolist():
        alike = reached[(counts == (rows, columns)).all(axis=1)]
        b = (np.arange(columns) + 0.5) / columns
        strip = max(1, min(rows, _BOXES_AT_ONCE // columns))
        step = max(1, _BOXES_AT_ONCE // (strip * columns))
        for first in range(0, rows, strip):
            a = (np.arange(first, min(first + strip, rows)) + 0.5) / rows
            for start in range(0, len(alike), step):
                yield _Cut(alike[start : start + step], a, b, (1 / rows, 1 / columns))


def _bilinear(corners: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    sides = corners[:, None, 0] + (corners[:, None, 1] - corners[:, None, 0]) * a[:, None, None]
    return np.asarray(sides[:, :, None, 0] + (sides[:, :, None, 1] - sides[:, :, None, 0]) * b[:, None])


def _gradients(corners: FloatArray, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    along, across = (corners[:, 1] - corners[:, 0])[:, None], (corners[:, :, 1] - corners[:, :, 0])[:, :, None]
    along = along[:, :, None, 0] + (along[:, :, None, 1] - along[:, :, None, 0]) * b[:, None]
    return along, across[:, None, 0] + (across[:, None, 1] - across[:, None, 0]) * a[:, None, None]


def _slope(sensor: FloatArray, tangent: FloatArray) -> FloatArray:
    """Return (q, 2) dt/du at the beams' centres; 0 where a beam is folded to a line.

    The cross term of a curved mirror is neglected because it matters only over less than a box.
    """
    middle = np.array([0.5])
    (ua, ub), (ta, tb) = ([g[:, 0, 0] for g in _gradients(c, middle, middle)] for c in (sensor, tangent))
    determinant = ua[:, 0] * ub[:, 1] - ua[:, 1] * ub[:, 0]
    flat = np.abs(determinant) < _POINT * np.linalg.norm(ua, axis=1) * np.linalg.norm(ub, axis=1)
    row = ta[:, 0] * ub[:, 1] - tb[:, 0] * ua[:, 1]
    column = tb[:, 1] * ua[:, 0] - ta[:, 1] * ub[:, 0]
    safe = np.where(flat | (determinant == 0), np.inf, determinant)
    return np.asarray(np.stack([row, column], axis=1) / safe[:, None])


# -------- Frames of a projector's beams

_KEPT = 4


class SpecularLight:
    """Frames from ``beams``; the last few are cached because forming them takes as long as tracing."""

    def __init__(self, beams: Beams) -> None:
        self.beams, self.seconds = beams, 0.0
        self._kept = lru_cache(_KEPT)(self._form)

    def frames(self, labels: Labels, geometry: CameraGeometry, spectrum: Spectrum | None) -> ClassFrames | None:
        if not len(self.beams):
            return None
        return self._kept(np.asarray(labels, np.int64).tobytes(), geometry, spectrum)

    def irradiance(self, geometry: CameraGeometry) -> tuple[float, float]:
        beams = self.beams
        area, pixels = math.prod(geometry.pitches), math.prod(geometry.frame_shape)
        met = (np.abs(beams.sensor.mean(axis=(1, 2))) < geometry.half_width).all(axis=1)
        # Flux that edges leave is uncertain in single pixels; its rms is over all pixels.
        unsure = math.hypot(beams.unresolved, beams.error * math.sqrt(pixels))
        return float(beams.delivered[met].sum()) / area / pixels, unsure / area / pixels

    def _form(self, labels: bytes, geometry: CameraGeometry, spectrum: Spectrum | None) -> ClassFrames:
        started = time.perf_counter()
        if spectrum is None:
            terms = geometric_samplers(geometry)
        else:
            wide = self.beams.wide
            near = float(np.mean(self.beams.inverse_depth[wide])) if wide.any() else 0.0
            depth = 1 / near if near > 0 else math.inf
            tau = np.average(self.beams.tangent.mean(axis=(1, 2)), axis=0, weights=self.beams.delivered)
            terms = wave_samplers(geometry, spectrum, depth, (float(tau[0]), float(tau[1])))
        found = specular_frames(self.beams, geometry, terms, np.frombuffer(labels, np.int64))
        self.seconds = time.perf_counter() - started
        return found
