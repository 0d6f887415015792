"""The same seed gives the same bits: whatever the number of threads, the process, the clock, or how work is cut.

Interrupted and resumed runs are bit-equal too: tests/system/test_faults.py, tests/unit/acquire/test_run.py.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from mitsim.api.bench import Bench, open_bench
from mitsim.core import parallel
from mitsim.core.configuration import shipped_path
from mitsim.core.exr import read_frame
from mitsim.light import light
from mitsim.light.light import trace_light
from mitsim.light.settings import GROUPS, REPLICATES, Approximation, ErrorCovariance, Settings
from mitsim.optics import frames as forming
from mitsim.planner import pilot_direct, planner
from mitsim.planner.planner import make_plan
from mitsim.transport.direct import DirectTracer
from tests.physics.judged_scenes import CAMERA_FILE
from tests.robustness import Recorder

pytestmark = [pytest.mark.usefixtures("variant"), pytest.mark.robustness("Reproducibility")]
THREADS = (1, 3, 8)
EFFECTS = {"interreflection": True, "ambient": True}
LAMP_AND_BOX = """
<shape type="sphere"><point name="center" x="-150" y="150" z="100"/><float name="radius" value="20"/>
    <emitter type="area"><spectrum name="radiance" value="5"/></emitter></shape>
<shape type="cube"><transform name="to_world"><scale value="25"/><rotate y="1" angle="30"/><translate z="340"/>
    </transform><bsdf type="diffuse"><spectrum name="reflectance" value="0.8"/></bsdf></shape>"""
CHILD = """
import random, sys, time
import drjit as dr
from mitsim.api.bench import open_bench
from mitsim.core import parallel, job
scene, output, camera, patterns, accuracy, *effects = sys.argv[1:]
bench = open_bench(scene, camera=camera or None, for_render=not camera)
dr.set_thread_count(3)
parallel.workers = lambda: 3
sys.setswitchinterval(1e-5)
rng, now = random.Random(1), 0.0

def clock():
    global now
    now += rng.expovariate(1) * 10.0 ** rng.uniform(-6, 3)
    return now

time.perf_counter = time.monotonic = clock
job.free_memory = lambda: 10.0 ** rng.uniform(11, 13)
bench.capture(patterns, output, accuracy=float(accuracy), seed=3, effects=dict.fromkeys(effects, True))
"""
"""A capture in a process of its own: by three threads that take turns all the time, and by a clock and a memory that
say anything."""


def in_a_child(folder: Path, scene: Path, *rest: str, **variables: str) -> dict[str, object]:
    """:func:`bits` of what ``CHILD`` captures into ``folder``."""
    command = [sys.executable, "-c", CHILD, str(scene), str(folder), *rest]
    subprocess.run(command, check=True, capture_output=True, timeout=400, env=os.environ | variables)
    return bits(folder)


def bits(folder: Path) -> dict[str, object]:
    """SHA-256 of each frame's channels (noisy digital numbers and expected electrons), and all that was planned."""
    found: dict[str, object] = {}
    for path in sorted(folder.glob("*.exr")):
        channels, _ = read_frame(path)
        found[path.name] = hashlib.sha256(b"".join(channels[name].tobytes() for name in sorted(channels))).hexdigest()
    manifest = json.loads((folder / "manifest.json").read_text())
    plan = manifest["plan"]
    errors = {effect["name"]: effect["error_if_off"] for effect in plan["effects"]}
    left = {name: manifest[name] for name in ("mc_error", "heaviest_group", "paths", "digital")}
    return {**found, **left, "settings": plan["settings"], "errors": errors, "target": plan["sampling_target"]}


@pytest.fixture
def threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int], object]]:
    """Sets threads of Dr.Jit, of BLAS and of our own; put back at the end."""
    before = dr.thread_count()

    def limit(count: int) -> object:
        dr.set_thread_count(count)
        monkeypatch.setattr(parallel, "workers", lambda: count)
        return threadpool_limits(count)

    yield limit
    dr.set_thread_count(before)


def runs(
    bench: Bench,
    patterns: str,
    accuracy: float,
    where: Path,
    threads: Callable[[int], object],
    counts: tuple[int, ...] = THREADS,
) -> list[dict]:
    found = []
    for count in counts:
        with threads(count):
            bench.capture(patterns, where / f"run{count}", accuracy=accuracy, seed=3, effects=EFFECTS)
        found.append(bits(where / f"run{count}"))
    return found


def test_frames_do_not_depend_on_threads_or_process(
    small_scene: Callable[..., Path], tmp_path: Path, threads: Callable[[int], object]
) -> None:
    """Direct, indirect and ambient light, sensor noise, plan: one thread, and three in a process of its own, whose
    clock and free memory say anything. (Planted: candidates by unit costs that are measured.)"""
    path = small_scene(extra=LAMP_AND_BOX)
    found = runs(open_bench(path, for_render=True), "hadamard:2", 5e-2, tmp_path, threads, (1,))
    found.append(in_a_child(tmp_path / "child", path, "", "hadamard:2", "5e-2", *EFFECTS))
    assert len([name for name in found[0] if name.startswith("frame_")]) == 8
    assert set(found[0]["settings"]["effects"]) >= set(EFFECTS)
    for other in found[1:]:
        assert {name for name in other if other[name] != found[0][name]} == set()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["photograph", "gift_card", "corner", "cookie_bag"])
