"""Calibration by captures of known pictures: prints, screens or images by another calibration.

All planes of a colour sensor see one mask, so that their codes are fitted together.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.colour_files import CALIBRATION, PLANES, Wanted, write_colours
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError, check_arguments
from mitsim.core.exr import checksum, finite_channel, read_frame
from mitsim.core.files import output_folder
from mitsim.core.images import own_end, read_image
from mitsim.core.job import Cost, Job, Limits
from mitsim.core.manifests import MANIFEST, CalibrationManifest, FactorNoise
from mitsim.core.runs import load_run
from mitsim.devices.framelist import MOST_TERMS, KnownCaptures, load_known, preparation_of
from mitsim.reconstruct.factors import (
    LARGEST_ERROR,
    SEPARABLE_RESIDUAL,
    UNKNOWN_NOISE,
    Factors,
    rank_above_noise,
    squared_condition,
)
from mitsim.reconstruct.shifted_codes import Codes, Exposure, Shape, choose_terms, find_pose, fit_codes, plane_offsets
from mitsim.reconstruct.solution import Status, Verdict
from mitsim.reconstruct.solver import centre_frame

_MOST_TRIED = 3


# ---- The calibration -------------------------------------------------------------------------------------------------


@check_arguments
def calibrate_known(
    listed: Path | str | KnownCaptures, output: Path | str | None = None, job: Job | None = None
) -> dict[str, Factors]:
    """Calibrate a camera by captures of known pictures.

    Parameters
    ----------
    listed
        List of runs and pictures, TOML or JSON, or its contents.
    output
        CAL folder that is written, a coloured one for several planes; None keeps the factors in memory.
    job
        Clock and progress.

    Returns
    -------
    dict
        Factors by the runs' planes; "" where runs have none. They are flagged where frames contain more than the model
        explains, or pictures do not determine their orientation.

    Raises
    ------
    MitsimError
        For a list, run or picture that breaks a rule or does not fit, and an output that cannot be written.
    """
    captures = listed if isinstance(listed, KnownCaptures) else load_known(listed)
    job = job or Job()
    with nullcontext() if output is None else output_folder(output) as place:
        found = _calibrate(captures, job)
        if place is not None:
            for name, factors in found.items():
                (place / name).mkdir(exist_ok=True)
                factors.write(place / name)
            if captures.lines is not None:
                write_colours(place, captures.lines.model_copy(update={"kind": CALIBRATION}))
    return found


def _calibrate(captures: KnownCaptures, job: Job) -> dict[str, Factors]:
    listed, path = captures.listed, captures.path
    with job.clock.stage("read"):
        read = _KnownFrames(captures)
    job.progress("pose", 0.2)
    with job.clock.stage("pose"):
        pose = find_pose(read.exposures, listed.orientation, listed.scale)
    if "transposed" in pose.orientation:
        raise MitsimError(
            f"list {path}: pictures lie {pose.orientation} before the camera, and its factors are of rows and "
            "columns; save the pictures transposed, or turn the frames as they are imported"
        )
    turned, terms = [each.turn_scene(pose.orientation) for each in read.exposures], listed.terms
    held_out: tuple[float, ...] = ()
    job.progress("choice", 0.5)
    with job.clock.stage("choice"):
        if not terms:
            terms, held_out = choose_terms(turned, Shape(pose.scales, 1, listed.centre), min(_MOST_TRIED, MOST_TERMS))
    job.progress("fit", 0.8)
    with job.clock.stage("fit"):
        codes = fit_codes(turned, Shape(pose.scales, terms, listed.centre))
    explained, unexplained, chi_square = read.misfit(codes, turned)
    stated = bool(np.isfinite(read.noises).all())
    doubts = list[str]()
    if not pose.certain and pose.margin is not None:
        doubts.append(
            f"orientation: {pose.orientation!r} explains no more than {pose.margin:.1%} of the frames beyond another; "
            "give pictures that are not symmetric, or state orientation in the list"
        )
    if read.saturated:
        doubts.append(
            f"saturation: {len(read.saturated)} runs have readings at the full well or the ADC's end, first "
            f"{read.saturated[0]}, so their frames are not linear; expose for less"
        )
    found = {}
    for line, manifest in captures.manifests.items():
        left, right = codes.factors(read.places.get(line, (0.0, 0.0)), line)
        # Images lie as pictures do: a scene that is turned is one whose factors run the other way.
        left = left[:, ::-1] if pose.orientation in ("upside down", "turned") else left
        right = right[:, ::-1] if pose.orientation in ("mirrored", "turned") else right
        sides = [np.ascontiguousarray(side, dtype=np.float32).astype(np.float64) for side in (left, right)]
        root, norms = np.sqrt(abs(codes.gains[line])), [np.linalg.norm(side) / np.sqrt(side.size) for side in sides]
        whole, seen = (
            [float(root * error / norm) for error, norm in zip(errors, norms, strict=True)]
            for errors in (codes.errors, codes.seen_errors)
        )
        rank = [rank_above_noise(side, error) for side, error in zip(sides, whole, strict=True)]
        error = float(np.hypot(seen[0], seen[1]))
        figures = (
            f"Frames tell {codes.told[0]:.0f} and {codes.told[1]:.0f} numbers of the codes, rank {rank[0]} of "
            f"{codes.sides[0].scene} and {rank[1]} of {codes.sides[1].scene}; in frames of such pictures the factors "
            f"have an error of {error:.1e}."
        )
        if error > LARGEST_ERROR:
            verdict, remedy = Verdict.MOSTLY_NOISE, "capture more pictures, or longer"
            sentence = (
                f"Factors are mostly noise: in frames of such pictures they have an error of {error:.0%}, allowed are "
                f"{LARGEST_ERROR:.0%}"
            )
        elif unexplained > (SEPARABLE_RESIDUAL if stated else UNKNOWN_NOISE):
            verdict = Verdict.NOT_SEPARABLE
            sentence = (
                f"Frames hold more than codes seen through shifts explain: {unexplained:.1%} of them is left over"
            )
            remedy = (
                "check that each run is of its picture, that pictures are as light as what was shown (gamma), and that "
                "the frames stand straight"
            )
            if not stated:
                remedy = f"state digital.read_noise_e, as noise is guessed from neighbouring pixels; {remedy}"
        else:
            verdict, remedy = Verdict.CALIBRATED, ""
            code = "one code a side explains" if terms == 1 else f"{terms} codes that change over the scene explain"
            sentence = f"Calibrated by known pictures: {code} {explained:.1%} of what frames have beside even light"
        status = Status(verdict, sentence, remedy, figures)
        # Without its figures, which differ by plane.
        warnings = (*doubts, *(() if status.ok else (f"{sentence}; {remedy}.",)))
        result: dict[str, Any] = {
            "n": left.shape[1],
            "frames": read.frames,
            "pictures": len(listed.known),
            "orientation": pose.orientation,
            "orientation_margin": pose.margin,
            "scale": list(pose.scales),
            "terms": terms,
            "held_out": list(held_out),
            "predicted_phi_error": float(np.hypot(whole[0], whole[1])),
            "predicted_frame_error": error,
            "code_numbers": [side.length * side.terms for side in codes.sides],
            "told": list(codes.told),
            "rank": rank,
            "explained": explained,
            "chi_square": chi_square,
            "separability_residual": float(np.sqrt(max(1 - explained, 0.0))),
            "unexplained_residual": unexplained,
            "noise_free_residual": None,
            "phi_error": None,
            "condition": max(squared_condition(side) for side in sides),
            "exposure_s": manifest.digital.exposure_s,
            "saturated_runs": read.saturated,
            "seconds": job.clock.seconds(),
            "warnings": warnings,
        }
        turn_deg = read.prepared.turn_deg
        of_list = {"known": str(path), "list": listed.model_dump(mode="json"), "sha256": read.sums}
        made = CalibrationManifest(
            configuration={**({"turn_deg": turn_deg} if turn_deg else {}), **of_list},
            camera=manifest.camera,
            centre=listed.centre,
            board_reflectance=listed.board_reflectance,
            noise=FactorNoise(left=seen[0] * norms[0], right=seen[1] * norms[1], unexplained=unexplained),
            digital=manifest.digital,
            result=result,
            warnings=warnings,
            versions=versions(),
            command=job.command,
            estimate=str(status),
            verdict=status.verdict.value,
        )
        found[line] = Factors(sides[0], sides[1], made, status)
    return found


# ---- Frames and pictures ---------------------------------------------------------------------------------------------

_REFLECTANCE = "reflectance"
_COPIES = 4


class _KnownFrames:
    def __init__(self, captures: KnownCaptures) -> None:
        listed, manifests = captures.listed, captures.manifests
        self.exposures, self.noises, self.saturated, self.frames = list[Exposure](), list[float](), list[str](), 0
        self.sums: dict[str, str] = {}
        self.prepared = preparation_of(next(iter(manifests.values())), captures.path)
        self.places = plane_offsets(self.prepared)
        shape: tuple[int, int] | None = None
        for number, capture in enumerate(listed.known):
            path = captures.picture(capture)
            picture = _light_of_picture(path, listed.gamma)
            self.sums[capture.picture] = checksum(path)
            for line in manifests:
                if captures.lines is not None and line not in PLANES:
                    raise MitsimError(
                        f"list {captures.path}: {capture.run} has the line {line}, whose code is its own; calibrate "
                        "each line alone"
                    )
                if picture.ndim == 3 and not line:
                    raise MitsimError(
                        f"picture {path}: is in colour, and {capture.run} shows one plane; give a grey picture of that"
                    )
                light = picture if picture.ndim == 2 else picture[:, :, "rgb".index(line[0])]
                folder, name = captures.run(capture, line), str(Path(capture.run) / line)
                shots, saturated = load_run(folder), 0
                self.sums[name] = checksum(folder / MANIFEST)
                left, right = shots.patterns
                if light.shape != (len(left), len(right)):
                    raise MitsimError(
                        f"picture {path}: is {light.shape[0]} x {light.shape[1]} pixels, but the run {folder} has "
                        f"{len(left)} x {len(right)} scene pixels; give one of its size"
                    )
                digital = shots.manifest.digital
                for each in shots.pattern_measurements(shape):
                    if not self.exposures:
                        count = len(listed.known) * len(manifests) * left.shape[1] * right.shape[1]
                        held = Cost(memory_bytes=_COPIES * float(each.frame.nbytes) * count)
                        held.check(f"list {captures.path}: its frames", Limits())
                    frame = centre_frame(each.frame) if listed.centre else each.frame
                    shape = frame.shape[0], frame.shape[1]
                    scene = light * np.multiply.outer(left[:, each.row], right[:, each.column])
                    self.exposures.append(Exposure(scene, frame, number, line, self.places.get(line, (0.0, 0.0))))
                    variance = float(np.mean(np.maximum(digital.variance(each.light, each.shots), 0.0)))
                    self.noises.append(variance if digital.noise_is_stated else np.nan)
                    self.frames += each.shots
                    saturated += each.saturated
                if saturated:
                    self.saturated.append(name)

    def misfit(self, codes: Codes, exposures: Sequence[Exposure]) -> tuple[float, float, float]:
        """Return the explained part of the frames' energy, the unexplained part beyond noise, and chi-square."""
        excess = energy = total = 0.0
        ratios = []
        for each, stated in zip(exposures, self.noises, strict=True):
            rows, columns = codes.factors(each.offset, each.plane)
            misfit = centre_frame(each.frame - rows @ each.scene @ columns.T)
            noise = stated if np.isfinite(stated) else guess_noise(misfit)
            left_over = float(np.mean(np.square(misfit)))
            excess += left_over - noise
            total += left_over
            energy += float(np.mean(np.square(centre_frame(each.frame))))
            ratios.append(left_over / noise if noise > 0 else 1.0)
        return 1 - total / energy, float(np.sqrt(max(excess, 0.0) / energy)), float(np.mean(ratios))


def guess_noise(misfit: FloatArray) -> float:
    """Return the variance by second differences of every second pixel, which interpolated frames do not share."""
    parts = (misfit[row::2, column::2] for row in (0, 1) for column in (0, 1))
    # The weights of a second difference have squares of 6.
    return float(np.mean([np.mean(np.square(np.diff(np.diff(part, 2, 0), 2, 1))) for part in parts])) / 36


def _light_of_picture(path: Path, gamma: float) -> FloatArray:
    channels = read_frame(path)[0] if path.suffix.lower() == ".exr" else {}
    if _REFLECTANCE in channels:
        values = finite_channel(channels, _REFLECTANCE, path)
    else:
        values = read_image(path, Wanted("picture", colour=True))
    if values.ndim == 3 and values.shape[2] != 3:
        raise MitsimError(f"picture {path}: has {values.shape[2]} channels; save it without transparency")
    light = np.asarray(values, dtype=np.float64) / (own_end(values) or 1.0)
    if gamma != 1 and light.min() < 0:
        raise MitsimError(f"picture {path}: has numbers below 0, which have no gamma; leave gamma out of the list")
    return np.asarray(light**gamma) if gamma != 1 else light
