"""The line that a report shows for a scene."""

from pathlib import Path

import pytest

from mitsim.core.configuration import shipped
from mitsim.study.describe import scene_line


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("<!-- A sheet at 0.90 m, e.g. white. Second\nsentence. --><scene/>", "room: A sheet at 0.90 m, e.g. white."),
        ('<?xml version="1.0"?>\n<scene version="3.0.0">\n<!-- Two\n  lines -->', "room: Two lines"),
        ('<scene><default name="a" value="1"/><!-- mm, how far --></scene>', "room"),
        ("<scene><!-- --></scene>", "room"),
        ("<scene/>", "room"),
    ],
)
def test_first_sentence_of_the_opening_comment(tmp_path: Path, text: str, line: str) -> None:
    path = tmp_path / "room" / "scene.xml"
    path.parent.mkdir()
    path.write_text(text, encoding="utf-8")
    assert scene_line(path) == line


@pytest.mark.parametrize("path", sorted(shipped("scenes").glob("*/scene.xml")), ids=lambda path: path.parent.name)
def test_every_shipped_scene_says_what_it_is(path: Path) -> None:
    line = scene_line(path)
    assert line.startswith(f"{path.parent.name}: ") and len(line) > 40
