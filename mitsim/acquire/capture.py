"""Frames of a scene: the capture of a pattern family, and one expected frame of its own light by either estimator.

:class:`mitsim.acquire.spectral.SpectralBench` determines which lines are traced, and which runs they are read in.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsim.acquire import exposure
from mitsim.acquire.spectral import MosaicLight, SpectralBench, excess_behind_filters
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import names, present
from mitsim.bench.layout import obstacles
from mitsim.bench.request import FEWEST_PASSES, REFERENCE, Request, Task, Working, check_samples
from mitsim.core import colour_files, manifests
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import Drawn, takes
from mitsim.core.environment import deciding_versions, keep_scenes, versions
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, cut
from mitsim.core.exr import Channel, write_frame
from mitsim.core.files import FRAMES, output_folder
from mitsim.core.images import card, normalise, span
from mitsim.core.job import Cost, Job
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import AMBIENT, Capture, LineTruth, MosaicCapture, Recorder, claim_run, frame_name
from mitsim.core.seeds import integer
from mitsim.devices.patterns import Lighting
from mitsim.devices.sensor import digital_of
from mitsim.devices.session import load_recipe
from mitsim.light.cost_model import first_shadow, frame_seconds, frames_cost
from mitsim.light.light import SampledLight, Sampling, Truth, trace_light, trace_lines, trace_truths, write_light
from mitsim.light.plan import Plan
from mitsim.light.settings import GROUPS, Settings
from mitsim.optics.frames import bound_of
from mitsim.planner.planner import known_losses, make_plan, unseen_lamps

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from mitsim.scene.load import LoadedScene

_FIREFLIES = 0.72
"""Part of the variance in one of four groups above which single paths dominate (heavy path 0.75, noise 0.3 to 0.5)."""
_DROWNED = 1.0
"""Ratio of noise to the projector's light at which ambient light exhausts the dynamic range (12 dB at 3)."""
_DILUTED = 10.0
"""Error relative to the projector's light, over the accuracy, from which a run is flagged."""
_NOISIER = 2.0
"""Ratio of the Monte Carlo error to that of the family that was traced above which a run says so (6 dB)."""
_AS_DENSE = 0.45
"""Ratio of lit pixels to those of the planned shots down to which the plan's bound holds (docs/decisions.md)."""
_NEGLIGIBLE = 0.1
"""Part of the accuracy below which the cause of the Monte Carlo error does not matter."""


# -------- Light, and frames of it


class Light(SampledLight):
    """Sampled light of one scene, ready to be exposed."""

    @takes(Working, Request, without="patterns resume")
    def expose(self, patterns: str = "dots:7", output: Path | str | None = None, **request: Any) -> Capture:
        """Expose one noisy frame for each shot of the family ``patterns``; ``output`` None keeps them in memory.

        Raises MitsimError for patterns that do not fit, an output that cannot be written, or a field that needs other
        light.
        """
        return expose(self, patterns, Task.taken(output, request), **Request(**request).given)

    @check_arguments
    def save(self, path: Path | str) -> Path:
        """Write the light to the HDF5 file ``path`` and return it; docs/exchange.md forms frames from it.

        Raises MitsimError for light that was traced by class, or if the file cannot be written.
        """
        write_light(Path(path), self)
        return Path(path)

    def _repr_html_(self) -> str:
        side = math.isqrt(len(self.flux))
        caption = f"light on the sensor by projector pixel\n{span(self.flux, 'W/m^2')}"
        error = f"{self.sampling_error:.1e}, accuracy {self.plan.accuracy:g}"
        rows = {"bench": self.bench, "paths": f"{self.paths:.3g}", "Monte Carlo error": error, "seed": self.seed}
        pictures = {caption: normalise(self.flux.reshape(side, side))}
        return card("Light by projector pixel", pictures, (*self.warnings, "Frames: light.expose('dots:7')"), rows)


