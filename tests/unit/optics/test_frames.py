"""Frames in closed form against an integral over mask, window and pixel done by Gauss quadrature; their variance.

The camera here is small and the board near (40 mm), so that the falloff across the sensor is a few percent and every
discretisation has something to get wrong.
"""

from functools import cache
from itertools import pairwise, product

import numpy as np
import pytest
from scipy import sparse

from mitsim.optics.camera import CameraGeometry, anchor_positions
from mitsim.optics.frames import ExpectedFrames, FrameOptics, relative_error
from mitsim.optics.mask import Mask
from mitsim.optics.shadow import Directions

Z, WINDOW = 40.0, (-0.13, 0.17)
CAMERA = CameraGeometry(
    pixels=96, pixel_pitch=6 / 96, mask="separable", mask_order=3, mask_feature=1.5, scene_distance=Z
)
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
    optics = FrameOptics(CAMERA.model_copy(update={"mask": kind}), edges, edges, Z, anchors)
    return optics.frame(*board_light(edges, anchors))[np.ix_(ROWS, COLUMNS)]


def error(kind: str, cells: int, anchors: int) -> float:
    truth = by_quadrature(kind)
    return float(np.linalg.norm(factored(kind, cells, anchors) - truth) / np.linalg.norm(truth))


@pytest.mark.parametrize("kind", ["separable", "flatcam", "open"])
def test_a_lambertian_board_through_the_mask(kind: str) -> None:
    # 96 cells and 4 anchors leave what 192 cells halve twice: 1e-5; a 1 % error would be 500 times the gate.
    assert error(kind, 96, 4) < 2e-5


def test_anchors_converge() -> None:
    found = [error("separable", 192, anchors) for anchors in (1, 2, 3)]
    assert found[0] > 5e-3, "this geometry has to need anchors"
    assert found[1] < found[0] / 3 and found[2] < found[1] / 5


def test_cells_converge_at_least_with_the_square_of_their_size() -> None:
    found = [error("separable", cells, 5) for cells in (6, 12, 24)]
    assert found[0] > 1e-4
    for coarse, fine in pairwise(found):
        assert coarse / fine > 3


def test_orientation_of_rows_and_columns() -> None:
    """Light in one cell: its shadow is the outer product of the two factors, rows by rows."""
    rows, columns = np.linspace(-0.2, 0.2, 5), np.linspace(-0.1, 0.3, 8)
    optics = FrameOptics(CAMERA, rows, columns, Z, 1)
    ((left, right),) = CAMERA.shadow_terms(Directions.cells(rows), Directions.cells(columns), Z)
    frame = optics.frame(np.array([3 * 7 + 1]), np.array([2.0]))
    assert np.allclose(frame, 2 * np.outer(left[:, 3], right[:, 1]), rtol=1e-14)
    assert not np.allclose(frame, frame.T)


@pytest.mark.parametrize("lit", ["few rows", "few columns"])
def test_both_orders_of_the_product_agree_with_the_dense_one(lit: str) -> None:
    rng = np.random.default_rng(1)
    rows, columns = np.linspace(-0.2, 0.2, 13), np.linspace(-0.2, 0.2, 16)
    optics = FrameOptics(CAMERA.model_copy(update={"mask": "flatcam"}), rows, columns, Z, 1)
    light = np.zeros((12, 15))
    place = (slice(2, 4), slice(None)) if lit == "few rows" else (slice(None), slice(7, 9))
    light[place] = rng.random(light[place].shape)
    flat = np.flatnonzero(light)
    terms = CAMERA.model_copy(update={"mask": "flatcam"}).shadow_terms(
        Directions.cells(rows), Directions.cells(columns), Z
    )
    dense = sum(left @ light @ right.T for left, right in terms)
    assert np.allclose(optics.frame(flat, light.ravel()[flat]), dense, rtol=1e-12)


def test_no_light_is_a_black_frame() -> None:
    edges = np.linspace(*WINDOW, 5)
    optics = FrameOptics(CAMERA, edges, edges, Z, 1)
    assert not optics.frame(np.empty(0, np.int64), np.empty(0)).any()


def test_total_is_the_open_irradiance() -> None:
    edges = np.linspace(*WINDOW, 9)
    optics = FrameOptics(CAMERA.model_copy(update={"mask": "open", "mask_feature": 6.0}), edges, edges, Z, 3)
    flat, light = board_light(edges, 3)
    frame = optics.frame(flat, light)
    assert optics.total(sparse.csr_array(light[None, :])) == pytest.approx([frame.mean()], rel=1e-12)


# ---- families of frames


PIXELS, CELLS = 16, 10


def random_groups(count: int, seed: int, spread: float = 1.0) -> list[sparse.csr_array]:
    """Independent estimates of one light (16 pixels, 10 x 10 cells): mean 1 on a third of the entries."""
    fixed = np.random.default_rng(99).random((PIXELS, CELLS**2)) < 0.3
    rng = np.random.default_rng(seed)
    return [sparse.csr_array(fixed * (1 + spread * rng.standard_normal(fixed.shape))) for _ in range(count)]


