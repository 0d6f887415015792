"""What all studies share: a bench and what to measure in; findings, and the folder that holds them, out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from mitsim.capture.bench import Bench
from mitsim.capture.request import Request
from mitsim.core.job import Job
from mitsim.core.jsonfile import write_json
from mitsim.core.output import whole_file
from mitsim.core.versions import versions
from mitsim.study.folder import study_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mitsim.study.page import Part
    from mitsim.study.table import Table

DPI = 150
"""Figures are 8.6 inches wide: 1290 pixels, the width of a page of text on a common screen."""


def write_figures(folder: Path, figures: Mapping[str, Figure]) -> None:
    """Write ``figures``, by file name, to a ``folder``; MitsimError when one cannot be written."""
    for file, figure in figures.items():
        with whole_file(folder / file) as part:
            figure.savefig(part, dpi=DPI, format="png")


class Findings(Protocol):
    """What a study measured."""

    def payload(self) -> dict[str, Any]:
        """As JSON holds it."""

    def lines(self) -> list[str]:
        """For people."""

    def figures(self) -> Mapping[str, Figure]:
        """By file name."""


@runtime_checkable
class Tabled(Protocol):
    """Findings with tables."""

    def tables(self) -> Mapping[str, Table]:
        """By file name."""


@runtime_checkable
class Warned(Protocol):
    """Findings that may not be trusted."""

    @property
    def warnings(self) -> Sequence[str]:
        """What is wrong, and what to do; empty where nothing is."""


@runtime_checkable
class Paged(Protocol):
    """Findings with a page."""

    title: str

    def parts(self) -> Sequence[Part]:
        """Of the page."""


@dataclass(frozen=True)
class StudyResult:
    """Findings, of which scene and patterns they are (None: of none), and the folder ``output`` that holds them."""

    findings: Findings
    scene: str | None
    patterns: str | None
    output: str

    def payload(self) -> dict[str, Any]:
        """What the command line reports."""
        where = {"scene": self.scene, "patterns": self.patterns, "output": self.output}
        return {**self.findings.payload(), **where}

    def lines(self) -> list[str]:
        """For people."""
        return [*self.findings.lines(), f"JSON and plots: {self.output}"]

    @property
    def warnings(self) -> Sequence[str]:
        """Of the findings."""
        return self.findings.warnings if isinstance(self.findings, Warned) else ()


Measure = Callable[[Any, Request, Job], Findings]
Study = Callable[[Bench | None, Path | str, Request | None, Job | None], StudyResult]


def run_study(
    name: str,
    measure: Measure,
    bench: Bench | None,
    output: Path | str,
    request: Request | None = None,
    job: Job | None = None,
) -> StudyResult:
    """Measure, and write NAME.json, figures, tables and a page, where there are such, to a folder.

    MitsimError for an output that cannot be written or holds something else, and for what the study itself refuses.

    Parameters
    ----------
    name, measure
        of the study.
    bench, request, job
        what is studied: the scene, patterns and seed; clock, progress and limits. None for a study of no scene.
    output
        new or empty folder, or one with an earlier study of that name, which is replaced.
    """
    request = request or Request.of()
    with study_folder(output, name) as folder:
        findings = measure(bench, request, job or Job())
        scene, patterns = (str(bench.loaded.path), request.patterns) if bench else (None, None)
        result = StudyResult(findings, scene, patterns, str(folder))
        provenance = {"kind": name, "seed": request.seed, "versions": versions()}
        write_json(folder / f"{name}.json", {**result.payload(), **provenance})
        figures = findings.figures()
        write_figures(folder, figures)
        if isinstance(findings, Paged):
            from mitsim.study.page import build_findings

            where = f"Scene {bench.loaded.path.parent.name}, " if bench else ""
            where += f"patterns {patterns}, seed {request.seed}."
            page = build_findings(name, findings.title, where, findings.parts(), figures, result.warnings)
            with whole_file(folder / f"{name}.html") as part:
                part.write_text(page, encoding="utf-8")
        for file, table in findings.tables().items() if isinstance(findings, Tabled) else ():
            table.write(folder / file)
        return result
