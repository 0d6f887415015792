"""Exposure of a camera, at rest or drifted: digital numbers from expected irradiance, and back to electrons/s."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from itertools import islice
from typing import Any, Literal, TypeVar

import numpy as np

from mitsim.bench.apparatus import Apparatus
from mitsim.core.arrays import FloatArray, sum_of_squares
from mitsim.core.errors import MitsimError
from mitsim.core.exr import Channel
from mitsim.core.job import Job
from mitsim.core.manifests import MOST_SHOTS
from mitsim.core.parallel import Behind, in_threads
from mitsim.core.runs import Recorder
from mitsim.core.seeds import stream
from mitsim.devices.camera import Devices
from mitsim.devices.patterns import PatternFamily, Shot
from mitsim.devices.sensor import SensorModel
from mitsim.devices.session import Drift
from mitsim.light.cost_model import frames_at_once
from mitsim.light.settings import Estimate
from mitsim.optics.frames import ExpectedFrames, Frame, add_speckle, bound_of
from mitsim.scene.load import window_at
from mitsim.sensor import chain
from mitsim.sensor.chain import Digital, mean_variance, saturated_pixels

Item = TypeVar("Item", bound=tuple[Any, ...])
Used = TypeVar("Used")


@dataclass(frozen=True)
class Exposer:
    """A camera at one exposure time; every frame has random streams of its own."""

    devices: Devices
    exposure_s: float
    seed: int
    speckle: float = 0.0

    def electrons(self, frame: Frame) -> FloatArray:
        wavelength = self.devices.projector.effective_wavelength_nm
        return chain.electrons_from_irradiance(frame.irradiance, self.exposure_s, self.devices.sensor, wavelength)

    def shot_electrons(self, frame: Frame, *names: str | int) -> FloatArray:
        return add_speckle(self.electrons(frame), self.speckle, stream(self.seed, "speckle", *names))

    def digital(self, electrons: FloatArray, *names: str | int) -> Digital:
        shot, read = (stream(self.seed, noise, *names) for noise in ("shot", "read"))
        return chain.expose(electrons, self.exposure_s, self.devices.sensor, shot, read)

    def rate(self, digital: Digital) -> FloatArray:
        sensor = self.devices.sensor
        return chain.dn_to_electrons(digital, sensor) / self.exposure_s - sensor.superpixel_dark_current_e_per_s

    def sensor_noise(self, electrons: FloatArray) -> float:
        variance = mean_variance(electrons, self.exposure_s, self.devices.sensor)
        return math.sqrt(variance) / self.devices.sensor.gain_dn_per_e

    def saturates(self, digital: Digital, electrons: FloatArray) -> bool:
        return saturated_pixels(digital, electrons, self.exposure_s, self.devices.sensor) > 0

    def measurements(self, family: PatternFamily, expected: ExpectedFrames) -> Iterator[tuple[FloatArray, int, int]]:
        def measure(item: tuple[Shot, Frame]) -> FloatArray:
            shot, frame = item
            return self.rate(self.digital(self.shot_electrons(frame, *shot.names), *shot.names))

        chunks = in_chunks(zip(family.shots, expected, strict=True))
        return family.measurements(rate for shots in chunks for rate in in_threads(measure, shots))


def in_chunks(items: Iterable[Item]) -> Iterator[list[Item]]:
    remaining = iter(items)
    for first in remaining:
        yield [first, *islice(remaining, frames_at_once(first[-1].irradiance.size) - 1)]


def used_in_chunks(
    items: Iterable[Item], use: Callable[[Item], Used], job: Job
) -> Iterator[tuple[list[Item], list[Used]]]:
    """Form ``items`` in chunks, apply ``use`` in threads, and yield each chunk with its results."""
    chunks = in_chunks(items)
    while True:
        with job.clock.stage("optics"):
            if (chunk := next(chunks, None)) is None:
                return
        with job.clock.stage("sensor"):
            results = in_threads(use, chunk)
        yield chunk, results


def peak_irradiance(expected: ExpectedFrames) -> float:
    return max(float(frame.irradiance.max()) for frame in expected)


def camera_warnings(sensor: SensorModel, shape: tuple[int, ...]) -> Iterator[str]:
    if sensor.hot_pixels or sensor.dead_pixels:
        own = chain.specimen(sensor, (shape[0], shape[1]))
        yield (
            f"defect pixels: {own.hot} are hot and {own.dead} dead, and frames are not corrected, so that an image "
            "treats their readings as light; remove them from the camera's file, or look at the image's misfit"
        )
    if sensor.prnu_pixel:
        yield (
            f"response nonuniformity: pixels differ by {sensor.response_parts[0]:.2%} of their light; separable "
            "factors cannot describe this, so that an image treats it as light"
        )
    if sensor.row_noise_e:
        yield (
            f"row noise: {sensor.superpixel_row_noise_e:g} electrons are common to all pixels of a row, but the "
            "uncertainty of an image assumes independent noise; the true uncertainty is larger"
        )
    if sensor.linearity:
        yield (
            f"linearity: at the full well, readings differ by {sum(sensor.linearity):+.1%} from those of a linear "
            "camera, but an image assumes linear frames"
        )


# -------- The ambient frame of a capture
# It is taken with the projector off, not with a black pattern: it then holds what the lamps bring and nothing else,
# and a run less its ambient frame has the expectation of the same run in a dark room. The light that black pixels
# leak stays in the frames, as there.

_PART = 1 / 16
"""Part of an image's noise variance that its ambient frame may add (0.26 dB)."""


