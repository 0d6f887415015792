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
from mitsim.core.exr import checksum, finite_channel, read_frame
from mitsim.core.files import output_folder
from mitsim.core.imagelist import Wanted
from mitsim.core.images import own_end, read_image
from mitsim.core.job import Cost, Job, Limits
from mitsim.core.manifests import MANIFEST, CalibrationManifest, FactorNoise
from mitsim.core.runs import load_run
from mitsim.core.spectral_manifests import CALIBRATION, write_colours
from mitsim.devices.knownlist import MOST_TERMS, KnownCapture, KnownCaptures, load_known
from mitsim.reconstruct.estimate_factors import (
    LARGEST_ERROR,
    SEPARABLE_RESIDUAL,
    UNKNOWN_NOISE,
    rank_above_noise,
    squared_condition,
)
from mitsim.reconstruct.factors import Factors
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
from mitsim.reconstruct.solver import centre_frame

PLANES = {"r": (0.5, 0.5), "gb": (0.0, 0.5), "gr": (0.5, 0.0), "b": (0.0, 0.0)}
"""Place of each plane of a Bayer sensor in its cell, down and to the right, in pixels of a plane."""
_COLOURS = {"red": 0, "green": 1, "blue": 2}
_PICTURE = Wanted("picture", colour=True)
_REFLECTANCE = "reflectance"
"""Channel of an image, or of a truth, in OpenEXR."""
_MOST_TRIED = 3
"""Codes of a side that are tried where the list does not say how many."""


@check_arguments
def calibrate_known(
    listed: Path | str | KnownCaptures, output: Path | str | None = None, job: Job | None = None
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

    Returns
    -------
    dict
        Factors by the runs' planes; "" where runs have none. Flagged where frames hold more than the codes explain, or
        pictures do not tell how they lie.

    Raises
    ------
    MitsimError
        for a list, a run or a picture that breaks a rule, pictures of another size than the runs' scene, and an output
        that cannot be written.
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
    listed = captures.listed
    with job.clock.stage("read"):
        read = _Read.of(captures)
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


# ---- Runs and pictures as they are read ----


class _Read:
    """All frames of a list, and what they are of.

    Attributes
    ----------
    exposures
        frames and scenes.
    noises
        (exposures,) noise variance of a number of each frame by the sensor that its run states; NaN where it does not.
    saturated
        names of runs with readings at the full well or the ADC's end.
    frames
        shots that were read.
    sums
        SHA-256 of pictures and of the runs' manifests.
    """

    def __init__(self) -> None:
        self.exposures: list[Exposure] = []
        self.noises: list[float] = []
        self.saturated: list[str] = []
        self.frames = 0
        self.sums: dict[str, str] = {}

    @classmethod
    def of(cls, captures: KnownCaptures) -> _Read:
        """Those of all ``captures``; MitsimError for files that cannot be read, and pictures of another size."""
        read = cls()
        for number, capture in enumerate(captures.listed.known):
            picture = _picture(captures, capture)
            read.sums[capture.picture] = checksum(captures.picture(capture))
            for line in captures.manifests:
                if captures.lines is not None and line not in PLANES:
                    raise MitsimError(
                        f"list {captures.path}: {capture.run} has the line {line}, and lines of a projector see codes "
                        f"of their own; calibrate each alone, by runs such as {capture.run}/{line}"
                    )
                light = _plane(captures, capture, picture, line)
                read._add(captures, capture, number, line, light)
        return read

    def _add(self, captures: KnownCaptures, capture: KnownCapture, number: int, line: str, light: FloatArray) -> None:
        folder = captures.run(capture, line)
        shots = load_run(folder)
        self.sums[str(Path(capture.run) / line)] = checksum(folder / MANIFEST)
        left, right = shots.patterns
        if light.shape != (len(left), len(right)):
            raise MitsimError(
                f"picture {captures.picture(capture)}: is {light.shape[0]} x {light.shape[1]} pixels, but the run "
                f"{folder} has {len(left)} x {len(right)} scene pixels; give one of its size"
            )
        first = self.exposures[0].frame.shape if self.exposures else None
        digital = shots.manifest.digital
        saturated = 0
        for each in shots.pattern_measurements(first):
            if not self.exposures:
                count = len(captures.listed.known) * len(captures.manifests) * left.shape[1] * right.shape[1]
                held = Cost(memory_bytes=_COPIES * float(each.frame.nbytes) * count)
                held.check(f"list {captures.path}: its frames", Limits())
            frame = centre_frame(each.frame) if captures.listed.centre else each.frame
            scene = light * np.multiply.outer(left[:, each.row], right[:, each.column])
            self.exposures.append(Exposure(scene, frame, number, line, PLANES.get(line, (0.0, 0.0))))
            variance = float(np.mean(np.maximum(digital.variance(each.light, each.shots), 0.0)))
            self.noises.append(variance if digital.noise_is_stated else np.nan)
            self.frames += each.shots
            saturated += each.saturated
        if saturated:
            self.saturated.append(str(Path(capture.run) / line))


_COPIES = 4
"""Of all frames that are held at a time: as read, as they are compared, and what a model and its misfit take."""


def _picture(captures: KnownCaptures, capture: KnownCapture) -> FloatArray:
    """Light of a picture (rows, columns) or (rows, columns, 3), 1 at the largest number of its file."""
    path, gamma = captures.picture(capture), captures.listed.gamma
    if path.suffix.lower() == ".exr":
        channels = read_frame(path)[0]
        values = (
            finite_channel(channels, _REFLECTANCE, path) if _REFLECTANCE in channels else read_image(path, _PICTURE)
        )
    else:
        values = read_image(path, _PICTURE)
    if values.ndim == 3 and values.shape[2] != 3:
        raise MitsimError(f"picture {path}: has {values.shape[2]} channels; save it without transparency")
    light = np.asarray(values, dtype=np.float64) / (own_end(values) or 1.0)
    if gamma == 1:
        return light
    if light.min() < 0:
        raise MitsimError(f"picture {path}: has numbers below 0, which have no gamma; leave gamma out of the list")
    return np.asarray(light**gamma)


def _plane(captures: KnownCaptures, capture: KnownCapture, picture: FloatArray, line: str) -> FloatArray:
    """What the run's ``line`` sees of a ``picture``."""
    if picture.ndim == 2:
        if capture.colour is not None:
            raise MitsimError(
                f"list {captures.path}: picture {capture.picture} is grey; leave colour {capture.colour!r} out"
            )
        return picture
    if line:
        return picture[:, :, "rgb".index(line[0])]
    if capture.colour is None:
        raise MitsimError(
            f"list {captures.path}: picture {capture.picture} is in colour; say which plane {capture.run} shows, "
            f"colour = {', '.join(map(repr, _COLOURS))}, or give a grey one"
        )
    return picture[:, :, _COLOURS[capture.colour]]


# ---- Codes as factors ----


def _factors(
    captures: KnownCaptures, read: _Read, pose: Pose, choice: Choice, codes: Codes, line: str, job: Job
) -> Factors:
    """Factors of the plane ``line``."""
    listed, manifest = captures.listed, captures.manifests[line]
    if "transposed" in pose.orientation:
        raise MitsimError(
            f"list {captures.path}: pictures lie {pose.orientation} before the camera, and its factors are of rows and "
            "columns; save the pictures transposed, or turn the frames as they are imported"
        )
    left, right = codes.factors(PLANES.get(line, (0.0, 0.0)), line)
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
    explained, unexplained, chi_square = _misfit(read, pose, codes)
    rank = [rank_above_noise(side, error) for side, error in zip((left, right), whole, strict=True)]
    status = _status(
        choice, codes, (explained, unexplained), bool(np.isfinite(read.noises).all()), float(np.hypot(*seen)), rank
    )
    warnings = (*_warnings(captures, read, pose), *(() if status.ok else (str(status),)))
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
            **{name: manifest.configuration[name] for name in _OF_IMPORTS if name in manifest.configuration},
        },
        camera=manifest.camera,
        centre=listed.centre,
        board_reflectance=listed.board_reflectance,
        digital=manifest.digital,
        noise=FactorNoise(left=seen[0] * norms[0], right=seen[1] * norms[1], unexplained=unexplained),
        result=result,
        warnings=warnings,
        versions=versions(),
        estimate=str(status),
        verdict=status.verdict.value,
    )
    return Factors(left, right, stated, status)


