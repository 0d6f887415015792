"""Factors come back from striped light: exactly without noise, with the predicted error under noise."""

import numpy as np
import pytest
from scipy.linalg import hadamard

from mitsim.core.errors import MitsimError
from mitsim.devices.camera import centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.reconstruct.factors import AmbientLight, _rank_one_split, predicted_error, stripe_sums
from mitsim.reconstruct.solver import prepare
from tests.shadow_factor import scene_factor
from tests.stripes import estimated

N, M = 16, 40
H = hadamard(N).astype(float)
DARK = np.zeros((M, M + 5))


def factors(seed=0):
    rng = np.random.default_rng(seed)
    return rng.random((M, N)), 3 * rng.random((M + 5, N))


def responses(left, right, signs=H):
    ones = np.ones(len(signs))
    horizontal = [np.outer(left @ h, right @ ones) for h in signs.T]
    vertical = [np.outer(left @ ones, right @ h) for h in signs.T]
    return horizontal, vertical


def relative(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


def balanced(left, right):
    scale = np.sqrt(np.linalg.norm(right.sum(axis=1)) / np.linalg.norm(left.sum(axis=1)))
    return left * scale, right / scale


@pytest.mark.parametrize("scene", [N, 11])
def test_noise_free_factors_are_exact_and_reproduce_absolute_responses(scene):
    left, right = (factor[:, :scene] for factor in factors())
    horizontal, vertical = responses(left, right, H[:scene])
    got = estimated(iter(horizontal), iter(vertical), H[:scene])
    for estimate, truth in zip((got.left, got.right), balanced(left, right), strict=True):
        assert relative(estimate, truth) < 1e-12
    assert relative(np.outer(got.left, got.right), np.outer(left, right)) < 1e-12
    assert got.separability_residual < 1e-12
    assert got.condition == pytest.approx(max(np.linalg.cond(left), np.linalg.cond(right)) ** 2, rel=1e-9)
    assert got.ok


def test_error_under_noise_is_the_predicted_one():
    # 40 repetitions: the mean squared error of 40 x 640 independent numbers is known to 1 %; tolerance 5 %.
    left, right = balanced(*factors())
    horizontal, vertical = responses(left, right)
    noise, errors, claims, estimates = 1.0, [], [], []
    for seed in range(40):
        rng = np.random.default_rng([7, seed])
        got = estimated(
            (y + noise * rng.normal(size=y.shape) for y in horizontal),
            (y + noise * rng.normal(size=y.shape) for y in vertical),
            H,
        )
        errors.append((relative(got.left, left) ** 2, relative(got.right, right) ** 2))
        claims.append(got.predicted_error)
        estimates.append(got.noise)
    measured = np.sqrt(np.mean(errors, axis=0))
    a, v = np.linalg.norm(left.sum(axis=1)), np.linalg.norm(right.sum(axis=1))
    predicted = predicted_error(left, noise, v, N), predicted_error(right, noise, a, N)
    np.testing.assert_allclose(measured, predicted, rtol=0.05)
    np.testing.assert_allclose(np.mean(claims, axis=0), predicted, rtol=0.02)
    assert np.mean(estimates) == pytest.approx(noise, rel=0.01)


def test_dark_lines_flag_factors_and_twins_that_patterns_resolve_do_not():
    left, right = factors()
    left[:, 1] = left[:, 0]
    got = estimated(*responses(left, right), H)
    assert got.condition == np.inf and got.rank == (N - 1, N) and got.ok
    assert "uniform light alone leaves 1 directions of scene rows" in str(got.status)
    assert "which dots resolve (--patterns dots:7)" in str(got.status)
    left[:, 1] = 0
    got = estimated(*responses(left, right), H)
    assert not got.ok and str(got.status).startswith("Factors are rank deficient: 1 scene rows")


def flatcam(pixel_mm, order=9):
    """Weights and factors of both terms of a FlatCam mask at 2 mm, scene 120 mm wide at 400 mm."""
    mask = mls_mask("flatcam", order=order)
    pixels, scene = centred_edges(64, pixel_mm), centred_edges(N, 120 / N)
    rest = mask.feature_mm, pixels, scene, 2.0, 400.0
    return [(weight, scene_factor(profile, *rest)) for weight, profile, _ in mask.terms]


def flatcam_frame(terms, image):
    return sum(weight * factor @ image @ factor.T for weight, factor in terms)


def flatcam_round_trip(terms, image):
    ones = np.ones(N)
    got = estimated(
        [flatcam_frame(terms, np.outer(h, ones)) for h in H.T],
        [flatcam_frame(terms, np.outer(ones, h)) for h in H.T],
        H,
        centre=True,
    )
    prepared = prepare(got.left, got.right, np.ones((N, 1)), np.ones((N, 1)), centre=True)
    sums = prepared.accumulator()
    sums.add(flatcam_frame(terms, image), 0, 0)
    return got, prepared.solve(sums, 0.0)


def test_centred_flatcam_is_separable_and_recovers_the_image():
    # The mask (30.7 mm) covers the sensor's view (7 mm): the constant term has equal rows.
    image = np.random.default_rng(3).random((N, N))
    got, solution = flatcam_round_trip(flatcam(0.1), image)
    assert got.separability_residual < 1e-12
    np.testing.assert_allclose(solution.image, image, atol=1e-8)
    assert solution.residual < 1e-6
    plain = estimated(
        [flatcam_frame(flatcam(0.1), np.outer(h, np.ones(N))) for h in H.T],
        [flatcam_frame(flatcam(0.1), np.outer(np.ones(N), h)) for h in H.T],
        H,
    )
    assert not plain.ok


def test_flatcam_leak_where_the_mask_does_not_cover_the_view():
    # 127 features of 60 um are 7.6 mm; a sensor of 9.6 mm sees past the edge. What centring leaves of the
    # constant term is then (C Phi_1) X (C Phi_1)^T / 2, and calibration reports it as a residual.
    terms = flatcam(0.15, order=7)
    image = np.random.default_rng(3).random((N, N))
    centre = np.eye(64) - 1 / 64
    outline, code = (centre @ factor for _, factor in terms)
    leak = outline @ image @ outline.T / 2
    whole = centre @ flatcam_frame(terms, image) @ centre
    np.testing.assert_allclose(whole, code @ image @ code.T / 2 + leak, atol=1e-12)
    assert np.linalg.norm(leak) > 0.05 * np.linalg.norm(whole)
    got, _ = flatcam_round_trip(terms, image)
    assert got.separability_residual > 0.05


def test_a_dark_session_is_refused():
    with pytest.raises(MitsimError, match="zero everywhere"):
        estimated([DARK] * N, [DARK] * N, H)


# ---- large sensors ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("next_one", [0.0, 0.02, 0.5, 0.99, 1.0])
@pytest.mark.parametrize("shape", [(90, 70), (1, 5), (40, 60)])
def test_a_uniform_response_is_split_as_its_svd_would_be(shape, next_one):
    """Nearly of rank one, where power iteration converges, or not, where the SVD itself is taken; ``next_one`` is the
    second singular value over the first. (Planted: one step of the iteration; its start taken for the vector.)"""
    rng = np.random.default_rng(7)
    size = min(shape)
    left, right = (np.linalg.qr(rng.standard_normal((length, size)))[0] for length in shape)
    values = np.append(3.0, 3.0 * next_one * np.linspace(1, 0.5, size - 1) if size > 1 else [])
    mean = (left * values) @ right.T
    a, v = _rank_one_split(mean)
    assert np.linalg.norm(a) == pytest.approx(np.linalg.norm(v), rel=1e-12) and a.sum() > 0
    if next_one < 1 or size == 1:
        np.testing.assert_allclose(np.outer(a, v), 3.0 * np.outer(left[:, 0], right[:, 0]), atol=1e-11)
    assert np.linalg.norm(mean @ v) == pytest.approx(3.0 * np.linalg.norm(v), rel=1e-12)


@pytest.mark.parametrize("centre", [False, True])
@pytest.mark.parametrize("side", [0, 1])
def test_the_light_of_a_pair_is_projected_as_its_response_is(side: int, centre: bool) -> None:
    """(Planted: the sum is projected on the other side's vector; its mean is left in where responses are centred.)"""
    rng = np.random.default_rng(3)
    one, other = rng.random((2, 30, 30))
    both = stripe_sums(np.outer(one[0], one[1]), np.outer(one[0], one[1]), 2, centre)
    own = both[side]
    seen = own.fit_response(one - other, one + other)
    again = own.fit_response(one + other)
    np.testing.assert_allclose(seen.light, again.vector, atol=1e-12)
    own.put(seen)
    np.testing.assert_array_equal(own.lights, np.stack([np.zeros(30), seen.light], axis=1))
    assert not both[1 - side].lights.size


@pytest.mark.parametrize("side", [0, 1])
def test_ambient_light_is_measured_across_the_common_vector(side: int) -> None:
    """Even light and light tilted along either side, whatever the response is. (Planted: tilts exchanged.)"""
    rng, (rows, columns) = np.random.default_rng(2), (30, 40)
    left, right = rng.random(rows) + 1, rng.random(columns) + 1
    y, x = np.linspace(-1, 1, rows), np.linspace(-1, 1, columns)
    both = stripe_sums(np.outer(left, right), np.outer(left, right), 2)
    shown = np.outer(rng.standard_normal(rows), right) if side == 0 else np.outer(left, rng.standard_normal(columns))
    ambient = 0.3 + 0.2 * y[:, None] - 0.1 * x
    own, light = both[side], AmbientLight(both[side].common, (rows, columns)[side])
    seen = own.fit_response(shown + ambient)
    np.testing.assert_allclose(seen.ambient, [0.3, *((0.2, -0.1) if side == 0 else (-0.1, 0.2))], rtol=1e-9)
    taken = seen.vector - light.effects.T @ seen.ambient
    np.testing.assert_allclose(taken, own.fit_response(shown).vector, rtol=1e-9)
    np.testing.assert_allclose(light.energies(seen.ambient[None]), [seen.misfit], rtol=1e-6)


def test_a_uniform_response_whose_frames_are_exchanged_is_turned() -> None:
    """(Planted: both are averaged as they are, so that nothing is left.)"""
    horizontal, vertical = responses(*factors())
    right, turned = (stripe_sums(sign * horizontal[0], vertical[0], N) for sign in (1, -1))
    for own, other in zip(right, turned, strict=True):
        np.testing.assert_allclose(own.common, other.common)
