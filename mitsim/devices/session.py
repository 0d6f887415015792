"""How a calibration session is run: a TOML file in, a checked and frozen model out."""

from __future__ import annotations

import itertools
import json
import math
import random
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Literal, get_args

from pydantic import AfterValidator, Field, model_validator

from mitsim.core.configuration import Configuration, load_model, shipped
from mitsim.core.errors import ArgumentError, MitsimError, checked, checked_fields
from mitsim.devices.drift import Drift
from mitsim.devices.sensor import ExposureFraction

if TYPE_CHECKING:
    from mitsim.core.arrays import FloatArray
    from mitsim.devices.camera import CameraGeometry


# -------- The white board of a calibration session
# A board without these is flat, faces the camera on the aligned plane, and is larger than what the camera sees.

_BEYOND = 1.1
"""Half side of a board without a size, as a part of what the sensor's edge sees; chosen: more than rounding."""
_GRAZING = 0.05
"""Least part by which a board without a size recedes from a ray: it is at most 20 times what is seen of a flat one."""
CELLS = 64
"""Facets a side of a bowed board: they lie up to 1/4096 of the bow off the paraboloid."""


class BoardShape(Configuration):
    """Size, bow and tilt of the white board; its middle stays on the camera's axis."""

    size_mm: float | None = Field(default=None, ge=1e-3, le=1e7)
    """Side of the square board [mm]; none: larger than the view.

    From a board for masks in contact to one 10 km away."""
    bow_mm: float = Field(default=0.0, ge=-1e6, le=1e6)
    """Height of the middle over the middles of the edges, a paraboloid [mm]; above 0: to the camera.

    Up to a tenth of the largest board."""
    tilt_row_deg: float = Field(default=0.0, ge=-60, le=60)
    """Tilt [degrees]; above 0: later rows are farther from the camera.

    At 60 degrees half of the light is left, and no board is hung worse."""
    tilt_column_deg: float = Field(default=0.0, ge=-60, le=60)
    """The same of later columns."""

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


# -------- How a calibration session is run

MOST_REPEATS = 1024
"""Shots of one frame: 30 dB less noise, where a session of 512 frames takes days."""
MOST_RUNGS, LONGEST = 8, 1e6
"""Exposures of one frame, and the longest over the shortest: 120 dB, more than any scene on a sensor has."""
MOST_SEED = 2**32 - 1
"""As of every random stream."""
Merge = Literal["weighted", "longest"]


def _check_rising(exposures: tuple[float, ...]) -> tuple[float, ...]:
    if exposures[0] != 1 or any(later <= earlier for earlier, later in itertools.pairwise(exposures)):
        raise ValueError(f"got {', '.join(f'{value:g}' for value in exposures)}; give 1, and rising numbers after it")
    return exposures


def _check_different(depths: tuple[float, ...]) -> tuple[float, ...]:
    names = [f"{depth:g}" for depth in depths]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"{twice} is there twice, to the six digits that its folder's name has; give each depth once")
    return depths


Exposures = Annotated[
    tuple[Annotated[float, Field(ge=1, le=LONGEST)], ...],
    Field(strict=False, min_length=1, max_length=MOST_RUNGS),
    AfterValidator(_check_rising),
]
Depths = Annotated[
    tuple[Annotated[float, Field(ge=1e-6, le=1e10)], ...],
    Field(strict=False, max_length=64),
    AfterValidator(_check_different),
]
"""As `scene_distance`; 64 sessions of the shipped scenes take ten minutes."""


