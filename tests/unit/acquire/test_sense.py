"""`mitsim sense`: an image of irradiance or radiance behind a camera's sensor."""

import math
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsim.acquire.sense import read_image, sense
from mitsim.bench.request import Irradiance, check_ending
from mitsim.core.configuration import shipped_path
from mitsim.core.errors import MitsimError
from mitsim.core.exr import read_frame, write_frame
from mitsim.devices.sensor import load_sensor
from mitsim.sensor import chain
from tests.invented import sensor

CAMERA = sensor(
    full_well_e=8000.0, read_noise_e=3.0, gain_dn_per_e=0.47, black_level_dn=200.0, bits=12, quantum_efficiency=0.5
)
IMAGE = np.linspace(0, 2e-6, 60 * 80).reshape(60, 80)


def test_an_image_is_exposed_and_read_as_a_capture_s_frame() -> None:
    """Auto exposure fills 0.8 of the well at the brightest pixel; squared z-scores of all 4800 pixels, 5 deviations."""
    frame = sense(IMAGE, CAMERA, Irradiance(seed=3))
    assert frame.exposure_s == chain.exposure_for_peak(2e-6, 0.8, CAMERA, 550.0)
    assert frame.electrons.max() == pytest.approx(6400, rel=1e-12)
    mean, variance = chain.frame_moments(frame.electrons, frame.exposure_s, CAMERA)
    squares = float((np.square(frame.digital - mean) / variance).sum())
    assert abs(squares - IMAGE.size) < 5 * math.sqrt(2 * IMAGE.size)
    assert np.array_equal(frame.digital, sense(IMAGE, CAMERA, Irradiance(seed=3)).digital)
    assert not np.array_equal(frame.digital, sense(IMAGE, CAMERA, Irradiance(seed=4)).digital)
    assert not frame.warnings and frame.summary()["shape"] == [60, 80]


def test_a_lens_of_f_number_n_images_radiance_l_as_pi_l_over_4_n_squared() -> None:
    behind = sense(IMAGE, CAMERA, Irradiance(f_number=2.0, exposure=0.1)).electrons
    direct = sense(math.pi / 16 * IMAGE, CAMERA, Irradiance(exposure=0.1)).electrons
    np.testing.assert_allclose(behind, direct, rtol=1e-12)
    with pytest.raises(MitsimError, match="f_number"):
        Irradiance(f_number=0.1)


@pytest.mark.parametrize("ending", [".png", ".exr", ".npy"])
def test_numbers_are_written_whole_in_every_format(tmp_path: Path, ending: str) -> None:
    frame = sense(IMAGE, CAMERA)
    path = frame.save(tmp_path / f"frame{ending}")
    if ending == ".exr":
        channels, facts = read_frame(path)
        numbers = channels["DN"]
        assert facts["exposure_s"] == frame.exposure_s and set(channels) == {"DN", "electrons"}
    else:
        numbers = np.load(path) if ending == ".npy" else np.asarray(Image.open(path))
    assert np.array_equal(numbers, frame.digital)


def test_images_of_other_renderers_are_read(tmp_path: Path) -> None:
    parts = {name: np.full((2, 3), value, np.float32) for name, value in (("R", 1.0), ("G", 2.0), ("B", 4.0))}
    write_frame(tmp_path / "rgb.exr", parts, {})
    light, notes = read_image(tmp_path / "rgb.exr")
    np.testing.assert_allclose(light, 0.2126 + 2 * 0.7152 + 4 * 0.0722, rtol=1e-6)
    assert "luminance" in notes[0] and read_image(tmp_path / "rgb.exr", "G")[0][0, 0] == 2
    write_frame(tmp_path / "render.exr", {"Y": parts["R"], "error.Y": parts["B"]}, {})
    assert read_image(tmp_path / "render.exr")[0].max() == 1 and not read_image(tmp_path / "render.exr")[1]
    np.save(tmp_path / "image.npy", IMAGE)
    assert np.array_equal(read_image(tmp_path / "image.npy")[0], IMAGE)


def test_what_is_no_image_is_refused_in_a_line(tmp_path: Path) -> None:
    write_frame(tmp_path / "two.exr", {name: np.ones((2, 2), np.float32) for name in "ab"}, {})
    for name, channel, message in (
        ("two.exr", None, "a, b"),
        ("two.exr", "c", "no channel 'c'"),
        ("x.jpg", None, "OpenEXR"),
    ):
        with pytest.raises(MitsimError, match=message):
            read_image(tmp_path / name, channel)
    (tmp_path / "bad.npy").write_text("no array")
    with pytest.raises(MitsimError, match="cannot be read: damaged"):
        read_image(tmp_path / "bad.npy")
    for values in (np.full((2, 2), 1 + 1j), np.full((2, 2), "1")):  # (planted: imaginary parts dropped)
        np.save(tmp_path / "bad.npy", values)
        with pytest.raises(MitsimError, match="rows x columns of numbers are needed"):
            read_image(tmp_path / "bad.npy")
    with pytest.raises(MitsimError, match="an array has no channel 'R'"):
        read_image(tmp_path / "bad.npy", "R")
    for image in (np.array([[1.0, -1.0]]), np.array([[math.nan]]), np.ones(3), np.ones((0, 2))):
        with pytest.raises(MitsimError, match="image"):
            sense(image, CAMERA)
    for scale in (1e300, 1e-30):  # (planted: exposures of 1e-303 s taken)
        with pytest.raises(MitsimError, match=r"exposures are 1e-12 to .*; check the image's unit"):
            sense(np.full((2, 2), scale), CAMERA)
    with pytest.raises(MitsimError, match="quantum_efficiency"):
        sense(IMAGE, sensor(quantum_efficiency=None))
    with pytest.raises(MitsimError, match="wavelength"):
        sense(IMAGE, CAMERA, Irradiance(wavelength=0.0))
    with pytest.raises(MitsimError, match="mosaic BGGR of colour filters, but the image has one channel"):
        sense(IMAGE, load_sensor(shipped_path("calibration", "ov5647.toml")))


def test_a_png_holds_16_bits(tmp_path: Path) -> None:
    for model in (sensor(bits=None), sensor(bits=16, binning=2)):
        with pytest.raises(MitsimError, match="beyond 16 bits"):
            check_ending(tmp_path / "x.png", model)
    with pytest.raises(MitsimError, match="ends in"):
        check_ending(tmp_path / "x.jpg", sensor())


def test_an_array_that_claims_is_held_against_its_file(tmp_path: Path) -> None:
    """It is read as other pictures are (tests/unit/core/test_imagefile.py). (Planted: numpy's reader.)"""
    np.save(tmp_path / "image.npy", IMAGE)
    os.truncate(tmp_path / "image.npy", 1 << 40)
    with pytest.raises(MitsimError, match="and 1099511627648 follow"):
        read_image(tmp_path / "image.npy")