def trace_request(bench: Apparatus, plan: Plan, job: Job | None = None, seed: int | None = None) -> Light:
    job, request = job or Job(), plan.known_request
    if plan.cost:
        plan.cost.check(request.patterns, job.limits)
    lighting = bench.family(request.patterns, request.seed).lighting
    with job.clock.stage("transport"):
        light = trace_light(bench, plan, lighting, request.seed if seed is None else seed, progress=job.progress)
    return Light(**{each.name: getattr(light, each.name) for each in fields(light)})


def expose(light: SampledLight, patterns: str, task: Task | None = None, **request: Any) -> Capture:
    own = replace(light.plan, request=light.plan.known_request.with_values(patterns=patterns, seed=light.seed))
    bench = SpectralBench(light.bench)
    return capture(bench, request_of(own, request), task, lights=[light]).runs[0]


def request_of(plan: Plan | str, changes: Mapping[str, Any]) -> Request:
    """Return the request of a ``plan`` or a family's name, with ``changes`` by field.

    Raises MitsimError for an invalid value, or a change that needs another plan.
    """
    if isinstance(plan, str):
        if "patterns" in changes:
            raise ArgumentError("patterns", f"{cut(repr(changes['patterns']))}: beside the plan {plan!r}; give one")
        return Request.of(patterns=plan, **changes)
    return plan.request_with(changes)


def check_plan(plan: Plan, bench: SpectralBench, request: Request) -> None:
    """Raise ArgumentError, with the difference, for a plan of another bench or request.

    Another seed, and other patterns that light the same classes of pixels alike, are accepted.
    """
    plan.check_made_of(bench.whole.deciding)
    planned = plan.known_request
    made, asked = (bench.whole.family(each.patterns, each.seed).lighting for each in (planned, request))
    if not (np.array_equal(made.labels, asked.labels) and np.array_equal(made.weights, asked.weights)):
        if planned.patterns == request.patterns:
            raise ArgumentError("seed", f"{request.seed}: draws other {request.patterns}; {plan.made_for('seed')}")
        raise ArgumentError("patterns", f"{request.patterns!r}: {plan.made_for('patterns')}")


@dataclass(frozen=True, eq=False)
class Captured:
    runs: tuple[Capture, ...]
    truths: tuple[Truth, ...]


@single_threaded_blas()
def capture(
    bench: SpectralBench,
    request: Request,
    task: Task | None = None,
    plan: Plan | str | None = None,
    lights: Sequence[SampledLight] = (),
) -> Captured:
    """Render and expose every shot of a pattern family; see :meth:`mitsim.api.bench.Bench.capture`.

    Nothing is written before all input has been checked. A family's name in place of a ``plan`` is planned for.
    """
    task, plan = task or Task(), None if isinstance(plan, str) else plan
    job, spent = task.job, task.job.clock.seconds()
    starting = spent["total"] - spent.get("plan", 0.0)
    bench.check(request)
    if plan is not None:
        check_plan(plan, bench, request)
    bench = bench.lit_by_lamps(request.effects, request.seed)
    lighting = bench.whole.family(request.patterns, request.seed).lighting
    lines, readings = len(bench.benches), (bench.whole,) if bench.whole.filters else bench.benches
    colours = None if bench.whole.filters else bench.manifest  # of a folder of each line's
    exposed = frame_seconds(bench.whole, len(readings) * len(lighting.weights))
    exposing = sum(exposed.values())
    with ExitStack() as places:
        names = bench.names if colours else ("",)
        folders = [task.output and task.output / name for name in names]
        kept = [path for place in folders if place and task.resume for path in place.glob(FRAMES)]
        on_disk = sum(path.stat().st_size for path in kept)

        def check(settings: Settings, seconds: float) -> None:
            cost = frames_cost(readings[0], settings, lighting, seconds, on_disk, lines)
            cost.check(request.patterns, job.limits, task.output)

        check(Settings(bench.whole.geometry.scene_distance), exposing)
        if colours:
            places.enter_context(colour_folder(task, colours))
        asked = {**request.deciding, "versions": deciding_versions()}
        if plan is not None and plan.known_request.seed != request.seed:
            asked["plan_seed"] = plan.known_request.seed  # frames hang on it, and a run is resumed by the same alone
        if lights and lights[0].plan.request is not None:
            asked["light"] = {"patterns": lights[0].plan.request.patterns, "seed": lights[0].seed}
        heads = [manifests.RunHead.of({**each.provenance(), **each.identity(), **asked}) for each in readings]
        recorders = [
            places.enter_context(claim_run(place, head, task.resume)) if place else Recorder(head=head)
            for place, head in zip(folders, heads, strict=True)
        ]
        least = first_shadow(bench.whole, request.effects)
        with job.planning(request.patterns, least):
            made = lights[0].plan if lights else plan or bench.plan(request)
        known = {"plan": spent.get("plan", 0.0)} if plan is not None else {}  # what this run took to have it
        plan = made.taking(start=starting, **known)
        check(plan.settings, exposing if lights else plan.predicted_seconds)
        if not lights:
            with job.clock.stage("transport"):
                sampling = Sampling(by_pixel=False, excess=excess_behind_filters if bench.whole.filters else None)
                lights = trace_lines(bench.whole, bench.benches, plan, lighting, request.seed, sampling, job.progress)
            with job.clock.stage("truth"):
                errors = np.stack([light.flux_error for light in lights])
                truths = trace_truths(bench.whole, plan.settings, request.seed, errors)
                lights = [replace(light, known_truth=truth) for light, truth in zip(lights, truths, strict=True)]
        seen = lights
        if bench.whole.filters is not None and bench.manifest is not None:
            seen = [MosaicLight.of(bench.whole, lights, bench.manifest.wavelengths_nm)]
        runs = [
            _run(each, light, plan, request, job, recorder)
            for each, light, recorder in zip(readings, seen, recorders, strict=True)
        ]
    return Captured(tuple(runs), tuple(light.apparent for light in lights))


