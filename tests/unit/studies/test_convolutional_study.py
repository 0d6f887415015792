"""The study of convolutional cameras on invented results: which claims hold, and for which point spread function."""

from __future__ import annotations

import pytest

from mitsim.acquire.reference import rendered_psf
from mitsim.report import EQUAL_FRAME, EQUAL_PEAK
from mitsim.studies.framework.experiment import Results, Scope, Setup, find_experiment

STUDY = find_experiment("convolutional")


def results(psfs: tuple[str, ...], dots_db: float = 41.0, direct_s: float = 0.3) -> Results:
    rows: list[dict[str, object]] = []
    for psf in psfs:
        for patterns, decibels in ((1, 22.0), (49, dots_db)):
            for exposure, more in ((EQUAL_PEAK, 15.0 * (patterns > 1)), (EQUAL_FRAME, 0.0)):
                row = {"part": "quality", "psf": psf, "patterns": patterns, "exposure": exposure}
                rows += [
                    {**row, "psnr_db": decibels + more, "point": "", "picture": name} for name in ("page", "coins")
                ]
        for patterns, seconds in ((1, 0.4), (25, direct_s), (49, direct_s)):
            row = {"part": "speed", "sensor": "all light", "psf": psf, "patterns": patterns, "point": ""}
            rows.append({**row, "iterative_s": 4.0, "direct_s": seconds, "separable_s": 0.2})
    return Results(rows)  # type: ignore[arg-type]


@pytest.mark.parametrize("psfs", [("rendered",), ("measured", "rendered")])
def test_claims_of_invented_results(psfs: tuple[str, ...]) -> None:
    """Dots within the paper's figures at equal frame alone; uniform light, which is no dots, does not count against the
    direct solver. (Planted: uniform light counted; either exposure enough.)"""
    uniform, dots, slower, direct, even_so = STUDY.judge(results(psfs))
    assert uniform.verdict == "confirmed" and dots.verdict == "confirmed only at equal frame"
    assert slower.verdict == direct.verdict == even_so.verdict == "confirmed"
    assert direct.rendered == "13 times as long"
    assert bool(direct.idealised) == (len(psfs) == 2) and "-D psf=FILE" in STUDY.note


def test_a_slow_direct_solver_and_dim_dots_are_told() -> None:
    _, dots, _, direct, _ = STUDY.judge(results(("rendered",), dots_db=30.0, direct_s=0.5))
    assert direct.verdict == "not confirmed" and dots.verdict == "confirmed only at equal peak"
    assert STUDY.judge(results(("rendered",), dots_db=50.0))[1].verdict == "not confirmed"


def test_a_cropped_sensor_is_told_apart() -> None:
    """(Planted: races of both sensors in one ratio.)"""
    whole = results(("rendered",))
    races = (row for count in (25, 49) for row in whole.rows if row["part"] == "speed" and row["patterns"] == count)
    cropped = [{**row, "sensor": "cropped", "direct_s": 2.0} for row in races]
    _, _, _, direct, at_the_edge, _ = STUDY.judge(Results([*whole.rows, *cropped]))
    assert direct.verdict == "confirmed" and at_the_edge.verdict == "not confirmed"
    assert at_the_edge.rendered == "2 times as long"


def test_a_measured_point_spread_function_is_a_parameter_of_the_study_alone() -> None:
    """No scene is given it, or Mitsuba would refuse it."""
    points = STUDY.points(Scope(Setup(parameters=(("psf", "psf.tif"), ("sheet_z", "400"))), ("page",), quick=True))
    assert {point.setup.parameters for point in points} == {(("sheet_z", "400"),)}
    assert {(point["psf"], point["file"]) for point in points} == {("measured", "psf.tif"), ("rendered", None)}


def test_a_rendered_point_spread_function_has_a_sum_of_one(variant: str) -> None:
    psf = rendered_psf((30, 40), 0.234, variant, rays=256)
    assert psf.shape == (30, 40) and psf.sum() == pytest.approx(1) and psf.min() >= 0
    assert psf.max() > 5 * psf.mean(), "caustics"
