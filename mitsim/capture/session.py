"""A rendered Hadamard calibration session on a white board: from a bench to the camera's responses to striped light.

The paper's procedure (section IV-A): every column h_i of a Hadamard matrix is shown as horizontal stripes h_i 1^T and
as vertical ones 1 h_i^T, each +-1 pattern as two shots (or one and a uniform one), all at one exposure, with sensor
noise. When n is no Hadamard order the next one is used and its first n rows: rows stay orthogonal.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

import numpy as np

from mitsim.capture.bench import Bench
from mitsim.capture.cost import frame_seconds, frames_bytes, frames_cost
from mitsim.capture.exposer import Exposer, in_chunks
from mitsim.capture.light import Light, Sampling, trace_light
from mitsim.capture.plan import Plan
from mitsim.capture.planning import make_plan
from mitsim.capture.request import Exposure
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.core.parallel import in_threads
from mitsim.optics.frames import ExpectedFrames, Frame
from mitsim.rig.patterns import Lighting, hadamard_matrix
from mitsim.rig.recipe import SessionRecipe

SIDES = ("horizontal", "vertical")
_LINES = 4
"""Rows, and columns, of pixels that the plan looks at: chosen so that each quarter of the window shows."""


@dataclass(frozen=True)
class Session:
    """What a calibration session shows, of a ``bench`` by a ``recipe``; its noise and light come from ``seed``."""

    bench: Bench
    recipe: SessionRecipe
    seed: int = 0

    @cached_property
    def board(self) -> Bench:
        """The bench with the white board instead of its scene."""
        return self.bench.with_board(self.recipe.board_reflectance)

    @property
    def centre(self) -> bool:
        """Whether row and column means are taken out of every response, for a FlatCam mask."""
        return self.bench.geometry.mask == "flatcam"

    @cached_property
    def signs(self) -> FloatArray:
        """(n, N) first n rows of the smallest Hadamard matrix that has them; column 0 is all +1."""
        n = self.bench.n
        for order in range(n, 2 * n + 1):  # with a power of two among them
            try:
                return hadamard_matrix(order)[:n].astype(np.float64)
            except MitsimError:
                continue
        raise MitsimError(f"no Hadamard matrix for {n} projector pixels; use another number of pixels")

    @property
    def pairs(self) -> bool:
        """Whether a +-1 pattern is the difference of two shots, and not taken from one and a uniform shot."""
        return self.recipe.signed_capture == "pair"

    @cached_property
    def weights(self) -> FloatArray:
        """(shots, n) power of each stripe in the shots of one side."""
        n, count = self.signs.shape
        positive = (1.0 + self.signs.T) / 2
        if self.pairs:
            return np.stack([positive, 1 - positive], axis=1).reshape(2 * count, n)
        return np.concatenate([np.ones((1, n)), positive])

    @property
    def shots(self) -> int:
        """Frames of the whole session."""
        return 2 * len(self.weights)

    def plan(self, accuracy: float, job: Job) -> Plan:
        """What to simulate for responses of this relative ``accuracy``.

        MitsimError when the session would take more memory or time than the ``job`` allows.
        """
        n = self.bench.n
        with job.clock.stage("plan"):
            plan = make_plan(self.board, _lines(n), accuracy, self.seed)
        by_pixel = Lighting(np.arange(n * n), np.broadcast_to(1.0, (self.shots, n * n)))
        exposing, pixels = frame_seconds(self.bench, self.shots)["sensor"], self.bench.geometry.pixels
        cost = frames_cost(self.bench, plan.settings, by_pixel, plan.predicted_seconds + exposing)
        # Light is filed by pixel, but frames are formed of lines, and those of both sides are held.
        lines = 2 * frames_bytes(n, self.shots // 2, pixels) - frames_bytes(n * n, self.shots, pixels)
        replace(cost, memory_bytes=cost.memory_bytes + lines).check("calibration", job.limits)
        return plan

    def trace(self, plan: Plan, job: Job) -> Light:
        """The board's light, by projector pixel, sampled as the ``plan`` says; ``job`` is told how far it is."""
        with job.clock.stage("transport"):
            sampling = Sampling(purpose="calibration")
            return trace_light(self.board, plan, _lines(self.bench.n), self.seed, sampling, job.progress).merged()

    def lit(self, light: Light, job: Job) -> LitSession:
        """The session in the ``light`` that :meth:`trace` gave; ``job`` takes the time of choosing the exposure."""
        with job.clock.stage("optics"):
            white = next(iter(light.frames(Lighting.uniform(self.bench.n), self.seed)))
            exposure = Exposure(None, self.recipe.exposure_fraction)
            exposure_s = exposure.choose(self.bench.rig, float(white.irradiance.max()))
        return LitSession(self, light, white, exposure_s, light.simulation.physics.speckle)


