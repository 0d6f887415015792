"""Expected irradiance of every shot of a pattern family, with its Monte Carlo error.

Frames of mixtures of light are formed by the closed form of :mod:`mitsim.optics.image_formation`. A *basis* is a matrix
(b, rows) whose rows mix rows of light. *Replicates*, which are frames from single groups of the light, are only
multiplied by probing vectors and never formed.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial

import numpy as np
import numpy.typing as npt
from scipy import sparse

from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.parallel import in_threads
from mitsim.core.seeds import stream
from mitsim.devices.camera import CameraGeometry, Devices, side_of
from mitsim.devices.patterns import Lighting
from mitsim.devices.projector import Coherence, Spectrum
from mitsim.optics.fft_shadow import SampledTerm, geometric_samplers, wave_samplers
from mitsim.optics.image_formation import Entries, FrameOptics, IntArray

_FEW = 2
_COLUMNS = 2**14
"""Columns per product. The size is fixed because it affects the last bits, which must not depend on the threads."""
_MOST_COLUMNS = 2**22
"""Places of light above which a product is computed on lit places only, because SciPy takes 36 bytes per place."""


@dataclass(frozen=True, eq=False)
class AccumulatedLight:
    optics: FrameOptics
    groups: tuple[sparse.csr_array, ...]


Lights = Sequence[AccumulatedLight]
Formed = tuple[FloatArray, FloatArray]
"""Frames, and their products with random signs."""


def form_frames(lights: Lights, basis: sparse.csr_array, probes: FloatArray | None) -> Formed:
    """Form (b, m, m') frames of mixtures ``basis`` (b, rows), and products of groups' frames with ``probes``.

    The products are (b, m * groups * probes), of ``probes`` (m', probes) from :func:`probe_vectors`; None for none.
    """
    shape, groups = lights[0].optics.frame_shape, len(lights[0].groups)
    mixed, count = _mix_lights(lights, basis), basis.shape[0]
    frames = np.zeros((count, *shape))
    probed = np.zeros((count, shape[0] * groups * (0 if probes is None else probes.shape[1])))

    def form(row: int) -> None:
        for number, (optics, parts) in enumerate(mixed):
            estimates, out = [_row(part, row) for part in parts], None if number else frames[row]
            frame, seen = optics.frame_and_products(estimates, probes, out)
            if number:
                frames[row] += frame
            probed[row] += seen.ravel()

    in_threads(form, range(count))
    return frames, probed


def probe_frames(lights: Lights, basis: sparse.csr_array, probes: FloatArray) -> Formed:
    """Return (b, m * groups * probes) replicates, and inner products (b, lights, groups, groups) of differences."""
    rows, groups = lights[0].optics.frame_shape[0], len(lights[0].groups)
    mixed, count = _mix_lights(lights, basis), basis.shape[0]
    probed, noise = np.zeros((count, rows * groups * probes.shape[1])), np.zeros((count, len(lights), groups, groups))

    def probe(row: int) -> None:
        for number, (optics, parts) in enumerate(mixed):
            estimates = [_row(part, row) for part in parts]
            if not any(len(places) for places, _ in estimates):
                continue
            seen = optics.probe(estimates, probes)
            noise[row, number] = noise_of_groups(seen, rows, groups)
            probed[row] += seen.ravel()

    in_threads(probe, range(count))
    return probed, noise


def _mix_lights(lights: Lights, basis: sparse.csr_array) -> list[tuple[FrameOptics, list[sparse.csr_array]]]:
    mixed = [(light.optics, [_product(basis, group) for group in light.groups]) for light in lights]
    for part in (part for _, parts in mixed for part in parts):
        part.sort_indices()
    return mixed


def _product(basis: sparse.csr_array, light: sparse.csr_array) -> sparse.csr_array:
    if basis.nnz == len(basis.indices) == basis.shape[1] and not (basis - sparse.eye_array(*basis.shape)).nnz:
        return light
    if light.shape[1] <= _MOST_COLUMNS:
        return basis @ light
    places, indices = np.unique(light.indices, return_inverse=True)
    lit = sparse.csr_array((light.data, indices, light.indptr), shape=(light.shape[0], max(len(places), 1)))
    product = (basis @ lit).tocsr()
    # SciPy adds matrices of sorted rows entry by entry, and other matrices over all their columns.
    product.sort_indices()
    wide = places[product.indices] if len(places) else product.indices
    return sparse.csr_array((product.data, wide, product.indptr), shape=(basis.shape[0], light.shape[1]))


def _row(matrix: sparse.csr_array, row: int) -> Entries:
    inside = slice(matrix.indptr[row], matrix.indptr[row + 1])
    return matrix.indices[inside], matrix.data[inside]


# -------- Shots as sums of frames in memory


@dataclass(frozen=True, eq=False)
class Mixture:
    """Shots as ``weights`` (shots, b) of frames; ``least`` (b,) is shared by all shots, ``own`` is the rest."""

    weights: FloatArray
    least: FloatArray
    own: sparse.csr_array

    @property
    def sparse(self) -> bool:
        return bool(self.own.nnz <= _FEW * len(self.weights))

    def shots(self, basis: FloatArray, start: int, stop: int) -> Sequence[FloatArray]:
        if not self.sparse:
            return list(mix_frames(self.weights[start:stop], basis))
        common = mix_frames(self.least[None], basis)[0] if self.least.any() else None

        def add_up(shot: int) -> FloatArray:
            numbers, weights = _row(self.own, shot)
            if common is None and list(weights) == [1]:
                return np.asarray(basis[numbers[0]])
            total = np.zeros(basis.shape[1:]) if common is None else common.copy()
            for number, weight in zip(numbers, weights, strict=True):
                if weight == -1:
                    total -= basis[number]
                else:
                    total += basis[number] if weight == 1 else weight * basis[number]
            return total

        return in_threads(add_up, range(start, stop))


def pair_shots(weights: FloatArray) -> tuple[FloatArray, Mixture] | None:
    """Find pairs of complementary shots, which add up to the light of all pixels and halve the matrix product.

    Return None where ``weights`` (shots, classes) have other than two values, or more pairs than classes.
    """
    low, high = float(weights.min()), float(weights.max())
    lit = weights == high
    if not low < high or np.any(weights[~lit] != low):
        return None
    chosen: dict[bytes, int] = {}
    kept: list[npt.NDArray[np.bool_]] = []
    numbers, left = np.empty(len(weights), int), np.empty(len(weights), bool)
    for shot, row in enumerate(lit):
        key, other = row.tobytes(), (~row).tobytes()
        if key not in chosen and other not in chosen:
            chosen[key if row.any() else other] = len(kept)
            kept.append(row if row.any() else ~row)
        left[shot] = key not in chosen
        numbers[shot] = chosen[other if left[shot] else key]
    everything = chosen.get(np.ones(weights.shape[1], bool).tobytes())
    if everything is None or len(kept) > weights.shape[1]:
        return None
    by_pair = np.zeros((len(weights), len(kept)))
    by_pair[left, everything] = (low + high) / high
    by_pair[np.arange(len(weights)), numbers] += np.where(left, -1.0, 1.0)
    mixture = Mixture(by_pair, np.zeros(len(kept)), sparse.csr_array(by_pair))
    return np.where(np.array(kept), high, low), mixture


def mix_frames(weights: FloatArray, basis: FloatArray, out: FloatArray | None = None) -> FloatArray:
    flat = basis.reshape(len(basis), -1)
    mixed = np.empty((len(weights), flat.shape[1])) if out is None else out.reshape(len(weights), -1)

    def part(start: int) -> None:
        inside = slice(start, start + _COLUMNS)
        mixed[:, inside] = weights @ flat[:, inside]

    in_threads(part, range(0, flat.shape[1], _COLUMNS))
    return mixed.reshape(len(weights), *basis.shape[1:])


# -------- Replicates
#
# Monte Carlo error of the mean of frames of independent groups of light, and its bound.
#
# Squared norms are estimated without bias from products with random signs (Hutchinson's estimator), because forming as
# many frames as there are groups would cost more than the frames themselves.

PROBES = 8
"""Random signs beside the constant vector; probing then costs less than a frame."""
_STUDENT = 12.706205, 4.302653, 3.182446
"""97.5 % quantiles of Student's t with 1, 2, 3 and more degrees of freedom."""
_OF_ONE_KIND = 0.625
"""Power of the share of one kind of noise with which the squared bound grows: with four groups it holds in 93 to 99 %
of draws (91 % for a power of 0.75).
"""


def probe_vectors(pixels: int, seed: int) -> FloatArray:
    """Return (pixels, 1 + 8) vectors v with E sum |A v|^2 = ||A||^2: a constant one, and random signs.

    The constant vector is exact because most of a frame's error is common to its columns.
    """
    constant = np.full((pixels, 1), pixels**-0.5)
    signs = stream(seed, "probe").choice((-1.0, 1.0), size=(pixels, PROBES)) / PROBES**0.5
    return np.concatenate([constant, signs - constant @ (constant.T @ signs)], axis=1)


def noise_of_groups(probed: FloatArray, rows: int, groups: int) -> FloatArray:
    """Return the (groups, groups) inner products of the differences of groups' frames from their mean.

    No matrix product is used because the order in which BLAS adds depends on its threads.
    """
    by_group = probed.reshape(rows, groups, -1)
    off = by_group - by_group.mean(axis=1, keepdims=True)
    return np.asarray(np.einsum("rgp,rhp->gh", off, off))


def bound_of(products: FloatArray, energy: float) -> float:
    """Return the 95 % bound of a relative error from (G, G) inner ``products`` and the frames' squared norm.

    With many kinds of noise, the products have G - 1 equal eigenvalues. With one kind, the bound is that of Student's t
    with G - 1 degrees of freedom. In between, the squared bound grows with the squared norm of the products.
    """
    variance, freedom = float(np.trace(products)), len(products) - 1
    if not energy or not variance or not freedom:
        return 0.0
    one, norm = _STUDENT[min(freedom, len(_STUDENT)) - 1] ** 2, float(np.square(products).sum())
    part = (freedom * norm / variance**2 - 1) / (freedom - 1) if freedom > 1 else 1.0
    return math.sqrt((1 + (one - 1) * max(part, 0.0) ** _OF_ONE_KIND) * variance / energy)


# -------- Frames of a pattern family

_AT_ONCE, _BYTES_AT_ONCE = 32, 2**27
_LARGEST_BASIS, _BASIS_BYTES = 256, 7 * 2**28
"""Largest number of class frames in memory, and their bytes."""
_FLOAT = 8
"""Bytes per pixel."""
_ALL = sparse.csr_array(np.ones((1, 1)))
"""Mixture of ambient light: all of it."""


@dataclass(frozen=True, eq=False)
class Frame:
    """Expected irradiance (m, m') [W m^-2] of one shot, and its Monte Carlo variance (mean over pixels).

    ``removed`` is the part of the light below zero, which interpolation between anchors can leave. ``heaviest`` is the
    largest part of the variance from one group of the light: (G - 1) / G if one path dominates. ``by_group`` has the
    (G, G) inner products of the groups' contributions.
    """

    irradiance: FloatArray
    variance: float
    removed: float
    heaviest: float
    by_group: FloatArray = field(default_factory=lambda: np.zeros((1, 1)))


@dataclass(frozen=True, eq=False)
class ClassFrames:
    """Irradiance (c, m, m') [W m^-2] of increasing ``classes`` at full power; all others are zero."""

    classes: IntArray
    irradiance: FloatArray


# -------- How many frames are held


def at_once(pixels: float) -> int:
    return max(1, min(_AT_ONCE, int(_BYTES_AT_ONCE // (_FLOAT * pixels**2))))


def frames_in_memory(classes: int, shots: int, pixels: float) -> int:
    return (classes if mixes(classes, shots, pixels) else 0) + 3 * at_once(pixels)


def formed_frames(classes: int, shots: int, pixels: float) -> int:
    """Return the number of frames that are formed for a run, which asks for them twice."""
    return classes if mixes(classes, shots, pixels) else 2 * shots


def mixes(classes: int, shots: int, pixels: float) -> bool:
    return classes <= min(_LARGEST_BASIS, shots, _BASIS_BYTES // (_FLOAT * pixels**2))


# -------- All frames of a family


class ExpectedFrames:
    """Frames of every shot of a family, each with the Monte Carlo variance of its mean.

    Because light is linear, frames are formed once for the classes of projector pixels that a family always lights
    together, and mixed; a family with too many classes is formed shot by shot. The variance of the mean of G groups is
    ``sum ||F(T_g) - F(T)||^2 / (G (G - 1))``, and 0 for one group. Squared norms are estimated without bias from
    products with random signs (Hutchinson's estimator).

    ``lights`` have the same rows (classes or pixels), and their groups are paired with those of ``ambient`` (1, cells),
    which every shot has. ``lighting`` has the class of each row. ``specular`` frames are added to those of some
    classes. ``probed`` products of the same classes and seed are reused, and ``restated`` scales the Monte Carlo error.
    """

    def __init__(
        self,
        lights: Sequence[AccumulatedLight],
        lighting: Lighting,
        seed: int,
        ambient: Sequence[AccumulatedLight] = (),
        specular: ClassFrames | None = None,
        probed: FloatArray | None = None,
        restated: float = 1.0,
    ) -> None:
        self._restated = restated
        self._lights, self._ambient, self._specular = tuple(lights), tuple(ambient), specular
        self._weights = lighting.weights
        self._groups, self._shape = len(lights[0].groups), lights[0].optics.frame_shape
        self._probes = probe_vectors(self._shape[1], seed)
        (shots, classes), rows = lighting.weights.shape, lighting.labels.size
        indicator = sparse.csr_array((np.ones(rows), (lighting.labels, np.arange(rows))), shape=(classes, rows))
        self._mixed = mixes(classes, shots, side_of(self._shape))
        self._shares = np.eye(classes) if self._mixed else self._weights
        least = self._weights.min(axis=0)
        self._of_classes = Mixture(self._weights, least, sparse.csr_array(self._weights - least))
        self._pairs = pair_shots(self._weights) if self._mixed and not self._of_classes.sparse else None
        if self._mixed or shots < 2 or 2 * np.count_nonzero(self._weights == least) < self._weights.size:
            least = np.zeros(classes)
        self._leak = sparse.csr_array(sparse.csr_array(least[None]) @ indicator) if least.any() else None
        own = sparse.csr_array(self._weights - least)
        self._basis = indicator if self._mixed else sparse.csr_array(own @ indicator)
        self._probed = probed if self._mixed else None
        self._noise: FloatArray | None = None

    def __len__(self) -> int:
        return int(self._weights.shape[0])

    @property
    def has_ambient(self) -> bool:
        return bool(self._ambient)

    @property
    def projector_off(self) -> Frame:
        light = np.zeros(self._shape) if self._ambient_light is None else self._ambient_light[0][0]
        return Frame(np.maximum(light, 0.0), 0.0, 0.0, 0.0)

    @property
    def of_projector(self) -> ExpectedFrames:
        dark = copy(self)
        dark._ambient = ()
        for with_ambient in ("_ambient_light", "_energies"):
            vars(dark).pop(with_ambient, None)
        return dark

    def __iter__(self) -> Iterator[Frame]:
        step = at_once(side_of(self._shape))
        for start in range(0, len(self), step):
            stop = min(start + step, len(self))
            if self._mixed:
                (irradiance, probed), mixture = self._mixed_basis, self._pairs[1] if self._pairs else self._of_classes
                yield from self._frames(mixture.shots(irradiance, start, stop), mixture.shots(probed, start, stop))
            else:
                irradiance, probed = self._form(start, stop)
                yield from self._frames(list(irradiance), list(probed))

    # ---- Monte Carlo error, from random signs alone ----

    def sampling_error(self) -> tuple[float, float]:
        parts, energy, _ = self._energies
        return (float(np.sqrt(np.trace(parts) / energy)), bound_of(parts, energy)) if energy else (0.0, 0.0)

    @property
    def noise(self) -> tuple[FloatArray, FloatArray]:
        """Return (lights, G, G) and (ambient, G, G) parts of the variance, up to a factor; 0 if probed before."""
        of_lights = self._energies[2]
        return of_lights[: len(self._lights)], of_lights[len(self._lights) :]

    @cached_property
    def _energies(self) -> tuple[FloatArray, float, FloatArray]:
        count, energy = self._groups, 0.0
        parts, noise = np.zeros((count, count)), np.zeros((len(self._lights) + len(self._ambient), count, count))
        if count < 2:
            return parts, energy, noise
        for start in range(0, len(self), _AT_ONCE):
            stop = min(start + _AT_ONCE, len(self))
            classes, weights = self.probed, self._weights[start:stop]
            if classes is not None:
                shots = np.stack(self._of_classes.shots(classes, start, stop))
                unknown = np.zeros((1, len(self._lights), count, count))
                of_classes = unknown if self._noise is None else self._noise
                of_lights = (np.square(weights).sum(axis=0)[:, None, None, None] * of_classes).sum(axis=0)
            else:
                shots, of_shots = probe_frames(self._lights, self._basis[start:stop], self._probes)
                of_lights = of_shots.sum(axis=0)
                if self._leaked_light is not None:
                    shots += self._leaked_light[1][0]
            if self._specular is not None:  # in every group
                brought = np.repeat((self._specular.irradiance @ self._probes)[:, :, None], count, axis=2)
                shots += weights[:, self._specular.classes] @ brought.reshape(len(brought), -1)
            if self._ambient:
                seen, of_one = probe_frames(self._ambient, _ALL, self._probes)
                shots += seen
                of_lights = np.concatenate([of_lights, len(weights) * of_one[0]])
            noise += of_lights
            for probed in shots:
                energy += float(np.square(probed.reshape(self._shape[0], count, -1).mean(axis=1)).sum())
                parts += noise_of_groups(probed, self._shape[0], count)
        return parts * (self._restated**2 / (count * (count - 1))), energy, noise

    @property
    def probed(self) -> FloatArray | None:
        """Return (classes, m * groups * probes) products with random signs; None if shots are formed one by one."""
        if self._mixed and self._probed is None:
            self._probed, self._noise = probe_frames(self._lights, self._basis, self._probes)
        return self._probed

    # ---- Forming, once for all iterations ----

    @cached_property
    def _ambient_light(self) -> Formed | None:
        return self._form_with_probes(self._ambient, _ALL) if self._ambient else None

    @cached_property
    def _leaked_light(self) -> Formed | None:
        return None if self._leak is None else self._form_with_probes(self._lights, self._leak)

    @cached_property
    def _mixed_basis(self) -> tuple[FloatArray, FloatArray]:
        irradiance, probed = self._form(0, self._basis.shape[0])
        if self._pairs is None:
            return irradiance, probed
        chosen = self._pairs[0]  # the probes stay, which may be another's
        return mix_frames(chosen, irradiance, irradiance[: len(chosen)]), mix_frames(chosen, probed)

    def _form(self, start: int, stop: int) -> tuple[FloatArray, FloatArray]:
        basis = self._basis[start:stop]
        if self._probed is None:
            frames, probed = self._form_with_probes(self._lights, basis)
        else:
            frames, probed = form_frames(self._lights, basis, None)[0], self._probed[start:stop]
        if not self._mixed and self._leaked_light is not None:
            frames += self._leaked_light[0]
            probed += self._leaked_light[1]
        if self._specular is not None:
            for frame, share in zip(frames, self._shares[start:stop][:, self._specular.classes], strict=True):
                for index in np.flatnonzero(share):
                    frame += share[index] * self._specular.irradiance[index]
        return frames, probed

    def _form_with_probes(self, lights: Sequence[AccumulatedLight], basis: sparse.csr_array) -> Formed:
        return form_frames(lights, basis, self._probes if self._groups > 1 else None)

    def _frames(self, light: Sequence[FloatArray], probes: Sequence[FloatArray]) -> list[Frame]:
        ambient, count = self._ambient_light, self._groups
        pairs = count * (count - 1)

        def frame_of(row: int) -> Frame:
            frame, probed = light[row], probes[row]
            if ambient is not None:
                frame, probed = frame + ambient[0][0], probed + ambient[1][0]
            products = noise_of_groups(probed, self._shape[0], count) if pairs else np.zeros((1, 1))
            spread = float(np.trace(products))
            scale = self._restated**2 / max(pairs, 1) / frame.size
            variance, parts = spread * scale, products * scale
            heaviest = float(products.max()) / spread if spread else 0.0
            removed = 0.0
            if frame.min() < 0:
                whole, frame = float(frame.sum()), np.maximum(frame, 0)
                total = float(frame.sum())
                removed = (total - whole) / total if total else 0.0
            frame.flags.writeable = False  # a view of one that is held, which nobody may change
            return Frame(frame, variance, removed, heaviest, parts)

        return in_threads(frame_of, range(len(light)))


# -------- Speckle
#
# Laser speckle on the sensor: one realisation of coherent light, and its contrast.
#
# Integrated speckle after Goodman (Speckle Phenomena in Optics, section 4.6): light that averages over M independent
# modes (polarisations, laser lines, grains within a pixel, moments of a scanned beam) follows a gamma distribution of
# mean 1 and standard deviation C = M^(-1/2), the speckle contrast. Sensor pixels are independent, because a grain
# lambda z / D of an illuminated patch D = 120 mm is 2 um at 400 mm, below a pixel. Contrast 0 leaves light unchanged.
#
# Points u of a rough surface at distance z shine with independent phases, B(u) of their light reaches the pixel (width
# p) through the mask, and a scanned beam lights some together. With <> the mean over pairs of points u, u', weighted by
# B, and over the sensor's pixels::
#
#     C^2 = (1 + P^2) / 2  sum_kl w_k w_l mu_kl^2  < g(u - u') sinc^2(p dx / lambda z) sinc^2(p dy / lambda z) >
#
# - P is the degree of polarisation of the scattered light, because two polarisations speckle independently (Goodman,
#   3.3).
# - w_k are the lines' shares of the photons. Over heights of standard deviation h, their fields have a coherence mu_kl
#   = exp(-(4 pi h (1/lambda_k - 1/lambda_l))^2 / 2) (Goodman, chapter 6; light near the normal). Within a line of
#   standard deviation s, mu_kk^2 = (1 + (8 pi h s / lambda^2)^2)^(-1/2).
# - sinc^2 is the part of the grains of two points that remains over the area of a pixel: the van Cittert-Zernike
#   theorem, with Goodman's number of grains in an aperture (4.4). Light through fewer openings comes from fewer points.
# - g is the coherence with which the beam lights two points: 1 if all is lit at once, exp(-|u - u'|^2 / r^2) for a
#   Gaussian beam of 1/e^2 radius r, whose positions add up in one exposure as intensities.

_NODES = 16
"""Nodes of the Gauss-Legendre rule over half a triangle of distances between points of two projector pixels."""
Kernel = Callable[[FloatArray], FloatArray]
"""Function of distances along one axis [mm]."""


def add_speckle(irradiance: FloatArray, contrast: float, rng: np.random.Generator) -> FloatArray:
    if contrast == 0:
        return irradiance
    return np.asarray(irradiance * rng.gamma(contrast**-2, contrast**2, size=irradiance.shape))


def contrast_of(devices: Devices, pixels_mm: tuple[float, float], lit: FloatArray) -> float:
    """Return the mean contrast of speckle in one sensor pixel by the formula above.

    ``pixels_mm`` is the size of a projector pixel on the aligned plane, and ``lit`` the (n, n) light of each, any
    unit.
    """
    coherence, spectrum = devices.projector.speckle or Coherence(), devices.projector.spectrum
    camera, radius = devices.camera, coherence.beam_radius_mm
    wavelengths = spectrum.wavelengths_nm
    inverse, pairs = 1 / wavelengths, np.eye(len(wavelengths))
    if coherence.roughness_um is not None:
        height = 1e3 * coherence.roughness_um
        pairs = np.exp(-np.square(4 * np.pi * height * (1 / wavelengths[:, None] - 1 / wavelengths)))
        within = 1 / np.sqrt(1 + np.square(8 * np.pi * height * coherence.linewidth_nm / np.square(wavelengths)))
        np.fill_diagonal(pairs, within)
    pairs *= np.outer(spectrum.weights, spectrum.weights)

    # ---- What light of two points passes the same openings of the mask
    def one_feature(distance: FloatArray) -> FloatArray:
        apart = camera.mask_distance / (camera.scene_distance * camera.mask_feature)
        return np.asarray(np.maximum(1 - np.abs(distance) * apart, 0))

    seen: list[tuple[float, Kernel]] = [(1.0, lambda distance: 1 + one_feature(distance))]
    if camera.mask != "separable":
        means = [weight * rows.mean() * columns.mean() for weight, rows, columns in camera.build_mask().terms]
        open_part = {"open": 1.0, "flatcam": 0.5}.get(camera.mask) or float(sum(means))
        seen = [(1.0, np.ones_like), (1 / open_part - 1, one_feature)]

    # ---- Means over pairs of points, relative to the sum of squares of all pixels' light
    sizes = [2 * side for side in lit.shape]
    squared = np.square(np.abs(np.fft.rfft2(lit, sizes)))
    apart = np.fft.irfft2(squared, sizes)  # light of pairs of pixels, by how many rows and columns they are apart
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    part, share = (nodes + 1) / 2, weights / 2 * (1 - (nodes + 1) / 2)

    def mean(kernels: Iterable[Kernel]) -> float:
        total = 0.0
        for weight, through in seen:
            axes = []
            for kernel, size, count in zip(kernels, pixels_mm, lit.shape, strict=True):
                lags = np.fft.fftfreq(2 * count, 1 / (2 * count))[:, None]
                places = np.stack([(lags + part) * size, (lags - part) * size])
                axes.append(np.asarray((share * kernel(places) * through(places)).sum(axis=(0, 2))))
            total += weight * float(axes[0] @ apart @ axes[1])
        return total

    def grains(distance: FloatArray, width: float, wavelength_mm: float) -> FloatArray:
        kernel = np.square(np.sinc(width * distance / (wavelength_mm * camera.scene_distance)))
        return np.asarray(kernel if radius is None else kernel * np.exp(-np.square(distance / radius)))

    spaces, alone = dict[float, float](), mean([np.ones_like] * 2)
    for each in np.unique(2 / (inverse[:, None] + inverse)[pairs > 0]):
        sides = camera.active_sides
        spaces[each] = mean([partial(grains, width=side, wavelength_mm=each * 1e-6) for side in sides]) / alone
    # Two lines use grains at their mean wave number, because coherent lines are close to it.
    both = np.array([[spaces.get(2 / (k + other), 0.0) for other in inverse] for k in inverse])
    return float(np.sqrt((1 + coherence.polarisation**2) / 2 * (pairs * both).sum()))


# -------- Irradiance from beams that mirrors carry to the sensor
#
# A beam is a quadrilateral of one projector pixel's window with a known flux. Its four corner rays give the place
# where it lands, and quantities between them are bilinear. A beam is cut into boxes of at most half a sensor pixel,
# and each box gives the pixels that it overlaps their part of the flux times the mask's mean. Because boxes tile the
# beam, flux is conserved. Coordinates are centred index coordinates (s_row = -y, s_col = -x) in mm.

_BOXES_AT_ONCE = 2**18
_POINT = 1e-9
_Cut = tuple[IntArray, FloatArray, FloatArray, tuple[float, float]]
"""Beams, places of boxes along both sides, and sides of a box, in parts of a beam's sides."""
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


def specular_frames(
    beams: Beams, geometry: CameraGeometry, terms: Sequence[SampledTerm], labels: IntArray, boxes_per_pixel: int = 2
) -> ClassFrames:
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
    for those, a, b, size in _cuts(beams, reached, min(geometry.pitches) / boxes_per_pixel):
        # ---- Boxes that the sensor sees within the field stop: place, size and tangent at the middle, and flux
        corners, tangents = beams.sensor[those], beams.tangent[those]
        place, tangent = _bilinear(corners, a, b), _bilinear(tangents, a, b)
        along, across = _gradients(corners, a, b)
        extent = np.hypot(along * size[0], across * size[1])
        extent = np.maximum(extent, _POINT * min(geometry.pitches))
        seen = (np.abs(place) < geometry.half_width + extent / 2).all(axis=-1)
        seen &= (np.abs(tangent) <= geometry.tan_half_fov).all(axis=-1)
        throughput = _bilinear(beams.throughput[those][..., None], a, b)[..., 0]
        light = (beams.flux[those, None, None] * throughput)[seen] * (size[0] * size[1])
        owner = np.broadcast_to(np.arange(len(those))[:, None, None], seen.shape)[seen]
        place, extent, tangent = place[seen], extent[seen], tangent[seen]
        squared = np.square(tangent[:, 0]) + np.square(tangent[:, 1])
        light = light * (geometry.pixel_fill_factor * geometry.angular_response(squared))
        magnification = (1 + geometry.mask_distance * _slope(corners, tangents))[owner]
        slot = np.searchsorted(classes, labels[beams.pixel[those[owner]]])

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
                met = np.flatnonzero(flux)
                passed = np.zeros(len(met))
                for weight, left, right in shadows:
                    passed = passed + weight * left[i][met] * right[j][met]
                flat = (slot[met] * shape[0] + row[met]) * shape[1] + column[met]
                np.add.at(frames.reshape(-1), flat, flux[met] * passed)
    used, area = frames.any(axis=(1, 2)), math.prod(geometry.active_sides)
    return ClassFrames(classes[used].astype(np.int64), frames[used] / area)


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
                yield alike[start : start + step], a, b, (1 / rows, 1 / columns)


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
