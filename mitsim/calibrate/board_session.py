"""A bench and a recipe in; what a rendered Hadamard calibration session on a white board shows, and its light, out.

The paper's procedure (section IV-A): every column h_i of a Hadamard matrix is shown as horizontal stripes h_i 1^T and
as vertical ones 1 h_i^T, each +-1 pattern as two shots (or one and a uniform one), all at one exposure, with sensor
noise. When n is no Hadamard order the next one is used and its first n rows: rows stay orthogonal.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mitsim.acquire.drifting import levels
from mitsim.acquire.exposure import camera_warnings
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.board import before_board, missed_pixels
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.job import Cost, Job
from mitsim.core.parallel import in_threads
from mitsim.devices.camera import CameraGeometry, side_of
from mitsim.devices.patterns import Lighting, stripe_signs
from mitsim.devices.plate import MOST_TERMS
from mitsim.devices.projector import Spectrum
from mitsim.devices.session import UNIFORM, BoardShape, Half, SessionRecipe, halves_in_order
from mitsim.light.cost_model import FIXED, Numbers, forming_seconds, in_waves
from mitsim.light.light import SampledLight, Sampling, trace_lines
from mitsim.light.memory import (
    drawing_seconds,
    first_shadow,
    frame_seconds,
    frames_at_once,
    light_bytes,
    raster_bytes,
)
from mitsim.light.plan import Plan
from mitsim.light.settings import Forming, Settings
from mitsim.light.simulation import Simulation
from mitsim.optics.fft_shadow import raster
from mitsim.optics.frames import Frame, at_once, mixes
from mitsim.optics.image_formation import largest_terms, number_of_terms
from mitsim.optics.shadow import Directions, SeparableTerms
from mitsim.optics.terms import best_term, centre_terms, shadow_terms, stripe_misfits
from mitsim.planner.planner import make_plan
from mitsim.reconstruct.estimate_factors import SEPARABLE_RESIDUAL, decibels
from mitsim.reconstruct.session_check import odd_responses, too_many

_IN_RAYS = 0.5
"""Part of what no separable camera has, rms, that rays leave where the rest, three quarters of its energy, is said to
be of diffraction."""
_TOLD, _TOLD_S = 4.0, 6e-11
"""Times the terms of a mask that telling how far it is from a separable one takes in memory, with their sides stacked
and factorised; and seconds of that for each term and byte of all (a drawing that is turned by one degree, 512
pixels, 192 terms: 0.8 GiB, 3.1 processor seconds)."""
_DARK = 1e-12
"""Transmission below which nothing is seen: rounding of sums."""
_LINES = 4
"""Rows, and columns, of pixels that the plan looks at: chosen so that each quarter of the window shows."""


@dataclass(frozen=True)
class _Inseparable:
    """What the best separable mask leaves of a mask's shadow in ``words``, its ``remedy``, and how many ``patterns`` of
    a session are of another shape than the others."""

    words: str
    remedy: str
    patterns: int


@dataclass(frozen=True)
class Session:
    """What a calibration session shows, of a ``bench`` by a ``recipe``, at one depth.

    Attributes
    ----------
    bench, recipe
        what is calibrated, and how.
    seed
        of its noise and light.
    depth
        of the board [mm]; None: on the aligned plane.
    filters
        (pixels, pixels) part of the light that colour filters over them pass, which readings are divided by; None: all.
    whole
        the session of all lines, of whose light this is one; None: itself.
    """

    bench: Apparatus
    recipe: SessionRecipe
    seed: int = 0
    depth: float | None = None
    filters: FloatArray | None = None
    whole: Session | None = None

    @property
    def distance(self) -> float:
        """From the sensor to the board's middle [mm]."""
        return self.depth or self.bench.geometry.scene_distance

    @cached_property
    def board(self) -> Apparatus:
        """The bench with the white board instead of its scene."""
        if self.whole is not None:
            return replace(self.bench, loaded=self.whole.board.loaded)
        return before_board(self.bench, self.recipe.board_reflectance, self.recipe.board, self.depth)

    @property
    def centre(self) -> bool:
        """Whether row and column means are taken out of every response, as for a FlatCam mask."""
        return self.bench.geometry.centred

    @property
    def warnings(self) -> tuple[str, ...]:
        """What board, mask and sensor do that factors do not know of."""
        return (
            *self.board_warnings,
            *self.mask_warnings,
            *camera_warnings(self.bench.sensor, self.bench.geometry.frame_shape),
        )

    @cached_property
    def board_warnings(self) -> tuple[str, ...]:
        """Projector pixels that the board leaves dark."""
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

    @cached_property
    def mask_warnings(self) -> tuple[str, ...]:
        """A warning where no separable camera comes near this one's shadow between projector pixels and sensor, with
        the residual and the part of it that diffraction makes. Stripes show less of it, since their lines add up."""
        found = self._inseparable
        return () if found is None else (f"{found.words}, and images of these factors lack it; {found.remedy}",)

    def check_mask(self, job: Job | None = None) -> None:
        """MitsimError for a mask behind which more patterns of the session are of another shape than may be left out of
        it, which its frames would show after all the work; and when to tell so takes more than a ``job`` allows."""
        job, count = job or Job(), self.signs.shape[1]
        self._first_cost.check("calibration", job.limits)
        self._mask_cost.check("calibration", job.limits)
        with job.clock.stage("mask"):
            found = self._inseparable
        if found is not None and too_many(found.patterns, count):
            raise MitsimError(
                f"{found.words}: {found.patterns} of {2 * count} patterns would show another shape than the rest, too "
                f"many for factors; {found.remedy}; it can be planned and captured, and no image of it is solved"
            )

    @property
    def _first_cost(self) -> Cost:
        """Memory and time of the session, as far as they are known before a look at the board."""
        count, first = self.signs.shape[1], Settings(self.distance)
        seconds = session_seconds(self.board, count, self.shots, first)
        return session_cost(self.board, count, first, sum(seconds.values()), len(self.recipe.exposure_ladder))

    @property
    def _mask_cost(self) -> Cost:
        """Memory and time of comparing the mask with separable ones, at most."""
        geometry, most = self.bench.geometry, 1.0
        seconds = bytes_drawn = 0.0
        if geometry.is_drawn(waves=False):
            most, seconds = float(MOST_TERMS), drawing_seconds(geometry, None)
            bytes_drawn = raster_bytes(geometry, None)
        elif self._told is None:
            most = float(geometry.mask_terms)
        bytes_told = 8.0 * most * self.bench.n * sum(geometry.frame_shape)
        return Cost(seconds=seconds + _TOLD_S * most * bytes_told, memory_bytes=bytes_drawn + _TOLD * bytes_told)

    @cached_property
    def _inseparable(self) -> _Inseparable | None:
        """Of the mask's shadow in closed form; None where a separable mask has next to all of it."""
        geometry, told, remedy = self.bench.geometry, self._told, "straighten the mask, or take a separable one"
        seen = self._transmissions(geometry, told)
        terms = centre_terms(seen) if self.centre else seen
        residual = best_term(terms).residual
        if geometry.is_drawn(waves=False):
            left_out = raster(geometry, self.distance).largest.left_out
            residual = math.sqrt(1 - (1 - residual**2) * (1 - left_out**2))
        if residual <= SEPARABLE_RESIDUAL:
            return None
        rays, cause = residual if told is None else best_term(self.shadow(geometry)).residual, ""
        if rays < _IN_RAYS * residual:
            cause = f" by diffraction ({rays:.1%} without)"
            remedy = "bring the mask nearer to the sensor, or give it larger features: without waves it is separable"
        words = (
            f"the mask ({geometry.mask_words}) is not separable{cause}: the best separable one leaves {residual:.1%} "
            f"of its shadow, {-decibels(residual):.1f} dB below it"
        )
        noise, scale = self._noise_behind(seen)
        numbers = math.prod(geometry.frame_shape)
        patterns = sum(
            len(odd_responses(scale * misfits + noise, scale * energies + noise, numbers))
            for misfits, energies in stripe_misfits(terms, self.signs)
        )
        return _Inseparable(words, remedy, patterns)

    @property
    def _told(self) -> Spectrum | None:
        """Lines of the light, in waves of which the shadow is a sum of few terms; None: it is told in rays."""
        return self.bench.spectrum if self.bench.geometry.few_wave_terms else None

    def _noise_behind(self, terms: SeparableTerms) -> tuple[float, float]:
        """Squared noise of a +-1 response all in all [electrons^2], and squared electrons of a shot for a transmission
        of one of the shadow's ``terms``: the brightest pixel of the uniform frame has the recipe's part of the full
        well. Without falloff, dark current, speckle and steps of numbers."""
        sensor, recipe = self.bench.sensor, self.recipe
        rows, columns = (np.stack([each.sum(axis=1) for each in side]) for side in zip(*terms, strict=True))
        white = self.through_filters(np.maximum(rows.T @ columns, 0.0))
        scale = recipe.exposure_fraction * sensor.superpixel_full_well_e / max(float(white.max()), _DARK)
        # A pair's two shots share the uniform light; 2 Y - U has twice that light of its own, and the readings of four.
        light, readings = (1.0, 2.0) if self.pairs else (2.0, 4.0)
        variance = light * scale * white + readings * sensor.superpixel_reading_noise_e**2
        passed = 1.0 if self.filters is None else np.square(self.filters)
        return float(np.sum(variance / passed)) / recipe.repeats, scale**2

    def shadow(self, geometry: CameraGeometry, spectrum: Spectrum | None = None) -> SeparableTerms:
        """The operator of a camera's ``geometry`` from projector pixels at the board's distance to the sensor, of
        transmissions: in rays, or in waves of a ``spectrum``; centred where frames are."""
        terms = self._transmissions(geometry, spectrum)
        return centre_terms(terms) if self.centre else terms

    def _transmissions(self, geometry: CameraGeometry, spectrum: Spectrum | None) -> SeparableTerms:
        """The same of frames as they are."""
        rows, columns = (
            Directions.cells(np.linspace(*edges, self.bench.n + 1)) for edges in self.bench.windows_at(self.distance)
        )
        if geometry.is_drawn(waves=False):
            seen = largest_terms(geometry, rows, columns, self.distance, rough=True)
            assert seen is not None
            return seen
        return shadow_terms(geometry, rows, columns, self.distance, spectrum)

    @cached_property
    def signs(self) -> FloatArray:
        """(n, N) first n rows of the smallest Hadamard matrix that has them; column 0 is all +1."""
        return stripe_signs(self.bench.n).astype(np.float64)

    @property
    def lit_lines(self) -> float:
        """Part of the lines that are +1, mean over patterns: about half."""
        return float((1 + self.signs).mean()) / 2

    @property
    def pairs(self) -> bool:
        """Whether a +-1 pattern is the difference of two shots, and not taken from one and a uniform shot."""
        return self.recipe.signed_capture == "pair"

    def through_filters(self, light: FloatArray) -> FloatArray:
        """What passes the filters of ``light`` (pixels, pixels)."""
        return light if self.filters is None else light * self.filters

    @property
    def shots(self) -> int:
        """Frames of the whole session."""
        lit = len(self.order) * self.recipe.repeats
        return (lit + self.recipe.dark_frames) * len(self.recipe.exposure_ladder)

    @property
    def order(self) -> list[Half]:
        """What the lit frames show, as they are taken; each with all exposures, one after the other, and of each all
        repeats. Dark frames come last."""
        return halves_in_order(self.signs.shape[1], self.pairs, self.recipe.order, self.recipe.order_seed)

    @cached_property
    def powers(self) -> Mapping[tuple[str, int], FloatArray]:
        """(exposures, repeats) power of the projector in frames of each shot, by side and number; 1 at the session's
        begin."""
        drift, order = self.recipe.drift, self.order
        each = len(order), len(self.recipe.exposure_ladder), self.recipe.repeats
        found = levels(self.seed, "session", math.prod(each), drift.session_ramp, drift.session_flicker).reshape(each)
        return {self.shot(half): power for half, power in zip(order, found, strict=True)}

    def shot(self, half: Half) -> tuple[str, int]:
        """Side and number of the shot that shows a ``half``, which name its noise."""
        side, number, sign = half
        return side, 2 * number + (sign < 0) if self.pairs else number + (sign != UNIFORM)

    def plan(self, accuracy: float, job: Job) -> Plan:
        """What to simulate for responses of this relative ``accuracy``, and what the session takes.

        MitsimError when that is more memory or time than the ``job`` allows: before the look at the board, or after it.
        """
        n, count, spent = self.bench.n, self.signs.shape[1], job.clock.seconds()
        self._first_cost.check("calibration", job.limits)
        with job.planning("calibration", first_shadow(self.board, {})):
            plan, started = make_plan(self.board, _lines(n), accuracy, self.seed), time.perf_counter()
            # Drawn here in the cells that were chosen, a shadow is the session's own.
            terms = self._terms_of(plan.settings)
            planning = plan.predicted["plan"] + time.perf_counter() - started
        seconds = session_seconds(self.board, count, self.shots, plan.settings, terms)
        if told := spent.get("mask", 0.0):
            seconds["mask"] = told
        # There is no truth to be traced, and other frames are formed than those that the plan looks at.
        plan = plan.taking(start=spent["total"] - told, plan=planning, truth=0.0, **seconds)
        exposures = len(self.recipe.exposure_ladder)
        cost = session_cost(self.board, count, plan.settings, plan.predicted_seconds, exposures)
        cost.check("calibration", job.limits)
        job.clock.predict(plan.predicted)
        return replace(plan, cost=cost)

    def _terms_of(self, settings: Settings) -> float:
        """Terms of the shadow that ``settings`` have drawn on a raster, which their plan has looked at; 1 of others."""
        geometry, waves = self.board.geometry, in_waves(settings.effects)
        if not geometry.is_drawn(waves):
            return 1.0
        geometry = geometry.model_copy(update={"mask_cells": settings.raster_cells})
        return number_of_terms(raster(geometry, self.distance, self.board.waves if waves else None))

    def trace(self, plan: Plan, job: Job) -> SampledLight:
        """The board's light, by projector pixel, sampled as the ``plan`` says; ``job`` is told how far it is."""
        (light,) = self.trace_lines((self.board,), plan, job)
        return light

    def trace_lines(self, boards: Sequence[Apparatus], plan: Plan, job: Job) -> list[SampledLight]:
        """The same of every line of the board's light.

        Parameters
        ----------
        boards
            this session's with each line alone; the board itself where light is not told apart.
        plan, job
            as for :meth:`trace`.
        """
        with job.clock.stage("transport"):
            sampling, lighting = Sampling(purpose="calibration"), _lines(self.bench.n)
            lights = trace_lines(self.board, boards, plan, lighting, self.seed, sampling, job.progress)
        return [light.merge() for light in lights]


