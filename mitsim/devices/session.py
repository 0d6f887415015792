"""How a calibration session is run: a TOML file, checked to a frozen model."""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Literal, get_args

from pydantic import AfterValidator, Field, model_validator

from mitsim.core.configuration import RECIPE, Configuration, load_model, locate, validate
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments, checked_fields
from mitsim.devices.sensor import ExposureFraction

# -------- The white board of a calibration session
# The default board is flat, faces the camera on the aligned plane, and is larger than the camera's view.


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
            raise ValueError(f"bow_mm: got {self.bow_mm:g}; allowed is up to a tenth of size_mm {self.size_mm:g}")
        return self

    @property
    def words(self) -> str:
        parts = [] if self.size_mm is None else [f"{self.size_mm:g} mm a side"]
        parts += [f"bow {self.bow_mm:g} mm"] if self.bow_mm else []
        if self.tilt_row_deg or self.tilt_column_deg:
            parts.append(f"tilt {self.tilt_row_deg:g} and {self.tilt_column_deg:g} degrees")
        return ", ".join(parts) or "flat, larger than the view"


# -------- Motion between a calibration and a capture: the table [drift] of a recipe
# Every number is 0 where nothing moves. Mask, projector, power, lamps, sensor and exposure are as they were in the
# session before it, and as stated here in the capture after it; a session itself drifts by `session_ramp` and
# `session_flicker` alone.

LARGEST_ROTATION_MRAD = 10.0
"""Beyond it, the neglected cosine moves a mask's edge 3 mm off the axis by 0.15 um."""
LARGEST_TILT_MRAD = 50.0
DRIFTS: Mapping[str, tuple[str, str]] = MappingProxyType({
    "mask_rows_um": ("um", "mask down the rows"), "mask_columns_um": ("um", "mask along the columns"),
    "mask_axis_um": ("um", "mask away from the sensor"), "mask_rotation_mrad": ("mrad", "mask turns in its plane"),
    "mask_tilt_rows_mrad": ("mrad", "mask tilts down the rows"),
    "mask_tilt_columns_mrad": ("mrad", "mask tilts along the columns"),
    "vibration_um": ("um rms", "vibration of the mask"), "temperature_k": ("K", "temperature"),
    "exposure": ("1", "exposure time"), "power": ("1", "projector's power"),
    "power_ramp": ("1", "power over the capture"), "power_flicker": ("1 rms", "power from frame to frame"),
    "power_ripple": ("1", "ripple of the power"), "session_ramp": ("1", "power over the session"),
    "session_flicker": ("1 rms", "power from frame to frame of the session"),
    "lamp": ("1", "lamp after its frame"), "lamp_flicker": ("1 rms", "lamp from frame to frame"),
    "lamp_ripple": ("1", "ripple of the lamp"), "projector_rows": ("pixels", "picture down the rows"),
    "projector_columns": ("pixels", "picture along the columns"), "black_level_dn": ("DN", "black level"),
})  # fmt: skip
"""Unit and description of each kind of drift: every field of :class:`Drift` that moves something by itself."""
DRIFT_PARAMETERS = "gap_um_per_k", "power_ripple_hz", "lamp_ripple_hz"
"""Fields of :class:`Drift` that move nothing by themselves: they say what a kind does."""


class MaskMotion(Configuration):
    """How a mask is turned in its plane about its centre, from rows to columns, and how it moves during an exposure."""

    rotation_mrad: float = Field(default=0.0, ge=-LARGEST_ROTATION_MRAD, le=LARGEST_ROTATION_MRAD)
    vibration_um: float = Field(default=0.0, ge=0, le=1000)
    """Rms along each axis, um."""


