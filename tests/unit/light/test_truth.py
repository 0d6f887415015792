"""The truth against exact answers in float64, its stated standard error, and streams that frames do not share.

Scenes of 16 x 16 projector pixels, seeds stated; 3.182 is the 97.5 % quantile of Student's t with the three degrees of
freedom of four groups.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.bench.effects import EFFECTS
from mitsim.core.arrays import mean_of_neighbours
from mitsim.devices.patterns import parse_patterns
from mitsim.light import light as module
from mitsim.light.cost_model import TRUTH_SAMPLES
from mitsim.light.light import Sampling, Truth, trace_light, trace_truth
from mitsim.light.settings import GROUPS, Settings
from mitsim.planner.planner import make_plan

pytestmark = pytest.mark.usefixtures("kept_plans")
N, SHEET, HALF_SENSOR, Z = 16, 128.0, 32 * 0.01172, 400.0
INSIDE = 3.182
CARD_AT, CARD_HALF = np.array([10.0, -8.0, 345.0]), np.array([21.3, 33.7])
_Z, _Y = np.deg2rad(25.0), np.deg2rad(35.0)
TURN = np.array([[np.cos(_Y), 0, np.sin(_Y)], [0, 1, 0], [-np.sin(_Y), 0, np.cos(_Y)]]) @ np.array(
    [[np.cos(_Z), -np.sin(_Z), 0], [np.sin(_Z), np.cos(_Z), 0], [0, 0, 1]]
)
CARD = """<shape type="rectangle">
    <transform name="to_world">
        <scale x="21.3" y="33.7"/> <rotate z="1" angle="25"/> <rotate y="1" angle="35"/>
        <translate x="10" y="-8" z="345"/>
    </transform>
    <bsdf type="twosided"><bsdf type="diffuse"><spectrum name="reflectance" value="0.3"/></bsdf></bsdf>
</shape>"""


@pytest.fixture(scope="module")
def printed() -> np.ndarray:
    """8-bit print of 57 x 57 texels: no edge of a texel falls on the edge of a projector pixel."""
    return np.random.default_rng(4).integers(20, 256, (57, 57))


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path], variant: str, printed: np.ndarray) -> Bench:
    return open_bench(shared_scene("truth", reflectance=printed), variant)


@pytest.fixture(scope="module")
def shadowed(shared_scene: Callable[..., Path], variant: str) -> Bench:
    """A turned card before the sheet: its edges, its shadow, and what it hides from the sensor."""
    return open_bench(shared_scene("shadowed", extra=CARD), variant)


def exact(reflectance: np.ndarray, card: bool = False, steps: int = 6) -> np.ndarray:
    """(N, N) apparent reflectance by midpoints, ``steps`` a side of each piece of a texel that a pixel lights.

    A ray of the pinhole at x = 60 mm meets the card or the sheet at P; per flux, a diffuse surface of reflectance rho
    irradiates the sensor with rho / pi |n . omega| cos_a / r^2, unless the card is between. 2 x 2 Gaussian points stand
    for the sensor.
    """
    place, share, texel = _midpoints(len(reflectance), steps)
    y, x = np.meshgrid(-place, -place, indexing="ij")
    point = np.stack([x, y, np.full_like(x, Z)], axis=-1)
    scene, board, straight = np.zeros((N, N)), np.zeros((N, N)), np.array([0.0, 0.0, 1.0])
    hit, rho, met, normal = np.zeros(x.shape, bool), reflectance[np.ix_(texel, texel)], point, straight
    if card:
        eye = np.array([60.0, 0.0, 0.0])
        way = _met(eye, point)
        hit = np.isfinite(way)
        met = np.where(hit[..., None], eye + np.where(hit, way, 0)[..., None] * (point - eye), point)
        rho, normal = np.where(hit, 0.3, rho), np.where(hit[..., None], TURN[:, 2], straight)
    nodes, weights = np.polynomial.legendre.leggauss(2)
    for a, weight_a in zip(nodes * HALF_SENSOR, weights, strict=True):
        for b, weight_b in zip(nodes * HALF_SENSOR, weights, strict=True):
            sensor, weight = np.array([a, b, 0.0]), weight_a * weight_b
            seen = _received(met, normal, sensor) * rho
            if card:
                seen *= hit | ~np.isfinite(_met(sensor, met))
            scene += weight * share @ seen @ share.T
            board += weight * share @ (0.99 * _received(point, straight, sensor)) @ share.T
    return scene / board


def _midpoints(texels: int, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places [mm] along a side of the window, (N, places) the part of each pixel that they stand for, their texels."""
    pixels, edges = np.linspace(-60, 60, N + 1), np.linspace(-SHEET / 2, SHEET / 2, texels + 1)
    cuts = np.union1d(pixels, edges[np.abs(edges) < 60])
    inner = (np.arange(steps) + 0.5) / steps
    place = (cuts[:-1, None] + np.diff(cuts)[:, None] * inner).ravel()
    share = np.zeros((N, len(place)))
    share[np.searchsorted(pixels, place) - 1, np.arange(len(place))] = np.repeat(np.diff(cuts), steps) / steps
    return place, share, np.searchsorted(edges, place) - 1


