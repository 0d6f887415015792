"""A bench by the spectral lines of its light: the plan of all lines together, and light of each.

Paths carry a wavelength for each line (:func:`mitsim.light.light.trace_lines`); from there on every line is a bench of
its own. A camera without colours records one run for each line; one behind colour filters reads all lines in one run.

With w_pl the electrons that a pixel of plane p of the 2 x 2 filters makes of a photon of line l, its expected electrons
are e_p = t A sum_l w_pl E_l lambda_l / (h c). They equal those of a pixel without filter, one electron per photon, in
an irradiance sum_l w_pl E_l lambda_l / lambda at the projector's effective wavelength lambda. Each colour of filters
counts lamps' light itself (:mod:`mitsim.devices.projector`): a count c is an irradiance c / lambda.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from mitsim.bench.apparatus import Apparatus, Opened, reopen
from mitsim.bench.effects import present
from mitsim.bench.layout import obstacles
from mitsim.bench.request import Request
from mitsim.core import colour_files
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.seeds import integer
from mitsim.devices.patterns import Lighting, PatternFamily
from mitsim.devices.projector import SPECTRA_NM, Band, CountedLamps, Lines, Response, Spectrum, line_units
from mitsim.light.cost_model import frame_seconds, frames_cost
from mitsim.light.light import SampledLight, Truth
from mitsim.light.passes import Simulation, expected_of
from mitsim.light.plan import Plan
from mitsim.light.settings import Settings
from mitsim.optics.frames import ExpectedFrames, Frame
from mitsim.planner.planner import make_plan, plan_within
from mitsim.reconstruct.colour import PLANES, behind
from mitsim.transport.from_camera import FromCameraTracer, LampTracer
from mitsim.transport.records import PathSamples

_RAYS, _ALIKE = 4, 0.9
"""Rays per pixel for a line's roughness, paths per cell for lamps, and the relative roughness that counts."""


@dataclass(frozen=True)
class SpectralBench:
    whole: Apparatus
    manifest: colour_files.ColourManifest | None = None

    @classmethod
    def of(cls, bench: Apparatus, kind: str) -> SpectralBench:
        """Return all lines of a ``bench`` for folders of a ``kind``.

        Raises MitsimError if light cannot be traced by line, and for :data:`MOSAIC` without filters that pass the
        lines.
        """
        if kind == colour_files.MOSAIC:
            bench = without_filters(bench)
        if not bench.variant.endswith("_spectral"):
            needed = colour_files.spectral_of(bench.variant)
            raise ArgumentError("variant", f"{bench.variant}: knows no wavelengths; open the bench with {needed}")
        lines = bench.projector.traced_lines
        named = tuple(
            colour_files.Line(name=f"{wavelength:g}nm", wavelength_nm=wavelength, radiant_share=share)
            for wavelength, share in zip(lines.wavelengths_nm, lines.shares, strict=True)
        )
        message: dict[str, Any] = {"kind": kind, "channels": named}
        if kind == colour_files.MOSAIC:
            message |= {"mosaic": bench.counting.mosaic, "weights": bench.counting.planes(lines.wavelengths_nm)}
        model = colour_files.MosaicManifest if kind == colour_files.MOSAIC else colour_files.ColourManifest
        return cls(replace(bench, lines=lines), model.model_validate(message))

    @cached_property
    def benches(self) -> tuple[Apparatus, ...]:
        if self.manifest is None or self.whole.lines is None:
            return (self.whole,)
        return tuple(line_alone(self.whole, line) for line in self.whole.lines.single)

    @property
    def names(self) -> tuple[str, ...]:
        return self.manifest.names if self.manifest else ()

    def check(self, request: Request) -> None:
        request.timing.check(self.whole.sensor, self.whole.devices.camera_file)
        if self.manifest is None:
            return
        if request.seconds is not None:
            raise ArgumentError("seconds", f"{request.seconds:g}: runs in colour need an accuracy in place of a time")
        projector = self.whole.projector
        add_speckle = request.effects.get("speckle", True) and (projector.speckle_contrast or projector.speckle)
        if self.whole.filters and add_speckle:  # each line has its own, and each filter another mixture of them
            raise ArgumentError(
                "effects",
                f"projector {projector.name} has speckle, which is not simulated behind colour filters; switch it "
                "off with -speckle",
            )

    def lit_by_lamps(self, effects: Mapping[str, bool], seed: int) -> SpectralBench:
        if self.manifest is None or self.whole.counted_lamps is not None:
            return self
        return replace(self, whole=lit_by_lamps(self.whole, effects, seed))

    def plan(self, request: Request) -> Plan:
        if self.manifest is None:
            return plan_request(self.whole, request)
        self.check(request)
        lighting = self.whole.family(request.patterns, request.seed).lighting
        roughest = self.lit_by_lamps(request.effects, request.seed).roughest(request.seed, lighting.lit)
        plan = plan_request(roughest, request, len(self.benches))
        if roughest.counted_lamps is not None and "ambient" not in plan.settings.effects:
            # Beside a weaker line lamps may count.
            switched = request.with_values(effects={**request.effects, "ambient": True})
            plan = replace(plan_request(roughest, switched, len(self.benches)), request=request)
        return replace(plan, made_of=self.whole.deciding)

    def roughest(self, seed: int, lit: float) -> Apparatus:
        """Return the line that is planned for: the one whose light differs most between neighbouring projector pixels.

        Discretisation errs most for such light. Of equal lines the longest is the worst because its fringes are the
        widest.
        """
        bench, count = self.whole, len(self.benches)
        simulation = Simulation(bench, Settings(bench.geometry.scene_distance, effects=frozenset({"ambient"})))
        stream = integer(seed, "colour")
        path_samples, lamps = simulation.direct.trace(stream, 0, _RAYS), PathSamples.none()
        if bench.counted_lamps is not None and simulation.from_camera is not None:
            lamps = simulation.from_camera.trace(stream, 0, _RAYS)
        steps = []
        for light, ambient in zip(path_samples.by_line(count), lamps.by_line(count), strict=True):
            flux = np.bincount(light.pixel, light.value, bench.n**2).reshape(bench.n, bench.n)
            differences = sum(float(np.square(np.diff(flux, axis=axis)).sum()) for axis in (0, 1))
            energy = float(np.square(flux).sum())
            own = lit * float(flux.sum())
            part = own / (own + float(ambient.value.sum())) if own else 0.0
            steps.append(differences / energy * part**2 if energy else 0.0)
        alike = [each for each, step in zip(self.benches, steps, strict=True) if step >= _ALIKE * max(steps)]
        return max(alike, key=lambda each: each.projector.effective_wavelength_nm)


