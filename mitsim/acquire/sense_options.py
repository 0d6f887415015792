"""What `mitsim sense` takes: files, a lens and a wavelength in; a refusal out, before numpy is imported."""

from __future__ import annotations

import math
from pathlib import Path

from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.files import check_plain
from mitsim.devices.sensor import SensorModel

IMAGES, ENDINGS = (".exr", ".npy"), (".png", ".exr", ".npy")
"""Files that an image is read from, and digital numbers are written to."""
_LARGEST_PNG = 2**16 - 1
"""What 16 bits of grey hold."""
_WAVELENGTHS_NM = 1.0, 1e6
"""As a projector's."""


def check_image(path: Path) -> None:
    """MitsimError for a ``path`` that no image is read from."""
    if path.suffix.lower() not in IMAGES:
        raise MitsimError(f"image {path}: give an OpenEXR (.exr) or NumPy (.npy) file")
    check_plain(path, "image")


def check_wavelength(wavelength_nm: float) -> None:
    """ArgumentError for light of a ``wavelength_nm`` [nm] that there is not."""
    low, high = _WAVELENGTHS_NM
    if not low <= wavelength_nm <= high:
        raise ArgumentError("wavelength", f"{wavelength_nm:g}: give {low:g} to {high:g} nm")


def check_f_number(f_number: float) -> None:
    """ArgumentError for an ``f_number`` that no lens has."""
    if not 0.5 <= f_number < math.inf:
        raise ArgumentError("f_number", f"{f_number:g}: no lens in air is below 0.5; give its f-number")


def check_ending(path: Path, sensor: SensorModel) -> None:
    """MitsimError for a ``path`` that no frame is written to, or whose kind cannot hold a ``sensor``'s numbers."""
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise MitsimError(f"output {path}: give a name that ends in {', '.join(ENDINGS)}")
    if ending == ".png" and (sensor.largest_dn is None or sensor.largest_dn > _LARGEST_PNG):
        numbers = "real numbers" if sensor.largest_dn is None else f"numbers up to {sensor.largest_dn}"
        raise MitsimError(
            f"output {path}: sensor {sensor.name!r} gives {numbers}, 16 bits end at {_LARGEST_PNG}; use .exr"
        )
