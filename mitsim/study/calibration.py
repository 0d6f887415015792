"""`mitsim calibrate`: from a bench to a folder with the camera's factors, and their error."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mitsim.capture.bench import Bench
from mitsim.capture.exposer import Exposure
from mitsim.capture.run import digital_block
from mitsim.capture.session import Session
from mitsim.core.arrays import Progress, silent
from mitsim.core.job import Clock
from mitsim.core.manifests import CalibrationManifest
from mitsim.core.output import output_folder
from mitsim.core.resources import Limits
from mitsim.core.versions import versions
from mitsim.reconstruct.calibration import estimate_factors
from mitsim.reconstruct.factors import Factors
from mitsim.rig.recipe import SessionRecipe, load_recipe
from mitsim.study.metrics import relative_error


@dataclass(frozen=True)
class CalibrationResult:
    """What `mitsim calibrate` reports.

    ``unexplained_residual`` is the part of the separability residual beyond the sensor's noise, ``noise_free_residual``
    the residual of noise-free frames. ``phi_error`` is the relative error of the factors, both sides in quadrature,
    against those that the same procedure finds in noise-free frames.
    """

    n: int
    frames: int
    separability_residual: float
    unexplained_residual: float
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
    limits: Limits | None = None,
) -> tuple[CalibrationResult, Factors]:
    """Run a session and write its factors to a CAL folder; returns the report and the factors.

    Raises
    ------
    MitsimError
        for an output that cannot be written, a recipe that cannot be used, or a session beyond the ``limits``.
    """
    recipe = recipe or load_recipe()
    clock = Clock()
    Exposure(None, recipe.exposure_fraction).check(bench)
    with output_folder(output) as folder:
        session = Session(bench, recipe, accuracy, seed, clock, progress, limits)
        noisy = estimate_factors(*session.noisy(), session.signs, centre=session.centre, noise=session.response_noise)
        with clock.stage("noise-free check"):
            clean = estimate_factors(*session.noise_free(), session.signs, centre=session.centre)
        warnings = session.plan.warnings + (() if noisy.ok else (str(noisy.status),))
        if session.saturated:
            warnings += (
                f"{session.saturated} of {session.captures} frames have pixels at the full well or the ADC's end, "
                "so responses are not linear; lower the recipe's exposure_fraction",
            )
        # (left, right) and (-left, -right) are one camera; centred factors have no sum that would tell which it is.
        sign = 1.0 if np.vdot(noisy.left, clean.left) >= 0 else -1.0
        error = float(
            np.hypot(relative_error(sign * noisy.left, clean.left), relative_error(sign * noisy.right, clean.right))
        )
        result = CalibrationResult(
            n=bench.n,
            frames=session.captures,
            separability_residual=noisy.separability_residual,
            unexplained_residual=noisy.unexplained,
            noise_free_residual=clean.separability_residual,
            phi_error=error,
            condition=noisy.condition,
            exposure_s=session.exposure_s,
            seconds=clock.seconds(),
            output=str(folder),
            warnings=warnings,
        )
        factors = Factors.of(
            noisy,
            CalibrationManifest(
                configuration={**bench.provenance(), "accuracy": accuracy, "seed": seed, "recipe": recipe},
                camera=bench.identity(),
                centre=session.centre,
                board_reflectance=recipe.board_reflectance,
                digital=digital_block(bench, session.exposure_s),
                result={key: value for key, value in vars(result).items() if key != "output"},
                warnings=warnings,
                versions=versions(),
            ),
        )
        factors.write(folder)
        return result, factors
