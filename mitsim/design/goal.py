"""Goal of a design: a TOML file, checked to a frozen model."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from mitsim.core.configuration import FilePath, Options, read_toml, refuse_together, validated_by
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.picture_files import picture_files
from mitsim.devices.patterns import is_own

Positive = Annotated[float, Field(ge=1e-6, le=1e6)]
Part = Annotated[float, Field(ge=0, le=1)]
_MOST = 32
"""Combinations of choices, and of doses and distances, because all their shadows are kept in memory."""


def _can_be_compared(exposures: str) -> None:
    if exposures == "peak":
        raise MitsimError(
            "got 'peak'; masks of equal peak are exposed for different times, so that the mask with the "
            "least light wins (a single pinhole by exposing 53 times as long); give 'time' or 'light'"
        )


def _is_a_range(part: tuple[float, float]) -> None:
    if part[0] > part[1]:
        raise MitsimError(f"got {part[0]:g} to {part[1]:g}; give the smaller part first")


def _have_one_period(names: tuple[str, ...]) -> None:
    for name in names:
        if name.startswith("cyclic:") and not re.fullmatch(r"cyclic:[0-9]+", name):
            raise MitsimError(f"got {name!r}; give cyclic:P with one period P for rows and columns")


class Goal(Options):
    """What is searched, within which limits, and what counts."""

    scene: FilePath
    """Name or path of the scene."""
    camera: FilePath | None = None
    """Camera file or name; none: the scene's. Its mask is replaced."""
    patterns: Annotated[tuple[str, ...], validated_by(_have_one_period)] = Field(
        default=("dots:7",), strict=False, min_length=1
    )
    """Pattern families to choose from. For cyclic:P, the best 0/1 code of period P is found, which shifts as dots:P."""
    exposure_total_s: Positive
    """Exposure of all frames of a capture together."""
    exposures: Annotated[Literal["time", "light", "peak"], validated_by(_can_be_compared)] = "time"
    """Time: all masks have these seconds. Light: all have the mean light that the maximum length sequence has in these
    seconds. Peak is refused."""
    doses: tuple[Positive, ...] = Field(default=(1.0,), strict=False, min_length=1)
    """Fractions of these seconds at which masks are judged."""
    scene_distances_mm: tuple[Positive, ...] = Field(default=(), strict=False)
    """Distances of the scene at which masks are judged; none: the aligned plane."""
    judge: Literal["mean", "worst"] = "mean"
    """Mean error over doses, distances and pictures, or the worst."""
    feature_um: tuple[Positive, ...] = Field(default=(60.0,), strict=False, min_length=1)
    """Feature sizes to choose from."""
    mask_distance_mm: tuple[Positive, ...] = Field(default=(), strict=False)
    """Distances of the mask to choose from; none: the scene's."""
    open_part: Annotated[tuple[Part, Part], validated_by(_is_a_range)] = Field(default=(0.0, 1.0), strict=False)
    """Least and largest fraction of a side's features that are open."""
    prior: tuple[Positive, Part, Annotated[float, Field(ge=0, lt=1)]] | None = Field(default=None, strict=False)
    """Reflectance: mean, standard deviation, correlation of neighbouring pixels; none: those of the scene."""
    pictures: FilePath | None = None
    """Folder whose pictures replace that of the scene in turn."""
    wanted_psnr_db: float | None = Field(default=None, ge=1, le=100)
    """Also state the exposure that this PSNR needs."""
    starts: int = Field(default=4, ge=1, le=10_000)
    """Starts of the search for each combination of choices."""
    evaluations: int = Field(default=400, ge=10, le=1_000_000)
    """Codes that a start may try."""
    time_limit_s: Positive | None = None
    """Seconds after which no further start begins."""
    seed: int = Field(default=0, ge=0, lt=2**63)
    """Root of all random numbers."""
    seeds: int = Field(default=3, ge=2, le=100)
    """Captures of the proof, whose scatter decides."""
    accuracy: float = Field(default=1e-4, ge=1e-6, le=0.1)
    """Accuracy of the frames of the proof."""

    @property
    def families(self) -> tuple[str, ...]:
        """Pattern families with which the search begins: dots:P for cyclic:P."""
        return tuple(dict.fromkeys(re.sub("^cyclic:", "dots:", name) for name in self.patterns))

    @property
    def shown(self) -> list[dict[str, Any]]:
        """Parameters of the scene for each picture."""
        return [{}] if self.pictures is None else [{"picture": each} for each in picture_files(Path(self.pictures))]

    def check_count(self) -> None:
        """Raise MitsimError for too many combinations."""
        for names in (("feature_um", "mask_distance_mm", "patterns"), ("doses", "scene_distances_mm")):
            if (count := math.prod(max(len(getattr(self, name)), 1) for name in names)) > _MOST:
                raise MitsimError(f"goal: {', '.join(names)}: got {count} combinations; give at most {_MOST}")


def load_goal(path: Path | str) -> Goal:
    """Return the goal of a file, with whole paths, which count from the file; MitsimError names each wrong field."""
    try:
        goal, base = Goal(**read_toml(path)), Path(path).absolute().parent
    except ArgumentError as error:
        texts = (str(each).replace("no such option", "no such field") for each in (error, *error.others))
        raise refuse_together(f"file {path}", [*texts]) from error
    patterns = (os.path.normpath(base / each) if is_own(each, base) else each for each in goal.patterns)
    update: dict[str, object] = {"patterns": tuple(patterns)}
    for name in ("scene", "camera", "pictures"):
        text = str(getattr(goal, name))
        if os.sep in text or Path(text).suffix or (name == "pictures" and goal.pictures):
            update[name] = os.path.normpath(base / text)
    return goal.model_copy(update=update)
