"""Frames of light over sharp lobes against quadrature: a flat plate from 3e-3 to 1e-4, a ball, and the mirror's limit.

The judge is an integral over the lit surface that nothing of mitsim has a part in (:func:`lobe` for the plate). Frames
are compared on a grid of sensor points; the gate is five times the error that the run predicts, Monte Carlo and
systematic.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.devices.patterns import Lighting
from mitsim.light.light import SampledLight, Sampling, trace_light
from mitsim.planner.planner import make_plan
from tests.hard.hard_light import PLACE, SCALE, SPECULAR, glossy, lobe

N, PIXELS, SIGMAS = 32, 64, 5.0
ALONE = {"interreflection": False, "diffraction": False}


@pytest.fixture
def traced(small_scene: Callable[..., Path], variant: str) -> Callable[..., SampledLight]:
    """Light of a scene under uniform light on an open sensor of 6.4 mm."""

    def trace(accuracy: float, seed: int = 0, **numbers: object) -> SampledLight:
        path = small_scene("lobes", n=N, mask="open", pitch=0.1, **{"sheet_z": -500, **numbers})
        bench = open_bench(path, variant, for_render=True)
        lighting = Lighting.uniform(N)
        plan = make_plan(bench, lighting, accuracy, seed, ALONE)
        return trace_light(bench, plan, lighting, seed, Sampling(by_pixel=False))

    return trace


def frame(light: SampledLight) -> np.ndarray:
    return next(iter(light.frames(Lighting.uniform(N), 0))).irradiance


def predicted(light: SampledLight) -> float:
    return float(np.hypot(light.sampling_error, light.plan.systematic_error))


def points(bench: Bench, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices of some pixels, and where they are."""
    index = np.arange(step // 2, PIXELS, step)
    return index, bench.geometry.centres(1)[index]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("alpha", "accuracy"), [(3e-2, 5e-3), (1e-2, 5e-3), (3e-3, 1e-2), (1e-3, 1e-2), (3e-4, 1e-2), (1e-4, 2e-2)]
)
def test_a_plate_of_any_roughness(traced: Callable[..., SampledLight], alpha: float, accuracy: float) -> None:
    light = traced(accuracy, **glossy(alpha, sheet=False))
    index, place = points(light.bench, 6)
    expected = np.array([[lobe(alpha, row, column) for column in place] for row in place])
    found = frame(light)[np.ix_(index, index)]
    error = float(np.linalg.norm(found - expected) / np.linalg.norm(expected))
    assert light.reached and not light.warnings
    assert error < SIGMAS * predicted(light) < 0.15
    if alpha <= 1e-3:
        # Energy against the limit: the mirror's, but for the lobe's tails beyond the plate and the window.
        assert found[4:-4, 4:-4].mean() == pytest.approx(SPECULAR, rel=SIGMAS * predicted(light))
        assert light.plan.settings.sharp is not None


BALL, RADIUS = np.array([10.0, 5.0, 370.0]), 20.0


def on_ball(alpha: float, sensor: np.ndarray, count: int = 700) -> float:
    """Irradiance that a metal ball casts on a sensor point: the sum over even rays about its highlight.

    60 lobes' widths to each side leave 1 / (1 + 60^2) of the light; some six rays a width.

    GGX (Walter et al. 2007) with Smith's shadowing, Fresnel 1; the projector puts pi scale dp dq into its tan-angles.
    """
    source = np.array([PLACE, 0, 0])
    half = sum(direction / np.linalg.norm(direction) for direction in (source - BALL, sensor - BALL))
    top = BALL + RADIUS * half / np.linalg.norm(half) - source
    reach = min(60 * alpha * RADIUS / top[2], 0.07)
    even = np.linspace(-reach, reach, count)
    p, q = np.meshgrid(top[0] / top[2] + even, top[1] / top[2] + even, indexing="ij")
    ray = np.stack([p, q, np.ones_like(p)], axis=-1)
    a, b = np.square(ray).sum(-1), ray @ (source - BALL)
    inside = b**2 - a * (np.square(source - BALL).sum() - RADIUS**2)
    hit = (inside > 0) & (p > -0.3) & (p < 0) & (abs(q) < 0.15)
    point = source + ray[hit] * ((-b[hit] - np.sqrt(inside[hit])) / a[hit])[:, None]
    normal = (point - BALL) / RADIUS
    i = source - point
    o = sensor - point
    r = np.linalg.norm(o, axis=-1)
    i, o = i / np.linalg.norm(i, axis=-1)[:, None], o / r[:, None]
    h = (i + o) / np.linalg.norm(i + o, axis=-1)[:, None]
    cos_i, cos_o, cos_h = ((each * normal).sum(-1) for each in (i, o, h))
    tan2 = lambda cosine: 1 / cosine**2 - 1  # noqa: E731
    lit = (cos_i > 1e-3) & (cos_o > 1e-3)
    d = 1 / (np.pi * alpha**2 * cos_h**4 * (1 + tan2(cos_h) / alpha**2) ** 2)
    g = [2 / (1 + np.sqrt(1 + alpha**2 * tan2(np.clip(cosine, 1e-3, 1)))) for cosine in (cos_i, cos_o)]
    # f cos_o / cos_i times the flux, which is what arrives on the surface times cos_i; then the sensor's cosine.
    emitted = np.where(lit, d * g[0] * g[1] / (4 * np.abs(cos_i)) * np.abs(o[:, 2]) / r**2, 0)
    return float(np.pi * SCALE * emitted.sum() * (even[1] - even[0]) ** 2)


@pytest.mark.parametrize(("alpha", "accuracy"), [(2e-2, 1e-2), (5e-3, 1e-2)])
@pytest.mark.slow
def test_a_ball(traced: Callable[..., SampledLight], alpha: float, accuracy: float) -> None:
    """A highlight that one or two of the projector's pixels light."""
    place = '<point name="center" x="10" y="5" z="370"/><float name="radius" value="20"/>'
    rough = f'<string name="distribution" value="ggx"/><float name="alpha" value="{alpha}"/>'
    metal = f'<bsdf type="roughconductor"><string name="material" value="none"/>{rough}</bsdf>'
    light = traced(accuracy, extra=f'<shape type="sphere">{place}{metal}</shape>')
    index, centres = points(light.bench, 22)
    expected = np.array([[on_ball(alpha, np.array([-column, -row, 0])) for column in centres] for row in centres])
    found = frame(light)[np.ix_(index, index)]
    assert light.reached and not light.warnings
    assert light.plan.settings.sharp is not None and len(light.plan.settings.sharp.pixels) < 20
    error = float(np.linalg.norm(found - expected) / np.linalg.norm(expected))
    assert error < SIGMAS * predicted(light) < 0.1


@pytest.mark.slow
def test_matt_scenes_pay_nothing(small_scene: Callable[..., Path], variant: str) -> None:
    bench = open_bench(small_scene("matt", n=N, pitch=0.1, **glossy(0.3)), variant, for_render=True)
    assert make_plan(bench, Lighting.uniform(N), 1e-2, 0, ALONE).settings.sharp is None