def line_alone(bench: Apparatus, line: Lines) -> Apparatus:
    devices = replace(bench.devices, projector=bench.projector.at(line.wavelengths_nm[0]))
    return replace(bench, devices=devices, lines=line)


def plan_request(bench: Apparatus, request: Request, lines: int = 1) -> Plan:
    """Return the plan of a capture with its request and predicted cost, for ``lines`` that share the paths.

    Raises MitsimError if the request does not fit the bench, or no light of the projector reaches the camera.
    """
    family, effects = bench.family(request.patterns, request.seed), request.effects
    lighting = family.lighting
    exposing = frame_seconds(bench, lines * len(lighting.weights))
    if request.seconds is None:
        plan = make_plan(bench, lighting, request.accuracy, request.seed, effects, lines)
    else:
        plan = plan_within(bench, lighting, request.seconds, request.seed, effects)
    plan = plan.taking(**exposing)
    cost = frames_cost(bench, plan.settings, lighting, plan.predicted_seconds, lines=lines)
    warnings = (*plan.warnings, *obstacles(bench, family))
    return replace(plan, request=request, cost=cost, made_of=bench.deciding, warnings=warnings)


# -------- Choice between mono light and all lines
#
# A monochrome camera that sees all lines l of a projector at once makes electrons from their irradiances E_l in
# proportion to sum_l q_l lambda_l E_l, with its quantum efficiency q. Mono light has one panchromatic reflectance and
# the mean of the lines' shadows. Its error is the relative difference of frames of direct light, formed of the same few
# rays of a projector pixel, so that it contains no noise of the geometry.

_SHOTS = 4
_PART = 0.5
"""Part of the accuracy that mono light may use: the frames then keep 0.87 of it, at a third more paths."""
_NONE = 1e-6
"""Difference that counts as none in single precision (photograph: 3e-8)."""


class Coloured(NamedTuple):
    plan: Plan
    bench: Any
    mono: bool


