"""A plan in a file: what is read is what was written, and nothing else is read."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsim.bench.request import Request
from mitsim.core.environment import deciding_versions
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.job import Cost
from mitsim.light.plan import Plan
from mitsim.light.settings import SharpPixels
from tests.unit.planner.invented_pilot_result import plan as invented_plan

MADE_OF = {
    "version": deciding_versions(),
    "colour": None,
    "variant": "llvm_ad_mono",
    "scene": {"its XML": "a" * 64, "print.png": "b" * 64},
    "parameter": {"albedo": "0.4"},
    "board": None,
    "camera": {"mask_distance": 2.0},
    "projector": {"effective_wavelength_nm": 562.0},
}


def planned() -> Plan:
    """With something in every field, in NumPy's numbers too, as a pilot leaves them."""
    plan = invented_plan(1e-3)
    settings = replace(
        plan.settings,
        samples={"direct": np.float64(12.7), "indirect": 1e-3},
        layers=(430.0, np.float64(380.1)),
        repeats=tuple(np.array([1, 4, 2, 0])),
        reach=0.31,
        sharp=SharpPixels((5, 9), 3, (-0.05, 0.05, -0.1, 0.1), 1e-4),
        occluded=(3, 4),
    )
    return replace(
        plan,
        settings=settings,
        request=Request.of(patterns="dots:3", accuracy=1e-3, seed=2**63, effects="-blur"),
        cost=Cost(3.0, 2.0**30, 1e6),
        made_of=MADE_OF,
    )


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return planned().save(tmp_path / "plan.json")


def test_what_is_read_is_what_was_written(file: Path) -> None:
    """To the last bit, and what was left unsaid of the request stays so. (Planted: samples as `plan --json` has them;
    the request's defaults written; the seed left out.)"""
    found = Plan.load(file)
    assert found == planned() and hash(found.settings) == hash(planned().settings)
    assert found.request is not None and planned().request is not None
    assert found.request.model_fields_set <= {*planned().request.model_fields_set, "seconds"}  # type: ignore[union-attr]
    assert found.payload() == planned().payload()


Edit = Callable[[dict[str, Any]], object]
EDITS: dict[str, tuple[Edit, str]] = {
    "negative samples": (lambda plan: plan["settings"]["samples"].update(direct=-3.0), r"samples.direct: got -3"),
    "no number": (lambda plan: plan["settings"]["samples"].update(direct=math.nan), r"samples.direct: got nan"),
    "without end": (lambda plan: plan.update(systematic_error=math.inf), r"systematic_error: got inf"),
    "unknown effect": (lambda plan: plan["settings"]["effects"].append("wombat"), r"no effect 'wombat'"),
    "half an anchor": (lambda plan: plan["settings"].update(anchors=2.5), r"settings.anchors: got 2.5"),
    "no anchor": (lambda plan: plan["settings"].update(anchors=0), r"settings.anchors: got 0"),
    "too many anchors": (lambda plan: plan["settings"].update(anchors=10**30), r"settings.anchors: got 1000"),
    "text": (lambda plan: plan["settings"].update(depth="400"), r"settings.depth: got '400'"),
    "misspelt": (lambda plan: plan["settings"].update(anchor=3), r"settings.anchor: got 3"),
    "left out": (lambda plan: plan["settings"].pop("depth"), r"settings.depth: is missing"),
    "no settings": (lambda plan: plan.pop("settings"), r"plan.settings: is missing"),
    "another state": (lambda plan: plan["effects"][0].update(state="maybe"), r"effects.0.state: got 'maybe'"),
    "patterns": (lambda plan: plan["request"].update(patterns="dots:x"), r"plan.request: patterns 'dots:x'"),
    "a letter alone": (lambda plan: plan["effects"][0].update(reason="\ud800"), r"invalid JSON"),
    "a number": (lambda plan: plan["settings"].update(anchors=2), r"was changed since mitsim wrote it; plan anew"),
    "a word": (lambda plan: plan["effects"][0].update(reason="it is so"), r"was changed since mitsim wrote it"),
    "a version": (lambda plan: plan["made_of"]["version"].update(mitsim="0.1.0"), r"made by mitsim 0.1.0, and this is"),
    "no version": (lambda plan: plan.pop("made_of"), r"made by mitsim None, and this is"),
}


