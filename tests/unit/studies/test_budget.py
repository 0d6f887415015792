"""What each part of a budget is, of stands whose images and noises are given: nothing is traced or solved."""

from __future__ import annotations

import math
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import parse_patterns, stripe_signs
from mitsim.devices.session import Drift
from mitsim.report.lit_scene import SPECKLE
from mitsim.studies import calibration_study as budget
from mitsim.studies import causes
from mitsim.studies.calibration_study import ERROR_SOURCES, LAMBDA, RENDERING, REST, LossRow, Share
from mitsim.studies.causes import Expected, LinearImage, Noise
from mitsim.studies.drift_study import AMBIENT, SESSION

N = 4
RNG = np.random.default_rng(2)
SCENE = RNG.random((N, N))
STEADY = 0.1 * RNG.standard_normal((N, N))


def mean_square(error: np.ndarray) -> float:
    return float(np.mean(error**2))


def amounts(noise: Noise) -> list[float]:
    return [getattr(noise, each.name) for each in fields(noise)]


def test_noise_is_told_by_source_and_by_factor() -> None:
    """Of a session whose noise is all in a row of pixels that sees no even light: mean over the rows of V over |v|^2 in
    the left factor, whose entries each stand for a row, and none in the right one, which sees rows weighed by v^2.
    Of an ambient frame and of speckle only where there are any. (Planted: both factors by the one side or by the other;
    sampling of the truth left out.)"""
    factors = 1 + RNG.random((3, N)), 1 + RNG.random((5, N))
    factors[0][0] = 0.0
    variance = np.zeros((3, 5))
    variance[0] = 6.0
    session: Any = SimpleNamespace(
        session=SimpleNamespace(signs=stripe_signs(N)),
        uniform_rate=np.ones((3, 5)),
        response_variances=lambda side: ({"shot noise": variance}, {"shot noise": variance / 2}),
        light=SimpleNamespace(flux=np.ones(N * N), flux_error=np.full(N * N, 0.1)),
    )
    sampled = SimpleNamespace(flux_error=3.0, apparent=SimpleNamespace(error_of=lambda error: 2 * error, error=0.5))
    empty = {AMBIENT: Noise(), SPECKLE: Noise(), "read noise": Noise(), SESSION: Noise(left=9.0, right=9.0)}
    stand: Any = SimpleNamespace(
        noises=empty, factors=SimpleNamespace(left=factors[0], right=factors[1]), lit=SimpleNamespace(light=sampled)
    )
    found = dict(budget._noises(stand, session))
    common = factors[1].sum(axis=1)
    reported = found.pop((SESSION, "shot noise"))
    # Of noise of its own a mean over N responses; what these share is in the first of N columns.
    assert reported.left == pytest.approx(6 / 3 / (common @ common) * (1 / N + 0.5 / N)) and reported.right == 0
    rendering = budget.session_rendering(np.ones(1), np.full(1, 0.1), factors)
    assert amounts(found.pop((SESSION, RENDERING))) == pytest.approx(amounts(rendering))
    assert found == {("capture", "read noise"): Noise(), ("capture", RENDERING): Noise(light=36.25)}, "no speckle"
    stand.noises = {name: Noise(datum=1.0) for name in empty}
    found = budget._noises(stand, session)
    assert {name for of, name in found if of == "capture"} == {AMBIENT, SPECKLE, "read noise", RENDERING}


def test_sampled_light_of_a_board_multiplies_columns() -> None:
    """By the mean square of its relative errors where it is lit, and the squares of the other side's weights. (Planted:
    dark pixels; the mean of the weights' squares.)"""
    left, right = 1 + RNG.random((3, N)), 1 + RNG.random((5, N))
    found = budget.session_rendering(np.array([0.5, 0.0, 2.0]), np.array([0.05, 9.0, 0.4]), (left, right))
    for factor, reported in ((right, found.left_light), (left, found.right_light)):
        common = factor.sum(axis=1)
        weights = [float(column @ common) / float(common @ common) for column in factor.T]
        assert sum(weights) == pytest.approx(1)
        assert reported == pytest.approx(0.025 * sum(weight**2 for weight in weights))


