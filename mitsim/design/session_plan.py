"""Plan of the calibration session that an image of a wanted PSNR needs.

The image is predicted (:mod:`mitsim.design.predictor`) from a short trace of light: no frame is formed, and no image is
solved. PSNR rises with the session's light until noise of the capture or resolution limits it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from decimal import ROUND_CEILING, Context
from typing import Any

import numpy as np
from scipy.optimize import brentq

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.request import Exposure, PredictRequest, SessionRequest, Task, Working, check_psnr
from mitsim.calibrate.board_session import Session
from mitsim.core.configuration import takes
from mitsim.core.parallel import single_threaded_blas
from mitsim.design.predict import Stand, lacks
from mitsim.design.predictor import Errors, Predictor
from mitsim.devices.sensor import EXPOSURE_FRACTION
from mitsim.devices.session import MOST_REPEATS, SessionRecipe, load_recipe
from mitsim.reconstruct.factors import LARGEST_ERROR

_DIGITS = Context(prec=3, rounding=ROUND_CEILING)
"""Digits of an exposure fraction: a thousandth of the light is 0.004 dB."""
_NEAR = 1e-6
"""Relative error of the light that is searched."""


@dataclass(frozen=True, eq=False)
class CalibrationPlan:
    """Session for a wanted image.

    Attributes
    ----------
    psnr_asked, patterns
        Wanted PSNR [dB], and patterns of the capture.
    recipe
        Recipe that reaches it, or that comes nearest.
    errors, ceiling
        Expected errors of the image with factors of that session, and with noise-free factors.
    spread_db
        Standard deviation of PSNR between sessions [dB].
    frames, exposure_s
        Frames of the session, and exposure time of each [s].
    electrons, photons
        Mean number per pixel and frame.
    simulation_s
        Predicted seconds of `mitsim calibrate`, without the start of the program.
    seconds
        Time of this plan by stage.
    flags
        Reasons why the prediction may fail.
    """

    psnr_asked: float
    patterns: str
    recipe: SessionRecipe
    errors: Errors
    ceiling: Errors
    spread_db: float
    frames: int
    exposure_s: float
    electrons: float
    photons: float
    simulation_s: float
    seconds: dict[str, float]
    flags: tuple[str, ...]

    @property
    def reached(self) -> bool:
        """Return True if the wanted PSNR is reached."""
        return self.errors.psnr_db >= self.psnr_asked

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return why the PSNR is not reached, and the flags."""
        if self.reached:
            return self.flags
        short = self.ceiling.psnr_db < self.psnr_asked
        return (
            f"PSNR {self.psnr_asked:g} dB is not reached under {self.patterns} by {self.recipe.repeats} repeats: "
            f"{self.errors.psnr_db:.1f} dB; with a calibration without noise it is {self.ceiling.psnr_db:.1f} dB, and "
            f"its largest error is {self.ceiling.largest}{'; improve the capture' if short else ''}",
            *self.flags,
        )

    def payload(self) -> dict[str, Any]:
        """Return the values of the command line's JSON."""
        own = "psnr_asked", "patterns", "reached", "frames", "exposure_s", "simulation_s", "seconds", "warnings"
        return {
            **{name: getattr(self, name) for name in own},
            "psnr": self.errors.psnr_db,
            "psnr_spread": self.spread_db,
            "psnr_ceiling": self.ceiling.psnr_db,
            "ceiling_source": self.ceiling.largest,
            "recipe": self.recipe.model_dump(mode="json", exclude_defaults=True),
            "exposure_fraction": self.recipe.exposure_fraction,
            "repeats": self.recipe.repeats,
            "exposure_total_s": self.frames * self.exposure_s,
            "electrons_a_pixel": self.electrons,
            "photons_a_pixel": self.photons,
            "electrons_a_pixel_total": self.frames * self.electrons,
            "photons_a_pixel_total": self.frames * self.photons,
        }

    def lines(self) -> list[str]:
        """Return the report as lines of text."""
        recipe, total = self.recipe, self.frames * self.exposure_s
        return [
            f"PSNR {self.psnr_asked:g} dB under {self.patterns}: predicted {self.errors.psnr_db:.1f} dB "
            f"(one session +-{self.spread_db:.1f}), without noise of the calibration "
            f"{self.ceiling.psnr_db:.1f} dB",
            f"Session: exposure_fraction {recipe.exposure_fraction:g}, repeats {recipe.repeats}, "
            f"{recipe.signed_capture}: {self.frames} frames of {self.exposure_s:.3g} s, {total:.3g} s of exposure",
            f"Light: {self.electrons:.3g} electrons ({self.photons:.3g} photons) a pixel and frame in the mean, "
            f"{self.frames * self.electrons:.3g} ({self.frames * self.photons:.3g}) in all frames",
            f"Simulation: {self.simulation_s:.1f} s predicted",
        ]


