"""Pattern families: what is projected, what the solver is told, and what the light is sorted into are one thing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsim.core.errors import MitsimError
from mitsim.devices.hadamard import hadamard_orders
from mitsim.devices.patterns import Lighting, hadamard_matrix, parse_patterns

FAMILIES = [
    "uniform",
    "dots:1",
    "dots:3",
    "dots:5",
    "dots:16",
    "dots:3x5",
    "dots:16x1",
    "hadamard:1",
    "hadamard:4",
    "hadamard:12",
    "random:5",
]


@pytest.mark.parametrize("n", [16, 23])
@pytest.mark.parametrize("name", FAMILIES)
def test_captures_add_up_to_the_patterns_that_the_solver_is_told(name: str, n: int) -> None:
    family = parse_patterns(name, n)
    measured: dict[tuple[int, int], np.ndarray] = {}
    for capture in family.shots:
        light = family.light(capture)
        assert light.shape == (n, n)
        assert np.isin(light, (0, 1)).all(), "a projector shows no other light than these families use"
        part = light if capture.sign == 0 else capture.sign * light
        measured[capture.row, capture.column] = measured.get((capture.row, capture.column), 0) + part
    assert len(measured) == family.left.shape[1] * family.right.shape[1]
    for (i, j), pattern in measured.items():
        assert np.array_equal(pattern, np.outer(family.left[:, i], family.right[:, j]))


@pytest.mark.parametrize("name", FAMILIES)
def test_number_of_captures(name: str) -> None:
    family = parse_patterns(name, 16)
    rows, cross, columns = name.partition(":")[2].partition("x")
    k = int(rows or 1)
    count = k * int(columns) if cross else k**2
    # hadamard:1 is all ones, so it needs no second half.
    halves = 2 if name.startswith("hadamard") and k > 1 else 1
    assert len(family.shots) == halves * count
    assert len({capture.names for capture in family.shots}) == halves * count, "streams would be shared"


@pytest.mark.parametrize("n", [16, 23])
@pytest.mark.parametrize("name", FAMILIES)
def test_classes_weigh_every_pixel_as_light_does(name: str, n: int) -> None:
    family = parse_patterns(name, n)
    labels, weights = family.lighting.labels, family.lighting.weights
    assert labels.shape == (n * n,) and weights.shape[0] == len(family.shots)
    assert np.array_equal(np.unique(labels), np.arange(weights.shape[1])), "a class without pixels"
    for capture, row in zip(family.shots, weights, strict=True):
        assert np.array_equal(row[labels], family.light(capture).ravel())


@settings(max_examples=25, deadline=None)
@given(n=st.integers(1, 40), data=st.data())
def test_dots_light_every_pixel_exactly_once(n: int, data: st.DataObject) -> None:
    rows, columns = data.draw(st.integers(1, n)), data.draw(st.integers(1, n))
    family = parse_patterns(f"dots:{rows}x{columns}", n)
    assert np.array_equal(sum(family.light(capture) for capture in family.shots), np.ones((n, n)))
    labels, weights = family.lighting.labels, family.lighting.weights
    assert weights.shape == (rows * columns, rows * columns)
    assert np.array_equal(weights.sum(axis=0), np.ones(rows * columns)), "each class belongs to one pattern"
    assert len(np.unique(labels)) == rows * columns


def test_uniform_lighting_is_the_uniform_familys() -> None:
    family, uniform = parse_patterns("uniform", 7), Lighting.uniform(7)
    assert family.lighting is family.lighting, "found once"
    assert np.array_equal(family.lighting.labels, uniform.labels)
    assert np.array_equal(family.lighting.weights, uniform.weights)


def test_dots_are_the_papers_grid_of_every_kth_pixel() -> None:
    family = parse_patterns("dots:3", 8)
    lit = family.light(next(c for c in family.shots if (c.row, c.column) == (1, 2)))
    assert np.array_equal(np.argwhere(lit), [(r, c) for r in (1, 4, 7) for c in (2, 5)])


def test_dots_of_two_periods_repeat_each_along_its_own_axis() -> None:
    family = parse_patterns("dots:3x2", 7)
    lit = family.light(next(c for c in family.shots if (c.row, c.column) == (1, 1)))
    assert np.array_equal(np.argwhere(lit), [(r, c) for r in (1, 4) for c in (1, 3, 5)])
    both, one = parse_patterns("dots:3x3", 7), parse_patterns("dots:3", 7)
    assert both.shots == one.shots
    assert np.array_equal(both.left, one.left) and np.array_equal(both.right, one.right)
    assert np.array_equal(both.lighting.labels, one.lighting.labels)


def test_hadamard_repeats_its_matrix_and_the_halves_complement() -> None:
    family = parse_patterns("hadamard:4", 10)
    assert family.signed
    assert np.array_equal(family.left[4:8], family.left[:4]) and np.array_equal(family.left[8:], family.left[:2])
    first, second = family.shots[6:8]
    assert (first.row, first.column) == (second.row, second.column) and (first.sign, second.sign) == (1, -1)
    assert np.array_equal(family.light(first) + family.light(second), np.ones((10, 10)))


@pytest.mark.parametrize("order", hadamard_orders(68))
def test_hadamard_matrices_are_hadamard(order: int) -> None:
    matrix = hadamard_matrix(order).astype(int)
    assert np.isin(matrix, (-1, 1)).all()
    assert np.array_equal(matrix @ matrix.T, order * np.eye(order, dtype=int))
    assert (matrix[:, 0] == 1).all(), "the uniform pattern has to be among them"


def test_hadamard_orders_reach_every_multiple_of_four_up_to_48() -> None:
    assert hadamard_orders(48) == [1, 2, *range(4, 49, 4)]


def test_a_missing_hadamard_order_names_its_neighbours() -> None:
    with pytest.raises(MitsimError, match=r"order 52 .* use 48 or 56"):
        hadamard_matrix(52)


def test_random_is_seeded_and_covers_every_pixel() -> None:
    # With k = 2 a quarter of the rows would be dark by chance: the cover must be made, not hoped for.
    family = parse_patterns("random:2", 64, seed=3)
    assert family.left.any(axis=1).all() and family.right.any(axis=1).all()
    assert sum(family.light(c) for c in family.shots).min() >= 1
    again, other = parse_patterns("random:2", 64, seed=3), parse_patterns("random:2", 64, seed=4)
    assert np.array_equal(family.left, again.left) and np.array_equal(family.right, again.right)
    assert not np.array_equal(family.left, other.left)
    assert not np.array_equal(family.left, family.right), "rows and columns need streams of their own"


def test_random_is_a_fair_coin() -> None:
    bits = parse_patterns("random:40", 500, seed=1).left
    # 20 000 flips: standard deviation 0.0035; five of them. (Forced pixels: 500 x 2^-40, none.)
    assert abs(bits.mean() - 0.5) < 0.018


@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        ("dots:17", "1 to 16"),
        ("dots:0", "1 to 16"),
        ("dots:-1", "whole number"),
        ("dots:2.5", "whole number"),
        ("dots:\u0667", "whole number"),
        ("dots:\u00b2", "whole number"),
        ("dots: 3", "whole number"),
        ("dots:x", "whole number"),
        ("dots:7x", "whole number"),
        ("dots:x7", "whole number"),
        ("dots:7x14x3", "whole number"),
        ("dots:7X14", "whole number"),
        ("dots:4x17", "1 to 16"),
        ("dots:0x4", "1 to 16"),
        ("hadamard:4x4", "whole number"),
        ("dots", "use uniform"),
        ("dots:", "use uniform"),
        ("uniform:2", "use uniform"),
        ("stripes:4", "use uniform"),
        ("", "use uniform"),
        ("Dots:4", "use uniform"),
        ("hadamard:3", "use 2 or 4"),
        ("hadamard:32", "1 to 16"),
        ("random:999", "1 to 16"),
    ],
)
def test_refusals_are_one_line_that_names_the_value(text: str, fragment: str) -> None:
    with pytest.raises(MitsimError, match=fragment) as caught:
        parse_patterns(text, 16)
    message = str(caught.value)
    assert "\n" not in message
    # Which Hadamard matrices there are is told by what knows orders alone.
    assert repr(text) in message or (text == "hadamard:3" and "order 3 " in message)
