"""Moving the mask instead of the light: SweepCam's uniform frames at 49 places of the mask, 49 uniform frames, 49 dots.

Paper, section IV-D: the mask moves by -15 to +15 of its features, and there are as many frames as patterns. It does not
say along which axes; a grid of k x k places has as many frames as dots of period k, and is taken here. A line of 49
places along the rows, as a mask on one slide would go, is in the table as well: idealised only, because it would take
49 calibrations.

Frames through a mask that rests share the error of one calibration, those through a moved one have seven.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from mitsim.devices.patterns import PatternFamily
from mitsim.report.charts import curves, image_grid
from mitsim.report.exposures import EQUAL_FRAME, EQUAL_PEAK, IDEALISED, MODELS, RENDERED, LitScene, Unexposed
from mitsim.report.table import Table
from mitsim.studies.framework.experiment import Claim, Experiment, Found, Results, Scope
from mitsim.studies.framework.pictures import QUICK_IMAGES
from mitsim.studies.framework.setup import Point
from mitsim.studies.framework.studio import Image, Studio, reason_of
from mitsim.studies.framework.verdicts import Holds, difference, every, judged, sampled, verdict, within
from mitsim.studies.paper.measure import by_print, near, panels, pictured, shown, stated
from mitsim.studies.sweepcam import MovedMask, Places, ideal_places

REACH = 15.0
"""Features that the mask moves either way."""
GRIDS = {2: (0, 6), 3: (0, 3, 6), 4: (0, 2, 4, 6), 7: tuple(range(7))}
"""Which of seven places between both ends are taken along an axis, by their number: all are calibrated once."""
UNIFORM, SWEPT, LINE, DOTS = "uniform frames", "SweepCam", "SweepCam, along rows alone", "shifting dots"
_FRAMES = 49
"""As the paper's."""
_SWEPT_DB = (24.9, 26.8)
"""In the paper's figure 6."""
_TELLS_DB = 0.5
"""A gain that counts: a tenth of the squared error."""
EXPOSURES = (EQUAL_PEAK, EQUAL_FRAME)


def _points(scope: Scope) -> Sequence[Point]:
    sides = scope.chosen((1, *GRIDS), (1, 7))
    cases = [(UNIFORM, side) for side in sides] + [(name, side) for name in (SWEPT, DOTS) for side in sides[1:]]
    return [
        Point.of(scope.setup.printed(name), model=model, patterns=method, frames=side**2, seed=seed)
        for name in (scope.pictures[:1] if scope.quick else scope.pictures)
        for seed in scope.seeds
        for method, side in [*cases, (LINE, 7)]
        for model in (MODELS if method != LINE else (IDEALISED,))
    ]


def _measure(studio: Studio, point: Point) -> Found:
    method, side, lit = point["patterns"], round(point["frames"] ** 0.5), studio.lit(point.setup)
    images = _moved(studio, point, lit) if method in (SWEPT, LINE) else _still(studio, point, lit)
    rows = tuple(point.row(exposure=exposure, **image.row()) for exposure, image in images.items())
    kept = point.setup.picture in (*QUICK_IMAGES, None) and side in (1, 7) and method != LINE
    return Found(rows, shown(images[EQUAL_FRAME].image) if kept else {})


def _still(studio: Studio, point: Point, lit: LitScene) -> dict[str, Image]:
    """Images of as many uniform frames, or dots, as a point has, by exposure."""
    model, seed, n = point["model"], int(point["seed"]), lit.bench.n
    if point["patterns"] == DOTS:
        family = lit.bench.family(f"dots:{round(point['frames'] ** 0.5)}")
    else:
        family = PatternFamily(UNIFORM, np.ones((n, point["frames"]), np.int8), np.ones((n, 1), np.int8))
    centre, sides = lit.bench.geometry.centred, _factors(studio, point, lit)[0.0]
    frames = Unexposed(lit, model, family, sides, centre, seed if model == RENDERED else seed + 1)
    return {exposure: Image.of(frames, frames.seconds(exposure)) for exposure in EXPOSURES}


