"""From a bench to the camera's factors and their error: a rendered session, estimated as a user's frames would be."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy import sparse

from mitsim.capture.bench import Bench
from mitsim.capture.checkpoint import Checkpoint, claimed_session
from mitsim.capture.filing import TRAYS, FiledLight
from mitsim.capture.light import Light
from mitsim.capture.plan import Plan
from mitsim.capture.request import Exposure
from mitsim.capture.run import digital_scale
from mitsim.capture.session import SIDES, LitSession, Session
from mitsim.capture.simulation import Simulation
from mitsim.core.arrays import FloatArray
from mitsim.core.job import Job
from mitsim.core.manifests import CalibrationManifest
from mitsim.core.versions import DECIDING, versions
from mitsim.reconstruct.calibration import Estimate, StripeSums, factors_of_sums, stripe_sums
from mitsim.reconstruct.factors import Factors
from mitsim.rig.recipe import SessionRecipe, load_recipe

_SAVED_EVERY = 8
"""Responses between two checkpoints: the 16 shots that are exposed at once, or 32 of a noise-free check."""


def calibrate(
    bench: Bench,
    seed: int = 0,
    accuracy: float = 1e-3,
    recipe: SessionRecipe | None = None,
    output: Path | str | None = None,
    resume: bool = False,
    job: Job | None = None,
) -> Factors:
    """Run a calibration session and estimate the camera's factors; see :meth:`mitsim.capture.bench.Bench.calibrate`.

    Parameters
    ----------
    bench
        whose camera and projector are calibrated; its scene is replaced by the board.
    seed, accuracy, recipe, output, resume, job
        as there.

    Raises
    ------
    MitsimError
        as there.
    """
    recipe, job = recipe or load_recipe(), job or Job()
    Exposure(None, recipe.exposure_fraction).check(bench.rig)
    session = Session(bench, recipe, seed)
    configuration = {
        **bench.provenance(),
        **bench.identity(),
        "accuracy": accuracy,
        "seed": seed,
        "recipe": recipe.model_dump(),
        "versions": {name: version for name, version in versions().items() if name in DECIDING},
    }
    with claimed_session(output, configuration, resume) as checkpoint:
        plan = session.plan(accuracy, job)
        checkpoint.begin()
        lit = session.lit(_light(session, plan, checkpoint, job), job)
        noisy, saturated = estimate(lit, job, checkpoint=checkpoint)
        with job.clock.stage("noise-free check"):
            clean, _ = estimate(lit, job, noise_free=True, checkpoint=checkpoint)
        warnings = lit.light.warnings + (() if noisy.ok else (str(noisy.status),))
        if saturated:
            warnings += (
                f"saturation: {saturated} of {session.shots} frames have pixels at the full well or the ADC's end, "
                "so responses are not linear; lower the recipe's exposure_fraction",
            )
        result = {
            "n": bench.n,
            "frames": session.shots,
            "separability_residual": noisy.separability_residual,
            "unexplained_residual": noisy.unexplained,
            "noise_free_residual": clean.separability_residual,
            "phi_error": _factor_error(noisy, clean),
            "condition": noisy.condition,
            "exposure_s": lit.exposure_s,
            "seconds": job.clock.seconds(),
            "warnings": warnings,
        }
        manifest = CalibrationManifest(
            configuration=configuration,
            camera=bench.identity(),
            centre=session.centre,
            board_reflectance=recipe.board_reflectance,
            digital=digital_scale(bench, lit.exposure_s),
            parallax=bench.parallax,
            result=result,
            warnings=warnings,
            versions=versions(),
        )
        factors = Factors.of(noisy, manifest)
        if checkpoint.folder is not None:
            factors.write(checkpoint.folder)
            checkpoint.clear()
    return factors


def estimate(
    lit: LitSession, job: Job, noise_free: bool = False, checkpoint: Checkpoint | None = None
) -> tuple[Estimate, int]:
    """Factors from the responses of a session, and how many of its shots have saturated pixels.

    Parameters
    ----------
    lit
        the session, its light traced.
    job
        takes the time and is told how far the session is.
    noise_free
        whether to take the expected frames instead of noisy ones.
    checkpoint
        where finished stripes are kept, and those of an interrupted session found.
    """
    session, checkpoint = lit.session, checkpoint or Checkpoint()
    count, name = session.signs.shape[1], "noise_free" if noise_free else "noisy"
    found = _stripes(checkpoint.load(name), session.centre, count)
    first = [sums.done for sums in found[0]] if found else [0, 0]
    streams = [
        lit.noise_free(side, start) if noise_free else lit.noisy(side, job, start)
        for side, start in zip(SIDES, first, strict=True)
    ]
    if found:
        both, saturated = found
    else:
        uniform = [next(stream) for stream in streams]
        both = stripe_sums(uniform[0].rate, uniform[1].rate, count, session.centre)
        saturated = sum(response.saturated for response in uniform)
    for sums, stream in zip(both, streams, strict=True):
        while sums.done < count:
            response = next(stream)
            sums.add(response.rate)
            saturated += response.saturated
            if sums.done % _SAVED_EVERY == 0 or sums.done == count:
                checkpoint.save(name, _stripe_arrays(both, saturated))
    return factors_of_sums(*both, session.signs, None if noise_free else lit.response_noise), saturated


def _factor_error(noisy: Estimate, clean: Estimate) -> float:
    """Relative error of both factors, in quadrature.

    (left, right) and (-left, -right) are one camera; centred factors have no sum that would tell which it is.
    """
    sign = 1.0 if np.vdot(noisy.left, clean.left) >= 0 else -1.0
    left = np.linalg.norm(sign * noisy.left - clean.left) / np.linalg.norm(clean.left)
    right = np.linalg.norm(sign * noisy.right - clean.right) / np.linalg.norm(clean.right)
    return float(np.hypot(left, right))


# ---- what a checkpoint holds -----------------------------------------------------------------------------------------


def _light(session: Session, plan: Plan, checkpoint: Checkpoint, job: Job) -> Light:
    """The board's light, from the checkpoint if it is there."""
    arrays = checkpoint.load("light")
    if arrays is not None:
        trays = {
            name: sparse.csr_array(
                tuple(arrays[f"{name}_{part}"] for part in ("data", "indices", "indptr")),
                shape=tuple(arrays[f"{name}_shape"]),
            )
            for name in TRAYS
        }
        return Light(
            groups=(FiledLight(**trays, received=float(arrays["received"]), outside=float(arrays["outside"])),),
            simulation=Simulation(session.board, plan.settings),
            plan=plan,
            seed=session.seed,
            labels=arrays["labels"],
            flux=arrays["flux"],
            flux_error=arrays["flux_error"],
            paths=int(arrays["paths"]),
            sampling_error=float(arrays["sampling_error"]),
            reached=bool(arrays["reached"]),
        )
    light = session.trace(plan, job)
    facts = {
        name: getattr(light, name) for name in ("labels", "flux", "flux_error", "paths", "sampling_error", "reached")
    }
    facts |= {name: getattr(light.groups[0], name) for name in ("received", "outside")}
    for name in TRAYS:
        matrix = getattr(light.groups[0], name)
        facts |= {f"{name}_{part}": getattr(matrix, part) for part in ("data", "indices", "indptr", "shape")}
    checkpoint.save("light", facts)
    return light


def _stripe_arrays(both: tuple[StripeSums, StripeSums], saturated: int) -> dict[str, npt.ArrayLike]:
    arrays: dict[str, npt.ArrayLike] = {"saturated": saturated}
    for sums in both:
        arrays[f"{sums.side}_common"], arrays[f"{sums.side}_vectors"] = sums.common, sums.vectors[:, : sums.done]
        arrays[f"{sums.side}_sums"] = [sums.misfit, sums.energy]
    return arrays


def _stripes(
    arrays: Mapping[str, FloatArray] | None, centre: bool, count: int
) -> tuple[tuple[StripeSums, StripeSums], int] | None:
    """Sums over the finished stripes and saturated shots so far, as :func:`_stripe_arrays` put them down."""
    if arrays is None:
        return None

    def restored(side: str) -> StripeSums:
        finished = arrays[f"{side}_vectors"]
        vectors = np.empty((len(finished), count))
        vectors[:, : finished.shape[1]] = finished
        misfit, energy = map(float, arrays[f"{side}_sums"])
        return StripeSums(side, centre, arrays[f"{side}_common"], vectors, misfit, energy, finished.shape[1])

    return (restored(SIDES[0]), restored(SIDES[1])), int(arrays["saturated"])
