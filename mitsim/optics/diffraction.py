"""Compute the wave-optical shadow of a mask as separable terms, by scalar Fresnel diffraction.

The theory is Goodman's (Introduction to Fourier Optics, 4.2 and 4.5). If a mask's amplitude is a sum of separable
terms, each term's field is a product of two 1-D functions of s = u (1 - d/z) + d tau, with the effective distance D = d
(z - d) / z. A profile that jumps by J_k at e_k gives, relative to an unbounded open mask::

    U(s) = sum_k J_k E(s - e_k),    E(x) = 1/2 + (1 - i)/2 (C + i S)(x sqrt(2 / (lambda D)))

with Fresnel's integrals C and S. E is the unit step plus the wave from the edge, so that U is the profile plus one
convolution of the jumps on a fine grid. Beyond |x| = R, lambda D / 2 over the grid's step, the grid does not resolve
the edge wave, so that it is faded out from 3 R / 4 to R. The lost light (4.5e-4) is spread evenly.

The intensity of ``t = sum_k w_k r_k c_k`` (real) is::

    |U|^2 = sum_k w_k^2 |R_k|^2 |C_k|^2 + sum_(k<l) 2 w_k w_l (Re[R_k R_l*] Re[C_k C_l*] - Im[R_k R_l*] Im[C_k C_l*])

Behind a thick mask, the aperture that both faces leave clear is propagated from the exit face.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from itertools import chain, combinations

import numpy as np
import numpy.typing as npt
import scipy

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import in_threads
from mitsim.devices.mask import FEW, Mask, Plate
from mitsim.devices.projector import Spectrum
from mitsim.optics.shadow import (
    Antiderivative,
    Directions,
    SeparableTerms,
    ShadowGeometry,
    Steps,
    both_axes,
    lagrange_weights,
    nodes_between,
)

ComplexArray = npt.NDArray[np.complex128]
_STEP_MM = 2.5e-4
"""Widest grid cell: it changes the anchor geometry's shadow by 3.2e-4 (tests/physics/test_diffraction.py)."""
_STEPS_PER_FRESNEL_LENGTH = 130
_THICK_STEPS = 2
"""Grid step in steps of a thin mask, because each direction needs fields of its own."""
_DISTANCES = 3
_NARROWEST = 0.5
"""Least mean width of the openings in wavelengths. Between conducting edges, half a wavelength is the cutoff of light
polarised along them (Jackson, Classical Electrodynamics, 8.3), so that scalar theory fails below it.
"""
_NODES = 12
"""Nodes of the midpoint rule; the error is exp(-pi 12.5) = 9e-18."""
_LARGEST_GRID = 1 << 24
_KEPT, _LARGEST_KEPT = 24, 1 << 18
_PART_OF_RANGE = 1 / 4
"""Cached grids start and end at multiples of this part of their range, so that axes and cells of all sizes share them.
"""


