"""Paths to light per cell: nothing lost, nothing moved, kinds and layers kept apart."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsim.core.environment import device_array
from mitsim.transport.records import (
    AMBIENT,
    DIRECT,
    Bundle,
    CellAxis,
    CellGrid,
    DeviceAccumulator,
    PathSamples,
    Sightings,
    aligned_grid,
)


@settings(max_examples=60, deadline=None)
@given(
    low=st.floats(-0.4, 0.2),
    width=st.floats(0.05, 0.6),
    n=st.integers(1, 40),
    subdivision=st.sampled_from([1, 2, 4]),
    stop=st.floats(0.05, 0.5),
)
def test_edges_fall_on_pixels_and_cover_window_and_stop(
    low: float, width: float, n: int, subdivision: int, stop: float
) -> None:
    grid = aligned_grid((low, low + width), (-0.1, 0.2), n, subdivision, stop)
    edges = grid.rows.edges
    assert len(edges) == grid.shape[0] + 1
    step = width / n / subdivision
    assert np.allclose(np.diff(edges), step)
    place = (np.linspace(low, low + width, n + 1)[:, None] - edges[None, :]) / step
    assert np.abs(place).min(axis=1).max() < 1e-6, "a projector pixel's edge inside a cell"
    assert edges[0] <= min(low, -stop) + 1e-6 * step and edges[-1] >= max(low + width, stop) - 1e-6 * step
    # Not more than one projector pixel of margin beyond what is needed.
    pixel = step * subdivision * 1.001
    assert edges[0] > min(low, -stop) - pixel and edges[-1] < max(low + width, stop) + pixel


@settings(max_examples=30, deadline=None)
@given(n=st.integers(1, 40), shift=st.floats(-0.1, 0.1))
def test_grids_nest(n: int, shift: float) -> None:
    window = (-0.15 + shift, 0.15 + shift)
    fine = aligned_grid(window, window, n, 4, 0.17)
    coarse = aligned_grid(window, window, n, 1, 0.17)
    assert np.allclose(fine.rows.edges[::4], coarse.rows.edges)
    assert fine.shape[0] == 4 * coarse.shape[0]


# -------- histogram

PIXELS = 9  # a projector of 3 x 3
GRID = CellGrid(CellAxis(-0.2, 0.05, 8), CellAxis(-0.1, 0.02, 15))
DEPTHS = (500.0, 300.0, 250.0)


def path_samples(count: int = 400, seed: int = 3, inside: bool = True) -> PathSamples:
    """Light from everywhere to everywhere: two anchors a side, all pixels and ambient light."""
    rng = np.random.default_rng(seed)
    pixel = rng.integers(0, PIXELS + 1, count)
    low, high = ((-0.2, 0.2), (-0.1, 0.2)) if inside else ((-0.4, 0.4), (-0.3, 0.5))
    row, column = rng.uniform(*low, count), rng.uniform(*high, count)
    if not inside:
        row, column = rng.uniform(-0.4, 0.4, count), rng.uniform(-0.3, 0.5, count)
    return PathSamples(
        pixel=pixel,
        anchor_row=rng.integers(0, 2, count),
        anchor_column=rng.integers(0, 2, count),
        row=row,
        column=column,
        inverse_depth=1 / rng.uniform(240, 520, count),
        value=rng.uniform(0.5, 2, count),
        kind=np.where(pixel == PIXELS, AMBIENT, DIRECT).astype(np.int16),
    )


def one(row: float, column: float, **changes: object) -> PathSamples:
    """One path of value 1."""
    values = {"pixel": 0, "anchor_row": 0, "anchor_column": 0, "row": row, "column": column}
    values |= {"inverse_depth": 1 / 400, "value": 1.0, "kind": 1, **changes}
    kinds = {"row": float, "column": float, "inverse_depth": float, "value": float, "kind": np.int16}
    return PathSamples(**{name: np.array([value], dtype=kinds.get(name, np.int64)) for name, value in values.items()})


def bundle(depths: tuple[float, ...] = (400.0,), anchors: int = 2) -> Bundle:
    return Bundle(GRID, anchors, depths)


def unpacked(made: Bundle, light: np.ndarray) -> np.ndarray:
    """(rows, layers, anchors, y, anchors, x)"""
    shape = (len(made.depths), made.anchors, made.cells[0], made.anchors, made.cells[1])
    return np.asarray(light).reshape(-1, *shape)


def test_chosen_light_keeps_what_is_told_of_each_line() -> None:
    """(Planted: lines left out.)"""
    found = replace(path_samples(), lines=np.random.default_rng(5).random((4, 400)).astype(np.float32))
    for chosen in (slice(20, 50), found.pixel == 3):
        some = found.where(chosen)
        assert some.lines is not None and np.array_equal(some.lines, found.lines[:, chosen])  # type: ignore[index]


LABELS = np.array([0, 1, 2, 0, 1, 2, 0, 1, 2])
WAYS = ((400.0,), DEPTHS)


@pytest.mark.parametrize("depths", WAYS)
def test_all_light_is_accumulated_and_under_its_own_row(depths: tuple[float, ...]) -> None:
    made, found = bundle(depths), path_samples()
    light = made.accumulate(found, LABELS, samples=4)
    assert light.shape == (4, made.size)
    lines = np.append(LABELS, 3)[found.pixel]
    assert np.asarray(light.sum(axis=1)).ravel() == pytest.approx(np.bincount(lines, found.value) / 4, rel=1e-12)


def test_an_even_cell_holds_the_light_that_falls_in_it() -> None:
    made = bundle(anchors=1)
    light = unpacked(made, made.accumulate(one(-0.2 + 2.99 * 0.05, -0.1 + 7.01 * 0.02), LABELS).toarray())[
        0, 0, 0, :, 0
    ]
    assert light[2, 7] == 1 and light.sum() == 1
    assert made.cells == GRID.shape


@pytest.mark.parametrize("depth", [480.0, 300.0, 260.0])
def test_layers_keep_the_mean_inverse_depth(depth: float) -> None:
    """Split in 1/z, in which the shadow is nearly linear: between the two layers around it and no other."""
    made = bundle(DEPTHS, anchors=1)
    light = unpacked(made, made.accumulate(one(0.0, 0.0, inverse_depth=1 / depth), LABELS).toarray()).sum(
        axis=(0, 2, 3, 4, 5)
    )
    assert light.sum() == pytest.approx(1) and light @ (1 / np.array(DEPTHS)) == pytest.approx(1 / depth)
    distance = [abs(1 / layer - 1 / depth) for layer in DEPTHS]
    assert set(np.flatnonzero(light > 1e-9)) <= set(np.argsort(distance)[:2])


@pytest.mark.parametrize("depths", WAYS)
def test_accumulated_light_averaged_over_the_anchors(depths: tuple[float, ...]) -> None:
    """Averaged before it is accumulated or after, light is the same."""
    found, weights, made = path_samples(), np.array([0.7, 0.3]), bundle(depths)
    before = bundle(depths, anchors=1).accumulate(found.average(weights), LABELS).toarray()
    assert np.allclose(made.average(made.accumulate(found, LABELS), weights).toarray(), before, rtol=1e-12, atol=0)


@pytest.mark.parametrize("depths", WAYS)
def test_light_of_one_anchor_repeated_for_all(depths: tuple[float, ...]) -> None:
    made, single = bundle(depths), bundle(depths, anchors=1)
    light = single.accumulate(path_samples().average(np.array([0.5, 0.5])), LABELS)
    shown, one = unpacked(made, made.repeat(light).toarray()), unpacked(single, light.toarray())
    for a, b in np.ndindex(2, 2):
        assert np.array_equal(shown[:, :, a, :, b], one[:, :, 0, :, 0])


@pytest.mark.usefixtures("variant")
def test_small_light_beside_great_light_is_counted() -> None:
    """4096 paths of 1 beside one of 2^24, where float32 has steps of 2: what is fetched and accumulated is exact."""
    light = np.ones(4097, np.float32)
    light[0] = 2.0**24
    assert np.add.accumulate(light)[-1] == 2.0**24, "float32 loses all of it"
    zeros, depth = [dr.zeros(mi.Float, 4097) for _ in range(2)], dr.full(mi.Float, 1 / 400, 4097)
    seen = Sightings(device_array(mi.Float, light), dr.zeros(mi.UInt32, 4097), *zeros, depth)
    fetched, alone = PathSamples.fetch(seen, DIRECT), bundle(anchors=1)
    assert fetched.value.dtype == np.float64 and fetched.value.sum() == 2.0**24 + 4096
    assert alone.accumulate(fetched, LABELS).sum() == 2.0**24 + 4096
    accumulator = DeviceAccumulator(alone, LABELS, one=2.0**24)
    accumulator.add([seen.value], seen.pixel, accumulator.place(seen, mi.Float(0.5)))
    assert accumulator.fetch()[0].light()[1] == 2.0**24 + 4096
