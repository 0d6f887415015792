"""How much of each light the next round of sampling traces: what buys the missing accuracy with the least work."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import mitsim
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.mask import MOST_TERMS
from mitsim.devices.patterns import Lighting
from mitsim.light import cost_model
from mitsim.light.cost_model import (
    Numbers,
    accumulation_seconds,
    checking_seconds,
    forming_seconds,
    optics_seconds,
    tracing_seconds,
    truth_seconds,
)
from mitsim.light.light import SampledPass, cheapest_samples, next_samples
from mitsim.light.passes import EVEN, GRIDS, PASSES, even, table_of
from mitsim.light.settings import GROUPS, Forming, SampleCost, Settings
from mitsim.optics.frames import PROBES, formed_frames
from tests.unit.planner.test_choice import PILOT_RESULT, plan, with_sample_costs

LIGHTS = (
    SampledPass("direct", 24, 0.165, 3.0),
    SampledPass("anchor_residual", 1, 0.015, 8.0),
    SampledPass("indirect", 59, 0.5, 2.0),
    SampledPass("indirect_residual", 3, 0.23, 15.0),
)


def left(light: SampledPass, samples: int) -> float:
    """By hand: 1 / N, but for direct light, whose 2^k samples are better than 3 * 2^k."""
    if light.name != "direct":
        return light.variance * light.done / samples
    found = light.variance * (light.done / samples) ** 1.5
    return found / 1.2 if even(samples) == 2 ** round(math.log2(samples)) else found


@pytest.mark.parametrize("allowed", [0.9, 0.7, 0.5, 0.3])
def test_no_other_samples_take_less_work(allowed: float) -> None:
    """Against all that there are, but for what is rounded up: half a sample of each light that takes any number.

    (Planted: the last that is enough, direct light as if 3 * 2^k samples were as good.)
    """
    found = cheapest_samples(LIGHTS, allowed)
    assert sum(left(light, found[light.name]) for light in LIGHTS) <= allowed
    assert all(found[light.name] >= light.done for light in LIGHTS)
    assert all(even(found[light.name]) == found[light.name] for light in LIGHTS if light.name in EVEN)

    ladders = [(24, 32, 48, 64, 96), (1, 2, 3, 4, 6, 8), range(59, 400), range(3, 24)]
    choices = list(zip(LIGHTS, ladders, strict=True))
    work = sum(np.ix_(*([light.work * count for count in counts] for light, counts in choices)))
    variance = sum(np.ix_(*([left(light, count) for count in counts] for light, counts in choices)))
    assert sum(light.work * found[light.name] for light in LIGHTS) <= work[variance <= allowed].min() + (2.0 + 15.0)


def test_a_heavy_path_makes_its_own_light_grow() -> None:
    """Indirect light with 0.95 of the variance: the others, of ten times its work, stay as they are.

    (Planted: each given its part by Lagrange, though it has more.)
    """
    shares = ("direct", 32, 0.03, 20.0), ("indirect", 57, 0.95, 2.0), ("penumbra", 6, 0.02, 20.0)
    more = ("from_camera", 9, 0.0, 20.0), ("indirect_residual", 9, 0.0001, 20.0)
    lights = [SampledPass(*share) for share in (*shares, *more)]
    found = cheapest_samples(lights, 1 / 6)
    grown = math.ceil(57 * 0.95 / (1 / 6 - 0.0501))
    assert found == {"direct": 32, "indirect": grown, "penumbra": 6, "from_camera": 9, "indirect_residual": 9}


def test_a_variance_that_no_round_reaches_takes_the_largest_round() -> None:
    """(Planted: only light that is doubled.)"""
    largest = {"direct": 8 * 24, "anchor_residual": 8, "indirect": 8 * 59, "indirect_residual": 8 * 3}
    assert cheapest_samples(LIGHTS, 1e-9) == largest


def simulated(**tracers: tuple[Any, float]) -> Any:
    """A simulation of these tracers, with predicted samples."""
    passes = {name: SimpleNamespace(tracer=tracer, predicted=count) for name, (tracer, count) in tracers.items()}
    return SimpleNamespace(passes=passes)


def of_lanes(paths_per_sample: int) -> Any:
    return SimpleNamespace(paths_per_sample=paths_per_sample)


def test_the_next_round_lowers_the_variance_by_what_is_missing_and_a_twentieth() -> None:
    """At least by a tenth, at most to a sixth. (Planted: each of the three left out.)"""
    simulation, done = simulated(indirect=(of_lanes(10), 100.0)), {"indirect": 1000}

    def grown(excess: float) -> float:
        return next_samples(simulation, done, {"indirect": 3.0}, excess)["indirect"]

    assert grown(1.5) == math.ceil(1000 * 1.05 * 1.5**2)
    assert grown(1.001) == 1100
    assert grown(1e200) == 6000


# -------- Predicted times
#
# What simulating is predicted to take: multiplications counted by hand, at unit costs of one or none.

FORMING = Forming(pixels=50, cells=10, lit=0.5, terms=3.0, shots=4, classes=4)
ONE = Numbers(*[1.0] * 6)
COSTS = "_FRAME_S", "_ENTRY_S", "_ACCUMULATED_S", "_RAY_S", "_PIXEL_S"


def count(monkeypatch: pytest.MonkeyPatch, **costs: float) -> None:
    """All unit costs are 0 but these; a multiplication of ``formed`` is one second."""
    for name in COSTS:
        monkeypatch.setattr(cost_model, name, costs.get(name, 0.0))


def formed(forming: Forming, numbers: Numbers, frames: float = 1.0) -> float:
    return float(forming_seconds(forming, numbers, frames, 1.0))


def products(rows: float, terms: float = 1.0) -> float:
    """Of left (50, rows) times light (rows, rows) times right (rows, 50), and of the groups' probes in the same way."""
    probes = GROUPS * (PROBES + 1) * (min(rows, 50) + 50) * rows
    return terms * (50 * rows * rows + 50 * 50 * rows + probes)


