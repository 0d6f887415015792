"""Rendered Hadamard calibration session on a white board (the paper, section IV-A), and its responses.

Every column h_i of a Hadamard matrix is shown as stripes h_i 1^T and 1 h_i^T, each +-1 pattern as two shots (or one and
a shared uniform one). If n is no Hadamard order, the first n rows of the next one are used, because rows stay
orthogonal. Written frames contain only the data of a real session: digital numbers, patterns and camera settings.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mitsim.acquire.exposure import Exposer, camera_warnings, levels, used_in_chunks
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.layout import MOST_LOST, before_board, mask_fault, missed_pixels
from mitsim.bench.request import Exposure
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.images import write_numbers
from mitsim.core.job import Cost, Job
from mitsim.core.manifests import CalibrationManifest, Digital
from mitsim.devices.camera import CameraGeometry, side_of
from mitsim.devices.framelist import StripeFile
from mitsim.devices.patterns import Lighting, PatternFamily, stripe_signs
from mitsim.devices.projector import Spectrum
from mitsim.devices.session import SIDES, UNIFORM, BoardShape, Half, SessionRecipe, halves_in_order
from mitsim.light import cost_model
from mitsim.light.light import SampledLight, Sampling, trace_lines
from mitsim.light.passes import Simulation
from mitsim.light.plan import Plan
from mitsim.light.settings import Forming, Settings
from mitsim.optics.fft_shadow import raster
from mitsim.optics.frames import Frame, at_once, mix_frames, mixes
from mitsim.optics.image_formation import number_of_terms
from mitsim.optics.shadow import Directions, SeparableTerms
from mitsim.optics.terms import best_term, centre_terms, shadow_terms
from mitsim.planner.planner import make_plan
from mitsim.reconstruct.factors import SEPARABLE_RESIDUAL, decibels
from mitsim.sensor import chain

_IN_RAYS = 0.5
"""Part (rms) of the geometric residual below which the residual is attributed to diffraction."""
_PLACES = 128
"""Sensor pixels per axis on which the mask is compared, because all pixels would take gigabytes."""
_MOST_TIFF = 2**16 - 1
_LINES = 4
"""Rows and columns of pixels that the plan examines, such that each quarter of the window is represented."""


@dataclass(frozen=True)
class Session:
    """Calibration session of a ``bench`` by a ``recipe`` at one depth.

    Attributes
    ----------
    depth
        Depth of the board [mm]; None for the aligned plane.
    filters
        (pixels, pixels) transmission of colour filters, by which readings are divided; None without filters.
    whole
        Session of all lines, whose light includes this session's; None for itself.
    """

    bench: Apparatus
    recipe: SessionRecipe
    seed: int = 0
    depth: float | None = None
    filters: FloatArray | None = None
    whole: Session | None = None

    @property
    def distance(self) -> float:
        return self.depth or self.bench.geometry.scene_distance

    @cached_property
    def board(self) -> Apparatus:
        if self.whole is not None:
            return replace(self.bench, loaded=self.whole.board.loaded)
        return before_board(self.bench, self.recipe.board_reflectance, self.recipe.board, self.depth)

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        shape, found = self.recipe.board, list[str]()
        if missed := 0 if shape == BoardShape() else missed_pixels(self.board):
            z = self.distance
            rows, columns = (z * (last - first) for first, last in self.bench.windows_at(z))
            found.append(
                f"board: {missed} of {self.bench.n**2} projector pixels do not fall whole on it ({shape.words}), and "
                f"their light is missing in the factors; the window is {rows:.4g} x {columns:.4g} mm there: "
                "take a larger board, or hang it straight"
            )
        return (*found, *self.mask_warnings, *camera_warnings(self.bench.sensor, self.bench.geometry.frame_shape))

    def check_mask(self, job: Job | None = None) -> None:
        """Raise MitsimError for a mask without factors, and if the session exceeds the limits of a ``job``."""
        job, fault = job or Job(), mask_fault(self.bench)
        self._first_cost.check("calibration", job.limits)
        if fault and fault.lost > MOST_LOST:
            raise MitsimError(f"{fault.reason}; {fault.remedy}")
        with job.clock.stage("mask"):
            _ = self.mask_warnings

    @property
    def _first_cost(self) -> Cost:
        count, first = self.signs.shape[1], Settings(self.distance)
        seconds = session_seconds(self.board, count, self.shots, first)
        return session_cost(self.board, count, first, sum(seconds.values()))

    @cached_property
    def mask_warnings(self) -> tuple[str, ...]:
        """Return a warning if the best separable camera leaves more of the shadow than a calibration accepts.

        It states the residual and its part from diffraction. Stripes show less of it because their lines add up.
        """
        geometry, fault = self.bench.geometry, mask_fault(self.bench)
        residual = rays = fault.lost if fault else 0.0
        if not geometry.is_drawn(waves=False):
            residual = rays = best_term(self.shadow(geometry, None, _PLACES)).residual
            if geometry.few_wave_terms:
                residual = best_term(self.shadow(geometry, self.bench.spectrum, _PLACES)).residual
        if residual <= SEPARABLE_RESIDUAL:
            return ()
        cause = ""
        remedy = fault.remedy if fault else "mount the mask straight"
        if rays < _IN_RAYS * residual:
            cause = f" by diffraction ({rays:.1%} without)"
            remedy = 'use kind = "separable", or larger features (feature_mm), in its table [mask]'
        return (
            f"the mask ({geometry.mask_words}) is not separable{cause}: the best separable one leaves {residual:.1%} "
            f"of its shadow, {-decibels(residual):.1f} dB below it, and images of these factors lack it; {remedy}",
        )

    def shadow(
        self, geometry: CameraGeometry, spectrum: Spectrum | None = None, places: int | None = None
    ) -> SeparableTerms:
        """Return the transmissions from projector pixels at the board's distance to sensor pixels.

        ``spectrum`` None uses rays; about ``places`` sensor pixels per axis are used, or all for None.
        """
        rows, columns = (
            Directions.cells(np.linspace(*edges, self.bench.n + 1)) for edges in self.bench.windows_at(self.distance)
        )
        down, across = (tuple(range(0, size, max(size // (places or size), 1))) for size in geometry.frame_shape)
        terms = shadow_terms(geometry, rows, columns, self.distance, spectrum, (down, across))
        return centre_terms(terms) if geometry.centred else terms

    @cached_property
    def signs(self) -> FloatArray:
        """Return the first n rows of the smallest sufficient Hadamard matrix, (n, N); column 0 is all +1."""
        return stripe_signs(self.bench.n).astype(np.float64)

    @property
    def pairs(self) -> bool:
        return self.recipe.signed_capture == "pair"

    def through_filters(self, light: FloatArray) -> FloatArray:
        return light if self.filters is None else light * self.filters

    @property
    def shots(self) -> int:
        return len(self.order) * self.recipe.repeats

    @property
    def order(self) -> list[Half]:
        """Return the order of the frames; the repeats of each follow one another."""
        return halves_in_order(self.signs.shape[1], self.pairs, self.recipe.order, self.recipe.order_seed)

    @property
    def as_tiff(self) -> bool:
        """Return True if frames are written as 16-bit TIFF, and False for NPY, which holds larger and real numbers."""
        largest = self.bench.sensor.largest_dn
        return largest is not None and largest <= _MOST_TIFF

    @cached_property
    def files(self) -> dict[tuple[str, int, int], StripeFile]:
        """Return the file of each shot and repeat, numbered in the order in which they are taken."""
        found, ending = dict[tuple[str, int, int], StripeFile](), "tif" if self.as_tiff else "npy"
        for (side, index, sign), repeat in product(self.order, range(self.recipe.repeats)):
            file = f"frame_{len(found):05d}.{ending}"
            listed = StripeFile(file=file, side=side, index=index, sign=sign, repeat=repeat)
            found[(*self.shot((side, index, sign)), repeat)] = listed
        return found

    @cached_property
    def powers(self) -> Mapping[tuple[str, int], FloatArray]:
        drift, order = self.recipe.drift, self.order
        each = len(order), self.recipe.repeats
        found = levels(self.seed, "session", math.prod(each), drift.session_ramp, drift.session_flicker).reshape(each)
        return {self.shot(half): power for half, power in zip(order, found, strict=True)}

    def shot(self, half: Half) -> tuple[str, int]:
        side, number, sign = half
        return side, 2 * number + (sign < 0) if self.pairs else number + (sign != UNIFORM)

    def plan(self, accuracy: float, job: Job) -> Plan:
        n, count, spent = self.bench.n, self.signs.shape[1], job.clock.seconds()
        self._first_cost.check("calibration", job.limits)
        with job.planning("calibration", cost_model.first_shadow(self.board, {})):
            plan, started = make_plan(self.board, _lines(n), accuracy, self.seed), time.perf_counter()
            geometry, waves, terms = self.board.geometry, cost_model.in_waves(plan.settings.effects), 1.0
            if geometry.is_drawn(waves):
                # Drawn here in the cells that were chosen, a shadow is the session's own.
                geometry = geometry.model_copy(update={"mask_cells": plan.settings.raster_cells})
                terms = number_of_terms(raster(geometry, self.distance, self.board.waves if waves else None))
            planning = plan.predicted["plan"] + time.perf_counter() - started
        seconds = session_seconds(self.board, count, self.shots, plan.settings, terms)
        if told := spent.get("mask", 0.0):
            seconds["mask"] = told
        # There is no truth to be traced, and other frames are formed than those that the plan looks at.
        plan = plan.taking(start=spent["total"] - told, plan=planning, truth=0.0, **seconds)
        cost = session_cost(self.board, count, plan.settings, plan.predicted_seconds)
        cost.check("calibration", job.limits)
        return replace(plan, cost=cost)

    def trace(self, plan: Plan, job: Job, boards: Sequence[Apparatus] = ()) -> list[SampledLight]:
        """Return the light of the board, or of the ``boards`` of all lines, which share the paths."""
        with job.clock.stage("transport"):
            sampling, lighting = Sampling(purpose="calibration"), _lines(self.bench.n)
            every = boards or (self.board,)
            lights = trace_lines(self.board, every, plan, lighting, self.seed, sampling, job.progress)
        return [light.merge() for light in lights]


def manifest_of(
    bench: Apparatus, digital: Digital, board_reflectance: float | None, depth: float, **more: Any
) -> CalibrationManifest:
    """Return the manifest of a calibration of a ``bench`` before a board at a ``depth`` [mm]."""
    more |= {"camera": bench.identity(), "centre": bench.geometry.centred, "board_reflectance": board_reflectance}
    return CalibrationManifest(digital=digital, parallax=bench.parallax_from(depth), **more)


def _lines(n: int) -> Lighting:
    """Return shots of one row or one column of pixels each, evenly spread.

    The accuracy of a session is that of single lines: because patterns are orthogonal, the squared errors of all +-1
    responses add up to N times those of all lines, and so do the squared responses.
    """
    chosen = np.unique(((np.arange(_LINES) + 0.5) * n / _LINES).astype(np.int64))
    rows = np.zeros((len(chosen), n, n))
    rows[np.arange(len(chosen)), chosen] = 1
    return Lighting(np.arange(n * n), np.concatenate([rows, rows.transpose(0, 2, 1)]).reshape(-1, n * n))


# -------- Cost of a calibration session
# The reason of each figure is how :class:`LitSession` works.

_PRODUCT_S = 1.1e-11
"""Cost of a multiplication in products as large as those of stripes: half of that in small ones."""
_MIXED_S, _FORMED_S = 8e-9, 1e-8
"""Seconds per pixel of a frame beside its multiplications."""
_READ_S = 1.75e-9
"""Seconds per number of a raster's terms that a stripe's frame and its probes read."""
_UNWRITTEN = 0.55
"""Cost of exposing a frame without writing it, relative to a capture's frame."""
_HELD, _AT_WORK = 5.0, 5.0
"""Frames in double precision: of a session, and of each response in progress."""
_SUMS = 8.0
"""Numbers of a side's sums for each pattern and pixel of a side of the sensor."""


