"""Pilot result of a scene that nobody rendered: a pilot's word on every effect in, plans and their rows out.

Sizes of changes are chosen so that each accuracy of ``ACCURACIES`` needs others of them.

The choice of settings: from measured changes to the least work that keeps an accuracy, all that is left counted.

What a plan says: of devices that the model does not cover, of effects, and as JSON; benches are plain numbers.

The accuracy that a time buys, of an invented pilot: light takes PRICE / accuracy^2 seconds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mitsim.api.bench import Bench
from mitsim.bench.effects import parse_switches
from mitsim.devices.patterns import Lighting
from mitsim.light.cost_model import (
    Numbers,
    accumulation_seconds,
    checking_seconds,
    entries,
    optics_seconds,
    tracing_seconds,
    truth_seconds,
)
from mitsim.light.passes import PASSES
from mitsim.light.plan import Plan, PlanRow
from mitsim.light.settings import (
    CELLS_OF_COARSE,
    COUNTED,
    GROUPS,
    REPLICATES,
    SURE,
    WIDE,
    Approximation,
    ErrorCovariance,
    Estimate,
    Forming,
    PilotResult,
    SampleCost,
    Settings,
    SharpPixels,
)
from mitsim.planner import planner
from mitsim.planner.choose import Candidate, Candidates, counts_of, table_of, value_of_refining
from mitsim.planner.planner import SceneFacts, explain_plan
from mitsim.scene.check import Unfit
from mitsim.scene.outline import Tag

FACTS = SceneFacts(notes={"diffraction": "Fresnel number 3.2"}, keystone=0.0)
SIZES = {
    **{Approximation("anchors", count): size for count, size in {1: 2e-3, 2: 3e-4, 3: 4e-5, 5: 1e-5}.items()},
    **{Approximation("layers", count): size for count, size in {1: 4e-3, 2: 6e-4, 3: 2e-4, 4: 5e-5}.items()},
    **{Approximation("cells", count): size for count, size in {1: 6e-3, 2: 2e-3, 4: 1e-4, 8: 1e-5}.items()},
    **{
        Approximation(name): size
        for name, size in {"interreflection": 2e-2, "diffraction": 0.3, "ambient": 5e-4}.items()
    },
    **{Approximation("followed_anchors", count): size for count, size in {1: 7e-4, 2: 9e-5, 3: 1e-5}.items()},
    Approximation("blur"): 1e-3,
    Approximation("anchor_residual cells", 1): 2e-4,
    Approximation("indirect cells", 1): 4e-4,
    Approximation("indirect layers", 1): 3e-4,
}
APART = {"speckle": 8e-3}


def changes(sizes: dict[Approximation, float], noise: float = 0.0, seed: int = 0) -> ErrorCovariance:
    """Changes at right angles to each other, each look with ``noise`` of its own: independent, of norm ``noise``."""
    rng, count = np.random.default_rng(seed), len(sizes)
    vectors = np.diag(list(sizes.values()))
    space = count + 40
    exact = np.zeros((count, space))
    exact[:, :count] = vectors
    replicates = exact[:, None] + noise * rng.normal(size=(count, REPLICATES, space)) / math.sqrt(space)
    return ErrorCovariance.between(dict(zip(sizes, replicates, strict=True)), 1.0)


PILOT_RESULT = PilotResult(
    depth=380.0,
    layers={1: (380.0,), 2: (400.0, 300.0), 3: (400.0, 343.0, 300.0), 4: (400.0, 369.0, 327.0, 300.0)},
    changes=changes(SIZES),
    sample_costs={
        "direct": SampleCost(2e-3, 16, 16_384, 0.8),
        "anchor_residual": SampleCost(3e-4, 4, 16_384),
        "indirect": SampleCost(4e-3, 2, 16_384),
        "from_camera": SampleCost(1e-2, 2, 20_000),
        "indirect_residual": SampleCost(2e-3, 2, 36_384),
        "camera_residual": SampleCost(0.0, 1, 0),
    },
    spread=SampleCost(2e-3, 16, 16_384, 0.8),
    forming=Forming(pixels=512, cells=150, lit=0.2, terms=3.0, shots=49, classes=49),
    apart=APART,
)
ONE_CLASS = replace(PILOT_RESULT, forming=replace(PILOT_RESULT.forming, shots=1, classes=1))
"""The same under one pattern, whose light takes no memory."""


ACCURACIES = [0.1, 1e-2, 3e-3, 1e-3, 3e-4]


def cheapest(accuracy: float, pilot_result: PilotResult, switches: Mapping[str, bool], sure: float = SURE) -> Candidate:
    """The choice of least work that keeps ``accuracy``, or of least error if none does."""
    return Candidates(pilot_result, switches).choice(accuracy, sure)


def predicted(accuracy: float, pilot_result: PilotResult, settings: Settings) -> Candidate:
    return table_of(pilot_result, settings, {}).candidate(accuracy, SURE)


def plan(
    accuracy: float = 1e-3,
    pilot_result: PilotResult = PILOT_RESULT,
    effects: str = "",
    facts: SceneFacts = FACTS,
    pace: float = 1.0,
) -> Plan:
    switches = parse_switches(effects)
    return explain_plan(accuracy, pilot_result, cheapest(accuracy, pilot_result, switches), facts, switches, pace)


def rows(found: Plan) -> dict[str, PlanRow]:
    return {effect.name: effect for effect in found.effects}


def stages(pilot_result: PilotResult, settings: Settings, pace: float = 1.0) -> dict[str, float]:
    """Seconds of each stage: paths, accumulating of what they bring, looks at the error; rays of the truth; frames."""
    forming, numbers = pilot_result.forming, Numbers.of(settings)
    held = entries(pilot_result.sample_costs["direct"].paths, forming.classes, numbers, settings)
    rest = float(accumulation_seconds(forming, numbers, held)) + float(checking_seconds(forming, numbers))
    return {
        "transport": pace * sum(tracing_seconds(pilot_result, settings).values()) + rest,
        "truth": pace * truth_seconds(pilot_result, settings),
        "optics": float(optics_seconds(forming, numbers)),
    }


def with_sample_costs(pilot_result: PilotResult, **costs: SampleCost) -> PilotResult:
    return replace(pilot_result, sample_costs={**pilot_result.sample_costs, **costs})


def with_occluded(sizes: dict[int, float]) -> PilotResult:
    """150 pixels that leave so much by the number of their anchors."""
    found = changes(SIZES | {Approximation("occluded_anchors", count): size for count, size in sizes.items()})
    several = replace(ONE_CLASS, changes=found, occluded=tuple(range(150)))
    return with_sample_costs(several, penumbra=SampleCost(1e-4, 4, 150))


# -------- The choice of settings

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
        other = predicted(accuracy, pilot_result, settings)
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
    seconds = stages(PILOT_RESULT, settings)
    assert chosen.work == pytest.approx(seconds["transport"] + seconds["optics"])


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
        assert predicted(1e-3, pilot_result, bare).fits == fits


def test_light_that_is_missing_leaves_less_for_other_errors_to_be_part_of() -> None:
    """A fifth of the light, and a tenth, come over what no tracer finds: errors are those of the rest."""
    settings = cheapest(1e-2, PILOT_RESULT, {}).settings
    lacking = replace(PILOT_RESULT, unresolved=0.2, left_out=0.1)
    before, after = (predicted(1e-2, pilot_result, settings).systematic for pilot_result in (PILOT_RESULT, lacking))
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


@pytest.mark.parametrize("name", ["anchors", "layers", "followed_anchors"])
def test_a_switch_leaves_one_number_or_the_cheapest_of_several(name: str) -> None:
    """Switched on where one would do, two are taken; switched off where the accuracy needs several, there is one.
    (Planted: two counted as one; the depth of a single layer stated.)"""
    several = cheapest(0.1, PILOT_RESULT, {name: True}).settings
    assert dict(zip(COUNTED, counts_of(several), strict=True))[name] == 2
    one = cheapest(1e-3, PILOT_RESULT, {name: False}).settings
    assert dict(zip(COUNTED, counts_of(one), strict=True))[name] == 1 and (name != "layers" or one.layers == ())


class Doubtful(PilotResult):
    """Pilot result whose doubt of each approximation is stated."""

    doubt: Mapping[Approximation, float]

    def error(self, part: Approximation) -> Estimate:
        return Estimate(0.0, self.doubt.get(part, 0.0))


def test_the_largest_doubt_is_looked_at_as_it_counts_in_the_choice() -> None:
    """An error of one wide cell of even light counts by the area of the cells that are chosen, so that its doubt must
    be c^2 times as large as another one. Without any doubt the cells are measured again. (Planted: the weight without
    its square.)"""
    settings = cheapest(1e-3, PILOT_RESULT, parse_switches("+interreflection")).settings
    settings = replace(settings, subdivision=4 * CELLS_OF_COARSE, coarse_layers=True)
    chosen = replace(predicted(1e-3, PILOT_RESULT, settings), fits=True, work=2.0)
    points, even = Approximation("anchors", settings.anchors), Approximation("indirect cells", 1)
    result = Doubtful(**{each.name: getattr(PILOT_RESULT, each.name) for each in fields(PILOT_RESULT)})
    found: Any = SimpleNamespace(pilot_result=result, switches={}, choice=lambda *_: chosen)
    for doubt, worst in ((0.7, points), (1.4, even)):
        object.__setattr__(result, "doubt", {points: 1e-4, even: doubt * 1e-4 * settings.coarse_cells**2})
        assert settings.coarse_cells == 4 and value_of_refining(1e-3, found) == (0.0, worst)
    found.pilot_result = replace(result, changes=changes({}))
    assert value_of_refining(1e-3, found) == (0.0, Approximation("cells", 1))


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
    with_none = predicted(accuracy, with_occluded({1: 0.0}), replace(settings, occluded_anchors=1))
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
    rest = predicted(1e-2, PILOT_RESULT, chosen.settings).systematic
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
    found = predicted(0.1, doubtful, bare).systematic
    assert found == pytest.approx(doubtful.changes.estimate(left)) and found.bound > 1.002 * found.value


def test_what_interpolation_leaves_of_sharp_light_counts() -> None:
    """Points for sharp lobes leave 6e-4 of the light between them. (Planted: nothing left.)"""
    sharp = SharpPixels((3, 4), 7, (-0.1, 0.1, -0.1, 0.1), 6e-4)
    light = SampleCost(1e-4, 4, 98, 0.75)
    found, exact = (
        with_sample_costs(replace(ONE_CLASS, sharp=each), sharp=light) for each in (sharp, replace(sharp, left=0.0))
    )
    chosen = cheapest(1e-3, found, {})
    without = predicted(1e-3, exact, replace(chosen.settings, sharp=exact.sharp))
    assert chosen.fits and chosen.systematic.value == pytest.approx(math.hypot(without.systematic.value, 6e-4))
    assert not cheapest(5e-4, found, {}).fits
    assert any("anchors of sharp light (7), 6.0e-04" in warning for warning in plan(5e-4, found).warnings)


# -------- What a plan says, of benches that are plain numbers


def bench(
    cuts: bool = False,
    shift: float = 0.0,
    feature: float = 0.06,
    glare: float = 0.0,
    mirrors: bool = False,
    curve: object = None,
    coloured: tuple[Tag, ...] = (),
    lens: float = 0.0,
) -> Bench:
    geometry = SimpleNamespace(
        wall_shift_features=shift, mask_thickness=0.5, mask_feature=feature, mask_distance=2.0, diffracts=True,
        mask_plate=None,
        build_mask=lambda: SimpleNamespace(opening_mm=2 * feature),
        tilt_shift_mm=0.0, tilt_left_out=lambda waves: False, mask_tilt=(0.0, 0.0),
    )  # fmt: skip
    return SimpleNamespace(  # type: ignore[return-value]
        field_stop_cuts=cuts,
        geometry=geometry,
        spectrum=SimpleNamespace(wavelengths_nm=np.array([450.0, 620.0])),
        loaded=SimpleNamespace(
            pixels=SimpleNamespace(keystone=2.5),
            unfit=Unfit(),
            shapes=(),
            mirrors=mirrors,
            in_view=bool(lens),
            camera=SimpleNamespace(world_transform=lambda: None),
            scene=None,
            small_lamps=(),
            coloured=coloured,
            parting=(),
        ),
        lines=None,
        projector=SimpleNamespace(glare=glare, aperture_radius_mm=lens),
        projector_optics=SimpleNamespace(canvas_map=SimpleNamespace(origin=(30.0, 40.0, 0.0))),
        sensor=SimpleNamespace(quantum_efficiency_curve=curve),
    )


@pytest.mark.parametrize(
    ("device", "words"),
    [
        (bench(), []),
        (bench(cuts=True), ["field stop (fov) cuts into the projector's window"]),
        (bench(shift=0.99), []),
        (bench(shift=1.0), ["0.5 mm shifts the far face by 1.0 features"]),
        (bench(feature=6.2e-4), []),
        (bench(feature=6.1e-4), ["less than 2 wavelengths of 620 nm"]),
        (bench(glare=0.02), []),
        (bench(mirrors=True), []),
        (bench(glare=0.02, mirrors=True), ["0.02 of the light over mirrors alone is to be scattered"]),
    ],
)
def test_devices_are_flagged_where_their_model_ends(
    monkeypatch: pytest.MonkeyPatch, device: Bench, words: list[str]
) -> None:
    """At a wall's shift of one feature, and a feature of the longest wavelength."""
    monkeypatch.setattr("mitsim.planner.planner.EFFECTS", {})
    facts = SceneFacts.of(device)
    assert facts.keystone == 2.5 and len(facts.warnings) == len(words)
    for warning, part in zip(facts.warnings, words, strict=True):
        assert part in warning


