"""`mitsim capture`: from a bench and a pattern family to a folder of frames with everything needed to use them."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.capture.bench import Bench, load_recipe
from mitsim.capture.light import Light, Progress, collect, make_plan, silent
from mitsim.core.errors import MitsimError
from mitsim.core.frames import checksum, read_frame, write_frame
from mitsim.core.manifest import prepare_output, read_json, versions, write_json
from mitsim.core.seeds import stream
from mitsim.optics.frames import ExpectedFrames, Frame
from mitsim.scene.patterns import Capture, PatternFamily, parse_patterns
from mitsim.scene.plan import Plan
from mitsim.sensor.chain import electrons_from_irradiance, exposure_for_peak, expose, frame_moments

FloatArray = npt.NDArray[np.float64]
_AT_ONCE = 16
_WORKERS = 2


@dataclass(frozen=True)
class Exposure:
    """One exposure for a whole session: ``seconds`` by hand, or the brightest pixel at ``fraction`` of full well."""

    seconds: float | None = None
    fraction: float = 0.8

    def __post_init__(self) -> None:
        if self.seconds is not None and not 0 < self.seconds < np.inf:
            raise MitsimError(f"exposure {self.seconds} s: give a finite time above 0, or auto")

    def choose(self, bench: Bench, peak_irradiance: float) -> float:
        """Exposure time [s] for frames whose brightest expected pixel has this irradiance [W m^-2]."""
        if self.seconds is not None:
            return self.seconds
        wavelength = bench.projector.effective_wavelength_nm
        return exposure_for_peak(peak_irradiance, self.fraction, bench.sensor, wavelength)


@dataclass(frozen=True)
class CaptureResult:
    """What `mitsim capture` reports; ``warnings`` make the run count as flagged."""

    frames: int
    shape: tuple[int, int]
    seconds: dict[str, float]
    mc_error: float
    variant: str
    seed: int
    output: str
    exposure_s: float
    mc_to_sensor_noise: float
    plan: Plan
    warnings: tuple[str, ...] = field(default=())


def capture(
    bench: Bench,
    patterns: str,
    output: Path | str,
    accuracy: float = 1e-3,
    seed: int = 0,
    exposure: Exposure | None = None,
    resume: bool = False,
    progress: Progress = silent,
) -> CaptureResult:
    """Render, expose and write every frame of a pattern family.

    Nothing is written before all input has been checked. ``resume`` keeps the frames of an interrupted run of the same
    configuration and adds the missing ones, bit-equal to an uninterrupted run.

    Raises
    ------
    MitsimError
        for patterns that do not fit, an output that cannot be written or holds something else.
    """
    exposure = exposure or Exposure()
    family = parse_patterns(patterns, bench.n, seed)
    configuration = {
        **bench.provenance(),
        **bench.identity(),
        "patterns": patterns,
        "accuracy": accuracy,
        "seed": seed,
        "exposure": asdict(exposure),
    }
    digest = hashlib.sha256(json.dumps(configuration, sort_keys=True).encode()).hexdigest()
    clock = Clock()
    labels, weights = family.classes()
    with clock.stage("plan"):
        plan = make_plan(bench, labels, weights, accuracy, seed)
    folder = _open_run(Path(output), digest, configuration, resume)
    with clock.stage("transport"):
        light = collect(bench, plan, labels, weights, seed, progress)
    with clock.stage("truth"):
        _write_truth(bench, plan, light, folder, seed)
    expected = light.frames(labels, weights, seed)
    with clock.stage("optics"):
        # Forming the frames once finds the brightest pixel; a family with few classes keeps them for the second time.
        peak, energy, variance, removed = 0.0, 0.0, 0.0, 0.0
        for frame in expected:
            removed = max(removed, frame.removed)
            peak = max(peak, float(frame.irradiance.max()))
            energy += float(np.square(frame.irradiance).sum())
            variance += frame.variance * frame.irradiance.size
    exposure_s = exposure.choose(bench, peak)
    writer = _Writer(bench, family, folder, digest, exposure_s, seed)
    writer.write_all(expected, clock, progress)
    mc_error = float(np.sqrt(variance / energy)) if energy else 0.0
    warnings = plan.warnings
    if not light.reached:
        warnings += (f"sampling stopped at {light.sampling_error:.1e}; the accuracy {accuracy:g} was not reached",)
    if removed > accuracy:
        warnings += (f"interpolation between anchors left {removed:.1e} of a frame below zero; ask for more accuracy",)
    if writer.saturated:
        warnings += (f"{writer.saturated} frames have pixels at the full well or the ADC's end; shorten the exposure",)
    result = CaptureResult(
        frames=len(family.captures),
        shape=(bench.geometry.pixels, bench.geometry.pixels),
        seconds=clock.seconds(),
        mc_error=mc_error,
        variant=bench.variant,
        seed=seed,
        output=str(folder),
        exposure_s=exposure_s,
        mc_to_sensor_noise=writer.noise_ratio,
        plan=plan,
        warnings=warnings,
    )
    _write_manifest(bench, family, folder, digest, configuration, result, light, writer)
    return result


class Clock:
    """Seconds by stage, in the order of first use."""

    def __init__(self) -> None:
        self._started = time.perf_counter()
        self._stages: dict[str, float] = {}
        self._running: list[tuple[str, float]] = []

    def stage(self, name: str) -> Clock:
        """Use as a context: adds the time spent inside to ``name``."""
        self._running.append((name, 0.0))
        return self

    def __enter__(self) -> None:
        name, _ = self._running[-1]
        self._running[-1] = (name, time.perf_counter())

    def __exit__(self, *_: object) -> None:
        name, started = self._running.pop()
        self._stages[name] = self._stages.get(name, 0.0) + time.perf_counter() - started

    def seconds(self) -> dict[str, float]:
        """Stages and ``total`` since the clock was made."""
        return {**self._stages, "total": time.perf_counter() - self._started}


class _Writer:
    """Turns expected frames into noisy ones and writes them; frames already there from the same run are kept."""

    def __init__(
        self, bench: Bench, family: PatternFamily, folder: Path, digest: str, exposure_s: float, seed: int
    ) -> None:
        self.bench, self.family, self.folder, self.digest = bench, family, folder, digest
        self.exposure_s, self.seed = exposure_s, seed
        self.saturated, self.noise_ratio = 0, 0.0

    def write_all(self, expected: ExpectedFrames, clock: Clock, progress: Progress) -> None:
        """Expose and write in chunks, two threads each; stages are timed on the wall clock."""
        total = len(expected)
        with ThreadPoolExecutor(_WORKERS) as pool:
            numbered = enumerate(zip(self.family.captures, expected, strict=True))
            while True:
                with clock.stage("optics"):
                    chunk = list(islice(numbered, _AT_ONCE))
                if not chunk:
                    return
                with clock.stage("sensor"):
                    exposed = list(pool.map(self._expose, chunk))
                with clock.stage("write"):
                    list(pool.map(self._write, exposed))
                progress("frames", (chunk[-1][0] + 1) / total)

    def _expose(self, item: tuple[int, tuple[Capture, Frame]]) -> tuple[int, Capture, Frame, FloatArray, Any]:
        index, (shown, frame) = item
        sensor, wavelength = self.bench.sensor, self.bench.projector.effective_wavelength_nm
        electrons = electrons_from_irradiance(frame.irradiance, self.exposure_s, sensor, wavelength)
        name = f"{shown.row}/{shown.column}/{shown.sign}"
        dn = expose(
            electrons, self.exposure_s, sensor, stream(self.seed, "shot", name), stream(self.seed, "read", name)
        )
        return index, shown, frame, electrons, dn

    def _write(self, item: tuple[int, Capture, Frame, FloatArray, Any]) -> None:
        index, shown, frame, electrons, dn = item
        sensor = self.bench.sensor
        ceiling = sensor.largest_dn
        full = sensor.superpixel_full_well_e * sensor.gain_dn_per_e + sensor.superpixel_black_level_dn
        limit = full if ceiling is None else min(full, ceiling)
        self.saturated += int(dn.max() >= np.floor(limit))
        scale = electrons_from_irradiance(1.0, self.exposure_s, sensor, self.bench.projector.effective_wavelength_nm)
        rendering = np.sqrt(frame.variance) * float(scale)
        sensor_noise = np.sqrt(frame_moments(electrons, self.exposure_s, sensor)[1].mean()) / sensor.gain_dn_per_e
        self.noise_ratio = max(self.noise_ratio, float(rendering / sensor_noise))
        path = self.folder / frame_name(index)
        if _is_kept(path, self.digest, index):
            return
        metadata = {
            "run": self.digest,
            "index": index,
            "row": shown.row,
            "column": shown.column,
            "sign": shown.sign,
            "exposure_s": self.exposure_s,
            "rendering_noise_e": float(rendering),
            "seed": self.seed,
        }
        digital = dn if dn.dtype == np.uint32 else dn.astype(np.float32)
        write_frame(path, {"DN": digital, "electrons": electrons.astype(np.float32)}, metadata)


def frame_name(index: int) -> str:
    """File name of a capture in its run folder."""
    return f"frame_{index:05d}.exr"


def _is_kept(path: Path, digest: str, index: int) -> bool:
    if not path.exists():
        return False
    try:
        _, metadata = read_frame(path)
    except MitsimError:
        return False
    return metadata.get("run") == digest and metadata.get("index") == index


def _open_run(folder: Path, digest: str, configuration: dict[str, Any], resume: bool) -> Path:
    manifest = folder / "manifest.json"
    if resume and manifest.exists():
        found = read_json(manifest)
        if found.get("configuration_sha256") != digest:
            changed = [k for k, v in configuration.items() if found.get("configuration", {}).get(k) != v]
            raise MitsimError(
                f"--resume: {folder} holds a run of another configuration ({', '.join(changed) or 'unknown'} differ); "
                "use the same options, or another folder"
            )
        prepare_output(folder, overwrite=True)
        return folder
    prepare_output(folder)
    write_json(
        manifest,
        {"kind": "capture", "status": "incomplete", "configuration": configuration, "configuration_sha256": digest},
    )
    return folder


def _write_truth(bench: Bench, plan: Plan, light: Light, folder: Path, seed: int) -> None:
    write_frame(
        folder / "truth.exr", {"reflectance": truth(bench, plan, light, seed).astype(np.float32)}, {"peak": 1.0}
    )


def truth(bench: Bench, plan: Plan, light: Light, seed: int) -> FloatArray:
    """(n, n) apparent reflectance: each projector pixel's flux toward the camera over that of the calibration board.

    The board is the session's, so a board of reflectance 0.99 counts as 1 (DESIGN section 5).
    """
    uniform = np.zeros(bench.n**2, dtype=np.int64), np.ones((1, 1))
    board = collect(bench.with_board(load_recipe().board_reflectance), plan, *uniform, seed)
    reference = board.flux()
    ratio = np.divide(light.flux(), reference, out=np.zeros_like(reference), where=reference > 0)
    return ratio.reshape(bench.n, bench.n)


def pattern_block(family: PatternFamily, files: Sequence[str]) -> dict[str, Any]:
    """What a solver must know of the patterns, as it stands in a manifest."""
    return {
        "family": family.name,
        "n": family.n,
        "P_L": family.left.tolist(),
        "P_R": family.right.tolist(),
        "captures": [
            {"file": file, "row": c.row, "column": c.column, "sign": c.sign}
            for file, c in zip(files, family.captures, strict=True)
        ],
    }


def digital_block(bench: Bench, exposure_s: float) -> dict[str, float]:
    """How digital numbers become electrons a second: (DN - black_level_dn) / gain / exposure - dark."""
    return {
        "exposure_s": exposure_s,
        "black_level_dn": bench.sensor.superpixel_black_level_dn,
        "gain_dn_per_e": bench.sensor.gain_dn_per_e,
        "dark_current_e_per_s": bench.sensor.superpixel_dark_current_e_per_s,
    }


def _write_manifest(
    bench: Bench,
    family: PatternFamily,
    folder: Path,
    digest: str,
    configuration: dict[str, Any],
    result: CaptureResult,
    light: Light,
    writer: _Writer,
) -> None:
    files = [frame_name(index) for index in range(result.frames)]
    write_json(
        folder / "manifest.json",
        {
            "kind": "capture",
            "status": "complete",
            "configuration": configuration,
            "configuration_sha256": digest,
            "camera": bench.identity(),
            "digital": digital_block(bench, result.exposure_s),
            "patterns": pattern_block(family, files),
            "checksums": {name: checksum(folder / name) for name in [*files, "truth.exr"]},
            "plan": asdict(result.plan),
            "mc_error": result.mc_error,
            "mc_to_sensor_noise": result.mc_to_sensor_noise,
            "paths": light.paths,
            "seconds": result.seconds,
            "warnings": result.warnings,
            "versions": versions(),
        },
    )


def expected_electrons(bench: Bench, expected: ExpectedFrames, exposure_s: float) -> Iterator[FloatArray]:
    """Noise-free photoelectrons of each capture."""
    for frame in expected:
        yield electrons_from_irradiance(
            frame.irradiance, exposure_s, bench.sensor, bench.projector.effective_wavelength_nm
        )
