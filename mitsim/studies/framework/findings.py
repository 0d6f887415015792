"""What a study of one bench found, and a characterisation: tables in words and figures, as text and as a page."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap

from mitsim.core.environment import versions
from mitsim.report.pages import render_page

_NUMBER = re.compile(r"[+-]?\d|nothing$")
"""How a cell of a column of numbers begins."""
_LETTERS = 100
"""Of a line of text, as wide as most terminals."""


@dataclass(frozen=True)
class Part:
    """Of a page of one study: a table of ``rows`` under ``head``, in words, ``figures`` by file name, and ``notes``
    that say how these are to be read."""

    title: str
    lead: str
    head: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    figures: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def numeric(self) -> tuple[bool, ...]:
        """Of which columns all cells begin with a number: these stand to the right."""
        return _numeric(self.rows)

    def lines(self) -> list[str]:
        """As text: the title, what leads to the table, and the table."""
        return [f"{self.title}:", *wrap(self.lead, _LETTERS), *text_table(self.head, self.rows)]


def text_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table of ``rows`` under their ``head``, its columns as wide as they need be; none without rows."""
    table = [head, *rows] if rows else []
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    sides = [str.rjust if right else str.ljust for right in _numeric(rows)]
    lines = [[side(*cell) for side, cell in zip(sides, zip(row, widths, strict=True), strict=True)] for row in table]
    return ["  ".join(cells).rstrip() for cells in lines]


def _numeric(rows: Sequence[Sequence[str]]) -> tuple[bool, ...]:
    columns = zip(*rows, strict=True)
    return tuple(any(cells) and all(not cell or _NUMBER.match(cell) for cell in cells) for cells in columns)


def build_findings(
    name: str,
    titles: tuple[str, str],
    where: str,
    parts: Sequence[Part],
    pictures: Mapping[str, tuple[str, int]],
    warnings: Sequence[str] = (),
) -> str:
    """The page of a study of one bench, as HTML.

    Parameters
    ----------
    name, titles
        of the study, and the page's title and message, which may be empty.
    where
        of which scene and patterns it is.
    parts
        of the page, in order.
    pictures
        figures by file name: what holds each, and its width [pixels] (:func:`mitsim.report.pages.page_figure`).
    warnings
        why its findings may not be trusted, for its head.
    """
    title, message = titles
    return render_page(
        "findings.html",
        name=name,
        title=title,
        message=message or title,
        where=where,
        parts=parts,
        pictures=pictures,
        warnings=warnings,
        versions=versions(),
    )