class Drift(Configuration):
    """Motions and changes between a calibration and a capture."""

    mask_rows_um: float = Field(default=0.0, ge=-1000, le=1000)
    """Mask moves down the rows, um."""
    mask_columns_um: float = Field(default=0.0, ge=-1000, le=1000)
    """The same along the columns, um."""
    mask_axis_um: float = Field(default=0.0, ge=-1000, le=1000)
    """Mask moves away from the sensor, um.

    A millimetre: a mask that has come loose."""
    mask_rotation_mrad: float = Field(default=0.0, ge=-LARGEST_ROTATION_MRAD, le=LARGEST_ROTATION_MRAD)
    """Mask turns in its plane, mrad."""
    mask_tilt_rows_mrad: float = Field(default=0.0, ge=-LARGEST_TILT_MRAD, le=LARGEST_TILT_MRAD)
    """Mask tilts about its centre, its distance growing down the rows, mrad."""
    mask_tilt_columns_mrad: float = Field(default=0.0, ge=-LARGEST_TILT_MRAD, le=LARGEST_TILT_MRAD)
    """The same along the columns, mrad."""
    vibration_um: float = Field(default=0.0, ge=0, le=1000)
    """Normal motion of the mask during each exposure, um rms along each axis."""
    temperature_k: float = Field(default=0.0, ge=-200, le=200)
    """Sensor and camera grow warmer, K."""
    gap_um_per_k: float = Field(default=0.0, ge=-100, le=100)
    """Gap from sensor to mask grows, um/K; moves nothing by itself.

    A metre of aluminium has 23 um/K."""
    exposure: float = Field(default=0.0, gt=-1, le=10)
    """Exposure time's error, as a part of it."""
    power: float = Field(default=0.0, ge=-1, le=10)
    """Projector's power changes, as a part of it."""
    power_ramp: float = Field(default=0.0, ge=-1, le=10)
    """The same, evenly from begin to end of the capture, as a part of it."""
    power_flicker: float = Field(default=0.0, ge=0, le=1)
    """The same from frame to frame, normal deviates, rms as a part of it."""
    power_ripple: float = Field(default=0.0, ge=0, le=1)
    """Power during each frame, a sine of any phase, amplitude as a part of it."""
    power_ripple_hz: float | None = Field(default=None, ge=1e-3, le=1e7)
    """Its frequency, Hz.

    Mains bring 100 or 120, a projector's pictures some 60, drivers of light-emitting diodes up to 1e6."""
    session_ramp: float = Field(default=0.0, ge=-1, le=10)
    """Power changes from begin to end of the session, as a part of it."""
    session_flicker: float = Field(default=0.0, ge=0, le=1)
    """Power from frame to frame of the session, rms as a part of it."""
    lamp: float = Field(default=0.0, ge=-1, le=10)
    """Lamps change after the ambient frame, as a part of their light."""
    lamp_flicker: float = Field(default=0.0, ge=0, le=1)
    """Lamps from frame to frame, normal deviates, rms as a part of their light."""
    lamp_ripple: float = Field(default=0.0, ge=0, le=1)
    """Lamps during each frame, a sine of any phase, amplitude as a part of it."""
    lamp_ripple_hz: float | None = Field(default=None, ge=1e-3, le=1e7)
    """Its frequency, Hz."""
    projector_rows: float = Field(default=0.0, gt=-0.5, lt=0.5)
    """Picture moves down the rows, its pixels."""
    projector_columns: float = Field(default=0.0, gt=-0.5, lt=0.5)
    """The same along the columns.

    Beyond half a pixel, pixels at the window's edge would light nothing."""
    black_level_dn: float = Field(default=0.0, ge=-1e4, le=1e4)
    """Black level of a pixel moves, DN."""

    @model_validator(mode="after")
    def _ripples_have_a_frequency(self) -> Drift:
        for name in ("power", "lamp"):
            if getattr(self, f"{name}_ripple") and getattr(self, f"{name}_ripple_hz") is None:
                amplitude = getattr(self, f"{name}_ripple")
                raise ValueError(f"{name}_ripple {amplitude:g} has no frequency; give {name}_ripple_hz")
        return self

    @property
    def ripples(self) -> Mapping[str, tuple[float, float]]:
        both = ("power", self.power_ripple, self.power_ripple_hz), ("lamp", self.lamp_ripple, self.lamp_ripple_hz)
        return {name: (amplitude, hertz) for name, amplitude, hertz in both if amplitude and hertz}

    def alone(self, kind: str, amount: float | None = None) -> Drift:
        """Return one ``kind`` of drift alone; MitsimError for an unknown kind, or an amount that is not allowed."""
        if kind not in DRIFTS:
            raise MitsimError(f"drift {kind!r}: there is no such kind; use {', '.join(DRIFTS)}")
        chosen = getattr(self, kind) if amount is None else float(amount)
        return validate(Drift, {kind: chosen, **{name: getattr(self, name) for name in DRIFT_PARAMETERS}}, "drift")

    @property
    def kinds(self) -> tuple[str, ...]:
        return tuple(kind for kind in DRIFTS if getattr(self, kind))

    @property
    def mask_mm(self) -> tuple[float, float, float]:
        axis = self.mask_axis_um + self.gap_um_per_k * self.temperature_k
        return self.mask_rows_um / 1e3, self.mask_columns_um / 1e3, axis / 1e3

    @property
    def tilt_mrad(self) -> tuple[float, float] | None:
        tilt = self.mask_tilt_rows_mrad, self.mask_tilt_columns_mrad
        return tilt if any(tilt) else None

    @property
    def motion(self) -> MaskMotion | None:
        if not (self.mask_rotation_mrad or self.vibration_um):
            return None
        return MaskMotion(rotation_mrad=self.mask_rotation_mrad, vibration_um=self.vibration_um)


