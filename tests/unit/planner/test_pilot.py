"""The pilot's predictions come true: what it says that leaving something out changes is what careful runs find.

The scene calls for everything at once: a sensor of 24 mm near a ball and a corner, under a sky. Each prediction is held
against frames of many more samples; the pilot sees a few, so a factor of 1.5 either way is its promise here.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.acquire.exposure import Totals
from mitsim.api.bench import Bench, open_bench
from mitsim.bench import effects
from mitsim.bench.effects import EFFECTS
from mitsim.core.errors import MitsimError
from mitsim.core.seeds import integer
from mitsim.devices.patterns import parse_patterns
from mitsim.light.passes import Simulation, expected_of
from mitsim.light.settings import REPLICATES, WIDE, PilotResult, Settings
from mitsim.planner import pilot, pilot_direct
from mitsim.planner.pilot_effects import AnchorRuns, EffectRuns, FollowedRuns
from mitsim.transport.records import PathSamples

pytestmark = pytest.mark.usefixtures("variant")
N = 16
SHOWN = list(range(16))  # of dots:4 on few pixels the pilot looks at all captures
EXTRA = """<emitter type="constant"><spectrum name="radiance" value="0.02"/></emitter>
    <shape type="sphere"><point name="center" x="-25" y="10" z="330"/> <float name="radius" value="30"/>
        <bsdf type="twosided"><bsdf type="diffuse"><spectrum name="reflectance" value="0.8"/></bsdf></bsdf></shape>
    <shape type="rectangle"><transform name="to_world"><scale x="60" y="60"/><rotate y="1" angle="90"/>
        <translate x="-50" z="350"/></transform>
        <bsdf type="twosided"><bsdf type="diffuse"><spectrum name="reflectance" value="0.8"/></bsdf></bsdf></shape>"""


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path], variant: str) -> Bench:
    print_ = np.random.default_rng(4).integers(20, 256, (48, 48))
    return open_bench(
        shared_scene("pilot", reflectance=print_, extra=EXTRA, pitch=0.375, mask_feature=0.3), variant, for_render=True
    )


def measured(bench: Bench, seed: int, accuracy: float = 1e-2) -> PilotResult:
    return pilot.PilotRuns(bench, parse_patterns("dots:4", N).lighting, accuracy, seed).pilot_result


@pytest.fixture(scope="module")
def pilot_result(bench: Bench) -> PilotResult:
    return measured(bench, seed=3)


def frames(bench: Bench, settings: Settings, many: int = 64, other: int = 24, judging_cells: int = 0) -> np.ndarray:
    """(16, pixels, pixels) of the captures that the pilot looks at, from many samples."""
    lighting = parse_patterns("dots:4", N).lighting.shots(SHOWN)
    labels = lighting.labels
    made, counts = (
        Simulation(bench, settings, judging_cells=judging_cells),
        {"direct": many, "anchor_residual": many // 4, "indirect": 8 * other, "from_camera": other}
        | dict.fromkeys(("indirect_residual", "camera_residual"), other),
    )
    parts = [
        made.accumulate(name, each.tracer.trace(integer(77, each.row.stream), 0, counts[name]), labels, counts[name])
        for name, each in made.passes.items()
    ]
    light = sum(parts[1:], parts[0])
    expected = expected_of([(made, [light])], np.arange(16), lighting, 0)
    return np.stack([frame.irradiance for frame in expected])


def change(one: np.ndarray, judge: np.ndarray) -> float:
    return float(np.linalg.norm(one - judge) / np.linalg.norm(judge))


def promised(found: float, actual: float) -> bool:
    return 1 / 1.5 < found / actual < 1.5


def test_what_is_measured(bench: Bench, pilot_result: PilotResult) -> None:
    assert set(pilot_result.effects) == {"interreflection", "ambient", "diffraction", "black-level", "speckle"} & set(
        effects.present(bench)
    )
    assert set(pilot_result.effects) <= set(EFFECTS)
    ladders = pilot_result.ladders
    assert {1, 2, 3} <= set(ladders["anchors"]) <= set(AnchorRuns.ladder)
    assert {1, 2, 3} <= set(ladders["layers"]) <= set(pilot_direct.LAYER_LADDER)
    assert {1, 2} <= set(ladders["cells"]) <= set(pilot_direct.CELL_LADDER)
    for name, errors in ladders.items():
        assert all(0 <= error.value <= error.bound for error in errors.values())
        assert len(errors) == 1 or errors[1].value > errors[max(errors)].value, name
    assert WIDE in pilot_result.changes.parts and pilot_result.error(WIDE).value > 0
    assert {1, 2} <= set(ladders["followed_anchors"]) <= set(FollowedRuns.ladder)
    assert (
        pilot_result.sample_costs["direct"].paths
        == pilot_result.sample_costs["indirect"].paths
        == N * N
        < pilot_result.sample_costs["from_camera"].paths
    )
    assert pilot_result.sample_costs["indirect_residual"].paths == pilot_result.sample_costs["indirect"].paths
    assert pilot_result.sample_costs["camera_residual"].paths == pilot_result.sample_costs["from_camera"].paths
    assert pilot_result.forming.terms == len(bench.spectrum.weights)


def test_gloss_makes_noise_at_random_points_of_the_sensor(small_scene: Callable[..., Path], variant: str) -> None:
    """A glossy sheet differs over a sensor of 24 mm: light to random points of it is noisier than from ray to ray of a
    pixel. The pilot says how much: judged by eight groups of 16 samples. (Planted: the centre's noise for both.)"""
    gloss = (
        '<shape type="rectangle"><transform name="to_world"><rotate y="1" angle="180"/><scale x="60" y="60"/>'
        '<translate z="390"/></transform><bsdf type="roughconductor"><float name="alpha" value="0.1"/></bsdf></shape>'
    )
    bench = open_bench(small_scene(extra=gloss, pitch=0.375), variant, for_render=True)
    found, lighting = measured(bench, 1), parse_patterns("dots:4", N).lighting.shots(SHOWN)
    made = Simulation(bench, Settings(depth=found.depth, anchors=2))
    groups = [made.accumulate("direct", made.direct.trace(seed, 0, 16), lighting.labels, 16) for seed in range(8)]
    actual = Totals.of(expected_of([(made, groups)], np.arange(16), lighting, 0)).noise.value * 8**0.5
    assert promised(float(found.spread.error_left(16)), actual)
    assert found.spread.error_left(16) > 10 * found.sample_costs["direct"].error_left(16)


def test_depth_and_layers(bench: Bench, pilot_result: PilotResult) -> None:
    """The light is seen from the ball's top (300 mm) to the sheet (400 mm); layers are equidistant in 1/z."""
    assert 330 < pilot_result.depth < 400
    assert pilot_result.layers[1] == (pilot_result.depth,)
    for count, depths in pilot_result.layers.items():
        if count > 1:
            assert len(depths) == count and depths[0] == pytest.approx(400, rel=1e-3)
            assert 299 < depths[-1] < 320
            assert np.diff(1 / np.array(depths), 2) == pytest.approx(np.zeros(count - 2), abs=1e-9)


@pytest.mark.parametrize("effect", ["interreflection", "ambient", "diffraction"])
def test_effects_come_true(bench: Bench, pilot_result: PilotResult, effect: str) -> None:
    names = frozenset(effects.present(bench)) - {"speckle"}
    full = Settings(depth=pilot_result.depth, subdivision=2, effects=names)
    judge = frames(bench, full)
    actual = change(frames(bench, replace(full, effects=names - {effect})), judge)
    assert actual > 1e-3, "the scene has to call for it"
    assert promised(pilot_result.effects[effect].value, actual)


def test_anchors_come_true(bench: Bench, pilot_result: PilotResult) -> None:
    base = Settings(depth=pilot_result.depth, subdivision=2)
    every = frozenset(effects.present(bench)) - {"speckle"}
    light = np.linalg.norm(frames(bench, replace(base, effects=every)))
    judge = frames(bench, replace(base, anchors=5), 256, judging_cells=2)
    actual = np.linalg.norm(frames(bench, base, 256) - judge) / light
    assert actual > 2e-3
    assert promised(pilot_result.ladders["anchors"][1].value, actual)


def test_wide_cells_of_followed_light_come_true(bench: Bench, pilot_result: PilotResult) -> None:
    """What anchors see beyond their mean, in cells of four pixels and one layer, against cells of half a pixel and two
    layers. (Planted: the mean accumulated in the cells of indirect light; cells twice as wide.)"""
    every = frozenset(effects.present(bench)) - {"speckle"}
    base = Settings(
        depth=pilot_result.depth, subdivision=2, effects=every, followed_anchors=2, layers=pilot_result.layers[2]
    )
    base = replace(base, coarse_layers=True)
    accumulated = Simulation(bench, base)
    assert accumulated.grids["indirect_residual"].bundle.grid.rows.size == pytest.approx(
        4 * accumulated.grids["indirect"].bundle.grid.rows.size
    )
    judge, few = frames(bench, base, judging_cells=2), frames(bench, replace(base, followed_anchors=1), judging_cells=2)
    of_mean = frames(bench, replace(base, followed_anchors=1))
    actual = float(np.linalg.norm((frames(bench, base) - of_mean) - (judge - few)) / np.linalg.norm(judge))
    assert actual > 1e-3, "the scene has to call for it"
    assert promised(pilot_result.error(WIDE).value, actual)


@pytest.fixture(scope="module")
def direct_part(bench: Bench, pilot_result: PilotResult) -> float:
    """Of all light."""
    base = Settings(depth=pilot_result.depth, effects=frozenset({"diffraction"}))
    every = replace(base, effects=frozenset(effects.present(bench)) - {"speckle"})
    return float(np.linalg.norm(frames(bench, base)) / np.linalg.norm(frames(bench, every)))


def test_cells_come_true(bench: Bench, pilot_result: PilotResult, direct_part: float) -> None:
    """Against cells twice as fine as the finest that the pilot tries; of direct light, told as a part of all."""
    base = Settings(depth=pilot_result.depth, effects=frozenset({"diffraction"}))
    judge = frames(bench, replace(base, subdivision=2 * max(pilot_direct.CELL_LADDER)), 1024)
    for cells in (1, 2):
        actual = change(frames(bench, replace(base, subdivision=cells), 1024), judge)
        assert actual > 4e-4
        assert promised(pilot_result.ladders["cells"][cells].value, actual * direct_part)


def test_layers_come_true(bench: Bench, pilot_result: PilotResult, direct_part: float) -> None:
    base = Settings(depth=pilot_result.depth, subdivision=2, effects=frozenset({"diffraction"}))
    judge = frames(bench, replace(base, layers=pilot_result.layers[4]), 256)
    actual = change(frames(bench, base, 256), judge)
    assert actual > 2e-3
    assert promised(pilot_result.ladders["layers"][1].value, actual * direct_part)


def test_noise_comes_true(bench: Bench, pilot_result: PilotResult) -> None:
    """Spread of six estimates of direct light with sixteen samples; and of other light with two."""
    every = frozenset(effects.present(bench)) - {"speckle"}
    switched = {"direct": frozenset({"diffraction"}), "indirect": every, "from_camera": every}
    lighting = parse_patterns("dots:4", N).lighting.shots(SHOWN)
    labels = lighting.labels
    everything = frames(bench, Settings(depth=pilot_result.depth, subdivision=2, effects=every))
    for kind in switched:
        made = Simulation(bench, Settings(depth=pilot_result.depth, subdivision=2, effects=switched[kind]))
        each, noise = made.passes[kind], pilot_result.sample_costs[kind]
        samples = int(noise.samples)
        traced = [each.tracer.trace(integer(9, kind, index), 0, samples) for index in range(6)]
        groups = [made.accumulate(kind, found, labels, samples) for found in traced]
        found = [
            np.stack([frame.irradiance for frame in expected_of([(made, [light])], np.arange(16), lighting, 0)])
            for light in groups
        ]
        spread = np.sqrt(np.square(np.std(found, axis=0, ddof=1)).sum())
        norm = np.linalg.norm(np.mean(found, axis=0) if kind == "direct" else everything)
        # A few looks tell a spread with few degrees of freedom.
        assert 0.4 < noise.error / (spread / norm) < 2.5
        assert 0.5 <= noise.rate <= 1


@pytest.mark.slow
def test_frames_of_pilot_runs_are_those_that_a_capture_forms(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the sample's pixels, other rows than columns, from the same paths, with lamps and black pixels that leak.
    (Planted: lamps' light lost, the least light of a shot left out, places of rows for columns.)"""
    monkeypatch.setattr(pilot_direct, "_PLACES", 5)
    lighting = parse_patterns("dots:4", N).lighting
    sample = pilot_direct.Sample.of(lighting, bench.geometry.frame_shape, bench.loaded.mirrors)
    rows, columns = sample.places
    sample = replace(sample, places=(rows, tuple(place + 1 for place in columns[:-1])))
    everything = Settings(bench.geometry.scene_distance, subdivision=2, effects=frozenset(effects.present(bench)))
    found = EffectRuns(bench, everything, sample, 5)
    made = Simulation(bench, everything)
    accumulated = [
        made.accumulate("direct", pilot_direct, lighting.labels, sample.direct)
        + made.accumulate("indirect", PathSamples.join(list(pilot_indirect)), lighting.labels, sample.followed)
        for pilot_direct, *pilot_indirect in zip(found.direct, *found.followed.values(), strict=True)
    ]
    assert made.physics.lamps and made.physics.black_level and sample.shape == (5, 4) and bench.geometry.pixels > 5
    formed = [expected_of([(made, [light])], np.arange(16), sample.lighting, 0) for light in accumulated]
    expected = np.array([[frame.irradiance[np.ix_(*sample.places)] for frame in one] for one in formed])
    np.testing.assert_allclose(found.frames, expected, rtol=1e-9)


def test_stripes_of_a_hadamard_family_are_looked_at() -> None:
    """Without diffraction they are 7.7 % off, other shots 1.3 %. (Planted: four even shots, none of them stripes.)"""
    family = parse_patterns("hadamard:8", 32)
    shown = pilot_direct.Sample.of(family.lighting, (64, 64), False).lighting.weights
    rows = shown.reshape(len(shown), 8, 8)
    assert len(rows) == 16 and sum((row[0] == row).all() and row.any() and not row.all() for row in rows) >= 1


def test_a_ladder_ends_where_its_last_step_leaves_little() -> None:
    """As far as two steps tell: of changes that fall by a quarter, 1/16 is left after three. One step alone tells what
    the step before it leaves. (Planted: a further step to judge the last one; one step trusted as two are.)"""
    tried = list[int]()

    def step(count: int) -> np.ndarray:
        tried.append(count)
        return np.full((REPLICATES, 1), 0.25 ** [1, 2, 4, 8].index(count))

    found = pilot_direct.ladder((1, 2, 4, 8), step, 1, 0.07)
    assert tried == [1, 2, 4] and [float(change[0, 0]) for change in found.values()] == [-1, -0.25, -0.0625]
    tried.clear()
    pilot_direct.ladder((1, 2, 4, 8), step, 1, 1.0)
    assert tried == [1, 2, 4], "0.75 of one step may leave as much again, which is more than 1.0 with it"
    tried.clear()
    pilot_direct.ladder((1, 2, 4, 8), step, 1, 1.6)
    assert tried == [1, 2]


def test_a_flat_scene_needs_no_layers(small_scene: Callable[..., Path]) -> None:
    found = measured(open_bench(small_scene()), 0)
    assert found.depth == 400.0 and found.ladders["layers"] == {1: (0.0, 0.0)} and found.layers == {1: (400.0,)}
    assert found.effects["interreflection"] == (0, 0) and "ambient" not in found.effects


def test_a_mask_that_is_closed_before_the_sensor_is_refused(small_scene: Callable[..., Path]) -> None:
    """Its features are wider than the sensor sees, and the middle one is closed: it was a division by zero."""
    with pytest.raises(MitsimError, match=r"no light of the projector passes the mask.* features are 40 mm wide"):
        measured(open_bench(small_scene("closed", mask_feature=40)), seed=0)
