"""``--effects``: the user's word against the plan's, through the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mitsim.bench.effects import SWITCHES
from tests.system.refusals import Call


def test_a_plan_as_json(call: Call, lab: Any) -> None:
    options = "--patterns", "dots:4", "--json", "--effects", "+anchors,-diffraction,+ambient"
    effects = call("plan", *lab.arguments, *options).payload["effects"]
    rows = {row["name"]: row for row in effects}
    assert set(SWITCHES) <= set(rows) and len(rows) == len(effects)
    assert rows["diffraction"]["state"] == "off" and "by the user" in rows["diffraction"]["reason"]
    assert rows["anchors"]["state"] == "approximate" and rows["ambient"]["state"] == "exact"


def test_a_capture_without_two_effects(call: Call, lab: Any, tmp_path: Path) -> None:
    options = "--effects", "-diffraction,-interreflection", "--patterns", "uniform"
    call("capture", *lab.arguments, "-o", tmp_path / "run", *options)
    plan = json.loads((tmp_path / "run" / "manifest.json").read_text())["plan"]
    off = {row["name"] for row in plan["effects"] if "switched by the user" in row["reason"]}
    assert off == {"diffraction", "interreflection"} and not off & set(plan["settings"]["effects"])
