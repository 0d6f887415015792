"""Frames of a convolutional camera under dots of period k in; the image out, directly, class by class.

Under dots of period k no two pixels of one frame are nearer than k, and no pixel is in two frames: the normal equations
of :mod:`mitsim.reconstruct.convolution` fall into k^2 independent systems, one for the n^2/k^2 pixels of each *class*
(those that shine together), as the paper's equation 8 does for separable cameras. Within a class

    G[p, p'] = sum over sensor pixels s of h[s - p] h[s - p'],       p - p' a multiple of k

**Whole light.** Where the sensor gets all light, G depends on p - p' alone: it is one convolution with h's
autocorrelation r taken at every k-th place, the same for all classes. On the whole plane the equations are solved by a
division, in the Fourier domain, by S + lambda, where S is the spectrum |H|^2 folded k times (:meth:`Classes.divided`).
That answer takes the plane beyond the projector's window for unknown; the one that knows it to be dark solves a section
of that convolution, by conjugate gradients on grids of 2n/k pixels a side, all frames' transforms being done with once.

**Cropped.** At the sensor's edges light is lost, and G hangs on p too. Its entries are sums of h[u] h[u + p - p'] over
a window of u, which sums along rows and columns give for all pixels at once, exactly; then each class is factorised by
Cholesky. Classes of too many pixels are solved by conjugate gradients with the crop in each step, for which the
division is near the inverse and saves a third to a half of the steps.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
import numpy.typing as npt
from scipy import fft, linalg

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import in_threads, single_threaded_blas
from mitsim.reconstruct.convolution import ConvolutionalCamera, Operator, check_lambda, conjugate_gradients
from mitsim.reconstruct.solver import Prepared
from mitsim.reconstruct.status import Solution, Status, Verdict

MOST_FACTORISED = 2048
"""Pixels of a class up to which it is factorised: at 128 x 128 scene pixels all classes then take 270 MB, and their
factors as much; one of 4096 pixels takes 23 Gflop, more than its conjugate gradients."""


@dataclass(frozen=True, eq=False)
class Classes:
    """A ``camera`` under shifting dots of period ``k``; 1 is uniform light. Frames are those of ``dots:k``."""

    camera: ConvolutionalCamera
    k: int

    def __post_init__(self) -> None:
        if not 1 <= self.k <= self.camera.n:
            raise MitsimError(f"dots of period {self.k}: give 1 to {self.camera.n}, the scene's pixels a side")

    @property
    def factorised(self) -> bool:
        """Whether normal matrices are formed and factorised."""
        return self.camera.cropped and self._side**2 <= MOST_FACTORISED

    @property
    def largest(self) -> float:
        """Largest of S: what lambda is to be compared with."""
        return float(self._power.max())

    def projected(self, frames: Iterable[FloatArray]) -> FloatArray:
        """(n, n) sum of all ``frames`` weighted by the light of each scene pixel: `ConvolutionalCamera.projected`, each
        frame taken at its own pixels only."""
        return self._interleaved(spectrum for spectrum in self._folded(frames))

    def divided(self, frames: Iterable[FloatArray], lam: float) -> FloatArray:
        """(n, n) image by one division, of ``frames`` at ``lam``: the Tikhonov image of a plane without a dark
        surround, exact for the whole light."""
        weight = 1 / (self._power + check_lambda(lam))
        return self._interleaved(spectrum * weight for spectrum in self._folded(frames))

    def factorise(self, lam: float) -> FactorisedClasses:
        """All classes at ``lam``, ready for any number of scenes.

        MitsimError for another lambda, or where a class is too ill-conditioned for it.
        """
        lam = check_lambda(lam)
        if not self.factorised:
            return FactorisedClasses(self, lam, None)
        grams = self._grams.reshape(self.k**2, self._side**2, self._side**2)
        lit = self._split(np.ones((self.camera.n,) * 2)).reshape(self.k**2, -1) > 0

        def factor(index: int) -> FloatArray:
            gram = grams[index].copy()
            # Places beyond the scene's edge, in classes of fewer pixels, are unknowns of their own that stay zero.
            gram[np.diag_indices_from(gram)] += np.where(lit[index], lam, 1.0)
            try:
                return np.asarray(linalg.cholesky(gram, lower=True, overwrite_a=True, check_finite=False))
            except linalg.LinAlgError as error:
                raise MitsimError(
                    f"class {divmod(index, self.k)} of dots:{self.k} is singular at lambda {lam:g}; raise it"
                ) from error

        return FactorisedClasses(self, lam, in_threads(factor, range(self.k**2)))

    # ---- equations

    def normal(self, image: FloatArray) -> FloatArray:
        """(n, n) product of the normal matrix of all classes with an ``image`` (n, n)."""
        if not self.camera.cropped:
            classes = fft.rfft2(self._split(image), self._section[0])
            whole = fft.irfft2(classes * self._section[1], self._section[0])
            return self._joined(whole[..., : self._side, : self._side])
        light = np.zeros_like(image)
        total = np.zeros_like(image)
        for a, b in product(range(self.k), repeat=2):
            pixels = slice(a, None, self.k), slice(b, None, self.k)
            light[pixels] = image[pixels]
            total[pixels] = self.camera.correlated(self.camera.image_of(light))[pixels]
            light[pixels] = 0
        return total

    def inverse(self, lam: float) -> Operator:
        """Division of an image by S + ``lam``: near the normal matrix's inverse, symmetric and positive."""
        least = max(lam, float(np.finfo(np.float64).eps) * self.largest)
        weight = 1 / (self._power[:, : self._grid[1] // 2 + 1] + least)

        def divide(image: FloatArray) -> FloatArray:
            spectra = fft.rfft2(self._split(image), self._grid) * weight
            return self._joined(fft.irfft2(spectra, self._grid)[..., : self._side, : self._side])

        return divide

    # ---- grids

    @property
    def _side(self) -> int:
        """Pixels a side of the largest class."""
        return -(-self.camera.n // self.k)

    @property
    def _grid(self) -> tuple[int, int]:
        """Every k-th place of a grid that holds the whole light."""
        rows, columns = (fft.next_fast_len(-(-size // self.k)) for size in self.camera.whole)
        return rows, columns

    @cached_property
    def _spectrum(self) -> npt.NDArray[np.complex128]:
        return np.asarray(fft.fft2(self.camera.psf, tuple(self.k * size for size in self._grid)))

    def _fold(self, spectrum: npt.NDArray[np.complex128]) -> npt.NDArray[np.complex128]:
        """Spectrum of every k-th number from the first on."""
        rows, columns = self._grid
        return np.asarray(spectrum.reshape(self.k, rows, self.k, columns).mean(axis=(0, 2)))

    @cached_property
    def _power(self) -> FloatArray:
        """S: spectrum of the autocorrelation at every k-th place."""
        power = np.square(np.abs(self._spectrum))
        return np.asarray(self._fold(power).real)

    @cached_property
    def _section(self) -> tuple[tuple[int, int], npt.NDArray[np.complex128]]:
        """Grid, and spectrum on it, of the autocorrelation between pixels of one class."""
        size = fft.next_fast_len(2 * self._side - 1, real=True)
        steps = (np.arange(size) + size // 2) % size - size // 2
        near = np.abs(steps) < self._side
        correlation = fft.ifft2(self._power).real
        rows, columns = (steps % length for length in self._grid)
        kernel = np.where(np.outer(near, near), correlation[np.ix_(rows, columns)], 0.0)
        return (size, size), np.asarray(fft.rfft2(kernel))

    def _folded(self, frames: Iterable[FloatArray]) -> Iterator[npt.NDArray[np.complex128]]:
        """Spectrum of each frame's correlation with h at the pixels of its class."""
        weight = self._spectrum.conj()
        (row, column), (rows, columns) = self.camera.origin, self.camera.shape
        for (a, b), frame in zip(product(range(self.k), repeat=2), self.camera.checked(frames, self.k**2), strict=True):
            placed = np.zeros(self._spectrum.shape)
            # Moved so that the class's first pixel is the first number.
            placed[:rows, :columns] = frame
            placed = np.roll(placed, (row - a, column - b), axis=(0, 1))
            yield self._fold(fft.fft2(placed) * weight)

    def _interleaved(self, spectra: Iterable[npt.NDArray[np.complex128]]) -> FloatArray:
        """Image (n, n) of the spectra of its classes."""
        classes = np.empty((self.k**2, self._side, self._side))
        for place, spectrum in zip(classes, spectra, strict=True):
            place[:] = fft.ifft2(spectrum).real[: self._side, : self._side]
        return self._joined(classes.reshape(self.k, self.k, self._side, self._side))

    def _split(self, image: FloatArray) -> FloatArray:
        """(k, k, side, side) classes of an image, zero beyond its edge."""
        room = self._side * self.k - self.camera.n
        padded = np.pad(image, ((0, room), (0, room)))
        return padded.reshape(self._side, self.k, self._side, self.k).transpose(1, 3, 0, 2)

    def _joined(self, classes: FloatArray) -> FloatArray:
        """Image (n, n) of its classes."""
        size = self._side * self.k
        return np.ascontiguousarray(classes.transpose(2, 0, 3, 1).reshape(size, size)[: self.camera.n, : self.camera.n])

    @cached_property
    def _grams(self) -> FloatArray:
        """(k, k, side, side, side, side) lower triangles of all normal matrices: what pixels (i, j) and (i', j') of a
        class share on the sensor."""
        k, side = self.k, self._side
        grams = np.zeros((k, k, side, side, side, side))

        def fill(step: tuple[int, int]) -> None:
            below, right = step
            i = np.arange(below, side)[:, None]
            j = np.arange(max(right, 0), side + min(right, 0))[None, :]
            shared = self._split(self._shared(below * k, right * k))
            grams[:, :, i, j, i - below, j - right] = shared[:, :, i, j]

        steps = product(range(side), range(1 - side, side))
        in_threads(fill, [(below, right) for below, right in steps if below or right >= 0])
        return grams

    def _shared(self, below: int, right: int) -> FloatArray:
        """(n, n) sum over the sensor of each pixel's light times that of the pixel so far above and to the left."""
        psf, (rows, columns) = self.camera.psf, self.camera.psf.shape
        first, last = max(-right, 0), columns - max(right, 0)
        if below >= rows or last <= first:
            return np.zeros((self.camera.n,) * 2)
        both = psf[: rows - below, first:last] * psf[below:, first + right : last + right]
        for axis, start in ((0, 0), (1, first)):
            sums = np.insert(np.cumsum(both, axis=axis), 0, 0.0, axis=axis)
            # Sensor pixel s is place s - p of the light of pixel p.
            edge = self.camera.origin[axis] - np.arange(self.camera.n) - start
            ends = np.clip([edge, edge + self.camera.shape[axis]], 0, both.shape[axis])
            both = np.take(sums, ends[1], axis=axis) - np.take(sums, ends[0], axis=axis)
        if right < 0:
            both[:, right:] = 0  # their partner is beyond the scene's edge
        return both


@dataclass(frozen=True, eq=False)
class FactorisedClasses:
    """``classes`` at one ``lam``; with the Cholesky factors of each, or None where conjugate gradients solve them."""

    classes: Classes
    lam: float
    factors: list[FloatArray] | None

    def solve(self, projected: FloatArray, tolerance: float = 1e-6) -> Solution:
        """The Tikhonov image of frames.

        Parameters
        ----------
        projected
            (n, n) :meth:`Classes.projected` of them.
        tolerance
            relative residual of the normal equations at which conjugate gradients end.
        """
        classes = self.classes
        if self.factors is None:
            # On a section's small grids the division would take longer than the steps that it saves.
            inverse = classes.inverse(self.lam) if classes.camera.cropped else None
            return conjugate_gradients(classes.normal, projected, self.lam, inverse, tolerance)
        targets = classes._split(projected)
        image = np.empty_like(targets)
        for index, factor in enumerate(self.factors):
            place = divmod(index, classes.k)
            image[place] = linalg.cho_solve((factor, True), targets[place].ravel(), check_finite=False).reshape(
                image[place].shape
            )
        status = Status(Verdict.SOLVED, "Solved", "", f"{classes.k**2} classes of {factor.shape[0]} pixels factorised.")
        return Solution(classes._joined(image), self.lam, 0.0, status)


# -------- Frames under shifting dots and the factorised model in

_LEAST_TOLD = 1e-3
"""Part of a mode that must remain: noise in it is magnified by the root of one over that, thirtyfold, which the mean
over all frames makes up for."""


@dataclass(frozen=True, eq=False)
class Separation:
    """Light that is in all frames alike.

    Attributes
    ----------
    common
        (m, m') of each frame, in the frames' unit; to be taken off.
    image
        (n, n') reflectance that it looks like under uniform light, all of it from lit pixels.
    told
        (modes,) part of each mode of it that lit pixels do not explain, smallest first.
    """

    common: FloatArray
    image: FloatArray
    told: FloatArray


@single_threaded_blas()
def separate(
    model: Prepared,
    seen: tuple[FloatArray, FloatArray],
    patterns: tuple[FloatArray, FloatArray],
    weights: FloatArray,
    total: FloatArray,
) -> Separation:
    """Global light of frames under patterns of 0 and 1.

    Parameters
    ----------
    model
        the factorised model of these patterns.
    seen
        Phi_L (m, n + 2 w) and Phi_R (m', n' + 2 w'): factors with w columns beside the window on either side, as
        :meth:`mitsim.reconstruct.focus.FactorOfDepths.beyond` makes them, or none.
    patterns
        P_L (n, K) and P_R (n', K'), shifting dots.
    weights, total
        W (r, r') and the sum (m, m') of all frames.

    Raises
    ------
    MitsimError
        for patterns under which global light looks like an image: uniform light, +-1, a factor of centred frames.
    """
    if model.centre or any((side < 0).any() for side in patterns):
        raise MitsimError("separation: takes dots before a mask that is not centred; use dots:K")
    nodes = [_hats(factor.shape[1], side.shape[1]) for factor, side in zip(seen, patterns, strict=True)]
    bases, triangles = zip(*(np.linalg.qr(side @ hats) for side, hats in zip(seen, nodes, strict=True)), strict=True)
    lit = [side.common.T @ basis for side, basis in zip((model.left, model.right), bases, strict=True)]
    shape = bases[0].shape[1], bases[1].shape[1]
    count = model.left.pattern_count * model.right.pattern_count
    measured = (model.sigma > 0).astype(np.float64)
    target = bases[0].T @ total @ bases[1] - lit[0].T @ (measured * weights) @ lit[1]
    unexplained: FloatArray = np.eye(target.size) - _explained(lit, measured) / count
    told, modes = np.linalg.eigh(unexplained)
    if told[-1] < _LEAST_TOLD:
        raise MitsimError("separation: these patterns light all pixels in each frame; use dots:K with K of 2 or more")
    inverse = np.divide(1.0, count * told, out=np.zeros_like(told), where=told > _LEAST_TOLD)
    found = (modes @ (inverse * (modes.T @ target.ravel()))).reshape(shape)
    left, right = (
        _inside(hats, len(side)) @ np.linalg.inv(triangle)
        for hats, side, triangle in zip(nodes, patterns, triangles, strict=True)
    )
    part = float(np.prod([side.mean() for side in patterns]))
    return Separation(bases[0] @ found @ bases[1].T, left @ found @ right.T / part, told)


def _inside(hats: FloatArray, pixels: int) -> FloatArray:
    """Rows of ``hats`` within the window of so many ``pixels``."""
    margin = (len(hats) - pixels) // 2
    return hats[margin : margin + pixels]


def _hats(pixels: int, period: int) -> FloatArray:
    """(pixels, J) functions that are linear between J nodes ``period`` apart, the outer ones at the window's ends."""
    count = max(2, 1 + -(-(pixels - 1) // period))
    place = np.arange(pixels) * (count - 1) / max(pixels - 1, 1)
    return np.asarray(np.maximum(0.0, 1 - np.abs(place[:, None] - np.arange(count))))


def _explained(lit: Sequence[FloatArray], measured: FloatArray) -> FloatArray:
    """(J J', J J') matrix of f -> A_L^T (A_L f A_R^T) A_R, of what is ``measured`` (r, r')."""
    pairs = [(side[:, :, None] * side[:, None, :]).reshape(len(side), -1) for side in lit]
    sizes = [side.shape[1] for side in lit]
    product = (pairs[0].T @ measured @ pairs[1]).reshape(sizes[0], sizes[0], sizes[1], sizes[1])
    size = sizes[0] * sizes[1]
    return np.asarray(product.transpose(0, 2, 1, 3).reshape(size, size))
