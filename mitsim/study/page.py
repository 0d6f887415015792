"""Finished studies in, one self-contained HTML page out: claims, figures, and the commands that repeat them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from mitsim.core.output import whole_file
from mitsim.core.pictures import data_uri
from mitsim.core.versions import versions
from mitsim.study.experiment import HEADS, Claim, Experiment, PageTable, Results, Scope
from mitsim.study.pictures import TEST_IMAGES

_DPI, _SHOWN_DPI = 220, 110
"""Figures are 8.6 inches wide at most: 946 pixels of the page, in two dots each."""


@dataclass(frozen=True)
class Section:
    """One study on a page; ``pictures`` are figures by file name: what holds each, and its width [pixels]; ``about``
    and ``heads`` are the experiment's."""

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
        return cls(
            name=experiment.name,
            title=experiment.title,
            question=experiment.question,
            claims=tuple(claims),
            pictures={name: (_address(figure), _width(figure)) for name, figure in figures.items()},
            count=f"{len(results.table)} measurements{means}, light to {setup.accuracy:g}",
            command=" ".join(command),
            about=experiment.about,
            heads=experiment.heads,
            tables=tuple(experiment.tables(results)),
        )


@dataclass(frozen=True)
class Part:
    """Of a page of one study: a table of ``rows`` under ``head``, in words, and ``figures`` by file name."""

    title: str
    lead: str
    head: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    figures: tuple[str, ...] = ()


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
    pictures = {file: (_address(figure), _width(figure)) for file, figure in figures.items()}
    template = _environment().get_template("findings.html")
    return template.render(name=name, title=title, where=where, parts=parts, pictures=pictures, versions=versions())


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
    text = _environment().get_template("study.html").render(title=title, sections=sections, versions=versions())
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")
    return path


def _environment() -> Environment:
    loader = PackageLoader("mitsim.study")
    return Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True)


def _options(scope: Scope) -> list[str]:
    setup = scope.setup
    named = {"--camera": setup.camera, "--projector": setup.projector}
    given = [f"{option} {value}" for option, value in named.items() if value]
    given += [f"-D {name}={value}" for name, value in setup.parameters]
    given += [f"--over {name}={','.join(values)}" for name, values in scope.sweep]
    given += [f"--recipe {scope.recipe}"] if scope.recipe else []
    return [*given, *(["--quick"] if scope.quick else [])]


def _width(figure: Figure) -> int:
    """On the page: letters have one size in all figures."""
    return round(float(figure.get_figwidth()) * _SHOWN_DPI)


def _address(figure: Figure) -> str:
    figure.savefig(buffer := BytesIO(), format="png", dpi=_DPI)
    return data_uri(buffer.getvalue())
