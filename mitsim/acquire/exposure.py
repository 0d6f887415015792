"""Exposure of a camera, at rest or drifted: noisy digital numbers from expected irradiance, and back to electrons/s."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any, Literal, TypeVar

import numpy as np

from mitsim.bench.request import Exposure
from mitsim.core.arrays import FloatArray, sum_of_squares
from mitsim.core.exr import Channel
from mitsim.core.job import Job
from mitsim.core.manifests import MOST_SHOTS, AmbientFile
from mitsim.core.parallel import Behind, in_threads
from mitsim.core.runs import AMBIENT, Recorder
from mitsim.core.seeds import stream
from mitsim.devices.camera import Devices
from mitsim.devices.patterns import PatternFamily, Shot
from mitsim.devices.sensor import SensorModel
from mitsim.light.memory import frames_at_once
from mitsim.light.settings import Estimate
from mitsim.optics.forming import bound_of
from mitsim.optics.frames import ExpectedFrames, Frame, add_speckle
from mitsim.sensor.chain import Digital, dn_to_electrons, electrons_from_irradiance, expose, specimen
from mitsim.sensor.moments import mean_variance, saturated_pixels

Item = TypeVar("Item", bound=tuple[Any, ...])


@dataclass(frozen=True)
class Exposer:
    """A camera at one exposure time, with speckle of a contrast (0 for none).

    Every frame has random streams of its own, which its names select.
    """

    devices: Devices
    exposure_s: float
    seed: int
    speckle: float = 0.0

    def electrons(self, frame: Frame) -> FloatArray:
        """Return the expected photoelectrons (m, m') of ``frame`` without dark current."""
        return electrons_from_irradiance(
            frame.irradiance, self.exposure_s, self.devices.sensor, self.devices.projector.effective_wavelength_nm
        )

    def shot_electrons(self, frame: Frame, *names: str | int) -> FloatArray:
        """Return the expected photoelectrons of ``frame`` with its own speckle."""
        return add_speckle(self.electrons(frame), self.speckle, stream(self.seed, "speckle", *names))

    def digital(self, electrons: FloatArray, *names: str | int) -> Digital:
        """Draw noisy digital numbers of expected ``electrons``."""
        shot, read = (stream(self.seed, noise, *names) for noise in ("shot", "read"))
        return expose(electrons, self.exposure_s, self.devices.sensor, shot, read)

    def rate(self, digital: Digital) -> FloatArray:
        """Return photoelectrons per second, as a user computes them from ``digital`` numbers."""
        sensor = self.devices.sensor
        return dn_to_electrons(digital, sensor) / self.exposure_s - sensor.superpixel_dark_current_e_per_s

    def rendering_noise(self, frame: Frame) -> float:
        """Return the rms Monte Carlo error of ``frame`` [electrons]."""
        unit = electrons_from_irradiance(
            1.0, self.exposure_s, self.devices.sensor, self.devices.projector.effective_wavelength_nm
        )
        return float(np.sqrt(frame.variance) * unit)

    def sensor_noise(self, electrons: FloatArray) -> float:
        """Return the closed-form rms noise of the sensor for expected ``electrons`` [electrons]."""
        variance = mean_variance(electrons, self.exposure_s, self.devices.sensor)
        return math.sqrt(variance) / self.devices.sensor.gain_dn_per_e

    def saturates(self, digital: Digital, electrons: FloatArray) -> bool:
        """Return True if a pixel of the frame reached the full well or the end of the ADC."""
        return saturated_pixels(digital, electrons, self.exposure_s, self.devices.sensor) > 0

    def measurements(self, family: PatternFamily, expected: ExpectedFrames) -> Iterator[tuple[FloatArray, int, int]]:
        """Yield the noisy measurement [electrons/s] of every pattern (i, j), from two frames if signed."""
        positive: FloatArray | None = None
        for shots in in_chunks(zip(family.shots, expected, strict=True)):
            rates = in_threads(lambda item: self._measurement(item[1], *item[0].names), shots)
            for (shot, _), rate in zip(shots, rates, strict=True):
                if shot.sign == 1:
                    positive = rate
                    continue
                yield rate if positive is None else positive - rate, shot.row, shot.column
                positive = None

    def _measurement(self, frame: Frame, *names: str | int) -> FloatArray:
        return self.rate(self.digital(self.shot_electrons(frame, *names), *names))


def in_chunks(items: Iterable[Item]) -> Iterator[list[Item]]:
    """Split ``items`` into lists of as many as :func:`frames_at_once` allows."""
    remaining = iter(items)
    for first in remaining:
        yield [first, *islice(remaining, frames_at_once(first[-1].irradiance.size) - 1)]


@dataclass(frozen=True)
class NoiseTarget:
    """Monte Carlo error below which more sampling gains nothing: a ``fraction`` of the sensor's own relative noise."""

    devices: Devices
    exposure: Exposure
    fraction: float

    def __call__(self, expected: ExpectedFrames) -> float:
        """Return the relative error at which sampling stops."""
        peak = peak_irradiance(expected)
        if peak <= 0:
            return np.inf
        exposer = Exposer(self.devices, self.exposure.choose(self.devices, peak), 0)
        noise = energy = 0.0
        for frame in expected:
            electrons = exposer.electrons(frame)
            noise += exposer.sensor_noise(electrons) ** 2 * electrons.size
            energy += float(np.square(electrons).sum())
        return self.fraction * float(np.sqrt(noise / energy))


def peak_irradiance(expected: ExpectedFrames) -> float:
    """Return the irradiance [W m^-2] of the brightest pixel of ``expected`` frames."""
    return max(float(frame.irradiance.max()) for frame in expected)


def camera_warnings(sensor: SensorModel, shape: tuple[int, ...]) -> Iterator[str]:
    """Yield effects of a ``sensor`` that the model of an image does not contain."""
    if sensor.has_defects:
        own = specimen(sensor, (shape[0], shape[1]))
        yield (
            f"defect pixels: {own.hot} are hot and {own.dead} dead, and frames have them as they are read; an image "
            "takes what they read for light; leave them out of the camera's file, or look at its misfit"
        )
    if sensor.prnu_pixel:
        yield (
            f"response nonuniformity: pixels differ by {sensor.response_parts[0]:.2%} of their light, which is no "
            "product of a row's and a column's; factors hold none of it, and an image takes it for light"
        )
    if sensor.row_noise_e:
        yield (
            f"row noise: {sensor.superpixel_row_noise_e:g} electrons are shared by a row's pixels, and an image's "
            "uncertainty takes all noise for independent; it is larger than stated"
        )
    if sensor.linearity:
        yield (
            f"linearity: a full well reads {sum(sensor.linearity):+.1%} off what a linear camera reads, and an image "
            "takes the frames for linear"
        )


# -------- The ambient frame of a capture
# It is taken with the projector off, not with a black pattern: it then holds what the lamps bring and nothing else,
# and a run less its ambient frame has the expectation of the same run in a dark room. The light that black pixels
# leak stays in the frames, as there.

AmbientChoice = Literal["auto", "yes", "no"]
_PART = 1 / 16
"""Part of an image's noise variance that its ambient frame may add (0.26 dB)."""


def takes_ambient_frame(choice: AmbientChoice, family: PatternFamily, expected: ExpectedFrames) -> bool:
    """Return True if a capture takes an ambient frame.

    With ``auto`` it does if lamps are on and the family is unsigned: in the difference of two shots ambient light
    cancels.
    """
    return choice == "yes" or (choice == "auto" and expected.has_ambient and not family.signed)


def ambient_shots(family: PatternFamily) -> int:
    """Return the shots of an ambient frame that add at most a sixteenth of the image's noise variance.

    An ambient frame is no noisier than others, but its noise is common to all frames of a ``family``. With disjoint
    patterns p_i such as shifting dots, every scene pixel contains it once, like the noise of its own frame. With
    overlapping patterns it adds up by |sum_i p_i|^2 / sum_i |p_i|^2 on either side.
    """
    alike = 1.0
    for side in (family.left, family.right):
        patterns = side.astype(np.float64)
        alike *= float(np.square(patterns.sum(axis=1)).sum() / np.square(patterns).sum())
    return min(max(1, math.ceil(alike / _PART)), MOST_SHOTS)


@dataclass(frozen=True, eq=False)
class AmbientFrame:
    """Mean of several shots with the projector off.

    Attributes
    ----------
    shots
        Number of shots.
    electrons
        (rows, columns) expected electrons of each, without dark current.
    digital
        (rows, columns) mean digital numbers.
    saturated
        True if a pixel saturated in a shot.
    """

    shots: int
    electrons: FloatArray
    digital: FloatArray
    saturated: bool

    @classmethod
    def expose(cls, exposer: Exposer, expected: ExpectedFrames, shots: int) -> AmbientFrame:
        """Average noisy shots, each with random streams of its own."""
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
    """Return the ambient light [electrons/s] that a user subtracts from each frame, from an ambient frame if needed."""
    if not takes_ambient_frame("auto", family, expected):
        return 0.0
    return exposer.rate(AmbientFrame.expose(exposer, expected, ambient_shots(family)).digital)


# -------- Shots of a family: expected frames made noisy, and recorded


@dataclass(frozen=True)
class Totals:
    """Brightest pixel [W m^-2], relative Monte Carlo error and largest negative light over all expected frames.

    ``heaviest`` is the largest part of the Monte Carlo variance from one group of the light; ``mc_bound`` the 95 %
    bound.
    """

    peak: float
    mc_error: float
    removed: float
    heaviest: float
    mc_bound: float

    @property
    def noise(self) -> Estimate:
        """Return the Monte Carlo error and its bound."""
        return Estimate(self.mc_error, self.mc_bound)

    @classmethod
    def of(cls, expected: ExpectedFrames) -> Totals:
        """Form all ``expected`` frames and return their totals."""
        peak = energy = variance = removed = heaviest = 0.0
        parts = np.zeros((1, 1))
        for chunk in in_chunks((frame,) for frame in expected):
            for (frame,), (brightest, squares) in zip(chunk, in_threads(_peak_and_energy, chunk), strict=True):
                removed = max(removed, frame.removed)
                peak = max(peak, brightest)
                energy += squares
                variance += frame.variance * frame.irradiance.size
                heaviest += frame.heaviest * frame.variance * frame.irradiance.size
                parts = parts + frame.by_group * frame.irradiance.size
        mc_error = float(np.sqrt(variance / energy)) if energy else 0.0
        return cls(peak, mc_error, removed, heaviest / variance if variance else 0.0, bound_of(parts, energy))


def _peak_and_energy(item: tuple[Frame]) -> tuple[float, float]:
    (frame,) = item
    return float(frame.irradiance.max()), sum_of_squares(frame.irradiance)


@dataclass(frozen=True, eq=False)
class _Exposed:
    index: int
    shot: Shot
    electrons: FloatArray
    digital: Digital
    rendering_noise: float
    sensor_noise: float
    saturated: bool
    light: float
    energy: float
    signal: float


@dataclass(eq=False)
class Shooting:
    """Exposes expected frames and records them; frames that a resumed run already has are kept.

    Attributes
    ----------
    family, recorder, exposer
        Shots, storage and camera.
    ambient
        Light that is subtracted from the frames.
    always
        (m, m') expected electrons of ambient light.
    saturated, noise_ratio
        Frames with saturated pixels, and the largest ratio of rendering noise to sensor noise.
    """

    family: PatternFamily
    recorder: Recorder
    exposer: Exposer
    ambient: AmbientFrame | None
    always: FloatArray
    saturated: int = 0
    noise_ratio: float = 0.0
    _noise_energy: float = 0.0
    _energy: float = 0.0
    _signal: float = 0.0
    _light: float = 0.0

    @property
    def sensor_noise(self) -> float:
        """Return the sensor's closed-form relative noise ||noise|| / ||expected|| over all frames."""
        return math.sqrt(self._noise_energy / self._energy) if self._energy else 0.0

    @property
    def dilution(self) -> float:
        """Return ||frames|| / ||projector's light||: the factor by which lamps dilute a relative error."""
        return math.sqrt(self._energy / self._signal) if self._signal else 1.0

    @property
    def ambient_part(self) -> float:
        """Return the part of ambient light in the frames."""
        return float(self.always.sum()) * len(self.family.shots) / self._light if self._light else 0.0

    @property
    def noise_to_signal(self) -> float:
        """Return ||noise|| / ||light of the projector|| over all frames less the ambient frame."""
        own = 0.0
        if self.ambient is not None and not self.family.signed:
            own = self.exposer.sensor_noise(self.always) ** 2 / self.ambient.shots
            own *= self.always.size * len(self.family.shots)
        return math.sqrt((self._noise_energy + own) / self._signal) if self._signal else math.inf

    @property
    def ambient_file(self) -> AmbientFile | None:
        """Return the manifest's entry of the ambient frame."""
        if self.ambient is None:
            return None
        return AmbientFile(file=AMBIENT, shots=self.ambient.shots, part=self.ambient_part, noise=self.noise_to_signal)

    def shoot(self, expected: ExpectedFrames, job: Job) -> None:
        """Expose and record the ``expected`` frames in chunks, one thread per processor.

        Files are written while the next chunk is formed; the stage ``write`` is the time that work waits for them.
        """
        chunks = in_chunks(zip(range(len(expected)), self.family.shots, expected, strict=True))
        job.progress("frames", 0.0)
        with Behind(self._record) as writing:
            while True:
                with job.clock.stage("optics"):
                    chunk = next(chunks, None)
                if chunk is None:
                    break
                with job.clock.stage("sensor"):
                    exposed = in_threads(self._expose, chunk)
                with job.clock.stage("write"):
                    writing.give(exposed)
                for shot in exposed:
                    self._count(shot)
                job.progress("frames", (chunk[-1][0] + 1) / len(expected))
            with job.clock.stage("write"):
                writing.wait()

    def _count(self, shot: _Exposed) -> None:
        if shot.rendering_noise:
            ratio = shot.rendering_noise / shot.sensor_noise if shot.sensor_noise else np.inf
            self.noise_ratio = max(self.noise_ratio, ratio)
        self.saturated += shot.saturated
        self._noise_energy += shot.sensor_noise**2 * shot.electrons.size
        self._energy += shot.energy
        self._signal += shot.signal
        self._light += shot.light

    def _expose(self, item: tuple[int, Shot, Frame]) -> _Exposed:
        index, shot, frame = item
        electrons = self.exposer.shot_electrons(frame, *shot.names)
        digital = self.exposer.digital(electrons, *shot.names)
        energy = sum_of_squares(electrons)
        return _Exposed(
            index=index,
            shot=shot,
            electrons=electrons,
            digital=digital,
            rendering_noise=self.exposer.rendering_noise(frame),
            sensor_noise=self.exposer.sensor_noise(electrons),
            saturated=self.exposer.saturates(digital, electrons),
            light=float(electrons.sum()),
            energy=energy,
            signal=sum_of_squares(electrons - self.always) if self.always.any() else energy,
        )

    def _record(self, exposed: _Exposed) -> None:
        if self.recorder.keeps(exposed.index):
            return
        metadata: dict[str, str | int | float] = {
            "row": exposed.shot.row,
            "column": exposed.shot.column,
            "sign": exposed.shot.sign,
            "exposure_s": self.exposer.exposure_s,
            "rendering_noise_e": exposed.rendering_noise,
            "seed": self.exposer.seed,
        }
        self.recorder.write_frame(exposed.index, frame_channels(exposed.digital, exposed.electrons), metadata)


def frame_channels(digital: Digital, electrons: FloatArray) -> dict[str, Channel]:
    """Return the channels of a frame's file."""
    # EXR has no 64-bit numbers: the real-valued output of a sensor without an ADC is kept in single precision.
    whole = digital.dtype == np.uint32
    dn: Channel = digital.astype(np.uint32, copy=False) if whole else digital.astype(np.float32)
    return {"DN": dn, "electrons": electrons.astype(np.float32)}
