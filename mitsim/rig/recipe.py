"""How a calibration session is run: a TOML file in, a checked and frozen model out."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from mitsim.core.configuration import load_model, shipped


class SessionRecipe(BaseModel):
    """How a calibration session is run."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    board_reflectance: float = Field(gt=0, le=1, description="diffuse reflectance of the white board")
    exposure_fraction: float = Field(gt=0, le=1, description="brightest pixel's mean, as a part of the full well")
    signed_capture: str = Field(pattern="^(pair|uniform)$", description="how a +-1 pattern is captured")
    source: str = Field(description="where the numbers come from")


def load_recipe(path: Path | str | None = None) -> SessionRecipe:
    """The calibration session's recipe, the shipped one without ``path``."""
    return load_model(Path(path) if path is not None else shipped("calibration", "session.toml"), SessionRecipe)
