"""A bench and a recipe in; what a rendered Hadamard calibration session on a white board shows, and its light, out.

The paper's procedure (section IV-A): every column h_i of a Hadamard matrix is shown as horizontal stripes h_i 1^T and
as vertical ones 1 h_i^T, each +-1 pattern as two shots (or one and a uniform one), all at one exposure, with sensor
noise. When n is no Hadamard order the next one is used and its first n rows: rows stay orthogonal.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
from PIL import Image

from mitsim.acquire.drift import levels
from mitsim.acquire.exposure import Exposer, camera_warnings, in_chunks
from mitsim.bench.bench import Apparatus
from mitsim.bench.board import before_board, missed_pixels
from mitsim.bench.request import Exposure
from mitsim.core.arrays import FloatArray
from mitsim.core.files import whole_file, write_json
from mitsim.core.job import Job
from mitsim.core.manifests import Digital
from mitsim.core.parallel import in_threads
from mitsim.core.resources import Cost
from mitsim.devices.camera import CameraGeometry, side_of
from mitsim.devices.framelist import LISTS, DarkFile, FrameList, StripeFile
from mitsim.devices.patterns import Lighting, PatternFamily, stripe_signs
from mitsim.devices.projector import Spectrum
from mitsim.devices.sensor import digital_of
from mitsim.devices.session import SIDES, UNIFORM, BoardShape, Half, SessionRecipe, taken
from mitsim.light.cost_model import FIXED, Numbers, forming_seconds
from mitsim.light.light import SampledLight, Sampling, trace_lines
from mitsim.light.passes import Simulation
from mitsim.light.pilot_result import Forming
from mitsim.light.plan import Plan
from mitsim.light.settings import Settings
from mitsim.optics.frames import Frame, at_once, mixes
from mitsim.optics.separable import best_term, centred
from mitsim.optics.shadow import Directions, SeparableTerms
from mitsim.optics.terms import shadow_terms
from mitsim.planner.memory import frame_seconds, frames_at_once, light_bytes
from mitsim.planner.planner import make_plan
from mitsim.reconstruct.captured_session import Chosen, Ladder
from mitsim.reconstruct.estimate_factors import SEPARABLE_RESIDUAL, decibels
from mitsim.sensor.chain import Digital as DigitalNumbers

_IN_RAYS = 0.5
"""Part of what no separable camera has, rms, that rays leave where the rest, three quarters of its energy, is said to
be of diffraction."""
_LINES = 4
"""Rows, and columns, of pixels that the plan looks at: chosen so that each quarter of the window shows."""


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
    """

    bench: Apparatus
    recipe: SessionRecipe
    seed: int = 0
    depth: float | None = None
    filters: FloatArray | None = None

    @property
    def distance(self) -> float:
        """From the sensor to the board's middle [mm]."""
        return self.depth or self.bench.geometry.scene_distance

    @cached_property
    def board(self) -> Apparatus:
        """The bench with the white board instead of its scene."""
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
        """What the best separable camera leaves of this one's shadow between projector pixels and sensor, where it is
        much, and what of it waves make. Stripes, whose lines add up, show less of it."""
        geometry, spectrum = self.bench.geometry, self.bench.spectrum
        rays = residual = best_term(self.shadow(geometry)).residual
        if geometry.few_wave_terms and spectrum is not None:
            residual = best_term(self.shadow(geometry, spectrum)).residual
        if residual <= SEPARABLE_RESIDUAL:
            return ()
        cause, remedy = "", "straighten the mask, or take a separable one"
        if rays < _IN_RAYS * residual:
            cause = f" by diffraction ({rays:.1%} without)"
            remedy = "take a separable mask, or one nearer to the sensor or of larger features"
        return (
            f"the mask ({geometry.mask_words}) is not separable{cause}: the best separable one leaves {residual:.1%} "
            f"of its shadow, {-decibels(residual):.1f} dB below it, and images of these factors lack it; {remedy}",
        )

    def shadow(self, geometry: CameraGeometry, spectrum: Spectrum | None = None) -> SeparableTerms:
        """The operator of a camera's ``geometry`` from projector pixels at the board's distance to the sensor, of
        transmissions: in rays, or in waves of a ``spectrum``; centred where frames are."""
        rows, columns = (
            Directions.cells(np.linspace(*edges, self.bench.n + 1)) for edges in self.bench.windows_at(self.distance)
        )
        terms = shadow_terms(geometry, rows, columns, self.distance, spectrum)
        return centred(terms) if self.centre else terms

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

    def filtered(self, light: FloatArray) -> FloatArray:
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
        return taken(self.signs.shape[1], self.pairs, self.recipe.order, self.recipe.order_seed)

    @cached_property
    def powers(self) -> Mapping[tuple[str, int], FloatArray]:
        """(exposures, repeats) power of the projector in frames of each shot, by side and number; 1 at the session's
        begin."""
        drift, order = self.recipe.drift, self.order
        each = len(order), len(self.recipe.exposure_ladder), self.recipe.repeats
        found = levels(self.seed, "session", math.prod(each), drift.session_ramp, drift.session_flicker).reshape(each)

        def shot(half: Half) -> tuple[str, int]:
            side, number, sign = half
            return side, 2 * number + (sign < 0) if self.pairs else number + (sign != UNIFORM)

        return {shot(half): power for half, power in zip(order, found, strict=True)}

    def plan(self, accuracy: float, job: Job) -> Plan:
        """What to simulate for responses of this relative ``accuracy``, and what the session takes.

        MitsimError when that is more memory or time than the ``job`` allows: before the look at the board, or after it.
        """
        n, count, starting = self.bench.n, self.signs.shape[1], job.clock.seconds()["total"]
        first = Settings(self.distance)
        seconds = session_seconds(self.board, count, self.shots, first)
        exposures = len(self.recipe.exposure_ladder)
        session_cost(self.board, count, first, sum(seconds.values()), exposures).check("calibration", job.limits)
        with job.planning("calibration"):
            plan = make_plan(self.board, _lines(n), accuracy, self.seed)
        seconds = session_seconds(self.board, count, self.shots, plan.settings)
        # There is no truth to be traced, and other frames are formed than those that the plan looks at.
        plan = plan.taking(start=starting, truth=0.0, **seconds)
        cost = session_cost(self.board, count, plan.settings, plan.predicted_seconds, exposures)
        cost.check("calibration", job.limits)
        return replace(plan, cost=cost)

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
        return [light.merged() for light in lights]

    def lit(self, light: SampledLight, job: Job) -> LitSession:
        """The session in the ``light`` that :meth:`trace` gave; ``job`` takes the time of choosing the exposure."""
        with job.clock.stage("optics"):
            white = next(iter(light.frames(Lighting.uniform(self.bench.n), self.seed)))
            exposure = Exposure(None, self.recipe.exposure_fraction)
            exposure_s = exposure.choose(self.bench.rig, float(self.filtered(white.irradiance).max()))
        stripes = PatternFamily("stripes", self.signs[:, 1:2].astype(np.int8), np.ones((self.bench.n, 1), np.int8))
        return LitSession(self, light, white, exposure_s, light.speckle(stripes))


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


