"""The demo on a bench of one's own, and the line that a report shows for a scene."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.bench.request import Request
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.light.plan import Plan
from mitsim.studies.demo import demo, scene_line

pytestmark = pytest.mark.usefixtures("draft_figures")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("<!-- A sheet at 0.90 m, e.g. white. Second\nsentence. --><scene/>", "room: A sheet at 0.90 m, e.g. white."),
        ('<?xml version="1.0"?>\n<scene version="3.0.0">\n<!-- Two\n  lines -->', "room: Two lines"),
        ('<scene><default name="a" value="1"/><!-- mm, how far --></scene>', "room"),
        ("<scene><!-- --></scene>", "room"),
        ("<scene/>", "room"),
    ],
)
def test_first_sentence_of_the_opening_comment(tmp_path: Path, text: str, line: str) -> None:
    path = tmp_path / "room" / "scene.xml"
    path.parent.mkdir()
    path.write_text(text, encoding="utf-8")
    assert scene_line(path) == line


@pytest.mark.parametrize(("patterns", "planned"), [("dots:2", "dots:5"), ("uniform", "dots:5"), ("dots:7", "dots:7")])
def test_light_is_planned_for_the_sparsest_family_that_is_shown(
    small_scene: Callable[..., Path], variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    patterns: str, planned: str,
) -> None:  # fmt: skip
    """Of others the plan does not tell what it leaves. (Planted: the main family's plan.)"""

    def trace(bench: Bench, plan: Plan, job: Job) -> None:
        raise MitsimError(f"traced for {plan.known_request.patterns} at {plan.accuracy:g}")

    monkeypatch.setattr("mitsim.studies.demo.trace_request", trace)
    bench = open_bench(small_scene(), variant)
    with pytest.raises(MitsimError, match=f"^traced for {planned} at 0.2$"):
        demo(bench, tmp_path / "demo", Request.of(patterns=patterns, accuracy=0.2))


def test_what_does_not_fit_is_refused_before_an_earlier_demo_is_removed(
    shared_scene: Callable[..., Path], variant: str, tmp_path: Path
) -> None:
    earlier = tmp_path / "demo"
    earlier.mkdir()
    (earlier / "demo.json").write_text('{"kind": "demo"}')
    (earlier / "report.html").write_text("yesterday's")
    bench = open_bench(shared_scene("refused", n=16), variant)
    with pytest.raises(MitsimError, match="dots:17"):
        demo(bench, earlier, Request.of(patterns="dots:17"))
    bottomless = replace(
        bench, devices=replace(bench.devices, sensor=bench.sensor.model_copy(update={"full_well_e": np.inf}))
    )
    with pytest.raises(MitsimError, match="full_well_e is inf"):
        demo(bottomless, earlier, Request.of(patterns="dots:2"))
    assert (earlier / "report.html").read_text() == "yesterday's"