def takes_ambient_frame(choice: Literal["auto", "yes", "no"], family: PatternFamily, expected: ExpectedFrames) -> bool:
    """Return True if an ambient frame is taken; by default if lamps are on and shots are not subtracted in pairs."""
    return choice == "yes" or (choice == "auto" and expected.has_ambient and not family.signed)


def ambient_shots(family: PatternFamily) -> int:
    """Return the shots of an ambient frame that add at most a sixteenth of the image's noise variance.

    The noise of an ambient frame is common to all frames. With disjoint patterns p_i, every scene pixel contains it
    once;
    overlapping patterns add it up by |sum_i p_i|^2 / sum_i |p_i|^2 on either side.
    """
    alike = 1.0
    for side in (family.left, family.right):
        patterns = side.astype(np.float64)
        alike *= float(np.square(patterns.sum(axis=1)).sum() / np.square(patterns).sum())
    return min(max(1, math.ceil(alike / _PART)), MOST_SHOTS)


@dataclass(frozen=True, eq=False)
class AmbientFrame:
    shots: int
    electrons: FloatArray
    digital: FloatArray
    saturated: bool

    @classmethod
    def expose(cls, exposer: Exposer, expected: ExpectedFrames, shots: int) -> AmbientFrame:
        electrons = exposer.electrons(expected.projector_off)
        total, saturated = np.zeros_like(electrons), False
        step = frames_at_once(electrons.size)
        for start in range(0, shots, step):
            names = [("ambient", shot) for shot in range(start, min(start + step, shots))]
            for digital in in_threads(lambda name: exposer.digital(electrons, *name), names):
                total += digital
                saturated |= exposer.saturates(digital, electrons)
        return cls(shots, electrons, total / shots, saturated)


def taken_off(exposer: Exposer, family: PatternFamily, expected: ExpectedFrames) -> FloatArray | float:
    if not takes_ambient_frame("auto", family, expected):
        return 0.0
    return exposer.rate(AmbientFrame.expose(exposer, expected, ambient_shots(family)).digital)


# -------- Shots of a family: expected frames made noisy, and recorded


