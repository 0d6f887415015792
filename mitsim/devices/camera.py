"""Geometry of a lensless camera: pixel grid and mask, from a scene's sensor and a camera file's table ``[mask]``.

Coordinates are index coordinates (``s_row = -y``, ``s_col = -x``) in mm, centred on the optical axis.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, cast, get_args

import numpy as np
from pydantic import Field, field_validator, model_validator
from pydantic.json_schema import SkipJsonSchema

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import Configuration, read_toml, validate
from mitsim.core.errors import MitsimError
from mitsim.core.files import FRAME_LIMITS, fits_a_frame
from mitsim.core.images import image_pages, own_end, read_image, reduce_frame
from mitsim.core.job import Cost, Limits
from mitsim.core.picture_files import BGGR, PLANES, RGB, Wanted, planes_of
from mitsim.core.seeds import stream
from mitsim.devices.mask import FEW, LARGEST, NO_FLAWS, CameraMask, Flaws, Mask, MaskKind, Plate, mls_mask, within
from mitsim.devices.patterns import is_prime
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


_MASKS_OF_SCENES = "a scene has separable, flatcam or open; a camera file with a table [mask] gives other masks"

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
    """Kind of mask; plate: the mask of a camera file's table [mask], given feature by feature."""
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
            like = f" --like {kind}" if kind in KINDS else ""
            raise ValueError(f"{_MASKS_OF_SCENES}: `mitsim new mask NAME{like}` writes one")
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
            raise ValueError(f"mask: got 'plate'; {_MASKS_OF_SCENES}")
        if plate is not None and self.mask_thickness and not (plate.crosses is not None and plate.flaws == NO_FLAWS):
            drawn = f"blurred, dusty, turned or tilted ({plate.words})"
            problem = f"mask_thickness: got {self.mask_thickness:g} mm; a mask of more than {FEW} separable terms"
            raise ValueError(f"{problem}, or one that is {drawn}, is thin, so set 0")
        if self.pitches[0] != self.pitches[1] and self.is_drawn(waves=True):
            got = f"row_pitch: got {self.pitches[0]:g} beside pixel_pitch {self.pitches[1]:g}; behind {self.mask_words}"
            remedy = "give equal ones, or a mask of one or two separable terms that is not turned"
            raise ValueError(f"{got} pixels must be square; {remedy}")
        return self

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


# -------- A camera file's table ``[mask]``

KINDS: Mapping[str, str] = MappingProxyType({
    "separable": "a maximum length sequence times itself, a quarter of it open",
    "flatcam": "the same in two terms, as a FlatCam has it, half of it open",
    "open": "an aperture of the same size, all of it open",
    "mura": "one period of a modified uniformly redundant array (Gottesman and Fenimore, Appl. Opt. 28, 4344, 1989)",
    "random": "every feature open or closed by a draw of its own: frames, and no two factors that solve an image",
    "drawing": "a picture or array of transmissions, a feature each; calibrated where it is next to separable",
    "psf": "a phase mask by its point spread function, measured or rendered",
})  # fmt: skip
"""What each kind of mask is."""
_OWN = {
    **dict.fromkeys(get_args(MaskKind), "order"),
    "mura": "features!",
    "random": "features! open_part seed",
    "drawing": "file!",
    "psf": "file! psf_distance_mm! aperture_mm2! psf_reduce",
}
"""Fields that each kind has beside its name and the feature size; those with ! are required."""
_FLAWS = {
    *("edge_blur_um", "opaque_transmission", "clear_transmission", "rotation_deg", "tilt_row_mrad", "tilt_column_mrad")
}
"""The fields that every kind has."""