# -------- How a calibration session is run

MOST_REPEATS = 1024
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


_Ladder = tuple[Annotated[float, Field(ge=1, le=LONGEST)], ...]
_RUNGS = Field(strict=False, min_length=1, max_length=MOST_RUNGS)
Exposures = Annotated[_Ladder, _RUNGS, AfterValidator(_check_rising)]
_Distances = tuple[Annotated[float, Field(ge=1e-6, le=1e10)], ...]
Depths = Annotated[_Distances, Field(strict=False, max_length=64), AfterValidator(_check_different)]
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
    order: Order = "listed"
    """Order in which patterns are taken."""
    order_seed: int = Field(default=0, ge=0, le=MOST_SEED)
    """Of a random order."""
    drift: Drift = Drift()
    """What moves between calibration and capture; none: nothing."""
    source: str
    """Where the numbers come from."""

    def of_one_depth(self) -> SessionRecipe:
        if self.depths:
            raise MitsimError(f"recipe: has {len(self.depths)} depths; use calibrate_depths, or leave depths out")
        return self


@check_arguments
def load_recipe(path: Path | str | None = None) -> SessionRecipe:
    """Return the recipe in the TOML file at ``path``, or the shipped one; errors name the field that breaks a rule."""
    return load_model(locate("session" if path is None else path, "calibration", ".toml", RECIPE), SessionRecipe)


def recipe_text(recipe: SessionRecipe) -> str:
    import tomli_w  # here: only those who print a recipe need it

    return tomli_w.dumps(recipe.model_dump(mode="json", exclude_defaults=True))


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
    """Yield the halves that show each of ``count`` patterns per side: horizontal stripes, then vertical ones.

    With ``pairs``, a +-1 pattern is the difference of two frames. Otherwise each side begins with a uniform frame.
    """
    for side in SIDES:
        if not pairs:
            yield [(side, 0, UNIFORM)]
        for index in range(count):
            yield [(side, index, sign) for sign in ((1, -1) if pairs else (1,))]


def halves_in_order(count: int, pairs: bool, order: Order = "listed", seed: int = 0) -> list[Half]:
    """Return the halves in the order in which they are taken; those that are subtracted follow one another.

    ``interleaved`` alternates between the sides, and ``random`` uses the ``seed``.
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
"""Numbers of the devices that can be fitted (:class:`mitsim.optics.terms.Placement`), and their units."""
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
                problem = f"mask_shift_{axis},projector_{axis}: both move the shadow alike, and cannot be distinguished"
                raise ArgumentError("fit", f"{problem} but by how its brightness falls off; fit one of them")

    @property
    def free(self) -> tuple[str, ...]:
        return tuple(name for name in UNITS if name in (*self.fitted, "gain"))

    def used_patterns(self, changes: Sequence[int], pairs: bool, repeats: int) -> list[tuple[Side, int]]:
        """Return side and number of the +-1 patterns whose frames are used.

        They are uniform light, then ever finer stripes (by their ``changes`` of sign), because a mask's fringes change
        the deep shadows of coarse stripes least.
        """
        shots = max(self.frames // repeats, 2)
        most = shots // 2 if pairs else max(shots - 2, 1)
        finer = sorted(range(1, len(changes)), key=lambda index: changes[index])
        turns: tuple[Side, Side] = "vertical", "horizontal"
        order: list[tuple[Side, int]] = [("horizontal", 0)]
        order += [(side, index) for index in finer for side in turns]
        return order[:most]


def frames_of(chosen: Sequence[tuple[Side, int]], pairs: bool, repeats: int) -> int:
    sides = len({side for side, _ in chosen})
    return repeats * (2 * len(chosen) if pairs else len(chosen) + sides)
