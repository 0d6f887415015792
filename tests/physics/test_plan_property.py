"""The property that makes the plan honest: the total error of what it chose, measured apart, keeps the accuracy.

All of it: effects left out, anchors, layers and cells, sampling (:mod:`tests.physics.plan_property`). An error whose
lower bound (95 %) is above the accuracy fails. That nothing cheaper would do
is held by tests/unit/planner/test_choice.py.
"""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.devices.patterns import Lighting
from mitsim.planner.planner import make_plan
from tests.physics.plan_property import SampleWork, answer, planned, total_error

pytestmark = pytest.mark.usefixtures("variant")
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
    check(small, "dots:4", 5e-2, of_small(small, SampleWork(64, 128)))


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
