"""A camera file's table ``[mask]``: a mask's numbers in, the camera's geometry with that mask out."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import read_toml, validated
from mitsim.core.errors import MitsimError
from mitsim.core.seeds import stream
from mitsim.rig.camera import CameraGeometry
from mitsim.rig.drawing import read_drawing, squared
from mitsim.rig.mask import MaskKind
from mitsim.rig.plate import LARGEST, Plate

_OWN = {
    **dict.fromkeys(get_args(MaskKind), ("order",)),
    "mura": ("features",),
    "random": ("features", "open_part", "seed"),
    "drawing": ("file",),
}
"""The fields that each kind has beside its name and the feature size."""
_NEEDED = {"mura": "features", "random": "features", "drawing": "file"}
"""The one that it cannot do without."""


class MaskProfile(BaseModel):
    """What a mask is made of; the scene states where it stands."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    kind: Literal["separable", "flatcam", "open", "mura", "random", "drawing"] = Field(description="see below")
    feature_mm: float = Field(ge=1e-6, le=1e3, description="side of a feature, or of a drawing's pixel [mm]")
    """As a scene's ``mask_feature``."""
    order: int = Field(9, ge=2, le=16, description="separable, flatcam, open: order of the maximum length sequence")
    features: int | None = Field(None, ge=1, le=LARGEST, description="mura (an odd prime), random: features a side")
    open_part: float = Field(0.5, gt=0, le=1, description="random: probability that a feature is open")
    seed: int = Field(0, ge=0, le=2**63 - 1, description="random: which of all such masks")
    file: str | None = Field(None, min_length=1, max_length=4096, description="drawing: PNG, TIFF, NPY or OpenEXR file")

    @model_validator(mode="after")
    def _fields_of_its_kind(self) -> MaskProfile:
        foreign = self.model_fields_set - {"kind", "feature_mm", *_OWN[self.kind]}
        if foreign:
            raise ValueError(f"{min(foreign)} says nothing of a mask {self.kind}; remove it")
        needed = _NEEDED.get(self.kind)
        if needed and getattr(self, needed) is None:
            raise ValueError(f"a mask {self.kind} needs {needed}; add it")
        if self.kind == "mura" and not _is_odd_prime(self.features or 0):
            raise ValueError(f"features: got {self.features}; a MURA has an odd prime, as 101 or 251")
        return self

    def plate(self, folder: Path) -> Plate:
        """The plate of a mask of another kind than :class:`mitsim.rig.mask.Mask` has; files count from ``folder``."""
        if self.kind == "drawing":
            path = folder / str(self.file)
            return Plate(*squared(read_drawing(path), self.feature_mm), words=f"drawing {path.name}")
        side = self.features or 0
        if self.kind == "mura":
            return Plate(self.feature_mm, mura(side), f"MURA of {side} features")
        draws = stream(self.seed, "mask").random((side, side))
        words = f"random mask of {side} features, open part {self.open_part:g}, seed {self.seed}"
        return Plate(self.feature_mm, (draws < self.open_part).astype(np.float64), words)

    def worn(self, camera: CameraGeometry, folder: Path) -> CameraGeometry:
        """The ``camera`` with this mask; a drawing's file counts from ``folder``. MitsimError as for a plate."""
        mask: dict[str, object] = {"mask_feature": self.feature_mm, "mask_plate": None}
        if self.kind in get_args(MaskKind):
            mask |= {"mask": self.kind, "mask_order": self.order}
        else:
            mask |= {"mask": "plate", "mask_plate": self.plate(folder)}
        return CameraGeometry.checked("camera file: [mask]", **{**dict(camera), **mask})


def mura(features: int) -> FloatArray:
    """(p, p) modified uniformly redundant array of an odd prime p ``features``, 0 and 1: one period of it.

    Gottesman and Fenimore, Applied Optics 28, 4344 (1989), equation 11: row 0 is closed, else column 0 is open, else
    what C_i C_j = 1 makes so, with C_k = 1 for squares modulo p and -1 for others.
    """
    signs = np.full(features, -1)
    signs[np.arange(1, features) ** 2 % features] = 1
    array: FloatArray = (np.outer(signs, signs) == 1).astype(np.float64)
    array[:, 0], array[0] = 1, 0
    return array


def load_mask(path: Path | str) -> MaskProfile | None:
    """The table ``[mask]`` of the camera file ``path``, None without one. MitsimError naming field, value and rule."""
    table = read_toml(path).get("mask")
    if table is None:
        return None
    if not isinstance(table, dict):
        raise MitsimError(f"file {path}: mask: got {table!r}; give a table [mask]")
    return validated(MaskProfile, table, f"file {path}: [mask]")


def _is_odd_prime(number: int) -> bool:
    return number > 2 and all(number % divisor for divisor in range(2, int(number**0.5) + 1))