# -------- A simulated session's frames in

MOST_TIFF = 2**16 - 1
"""Largest digital number of a 16-bit TIFF; frames of larger or real numbers become NPY."""


@dataclass(frozen=True, eq=False)
class KeptFrames:
    """Frames of a ``session`` in a ``folder`` that is held, called by the number at which they are taken."""

    session: Session
    folder: Path

    def write(self, names: tuple[str | int, ...], numbers: DigitalNumbers) -> None:
        """Write one frame.

        Parameters
        ----------
        names
            of its noise: side and number of the shot, or ``dark`` and numbers of exposure and frame; then ``exposure``
            and ``repeat``, each with its number where that is not 0.
        numbers
            (rows, columns) as read.
        """
        if names[0] == "dark":
            place = self._dark(int(names[1]), int(names[2]))
        else:
            options = dict(zip(names[2::2], names[3::2], strict=True))
            half = self._half(str(names[0]), int(names[1]))
            place = self._lit(half, int(options.get("exposure", 0)), int(options.get("repeat", 0)))
        with whole_file(self.folder / place) as part, part.open("wb") as file:
            if self._tiff:
                Image.fromarray(numbers.astype(np.uint16)).save(file, "TIFF")
            else:
                np.save(file, numbers)

    def finish(self, digital: Digital) -> None:
        """Write the list, when all frames are there; ``digital`` is of the shortest exposure."""
        recipe, exposures = self.session.recipe, range(len(self.session.recipe.exposure_ladder))
        listed = FrameList(
            camera=self.session.bench.identity(),
            n=self.session.bench.n,
            signed_capture=recipe.signed_capture,
            repeats=recipe.repeats,
            exposure_ladder=recipe.exposure_ladder,
            ladder_merge=recipe.ladder_merge,
            digital=digital,
            centre=self.session.centre,
            board_reflectance=recipe.board_reflectance,
            frames=tuple(
                StripeFile(
                    file=self._lit(half, exposure, repeat),
                    side=half[0],
                    index=half[1],
                    sign=half[2],
                    exposure=exposure,
                    repeat=repeat,
                )
                for half in self.session.order
                for exposure in exposures
                for repeat in range(recipe.repeats)
            ),
            dark=tuple(
                DarkFile(file=self._dark(exposure, number), exposure=exposure)
                for exposure in exposures
                for number in range(recipe.dark_frames)
            ),
        )
        write_json(self.folder / LISTS[1], listed.model_dump(mode="json", exclude_defaults=True))

    @cached_property
    def _tiff(self) -> bool:
        largest = self.session.bench.sensor.largest_dn
        return largest is not None and largest <= MOST_TIFF

    @cached_property
    def _numbers(self) -> dict[Half, int]:
        """At which number each is taken, of those with one exposure and no repeats."""
        return {half: number for number, half in enumerate(self.session.order)}

    def _half(self, side: str, index: int) -> Half:
        """What shot number ``index`` of a ``side`` shows."""
        (own,) = (known for known in SIDES if known == side)
        if self.session.pairs:
            return own, index // 2, -1 if index % 2 else 1
        return (own, index - 1, 1) if index else (own, 0, UNIFORM)

    def _lit(self, half: Half, exposure: int, repeat: int) -> str:
        recipe = self.session.recipe
        number = (self._numbers[half] * len(recipe.exposure_ladder) + exposure) * recipe.repeats + repeat
        return f"frame_{number:05d}{self._ending}"

    def _dark(self, exposure: int, number: int) -> str:
        return f"dark_{exposure * self.session.recipe.dark_frames + number:05d}{self._ending}"

    @property
    def _ending(self) -> str:
        return ".tif" if self._tiff else ".npy"


