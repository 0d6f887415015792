"""Calibration by captures of known pictures, anew or by moving the factors of an aged calibration.

Prints, screens or images by another calibration serve as pictures. All planes of a colour sensor see one mask, so that
their codes are fitted together.

*Aged calibration.* A factor is a shadow Phi[u, i] = M(u + s i), with M of any mask. A shadow that has moved by b sensor
pixels, in steps that are 1 + k times as long as the mask's distance is, is M(u - b + s i + k (s (i - i_c) - r (u -
u_c))), r = d / (z - d) where the depth z is known, else 0. M between sensor pixels is a spline through all numbers of
the factor, each at its own u + s i. The light, b of either side and k are fitted by Gauss-Newton steps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded
from scipy.optimize import minimize_scalar

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError, check_arguments
from mitsim.core.exr import checksum, finite_channel, read_frame
from mitsim.core.files import output_folder
from mitsim.core.imagelist import PLANES, Crop, Preparation, Wanted
from mitsim.core.images import own_end, read_image
from mitsim.core.job import Cost, Job, Limits
from mitsim.core.manifests import (
    CALIBRATION,
    MANIFEST,
    RUN,
    CalibrationManifest,
    FactorNoise,
    open_lines,
    write_colours,
)
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import load_run
from mitsim.devices.framelist import MOST_TERMS, KnownCapture, KnownCaptures, load_known, preparation_of
from mitsim.reconstruct.factors import (
    LARGEST_ERROR,
    SEPARABLE_RESIDUAL,
    UNKNOWN_NOISE,
    Factors,
    load_calibration,
    rank_above_noise,
    squared_condition,
)
from mitsim.reconstruct.session_check import shadow_step
from mitsim.reconstruct.shifted_codes import (
    TURNS,
    Exposure,
    Shape,
    choose_terms,
    find_pose,
    fit_codes,
    fit_gains,
    plane_offsets,
)
from mitsim.reconstruct.solution import Status, Verdict
from mitsim.reconstruct.solver import centre_columns, centre_frame

_MOST_TRIED = 3


# ---- The calibration -------------------------------------------------------------------------------------------------


@check_arguments
def calibrate_known(
    listed: Path | str | KnownCaptures,
    output: Path | str | None = None,
    job: Job | None = None,
    aged: Path | str | None = None,
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
    aged
        CAL folder of this camera before its mask, projector or light moved, whose factors are moved until frames fit.
        None makes factors of the pictures alone.

    Returns
    -------
    dict
        Factors by the runs' planes; "" where runs have none. They are flagged where frames contain more than the model
        explains, or pictures do not determine their orientation.

    Raises
    ------
    MitsimError
        For a list, run or picture that breaks a rule or does not fit, another camera, and an output that cannot be
        written.
    """
    captures = listed if isinstance(listed, KnownCaptures) else load_known(listed)
    job = job or Job()
    with nullcontext() if output is None else output_folder(output) as place:
        found = _fit_codes(captures, job) if aged is None else _move_factors(captures, Path(aged), job)
        if place is not None:
            for name, factors in found.items():
                (place / name).mkdir(exist_ok=True)
                factors.write(place / name)
            if captures.lines is not None:
                write_colours(place, captures.lines.model_copy(update={"kind": CALIBRATION}))
    return found


