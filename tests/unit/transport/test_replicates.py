"""Light of independent seeds, however its paths are launched."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.bench import effects
from mitsim.light.passes import Simulation
from mitsim.light.settings import Settings
from mitsim.transport.integrator import Tracer
from mitsim.transport.records import PathSamples

pytestmark = pytest.mark.usefixtures("variant")
SEEDS = (7, 2**32 - 1, 11)
_TRACER = {"shared": "indirect"}
GLOSSY = """<emitter type="constant"><spectrum name="radiance" value="0.02"/></emitter>
    <shape type="sphere"><point name="center" x="-25" y="10" z="330"/> <float name="radius" value="30"/>
        <bsdf type="roughconductor"><float name="alpha" value="0.3"/></bsdf></shape>"""


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path], variant: str) -> Bench:
    return open_bench(shared_scene("looks", extra=GLOSSY), variant)


def alike(one: PathSamples, other: PathSamples) -> bool:
    """Whether two have the same entries, light to rounding; those of a launch stand kind by kind, so in another
    order."""
    names = ("value", "inverse_depth", "column", "row", "anchor_column", "anchor_row", "kind", "pixel")
    found = []
    for light in (one, other):
        columns = [getattr(light, name) for name in names]
        found.append([column[np.lexsort(columns)] for column in columns])
    (value, *places), (expected, *others) = found
    same = all(np.array_equal(*pair) for pair in zip(places, others, strict=True))
    return same and np.allclose(value, expected, rtol=1e-6, atol=0)


@pytest.mark.parametrize(
    "name", ["direct", "anchored", "indirect", pytest.param("at anchors", marks=pytest.mark.slow), "from_camera"]
)
def test_light_does_not_hang_on_how_paths_are_launched(
    bench: Bench, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Launches of one sample and a part, of each seed that a generator takes; another seed finds other light, and later
    samples are what the first ones leave. (Planted: every launch begins with the first sample; the first one that is
    asked for not heeded.)"""
    settings = Settings(depth=bench.geometry.scene_distance, effects=frozenset(effects.present(bench)))
    simulation = Simulation(bench, replace(settings, anchors=2, followed_anchors=2))
    tracer = simulation.at_anchors[0] if name == "at anchors" else getattr(simulation, name)
    whole = [tracer.trace(seed, 0, 3) for seed in SEEDS]
    monkeypatch.setattr(Tracer, "paths_per_launch", 5 * 64)
    assert whole[0].value.size and not alike(whole[0], whole[1])
    for seed, found in zip(SEEDS, whole, strict=True):
        assert alike(found, tracer.trace(seed, 0, 3))
    assert alike(whole[0], PathSamples.join([tracer.trace(SEEDS[0], 0, 1), tracer.trace(SEEDS[0], 1, 2)]))


@pytest.mark.parametrize(
    "name",
    [
        *("direct", "indirect"),
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("anchored", "shared", "at anchors", "from_camera")),
    ],
)
def test_replicates_in_one_kernel_are_what_each_seed_traces(
    bench: Bench, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of each seed the first sample and the first three, in launches that end within a seed's samples. (Planted: every
    part begins with the first seed's; samples that go on from seed to seed; connections counted as paths.)"""
    settings = Settings(depth=bench.geometry.scene_distance, effects=frozenset(effects.present(bench)))
    simulation = Simulation(bench, replace(settings, anchors=2, followed_anchors=2, shared=name == "shared"))
    tracer = simulation.at_anchors[0] if name == "at anchors" else getattr(simulation, _TRACER.get(name, name))
    monkeypatch.setattr(type(tracer), "paths_per_launch", 5 * 64)
    for first in (0, 2):
        of_one, of_all = tracer.replicates(SEEDS, 1, 3, first=first)
        assert all(replicate.value.size for replicate in of_all)
        for samples, replicates in ((1, of_one), (3, of_all)):
            for seed, found in zip(SEEDS, replicates, strict=True):
                assert alike(found, tracer.trace(seed, first, samples))


def test_replicates_have_the_light_of_all_wavelengths(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each is traced alone where glass parts them. (Planted: lanes counted on from one wavelength to the next; sums of
    one wavelength.)"""
    tracer = Simulation(bench, Settings(depth=bench.geometry.scene_distance)).direct
    monkeypatch.setattr(Tracer, "per_wavelength", property(lambda self: [self, self]))
    for samples, replicates in zip((1, 2), tracer.replicates(SEEDS, 1, 2), strict=True):
        for seed, found in zip(SEEDS, replicates, strict=True):
            assert alike(found, tracer.trace(seed, 0, samples))
    sums, found = tracer.sums(SEEDS[0], 2), tracer.trace(SEEDS[0], 0, 2)
    assert np.allclose(sums.ravel(), np.bincount(found.pixel, found.value, sums.size), rtol=1e-6)