# -------- A calibration session whose light is traced in

Result = TypeVar("Result")
_NUMBERS_AT_ONCE = 2**15
"""Numbers of frames that become a response at a time: so few stay in the cache. Whole frames of a sensor of 2048 pixels
took ten times as long."""
SHOT, DARK, READ, ROUNDING = "shot noise", "dark current", "read noise", "quantisation"
"""Sources of a frame's noise."""


@dataclass(frozen=True)
class Response:
    """Response (m, m') to a +-1 pattern [electrons / s], how many of its shots had saturated pixels, and, of a pair,
    the sum of its two shots."""

    rate: FloatArray
    saturated: int = 0
    light: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class LitSession:
    """A session whose light is traced: its responses, with noise or without.

    Attributes
    ----------
    session
        what is shown.
    light
        of the board, by projector pixel.
    white
        expected frame of the uniform shot.
    exposure_s
        of every shot [s], the shortest where there are several.
    speckle
        contrast of laser speckle in the frames.
    kept
        where its frames are written to; None: nowhere.
    """

    session: Session
    light: SampledLight
    white: Frame
    exposure_s: float
    speckle: float
    kept: KeptFrames | None = None

    @property
    def response_noise(self) -> float:
        """Root mean square noise of a +-1 response [electrons / s], from the sensor's closed form."""
        return float(np.sqrt(np.mean([self.response_variance(side).mean() for side in SIDES])))

    def response_variance(self, side: str) -> FloatArray:
        """(m, m') mean noise variance of the responses of a ``side`` [(electrons / s)^2], in closed form."""
        variance: FloatArray = np.zeros(self.uniform_rate.shape)
        for parts in self.response_variances(side):
            for part in parts.values():
                variance += part
        return variance

    def response_variances(self, side: str) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
        """The same by source, (m, m') or one number each: what each response has of its own, and what all of
        the ``side`` share.

        Two shots of a pair share the uniform light L: variance (L + 2 D) / t + 2 R / t^2 with dark electrons D and the
        variance R of reading and rounding. 2 Y(positive) - Y(uniform) of a part p of the lines, about half, has
        (4 p L + 4 D) / t + 4 R / t^2 of its own; the uniform shot's (L + D) / t + R / t^2 is shared, and that of a dark
        frame's mean. Means of repeated shots have their number's part of it. Of several exposures each pixel has the
        sum of these by the squares of its weights.
        """
        sensor, recipe, ladder = self.session.bench.sensor, self.session.recipe, self.ladders[side]
        rounding = 0.0 if sensor.largest_dn is None else 1 / (12 * sensor.gain_dn_per_e**2)
        # As many times a uniform shot's light, and another shot's other noise, as a response has.
        lines, own_shots, shared_shots = (0.5, 2.0, 0.0) if self.session.pairs else (self.session.lit_lines, 4.0, 1.0)
        own, shared = (dict.fromkeys((SHOT, DARK, READ, ROUNDING), np.zeros(1)) for _ in range(2))
        for number, time in enumerate(self.exposures_s):
            weight: FloatArray | float = 1.0 if ladder.weights is None else np.square(ladder.weights[number])
            if self.session.filters is not None:
                weight = weight / np.square(self.session.filters)
            single: dict[str, FloatArray | float] = {
                SHOT: self.session.filtered(self.uniform_rate) / time,
                DARK: sensor.superpixel_dark_current_e_per_s / time,
                READ: sensor.superpixel_reading_noise_e**2 / time**2,
                ROUNDING: rounding / time**2,
            }
            for source, one in single.items():
                part = lines if source == SHOT else 1.0
                own[source] = own[source] + own_shots * part * weight * one / recipe.repeats
                shots = shared_shots / recipe.repeats
                if source != SHOT and recipe.dark_frames:
                    shots += 1 / recipe.dark_frames
                shared[source] = shared[source] + shots * weight * one
        return own, shared

    def each(self, side: str, use: Callable[[tuple[int, Frame]], Result], job: Job, first: int = 0) -> Iterator[Result]:
        """What a function makes of the +-1 patterns of a side, in order, some at a time in a thread each.

        Parameters
        ----------
        side
            ``horizontal`` or ``vertical`` stripes.
        use
            of a pattern's number and the expected frame of its +1 pixels. Number 0 is the uniform pattern.
        job
            takes the time and is told how far it is.
        first
            number of the first pattern.
        """

        def used(item: tuple[int, Frame]) -> Result:
            number, frame = item
            return use((number, self._leaking(frame) if number else frame))

        chunks = in_chunks(self._formed(side, first))
        while True:
            with job.clock.stage("optics"):
                chunk = next(chunks, None)
            if chunk is None:
                return
            with job.clock.stage("sensor"):
                results = in_threads(used, chunk)
            job.progress(f"{side} stripes", (chunk[-1][0] + 1) / self.session.signs.shape[1])
            yield from results

    def _formed(self, side: str, first: int) -> Iterator[tuple[int, Frame]]:
        """Numbers and frames from ``first`` on, without what black pixels leak; none is formed for number 0."""
        if first == 0:
            yield 0, self.white
        n = self.session.bench.n
        row, column = np.divmod(np.arange(n * n), n)
        stripes = Lighting(row if side == "horizontal" else column, (1.0 + self.session.signs.T) / 2)
        shape = self.session.bench.geometry.frame_shape
        yield from stripe_frames(self.light, stripes, self.session.seed, shape, max(first, 1))

    def _leaking(self, frame: Frame) -> Frame:
        """The ``frame`` with the light of black pixels: to form it with them would be twice the work."""
        black = self.light.simulation.physics.black_level
        if not black:
            return frame
        light = (1 - black) * frame.irradiance
        light += self._leaked
        return replace(frame, irradiance=light)

    @cached_property
    def _leaked(self) -> FloatArray:
        """(m, m') light of all pixels when they are black [W m^-2]."""
        return np.asarray(self.light.simulation.physics.black_level * self.white.irradiance)

    def noisy(self, side: str, number: int, frame: Frame) -> Response:
        """Response to a +-1 pattern as a user of noisy frames has it.

        Parameters
        ----------
        side
            ``horizontal`` or ``vertical`` stripes.
        number, frame
            of the pattern, as :meth:`each` has them.
        """
        if not self.session.pairs:
            shot, uniform = self._exposed(frame.irradiance, side, number + 1), self._uniform[side]
            rate = self._rates(lambda rows: 2 * self._rate(shot, rows) - uniform.rate[rows], shot)
            if self._dark is not None:
                rate -= self._dark[side]
            return Response(rate, shot.saturated + (uniform.saturated if number == 0 else 0))
        negative = self._both - frame.irradiance
        shots = (
            self._exposed(frame.irradiance, side, 2 * number),
            # Rounding leaves pixels that see the +1 stripes alone a little below zero.
            self._exposed(np.maximum(negative, 0.0, out=negative), side, 2 * number + 1),
        )
        light: FloatArray = np.empty(frame.irradiance.shape)

        def difference(rows: slice) -> FloatArray:
            one, other = self._rate(shots[0], rows), self._rate(shots[1], rows)
            np.add(one, other, out=light[rows])
            return one - other

        rate = self._rates(difference, shots[0])
        return Response(rate, sum(shot.saturated for shot in shots), light)

    def noise_free(self, frame: Frame) -> FloatArray:
        """(m, m') the same of the expected ``frame``: 2 Y((1 + P)/2) - Y(1)."""
        rate = self._second.electrons(frame)
        rate *= 2
        rate -= self.uniform_rate
        return rate

    @property
    def _second(self) -> Exposer:
        """An exposure of one second, whose electrons are rates."""
        return Exposer(self.session.bench.rig, 1.0, self.session.seed)

    @cached_property
    def exposures_s(self) -> tuple[float, ...]:
        """Every exposure of a frame [s]."""
        return tuple(self.exposure_s * factor for factor in self.session.recipe.exposure_ladder)

    @cached_property
    def _exposers(self) -> tuple[Exposer, ...]:
        bench = self.session.bench
        return tuple(Exposer(bench.rig, time, self.session.seed, self.speckle) for time in self.exposures_s)

    @cached_property
    def ladders(self) -> Mapping[str, Ladder]:
        """How frames of several exposures of a side are merged: by the first uniform frame of the other one, which
        shares no noise with them."""
        digitals = tuple(digital_of(self.session.bench.sensor, time) for time in self.exposures_s)
        if len(digitals) == 1:
            return {side: Ladder(digitals) for side in SIDES}
        recipe, found = self.session.recipe, dict[str, Ladder]()
        for side, other in zip(SIDES, reversed(SIDES), strict=True):
            uniform, _ = self._repeated(self._lit(self.white.irradiance, 0, other, 0), 0, True, other, 0)
            rate = self._exposers[0].rate(uniform)
            found[side] = Ladder.of(digitals, rate, recipe.repeats, recipe.ladder_merge)
        return found

    @cached_property
    def _dark(self) -> Mapping[str, FloatArray] | None:
        """(m, m') rate of the mean dark frame, as each side's frames are merged; None where none is taken."""
        number = self.session.recipe.dark_frames
        if not number:
            return None
        still = np.zeros(self.white.irradiance.shape)
        rates = []
        for exposure, exposer in enumerate(self._exposers):
            total = np.zeros(still.shape)
            for index in range(number):
                total += self._read(exposer, still, "dark", exposure, index)
            rates.append(exposer.rate(total / number))
        return {side: self._unfiltered(ladder.merged(rates)) for side, ladder in self.ladders.items()}

    @cached_property
    def uniform_rate(self) -> FloatArray:
        """(m, m') expected photoelectrons a second of the uniform frame."""
        return self._second.electrons(self.white)

    @cached_property
    def _both(self) -> FloatArray:
        """(m, m') light of a pair's two shots together [W m^-2]: all of it, and what black pixels leak."""
        n = self.session.bench.n
        off = Lighting(np.zeros(n * n, dtype=np.int64), np.zeros((1, 1)))
        (dark,) = self.light.frames(off, self.session.seed)
        return np.asarray(self.white.irradiance + dark.irradiance)

    @cached_property
    def _uniform(self) -> Mapping[str, Response]:
        """Noisy uniform frames, from which each side's responses are taken where they are no pairs."""
        shots = {side: self._exposed(self.white.irradiance, side, 0) for side in SIDES}
        return {side: Response(self._rate(shot, slice(None)), shot.saturated) for side, shot in shots.items()}

    def _exposed(self, irradiance: FloatArray, side: str, index: int) -> _Shot:
        """The noisy frames of shot number ``index`` of a ``side``, of expected ``irradiance`` (m, m')."""
        ladder = self.ladders[side]
        found = [
            self._repeated(self._lit(irradiance, exposure, side, index), exposure, ladder.used(exposure), side, index)
            for exposure in range(len(self._exposers))
        ]
        return _Shot(ladder, tuple(digital for digital, _ in found), sum(saturated for _, saturated in found))

    def _lit(self, irradiance: FloatArray, exposure: int, *names: str | int) -> FloatArray:
        """Expected electrons of a shot. Speckle of a board at rest is the same in all repeats and exposures."""
        passed = Frame(self.session.filtered(irradiance), 0.0, 0.0, 0.0)
        return self._exposers[exposure].lit(passed, "calibration", *names)

    def _repeated(
        self, lit: FloatArray, exposure: int, used: Chosen, side: str, index: int
    ) -> tuple[DigitalNumbers, int]:
        """The mean of all repeats of a shot at one exposure, and how many have saturated pixels that are used.

        Parameters
        ----------
        lit
            expected electrons.
        exposure, side, index
            numbers of the exposure and of the shot.
        used
            pixels that count.
        """
        exposer, repeats = self._exposers[exposure], self.session.recipe.repeats
        names: tuple[str | int, ...] = (side, index)
        names += ("exposure", exposure) if exposure else ()

        powers = self.session.powers[side, index][exposure]

        def read(repeat: int) -> tuple[DigitalNumbers, int]:
            light = powers[repeat] * lit
            digital = self._read(exposer, light, *names, *(("repeat", repeat) if repeat else ()))
            if used is True:
                return digital, int(exposer.saturated(digital, light))
            return digital, int(exposer.saturated(np.where(used, digital, 0), np.where(used, light, 0.0)))

        digital, count = read(0)
        if repeats == 1:
            return digital, count
        mean = digital.astype(np.float64)
        for repeat in range(1, repeats):
            digital, saturated = read(repeat)
            count += saturated
            mean += digital
        mean /= repeats
        return mean, count

    def _read(self, exposer: Exposer, lit: FloatArray, *names: str | int) -> DigitalNumbers:
        """One noisy frame, which is kept where frames are; ``names`` find its noise."""
        digital = exposer.digital(lit, "calibration", *names)
        if self.kept is not None:
            self.kept.write(names, digital)
        return digital

    def _rate(self, shot: _Shot, rows: slice) -> FloatArray:
        """Rates of some ``rows`` of a ``shot``."""
        each = zip(self._exposers, shot.digital, strict=True)
        merged = shot.ladder.merged((exposer.rate(digital[rows]) for exposer, digital in each), rows)
        return self._unfiltered(merged, rows)

    def _unfiltered(self, rate: FloatArray, rows: slice = slice(None)) -> FloatArray:
        """What pixels without filters would read, from the ``rate`` of some ``rows``."""
        return rate if self.session.filters is None else rate / self.session.filters[rows]

    @staticmethod
    def _rates(of: Callable[[slice], FloatArray], shot: _Shot) -> FloatArray:
        """(m, m') rates of all rows by those ``of`` some, a few at a time: their arrays stay in the cache."""
        rates: FloatArray = np.empty(shot.digital[0].shape)
        step = max(1, _NUMBERS_AT_ONCE // rates.shape[1])
        for start in range(0, len(rates), step):
            rows = slice(start, start + step)
            rates[rows] = of(rows)
        return rates


@dataclass(frozen=True, eq=False)
class _Shot:
    """Noisy frames (m, m'), of each exposure the mean of its repeats, which a ``ladder`` merges; how many of
    all have ``saturated`` pixels."""

    ladder: Ladder
    digital: tuple[DigitalNumbers, ...]
    saturated: int


# -------- What a calibration session takes

_PACES = replace(FIXED, product=1.1e-11)
"""A multiplication of products as large as those of stripes: half of what it takes in small ones (2048 pixels a side,
two processors)."""
_MIXED_S, _FORMED_S = 3e-8, 1e-8
"""A pixel of a frame that is mixed or formed beside its multiplications: memory that is read and taken anew (sensors of
512 and 1024 pixels mixed, of 2048 formed; processor seconds, halved for two processors)."""
_HELD, _AT_WORK = 5.0, 5.0
"""Frames in double precision: those that a session holds (the uniform one, its rate, a pair's both shots together, two
noisy uniform ones), and what each response takes that is worked on (light of two shots, their numbers, rates)."""
_OF_AN_EXPOSURE = 2.0
"""Frames more of a response for each exposure beyond the first: numbers of two shots, and one shot's electrons."""
_SUMS = 8.0
"""Numbers of a side's sums for each pattern and pixel of a side of the sensor: of two sides and two kinds of responses,
and once more while they are saved."""


def session_seconds(board: Apparatus, count: int, shots: int, settings: Settings) -> dict[str, float]:
    """Seconds of forming the stripes of a session, and of exposing its shots and adding up responses.

    Parameters
    ----------
    board
        the bench with the board.
    count, shots
        +-1 patterns of a side, and frames of the whole session.
    settings
        what is simulated.
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
        correlated=(board.geometry.drawn(waves=False), board.geometry.drawn(board.geometry.diffracts)),
    )
    numbers = replace(Numbers.of(settings), mixed=0.0)  # what black pixels leak is added to frames
    seconds = 2 * float(forming_seconds(forming, numbers, n if mixed else count, _PACES))
    each = n * _PACES.product + _MIXED_S if mixed else _FORMED_S
    return {"optics": seconds + 2 * count * pixels**2 * each, "sensor": frame_seconds(board, shots)["sensor"]}


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


# -------- Light by projector pixel and a side's stripes in

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
            frames = (Frame(frame, 0.0, 0.0, 0.0) for frame in _mixed(stripes.weights[numbers], lines, shape))
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


def _mixed(weights: FloatArray, lines: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """(patterns, m, m') sums of ``lines`` (lines, m m') by ``weights`` (patterns, lines), for frames of a ``shape``."""
    mixed = np.empty((len(weights), lines.shape[1]))

    def part(start: int) -> None:
        inside = slice(start, start + _COLUMNS)
        mixed[:, inside] = weights @ lines[:, inside]

    in_threads(part, range(0, lines.shape[1], _COLUMNS))
    return mixed.reshape(-1, *shape)