def test_a_lens_and_lamps_in_view_are_flagged(monkeypatch: pytest.MonkeyPatch) -> None:
    """A lens of 3 mm radius 50 mm from the camera blurs the shadow of a mask 2 mm from the sensor by 2 x 3 x 2 / 50 mm.
    It is no flaw of frames without lens or mirrors. A lamp is named by its type. (Planted: never flagged; no type.)"""
    monkeypatch.setattr("mitsim.planner.planner.EFFECTS", {})
    monkeypatch.setattr(planner, "turn_and_origin", lambda transform: (None, (0.0, 0.0, 0.0)))
    (warning,) = SceneFacts.of(bench(lens=3.0)).warnings
    assert "as a pinhole" in warning and "by 0.24 mm" in warning
    for off in ("aperture", "mirrors"):
        assert not SceneFacts.of(bench(lens=3.0), {off: False}).warnings
    monkeypatch.setattr(planner, "shines_in", lambda *_: True)
    lamp = Tag(Path("room.xml"), 7, "emitter", {"type": "point"})
    loaded: Any = SimpleNamespace(small_lamps=((None, lamp),), scene=None, camera=None, shapes=())
    (said,) = planner.unseen_lamps(loaded, 100.0, "the reference")
    assert said.startswith("room.xml:7: light: got 'point' in <emitter")


