"""How a calibration session is run: a TOML file in, a checked and frozen model out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from mitsim.core.configuration import load_model, shipped
from mitsim.rig.board import BoardShape
from mitsim.rig.sensor import ExposureFraction

MOST_REPEATS = 1024
"""Shots of one frame: 30 dB less noise, where a session of 512 frames takes days."""


class SessionRecipe(BaseModel):
    """A session's board and exposure, how signed patterns are taken, and how often."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    board_reflectance: float = Field(ge=0.01, le=1, description="diffuse reflectance of the white board")
    """Black velvet reflects 0.004, and a board of 1 % would take a hundred times the exposure."""
    board: BoardShape = Field(default=BoardShape(), description="size, bow and tilt of the board; none: ideal")
    exposure_fraction: ExposureFraction = Field(description="brightest pixel's mean, as a part of the full well")
    signed_capture: Literal["pair", "uniform"] = Field(description="how a +-1 pattern is captured")
    repeats: int = Field(default=1, ge=1, le=MOST_REPEATS, description="shots of every frame, whose mean is taken")
    source: str = Field(description="where the numbers come from")


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
