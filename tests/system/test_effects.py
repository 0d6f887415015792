"""``--effects`` and ``--noise-fraction``: the user's word against the plan's, through the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mitsim.bench.effects import SWITCHES

ROW = {"name", "state", "reason", "error_if_off", "seconds"}


@pytest.mark.parametrize(
    "verb",
    [
        ("plan",),
        ("capture", "-o", "new", "--patterns", "dots:4"),
        ("render", "-o", "new.exr", "--estimator", "factored"),
    ],
    ids=lambda verb: verb[0],
)
@pytest.mark.parametrize("effects", ["fog", "+fog", "ambient", "+ambient,-ambient"])
def test_effects_that_make_no_sense(refused: Callable[..., str], lab: Any, verb: tuple[str, ...], effects: str) -> None:
    line = refused(*verb, lab.scene, "--effects", effects)
    assert "--effects" in line and effects in line
    assert ("both on and off" in line) == ("-ambient" in effects)
    if "both" not in line:
        assert all(name in line for name in SWITCHES)


@pytest.mark.parametrize("fraction", ["2", "0", "-1", "1e-300", "nan", "much"])
def test_noise_fractions_that_make_no_sense(refused: Callable[..., str], lab: Any, fraction: str) -> None:
    line = refused("capture", *lab.arguments, "-o", "new", "--patterns", "dots:4", "--noise-fraction", fraction)
    assert "--noise-fraction" in line and fraction in line


def test_a_plan_as_json(call: Callable[..., Any], lab: Any) -> None:
    free, forced = (
        call("plan", *lab.arguments, "--patterns", "dots:4", "--json", *more).payload
        for more in ((), ("--effects", "+anchors,-diffraction,+ambient"))
    )
    for block in (free, forced):
        assert {"effects", "accuracy", "predicted_seconds"} <= set(block)
        rows = {row["name"]: row for row in block["effects"]}
        assert set(SWITCHES) <= set(rows) and len(rows) == len(block["effects"])
        assert all(set(row) >= ROW and row["seconds"] >= 0 for row in rows.values())
        assert block["accuracy"] == 0.005 and block["predicted_seconds"] > 0
    rows = {row["name"]: row for row in forced["effects"]}
    assert rows["diffraction"]["state"] == "off" and "by the user" in rows["diffraction"]["reason"]
    assert rows["anchors"]["state"] == "approximate" and rows["ambient"]["state"] == "exact"


def test_a_capture_with_both(call: Callable[..., Any], lab: Any, tmp_path: Path) -> None:
    """A sampling error of a fiftieth of the sensor's noise, where the accuracy alone leaves 0.04 (seed 0)."""
    options = "--effects", "-diffraction,-interreflection", "--patterns", "uniform", "--json"
    free, done = (
        call("capture", *lab.arguments, "-o", tmp_path / name, *options, *more).payload
        for name, more in (("free", ()), ("run", ("--noise-fraction", "0.02")))
    )
    assert free["mc_error"] > 0.03 * done["sensor_noise"] and 0 < done["mc_error"] < 0.02 * done["sensor_noise"]
    plan = json.loads((tmp_path / "run" / "manifest.json").read_text())["plan"]
    off = {row["name"] for row in plan["effects"] if "switched by the user" in row["reason"]}
    assert off == {"diffraction", "interreflection"} and not off & set(plan["settings"]["effects"])