class SessionRecipe(Configuration):
    """A session's board and exposure, how signed patterns are taken, and how often."""

    board_reflectance: float = Field(ge=0.01, le=1)
    """Diffuse reflectance of the white board.

    Black velvet reflects 0.004, and a board of 1 % would take a hundred times the exposure."""
    board: BoardShape = BoardShape()
    """Size, bow and tilt of the board; none: ideal."""
    exposure_fraction: ExposureFraction
    """Brightest pixel's mean, as a part of the full well."""
    signed_capture: Literal["pair", "uniform"]
    """How a +-1 pattern is captured."""
    repeats: int = Field(default=1, ge=1, le=MOST_REPEATS)
    """Shots of every frame, whose mean is taken."""
    depths: Depths = ()
    """Of the board [mm], a CAL folder each; none: on the aligned plane."""
    exposure_ladder: Exposures = (1.0,)
    """Exposures of every frame, over the shortest."""
    ladder_merge: Merge = "weighted"
    """How they make one: by variance, or the longest alone."""
    dark_frames: int = Field(default=0, ge=0, le=MOST_REPEATS)
    """Frames without light, of each exposure."""
    order: Order = "listed"
    """Order in which patterns are taken."""
    order_seed: int = Field(default=0, ge=0, le=MOST_SEED)
    """Of a random order."""
    drift: Drift = Drift()
    """What moves between calibration and capture; none: nothing."""
    source: str
    """Where the numbers come from."""

    @model_validator(mode="after")
    def _dark_frames_are_of_use(self) -> SessionRecipe:
        if self.dark_frames and self.signed_capture == "pair":
            raise ValueError(
                f"dark_frames: got {self.dark_frames}, but a pair's difference has no dark signal; set 0, or "
                "signed_capture 'uniform'"
            )
        return self

    def of_one_depth(self) -> SessionRecipe:
        """Itself, as the recipe of one calibration; MitsimError where it has depths."""
        if self.depths:
            raise MitsimError(
                f"recipe: has {len(self.depths)} depths, and this makes one calibration; use calibrate_depths, or "
                "leave depths out"
            )
        return self


@checked
def load_recipe(path: Path | str | None = None) -> SessionRecipe:
    """The recipe in the TOML file at ``path``, or the shipped one; MitsimError names the field that breaks a rule."""
    return load_model(Path(path) if path is not None else shipped("calibration", "session.toml"), SessionRecipe)


