"""Which scenes are in greys is told from their files: what may differ by wavelength, and nothing else."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.exr import MAGIC
from mitsim.scene.check import check_file
from mitsim.scene.headers import check_image
from tests.conftest import write_png
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
    if plugin == "measured" and variant == "llvm_ad_rgb":
        return dict.fromkeys(ALL, "table.bsdf has spectra, which llvm_ad_rgb cannot use")
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


# -------- colours of scenes

pytestmark = pytest.mark.usefixtures("variant")
SPHERE = '<shape type="sphere"><bsdf type="{type}">{inside}</bsdf></shape>'
PICTURE = '<texture name="reflectance" type="bitmap"><string name="filename" value="{name}.png"/></texture>'

SPECTRA = ("0.3", False), ("400:0.3, 700:0.3", False), ("400:0.3, 700:0.4", True)
INDEX = '<spectrum name="eta" value="3"/><spectrum name="k" value="4"/>'
IRREGULAR = '<spectrum name="reflectance" type="irregular"><string name="wavelengths" value="400,500"/>'
IRREGULAR += '<string name="values" value="0.2,0.3"/></spectrum>'


def diffuse(inside: str) -> str:
    return SPHERE.format(type="diffuse", inside=inside)


@pytest.mark.parametrize(
    ("extra", "coloured"),
    [
        ("", False),
        *((diffuse(f'<spectrum name="reflectance" value="{value}"/>'), coloured) for value, coloured in SPECTRA),
        *((diffuse('<rgb name="reflectance" value="0.3"/>'), False), (diffuse(PICTURE.format(name="grey")), False)),
        *((diffuse('<rgb name="reflectance" value="0.3, 0.3, 0.2"/>'), True), (diffuse(IRREGULAR), True)),
        *((diffuse(PICTURE.format(name="red")), True), (SPHERE.format(type="conductor", inside=""), True)),
        (SPHERE.format(type="conductor", inside='<string name="material" value="Au"/>'), True),
        (SPHERE.format(type="conductor", inside='<string name="material" value="none"/>'), False),
        (SPHERE.format(type="roughconductor", inside=INDEX), False),
        ('<emitter type="constant"><rgb name="radiance" value="1, 2, 3"/></emitter>', True),
    ],
)
def test_what_may_differ_by_wavelength_is_told(small_scene: Callable[..., Path], extra: str, coloured: bool) -> None:
    """(Planted one by one: numbers not compared, pictures not opened, copper taken for grey.)"""
    path = small_scene(extra=extra)
    write_png(path.with_name("grey.png"), np.full((2, 2), 90))
    write_png(path.with_name("red.png"), np.full((2, 2, 3), (90, 10, 10)))
    found = check_file(path, {}).coloured
    assert bool(found) == coloured
    assert all(tag.path == path and tag.line > 1 for tag in found)


def test_pictures_of_numbers_are_told_by_their_channels(tmp_path: Path) -> None:
    import mitsuba as mi

    for name, channels, grey in (("one.exr", 1, True), ("three.exr", 3, False), ("one.pfm", 1, True)):
        path = tmp_path / name
        mi.Bitmap(np.ones((2, 2, channels), dtype=np.float32)).write(str(path))
        assert check_image(path) == (4, grey)
    assert (tmp_path / "one.exr").read_bytes().startswith(MAGIC)
