"""A capture: from a bench and a request to one noisy frame for each shot, in memory or in a folder as they are made."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.acquire.exposure import AmbientFrame, Exposer, NoiseTarget, camera_warnings, in_chunks, is_taken, shots_for
from mitsim.bench.bench import Apparatus
from mitsim.bench.request import Request
from mitsim.core.arrays import FloatArray, sum_of_squares
from mitsim.core.environment import deciding_versions, versions
from mitsim.core.errors import ArgumentError, cut
from mitsim.core.exr import Channel
from mitsim.core.files import FRAMES
from mitsim.core.job import Job
from mitsim.core.manifests import MANIFEST, AmbientFile, Patterns, RunHead, RunManifest
from mitsim.core.manifests import Digital as DigitalScale
from mitsim.core.parallel import Behind, in_threads, single_threaded_blas
from mitsim.core.runs import AMBIENT, Capture, Recorder, RunMemory, check_same, claimed, frame_name
from mitsim.devices.patterns import Lighting, PatternFamily, Shot
from mitsim.devices.sensor import digital_of
from mitsim.devices.session import load_recipe
from mitsim.light.light import SampledLight, Sampling, trace_light
from mitsim.light.plan import Plan
from mitsim.light.settings import GROUPS, Estimate, Settings
from mitsim.optics.frames import ExpectedFrames, Frame, bound_of
from mitsim.planner.explain import known_losses
from mitsim.planner.memory import frame_seconds, frames_cost
from mitsim.planner.planner import make_plan, plan_within
from mitsim.sensor.chain import Digital

_FIREFLIES = 0.72
"""Part of the variance in one of four groups: a single heavy path gives 0.75, and ordinary noise 0.3 to 0.5.

