"""The table of passes: adding one is its row, its integrator and its test, and nothing else."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mitsim
from mitsim.light.passes import GRIDS, PASSES, table_of
from mitsim.light.settings import Settings
from tests.exchanged import frame_of

TOY = Path(__file__).with_name("toy_pass.patch")
N = 16
PROGRAM = """
import json, pathlib, sys
import numpy as np
import mitsim as ms
from mitsim.light.cost_model import tracing_seconds
from mitsim.light.light import trace_light
from mitsim.light.light import write_light
from mitsim.light.light import next_samples
from mitsim.planner import pilot
assert pathlib.Path(ms.__file__).parents[1] == pathlib.Path.cwd(), ms.__file__
scene, folder = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2])
found = {}
for name in ("plain", "veiled"):
    bench = ms.open_bench(scene, projector=folder / f"{name}.toml")
    lighting = bench.family("dots:2").lighting
    plan = bench.plan("dots:2", accuracy=5e-3)
    result = pilot.PilotRuns(bench, lighting, 5e-3, 0).pilot_result
    light = trace_light(bench, plan, lighting, 0)
    write_light(folder / f"{name}.h5", light)
    grown = next_samples(light.simulation, light.samples, {each: float(each == "veil") for each in light.samples}, 2.0)
    sample_cost = result.sample_costs["veil"]
    found[name] = {
        "plan": plan.payload(),
        "samples": dict(light.samples),
        "grown": grown,
        "noise": sample_cost.error,
        "paths": sample_cost.paths,
        "seconds": tracing_seconds(result, plan.settings)["veil"],
        "reached": light.reached,
    }
print(json.dumps(found))
"""


def test_a_new_pass_is_its_row_and_its_integrator(small_scene: Callable[..., Path], tmp_path: Path) -> None:
    """`veil`: a tenth of the direct light once more where the projector's name says so, added to a copy of the package
    by a patch. It is traced, accumulated and sampled in rounds, measured by the pilot, and counted in costs, plans and
    files of light, with no other file touched.

    (Planted, each in the code that reads the table: a pass left out of the pilot; of tracing; of rounds; of plans.)
    """
    patch = TOY.read_text()
    assert re.findall(r"^\+\+\+ b/(.*)$", patch, re.MULTILINE) == ["mitsim/light/passes.py", "mitsim/transport/veil.py"]
    row = patch[: patch.index("diff --git a/mitsim/transport")]
    assert len(re.findall(r"^\+(?!\+)", row, re.MULTILINE)) == 2, "an import and a row"
    package = Path(mitsim.__file__).parent
    copy = tmp_path / "copy"
    shutil.copytree(package, copy / "mitsim")  # with its byte code: modules that stay as they are load at once
    for shelf in ("scenes", "calibration"):
        (copy / shelf).symlink_to(package.parent / shelf)
    subprocess.run(["git", "apply", str(TOY)], cwd=copy, check=True)
    for name in ("plain", "veiled"):
        (tmp_path / f"{name}.toml").write_text(f'name = "{name}"\neffective_wavelength_nm = 562.0\n')
    scene = small_scene(n=N, reflectance=np.random.default_rng(1).integers(20, 256, (64, 64)))
    command = [sys.executable, "-c", PROGRAM, str(scene), str(tmp_path)]
    done = subprocess.run(command, cwd=copy, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    plain, veiled = found["plain"], found["veiled"]
    assert veiled["reached"] and set(veiled["samples"]) - set(plain["samples"]) == {"veil"}
    # The pilot tells its noise, and plans its samples; a round that lacks them takes more of it and of nothing else.
    assert veiled["noise"] > 0 == plain["noise"] and veiled["paths"] == N * N
    assert veiled["plan"]["settings"]["veil_samples"] > plain["plan"]["settings"]["veil_samples"] > 0
    assert veiled["grown"]["veil"] > veiled["samples"]["veil"]
    assert {**veiled["grown"], "veil": 0} == {**veiled["samples"], "veil": 0}
    assert veiled["seconds"] > 0 == plain["seconds"]
    # Files of light have it in the frames of any pattern.
    pattern = np.random.default_rng(3).random((N, N))
    dim, bright = (frame_of(tmp_path / f"{name}.h5", pattern)[0] for name in ("plain", "veiled"))
    assert np.linalg.norm(bright - 1.1 * dim) < 0.01 * np.linalg.norm(dim)
    assert bright.sum() == pytest.approx(1.1 * dim.sum(), rel=5e-3)


def test_rows_are_told_apart() -> None:
    """By name and by stream: two passes of one stream would have the same noise. Grids that they name are there."""
    direct = PASSES["direct"]
    for twice, other in (("name", replace(direct, stream="own")), ("stream", replace(direct, name="own"))):
        with pytest.raises(ValueError, match=f"two passes have the {twice} 'direct'"):
            table_of(*PASSES.values(), other)
    grids = {grid for row in PASSES.values() for grid in row.grids}
    assert grids == set(GRIDS)
    counted = {row.anchors for row in PASSES.values() if row.anchors}
    assert all(getattr(Settings(400.0), name) == 1 for name in counted)
