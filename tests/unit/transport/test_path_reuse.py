"""Shared second points: the same light as paths of their own bring, less noise, and the accumulator that it is added up
in.

Gates on Monte Carlo means are seven standard errors of eight independent seeds: five sigma of the t distribution.
"""

from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.core.errors import MitsimError
from mitsim.transport import integrator
from mitsim.transport.connect import SensorPoints
from mitsim.transport.from_camera import FromCameraTracer
from mitsim.transport.integrator import IndirectTracer, Paths, adaptive_counts, by_pixel, effect_of
from mitsim.transport.path_reuse import PathReuseTracer
from mitsim.transport.records import INDIRECT, Bundle, DeviceAccumulator, PathSamples, aligned_grid
from tests.unit.transport.test_indirect import MATT, MIRROR, SHINY, SPHERE

pytestmark = pytest.mark.usefixtures("variant")
N, SEEDS, SIGMAS = 16, 8, 7.0
WALL = """<shape type="rectangle"><transform name="to_world"><scale x="60" y="60"/><rotate y="1" angle="{turn}"/>
    <translate x="{x}" z="350"/></transform>{bsdf}</shape>"""
BENT = """v -30 -60 290\nv -30 60 290\nv -30 60 410\nv -30 -60 410
vn 0.8 0 0.6\nvn 0.8 0.6 0\nvn 0.8 0 -0.6\nvn 0.8 -0.6 0
f 1//1 2//2 3//3\nf 1//1 3//3 4//4\n"""
"""A wall whose shading normals lean 37 degrees, each corner's another way."""
OBJECT = """<shape type="obj"><string name="filename" value="bent.obj"/><bsdf type="twosided"><bsdf type="diffuse">
    <spectrum name="reflectance" value="0.7"/></bsdf></bsdf></shape>"""
FIN = """<shape type="rectangle"><transform name="to_world"><scale x="25" y="60"/><rotate y="1" angle="90"/>
    <translate x="{x}" z="375"/></transform><bsdf type="twosided"><bsdf type="diffuse">
    <spectrum name="reflectance" value="0.8"/></bsdf></bsdf></shape>"""
"""A board that stands on the sheet, between pixels of one block."""
SCENES = {
    "matt walls": WALL.format(turn=90, x=-30, bsdf=MATT) + WALL.format(turn=-60, x=40, bsdf=MATT),
    "shiny wall": WALL.format(turn=90, x=-30, bsdf=SHINY) + WALL.format(turn=-60, x=40, bsdf=MATT),
    "bent wall": OBJECT + WALL.format(turn=-60, x=40, bsdf=MATT),
    "fins": FIN.format(x=14) + FIN.format(x=-26),
    "mirror wall": MIRROR + WALL.format(turn=-60, x=40, bsdf=MATT),
}
BENT_SCENES = {
    "bent": SCENES["bent wall"],
    "shiny": OBJECT + WALL.format(turn=-60, x=40, bsdf=SHINY),
    "mirror": OBJECT + MIRROR.replace('angle="90"', 'angle="-60"').replace('x="-40"', 'x="40"'),
}


def opened(scene: Path) -> Bench:
    """The bench of a scene, with what it may read beside it."""
    (scene.parent / "bent.obj").write_text(BENT)
    return open_bench(scene)


def tracers(
    bench: Bench, spread: bool = False, mirrors: bool = False, steep: bool = False
) -> tuple[IndirectTracer, PathReuseTracer]:
    """Paths of their own, and shared ones."""
    points = SensorPoints(bench.geometry.half_width, spread=spread)
    parts = bench.setup, Paths(mirrors, True, steep=steep)
    return IndirectTracer(*parts, points=points), PathReuseTracer(*parts, points=points)


SLOW = "bent wall", "shiny wall"
"""Scenes whose paths are many; the others have the same kinds of light."""


def summed(light: PathSamples, samples: int, pixels: int) -> np.ndarray:
    """Light of each column of pixels in all, and by row, column and depth that it comes from: (4, pixels)."""
    weights = np.ones_like(light.row), light.row, light.column, light.inverse_depth
    return np.array([np.bincount(light.pixel % pixels, light.value * each / samples, pixels) for each in weights])


