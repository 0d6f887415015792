"""Pictures of point spread functions, against what they were drawn from."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsim.core.errors import MitsimError
from mitsim.devices.camera import load_psf


def drawn(path: Path, background: int, colours: bool) -> np.ndarray:
    """A 16-bit grey (or 8-bit colour) picture of a cross on a background; the light of the cross alone."""
    light = np.zeros((70, 83))
    light[30:36, 20:60], light[20:50, 40:44] = 100, 60
    picture = light + background
    if colours:
        Image.fromarray(np.stack([picture, picture, picture], axis=2).astype(np.uint8)).save(path)
    else:
        Image.fromarray(picture.astype(np.uint16)).save(path)
    return light


@pytest.mark.parametrize(("background", "colours", "name"), [(400, False, "a.tif"), (40, True, "b.png")])
def test_pixels_are_averaged_and_the_sum_is_one(tmp_path: Path, background: int, colours: bool, name: str) -> None:
    light = drawn(tmp_path / name, background, colours)
    expected = light[:68, :80].reshape(17, 4, 20, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(load_psf(tmp_path / name, 4), expected / expected.sum(), rtol=1e-12)


def test_noise_round_the_background_averages_out_before_it_is_cut(tmp_path: Path) -> None:
    """Cutting first would leave 0.4 deviations a pixel, 25 % of this light; of 4 x 4 means a quarter of that is left.

    Seed 0, 4 DN of noise on 5810 pixels.
    """
    light = drawn(tmp_path / "a.tif", 400, False)
    noisy = light + 400 + 4 * np.random.default_rng(0).standard_normal(light.shape)
    Image.fromarray(noisy.round().astype(np.uint16)).save(tmp_path / "n.tif")
    light[20:50, 20:60] = 1
    outside = load_psf(tmp_path / "n.tif", 4)[light[:68, :80].reshape(17, 4, 20, 4).mean(axis=(1, 3)) == 0].sum()
    cut_first = 4 * 0.399 * (70 * 83 - 30 * 40) / (6 * 40 * 100 + 24 * 4 * 60)
    assert 0 < outside < 0.4 * cut_first


def test_what_shows_no_light_is_refused(tmp_path: Path) -> None:
    Image.fromarray(np.full((50, 50), 9, dtype=np.uint8)).save(tmp_path / "flat.png")
    Image.fromarray(np.full((20, 50), 9, dtype=np.uint8)).save(tmp_path / "small.png")
    (tmp_path / "text.png").write_text("no picture")
    for name, words in (
        ("flat.png", "nothing is brighter"),
        ("small.png", "more than 32 pixels"),
        ("text.png", "does not begin as a PNG"),
        ("none.png", "cannot be read"),
    ):
        with pytest.raises(MitsimError, match=words):
            load_psf(tmp_path / name)
    drawn(tmp_path / "a.tif", 400, False)
    with pytest.raises(MitsimError, match="reduce 71"):
        load_psf(tmp_path / "a.tif", 71)