def _run(bench: Apparatus, light: SampledLight, plan: Plan, request: Request, job: Job, recorder: Recorder) -> Capture:
    family = bench.family(request.patterns, request.seed)
    patterns = manifests.Patterns.of(family, [frame_name(index) for index in range(len(family.shots))])
    with job.clock.stage("truth"):
        truth = light.apparent
    with job.clock.stage("optics"):
        expected = light.frames(family.lighting, request.seed)
        # Forming the frames once finds the brightest pixel; a family with few classes keeps them for later.
        totals = exposure.Totals.of(expected)
    exposure_s = request.timing.choose(bench.devices, totals.peak)
    exposer = exposure.Exposer(bench.devices, exposure_s, request.seed, light.speckle(family))
    with job.clock.stage("write"):
        recorder.begin()
        recorder.write_truth(truth.reflectance, load_recipe().board_reflectance, truth.standard_error)
    ambient = None
    with job.clock.stage("ambient frame"):
        if exposure.takes_ambient_frame(request.ambient_frame, family, expected):
            ambient = exposure.AmbientFrame.expose(exposer, expected, exposure.ambient_shots(family))
    if ambient:
        single = {"DN": ambient.digital, "electrons": ambient.electrons}
        channels: dict[str, Channel] = {name: values.astype(np.float32) for name, values in single.items()}
        recorder.write(AMBIENT, channels, {"shots": ambient.shots, "exposure_s": exposure_s, "seed": request.seed})
    shooting = exposure.Shooting(family, recorder, exposer, ambient, exposer.electrons(expected.projector_off))
    shooting.shoot(expected, job)
    ambient_file = None
    if ambient:
        part, noise = shooting.ambient_part, shooting.noise_to_signal
        ambient_file = manifests.AmbientFile(file=AMBIENT, shots=ambient.shots, part=part, noise=noise)
    total = light.plan.total(totals.noise)
    manifest = manifests.RunManifest(
        configuration=recorder.head.configuration,
        configuration_sha256=recorder.head.configuration_sha256,
        camera=bench.identity(),
        digital=digital_of(bench.sensor, exposure_s),
        patterns=patterns,
        ambient_frame=ambient_file,
        plan=plan.block(),
        mc_error=totals.noise.value,
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
        kernels=job.clock.kernels(),
        predicted_memory_bytes=frames_cost(bench, plan.settings, family.lighting).memory_bytes,
        warnings=tuple(_warnings(light, totals, shooting, request)),
        versions=versions(),
        command=job.command,
        opened=bench.opened,
    )
    foreign = _foreign(light, totals, request)
    if foreign and not manifest.warnings:  # within the accuracy: said, but no reason to flag the run
        warnings.warn(foreign, stacklevel=5)
    return recorder.finish(manifest)


