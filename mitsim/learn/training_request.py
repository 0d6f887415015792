"""How a network is asked to be trained in, a refusal out, before torch is imported."""

from __future__ import annotations

from dataclasses import dataclass

from mitsim.core.errors import ArgumentError, MitsimError, checked_fields, near_name
from mitsim.core.seeds import check_root

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


@checked_fields
@dataclass(frozen=True)
class Training:
    """How a network is trained. MitsimError for what none is trained by.

    Attributes
    ----------
    method
        one of :data:`METHODS`.
    steps, batch
        of the optimiser, and pairs of each of them.
    rate
        largest learning rate of the one cycle that the steps go through.
    seed
        root of first weights, order of the pairs and their noise.
    device
        of torch, such as ``cpu`` or ``cuda``.
    feature_weight, adversary_weight
        of the losses of :class:`mitsim.learn.methods.Critic`, beside the logarithm of the squared error.
    """

    method: str
    steps: int = 4000
    batch: int = 4
    rate: float = 2e-3
    seed: int = 0
    device: str = "cpu"
    feature_weight: float = 0.0
    adversary_weight: float = 0.0

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            near = near_name(str(self.method), METHODS)
            raise MitsimError(f"method {self.method!r}: {near}use {', '.join(METHODS[:-1])} or {METHODS[-1]}")
        for name, most in (("steps", _LONGEST), ("batch", _LARGEST_BATCH)):
            value = getattr(self, name)
            if not 1 <= value <= most:
                raise ArgumentError(name, f"{value}: give a whole number, 1 to {most}")
        check_root(self.seed)
        if not 0 < self.rate <= 1:
            raise ArgumentError("rate", f"{self.rate}: give a number above 0, at most 1")
        for name in ("feature_weight", "adversary_weight"):
            value = getattr(self, name)
            if not 0 <= value <= _LARGEST_WEIGHT:
                raise ArgumentError(name, f"{value}: give a number, 0 to {_LARGEST_WEIGHT}")
            if value and self.method == PLUG_AND_PLAY:
                raise ArgumentError(name, f"{value}: {PLUG_AND_PLAY} learns from noise alone; leave it out")
