"""A FlatCam's raw captures and its authors' images of them in; frames, their noise and the mask's codes out.

Captures become frames as `mitsim import --list flatcam` makes them (:mod:`mitsim.core.prepare`); codes are learned as
`mitsim calibrate --known` learns them (:mod:`mitsim.reconstruct.shifted_codes`), with one code a side. Noise is that of
a capture's own fine structure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy import ndimage

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import read_toml, shipped_path, validate
from mitsim.core.errors import MitsimError
from mitsim.core.imagelist import BGGR, PLANES, Preparation, Wanted, planes_of
from mitsim.core.images import Numbers, read_image
from mitsim.core.manifests import Digital
from mitsim.core.prepare import CommonFactor, Preparer
from mitsim.core.seeds import stream
from mitsim.devices.sensor import SensorModel
from mitsim.reconstruct.shifted_codes import Codes, Exposure, Pose, Shape, find_pose, fit_codes, plane_offsets
from mitsim.reconstruct.solver import centre_frame
from mitsim.sensor.chain import expose

_RAW = 1024, 1280
"""Rows and columns of a capture."""
PITCH_MM = 0.0106
"""Of a plane's pixels, twice 5.3 um: the sensors of 1024 x 1280 pixels in use then have it. Frames do not depend on
it."""
EXPOSURE_S = 0.01
"""Any: frames before noise are compared, and scaled."""
_BLOCK = 48
"""Side of the blocks whose noise and mean are compared [pixels]: light varies by some per cent within."""
_SMOOTH = 31
"""Side of the square that gives a pixel's mean light [pixels], far more than the mask's features."""


@dataclass(frozen=True, eq=False)
class Measured:
    """One plane of a capture.

    Attributes
    ----------
    capture, plane
        names of both.
    offset
        of the plane's pixels, down and to the right [pixels].
    level
        (m, m') the plane, turned and cut [DN].
    noise
        (m, m') drawn as the plane's is, turned and cut, row and column means off [DN].
    scene
        (n, n') authors' image of it, 0 to 1.
    gain, read_variance
        DN an electron, and noise without light [DN^2], of the raw plane.
    """

    capture: str
    plane: str
    offset: tuple[float, float]
    level: FloatArray
    noise: FloatArray
    scene: FloatArray
    gain: float
    read_variance: float

    @property
    def name(self) -> str:
        """Of the frame."""
        return f"{self.capture} {self.plane}"

    @cached_property
    def frame(self) -> FloatArray:
        """(m, m') the plane without row and column means [DN]."""
        return centre_frame(self.level)

    def exposure(self, frame: FloatArray | None = None, group: int = 0) -> Exposure:
        """What a fit of codes takes: the frame, or another ``frame`` of the plane; ``group``: the picture's number."""
        return Exposure(self.scene, self.frame if frame is None else frame, group, self.plane, self.offset)


@dataclass(frozen=True)
class Recipe:
    """What `calibration/flatcam.toml` says: ``how`` files become frames, what their numbers are (``digital``), of how
    many ``bits``, and ``n`` scene pixels a side."""

    how: Preparation
    digital: Digital
    bits: int
    n: int

    @classmethod
    def load(cls) -> Recipe:
        """As it ships."""
        path = shipped_path("calibration", "flatcam.toml")
        listed = read_toml(path)
        how = validate(Preparation, listed["prepare"], f"list {path}")
        return cls(how, validate(Digital, listed["digital"], f"list {path}"), listed["bits"], listed["n"])

    def planes(self, path: Path) -> dict[str, FloatArray]:
        """Planes of the capture ``path``, whole, as the sensor has them [DN]; MitsimError where it is no capture."""
        numbers = read_image(path, Wanted("capture", mosaic=self.how.mosaic))
        if numbers.shape != _RAW:
            raise MitsimError(f"capture {path}: is {_size(numbers)}; give the raw frame, {_RAW[0]} x {_RAW[1]}")
        factor, largest = self._shift(numbers), 2**self.bits - 1
        if not 0 <= numbers.min() < numbers.max() <= factor * largest:
            raise MitsimError(
                f"capture {path}: holds {numbers.min():g} to {numbers.max():g}, no light in numbers of {self.bits} "
                "bits; give the raw frame"
            )
        places = planes_of(self.how.mosaic or BGGR)
        return {name: np.asarray(numbers[places[name][0] :: 2, places[name][1] :: 2] / factor) for name in PLANES}

    def _shift(self, numbers: Numbers) -> int:
        common = CommonFactor()
        common.add(numbers)
        return common.shift(2**self.bits - 1)

    def place(self, plane: FloatArray) -> FloatArray:
        """A whole ``plane``, or noise alone, turned and cut as a frame."""
        how = self.how.model_copy(update={"channel": None, "mosaic": None, "divide_by": 1})
        return Preparer.of(how, self.digital, Wanted()).frame(Path(), plane).astype(np.float64)

    def scene(self, path: Path) -> FloatArray:
        """(n, n, 3) authors' image in the file ``path``, 0 to 1."""
        image = read_image(path, Wanted("image", bits=(8,), colour=True))
        if image.shape != (self.n, self.n, 3):
            raise MitsimError(
                f"image {path}: is {_size(image)}; give the authors', {self.n} x {self.n} of red, green and blue"
            )
        return np.asarray(image / 255, dtype=np.float64)


def _size(values: Numbers) -> str:
    return " x ".join(map(str, values.shape))


def read_captures(files: Mapping[str, tuple[Path, Path]], seed: int) -> list[Measured]:
    """Every plane of all captures.

    Parameters
    ----------
    files
        raw frame and its authors' image, by the capture's name.
    seed
        of their drawn noise.

    Raises
    ------
    MitsimError
        for files that are no such captures.
    """
    recipe, found = Recipe.load(), []
    raw = {name: recipe.planes(frame) for name, (frame, _) in files.items()}
    offsets = plane_offsets(recipe.how)
    scenes = {name: recipe.scene(image) for name, (_, image) in files.items()}
    for plane in PLANES:
        gain, dark = noise_of([planes[plane] for planes in raw.values()])
        for name, planes in raw.items():
            noise = recipe.place(draw_noise(planes[plane], gain, dark, seed, f"{name} {plane}"))
            scene, level = scenes[name][..., "rgb".index(plane[0])], recipe.place(planes[plane])
            found.append(Measured(name, plane, offsets[plane], level, centre_frame(noise), scene, gain, dark))
    return found


def noise_of(planes: Sequence[FloatArray]) -> tuple[float, float]:
    """Gain [DN an electron] and variance without light [DN^2], from the ``planes`` of several captures themselves.

    Second differences along both axes leave nothing of the light: between the two green planes of a capture, which see
    it half a pixel apart, they correlate by less than 0.01. Their mean squares in blocks are a line over the means.
    """
    means, squares = [], []
    for plane in planes:
        fine = np.square(np.diff(np.diff(plane, 2, 0), 2, 1)) / 36
        light = plane[1:-1, 1:-1]
        for row in range(0, light.shape[0] - _BLOCK, _BLOCK):
            for column in range(0, light.shape[1] - _BLOCK, _BLOCK):
                block = np.s_[row : row + _BLOCK, column : column + _BLOCK]
                means.append(light[block].mean())
                squares.append(fine[block].mean())
    light, variance = np.array(means), np.array(squares)
    gain, dark = np.polyfit(light, variance, 1)
    if dark < 0 or gain <= 0:  # no dark light is seen: all noise is that of photons
        gain, dark = float(light @ variance / (light @ light)), 0.0
    return float(gain), float(dark)


def draw_noise(plane: FloatArray, gain: float, read_variance: float, seed: int, name: str) -> FloatArray:
    """(rows, columns) noise [DN] of a simulated sensor in the light of a plane.

    Parameters
    ----------
    plane
        (rows, columns) as the sensor has it [DN].
    gain, read_variance
        as :func:`noise_of`.
    seed, name
        of the draw.
    """
    sensor = SensorModel(
        name="twin", pixel_pitch_um=PITCH_MM * 1e3, full_well_e=float("inf"), gain_dn_per_e=gain,
        read_noise_e=float(np.sqrt(read_variance)) / gain, source="mitsim study twin",
    )  # fmt: skip
    light = np.maximum(ndimage.uniform_filter(plane, _SMOOTH), 0)
    shot, read = (stream(seed, "twin", kind, name) for kind in ("shot", "read"))
    return np.asarray(expose(light / gain, EXPOSURE_S, sensor, shot, read) - light, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Learned:
    """Codes of a mask, and how pictures lie before it (``pose``)."""

    pose: Pose
    codes: Codes

    @classmethod
    def of(cls, planes: Sequence[Measured]) -> Learned:
        """From ``planes`` of known scenes."""
        names = list(dict.fromkeys(each.capture for each in planes))
        exposures = [each.exposure(group=names.index(each.capture)) for each in planes]
        pose = find_pose(exposures)
        turned = [each.turn_scene(pose.orientation) for each in exposures]
        return cls(pose, fit_codes(turned, Shape(pose.scales, 1, True)))

    def see(self, measured: Measured) -> Measured:
        """The ``measured`` plane with its scene as it lies before the mask."""
        return replace(measured, scene=measured.exposure().turn_scene(self.pose.orientation).scene)
