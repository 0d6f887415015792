"""The pilot's predictions come true: what it says that leaving something out changes is what careful runs find.

The scene calls for everything at once: a sensor of 24 mm near a ball and a corner, under a sky. Each prediction is held
against frames of many more samples; the pilot sees a few, so a factor of 1.5 either way is its promise here.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.bench import effects
from mitsim.bench.effects import EFFECTS
from mitsim.core.errors import MitsimError
from mitsim.core.seeds import integer
from mitsim.devices.patterns import parse_patterns
from mitsim.light.settings import REPLICATES, WIDE, Approximation, ErrorCovariance, PilotResult, Settings
from mitsim.light.simulation import Simulation, expected_of
from mitsim.optics.frames import monte_carlo_error
from mitsim.planner import pilot, pilot_direct, pilot_effects
from mitsim.planner.pilot_effects import AnchorRuns, EffectRuns, FollowedRuns
from mitsim.transport.integrator import FollowingTracer, Tracer
from mitsim.transport.path_reuse import PathReuseTracer
from mitsim.transport.records import DIRECT, INDIRECT, PathSamples

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
    actual = monte_carlo_error(expected_of([(made, groups)], np.arange(16), lighting, 0)) * 8**0.5
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


@pytest.mark.slow
def test_anchors_of_followed_light_come_true(bench: Bench, pilot_result: PilotResult) -> None:
    """Light between the ball, the wall and the sheet differs over the sensor of 24 mm. (Planted: paths from the camera
    that are accumulated as seen from their start.)"""
    every = frozenset(effects.present(bench)) - {"speckle"}
    base = Settings(depth=pilot_result.depth, subdivision=2, effects=every)
    light = np.linalg.norm(frames(bench, base))
    judge = frames(bench, replace(base, followed_anchors=5), 64, 96)
    actual = np.linalg.norm(frames(bench, base, 64, 96) - judge) / light
    found = pilot_result.ladders["followed_anchors"]
    assert actual > 1e-3, "the scene has to call for it"
    assert promised(found[1].value, actual)
    few = np.linalg.norm(frames(bench, replace(base, followed_anchors=2), 64, 96) - judge) / light
    assert few < actual / 2


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


@pytest.mark.slow
def test_light_to_many_anchors_is_traced_in_parts(
    bench: Bench, pilot_result: PilotResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of it at once takes gigabytes. Parts of two samples make the same ladder but for the order of sums.
    (Planted: every part from the first sample on.)"""
    monkeypatch.setattr(
        pilot_effects,
        "_AT_ONCE",
        2 * 9 * (pilot_result.sample_costs["indirect_residual"].paths + pilot_result.sample_costs["from_camera"].paths),
    )
    again = measured(bench, seed=3).ladders["followed_anchors"]
    for count, error in pilot_result.ladders["followed_anchors"].items():
        assert again[count] == pytest.approx(error, rel=1e-6)


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


def test_a_print_in_the_projectors_pixels_needs_no_finer_cells(small_scene: Callable[..., Path]) -> None:
    found = measured(open_bench(small_scene()), 0, accuracy=1e-3).ladders["cells"]
    assert max(found.values()).value < 6e-4, "falloff within a pixel of 7.5 mm"


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
    formed = [expected_of([(made, [light])], sample.rows, sample.lighting, 0) for light in accumulated]
    expected = np.array([[frame.irradiance[np.ix_(*sample.places)] for frame in one] for one in formed])
    np.testing.assert_allclose(found.frames, expected, rtol=1e-9)


@pytest.mark.slow
def test_followed_light_of_either_side_has_its_own_noise(bench: Bench) -> None:
    """At anchors, as a tracer alone would make it; their squares add up. (Planted: one side's for the other's, all
    light's for one of them.)"""
    lighting = parse_patterns("dots:4", N).lighting
    sample = pilot_direct.Sample.of(lighting, bench.geometry.frame_shape, bench.loaded.mirrors)
    everything = Settings(bench.geometry.scene_distance, subdivision=2, effects=frozenset(effects.present(bench)))
    found = FollowedRuns(bench, everything, sample, 0.0, 5)
    indirect, camera = found.sample_costs(1.0).values()
    alone, nothing = FollowedRuns(bench, everything, sample, 0.0, 5), [PathSamples.none()] * REPLICATES
    vars(alone)["_few_by_tracer"] = [found._few_by_tracer[0], nothing]
    assert indirect.error == pytest.approx(pilot_direct.noise(alone._beyond_mean(1, ())), rel=1e-9)
    both = pilot_direct.noise(found._beyond_mean(1, ()))
    assert math.hypot(indirect.error, camera.error) == pytest.approx(both, rel=0.3)
    assert (indirect.paths, camera.paths) == tuple(tracer.paths_per_sample for tracer in found._simulation().at_anchors)


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


