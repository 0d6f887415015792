"""`mitsim demo`: the main job on any bench, from plan to report."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsim.acquire.capture import expose, trace_request
from mitsim.api.bench import Bench
from mitsim.bench.layout import layout_of, previews
from mitsim.bench.request import Exposure, Request, Task
from mitsim.calibrate.board_session import Session
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import opening_words
from mitsim.core.errors import MitsimError
from mitsim.core.files import write_json
from mitsim.core.headline import each_once, headline
from mitsim.core.job import Job
from mitsim.core.runs import Capture
from mitsim.devices.session import load_recipe
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import Reconstruction, reconstruct
from mitsim.report import CONVENTIONS, EQUAL_PEAK, IDEALISED, RENDERED, in_text, label
from mitsim.report.folder_page import report_folder
from mitsim.report.lit_scene import LitScene
from mitsim.report.pages import Value, scene_name, scientific
from mitsim.studies.framework.campaign import DEMO_FOLDERS, DEMO_PAGE, study_folder
from mitsim.studies.framework.experiment import IMAGE, TRUTH, Results, Study
from mitsim.studies.framework.panels import Images as Grid
from mitsim.studies.framework.panels import Pivot, section_of, write_page
from mitsim.studies.framework.studio import Image, measure_image

if TYPE_CHECKING:
    from matplotlib.figure import Figure

UNIFORM = "uniform"
_BEFORE, _AFTER = (UNIFORM, "dots:4", "dots:5"), ("hadamard:8",)
_GAIN_DB = 0.5
"""Least gain that counts: a tenth of the squared error."""
COVERED = 1.96
"""Standard uncertainties of a 95 % interval."""
_CORNER = 40
"""Shown rows and columns of a pattern."""
_PAGES = "frames, simulated effects, time and settings", "the camera's factors and their errors"

Images = Mapping[tuple[str, str, str], Image]
"""Images by patterns, model and exposure; of the idealised model at equal peak alone."""


@dataclass(frozen=True)
class DemoResult:
    """Result of `mitsim demo`: PSNR [dB] by family and exposure, relative errors, and time by stage."""

    psnr: dict[str, float]
    psnr_ideal: dict[str, float]
    exposure: dict[str, dict[str, float]]
    gain_db: float
    verdict: str
    mc_error: float
    truth_error: float
    trust: dict[str, dict[str, Any]]
    seconds: dict[str, float]
    kernels: dict[str, float]
    report: str
    warnings: tuple[str, ...]

    def payload(self) -> dict[str, Any]:
        return {"headline": headline(self.verdict, self.warnings), **asdict(self)}

    def lines(self) -> list[str]:
        table = [
            f"{label(name):>14}: {value:5.1f} dB rendered and calibrated, {self.psnr_ideal[name]:5.1f} dB idealised"
            for name, value in self.psnr.items()
        ]
        truth = f"The truth is good to {-20 * math.log10(self.truth_error):.1f} dB." if self.truth_error else ""
        return [headline(self.verdict, self.warnings), f"Report: {self.report}", *table, *filter(None, (truth,))]


def demo(bench: Bench, output: Path | str, request: Request | None = None, job: Job | None = None) -> DemoResult:
    """Plan, capture, calibrate and reconstruct a scene under several pattern families, and write report.html.

    Parameters
    ----------
    output
        A new or empty folder, or one with an earlier demo alone, which is replaced.
    request
        The main family, its accuracy and seed; it is compared with those of the paper that fit the projector.

    Raises
    ------
    MitsimError
        For patterns that do not fit, a camera without a full well, a scene without light, an output that cannot be
        written or holds something else, or work beyond the job's limits.
    """
    request, job = request or Request.of(), job or Job()
    Exposure().check(bench.sensor, bench.devices.camera_file)
    bench.family(request.patterns, request.seed)
    names = []
    for name in dict.fromkeys((*_BEFORE, request.patterns, *_AFTER)):
        with suppress(MitsimError):
            bench.family(name, request.seed)
            names.append(name)
    Session(bench, load_recipe(), request.seed).check_mask(job)
    # Only now, with nothing left to refuse, is an earlier demo removed.
    with study_folder(output, "demo") as folder:
        for part in DEMO_FOLDERS:
            shutil.rmtree(folder / part, ignore_errors=True)
        (folder / DEMO_PAGE).unlink(missing_ok=True)
        write_json(folder / "demo.json", {"kind": "demo", "status": "incomplete"})
        result = _run(bench, folder, request, names, job)
        write_json(folder / "demo.json", {"kind": "demo", **result.payload()})
        return result


def _run(bench: Bench, folder: Path, request: Request, names: list[str], job: Job) -> DemoResult:
    with job.clock.stage("plan"):
        sparsest = min(names, key=lambda name: bench.family(name, request.seed).lighting.lit)
        plan = bench.plan(**{**request.model_dump(), "patterns": sparsest})
    light, main = trace_request(bench, plan, job), request.patterns
    shots = expose(light, main, Task(folder / "run", job=job))
    session = job.apart("calibration ")
    factors = bench.calibrate(seed=request.seed, accuracy=request.accuracy, output=folder / "calibration", job=session)
    job.clock.add(session.clock.seconds(), "calibration ")
    lit, images = LitScene(light), dict[tuple[str, str, str], Image]()
    with job.clock.stage("compare families"):
        for index, name in enumerate(names):
            images |= _compare(lit, factors, name, shots if name == main else None)
            job.progress(f"compare families: {label(name)}", (index + 1) / len(names))
    flags = {"the capture": shots.warnings, "the calibration": factors.warnings, "the image": doubts(images, main)}
    warnings, (best, detail) = each_once(flags), verdict(images, main)
    with job.clock.stage("report"):
        for part in DEMO_FOLDERS:
            report_folder(folder / part)
        results = results_of(images, light.truth)
        figures = {"scene.png": _scene(lit, shots, main), **STUDY.draw(results)}
        section = replace(
            section_of(STUDY, (), figures, results),
            message=headline(best, warnings),
            detail=f"{detail} {scene_line(bench.loaded.path)} The frames before noise are good to "
            f"{scientific(shots.manifest.total_error)}; {plan.accuracy:g} was asked for.",
            warnings=warnings,
            scene=scene_name(bench.loaded.path),
            camera=bench.sensor.name,
            count="",
            pages={f"{part}/{DEMO_PAGE}": words for part, words in zip(DEMO_FOLDERS, _PAGES, strict=True)},
        )
        write_page([section], folder / DEMO_PAGE, section.title, section.message)
    psnr, ideal = (
        {name: images[name, model, EQUAL_PEAK].quality.psnr_db for name in names} for model in (RENDERED, IDEALISED)
    )
    trust = {name: dict(images[name, RENDERED, EQUAL_PEAK].trust) for name in names}
    return DemoResult(
        psnr=psnr,
        psnr_ideal=ideal,
        exposure={name: {rule: images[name, RENDERED, rule].quality.psnr_db for rule in CONVENTIONS} for name in names},
        gain_db=psnr[main] - psnr[UNIFORM],
        verdict=best,
        mc_error=shots.manifest.mc_error or 0.0,
        truth_error=light.apparent.error,
        trust={name: each for name, each in trust.items() if each},
        seconds=job.clock.seconds(),
        kernels=dict(job.clock.kernels()),
        report=str(folder / DEMO_PAGE),
        warnings=warnings,
    )


def _compare(lit: LitScene, factors: Factors, name: str, shots: Capture | None) -> Images:
    seed = lit.light.seed
    family = lit.bench.family(name, seed)
    frames, ideal = lit.rendered_frames(factors, family, seed), lit.idealised_frames(family, seed)
    times = {rule: frames.seconds(rule) for rule in CONVENTIONS}
    image = reconstruct(shots or expose(lit.light, name), factors)
    # The flags of capture and calibration are stated once for all families; rank and condition are no reason.
    status, trust = str(replace(image.status, flags=())).partition(". ")[0], trust_of(image, lit.truth)
    flags: dict[str, Value] = {"flagged": bool(trust.get("cause")), "reason": status}
    first = lit.quality(image.image), image.lam, len(family.shots), times[EQUAL_PEAK], flags, trust
    rendered = {times[EQUAL_PEAK]: Image(image.image, *first)}
    for seconds in times.values():
        if seconds not in rendered:
            rendered[seconds] = Image.of(frames, seconds)
    found = {(name, RENDERED, rule): rendered[seconds] for rule, seconds in times.items()}
    return {**found, (name, IDEALISED, EQUAL_PEAK): Image.of(ideal, ideal.seconds(EQUAL_PEAK))}


def trust_of(image: Reconstruction, truth: FloatArray) -> dict[str, Any]:
    """Return stated uncertainty and actual error of an image, rms [reflectance]; nothing where the first is unknown."""
    if image.uncertainty is None:
        return {}
    error, misfit = np.abs(image.image - truth), image.misfit
    return {
        "uncertainty": float(np.sqrt(np.square(image.uncertainty).mean())),
        "rms_error": float(np.sqrt(np.square(error).mean())),
        "within_95": float(np.mean(error <= COVERED * image.uncertainty)),
        "chi_square": misfit.chi_square if misfit else None,
        "cause": (misfit.reason if misfit else "") or None,
    }


# -------- The page


def verdict(images: Images, best: str) -> tuple[str, str]:
    """Return headline and detail, such as "49 dots beat uniform by 11.0 dB"."""
    (ours, theirs), (ideal, other) = (
        [images[name, model, EQUAL_PEAK].quality.psnr_db for name in (best, UNIFORM)] for model in (RENDERED, IDEALISED)
    )
    if best == UNIFORM:
        return f"{label(best)}: {ours:.1f} dB", "PSNR, rendered light and calibrated factors."
    image, gain = images[best, RENDERED, EQUAL_PEAK], ours - theirs
    if not image.quality.is_image:
        text = f"{label(best)}: no image, {ours:.1f} dB"
    elif gain >= _GAIN_DB:
        text = f"{label(best)} beat {in_text(UNIFORM)} by {gain:.1f} dB"
    else:
        text = f"{label(best)}: {abs(gain):.1f} dB {'above' if gain >= 0 else 'below'} {in_text(UNIFORM)}"
    if image.quality.is_image and gain >= 0 and image.trust.get("cause"):
        text += ", but part of their light fits no image"
    detail = f"{ours:.1f} against {theirs:.1f} dB PSNR, rendered light and calibrated factors."
    return text, f"{detail} The idealised model says {ideal - other:+.1f} dB."


def doubts(images: Images, name: str) -> tuple[str, ...]:
    image = images[name, RENDERED, EQUAL_PEAK]
    found = [f"{label(name)}: {image.flags['reason']}"] if image.flags["flagged"] else []
    if not image.quality.is_image:
        found.append(
            f"{label(name)}: the rms error is above the whole range of reflectance ({image.quality.psnr_db:.1f} dB), "
            "so this is no image of the scene; the solver assumes a flat, matt print"
        )
    return tuple(found)


def results_of(images: Images, truth: FloatArray) -> Results:
    """Return the images as rows of a study's table; images that were solved once are one point."""
    rows, arrays = [], dict[tuple[str, str], FloatArray]()
    for (name, model, rule), image in images.items():
        point = f"{name} {model} {rule}"
        rows.append({"point": point, "patterns": name, "model": model, "exposure": rule, **image.row()})
        arrays |= {(point, IMAGE): image.image, (point, TRUTH): truth}
    return Results(rows, arrays)


