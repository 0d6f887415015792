"""Distance of the sheet: a study to begin with, whole as it stands.

A study says what varies (points), what is measured at each point (measure), and what all points come to (claims and
figures). Change these; `mitsim study --help` has the options, such as --quick for a first look at a few points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from mitsim.report import EQUAL_PEAK, RENDERED
from mitsim.studies.framework.experiment import Claim, Point, Results, Scope
from mitsim.studies.framework.legacy import Experiment, measure_image

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def points(scope: Scope) -> Sequence[Point]:
    """Where is measured: parameters of the scene (sheet_z, in mm) by what is varied beside them, in a ``scope``."""
    distances = scope.choose((380, 390, 400, 410, 420), (390, 400))
    setups = [
        scope.setup.with_parameters(sheet_z=each).with_print(picture)
        for each in distances
        for picture in scope.pictures
    ]
    return Point.grid(
        setups,
        "model patterns exposure seed",
        model=(RENDERED,),
        patterns=("uniform", "dots:7"),
        exposure=(EQUAL_PEAK,),
        seed=scope.seeds,
    )


def claims(results: Results) -> Sequence[Claim]:
    """What is said of all ``results``: a sentence, the numbers that it rests on, and its verdict."""
    at = {each: results.table.where(patterns="dots:7", sheet_z=each).mean("psnr_db") for each in ("390", "400")}
    verdict = "confirmed" if at["400"].value > at["390"].value else "not confirmed"
    return [Claim("The calibrated distance, 400 mm, is best", "", "", f"{at['400']} against {at['390']} dB", verdict)]


def figures(results: Results) -> Mapping[str, Figure]:
    """Pictures of ``results`` by file name: PSNR by distance, a curve for each pattern family."""
    from mitsim.report.plots import curves  # here, for processes that measure do without

    table, shown = results.table, {}
    for family in table.distinct("patterns"):
        rows = table.where(patterns=family)
        shown[str(family)] = {float(str(z)): rows.where(sheet_z=z).mean("psnr_db") for z in rows.distinct("sheet_z")}
    return {"psnr.png": curves({"": shown}, "distance of the sheet [mm]", title="PSNR by the sheet's distance")}


EXPERIMENT = Experiment(
    "starter",
    "Distance of the sheet",
    "What does a sheet beside the calibrated distance cost?",
    points,
    measure_image,
    claims,
    figures,
)