def _fit_codes(captures: KnownCaptures, job: Job) -> dict[str, Factors]:
    listed = captures.listed
    with job.clock.stage("read"):
        read = KnownFrames(captures)
    job.progress("pose", 0.2)
    with job.clock.stage("pose"):
        pose = find_pose(read.exposures, listed.orientation, listed.scale)
    if "transposed" in pose.orientation:
        raise MitsimError(
            f"list {captures.path}: pictures lie {pose.orientation} before the camera, and its factors are of rows and "
            "columns; save the pictures transposed, or turn the frames as they are imported"
        )
    turned, terms = [each.turn_scene(pose.orientation) for each in read.exposures], listed.terms
    held_out: tuple[float, ...] = ()
    job.progress("choice", 0.5)
    with job.clock.stage("choice"):
        if not terms:
            shape = Shape(pose.scales, 1, listed.centre)
            terms, held_out = choose_terms(turned, shape, min(_MOST_TRIED, MOST_TERMS))
    job.progress("fit", 0.8)
    with job.clock.stage("fit"):
        codes = fit_codes(turned, Shape(pose.scales, terms, listed.centre))
    doubts = list[str]()
    if not pose.certain and pose.margin is not None:
        doubts.append(
            f"orientation: {pose.orientation!r} explains no more than {pose.margin:.1%} of the frames beyond another; "
            "give pictures that are not symmetric, or state orientation in the list"
        )
    found = {}
    for line, manifest in captures.manifests.items():
        left, right = codes.factors(read.places.get(line, (0.0, 0.0)), line)
        # Images lie as pictures do: a scene that is turned is one whose factors run the other way.
        left = left[:, ::-1] if pose.orientation in ("upside down", "turned") else left
        right = right[:, ::-1] if pose.orientation in ("mirrored", "turned") else right
        sides = _single(left), _single(right)
        root, norms = np.sqrt(abs(codes.gains[line])), [np.linalg.norm(side) / np.sqrt(side.size) for side in sides]
        whole, seen = (
            [float(root * error / norm) for error, norm in zip(errors, norms, strict=True)]
            for errors in (codes.errors, codes.seen_errors)
        )
        rank = [rank_above_noise(side, error) for side, error in zip(sides, whole, strict=True)]
        models = ((each, codes.factors(each.offset, each.plane)) for each in turned)
        explained, unexplained, chi_square = read.misfit(
            (rows @ each.scene @ columns.T, 0.0) for each, (rows, columns) in models
        )
        error, stated = float(np.hypot(seen[0], seen[1])), bool(np.isfinite(read.noises).all())
        figures = (
            f"Frames tell {codes.told[0]:.0f} and {codes.told[1]:.0f} numbers of the codes, rank {rank[0]} of "
            f"{codes.sides[0].scene} and {rank[1]} of {codes.sides[1].scene}; in frames of such pictures the factors "
            f"have an error of {error:.1e}."
        )
        if error > LARGEST_ERROR:
            status = Status(
                Verdict.MOSTLY_NOISE,
                f"Factors are mostly noise: in frames of such pictures they have an error of {error:.0%}, allowed are "
                f"{LARGEST_ERROR:.0%}",
                "capture more pictures, or longer",
                figures,
            )
        elif unexplained > (SEPARABLE_RESIDUAL if stated else UNKNOWN_NOISE):
            status = Status(
                Verdict.NOT_SEPARABLE,
                f"Frames hold more than codes seen through shifts explain: {unexplained:.1%} of them is left over",
                ("" if stated else "state digital.read_noise_e, as noise is guessed from neighbouring pixels; ")
                + "check that each run is of its picture, that pictures are as light as what was shown (gamma), and "
                "that the frames stand straight",
                figures,
            )
        else:
            code = (
                "one code a side explains" if terms == 1 else f"{terms} codes that change over the scene a side explain"
            )
            status = Status(
                Verdict.CALIBRATED,
                f"Calibrated by known pictures: {code} {explained:.1%} of what frames have beside even light",
                "",
                figures,
            )
        # Without its figures, which differ by plane.
        flag = () if status.ok else (f"{status.sentence}; {status.remedy}.",)
        stated_by = CalibrationManifest(
            configuration={**({"turn_deg": read.prepared.turn_deg} if read.prepared.turn_deg else {})},
            camera=manifest.camera,
            centre=listed.centre,
            board_reflectance=listed.board_reflectance,
            noise=FactorNoise(left=seen[0] * norms[0], right=seen[1] * norms[1], unexplained=unexplained),
        )
        result = {
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
        }
        warnings, parts = (*doubts, *read.warnings(), *flag), (explained, unexplained, chi_square)
        found[line] = _finish(captures, read, line, sides, status, stated_by, (parts, result, warnings), job)
    return found


def _single(values: npt.NDArray[np.floating]) -> FloatArray:
    return np.ascontiguousarray(values, dtype=np.float32).astype(np.float64)


