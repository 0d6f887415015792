"""A mask as functions that can be asked for means: from mask profiles to separable terms of samplers.

A term is ``(weight, row sampler, column sampler)``. A sampler takes arrays of centres s and widths w (mm, index
coordinates in the mask plane) and of tan-angles t, and gives the mean over each [s - w/2, s + w/2] of a mask profile
for light that comes under t. :func:`geometric_samplers` makes them for a thin mask's geometric shadow, where t does not
matter; profiles of thick masks and wave-optical ones fit as well.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.optics.diffraction import wave_profiles
from mitsim.optics.profile import Steps
from mitsim.optics.raster import raster
from mitsim.optics.shadow import ShadowGeometry
from mitsim.rig.camera import CameraGeometry
from mitsim.rig.mask import Mask
from mitsim.rig.plate import Plate
from mitsim.rig.projector import Spectrum

Sampler = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
SeparableTerm = tuple[float, Sampler, Sampler]


class ProfileSampler:
    """Exact means of a piecewise constant mask profile, zero outside its features.

    Parameters
    ----------
    profile
        (N,) transmission of each feature.
    feature_mm
        their size.
    start_mm
        where the first begins; None: centred on ``centre_mm``.
    centre_mm
        of the mask, which ``start_mm`` is counted from.
    """

    def __init__(
        self, profile: npt.ArrayLike, feature_mm: float, start_mm: float | None = None, centre_mm: float = 0.0
    ) -> None:
        values = np.asarray(profile, dtype=np.float64)
        self._values = np.concatenate(([0.0], values, [0.0]))
        self._sums = np.cumsum(self._values)
        self._feature, self._count = feature_mm, len(values)
        self._start = (-len(values) / 2 if start_mm is None else start_mm / feature_mm) + centre_mm / feature_mm

    def __call__(self, s: FloatArray, width: FloatArray, tangent: FloatArray) -> FloatArray:
        """Mean over [s - width/2, s + width/2] for arrays that broadcast; at width 0 the value itself."""
        centre, half = s / self._feature - self._start, np.abs(width) / self._feature / 2
        low, high = centre - half, centre + half
        first, last = self._index(low), self._index(high)
        # Two features that are cut and what lies between: with nothing between, no large sums are subtracted.
        parts = self._values[first] * (first - low) + self._values[last] * (high - last + 1)
        parts += self._sums[np.maximum(last - 1, first)] - self._sums[first]
        return np.asarray(np.where(first == last, self._values[first], parts / np.where(half > 0, 2 * half, 1)))

    def _index(self, x: FloatArray) -> npt.NDArray[np.intp]:
        """Place in the padded values of what lies at x (features from the first edge); feature k is number k + 1."""
        return np.clip(np.floor(x), -1, self._count).astype(np.intp) + 1


def wave_samplers(
    geometry: CameraGeometry, spectrum: Spectrum, depth: float, tau: tuple[float, float]
) -> list[SeparableTerm]:
    """A mask's wave-optical shadow of a (virtual) source, as samplers.

    Parameters
    ----------
    geometry, spectrum
        the camera and the light.
    depth, tau
        of the source [mm], and its tan-angles along rows and columns.
    """
    if geometry.drawn(spectrum is not None):
        return _of_plate(raster(geometry, depth, spectrum), geometry.mask_offset)
    shadow = ShadowGeometry.of(geometry, depth)
    reach = geometry.half_width + geometry.mask_distance * geometry.tan_half_fov + max(geometry.pitches)
    terms: list[SeparableTerm] = []
    for wavelength, share in zip(spectrum.wavelengths_nm, spectrum.weights, strict=True):

        def axis(of: int, wavelength: float = float(wavelength)) -> list[tuple[float, ProfileSampler]]:
            centre = geometry.mask_offset[of]
            low, high = -reach - centre, reach - centre
            profiles, start, step = wave_profiles(shadow, wavelength, low, high, tau[of] - centre / depth)
            return [(weight, ProfileSampler(profile, step, start, centre)) for weight, profile in profiles]

        terms += [
            (float(share) * weight, row, column) for (weight, row), (_, column) in zip(axis(0), axis(1), strict=True)
        ]
    return terms


def _steps_sampler(profile: Steps) -> Sampler:
    """That of a ``profile`` whose features are not even, or blurred."""
    return lambda s, width, tangent: profile.over(s, np.abs(width) / 2)


def geometric_samplers(geometry: CameraGeometry) -> list[SeparableTerm]:
    """The geometric shadow of the mask of ``geometry``, as samplers."""
    if geometry.drawn(waves=False):
        return _of_plate(raster(geometry, geometry.scene_distance), geometry.mask_offset)
    return _of_plate(geometry.build_mask(), geometry.mask_offset)


def _of_plate(mask: Mask | Plate, centre: tuple[float, float]) -> list[SeparableTerm]:
    """The samplers of a ``mask`` with its ``centre`` off the axis [mm]."""

    def sampler(profile: FloatArray, at: float) -> Sampler:
        if mask.even:
            return ProfileSampler(profile, mask.feature_mm, centre_mm=at)
        return _steps_sampler(Steps.between(profile, mask.lines + at, mask.blur_mm))

    row, column = centre
    return [(weight, sampler(rows, row), sampler(columns, column)) for weight, rows, columns in mask.terms]
