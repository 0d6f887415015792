"""Finished studies in, one self-contained HTML page out: claims, figures, and the commands that repeat them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from mitsim.core.versions import versions
from mitsim.study.experiment import HEADS, Claim, Experiment, PageTable, Results, Scope
from mitsim.study.html import rendered, shown_figure, write_html
from mitsim.study.pictures import TEST_IMAGES

_NUMBER = re.compile(r"[+-]?\d|nothing$")
"""How a cell of a column of numbers begins."""


@dataclass(frozen=True)
class Section:
    """One study on a page; ``pictures`` are figures by file name: what holds each, and its width [pixels]; ``about``
    and ``heads`` are the experiment's; ``quick``: of a few points alone."""

    name: str
    title: str
    question: str
    claims: tuple[Claim, ...]
    pictures: Mapping[str, tuple[str, int]]
    count: str
    command: str
    about: str = ""
    heads: tuple[str, str, str] = HEADS
    tables: tuple[PageTable, ...] = ()
    quick: bool = False

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        study: str,
        scope: Scope,
        claims: Sequence[Claim],
        figures: Mapping[str, Figure],
        results: Results,
    ) -> Section:
        """The section of an experiment.

        Parameters
        ----------
        experiment, study, scope
            what was studied, and what the command line calls it.
        claims, figures, results
            what it came to.
        """
        prints = set(results.table.distinct("picture")) & set(TEST_IMAGES)
        means = f", over {len(prints)} test images" if len(prints) > 1 else ""
        setup = scope.setup
        command = ["mitsim study", study, *([] if any(scope.pictures) else [setup.scene]), *_options(scope)]
        good = f"frames before noise good to {setup.accuracy:g} (relative rms)"
        return cls(
            name=experiment.name,
            title=experiment.title,
            question=experiment.question,
            claims=tuple(claims),
            pictures={name: shown_figure(figure) for name, figure in figures.items()},
            count=f"{len(results.table)} measurements{means}; {good}",
            command=" ".join(command),
            about=experiment.about,
            heads=experiment.heads,
            tables=tuple(experiment.tables(results)),
            quick=scope.quick,
        )


@dataclass(frozen=True)
class Part:
    """Of a page of one study: a table of ``rows`` under ``head``, in words, and ``figures`` by file name."""

    title: str
    lead: str
    head: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    figures: tuple[str, ...] = ()

    @property
    def numeric(self) -> tuple[bool, ...]:
        """Of which columns all cells begin with a number: these stand to the right."""
        columns = zip(*self.rows, strict=True)
        return tuple(any(cells) and all(not cell or _NUMBER.match(cell) for cell in cells) for cells in columns)


def build_findings(name: str, title: str, where: str, parts: Sequence[Part], figures: Mapping[str, Figure]) -> str:
    """The page of a study of one bench, as HTML.

    Parameters
    ----------
    name, title
        of the study, and the page's head.
    where
        of which scene and patterns it is.
    parts
        of the page, in order.
    figures
        by file name.
    """
    pictures = {file: shown_figure(figure) for file, figure in figures.items()}
    return rendered(
        "findings.html", name=name, title=title, where=where, parts=parts, pictures=pictures, versions=versions()
    )


def build_page(sections: Sequence[Section], path: Path, title: str) -> Path:
    """Write a page, all or nothing, and return its path.

    MitsimError when it cannot be written.

    Parameters
    ----------
    sections, title
        what it shows, and its head.
    path
        where.
    """
    return write_html(path, rendered("study.html", title=title, sections=sections, versions=versions()))


def _options(scope: Scope) -> list[str]:
    setup = scope.setup
    named = {"--camera": setup.camera, "--projector": setup.projector}
    given = [f"{option} {value}" for option, value in named.items() if value]
    given += [f"-D {name}={value}" for name, value in setup.parameters]
    given += [f"--over {name}={','.join(values)}" for name, values in scope.sweep]
    given += [f"--recipe {scope.recipe}"] if scope.recipe else []
    return [*given, *(["--quick"] if scope.quick else [])]
