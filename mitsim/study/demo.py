"""`mitsim demo`: the main job on any bench, from plan to report.

Folders ``run`` and ``calibration`` are what `mitsim capture` and `mitsim calibrate` write; the comparison of pattern
families and exposure conventions uses the same light, which is traced once.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy.typing as npt

from mitsim.capture.bench import Bench
from mitsim.capture.light import Light, pinhole_view
from mitsim.capture.request import Exposure, Request
from mitsim.capture.run import trace_request
from mitsim.core.errors import MitsimError
from mitsim.core.framefile import Channel, read_frame
from mitsim.core.job import Clock, Job
from mitsim.core.manifest import write_json
from mitsim.core.runs import Capture, frame_name
from mitsim.core.versions import versions
from mitsim.reconstruct.factors import Factors
from mitsim.rig.recipe import load_recipe
from mitsim.study.compare import Comparison, label
from mitsim.study.describe import scene_line
from mitsim.study.report import BudgetRow, FamilyResult, ReportData, build_report, verdict
from mitsim.study.runner import study_folder

_PAGE, _FOLDERS = "report.html", ("run", "calibration")
_BEFORE, _AFTER = ("uniform", "dots:4", "dots:5"), ("hadamard:8",)
"""Families that the main one stands between in the report: the paper's, from the fewest frames to the most."""


@dataclass(frozen=True)
class DemoResult:
    """What `mitsim demo` reports.

    Attributes
    ----------
    psnr, psnr_ideal
        [dB] by family, rendered and idealised, at equal peak.
    exposure
        PSNR [dB] of the rendered ones by family and exposure convention.
    gain_db
        PSNR of the main family over that of uniform light; ``verdict`` says it in words.
    mc_error
        relative Monte Carlo error of the main family's frames.
    seconds
        by stage.
    report
        where the page is.
    warnings
        why the result is flagged.
    """

    psnr: dict[str, float]
    psnr_ideal: dict[str, float]
    exposure: dict[str, dict[str, float]]
    gain_db: float
    verdict: str
    mc_error: float
    seconds: dict[str, float]
    report: str
    warnings: tuple[str, ...]

    def payload(self) -> dict[str, Any]:
        """What the command line reports."""
        return asdict(self)

    def lines(self) -> list[str]:
        """For people."""
        table = [
            f"{label(name):>14}: {value:5.1f} dB rendered and calibrated, {self.psnr_ideal[name]:5.1f} dB idealised"
            for name, value in self.psnr.items()
        ]
        return [*table, f"{self.verdict}.", f"Report: {self.report}"]


def demo(bench: Bench, output: Path | str, request: Request | None = None, job: Job | None = None) -> DemoResult:
    """Plan, capture, calibrate and reconstruct a scene under several pattern families, and write report.html.

    Parameters
    ----------
    bench
        the scene with its camera and projector.
    output
        new or empty folder, or one with an earlier demo alone, which is replaced.
    request
        the main family, its accuracy and seed; the families that it is compared with are those of the paper that fit
        the projector.
    job
        clock, progress and limits.

    Raises
    ------
    MitsimError
        for patterns that do not fit, a camera without a full well, a scene without light, an output that cannot be
        written or holds something else, or work beyond the job's limits.
    """
    request, job = request or Request.of(), job or Job()
    Exposure().check(bench)
    names = _fitting(bench, request)
    # Only now, with nothing left to refuse, is an earlier demo taken away.
    with study_folder(output, "demo", (*_FOLDERS, _PAGE)) as folder:
        for part in _FOLDERS:
            shutil.rmtree(folder / part, ignore_errors=True)
        (folder / _PAGE).unlink(missing_ok=True)
        write_json(folder / "demo.json", {"kind": "demo", "status": "incomplete"})
        evidence = _Evidence.gather(bench, folder, request, job)
        result = _compare(evidence, names, folder, job)
        write_json(folder / "demo.json", {"kind": "demo", **result.payload()})
        return result


def _fitting(bench: Bench, request: Request) -> tuple[str, ...]:
    """The main family, which must fit the projector, among those of the others that do."""
    bench.family(request.patterns, request.seed)
    names = dict.fromkeys((*_BEFORE, request.patterns, *_AFTER))
    for name in tuple(names):
        try:
            bench.family(name, request.seed)
        except MitsimError:
            del names[name]
    return tuple(names)


