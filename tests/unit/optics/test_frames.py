"""A small camera before a near board, and light of a few projector pixels in its cells: numbers in, frames' optics out.

The board is near (40 mm), so that the falloff across the sensor is a few percent and every discretisation has something
to get wrong.

Frames in closed form against an integral over mask, window and pixel done by Gauss quadrature; layers; probes.

What groups of paths tell of the frames' Monte Carlo error: the variance against drawn errors, probes, the bound.

Frames of all shots of a family: mixed from classes or formed one by one, with ambient, further and exact light.
"""

from functools import cache
from itertools import pairwise, product

import numpy as np
import pytest
from scipy import sparse
from scipy.linalg import hadamard

from mitsim.acquire.exposure import Totals
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.mask import Mask
from mitsim.devices.patterns import Lighting
from mitsim.optics import frames as frames_module
from mitsim.optics.frames import (
    AccumulatedLight,
    ClassFrames,
    ExpectedFrames,
    _product,
    bound_of,
    formed_frames,
    pair_shots,
    probe_vectors,
)
from mitsim.optics.image_formation import FrameOptics, anchor_positions, anchor_weights
from mitsim.optics.shadow import Directions
from mitsim.optics.terms import shadow_terms

Z, WINDOW = 40.0, (-0.13, 0.17)
CAMERA = CameraGeometry(
    pixels=96, pixel_pitch=6 / 96, mask="separable", mask_order=3, mask_feature=1.5, scene_distance=Z
)


def cell_optics(camera: CameraGeometry, rows: np.ndarray, columns: np.ndarray, anchors: int = 1) -> FrameOptics:
    """Light that is even in cells, at the board's depth."""
    return FrameOptics(camera, Directions.cells(rows), Directions.cells(columns), (Z,), anchors)


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
    return cell_optics(camera, edges, edges)


LABELS = np.arange(PIXELS) % 4


def expected_frames(optics, groups, labels, weights, seed, more=(), **others) -> ExpectedFrames:
    """Frames of ``groups`` in the cells of ``optics``, and of light accumulated elsewhere."""
    return ExpectedFrames([AccumulatedLight(optics, tuple(groups)), *more], Lighting(labels, weights), seed, **others)


FAMILIES = {
    "identity": np.eye(4),
    "permuted": np.eye(4)[::-1],
    "mixing": np.vstack(
        [np.ones(4), 0.5 + 0.5 * np.array([[1, 1, 1, 1], [1, -1, 1, -1], [1, 1, -1, -1], [0, 1, 0.3, 1]])]
    ),
    "a class or two that leak": 0.02
    + 0.98 * np.array([[1, 0.7, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 0, 1]]),
}


SPLIT = np.arange(PIXELS) % 12
MANY = np.random.default_rng(12).random((3, 12))
"""Twelve classes for three captures: formed capture by capture, not mixed from classes."""
BESIDE = {"mixed": (LABELS, FAMILIES["mixing"]), "by capture": (SPLIT, MANY)}


def ambient_groups(count: int, seed: int = 31) -> tuple[sparse.csr_array, ...]:
    return tuple(group[[0]] for group in random_groups(count, seed, 0.3))


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

SEEDS = 300


