"""Which scenes are in greys is told from their files: what may differ by wavelength, and nothing else."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.exr import MAGIC
from mitsim.scene.check import check_file
from mitsim.scene.headers import check_image
from tests.conftest import write_png

pytestmark = pytest.mark.usefixtures("variant")
SPHERE = '<shape type="sphere"><bsdf type="{type}">{inside}</bsdf></shape>'
PICTURE = '<texture name="reflectance" type="bitmap"><string name="filename" value="{name}.png"/></texture>'


def diffuse(inside: str) -> str:
    return SPHERE.format(type="diffuse", inside=inside)


@pytest.mark.parametrize(
    ("extra", "coloured"),
    [
        ("", False),
        (diffuse('<spectrum name="reflectance" value="0.3"/>'), False),
        (diffuse('<spectrum name="reflectance" value="400:0.3, 700:0.3"/>'), False),
        (diffuse('<spectrum name="reflectance" value="400:0.3, 700:0.4"/>'), True),
        (diffuse('<rgb name="reflectance" value="0.3"/>'), False),
        (diffuse('<rgb name="reflectance" value="0.3, 0.3, 0.2"/>'), True),
        (
            diffuse(
                '<spectrum name="reflectance" type="irregular"><string name="wavelengths" value="400,500"/>'
                '<string name="values" value="0.2,0.3"/></spectrum>'
            ),
            True,
        ),
        (diffuse(PICTURE.format(name="grey")), False),
        (diffuse(PICTURE.format(name="red")), True),
        (SPHERE.format(type="conductor", inside=""), True),
        (SPHERE.format(type="conductor", inside='<string name="material" value="Au"/>'), True),
        (SPHERE.format(type="conductor", inside='<string name="material" value="none"/>'), False),
        (
            SPHERE.format(
                type="roughconductor", inside='<spectrum name="eta" value="3"/><spectrum name="k" value="4"/>'
            ),
            False,
        ),
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
