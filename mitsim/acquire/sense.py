"""Response of a camera's sensor to an image of irradiance or radiance, whose pixels are the (binned) sensor's."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mitsim.bench.request import Irradiance, check_ending, check_image
from mitsim.core import images
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import Drawn, takes
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError, check_arguments
from mitsim.core.exr import Channel, finite_channel, read_frame, write_frame
from mitsim.core.picture_files import Wanted
from mitsim.core.seeds import stream
from mitsim.devices.sensor import EXPOSURE_S, SensorModel
from mitsim.sensor.chain import Digital, electrons_from_irradiance, expose, exposure_for_peak, saturated_pixels

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LUMINANCE = {"R": 0.2126, "G": 0.7152, "B": 0.0722}
"""Weights of linear RGB in luminance (ITU-R BT.709)."""
_IMAGE = Wanted("image", bits=(1, 8, 16, 32))


@dataclass(frozen=True, eq=False)
class Sensed:
    """One frame: (rows, columns) digital numbers, and expected photoelectrons without dark current."""

    digital: Digital
    electrons: FloatArray
    sensor: SensorModel
    exposure_s: float
    wavelength_nm: float
    seed: int
    notes: tuple[str, ...] = ()

    @property
    def saturated(self) -> int:
        """Return the number of pixels that reached the full well or the end of the ADC."""
        return saturated_pixels(self.digital, self.electrons, self.exposure_s, self.sensor)

    @property
    def warnings(self) -> tuple[str, ...]:
        if not self.saturated:
            return ()
        return (f"saturation: {self.saturated} pixels are at the full well or the ADC's end; use a shorter exposure",)

    def summary(self) -> dict[str, Any]:
        return {
            "camera": self.sensor.name,
            "shape": list(self.digital.shape),
            "exposure_s": self.exposure_s,
            "wavelength_nm": self.wavelength_nm,
            "seed": self.seed,
            "mean_dn": float(self.digital.mean()),
            "largest_dn": float(self.digital.max()),
            "saturated_pixels": self.saturated,
            "notes": list(self.notes),
            "warnings": list(self.warnings),
        }

    @takes(Drawn)
    def plot(self, ax: Axes | None = None, **figure: Any) -> Axes:
        """Draw the digital numbers with a colour bar on ``ax`` or a new figure, and return the axes."""
        title = f"{self.sensor.name}, exposure {self.exposure_s:.3g} s"
        return images.from_above("report.plots", "draw_frame")(self.digital, title, "digital number [DN]", ax, **figure)

    def __repr__(self) -> str:
        rows, columns = self.digital.shape
        return f"Sensed({rows} x {columns}: {self.sensor.name}, exposure {self.exposure_s:.3g} s)"

    @check_arguments
    def save(self, path: Path | str) -> Path:
        """Write the numbers to ``path`` and return it.

        ``.exr`` has channels DN and electrons with metadata, ``.npy`` the numbers, ``.png`` 16 bits of grey. Raises
        MitsimError
        for another ending, numbers beyond 16 bits in a PNG, or an unwritable file.
        """
        path = Path(path)
        check_ending(path, self.sensor)
        if path.suffix.lower() == ".exr":
            whole = self.digital.dtype == np.uint32
            numbers: Channel = self.digital.astype(np.uint32) if whole else self.digital.astype(np.float32)
            facts = {"exposure_s": self.exposure_s, "wavelength_nm": self.wavelength_nm, "seed": self.seed}
            channels = {"DN": numbers, "electrons": self.electrons.astype(np.float32)}
            write_frame(path, channels, {"camera": self.sensor.name, **facts, **versions()})
        else:
            images.write_numbers(
                path, self.digital.astype(np.uint16) if path.suffix.lower() == ".png" else self.digital
            )
        return path


def sense(image: FloatArray | Path | str, sensor: SensorModel, asked: Irradiance | None = None) -> Sensed:
    """Return the frame that a sensor reads under an image of irradiance.

    Parameters
    ----------
    image
        (rows, columns) mean over each (binned) pixel [W m^-2], or a file of it.
    asked
        Exposure, seed of the noise (the camera's fixed pattern has its own), and meaning of the image's numbers. A lens
        of f-number N makes the irradiance pi L / (4 N^2) of the radiance L of a distant object, on the axis.

    Raises
    ------
    MitsimError
        For values that are negative or not finite, no light although the exposure depends on it, or a camera without
        quantum efficiency.
    """
    asked, notes = asked or Irradiance(), tuple[str, ...]()
    seed, wavelength_nm, timing = asked.seed, asked.wavelength, asked.timing
    if isinstance(image, str | Path):
        image, notes = read_image(image, asked.channel)
    if sensor.mosaic is not None:
        raise MitsimError(
            f"sensor {sensor.name!r}: has a mosaic {sensor.mosaic} of colour filters, but the image has one channel; "
            "use a monochrome camera, or capture a scene with --colour mosaic"
        )
    light = np.asarray(image, dtype=np.float64) * asked.scale
    if asked.f_number is not None:
        light = light * (math.pi / (4 * asked.f_number**2))
    if light.ndim != 2 or not light.size or not (light.min() >= 0 and light.max() < np.inf):
        shown = f"the range is {light.min()} to {light.max()}" if light.size else "it is empty"
        raise MitsimError(
            f"image: its shape is {light.shape} and {shown}; give rows x columns of irradiance, finite and 0 or more"
        )
    seconds = timing.seconds
    if seconds is None:
        seconds = exposure_for_peak(float(light.max()), timing.fraction, sensor, wavelength_nm)
        shortest, longest = EXPOSURE_S
        if not shortest <= seconds <= longest:
            raise MitsimError(
                f"image: its brightest pixel, {light.max():g} W/m^2, fills the sensor in {seconds:g} s; exposures are "
                f"{shortest:g} to {longest:g} s; check the image's unit and scale"
            )
    electrons = electrons_from_irradiance(light, seconds, sensor, wavelength_nm)
    shot, read = (stream(seed, "sense", noise) for noise in ("shot", "read"))
    digital = expose(electrons, seconds, sensor, shot, read)
    return Sensed(digital, electrons, sensor, seconds, wavelength_nm, seed, notes)


def read_image(path: Path | str, channel: str | None = None) -> tuple[FloatArray, tuple[str, ...]]:
    """Return the image (rows, columns) in an OpenEXR or NPY file, and the assumptions about it.

    Without ``channel``, the only channel is read, or Y, or the luminance of R, G and B. Raises MitsimError for a file
    that is missing, damaged or of another kind, or a missing channel.
    """
    path = Path(path)
    check_image(path)
    if path.suffix.lower() == ".npy":
        if channel is not None:
            raise MitsimError(f"image {path}: an array has no channel {channel!r}; name none")
        return images.read_image(path, _IMAGE).astype(np.float64), ()
    channels = {name: values for name, values in read_frame(path)[0].items() if not name.startswith("error.")}
    if channel is None and {*_LUMINANCE} <= {*channels}:
        light = sum(weight * finite_channel(channels, name, path) for name, weight in _LUMINANCE.items())
        return np.asarray(light), ("channels R, G and B are combined to their luminance (ITU-R BT.709)",)
    name = channel or ("Y" if "Y" in channels else next(iter(channels)) if len(channels) == 1 else None)
    if name is None or name not in channels:
        asked = "several channels" if name is None else f"no channel {name!r}"
        raise MitsimError(f"image {path}: has {asked}; its channels are {', '.join(channels)}; name one by channel")
    return finite_channel(channels, name, path), ()
