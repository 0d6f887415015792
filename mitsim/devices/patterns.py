"""Pattern families: from a name such as ``dots:7`` to the factors P_L, P_R and the shots that show every pattern.

Pattern (i, j) is ``P_L[:, i] P_R[:, j]^T`` over the projector's n x n pixels (paper, section III-B). A family with
values +-1 cannot be projected as it is: each of its patterns is shown twice, as (1 + P)/2 and (1 - P)/2, and the
measurement is the difference.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.errors import MitsimError
from mitsim.core.manifests import MOST_SHOTS
from mitsim.core.seeds import stream
from mitsim.devices.families import read_name, shot_count
from mitsim.devices.hadamard import stripe_count, way_to

PatternFactor = npt.NDArray[np.int8]
"""(n, K) of 0/1 or +-1: one side of K separable patterns."""


@dataclass(frozen=True)
class Shot:
    """One projected frame: pattern (row, column), whole (sign 0) or the positive or negative half of a +-1 pattern."""

    row: int
    column: int
    sign: int = 0

    @property
    def names(self) -> tuple[str, int, int, int]:
        """Names of the shot's random streams."""
        return ("capture", self.row, self.column, self.sign)


@dataclass(frozen=True, eq=False)
class Lighting:
    """Which light belongs together, and how much of it each shot shows.

    Attributes
    ----------
    labels
        (n^2,) class of each projector pixel, 0 to C - 1; or of each row of light, where pixels share rows.
    weights
        (shots, C) fraction 0..1 of full power that each class emits in each shot.
    """

    labels: Labels
    weights: FloatArray

    @classmethod
    def uniform(cls, n: int) -> Lighting:
        """One shot with each of ``n`` x ``n`` projector pixels fully lit."""
        return cls(np.zeros(n * n, dtype=np.int64), np.ones((1, 1)))

    def shots(self, chosen: list[int] | npt.NDArray[np.int64]) -> Lighting:
        """The same classes in the ``chosen`` shots only."""
        return replace(self, weights=self.weights[chosen])


