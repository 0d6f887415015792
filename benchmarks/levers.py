"""What each way of following less light to the same error gains: variance times seconds, alone and together.

    python benchmarks/levers.py --json FILE [--scene NAME ...] [--groups 8] [--samples 64] [--repeat 3]

For each scene its plan at 1e-3 says which cells, layers and anchors there are. Then its indirect and its direct light
are traced and accumulated with each lever on, alone and together, in eight independent groups of the same seeds, in
turn; variance is that of the frames of that light, by groups (good to some 10 % here), seconds the sum over the groups,
the least of ``--repeat`` rounds. Both, and their product, are over those without levers: below 1 is a gain, at equal
error.

- device: light is added up where it is traced, not on the host;
- repeats: blocks of pixels whose light is noisy are followed more often;
- shared: neighbouring pixels share their second points;
- even: points of the sensor are as even as those of the pixels, of direct light that has several anchors.

The pilot of a plan chooses `shared` and `repeats` by what it measures itself; the others are always on.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np

import mitsim as ms
from mitsim.api.bench import Bench
from mitsim.devices.patterns import PatternFamily, parse_patterns
from mitsim.light.grids import LightEstimate
from mitsim.light.simulation import Simulation, expected_of
from mitsim.transport.connect import SensorPoints
from mitsim.transport.indirect import adaptive_counts, block_moments
from mitsim.transport.plugins.base import generator
from mitsim.transport.records import INDIRECT

ROOT = Path(__file__).parents[1]
SCENES = ("cookie_bag", "corner", "compact_disc", "gift_card", "metal_blade")
SHOTS = 8
"""Shots whose frames tell the variance."""
SHARED_PATHS = 6
"""A sample of shared light takes as long as several of paths of their own, so fewer are taken."""


@dataclass(frozen=True)
class Way:
    """One way to follow light: what differs from the plan's settings, whether sums are on the device, and even points
    of the sensor; so many of the samples are taken."""

    settings: Mapping[str, Any]
    device: bool = False
    even: bool = True
    part: float = 1.0


def ways(repeats: tuple[int, ...]) -> dict[str, dict[str, Way]]:
    """Ways of each kind of light by name; the first is without levers."""
    plain: dict[str, Any] = {"shared": False, "repeats": ()}
    often, shared = {**plain, "repeats": repeats}, {**plain, "shared": True}
    fewer = 1 / float(np.mean(repeats))
    return {
        "indirect": {
            "none": Way(plain),
            "device": Way(plain, device=True),
            "repeats": Way(often, part=fewer),
            "shared": Way(shared, part=1 / SHARED_PATHS),
            "device + repeats": Way(often, device=True, part=fewer),
            "device + shared": Way(shared, device=True, part=1 / SHARED_PATHS),
            "all": Way({"shared": True, "repeats": repeats}, device=True, part=fewer / SHARED_PATHS),
        },
        "direct": {"none": Way({}, even=False), "even": Way({})},
    }


def repeats_of(simulation: Simulation, samples: int) -> tuple[int, ...]:
    """Paths of each block of pixels in a sample, from a look of its own."""
    assert simulation.indirect is not None
    light = simulation.indirect.trace(2**20, 0, samples)
    light, pixels = light.where(light.kind == INDIRECT), simulation.bench.n
    return tuple(int(count) for count in adaptive_counts(block_moments(light.pixel, light.value, pixels)).ravel())


def traced(
    simulation: Simulation, name: str, labels: np.ndarray, seed: int, samples: int, device: bool
) -> LightEstimate:
    """Light of one group, per sample."""
    accumulator = simulation.accumulator(name, labels, 1) if device else None
    light = simulation.accumulate(name, simulation.passes[name].trace(seed, 0, samples, accumulator), labels, samples)
    for sums in accumulator.fetch() if accumulator else ():
        light = light + simulation.accumulate(name, sums, labels, samples)
    dr.sync_thread()
    return light


EVEN_POINTS = SensorPoints.place


def plain_points(self: SensorPoints, row: Any, column: Any, point: Any) -> Any:
    """Points of the sensor as they were in 0.3.0: random numbers that even ``point`` coordinates are hashed to."""
    rng = generator(*(dr.reinterpret_array(mi.UInt32, part) for part in (point.x, point.y)))
    return EVEN_POINTS(self, row, column, mi.Point2f(rng.next_float32(), rng.next_float32()))


def measured(
    bench: Bench, family: PatternFamily, kind: str, found: Mapping[str, Way], options: argparse.Namespace
) -> dict[str, dict[str, float]]:
    """Variance, seconds and their product of each way of one kind of light, over those of the first."""
    plan = bench.plan("dots:7", accuracy=1e-3)
    labels, lighting = family.lighting.labels, family.lighting
    shots = lighting.shots(np.unique(np.linspace(0, len(lighting.weights) - 1, SHOTS).astype(int)))
    rows, lights = np.arange(lighting.weights.shape[1]), {name: [] for name in found}
    seconds: dict[str, list[float]] = {name: [0.0] * options.repeat for name in found}
    simulations = {name: Simulation(bench, replace(plan.settings, **way.settings)) for name, way in found.items()}
    for turn in range(-1, options.repeat):
        for group in range(options.groups):
            for name, way in found.items():
                samples = max(1, round(options.samples * way.part))
                with mock.patch.object(SensorPoints, "place", EVEN_POINTS if way.even else plain_points):
                    assert kind in simulations[name].passes, "prepared before the clock starts"
                    started = time.perf_counter()
                    light = traced(simulations[name], kind, labels, group, samples, way.device)
                if turn >= 0:
                    seconds[name][turn] += time.perf_counter() - started
                else:
                    # The first turn, not counted, compiles the kernels.
                    lights[name].append(light)
    errors = {
        name: expected_of([(simulations[name], light)], rows, shots, 0, leaking=False).sampling_error()[0]
        for name, light in lights.items()
    }
    first, *_ = found
    result = {}
    for name in found:
        variance, taken = (errors[name] / errors[first]) ** 2, min(seconds[name]) / min(seconds[first])
        result[name] = {"variance": variance, "seconds": taken, "product": variance * taken, "error": errors[name]}
    return result


def table(results: Mapping[str, Any]) -> str:
    """For people, in Markdown."""
    lines = ["| scene | light | lever | variance | seconds | product |", "|---|---|---|---|---|---|"]
    for scene, kinds in results["scenes"].items():
        for kind, found in kinds.items():
            lines += [
                f"| {scene} | {kind} | {name} | {row['variance']:.2f} | {row['seconds']:.2f} | {row['product']:.2f} |"
                for name, row in found.items()
            ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--scene", action="append", default=[], metavar="NAME")
    parser.add_argument("--groups", type=int, default=8)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    results: dict[str, Any] = {"machine": platform.processor() or platform.machine(), "scenes": {}}
    for name in options.scene or SCENES:
        bench = ms.open_bench(ROOT / "scenes" / name / "scene.xml")
        family = parse_patterns("dots:7", bench.n)
        simulation = Simulation(bench, bench.plan("dots:7", accuracy=1e-3).settings)
        repeats = repeats_of(simulation, options.samples) if simulation.indirect else (1,)
        results["scenes"][name] = {
            kind: measured(bench, family, kind, found, options)
            for kind, found in ways(repeats).items()
            if kind in simulation.passes and (kind != "direct" or simulation.settings.anchors > 1)
        }
        options.json.write_text(json.dumps(results, indent=1) + "\n")
    print(table(results))


if __name__ == "__main__":
    main()