class EdgeWaves:
    """Fresnel fields of 1-D apertures on ``count`` cells of ``step_mm``, for edges up to ``span_mm`` away.

    Raises MitsimError if the grid exceeds the memory limit.
    """

    def __init__(
        self, wavelength_nm: float, distance_mm: float, step_mm: float, count: int, span_mm: float, single: bool = False
    ) -> None:
        product = wavelength_nm * 1e-6 * distance_mm
        self.step_mm, self._count = step_mm, count
        fade = product / (2 * step_mm)
        self._reach = reach = max(int(np.ceil(min(fade, span_mm) / step_mm)), 1)
        size = count + 2 * reach
        if size > _LARGEST_GRID:
            needed = f"{size:.3g} points, more than {_LARGEST_GRID}"
            problem = f"mask: its diffraction, {product**0.5 * 1e3:.3g} um wide, needs {needed}"
            raise MitsimError(f"{problem}; move the mask off sensor and scene, or take fewer or smaller pixels")
        x = (np.arange(reach) + 0.5) * step_mm
        wave = edge_wave(x * (2 / product) ** 0.5)
        wave *= np.square(np.cos(np.pi / 2 * np.clip(4 * x / fade - 3, 0, 1)))
        self._size = fast_length(size - 1)
        kernel = np.fft.fft(np.concatenate((-wave[::-1], wave)), self._size)
        self._kernel = kernel.astype(np.complex64) if single else kernel

    def field(self, aperture: Steps, start_mm: float) -> ComplexArray:
        return np.asarray(self.fields([aperture], start_mm)[0])

    def fields(self, apertures: Sequence[Steps], start_mm: float) -> ComplexArray:
        reach, count = self._reach, self._count
        start = start_mm - reach * self.step_mm
        profiles = np.stack([each.amplitude_means(start, self.step_mm, count + 2 * reach) for each in apertures])
        jumps, size = np.diff(profiles), self._size
        if self._kernel.dtype == np.complex64:  # of which numpy's transforms take five times as long
            spectrum = scipy.fft.fft(jumps.astype(np.float32), size)
            spectrum *= self._kernel
            waves = scipy.fft.ifft(spectrum, overwrite_x=True)
        else:  # in double precision scipy's are no faster, and take 0.02 s to import
            half = np.fft.rfft(jumps, size)
            whole = np.concatenate((half, np.conj(half[:, (size - 1) // 2 : 0 : -1])), axis=1)
            waves = np.fft.ifft(whole * self._kernel)
        # The first 2 reach - 1 values lack jumps on their left, or contain values that wrapped around the end.
        waves = waves[:, 2 * reach - 1 : 2 * reach - 1 + count]
        return np.asarray(waves + profiles[:, reach : reach + count])


def edge_wave(x: FloatArray) -> ComplexArray:
    """Return E - 1 = (1 - i)/2 (C + i S)(x) - 1/2 at ``x`` > 0 in units of sqrt(lambda D / 2), to 3e-16.

    The value is -erfc(z)/2 at z = exp(-i pi/4) sqrt(pi/2) x (Alazah, Chandler-Wilde and La Porte 2014, Numerische
    Mathematik 128, 635). scipy.special is avoided because its import takes 0.1 s.
    """
    scale = ((_NODES + 0.5) * np.pi) ** 0.5
    y = (np.pi / 2) ** 0.5 * x
    square = np.square(y)
    fourth, real, imaginary = np.square(square), np.zeros_like(y), np.zeros_like(y)
    for t in (np.arange(_NODES) + 0.5) * np.pi / scale:
        part = np.exp(-(t**2)) / (t**4 + fourth)
        real += t**2 * part
        imaginary += part
    eighth = np.exp(-0.25j * np.pi)
    pole = np.exp(-2 * scale * eighth * y)
    # Whole turns are subtracted before the product with pi, because there are thousands far from the edge.
    phase = np.exp(1j * np.pi * np.fmod(np.square(x) / 2, 2)) * eighth
    return np.asarray(-(phase * (y / scale) * (real + 1j * (square * imaginary)) + pole / (1 + pole)))


@cache
def fast_length(least: int) -> int:
    left, length = 0, least - 1
    while left != 1:
        length += 1
        left = length
        for prime in (2, 3, 5, 7, 11):
            while left % prime == 0:
                left //= prime
    return length


def wave_terms(shadow: ShadowGeometry, rows: Directions, columns: Directions, spectrum: Spectrum) -> SeparableTerms:
    shadow = _of_fields(shadow)
    weights = _pair_weights(shadow.weights())
    means = _thick_means if shadow.thickness_mm else _thin_means

    def of_line(wavelength: float) -> tuple[FloatArray, FloatArray]:
        return both_axes(shadow, rows, columns, partial(means, nm=float(wavelength)))

    lines = in_threads(of_line, spectrum.wavelengths_nm)
    by_line = [(share, zip(weights, *both, strict=True)) for both, share in zip(lines, spectrum.weights, strict=True)]
    return [(share * weight * a, b) for share, terms in by_line for weight, a, b in terms]


def wave_profiles(
    shadow: ShadowGeometry, wavelength_nm: float, low_mm: float, high_mm: float, tau: float
) -> tuple[list[tuple[float, FloatArray]], float, float]:
    """Return (weight, (cells,) profile) for each term in a point source's shadow, and the grid's start and step [mm].

    The intensity is a function of the mask coordinate; ``tau`` matters for thick masks.
    """
    shadow = _of_fields(shadow)
    light = _Propagation.of(shadow, wavelength_nm)
    waves, start = light.waves(np.array([low_mm]), np.array([high_mm])), light.start(low_mm)
    rows = [profile for _, profile, _ in shadow.mask.terms]
    products = _products([waves.field(clear, start) for clear in shadow.clear(rows, tau)])
    return list(zip(_pair_weights(shadow.weights()), products, strict=True)), start, waves.step_mm


def _of_fields(shadow: ShadowGeometry) -> ShadowGeometry:
    mask = shadow.mask.amplitude
    if mask.crosses is None:
        problem = f"{mask.words}: its field is no sum of {FEW} separable terms, so its diffraction is not worked out"
        raise MitsimError(f"{problem}; use --effects=-diffraction for its geometric shadow")
    return replace(shadow, mask=mask)


def narrowest_mm(wavelength_nm: float) -> float:
    return _NARROWEST * wavelength_nm * 1e-6


def check_openings(mask: Mask | Plate, wavelength_nm: float) -> None:
    if mask.opening_mm < narrowest_mm(wavelength_nm):
        least = f"{wavelength_nm:.0f} nm needs {narrowest_mm(wavelength_nm):.3g}, half a wavelength"
        problem = f"mask: its openings are {mask.opening_mm:.3g} mm wide, and diffraction of {least}"
        remedy = "give a larger feature_mm (camera file) or mask_feature (scene), or --effects=-diffraction"
        raise MitsimError(f"{problem}; {remedy}")


def grid_step(shadow: ShadowGeometry, wavelength_nm: float) -> float:
    check_openings(shadow.mask, wavelength_nm)
    feature = shadow.mask.feature_mm
    fresnel_length = (wavelength_nm * 1e-6 * shadow.distance_mm * shadow.shrink) ** 0.5
    widest = min(_STEP_MM, fresnel_length / _STEPS_PER_FRESNEL_LENGTH) * (_THICK_STEPS if shadow.thickness_mm else 1)
    # Features that are finer than a cell are averaged, because their orders are evanescent.
    return feature / float(np.ceil(feature / widest)) if feature > widest else widest


@dataclass(frozen=True)
class _Propagation:
    wavelength_nm: float
    distance_mm: float
    extent_mm: float
    step_mm: float

    @classmethod
    def of(cls, shadow: ShadowGeometry, wavelength_nm: float) -> _Propagation:
        distance, step = shadow.distance_mm * shadow.shrink, grid_step(shadow, wavelength_nm)
        return cls(wavelength_nm, distance, shadow.mask.extent_mm, step)

    def waves(self, lows: FloatArray, highs: FloatArray) -> EdgeWaves:
        count = int(np.ceil((highs - lows).max() / self.step_mm)) + 3
        span = self.extent_mm / 2 + float(max(np.abs(lows).max(), np.abs(highs).max())) + 3 * self.step_mm
        return EdgeWaves(self.wavelength_nm, self.distance_mm, self.step_mm, count, span)

    def start(self, low: float) -> float:
        first = -self.extent_mm / 2
        return float(first + (np.floor((low - first) / self.step_mm) - 1) * self.step_mm)


def _integrate(apertures: tuple[Steps, ...], light: _Propagation, low: float, high: float) -> Antiderivative:
    waves, start = light.waves(np.array([low]), np.array([high])), light.start(low)
    return Antiderivative.of_samples(_products([waves.field(each, start) for each in apertures]), start, waves.step_mm)


_keep_integrated = lru_cache(maxsize=_KEPT)(_integrate)


def _thin_means(shadow: ShadowGeometry, profiles: list[FloatArray], directions: Directions, nm: float) -> FloatArray:
    """Return the (pairs, m, c) mean products of fields on one grid.

    Behind a tilted mask they are interpolated between those of a few distances.
    """
    (growth, beyond), even = shadow.tilt[0], shadow.crossings(directions)
    nodes, total = nodes_between(even, _DISTANCES) if growth else np.zeros(1), np.zeros(())
    met, half_cell = shadow.on_tilted_mask(directions), shadow.half_cell(directions)
    reach = shadow.half_pixel + half_cell
    for weight, node in zip(lagrange_weights(even, nodes), nodes, strict=True):
        low, high = float(met.min() - reach), float(met.max() + reach)
        at_node = replace(shadow, distance_mm=shadow.distance_mm + beyond + growth * float(node))
        light = _Propagation.of(at_node, nm)
        kept = len(profiles) ** 2 * (high - low) <= _LARGEST_KEPT * light.step_mm
        if kept:
            part = 2.0 ** math.floor(math.log2(_PART_OF_RANGE * (high - low)))
            low, high = part * math.floor(low / part), part * math.ceil(high / part)
        integrated = (_keep_integrated if kept else _integrate)(tuple(shadow.clear(profiles, 0.0)), light, low, high)
        means = integrated.smooth_means(met, shadow.half_pixel, half_cell)
        if not growth:
            return means
        total = total + weight * means
    return total


def _thick_means(shadow: ShadowGeometry, profiles: list[FloatArray], directions: Directions, nm: float) -> FloatArray:
    crossings, half_cell = shadow.crossings(directions), shadow.half_cell(directions)
    reach = shadow.half_pixel + half_cell
    lows, highs = crossings.min(axis=0) - reach, crossings.max(axis=0) + reach
    light = _Propagation.of(shadow, nm)
    waves = light.waves(lows, highs)

    def toward(j: int) -> FloatArray:
        start = light.start(float(lows[j]))
        clear = shadow.clear(profiles, float(directions.centres[j]))
        products = _products([waves.field(aperture, start) for aperture in clear])
        integrated = Antiderivative.of_samples(products, start, waves.step_mm)
        return integrated.smooth_means(crossings[:, j], shadow.half_pixel, half_cell)

    return np.stack(in_threads(toward, range(crossings.shape[1])), axis=-1)


def _products(fields: list[ComplexArray]) -> FloatArray:
    parts = [np.square(field.real) + np.square(field.imag) for field in fields]
    for product in (first * second.conj() for first, second in combinations(fields, 2)):
        parts += [product.real, product.imag]
    return np.stack(parts)


def _pair_weights(weights: list[float]) -> list[float]:
    pairs = [(2 * first * second, -2 * first * second) for first, second in combinations(weights, 2)]
    return [*(weight**2 for weight in weights), *chain.from_iterable(pairs)]
