"""Pictures that pairs are made of: drawn by code, or of a folder."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsim.core.arrays import stream
from mitsim.core.errors import MitsimError
from mitsim.learn.pairs import DrawnPictures, FolderPictures, pink_noise

N = 64


def test_a_picture_hangs_on_the_seed_and_its_number_alone() -> None:
    """(Planted: the stream of all pictures of a seed.)"""
    one, other = DrawnPictures(1), DrawnPictures(2)
    third = one.draw(3, N)
    assert third.dtype == np.uint8 and third.shape == (N, N)
    one.draw(0, N)
    assert np.array_equal(one.draw(3, N), third)
    assert not np.array_equal(one.draw(4, N), third) and not np.array_equal(other.draw(3, N), third)


def test_drawn_pictures_are_as_natural_ones_are() -> None:
    """Over 40 of them: reflectances as print has them; power that falls with frequency: most of it lies below an eighth
    of a cycle a pixel, in 5 % of all frequencies; soft edges: few steps from pixel to pixel exceed a third. (Planted:
    edges a hundredth of a pixel wide, and leaves of black and white.)"""
    pictures = np.array([DrawnPictures(5).draw(number, N) for number in range(40)]) / 255
    assert pictures.min() >= 0.03 - 1 / 255 and pictures.max() <= 0.95 + 1 / 255
    assert 0.3 < pictures.mean() < 0.6 and 0.08 < pictures.std(axis=(1, 2)).mean() < 0.25
    frequency = np.hypot(np.fft.fftfreq(N)[:, None], np.fft.fftfreq(N)[None])
    power = np.square(abs(np.fft.fft2(pictures - pictures.mean(axis=(1, 2), keepdims=True)))).mean(axis=0)
    assert power[frequency < 1 / 8].sum() > 0.6 * power.sum()
    assert (abs(np.diff(pictures, axis=1)) > 1 / 3).mean() < 0.01


def test_the_amplitude_of_texture_falls_as_one_over_the_frequency() -> None:
    """The mean over 30 fields, to 5 % in its slope. (Planted: the power, not the amplitude.)"""
    fields = np.array([pink_noise(N, stream(0, "field", number)) for number in range(30)])
    assert fields.std() == pytest.approx(1, rel=1e-6) and abs(fields.mean()) < 1e-9
    amplitude = np.sqrt(np.square(abs(np.fft.fft2(fields))).mean(axis=0))
    frequency = np.hypot(np.fft.fftfreq(N)[:, None], np.fft.fftfreq(N)[None])
    inside = (frequency > 0) & (frequency < 0.4)
    slope = np.polyfit(np.log(frequency[inside]), np.log(amplitude[inside]), 1)[0]
    assert slope == pytest.approx(-1, abs=0.05)


def save(path: Path, values: np.ndarray) -> None:
    Image.fromarray(values).save(path)


def test_pictures_of_a_folder_are_middle_squares_then_crops(tmp_path: Path) -> None:
    """Of a ramp along the columns each part's mean is known. (Planted: the upper left square.)"""
    ramp = np.broadcast_to(np.arange(0, 240, 2, dtype=np.uint8), (90, 120))
    save(tmp_path / "b.png", np.ascontiguousarray(ramp))
    colours = np.stack([ramp, 0 * ramp, 0 * ramp], axis=2)
    save(tmp_path / "a.png", np.ascontiguousarray(colours))
    (tmp_path / "letter.txt").write_text("mine")
    pictures = FolderPictures(tmp_path, seed=1)
    assert [path.name for path in pictures.files] == ["a.png", "b.png"] and pictures.source.startswith("2 files of ")
    # 90 columns from the 15th on, in 16 parts of 5.625: the middle of each part.
    middles = 30 + 2 * (5.625 * (np.arange(16) + 0.5) - 0.5)
    assert abs(pictures.draw(1, 16) - middles[None]).max() <= 0.5 + 1e-9
    assert abs(pictures.draw(0, 16) - middles[None] / 3).max() <= 0.5 + 1e-9
    crops = [pictures.draw(number, 16) for number in (3, 5)]
    assert not np.array_equal(*crops) and np.array_equal(FolderPictures(tmp_path, 1).draw(5, 16), crops[1])
    steps = [sorted(abs(np.diff(crop.astype(float), axis=axis)).mean() for axis in (0, 1)) for crop in crops]
    assert all(still == 0 and step > 0 for still, step in steps), "turned by quarters"


def test_equal_files_are_one_photograph(tmp_path: Path) -> None:
    """By what they hold, whatever they are called. (Planted: names compared.)"""
    for name, level in (("a.png", 10), ("b.png", 20), ("c.png", 10)):
        Image.fromarray(np.full((16, 16), level, np.uint8)).save(tmp_path / name)
    assert FolderPictures(tmp_path, 0).photographs == (0, 1, 0) and DrawnPictures(0).photographs == ()


def test_pictures_of_any_kind_of_file_are_read(tmp_path: Path) -> None:
    """Of sixteen bits, without transparency, and a grey JPEG but for what its packing changes."""
    save(tmp_path / "a.png", np.full((20, 20), 257 * 77, np.uint16))
    opaque = np.full((20, 20, 4), 77, np.uint8)
    opaque[..., 3] = 255
    save(tmp_path / "b.png", opaque)
    save(tmp_path / "c.JPG", np.full((40, 60), 77, np.uint8))
    assert all(abs(FolderPictures(tmp_path, 0).draw(each, 8).astype(int) - 77).max() <= each // 2 for each in range(3))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.png", np.zeros((8, 9), np.uint8), "has 8 pixels on its shorter side, and 16 are shown"),
        ("a.npy", np.full((20, 20), 1.5), "its numbers reach from 1.5 to 1.5; give 0 to 1"),
        ("a.jpg", None, "cannot be read as a JPEG"),
        ("a.png", np.full((20, 20, 4), 128, np.uint8), "has transparent pixels"),
        ("a.png", np.full((20, 20, 2), 128, np.uint8), "is no grey PNG"),
    ],
)
def test_a_picture_that_cannot_be_shown_is_refused(
    tmp_path: Path, name: str, content: np.ndarray | None, words: str
) -> None:
    path = tmp_path / name
    if content is None:
        path.write_bytes(b"no picture")
    elif name.endswith("npy"):
        np.save(path, content)
    else:
        save(path, content)
    with pytest.raises(MitsimError, match=words) as refusal:
        FolderPictures(tmp_path, 0).draw(0, 16)
    assert str(path) in str(refusal.value) and "\n" not in str(refusal.value)


def test_a_folder_without_pictures_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MitsimError, match="holds no file that ends in"):
        FolderPictures(tmp_path, 0).draw(0, 16)
    with pytest.raises(MitsimError, match="is no folder"):
        FolderPictures(tmp_path / "none", 0).draw(0, 16)
    (tmp_path / "a.png").symlink_to(tmp_path / "gone.png")
    with pytest.raises(MitsimError, match=r"picture .*a\.png: cannot be read"):
        FolderPictures(tmp_path, 0).source  # noqa: B018 - found when it is asked for
