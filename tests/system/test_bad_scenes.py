"""Scenes that cannot be used (issue 2, item 10): exit 2, one line that names place and value, and nothing written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.system.refusals import NEW, Refused, mentions


@pytest.mark.parametrize(
    "verb",
    [
        ("view", "-o", "new.png"),
        ("plan",),
        ("capture", *NEW, "--patterns", "dots:4"),
        ("calibrate", *NEW),
        ("render", "-o", "new.exr"),
        ("render", "-o", "new.exr", "--estimator", "factored"),
        ("study", "accuracy", *NEW),
        ("demo", *NEW),
    ],
    ids=lambda verb: verb[0],
)
def test_every_verb_refuses_a_scene_it_cannot_load(refused: Refused, tmp_path: Path, verb: tuple[str, ...]) -> None:
    mentions(refused(*verb, "nowhere.xml"), "nowhere.xml", "no such scene file")
    mentions(refused(*verb, "nowhere"), "nowhere", "shipped", "photograph", "resolution_target")
    (tmp_path / "broken.xml").write_text('<scene version="3.0.0">\n<bsdf>\n</scene>')
    mentions(refused(*verb, "broken.xml"), "broken.xml:3", "not well-formed")


def test_a_folder_without_scene(refused: Refused, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    mentions(refused("plan", "empty"), "empty/scene.xml")


@pytest.mark.parametrize(
    ("old", "new", "fragments"),
    [
        ('"mask_distance" value="2"', '"mask_distanse" value="2"', ["mask_distanse"]),
        ('"mask_distance" value="2"', '"mask_distance" value="nan"', ["mask_distance", "nan"]),
        ('"mask_distance" value="2"', '"mask_distance" value="-2"', ["mask_distance", "-2"]),
        ('"max_depth" value="2"', '"max_depht" value="2"', ["max_depht"]),
        ('"pixel_pitch" value="0.01172"', '"pixel_pitch" value="0.012"', ["pitch", "11.72", "12 um"]),
        ("_projector.png", "_nothing.png", ["_nothing.png"]),
        ('type="projector"', 'type="projektor"', ["projektor"]),
    ],
)
def test_a_scene_with_a_bad_parameter(
    refused: Refused, small_scene: Callable[..., Path], old: str, new: str, fragments: list[str]
) -> None:
    path = small_scene()
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    mentions(refused("capture", path, *NEW, "--patterns", "dots:4"), *fragments)


@pytest.mark.parametrize(
    ("old", "new", "fragments"),
    [
        ('"fov" value="33.398488"', '"fov" value="nan"', ["fov: got nan", "finite"]),
        ('<translate x="60"/>', '<translate x="inf"/>', ["to_world: got nan", "finite"]),
        ('<scale x="64" y="64"/>', '<scale x="nan" y="64"/>', ["to_world: got nan"]),
        ('value="1 0 0 0 0 1', 'value="1 0 0 nan 0 1', ["to_world: got nan", "got nan"]),
        ('"scale" value="111000"', '"scale" value="-1"', ["scale: got -1", "at least 0"]),
        ('value="$albedo"', 'value="nan"', ["reflectance: got nan"]),
        ('value="$albedo"', 'value="400:0.5, 700:-0.5"', ["reflectance: got -0.5", "at least 0"]),
        ('value="$albedo"', 'value="1.5"', ["reflectance: got 1.5", "more than 1"]),
        ("</scene>", '<path value="/tmp"/></scene>', ["<path value='/tmp'>", "native code"]),
        ("</scene>", '<include filename="small.xml"/></scene>', ["<include filename='small.xml'>", "itself"]),
        ("</scene>", '<include filename="nowhere.xml"/></scene>', ["<include filename='nowhere.xml'>", "no such file"]),
    ],
)
def test_a_scene_that_mitsuba_would_take_without_a_word(
    refused: Refused, small_scene: Callable[..., Path], old: str, new: str, fragments: list[str]
) -> None:
    path = small_scene()
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    for verb in (("capture", "--patterns", "uniform", *NEW), ("render", "-o", "new.exr")):
        mentions(refused(*verb, path), str(path), *fragments)


@pytest.mark.parametrize("value", ["nan", "-1", "2", "inf"])
def test_a_define_that_no_material_can_have(refused: Refused, small_scene: Callable[..., Path], value: str) -> None:
    line = refused("capture", small_scene(), *NEW, "--patterns", "uniform", "-D", f"albedo={value}")
    mentions(line, "reflectance: got", value, "$albedo")


def test_included_files_are_looked_at_too(
    refused: Refused, call: Callable[..., Any], small_scene: Callable[..., Path]
) -> None:
    path = small_scene()
    path.write_text(path.read_text().replace("</scene>", '<include filename="part.xml"/></scene>'))
    part = path.parent / "part.xml"
    shape = '<scene version="3.0.0"><shape type="sphere">{}</shape></scene>'
    behind = '<point name="center" value="0, 0, -9"/><float name="radius" value="{}"/>'
    part.write_text(shape.format(behind.format(1)))
    assert call("render", path, "--spp", 4, "-o", path.parent / "frame.exr").code == 0
    part.write_text(shape.format(behind.format("inf")))
    mentions(refused("plan", path), "part.xml", "radius: got inf")


def test_native_code_beside_a_scene(refused: Refused, small_scene: Callable[..., Path]) -> None:
    path = small_scene()
    (path.parent / "plugins").mkdir()
    (path.parent / "plugins" / "mine.so").write_bytes(b"\x7fELF")
    mentions(refused("plan", path), str(path), "plugins/mine.so", "native code")


def test_a_scene_without_projector(refused: Refused, small_scene: Callable[..., Path]) -> None:
    path = small_scene()
    text = path.read_text()
    end = text.index("</emitter>") + len("</emitter>")
    path.write_text(text[: text.index("<emitter")] + '<emitter type="constant"/>' + text[end:])
    mentions(
        refused("capture", path, *NEW, "--patterns", "dots:4"),
        str(path),
        "needs one emitter of type projector, the file has none",
    )


@pytest.mark.usefixtures("soon_dark")
def test_a_scene_that_sends_no_light_back(refused: Refused, small_scene: Callable[..., Path]) -> None:
    path = small_scene()
    render = "render", "--estimator", "factored", "-o", "new.exr"
    for verb in (("capture", "--patterns", "dots:4", *NEW), ("plan",), render):
        mentions(refused(*verb, path, "-D", "albedo=0"), "no light")


@pytest.mark.parametrize(
    ("define", "fragments"),
    [
        ("albdo=0.5", ["albdo", "albedo"]),
        ("albedo", ["'albedo'", "NAME=VALUE"]),
        ("=3", ["'=3'", "NAME=VALUE"]),
        ("albedo=half", ["half"]),
    ],
)
def test_a_bad_define(refused: Refused, small_scene: Callable[..., Path], define: str, fragments: list[str]) -> None:
    path = small_scene()
    for verb in (("plan",), ("capture", *NEW, "--patterns", "dots:4"), ("render", "-o", "new.exr")):
        mentions(refused(*verb, path, "-D", define), *fragments)