def test_neither_do_those_of_shipped_scenes(tmp_path: Path, threads: Callable[[int], object], name: str) -> None:
    """On a sensor of 128 pixels, with a cache of kernels and without."""
    scene, camera = tmp_path / name / "scene.xml", tmp_path / "camera.toml"
    shutil.copytree(shipped_path("scenes", name), scene.parent)
    text = scene.read_text()
    for old, new in (('value="0.01172"', 'value="0.04688"'), ('value="512"', 'value="128"')):
        text = text.replace(old, new)
    scene.write_text(text)
    camera.write_text(CAMERA_FILE)
    bench = open_bench(scene, camera=camera)
    with threads(1):
        bench.capture("dots:3", tmp_path / "run", accuracy=5e-3, seed=3)
    ours, cache = bits(tmp_path / "run"), str(tmp_path / "cache")
    child = in_a_child(tmp_path / "child", scene, str(camera), "dots:3", "5e-3", DRJIT_CACHE_DIR=cache)
    assert {key for key in child if child[key] != ours[key]} == set() and len(ours) > 9


def test_sums_do_not_depend_on_threads_of_blas(measured: Recorder) -> None:
    """Norms and products of the pilot: BLAS's own of so many numbers differ between 1, 2, 3 and 8 threads."""
    a, b = np.random.default_rng(0).random((2, REPLICATES, 300, 300))
    naive, norms, products = set(), set(), set()
    for count in THREADS:
        with threadpool_limits(count):
            naive.add(float(np.vdot(a[0], a[1])))
            norms.add(pilot_direct.norm(a))
            products.add(
                ErrorCovariance.between({Approximation("a"): a, Approximation("b"): b}, 1.0).products.tobytes()
            )
    measured(len(naive), what="answers of BLAS")
    measured(max(len(norms), len(products)), at_most=1, what="ours")


@pytest.mark.parametrize("columns", [100, 20_000, 3 * 2**14 + 5])
def test_mixing_does_not_depend_on_threads(monkeypatch: pytest.MonkeyPatch, columns: int) -> None:
    """49 captures of 49 classes. How a product is cut shows in its last bits, so it is cut at fixed columns."""
    rng = np.random.default_rng(1)
    weights, basis = rng.random((49, 49)), rng.random((49, columns))
    found = set()
    for count in (*THREADS, 5, 7):
        monkeypatch.setattr(parallel, "workers", lambda count=count: count)
        found.add(forming.mix_frames(weights, basis).tobytes())
    assert len(found) == 1
    assert np.allclose(np.frombuffer(found.pop()), (weights @ basis).ravel(), rtol=1e-13, atol=0)


def test_results_keep_their_order_in_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    for count in (*THREADS, 64):
        monkeypatch.setattr(parallel, "workers", lambda count=count: count)
        assert parallel.in_threads(lambda item: item**2, range(100)) == [item**2 for item in range(100)]


def test_the_plan_does_not_depend_on_the_clock(
    small_scene: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seconds are measured and predicted; what is simulated, and how finely, does not hang on them."""
    bench = open_bench(small_scene(), for_render=True)
    family = bench.family("dots:2").lighting
    plans = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        times = iter(np.cumsum(rng.exponential(10.0 ** rng.uniform(-6, 3, 1000))))
        monkeypatch.setattr(planner.time, "perf_counter", lambda times=times: float(next(times)))
        plans.append(make_plan(bench, family, 5e-2, 3))
    first, second = plans
    assert first.predicted_seconds != second.predicted_seconds
    assert (first.settings, first.sampling_target) == (second.settings, second.sampling_target)
    assert first.systematic_error == second.systematic_error


def test_light_does_not_depend_on_how_many_paths_are_held_at_once(
    measured: Recorder, small_scene: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The chunk is a constant, not the machine's; another adds the same light in another order, in single precision.

    (Planted: every chunk the first one's samples. It was not seen while one sample a group was all that there was.)
    """
    bench = open_bench(small_scene("chunks"), for_render=True)
    lighting = bench.family("dots:2").lighting
    plan = make_plan(bench, lighting, 5e-2, 3, {"diffraction": False})
    plan = replace(plan, settings=Settings(plan.settings.depth, samples={"direct": 16}), sampling_target=1e9)
    found, trace, counts = [], DirectTracer.trace, list[int]()
    monkeypatch.setattr(
        DirectTracer, "trace", lambda self, seed, first, count: counts.append(count) or trace(self, seed, first, count)
    )
    for paths_per_sample, at_once in ((light.PATHS_AT_ONCE, 16), (light.PATHS_AT_ONCE, 16), (3 * bench.n**2, 3)):
        monkeypatch.setattr(light, "PATHS_AT_ONCE", paths_per_sample)
        one = trace_light(bench, plan, lighting, 3)
        found.append(np.stack([frame.irradiance for frame in one.frames(lighting, 3)]))
        assert max(counts) == at_once and sum(counts) == 16 * GROUPS
        counts.clear()
    assert np.array_equal(found[0], found[1])
    measured(np.linalg.norm(found[2] - found[0]) / np.linalg.norm(found[0]), at_most=1e-7)
