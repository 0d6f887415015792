"""Frames in closed form against an integral over mask, window and pixel done by Gauss quadrature; their variance.

The camera here is small and the board near (40 mm), so that the falloff across the sensor is a few percent and every
discretisation has something to get wrong.
"""

from functools import cache
from itertools import pairwise, product

import numpy as np
import pytest
from scipy import sparse

from mitsim.optics.anchors import anchor_positions, anchor_weights
from mitsim.optics.frames import (
    ClassFrames,
    ExpectedFrames,
    Filed,
    FrameOptics,
    _probes,
    _product,
    bound_of,
    formed_frames,
    monte_carlo_bound,
    monte_carlo_error,
)
from mitsim.optics.shadow import Directions
from mitsim.optics.terms import shadow_terms
from mitsim.rig.camera import CameraGeometry
from mitsim.rig.mask import Mask
from mitsim.rig.patterns import Lighting

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
    optics = cell_optics(CAMERA.model_copy(update={"mask": kind}), edges, edges, anchors)
    return optics.frame(*board_light(edges, anchors))[np.ix_(ROWS, COLUMNS)]


def cell_optics(camera: CameraGeometry, rows: np.ndarray, columns: np.ndarray, anchors: int = 1) -> FrameOptics:
    """Light that is even in cells, at the board's depth."""
    return FrameOptics(camera, Directions.cells(rows), Directions.cells(columns), (Z,), anchors)


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


def test_no_light_is_a_black_frame() -> None:
    edges = np.linspace(*WINDOW, 5)
    optics = cell_optics(CAMERA, edges, edges)
    assert not optics.frame(np.empty(0, np.int64), np.empty(0)).any()


@pytest.mark.parametrize("anchors", [1, 3])
def test_the_mean_of_an_open_frame_is_the_irradiance(anchors: int) -> None:
    """Through an open mask a frame's mean is the light itself, by the anchors' mean weights."""
    edges = np.linspace(*WINDOW, 9)
    camera = CAMERA.model_copy(update={"mask": "open", "mask_feature": 6.0})
    flat, light = board_light(edges, anchors)
    frame = cell_optics(camera, edges, edges, anchors).frame(flat, light)
    middle = (CAMERA.pixel_edges[:-1] + CAMERA.pixel_edges[1:]) / 2
    mean = anchor_weights(anchor_positions(anchors, CAMERA.half_width), middle).mean(axis=0)
    expected = np.einsum("a,b,aibj->", mean, mean, light.reshape(anchors, 8, anchors, 8))
    assert frame.mean() == pytest.approx(expected, rel=1e-12)


# ---- layers, and light between cell corners


def test_layers_add_up() -> None:
    """Light in two layers casts the sum of two shadows, each with its own magnification."""
    rng, edges, depths = np.random.default_rng(5), np.linspace(-0.2, 0.2, 11), (60.0, 20.0)
    camera = CAMERA.model_copy(update={"mask": "flatcam"})
    light = rng.random((2, 400))
    directions = Directions.cells(edges)
    both = FrameOptics(camera, directions, directions, depths, 2)
    single = [FrameOptics(camera, directions, directions, (depth,), 2) for depth in depths]
    parts = [optics.frame(np.arange(400), values) for optics, values in zip(single, light, strict=True)]
    assert np.allclose(both.frame(np.arange(800), light.ravel()), sum(parts), rtol=1e-12)
    assert np.allclose(both.frame(np.arange(400) + 400, light[1]), parts[1], rtol=1e-12)
    assert np.abs(single[0].frame(np.arange(400), light[1]) - parts[1]).max() > 0.05 * parts[1].max()


