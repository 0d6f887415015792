"""Total error of frames, measured apart from the plan that chose how they are made: bench in, error and bounds out.

The answer is light of other seeds with every effect that the scene has, more anchors, layers and cells than the plan
asked for, in GROUPS independent groups. With a the frames and r_i, r_j two of the groups, the mean of
<a - r_i, a - r_j> / <r_i, r_j> is the squared relative error of a, free of the answer's noise; its standard error is
the jackknife's over groups. The frames of both are formed by the simulation, but judged on shots that the pilot does
not look at.

The property that makes the plan honest: the total error of what it chose, measured apart, keeps the accuracy.

All of it: effects left out, anchors, layers and cells, sampling. An error whose lower bound (95 %) is above the
accuracy fails. That nothing cheaper would do is held by tests/unit/planner/test_choice.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from mitsim.acquire.exposure import Totals
from mitsim.api.bench import Bench, open_bench
from mitsim.bench import effects
from mitsim.core.seeds import integer
from mitsim.devices.patterns import Lighting
from mitsim.light.light import Sampling, trace_light
from mitsim.light.passes import Simulation, expected_of
from mitsim.light.plan import Plan
from mitsim.light.settings import Estimate, Settings
from mitsim.planner.planner import make_plan

pytestmark = pytest.mark.usefixtures("variant")
GROUPS = 6
STUDENT = 2.02
"""One-sided 95 % of Student's distribution with GROUPS - 1 degrees of freedom."""


@dataclass(frozen=True)
class SampleWork:
    """Samples of one group, a projector pixel of direct light, a pixel or a cell of other light; numbers a side."""

    direct: int
    other: int
    anchors: int = 5
    followed_anchors: int = 3
    layers: int = 8
    cells: int = 4


@dataclass(frozen=True)
class Error:
    """Relative error, and the bounds that it stays within at 95 % each."""

    size: float
    low: float
    high: float