def session_seconds(
    board: Apparatus, count: int, shots: int, settings: Settings, largest_terms: float = 1.0
) -> dict[str, float]:
    """Predict the seconds of forming stripes, exposing shots and adding up responses.

    ``count`` is the number of +-1 patterns of a side, and ``largest_terms`` the number of terms of a mask on a raster.
    """
    n, pixels = board.n, board.geometry.frame_side
    cells = max(Simulation(board, settings).grids["fine"].bundle.cells)
    mixed = lines_held(n, count, pixels)
    forming = Forming(
        pixels=pixels,
        cells=cells,
        # Single lines that are mixed, or the half of all that is +1.
        lit=(1 if mixed else n / 2) / cells,
        terms=float(len(board.spectrum.weights) * board.geometry.mask_terms),
        shots=count,
        classes=n,
        geometric_terms=float(board.geometry.mask_terms),
        correlated=(board.geometry.is_drawn(waves=False), board.geometry.is_drawn(board.geometry.diffracts)),
        largest_terms=(largest_terms,) * 2,
    )
    numbers = replace(cost_model.Numbers.of(settings), mixed=0.0)  # what black pixels leak is added to frames
    frames = n if mixed else count
    seconds = 2 * float(cost_model.forming_seconds(forming, numbers, frames, _PRODUCT_S))
    if 1 < largest_terms < math.inf:
        of_anchors = (settings.anchors > 1) * settings.anchors * settings.coarse_cells
        lit_cells = cells * len(settings.depths) + n * of_anchors
        seconds += 2 * frames * _READ_S * largest_terms * lit_cells * pixels
    each = n * _PRODUCT_S + _MIXED_S if mixed else _FORMED_S
    return {
        "optics": seconds + 2 * count * pixels**2 * each,
        "sensor": _UNWRITTEN * cost_model.frame_seconds(board, shots)["sensor"],
    }