def test_probes_see_the_frames_of_all_layers() -> None:
    rng, rows = np.random.default_rng(6), Directions.cells(np.linspace(-0.2, 0.2, 11))
    columns = Directions.cells(np.linspace(-0.1, 0.3, 9))
    optics = FrameOptics(CAMERA, rows, columns, (60.0, 20.0), 2)
    flat = np.sort(rng.choice(640, 150, replace=False))
    lights, vectors = rng.random((3, 150)), rng.standard_normal((96, 5))
    found = optics.probe(flat, lights, vectors)
    expected = np.concatenate([optics.frame(flat, light) @ vectors for light in lights], axis=1)
    assert np.allclose(found, expected, rtol=1e-10)


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
    return cell_optics(camera, edges, edges)


LABELS = np.arange(PIXELS) % 4


def expected_frames(optics, groups, labels, weights, seed, more=(), **others) -> ExpectedFrames:
    """Frames of ``groups`` in the cells of ``optics``, and of light filed elsewhere."""
    return ExpectedFrames([Filed(optics, tuple(groups)), *more], Lighting(labels, weights), seed, **others)


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


def test_more_frames_than_one_block() -> None:
    weights = np.random.default_rng(2).random((70, 4))
    expected = expected_frames(small_optics(8), random_groups(2, 3, 0.1), LABELS, weights, 0)
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
    exact = [frame.irradiance for frame in expected_frames(optics, random_groups(1, 0, 0.0), labels, weights, 0)]
    actual, predicted = [], []
    for seed in range(SEEDS):
        found = list(expected_frames(optics, random_groups(groups, 100 + seed, 0.2), labels, weights, seed))
        assert all(frame.removed == 0 for frame in found)
        actual.append(sum(np.square(f.irradiance - e).sum() for f, e in zip(found, exact, strict=True)))
        predicted.append(sum(f.variance * f.irradiance.size for f in found))
        energy = sum(np.square(f.irradiance).sum() for f in found)
        assert monte_carlo_error(found) == pytest.approx(np.sqrt(predicted[-1] / energy), rel=1e-12)
    ratio = np.sum(actual) / np.sum(predicted)
    residual = np.array(actual) - ratio * np.array(predicted)
    deviation = residual.std(ddof=1) / np.sqrt(SEEDS) / np.mean(predicted)
    assert 5 * deviation < 0.22
    assert abs(ratio - 1) < 5 * deviation


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


# ---- ambient light, light in other cells, and exact light beside the groups'


SPLIT = np.arange(PIXELS) % 12
MANY = np.random.default_rng(12).random((3, 12))
"""Twelve classes for three captures: formed capture by capture, not mixed from classes."""
BESIDE = {"mixed": (LABELS, FAMILIES["mixing"]), "by capture": (SPLIT, MANY)}


def ambient_groups(count: int, seed: int = 31) -> tuple[sparse.csr_array, ...]:
    return tuple(group[[0]] for group in random_groups(count, seed, 0.3))


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
    lit = expected_frames(optics, groups, labels, weights, 5, ambient=[Filed(optics, lamps)])
    mean = np.asarray(sum(lamps[1:], lamps[0]).todense()).ravel() / 3
    expected = optics.frame(np.arange(CELLS**2), mean)
    for with_lamps, without in zip(lit, plain, strict=True):
        assert np.allclose(with_lamps.irradiance, without.irradiance + expected, rtol=1e-10)
    # The same as a projector pixel of its own that always shines.
    more = [sparse.vstack([group, lamp], format="csr") for group, lamp in zip(groups, lamps, strict=True)]
    always = np.concatenate([weights, np.ones((len(weights), 1))], axis=1)
    alike(lit, expected_frames(optics, more, np.append(labels, weights.shape[1]), always, 5))
    assert next(iter(lit)).variance > 0 and plain[1].variance == 0
    assert np.allclose(lit.projector_off.irradiance, expected, rtol=1e-10) and lit.projector_off.variance == 0
    dark = expected_frames(optics, groups, labels, weights, 5).projector_off
    assert dark.irradiance.shape == expected.shape and not dark.irradiance.any()


