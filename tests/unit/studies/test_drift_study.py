"""The drift study: what it measures and predicts on a small scene, its points, and what it says of invented results."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.acquire.exposure import drift_mask, drift_projector
from mitsim.core.configuration import shipped_path
from mitsim.core.errors import MitsimError
from mitsim.devices.session import DRIFTS, Drift, load_recipe
from mitsim.report import RENDERED
from mitsim.report.lit_scene import LitScene
from mitsim.studies.drift_study import DriftStand, loss_of
from mitsim.studies.framework.experiment import Results, Scope, Setup, find_experiment
from mitsim.studies.framework.studio import Studio
from mitsim.verbs import StudyOptions, scope_of, study

pytestmark = pytest.mark.usefixtures("kept_plans")

SEED = 3
RECIPE = load_recipe()


Y, X = (np.mgrid[:64, :64] + 0.5) / 64
PRINT = np.rint(125 + 100 * np.sin(7 * Y + 2 * X) * np.cos(9 * X)).astype(int)
LAMP = """<emitter type="point">
    <point name="position" x="-60" y="40" z="150"/> <spectrum name="intensity" value="1e4"/></emitter>"""


@pytest.fixture(scope="module")
def stand(shared_scene: Callable[..., Path], variant: str) -> Iterator[DriftStand]:
    setup = Setup(str(shared_scene("drift", reflectance=PRINT)), variant=variant)
    with Studio() as studio:
        lit = studio.lit_scene(setup)
        yield DriftStand(lit, studio.factors(setup, SEED), RECIPE, lit.bench.family("dots:4"), SEED)


@pytest.fixture(scope="module")
def lamp_stand(stand: DriftStand, shared_scene: Callable[..., Path], variant: str) -> Iterator[DriftStand]:
    """The same before a lamp, which the session that found its factors does not see."""
    setup = Setup(str(shared_scene("drift_lamp", reflectance=PRINT, extra=LAMP)), variant=variant)
    with Studio() as studio:
        yield replace(stand, lit=studio.lit_scene(setup))


def test_without_drift_the_image_is_the_same_bit_for_bit(stand: DriftStand) -> None:
    """(Planted: the exposure chosen anew; another seed.)"""
    found, _ = stand.outcome(Drift())
    assert found["before_db"] == found["after_db"]
    assert found["lost_db"] == found["predicted_lost_db"] == found["predicted_error_db"] == 0


COSTS = {
    "dots:4": {
        "mask_rows_um": 10, "mask_columns_um": -10, "mask_axis_um": 40, "mask_rotation_mrad": 3,
        "mask_tilt_columns_mrad": -40, "exposure": 0.02, "power": -0.02, "power_ramp": 0.03, "black_level_dn": 8,
    },
    "hadamard:4": {"mask_rows_um": 10, "power": -0.02, "power_ramp": 0.3, "black_level_dn": 100},
}  # fmt: skip


@pytest.mark.parametrize(("patterns", "kind"), [(patterns, kind) for patterns in COSTS for kind in COSTS[patterns]])
def test_closed_forms_say_what_a_drift_costs(stand: DriftStand, patterns: str, kind: str) -> None:
    """To 0.5 dB of 3 or more: what detail leaves in this image, 14 dB above the model's error, shares in the drift's.
    What both frames of a signed pattern have alike costs nothing. (Planted: rows and columns swapped; both terms of the
    rotation with one sign; a gain twice; black level of one pixel.)"""
    own = replace(stand, family=stand.lit.bench.family(patterns))
    found, _ = own.outcome(Drift().alone(kind, COSTS[patterns][kind]))
    assert found["predicted_lost_db"] == pytest.approx(found["lost_db"], abs=0.5)
    alike = own.family.signed and kind == "black_level_dn"
    assert abs(found["lost_db"]) < 0.01 if alike else found["lost_db"] > (1 if own.family.signed else 3)


@pytest.mark.parametrize(("source", "waves"), [("power", 0.0), ("power", 2.5), ("lamp", 2.5)])
def test_closed_forms_say_what_a_ripple_costs(request: pytest.FixtureRequest, source: str, waves: float) -> None:
    """By a global shutter, and by a rolling one that sees two and a half waves down its frame: to 0.5 dB of 3 or more,
    the mean over five captures, whose phases spread by half of that."""
    still = request.getfixturevalue("stand" if source == "power" else "lamp_stand")
    bench, hertz = still.lit.bench, 0.6 / still.exposure_s
    line_us = 1e6 * waves / hertz / (bench.geometry.frame_shape[0] * bench.sensor.binning)
    shutter = {"shutter": "rolling", "line_time_us": line_us} if waves else {}
    lit = copy(still.lit)
    lit.bench = replace(bench, devices=replace(bench.devices, sensor=bench.sensor.model_copy(update=shutter)))
    drift = Drift.model_validate({f"{source}_ripple": 0.1, f"{source}_ripple_hz": hertz})
    found = [replace(still, lit=lit, seed=seed).outcome(drift)[0] for seed in range(5)]
    lost = np.mean([outcome["lost_db"] for outcome in found])
    assert lost > 3
    assert np.mean([outcome["predicted_lost_db"] for outcome in found]) == pytest.approx(lost, abs=0.5)


@pytest.mark.parametrize("drift", [Drift(mask_tilt_rows_mrad=40.0), Drift(mask_tilt_columns_mrad=-40.0)])
def test_a_tilt_changes_the_image_as_it_is_predicted_to(stand: DriftStand, drift: Drift) -> None:
    """To 15 % of the change, without noise: the model has neither detail inside projector pixels nor falloff. What a
    tilt of the rows costs this print hangs on that detail: its change has -0.4 of the error from before."""
    bench, images, model = stand.lit.bench, [], stand.model
    for each in (Drift(), drift):
        expected = stand.lit.expected_frames(RENDERED, stand.family, bench=drift_mask(bench, each))
        seen = stand.family.measurements(stand.frames.exposer(1.0).electrons(frame) for frame in expected)
        images.append(model.solve(model.accumulator(seen), stand.before.lam).image)
    still, tilted = (
        model.image(model.gain(stand.before.lam) * stand.data(model, each)[0]) for each in (Drift(), drift)
    )
    changed = images[1] - images[0]
    assert np.linalg.norm(tilted - still - changed) < 0.15 * np.linalg.norm(changed)


def test_a_session_whose_power_drifts_gives_other_factors(stand: DriftStand) -> None:
    """Phi C on either side, to 2 % of what the drift changes: noise of other light is what is left. What that costs, to
    0.5 dB. (Planted: pairs of the other sign in what is predicted, and in what is exposed; levels of the first side for
    both, or of the other.)"""
    drift, recipe = Drift(session_ramp=0.2, session_flicker=0.02), RECIPE
    calibrate = stand.lit.bench.calibrate
    still, factors = (
        calibrate(seed=SEED, recipe=recipe.model_copy(update={"drift": moving})) for moving in (Drift(), drift)
    )
    own = replace(stand, factors=still)
    for before, after, predicted in zip(
        (still.left, still.right), (factors.left, factors.right), own.session_factors(drift), strict=True
    ):
        assert np.linalg.norm(after - predicted) < 0.02 * np.linalg.norm(after - before)
    found, _ = own.outcome(drift, factors)
    assert found["lost_db"] > 1 and found["predicted_lost_db"] == pytest.approx(found["lost_db"], abs=0.5)


def test_a_moved_picture_lights_other_places(stand: DriftStand) -> None:
    """A quarter of a pixel down a smooth print, its pixels see what lies between two. (Planted: rows and columns
    swapped.)"""
    drift = Drift(projector_rows=0.25)
    bench = drift_projector(stand.lit.bench, drift)
    (top, bottom), columns = bench.windows
    (before, after), same = stand.lit.bench.windows
    shift = 0.25 * (after - before) / bench.n
    assert (top, bottom) == pytest.approx((before + shift, after + shift), abs=1e-7) and columns == pytest.approx(same)
    moved = LitScene(bench.light(accuracy=1e-2))
    truth = stand.lit.truth
    left = moved.truth[:-1] - 0.75 * truth[:-1] - 0.25 * truth[1:]
    assert np.linalg.norm(left) < 0.2 * np.linalg.norm(moved.truth - truth)
    assert drift_projector(stand.lit.bench, Drift(mask_rows_um=1.0)) is stand.lit.bench


def test_what_is_predicted_of_a_worse_image() -> None:
    """A drift that adds as much squared error as the image has costs 3 dB; if the model has half of that image's error,
    it alone would say 4.8. (Planted: decibels subtracted.)"""
    found = loss_of(30.0, 27.0, 0.5e-3, 1.5e-3)
    assert found["predicted_before_db"] == pytest.approx(33.0103, abs=1e-3)
    assert found["predicted_lost_db"] == pytest.approx(3.0103, abs=1e-3)
    assert found["predicted_error_db"] == pytest.approx(4.7712 - 3.0103, abs=1e-3)
    assert found["lost_db"] == 3.0


def test_predicted_noise_is_that_of_the_image(stand: DriftStand, lamp_stand: DriftStand) -> None:
    """Before a lamp and without one, that of the capture by noisy frames and expected ones at one lambda: 256 pixels,
    whose mean square scatters by 9 %, three times that. The factors' noise adds to that. (Planted: electrons for
    electrons a second; no lamp; no noise of factors.)"""
    for own in (stand, lamp_stand):
        manifest, lam = own.factors.manifest.model_copy(update={"noise": None}), own.before.lam
        quiet = replace(own, factors=replace(own.factors, manifest=manifest))
        quiet.__dict__.update(before=own.before, exposure_s=own.exposure_s, frames=own.frames)
        expected = own.model.image(own.model.gain(lam) * own.data(own.model, Drift())[0])
        noise = quiet.predicted(Drift()) - np.mean(np.square(expected - own.lit.truth))
        still = own.clear(own.factors, own.lit.light)
        assert noise == pytest.approx(np.mean(np.square(own.before.image - still)), rel=0.27)
        assert own.predicted(Drift()) > quiet.predicted(Drift()) + 1e-4 * noise


def test_points_are_every_kind_alone() -> None:
    """At the shipped amounts, lamps' before a lamp; a quick study is a start of the whole. (Planted: lamps at the
    sheet.)"""
    experiment = find_experiment("drift")
    points, few = (experiment.points(Scope(Setup(), ("astronaut", "page"), quick=quick)) for quick in (False, True))
    assert {point["kind"] for point in points} == set(DRIFTS) and len(points) == 4 * len(DRIFTS)
    assert len({point.key for point in points}) == len(points) and {p.key for p in few} <= {p.key for p in points}
    drift = load_recipe(shipped_path("calibration", "drift.toml")).drift
    assert all(point["amount"] == getattr(drift, point["kind"]) for point in points)
    assert {p.setup.scene for p in points if p["kind"].startswith("lamp")} == {"lamp_bench"}
    asked = experiment.points(Scope(Setup(), (None,), sweep=(("power", ("0.1", "0.2")),), quick=True))
    assert [(point["kind"], point["amount"]) for point in asked] == [("power", 0.1), ("power", 0.2)]
    others = experiment.points(Scope(Setup(), (None,), patterns="hadamard:8", quick=True))
    assert {point["patterns"] for point in points} == {"dots:7"} and others[0]["patterns"] == "hadamard:8"
    with pytest.raises(MitsimError, match="patterns 'stripes:8'"):
        experiment.points(Scope(Setup(), (None,), patterns="stripes:8"))


def test_options_of_the_study(tmp_path: Path) -> None:
    """(Planted: a recipe for any study; a ripple without a frequency refused.)"""
    scope, points = Scope(Setup(), (None,)), find_experiment("drift").points
    ripple = StudyOptions(over=["lamp_ripple=0.3"]).varied  # whose frequency the recipe states
    for varied, found in (([("power", ("0.1", "0.2"))], (("power", ("0.1", "0.2")),)), (ripple, tuple(ripple))):
        assert scope_of("drift", scope, "dots:7", varied, "psnr").sweep == found
    assert scope_of("drift", scope, "hadamard:8", (), "psnr").patterns == "hadamard:8"
    with pytest.raises(MitsimError, match="over for drift, sweep; patterns for"):
        scope_of("patterns", scope, "dots:7", [("power", ("0.1",))], "psnr")
    with pytest.raises(MitsimError, match="a recipe is for calibration and drift"):
        study("sweep", recipe=Path("any.toml"))
    unknown = Scope(Setup(camera="mt9m034"), (None,), sweep=(("power", ("0.1",)),))
    assert points(unknown)
    uniform, text = tmp_path / "uniform.toml", shipped_path("calibration", "drift.toml").read_text()
    assert 'signed_capture = "pair"' in text
    uniform.write_text(text.replace('signed_capture = "pair"', 'signed_capture = "uniform"'))
    still = str(shipped_path("calibration", "session.toml"))
    for refused, words in (
        (replace(scope, sweep=(("sheet_z", ("390",)),)), "there is no such kind"),
        (replace(unknown, sweep=(("power_ripple", ("0.1",)),)),
         r"^sensor 'Aptina MT9M034': [^\n]*give line_time_us[^\n]*$"),
        (replace(scope, recipe=str(uniform)), 'studied for signed_capture = "pair"'),
        (replace(scope, recipe=still), "moves nothing"),
    ):  # fmt: skip
        with pytest.raises(MitsimError, match=words):
            points(refused)


def test_claims_hold_predictions_against_what_was_measured() -> None:
    """Of each kind and amount, mean over seeds. (Planted: all amounts together.)"""
    rows = [
        {"kind": "power", "what": f"power {amount}", "amount": amount, "unit": "um", "seed": seed,
         "lost_db": amount + 0.1 * seed, "predicted_lost_db": predicted + 0.1 * seed, "predicted_error_db": 0.3}
        for amount, predicted in ((1.0, 1.4), (2.0, 9.0))
        for seed in (0, 1)
    ]  # fmt: skip
    experiment, results = find_experiment("drift"), Results(rows)
    power, other = experiment.judge(results)
    assert power.verdict == "confirmed" and other.verdict == "not confirmed"
    assert power.idealised == "1.45 \N{PLUS-MINUS SIGN} 0.30 dB lost"
    assert power.rendered == "1.050 \N{PLUS-MINUS SIGN} 0.050 dB lost, 3 dB at about 1.9 um"
    assert set(experiment.draw(results)) == {"losses.png"}