def test_what_is_not_explained_is_a_loss_of_its_own() -> None:
    """A quarter of an error is told: 6.02 dB are left, and 3.01 dB more if chance took half of what is told."""
    row = budget._unexplained_row(4.0, 1.0, 0.5)
    assert row == LossRow("unexplained", "not explained", "", row.lost_db, row.error_db, 3.0, 0.5)
    assert (row.lost_db, row.error_db) == pytest.approx((6.0206, 3.0103), abs=1e-4)
    assert budget._unexplained_row(4.0, 4.0, 1.0).error_db == pytest.approx(1.2494, abs=1e-4)


@pytest.mark.parametrize(
    ("row", "name"),
    [
        (LossRow("unexplained", "not explained", "", 0, 0), "not explained"),
        (LossRow("scene", "detail", "", 0, 0), "scene: detail"),
        (LossRow("drift", "mask_rows_um", "0.4 um", 0, 0), "mask down the rows, 0.4 um"),
        (LossRow("drift", "of a plugin", "3", 0, 0), "of a plugin, 3"),
        (LossRow("capture", "mask_rows_um", "", 0, 0), "capture: mask_rows_um"),
    ],
)
def test_a_row_is_named_by_where_it_comes_from(row: LossRow, name: str) -> None:
    assert row.name == name


def test_causes_are_taken_out_one_after_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the order of ERROR_SOURCES, each beside those before it; what the white board's light has as well stays.
    (Planted: each alone.)"""
    effects = ("falloff", causes.GLOSS, causes.DETAIL, causes.DEPTH)
    scene_ablation = SimpleNamespace(effects=effects, without=lambda off: sorted(off))
    monkeypatch.setattr(budget.Ablation, "of", lambda light: scene_ablation)
    stand: Any = SimpleNamespace(lit=SimpleNamespace(light="all"), clear=lambda factors, light: (factors, light))
    assert list(budget._clear_images(stand, "exact")) == [  # type: ignore[arg-type]
        ("", ("exact", "all")),
        (causes.DETAIL, ("exact", [causes.DETAIL])),
        (causes.DEPTH, ("exact", sorted([causes.DETAIL, causes.DEPTH]))),
        (causes.GLOSS, ("exact", sorted([causes.DETAIL, causes.DEPTH, causes.GLOSS]))),
    ]


def test_a_cause_has_what_the_image_gains_without_it() -> None:
    """Beside those that are out already; the rest is neither lambda's nor of the sampling that is in all images."""
    kept, sampled = 0.9 * SCENE, Noise(light=2.0)
    images = [kept + size * STEADY for size in (3.0, 2.0, 0.5)]
    solver = SimpleNamespace(
        expected_image=lambda light: Expected(0.9 * light), variance=lambda _, noise: 1e-3 * noise.light
    )
    scatter: Any = SimpleNamespace(
        solver=solver,
        scene=SCENE,
        common=lambda noise, error: noise.light * float(np.abs(error).sum()),
        deviation=lambda noise, error: 3 * noise.light * float(np.abs(error).sum()),
    )
    found = budget._of_scene(scatter, dict(zip(("", causes.DEPTH, causes.GLOSS), images, strict=True)), sampled)
    squares, whole = [mean_square(image - SCENE) for image in images], float(np.abs(STEADY).sum()) / SCENE.size
    depth, gloss = (found["scene", ERROR_SOURCES[name]] for name in (causes.DEPTH, causes.GLOSS))
    assert (depth.square, depth.deviation) == pytest.approx((squares[0] - squares[1], 2 * whole))
    assert (gloss.square, gloss.deviation) == pytest.approx((squares[1] - squares[2], 2 * 1.5 * whole))
    assert found["scene", ERROR_SOURCES[causes.DETAIL]] == Share(0.0)
    bias, rest = found["solver", LAMBDA], found["scene", REST]
    assert (bias.square, bias.deviation) == (pytest.approx(mean_square(0.1 * SCENE)), 0.0)
    assert rest.square == pytest.approx(squares[2] - bias.square - 2e-3 / SCENE.size)
    assert rest.deviation == pytest.approx(6 * float(np.abs(images[2] - SCENE).sum()) / SCENE.size)
    assert sum(part.square for part in found.values()) == pytest.approx(squares[0] - 2e-3 / SCENE.size)


