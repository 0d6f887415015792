"""`mitsim calibrate`: a rendered Hadamard session on a white board, from a bench to the camera's estimated factors.

The paper's procedure (section IV-A): every column h_i of a Hadamard matrix is shown as horizontal stripes h_i 1^T and as
vertical ones 1 h_i^T, each +-1 pattern as two captures (or one and a uniform frame), all at one exposure, with sensor
noise. When n is no Hadamard order the next one is used and its first n rows: rows stay orthogonal.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mitsim.calibrate.hadamard import Calibration, estimate_factors
from mitsim.capture.bench import Bench, SessionRecipe, load_recipe
from mitsim.capture.clock import Clock
from mitsim.capture.exposer import WORKERS, Exposer, Exposure
from mitsim.capture.light import Light, Progress, collect, make_plan, silent, uniform_light
from mitsim.capture.run import digital_block
from mitsim.core.errors import MitsimError
from mitsim.core.frames import checksum, write_frame
from mitsim.core.manifest import prepare_output, versions, write_json
from mitsim.optics.frames import ExpectedFrames, Frame
from mitsim.scene.patterns import hadamard_matrix
from mitsim.scene.plan import Plan

FloatArray = npt.NDArray[np.float64]
SIDES = ("horizontal", "vertical")


@dataclass(frozen=True)
class CalibrationResult:
    """What `mitsim calibrate` reports.

    ``phi_error`` is the relative error of the factors, both sides in quadrature, against those that the same procedure
    finds in noise-free frames; ``noise_free_residual`` is what those frames leave unexplained.
    """

    n: int
    frames: int
    separability_residual: float
    noise_free_residual: float
    phi_error: float
    condition: float
    exposure_s: float
    seconds: dict[str, float]
    output: str
    warnings: tuple[str, ...]


def calibrate(
    bench: Bench,
    output: Path | str,
    accuracy: float = 1e-3,
    seed: int = 0,
    recipe: SessionRecipe | None = None,
    progress: Progress = silent,
) -> tuple[CalibrationResult, Calibration]:
    """Run a session and write its factors to a CAL folder; returns the report and the factors.

    Raises
    ------
    MitsimError
        for an output that cannot be written, or a recipe that cannot be used.
    """
    recipe = recipe or load_recipe()
    clock = Clock()
    folder = prepare_output(output)
    session = Session(bench, recipe, accuracy, seed, clock, progress)
    noisy, clean = session.factors()
    warnings = session.plan.warnings + (() if noisy.ok else (noisy.status,))
    for name, factor in (("left", noisy.left), ("right", noisy.right)):
        write_frame(
            folder / f"{name}.exr",
            {"factor": factor.astype(np.float32)},
            {"unit": "sqrt(e-/s)", "reflectance": recipe.board_reflectance},
        )
    result = CalibrationResult(
        n=bench.n,
        frames=session.captures,
        separability_residual=noisy.separability_residual,
        noise_free_residual=clean.separability_residual,
        phi_error=float(np.hypot(_relative(noisy.left, clean.left), _relative(noisy.right, clean.right))),
        condition=noisy.condition,
        exposure_s=session.exposure_s,
        seconds=clock.seconds(),
        output=str(folder),
        warnings=warnings,
    )
    write_json(
        folder / "manifest.json",
        {
            "kind": "calibration",
            "status": "complete",
            "configuration": {**bench.provenance(), "accuracy": accuracy, "seed": seed, "recipe": recipe},
            "camera": bench.identity(),
            "centre": session.centre,
            "digital": digital_block(bench, session.exposure_s),
            "checksums": {name: checksum(folder / name) for name in ("left.exr", "right.exr")},
            "result": {key: value for key, value in vars(result).items() if key != "output"},
            "versions": versions(),
        },
    )
    return result, noisy


class Session:
    """One calibration session: the board's light, the exposure, and noisy or noise-free responses."""

    def __init__(
        self, bench: Bench, recipe: SessionRecipe, accuracy: float, seed: int, clock: Clock, progress: Progress
    ) -> None:
        self.bench, self.recipe, self.seed, self.clock, self.progress = bench, recipe, seed, clock, progress
        self.board = bench.with_board(recipe.board_reflectance)
        self.centre = bench.geometry.mask == "flatcam"
        self.signs = _signs(bench.n)
        n, count = self.signs.shape
        positive = (1.0 + self.signs.T) / 2
        self.pairs = recipe.signed_capture == "pair"
        self.weights = (
            np.stack([positive, 1 - positive], axis=1).reshape(2 * count, n)
            if self.pairs
            else np.concatenate([np.ones((1, n)), positive])
        )
        uniform = uniform_light(n)
        with clock.stage("plan"):
            self.plan: Plan = make_plan(self.board, *uniform, accuracy, seed)
        with clock.stage("transport"):
            self.light: Light = collect(self.board, self.plan, *uniform, seed, progress)
        with clock.stage("optics"):
            white = next(iter(self.light.frames(*uniform, seed)))
            self.exposure_s = Exposure(None, recipe.exposure_fraction).choose(bench, float(white.irradiance.max()))

    @property
    def captures(self) -> int:
        """Frames of the whole session."""
        return 2 * len(self.weights)

    def factors(self) -> tuple[Calibration, Calibration]:
        """Factors [sqrt(electrons / s)] from noisy frames, and from the expected ones."""
        noisy = estimate_factors(
            *(self._signed(self._noisy(side)) for side in SIDES), self.signs, centre=self.centre
        )
        with self.clock.stage("noise-free check"):
            clean = estimate_factors(
                *(self._noise_free(side) for side in SIDES), self.signs, centre=self.centre
            )
        return noisy, clean

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
        exposer = Exposer(self.bench, self.exposure_s, self.seed)
        numbered = enumerate(self._expected(side, self.weights))

        def shoot(item: tuple[int, Frame]) -> FloatArray:
            index, frame = item
            return exposer.rate(exposer.digital(exposer.electrons(frame), "calibration", side, index))

        done = 0
        with ThreadPoolExecutor(WORKERS) as pool:
            while True:
                with self.clock.stage("optics"):
                    chunk = list(islice(numbered, 2 * WORKERS))
                if not chunk:
                    return
                with self.clock.stage("sensor"):
                    rates = list(pool.map(shoot, chunk))
                done += len(chunk)
                self.progress(f"{side} stripes", done / len(self.weights))
                yield from rates


def _signs(n: int) -> FloatArray:
    """(n, N) first n rows of the smallest Hadamard matrix that has them; column 0 is all +1."""
    for order in range(n, 4 * n + 5):
        try:
            return hadamard_matrix(order)[:n].astype(np.float64)
        except MitsimError:
            continue
    raise MitsimError(f"no Hadamard matrix for {n} projector pixels; use another number of pixels")


def _relative(a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))