@contextmanager
def colour_folder(task: Task, manifest: colour_files.ColourManifest) -> Iterator[Path | None]:
    """Claim the folder of the lines' folders; write colour.json when all of them are finished."""
    if task.output is None:
        yield None
        return
    again = task.resume and any((task.output / name).is_dir() for name in manifest.names)
    with output_folder(task.output, overwrite=again) as folder:
        yield folder
        colour_files.write_colours(folder, manifest)


def capture_lines(bench: Apparatus, request: Request, task: Task, plan: Plan | str) -> dict[str, Capture]:
    lines = SpectralBench.of(bench, colour_files.RUN)
    return dict(zip(lines.names, capture(lines, request, task, plan).runs, strict=True))


def capture_mosaic(bench: Apparatus, request: Request, task: Task, plan: Plan | str) -> MosaicCapture:
    lines = SpectralBench.of(bench, colour_files.MOSAIC)
    assert isinstance(lines.manifest, colour_files.MosaicManifest)
    captured, board = capture(lines, request, task, plan), load_recipe().board_reflectance
    each = [LineTruth(truth.reflectance, truth.standard_error, board) for truth in captured.truths]
    found = MosaicCapture(captured.runs[0], lines.manifest, dict(zip(lines.names, each, strict=True)))
    if found.shots.folder is not None:
        found.write_lines(found.shots.folder)
    return found


# -------- Why a run is flagged


def _warnings(
    light: SampledLight, totals: exposure.Totals, shooting: exposure.Shooting, request: Request
) -> Iterator[str]:
    accuracy, total = light.plan.accuracy, light.plan.total(totals.noise)
    # The light may have been planned for other patterns, which do not give the same numbers.
    own, patterns = obstacles(light.bench, shooting.family), light.plan.known_request.patterns
    same = patterns == shooting.family.name
    planned = own if same else obstacles(light.bench, light.bench.family(patterns, light.seed))
    yield from own
    yield from (text for text in light.warnings if text not in planned)
    predicted_warnings = {*light.plan.warnings} - {*known_losses(light.bench.loaded, request.effects), *planned}
    if not light.reached:
        yield from light.unreached
    elif total.bound > accuracy and not predicted_warnings:
        reason = _foreign(light, totals, request)
        yield (
            f"the total error is up to {total.bound:.3g} (95 %); the accuracy {accuracy:g} was not reached"
            + (f": {reason}" if reason else "")
        )
    if totals.removed > accuracy:
        yield f"interpolation between anchors left {totals.removed:.1e} of a frame below zero; ask for a finer accuracy"
    if totals.heaviest > _FIREFLIES and totals.noise.value > _NEGLIGIBLE * accuracy:
        yield (
            f"one of {GROUPS} groups of the light causes {totals.heaviest:.1%} of the Monte Carlo variance: few very "
            "bright paths (fireflies) make mc_error unreliable; frames contain them unclipped; try another seed"
        )
    if shooting.ambient is not None and shooting.ambient.saturated:
        yield "saturation: the ambient frame has pixels at the full well or the ADC's end; use a shorter exposure"
    yield from exposure.camera_warnings(light.bench.sensor, shooting.always.shape)
    if shooting.saturated:
        yield (f"saturation: {shooting.saturated} frames reach the full well or the ADC's end; use a shorter exposure")
    if not shooting.always.any():
        return

    # ---- Ambient light
    part, of_projector = f"{shooting.ambient_part:.1%} of the frames' light is ambient", total.bound * shooting.dilution
    if of_projector > _DILUTED * accuracy:
        yield (
            f"{part}, and the accuracy {accuracy:g} is relative to all light; relative to the projector's light alone, "
            f"the error is up to {of_projector:.1e}; ask for a finer accuracy, or darken the room"
        )
    if shooting.ambient is None and not shooting.family.signed:
        yield (f"{part} and is not subtracted (ambient_frame is no), so images are wrong; set ambient_frame to auto")
    if shooting.noise_to_signal > _DROWNED:
        yield (
            f"{part}: noise is {shooting.noise_to_signal:.2g} times the projector's light in the frames, so little of "
            "an image will be left; darken the room, or expose longer on a sensor of a larger full well"
        )
    counted_lamps = light.bench.counted_lamps
    if counted_lamps is not None and counted_lamps.unknown * shooting.ambient_part > accuracy:
        first, last = counted_lamps.range_nm
        yield (
            f"up to {counted_lamps.unknown:.1%} of the lamps' light is missing in the frames, because the quantum "
            f"efficiency is not known beyond {first:g} to {last:g} nm; extend its curve until it is 0, for example "
            "with a filter's"
        )


