"""While kernels are put together, Python's collector frees no scene: Dr.Jit counts the objects of all that are there.

(Planted: a collector that goes on; one that is not set going again.)
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import open_bench
from mitsim.devices.patterns import Lighting
from mitsim.light.settings import Settings
from mitsim.light.simulation import Simulation
from mitsim.transport.direct import FluxTracer

RECORDING = {"load_scene", "_launch", "sums", "highlights", "board"}
"""Functions whose calls of scenes make kernels."""


@pytest.fixture
def collections() -> Iterator[list[set[str]]]:
    """Names of the functions that ran when the collector did, which it now does all the time."""
    found: list[set[str]] = []

    def note(phase: str, info: object) -> None:
        frame, names = sys._getframe(1), set()
        while frame is not None:
            if "mitsim" in frame.f_code.co_filename:
                names.add(frame.f_code.co_name)
            frame = frame.f_back
        found.append(names)

    usual = gc.get_threshold()
    gc.callbacks.append(note)
    gc.set_threshold(1)
    yield found
    gc.set_threshold(*usual)
    gc.callbacks.remove(note)


def test_nothing_is_collected_while_light_is_traced(
    small_scene: Callable[..., Path], variant: str, collections: list[set[str]]
) -> None:
    bench = open_bench(small_scene(n=4))
    simulation = Simulation(bench, Settings(bench.geometry.scene_distance, effects=frozenset({"interreflection"})))
    labels = Lighting.uniform(bench.n).labels
    for name in ("direct", "indirect"):
        simulation.accumulate(name, simulation.passes[name].tracer.trace(3, 0, 2), labels, 2)
    FluxTracer(bench.setup).sums(3, 1, np.arange(4), np.zeros(4, np.int64), 2)
    bench.render(spp=8)
    assert len(collections) > 100 and not set().union(*collections) & RECORDING