Normal noise gives 0.72 once in 12 runs if it is the same in all pixels of all frames, once in 150 if it is of two such
kinds, once in 2000 if of three, and else never.
"""
_DROWNED = 1.0
"""Noise over the projector's light at which ambient light has ended the dynamic range: 49 dots of lamp_bench give 29 dB
at 0.03, 17 dB at 0.3, and 12 dB, next to no image, at 3."""
_DILUTED = 10.0
"""Error relative to the projector's light, over the accuracy, from which a run is flagged: another order of magnitude
than was asked for. It is stated in all runs; lamp_bench as shipped has 7."""
_NOISIER = 2.0
"""Monte Carlo error of a family's frames over that of the family the light was traced for, above which that is said:
6 dB of an image. Families whose shots light as many pixels are alike to a tenth."""
_NEGLIGIBLE = 0.1
"""Part of the accuracy below which it does not matter what the Monte Carlo error is made of."""


def plan_request(bench: Apparatus, request: Request, lines: int = 1) -> Plan:
    """The plan of a capture, with the request that it is for and what it takes on this bench.

    Parameters
    ----------
    bench, request
        what is asked for.
    lines
        that share the paths, of which the bench shows one; what it takes is told of all.

    Raises
    ------
    MitsimError
        when the request does not fit the bench, or no light of the projector reaches the camera.
    """
    lighting = bench.family(request.patterns, request.seed).lighting
    plan = _planned(bench, lighting, request, lines)
    cost = frames_cost(bench, plan.settings, lighting, plan.predicted_seconds, lines=lines)
    return replace(plan, request=request, cost=cost)


def _planned(bench: Apparatus, lighting: Lighting, request: Request, lines: int) -> Plan:
    """The plan of a capture, with what exposing and writing its frames takes."""
    exposing, effects = frame_seconds(bench, lines * len(lighting.weights)), request.effects
    if request.seconds is None:
        plan = make_plan(bench, lighting, request.accuracy, request.seed, effects, lines)
    else:
        plan = plan_within(bench, lighting, request.seconds, request.seed, effects)
    return plan.taking(**exposing)


def trace_request(bench: Apparatus, plan: Plan, job: Job | None = None) -> SampledLight:
    """Light by projector pixel, as a plan asks.

    Parameters
    ----------
    bench, plan
        what is traced, and a plan of it.
    job
        clock, progress and limits; MitsimError for work beyond them.
    """
    job, request = job or Job(), _request(plan)
    if plan.cost:
        plan.cost.check(request.patterns, job.limits)
    lighting = bench.family(request.patterns, request.seed).lighting
    with job.clock.stage("transport"):
        return trace_light(bench, plan, lighting, request.seed, progress=job.progress)


def expose(
    light: SampledLight, patterns: str, output: Path | str | None = None, job: Job | None = None, **request: Any
) -> Capture:
    """One noisy frame for each shot of a family in given light.

    Parameters
    ----------
    light
        that the family is shown in.
    patterns, output, job, request
        as for :meth:`mitsim.api.light.Light.expose`, which has the errors raised as well.
    """
    own = replace(light.plan, request=request_of(light.plan, {}).changed(patterns=patterns))
    return capture(light.bench, request_of(own, request), job, output, light=light)


def request_of(plan: Plan | str, changes: Mapping[str, Any]) -> Request:
    """The request of a ``plan`` or a family's name, with ``changes`` by field.

    MitsimError for a value that a field cannot have, or a change that would need another plan.
    """
    if isinstance(plan, str):
        if "patterns" in changes:
            raise ArgumentError("patterns", f"{cut(repr(changes['patterns']))}: beside the plan {plan!r}; give one")
        return Request.of(patterns=plan, **changes)
    request = _request(plan).changed(**changes)
    for name in ("patterns", "accuracy", "seconds", "effects"):
        if getattr(request, name) != getattr(_request(plan), name):
            raise ArgumentError(
                name, f"{changes[name]!r}: the plan was made for {getattr(plan.request, name)!r}; plan anew"
            )
    return request


def _request(plan: Plan) -> Request:
    if plan.request is None:
        raise ArgumentError("plan", "was decided without a request; make it by bench.plan")
    return plan.request


@single_threaded_blas()
def capture(
    bench: Apparatus,
    request: Request,
    job: Job | None = None,
    output: Path | str | None = None,
    resume: bool = False,
    plan: Plan | None = None,
    light: SampledLight | None = None,
) -> Capture:
    """Render and expose every shot of a pattern family; see :meth:`mitsim.api.bench.Bench.capture`.

    Nothing is written before all input has been checked.

    Parameters
    ----------
    bench, request, job, output, resume
        as there.
    plan
        made already.
    light
        traced already, by pixel or for this family.

    Raises
    ------
    MitsimError
        as there.
    """
    job = job or Job()
    spent = job.clock.seconds()
    starting = spent["total"] - spent.get("plan", 0.0)  # a plan that was made already has its own seconds
    request.timing.check(bench.sensor, bench.rig.camera_file)
    family = bench.family(request.patterns, request.seed)
    patterns = Patterns.of(family, [frame_name(index) for index in range(len(family.shots))])
    lighting = family.lighting
    on_disk = sum(path.stat().st_size for path in Path(output).glob(FRAMES)) if output and resume else 0
    place = Path(output) if output else None
    exposing = sum(frame_seconds(bench, len(family.shots)).values())
    first_look = frames_cost(bench, Settings(bench.geometry.scene_distance), lighting, exposing, on_disk)
    first_look.check(request.patterns, job.limits, place)
    head = RunHead.of(_configuration(bench, request))
    with _recorder(place, head, resume) as recorder:
        with job.planning(request.patterns):
            plan = light.plan if light else plan
            plan = (plan or _planned(bench, lighting, request, 1)).taking(start=starting)
        seconds = exposing if light else plan.predicted_seconds
        cost = frames_cost(bench, plan.settings, lighting, seconds, on_disk)
        cost.check(request.patterns, job.limits, place)
        with job.clock.stage("transport"):
            light = light or trace_light(bench, plan, lighting, request.seed, sampling_of(bench, request), job.progress)
        with job.clock.stage("truth"):
            truth = light.apparent
        with job.clock.stage("optics"):
            expected = light.frames(lighting, request.seed)
            # Forming the frames once finds the brightest pixel; a family with few classes keeps them for later.
            totals = Totals.of(expected)
        exposure_s = request.timing.choose(bench.rig, totals.peak)
        exposer = Exposer(bench.rig, exposure_s, request.seed, light.speckle(family))
        digital = digital_scale(bench, exposure_s)
        with job.clock.stage("write"):
            recorder.begin()
            recorder.write_truth(truth.reflectance, load_recipe().board_reflectance, truth.standard_error)
        with job.clock.stage("ambient frame"):
            ambient = _ambient(request, family, expected, exposer)
        if ambient:
            _record_ambient(recorder, ambient, exposer)
        shooting = Shooting(family, recorder, exposer, ambient, exposer.electrons(expected.projector_off))
        shooting.shoot(expected, job)
        total = light.plan.total(totals.noise)
        manifest = RunManifest(
            configuration=head.configuration,
            configuration_sha256=head.configuration_sha256,
            camera=bench.identity(),
            digital=digital,
            patterns=patterns,
            ambient_frame=shooting.ambient_file,
            plan=plan.block(),
            mc_error=totals.mc_error,
            total_error=total.value,
            total_error_bound=total.bound,
            total_error_of_projector=total.bound * shooting.dilution,
            mc_to_sensor_noise=shooting.noise_ratio,
            sensor_noise=shooting.sensor_noise,
            heaviest_group=totals.heaviest,
            truth_error=truth.error,
            light_error=truth.error_of(light.flux_error),
            paths=light.paths,
            lost_light=light.lost,
            seconds=job.clock.seconds(),
            predicted_memory_bytes=cost.memory_bytes,
            warnings=light.warnings + tuple(_warnings(light, totals, shooting, request)),
            versions=versions(),
        )
        foreign = _foreign(light, totals, request)
        if foreign and not manifest.warnings:  # within the accuracy: said, but no reason to flag the run
            warnings.warn(foreign, stacklevel=4)
        return Capture.recorded(recorder, manifest)


def check_run(bench: Apparatus, request: Request, output: Path | None, resume: bool) -> None:
    """Refuse, before any work, to go on with a run of another configuration; the rest is for :func:`capture`.

    Parameters
    ----------
    bench, request, output, resume
        as there.

    Raises
    ------
    MitsimError
        for another configuration, and an exposure that the camera cannot have.
    """
    request.timing.check(bench.sensor, bench.rig.camera_file)
    if output is not None and resume and (output / MANIFEST).is_file():
        check_same(output, RunHead.of(_configuration(bench, request)))


def _configuration(bench: Apparatus, request: Request) -> dict[str, Any]:
    """All that decides the frames."""
    return {**bench.provenance(), **bench.identity(), **request.deciding, "versions": deciding_versions()}


@contextmanager
def _recorder(output: Path | None, head: RunHead, resume: bool) -> Iterator[Recorder]:
    if output is None:
        yield RunMemory()
        return
    with claimed(output, head, resume) as folder:
        yield folder


def sampling_of(bench: Apparatus, request: Request) -> Sampling:
    """How light of a ``bench`` is sampled for one family's frames by a ``request``."""
    fraction = request.noise_fraction
    return Sampling(by_pixel=False, target=NoiseTarget(bench.rig, request.timing, fraction) if fraction else None)