def _foreign(light: SampledLight, totals: exposure.Totals, request: Request) -> str:
    """Return why frames of other patterns than the light was traced for may be worse than stated; empty if not."""
    traced = light.plan.request.patterns if light.plan.request else request.patterns
    if traced == request.patterns:
        return ""
    if totals.noise.value > _NOISIER * light.sampling_error:
        return (
            f"the light was traced for {traced}, whose frames have an error of {light.sampling_error:.1e}; frames of "
            f"{request.patterns} have {totals.noise.value:.1e}, and their image is noisier; trace the light for "
            f"{request.patterns}"
        )
    own = light.bench.family(request.patterns, request.seed).lighting.lit
    planned = light.bench.family(traced, light.seed).lighting.lit
    if own >= _AS_DENSE * planned:
        return ""
    return (
        f"its shots light {own:.2g} of the pixels, but the light was planned for {traced}, whose shots light "
        f"{planned:.2g}; effects that the plan left out may cause a larger error, which is not known; trace the light "
        f"for {request.patterns}"
    )


# -------- One frame of a scene under its own light, by either estimator, with its error

_SAMPLERS = ("IndependentSampler", "OrthogonalSampler")
"""Samplers without correlated dimensions; others of Mitsuba 3.9.1 correlate pairs by 0.15 to 0.8."""
_SAMPLES = 64
"""Default samples per pixel, as in the shipped scenes."""
_UNKNOWN = 1.0
"""Relative noise above which a frame counts as unknown."""
_SAMPLES_A_PASS = 64
"""Samples per pixel of one pass: 2^24 paths of a 512 x 512 sensor fit in memory."""


@dataclass(frozen=True, eq=False)
class Rendered:
    """One frame of irradiance [W m^-2].

    Attributes
    ----------
    mean, error
        (m, m', channels) irradiance and its standard error.
    facts
        estimator, spp (None for factored), seconds, variant, seed, notes (changes of objects, and neglected effects),
        and mc_error_bound (95 % bound of the factored estimator's relative Monte Carlo error).
    warnings
        Reasons why the frame is flagged.
    """

    mean: FloatArray
    error: FloatArray
    facts: Mapping[str, Any]
    warnings: tuple[str, ...] = ()

    @property
    def mc_error(self) -> float:
        """Return ||standard error|| / ||frame||, where the energy of the noise is subtracted from the frame's."""
        noise = float(np.square(self.error).sum())
        energy = float(np.square(self.mean).sum()) - noise
        return math.sqrt(noise / energy) if energy > 0 else math.inf

    def summary(self) -> dict[str, Any]:
        return {**self.facts, "mean": float(self.mean.mean()), "mc_error": self.mc_error, "warnings": self.warnings}

    @check_arguments
    def save(self, path: Path | str) -> Path:
        """Write the frame and its error to the OpenEXR file ``path`` and return it; raise MitsimError if that fails."""
        names = ("Y",) if self.mean.shape[2] == 1 else ("R", "G", "B")
        channels = {name: self.mean[..., i].astype(np.float32) for i, name in enumerate(names)}
        channels |= {f"error.{name}": self.error[..., i].astype(np.float32) for i, name in enumerate(names)}
        facts = {key: self.facts[key] for key in ("estimator", "seed", "variant")}
        write_frame(path, channels, {"unit": "W/m^2", **facts, **versions()})
        return Path(path)

    @takes(Drawn)
    def plot(self, ax: Axes | None = None, **figure: Any) -> Axes:
        """Draw the mean of the channels with a colour bar on ``ax`` or a new figure, and return the axes."""
        from mitsim.core.images import from_above

        channels = f", mean of {self.mean.shape[2]} channels" if self.mean.shape[2] > 1 else ""
        title = f"{self.facts['estimator']} estimator{channels}"
        return from_above("report.plots", "draw_frame")(self.mean.mean(2), title, "irradiance [W/m$^2$]", ax, **figure)

    def __repr__(self) -> str:
        rows, columns = self.mean.shape[:2]
        return f"Rendered({rows} x {columns}: {self.facts['estimator']}, relative noise {self.mc_error:.1e})"


