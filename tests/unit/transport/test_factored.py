"""Light followed from the camera: indirect and ambient light, against scenes in which both have a closed form.

Gates on Monte Carlo means are seven standard errors of eight independent seeds: five sigma of the t distribution.
"""

from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsim.capture.bench import Bench, open_bench
from mitsim.core.errors import MitsimError
from mitsim.transport import factored
from mitsim.transport.cells import CellGrid, aligned_grid
from mitsim.transport.factored import Paths, Tracer
from mitsim.transport.histogram import AMBIENT, INDIRECT, Deposits

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


def tracer(bench: Bench, anchors: int = 1, common: bool = False, **paths: object) -> Tracer:
    loaded = bench.loaded
    return Tracer(loaded.scene, loaded.camera, bench.source, grid(bench), anchors, paths=Paths(**paths), common=common)


def seen(stop: float) -> float:
    """Integral of (1 + t^2)^-2 over |t_x|, |t_y| < stop: the irradiance of an even radiance of 1."""
    node, weight = np.polynomial.legendre.leggauss(12)
    t, w = stop * node, stop * weight
    return float(w @ (1 + np.square(t)[:, None] + np.square(t)[None, :]) ** -2 @ w)


def mean(values: np.ndarray) -> tuple[float, float]:
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def test_a_hollow_sphere_is_lit_evenly_by_its_own_light(hollow: Bench) -> None:
    """Indirect light in a diffuse sphere is even: E = Phi rho / (A (1 - rho)), Phi being the projector's flux.

    Phi = pi scale (0.3)^2, the window's area at unit distance; every pixel has its equal part of it.
    """
    flux = np.pi * 111000 * 0.3**2
    radiance = 0.5 / np.pi * flux * 0.5 / (4 * np.pi * 1000**2 * (1 - 0.5))
    expected = radiance * seen(hollow.geometry.tan_half_fov)
    trace = tracer(hollow, interreflection=True)
    found = [trace.trace(seed, 0, 256) for seed in range(SEEDS)]
    assert all((one.order == INDIRECT).all() for one in found)
    total, error = mean(np.array([one.value.sum() / 256 for one in found]))
    assert SIGMAS * error < 0.1 * expected
    assert abs(total - expected) < SIGMAS * error
    light = np.mean([np.bincount(one.source, one.value, minlength=N * N) for one in found], axis=0).reshape(N, N)
    for part in (light[:8], light[8:], light[:, :8], light[:, 8:]):
        assert part.sum() / 256 == pytest.approx(expected / 2, rel=0.06)
    # Even over the directions too, whatever pixel the light came from.
    assert np.mean(found[0].row) == pytest.approx(0, abs=0.01) and np.mean(found[0].column) == pytest.approx(
        0, abs=0.01
    )
    assert np.abs(1 / found[0].inverse_depth - 1000).max() < 40


def test_a_flat_scene_has_no_indirect_light(outdoors: Bench) -> None:
    assert not tracer(outdoors, interreflection=True).trace(0, 0, 4).value.size


@pytest.mark.parametrize("interreflection", [False, True])
def test_an_even_sky(outdoors: Bench, interreflection: bool) -> None:
    """The sheet of albedo 0.5 shows half of the sky's radiance, and where the sheet ends is the sky itself.

    With bounces a path finds the sky in two ways (by connecting and by running into it), which share the light.
    """
    stop, sheet = outdoors.geometry.tan_half_fov, 64 / 400
    expected = 2 * seen(stop) - seen(sheet)
    trace = tracer(outdoors, interreflection=interreflection, emitters=outdoors.loaded.lamps)
    found = [trace.trace(seed, 0, 128) for seed in range(SEEDS)]
    assert all((one.order == AMBIENT).all() and (one.source == N * N).all() for one in found)
    total, error = mean(np.array([one.value.sum() / 128 for one in found]))
    assert SIGMAS * error < 0.03 * expected
    assert abs(total - expected) < SIGMAS * error
    one = Deposits.joined(found)
    on_sheet = (np.abs(one.row) < sheet) & (np.abs(one.column) < sheet)
    assert one.value[on_sheet].sum() / (128 * SEEDS) == pytest.approx(seen(sheet), rel=0.02)
    assert 1 / one.inverse_depth[on_sheet] == pytest.approx(np.full(on_sheet.sum(), 400.0), rel=1e-5)


def test_without_paths_there_is_no_light(hollow: Bench) -> None:
    """Direct light of the projector is the direct tracer's."""
    assert not tracer(hollow).trace(0, 0, 2).value.size


def test_seeds_and_launches(outdoors: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    trace = tracer(outdoors, emitters=outdoors.loaded.lamps)
    assert trace.lanes == grid(outdoors).shape[0] * grid(outdoors).shape[1]
    whole, again, other = trace.trace(6, 0, 4), trace.trace(6, 0, 4), trace.trace(7, 0, 4)
    assert all(np.array_equal(getattr(whole, name), getattr(again, name)) for name in vars(whole))
    assert np.isin(whole.row, other.row).mean() < 0.01
    pieces = Deposits.joined([trace.trace(6, 0, 1), trace.trace(6, 1, 3)])
    monkeypatch.setattr(factored, "LANES_PER_LAUNCH", 300)
    for parts in (pieces, trace.trace(6, 0, 4)):
        assert np.allclose(parts.row, whole.row, atol=1e-6) and np.allclose(parts.value, whole.value, rtol=1e-5)


def test_common_random_numbers_aim_every_anchor_alike(outdoors: Bench) -> None:
    def rows(common: bool) -> list[np.ndarray]:
        found = tracer(outdoors, 2, common, emitters=outdoors.loaded.lamps).trace(1)
        sheet = (np.abs(found.row) < 0.15) & (np.abs(found.column) < 0.15)
        anchors = found.anchor_row * 2 + found.anchor_column
        return [found.row[sheet & (anchors == index)] for index in range(4)]

    alike, apart = rows(True), rows(False)
    assert all(np.allclose(alike[0], other, atol=1e-6) for other in alike[1:])
    assert np.isin(apart[0], apart[1]).mean() < 0.01


def test_light_that_is_not_a_number_is_refused(small_scene: Callable[..., Path]) -> None:
    bench = open_bench(small_scene(extra=SPHERE, sheet_z=3000))
    parameters = mi.traverse(bench.loaded.projector)
    parameters["scale"] = float("nan")
    parameters.update()
    with pytest.raises(MitsimError, match="NaN"):
        tracer(bench, interreflection=True).trace(0)
