"""Hadamard matrices: an order in; how it is reached, or the matrix, out.

Sylvester's doubling, Paley's two constructions over prime fields (R. Paley, 1933), and Kronecker products of these:
every multiple of 4 up to 48, then gaps. numpy is imported where a matrix is made: orders are checked without it.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Literal

from mitsim.core.errors import MitsimError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    PatternFactor = npt.NDArray[np.int8]
    """(n, K) of 0/1 or +-1: one side of K separable patterns."""

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
    """Orders up to ``limit`` that :func:`hadamard_matrix` can build."""
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


def hadamard_matrix(order: int) -> PatternFactor:
    """(``order``, ``order``) matrix H of +-1 with H H^T = order I, first column all ones.

    MitsimError as :func:`way_to`.
    """
    import numpy as np

    matrix = _built(order)
    return (matrix * matrix[:, :1]).astype(np.int8)


def _built(order: int) -> npt.NDArray[np.int64]:
    import numpy as np

    how, number = way_to(order)
    if how == "doubled":
        # Not scipy.linalg.hadamard: importing it takes longer than all else that a refusal needs.
        doubled = np.ones((1, 1), dtype=np.int64)
        while len(doubled) < order:
            doubled = np.kron([[1, 1], [1, -1]], doubled)
        return doubled
    if how == "skew":
        return _conference(number) + np.eye(order, dtype=np.int64)
    if how == "symmetric":
        symmetric, eye = _conference(number), np.eye(number + 1, dtype=np.int64)
        return np.kron(symmetric, [[1, 1], [1, -1]]) + np.kron(eye, [[1, -1], [-1, -1]])
    return np.kron(_built(number), _built(order // number))


def _conference(q: int) -> npt.NDArray[np.int64]:
    """(q + 1, q + 1) Paley conference matrix of the prime q: skew for q = 3 mod 4, symmetric for q = 1 mod 4."""
    import numpy as np

    squares = set((np.arange(1, q) ** 2 % q).tolist())
    character = np.array([0] + [1 if value in squares else -1 for value in range(1, q)])
    jacobsthal = character[(np.arange(q)[:, None] - np.arange(q)[None, :]) % q]
    matrix = np.zeros((q + 1, q + 1), dtype=np.int64)
    matrix[0, 1:] = 1
    matrix[1:, 0] = 1 if q % 4 == 1 else -1
    matrix[1:, 1:] = jacobsthal
    return matrix
