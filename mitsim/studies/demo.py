"""`mitsim demo`: the main job on any bench, from plan to report."""

from __future__ import annotations

import math
import shutil
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.acquire.capture import expose, trace_request
from mitsim.api.bench import Bench
from mitsim.bench.layout import layout_of, previews
from mitsim.bench.request import Exposure, Request, Task
from mitsim.calibrate.board_session import Session
from mitsim.core.configuration import opening_words
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError
from mitsim.core.exr import read_frame
from mitsim.core.files import write_json, write_text
from mitsim.core.headline import each_once, headline
from mitsim.core.job import Job
from mitsim.core.runs import Capture, frame_name
from mitsim.devices.session import load_recipe
from mitsim.light.light import SampledLight
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.report import CONVENTIONS, EQUAL_PEAK, label
from mitsim.report.folder_page import FamilyResult, Recovery, Trust, render_demo, verdict
from mitsim.report.lit_scene import LitScene, Unexposed
from mitsim.report.pages import scene_name, subject
from mitsim.studies.framework.campaign import DEMO_FOLDERS, DEMO_PAGE, study_folder

_BEFORE, _AFTER = ("uniform", "dots:4", "dots:5"), ("hadamard:8",)
_SECOND_SHOWN = 0.4
"""Part of a family's shots before its second shown example."""


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
    light = trace_request(bench, plan, job)
    shots = expose(light, request.patterns, Task(folder / "run", job=job))
    session = job.apart("calibration ")
    factors = bench.calibrate(seed=request.seed, accuracy=request.accuracy, output=folder / "calibration", job=session)
    job.clock.add(session.clock.seconds(), "calibration ")
    lit, families = LitScene(light), dict[str, FamilyResult]()
    with job.clock.stage("compare families"):
        for index, name in enumerate(names):
            families[name] = _compare(lit, factors, name, shots if name == request.patterns else None)
            job.progress(f"compare families: {label(name)}", (index + 1) / len(names))
    main = families[request.patterns]
    flags = {"the capture": shots.warnings, "the calibration": factors.warnings, "the image": doubts(main)}
    warnings = each_once(flags)
    with job.clock.stage("views"):
        view = previews(bench, layout_of(bench))[0].picture.mean(axis=-1)
        count = len(shots.manifest.patterns.captures)
        white = lit.rendered_frames(factors, bench.family("uniform"), light.seed)
        (shot,), (even,) = white.family.shots, white.expected
        exposer = white.exposer(white.seconds(EQUAL_PEAK))
        shown = exposer.digital(exposer.shot_electrons(even, *shot.names), *shot.names)
        frames: dict[str, Any] = {f"{label('uniform')}, the only frame": shown}
        for index in (0, count // 2):
            caption = f"frame {index + 1} of {count}" if count > 1 else "the only frame"
            frame, _ = read_frame(folder / "run" / frame_name(index))
            frames[f"{label(request.patterns)}, {caption}"] = frame["DN"]
    with job.clock.stage("report"):
        page = {
            **(content := _page(light, shots, factors, families, request.patterns)),
            "verdict": headline(content["verdict"], warnings),
            "render": view,
            "frames": frames,
            "warnings": warnings,
            "seconds": job.clock.seconds(),
            "kernels": job.clock.kernels(),
        }
        write_text(folder / DEMO_PAGE, render_demo(page))
    rendered = {name: each.rendered for name, each in families.items() if each.rendered}
    psnr = {name: each.quality.psnr_db for name, each in rendered.items()}
    return DemoResult(
        psnr=psnr,
        psnr_ideal={name: each.idealised.quality.psnr_db for name, each in families.items() if each.idealised},
        exposure={name: dict(each.by_exposure) for name, each in families.items()},
        gain_db=psnr[request.patterns] - psnr["uniform"],
        verdict=content["verdict"],
        mc_error=shots.manifest.mc_error or 0.0,
        truth_error=light.apparent.error,
        trust={name: each.trust.summary() for name, each in rendered.items() if each.trust},
        seconds=job.clock.seconds(),
        kernels=dict(page["kernels"]),
        report=str(folder / DEMO_PAGE),
        warnings=warnings,
    )


def _compare(lit: LitScene, factors: Factors, name: str, shots: Capture | None) -> FamilyResult:

    def recover(frames: Unexposed, seconds: float) -> Recovery:
        solution = frames.solve(seconds)
        return Recovery(solution.image, lit.quality(solution.image), solution.lam, str(solution.status))

    seed = lit.light.seed
    family = lit.bench.family(name, seed)
    frames, ideal = lit.rendered_frames(factors, family, seed), lit.idealised_frames(family, seed)
    times = {convention: frames.seconds(convention) for convention in CONVENTIONS}
    image = reconstruct(shots or expose(lit.light, name), factors)
    # The flags of capture and calibration are in the report's notes, once for all families.
    status = str(replace(image.status, flags=()))
    trust = Trust.of(image, lit.light.truth)
    rendered = {times[EQUAL_PEAK]: Recovery(image.image, lit.quality(image.image), image.lam, status, trust)}
    for seconds in times.values():
        if seconds not in rendered:
            rendered[seconds] = recover(frames, seconds)
    singular = np.sort(frames.prepare().left.singular ** 2)[::-1]
    examples = family.shots[0], family.shots[int(len(family.shots) * _SECOND_SHOWN)]
    return FamilyResult(
        name=name,
        label=label(name),
        shots=len(family.shots),
        patterns=tuple(family.light(shot) for shot in dict.fromkeys(examples)),
        singular_values=singular / singular[0],
        idealised=recover(ideal, ideal.seconds(EQUAL_PEAK)),
        rendered=rendered[times[EQUAL_PEAK]],
        by_exposure={convention: rendered[seconds].quality.psnr_db for convention, seconds in times.items()},
    )


def _page(
    light: SampledLight, shots: Capture, factors: Factors, families: dict[str, FamilyResult], main: str
) -> dict[str, Any]:
    bench, session, plan, geometry = light.bench, factors.manifest.result, light.plan, light.bench.geometry
    best, detail = verdict(families[main], families["uniform"])
    unexplained = session["unexplained_residual"]  # JSON has no infinity: None
    beyond = "" if not unexplained else f" Beyond the sensor's noise, {unexplained:.1e} of the responses is left."
    budget = (
        ("Monte Carlo", shots.manifest.mc_error, "rendering noise of the expected frames, from groups of samples"),
        ("Discretisation", plan.systematic_error, "finite number of anchors, cells and layers, from the plan"),
        ("Sensor noise", shots.manifest.sensor_noise, "shot noise and read noise of the frames, in closed form"),
        ("Calibration", session["phi_error"], "error of the factors, because calibration frames are noisy"),
        ("Separable model", session["noise_free_residual"],
         "part of noise-free frames of the board that a product of two factors cannot describe"),
    )  # fmt: skip
    (rows, columns), full = geometry.frame_shape, 100 * Exposure().fraction
    size = " x ".join(f"{pitch * 1e3:g}" for pitch in geometry.pitches[geometry.row_pitch is None :])
    mask = f"{geometry.mask_words}, {geometry.mask_feature * 1e3:g} um, {geometry.mask_distance:g} mm from the sensor"
    return {
        "title": f"Comparison of patterns: {subject(scene_name(bench.loaded.path), bench.sensor.name)}",
        "verdict": best,
        "verdict_detail": detail,
        "truth": light.truth,
        "scene": scene_line(bench.loaded.path),
        "families": tuple(families.values()),
        "main": main,
        "exposure": f"equal peak: each family's brightest pixel fills {full:.0f} % of the full well",
        "calibration": {**session, "status": f"{factors.status}{beyond}"},
        "budget": budget,
        "accuracy": plan.accuracy,
        "error": shots.manifest.total_error,
        "effects": plan.effects,
        "configuration": {
            "variant": bench.variant,
            "camera": bench.sensor.name,
            "projector": bench.projector.name,
            "parameters": ", ".join(f"{name} = {value}" for name, value in bench.defines.items()) or "the scene's own",
            "sensor": f"{rows} x {columns} pixels of {size} um",
            "mask": mask,
            "scene plane": f"{geometry.scene_distance:g} mm, {bench.n} x {bench.n} projector pixels",
            f"exposure ({label(main)})": f"{shots.exposure_s:.3g} s a frame",
            "accuracy asked for": f"{plan.accuracy:g}",
        },
        "seeds": {"root": light.seed},
        "versions": versions(),
        "notes": (
            "PSNR has peak 1, without a fit of gain or offset. The truth is the apparent reflectance relative to the "
            f"board. It is sampled separately and has a standard error of {light.apparent.error:.1e}.",
            "The idealised images have the same sensor noise as the rendered ones.",
            "Lambda is chosen by an unbiased estimate of the risk, without the truth.",
        ),
    }


def doubts(family: FamilyResult) -> tuple[str, ...]:
    found, rendered = [], family.rendered
    if rendered and rendered.trust and rendered.trust.cause:
        # Rank and condition, which the sentences after the first state, are no warning.
        found.append(f"{family.label}: {rendered.status.partition('. ')[0]}")
    if rendered and not rendered.quality.is_image:
        found.append(
            f"{family.label}: the rms error is above the whole range of reflectance ({rendered.quality.psnr_db:.1f} "
            "dB), so this is no image of the scene; the solver assumes a flat, matt print"
        )
    return tuple(found)


def scene_line(path: Path) -> str:
    name, (sentence, _) = path.resolve().parent.name, opening_words(path)
    return f"{name}: {sentence}" if sentence else name
