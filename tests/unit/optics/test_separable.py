"""Operators of separable terms against the dense four-dimensional ones that they stand for."""

import numpy as np
import pytest
from scipy.linalg import hadamard

from mitsim.optics.terms import best_term, lacking
from mitsim.reconstruct.factors import estimate_factors

Terms = list[tuple[np.ndarray, np.ndarray]]


def random_terms(count: int, seed: int) -> Terms:
    """Factors (7, 4) and (6, 5): no two sizes are equal, so that no axis can be mistaken."""
    random = np.random.default_rng(seed)
    return [(random.normal(size=(7, 4)), 3 * random.normal(size=(6, 5))) for _ in range(count)]


def dense(terms: Terms) -> np.ndarray:
    """(7 * 4, 6 * 5) matrix with the operator's entries, left indices against right ones."""
    return sum(np.einsum("ir,jc->irjc", left, right).reshape(28, 30) for left, right in terms)


@pytest.mark.parametrize("count", [2, 3, 40])
def test_the_best_term_is_the_first_singular_pair_of_the_dense_operator(count: int) -> None:
    terms = random_terms(count, 1)
    whole = dense(terms)
    left, values, right = np.linalg.svd(whole)
    best = best_term(terms)
    assert np.allclose(dense([(best.left, best.right)]), values[0] * np.outer(left[:, 0], right[0]), atol=1e-10)
    assert best.residual == pytest.approx(np.linalg.norm(values[1:]) / np.linalg.norm(values), rel=1e-10)
    error = np.linalg.norm(whole - dense([(best.left, best.right)])) / np.linalg.norm(whole)
    assert best.residual == pytest.approx(error, rel=1e-10)


@pytest.mark.parametrize("count", [1, 3])
def test_what_factors_of_stripes_lack_is_the_rest_of_the_operator(count: int) -> None:
    """Pixels of a brightness of their own, which only their factors tell: the calibration's own estimate of the dense
    operator's responses, and the operator less these factors. (Planted: factors held against the best term.)"""
    random, signs = np.random.default_rng(6), hadamard(4).astype(np.float64)
    terms = [
        (part * random.normal(size=(7, 4)) + 0.5, part * random.normal(size=(6, 4)) + 0.5)
        for part in (1.0, 0.2, 0.1)[:count]
    ]
    rows, columns = 1 + 0.2 * random.random(4), 1 + 0.2 * random.random(4)
    bright = [(3 * rows * left, columns * right) for left, right in terms]
    horizontal, vertical = (
        [sum(left @ shown @ right.T for left, right in bright) for shown in shot]
        for shot in (np.stack([np.outer(h, np.ones(4)) for h in signs.T]), [np.outer(np.ones(4), h) for h in signs.T])
    )
    found = estimate_factors(horizontal, vertical, signs)
    whole = sum(np.einsum("ir,jc->irjc", *term) for term in bright)
    rest = whole - np.einsum("ir,jc->irjc", found.left, found.right)
    lacks = lacking(terms, found.left, found.right)
    assert lacks.residual == pytest.approx(np.linalg.norm(rest) / np.linalg.norm(whole), rel=0.02, abs=1e-12)
    made = sum((np.einsum("ir,jc->irjc", *term) for term in lacks.terms), 0 * rest)
    assert np.linalg.norm(made - rest) <= 0.06 * np.linalg.norm(rest) + 1e-12 * np.linalg.norm(whole)
