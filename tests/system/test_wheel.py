"""The wheel carries what a user without the source tree needs; `make wheel` builds it.

A clean environment takes the network and minutes, so the wheel is put before the environment of the tests instead.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import mitsim

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (path,) = folder.glob(f"mitsim-{mitsim.__version__}-*.whl")
    return path


def test_the_wheel_holds_the_package_and_all_shipped_data(wheel: Path) -> None:
    """Every module, template and type marker; of scenes, calibration and sessions everything but the code
    that drew them, and no test of that name."""
    expected = {str(path.relative_to(ROOT)) for path in (ROOT / "mitsim").rglob("*") if path.is_file()}
    for folder in ("scenes", "calibration", "sessions"):
        files = [path for path in (ROOT / folder).rglob("*") if path.is_file() and path.suffix != ".py"]
        expected |= {f"mitsim/_shipped/{path.relative_to(ROOT)}" for path in files}
    held = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert held == {name for name in expected if "__pycache__" not in name}


def test_the_wheel_says_who_may_use_it_and_what_it_needs(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        text = archive.read(metadata).decode()
        assert any(name.endswith("/licenses/LICENSE") for name in archive.namelist())
    assert "License-Expression: BSD-3-Clause" in text and "Requires-Dist: mitsuba<3.10,>=3.9" in text
    assert "Requires-Dist: colour-science!=0.4.7,>=0.4.6\n" in text


def test_demo_from_the_wheel_in_an_empty_folder(wheel: Path, tmp_path: Path) -> None:
    site, empty = tmp_path / "site", tmp_path / "empty"
    empty.mkdir()
    zipfile.ZipFile(wheel).extractall(site)
    environment = {**os.environ, "PYTHONPATH": str(site)}
    program = "from mitsim.core.configuration import shipped_path; print(shipped_path('scenes'))"
    place = subprocess.run(
        [sys.executable, "-c", program], cwd=empty, env=environment, capture_output=True, text=True, check=True
    )
    assert place.stdout.strip() == str(site / "mitsim" / "_shipped" / "scenes")
    command = [sys.executable, "-m", "mitsim", "demo", "--accuracy", "0.02", "--json"]
    done = subprocess.run(command, cwd=empty, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["gain_db"] > 8
    assert (empty / "demo-output" / "report.html").is_file()
