"""`mitsim capture`: from a bench and a pattern family to a folder of frames with everything needed to use them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.capture.bench import Bench
from mitsim.capture.cost import frames_cost
from mitsim.capture.evidence import GROUPS, Settings
from mitsim.capture.exposer import FRAMES_AT_ONCE, Exposer, Exposure
from mitsim.capture.folder import RunFolder, claimed, frame_name
from mitsim.capture.light import Light, collect, make_plan, speckle_of, uniform_light
from mitsim.capture.plan import Plan
from mitsim.core.arrays import FloatArray, Progress, silent
from mitsim.core.errors import MitsimError
from mitsim.core.framefile import Channel
from mitsim.core.job import Clock
from mitsim.core.manifest import DECIDING, versions
from mitsim.core.parallel import in_threads, single_threaded_blas
from mitsim.core.resources import Limits
from mitsim.optics.frames import ExpectedFrames, Frame
from mitsim.rig.patterns import Capture, PatternFamily
from mitsim.rig.recipe import load_recipe
from mitsim.sensor.chain import Digital

_FIREFLIES = 0.8
"""Part of the variance in one of 8 groups: a single heavy path gives 0.875, and ordinary noise 0.2 to 0.4.

Normal noise gives 0.8 once in 600 runs if it is the same in all pixels of all frames (Grubbs' test), else never.
"""
_NEGLIGIBLE = 0.1
"""Part of the accuracy below which it does not matter what the Monte Carlo error is made of."""
_OF_PROJECTOR = frozenset({"aperture", "blur", "pixel-response"})


@dataclass(frozen=True)
class CaptureResult:
    """What `mitsim capture` reports; ``warnings`` make the run count as flagged.

    ``heaviest_group`` is the largest part of the frames' Monte Carlo variance that one group of the light brings.
    """

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
    heaviest_group: float
    plan: Plan
    warnings: tuple[str, ...] = field(default=())


@single_threaded_blas()
def capture(
    bench: Bench,
    patterns: str,
    output: Path | str,
    accuracy: float = 1e-3,
    seed: int = 0,
    exposure: Exposure | None = None,
    resume: bool = False,
    progress: Progress = silent,
    effects: Mapping[str, bool] | None = None,
    noise_fraction: float | None = None,
    limits: Limits | None = None,
) -> CaptureResult:
    """Render, expose and write every frame of a pattern family.

    Nothing is written before all input has been checked. ``resume`` keeps the frames of an interrupted run of the same
    configuration and adds the missing ones, bit-equal to an uninterrupted run.

    Raises
    ------
    MitsimError
        for patterns that do not fit, an output that cannot be written or holds something else, or a run that would
        take more memory, disk or time than ``limits`` allow.
    """
    limits = limits or Limits()
    exposure = exposure or Exposure()
    exposure.check(bench)
    if noise_fraction is not None and not 0 < noise_fraction <= 1:
        raise MitsimError(f"--noise-fraction {noise_fraction}: give a part of the sensor's noise above 0, up to 1")
    family = bench.family(patterns, seed)
    labels, weights = family.classes()
    size = weights.shape[1], len(weights)
    there = sum(path.stat().st_size for path in Path(output).glob("frame_*.exr")) if resume else 0
    first_look = frames_cost(bench, Settings(bench.geometry.scene_distance), *size, on_disk=there)
    first_look.check(patterns, limits, Path(output))
    configuration = {
        **bench.provenance(),
        **bench.identity(),
        "patterns": patterns,
        "accuracy": accuracy,
        "seed": seed,
        "exposure": asdict(exposure),
        "effects": dict(effects or {}),
        "noise_fraction": noise_fraction,
        "versions": {name: version for name, version in versions().items() if name in DECIDING},
    }
    digest = hashlib.sha256(json.dumps(configuration, sort_keys=True).encode()).hexdigest()
    clock = Clock()
    with claimed(Path(output), digest, configuration, resume) as folder:
        with clock.stage("plan"):
            plan = make_plan(bench, labels, weights, accuracy, seed, effects)
        cost = frames_cost(bench, plan.settings, *size, plan.predicted_seconds, there)
        cost.check(patterns, limits, folder.path)
        target = NoiseTarget(bench, exposure, noise_fraction, seed) if noise_fraction is not None else None
        with clock.stage("transport"):
            light = collect(bench, plan, labels, weights, seed, progress, by_pixel=False, target=target)
        with clock.stage("truth"):
            reflectance = truth(bench, plan, light, seed)
        expected = light.frames(labels, weights, seed)
        with clock.stage("optics"):
            # Forming the frames once finds the brightest pixel; a family with few classes keeps them for later.
            totals = _Totals.of(expected)
        exposer = Exposer(bench, exposure.choose(bench, totals.peak), seed, speckle_of(bench, plan))
        folder.begin()
        folder.write_truth(reflectance, load_recipe().board_reflectance)
        writer = _Writer(family, folder, exposer)
        writer.write_all(expected, clock, progress)
        result = CaptureResult(
            frames=len(family.captures),
            shape=(bench.geometry.pixels, bench.geometry.pixels),
            seconds=clock.seconds(),
            mc_error=totals.mc_error,
            variant=bench.variant,
            seed=seed,
            output=str(folder.path),
            exposure_s=exposer.exposure_s,
            mc_to_sensor_noise=writer.noise_ratio,
            sensor_noise=writer.sensor_noise,
            heaviest_group=totals.heaviest,
            plan=plan,
            warnings=plan.warnings + _warnings(accuracy, light, totals, writer),
        )
        folder.finish(_manifest(bench, family, result, light.paths))
    return result


@dataclass(frozen=True)
class NoiseTarget:
    """Monte Carlo error at which more sampling buys nothing: a part of the sensor's own relative noise."""

    bench: Bench
    exposure: Exposure
    fraction: float
    seed: int

    def __call__(self, expected: ExpectedFrames) -> float:
        peak = max(float(frame.irradiance.max()) for frame in expected)
        if peak <= 0:
            return np.inf
        exposer = Exposer(self.bench, self.exposure.choose(self.bench, peak), self.seed)
        noise = energy = 0.0
        for frame in expected:
            electrons = exposer.electrons(frame)
            noise += exposer.sensor_noise(electrons) ** 2 * electrons.size
            energy += float(np.square(electrons).sum())
        return self.fraction * float(np.sqrt(noise / energy))


@dataclass(frozen=True)
class _Totals:
    """Over all expected frames: brightest pixel [W m^-2], relative Monte Carlo error, most light below zero.

    ``heaviest``: the largest part of the Monte Carlo variance that one group of the light brings.
    """

    peak: float
    mc_error: float
    removed: float
    heaviest: float

    @classmethod
    def of(cls, expected: ExpectedFrames) -> _Totals:
        peak = energy = variance = removed = heaviest = 0.0
        for frame in expected:
            removed = max(removed, frame.removed)
            peak = max(peak, float(frame.irradiance.max()))
            energy += float(np.square(frame.irradiance).sum())
            variance += frame.variance * frame.irradiance.size
            heaviest += frame.heaviest * frame.variance * frame.irradiance.size
        mc_error = float(np.sqrt(variance / energy)) if energy else 0.0
        return cls(peak, mc_error, removed, heaviest / variance if variance else 0.0)


def _warnings(accuracy: float, light: Light, totals: _Totals, writer: _Writer) -> tuple[str, ...]:
    found = []
    if not light.reached:
        found.append(f"sampling stopped at {light.sampling_error:.1e}; the accuracy {accuracy:g} was not reached")
    if totals.removed > accuracy:
        found.append(f"interpolation between anchors left {totals.removed:.1e} of a frame below zero; ask for more")
    if totals.heaviest > _FIREFLIES and totals.mc_error > _NEGLIGIBLE * accuracy:
        found.append(
            f"one of {GROUPS} groups of the light brings {totals.heaviest:.1%} of the Monte Carlo variance: a few "
            "heavy paths (fireflies) make it, so mc_error may be far off; frames keep them unclipped, try another seed"
        )
    if writer.saturated:
        found.append(f"{writer.saturated} frames have pixels at the full well or the ADC's end; shorten the exposure")
    return tuple(found)


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

    def __init__(self, family: PatternFamily, folder: RunFolder, exposer: Exposer) -> None:
        self.family, self.folder, self.exposer = family, folder, exposer
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
                if frame.rendering_noise:
                    ratio = frame.rendering_noise / frame.sensor_noise if frame.sensor_noise else np.inf
                    self.noise_ratio = max(self.noise_ratio, ratio)
                self.saturated += self.exposer.saturated(frame.digital, frame.electrons)
                self._noise_energy += frame.sensor_noise**2 * frame.electrons.size
                self._energy += float(np.square(frame.electrons).sum())
            progress("frames", (chunk[-1][0] + 1) / len(expected))

    def _expose(self, item: tuple[int, tuple[Capture, Frame]]) -> _Exposed:
        index, (shown, frame) = item
        electrons = self.exposer.lit(frame, *shown.names)
        return _Exposed(
            index=index,
            shown=shown,
            electrons=electrons,
            digital=self.exposer.digital(electrons, *shown.names),
            rendering_noise=self.exposer.rendering_noise(frame),
            sensor_noise=self.exposer.sensor_noise(electrons),
        )

    def _write(self, frame: _Exposed) -> None:
        if self.folder.keeps(frame.index):
            return
        metadata: dict[str, str | int | float] = {
            "row": frame.shown.row,
            "column": frame.shown.column,
            "sign": frame.shown.sign,
            "exposure_s": self.exposer.exposure_s,
            "rendering_noise_e": frame.rendering_noise,
            "seed": self.exposer.seed,
        }
        electrons = frame.electrons.astype(np.float32)
        # EXR has no 64-bit numbers: the real-valued output of a sensor without an ADC is kept in single precision.
        whole = frame.digital.dtype == np.uint32
        dn: Channel = frame.digital.astype(np.uint32) if whole else frame.digital.astype(np.float32)
        self.folder.write_frame(frame.index, {"DN": dn, "electrons": electrons}, metadata)


def truth(bench: Bench, plan: Plan, light: Light, seed: int) -> FloatArray:
    """(n, n) apparent reflectance: each projector pixel's flux toward the camera over that of the calibration board.

    The board is the session's, so a board of reflectance 0.99 counts as 1 (DESIGN section 5).
    """
    reference = board_flux(bench, plan, seed)
    ratio = np.divide(light.flux, reference, out=np.zeros_like(reference), where=reference > 0)
    return ratio.reshape(bench.n, bench.n)


def board_flux(bench: Bench, plan: Plan, seed: int) -> FloatArray:
    """(n^2,) direct light of each projector pixel on the sensor, over the calibration board [W m^-2]."""
    settings = Settings(
        bench.geometry.scene_distance,
        plan.settings.anchors,
        effects=_OF_PROJECTOR & plan.settings.effects,
        direct_samples=plan.settings.direct_samples,
    )
    board = bench.with_board(load_recipe().board_reflectance)
    return collect(
        board, replace(plan, settings=settings), *uniform_light(bench.n), seed, purpose="board", by_pixel=False
    ).flux


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


def plan_block(plan: Plan) -> dict[str, Any]:
    """A plan as JSON."""
    settings = {**asdict(plan.settings), "effects": sorted(plan.settings.effects)}
    return {**asdict(plan), "settings": settings}


def digital_block(bench: Bench, exposure_s: float) -> dict[str, float]:
    """How digital numbers become electrons a second: (DN - black_level_dn) / gain / exposure - dark."""
    return {
        "exposure_s": exposure_s,
        "black_level_dn": bench.sensor.superpixel_black_level_dn,
        "gain_dn_per_e": bench.sensor.gain_dn_per_e,
        "dark_current_e_per_s": bench.sensor.superpixel_dark_current_e_per_s,
    }


def _manifest(bench: Bench, family: PatternFamily, result: CaptureResult, paths: int) -> dict[str, Any]:
    """What a solver and a reader of the run need, beside what the folder adds itself."""
    return {
        "camera": bench.identity(),
        "digital": digital_block(bench, result.exposure_s),
        "patterns": pattern_block(family, [frame_name(index) for index in range(result.frames)]),
        "plan": plan_block(result.plan),
        "mc_error": result.mc_error,
        "mc_to_sensor_noise": result.mc_to_sensor_noise,
        "heaviest_group": result.heaviest_group,
        "paths": paths,
        "seconds": result.seconds,
        "warnings": result.warnings,
        "versions": versions(),
    }