class MaskProfile(Configuration):
    """Material, flaws and distance of a mask; the scene states its offsets."""

    kind: Literal["separable", "flatcam", "open", "mura", "random", "drawing", "psf"]
    """Kind of mask; `mitsim list masks` describes each."""
    feature_mm: float = Field(ge=1e-6, le=1e3)
    """Side of a feature, or of a picture's pixel [mm].

    As a scene's ``mask_feature``."""
    distance_mm: float | None = Field(default=None, ge=1e-9, le=1e7)
    """Distance from the sensor to the mask's near face [mm]; none: the scene's `mask_distance`.

    As a scene's ``mask_distance``."""
    order: int = Field(default=9, ge=2, le=16)
    """Separable, flatcam, open: order of the maximum length sequence."""
    features: int | None = Field(default=None, ge=1, le=LARGEST)
    """Mura (an odd prime), random: features a side."""
    open_part: float = Field(default=0.5, gt=0, le=1)
    """Random: probability that a feature is open."""
    seed: int = Field(default=0, ge=0, le=2**63 - 1)
    """Random: seed of the draw."""
    file: str | None = Field(default=None, min_length=1, max_length=4096)
    """Drawing, psf: PNG, TIFF, NPY or OpenEXR file."""
    psf_distance_mm: float | None = Field(default=None, gt=0, le=1e10)
    """Psf: distance from the sensor to the point whose light the picture shows [mm]."""
    aperture_mm2: float | None = Field(default=None, gt=0, le=1e8)
    """Psf: area of the mask that transmits light."""
    psf_reduce: int = Field(default=1, ge=1, le=1024)
    """Psf: number of the picture's pixels a side that are averaged to one."""
    edge_blur_um: float = Field(default=0.0, ge=0, le=1000)
    """Standard deviation of a Gaussian blur of the transmission [um]."""
    opaque_transmission: float = Field(default=0.0, ge=0, le=1)
    """Fraction of the light that a closed feature transmits."""
    clear_transmission: float = Field(default=1.0, ge=0, le=1)
    """Fraction of the light that an open feature transmits."""
    rotation_deg: float = Field(default=0.0, ge=-180, le=180)
    """Rotation in the mask's plane, from the rows' direction to the columns' [degrees]."""
    tilt_row_mrad: float = Field(default=0.0, ge=-300, le=300)
    """Increase of the mask's distance down the rows [mrad]."""
    tilt_column_mrad: float = Field(default=0.0, ge=-300, le=300)
    """Increase of the mask's distance along the columns [mrad]."""

    @model_validator(mode="after")
    def _fields_of_its_kind(self) -> MaskProfile:
        flaws = set() if self.kind == "psf" else _FLAWS
        own = _OWN[self.kind].split()
        common = {"kind", "feature_mm", "distance_mm", *flaws}
        foreign = self.model_fields_set - common - {name.rstrip("!") for name in own}
        if foreign:
            raise ValueError(f"{min(foreign)} has no effect on a mask of kind {self.kind}; remove it")
        missing = [name[:-1] for name in own if name.endswith("!") and getattr(self, name[:-1]) is None]
        if missing:
            raise ValueError(f"a mask of kind {self.kind} needs {missing[0]}; add it")
        if self.kind == "mura" and not (is_prime(self.features or 0) and self.features != 2):
            raise ValueError(f"features: got {self.features}; a MURA has an odd prime, as 101 or 251")
        if self.opaque_transmission >= self.clear_transmission:
            problem = f"opaque_transmission: got {self.opaque_transmission:g}"
            raise ValueError(f"{problem}; give less than clear_transmission, {self.clear_transmission:g}")
        return self

    @property
    def _stated(self) -> set[str]:
        return {name for name in _FLAWS if getattr(self, name) != type(self).model_fields[name].default}

    def plate(self, folder: Path) -> Plate:
        """Return the plate as it is made; files are relative to ``folder``. Raises MitsimError if it is too large."""
        feature, side = self.feature_mm, self.features or 0
        if self.kind == "drawing":
            path = folder / str(self.file)
            (feature, values), words = make_square(read_drawing(path), feature), f"drawing {path.name}"
        elif self.kind == "mura":
            values, words = mura(side), f"MURA of {side} features"
        elif self.kind == "random":
            values = (stream(self.seed, "mask").random((side, side)) < self.open_part).astype(np.float64)
            words = f"random mask of {side} features, open part {self.open_part:g}, seed {self.seed}"
        else:
            if 2**self.order - 1 > LARGEST:
                raise MitsimError(f"mask {self.kind}: flaws are worked out for orders up to 12; got {self.order}")
            terms = mls_mask(cast("MaskKind", self.kind), feature, self.order).terms
            values = np.asarray(sum(weight * np.outer(rows, columns) for weight, rows, columns in terms))
            words = f"{self.kind}, order {self.order}"
        drawn = Plate(feature, values, words)
        if not self._stated:
            return drawn
        values = self.opaque_transmission + (self.clear_transmission - self.opaque_transmission) * drawn.values
        turn = self.rotation_deg
        if turn % 90 == 0:
            values, turn = np.rot90(values, int(turn // 90)), 0.0
        flaws = Flaws(self.edge_blur_um * 1e-3, turn, (self.tilt_row_mrad, self.tilt_column_mrad))
        stated = [f"{name} {getattr(self, name):g}" for name in type(self).model_fields if name in self._stated]
        return Plate(feature, values, ", ".join([words, *stated]), flaws)

    def put_on(self, camera: CameraGeometry, folder: Path) -> CameraGeometry:
        mask: dict[str, object] = {"mask": "plate", "mask_feature": self.feature_mm, "mask_plate": None}
        if self.distance_mm is not None:
            mask["mask_distance"] = self.distance_mm
        if self.kind == "psf":
            # The light behind a phase mask as a plate: brightness relative to light without a mask. A point at depth z0
            # lights a picture's pixel of side p as one of side p (1 - d/z0) on the mask at distance d.
            path, far = folder / str(self.file), self.psf_distance_mm or 0.0
            near = camera.mask_distance if self.distance_mm is None else self.distance_mm
            if far <= near:
                raise MitsimError(f"mask psf: psf_distance_mm is {far:g}; give more than the mask's {near:g} mm")
            light = load_psf(path, self.psf_reduce, LARGEST // 2)
            feature, values = make_square(light, self.feature_mm * self.psf_reduce * (1 - near / far))
            values *= float(self.aperture_mm2 or 0.0) / (values.sum() * feature**2)
            words = f"point spread function {path.name} of {far:g} mm, aperture {self.aperture_mm2:g} mm2"
            mask |= {"mask_plate": Plate(feature, values, words, irradiance=True), "mask_feature": feature}
        elif self.kind in get_args(MaskKind) and not self._stated:
            mask |= {"mask": self.kind, "mask_order": self.order}
        else:
            mask["mask_plate"] = self.plate(folder)
        return validate(CameraGeometry, {**dict(camera), **mask}, "camera file: [mask]")


def mura(features: int) -> FloatArray:
    """Return one (p, p) period of the modified uniformly redundant array of an odd prime p ``features``.

    Gottesman and Fenimore, Applied Optics 28, 4344 (1989), equation 11: row 0 is closed, else column 0 is open, else
    features with C_i C_j = 1, where C_k = 1 for squares modulo p and -1 for others.
    """
    signs = np.full(features, -1)
    signs[np.arange(1, features) ** 2 % features] = 1
    array: FloatArray = (np.outer(signs, signs) == 1).astype(np.float64)
    array[:, 0], array[0] = 1, 0
    return array


def load_mask(path: Path | str) -> MaskProfile | None:
    """Return the table ``[mask]`` of the camera file ``path``, None without one; errors name field, value and rule."""
    table = read_toml(path)
    if "mask" not in table:
        return None
    if not isinstance(table["mask"], dict):
        raise MitsimError(f"file {path}: mask: got {table['mask']!r}; give a table [mask]")
    return validate(MaskProfile, table["mask"], f"file {path}: mask")


# -------- A drawing or scan of a mask

_DRAWING = Wanted("mask drawing", most=LARGEST, bits=(1, 2, 4, 8, 16, 32))
"""2 and 4 bits are read as 8, in which white is the same."""
_PICTURES = ".png", ".tif", ".tiff"
"""Files whose whole numbers are parts of white; other files hold transmissions."""


def read_drawing(path: Path) -> FloatArray:
    """Return the (rows, columns) transmissions, 0 to 1, of the drawing ``path``; pictures are linear in transmission.

    Row 0 is at the top and column 0 at the left for a viewer from the sensor. Raises MitsimError for a file that is no
    PNG, TIFF, NPY or OpenEXR, has colours, transparency or several pages, or numbers outside 0 to 1.
    """
    rows, columns = image_pages(path, _DRAWING)[1]
    if (rows - columns) % 2 and 2 * max(rows, columns) > LARGEST:
        problem = f"{rows} x {columns} pixels: about its centre the shorter side needs half a pixel, so features become"
        allowed = f"half as large, of which {LARGEST} a side are allowed"
        raise _DRAWING.refusal(path, f"{problem} {allowed}; make its sides differ by an even number")
    values = read_image(path, _DRAWING)
    white = own_end(values) if path.suffix.lower() in _PICTURES else None
    transmissions = np.asarray(values, dtype=np.float64) / (white or 1.0)
    if transmissions.min() < 0 or transmissions.max() > 1:
        raise _DRAWING.refusal(path, "has values outside 0 to 1; give transmissions")
    return transmissions


def make_square(values: FloatArray, feature_mm: float) -> tuple[float, FloatArray]:
    """Return the side of the pixels, and a drawing with opaque margins that make it square about its centre.

    Pixels are halved if margins of half a pixel are needed.
    """
    if (values.shape[0] - values.shape[1]) % 2:
        values, feature_mm = values.repeat(2, axis=0).repeat(2, axis=1), feature_mm / 2
    side = max(values.shape)
    margins = [((side - own) // 2,) * 2 for own in values.shape]
    return feature_mm, np.pad(values, margins)


# -------- Pictures of point spread functions
# Studies take it as a camera that shifts it (:mod:`mitsim.reconstruct.convolution`), a camera file's mask of the kind
# ``psf`` as a shadow that grows as the point comes nearer (:class:`MaskProfile`).
#
# An example is the picture of DiffuserCam (Antipa et al., Optica 5, 1, 2018; repository
# Waller-Lab/DiffuserCam-Tutorial, BSD 3-Clause), which mitsim does not ship.

_PICTURE = Wanted("point spread function", colour=True)
_PIXEL_BYTES = 64
"""Memory of a pixel: four colours of double precision, and as many arrays of their mean."""
PSF_BORDER = 16
"""Width [pixels] of the frame along the picture's edges that shows the background."""


def load_psf(path: Path | str, reduce: int = 4, most: int | None = None) -> FloatArray:
    """Return the point spread function in a picture (PNG, TIFF, NPY, OpenEXR), with sum 1.

    Colours are averaged, the median along the edges is subtracted, ``reduce`` x ``reduce`` pixels are averaged, and
    negative values become zero. Raises MitsimError for a file that is no picture, has a palette or more than ``most``
    pixels per side, for a ``reduce`` that does not fit, and without light above the background.
    """
    path = Path(path)
    light = _light(path, _read(path, reduce, most).mean(axis=2), reduce)
    return np.asarray(light / light.sum())


def load_psf_channels(
    path: Path | str, names: Sequence[str], frame: tuple[int, int], how: Mapping[str, Any], reduce: int = 1
) -> FloatArray:
    """Return the light (channels, k, k') of a point in a picture, a channel for each line of a run, or one for all.

    A run of the planes of a mosaic takes a raw mosaic of twice the rows and columns of its ``frame``, too, whose planes
    are read as ``how`` (:class:`mitsim.core.picture_files.Preparation`) says. MitsimError as :func:`load_psf`, and for
    other numbers of channels.
    """
    path = Path(path)
    values = np.moveaxis(_read(path, reduce), 2, 0)
    of_lines = tuple(names) == RGB or path.suffix.lower() == ".npy"
    if len(values) not in (1, len(names)) or (len(values) > 1 and not of_lines):
        found = f"has {len(values)} channels, and the run {len(names)} lines, {', '.join(names)}"
        raise _PICTURE.refusal(path, f"{found}; give one for all in grey, or NPY of (rows, columns, lines)")
    rows, columns = values.shape[1:]
    if len(values) == 1 and tuple(names) == PLANES and (rows > frame[0] or columns > frame[1]):
        if (rows, columns) != (2 * frame[0], 2 * frame[1]) or "orientation" in how or min(frame) <= 2 * PSF_BORDER:
            needed = f"a raw mosaic of the run's {frame[0]} x {frame[1]} pixels a plane has twice as many, not rotated"
            raise _PICTURE.refusal(path, f"{rows} x {columns} pixels; {needed}; import it with --point as the frames")
        values = np.stack([values[0, a::2, b::2] for a, b in planes_of(how.get("mosaic") or BGGR).values()])
    return np.stack([_light(path, each, reduce) for each in values])


def _read(path: Path, reduce: int, most: int | None = None) -> FloatArray:
    """Return the (rows, columns, channels) numbers of a picture without transparency, as :func:`load_psf` checks it."""
    size = image_pages(path, _PICTURE)[1]
    rows, columns = (side // reduce for side in size) if reduce >= 1 else (0, 0)
    if min(rows, columns) < 1 or min(size) <= 2 * PSF_BORDER:
        problem = f"{size[0]} x {size[1]} pixels, reduce {reduce}; it needs more than {2 * PSF_BORDER} pixels a side"
        raise _PICTURE.refusal(path, f"{problem}, and reduce from 1 to its shorter side")
    if most is not None and max(rows, columns) > most:
        raise _PICTURE.refusal(path, f"{rows} x {columns} pixels; a mask has at most {most} a side, set psf_reduce")
    Cost(memory_bytes=size[0] * size[1] * _PIXEL_BYTES).check(f"point spread function {path}", Limits())
    values = np.atleast_3d(np.asarray(read_image(path, _PICTURE), dtype=np.float64))
    return values if path.suffix.lower() == ".npy" else values[..., :3]


def _light(path: Path, values: FloatArray, reduce: int) -> FloatArray:
    inside = np.zeros(values.shape, dtype=bool)
    inside[PSF_BORDER:-PSF_BORDER, PSF_BORDER:-PSF_BORDER] = True
    above = values - np.median(values[~inside])
    light = np.maximum(reduce_frame(above, reduce), 0)
    if light.sum() <= 0:
        raise _PICTURE.refusal(path, "nothing is brighter than its edges; give another picture")
    return np.asarray(light)


# -------- The devices of a bench, as pure data


@dataclass(frozen=True)
class Devices:
    """Camera, electronics ``sensor`` of ``camera_file``, and projector."""

    camera: CameraGeometry
    sensor: SensorModel
    projector: ProjectorModel
    camera_file: str
