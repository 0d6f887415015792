"""A lensless camera's geometry: from the numbers of a scene's sensor to its pixel grid, mask and shadow factors.

Every part that needs the camera (the renderer's sensor, the factored frames, calibration files) reads this one model,
so that a fact such as the mask distance is written once. Coordinates are index coordinates (``s_row = -y``,
``s_col = -x``) in mm, centred on the optical axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import get_args

import numpy as np
from pydantic import Field, field_validator, model_validator
from pydantic.json_schema import SkipJsonSchema

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import Configuration, validate
from mitsim.core.errors import MitsimError
from mitsim.core.files import FRAME_LIMITS, fits_a_frame
from mitsim.devices.mask import CameraMask, Mask, mls_mask
from mitsim.devices.plate import FEW, Plate, within
from mitsim.devices.projector import ProjectorModel
from mitsim.devices.sensor import SensorModel
from mitsim.devices.session import MaskMotion

_NODES_PER_PIXEL = 14
"""Nodes of a tilted mask for each pixel that its shadow is moved by: 2 more leave 4e-5 of frames of dots:7, 2 to 20
mrad at the paper's geometry."""
_MOST_TILTED_TERMS = 64
"""Separable terms that a tilted mask is formed of: 0.8 GB at 512 pixels and as many cells a side."""
_NOT_KNOWN_BEFORE = (
    "mask_offset", "mask_plate", "mask_motion", "mask_lean", "mask_fft", "mask_cells", "rows", "columns",
    "row_pitch", "roi",
)  # fmt: skip
"""Beginnings of the names of fields that calibrations of 0.4 do not know."""


