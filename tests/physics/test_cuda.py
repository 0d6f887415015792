"""A GPU finds the light that the processor finds: the same code under ``cuda_ad_mono`` and ``llvm_ad_mono``.

Rationale. Random numbers, paths and bookkeeping are of the variant's own types, so both backends follow the same paths
but for float32's last digits (a GPU's reciprocals are approximate). The direct light of a flat sheet, of which no ray
passes an edge, agrees to 1e-5 of the total; frames, and light that goes between walls, whose paths may part at an edge,
within five times the Monte Carlo error that they state. On the GPU itself a seed gives the same factored frame twice,
bit for bit: light is added up in whole numbers, or on the host, and so are the normals of a mesh that has none.

Each backend runs in a process of its own. The slow test needs no GPU: the processor with another seed stands in for it,
which shows that the check passes on equal light, and that it fails on 2 % of planted light.
"""

import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tests.unit.scene.test_meshes import write_mesh

SIGMAS, FLOAT = 5.0, 1e-5
WALL = """<shape type="rectangle"><transform name="to_world">
    <scale x="64" y="30"/> <rotate x="1" angle="-90"/> <translate y="-50" z="370"/></transform>
    <bsdf type="twosided"><bsdf type="diffuse"><spectrum name="reflectance" value="0.8"/></bsdf></bsdf></shape>"""
BUMPS = """<shape type="ply"><string name="filename" value="bumps.ply"/>
    <transform name="to_world"><scale x="40" y="40" z="10"/> <translate x="-20" y="-20" z="340"/></transform>
    <bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>"""
BOUNCES = '<integer name="max_depth" value="-1"/>'
PROGRAM = """
import sys
from pathlib import Path
import numpy as np
from mitsim.api.bench import open_bench
variant, seed, target = sys.argv[1], int(sys.argv[2]), sys.argv[3]
found = {}
for path in map(Path, sys.argv[4:]):
    bench = open_bench(path, variant)
    from mitsim.transport.direct import DirectTracer
    tracer = DirectTracer(bench.setup, 1)
    found[f"{path.stem} total"] = tracer.trace(0, 0, 64).value.sum()
    forced = {"diffraction": False, "black-level": False, "interreflection": path.stem == "walls"}
    for name in ("reference", "factored"):
        result = bench.render(name, 64, accuracy=3e-3, seed=seed, effects=forced if name == "factored" else {})
        found[f"{path.stem} {name}"], found[f"{path.stem} {name} error"] = result.mean, result.mc_error
np.savez(target, **found)
"""
Light = dict[str, np.ndarray]
Trace = Callable[..., Light]


@pytest.fixture(scope="module")
def traced(shared_scene: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Trace:
    """Light that a variant and a seed find in two scenes: totals, frames and their relative errors."""
    folder = tmp_path_factory.mktemp("backends")
    scenes = [shared_scene("sheet"), shared_scene("walls", extra=WALL, integrator_options=BOUNCES)]
    scenes.append(shared_scene("bumps", extra=BUMPS))
    write_mesh(scenes[-1].parent / "bumps.ply", 60)

    @cache
    def get(variant: str, seed: int, run: int = 0) -> Light:
        target = folder / f"{variant}-{seed}-{run}.npz"
        command = [sys.executable, "-c", PROGRAM, variant, str(seed), str(target), *map(str, scenes)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        with np.load(target) as arrays:
            return dict(arrays)

    return get


def differences(one: Light, other: Light) -> list[str]:
    """What of two backends' light differs by more than it may."""
    found = []
    for name, light in one.items():
        if name.endswith("total"):
            allowed = FLOAT if name.startswith("sheet") else 1e-3
        elif name.endswith("error"):
            continue
        else:
            allowed = SIGMAS * float(np.hypot(one[f"{name} error"], other[f"{name} error"]))
            # A frame's error counts its pixels; its sum is known better.
            mean = allowed / (light.size**0.5 if name.endswith("reference") else 1)
            off = abs(float(other[name].mean() / light.mean()) - 1)
            found += [f"{name}: mean off by {off:.1e} of {mean:.1e}"] if off > mean * light_spread(light) else []
        off = float(np.linalg.norm(other[name] - light) / np.linalg.norm(light))
        found += [f"{name}: off by {off:.1e} of {allowed:.1e}"] if off > allowed else []
    return found


def light_spread(frame: np.ndarray) -> float:
    """Norm over the mean's share of it: an error relative to the norm, relative to the mean."""
    return float(np.sqrt(np.square(frame).mean()) / frame.mean())


def has_gpu() -> bool:
    """As a child sees it: Dr.Jit must not be imported here before an LLVM is chosen for the other tests."""
    program = "import drjit; print(drjit.has_backend(drjit.JitBackend.CUDA))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=600, check=True)
    return done.stdout.split()[-1] == "True"


def test_a_gpu_finds_the_light_that_the_processor_finds(traced: Trace) -> None:
    if not has_gpu():
        pytest.skip("no NVIDIA GPU: Dr.Jit has no CUDA backend on this machine")
    on_gpu = traced("cuda_ad_mono", 0)
    assert not differences(traced("llvm_ad_mono", 0), on_gpu)
    again = traced("cuda_ad_mono", 0, 1)
    for name in ("sheet factored", "walls factored", "bumps factored"):
        assert np.array_equal(on_gpu[name], again[name]), "a seed's frame differs from itself"


@pytest.mark.slow
def test_the_check_passes_equal_light_and_fails_on_two_percent(traced: Trace) -> None:
    one, other = traced("llvm_ad_mono", 0), traced("llvm_ad_mono", 1)
    assert not differences(one, other)
    for name in one:
        if not name.endswith("error"):
            assert differences(one, {**other, name: 1.02 * other[name]}), name
