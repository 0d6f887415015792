"""Design of a mask: search, proof by rendered images beside simple masks, and the page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w

from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError
from mitsim.core.files import output_folder, read_text, replaced, write_json, write_text
from mitsim.core.headline import headline
from mitsim.core.job import Job
from mitsim.design.goal import Goal
from mitsim.design.masks import (
    PATTERNS,
    Candidate,
    run_search,
    searches,
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
    """Result of a design: candidates with the found one first, its bounds, PSNR by distance, and sensitivities [dB]."""

    candidates: tuple[Candidate, ...]
    bounds: tuple[str, ...]
    distances: Mapping[str, float]
    sensitivity: Mapping[str, float]
    seconds_for_psnr: float | None
    complete: bool
    seconds: Mapping[str, float]
    output: str
    warnings: tuple[str, ...]

    def payload(self) -> dict[str, Any]:
        """Return the values of the command line's JSON."""
        candidates = [each.payload() for each in self.candidates]
        best = self.candidates[0]
        return {"headline": self.headline, "psnr": best.rendered, **vars(self), "candidates": candidates}

    @property
    def table(self) -> Part:
        """Return predicted and rendered PSNR of all masks."""
        head = ("mask", "patterns", "predicted [dB]", "rendered [dB]", "scatter [dB]", "open part", "exposure [s]",
                "calibration frame [s]", "codes tried")  # fmt: skip
        rows = list[tuple[str, ...]]()
        for each in self.candidates:
            numbers = each.predicted, each.rendered, each.scatter, each.found.code.mean()
            taken = (f"{one:.3g}" for one in (each.exposures[0], each.session_s, each.found.evaluations))
            rows.append((each.name, each.choice.shown, *(f"{one:.2f}" for one in numbers), *taken))
            for case in each.cases if len(each.cases) > 1 else ():
                shown = f"{case.get('picture', '')} dose {case['dose']:g}", "", f"{case['psnr_predicted']:.2f}"
                rows.append((*shown, f"{case['psnr_rendered']:.2f}", "", "", f"{case['exposure_total_s']:.3g}", "", ""))
        notes = ["Scatter is that of single captures; open part is that of the features of a side."]
        notes += [f"Camera file, drawings and patterns that were found: {self.output}/design/, and so on."]
        notes += [f"Not rendered, expected at {place}: {level:.2f} dB." for place, level in self.distances.items()]
        notes += [f"Expected change by {name}: {change:+.1f} dB." for name, change in self.sensitivity.items()]
        notes += [f"The design has reached a bound: {name}." for name in self.bounds]
        if self.seconds_for_psnr is not None:
            notes.append(f"The wanted PSNR needs {self.seconds_for_psnr:.3g} s of exposure.")
        if not self.complete:
            notes.append("The time limit ended the search; --resume makes the remaining starts.")
        return Part("PSNR", self.candidates[0].choice.words, head, tuple(rows), notes=tuple(notes))

    def lines(self) -> list[str]:
        """Return the report as lines of text."""
        return [self.headline, *self.table.lines()]

    @property
    def headline(self) -> str:
        best = self.candidates[0]
        rest = max(self.candidates[1:], key=lambda each: each.rendered)
        gain = f"{best.rendered - rest.rendered:+.1f} dB over the best simple mask ({rest.name})"
        made = f"Found a mask with PSNR {best.rendered:.1f} dB rendered, {best.predicted:.1f} dB predicted, {gain}"
        return headline(made, self.warnings)


# -------- Proof


def prove(goal: Goal, candidate: Candidate, camera: Path, job: Job, bench: Bench | None = None) -> Candidate:
    """Predict, capture, calibrate and reconstruct with the ``camera`` of a candidate, for each picture, dose and seed.

    ``bench`` has that camera; None: the goal's scene is opened with it.
    """
    from mitsim.api.bench import open_bench

    patterns = str(camera.parent / PATTERNS) if candidate.choice.lit else candidate.choice.patterns
    cases, levels, predictions, warnings = [], [], [], list[str]()
    factors = None
    for shown in goal.shown:
        own = bench or open_bench(goal.scene, camera=str(camera), **shown)
        factors = factors or own.calibrate(accuracy=goal.accuracy, seed=goal.seed, job=job)
        for dose, seconds in zip(goal.doses, candidate.exposures, strict=True):
            predicted, found = own.predict(patterns, exposure_total=seconds, job=job), list[float]()
            exposed: dict[str, Any] = {"exposure": seconds / predicted.frames, "accuracy": goal.accuracy}
            warnings += predicted.warnings
            for seed in range(goal.seeds):
                shots = own.capture(patterns, job=job, seed=goal.seed + seed, **exposed)
                solved = reconstruct(shots, factors)
                truth = truth_for(shots, factors.manifest.board_reflectance)
                assert truth is not None
                found.append(psnr(solved.image, truth))
                warnings += map(str, solved.status.flags)
            case = {name: each.name for name, each in shown.items()} | {"dose": dose, "exposure_total_s": seconds}
            cases.append(case | {"psnr_predicted": predicted.psnr_db, "psnr_rendered": float(np.mean(found))})
            predictions.append(predicted)
            levels.append(found)
    judge = np.min if goal.judge == "worst" else np.mean
    worst, rendered = min(predictions, key=lambda each: each.psnr_db), judge(levels, axis=0)
    return replace(
        candidate,
        cases=tuple(cases),
        predicted=float(judge([each.psnr_db for each in predictions])),
        causes=dict(worst.errors.causes),
        rendered=float(rendered.mean()),
        scatter=float(rendered.std(ddof=1)),
        session_s=worst.session_exposure_s,
        warnings=tuple(dict.fromkeys(warnings)),
        image=solved.image,
    )


