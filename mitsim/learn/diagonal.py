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
import torch
from torch import Tensor

from mitsim.core.arrays import FloatArray
from mitsim.reconstruct.factorisation import Side
from mitsim.reconstruct.solver import Prepared


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
        (K, m, r) and (K', m', r') U_L and U_R of every pattern, 0 where a pattern lights no pixel of a direction.
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
        """(B, r, r') W = sum_ij U_Li^T Y_ij U_Rj of ``frames`` (B, K, K', m, m')."""
        left, right = self.slabs
        return (left.transpose(1, 2) @ (frames @ right).sum(2)).sum(1)

    def frames(self, weights: Tensor) -> Tensor:
        """(B, K, K', m, m') frames of ``weights`` (B, r, r'); the adjoint of :meth:`project`."""
        left, right = self.slabs
        return (left @ weights[:, None])[:, :, None] @ right.transpose(1, 2)

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
        (B, K, K', m, m') the frames [electrons / s]; None: for methods that read none.
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


def _slabs(side: Side) -> FloatArray:
    """(K, m, r) U of every pattern of a ``side``."""
    stack = np.zeros((side.pattern_count, side.sensor_size, side.accumulated_size))
    for whole, slab in zip(stack, side.slabs, strict=True):
        whole[:, slab.columns] = slab.matrix
    return stack