def _received(point: np.ndarray, normal: np.ndarray, sensor: np.ndarray) -> np.ndarray:
    way = sensor - point
    squared = (way**2).sum(axis=-1)
    return np.abs((normal * way).sum(axis=-1)) * np.abs(way[..., 2]) / squared**2


def _met(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Part of the way from ``start`` to ``end`` (..., 3) at which the card is met; nan where it is not."""
    along = end - start
    share = ((CARD_AT - start) @ TURN[:, 2]) / (along @ TURN[:, 2])
    local = (start + share[..., None] * along - CARD_AT) @ TURN[:, :2]
    inside = (np.abs(local) <= CARD_HALF).all(axis=-1) & (share < 1 - 1e-9)
    return np.where(inside, share, np.nan)


def traced(bench: Bench, seed: int, frames_error: float) -> Truth:
    """The truth that is good enough for frames whose every pixel is off by ``frames_error`` of the board."""
    unit = trace_truth(bench, Settings(Z), 99, np.full(N * N, np.inf)).board_flux
    return trace_truth(bench, Settings(Z), seed, frames_error * unit)


def check(found: Truth, answer: np.ndarray) -> None:
    """The error is the stated one to 20 % in rms over 256 pixels (4.5 standard errors; a stop at the goal makes it 5 %
    optimistic); and 95 % of the exact answers lie within the interval, to 4 binomial deviations."""
    error = found.reflectance - answer
    assert np.sqrt(np.mean(error**2)) == pytest.approx(found.error, rel=0.2)
    inside = np.abs(error) <= INSIDE * found.standard_error
    assert inside.mean() == pytest.approx(0.95, abs=4 * np.sqrt(0.05 * 0.95 / N**2))


@pytest.mark.parametrize("seed", [0, 1])
def test_a_print_is_exact_to_its_standard_error(bench: Bench, printed: np.ndarray, seed: int) -> None:
    """(Planted: standard error without the root of the groups' number; the same samples again when refined.)"""
    found = traced(bench, seed, 3e-3)
    assert found.error <= 3e-3 / 6
    check(found, exact(printed / 255))


def test_a_scene_in_depth_is_exact_to_its_standard_error(shadowed: Bench) -> None:
    """Some 50 pixels at the card's edges hold the error: 40 % are 4 standard errors of its rms.

    Single ones may be off by more than they say: where an edge cuts the same part off the samples of all groups.
    """
    found, answer = traced(shadowed, 0, 2e-2), exact(np.full((16, 16), 0.5), card=True, steps=36)
    error = found.reflectance - answer
    assert 30 < (found.standard_error > 2e-4).sum() < 80 and np.ptp(answer) > 0.4
    assert np.sqrt(np.mean(error**2)) == pytest.approx(found.error, rel=0.4)
    assert np.median(np.abs(error)) < 2e-4


def test_it_shares_no_error_with_the_frames(bench: Bench, printed: np.ndarray) -> None:
    """Correlation over 256 pixels, with as many samples of each, below 4 / 16. (Planted: the frames' streams.)"""
    lighting = parse_patterns("dots:4", N).lighting
    plan = make_plan(bench, lighting, 1e-2, 0, dict.fromkeys(EFFECTS, False))
    plan = replace(plan, settings=replace(plan.settings, samples={"direct": float(TRUTH_SAMPLES)}))
    light = trace_light(bench, replace(plan, sampling_target=np.inf), lighting, 3, Sampling(by_pixel=False))
    assert light.paths == GROUPS * N**2 * TRUTH_SAMPLES, "the first round is what was predicted"
    found, answer = trace_truth(bench, plan.settings, 3, np.full(N * N, np.inf)), exact(printed / 255)
    of_frames = (light.flux / found.board_flux).reshape(N, N) - answer
    of_truth = found.reflectance - answer
    assert np.sqrt(np.mean(of_frames**2)) == pytest.approx(np.sqrt(np.mean(of_truth**2)), rel=0.5)
    assert abs(np.corrcoef(of_frames.ravel(), of_truth.ravel())[0, 1]) < 4 / N


def test_it_is_refined_as_far_as_the_frames_need(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sixth of what the frames' light is off by, where that takes no more rays than it may."""
    rough, fine = (traced(bench, 0, error) for error in (3e-2, 2e-3))
    assert rough.error <= 3e-2 / 6 and fine.error <= 2e-3 / 6 < rough.error
    assert rough.rays < fine.rays
    monkeypatch.setattr(module, "_FINEST", 5e-3)
    assert traced(bench, 0, 0.0).rays == pytest.approx(rough.rays, rel=0.05), "exact frames need no exact truth"


def test_pixels_without_light_have_no_truth_and_no_error(bench: Bench, small_scene: Callable[..., Path]) -> None:
    """A field stop of 12 degrees hides the window's edge, board and print alike: 0, not nan."""
    found = traced(open_bench(small_scene(n=N, fov=12)), 0, 0.2)
    dark = found.board_flux.reshape(N, N) == 0
    assert 0 < dark.sum() < N**2 / 2
    assert not found.reflectance[dark].any() and not found.standard_error[dark].any()
    assert found.reflectance[4:12, 4:12] == pytest.approx(0.5 / 0.99, rel=5e-3)


class KnownFlux(module._Flux):
    """Flux whose variances (n^2,) are known and fall as the square of the samples."""

    def __init__(self, variances: np.ndarray) -> None:
        self._samples, self._first = np.full(len(variances), 16), 16
        self._shape, self.variances = (math.isqrt(len(variances)),) * 2, variances

    @property
    def left(self) -> np.ndarray:
        return np.asarray(self.variances * (self._samples / 16.0) ** -2)

    @property
    def standard_error(self) -> np.ndarray:
        return np.sqrt(self.left)[None]

    def _sample(self, wanted: np.ndarray) -> None:
        self._samples = wanted


def test_rays_of_the_truth_go_where_they_lower_its_error_most() -> None:
    """Variances of 1024 pixels differ by factors of thousands, the errors are to be a fifth. Doubling the samples of a
    pixel lowers its variance by three quarters. The reached variance is within 4 % of the wanted one, and no rays are
    wasted: what one more doubling brings for its rays is alike in all pixels to the factor 8 of a whole doubling.
    (Planted: variances that fall faster; a part above one.)"""
    variances = np.exp(3 * np.random.default_rng(2).normal(size=1024))
    likely = variances + mean_of_neighbours(variances.reshape(32, 32)).ravel()
    known = KnownFlux(likely + 0.01 * likely.mean())
    wanted = np.sqrt(known.left.mean()) / 5
    known.refine(np.ones(1024), np.array([wanted]), variances)
    assert 0.92 < known.left.mean() / wanted**2 <= 1
    worth = known.left / known._samples
    grown = known._samples > 16
    assert grown.sum() > 30 and worth.max() <= 8 * worth[grown].min() * (1 + 1e-9)
