"""Sums of separable terms as operators: how far two are apart, and how far one is from a single separable term.

The sum of ``L_k (x) R_k`` takes an image X to the frame ``sum_k L_k X R_k^T``. As a matrix from pixels to pixels it has
(m m') x (n n') entries; written with vec(L_k) and vec(R_k) as columns it is ``A = L R^T`` with as few columns as there
are terms, and its Frobenius norm and singular values are those of small matrices (Van Loan and Pitsianis, 1993). Left
and right factors of all terms have one shape each.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.optics.shadow import SeparableTerms


@dataclass(frozen=True, eq=False)
class BestTerm:
    """The separable term ``left (x) right`` nearest to an operator, in the Frobenius norm.

    Attributes
    ----------
    left, right
        (m, n), (m', n') of equal norm.
    residual
        ||A - left (x) right|| / ||A||; 0 for one term.
    """

    left: FloatArray
    right: FloatArray
    residual: float


def best_term(terms: SeparableTerms) -> BestTerm:
    """The one separable term that comes closest to the sum of ``terms``; its factors' sign is like the largest term's.

    The singular values of A are those of the product of two small triangles, from QR factorisations of the two sides:
    Gram matrices would square the condition number and leave 1e-8 where the residual is zero.
    """
    (left, small_left), (right, small_right) = (
        np.linalg.qr(np.stack([np.ravel(pair[side]) for pair in terms], axis=1)) for side in (0, 1)
    )
    turn_left, values, turn_right = np.linalg.svd(small_left @ small_right.T)
    root = np.sqrt(values[0])
    factors = [
        (root * basis @ turn).reshape(like.shape)
        for basis, turn, like in zip((left, right), (turn_left[:, 0], turn_right[0]), terms[0], strict=True)
    ]
    largest = max(terms, key=lambda pair: float(np.linalg.norm(pair[0]) * np.linalg.norm(pair[1])))
    sign = 1.0 if np.vdot(factors[0], largest[0]) >= 0 else -1.0
    energy = np.square(values)
    return BestTerm(sign * factors[0], sign * factors[1], float(np.sqrt(energy[1:].sum() / energy.sum())))


def relative_difference(terms: SeparableTerms, reference: SeparableTerms) -> float:
    """||A - B|| / ||B|| of the operators of ``terms`` and ``reference``; rounding hides what is below 1e-7."""
    minus = [(-left, right) for left, right in reference]
    return float(np.sqrt(_energy([*terms, *minus]) / _energy(reference)))


def centred(terms: SeparableTerms) -> SeparableTerms:
    """``terms`` of frames from which the means of rows and columns are taken: that of every factor's columns is."""
    return [(left - left.mean(axis=0), right - right.mean(axis=0)) for left, right in terms]


def _energy(terms: SeparableTerms) -> float:
    """Squared Frobenius norm, sum_kl <L_k, L_l> <R_k, R_l>."""
    left, right = (np.stack([np.ravel(pair[side]) for pair in terms]) for side in (0, 1))
    return max(float(((left @ left.T) * (right @ right.T)).sum()), 0.0)