def _ambient(
    request: Request, family: PatternFamily, expected: ExpectedFrames, exposer: Exposer
) -> AmbientFrame | None:
    if not is_taken(request.ambient_frame, family, expected):
        return None
    return AmbientFrame.exposed(exposer, expected, request.ambient_shots or shots_for(family))


def _record_ambient(recorder: Recorder, ambient: AmbientFrame, exposer: Exposer) -> None:
    single = {"DN": ambient.digital, "electrons": ambient.electrons}
    channels: dict[str, Channel] = {name: values.astype(np.float32) for name, values in single.items()}
    recorder.write(AMBIENT, channels, {"shots": ambient.shots, "exposure_s": exposer.exposure_s, "seed": exposer.seed})


def digital_scale(bench: Apparatus, exposure_s: float) -> DigitalScale:
    """How digital numbers of the ``bench``'s camera become electrons a second at an exposure of ``exposure_s``."""
    return digital_of(bench.sensor, exposure_s)


def _warnings(light: SampledLight, totals: Totals, shooting: Shooting, request: Request) -> Iterator[str]:
    accuracy, total = light.plan.accuracy, light.plan.total(totals.noise)
    foretold = set(light.plan.warnings) - set(known_losses(light.bench.loaded, request.effects))
    if not light.reached:
        yield from light.unreached
    elif total.bound > accuracy and not foretold and request.noise_fraction is None:
        reason = _foreign(light, totals, request)
        yield (
            f"the total error is up to {total.bound:.1e} (95 %); the accuracy {accuracy:g} was not reached"
            + (f": {reason}" if reason else "")
        )
    if totals.removed > accuracy:
        yield f"interpolation between anchors left {totals.removed:.1e} of a frame below zero; ask for more"
    if totals.heaviest > _FIREFLIES and totals.mc_error > _NEGLIGIBLE * accuracy:
        yield (
            f"one of {GROUPS} groups of the light brings {totals.heaviest:.1%} of the Monte Carlo variance: a few "
            "heavy paths (fireflies) make it, so mc_error may be far off; frames keep them unclipped, try another seed"
        )
    if shooting.ambient is not None and shooting.ambient.saturated:
        yield "saturation: the ambient frame has pixels at the full well or the ADC's end; expose for less"
    yield from camera_warnings(light.bench.sensor, shooting.always.shape)
    if shooting.always.any():
        yield from _of_ambient_light(shooting, accuracy, total.bound * shooting.dilution)
        yield from _of_unknown_light(light, shooting)
    if shooting.saturated:
        yield f"saturation: {shooting.saturated} frames have pixels at the full well or the ADC's end; expose for less"


