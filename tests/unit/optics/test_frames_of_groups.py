"""What groups of paths tell of the frames' Monte Carlo error: the variance against drawn errors, probes, the bound."""

import numpy as np
import pytest

from mitsim.acquire.exposure import Totals
from mitsim.optics.frames import AccumulatedLight, ClassFrames, bound_of, probe_vectors
from tests.unit.optics.small_camera import BESIDE, PIXELS, ambient_groups, expected_frames, random_groups, small_optics

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
