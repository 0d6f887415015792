"""Patterns drawn without a run, and results as xarray Datasets and tensors.

What a camera sees of the pictures is what mitsim takes their frames for. Numbers come with units, indices of patterns
and places in mm.
"""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas
import pytest
from PIL import Image

import mitsim as ms
from mitsim.core.errors import MitsimError
from mitsim.core.manifests import Parallax
from mitsim.core.runs import Capture
from mitsim.devices.patterns import parse_patterns
from mitsim.exchange.formats import export
from mitsim.exchange.other_programs import SQUARE, Raster, describe_cells, draw_family, draw_stripes, grid_in
from mitsim.reconstruct.captured_session import calibrate_frames
from tests.exchanged import made
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


def test_own_grey_pictures_are_drawn_by_level_and_described_by_light(tmp_path: Path) -> None:
    """(Planted: light drawn in place of levels; a linear tone curve.)"""
    levels, projector = np.arange(256).reshape(16, 16).astype(np.uint8), tmp_path / "projector.toml"
    levels = np.rint(np.outer(levels[:, 15], levels[15] / 255)).astype(np.uint8)
    np.save(tmp_path / "own.npy", levels)
    projector.write_text(f"{PROJECTOR}tone_curve = 2.0\n".replace("30", "16").replace("14", "16"))
    draw_family(tmp_path / "drawn", str(tmp_path / "own.npy"), 16, str(projector), closing="uniform")
    for name, expected in (("pattern_00000", levels), ("pattern_00001", np.full((16, 16), 255))):
        with Image.open(tmp_path / "drawn" / "patterns" / f"{name}.png") as picture:
            assert np.array_equal(np.asarray(picture), expected)
    described = json.loads((tmp_path / "drawn" / "patterns.json").read_text())
    product = np.outer(described["P_L"], described["P_R"])
    assert np.abs(255 * np.sqrt(product) - levels).max() < 1


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


# ---- Results as labelled arrays and tensors ----


