"""A point spread function, patterns and frames in; the image that fits them out, by conjugate gradients.

A camera whose scene points all cast one pattern of light, each shifted by its place, as a diffuser before a bare sensor
does (Antipa et al., Optica 5, 1, 2018), sees under the pattern P_i (arXiv 2111.12862, section "Coded Illumination with
Nonseparable Systems")

    Y_i = crop( h * (P_i o X) )

h sums to 1, one scene pixel shifts it by one sensor pixel, and the crop is the sensor, centred in all that the light
reaches.
The image minimises sum_i ||Y_i - crop(h * (P_i o X))||^2 + lambda ||X||^2. :func:`solve_iteratively` does what is left
where no closed form is known: conjugate gradients on the normal equations, each step a convolution and a correlation of
every frame. :mod:`mitsim.reconstruct.dots` solves the same equations directly where patterns are dots.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import fft

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import PatternFamily
from mitsim.reconstruct.status import Solution, Status, Verdict

Operator = Callable[[FloatArray], FloatArray]
"""From an image (n, n) to another."""
Watch = Callable[[FloatArray], bool]
"""Looks at an image (n, n) under way, and says whether it is good enough."""


def _unwatched(image: FloatArray) -> bool:
    return False


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

    def correlated(self, frame: npt.ArrayLike) -> FloatArray:
        """Adjoint of :meth:`image_of`: (n, n) sum of a ``frame`` weighted by the light of each scene pixel."""
        (row, column), (rows, columns) = self.origin, self.shape
        placed = np.zeros(self._grid)
        placed[row : row + rows, column : column + columns] = frame
        return np.asarray(fft.irfft2(fft.rfft2(placed) * self._spectrum.conj(), self._grid)[: self.n, : self.n])

    def frames(self, family: PatternFamily, scene: npt.ArrayLike) -> Iterator[FloatArray]:
        """The noise-free frame of each pattern of a ``family`` on a ``scene`` (n, n), row-major over (i, j)."""
        for light in self._lights(family):
            yield self.image_of(light * np.asarray(scene))

    def projected(self, family: PatternFamily, frames: Iterable[FloatArray]) -> FloatArray:
        """Adjoint of :meth:`frames`: (n, n) sum over the patterns of a ``family`` and their ``frames``."""
        total = np.zeros((self.n, self.n))
        count = family.left.shape[1] * family.right.shape[1]
        for light, frame in zip(self._lights(family), self.checked(frames, count), strict=True):
            total += light * self.correlated(frame)
        return total

    def checked(self, frames: Iterable[FloatArray], count: int) -> Iterator[FloatArray]:
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
    lam: float,
    tolerance: float = 1e-6,
    iterations: int = 500,
    watch: Watch = _unwatched,
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
        return camera.projected(family, camera.frames(family, image))

    return conjugate_gradients(normal, camera.projected(family, frames), lam, None, tolerance, iterations, watch)


def conjugate_gradients(
    normal: Operator,
    target: FloatArray,
    lam: float,
    inverse: Operator | None = None,
    tolerance: float = 1e-6,
    most: int = 500,
    watch: Watch = _unwatched,
) -> Solution:
    """Solve (``normal`` + lambda) X = ``target``, from X = 0 (Hestenes and Stiefel 1952).

    Parameters
    ----------
    normal
        a symmetric operator without negative eigenvalues.
    target
        (n, n) right-hand side.
    lam
        lambda >= 0.
    inverse
        something near the inverse of normal + lambda, symmetric and positive, which saves steps.
    tolerance, most
        relative residual at which it ends, and the most steps.
    watch
        called with the image after each step; where it says True, that was the last.
    """
    lam = check_lambda(lam)
    image, left = np.zeros_like(target), target.copy()
    size = float(np.linalg.norm(target))
    turned = inverse(left) if inverse else left
    direction, power, spent = turned, float(np.vdot(left, turned)), 0
    residual = 1.0 if size > 0 else 0.0
    while residual > tolerance and spent < most:
        spent += 1
        moved = normal(direction) + lam * direction
        step = power / float(np.vdot(direction, moved))
        image, left = image + step * direction, left - step * moved
        residual = float(np.linalg.norm(left)) / size
        if watch(image):
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


def check_lambda(lam: float) -> float:
    """``lam``; MitsimError where it is no finite number of at least 0."""
    if not (np.isfinite(lam) and lam >= 0):
        raise MitsimError(f"lambda is {lam}; give a finite number of at least 0")
    return float(lam)