@dataclass(frozen=True, eq=False)
class _Evidence:
    """Light of the scene, the shots of the main family in it, and the camera's factors."""

    request: Request
    light: Light
    shots: Capture
    factors: Factors

    @classmethod
    def gather(cls, bench: Bench, folder: Path, request: Request, job: Job) -> _Evidence:
        """Trace, expose and calibrate, into the subfolders of ``folder``."""
        with job.clock.stage("plan"):
            plan = bench.plan(**request.model_dump())
        light = trace_request(bench, plan, job)
        shots = light.expose(request.patterns, folder / "run", job)
        session = replace(job, clock=Clock())
        factors = bench.calibrate(request.seed, request.accuracy, output=folder / "calibration", job=session)
        job.clock.add(session.clock.seconds(), "calibration ")
        return cls(request, light, shots, factors)

    def frames(self) -> dict[str, Channel]:
        """Two shots [DN] by caption, for people to look at."""
        count = len(self.shots.manifest.patterns.captures)
        folder = self.shots.folder or Path()
        return {
            _caption(self.request.patterns, index, count): read_frame(folder / frame_name(index))[0]["DN"]
            for index in (0, count // 2)
        }

    @property
    def warnings(self) -> tuple[str, ...]:
        """Of the capture and of the calibration."""
        return self.shots.warnings + self.factors.warnings


def _compare(evidence: _Evidence, names: tuple[str, ...], folder: Path, job: Job) -> DemoResult:
    """Every family in the same light, and the page that shows them."""
    comparison = Comparison(evidence.light, evidence.factors)
    results = {}
    with job.clock.stage("compare families"):
        for index, name in enumerate(names):
            results[name] = comparison.family(name)
            job.progress(label(name), (index + 1) / len(names))
    families, main = tuple(results.values()), evidence.request.patterns
    words = verdict(results[main], results["uniform"])
    with job.clock.stage("report"):
        frames = {_caption("uniform", 0, 1): comparison.white(), **evidence.frames()}
        page = _page(evidence, families, frames, words, job)
        report = build_report(page, folder / _PAGE)
    psnr = {f.name: f.rendered.quality.psnr_db for f in families if f.rendered}
    return DemoResult(
        psnr=psnr,
        psnr_ideal={f.name: f.idealised.quality.psnr_db for f in families if f.idealised},
        exposure={f.name: dict(f.by_exposure) for f in families},
        gain_db=psnr[main] - psnr["uniform"],
        verdict=words[0],
        mc_error=evidence.shots.manifest.mc_error or 0.0,
        seconds=job.clock.seconds(),
        report=str(report),
        warnings=evidence.warnings,
    )


def _page(
    evidence: _Evidence,
    families: tuple[FamilyResult, ...],
    frames: Mapping[str, npt.NDArray[Any]],
    words: tuple[str, str],
    job: Job,
) -> ReportData:
    bench, plan = evidence.light.bench, evidence.light.plan
    session, seed = evidence.factors.manifest.result, evidence.request.seed
    left = f"Beyond the sensor's noise, {session['unexplained_residual']:.1e} of them is left."
    return ReportData(
        title=f"Coded-illumination lensless imaging: {bench.loaded.path.parent.name}",
        verdict=words[0],
        verdict_detail=words[1],
        truth=evidence.light.truth,
        scene=scene_line(bench.loaded.path),
        render=pinhole_view(bench, load_recipe().board_reflectance, seed),
        families=families,
        frames=frames,
        exposure=f"equal peak: each family's brightest pixel fills {Exposure().fraction:.0%} of the full well",
        calibration={**session, "status": f"{evidence.factors.status} {left}"},
        budget=tuple(_budget(evidence)),
        accuracy=plan.accuracy,
        effects=plan.effects,
        seconds=job.clock.seconds(),
        configuration=_configuration(evidence),
        seeds={"root": seed},
        versions=versions(),
        notes=(
            "PSNR has peak 1 and no gain or offset fit; truth is apparent reflectance relative to the board.",
            "Idealised: the paper's model with its own exact factors and the same sensor noise.",
            "lambda is chosen by an unbiased risk estimate; no result has seen the truth.",
            *evidence.warnings,
        ),
    )


def _caption(name: str, index: int, count: int) -> str:
    return f"{label(name)}, {f'frame {index + 1} of {count}' if count > 1 else 'the only frame'}"


def _budget(evidence: _Evidence) -> Iterator[BudgetRow]:
    shots, session = evidence.shots.manifest, evidence.factors.manifest.result
    for name, value, meaning in (
        ("Monte Carlo", shots.mc_error, "rendering noise of the expected frames, from 8 independent groups"),
        (
            "Discretisation",
            evidence.light.plan.systematic_error,
            "anchors, cells and depth layers, predicted by the plan",
        ),
        ("Sensor noise", shots.sensor_noise, "shot and read noise of the frames, closed form"),
        ("Calibration", session["phi_error"], "error of the factors from noise in the calibration frames"),
        (
            "Separable model",
            session["noise_free_residual"],
            "what noise-free board frames leave beside Phi_L X Phi_R^T",
        ),
    ):
        yield BudgetRow(name, value or 0.0, meaning)


def _configuration(evidence: _Evidence) -> dict[str, object]:
    bench, request = evidence.light.bench, evidence.request
    geometry = bench.geometry
    return {
        "variant": bench.variant,
        "camera": bench.sensor.name,
        "projector": bench.projector.name,
        "parameters": ", ".join(f"{name} = {value}" for name, value in bench.defines.items()) or "the scene's own",
        "sensor": f"{geometry.pixels} x {geometry.pixels} pixels of {geometry.pixel_pitch * 1e3:g} um",
        "mask": f"{geometry.mask}, order {geometry.mask_order}, {geometry.mask_feature * 1e3:g} um, "
        f"{geometry.mask_distance:g} mm from the sensor",
        "scene plane": f"{geometry.scene_distance:g} mm, {bench.n} x {bench.n} projector pixels",
        f"exposure ({label(request.patterns)})": f"{evidence.shots.exposure_s:.3g} s a frame",
        "accuracy asked for": f"{request.accuracy:g}",
    }
