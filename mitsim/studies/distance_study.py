"""How far the mask is from the sensor: 500 to 2000 um, and on to where diffraction ends the shadow.

Paper, section IV-C and figure 5: mean PSNR of eight test images by the number of dots.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from mitsim.report import EQUAL_FRAME, EQUAL_PEAK, MODELS, label
from mitsim.studies.framework import claims
from mitsim.studies.framework.experiment import Claim, Experiment, Found, Point, Results, Scope
from mitsim.studies.framework.studio import Studio

DISTANCES_MM = (0.5, 0.75, 1.0, 2.0, 4.0, 8.0)
"""The paper's four; features of 60 um have a Fresnel number of 3.2 at 2 mm and of 0.8 at 8 mm."""
_FEW_MM = (0.75, 2.0)  # the two that the paper gives decibels of
FAMILIES = ("uniform", "dots:5", "dots:7")
_NEAR_UNIFORM, _NEAR_DOTS = (16.9, 19.0), (30.0, 30.5)
"""Decibels in the paper's figure 5, mask at 750 um."""
_COMPARABLE_DB = 1.0
"""A difference that may be seen: a fifth of the squared error."""
_SHOWN = ("uniform", "dots:7")


def _points(scope: Scope) -> Sequence[Point]:
    return Point.grid(
        [
            scope.setup.changed(mask_distance=distance).printed(name)
            for distance in scope.chosen(DISTANCES_MM, _FEW_MM)
            for name in scope.pictures
        ],
        "model patterns exposure seed",
        seed=scope.seeds,
        patterns=FAMILIES,
        exposure=(EQUAL_PEAK, EQUAL_FRAME),
        model=MODELS,
    )


def _measure(studio: Studio, point: Point) -> Found:
    return claims.measure_image(studio, point, _SHOWN)


def _claims(results: Results) -> Sequence[Claim]:
    near = results.table.where(mask_distance="0.75")
    return [
        claims.psnr_claim(
            near.where(patterns="uniform"), "At 750 um, uniform light gives 16.9 to 19 dB", _NEAR_UNIFORM
        ),
        claims.psnr_claim(near.where(patterns="dots:7"), "At 750 um, 49 dots give 30 to 30.5 dB", _NEAR_DOTS),
        claims.gain_claim(
            results.table,
            f"25 dots at 750 um are comparable to uniform light at 2000 um (within {_COMPARABLE_DB:g} dB)",
            "comparable",
            ({"mask_distance": "0.75", "patterns": "dots:5"}, {"mask_distance": "2.0", "patterns": "uniform"}),
            "{one} against {other} dB: {gain:+} dB",
            (-_COMPARABLE_DB, _COMPARABLE_DB),
        ),
    ]


def _figures(results: Results) -> Mapping[str, Figure]:
    table, title = results.table, "PSNR by the mask's distance"
    drawn = dict(claims.by_exposure(table, claims.by_patterns, "mask_distance", "sensor to mask [mm]", title, log=True))
    distances = table.distinct("mask_distance")
    names = [f"{float(each):g} mm" for each in distances]
    for family in _SHOWN:
        shown = claims.by_print(table.where(patterns=family, exposure=EQUAL_FRAME))
        file, title = f"images_{family.replace(':', '')}.png", f"{label(family)}, exposure {EQUAL_FRAME}"
        drawn |= claims.images(file, results, shown, "mask_distance", distances, title, names)
    return drawn


EXPERIMENT = Experiment(
    "distance",
    "How far the mask is from the sensor",
    "What does a thin camera cost, and how much of it do patterns give back?",
    _points, _measure, _claims, _figures,
)  # fmt: skip
