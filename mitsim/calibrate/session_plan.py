"""Plan of the calibration session that an image of a wanted PSNR needs.

The capture and the session's responses are simulated once. For any exposure, factors with noise are drawn in closed
form, and the image is solved and compared with the truth. PSNR rises with the session's light until noise of the
capture or resolution limits it; the least sufficient light is found by bisection.

Factors are linear in responses: u_i = Y_i v / |v|^2, Phi_L = U H^T / N. With V[k, l] the variance of a response, a
number in row k of Phi_L has the variance sum_l V[k, l] v_l^2 / (N |v|^4), and numbers are uncorrelated because the rows
of H are orthogonal. If all +-1 patterns share a uniform shot, its noise enters column p of Phi_L by sum_i H[p, i] / N,
that is, only the column whose signs are all +1. Noise of v (second order), speckle and noise of sensor rows are
neglected.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mitsim.acquire.capture import capture
from mitsim.acquire.exposure import Exposer
from mitsim.acquire.spectral import SpectralBench
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.request import Exposure, Request, SessionRequest, Task, Working, check_psnr
from mitsim.calibrate.board_session import LitSession, Session, manifest_of, session_seconds
from mitsim.calibrate.calibrate import NOISE_FREE, session_sums
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import takes
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import stream
from mitsim.devices.sensor import EXPOSURE_FRACTION, digital_of
from mitsim.devices.session import MOST_REPEATS, SIDES, SessionRecipe, load_recipe
from mitsim.metrics import psnr as psnr_of
from mitsim.metrics import truth_for
from mitsim.reconstruct.factors import Estimate, Factors, StripeSums, factors_of_sums
from mitsim.reconstruct.reconstruct import reconstruct

_DRAWS = 8
"""Sessions whose mean PSNR is used: single ones scatter by 0.4 dB, the mean by 0.14 dB."""
_NEAR_DB = 0.05
"""Excess over the wanted PSNR at which the search ends."""
_STEP = 8.0
"""Factor of light until the wanted PSNR is bracketed: some 6 dB."""
_TRIED = 0.1
"""Part of a search that one session is: nine sessions at most, five in the median."""
_DIGITS = 3
"""Digits of an exposure fraction: a thousandth of the light is 0.004 dB."""


@dataclass(frozen=True)
class Trial:
    """Images with factors of a session by ``recipe`` (None: no noise): mean PSNR [dB] and its standard deviation.

    ``largest`` is the largest source of the first image's stated uncertainty; empty if none is stated.
    """

    recipe: SessionRecipe | None
    psnr_db: float
    spread_db: float
    largest: str


@dataclass(frozen=True, eq=False)
class CalibrationPlan:
    """Session for a wanted image.

    Attributes
    ----------
    psnr_asked, patterns
        Wanted PSNR [dB], and patterns of the capture.
    recipe
        Recipe that reaches it, or that comes nearest.
    trial, ceiling
        Images with factors of that session, and with noise-free factors.
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
    trial: Trial
    ceiling: Trial
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
        return self.trial.psnr_db >= self.psnr_asked

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return why the PSNR is not reached, and the flags."""
        if self.reached:
            return self.flags
        most = f", most of its error is {self.ceiling.largest}" if self.ceiling.largest else ""
        if self.ceiling.psnr_db < self.psnr_asked:
            sentence = (
                f"PSNR {self.psnr_asked:g} dB cannot be reached under {self.patterns}: with a calibration without "
                f"noise the image has {self.ceiling.psnr_db:.1f} dB{most}; improve the capture, not the calibration"
            )
        else:
            sentence = (
                f"PSNR {self.psnr_asked:g} dB is not reached by {self.recipe.repeats} repeats: "
                f"{self.trial.psnr_db:.1f} dB; the ceiling is {self.ceiling.psnr_db:.1f} dB{most}"
            )
        return (sentence, *self.flags)

    def payload(self) -> dict[str, Any]:
        """Return the values of the command line's JSON."""
        own = "psnr_asked", "patterns", "reached", "frames", "exposure_s", "simulation_s", "seconds", "warnings"
        return {
            **{name: getattr(self, name) for name in own},
            "psnr": self.trial.psnr_db,
            "psnr_spread": self.trial.spread_db,
            "psnr_ceiling": self.ceiling.psnr_db,
            "ceiling_source": self.ceiling.largest or None,
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
            f"PSNR {self.psnr_asked:g} dB under {self.patterns}: predicted {self.trial.psnr_db:.1f} dB "
            f"(one session +-{self.trial.spread_db:.1f}), without noise of the calibration "
            f"{self.ceiling.psnr_db:.1f} dB",
            f"Session: exposure_fraction {recipe.exposure_fraction:g}, repeats {recipe.repeats}, "
            f"{recipe.signed_capture}: {self.frames} frames of {self.exposure_s:.3g} s, {total:.3g} s of exposure",
            f"Light: {self.electrons:.3g} electrons ({self.photons:.3g} photons) a pixel and frame in the mean, "
            f"{self.frames * self.electrons:.3g} ({self.frames * self.photons:.3g}) in all frames",
            f"Simulation: {self.simulation_s:.1f} s predicted",
        ]


