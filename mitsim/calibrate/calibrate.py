"""From a bench to the camera's factors and their error: a rendered session, estimated as a user's frames would be."""

from __future__ import annotations

import hashlib
import io
import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from mitsim.acquire.capture import digital_scale
from mitsim.bench.bench import Apparatus
from mitsim.bench.request import Exposure
from mitsim.calibrate.session import MOST_TIFF, KeptFrames, LitSession, Response, Session
from mitsim.core.arrays import FloatArray
from mitsim.core.environment import deciding_versions, versions
from mitsim.core.errors import MitsimError
from mitsim.core.files import PARTS, output_folder, plain, read_json, sweep, whole_file, whole_folder, write_json
from mitsim.core.job import Clock, Job
from mitsim.core.manifests import MANIFEST, CalibrationManifest, resumable
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.resources import Cost, Limits
from mitsim.core.seeds import integer
from mitsim.devices.session import SIDES, SessionRecipe, load_recipe
from mitsim.light.grids import GRIDS, LightEstimate
from mitsim.light.light import SampledLight
from mitsim.light.passes import Simulation
from mitsim.light.plan import Plan
from mitsim.optics.frames import Frame
from mitsim.optics.separable import Lacking, lacking
from mitsim.reconstruct.estimate_factors import (
    SEPARABLE_RESIDUAL,
    Estimate,
    PairSeen,
    PairSums,
    Seen,
    StripeSums,
    stripe_sums,
)
from mitsim.reconstruct.factors import Factors, load_calibration
from mitsim.reconstruct.session_faults import Checked, Circumstances, check_session
from mitsim.reconstruct.faults import frame_words

NOISY, NOISE_FREE = "noisy", "noise_free"
"""Kinds of responses that factors are estimated from."""
_SAVED_EVERY, _SAVED_AFTER_S = 8, 0.5
"""Responses between two checkpoints, half of those that are looked at at once, or twice as many at 2048 pixels; and
seconds, as each takes some ten milliseconds."""
_STRIPES = "stripes"
"""The part of a checkpoint that holds the sums over finished responses."""


