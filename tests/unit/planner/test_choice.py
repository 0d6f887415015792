"""The choice of settings: from measured changes to the least work that keeps an accuracy, all that is left counted."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mitsim.bench.effects import parse_switches
from mitsim.light.cost_model import Numbers, entries
from mitsim.light.passes import PASSES
from mitsim.light.settings import (
    COUNTED,
    GROUPS,
    REPLICATES,
    Approximation,
    ErrorCovariance,
    PilotResult,
    SampleCost,
    SharpPixels,
)
from mitsim.planner.choose import Candidates, counts_of, predicted_candidate, value_of_refining
from tests.unit.planner.invented_pilot_result import (
    ACCURACIES,
    APART,
    ONE_CLASS,
    PILOT_RESULT,
    SIZES,
    changes,
    cheapest,
    plan,
    with_occluded,
    with_sample_costs,
)

COSTLY = {"interreflection", "ambient", "diffraction", "black-level"}


def random_pilot_result(seed: int) -> PilotResult:
    """Changes of any size and angle to each other, and light of any noise."""
    rng = np.random.default_rng(seed)
    sizes = {part: size * 10 ** rng.uniform(-1, 1) for part, size in SIZES.items()}
    mixed = rng.normal(size=(len(sizes), 6))
    mixed *= (np.array(list(sizes.values())) / np.linalg.norm(mixed, axis=1))[:, None]
    replicates = mixed[:, None] + 3e-5 * rng.normal(size=(len(sizes), REPLICATES, 6))
    names = "direct", "spread", "anchor_residual", "indirect", "from_camera", "indirect_residual"
    costs = {name: PILOT_RESULT.sample_costs.get(name, PILOT_RESULT.spread) for name in names}
    costs = {name: SampleCost(10 ** rng.uniform(-4, -1.5), 4, cost.paths) for name, cost in costs.items()}
    found = ErrorCovariance.between(dict(zip(sizes, replicates, strict=True)), 1.0)
    return with_sample_costs(replace(PILOT_RESULT, changes=found, spread=costs.pop("spread")), **costs)


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("accuracy", ACCURACIES)
def test_no_choice_that_fits_is_cheaper(accuracy: float, seed: int) -> None:
    """Minimality, by other roads than the search's own: each thing that is on is switched off, each number made less.

    Whatever is cheaper breaks the accuracy; and what was chosen keeps it. What takes no time stays on: no error is left
    in the hope that it makes up for another.
    """
    pilot_result = random_pilot_result(seed)
    chosen = cheapest(accuracy, pilot_result, {})
    if not chosen.fits:
        return
    assert chosen.total.bound <= accuracy
    now = chosen.settings
    others = [replace(now, effects=now.effects - {name}) for name in COSTLY & now.effects]
    others += [replace(now, anchors=count) for count in pilot_result.ladders["anchors"]]
    others += [
        replace(now, layers=pilot_result.layers[count] if count > 1 else ()) for count in pilot_result.ladders["layers"]
    ]
    others += [replace(now, subdivision=count) for count in pilot_result.ladders["cells"]]
    others += [replace(now, coarse_layers=all_) for all_ in (False, True)]
    others += [replace(now, effects=frozenset({"blur", "speckle"}), anchors=1, layers=(), subdivision=1)]
    for settings in others:
        other = predicted_candidate(accuracy, pilot_result, settings, {})
        assert not other.fits or other.work >= chosen.work * (1 - 1e-12)


@pytest.mark.parametrize("accuracy", ACCURACIES)
def test_the_total_is_predicted_from_all_that_is_left(accuracy: float) -> None:
    """At right angles, squares add up. Where nothing is followed, it does not matter to how many points."""
    chosen = cheapest(accuracy, PILOT_RESULT, {})
    settings = chosen.settings
    counts = zip(COUNTED, counts_of(settings), strict=True)
    parts = {Approximation(*count) for count in counts}
    parts |= {Approximation(name) for name in PILOT_RESULT.effects if name not in settings.effects}
    assert {part.name for part in parts if not part.count} == set(PILOT_RESULT.effects) - settings.effects
    squares = sum(SIZES.get(part, APART.get(part.name, 0.0)) ** 2 for part in parts)
    if "interreflection" in settings.effects:
        layered = (
            SIZES[Approximation("layers", len(settings.depths))] / SIZES[Approximation("layers", 1)]
            if settings.coarse_layers
            else 1
        )
        squares += (4e-4 / settings.coarse_cells**2) ** 2 + (3e-4 * layered) ** 2
    if settings.anchors > 1:
        squares += (2e-4 / settings.coarse_cells**2) ** 2
    if not {"interreflection", "ambient"} & settings.effects:
        squares -= SIZES[Approximation("followed_anchors", settings.followed_anchors)] ** 2
    expected = math.sqrt(squares)
    assert chosen.systematic.value == pytest.approx(expected, rel=1e-6)
    assert chosen.total.value == pytest.approx(math.hypot(expected, chosen.noise))


def test_opposite_errors_are_left_together() -> None:
    """Cells and a lens that change the frames by 8e-4 each, one against the other: at 1e-3 neither is needed.

    The same with the same sign: 1.6e-3, so that one of them must go.
    """
    sizes = {part: 0.0 for part in SIZES if part.name not in ("cells", "diffraction")}
    for sign, fits in ((-1.0, True), (1.0, False)):
        vectors = {part: np.zeros((REPLICATES, 2)) for part in sizes}
        vectors[Approximation("cells", 1)], vectors[Approximation("cells", 2)] = (
            np.full((REPLICATES, 2), 5.6e-4),
            np.zeros((REPLICATES, 2)),
        )
        vectors[Approximation("diffraction")] = sign * np.full((REPLICATES, 2), 5.6e-4)
        pilot_result = replace(PILOT_RESULT, changes=ErrorCovariance.between(vectors, 1.0), apart={})
        bare = replace(cheapest(1e-3, pilot_result, {}).settings, effects=frozenset({"blur"}), subdivision=1)
        assert predicted_candidate(1e-3, pilot_result, bare, {}).fits == fits


def test_light_that_is_missing_leaves_less_for_other_errors_to_be_part_of() -> None:
    """A fifth of the light, and a tenth, come over what no tracer finds: errors are those of the rest."""
    settings = cheapest(1e-2, PILOT_RESULT, {}).settings
    lacking = replace(PILOT_RESULT, unresolved=0.2, left_out=0.1)
    before, after = (
        predicted_candidate(1e-2, pilot_result, settings, {}).systematic for pilot_result in (PILOT_RESULT, lacking)
    )
    assert before.value > 1e-3 and after == pytest.approx([0.3 + 0.7 * error for error in before])


def test_what_the_pilot_cannot_tell_is_on() -> None:
    """Interreflection of 5e-4 fits into 1e-3 when it is known, and does not when it may be twice as much."""
    sizes = {part: size * 0.1 for part, size in SIZES.items()} | {Approximation("interreflection"): 5e-4}
    sure = replace(PILOT_RESULT, changes=changes(sizes), apart={})
    noisy = changes({Approximation("interreflection"): 5e-4}, 3e-3).products[:, :, 0, 0]
    place, products = sure.changes.parts.index(Approximation("interreflection")), sure.changes.products.copy()
    products[:, :, place, place] = noisy
    unsure = replace(sure, changes=ErrorCovariance(sure.changes.parts, products))
    assert "interreflection" not in cheapest(1e-3, sure, {}).settings.effects
    careful, hopeful = (cheapest(1e-3, unsure, {}, sigmas).settings.effects for sigmas in (2.35, 0.0))
    assert "interreflection" in careful
    worth, part = value_of_refining(1e-3, Candidates(unsure, {}))
    assert worth > 0 and part == Approximation("interreflection") and "interreflection" not in hopeful
    assert value_of_refining(1e-3, Candidates(sure, {}))[0] == 0


@pytest.mark.parametrize("accuracy", [1e-3, 1e-4, 1e-6])
def test_no_light_is_asked_for_that_cannot_be_held(accuracy: float) -> None:
    """Of 49 classes indirect light lies in all cells of each: 2^25 entries a group are 12 GB. (Planted: no limit.)"""
    settings, pixels = cheapest(accuracy, PILOT_RESULT, {}).settings, PILOT_RESULT.sample_costs["direct"].paths
    assert entries(pixels, 49, Numbers.of(settings), settings) <= 2**25
    samples = {**settings.samples, "indirect": 1e5, "indirect_residual": 1e5}
    finest = replace(settings, anchors=64, followed_anchors=64, samples=samples)
    assert entries(pixels, 49, Numbers.of(finest), finest) > 2**28


@pytest.mark.parametrize("accuracy", ACCURACIES)
def test_occluded_pixels_have_several_anchors_where_the_others_do(accuracy: float) -> None:
    """One anchor is the sensor's centre, several stand for all of the sensor: for all pixels or for none. What is left
    of either counts. (Planted: the numbers chosen apart; the occluded pixels' share not counted.)"""
    pilot_result = with_occluded({1: 6e-3, 2: 3e-3, 5: 7e-4, 16: 1e-4, 32: 3e-5})
    chosen = cheapest(accuracy, pilot_result, {})
    settings = chosen.settings
    assert (settings.anchors > 1) == (settings.occluded_anchors > 1) and settings.occluded == tuple(range(150))
    assert chosen.fits and chosen.total.bound <= accuracy
    left = {1: 6e-3, 2: 3e-3, 5: 7e-4, 16: 1e-4, 32: 3e-5}[settings.occluded_anchors]
    with_none = predicted_candidate(accuracy, with_occluded({1: 0.0}), replace(settings, occluded_anchors=1), {})
    assert chosen.systematic.value == pytest.approx(math.hypot(with_none.systematic.value, left), rel=1e-6)
    off = cheapest(1e-3, pilot_result, {"anchors": False})
    assert off.settings.anchors == off.settings.occluded_anchors == 1 and off.fits, "what the user wants does not count"


def test_samples_take_the_least_work_for_the_target() -> None:
    """Variances v / N add up to the target's over 1.1, as sampling stops by a bound that lies so far above the error.

    N is in proportion to sqrt(v / unit cost): the least sum of costs. Whole numbers make both a little better.
    """
    silent = {"error": 0.0, "samples": 1, "rate": 0.5}
    costs = {name: replace(PILOT_RESULT.sample_costs[name], **silent)
             for name in ("direct", "anchor_residual", "indirect_residual")}  # fmt: skip
    costs["from_camera"] = SampleCost(3e-2, 2, 20_000)
    pilot_result = with_sample_costs(replace(PILOT_RESULT, spread=replace(PILOT_RESULT.spread, **silent)), **costs)
    found = cheapest(1e-3, pilot_result, parse_switches("+interreflection"))
    settings = found.settings
    counts = settings.samples["indirect"], settings.samples["from_camera"]
    variances = pilot_result.sample_costs["indirect"].variance, pilot_result.sample_costs["from_camera"].variance
    unit_costs = 16_384 * PASSES["indirect"].unit_cost, 20_000 * PASSES["from_camera"].unit_cost
    kinds = list(zip(variances, counts, unit_costs, strict=True))
    assert math.sqrt(sum(v / n for v, n, _ in kinds) / GROUPS) == pytest.approx(found.target / 1.1, rel=0.01)
    assert math.sqrt(sum(v / n for v, n, _ in kinds) / GROUPS) < found.target / 1.1
    ratios = [n / math.sqrt(v / price) for v, n, price in kinds]
    assert ratios[0] == pytest.approx(ratios[1], rel=0.02) and min(counts) > 50


def test_one_hit_of_a_small_target_is_a_quarter_of_the_noise_and_counts_beside_it() -> None:
    """Of few hits a group is off by 0.75 rms, by 1.5 at most: what is left out and that are in quadrature. (Planted:
    1.5 for both; samples whatever the hits.)"""
    few = replace(PILOT_RESULT, hits=0.5)
    chosen = cheapest(1e-2, few, {})
    one_hit = 1 / (few.hits * float(PASSES["direct"].whole(chosen.settings.samples["direct"])))
    assert chosen.settings.samples["direct"] > 4 * cheapest(1e-2, PILOT_RESULT, {}).settings.samples["direct"]
    assert 0.2 < one_hit / chosen.target <= 0.25
    rest = predicted_candidate(1e-2, PILOT_RESULT, chosen.settings, {}).systematic
    assert chosen.systematic.value == pytest.approx(math.hypot(rest.value, 0.75 * one_hit))
    assert chosen.systematic.bound == pytest.approx(math.hypot(rest.bound, 1.5 * one_hit))
    assert chosen.fits and chosen.total.bound <= 1e-2


def test_doubt_of_the_pilot_is_in_the_bound_alone() -> None:
    """The error that is predicted is the best estimate, its bound 2.35 standard errors of the square above it.
    (Planted: one standard error in both.)"""
    doubtful = replace(PILOT_RESULT, changes=changes(SIZES, 2e-3), apart={})
    bare = replace(cheapest(0.1, doubtful, {}).settings, effects=frozenset({"blur", "diffraction"}), layers=())
    bare = replace(bare, anchors=1, followed_anchors=1, subdivision=1)
    left = {Approximation("anchors", 1), Approximation("layers", 1), Approximation("cells", 1)}
    left |= {Approximation("interreflection"), Approximation("ambient")}
    found = predicted_candidate(0.1, doubtful, bare, {}).systematic
    assert found == pytest.approx(doubtful.changes.estimate(left)) and found.bound > 1.002 * found.value


def test_what_interpolation_leaves_of_sharp_light_counts() -> None:
    """Points for sharp lobes leave 6e-4 of the light between them. (Planted: nothing left.)"""
    sharp = SharpPixels((3, 4), 7, (-0.1, 0.1, -0.1, 0.1), 6e-4)
    light = SampleCost(1e-4, 4, 98, 0.75)
    found, exact = (
        with_sample_costs(replace(ONE_CLASS, sharp=each), sharp=light) for each in (sharp, replace(sharp, left=0.0))
    )
    chosen = cheapest(1e-3, found, {})
    without = predicted_candidate(1e-3, exact, replace(chosen.settings, sharp=exact.sharp), {})
    assert chosen.fits and chosen.systematic.value == pytest.approx(math.hypot(without.systematic.value, 6e-4))
    assert not cheapest(5e-4, found, {}).fits
    assert any("anchors of sharp light (7), 6.0e-04" in warning for warning in plan(5e-4, found).warnings)
