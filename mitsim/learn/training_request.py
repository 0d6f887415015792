"""How a network is asked to be trained in, a refusal out, before torch is imported."""

from __future__ import annotations

from mitsim.bench.request import Seeded, SeedKeys
from mitsim.core.configuration import LIMITS, QUALITY, option
from mitsim.core.errors import ArgumentError, MitsimError, near_name

UNROLLED, REFINED, FLATNET, PLUG_AND_PLAY, PREPROCESSED = METHODS = (
    "unrolled",
    "refined",
    "flatnet",
    "plug-and-play",
    "preprocessed",
)
"""Names of the classes of :mod:`mitsim.learn.methods`."""
_LARGEST_BATCH = 256
"""Pairs a step: thirty times what is usual; chosen so that a slip of the keyboard is refused."""
_LONGEST = 1_000_000
"""Steps: ten days of the smallest network on two processors; chosen as the batch is."""
_LARGEST_WEIGHT = 100
"""Of a loss beside the squared error: then that counts for nothing; chosen so."""
FEWEST_PAIRS = 8
"""Fewer cannot be parted into those that teach and those that judge; chosen so."""
FEWEST_PHOTOGRAPHS = 3
"""One that teaches, one that chooses the best step, and one that judges."""


class Schedule(Seeded):
    """How a network is trained."""

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
    """Which network is trained, and how."""

    VERB = "train"

    method: str
    """One of :data:`METHODS`."""

    def model_post_init(self, _: object) -> None:
        """Refuse what no network is trained by."""
        if self.method not in METHODS:
            near = near_name(str(self.method), METHODS)
            raise MitsimError(f"method {self.method!r}: {near}use {', '.join(METHODS[:-1])} or {METHODS[-1]}")
        for name in ("feature_weight", "adversary_weight"):
            if (value := getattr(self, name)) and self.method == PLUG_AND_PLAY:
                raise ArgumentError(name, f"{value}: {PLUG_AND_PLAY} learns from noise alone; leave it out")


class TrainingKeys(SeedKeys, total=False):
    """Keywords of :class:`Schedule`."""

    steps: int
    batch: int
    rate: float
    device: str
    feature_weight: float
    adversary_weight: float