@pytest.mark.parametrize(
    ("name", "spread"),
    [
        pytest.param(name, spread, marks=() if spread is (index % 2 == 0) and name not in SLOW else pytest.mark.slow)
        for index, name in enumerate(SCENES)
        for spread in (False, True)
    ],
)
def test_shared_light_is_the_light_of_paths_of_their_own(
    shared_scene: Callable[..., Path], name: str, spread: bool
) -> None:
    """Of each column of pixels: how much, and in which mean direction and depth.

    Fifteen pixels a side do not fill whole blocks. (Planted: no rays between first and second points fails "fins"; the
    density of the own direction alone all but "mirror wall"; ways on for either side "bent wall" and "fins"; a further
    path of diffuse surfaces without its cosines "bent wall". The own pixel's direction at glossy points shows below.)
    """
    n, samples = 15 if "walls" in name else N, 1024 if "bent" in name else 512
    bench = opened(shared_scene(f"{name} {spread}", extra=SCENES[name], n=n))
    sides = tracers(bench, spread, "mirror" in name)
    found = np.array(
        [[summed(side.trace(seed, 0, samples), samples, n) for seed in range(SEEDS)] for side in sides], np.float64
    )
    means, errors = found.mean(axis=1), found.std(axis=1, ddof=1) / np.sqrt(SEEDS)
    bound = SIGMAS * np.hypot(*errors)
    assert (np.abs(means[0] - means[1]) <= bound).all()
    lit = means[0, 0] > 0.01 * means[0, 0].max()
    assert lit.sum() > n / 3 and np.median(bound[0, lit] / means[0, 0, lit]) < 0.3, "of a column's light"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bent", "shiny", "mirror"])
