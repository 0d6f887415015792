"""A capture or calibration that was cut short: `--resume` finishes it to the same frames or factors, and nothing takes
it for a finished one."""

from __future__ import annotations

import json
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.system.interrupted import PATTERNS, RESUME, assert_equal_runs, cut_short

pytestmark = pytest.mark.robustness("Faults")


@pytest.fixture(scope="module")
def killed(lab: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same run, its process killed while it wrote frames; not to be changed."""
    run: Path = tmp_path_factory.mktemp("killed") / "run"
    done = cut_short(signal.SIGKILL, 100, "capture", *lab.arguments, "-o", run, "--patterns", PATTERNS, "--quiet")
    assert done.returncode == -signal.SIGKILL and done.stdout == "" and done.stderr == ""
    return run


@pytest.fixture
def interrupted(killed: Path, tmp_path: Path) -> Path:
    """A copy of the killed run."""
    return Path(shutil.copytree(killed, tmp_path / "run"))


def test_a_killed_run_is_no_run(refused: Callable[..., str], lab: Any, interrupted: Path) -> None:
    line = refused("reconstruct", "run", "--calibration", lab.calibration)
    assert "run: the capture is incomplete" in line and "--resume" in line
    line = refused("capture", *lab.arguments, "-o", "run", "--patterns", PATTERNS)
    assert "run: the folder holds files already" in line
    assert "go on with --resume" in line and "empty" not in line, "emptying it would throw the frames away"


def test_resume_finishes_it(call: Callable[..., Any], lab: Any, interrupted: Path, whole: Path) -> None:
    """And sweeps up what was half written."""
    kept = {path: path.stat().st_mtime_ns for path in interrupted.glob("frame_*.exr")}
    (interrupted / ".frame_00400.exr.4711-140703.part").write_bytes(b"\x76\x2f\x31\x01")
    outcome = call("capture", *lab.arguments, "-o", interrupted, "--patterns", PATTERNS, "--resume", "--json")
    assert outcome.code == 0 and outcome.payload["frames"] == 512
    assert_equal_runs(interrupted, whole)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept, "frames that were there are not written again"
    assert [path.name for path in interrupted.glob(".*")] == []


def test_resume_of_a_finished_run_changes_nothing(call: Callable[..., Any], lab: Any, tmp_path: Path) -> None:
    run = lab.copy("run", tmp_path / "run")
    before = {path.name: path.read_bytes() for path in run.glob("*.exr")}
    assert call("capture", *lab.arguments, "-o", run, "--patterns", "dots:4", "--resume").code == 0
    assert {path.name: path.read_bytes() for path in run.glob("*.exr")} == before


def test_resume_replaces_a_frame_that_was_changed(call: Callable[..., Any], lab: Any, tmp_path: Path) -> None:
    """`reconstruct` refuses such a frame and says: capture it again with --resume."""
    run = lab.copy("run", tmp_path / "run")
    data = bytearray((run / "frame_00005.exr").read_bytes())
    data[-2000] ^= 1
    (run / "frame_00005.exr").write_bytes(data)
    assert "resume" in call("reconstruct", run, "--calibration", lab.calibration).refusal
    assert call("capture", *lab.arguments, "-o", run, "--patterns", "dots:4", "--resume").code == 0
    assert_equal_runs(run, lab.run)


@pytest.mark.parametrize(
    ("options", "fragment"),
    [
        (["--seed", "1"], "seed"),
        (["--patterns", "dots:2"], "patterns"),
        (["--accuracy", "0.1"], "accuracy"),
        (["--exposure", "0.01"], "exposure"),
        (["--camera", "other.toml"], "sensor"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else None,
)
def test_resume_refuses_another_configuration(
    refused: Callable[..., str], lab: Any, tmp_path: Path, options: list[str], fragment: str
) -> None:
    (tmp_path / "other.toml").write_text(lab.camera.read_text().replace("6.7", "7.6"))
    lab.copy("run", tmp_path / "run")
    line = refused("capture", *lab.arguments, "-o", "run", "--resume", "--patterns", "dots:4", *options)
    assert "--resume: run holds a run of another configuration" in line and f"({fragment} differ)" in line


@pytest.mark.parametrize("text", ['{"kind": "capt', "[]", "{}"])
def test_resume_refuses_a_corrupted_manifest(refused: Callable[..., str], lab: Any, tmp_path: Path, text: str) -> None:
    run = lab.copy("run", tmp_path / "run")
    (run / "manifest.json").write_text(text)
    assert "run/manifest.json" in refused("capture", *lab.arguments, "-o", "run", "--resume", "--patterns", "dots:4")


# ---- calibrations ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def wide(lab: Any) -> tuple[object, ...]:
    """The laboratory's devices with a projector of 32 x 32 pixels, whose 128 shots take long enough to be hit."""
    return lab.write_scene("wide", n=32), *lab.electronics[:-1], "0.02"


@pytest.fixture(scope="module")
def factors(call: Callable[..., Any], wide: tuple[object, ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The calibration of those devices which nothing disturbed."""
    calibration: Path = tmp_path_factory.mktemp("factors") / "cal"
    assert call("calibrate", *wide, "-o", calibration).code in (0, 1)
    return calibration


@pytest.mark.parametrize(
    ("how", "part"),
    [
        pytest.param(signal.SIGKILL, "manifest.json", marks=pytest.mark.slow),
        pytest.param(signal.SIGKILL, "light.part.npz", marks=pytest.mark.slow),
        (signal.SIGINT, "stripes.part.npz"),
        pytest.param(signal.SIGTERM, "stripes.part.npz", marks=pytest.mark.slow),
    ],
)
def test_a_calibration_that_is_stopped_loses_no_finished_part(
    call: Callable[..., Any],
    lab: Any,
    wide: tuple[object, ...],
    factors: Path,
    tmp_path: Path,
    how: signal.Signals,
    part: str,
) -> None:
    """While light is traced, after it, and between stripes; `reconstruct` does not take it for a calibration."""
    calibration = tmp_path / "cal"
    done = cut_short(how, part, "calibrate", *wide, "-o", calibration)
    reported = {signal.SIGINT: "mitsim: interrupted" + RESUME, signal.SIGTERM: "mitsim: ended by SIGTERM" + RESUME}
    assert (done.returncode, done.stderr) == (-how if how == signal.SIGKILL else 128 + how, reported.get(how, ""))
    assert (calibration / part).is_file()
    assert "the calibration is incomplete" in call("reconstruct", lab.run, "--calibration", calibration).refusal
    assert "(seed differ)" in call("calibrate", *wide, "-o", calibration, "--resume", "--seed", "1").refusal
    outcome = call("calibrate", *wide, "-o", calibration, "--resume")
    assert outcome.code in (0, 1), outcome.err
    assert sorted(path.name for path in calibration.iterdir()) == ["left.exr", "manifest.json", "right.exr"]
    ours, theirs = (json.loads((folder / "manifest.json").read_text()) for folder in (calibration, factors))
    assert ours["checksums"] == theirs["checksums"] and ours["configuration"] == theirs["configuration"]