def calibrate(
    bench: Apparatus,
    seed: int = 0,
    accuracy: float = 1e-3,
    recipe: SessionRecipe | None = None,
    output: Path | str | None = None,
    resume: bool = False,
    job: Job | None = None,
) -> Factors:
    """Run a calibration session and estimate the camera's factors; see :meth:`mitsim.api.bench.Bench.calibrate`.

    Where the recipe has ``depths``, see :func:`calibrate_depths`.

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
    session = Session(bench, (recipe or load_recipe()).of_one_depth(), seed)
    return calibrate_session(session, accuracy, output, resume, job or Job())


def calibrate_depths(
    bench: Apparatus,
    seed: int = 0,
    accuracy: float = 1e-3,
    recipe: SessionRecipe | None = None,
    output: Path | str | None = None,
    resume: bool = False,
    job: Job | None = None,
) -> dict[float, Factors]:
    """The camera's factors at each of a recipe's ``depths``, by depth [mm].

    Parameters
    ----------
    bench, seed, accuracy, recipe, resume, job
        as for :func:`calibrate`. Each depth has light and noise of its own, whatever others there are.
    output
        folder of a CAL folder for each depth, called by its millimetres; None keeps the factors in memory.

    Raises
    ------
    MitsimError
        as :func:`calibrate`, for a recipe without depths, and for one at which the mask or no light is.
    """
    recipe, job = recipe or load_recipe(), job or Job()
    if not recipe.depths:
        raise MitsimError("recipe: has no depths; give depths = [350, 400, 450], or use calibrate")
    nearest = bench.geometry.mask_distance + bench.geometry.mask_thickness
    if min(recipe.depths) <= nearest:
        raise MitsimError(
            f"recipe: depths has {min(recipe.depths):g}, and the mask ends {nearest:g} mm from the sensor; give more"
        )
    found = {}
    with nullcontext() if output is None else output_folder(output, overwrite=resume) as folder:
        for depth in recipe.depths:
            session = Session(bench, recipe, integer(seed, "depth", f"{depth:g}"), depth)
            place = None if folder is None else folder / f"{depth:g}"
            found[depth] = calibrate_session(session, accuracy, place, resume, replace(job, clock=Clock()))
    return found


def write_session(
    bench: Apparatus,
    frames: Path | str,
    output: Path | str | None = None,
    seed: int = 0,
    accuracy: float = 1e-3,
    recipe: SessionRecipe | None = None,
    job: Job | None = None,
) -> Factors:
    """What :func:`calibrate` does, and its frames in a folder as `mitsim calibrate --frames` reads it.

    Parameters
    ----------
    bench, output, seed, accuracy, recipe, job
        as there.
    frames
        new or empty folder.

    Raises
    ------
    MitsimError
        as there, for a recipe with depths, a folder that holds something, and a disk without room.
    """
    session = Session(bench, (recipe or load_recipe()).of_one_depth(), seed)
    with whole_folder(frames) as folder:
        number_bytes = 2 if (bench.sensor.largest_dn or math.inf) <= MOST_TIFF else 8
        size = Cost(disk_bytes=float(session.shots * math.prod(bench.geometry.frame_shape) * number_bytes))
        size.check("frames", Limits(), folder)
        return calibrate_session(session, accuracy, output, False, job or Job(), folder)


def calibrate_session(
    session: Session, accuracy: float, output: Path | str | None, resume: bool, job: Job, frames: Path | None = None
) -> Factors:
    """Run a ``session`` and estimate the camera's factors.

    Parameters
    ----------
    session
        what is shown.
    accuracy, output, resume, job
        as for :func:`calibrate`.
    frames
        folder that its frames are written to.
    """
    bench, recipe = session.bench, session.recipe
    Exposure(None, recipe.exposure_fraction).check(bench.sensor, bench.rig.camera_file)
    configuration = {
        **bench.provenance(),
        **bench.identity(),
        "accuracy": accuracy,
        "seed": session.seed,
        **({} if session.depth is None else {"depth_mm": session.depth}),
        "recipe": recipe.model_dump(exclude_defaults=True, exclude={"depths"}),
        "versions": deciding_versions(),
    }
    if session.depth is not None and resume and output is not None and is_finished(output, configuration):
        return load_calibration(output)
    with claimed_session(output, configuration, resume) as checkpoint:
        plan = session.plan(accuracy, job)
        checkpoint.begin()
        lit = session.lit(_light(session, plan, checkpoint, job), job)
        if frames is not None:
            lit = replace(lit, kept=KeptFrames(session, frames))
        (noisy, clean), saturated, found = checked_estimates(lit, job, (NOISY, NOISE_FREE), checkpoint)
        if lit.kept is not None:
            lit.kept.finish(digital_scale(bench, lit.exposure_s))
        lacks = _lacking(lit, clean)
        warnings = lit.light.warnings + session.warnings + (() if noisy.ok else (str(noisy.status),))
        warnings += found.warnings(frame_words)
        if saturated:
            warnings += (
                f"saturation: {saturated} of {session.shots} frames have pixels at the full well or the ADC's end, "
                "so responses are not linear; lower the recipe's exposure_fraction",
            )
        result = {
            "n": bench.n,
            "depth_mm": session.distance,
            "frames": session.shots,
            "separability_residual": noisy.separability_residual,
            "unexplained_residual": noisy.unexplained,
            "noise_free_residual": clean.separability_residual,
            "phi_error": _factor_error(noisy, clean),
            "faults": found.listed(frame_words),
            "lamp": found.lamp.listed(),
            "shadow_residual": lacks and lacks.residual,
            "condition": noisy.condition,
            "exposure_s": lit.exposure_s,
            "seconds": job.clock.seconds(),
            "predicted": plan.predicted,
            "predicted_seconds": plan.predicted_seconds,
            "predicted_memory_bytes": plan.cost and plan.cost.memory_bytes,
            "warnings": warnings,
        }
        manifest = CalibrationManifest(
            configuration=configuration,
            camera=bench.identity(),
            centre=session.centre,
            board_reflectance=recipe.board_reflectance,
            digital=digital_scale(bench, lit.exposure_s),
            parallax=bench.parallax_from(session.distance),
            result=result,
            warnings=warnings,
            versions=versions(),
        )
        much = lacks is not None and lacks.residual > SEPARABLE_RESIDUAL
        factors = Factors.of(noisy, manifest, lacks.terms if lacks and much else ())
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
    (found,), saturated = estimates(lit, job, (NOISE_FREE if noise_free else NOISY,), checkpoint)
    return found, saturated


def estimates(
    lit: LitSession, job: Job, kinds: Sequence[str], checkpoint: Checkpoint | None = None
) -> tuple[list[Estimate], int]:
    """Factors from each kind of responses to a session, and its saturated shots.

    Parameters
    ----------
    lit, job, kinds, checkpoint
        as for :func:`checked_estimates`.
    """
    found, saturated, _ = checked_estimates(lit, job, kinds, checkpoint)
    return found, saturated


@single_threaded_blas()
def checked_estimates(
    lit: LitSession, job: Job, kinds: Sequence[str], checkpoint: Checkpoint | None = None
) -> tuple[list[Estimate], int, Checked]:
    """Factors from each kind of responses to a session, whose frames are formed once, its saturated shots, and what its
    noisy frames show of faults.

    Parameters
    ----------
    lit, job, checkpoint
        as for :func:`estimate`.
    kinds
        of ``NOISY`` and ``NOISE_FREE``, one or both.
    """
    session, checkpoint = lit.session, checkpoint or Checkpoint()
    count = session.signs.shape[1]
    stripes = _restored(checkpoint.load(_STRIPES), kinds, session)
    if stripes is None:
        with job.clock.stage("sensor"):
            first = [list(_responses(lit, kinds, side, 0, lit.white)) for side in SIDES]
        both = [
            stripe_sums(left.rate, right.rate, count, session.centre, lights=(left.light, right.light))
            for left, right in zip(*first, strict=True)
        ]
        stripes = _Stripes(dict(zip(kinds, both, strict=True)), sum(each.saturated for side in first for each in side))
        del first
    saved = time.monotonic()
    for side, sums in zip(SIDES, zip(*stripes.sums.values(), strict=True), strict=True):
        for looked in lit.each(side, partial(_looked, lit, kinds, sums), job, sums[0].done):
            for own, (seen, saturated) in zip(sums, looked, strict=True):
                own.put(seen)
                stripes.saturated += saturated
            due = sums[0].done % _SAVED_EVERY == 0 and time.monotonic() >= saved + _SAVED_AFTER_S
            if due or sums[0].done == count:
                checkpoint.save(_STRIPES, stripes.arrays())
                saved = time.monotonic()
    drift = session.recipe.drift
    # Who states that the lamp drifts asks what that costs, which is gone once it is divided out.
    unsteady = bool(drift.session_ramp or drift.session_flicker)
    sensor = session.bench.sensor
    step = 0.0 if sensor.largest_dn is None else 1 / sensor.gain_dn_per_e / lit.exposure_s
    taken = Circumstances(session.order, saturated=bool(stripes.saturated), unsteady=unsteady, step=step)
    with job.clock.stage("estimate"):
        judged = [
            check_session(stripes.sums[kind], session.signs, taken) if kind == NOISY else Checked(stripes.sums[kind])
            for kind in kinds
        ]
        found = [
            each.estimate(session.signs, lit.response_noise if kind == NOISY else None)
            for kind, each in zip(kinds, judged, strict=True)
        ]
    return found, stripes.saturated, judged[0]


def _responses(lit: LitSession, kinds: Sequence[str], side: str, number: int, frame: Frame) -> Iterator[Response]:
    """Each of the ``kinds`` of responses to a pattern, as :meth:`LitSession.each` has it."""
    for kind in kinds:
        yield lit.noisy(side, number, frame) if kind == NOISY else Response(lit.noise_free(frame))


def _looked(
    lit: LitSession, kinds: Sequence[str], sums: Sequence[StripeSums], shown: tuple[int, Frame]
) -> list[tuple[Seen, int]]:
    """What the responses to a pattern add to the ``sums`` of each kind, and their saturated shots."""
    responses = _responses(lit, kinds, sums[0].side, *shown)
    return [
        (own.seen(each.rate, shown[0], each.light), each.saturated) for own, each in zip(sums, responses, strict=True)
    ]


def _lacking(lit: LitSession, clean: Estimate) -> Lacking | None:
    """What ``clean`` factors lack of the camera that is simulated in a ``lit`` session; None where its shadow is no sum
    of few terms."""
    physics = lit.light.simulation.physics
    if not physics.geometry.few_wave_terms:
        return None
    return lacking(lit.session.shadow(physics.geometry, physics.spectrum), clean.left, clean.right)


def _factor_error(noisy: Estimate, clean: Estimate) -> float:
    """Relative error of both factors, in quadrature.

    (left, right) and (-left, -right) are one camera; centred factors have no sum that would tell which it is.
    """
    sign = 1.0 if np.vdot(noisy.left, clean.left) >= 0 else -1.0
    left = np.linalg.norm(sign * noisy.left - clean.left) / np.linalg.norm(clean.left)
    right = np.linalg.norm(sign * noisy.right - clean.right) / np.linalg.norm(clean.right)
    return float(np.hypot(left, right))


# ---- what a checkpoint holds -----------------------------------------------------------------------------------------


def _light(session: Session, plan: Plan, checkpoint: Checkpoint, job: Job) -> SampledLight:
    """The board's light, from the checkpoint if it is there."""
    arrays = checkpoint.load("light")
    if arrays is not None:
        by_grid = {
            name: sparse.csr_array(
                tuple(arrays[f"{row.key}_{part}"] for part in ("data", "indices", "indptr")),
                shape=tuple(arrays[f"{row.key}_shape"]),
            )
            for name, row in GRIDS.items()
        }
        return SampledLight(
            groups=(LightEstimate(by_grid, float(arrays["received"]), float(arrays["outside"])),),
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
    for name, row in GRIDS.items():
        matrix = light.groups[0][name]
        facts |= {f"{row.key}_{part}": getattr(matrix, part) for part in ("data", "indices", "indptr", "shape")}
    checkpoint.save("light", facts)
    return light


@dataclass
class _Stripes:
    """Sums over finished stripes by kind, horizontal and vertical ones, and ``saturated`` shots so far."""

    sums: dict[str, tuple[StripeSums, StripeSums]]
    saturated: int

    def arrays(self) -> dict[str, npt.ArrayLike]:
        """What a checkpoint holds of them."""
        arrays: dict[str, npt.ArrayLike] = {"saturated": self.saturated}
        for kind, both in self.sums.items():
            for sums in both:
                name = f"{kind}_{sums.side}"
                arrays[f"{name}_common"], arrays[f"{name}_vectors"] = sums.common, sums.vectors[:, : sums.done]
                arrays[f"{name}_sums"] = [sums.misfit, sums.energy]
                arrays[f"{name}_each"] = [each[: sums.done] for each in (sums.misfits, sums.energies, sums.fluxes)]
                if sums.pairs is not None:
                    pairs = sums.pairs
                    arrays[f"{name}_light"] = pairs.light[:, : sums.done]
                    arrays[f"{name}_rows"], arrays[f"{name}_columns"] = (
                        pairs.rows[: sums.done],
                        pairs.columns[: sums.done],
                    )
        return arrays


def _restored(arrays: Mapping[str, FloatArray] | None, kinds: Sequence[str], session: Session) -> _Stripes | None:
    """What :meth:`_Stripes.arrays` put down of these ``kinds``."""
    if arrays is None:
        return None

    def restored(kind: str, side: str) -> StripeSums:
        finished = arrays[f"{kind}_{side}_vectors"]
        vectors = np.empty((len(finished), session.signs.shape[1]))
        vectors[:, : finished.shape[1]] = finished
        misfit, energy = map(float, arrays[f"{kind}_{side}_sums"])
        common = arrays[f"{kind}_{side}_common"]
        sums = StripeSums(side, session.centre, common, vectors, misfit, energy, finished.shape[1])
        for own, finished in zip(
            (sums.misfits, sums.energies, sums.fluxes), arrays[f"{kind}_{side}_each"], strict=True
        ):
            own[: sums.done] = finished
        if f"{kind}_{side}_light" in arrays:
            light, rows, columns = (arrays[f"{kind}_{side}_{part}"] for part in ("light", "rows", "columns"))
            seen = [PairSeen(*parts) for parts in zip(light.T, rows, columns, strict=True)]
            sums.pairs = PairSums.empty(seen[0], vectors.shape[1])
            for number, each in enumerate(seen):
                sums.pairs.put(number, each)
        return sums

    return _Stripes(
        {kind: (restored(kind, SIDES[0]), restored(kind, SIDES[1])) for kind in kinds}, int(arrays["saturated"])
    )


# -------- What is finished of a calibration session, in its CAL folder until the whole is

KIND = "calibration"
_SUFFIX = PARTS.removeprefix("*")
_DIGEST = hashlib.sha256().digest_size


class Checkpoint:
    """Parts of one session; without a folder nothing is kept."""

    def __init__(self, folder: Path | None = None, configuration: Mapping[str, Any] | None = None) -> None:
        """Parts in ``folder``, of the session with this ``configuration``."""
        self.folder, self._configuration = folder, plain(configuration or {})
        self._session = json.dumps(self._configuration, sort_keys=True).encode()

    def begin(self) -> None:
        """Mark the folder as an unfinished session, and clear what a killed process left half-written."""
        if self.folder is not None:
            sweep(self.folder)
            head = {"kind": KIND, "status": "incomplete", "configuration": self._configuration}
            write_json(self.folder / MANIFEST, head)

    def save(self, name: str, arrays: Mapping[str, npt.ArrayLike]) -> None:
        """Write ``arrays`` as the part ``name``, whole or not at all. MitsimError when it cannot be written."""
        if self.folder is None:
            return
        memory = io.BytesIO()
        np.savez(memory, allow_pickle=False, **{key: np.asarray(value) for key, value in arrays.items()})
        with whole_file(self.folder / f"{name}{_SUFFIX}") as part, part.open("wb") as file:
            file.write(memory.getbuffer())
            file.write(self._digest(memory.getbuffer()))

    def load(self, name: str) -> dict[str, npt.NDArray[Any]] | None:
        """The arrays of the part ``name``; None when it is not there, damaged, or of another session."""
        path = None if self.folder is None else self.folder / f"{name}{_SUFFIX}"
        if path is None or not path.is_file():
            return None
        data = memoryview(path.read_bytes())
        if self._digest(data[:-_DIGEST]) != data[-_DIGEST:]:
            return None
        with np.load(io.BytesIO(data[:-_DIGEST]), allow_pickle=False) as arrays:
            return dict(arrays)

    def clear(self) -> None:
        """Remove the parts of a session that is complete."""
        if self.folder is not None:
            for path in self.folder.glob(PARTS):
                path.unlink()

    def _digest(self, data: memoryview) -> bytes:
        return hashlib.sha256(hashlib.sha256(self._session).digest() + data).digest()


@contextmanager
def claimed_session(
    output: Path | str | None, configuration: Mapping[str, Any], resume: bool = False
) -> Iterator[Checkpoint]:
    """The place for a session's parts, checked before any work; if the session fails before writing, a new folder is
    removed.

    Parameters
    ----------
    output
        CAL folder; None keeps nothing.
    configuration
        all that decides the factors.
    resume
        whether the folder may hold a session of the same configuration.

    Raises
    ------
    MitsimError
        for a place that cannot be written, or that holds something else or another configuration.
    """
    if output is None:
        yield Checkpoint()
        return
    path = Path(output)
    again = resume and (path / MANIFEST).is_file()
    if again:
        _check_same(path, plain(configuration))
    with output_folder(path, overwrite=again) as folder:
        yield Checkpoint(folder, configuration)


def is_finished(output: Path | str, configuration: Mapping[str, Any]) -> bool:
    """Whether the folder ``output`` holds a finished session; MitsimError when its ``configuration`` is another."""
    path = Path(output)
    if not (path / MANIFEST).is_file():
        return False
    _check_same(path, plain(configuration))
    return bool(read_json(path / MANIFEST).get("status") == "complete")


def _check_same(path: Path, configuration: Mapping[str, Any]) -> None:
    before = resumable(path, KIND).get("configuration")
    before = before if isinstance(before, dict) else {}
    changed = [key for key in {**configuration, **before} if before.get(key) != configuration.get(key)]
    if changed:
        raise MitsimError(
            f"resume=True: {path} holds a session of another configuration ({', '.join(changed)} differ); "
            "use the same options, or another folder"
        )
