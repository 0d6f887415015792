"""Light beside the centres of its pixels, against factors that are moved, and what halves of the sensor tell of it."""

import numpy as np
import pytest

from mitsim.core.runs import Capture
from mitsim.devices.camera import centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.devices.patterns import parse_patterns
from mitsim.reconstruct.accumulation import Model, accumulate, disagreement, factor_slope
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.reconstruct.solver import prepare
from mitsim.reconstruct.uncertainty import Propagation
from tests.ideal_sessions import PITCH, PIXELS, Bench, N, shadow
from tests.shadow_factor import scene_factor

FINE = 8
"""Parts of a scene pixel's side."""


def fine_shadow(count: int = FINE * N, moved: float = 0.0) -> np.ndarray:
    """(PIXELS, ``count``) shadow of each part of the scene's pixels, ``moved`` by so many mm; its mean over a pixel is
    the ideal camera's."""
    edges = centred_edges(count, 120 / count) + moved
    return scene_factor(mls_mask().terms[0][1], 0.06, centred_edges(PIXELS, PITCH), edges, 2.0, 400.0)


def squares(seed: int) -> np.ndarray:
    """(FINE N, FINE N) print of 60 squares of any grey, their edges anywhere within pixels."""
    rng, print_ = np.random.default_rng([seed, 3]), np.full((FINE * N, FINE * N), 0.5)
    for _ in range(60):
        (y, x), size = rng.integers(0, FINE * N, 2), rng.integers(4, 40)
        print_[y : y + size, x : x + size] = rng.uniform(0.05, 0.95)
    return print_


def test_a_single_pixel_has_no_neighbour() -> None:
    factor, one = np.random.default_rng(0).random((12, 1)), np.ones((1, 1))
    assert not Model(prepare(factor, factor, one, one), (factor, factor), (one, one)).moved[0].any()


@pytest.mark.parametrize("step", [-3.0, 0.4, 2.3])
def test_the_slope_of_a_moving_shadow(step: float) -> None:
    """Waves of 10 to 40 sensor pixels that move by ``step`` of them from scene pixel to scene pixel: the exact slope is
    -step times that along the sensor, to 10 % rms (differences over two of 10 pixels are short of it by 6 %).

    Neighbours that are 2.3 and 3 pixels on tell 43 and 70 % less of the shortest wave. (Planted: always neighbours; the
    sign turned.)
    """
    rng, place = np.random.default_rng(1), np.arange(80)[:, None] - step * np.arange(20)
    waves = [(2 * np.pi / length, rng.uniform(0, 6)) for length in rng.uniform(10, 40, 12)]
    factor = sum(np.sin(k * place + phase) for k, phase in waves)
    exact = sum(-step * k * np.cos(k * place + phase) for k, phase in waves)
    error = (factor_slope(factor) - exact)[2:-2, 1:-1]
    assert np.sqrt(np.square(error).mean() / np.square(exact).mean()) < 0.1


@pytest.mark.parametrize("patterns", ["uniform", "dots:4", "hadamard:4", "random:3"])
def test_disagreement_is_the_energy_of_the_image_error(patterns: str) -> None:
    """Independent dipoles in all pixels, no noise: over 200 draws their error of the image, and what halves tell of it.

    Each draw has some 100 independent numbers in each, so the ratio is good to sqrt(4 / 20 000) = 1.5 %; where small
    sigma rule (uniform light) to 10 %. (Planted: the second half's response for the first's, with a
    sign; half of what the whole tells left in.)
    """
    rng, family = np.random.default_rng(5), parse_patterns(patterns, N, 0)
    factors, (P_L, P_R) = (shadow(), shadow(0.37)), (family.left.astype(float), family.right.astype(float))
    factors = factors[0], 2 * factors[1]
    prepared = prepare(*factors, P_L, P_R)
    sigma = np.outer(prepared.left.singular, prepared.right.singular)
    gain = sigma / (sigma**2 + 1e-4 * sigma.max() ** 2)
    model = Model(prepared, factors, (P_L, P_R))
    slopes, zero, struck, reported = model.slopes, np.zeros((N, N)), 0.0, 0.0
    for _ in range(200):
        rows, columns = 0.5 * rng.standard_normal((N, N)), 2 * rng.standard_normal((N, N))
        sums, image = prepared.accumulator(), rng.random((N, N))
        for i, left in enumerate(P_L.T):
            for j, right in enumerate(P_R.T):
                lit = np.outer(left, right)
                light = factors[0] @ (lit * image) @ factors[1].T + slopes[0] @ (lit * rows) @ factors[1].T
                sums.add(light + factors[0] @ (lit * columns) @ slopes[1].T, i, j)
        problem = prepared.problem(sums)
        expected = prepared.image(gain * sigma * prepared.coefficients(image))
        struck += np.square(prepared.image(gain * problem.projected) - expected).mean()
        reported += disagreement(model, gain, problem.halves, (zero, zero)).mean()
    assert reported == pytest.approx(struck, rel=0.1 if patterns == "uniform" else 0.06)