# -------- The design as a whole


def design(
    asked: Goal, output: Path | str, job: Job | None = None, resume: bool = False, overwrite: bool = False
) -> Design:
    """Search a mask for a goal, prove it by rendered images, and write its files; see :func:`mitsim.design`."""
    from mitsim.api.bench import open_bench

    job, earlier = job or Job(), Path(output) / GOAL
    text = tomli_w.dumps(asked.model_dump(mode="json", exclude_none=True))
    same = resume and earlier.is_file()
    if same and read_text(earlier, 1 << 16) != text:
        raise MitsimError(f"output {output}: was begun for another goal; give its own goal, or another folder")
    aside = replaced(Path(output), (DESIGN,)) if overwrite else nullcontext()
    with aside, output_folder(output, overwrite=same) as folder:
        with job.clock.stage("open scene"):
            bench = open_bench(asked.scene, camera=asked.camera, **asked.shown[0])
        with job.clock.stage("transport"):
            stand = stand_of(bench, asked.seed)
        with job.clock.stage("search"):
            every = searches(stand, asked)
        head = {"kind": "design", "versions": versions(), "command": job.command, "scene": str(asked.scene)}
        write_json(folder / DESIGN, {**head, "status": "incomplete"})
        write_text(folder / GOAL, text)
        with job.clock.stage("search"):
            candidates, complete = run_search(asked, folder, job, every)
        proved = []
        for number, each in enumerate(candidates):
            job.progress("proof", number / len(candidates))
            file = write_camera(folder / each.name.replace(" ", "_"), bench, each)
            with job.clock.stage("proof"):
                proved.append(prove(asked, each, file, job.apart(f"{each.name} ")))
        best, *simple = proved
        own, code, distances = every[best.choice], best.found.code, asked.scene_distances_mm
        part = len(own.objectives) // max(len(distances), 1)
        parts = (own.objectives[k * part :][:part] for k in range(len(distances)))
        judged = (-10 * math.log10(replace(own, objectives=each).score(code).score) for each in parts)
        texts = dict.fromkeys(text for each in proved for text in each.warnings)
        warnings = [f"{', '.join(each.name for each in proved if text in each.warnings)}: {text}" for text in texts]
        if best.rendered < best.predicted - _SHORT_DB:
            short = f"by {best.predicted - best.rendered:.1f} dB; a cause that the prediction lacks matters"
            warnings.append(f"The rendered image is worse than predicted: {short} in this scene")
        rival = max(simple, key=lambda each: each.rendered)
        scatter = math.hypot(best.scatter, rival.scatter) / math.sqrt(asked.seeds)
        if best.rendered - rival.rendered <= 2 * scatter:
            known = f"{rival.name} has {rival.rendered:.2f} dB, with two standard errors of {2 * scatter:.2f} dB"
            warnings.append(f"The design is no better than a simple mask: {known}; take it, or use more seeds")
        found = Design(
            candidates=tuple(proved),
            bounds=tuple(own.active_bounds(code)),
            distances=dict(zip((f"{mm:g} mm" for mm in distances), judged, strict=True)),
            sensitivity=sensitivity(stand, asked, best.choice, own, code),
            seconds_for_psnr=None if asked.wanted_psnr_db is None else seconds_for(own, code, asked),
            complete=complete,
            seconds=job.clock.seconds(),
            output=str(folder),
            warnings=tuple(warnings),
        )
        draw(found, folder, bench)
        write_json(folder / DESIGN, {**head, **found.payload(), "status": "complete"})
    return found


def draw(found: Design, folder: Path, bench: Bench) -> None:
    """Write figures and the page of a design."""
    names = [each.name for each in found.candidates]
    masks = {"": [(np.outer(each.found.code, each.found.code), each.found.origin) for each in found.candidates]}
    images = {"": [(each.image, f"PSNR {each.rendered:.1f} dB") for each in found.candidates]}
    causes = {
        each.name: {
            name.replace("_", " "): Mean(square**0.5, 0.0, 1)
            for name, square in each.causes.items()
            if square > _SHOWN * 10 ** (-each.predicted / 10)
        }
        for each in found.candidates
    }
    bars = grouped_bars(causes, "expected rms error of reflectance")
    figures = {"masks.png": image_grid(masks, names), "images.png": image_grid(images, names), "causes.png": bars}
    pictures = {file: page_figure(figure) for file, figure in write_figures(folder, figures).items()}
    title, scene = "Design of a mask", bench.loaded.path.parent.name
    section = Section("design", title, found.headline, found.headline, pictures, (found.table,))
    section = replace(section, warnings=found.warnings, scene=scene, camera=bench.counting.name)
    write_page([section], folder / "report.html", title)
