"""Captures of known pictures and their list in; the camera's factors, with their error and how the pictures lie, out.

No stripes and no board: anything whose picture is known, prints, screens, images by another calibration. All planes of
a colour sensor see one mask: their codes are fitted together.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError, check_arguments
from mitsim.core.files import output_folder
from mitsim.core.job import Job
from mitsim.core.manifests import CalibrationManifest, FactorNoise
from mitsim.core.spectral_manifests import CALIBRATION, write_colours
from mitsim.devices.knownlist import MOST_TERMS, KnownCaptures, load_known
from mitsim.reconstruct.aged_calibration import mend_factors
from mitsim.reconstruct.estimate_factors import (
    LARGEST_ERROR,
    SEPARABLE_RESIDUAL,
    UNKNOWN_NOISE,
    rank_above_noise,
    squared_condition,
)
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.known_frames import KnownFrames
from mitsim.reconstruct.shifted_codes import (
    Choice,
    Codes,
    Exposure,
    Pose,
    Shape,
    choose_terms,
    find_pose,
    fit_codes,
)
from mitsim.reconstruct.solution import Status, Verdict

_MOST_TRIED = 3
"""Codes of a side that are tried where the list does not say how many."""


@check_arguments
def calibrate_known(
    listed: Path | str | KnownCaptures,
    output: Path | str | None = None,
    job: Job | None = None,
    aged: Path | str | None = None,
) -> dict[str, Factors]:
    """A camera's factors by captures of known pictures.

    Parameters
    ----------
    listed
        list of runs and pictures, TOML or JSON; or what :func:`mitsim.devices.knownlist.load_known` says of it.
    output
        CAL folder that is written, of several planes a coloured one; None keeps the factors in memory.
    job
        clock and progress.
    aged
        CAL folder of this camera before its mask, projector or light moved: its factors are moved until frames fit.
        None: factors are made of pictures alone.

    Returns
    -------
    dict
        Factors by the runs' planes; "" where runs have none. Flagged where frames hold more than the codes, or factors
        that moved, explain, or pictures do not tell how they lie.

    Raises
    ------
    MitsimError
        for a list, a run or a picture that breaks a rule, pictures of another size than the runs' scene or that lie
        otherwise than images by ``aged``, a calibration of another camera, and an output that cannot be written.
    """
    captures = listed if isinstance(listed, KnownCaptures) else load_known(listed)
    job = job or Job()
    with nullcontext() if output is None else output_folder(output) as place:
        found = _calibrate(captures, job) if aged is None else mend_factors(captures, Path(aged), job)
        if place is not None:
            for name, factors in found.items():
                (place / name).mkdir(exist_ok=True)
                factors.write(place / name)
            if captures.lines is not None:
                write_colours(place, captures.lines.model_copy(update={"kind": CALIBRATION}))
    return found


def _calibrate(captures: KnownCaptures, job: Job) -> dict[str, Factors]:
    listed = captures.listed
    with job.clock.stage("read"):
        read = KnownFrames.of(captures)
    job.progress("pose", 0.2)
    with job.clock.stage("pose"):
        pose = find_pose(read.exposures, listed.orientation, listed.scale)
    turned = [each.turn_scene(pose.orientation) for each in read.exposures]
    shape = Shape(pose.scales, 1, listed.centre)
    job.progress("choice", 0.5)
    with job.clock.stage("choice"):
        choice = Choice(listed.terms) if listed.terms else choose_terms(turned, shape, min(_MOST_TRIED, MOST_TERMS))
    job.progress("fit", 0.8)
    with job.clock.stage("fit"):
        codes = fit_codes(turned, Shape(pose.scales, choice.terms, listed.centre))
    return {name: _factors(captures, read, pose, choice, codes, name, job) for name in captures.manifests}


# ---- Codes as factors ----


def _factors(
    captures: KnownCaptures, read: KnownFrames, pose: Pose, choice: Choice, codes: Codes, line: str, job: Job
) -> Factors:
    """Factors of the plane ``line``."""
    listed, manifest = captures.listed, captures.manifests[line]
    if "transposed" in pose.orientation:
        raise MitsimError(
            f"list {captures.path}: pictures lie {pose.orientation} before the camera, and its factors are of rows and "
            "columns; save the pictures transposed, or turn the frames as they are imported"
        )
    left, right = codes.factors(read.places.get(line, (0.0, 0.0)), line)
    # Images lie as pictures do: a scene that is turned is one whose factors run the other way.
    left = left[:, ::-1] if pose.orientation in ("upside down", "turned") else left
    right = right[:, ::-1] if pose.orientation in ("mirrored", "turned") else right
    left, right = (np.ascontiguousarray(side, dtype=np.float32).astype(np.float64) for side in (left, right))
    root = np.sqrt(abs(codes.gains[line]))
    norms = [float(np.linalg.norm(side) / np.sqrt(side.size)) for side in (left, right)]
    whole, seen = (
        [root * error / norm for error, norm in zip(errors, norms, strict=True)]
        for errors in (codes.errors, codes.seen_errors)
    )
    explained, unexplained, chi_square = read.misfit(
        (_model(codes, each.turn_scene(pose.orientation)), 0.0) for each in read.exposures
    )
    rank = [rank_above_noise(side, error) for side, error in zip((left, right), whole, strict=True)]
    status = _status(
        choice, codes, (explained, unexplained), bool(np.isfinite(read.noises).all()), float(np.hypot(*seen)), rank
    )
    # Without its figures, which differ by plane.
    warnings = (*_warnings(captures, read, pose), *(() if status.ok else (f"{status.sentence}; {status.remedy}.",)))
    lengths = [side.length * side.terms for side in codes.sides]
    result: dict[str, Any] = {
        "n": left.shape[1],
        "frames": read.frames,
        "pictures": len(listed.known),
        "orientation": pose.orientation,
        "orientation_margin": pose.margin,
        "scale": list(pose.scales),
        "terms": choice.terms,
        "held_out": list(choice.held_out),
        "explained": explained,
        "chi_square": chi_square,
        "separability_residual": float(np.sqrt(max(1 - explained, 0.0))),
        "unexplained_residual": unexplained,
        "noise_free_residual": None,
        "phi_error": None,
        "predicted_phi_error": float(np.hypot(*whole)),
        "predicted_frame_error": float(np.hypot(*seen)),
        "code_numbers": lengths,
        "told": list(codes.told),
        "rank": rank,
        "condition": max(squared_condition(left), squared_condition(right)),
        "exposure_s": manifest.digital.exposure_s,
        "saturated_runs": read.saturated,
        "seconds": job.clock.seconds(),
        "warnings": warnings,
    }
    stated = CalibrationManifest(
        configuration={
            "known": str(captures.path),
            "list": listed.model_dump(mode="json"),
            "sha256": read.sums,
            **({"turn_deg": read.prepared.turn_deg} if read.prepared.turn_deg else {}),
        },
        camera=manifest.camera,
        centre=listed.centre,
        board_reflectance=listed.board_reflectance,
        digital=manifest.digital,
        noise=FactorNoise(left=seen[0] * norms[0], right=seen[1] * norms[1], unexplained=unexplained),
        result=result,
        warnings=warnings,
        versions=versions(),
        command=job.command,
        estimate=str(status),
        verdict=status.verdict.value,
    )
    return Factors(left, right, stated, status)


def _model(codes: Codes, exposure: Exposure) -> FloatArray:
    """The frame of an ``exposure``, its scene turned as the code runs."""
    left, right = codes.factors(exposure.offset, exposure.plane)
    return np.asarray(left @ exposure.scene @ right.T)


def _status(
    choice: Choice, codes: Codes, parts: tuple[float, float], stated: bool, error: float, rank: list[int]
) -> Status:
    """By ``parts`` of the frames that are explained and unexplained, whether their noise is ``stated``, the ``error``
    of such frames and the factors' ``rank``."""
    explained, unexplained = parts
    sides = [side.scene for side in codes.sides]
    figures = (
        f"Frames tell {codes.told[0]:.0f} and {codes.told[1]:.0f} numbers of the codes, rank {rank[0]} of {sides[0]} "
        f"and {rank[1]} of {sides[1]}; in frames of such pictures the factors have an error of {error:.1e}."
    )
    if error > LARGEST_ERROR:
        return Status(
            Verdict.MOSTLY_NOISE,
            f"Factors are mostly noise: in frames of such pictures they have an error of {error:.0%}, allowed are "
            f"{LARGEST_ERROR:.0%}",
            "capture more pictures, or longer",
            figures,
        )
    if unexplained > (SEPARABLE_RESIDUAL if stated else UNKNOWN_NOISE):
        return Status(
            Verdict.NOT_SEPARABLE,
            f"Frames hold more than codes seen through shifts explain: {unexplained:.1%} of them is left over",
            ("" if stated else "state digital.read_noise_e, as noise is guessed from neighbouring pixels; ")
            + "check that each run is of its picture, that pictures are as light as what was shown (gamma), and that "
            "the frames stand straight",
            figures,
        )
    code = "one code" if choice.terms == 1 else f"{choice.terms} codes that change over the scene"
    return Status(
        Verdict.CALIBRATED,
        f"Calibrated by known pictures: {code} a side explain{'s' if choice.terms == 1 else ''} {explained:.1%} "
        "of what frames have beside even light",
        "",
        figures,
    )


def _warnings(captures: KnownCaptures, read: KnownFrames, pose: Pose) -> Iterator[str]:
    if not pose.certain and pose.margin is not None:
        yield (
            f"orientation: {pose.orientation!r} explains no more than {pose.margin:.1%} of the frames beyond another; "
            "give pictures that are not symmetric, or state orientation in the list"
        )
    yield from read.warnings()
