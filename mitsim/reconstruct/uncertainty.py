"""The factorised model, lambda and stated noise in; a standard uncertainty for each pixel of the image out, by source.

With G = sigma / (sigma^2 + lambda) the image X = V_L (G o W) V_R^T is linear in the frames, W = sum_ij U_Li^T Y_ij
U_Rj. Independent noise of variance v in all data leaves, V o V being the squares of V's numbers,

    var X = (V_L o V_L) (v G o G) (V_R o V_R)^T

Light differs from frame to frame and over the sensor. A coefficient of the blocks (B, B') takes part w_Bi w'_B'j of its
energy from frame (i, j), w_Bi = ||U_Li,B||^2 / r_B, and from all of the sensor alike, because a mask spreads each pixel
over it: v becomes sum_ij w_Bi w'_B'j v_ij, with v_ij the mean over the frame.

Factors are off by independent numbers of deviation s_L, one and the same in all frames. To first order the frames are
then off by d_L (P_ij o X) Phi_R^T, and, with Q = X V_R S_R, the image by V_L [G o (T Q)] V_R^T, where T = sum_i U_Li^T
d_L diag(p_i) has independent numbers of variance s_L^2 rho[a, p], rho[a, p] = ||sum_i P_L[p, i] U_Li[:, a]||^2. So

    var X[p, q] = s_L^2 sum_a V_L[p, a]^2 sum_p' rho[a, p'] (sum_b G[a, b] Q[p', b] V_R[q, b])^2

and the same with the sides exchanged. G is taken apart into a few products of a row and a column. (For patterns whose
blocks share no row, such as ``random``, rho leaves out what is correlated between coefficients.)

Print that changes within a projector pixel casts another shadow than the board's. A ramp of slope g a pixel has its
light g / 12 pixels off the centre, which moves the frames by Phi_L (P_ij o g / 12) Phi_R'^T, Phi_R' being the slope of
Phi_R along its columns; what that does to the image stands for print that is finer than the image shows.

What lambda takes away, sigma^2 x / (sigma^2 + lambda) instead of x, is no noise: it is estimated from the data and
stated apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.framefile import Channel
from mitsim.core.manifests import FactorNoise
from mitsim.reconstruct.noise import FrameNoise, moved_responses
from mitsim.reconstruct.regularisation import DiagonalProblem
from mitsim.reconstruct.sides import Side
from mitsim.reconstruct.solver import Prepared

_LOST = 1e-5
"""Part of the energy of G that its few products may leave out: 0.3 % of its norm, less than 1 % of a variance."""
_FITTED = 4
"""Octaves of sigma that a power of the scene's energy is fitted to: chosen, of some ten that a camera tells."""
NO_UNCERTAINTY = {"uncertainty": None, "uncertainty_budget": None}
"""Entries of result.json where it is not known."""


RANDOM = ("frame_noise", "ambient_frame", "rendering")
"""Sources that another capture draws anew; the others are the same in all captures with one calibration."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Standard uncertainty of an image, without its ``bias``.

    Attributes
    ----------
    sources
        (n, n') standard uncertainty by source.
    bias
        root mean square over the image of what lambda takes away, as the data tell it.
    """

    sources: dict[str, FloatArray]
    bias: float

    @property
    def random(self) -> FloatArray:
        """(n, n') of what another capture draws anew: noise of the frames, and their rendering where simulated."""
        return _together([values for name, values in self.sources.items() if name in RANDOM])

    @property
    def systematic(self) -> FloatArray:
        """(n, n') of what captures with these factors share: noise of the factors, print within a pixel, exposure."""
        return _together([values for name, values in self.sources.items() if name not in RANDOM])

    @property
    def total(self) -> FloatArray:
        """(n, n') standard uncertainty."""
        return _together(list(self.sources.values()))

    @property
    def budget(self) -> dict[str, float]:
        """Root mean square over the image by source, and of the bias, which is none of them."""
        return {**{name: _rms(values) for name, values in self.sources.items()}, "regularisation_bias": self.bias}

    def channels(self) -> dict[str, Channel]:
        """(n, n') channels of uncertainty.exr."""
        parts = {"uncertainty": self.total, "random": self.random, "systematic": self.systematic}
        return {name: values.astype(np.float32) for name, values in parts.items()}

    def summary(self) -> dict[str, Any]:
        """What result.json and the command line's JSON say of it."""
        return {
            "uncertainty": _rms(self.total),
            "uncertainty_budget": {**self.budget, "regularisation_bias": self.bias},
        }


