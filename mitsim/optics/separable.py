"""Sums of separable terms as operators: how far two are apart, and how far one is from a single separable term.

The sum of ``L_k (x) R_k`` takes an image X to the frame ``sum_k L_k X R_k^T``. As a matrix from pixels to pixels it has
(m m') x (n n') entries; written with vec(L_k) and vec(R_k) as columns it is ``A = L R^T`` with as few columns as there
are terms, and its Frobenius norm and singular values are those of small matrices (Van Loan and Pitsianis, 1993). Left
and right factors of all terms have one shape each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mitsim.core.arrays import FloatArray, SeparableTerm
from mitsim.optics.shadow import SeparableTerms

_LEFT_OUT = 0.03
"""Part of what factors lack that its terms may leave out, rms: a thousandth of an energy. Two or three terms hold the
rest of FlatCam's masks and of MURA in three lines."""
_TURNS = 2
"""Steps to the brightness of a session's pixels: the third moves the residual by 1e-7."""


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


@dataclass(frozen=True, eq=False)
class Lacking:
    """What factors lack of a camera.

    Attributes
    ----------
    terms
        [(left (m, n), right (m', n')), ...] of the operator less the factors', but for 3 % of it, rms.
    residual
        its Frobenius norm as a part of the operator's: of the light of single pixels, rms.
    """

    terms: SeparableTerms
    residual: float


def best_term(terms: SeparableTerms) -> BestTerm:
    """The one separable term that comes closest to the sum of ``terms``; its factors' sign is like the largest term's.

    The singular values of A are those of the product of two small triangles, from QR factorisations of the two sides:
    Gram matrices would square the condition number and leave 1e-8 where the residual is zero.
    """
    values, split = _singular(terms)
    left, right = split(0)
    largest = max(terms, key=lambda pair: float(np.linalg.norm(pair[0]) * np.linalg.norm(pair[1])))
    sign = 1.0 if np.vdot(left, largest[0]) >= 0 else -1.0
    energy = np.square(values)
    return BestTerm(sign * left, sign * right, float(np.sqrt(energy[1:].sum() / energy.sum())))


def lacking(terms: SeparableTerms, left: FloatArray, right: FloatArray) -> Lacking:
    """What factors that a session's stripes gave lack of the camera's operator.

    Stripes give factors of an operator in closed form (:func:`_of_stripes`). Those of ``terms``, of pixels of one
    brightness, tell by each column how bright its pixels were in the session, and so the operator as it was.

    Parameters
    ----------
    terms
        the operator [(left (m, n), right (m', n')), ...].
    left, right
        the factors (m, n) and (m', n'), centred as the terms are.
    """
    whole = terms
    for _ in range(_TURNS):
        rows, columns = (
            np.einsum("ij,ij->j", found, own) / np.maximum(np.einsum("ij,ij->j", own, own), np.finfo(np.float64).tiny)
            for found, own in zip((left, right), _of_stripes(whole), strict=True)
        )
        whole = [(rows * a, columns * b) for a, b in whole]
    values, split = _singular([*whole, (-left, right)])
    beyond = np.sqrt(np.cumsum(np.square(values[::-1]))[::-1])
    count = int(np.count_nonzero(beyond > _LEFT_OUT * beyond[0]))
    return Lacking([split(number) for number in range(count)], float(beyond[0] / np.sqrt(_energy(whole))))


def _of_stripes(terms: SeparableTerms) -> SeparableTerm:
    """The factors that stripes give of an operator (:mod:`mitsim.reconstruct.estimate_factors`): with its uniform
    response sum_k (L_k 1) (R_k 1)^T split into a v^T, stripes h 1^T into u v^T with u = sum_k L_k h <R_k 1, v> / |v|^2,
    so the left factor is the sum of L_k with these weights; and the right one likewise."""
    uniform = best_term([(a.sum(axis=1, keepdims=True), b.sum(axis=1, keepdims=True)) for a, b in terms])
    split = uniform.left[:, 0], uniform.right[:, 0]
    return (
        sum((a * (np.dot(b.sum(axis=1), split[1]) / np.dot(split[1], split[1])) for a, b in terms), 0 * terms[0][0]),
        sum((b * (np.dot(a.sum(axis=1), split[0]) / np.dot(split[0], split[0])) for a, b in terms), 0 * terms[0][1]),
    )


def _singular(terms: SeparableTerms) -> tuple[FloatArray, Callable[[int], SeparableTerm]]:
    """Singular values of an operator, and what gives the term (of factors of equal norm) of the one of a number."""
    (left, small_left), (right, small_right) = (
        np.linalg.qr(np.stack([np.ravel(pair[side]) for pair in terms], axis=1)) for side in (0, 1)
    )
    turn_left, values, turn_right = np.linalg.svd(small_left @ small_right.T)

    def split(number: int) -> SeparableTerm:
        root = np.sqrt(values[number])
        return (
            (root * left @ turn_left[:, number]).reshape(terms[0][0].shape),
            (root * right @ turn_right[number]).reshape(terms[0][1].shape),
        )

    return values, split


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