def _scene(lit: LitScene, shots: Capture, patterns: str) -> Figure:
    from mitsim.report.plots import image_grid

    bench, taken = lit.bench, shots.manifest.patterns.captures
    family, middle = bench.family(patterns, lit.light.seed), len(taken) // 2
    pattern, frame = family.light(family.shots[middle])[:_CORNER, :_CORNER], shots.read(taken[middle].file)[0]["DN"]
    view = previews(bench, layout_of(bench))[0].picture.mean(axis=-1)
    shown = {
        "the scene in full light": (view, "without the mask"),
        "the truth": (lit.truth, "reflectance"),
        "a pattern": ((pattern - pattern.min()) / max(float(np.ptp(pattern)), 1.0), "its corner"),
        "its frame": (frame / float(frame.max()), f"white is {float(frame.max()):.0f} DN"),
    }
    return image_grid({"": [*shown.values()]}, [*shown])


STUDY = Study(
    "demo",
    "Comparison of patterns",
    "What do patterns recover of this scene?",
    points=lambda scope: (),
    measure=measure_image,
    panels=(Grid("patterns", where={"exposure": EQUAL_PEAK}, down=("model",), title="Images, exposure equal peak"),),
    tables=(
        Pivot("patterns", columns="exposure", where={"model": RENDERED}, title="PSNR [dB] of rendered images"),
        Pivot(
            "patterns", title="Stated uncertainty and actual error", where={"model": RENDERED, "exposure": EQUAL_PEAK},
            columns={
                "exposure_s": "exposure [s]", "ssim": "SSIM", "uncertainty": "stated, rms",
                "rms_error": "actual, rms", "within_95": "part within its 95 % interval", "chi_square": "chi-square",
            },
        ),
    ),
    note="A projector casts a coded pattern on the scene. A lensless camera, a bare sensor a few millimetres behind a "
    "coded mask, records the shadow of the mask, one frame for each pattern. A solver recovers the scene from all "
    "frames and calibrated factors. Rendered: light traced through the mask to digital numbers, factors of a session. "
    "Idealised: the paper's model, an evenly lit plane, a geometric shadow and known factors, with the same noise. "
    "Exposures: equal peak, the brightest pixel of each family fills 80 % of the full well; equal frame, each frame "
    "has the time of the frame in uniform light; equal total, all frames of a family together have that time. Each "
    "image states the standard uncertainty of its pixels without the truth; the actual error should be as large, and "
    "95 % of the pixels should lie in their 95 % interval. Chi-square is about 1 if the frames fit a flat, matt print.",
    traced=False,
)  # fmt: skip


def scene_line(path: Path) -> str:
    name, (sentence, _) = path.resolve().parent.name, opening_words(path)
    return f"{name}: {sentence}" if sentence else name