def test_what_costs_more_to_ask_than_it_saves_is_not_asked(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether paths are shared, where indirect light takes little; and no closer look than a part of that light.
    (Planted: always asked; a closer look whatever it takes.)"""
    lighting = parse_patterns("dots:4", N).lighting
    sample = pilot_direct.Sample.of(lighting, bench.geometry.frame_shape, bench.loaded.mirrors)
    everything = Settings(bench.geometry.scene_distance, subdivision=2, effects=frozenset(effects.present(bench)))
    monkeypatch.setattr(pilot_effects, "_OF_INDIRECT", 1e-12)
    loose, close = (EffectRuns(bench, everything, sample, 5, (450.0, 330.0), reported) for reported in (1.0, 1e-7))
    tried = list[object]()
    monkeypatch.setattr(PathReuseTracer, "shares", lambda tracer: bool(tried.append(tracer)))
    for found, asked in ((loose, False), (close, True)):
        found.indirect_cost()
        assert bool(tried) == asked and found._looks[1].samples == sample.followed


def test_indirect_light_is_looked_at_closer_where_noise_hides_what_coarse_cells_change(bench: Bench) -> None:
    """By looks of their own, whose light and noise are as large as told before. (Planted: samples of the first looks
    for either, the first looks' seeds, no closer looks at all.)"""
    lighting = parse_patterns("dots:4", N).lighting
    sample = pilot_direct.Sample.of(lighting, bench.geometry.frame_shape, bench.loaded.mirrors)
    everything = Settings(bench.geometry.scene_distance, subdivision=2, effects=frozenset(effects.present(bench)))
    first, close = (EffectRuns(bench, everything, sample, 5, (450.0, 330.0), reported) for reported in (1.0, 1e-7))
    seen = [ErrorCovariance.between(found.changes, found.light**2) for found in (first, close)]
    open_ = [
        bound**2 - value**2 for value, bound in (each.estimate([Approximation("indirect cells", 1)]) for each in seen)
    ]
    assert open_[1] < open_[0] / 4
    one, two = (each.estimate([Approximation("indirect layers", 1)]).value for each in seen)
    assert two == pytest.approx(one, rel=0.3)
    noises = [found.sample_costs["indirect"] for found in (first, close)]
    assert [noise.samples for noise in noises] == [sample.followed, 16 * sample.followed]
    assert 0.5 < noises[1].error * math.sqrt(16) / noises[0].error < 2
    one, two = (found._looks[1][0][0].value[:50] for found in (first, close))
    assert not np.array_equal(one, two)


def test_the_pilot_is_reproducible(bench: Bench) -> None:
    """Of few shots and at a loose accuracy: all parts of the pilot have their turn."""
    lighting = parse_patterns("dots:2", N).lighting
    one, again = (pilot.PilotRuns(bench, lighting, 0.1, 3).pilot_result for _ in range(2))
    for name in ("depth", "layers", "effects", "ladders"):
        assert getattr(again, name) == getattr(one, name)
    assert np.array_equal(again.changes.products, one.changes.products)


@pytest.mark.slow
def test_the_pilot_of_a_flat_scene_is_reproducible(small_scene: Callable[..., Path]) -> None:
    flat = open_bench(small_scene())
    one, again, other = (measured(flat, seed) for seed in (3, 3, 4))
    assert again.effects == one.effects and np.array_equal(again.changes.products, one.changes.products)
    assert other.effects != one.effects and other.ladders["anchors"] != one.ladders["anchors"]


def test_a_flat_scene_needs_no_layers(small_scene: Callable[..., Path]) -> None:
    found = measured(open_bench(small_scene()), 0)
    assert found.depth == 400.0 and found.ladders["layers"] == {1: (0.0, 0.0)} and found.layers == {1: (400.0,)}
    assert found.effects["interreflection"] == (0, 0) and "ambient" not in found.effects


def test_light_is_followed_only_where_surfaces_see_each_other(
    small_scene: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sheet, and a plate before it that faces as it does: nothing is followed. Turned by a degree, it is."""
    followed = list[str]()
    replicates = Tracer.replicates

    def count(tracer: Tracer, *arguments: Any, **options: Any) -> list[list[PathSamples]]:
        followed.extend([type(tracer).__name__] * isinstance(tracer, FollowingTracer))
        return replicates(tracer, *arguments, **options)

    monkeypatch.setattr(Tracer, "replicates", count)
    for angle in (180, 181):
        place = f'<scale value="20"/><rotate y="1" angle="{angle}"/><translate z="390"/>'
        bsdf = '<bsdf type="diffuse"><spectrum name="reflectance" value="0.5"/></bsdf>'
        plate = f'<shape type="rectangle"><transform name="to_world">{place}</transform>{bsdf}</shape>'
        assert "interreflection" in measured(open_bench(small_scene(extra=plate)), 0).effects
        assert bool(followed) == (angle == 181)


def test_coarse_cells_of_what_anchors_see_are_looked_at_where_they_may_matter(bench: Bench) -> None:
    """Where one cell, and one layer, leave little of all light, and anchors see little beyond their mean, neither is.
    (Planted: the part of the mean, not of what is beyond it.)"""
    runs = pilot.PilotRuns(bench, parse_patterns("dots:4", N).lighting, 1e-2, 3)
    cells, layers = (Approximation(f"anchor_residual {what}", 1) for what in ("cells", "layers"))
    enough = 1 / (15 * pilot_direct.norm(runs.anchored._beyond_mean(1, ())))
    for coarse, looked_at in (
        ((0.9 * enough, 0.9 * enough), set()),
        ((1.1 * enough, 0.9 * enough), {cells}),
        ((0.9 * enough, 1.1 * enough), {cells, layers}),
    ):
        runs.anchored.coarse = coarse
        vars(runs.anchored).pop("changes", None)
        assert {part for part in runs.anchored.changes if part.name.startswith("anchor_")} == looked_at


def test_noise_of_light_over_mirrors_counts_with_that_of_indirect_light(bench: Bench) -> None:
    """Light whose kind is direct light's, as over mirrors and curved glass, comes by the same paths. (Planted: indirect
    light alone.)"""
    sample = pilot_direct.Sample.of(
        parse_patterns("dots:4", N).lighting, bench.geometry.frame_shape, bench.loaded.mirrors
    )
    everything = Settings(bench.geometry.scene_distance, subdivision=2, effects=frozenset(effects.present(bench)))
    found = EffectRuns(bench, everything, sample, 5)
    seen = found._looks[1]
    halves = [
        replace(light, kind=np.where(np.arange(light.value.size) % 2, DIRECT, INDIRECT).astype(np.int16))
        for light in seen.indirect
    ]
    parted = pilot_effects.Bounced.of(halves, seen.samples)
    assert found._noise_of_bounced(parted) == pytest.approx(found._noise_of_bounced(seen), rel=0.1)
    assert pilot_direct.noise(found._indirect(1, (), parted)) < 0.85 * found._noise_of_bounced(seen)


def test_more_anchors_see_a_faint_camera_part_as_few_do(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Then it is not traced again, and nothing of it is lost. (Planted: frames without it; those of one anchor.)"""
    runs = pilot.PilotRuns(bench, parse_patterns("dots:4", N).lighting, 1e-2, 3)
    others = runs.samples["followed"], math.inf, 3, runs.fine.judging
    whole = pilot_effects.FollowedRuns(bench, runs._everything, *others)
    monkeypatch.setattr(pilot_effects, "_FAINT", 0.0)
    apart = whole._frames(3)
    monkeypatch.setattr(pilot_effects, "_FAINT", 0.6)
    faint = pilot_effects.FollowedRuns(bench, runs._everything, *others)
    traced = list[str]()
    replicates = Tracer.replicates

    def count(tracer: Tracer, *arguments: Any, **options: Any) -> list[list[PathSamples]]:
        traced.append(type(tracer).__name__)
        return replicates(tracer, *arguments, **options)

    faint._frames(2)
    monkeypatch.setattr(Tracer, "replicates", count)
    seen = faint._frames(3)
    assert len(traced) == 1 and "Camera" not in traced[0]
    camera = float(np.linalg.norm(whole._form(whole._grids(whole._simulation(2)), whole._few_by_tracer[1])))
    assert float(np.linalg.norm(seen - apart)) < 0.5 * camera
    assert camera > 0.1 * float(np.linalg.norm(apart))


def test_coarse_cells_of_faint_indirect_light_are_not_looked_at(bench: Bench) -> None:
    """Where the bound on what they leave, by what they leave of direct light, is below the accuracy. (Planted: the
    bound of direct light, not of its part.)"""
    lighting = parse_patterns("dots:4", N).lighting
    sample = pilot_direct.Sample.of(lighting, bench.geometry.frame_shape, bench.loaded.mirrors)
    everything = Settings(bench.geometry.scene_distance, subdivision=2, effects=frozenset(effects.present(bench)))
    followed = EffectRuns(bench, everything, sample, 5)
    direct = sum(float(light.value.sum()) for light in followed.direct) / (REPLICATES * sample.direct)
    part = followed.received / (direct + followed.received)
    enough = pilot_direct.GOOD_ENOUGH * 1e-2 / (15 * part)
    for left, looked_at in ((0.9 * enough, False), (1.1 * enough, True), (0.0, True)):
        found = EffectRuns(bench, everything, sample, 5, (), 1e-2, partial(tuple, (left / 2, left)))
        assert bool(found._coarse) == looked_at
        assert found.sample_costs["indirect"].error


def test_noise_over_a_flat_matt_scene_is_that_at_its_centre(small_scene: Callable[..., Path]) -> None:
    """No ray is traced for what can be no other; nor where the nearest surface is no nearer than all light. Four
    replicates tell either noise to some 40 %; over gloss they would differ by a factor. (Planted: rays for any scene.)
    """
    flat = pilot.PilotRuns(open_bench(small_scene()), parse_patterns("dots:4", N).lighting, 1e-2, 0)
    assert flat.fine.sample_cost(1.0, spread=True) == flat.fine.sample_cost(1.0) and set(flat.fine._noises) == {False}
    _, seen = flat.fine._trace(1, spread=True)
    over = pilot_direct.noise(flat.fine._form(flat.fine._simulation, seen, flat.fine.sample.fine))
    assert 0.5 < over / flat.fine.sample_cost(1.0).error < 2


@pytest.mark.usefixtures("soon_dark")
def test_a_scene_without_light_is_refused(small_scene: Callable[..., Path]) -> None:
    away = open_bench(small_scene(projector_turn='<rotate y="1" angle="180"/>'))
    with pytest.raises(MitsimError, match="no light of the projector reaches the camera"):
        measured(away, seed=0)
    black = open_bench(small_scene("black"), albedo="0")
    with pytest.raises(MitsimError, match="no light of the projector reaches the camera"):
        measured(black, seed=0)


def test_a_mask_that_is_closed_before_the_sensor_is_refused(small_scene: Callable[..., Path]) -> None:
    """Its features are wider than the sensor sees, and the middle one is closed: it was a division by zero."""
    with pytest.raises(MitsimError, match=r"no light of the projector passes the mask.* features are 40 mm wide"):
        measured(open_bench(small_scene("closed", mask_feature=40)), seed=0)


def test_applicable(bench: Bench, small_scene: Callable[..., Path], tmp_path: Path) -> None:
    assert "ambient" in effects.present(bench) and "mirrors" not in effects.present(bench)
    projector = tmp_path / "projector.toml"
    projector.write_text('name = "ideal"\neffective_wavelength_nm = 562.0\n')
    assert effects.present(open_bench(small_scene(), projector=projector)) == ("interreflection", "diffraction")
    projector.write_text(
        'name = "all"\neffective_wavelength_nm = 562.0\ncontrast_ratio = 100.0\naperture_radius_mm = 1.0\n'
        "blur_pixels = 0.5\nspeckle_contrast = 0.01\n"
    )
    found = effects.present(open_bench(small_scene(), projector=projector))
    assert found == ("interreflection", "diffraction", "aperture", "blur", "black-level", "speckle")


@pytest.mark.slow
def test_a_mirror_shows_some_shots_only(shipped_bench: Callable[..., Bench]) -> None:
    """A mirror brings the light of a few projector pixels to the sensor; shots that do not show them see black pixels
    alone, and four of 49 have no such shot among them. What black pixels change, against the frames of all shots in
    closed form, (1 - b) of a class and b of all. (Planted: four shots, as of a print: 6.0e-5 of 8.8e-5.)"""
    bench = shipped_bench("mirror")
    lighting = parse_patterns("dots:7", bench.n).lighting
    found = pilot.PilotRuns(bench, lighting, 1e-3, 1).pilot_result.effects["black-level"]
    made = Simulation(bench, Settings(depth=400.0, effects=frozenset(effects.present(bench))))
    specular, black = made.specular_frames(lighting.labels), made.physics.black_level
    assert specular is not None
    seen = np.zeros((49, 512, 512))
    seen[specular.classes] = specular.irradiance
    everything = black * seen.sum(axis=0)
    actual = np.linalg.norm(everything - black * seen) / np.linalg.norm(everything + (1 - black) * seen)
    assert found.value == pytest.approx(actual, rel=0.1)


@pytest.mark.slow
def test_a_refined_run_is_in_what_was_found(bench: Bench) -> None:
    """More samples of a run tell its changes with half of the standard error. (Planted: the former is kept.)"""
    runs = pilot.PilotRuns(bench, parse_patterns("dots:4", N).lighting, 1e-2, seed=3)
    before, cells = runs.pilot_result, Approximation("cells", 1)
    runs.refine("cells")
    after = runs.pilot_result
    spread = [each.bound**2 - each.value**2 for each in (result.error(cells) for result in (before, after))]
    assert after is not before
    assert spread[1] != spread[0]