def _finish(
    captures: KnownCaptures,
    read: KnownFrames,
    line: str,
    sides: tuple[FloatArray, FloatArray],
    status: Status,
    manifest: CalibrationManifest,
    found: tuple[tuple[float, float, float], Mapping[str, Any], tuple[str, ...]],
    job: Job,
) -> Factors:
    (explained, unexplained, chi_square), more, warnings = found
    digital, (left, right) = captures.manifests[line].digital, sides
    result: dict[str, Any] = {
        "n": left.shape[1],
        "frames": read.frames,
        "pictures": len(captures.listed.known),
        **more,
        "explained": explained,
        "chi_square": chi_square,
        "separability_residual": float(np.sqrt(max(1 - explained, 0.0))),
        "unexplained_residual": unexplained,
        "noise_free_residual": None,
        "phi_error": None,
        "condition": max(squared_condition(left), squared_condition(right)),
        "exposure_s": digital.exposure_s,
        "saturated_runs": read.saturated,
        "seconds": job.clock.seconds(),
        "warnings": warnings,
    }
    of_list = {
        "known": str(captures.path),
        "list": captures.listed.model_dump(mode="json"),
        "sha256": read.sums,
    }
    update = {
        "configuration": {**manifest.configuration, **of_list},
        "digital": digital,
        "result": result,
        "warnings": warnings,
        "versions": versions(),
        "command": job.command,
        "estimate": str(status),
        "verdict": status.verdict.value,
    }
    return Factors(left, right, manifest.model_copy(update=update), status)


# ---- Frames and pictures ---------------------------------------------------------------------------------------------

_COLOURS = {"red": 0, "green": 1, "blue": 2}
_PICTURE = Wanted("picture", colour=True)
_REFLECTANCE = "reflectance"
_OF_DIFFERENCES = 6
_COPIES = 4


class KnownFrames:
    def __init__(self, captures: KnownCaptures, aged: Mapping[str, Factors] | None = None) -> None:
        self.exposures, self.noises, self.saturated, self.frames = list[Exposure](), list[float](), list[str](), 0
        self.sums: dict[str, str] = {}
        self.prepared = preparation_of(next(iter(captures.manifests.values())), captures.path)
        self.places = plane_offsets(self.prepared)
        first: tuple[int, int] | None = None
        for number, capture in enumerate(captures.listed.known):
            picture = _picture(captures, capture)
            self.sums[capture.picture] = checksum(captures.picture(capture))
            for line in captures.manifests:
                light, folder = _plane(captures, capture, picture, line), captures.run(capture, line)
                shots, name = load_run(folder), str(Path(capture.run) / line)
                self.sums[name] = checksum(folder / MANIFEST)
                left, right = shots.patterns
                if light.shape != (len(left), len(right)):
                    raise MitsimError(
                        f"picture {captures.picture(capture)}: is {light.shape[0]} x {light.shape[1]} pixels, but the "
                        f"run {folder} has {len(left)} x {len(right)} scene pixels; give one of its size"
                    )
                digital, centre, saturated = shots.manifest.digital, captures.listed.centre, 0
                if aged is not None:
                    aged[line].check_fit(shots)
                    first, centre = (len(aged[line].left), len(aged[line].right)), aged[line].manifest.centre
                for each in shots.pattern_measurements(first):
                    if not self.exposures:
                        count = len(captures.listed.known) * len(captures.manifests) * left.shape[1] * right.shape[1]
                        held = Cost(memory_bytes=_COPIES * float(each.frame.nbytes) * count)
                        held.check(f"list {captures.path}: its frames", Limits())
                    frame = centre_frame(each.frame) if centre else each.frame
                    first = frame.shape[0], frame.shape[1]
                    scene = light * np.multiply.outer(left[:, each.row], right[:, each.column])
                    self.exposures.append(Exposure(scene, frame, number, line, self.places.get(line, (0.0, 0.0))))
                    variance = float(np.mean(np.maximum(digital.variance(each.light, each.shots), 0.0)))
                    self.noises.append(variance if digital.noise_is_stated else np.nan)
                    self.frames += each.shots
                    saturated += each.saturated
                if saturated:
                    self.saturated.append(name)

    def noise(self, number: int, misfit: FloatArray) -> float:
        if np.isfinite(self.noises[number]):
            return self.noises[number]
        guess = float(np.mean(np.square(np.diff(np.diff(misfit, 2, 0), 2, 1)))) / _OF_DIFFERENCES**2
        return guess / _differences_of_turned(misfit.shape, self.prepared)

    def misfit(self, models: Iterable[tuple[FloatArray, float]]) -> tuple[float, float, float]:
        excess = energy = total = 0.0
        ratios = []
        for number, (each, (model, error)) in enumerate(zip(self.exposures, models, strict=True)):
            misfit = centre_frame(each.frame - model)
            noise = self.noise(number, misfit) + error
            left_over = float(np.mean(np.square(misfit)))
            excess += left_over - noise
            total += left_over
            energy += float(np.mean(np.square(centre_frame(each.frame))))
            ratios.append(left_over / noise if noise > 0 else 1.0)
        return 1 - total / energy, float(np.sqrt(max(excess, 0.0) / energy)), float(np.mean(ratios))

    def warnings(self) -> Iterator[str]:
        if self.saturated:
            yield (
                f"saturation: {len(self.saturated)} runs have readings at the full well or the ADC's end, first "
                f"{self.saturated[0]}, so their frames are not linear; expose for less"
            )


