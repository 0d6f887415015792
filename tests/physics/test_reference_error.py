"""The reference states its error: runs of several seeds scatter by it, and its points are random enough.

Rationale. Stratified points depend on each other within a pass, so the spread of its paths says nothing of
their mean; passes are independent, and their spread does. Expectation: two sums over all pixels (light as a whole, and
its slope along the rows), less their means over RUNS runs and divided by the stated error, have the chi-square of
RUNS - 1 degrees of freedom each. A run has 4 passes of 9 paths in 4096 pixels: a sum's stated error is good to a
percent. Seeds are fixed; alpha = 1e-4 for each bound, six bounds in all.

The anchor geometry gives the condition numbers it is known by.

Rationale: conditioning hangs on every digit of the geometry (the scene 2 mm further off doubles it), so
three numbers guard mask code, shadow, scale and block structure at once. Expectation: cond(A_L) = 7.03e6
under uniform light, 545 under 25 shifting dots, 92.6 under 64, each within 1 %.
"""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from mitsim.devices.camera import centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.reconstruct.solver import prepare
from tests.shadow_factor import scene_factor

RUNS, SPP, ALPHA = 16, 36, 1e-4
SLOPE = np.linspace(-1, 1, 64)[:, None, None] * np.ones((1, 64, 1))
Runs = Callable[[str], tuple[np.ndarray, np.ndarray]]


@pytest.fixture(scope="module")
def runs(shared_scene: Callable[..., Path], variant: str) -> Runs:
    """(RUNS, 2) sums of runs, and their stated errors: of `reference`, or where its paths stay "random"."""
    from mitsim.acquire.capture import reference
    from mitsim.api.bench import open_bench

    @cache
    def get(paths: str) -> tuple[np.ndarray, np.ndarray]:
        reflectance = np.kron(np.random.default_rng(2).integers(20, 220, (16, 16)), np.ones((2, 2)))
        loaded = open_bench(shared_scene(paths, reflectance=reflectance)).loaded
        if paths == "random":
            loaded.camera.stratify = lambda points: None
        sums, errors = [], []
        for seed in range(RUNS):
            mean, error = reference(loaded, SPP, seed)
            weights = (np.ones_like(mean), SLOPE)
            sums.append([(mean * weight).sum() for weight in weights])
            errors.append([np.sqrt(np.square(error * weight).sum()) for weight in weights])
        return np.array(sums), np.array(errors)

    return get


@pytest.mark.parametrize("paths", ["random", "stratified"])
def test_runs_scatter_by_the_stated_error(runs: Runs, paths: str) -> None:
    sums, errors = runs(paths)
    chi_square = np.square((sums - sums.mean(axis=0)) / errors).sum()
    for tail in (stats.chi2.sf, stats.chi2.cdf):
        assert tail(chi_square, 2 * (RUNS - 1)) > ALPHA


def test_stratified_paths_find_the_same_light_with_less_noise(runs: Runs) -> None:
    (plain, error), (even, smaller) = runs("random"), runs("stratified")
    z = (even - plain).mean(axis=0) / np.sqrt((error**2 + smaller**2).mean(axis=0) / RUNS)
    assert np.abs(z).max() < stats.norm.isf(ALPHA / 2)
    assert (smaller**2).mean() < 0.67 * (error**2).mean()


def test_no_two_numbers_of_a_path_know_of_each_other(variant: str) -> None:
    """Place in the pixel and on the mask: products of cosines of any two have the mean 0, at 4 and at 16 paths.

    Mitsuba's own multijittered and low-discrepancy points fail here (0.15 and 0.26 at 4 paths, 0.015 at 16): their
    permutations are no random ones, and light that depends on two of the numbers comes out wrong. N = 2^18 paths in
    independent sets of 4 or 16, of which the spread gives z; alpha = 1e-4 over the 28 pairs a count.
    """
    import mitsuba as mi

    camera = mi.load_dict(
        {
            "type": "mitsim_lensless",
            "mask": "open",
            "film": {"type": "hdrfilm", "width": 128, "height": 128, "rfilter": {"type": "box"}},
        }
    )
    for paths in (4, 16):
        lane = np.arange(128 * 128 * paths) // paths
        film = mi.Point2f((lane % 128 + 0.5) / 128, (lane // 128 + 0.5) / 128)
        camera.stratify((7, paths))
        ray, _ = camera.sample_ray(0.0, 0.5, film, mi.Point2f(0.5))
        camera.stratify(None)
        u = np.array(ray.o)[:2] / camera.geometry.half_width
        t = np.array(ray.d)[:2] / np.array(ray.d)[2] / camera.geometry.tan_half_fov
        numbers = np.concatenate([(1 - u) * 64 % 1, (1 - t) / 2])
        waves = np.concatenate([np.sqrt(2) * np.cos(np.pi * k * numbers) for k in (1, 2)])
        means = np.einsum("ip,jp->ijp", waves, waves).reshape(8, 8, -1, paths).mean(axis=3)
        z = means.mean(axis=2) / (means.std(axis=2) / (128 * 128) ** 0.5)
        assert np.abs(z[np.triu_indices(8, 1)]).max() < stats.norm.isf(ALPHA / 28 / 2)


@pytest.mark.parametrize(("k", "condition"), [(1, 7.03e6), (5, 545.0), (8, 92.6)])
def test_condition_numbers(k, condition):
    factor = scene_factor(
        mls_mask().terms[0][1], 0.06, centred_edges(512, 0.01172), centred_edges(128, 120 / 128), 2.0, 400.0
    )
    dots = (np.arange(128)[:, None] % k == np.arange(k)).astype(float)
    assert prepare(factor, factor, dots, dots).condition == pytest.approx(condition, rel=0.01)
