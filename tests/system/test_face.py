"""The Python face: `import mitsim as ms` gives all that the command line does, lazily, and the same numbers."""

from __future__ import annotations

import ast
import json
import math
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mitsim as ms
from mitsim.acquire import capture
from mitsim.core.exr import read_frame
from mitsim.light import light
from tests.system.refusals import Call, Refused

pytestmark = pytest.mark.usefixtures("variant")
ACCURACY, SEED = 0.02, 4
ALBEDO = 0.4


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path]) -> ms.Bench:
    return ms.open_bench(shared_scene("face"), albedo=ALBEDO)


@pytest.fixture(scope="module")
def shots(bench: ms.Bench) -> ms.Capture:
    return bench.capture("dots:3", accuracy=ACCURACY, seed=SEED)


@pytest.fixture(scope="module")
def factors(bench: ms.Bench) -> ms.Factors:
    return bench.calibrate(accuracy=ACCURACY)


# ---- names -----------------------------------------------------------------------------------------------------------


def test_every_name_is_fetched_from_its_home_when_it_is_used() -> None:
    """In a process of its own, each name first: whatever else was imported, it is the same object."""
    program = """
import importlib, sys
import mitsim as ms
assert not {"numpy", "scipy", "mitsuba", "drjit", "pydantic"} & set(sys.modules), "the package alone imports nothing"
assert set(ms._HOMES) == set(ms.__all__) and set(dir(ms)) == {*ms.__all__, "__version__"}
tracing = ["CalibrationPlan", "Light", "Prediction", "Rendered", "calibrate_model", "plan_calibration"]
for name in sorted(ms.__all__, key=tracing.__contains__):
    assert name in tracing or "mitsuba" not in sys.modules, "only what traces imports the renderer"
    home = importlib.import_module(ms._HOMES[name])
    assert getattr(ms, name) is getattr(home, name), name
try:
    ms.nonsense
except AttributeError as error:
    assert "nonsense" in str(error)
else:
    raise SystemExit("no such name, and no error")
"""
    # The room `reconstruct` and the function of that name: whichever is imported first.
    room = """
import importlib
import mitsim as ms
home = importlib.import_module(ms._HOMES['load_calibration'])
assert ms.load_calibration is home.load_calibration
assert ms.reconstruct is importlib.import_module(ms._HOMES['reconstruct']).reconstruct
"""
    for each in (program, room):
        done = subprocess.run([sys.executable, "-c", each], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr


def test_type_checkers_see_the_same_homes() -> None:
    """(Planted: a name in brackets, which the package overlooks.)"""
    stub = ast.parse(Path(ms.__file__).with_suffix(".pyi").read_text())
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    seen = {alias.name: node.module for node in imports for alias in node.names}
    assert seen == {**ms._HOMES, "__version__": "mitsim.version"}


# ---- from a scene to an image ----------------------------------------------------------------------------------------


def test_the_lines_that_the_package_opens_with(shared_scene: Callable[..., Path], tmp_path: Path) -> None:
    print_ = np.kron(np.random.default_rng(3).integers(40, 250, (16, 16)), np.ones((15, 15)))
    scene = shared_scene("lines", reflectance=np.pad(print_, 8, mode="edge"), sheet_z="$sheet_z")
    albedo = '<default name="albedo" value="0.5"/>'
    scene.write_text(scene.read_text().replace(albedo, albedo + '<default name="sheet_z" value="390"/>'))
    bench = ms.open_bench(scene, sheet_z=400)
    plan = bench.plan("dots:4", accuracy=5e-3)
    shots = bench.capture(plan, seed=0)
    assert shots.save(tmp_path / "run") == tmp_path / "run"
    factors = bench.calibrate(seed=0, accuracy=5e-3)
    factors.save(tmp_path / "cal")
    image = ms.reconstruct(shots, factors, lam="auto")
    assert image.ok, image.status
    assert ms.psnr(image.image, shots.truth) > 25 and ms.ssim(image.image, shots.truth) > 0.8
    light = bench.light("dots:4", accuracy=5e-3)
    for k in (1, 2):
        assert len(light.expose(f"dots:{k}").dn) == k**2
    operator = factors.operator("dots:4")
    model = operator @ image.image.ravel()
    data = np.concatenate([frame.ravel() for frame, _, _ in shots.measurements()])
    assert np.linalg.norm(data - model) / np.linalg.norm(data) == pytest.approx(image.residual, rel=1e-3)


@pytest.mark.usefixtures("other_kernels")
def test_a_saved_capture_is_that_of_the_command_line(
    call: Call, shots: ms.Capture, bench: ms.Bench, tmp_path: Path
) -> None:
    """The same files with the same pixels, and manifests that differ in seconds and compiled kernels alone."""
    shots.save(tmp_path / "saved")
    options = "--patterns", "dots:3", "--accuracy", ACCURACY, "--seed", SEED, "-D", f"albedo={ALBEDO}"
    reported = call("capture", bench.loaded.path, *options, "-o", tmp_path / "told", "--json").payload
    bench.capture("dots:3", tmp_path / "direct", accuracy=ACCURACY, seed=SEED)
    names = sorted(path.name for path in (tmp_path / "told").iterdir())
    assert names == [*(f"frame_{index:05d}.exr" for index in range(9)), "manifest.json", "truth.exr"]
    manifest = untimed(tmp_path / "told")
    for other in ("saved", "direct"):
        assert sorted(path.name for path in (tmp_path / other).iterdir()) == names
        assert untimed(tmp_path / other) == manifest
        for name in names:
            if name.endswith(".exr"):
                assert_equal_files(tmp_path / other / name, tmp_path / "told" / name)
    # What the process took is as little of the result as its seconds.
    taken = reported.pop("memory_bytes")
    assert 0 <= taken < reported["predicted_memory_bytes"]
    error = f"{reported['total_error_bound']:.1e}"
    assert reported.pop("headline") == f"Captured 9 frames of 64 x 64 pixels, total error up to {error}"
    summary = {**shots.summary(), "shape": [64, 64], "warnings": [], "output": reported["output"]}
    timed = {"seconds": 0, "kernels": 0, "predicted_seconds": 0, "report": None}
    assert {**summary, **timed} == {**reported, **timed}


def untimed(folder: Path) -> dict[str, Any]:
    """The manifest without its command and what the clock says: stages, kernels, and the plan's predictions from
    measured paces."""
    manifest = json.loads((folder / "manifest.json").read_text())
    plan = manifest["plan"]
    rows = [{**row, "seconds": 0} for row in plan["effects"]]
    untimed_plan = {**plan, "effects": rows, "predicted_seconds": 0, "predicted": {}}
    return {**manifest, "seconds": {}, "kernels": {}, "plan": untimed_plan, "command": None}


def assert_equal_files(one: Path, other: Path) -> None:
    (ours, mine), (theirs, stated) = read_frame(one), read_frame(other)
    assert mine == stated and ours.keys() == theirs.keys()
    for name, values in ours.items():
        assert values.dtype == theirs[name].dtype and np.array_equal(values, theirs[name]), (one, name)


def test_images_from_memory_and_from_disk_are_equal(shots: ms.Capture, factors: ms.Factors, tmp_path: Path) -> None:
    capture, cal = ms.load_run(shots.save(tmp_path / "run")), ms.load_calibration(factors.save(tmp_path / "cal"))
    assert np.array_equal(cal.left, factors.left) and np.array_equal(cal.right, factors.right)
    assert cal.fingerprint == factors.fingerprint and str(cal.status) == str(factors.status)
    for method in ("tikhonov", "markov", "tv"):
        first, second = ms.reconstruct(shots, factors, method=method), ms.reconstruct(capture, cal, method=method)
        assert np.array_equal(first.image, second.image) and first.inputs == second.inputs, method
        assert first.save(tmp_path / method) == second.save(tmp_path / method), "the same inputs may be written again"


# ---- light that is traced once ---------------------------------------------------------------------------------------


@pytest.fixture
def traced(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Purposes of all light that was traced since."""
    purposes: list[str] = []
    original, truth, truths = light.trace_lines, light.trace_truth, capture.trace_truths

    def counted(*arguments: Any) -> Any:
        sampling = arguments[5] if len(arguments) > 5 else None
        purposes.append((sampling or light.Sampling()).purpose)
        return original(*arguments)

    def counted_truth(of: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *arguments: (purposes.append("truth"), of(*arguments))[1]  # type: ignore[func-returns-value]

    for module in (light, capture):
        monkeypatch.setattr(module, "trace_lines", counted)
    monkeypatch.setattr(light, "trace_truth", counted_truth(truth))
    monkeypatch.setattr(capture, "trace_truths", counted_truth(truths))
    return purposes


def same_light(ours: ms.Capture, theirs: ms.Capture) -> None:
    """Single precision of the light's sums by pixel and by class: 1e-6 of the brightest pixel."""
    assert ours.exposure_s == pytest.approx(theirs.exposure_s, rel=1e-6)
    assert np.abs(ours.electrons - theirs.electrons).max() < 1e-6 * theirs.electrons.max()
    assert np.array_equal(ours.truth, theirs.truth)


def test_light_serves_any_family_and_is_traced_once(
    bench: ms.Bench, monkeypatch: pytest.MonkeyPatch, traced: list[str]
) -> None:
    """Against captures of each family with the same number of paths: one plan for all, and sampling in one round."""
    plan = replace(bench.plan("dots:3", accuracy=ACCURACY, seed=SEED), sampling_target=math.inf)

    def planned(self: ms.Bench, patterns: str, **request: Any) -> ms.Plan:
        return replace(plan, request=ms.Request.of(patterns=patterns, **request))

    monkeypatch.setattr(ms.Bench, "plan", planned)
    light = bench.light("dots:3", accuracy=ACCURACY, seed=SEED)
    families = "dots:1", "dots:2", "dots:5", "uniform", "hadamard:2"
    exposed = {patterns: light.expose(patterns) for patterns in families}
    assert traced == ["scene", "truth"]
    for patterns, ours in exposed.items():
        same_light(ours, bench.capture(planned(bench, patterns, accuracy=ACCURACY, seed=SEED)))
    assert len(traced) == 2 + 2 * len(families), "a capture of its own traces anew"


def test_light_is_exposed_with_other_seeds_and_times_but_no_other_light(bench: ms.Bench) -> None:
    light = bench.light("uniform", accuracy=0.1, seed=SEED, effects="-diffraction")
    first, other = light.expose("uniform", exposure=0.01), light.expose("uniform", exposure=0.02, seed=SEED + 1)
    assert (first.exposure_s, other.exposure_s) == (0.01, 0.02)
    assert np.allclose(2 * first.electrons, other.electrons, rtol=1e-6) and not np.array_equal(first.dn, other.dn)
    for name, value in (("accuracy", 1e-3), ("effects", {}), ("patterns", "dots:2")):
        with pytest.raises((ms.ArgumentError, TypeError)) as caught:
            light.expose("uniform", **{name: value})
        assert name in str(caught.value)


# ---- the linear model ------------------------------------------------------------------------------------------------


def test_an_operator_of_other_patterns(factors: ms.Factors, shared_scene: Callable[..., Path]) -> None:
    with pytest.raises(ms.MitsimError, match="dots:17"):
        factors.operator("dots:17")
    with pytest.raises(ms.MitsimError, match="8 x 8 scene pixels, but the factors have 16 x 16"):
        factors.operator(ms.open_bench(shared_scene("eight", n=8)).family("dots:2"))


# ---- notebooks -------------------------------------------------------------------------------------------------------


def test_objects_show_themselves(bench: ms.Bench, shots: ms.Capture, factors: ms.Factors) -> None:
    plan = bench.plan("uniform", accuracy=0.1)
    page = plan._repr_html_()
    assert page.count("<tr>") == 1 + len(plan.effects) and "error if off" in page
    assert all(f">{row.name}<" in page for row in plan.effects)
    for shown, pictures, words in (
        (bench, 1, "separable, order 9, 2 mm before the sensor"),
        (bench.light("uniform", accuracy=0.1), 1, "Monte Carlo error"),
        (shots, 4, "dots:3"),
        (factors, 2, "left: 64 sensor x 16 projector pixels"),
        (ms.reconstruct(shots, factors), 2, "standard uncertainty"),
    ):
        page = shown._repr_html_()
        assert page.count('src="data:image/png;base64,') == pictures, type(shown)
        assert words in page and len(page) < 1e5 and page.count("<table>") == 1


# ---- numbers and names -----------------------------------------------------------------------------------------------


def test_a_shipped_name_wins_over_a_folder_of_that_name(refused: Refused, tmp_path: Path) -> None:
    (tmp_path / "photograph").mkdir()
    (tmp_path / "photograph" / "scene.xml").write_text("<scene")
    assert "dots:129" in refused("plan", "photograph", "--patterns", "dots:129")
    for own in ("./photograph", tmp_path / "photograph", "photograph/scene.xml"):
        assert "photograph/scene.xml" in refused("plan", own, "--patterns", "dots:129")


@pytest.mark.parametrize("name", ["scene", "variant", "camera", "projector", "allow_outside_files", "for_render"])
def test_parameters_that_python_takes_for_others(refused: Refused, bench: ms.Bench, name: str) -> None:
    line = refused("plan", bench.loaded.path, "-D", f"{name}=x")
    assert f"-D '{name}=x'" in line and "another" in line