def reference(loaded: LoadedScene, spp: int, seed: int, job: Job | None = None) -> tuple[FloatArray, FloatArray]:
    """Return (m, m', channels) irradiance [W m^-2] and its standard error, by the scene's own integrator.

    Passes of Owen-scrambled Sobol points are scrambled anew, and their spread gives the error; ``spp`` is at least 4.
    MitsimError is raised for an unsuitable number of samples, an integrator that cannot render this sensor or loses
    light, or work beyond the limits.
    """
    import mitsuba as mi

    from mitsim.scene.outline import one_line

    if loaded.unfit.reference is not None:
        raise loaded.unfit.reference
    if loaded.parting and mi.is_spectral:
        rule = f"{mi.variant()} carries several wavelengths on a path, which this glass parts; use a mono variant"
        raise loaded.parting[0].refusal("type", "'mitsim_glass'", rule)
    check_samples(REFERENCE, spp)
    job = job or Job()
    passes = max(FEWEST_PASSES, math.ceil(spp / _SAMPLES_A_PASS))
    each = math.ceil(spp / passes)
    total: FloatArray | float = 0.0
    squares: FloatArray | float = 0.0
    started = time.perf_counter()
    job.progress("reference", 0.0)
    for index in range(passes):
        child = integer(seed, "reference", index)
        loaded.camera.stratify((integer(seed, "reference points", index), each))
        try:
            with keep_scenes():
                image = np.array(mi.render(loaded.scene, sensor=loaded.camera, spp=each, seed=child), dtype=np.float64)
        except RuntimeError as error:
            cause: BaseException = error
            while cause.__cause__ is not None:  # what Dr.Jit raises says only that something below it failed
                cause = cause.__cause__
            raise MitsimError(
                f"{loaded.path}: Mitsuba cannot render this scene in {mi.variant()}: {one_line(cause)}; change the "
                "part that it names, or try another --variant"
            ) from None
        finally:
            loaded.camera.stratify(None)
        total, squares = total + image, squares + image**2
        job.progress("reference", (index + 1) / passes)
        if index == 0:
            Cost(seconds=(time.perf_counter() - started) * passes).check(f"{spp} samples a pixel", job.limits)
    mean = np.asarray(total) / passes
    variance = np.maximum(np.asarray(squares) / passes - mean**2, 0) / (passes - 1)
    return mean.reshape(*mean.shape[:2], -1), np.sqrt(variance).reshape(*mean.shape[:2], -1)


@contextmanager
def show_pattern(bench: Apparatus, pattern: FloatArray) -> Iterator[None]:
    """Show a ``pattern`` (n, n) of 0..1 on the projector within the context."""
    import mitsuba as mi

    parameters = mi.traverse(bench.loaded.projector)
    white = np.array(parameters["irradiance.data"])
    grid = bench.loaded.pixels
    texels = np.zeros_like(white)
    rows = slice(grid.first_row, grid.first_row + grid.n)
    columns = slice(grid.first_column, grid.first_column + grid.n)
    texels[rows, columns] = white[rows, columns] * pattern.reshape(grid.n, grid.n, *([1] * (white.ndim - 2)))
    try:
        parameters["irradiance.data"] = mi.TensorXf(texels)
        parameters.update()
        yield
    finally:
        parameters["irradiance.data"] = mi.TensorXf(white)
        parameters.update()


