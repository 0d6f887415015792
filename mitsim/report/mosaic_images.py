"""Three ways from frames behind colour filters to an image of each spectral line.

*Demosaiced*: every frame becomes three whole frames (colour-demosaicing), each channel is solved, and the channels'
images are separated into lines. *Half resolution*: each plane of filters is solved with its own rows of the factors,
so that no pixel is interpolated. *Joint*: all planes are solved for all lines (:mod:`mitsim.reconstruct.colour`). A
channel or plane that sees several lines has the one separable camera that is nearest to them; only the joint solve
knows that each line has its own.

Lambda is chosen without a truth: each plane, or channel, chooses its own (:mod:`mitsim.reconstruct.regularisation`).
The joint solve takes the geometric mean of the planes' lambdas, because the planes have the same scene and nearly the
same noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.spectral_manifests import DEMOSAIC, JOINT, check_way
from mitsim.optics.terms import best_term
from mitsim.reconstruct.colour import PLANES, JointMosaic
from mitsim.reconstruct.regularisation import automatic_lambda
from mitsim.reconstruct.solution import Solution
from mitsim.reconstruct.solver import prepare

Patterns = tuple[FloatArray, FloatArray]
Lambda = float | Literal["auto"]


@dataclass(frozen=True, eq=False)
class MosaicCamera:
    """A camera under a mosaic of colour filters.

    Attributes
    ----------
    lefts, rights : (lines, m, n) and (lines, m', n') arrays
        Factors of each line, of pixels without filters.
    weights : (4, lines) array
        Response of the pixels of each plane of 2 x 2 to each line.
    mosaic
        Colours of these four, such as ``RGGB``.
    """

    lefts: FloatArray
    rights: FloatArray
    weights: FloatArray
    mosaic: str

    @classmethod
    def of(cls, factors: Sequence[tuple[FloatArray, FloatArray]], weights: FloatArray, mosaic: str) -> MosaicCamera:
        """Stack the (left, right) ``factors`` of all lines."""
        lefts, rights = (np.stack(side) for side in zip(*factors, strict=True))
        return cls(lefts, rights, weights, mosaic)


@dataclass(frozen=True, eq=False)
class LineImages:
    """Images of all lines by one way.

    Attributes
    ----------
    images : (lines, n, n') array
        Reflectances.
    lam
        Lambda of the joint solve, or the geometric mean of those of the planes or channels.
    residual
        ||Y - model|| / ||Y|| over all frames, of planes or channels as they were solved.
    joint
        The joint solution; None for the other ways.
    """

    images: FloatArray
    lam: float
    residual: float
    joint: Solution | None = None


class Solver:
    """Images of all lines from frames behind a camera's filters.

    Each plane, or channel of demosaiced frames, is solved by itself. The joint way adds one model of all lines, and
    needs the planes for lambda alone.

    Parameters
    ----------
    way
        One of :data:`mitsim.core.spectral_manifests.WAYS`.
    camera, patterns
        The camera, and the pattern columns P_L (n, K) and P_R (n', K').
    """

    def __init__(self, way: str, camera: MosaicCamera, patterns: Patterns) -> None:
        self._mosaic = camera.mosaic if check_way(way) == DEMOSAIC else None
        self._joint = JointMosaic(camera.lefts, camera.rights, camera.weights, *patterns) if way == JOINT else None
        self._gathered = np.zeros(self._joint.shape if self._joint else ())
        channels = [camera.mosaic.index(name) for name in "RGB"] if self._mosaic else list(range(len(PLANES)))
        lines = [*zip(camera.lefts, camera.rights, strict=True)]
        weights = camera.weights[channels]
        terms = [
            best_term([(weight * left, right) for weight, (left, right) in zip(row, lines, strict=True)])
            for row in weights
        ]
        # (channels, lines): the part of each line's image in the image that the one separable camera gives.
        mixing = np.array(
            [
                [
                    weight * np.vdot(left, term.left) * np.vdot(right, term.right)
                    for weight, (left, right) in zip(row, lines, strict=True)
                ]
                / (np.square(np.linalg.norm(term.left)) * np.square(np.linalg.norm(term.right)))
                for row, term in zip(weights, terms, strict=True)
            ]
        )
        self._undo = np.linalg.pinv(mixing)
        sides = [(term.left, term.right) for term in terms]
        if not self._mosaic:
            sides = [(left[a::2], right[b::2]) for (left, right), (a, b) in zip(sides, PLANES, strict=True)]
        self._models = [prepare(left, right, *patterns) for left, right in sides]
        self._sums = [model.accumulator() for model in self._models]

    def add(self, frame: FloatArray, row: int, column: int) -> None:
        """Add the (m, m') ``frame`` [electrons/s] that was measured under pattern (``row``, ``column``)."""
        if self._joint:
            self._gathered += self._joint.gather(frame, row, column)
        if self._mosaic:
            parts = [*np.moveaxis(demosaic(frame, self._mosaic), -1, 0)]
        else:
            parts = [frame[a::2, b::2] for a, b in PLANES]
        for total, part in zip(self._sums, parts, strict=True):
            total.add(part, row, column)

    def images(self, lam: Lambda, relative: bool = False) -> LineImages:
        """Solve for the images of all lines.

        Parameters
        ----------
        lam, relative
            Lambda: a number, ``relative`` to the largest sigma^2 where asked for, or ``auto``.
        """
        pairs = [*zip(self._models, self._sums, strict=True)]
        energy = sum(total.energy for total in self._sums)
        if isinstance(lam, str):
            lambdas = [automatic_lambda(model.problem(total)) for model, total in pairs]
        elif self._joint:
            lambdas = [lam * (self._joint.scale if relative else 1)]
        else:
            lambdas = [lam * (model.problem(total).scale if relative else 1) for model, total in pairs]
        shared = lambdas[0] if len(lambdas) == 1 else _geometric(lambdas)
        if self._joint is None:
            found = [model.solve(total, float(own)) for (model, total), own in zip(pairs, lambdas, strict=True)]
            left = sum(each.residual**2 * total.energy for each, total in zip(found, self._sums, strict=True))
            images = np.tensordot(self._undo, np.stack([each.image for each in found]), axes=1)
            return LineImages(images, shared, float(np.sqrt(left / energy)))
        joint = self._joint.solve(self._gathered, shared)
        left = energy + float(np.vdot(joint.image, self._joint.normal(joint.image) - 2 * self._gathered))
        return LineImages(joint.image, shared, float(np.sqrt(max(left, 0.0) / energy)), joint)


def demosaic(frame: FloatArray, mosaic: str) -> FloatArray:
    """Return the (m, m', 3) red, green and blue of a ``frame`` (m, m') behind a ``mosaic`` (Menon and others 2007).

    MitsimError without colour-demosaicing.
    """
    check_way(DEMOSAIC)
    from colour_demosaicing import demosaicing_CFA_Bayer_Menon2007

    return np.asarray(demosaicing_CFA_Bayer_Menon2007(frame, mosaic), dtype=np.float64)


def _geometric(values: Sequence[float]) -> float:
    """Return the geometric mean; 0 where one value is 0."""
    logs = np.log(values) if all(value > 0 for value in values) else -np.inf
    return float(np.exp(np.mean(logs)))
