"""What pairs are asked for: options or arguments in, a checked request, or a refusal in one line, out.

Nothing here imports numpy before work begins.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, field_validator

from mitsim.bench.request import Exposure, ExposureKeys, Request
from mitsim.core.configuration import Configuration, FilePath, Options, load_model, option, validate
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.imagelist import PRINTS
from mitsim.core.seeds import stream
from mitsim.devices.session import Drift

MOST_PAIRS = 10**6
"""Pairs that may be asked for: beyond what any network of these was trained on, and within five digits of shards."""
CALIBRATION = "calibration"
"""CAL folder in a folder of pairs of the idealised model, whose factors are known."""
Between = Annotated[tuple[float, float], Field(strict=False)]
"""Least and largest number that are drawn, all between them alike."""


class Variation(Configuration):
    """How benches vary: so many of them are drawn, each for an equal part of the pairs."""

    groups: int = Field(ge=1, le=10_000)
    """Benches."""
    exposure_fraction: Between | None = None
    """Brightest pixel, as a part of full well: the level of noise."""
    scene: dict[str, Between] = Field(default={})
    """Parameters of the scene, as `sheet_z`; light is traced for each bench."""
    mask: dict[str, Between] = Field(default={})
    """How the mask has moved, by fields of a drift, as `mask_rows_um`."""

    @field_validator("exposure_fraction", "scene", "mask")
    @classmethod
    def _least_first(cls, value: Any) -> Any:
        for low, high in value.values() if isinstance(value, dict) else filter(None, (value,)):
            if low > high:
                raise ValueError(f"got [{low:g}, {high:g}]; give the least number first")
        return value

    @field_validator("mask")
    @classmethod
    def _of_a_mask(cls, value: dict[str, Between]) -> dict[str, Between]:
        known = [name for name in Drift.model_fields if name.startswith("mask_")]
        for name in value:
            if name not in known:
                raise ValueError(f"{name!r} is no motion of a mask; known are {', '.join(known)}")
        return value

    def draw(self, seed: int, group: int) -> dict[str, float]:
        """What is drawn for bench number ``group`` under a ``seed``, by `table.name`."""
        rng = stream(seed, "bench", group)
        ranges = {f"scene.{name}": limits for name, limits in self.scene.items()}
        ranges |= {f"mask.{name}": limits for name, limits in self.mask.items()}
        if self.exposure_fraction is not None:
            ranges["exposure_fraction"] = self.exposure_fraction
        return {name: float(rng.uniform(*limits)) for name, limits in sorted(ranges.items())}


class PairOptions(Options):
    """Which pairs are made, beside the request of their frames."""

    VERB = "make_pairs"

    count: int = option(..., "pairs to make", metavar="N", ge=1, le=MOST_PAIRS)
    idealised: bool = option(False, "frames of the paper's separable model, not rendered")
    pictures: FilePath | None = option(
        None, "folder of pictures; drawn by code if not given", metavar="FOLDER", kind=Path
    )
    vary: Variation | None = option(
        None,
        "how benches vary from one group of pairs to the next",
        metavar="FILE.toml",
        kind=Path,
        read=lambda path: load_model(path, Variation),
    )


class PairsRequest(PairOptions):
    """Which pairs are wanted."""

    capture: Request
    """Request of each pair's frames; its seed is the root of all streams."""

    def check(self) -> None:
        """MitsimError for a request that cannot be served, before any work."""
        if self.capture.seconds is not None or self.capture.noise_fraction is not None:
            raise ArgumentError("seconds", "pairs share their light; give an accuracy")
        if self.capture.closing_frame is not None:
            raise ArgumentError("closing_frame", "pairs have none; leave it out")
        if self.pictures is not None:
            picture_files(Path(self.pictures))
        vary = self.vary
        for limit in (vary and vary.exposure_fraction) or ():
            Exposure(None, limit)
        for name, limits in vary.mask.items() if vary else ():
            for limit in limits:
                validate(Drift, {name: limit}, "vary: [mask]")
        if vary is not None and self.idealised:
            raise ArgumentError("vary", "the idealised model has no bench that varies; leave out one of the two")
        if vary is not None and vary.groups > self.count:
            raise ArgumentError("vary", f"{vary.groups} groups of {self.count} pairs; give fewer groups or more pairs")
        if vary is not None and vary.exposure_fraction and self.capture.exposure != "auto":
            raise ArgumentError("exposure", f"{self.capture.exposure}: exposure_fraction varies; leave out one of both")

    def groups(self) -> list[dict[str, float]]:
        """What is drawn for each bench."""
        if self.vary is None:
            return [{}]
        return [self.vary.draw(self.capture.seed, group) for group in range(self.vary.groups)]


class PairKeys(ExposureKeys, total=False):
    """Keywords of :func:`mitsim.make_pairs`, beside the number of pairs."""

    idealised: bool
    pictures: Path | str | None


def picture_files(folder: Path) -> tuple[Path, ...]:
    """The pictures in a ``folder``, by their names. MitsimError where there are none."""
    if not folder.is_dir():
        raise MitsimError(f"pictures {folder}: is no folder; give one of pictures")
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in PRINTS)
    if not found:
        raise MitsimError(f"pictures {folder}: holds no file that ends in {', '.join(PRINTS)}")
    return tuple(found)
