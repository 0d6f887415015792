"""The demo on a bench of one's own, and the line that a report shows for a scene."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsim.acquire import capture
from mitsim.api.bench import Bench, open_bench
from mitsim.bench.request import Request
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.core.runs import load_run
from mitsim.light import light
from mitsim.light.plan import Plan
from mitsim.metrics import psnr
from mitsim.reconstruct.factors import Factors, load_calibration
from mitsim.reconstruct.reconstruct import reconstruct
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


@pytest.mark.slow
def test_the_scene_is_traced_once_and_a_speckled_projector_shows_in_every_family(
    shared_scene: Callable[..., Path], variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The main family's image is the one of the run folder: same light, speckle and noise (once, it had no speckle)."""
    projector = tmp_path / "laser.toml"
    projector.write_text('name = "laser"\neffective_wavelength_nm = 562.0\nspeckle_contrast = 0.1\n')
    print_ = np.random.default_rng(4).integers(40, 256, (16, 16))
    bench = open_bench(shared_scene("speckled", n=16, reflectance=print_), variant, projector=projector)
    traced = []

    def counted(*arguments: Any, **options: Any) -> light.SampledLight:
        traced.append(arguments)
        return light.trace_light(*arguments, **options)

    monkeypatch.setattr(capture, "trace_light", counted)
    monkeypatch.setattr(capture, "trace_lines", lambda *_: pytest.fail("traced anew"))
    calibrate = Bench.calibrate

    def without_figures(*arguments: Any, **options: Any) -> Factors:
        """As of a camera that can hardly be calibrated: what is not finite is None in JSON."""
        factors = calibrate(*arguments, **options)
        unknown = dict.fromkeys(("unexplained_residual", "condition", "phi_error"))
        manifest = factors.manifest.model_copy(update={"result": {**factors.manifest.result, **unknown}})
        return replace(factors, manifest=manifest)

    monkeypatch.setattr(Bench, "calibrate", without_figures)
    job = Job()
    result = demo(bench, tmp_path / "demo", Request.of(patterns="dots:2", accuracy=2e-2, seed=3), job)
    assert len(traced) == 1
    page = (tmp_path / "demo" / "report.html").read_text(encoding="utf-8")
    assert "<b>\N{EN DASH}</b>" in page and re.search(r"<title>Comparison of patterns: \w+, [^<]+, \d{4}-\d\d-", page)
    assert tuple(result.psnr) == ("uniform", "dots:4", "dots:5", "dots:2", "hadamard:8")
    assert result.gain_db == result.psnr["dots:2"] - result.psnr["uniform"]
    shots = load_run(tmp_path / "demo" / "run")
    image = reconstruct(shots, load_calibration(tmp_path / "demo" / "calibration"))
    assert shots.truth is not None
    assert psnr(image.image, shots.truth) == pytest.approx(result.psnr["dots:2"], abs=1e-3)
    assert result.trust.keys() == result.psnr.keys()
    trust, error = result.trust["dots:2"], image.image - shots.truth
    assert image.uncertainty is not None and image.misfit is not None
    assert trust["rms_error"] == pytest.approx(10 ** (-result.psnr["dots:2"] / 20))
    assert trust["uncertainty"] == pytest.approx(np.sqrt(np.mean(image.uncertainty**2)))
    assert trust["within_95"] == np.mean(np.abs(error) <= 1.96 * image.uncertainty)
    assert trust["chi_square"] == pytest.approx(image.misfit.chi_square)
    assert bool(trust["cause"]) == image.misfit.flagged
    assert {"plan", "transport", "calibration sensor", "compare families", "report"} <= job.clock.seconds().keys()
    assert any("4 dots" in line for line in result.lines()) and result.report in result.lines()[1]


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
