"""Goal of a design: a TOML file, checked to a frozen model."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from mitsim.core.configuration import Configuration, load_model

Positive = Annotated[float, Field(gt=0, le=1e6)]


class Goal(Configuration):
    """What is searched, within which limits, and what counts."""

    scene: str
    """Name or path of the scene; its camera and its reflectance are where the search begins."""
    camera: str | None = None
    """Camera file or name; none: the scene's. Its mask is replaced."""
    patterns: tuple[str, ...] = Field(default=("dots:7",), strict=False, min_length=1)
    """Pattern families to choose from. For cyclic:P, the best 0/1 code of period P is found, which shifts as dots:P."""
    exposure_total_s: Positive
    """Seconds of all frames of a capture together; frames of a family share them evenly."""
    exposures: Literal["time", "light", "peak"] = "time"
    """Time: all masks have the same seconds. Light: the same mean light, so that a mask that transmits less is exposed
    for longer than these seconds, which are those of the scene's own mask. Peak is refused."""
    doses: tuple[Positive, ...] = Field(default=(1.0,), strict=False, min_length=1)
    """Parts of these seconds over which the design is judged."""
    scene_distances_mm: tuple[Positive, ...] = Field(default=(), strict=False)
    """Distances of the scene over which it is judged; none: the aligned plane."""
    judge: Literal["mean", "worst"] = "mean"
    """Mean of the errors in dB over doses and distances, or the worst."""
    feature_um: tuple[Positive, ...] = Field(default=(60.0,), strict=False, min_length=1)
    """Least features to choose from."""
    mask_distance_mm: tuple[Positive, ...] = Field(default=(), strict=False)
    """Distances of the mask to choose from; none: the scene's."""
    open_part: tuple[float, float] = Field(default=(0.0, 1.0), strict=False)
    """Least and largest part of a side's features that are open."""
    prior: tuple[float, float, float] | None = Field(default=None, strict=False)
    """Mean, standard deviation and correlation of neighbouring pixels of reflectance; none: those of the scene."""
    wanted_psnr_db: float | None = Field(default=None, ge=1, le=100)
    """Also state the seconds of exposure that this PSNR needs."""
    starts: int = Field(default=4, ge=1, le=10_000)
    """Starts of the search for each feature size, distance and family."""
    evaluations: int = Field(default=400, ge=10, le=1_000_000)
    """Codes that a start may try."""
    time_limit_s: Positive | None = None
    """Seconds after which no further start begins."""
    seed: int = Field(default=0, ge=0, lt=2**63)
    """Root of all random numbers."""
    seeds: int = Field(default=3, ge=2, le=100)
    """Captures of the proof, whose scatter decides what is better."""
    accuracy: float = Field(default=1e-4, ge=1e-6, le=0.1)
    """Accuracy of the frames of the proof."""

    @property
    def families(self) -> tuple[str, ...]:
        """Pattern families with which the search begins: dots:P for cyclic:P."""
        return tuple(dict.fromkeys(re.sub("^cyclic:", "dots:", name) for name in self.patterns))

    @model_validator(mode="after")
    def _can_be_compared(self) -> Goal:
        if self.exposures == "peak":
            raise ValueError(
                "exposures: got 'peak'; masks of equal peak are exposed for different times, so that the mask with the "
                "least light wins (a single pinhole by exposing 53 times as long); give 'time' or 'light'"
            )
        low, high = self.open_part
        if not 0 <= low <= high <= 1:
            raise ValueError(f"open_part: got {low:g} to {high:g}; give two parts from 0 to 1, the smaller one first")
        for name in self.patterns:
            if name.startswith("cyclic:") and not re.fullmatch(r"cyclic:[0-9]+", name):
                raise ValueError(f"patterns: got {name!r}; give cyclic:P with one period P for rows and columns")
        return self


def load_goal(path: Path | str) -> Goal:
    """Return the goal of a file; MitsimError names each field that breaks a rule."""
    return load_model(path, Goal)
