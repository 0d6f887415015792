"""Requests for pairs and for trainings, checked or refused in one line, without an import of numpy or torch."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, field_validator

from mitsim.bench.request import Exposure, Request, Seeded
from mitsim.core.configuration import LIMITS, QUALITY, Configuration, FilePath, Options, load_model, option, validate
from mitsim.core.errors import ArgumentError, MitsimError, near_name
from mitsim.core.imagelist import PRINTS
from mitsim.core.seeds import stream
from mitsim.devices.session import Drift

# -------- Pairs

MOST_PAIRS = 10**6
CALIBRATION = "calibration"
Between = Annotated[tuple[float, float], Field(strict=False)]
"""Bounds of an even distribution."""


class Variation(Configuration):
    """Variation of benches, each drawn for an equal part of the pairs."""

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
        """Return the drawn numbers of bench number ``group``, by `table.name`."""
        rng = stream(seed, "bench", group)
        tables = {"scene": self.scene, "mask": self.mask}
        ranges = {f"{table}.{name}": limits for table, each in tables.items() for name, limits in each.items()}
        if self.exposure_fraction is not None:
            ranges["exposure_fraction"] = self.exposure_fraction
        return {name: float(rng.uniform(*limits)) for name, limits in sorted(ranges.items())}


class PairOptions(Options):
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
    capture: Request
    """Request of each pair's frames; its seed is the root of all streams."""

    def check(self) -> None:
        capture, vary = self.capture, self.vary
        if self.pictures is not None:
            picture_files(Path(self.pictures))
        if vary is None:
            return
        for limit in vary.exposure_fraction or ():
            Exposure(None, limit)
        for name, limits in vary.mask.items():
            for limit in limits:
                validate(Drift, {name: limit}, "vary: [mask]")
        if self.idealised:
            raise ArgumentError("vary", "the idealised model has no bench that varies; leave out one of the two")
        if vary.groups > self.count:
            raise ArgumentError("vary", f"{vary.groups} groups of {self.count} pairs; give fewer groups or more pairs")
        if vary.exposure_fraction and capture.exposure != "auto":
            raise ArgumentError("exposure", f"{capture.exposure}: exposure_fraction varies; leave out one of both")

    def groups(self) -> list[dict[str, float]]:
        if self.vary is None:
            return [{}]
        return [self.vary.draw(self.capture.seed, group) for group in range(self.vary.groups)]


def picture_files(folder: Path) -> tuple[Path, ...]:
    """Return the pictures in a ``folder`` by their names; MitsimError if there are none."""
    if not folder.is_dir():
        raise MitsimError(f"pictures {folder}: is no folder; give one of pictures")
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in PRINTS)
    if not found:
        raise MitsimError(f"pictures {folder}: holds no file that ends in {', '.join(PRINTS)}")
    return tuple(found)


# -------- Trainings

UNROLLED, REFINED, FLATNET, PLUG_AND_PLAY, PREPROCESSED = METHODS = (
    "unrolled", "refined", "flatnet", "plug-and-play", "preprocessed",
)  # fmt: skip
_LARGEST_BATCH, _LONGEST, _LARGEST_WEIGHT = 256, 1_000_000, 100
"""Largest batch, number of steps (ten days of the smallest network on two processors), and weight of a loss beside the
squared error."""
FEWEST_PAIRS, FEWEST_PHOTOGRAPHS = 8, 3
"""Least numbers that can be divided: one photograph teaches, one chooses the best step, and one judges."""


class Schedule(Seeded):
    """Settings of a training."""

    PANEL = QUALITY

    steps: int = option(4000, "of the optimiser", ge=1, le=_LONGEST)
    batch: int = option(4, "pairs a step", ge=1, le=_LARGEST_BATCH)
    rate: float = option(2e-3, "largest learning rate of the cycle", gt=0, le=1)
    device: str = option("cpu", "that torch works on", metavar="NAME", panel=LIMITS)
    feature_weight: float = option(
        0.0, "of differences of features, beside the squared error", ge=0, le=_LARGEST_WEIGHT
    )
    adversary_weight: float = option(0.0, "of what an adversary tells from truths, beside it", ge=0, le=_LARGEST_WEIGHT)


class Training(Schedule):
    """Request of a training."""

    VERB = "train"

    method: str
    """One of :data:`METHODS`."""

    def model_post_init(self, _: object) -> None:
        if self.method not in METHODS:
            near = near_name(str(self.method), METHODS)
            raise MitsimError(f"method {self.method!r}: {near}use {', '.join(METHODS[:-1])} or {METHODS[-1]}")
        for name in ("feature_weight", "adversary_weight"):
            if (value := getattr(self, name)) and self.method == PLUG_AND_PLAY:
                raise ArgumentError(name, f"{value}: {PLUG_AND_PLAY} learns from noise alone; leave it out")