def test_ambient_light_of_two_kinds() -> None:
    """Fine and coarse cells: their frames add, and so do the deviations of paired groups, before they are squared."""
    optics, groups, lamps, others = small_optics(), random_groups(3, 7, 0.2), ambient_groups(3), ambient_groups(3, 32)
    apart = expected_frames(optics, groups, LABELS, np.eye(4), 5, ambient=[Filed(optics, lamps), Filed(optics, others)])
    summed = tuple(a + b for a, b in zip(lamps, others, strict=True))
    alike(apart, expected_frames(optics, groups, LABELS, np.eye(4), 5, ambient=[Filed(optics, summed)]))


def test_ambient_light_has_a_shadow_of_its_own() -> None:
    optics, other, lamps = small_optics(), small_optics(), ambient_groups(2)
    edges = np.linspace(*WINDOW, CELLS + 1)
    other = cell_optics(CAMERA.model_copy(update={"pixels": 40, "pixel_pitch": 0.15, "mask": "open"}), edges, edges)
    groups = random_groups(2, 7, 0.2)
    frames = expected_frames(optics, groups, LABELS, np.eye(4), 0, ambient=[Filed(other, lamps)])
    plain = expected_frames(optics, groups, LABELS, np.eye(4), 0)
    mean = np.asarray((lamps[0] + lamps[1]).todense()).ravel() / 2
    expected = other.frame(np.arange(CELLS**2), mean)
    assert np.allclose(next(iter(frames)).irradiance - next(iter(plain)).irradiance, expected, rtol=1e-9)


@pytest.mark.parametrize("family", BESIDE)
def test_more_light_adds_to_the_light_of_its_rows(family: str) -> None:
    """Filed in the same cells it is as if it had been added; errors of one path go together, so they add first."""
    labels, weights = BESIDE[family]
    optics, groups, more = small_optics(), random_groups(3, 7, 0.2), random_groups(3, 8, 0.2)
    apart = expected_frames(optics, groups, labels, weights, 5, more=[Filed(optics, tuple(more))])
    alike(apart, expected_frames(optics, [a + b for a, b in zip(groups, more, strict=True)], labels, weights, 5))


def test_more_light_in_cells_of_its_own() -> None:
    edges = np.linspace(*WINDOW, 4)
    camera = CAMERA.model_copy(update={"pixels": 40, "pixel_pitch": 0.15})
    coarse, optics = cell_optics(camera, edges, edges), small_optics()
    groups = random_groups(2, 7, 0.2)
    more = tuple(sparse.csr_array(np.random.default_rng(seed).random((PIXELS, 9))) for seed in (1, 2))
    frames = expected_frames(optics, groups, LABELS, np.eye(4), 0, more=[Filed(coarse, more)])
    plain = expected_frames(optics, groups, LABELS, np.eye(4), 0)
    light = np.asarray((more[0] + more[1]).todense())[LABELS == 2].sum(axis=0) / 2
    difference = list(frames)[2].irradiance - list(plain)[2].irradiance
    assert np.allclose(difference, coarse.frame(np.arange(9), light), rtol=1e-9)


@pytest.mark.parametrize("family", [*BESIDE, "identity", "many"])
def test_exact_frames_are_mixed_by_the_weights(family: str) -> None:
    """Classes 1 and 3 bring frames of their own, without error, in families of either kind and over several blocks."""
    families = {**BESIDE, "identity": (LABELS, np.eye(4)), "many": (SPLIT, np.random.default_rng(2).random((70, 80)))}
    labels, weights = families[family]
    optics, groups = small_optics(8), random_groups(2, 7, 0.2)
    brought = np.random.default_rng(3).random((2, 8, 8))
    exact = ClassFrames(np.array([1, 3]), brought)
    with_it = list(expected_frames(optics, groups, labels, weights, 0, glint=exact))
    without = list(expected_frames(optics, groups, labels, weights, 0))
    assert len(with_it) == len(weights)
    for found, plain, row in zip(with_it, without, weights, strict=True):
        expected = plain.irradiance + row[1] * brought[0] + row[3] * brought[1]
        assert np.allclose(found.irradiance, expected, rtol=1e-10)
        assert found.variance == pytest.approx(plain.variance, rel=1e-12)


