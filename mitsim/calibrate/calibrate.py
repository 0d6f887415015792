"""Rendered calibration sessions, and factors that are estimated from them as from a user's frames.

Sums over finished stripes are kept in the CAL folder for a resumed session, as an ``.npz`` file with a SHA-256 of
configuration and data; a damaged or foreign file is computed again. Light is traced again, because its seed makes it
bit-equal, and because tracing takes a fiftieth of a session.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.acquire.capture import colour_folder
from mitsim.acquire.spectral import SpectralBench, without_filters
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.request import Exposure, SessionRequest, Task
from mitsim.calibrate.board_session import LitSession, Response, Session, manifest_of
from mitsim.core.arrays import FloatArray
from mitsim.core.colour_files import CALIBRATION
from mitsim.core.environment import deciding_versions, versions
from mitsim.core.errors import MitsimError
from mitsim.core.files import output_folder, plain, remove_page, whole_file, whole_folder, write_json
from mitsim.core.job import Cost, Job, Limits
from mitsim.core.manifests import MANIFEST, other_request, resumable
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import integer
from mitsim.devices.framelist import LISTS, FrameList
from mitsim.devices.sensor import digital_of
from mitsim.devices.session import SIDES, load_recipe
from mitsim.light.light import SampledLight
from mitsim.light.plan import Plan
from mitsim.optics.frames import Frame
from mitsim.optics.terms import lacking
from mitsim.reconstruct.colour import behind
from mitsim.reconstruct.factors import (
    SEPARABLE_RESIDUAL,
    Estimate,
    Factors,
    ResponseFit,
    StripeSums,
    load_calibration,
    stripe_sums,
)
from mitsim.reconstruct.session_check import CheckedSession, check_session
from mitsim.reconstruct.solver import Verdict

NOISY, NOISE_FREE = "noisy", "noise_free"
"""Kinds of responses from which factors are estimated."""
_SAVED_EVERY, _SAVED_AFTER_S = 8, 0.5
"""Responses and seconds between two checkpoints."""
_REPEATS_BEHIND_FILTERS = 4
"""Default repeats behind filters, because most pixels see a tenth of a line that fills others."""
_AS_STATED = 1.2
"""Ratio of measured to stated residual up to which the stated camera explains it."""


# ---- Finished stripes of a session in its folder ----

KIND = "calibration"
STRIPES = "stripes.part.npz"
_DIGEST = hashlib.sha256().digest_size


class Checkpoint:
    def __init__(self, folder: Path | None = None, configuration: Mapping[str, Any] | None = None) -> None:
        self.folder, self.configuration = folder, dict(configuration or {})
        self._session = json.dumps(plain(self.configuration), sort_keys=True).encode()

    def begin(self) -> None:
        if self.folder is not None:
            remove_page(self.folder)
            head = {"kind": KIND, "status": "incomplete", "configuration": plain(self.configuration)}
            write_json(self.folder / MANIFEST, head)

    def save(self, arrays: Mapping[str, npt.ArrayLike]) -> None:
        if self.folder is None:
            return
        memory = io.BytesIO()
        np.savez(memory, allow_pickle=False, **{key: np.asarray(value) for key, value in arrays.items()})
        with whole_file(self.folder / STRIPES) as part, part.open("wb") as file:
            file.write(memory.getbuffer())
            file.write(self._digest(memory.getbuffer()))

    def load(self) -> dict[str, npt.NDArray[Any]] | None:
        path = None if self.folder is None else self.folder / STRIPES
        if path is None or not path.is_file():
            return None
        data = memoryview(path.read_bytes())
        if self._digest(data[:-_DIGEST]) != data[-_DIGEST:]:
            return None
        with np.load(io.BytesIO(data[:-_DIGEST]), allow_pickle=False) as arrays:
            return dict(arrays)

    def clear(self) -> None:
        if self.folder is not None:
            (self.folder / STRIPES).unlink(missing_ok=True)

    def _digest(self, data: memoryview) -> bytes:
        return hashlib.sha256(hashlib.sha256(self._session).digest() + data).digest()


# ---- Sessions ----


def calibrate(bench: Apparatus, request: SessionRequest, task: Task, frames: Path | str | None = None) -> Factors:
    """Run a calibration session and estimate the camera's factors; see :meth:`mitsim.api.bench.Bench.calibrate`.

    ``frames`` is a folder for frames that `mitsim calibrate --frames` reads. MitsimError for a recipe with depths, a
    folder that contains something, and a full disk.
    """
    session = Session(bench, (request.recipe or load_recipe()).of_one_depth(), request.seed)
    with nullcontext() if frames is None else whole_folder(frames) as folder:
        if folder is not None:
            pixels, number_bytes = math.prod(bench.geometry.frame_shape), 2 if session.as_tiff else 8
            size = Cost(disk_bytes=float(session.shots * pixels * number_bytes))
            size.check("frames", Limits(), folder)
        return _run_sessions([session], request.accuracy, task, [task.output], folder)[0]


def calibrate_depths(bench: Apparatus, request: SessionRequest, task: Task) -> dict[float, Factors]:
    """Estimate factors at each of a recipe's ``depths`` [mm], independently, in a folder for each.

    MitsimError as :func:`calibrate`, for a recipe without depths, and for a depth at which the mask or no light is.
    """
    recipe, found = request.recipe or load_recipe(), {}
    if not recipe.depths:
        raise MitsimError("recipe: has no depths; give depths = [350, 400, 450], or use calibrate")
    nearest = bench.geometry.mask_distance + bench.geometry.mask_thickness
    if min(recipe.depths) <= nearest:
        raise MitsimError(
            f"recipe: depths has {min(recipe.depths):g}, and the mask ends {nearest:g} mm from the sensor; give more"
        )
    with nullcontext() if task.output is None else output_folder(task.output, overwrite=task.resume) as folder:
        for depth in recipe.depths:
            session = Session(bench, recipe, integer(request.seed, "depth", f"{depth:g}"), depth)
            own = replace(task, job=task.job.apart(f"{depth:g} mm "))
            (found[depth],) = _run_sessions([session], request.accuracy, own, [folder and folder / f"{depth:g}"])
    return found


def calibrate_lines(whole: Apparatus, request: SessionRequest, task: Task, mosaic: bool = False) -> dict[str, Factors]:
    """Estimate factors at each line, or behind the filters of a ``mosaic``.

    See :meth:`mitsim.api.bench.Bench.calibrate_lines` and :meth:`mitsim.api.bench.Bench.calibrate_mosaic`.
    """
    bench = SpectralBench.of(without_filters(whole) if mosaic else whole, CALIBRATION)
    if mosaic and request.recipe is None:
        recipe = load_recipe().model_copy(update={"repeats": _REPEATS_BEHIND_FILTERS})
        request = request.model_copy(update={"recipe": recipe})
    assert bench.manifest is not None
    names, filters = bench.names, bench.whole.filters
    passed: Sequence[FloatArray | None] = [None] * len(names)
    if filters is not None:
        weights = np.array(filters.planes(bench.manifest.wavelengths_nm))
        if (dark := np.argwhere(weights == 0)).size:
            plane, line = dark[0]
            raise MitsimError(
                f"camera {bench.whole.devices.camera_file}: its {str(filters.mosaic)[plane]} filters "
                f"pass nothing of {names[line]}, so its calibration lacks pixels; use a projector whose lines all "
                "filters pass"
            )
        passed = list(behind(weights, bench.whole.geometry.frame_shape))
    white = Session(bench.whole, (request.recipe or load_recipe()).of_one_depth(), request.seed)
    sessions = [
        replace(white, bench=each, filters=own, whole=white) for each, own in zip(bench.benches, passed, strict=True)
    ]
    with colour_folder(task, bench.manifest) as folder:
        places = [folder and folder / name for name in names]
        return dict(zip(names, _run_sessions(sessions, request.accuracy, task, places), strict=True))


@single_threaded_blas()
def _run_sessions(
    lines: Sequence[Session], accuracy: float, task: Task, places: Sequence[Path | None], frames: Path | None = None
) -> list[Factors]:
    for session in lines:
        session.check_mask(task.job)
    found, job, whole = list[Factors](), task.job, lines[0].whole or lines[0]
    plan: Plan | None = None
    lights: list[SampledLight] = []
    for number, (session, place) in enumerate(zip(lines, places, strict=True)):
        bench, recipe = session.bench, session.recipe
        Exposure(None, recipe.exposure_fraction).check(bench.sensor, bench.devices.camera_file)
        configuration = {
            **bench.provenance(),
            **bench.identity(),
            "accuracy": accuracy,
            "seed": session.seed,
            **({} if session.depth is None else {"depth_mm": session.depth}),
            "recipe": recipe.model_dump(exclude_defaults=True, exclude={"depths"}),
            "versions": deciding_versions(),
        }
        again = task.resume and place is not None and (place / MANIFEST).is_file()
        if again and place is not None:
            before, own = resumable(place, KIND), plain(configuration)
            earlier = before["configuration"] if isinstance(before.get("configuration"), dict) else {}
            if earlier != own:
                raise other_request(place, "a session", earlier, own)
            if session.depth is not None and before.get("status") == "complete":
                return [load_calibration(place)]
        # The folder is claimed before any work; a new one is removed if the session fails before writing.
        with nullcontext() if place is None else output_folder(place, overwrite=again) as folder:
            checkpoint = Checkpoint(folder, configuration)
            plan = plan or whole.plan(accuracy, job)
            checkpoint.begin()
            lights = lights or whole.trace(plan, job, [each.board for each in lines])
            lit = replace(LitSession.of(session, lights[number], job), kept=frames)
            found.append(_factors(lit, checkpoint, job))
    return found


def _factors(lit: LitSession, checkpoint: Checkpoint, job: Job) -> Factors:
    session, plan = lit.session, lit.light.plan
    bench, digital = session.bench, digital_of(session.bench.sensor, lit.exposure_s)
    (noisy, clean), saturated, faults = estimates(lit, job, (NOISY, NOISE_FREE), checkpoint)
    if lit.kept is not None:
        listed = FrameList(
            camera=bench.identity(),
            n=bench.n,
            signed_capture=session.recipe.signed_capture,
            repeats=session.recipe.repeats,
            digital=digital,
            centre=bench.geometry.centred,
            board_reflectance=session.recipe.board_reflectance,
            frames=tuple(session.files.values()),
        )
        write_json(lit.kept / LISTS[1], listed.model_dump(mode="json", exclude_defaults=True))
    physics, lacks = lit.light.simulation.physics, None
    if physics.geometry.few_wave_terms:
        lacks = lacking(session.shadow(physics.geometry, physics.spectrum), clean.left, clean.right)
    # The warnings of the session name the residual that the stated mask and sensor explain.
    stated = _AS_STATED * np.hypot(clean.separability_residual, bench.sensor.response_parts[0])
    named = session.warnings and noisy.status.verdict is Verdict.NOT_SEPARABLE and noisy.unexplained < stated
    reasons = () if named else noisy.status.reasons
    warnings = (*lit.light.warnings, *session.warnings, *reasons, *faults.warnings)
    if saturated:
        warnings += (
            f"saturation: {saturated} of {session.shots} frames have pixels at the full well or the ADC's end, "
            "so responses are not linear; lower the recipe's exposure_fraction",
        )
    # (left, right) and (-left, -right) are the same camera, and centred factors have no sum that decides the sign.
    sign = 1.0 if np.vdot(noisy.left, clean.left) >= 0 else -1.0
    left = np.linalg.norm(sign * noisy.left - clean.left) / np.linalg.norm(clean.left)
    right = np.linalg.norm(sign * noisy.right - clean.right) / np.linalg.norm(clean.right)
    result = {
        "n": bench.n,
        "depth_mm": session.distance,
        "frames": session.shots,
        "separability_residual": noisy.separability_residual,
        "unexplained_residual": noisy.unexplained,
        "noise_free_residual": clean.separability_residual,
        "phi_error": float(np.hypot(left, right)),
        "faults": [asdict(fault) for fault in faults.faults],
        "lamp": faults.lamp,
        "shadow_residual": lacks and lacks.residual,
        "condition": noisy.condition,
        "exposure_s": lit.exposure_s,
        "seconds": job.clock.seconds(),
        "kernels": job.clock.kernels(),
        "predicted": plan.predicted,
        "predicted_seconds": plan.predicted_seconds,
        "predicted_memory_bytes": plan.cost and plan.cost.memory_bytes,
        "warnings": warnings,
    }
    made: dict[str, Any] = {"configuration": checkpoint.configuration, "versions": versions(), "command": job.command}
    made |= {"result": result, "warnings": warnings, "opened": bench.opened}
    manifest = manifest_of(bench, digital, session.recipe.board_reflectance, session.distance, **made)
    much = lacks is not None and lacks.residual > SEPARABLE_RESIDUAL
    factors = Factors.of(noisy, manifest, lacks.terms if lacks and much else ())
    if checkpoint.folder is not None:
        factors.write(checkpoint.folder)
        checkpoint.clear()
    return factors


def estimate(lit: LitSession, job: Job, noise_free: bool = False) -> tuple[Estimate, int]:
    (found,), saturated, _ = estimates(lit, job, (NOISE_FREE if noise_free else NOISY,))
    return found, saturated


@single_threaded_blas()
def estimates(
    lit: LitSession, job: Job, kinds: Sequence[str], checkpoint: Checkpoint | None = None
) -> tuple[list[Estimate], int, CheckedSession]:
    session, (found, saturated) = lit.session, session_sums(lit, job, kinds, checkpoint)
    drift = session.recipe.drift
    # A stated drift of the lamp is not divided out, so that the user sees its effect.
    unsteady = bool(drift.session_ramp or drift.session_flicker)
    with job.clock.stage("estimate"):
        judged, clean = [CheckedSession(sums) for sums in found.values()], found.get(NOISE_FREE)
        if kinds[0] == NOISY:
            try:
                judged[0] = check_session(
                    found[NOISY],
                    session.signs,
                    session.order,
                    saturated=bool(saturated),
                    unsteady=unsteady,
                    stated=clean,
                )
            except MitsimError as error:
                # A real session would be refused. A simulated one is flagged, because the bench asks for it, and
                # comparison with exact factors shows the loss.
                judged[0].doubts += [*session.mask_warnings[:1], str(error)]
        noises = [lit.response_noise if kind == NOISY else None for kind in kinds]
        factors = [each.estimate(session.signs, noise) for each, noise in zip(judged, noises, strict=True)]
    return factors, saturated, judged[0]


def session_sums(
    lit: LitSession, job: Job, kinds: Sequence[str], checkpoint: Checkpoint | None = None
) -> tuple[dict[str, tuple[StripeSums, StripeSums]], int]:
    """Return sums over all responses of a session by kind, whose frames are formed once, and its saturated frames.

    ``kinds`` are ``NOISY``, ``NOISE_FREE`` or both; ``checkpoint`` has finished stripes of an interrupted session.
    """
    session, checkpoint, found = lit.session, checkpoint or Checkpoint(), dict[str, tuple[StripeSums, StripeSums]]()
    count = session.signs.shape[1]

    def respond(side: str, number: int, frame: Frame) -> list[Response]:
        return [lit.noisy(side, number, frame) if kind == NOISY else Response(lit.noise_free(frame)) for kind in kinds]

    def fit_responses(sums: Sequence[StripeSums], shown: tuple[int, Frame]) -> list[tuple[ResponseFit, int]]:
        each = zip(sums, respond(sums[0].side, *shown), strict=True)
        return [(own.fit_response(r.rate, r.light), r.saturated) for own, r in each]

    if (arrays := checkpoint.load()) is not None:
        saturated = int(arrays["saturated"])
        for kind in kinds:
            both = []
            for side in SIDES:
                begin = f"{kind}_{side}_"
                own = {name[len(begin) :]: values for name, values in arrays.items() if name.startswith(begin)}
                both.append(StripeSums(side, bool(own["centre"]), own["common"], own["vectors"]))
                vars(both[-1]).update((name, each if each.ndim else each.item()) for name, each in own.items())
            found[kind] = both[0], both[1]
    else:
        saturated = 0
        with job.clock.stage("sensor"):
            uniform = zip(kinds, *(respond(side, 0, lit.white) for side in SIDES), strict=True)
            for kind, one, other in uniform:
                lights = one.light, other.light
                found[kind] = stripe_sums(one.rate, other.rate, count, session.bench.geometry.centred, lights=lights)
                saturated += one.saturated + other.saturated
    saved = time.monotonic()
    for side, sums in zip(SIDES, zip(*found.values(), strict=True), strict=True):
        for fitted in lit.each(side, partial(fit_responses, sums), job, sums[0].done):
            for own_sums, (fit, full) in zip(sums, fitted, strict=True):
                own_sums.put(fit)
                saturated += full
            due = sums[0].done % _SAVED_EVERY == 0 and time.monotonic() >= saved + _SAVED_AFTER_S
            if due or sums[0].done == count:
                parts: dict[str, npt.ArrayLike] = {"saturated": saturated}
                for kind, each in product(kinds, (0, 1)):
                    named = vars(found[kind][each]).items()
                    parts |= {f"{kind}_{SIDES[each]}_{name}": values for name, values in named if name != "side"}
                checkpoint.save(parts)
                saved = time.monotonic()
    return found, saturated
