"""Calibration sessions: factors that are the camera's geometric shadow, with the error that their noise predicts.

Few electrons (1 % of full well) make the sensor's noise the only error that counts.
"""

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from mitsim.api.bench import Bench, open_bench
from mitsim.bench.effects import EFFECTS
from mitsim.calibrate.board_session import Session
from mitsim.calibrate.calibrate import STRIPES, Checkpoint
from mitsim.core.environment import versions
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.devices.camera import centred_edges
from mitsim.devices.framelist import FrameList
from mitsim.devices.patterns import Lighting
from mitsim.devices.session import SessionRecipe, load_recipe
from mitsim.light.cost_model import frame_seconds
from mitsim.light.plan import Plan
from mitsim.planner.planner import make_plan
from mitsim.reconstruct.captured_session import calibrate_frames
from mitsim.reconstruct.factors import Estimate, Factors, load_calibration
from tests.shadow_factor import scene_factor

pytestmark = pytest.mark.usefixtures("kept_plans", "other_kernels")
N = 16
CASES = [("separable", "pair", 16), ("separable", "uniform", 16), ("flatcam", "pair", 16)]
CASES += [pytest.param("separable", "pair", 13, marks=pytest.mark.slow)]
Done = tuple[Bench, Factors, Estimate, Path]
"""The bench, its factors, the estimate that they were made of, and their folder."""


def geometric_plan(*arguments: object) -> Plan:
    """Direct light through a geometric mask."""
    return make_plan(*arguments, switches=dict.fromkeys(EFFECTS, False))


def recipe(mode: str, fraction: float = 0.01) -> SessionRecipe:
    return load_recipe().model_copy(update={"exposure_fraction": fraction, "signed_capture": mode})


@pytest.fixture(scope="module")
def session(
    shared_scene: Callable[..., Path], variant: str, tmp_path_factory: pytest.TempPathFactory
) -> Callable[..., Done]:
    made: dict[tuple[str, str, int], Done] = {}

    def run(mask: str, mode: str, n: int) -> Done:
        key = mask, mode, n
        if key not in made:
            bench = open_bench(shared_scene(f"{mask}{n}", mask=mask, n=n), variant)
            folder = tmp_path_factory.mktemp("calibration") / "cal"
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr("mitsim.calibrate.board_session.make_plan", geometric_plan)
                factors = bench.calibrate(seed=2, recipe=recipe(mode), output=folder)
            made[key] = bench, factors, factors.estimate, folder
        return made[key]

    return run


