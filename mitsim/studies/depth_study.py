"""What depth costs, by distance, baseline and patterns; and what is left once it is found, for all pixels or for each.

Paper, section V-A and its limitations: "our method is robust to small variations in depth", camera and projector being
co-located. Parallax moves each projector pixel's light by B (1/z - 1/z_0), B being the distance between them.

Idealised: a plane beside the calibrated distance, any baseline. Rendered: the shipped devices, 60 mm, its sheet moved;
the depth given by nothing, found for the sheet, or of a calibration at the sheet's own distance; and scenes of many
depths, whose depth is found for each projector pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from mitsim.report import EQUAL_PEAK, IDEALISED, RENDERED, label
from mitsim.report.lit_scene import Plane
from mitsim.report.pages import Mean
from mitsim.studies.framework.claims import (
    Gain,
    Holds,
    Judged,
    choose_rows,
    distinct,
    every,
    mean_of,
    verdict,
    within,
)
from mitsim.studies.framework.experiment import Claim, Found, Point, Results, Scope, Study, group_by_setup
from mitsim.studies.framework.panels import Images, Lines
from mitsim.studies.framework.studio import Image, Studio, finding

if TYPE_CHECKING:
    from pandas import DataFrame

CALIBRATED_MM = 400.0
"""The paper's distance."""
DEPTHS_MM = (360.0, 380.0, 395.0, 400.0, 405.0, 420.0, 440.0)
"""A tenth of the distance either way, as the shipped scenes with depth have, and what a bag's folds are."""
BASELINES_MM = (0.0, 15.0, 60.0, 150.0, 300.0)
"""From co-located, over a pico projector that touches the camera, to one on the other side of a bench."""
FAMILIES = ("uniform", "dots:4", "dots:7")
ALONG = {"columns": (0.0, -1.0), "rows": (-1.0, 0.0), "both": (-(0.5**0.5), -(0.5**0.5))}
"""Unit vectors of the baseline; that of the shipped devices is along the columns."""
DEEP = {"cards": ("dots:7", "dots:7x14"), "cookie_bag": ("dots:7", "dots:7x16")}
"""Scenes of many depths, and patterns whose period is too short for them, and long enough."""
NONE, AUTO, MAP, OWN = ("none", "auto", "map", "own calibration")
_FOCUSED = {
    NONE: "factors as calibrated at 400 mm", AUTO: "depth found (--focus auto)", OWN: "calibrated at its own depth"
}  # fmt: skip
_SMALL_MM = 5.0
"""What a small variation of depth is taken for: the bag's folds."""
_ROBUST_DB = 3.0
"""What an image may lose and still be called robust: half of its squared error is then as before."""


def _points(scope: Scope) -> Sequence[Point]:
    setups = [scope.setup.with_print(name) for name in scope.choose(scope.pictures, scope.pictures[:1])]
    seed, depths = scope.seeds[0], scope.choose(DEPTHS_MM, (380.0, 400.0))
    families = scope.choose(FAMILIES, ("dots:7",))
    planes = [("columns", baseline) for baseline in scope.choose(BASELINES_MM, (0.0, 60.0))]
    planes += [(along, 60.0) for along in scope.choose(("rows", "both"), ())]
    ideal = [
        Point.of(setup, model=IDEALISED, patterns=family, seed=seed, depth=depth, baseline=baseline, along=along)
        for setup in setups
        for along, baseline in planes
        for depth in depths
        for family in families
    ]
    moved = [
        Point.of(
            setup.with_parameters(sheet_z=depth, **({"scene_distance": depth} if focus == OWN else {})),
            model=RENDERED, patterns="dots:7", seed=seed, depth=depth, focus=focus,
        )
        for setup in setups
        for depth in depths
        for focus in (NONE, AUTO, OWN)
        if not (focus == OWN and depth == CALIBRATED_MM)  # that is the bench as it is
    ]  # fmt: skip
    deep = [
        Point.of(replace(scope.setup, scene=scene), model=RENDERED, patterns=family, seed=each, focus=focus)
        for scene, both in scope.choose(tuple(DEEP.items()), tuple(DEEP.items())[:1])
        for each in scope.repeats
        for family in both
        for focus in (NONE, MAP)
    ]
    # What takes longest first, so that no process is left with it at the end.
    return group_by_setup([*(deep if scope.setup.scene == "photograph" else []), *moved, *ideal])


def _measure(studio: Studio, point: Point) -> Found:
    setup, values = point.setup, dict(point.values)
    patterns, seed = str(values["patterns"]), int(point["seed"])
    if point["model"] == IDEALISED:
        lit = studio.lit_scene(setup)
        baseline = tuple(float(point["baseline"]) * part for part in ALONG[point["along"]])
        frames = lit.idealised_frames(
            lit.bench.family(patterns, seed), seed, Plane(point["depth"], (baseline[0], baseline[1]))
        )
        image = Image.of(frames, frames.seconds(EQUAL_PEAK))
    else:
        focus = point["focus"] if point["focus"] in (AUTO, MAP) else None
        # Frames of the sheet elsewhere, factors of the bench as it was aligned.
        image = studio.image(setup, RENDERED, patterns, seed, focus=focus)
    return finding(studio, point, image.image, scene=setup.scene, **image.row())


