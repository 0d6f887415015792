"""Orders in which a run's frames may have been taken: permutations, by rules that are counted without them."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import hadamard
from scipy.ndimage import label

from mitsim.core.manifests import Patterns
from mitsim.devices.patterns import ORDERS, Shot, hadamard_matrix, parse_patterns, shot_orders


def _patterns(name: str, n: int = 16) -> Patterns:
    family = parse_patterns(name, n)
    return Patterns.of(family, [f"{index}.exr" for index in range(len(family.shots))])


@pytest.mark.parametrize("name", ["uniform", "dots:4x7", "dots:1x5", "hadamard:1", "hadamard:8", "hadamard:12"])
def test_every_order_is_a_permutation_and_that_of_the_run_is_the_identity(name: str) -> None:
    patterns = _patterns(name)
    orders, count = shot_orders(patterns), len(patterns.captures)
    assert all(np.array_equal(np.sort(each), np.arange(count)) for each in orders.values())
    assert np.array_equal(orders["row-major"], np.arange(count)) and next(iter(orders)) == "row-major"
    pairs, sylvester = name in ("hadamard:8", "hadamard:12"), name == "hadamard:8"
    assert ("plus-first" in orders) == pairs and ("sequency" in orders) == sylvester


@pytest.mark.parametrize("name", ["dots:4x7", "random:3", "hadamard:4"])
def test_frames_in_the_order_of_loops_come_back_in_the_order_of_the_run(name: str) -> None:
    """(Planted: the inverse permutation, which squares of patterns do not show; rows and columns exchanged.)"""
    patterns = _patterns(name)
    rows, columns = (side.shape[1] for side in patterns.matrices)
    signs = (1, -1) if name.startswith("hadamard") else (0,)
    loops = {
        "column-major": [(i, j, s) for j in range(columns) for i in range(rows) for s in signs],
        "reversed": [(i, j, s) for i in range(rows) for j in range(columns) for s in signs][::-1],
        "plus-first": [(i, j, s) for s in signs for i in range(rows) for j in range(columns)],
        "minus-first": [(i, j, s) for s in signs[::-1] for i in range(rows) for j in range(columns)],
        "halves-exchanged": [(i, j, s) for i in range(rows) for j in range(columns) for s in signs[::-1]],
        "column-major,plus-first": [(i, j, s) for s in signs for j in range(columns) for i in range(rows)],
    }
    orders, shots = shot_orders(patterns), [(shot.row, shot.column, shot.sign) for shot in patterns.captures]
    assert set(orders) <= {*loops, "row-major"} or len(signs) == 2
    for order in orders.keys() & loops.keys():
        assert [loops[order][k] for k in orders[order]] == shots, order


def in_order(order: str, k: int) -> list[np.ndarray]:
    """Patterns (k, k) of +-1 in an order, by its definition.

    Natural are the functions of scipy; sequency is the number of sign changes; number p of Paley's functions is the
    product of the square waves that p has bits of; cakes are cut into the fewest connected blocks of one sign first.
    """
    natural = hadamard(k)
    middles, paley = (np.arange(k) + 0.5) / k, []
    for p in range(k):
        waves = [np.sign(np.sin(2 * np.pi * 2**bit * middles)) for bit in range(8) if p >> bit & 1]
        paley.append(np.prod([np.ones(k), *waves], axis=0))
    walsh = sorted(natural, key=lambda function: sum(a != b for a, b in pairwise(function.tolist())))
    series = {"sequency": walsh, "dyadic": paley}.get(order, natural)
    patterns = [np.outer(left, right) for left in series for right in series]
    if order == "cake-cutting":
        patterns.sort(key=lambda pattern: label(pattern > 0)[1] + label(pattern < 0)[1])
    return patterns


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("k", [2, 8, 16])
def test_the_orders_of_hadamard_patterns_are_those_of_their_definitions(k: int, order: str) -> None:
    """Of frames that are imported, and of a family by its name, + before - in each pair.

    (Planted: s and s ^ (s >> 2) in place of the Gray code; natural order in place of sequency; changes added in place
    of multiplied blocks; ties of blocks by column; - before +.)
    """
    patterns, matrix = _patterns(f"hadamard:{k}"), hadamard_matrix(k)
    taken = [patterns.captures[shot] for shot in np.argsort(shot_orders(patterns)[order])]
    named = parse_patterns(f"hadamard:{k}:{order}", 16).shots
    assert named == tuple(Shot(each.row, each.column, each.sign) for each in taken)
    assert {shot.sign for shot in named[::2]} == {1} and {shot.sign for shot in named[1::2]} == {-1}
    shown = [np.outer(matrix[:, shot.row], matrix[:, shot.column]) for shot in named[::2]]
    assert np.array_equal(shown, in_order(order, k))


def test_an_order_after_another_is_of_the_cameras_frames() -> None:
    """A run that was read as column-major in error has its row-major frames at the places that it put them to."""
    patterns = _patterns("dots:4x7")
    camera = shot_orders(patterns)
    again = shot_orders(patterns, "column-major")
    run = camera["column-major"]  # the camera's frame in each place of the run
    for name, order in again.items():
        assert np.array_equal(run[order], camera[name]), name
    assert np.array_equal(again["column-major"], np.arange(28))
