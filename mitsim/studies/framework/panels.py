"""Figures and tables of a study, declared over columns of its table, and the study's page.

A panel names the columns along its axes and averages over every other column that varies, by
:func:`mitsim.studies.framework.claims.mean_of`.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from itertools import product
from pathlib import Path
from string import Formatter
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import versions
from mitsim.core.files import write_text
from mitsim.devices.patterns import FAMILIES
from mitsim.report import label
from mitsim.report.pages import DASH, Mean, page_figure, render_page
from mitsim.studies.framework.claims import (
    CONFIRMED,
    NOT_CONFIRMED,
    Where,
    choose_rows,
    distinct,
    mean_of,
    measured,
    value_name,
    with_unit,
)  # fmt: skip
from mitsim.studies.framework.experiment import (
    HEADS,
    IMAGE,
    KNOBS,
    TEST_IMAGES,
    TRUTH,
    Claim,
    Results,
    Scope,
    Setup,
    Study,
)  # fmt: skip

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

Columns = str | Sequence[str] | Mapping[str, str]
"""A column, several columns whose combinations are shown, or names by column whose numbers are shown side by side."""
Names = Mapping[Any, str] | str
"""Names by value, or by (column, value); or a template for numbers such as "{} mm"."""
PSNR = "PSNR [dB]"


# -------- Figures and tables


@dataclass(frozen=True)
class Panel:
    """A figure of a study.

    Attributes
    ----------
    file, title
        name of the file without its ending (by default that of the measure or images), and heading.
    where
        rows that are shown.
    each
        column with a figure for each of its values, which file and title end with.
    names
        names of values in the legend, beside rows and above columns.
    errors
        columns of errors that all rows share, by the column of their numbers.
    """

    _: KW_ONLY
    file: str = ""
    title: str = ""
    where: Where = field(default_factory=dict)
    each: str = ""
    names: Names = field(default_factory=dict)
    errors: Mapping[str, str] = field(default_factory=dict)

    def draw(self, results: Results) -> dict[str, Figure]:
        rows = choose_rows(results.frame, self.where)
        measure = str(getattr(self, "y", getattr(self, "x", ""))).removesuffix("_db") or "images"
        drawn: dict[str, Figure | None] = {}
        for value in distinct(rows, self.each) if self.each else [""]:
            shown = f"exposure {value}" if self.each == "exposure" else self.name(self.each, value)
            one = replace(self, title=", ".join(filter(None, (self.title, shown))))
            name = "_".join(filter(None, (self.file or measure, str(value)))).replace(" ", "_").replace(":", "")
            own = choose_rows(rows, {self.each: value} if self.each else {})
            drawn[f"{name}.png"] = one.figure(results, own)
        return {name: figure for name, figure in drawn.items() if figure is not None}

    def figure(self, results: Results, rows: DataFrame) -> Figure | None:
        raise NotImplementedError

    def name(self, column: str, value: Any) -> str:
        if isinstance(self.names, str) and is_number(value):
            return self.names.format(f"{float(value):g}")
        for key in ((column, value), value):
            if not isinstance(self.names, str) and key in self.names:
                return self.names[key]
        if column == "patterns" and str(value).partition(":")[0] in FAMILIES:
            return label(str(value))
        if value is None:
            return "scene" if column == "picture" else ""
        return value_name(column, value)

    def combinations(self, rows: DataFrame, by: Columns) -> list[dict[str, Any]]:
        columns = [by] if isinstance(by, str) else list(by)
        lacking = [each not in rows or bool(rows[each].isna().any()) for each in columns]
        values = [[*distinct(rows, each), *([None] if no else [])] for each, no in zip(columns, lacking, strict=True)]
        found = [dict(zip(columns, chosen, strict=True)) for chosen in product(*values)]
        return [each for each in found if len(choose_rows(rows, each))]

    def parts(self, rows: DataFrame, by: Columns) -> dict[str, tuple[DataFrame, str]]:
        if isinstance(by, Mapping):
            return {name: (rows, column) for column, name in by.items() if column in rows}
        chosen = self.combinations(rows, by) if by else [{}]
        return {self.joined(each): (choose_rows(rows, each), "") for each in chosen}

    def joined(self, values: Mapping[str, Any]) -> str:
        return ", ".join(filter(None, (self.name(*item) for item in values.items())))


def is_number(value: Any) -> bool:
    try:
        float(str(value))
    except ValueError:
        return False
    return not isinstance(value, bool)


@dataclass(frozen=True)
class Lines(Panel):
    """Means of a column over another with bars of one standard error.

    Attributes
    ----------
    x, x_label, y, y_label
        columns along the axes, and the axes' names with units.
    colour, facet
        columns of the curves and facets; a mapping shows several columns of numbers instead of ``y``.
    shared
        rows that begin every curve, such as one uniform frame.
    log
        True for a logarithmic x axis.
    """

    x: str
    x_label: str
    _: KW_ONLY
    y: str = "psnr_db"
    y_label: str = PSNR
    colour: Columns = "patterns"
    facet: Columns = "model"
    shared: Where | None = None
    log: bool = False

    def figure(self, results: Results, rows: DataFrame) -> Figure | None:
        from mitsim.report.plots import curves

        if rows.empty:
            return None
        first = None if self.shared is None else choose_rows(rows, self.shared)
        shown: dict[str, dict[str, dict[float, Mean]]] = {}
        for facet, (own, column) in self.parts(rows, self.facet).items():
            begin = own[own.index.isin([] if first is None else first.index)]
            shown[facet] = {
                colour: self._means(begin, other or column or self.y) | self._means(line, other or column or self.y)
                for colour, (line, other) in self.parts(own.drop(begin.index), self.colour).items()
            }
        return curves(shown, self.x_label, self.y_label, log=self.log, title=self.title)

    def _means(self, rows: DataFrame, column: str) -> dict[float, Mean]:
        from pandas import to_numeric

        if column not in rows:
            return {}
        rows = rows[to_numeric(rows[column], errors="coerce").notna()]
        return {
            float(value): mean_of(choose_rows(rows, {self.x: value}), column, error_column=self.errors.get(column, ""))
            for value in distinct(rows, self.x)
        }


@dataclass(frozen=True)
class Bars(Panel):
    """Means of a column as horizontal bars with one standard error, a group for each of ``rows``.

    Attributes
    ----------
    rows, colour
        columns of the groups and of the bars in each; a mapping shows several columns of numbers instead of ``x``.
    ordered
        True for the largest on top; False for the order of the table.
    """

    rows: Columns
    _: KW_ONLY
    colour: Columns = "model"
    x: str = "psnr_db"
    x_label: str = PSNR
    ordered: bool = False

    def figure(self, results: Results, rows: DataFrame) -> Figure | None:
        from mitsim.report.plots import grouped_bars

        if rows.empty:
            return None
        groups: dict[str, dict[str, Mean]] = {}
        for group, (own, column) in self.parts(rows, self.rows).items():
            parts = (
                (bar, line, other or column or self.x) for bar, (line, other) in self.parts(own, self.colour).items()
            )
            groups[group] = {
                bar: mean_of(line, shown, error_column=self.errors.get(shown, ""))
                for bar, line, shown in parts
                if shown in line and line[shown].notna().any()
            }
        groups = {group: bars for group, bars in groups.items() if bars}
        if self.ordered:
            groups = dict(sorted(groups.items(), key=lambda item: -next(iter(item[1].values())).value))
        return grouped_bars(groups, self.x_label, self.title) if groups else None


@dataclass(frozen=True)
class Pivot(Panel):
    """A table of the page: means of the column ``value`` by the values of ``rows`` and ``columns``."""

    rows: Columns
    _: KW_ONLY
    columns: Columns
    value: str = "psnr_db"

    def parts_of(self, results: Results) -> list[Part]:
        chosen, found = choose_rows(results.frame, self.where), []
        for value in distinct(chosen, self.each) if self.each else [None]:
            own = choose_rows(chosen, {} if value is None else {self.each: value})
            heads, lines = list(self.parts(own, self.columns)), []
            for name, (line, _) in self.parts(own, self.rows).items():
                cells, texts = self.parts(line, self.columns), []
                for head in heads:
                    rows, column = cells.get(head, (line[:0], ""))
                    column = column or self.value
                    known = column in rows and bool(rows[column].notna().any())
                    unit = "dB" if column.endswith("_db") else ""
                    texts.append(with_unit(mean_of(rows, column), unit).removesuffix(" dB") if known else DASH)
                lines.append((name, *texts))
            title = ", ".join(filter(None, (self.title, "" if value is None else self.name(self.each, value))))
            found += [Part(title, "", ("", *heads), tuple(lines))] if lines else []
        return found


_MOST_SHOWN = 6


@dataclass(frozen=True)
class Images(Panel):
    """A grid of images with their truths and a caption below each; rows with a missing image are left out.

    Attributes
    ----------
    across, columns
        columns whose combinations are the grid's columns, or (title, caption) by the name of an array; their order.
    down
        columns whose combinations are the grid's rows.
    array, before
        template of the arrays' names, filled from their row; titles of leading arrays by name.
    caption
        template of the text below an image, filled from its row.
    """

    across: str | Sequence[str] | Mapping[str, tuple[str, str]]
    _: KW_ONLY
    columns: Sequence[Any] | None = None
    down: Sequence[str] = ("picture", "model")
    array: str = IMAGE
    before: Mapping[str, str] = field(default_factory=dict)
    caption: str = "{psnr_db:.1f} dB"

    def figure(self, results: Results, rows: DataFrame) -> Figure | None:
        kept = {key for key, _ in results.arrays}
        rows = rows[rows["point"].isin(kept)] if "point" in rows else rows[:0]
        shown: list[tuple[dict[str, Any], str, str]] = [({}, name, "") for name in self.before]
        titles = list(self.before.values())
        if isinstance(self.across, Mapping):
            shown += [({}, name, caption) for name, (_, caption) in self.across.items()]
            titles += [title for title, _ in self.across.values()]
            count = len(titles)
        else:
            chosen = self.combinations(rows, self.across)
            if self.columns is not None:
                chosen = [{str(self.across): value} for value in self.columns]
            shown += [(each, self.array, self.caption) for each in _few(chosen)]
            titles += [self.joined(each) for each in _few(chosen)]
            count = len(self.before) + len(chosen)
        groups = {self.joined(each): choose_rows(rows, each) for each in self.combinations(rows, self.down)}
        grid = {name: [cell for each in shown for cell in _cells(results, own, *each)] for name, own in groups.items()}
        grid = {name: cells for name, cells in grid.items() if len(cells) == len(titles)}
        if not grid:
            return None
        sides = {"columns": (len(titles), count), "rows": (min(len(grid), _MOST_SHOWN), len(grid))}
        cut = ", ".join(f"{few} of {all_} {side}" for side, (few, all_) in sides.items() if few < all_)
        title = f"{self.title}{f' ({cut})' if cut else ''}"
        return grid_with_truths({name: grid[name] for name in _few(list(grid))}, titles, title)


Cell = tuple[FloatArray, FloatArray | None, str]


def _cells(results: Results, rows: DataFrame, where: Where, array: str, caption: str) -> list[Cell]:
    for row in choose_rows(rows, where).to_dict("records"):
        image = results.array(row, array.format(**row))
        if image is not None:
            known = all(measured(row.get(name)) for _, name, kind, _ in Formatter().parse(caption) if kind and name)
            text = caption.format(**row) if known else ""
            flag = "\nflagged" if caption and row.get("flagged") is True else ""
            return [(image, results.array(row, TRUTH) if array == IMAGE else None, text + flag)]
    return []


def _few(items: Sequence[Any]) -> list[Any]:
    count = min(len(items), _MOST_SHOWN)
    return [items[int(place)] for place in np.linspace(0, len(items) - 1, count).round()]


def grid_with_truths(grid: Mapping[str, Sequence[Cell]], titles: Sequence[str], title: str) -> Figure:
    from mitsim.report.plots import image_grid

    truths = {name: [truth for _, truth, _ in cells if truth is not None] for name, cells in grid.items()}
    alone = {name: [(image, caption) for image, _, caption in cells] for name, cells in grid.items()}
    if any(len(truths[name]) < len(cells) for name, cells in grid.items()):
        return image_grid(alone, titles, title)
    if all(np.array_equal(own[0], other) for own in truths.values() for other in own):
        beside = {name: [(truths[name][0], ""), *cells] for name, cells in alone.items()}
        return image_grid(beside, ["truth", *titles], title)
    rows: dict[str, list[tuple[FloatArray, str]]] = {}
    for name, cells in alone.items():
        rows[", ".join(filter(None, ("truth", name)))] = [(truth, "") for truth in truths[name]]
        rows[name or "image"] = cells
    return image_grid(rows, titles, title)


# -------- The page of a study


@dataclass(frozen=True)
class Part:
    title: str
    lead: str = ""
    head: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    figures: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def numeric(self) -> tuple[bool, ...]:
        columns = zip(*self.rows, strict=True)
        begins = re.compile(r"[+-]?\d|nothing$")
        return tuple(any(cells) and all(not cell or begins.match(cell) for cell in cells) for cells in columns)


def text_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    table = [head, *rows] if rows else []
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    sides = [">" if right else "<" for right in Part("", rows=tuple(map(tuple, rows))).numeric]
    return ["  ".join(f"{cell:{side}{width}}" for cell, side, width in zip(row, sides, widths, strict=True)).rstrip()
            for row in table]  # fmt: skip


@dataclass(frozen=True)
class Section:
    """One study on a page; ``pictures`` has data URI and width [pixels] of figures by file name."""

    name: str
    title: str
    message: str
    detail: str
    pictures: Mapping[str, tuple[str, int]]
    parts: tuple[Part, ...] = ()
    claims: tuple[Claim, ...] = ()
    heads: tuple[str, str, str] = HEADS
    warnings: tuple[str, ...] = ()
    note: str = ""
    about: str = ""
    count: str = ""
    command: str = ""
    quick: bool = False
    prints: int = 0


def section_of(
    study: Study, name: str, claims: Sequence[Claim], figures: Mapping[str, Figure], results: Results
) -> Section:
    """Return the section of a study's page; ``name`` is the study's on the command line."""
    scope = results.scope
    prints = sorted({str(row.get("picture")) for row in results.rows} & set(TEST_IMAGES))
    of = f" of the test image{'s' if len(prints) > 1 else ''} {', '.join(prints)} of scikit-image" if prints else ""
    command = ["mitsim study", name, *([] if any(scope.pictures) else [scope.setup.scene]), *_options(scope)]
    accuracies = sorted({point.setup.accuracy for point in study.points(scope)} if study.traced else ())
    named = " or ".join(f"{each:g}" for each in accuracies)
    good = f"; frames before noise asked to be good to {named} (relative rms)" if accuracies else ""
    images_first = sorted(figures, key=lambda file: not file.startswith("images"))
    return Section(
        study.name,
        title=study.title.replace(KNOBS, " and ".join(name for name, _ in scope.sweep)),
        message=tally(claims),
        detail=study.question,
        pictures={file: page_figure(figures[file]) for file in images_first},
        parts=tuple(study.parts(results)),
        claims=tuple(claims),
        heads=study.heads,
        warnings=flag_warnings(study.name, results),
        note=study.note,
        about=study.about,
        count=f"{len(results.rows)} measurements{of}{good}",
        command=" ".join(command),
        quick=scope.quick,
        prints=len(prints),
    )


def tally(claims: Sequence[Claim]) -> str:
    part, open_ = "confirmed in part", "not decided"
    counts = Counter(
        each if each in (CONFIRMED, NOT_CONFIRMED) else part if each.startswith(CONFIRMED) else open_
        for each in (claim.verdict for claim in claims)
    )
    kinds = [f"{counts[kind]} {kind}" for kind in (CONFIRMED, part, NOT_CONFIRMED, open_) if counts[kind]]
    return f"{len(claims)} claim{'s' * (len(claims) > 1)}: {', '.join(kinds)}" if claims else ""


_IMAGE = "point", "psnr_db", "exposure", "model", "picture", "condition", "method", "weight"


def flag_warnings(name: str, results: Results) -> tuple[str, ...]:
    # An image may have many rows, such as a transfer function's.
    rows = {tuple(map(row.get, _IMAGE)): row for row in results.rows if row.get("flagged") is not None}
    found = [str(row.get("reason") or "") for row in rows.values() if row["flagged"]]
    if not found:
        return ()
    reasons = Counter(reason for each in found for reason in each.split("; ") if reason)
    counts = "; ".join(f"{count} \N{MULTIPLICATION SIGN} {reason}" for reason, count in reasons.most_common())
    return (
        f"{len(found)} of {len(rows)} images are flagged by the solver, their calibration or their capture, but "
        f"included in the means (column flagged of {name}.csv){': ' if counts else ''}{counts}.",
    )


def write_page(sections: Sequence[Section], path: Path, title: str) -> Path:
    """Write a page of one study, or of several with the verdicts of all first."""
    message = sections[0].message if len(sections) == 1 else tally([claim for one in sections for claim in one.claims])
    page = render_page("study.html", title=title, message=message or title, sections=sections, versions=versions())
    write_text(path, page)
    return path


def _options(scope: Scope) -> list[str]:
    setup = scope.setup
    given: list[tuple[str, Any]] = [
        ("--camera", setup.camera), ("--projector", setup.projector),
        *(("-D", f"{name}={value}") for name, value in setup.parameters),
        *(("--over", f"{name}={','.join(values)}") for name, values in scope.sweep),
        ("--measure", ",".join(scope.measures)),
        ("--patterns", scope.patterns if scope.patterns != Scope.patterns else None),
        ("--recipe", scope.recipe), ("--data", scope.data), ("--seed", scope.seeds[0]),
        ("--variant", setup.variant if setup.variant != Setup.variant else None),
    ]  # fmt: skip
    flags = {"--allow-outside-files": setup.outside, "--quick": scope.quick}
    return [f"{option} {value}" for option, value in given if value] + [flag for flag, on in flags.items() if on]
