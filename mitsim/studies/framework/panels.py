"""Figures and tables of a study, declared over columns of its table, and the study's page.

A panel names the columns along its axes and averages over every other column that varies, by
:func:`mitsim.studies.framework.claims.mean_of`.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from itertools import product
from pathlib import Path
from string import Formatter
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import versions
from mitsim.core.files import write_text
from mitsim.report import label
from mitsim.report.pages import DASH, Mean, page_figure, render_page, scene_name, subject
from mitsim.studies.framework.claims import (
    Where,
    choose_rows,
    distinct,
    mean_of,
    measured,
    tally,
    value_name,
    with_unit,
)
from mitsim.studies.framework.experiment import HEADS, IMAGE, KNOBS, TEST_IMAGES, TRUTH, Claim, Results, Study

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
    interval
        True for means with their 95 % intervals, False for means with one standard error.
    """

    _: KW_ONLY
    file: str = ""
    title: str = ""
    where: Where = field(default_factory=dict)
    each: str = ""
    names: Names = field(default_factory=dict)
    errors: Mapping[str, str] = field(default_factory=dict)
    interval: bool = False

    def draw(self, results: Results) -> dict[str, Any]:
        """Return the figures, or the tables of a page, by file name."""
        rows = choose_rows(results.frame, self.where)
        measure = str(getattr(self, "y", getattr(self, "x", ""))).removesuffix("_db") or "images"
        drawn: dict[str, Any] = {}
        for value in distinct(rows, self.each) if self.each else [""]:
            shown = f"exposure {value}" if self.each == "exposure" else self.name(self.each, value)
            one = replace(self, title=", ".join(filter(None, (self.title, shown))))
            name = "_".join(filter(None, (self.file or measure, str(value)))).replace(" ", "_").replace(":", "")
            own = choose_rows(rows, {self.each: value} if self.each else {})
            if not own.empty and (figure := one.figure(results, own)) is not None:
                drawn[f"{name}.png"] = figure
        return drawn

    def figure(self, results: Results, rows: DataFrame) -> Any:
        raise NotImplementedError

    def name(self, column: str, value: Any) -> str:
        if isinstance(self.names, str) and is_number(value):
            return self.names.format(f"{float(value):g}")
        for key in ((column, value), value):
            if not isinstance(self.names, str) and key in self.names:
                return self.names[key]
        if value is None:
            return "scene" if column == "picture" else ""
        return value_name(column, value, label)

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

    def cells(self, rows: DataFrame, first: Columns, second: Columns, column: str) -> dict[str, dict[str, Mean]]:
        """Return the means of a ``column`` by the combinations of two lists of columns."""
        return {
            name: {
                inner: self.mean(line, shown)
                for inner, (line, third) in self.parts(own, second).items()
                if (shown := third or other or column) in line and line[shown].notna().any()
            }
            for name, (own, other) in self.parts(rows, first).items()
        }

    def mean(self, rows: DataFrame, column: str) -> Mean:
        found = mean_of(rows, column, error_column=self.errors.get(column, ""))
        return found._replace(error=found.reach) if self.interval else found

    def joined(self, values: Mapping[str, Any]) -> str:
        return ", ".join(filter(None, (self.name(*item) for item in values.items())))


def is_number(value: Any) -> bool:
    try:
        float(str(value))
    except ValueError:
        return False
    return True


