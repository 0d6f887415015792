"""`mitsim demo`: the main job on a shipped scene, from plan to report.

Folders ``run`` and ``calibration`` are exactly what `mitsim capture` and `mitsim calibrate` write; the comparison of
pattern families and exposure conventions reuses the same sampled light.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from mitsim.capture.bench import Bench, open_bench
from mitsim.capture.calibrate import CalibrationResult, calibrate
from mitsim.capture.folder import frame_name
from mitsim.capture.light import collect, pinhole_view
from mitsim.capture.plan import check_accuracy
from mitsim.capture.run import CaptureResult, capture
from mitsim.core.arrays import FloatArray, Progress, silent
from mitsim.core.configuration import shipped
from mitsim.core.framefile import read_frame
from mitsim.core.job import Clock, Job
from mitsim.core.manifest import read_json, versions, write_json
from mitsim.core.output import output_folder, sweep
from mitsim.reconstruct.calibration import Calibration
from mitsim.rig.patterns import PatternFamily
from mitsim.rig.recipe import load_recipe
from mitsim.study.compare import Comparison
from mitsim.study.describe import scene_line
from mitsim.study.metrics import read_truth
from mitsim.study.report import (
    BudgetRow,
    CalibrationFacts,
    CapturedFrame,
    EffectRow,
    ExposureRow,
    FamilyResult,
    ReportData,
    build_report,
    verdict,
)

_PARTS = ("run", "calibration", "demo.json", "report.html")
MAIN = "dots:7"
FAMILIES = {
    "uniform": "Uniform",
    "dots:4": "16 dots",
    "dots:5": "25 dots",
    MAIN: "49 dots",
    "hadamard:8": "64 Hadamard",
}


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
    with clock.stage("open scene"):
        bench = open_bench(scene or shipped("scenes", "photograph", "scene.xml"), variant)
    check_accuracy(accuracy)
    for name in FAMILIES:
        bench.family(name, seed)
    # Only now, with nothing left to refuse, is an earlier demo taken away.
    with _fresh(Path(output)) as folder:
        return _run(bench, folder, accuracy, seed, progress, clock)


def _run(bench: Bench, folder: Path, accuracy: float, seed: int, progress: Progress, clock: Clock) -> DemoResult:
    """The demo in a folder of its own."""
    captured = capture(bench, MAIN, folder / "run", accuracy, seed, progress=progress)
    clock.add(captured.seconds)
    session = calibrate(bench, None, accuracy, seed, folder / "calibration", job=Job(progress=progress))
    calibrated, factors = session.result, session.factors
    clock.add(calibrated.seconds, "calibration ")
    with clock.stage("transport"):
        light = collect(bench, captured.plan, *bench.family(MAIN, seed).classes(), seed)
    truth = read_truth(folder / "run")
    comparison = Comparison(bench, light, factors, truth, captured.plan, seed, progress)
    with clock.stage("compare families"):
        compared = [comparison.family(name, label) for name, label in FAMILIES.items()]
    families = [family for family, _ in compared]
    result = DemoResult(
        psnr={f.name: f.rendered.psnr_db for f in families if f.rendered},
        psnr_ideal={f.name: f.idealised.psnr_db for f in families if f.idealised},
        exposure={name: found for name, (_, found) in zip(FAMILIES, compared, strict=True)},
        gain_db=_quality(families, MAIN) - _quality(families, "uniform"),
        mc_error=captured.mc_error,
        seconds=clock.seconds(),
        report=str(folder / "report.html"),
        warnings=captured.warnings + calibrated.warnings,
    )
    with clock.stage("report"):
        rows = tuple(ExposureRow(FAMILIES[name], *found.values()) for name, found in result.exposure.items())
        white = CapturedFrame("Uniform, the only frame", comparison.frame("uniform", 0))
        data = _report(bench, captured, calibrated, factors, white, tuple(families), rows, truth, clock, seed)
        build_report(data, folder / "report.html")
    write_json(folder / "demo.json", {"kind": "demo", **asdict(result)})
    return result


def _quality(families: list[FamilyResult], name: str) -> float:
    return next(f.rendered.psnr_db for f in families if f.name == name and f.rendered)


def _is_demo(path: Path) -> bool:
    found = read_json(path)
    return isinstance(found, dict) and found.get("kind") == "demo"


@contextmanager
def _fresh(output: Path) -> Iterator[Path]:
    """The output folder, emptied of an earlier demo; refused when it holds anything else."""
    earlier = (output / "demo.json").is_file() and _is_demo(output / "demo.json")
    alone = earlier and all(item.name in _PARTS or item.name.startswith(".") for item in output.iterdir())
    with output_folder(output, overwrite=alone) as folder:
        sweep(folder)
        for part in ("run", "calibration"):
            shutil.rmtree(folder / part, ignore_errors=True)
        (folder / "report.html").unlink(missing_ok=True)
        write_json(folder / "demo.json", {"kind": "demo", "status": "incomplete"})
        yield folder


def _report(
    bench: Bench,
    captured: CaptureResult,
    calibrated: CalibrationResult,
    factors: Calibration,
    white: CapturedFrame,
    families: tuple[FamilyResult, ...],
    exposure: tuple[ExposureRow, ...],
    truth: FloatArray,
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
        truth=truth,
        scene=scene_line(bench.loaded.path),
        render=pinhole_view(bench, load_recipe().board_reflectance, seed),
        render_caption="The scene as Mitsuba renders it from the sensor's centre, before mask and noise.",
        families=families,
        frames=(white, *_frames(captured, main)),
        exposure=exposure,
        exposure_used="equal peak: each family's brightest pixel fills 80 % of the full well",
        calibration=CalibrationFacts(
            calibrated.n,
            calibrated.frames,
            calibrated.separability_residual,
            calibrated.phi_error,
            calibrated.condition,
            f"{factors.status} Beyond the sensor's noise, {calibrated.unexplained_residual:.1e} of them is left.",
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
    for index in (0, count // 2):
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
