"""How a calibration session is run: a TOML file in, a checked and frozen model out."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from mitsim.core.arguments import checked
from mitsim.core.configuration import load_model, shipped
from mitsim.core.errors import MitsimError
from mitsim.rig.board import BoardShape
from mitsim.rig.drift import Drift
from mitsim.rig.order import Order
from mitsim.rig.sensor import ExposureFraction

MOST_REPEATS = 1024
"""Shots of one frame: 30 dB less noise, where a session of 512 frames takes days."""
MOST_RUNGS, LONGEST = 8, 1e6
"""Exposures of one frame, and the longest over the shortest: 120 dB, more than any scene on a sensor has."""
MOST_SEED = 2**32 - 1
"""As of every random stream."""
Merge = Literal["weighted", "longest"]


def _rising(exposures: tuple[float, ...]) -> tuple[float, ...]:
    if exposures[0] != 1 or any(later <= earlier for earlier, later in itertools.pairwise(exposures)):
        raise ValueError(f"got {', '.join(f'{value:g}' for value in exposures)}; give 1, and rising numbers after it")
    return exposures


def _different(depths: tuple[float, ...]) -> tuple[float, ...]:
    names = [f"{depth:g}" for depth in depths]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"{twice} is there twice, to the six digits that its folder's name has; give each depth once")
    return depths


Exposures = Annotated[
    tuple[Annotated[float, Field(ge=1, le=LONGEST)], ...],
    Field(strict=False, min_length=1, max_length=MOST_RUNGS),
    AfterValidator(_rising),
]
Depths = Annotated[
    tuple[Annotated[float, Field(ge=1e-6, le=1e10)], ...],
    Field(strict=False, max_length=64),
    AfterValidator(_different),
]
"""As `scene_distance`; 64 sessions of the shipped scenes take ten minutes."""


class SessionRecipe(BaseModel):
    """A session's board and exposure, how signed patterns are taken, and how often."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    board_reflectance: float = Field(ge=0.01, le=1, description="diffuse reflectance of the white board")
    """Black velvet reflects 0.004, and a board of 1 % would take a hundred times the exposure."""
    board: BoardShape = Field(default=BoardShape(), description="size, bow and tilt of the board; none: ideal")
    exposure_fraction: ExposureFraction = Field(description="brightest pixel's mean, as a part of the full well")
    signed_capture: Literal["pair", "uniform"] = Field(description="how a +-1 pattern is captured")
    repeats: int = Field(default=1, ge=1, le=MOST_REPEATS, description="shots of every frame, whose mean is taken")
    depths: Depths = Field(default=(), description="of the board [mm], a CAL folder each; none: on the aligned plane")
    exposure_ladder: Exposures = Field(default=(1.0,), description="exposures of every frame, over the shortest")
    ladder_merge: Merge = Field(default="weighted", description="how they make one: by variance, or the longest alone")
    dark_frames: int = Field(default=0, ge=0, le=MOST_REPEATS, description="frames without light, of each exposure")
    order: Order = Field(default="listed", description="order in which patterns are taken")
    order_seed: int = Field(default=0, ge=0, le=MOST_SEED, description="of a random order")
    drift: Drift = Field(default=Drift(), description="what moves between calibration and capture; none: nothing")
    source: str = Field(description="where the numbers come from")

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