@dataclass(frozen=True)
class Lines(Panel):
    """Means of a column over another with bars of their errors.

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

    def figure(self, results: Results, rows: DataFrame) -> Figure:
        from pandas import to_numeric

        from mitsim.report.plots import curves

        begin = rows[:0] if self.shared is None else choose_rows(rows, self.shared)
        shown: dict[str, dict[str, dict[float, Mean]]] = {}
        for facet, (own, other) in self.parts(rows, self.facet).items():
            shown[facet], first = {}, own.index.intersection(begin.index)
            for colour, (line, third) in self.parts(own.drop(first), self.colour).items():
                column, line = third or other or self.y, own.loc[first.append(line.index)]
                line = line[to_numeric(line[column], errors="coerce").notna()] if column in line else line[:0]
                shown[facet][colour] = {
                    float(x): self.mean(choose_rows(line, {self.x: x}), column) for x in distinct(line, self.x)
                }
        return curves(shown, self.x_label, self.y_label, log=self.log, title=self.title)


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

        groups = {group: bars for group, bars in self.cells(rows, self.rows, self.colour, self.x).items() if bars}
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

    def figure(self, results: Results, rows: DataFrame) -> Part | None:
        shown = {name: column for column, name in self.columns.items()} if isinstance(self.columns, Mapping) else {}

        def text(mean: Mean, head: str) -> str:
            return with_unit(mean, "dB" if shown.get(head, self.value).endswith("_db") else "").removesuffix(" dB")

        heads = list(self.parts(rows, self.columns))
        lines = tuple(
            (name, *(text(cells[head], head) if head in cells else DASH for head in heads))
            for name, cells in self.cells(rows, self.rows, self.columns, self.value).items()
        )
        return Part(self.title, "", ("", *heads), lines) if lines else None


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
        from mitsim.report.plots import image_grid

        kept = {key for key, _ in results.arrays}
        rows = rows[rows["point"].isin(kept)] if "point" in rows else rows[:0]
        shown: list[tuple[dict[str, Any], str, str, str]] = [
            ({}, name, "", title) for name, title in self.before.items()
        ]
        left_out = 0
        if isinstance(self.across, Mapping):
            shown += [({}, name, caption, title) for name, (title, caption) in self.across.items()]
        else:
            chosen = self.combinations(rows, self.across)
            if self.columns is not None:
                chosen = [{str(self.across): value} for value in self.columns]
            shown += [(each, self.array, self.caption, self.joined(each)) for each in _few(chosen)]
            left_out = len(chosen) - len(_few(chosen))
        groups = {self.joined(each): choose_rows(rows, each) for each in self.combinations(rows, self.down)}
        grid = {
            name: [cell for each in shown for cell in self._cell(results, own, *each[:3])]
            for name, own in groups.items()
        }
        grid = {name: cells for name, cells in grid.items() if len(cells) == len(shown)}
        if not grid:
            return None
        sides = {"columns": (len(shown), len(shown) + left_out), "rows": (min(len(grid), _MOST_SHOWN), len(grid))}
        cut = ", ".join(f"{few} of {all_} {side}" for side, (few, all_) in sides.items() if few < all_)
        title, titles = f"{self.title}{f' ({cut})' if cut else ''}", [each[3] for each in shown]
        grid = {name: grid[name] for name in _few(list(grid))}
        truths = {name: [truth for _, truth, _ in cells if truth is not None] for name, cells in grid.items()}
        alone = {name: [(image, caption) for image, _, caption in cells] for name, cells in grid.items()}
        if any(len(truths[name]) < len(cells) for name, cells in grid.items()):
            return image_grid(alone, titles, title)
        if all(np.array_equal(own[0], other) for own in truths.values() for other in own):
            beside = {name: [(truths[name][0], ""), *cells] for name, cells in alone.items()}
            return image_grid(beside, ["truth", *titles], title)
        above = {}
        for name, cells in alone.items():
            above[", ".join(filter(None, ("truth", name)))] = [(truth, "") for truth in truths[name]]
            above[name or "image"] = cells
        return image_grid(above, titles, title)

    def _cell(
        self, results: Results, rows: DataFrame, where: Where, array: str, caption: str
    ) -> Iterator[tuple[FloatArray, FloatArray | None, str]]:
        """Yield image, truth and caption of the first row that has an image, if any."""
        for row in choose_rows(rows, where).to_dict("records"):
            image = results.array(row, array.format(**row))
            if image is not None:
                known = all(measured(row.get(name)) for _, name, kind, _ in Formatter().parse(caption) if kind and name)
                text = caption.format(**row) if known else ""
                flag = "\nflagged" if caption and row.get("flagged") is True else ""
                yield image, results.array(row, TRUTH) if array == IMAGE else None, text + flag
                return


def _few(items: Sequence[Any]) -> list[Any]:
    count = min(len(items), _MOST_SHOWN)
    return [items[int(place)] for place in np.linspace(0, len(items) - 1, count).round()]


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
        begins = re.compile(rf"[+-]?\d|nothing$|{DASH}$")
        return tuple(any(cells) and all(not cell or begins.match(cell) for cell in cells) for cells in columns)

    def lines(self) -> list[str]:
        """Return the table as text, and the notes."""
        table = [self.head, *self.rows] if self.rows else []
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        sides = [">" if right else "<" for right in self.numeric]
        rows = [
            [f"{cell:{side}{width}}" for cell, side, width in zip(row, sides, widths, strict=True)] for row in table
        ]
        return [*("  ".join(row).rstrip() for row in rows), *self.notes]


@dataclass(frozen=True)
class Section:
    """One study on a page; ``pictures`` has data URI and width [pixels] of figures by file name.

    ``pages`` has the contents of further pages by their places.
    """

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
    command: str | None = None
    quick: bool = False
    prints: int = 0
    scene: str = ""
    camera: str = ""
    pages: Mapping[str, str] = field(default_factory=dict)


def section_of(
    study: Study, claims: Sequence[Claim], figures: Mapping[str, Figure], results: Results, command: str | None = None
) -> Section:
    """Return the section of a study's page; ``command`` made its points, None if it was not a command line."""
    scope, setup = results.scope, results.scope.setup
    prints = sorted({str(row.get("picture")) for row in results.rows} & set(TEST_IMAGES))
    of = f" of the test image{'s' if len(prints) > 1 else ''} {', '.join(prints)} of scikit-image" if prints else ""
    accuracies = sorted({point.setup.accuracy for point in study.points(scope)} if study.traced else ())
    named = " or ".join(f"{each:g}" for each in accuracies)
    good = f"; frames before noise asked to be good to {named} (relative rms)" if accuracies else ""
    scene = scene_name(Path(setup.scene))
    return Section(
        study.name,
        title=study.title.replace(KNOBS, " and ".join(name for name, _ in scope.sweep)),
        message=tally(claims),
        detail=study.question,
        pictures={
            file: page_figure(figures[file]) for file in sorted(figures, key=lambda file: not file.startswith("images"))
        },
        parts=tuple(study.parts(results)),
        claims=tuple(claims),
        heads=study.heads,
        warnings=flag_warnings(study.name, results),
        note=study.note,
        about=study.about,
        count=f"{len(results.rows)} measurement{'s' * (len(results.rows) > 1)}{of}{good}",
        command=command,
        quick=scope.quick,
        prints=len(prints),
        scene=f"{len(prints)} test image{'s' * (len(prints) > 1)} on {scene}" if prints else scene,
        camera=Path(setup.camera).stem if setup.camera else "the scene's camera",
    )


