"""`mitsim demo`: the main job on any bench, from plan to report.

Folders ``run`` and ``calibration`` are what `mitsim capture` and `mitsim calibrate` write; the comparison of pattern
families and exposure conventions uses the same light, which is traced once.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.acquire.capture import expose, trace_request
from mitsim.api.bench import Bench
from mitsim.bench.request import Exposure, Request
from mitsim.calibrate.board_session import Session
from mitsim.core.configuration import opening_words
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError
from mitsim.core.exr import Channel, read_frame
from mitsim.core.files import write_json
from mitsim.core.job import Job
from mitsim.core.runs import Capture, frame_name
from mitsim.devices.session import load_recipe
from mitsim.light.light import SampledLight, pinhole_view
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.report import CONVENTIONS, EQUAL_PEAK, label
from mitsim.report.demo_page import BudgetRow, FamilyResult, Recovery, ReportData, Trust, build_report, verdict
from mitsim.report.lit_scene import LitScene, Unexposed
from mitsim.sensor.chain import Digital
from mitsim.studies.framework.run import DEMO_FOLDERS, DEMO_PAGE, study_folder

_BEFORE, _AFTER = ("uniform", "dots:4", "dots:5"), ("hadamard:8",)
"""Families that the main one stands between in the report: the paper's, from the fewest frames to the most."""


@dataclass(frozen=True)
class DemoResult:
    """What `mitsim demo` reports: PSNR [dB] by family, rendered and idealised, at equal peak, and by exposure
    convention; what the main family gains over uniform light, as a number and in words; the truth's standard error; how
    far to trust each family's image; wall time by stage, and the kernels that were compiled in it; and where the page
    is."""

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
        """What the command line reports."""
        return asdict(self)

    def lines(self) -> list[str]:
        """For people."""
        table = [
            f"{label(name):>14}: {value:5.1f} dB rendered and calibrated, {self.psnr_ideal[name]:5.1f} dB idealised"
            for name, value in self.psnr.items()
        ]
        truth = f"The truth is good to {-20 * math.log10(self.truth_error):.1f} dB."
        return [f"{self.verdict}.", f"Report: {self.report}", *table, *([truth] if self.truth_error else ())]


def demo(bench: Bench, output: Path | str, request: Request | None = None, job: Job | None = None) -> DemoResult:
    """Plan, capture, calibrate and reconstruct a scene under several pattern families, and write report.html.

    MitsimError for patterns that do not fit, a camera without a full well, a scene without light, an output that cannot
    be written or holds something else, or work beyond the job's limits.

    Parameters
    ----------
    bench, output, job
        the scene; a new or empty folder, or one with an earlier demo alone, which is replaced; clock and limits.
    request
        the main family, its accuracy and seed; it is compared with those of the paper that fit the projector.
    """
    request, job = request or Request.of(), job or Job()
    Exposure().check(bench.sensor, bench.devices.camera_file)
    names = _fitting(bench, request)
    Session(bench, load_recipe(), request.seed).check_mask(job)
    # Only now, with nothing left to refuse, is an earlier demo taken away.
    with study_folder(output, "demo") as folder:
        for part in DEMO_FOLDERS:
            shutil.rmtree(folder / part, ignore_errors=True)
        (folder / DEMO_PAGE).unlink(missing_ok=True)
        write_json(folder / "demo.json", {"kind": "demo", "status": "incomplete"})
        result = _run(bench, folder, request, names, job)
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


def _run(bench: Bench, folder: Path, request: Request, names: tuple[str, ...], job: Job) -> DemoResult:
    with job.clock.stage("plan"):
        sparsest = min(names, key=lambda name: bench.family(name, request.seed).lighting.lit)
        plan = bench.plan(**{**request.model_dump(), "patterns": sparsest})
    light = trace_request(bench, plan, job)
    shots = expose(light, request.patterns, folder / "run", job)
    session = job.apart("calibration ")
    factors = bench.calibrate(seed=request.seed, accuracy=request.accuracy, output=folder / "calibration", job=session)
    job.clock.add(session.clock.seconds(), "calibration ")
    comparison, families = Comparison(light, factors), {}
    with job.clock.stage("compare families"):
        for index, name in enumerate(names):
            families[name] = comparison.family(name, shots if name == request.patterns else None)
            job.progress(f"compare families: {label(name)}", (index + 1) / len(names))
    with job.clock.stage("views"):
        view = pinhole_view(bench, load_recipe().board_reflectance, request.seed)
        frames = {_caption("uniform", 0, 1): comparison.white(), **_frames(shots, folder / "run", request.patterns)}
    evidence = _Evidence(light, shots, factors, families, request.patterns)
    with job.clock.stage("report"):
        kernels = job.clock.kernels()
        page = replace(_page(evidence), render=view, frames=frames, seconds=job.clock.seconds(), kernels=kernels)
        report = build_report(page, folder / DEMO_PAGE)
    psnr = {name: f.rendered.quality.psnr_db for name, f in families.items() if f.rendered}
    return DemoResult(
        psnr=psnr,
        psnr_ideal={name: f.idealised.quality.psnr_db for name, f in families.items() if f.idealised},
        exposure={name: dict(f.by_exposure) for name, f in families.items()},
        gain_db=psnr[request.patterns] - psnr["uniform"],
        verdict=page.verdict,
        mc_error=shots.manifest.mc_error or 0.0,
        truth_error=light.apparent.error,
        trust={name: f.rendered.trust.summary() for name, f in families.items() if f.rendered and f.rendered.trust},
        seconds=job.clock.seconds(),
        kernels=kernels,
        report=str(report),
        warnings=evidence.warnings,
    )