def _loss(rows: DataFrame, small: float) -> Mean:
    """Return the loss at the worse of both depths that are ``small`` mm beside the calibrated one."""
    there = choose_rows(rows, {"depth": CALIBRATED_MM})
    beside = (choose_rows(rows, {"depth": CALIBRATED_MM + side * small}) for side in (-1, 1))
    return max((mean_of(there, "psnr_db", each) for each in beside if len(each)), key=lambda loss: loss.value)


def _is_robust(results: Results) -> list[Claim]:
    """Judge the loss a little beside the calibrated depth, at each distance between camera and projector."""
    table = choose_rows(results.frame, {"patterns": "dots:7"})
    small = max(
        _SMALL_MM, min(abs(depth - CALIBRATED_MM) for depth in distinct(table, "depth") if depth != CALIBRATED_MM)
    )
    ideal = choose_rows(table, {"model": IDEALISED, "along": "columns"})
    losses = {each: _loss(choose_rows(ideal, {"baseline": each}), small) for each in distinct(ideal, "baseline")}
    rendered = _loss(choose_rows(table, {"model": RENDERED, "focus": NONE}), small)
    holds = {baseline: within(loss, high=_ROBUST_DB) for baseline, loss in losses.items()}
    robust = [baseline for baseline, each in holds.items() if each]
    everywhere = every(within(rendered, high=_ROBUST_DB), *holds.values())
    apart = f"at most {max(robust):g} mm apart" if any(robust) else "co-located"
    only = f"confirmed only if camera and projector are {apart}"
    return [
        Claim(
            f"Robust to small variations in depth: 49 dots, {small:g} mm beside the calibrated distance",
            "robust",
            f"lost by baseline: {', '.join(f'{loss} dB at {each:g} mm' for each, loss in losses.items())}",
            f"lost at 60 mm: {rendered} dB",
            only if everywhere is False and robust else verdict(everywhere),
        )
    ]


def _mended(rows: DataFrame, short: str, long: str) -> tuple[str, Holds]:
    """Judge whether a map of depths mends images under the ``long`` family and is flagged under the ``short`` one."""
    found = {
        (family, focus): choose_rows(rows, {"patterns": family, "focus": focus})
        for family in (short, long)
        for focus in (NONE, MAP)
    }
    text = "; ".join(
        f"{label(name)} {mean_of(found[name, NONE])} dB, with depths {mean_of(found[name, MAP])} dB"
        for name in (short, long)
    )
    gain = mean_of(found[long, MAP], "psnr_db", found[long, NONE])
    return text, every(within(gain, low=_ROBUST_DB), bool(found[short, MAP]["flagged"].all()))


_ALONG = {"model": IDEALISED, "along": "columns"}

STUDY = Study(
    "depth",
    "Depth",
    "What does a scene beside the calibrated distance cost, and what is left once its depth is found?",
    points=_points,
    measure=_measure,
    claims=(
        _is_robust,
        Gain(
            "A plane whose depth is found (--focus auto) is within 3 dB of a calibration at its depth",
            {"focus": AUTO},
            {"focus": OWN},
            where={"patterns": "dots:7", "focus": (AUTO, OWN), "depth": lambda depth: depth != CALIBRATED_MM},
            every="depth",
            at_least=-_ROBUST_DB,
        ),
        *(
            Judged(
                f"A depth for each pixel (--focus map) mends {scene}, and is flagged where dots are too near to each "
                "other",
                partial(_mended, short=short, long=long),
                where={"scene": scene, "focus": (NONE, MAP)},
                optional=True,
            )
            for scene, (short, long) in DEEP.items()
        ),
    ),
    panels=(
        *(
            Lines(
                "depth",
                "depth of the plane [mm]",
                file=file,
                title=title,
                where=where,
                colour=file,
                facet="",
                names=names,
            )
            for file, title, where, names in (
                ("baseline", "Idealised, 49 dots, by baseline", _ALONG | {"patterns": "dots:7"}, "{} mm"),
                ("patterns", "Idealised, projector 60 mm beside the camera", _ALONG | {"baseline": 60.0}, {}),
                (
                    "focus",
                    "Rendered, 49 dots",
                    {"model": RENDERED, "patterns": "dots:7", "focus": tuple(_FOCUSED)},
                    _FOCUSED,
                ),
            )
        ),
        Images(
            "focus",
            title="Rendered scenes of many depths",
            where={"scene": tuple(DEEP), "focus": (NONE, MAP)},
            down=("scene", "patterns"),
            names={NONE: "one depth", MAP: "a depth for each pixel"},
        ),
    ),
)