@dataclass(frozen=True, eq=False)
class PatternFamily:
    """Separable patterns on an n x n grid.

    Attributes
    ----------
    name
        as given on the command line.
    left, right
        P_L and P_R, (n, K) of 0/1 or +-1.
    """

    name: str
    left: PatternFactor
    right: PatternFactor

    @property
    def n(self) -> int:
        """Projector pixels a side."""
        return int(self.left.shape[0])

    @property
    def signed(self) -> bool:
        """Whether the patterns take the value -1."""
        return bool((self.left < 0).any() or (self.right < 0).any())

    @property
    def shots(self) -> tuple[Shot, ...]:
        """Every frame to project, row-major over (i, j); a positive half is followed by its negative half."""
        signs = (1, -1) if self.signed else (0,)
        return tuple(
            Shot(i, j, sign) for i in range(self.left.shape[1]) for j in range(self.right.shape[1]) for sign in signs
        )

    def light(self, shot: Shot) -> FloatArray:
        """(n, n) fraction 0..1 of full power that each projector pixel emits in one ``shot``."""
        pattern = np.outer(self.left[:, shot.row], self.right[:, shot.column]).astype(np.float64)
        return np.asarray(pattern if shot.sign == 0 else (1 + shot.sign * pattern) / 2)

    @cached_property
    def lighting(self) -> Lighting:
        """The finest partition of the pixels whose members are always lit alike, and every shot's light of it."""
        _, row = np.unique(self.left, axis=0, return_inverse=True)
        _, column = np.unique(self.right, axis=0, return_inverse=True)
        label = (row.reshape(-1, 1) * (int(column.max()) + 1) + column.reshape(1, -1)).ravel()
        _, first, sorted_label = np.unique(label, return_index=True, return_inverse=True)
        # Numbered by first appearance, so that shifting dots have one class a shot, in the same order.
        by_appearance = np.argsort(first)
        first, labels = first[by_appearance], np.argsort(by_appearance)[sorted_label.ravel()]
        i, j, sign = np.array([(shot.row, shot.column, shot.sign) for shot in self.shots]).T
        sign = sign[:, None]
        pattern = self.left[first // self.n][:, i].T * self.right[first % self.n][:, j].T.astype(np.float64)
        return Lighting(labels, np.where(sign == 0, pattern, (1 + sign * pattern) / 2))


def _shifting_dots(n: int, k: int) -> PatternFactor:
    """(n, k) of 0/1: column i lights every ``k``-th of ``n`` pixels from i on; n need not be a multiple of k."""
    return np.asarray(np.arange(n)[:, None] % k == np.arange(k)[None, :], dtype=np.int8)


def _repeated_hadamard(n: int, k: int) -> PatternFactor:
    """(n, k) of +-1: the rows of the Hadamard matrix of order ``k``, repeated down ``n`` pixels."""
    return np.asarray(hadamard_matrix(k)[np.arange(n) % k])


def _random_binary(n: int, k: int, seed: int, side: str) -> PatternFactor:
    """(n, k) fair coin flips, each pixel lit by at least one column: the union must cover the scene."""
    rng = stream(seed, "patterns", "random", side)
    bits = rng.integers(0, 2, size=(n, k), dtype=np.int8)
    dark = np.flatnonzero(~bits.any(axis=1))
    bits[dark, rng.integers(0, k, size=dark.size)] = 1
    return bits


def hadamard_matrix(order: int) -> PatternFactor:
    """(``order``, ``order``) matrix H of +-1 with H H^T = order I, first column all ones.

    Built as :mod:`mitsim.devices.hadamard` says, whose errors it raises.
    """
    matrix = _built(order)
    return (matrix * matrix[:, :1]).astype(np.int8)


def stripe_signs(n: int) -> PatternFactor:
    """(``n``, N) first rows of the smallest Hadamard matrix that has them; column 0 is all +1.

    The +-1 patterns of a calibration's stripes. MitsimError as :func:`mitsim.devices.hadamard.stripe_count`.
    """
    return hadamard_matrix(stripe_count(n))[:n]


def _built(order: int) -> npt.NDArray[np.int64]:
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
    squares = set((np.arange(1, q) ** 2 % q).tolist())
    character = np.array([0] + [1 if value in squares else -1 for value in range(1, q)])
    jacobsthal = character[(np.arange(q)[:, None] - np.arange(q)[None, :]) % q]
    matrix = np.zeros((q + 1, q + 1), dtype=np.int64)
    matrix[0, 1:] = 1
    matrix[1:, 0] = 1 if q % 4 == 1 else -1
    matrix[1:, 1:] = jacobsthal
    return matrix


_SAME_BOTH_SIDES: dict[str, Callable[[int, int], PatternFactor]] = {
    "uniform": lambda n, k: np.ones((n, 1), dtype=np.int8),
    "dots": _shifting_dots,
    "hadamard": _repeated_hadamard,
}
"""Families whose rows and columns show alike: from n and K to (n, K)."""


def parse_patterns(text: str, n: int, seed: int = 0) -> PatternFamily:
    """The family of a name.

    Parameters
    ----------
    text
        ``uniform``, ``dots:K``, ``dots:RxC`` (periods of rows and of columns), ``hadamard:K`` or ``random:K``.
    n
        projector pixels a side.
    seed
        of the random family.

    Raises
    ------
    MitsimError
        for an unknown family, a K that is not a whole number, K outside 1..n, or more shots than a run has.
    """
    name, periods = read_name(text, n)
    if (count := shot_count(text)) > MOST_SHOTS:
        raise MitsimError(f"patterns {text!r}: are {count} shots; a run has at most {MOST_SHOTS}, give a smaller K")
    if name == "random":
        return PatternFamily(text, *(_random_binary(n, periods[0], seed, side) for side in ("left", "right")))
    if len(periods) == 2:
        return PatternFamily(text, *(_shifting_dots(n, period) for period in periods))
    factor = _SAME_BOTH_SIDES[name](n, periods[0])
    return PatternFamily(text, factor, factor)
