"""The demo on a bench of one's own, and the line that a report shows for a scene."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.bench.request import Request
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.light.plan import Plan
from mitsim.metrics import Quality
from mitsim.report import EQUAL_PEAK, IDEALISED, RENDERED
from mitsim.studies.demo import demo, doubts, results_of, scene_line, trust_of, verdict
from mitsim.studies.framework.studio import Image

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


# -------- The verdict


def images(ours: float, theirs: float, cause: str = "") -> dict[tuple[str, str, str], Image]:
    """Images of 49 dots and of uniform light with stated PSNR; the idealised gain is 12.9 dB."""

    def image(decibel: float, cause: str = "") -> Image:
        stated: Any = {"flagged": bool(cause), "reason": cause}, {"cause": cause}
        return Image(np.ones((4, 4)), Quality(decibel, None), 1.0, 1, 1.0, *stated)

    return {
        ("dots:7", RENDERED, EQUAL_PEAK): image(ours, cause), ("uniform", RENDERED, EQUAL_PEAK): image(theirs),
        ("dots:7", IDEALISED, EQUAL_PEAK): image(36.4), ("uniform", IDEALISED, EQUAL_PEAK): image(23.5),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("ours", "theirs", "cause", "headline"),
    [
        (31.8, 18.7, "", "49 dots beat uniform by 13.1 dB"),
        (31.8, 18.7, "depth", "49 dots beat uniform by 13.1 dB, but part of their light fits no image"),
        (19.0, 18.7, "", "49 dots: 0.3 dB above uniform"),
        (18.0, 18.7, "depth", "49 dots: 0.7 dB below uniform"),
        (-42.0, -65.3, "", "49 dots: no image, -42.0 dB"),
    ],
)
def test_a_gain_over_nothing_is_no_gain(ours: float, theirs: float, cause: str, headline: str) -> None:
    """A mirror's demo said that 9 dots beat uniform by 23.3 dB, of images at -42 and -65 dB. (Planted: "beat" by 0.3
    dB, and nothing of a misfit.)"""
    found = images(ours, theirs, cause)
    assert verdict(found, "dots:7") == (
        headline,
        f"{ours:.1f} against {theirs:.1f} dB PSNR, rendered light and calibrated factors. The idealised model says "
        "+12.9 dB.",
    )
    stated = doubts(found, "dots:7")
    assert (f"49 dots: {cause}" in stated) == bool(cause) and any("no image" in text for text in stated) == (ours < 0)
    assert verdict(found, "uniform")[0] == f"Uniform: {theirs:.1f} dB", "nothing to compare with"


def test_trust_compares_stated_and_actual_errors() -> None:
    """10 000 draws of normal noise of twice the stated deviation: 67 % lie within 1.96 stated ones, to 2 %. (Planted:
    the error held against one uncertainty.)"""
    error = 0.02 * np.random.default_rng(3).standard_normal((100, 100))
    image: Any = SimpleNamespace(image=0.5 + error, uncertainty=np.full((100, 100), 0.01), misfit=None)
    found = trust_of(image, np.full((100, 100), 0.5))
    assert found["uncertainty"] == pytest.approx(0.01) and found["rms_error"] == pytest.approx(0.02, rel=0.03)
    assert found["within_95"] == pytest.approx(0.673, abs=0.02) and found["cause"] is None
    assert trust_of(cast(Any, SimpleNamespace(uncertainty=None)), error) == {}


def test_rows_of_the_page_have_their_images() -> None:
    """(Planted: the image of another family.)"""
    results = results_of(images(31.8, 18.7), np.zeros((4, 4)))
    assert [row["psnr_db"] for row in results.rows] == [31.8, 18.7, 36.4, 23.5]
    assert all(results.array(row) is not None for row in results.rows)
