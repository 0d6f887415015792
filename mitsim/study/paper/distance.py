"""How far the mask is from the sensor: 500 to 2000 um, and on to where diffraction ends the shadow.

Paper, section IV-C and figure 5: mean PSNR of eight test images by the number of dots.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from mitsim.study.charts import curves, image_grid
from mitsim.study.compare import label
from mitsim.study.experiment import Claim, Experiment, Found, Point, Results, Scope
from mitsim.study.paper.measure import captioned, confirmed, imaged, said, stated
from mitsim.study.studio import EQUAL_FRAME, EQUAL_PEAK, IDEALISED, MODELS, RENDERED, Studio
from mitsim.study.table import Value

DISTANCES_MM = (0.5, 0.75, 1.0, 2.0, 4.0, 8.0)
"""The paper's four; features of 60 um have a Fresnel number of 3.2 at 2 mm and of 0.8 at 8 mm."""
_FEW_MM = (0.75, 2.0)  # the two that the paper gives decibels of
FAMILIES = ("uniform", "dots:5", "dots:7")
_NEAR_UNIFORM, _NEAR_DOTS = (16.9, 19.0), (30.0, 30.5)
"""Decibels in the paper's figure 5, mask at 750 um."""


def _points(scope: Scope) -> Sequence[Point]:
    """The families at each distance, on every print, in both models."""
    return [
        Point.of(
            scope.setup.changed(mask_distance=distance).printed(name),
            model=model, patterns=family, exposure=exposure, seed=seed,
        )
        for distance in scope.chosen(DISTANCES_MM, _FEW_MM)
        for name in scope.pictures
        for seed in scope.seeds
        for family in FAMILIES
        for exposure in (EQUAL_PEAK, EQUAL_FRAME)
        for model in MODELS
    ]  # fmt: skip


def _measure(studio: Studio, point: Point) -> Found:
    """Image and quality."""
    return imaged(studio, point, shown=("uniform", "dots:7"))


def _claims(results: Results) -> Sequence[Claim]:
    """The paper's."""
    near = Results(results.table.where(mask_distance="0.75"), results.images)
    return [
        stated(near, "At 750 um, uniform light gives 16.9 to 19 dB", _NEAR_UNIFORM, patterns="uniform"),
        stated(near, "At 750 um, 49 dots give 30 to 30.5 dB", _NEAR_DOTS, patterns="dots:7"),
        _as_good(results),
    ]


def _as_good(results: Results) -> Claim:
    """25 dots at 750 um are comparable to uniform light at 2000 um."""
    told: dict[str, list[str]] = {model: [] for model in MODELS}
    holds: list[Value] = []
    exposures = results.table.distinct("exposure")
    for exposure in exposures:
        pairs = [
            (
                results.table.mean("psnr_db", model=model, exposure=exposure, mask_distance="0.75", patterns="dots:5"),
                results.table.mean("psnr_db", model=model, exposure=exposure, mask_distance="2.0", patterns="uniform"),
            )
            for model in (IDEALISED, RENDERED)
        ]
        for model, (dots, uniform) in zip((IDEALISED, RENDERED), pairs, strict=True):
            told[model].append(f"{exposure}: {said(dots)} against {said(uniform)}")
        if all(dots.value > uniform.value - 1 for dots, uniform in pairs):
            holds.append(exposure)
    return Claim(
        "25 dots at 750 um are comparable to uniform light at 2000 um (no more than 1 dB below)", "comparable",
        "; ".join(told[IDEALISED]), "; ".join(told[RENDERED]), confirmed(holds, exposures),
    )  # fmt: skip


def _figures(results: Results) -> Mapping[str, Figure]:
    """PSNR by distance, and images."""
    table, drawn = results.table, {}
    for exposure in table.distinct("exposure"):
        panels = {
            model: {
                label(family): {
                    float(distance): table.mean(
                        "psnr_db", model=model, exposure=exposure, patterns=family, mask_distance=distance
                    )
                    for distance in table.distinct("mask_distance")
                }
                for family in FAMILIES
            }
            for model in MODELS
        }
        drawn[f"psnr_{exposure.replace(' ', '_')}.png"] = curves(panels, f"sensor to mask [mm], {exposure}", log=True)
    for family in ("uniform", "dots:7"):
        shown = table.distinct("mask_distance")
        grid = captioned(results, "mask_distance", shown, patterns=family, exposure=EQUAL_FRAME)
        if grid:
            drawn[f"images_{family.replace(':', '')}.png"] = image_grid(grid, [f"{each} mm" for each in shown])
    return drawn


EXPERIMENT = Experiment(
    name="distance",
    title="How far the mask is from the sensor",
    question="What does a thin camera cost, and how much of it do patterns give back?",
    points=_points,
    measure=_measure,
    claims=_claims,
    figures=_figures,
)
