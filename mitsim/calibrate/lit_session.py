"""Noisy and noise-free responses of a calibration session with traced light, and its frames.

Written frames contain only the data of a real session: digital numbers, patterns and camera settings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import TypeVar

import numpy as np
from PIL import Image

from mitsim.acquire.exposure import Exposer, in_chunks
from mitsim.bench.request import Exposure
from mitsim.calibrate.board_session import Session, stripe_frames
from mitsim.core.arrays import FloatArray
from mitsim.core.files import whole_file, write_json
from mitsim.core.job import Job
from mitsim.core.manifests import Digital
from mitsim.core.parallel import in_threads
from mitsim.devices.framelist import LISTS, DarkFile, FrameList, StripeFile
from mitsim.devices.patterns import Lighting, PatternFamily
from mitsim.devices.sensor import digital_of
from mitsim.devices.session import SIDES
from mitsim.light.light import SampledLight
from mitsim.optics.frames import Frame
from mitsim.reconstruct.captured_session import Chosen, Ladder
from mitsim.sensor.chain import Digital as DigitalNumbers

Result = TypeVar("Result")
_NUMBERS_AT_ONCE = 2**15
"""Numbers that become a response at a time, so that they stay in the cache."""
SHOT, DARK, READ, ROUNDING = "shot noise", "dark current", "read noise", "quantisation"
"""Sources of a frame's noise."""


# ---- Frames as a real camera's user has them ----

MOST_TIFF = 2**16 - 1
"""Largest digital number of a 16-bit TIFF; frames with larger or real numbers become NPY."""
Names = tuple[str | int, ...]
"""Side and number of a frame's shot, or ``dark`` with numbers of exposure and frame."""


def repeat_names(shot: tuple[str, int], exposure: int, repeat: int) -> Names:
    own: Names = ("exposure", exposure) if exposure else ()
    return (*shot, *own, "repeat", repeat) if repeat else (*shot, *own)


class KeptFrames:
    def __init__(self, session: Session, folder: Path) -> None:
        self._session, self._folder, recipe = session, folder, session.recipe
        largest = session.bench.sensor.largest_dn
        self._tiff = largest is not None and largest <= MOST_TIFF
        end, exposures = ".tif" if self._tiff else ".npy", range(len(recipe.exposure_ladder))
        self._lit: dict[Names, StripeFile] = {}
        for half, exposure, repeat in product(session.order, exposures, range(recipe.repeats)):
            names, (side, index, sign) = repeat_names(session.shot(half), exposure, repeat), half
            file = f"frame_{len(self._lit):05d}{end}"
            self._lit[names] = StripeFile(
                file=file, side=side, index=index, sign=sign, exposure=exposure, repeat=repeat
            )
        self._dark: dict[Names, DarkFile] = {}
        for exposure, number in product(exposures, range(recipe.dark_frames)):
            file = f"dark_{len(self._dark):05d}{end}"
            self._dark["dark", exposure, number] = DarkFile(file=file, exposure=exposure)

    def write(self, names: Names, numbers: DigitalNumbers) -> None:
        place = (self._dark if names[0] == "dark" else self._lit)[names].file
        with whole_file(self._folder / place) as part, part.open("wb") as file:
            if self._tiff:
                Image.fromarray(numbers.astype(np.uint16)).save(file, "TIFF")
            else:
                np.save(file, numbers)

    def finish(self, digital: Digital) -> None:
        session, recipe = self._session, self._session.recipe
        listed = FrameList(
            camera=session.bench.identity(),
            n=session.bench.n,
            signed_capture=recipe.signed_capture,
            repeats=recipe.repeats,
            exposure_ladder=recipe.exposure_ladder,
            ladder_merge=recipe.ladder_merge,
            digital=digital,
            centre=session.centre,
            board_reflectance=recipe.board_reflectance,
            frames=tuple(self._lit.values()),
            dark=tuple(self._dark.values()),
        )
        write_json(self._folder / LISTS[1], listed.model_dump(mode="json", exclude_defaults=True))


# ---- Responses ----


