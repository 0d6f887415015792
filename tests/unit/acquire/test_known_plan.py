"""Captures by a plan that is there already: what planning anew would give, or a refusal that names what differs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.acquire import spectral
from mitsim.acquire.capture import Light
from mitsim.api.bench import Bench, open_bench
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.runs import Capture
from mitsim.devices.projector import Lines
from mitsim.light.plan import Plan
from tests.conftest import write_small_scene

pytestmark = pytest.mark.usefixtures("kept_plans")
ACCURACY, SEED = 2e-2, 5
LAMP = '<emitter type="constant"><spectrum name="radiance" value="0.01"/></emitter>'


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path], variant: str) -> Bench:
    return open_bench(shared_scene("known_plan", extra=LAMP), variant, albedo=0.4)


@pytest.fixture(scope="module")
def file(bench: Bench, tmp_path_factory: pytest.TempPathFactory) -> Path:
    plan = bench.plan("dots:3", accuracy=ACCURACY, seed=SEED)
    return plan.save(tmp_path_factory.mktemp("plan") / "plan.json")


@pytest.fixture(scope="module")
def captured(bench: Bench) -> Capture:
    return bench.capture("dots:3", accuracy=ACCURACY, seed=SEED)


@pytest.fixture
def no_plans(monkeypatch: pytest.MonkeyPatch) -> None:
    def make(*_: object) -> None:
        raise AssertionError("planned again")

    monkeypatch.setattr(spectral, "make_plan", make)


@pytest.mark.usefixtures("no_plans")
def test_frames_are_those_of_a_capture_that_plans_itself(bench: Bench, captured: Capture, file: Path) -> None:
    """Bit for bit, under the same configuration; what planning took is not this run's. (Planted: the request's seed in
    place of the plan's; samples of one.)"""
    shots = bench.capture(Plan.load(file))
    assert all(np.array_equal(getattr(shots, name), getattr(captured, name)) for name in ("dn", "electrons", "truth"))
    assert shots.manifest.configuration == captured.manifest.configuration
    assert bench.capture(Plan.load(file), accuracy=ACCURACY).manifest.configuration == shots.manifest.configuration
    assert shots.manifest.plan is not None and captured.manifest.plan is not None
    assert shots.manifest.plan["settings"] == captured.manifest.plan["settings"]
    assert shots.manifest.plan["predicted"]["plan"] == 0 < captured.manifest.plan["predicted"]["plan"]


@pytest.mark.usefixtures("no_plans")
def test_another_seed_exposure_and_the_same_classes_may_be_asked_for(bench: Bench, file: Path, tmp_path: Path) -> None:
    """The plan's own seed stands in the configuration then, so that no other plan goes on with the run. (Planted: it
    does not.)"""
    plan, run = Plan.load(file), tmp_path / "run"
    shots = bench.capture(plan, run, seed=6, exposure=0.01, patterns="dots:3x3")
    configuration = shots.manifest.configuration
    assert configuration["seed"] == 6 and configuration["plan_seed"] == SEED and configuration["exposure"] == 0.01
    again = replace(plan, request=plan.known_request.with_values(seed=6))
    with pytest.raises(MitsimError, match="another configuration"):
        bench.capture(again, run, resume=True, exposure=0.01, patterns="dots:3x3")
    (run / "frame_00003.exr").unlink()
    resumed = bench.capture(plan, run, resume=True, seed=6, exposure=0.01, patterns="dots:3x3")
    assert np.array_equal(resumed.dn, shots.dn)


@pytest.mark.usefixtures("no_plans")
@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"patterns": "dots:5"}, "^patterns 'dots:5': the plan was made for 'dots:3'; plan anew"),
        ({"patterns": "hadamard:4"}, "^patterns 'hadamard:4': the plan was made for 'dots:3'"),
        ({"accuracy": 1e-3}, "^accuracy 0.001: the plan was made for 0.02; plan anew"),
        ({"effects": "-ambient"}, "^effects -ambient: the plan was made for none"),
    ],
)
def test_what_needs_another_plan_is_refused(
    bench: Bench, file: Path, tmp_path: Path, changes: dict[str, object], sentence: str
) -> None:
    with pytest.raises(ArgumentError, match=sentence):
        bench.capture(Plan.load(file), tmp_path / "run", **changes)
    if "patterns" not in changes:
        with pytest.raises(ArgumentError, match=sentence):
            bench.light(Plan.load(file), **changes)
    assert not (tmp_path / "run").exists()


