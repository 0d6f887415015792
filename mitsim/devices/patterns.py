"""Pattern families: from a text such as ``dots:7`` to the factors P_L, P_R and the shots that show every pattern.

Pattern (i, j) is ``P_L[:, i] P_R[:, j]^T`` over the projector's n x n pixels (paper, section III-B). A family with
values +-1 shows each pattern as two shots, (1 + P)/2 and (1 - P)/2. A family is a function with the decorator
:func:`pattern_family`, from which the command line, the checks of requests and the documents are made. numpy is
imported only where patterns are made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import count, product
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.devices import pattern_files

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from mitsim.core.arrays import FloatArray, Labels
    from mitsim.core.manifests import Patterns

    PatternFactor = npt.NDArray[np.int8]
    """(n, K) of 0/1 or +-1."""


_MOST_DIGITS = 9
_MOST_CHECKED = 4096
ORDERS = "natural", "sequency", "dyadic", "cake-cutting"
"""Orders of Sylvester's Hadamard patterns: names that may follow the K of a family."""

# ---- What is projected ----


@dataclass(frozen=True)
class Shot:
    row: int
    column: int
    sign: int = 0

    @property
    def names(self) -> tuple[str, int, int, int]:
        return ("capture", self.row, self.column, self.sign)


@dataclass(frozen=True, eq=False)
class Lighting:
    """Classes of light that shots switch together.

    Attributes
    ----------
    labels
        (n^2,) class of each projector pixel, 0 to C - 1; or of each row of light, where pixels share rows.
    weights
        (shots, C) fraction of full power that each class emits in each shot.
    """

    labels: Labels
    weights: FloatArray

    @classmethod
    def uniform(cls, n: int) -> Lighting:
        import numpy as np

        return cls(np.zeros(n * n, dtype=np.int64), np.ones((1, 1)))

    @property
    def lit(self) -> float:
        return float(self.weights.mean(axis=0)[self.labels].mean())

    def shots(self, chosen: list[int] | npt.NDArray[np.int64]) -> Lighting:
        return replace(self, weights=self.weights[chosen])