PARALLAX = Parallax(
    depth_mm=400.0, row_tan=(-0.15, 0.15), column_tan=(-0.1, 0.2), row_mm=(0.0, 0.0), column_mm=(60.0, 60.0),
    pixel_pitch_mm=0.01, mask_distance_mm=2.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    pytest.importorskip("xarray")
    return ms.load_run(made(tmp_path_factory.mktemp("labelled") / "made", signed=True).run)


@pytest.fixture(scope="module")
def factors(tmp_path_factory: pytest.TempPathFactory) -> ms.Factors:
    known = ms.load_calibration(made(tmp_path_factory.mktemp("labelled") / "made").calibration)
    return replace(known, manifest=known.manifest.model_copy(update={"parallax": PARALLAX}))


def test_a_capture_has_its_frames_and_which_pattern_each_is_of(shots: Capture) -> None:
    """(Planted: rows and columns of the patterns in each other's place; electrons without a unit.)"""
    data = shots.to_xarray()
    assert data.dn.dims == ("shot", "row", "column") and np.array_equal(data.dn, shots.dn)
    assert np.array_equal(data.electrons, shots.electrons) and data.electrons.attrs["units"] == "electron"
    assert np.array_equal(data.truth, shots.truth) and data.truth.dims == ("scene_row", "scene_column")
    captures = shots.manifest.patterns.captures
    one = data.isel(shot=5)
    assert (one.pattern_row, one.pattern_column, one.sign) == (captures[5].row, captures[5].column, captures[5].sign)
    halves = data.dn.where(data.sign == 1, drop=True)
    assert halves.sizes["shot"] == len(captures) // 2
    assert data.attrs["exposure_s"] == shots.exposure_s and data.attrs["Conventions"].startswith("CF-")


def test_every_number_has_a_unit_and_a_name(shots: Capture, factors: ms.Factors) -> None:
    for data in (shots.to_xarray(), factors.to_xarray()):
        for name, values in data.variables.items():
            assert {"units", "long_name"} <= values.attrs.keys(), name


def test_places_on_the_sensor_are_of_the_region_that_is_read(shots: Capture) -> None:
    """Middles of pixels, from the axis. (Planted: a region whose first row does not count; the pitch of columns for
    rows.)"""
    geometry = {"pixels": 100, "pixel_pitch": 0.01, "row_pitch": 0.02, "roi": (30, 20, 40, 52)}
    manifest = shots.manifest.model_copy(update={"camera": {**shots.manifest.camera, "geometry": geometry}})
    data = Capture(manifest, shots.folder).to_xarray()
    assert data.y.attrs["units"] == "mm" and data.y.dims == ("row",)
    assert np.allclose(data.y, 0.02 * (np.arange(30, 70) - 49.5)) and np.allclose(
        data.x, 0.01 * (np.arange(20, 72) - 49.5)
    )
    assert "y" not in shots.to_xarray().coords, "a camera that states no pixels"


def test_an_image_lies_where_its_factors_were_calibrated(shots: Capture, factors: ms.Factors, tmp_path: Path) -> None:
    """Cells of the projector's window at the calibrated depth: 120 mm high in 10 rows, from 60 mm below the axis.
    (Planted: edges of cells for their middles.)"""
    image = ms.reconstruct(ms.load_run(made(tmp_path / "made").run), factors)
    data = image.to_xarray(factors)
    assert np.array_equal(data.image, image.image) and np.array_equal(data.uncertainty, image.uncertainty)
    assert np.allclose(data.scene_y, -60 + 12 * (np.arange(10) + 0.5))
    assert np.allclose(data.scene_x, -40 + 120 / 14 * (np.arange(14) + 0.5))
    assert np.allclose(factors.to_xarray().scene_y, data.scene_y)
    assert "scene_y" not in image.to_xarray().coords
    other = replace(factors, left=factors.left[:, :4])
    with pytest.raises(ms.MitsimError, match="4 x 14 scene pixels, but the image has 10 x 14"):
        image.to_xarray(other)


def test_without_xarray_it_is_said_in_a_line(monkeypatch: pytest.MonkeyPatch, shots: Capture) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ms.MitsimError, match=r"xarray is not installed; type: pip install 'mitsim\[xarray\]'"):
        shots.to_xarray()


def test_a_studys_rows_are_a_table(tmp_path: Path) -> None:
    """(Planted: a table of the first row alone.)"""
    from mitsim.studies.framework.campaign import StudyResult

    rows = ({"x": 1, "psnr_db": 20.5}, {"x": 2, "psnr_db": 21.5})
    found = StudyResult("toy", str(tmp_path), rows, points=2)
    (tmp_path / "toy.png").write_bytes(b"\x89PNG")
    assert found.pictures == {"toy.png": tmp_path / "toy.png"} and "Measured 2 points" in found._repr_html_()
    assert found.to_pandas().equals(pandas.DataFrame([*rows]))


# ---- Tensors of PyTorch ----


def test_a_missing_package_is_told_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = made(tmp_path)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MitsimError, match=r"torch is not installed, .* pip install 'mitsim\[torch\]'"):
        export(bench.run, "torch", tmp_path / "run.pt", bench.calibration)
    assert not (tmp_path / "run.pt").exists()


def test_the_file_holds_what_the_solver_sees(tmp_path: Path) -> None:
    """Measurements, truth, patterns and factors."""
    torch = pytest.importorskip("torch")
    bench = made(tmp_path, signed=True)
    shots, factors = ms.load_run(bench.run), ms.load_calibration(bench.calibration)
    export(bench.run, "torch", tmp_path / "run.pt", bench.calibration)
    held = {name: each.numpy() for name, each in torch.load(tmp_path / "run.pt", weights_only=True).items()}
    columns = shots.patterns[1].shape[1]
    for frame, i, j in shots.measurements():
        assert np.array_equal(held["y"][i * columns + j], frame)
    assert np.array_equal(held["x"][0], shots.truth)
    for name, expected in zip(("P_L", "P_R", "left", "right"), (*shots.patterns, *factors.sides), strict=True):
        assert np.array_equal(held[name], expected)