def _foreign(light: SampledLight, totals: Totals, request: Request) -> str:
    """Why frames are noisier than the light was planned for, and what to do; empty where they are not."""
    traced = light.plan.request.patterns if light.plan.request else request.patterns
    if traced == request.patterns or totals.mc_error <= _NOISIER * light.sampling_error:
        return ""
    return (
        f"the light was traced for {traced}, whose frames it leaves {light.sampling_error:.1e} off, those of "
        f"{request.patterns} {totals.mc_error:.1e}, and their image as much noisier; trace it for {request.patterns}"
    )


def _of_unknown_light(light: SampledLight, shooting: Shooting) -> Iterator[str]:
    lamplight, accuracy = light.bench.lamplight, light.plan.accuracy
    if lamplight is not None and lamplight.unknown * shooting.ambient_part > accuracy:
        first, last = lamplight.range_nm
        one = len(lamplight.responses) == 1
        part = f"{lamplight.unknown:.1%} of the lamps' light"
        yield (
            f"{part if one else f'up to {part} behind filters of one colour'} is in no frame: what would be counted "
            f"beyond {first:g} to {last:g} nm if the quantum efficiency went on as its curve ends; let it end at 0, as "
            "a filter's does"
        )


def _of_ambient_light(shooting: Shooting, accuracy: float, of_projector: float) -> Iterator[str]:
    part = f"{shooting.ambient_part:.1%} of the frames' light is ambient"
    if of_projector > _DILUTED * accuracy:
        yield (
            f"{part}, and the accuracy {accuracy:g} is relative to all of it: relative to the projector's light alone "
            f"the error is up to {of_projector:.1e}; ask for a finer accuracy, or darken the room"
        )
    if shooting.ambient is None and not shooting.family.signed:
        yield f"{part} and is not taken off (ambient_frame is no): an image of them shows it, and is wrong"
    if shooting.noise_to_signal > _DROWNED:
        yield (
            f"{part}: noise is {shooting.noise_to_signal:.2g} times the projector's light in the frames, so little of "
            "an image will be left; darken the room, or expose longer on a sensor of a larger full well"
        )