@pytest.mark.usefixtures("no_plans")
def test_a_plan_that_takes_longer_than_is_allowed_is_refused(bench: Bench, file: Path, tmp_path: Path) -> None:
    """(Planted: what is known before a plan held against the limits alone.)"""
    with pytest.raises(MitsimError, match=r"^dots:3: would take about 1e\+09 s; allowed are 8\.64e\+04 s"):
        bench.capture(Plan.load(file).taking(transport=1e9), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.usefixtures("no_plans")
def test_a_scene_that_changed_by_a_number_is_another(
    bench: Bench, file: Path, variant: str, tmp_path: Path, captured: Capture
) -> None:
    """Wherever it lies: a copy of the same content is the same. (Planted: paths are compared, and not the content.)"""
    plan, path = Plan.load(file), write_small_scene(tmp_path, "known_plan", extra=LAMP)
    moved = open_bench(path, variant, albedo=0.4)
    assert np.array_equal(moved.capture(plan).dn, captured.dn)
    path.write_text(path.read_text().replace('value="0.01"', 'value="0.011"'))
    with pytest.raises(ArgumentError, match=r"^plan was made for another scene: the content of its XML differs"):
        open_bench(path, variant, albedo=0.4).capture(plan)
    write_small_scene(tmp_path, "known_plan", extra=LAMP, canvas=np.full((16, 32), 255) * (np.arange(32) > 15) * 254)
    with pytest.raises(ArgumentError, match=r"the content of known_plan_projector\.png differs"):
        open_bench(path, variant, albedo=0.4).capture(plan)


@pytest.mark.usefixtures("no_plans")
def test_other_devices_are_refused_where_they_matter(bench: Bench, file: Path, variant: str) -> None:
    """The sensor's noise, its full well and where its numbers come from do not; colour filters, a curve of its
    efficiency and a board do. (Planted: noise that is refused; a curve, or a board, that is not.)"""
    plan, devices = Plan.load(file), bench.devices
    noisier = devices.sensor.model_copy(update={"read_noise_e": 50.0, "full_well_e": 1e6, "source": "elsewhere"})
    bench.capture(plan)
    replace(bench, devices=replace(devices, sensor=noisier)).capture(plan)
    others = {
        r"parameter: albedo 0\.4 then, 0\.5 now": replace(bench, defines={"albedo": "0.5"}),
        "projector: blur_pixels 0.0 then, 0.5 now": replace(
            bench, devices=replace(devices, projector=devices.projector.model_copy(update={"blur_pixels": 0.5}))
        ),
        "camera: mask_distance 2.0 then, 1.5 now": replace(
            bench, devices=replace(devices, camera=devices.camera.model_copy(update={"mask_distance": 1.5}))
        ),
        "board: none then": bench.with_board(0.9),
        "variant: llvm_ad_mono then": replace(bench, variant="llvm_ad_rgb"),
        "colour: none then": replace(bench, lines=Lines((445.0, 638.0), (0.5, 0.5))),
        "camera: mosaic none then, RGGB now": replace(
            bench, filters=devices.sensor.model_copy(update={"mosaic": "RGGB"})
        ),
    }
    for sentence, other in others.items():
        with pytest.raises(ArgumentError, match=f"^plan was made for another {sentence}"):
            other.capture(plan)
        with pytest.raises(ArgumentError, match=f"^plan was made for another {sentence}"):
            other.light(plan)


# ---- light that is traced already


@pytest.fixture(scope="module")
def light(bench: Bench) -> Light:
    return bench.light("dots:3", accuracy=ACCURACY, seed=SEED)


@pytest.mark.usefixtures("no_plans")
def test_frames_that_are_noisier_than_the_lights_own_say_so(light: Light) -> None:
    """Where the accuracy is not reached. (Planted: no comparison.)"""
    rough = replace(light, sampling_error=1e-7, plan=replace(light.plan, accuracy=1e-6, warnings=()))
    for patterns, said in (("dots:2", True), ("dots:3", False)):
        (warning,) = [each for each in rough.expose(patterns).warnings if "accuracy 1e-06 was not reached" in each]
        assert ("trace the light for dots:2" in warning and "is noisier" in warning) is said
    assert rough.expose("dots:3", seed=9).manifest.configuration["light"] == {"patterns": "dots:3", "seed": SEED}
    with pytest.raises(ArgumentError, match=r"^accuracy 0\.001"):
        light.expose("dots:2", accuracy=1e-3)