@pytest.mark.parametrize(
    ("lacking", "words"),
    [
        ({"unresolved": 0.2, "left_out": 0.1}, "of which the frames lack most, 2.0e-01; give"),
        ({"left_out": 9.9e-3}, "a mirror or curved glass twice, or once and a sharp lobe (left out), 9.9e-03; turn"),
        ({"unresolved_specular": 0.2}, "alone, in beams too fine to be placed on the sensor, 2.0e-01; use fewer"),
    ],
)
def test_light_that_frames_lack_is_told_with_its_part_and_a_remedy(lacking: dict[str, float], words: str) -> None:
    """Where it breaks the accuracy, as the largest part; else it is a part of all."""
    (warning,) = plan(1e-2, replace(PILOT_RESULT, **lacking)).warnings
    assert "largest: light over" in warning and words in warning
    assert not plan(1e-2, replace(PILOT_RESULT, **dict.fromkeys(lacking, 1e-4))).warnings
    (other,) = plan(1e-6, ONE_CLASS).warnings
    assert "largest: layers (4)" in other, "light that is all resolved is no reason"


FOLLOWS = replace(PILOT_RESULT, changes=changes(SIZES | {Approximation("ambient"): 5e-2}))
"""Light of lamps that no budget can do without, seen from two points a side of the sensor."""