@dataclass(frozen=True)
class Totals:
    """Brightest pixel, Monte Carlo error, and largest parts below zero and from one group, of all frames."""

    peak: float
    noise: Estimate
    removed: float
    heaviest: float

    @classmethod
    def of(cls, expected: ExpectedFrames) -> Totals:
        peak = energy = variance = removed = heaviest = 0.0
        parts = np.zeros((1, 1))
        for chunk in in_chunks((frame,) for frame in expected):
            squared = in_threads(lambda item: sum_of_squares(item[0].irradiance), chunk)
            for (frame,), squares in zip(chunk, squared, strict=True):
                removed = max(removed, frame.removed)
                peak = max(peak, float(frame.irradiance.max()))
                energy += squares
                variance += frame.variance * frame.irradiance.size
                heaviest += frame.heaviest * frame.variance * frame.irradiance.size
                parts = parts + frame.by_group * frame.irradiance.size
        noise = Estimate(float(np.sqrt(variance / energy)) if energy else 0.0, bound_of(parts, energy))
        return cls(peak, noise, removed, heaviest / variance if variance else 0.0)


Exposed = tuple[int, Shot, FloatArray, Digital, float, float, bool, FloatArray]
"""Number, shot, electrons, digital numbers, Monte Carlo error [electrons] and its ratio to the sensor's noise, True if
saturated, and sums over the pixels, of a frame."""


@dataclass(eq=False)
class Shooting:
    """Exposes expected frames and records them; frames that a resumed run already has are kept.

    ``ambient`` is the light that is subtracted from the frames; ``always`` (m, m') are expected electrons of ambient
    light.
    """

    family: PatternFamily
    recorder: Recorder
    exposer: Exposer
    ambient: AmbientFrame | None
    always: FloatArray
    saturated: int = 0
    noise_ratio: float = 0.0

    def shoot(self, expected: ExpectedFrames, job: Job) -> None:
        exposer, wavelength = self.exposer, self.exposer.devices.projector.effective_wavelength_nm
        total = np.zeros(4)

        def expose_shot(item: tuple[int, Shot, Frame]) -> Exposed:
            index, shot, frame = item
            electrons = exposer.shot_electrons(frame, *shot.names)
            digital = exposer.digital(electrons, *shot.names)
            unit = chain.electrons_from_irradiance(1.0, exposer.exposure_s, exposer.devices.sensor, wavelength)
            rendered, noise = float(np.sqrt(frame.variance) * unit), exposer.sensor_noise(electrons)
            energy = sum_of_squares(electrons)
            signal = sum_of_squares(electrons - self.always) if self.always.any() else energy
            ratio = 0.0 if not rendered else rendered / noise if noise else math.inf
            sums = np.array([noise**2 * electrons.size, energy, signal, float(electrons.sum())])
            return index, shot, electrons, digital, rendered, ratio, exposer.saturates(digital, electrons), sums

        def record(exposed: Exposed) -> None:
            index, shot, electrons, digital, rendered, *_ = exposed
            if not self.recorder.keeps(index):
                metadata: dict[str, str | int | float] = {
                    "row": shot.row, "column": shot.column, "sign": shot.sign, "exposure_s": exposer.exposure_s,
                    "rendering_noise_e": rendered, "seed": exposer.seed,
                }  # fmt: skip
                # EXR has no 64-bit numbers: what a sensor without an ADC gives is kept in single precision.
                whole = digital.dtype == np.uint32
                dn: Channel = digital.astype(np.uint32, copy=False) if whole else digital.astype(np.float32)
                channels: dict[str, Channel] = {"DN": dn, "electrons": electrons.astype(np.float32)}
                self.recorder.write_frame(index, channels, metadata)

        shots = zip(range(len(expected)), self.family.shots, expected, strict=True)
        job.progress("frames", 0.0)
        with Behind(record) as writing:
            for chunk, exposed in used_in_chunks(shots, expose_shot, job):
                with job.clock.stage("write"):
                    writing.give(exposed)
                for *_, ratio, saturated, sums in exposed:
                    self.noise_ratio = max(self.noise_ratio, ratio)
                    self.saturated += saturated
                    total += sums
                job.progress("frames", (chunk[-1][0] + 1) / len(expected))
            with job.clock.stage("write"):
                writing.wait()
        own, (noise, energy, signal, light) = 0.0, total
        if self.ambient is not None and not self.family.signed:
            own = exposer.sensor_noise(self.always) ** 2 / self.ambient.shots
            own *= self.always.size * len(self.family.shots)
        self.sensor_noise = math.sqrt(noise / energy) if energy else 0.0
        self.dilution = math.sqrt(energy / signal) if signal else 1.0
        self.ambient_part = float(self.always.sum()) * len(self.family.shots) / float(light) if light else 0.0
        self.noise_to_signal = math.sqrt((noise + own) / signal) if signal else math.inf