def _differences_of_turned(shape: tuple[int, ...], how: Preparation) -> float:
    """Return the noise that second differences show over the true noise, after turning by bilinear interpolation."""
    angle, crop = np.radians(how.turn_deg), how.crop or Crop()
    pivot = (np.array(shape) - 1) / 2 if how.turn_about == "centre" else np.array([-crop.row, -crop.column])
    y, x = np.arange(shape[0])[:, None] - pivot[0], np.arange(shape[1]) - pivot[1]
    sources = np.cos(angle) * y + np.sin(angle) * x + pivot[0], np.cos(angle) * x - np.sin(angle) * y + pivot[1]
    kept, seen = np.ones(shape), np.ones(shape)
    for r in (source % 1 for source in sources):
        kept *= r**2 + (1 - r) ** 2
        seen *= (r**2 + (1 - 3 * r) ** 2 + (3 * r - 2) ** 2 + (1 - r) ** 2) / _OF_DIFFERENCES
    return float(seen.mean() / kept.mean())


def _picture(captures: KnownCaptures, capture: KnownCapture) -> FloatArray:
    path, gamma = captures.picture(capture), captures.listed.gamma
    channels = read_frame(path)[0] if path.suffix.lower() == ".exr" else {}
    known = _REFLECTANCE in channels
    values = finite_channel(channels, _REFLECTANCE, path) if known else read_image(path, _PICTURE)
    if values.ndim == 3 and values.shape[2] != 3:
        raise MitsimError(f"picture {path}: has {values.shape[2]} channels; save it without transparency")
    light = np.asarray(values, dtype=np.float64) / (own_end(values) or 1.0)
    if gamma == 1:
        return light
    if light.min() < 0:
        raise MitsimError(f"picture {path}: has numbers below 0, which have no gamma; leave gamma out of the list")
    return np.asarray(light**gamma)


def _plane(captures: KnownCaptures, capture: KnownCapture, picture: FloatArray, line: str) -> FloatArray:
    problem = ""
    if captures.lines is not None and line not in PLANES:
        problem = (
            f"{capture.run} has the line {line}, and lines of a projector see codes of their own; calibrate each "
            f"alone, by runs such as {capture.run}/{line}"
        )
    elif picture.ndim == 2:
        if capture.colour is None:
            return picture
        problem = f"picture {capture.picture} is grey; leave colour {capture.colour!r} out"
    elif line or capture.colour is not None:
        return picture[:, :, "rgb".index(line[0]) if line else _COLOURS[capture.colour or ""]]
    else:
        problem = (
            f"picture {capture.picture} is in colour; say which plane {capture.run} shows, "
            f"colour = {', '.join(map(repr, _COLOURS))}, or give a grey one"
        )
    raise MitsimError(f"list {captures.path}: {problem}")


