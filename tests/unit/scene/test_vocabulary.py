"""Every plugin that the guard lets a scene have: it renders by both estimators, or a line says why not."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from mitsim.scene.check import check_file
from tests.vocabulary import cases, outcome, scene

ALL = ("reference", "factored", "capture")
VARIANTS = ("llvm_ad_mono", "llvm_ad_rgb", "llvm_ad_spectral")
SPECTRAL = ("blackbody", "irregular", "regular", "specfilm")


def refused(tag: str, plugin: str, variant: str) -> Mapping[str, str]:
    """What is to be refused, and a part of the line."""
    if plugin in SPECTRAL and variant != "llvm_ad_spectral":
        return dict.fromkeys(ALL, f"{variant} lacks it")
    if plugin == "hair" and variant == "llvm_ad_mono":
        return dict.fromkeys(ALL, "give sigma_a")
    if tag == "rfilter" and plugin != "box":
        return dict.fromkeys(ALL, "use <rfilter type='box'/>")
    if tag in ("medium", "phase", "volume"):
        return dict.fromkeys(ALL[1:], "only the reference estimator follows light through media")
    if plugin == "mitsim_glass" and variant == "llvm_ad_spectral":
        return {"reference": "use a mono variant", **dict.fromkeys(ALL[1:], "trace the projector's lines")}
    return {"reference": "starts paths at lamps"} if plugin == "ptracer" else {}


def as_it_should(tag: str, plugin: str, variant: str, found: Mapping[str, str]) -> bool:
    expected = refused(tag, plugin, variant)
    return found.keys() == expected.keys() and all(part in found[verb] for verb, part in expected.items())


@pytest.mark.parametrize("name", VARIANTS)
def test_what_a_variant_lacks_is_refused_where_it_stands(tmp_path: Path, name: str) -> None:
    """Before objects are made. (Seen failing: a traceback when light first met such a texture, or hair in mono.)"""
    for tag, plugin in (("bsdf", "hair"), *(case for case in cases() if case[1] in SPECTRAL)):
        path, line = scene(tmp_path, tag, plugin), ""
        try:
            check_file(path, {}, variant=name)
        except Exception as error:
            line = str(error)
        expected = refused(tag, plugin, name)
        assert bool(line) == bool(expected), line
        if expected:
            assert expected["capture"] in line and f"type: got {plugin!r} in <{tag}" in line and f"{path}:" in line


@pytest.mark.parametrize(("tag", "plugin"), [("bsdf", "hair"), ("integrator", "ptracer"), ("rfilter", "box")])
def test_a_few_plugins_in_mono(tmp_path: Path, variant: str, tag: str, plugin: str) -> None:
    assert as_it_should(tag, plugin, variant, found := outcome(scene(tmp_path, tag, plugin), variant)), found


@pytest.mark.slow
@pytest.mark.parametrize("name", VARIANTS)
def test_every_plugin_in_every_variant(tmp_path: Path, name: str) -> None:
    """(Seen failing: seven plugins ended in a traceback in mono, six in RGB, three in spectral.)"""
    command = [sys.executable, "-m", "tests.vocabulary", name, tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    assert {tuple(case.split()) for case in found} == {*cases()}
    wrong = {case: lines for case, lines in found.items() if not as_it_should(*case.split(), name, lines)}
    assert not wrong
