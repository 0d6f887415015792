"""Design of a mask: search, proof by rendered images beside simple masks, and the page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w

from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError
from mitsim.core.files import output_folder, write_json, write_text
from mitsim.core.job import Job
from mitsim.design.goal import Goal, load_goal
from mitsim.design.masks import (
    PATTERNS,
    STATE,
    Candidate,
    run_search,
    search_of,
    seconds_for,
    sensitivity,
    stand_of,
    write_camera,
)
from mitsim.metrics import psnr, truth_for
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.report.pages import Mean, page_figure
from mitsim.report.plots import grouped_bars, image_grid
from mitsim.studies.framework.campaign import write_figures
from mitsim.studies.framework.panels import Part, Section, write_page

if TYPE_CHECKING:
    from mitsim.api.bench import Bench

GOAL, DESIGN = "goal.toml", "design.json"
_SHORT_DB = 0.5
"""Shortfall of a rendered image from its prediction that flags a design."""
_SHOWN = 1e-2
"""Part of the error from which a cause is drawn."""


@dataclass(frozen=True)
class Design:
    """Result of a design: candidates with the found one first, bounds that it has reached, and sensitivities [dB]."""

    candidates: tuple[Candidate, ...]
    bounds: tuple[str, ...]
    sensitivity: Mapping[str, float]
    seconds_for_psnr: float | None
    complete: bool
    seconds: Mapping[str, float]
    output: str
    warnings: tuple[str, ...]

    def payload(self) -> dict[str, Any]:
        """Return the values of the command line's JSON."""
        candidates = [each.payload() for each in self.candidates]
        return {"headline": self.headline, **vars(self), "candidates": candidates}

    @property
    def table(self) -> Part:
        """Return predicted and rendered PSNR of all masks."""
        head = ("mask", "patterns", "predicted [dB]", "rendered [dB]", "scatter of seeds [dB]", "open part a side",
                "exposure [s]", "session [s a frame]", "codes tried")  # fmt: skip
        rows = tuple(
            (
                each.name,
                each.choice.shown,
                f"{each.predicted:.2f}",
                f"{each.rendered:.2f}",
                f"{each.scatter:.2f}",
                f"{each.found.code.mean():.2f}",
                f"{each.exposure_total_s:.3g}",
                f"{each.session_s:.3g}",
                str(each.found.evaluations),
            )
            for each in self.candidates
        )
        notes = [f"Expected change by {name}: {change:+.1f} dB." for name, change in self.sensitivity.items()]
        notes += [f"The design has reached a bound: {name}." for name in self.bounds]
        if self.seconds_for_psnr is not None:
            notes.append(f"The wanted PSNR needs {self.seconds_for_psnr:.3g} s of exposure.")
        if not self.complete:
            notes.append("The time limit ended the search; --resume makes the remaining starts.")
        return Part("PSNR", self.candidates[0].choice.words, head, rows, notes=tuple(notes))

    def lines(self) -> list[str]:
        """Return the report as lines of text."""
        patterns = [f"Patterns: {self.output}/design/{PATTERNS}"] if self.candidates[0].choice.lit else []
        return [self.headline, *self.table.lines(), f"Camera file: {self.output}/design/camera.toml", *patterns]

    @property
    def headline(self) -> str:
        best = self.candidates[0]
        rest = max((each for each in self.candidates[1:]), key=lambda each: each.rendered, default=best)
        gain = f", {best.rendered - rest.rendered:+.1f} dB over the best simple mask ({rest.name})"
        return f"Found a mask with PSNR {best.rendered:.1f} dB rendered, {best.predicted:.1f} dB predicted{gain}"


# -------- Proof


def prove(goal: Goal, candidate: Candidate, camera: Path, job: Job) -> Candidate:
    """Predict, capture, calibrate and reconstruct with the ``camera`` of a candidate, once for each seed."""
    from mitsim.api.bench import open_bench

    bench = open_bench(goal.scene, camera=str(camera))
    patterns = str(camera.parent / PATTERNS) if candidate.choice.lit else candidate.choice.patterns
    frames = len(bench.family(patterns).shots)
    predicted = bench.predict(patterns, exposure_total=candidate.exposure_total_s, job=job)
    factors = bench.calibrate(accuracy=goal.accuracy, seed=goal.seed, job=job)
    found, warnings = [], list(predicted.warnings)
    for seed in range(goal.seeds):
        exposed: dict[str, Any] = {"exposure": candidate.exposure_total_s / frames, "accuracy": goal.accuracy}
        shots = bench.capture(patterns, job=job, seed=goal.seed + seed, **exposed)
        image = reconstruct(shots, factors)
        truth = truth_for(shots, factors.manifest.board_reflectance)
        assert truth is not None
        found.append(psnr(image.image, truth))
        warnings += image.status.flags
    return replace(
        candidate,
        predicted=predicted.psnr_db,
        causes=dict(predicted.errors.causes),
        rendered=float(np.mean(found)),
        scatter=float(np.std(found, ddof=1)),
        session_s=predicted.session_exposure_s,
        warnings=tuple(dict.fromkeys(map(str, warnings))),
        image=image.image,
    )