# ---- An aged calibration ---------------------------------------------------------------------------------------------

_KNOTS = 4
_STIFFNESS = 1e-3
_WAY_ERROR = 0.02
_PASSES, _MOVED = 20, 0.05
_HALVINGS = 8
_REACH = 8
_STARTED = 4
_CLEARER = 1.5
_MASK = "mask_rows_um", "mask_columns_um", "mask_axis_um"


def _move_factors(captures: KnownCaptures, folder: Path, job: Job) -> dict[str, Factors]:
    listed = captures.listed
    for name in ("orientation", "scale", "terms"):
        if getattr(listed, name) is not None:
            raise MitsimError(
                f"list {captures.path}: {name} is of codes that are found from nothing, and calibration {folder} has "
                f"its own; leave {name} out, and give pictures as images by that calibration lie"
            )
    run = open_lines(captures.run(listed.known[0]), RUN)
    aged = {name: load_calibration(part) for name, part in run.check_calibration(folder).parts.items()}
    for name in ("centre", "board_reflectance"):
        own = getattr(next(iter(aged.values())).manifest, name)
        if name in listed.model_fields_set and getattr(listed, name) != own:
            raise MitsimError(
                f"list {captures.path}: {name} is {getattr(listed, name)}, but {own} in calibration {folder}, which "
                "decides; leave it out"
            )
    with job.clock.stage("read"):
        read = KnownFrames(captures, aged)
    job.progress("fit", 0.3)
    with job.clock.stage("fit"):
        camera = _AgedCamera(aged, read)
        start = camera.first_guess(str(captures.path))
        _, before, chi_before = camera.misfit(np.zeros(3))
        at, covariance, converged, unknown = camera.fit(start)
        parts = camera.misfit(at[:3])
    numbers, gains, stated = camera.numbers(at, covariance), at[3:], bool(np.isfinite(read.noises).all())
    figures = moved_in_words(numbers) + f"; left over {before:.2%} before, {parts[1]:.2%} after."
    status = Status(Verdict.CALIBRATED, "Mended by known pictures: factors moved until frames fit", "", figures)
    if not (converged and (gains > 0).all()):
        status = Status(
            Verdict.NOT_CONVERGED,
            "The shadow of the calibration was not found in these frames: it has moved by more than an eighth of the "
            "sensor, or is another one",
            "check that pictures and runs belong together, or calibrate anew",
            figures,
        )
    elif parts[1] > (SEPARABLE_RESIDUAL if stated else UNKNOWN_NOISE):
        status = Status(
            Verdict.NOT_SEPARABLE,
            f"Frames hold more than the calibration's factors explain however they move: {parts[1]:.1%} of them is "
            f"left over, {before:.1%} before",
            "calibrate anew if the mask has turned or tilted, or stands otherwise; check that each run is of its "
            "picture"
            + ("" if stated else "; state digital.read_noise_e, as noise is guessed from neighbouring pixels"),
            figures,
        )
    found = {}
    for (line, factors), gain in zip(aged.items(), gains.tolist(), strict=True):
        old, root = factors.manifest, float(np.sqrt(abs(gain)))
        left, right = (_single(root * side.factor) for side in camera.moved(line, at[:3]))
        update = {
            "configuration": {
                **old.configuration,
                "aged": {"calibration": factors.name, "factors": factors.fingerprint},
            },
            "noise": old.noise
            and old.noise.model_copy(update={"left": old.noise.left * root, "right": old.noise.right * root}),
            "parallax": old.parallax
            and old.parallax.model_copy(
                update={"mask_distance_mm": old.parallax.mask_distance_mm * (1 + float(at[2]))}
            ),
            "modelled": None,
        }
        flagged = (f"the calibration was flagged before it was mended: {text}" for text in factors.warnings)
        warnings = (*flagged, *read.warnings(), *(() if status.ok else (str(status),)))
        more = {
            "moved": numbers,
            "unknown": unknown,
            "chi_square_before": chi_before,
            "unexplained_before": before,
        }
        stated_by = old.model_copy(update=update)
        found[line] = _finish(captures, read, line, (left, right), status, stated_by, (parts, more, warnings), job)
    return found


