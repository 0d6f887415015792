"""Seeded mutations of good files, and hostile inputs of every kind through the command line.

Each is taken or refused in one line, within 5 s; nothing else is raised, no crash. Frames, and scenes that Mitsuba
loads, are tried in a process of their own, for C++ may abort without an exception.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from mitsim.scene.check import check_file
from tests.hard.fuzz import RICH, Fuzz, run
from tests.robustness import Recorder

pytestmark = pytest.mark.robustness("Input")

ROOT = Path(__file__).parents[2]


def apart(kind: str, first: int, count: int, seconds: float) -> tuple[int, int]:
    """Taken and refused by a child process; fails with the seed at which the child stopped."""
    command = [sys.executable, "-m", "tests.hard.fuzz", kind, str(first), str(count), str(seconds)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=20 * seconds)
    *seeds, last = done.stdout.splitlines() or [""]
    assert done.returncode == 0, (
        f"{kind} stopped with {done.returncode} after {last or seeds[-1:]}:\n{done.stderr[-2000:]}"
    )
    found = re.fullmatch(rf"{kind}: (\d+) taken, (\d+) refused", last)
    assert found, last
    sys.stdout.write(last + "\n")
    return int(found[1]), int(found[2])


def test_the_scene_that_is_changed_is_good(tmp_path: Path) -> None:
    """With every kind of object, so that few changes reach far."""
    fuzz = Fuzz(tmp_path)
    fuzz.scene.write_text(RICH)
    assert len(check_file(fuzz.scene, {}).files) == 5


@pytest.mark.parametrize("kind", ["xml", "json"])
def test_a_hundred_and_fifty_changes(tmp_path: Path, kind: str) -> None:
    """Some are harmless and are taken, or nothing would be shown of the others."""
    taken, refused = run(getattr(Fuzz(tmp_path), kind), 0, 150, 60, lambda seed: None)
    assert taken >= 3 and refused >= 100 and taken + refused == 150


def test_a_hundred_and_fifty_frames() -> None:
    taken, refused = apart("exr", 0, 150, 60)
    assert taken >= 3 and refused >= 100 and taken + refused == 150


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seconds"), [("xml", 20), ("json", 10), ("exr", 15), ("load", 40), ("mesh", 15), ("image", 15)]
)
def test_many_changes(measured: Recorder, kind: str, seconds: float) -> None:
    """As many of 20000 as the time allows; ``load``, ``mesh`` and ``image`` go through Mitsuba's own readers."""
    taken, refused = apart(kind, 1000, 20_000, seconds)
    measured(taken + refused, at_least=100, what="inputs")
    assert taken >= 3


# ---- Through the command line ----


@pytest.mark.slow
def test_a_hundred_inputs(measured: Recorder, tmp_path: Path) -> None:
    """Of other seeds than those by which faults were found. (Planted: what was never stored read as zeros; the log of
    Pillow on stderr.)"""
    options = ["--count", "110", "--seed", "5000", "--json", tmp_path / "a.json"]
    command = [sys.executable, "benchmarks/hostile.py", *options]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    reported = json.loads((tmp_path / "a.json").read_text())
    measured(reported["inputs"], at_least=100, what="inputs")
    assert {"0", "2"} <= {status for row in reported["kinds"] for status in row["status"]}, "some are good"


def test_one_function_of_the_bench_loads_a_scene() -> None:
    """By the name that benchmarks/hostile.py has for it: what passes all checks is refused in its place."""
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "mitsim" / "bench").rglob("*.py")]
    assert sum("\ndef _load(" in text for text in texts) == 1
    assert 'opening["_load"] = unloaded' in (ROOT / "benchmarks" / "hostile.py").read_text(encoding="utf-8")