def choose_colour(bench: Apparatus, request: Request) -> Coloured:
    if request.seconds is not None or bench.variant.endswith("_spectral"):
        raise ArgumentError("colour", "auto: give an accuracy in place of a time, and a mono or rgb variant")
    started, error, whole = time.perf_counter(), 0.0, None
    if bench.loaded.coloured or bench.sensor.quantum_efficiency_curve is not None:
        shots = len((family := bench.family(request.patterns, request.seed).lighting).weights)
        lighting = family.shots(np.unique(np.linspace(0, shots - 1, min(shots, _SHOTS)).astype(int)))
        waves = bench.geometry.diffracts and request.effects.get("diffraction", True)
        settings = Settings(bench.geometry.scene_distance, effects=frozenset({"diffraction"} if waves else ()))

        def electrons(of: Apparatus, lines: Sequence[Apparatus]) -> FloatArray:
            light, total = Simulation(of, settings).direct.trace(integer(request.seed, "colour"), 0, _RAYS), []
            for line, own in zip(lines, light.by_line(len(lines)), strict=True):
                simulation, nm = Simulation(line, settings), line.projector.effective_wavelength_nm
                accumulated = simulation.accumulate("direct", own, lighting.labels, _RAYS)
                rows = np.arange(lighting.weights.shape[1])
                frames = expected_of([(simulation, [accumulated])], rows, lighting, request.seed, leaking=False)
                total.append(np.stack([frame.irradiance for frame in frames]) * line.sensor.efficiency(nm) * nm)
            return np.asarray(sum(total))

        mono = electrons(bench, (bench,))  # before another variant is set
        whole = SpectralBench.of(reopen(bench, colour_files.spectral_of(bench.variant)), colour_files.RUN)
        seen = electrons(whole.whole, whole.benches)
        error = float(np.linalg.norm(mono - seen) / np.linalg.norm(seen)) if seen.any() else 0.0
        error = 0.0 if error < _NONE else float(f"{error:.1e}")
    is_mono = error <= _PART * request.accuracy
    if is_mono or whole is None:
        own: Apparatus = reopen(bench, bench.variant) if whole else bench
        left = request.with_values(accuracy=math.sqrt(request.accuracy**2 - error**2)) if error else request
        plan = plan_request(own, left)
    else:
        own, plan = whole.whole, whole.plan(request)
    looked = time.perf_counter() - started - plan.predicted["plan"]
    ways = [{"name": colour_files.MONO, "error": error}, {"name": colour_files.LINES, "error": 0.0}]
    choice = {"chosen": colour_files.MONO if is_mono else colour_files.LINES, "candidates": ways}
    note = f"colour: {choice['chosen']}, because grey light causes a relative error of {error:.1e} in direct light"
    plan = replace(plan.taking(plan=plan.predicted["plan"] + looked), request=request, colour=choice)
    return Coloured(replace(plan, notes=(*plan.notes, note)), own, is_mono)


# -------- All lines at once behind colour filters


def without_filters(bench: Opened) -> Opened:
    """Return a ``bench`` without its colour filters, which are kept beside.

    Raises MitsimError for a camera without filters or with an odd number of pixels.
    """
    sensor = bench.sensor
    if sensor.mosaic is None:
        raise MitsimError(
            f"camera {bench.devices.camera_file}: has no mosaic of colour filters, and colour mosaic was asked for; "
            "use a camera that has one, such as imx249_rggb, or colour lines"
        )
    (rows, columns), first = bench.geometry.frame_shape, (bench.geometry.roi or (0, 0))[:2]
    if rows % 2 or columns % 2 or any(at % 2 for at in first):
        raise MitsimError(
            f"camera {bench.devices.camera_file}: frames of {rows} x {columns} pixels from row {first[0]} and column "
            f"{first[1]} do not hold whole filters of 2 x 2; give the scene's film even numbers"
        )
    bare = sensor.model_copy(update={"mosaic": None, "mosaic_curves": None, "quantum_efficiency": 1.0})
    return replace(bench, devices=replace(bench.devices, sensor=bare), filters=sensor)