# -------- Drift of a bench and of a camera's exposure
#
# Light is traced up to the mask, so that a mask that moved, turned or shakes changes only the optics of traced light
# (:meth:`mitsim.light.light.SampledLight.behind`). The cells suffice because a moved shadow is averaged over the same
# cells. The light of a moved projector is traced anew because it reaches other places. Power, lamps, temperature,
# exposure time and black level are part of the exposure.

_OF_TERMS = ("mask_rotation_mrad", "mask_tilt_rows_mrad", "mask_tilt_columns_mrad", "vibration_um")
"""Kinds of drift after which other separable terms form the mask's shadow."""


def levels(seed: int, name: str, count: int, ramp: float = 0.0, flicker: float = 0.0) -> FloatArray:
    """Return the (count,) relative light of a source in successive frames.

    ``ramp`` is the linear change from the first frame's begin to the last one's end, ``flicker`` the deviation of each.
    """
    changed = 1 + ramp * (np.arange(count) + 0.5) / count
    if flicker:
        changed = changed * (1 + flicker * stream(seed, "drift", name).standard_normal(count))
    return np.asarray(np.maximum(changed, 0.0))


def drift_mask(bench: Apparatus, drift: Drift) -> Apparatus:
    """Return a ``bench`` whose mask has moved by a ``drift``, for light that was traced before.

    Raises MitsimError for a mask that turns, tilts or shakes before mirrors or on a raster, for a thick one that tilts,
    and for one that tilts too far or moves into the sensor or the scene.
    """
    row, column, axis = drift.mask_mm
    camera, kinds = bench.geometry, " and ".join(kind for kind in drift.kinds if kind in _OF_TERMS)
    changed: dict[str, object] = {
        "mask_offset_row": camera.mask_offset_row + row,
        "mask_offset_column": camera.mask_offset_column + column,
        "mask_distance": camera.mask_distance + axis,
        "mask_motion": drift.motion,
        "mask_lean_mrad": drift.tilt_mrad,
    }
    moved, fault = camera.model_copy(update=changed), ""
    if kinds and camera.is_correlated(camera.diffracts):
        fault = (
            f"{kinds} can be simulated only for separable masks, not for {camera.mask_words}; rotate or tilt that mask "
            "in the camera file's [mask]"
        )
    elif kinds and bench.loaded.mirrors:
        fault = f"{kinds} cannot be simulated for light over mirrors; use a scene without mirrors"
    elif drift.tilt_mrad and camera.mask_thickness:
        thick = f"{kinds} would tilt a mask of {camera.mask_thickness:g} mm"
        fault = f"{thick}, but only thin masks can be tilted; set mask_thickness to 0"
    elif not camera.mask_distance + axis > 0:
        fault = f"mask_axis_um moves the mask {-axis:g} mm, to the sensor; it is {camera.mask_distance:g} mm off"
    elif drift.tilt_mrad and moved.tilt_left_out(moved.diffracts):
        tilted = f"{kinds} would tilt the mask until its shadow needs more terms than are computed"
        fault = f"{tilted}; give a smaller tilt, or a tilt about one axis"
    if fault:
        raise MitsimError(f"drift: {fault}")
    return replace(bench, devices=replace(bench.devices, camera=moved))


