"""Compute a camera's factors from a folder with the frames of a real calibration session.

Frames of a simulated session, written to such a folder, give its factors bit for bit.

*Exposures of one frame.* No frame of a session is brighter than the uniform one. Weights of all exposures are
therefore found once, by a uniform frame of the other side's stripes, and do not depend on noise of the merged frames.
The variance sum_k w_k^2 v_k of merged rates is least with w_k in proportion to 1/v_k (Granados et al. 2010, "Optimal
HDR reconstruction with linear digital cameras", CVPR).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.colour_files import CALIBRATION, lines_of_planes, write_colours
from mitsim.core.configuration import CAMERA, locate
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError, check_arguments
from mitsim.core.exr import checksum, verify
from mitsim.core.files import output_folder
from mitsim.core.images import CommonFactor, image_pages, own_end, read_image
from mitsim.core.job import Job
from mitsim.core.manifests import CalibrationManifest, Digital
from mitsim.core.parallel import in_threads, single_threaded_blas
from mitsim.core.worker import workers
from mitsim.devices.framelist import DarkFile, SessionFrames, StripeFile, load_frames
from mitsim.devices.patterns import stripe_signs
from mitsim.devices.sensor import digital_of, load_sensor
from mitsim.devices.session import SIDES, UNIFORM, Half, Merge, Side
from mitsim.reconstruct.factors import Factors, ResponseFit, StripeSums, stripe_sums
from mitsim.reconstruct.session_check import check_session

_FILLED = ("read_noise_e", "step_dn", "saturation_dn")
_COMPARED = {"gain_dn_per_e": (0.05, 0.0), "black_level_dn": (0.02, 1.0), "saturation_dn": (0.02, 1.0)}


# ---- From the frames of a real session to factors ----


@check_arguments
def calibrate_frames(
    folder: Path | str | SessionFrames,
    output: Path | str | None = None,
    job: Job | None = None,
    camera: Path | str | None = None,
) -> Factors:
    """Calibrate a camera by the frames of a real session.

    Parameters
    ----------
    folder
        Folder with the frames and their list (docs/real_camera.md), or the result of :func:`load_frames`.
    output
        CAL folder that is written; None keeps the factors in memory.
    job
        Clock and progress.
    camera
        Name of a shipped camera, or its TOML file: it supplies noise and saturation that the list does not state, and
        is compared with the list.

    Returns
    -------
    Factors
        Flagged for saturated frames, responses that are not separable, and a list that contradicts the camera.

    Raises
    ------
    MitsimError
        For frames that are missing, given twice, of different sizes or unreadable, a list that breaks a rule, and an
        output that cannot be written.
    """
    job = job or Job()
    session = folder if isinstance(folder, SessionFrames) else load_frames(folder)
    doubts = list[str]()
    if camera is not None:
        sensor = load_sensor(locate(camera, "calibration", ".toml", CAMERA))
        stated, own = session.listed.digital, digital_of(sensor, session.listed.digital.exposure_s)
        for name, (part, least) in _COMPARED.items():
            ours, theirs = getattr(stated, name), getattr(own, name)
            if ours is not None and theirs is not None and abs(ours - theirs) > max(part * theirs, least):
                words = f"digital.{name} is {ours:g} in the list, and {theirs:g} by the camera's file"
                doubts.append(f"camera {sensor.name}: {words}; correct the wrong one, or leave --camera out")
        absent = {name: getattr(own, name) for name in _FILLED if getattr(stated, name) is None}
        digital = stated.model_copy(update=absent)
        session = replace(session, listed=session.listed.model_copy(update={"digital": digital}))
    session, doubt = _checked(session)
    with nullcontext() if output is None else output_folder(output) as place:
        factors = _calibrate(session, job, (*doubts, *doubt))
        if place is not None:
            factors.write(place)
    return factors


def calibrate_planes(
    session: SessionFrames, output: Path, job: Job | None = None, camera: Path | str | None = None
) -> dict[str, Factors]:
    job, colours = job or Job(), lines_of_planes(CALIBRATION, session.listed.prepare.wavelengths_nm)
    with output_folder(output) as place:
        found = {}
        for name in colours.names:
            plane = session.of_plane(name)
            found[name] = calibrate_frames(plane, place / name, job.apart(f"{name} "), camera)
        write_colours(place, colours)
    return found


def chosen_responses(session: SessionFrames, chosen: Iterable[tuple[Side, int]]) -> Iterator[tuple[FloatArray, float]]:
    readings = _Readings(_checked(session)[0])
    for side, index in chosen:
        rate, variance, _ = readings.response(side, index)
        if readings.saturated:
            words = f"{min(readings.saturated)} has pixels at the full well or the ADC's end"
            raise MitsimError(f"frames {session.folder}: {words}; use a shorter exposure")
        yield rate, float(np.sqrt(variance))


@single_threaded_blas()
def _calibrate(session: SessionFrames, job: Job, doubts: tuple[str, ...]) -> Factors:
    listed, readings = session.listed, _Readings(session)
    signs = stripe_signs(listed.n).astype(np.float64)
    sums, variances = _sums(readings, signs.shape[1], job)
    found = check_session(sums, signs, session.order, session.frame_name, saturated=bool(readings.saturated))
    noise = float(np.sqrt(max(float(np.mean(variances)), 0.0))) if listed.digital.noise_is_stated else None
    with job.clock.stage("estimate"):
        estimate = found.estimate(signs, noise)
    warnings: tuple[str, ...] = (*doubts, *estimate.status.reasons, *found.warnings)
    if readings.saturated:
        warnings += (
            f"saturation: {len(readings.saturated)} of {len(session.files)} frames have pixels at the full well or the "
            f"ADC's end, first {min(readings.saturated)}, so responses are not linear; use a shorter exposure",
        )
    exact = "exact factors of a real camera are not known; predicted_phi_error is the part that noise causes"
    end = "frames count as saturated at the largest number of their file, if at all"
    not_known = (
        (True, f"phi_error, noise_free_residual: {exact}"),
        (noise is None, "digital.read_noise_e: noise cannot be distinguished from responses that are not separable"),
        (listed.digital.saturation_dn is None, f"digital.saturation_dn: {end}"),
        (listed.board_reflectance is None, "board_reflectance: 1 in an image is the board's, which is unknown"),
        (listed.parallax is None, "parallax: `reconstruct --focus` can use only the depth of the board"),
        (not session.pairs, "motion, ambient light, nonlinearity: hardly found without pairs; take pairs"),
        (bool(session.dark) and session.pairs, "dark: pairs have no dark signal, and dark frames are not used"),
    )
    result = {
        "n": listed.n,
        "frames": len(session.files),
        "separability_residual": estimate.separability_residual,
        "unexplained_residual": estimate.unexplained,
        "noise_free_residual": None,
        "phi_error": None,
        "predicted_phi_error": float(np.hypot(*estimate.predicted_error)),
        "response_noise": noise,
        "faults": [asdict(fault) for fault in found.faults],
        "lamp": found.lamp,
        "condition": estimate.condition,
        "exposure_s": listed.digital.exposure_s,
        "saturated_frames": len(readings.saturated),
        "dark_frames": len(session.dark),
        "divided_by": session.listed.prepare.divide_by or 1,
        "not_known": [words for unknown, words in not_known if unknown],
        "seconds": job.clock.seconds(),
        "warnings": warnings,
    }
    with job.clock.stage("checksums"):
        digests = in_threads(lambda name: checksum(session.folder / name), session.files)
    manifest = CalibrationManifest(
        configuration={
            "frames": str(session.folder),
            "list": listed.model_dump(mode="json"),
            "frames_sha256": dict(zip(session.files, digests, strict=True)),
        },
        camera=listed.camera,
        centre=listed.centre,
        board_reflectance=listed.board_reflectance,
        digital=listed.digital,
        parallax=listed.parallax,
        result=result,
        warnings=warnings,
        versions=versions(),
        command=job.command,
    )
    return Factors.of(estimate, manifest)


# ---- What is refused ----


def _checked(session: SessionFrames) -> tuple[SessionFrames, tuple[str, ...]]:
    first, *others = session.files
    size = image_pages(session.folder / first, session.wanted)[1]
    for name in session.files:
        verify(session.folder, name, {}, "")  # no link out of it
    for name in others:
        own = image_pages(session.folder / name, session.wanted)[1]
        if own != size:
            words = f"{name} is {own[0]} x {own[1]} pixels, but {first} is {size[0]} x {size[1]}"
            raise MitsimError(f"frames {session.folder}: {words}; take all with one camera setting")
    prepare, end = session.listed.prepare, session.listed.digital.saturation_dn
    if prepare.divide_by is None:
        common = CommonFactor()
        for name in (session.files[0], session.files[-1]):
            common.add(read_image(session.folder / name, session.wanted))
        factor = common.choose(end)
        if factor == 1 < common.factor:
            are = f"are multiples of {common.factor}, and are used unchanged"
            remedy = f"state prepare.divide_by = {common.factor} if they were shifted or scaled, else 1"
            return session.with_preparer(), (f"frames: all numbers of {session.files[0]} {are}; {remedy}",)
        if factor > 1:
            prepare = prepare.model_copy(update={"divide_by": factor})
            session = replace(session, listed=session.listed.model_copy(update={"prepare": prepare}))
    return session.with_preparer(), ()


# ---- Frames as electrons a second ----


@dataclass(frozen=True, eq=False)
class _Reading:
    rate: FloatArray
    ladder: Ladder
    shots: int

    @property
    def exposure_s(self) -> float:
        return self.ladder.digitals[0].exposure_s

    @property
    def variance(self) -> float:
        return max(self.ladder.variance(self.rate), 0.0) / self.shots


@dataclass(frozen=True, eq=False)
class _Readings:
    session: SessionFrames
    saturated: set[str] = field(default_factory=set)

    def response(self, side: Side, index: int) -> tuple[FloatArray, float, FloatArray | None]:
        positive = self._merge((side, index, 1))
        if self.session.pairs:
            negative = self._merge((side, index, -1))
            light = positive.rate + negative.rate
            return positive.rate - negative.rate, positive.ladder.variance(light, 2) / positive.shots, light
        uniform = self._uniform[side]
        response = 2 * positive.rate - uniform.rate
        variance = 4 * positive.variance + uniform.variance
        if self.session.dark:
            # 2 (Y - D) - (U - D), where both are exposed alike.
            both = (positive.exposure_s, 2), (uniform.exposure_s, -1)
            parts: dict[float, int] = {}
            for exposure, weight in both:
                parts[exposure] = parts.get(exposure, 0) + weight
            for exposure, weight in parts.items():
                dark = self._dark_of[side][exposure]
                response -= weight * dark.rate
                variance += weight**2 * dark.variance
        return response, variance, None

    @cached_property
    def _uniform(self) -> dict[Side, _Reading]:
        return {side: self._merge((side, 0, UNIFORM)) for side in SIDES}

    @cached_property
    def _ladders(self) -> dict[Side, Ladder] | None:
        listed = self.session.listed
        if len(listed.exposure_ladder) == 1:
            return None
        digital, factors = listed.digital, listed.exposure_ladder
        digitals = [digital.model_copy(update={"exposure_s": digital.exposure_s * factor}) for factor in factors]
        found = {}
        for side, other in zip(SIDES, reversed(SIDES), strict=True):
            frames = self.session.repeats_of((other, 0, 1 if self.session.pairs else UNIFORM))
            uniform = self._read(frames, True)
            found[side] = Ladder.of(digitals, uniform.rate, uniform.shots, listed.ladder_merge)
        return found

    @cached_property
    def _dark_of(self) -> dict[Side, dict[float, _Reading]]:
        found = {}
        for exposure in {self.session.exposure_s(frame) for frame in self.session.dark}:
            frames = [frame for frame in self.session.dark if self.session.exposure_s(frame) == exposure]
            levels = np.array([float(self._read([frame], True).rate.mean()) for frame in frames])
            uniform = self._read(self.session.repeats_of((SIDES[0], 0, UNIFORM)), True).rate.mean()
            parts = (levels - np.median(levels)) / uniform
            worst = int(np.argmax(np.abs(parts)))
            if abs(parts[worst]) > 0.01:
                raise MitsimError(
                    f"frames {self.session.folder}: {frames[worst].file}, with the projector off, has "
                    f"{parts[worst]:+.1%} of a uniform frame's light more than the median of {len(frames)} such "
                    "frames; leave the wrong one out"
                )
            found[exposure] = self._read(frames, True)
        if self._ladders is None:
            return dict.fromkeys(SIDES, found)
        each = [found[digital.exposure_s] for digital in self._ladders[SIDES[0]].digitals]
        exposure, shots = each[0].exposure_s, each[0].shots
        merged = ((side, ladder, ladder.merge(own.rate for own in each)) for side, ladder in self._ladders.items())
        return {side: {exposure: _Reading(rate, ladder, shots)} for side, ladder, rate in merged}

    def _merge(self, half: Half) -> _Reading:
        if self._ladders is None:
            return self._read(self.session.repeats_of(half), True)
        ladder = self._ladders[half[0]]
        numbers = range(len(ladder.digitals))
        each = ((self.session.repeats_of(half, number), ladder.used_pixels(number)) for number in numbers)
        rates = [self._read(*exposed).rate for exposed in each]
        return _Reading(ladder.merge(rates), ladder, self.session.listed.repeats)

    def _read(self, frames: Sequence[StripeFile | DarkFile], used: Chosen) -> _Reading:
        digital = self.session.listed.digital.model_copy(update={"exposure_s": self.session.exposure_s(frames[0])})
        total: FloatArray | None = None
        for frame in frames:
            values = self.session.read(frame.file)
            end = own_end(values) if digital.saturation_dn is None else digital.saturation_dn
            if end is not None and ((values >= end) & used).any():
                self.saturated.add(frame.file)
            total = values.astype(np.float64) if total is None else total + values
        assert total is not None
        return _Reading(digital.rate(total / len(frames)), Ladder((digital,)), len(frames))


# ---- Sums over responses, and the estimate ----


def _sums(readings: _Readings, count: int, job: Job) -> tuple[tuple[StripeSums, StripeSums], list[float]]:
    with job.clock.stage("frames"):
        first = [readings.response(side, 0) for side in SIDES]
    (left, *_), (right, *_) = first
    session, uniform = readings.session, max((left, right), key=lambda response: float(response.mean()))
    brightest = session.repeats_of((SIDES[0], 0, 1 if session.pairs else UNIFORM))[0]
    values, digital = session.read(brightest.file), session.listed.digital
    if digital.rate(values).max() <= 0 or not uniform.any():
        raise MitsimError(
            f"frames {session.folder}: {brightest.file}, a uniform frame, reaches {values.max():g}, and the list's "
            f"digital.black_level_dn {digital.black_level_dn:g} and dark_current_e_per_s "
            f"{digital.dark_current_e_per_s:g} leave no light of it; state them in the files' numbers"
        )
    lights = [light for *_, light in first]
    sums = stripe_sums(left, right, count, readings.session.listed.centre, lights=lights)
    variances = [variance for _, variance, _ in first]
    step = 4 * workers()
    for side, own in zip(SIDES, sums, strict=True):

        def fit_response(index: int, side: Side = side, own: StripeSums = own) -> tuple[ResponseFit, float]:
            response, variance, light = readings.response(side, index)
            return own.fit_response(response, light), variance

        for start in range(1, count, step):
            with job.clock.stage("frames"):
                chunk = in_threads(fit_response, range(start, min(start + step, count)))
            for seen, variance in chunk:
                own.put(seen)
                variances.append(variance)
            job.progress(f"{side} stripes", own.done / count)
    return sums, variances


# ---- One frame at several exposure times ----

Chosen = npt.NDArray[np.bool_] | bool


@dataclass(frozen=True, eq=False)
class Ladder:
    """Exposures of every frame, the shortest first, and their weights (exposures, rows, columns), or None for one."""

    digitals: tuple[Digital, ...]
    weights: FloatArray | None = None

    @classmethod
    def of(cls, digitals: Sequence[Digital], uniform: FloatArray, shots: int, merge: Merge) -> Ladder:
        """Return the weights of exposures by the ``uniform`` rate [electrons/s] at the first, the shortest one."""
        first = digitals[0]
        light = np.maximum(uniform, 0.0)
        error = first.variance(light) / shots
        usable = np.ones((len(digitals), *uniform.shape), dtype=bool)
        variance = np.empty(usable.shape)
        for rung, digital in enumerate(digitals):
            variance[rung] = digital.variance(0.5 * light)
            if rung and digital.saturation_dn is not None:
                unit = digital.gain_dn_per_e * digital.exposure_s
                brightest = uniform + digital.dark_current_e_per_s + 5.0 * np.sqrt(error + digital.variance(light))
                usable[rung] = brightest * unit + digital.black_level_dn < digital.saturation_dn
        if merge == "longest":
            longest = len(digitals) - 1 - np.argmax(usable[::-1], axis=0)
            weights = (np.arange(len(digitals))[:, None, None] == longest).astype(np.float64)
        else:
            weights = usable / variance
            weights /= weights.sum(axis=0)
        return cls(tuple(digitals), weights)

    def merge(self, rates: Iterable[FloatArray]) -> FloatArray:
        each = iter(rates)
        if self.weights is None:
            return next(each)
        total: FloatArray = self.weights[0] * next(each)
        for weight, rate in zip(self.weights[1:], each, strict=True):
            total += weight * rate
        return total

    def used_pixels(self, exposure: int) -> Chosen:
        return True if self.weights is None else np.asarray(self.weights[exposure] > 0)

    def variance(self, light: FloatArray | float, shots: int = 1) -> float:
        if self.weights is None:
            return float(self.digitals[0].variance(float(np.mean(light)), shots))
        parts = zip(self.weights, self.digitals, strict=True)
        return float(sum((np.square(weight) * digital.variance(light, shots)).mean() for weight, digital in parts))
