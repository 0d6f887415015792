"""The cell grid: edges on the projector's pixels, field stop covered, subdivisions nested."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsim.transport.records import aligned_grid


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
