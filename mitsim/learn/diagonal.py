"""A factorised camera in, its model as tensors out: least squares nearest to any image, for many scenes at once.

In the basis where the model is diagonal (:mod:`mitsim.reconstruct.solver`) W = sigma o C + noise, with C = V_L^T X V_R
the coefficients of the image X. Divided by the noise's standard deviation, w = s o C + noise of variance 1, whatever
the exposure. The image that is nearest to both the data and an image Z, argmin ||w - s o C||^2 + rho ||X - Z||^2, is ::

    X = Z + V_L [s (w - s o V_L^T Z V_R) / (s^2 + rho)] V_R^T

Directions that are not measured stay those of Z. Everything is written with V and s together, so that the signs that an
SVD is free to choose do not matter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from mitsim.core.arrays import FloatArray
from mitsim.reconstruct.factorisation import Side
from mitsim.reconstruct.solver import Accumulator, Prepared

BIN = 4
"""Sensor pixels a side that a network which reads frames sees as one, 47 um of the shipped camera: features of the mask
are 60 um. Frames of a pair under 49 patterns are then 3 MB, which memory holds for a thousand pairs."""


@dataclass(frozen=True, eq=False)
class Diagonal:
    """A camera under its patterns.

    Attributes
    ----------
    left, right
        V_L (n, r) and V_R (n', r').
    sigma
        (r, r') singular values of the whole model [electrons / s].
    slabs
        (K, b, r) and (K', b', r') sums of U_L and U_R over the sensor pixels of a bin, for every pattern; 0 where a
        pattern lights no pixel of a direction.
    """

    left: Tensor
    right: Tensor
    sigma: Tensor
    slabs: tuple[Tensor, Tensor]

    @classmethod
    def of(cls, prepared: Prepared, like: Tensor) -> Diagonal:
        """The model of a camera.

        Parameters
        ----------
        prepared
            factorised.
        like
            a tensor of whose device and precision it is to be.
        """

        def tensor(values: FloatArray) -> Tensor:
            return torch.as_tensor(values.copy()).to(like)

        left, right = prepared.left, prepared.right
        slabs = tensor(_slabs(left)), tensor(_slabs(right))
        return cls(tensor(left.basis), tensor(right.basis), tensor(prepared.sigma), slabs)

    def coefficients(self, images: Tensor) -> Tensor:
        """(B, 1, r, r') C of ``images`` (B, 1, n, n')."""
        return self.left.T @ images @ self.right

    def images(self, coefficients: Tensor) -> Tensor:
        """(B, 1, n, n') of ``coefficients`` (B, 1, r, r'); the adjoint of :meth:`coefficients`."""
        return self.left @ coefficients @ self.right.T

    def project(self, frames: Tensor) -> Tensor:
        """(B, r, r') W = sum_ij U_Li^T Y_ij U_Rj of ``frames`` Y (B, K, K', b, b') that are even over each bin."""
        left, right = self.slabs
        return (left.transpose(1, 2) @ (frames @ right).sum(2)).sum(1)

    def nearest(self, data: Data, images: Tensor, rho: Tensor) -> Tensor:
        """The images nearest to both the data and ``images``.

        Parameters
        ----------
        data
            of the scenes' frames.
        images
            (B, 1, n, n') Z.
        rho
            their weight, 1 over the variance of what they are off by; broadcast to (B, 1, r, r').
        """
        s = self.sigma / data.deviation
        return images + self.images(s * (data.weights - s * self.coefficients(images)) / (s * s + rho))


@dataclass(frozen=True, eq=False)
class Data:
    """What the frames of B scenes say.

    Attributes
    ----------
    weights
        (B, 1, r, r') W over the noise of a datum.
    deviation
        (B, 1, 1, 1) standard deviation of that noise [electrons / s].
    frames
        (B, K, K', b, b') the frames, binned [electrons / s]; None: for methods that read none.
    """

    weights: Tensor
    deviation: Tensor
    frames: Tensor | None = None

    @classmethod
    def of(cls, weights: FloatArray, variance: FloatArray | float, like: Tensor) -> Data:
        """Data of scenes.

        Parameters
        ----------
        weights
            (B, r, r') W.
        variance
            of the noise of a datum of each [(electrons / s)^2].
        like
            a tensor of whose device and precision they are to be.
        """
        deviation = np.sqrt(np.broadcast_to(variance, len(weights)))[:, None, None]
        scaled = torch.as_tensor(weights / deviation)
        return cls(scaled[:, None].to(like), torch.as_tensor(deviation)[:, None].to(like))


class Binning(Accumulator):
    """A sum of frames that keeps them, binned: ``frames`` (K, K', b, b') of single precision.

    Parameters
    ----------
    prepared
        the model that they are of.
    """

    def __init__(self, prepared: Prepared) -> None:
        super().__init__(prepared)
        sides = prepared.left, prepared.right
        bins = (-(-side.sensor_size // BIN) for side in sides)
        self.frames = np.zeros((*(side.pattern_count for side in sides), *bins), np.float32)

    def add(self, frame: npt.ArrayLike, row: int, column: int) -> FloatArray:
        """Add one frame, and return what it adds to W at its places (c, c').

        Parameters
        ----------
        frame, row, column
            as :class:`mitsim.reconstruct.solver.Accumulator` takes them.
        """
        own = super().add(frame, row, column)
        values = np.asarray(frame)
        pixels = np.outer(*(_bin(np.ones(size)) for size in values.shape))
        self.frames[row, column] = _bin(_bin(values).T).T / pixels
        return own


def _bin(values: FloatArray) -> FloatArray:
    """(b, ...) sums of ``values`` (m, ...) over bins; the last may have fewer."""
    return np.asarray(np.add.reduceat(values, np.arange(0, len(values), BIN)))


def _slabs(side: Side) -> FloatArray:
    """(K, b, r) sums over bins of U of every pattern of a ``side``."""
    stack = np.zeros((side.pattern_count, -(-side.sensor_size // BIN), len(side.singular)))
    for whole, slab in zip(stack, side.slabs, strict=True):
        whole[:, slab.columns] = _bin(slab.matrix)
    return stack
