"""Pictures and meshes that a user names: where they are found, what they become, and what is wrong with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

import mitsim as ms
from mitsim.core.errors import MitsimError
from mitsim.core.images import fit_square, read_reflectance
from mitsim.scene.outline import Outline

TETRAHEDRON = "v 0 0 0\nv 10 0 0\nv 5 20 3\nv 4 2 9\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
BOARD = 0.99
"""Reflectance of the white board, which stands for the unit of truth."""


def print_of(bench: ms.Bench) -> np.ndarray:
    """Texels of the sheet."""
    import mitsuba as mi

    parameters = mi.traverse(bench.loaded.scene)
    (name,) = (name for name in parameters.keys() if name.endswith("reflectance.data"))  # noqa: SIM118
    values = np.array(parameters[name])[..., 0]
    return values / 255 if values.dtype == np.uint8 else values


@pytest.mark.parametrize("kind", ["png", "npy", "exr", "tiff"])
def test_numbers_are_reflectances_whichever_file_holds_them(kind: str, tmp_path: Path) -> None:
    """(Planted: a gamma curve; numbers scaled to their own largest.)"""
    codes = np.arange(12, dtype=np.uint8).reshape(3, 4) * 20
    path = tmp_path / f"a.{kind}"
    if kind == "npy":
        np.save(path, codes / 255)
    elif kind == "exr":
        from mitsim.core.exr import write_frame

        write_frame(path, {"DN": (codes / 255).astype(np.float32)}, {})
    else:
        Image.fromarray(codes).save(path)
    assert_allclose(read_reflectance(path), codes / 255, atol=1e-7)


def test_large_pictures_are_reduced_by_means_and_centred(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks at the ends are smaller. (Planted: blocks at the ends left out; sums instead of means.)"""
    monkeypatch.setattr("mitsim.core.images._MOST_SIDE", 3)
    assert_allclose(fit_square(np.arange(15.0).reshape(3, 5)), [[3, 5, 6.5], [10.5, 12.5, 14], [0, 0, 0]])


def test_a_picture_on_the_sheet_is_the_truth(variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file that lies elsewhere, a number for each projector pixel. (Planted: colours by their first; the sheet's side
    128 for 120; a picture turned.) Rays at the edge of a pixel may meet its neighbour, by rounding."""
    values = np.random.default_rng(1).integers(10, 240, (128, 128)).astype(np.uint8)
    Image.fromarray(np.stack([values, values // 2, values], axis=2)).save(tmp_path / "mine.png")
    monkeypatch.chdir(tmp_path)
    Path("small.toml").write_text('base = "imx249"\nrows = 64\ncolumns = 64\n')
    with pytest.warns(UserWarning, match="32 x 32 pixels of 11.72 x 11.72 um"):
        bench = ms.open_bench("photograph", variant, "small.toml", picture="mine.png", sheet_mm=120)
    expected = (2 * values.astype(float) + values // 2) / 3 / 255
    assert_allclose(print_of(bench), expected, atol=1e-6)
    assert bench.defines["picture"] == str(tmp_path / "mine.png")
    assert str(tmp_path / "mine.png") in bench.provenance()["scene_files"]
    truth = np.asarray(bench.capture("uniform", accuracy=0.05, exposure=0.01).truth, dtype=np.float64)
    assert np.abs(truth - expected / BOARD).mean() < 1e-4 and np.abs(truth - expected / BOARD).max() < 0.02


def test_where_a_named_file_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the working folder, else in the scene's; in both, whoever names it must say which. (Planted: the scene's own
    first; a file inside a scene from elsewhere allowed.)"""
    for folder in ("scene", "here"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "both.png").write_bytes(b"1")
    (tmp_path / "here" / "mine.png").write_bytes(b"1")
    (tmp_path / "scene" / "own.png").write_bytes(b"1")
    path = tmp_path / "scene" / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><default name="picture" value="own.png"/><shape type="rectangle"><bsdf type="diffuse">'
        '<texture type="bitmap"><string name="filename" value="$picture"/></texture></bsdf></shape></scene>'
    )
    monkeypatch.chdir(tmp_path / "here")

    def found(name: str) -> str:
        return Outline(path, {"picture": name}).defines["picture"]

    assert found("mine.png") == found("./mine.png") == str(tmp_path / "here" / "mine.png")
    assert found("own.png") == str(tmp_path / "scene" / "own.png")
    assert found("./both.png") == str(tmp_path / "here" / "both.png")
    for name, words in (("both.png", r"give \./both\.png or "), ("none.png", "no such file in .*here or .*scene")):
        with pytest.raises(MitsimError, match=words):
            found(name)


def test_a_mesh_stands_on_the_shelf(variant: str, tmp_path: Path) -> None:
    """Its longest side, 20, is 50 mm; its lowest point is on the shelf, its box's middle over the object's place.
    It states no normals, so its faces are flat. (Planted: scaled by its height; hung by its middle; smoothed.)"""
    (tmp_path / "a.obj").write_text(TETRAHEDRON)
    bench = ms.shelf_scene(tmp_path / "a.obj", size_mm=50, variant=variant)
    import mitsuba as mi

    (shape,) = (shape for shape in bench.loaded.scene.shapes() if shape.id() == "object")
    corners = np.array(mi.traverse(shape)["vertex_positions"]).reshape(-1, 3)
    sine, cosine = np.sin(np.radians(15)), np.cos(np.radians(15))
    # Back from the shelf: its place taken off, its slope turned back.
    x, y, z = (corners - [0, -49.28, 390]).T
    level = np.stack([x, y * cosine - z * sine, y * sine + z * cosine], axis=1)
    box = np.array([[0, 0, 0], [5, 20, 3], [10, 0, 0], [4, 2, 9]]) * 2.5 - [12.5, -0.05, 11.25]
    assert_allclose(level, box, atol=1e-3)
    assert not shape.has_vertex_normals()
    (tmp_path / "b.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1 3//1\n")
    smooth = ms.shelf_scene(tmp_path / "b.obj", variant=variant).loaded.scene.shapes()
    assert next(shape for shape in smooth if shape.id() == "object").has_vertex_normals()


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "has no faces"),
        ("a.obj", TETRAHEDRON.replace("v 4 2 9", "v 4 2 nan"), "not finite"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nf 1//1 3//1 2//1\n", "normals of 3 of 3 corners face against"),
        ("a.obj", "v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "all its vertices are one point"),
        ("a.stl", "solid", r"ends in \.stl; read are"),
    ],
)
def test_what_is_wrong_with_a_mesh_is_told(name: str, text: str, words: str, variant: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(MitsimError, match=words) as refusal:
        ms.shelf_scene(tmp_path / name, variant=variant)
    assert str(tmp_path / name) in str(refusal.value) and "\n" not in str(refusal.value)
