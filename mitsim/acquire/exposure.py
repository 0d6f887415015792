"""One exposure setting of a camera: from expected irradiance to digital numbers, and back to electrons a second."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any, Literal, TypeVar

import numpy as np

from mitsim.bench.request import Exposure
from mitsim.core.arrays import FloatArray
from mitsim.core.manifests import MOST_SHOTS
from mitsim.core.parallel import in_threads
from mitsim.core.seeds import stream
from mitsim.devices.camera import Rig
from mitsim.devices.patterns import PatternFamily
from mitsim.devices.sensor import SensorModel
from mitsim.optics.frames import ExpectedFrames, Frame
from mitsim.optics.speckle import speckled
from mitsim.planner.memory import frames_at_once
from mitsim.sensor.chain import (
    Digital,
    dn_to_electrons,
    electrons_from_irradiance,
    expose,
)
from mitsim.sensor.moments import mean_variance, saturated_pixels
from mitsim.sensor.specimen import specimen

Item = TypeVar("Item", bound=tuple[Any, ...])


@dataclass(frozen=True)
class Exposer:
    """A rig's camera at one exposure time; every frame's noise has streams of its own, found by its names.

    ``speckle`` is the contrast of laser speckle in the frames; 0 without.
    """

    rig: Rig
    exposure_s: float
    seed: int
    speckle: float = 0.0

    def electrons(self, frame: Frame) -> FloatArray:
        """Expected photoelectrons (m, m') of ``frame``, without dark current."""
        return electrons_from_irradiance(
            frame.irradiance, self.exposure_s, self.rig.sensor, self.rig.projector.effective_wavelength_nm
        )

    def lit(self, frame: Frame, *names: str | int) -> FloatArray:
        """Expected photoelectrons of ``frame``, with the speckle of its own that ``names`` find."""
        return speckled(self.electrons(frame), self.speckle, stream(self.seed, "speckle", *names))

    def digital(self, electrons: FloatArray, *names: str | int) -> Digital:
        """Noisy digital numbers of expected ``electrons``; ``names`` find the frame's own noise."""
        shot, read = (stream(self.seed, noise, *names) for noise in ("shot", "read"))
        return expose(electrons, self.exposure_s, self.rig.sensor, shot, read)

    def rate(self, digital: Digital) -> FloatArray:
        """What a user of frames computes of ``digital`` numbers: photoelectrons a second, dark current taken off."""
        sensor = self.rig.sensor
        return dn_to_electrons(digital, sensor) / self.exposure_s - sensor.superpixel_dark_current_e_per_s

    def rendering_noise(self, frame: Frame) -> float:
        """Root mean square Monte Carlo error of ``frame`` [electrons]."""
        unit = electrons_from_irradiance(
            1.0, self.exposure_s, self.rig.sensor, self.rig.projector.effective_wavelength_nm
        )
        return float(np.sqrt(frame.variance) * unit)

    def sensor_noise(self, electrons: FloatArray) -> float:
        """Root mean square noise of the sensor on expected ``electrons``, from its closed form [electrons]."""
        variance = mean_variance(electrons, self.exposure_s, self.rig.sensor)
        return math.sqrt(variance) / self.rig.sensor.gain_dn_per_e

    def saturated(self, digital: Digital, electrons: FloatArray) -> bool:
        """Whether a pixel of a ``digital`` frame, of expected ``electrons``, reached the full well or the ADC's end."""
        return saturated_pixels(digital, electrons, self.exposure_s, self.rig.sensor) > 0

    def measurements(self, family: PatternFamily, expected: ExpectedFrames) -> Iterator[tuple[FloatArray, int, int]]:
        """Noisy measurement [electrons / s] of every pattern (i, j) of ``family``, from its ``expected`` frames.

        A signed pattern is a difference of two frames.
        """
        positive: FloatArray | None = None
        for shots in in_chunks(zip(family.shots, expected, strict=True)):
            rates = in_threads(lambda item: self._measured(item[1], *item[0].names), shots)
            for (shot, _), rate in zip(shots, rates, strict=True):
                if shot.sign == 1:
                    positive = rate
                    continue
                yield rate if positive is None else positive - rate, shot.row, shot.column
                positive = None

    def _measured(self, frame: Frame, *names: str | int) -> FloatArray:
        """Noisy electrons a second of the frame ``names``."""
        return self.rate(self.digital(self.lit(frame, *names), *names))


def in_chunks(items: Iterable[Item]) -> Iterator[list[Item]]:
    """Lists of ``items``, in order, as many as :func:`frames_at_once` has of the frame that each item ends with."""
    remaining = iter(items)
    for first in remaining:
        yield [first, *islice(remaining, frames_at_once(first[-1].irradiance.size) - 1)]


@dataclass(frozen=True)
class NoiseTarget:
    """Monte Carlo error at which more sampling buys nothing: a part of the sensor's own relative noise.

    Attributes
    ----------
    rig, exposure
        the devices, and how its exposure time is found.
    fraction
        part of the noise.
    """

    rig: Rig
    exposure: Exposure
    fraction: float

    def __call__(self, expected: ExpectedFrames) -> float:
        """Relative error to stop at, from the frames ``expected`` so far."""
        peak = peak_irradiance(expected)
        if peak <= 0:
            return np.inf
        exposer = Exposer(self.rig, self.exposure.choose(self.rig, peak), 0)
        noise = energy = 0.0
        for frame in expected:
            electrons = exposer.electrons(frame)
            noise += exposer.sensor_noise(electrons) ** 2 * electrons.size
            energy += float(np.square(electrons).sum())
        return self.fraction * float(np.sqrt(noise / energy))


def peak_irradiance(expected: ExpectedFrames) -> float:
    """Irradiance [W m^-2] of the brightest pixel of ``expected`` frames."""
    return max(float(frame.irradiance.max()) for frame in expected)


def camera_warnings(sensor: SensorModel, shape: tuple[int, ...]) -> Iterator[str]:
    """What a ``sensor`` does to frames of a ``shape`` that an image of them does not know of."""
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

AmbientChoice = Literal["auto", "yes", "no"]
_PART = 1 / 16
"""Part of an image's noise variance that its ambient frame may bring, 0.26 dB: an exposure for every further tenth of a
decibel would be better spent on the frames."""


def is_taken(choice: AmbientChoice, family: PatternFamily, expected: ExpectedFrames) -> bool:
    """Whether a capture takes an ambient frame.

    Parameters
    ----------
    choice
        what was asked for; ``auto`` takes it where lamps are on and the family has frames that show them.
    family
        a signed one needs none: in the difference of two shots ambient light cancels, and so would an ambient frame.
    expected
        the family's frames.
    """
    return choice == "yes" or (choice == "auto" and expected.has_ambient and not family.signed)


def shots_for(family: PatternFamily) -> int:
    """Shots that an ambient frame is the mean of, so that its noise is at most a sixteenth of the image's variance.

    An ambient frame is no noisier than a frame with the projector on, but its noise is the same in all frames of a
    ``family``. Where patterns p_i are disjoint, as shifting dots, every scene pixel sees it once, like that of its own
    frame; where they are alike it adds up, by |sum_i p_i|^2 / sum_i |p_i|^2 on either side.
    """
    alike = 1.0
    for side in (family.left, family.right):
        patterns = side.astype(np.float64)
        alike *= float(np.square(patterns.sum(axis=1)).sum() / np.square(patterns).sum())
    return min(max(1, math.ceil(alike / _PART)), MOST_SHOTS)


@dataclass(frozen=True, eq=False)
class AmbientFrame:
    """Mean of some shots with the projector off.

    Attributes
    ----------
    shots
        that were averaged.
    electrons
        (rows, columns) expected in each, without dark current.
    digital
        (rows, columns) mean digital numbers.
    saturated
        whether a pixel reached the full well or the ADC's end in a shot.
    """

    shots: int
    electrons: FloatArray
    digital: FloatArray
    saturated: bool

    @classmethod
    def exposed(cls, exposer: Exposer, expected: ExpectedFrames, shots: int) -> AmbientFrame:
        """The mean of noisy shots, each with streams of its own.

        Parameters
        ----------
        exposer, expected
            camera and exposure of a family's frames, and these.
        shots
            to average.
        """
        electrons = exposer.electrons(expected.projector_off)
        total, saturated = np.zeros_like(electrons), False
        step = frames_at_once(electrons.size)
        for start in range(0, shots, step):
            names = [("ambient", shot) for shot in range(start, min(start + step, shots))]
            for digital in in_threads(lambda name: exposer.digital(electrons, *name), names):
                total += digital
                saturated |= exposer.saturated(digital, electrons)
        return cls(shots, electrons, total / shots, saturated)


def taken_off(exposer: Exposer, family: PatternFamily, expected: ExpectedFrames) -> FloatArray | float:
    """What a user of frames takes off each of them [electrons/s], from an ambient frame if they need one.

    Parameters
    ----------
    exposer, family, expected
        camera and exposure, patterns, and their frames without noise.
    """
    if not is_taken("auto", family, expected):
        return 0.0
    return exposer.rate(AmbientFrame.exposed(exposer, expected, shots_for(family)).digital)