@takes(Working, SessionRequest, without="resume")
@single_threaded_blas()
def plan_calibration(bench: Apparatus, psnr: float, patterns: str = "dots:7", **request: Any) -> CalibrationPlan:
    """Find the least exposure, or fewest repeats, with which the image of a capture reaches a PSNR.

    The recipe's exposure fraction is the largest; its repeats are found.

    Parameters
    ----------
    bench
        Scene, camera and projector.
    psnr
        Wanted PSNR [dB].
    patterns
        Patterns of the capture, which is exposed as `mitsim capture` does by default.

    Returns
    -------
    CalibrationPlan
        Flagged if no calibration reaches that PSNR, and for causes of error that the prediction lacks.

    Raises
    ------
    MitsimError
        For a PSNR outside 1 to 100 dB, patterns that do not fit, and as :meth:`mitsim.api.bench.Bench.capture`.
    """
    check_psnr(psnr)
    job, asked = Task.taken(None, request).job, SessionRequest(**request)
    largest = (asked.recipe or load_recipe()).of_one_depth()
    Exposure(None, largest.exposure_fraction).check(bench.sensor, bench.devices.camera_file)
    family, session = bench.family(patterns, asked.seed), Session(bench, largest, asked.seed)
    session.check_mask(job)
    with job.clock.stage("transport"):
        stand = Stand.of(session)
    with job.clock.stage("predict"):
        model = stand.predictor(stand.own, family, session, PredictRequest(patterns=patterns, seed=asked.seed))
        ceiling = model.calibrated((0.0, 0.0)).errors()

        full, least = largest.exposure_fraction, EXPOSURE_FRACTION[0]

        def by(fraction: float, repeats: float) -> tuple[Session, Predictor]:
            update = {"exposure_fraction": min(max(fraction, least), full), "repeats": max(repeats, 1)}
            taken = replace(session, recipe=largest.model_copy(update=update))
            return taken, model.calibrated(stand.session_noise(taken)[0])

        def excess(log_light: float) -> float:
            light = math.exp(log_light)
            made, factors = by(light, light / full)[1], stand.camera.factors
            # Where factors are mostly noise, the closed form of first order and the calibration fail.
            parts = (
                each * math.sqrt(own.size) / np.linalg.norm(own)
                for each, own in zip(made.noise.factors, factors, strict=True)
            )
            return min(made.errors().psnr_db - psnr, math.log(LARGEST_ERROR / max(parts)))

        ends = math.log(least), math.log(full * MOST_REPEATS)
        if excess(ends[0]) >= 0:
            light = least
        elif excess(ends[1]) < 0:
            light = full if ceiling.psnr_db < psnr else full * MOST_REPEATS
        else:
            light = math.exp(brentq(excess, *ends, xtol=_NEAR) + 2 * _NEAR)
        taken, chosen = by(float(_DIGITS.create_decimal(light)), min(math.ceil(light / full), MOST_REPEATS))
        errors, exposure_s = chosen.errors(), stand.session_noise(taken)[1]
        flags = [*lacks(stand, chosen, session)]
        spread = chosen.session_scatter(errors.lam)
    if speckle := bench.speckle():
        flags.append(f"speckle of contrast {speckle:g}: it is in every frame, and not in the plan's calibration")
    simulated = taken.plan(asked.accuracy, job.apart("session "))
    electrons = float(stand.white.mean()) * exposure_s / 2  # half of the pixels is lit in all but the uniform frames
    return CalibrationPlan(
        psnr_asked=psnr,
        patterns=patterns,
        recipe=taken.recipe.model_copy(update={"source": f"planned for {psnr:g} dB; {largest.source}"}),
        errors=errors,
        ceiling=ceiling,
        spread_db=10 / math.log(10) * spread,
        frames=taken.shots,
        exposure_s=exposure_s,
        electrons=electrons,
        photons=electrons / bench.sensor.efficiency(bench.projector.effective_wavelength_nm),
        simulation_s=simulated.taking(start=0.0).predicted_seconds,
        seconds=job.clock.seconds(),
        flags=tuple(flags),
    )
