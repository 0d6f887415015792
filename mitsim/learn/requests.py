"""Requests for pairs and for trainings, checked or refused in one line, without an import of numpy or torch."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field, field_validator

from mitsim.bench.request import Exposure, Request, Seeded
from mitsim.core.configuration import LIMITS, QUALITY, Configuration, FilePath, Options, load_model, option, validate
from mitsim.core.errors import ArgumentError, MitsimError, near_name
from mitsim.core.picture_files import picture_files
from mitsim.devices.session import Drift

# -------- Pairs

MOST_PAIRS = 10**6


def _least_first(limits: tuple[float, float]) -> tuple[float, float]:
    if limits[0] > limits[1]:
        raise ValueError(f"got [{limits[0]:g}, {limits[1]:g}]; give the least number first")
    return limits


Between = Annotated[tuple[float, float], Field(strict=False), AfterValidator(_least_first)]
"""Bounds of an even distribution."""


class Variation(Configuration):
    """Variation of benches, each drawn for an equal part of the pairs."""

    groups: int = Field(ge=1, le=10_000)
    """Benches."""
    exposure_fraction: Between | None = None
    """Brightest pixel, as a part of full well: the level of noise."""
    mask: dict[str, Between] = Field(default={})
    """How the mask has moved, by fields of a drift, as `mask_rows_um`."""

    @field_validator("mask")
    @classmethod
    def _of_a_mask(cls, value: dict[str, Between]) -> dict[str, Between]:
        known = [name for name in Drift.model_fields if name.startswith("mask_")]
        for name, limits in value.items():
            if name not in known:
                raise ValueError(f"{name!r} is no motion of a mask; known are {', '.join(known)}")
            for limit in limits:
                validate(Drift, {name: limit}, "vary: [mask]")
        return value

    def draw(self, seed: int, group: int) -> dict[str, float]:
        """Return the drawn numbers of bench number ``group``: `exposure_fraction`, and `mask.` with a field's name."""
        from mitsim.core.seeds import stream

        rng, ranges = stream(seed, "bench", group), {f"mask.{name}": limits for name, limits in self.mask.items()}
        if self.exposure_fraction is not None:
            ranges["exposure_fraction"] = self.exposure_fraction
        return {name: float(rng.uniform(*limits)) for name, limits in sorted(ranges.items())}


class PairOptions(Options):
    VERB = "make_pairs"

    count: int = option(..., "number of pairs to make", metavar="N", ge=1, le=MOST_PAIRS)
    pictures: FilePath | None = option(
        None, "folder of pictures; by default mitsim draws its own", metavar="FOLDER", kind=Path
    )
    vary: Variation | None = option(
        None,
        "file that varies exposure and mask from one group of pairs to the next",
        metavar="FILE.toml",
        kind=Path,
        read=lambda path: load_model(path, Variation),
    )


class PairsRequest(PairOptions):
    capture: Request
    """Request of each pair's frames; its seed is the root of all streams."""

    def model_post_init(self, _: object) -> None:
        capture, vary = self.capture, self.vary
        if capture.seconds is not None:
            raise ArgumentError("seconds", "pairs share their light; give an accuracy")
        if self.pictures is not None:
            picture_files(Path(self.pictures))
        if vary is None:
            return
        for limit in vary.exposure_fraction or ():
            Exposure(None, limit)
        if vary.groups > self.count:
            raise ArgumentError("vary", f"{vary.groups} groups of {self.count} pairs; give fewer groups or more pairs")
        if vary.exposure_fraction and capture.exposure != "auto":
            raise ArgumentError("exposure", f"{capture.exposure}: exposure_fraction varies; leave out one of both")


# -------- Trainings

UNROLLED, REFINED, FLATNET = METHODS = ("unrolled", "refined", "flatnet")
FEWEST_PAIRS, FEWEST_PHOTOGRAPHS = 8, 3
"""Least numbers that can be divided: one photograph teaches, one chooses the best step, and one judges."""


class Schedule(Seeded):
    """Settings of a training."""

    PANEL = QUALITY

    # A million steps are ten days of the smallest network on two processors.
    steps: int = option(4000, "number of steps of the optimiser", ge=1, le=1_000_000)
    batch: int = option(4, "number of pairs in each step", ge=1, le=256)
    rate: float = option(2e-3, "largest learning rate of the schedule", gt=0, le=1)
    device: str = option("cpu", "device that torch uses, by its name in torch", metavar="NAME", panel=LIMITS)


class Training(Schedule):
    """Request of a training."""

    VERB = "train"

    method: str
    """One of :data:`METHODS`."""

    def model_post_init(self, _: object) -> None:
        if self.method not in METHODS:
            near = near_name(str(self.method), METHODS)
            raise MitsimError(f"method {self.method!r}: {near}use {', '.join(METHODS[:-1])} or {METHODS[-1]}")


def check_torch(needed_by: str = "networks need", extra: str = "learn") -> None:
    """Raise MitsimError if torch, an extra, is not installed."""
    if find_spec("torch") is None:
        raise MitsimError(f"torch is not installed, which {needed_by}; type: pip install 'mitsim[{extra}]'")