def seconds(settings: Settings, pilot_result: PilotResult = FOLLOWS) -> float:
    return sum(stages(pilot_result, settings).values())


def test_a_miss_and_a_window_off_square_are_told() -> None:
    """Followed light in cells of 2 x 2 pixels leaves a quarter of what cells of 4 x 4 leave, and is the largest part.
    (Planted: cells of two pixels not named; the row's name and state exchanged.)"""
    chosen = cheapest(1e-3, with_wide := replace(FOLLOWS, changes=changes(SIZES | {WIDE: 0.4})), {})
    wide = replace(chosen.settings, followed_anchors=2, subdivision=2 * CELLS_OF_COARSE, coarse_layers=True)
    missed = predicted(1e-3, with_wide, wide)
    (warning, *_) = planner._shortfall(1e-3, with_wide, missed)
    assert wide.followed_width == 2 and "cells of their light (2 pixels), 1.0e-01" in warning
    found = rows(plan(facts=SceneFacts(notes={}, keystone=2.5)))["keystone"]
    assert found.state == "exact" and "2.5 of its pixels off a square" in found.reason


def test_seconds_of_a_look_are_its_stages_and_sharp_lobes_get_paths() -> None:
    """Where light over sharp lobes is found, light over two of them needs 2^21 paths from the camera at least.
    (Planted: the smaller number of paths; no seconds.)"""
    sharp = SharpPixels((3, 4), 7, (-0.1, 0.1, -0.1, 0.1), 1e-5)
    light = {"sharp": SampleCost(1e-4, 4, 98, 0.75)}
    for result in (FOLLOWS, with_sample_costs(replace(FOLLOWS, sharp=sharp), **light)):
        runs: Any = SimpleNamespace(pilot_result=result)
        look = planner._Look(runs, Candidates(result, {}), ())
        taken, plain = look.taken(1e-2).settings, cheapest(1e-2, result, {}).settings
        least = 2**21 / (GROUPS * 20_000) if result.sharp else 0.0
        assert taken.samples["from_camera"] == max(plain.samples["from_camera"], least)
        assert plain.samples["from_camera"] < 2**21 / (GROUPS * 20_000)
        assert look.seconds(1e-2) == pytest.approx(seconds(taken, result))


