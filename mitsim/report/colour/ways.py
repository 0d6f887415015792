"""Measured frames behind colour filters and each line's factors in; an image of every line out, in three ways.

*Demosaiced*: every frame becomes three whole ones (colour-demosaicing), a solve for each channel, and channels are
taken apart into lines. *Half resolution*: a solve for each plane of filters with its own rows of the factors, no pixel
interpolated. *Joint*: all planes for all lines (:mod:`mitsim.reconstruct.mosaic`). A channel or plane that sees several
lines has the one factor that is nearest to them; only the joint solve knows that each line has its own.

Lambda is found without a truth: each plane, or channel, chooses its own as any other frames do
(:mod:`mitsim.reconstruct.regularisation`), and the joint solve takes the geometric mean of the planes'. They have the
same scene, and nearly the same noise, which lambda weighs against each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.spectral_manifests import DEMOSAIC, HALF, JOINT, check_way
from mitsim.optics.separable import BestTerm, best_term
from mitsim.reconstruct.mosaic import PLANES, JointMosaic, JointSolution
from mitsim.reconstruct.regularisation import automatic_lambda
from mitsim.reconstruct.solver import prepare

Patterns = tuple[FloatArray, FloatArray]
Lambda = float | Literal["auto"]


@dataclass(frozen=True, eq=False)
class MosaicCamera:
    """A camera under a mosaic of colour filters.

    Attributes
    ----------
    lefts, rights
        (lines, m, n) and (lines, m', n') factors of each line, of pixels without filters.
    weights
        (4, lines) what pixels of each plane of 2 x 2 see of each line.
    mosaic
        colours of these four, such as ``RGGB``.
    """

    lefts: FloatArray
    rights: FloatArray
    weights: FloatArray
    mosaic: str

    @classmethod
    def of(cls, factors: Sequence[tuple[FloatArray, FloatArray]], weights: FloatArray, mosaic: str) -> MosaicCamera:
        """Of all lines' factors.

        Parameters
        ----------
        factors
            (left, right) of each line.
        weights, mosaic
            as above.
        """
        lefts, rights = (np.stack(side) for side in zip(*factors, strict=True))
        return cls(lefts, rights, weights, mosaic)

    def term(self, weights: FloatArray) -> BestTerm:
        """The one separable camera that is nearest to that of a plane's ``weights`` (lines,) of all lines."""
        pairs = zip(weights, self.lefts, self.rights, strict=True)
        return best_term([(weight * left, right) for weight, left, right in pairs])

    def mixing(self, weights: FloatArray, terms: Sequence[BestTerm]) -> FloatArray:
        """(terms, lines) part of each line's image in those that are solved with single ``terms`` of some ``weights``
        (terms, lines): what the term has of the line's own."""
        return np.array(
            [
                [
                    weight * np.vdot(left, term.left) * np.vdot(right, term.right)
                    for weight, left, right in zip(row, self.lefts, self.rights, strict=True)
                ]
                / (np.square(np.linalg.norm(term.left)) * np.square(np.linalg.norm(term.right)))
                for row, term in zip(weights, terms, strict=True)
            ]
        )


@dataclass(frozen=True, eq=False)
class LineImages:
    """Images of all lines by one way.

    Attributes
    ----------
    images
        (lines, n, n') reflectances.
    lam
        lambda of the joint solve, or the geometric mean of those of the planes or channels.
    residual
        ||Y - model|| / ||Y|| over all frames, of planes or channels as they were solved.
    joint
        the joint solution; None of other ways.
    """

    images: FloatArray
    lam: float
    residual: float
    joint: JointSolution | None = None


class Solver(Protocol):
    """One way from frames to images of the lines."""

    def add(self, frame: FloatArray, row: int, column: int) -> None:
        """Add what was measured under one pattern.

        Parameters
        ----------
        frame
            (m, m') [electrons/s].
        row, column
            of the pattern.
        """

    def images(self, lam: Lambda, relative: bool = False) -> LineImages:
        """Images of all lines from what was added, with a lambda ``lam``: a number, ``relative`` to the largest sigma^2
        where asked for, or ``auto``."""


def solver_of(way: str, camera: MosaicCamera, patterns: Patterns) -> Solver:
    """A solver without frames.

    Parameters
    ----------
    way, camera
        one of :data:`mitsim.core.spectral_manifests.WAYS`, and the camera.
    patterns
        P_L (n, K) and P_R (n', K').

    Raises
    ------
    MitsimError
        as :func:`check_way`, and for factors that do not fit.
    """
    if check_way(way) == JOINT:
        return _Joint(camera, patterns)
    return _Apart(camera, patterns, way == HALF)