# -------- Expected frames of a family in


@dataclass(frozen=True)
class Totals:
    """Over all expected frames: brightest pixel [W m^-2], relative Monte Carlo error, most light below zero.

    ``heaviest``: the largest part of the Monte Carlo variance that one group of the light brings; ``mc_bound``: what
    that error is below, at 95 %.
    """

    peak: float
    mc_error: float
    removed: float
    heaviest: float
    mc_bound: float

    @property
    def noise(self) -> Estimate:
        """The Monte Carlo error, and its bound."""
        return Estimate(self.mc_error, self.mc_bound)

    @classmethod
    def of(cls, expected: ExpectedFrames) -> Totals:
        """Those of all ``expected`` frames, which are formed for it."""
        peak = energy = variance = removed = heaviest = 0.0
        parts = np.zeros(GROUPS)
        for chunk in in_chunks((frame,) for frame in expected):
            for (frame,), (brightest, squares) in zip(chunk, in_threads(_seen, chunk), strict=True):
                removed = max(removed, frame.removed)
                peak = max(peak, brightest)
                energy += squares
                variance += frame.variance * frame.irradiance.size
                heaviest += frame.heaviest * frame.variance * frame.irradiance.size
                parts += np.asarray(frame.by_group or (0.0,)) * frame.irradiance.size
        mc_error = float(np.sqrt(variance / energy)) if energy else 0.0
        return cls(peak, mc_error, removed, heaviest / variance if variance else 0.0, bound_of(parts, energy))


def _seen(item: tuple[Frame]) -> tuple[float, float]:
    """Irradiance of the brightest pixel of a frame, and the sum of its squares."""
    (frame,) = item
    return float(frame.irradiance.max()), sum_of_squares(frame.irradiance)


@dataclass(frozen=True, eq=False)
class _Exposed:
    """One exposed shot: expected electrons, digital numbers, the two noises [electrons, rms], sums over its pixels.

    ``light``, ``energy`` and ``signal``: of the electrons, of their squares, and of the squares without ambient light.
    """

    index: int
    shot: Shot
    electrons: FloatArray
    digital: Digital
    rendering_noise: float
    sensor_noise: float
    saturated: bool
    light: float
    energy: float
    signal: float