@pytest.mark.parametrize("family", BESIDE)
def test_each_group_makes_frames_by_itself(family: str) -> None:
    """Those of a capture whose light is that group alone, with its ambient light and what is exact."""
    labels, weights = BESIDE[family]
    optics, groups, lamps = small_optics(8), random_groups(3, 7, 0.1), ambient_groups(3)
    columns, brought = np.array([1, 6]), np.random.default_rng(3).random((2, 8, 8))
    exact = ClassFrames(np.array([1, 3]), brought)
    found = expected_frames(optics, groups, labels, weights, 0, ambient=[Filed(optics, lamps)], glint=exact).by_group(
        columns
    )
    assert found.shape == (3, len(weights), 8, 2)
    for frames, group, lamp in zip(found, groups, lamps, strict=True):
        alone = expected_frames(optics, [group], labels, weights, 0, ambient=[Filed(optics, (lamp,))], glint=exact)
        for frame, expected in zip(frames, alone, strict=True):
            assert np.allclose(frame, expected.irradiance[:, columns], rtol=1e-10)


@pytest.mark.parametrize(("family", "formed"), [("mixed", 4), ("by capture", 6)])
def test_frames_are_formed_as_often_as_is_promised(family: str, formed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every frame is asked for twice: to find the brightest pixel, and to expose it."""
    labels, weights = BESIDE[family]
    count, frame = [], FrameOptics.frame
    monkeypatch.setattr(FrameOptics, "frame", lambda *arguments: count.append(0) or frame(*arguments))
    frames = expected_frames(small_optics(8), random_groups(1, 7), labels, weights, 0)
    for _ in range(2):
        assert len(list(frames)) == len(weights)
    assert len(count) == formed == formed_frames(labels.max() + 1, len(weights))


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


def test_one_group_has_no_variance_to_tell() -> None:
    frames = expected_frames(small_optics(), random_groups(1, 7, 0.2), LABELS, np.eye(4), 0)
    assert all(frame.variance == 0 and frame.irradiance.any() for frame in frames)
    assert monte_carlo_error(frames) == monte_carlo_bound(frames) == 0


def test_probes_see_every_matrix_with_its_norm_and_what_columns_share_exactly() -> None:
    """sum |A v|^2 is ||A||^2 in the mean; for equal columns it is no estimate.

    Of 400 draws of 8 signs the mean of an off-diagonal entry of sum v v^T has a deviation of 1/sqrt(3200); five of
    those.
    """
    pixels = 12
    probes = [_probes(pixels, seed) for seed in range(400)]
    for one in probes[:5]:
        assert np.square(np.ones(pixels) @ one).sum() == pytest.approx(pixels, rel=1e-12)
    mean = np.mean([one @ one.T for one in probes], axis=0)
    np.testing.assert_allclose(mean, np.eye(pixels), rtol=0, atol=5 / np.sqrt(3200))


@pytest.mark.parametrize(("freedom", "least"), [(4, 0.86), (40, 0.91), (400, 0.91)])
def test_the_bound_of_a_monte_carlo_error_holds(freedom: int, least: float) -> None:
    """2000 errors, each the mean of 8 normal groups in so many dimensions: 95 % should be below their bound.

    Eight groups tell the spread of their energies to a quarter, and in four dimensions it is skewed as well: 88.6 %
    there. Without the spread the bound holds in 58 % at best. Binomial standard deviation: 0.7 %.
    """
    groups, draws = 8, 2000
    noise = np.random.default_rng(5).normal(size=(draws, groups, freedom))
    mean = noise.mean(axis=1)
    parts = np.square(noise - mean[:, None]).sum(axis=2) / (groups * (groups - 1))
    made, bounds = np.square(mean).sum(axis=1), np.array([bound_of(part, 1.0) for part in parts])
    held = float((made <= bounds**2).mean())
    assert least < held < 0.99
    assert bound_of(np.zeros(8), 1.0) == bound_of(np.ones(8), 0.0) == 0.0
