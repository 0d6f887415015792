"""How fine: bars of 0.13 to 0.6 line pairs a mm under 9, 16 and 49 patterns, and the transfer of a slanted edge.

The paper takes (I_max - I_min) / (I_max + I_min) of the mean along the bars, of which noise alone makes 0.2 to
0.5: it is in the table as `contrast_of_extremes`; figure and verdicts take the contrast at the bars' own frequency.

Paper, section V-C and figure 11. Pixels of the image are 0.9375 mm, so 0.533 line pairs a mm are the most there can be.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from matplotlib.figure import Figure

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.report import EQUAL_FRAME, MODELS
from mitsim.report.lit_scene import LitScene
from mitsim.report.pages import Table
from mitsim.report.plots import curves, image_grid
from mitsim.studies.diffraction_study import contrast, modulation, slanted_edge
from mitsim.studies.framework import claims
from mitsim.studies.framework.claims import Holds, image_array
from mitsim.studies.framework.experiment import Claim, Experiment, Found, Results, Scope
from mitsim.studies.framework.setup import PRINT_MM, Point
from mitsim.studies.framework.studio import Studio

PAIRS_A_MM = (0.13, 0.17, 0.21, 0.26, 0.35, 0.43, 0.52, 0.6)
"""The paper's groups 20 to 5, and one that no pixel of 0.9375 mm can tell."""
FAMILIES = ("uniform", "dots:3", "dots:4", "dots:7")
_TOLD = 0.1
"""Contrast below which bars are not told apart: what the eye needs of a print."""
_SEEN, _BESIDE = slice(16, -16), slice(8, -8)
"""Pixels that are looked at: the margin is beside the bars of the sheet's other half, or beyond the print."""
_FINEST = 0.52  # the paper's group 5
_COARSE = 0.35
"""Cycles a pixel up to which the truth must show bars: pixels that average over them leave 0.8 of their contrast."""
_SHOWS = 0.4
"""Contrast that the truth must have of such bars: half of what print and pixels leave."""


def _points(scope: Scope) -> Sequence[Point]:
    pairs = scope.chosen(PAIRS_A_MM, (0.13, 0.26, 0.52))
    return Point.grid(
        map(scope.setup.printed, [f"bars {each:g}" for each in pairs] + ["edge"]),
        "model patterns exposure seed",
        seed=scope.repeats,
        patterns=scope.chosen(FAMILIES, ("uniform", "dots:7")),
        model=MODELS,
        exposure=(EQUAL_FRAME,),
    )


def _measure(studio: Studio, point: Point) -> Found:
    image = studio.image(point.setup, point["model"], point["patterns"], int(point["seed"]), EQUAL_FRAME)
    lit = studio.lit(point.setup)
    kind, _, frequency = str(point.setup.picture).partition(" ")
    pixel_mm, row = _pixel_mm(lit), point.row(**image.row())
    if kind == "edge":
        cycles, transfer = slanted_edge(image.image[_SEEN, _SEEN])
        pairs = zip(cycles / pixel_mm, transfer, strict=True)
        return Found(tuple({**row, "pairs_a_mm": float(each), "transfer": float(value)} for each, value in pairs))
    own = float(frequency) * pixel_mm
    if own < _COARSE and (there := _contrast(lit.truth, own)) < _SHOWS:
        raise MitsimError(
            f"scene {point.setup.scene}: bars of {frequency} line pairs a mm show a contrast of {there:.2f} in its "
            f"truth; the study needs a print {PRINT_MM:g} mm wide, flat and facing the camera, that fills the image"
        )
    extremes = float(np.mean([contrast(*half) for half in _halves(image.image)]))
    row |= {"pairs_a_mm": float(frequency), "contrast": _contrast(image.image, own), "contrast_of_extremes": extremes}
    return Found((row,), image_array(image.image))


def _pixel_mm(lit: LitScene) -> float:
    """Width of the image's pixels on the print."""
    depth = lit.light.plan.settings.depth
    extents = [high - low for low, high in lit.bench.windows_at(depth)]
    return float(np.mean(extents)) * depth / lit.bench.n


