"""The property that makes the effect plan honest, on the shipped scenes.

Switching on what the plan left off changes the expected frames by less than the accuracy; switching off what it put on
changes them by more. Changes are measured apart from the pilot (:mod:`tests.physics.plan_property`), on CAPTURES of the
49 captures of ``dots:7``, with bounds of 99 % each. A bound beyond the accuracy on the wrong side fails the test. Where
the accuracy lies between the bounds the property is undecided: allowed for changes within UNDECIDED of the accuracy,
where the pilot's own few captures and samples cannot tell either, and for few of them.
"""

import logging
from collections.abc import Callable
from functools import cache

import pytest

from mitsim.capture.bench import Bench
from mitsim.capture.effects import SWITCHES
from mitsim.capture.light import make_plan
from mitsim.capture.plan import Plan
from tests.physics.plan_property import Change, Effort, measured

pytestmark = pytest.mark.usefixtures("variant")
PATTERNS, CAPTURES = "dots:7", 4
PLANNED, MEASURED = 0, 4711
UNDECIDED, FEW = 0.25, 2
EFFORT = Effort(direct=32, other=32, layers=12)
SCENES = (
    *("photograph", "corner", "cards", "colour_chart", "compact_disc", "cookie_bag", "gift_card", "keystone"),
    *("lamp_bench", "metal_blade", "mirror", "resolution_target"),
)


def on(plan: Plan) -> set[str]:
    """Names of :data:`SWITCHES` that a plan has on."""
    numbers = {"anchors": plan.settings.anchors, "layers": len(plan.settings.depths)}
    return set(plan.settings.effects) | {name for name, count in numbers.items() if count > 1}


def verdict(change: Change, is_on: bool, accuracy: float) -> str:
    """Whether a measured change agrees with the plan."""
    if change.low <= accuracy <= change.high:
        return "undecided"
    return "holds" if (change.size > accuracy) == is_on else "violated"


def check(bench: Bench, accuracy: float, changes: dict[str, Change]) -> None:
    """The property at one accuracy."""
    plan = make_plan(bench, bench.family(PATTERNS).lighting, accuracy, PLANNED)
    planned = on(plan)
    nothing = Change(0.0, 0.0, 0.0)
    found = {name: (verdict(changes.get(name, nothing), name in planned, accuracy), name) for name in SWITCHES}
    said = "; ".join(
        f"{name} {'on' if name in planned else 'off'} {c.size:.2e} [{c.low:.2e}, {c.high:.2e}] {found[name][0]}"
        for name, c in changes.items()
    )
    logging.getLogger(__name__).info("%s at %g: %s", bench.loaded.path.parent.name, accuracy, said)
    assert not [name for word, name in found.values() if word == "violated"], said
    open_ = [name for word, name in found.values() if word == "undecided"]
    far = [name for name in open_ if abs(changes[name].size / accuracy - 1) > UNDECIDED]
    assert not far, f"too few samples to tell {far}: {said}"
    assert len(open_) <= FEW, said


@pytest.fixture(scope="module")
def changes(shipped_bench: Callable[..., Bench]) -> Callable[[str, Effort], dict[str, Change]]:
    """Measured once a scene: the same changes judge every accuracy."""

    @cache
    def measure(scene: str, effort: Effort) -> dict[str, Change]:
        bench = shipped_bench(scene)
        plan = make_plan(bench, bench.family(PATTERNS).lighting, 0.1, PLANNED)
        return measured(bench, PATTERNS, CAPTURES, plan.settings.depth, MEASURED, effort)

    return measure


@pytest.mark.slow
@pytest.mark.parametrize("accuracy", [1e-2, 1e-3, 1e-4])
@pytest.mark.parametrize("scene", SCENES)
def test_the_plan_keeps_its_word(
    shipped_bench: Callable[..., Bench], changes: Callable[..., dict[str, Change]], scene: str, accuracy: float
) -> None:
    check(shipped_bench(scene), accuracy, changes(scene, EFFORT))


def test_a_wrong_plan_is_seen() -> None:
    """The judge itself: a change beyond the accuracy counts against a plan without it, and the other way about."""
    large, small, between = Change(2e-3, 1.9e-3, 2.1e-3), Change(5e-4, 4e-4, 6e-4), Change(1.1e-3, 9e-4, 1.3e-3)
    assert verdict(large, True, 1e-3) == verdict(small, False, 1e-3) == "holds"
    assert verdict(large, False, 1e-3) == verdict(small, True, 1e-3) == "violated"
    assert verdict(between, True, 1e-3) == verdict(between, False, 1e-3) == "undecided"