class Shooting:
    """Turns expected frames into noisy ones and records them; frames that a resumed run has already are kept."""

    def __init__(
        self,
        family: PatternFamily,
        recorder: Recorder,
        exposer: Exposer,
        ambient: AmbientFrame | None,
        always: FloatArray,
    ) -> None:
        """Nothing is exposed yet.

        Parameters
        ----------
        family, recorder, exposer
            the shots, where they are kept, and the camera.
        ambient
            what is taken off the frames.
        always
            (m, m') expected electrons of ambient light, which is in every frame.
        """
        self.family, self.recorder, self.exposer = family, recorder, exposer
        self.ambient, self.always = ambient, always
        self._has_ambient = bool(always.any())
        self.saturated, self.noise_ratio = 0, 0.0
        self._noise_energy = self._energy = self._signal = self._light = 0.0

    @property
    def sensor_noise(self) -> float:
        """Relative noise of the sensor, ||noise|| / ||expected||, over all frames, from its closed form."""
        return math.sqrt(self._noise_energy / self._energy) if self._energy else 0.0

    @property
    def dilution(self) -> float:
        """Norm of the frames' light over that of the projector's: by so much lamps dilute an error relative to all."""
        return math.sqrt(self._energy / self._signal) if self._signal else 1.0

    @property
    def ambient_part(self) -> float:
        """Ambient light in all light of the frames."""
        return float(self.always.sum()) * len(self.family.shots) / self._light if self._light else 0.0

    @property
    def noise_to_signal(self) -> float:
        """Noise of the frames less the ambient frame, ||noise|| / ||light of the projector||, over all frames."""
        own = 0.0
        if self.ambient is not None and not self.family.signed:
            own = self.exposer.sensor_noise(self.always) ** 2 / self.ambient.shots
            own *= self.always.size * len(self.family.shots)
        return math.sqrt((self._noise_energy + own) / self._signal) if self._signal else math.inf

    @property
    def ambient_file(self) -> AmbientFile | None:
        """What the manifest says of the ambient frame."""
        if self.ambient is None:
            return None
        return AmbientFile(file=AMBIENT, shots=self.ambient.shots, part=self.ambient_part, noise=self.noise_to_signal)

    def shoot(self, expected: ExpectedFrames, job: Job) -> None:
        """Expose and record the ``expected`` frames in chunks, one thread a processor; the ``job`` times its stages.

        Files are written while the next chunk is formed and exposed: ``write`` is the time that work waits for them.
        """
        chunks = in_chunks(zip(range(len(expected)), self.family.shots, expected, strict=True))
        with Behind(self._record) as writing:
            while True:
                with job.clock.stage("optics"):
                    chunk = next(chunks, None)
                if chunk is None:
                    break
                with job.clock.stage("sensor"):
                    exposed = in_threads(self._expose, chunk)
                with job.clock.stage("write"):
                    writing.give(exposed)
                for shot in exposed:
                    self._count(shot)
                job.progress("frames", (chunk[-1][0] + 1) / len(expected))
            with job.clock.stage("write"):
                writing.wait()

    def _count(self, shot: _Exposed) -> None:
        """Add what a ``shot`` says to what all say."""
        if shot.rendering_noise:
            ratio = shot.rendering_noise / shot.sensor_noise if shot.sensor_noise else np.inf
            self.noise_ratio = max(self.noise_ratio, ratio)
        self.saturated += shot.saturated
        self._noise_energy += shot.sensor_noise**2 * shot.electrons.size
        self._energy += shot.energy
        self._signal += shot.signal
        self._light += shot.light

    def _expose(self, item: tuple[int, Shot, Frame]) -> _Exposed:
        index, shot, frame = item
        electrons = self.exposer.lit(frame, *shot.names)
        digital = self.exposer.digital(electrons, *shot.names)
        energy = sum_of_squares(electrons)
        return _Exposed(
            index=index,
            shot=shot,
            electrons=electrons,
            digital=digital,
            rendering_noise=self.exposer.rendering_noise(frame),
            sensor_noise=self.exposer.sensor_noise(electrons),
            saturated=self.exposer.saturated(digital, electrons),
            light=float(electrons.sum()),
            energy=energy,
            signal=sum_of_squares(electrons - self.always) if self._has_ambient else energy,
        )

    def _record(self, exposed: _Exposed) -> None:
        if self.recorder.keeps(exposed.index):
            return
        metadata: dict[str, str | int | float] = {
            "row": exposed.shot.row,
            "column": exposed.shot.column,
            "sign": exposed.shot.sign,
            "exposure_s": self.exposer.exposure_s,
            "rendering_noise_e": exposed.rendering_noise,
            "seed": self.exposer.seed,
        }
        electrons = exposed.electrons.astype(np.float32)
        # EXR has no 64-bit numbers: the real-valued output of a sensor without an ADC is kept in single precision.
        whole = exposed.digital.dtype == np.uint32
        dn: Channel = exposed.digital.astype(np.uint32, copy=False) if whole else exposed.digital.astype(np.float32)
        self.recorder.write_frame(exposed.index, {"DN": dn, "electrons": electrons}, metadata)