@dataclass(frozen=True, eq=False)
class PatternFamily:
    """Factors of patterns, and the ``grey`` pictures that show them, rounded to 8 bits; None for 0/1 and +-1.

    ``order`` is one of :data:`ORDERS`, in which shots are taken; empty for row-major.
    """

    name: str
    left: PatternFactor | FloatArray
    right: PatternFactor | FloatArray
    grey: pattern_files.GreyPictures | None = None
    order: str = ""

    @property
    def n(self) -> int:
        return int(self.left.shape[0])

    @property
    def signed(self) -> bool:
        return bool((self.left < 0).any() or (self.right < 0).any())

    @cached_property
    def shots(self) -> tuple[Shot, ...]:
        sizes = self.left.shape[1], self.right.shape[1]
        shots = tuple(Shot(*place) for place in product(*map(range, sizes), (1, -1) if self.signed else (0,)))
        if not self.order:
            return shots
        import numpy as np

        row, column = np.array([(shot.row, shot.column) for shot in shots]).T
        taken = np.lexsort(_walks(sizes, row, column)[self.order][::-1])  # stable: + stays before -
        return tuple(shots[index] for index in taken)

    def light(self, shot: Shot) -> FloatArray:
        import numpy as np

        if self.grey:
            return np.asarray(self.grey.light[self.grey.levels[shot.row * self.right.shape[1] + shot.column]])
        pattern = np.outer(self.left[:, shot.row], self.right[:, shot.column]).astype(np.float64)
        return np.asarray(pattern if shot.sign == 0 else (1 + shot.sign * pattern) / 2)

    def measurements(self, rates: Iterable[FloatArray]) -> Iterator[tuple[FloatArray, int, int]]:
        """Yield the measurement, row and column of each pattern from the ``rates`` of all shots in their order.

        The measurement of a signed pattern is the difference of its two shots.
        """
        positive = None
        for shot, rate in zip(self.shots, rates, strict=True):
            if shot.sign == 1:
                positive = rate
            else:
                yield rate if positive is None else positive - rate, shot.row, shot.column

    @cached_property
    def lighting(self) -> Lighting:
        import numpy as np

        if self.grey:
            levels = self.grey.levels.reshape(len(self.grey.levels), -1)
            _, label = np.unique(levels, axis=1, return_inverse=True)
        else:
            _, row = np.unique(self.left, axis=0, return_inverse=True)
            _, column = np.unique(self.right, axis=0, return_inverse=True)
            label = (row.reshape(-1, 1) * (int(column.max()) + 1) + column.reshape(1, -1)).ravel()
        _, first, sorted_label = np.unique(label, return_index=True, return_inverse=True)
        # Numbered by first appearance, so that shifting dots have one class a shot, in the same order.
        by_appearance = np.argsort(first)
        first, labels = first[by_appearance], np.argsort(by_appearance)[sorted_label.ravel()]
        if self.grey:
            return Lighting(labels, self.grey.light[levels[:, first]])
        i, j, sign = np.array([(shot.row, shot.column, shot.sign) for shot in self.shots]).T
        sign = sign[:, None]
        pattern = self.left[first // self.n][:, i].T * self.right[first % self.n][:, j].T.astype(np.float64)
        return Lighting(labels, np.where(sign == 0, pattern, (1 + sign * pattern) / 2))


# ---- Hadamard matrices ----
#
# Sylvester's doubling, Paley's two constructions over prime fields (R. Paley, 1933), and Kronecker products of these:
# every multiple of 4 up to 48, then gaps.

Way = tuple[Literal["doubled", "skew", "symmetric", "product"], int]
"""Construction of a matrix, and its order, its conference matrix's prime, or the order of its left factor."""


def way_to(order: int) -> Way:
    """Return the construction of the matrix of that ``order``.

    Raises MitsimError for an order without a construction, with the nearest ones.
    """
    way = _way(order)
    if way is None:
        below, above = (next(filter(_way, orders)) for orders in (range(max(order, 1), 0, -1), count(order + 1)))
        raise MitsimError(f"order {order} has no Hadamard matrix; use {below} or {above}")
    return way


def stripe_signs(n: int) -> PatternFactor:
    """Return the (``n``, N) first rows of the smallest Hadamard matrix, for a calibration's stripes."""
    return hadamard_matrix(stripe_count(n))[:n]


def stripe_count(n: int) -> int:
    return next(filter(_way, range(n, 2 * n + 1)))  # a power of two is among them


@cache
def _way(order: int) -> Way | None:
    if order < 1 or (order > 2 and order % 4):
        return None
    if order & (order - 1) == 0:
        return "doubled", order
    if is_prime(order - 1) and (order - 1) % 4 == 3:
        return "skew", order - 1
    half = order // 2
    if is_prime(half - 1) and (half - 1) % 4 == 1:
        return "symmetric", half - 1
    factors = (factor for factor in range(2, half + 1) if order % factor == 0)
    found = next((factor for factor in factors if _way(factor) and _way(order // factor)), None)
    return None if found is None else ("product", found)


def is_prime(value: int) -> bool:
    return value > 1 and all(value % factor for factor in range(2, int(value**0.5) + 1))


def hadamard_matrix(order: int) -> PatternFactor:
    """Return the (``order``, ``order``) matrix H of +-1 with H H^T = order I, first column all ones."""
    import numpy as np

    how, number = way_to(order)
    if how == "product":
        return np.kron(hadamard_matrix(number), hadamard_matrix(order // number))
    if how == "doubled":
        places = np.arange(order)
        matrix = np.where(np.bitwise_count(places[:, None] & places) % 2, -1, 1)
    else:
        # Paley's conference matrix of a prime: skew for 3 mod 4, symmetric for 1 mod 4.
        squares = np.arange(1, number) ** 2 % number
        character = np.where(np.isin(np.arange(number), squares), 1, -1)
        character[0] = 0
        conference = np.zeros((number + 1, number + 1), dtype=np.int64)
        conference[0, 1:], conference[1:, 0] = 1, -1 if how == "skew" else 1
        conference[1:, 1:] = character[(np.arange(number)[:, None] - np.arange(number)) % number]
        eye = np.eye(number + 1, dtype=np.int64)
        if how == "skew":
            matrix = conference + eye
        else:
            matrix = np.kron(conference, [[1, 1], [1, -1]]) + np.kron(eye, [[1, -1], [-1, -1]])
    return (matrix * matrix[:, :1]).astype(np.int8)


# ---- Families ----


@dataclass(frozen=True)
class PatternAxis:
    """One axis of a family's patterns; ``k`` is the number in the family's name, 1 without one."""

    n: int
    k: int
    name: Literal["left", "right"]
    seed: int


@dataclass(frozen=True)
class Family:
    name: str
    forms: tuple[str, ...]
    factor: Callable[[PatternAxis], PatternFactor]
    label: str
    random: bool
    signed: Callable[[int], bool]
    check: Callable[[int], object] | None


FAMILIES: dict[str, Family] = {}
"""Every pattern family by its name."""


def pattern_family(
    *forms: str,
    label: str = "",
    random: bool = False,
    signed: Callable[[int], bool] = lambda k: False,
    check: Callable[[int], object] | None = None,
) -> Callable[[Callable[[PatternAxis], PatternFactor]], Callable[[PatternAxis], PatternFactor]]:
    """Register a function from a :class:`PatternAxis` to its (n, K) factor of 0/1 or +-1 as a pattern family.

    ``forms`` are its names: ``NAME``, or ``NAME:K``, and ``NAME:RxC`` as well where rows and columns may differ.
    ``label`` is the name in reports. ``random`` families take a seed. ``signed`` returns True if patterns of a K take
    the value -1, and ``check`` raises MitsimError for a K that does not exist. A name that is taken raises ValueError.
    """
    name = forms[0].partition(":")[0]
    if name in FAMILIES:
        raise ValueError(f"pattern_family: {name!r} is there already; known are {', '.join(FAMILIES)}")

    def register(factor: Callable[[PatternAxis], PatternFactor]) -> Callable[[PatternAxis], PatternFactor]:
        FAMILIES[name] = Family(name, forms, factor, label or name, random, signed, check)
        return factor

    return register


@pattern_family("uniform")
def uniform(axis: PatternAxis) -> PatternFactor:
    """All pixels lit, in one frame.

    On one ``axis`` a single pattern."""
    import numpy as np

    return np.ones((axis.n, 1), dtype=np.int8)


@pattern_family("dots:K", "dots:RxC")
def shifting_dots(axis: PatternAxis) -> PatternFactor:
    """Every K-th pixel lit, in each frame others.

    Column i lights every K-th pixel of an ``axis`` from i on; their number need not be a multiple of K."""
    import numpy as np

    return np.asarray(np.arange(axis.n)[:, None] % axis.k == np.arange(axis.k)[None, :], dtype=np.int8)


@pattern_family("hadamard:K", "hadamard:K:ORDER", label="Hadamard", signed=lambda k: k > 1, check=way_to)
def repeated_hadamard(axis: PatternAxis) -> PatternFactor:
    """Half of all pixels lit, by a Hadamard matrix.

    The rows of the matrix of order K, repeated down the pixels of an ``axis``; +-1."""
    import numpy as np

    return np.asarray(hadamard_matrix(axis.k)[np.arange(axis.n) % axis.k])


@pattern_family("random:K", random=True)
def random_binary(axis: PatternAxis) -> PatternFactor:
    """Pixels lit by the fall of a coin.

    Each pixel of an ``axis`` is lit by at least one column: the union must cover the scene."""
    import numpy as np

    from mitsim.core.seeds import stream

    rng = stream(axis.seed, "patterns", "random", axis.name)
    bits = rng.integers(0, 2, size=(axis.n, axis.k), dtype=np.int8)
    dark = np.flatnonzero(~bits.any(axis=1))
    bits[dark, rng.integers(0, axis.k, size=dark.size)] = 1
    return bits


# ---- Names of families and own patterns, as requests have them ----


def pattern_names() -> str:
    return f"{', '.join(form for family in FAMILIES.values() for form in family.forms)}, {pattern_files.OWN}"


def is_own(text: str, base: Path = Path()) -> bool:
    """Return True if the patterns ``text`` are a file or a folder, seen from ``base``, not the name of a family."""
    return text.partition(":")[0] not in FAMILIES and pattern_files.looks_like_file(text, base)


def short_name(text: str) -> str:
    """Return the name of patterns for people: that of a family, or of the file."""
    return pattern_files.split_name(text)[0].name if is_own(text) else text


def read_name(text: str, n: int | None = None) -> str:
    """Return the patterns ``text`` as requests have them, for ``n`` projector pixels per side (None: any number).

    Raises MitsimError for an unknown family or Hadamard order, a K that is not a whole number or outside 1..n, and
    files that cannot be read.
    """
    if is_own(text):
        return pattern_files.own_name(text)
    _read_family(text, n)
    return text


def _read_family(text: str, n: int | None = None) -> tuple[Family, list[int], str]:
    """Return the family, its one or two K, and the order of its shots, empty if none is stated."""
    name, colon, size = text.partition(":")
    family, orders = FAMILIES.get(name), list[str]()
    if family and f"{name}:K:ORDER" in family.forms:
        size, *orders = size.split(":", 1)
    form = f"{name}:K" if colon else name
    if family is None or form not in family.forms or bool(colon) != bool(size):
        raise ArgumentError("patterns", f"{text!r}: use {pattern_names()}")
    rows, _, columns = size.partition("x")
    both = [rows, columns] if f"{name}:RxC" in family.forms and rows and columns else [size or "1"]
    most = "the projector's pixels a side" if n is None else str(n)
    periods = []
    for period in both:
        if not (period.isascii() and period.isdigit() and len(period) <= _MOST_DIGITS):
            raise MitsimError(f"patterns {text!r}: K is {period!r}; give a whole number from 1 to {most}")
        k = int(period)
        if k < 1 or (n is not None and k > n):
            more = "" if n is None else ", the projector's pixels a side"
            raise MitsimError(f"patterns {text!r}: K is {k}; give 1 to {most}{more}")
        if family.check is not None and k <= _MOST_CHECKED:
            family.check(k)
        if orders and k & (k - 1):
            raise MitsimError(f"patterns {text!r}: K is {k}, and orders are of powers of 2; use such, or {name}:{k}")
        periods.append(k)
    if orders and orders[0] not in ORDERS:
        raise MitsimError(f"patterns {text!r}: the order is {orders[0]!r}; use {', '.join(ORDERS)}")
    return family, periods, "".join(orders)


def takes_seed(text: str) -> bool:
    name = text.partition(":")[0]
    return name in FAMILIES and FAMILIES[name].random


def shot_count(text: str) -> int:
    family, periods, _ = _read_family(text)
    return periods[0] * periods[-1] * (2 if any(map(family.signed, periods)) else 1)


def parse_patterns(
    text: str, n: int | tuple[int, int], seed: int = 0, light: tuple[float, ...] | None = None
) -> PatternFamily:
    """Return the patterns of a name or file, see :func:`pattern_names`, for ``n`` projector pixels per side.

    ``light`` is that of each grey level (:attr:`mitsim.devices.projector.ProjectorModel.grey_light`), None if it is not
    known. Raises MitsimError as :func:`read_name`, for more shots than a run has, and as
    :func:`mitsim.devices.pattern_files.read_own`.
    """
    from mitsim.core.manifests import MOST_SHOTS  # here: it takes 7 ms to import, and most requests make no patterns

    sides = (n, n) if isinstance(n, int) else n
    if is_own(text):
        own = pattern_files.read_own(text, sides, light)
        return PatternFamily(short_name(text), own.left, own.right, own.grey)
    family, periods, order = _read_family(text, min(sides))
    if (count := shot_count(text)) > MOST_SHOTS:
        raise MitsimError(f"patterns {text!r}: are {count} shots; a run has at most {MOST_SHOTS}, give a smaller K")
    left = family.factor(PatternAxis(sides[0], periods[0], "left", seed))
    return PatternFamily(text, left, family.factor(PatternAxis(sides[1], periods[-1], "right", seed)), order=order)


# ---- Orders in which frames may have been taken ----


def shot_orders(patterns: Patterns, taken: str | None = None) -> dict[str, npt.NDArray[np.int64]]:
    """Return orders in which the frames of a run may have been taken, by name, as permutations p.

    Shot k of ``patterns.captures`` is then frame p[k] of those at hand. ``row-major`` loops over columns inside rows,
    ``column-major`` over rows inside columns. Sylvester's Hadamard patterns also have the :data:`ORDERS`. In signed
    pairs, + precedes - except for ``halves-exchanged`` (- before +), ``plus-first`` (all + before all -) and
    ``minus-first``, which also follow another order, as in ``sequency,plus-first``. Two names may have the same
    permutation. ``taken`` is the order that `mitsim import --order` applied to the frames at hand.
    """
    import numpy as np

    row, column, sign = np.array([(shot.row, shot.column, shot.sign) for shot in patterns.captures]).T
    walks: dict[str, tuple[Labels, ...]] = {"row-major": (row, column), "column-major": (column, row)}
    sizes = [side.shape[1] for side in patterns.matrices]
    squares = [side[:size] for side, size in zip(patterns.matrices, sizes, strict=True)]
    sylvester = all(size & (size - 1) == 0 for size in sizes)
    if sign.any() and sylvester and all(map(np.array_equal, squares, map(hadamard_matrix, sizes))):
        walks |= _walks(sizes, row, column)
    orders = {name: _places(*walk, -sign) for name, walk in walks.items()}
    orders["reversed"] = len(row) - 1 - orders["row-major"]
    for name, walk in walks.items() if sign.any() else ():
        before = "" if name == "row-major" else f"{name},"
        orders[f"{before}halves-exchanged"] = _places(*walk, sign)
        orders[f"{before}plus-first"] = _places(-sign, *walk)
        orders[f"{before}minus-first"] = _places(sign, *walk)
    if taken is None:
        return orders
    frame_of = np.argsort(orders[taken])
    return {name: frame_of[order] for name, order in orders.items()}


def _places(*keys: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the place of each shot when shots are sorted by the ``keys``, the first before the next."""
    import numpy as np

    return np.argsort(np.lexsort(keys[::-1]))


def _walks(sizes: Sequence[int], row: Labels, column: Labels) -> dict[str, tuple[Labels, ...]]:
    """Return the keys by which shots of Sylvester's patterns are sorted, by each of the :data:`ORDERS`."""
    import numpy as np

    counts = [np.count_nonzero(np.diff(hadamard_matrix(size), axis=0), axis=0) for size in sizes]
    changes = np.asarray(counts[0])[row], np.asarray(counts[1])[column]
    # The function with s sign changes is number s ^ (s >> 1), the Gray code of s, in Paley's order.
    dyadic = changes[0] ^ (changes[0] >> 1), changes[1] ^ (changes[1] >> 1)
    # Sign changes cut a pattern like a cake, in rows and columns, into connected blocks (Yu, Sensors 19, 4122, 2019).
    blocks = (changes[0] + 1) * (changes[1] + 1)
    return {"natural": (row, column), "sequency": changes, "dyadic": dyadic, "cake-cutting": (blocks, row, column)}