def moved_in_words(numbers: Mapping[str, Mapping[str, Any]]) -> str:
    return ", ".join(
        f"{name.replace('_um', '').replace('_', ' ')} {each['value']:.4g} +-{each['standard_error']:.2g}"
        + (f" {each['unit']}" if each["unit"] != "1" else "")
        for name, each in numbers.items()
    )


class _Shadow:
    def __init__(self, factor: FloatArray, scale: float) -> None:
        self.factor, self.scale = factor, scale
        rows, count = factor.shape
        self._place = np.arange(rows)[:, None] + scale * np.arange(count)
        self._first, self._last = float(self._place.min()), float(self._place.max())
        size = int(np.ceil((self._last - self._first) * _KNOTS)) + 1
        knots, self._brightness = self._first + np.arange(-3, size + 4) / _KNOTS, np.ones(count)
        design = BSpline.design_matrix(self._place.ravel(), knots, 3)
        for _ in range(2):
            lit = design.multiply(np.broadcast_to(self._brightness, factor.shape).reshape(-1, 1)).tocsr()
            normal = lit.T @ lit
            bands = np.zeros((4, normal.shape[0]))
            for k, stiff in enumerate((20, -15, 6, -1)):  # of third differences, each with the next ones
                bands[k, : normal.shape[0] - k] = normal.diagonal(-k) + _STIFFNESS * stiff
            self._spline = BSpline(knots, solveh_banded(bands, lit.T @ factor.ravel(), lower=True), 3)
            self._still = self._spline(self._place)
            below = np.maximum(np.square(self._still).sum(axis=0), np.finfo(np.float64).tiny)
            self._brightness = (self._still * factor).sum(axis=0) / below
        self.unlike = float(np.linalg.norm(self._still * self._brightness - factor))

    @classmethod
    def find_scale(cls, factor: FloatArray, name: str) -> float:
        count, first = factor.shape[1], -shadow_step(factor)
        if abs(first) * count < 1:
            raise MitsimError(
                f"calibration {name}: its columns are no shadow that moves over the sensor, so nothing tells how they "
                "move with a mask; calibrate anew"
            )
        bounds, options = (first - 0.5 / count, first + 0.5 / count), {"xatol": _WAY_ERROR / count}
        best = minimize_scalar(
            lambda scale: cls(factor, scale).unlike, bounds=bounds, method="bounded", options=options
        )
        return float(best.x)

    def move_by(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]:
        place = self._place + pixels
        within = (place >= self._first) & (place <= self._last)
        place = np.clip(place, self._first, self._last)
        moved = self.factor + self._brightness * (self._spline(place) - self._still)
        return moved, self._brightness * self._spline(place, 1) * within, within


class _MovedSide(NamedTuple):
    factor: FloatArray
    seen: FloatArray
    slopes: FloatArray
    known: npt.NDArray[np.bool_]


