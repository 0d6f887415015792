"""A scene of which the sensor sees nothing: the sentence says where scene and projected window lie."""

from collections.abc import Callable
from pathlib import Path

import pytest

from mitsim.scene.load import load_scene, why_dark

pytestmark = pytest.mark.usefixtures("variant")
Write = Callable[..., Path]
SHEET = '<scale x="64" y="64"/> <translate z="400"/>'


@pytest.mark.parametrize(
    ("place", "words"),
    [
        (SHEET, "x = -64 to 64, y = -64 to 64, z = 400 to 400 mm of the camera"),
        ('<scale x="0.064" y="0.064"/> <translate z="0.4"/>', "z = 0.4 to 0.4 mm of the camera"),
        ('<scale x="64" y="64"/> <translate x="900" z="-400"/>', "x = 836 to 964, y = -64 to 64, z = -400 to -400"),
    ],
)
def test_the_places_of_scene_and_window_are_named(small_scene: Write, place: str, words: str) -> None:
    path = small_scene()
    text = path.read_text()
    assert SHEET in text
    path.write_text(text.replace(SHEET, place))
    found = why_dark(load_scene(path))
    assert words in found and "the projector lights x = -60 to 60, y = -60 to 60 mm at z = 400 mm" in found


def test_a_scene_of_no_surfaces(small_scene: Write) -> None:
    path = small_scene()
    text = path.read_text()
    path.write_text(text.replace(text[text.index("<shape") : text.index("</shape>") + 8], ""))
    assert "no surfaces" in why_dark(load_scene(path))
