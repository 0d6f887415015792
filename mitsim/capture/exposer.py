"""One exposure setting of a camera: from expected irradiance to digital numbers, and back to electrons a second."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
from scipy import special

from mitsim.capture.bench import Bench
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import in_threads
from mitsim.core.seeds import stream
from mitsim.optics.frames import ExpectedFrames, Frame
from mitsim.optics.speckle import speckled
from mitsim.rig.patterns import PatternFamily
from mitsim.sensor.chain import (
    Digital,
    add_dark_current,
    dn_to_electrons,
    electrons_from_irradiance,
    expose,
    exposure_for_peak,
)
from mitsim.sensor.moments import frame_moments

_LONGEST_S = 1e6
_CAN_SATURATE = 1e-3
FRAMES_AT_ONCE = 16
"""Frames held in memory at a time."""


@dataclass(frozen=True)
class Exposure:
    """One exposure for a whole session: ``seconds`` by hand, or the brightest pixel at ``fraction`` of full well."""

    seconds: float | None = None
    fraction: float = 0.8

    def __post_init__(self) -> None:
        if self.seconds is not None and not 0 < self.seconds <= _LONGEST_S:
            raise MitsimError(f"exposure {self.seconds} s: give a time above 0, up to {_LONGEST_S:g} s, or auto")
        if not 0 < self.fraction <= 1:
            raise MitsimError(f"exposure fraction {self.fraction} of full well: give a number above 0, up to 1")

    def check(self, bench: Bench) -> None:
        """MitsimError when the time is to follow from a full well that the camera does not have."""
        if self.seconds is None and not np.isfinite(bench.sensor.full_well_e):
            raise MitsimError(
                f"camera {bench.camera_file}: full_well_e is inf, so there is no full well to fill; "
                "give a finite one, or an exposure in seconds"
            )

    def choose(self, bench: Bench, peak_irradiance: float) -> float:
        """Exposure time [s] for frames whose brightest expected pixel has this irradiance [W m^-2]."""
        if self.seconds is not None:
            return self.seconds
        wavelength = bench.projector.effective_wavelength_nm
        return exposure_for_peak(peak_irradiance, self.fraction, bench.sensor, wavelength)


@dataclass(frozen=True)
class Exposer:
    """A bench's camera at one exposure time; every frame's noise has streams of its own, found by its names.

    ``speckle`` is the contrast of laser speckle in the frames; 0 without.
    """

    bench: Bench
    exposure_s: float
    seed: int
    speckle: float = 0.0

    def electrons(self, frame: Frame) -> FloatArray:
        """Expected photoelectrons (pixels, pixels), without dark current."""
        return electrons_from_irradiance(
            frame.irradiance, self.exposure_s, self.bench.sensor, self.bench.projector.effective_wavelength_nm
        )

    def lit(self, frame: Frame, *names: str | int) -> FloatArray:
        """Expected photoelectrons of the frame ``names``, with its own speckle."""
        return speckled(self.electrons(frame), self.speckle, stream(self.seed, "speckle", *names))

    def digital(self, electrons: FloatArray, *names: str | int) -> Digital:
        """Noisy digital numbers of the frame ``names``."""
        shot, read = (stream(self.seed, noise, *names) for noise in ("shot", "read"))
        return expose(electrons, self.exposure_s, self.bench.sensor, shot, read)

    def rate(self, digital: Digital) -> FloatArray:
        """What a user of frames computes: photoelectrons a second, dark current taken off."""
        sensor = self.bench.sensor
        return dn_to_electrons(digital, sensor) / self.exposure_s - sensor.superpixel_dark_current_e_per_s

    def rendering_noise(self, frame: Frame) -> float:
        """Root mean square Monte Carlo error of a frame [electrons]."""
        unit = electrons_from_irradiance(
            1.0, self.exposure_s, self.bench.sensor, self.bench.projector.effective_wavelength_nm
        )
        return float(np.sqrt(frame.variance) * unit)

    def sensor_noise(self, electrons: FloatArray) -> float:
        """Root mean square noise of the sensor in a frame, from its closed form [electrons]."""
        _, variance = frame_moments(electrons, self.exposure_s, self.bench.sensor)
        return float(np.sqrt(variance.mean()) / self.bench.sensor.gain_dn_per_e)

    def saturated(self, digital: Digital, electrons: FloatArray) -> bool:
        """Whether any pixel reached the full well or the ADC's end, from the frame and its expected photoelectrons.

        A reading at the full well counts where the light can have filled it: with a chance of 1e-3 in the whole frame.
        Elsewhere it is read noise.
        """
        sensor = self.bench.sensor
        well, brightest = sensor.superpixel_full_well_e, float(digital.max())
        if sensor.largest_dn is not None and brightest >= sensor.largest_dn:
            return True
        if np.isinf(well) or brightest < np.floor(well * sensor.gain_dn_per_e + sensor.superpixel_black_level_dn):
            return False
        peak = add_dark_current(electrons.max(), self.exposure_s, sensor)
        return bool(special.pdtrc(np.ceil(well) - 1, peak) * electrons.size >= _CAN_SATURATE)

    def measurements(self, family: PatternFamily, expected: ExpectedFrames) -> Iterator[tuple[FloatArray, int, int]]:
        """Noisy measurement [electrons / s] of every pattern (i, j); a signed pattern is a difference of two frames."""
        numbered = zip(family.captures, expected, strict=True)
        half: FloatArray | None = None
        while chunk := list(islice(numbered, FRAMES_AT_ONCE)):
            rates = in_threads(lambda item: self._measured(item[1], *item[0].names), chunk)
            for (shown, _), rate in zip(chunk, rates, strict=True):
                if shown.sign == 1:
                    half = rate
                    continue
                yield rate if half is None else half - rate, shown.row, shown.column
                half = None

    def _measured(self, frame: Frame, *names: str | int) -> FloatArray:
        """Noisy electrons a second of the frame ``names``."""
        return self.rate(self.digital(self.lit(frame, *names), *names))