@dataclass(frozen=True, eq=False)
class _Evidence:
    """What a demo came to: the scene's light, shots of the ``main`` family in it, factors, and all families."""

    light: SampledLight
    shots: Capture
    factors: Factors
    families: Mapping[str, FamilyResult]
    main: str

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why the demo is flagged: those of its frames and factors, and an image that is none or that its frames do not
        fit."""
        main = self.families[self.main]
        return self.shots.warnings + self.factors.warnings + _misfit(main) + _no_image(main)


def _page(evidence: _Evidence) -> ReportData:
    light, shots, factors = evidence.light, evidence.shots, evidence.factors
    bench, session = light.bench, factors.manifest.result
    headline, detail = verdict(evidence.families[evidence.main], evidence.families["uniform"])
    unexplained = session["unexplained_residual"]  # JSON has no infinity: None
    beyond = "" if not unexplained else f" Beyond the sensor's noise, {unexplained:.1e} of the responses is left."
    return ReportData(
        title=f"Coded-illumination lensless imaging: {bench.loaded.path.parent.name}",
        verdict=headline,
        verdict_detail=detail,
        truth=light.truth,
        scene=scene_line(bench.loaded.path),
        families=tuple(evidence.families.values()),
        main=evidence.main,
        exposure=f"equal peak: each family's brightest pixel fills {100 * Exposure().fraction:.0f} % of the full well",
        calibration={**session, "status": f"{factors.status}{beyond}"},
        budget=(
            BudgetRow(
                "Monte Carlo", shots.manifest.mc_error, "rendering noise of the expected frames, from its groups"
            ),
            BudgetRow(
                "Discretisation", light.plan.systematic_error, "anchors, cells and layers, predicted by the plan"
            ),
            BudgetRow("Sensor noise", shots.manifest.sensor_noise, "shot and read noise of the frames, closed form"),
            BudgetRow("Calibration", session["phi_error"], "error of the factors from noise in the calibration frames"),
            BudgetRow(
                "Separable model",
                session["noise_free_residual"],
                "what no product of a left and a right factor explains of noise-free frames of the board",
            ),
        ),
        accuracy=light.plan.accuracy,
        error=shots.manifest.total_error,
        effects=light.plan.effects,
        configuration=_configuration(evidence),
        seeds={"root": light.seed},
        versions=versions(),
        notes=(
            "PSNR has peak 1 and no gain or offset fit; truth is apparent reflectance relative to the board, with a "
            f"standard error of {light.apparent.error:.1e} from sampling of its own.",
            "Idealised: the paper's model with its own exact factors and the same sensor noise.",
            "lambda is chosen by an unbiased risk estimate; no result has seen the truth.",
        ),
        warnings=evidence.warnings,
    )


def _misfit(family: FamilyResult) -> tuple[str, ...]:
    if family.rendered is None or family.rendered.trust is None or not family.rendered.trust.cause:
        return ()
    # What the image can be used for all the same, rank and condition, is no warning.
    return (f"{family.label}: {family.rendered.status.partition('. ')[0]}",)


def _no_image(family: FamilyResult) -> tuple[str, ...]:
    if family.rendered is None or family.rendered.quality.is_image:
        return ()
    return (
        f"{family.label}: the rms error is above the whole range of reflectance ({family.rendered.quality.psnr_db:.1f} "
        "dB), so this is no image of the scene; the solver assumes a flat, matt print",
    )


def scene_line(path: Path) -> str:
    """Name of the folder of the scene ``path``, and the first sentence of the comment that opens the file, if any.

    A comment further down speaks of its own element and is left alone.
    """
    name, (sentence, _) = path.resolve().parent.name, opening_words(path)
    return f"{name}: {sentence}" if sentence else name


def _caption(name: str, index: int, count: int) -> str:
    return f"{label(name)}, {f'frame {index + 1} of {count}' if count > 1 else 'the only frame'}"


def _frames(shots: Capture, folder: Path, name: str) -> dict[str, Channel]:
    """Two shots [DN] of the family ``name`` by caption."""
    count = len(shots.manifest.patterns.captures)
    shown = {_caption(name, index, count): folder / frame_name(index) for index in (0, count // 2)}
    return {caption: read_frame(path)[0]["DN"] for caption, path in shown.items()}


def _configuration(evidence: _Evidence) -> dict[str, object]:
    bench = evidence.light.bench
    geometry = bench.geometry
    rows, columns = geometry.frame_shape
    size = " x ".join(f"{pitch * 1e3:g}" for pitch in geometry.pitches[geometry.row_pitch is None :])
    return {
        "variant": bench.variant,
        "camera": bench.sensor.name,
        "projector": bench.projector.name,
        "parameters": ", ".join(f"{name} = {value}" for name, value in bench.defines.items()) or "the scene's own",
        "sensor": f"{rows} x {columns} pixels of {size} um",
        "mask": f"{geometry.mask_words}, {geometry.mask_feature * 1e3:g} um, "
        f"{geometry.mask_distance:g} mm from the sensor",
        "scene plane": f"{geometry.scene_distance:g} mm, {bench.n} x {bench.n} projector pixels",
        f"exposure ({label(evidence.main)})": f"{evidence.shots.exposure_s:.3g} s a frame",
        "accuracy asked for": f"{evidence.light.plan.accuracy:g}",
    }


# -------- Pattern families compared on one scene

_SECOND_SHOWN = 0.4
"""Part of a family's shots after which its second example of a pattern comes, so that it is neither like the first nor
its mirror image."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Reconstructions of any family in the same light, with the same sensor, judged against the same truth.

    ``light`` is the scene's, by projector pixel, ``factors`` the camera's.
    """

    light: SampledLight
    factors: Factors

    def family(self, name: str, shots: Capture | None = None) -> FamilyResult:
        """Both reconstructions of the family ``name`` at equal peak, the rendered one with how far to trust it, and its
        PSNR [dB] under each exposure convention.

        Parameters
        ----------
        name
            of the family; MitsimError when it does not fit the projector.
        shots
            of it at equal peak, where they were taken already.
        """
        lit, seed = self._lit, self.light.seed
        family = lit.bench.family(name, seed)
        frames, ideal = lit.rendered_frames(self.factors, family, seed), lit.idealised_frames(family, seed)
        times = {convention: frames.seconds(convention) for convention in CONVENTIONS}
        rendered = {times[EQUAL_PEAK]: self._recover(shots or expose(self.light, name))}
        for time in times.values():
            if time not in rendered:
                rendered[time] = self._recovery(frames, time)
        singular = np.sort(frames.prepare().left.singular ** 2)[::-1]
        examples = family.shots[0], family.shots[int(len(family.shots) * _SECOND_SHOWN)]
        return FamilyResult(
            name=name,
            label=label(name),
            shots=len(family.shots),
            patterns=tuple(family.light(shot) for shot in dict.fromkeys(examples)),
            singular_values=singular / singular[0],
            idealised=self._recovery(ideal, ideal.seconds(EQUAL_PEAK)),
            rendered=rendered[times[EQUAL_PEAK]],
            by_exposure={convention: rendered[time].quality.psnr_db for convention, time in times.items()},
        )

    def white(self) -> Digital:
        """The noisy frame of uniform light at equal peak [DN]."""
        frames = self._lit.rendered_frames(self.factors, self.light.bench.family("uniform"), self.light.seed)
        (shot,), (frame,), exposer = frames.family.shots, frames.expected, frames.exposer(frames.seconds(EQUAL_PEAK))
        return exposer.digital(exposer.shot_electrons(frame, *shot.names), *shot.names)

    @cached_property
    def _lit(self) -> LitScene:
        return LitScene(self.light)

    def _recover(self, shots: Capture) -> Recovery:
        image = reconstruct(shots, self.factors)
        quality = self._lit.quality(image.image)
        # What the capture and the calibration are flagged for is in the report's notes, once for all families.
        status = replace(image.status, flags=())
        return Recovery(image.image, quality, image.lam, str(status), Trust.of(image, self.light.truth))

    def _recovery(self, frames: Unexposed, seconds: float) -> Recovery:
        solution = frames.solve(seconds)
        return Recovery(solution.image, self._lit.quality(solution.image), solution.lam, str(solution.status))
