"""Laser speckle on the sensor: one realisation of coherent light, and its contrast.

Integrated speckle after Goodman (Speckle Phenomena in Optics, section 4.6): light that averages over M independent
modes (polarisations, laser lines, grains within a pixel, moments of a scanned beam) follows a gamma distribution of
mean 1 and standard deviation C = M^(-1/2), the speckle contrast. Sensor pixels are independent, because a grain
lambda z / D of an illuminated patch D = 120 mm is 2 um at 400 mm, below a pixel. Contrast 0 leaves light unchanged.

Points u of a rough surface at distance z shine with independent phases, B(u) of their light reaches the pixel (width p)
through the mask, and a scanned beam lights some together. With <> the mean over pairs of points u, u', weighted by B,
and over the sensor's pixels::

    C^2 = (1 + P^2) / 2  sum_kl w_k w_l mu_kl^2  < g(u - u') sinc^2(p dx / lambda z) sinc^2(p dy / lambda z) >

- P is the degree of polarisation of the scattered light, because two polarisations speckle independently (Goodman,
  3.3).
- w_k are the lines' shares of the photons. Over heights of standard deviation h, their fields have a coherence mu_kl =
  exp(-(4 pi h (1/lambda_k - 1/lambda_l))^2 / 2) (Goodman, chapter 6; light near the normal). Within a line of standard
  deviation s, mu_kk^2 = (1 + (8 pi h s / lambda^2)^2)^(-1/2).
- sinc^2 is the part of the grains of two points that remains over the area of a pixel: the van Cittert-Zernike theorem,
  with Goodman's number of grains in an aperture (4.4). Light through fewer openings comes from fewer points.
- g is the coherence with which the beam lights two points: 1 if all is lit at once, exp(-|u - u'|^2 / r^2) for a
  Gaussian beam of 1/e^2 radius r, whose positions add up in one exposure as intensities.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry, Devices
from mitsim.devices.projector import Coherence

_NODES = 16
"""Nodes of the Gauss-Legendre rule over half a triangle of distances between points of two projector pixels."""
Kernel = Callable[[FloatArray], FloatArray]
"""Function of distances along one axis [mm]."""


def add_speckle(irradiance: FloatArray, contrast: float, rng: np.random.Generator) -> FloatArray:
    """Multiply ``irradiance`` (any shape and unit) by a gamma field of mean 1 and standard deviation ``contrast``.

    Raises MitsimError for a contrast outside 0..1, because single fully developed speckle has 1.
    """
    if not 0 <= contrast <= 1:
        raise MitsimError(f"speckle contrast is {contrast}; give a number from 0 (none) to 1 (fully developed)")
    if contrast == 0:
        return irradiance
    return np.asarray(irradiance * rng.gamma(contrast**-2, contrast**2, size=irradiance.shape))


def contrast_of(devices: Devices, pixels_mm: tuple[float, float], lit: FloatArray) -> float:
    """Return the mean contrast of speckle in one sensor pixel by the module's formula.

    Parameters
    ----------
    devices
        Camera and projector, whose table ``speckle`` states the coherence of its light.
    pixels_mm
        Height and width of a projector pixel on the aligned plane [mm].
    lit
        (n, n) light of each projector pixel, any unit.

    Raises
    ------
    MitsimError
        If no pixel is lit.
    """
    if not lit.any():
        raise MitsimError("speckle contrast: no projector pixel is lit; light makes it")
    coherence, spectrum = devices.projector.speckle or Coherence(), devices.projector.spectrum
    inverse = 1 / spectrum.wavelengths_nm
    pairs = _coherences(spectrum.wavelengths_nm, coherence.roughness_um, coherence.linewidth_nm)
    pairs *= np.outer(spectrum.weights, spectrum.weights)
    spaces = {
        wavelength: _space(devices, pixels_mm, lit, wavelength * 1e-6)
        for wavelength in np.unique(2 / (inverse[:, None] + inverse)[pairs > 0])
    }
    # Of two lines, grains at their mean wave number; where lines are coherent at all they are close to it.
    both = np.array([[spaces.get(2 / (k + other), 0.0) for other in inverse] for k in inverse])
    return float(np.sqrt((1 + coherence.polarisation**2) / 2 * (pairs * both).sum()))


def _coherences(wavelengths_nm: FloatArray, roughness_um: float | None, linewidth_nm: float) -> FloatArray:
    if roughness_um is None:
        return np.eye(len(wavelengths_nm))
    height = 1e3 * roughness_um
    phase = 4 * np.pi * height * (1 / wavelengths_nm[:, None] - 1 / wavelengths_nm)
    found = np.exp(-np.square(phase))
    within = 1 / np.sqrt(1 + np.square(8 * np.pi * height * linewidth_nm / np.square(wavelengths_nm)))
    np.fill_diagonal(found, within)
    return np.asarray(found)


def _space(devices: Devices, pixels_mm: tuple[float, float], lit: FloatArray, wavelength_mm: float) -> float:
    """Return the mean over pairs of points for one wavelength [mm].

    It is relative to the sum of the squares of all pixels' light, because pixels of the mask's shadow differ.
    """
    camera, radius = devices.camera, (devices.projector.speckle or Coherence()).beam_radius_mm

    def grains(distance: FloatArray, width: float) -> FloatArray:
        kernel = np.square(np.sinc(width * distance / (wavelength_mm * camera.scene_distance)))
        return np.asarray(kernel if radius is None else kernel * np.exp(-np.square(distance / radius)))

    sizes = [2 * side for side in lit.shape]
    spectrum = np.square(np.abs(np.fft.rfft2(lit, sizes)))
    apart = np.fft.irfft2(spectrum, sizes)  # light of pairs of pixels, by how many rows and columns they are apart

    def mean(kernels: Iterable[Kernel]) -> float:
        total = 0.0
        for weight, seen in _pairs_seen(camera):
            rows, columns = (
                _between_pixels((kernel, seen), size, side)
                for kernel, size, side in zip(kernels, pixels_mm, lit.shape, strict=True)
            )
            total += weight * float(rows @ apart @ columns)
        return total

    return mean([partial(grains, width=width) for width in camera.active_sides]) / mean([np.ones_like] * 2)


def _between_pixels(kernels: tuple[Kernel, Kernel], size: float, count: int) -> FloatArray:
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    part, share = (nodes + 1) / 2, weights / 2 * (1 - (nodes + 1) / 2)
    lags = np.fft.fftfreq(2 * count, 1 / (2 * count))[:, None]
    places = np.stack([(lags + part) * size, (lags - part) * size])
    return np.asarray((share * kernels[0](places) * kernels[1](places)).sum(axis=(0, 2)))


def _pairs_seen(camera: CameraGeometry) -> tuple[tuple[float, Kernel], ...]:
    apart = camera.mask_distance / (camera.scene_distance * camera.mask_feature)

    def always(distance: FloatArray) -> FloatArray:
        return np.ones_like(distance)

    def one_feature(distance: FloatArray) -> FloatArray:
        return np.asarray(np.maximum(1 - np.abs(distance) * apart, 0))

    if camera.mask == "separable":
        return ((1.0, lambda distance: 1 + one_feature(distance)),)
    open_part = {"open": 1.0, "flatcam": 0.5}.get(camera.mask) or _open_part(camera)
    return ((1.0, always), (1 / open_part - 1, one_feature))


def _open_part(camera: CameraGeometry) -> float:
    return float(sum(weight * rows.mean() * columns.mean() for weight, rows, columns in camera.build_mask().terms))
