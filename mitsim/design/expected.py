"""Expected squared error of images of a separable camera by cause, with gradients, from Gram matrices.

A side of the camera has the factor F (m, n) and the patterns C (n, k). Frames depend on F and C only through the stack
of F diag(c_i), whose Gram matrix is M = (F^T F) o (C C^T) = V diag(mu) V^T. With M and nu of the two sides, Tikhonov
regularisation gives the coefficient (a, b) of the image the gain G_ab = sqrt(mu_a nu_b) / (mu_a nu_b + lambda). The
expected squared error of all causes that are independent of one another is

    sum over causes of  w sum_ab  mu_a^i nu_b^j / (mu_a nu_b + lambda)^2  (v_a^T A v_a) (v'_b^T B v'_b)

where the exponents (i, j), the weight w and the matrices A and B depend on the cause:

- noise of variance w in all data: (1, 1), A = B = 1.
- errors of variance w in all numbers of the left factor, which are the same in all frames: (0, 2),
  A = (F^T F) o (P P) with P = C C^T, and B = E[x x^T] of the scene's rows.
- *detail* inside projector pixels, of the deviation F' S F'^T: (0, 2), A = N S N^T with N = (F^T F') o P.
- a frame of noise that is subtracted from all frames: (0, 0), A = (F^T F) o (c c^T) with c the sum of patterns.

*Regularisation* removes lambda z_ab / (mu_a nu_b + lambda) of each coefficient z = V^T X V' of a scene X.

Because M alone determines mu and V, the sum is a spectral function of M. Its derivative needs divided differences of
mu^i / (mu nu + lambda)^2 (Daleckii and Krein, 1965), which are written without a difference of close numbers, so that
equal eigenvalues are harmless (Lewis, Math. Oper. Res. 21, 576, 1996).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from mitsim.core.arrays import FloatArray

Pair = tuple[FloatArray, FloatArray]
BIAS = "regularisation_bias"
_DECADES = -14.0, 2.0
"""Range of lambda relative to the largest squared singular value, as powers of ten."""


@dataclass(frozen=True, eq=False)
class Cause:
    """One cause of error: ``powers`` (i, j), matrices A and B (n, n), and weight w."""

    name: str
    powers: tuple[int, int]
    matrices: Pair
    weight: float = 1.0


@dataclass(frozen=True, eq=False)
class ExpectedError:
    """Sum of squared errors (``total``, and ``parts`` by cause) at ``lam``, and its derivatives.

    ``per_weight`` has the sum of each cause for a weight of 1. ``of_gram`` is the derivative with respect to M of each
    side, and ``of_matrices`` those with respect to A and B of each cause; empty without gradients.
    """

    lam: float
    parts: dict[str, float]
    per_weight: tuple[float, ...]
    of_gram: tuple[FloatArray, ...] = ()
    of_matrices: tuple[Pair, ...] = ()

    @property
    def total(self) -> float:
        return sum(self.parts.values())


def expected_error(
    grams: Pair, causes: Sequence[Cause], scenes: Sequence[FloatArray], lam: float | None = None, slopes: bool = False
) -> ExpectedError:
    """Compute the expected squared error of an image, summed over its pixels.

    Parameters
    ----------
    grams
        M of the left and of the right side, (n, n) and (n', n'), or its blocks (groups, size, size) if M is block
        diagonal in the order of the scene's pixels. Of A and B these blocks suffice.
    causes
        Causes of error.
    scenes
        Scenes (n, n') over which the bias of regularisation is averaged.
    lam
        Regularisation; None for the value with the least error.
    slopes
        Compute derivatives. At the best lambda, its own change does not contribute (envelope theorem).
    """
    mu, left = np.linalg.eigh(grams[0])
    nu, right = (mu, left) if grams[1] is grams[0] else np.linalg.eigh(grams[1])
    mu, nu = np.maximum(mu, 0.0), np.maximum(nu, 0.0)
    rows, columns = mu.ravel(), nu.ravel()
    product = np.outer(rows, columns)
    products = dict[tuple[int, int], FloatArray]()  # causes share matrices

    def times(matrix: FloatArray, basis: FloatArray) -> FloatArray:
        key = id(matrix), id(basis)
        if key not in products:
            products[key] = matrix @ basis
        return products[key]

    def turned_by(basis: FloatArray, matrix: FloatArray) -> FloatArray:
        return (basis.mT @ matrix.reshape(*basis.shape[:-1], -1)).reshape(matrix.shape)

    turned = [(times(a, left), times(b, right)) for a, b in (cause.matrices for cause in causes)]
    seen = [((left * a).sum(axis=-2).ravel(), (right * b).sum(axis=-2).ravel()) for a, b in turned]
    of_rows = np.stack([own * rows ** cause.powers[0] for (own, _), cause in zip(seen, causes, strict=True)])
    of_columns = np.stack([own * columns ** cause.powers[1] for (_, own), cause in zip(seen, causes, strict=True)])

    coefficients = [turned_by(right, turned_by(left, scene).T).T for scene in scenes]
    energy = sum(np.square(each) for each in coefficients) / len(scenes)

    def sums(value: float) -> list[float]:
        inverse = 1 / np.square(product + value)
        return [*((of_rows @ inverse) * of_columns).sum(axis=1).tolist(), value**2 * float(np.vdot(inverse, energy))]

    weights = [*(cause.weight for cause in causes), 1.0]
    if lam is None:
        largest = float(product.max())
        trial = minimize_scalar(
            lambda power: float(np.dot(weights, sums(largest * 10.0**power))), bounds=_DECADES, method="bounded",
            options={"xatol": 1e-3},
        )  # fmt: skip
        lam = largest * 10.0 ** float(trial.x)
    found = tuple(sums(lam))
    parts = {**dict.fromkeys((cause.name for cause in causes), 0.0), BIAS: found[-1]}
    for cause, one in zip(causes, found[:-1], strict=True):
        parts[cause.name] += cause.weight * one
    if not slopes:
        return ExpectedError(lam, parts, found)
    once = 1 / (product + lam)
    inverse, matrices = np.square(once), []
    of_left, of_right = np.zeros_like(grams[0]), np.zeros_like(grams[1])
    for each in coefficients:
        halves = (each * once * columns, each * inverse), ((each * once * rows[:, None]).T, (each * inverse).T)
        for of, half, basis in zip((of_left, of_right), halves, (left, right), strict=True):
            first, second = (matrix.reshape(*basis.shape[:-1], -1) for matrix in half)
            of -= lam**2 / len(scenes) * (first @ second.mT + second @ first.mT)
    for cause, (a, b), own, other in zip(causes, turned, of_rows, of_columns, strict=True):
        (i, j), weight = cause.powers, cause.weight
        of_left += weight * (left.mT @ a) * _divided(mu, columns, lam, i, other)
        of_right += weight * (right.mT @ b) * _divided(nu, rows, lam, j, own)
        by_left = weight * (rows**i * (inverse @ other)).reshape(mu.shape)[..., None, :]
        by_right = weight * (columns**j * (own @ inverse)).reshape(nu.shape)[..., None, :]
        matrices.append(((left * by_left) @ left.mT, (right * by_right) @ right.mT))
    return ExpectedError(lam, parts, found, (left @ of_left @ left.mT, right @ of_right @ right.mT), tuple(matrices))


def _divided(mu: FloatArray, nu: FloatArray, lam: float, power: int, weights: FloatArray) -> FloatArray:
    """Return divided differences of g(mu) = sum_b w_b mu^i / (mu nu_b + lambda)^2 between eigenvalues of a block."""
    once = 1 / (mu[..., None] * nu + lam)
    twice = np.square(once)
    if power == 0:
        one = (once * (weights * nu)) @ twice.mT
        return np.asarray(-(one + one.mT))
    scaled = mu[..., None] * twice
    if power == 1:
        return np.asarray(lam**2 * (twice * weights) @ twice.mT - (scaled * (weights * np.square(nu))) @ scaled.mT)
    one = mu[..., None] * ((twice * weights) @ twice.mT)
    return np.asarray(lam * (2 * (scaled * (weights * nu)) @ scaled.mT + lam * (one + one.mT)))
