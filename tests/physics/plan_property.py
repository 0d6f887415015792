"""Total error of frames, measured apart from the plan that chose how they are made: bench in, error and bounds out.

The answer is light of other seeds with every effect that the scene has, more anchors, layers and cells than the plan
asked for, in GROUPS independent groups. With a the frames and r_i, r_j two of the groups, the mean of
<a - r_i, a - r_j> / <r_i, r_j> is the squared relative error of a, free of the answer's noise; its standard error is
the jackknife's over groups. The frames of both are formed by the simulation, but judged on shots that the pilot does
not look at.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from mitsim.acquire.exposure import Totals
from mitsim.api.bench import Bench
from mitsim.bench import effects
from mitsim.core.arrays import integer
from mitsim.devices.patterns import Lighting
from mitsim.light.light import Sampling, trace_light
from mitsim.light.passes import Simulation, expected_of
from mitsim.light.plan import Plan
from mitsim.light.settings import Estimate, Settings

GROUPS = 6
STUDENT = 2.02
"""One-sided 95 % of Student's distribution with GROUPS - 1 degrees of freedom."""


@dataclass(frozen=True)
class SampleWork:
    """Samples of one group, a projector pixel of direct light, a pixel or a cell of other light; numbers a side."""

    direct: int
    other: int
    anchors: int = 5
    followed_anchors: int = 3
    layers: int = 8
    cells: int = 4


@dataclass(frozen=True)
class Error:
    """Relative error, and the bounds that it stays within at 95 % each."""

    size: float
    low: float
    high: float


def answer(bench: Bench, shots: Lighting, depth: float, seed: int, sample_work: SampleWork) -> np.ndarray:
    """(groups, shots, pixels, pixels) frames with all that ``bench`` has, all ``depth`` [mm] of the light in layers."""
    names = frozenset(effects.present(bench)) - {"speckle"}
    base = Settings(depth, subdivision=sample_work.cells, effects=names, coarse_layers=True)
    base = replace(base, followed_anchors=sample_work.followed_anchors)
    settings = replace(base, anchors=sample_work.anchors, layers=_layers(bench, base, seed, sample_work.layers))
    simulation = Simulation(bench, settings, judging_cells=2)
    counts = {"direct": sample_work.direct, "anchor_residual": max(1, sample_work.direct // 4)}
    groups = []
    for group in range(GROUPS):
        parts = [
            simulation.accumulate(name, each.tracer.trace(integer(seed, name, group), 0, count), shots.labels, count)
            for name, each in simulation.passes.items()
            for count in [counts.get(name, sample_work.other)]
        ]
        groups.append(sum(parts[1:], parts[0]))
    rows = np.arange(shots.weights.shape[1])
    formed = [expected_of([(simulation, [group])], rows, shots, 0) for group in groups]
    return np.array([[frame.irradiance for frame in frames] for frames in formed])


def _layers(bench: Bench, base: Settings, seed: int, count: int) -> tuple[float, ...]:
    """Depths over the whole range that light is seen at; none for a flat scene."""
    simulation, own = Simulation(bench, base), integer(seed, "range")
    near = np.append(simulation.direct.trace(own, 0, 8).inverse_depth, simulation.follow(own, 8).inverse_depth)
    low, high = max(float(near.min()), 1e-4 / base.depth), float(near.max())
    return () if high < low * (1 + 1e-4) else tuple(1 / np.linspace(low, high, count))


def planned(bench: Bench, plan: Plan, shots: Lighting, seed: int) -> tuple[np.ndarray, Estimate]:
    """(shots, pixels, pixels) frames that ``plan`` makes, and their relative Monte Carlo error with its bound."""
    light = trace_light(bench, plan, shots, seed, Sampling(by_pixel=False))
    expected = list(light.frames(shots, seed))
    return np.stack([frame.irradiance for frame in expected]), Totals.of(expected).noise


def total_error(frames: np.ndarray, groups: np.ndarray) -> Error:
    """Error of ``frames`` against the answer's ``groups``."""
    differences, answers = (frames - groups).reshape(len(groups), -1), groups.reshape(len(groups), -1)
    products, energies = differences @ differences.T, answers @ answers.T

    def squared(kept: list[int]) -> float:
        pairs = np.ix_(kept, kept)
        off = ~np.eye(len(kept), dtype=bool)
        return float(products[pairs][off].mean() / energies[pairs][off].mean())

    everyone = list(range(len(groups)))
    found = squared(everyone)
    without = np.array([squared([i for i in everyone if i != out]) for out in everyone])
    spread = math.sqrt((len(without) - 1) * float(np.square(without - without.mean()).mean()))
    low, size, high = (math.sqrt(max(found + sign * STUDENT * spread, 0.0)) for sign in (-1, 0, 1))
    return Error(size, low, high)