def _lines(n: int) -> Lighting:
    """Shots of one row or one column of pixels each, evenly spread.

    The accuracy of a session is that of single lines: by the patterns' orthogonality the squared errors of all +-1
    responses add up to N times those of all lines, and so do the squared responses themselves. Frames of half the
    pixels are far brighter than the responses that are taken from their differences.
    """
    chosen = np.unique(((np.arange(_LINES) + 0.5) * n / _LINES).astype(np.int64))
    rows = np.zeros((len(chosen), n, n))
    rows[np.arange(len(chosen)), chosen] = 1
    return Lighting(np.arange(n * n), np.concatenate([rows, rows.transpose(0, 2, 1)]).reshape(-1, n * n))


# -------- What a calibration session takes
# The reason of each figure is how :class:`mitsim.calibrate.session.LitSession` works.

_UNIT_COSTS = replace(FIXED, product=1.1e-11)
"""A multiplication of products as large as those of stripes: half of what it takes in small ones (2048 pixels a side,
two processors)."""
_MIXED_S, _FORMED_S = 8e-9, 1e-8
"""A pixel of a frame that is mixed or formed beside its multiplications: memory that is read and taken anew (sensors of
512 and 1024 pixels mixed, of 2048 formed; two processors)."""
_READ_S = 1.75e-9
"""A number of a drawn shadow's terms, all of one side of which a stripe's frame and its probes read; 0.7 of the
processor seconds of 60 and 102 terms at 512 pixels (a drawing that is turned by 0.05 degrees: 1.05 of what it took)."""
_UNWRITTEN = 0.55
"""Of what exposing a capture's frame takes, that of one which no file is written of (0.62 at 512 pixels, 0.49 at
1024)."""
_HELD, _AT_WORK = 5.0, 5.0
"""Frames in double precision: those that a session holds (the uniform one, its rate, a pair's both shots together, two
noisy uniform ones), and what each response takes that is worked on (light of two shots, their numbers, rates)."""
_OF_AN_EXPOSURE = 2.0
"""Frames more of a response for each exposure beyond the first: numbers of two shots, and one shot's electrons."""
_SUMS = 8.0
"""Numbers of a side's sums for each pattern and pixel of a side of the sensor: of two sides and two kinds of responses,
and once more while they are saved."""


