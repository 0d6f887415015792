"""A rendered Hadamard calibration session on a white board: from a bench to the camera's responses to striped light.

The paper's procedure (section IV-A): every column h_i of a Hadamard matrix is shown as horizontal stripes h_i 1^T and
as vertical ones 1 h_i^T, each +-1 pattern as two captures (or one and a uniform frame), all at one exposure, with
sensor noise. When n is no Hadamard order the next one is used and its first n rows: rows stay orthogonal.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np

from mitsim.capture.bench import Bench
from mitsim.capture.cost import frames_cost
from mitsim.capture.exposer import FRAMES_AT_ONCE, Exposer
from mitsim.capture.light import Light, collect, make_plan, speckle_of
from mitsim.capture.plan import Plan
from mitsim.capture.request import Exposure
from mitsim.core.arrays import FloatArray, Labels, Progress
from mitsim.core.errors import MitsimError
from mitsim.core.job import Clock
from mitsim.core.parallel import in_threads
from mitsim.core.resources import Limits
from mitsim.optics.frames import ExpectedFrames, Frame
from mitsim.rig.patterns import Lighting, hadamard_matrix
from mitsim.rig.recipe import SessionRecipe

SIDES = ("horizontal", "vertical")
_LINES = 4


class Session:
    """One calibration session: the board's light, the exposure, and noisy or noise-free responses.

    ``saturated`` counts the noisy frames so far that have pixels at the full well or the ADC's end.
    """

    def __init__(
        self,
        bench: Bench,
        recipe: SessionRecipe,
        accuracy: float,
        seed: int,
        clock: Clock,
        progress: Progress,
        limits: Limits | None = None,
    ) -> None:
        """MitsimError when the session would take more memory or time than ``limits`` allow."""
        self.bench, self.recipe, self.seed, self.clock, self.progress = bench, recipe, seed, clock, progress
        self.board = bench.with_board(recipe.board_reflectance)
        self.centre = bench.geometry.mask == "flatcam"
        self.saturated = 0
        self.signs = _signs(bench.n)
        n, count = self.signs.shape
        positive = (1.0 + self.signs.T) / 2
        self.pairs = recipe.signed_capture == "pair"
        self.weights = (
            np.stack([positive, 1 - positive], axis=1).reshape(2 * count, n)
            if self.pairs
            else np.concatenate([np.ones((1, n)), positive])
        )
        lines = _lines(n)
        with clock.stage("plan"):
            self.plan: Plan = make_plan(self.board, *lines, accuracy, seed)
        cost = frames_cost(bench, self.plan.settings, n * n, self.captures, self.plan.predicted_seconds)
        cost.check("calibration", limits or Limits())
        with clock.stage("transport"):
            self.light: Light = collect(self.board, self.plan, *lines, seed, progress, "calibration").merged()
        with clock.stage("optics"):
            self.white = next(iter(self.light.frames(Lighting.uniform(n), seed)))
            peak = float(self.white.irradiance.max())
            self.exposure_s = Exposure(None, recipe.exposure_fraction).choose(bench, peak)

    @property
    def response_noise(self) -> float:
        """Root mean square noise of a +-1 response [electrons / s], from the sensor's closed form.

        Its two frames share the uniform light: variance (mean electrons + dark + 2 read noise^2) / t^2 for a pair; with
        one frame and a uniform one, 2 Y(positive) - Y(uniform), it is three times the light and 5/2 of the read noise.
        """
        sensor, time = self.bench.sensor, self.exposure_s
        second = Exposer(self.bench, 1.0, self.seed)
        light = float(second.electrons(self.white).mean()) + 2 * sensor.superpixel_dark_current_e_per_s
        read = sensor.superpixel_read_noise_e**2
        if self.pairs:
            return float(np.sqrt(light / time + 2 * read / time**2))
        return float(np.sqrt(3 * light / time + 5 * read / time**2))

    @property
    def captures(self) -> int:
        """Frames of the whole session."""
        return 2 * len(self.weights)

    def noisy(self) -> tuple[Iterator[FloatArray], Iterator[FloatArray]]:
        """Responses [electrons / s] to horizontal and vertical +-1 stripes, from noisy frames, one at a time."""
        horizontal, vertical = (self._signed(self._noisy(side)) for side in SIDES)
        return horizontal, vertical

    def noise_free(self) -> tuple[Iterator[FloatArray], Iterator[FloatArray]]:
        """The same responses from expected frames."""
        horizontal, vertical = (self._noise_free(side) for side in SIDES)
        return horizontal, vertical

    def _expected(self, side: str, weights: FloatArray) -> ExpectedFrames:
        n = self.bench.n
        row, column = np.divmod(np.arange(n * n), n)
        return self.light.frames(row if side == "horizontal" else column, weights, self.seed)

    def _signed(self, rates: Iterator[FloatArray]) -> Iterator[FloatArray]:
        """Responses to the +-1 patterns from captures in the order of ``weights``."""
        if self.pairs:
            for positive in rates:
                yield positive - next(rates)
            return
        uniform = next(rates)
        for positive in rates:
            yield 2 * positive - uniform

    def _noise_free(self, side: str) -> Iterator[FloatArray]:
        """Expected responses to the +-1 patterns: 2 Y((1 + P)/2) - Y(1), electrons a second."""
        second = Exposer(self.bench, 1.0, self.seed)
        rates = (second.electrons(frame) for frame in self._expected(side, (1.0 + self.signs.T) / 2))
        uniform = next(rates)
        yield uniform
        for positive in rates:
            yield 2 * positive - uniform

    def _noisy(self, side: str) -> Iterator[FloatArray]:
        """Electrons a second that a user computes from the noisy frame of each capture."""
        exposer = Exposer(self.bench, self.exposure_s, self.seed, speckle_of(self.bench, self.plan))
        numbered = enumerate(self._expected(side, self.weights))

        def shoot(item: tuple[int, Frame]) -> tuple[FloatArray, bool]:
            index, frame = item
            lit = exposer.lit(frame, "calibration", side, index)
            digital = exposer.digital(lit, "calibration", side, index)
            return exposer.rate(digital), exposer.saturated(digital, lit)

        done = 0
        while True:
            with self.clock.stage("optics"):
                chunk = list(islice(numbered, FRAMES_AT_ONCE))
            if not chunk:
                return
            with self.clock.stage("sensor"):
                shot = in_threads(shoot, chunk)
            done += len(chunk)
            self.progress(f"{side} stripes", done / len(self.weights))
            for rate, saturated in shot:
                self.saturated += saturated
                yield rate


def _lines(n: int) -> tuple[Labels, FloatArray]:
    """Labels and weights of captures of one row or one column of pixels each, evenly spread.

    The accuracy of a session is that of single lines: by the patterns' orthogonality the squared errors of all +-1
    responses add up to N times those of all lines, and so do the squared responses themselves. Frames of half the
    pixels are far brighter than the responses that are taken from their differences.
    """
    chosen = np.unique(((np.arange(_LINES) + 0.5) * n / _LINES).astype(np.int64))
    rows = np.zeros((len(chosen), n, n))
    rows[np.arange(len(chosen)), chosen] = 1
    return np.arange(n * n), np.concatenate([rows, rows.transpose(0, 2, 1)]).reshape(-1, n * n)


def _signs(n: int) -> FloatArray:
    """(n, N) first n rows of the smallest Hadamard matrix that has them; column 0 is all +1."""
    for order in range(n, 4 * n + 5):
        try:
            return hadamard_matrix(order)[:n].astype(np.float64)
        except MitsimError:
            continue
    raise MitsimError(f"no Hadamard matrix for {n} projector pixels; use another number of pixels")