@pytest.mark.parametrize("name", EDITS)
def test_an_edited_file_is_refused_in_a_line(file: Path, name: str) -> None:
    """With the field where it breaks a rule, else by its checksum. (Planted: no checksum; no end of a count.)"""
    edit, sentence = EDITS[name]
    data = json.loads(file.read_text())
    edit(data["plan"])
    file.write_text(json.dumps(data))
    refused(file, sentence)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "not valid JSON"),
        ("[]", "is no file of a plan; give one that `mitsim plan -o` wrote"),
        ('{"kind": "capture"}', "is no file of a plan"),
        ('{"kind": "plan"}', "was made by mitsim None"),
        ('{"kind": "plan", "kind": "plan"}', "is there twice"),
        ("[" * 100_000, "nested too deep"),
    ],
)
def test_a_file_that_is_none_is_refused_in_a_line(file: Path, text: str, sentence: str) -> None:
    file.write_text(text)
    refused(file, sentence)


def test_a_file_that_was_cut_or_is_huge_is_refused_in_a_line(file: Path, tmp_path: Path) -> None:
    file.write_bytes(file.read_bytes()[:-200])
    refused(file, "not valid JSON")
    with file.open("wb") as huge:
        huge.truncate(200 << 20)
    refused(file, "has 209715200 bytes; at most")
    refused(tmp_path, "Is a directory")
    refused(tmp_path / "none.json", "No such file")


def refused(file: Path, sentence: str) -> None:
    with pytest.raises(MitsimError, match=sentence) as refusal:
        Plan.load(file)
    assert len(str(refusal.value).splitlines()) == 1 and file.name in str(refusal.value)


def test_a_file_is_written_whole_or_not_at_all(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = file.read_bytes()
    with pytest.raises(MitsimError, match="decided without a request"):
        invented_plan(1e-3).save(file)
    monkeypatch.setattr("mitsim.light.plan.MOST_BYTES", 100)
    with pytest.raises(MitsimError, match="and at most 100 are read"):
        planned().save(file)
    with pytest.raises(MitsimError, match="cannot be written"):
        monkeypatch.undo()
        planned().save(tmp_path / "none" / "plan.json")
    assert file.read_bytes() == before and [*tmp_path.iterdir()] == [file]


# ---- beside a request, and another bench


def test_what_is_said_again_is_taken_and_what_needs_another_plan_is_not() -> None:
    plan = planned()
    again = plan.request_with({"accuracy": 1e-3, "effects": {"blur": False}, "seed": 5, "exposure": 0.1})
    assert (again.seed, again.exposure, again.patterns, again.accuracy) == (5, 0.1, "dots:3", 1e-3)
    for changes, sentence in (
        ({"accuracy": 1e-2}, "accuracy 0.01: the plan was made for 0.001; plan anew"),
        ({"effects": {}}, "effects none: the plan was made for -blur; plan anew"),
        ({"effects": {"blur": True}}, r"effects \+blur: the plan was made for -blur"),
    ):
        with pytest.raises(ArgumentError, match=sentence):
            plan.request_with(changes)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"version": {**deciding_versions(), "drjit": "0.1"}}, r"another version: drjit \S+ there, 0.1 here"),
        ({"colour": {"filters": False, "wavelengths_nm": [440.0]}}, "another colour: none there, {"),
        ({"variant": "llvm_ad_rgb"}, "another variant: llvm_ad_mono there, llvm_ad_rgb here"),
        ({"scene": {**MADE_OF["scene"], "its XML": "c" * 64}}, "another scene: the content of its XML differs"),  # type: ignore[dict-item]
        ({"scene": {"its XML": "a" * 64}}, "another scene: the content of print.png differs"),
        ({"parameter": {}}, "another parameter: albedo 0.4 there, none here"),
        ({"board": {"reflectance": 0.9}}, "another board: none there, {"),
        ({"camera": {"mask_distance": 1.5}}, "another camera: mask_distance 2.0 there, 1.5 here"),
        ({"projector": {}}, "another projector: effective_wavelength_nm 562.0 there, none here"),
    ],
)
def test_a_plan_of_another_bench_is_refused_by_what_differs(changes: dict[str, Any], sentence: str) -> None:
    plan = planned()
    plan.check_made_of(MADE_OF)
    with pytest.raises(ArgumentError, match=f"^plan was made of {sentence}"):
        plan.check_made_of({**MADE_OF, **changes})
    with pytest.raises(ArgumentError, match="decided without a bench"):
        replace(plan, made_of=None).check_made_of(MADE_OF)
