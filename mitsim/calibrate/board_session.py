"""Patterns and light of a rendered Hadamard calibration session on a white board (the paper, section IV-A).

Every column h_i of a Hadamard matrix is shown as stripes h_i 1^T and 1 h_i^T, each +-1 pattern as two shots (or one and
a shared uniform one). If n is no Hadamard order, the first n rows of the next one are used, because rows stay
orthogonal.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mitsim.acquire.exposure import camera_warnings, levels
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.layout import MOST_LOST, before_board, mask_fault, missed_pixels
from mitsim.core.arrays import FloatArray, in_threads
from mitsim.core.errors import MitsimError
from mitsim.core.job import Cost, Job
from mitsim.devices.camera import CameraGeometry, side_of
from mitsim.devices.patterns import Lighting, stripe_signs
from mitsim.devices.projector import Spectrum
from mitsim.devices.session import UNIFORM, BoardShape, Half, SessionRecipe, halves_in_order
from mitsim.light.cost_model import (
    Numbers,
    first_shadow,
    forming_seconds,
    frame_seconds,
    frames_at_once,
    in_waves,
    light_bytes,
)
from mitsim.light.light import SampledLight, Sampling, trace_lines
from mitsim.light.passes import Simulation
from mitsim.light.plan import Plan
from mitsim.light.settings import Forming, Settings
from mitsim.optics.fft_shadow import raster
from mitsim.optics.frames import Frame, at_once, mixes
from mitsim.optics.image_formation import number_of_terms
from mitsim.optics.shadow import Directions, SeparableTerms
from mitsim.optics.terms import best_term, centre_terms, shadow_terms
from mitsim.planner.planner import make_plan
from mitsim.reconstruct.factors import SEPARABLE_RESIDUAL, decibels

_IN_RAYS = 0.5
"""Part (rms) of the geometric residual below which the residual is attributed to diffraction."""
_PLACES = 128
"""Sensor pixels per axis on which the mask is compared, because all pixels would take gigabytes."""
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

    @property
    def centre(self) -> bool:
        """Return True if row and column means are subtracted from every response, as for a FlatCam mask."""
        return self.bench.geometry.centred

    @property
    def warnings(self) -> tuple[str, ...]:
        return (
            *self.board_warnings,
            *self.mask_warnings,
            *camera_warnings(self.bench.sensor, self.bench.geometry.frame_shape),
        )

    @cached_property
    def board_warnings(self) -> tuple[str, ...]:
        shape = self.recipe.board
        missed = 0 if shape == BoardShape() else missed_pixels(self.board)
        if not missed:
            return ()
        z = self.distance
        rows, columns = (z * (last - first) for first, last in self.bench.windows_at(z))
        return (
            f"board: {missed} of {self.bench.n**2} projector pixels do not fall whole on it ({shape.words}), and "
            f"their light is missing in the factors; the window is {rows:.4g} x {columns:.4g} mm there: "
            "take a larger board, or hang it straight",
        )

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
            remedy = "bring the mask nearer to the sensor, or give it larger features: without waves it is separable"
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
        return centre_terms(terms) if self.centre else terms

    @cached_property
    def signs(self) -> FloatArray:
        """Return the first n rows of the smallest sufficient Hadamard matrix, (n, N); column 0 is all +1."""
        return stripe_signs(self.bench.n).astype(np.float64)

    @property
    def lit_lines(self) -> float:
        return float((1 + self.signs).mean()) / 2

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
        with job.planning("calibration", first_shadow(self.board, {})):
            plan, started = make_plan(self.board, _lines(n), accuracy, self.seed), time.perf_counter()
            geometry, waves, terms = self.board.geometry, in_waves(plan.settings.effects), 1.0
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

    def trace(self, plan: Plan, job: Job) -> SampledLight:
        (light,) = self.trace_lines((self.board,), plan, job)
        return light

    def trace_lines(self, boards: Sequence[Apparatus], plan: Plan, job: Job) -> list[SampledLight]:
        with job.clock.stage("transport"):
            sampling, lighting = Sampling(purpose="calibration"), _lines(self.bench.n)
            lights = trace_lines(self.board, boards, plan, lighting, self.seed, sampling, job.progress)
        return [light.merge() for light in lights]


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
# The reason of each figure is how :class:`mitsim.calibrate.session.LitSession` works.

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
    numbers = replace(Numbers.of(settings), mixed=0.0)  # what black pixels leak is added to frames
    frames = n if mixed else count
    seconds = 2 * float(forming_seconds(forming, numbers, frames, _PRODUCT_S))
    if 1 < largest_terms < math.inf:
        of_anchors = (settings.anchors > 1) * settings.anchors * settings.coarse_cells
        lit_cells = cells * len(settings.depths) + n * of_anchors
        seconds += 2 * frames * _READ_S * largest_terms * lit_cells * pixels
    each = n * _PRODUCT_S + _MIXED_S if mixed else _FORMED_S
    return {
        "optics": seconds + 2 * count * pixels**2 * each,
        "sensor": _UNWRITTEN * frame_seconds(board, shots)["sensor"],
    }


def session_cost(board: Apparatus, count: int, settings: Settings, seconds: float) -> Cost:
    n, pixels = board.n, board.geometry.frame_side
    lines = n if lines_held(n, count, pixels) else 0
    frames = lines + 3 * at_once(pixels) + _HELD + _AT_WORK * frames_at_once(round(pixels**2))
    memory_bytes = 8.0 * (frames * pixels**2 + _SUMS * count * pixels)
    return Cost(seconds=seconds, memory_bytes=light_bytes(board, n * n, settings) + memory_bytes)


# -------- Frames of a side's stripes
# Where frames of single lines can be held, those of patterns are mixed from them: by :class:`ExpectedFrames` up to
# 256 lines, and here beyond. Otherwise they are formed in lots: which pixels each of 512 patterns lights would be 2
# GiB.

_LINES_BYTES = 7 * 2**28
"""Largest memory for frames of lines."""
_COLUMNS = 2**14
"""Pixels per product, fixed because it affects the last bits."""


def lines_held(lines: int, patterns: int, pixels: float) -> bool:
    return mixes(lines, patterns, pixels) or (patterns >= lines and 8 * lines * pixels**2 <= _LINES_BYTES)


def stripe_frames(
    light: SampledLight, stripes: Lighting, seed: int, shape: tuple[int, int], first: int
) -> Iterator[tuple[int, Frame]]:
    """Yield numbers and frames of patterns without light of black pixels and without Monte Carlo error.

    The bits do not depend on the ``first`` pattern. ``stripes`` has the line of each projector pixel, and the power 0
    or 1 of each line in every pattern.
    """
    count, n = stripes.weights.shape
    lines, pixels, removed = None, side_of(shape), False
    if lines_held(n, count, pixels) and not mixes(n, count, pixels):
        held, single = np.empty((n, math.prod(shape))), Lighting(stripes.labels, np.eye(n))
        for start in range(0, n, together := at_once(pixels)):
            numbers = np.arange(start, min(start + together, n))
            formed = [*light.frames(single.shots(numbers), seed, leaking=False)]
            held[numbers] = [frame.irradiance.ravel() for frame in formed]
            removed = removed or any(frame.removed for frame in formed)
        lines = None if removed else held
    # Batches depend on the sensor alone, because their size affects the last bits.
    step = count if mixes(n, count, pixels) else at_once(pixels)
    for start in range(0, count, step):
        numbers = np.arange(start, min(start + step, count))
        if numbers[-1] < first:
            continue
        if lines is None:
            frames: Iterator[Frame] = iter(light.frames(stripes.shots(numbers), seed, leaking=False))
        else:
            weights, mixed = stripes.weights[numbers], np.empty((len(numbers), lines.shape[1]))

            def mix(begin: int, weights: FloatArray = weights, mixed: FloatArray = mixed) -> None:
                inside = slice(begin, begin + _COLUMNS)
                mixed[:, inside] = weights @ lines[:, inside]

            in_threads(mix, range(0, lines.shape[1], _COLUMNS))
            frames = (Frame(frame, 0.0, 0.0, 0.0) for frame in mixed.reshape(-1, *shape))
        yield from (item for item in zip(numbers.tolist(), frames, strict=True) if item[0] >= first)
