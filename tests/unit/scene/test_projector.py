"""The projector's window and where it lands, against a pinhole projector written out by hand."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsim.bench.apparatus import check_scene
from mitsim.core.errors import MitsimError
from mitsim.scene.load import ProjectorGrid, load_scene
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
    place = tmp_path / "x.png"
    for mode, size, value in (("L", (6, 5), 1), ("RGBA", (6, 6), 1), ("L", (6, 6), 0)):
        assert lit_side(picture(place, mode, size, value)) is None
    for content in (place.read_bytes()[:60], b"no picture"):
        place.write_bytes(content)
        assert lit_side(place) is None
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


# -------- projector

pytestmark = pytest.mark.usefixtures("variant")
N, Z = 16, 400.0
# uv comes back from Mitsuba in float32: 6e-8 of a canvas that spans 0.6 in tan-angle, a few roundings.
FLOAT32 = 5e-7


def by_hand(axis: str, degrees: float) -> np.ndarray:
    """(2, 2, 2) tan-angles (row, column) of the window's corners for a projector turned about its own axis."""
    angle = np.radians(degrees)
    c, s = np.cos(angle), np.sin(angle)
    turn = {"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]]}[axis]
    reach = np.tan(np.radians(33.398488) / 2)
    corners = np.empty((2, 2, 2))
    for i, v in enumerate((0.0, 1.0)):
        for j, u in enumerate((0.5, 1.0)):  # the window is the right half of a canvas twice as wide as high
            ray = np.array(turn) @ [(1 - 2 * u) * reach, (1 - 2 * v) * reach / 2, 1.0]
            x, y, _ = [60.0, 0.0, 0.0] + ray * Z / ray[2]
            corners[i, j] = -y / Z, -x / Z
    return corners


def grid_of(path: Path) -> ProjectorGrid:
    return load_scene(path).pixels


def test_a_shifted_lens_casts_its_window_squarely(small_scene: Callable[..., Path]) -> None:
    grid = grid_of(small_scene())
    assert (grid.n, grid.first_row, grid.first_column, grid.canvas) == (N, 0, N, (N, 2 * N))
    assert grid.row_tan == pytest.approx((-0.15, 0.15), abs=FLOAT32)
    assert grid.column_tan == pytest.approx((-0.15, 0.15), abs=FLOAT32)
    assert grid.keystone == 0


def test_a_window_inside_its_canvas_is_found_with_its_offset(small_scene: Callable[..., Path]) -> None:
    canvas = np.zeros((N, 2 * N))
    canvas[3:11, 20:28] = 255
    grid = grid_of(small_scene(canvas=canvas))
    assert (grid.n, grid.first_row, grid.first_column) == (8, 3, 20)
    # Canvas texel r spans tan-angles -0.15 + 0.3 r / 16; column 16 of the canvas is the left edge of the plain window.
    assert grid.row_tan == pytest.approx((-0.15 + 0.3 * 3 / 16, -0.15 + 0.3 * 11 / 16), abs=FLOAT32)
    assert grid.column_tan == pytest.approx((-0.15 + 0.3 * 4 / 16, -0.15 + 0.3 * 12 / 16), abs=FLOAT32)


@pytest.mark.parametrize(("axis", "degrees"), [("y", 5.0), ("y", -3.0), ("x", -5.0), ("x", 2.0)])
def test_a_turned_projector_casts_a_keystone(small_scene: Callable[..., Path], axis: str, degrees: float) -> None:
    grid = grid_of(small_scene(projector_turn=f'<rotate {axis}="1" angle="{degrees}"/>'))
    corners = by_hand(axis, degrees)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    assert grid.row_tan == pytest.approx((low[0], high[0]), abs=FLOAT32)
    assert grid.column_tan == pytest.approx((low[1], high[1]), abs=FLOAT32)
    box = np.stack(np.meshgrid([low[0], high[0]], [low[1], high[1]], indexing="ij"), axis=-1)
    assert grid.keystone == pytest.approx(np.abs((corners - box) / (high - low)).max() * N, abs=1e-3)
    assert grid.keystone > 0.05


@pytest.mark.parametrize("fov", ["1e-9", "1e-6", "0.01"])
def test_a_window_of_no_width_is_refused(small_scene: Callable[..., Path], fov: str) -> None:
    """Light is collected in cells of the projector's pixels: 24 GB of them at 1e-6 degrees. (Planted: no limit.)"""
    path = small_scene()
    text = path.read_text()
    start = text.index('name="fov"', text.index('type="projector"'))
    end = text.index("/>", start)
    path.write_text(f'{text[:start]}name="fov" value="{fov}"{text[end:]}')
    with pytest.raises(MitsimError, match=r"the camera's field is .* pixels of the projector wide; at most 16384"):
        load_scene(path)


OBLONG = np.pad(np.full((N // 2, N), 255.0), ((0, N // 2), (N, 0)))
HOLLOW = np.pad(np.full((N, N), 255.0), ((0, 0), (N, 0)))
HOLLOW[5, 20] = 0


@pytest.mark.parametrize(
    ("canvas", "fragment"),
    [(np.zeros((N, 2 * N)), "all black"), (OBLONG, "8x16 and must fill a square"), (HOLLOW, "must fill a square")],
    ids=["black", "oblong", "hollow"],
)
def test_a_window_is_a_filled_square(small_scene: Callable[..., Path], canvas: np.ndarray, fragment: str) -> None:
    path = small_scene(canvas=canvas)
    with pytest.raises(MitsimError, match=fragment) as caught:
        grid_of(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