@dataclass(frozen=True, eq=False)
class MosaicLight(SampledLight):
    """Light of all lines together behind the filters.

    ``passed`` (lines, m, m') is the part of each line's irradiance that counts, at the effective wavelength.
    """

    by_line: tuple[SampledLight, ...] = ()
    passed: FloatArray | None = None

    @classmethod
    def of(cls, bench: Apparatus, lights: Sequence[SampledLight], wavelengths_nm: Sequence[float]) -> MosaicLight:
        weights = np.array(bench.counting.planes(wavelengths_nm))
        counted = weights * np.asarray(wavelengths_nm) / bench.projector.effective_wavelength_nm
        first, truths = lights[0], [light.apparent for light in lights]
        mean, shape = counted.mean(axis=0), truths[0].reflectance.shape
        board = mean[:, None] * np.stack([truth.board_flux for truth in truths])
        whole = board.sum(axis=0)
        shares = np.divide(board, whole, out=np.zeros_like(board), where=whole > 0).reshape(-1, *shape)
        seen, off = (
            (shares * np.stack([getattr(truth, name) for truth in truths])).sum(axis=0)
            for name in ("reflectance", "standard_error")
        )
        own = {
            "simulation": Simulation(bench, first.plan.settings),
            "flux": np.tensordot(mean, [light.flux for light in lights], axes=1),
            "flux_error": np.tensordot(mean, [light.flux_error for light in lights], axes=1),
            "sampling_error": max(light.sampling_error for light in lights),
            "reached": all(light.reached for light in lights),
            "looked": None,
            "known_truth": Truth(seen, off, whole, truths[0].rays),
            "by_line": tuple(lights),
            "passed": behind(counted, bench.geometry.frame_shape),
        }
        return cls(**{each.name: getattr(first, each.name) for each in fields(SampledLight)} | own)

    @property
    def lost(self) -> float:
        return max(light.lost for light in self.by_line)

    def frames(self, lighting: Lighting, seed: int, leaking: bool = True) -> ExpectedFrames:
        assert self.passed is not None, "made by of()"
        lines = [light.frames(lighting, seed, leaking).of_projector for light in self.by_line]
        apart = not self.by_line[0].simulation.from_camera_of_projector
        return MosaicFrames(lines, self.passed, self._lamps(seed), apart)

    def _lamps(self, seed: int) -> Frame | None:
        counted_lamps = self.bench.counted_lamps
        if counted_lamps is None:
            return None
        each = [counted_lamps.units_of(light.bench.projector.lines)[0] for light in self.by_line]
        unit, line = max((unit, line) for line, unit in enumerate(each))
        light = self.by_line[line]
        frames, counted = list[Frame](), np.zeros((len(PLANES), len(counted_lamps.responses)))
        for number, response in enumerate(counted_lamps.responses):
            frames += _lamps_alone(light, counted_lamps.rows(number), seed)
            # Accumulated is the mean over all pixels, of which the response's have it all.
            scale = response.part * unit * self.bench.projector.effective_wavelength_nm
            counted[list(response.planes), number] = 1 / scale
        shape = self.bench.geometry.frame_shape
        irradiance = np.einsum("fij,fij->ij", behind(counted, shape), np.stack([each.irradiance for each in frames]))
        # No pixel has two.
        parts = np.tensordot(np.square(counted).mean(axis=0), [each.by_group for each in frames], axes=1)
        variance = float(np.trace(parts))
        heaviest = float(parts.max()) / variance if variance else 0.0
        return Frame(irradiance, variance, max(each.removed for each in frames), heaviest, parts)

    def speckle(self, family: PatternFamily | None = None) -> float:
        return 0.0


def _lamps_alone(light: SampledLight, bands: slice, seed: int) -> ExpectedFrames:
    counted_lamps = light.bench.counted_lamps
    assert counted_lamps is not None, "asked before"
    accumulated = light.simulation.of_lamps(light.groups, light.groups[0].rows - len(counted_lamps.bands), bands)
    return ExpectedFrames(accumulated, Lighting(np.zeros(1, np.int64), np.ones((1, 1))), seed, restated=light.restated)


def excess_behind_filters(lights: Sequence[SampledLight]) -> float:
    light, counted_lamps = lights[0], lights[0].bench.counted_lamps
    if counted_lamps is None or counted_lamps.shares is None:
        return 1.0
    whole, _ = _lamps_alone(light, slice(None), light.seed).sampling_error()
    energy = variance = 0.0
    for number, response in enumerate(counted_lamps.responses):
        rows = counted_lamps.rows(number)
        error, _ = _lamps_alone(light, rows, light.seed).sampling_error()
        own = float(counted_lamps.shares[rows].sum()) ** 2 / response.part
        energy, variance = energy + own, variance + own * error**2
    return max(1.0, math.sqrt(variance / energy) / whole) if whole else 1.0


