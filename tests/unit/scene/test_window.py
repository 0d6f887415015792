"""How many pixels a side a projector's picture lights, told without the renderer."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsim.bench.apparatus import check_scene
from mitsim.core.errors import MitsimError
from mitsim.scene.outline import lit_side


def picture(path: Path, mode: str, size: tuple[int, int] = (6, 6), value: int = 1) -> Path:
    """Texels of a ``value``, ``size`` rows and columns of them from row 3 and column 5 on, else dark."""
    texels = np.zeros((16, 16), dtype=np.uint8)
    texels[3 : 3 + size[0], 5 : 5 + size[1]] = value
    image = Image.fromarray(texels)
    if mode == "RGB":  # blue alone is lit
        image = Image.merge("RGB", (Image.new("L", (16, 16)), Image.new("L", (16, 16)), image))
    elif mode != "L":
        image = image.convert(mode)
    image.save(path)
    return path


@pytest.mark.parametrize("mode", ["L", "RGB", "1"])
def test_the_lit_square_is_the_window(tmp_path: Path, mode: str) -> None:
    """(Planted: the picture's width; a box that ends one texel early.)"""
    assert lit_side(picture(tmp_path / "x.png", mode, value=255)) == 6


def test_what_only_the_renderer_tells_is_left_to_it(tmp_path: Path) -> None:
    """A window that is no square, alpha, a dark picture, one that is no PNG, and none at all. (Planted: a box of alpha,
    which is 255 everywhere.)"""
    assert lit_side(picture(tmp_path / "x.png", "L", (6, 5))) is None
    assert lit_side(picture(tmp_path / "x.png", "RGBA")) is None
    assert lit_side(picture(tmp_path / "x.png", "L", value=0)) is None
    (tmp_path / "x.png").write_bytes((tmp_path / "x.png").read_bytes()[:60])
    assert lit_side(tmp_path / "x.png") is None
    (tmp_path / "x.png").write_text("no picture")
    assert lit_side(tmp_path / "x.png") is None
    assert lit_side(tmp_path / "none.png") is None


def test_patterns_of_more_periods_than_pixels_are_refused(tmp_path: Path) -> None:
    """Of the picture inside the projector, and no other. (Planted: the last picture of the scene.)"""
    picture(tmp_path / "shown.png", "L")
    picture(tmp_path / "print.png", "L", (9, 9))
    texture = '<texture name="{}" type="bitmap"><string name="filename" value="{}"/></texture>'
    scene = tmp_path / "scene.xml"
    scene.write_text(
        f'<scene version="3.0.0"><default name="shown" value="shown.png"/>'
        f'<emitter type="projector">{texture.format("irradiance", "$shown")}</emitter>'
        f'<shape type="rectangle"><bsdf type="diffuse">{texture.format("reflectance", "print.png")}</bsdf></shape>'
        "</scene>"
    )
    check_scene(scene, {}, patterns=["dots:6", "dots:3x6", "uniform"])
    for name in ("dots:7", "dots:1x7", "random:7"):
        with pytest.raises(MitsimError, match="K is 7; give 1 to 6, the projector's pixels a side"):
            check_scene(scene, {}, patterns=["uniform", name])
    check_scene(scene, {"shown": "print.png"}, patterns=["dots:7"])
    (tmp_path / "none.png").write_text("no picture")
    check_scene(scene, {"shown": "none.png"}, patterns=["dots:7"])