def session_cost(board: Apparatus, count: int, settings: Settings, seconds: float) -> Cost:
    n, pixels = board.n, board.geometry.frame_side
    lines = n if lines_held(n, count, pixels) else 0
    frames = lines + 3 * at_once(pixels) + _HELD + _AT_WORK * cost_model.frames_at_once(round(pixels**2))
    memory_bytes = 8.0 * (frames * pixels**2 + _SUMS * count * pixels)
    return Cost(seconds=seconds, memory_bytes=cost_model.light_bytes(board, n * n, settings) + memory_bytes)


_LINES_BYTES = 7 * 2**28
"""Largest memory for frames of lines."""


def lines_held(lines: int, patterns: int, pixels: float) -> bool:
    return mixes(lines, patterns, pixels) or (patterns >= lines and 8 * lines * pixels**2 <= _LINES_BYTES)


# -------- A session with its light: responses with and without noise, and frames

Result = TypeVar("Result")
SHOT, DARK, READ, ROUNDING = "shot noise", "dark current", "read noise", "quantisation"
"""Sources of a frame's noise."""


@dataclass(frozen=True)
class Response:
    """Response (m, m') to a +-1 pattern [electrons / s], its saturated shots, and the sum of a pair."""

    rate: FloatArray
    saturated: int = 0
    light: FloatArray | None = None


