"""Meshes and pictures as other programs write them: read as they are meant, or refused in one line, by every reader."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from mitsim.acquire.sense import read_image
from mitsim.core.errors import MitsimError
from mitsim.core.exr import read_frame
from mitsim.core.images import read_reflectance
from mitsim.scene.headers import check_image, check_obj, check_ply
from tests.ply import ply_text

# -------- Wavefront meshes

SQUARE = "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\n"
DENT = "v 0 0 0\nv 3 0 0\nv 3 3 0\nv 2 1 0\n"
"""A dart, whose fourth corner is concave: from there a fan covers it, from the corner before it not."""
MESHES: dict[str, tuple[str, float | str]] = {
    "a quad": (f"{SQUARE}f 1 2 3 4\n", 4.0),
    "line ends of Windows, tabs, blanks before": ((SQUARE + "f\t1 2 3 4\n  f 1 2 3\n").replace("\n", "\r\n"), 6.0),
    "textures and normals": (f"{SQUARE}vt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3//1 4/1\n", 4.0),
    "remarks, groups, colours of vertices": (f"# a\n{SQUARE}o x\ng y z\ns off\nv 1 1 1 1 1 1\nf 1 2 3 # b\n", 2.0),
    "a corner twice": (f"{SQUARE}f 1 2 2 3 4\n", 4.0),
    "a corner on an edge": (f"{SQUARE}v 1 0 0\nf 1 5 2 3 4\n", 4.0),
    "a dart seen from its dent": (f"{DENT}f 4 1 2 3\n", 3.0),
    "rounded coordinates": (f"{SQUARE.replace('2 2 0', '2.0001 2 0.0001')}f 1 2 3 4\n", 4.0),
    "a continued face": (f"{SQUARE}f 1 2 3 \\\n4\n", "line that is not understood, 5"),
    "a continued remark": (f"# C:\\\n{SQUARE}f 1 2 3\n", "line that is not understood, 1"),
    "counted from the end": (f"{SQUARE}f -4 -3 -2\n", r"5 \('f -4 -3 -2'\)"),
    "two corners": (f"{SQUARE}f 1 2 3\nf 1 2\n", "understood, 6"),
    "a broken number": (f"{SQUARE}f 1 2 3.5 4\n", "understood, 5"),
    "a letter among corners": (f"{SQUARE}f 1 2 x 3\n", "understood, 5"),
    "line ends of old Macintoshes": (f"{SQUARE}f 1 2 3\rf 1 3 4\r\n", "understood, 5"),
    "a free-form surface": (f"{SQUARE}f 1 2 3\nsurf 0 1 0 1 1 2 3 4\n", "understood, 6"),
    "an old word for a face": (f"{SQUARE}f 1 2 3\nfo 1 3 4\n", "understood, 6"),
    "a vertex that is not there": (f"{SQUARE}f 1 2 3 9\n", "vertex 9, but 4 vertices"),
    "a dart": (f"{DENT}f 3 4 1 2\n", "concave, or crosses itself, in line 5"),
    "a bow tie": (f"{SQUARE}f 1 2 4 3\n", "concave, or crosses itself|in no plane"),
    "a square with a hole": (
        "v 0 0 0\nv 9 0 0\nv 9 9 0\nv 0 9 0\nv 3 3 0\nv 3 6 0\nv 6 6 0\nv 6 3 0\nf 1 2 3 4 1 5 6 7 8 5\n", "line 9"),
    "a saddle": (f"{SQUARE.replace('2 2 0', '2 2 1')}f 1 2 3 4\n", "in no plane, in line 5"),
    "a concave face among good ones": (f"{SQUARE}{DENT}f 1 2 3 4\nf 5 6 7\nf 7 8 5 6\n",
        "concave, or crosses itself, in line 11"),
}  # fmt: skip


@pytest.mark.parametrize("name", MESHES)
def test_a_wavefront_mesh_is_read_right_or_refused(tmp_path: Path, variant: str, name: str) -> None:
    """By its area in Mitsuba. (Planted: no look at backslashes, at a face's words, at lines of unknown words, at turned
    triangles, at bent faces, at the number of vertices; a fan from the second corner.)"""
    import mitsuba as mi

    text, right = MESHES[name]
    path = tmp_path / "a.obj"
    path.write_bytes(text.encode())
    if isinstance(right, str):
        with pytest.raises(ValueError, match=right) as refusal:
            check_obj(path)
        assert "\n" not in str(refusal.value)
        return
    check_obj(path)
    mesh = mi.load_dict({"type": "obj", "filename": str(path), "face_normals": True})
    assert float(np.array(mesh.surface_area()).ravel()[0]) == pytest.approx(right, rel=1e-3)


# -------- OpenEXR pictures


def window(left: int, top: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a window of 8 x 6 pixels."""
    return np.array([left, top], np.int32), np.array([left + 7, top + 5], np.int32)


WINDOWS: dict[str, dict[str, Any]] = {
    "data below zero": {"dataWindow": window(-3, -2), "displayWindow": window(0, 0)},
    "both below zero": {"dataWindow": window(-3, -2), "displayWindow": window(-3, -2)},
    "one row below zero": {"dataWindow": window(0, -1), "displayWindow": window(0, 0)},
    "data within what is shown": {"dataWindow": window(3, 2), "displayWindow": (window(0, 0)[0], window(9, 9)[1])},
    "more data than are shown": {"dataWindow": window(0, 0), "displayWindow": (window(0, 0)[0], window(-2, -1)[1])},
}
READERS: dict[str, Callable[[Path], object]] = {
    "scene": check_image, "frame": read_frame, "sense": read_image, "picture": read_reflectance,
}  # fmt: skip


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("what", WINDOWS)
def test_windows_that_differ_are_refused(tmp_path: Path, what: str, reader: str) -> None:
    """(Planted: only those below zero; only the corner at the left.)"""
    path = tmp_path / "a.exr"
    header = {"type": OpenEXR.scanlineimage, **WINDOWS[what]}
    OpenEXR.File(header, {"Y": np.ones((6, 8), np.float32)}).write(str(path))
    with pytest.raises((MitsimError, ValueError), match=r"the data window .* and the display window .*; save equal"):
        READERS[reader](path)


@pytest.mark.parametrize("types", ["uff", "hff", "fhh", "ffu", "fuh", "uuu"])
def test_channels_of_several_types_are_refused_in_scenes_and_read_elsewhere(tmp_path: Path, types: str) -> None:
    """Mitsuba takes all for the type of the first: whole numbers for `uff`, half precision for `hff`."""
    kinds = {"u": np.uint32, "h": np.float16, "f": np.float32}
    ramp = np.linspace(0.1, 0.9, 48).reshape(6, 8)
    channels = {name: (9 * ramp).astype(kinds[each]) for name, each in zip(("B", "DN", "R"), types, strict=True)}
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {**channels}).write(str(tmp_path / "a.exr"))
    with pytest.raises(ValueError, match=r"its channels are .*; save all as float, or as half"):
        check_image(tmp_path / "a.exr")
    for name, values in read_frame(tmp_path / "a.exr")[0].items():
        assert np.array_equal(values, channels[name])
    assert np.array_equal(read_image(tmp_path / "a.exr", "DN")[0], channels["DN"])


def test_a_texture_that_a_mesh_names_is_found(tmp_path: Path) -> None:
    for comment, texture in (("", ""), ("comment TextureFile bricks.png", "bricks.png")):
        (tmp_path / "a.ply").write_text(ply_text([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)], comment))
        assert check_ply(tmp_path / "a.ply") == (False, texture)
