"""A linear solver and noise in; how far the squared error of one image scatters about what is expected of it, out.

With b the part of an image's error that is no noise, and C the covariance of the noise in its numbers, the squared
error |b + e|^2 of normal e has the variance 2 tr(C^2) + 4 b^T C b. In the coefficients of
:mod:`mitsim.studies.drift.perturbation`, e = F o dW,

* noise of data and of the scene's light is independent from one number of W to the next, of variance v_kl, so that
  tr(C^2) = sum F_kl^4 v_kl^2; so are different kinds of noise, whose variances add up;
* noise of variance nu_kx^2 of the left factor's G has row k of W see scene pixel x through a_x = (X V_R S_R)(x): C_k =
  F_k o (sum_x nu_kx^2 a_x a_x^T) o F_k, hence tr(C_k^2) = nu_k^2^T (K_k o K_k) nu_k^2 with K_k(x, y) = sum_l F_kl^2
  a_xl a_yl; rows are taken for independent, as they are where patterns share no pixels;
* columns of the left factor off by eta_x each add one number times s_k V_L(x, k) a_x, so that tr(C^2) = eta^4 sum_xy
  (sum_k s_k^2 V_L(x, k) V_L(y, k) K_k(x, y))^2;
* and the same of the right factor. In b^T C b stands the square of sum_l F_kl b_kl a_xl, weighed likewise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.studies.drift.perturbation import Axis, LinearImage, Noise

_KINDS = tuple(each.name for each in fields(Noise))
"""In the order of all arrays by kind."""


@dataclass(frozen=True, eq=False)
class Scatter:
    """Of the squared error, sum over the image, of a ``scene`` (n, n') as a ``solver`` makes it.

    Errors that are no noise are (n, n') each.
    """

    solver: LinearImage
    scene: FloatArray

    def deviation(self, noise: Noise, error: FloatArray) -> float:
        """Standard deviation with so much ``noise`` beside an ``error`` that is none."""
        return math.sqrt(self._variance(noise, error))

    def share(self, noise: Noise, among: Noise, error: FloatArray) -> float:
        """Standard deviation of what a source adds.

        Parameters
        ----------
        noise, among
            of the source, and of all, the source with them.
        error
            that is no noise.
        """
        return math.sqrt(max(self._variance(among, error) - self._variance(among - noise, error), 0.0))

    def common(self, noise: Noise, error: FloatArray) -> float:
        """Standard deviation of what ``noise`` has in common with an ``error`` that is none, 2 b . e."""
        return math.sqrt(float(self._beside(error) @ _amounts(noise)))

    def _variance(self, noise: Noise, error: FloatArray) -> float:
        amounts = _amounts(noise)
        return float(amounts @ self._own @ amounts + self._beside(error) @ amounts)

    def _beside(self, error: FloatArray) -> FloatArray:
        """(kinds,) variance of 2 b . e by a variance."""
        (left, right), gain = self.solver.axes, self.solver.filter
        off = left.basis.T @ error @ right.basis
        found = 4 * self._energies @ np.square(off).ravel()
        for (side, axis, seen), weights in zip(self._sides, (gain * off, (gain * off).T), strict=True):
            beside = weights @ seen.T  # (r, n)
            found[_KINDS.index(side)] = 4 * float((axis.noise * np.square(beside)).sum())
            light = ((axis.basis * axis.singular).T * beside).sum(axis=0)
            found[_KINDS.index(f"{side}_light")] = 4 * float(np.square(light).sum())
        return np.asarray(found)

    @cached_property
    def _own(self) -> FloatArray:
        """(kinds, kinds) variance of |e|^2 by the product of two variances."""
        found, gain = 2 * self._energies @ self._energies.T, self.solver.filter
        for (side, axis, seen), weights in zip(self._sides, (gain, gain.T), strict=True):
            for name, square in zip((side, f"{side}_light"), _squares(axis, seen, weights), strict=True):
                found[_KINDS.index(name), _KINDS.index(name)] = 2 * square
        return np.asarray(found)

    @cached_property
    def _energies(self) -> FloatArray:
        """(kinds, r r') variance of the image's coefficients by a variance."""
        units = self.solver.units(self.scene)
        return np.stack([(np.square(self.solver.filter) * units[name]).ravel() for name in _KINDS])

    @property
    def _sides(self) -> tuple[tuple[str, Axis, FloatArray], tuple[str, Axis, FloatArray]]:
        """Each factor, and (n, r') a_x through the other one."""
        left, right = self.solver.axes
        through_right = self.scene @ (right.basis * right.singular)
        return ("left", left, through_right), ("right", right, self.scene.T @ (left.basis * left.singular))


def _amounts(noise: Noise) -> FloatArray:
    return np.array([getattr(noise, name) for name in _KINDS])


def _squares(axis: Axis, seen: FloatArray, gain: FloatArray) -> tuple[float, float]:
    """tr(C^2) of noise of variance 1 in the numbers of a factor, and in what its columns are multiplied by.

    Parameters
    ----------
    axis, seen
        of the factor; and (n, r') a_x through the other one.
    gain
        (r, r') F.
    """
    square, light = 0.0, axis.basis * axis.singular
    together = np.zeros((len(seen), len(seen)))
    for row, weights in enumerate(gain):
        passed, variance = seen * weights, axis.noise[row]
        kernel = passed @ passed.T
        square += float(variance @ np.square(kernel) @ variance)
        together += np.outer(light[:, row], light[:, row]) * kernel
    return square, float(np.square(together).sum())