_OF_IMPORTS = ("turn_deg",)
"""Of a run's configuration, what an import of other frames is compared with."""


def _misfit(read: _Read, pose: Pose, codes: Codes) -> tuple[float, float, float]:
    """Part of the energy of all frames that codes explain; part, rms, that neither they nor noise do; and the mean of
    misfit over noise. All of centred frames: whatever picture is named, even light is explained.

    Noise is what the sensor states; where it does not, what second differences of the misfit tell along rows and
    columns at once, in which there is hardly any scene.
    """
    excess = energy = total = 0.0
    ratios = []
    for each, stated in zip(read.exposures, read.noises, strict=True):
        left, right = codes.factors(each.offset, each.plane)
        misfit = centre_frame(each.frame - left @ each.turn_scene(pose.orientation).scene @ right.T)
        noise = stated if np.isfinite(stated) else float(np.mean(np.square(np.diff(np.diff(misfit, 2, 0), 2, 1)))) / 36
        left_over = float(np.mean(np.square(misfit)))
        excess += left_over - noise
        total += left_over
        energy += float(np.mean(np.square(centre_frame(each.frame))))
        ratios.append(left_over / noise if noise > 0 else 1.0)
    return 1 - total / energy, float(np.sqrt(max(excess, 0.0) / energy)), float(np.mean(ratios))


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


def _warnings(captures: KnownCaptures, read: _Read, pose: Pose) -> Iterator[str]:
    if not pose.certain and pose.margin is not None:
        yield (
            f"orientation: {pose.orientation!r} explains no more than {pose.margin:.1%} of the frames beyond another; "
            "give pictures that are not symmetric, or state orientation in the list"
        )
    if read.saturated:
        yield (
            f"saturation: {len(read.saturated)} runs have readings at the full well or the ADC's end, first "
            f"{read.saturated[0]}, so their frames are not linear; expose for less"
        )
