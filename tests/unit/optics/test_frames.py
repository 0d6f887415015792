"""Frames in closed form against an integral over mask, window and pixel done by Gauss quadrature; layers; probes."""

from functools import cache
from itertools import pairwise, product

import numpy as np
import pytest

from mitsim.devices.mask import Mask
from mitsim.optics.image_formation import anchor_positions, anchor_weights
from mitsim.optics.shadow import Directions
from mitsim.optics.terms import shadow_terms
from tests.unit.optics.small_camera import CAMERA, WINDOW, Z, cell_optics


@pytest.mark.parametrize("count", [1, 2, 3, 6])
def test_anchors_are_chebyshev_s_nodes_in_rising_order(count: int) -> None:
    np.testing.assert_allclose(
        anchor_positions(count, 1.5), 1.5 * np.polynomial.chebyshev.chebpts1(count), rtol=0, atol=1e-15
    )


@pytest.mark.parametrize("count", [1, 2, 5])
def test_interpolation_is_exact_for_polynomials_of_one_degree_less_than_anchors(count: int) -> None:
    anchors, at = anchor_positions(count, 2.0), np.linspace(-2.2, 2.2, 9)
    polynomial = np.polynomial.Polynomial(np.arange(1, count + 1))
    weights = anchor_weights(anchors, at)
    assert weights.shape == (9, count)
    np.testing.assert_allclose(weights @ polynomial(anchors), polynomial(at), rtol=1e-12)
    np.testing.assert_allclose(anchor_weights(anchors, anchors), np.eye(count), atol=1e-14)


# -------- frames

ROWS, COLUMNS = np.array([0, 9, 31, 48, 70, 95]), np.array([2, 20, 40, 57, 88, 95])
"""Sensor pixels that are compared: quadrature for all would take long."""


