"""The page of a study, self-contained HTML: what it found, why it may not be trusted, claims, figures, tables, and the
command that repeats it; and tables as text."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap

from matplotlib.figure import Figure

from mitsim.core.environment import versions
from mitsim.core.files import write_text
from mitsim.report.pages import page_figure, render_page
from mitsim.studies.framework.claims import CONFIRMED, NOT_CONFIRMED
from mitsim.studies.framework.experiment import HEADS, KNOBS, TEST_IMAGES, Claim, Results, Scope, Setup, Study

_IN_PART, _NOT_DECIDED = "confirmed in part", "not decided"
"""Kinds in a tally: claims that hold somewhere, and claims that more prints or seeds would decide."""
_NUMBER = re.compile(r"[+-]?\d|nothing$")
"""Beginning of a cell in a column of numbers."""
_LETTERS = 100
"""Letters of a line of text, as wide as most terminals."""


@dataclass(frozen=True)
class Part:
    """A part of a page: a ``title``, a ``lead``, ``figures`` by file name, a table of ``rows`` of words under its
    ``head``, and ``notes`` on how to read them."""

    title: str
    lead: str = ""
    head: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    figures: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def numeric(self) -> tuple[bool, ...]:
        """True for each column whose cells all begin with a number, which are set to the right."""
        return _numeric(self.rows)

    def lines(self) -> list[str]:
        """Return title, lead and table as text."""
        return [f"{self.title}:", *wrap(self.lead, _LETTERS), *text_table(self.head, self.rows)]


def text_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table of ``rows`` under their ``head``; none without rows."""
    table = [head, *rows] if rows else []
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    sides = [str.rjust if right else str.ljust for right in _numeric(rows)]
    lines = [[side(*cell) for side, cell in zip(sides, zip(row, widths, strict=True), strict=True)] for row in table]
    return ["  ".join(cells).rstrip() for cells in lines]


def _numeric(rows: Sequence[Sequence[str]]) -> tuple[bool, ...]:
    columns = zip(*rows, strict=True)
    return tuple(any(cells) and all(not cell or _NUMBER.match(cell) for cell in cells) for cells in columns)


@dataclass(frozen=True)
class Section:
    """One study on a page.

    Attributes
    ----------
    name, title, message, detail
        study, heading, first sentence, and the question or the scene that it is about.
    pictures
        figures by file name: the data URI of each, and its width [pixels].
    parts, claims, heads
        tables with their figures; judged claims and the heads of their figures.
    warnings
        reasons why the findings may not be trusted.
    note, about, count, command
        remarks on the figures; how the study was measured; the number of measurements; the command that repeats them.
    quick, prints
        True for a few points alone; number of test images that means are taken over.
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
    command: str = ""
    quick: bool = False
    prints: int = 0

    @classmethod
    def of(
        cls, study: Study, name: str, claims: Sequence[Claim], figures: Mapping[str, Figure], results: Results
    ) -> Section:
        """Return the section of a study of many points.

        Parameters
        ----------
        study, name
            study, and its name on the command line.
        claims, figures, results
            judged claims, figures by file name, and all results.
        """
        scope = results.scope
        prints = sorted({str(row.get("picture")) for row in results.rows} & set(TEST_IMAGES))
        of = f" of the test image{'s' if len(prints) > 1 else ''} {', '.join(prints)} of scikit-image" if prints else ""
        command = ["mitsim study", name, *([] if any(scope.pictures) else [scope.setup.scene]), *_options(scope)]
        accuracies = sorted({point.setup.accuracy for point in study.points(scope)} if study.traced else ())
        named = " or ".join(f"{each:g}" for each in accuracies)
        good = f"; frames before noise asked to be good to {named} (relative rms)" if accuracies else ""
        return cls(
            study.name,
            title=study.title.replace(KNOBS, " and ".join(name for name, _ in scope.sweep)),
            message=study.message(results) or tally(claims),
            detail=study.question,
            pictures={name: page_figure(figures[name]) for name in sorted(figures, key=_images_first)},
            parts=tuple(study.tables(results)),
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
    """Return how many ``claims`` hold; an empty text without claims."""
    counts = Counter(
        each.verdict
        if each.verdict in (CONFIRMED, NOT_CONFIRMED)
        else _IN_PART
        if each.verdict.startswith(CONFIRMED)
        else _NOT_DECIDED
        for each in claims
    )
    kinds = [f"{counts[kind]} {kind}" for kind in (CONFIRMED, _IN_PART, NOT_CONFIRMED, _NOT_DECIDED) if counts[kind]]
    return f"{len(claims)} claim{'s' * (len(claims) > 1)}: {', '.join(kinds)}" if claims else ""


def _images_first(file: str) -> bool:
    return not file.startswith("images")


_IMAGE = "point", "psnr_db", "exposure", "model", "picture", "condition", "method", "weight", "lux", "draw"
"""Columns whose values together are of one image."""


def flag_warnings(name: str, results: Results) -> tuple[str, ...]:
    """Return a warning of how many images of the study ``name`` are flagged, and why; nothing if none is."""
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


def page_of(sections: Sequence[Section], title: str) -> str:
    """Return the page of some ``sections`` under a ``title`` as HTML."""
    message = sections[0].message if len(sections) == 1 else tally([claim for one in sections for claim in one.claims])
    return render_page("study.html", title=title, message=message or title, sections=sections, versions=versions())


def build_page(sections: Sequence[Section], path: Path, title: str) -> Path:
    """Write the page of some ``sections`` under a ``title`` to ``path``, all or nothing, and return the path.

    MitsimError when it cannot be written.
    """
    write_text(path, page_of(sections, title))
    return path


def build_findings(
    name: str,
    titles: tuple[str, str],
    where: str,
    parts: Sequence[Part],
    pictures: Mapping[str, tuple[str, int]],
    warnings: Sequence[str] = (),
) -> str:
    """Return the page of a study of one bench as HTML.

    Parameters
    ----------
    name, titles
        study, and the page's title and message, which may be empty.
    where, parts, pictures, warnings
        scene and patterns, and the rest as of :class:`Section`.
    """
    title, message = titles
    return page_of([Section(name, title, message, where, pictures, tuple(parts), warnings=tuple(warnings))], title)


def _options(scope: Scope) -> list[str]:
    setup = scope.setup
    named = {"--camera": setup.camera, "--projector": setup.projector}
    given = [f"{option} {value}" for option, value in named.items() if value]
    given += [f"-D {name}={value}" for name, value in setup.parameters]
    given += [f"--over {name}={','.join(values)}" for name, values in scope.sweep]
    given += [f"--measure {','.join(scope.measures)}"] if scope.measures else []
    given += [f"--patterns {scope.patterns}"] if scope.patterns != Scope.patterns else []
    given += [f"--recipe {scope.recipe}"] if scope.recipe else []
    given += [f"--data {scope.data}"] if scope.data else []
    given += [f"--seed {scope.seeds[0]}"] if scope.seeds[0] != Scope.seeds[0] else []
    given += [f"--variant {setup.variant}"] if setup.variant != Setup.variant else []
    return [*given, *(["--allow-outside-files"] if setup.outside else []), *(["--quick"] if scope.quick else [])]