def response_variances(
    session: Session, uniform_rate: FloatArray, exposure_s: float
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Return noise variances [(electrons / s)^2], (m, m') or one number: each response's own, and a side's shared.

    Two shots of a pair share the uniform light L: variance (L + 2 D) / t + 2 R / t^2 with dark electrons D and the
    variance R of reading and rounding. 2 Y(positive) - Y(uniform) for a part p of the lines has (4 p L + 4 D) / t +
    4 R / t^2 of its own; the uniform shot's (L + D) / t + R / t^2 is shared. Means of repeats have the
    corresponding part.
    """
    sensor, time = session.bench.sensor, exposure_s
    rounding = 0.0 if sensor.largest_dn is None else 1 / (12 * sensor.gain_dn_per_e**2)
    single: dict[str, FloatArray | float] = {
        SHOT: session.through_filters(uniform_rate) / time,
        DARK: sensor.superpixel_dark_current_e_per_s / time,
        READ: sensor.superpixel_reading_noise_e**2 / time**2,
        ROUNDING: rounding / time**2,
    }
    # As many times a uniform shot's light, and another shot's other noise, as a response has.
    lines, own_shots, shared_shots = 0.5, 2.0, 0.0
    if not session.pairs:
        lines, own_shots, shared_shots = float((1 + session.signs).mean()) / 2, 4.0, 1.0
    weight = 1.0 if session.filters is None else 1.0 / np.square(session.filters)
    own, shared = {}, {}
    for source, one in single.items():
        part = lines if source == SHOT else 1.0
        own[source] = np.asarray(own_shots * part * weight * one / session.recipe.repeats)
        shared[source] = np.asarray(shared_shots / session.recipe.repeats * weight * one)
    return own, shared


def entry_variances(
    session: Session, uniform_rate: FloatArray, exposure_s: float, factors: tuple[FloatArray, FloatArray]
) -> list[dict[str, FloatArray]]:
    """Return the variances (m, n) of the entries of the left and of the right factor, by source.

    u_i = Y_i v / |v|^2, v the sum of the other factor's columns, has the variance sum_c V_rc v_c^2 / |v|^4 in row r,
    V being that of a response's pixels. U H^T / N averages N of them with signs, and the rows of H are orthogonal.
    Noise that all responses share enters column p by the mean of its signs: fully where they are all +1, and not at all
    elsewhere. Noise of v is of second order.
    """
    signs, found = session.signs, list[dict[str, FloatArray]]()
    columns = np.full(len(signs), 1 / signs.shape[1]), np.square(signs.mean(axis=1))
    for axis, other in enumerate(factors[::-1]):
        common, parts = other.sum(axis=1), dict[str, FloatArray]()
        weights = np.square(common / np.dot(common, common))
        for variances, even in zip(response_variances(session, uniform_rate, exposure_s), columns, strict=True):
            for source, variance in variances.items():
                rows = np.moveaxis(np.broadcast_to(variance, uniform_rate.shape), axis, 0) @ weights
                parts[source] = parts.get(source, 0.0) + np.outer(rows, even)
        found.append(parts)
    return found


@dataclass(frozen=True, eq=False)
class LitSession:
    """A session with traced light: its responses, with or without noise.

    Attributes
    ----------
    light
        Light of the board by projector pixel.
    white
        Expected frame of the uniform shot.
    exposure_s
        Exposure time of every shot [s].
    speckle
        Speckle contrast of the frames.
    kept
        Folder for its frames, or None.
    """

    session: Session
    light: SampledLight
    white: Frame
    exposure_s: float
    speckle: float
    kept: Path | None = None

    @classmethod
    def of(cls, session: Session, light: SampledLight, job: Job) -> LitSession:
        with job.clock.stage("optics"):
            n, signs = session.bench.n, session.signs
            white = next(iter(light.frames(Lighting.uniform(n), session.seed)))
            exposure = Exposure(None, session.recipe.exposure_fraction)
            exposure_s = exposure.choose(session.bench.devices, float(session.through_filters(white.irradiance).max()))
        stripes = PatternFamily("stripes", signs[:, 1:2].astype(np.int8), np.ones((n, 1), np.int8))
        return cls(session, light, white, exposure_s, light.speckle(stripes))

    @property
    def response_noise(self) -> float:
        """Standard deviation of a number of a response [electrons / s], its mean over all pixels."""
        both = response_variances(self.session, self.uniform_rate, self.exposure_s)
        every = [part for parts in both for part in parts.values()]
        return float(np.sqrt(sum(every, np.zeros(self.uniform_rate.shape)).mean()))

    def each(self, side: str, use: Callable[[tuple[int, Frame]], Result], job: Job, first: int = 0) -> Iterator[Result]:
        """Apply ``use`` to number and expected frame of the +-1 patterns of a ``side``, in threads.

        Results are in order. Number 0 is the uniform pattern; the frame is that of a pattern's +1 pixels.
        """
        black, count = self.light.simulation.physics.black_level, self.session.signs.shape[1]

        def use_response(item: tuple[int, Frame]) -> Result:
            number, frame = item
            if number and black:
                lit = (1 - black) * frame.irradiance + black * self.white.irradiance
                frame = replace(frame, irradiance=lit)
            return use((number, frame))

        job.progress(f"{side} stripes", first / count)
        for chunk, results in used_in_chunks(self.stripes(side, first), use_response, job):
            job.progress(f"{side} stripes", (chunk[-1][0] + 1) / count)
            yield from results

    def stripes(self, side: str, first: int) -> Iterator[tuple[int, Frame]]:
        """Yield numbers and frames of the +1 pixels of a ``side``'s patterns, without light of black pixels.

        Where frames of single lines can be held, those of patterns are mixed from them: by :class:`ExpectedFrames` up
        to 256 lines, and here beyond. Otherwise they are formed in lots: which pixels each of 512 patterns lights would
        be 2 GiB. The bits do not depend on the ``first`` pattern, and there is no Monte Carlo error.
        """
        if first == 0:
            yield 0, self.white
        seed, (n, count) = self.session.seed, self.session.signs.shape
        row, column = np.divmod(np.arange(n * n), n)
        stripes = Lighting(row if side == "horizontal" else column, (1.0 + self.session.signs.T) / 2)
        lines, pixels, removed = None, side_of(self.session.bench.geometry.frame_shape), False
        if lines_held(n, count, pixels) and not mixes(n, count, pixels):
            held, single = np.empty((n, *self.session.bench.geometry.frame_shape)), Lighting(stripes.labels, np.eye(n))
            for start in range(0, n, together := at_once(pixels)):
                numbers = np.arange(start, min(start + together, n))
                formed = [*self.light.frames(single.shots(numbers), seed, leaking=False)]
                held[numbers] = [frame.irradiance for frame in formed]
                removed = removed or any(frame.removed for frame in formed)
            lines = None if removed else held
        # Batches depend on the sensor alone, because their size affects the last bits.
        step = count if mixes(n, count, pixels) else at_once(pixels)
        for start in range(0, count, step):
            numbers = np.arange(start, min(start + step, count))
            if numbers[-1] < max(first, 1):
                continue
            if lines is None:
                frames: Iterator[Frame] = iter(self.light.frames(stripes.shots(numbers), seed, leaking=False))
            else:
                mixed = mix_frames(stripes.weights[numbers], lines)
                frames = (Frame(frame, 0.0, 0.0, 0.0) for frame in mixed)
            yield from (item for item in zip(numbers.tolist(), frames, strict=True) if item[0] >= max(first, 1))

    def noisy(self, side: str, number: int, frame: Frame) -> Response:
        if not self.session.pairs:
            (rate, saturated), uniform = self._expose(frame.irradiance, side, number + 1), self._uniform[side]
            return Response(2 * rate - uniform[0], saturated + (uniform[1] if number == 0 else 0))
        positive, saturated = self._expose(frame.irradiance, side, 2 * number)
        # Rounding leaves pixels that see the +1 stripes alone a little below zero.
        rest = np.maximum(self._both - frame.irradiance, 0.0)
        negative, also_saturated = self._expose(rest, side, 2 * number + 1)
        return Response(positive - negative, saturated + also_saturated, positive + negative)

    def noise_free(self, frame: Frame) -> FloatArray:
        """Return the (m, m') response from the expected ``frame``: 2 Y((1 + P)/2) - Y(1)."""
        return 2 * self._second.electrons(frame) - self.uniform_rate

    @property
    def _second(self) -> Exposer:
        return Exposer(self.session.bench.devices, 1.0, self.session.seed)

    @cached_property
    def uniform_rate(self) -> FloatArray:
        return self._second.electrons(self.white)

    @cached_property
    def _both(self) -> FloatArray:
        n = self.session.bench.n
        off = Lighting(np.zeros(n * n, dtype=np.int64), np.zeros((1, 1)))
        (dark,) = self.light.frames(off, self.session.seed)
        return np.asarray(self.white.irradiance + dark.irradiance)

    @cached_property
    def _uniform(self) -> Mapping[str, tuple[FloatArray, int]]:
        return {side: self._expose(self.white.irradiance, side, 0) for side in SIDES}

    def _expose(self, irradiance: FloatArray, side: str, index: int) -> tuple[FloatArray, int]:
        """Return the rate [electrons / s] of a shot, the mean of its repeats, and its saturated frames."""
        session, repeats, saturated = self.session, self.session.recipe.repeats, 0
        exposer = Exposer(session.bench.devices, self.exposure_s, session.seed, self.speckle)
        passed = Frame(session.through_filters(irradiance), 0.0, 0.0, 0.0)
        lit = exposer.shot_electrons(passed, "calibration", side, index)
        total: chain.Digital | FloatArray = np.zeros(0)
        for repeat, power in enumerate(session.powers[side, index]):
            names = ("repeat", repeat) if repeat else ()
            light = power * lit
            digital = exposer.digital(light, "calibration", side, index, *names)
            if self.kept is not None:
                path = self.kept / session.files[side, index, repeat].file
                write_numbers(path, digital.astype(np.uint16) if session.as_tiff else digital)
            saturated += int(exposer.saturates(digital, light))
            total = total + digital if repeat else digital if repeats == 1 else digital.astype(np.float64)
        rate = exposer.rate(total if repeats == 1 else total / repeats)
        return rate if session.filters is None else rate / session.filters, saturated
