"""A tracer is one kernel, whatever it is told: numbers of paths, anchors and pixels are data, not code.

Not so the number of objects of all scenes that are open: Dr.Jit (1.5.0) writes it into every call of one.

(Planted: ``dr.mean`` in `panchromatic`, which writes the number of lanes into the kernel; a sensor's centre without the
table of anchors; literal numbers of the projector's window.)
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.bench import effects
from mitsim.devices.patterns import Lighting
from mitsim.light.passes import Simulation
from mitsim.light.settings import Settings
from mitsim.transport import integrator
from mitsim.transport.connect import SensorPoints
from mitsim.transport.direct import DirectTracer, FluxTracer
from mitsim.transport.from_camera import FromCameraTracer
from mitsim.transport.integrator import IndirectTracer, Paths, Tracer
from mitsim.transport.records import PathSamples

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


# -------- kernels

SHINY = """<shape type="sphere"><point name="center" x="0" y="0" z="380"/><float name="radius" value="6"/>
    <bsdf type="roughconductor"><float name="alpha" value="0.2"/></bsdf></shape>"""
LAMP = '<emitter type="point"><point name="position" x="-60" y="30" z="50"/><rgb name="intensity" value="3"/></emitter>'
PATHS = Paths(interreflection=True)


@pytest.fixture
def kernels(monkeypatch: pytest.MonkeyPatch, variant: str) -> Iterator[Callable[[Tracer, int], set[str]]]:
    """Kernels, by the hash of their text, that trace so many samples of a tracer."""
    monkeypatch.setattr(integrator, "compiled_kernels", lambda: None)  # which would take the history

    def launched(tracer: Tracer, samples: int) -> set[str]:
        tracer.trace(5, 0, 1)  # what is prepared once
        dr.kernel_history_clear()
        tracer.trace(5, 0, samples)
        return {launch["hash"] for launch in dr.kernel_history([dr.KernelType.JIT])}

    yield launched
    dr.kernel_history_clear()


def open_scene(scene: Callable[..., Path], name: str, **numbers: object) -> Bench:
    return open_bench(scene(name, extra=SHINY + LAMP, **numbers))


def points_of(bench: Bench, *choices: tuple[int, bool]) -> list[SensorPoints]:
    return [SensorPoints(bench.geometry.half_width, anchors, spread) for anchors, spread in choices]


def test_direct_light_is_one_kernel(
    small_scene: Callable[..., Path], kernels: Callable[[Tracer, int], set[str]]
) -> None:
    bench, found = open_scene(small_scene, "one", n=6), set()
    for anchors, spread, pixels in ((1, False, None), (1, True, None), (3, False, None), (5, False, np.arange(7))):
        for samples in (1, 3):
            found |= kernels(DirectTracer(bench.setup, anchors, spread, pixels), samples)
    assert len(found) == 1


def test_light_over_several_surfaces_is_one_kernel_to_a_point_and_one_to_anchors(
    small_scene: Callable[..., Path], kernels: Callable[[Tracer, int], set[str]]
) -> None:
    bench = open_scene(small_scene, "one", n=6)
    centre, spread, three, four = points_of(bench, (1, False), (1, True), (3, False), (4, False))
    to_point = [kernels(IndirectTracer(bench.setup, PATHS, point), n) for point, n in ((centre, 1), (spread, 3))]
    assert len(set().union(*to_point)) == 1
    # And a small one that unpacks them.
    to_anchors = [kernels(IndirectTracer(bench.setup, PATHS, points), n) for points, n in ((three, 1), (four, 2))]
    assert len(set().union(*to_anchors)) == 2


def test_another_projector_is_no_other_kernel(
    small_scene: Callable[..., Path], kernels: Callable[[Tracer, int], set[str]]
) -> None:
    """Its window, that is: what Mitsuba knows of it is Mitsuba's."""
    bench = open_scene(small_scene, "one", n=6)
    grid = Simulation(bench, Settings(bench.geometry.scene_distance)).aim
    part = replace(bench.setup.projector, n=5, first_row=0.5, first_column=6.25, share=0.9)
    direct, camera = set(), set()
    for setup in (bench.setup, replace(bench.setup, projector=part)):
        direct |= kernels(DirectTracer(setup, 1), 1)
        camera |= kernels(FromCameraTracer(setup, grid, PATHS), 1)
    assert len(direct) == len(camera) == 1


# -------- Light of independent seeds
#
# Light of independent seeds, however its paths are launched.

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