@pytest.mark.parametrize("groups", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_the_predicted_variance_is_the_actual_one(groups: int) -> None:
    """Squared error / predicted variance over 300 seeds is 1 within five of its own standard deviations.

    Sixteen frames with independent noise make the mean over the seeds good to 4 %; a divisor G^2 in place of
    G (G - 1) would be wrong by 1/2 and 1/4.
    """
    optics, weights, labels = small_optics(), np.eye(PIXELS), np.arange(PIXELS)
    exact = [frame.irradiance for frame in expected_frames(optics, random_groups(1, 0, 0.0), labels, weights, 0)]
    actual, predicted = [], []
    for seed in range(SEEDS):
        found = list(expected_frames(optics, random_groups(groups, 100 + seed, 0.2), labels, weights, seed))
        assert all(frame.removed == 0 for frame in found)
        actual.append(sum(np.square(f.irradiance - e).sum() for f, e in zip(found, exact, strict=True)))
        predicted.append(sum(f.variance * f.irradiance.size for f in found))
        energy = sum(np.square(f.irradiance).sum() for f in found)
        assert Totals.of(found).noise.value == pytest.approx(np.sqrt(predicted[-1] / energy), rel=1e-12)
    ratio = np.sum(actual) / np.sum(predicted)
    residual = np.array(actual) - ratio * np.array(predicted)
    deviation = residual.std(ddof=1) / np.sqrt(SEEDS) / np.mean(predicted)
    assert 5 * deviation < 0.22
    assert abs(ratio - 1) < 5 * deviation


@pytest.mark.parametrize("family", BESIDE)
def test_the_sampling_error_is_told_without_frames(family: str) -> None:
    """That of the frames, and its bound, but for the energy, which the same signs tell.

    Nearly all energy is in the frames' means over columns, which are told exactly; of the rest eight signs tell a
    half. Ambient light and specular chains are large parts of it: either left out would move the error by more than the
    gate.
    """
    labels, weights = BESIDE[family]
    optics, groups, lamps = small_optics(), random_groups(4, 7, 0.3), ambient_groups(4)
    bright = next(iter(expected_frames(optics, groups, labels, weights, 0))).irradiance.mean()
    exact = ClassFrames(np.array([1, 3]), bright * np.random.default_rng(3).random((2, 40, 40)))
    frames = expected_frames(
        optics, groups, labels, weights, 0, ambient=[AccumulatedLight(optics, lamps)], specular=exact
    )
    error, bound = frames.sampling_error()
    assert error == pytest.approx(Totals.of(frames).noise.value, rel=0.02)
    assert bound / error == pytest.approx(Totals.of(frames).noise.bound / Totals.of(frames).noise.value, rel=1e-9)
    for without in ({"specular": exact}, {"ambient": [AccumulatedLight(optics, lamps)]}):
        other, _ = expected_frames(optics, groups, labels, weights, 0, **without).sampling_error()
        assert other != pytest.approx(Totals.of(frames).noise.value, rel=0.02)


def test_probes_see_every_matrix_with_its_norm_and_what_columns_share_exactly() -> None:
    """sum |A v|^2 is ||A||^2 in the mean; for equal columns it is no estimate.

    Of 400 draws of 8 signs the mean of an off-diagonal entry of sum v v^T has a deviation of 1/sqrt(3200); five of
    those.
    """
    pixels = 12
    probes = [probe_vectors(pixels, seed) for seed in range(400)]
    for one in probes[:5]:
        assert np.square(np.ones(pixels) @ one).sum() == pytest.approx(pixels, rel=1e-12)
    mean = np.mean([one @ one.T for one in probes], axis=0)
    np.testing.assert_allclose(mean, np.eye(pixels), rtol=0, atol=5 / np.sqrt(3200))


KINDS = {"one": np.ones(1), "two": np.ones(2), "four": np.ones(4), "sixteen": np.ones(16), "many": np.ones(100),
         "fewer and fewer": 0.8 ** np.arange(30), "half of one": np.array([50.0, *np.ones(50)])}  # fmt: skip
"""Variance of each kind of noise."""


@pytest.mark.parametrize("kinds", KINDS)
def test_the_bound_of_a_monte_carlo_error_holds(kinds: str) -> None:
    """At least 93.5 % of 4000 errors, each the mean of 4 normal groups with so many kinds of noise, are below their
    bound.

    One seed: 94 % where one kind has half of the noise, up to 99.4 % of equal kinds. Binomial standard deviation:
    0.35 %. (Planted: the bound by the spread of groups' energies, which held in 85 % for one kind; Student's deviate
    of one side; a square that grows with the power 0.75 of the part of one kind, 92 %.)
    """
    groups, draws, variances = 4, 4000, KINDS[kinds]
    noise = np.random.default_rng(5).normal(size=(draws, groups, len(variances))) * np.sqrt(variances)
    mean = noise.mean(axis=1)
    off = noise - mean[:, None]
    products = off @ off.transpose(0, 2, 1) / (groups * (groups - 1))
    made, bounds = np.square(mean).sum(axis=1), np.array([bound_of(each, 1.0) for each in products])
    held = float((made <= bounds**2).mean())
    assert 0.935 < held < 0.997
    assert bound_of(np.zeros((4, 4)), 1.0) == bound_of(np.eye(4), 0.0) == 0.0


@pytest.mark.parametrize("family", FAMILIES)
def test_mixing_classes_equals_weighing_every_pixel(family: str) -> None:
    weights, groups = FAMILIES[family], random_groups(3, 7, spread=0.1)
    optics = small_optics()
    mixed = list(expected_frames(optics, groups, LABELS, weights, 5))
    # Sixteen classes are more than the captures, so these frames are formed one by one.
    direct = list(expected_frames(optics, groups, np.arange(PIXELS), weights[:, LABELS], 5))
    assert len(mixed) == len(direct) == len(weights)
    mean = sum(groups[1:], groups[0]) / 3
    for one, other, row in zip(mixed, direct, weights, strict=True):
        plain = optics.frame(np.arange(CELLS**2), np.asarray(row[LABELS] @ mean.toarray()))
        scale = np.abs(plain).max()
        assert np.abs(one.irradiance - plain).max() < 1e-12 * scale
        assert np.abs(other.irradiance - plain).max() < 1e-12 * scale
        assert one.variance == pytest.approx(other.variance, rel=1e-9)


def test_what_interpolation_leaves_below_zero_is_reported() -> None:
    """As a part of the light that is left. Half of the cells are darker than nothing here."""
    light = sparse.csr_array(np.where(np.arange(CELLS**2) % CELLS < CELLS // 2, -1.0, 1.5)[None, :].repeat(PIXELS, 0))
    weights = np.array([[1.0, 0, 0, 0]])
    optics = small_optics()
    (frame,) = expected_frames(optics, [light, light], LABELS, weights, 0)
    raw = optics.frame(np.arange(CELLS**2), 4 * light.toarray()[0])
    below = raw < 0
    assert 0.1 < below.mean() < 0.9
    assert frame.removed == pytest.approx(-raw[below].sum() / raw[~below].sum(), rel=1e-12)
    assert np.array_equal(frame.irradiance, np.maximum(raw, 0))
    dark = sparse.csr_array(-abs(light))
    (frame,) = expected_frames(optics, [dark, dark], LABELS, weights, 0)
    assert not frame.irradiance.any() and frame.removed == 0.0


@pytest.mark.parametrize(("family", "formed"), [("mixed", 4), ("by capture", 6)])
def test_frames_are_formed_as_often_as_is_promised(family: str, formed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every frame is asked for twice: to find the brightest pixel, and to expose it."""
    labels, weights = BESIDE[family]
    count, seen = [], FrameOptics.frame_and_products
    monkeypatch.setattr(FrameOptics, "frame_and_products", lambda *arguments: count.append(0) or seen(*arguments))
    frames = expected_frames(small_optics(8), random_groups(1, 7), labels, weights, 0)
    for _ in range(2):
        assert len(list(frames)) == len(weights)
    assert len(count) == formed == formed_frames(labels.max() + 1, len(weights), 8)


def test_what_leaks_in_all_shots_is_formed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three shots of twelve classes whose black pixels leak: the frames, and the error, of weighing every pixel.

    (Planted: the leak left out; added twice where shots are asked for from the second on; left out of the probes.) Each
    shot's own light is then that of its class alone, and not of every pixel.
    """
    weights = 0.02 + 0.98 * np.eye(12)[[1, 5, 9]]
    optics, groups = small_optics(8), random_groups(3, 7, 0.2)
    leaking = expected_frames(optics, groups, SPLIT, weights, 5)
    assert leaking._basis.nnz == np.isin(SPLIT, [1, 5, 9]).sum()
    mean = (sum(groups[1:], groups[0]) / 3).toarray()
    whole = expected_frames(optics, groups, SPLIT, np.vstack([weights, np.eye(12)]), 5)
    monkeypatch.setattr(frames_module, "_BYTES_AT_ONCE", 2 * 8 * 8**2)
    for found, other, row in zip(leaking, whole, weights, strict=False):
        plain = optics.frame(np.arange(CELLS**2), row[SPLIT] @ mean)
        assert np.abs(found.irradiance - plain).max() < 1e-12 * plain.max()
        assert found.variance == pytest.approx(other.variance, rel=1e-9)
    three = expected_frames(optics, groups, SPLIT, np.vstack([weights] * 4), 5)
    assert leaking.sampling_error() == pytest.approx(three.sampling_error(), rel=1e-9)


@pytest.mark.parametrize("lamps", [False, True])
@pytest.mark.parametrize("black", [0.0, 0.02])
@pytest.mark.parametrize("most", [1.0, 0.7])
def test_shots_of_a_class_each_are_the_same_when_asked_for_twice(lamps: bool, black: float, most: float) -> None:
    """Bit by bit; some pixels are below zero, and the classes' frames must stay what they are."""
    weights = black + most * np.eye(4)[[2, 0, 3, 1]]
    sides = np.where(np.arange(CELLS**2) % CELLS < CELLS // 2, -1.0, 1.5)
    light = [sparse.csr_array(group.toarray() * sides) for group in random_groups(3, 7, 0.2)]
    ambient = [AccumulatedLight(small_optics(), ambient_groups(3))] if lamps else []
    expected = expected_frames(small_optics(), light, LABELS, weights, 5, ambient=ambient)
    error = expected.sampling_error()
    once, twice = list(expected), list(expected)
    assert any(frame.removed for frame in once) and len({frame.variance for frame in once}) == 4
    assert error[0] > 0 and expected.sampling_error() == error
    for found, again in zip(once, twice, strict=True):
        assert found.irradiance.tobytes() == again.irradiance.tobytes()
        assert np.array_equal(found.by_group, again.by_group)


def test_light_in_very_many_places_is_mixed_where_it_is() -> None:
    """Places beyond 2^22 take a product of their own, which never makes a line for each of them."""
    rng = np.random.default_rng(6)
    rows, places = rng.integers(0, PIXELS, 300), rng.integers(0, 2**23, 300)
    light = sparse.csr_array((rng.random(300), (rows, places)), shape=(PIXELS, 2**23))
    basis = sparse.csr_array(rng.random((3, PIXELS)))
    found = _product(basis, light)
    assert found.shape == (3, 2**23) and abs(found - basis @ light).max() < 1e-15
    assert (np.diff(found.indices) < 0).sum() == 2, "in each of three rows in order, or a sum takes 20 bytes a place"
    dark = _product(basis, sparse.csr_array((PIXELS, 2**23)))
    assert dark.shape == (3, 2**23) and dark.nnz == 0


# ---- ambient light, light in other cells, and exact light beside the groups'


def alike(found: ExpectedFrames, other: ExpectedFrames) -> None:
    """Same frames and same variances."""
    for one, two in zip(found, other, strict=True):
        assert np.allclose(one.irradiance, two.irradiance, rtol=1e-10, atol=1e-12 * two.irradiance.max())
        assert one.variance == pytest.approx(two.variance, rel=1e-9)


@pytest.mark.parametrize("family", BESIDE)
def test_ambient_light_is_in_every_capture_alike(family: str) -> None:
    """Weight 1 even where the projector is dark; its estimates deviate together with their groups'."""
    labels, weights = BESIDE[family]
    weights = weights.copy()
    weights[1] = 0
    optics, groups, lamps = small_optics(), random_groups(3, 7, 0.2), ambient_groups(3)
    plain = list(expected_frames(optics, groups, labels, weights, 5))
    lit = expected_frames(optics, groups, labels, weights, 5, ambient=[AccumulatedLight(optics, lamps)])
    mean = np.asarray(sum(lamps[1:], lamps[0]).todense()).ravel() / 3
    expected = optics.frame(np.arange(CELLS**2), mean)
    for with_lamps, without in zip(lit, plain, strict=True):
        assert np.allclose(with_lamps.irradiance, without.irradiance + expected, rtol=1e-10)
    # The same as a projector pixel of its own that always shines.
    more = [sparse.vstack([group, lamp], format="csr") for group, lamp in zip(groups, lamps, strict=True)]
    always = np.concatenate([weights, np.ones((len(weights), 1))], axis=1)
    alike(lit, expected_frames(optics, more, np.append(labels, weights.shape[1]), always, 5))
    assert next(iter(lit)).variance > 0 and plain[1].variance == 0
    alike(lit.of_projector, plain)
    for shot in lit:
        parts = shot.by_group
        assert shot.heaviest == pytest.approx(parts.max() / np.trace(parts))
    assert np.allclose(lit.projector_off.irradiance, expected, rtol=1e-10) and lit.projector_off.variance == 0
    dark = expected_frames(optics, groups, labels, weights, 5).projector_off
    assert dark.irradiance.shape == expected.shape and not dark.irradiance.any()


@pytest.mark.parametrize("family", BESIDE)
def test_more_light_adds_to_the_light_of_its_rows(family: str) -> None:
    """Filed in the same cells it is as if it had been added; errors of one path go together, so they add first."""
    labels, weights = BESIDE[family]
    optics, groups, more = small_optics(), random_groups(3, 7, 0.2), random_groups(3, 8, 0.2)
    apart = expected_frames(optics, groups, labels, weights, 5, more=[AccumulatedLight(optics, tuple(more))])
    alike(apart, expected_frames(optics, [a + b for a, b in zip(groups, more, strict=True)], labels, weights, 5))


# ---- shots that leave one another of the light of all pixels


@pytest.mark.parametrize("low", [0.0, 0.01])
def test_shots_of_signed_patterns_are_pairs(low: float) -> None:
    """All +-1 patterns of order 8, with black pixels that are dark and that leak: half of the shots are kept, and these
    make up all. (Planted: the second of a pair not turned; what leaks left out; the light of all pixels not found.)"""
    signs = hadamard(8)
    lit = np.stack([signs > 0, signs < 0], axis=1).reshape(16, 8)
    weights = np.where(lit, 1.0, low)
    kept, mixture = pair_shots(weights)  # type: ignore[misc]
    assert kept.shape == (8, 8)
    assert np.abs(mixture.weights @ kept - weights).max() < 1e-15
    assert mixture.own.nnz <= 2 * len(weights)
    basis = np.random.default_rng(1).random((8, 3, 5))
    pairs = np.tensordot(kept, basis, axes=1)
    for start, stop in ((0, 16), (5, 9)):
        shots = np.stack(mixture.shots(pairs, start, stop))
        assert np.abs(shots - np.tensordot(weights[start:stop], basis, axes=1)).max() < 1e-14


# ---- what frames are, besides their light


def test_no_product_is_taken_over_more_than_four_million_places() -> None:
    """SciPy would take 16 bytes for each. (Planted: a bound of 3^22.)"""
    widths = []

    class Watched(sparse.csr_array):
        def __matmul__(self, other: sparse.csr_array) -> sparse.csr_array:
            widths.append(other.shape[1])
            return super().__matmul__(other)

    for places in (2**22, 2**22 + 1):
        light = sparse.csr_array(([1.0, 2.0], ([0, 1], [5, places - 1])), shape=(2, places))
        found = _product(Watched(np.array([[1.0, 1.0]])), light)
        assert found.shape == (1, places) and found.nnz == 2 and found.max() == 2
    assert widths == [2**22, 2]
