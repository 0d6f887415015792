"""What light is counted to take while it is traced, against what is allocated."""

import tracemalloc

import numpy as np
import pytest

from mitsim.light.settings import Settings, SharpPixels
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
