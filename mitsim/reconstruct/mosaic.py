"""Frames of a sensor under a mosaic of colour filters, and each line's factors, in; an image of every line out.

Every shot shows all lines at once, and each pixel of a 2 x 2 cell sees them through its own filter: with plane p the
pixels (a::2, b::2) and w_pl how much of line l they see,

    Y_ij[a::2, b::2] = sum_l w_pl  Phi_Ll[a::2] (P_ij o X_l) Phi_Rl[b::2]^T,

exactly, with factors sub-sampled and nothing interpolated. :class:`JointMosaic` takes all planes for all lines
together,

    min_X  sum_ij,p ||Y_ij,p - model||^2 + lambda sum_l ||X_l||^2,

by conjugate gradients on the normal equations, which for products of patterns are sums of separable terms:

    (N X)_l = sum_p,l' w_pl w_pl' [(P_L P_L^T) o (Phi_Ll[a::2]^T Phi_Ll'[a::2])] X_l' [the same of columns]^T.

Preconditioner: the same with one pair of factors for all lines, which its eigenvectors make diagonal. Where the lines'
factors are equal and rows of either parity alike, it is exact, and the first step is the solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import single_threaded_blas

if TYPE_CHECKING:
    from scipy.sparse.linalg import LinearOperator

PLANES = ((0, 0), (0, 1), (1, 0), (1, 1))
"""First row and column of each plane of 2 x 2 filters, row by row."""
_TOLERANCE = 1e-7
"""Residual of the normal equations, relative to their right side, at which an image's last visible digit is still."""
_MOST_STEPS = 1000
"""Of conjugate gradients; some hundred are taken at the best lambda."""


@dataclass(frozen=True, eq=False)
class JointSolution:
    """Images of all lines.

    Attributes
    ----------
    images
        (lines, n, n') reflectances.
    lam
        lambda that was used.
    steps
        of conjugate gradients.
    residual
        of the normal equations, relative to their right side.
    """

    images: FloatArray
    lam: float
    steps: int
    residual: float

    @property
    def converged(self) -> bool:
        """Whether the steps led to the solution."""
        return self.residual <= _TOLERANCE