class _AgedCamera:
    """Factors of an aged calibration by plane, and the known frames that they are moved to.

    A *move* (3,) is the shadow's way along rows and columns [pixels], and the mask's distance over the calibrated one,
    less one. Fitted numbers are the move and the gain of each plane.
    """

    def __init__(self, factors: Mapping[str, Factors], read: KnownFrames) -> None:
        self._factors, self._read, one = factors, read, next(iter(factors.values()))
        self._parallax, self._centre = one.manifest.parallax, one.manifest.centre
        # All planes see one mask.
        scales = [_Shadow.find_scale(side, one.name) for side in (one.left, one.right)]
        self._shadows = {
            name: [_Shadow(side, scale) for side, scale in zip((each.left, each.right), scales, strict=True)]
            for name, each in factors.items()
        }
        self._ratio = 0.0
        if parallax := self._parallax:
            self._ratio = parallax.mask_distance_mm / (parallax.depth_mm - parallax.mask_distance_mm)

    def moved(self, line: str, move: FloatArray) -> list[_MovedSide]:
        found = []
        for axis, shadow in enumerate(self._shadows[line]):
            rows, count = shadow.factor.shape
            # The way of the shadow of a mask at twice the distance.
            longer = shadow.scale * (np.arange(count) - (count - 1) / 2)
            longer = np.asarray(longer - self._ratio * (np.arange(rows)[:, None] - (rows - 1) / 2))
            factor, slope, known = shadow.move_by(longer * move[2] - move[axis])
            slopes = [np.zeros_like(slope), np.zeros_like(slope), slope * longer]
            slopes[axis] = -slope
            seen, *slopes = (centre_columns(each) if self._centre else each for each in (factor, *slopes))
            found.append(_MovedSide(factor, seen, np.stack(slopes), known))
        return found

    def first_guess(self, name: str) -> FloatArray:
        some = self._read.exposures[:: -(-len(self._read.exposures) // _STARTED)]
        still = {line: self.moved(line, np.zeros(3)) for line in self._factors}
        shape = some[0].frame.shape
        places = [np.arange(-(count // _REACH), count // _REACH + 1) for count in shape]
        size, likeness = [count + count // _REACH for count in shape], dict[str, tuple[float, float, float]]()
        for turn, apply in TURNS.items():
            if "transposed" in turn and some[0].scene.shape[0] != some[0].scene.shape[1]:
                continue
            total: FloatArray = np.zeros((len(places[0]), len(places[1])))
            for each in some:
                left, right = still[each.plane]
                model = left.seen @ apply(each.scene) @ right.seen.T
                pair = [centre_frame(frame) for frame in (each.frame, model)]
                length = float(np.prod([np.linalg.norm(frame) for frame in pair]))
                seen, predicted = (np.fft.rfft2(frame, size) for frame in pair)
                alike = np.fft.irfft2(seen * np.conj(predicted), size)[np.ix_(*places)]
                total += alike / max(length, np.finfo(np.float64).tiny) / len(some)
            row, column = np.unravel_index(int(np.argmax(total)), total.shape)
            likeness[turn] = float(total.max()), float(places[0][row]), float(places[1][column])
        best = max(likeness, key=lambda turn: likeness[turn][0])
        if 1 - likeness["upright"][0] ** 2 > _CLEARER * (1 - likeness[best][0] ** 2):
            raise MitsimError(
                f"list {name}: the calibration's images lie {best} beside these pictures: frames correlate by "
                f"{likeness[best][0]:.3f} so, as they are by {likeness['upright'][0]:.3f}; save the pictures {best}"
            )
        move = np.array([*likeness["upright"][1:], 0.0])
        return np.append(move, self._gains(move))

    @single_threaded_blas()
    def fit(self, start: FloatArray) -> tuple[FloatArray, FloatArray, bool, float]:
        exposures = self._read.exposures
        models = zip(exposures, self._models(start), strict=True)
        found = [self._read.noise(number, each.frame - model) for number, (each, (model, _)) in enumerate(models)]
        floor = max(max(found), np.finfo(np.float64).tiny) * 1e-6
        variances = [max(each, floor) for each in found]
        at, here, converged = start, self._normal(start, variances), False
        for _ in range(_PASSES):
            matrix, right, _, misfit = here
            step = np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
            errors = np.sqrt(np.diag(np.linalg.inv(matrix)))
            for _ in range(_HALVINGS):
                there = self._normal(at + step, variances)
                if there[3] <= misfit * (1 + 1e-12):
                    break
                step = step / 2
            at, here = at + step, there
            converged = bool((np.abs(step) < _MOVED * errors).all())
            if converged:
                break
        matrix, _, systematic, _ = here
        inverse, ratio = np.linalg.inv(matrix), self.misfit(at[:3])[2]
        covariance = inverse @ (matrix + systematic) @ inverse * max(ratio, 1.0)
        within = all(abs(way) < count / _REACH for way, count in zip(at[:2], exposures[0].frame.shape, strict=True))
        unknown = max(float(1 - side.known.mean()) for line in self._factors for side in self.moved(line, at[:3]))
        return at, covariance, converged and within, unknown

    def misfit(self, move: FloatArray) -> tuple[float, float, float]:
        return self._read.misfit(self._models(np.append(move, self._gains(move))))

    def numbers(self, at: FloatArray, covariance: FloatArray) -> dict[str, dict[str, Any]]:
        lights = [f"light {line}".strip() for line in self._factors]
        names = ["shadow_rows", "shadow_columns", "mask_distance", *lights]
        units, values, errors = ["pixels", "pixels", *["1"] * (1 + len(lights))], at, np.sqrt(np.diag(covariance))
        if parallax := self._parallax:
            distance, ways = parallax.mask_distance_mm, np.zeros((3, len(at)))
            for axis, window in enumerate((parallax.row_tan, parallax.column_tan)):
                ways[axis, axis] = 1e3 * parallax.pitch_mm(axis) * (1 - distance / parallax.depth_mm)
                ways[axis, 2] = 1e3 * distance * (window[0] + window[1]) / 2
            ways[2, 2] = 1e3 * distance
            names, units, values = [*names, *_MASK], [*units, *["um"] * 3], np.append(at, ways @ at)
            errors = np.append(errors, np.sqrt(np.diag(ways @ covariance @ ways.T)))
        each = zip(names, values.tolist(), errors.tolist(), units, strict=True)
        return {name: {"value": value, "standard_error": error, "unit": unit} for name, value, error, unit in each}

    def _gains(self, move: FloatArray) -> list[float]:
        sides = {line: self.moved(line, move) for line in self._factors}
        exposures = self._read.exposures
        models = [sides[each.plane][0].seen @ each.scene @ sides[each.plane][1].seen.T for each in exposures]
        return [*fit_gains(exposures, models, [*self._factors]).values()]

    def _models(self, at: FloatArray) -> Iterator[tuple[FloatArray, float]]:
        sides = {line: self.moved(line, at[:3]) for line in self._factors}
        gains = dict(zip(self._factors, at[3:].tolist(), strict=True))
        for each in self._read.exposures:
            (left, right), gain = (side.seen for side in sides[each.plane]), gains[each.plane]
            lit, shown, noise = each.scene @ right.T, left @ each.scene, self._factors[each.plane].manifest.noise
            error = 0.0
            if noise is not None:
                of_left = noise.left**2 * float(np.sum(lit**2)) / len(right)
                error = gain**2 * (of_left + noise.right**2 * float(np.sum(shown**2)) / len(left))
            yield gain * (left @ lit), error

    def _normal(self, at: FloatArray, variances: Sequence[float]) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        size, right, misfit = len(at), np.zeros(len(at)), 0.0
        matrix, systematic = np.zeros((size, size)), np.zeros((size, size))
        for number, (line, factors) in enumerate(self._factors.items()):
            sides = self.moved(line, at[:3])
            (left, other), gain, noise = (side.seen for side in sides), at[3 + number], factors.manifest.noise
            own = [0, 1, 2, 3 + number]
            # Sensor rows and columns that see what no pixel saw before tell nothing of where the shadow is.
            seen = np.multiply.outer(*(side.known.all(axis=1) for side in sides))
            pulls = [np.zeros((4, *side.shape)) for side in (left, other)]
            for each, variance in zip(self._read.exposures, variances, strict=True):
                if each.plane != line:
                    continue
                lit, shown = each.scene @ other.T, left @ each.scene
                model = left @ lit
                slopes = zip(sides[0].slopes, sides[1].slopes, strict=True)
                jacobian = np.stack([*(gain * (a @ lit + shown @ b.T) for a, b in slopes), model]) * seen
                rest, flat = (each.frame - gain * model) * seen, jacobian.reshape(4, -1)
                matrix[np.ix_(own, own)] += flat @ flat.T / variance
                right[own] += flat @ rest.ravel() / variance
                misfit += float(np.sum(np.square(rest))) / variance
                pulls[0] += gain / variance * (jacobian @ lit.T)
                pulls[1] += gain / variance * (jacobian.transpose(0, 2, 1) @ shown)
            for pull, error in zip(pulls, (noise.left, noise.right) if noise else (0.0, 0.0), strict=True):
                pull = pull.reshape(4, -1)
                systematic[np.ix_(own, own)] += error**2 * (pull @ pull.T)
        return matrix, right, systematic, misfit
