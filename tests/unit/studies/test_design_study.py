"""The design study: its points, rows of one point on a small scene, and claims of invented results."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsim.core.job import Job
from mitsim.design.goal import Goal
from mitsim.design.masks import Candidate, Choice
from mitsim.design.search import Found
from mitsim.report import RENDERED
from mitsim.studies.design_study import MASKS, PREDICTED
from mitsim.studies.framework.experiment import TRUTH, Point, Results, Scope, Setup, find_experiment
from mitsim.studies.framework.studio import Studio
from mitsim.studies.mask_design import prove

STUDY = find_experiment("design")


def test_points_are_all_doses_and_frames_with_three_seeds() -> None:
    whole, few, own = (
        STUDY.points(Scope(Setup(camera=camera), ("page",), seeds=(4,), quick=quick))
        for camera, quick in ((None, False), (None, True), ("imx250", True))
    )
    assert len({point.key for point in whole}) == len(whole) == 6 * 4 * 3 and len(few) == 3 * 3
    assert {point["seed"] for point in few} == {4, 5, 6}
    assert [points[0].setup.camera for points in (whole, few, own)] == [None, "small", "imx250"]
    assert {(point.setup.picture, point.setup.accuracy) for point in whole} == {(None, 3e-4)}


def test_a_point_has_each_mask_predicted_and_rendered(shared_scene: Callable[..., Path], variant: str) -> None:
    y, x = np.mgrid[:32, :32] / 32
    print_ = np.rint(125 + 100 * np.sin(7 * y + 2 * x) * np.cos(9 * x)).astype(int)
    setup = Setup(str(shared_scene("design", reflectance=print_)), variant=variant, accuracy=3e-2)
    point = Point.of(setup, patterns="dots:2", dose=0.1, evaluations=10, seed=1)
    with Studio() as studio:
        found = STUDY.measure(studio, point)
        bench = studio.bench(setup)
        full = bench.predict("dots:2")
        goal = Goal(scene=setup.scene, exposure_total_s=1.0, doses=(1.0, 0.1), judge="worst", seeds=2, accuracy=3e-2)
        exposures = (full.frames * full.exposure_s, 1.6 * full.exposure_s)
        choice, code = Choice(0.06, 2.0, "dots:2"), Found("own", np.ones(3), 1.0, 0)
        proved = prove(goal, Candidate("own", choice, code, exposures), Path("camera.toml"), Job(), bench)
    bright, dim = proved.cases
    assert (bright["dose"], dim["dose"], dim["exposure_total_s"]) == (1.0, 0.1, exposures[1])
    assert bright["psnr_rendered"] > proved.rendered == pytest.approx(dim["psnr_rendered"])
    assert bright["psnr_predicted"] > proved.predicted == dim["psnr_predicted"]
    assert bright["psnr_predicted"] == pytest.approx(full.psnr_db)
    rows: dict[tuple[Any, Any], Any] = {(row["mask"], row["model"]): row for row in found.rows}
    assert [*rows] == [(mask, model) for model in (PREDICTED, RENDERED) for mask in MASKS]
    for model in (PREDICTED, RENDERED):
        level, *simple = (rows[mask, model]["psnr_db"] for mask in MASKS)
        assert rows["design", model]["gain_db"] == pytest.approx(level - max(simple))
    for mask in MASKS:
        row = rows[mask, RENDERED]
        assert row["off_db"] == pytest.approx(row["psnr_db"] - rows[mask, PREDICTED]["psnr_db"])
        assert row["exposure_total_s"] == pytest.approx(0.1 * 4 * full.exposure_s) and row["frames"] == 4
    assert {*found.arrays} == {*MASKS, TRUTH}


@pytest.mark.parametrize(
    ("bright", "off", "verdicts"),
    [
        ({}, {}, ["confirmed"] * 4),
        ({"design": 47.0, "pinholes": 46.2}, {}, ["confirmed", "not confirmed", "not confirmed", "confirmed"]),
        ({}, {("dots:7", 0.1, "random"): -0.8}, ["confirmed", "confirmed", "confirmed", "not confirmed"]),
    ],
)
def test_claims(bright: dict[str, float], off: dict[tuple[str, float, str], float], verdicts: list[str]) -> None:
    levels = {
        ("dots:7", 1.0): dict(zip(MASKS, (56.0, 55.4, 56.1, 51.4), strict=True)) | bright,
        ("dots:7", 0.1): dict(zip(MASKS, (48.5, 46.5, 45.9, 44.8), strict=True)),
        ("dots:3", 0.1): dict(zip(MASKS, (26.0, 25.9, 25.8, 25.0), strict=True)),
    }
    rows = [
        {"patterns": patterns, "frames": 49 if patterns == "dots:7" else 9, "dose": dose, "seed": seed, "mask": mask,
         "model": model, "psnr_db": level + 0.01 * seed + (missed if model == RENDERED else 0),
         "gain_db": 2.0 + 0.01 * seed if mask == "design" else None, "off_db": missed if model == RENDERED else None,
         "case": f"{mask}, {patterns}, {dose}"}
        for (patterns, dose), masks in levels.items()
        for mask, level in masks.items()
        for missed in [off.get((patterns, dose, mask), 0.0)]
        for model in (PREDICTED, RENDERED)
        for seed in range(3)
    ]  # fmt: skip
    results = Results(rows)
    assert [claim.verdict for claim in STUDY.judge(results)] == verdicts
    assert {*STUDY.draw(results)} == {"gain_by_dose.png", "gain_by_frames.png", "masks.png"}
    (table,) = STUDY.parts(results)
    assert table.head[1:3] == ("design, predicted", "design, rendered") and table.rows[0][0] == "49 frames, dose 1"