def test_the_pace_is_that_of_the_pass_that_takes_longest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each launch takes twice its fixed seconds, but the first, which compiles. (Planted: the pass whose name is last;
    the first launch counts; seconds of a sample, not of a path.)"""
    settings, clock, traced = plan().settings, [0.0], list[str]()

    def trace(name: str, samples: int) -> None:
        traced.append(name)
        row = PASSES[name]
        clock[0] += 2 * samples * 64 * row.unit_cost * float(row.connections(settings)) if len(traced) > 1 else 9.0

    def each(name: str) -> Any:
        tracer = SimpleNamespace(paths_per_sample=64)
        return SimpleNamespace(tracer=tracer, whole=100, trace=lambda seed, first, samples, _: trace(name, samples))

    passes = {name: each(name) for name in ("indirect", "direct", "from_camera")}
    simulation: Any = SimpleNamespace(
        settings=settings, passes=passes, accumulator=lambda *_: None, accumulate=lambda *_: None
    )
    monkeypatch.setattr(planner.cost_model, "tracing_seconds", lambda *_: {"direct": 5.0, "indirect": 2.0})
    monkeypatch.setattr(planner.time, "perf_counter", lambda: clock[0])
    assert planner._measure_pace(FOLLOWS, simulation, np.zeros(4, int), 0) == pytest.approx(2.0)
    assert traced == ["direct"] * 2


def test_effects_that_are_off_take_no_seconds_and_switches_are_named() -> None:
    found = rows(plan(effects="+ambient,-interreflection"))
    for name, row in found.items():
        assert row.seconds == 0 or row.state != "off", name
        assert ("switched by the user" in row.reason) == (name in ("ambient", "interreflection")), name
    assert found["diffraction"].reason == "Fresnel number 3.2" and found["diffraction"].seconds > 0
    assert found["blur"].reason == "" and found["blur"].state == "exact"
    assert found["blur"].seconds == 0


@pytest.mark.parametrize("pace", [1.0, 3.0])
def test_seconds_are_those_of_every_stage_once(pace: float) -> None:
    """Paths at the machine's pace, which decides nothing: resuming needs the same settings everywhere."""
    found = plan(pilot_result=FOLLOWS, pace=pace)
    expected = stages(FOLLOWS, found.settings, pace)
    assert found.predicted == pytest.approx(expected) and min(expected.values()) > 0
    assert found.predicted_seconds == pytest.approx(sum(expected.values()))
    assert found.settings == plan(pilot_result=FOLLOWS).settings


