"""A lamp beside the projector, from a hundredth of its light to a hundred times: what is left once it is taken off.

Paper, supplement: one uniform pattern, 64 dots and 64 Hadamard patterns under ambient light, whose reference frame is
subtracted; the dynamic range of the measurements decides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from mitsim.capture.exposer import Exposer
from mitsim.study.charts import curves, image_grid
from mitsim.study.compare import label
from mitsim.study.experiment import Claim, Experiment, Found, Point, Results, Scope, thumbnail
from mitsim.study.paper.measure import image_name, said
from mitsim.study.studio import EQUAL_PEAK, RENDERED, Shoot, Studio
from mitsim.study.table import Value

RATIOS = (0.01, 0.1, 1.0, 10.0, 100.0)
"""Irradiance of the lamp over that of the projector, on the sheet of lamp_bench."""
_EQUAL = 117.0
"""Radiance [W m^-2 sr^-1] of the lamp of lamp_bench that lights the sheet as the projector does: ten times the shipped
one's."""
FAMILIES = ("uniform", "dots:8", "hadamard:8")
_SPREAD = (1.0, 99.0)
"""Percentiles that a dynamic range lies between: single pixels' noise is no signal."""


def _points(scope: Scope) -> Sequence[Point]:
    own = scope.pictures == (None,)
    setup = scope.setup if own else replace(scope.setup, scene="lamp_bench")
    seeds = scope.seeds if scope.quick else (*scope.seeds, scope.seeds[0] + 1, scope.seeds[0] + 2)
    return [
        Point.of(
            setup.changed(lamp=f"{_EQUAL * ratio:g}"),
            model=RENDERED, patterns=family, exposure=EQUAL_PEAK, seed=seed, ratio=ratio,
        )
        for ratio in scope.chosen(RATIOS, (0.01, 1.0, 100.0))
        for seed in seeds
        for family in FAMILIES
    ]  # fmt: skip


def _measure(studio: Studio, point: Point) -> Found:
    setup, patterns, seed = point.setup, str(point["patterns"]), int(point["seed"])
    found = studio.image(setup, RENDERED, patterns, seed)
    low, high = _range(studio.shoot(setup, RENDERED, patterns, seed))
    row: dict[str, Value] = {"picture": None, **dict(setup.parameters), **dict(point.values), **found.row()}
    row |= {"range_low": low, "range_high": high}
    return Found((row,), {image_name(row): thumbnail(found.image)})


def _range(shoot: Shoot) -> tuple[float, float]:
    """Part of the full well that a frame takes up without the lamp's light, from dark to bright pixels."""
    bench = shoot.scene.bench
    exposer = Exposer(bench.rig, shoot.peak_s, 0)
    dark = exposer.electrons(shoot.expected.projector_off)
    frames = [np.percentile(exposer.electrons(frame) - dark, _SPREAD) for frame in shoot.expected]
    low, high = np.mean(frames, axis=0) / bench.sensor.superpixel_full_well_e
    return float(low), float(high)


def _claims(results: Results) -> Sequence[Claim]:
    table = results.table
    ratios = table.distinct("ratio")
    means = {
        (ratio, family): table.mean("psnr_db", ratio=ratio, patterns=family) for ratio in ratios for family in FAMILIES
    }
    better = [ratio for ratio in ratios if means[ratio, "hadamard:8"].value > means[ratio, "dots:8"].value]
    least, most = ratios[0], ratios[-1]

    def told(family: str, ratio: float) -> str:
        return f"{label(family).lower()} {said(means[ratio, family])}"

    def spread(family: str, ratio: float) -> str:
        own: dict[str, Value] = {"patterns": family, "ratio": ratio}
        low, high = (table.mean(name, **own).value for name in ("range_low", "range_high"))
        return f"{label(family).lower()} {low:.3f} to {high:.3f}"

    strong = next((ratio for ratio in ratios if ratio >= 1), most)
    dots, hadamard = (table.mean("range_high", patterns=name, ratio=strong).value for name in ("dots:8", "hadamard:8"))
    beyond = better == [ratio for ratio in ratios if better and ratio >= better[0]]
    return [
        Claim(
            "Under strong ambient light dots keep less dynamic range than Hadamard patterns (part of the full well)",
            "0 to 0.02 against 0.06 to 0.17", "not simulated",
            f"lamp {strong:g} times: {spread('dots:8', strong)}, {spread('hadamard:8', strong)}",
            "confirmed" if dots < hadamard else "not confirmed",
        ),
        Claim(
            "Hadamard patterns are better under strong ambient light", "better", "not simulated",
            f"from {better[0]:g} times on; {told('dots:8', most)}, {told('hadamard:8', most)} at {most:g}" if better
            else f"at no ratio; {told('dots:8', most)}, {told('hadamard:8', most)} at {most:g}",
            ("confirmed" if beyond else "confirmed only at some ratios") if better else "not confirmed",
        ),
        Claim(
            "Dots are preferred when ambient light is not strong: they take half the frames", "preferred",
            "not simulated", f"{told('dots:8', least)}, {told('hadamard:8', least)} at {least:g}",
            "confirmed" if least not in better else "not confirmed",
        ),
    ]  # fmt: skip


def _figures(results: Results) -> Mapping[str, Figure]:
    table = results.table
    shown = {label(family): table.means("psnr_db", "ratio", patterns=family) for family in FAMILIES}
    spans = {label(family): table.means("range_high", "ratio", patterns=family) for family in FAMILIES}
    axis = "lamp's light over the projector's [1]"
    drawn = {
        "psnr.png": curves({"equal peak, the lamp's frame taken off": shown}, axis, log=True),
        "range.png": curves(
            {"brightest pixels, the lamp's frame taken off": spans}, axis, "part of the full well [1]", log=True
        ),
    }
    first = table.rows[0]["seed"]
    drawn["images.png"] = image_grid(
        {
            label(family): [
                (results.images[image_name(row)], f"{row['psnr_db']:.1f} dB")
                for row in table.where(patterns=family, seed=first).rows
            ]
            for family in FAMILIES
        },
        [f"lamp {ratio:g}" for ratio in table.distinct("ratio")],
    )
    return drawn


EXPERIMENT = Experiment(
    name="ambient",
    title="A lamp beside the projector",
    question="How much ambient light does each kind of pattern stand?",
    points=_points,
    measure=_measure,
    claims=_claims,
    figures=_figures,
)
