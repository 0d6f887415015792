"""Patterns drawn without a run: what a camera sees of their pictures is what mitsim takes their frames for."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import parse_patterns
from mitsim.exchange.other_programs import SQUARE, Raster, describe_cells, draw_family, draw_stripes, grid_in
from mitsim.reconstruct.captured_session import calibrate_frames
from tests.real_session import RealSession, write_image

N = 4
PROJECTOR = 'name = "p"\neffective_wavelength_nm = 550.0\ncolumns = 30\nrows = 14\n'
CAMERA = """
name = "bench 3"
pixel_pitch_um = 5.0
full_well_e = 34720.0
read_noise_e = 10.0
dark_current_e_per_s = 4000.0
quantum_efficiency = 0.5
gain_dn_per_e = 0.125
black_level_dn = 160.0
bits = 12
source = "made up"
"""


@pytest.fixture
def devices(tmp_path: Path) -> tuple[str, str]:
    """Files of a projector, whose grid of 4 cells takes 12 of 14 rows and of 30 columns, and of a camera."""
    (tmp_path / "projector.toml").write_text(PROJECTOR)
    (tmp_path / "camera.toml").write_text(CAMERA)
    return str(tmp_path / "projector.toml"), str(tmp_path / "camera.toml")


def lights(folder: Path) -> list[np.ndarray]:
    """(n, n) of 0 to 1 in each picture, in the order of their names; nothing around the grid."""
    found = []
    for path in sorted((folder / "patterns").glob("pattern_*.png")):
        with Image.open(path) as picture:
            values = np.asarray(picture)
        assert values.shape == (14, 30) and set(np.unique(values)) <= {0, 255}
        grid = values[1:13, 9:21]
        assert values.sum() == grid.sum()
        found.append(grid.reshape(N, 3, N, 3).mean(axis=(1, 3)) / 255)
    return found


@pytest.mark.parametrize("mode", ["pair", "uniform"])
def test_frames_of_the_stripes_give_the_cameras_factors(mode: str, devices: tuple[str, str], tmp_path: Path) -> None:
    """The list that comes with them is theirs: the camera that sees them is found again, to its noise. (Planted:
    rows for columns, the negative half first, no uniform frame, another exposure in the list.)"""
    result = draw_stripes(tmp_path / "stripes", N, *devices, 0.02, mode)
    shown, session = lights(tmp_path / "stripes"), RealSession()
    assert result["pictures"] == len(shown) == (16 if mode == "pair" else 10)
    cell = {"cell": 3, "cell_columns": 3, "cell_shape": 1.0}
    assert result["projector"] == {"rows": 14, "columns": 30, **cell, "first_row": 1, "first_column": 9}
    (tmp_path / "frames").mkdir()
    for number, light in enumerate(shown):
        write_image(tmp_path / "frames" / f"shot {number}.png", session.frame(light))
    shutil.copy(tmp_path / "stripes" / "session.json", tmp_path / "frames")
    factors = calibrate_frames(tmp_path / "frames")
    assert factors.ok, factors.warnings
    found, exact = (np.kron(*sides) for sides in ((factors.left, factors.right), (session.left, session.right)))
    assert np.linalg.norm(found - exact) < 0.03 * np.linalg.norm(exact)


def test_a_family_is_drawn_shot_by_shot(devices: tuple[str, str], tmp_path: Path) -> None:
    """Of signed ones the positive half first. (Planted: rows and columns of a shot changed places.)"""
    for name in ("dots:2x3", "hadamard:2"):
        folder = tmp_path / name.replace(":", "_")
        result = draw_family(folder, name, N, devices[0])
        family = parse_patterns(name, N, 0)
        for light, shot in zip(lights(folder), family.shots, strict=True):
            assert np.array_equal(light, family.light(shot))
        described = json.loads((folder / "patterns.json").read_text())
        assert described["projector"] == result["projector"] and described["family"] == name
        assert [(shot["row"], shot["column"], shot["sign"]) for shot in described["shots"]] == [
            (shot.row, shot.column, shot.sign) for shot in family.shots
        ]


def test_a_cell_is_square_on_the_scene_where_pixels_are_not(tmp_path: Path) -> None:
    """Of the MP-CL1, 1920 x 720 pixels in a picture of 16:9: the lit part is as wide as high, and so is every cell.
    (Planted: the aspect left out; its inverse.)"""
    result = draw_family(tmp_path / "dots", "dots:2", 128, "mp_cl1")
    with Image.open(tmp_path / "dots" / "patterns" / "white.png") as picture:
        white = np.asarray(picture)
    with Image.open(tmp_path / "dots" / "patterns" / "pattern_00000.png") as picture:
        dots = np.asarray(picture)
    width, height = 16 / 1920, 9 / 720
    for light, side in ((white, 128), (dots, 127)):  # of every second pixel, from the first on
        rows, columns = (np.flatnonzero(light.any(axis=axis)) for axis in (1, 0))
        assert (np.ptp(columns) + 1) * width == pytest.approx((np.ptp(rows) + 1) * height, rel=1e-12)
        assert np.ptp(rows) + 1 == side * result["projector"]["cell"]
    assert (result["projector"]["cell"], result["projector"]["cell_columns"]) == (4, 6)
    assert result["projector"]["cell_shape"] == pytest.approx(1, abs=1e-5)
    assert describe_cells(result["projector"]) == "4 x 6 pixels, square on the scene"


@pytest.mark.parametrize("aspect", [0.31, 2 / 3, 0.9, 1.0, 1.05, 1.4, 3.0])
@pytest.mark.parametrize("raster", [(14, 30), (64, 64), (720, 1280), (1280, 720)])
def test_of_square_cells_the_largest_is_drawn_else_the_squarest(raster: tuple[int, int], aspect: float) -> None:
    """Against all cells of whole pixels that fit. (Planted: the smallest square one; the
    squarest in any case; columns not held to the raster.)"""
    sides = (7, 10)
    where = grid_in(Raster(*raster, aspect), sides, "here")
    most = [pixels // side for pixels, side in zip(raster, sides, strict=True)]
    off = {
        (rows, columns): abs(np.log(columns * aspect / rows))
        for rows in range(1, most[0] + 1)
        for columns in range(1, most[1] + 1)
    }
    square = [cell for cell, by in off.items() if by <= SQUARE]
    found = where["cell"], where["cell_columns"]
    assert found[0] == max(rows for rows, _ in square) if square else off[found] == min(off.values())
    assert where["cell_shape"] == pytest.approx(found[1] * aspect / found[0])
    assert ("times as wide" in describe_cells(where)) == (not square)
    ends = where["first_row"] + sides[0] * found[0], where["first_column"] + sides[1] * found[1]
    assert all(
        0 <= raster[axis] - ends[axis] - where[name] <= 1 for axis, name in enumerate(("first_row", "first_column"))
    )


def test_what_cannot_be_drawn_is_refused_and_leaves_nothing(devices: tuple[str, str], tmp_path: Path) -> None:
    place = tmp_path / "new"
    (tmp_path / "bare.toml").write_text('name = "p"\neffective_wavelength_nm = 550.0\n')
    for words, name, n, projector in (
        ("do not fit a projector of 14 rows x 30 columns", "dots:2", 15, devices[0]),
        ("does not say its rows", "dots:2", N, str(tmp_path / "bare.toml")),
        ("K is 5", "dots:5", N, devices[0]),
        ("use uniform", "stripe", N, devices[0]),
    ):
        with pytest.raises(MitsimError, match=words):
            draw_family(place, name, n, projector)
    for words, exposure, n, mode in (("'pair' or 'uniform'", 0.02, N, "both"), ("exposure 0:", 0.0, N, "pair")):
        with pytest.raises(MitsimError, match=words):
            draw_stripes(place, n, *devices, exposure, mode)
    assert not place.exists()