@dataclass(frozen=True, eq=False)
class JointMosaic:
    """The model of a camera with a mosaic, for one family of patterns.

    Attributes
    ----------
    lefts, rights
        (lines, m, n) and (lines, m', n') factors of each line; m and m' even.
    weights
        (4, lines) of each plane of :data:`PLANES` for each line: what its pixels see of the light that the factors are
        of.
    P_L, P_R
        (n, K) and (n', K') pattern columns.
    """

    lefts: FloatArray
    rights: FloatArray
    weights: FloatArray
    P_L: FloatArray
    P_R: FloatArray

    def __post_init__(self) -> None:
        lines = len(self.lefts)
        for name, sides, patterns in (("left", self.lefts, self.P_L), ("right", self.rights, self.P_R)):
            if sides.ndim != 3 or len(sides) != lines or sides.shape[1] % 2 or sides.shape[2] != len(patterns):
                raise MitsimError(
                    f"mosaic: {name} factors are {sides.shape} for patterns of {len(patterns)} scene pixels; give "
                    f"{lines} factors of an even number of sensor pixels, a column for each scene pixel"
                )
        if self.weights.shape != (len(PLANES), lines):
            raise MitsimError(
                f"mosaic: weights are {self.weights.shape}; give one for each of 4 planes and {lines} lines"
            )

    @property
    def shape(self) -> tuple[int, int, int]:
        """(lines, n, n') of the images."""
        return len(self.lefts), self.lefts.shape[2], self.rights.shape[2]

    def operator(self) -> LinearOperator:
        """The model with its adjoint: images (lines, n, n') to frames (K, K', m, m'), both in one column."""
        from scipy.sparse.linalg import LinearOperator

        size = self.P_L.shape[1], self.P_R.shape[1], self.lefts.shape[1], self.rights.shape[1]

        def forward(images: FloatArray) -> FloatArray:
            frames = np.zeros(size)
            for i, j in np.ndindex(size[:2]):
                frames[i, j] = self.frame(images.reshape(self.shape), i, j)
            return frames.ravel()

        def adjoint(frames: FloatArray) -> FloatArray:
            each = frames.reshape(size)
            return sum(
                (self.gathered(each[index], *index) for index in np.ndindex(size[:2])), np.zeros(self.shape)
            ).ravel()

        count = int(np.prod(size)), int(np.prod(self.shape))
        return LinearOperator(count, matvec=forward, rmatvec=adjoint, dtype=np.dtype(np.float64))

    def frame(self, images: FloatArray, row: int, column: int) -> FloatArray:
        """The frame (m, m') of one pattern.

        Parameters
        ----------
        images
            (lines, n, n').
        row, column
            of the pattern.
        """
        rows, columns = np.flatnonzero(self.P_L[:, row]), np.flatnonzero(self.P_R[:, column])
        lit = images[:, rows[:, None], columns] * self.P_L[rows, row][:, None] * self.P_R[columns, column]
        seen = self.lefts[:, :, rows] @ lit @ self.rights[:, :, columns].transpose(0, 2, 1)
        return np.asarray((self._filters(seen.shape[1:]) * seen).sum(axis=0))

    def gathered(self, frame: FloatArray, row: int, column: int) -> FloatArray:
        """Adjoint of :meth:`frame`: (lines, n, n') of a ``frame`` (m, m').

        Parameters
        ----------
        frame
            measured under one pattern.
        row, column
            of the pattern.
        """
        rows, columns = np.flatnonzero(self.P_L[:, row]), np.flatnonzero(self.P_R[:, column])
        seen = self._filters(frame.shape) * frame
        lit = self.lefts[:, :, rows].transpose(0, 2, 1) @ seen @ self.rights[:, :, columns]
        images = np.zeros(self.shape)
        images[:, rows[:, None], columns] = lit * self.P_L[rows, row][:, None] * self.P_R[columns, column]
        return images

    def normal(self, images: FloatArray) -> FloatArray:
        """(lines, n, n') of A^T A ``images``, for all patterns together."""
        left, right = self._grams
        found = np.zeros(self.shape)
        for other in range(self.shape[0]):
            seen = left[:, :, other] @ images[other]  # (parity, line, n, n')
            for plane, (a, b) in enumerate(PLANES):
                both = self.weights[plane] * self.weights[plane, other]
                found += both[:, None, None] * (seen[a] @ right[b, :, other].transpose(0, 2, 1))
        return found

    @property
    def scale(self) -> float:
        """Largest eigenvalue of the preconditioner, what lambda is relative to."""
        (rows, _), (columns, _), (lines, _) = self._spectra
        return float(rows.max() * columns.max() * lines.max())

    @single_threaded_blas()
    def solve(self, gathered: FloatArray, lam: float, start: FloatArray | None = None) -> JointSolution:
        """Images of least squares.

        Parameters
        ----------
        gathered
            (lines, n, n') sum of :meth:`gathered` over all frames.
        lam
            lambda above 0, in the unit of (Phi_L Phi_R)^2.
        start
            (lines, n, n') images to begin with; None: black.

        Raises
        ------
        MitsimError
            for lambda that is not above 0.
        """
        if not 0 < lam < np.inf:
            raise MitsimError(f"lambda is {lam}; give a finite number above 0")
        # With SciPy's linear algebra, which a capture behind filters does without: 14 MB of addresses.
        from mitsim.reconstruct.convolution import Ending, conjugate_gradients

        found = conjugate_gradients(
            self.normal,
            gathered,
            lam,
            lambda images: self._precondition(images, lam),
            Ending(_TOLERANCE, _MOST_STEPS),
            start,
        )
        return JointSolution(found.image, lam, found.iterations, found.residual)

    def _precondition(self, images: FloatArray, lam: float) -> FloatArray:
        (rows, left), (columns, right), (lines, mixed) = self._spectra
        turned = np.tensordot(mixed.T, left.T @ images @ right, axes=1)
        turned /= lines[:, None, None] * np.outer(rows, columns) + lam
        return np.asarray(np.tensordot(mixed, left @ turned @ right.T, axes=1))

    @cached_property
    def _grams(self) -> tuple[FloatArray, FloatArray]:
        """(2, lines, lines, n, n) for rows and for columns: by parity, what pairs of lines share under all patterns."""
        return _grams(self.lefts, self.P_L), _grams(self.rights, self.P_R)

    @cached_property
    def _spectra(self) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """Eigenvalues and vectors of the preconditioner's three parts: rows, columns and lines."""
        rows, columns = (np.einsum("plljk->jk", grams) / (2 * self.shape[0]) for grams in self._grams)
        spectra = [np.linalg.eigh(part) for part in (rows, columns, self.weights.T @ self.weights)]
        return tuple((np.maximum(values, 0), vectors) for values, vectors in spectra)

    def _filters(self, shape: Sequence[int]) -> FloatArray:
        """(lines, m, m') what each pixel sees of each line."""
        return behind(self.weights, shape)


def behind(weights: FloatArray, shape: Sequence[int]) -> FloatArray:
    """(lines, m, m') what each pixel of a sensor counts of each line.

    Parameters
    ----------
    weights
        (4, lines) of each plane of :data:`PLANES`.
    shape
        (m, m'), both even.
    """
    return np.tile(weights.T.reshape(-1, 2, 2), (1, shape[0] // 2, shape[1] // 2))


def _grams(sides: FloatArray, patterns: npt.NDArray[np.floating]) -> FloatArray:
    shared = patterns @ patterns.T
    halves = (sides[:, parity::2] for parity in (0, 1))
    return np.stack([shared * (half.transpose(0, 2, 1)[:, None] @ half[None]) for half in halves])
