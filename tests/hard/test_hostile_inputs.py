"""Hostile inputs of every kind through the command line: a status, a line, bounded seconds and memory, nothing left."""

from __future__ import annotations

import ast
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
    told = json.loads((tmp_path / "a.json").read_text())
    measured(told["inputs"], at_least=100, what="inputs")
    assert {"0", "2"} <= {status for row in told["kinds"] for status in row["status"]}, "some are good"


def test_what_the_inputs_take_for_granted_is_there() -> None:
    """Modules that are imported beforehand, and what loads a scene, by the names that benchmarks/hostile.py has."""
    source = (ROOT / "benchmarks" / "hostile.py").read_text(encoding="utf-8")
    beforehand = [
        each.value
        for node in ast.parse(source).body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "BEFOREHAND"
        for each in ast.walk(node)
        if isinstance(each, ast.Constant)
    ]
    assert beforehand
    for name in beforehand:
        assert (ROOT / "mitsim" / f"{name.replace('.', '/')}.py").is_file(), name
    assert 'opening["_load"] = unloaded' in source
    assert "\ndef _load(" in (ROOT / "mitsim/bench/open.py").read_text(encoding="utf-8")
