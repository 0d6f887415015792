"""How many sensor pixels: 512, 256, 128 and 64 a side, the last two with fewer data than unknowns in a single frame.

Paper, section V-D and its supplement: frames are binned by averaging after capture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from mitsim.study.charts import curves, image_grid
from mitsim.study.compare import label
from mitsim.study.experiment import Claim, Experiment, Found, Point, Results, Scope, thumbnail
from mitsim.study.paper.measure import captioned, image_name, said
from mitsim.study.pictures import QUICK_IMAGES
from mitsim.study.studio import IDEALISED, MODELS, RENDERED, Studio

BINNINGS = (1, 2, 4, 8)
"""Pixels a side that are averaged: the paper's 512 to 64 pixels a side."""
FAMILIES = ("uniform", "dots:5", "dots:7")
_STABLE_DB = 3.0
"""What an image may lose and still be called stable: half of its squared error is then as before."""


def _points(scope: Scope) -> Sequence[Point]:
    return [
        Point.of(scope.setup.printed(name), model=model, patterns=family, binning=binning, seed=seed)
        for name in scope.pictures
        for seed in scope.seeds
        for family in scope.chosen(FAMILIES, ("uniform", "dots:7"))
        for binning in scope.chosen(BINNINGS, (1, 8))
        for model in MODELS
    ]


def _measure(studio: Studio, point: Point) -> Found:
    setup, binning = point.setup, int(point["binning"])
    shoot = studio.shoot(setup, point["model"], point["patterns"], int(point["seed"]))
    # With fewer data than unknowns noise cannot be told, nor lambda chosen by it.
    found = shoot.image(shoot.peak_s, "best", binning)
    pixels = studio.bench(setup).geometry.pixels // binning
    row = {"picture": setup.picture, **dict(setup.parameters), **dict(point.values), "pixels": pixels, **found.row()}
    shown = setup.picture in (*QUICK_IMAGES, None) and point["patterns"] != "dots:5"
    images = {image_name(row): thumbnail(found.image)} if shown else {}
    return Found((row,), images)


def _claims(results: Results) -> Sequence[Claim]:
    means = {
        (model, family, binning): results.table.mean("psnr_db", model=model, patterns=family, binning=binning)
        for model in MODELS
        for family in ("uniform", "dots:7")
        for binning in (BINNINGS[0], BINNINGS[-1])
    }

    def told(family: str) -> list[str]:
        return [
            " to ".join(said(means[model, family, binning]) for binning in (1, 8)) for model in (IDEALISED, RENDERED)
        ]

    lost = {
        (model, family): means[model, family, 1].value - means[model, family, 8].value
        for model in MODELS
        for family in ("uniform", "dots:7")
    }
    holds = [model for model in MODELS if lost[model, "dots:7"] <= _STABLE_DB]
    degrades = all(lost[model, "uniform"] > 0 for model in MODELS)
    better = all(means[model, "dots:7", 8].value > means[model, "uniform", 1].value for model in MODELS)
    stable = "confirmed" if len(holds) == 2 else f"confirmed only {holds[0]}" if holds else "not confirmed"
    gains = [f"{means[model, 'dots:7', 8].value - means[model, 'uniform', 1].value:+.1f} dB" for model in MODELS]
    dots, uniform = told("dots:7"), told("uniform")
    return [
        Claim("49 dots are stable down to 64 x 64 pixels (3 dB lost at most)", "stable", dots[0], dots[1], stable),
        Claim(
            "Uniform light degrades with fewer pixels", "degrades", uniform[0], uniform[1],
            "confirmed" if degrades else "not confirmed",
        ),
        Claim(
            "49 dots on 64 x 64 pixels are better than uniform light on 512 x 512", "better",
            gains[0], gains[1],
            "confirmed" if better else "not confirmed",
        ),
    ]  # fmt: skip


def _figures(results: Results) -> Mapping[str, Figure]:
    table = results.table
    panels = {
        model: {
            label(family): table.means("psnr_db", "pixels", model=model, patterns=family)
            for family in table.distinct("patterns")
        }
        for model in MODELS
    }
    drawn = {"psnr.png": curves(panels, "sensor pixels a side, equal peak", log=True)}
    for family in ("uniform", "dots:7"):
        shown = table.distinct("binning")
        grid = captioned(results, "binning", shown, patterns=family)
        pixels = [table.where(binning=binning).distinct("pixels")[0] for binning in shown]
        if grid:
            drawn[f"images_{family.replace(':', '')}.png"] = image_grid(grid, [f"{each} x {each}" for each in pixels])
    return drawn


EXPERIMENT = Experiment(
    name="binning",
    title="How many sensor pixels",
    question="What is left where the sensor has fewer pixels than the image, with one frame and with 49?",
    points=_points,
    measure=_measure,
    claims=_claims,
    figures=_figures,
)
