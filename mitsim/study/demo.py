"""`mitsim demo`: the main job on a shipped scene, from plan to report.

Folders ``run`` and ``calibration`` are exactly what `mitsim capture` and `mitsim calibrate` write; the comparison of
pattern families and exposure conventions reuses the same sampled light.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.calibrate.hadamard import Calibration
from mitsim.capture.bench import Bench, PatternFamily, load_recipe, open_bench
from mitsim.capture.clock import Clock
from mitsim.capture.exposer import Exposer, Exposure
from mitsim.capture.light import Light, Progress, collect, pinhole_view, silent, uniform_light
from mitsim.capture.run import CaptureResult, capture, frame_name
from mitsim.core.configuration import shipped
from mitsim.core.frames import read_frame
from mitsim.core.manifest import prepare_output, read_json, versions, write_json
from mitsim.optics.frames import ExpectedFrames
from mitsim.reconstruct.solver import Prepared, Solution, prepare
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.study.calibration import CalibrationResult, calibrate
from mitsim.study.describe import scene_line
from mitsim.study.ideal import ideal_factors, ideal_light
from mitsim.study.metrics import psnr, read_truth, ssim
from mitsim.study.report import (
    BudgetRow,
    CalibrationFacts,
    CapturedFrame,
    EffectRow,
    ExposureRow,
    FamilyResult,
    Recovery,
    ReportData,
    build_report,
    verdict,
)

FloatArray = npt.NDArray[np.float64]
MAIN = "dots:7"
FAMILIES = {
    "uniform": "Uniform",
    "dots:4": "16 dots",
    "dots:5": "25 dots",
    MAIN: "49 dots",
    "hadamard:8": "64 Hadamard",
}
CONVENTIONS = ("equal peak", "equal frame", "equal total")


@dataclass(frozen=True)
class DemoResult:
    """What `mitsim demo` reports: PSNR by family, rendered and idealised, at equal peak, and where the page is."""

    psnr: dict[str, float]
    psnr_ideal: dict[str, float]
    exposure: dict[str, dict[str, float]]
    gain_db: float
    mc_error: float
    seconds: dict[str, float]
    report: str
    warnings: tuple[str, ...] = field(default=())


def demo(
    output: Path | str,
    scene: Path | str | None = None,
    variant: str = "llvm_ad_mono",
    accuracy: float = 1e-3,
    seed: int = 0,
    progress: Progress = silent,
) -> DemoResult:
    """Plan, capture, calibrate and reconstruct a scene under five pattern families, and write report.html.

    An earlier demo in ``output`` is replaced; any other content there is refused.
    """
    clock = Clock()
    folder = _fresh(Path(output))
    with clock.stage("open scene"):
        bench = open_bench(scene or shipped("scenes", "photograph", "scene.xml"), variant)
    captured = capture(bench, MAIN, folder / "run", accuracy, seed, progress=progress)
    clock.add(captured.seconds)
    calibrated, factors = calibrate(bench, folder / "calibration", accuracy, seed, progress=progress)
    clock.add(calibrated.seconds, "calibration ")
    comparison = _Comparison(bench, captured, factors, folder, seed, clock, progress)
    families = [comparison.family(name) for name in FAMILIES]
    exposure = [comparison.exposures(name) for name in FAMILIES]
    result = DemoResult(
        psnr={f.name: f.rendered.psnr_db for f in families if f.rendered},
        psnr_ideal={f.name: f.idealised.psnr_db for f in families if f.idealised},
        exposure={name: rows for name, (rows, _) in zip(FAMILIES, exposure, strict=True)},
        gain_db=_quality(families, MAIN) - _quality(families, "uniform"),
        mc_error=captured.mc_error,
        seconds=clock.seconds(),
        report=str(folder / "report.html"),
        warnings=captured.warnings + calibrated.warnings,
    )
    with clock.stage("report"):
        rows = tuple(row for _, row in exposure)
        data = _report(bench, captured, calibrated, factors, comparison, tuple(families), rows, clock, seed)
        build_report(data, folder / "report.html")
    write_json(folder / "demo.json", {"kind": "demo", **asdict(result)})
    return result


class _Comparison:
    """Reconstructions of every family from one light, rendered and idealised, at several exposures."""

    def __init__(
        self,
        bench: Bench,
        captured: CaptureResult,
        factors: Calibration,
        folder: Path,
        seed: int,
        clock: Clock,
        progress: Progress,
    ) -> None:
        self.bench, self.seed, self.clock, self.progress = bench, seed, clock, progress
        self.captured, self.factors = captured, factors
        self.truth = read_truth(folder / "run")
        main = bench.family(MAIN, seed)
        with clock.stage("transport"):
            self.light = collect(bench, captured.plan, *main.classes(), seed)
            board = bench.with_board(load_recipe().board_reflectance)
            self.board_flux = float(collect(board, captured.plan, *uniform_light(bench.n), seed).flux().mean())
        self.ideal = ideal_light(bench, self.truth, self.board_flux)
        rate = float(electrons_from_irradiance(1.0, 1.0, bench.sensor, bench.projector.effective_wavelength_nm))
        self.ideal_factors = ideal_factors(bench, self.board_flux, rate)
        self.uniform_s = self._peak_time(self.light, "uniform")

    def family(self, name: str) -> FamilyResult:
        """Both reconstructions at equal peak, with singular values and two example patterns."""
        family = self.bench.family(name, self.seed)
        prepared = self._prepared(family, rendered=True)
        singular = np.sort(prepared.left.singular**2)[::-1]
        shown = (
            family.captures[0],
            family.captures[2 * len(family.captures) // 5 + 2 if len(family.captures) > 4 else 0],
        )
        return FamilyResult(
            name=name,
            label=FAMILIES[name],
            captures=len(family.captures),
            patterns=tuple(family.light(one) for one in shown[: min(2, len(family.captures))]),
            singular_values=singular / singular[0],
            idealised=self._recovery(name, self._peak_time(self.ideal, name), rendered=False),
            rendered=self._recovery(name, self._peak_time(self.light, name), rendered=True),
        )

    def exposures(self, name: str) -> tuple[dict[str, float], ExposureRow]:
        """PSNR of the rendered reconstruction under the three exposure conventions."""
        captures = len(self.bench.family(name, self.seed).captures)
        times = (self._peak_time(self.light, name), self.uniform_s, self.uniform_s / captures)
        found = [self._recovery(name, time, rendered=True).psnr_db for time in times]
        return dict(zip(CONVENTIONS, found, strict=True)), ExposureRow(FAMILIES[name], *found)

    def _recovery(self, name: str, exposure_s: float, rendered: bool) -> Recovery:
        family = self.bench.family(name, self.seed)
        light = self.light if rendered else self.ideal
        exposer = Exposer(self.bench, exposure_s, self.seed if rendered else self.seed + 1)
        prepared = self._prepared(family, rendered)
        with self.clock.stage("compare families"):
            solution = _solve(prepared, exposer, family, self._expected(light, family))
        self.progress(f"{FAMILIES[name]}", 1.0)
        return Recovery(
            solution.image,
            psnr(solution.image, self.truth),
            ssim(solution.image, self.truth),
            solution.lam,
            solution.status,
        )

    def _prepared(self, family: PatternFamily, rendered: bool) -> Prepared:
        left, right = (self.factors.left, self.factors.right) if rendered else self.ideal_factors
        return prepare(left, right, family.left, family.right, centre=self.bench.geometry.mask == "flatcam")

    def _expected(self, light: Light, family: PatternFamily) -> ExpectedFrames:
        return light.frames(*family.classes(), self.seed)

    def _peak_time(self, light: Light, name: str) -> float:
        family = self.bench.family(name, self.seed)
        with self.clock.stage("compare families"):
            peak = max(float(frame.irradiance.max()) for frame in self._expected(light, family))
        return Exposure().choose(self.bench, peak)


def _solve(prepared: Prepared, exposer: Exposer, family: PatternFamily, expected: ExpectedFrames) -> Solution:
    frames = prepared.accumulator()
    for measurement, row, column in exposer.measurements(family, expected):
        frames.add(measurement, row, column)
    return prepared.solve(frames, "auto")


def _quality(families: list[FamilyResult], name: str) -> float:
    return next(f.rendered.psnr_db for f in families if f.name == name and f.rendered)


def _fresh(folder: Path) -> Path:
    """The output folder, emptied of an earlier demo and of nothing else."""
    if folder.is_dir() and (folder / "demo.json").is_file() and read_json(folder / "demo.json").get("kind") == "demo":
        for part in ("run", "calibration"):
            shutil.rmtree(folder / part, ignore_errors=True)
        for name in ("demo.json", "report.html"):
            (folder / name).unlink(missing_ok=True)
    prepare_output(folder)
    write_json(folder / "demo.json", {"kind": "demo", "status": "incomplete"})
    return folder


def _report(
    bench: Bench,
    captured: CaptureResult,
    calibrated: CalibrationResult,
    factors: Calibration,
    comparison: _Comparison,
    families: tuple[FamilyResult, ...],
    exposure: tuple[ExposureRow, ...],
    clock: Clock,
    seed: int,
) -> ReportData:
    best = next(f for f in families if f.name == MAIN)
    headline, detail = verdict(best, families[0])
    main = bench.family(MAIN, seed)
    return ReportData(
        title=f"Coded-illumination lensless imaging: {bench.loaded.path.parent.name}",
        verdict=headline,
        verdict_detail=detail,
        truth=comparison.truth,
        scene=scene_line(bench.loaded.path),
        render=pinhole_view(bench, load_recipe().board_reflectance, seed),
        render_caption="The scene as Mitsuba renders it from the sensor's centre, before mask and noise.",
        families=families,
        frames=tuple(_frames(captured, main)),
        exposure=exposure,
        exposure_used="equal peak: each family's brightest pixel fills 80 % of the full well",
        calibration=CalibrationFacts(
            calibrated.n,
            calibrated.frames,
            calibrated.separability_residual,
            calibrated.phi_error,
            calibrated.condition,
            factors.status,
        ),
        budget=tuple(_budget(captured, calibrated)),
        accuracy=captured.plan.accuracy,
        effects=tuple(EffectRow(**asdict(effect)) for effect in captured.plan.effects),
        seconds=clock.seconds(),
        configuration=_configuration(bench, captured),
        seeds={"root": seed},
        versions=versions(),
        notes=(
            "PSNR has peak 1 and no gain or offset fit; truth is apparent reflectance relative to the board.",
            "Idealised: the paper's model with its own exact factors and the same sensor noise.",
            "lambda is chosen by an unbiased risk estimate; no result has seen the truth.",
            *captured.warnings,
            *calibrated.warnings,
        ),
    )


def _frames(captured: CaptureResult, family: PatternFamily) -> Iterator[CapturedFrame]:
    count = len(family.captures)
    for index in (0, count // 2, count - 1):
        channels, _ = read_frame(Path(captured.output) / frame_name(index))
        yield CapturedFrame(f"{FAMILIES[MAIN]}, frame {index + 1} of {count}", channels["DN"])


def _budget(captured: CaptureResult, calibrated: CalibrationResult) -> Iterator[BudgetRow]:
    yield BudgetRow(
        "Monte Carlo", captured.mc_error, "rendering noise of the expected frames, from 8 independent groups"
    )
    yield BudgetRow(
        "Discretisation", captured.plan.systematic_error, "anchors, cells and depth layers, predicted by the plan"
    )
    yield BudgetRow("Sensor noise", captured.sensor_noise, "shot and read noise of the frames, closed form")
    yield BudgetRow("Calibration", calibrated.phi_error, "error of the factors from noise in the calibration frames")
    yield BudgetRow(
        "Separable model", calibrated.noise_free_residual, "what noise-free board frames leave beside Phi_L X Phi_R^T"
    )


def _configuration(bench: Bench, captured: CaptureResult) -> dict[str, Any]:
    geometry = bench.geometry
    return {
        "variant": bench.variant,
        "camera": bench.sensor.name,
        "projector": bench.projector.name,
        "sensor": f"{geometry.pixels} x {geometry.pixels} pixels of {geometry.pixel_pitch * 1e3:g} um",
        "mask": f"{geometry.mask}, order {geometry.mask_order}, {geometry.mask_feature * 1e3:g} um, "
        f"{geometry.mask_distance:g} mm from the sensor",
        "scene plane": f"{geometry.scene_distance:g} mm, {bench.n} x {bench.n} projector pixels",
        "exposure (49 dots)": f"{captured.exposure_s:.3g} s a frame",
        "accuracy asked for": f"{captured.plan.accuracy:g}",
    }
