"""Geometry of a lensless camera: pixel grid, mask and shadow factors from the numbers of a scene's sensor.

Coordinates are index coordinates (``s_row = -y``, ``s_col = -x``) in mm, centred on the optical axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast, get_args

import numpy as np
from pydantic import Field, field_validator, model_validator
from pydantic.json_schema import SkipJsonSchema

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import Configuration, validate
from mitsim.core.files import FRAME_LIMITS, fits_a_frame
from mitsim.devices.mask import FEW, NO_FLAWS, CameraMask, Mask, MaskKind, Plate, mls_mask, within
from mitsim.devices.projector import ProjectorModel
from mitsim.devices.sensor import SensorModel
from mitsim.devices.session import MaskMotion

_NODES_PER_PIXEL = 14
"""Nodes of a tilted mask for each pixel by which its shadow moves: two more change frames of dots:7 by 4e-5."""
_MOST_TILTED_TERMS = 64
_NOT_KNOWN_BEFORE = (
    "mask_offset", "mask_plate", "mask_motion", "mask_lean", "mask_fft", "mask_cells", "rows", "columns",
    "row_pitch", "roi",
)  # fmt: skip
"""Beginnings of the names of fields that calibrations of 0.4 lack."""


PIXELS = 1, 16384
"""Sensor pixels a side: more than the largest square sensors have, 10 560, of which a region is read."""


class CameraGeometry(Configuration, arbitrary_types_allowed=True):
    """Bare sensor under a coded mask; the defaults are the geometry of Zheng & Asif, section IV-A."""

    pixels: int = Field(default=512, ge=PIXELS[0], le=PIXELS[1])
    """Sensor pixels a side, of a square sensor."""
    rows: int | None = Field(default=None, ge=PIXELS[0], le=PIXELS[1])
    """Rows of sensor pixels; none: `pixels`."""
    columns: int | None = Field(default=None, ge=PIXELS[0], le=PIXELS[1])
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
    def _parts_fit_together(self) -> CameraGeometry:
        if self.mask_distance + self.mask_thickness >= self.scene_distance:
            ends = f"mask_distance {self.mask_distance} mm plus mask_thickness {self.mask_thickness} mm"
            raise ValueError(f"{ends} must be less than scene_distance {self.scene_distance} mm")
        if self.roi is not None:
            row, column, rows, columns = self.roi
            all_rows, all_columns = self.shape
            inside = row + rows <= all_rows and column + columns <= all_columns
            if min(row, column) < 0 or min(rows, columns) < 1 or not inside:
                part = f"roi {list(self.roi)}: {rows} rows from {row} and {columns} columns from {column}"
                raise ValueError(f"{part} are not on a sensor of {all_rows} x {all_columns} pixels")
        rows, columns = self.frame_shape
        if not fits_a_frame(self.frame_shape):
            raise ValueError(f"{rows} x {columns} pixels; {FRAME_LIMITS} are written and read, so read a part by roi")
        plate = self.mask_plate
        if (self.mask == "plate") != (plate is not None):
            raise ValueError("mask: got 'plate'; use separable, flatcam or open, or --camera with a table [mask]")
        if plate is not None and self.mask_thickness and not (plate.crosses is not None and plate.flaws == NO_FLAWS):
            drawn = f"blurred, dusty, turned or tilted ({plate.words})"
            problem = f"mask_thickness: got {self.mask_thickness:g} mm; a mask of more than {FEW} separable terms"
            raise ValueError(f"{problem}, or one that is {drawn}, is thin, so set 0")
        if self.pitches[0] != self.pitches[1] and self.is_drawn(waves=True):
            got = f"row_pitch: got {self.pitches[0]:g} beside pixel_pitch {self.pitches[1]:g}; behind {self.mask_words}"
            remedy = "give equal ones, or a mask of one or two separable terms that is not turned"
            raise ValueError(f"{got} pixels must be square; {remedy}")
        return self

    @classmethod
    def build(cls, where: str, **values: object) -> CameraGeometry:
        """Return the geometry of loose ``values``; a MitsimError of one line begins with ``where``."""
        return validate(cls, values, where)

    @property
    def identity(self) -> dict[str, object]:
        """Return all fields for manifests but those that are unset and unknown to calibrations of 0.4."""
        known = {name: value for name, value in self if value or not name.startswith(_NOT_KNOWN_BEFORE)}
        if self.mask_motion is not None:
            known["mask_motion"] = self.mask_motion.model_dump()
        return known if self.mask_plate is None else {**known, "mask_plate": self.mask_plate.identity}

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows or self.pixels, self.columns or self.pixels

    @property
    def pitches(self) -> tuple[float, float]:
        return self.row_pitch or self.pixel_pitch, self.pixel_pitch

    @property
    def frame_shape(self) -> tuple[int, int]:
        return self.shape if self.roi is None else self.roi[2:]

    @property
    def axes_alike(self) -> bool:
        return self.pitches[0] == self.pitches[1] and np.array_equal(self.centres(0), self.centres(1))

    @property
    def frame_side(self) -> float:
        return side_of(self.frame_shape)

    @property
    def half_width(self) -> float:
        return max(self.half_sides)

    @property
    def half_sides(self) -> tuple[float, float]:
        (rows, columns), (row, column) = self.shape, self.pitches
        return rows * row / 2, columns * column / 2

    @property
    def tan_half_fov(self) -> float:
        """Return the largest |x/z| and |y/z| of a ray that passes the field stop."""
        return math.tan(math.radians(self.fov) / 2)

    def reach(self, depth: float) -> float:
        return self.tan_half_fov + self.half_width / depth

    @property
    def pixel_edges(self) -> FloatArray:
        return centred_edges(*max(zip(self.shape, self.pitches, strict=True), key=math.prod))

    def centres(self, axis: int) -> FloatArray:
        edges = centred_edges(self.shape[axis], self.pitches[axis])
        centres = np.asarray((edges[:-1] + edges[1:]) / 2)
        return centres if self.roi is None else centres[self.roi[axis] : self.roi[axis] + self.roi[axis + 2]]

    @property
    def mask_offset(self) -> tuple[float, float]:
        return self.mask_offset_row, self.mask_offset_column

    def build_mask(self) -> Mask | Plate:
        if self.mask_plate is not None:
            return within(self.mask_plate, self.mask_reach)
        return mls_mask(cast("MaskKind", self.mask), self.mask_feature, self.mask_order)

    @property
    def mask_reach(self) -> float:
        seen = self.half_width + (self.mask_distance + self.mask_thickness) * self.tan_half_fov
        leaning = 1 + self.tan_half_fov * sum(map(abs, self.mask_tilt))
        return (seen + max(self.pitches) + max(map(abs, self.mask_offset))) * leaning

    @property
    def centred(self) -> bool:
        return self.build_mask().centred

    @property
    def diffracts(self) -> bool:
        return self.build_mask().diffracts

    @property
    def mask_tilt(self) -> tuple[float, float]:
        made = self.mask_plate.flaws.tilt_mrad if self.mask_plate else (0.0, 0.0)
        lean = self.mask_lean_mrad or (0.0, 0.0)
        return math.tan((made[0] + lean[0]) * 1e-3), math.tan((made[1] + lean[1]) * 1e-3)

    @property
    def tilt_shift_mm(self) -> float:
        return self.tan_half_fov * self.mask_reach * sum(map(abs, self.mask_tilt))

    def tilt_nodes(self, waves: bool) -> tuple[int, int] | None:
        """Return the nodes of rows and columns for the terms of a tilted mask; None where none are used."""
        if not any(self.mask_tilt) or self.is_drawn(waves):
            return None
        farthest = self.tan_half_fov * self.mask_reach / min(self.pitches)
        tilts = self.mask_tilt[::-1]
        by_column, by_row = (2 + math.ceil(_NODES_PER_PIXEL * farthest * abs(t)) if t else 1 for t in tilts)
        many = by_column * by_row * len(self.build_mask().terms) > _MOST_TILTED_TERMS
        return None if many else (by_column, by_row)

    def tilt_left_out(self, waves: bool) -> bool:
        return any(self.mask_tilt) and self.tilt_nodes(waves) is None

    @property
    def mask_words(self) -> str:
        return self.mask_plate.words if self.mask_plate else f"{self.mask}, order {self.mask_order}"

    @property
    def mask_terms(self) -> int:
        if self.is_drawn(waves=False):
            return 1
        return len(self.build_mask().terms) * math.prod(self.tilt_nodes(waves=False) or (1,))

    def is_correlated(self, waves: bool) -> bool:
        return self.is_drawn(waves) or (self.mask_fft and self.may_be_drawn(waves))

    def may_be_drawn(self, waves: bool) -> bool:
        mask = self.build_mask()
        still = self.mask_motion is None and not any(self.mask_tilt) and self.pitches[0] == self.pitches[1]
        return still and not (waves or self.is_drawn(waves)) and mask.crosses is None

    def is_drawn(self, waves: bool) -> bool:
        """Return True if the shadow is drawn on a raster, because it has no short closed form."""
        mask = self.build_mask()
        turned = bool(mask.flaws.turn_deg)
        return mask.irradiance or turned or mask.many or (waves and mask.amplitude.crosses is None)

    @property
    def few_wave_terms(self) -> bool:
        return self.diffracts and not self.is_drawn(waves=True) and not any(self.mask_tilt) and self.mask_motion is None

    @property
    def wall_shift_features(self) -> float:
        """Return the largest shift between a mask's two faces along a ray, in features.

        The two-face model needs less than 1, because a ray may then not cross a wall between the faces.
        """
        return self.mask_thickness * self.tan_half_fov / self.mask_feature

    @property
    def active_sides(self) -> tuple[float, float]:
        root = math.sqrt(self.pixel_fill_factor)
        return self.pitches[0] * root, self.pitches[1] * root

    def angular_response(self, squared_tan: FloatArray) -> FloatArray:
        return np.asarray((1 + squared_tan) ** (-self.angular_exponent / 2))


def side_of(shape: tuple[int, int]) -> float:
    return shape[0] if shape[0] == shape[1] else math.sqrt(shape[0] * shape[1])


def centred_edges(count: int, pitch: float) -> FloatArray:
    return np.asarray((np.arange(count + 1, dtype=np.float64) - count / 2) * pitch)


# -------- The devices of a bench, as pure data


@dataclass(frozen=True)
class Devices:
    """Camera, electronics ``sensor`` of ``camera_file``, and projector."""

    camera: CameraGeometry
    sensor: SensorModel
    projector: ProjectorModel
    camera_file: str
