"""One uniform frame, 49 uniform frames, and 49 dots in the same time; and the law of the paper's noise analysis.

Paper, section V-B, figure 9, and the error analysis of its supplement: of a least-squares image x' of a scene x,
||x|| / ||x - x'|| = ||x|| / (s rho), rho^2 = Tr (A^T A)^-1 = sum 1 / s_i^2 over the singular values of the model A of
all frames, s being the noise of a datum. (The paper writes it as SER = sqrt(T) SNR / rho, of T equal frames.)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from mitsim.rig.patterns import PatternFamily
from mitsim.study.charts import image_grid
from mitsim.study.experiment import Claim, Experiment, Found, Point, Results, Scope, thumbnail
from mitsim.study.paper.measure import captioned, image_name, said
from mitsim.study.pictures import QUICK_IMAGES
from mitsim.study.plots import quality_bars
from mitsim.study.studio import IDEALISED, MODELS, RENDERED, Studio
from mitsim.study.table import Value

FRAMES = 49
"""As the paper's."""
ONE, MANY, DOTS = "1 uniform", "49 uniform", "49 dots"
_LAW_WITHIN = 0.1
"""Relative difference of law and measurement: one draw of 16384 unknowns scatters by 1 %, dots' noise is not white."""


def _family(studio: Studio, point: Point) -> PatternFamily:
    bench = studio.bench(point.setup)
    if point["patterns"] == DOTS:
        return bench.family("dots:7")
    count = 1 if point["patterns"] == ONE else FRAMES
    return PatternFamily(point["patterns"], np.ones((bench.n, count), np.int8), np.ones((bench.n, 1), np.int8))


def _points(scope: Scope) -> Sequence[Point]:
    return [
        Point.of(scope.setup.printed(name), model=model, patterns=patterns, seed=seed)
        for name in scope.pictures
        for seed in scope.seeds
        for patterns in (ONE, MANY, DOTS)
        for model in MODELS
    ]


def _measure(studio: Studio, point: Point) -> Found:
    """All frames have the time in which one of uniform light fills the full well as far as it may."""
    setup, model, seed = point.setup, point["model"], int(point["seed"])
    shoot = studio.shoot(setup, model, _family(studio, point), seed)
    seconds = studio.shoot(setup, model, "uniform", seed).peak_s
    image, law = shoot.image(seconds), {}
    if model == IDEALISED and point["patterns"] == DOTS:
        # Elsewhere the law's model is not that of the frames, or least squares magnifies rounding beyond any image.
        plain, truth = shoot.image(seconds, 0.0), studio.scene(setup).truth
        measured = np.linalg.norm(truth) / np.linalg.norm(plain.image - truth)
        prepared = shoot.model()
        sigma = np.outer(prepared.left.singular, prepared.right.singular)
        rho = float(np.sqrt(np.square(1 / sigma).sum()))
        law = {"ser": float(measured), "ser_law": float(np.linalg.norm(truth)) / (shoot.noise(seconds) * rho)}
    row: dict[str, Value] = {
        "picture": setup.picture,
        **dict(setup.parameters),
        **dict(point.values),
        **image.row(),
        **law,
    }
    shown = setup.picture in (*QUICK_IMAGES, None)
    return Found((row,), {image_name(row): thumbnail(image.image)} if shown else {})


def _claims(results: Results) -> Sequence[Claim]:
    table = results.table
    means = {
        (model, name): table.mean("psnr_db", model=model, patterns=name)
        for model in MODELS
        for name in (ONE, MANY, DOTS)
    }

    def gain(better: str, other: str) -> list[str]:
        return [
            f"{said(means[model, better])}, {means[model, better].value - means[model, other].value:+.1f} dB"
            for model in (IDEALISED, RENDERED)
        ]

    def holds(better: str, other: str) -> str:
        every = all(means[model, better].value > means[model, other].value for model in MODELS)
        return "confirmed" if every else "not confirmed"

    law = np.array(
        [(float(str(row["ser"])), float(str(row["ser_law"]))) for row in table.rows if row.get("ser") is not None]
    )
    ratio = law[:, 0] / law[:, 1]
    within = "confirmed" if np.abs(ratio - 1).max() < _LAW_WITHIN else "not confirmed"
    dots, many = gain(DOTS, MANY), gain(MANY, ONE)
    return [
        Claim("49 dots beat 49 uniform frames of the same time", "higher", dots[0], dots[1], holds(DOTS, MANY)),
        Claim("49 uniform frames are slightly better than one", "slightly higher", many[0], many[1], holds(MANY, ONE)),
        Claim(
            "Without regularisation, ||x|| / ||x - x'|| is SNR / rho (49 dots)", "equal",
            f"measured / law {ratio.min():.3f} to {ratio.max():.3f}", "not defined: factors are calibrated", within,
        ),
    ]  # fmt: skip


def _figures(results: Results) -> Mapping[str, Figure]:
    table, names = results.table, (ONE, MANY, DOTS)
    idealised, rendered = (
        [table.mean("psnr_db", model=model, patterns=name).value for name in names] for model in (IDEALISED, RENDERED)
    )
    drawn = {"psnr.png": quality_bars(dict(zip(names, zip(idealised, rendered, strict=True), strict=True)))}
    if grid := captioned(results, "patterns", names):
        drawn["images.png"] = image_grid(grid, names)
    return drawn


EXPERIMENT = Experiment(
    name="exposure",
    title="The same time, shared differently",
    question="Do many dots beat as many uniform frames that take as long?",
    points=_points,
    measure=_measure,
    claims=_claims,
    figures=_figures,
)
