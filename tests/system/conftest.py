"""Shared by the system tests: the command line called in this process or as a program, and one small laboratory.

A call in this process costs milliseconds where a new process imports for seconds; it stays in ``llvm_ad_mono``. Both
ways give an ``Outcome``: exit status and all that came out on stdout and stderr, including what C++ writes past Python.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer.main

from tests.kept_plans import plans_kept
from tests.system.interrupted import PATTERNS

ACCURACY = "0.005"
"""Relative error of expected frames; at 0.02 the uniform frame comes without diffraction, and its image loses 10 dB."""

CAMERA = """
name = "test camera"
pixel_pitch_um = 5.86
binning = 2
full_well_e = 32360.0
read_noise_e = 6.7
dark_current_e_per_s = 1.5
quantum_efficiency = 0.75
gain_dn_per_e = 0.125
black_level_dn = 40.0
bits = 12
source = "made for a test"
"""
PROJECTOR = 'name = "test projector"\neffective_wavelength_nm = 562.0\n'
MITSIM = Path(sys.executable).with_name("mitsim")
HANGS_S = 1200
"""Seconds on the clock after which a program counts as hung: ten times 120, which captures in colour passed while a
dozen other busy processes shared two processors."""
PICTURED = {"capture", "calibrate", "import", "reconstruct", "render", "sense"}
"""Verbs whose work has pictures."""
_commands = cache(typer.main.get_command)
"""Typer builds all commands anew whenever one is called, for longer than most refusals take."""


@dataclass(frozen=True)
class Outcome:
    """What one command did."""

    code: int
    out: str
    err: str

    @property
    def payload(self) -> dict[str, Any]:
        """The one JSON object on stdout; fails when there is anything else."""
        assert self.code in (0, 1), self.err
        found = json.loads(self.out, parse_constant=lambda text: pytest.fail(f"{text} is no JSON"))
        assert isinstance(found, dict)
        assert self.out.count("\n") == 1 and self.out.endswith("\n")
        return found

    @property
    def refusal(self) -> str:
        """The one line of a refusal, after ``mitsim: ``; fails when this was none."""
        assert self.code == 2, (self.code, self.out, self.err)
        assert self.out == ""
        lines = self.err.splitlines()
        assert len(lines) == 1 and lines[0].startswith("mitsim: "), self.err
        assert "\x1b" not in self.err and "Traceback" not in self.err
        return lines[0].removeprefix("mitsim: ")


def _plain(arguments: tuple[object, ...]) -> tuple[object, ...]:
    """``arguments`` of mitsim without pictures, of which most tests see nothing."""
    verb = str(arguments[0]) if arguments else ""
    planned = verb == "calibrate" and "--plan" in map(str, arguments)
    return (verb, "--no-pictures", *arguments[1:]) if verb in PICTURED and not planned else arguments


def call(*arguments: object, cwd: Path | None = None, pictures: bool = False) -> Outcome:
    """``mitsim ARGUMENTS`` in this process; without pictures, unless these are asked for."""
    from mitsim import cli

    before, kept = sys.argv, Path.cwd()
    sys.argv = ["mitsim", *map(str, arguments if pictures else _plain(arguments))]
    os.chdir(cwd or kept)
    try:
        with _captured() as (out, err), pytest.MonkeyPatch.context() as patch:
            patch.setattr(typer.main, "get_command", _commands)
            try:
                cli.run()
                code: object = None
            except SystemExit as stop:
                code = stop.code or 0
            assert isinstance(code, int), code
            return Outcome(code, out.read_text(), err.read_text())
    finally:
        sys.argv = before
        os.chdir(kept)


@contextlib.contextmanager
def _captured() -> Iterator[tuple[Path, Path]]:
    """Files that receive stdout and stderr of Python and of native code."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        paths = Path(folder, "out"), Path(folder, "err")
        redirects = contextlib.redirect_stdout, contextlib.redirect_stderr
        for descriptor, path, redirect in zip((1, 2), paths, redirects, strict=True):
            file = stack.enter_context(path.open("w", buffering=1))
            saved = os.dup(descriptor)
            os.dup2(file.fileno(), descriptor)
            stack.callback(os.close, saved)
            stack.callback(os.dup2, saved, descriptor)
            stack.enter_context(redirect(file))
        yield paths


def shell(*arguments: object, cwd: Path | None = None, **options: Any) -> Outcome:
    """The installed program ``mitsim ARGUMENTS``, without pictures."""
    command = [MITSIM, *map(str, _plain(arguments))]
    done = subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=HANGS_S, check=False, **options)
    return Outcome(done.returncode, done.stdout, done.stderr)