def test_light_that_shading_normals_make_heavy_is_divided(
    shared_scene: Callable[..., Path], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By both sides as much as by the projector's alone, of each column of pixels and place, shared points or not.

    Where a factor of a half is already heavy, nearly all light over the bent wall is divided. (Planted: first turns, or
    those after a mirror, divided on one side; the way to the sensor not; further paths of shared points not.)
    """
    monkeypatch.setattr(integrator, "_STEEP", 0.5)
    mirrors, samples = "mirror" in name, 512 if "mirror" in name else 256
    bench = opened(shared_scene(f"steep {name}", extra=BENT_SCENES[name]))
    grid = aligned_grid(*bench.windows, N, 1, bench.geometry.tan_half_fov)
    cameras = [FromCameraTracer(bench.setup, grid, Paths(mirrors, True, steep=steep)) for steep in (False, True)]
    own, shared = tracers(bench, mirrors=mirrors, steep=True)
    ways = [(tracers(bench, mirrors=mirrors)[0], cameras[0]), (own, cameras[1]), (shared, cameras[1])]

    def light(way: tuple[IndirectTracer, FromCameraTracer], seed: int) -> np.ndarray:
        traced = PathSamples.join([side.trace(seed, 0, samples) for side in way])
        return summed(traced.where(traced.kind == INDIRECT), samples, N)

    found = np.array([[light(way, seed) for seed in range(SEEDS)] for way in ways])
    means, errors = found.mean(axis=1), found.std(axis=1, ddof=1) / np.sqrt(SEEDS)
    for one in (1, 2):
        bound = SIGMAS * np.hypot(errors[0], errors[one])
        assert (np.abs(means[0] - means[one]) <= bound).all()
        assert (
            np.abs((means[0] - means[one])[0].sum()) < SIGMAS * np.std(found[[0, one], :, 0].sum(axis=2)) / SEEDS**0.5
        )
    lit = means[0, 0] > 0.01 * means[0, 0].max()
    assert np.median(bound[0, lit] / means[0, 0, lit]) < 0.3, "of a column's light"
    part = summed(cameras[1].trace(0, 0, samples), samples, N)[0].sum() / means[0, 0].sum()
    assert part > 0.2, "what is left to the camera's side"


# ---- the accumulator


@pytest.mark.parametrize("depths", [(400.0,), (450.0, 380.0, 300.0)])
def test_the_accumulator_holds_what_the_host_accumulates(
    shared_scene: Callable[..., Path], depths: tuple[float, ...]
) -> None:
    """Row by row to rounding, and place by place where layers are summed; a window of a third of the view leaves some
    light outside."""
    bench = open_bench(shared_scene(f"ledger {len(depths)}", extra=SCENES["shiny wall"]))
    grid = aligned_grid(*bench.windows, N, 1, bench.geometry.tan_half_fov / 3)
    bundle, labels = Bundle(grid, 1, depths), np.arange(N * N) % 5
    tracer = tracers(bench)[1]
    accumulator = DeviceAccumulator(bundle, labels, tracer.board)
    own = tracer.trace(3, 0, 512, accumulator)
    matrix, received, outside = accumulator.fetch()[0].light()
    every = tracer.trace(3, 0, 512)
    expected = bundle.accumulate(every, labels).toarray()
    found = (matrix + bundle.accumulate(own, labels)).toarray()
    assert 0 < outside + bundle.outside(own) == pytest.approx(bundle.outside(every), rel=1e-6)
    assert received + own.value.sum() == pytest.approx(every.value.sum(), rel=1e-6)
    np.testing.assert_allclose(found.sum(axis=1), expected.sum(axis=1), rtol=1e-6)
    flat = [light.reshape(6, len(depths), -1).sum(axis=1) for light in (found, expected)]
    assert np.abs(flat[0] - flat[1]).sum() < 1e-3 * flat[1].sum()
    by_layer = [light.reshape(6, len(depths), -1).sum(axis=(0, 2)) for light in (found, expected)]
    np.testing.assert_allclose(*by_layer, rtol=0.03)


def test_light_that_is_not_a_number_is_refused(small_scene: Callable[..., Path]) -> None:
    bench = open_bench(small_scene(extra=SPHERE.format(bsdf=MATT), sheet_z=3000))
    bundle = Bundle(aligned_grid(*bench.windows, N, 1, bench.geometry.tan_half_fov), 1, (400.0,))
    tracer = tracers(bench)[1]
    accumulator = DeviceAccumulator(bundle, np.zeros(N * N, np.int64), tracer.board)
    parameters = mi.traverse(bench.loaded.projector)
    parameters["scale"] = float("nan")
    parameters.update()
    with pytest.raises(MitsimError, match="NaN"):
        tracer.trace(0, 0, 256)
    tracer.trace(0, 0, 256, accumulator)
    with pytest.raises(MitsimError, match="NaN"):
        accumulator.fetch()[0].light()


# -------- Blocks that are followed more often
#
# Blocks that are followed more often: the light stays, its noise moves; numbers from moments.

ODD = 18
BLOCKS = 5
"""Blocks a side of 18 pixels: the last are of two pixels."""


@pytest.mark.slow
@pytest.mark.parametrize("shared", [False, True])
def test_repeated_light_is_the_same_light(shared_scene: Callable[..., Path], shared: bool) -> None:
    """Of each class of pixels, how much and from where, whatever the repeats; and less noise where there are more.

    (Planted: light that is not divided by the repeats, and turns of a block that share a sample's numbers.)
    """
    bench = open_bench(shared_scene(f"repeated {shared}", extra=SCENES["matt walls"], n=ODD))
    repeats = np.random.default_rng(2).choice([1, 2, 5], BLOCKS**2)
    plain = tracers(bench)[shared]
    again = plain.with_adaptive_counts(repeats.tolist())
    paths_per_sample = repeats.sum() * 16 if shared else by_pixel(repeats.tolist(), ODD).sum()
    assert again.paths_per_sample == paths_per_sample
    runs = [[side.trace(seed, 0, 256) for seed in range(SEEDS)] for side in (plain, again)]
    found = np.array([[summed(run, 256, ODD) for run in side] for side in runs])
    means, errors = found.mean(axis=1), found.std(axis=1, ddof=1) / np.sqrt(SEEDS)
    bound = SIGMAS * np.hypot(*errors)
    assert (np.abs(means[0] - means[1]) <= bound).all() and bound[0].sum() < 0.2 * means[0, 0].sum()
    each = [[np.bincount(run.pixel, run.value, ODD * ODD) for run in side] for side in runs]
    variance = np.var(each, axis=1).reshape(2, -1)
    for count in (1, 2, 5):
        such = by_pixel(repeats.tolist(), ODD) == count
        assert variance[1][such].sum() == pytest.approx(variance[0][such].sum() / count, rel=0.45), count


def test_repeats_leave_less_variance_for_the_cost() -> None:
    """Half of the blocks a hundred times as noisy: (1 + 10)^2 / (2 (1 + 100)) = 0.6 of variance times cost at best."""
    moments = np.ones((16, 16))
    moments[:, :8] = 100.0
    repeats = adaptive_counts(moments)
    variance, paths = effect_of(repeats, moments)
    assert variance * paths < 0.72
    assert repeats[:, :6].min() > 2 * repeats[:, 10:].max()
    assert set(adaptive_counts(np.ones((8, 8))).ravel()) == set(adaptive_counts(np.zeros((8, 8))).ravel()) == {1}
    assert effect_of(repeats, np.zeros((16, 16)))[0] == 1.0