def nodes(breaks: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre points and weights on each interval between sorted ``breaks``."""
    x, w = np.polynomial.legendre.leggauss(order)
    half = np.diff(breaks)[:, None] / 2
    middle = (breaks[:-1] + breaks[1:])[:, None] / 2
    return (middle + half * x).ravel(), (half * w).ravel()


def crossing_terms(mask: Mask, u: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """tau points and weights that break where a ray from u meets a feature's edge, and where it crosses the mask."""
    d = CAMERA.mask_distance
    edges = (np.arange(len(mask.bits) + 1) - len(mask.bits) / 2) * mask.feature_mm
    breaks = (edges - u * (1 - d / Z)) / d
    inside = breaks[(breaks > WINDOW[0]) & (breaks < WINDOW[1])]
    tau, weight = nodes(np.concatenate(([WINDOW[0]], inside, [WINDOW[1]])), 6)
    return tau, weight, u * (1 - d / Z) + d * tau


@cache
def by_quadrature(kind: str) -> np.ndarray:
    """Irradiance on ROWS x COLUMNS for radiance 1 from the window: mean over a pixel of the integral of
    M (1 + |tau - u/z|^2)^-2 dtau.

    Four Gauss points on each piece of a pixel between the kinks that the window's edges make as they pass features:
    good to 1e-7.
    """
    mask, d = CAMERA.model_copy(update={"mask": kind}).build_mask(), CAMERA.mask_distance
    edges = (np.arange(8) - 3.5) * mask.feature_mm
    kinks = ((edges[:, None] - d * np.array(WINDOW)) / (1 - d / Z)).ravel()
    chosen = {}
    for pixel in {*ROWS, *COLUMNS}:
        low, high = CAMERA.pixel_edges[pixel : pixel + 2]
        inside = np.sort(kinks[(kinks > low) & (kinks < high)])
        u, weight = nodes(np.concatenate(([low], inside, [high])), 4)
        points = zip(u, weight / (high - low), strict=True)
        chosen[pixel] = [(share, point, *crossing_terms(mask, point)) for point, share in points]
    frame = np.zeros((len(ROWS), len(COLUMNS)))
    for (i, row), (j, column) in product(enumerate(ROWS), enumerate(COLUMNS)):
        for (share_r, u_r, tau_r, dtau_r, s_r), (share_c, u_c, tau_c, dtau_c, s_c) in product(
            chosen[row], chosen[column]
        ):
            squared = np.square(tau_r - u_r / Z)[:, None] + np.square(tau_c - u_c / Z)[None, :]
            seen = mask.transmission(s_r[:, None], s_c[None, :]) * (1 + squared) ** -2
            frame[i, j] += share_r * share_c * (dtau_r @ seen @ dtau_c)
    return frame


def board_light(edges: np.ndarray, anchors: int) -> tuple[np.ndarray, np.ndarray]:
    """Flat index and light of a board of radiance 1: integral over each cell of the falloff seen from each anchor."""
    tau, weight = nodes(edges, 5)
    cells = len(edges) - 1
    positions = anchor_positions(anchors, CAMERA.half_width)
    light = np.empty((anchors, cells, anchors, cells))
    for a, row in enumerate(positions):
        for b, column in enumerate(positions):
            squared = np.square(tau - row / Z)[:, None] + np.square(tau - column / Z)[None, :]
            value = np.outer(weight, weight) * (1 + squared) ** -2
            light[a, :, b, :] = value.reshape(cells, 5, cells, 5).sum(axis=(1, 3))
    return np.arange(light.size), light.ravel()


def factored(kind: str, cells: int, anchors: int) -> np.ndarray:
    edges = np.linspace(*WINDOW, cells + 1)
    optics = cell_optics(CAMERA.model_copy(update={"mask": kind}), edges, edges, anchors)
    return optics.frame(*board_light(edges, anchors))[np.ix_(ROWS, COLUMNS)]


def error(kind: str, cells: int, anchors: int) -> float:
    truth = by_quadrature(kind)
    return float(np.linalg.norm(factored(kind, cells, anchors) - truth) / np.linalg.norm(truth))


@pytest.mark.parametrize("kind", ["separable", "flatcam", "open"])
def test_a_lambertian_board_through_the_mask(kind: str) -> None:
    # 96 cells and 4 anchors leave what 192 cells halve twice: 1e-5; a 1 % error would be 500 times the gate.
    assert error(kind, 96, 4) < 2e-5


def test_cells_converge_at_least_with_the_square_of_their_size() -> None:
    found = [error("separable", cells, 5) for cells in (6, 12, 24)]
    assert found[0] > 1e-4
    for coarse, fine in pairwise(found):
        assert coarse / fine > 3


def test_orientation_of_rows_and_columns() -> None:
    """Light in one cell: its shadow is the outer product of the two factors, rows by rows."""
    rows, columns = np.linspace(-0.2, 0.2, 5), np.linspace(-0.1, 0.3, 8)
    optics = cell_optics(CAMERA, rows, columns)
    ((left, right),) = shadow_terms(CAMERA, Directions.cells(rows), Directions.cells(columns), Z)
    frame = optics.frame(np.array([3 * 7 + 1]), np.array([2.0]))
    assert np.allclose(frame, 2 * np.outer(left[:, 3], right[:, 1]), rtol=1e-14)
    assert not np.allclose(frame, frame.T)


@pytest.mark.parametrize("lit", ["few rows", "few columns"])
def test_both_orders_of_the_product_agree_with_the_dense_one(lit: str) -> None:
    rng = np.random.default_rng(1)
    rows, columns = np.linspace(-0.2, 0.2, 13), np.linspace(-0.2, 0.2, 16)
    optics = cell_optics(CAMERA.model_copy(update={"mask": "flatcam"}), rows, columns)
    light = np.zeros((12, 15))
    place = (slice(2, 4), slice(None)) if lit == "few rows" else (slice(None), slice(7, 9))
    light[place] = rng.random(light[place].shape)
    flat = np.flatnonzero(light)
    terms = shadow_terms(
        CAMERA.model_copy(update={"mask": "flatcam"}), Directions.cells(rows), Directions.cells(columns), Z
    )
    dense = sum(left @ light @ right.T for left, right in terms)
    assert np.allclose(optics.frame(flat, light.ravel()[flat]), dense, rtol=1e-12)


# ---- layers