@dataclass(frozen=True, eq=False)
class Propagation:
    """How noise of a model's data comes to be noise of its image.

    Parameters
    ----------
    prepared
        the factorised model.
    factors
        Phi_L (m, n) and Phi_R (m', n'), centred where the model is.
    patterns
        P_L (n, K) and P_R (n', K').
    lam
        lambda of the image.
    """

    prepared: Prepared
    factors: tuple[FloatArray, FloatArray]
    patterns: tuple[FloatArray, FloatArray]
    lam: float

    @property
    def gain(self) -> FloatArray:
        """G (r, r'), 0 where nothing is measured."""
        sigma = np.outer(self.prepared.left.singular, self.prepared.right.singular)
        return np.divide(sigma, np.square(sigma) + self.lam, out=np.zeros_like(sigma), where=sigma > 0)

    def of_frames(self, variance: FloatArray) -> FloatArray:
        """(n, n') variance of the image, ``variance`` (K, K') being the mean of a datum of each pattern."""
        left, right = (_column_energies(side) for side in self._sides)
        return self._spread(left.T @ variance @ right)

    def of_ambient_frame(self, variance: float) -> FloatArray:
        """(n, n') variance of the image by one noisy frame, of this mean ``variance``, taken off every measurement."""
        left, right = (_common_energy(side) for side in self._sides)
        return self._spread(variance * np.outer(left, right))

    def of_factors(self, noise: FactorNoise, image: FloatArray) -> FloatArray:
        """(n, n') variance of an ``image`` by ``noise`` of the factors."""
        left, right = self._sides
        gain = self.gain
        rows = _of_factor(left, right, self.patterns[0], gain, image)
        columns = _of_factor(right, left, self.patterns[1], gain.T, image.T).T
        return np.asarray(noise.left**2 * rows + noise.right**2 * columns)

    def of_print(self, image: FloatArray) -> FloatArray:
        """(n, n') square of what an ``image`` is off by when its print changes evenly within every projector pixel."""
        left, right = self._sides
        gain = self.gain
        rows, columns = (np.gradient(image, axis=axis) / 12 if image.shape[axis] > 1 else 0 * image for axis in (0, 1))
        moved = [moved_responses(*side) for side in zip(self._sides, self.factors, self.patterns, strict=True)]
        seen = moved[0].T @ rows @ (right.basis * right.singular), (left.basis * left.singular).T @ columns @ moved[1]
        return sum((np.square(self.prepared.image(gain * each)) for each in seen), np.zeros_like(image))

    def _spread(self, variances: FloatArray) -> FloatArray:
        """(n, n') variance of the image, that of each coefficient of W being ``variances`` (r, r')."""
        left, right = (np.square(side.basis) for side in self._sides)
        return np.asarray(left @ (np.square(self.gain) * variances) @ right.T)

    @property
    def _sides(self) -> tuple[Side, Side]:
        return self.prepared.left, self.prepared.right


def uncertainty(
    propagation: Propagation,
    noise: FrameNoise,
    factors: FactorNoise | None,
    exposure: float,
    image: FloatArray,
    problem: DiagonalProblem,
) -> Uncertainty:
    """Standard uncertainty of an image.

    Parameters
    ----------
    propagation
        of the image's model and lambda.
    noise
        of its frames.
    factors
        of its factors; None: not stated, and left out.
    exposure
        relative standard uncertainty of the exposures.
    image
        (n, n').
    problem
        its data in the diagonal basis.
    """
    zero = np.zeros_like(image)
    rendering = np.full(noise.variance.shape, noise.rendering / problem.data_count)
    variances = {
        "frame_noise": propagation.of_frames(noise.variance),
        "ambient_frame": propagation.of_ambient_frame(noise.ambient_variance) if noise.ambient_variance else zero,
        "rendering": propagation.of_frames(rendering) if noise.rendering else zero,
        "calibration_noise": propagation.of_factors(factors, image) if factors else zero,
        "print_detail": propagation.of_print(image),
        "exposure": np.square(exposure * image),
    }
    return Uncertainty(
        sources={name: np.sqrt(np.maximum(variance, 0.0)) for name, variance in variances.items()},
        bias=regularisation_bias(problem, propagation.lam, float(noise.variance.mean())),
    )


