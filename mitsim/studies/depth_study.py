"""What depth costs, by distance, baseline and patterns; and what is left once it is found, for all pixels or for each.

Paper, section V-A and its limitations: "our method is robust to small variations in depth", camera and projector being
co-located. Parallax moves each projector pixel's light by B (1/z - 1/z_0), B being the distance between them.

Idealised: a plane beside the calibrated distance, any baseline. Rendered: the shipped devices, 60 mm, its sheet moved;
the depth given by nothing, found for the sheet, or of a calibration at the sheet's own distance; and scenes of many
depths, whose depth is found for each projector pixel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from matplotlib.figure import Figure

from mitsim.report import EQUAL_PEAK, IDEALISED, RENDERED, label
from mitsim.report.lit_scene import Plane
from mitsim.report.pages import Mean, Table, Value
from mitsim.report.plots import curves
from mitsim.studies.framework import legacy as claims
from mitsim.studies.framework.experiment import Claim, Found, Point, Results, Scope, group_by_setup
from mitsim.studies.framework.legacy import Experiment
from mitsim.studies.framework.studio import Image, Studio

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
    return claims.finding(studio, point, image.image, scene=setup.scene, **image.row())


def _claims(results: Results) -> Sequence[Claim]:
    table = results.table
    near = min(abs(depth - CALIBRATED_MM) for depth in table.distinct("depth") if depth != CALIBRATED_MM)
    small = max(near, _SMALL_MM)

    def worse_loss(rows: Table) -> Mean:
        """At the worse of both depths."""
        there = rows.where(depth=CALIBRATED_MM)
        beside = [depth for depth in rows.distinct("depth") if abs(depth - CALIBRATED_MM) == small]
        losses = (claims.difference(there, rows.where(depth=depth), "psnr_db") for depth in beside)
        return max(losses, key=lambda loss: loss.value)

    ideal = table.where(model=IDEALISED, patterns="dots:7", along="columns")
    losses = {baseline: worse_loss(ideal.where(baseline=baseline)) for baseline in ideal.distinct("baseline")}
    rendered = worse_loss(table.where(model=RENDERED, patterns="dots:7", focus=NONE))
    holds = {baseline: claims.within(loss, high=_ROBUST_DB) for baseline, loss in losses.items()}
    robust = [baseline for baseline, each in holds.items() if each]
    by_baseline = ", ".join(f"{loss} dB at {baseline:g} mm" for baseline, loss in losses.items())
    everywhere = claims.every(claims.within(rendered, high=_ROBUST_DB), *holds.values())
    apart = f"at most {max(robust):g} mm apart" if any(robust) else "co-located"
    only = f"confirmed only if camera and projector are {apart}"
    found = [
        Claim(
            f"Robust to small variations in depth: 49 dots, {small:g} mm beside the calibrated distance", "robust",
            f"lost by baseline: {by_baseline}", f"lost at 60 mm: {rendered} dB",
            only if everywhere is False and robust else claims.verdict(everywhere),
        )
    ]  # fmt: skip
    own, auto = (table.where(focus=focus, patterns="dots:7") for focus in (OWN, AUTO))
    gains = {
        depth: claims.difference(auto.where(depth=depth), own.where(depth=depth), "psnr_db")
        for depth in own.distinct("depth")
    }
    worst = min(gains.values(), key=lambda gain: gain.value)
    which = f"worst of {len(gains)} depths" if len(gains) > 1 else f"{min(gains):g} mm"
    found.append(
        Claim(
            "A plane whose depth is found (--focus auto) is within 3 dB of a calibration at its depth",
            "", "", f"{worst:+} dB at {which}",
            claims.verdict(claims.every(*(claims.within(gain, low=-_ROBUST_DB) for gain in gains.values()))),
        )
    )  # fmt: skip
    return [*found, *(_map_claim(table.where(scene=scene), scene) for scene in DEEP if len(table.where(scene=scene)))]


def _map_claim(rows: Table, scene: str) -> Claim:
    short, long = DEEP[scene]
    by_case = {
        (family, focus): rows.where(patterns=family, focus=focus) for family in (short, long) for focus in (NONE, MAP)
    }
    means = {case: claims.sample_mean(each, "psnr_db") for case, each in by_case.items()}
    flagged = all(row["flagged"] for row in rows.where(patterns=short, focus=MAP).rows)
    gains = "; ".join(
        f"{label(name)} {means[name, NONE]} dB, with depths {means[name, MAP]} dB" for name in (short, long)
    )
    gain = claims.difference(by_case[long, MAP], by_case[long, NONE], "psnr_db")
    better = claims.every(claims.within(gain, low=_ROBUST_DB), flagged)
    return Claim(
        f"A depth for each pixel (--focus map) mends {scene}, and is flagged where dots are too near to each other",
        "", "", gains, claims.verdict(better),
    )  # fmt: skip


def _figures(results: Results) -> Mapping[str, Figure]:
    table = results.table
    ideal, rendered = table.where(model=IDEALISED), table.where(model=RENDERED)
    by_baseline = {
        f"{baseline:g} mm": ideal.where(patterns="dots:7", along="columns", baseline=baseline).means("psnr_db", "depth")
        for baseline in ideal.distinct("baseline")
    }
    axis = "depth of the plane [mm]"
    title = "Idealised plane, 49 dots, by the distance between camera and projector"
    drawn = {"baseline.png": curves({"": by_baseline}, axis, title=title)}
    own = {
        name: rows.where(along="columns", baseline=60.0).means("psnr_db", "depth")
        for name, rows in claims.by_patterns(ideal).items()
    }
    title = "Idealised plane, projector 60 mm beside the camera, by patterns"
    drawn["patterns.png"] = curves({"": own}, axis, title=title)
    focus = {
        _FOCUSED[name]: rendered.where(patterns="dots:7", focus=name).means("psnr_db", "depth")
        for name in (NONE, AUTO, OWN)
    }
    drawn["focus.png"] = curves(
        {"": focus}, "depth of the sheet [mm]", title="Rendered sheet, projector 60 mm beside the camera, 49 dots"
    )
    lines = {
        f"{scene}, {label(family)}": table.where(scene=scene, patterns=family)
        for scene in DEEP
        for family in DEEP[scene]
    }
    shown: list[Value] = [NONE, MAP]
    titles = ["one depth", "a depth for each pixel"]
    return drawn | claims.images("images.png", results, lines, "focus", shown, "Rendered scenes of many depths", titles)


EXPERIMENT = Experiment(
    "depth",
    "Depth",
    "What does a scene beside the calibrated distance cost, and what is left once its depth is found?",
    _points, _measure, _claims, _figures,
)  # fmt: skip