def small_optics(pixels: int = 40) -> FrameOptics:
    edges = np.linspace(*WINDOW, CELLS + 1)
    # Features three times smaller than a cell's shadow: the cells look different to the sensor.
    fine = {"pixels": pixels, "pixel_pitch": 6.0 / pixels, "mask_order": 9, "mask_feature": 0.02}
    camera = CAMERA.model_copy(update=fine)
    return FrameOptics(camera, edges, edges, Z, 1)


LABELS = np.arange(PIXELS) % 4
FAMILIES = {
    "identity": np.eye(4),
    "permuted": np.eye(4)[::-1],
    "mixing": np.vstack(
        [np.ones(4), 0.5 + 0.5 * np.array([[1, 1, 1, 1], [1, -1, 1, -1], [1, 1, -1, -1], [0, 1, 0.3, 1]])]
    ),
}


@pytest.mark.parametrize("family", FAMILIES)
def test_mixing_classes_equals_weighing_every_pixel(family: str) -> None:
    weights, groups = FAMILIES[family], random_groups(3, 7, spread=0.1)
    optics = small_optics()
    mixed = list(ExpectedFrames(optics, groups, LABELS, weights, 5))
    # Sixteen classes are more than the captures, so these frames are formed one by one.
    direct = list(ExpectedFrames(optics, groups, np.arange(PIXELS), weights[:, LABELS], 5))
    assert len(mixed) == len(direct) == len(weights)
    mean = sum(groups[1:], groups[0]) / 3
    for one, other, row in zip(mixed, direct, weights, strict=True):
        plain = optics.frame(np.arange(CELLS**2), np.asarray(row[LABELS] @ mean.toarray()))
        scale = np.abs(plain).max()
        assert np.abs(one.irradiance - plain).max() < 1e-12 * scale
        assert np.abs(other.irradiance - plain).max() < 1e-12 * scale
        assert one.variance == pytest.approx(other.variance, rel=1e-9)


def test_more_frames_than_one_block() -> None:
    weights = np.random.default_rng(2).random((70, 4))
    expected = ExpectedFrames(small_optics(8), random_groups(2, 3, 0.1), LABELS, weights, 0)
    frames = [frame.irradiance for frame in expected]
    assert len(frames) == len(expected) == 70
    again = [frame.irradiance for frame in expected]
    assert all(np.array_equal(a, b) for a, b in zip(frames, again, strict=True)), "iterable as often as needed"
    # Linear: frame 69 is the same mix of the first four as its weights are.
    mix = np.linalg.solve(weights[:4].T, weights[69])
    assert np.allclose(frames[69], np.tensordot(mix, np.stack(frames[:4]), axes=1), rtol=1e-9)


SEEDS = 300


@pytest.mark.parametrize("groups", [2, 4])
def test_the_predicted_variance_is_the_actual_one(groups: int) -> None:
    """Squared error / predicted variance over 300 seeds is 1 within five of its own standard deviations.

    Sixteen frames with independent noise make the mean over the seeds good to 4 %; a divisor G^2 in place of
    G (G - 1) would be wrong by 1/2 and 1/4.
    """
    optics, weights, labels = small_optics(), np.eye(PIXELS), np.arange(PIXELS)
    exact = [frame.irradiance for frame in ExpectedFrames(optics, random_groups(1, 0, 0.0), labels, weights, 0)]
    actual, predicted = [], []
    for seed in range(SEEDS):
        found = list(ExpectedFrames(optics, random_groups(groups, 100 + seed, 0.2), labels, weights, seed))
        assert all(frame.removed == 0 for frame in found)
        actual.append(sum(np.square(f.irradiance - e).sum() for f, e in zip(found, exact, strict=True)))
        predicted.append(sum(f.variance * f.irradiance.size for f in found))
        energy = sum(np.square(f.irradiance).sum() for f in found)
        assert relative_error(found) == pytest.approx(np.sqrt(predicted[-1] / energy), rel=1e-12)
    ratio = np.sum(actual) / np.sum(predicted)
    residual = np.array(actual) - ratio * np.array(predicted)
    deviation = residual.std(ddof=1) / np.sqrt(SEEDS) / np.mean(predicted)
    assert 5 * deviation < 0.22
    assert abs(ratio - 1) < 5 * deviation


def test_what_interpolation_leaves_below_zero_is_reported() -> None:
    light = sparse.csr_array(np.where(np.arange(CELLS**2) == 0, -1.0, 1.0)[None, :].repeat(PIXELS, 0))
    weights = np.array([[1.0, 0, 0, 0]])
    optics = small_optics()
    (frame,) = ExpectedFrames(optics, [light, light], LABELS, weights, 0)
    raw = optics.frame(np.arange(CELLS**2), 4 * light.toarray()[0])
    assert (raw < 0).any() == (frame.removed > 0)
    assert np.array_equal(frame.irradiance, np.maximum(raw, 0))
    only = sparse.csr_array(-light * (np.arange(CELLS**2) == 0))
    dark = sparse.csr_array(light * (np.arange(CELLS**2) == 0))
    assert only.sum() == PIXELS and dark.sum() == -PIXELS
    (frame,) = ExpectedFrames(optics, [dark, dark], LABELS, weights, 0)
    assert not frame.irradiance.any() and frame.removed == 0.0
