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
from mitsim.core.arrays import FloatArray, in_threads
from mitsim.core.files import whole_file, write_json
from mitsim.core.job import Job
from mitsim.core.manifests import Digital
from mitsim.devices.framelist import LISTS, FrameList, StripeFile
from mitsim.devices.patterns import Lighting, PatternFamily
from mitsim.devices.session import SIDES
from mitsim.light.light import SampledLight
from mitsim.optics.frames import Frame
from mitsim.sensor.chain import Digital as DigitalNumbers

Result = TypeVar("Result")
SHOT, DARK, READ, ROUNDING = "shot noise", "dark current", "read noise", "quantisation"
"""Sources of a frame's noise."""
MOST_TIFF = 2**16 - 1
"""Largest digital number of a 16-bit TIFF; frames with larger or real numbers become NPY."""


class KeptFrames:
    """Folder of a session's frames, as a real camera's user has them."""

    def __init__(self, session: Session, folder: Path) -> None:
        self._session, self._folder, largest = session, folder, session.bench.sensor.largest_dn
        self._tiff = largest is not None and largest <= MOST_TIFF
        self._files: dict[tuple[str, int, int], StripeFile] = {}
        for (side, index, sign), repeat in product(session.order, range(session.recipe.repeats)):
            file = f"frame_{len(self._files):05d}.{'tif' if self._tiff else 'npy'}"
            listed = StripeFile(file=file, side=side, index=index, sign=sign, repeat=repeat)
            self._files[(*session.shot((side, index, sign)), repeat)] = listed

    def write(self, shot: tuple[str, int, int], numbers: DigitalNumbers) -> None:
        with whole_file(self._folder / self._files[shot].file) as part, part.open("wb") as file:
            if self._tiff:
                Image.fromarray(numbers.astype(np.uint16)).save(file, "TIFF")
            else:
                np.save(file, numbers)

    def finish(self, digital: Digital) -> None:
        bench, recipe = self._session.bench, self._session.recipe
        listed = FrameList(
            camera=bench.identity(),
            n=bench.n,
            signed_capture=recipe.signed_capture,
            repeats=recipe.repeats,
            digital=digital,
            centre=self._session.centre,
            board_reflectance=recipe.board_reflectance,
            frames=tuple(self._files.values()),
        )
        write_json(self._folder / LISTS[1], listed.model_dump(mode="json", exclude_defaults=True))


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
        """Standard deviation of a number of a response [electrons / s], its mean over all pixels."""
        total: FloatArray = np.zeros(self.uniform_rate.shape)
        for parts in self.response_variances():
            for part in parts.values():
                total += part
        return float(np.sqrt(total.mean()))

    def response_variances(self) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
        """Return noise variances [(electrons / s)^2], (m, m') or one number: each response's own, and a side's shared.

        Two shots of a pair share the uniform light L: variance (L + 2 D) / t + 2 R / t^2 with dark electrons D and the
        variance R of reading and rounding. 2 Y(positive) - Y(uniform) for a part p of the lines has (4 p L + 4 D) / t +
        4 R / t^2 of its own; the uniform shot's (L + D) / t + R / t^2 is shared. Means of repeats have the
        corresponding part.
        """
        session, sensor, time = self.session, self.session.bench.sensor, self.exposure_s
        rounding = 0.0 if sensor.largest_dn is None else 1 / (12 * sensor.gain_dn_per_e**2)
        single: dict[str, FloatArray | float] = {
            SHOT: session.through_filters(self.uniform_rate) / time,
            DARK: sensor.superpixel_dark_current_e_per_s / time,
            READ: sensor.superpixel_reading_noise_e**2 / time**2,
            ROUNDING: rounding / time**2,
        }
        # As many times a uniform shot's light, and another shot's other noise, as a response has.
        lines, own_shots, shared_shots = (0.5, 2.0, 0.0) if session.pairs else (session.lit_lines, 4.0, 1.0)
        weight = 1.0 if session.filters is None else 1.0 / np.square(session.filters)
        own, shared = {}, {}
        for source, one in single.items():
            part = lines if source == SHOT else 1.0
            own[source] = np.asarray(own_shots * part * weight * one / session.recipe.repeats)
            shared[source] = np.asarray(shared_shots / session.recipe.repeats * weight * one)
        return own, shared

    def each(self, side: str, use: Callable[[tuple[int, Frame]], Result], job: Job, first: int = 0) -> Iterator[Result]:
        """Apply ``use`` to number and expected frame of the +-1 patterns of a ``side``, in threads.

        Results are in order. Number 0 is the uniform pattern; the frame is that of a pattern's +1 pixels.
        """
        black = self.light.simulation.physics.black_level

        def use_response(item: tuple[int, Frame]) -> Result:
            number, frame = item
            if number and black:
                lit = (1 - black) * frame.irradiance + black * self.white.irradiance
                frame = replace(frame, irradiance=lit)
            return use((number, frame))

        job.progress(f"{side} stripes", first / self.session.signs.shape[1])
        chunks = in_chunks(self.stripes(side, first))
        while True:
            with job.clock.stage("optics"):
                chunk = next(chunks, None)
            if chunk is None:
                return
            with job.clock.stage("sensor"):
                results = in_threads(use_response, chunk)
            job.progress(f"{side} stripes", (chunk[-1][0] + 1) / self.session.signs.shape[1])
            yield from results

    def stripes(self, side: str, first: int) -> Iterator[tuple[int, Frame]]:
        """Yield numbers and frames of the +1 pixels of a ``side``'s patterns, without light of black pixels."""
        if first == 0:
            yield 0, self.white
        n = self.session.bench.n
        row, column = np.divmod(np.arange(n * n), n)
        stripes = Lighting(row if side == "horizontal" else column, (1.0 + self.session.signs.T) / 2)
        shape = self.session.bench.geometry.frame_shape
        yield from stripe_frames(self.light, stripes, self.session.seed, shape, max(first, 1))

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
        total: DigitalNumbers | FloatArray = np.zeros(0)
        for repeat, power in enumerate(session.powers[side, index]):
            names = ("repeat", repeat) if repeat else ()
            light = power * lit
            digital = exposer.digital(light, "calibration", side, index, *names)
            if self.kept is not None:
                self.kept.write((side, index, repeat), digital)
            saturated += int(exposer.saturates(digital, light))
            total = total + digital if repeat else digital if repeats == 1 else digital.astype(np.float64)
        rate = exposer.rate(total if repeats == 1 else total / repeats)
        return rate if session.filters is None else rate / session.filters, saturated