class _Apart:
    """A solve for each plane, or for each channel of demosaiced frames, whose images are then taken apart."""

    def __init__(self, camera: MosaicCamera, patterns: Patterns, half: bool) -> None:
        self._half, self._mosaic = half, camera.mosaic
        self.weights = camera.weights if half else camera.weights[[camera.mosaic.index(name) for name in "RGB"]]
        terms = [camera.term(weights) for weights in self.weights]
        places = PLANES if half else [(None, None)] * 3
        self.models = [
            prepare(*(term.left[a::2], term.right[b::2]) if half else (term.left, term.right), *patterns)
            for term, (a, b) in zip(terms, places, strict=True)
        ]
        self._undo = np.linalg.pinv(camera.mixing(self.weights, terms))
        self._sums = [model.accumulator() for model in self.models]

    def add(self, frame: FloatArray, row: int, column: int) -> None:
        parts = planes_of(frame) if self._half else np.moveaxis(demosaiced(frame, self._mosaic), -1, 0)
        for total, part in zip(self._sums, parts, strict=True):
            total.add(part, row, column)

    def lambdas(self) -> FloatArray:
        """(planes or channels,) lambda that each chooses from its own data."""
        pairs = zip(self.models, self._sums, strict=True)
        return np.array([automatic_lambda(model.problem(total)) for model, total in pairs])

    def images(self, lam: Lambda, relative: bool = False) -> LineImages:
        if isinstance(lam, str):
            lambdas = self.lambdas()
        else:
            pairs = zip(self.models, self._sums, strict=True)
            lambdas = np.array([lam * (model.problem(total).scale if relative else 1) for model, total in pairs])
        solved = zip(self.models, self._sums, lambdas, strict=True)
        found = [model.solve(total, float(own)) for model, total, own in solved]
        left = sum(each.residual**2 * total.energy for each, total in zip(found, self._sums, strict=True))
        images = np.tensordot(self._undo, np.stack([each.image for each in found]), axes=1)
        return LineImages(images, _geometric(lambdas), float(np.sqrt(left / self.energy)))

    @property
    def energy(self) -> float:
        """Sum of the squares of all that was added."""
        return sum(total.energy for total in self._sums)


class _Joint:
    """All planes for all lines together."""

    def __init__(self, camera: MosaicCamera, patterns: Patterns) -> None:
        self._planes = _Apart(camera, patterns, half=True)
        self._model = JointMosaic(camera.lefts, camera.rights, camera.weights, *patterns)
        self._gathered = np.zeros(self._model.shape)

    def add(self, frame: FloatArray, row: int, column: int) -> None:
        self._gathered += self._model.gathered(frame, row, column)
        self._planes.add(frame, row, column)

    def images(self, lam: Lambda, relative: bool = False) -> LineImages:
        if isinstance(lam, str):
            lam = _geometric(self._planes.lambdas())
        elif relative:
            lam *= self._model.scale
        found = self._model.solve(self._gathered, lam)
        energy, images = self._planes.energy, found.images
        left = energy + float(np.vdot(images, self._model.normal(images) - 2 * self._gathered))
        return LineImages(images, lam, float(np.sqrt(max(left, 0.0) / energy)), found)


def planes_of(frame: FloatArray) -> list[FloatArray]:
    """(m / 2, m' / 2) pixels of a ``frame`` (m, m') in each plane of 2 x 2."""
    return [frame[a::2, b::2] for a, b in PLANES]


def demosaiced(frame: FloatArray, mosaic: str) -> FloatArray:
    """(m, m', 3) red, green and blue of a ``frame`` (m, m') behind a ``mosaic`` such as RGGB (Menon and others 2007).

    MitsimError without colour-demosaicing.
    """
    check_way(DEMOSAIC)
    from colour_demosaicing import demosaicing_CFA_Bayer_Menon2007

    return np.asarray(demosaicing_CFA_Bayer_Menon2007(frame, mosaic), dtype=np.float64)


def _geometric(values: FloatArray) -> float:
    """Their geometric mean; 0 where one is 0."""
    return float(np.exp(np.mean(np.log(values)))) if (values > 0).all() else 0.0
