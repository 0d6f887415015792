"""Charts and pages of studies, of made-up results: units, scales, images, and what a page says first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mitsim.report import EQUAL_FRAME, EQUAL_PEAK, MODELS
from mitsim.report.pages import Value
from mitsim.report.plots import curves, spans_decades
from mitsim.studies import PAPER
from mitsim.studies.framework.experiment import IMAGE, QUICK_IMAGES, TRUTH, Claim, Point, Results, Scope, Setup
from mitsim.studies.framework.experiment import find_experiment as find
from mitsim.studies.framework.panels import section_of, tally, write_page
from mitsim.studies.light_studies import ERROR_SOURCES
from tests.unit.report.test_charts import curve

STUDIES = (*PAPER, "drift", "sweep")
KNOBS = ("sheet_z", ("390", "400", "410")), ("patterns", ("dots:4", "dots:7"))
OTHERS = "spectrum", "without the drift"
"""Arrays of the studies of patterns and of drift."""
SCOPE = Scope(Setup(), QUICK_IMAGES, quick=True, measures=("psnr", "lambda"))


def faults(figure: Figure) -> list[str]:
    """Axes of numbers without a unit, and linear ones over more than two decades."""
    return [fault for axes in figure.axes for fault in _faults(axes) if not axes.images]


def _faults(axes: Axes) -> Iterator[str]:
    data = [
        line.get_xydata() for line in axes.lines if all(line.get_transform().contains_branch_seperately(axes.transData))
    ]
    points = np.concatenate([np.asarray(each, dtype=float).reshape(-1, 2) for each in data] or [np.zeros((0, 2))])
    for index, (axis, shown) in enumerate(((axes.xaxis, "labelbottom"), (axes.yaxis, "labelleft"))):
        named = any(text.get_text() and not _is_number(text.get_text()) for text in axis.get_majorticklabels())
        label = axis.get_label_text()
        if (label or axis.get_tick_params().get(shown, True)) and not named and "[" not in label:
            yield f"axis {label!r} has no unit"
        numbers = points[np.isfinite(points).all(axis=1), index]
        if axis.get_scale() == "linear" and spans_decades(numbers) and numbers.max() > 100 * numbers.min():
            yield f"axis {label!r} is linear from {numbers.min():g} to {numbers.max():g}"


def _is_number(text: str) -> bool:
    return text.replace("\N{MINUS SIGN}", "-").replace(".", "").lstrip("-").isdecimal()


def rows_of(point: Point, rng: np.random.Generator) -> Iterator[dict[str, Value]]:
    """Rows as any study may have them: each model and exposure where the point has none of its own."""
    own = {**point.row(), "scene": point.setup.scene}
    levels = ("psnr", "before", "after", "ideal", "with", "calibrated", "psnr_matt", "artefacts", *ERROR_SOURCES)
    parts = ("contrast", "range_high", "ssim", "ser_over_law", "gain_db")
    measured: dict[str, Value] = {f"{name}_db": float(rng.uniform(20, 40)) for name in levels}
    measured |= {name: float(rng.uniform(0.1, 0.9)) for name in parts}
    measured |= {f"{name}_s": float(10 ** rng.uniform(-3, 1)) for name in ("iterative", "direct", "separable")}
    measured |= {f"{name}_db": float(rng.uniform(0.1, 9)) for name in ("lost", "predicted_lost", "predicted_error")}
    measured |= {"change_db": -1.5, "called_for": True, "lambda": float(10 ** rng.uniform(5, 9))}
    kind, _, size = str(own.get("patterns", "")).partition(":")
    measured["kind"] = kind
    measured["patterns_count"] = int(size) ** 2 if size.isdecimal() else 1
    measured["pixels"] = 512 // int(own.get("binning", 1) or 1)
    if (bars := str(point.setup.picture)).startswith("bars"):
        measured["pairs_a_mm"] = float(bars.split()[1])
    for model, exposure in product(MODELS, (EQUAL_PEAK, EQUAL_FRAME)):
        more = {"model": model, "exposure": exposure}
        if all(own.get(name, value) == value for name, value in more.items()) or more.keys() <= own.keys():
            yield {"point": point.key, **measured, **more, **own}


def invented(name: str, quick: bool = True) -> Results:
    """Results of the study ``name``, whose images are noise."""
    scope = replace(SCOPE, sweep=KNOBS if name == "sweep" else (), quick=quick)
    rng, experiment = np.random.default_rng(1), find(name)
    points = experiment.points(scope)
    rows = [row for point in points for row in rows_of(point, rng)]
    arrays = {(point.key, array): rng.random((4, 4)) for point in points for array in (IMAGE, TRUTH, *OTHERS)}
    return Results(rows, arrays, scope)


@pytest.mark.parametrize("name", STUDIES)
def test_axes_have_units_and_decades_are_logarithmic(name: str) -> None:
    """Of all charts of a study. (Seen failing: numbers of patterns and frames without a unit in four studies, a sweep
    over the bare name of its parameter, lambda from 1e5 to 1e9 on a linear axis.)"""
    drawn = find(name).draw(invented(name))
    found = {file: faults(figure) for file, figure in drawn.items()}
    assert (found or name == "reflectivity") and not any(found.values()), found


@pytest.mark.parametrize("quick", [False, True])
@pytest.mark.parametrize("name", PAPER)
def test_claims_fit_the_rows_of_their_study(name: str, quick: bool) -> None:
    """Every claim is judged. (Planted: a column misspelt in a claim.)"""
    claims = find(name).judge(invented(name, quick))
    assert claims and all(claim.verdict and (claim.idealised or claim.rendered) for claim in claims)


def test_the_rule_sees_what_is_wrong() -> None:
    """(Planted: an axis without a unit; one made linear.)"""
    good = curves({"": {"a": curve((1, 1e-4), (2, 1.0))}}, "x [mm]", "y [1]")
    assert not faults(good)
    bare = curves({"": {"a": curve((1, 1.0), (2, 2.0))}}, "x", "y [1]")
    assert faults(bare) == ["axis 'x' has no unit"]
    good.axes[0].set_yscale("linear")
    assert faults(good) == ["axis 'y [1]' is linear from 0.0001 to 1"]


def sweep(knobs: Sequence[tuple[str, tuple[str, ...]]], truth_by: str = "") -> Results:
    """Images that are even greys, each a hundredth brighter than the one before; truths of 0.9, or of another grey for
    each value of ``truth_by``."""
    scope = Scope(Setup(), (None,), sweep=tuple(knobs), measures=("psnr",))
    points = find("sweep").points(scope)
    rows = [
        {"point": point.key, **point.row(psnr_db=20.0 + index, flagged=index == 0)}
        for index, point in enumerate(points)
    ]
    arrays = {(point.key, IMAGE): np.full((2, 2), index / 100) for index, point in enumerate(points)}
    values = dict(knobs).get(truth_by, ())
    for point, row in zip(points, rows, strict=True):
        grey = 0.8 + 0.01 * values.index(str(row[truth_by])) if truth_by else 0.9
        arrays[point.key, TRUTH] = np.full((2, 2), grey)
    return Results(rows, arrays, scope)


def grid(results: Results) -> tuple[list[str], list[str], list[str]]:
    """Titles of columns, names of rows and captions of its images."""
    cells = find("sweep").draw(results)["images.png"].axes
    titles = [axes.get_title() for axes in cells if axes.get_title()]
    return titles, [axes.get_ylabel() for axes in cells if axes.get_ylabel()], [axes.get_xlabel() for axes in cells]


def test_a_sweep_shows_its_images_by_what_is_swept() -> None:
    """The first knob across, the second down, the truth beside, a PSNR below each. (Planted: knobs in the table's
    order; no truth.)"""
    titles, names, captions = grid(sweep((("patterns", ("dots:4", "dots:7")), ("sheet_z", ("390", "400", "410")))))
    assert titles == ["truth", "patterns dots:4", "patterns dots:7"]
    assert names == ["sheet_z 390", "sheet_z 400", "sheet_z 410"]
    assert captions == ["", "20.0 dB\nflagged", "21.0 dB", "", "22.0 dB", "23.0 dB", "", "24.0 dB", "25.0 dB"]


def test_truths_stand_above_images_where_they_differ_along_a_row() -> None:
    """(Planted: the first column's truth beside all.)"""
    titles, names, captions = grid(sweep((KNOBS[0], KNOBS[1]), truth_by="sheet_z"))
    assert titles == ["sheet_z 390", "sheet_z 400", "sheet_z 410"] and captions[:3] == [""] * 3
    both = ("dots:4", "dots:7")
    assert names == [f"{truth}patterns {each}" for each in both for truth in ("truth,\n", "")]


def test_a_long_sweep_shows_both_ends_and_says_how_many_there_are() -> None:
    """(Planted: the first six.)"""
    results = sweep((("sheet_z", tuple(f"{390 + each}" for each in range(11))),))
    figure = find("sweep").draw(results)["images.png"]
    titles, names, _ = grid(results)
    assert titles == ["truth", *(f"sheet_z {390 + each}" for each in (0, 2, 4, 6, 8, 10))] and not names
    assert figure.get_suptitle().replace("\n", " ") == "Images by sheet_z (6 of 11 columns)"


def test_a_page_says_first_how_many_claims_hold(tmp_path: Path) -> None:
    """Then claims, pictures, and how it was measured last. (Planted: what holds in part counted as confirmed; the
    explanation first.)"""
    verdicts = ("confirmed", "confirmed only at equal peak", "not confirmed", "not decided at this size", "wrong")
    claims = tuple(Claim(f"claim {index}", "", "", "", each) for index, each in enumerate(verdicts))
    said = "5 claims: 1 confirmed, 1 confirmed in part, 1 not confirmed, 2 not decided"
    assert tally(claims) == said and tally(claims[:1]) == "1 claim: 1 confirmed" and not tally(())
    results = invented("patterns")
    shown = {"psnr.png": curves({"": {"a": curve((1, 1.0), (2, 2.0))}}, "x [mm]")}
    section = section_of(find("patterns"), claims, shown, results)
    page = write_page([section], tmp_path / "page.html", section.title).read_text()
    order = [page.index(each) for each in (said, section.detail, "claim 4", "<img", "Zheng")]
    assert order == sorted(order)
