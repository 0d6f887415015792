"""Captures, factors and images as xarray Datasets, with units, indices of patterns and places in mm, and as tensors."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas
import pytest

import mitsim as ms
from mitsim.core.errors import MitsimError
from mitsim.core.manifests import Parallax
from mitsim.core.runs import Capture
from mitsim.exchange.formats import export
from tests.exchanged import made

xarray = pytest.importorskip("xarray")
PARALLAX = Parallax(
    depth_mm=400.0, row_tan=(-0.15, 0.15), column_tan=(-0.1, 0.2), row_mm=(0.0, 0.0), column_mm=(60.0, 60.0),
    pixel_pitch_mm=0.01, mask_distance_mm=2.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Capture:
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
    assert found.pictures == {"toy.png": tmp_path / "toy.png"} and "2 points in" in found._repr_html_()
    assert found.to_pandas().equals(pandas.DataFrame([*rows]))


# ---- Tensors of PyTorch ----


def test_a_missing_package_is_told_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = made(tmp_path)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MitsimError, match=r"torch is not installed .* pip install 'mitsim\[torch\]'"):
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
