"""How many sensor pixels: 512, 256, 128 and 64 a side, the last two with fewer data than unknowns in a single frame.

Paper, section V-D and its supplement: frames are binned by averaging after capture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from mitsim.report import EQUAL_PEAK, MODELS
from mitsim.report.charts import curves, image_grid
from mitsim.report.compare import label
from mitsim.report.table import Mean, Table
from mitsim.studies.framework.claims import (
    Holds,
    by_patterns,
    by_print,
    difference,
    found,
    judged,
    panels,
    pictured,
    sampled,
    within,
)
from mitsim.studies.framework.experiment import Claim, Experiment, Found, Results, Scope
from mitsim.studies.framework.setup import Point
from mitsim.studies.framework.studio import Image, Studio

BINNINGS = (1, 2, 4, 8)
"""Pixels a side that are averaged: the paper's 512 to 64 pixels a side."""
_FINE, _COARSE = BINNINGS[0], BINNINGS[-1]
FAMILIES = ("uniform", "dots:5", "dots:7")
_SHOWN = ("uniform", "dots:7")
_STABLE_DB = 3.0
"""What an image may lose and still be called stable: half of its squared error is then as before."""


def _points(scope: Scope) -> Sequence[Point]:
    return [
        Point.of(scope.setup.printed(name), model=model, patterns=family, binning=binning, seed=seed)
        for name in scope.pictures
        for seed in scope.seeds
        for family in scope.chosen(FAMILIES, _SHOWN)
        for binning in scope.chosen(BINNINGS, (_FINE, _COARSE))
        for model in MODELS
    ]


def _measure(studio: Studio, point: Point) -> Found:
    binning = int(point["binning"])
    frames = studio.frames(point.setup, point["model"], point["patterns"], int(point["seed"]))
    # With fewer data than unknowns noise cannot be told, nor lambda chosen by it.
    image = Image.of(frames, frames.seconds(EQUAL_PEAK), "best", binning)
    pixels = frames.lit.bench.geometry.frame_shape[0] // binning
    return found(point, image.image if point["patterns"] in _SHOWN else None, pixels=pixels, **image.row())


def _claims(results: Results) -> Sequence[Claim]:
    def lost(family: str, rows: Table) -> tuple[str, Mean]:
        fine, coarse = (rows.where(patterns=family, binning=binning) for binning in (_FINE, _COARSE))
        loss = difference(fine, coarse, "psnr_db")
        return f"{sampled(fine, 'psnr_db')} to {sampled(coarse, 'psnr_db')} dB: {loss} dB lost", loss

    def stable(rows: Table) -> tuple[str, Holds]:
        said, loss = lost("dots:7", rows)
        return said, within(loss, high=_STABLE_DB)

    def degrades(rows: Table) -> tuple[str, Holds]:
        said, loss = lost("uniform", rows)
        return said, within(loss, low=0)

    def better(rows: Table) -> tuple[str, Holds]:
        dots, uniform = rows.where(patterns="dots:7", binning=_COARSE), rows.where(patterns="uniform", binning=_FINE)
        gain = difference(dots, uniform, "psnr_db")
        return f"{gain:+} dB", within(gain, low=0)

    table = results.table
    return [
        judged(table, "49 dots are stable down to 64 x 64 pixels (3 dB lost at most)", "stable", stable),
        judged(table, "Uniform light degrades with fewer pixels", "degrades", degrades),
        judged(table, "49 dots on 64 x 64 pixels are better than uniform light on 512 x 512", "better", better),
    ]


def _figures(results: Results) -> Mapping[str, Figure]:
    table = results.table
    drawn = {
        "psnr.png": curves(
            panels(by_patterns(table), "pixels"),
            "rows of the sensor [pixel]",
            log=True,
            title=f"PSNR by the sensor's rows, exposure {EQUAL_PEAK}",
        )
    }
    pixels = table.distinct("pixels")
    for family in _SHOWN:
        if grid := pictured(results, by_print(table.where(patterns=family)), "pixels", pixels):
            drawn[f"images_{family.replace(':', '')}.png"] = image_grid(
                grid, [f"{each} rows" for each in pixels], f"{label(family)}, {EQUAL_PEAK}, by sensor rows"
            )
    return drawn


EXPERIMENT = Experiment(
    "binning",
    "How many sensor pixels",
    "What is left where the sensor has fewer pixels than the image, with one frame and with 49?",
    _points, _measure, _claims, _figures,
)  # fmt: skip
