"""Orders in which a run's frames may have been taken: permutations, by rules that are counted without them."""

from itertools import pairwise

import numpy as np
import pytest

from mitsim.core.manifests import Patterns
from mitsim.devices.patterns import hadamard_matrix, parse_patterns, shot_orders


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


@pytest.mark.parametrize("k", [2, 8, 16])
def test_sequency_counts_sign_changes_and_dyadic_multiplies_rademacher_functions(k: int) -> None:
    """Walsh's order is that of sign changes; number p of Paley's is the product of the square waves that p has bits of.

    (Planted: s and s ^ (s >> 2) in place of the Gray code; natural order in place of sequency.)
    """
    patterns, matrix = _patterns(f"hadamard:{k}"), hadamard_matrix(k)
    orders, shots = shot_orders(patterns), patterns.captures
    changes = [sum(a != b for a, b in pairwise(column)) for column in matrix.T.tolist()]
    middles = (np.arange(k) + 0.5) / k
    paley = []
    for p in range(k):
        waves = [np.sign(np.sin(2 * np.pi * 2**bit * middles)) for bit in range(8) if p >> bit & 1]
        paley.append(np.prod([np.ones(k), *waves], axis=0))
    for order, series in (("sequency", matrix[:, np.argsort(changes)].T), ("dyadic", np.array(paley))):
        taken = np.argsort(orders[order])  # the shot of each frame
        shown = [np.outer(matrix[:, shots[shot].row], matrix[:, shots[shot].column]) for shot in taken[::2]]
        assert np.array_equal(shown, [np.outer(left, right) for left in series for right in series]), order


def test_an_order_after_another_is_of_the_cameras_frames() -> None:
    """A run that was read as column-major in error has its row-major frames at the places that it put them to."""
    patterns = _patterns("dots:4x7")
    camera = shot_orders(patterns)
    again = shot_orders(patterns, "column-major")
    run = camera["column-major"]  # the camera's frame in each place of the run
    for name, order in again.items():
        assert np.array_equal(run[order], camera[name]), name
    assert np.array_equal(again["column-major"], np.arange(28))
