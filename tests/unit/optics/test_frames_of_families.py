"""Frames of all shots of a family: mixed from classes or formed one by one, with ambient, further and exact light."""

import numpy as np
import pytest
from scipy import sparse
from scipy.linalg import hadamard

from mitsim.optics import frames as frames_module
from mitsim.optics.frames import AccumulatedLight, ExpectedFrames, _product, formed_frames, pair_shots
from mitsim.optics.image_formation import FrameOptics
from tests.unit.optics.small_camera import (
    BESIDE,
    CELLS,
    FAMILIES,
    LABELS,
    PIXELS,
    SPLIT,
    ambient_groups,
    expected_frames,
    random_groups,
    small_optics,
)


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
