"""Rows of the accuracy study by the number of surfaces: in a diffuse sphere each keeps the albedo of the one before."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from mitsim.api.bench import open_bench
from mitsim.core.job import Job
from mitsim.light.settings import Approximation
from mitsim.studies import accuracy_findings
from mitsim.studies.accuracy_findings import Budget, PartCost, Spread
from mitsim.studies.accuracy_parts import Judge, Orders, Stand, with_samples
from mitsim.studies.accuracy_study import PARENT
from tests.unit.transport.test_indirect import MATT, SPHERE

pytestmark = pytest.mark.usefixtures("variant", "kept_plans", "draft_figures")
RHO = 0.8


@pytest.mark.slow
def test_each_surface_keeps_the_albedo_of_the_light(shared_scene: Callable[..., Path]) -> None:
    """Light of order k is even in a sphere, so its frames are rho times those of order k - 1, and all after them
    rho / (1 - rho) times; together they are what the pilot says of the effect. What they take is never negative.

    (Planted: a row's order one too high; the orders after the last row left out; half of the looks' mean.)
    """
    sphere = SPHERE.format(bsdf=MATT.replace("0.5", str(RHO)))
    bench = open_bench(shared_scene("orders_of_study", extra=sphere, sheet_z=3000))
    stand = Stand(bench, bench.family("dots:2"), 5, Job(), 1e-2)
    plan = stand.plan(1e-2)
    judge = Judge.trace(stand, plan, 0.0)
    full = SimpleNamespace(settings=with_samples(plan.settings, 1024))
    orders = Orders(stand, judge, SimpleNamespace(full=full, seconds=0.0))
    assert not orders.costs
    orders.measure(Budget(600.0), 1.0)
    second, third, fourth, rest = orders.costs
    assert [each.label for each in (second, rest)] == [f"{PARENT}: 2 surfaces", f"{PARENT}: 5 or more"]
    for one, other, ratio in ((second, third, RHO), (third, fourth, RHO), (fourth, rest, RHO / (1 - RHO))):
        assert other.error_if_off / one.error_if_off == pytest.approx(ratio, rel=0.1)
    whole = stand.pilot_result.error(Approximation(PARENT))
    summed = sum(each.error_if_off for each in orders.costs)
    assert summed == pytest.approx(whole.value, abs=2 * (whole.bound - whole.value) + 0.1 * summed)
    for each in orders.costs:
        assert each.error_if_off < each.error_bound < 1.5 * each.error_if_off
        assert each.repeats == 1 and each.payload()["least_s"] >= 0 and each.payload()["of"] == PARENT
    assert second.without is not None and second.without.most == 0, "nothing else is followed"
    assert len(orders.timed) == 5


def test_rows_of_one_part_stand_by_their_names_in_the_chart() -> None:
    """With what they take, and a bound is drawn beside each error. (Planted: bounds in the order of the rows.)"""
    took, more = Spread.of([1.0, 1.1, 1.2]), Spread.of([3.0, 3.1, 3.2])
    rows = [
        PartCost("fog", 0.1, 0.2, more, took, True),
        PartCost("2 surfaces", 0.05, 0.06, took, None, False, of="fog"),
    ]
    (errors,) = accuracy_findings.part_chart(rows, 1e-3).axes
    names = [label.get_text() for label in errors.get_yticklabels()]
    assert names == ["fog: 2 surfaces, not timed, not planned", "fog, 2 s (1.8 to 2.2)"]
    ends = [path.vertices[:, 0].tolist() for path in errors.collections[-1].get_paths()]
    assert ends == [[0.05, 0.06], [0.1, 0.2]]
