"""A linear solver and noise in; how far the squared error of one image scatters about what is expected of it, out.

With b the part of an image's error that is no noise, and C the covariance of the noise in its numbers, the squared
error |b + e|^2 of normal e has the variance 2 tr(C^2) + 4 b^T C b. In the coefficients of
:mod:`mitsim.reconstruct.perturbation`, e = F o dW,

* noise of data and of the scene's light is independent from one number of W to the next, of variance v_kl, so that
  tr(C^2) = sum F_kl^4 v_kl^2, and different kinds of it add their variances;
* noise of the left factor has row k of W see scene pixel x through a_x = (X V_R S_R)(x): C_k = F_k o (sum_x nu_kx^2
  a_x a_x^T) o F_k, hence tr(C_k^2) = nu_k^2^T (K_k o K_k) nu_k^2 with K_k(x, y) = sum_l F_kl^2 a_xl a_yl; rows are taken
  for independent, as they are where patterns share no pixels;
* columns of the left factor off by eta_x each add one number times s_k V_L(x, k) a_x, so that tr(C^2) = eta^4 sum_xy (sum_k
  s_k^2 V_L(x, k) V_L(y, k) K_k(x, y))^2;
* and the same of the right factor. b^T C b is (F_k b_k . a_x)^2, weighed likewise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.reconstruct.perturbation import Axis, LinearImage, Noise

_KINDS = tuple(each.name for each in fields(Noise))
"""In the order of all arrays by kind."""


@dataclass(frozen=True, eq=False)
class Scatter:
    """Of the squared error, sum over the image, by kinds of :class:`mitsim.reconstruct.perturbation.Noise` (K of them).

    Attributes
    ----------
    own
        (K, K) variance by the product of two variances.
    beside
        (K,) variance by a variance, of what the noise has in common with the part of the error that is none.
    """

    own: FloatArray
    beside: FloatArray

    @classmethod
    def of(cls, solver: LinearImage, scene: FloatArray, error: FloatArray) -> Scatter:
        """That of an image.

        Parameters
        ----------
        solver, scene
            what makes it, and X (n, n').
        error
            (n, n') part of its error that is no noise.
        """
        (left, right), gain = solver.axes, solver.filter
        energies = np.stack([(np.square(gain) * unit).ravel() for unit in solver.units(scene).values()])
        off = left.basis.T @ error @ right.basis
        own, beside = 2 * energies @ energies.T, 4 * energies @ np.square(off).ravel()
        sides = _of_side(left, scene @ (right.basis * right.singular), gain, off), _of_side(
            right, scene.T @ (left.basis * left.singular), gain.T, off.T
        )
        for side, found in zip(("left", "right"), sides, strict=True):
            for name, (square, common) in zip((side, f"{side}_light"), found, strict=True):
                kind = _KINDS.index(name)
                own[kind, kind], beside[kind] = 2 * square, 4 * common
        return cls(own, beside)

    def deviation(self, noise: Noise) -> float:
        """Standard deviation with so much ``noise``."""
        return math.sqrt(self._variance(noise))

    def share(self, noise: Noise, among: Noise) -> float:
        """Standard deviation of what a source adds.

        Parameters
        ----------
        noise, among
            of the source, and of all, the source with them.
        """
        return math.sqrt(max(self._variance(among) - self._variance(among - noise), 0.0))

    def common(self, noise: Noise) -> float:
        """Standard deviation of what ``noise`` has in common with the part of the error that is none, 2 b . e."""
        return math.sqrt(float(self.beside @ _amounts(noise)))

    def _variance(self, noise: Noise) -> float:
        amounts = _amounts(noise)
        return float(amounts @ self.own @ amounts + self.beside @ amounts)


def _amounts(noise: Noise) -> FloatArray:
    return np.array([getattr(noise, name) for name in _KINDS])


def _of_side(
    axis: Axis, seen: FloatArray, gain: FloatArray, off: FloatArray
) -> tuple[tuple[float, float], tuple[float, float]]:
    """tr(C^2) and b^T C b of noise of variance 1 in the numbers of a factor, and in what its columns are multiplied by.

    Parameters
    ----------
    axis, seen
        of the factor; and (n, r') a_x through the other one.
    gain, off
        (r, r') F, and coefficients of b.
    """
    square = common = 0.0
    pixels = len(seen)
    together, along = np.zeros((pixels, pixels)), np.zeros(pixels)
    light = axis.basis * axis.singular
    for row, weights in enumerate(gain):
        passed, variance = seen * weights, axis.noise[row]
        kernel, beside = passed @ passed.T, passed @ off[row]
        square += float(variance @ np.square(kernel) @ variance)
        common += float(variance @ np.square(beside))
        together += np.outer(light[:, row], light[:, row]) * kernel
        along += light[:, row] * beside
    return (square, common), (float(np.square(together).sum()), float(np.square(along).sum()))