class CameraGeometry(Configuration, arbitrary_types_allowed=True):
    """Bare sensor under a coded mask; the defaults are the geometry of Zheng & Asif, section IV-A."""

    pixels: int = Field(default=512, ge=1, le=16384)
    """Sensor pixels a side, of a square sensor.

    More than the largest square sensors, 10 560, of which a region is read."""
    rows: int | None = Field(default=None, ge=1, le=16384)
    """Rows of sensor pixels; none: `pixels`."""
    columns: int | None = Field(default=None, ge=1, le=16384)
    """Columns of sensor pixels; none: `pixels`."""
    pixel_pitch: float = Field(default=0.01172, ge=1e-6, le=1e3)
    """Distance between columns of sensor pixels, and between rows [mm].

    A nanometre to a metre: shadows keep at least eight digits there (tests/hard/test_hard_shadows.py)."""
    row_pitch: float | None = Field(default=None, ge=1e-6, le=1e3)
    """Distance between rows of pixels that are not square [mm]; none: `pixel_pitch`."""
    roi: tuple[int, int, int, int] | None = Field(default=None, strict=False)
    """Region of interest: its first row and column, rows and columns; none: all."""
    mask: CameraMask = "separable"
    """Mask construction; plate: what a camera file's [mask] gives."""
    mask_order: int = Field(default=9, ge=2, le=16)
    """Order of the maximum length sequence.

    The orders of :func:`mitsim.devices.mask.mls_code`: 3 to 65 535 features a side."""
    mask_feature: float = Field(default=0.06, ge=1e-6, le=1e3)
    """Mask feature size [mm].

    As pixels; lithography ends at some 10 nm, masks of telescopes at some cm."""
    mask_distance: float = Field(default=2.0, ge=1e-9, le=1e7)
    """Sensor to the mask's near face [mm].

    A picometre, in contact, to 10 km; masks of gamma-ray telescopes stand 10 m away."""
    mask_thickness: float = Field(default=0.0, ge=0, le=1e7)
    """Mask thickness [mm]; 0 is a thin mask.

    As the distance; a mask must end before the scene."""
    mask_offset_row: float = Field(default=0.0, ge=-1e7, le=1e7)
    """Mask's centre off the axis, down the rows [mm]."""
    mask_offset_column: float = Field(default=0.0, ge=-1e7, le=1e7)
    """The same along the columns [mm].

    As the distance: no mask is wider."""
    scene_distance: float = Field(default=400.0, ge=1e-6, le=1e10)
    """Sensor to the plane that the bench is aligned to [mm].

    A nanometre, for masks in contact, to 10 000 km."""
    fov: float = Field(default=20.0, ge=1e-3, lt=180)
    """Full angle of the square field stop [degrees].

    3.6 seconds of arc, the width of a star's blur, to all that a plane can see."""
    pixel_fill_factor: float = Field(default=1.0, ge=1e-4, le=1)
    """Part of a pixel that is active, in its middle and as high to wide as it; 1 is the whole pixel.

    Pixels with a counter each fill some 1e-2."""
    angular_exponent: float = Field(default=0.0, ge=0, le=1000)
    """A pixel responds as cos(theta) to this power; 0 is no angular response.

    1000 halves the response at 2 degrees, far less than any microlens."""
    mask_plate: SkipJsonSchema[Plate | None] = Field(default=None, exclude=True)
    """Mask of a camera file.

    The mask ``plate``, which no scene states."""
    mask_motion: SkipJsonSchema[MaskMotion | None] = Field(default=None, exclude=True)
    """Turn and vibration.

    What a drift adds between calibration and capture, which no scene states."""
    mask_lean_mrad: SkipJsonSchema[tuple[float, float] | None] = Field(default=None, exclude=True)
    """Tilt by a drift.

    Beside the tilt of a camera file's mask: along rows and along columns, which no scene states."""
    mask_fft: SkipJsonSchema[bool] = Field(default=False, exclude=True)
    """Frames by FFT where that is a choice."""
    mask_cells: SkipJsonSchema[int] = Field(default=0, exclude=True)
    """Raster cells along a pixel; 0: the fewest.

    What a plan chooses, which no scene states."""

    @field_validator("mask", mode="before")
    @classmethod
    def _scenes_have_few_masks(cls, kind: object) -> object:
        if kind not in get_args(CameraMask):
            raise ValueError("a scene has separable, flatcam or open; others come with --camera and its table [mask]")
        return kind

    @model_validator(mode="after")
    def _mask_lies_before_the_scene(self) -> CameraGeometry:
        if self.mask_distance + self.mask_thickness >= self.scene_distance:
            raise ValueError(
                f"mask_distance {self.mask_distance} mm plus mask_thickness {self.mask_thickness} mm must be less than "
                f"scene_distance {self.scene_distance} mm"
            )
        return self

    @model_validator(mode="after")
    def _the_region_lies_on_the_sensor(self) -> CameraGeometry:
        if self.roi is not None:
            ends = [first + size for first, size in zip(self.roi[:2], self.roi[2:], strict=True)]
            if min(self.roi[:2]) < 0 or min(self.roi[2:]) < 1 or ends[0] > self.shape[0] or ends[1] > self.shape[1]:
                raise ValueError(
                    f"roi {list(self.roi)}: {self.roi[2]} rows from {self.roi[0]} and {self.roi[3]} columns from "
                    f"{self.roi[1]} are not on a sensor of {self.shape[0]} x {self.shape[1]} pixels"
                )
        return self

    @model_validator(mode="after")
    def _its_frames_can_be_read(self) -> CameraGeometry:
        rows, columns = self.frame_shape
        if not fits_a_frame(self.frame_shape):
            raise ValueError(f"{rows} x {columns} pixels; {FRAME_LIMITS} are written and read, so read a part by roi")
        return self

    @model_validator(mode="after")
    def _a_plate_is_there(self) -> CameraGeometry:
        if (self.mask == "plate") != (self.mask_plate is not None):
            raise ValueError("mask: got 'plate'; use separable, flatcam or open, or --camera with a table [mask]")
        if self.mask_plate is not None and self.mask_thickness and not self.mask_plate.may_be_thick:
            raise ValueError(
                f"mask_thickness: got {self.mask_thickness:g} mm; a mask of more than {FEW} separable terms, or one "
                f"that is blurred, dusty, turned or tilted ({self.mask_plate.words}), is thin, so set 0"
            )
        if self.pitches[0] != self.pitches[1] and self.is_drawn(waves=True):
            raise ValueError(
                f"row_pitch: got {self.pitches[0]:g} beside pixel_pitch {self.pitches[1]:g}; behind {self.mask_words} "
                "pixels must be square; give equal ones, or a mask of one or two separable terms that is not turned"
            )
        return self

    @classmethod
    def build(cls, where: str, **values: object) -> CameraGeometry:
        """Build from loose ``values``; a bad one raises MitsimError with one line that begins with ``where``."""
        return validate(cls, values, where)

    @property
    def identity(self) -> dict[str, object]:
        """What manifests say of it: all fields, but for those that calibrations of 0.4 do not know, where they are 0 or
        none."""
        known = {name: value for name, value in self if value or not name.startswith(_NOT_KNOWN_BEFORE)}
        if self.mask_motion is not None:
            known["mask_motion"] = self.mask_motion.model_dump()
        return known if self.mask_plate is None else {**known, "mask_plate": self.mask_plate.identity}

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the whole sensor."""
        return self.rows or self.pixels, self.columns or self.pixels

    @property
    def pitches(self) -> tuple[float, float]:
        """Distances between rows, and between columns [mm]."""
        return self.row_pitch or self.pixel_pitch, self.pixel_pitch

    @property
    def frame_shape(self) -> tuple[int, int]:
        """Rows and columns of a frame: of the region of interest."""
        return self.shape if self.roi is None else self.roi[2:]

    @property
    def axes_alike(self) -> bool:
        """Whether a frame's columns lie as its rows do: of square pixels, as many and as far off the axis."""
        return self.pitches[0] == self.pitches[1] and np.array_equal(self.centres(0), self.centres(1))

    @property
    def frame_side(self) -> float:
        """Pixels a side of a square with as many as a frame; a whole number for square frames."""
        return side_of(self.frame_shape)

    @property
    def half_width(self) -> float:
        """Half the sensor's longer side [mm]: light is followed to the square of that side."""
        return max(self.half_sides)

    @property
    def half_sides(self) -> tuple[float, float]:
        """Half the sensor's height, along rows' numbers, and half its width [mm]."""
        (rows, columns), (row, column) = self.shape, self.pitches
        return rows * row / 2, columns * column / 2

    @property
    def tan_half_fov(self) -> float:
        """Largest |x/z| and |y/z| of a ray that passes the field stop."""
        return math.tan(math.radians(self.fov) / 2)

    def reach(self, depth: float) -> float:
        """Largest tan-angle, from the sensor's centre, of what its edge sees at ``depth`` [mm]."""
        return self.tan_half_fov + self.half_width / depth

    @property
    def pixel_edges(self) -> FloatArray:
        """(pixels + 1,) edges of pixels along the sensor's longer side [mm]."""
        return centred_edges(*max(zip(self.shape, self.pitches, strict=True), key=math.prod))

    @property
    def pixel_centres(self) -> FloatArray:
        """(pixels,) centres along the sensor's longer side [mm]."""
        edges = self.pixel_edges
        return np.asarray((edges[:-1] + edges[1:]) / 2)

    def centres(self, axis: int) -> FloatArray:
        """(m,) centres of a frame's rows (``axis`` 0) or columns (1) [mm]."""
        edges = centred_edges(self.shape[axis], self.pitches[axis])
        centres = np.asarray((edges[:-1] + edges[1:]) / 2)
        return centres if self.roi is None else centres[self.roi[axis] : self.roi[axis] + self.roi[axis + 2]]

    @property
    def mask_offset(self) -> tuple[float, float]:
        """Mask coordinates (row, column) of the mask's centre [mm]; (0, 0) on the axis."""
        return self.mask_offset_row, self.mask_offset_column

    def build_mask(self) -> Mask | Plate:
        """The mask that these numbers describe, in coordinates of its own centre; of a plate what can be seen."""
        if self.mask != "plate":
            return mls_mask(self.mask, self.mask_feature, self.mask_order)
        if self.mask_plate is None:
            raise MitsimError("mask: got 'plate' without one; give a camera file with a table [mask]")
        return within(self.mask_plate, self.mask_reach)

    @property
    def mask_reach(self) -> float:
        """How far from its centre a mask is seen [mm]."""
        seen = self.half_width + (self.mask_distance + self.mask_thickness) * self.tan_half_fov
        leaning = 1 + self.tan_half_fov * sum(map(abs, self.mask_tilt))
        return (seen + max(self.pitches) + max(map(abs, self.mask_offset))) * leaning

    @property
    def centred(self) -> bool:
        """Whether a separable solver takes row and column means off this camera's frames, as for a FlatCam mask."""
        mask = self.build_mask()
        return mask.centred if isinstance(mask, Plate) else mask.kind == "flatcam"

    @property
    def diffracts(self) -> bool:
        """Whether diffraction at the mask is simulated."""
        mask = self.build_mask()
        return not isinstance(mask, Plate) or mask.diffracts

    @property
    def mask_tilt(self) -> tuple[float, float]:
        """How the mask's distance grows along rows and along columns, tangents; (0, 0) for a mask that is even."""
        made = self.mask_plate.flaws.tilt_mrad if self.mask_plate else (0.0, 0.0)
        lean = self.mask_lean_mrad or (0.0, 0.0)
        return math.tan((made[0] + lean[0]) * 1e-3), math.tan((made[1] + lean[1]) * 1e-3)

    @property
    def tilt_shift_mm(self) -> float:
        """How far a tilt of the mask moves shadows at most, on the mask [mm]: a ray of slope t that leaves the even
        plane at s meets the tilted one t s tan(tilt) beside."""
        return self.tan_half_fov * self.mask_reach * sum(map(abs, self.mask_tilt))

    def tilt_nodes(self, waves: bool) -> tuple[int, int] | None:
        """Nodes of rows and of columns from which the shadow of a tilted mask is formed (:mod:`mitsim.optics.terms`),
        with ``waves`` or without; None where it is not: of an even mask, one that is drawn on a raster, and one that
        would take too many terms."""
        if not any(self.mask_tilt) or self.is_drawn(waves):
            return None
        farthest = self.tan_half_fov * self.mask_reach / min(self.pitches)
        by_column, by_row = (
            1 if not growth else 2 + math.ceil(_NODES_PER_PIXEL * farthest * abs(growth))
            for growth in self.mask_tilt[::-1]
        )
        many = by_column * by_row * len(self.build_mask().terms) > _MOST_TILTED_TERMS
        return None if many else (by_column, by_row)

    def tilt_left_out(self, waves: bool) -> bool:
        """Whether the mask is tilted, and its shadow, with ``waves`` or without, that of an even one."""
        return any(self.mask_tilt) and self.tilt_nodes(waves) is None

    @property
    def mask_words(self) -> str:
        """The mask in words."""
        return (
            self.mask_plate.words
            if self.mask == "plate" and self.mask_plate
            else f"{self.mask}, order {self.mask_order}"
        )

    @property
    def mask_terms(self) -> int:
        """Separable terms of the mask as it is mounted, 1 where it has no closed form."""
        if self.is_drawn(waves=False):
            return 1
        return len(self.build_mask().terms) * math.prod(self.tilt_nodes(waves=False) or (1,))

    def is_correlated(self, waves: bool) -> bool:
        """Whether frames behind the mask, with ``waves`` or without, are correlations with a shadow that is drawn,
        as it must be or as was chosen."""
        return self.is_drawn(waves) or (self.mask_fft and self.may_be_drawn(waves))

    def may_be_drawn(self, waves: bool) -> bool:
        """Whether frames behind the mask, with ``waves`` or without, may as well be sums of terms as correlations with
        a shadow on a raster: of a plate of more than two terms that is mounted straight, and at rest, over square
        pixels."""
        mask = self.build_mask()
        still = self.mask_motion is None and not any(self.mask_tilt) and self.pitches[0] == self.pitches[1]
        return isinstance(mask, Plate) and still and not (waves or self.is_drawn(waves)) and mask.crosses is None

    def is_drawn(self, waves: bool) -> bool:
        """Whether the mask's shadow, with ``waves`` or without, is drawn on a raster because it has no short closed
        form: of what is turned, of a picture of light, of more than a thousand terms, and of the waves behind many
        terms."""
        mask = self.build_mask()
        if not isinstance(mask, Plate):
            return False
        turned = bool(mask.flaws.turn_deg)
        return mask.irradiance or turned or mask.many or (waves and mask.amplitude.crosses is None)

    @property
    def few_wave_terms(self) -> bool:
        """Whether waves behind the mask are a sum of few separable terms: of a mask of one or two that is mounted
        straight, and at rest."""
        return self.diffracts and not self.is_drawn(waves=True) and not any(self.mask_tilt) and self.mask_motion is None

    def fresnel_number(self, wavelength_nm: float) -> float:
        """a^2 / (lambda d) of one mask feature at ``wavelength_nm``: well above 1, a geometric shadow is good."""
        return self.mask_feature**2 / (wavelength_nm * 1e-6 * self.mask_distance)

    @property
    def wall_shift_features(self) -> float:
        """Largest shift between a mask's two faces along a ray that passes the field stop, in features.

        The two-face model of a thick mask needs it below 1: beyond, a ray may cross a wall between the faces.
        """
        return self.mask_thickness * self.tan_half_fov / self.mask_feature

    @property
    def active_sides(self) -> tuple[float, float]:
        """A pixel's active part, along rows' and columns' numbers [mm]: a square in a square pixel."""
        row, column = self.pitches
        return row * math.sqrt(self.pixel_fill_factor), column * math.sqrt(self.pixel_fill_factor)

    def angular_response(self, squared_tan: FloatArray) -> FloatArray:
        """A pixel's response, relative to normal incidence, to rays of ``squared_tan``, tan^2(theta): cos^n(theta)."""
        return np.asarray((1 + squared_tan) ** (-self.angular_exponent / 2))


def side_of(shape: tuple[int, int]) -> float:
    """Pixels a side of a square with as many as a frame of ``shape``; a whole number for square frames."""
    return shape[0] if shape[0] == shape[1] else math.sqrt(shape[0] * shape[1])


def centred_edges(count: int, pitch: float) -> FloatArray:
    """(count + 1,) edges of ``count`` equal cells centred on zero, in the unit of ``pitch``; MitsimError for none."""
    if count < 1 or not (np.isfinite(pitch) and pitch > 0):
        raise MitsimError(f"a grid of {count} cells of size {pitch} is empty; give at least 1 cell and a size above 0")
    return np.asarray((np.arange(count + 1, dtype=np.float64) - count / 2) * pitch)


# -------- The devices of a bench, as pure data


@dataclass(frozen=True)
class Devices:
    """Camera and projector.

    Attributes
    ----------
    camera
        sensor and mask in space, as the scene states them.
    sensor
        the camera's electronics.
    projector
        light and lens of the projector.
    camera_file
        where the electronics stand, for messages.
    """

    camera: CameraGeometry
    sensor: SensorModel
    projector: ProjectorModel
    camera_file: str