@dataclass(frozen=True)
class Response:
    """Response (m, m') to a +-1 pattern [electrons / s], its saturated shots, and the sum of a pair."""

    rate: FloatArray
    saturated: int = 0
    light: FloatArray | None = None


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
        Exposure time of every shot [s], the shortest of several.
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
    kept: KeptFrames | None = None

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
        return float(np.sqrt(np.mean([self.response_variance(side).mean() for side in SIDES])))

    def response_variance(self, side: str) -> FloatArray:
        """Return the (m, m') sum of :meth:`response_variances` [(electrons / s)^2]."""
        variance: FloatArray = np.zeros(self.uniform_rate.shape)
        for parts in self.response_variances(side):
            for part in parts.values():
                variance += part
        return variance

    def response_variances(self, side: str) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
        """Return noise variances, (m, m') or one number: each response's own, and that shared by the ``side``.

        Two shots of a pair share the uniform light L: variance (L + 2 D) / t + 2 R / t^2 with dark electrons D and the
        variance R of reading and rounding. 2 Y(positive) - Y(uniform) for a part p of the lines has (4 p L + 4 D) / t +
        4 R / t^2 of its own; the uniform shot's (L + D) / t + R / t^2 and that of a dark frame's mean are shared. Means
        of repeats have the corresponding part. With several exposures, each pixel has the sum weighted by the squares
        of its weights.
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
                SHOT: self.session.through_filters(self.uniform_rate) / time,
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
        """Apply ``use`` to number and expected frame of the +-1 patterns of a ``side``, in threads.

        Results are in order. Number 0 is the uniform pattern; the frame is that of a pattern's +1 pixels.
        """
        black = self.light.simulation.physics.black_level
        leak = black * self.white.irradiance

        def use_response(item: tuple[int, Frame]) -> Result:
            number, frame = item
            if number and black:
                frame = replace(frame, irradiance=(1 - black) * frame.irradiance + leak)
            return use((number, frame))

        job.progress(f"{side} stripes", first / self.session.signs.shape[1])
        chunks = in_chunks(self._stripes(side, first))
        while True:
            with job.clock.stage("optics"):
                chunk = next(chunks, None)
            if chunk is None:
                return
            with job.clock.stage("sensor"):
                results = in_threads(use_response, chunk)
            job.progress(f"{side} stripes", (chunk[-1][0] + 1) / self.session.signs.shape[1])
            yield from results

    def _stripes(self, side: str, first: int) -> Iterator[tuple[int, Frame]]:
        if first == 0:
            yield 0, self.white
        n = self.session.bench.n
        row, column = np.divmod(np.arange(n * n), n)
        stripes = Lighting(row if side == "horizontal" else column, (1.0 + self.session.signs.T) / 2)
        shape = self.session.bench.geometry.frame_shape
        yield from stripe_frames(self.light, stripes, self.session.seed, shape, max(first, 1))

    def noisy(self, side: str, number: int, frame: Frame) -> Response:
        rate: FloatArray = np.empty(frame.irradiance.shape)
        if not self.session.pairs:
            shot, uniform = self._expose(frame.irradiance, side, number + 1), self._uniform[side]
            for rows in _chunks(rate):
                rate[rows] = 2 * self._rate(shot, rows) - uniform.rate[rows]
            if self._dark is not None:
                rate -= self._dark[side]
            return Response(rate, shot.saturated + (uniform.saturated if number == 0 else 0))
        negative, light = self._both - frame.irradiance, np.empty_like(rate)
        one = self._expose(frame.irradiance, side, 2 * number)
        # Rounding leaves pixels that see the +1 stripes alone a little below zero.
        other = self._expose(np.maximum(negative, 0.0, out=negative), side, 2 * number + 1)
        for rows in _chunks(rate):
            both = self._rate(one, rows), self._rate(other, rows)
            np.add(*both, out=light[rows])
            np.subtract(*both, out=rate[rows])
        return Response(rate, one.saturated + other.saturated, light)

    def noise_free(self, frame: Frame) -> FloatArray:
        """Return the (m, m') response from the expected ``frame``: 2 Y((1 + P)/2) - Y(1)."""
        rate = self._second.electrons(frame)
        rate *= 2
        rate -= self.uniform_rate
        return rate

    @property
    def _second(self) -> Exposer:
        return Exposer(self.session.bench.devices, 1.0, self.session.seed)

    @cached_property
    def exposures_s(self) -> tuple[float, ...]:
        return tuple(self.exposure_s * factor for factor in self.session.recipe.exposure_ladder)

    @cached_property
    def _exposers(self) -> tuple[Exposer, ...]:
        bench = self.session.bench
        return tuple(Exposer(bench.devices, time, self.session.seed, self.speckle) for time in self.exposures_s)

    @cached_property
    def ladders(self) -> Mapping[str, Ladder]:
        """Return how frames of several exposures of a side are merged.

        The first uniform frame of the other side is used because it shares no noise with them.
        """
        digitals = tuple(digital_of(self.session.bench.sensor, time) for time in self.exposures_s)
        if len(digitals) == 1:
            return {side: Ladder(digitals) for side in SIDES}
        recipe, found = self.session.recipe, dict[str, Ladder]()
        for side, other in zip(SIDES, reversed(SIDES), strict=True):
            uniform, _ = self._mean_of_repeats(self.white.irradiance, 0, True, other, 0)
            rate = self._exposers[0].rate(uniform)
            found[side] = Ladder.of(digitals, rate, recipe.repeats, recipe.ladder_merge)
        return found

    @cached_property
    def _dark(self) -> Mapping[str, FloatArray] | None:
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
        return {side: self._without_filters(ladder.merge(rates)) for side, ladder in self.ladders.items()}

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
    def _uniform(self) -> Mapping[str, Response]:
        shots = {side: self._expose(self.white.irradiance, side, 0) for side in SIDES}
        return {side: Response(self._rate(shot, slice(None)), shot.saturated) for side, shot in shots.items()}

    def _expose(self, irradiance: FloatArray, side: str, index: int) -> _Shot:
        ladder = self.ladders[side]
        found = [
            self._mean_of_repeats(irradiance, exposure, ladder.used_pixels(exposure), side, index)
            for exposure in range(len(self._exposers))
        ]
        return _Shot(ladder, tuple(digital for digital, _ in found), sum(saturated for _, saturated in found))

    def _mean_of_repeats(
        self, irradiance: FloatArray, exposure: int, used: Chosen, side: str, index: int
    ) -> tuple[DigitalNumbers, int]:
        """Return the mean digital numbers of a shot at one exposure, and its frames with saturated ``used`` pixels."""
        exposer, repeats, count = self._exposers[exposure], self.session.recipe.repeats, 0
        passed = Frame(self.session.through_filters(irradiance), 0.0, 0.0, 0.0)
        lit = exposer.shot_electrons(passed, "calibration", side, index)
        mean: FloatArray = np.zeros(0)
        for repeat, power in enumerate(self.session.powers[side, index][exposure]):
            light = power * lit
            digital = self._read(exposer, light, *repeat_names((side, index), exposure, repeat))
            shown = (digital, light) if used is True else (np.where(used, digital, 0), np.where(used, light, 0.0))
            count += int(exposer.saturates(*shown))
            if repeats == 1:
                return digital, count
            mean = mean + digital if repeat else digital.astype(np.float64)
        mean /= repeats
        return mean, count

    def _read(self, exposer: Exposer, lit: FloatArray, *names: str | int) -> DigitalNumbers:
        digital = exposer.digital(lit, "calibration", *names)
        if self.kept is not None:
            self.kept.write(names, digital)
        return digital

    def _rate(self, shot: _Shot, rows: slice) -> FloatArray:
        each = zip(self._exposers, shot.digital, strict=True)
        merged = shot.ladder.merge((exposer.rate(digital[rows]) for exposer, digital in each), rows)
        return self._without_filters(merged, rows)

    def _without_filters(self, rate: FloatArray, rows: slice = slice(None)) -> FloatArray:
        return rate if self.session.filters is None else rate / self.session.filters[rows]


@dataclass(frozen=True, eq=False)
class _Shot:
    ladder: Ladder
    digital: tuple[DigitalNumbers, ...]
    saturated: int


def _chunks(rates: FloatArray) -> Iterator[slice]:
    step = max(1, _NUMBERS_AT_ONCE // rates.shape[1])
    return (slice(start, start + step) for start in range(0, len(rates), step))
