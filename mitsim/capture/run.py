"""A capture: from a bench and a request to one noisy frame for each shot, in memory or in a folder as they are made."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.capture.ambient import AmbientFrame, is_taken, shots_for
from mitsim.capture.bench import Bench
from mitsim.capture.cost import frame_seconds, frames_cost
from mitsim.capture.evidence import GROUPS, Settings
from mitsim.capture.exposer import Exposer, NoiseTarget, camera_warnings
from mitsim.capture.light import Light, Sampling, trace_light
from mitsim.capture.losses import known_losses
from mitsim.capture.plan import Plan
from mitsim.capture.planning import make_plan, plan_within
from mitsim.capture.request import Request
from mitsim.capture.shooting import Shooting, Totals
from mitsim.core.errors import ArgumentError, cut
from mitsim.core.framefile import Channel
from mitsim.core.job import Job
from mitsim.core.manifests import MANIFEST, Patterns, RunHead, RunManifest
from mitsim.core.manifests import Digital as DigitalScale
from mitsim.core.output import FRAMES
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.recorders import AMBIENT, Recorder, RunMemory, check_same, claimed, frame_name
from mitsim.core.runs import Capture
from mitsim.core.versions import deciding_versions, versions
from mitsim.optics.frames import ExpectedFrames
from mitsim.rig.digital import digital_of
from mitsim.rig.patterns import Lighting, PatternFamily
from mitsim.rig.recipe import load_recipe

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


def plan_request(bench: Bench, request: Request, lines: int = 1) -> Plan:
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


def _planned(bench: Bench, lighting: Lighting, request: Request, lines: int) -> Plan:
    """The plan of a capture, with what exposing and writing its frames takes."""
    exposing, effects = frame_seconds(bench, lines * len(lighting.weights)), request.effects
    if request.seconds is None:
        plan = make_plan(bench, lighting, request.accuracy, request.seed, effects, lines)
    else:
        plan = plan_within(bench, lighting, request.seconds, request.seed, effects)
    return plan.taking(**exposing)


def trace_request(bench: Bench, plan: Plan, job: Job | None = None) -> Light:
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
    bench: Bench,
    request: Request,
    job: Job | None = None,
    output: Path | str | None = None,
    resume: bool = False,
    plan: Plan | None = None,
    light: Light | None = None,
) -> Capture:
    """Render and expose every shot of a pattern family; see :meth:`mitsim.capture.bench.Bench.capture`.

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


def check_run(bench: Bench, request: Request, output: Path | None, resume: bool) -> None:
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


def _configuration(bench: Bench, request: Request) -> dict[str, Any]:
    """All that decides the frames."""
    return {**bench.provenance(), **bench.identity(), **request.deciding, "versions": deciding_versions()}


@contextmanager
def _recorder(output: Path | None, head: RunHead, resume: bool) -> Iterator[Recorder]:
    if output is None:
        yield RunMemory()
        return
    with claimed(output, head, resume) as folder:
        yield folder


def sampling_of(bench: Bench, request: Request) -> Sampling:
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


def digital_scale(bench: Bench, exposure_s: float) -> DigitalScale:
    """How digital numbers of the ``bench``'s camera become electrons a second at an exposure of ``exposure_s``."""
    return digital_of(bench.sensor, exposure_s)


def _warnings(light: Light, totals: Totals, shooting: Shooting, request: Request) -> Iterator[str]:
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


def _foreign(light: Light, totals: Totals, request: Request) -> str:
    """Why frames are noisier than the light was planned for, and what to do; empty where they are not."""
    traced = light.plan.request.patterns if light.plan.request else request.patterns
    if traced == request.patterns or totals.mc_error <= _NOISIER * light.sampling_error:
        return ""
    return (
        f"the light was traced for {traced}, whose frames it leaves {light.sampling_error:.1e} off, those of "
        f"{request.patterns} {totals.mc_error:.1e}, and their image as much noisier; trace it for {request.patterns}"
    )


def _of_unknown_light(light: Light, shooting: Shooting) -> Iterator[str]:
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