class MosaicFrames(ExpectedFrames):
    """Frames of every shot behind the filters.

    Lines share their paths, so that the error of the sum is at most the sum of the errors; ``independent`` lamps' light
    has no other light on its paths.
    """

    def __init__(
        self, lines: Sequence[ExpectedFrames], passed: FloatArray, lamps: Frame | None = None, independent: bool = False
    ) -> None:
        self._lines, self._passed, self._lamps, self._independent = tuple(lines), passed, lamps, independent
        self._spread = np.sqrt(np.square(passed).mean(axis=(1, 2)))

    def __len__(self) -> int:
        return len(self._lines[0])

    @property
    def has_ambient(self) -> bool:
        return self._lamps is not None

    @property
    def projector_off(self) -> Frame:
        if self._lamps is None:
            return self._lines[0].projector_off
        return replace(self._lamps, variance=0.0, by_group=np.zeros((1, 1)))

    def __iter__(self) -> Iterator[Frame]:
        always = () if self._lamps is None else (self._lamps,)
        for shot in zip(*self._lines, strict=True):
            light = np.einsum("lij,lij->ij", self._passed, np.stack([frame.irradiance for frame in shot]))
            if self._lamps is not None:
                light += self._lamps.irradiance
            products = np.array([frame.by_group for frame in (*shot, *always)])
            roots = np.sign(products) * np.sqrt(np.abs(products))
            own = np.tensordot(self._spread, roots[: len(self._lines)], axes=1)
            lamps = roots[len(self._lines) :].sum(axis=0)
            apart = np.asarray(own * np.abs(own) + lamps * np.abs(lamps))
            parts = apart if self._independent else np.asarray((own + lamps) * np.abs(own + lamps))
            variance, removed = float(np.trace(parts)), max(frame.removed for frame in (*shot, *always))
            heaviest = float(parts.max()) / variance if variance else 0.0
            yield Frame(light, variance, removed, heaviest, parts)


# -------- Lamps at wavelengths of their own, as the camera counts them

_STEP_NM = 24.0
"""Widest part of a band whose light diffracts like that of its middle."""
_CELLS, _SAMPLES = 32, 16
"""Cells per side and paths per cell: they find 5 % of the light to some percent."""
_END_NM = 10.0
"""Range at the end of spectra from which the light beyond is estimated."""


def lit_by_lamps(bench: Apparatus, effects: Mapping[str, bool], seed: int) -> Apparatus:
    """Return the bench with lamps at wavelengths of their own, or unchanged without lamps.

    Raises MitsimError for a camera whose efficiency is unknown in the lamps' spectra, or that is blind to the
    projector's lines.
    """
    if not bench.loaded.lamps or not effects.get("ambient", True):
        return bench
    responses = Response.of_each(bench.counting)
    found = frozenset(name for name in present(bench) if effects.get(name, True))
    settings = Settings(bench.geometry.scene_distance, effects=found)
    tracer = Simulation(bench, settings, pixels=min(bench.n, _CELLS)).from_camera
    assert isinstance(tracer, FromCameraTracer), "lamps are followed, not yet apart"
    stream, (begin, end) = integer(seed, "lamplight"), SPECTRA_NM
    light, spectra, unknown = list[FloatArray](), list[Spectrum](), 0.0
    for response in responses:

        def counted(*bands: Band, response: Response = response) -> FloatArray:
            seen = LampTracer(tracer, response, bands, (1.0,)).trace(stream, 0, _SAMPLES)
            lit = np.bincount(seen.pixel - tracer.projector.n**2, seen.value, colour_files.MOST_LINES)
            return np.asarray(lit / _SAMPLES)

        first, last = response.range_nm
        parts = math.ceil((last - first) / colour_files.MOST_LINES / _STEP_NM)
        cut = [response.bands(colour_files.MOST_LINES, part, parts) for part in range(parts)]
        of_parts = np.stack([counted(*bands) for bands in cut], axis=1)  # (bands, parts)
        beyond = counted((begin, first), (last, end), (end - _END_NM, end), (end, end))
        missing = float(beyond[0] + beyond[1] + beyond[2] / _END_NM * response.beyond_nm)
        if missing:
            unknown = max(unknown, missing / (missing + float(of_parts.sum())))
        for band, weights in enumerate(of_parts):
            middles = np.array([(bands[band][0] + bands[band][1]) / 2 for bands in cut])
            shining = weights > 0 if weights.any() else np.ones(parts, dtype=bool)
            some = weights[shining] if weights.any() else np.ones(parts)
            spectra.append(Spectrum(middles[shining], some / some.sum()))
        light.append(response.part * of_parts.sum(axis=1))
    shares, lines = np.concatenate(light), bench.projector.lines
    counted_lamps = CountedLamps(
        responses,
        tuple(band for response in responses for band in response.bands(colour_files.MOST_LINES)),
        tuple(spectra),
        shares / shares.sum() if shares.any() else np.full(len(shares), 1 / len(shares)),
        unknown,
        tuple(zip(lines.wavelengths_nm, line_units(bench.counting, lines), strict=True)),
    )
    return replace(bench, counted_lamps=counted_lamps)