def tree(*folders: Path) -> dict[str, str]:
    """Every folder and file below ``folders``, with the digest of a file's bytes."""
    found = {}
    for folder in folders:
        for path in sorted([folder, *folder.rglob("*")]):
            found[str(path)] = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
    return found


def photograph(side: int = 16) -> np.ndarray:
    """8-bit print with smooth shading, a disc and a bar: no symmetry, no equal rows or columns.

    (256, 256) texels, the middle 240 of them ``side`` x ``side`` even squares: 16 are the projector's pixels, whose
    light is then even, as the solver takes it; more are detail that no image of projector pixels can hold.
    """
    row, column = (np.mgrid[0:side, 0:side] + 0.5) / side
    image = 60 + 90 * row + 40 * np.sin(2.5 * column)
    image[(row - 0.4) ** 2 + (column - 0.35) ** 2 < 0.03] = 225
    image[(column > 0.62) & (column < 0.7) & (row > 0.3)] = 20
    return np.pad(np.kron(np.clip(image, 0, 255), np.ones((240 // side, 240 // side))), 8, mode="edge")


@dataclass(frozen=True)
class Laboratory:
    """A scene, camera and projector files, a finished run of 16 dots and a calibration that fits; never changed."""

    scene: Path
    camera: Path
    projector: Path
    run: Path
    calibration: Path
    captured: Outcome
    calibrated: Outcome
    write_scene: Callable[..., Path]
    photograph: Callable[[int], np.ndarray]

    @property
    def arguments(self) -> tuple[object, ...]:
        """Arguments that name scene, camera, projector and accuracy."""
        return self.scene, *self.electronics

    @property
    def electronics(self) -> tuple[object, ...]:
        """The same without the scene."""
        return "--camera", self.camera, "--projector", self.projector, "--accuracy", ACCURACY

    def copy(self, name: str, to: Path) -> Path:
        """A copy of the ``run`` or the ``calibration`` that a test may damage."""
        shutil.copytree(getattr(self, name), to)
        return to


@pytest.fixture(scope="module", autouse=True)
def _quicker(kept_plans: None, draft_figures: None) -> None:
    """No system test in this process is about planning or how figures look; programs do all by themselves."""


@pytest.fixture(scope="session")
def lab(variant: str, shared_scene: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Laboratory:
    """The laboratory, built through the command line once."""
    folder = tmp_path_factory.mktemp("laboratory")
    camera, projector = folder / "camera.toml", folder / "projector.toml"
    camera.write_text(CAMERA)
    projector.write_text(PROJECTOR)

    def write_scene(name: str, **numbers: object) -> Path:
        return shared_scene(name, **{"reflectance": photograph(), **numbers})

    scene = write_scene("laboratory")
    arguments = scene, "--camera", camera, "--projector", projector, "--accuracy", ACCURACY
    with plans_kept():
        captured = call("capture", *arguments, "-o", folder / "run", "--patterns", "dots:4", "--json")
        calibrated = call("calibrate", *arguments, "-o", folder / "calibration", "--json")
    assert captured.code == 0, captured.err
    assert calibrated.code == 0, calibrated.err
    return Laboratory(
        scene, camera, projector, folder / "run", folder / "calibration", captured, calibrated, write_scene, photograph
    )


@pytest.fixture(name="call", scope="session")
def _call() -> Callable[..., Outcome]:
    return call


@pytest.fixture(name="shell", scope="session")
def _shell() -> Callable[..., Outcome]:
    return shell


@pytest.fixture
def refused(tmp_path: Path, lab: Laboratory) -> Callable[..., str]:
    """Calls mitsim in ``tmp_path``, checks that it refuses in one line and writes nothing; gives that line."""

    def check(*arguments: object) -> str:
        places = tmp_path, lab.run, lab.calibration, lab.scene.parent
        before = tree(*places)
        line = call(*arguments, cwd=tmp_path).refusal
        after = tree(*places)
        assert after == before, {path for path in {*before, *after} if before.get(path) != after.get(path)}
        return line

    return check


@pytest.fixture(scope="session")
def whole(lab: Laboratory, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of many frames that nothing disturbed."""
    run: Path = tmp_path_factory.mktemp("whole") / "run"
    with plans_kept():
        assert call("capture", *lab.arguments, "-o", run, "--patterns", PATTERNS).code == 0
    return run