def test_noise_alone_is_no_disagreement() -> None:
    """20 sessions of an even scene with noise in frames and factors, two sides: above 3 standard deviations are 2 and 0
    sessions. (Planted: the factors' noise left out.)"""
    camera, reported = Bench(shadow(), shadow()), 0
    for seed in range(20):
        shots, factors = camera.run("dots:4", np.full((N, N), 0.7), seed), camera.calibrated(seed, 0.01)
        sums, image = accumulate(shots, factors), reconstruct(shots, factors, 1e-9)
        propagation = Propagation(sums.model, 1e-9)
        frames = propagation.of_frames(sums.noise.rows, sums.noise.columns)
        assert factors.manifest.noise and image.ok
        left, right = propagation.of_factors(factors.manifest.noise, image.image)
        halves = sums.prepared.problem(sums.frames).halves
        assert halves
        reported += disagreement(propagation.model, propagation.gain, halves, (frames + left, frames + right)).any()
    assert reported <= 3


def test_print_within_pixels_is_covered() -> None:
    """20 prints of squares whose edges lie anywhere within a pixel of 7.5 mm: 95 % of truths within 1.96 u.

    A print's errors hang together by its edges: single prints spread by 2 %, the mean of 20 by 0.5 %. That light moves
    by its dipole leaves a tenth of the error's energy out, and slopes are told to a fifth: 2 % more. The power and the
    place of all frames are known, as of a simulated run. (Planted: what halves tell left out; its ratio to the image's
    error set to 1.)
    """
    fine, coarse = fine_shadow() / FINE, shadow()
    assert fine.reshape(PIXELS, N, FINE).sum(axis=2) == pytest.approx(coarse, rel=1e-9, abs=1e-9)
    camera, inside = Bench(fine, fine, parts=FINE), []
    for seed in range(20):
        print_ = squares(seed)
        shots = camera.run("dots:4", print_, seed)
        simulated = shots.manifest.model_copy(update={"plan": {"systematic_error": 0.0}})
        image = reconstruct(Capture(simulated, memory=shots._memory), Bench(coarse, coarse).calibrated(seed), 1e-9)
        truth = print_.reshape(N, FINE, N, FINE).mean(axis=(1, 3))
        assert image.uncertainty is not None
        inside.append(np.mean(np.abs(image.image - truth) < 1.96 * image.uncertainty))
    assert np.mean(inside) == pytest.approx(0.95, abs=0.025)


def test_light_of_one_side_weighs_the_dipoles_of_the_other() -> None:
    """Sides as unlike as a mask lets them be: singular values of columns fall over two decades, those of rows over one.

    Dipoles along columns alone, uniform light, lambda in the midst of the values; 200 draws, 10 % as for uniform light
    above. (Planted: the sides' light exchanged, 28 % less; where both fall alike that changes nothing.)
    """
    rng, P = np.random.default_rng(6), np.ones((N, 1))
    u, _, v = np.linalg.svd(shadow(0.37), full_matrices=False)
    factors = shadow(), (u * np.geomspace(1, 1e-2, N)) @ v
    prepared = prepare(*factors, P, P)
    sigma = np.outer(prepared.left.singular, prepared.right.singular)
    gain = sigma / (sigma**2 + 1e-4 * sigma.max() ** 2)
    model, zero, struck, reported = Model(prepared, factors, (P, P)), np.zeros((N, N)), 0.0, 0.0
    for _ in range(200):
        sums = prepared.accumulator()
        sums.add(factors[0] @ rng.standard_normal((N, N)) @ model.slopes[1].T, 0, 0)
        problem = prepared.problem(sums)
        struck += np.square(prepared.image(gain * problem.projected)).mean()
        reported += disagreement(model, gain, problem.halves, (zero, zero)).mean()
    assert reported == pytest.approx(struck, rel=0.1)
