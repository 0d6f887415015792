"""Ways from frames to an image, by name: each prepares a camera and its patterns once, and solves any number of scenes.

A further one is a class with ``init`` and ``compute`` (:class:`mitsim.reconstruct.solution.Solver`); one of separable
cameras that an image may be asked by has a line in :data:`SOLVERS`, and its name in
:data:`mitsim.reconstruct.request.METHODS`, which is read before numpy is imported.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, Protocol

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import PatternFamily
from mitsim.reconstruct.convolution import ConvolutionalCamera, solve_iteratively
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.request import MARKOV, TIKHONOV, TV
from mitsim.reconstruct.solution import Solution, Solver
from mitsim.reconstruct.solver import Accumulator, Prepared, prepare
from mitsim.reconstruct.tv import solve_tv

Patterns = tuple[FloatArray, FloatArray]
"""P_L (n, K) and P_R (n', K')."""


class Tikhonov:
    """Least squares with lambda ||X||^2: pixels are independent, the solution is in closed form.

    Attributes
    ----------
    whole
        whether every pattern's slab has all coefficients, not those of the pixels that it lights alone.
    """

    linear, whole = True, False

    def init(self, camera: Factors, patterns: Patterns) -> Prepared:
        """The ``camera``'s model under ``patterns``, factorised."""
        return prepare(camera.left, camera.right, *patterns, centre=camera.manifest.centre)

    def compute(self, prepared: Prepared, frames: Accumulator, lam: float | Literal["auto"]) -> Solution:
        """The image of ``frames``.

        Parameters
        ----------
        prepared, frames
            what :meth:`init` gives, and all frames, added up.
        lam
            lambda; ``auto``: :func:`mitsim.reconstruct.regularisation.automatic_lambda`.
        """
        return prepared.solve(frames, lam)


class Markov(Tikhonov):
    """The same where neighbouring pixels are alike: lambda times X in the metric of their inverse covariance."""

    whole = True

    def init(self, camera: Factors, patterns: Patterns) -> Prepared:
        """The ``camera``'s model under ``patterns``, factorised in the basis of correlated pixels."""
        return super().init(camera, patterns).correlated()


class TotalVariation(Tikhonov):
    """Least squares with lambda times the total variation of X, by iterations."""

    linear = False

    def compute(self, prepared: Prepared, frames: Accumulator, lam: float | Literal["auto"]) -> Solution:
        """The image of ``frames``.

        Parameters
        ----------
        prepared, frames
            what :meth:`init` gives, and all frames, added up.
        lam
            weight; ``auto``: :func:`mitsim.reconstruct.tv.automatic_weight`.
        """
        return solve_tv(prepared, frames, lam)


@dataclass(frozen=True)
class Convolutional:
    """Tikhonov images of a camera whose scene points all cast one pattern, by conjugate gradients.

    Attributes
    ----------
    tolerance, iterations
        residual of the normal equations, relative, at which it ends, and the most steps.
    """

    tolerance: float = 1e-6
    iterations: int = 500
    linear = False

    def init(self, camera: ConvolutionalCamera, patterns: PatternFamily) -> tuple[ConvolutionalCamera, PatternFamily]:
        """The ``camera`` and its ``patterns``: there is nothing to factorise."""
        return camera, patterns

    def compute(
        self,
        prepared: tuple[ConvolutionalCamera, PatternFamily],
        frames: Iterable[FloatArray],
        lam: float | Literal["auto"],
    ) -> Solution:
        """The image of ``frames``.

        Parameters
        ----------
        prepared, frames
            what :meth:`init` gives, and a frame of each pattern, row-major over (i, j).
        lam
            lambda; MitsimError for ``auto``.
        """
        if isinstance(lam, str):
            raise MitsimError(f"lambda is {lam!r}; give a finite number of at least 0")
        return solve_iteratively(*prepared, frames, lam, self.tolerance, self.iterations)


class SeparableSolver(Solver[Factors, Patterns, Prepared, Accumulator], Protocol):
    """Of a separable camera, whose frames are added up; ``whole`` as of :class:`Tikhonov`."""

    whole: bool


SOLVERS: dict[str, SeparableSolver] = {TIKHONOV: Tikhonov(), MARKOV: Markov(), TV: TotalVariation()}
"""By the method that an image is asked by."""