@takes(Working, SessionRequest, without="resume")
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
        Flagged if no calibration reaches that PSNR.

    Raises
    ------
    MitsimError
        For a PSNR outside 1 to 100 dB, patterns that do not fit, and as :meth:`mitsim.api.bench.Bench.capture`.
    """
    check_psnr(psnr)
    job, asked = Task.taken(None, request).job, SessionRequest(**request)
    largest = (asked.recipe or load_recipe()).of_one_depth()
    Exposure(None, largest.exposure_fraction).check(bench.sensor, bench.devices.camera_file)
    session = Session(bench, largest, asked.seed)
    session.check_mask(job)
    job.progress("capture", 0.0)
    with job.clock.stage("capture"):
        light = Request(patterns=patterns, seed=asked.seed, accuracy=asked.accuracy)
        shots = capture(SpectralBench(bench), light).runs[0]
    job.progress("session", 0.0)
    with job.clock.stage("session"), single_threaded_blas():
        own = job.apart("session ")
        plan = session.plan(asked.accuracy, own)
        whole = LitSession.of(session, session.trace(plan, own)[0], own)
        sums = session_sums(whole, own, (NOISE_FREE,))[0][NOISE_FREE]
    truth = truth_for(shots, largest.board_reflectance)
    assert truth is not None

    def by(recipe: SessionRecipe) -> LitSession:
        exposure = Exposure(None, recipe.exposure_fraction)
        exposure_s = exposure.choose(bench.devices, float(whole.white.irradiance.max()))
        return replace(whole, session=replace(session, recipe=recipe), exposure_s=exposure_s)

    def trial(recipe: SessionRecipe | None) -> Trial:
        lit, found, budget = whole if recipe is None else by(recipe), [], dict[str, float]()
        digital = digital_of(bench.sensor, lit.exposure_s)
        manifest = manifest_of(bench, digital, largest.board_reflectance, bench.geometry.scene_distance)
        for draw in range(_DRAWS) if recipe else (None,):
            image = reconstruct(shots, Factors.of(drawn_estimate(lit, sums, draw), manifest))
            found.append(psnr_of(image.image, truth))
            budget = budget or (image.uncertainties.budget if image.uncertainties else {})
        most = max(budget, key=lambda name: budget[name], default="").replace("_", " ")
        return Trial(recipe, float(np.mean(found)), float(np.std(found, ddof=1)) if len(found) > 1 else 0.0, most)

    trials: dict[float, Trial] = {}

    def quality(dose: float) -> float:
        if dose not in trials:
            fraction = float(f"{dose * largest.exposure_fraction:.{_DIGITS}g}")
            update = {"repeats": round(dose)} if dose > 1 else {"repeats": 1, "exposure_fraction": fraction}
            trials[dose] = trial(largest.model_copy(update=update))
            job.progress(f"solve: {len(trials)} sessions", min(_TRIED * len(trials), 1.0))
        return trials[dose].psnr_db

    with job.clock.stage("solve"):
        ceiling = trial(None)
        out_of_reach = quality(1.0) < psnr and ceiling.psnr_db < psnr
        smallest = EXPOSURE_FRACTION[0] / largest.exposure_fraction
        chosen = trials[1.0 if out_of_reach else least_dose(quality, psnr, smallest)]
    assert chosen.recipe is not None
    lit = by(chosen.recipe)
    taken = session_seconds(session.board, session.signs.shape[1], lit.session.shots, plan.settings)
    flags = [*shots.warnings, *session.warnings]
    if lit.speckle:
        flags.append(f"speckle of contrast {lit.speckle:g}: it is in every frame, and not in the plan's calibration")
    # Half of the projector's pixels are lit in every frame but the uniform ones.
    electrons = float(Exposer(bench.devices, lit.exposure_s, asked.seed).electrons(lit.white).mean()) / 2
    return CalibrationPlan(
        psnr_asked=psnr,
        patterns=patterns,
        recipe=chosen.recipe.model_copy(update={"source": f"planned for {psnr:g} dB; {chosen.recipe.source}"}),
        trial=chosen,
        ceiling=ceiling,
        frames=lit.session.shots,
        exposure_s=lit.exposure_s,
        electrons=electrons,
        photons=electrons / bench.sensor.efficiency(bench.projector.effective_wavelength_nm),
        simulation_s=plan.taking(start=0.0, **taken).predicted_seconds,
        seconds=job.clock.seconds(),
        flags=tuple(flags),
    )


def least_dose(quality: Callable[[float], float], wanted: float, smallest: float) -> float:
    """Return the least dose of light that suffices, or the largest one (``MOST_REPEATS``).

    ``quality`` is the PSNR [dB] by dose, and rises. Doses beyond 1 are whole repeats.
    """
    low = high = 1.0
    while quality(low) >= wanted:
        if low == smallest:
            return low
        low, high = max(low / _STEP, smallest), low
    while quality(high) < wanted:
        if high == MOST_REPEATS:
            return high
        low, high = high, min(high * _STEP, float(MOST_REPEATS))
    while (low < 1 or high - low > 1) and quality(high) - wanted > _NEAR_DB and high / low >= 1 + 10.0 ** (1 - _DIGITS):
        part = (_NEAR_DB / 2 - quality(low) + wanted) / (quality(high) - quality(low))
        dose = float(low * (high / low) ** min(max(part, 0.2), 0.8))
        dose = min(max(float(round(dose)), low + 1), high - 1) if low >= 1 else dose
        low, high = (low, dose) if quality(dose) >= wanted else (dose, high)
    return high


def vector_variance(variance: FloatArray, common: FloatArray) -> FloatArray:
    """Return the variance (m,) of u = Y v / |v|^2, from that of a response Y (m, m') and the ``common`` v (m',)."""
    return np.asarray(variance @ np.square(common / np.dot(common, common)))


def drawn_estimate(lit: LitSession, sums: tuple[StripeSums, StripeSums], draw: int | None) -> Estimate:
    """Estimate factors from noise-free ``sums`` with noise as of the session ``lit``.

    Equal numbers ``draw`` give equal noise, and None gives none. Each response has noise of its own, and all responses
    of a side share the noise of their uniform frame.
    """
    if draw is None:
        return factors_of_sums(*sums, lit.session.signs, 0.0)
    own, shared = (
        np.broadcast_to(np.sum([*np.broadcast_arrays(*parts.values())], axis=0), lit.uniform_rate.shape)
        for parts in lit.response_variances()
    )
    sides = []
    for each in sums:
        across, random = each.side == SIDES[0], stream(lit.session.seed, "foreseen", each.side, draw)
        by_row = vector_variance(own if across else own.T, each.common)
        noise = np.sqrt(by_row)[:, None] * random.standard_normal(each.vectors.shape)
        if shared.any():
            by_row = vector_variance(shared if across else shared.T, each.common)
            noise += np.sqrt(by_row)[:, None] * random.standard_normal((len(each.vectors), 1))
        # One number a row (or column) of each response was fitted.
        energy, fitted = each.done * float((own + shared).sum()), 1 - 1 / len(each.common)
        more: dict[str, Any] = {
            "vectors": each.vectors + noise,
            "misfit": each.misfit + fitted * energy,
            "energy": each.energy + energy,
        }
        sides.append(replace(each, **more))
    return factors_of_sums(sides[0], sides[1], lit.session.signs, lit.response_noise)
