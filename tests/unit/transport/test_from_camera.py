"""Light followed from the camera: ambient light, against scenes in which it has a closed form.

What it adds to the projector's light is in test_indirect.py and tests/physics/test_mirror.py.

Gates on Monte Carlo means are seven standard errors of eight independent seeds: five sigma of the t distribution.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.transport.from_camera import FromCameraTracer
from mitsim.transport.integrator import Paths
from mitsim.transport.records import AMBIENT, CellGrid, PathSamples, aligned_grid
from tests.unit.transport.closed_forms import mean, seen

pytestmark = pytest.mark.usefixtures("variant")
N, SEEDS, SIGMAS = 16, 8, 7.0
SPHERE = """<shape type="sphere"><float name="radius" value="1000"/><boolean name="flip_normals" value="true"/>
    <bsdf type="diffuse"><spectrum name="reflectance" value="0.5"/></bsdf></shape>"""
SKY = '<emitter type="constant"><spectrum name="radiance" value="2"/></emitter>'


@pytest.fixture(scope="module")
def hollow(shared_scene: Callable[..., Path], variant: str) -> Bench:
    """Camera and projector inside a diffuse sphere; the sheet is far outside."""
    return open_bench(shared_scene("hollow", extra=SPHERE, sheet_z=3000), variant)


@pytest.fixture(scope="module")
def outdoors(shared_scene: Callable[..., Path], variant: str) -> Bench:
    """The sheet, |x|, |y| < 64 mm at 400 mm, under an even sky."""
    return open_bench(shared_scene("outdoors", extra=SKY), variant)


def grid(bench: Bench) -> CellGrid:
    return aligned_grid(*bench.windows, N, 1, bench.geometry.tan_half_fov)


def tracer(bench: Bench, **followed: object) -> FromCameraTracer:
    return FromCameraTracer(bench.setup, grid(bench), Paths(**followed))


@pytest.mark.slow
@pytest.mark.parametrize("interreflection", [False, True])
def test_an_even_sky(outdoors: Bench, interreflection: bool) -> None:
    """The sheet of albedo 0.5 shows half of the sky's radiance, and where the sheet ends is the sky itself.

    With bounces a path finds the sky in two ways (by connecting and by running into it), which share the light.
    """
    stop, sheet = outdoors.geometry.tan_half_fov, 64 / 400
    expected = 2 * seen(stop) - seen(sheet)
    trace = tracer(outdoors, interreflection=interreflection, emitters=outdoors.loaded.lamps)
    found = [trace.trace(seed, 0, 128) for seed in range(SEEDS)]
    assert all((one.kind == AMBIENT).all() and (one.pixel == N * N).all() for one in found)
    total, error = mean(np.array([one.value.sum() / 128 for one in found]))
    assert SIGMAS * error < 0.03 * expected
    assert abs(total - expected) < SIGMAS * error
    one = PathSamples.join(found)
    on_sheet = (np.abs(one.row) < sheet) & (np.abs(one.column) < sheet)
    assert one.value[on_sheet].sum() / (128 * SEEDS) == pytest.approx(seen(sheet), rel=0.02)
    assert 1 / one.inverse_depth[on_sheet] == pytest.approx(np.full(on_sheet.sum(), 400.0), rel=1e-5)


def test_light_that_the_projectors_side_finds_is_not_followed(hollow: Bench) -> None:
    """Matt surfaces turn no light sharply: every path ends at the first."""
    assert not tracer(hollow, interreflection=True).trace(0, 0, 2).value.size
    assert not tracer(hollow).trace(0, 0, 2).value.size
