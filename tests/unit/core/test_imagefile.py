"""Frames of other programs: numbers as they are stored, and a line for every file that is no frame."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsim.core.errors import MitsimError
from mitsim.core.framefile import write_frame
from mitsim.core.imagefile import image_size, own_end, read_image

NUMBERS = (np.arange(35).reshape(5, 7) * 113).astype(np.uint16)
Write = Callable[[Path], object]


def saved(values: np.ndarray, **options: object) -> Write:
    return lambda path: Image.fromarray(values).save(path, **options)


@pytest.mark.parametrize(
    ("name", "write", "expected"),
    [
        ("a.png", saved(NUMBERS), NUMBERS),
        ("a.PNG", saved((NUMBERS // 113).astype(np.uint8)), NUMBERS // 113),
        ("a.tif", saved(NUMBERS), NUMBERS),
        ("a.tiff", saved(NUMBERS, compression="tiff_lzw"), NUMBERS),
        ("a.tif", saved(NUMBERS.astype(np.float32) / 7), NUMBERS.astype(np.float32) / 7),
        ("a.tif", saved(NUMBERS.astype(np.int32) * 1000), NUMBERS.astype(np.int32) * 1000),
        ("a.npy", lambda path: np.save(path, NUMBERS), NUMBERS),
        ("a.npy", lambda path: np.save(path, np.asfortranarray(NUMBERS / 3.0)), NUMBERS / 3.0),
        ("a.exr", lambda path: write_frame(path, {"Y": NUMBERS.astype(np.float32)}, {}), NUMBERS),
    ],
)
def test_numbers_are_read_as_they_are_stored(tmp_path: Path, name: str, write: Write, expected: np.ndarray) -> None:
    write(tmp_path / name)
    assert image_size(tmp_path / name) == (5, 7)
    values = read_image(tmp_path / name)
    assert np.array_equal(values, expected) and values.shape == (5, 7)


def test_the_end_of_a_file_is_that_of_its_bits() -> None:
    """A real or 32 bit number ends where no camera does."""
    assert own_end(np.zeros(1, np.uint8)) == 255 and own_end(np.zeros(1, np.uint16)) == 65535
    assert own_end(np.zeros(1, np.uint32)) is None and own_end(np.zeros(1)) is None


@pytest.mark.parametrize(
    ("name", "write", "words"),
    [
        ("a.png", saved(np.zeros((5, 7, 3), np.uint8)), "mode RGB; one grey channel"),
        ("a.png", saved(np.zeros((5, 7, 4), np.uint8)), "mode RGBA"),
        ("a.png", lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n cut"), "cannot be read"),
        ("a.tif", saved(NUMBERS, save_all=True, append_images=[Image.fromarray(NUMBERS)]), "has 2 pages"),
        ("a.tif", saved(NUMBERS, tiffinfo={262: 0}), "WhiteIsZero"),
        ("a.npy", lambda path: np.save(path, NUMBERS[None]), "uint16 of shape (1, 5, 7)"),
        ("a.npy", lambda path: np.save(path, np.array([["a"]])), "rows x columns of numbers"),
        ("a.npy", lambda path: np.save(path, np.array([[None]]), allow_pickle=True), "cannot be read"),
        ("a.npy", lambda path: np.save(path, np.array([[np.nan, 1.0]])), "1 values are not finite"),
        ("a.npy", lambda path: np.save(path, np.zeros((0, 3))), "0 x 3 pixels"),
        (
            "a.exr",
            lambda path: write_frame(path, {name: np.ones((2, 2), np.float32) for name in "RGB"}, {}),
            "DN, or a",
        ),
        ("a.jpg", saved(np.zeros((5, 7), np.uint8)), "ends in .jpg"),
        ("a.png", lambda path: None, "No such file"),
    ],
)
def test_what_is_no_frame_is_refused(tmp_path: Path, name: str, write: Write, words: str) -> None:
    write(tmp_path / name)
    with pytest.raises(MitsimError) as told:
        read_image(tmp_path / name)
    assert words in str(told.value) and name in str(told.value) and "\n" not in str(told.value)


def test_a_picture_too_large_for_any_sensor_is_refused_by_its_header(tmp_path: Path) -> None:
    np.lib.format.open_memmap(tmp_path / "a.npy", "w+", np.uint8, (2, 20000)).flush()
    with pytest.raises(MitsimError, match="2 x 20000 pixels"):
        image_size(tmp_path / "a.npy")
