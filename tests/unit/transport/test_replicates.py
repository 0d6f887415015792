"""Independent looks that one kernel follows together are those that single ones find, bit for bit."""

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.bench import effects
from mitsim.light.settings import Settings
from mitsim.light.simulation import Simulation
from mitsim.transport.integrator import Tracer
from mitsim.transport.records import PathSamples

pytestmark = pytest.mark.usefixtures("variant")
SEEDS = (7, 2**32 - 1, 11, 12, 13)
GLOSSY = """<emitter type="constant"><spectrum name="radiance" value="0.02"/></emitter>
    <shape type="sphere"><point name="center" x="-25" y="10" z="330"/> <float name="radius" value="30"/>
        <bsdf type="roughconductor"><float name="alpha" value="0.3"/></bsdf></shape>"""


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path], variant: str) -> Bench:
    return open_bench(shared_scene("looks", extra=GLOSSY), variant)


def alike(one: PathSamples, other: PathSamples) -> bool:
    names = [field.name for field in fields(one) if field.name != "lane"]
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


@pytest.mark.parametrize("launch", [2**22, 3 * 256])
@pytest.mark.parametrize("name", ["direct", "anchored", "indirect", "at anchors", "from_camera"])
def test_looks_together_are_looks_one_by_one(
    bench: Bench, name: str, launch: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four in a launch and one more, or launches that hold too few. (Planted: the sample's number of the first look
    for all of them, the lanes of the look before.)"""
    settings = Settings(depth=bench.geometry.scene_distance, effects=frozenset(effects.present(bench)))
    simulation = Simulation(bench, replace(settings, anchors=2, followed_anchors=2))
    tracer = simulation.at_anchors[0] if name == "at anchors" else getattr(simulation, name)
    monkeypatch.setattr(Tracer, "paths_per_launch", launch)
    together = tracer.trace_replicates(SEEDS, 3)
    assert len(together) == len(SEEDS) and not alike(together[0], together[1])
    for seed, found in zip(SEEDS, together, strict=True):
        assert found.value.size and alike(found, tracer.trace(seed, 0, 3))
