"""Which patterns: uniform, random, shifting dots and repeated Hadamard, 1 to 64 of them, by three ways to expose them.

Paper, section IV-B and figure 4: singular values, and the mean PSNR of eight test images by the number of patterns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from mitsim.study.charts import curves, image_grid
from mitsim.study.compare import CONVENTIONS, label
from mitsim.study.experiment import Claim, Experiment, Found, Point, Results, Scope
from mitsim.study.paper.measure import captioned, confirmed, imaged, stated
from mitsim.study.plots import singular_values
from mitsim.study.studio import EQUAL_FRAME, IDEALISED, MODELS, RENDERED, Studio
from mitsim.study.table import Value

FAMILIES = (
    "uniform", "random:2", "random:4", "random:5", "random:7", "random:8", "dots:2", "dots:3", "dots:4", "dots:5",
    "dots:6", "dots:7", "dots:8", "hadamard:2", "hadamard:4", "hadamard:8",
)  # fmt: skip
_FEW = ("uniform", "random:7", "dots:2", "dots:4", "dots:7", "dots:8", "hadamard:4", "hadamard:8")
_KINDS = {"dots": "shifting dots", "hadamard": "repeated Hadamard", "random": "random"}
_UNIFORM, _DOTS = (21.0, 23.0), (34.0, 35.5)
"""Decibels in the paper's figures 4 to 6, of one uniform pattern and of 49 dots, mask at 2000 um."""
_SHOWN = ("uniform", "random:7", "dots:4", "dots:7", "hadamard:8")


def _points(scope: Scope) -> Sequence[Point]:
    """All families on every print, each way of exposing them, in both models."""
    families = scope.chosen(FAMILIES, _FEW)
    conventions = scope.chosen(CONVENTIONS, CONVENTIONS[:2])
    return [
        Point.of(scope.setup.printed(name), model=model, patterns=family, exposure=exposure, seed=seed)
        for name in scope.pictures
        for seed in scope.seeds
        for family in families
        for exposure in conventions
        for model in MODELS
    ]


def _measure(studio: Studio, point: Point) -> Found:
    """Image and quality; what the family's model is conditioned like."""
    return imaged(studio, point, shown=_SHOWN)


def _claims(results: Results) -> Sequence[Claim]:
    """The paper's."""
    table = results.table
    exposures = table.distinct("exposure")
    return [
        stated(results, "One uniform pattern gives 21 to 23 dB", _UNIFORM, patterns="uniform"),
        stated(results, "49 shifting dots give 34 to 35.5 dB", _DOTS, patterns="dots:7"),
        _compared(results, "More dots, better images (49 against 4)", "dots:7", "dots:2", exposures),
        _compared(results, "Orthogonal patterns outperform random ones (49 each)", "dots:7", "random:7", exposures),
        _compared(
            results, "Hadamard patterns perform best, for their light (64 each)", "hadamard:8", "dots:8", exposures
        ),
    ]


def _compared(results: Results, claim: str, better: str, other: str, exposures: Sequence[Value]) -> Claim:
    """A claim that one family is ``better`` than an ``other``: at which exposures it is, rendered and idealised."""
    told: dict[str, list[str]] = {model: [] for model in MODELS}
    holds: list[Value] = []
    for exposure in exposures:
        gains = []
        for model in MODELS:
            one, two = (results.table.where(model=model, exposure=exposure, patterns=name) for name in (better, other))
            if not (len(one) and len(two)):
                return Claim(claim, "higher", "not measured", "not measured", "not measured")
            gains.append(one.mean("psnr_db").value - two.mean("psnr_db").value)
            told[model].append(f"{exposure}: {gains[-1]:+.1f} dB")
        if min(gains) > 0:
            holds.append(exposure)
    return Claim(claim, "higher", "; ".join(told[IDEALISED]), "; ".join(told[RENDERED]), confirmed(holds, exposures))


def _figures(results: Results) -> Mapping[str, Figure]:
    """PSNR by the number of patterns, the conditioning, and images."""
    table, drawn = results.table, {}
    for exposure in table.distinct("exposure"):
        panels = {
            model: {
                said_kind: {
                    row["patterns_count"]: table.mean(
                        "psnr_db", model=model, exposure=exposure, patterns=row["patterns"]
                    )
                    for row in table.where(model=model, exposure=exposure).rows
                    if str(row["patterns"]).split(":")[0] in (kind, "uniform")
                }
                for kind, said_kind in _KINDS.items()
            }
            for model in MODELS
        }
        drawn[f"psnr_{exposure.replace(' ', '_')}.png"] = curves(panels, f"patterns, {exposure}")
    spectra = {label(family): results.images[f"spectrum {family}"]
               for family in _SHOWN if f"spectrum {family}" in results.images}  # fmt: skip
    if spectra:
        drawn["singular_values.png"] = singular_values(spectra)
    grid = captioned(results, "patterns", _SHOWN, exposure=EQUAL_FRAME)
    if grid:
        drawn["images.png"] = image_grid(grid, [label(family) for family in _SHOWN])
    return drawn


EXPERIMENT = Experiment(
    name="patterns",
    title="Which patterns, and how many",
    question="What do uniform, random, shifting-dots and Hadamard patterns recover, by their number and exposure?",
    points=_points,
    measure=_measure,
    claims=_claims,
    figures=_figures,
)