def test_parts_of_an_image_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise that is drawn is judged beside all that is, sampled light beside it and itself; what pixels differ by
    beside what came before. (Planted: sampled light among what is drawn; each difference alone.)"""
    noises = {
        ("capture", "shot noise"): Noise(datum=1e-4),
        ("session", "shot noise"): Noise(left=2e-4),
        ("capture", RENDERING): Noise(light=3e-4),
        ("session", RENDERING): Noise(left_light=4e-4),
    }
    asked: list[Any] = []
    monkeypatch.setattr(budget, "_noises", lambda *given: asked.append(given) or noises)
    monkeypatch.setattr(budget, "_clear_images", lambda *given: asked.append(given) or {"": SCENE + STEADY}.items())
    monkeypatch.setattr(budget, "_of_scene", lambda scatter, seen, sampled: {("scene", "light"): (seen, sampled)})
    left, right = RNG.standard_normal((6, N)) + 0.3, RNG.standard_normal((7, N)) + 0.3
    fixed = {"response": RNG.standard_normal((N, N)), "offsets": RNG.standard_normal((N, N))}
    linear = LinearImage(left, right, parse_patterns("dots:2", N), 0.1)
    stand: Any = SimpleNamespace(lit=SimpleNamespace(truth=SCENE), linear=linear, fixed=fixed)
    clear: Any = SimpleNamespace(left=2 * left, right=3 * right)
    found = budget._budget(stand, "session", clear)  # type: ignore[arg-type]
    assert asked == [(stand, "session"), (stand, clear)]
    steps = [STEADY, STEADY + fixed["response"], STEADY + fixed["response"] + fixed["offsets"]]
    assert found.steady == pytest.approx(steps[2])
    assert amounts(found.drawn) == pytest.approx(amounts(Noise(datum=1e-4, left=2e-4)))
    assert np.array_equal(found.scatter.solver.left, 2 * left) and np.array_equal(found.scatter.solver.right, 3 * right)
    for (of, source), noise in noises.items():
        part = found.parts[of, source]
        among = found.drawn + noise if source == RENDERING else found.drawn
        assert part.square == pytest.approx(linear.variance(SCENE, noise) / N**2)
        assert part.deviation == pytest.approx(found.scatter.share(noise, among, steps[2]) / N**2)
    for name, before, after in zip(fixed, steps, steps[1:], strict=False):
        assert found.parts["capture", name] == Share(pytest.approx(mean_square(after) - mean_square(before)))
    seen, sampled = found.parts["scene", "light"]  # type: ignore[misc]
    assert [*seen] == [""] and amounts(sampled) == amounts(Noise(light=3e-4, left_light=4e-4))
    assert sum(found.parts[name].square for name in [("capture", "response"), ("capture", "offsets")]) == (
        pytest.approx(mean_square(steps[2]) - mean_square(STEADY))
    )


def test_a_drift_costs_what_it_adds_to_the_error_that_is_there() -> None:
    """E + A in the place of E, A with what the drift has in common with the image's own error; how sure that is hangs
    on all of that, and on noise that looks like the drift. A drift that cannot be is named. (Planted: against the scene
    alone; the common part as sure.)"""
    moved, noise = STEADY + 0.2, 0.3
    images = {"mask_rows_um": SCENE + moved, "power": SCENE + STEADY}

    def expected_image(drift: Drift) -> Expected:
        if not drift.kinds:
            return Expected(SCENE + 2 * STEADY, 0.1)
        if drift.kinds == ("exposure",):
            raise MitsimError("no time")
        return Expected(images[drift.kinds[0]] + STEADY, 0.1)

    measured = 0.05
    stand: Any = SimpleNamespace(
        expected_image=expected_image,
        lit=SimpleNamespace(truth=SCENE),
        recipe=SimpleNamespace(drift=Drift(mask_rows_um=0.4, exposure=0.2, power=0.1)),
        before_db=-10 * math.log10(measured),
        scatter=lambda drift, error: 1e-6 * (error == STEADY).all(),
    )
    scatter: Any = SimpleNamespace(common=lambda drawn, error: drawn.datum * float(np.abs(error).sum()))
    rows, refused = budget._drifts(stand, budget.Budget({}, scatter, Noise(datum=noise), STEADY), measured)
    assert refused == ["exposure: no time"]
    assert [row.name for row in rows] == ["mask down the rows, 0.4 um", "projector's power, 10 %"]
    row, none = rows
    assert none.lost_db == 0 and none.error_db == pytest.approx(10 * math.log10(1 + 1e-3 / measured))
    # The target is the image's expectation less its steady error; beside it the error was STEADY.
    added = mean_square(moved) - mean_square(STEADY)
    lost = 10 * math.log10(1 + added / measured)
    apart = 10 * math.log10(1 + (mean_square(moved + STEADY) - mean_square(2 * STEADY)) / measured)
    chance = math.hypot(noise * 0.2, 1e-3) / measured
    assert row.lost_db == pytest.approx(lost)
    assert row.error_db == pytest.approx(math.hypot(lost - apart, 10 * math.log10(1 + chance / (1 + added / measured))))


def test_rows_are_all_parts_then_what_is_left_then_drifts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an image that 0.06 is told of and 0.05 measured; the chance of the whole is a mean over its pixels. (Planted:
    the sum over them; where it comes from in the place of the source.)"""
    parts = {("capture", "shot noise"): Share(0.04, 1e-3), ("scene", "depth"): Share(0.02)}
    asked: list[Any] = []
    scatter: Any = SimpleNamespace(deviation=lambda noise, error: asked.append((noise, error)) or 0.16)
    whole = budget.Budget(parts, scatter, Noise(datum=1.0), STEADY)
    drift = LossRow("drift", "power", "10 %", 1.0, 0.1)
    monkeypatch.setattr(budget, "_budget", lambda *given: asked.append(given) or whole)
    monkeypatch.setattr(budget, "_drifts", lambda *given: asked.append(given) or ([drift], ["lamp: no"]))
    stand: Any = SimpleNamespace(before_db=-10 * math.log10(0.05))
    rows, refused = budget.losses(stand, "session", "exact")  # type: ignore[arg-type]
    shot, depth, left, last = rows
    assert refused == ["lamp: no"] and last is drift
    measured = pytest.approx(0.05)
    assert asked == [(stand, "session", "exact"), (whole.drawn, STEADY), (stand, whole, measured)]
    assert (shot.lost_db, shot.error_db) == pytest.approx(budget.gain_without(0.04, 0.05, 0.06, 1e-3))
    assert (depth.lost_db, depth.error_db) == pytest.approx(budget.gain_without(0.02, 0.05, 0.06))
    assert [(row.of, row.source, row.amount, row.deviation) for row in (shot, depth)] == [
        ("capture", "shot noise", "", 1e-3),
        ("scene", "depth", "", 0.0),
    ]
    assert (shot.squared_error, depth.squared_error) == (0.04, 0.02)
    assert (left.squared_error, left.deviation) == pytest.approx((-0.01, 0.01))
    assert (drift.squared_error, drift.deviation) == (0, 0)


def test_chance_is_in_how_sure_a_part_is() -> None:
    """A deviation as large as a part that is a quarter, 3.01 - 1.25 dB; with what is not explained as squares add."""
    alone = budget.gain_without(1.0, 4.0, 4.0, 1.0)
    assert alone == pytest.approx((1.2494, 3.0103 - 1.2494), abs=1e-4)
    assert budget.gain_without(1.0, 4.0, 2.0, 1.0)[1] == pytest.approx(2**0.5 * alone[1])
    more = budget.gain_without(1.0, 4.0, 8.0, 1.0)
    assert more[1] == pytest.approx(math.hypot(1.2494 - 0.5799, 0.5799), abs=1e-4)
    # A quarter too much is told: it may all be this part's, of which half of the error is left.
    assert budget.gain_without(3.0, 4.0, 5.0) == pytest.approx((3.9794, 3.9794 - 3.0103), abs=1e-4)
    assert budget.gain_without(4.0, 4.0, 4.0)[0] == pytest.approx(90)
