"""What light is counted to take while it is traced, against what is allocated."""

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import open_bench
from mitsim.light.cost_model import Numbers, entries, light_bytes
from mitsim.light.light import Group, trace_groups
from mitsim.light.settings import GROUPS, PATHS_AT_ONCE, Settings, SharpPixels
from mitsim.light.simulation import Simulation
from mitsim.transport.records import DIRECT, Bundle, CellAxis, CellGrid, PathSamples

PATHS, PIXELS = 2**15, 16
GRID = CellGrid(CellAxis(-0.2, 0.05, 8), CellAxis(-0.2, 0.05, 8))
SHARP = SharpPixels((1, 2), 2, (-0.1, 0.1, -0.1, 0.1))


def path_samples() -> PathSamples:
    """Light of many paths from everywhere."""
    random = np.random.default_rng(3)
    return PathSamples(
        pixel=random.integers(0, PIXELS, PATHS),
        anchor_row=random.integers(0, 2, PATHS),
        anchor_column=random.integers(0, 2, PATHS),
        row=random.uniform(-0.2, 0.2, PATHS),
        column=random.uniform(-0.2, 0.2, PATHS),
        inverse_depth=1 / random.uniform(300, 400, PATHS),
        value=np.ones(PATHS),
        kind=np.full(PATHS, DIRECT, dtype=np.int16),
    )


@pytest.mark.parametrize("between", [False, True], ids=["even", "between"])
@pytest.mark.parametrize("layers", [(), (400.0, 300.0)], ids=["one layer", "two layers"])
def test_a_block_takes_no_more_than_is_counted(between: bool, layers: tuple[float, ...]) -> None:
    settings = Settings(depth=400.0, layers=layers, sharp=SHARP if between else None)
    bundle = Bundle(GRID, 2, settings.depths, between)
    tracemalloc.start()
    light = path_samples()
    held = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    bundle.accumulate(light, np.arange(PIXELS), 4)
    # The light of the next paths is fetched meanwhile: it is held beside what is accumulated, and twice while it is
    # fetched.
    taken = tracemalloc.get_traced_memory()[1] + held
    tracemalloc.stop()
    assert taken <= PATHS * (800 if between and layers else 500)


def test_rounds_beyond_the_plan_trace_no_larger_blocks_than_are_counted(
    shared_scene: Callable[..., Path], variant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulation = Simulation(open_bench(shared_scene("light"), variant), Settings(depth=400.0, samples={"direct": 2.0}))
    assert simulation.paths_at_once < PATHS_AT_ONCE
    tracer, blocks = type(simulation.direct), list[int]()
    traced = tracer.trace
    monkeypatch.setattr(tracer, "trace", lambda self, *args: blocks.append(args[2]) or traced(self, *args))
    wanted = 3 * simulation.paths_at_once // simulation.direct.paths_per_sample
    trace_groups([Group(simulation, np.zeros(simulation.bench.n**2, dtype=np.int64), 3)], {"direct": wanted})
    assert sum(blocks) == wanted
    assert max(blocks) * simulation.direct.paths_per_sample <= simulation.paths_at_once


def test_light_of_each_line_is_held(
    shared_scene: Callable[..., Path], variant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three lines' entries, at 45 bytes each; one worker accumulates one line after the other. (Planted: of one.)"""
    monkeypatch.setattr("mitsim.light.cost_model.workers", lambda: 1)
    bench, settings = open_bench(shared_scene("light"), variant), Settings(depth=400.0, samples={"direct": 9.0})
    one, three = (light_bytes(bench, bench.n**2, settings, lines) for lines in (1, 3))
    held = float(entries(bench.n**2, bench.n**2, Numbers.of(settings), settings))
    assert three - one == pytest.approx(2 * GROUPS * 45 * held)
