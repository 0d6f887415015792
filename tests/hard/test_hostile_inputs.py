"""Hostile inputs of every kind through the command line: a status, a line, bounded seconds and memory, nothing left."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.robustness import Recorder

pytestmark = pytest.mark.robustness("Input")

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_a_hundred_inputs(measured: Recorder, tmp_path: Path) -> None:
    """Of other seeds than those by which faults were found. (Planted: what was never stored read as zeros; the log of
    Pillow on stderr.)"""
    command = [
        sys.executable,
        "benchmarks/hostile.py",
        "--count",
        "110",
        "--seed",
        "5000",
        "--json",
        tmp_path / "a.json",
    ]
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
