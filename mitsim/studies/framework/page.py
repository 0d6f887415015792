"""Finished studies in, one self-contained HTML page out: claims, figures, and the commands that repeat them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from mitsim.core.environment import versions
from mitsim.core.files import write_text
from mitsim.report.pages import page_figure, render_page
from mitsim.studies.framework.claims import CONFIRMED, NOT_CONFIRMED
from mitsim.studies.framework.experiment import KNOBS, TEST_IMAGES, Claim, PageTable, Results, Scope, Setup, Study

_IN_PART, _NOT_DECIDED = "confirmed in part", "not decided"
"""What a tally says of claims that hold somewhere, and of those that more prints or seeds would decide."""


@dataclass(frozen=True)
class Section:
    """One study on a page; ``message`` is what it says first; ``pictures`` are figures by file name: what holds each,
    and its width [pixels]; ``quick``: of a few points alone; ``warnings`` are on what was measured; ``prints``: over
    how many test images means are."""

    experiment: Study
    title: str
    message: str
    claims: tuple[Claim, ...]
    pictures: Mapping[str, tuple[str, int]]
    count: str
    command: str
    tables: tuple[PageTable, ...]
    quick: bool
    warnings: tuple[str, ...]
    prints: int

    @classmethod
    def of(
        cls,
        experiment: Study,
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
        prints = sorted({row.get("picture") for row in results.rows} & set(TEST_IMAGES))
        of = f" of the test image{'s' if len(prints) > 1 else ''} {', '.join(prints)} of scikit-image" if prints else ""
        setup = scope.setup
        command = ["mitsim study", study, *([] if any(scope.pictures) else [setup.scene]), *_options(scope)]
        accuracies = sorted({point.setup.accuracy for point in experiment.points(scope)} if experiment.traced else ())
        named = " or ".join(f"{each:g}" for each in accuracies)
        good = f"; frames before noise asked to be good to {named} (relative rms)" if accuracies else ""
        return cls(
            experiment=experiment,
            title=experiment.title.replace(KNOBS, " and ".join(name for name, _ in scope.sweep)),
            message=experiment.message(results) or tally(claims),
            claims=tuple(claims),
            pictures={name: page_figure(figures[name]) for name in sorted(figures, key=_images_first)},
            count=f"{len(results.rows)} measurements{of}{good}",
            command=" ".join(command),
            tables=tuple(experiment.tables(results)),
            quick=scope.quick,
            warnings=flag_warnings(experiment.name, results),
            prints=len(prints),
        )


def tally(claims: Sequence[Claim]) -> str:
    """How many of some ``claims`` hold; empty of none."""
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


def flag_warnings(name: str, results: Results) -> tuple[str, ...]:
    """That images of the study ``name`` are flagged in its ``results``, how many and what for; empty where none is."""
    # An image may have many rows, such as a transfer function's.
    rows = {
        (row.get("point"), row.get("exposure"), row.get("psnr_db")): row
        for row in results.rows
        if row.get("flagged") is not None
    }
    found = [str(row.get("reason") or "") for row in rows.values() if row["flagged"]]
    if not found:
        return ()
    reasons = Counter(reason for each in found for reason in each.split("; ") if reason)
    counts = "; ".join(f"{count} \N{MULTIPLICATION SIGN} {reason}" for reason, count in reasons.most_common())
    return (
        f"{len(found)} of {len(rows)} images are flagged by the solver, their calibration or their capture, but "
        f"included in the means (column flagged of {name}.csv){': ' if counts else ''}{counts}.",
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
    message = sections[0].message if len(sections) == 1 else tally([claim for one in sections for claim in one.claims])
    page = render_page("study.html", title=title, message=message or title, sections=sections, versions=versions())
    write_text(path, page)
    return path


def _options(scope: Scope) -> list[str]:
    setup = scope.setup
    named = {"--camera": setup.camera, "--projector": setup.projector}
    given = [f"{option} {value}" for option, value in named.items() if value]
    given += [f"-D {name}={value}" for name, value in setup.parameters]
    given += [f"--over {name}={','.join(values)}" for name, values in scope.sweep]
    given += [f"--measure {','.join(scope.measures)}"] if scope.measures else []
    given += [f"--patterns {scope.patterns}"] if scope.patterns != Scope.patterns else []
    given += [f"--recipe {scope.recipe}"] if scope.recipe else []
    given += [f"--seed {scope.seeds[0]}"] if scope.seeds[0] != Scope.seeds[0] else []
    given += [f"--variant {setup.variant}"] if setup.variant != Setup.variant else []
    return [*given, *(["--allow-outside-files"] if setup.outside else []), *(["--quick"] if scope.quick else [])]