def test_each_depth_has_factors_of_its_own(
    shared_scene: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At each depth those of the geometric shadow there: rows from the axis, columns from 60 mm beside it, off
    by their predicted error. In folders called by depth, which stay as they are when resumed; with the
    parallax from there. (Planted: the board always on the aligned plane, one seed for all depths.)"""
    monkeypatch.setattr("mitsim.calibrate.board_session.make_plan", geometric_plan)
    bench = open_bench(shared_scene("depths16", n=16))
    depths = recipe("pair").model_copy(update={"depths": (350.0, 450.0)})
    found = bench.calibrate_depths(seed=2, recipe=depths, output=tmp_path / "cal")
    geometry = bench.geometry
    code = geometry.build_mask().terms[-1][1]
    for depth, factors in found.items():
        assert factors.estimate is not None and factors.status.ok
        half, centre = 60 * depth / 400, 60 * (1 - depth / 400)
        errors = factors.estimate.predicted_error
        for side, middle, error in zip((factors.left, factors.right), (0.0, centre), errors, strict=True):
            # Columns run down -x, and the projector stands at +x.
            edges = np.linspace(-half, half, N + 1) - middle
            shadow = scene_factor(
                code, geometry.mask_feature, geometry.pixel_edges, edges, geometry.mask_distance, depth
            )
            scale = (side * shadow).sum(axis=0) / np.square(shadow).sum(axis=0)
            rest = np.linalg.norm(side - scale * shadow) / np.linalg.norm(side)
            assert rest == pytest.approx(error, rel=0.3)
        result, parallax = factors.manifest.result, factors.manifest.parallax
        assert result["depth_mm"] == depth and parallax is not None and parallax.depth_mm == depth
        assert parallax.column_tan == pytest.approx(np.array([-half - centre, half - centre]) / depth, abs=1e-5)
        assert parallax.column_mm == pytest.approx((-60, -60), abs=1e-3)
        folder = tmp_path / "cal" / f"{depth:g}"
        assert np.array_equal(load_calibration(folder).left, factors.left)
    assert len({factors.manifest.configuration["seed"] for factors in found.values()}) == 2
    stamp = (tmp_path / "cal" / "350" / "manifest.json").stat().st_mtime_ns
    again = bench.calibrate_depths(seed=2, recipe=depths, output=tmp_path / "cal", resume=True)
    assert np.array_equal(again[450.0].right, found[450.0].right)
    assert (tmp_path / "cal" / "350" / "manifest.json").stat().st_mtime_ns == stamp
    with pytest.raises(MitsimError, match="use calibrate_depths"):
        bench.calibrate(recipe=depths)
    with pytest.raises(MitsimError, match="has no depths"):
        bench.calibrate_depths()
    with pytest.raises(MitsimError, match="the mask ends 2 mm"):
        bench.calibrate_depths(recipe=depths.model_copy(update={"depths": (1.5,)}))


def geometric(bench: Bench) -> np.ndarray:
    """(pixels, n) shadow of the mask's code by projector pixels of 120 mm / n at 400 mm; flatcam: centred."""
    geometry = bench.geometry
    code = geometry.build_mask().terms[-1][1]
    scene = centred_edges(bench.n, 120.0 / bench.n)
    factor = scene_factor(code, geometry.mask_feature, geometry.pixel_edges, scene, geometry.mask_distance, 400.0)
    return factor - factor.mean(axis=0) if geometry.mask == "flatcam" else factor


@pytest.mark.parametrize(("mask", "mode", "n"), CASES)
def test_factors_are_the_geometric_shadow_within_their_noise(
    session: Callable[..., Done], mask: str, mode: str, n: int
) -> None:
    """Each column up to its own scale (falloff makes them 1 % different): the rest is the predicted noise.

    1008 numbers a side tell a noise to 2 %; the light's fall-off inside a projector pixel adds a per mille.
    """
    bench, factors, calibration, _ = session(mask, mode, n)
    truth, result = geometric(bench), factors.manifest.result
    assert result["phi_error"] == pytest.approx(np.hypot(*calibration.predicted_error), rel=0.3)
    assert result["noise_free_residual"] < 2e-3 < result["separability_residual"]
    assert result["condition"] == calibration.condition and factors.manifest.centre == (mask == "flatcam")
    for factor, predicted in zip((calibration.left, calibration.right), calibration.predicted_error, strict=True):
        scale = (factor * truth).sum(axis=0) / np.square(truth).sum(axis=0)
        assert np.ptp(scale) < (0.1 if mask == "separable" else 1.0) * abs(scale.mean())
        error = np.linalg.norm(factor - truth * scale) / np.linalg.norm(factor)
        assert error == pytest.approx(predicted, rel=0.12)
        assert np.linalg.norm(factor - truth[::-1] * scale) > 3 * error * np.linalg.norm(factor), "orientation"


def test_the_scale_is_absolute(session: Callable[..., Done]) -> None:
    """left x right reproduces the rate of a uniform frame: E A t eta / (h c / lambda), from the board's radiance."""
    bench, _, calibration, _ = session("separable", "pair", 16)
    rate = np.outer(calibration.left.sum(axis=1), calibration.right.sum(axis=1))
    radiance = 0.99 * 111000 / 400**2
    tau = (np.arange(N) - 7.5) * 0.3 / N
    falloff = (1 + np.square(tau)[:, None] + np.square(tau)[None, :]) ** -2
    shadow = geometric(bench)
    irradiance = radiance * (0.3 / N) ** 2 * shadow @ falloff @ shadow.T
    photon_j = 6.62607015e-34 * 299792458 / 562e-9
    expected = irradiance * (11.72e-6) ** 2 * bench.sensor.quantum_efficiency / photon_j
    # A cell's falloff is taken at its middle (2e-4); noise of the sum of 16 columns is below a percent a pixel.
    assert rate.mean() == pytest.approx(expected.mean(), rel=3e-3)
    assert np.linalg.norm(rate - expected) < 0.03 * np.linalg.norm(expected)


def test_what_a_session_takes_is_predicted(session: Callable[..., Done]) -> None:
    """By stage, and in bytes; there is no truth to be traced, and frames of both sides count. (Planted: of one.)"""
    bench, factors, _, _ = session("separable", "pair", 16)
    result = factors.manifest.result
    assert result["predicted_seconds"] == pytest.approx(sum(result["predicted"].values()))
    assert result["predicted"].keys() >= {"start", "plan", "transport", "optics", "sensor"}
    assert result["predicted"]["truth"] == 0
    exposing = frame_seconds(bench, 2 * 2 * 16)["sensor"]
    assert result["predicted"]["sensor"] == pytest.approx(0.55 * exposing) and exposing > 0
    assert 0 < result["predicted"]["optics"] < 10
    assert 3e8 < result["predicted_memory_bytes"] < 2e9


def test_seeds(shared_scene: Callable[..., Path]) -> None:
    bench = open_bench(shared_scene("separable16", n=16))
    one, again, other = (bench.calibrate(seed=seed, accuracy=2e-2, recipe=recipe("uniform")).left for seed in (1, 1, 2))
    assert np.array_equal(one, again) and not np.allclose(one, other, rtol=1e-6)


def test_a_session_is_planned_by_what_its_responses_need(shared_scene: Callable[..., Path]) -> None:
    """Diffraction hardly changes a uniform frame, but single lines, and so the +-1 responses, by a tenth."""
    board = open_bench(shared_scene("separable16", n=16)).with_board(0.99)
    uniform = make_plan(board, Lighting.uniform(16), 2e-2, 0)
    assert "diffraction" not in uniform.settings.effects
    assert "diffraction" in Session(board, recipe("pair")).plan(2e-2, Job()).settings.effects


# ---- frames of a session ---------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("geometric_sessions")
@pytest.mark.parametrize(
    ("more", "files", "ending"),
    [
        ({"signed_capture": "pair", "order": "interleaved"}, 64, ".tif"),
        ({"signed_capture": "uniform", "repeats": 2, "order": "random"}, 34 * 2, ".npy"),
    ],
)
def test_frames_that_are_written_give_the_same_factors_bit_for_bit(
    shared_scene: Callable[..., Path], tmp_path: Path, more: dict[str, object], files: int, ending: str
) -> None:
    """Codes as TIFF, real numbers as NPY, called by the order in which they are taken; and nothing that a camera's user
    does not have. (Planted: numbers by the order of the list, repeats not told apart, half of the codes cut, the
    parallax in the list.)"""
    bench = open_bench(shared_scene("written16", n=16))
    if ending == ".npy":
        bench = replace(bench, devices=replace(bench.devices, sensor=bench.sensor.model_copy(update={"bits": None})))
    own = recipe("pair").model_copy(update=more)
    simulated = bench.write_session(tmp_path / "frames", tmp_path / "cal", seed=3, recipe=own)
    found = calibrate_frames(tmp_path / "frames")
    assert np.array_equal(found.left, simulated.left) and np.array_equal(found.right, simulated.right)
    assert simulated.manifest.result["frames"] == files == len(list((tmp_path / "frames").glob(f"*{ending}")))
    assert np.array_equal(load_calibration(tmp_path / "cal").left, found.left)
    listed = json.loads((tmp_path / "frames" / "session.json").read_text())
    assert not listed.keys() - FrameList.model_fields.keys() and not {"parallax", "seed"} & listed.keys()
    taken = [frame["file"] for frame in listed["frames"]]
    assert taken == sorted(taken)
    with pytest.raises(MitsimError, match="holds files already"):
        bench.write_session(tmp_path / "frames", recipe=own)


# ---- interrupted and resumed -----------------------------------------------------------------------------------------

SECONDS = {"seconds", "kernels", "predicted", "predicted_seconds"}
"""Of a result, what differs from session to session: time, taken and predicted with what was taken before, and kernels
that an earlier one has left to be compiled."""


class Killed(BaseException):
    """The end of a process that no code of ours takes notice of."""


@pytest.fixture
def geometric_sessions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sessions of geometric shadows whose plan is made once for each scene, accuracy and seed: plans take most of their
    time, and that the same seed makes the same plan is held by hard/test_reproducibility.py."""
    plans: dict[tuple[object, ...], Plan] = {}

    def planned(board: Bench, lighting: Lighting, *request: object) -> Plan:
        key = board.loaded.path, *request
        if key not in plans:
            plans[key] = geometric_plan(board, lighting, *request)
        return plans[key]

    monkeypatch.setattr("mitsim.calibrate.board_session.make_plan", planned)


@pytest.fixture(autouse=True)
def every_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    """Checkpoints are kept however little time has passed."""
    monkeypatch.setattr("mitsim.calibrate.calibrate._SAVED_AFTER_S", 0.0)


@pytest.fixture
def kill_after(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """The session ends right after so many checkpoints are written from now on."""
    save = Checkpoint.save

    def arm(count: int) -> None:
        left = iter(range(count - 1, -1, -1))

        def save_and_die(self: Checkpoint, arrays: Mapping[str, npt.ArrayLike]) -> None:
            save(self, arrays)
            if next(left) == 0:
                raise Killed

        monkeypatch.setattr(Checkpoint, "save", save_and_die)

    return arm


def assert_equal(ours: Factors, theirs: Factors) -> None:
    """The same factors bit for bit, the same report but for seconds."""
    for name in ("left", "right"):
        assert np.array_equal(getattr(ours, name), getattr(theirs, name)), name
    for name in ("predicted_error", "unexplained", "noise", "status"):
        assert getattr(ours.estimate, name) == getattr(theirs.estimate, name), name
    for name in ours.manifest.result.keys() - SECONDS:
        assert ours.manifest.result[name] == theirs.manifest.result[name], name


@pytest.mark.usefixtures("geometric_sessions")
def test_damaged_and_foreign_parts_are_computed_again(
    shared_scene: Callable[..., Path],
    tmp_path: Path,
    kill_after: Callable[[int], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Cut, emptied, flipped at the start, in the middle and at the end, or of a session with another seed."""
    bench = open_bench(shared_scene("damaged16", n=16))
    save = Checkpoint.save
    for name, seed in (("ours", 3), ("theirs", 4)):
        kill_after(2)
        with pytest.raises(Killed):
            bench.calibrate(recipe=recipe("pair"), seed=seed, output=tmp_path / name)
    monkeypatch.setattr(Checkpoint, "save", save)
    whole = bench.calibrate(recipe=recipe("pair"), seed=3)

    def flipped(spot: float) -> Callable[[bytes], bytes]:
        def flip(data: bytes) -> bytes:
            index = int(spot * (len(data) - 1))
            return data[:index] + bytes([data[index] ^ 4]) + data[index + 1 :]

        return flip

    damages = [lambda data: data[:-7], lambda data: b"", flipped(0.0), flipped(0.5), flipped(1.0), None]
    for index, damage in enumerate(damages):
        folder = shutil.copytree(tmp_path / "ours", tmp_path / f"cal{index}")
        part = folder / STRIPES
        source = part if damage else tmp_path / "theirs" / part.name
        part.write_bytes((damage or bytes)(source.read_bytes()))
        assert_equal(bench.calibrate(recipe=recipe("pair"), seed=3, output=folder, resume=True), whole)


@pytest.mark.usefixtures("geometric_sessions")
def test_only_the_same_session_is_resumed(
    shared_scene: Callable[..., Path],
    tmp_path: Path,
    kill_after: Callable[[int], None],
) -> None:
    bench = open_bench(shared_scene("other16", n=16))
    kill_after(1)
    with pytest.raises(Killed):
        bench.calibrate(recipe=recipe("pair"), output=tmp_path / "cal")
    for change, words in (
        ({"seed": 5}, "seed differ"),
        ({"accuracy": 1e-2, "recipe": recipe("uniform")}, "accuracy, recipe differ"),
    ):
        with pytest.raises(
            MitsimError, match=rf"resume=True: .*cal holds a session of another configuration \({words}\)"
        ):
            bench.calibrate(**{"recipe": recipe("pair"), "output": tmp_path / "cal", "resume": True, **change})
    with pytest.raises(MitsimError, match="holds files already"):
        bench.calibrate(recipe=recipe("pair"), output=tmp_path / "cal")
    (tmp_path / "cal" / "manifest.json").write_text('{"kind": "capture"}')
    with pytest.raises(MitsimError, match=r"resume=True: .* is not that of a calibration"):
        bench.calibrate(recipe=recipe("pair"), output=tmp_path / "cal", resume=True)


@pytest.mark.usefixtures("geometric_sessions")
def test_what_is_said_of_factors_is_added_up_by_one_thread_of_blas(
    shared_scene: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 128 x 128 numbers, `phi_error` differed in its last digit with one thread and two. (Planted: so it does.)"""
    asked: list[set[int]] = []

    def look() -> dict[str, str]:
        asked.append({pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"})
        return versions()

    monkeypatch.setattr("mitsim.calibrate.calibrate.versions", look)
    with threadpool_limits(2):
        open_bench(shared_scene("threads16", n=16)).calibrate(recipe=recipe("uniform"))
    assert asked == [{1}]