def _halves(image: FloatArray) -> list[tuple[FloatArray, int]]:
    """Bars of each half of an ``image``, without the margins, and the axis along which they lie."""
    left, right = np.split(image, 2, axis=1)
    return [(left[_SEEN, _BESIDE], 0), (right[_SEEN, _BESIDE], 1)]


def _contrast(image: FloatArray, cycles: float) -> float:
    """Mean of both halves at so many ``cycles`` a pixel."""
    return float(np.mean([modulation(*half, cycles) for half in _halves(image)]))


def _claims(results: Results) -> Sequence[Claim]:
    table = results.table

    def rises(rows: Table) -> tuple[str, Holds]:
        limits = {name: _limit(of_family) for name, of_family in claims.by_patterns(rows).items()}
        fine = claims.by_patterns(rows.where(pairs_a_mm=_FINEST))
        kept = {name: claims.sample_mean(of_family, "contrast").value for name, of_family in fine.items()}
        text = ", ".join(f"{name[:1].lower()}{name[1:]} {limits[name]:g} ({kept[name]:.2f})" for name in limits)
        gains = [
            claims.within(claims.difference(more, fewer, "contrast"), low=0) for fewer, more in pairwise(fine.values())
        ]
        families = list(fine.values())
        gain = claims.within(claims.difference(families[-1], families[0], "contrast"), low=0)
        return text, False if False in gains else gain

    def apart(rows: Table) -> tuple[str, Holds]:
        dots = rows.where(patterns="dots:7")
        seen = {
            pairs: claims.sample_mean(dots.where(pairs_a_mm=pairs), "contrast")
            for pairs in _bars(dots)
            if pairs <= _FINEST
        }
        return f"contrast {seen[_FINEST].value:.2f}", claims.every(
            *(claims.within(each, low=_TOLD) for each in seen.values())
        )

    resolution = (
        f"Resolution rises with the number of patterns (finest bars of 10 % contrast, line pairs a mm; contrast at "
        f"{_FINEST})"
    )
    return [
        claims.judge_claim(table, resolution, "rises", rises),
        claims.judge_claim(table, f"49 patterns tell {_FINEST} line pairs a mm apart", "told apart", apart),
    ]


def _limit(rows: Table) -> float:
    """Finest bars up to which all are told apart; 0 for none."""
    limit = 0.0
    for pairs in _bars(rows):
        if claims.sample_mean(rows.where(pairs_a_mm=pairs), "contrast").value < _TOLD:
            break
        limit = pairs
    return limit


def _bars(rows: Table) -> list[float]:
    """Line pairs a mm of all bars that a contrast was measured of."""
    return sorted(rows.means("contrast", "pairs_a_mm"))


def _figures(results: Results) -> Mapping[str, Figure]:
    table, drawn, lines = results.table, {}, claims.by_patterns(results.table)
    for column, file, title in (
        ("contrast", "contrast", "Contrast of bars at their own frequency"),
        ("transfer", "edge", "Modulation transfer by a slanted edge (ISO 12233)"),
    ):
        axis = "spatial frequency on the print [line pairs/mm]"
        shown = claims.panels(lines, "pairs_a_mm", column)
        drawn[f"{file}.png"] = curves(shown, axis, f"{column} [1]", ticks=False, title=title)
    names = [name for name in table.distinct("picture") if name.startswith("bars")]
    both = {f"{name}, {model}": rows.where(model=model) for name, rows in lines.items() for model in MODELS}
    grid = claims.image_rows(results, both, "picture", names, "contrast {contrast:.2f}")
    title = f"Bars by line pairs/mm of the print, exposure {EQUAL_FRAME}"
    drawn["images.png"] = image_grid(grid, [name.replace("bars ", "") for name in names], title)
    return drawn


EXPERIMENT = Experiment(
    "resolution",
    "How fine",
    "Which bars are told apart, and how much contrast does an edge keep?",
    _points, _measure, _claims, _figures,
    note="Pixels of the image are 0.94 mm on the shipped print, so 0.533 line pairs/mm are the most that they show; "
    "bars just below beat with them. Bars lie along the sensor's rows and columns and the edge does not, and lambda "
    "is chosen for each image: the two need not agree.",
)  # fmt: skip
