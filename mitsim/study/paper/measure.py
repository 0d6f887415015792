"""What experiments of the paper share: an image at a point, captions, and verdicts on what the paper states."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from mitsim.core.arrays import FloatArray
from mitsim.reconstruct.solver import prepare
from mitsim.study.experiment import Claim, Found, Point, Results, thumbnail
from mitsim.study.pictures import QUICK_IMAGES
from mitsim.study.studio import IDEALISED, MODELS, RENDERED, Studio
from mitsim.study.table import Mean, Table, Value

_NAMED = ("picture", "model", "patterns", "exposure", "seed", "mask_distance", "binning", "method", "ratio")
"""Columns that tell images apart."""
TOLERANCE_DB = 2.0
"""How far from the paper's figures ours may be: it states neither its images, nor how bright they are."""
_SHOWN_PRINTS = QUICK_IMAGES
"""Test images whose reconstructions are shown."""


def imaged(studio: Studio, point: Point, shown: Collection[str] = ()) -> Found:
    """The image of a point, kept where it is shown with the singular values of the rendered model.

    Parameters
    ----------
    studio
        where it is made.
    point
        with model, patterns, exposure, seed, and what else varies.
    shown
        patterns whose images are kept.
    """
    setup, values = point.setup, dict(point.values)
    model, patterns, seed = str(point["model"]), str(point["patterns"]), int(point["seed"])
    exposure = str(values.get("exposure", "equal peak"))
    found = studio.image(setup, model, patterns, seed, exposure)
    family = studio.bench(setup).family(patterns, seed)
    count = family.left.shape[1] * family.right.shape[1]
    row = {"picture": setup.picture, **dict(setup.parameters), **values, "patterns_count": count, **found.row()}
    images: dict[str, FloatArray] = {}
    if patterns in shown and (setup.picture in _SHOWN_PRINTS or setup.picture is None):
        images[image_name(row)] = thumbnail(found.image)
    if patterns in shown and model == RENDERED:
        factors = studio.factors(setup, seed)
        prepared = prepare(factors.left, factors.right, family.left, family.right, centre=factors.manifest.centre)
        images[f"spectrum {patterns}"] = prepared.left.singular**2
    return Found((row,), images)


def captioned(
    results: Results, across: str, columns: Sequence[Value], **fixed: Value
) -> dict[str, list[tuple[FloatArray, str]]]:
    """Rows of an image grid: each shown print in both models, by the value ``across`` its ``columns``.

    Parameters
    ----------
    results
        of points that :func:`imaged` measured.
    across, columns
        what varies along a row, and its values.
    **fixed
        of all else that varies; the first that was measured otherwise.
    """
    rows: dict[str, list[tuple[FloatArray, str]]] = {}
    for print_ in (*_SHOWN_PRINTS, None):
        for model in MODELS:
            chosen = results.table.where(picture=print_, model=model, **fixed)
            cells = [_cell(results, chosen.where(**{across: value})) for value in columns]
            found = [cell for cell in cells if cell is not None]
            if len(found) == len(columns):
                rows[f"{print_ or 'scene'}, {model}"] = found
    return rows


def said(mean: Mean) -> str:
    """A ``mean`` PSNR as people read it."""
    return f"{mean} dB"


def stated(results: Results, claim: str, band: tuple[float, float], **values: Value) -> Claim:
    """A claim of PSNR within a ``band`` [dB], for rows with these ``values``: at which exposures it holds.

    Parameters
    ----------
    results
        of all points.
    claim, band
        what the paper says.
    **values
        patterns, and what else it says it of.
    """
    table = results.table.where(**values)
    exposures = table.distinct("exposure") or [None]
    means = {
        model: {each: table.mean("psnr_db", model=model, **_of(exposure=each)) for each in exposures}
        for model in MODELS
    }
    low, high = band[0] - TOLERANCE_DB, band[1] + TOLERANCE_DB
    holds = [each for each in exposures if all(low <= means[model][each].value <= high for model in MODELS)]
    return Claim(
        claim,
        f"{band[0]:g} to {band[1]:g} dB",
        _by_exposure(means[IDEALISED]),
        _by_exposure(means[RENDERED]),
        confirmed(holds, exposures),
    )


def confirmed(holds: Sequence[Value], everywhere: Sequence[Value]) -> str:
    """The verdict on a claim that ``holds`` at some of the exposures ``everywhere``."""
    if not holds:
        return "not confirmed"
    return "confirmed" if len(holds) == len(everywhere) else f"confirmed only at {' and '.join(map(str, holds))}"


def _by_exposure(means: dict[Value, Mean]) -> str:
    if len(means) == 1:
        return said(next(iter(means.values())))
    return "; ".join(f"{exposure}: {said(mean)}" for exposure, mean in means.items())


def _of(**values: Value) -> dict[str, Value]:
    return {name: value for name, value in values.items() if value is not None}


def _cell(results: Results, rows: Table) -> tuple[FloatArray, str] | None:
    for row in rows.rows:
        for name, image in results.images.items():
            if name == image_name(row):
                return image, f"{row['psnr_db']:.1f} dB"
    return None


def image_name(row: Mapping[str, Value]) -> str:
    """Name of the image that a ``row`` is of."""
    return " ".join(str(row[part]) for part in _NAMED if row.get(part) is not None)
