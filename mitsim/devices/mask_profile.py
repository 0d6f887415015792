"""A camera file's table ``[mask]``, and the camera's geometry with that mask."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Literal, cast, get_args

import numpy as np
from pydantic import Field, model_validator

from mitsim.core.arrays import FloatArray, stream
from mitsim.core.colour_files import Wanted
from mitsim.core.configuration import Configuration, read_toml, validate
from mitsim.core.errors import MitsimError
from mitsim.core.images import image_size, read_image
from mitsim.core.job import Cost, Limits
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.mask import LARGEST, Flaws, MaskKind, Plate, make_square, mls_mask, read_drawing
from mitsim.devices.patterns import is_prime

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
    *("edge_blur_um", "opaque_transmission", "clear_transmission", "rotation_deg", "tilt_row_mrad", "tilt_column_mrad"),
}
"""The fields that every kind has."""
_QUARTER = 90


class MaskProfile(Configuration):
    """Material and flaws of a mask; the scene states its place."""

    kind: Literal["separable", "flatcam", "open", "mura", "random", "drawing", "psf"]
    """What it is made as; `mitsim list masks` says what each is."""
    feature_mm: float = Field(ge=1e-6, le=1e3)
    """Side of a feature, or of a picture's pixel [mm].

    As a scene's ``mask_feature``."""
    order: int = Field(default=9, ge=2, le=16)
    """Separable, flatcam, open: order of the maximum length sequence."""
    features: int | None = Field(default=None, ge=1, le=LARGEST)
    """Mura (an odd prime), random: features a side."""
    open_part: float = Field(default=0.5, gt=0, le=1)
    """Random: probability that a feature is open."""
    seed: int = Field(default=0, ge=0, le=2**63 - 1)
    """Random: which of all such masks."""
    file: str | None = Field(default=None, min_length=1, max_length=4096)
    """Drawing, psf: PNG, TIFF, NPY or OpenEXR file."""
    psf_distance_mm: float | None = Field(default=None, gt=0, le=1e10)
    """Psf: from the sensor to the point that the picture shows the light of [mm]."""
    aperture_mm2: float | None = Field(default=None, gt=0, le=1e8)
    """Psf: area of the mask that lets light through."""
    psf_reduce: int = Field(default=1, ge=1, le=1024)
    """Psf: pixels a side of the picture that become one."""
    edge_blur_um: float = Field(default=0.0, ge=0, le=1000)
    """Standard deviation of a Gaussian blur of the transmission [um]."""
    opaque_transmission: float = Field(default=0.0, ge=0, le=1)
    """Part of the light that a closed feature lets through."""
    clear_transmission: float = Field(default=1.0, ge=0, le=1)
    """Part of the light that an open feature lets through."""
    rotation_deg: float = Field(default=0.0, ge=-180, le=180)
    """Turn in its plane, from the rows' direction to the columns' [degrees]."""
    tilt_row_mrad: float = Field(default=0.0, ge=-300, le=300)
    """How its distance grows down the rows [mrad]."""
    tilt_column_mrad: float = Field(default=0.0, ge=-300, le=300)
    """The same along the columns [mrad]."""

    @model_validator(mode="after")
    def _fields_of_its_kind(self) -> MaskProfile:
        flaws = set() if self.kind == "psf" else _FLAWS
        own = _OWN[self.kind].split()
        foreign = self.model_fields_set - {"kind", "feature_mm", *(name.rstrip("!") for name in own), *flaws}
        if foreign:
            raise ValueError(f"{min(foreign)} says nothing of a mask {self.kind}; remove it")
        missing = [name[:-1] for name in own if name.endswith("!") and getattr(self, name[:-1]) is None]
        if missing:
            raise ValueError(f"a mask {self.kind} needs {missing[0]}; add it")
        if self.kind == "mura" and not (is_prime(self.features or 0) and self.features != 2):
            raise ValueError(f"features: got {self.features}; a MURA has an odd prime, as 101 or 251")
        if self.opaque_transmission >= self.clear_transmission:
            problem = f"opaque_transmission: got {self.opaque_transmission:g}"
            raise ValueError(f"{problem}; give less than clear_transmission, {self.clear_transmission:g}")
        return self

    def plate(self, folder: Path) -> Plate:
        """Return the plate as it is made; files are relative to ``folder``. Raises MitsimError if it is too large."""
        drawn = self.plate_drawing(folder)
        if not self._stated:
            return drawn
        values = self.opaque_transmission + (self.clear_transmission - self.opaque_transmission) * drawn.values
        turn = self.rotation_deg
        if turn % _QUARTER == 0:
            values, turn = np.rot90(values, int(turn // _QUARTER)), 0.0
        flaws = Flaws(self.edge_blur_um * 1e-3, turn, (self.tilt_row_mrad, self.tilt_column_mrad))
        stated = [f"{name} {getattr(self, name):g}" for name in type(self).model_fields if name in self._stated]
        return Plate(drawn.feature_mm, values, ", ".join([drawn.words, *stated]), flaws)

    @property
    def _stated(self) -> set[str]:
        return {name for name in _FLAWS if getattr(self, name) != type(self).model_fields[name].default}

    def plate_drawing(self, folder: Path) -> Plate:
        if self.kind in get_args(MaskKind):
            if 2**self.order - 1 > LARGEST:
                problem = f"mask {self.kind} of order {self.order}: flaws are worked out for at most {LARGEST} features"
                raise MitsimError(f"{problem} a side; give an order up to 12")
            mask = mls_mask(cast("MaskKind", self.kind), self.feature_mm, self.order)
            values = sum(weight * np.outer(rows, columns) for weight, rows, columns in mask.terms)
            return Plate(self.feature_mm, np.asarray(values), f"{self.kind}, order {self.order}")
        if self.kind == "drawing":
            path = folder / str(self.file)
            return Plate(*make_square(read_drawing(path), self.feature_mm), words=f"drawing {path.name}")
        side = self.features or 0
        if self.kind == "mura":
            return Plate(self.feature_mm, mura(side), f"MURA of {side} features")
        draws = stream(self.seed, "mask").random((side, side))
        words = f"random mask of {side} features, open part {self.open_part:g}, seed {self.seed}"
        return Plate(self.feature_mm, (draws < self.open_part).astype(np.float64), words)

    def put_on(self, camera: CameraGeometry, folder: Path) -> CameraGeometry:
        mask: dict[str, object] = {"mask_feature": self.feature_mm, "mask_plate": None}
        if self.kind == "psf":
            # The light behind a phase mask as a plate: brightness relative to light without a mask. A point at depth z0
            # lights a picture's pixel of side p as one of side p (1 - d/z0) on the mask at distance d.
            path, near, far = folder / str(self.file), camera.mask_distance, self.psf_distance_mm or 0.0
            if far <= near:
                problem = f"mask psf: psf_distance_mm is {far:g}; the point must lie beyond the mask"
                raise MitsimError(f"{problem}, at {near:g} mm")
            light = load_psf(path, self.psf_reduce, LARGEST // 2)
            feature, values = make_square(light, self.feature_mm * self.psf_reduce * (1 - near / far))
            values *= float(self.aperture_mm2 or 0.0) / (values.sum() * feature**2)
            words = f"point spread function {path.name} of {far:g} mm, aperture {self.aperture_mm2:g} mm2"
            picture = Plate(feature, values, words, irradiance=True)
            mask |= {"mask": "plate", "mask_plate": picture, "mask_feature": picture.feature_mm}
        elif self.kind in get_args(MaskKind) and not self._stated:
            mask |= {"mask": self.kind, "mask_order": self.order}
        else:
            mask |= {"mask": "plate", "mask_plate": self.plate(folder)}
        return CameraGeometry.build("camera file: [mask]", **{**dict(camera), **mask})


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


# -------- Pictures of point spread functions
# Studies take it as a camera that shifts it (:mod:`mitsim.reconstruct.convolution`), a camera file's mask of the kind
# ``psf`` as a shadow that grows as the point comes nearer (:class:`mitsim.devices.mask_profile.MaskProfile`).
#
# An example is the picture of DiffuserCam (Antipa et al., Optica 5, 1, 2018; repository
# Waller-Lab/DiffuserCam-Tutorial, BSD 3-Clause), which mitsim does not ship.

_PICTURE = Wanted("point spread function", colour=True)
_PIXEL_BYTES = 64
"""Memory of a pixel: four colours of double precision, and as many arrays of their mean."""
_BORDER = 16
"""Width [pixels] of the frame along the picture's edges that shows the background."""


def load_psf(path: Path | str, reduce: int = 4, most: int | None = None) -> FloatArray:
    """Return the point spread function in a picture (PNG, TIFF, NPY, OpenEXR), with sum 1.

    Colours are averaged, the median along the edges is subtracted, ``reduce`` x ``reduce`` pixels are averaged, and
    negative values become zero. Raises MitsimError for a file that is no picture, has a palette or more than ``most``
    pixels per side, for a ``reduce`` that does not fit, and without light above the background.
    """
    path = Path(path)
    size = image_size(path, _PICTURE)
    rows, columns = (side // reduce for side in size) if reduce >= 1 else (0, 0)
    if min(rows, columns) < 1 or min(size) <= 2 * _BORDER:
        problem = f"{size[0]} x {size[1]} pixels, reduce {reduce}; it needs more than {2 * _BORDER} pixels a side"
        raise _PICTURE.refusal(path, f"{problem}, and reduce from 1 to its shorter side")
    if most is not None and max(rows, columns) > most:
        raise _PICTURE.refusal(
            path, f"{rows} x {columns} pixels; at most {most} a side make a mask, so set a larger psf_reduce"
        )
    Cost(memory_bytes=size[0] * size[1] * _PIXEL_BYTES).check(f"point spread function {path}", Limits())
    values = np.asarray(read_image(path, _PICTURE), dtype=np.float64)
    values = values if values.ndim == 2 else values[..., :3].mean(axis=2)
    inside = np.zeros(values.shape, dtype=bool)
    inside[_BORDER:-_BORDER, _BORDER:-_BORDER] = True
    above = values - np.median(values[~inside])
    means = above[: rows * reduce, : columns * reduce].reshape(rows, reduce, columns, reduce).mean(axis=(1, 3))
    light = np.maximum(means, 0)
    total = float(light.sum())
    if total <= 0:
        raise _PICTURE.refusal(path, "nothing is brighter than its edges; give another picture")
    return np.asarray(light / total)