@dataclass(frozen=True)
class Response:
    """Response (pixels, pixels) to a +-1 pattern [electrons / s], and how many of its shots had saturated pixels."""

    rate: FloatArray
    saturated: int = 0


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
        of every shot [s].
    speckle
        contrast of laser speckle in the frames.
    """

    session: Session
    light: Light
    white: Frame
    exposure_s: float
    speckle: float

    @property
    def response_noise(self) -> float:
        """Root mean square noise of a +-1 response [electrons / s], from the sensor's closed form.

        Its two shots share the uniform light: variance (mean electrons + dark + 2 read noise^2) / t^2 for a pair; with
        one shot and a uniform one, 2 Y(positive) - Y(uniform), it is three times the light and 5/2 of the read noise.
        """
        sensor, time = self.session.bench.sensor, self.exposure_s
        light = float(self._second.electrons(self.white).mean()) + 2 * sensor.superpixel_dark_current_e_per_s
        read = sensor.superpixel_read_noise_e**2
        if self.session.pairs:
            return float(np.sqrt(light / time + 2 * read / time**2))
        return float(np.sqrt(3 * light / time + 5 * read / time**2))

    def noisy(self, side: str, job: Job, first: int = 0) -> Iterator[Response]:
        """Responses to +-1 stripes from noisy frames, one at a time.

        Parameters
        ----------
        side
            ``horizontal`` or ``vertical`` stripes.
        job
            takes the time and is told how far it is.
        first
            number of the first response; earlier ones are not exposed.
        """
        exposed = self._exposed(side, job, first)
        if self.session.pairs:
            for positive in exposed:
                negative = next(exposed)
                yield Response(positive.rate - negative.rate, positive.saturated + negative.saturated)
            return
        uniform = next(exposed)
        counted = uniform.saturated if first == 0 else 0
        for positive in exposed:
            yield Response(2 * positive.rate - uniform.rate, positive.saturated + counted)
            counted = 0

    def noise_free(self, side: str, first: int = 0) -> Iterator[Response]:
        """Expected responses to the +-1 stripes of a ``side`` from number ``first`` on: 2 Y((1 + P)/2) - Y(1)."""
        rates = (self._second.electrons(frame) for frame in self._expected(side, (1.0 + self.session.signs.T) / 2))
        uniform = next(rates)
        if first == 0:
            yield Response(uniform)
        for positive in islice(rates, max(first - 1, 0), None):
            yield Response(2 * positive - uniform)

    @property
    def _second(self) -> Exposer:
        """An exposure of one second, whose electrons are rates."""
        return Exposer(self.session.bench.rig, 1.0, self.session.seed)

    def _expected(self, side: str, weights: FloatArray) -> ExpectedFrames:
        n = self.session.bench.n
        row, column = np.divmod(np.arange(n * n), n)
        lighting = Lighting(row if side == "horizontal" else column, weights)
        return self.light.frames(lighting, self.session.seed)

    def _exposed(self, side: str, job: Job, first: int) -> Iterator[Response]:
        """Electrons a second that a user computes from each noisy frame that responses from ``first`` on need."""
        session = self.session
        exposer = Exposer(session.bench.rig, self.exposure_s, session.seed, self.speckle)
        # Frames that are not needed are formed all the same: how many are mixed at once shows in their last bits.
        needed = range(2 * first if session.pairs else first + 1, len(session.weights))
        numbered = (
            item
            for item in enumerate(self._expected(side, session.weights))
            if item[0] in needed or (item[0] == 0 and not session.pairs)
        )

        def expose(item: tuple[int, Frame]) -> Response:
            index, frame = item
            lit = exposer.lit(frame, "calibration", side, index)
            digital = exposer.digital(lit, "calibration", side, index)
            return Response(exposer.rate(digital), int(exposer.saturated(digital, lit)))

        chunks = in_chunks(numbered)
        while True:
            with job.clock.stage("optics"):
                chunk = next(chunks, None)
            if chunk is None:
                return
            with job.clock.stage("sensor"):
                exposed = in_threads(expose, chunk)
            job.progress(f"{side} stripes", (chunk[-1][0] + 1) / len(session.weights))
            yield from exposed


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
