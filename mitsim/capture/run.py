"""`mitsim capture`: from a bench and a pattern family to a folder of frames with everything needed to use them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.capture.bench import Bench, load_recipe
from mitsim.capture.clock import Clock
from mitsim.capture.exposer import FRAMES_AT_ONCE, Exposer, Exposure
from mitsim.capture.light import Light, Progress, collect, make_plan, silent, uniform_light
from mitsim.core.errors import MitsimError
from mitsim.core.frames import checksum, read_frame, write_frame
from mitsim.core.manifest import prepare_output, read_json, versions, write_json
from mitsim.core.parallel import in_threads
from mitsim.optics.frames import ExpectedFrames, Frame
from mitsim.scene.patterns import Capture, PatternFamily
from mitsim.scene.plan import Plan
from mitsim.sensor.chain import Digital

FloatArray = npt.NDArray[np.float64]


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
    sensor_noise: float
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
    family = bench.family(patterns, seed)
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
    writer = _Writer(family, folder, digest, Exposer(bench, exposure_s, seed))
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
        sensor_noise=writer.sensor_noise,
        plan=plan,
        warnings=warnings,
    )
    _write_manifest(bench, family, folder, digest, configuration, result, light, writer)
    return result


@dataclass(frozen=True, eq=False)
class _Exposed:
    """One captured frame: expected electrons, digital numbers, and the two noises [electrons, rms]."""

    index: int
    shown: Capture
    electrons: FloatArray
    digital: Digital
    rendering_noise: float
    sensor_noise: float


class _Writer:
    """Turns expected frames into noisy ones and writes them; frames already there from the same run are kept."""

    def __init__(self, family: PatternFamily, folder: Path, digest: str, exposer: Exposer) -> None:
        self.family, self.folder, self.digest, self.exposer = family, folder, digest, exposer
        self.saturated, self.noise_ratio = 0, 0.0
        self._noise_energy = self._energy = 0.0

    @property
    def sensor_noise(self) -> float:
        """Relative noise of the sensor, ||noise|| / ||expected||, over all frames, from its closed form."""
        return float(np.sqrt(self._noise_energy / self._energy)) if self._energy else 0.0

    def write_all(self, expected: ExpectedFrames, clock: Clock, progress: Progress) -> None:
        """Expose and write in chunks, one thread a processor; stages are timed on the wall clock."""
        numbered = enumerate(zip(self.family.captures, expected, strict=True))
        while True:
            with clock.stage("optics"):
                chunk = list(islice(numbered, FRAMES_AT_ONCE))
            if not chunk:
                return
            with clock.stage("sensor"):
                exposed = in_threads(self._expose, chunk)
            with clock.stage("write"):
                in_threads(self._write, exposed)
            for frame in exposed:
                self.noise_ratio = max(self.noise_ratio, frame.rendering_noise / frame.sensor_noise)
                self.saturated += self.exposer.saturated(frame.digital)
                self._noise_energy += frame.sensor_noise**2 * frame.electrons.size
                self._energy += float(np.square(frame.electrons).sum())
            progress("frames", (chunk[-1][0] + 1) / len(expected))

    def _expose(self, item: tuple[int, tuple[Capture, Frame]]) -> _Exposed:
        index, (shown, frame) = item
        electrons = self.exposer.electrons(frame)
        return _Exposed(
            index=index,
            shown=shown,
            electrons=electrons,
            digital=self.exposer.digital(electrons, *shown.names),
            rendering_noise=self.exposer.rendering_noise(frame),
            sensor_noise=self.exposer.sensor_noise(electrons),
        )

    def _write(self, frame: _Exposed) -> None:
        path = self.folder / frame_name(frame.index)
        if _is_kept(path, self.digest, frame.index):
            return
        metadata: dict[str, str | int | float] = {
            "run": self.digest,
            "index": frame.index,
            "row": frame.shown.row,
            "column": frame.shown.column,
            "sign": frame.shown.sign,
            "exposure_s": self.exposer.exposure_s,
            "rendering_noise_e": frame.rendering_noise,
            "seed": self.exposer.seed,
        }
        electrons = frame.electrons.astype(np.float32)
        if frame.digital.dtype == np.uint32:
            write_frame(path, {"DN": frame.digital.astype(np.uint32), "electrons": electrons}, metadata)
        else:
            write_frame(path, {"DN": frame.digital.astype(np.float32), "electrons": electrons}, metadata)


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
    board = collect(bench.with_board(load_recipe().board_reflectance), plan, *uniform_light(bench.n), seed)
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