def regularisation_bias(problem: DiagonalProblem, lam: float, variance: float) -> float:
    """Root mean square over the image of what lambda takes away.

    Parameters
    ----------
    problem
        in its diagonal basis.
    lam
        lambda.
    variance
        of a datum.

    Notes
    -----
    Coefficient x loses (1 - k) x. Over an octave of sigma the scene's energy, the mean of x^2, is told by sum(W^2 -
    variance) / sum(sigma^2) while there is more signal than noise in it. Beyond, it goes on by the power of sigma that
    the last octaves show, or as it is: scenes have less of what a camera sees badly, which is fine detail.
    """
    measured = problem.sigma > 0
    sigma, data = problem.sigma[measured], np.square(problem.projected[measured])
    octave = np.log2(sigma.max() / sigma).astype(np.intp)
    count = np.maximum(np.bincount(octave), 1)
    signal = np.bincount(octave, data) / count - variance
    square = np.bincount(octave, np.square(sigma)) / count
    told = np.flatnonzero(signal > variance)
    if not told.size:
        return 0.0
    energy = np.where(signal > variance, signal, 0.0) / np.where(square > 0, square, 1.0)
    last, fitted = told[-1], told[-_FITTED:]
    power = np.polyfit(np.log(square[fitted]), np.log(energy[fitted]), 1)[0] if fitted.size == _FITTED else 0.0
    beyond = np.power(square[octave] / square[last], max(float(power), 0.0)) * energy[last]
    expected = np.where(octave > last, beyond, energy[octave])
    lost = np.square(1 - problem.kept(lam)[measured])
    return float(np.sqrt(np.sum(lost * expected) / problem.sigma.size))


def _column_energies(side: Side) -> FloatArray:
    """(K, r) part of each column of U that lies in the rows of each pattern; parts of a column add up to 1."""
    energies = np.zeros((side.pattern_count, len(side.singular)))
    for energy, slab in zip(energies, side.slabs, strict=True):
        energy[slab.columns] = np.square(slab.matrix).sum(axis=0)
    return energies


def _common_energy(side: Side) -> FloatArray:
    """(r,) squared norm of the sum of all slabs: how much of one frame, added to all, each coefficient takes."""
    total = np.zeros((side.sensor_size, len(side.singular)))
    for slab in side.slabs:
        total[:, slab.columns] += slab.matrix
    return np.asarray(np.square(total).sum(axis=0))


def _of_factor(own: Side, other: Side, patterns: FloatArray, gain: FloatArray, image: FloatArray) -> FloatArray:
    """(n, n') variance of an ``image`` by independent numbers of variance 1 in the factor of its ``own`` side."""
    seen = image @ (other.basis * other.singular)
    responses = _responses(own, patterns)
    left, values, right = np.linalg.svd(gain, full_matrices=False)
    beyond = 1 - np.cumsum(np.square(values)) / np.square(values).sum()
    count = int(np.argmax(beyond <= _LOST)) + 1
    rows, columns = left[:, :count] * values[:count], right[:count]
    parts = [(seen * column) @ other.basis.T for column in columns]
    spread = np.zeros((len(own.singular), len(other.basis)))
    for k in range(count):
        for other_k in range(k + 1):
            twice = 1.0 if k == other_k else 2.0
            spread += twice * (rows[:, k] * rows[:, other_k])[:, None] * (responses @ (parts[k] * parts[other_k]))
    return np.asarray(np.square(own.basis) @ np.maximum(spread, 0.0))


def _responses(side: Side, patterns: FloatArray) -> FloatArray:
    """rho (r, n): squared norm of sum_i P[p, i] U_i[:, a], of coefficient a for light of scene pixel p."""
    stack = np.zeros((side.pattern_count, side.sensor_size, len(side.singular)))
    for part, slab in zip(stack, side.slabs, strict=True):
        part[:, slab.columns] = slab.matrix
    products = np.einsum("ima,jma->aij", stack, stack, optimize=True)
    return np.asarray(np.einsum("pi,aij,pj->ap", patterns, products, patterns, optimize=True))


def _together(parts: list[FloatArray]) -> FloatArray:
    """Root of the sum of squares."""
    return np.sqrt(sum(np.square(part) for part in parts))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.square(values).mean()))