def answer(bench: Bench, shots: Lighting, depth: float, seed: int, sample_work: SampleWork) -> np.ndarray:
    """(groups, shots, pixels, pixels) frames with all that ``bench`` has, all ``depth`` [mm] of the light in layers."""
    names = frozenset(effects.present(bench)) - {"speckle"}
    base = Settings(depth, subdivision=sample_work.cells, effects=names, coarse_layers=True)
    base = replace(base, followed_anchors=sample_work.followed_anchors)
    settings = replace(base, anchors=sample_work.anchors, layers=_layers(bench, base, seed, sample_work.layers))
    simulation = Simulation(bench, settings, judging_cells=2)
    counts = {"direct": sample_work.direct, "anchor_residual": max(1, sample_work.direct // 4)}
    groups = []
    for group in range(GROUPS):
        parts = [
            simulation.accumulate(name, each.tracer.trace(integer(seed, name, group), 0, count), shots.labels, count)
            for name, each in simulation.passes.items()
            for count in [counts.get(name, sample_work.other)]
        ]
        groups.append(sum(parts[1:], parts[0]))
    rows = np.arange(shots.weights.shape[1])
    formed = [expected_of([(simulation, [group])], rows, shots, 0) for group in groups]
    return np.array([[frame.irradiance for frame in frames] for frames in formed])


def _layers(bench: Bench, base: Settings, seed: int, count: int) -> tuple[float, ...]:
    """Depths over the whole range that light is seen at; none for a flat scene."""
    simulation, own = Simulation(bench, base), integer(seed, "range")
    near = np.append(simulation.direct.trace(own, 0, 8).inverse_depth, simulation.follow(own, 8).inverse_depth)
    low, high = max(float(near.min()), 1e-4 / base.depth), float(near.max())
    return () if high < low * (1 + 1e-4) else tuple(1 / np.linspace(low, high, count))


def planned(bench: Bench, plan: Plan, shots: Lighting, seed: int) -> tuple[np.ndarray, Estimate]:
    """(shots, pixels, pixels) frames that ``plan`` makes, and their relative Monte Carlo error with its bound."""
    light = trace_light(bench, plan, shots, seed, Sampling(by_pixel=False))
    expected = list(light.frames(shots, seed))
    return np.stack([frame.irradiance for frame in expected]), Totals.of(expected).noise


def total_error(frames: np.ndarray, groups: np.ndarray) -> Error:
    """Error of ``frames`` against the answer's ``groups``."""
    differences, answers = (frames - groups).reshape(len(groups), -1), groups.reshape(len(groups), -1)
    products, energies = differences @ differences.T, answers @ answers.T

    def squared(kept: list[int]) -> float:
        pairs = np.ix_(kept, kept)
        off = ~np.eye(len(kept), dtype=bool)
        return float(products[pairs][off].mean() / energies[pairs][off].mean())

    everyone = list(range(len(groups)))
    found = squared(everyone)
    without = np.array([squared([i for i in everyone if i != out]) for out in everyone])
    spread = math.sqrt((len(without) - 1) * float(np.square(without - without.mean()).mean()))
    low, size, high = (math.sqrt(max(found + sign * STUDENT * spread, 0.0)) for sign in (-1, 0, 1))
    return Error(size, low, high)


PLANNED, ANSWERED = 0, 4711
_FEW = 16
SCENES = (
    *("photograph", "corner", "cards", "colour_chart", "compact_disc", "cookie_bag", "gift_card", "keystone"),
    *("lamp_bench", "metal_blade", "mirror", "resolution_target"),
)
BALL_AND_WALL = """<shape type="sphere"><point name="center" x="-25" y="10" z="330"/><float name="radius" value="30"/>
        <bsdf type="twosided"><bsdf type="diffuse"><spectrum name="reflectance" value="0.8"/></bsdf></bsdf></shape>
    <shape type="rectangle"><transform name="to_world"><scale x="60" y="60"/><rotate y="1" angle="90"/>
        <translate x="-50" z="350"/></transform>
        <bsdf type="twosided"><bsdf type="diffuse"><spectrum name="reflectance" value="0.8"/></bsdf></bsdf></shape>"""


def judged(bench: Bench, family: Lighting) -> Lighting:
    """All shots of few, or some that the pilot, which looks at an even spread from first to last, does not see.

    All where a mirror shows some of them only: in the others all light is that of black pixels, of any accuracy.
    """
    shots = len(family.weights)
    if shots <= _FEW or bench.loaded.mirrors:
        return family
    return family.shots(np.unique((np.array([0.12, 0.45, 0.78]) * shots).astype(int)))


def check(bench: Bench, patterns: str, accuracy: float, groups: np.ndarray) -> None:
    """The property at one accuracy."""
    family = bench.family(patterns).lighting
    plan = make_plan(bench, family, accuracy, PLANNED)
    frames, noise = planned(bench, plan, judged(bench, family), PLANNED)
    error, stated = total_error(frames, groups), plan.total(noise)
    reported = f"{error} against {stated}, settings {plan.settings}"
    assert not plan.warnings, plan.warnings
    assert stated.bound <= accuracy, reported
    assert error.low <= accuracy, reported
    assert error.high <= 1.5 * accuracy, f"too few samples to tell: {reported}"


@pytest.fixture(scope="module")
def small(shared_scene: Callable[..., Path], variant: str) -> Bench:
    print_ = np.random.default_rng(4).integers(20, 256, (48, 48))
    return open_bench(
        shared_scene("property", reflectance=print_, extra=BALL_AND_WALL, pitch=0.125, mask_feature=0.1),
        variant,
        for_render=True,
    )


def of_small(bench: Bench, sample_work: SampleWork) -> np.ndarray:
    """The answer that the small scene's frames are held against."""
    return answer(bench, judged(bench, bench.family("dots:4").lighting), 370.0, ANSWERED, sample_work)


@pytest.fixture(scope="module")
def small_answer(small: Bench) -> np.ndarray:
    return of_small(small, SampleWork(256, 512, cells=8))


def test_a_small_scene_keeps_a_loose_accuracy(small: Bench) -> None:
    """A ball before a print and a wall beside it, near a sensor of 8 mm: all discretisations count."""
    check(small, "dots:4", 5e-2, of_small(small, SampleWork(48, 96)))


@pytest.mark.slow
@pytest.mark.parametrize("accuracy", [5e-2, 1e-2])
def test_a_small_scene_keeps_its_accuracy(small: Bench, small_answer: np.ndarray, accuracy: float) -> None:
    """The same, against a finer answer."""
    check(small, "dots:4", accuracy, small_answer)


@pytest.mark.slow
def test_a_wrong_plan_is_seen(small: Bench, small_answer: np.ndarray) -> None:
    """The judge itself: without diffraction, or with one layer and anchor, the frames are off by what they change."""
    family = small.family("dots:4").lighting
    for switches in ({"diffraction": False}, {"layers": False, "anchors": False}):
        plan = make_plan(small, family, 1e-2, PLANNED, switches)
        frames, _ = planned(small, plan, judged(small, family), PLANNED)
        error = total_error(frames, small_answer)
        assert plan.warnings and error.low > 1e-2


@pytest.fixture(scope="module")
def answers(shipped_bench: Callable[..., Bench]) -> Callable[[str], np.ndarray]:
    """Measured once a scene: the same answer judges every accuracy."""

    @cache
    def measure(scene: str) -> np.ndarray:
        bench = shipped_bench(scene)
        family = bench.family("dots:7").lighting
        depth = make_plan(bench, family, 0.1, PLANNED).settings.depth
        return answer(bench, judged(bench, family), depth, ANSWERED, SampleWork(direct=32, other=32, layers=12))

    return measure


@pytest.mark.slow
@pytest.mark.parametrize("accuracy", [1e-2, 3e-3])
@pytest.mark.parametrize("scene", SCENES)
def test_the_plan_keeps_its_word(
    shipped_bench: Callable[..., Bench], answers: Callable[..., np.ndarray], scene: str, accuracy: float
) -> None:
    check(shipped_bench(scene), "dots:7", accuracy, answers(scene))
