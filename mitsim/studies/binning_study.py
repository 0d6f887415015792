"""How many sensor pixels: 512, 256, 128 and 64 a side, the last two with fewer data than unknowns in a single frame.

Paper, section V-D and its supplement: frames are binned by averaging after capture.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from mitsim.report import EQUAL_PEAK, MODELS, label
from mitsim.report.pages import Value
from mitsim.report.plots import curves
from mitsim.studies.framework import claims
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
    return Point.grid(
        map(scope.setup.printed, scope.pictures),
        "model patterns binning seed",
        seed=scope.seeds,
        patterns=scope.chosen(FAMILIES, _SHOWN),
        binning=scope.chosen(BINNINGS, (_FINE, _COARSE)),
        model=MODELS,
    )


def _measure(studio: Studio, point: Point) -> Found:
    binning = int(point["binning"])
    frames = studio.frames(point.setup, point["model"], point["patterns"], int(point["seed"]))
    # With fewer data than unknowns noise cannot be told, nor lambda chosen by it.
    image = Image.of(frames, frames.seconds(EQUAL_PEAK), "best", binning)
    pixels = frames.lit.bench.geometry.frame_shape[0] // binning
    return claims.finding(point, image.image if point["patterns"] in _SHOWN else None, pixels=pixels, **image.row())


def _claims(results: Results) -> Sequence[Claim]:
    few, few_coarse, many, many_coarse = (
        dict[str, Value](patterns=family, binning=binning) for family in _SHOWN for binning in (_FINE, _COARSE)
    )
    lost, table = "{one} to {other} dB: {gain} dB lost", results.table
    stable = "49 dots are stable down to 64 x 64 pixels (3 dB lost at most)"
    better = "49 dots on 64 x 64 pixels are better than uniform light on 512 x 512"
    return [
        claims.gain_claim(table, stable, "stable", (many, many_coarse), lost, (-math.inf, _STABLE_DB)),
        claims.gain_claim(table, "Uniform light degrades with fewer pixels", "degrades", (few, few_coarse), lost),
        claims.gain_claim(table, better, "better", (many_coarse, few)),
    ]


def _figures(results: Results) -> Mapping[str, Figure]:
    table = results.table
    shown = claims.panels(claims.by_patterns(table), "pixels")
    title = f"PSNR by the sensor's rows, exposure {EQUAL_PEAK}"
    drawn = {"psnr.png": curves(shown, "rows of the sensor [pixel]", log=True, title=title)}
    pixels = table.distinct("pixels")
    for family in _SHOWN:
        lines, title = claims.by_print(table.where(patterns=family)), f"{label(family)}, {EQUAL_PEAK}, by sensor rows"
        names = [f"{each} rows" for each in pixels]
        drawn |= claims.images(f"images_{family.replace(':', '')}.png", results, lines, "pixels", pixels, title, names)
    return drawn


EXPERIMENT = Experiment(
    "binning",
    "How many sensor pixels",
    "What is left where the sensor has fewer pixels than the image, with one frame and with 49?",
    _points, _measure, _claims, _figures,
)  # fmt: skip
