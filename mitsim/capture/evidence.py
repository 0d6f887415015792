"""What is simulated, and what a short look at a scene measured: what pilot, plan and tracers have in common."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from mitsim.capture.effects import names

_FEWEST_SAMPLES = 1e-3
"""Samples of light without noise: next to none, and above 0 because costs are ratios."""
GROUPS = 8
"""Independent estimates of the light: eight tell their spread, the Monte Carlo error, to a quarter (1 / sqrt(14))."""


@dataclass(frozen=True)
class Settings:
    """What is simulated, and how finely.

    Attributes
    ----------
    depth
        where the light is seen, 1 / mean(1/z) [mm]; the cells are aligned with the projector's pixels there.
    anchors
        points a side of the sensor from which radiance is evaluated.
    layers
        depths [mm], far to near, between which light is split; one for a flat scene.
    subdivision
        cells a side of a projector pixel.
    effects
        names of those that are simulated (:mod:`mitsim.capture.effects`).
    direct_samples, anchored_samples, indirect_samples, from_camera_samples
        samples that each group is predicted to need: a projector pixel of direct light, of its differences between
        anchors, and of indirect light; a cell of what is followed from the camera.
    coarse_cells, coarse_layers
        cells a side of a projector pixel for what anchors see beyond their mean and for indirect light, and whether
        they have all layers or one.
    """

    depth: float
    anchors: int = 1
    layers: tuple[float, ...] = ()
    subdivision: int = 1
    effects: frozenset[str] = frozenset()
    direct_samples: float = 1.0
    anchored_samples: float = 1.0
    indirect_samples: float = 1.0
    from_camera_samples: float = 1.0
    coarse_cells: int = 1
    coarse_layers: bool = False

    @property
    def depths(self) -> tuple[float, ...]:
        """Depth of each layer [mm]; the one depth of a flat scene."""
        return self.layers or (self.depth,)


@dataclass(frozen=True)
class Noise:
    """Monte Carlo error of one estimate: ``error`` at ``samples`` a cell, falling with samples^-rate."""

    error: float
    samples: float
    rate: float

    def samples_for(self, target: float) -> float:
        """Samples a cell at which the error is ``target``."""
        return self.samples * (self.error / target) ** (1 / self.rate) if self.error > 0 else _FEWEST_SAMPLES


@dataclass(frozen=True)
class Effort:
    """What one kind of light takes: its noise relative to all light, paths in a sample, and seconds a path."""

    noise: Noise
    paths: int
    seconds: float

    @classmethod
    def none(cls) -> Effort:
        """Of light that there is none of."""
        return cls(Noise(0.0, 1, 0.5), 0, 0.0)

    @property
    def cost(self) -> float:
        """Seconds a sample."""
        return self.paths * self.seconds

    @property
    def variance(self) -> float:
        """Relative variance of one sample, where the error falls with the square root of their number."""
        return self.noise.samples * self.noise.error**2


@dataclass(frozen=True)
class Evidence:
    """What a short look at the scene measured (:mod:`mitsim.capture.pilot`); all errors are relative.

    Attributes
    ----------
    depth, layers
        depth of the light [mm]; candidates for the layers' depths, by their number.
    anchor_error, layer_error
        error of the frames by anchors a side, and by number of layers.
    cell_error
        by cells a side of a projector pixel.
    effect_error
        error of leaving out each effect that the bench has.
    direct_part
        direct light in all light.
    direct, anchored, indirect, from_camera
        what direct light takes, its differences between anchors (paths: to one of them), light over several surfaces,
        and what is followed from the camera.
    seconds_per_frame
        of forming a frame with one anchor, one layer, a wave-optical shadow and a cell a projector pixel.
    terms
        terms of the shadow, wave-optical over geometric.
    unresolved
        part of the direct light in lobes that sampling would miss (:mod:`mitsim.transport.lobes`).
    left_out
        light that no tracer finds, over that and direct light (:mod:`mitsim.transport.left_out`).
    """

    depth: float
    layers: Mapping[int, tuple[float, ...]]
    anchor_error: Mapping[int, float]
    layer_error: Mapping[int, float]
    cell_error: Mapping[int, float]
    effect_error: Mapping[str, float]
    direct_part: float
    direct: Effort
    anchored: Effort
    indirect: Effort
    from_camera: Effort
    seconds_per_frame: float
    terms: float
    unresolved: float = 0.0
    left_out: float = 0.0

    def connecting(self, settings: Settings, anchors: int) -> float:
        """Seconds of direct light in the samples of ``settings``, and of its differences between ``anchors`` a side."""
        differences = settings.anchored_samples * anchors**2 * self.anchored.cost if anchors > 1 else 0.0
        return GROUPS * (settings.direct_samples * self.direct.cost + differences)

    def following(self, settings: Settings) -> float:
        """Seconds of all other light in the samples of ``settings``; none when no effect calls for it."""
        if not settings.effects & names(lambda effect: effect.followed):
            return 0.0
        indirect = settings.indirect_samples * self.indirect.cost
        return GROUPS * (indirect + settings.from_camera_samples * self.from_camera.cost)
