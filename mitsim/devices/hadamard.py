"""Hadamard matrices that can be built: an order in, how it is reached out; no matrix is made.

Sylvester's doubling, Paley's two constructions over prime fields (R. Paley, 1933), and Kronecker products of these:
every multiple of 4 up to 48, then gaps.
"""

from __future__ import annotations

from functools import cache
from typing import Literal

from mitsim.core.errors import MitsimError

Way = tuple[Literal["doubled", "skew", "symmetric", "product"], int]
"""How a matrix is built, and its order, its conference matrix's prime, or the order of its left factor."""


def way_to(order: int) -> Way:
    """How the matrix of that ``order`` is built.

    MitsimError for an order that no construction here reaches, with the nearest ones that are reached.
    """
    way = _way(order)
    if way is None:
        below = max((o for o in hadamard_orders(order) if o < order), default=1)
        above = next(o for o in range(order + 1, 4 * order + 5) if _way(o))
        raise MitsimError(f"no Hadamard matrix of order {order} is available; use {below} or {above}")
    return way


def hadamard_orders(limit: int) -> list[int]:
    """Orders up to ``limit`` that :func:`mitsim.devices.patterns.hadamard_matrix` can build."""
    return [order for order in range(1, limit + 1) if _way(order)]


def stripe_count(n: int) -> int:
    """N, the stripe patterns of a side for ``n`` projector pixels: the smallest order of at least n.

    MitsimError where no order up to 2 n is reached.
    """
    for order in range(n, 2 * n + 1):  # with a power of two among them
        if _way(order):
            return order
    raise MitsimError(f"no Hadamard matrix for {n} projector pixels; use another number of pixels")


@cache
def _way(order: int) -> Way | None:
    if order < 1 or (order > 2 and order % 4):
        return None
    if order & (order - 1) == 0:
        return "doubled", order
    if _is_prime(order - 1) and (order - 1) % 4 == 3:
        return "skew", order - 1
    half = order // 2
    if _is_prime(half - 1) and (half - 1) % 4 == 1:
        return "symmetric", half - 1
    factors = (factor for factor in range(2, half + 1) if order % factor == 0)
    found = next((factor for factor in factors if _way(factor) and _way(order // factor)), None)
    return None if found is None else ("product", found)


def _is_prime(value: int) -> bool:
    return value > 1 and all(value % factor for factor in range(2, int(value**0.5) + 1))