def session_seconds(
    board: Apparatus, count: int, shots: int, settings: Settings, largest_terms: float = 1.0
) -> dict[str, float]:
    """Seconds of forming the stripes of a session, and of exposing its shots and adding up responses.

    Parameters
    ----------
    board
        the bench with the board.
    count, shots
        +-1 patterns of a side, and frames of the whole session.
    settings
        what is simulated.
    largest_terms
        terms that hold a shadow that must be drawn on a raster; 1, the fewest, before it is known.
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
    seconds = 2 * float(forming_seconds(forming, numbers, frames, _UNIT_COSTS))
    if 1 < largest_terms < math.inf:
        of_anchors = (settings.anchors > 1) * settings.anchors * settings.coarse_cells
        lit_cells = cells * len(settings.depths) + n * of_anchors
        seconds += 2 * frames * _READ_S * largest_terms * lit_cells * pixels
    each = n * _UNIT_COSTS.product + _MIXED_S if mixed else _FORMED_S
    return {
        "optics": seconds + 2 * count * pixels**2 * each,
        "sensor": _UNWRITTEN * frame_seconds(board, shots)["sensor"],
    }


def session_cost(board: Apparatus, count: int, settings: Settings, seconds: float, exposures: int = 1) -> Cost:
    """Memory, an upper estimate, and time of a session.

    Parameters
    ----------
    board, count, settings
        as for :func:`session_seconds`.
    seconds
        that it takes.
    exposures
        of every frame.
    """
    n, pixels = board.n, board.geometry.frame_side
    lines = n if lines_held(n, count, pixels) else 0
    at_work = _AT_WORK + _OF_AN_EXPOSURE * (exposures - 1)
    held = _HELD + (exposures if exposures > 1 else 0)  # and a pixel's weights
    frames = lines + 3 * at_once(pixels) + held + at_work * frames_at_once(round(pixels**2))
    memory_bytes = 8.0 * (frames * pixels**2 + _SUMS * count * pixels)
    return Cost(seconds=seconds, memory_bytes=light_bytes(board, n * n, settings) + memory_bytes)


# -------- Frames of a side's stripes
# Where frames of single lines can be held, those of patterns are mixed from them: by :class:`ExpectedFrames` up to
# 256 lines, and here beyond. Otherwise they are formed in lots: which pixels each of 512 patterns lights would be 2
# GiB.

_LINES_BYTES = 7 * 2**28
"""Frames of lines that are held at most, as of classes that are mixed."""
_COLUMNS = 2**14
"""Pixels of a product at a time: how a product is cut shows in its last bits, so not by the number of threads."""


def lines_held(lines: int, patterns: int, pixels: float) -> bool:
    """Whether frames of lines are held to be mixed into those of patterns.

    Parameters
    ----------
    lines, patterns
        how many there are of a side.
    pixels
        a side of the sensor.
    """
    return mixes(lines, patterns, pixels) or (patterns >= lines and 8 * lines * pixels**2 <= _LINES_BYTES)


def stripe_frames(
    light: SampledLight, stripes: Lighting, seed: int, shape: tuple[int, int], first: int
) -> Iterator[tuple[int, Frame]]:
    """Numbers and frames of patterns, without what black pixels leak.

    The same bits whatever is the first. Frames come without a Monte Carlo error.

    Parameters
    ----------
    light, seed
        by projector pixel, and the seed of its probes.
    stripes
        line of each projector pixel, and the power 0 or 1 of each line in every pattern.
    shape
        rows and columns of a frame.
    first
        number of the first pattern.
    """
    count, n = stripes.weights.shape
    lines, pixels = None, side_of(shape)
    if lines_held(n, count, pixels) and not mixes(n, count, pixels):
        lines = _stripe_lines(light, Lighting(stripes.labels, np.eye(n)), seed, shape)
    # Lots that hang on the sensor alone: what is formed together shows in the last bits.
    step = count if mixes(n, count, pixels) else at_once(pixels)
    for start in range(0, count, step):
        numbers = np.arange(start, min(start + step, count))
        if numbers[-1] < first:
            continue
        if lines is None:
            frames: Iterator[Frame] = iter(light.frames(stripes.shots(numbers), seed, leaking=False))
        else:
            frames = (Frame(frame, 0.0, 0.0, 0.0) for frame in _mix(stripes.weights[numbers], lines, shape))
        yield from (item for item in zip(numbers.tolist(), frames, strict=True) if item[0] >= first)


def _stripe_lines(light: SampledLight, lines: Lighting, seed: int, shape: tuple[int, int]) -> FloatArray | None:
    """(lines, m m') frames of single lines; None where one lost light below zero, which patterns would lack."""
    frames = np.empty((len(lines.weights), math.prod(shape)))
    for start in range(0, len(frames), step := at_once(side_of(shape))):
        numbers = np.arange(start, min(start + step, len(frames)))
        for number, frame in zip(numbers, light.frames(lines.shots(numbers), seed, leaking=False), strict=True):
            if frame.removed:
                return None
            frames[number] = frame.irradiance.ravel()
    return frames


def _mix(weights: FloatArray, lines: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """(patterns, m, m') sums of ``lines`` (lines, m m') by ``weights`` (patterns, lines), for frames of a ``shape``."""
    mixed = np.empty((len(weights), lines.shape[1]))

    def part(start: int) -> None:
        inside = slice(start, start + _COLUMNS)
        mixed[:, inside] = weights @ lines[:, inside]

    in_threads(part, range(0, lines.shape[1], _COLUMNS))
    return mixed.reshape(-1, *shape)
