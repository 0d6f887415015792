"""Solvers of cameras whose light is one shifted pattern: conjugate gradients, or direct under dots.

A diffuser before a bare sensor casts one pattern of light h from every scene point, shifted by its place (Antipa et
al., Optica 5, 1, 2018). Under the pattern P_i (arXiv 2111.12862, section "Coded Illumination with Nonseparable
Systems") the frame is Y_i = crop( h * (P_i o X) ). One scene pixel shifts h by one sensor pixel. The image minimises
sum_i ||Y_i - crop(h * (P_i o X))||^2 + lambda ||X||^2.

Under dots of period k no pixel is in two frames, so that the normal equations fall into k^2 independent systems, one
for the n^2/k^2 pixels of each *class* that shines together, as in the paper's equation 8. Within a class

    G[p, p'] = sum over sensor pixels s of h[s - p] h[s - p'],       p - p' a multiple of k

**Whole light.** Where the sensor gets all light, G depends on p - p' alone: it is a section of one convolution with h's
autocorrelation at every k-th place, the same for all classes, and is solved on grids of 2n/k pixels a side.

**Cropped.** Elsewhere the entries of G are sums of h[u] h[u + p - p'] over a window of u, which cumulative sums give
exactly, and each class is factorised by Cholesky. Classes of too many pixels are solved by conjugate gradients with the
crop in each step, preconditioned by a division by S + lambda, where S is the spectrum |H|^2 folded k times.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import fft, linalg

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import in_threads
from mitsim.devices.patterns import parse_patterns
from mitsim.reconstruct.point_spread import ShiftedLight
from mitsim.reconstruct.solution import Solution, Status, Verdict
from mitsim.reconstruct.solver import check_lambda

Operator = Callable[[FloatArray], FloatArray]
Watch = Callable[[FloatArray], bool]


def solve_iteratively(
    camera: ShiftedLight,
    frames: FloatArray,
    lam: float,
    tolerance: float = 1e-6,
    iterations: int = 500,
    watch: Watch | None = None,
) -> Solution:
    camera.check_frames(frames)
    target = camera.correlate(frames)
    return conjugate_gradients(
        lambda image: camera.correlate(camera.image_of(image)), target, lam, None, tolerance, iterations, watch
    )


def conjugate_gradients(
    normal: Operator,
    target: FloatArray,
    lam: float | str,
    inverse: Operator | None = None,
    tolerance: float = 1e-6,
    most: int = 500,
    watch: Watch | None = None,
) -> Solution:
    """Solve (``normal`` + lambda) X = ``target`` (Hestenes and Stiefel 1952).

    The preconditioner ``inverse`` is symmetric and positive. Steps end early when ``watch`` returns True.
    """
    lam = check_lambda(lam)
    image, left = np.zeros_like(target), target
    size = float(np.linalg.norm(target)) or 1.0
    turned = inverse(left) if inverse else left
    direction, power, spent = turned, float(np.vdot(left, turned)), 0
    residual = float(np.linalg.norm(left)) / size
    while residual > tolerance and spent < most:
        spent += 1
        moved = normal(direction) + lam * direction
        step = power / float(np.vdot(direction, moved))
        image, left = image + step * direction, left - step * moved
        residual = float(np.linalg.norm(left)) / size
        if watch and watch(image):
            break
        turned = inverse(left) if inverse else left
        before, power = power, float(np.vdot(left, turned))
        direction = turned + power / before * direction
    figures = f"Residual of the normal equations {residual:.0e} after {spent} iterations."
    if residual > tolerance:
        remedy = "allow more iterations, a larger tolerance or a larger lambda"
        status = Status(Verdict.NOT_CONVERGED, f"Not converged to {tolerance:g}", remedy, figures)
    else:
        status = Status(Verdict.SOLVED, "Solved", "", figures)
    return Solution(image, lam, residual, status, iterations=spent)


# ---- Frames under dots of period k, solved directly, class by class --------------------------------------------------


MOST_FACTORISED = 2048
"""Largest number of pixels of a factorised class; all classes of 128 x 128 scene pixels then take 270 MB."""


class Classes:
    """A ``camera`` under shifting dots of period ``k``; 1 is uniform light."""

    def __init__(self, camera: ShiftedLight, k: int) -> None:
        self.camera, self.k, self._n = camera, k, camera.scene[0]
        if not 1 <= k <= self._n:
            raise MitsimError(f"dots of period {k}: give 1 to {self._n}, the scene's pixels a side")
        self._lit = camera.under(parse_patterns(f"dots:{k}", self._n))
        self._side = -(-self._n // k)
        self.cropped = camera.sensor != camera.whole
        self.factorised = self.cropped and self._side**2 <= MOST_FACTORISED
        self._grid = [fft.next_fast_len(-(-size // k)) for size in camera.whole]
        self._spectrum = fft.fft2(camera.psf, tuple(k * size for size in self._grid))
        self._power: FloatArray = self._fold(np.square(np.abs(self._spectrum))).real
        self.largest = float(self._power.max())

    def project(self, frames: FloatArray) -> FloatArray:
        self._lit.check_frames(frames)
        weight = self._spectrum.conj()
        (row, column), (rows, columns) = self.camera.origin, self.camera.sensor
        classes = np.empty((self.k, self.k, self._side, self._side))
        for (a, b), frame in zip(product(range(self.k), repeat=2), frames, strict=True):
            placed = np.zeros(weight.shape)
            # Moved so that the class's first pixel is the first number.
            placed[:rows, :columns] = frame
            placed = np.roll(placed, (row - a, column - b), axis=(0, 1))
            light = fft.ifft2(self._fold(fft.fft2(placed) * weight))
            classes[a, b] = light.real[: self._side, : self._side]
        return self._join(classes)

    def factorise(self, lam: float) -> FactorisedClasses:
        lam = check_lambda(lam)
        if not self.factorised:
            return FactorisedClasses(self, lam, None)
        grams = self._grams.reshape(self.k**2, self._side**2, self._side**2)
        lit = self._split(np.ones((self._n,) * 2)).reshape(self.k**2, -1) > 0

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

    def normal(self, image: FloatArray) -> FloatArray:
        if self.cropped:
            return self._lit.correlate(self._lit.image_of(image))
        size, kernel = self._section
        whole = fft.irfft2(fft.rfft2(self._split(image), size) * kernel, size)
        return self._join(whole[..., : self._side, : self._side])

    def inverse(self, lam: float) -> Operator:
        least = max(lam, float(np.finfo(np.float64).eps) * self.largest)
        weight = 1 / (self._power[:, : self._grid[1] // 2 + 1] + least)

        def divide(image: FloatArray) -> FloatArray:
            spectra = fft.rfft2(self._split(image), self._grid) * weight
            return self._join(fft.irfft2(spectra, self._grid)[..., : self._side, : self._side])

        return divide

    def _fold(self, spectrum: npt.NDArray[Any]) -> npt.NDArray[Any]:
        rows, columns = self._grid
        return np.asarray(spectrum.reshape(self.k, rows, self.k, columns).mean(axis=(0, 2)))

    def _split(self, image: FloatArray) -> FloatArray:
        room = self._side * self.k - self._n
        padded = np.pad(image, ((0, room), (0, room)))
        return padded.reshape(self._side, self.k, self._side, self.k).transpose(1, 3, 0, 2)

    def _join(self, classes: FloatArray) -> FloatArray:
        size = self._side * self.k
        return np.ascontiguousarray(classes.transpose(2, 0, 3, 1).reshape(size, size)[: self._n, : self._n])

    @cached_property
    def _section(self) -> tuple[tuple[int, int], npt.NDArray[np.complex128]]:
        size = fft.next_fast_len(2 * self._side - 1, real=True)
        steps = (np.arange(size) + size // 2) % size - size // 2
        near = np.abs(steps) < self._side
        rows, columns = (steps % length for length in self._grid)
        kernel = np.where(np.outer(near, near), fft.ifft2(self._power).real[np.ix_(rows, columns)], 0.0)
        return (size, size), np.asarray(fft.rfft2(kernel))

    @cached_property
    def _grams(self) -> FloatArray:
        k, side, psf = self.k, self._side, self.camera.psf
        grams = np.zeros((k, k, side, side, side, side))

        def fill(step: tuple[int, int]) -> None:
            # Each pixel's light times that of a pixel above and to the left, summed over the sensor.
            below, right = (k * each for each in step)
            first, last = max(-right, 0), psf.shape[1] - max(right, 0)
            if below >= len(psf) or last <= first:
                return
            both = psf[: len(psf) - below, first:last] * psf[below:, first + right : last + right]
            for axis, start in ((0, 0), (1, first)):
                sums = np.insert(np.cumsum(both, axis=axis), 0, 0.0, axis=axis)
                # Sensor pixel s is place s - p of the light of pixel p.
                edge = self.camera.origin[axis] - np.arange(self._n) - start
                ends = np.clip([edge, edge + self.camera.sensor[axis]], 0, both.shape[axis])
                both = np.take(sums, ends[1], axis=axis) - np.take(sums, ends[0], axis=axis)
            if right < 0:
                both[:, right:] = 0  # their partner is beyond the scene's edge
            down, across = step
            i = np.arange(down, side)[:, None]
            j = np.arange(max(across, 0), side + min(across, 0))[None, :]
            grams[:, :, i, j, i - down, j - across] = self._split(both)[:, :, i, j]

        steps = product(range(side), range(1 - side, side))
        in_threads(fill, [(below, right) for below, right in steps if below or right >= 0])
        return grams


@dataclass(frozen=True, eq=False)
class FactorisedClasses:
    classes: Classes
    lam: float
    factors: list[FloatArray] | None

    def solve(self, projected: FloatArray, tolerance: float = 1e-6) -> Solution:
        classes = self.classes
        if self.factors is None:
            # On a section's small grids the division would take longer than the steps that it saves.
            inverse = classes.inverse(self.lam) if classes.cropped else None
            return conjugate_gradients(classes.normal, projected, self.lam, inverse, tolerance)
        image = classes._split(projected).copy()
        for index, factor in enumerate(self.factors):
            place = divmod(index, classes.k)
            found = linalg.cho_solve((factor, True), image[place].ravel(), check_finite=False)
            image[place] = found.reshape(image[place].shape)
        status = Status(Verdict.SOLVED, "Solved", "", f"{classes.k**2} classes of {factor.shape[0]} pixels factorised.")
        return Solution(classes._join(image), self.lam, 0.0, status)