def _moved(studio: Studio, point: Point, lit: LitScene) -> dict[str, Image]:
    """Images through the moved mask, by exposure."""
    model, feature = point["model"], lit.bench.geometry.mask_feature
    columns: tuple[float, ...]
    if point["patterns"] == LINE:
        rows, columns = _spread(_FRAMES, feature), (0.0,)
        factors = ideal_places(lit.bench, {*rows, *columns}, lit.board_flux)
    else:
        seven, factors = _spread(7, feature), _factors(studio, point, lit)
        rows = columns = tuple(seven[index] for index in GRIDS[round(point["frames"] ** 0.5)])
    mask = MovedMask(lit, model, factors, int(point["seed"]) + (model == IDEALISED))
    images = {}
    for exposure in EXPOSURES:
        seconds = mask.seconds(rows, columns, exposure)
        found = mask.solve(rows, columns, seconds)
        quality, reason = lit.quality(found.image), reason_of(found.status)
        images[exposure] = Image(found.image, quality, found.lam, point["frames"], seconds, bool(reason), reason=reason)
    return images


def _factors(studio: Studio, point: Point, lit: LitScene) -> Places:
    """Of a camera with its mask at seven places, the middle one on the axis."""
    places = _spread(7, lit.bench.geometry.mask_feature)
    if point["model"] == RENDERED:
        return studio.places(point.setup, places, int(point["seed"]))
    return ideal_places(lit.bench, places, lit.board_flux)


def _spread(count: int, feature_mm: float) -> tuple[float, ...]:
    """So many places [mm], evenly from one end to the other."""
    return tuple(float(place) for place in np.linspace(-REACH, REACH, count) * feature_mm)


def _claims(results: Results) -> Sequence[Claim]:
    table = results.table
    many = table.where(frames=_FRAMES)
    line = {each: sampled(many.where(patterns=LINE, exposure=each), "psnr_db") for each in EXPOSURES}
    on_the_line = every(*(near(mean, _SWEPT_DB) for mean in line.values()))

    def gain(claim: str, paper: str, better: Table, other: Table) -> Claim:
        def judge(rows: Table) -> tuple[str, Holds]:
            same = {"model": rows.rows[0]["model"], "exposure": rows.rows[0]["exposure"]}
            more = difference(rows, other.where(**same), "psnr_db")
            return f"{more:+} dB", within(more, low=_TELLS_DB)

        return judged(better, claim, paper, judge)

    one, still = table.where(patterns=UNIFORM, frames=1), many.where(patterns=UNIFORM)
    swept, dots = many.where(patterns=SWEPT), many.where(patterns=DOTS)
    on_a_line = "; ".join(f"{exposure}: {mean} dB" for exposure, mean in line.items())
    return [
        stated(one, "One uniform frame gives 21.3 to 22.9 dB", (21.3, 22.9)),
        stated(swept, "SweepCam with 49 frames gives 24.9 to 26.8 dB, here on a grid", _SWEPT_DB),
        Claim(
            "The same on a line along the rows", "24.9 to 26.8 dB", on_a_line, "",
            "confirmed only idealised" if on_the_line else verdict(on_the_line),
        ),
        stated(dots, "49 shifting dots give 34 to 35.5 dB", (34.0, 35.5)),
        gain("49 dots beat SweepCam's 49 frames", "higher", dots, swept),
        gain("SweepCam's 49 frames beat 49 frames through a mask that rests", "", swept, still),
    ]  # fmt: skip


def _figures(results: Results) -> Mapping[str, Figure]:
    table, drawn = results.table, {}
    for exposure in EXPOSURES:
        rows = table.where(exposure=exposure)
        first = rows.where(patterns=UNIFORM, frames=1).rows  # one uniform frame is the first of each
        lines = {name: Table((*first, *rows.where(patterns=name).rows)) for name in (SWEPT, DOTS)}
        lines = {UNIFORM: rows.where(patterns=UNIFORM), **lines}
        drawn[f"psnr_{exposure.replace(' ', '_')}.png"] = curves(
            panels(lines, "frames"), "frames", log=True, title=f"PSNR by the number of frames, exposure {exposure}"
        )
    names = {UNIFORM: "49 uniform", SWEPT: "SweepCam, 49", DOTS: "49 dots"}
    shown = table.where(exposure=EQUAL_FRAME, frames=_FRAMES)
    if grid := pictured(results, by_print(shown), "patterns", list(names)):
        drawn["images.png"] = image_grid(grid, list(names.values()), f"Images of 49 frames, exposure {EQUAL_FRAME}")
    return drawn


EXPERIMENT = Experiment(
    "multishot",
    "The mask moved, or the light",
    "Do dots beat as many uniform frames through a mask that moves?",
    _points, _measure, _claims, _figures,
)  # fmt: skip