def flag_warnings(name: str, results: Results) -> tuple[str, ...]:
    # An image may have many rows, such as a transfer function's.
    image = "point", "psnr_db", "exposure", "model", "picture", "condition", "method", "weight"
    rows = {tuple(map(row.get, image)): row for row in results.rows if row.get("flagged") is not None}
    found = [str(row.get("reason") or "") for row in rows.values() if row["flagged"]]
    if not found:
        return ()
    reasons = Counter(reason for each in found for reason in each.split("; ") if reason)
    counted = "; ".join(f"{count} \N{MULTIPLICATION SIGN} {reason}" for reason, count in reasons.most_common())
    flagged = f"{len(found)} of {len(rows)} images are flagged: {counted or 'no reason is stated'}"
    return (f"{flagged}; the means include them (column flagged of {name}.csv)",)


def write_page(sections: Sequence[Section], path: Path, title: str, message: str = "") -> Path:
    """Write a page of one study, or of several with the verdicts of all first; ``message`` is the headline."""
    message = message or tally([claim for one in sections for claim in one.claims]) or sections[0].message
    scenes, cameras = {one.scene for one in sections}, {one.camera for one in sections}
    scene, camera = (names.pop() if len(names) == 1 else "" for names in (scenes, cameras))
    images = any(file.startswith("images") for one in sections for file in one.pictures)
    shown: dict[str, Any] = {"message": message or title, "sections": sections, "images": images}
    page = render_page("study.html", title=f"{title}: {subject(scene, camera)}", **shown, versions=versions())
    write_text(path, page)
    return path
