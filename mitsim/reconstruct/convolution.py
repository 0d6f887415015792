"""A point spread function, patterns and frames in; the image that fits them out, by conjugate gradients, or directly.

A camera whose scene points all cast one pattern of light, each shifted by its place, as a diffuser before a bare sensor
does (Antipa et al., Optica 5, 1, 2018), sees under the pattern P_i (arXiv 2111.12862, section "Coded Illumination with
Nonseparable Systems")

    Y_i = crop( h * (P_i o X) )

h sums to 1, one scene pixel shifts it by one sensor pixel, and the crop is the sensor, centred in all that the light
reaches.
The image minimises sum_i ||Y_i - crop(h * (P_i o X))||^2 + lambda ||X||^2. :func:`solve_iteratively` does what is left
where no closed form is known: conjugate gradients on the normal equations, each step a convolution and a correlation of
every frame. :class:`Classes` solves the same equations directly where patterns are dots.

Under dots of period k no two pixels of one frame are nearer than k, and no pixel is in two frames: the normal equations
fall into k^2 independent systems, one for the n^2/k^2 pixels of each *class* (those that shine together), as the
paper's equation 8 does for separable cameras. Within a class

    G[p, p'] = sum over sensor pixels s of h[s - p] h[s - p'],       p - p' a multiple of k

**Whole light.** Where the sensor gets all light, G depends on p - p' alone: it is one convolution with h's
autocorrelation r taken at every k-th place, the same for all classes. On the whole plane the equations are solved by a
division, in the Fourier domain, by S + lambda, where S is the spectrum |H|^2 folded k times (:meth:`Classes.divide`).
That answer takes the plane beyond the projector's window for unknown; the one that knows it to be dark solves a section
of that convolution, by conjugate gradients on grids of 2n/k pixels a side, all frames' transforms being done with once.

**Cropped.** At the sensor's edges light is lost, and G hangs on p too. Its entries are sums of h[u] h[u + p - p'] over
a window of u, which sums along rows and columns give for all pixels at once, exactly; then each class is factorised by
Cholesky. Classes of too many pixels are solved by conjugate gradients with the crop in each step, for which the
division is near the inverse and saves a third to a half of the steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
import numpy.typing as npt
from scipy import fft, linalg

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import in_threads
from mitsim.devices.patterns import PatternFamily
from mitsim.reconstruct.solution import Solution, Status, Verdict

Operator = Callable[[FloatArray], FloatArray]
"""From an image (n, n) to another."""
Watch = Callable[[FloatArray], bool]
"""Looks at an image (n, n) under way, and says whether it is good enough."""


@dataclass(frozen=True, eq=False)
class ConvolutionalCamera:
    """A point spread function over a scene of n x n pixels.

    Attributes
    ----------
    psf
        (rows, columns) light of one scene pixel, in sensor pixels; usually of sum 1.
    n
        scene pixels a side.
    sensor
        (rows, columns) of the sensor, centred; None: all that any scene pixel's light reaches.
    """

    psf: FloatArray
    n: int
    sensor: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if self.psf.ndim != 2 or not np.isfinite(self.psf).all() or not self.psf.any():
            raise MitsimError(f"point spread function of shape {self.psf.shape}: give finite rows x columns, not all 0")
        if self.n < 1:
            raise MitsimError(f"scene of {self.n} pixels a side; give at least 1")
        if any(not 1 <= size <= most for size, most in zip(self.shape, self.whole, strict=True)):
            raise MitsimError(
                f"sensor of {self.shape[0]} x {self.shape[1]} pixels; give 1 x 1 to {self.whole[0]} x {self.whole[1]}, "
                "what the light of the whole scene reaches"
            )

    @property
    def whole(self) -> tuple[int, int]:
        """Rows and columns that any scene pixel's light reaches."""
        rows, columns = self.psf.shape
        return rows + self.n - 1, columns + self.n - 1

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the sensor."""
        return self.sensor or self.whole

    @property
    def cropped(self) -> bool:
        """Whether light falls beside the sensor."""
        return self.shape != self.whole

    @property
    def origin(self) -> tuple[int, int]:
        """Row and column of the whole light at which the sensor begins."""
        rows, columns = ((most - size) // 2 for size, most in zip(self.shape, self.whole, strict=True))
        return rows, columns

    def image_of(self, scene: npt.ArrayLike) -> FloatArray:
        """What the sensor sees of a ``scene`` (n, n) of shining pixels."""
        spectrum = fft.rfft2(np.asarray(scene, dtype=np.float64), self._grid) * self._spectrum
        (row, column), (rows, columns) = self.origin, self.shape
        return np.asarray(fft.irfft2(spectrum, self._grid)[row : row + rows, column : column + columns])

    def correlate(self, frame: npt.ArrayLike) -> FloatArray:
        """Adjoint of :meth:`image_of`: (n, n) sum of a ``frame`` weighted by the light of each scene pixel."""
        (row, column), (rows, columns) = self.origin, self.shape
        placed = np.zeros(self._grid)
        placed[row : row + rows, column : column + columns] = frame
        return np.asarray(fft.irfft2(fft.rfft2(placed) * self._spectrum.conj(), self._grid)[: self.n, : self.n])

    def frames(self, family: PatternFamily, scene: npt.ArrayLike) -> Iterator[FloatArray]:
        """The noise-free frame of each pattern of a ``family`` on a ``scene`` (n, n), row-major over (i, j)."""
        for light in self._lights(family):
            yield self.image_of(light * np.asarray(scene))

    def project(self, family: PatternFamily, frames: Iterable[FloatArray]) -> FloatArray:
        """Adjoint of :meth:`frames`: (n, n) sum over the patterns of a ``family`` and their ``frames``."""
        total = np.zeros((self.n, self.n))
        count = family.left.shape[1] * family.right.shape[1]
        for light, frame in zip(self._lights(family), self.check_frames(frames, count), strict=True):
            total += light * self.correlate(frame)
        return total

    def check_frames(self, frames: Iterable[FloatArray], count: int) -> Iterator[FloatArray]:
        """``frames`` one by one. MitsimError where one has not the sensor's shape or a number that is not finite,
        or where there are not ``count`` of them."""
        seen = 0
        for seen, frame in enumerate(frames, start=1):
            if seen > count or frame.shape != self.shape or not np.isfinite(frame).all():
                raise MitsimError(
                    f"frame {seen} of shape {frame.shape}, of {count} of shape {self.shape}: give as many as there are "
                    "patterns, as large as the sensor, of finite numbers"
                )
            yield frame
        if seen < count:
            raise MitsimError(f"{seen} frames for {count} patterns; give all of them")

    def _lights(self, family: PatternFamily) -> Iterator[FloatArray]:
        if family.n != self.n:
            raise MitsimError(f"patterns of {family.n} pixels a side for a scene of {self.n}; both need the same")
        for row in family.left.T:
            for column in family.right.T:
                yield np.outer(row, column).astype(np.float64)

    @property
    def _grid(self) -> tuple[int, int]:
        """The whole light and more, so that nothing wraps round, in sizes that transform fast."""
        rows, columns = (fft.next_fast_len(size, real=True) for size in self.whole)
        return rows, columns

    @cached_property
    def _spectrum(self) -> npt.NDArray[np.complex128]:
        return np.asarray(fft.rfft2(self.psf, self._grid))


def solve_iteratively(
    camera: ConvolutionalCamera,
    family: PatternFamily,
    frames: Iterable[FloatArray],
    lam: float | str,
    tolerance: float = 1e-6,
    iterations: int = 500,
    watch: Watch | None = None,
) -> Solution:
    """Tikhonov image of any ``family`` by conjugate gradients.

    Parameters
    ----------
    camera, family, frames
        what saw the patterns, these, and a frame of each, row-major over (i, j).
    lam
        lambda >= 0, in the unit of the point spread function squared.
    tolerance
        residual of the normal equations, relative, at which it ends.
    iterations
        it takes at most; that image is not ok.
    watch
        called with the image after each step; where it says True, that was the last.

    Raises
    ------
    MitsimError
        for another lambda, or frames that do not fit.
    """

    def normal(image: FloatArray) -> FloatArray:
        return camera.project(family, camera.frames(family, image))

    return conjugate_gradients(normal, camera.project(family, frames), lam, None, tolerance, iterations, watch)


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

    Parameters
    ----------
    normal
        a symmetric operator without negative eigenvalues.
    target
        right-hand side, of the shape of X.
    lam
        lambda >= 0.
    inverse
        something near the inverse of normal + lambda, symmetric and positive, which saves steps.
    tolerance, most, watch
        relative residual at which it ends, the most steps, and what ends it before: :data:`Watch`.
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


def check_lambda(lam: float | str) -> float:
    """``lam``; MitsimError where it is no finite number of at least 0."""
    if isinstance(lam, str) or not (np.isfinite(lam) and lam >= 0):
        raise MitsimError(f"lambda is {lam}; give a finite number of at least 0")
    return float(lam)


# ---- Frames under dots of period k, solved directly, class by class --------------------------------------------------


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

    def project(self, frames: Iterable[FloatArray]) -> FloatArray:
        """(n, n) sum of all ``frames`` weighted by the light of each scene pixel: `ConvolutionalCamera.project`, each
        frame taken at its own pixels only."""
        return self._interleave(spectrum for spectrum in self._fold_frames(frames))

    def divide(self, frames: Iterable[FloatArray], lam: float) -> FloatArray:
        """(n, n) image by one division, of ``frames`` at ``lam``: the Tikhonov image of a plane without a dark
        surround, exact for the whole light."""
        weight = 1 / (self._power + check_lambda(lam))
        return self._interleave(spectrum * weight for spectrum in self._fold_frames(frames))

    def factorise(self, lam: float) -> FactorisedClasses:
        """All classes at ``lam``, ready for any number of scenes.

        MitsimError for another lambda, or where a class is too ill-conditioned for it.
        """
        lam = check_lambda(lam)
        if not self.factorised:
            return FactorisedClasses(self, lam, None)
        grams = self._grams.reshape(self.k**2, self._side**2, self._side**2)
        lit = self._split_classes(np.ones((self.camera.n,) * 2)).reshape(self.k**2, -1) > 0

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
            classes = fft.rfft2(self._split_classes(image), self._section[0])
            whole = fft.irfft2(classes * self._section[1], self._section[0])
            return self._join(whole[..., : self._side, : self._side])
        light = np.zeros_like(image)
        total = np.zeros_like(image)
        for a, b in product(range(self.k), repeat=2):
            pixels = slice(a, None, self.k), slice(b, None, self.k)
            light[pixels] = image[pixels]
            total[pixels] = self.camera.correlate(self.camera.image_of(light))[pixels]
            light[pixels] = 0
        return total

    def inverse(self, lam: float) -> Operator:
        """Division of an image by S + ``lam``: near the normal matrix's inverse, symmetric and positive."""
        least = max(lam, float(np.finfo(np.float64).eps) * self.largest)
        weight = 1 / (self._power[:, : self._grid[1] // 2 + 1] + least)

        def divide(image: FloatArray) -> FloatArray:
            spectra = fft.rfft2(self._split_classes(image), self._grid) * weight
            return self._join(fft.irfft2(spectra, self._grid)[..., : self._side, : self._side])

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

    def _fold_frames(self, frames: Iterable[FloatArray]) -> Iterator[npt.NDArray[np.complex128]]:
        """Spectrum of each frame's correlation with h at the pixels of its class."""
        weight = self._spectrum.conj()
        (row, column), (rows, columns) = self.camera.origin, self.camera.shape
        for (a, b), frame in zip(
            product(range(self.k), repeat=2), self.camera.check_frames(frames, self.k**2), strict=True
        ):
            placed = np.zeros(self._spectrum.shape)
            # Moved so that the class's first pixel is the first number.
            placed[:rows, :columns] = frame
            placed = np.roll(placed, (row - a, column - b), axis=(0, 1))
            yield self._fold(fft.fft2(placed) * weight)

    def _interleave(self, spectra: Iterable[npt.NDArray[np.complex128]]) -> FloatArray:
        """Image (n, n) of the spectra of its classes."""
        classes = np.empty((self.k**2, self._side, self._side))
        for place, spectrum in zip(classes, spectra, strict=True):
            place[:] = fft.ifft2(spectrum).real[: self._side, : self._side]
        return self._join(classes.reshape(self.k, self.k, self._side, self._side))

    def _split_classes(self, image: FloatArray) -> FloatArray:
        """(k, k, side, side) classes of an image, zero beyond its edge."""
        room = self._side * self.k - self.camera.n
        padded = np.pad(image, ((0, room), (0, room)))
        return padded.reshape(self._side, self.k, self._side, self.k).transpose(1, 3, 0, 2)

    def _join(self, classes: FloatArray) -> FloatArray:
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
            shared = self._split_classes(self._shared_light(below * k, right * k))
            grams[:, :, i, j, i - below, j - right] = shared[:, :, i, j]

        steps = product(range(side), range(1 - side, side))
        in_threads(fill, [(below, right) for below, right in steps if below or right >= 0])
        return grams

    def _shared_light(self, below: int, right: int) -> FloatArray:
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
            (n, n) :meth:`Classes.project` of them.
        tolerance
            relative residual of the normal equations at which conjugate gradients end.
        """
        classes = self.classes
        if self.factors is None:
            # On a section's small grids the division would take longer than the steps that it saves.
            inverse = classes.inverse(self.lam) if classes.camera.cropped else None
            return conjugate_gradients(classes.normal, projected, self.lam, inverse, tolerance)
        targets = classes._split_classes(projected)
        image = np.empty_like(targets)
        for index, factor in enumerate(self.factors):
            place = divmod(index, classes.k)
            image[place] = linalg.cho_solve((factor, True), targets[place].ravel(), check_finite=False).reshape(
                image[place].shape
            )
        status = Status(Verdict.SOLVED, "Solved", "", f"{classes.k**2} classes of {factor.shape[0]} pixels factorised.")
        return Solution(classes._join(image), self.lam, 0.0, status)