def test_a_row_tells_what_one_of_it_would_save_and_leave() -> None:
    """Seconds with and without, samples as they are; the error of one anchor, layer and point, not of two."""
    found = plan(pilot_result=FOLLOWS)
    settings, reported = found.settings, rows(found)
    assert settings.anchors > 1 and settings.layers and settings.followed_anchors == 2
    for name, less in (
        ("anchors", replace(settings, anchors=1)),
        ("layers", replace(settings, layers=())),
        ("followed-anchors", replace(settings, followed_anchors=1)),
        ("diffraction", replace(settings, effects=settings.effects - {"diffraction"})),
    ):
        assert (
            reported[name].seconds == pytest.approx(seconds(settings) - seconds(less)) and reported[name].seconds > 0
        ), name
    assert reported["followed-anchors"].error_if_off == pytest.approx(SIZES[Approximation("followed_anchors", 1)])


# -------- The accuracy that a time buys

LIGHTING, PILOT_S, FRAMES, PRICE, KEPT = Lighting(np.zeros(4, int), np.ones((4, 1))), 0.5, 0.25, 1e-6, 2e-5
AROUND = planner._OPENING_S + FRAMES


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Accuracies of the pilots; each keeps what is looser than its own accuracy and than KEPT."""
    seen: list[float] = []

    def look(bench: object, lighting: Lighting, accuracy: float, *_: object) -> Any:
        seen.append(accuracy)
        return SimpleNamespace(
            runs=SimpleNamespace(seconds=PILOT_S),
            taken=lambda each: SimpleNamespace(fits=each >= KEPT),
            seconds=lambda each: PRICE / each**2,
        )

    made = plan()
    monkeypatch.setattr(planner, "_look", look)
    monkeypatch.setattr(planner, "_explain", lambda accuracy, *_: replace(made, accuracy=accuracy))
    monkeypatch.setattr(planner.cost_model, "frame_seconds", lambda bench, shots: {"sensor": FRAMES})
    return seen


@pytest.mark.parametrize(
    ("seconds", "bought", "pilots"),
    [(2.26, 1e-2, 1), (3.3, 1e-3, 1), (12.0, 3.3e-4, 2), (103.0, 1e-4, 2), (1e5, KEPT, 2)],
)
def test_time_buys_the_accuracy_that_takes_it(tried: list[float], seconds: float, bought: float, pilots: int) -> None:
    """Opening, frames and all pilots come off; a looser accuracy than the first pilot's needs no other. Nothing is
    bought that is not kept, or takes longer. (Planted: pilots for nothing; an accuracy that no pilot of its own keeps;
    the first pilot's answer in place of the second's.)"""
    found: Any = planner.plan_within(None, LIGHTING, seconds, 3, {})  # type: ignore[arg-type]
    assert found.asked_seconds == seconds and not found.warnings
    assert PRICE / found.accuracy**2 + AROUND + pilots * PILOT_S <= seconds
    assert found.accuracy == pytest.approx(bought, rel=0.27) and found.accuracy >= KEPT and len(tried) == pilots


def test_too_few_seconds_flag_the_loosest_accuracy(tried: list[float]) -> None:
    found: Any = planner.plan_within(None, LIGHTING, 0.1, 3, {})  # type: ignore[arg-type]
    assert found.accuracy == planner._GRID[0] and len(tried) == 1
    assert found.warnings[0].startswith("0.1 seconds are too few: even accuracy 0.3, which was taken, is predicted")
