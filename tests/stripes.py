"""Factors from the responses to striped light as arrays, which only tests and benchmarks have."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mitsim.reconstruct.factors import Estimate, factors_of_sums, stripe_sums


def estimated(
    horizontal: Iterable[np.ndarray],
    vertical: Iterable[np.ndarray],
    signs: np.ndarray,
    centre: bool = False,
    noise: float | None = None,
) -> Estimate:
    """Return the estimate of a calibration from responses (m, m') to signs[:, i] 1^T and 1 signs[:, i]^T."""
    pairs = zip(horizontal, vertical, strict=True)
    sums = stripe_sums(*next(pairs), signs.shape[1], centre)
    for pair in pairs:
        for side, response in zip(sums, pair, strict=True):
            side.put(side.fit_response(response))
    return factors_of_sums(*sums, signs, noise)
