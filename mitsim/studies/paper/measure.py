"""What experiments of the paper share: findings at a point, curves and rows of images, and claims of PSNR."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from mitsim.core.arrays import FloatArray
from mitsim.report.charts import Curve
from mitsim.report.compare import label
from mitsim.report.exposures import EQUAL_PEAK, IDEALISED, MODELS, RENDERED
from mitsim.report.table import Mean, Table, Value
from mitsim.studies.framework.experiment import IMAGE, Claim, Found, Results
from mitsim.studies.framework.pictures import QUICK_IMAGES
from mitsim.studies.framework.setup import Point
from mitsim.studies.framework.studio import Studio
from mitsim.studies.framework.verdicts import Holds, judged, sampled, within

TOLERANCE_DB = 2.0
"""How far from the paper's figures ours may be: it states neither its images, nor how bright they are."""
Lines = Mapping[str, Table]
"""Rows of a table by what they are called in a figure."""


def found(point: Point, image: FloatArray | None = None, **measured: Value) -> Found:
    """What a point came to, in one row.

    Parameters
    ----------
    point
        that was measured.
    image
        of it, where it is to be shown; kept for a few prints.
    **measured
        columns of the row.
    """
    kept = image is not None and point.setup.picture in (*QUICK_IMAGES, None)
    return Found((point.row(**measured),), shown(image) if kept and image is not None else {})


def shown(image: FloatArray) -> dict[str, FloatArray]:
    """An ``image`` as findings keep it: a page shows no more than single precision."""
    return single({IMAGE: image})


def single(arrays: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Named ``arrays`` as findings keep them, in single precision."""
    return {name: array.astype("float32") for name, array in arrays.items()}


def imaged(studio: Studio, point: Point, shown: Collection[str] = ()) -> Found:
    """The image that a user gets at a point with model, patterns, exposure and seed.

    Parameters
    ----------
    studio, point
        where it is made, and what varies.
    shown
        patterns whose images are kept.
    """
    values = dict(point.values)
    patterns, exposure = str(values["patterns"]), str(values.get("exposure", EQUAL_PEAK))
    image = studio.image(point.setup, str(values["model"]), patterns, int(point["seed"]), exposure)
    return found(point, image.image if patterns in shown else None, **image.row())


def by_patterns(table: Table, families: Collection[str] | None = None) -> Lines:
    """The rows of each pattern family in a ``table``, or of those of ``families``."""
    there = table.distinct("patterns")
    return {label(name): table.where(patterns=name) for name in there if families is None or name in families}


def panels(lines: Lines, by: str, column: str = "psnr_db") -> Mapping[str, Mapping[str, Curve]]:
    """Means of both models side by side.

    Parameters
    ----------
    lines
        rows by name.
    by, column
        columns: along the axis, and up.
    """
    return {
        model: {name: rows.where(model=model).means(column, by) for name, rows in lines.items()} for model in MODELS
    }


def by_print(table: Table) -> Lines:
    """The rows of a ``table`` of each shown print in both models."""
    return {
        f"{print_ or 'scene'}, {model}": table.where(picture=print_, model=model)
        for print_ in (*QUICK_IMAGES, None)
        for model in MODELS
    }


def pictured(
    results: Results, lines: Lines, across: str, columns: Sequence[Value], caption: str = "{psnr_db:.1f} dB"
) -> dict[str, list[tuple[FloatArray, str]]]:
    """Rows of an image grid, those of which all images were kept.

    Parameters
    ----------
    results
        with the images.
    lines
        rows of the table by the grid's.
    across, columns
        what varies along a row of the grid, and its values.
    caption
        of an image, from its row of the table.
    """
    grid = {}
    for name, rows in lines.items():
        cells = []
        for value in columns:
            kept = ((results.array(row), row) for row in rows.where(**{across: value}).rows)
            cells += [(image, caption.format(**row)) for image, row in kept if image is not None][:1]
        if len(cells) == len(columns):
            grid[name] = cells
    return grid


def stated(table: Table, claim: str, band: tuple[float, float]) -> Claim:
    """A claim of PSNR within a band.

    Parameters
    ----------
    table
        rows that it is said of.
    claim, band
        what the paper says [dB].
    """

    def judge(rows: Table) -> tuple[str, Holds]:
        mean = sampled(rows, "psnr_db")
        return f"{mean} dB", near(mean, band)

    return judged(table, claim, f"{band[0]:g} to {band[1]:g} dB", judge)


def near(psnr_db: Mean, band: tuple[float, float]) -> Holds:
    """Whether a mean ``psnr_db`` is within a ``band`` of the paper's [dB], or no more than TOLERANCE_DB beside it."""
    return within(psnr_db, band[0] - TOLERANCE_DB, band[1] + TOLERANCE_DB)


def bars(lines: Lines, column: str = "psnr_db") -> Mapping[str, tuple[Mean, Mean]]:
    """Means of a ``column`` in both models, by the names of ``lines``."""
    return {
        name: (rows.where(model=IDEALISED).mean(column), rows.where(model=RENDERED).mean(column))
        for name, rows in lines.items()
    }
