"""Anchors and the interpolation between them, against numpy's own polynomials."""

import numpy as np
import pytest

from mitsim.optics.image_formation import anchor_positions, anchor_weights


@pytest.mark.parametrize("count", [1, 2, 3, 6])
def test_anchors_are_chebyshev_s_nodes_in_rising_order(count: int) -> None:
    np.testing.assert_allclose(
        anchor_positions(count, 1.5), 1.5 * np.polynomial.chebyshev.chebpts1(count), rtol=0, atol=1e-15
    )


@pytest.mark.parametrize("count", [1, 2, 5])
def test_interpolation_is_exact_for_polynomials_of_one_degree_less_than_anchors(count: int) -> None:
    anchors, at = anchor_positions(count, 2.0), np.linspace(-2.2, 2.2, 9)
    polynomial = np.polynomial.Polynomial(np.arange(1, count + 1))
    weights = anchor_weights(anchors, at)
    assert weights.shape == (9, count)
    np.testing.assert_allclose(weights @ polynomial(anchors), polynomial(at), rtol=1e-12)
    np.testing.assert_allclose(anchor_weights(anchors, anchors), np.eye(count), atol=1e-14)