def drift_projector(bench: Apparatus, drift: Drift) -> Apparatus:
    if not (drift.projector_rows or drift.projector_columns):
        return bench
    loaded, grid = bench.loaded, bench.loaded.pixels
    first_row, first_column = grid.first_row + drift.projector_rows, grid.first_column + drift.projector_columns
    moved = replace(grid, first_row=first_row, first_column=first_column)
    windows = window_at(str(loaded.path), loaded.projector, loaded.camera, moved, bench.geometry.scene_distance)
    placed = replace(moved, row_tan=windows[0], column_tan=windows[1])
    return replace(bench, loaded=replace(loaded, grid=placed))


def warmer(sensor: SensorModel, kelvin: float) -> SensorModel:
    if sensor.dark_current_temperature_c is None or sensor.dark_doubling_c is None or not kelvin:
        return sensor
    now = sensor.dark_current_temperature_c if sensor.temperature_c is None else sensor.temperature_c
    return sensor.model_copy(update={"temperature_c": now + kelvin})


@dataclass(frozen=True)
class DriftedExposer(Exposer):
    """A camera that has drifted: frames are exposed in its true state and interpreted in its known one."""

    _: KW_ONLY
    drift: Drift
    family: PatternFamily
    ambient: FloatArray | float = 0.0

    def electrons(self, frame: Frame) -> FloatArray:
        return self._open.electrons(frame)

    def shot_electrons(self, frame: Frame, *names: str | int) -> FloatArray:
        rows = len(frame.irradiance)
        power, lamp = (
            level * self._ripple(source, rows, *names)
            for source, level in zip(("power", "lamp"), self.levels[names], strict=True)
        )
        light = frame.irradiance + (power - 1) * (frame.irradiance - self.ambient)
        return super().shot_electrons(replace(frame, irradiance=light + (lamp - 1) * self.ambient), *names)

    def digital(self, electrons: FloatArray, *names: str | int) -> Digital:
        if names[0] == "ambient":
            level = self.ambient_levels[int(names[1])] * self._ripple("lamp", len(electrons), *names)
            electrons = level * electrons
        return self._open.digital(electrons, *names)

    def _ripple(self, source: str, rows: int, *names: str | int) -> FloatArray | float:
        if source not in self.drift.ripples:
            return 1.0
        amplitude, hertz = self.drift.ripples[source]
        response = chain.ripple_response(self.devices.sensor, self._open.exposure_s, hertz, rows)
        phase = stream(self.seed, "drift", f"{source} ripple", *names).uniform(0, 2 * np.pi)
        return chain.ripple_level(response, amplitude, phase)

    @cached_property
    def _open(self) -> Exposer:
        sensor, drift = warmer(self.devices.sensor, self.drift.temperature_k), self.drift
        black = {"black_level_dn": sensor.black_level_dn + drift.black_level_dn}
        devices = replace(self.devices, sensor=sensor.model_copy(update=black))
        return Exposer(devices, self.exposure_s * (1 + drift.exposure), self.seed, self.speckle)

    @cached_property
    def levels(self) -> dict[tuple[str | int, ...], tuple[float, float]]:
        shots, drift = self.family.shots, self.drift
        power = (1 + drift.power) * levels(self.seed, "power", len(shots), drift.power_ramp, drift.power_flicker)
        lamp = (1 + drift.lamp) * levels(self.seed, "lamp", len(shots), flicker=drift.lamp_flicker)
        found = zip(power.tolist(), lamp.tolist(), strict=True)
        return dict(zip((shot.names for shot in shots), found, strict=True))

    @cached_property
    def ambient_levels(self) -> FloatArray:
        return levels(self.seed, "ambient", ambient_shots(self.family), flicker=self.drift.lamp_flicker)
