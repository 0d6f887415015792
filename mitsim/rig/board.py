"""The white board of a calibration session: its size, bow and tilt in, its points out.

A board without these is flat, faces the camera on the aligned plane, and is larger than what the camera sees.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict, Field, model_validator

if TYPE_CHECKING:
    from mitsim.core.arrays import FloatArray
    from mitsim.rig.camera import CameraGeometry

_BEYOND = 1.1
"""Half side of a board without a size, as a part of what the sensor's edge sees; chosen: more than rounding."""
_GRAZING = 0.05
"""Least part by which a board without a size recedes from a ray: it is at most 20 times what is seen of a flat one."""
CELLS = 64
"""Facets a side of a bowed board: they lie up to 1/4096 of the bow off the paraboloid."""


class BoardShape(BaseModel):
    """Size, bow and tilt of the white board; its middle stays on the camera's axis."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    size_mm: float | None = Field(
        default=None, ge=1e-3, le=1e7, description="side of the square board [mm]; none: larger than the view"
    )
    """From a board for masks in contact to one 10 km away."""
    bow_mm: float = Field(
        default=0.0,
        ge=-1e6,
        le=1e6,
        description="height of the middle over the middles of the edges, a paraboloid [mm]; above 0: to the camera",
    )
    """Up to a tenth of the largest board."""
    tilt_row_deg: float = Field(
        default=0.0, ge=-60, le=60, description="tilt [degrees]; above 0: later rows are farther from the camera"
    )
    """At 60 degrees half of the light is left, and no board is hung worse."""
    tilt_column_deg: float = Field(default=0.0, ge=-60, le=60, description="the same of later columns")

    @model_validator(mode="after")
    def _a_bow_has_a_size(self) -> BoardShape:
        if self.bow_mm and self.size_mm is None:
            raise ValueError(f"bow_mm: got {self.bow_mm:g} without size_mm, from whose edges it is measured; give both")
        if self.size_mm is not None and abs(self.bow_mm) > 0.1 * self.size_mm:
            raise ValueError(
                f"bow_mm: got {self.bow_mm:g} on a board of {self.size_mm:g} mm; allowed is up to a tenth of it"
            )
        return self

    @property
    def words(self) -> str:
        """The board in words, without what it does not have."""
        parts = [] if self.size_mm is None else [f"{self.size_mm:g} mm a side"]
        parts += [f"bow {self.bow_mm:g} mm"] if self.bow_mm else []
        if self.tilt_row_deg or self.tilt_column_deg:
            parts.append(f"tilt {self.tilt_row_deg:g} and {self.tilt_column_deg:g} degrees")
        return ", ".join(parts) or "flat, larger than the view"

    @property
    def turn(self) -> FloatArray:
        """(3, 3) rotation of the board in the camera's frame, by the smallest angle that gives it its slopes: its plane
        is z = tan(tilt_row) s_row + tan(tilt_column) s_column, s_row = -y and s_column = -x. So no axis comes first."""
        import numpy as np  # here: recipes are checked without it

        slope = np.array([-math.tan(math.radians(tilt)) for tilt in (self.tilt_column_deg, self.tilt_row_deg)])
        steep = float(np.linalg.norm(slope))
        if steep == 0:
            return np.eye(3)
        angle = math.atan(steep)
        uphill = slope / steep
        # Rodrigues' formula about the level line: points uphill of the middle move away along z.
        axis = np.array([uphill[1], -uphill[0], 0.0])
        cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        return np.asarray(np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross)

    def half_side(self, geometry: CameraGeometry, z: float) -> float:
        """Half of the board's side [mm] at a distance ``z`` [mm] from a camera of that ``geometry``; without a size,
        beyond what the camera sees of it."""
        if self.size_mm is not None:
            return self.size_mm / 2
        half = _BEYOND * (geometry.tan_half_fov * z + geometry.half_width)
        steep = math.hypot(*(math.tan(math.radians(tilt)) for tilt in (self.tilt_row_deg, self.tilt_column_deg)))
        if steep == 0:
            return half
        # Along the slope a ray of tan-angle u meets the board at u z / (cos - u sin) from its middle.
        angle, corner = math.atan(steep), math.sqrt(2) * half / z
        return half * math.sqrt(2) / max(math.cos(angle) - corner * math.sin(angle), _GRAZING)

    def surface(self, half: float) -> tuple[FloatArray, FloatArray]:
        """Points and normals (CELLS + 1, CELLS + 1, 3) of the bowed board in its own frame, x and y in -``half`` to
        ``half`` [mm], its camera's side towards -z.

        The paraboloid z = bow (x^2 + y^2) / half^2.
        """
        import numpy as np

        line = np.linspace(-half, half, CELLS + 1)
        x, y = np.meshgrid(line, line)
        part = self.bow_mm / half**2
        normals = np.stack([2 * part * x, 2 * part * y, -np.ones_like(x)], axis=-1)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        return np.stack([x, y, part * (x**2 + y**2)], axis=-1), normals