def render(bench: Apparatus, estimator: str, spp: int | None, asked: Request, job: Job) -> Rendered:
    check_samples(estimator, spp)
    if spp is None:
        spp = bench.loaded.samples or _SAMPLES
        try:
            check_samples(estimator, spp)
        except MitsimError as wrong:
            raise MitsimError(f"{bench.loaded.path}: sample_count of its sampler, taken for {wrong}") from None
    warnings, notes, bound = tuple[str, ...](), tuple[str, ...](), None
    started = time.perf_counter()
    if estimator == REFERENCE:
        if bench.loaded.projector is not None:
            absent = names(lambda effect: effect.in_frames and not effect.in_reference) - {"black-level"}
            left_out = ", ".join(name for name in present(bench) if name in absent)
            notes += (f"the reference leaves out {left_out}; --estimator factored does not",) if left_out else ()
        mean, error = reference(bench.loaded, spp, asked.seed, job)
        warnings = (bench.loaded.unfit.caustics,) if bench.loaded.unfit.caustics else ()
        sampler = bench.loaded.camera.sampler().class_name()
        if sampler not in _SAMPLERS:
            warnings += (
                f"{bench.loaded.path}: the points of sampler {sampler} depend on each other (at 4 paths by 15 to 80 "
                '%), so light over several turns may come out wrong; use <sampler type="independent"/>, the first turn '
                "is stratified anyway",
            )
        if bench.loaded.in_view:
            warnings += (
                f"{bench.loaded.path}: the projector shines on the sensor itself, and the reference has no light of it "
                "but over surfaces, so that is missing; keep it out of the view, or use --estimator factored",
            )
        warnings += tuple(unseen_lamps(bench.loaded, spp * mean.shape[0] * mean.shape[1], "the reference"))
    else:
        uniform = Lighting.uniform(bench.n)
        with job.planning(str(bench.loaded.path), first_shadow(bench, asked.effects)):
            plan = make_plan(bench, uniform, asked.accuracy, asked.seed, asked.effects)
        frames_cost(bench, plan.settings, uniform, plan.predicted_seconds).check(str(bench.loaded.path), job.limits)
        with job.clock.stage("transport"):
            light = trace_light(bench, plan, uniform, asked.seed, Sampling(by_pixel=False), job.progress)
        warnings = (*light.warnings, *light.unreached)
        frame = next(iter(light.frames(uniform, asked.seed)))
        bound = bound_of(frame.by_group * frame.irradiance.size, float(np.square(frame.irradiance).sum()))
        mean = frame.irradiance[..., None]
        error = np.full_like(mean, math.sqrt(frame.variance))
    if not mean.any():
        warnings += ("the frame is wholly dark; check the scene's light, the mask and the field stop",)
    facts = {
        "estimator": estimator,
        "spp": spp if estimator == REFERENCE else None,
        "seconds": time.perf_counter() - started,
        "variant": bench.variant,
        "seed": asked.seed,
        "notes": notes,
        "mc_error_bound": bound,
    }
    rendered = Rendered(mean, error, facts, warnings)
    if mean.any() and not rendered.mc_error < _UNKNOWN:
        rule = "too few paths met light to estimate the irradiance; give more samples (--spp), or more light"
        return replace(rendered, warnings=(*warnings, f"relative noise {rendered.mc_error:.1e}: {rule}"))
    return rendered


def rendered_psf(shape: tuple[int, int], pitch_mm: float, rays: int = 4096, seed: int = 0) -> FloatArray:
    """Return the light of a distant point behind the default diffuser, with a sum of 1."""
    from mitsim.transport.plugins.lens import Diffuser, point_spread

    light = point_spread(Diffuser(), shape, pitch_mm, rays=rays, seed=seed)
    return np.asarray(light / light.sum())