# -------- The design as a whole


def design(
    goal: Goal | Path | str, output: Path | str, job: Job | None = None, resume: bool = False, overwrite: bool = False
) -> Design:
    """Search a mask for a ``goal``, prove it by rendered images, and write its files; see :func:`mitsim.design`."""
    from mitsim.api.bench import open_bench

    job, asked = job or Job(), goal if isinstance(goal, Goal) else load_goal(goal)
    earlier = Path(output) / GOAL
    same = resume and earlier.is_file()
    if same and load_goal(earlier) != asked:
        raise MitsimError(f"output {output}: was begun for another goal; give its own goal, or another folder")
    with output_folder(output, overwrite=same or (overwrite and (Path(output) / STATE).is_file())) as folder:
        if overwrite and not same:
            (folder / STATE).unlink(missing_ok=True)
        write_text(folder / GOAL, tomli_w.dumps(asked.model_dump(mode="json", exclude_none=True)))
        with job.clock.stage("open scene"):
            bench = open_bench(asked.scene, camera=asked.camera)
        with job.clock.stage("transport"):
            stand, session_s = stand_of(bench, asked.seed)
        with job.clock.stage("search"):
            candidates, complete = run_search(stand, asked, folder, job, session_s)
        proved = []
        for number, each in enumerate(candidates):
            job.progress("proof", number / len(candidates))
            file = write_camera(folder / each.name.replace(" ", "_"), bench, each)
            with job.clock.stage("proof"):
                proved.append(prove(asked, each, file, job.apart(f"{each.name} ")))
        best, *simple = proved
        own = search_of(stand, asked, best.choice, session_s)
        texts = dict.fromkeys(text for each in proved for text in each.warnings)
        warnings = [f"{', '.join(each.name for each in proved if text in each.warnings)}: {text}" for text in texts]
        if best.rendered < best.predicted - _SHORT_DB:
            warnings.append(
                f"The rendered image has {best.predicted - best.rendered:.1f} dB less than predicted; a cause that the "
                "search lacks matters in this scene"
            )
        rival = max(simple, key=lambda each: each.rendered)
        scatter = math.hypot(best.scatter, rival.scatter) / math.sqrt(asked.seeds)
        if best.rendered - rival.rendered <= 2 * scatter:
            warnings.append(
                f"The design is not better than a simple mask ({rival.name}, {rival.rendered:.2f} dB) by more than the "
                f"scatter of seeds (two standard errors are {2 * scatter:.2f} dB); take the simple mask"
            )
        found = Design(
            candidates=tuple(proved),
            bounds=tuple(own.active_bounds(best.found.code)),
            sensitivity=sensitivity(own, best.found.code),
            seconds_for_psnr=None if asked.wanted_psnr_db is None else seconds_for(own, best.found.code, asked),
            complete=complete,
            seconds=job.clock.seconds(),
            output=str(folder),
            warnings=tuple(warnings),
        )
        write_json(folder / DESIGN, {**found.payload(), "kind": "design", "versions": versions()})
        draw(found, folder, bench)
    return found


def draw(found: Design, folder: Path, bench: Bench) -> None:
    """Write figures and the page of a design."""
    names = [each.name for each in found.candidates]
    masks = {"": [(np.outer(each.found.code, each.found.code), each.found.origin) for each in found.candidates]}
    rendered = ((each.image, f"PSNR {each.rendered:.1f} dB") for each in found.candidates)
    images = [(image, caption) for image, caption in rendered if image is not None]
    causes = dict[str, dict[str, Mean]]()
    for each in found.candidates:
        least = _SHOWN * 10 ** (-each.predicted / 10)
        shown = {
            name.replace("_", " "): Mean(square**0.5, 0.0, 1)
            for name, square in (each.causes or {}).items()
            if square > least
        }
        causes[each.name] = shown
    figures = {
        "masks.png": image_grid(masks, names),
        "images.png": image_grid({"": images}, names),
        "causes.png": grouped_bars(causes, "expected rms error of reflectance"),
    }
    drawn = write_figures(folder, figures)
    pictures = {file: page_figure(figure) for file, figure in drawn.items()}
    title = "Design of a mask"
    section = Section(
        "design", title, found.headline, found.headline, pictures, (found.table,), warnings=found.warnings
    )
    section = replace(section, scene=bench.loaded.path.parent.name, camera=bench.counting.name)
    write_page([section], folder / "report.html", title)
