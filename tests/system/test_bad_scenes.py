"""Scenes that cannot be used (issue 2, item 10): exit 2, one line that names place and value, and nothing written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

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