@pytest.mark.parametrize(
    ("change", "multiplications"),
    [
        ({"waves": 0.0}, products(5)),
        ({}, products(5, 3)),
        ({"layers": 2.0}, 2 * products(5, 3)),
        ({"cells": 4.0}, products(20, 3)),
        ({"anchors": 2.0, "cells": 8.0}, products(40, 3) + products(20, 3)),
        ({"anchors": 2.0, "layers": 3.0, "coarse_layers": 1.0}, 3 * products(5, 3) + 3 * products(10, 3)),
        ({"indirect": 1.0}, products(5, 3) + products(10, 3)),
        ({"followed_anchors": 3.0, "layers": 3.0, "coarse_layers": 1.0}, 3 * products(5, 3) + products(7.5, 3)),
        ({"occluded_anchors": 4.0}, products(5, 3)),
        ({"occluded": 1.0, "occluded_anchors": 4.0}, products(5, 3) + products(2, 3)),
        ({"occluded": 90.0, "occluded_anchors": 4.0}, products(5, 3) + products(20, 3)),
        ({"mixed": 1.0}, products(5, 3) + 4 * 50**2),
    ],
)
def test_forming_a_frame_is_as_many_products_as_its_matrices_have(
    change: dict[str, float], multiplications: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of the ten rows of cells hold light; coarse light of several anchors and indirect light add frames.

    A quarter of the pixels is lit: of one occluded pixel a quarter of two rows, of many no more than of all.
    """
    count(monkeypatch)
    assert formed(FORMING, replace(ONE, **change), 7.0) == pytest.approx(7 * multiplications)


def test_the_shorter_side_of_occluded_light_is_multiplied_out_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hidden pixels light 2 of 10 rows and 5 of 10 columns of cells, from 4 x 4 anchors. (Planted: the longer side.)"""
    count(monkeypatch)
    hidden = replace(ONE, occluded=90.0, occluded_anchors=4.0)
    for occluded, (rows, columns) in (((0.4, 1.0), (8, 20)), ((1.0, 0.4), (20, 8))):
        seen = 50 * rows * columns + 50 * 50 * 8 + GROUPS * (PROBES + 1) * (columns + 50) * rows
        found = formed(replace(FORMING, occluded=occluded), hidden)
        assert found == pytest.approx(products(5, 3) + 3 * seen)


@pytest.mark.parametrize(
    ("change", "rows"),
    [
        ({}, 1.0),
        ({"layers": 3.0}, 3.0),
        ({"anchors": 2.0, "cells": 8.0}, 8 + 2),
        ({"indirect": 1.0, "cells": 8.0, "coarse_layers": 1.0}, 8 + 2),
        ({"followed_anchors": 3.0, "cells": 8.0, "coarse_layers": 1.0}, 8 + 2 / 4),
    ],
)
def test_shadows_and_checks_take_the_time_of_their_entries(
    change: dict[str, float], rows: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A shadow has an entry for each pixel, for each row of cells and for each term, and two axes. Followed light has
    a row of cells for every fourth pixel. The last check of all classes forms the frames, so that half a round is left,
    or a round more for followed light. (Planted: rows of followed light by the wrong power; the last check twice.)"""
    count(monkeypatch, _ENTRY_S=1.0)
    numbers = replace(ONE, **change)
    frames = float(forming_seconds(FORMING, numbers, formed_frames(4, 4, 50)))
    assert float(optics_seconds(FORMING, numbers)) - frames == pytest.approx(2 * 50 * 10 * 3 * rows)
    again = float(forming_seconds(FORMING, numbers, 4 * cost_model._CHECK * (0.5 + numbers.indirect)))
    assert float(checking_seconds(FORMING, numbers)) == pytest.approx(again)


def test_light_is_accumulated_in_all_cells_of_its_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    """Indirect light of 4 classes in 10 x 10 pixels of 2 x 2 cells passes 1600 places of each group. A place takes
    0.4 of an entry. (Planted: more cells are fewer places.)"""
    count(monkeypatch, _ACCUMULATED_S=1.0)
    numbers = replace(ONE, indirect=1.0, cells=8.0, coarse_layers=1.0)
    assert float(accumulation_seconds(FORMING, numbers, 7.0)) == pytest.approx(GROUPS * (7 + 0.4 * 4 * 20**2))


def test_the_truth_takes_rays_for_a_sixth_of_the_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four estimates begin with 16 + 8 rays for each pixel. Then errors that fall as N^(-0.8) need 6^(1/0.8) times the
    rays of the frames, and half of them is allotted. (Planted: fewer rays for more pixels.)"""
    count(monkeypatch, _RAY_S=1.0)
    few = with_sample_costs(PILOT_RESULT, direct=SampleCost(2e-3, 16, 100, 0.8))
    settings = replace(plan().settings, anchors=1, samples={"direct": 64.0})
    expected = 4 * 100 * 24 + 0.5 * GROUPS * 100 * 64 * 6 ** (1 / 0.8)
    assert truth_seconds(few, settings) == pytest.approx(expected)


def test_memory_and_disk_of_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each pixel takes 8 bytes, each row 16 and each file 2000; the truth is one file more. A mask of two terms keeps
    none of them, and a mask on a raster keeps the raster and its largest terms. (Planted: a byte that is there already;
    the raster left out; two terms kept.)"""
    lighting = Lighting(np.arange(16), np.eye(5, 16))
    monkeypatch.setattr(cost_model, "Simulation", lambda *_: SimpleNamespace(paths_at_once=1000))
    camera = CameraGeometry(pixels=64, columns=32)
    bench: Any = SimpleNamespace(n=4, geometry=camera, waves=None)
    settings = replace(plan().settings, layers=(), anchors=1, subdivision=2)
    files = 5 * (8 * 64 * 32 + 16 * 64 + 2000) + 8 * 16 + 16 * 4 + 2000
    assert cost_model.frames_cost(bench, settings, lighting).disk_bytes == files
    assert cost_model.frames_cost(bench, settings, lighting, on_disk=100.0, lines=3).disk_bytes == 3 * files - 100
    held = cost_model.light_bytes(bench, 5, settings)
    two: Any = SimpleNamespace(n=4, geometry=camera.model_copy(update={"mask": "flatcam"}), waves=None)
    assert two.geometry.mask_terms == 2 and cost_model.light_bytes(two, 5, settings) == held
    monkeypatch.setattr(cost_model, "cells_a_side", lambda geometry, waves: 1000 * geometry.mask_cells)
    largest = 2 * 8 * MOST_TERMS * (4 * 2) * (64 + 32)
    drawn = cost_model.light_bytes(bench, 5, replace(settings, raster=True, raster_cells=3))
    assert drawn - held == pytest.approx(8 * 24 * 3000**2 + 1.2e8 + largest)


def test_lines_share_paths_and_form_and_file_each_its_own() -> None:
    """Three lines: two fifths more tracing, or three times as much where glass parts them, and all else three times.
    (Planted: shadows of one line; accumulating of one; paths shared whatever parts them.)"""
    three = replace(PILOT_RESULT, forming=replace(PILOT_RESULT.forming, lines=3))
    settings = plan(pilot_result=PILOT_RESULT).settings
    numbers = Numbers.of(settings)
    for seconds in (
        lambda forming: forming_seconds(forming, numbers, 5.0),
        lambda forming: optics_seconds(forming, numbers),
        lambda forming: checking_seconds(forming, numbers),
        lambda forming: accumulation_seconds(forming, numbers, 1e6),
    ):
        assert seconds(three.forming) == pytest.approx(3 * seconds(PILOT_RESULT.forming))  # type: ignore[no-untyped-call]
    one, several = (tracing_seconds(pilot_result, settings) for pilot_result in (PILOT_RESULT, three))
    assert several == pytest.approx({name: 1.4 * each for name, each in one.items()})
    parted = tracing_seconds(replace(three, forming=replace(three.forming, parted=True)), settings)
    assert parted == pytest.approx({name: 3 * each for name, each in one.items()})
    assert truth_seconds(three, settings) == pytest.approx(1.4 * truth_seconds(PILOT_RESULT, settings))


# -------- The table of passes
#
# The table of passes: adding one is its row, its integrator and its test, and nothing else.

TOY = Path(__file__).with_name("toy_pass.patch")
N = 16
PROGRAM = """
import json, pathlib, sys
import numpy as np
import mitsim as ms
from mitsim.light.cost_model import tracing_seconds
from mitsim.light.light import trace_light
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
    by a patch. It is traced, accumulated and sampled in rounds, measured by the pilot, and counted in costs and plans,
    with no other file touched; tests/test_extending.py captures it.

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