def recipe_text(recipe: SessionRecipe) -> str:
    """The ``recipe`` as TOML that :func:`load_recipe` reads."""
    fields = recipe.model_dump(mode="json", exclude_defaults=True)
    tables = {name: value for name, value in fields.items() if isinstance(value, dict)}
    lines = [f"{name} = {json.dumps(value)}" for name, value in fields.items() if name not in tables]
    for name, table in tables.items():
        lines += ["", f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


# -------- The order in which a session's frames are taken

Side = Literal["horizontal", "vertical"]
SIDES: tuple[Side, Side] = ("horizontal", "vertical")
"""Stripes of a calibration: h_i 1^T, and 1 h_i^T."""
Order = Literal["listed", "reversed", "interleaved", "random"]
UNIFORM = 0
"""Sign of a frame under uniform light."""
Half = tuple[Side, int, int]
"""Side, number of the pattern and sign of a frame."""


def halves(count: int, pairs: bool) -> Iterator[list[Half]]:
    """What shows each pattern, in the order of the list: horizontal stripes, then vertical ones.

    Parameters
    ----------
    count
        patterns of a side.
    pairs
        whether a +-1 pattern is the difference of two frames. If not, each side begins with a uniform frame.
    """
    for side in SIDES:
        if not pairs:
            yield [(side, 0, UNIFORM)]
        for index in range(count):
            yield [(side, index, sign) for sign in ((1, -1) if pairs else (1,))]


def taken(count: int, pairs: bool, order: Order = "listed", seed: int = 0) -> list[Half]:
    """The same in the order in which they are taken. What is subtracted in a pair is taken one after the other.

    Parameters
    ----------
    count, pairs
        as :func:`halves`.
    order
        ``listed``; ``reversed``; ``interleaved``: a pattern of one side, then the same of the other; ``random``.
    seed
        of a random order.
    """
    patterns = list(halves(count, pairs))
    if order == "reversed":
        patterns.reverse()
    elif order == "interleaved":
        middle = len(patterns) // 2
        patterns = [pattern for both in zip(patterns[:middle], patterns[middle:], strict=True) for pattern in both]
    elif order == "random":
        random.Random(seed).shuffle(patterns)
    return [half for pattern in patterns for half in pattern]


# ---- How a camera's factors are modelled ----

Model = Literal["geometric", "wave"]
"""Of the mask's shadow: rays, or waves of the projector's lines."""
UNITS: Mapping[str, str] = MappingProxyType({
    "mask_distance": "mm", "mask_shift_row": "mm", "mask_shift_column": "mm", "mask_rotation": "rad",
    "magnification": "1", "projector_row": "tan", "projector_column": "tan", "gain": "e-/s",
})  # fmt: skip
"""Numbers of a rig that can be fitted (:class:`mitsim.optics.camera_model.Placement`), and their units."""
FITTED = ("mask_distance", "mask_shift_row", "mask_shift_column", "mask_rotation", "magnification", "gain")
"""Those that are, where nothing is said: a shift of the projector's window looks like one of the mask."""


@checked_fields
@dataclass(frozen=True)
class Modelling:
    """Which model is fitted to how many frames.

    Attributes
    ----------
    model
        of the mask's shadow.
    frames
        of the session that are used, at most.
    fitted
        names of :data:`UNITS`; the rest is as the scene states it. The gain is always fitted.
    accuracy
        of a simulated session's light.
    """

    model: Model
    frames: int = 16
    fitted: tuple[str, ...] = FITTED
    accuracy: float = 1e-3

    def __post_init__(self) -> None:
        if not isinstance(self.model, str) or self.model not in get_args(Model):
            raise ArgumentError("model", f"{self.model!r}: use {' or '.join(get_args(Model))}")
        if self.frames < 2:
            raise ArgumentError("frames_used", f"{self.frames}: give 2 or more; a +-1 pattern is two frames")
        for name in self.fitted:
            if name not in UNITS:
                raise ArgumentError("fit", f"{name!r}: use names of {', '.join(UNITS)}")
        for axis in ("row", "column"):
            if {f"mask_shift_{axis}", f"projector_{axis}"} <= {*self.fitted}:
                raise ArgumentError(
                    "fit",
                    f"mask_shift_{axis},projector_{axis}: both move the shadow alike, and cannot be told apart but by "
                    "how its brightness falls off; fit one of them",
                )

    @property
    def free(self) -> tuple[str, ...]:
        """What is fitted, each once."""
        return tuple(name for name in UNITS if name in (*self.fitted, "gain"))

    def chosen(self, changes: Sequence[int], pairs: bool, repeats: int) -> list[tuple[Side, int]]:
        """Side and number of the +-1 patterns whose frames are used: uniform light, then ever finer stripes, vertical
        and horizontal ones. Coarse stripes cast the deepest shadows, which a mask's fringes change least.

        Parameters
        ----------
        changes
            of sign in each pattern of a side; none in number 0.
        pairs, repeats
            whether a pattern is two frames, or one beside its side's uniform one; and how often each is taken.
        """
        shots = max(self.frames // repeats, 2)
        most = shots // 2 if pairs else max(shots - 2, 1)
        finer = sorted(range(1, len(changes)), key=lambda index: changes[index])
        turns: tuple[Side, Side] = "vertical", "horizontal"
        order: list[tuple[Side, int]] = [("horizontal", 0)]
        order += [(side, index) for index in finer for side in turns]
        return order[:most]


def frames_of(chosen: Sequence[tuple[Side, int]], pairs: bool, repeats: int) -> int:
    """How many frames the ``chosen`` patterns are.

    Parameters
    ----------
    chosen, pairs, repeats
        as :meth:`Modelling.chosen` has them.
    """
    sides = len({side for side, _ in chosen})
    return repeats * (2 * len(chosen) if pairs else len(chosen) + sides)
