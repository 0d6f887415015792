"""Twins of a FlatCam's captures: frames, noise and causes of simulated captures come out as they were set."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import DEFAULT_VARIANT
from mitsim.core.errors import MitsimError
from mitsim.reconstruct.known_pictures import PLANES
from mitsim.reconstruct.shifted_codes import Codes, Side
from mitsim.reconstruct.solver import centre_frame
from mitsim.studies.twin_capture import Learned, Measured, Recipe, draw_noise, noise_of, read_captures
from mitsim.studies.twin_files import TwinFiles
from mitsim.studies.twin_frame import CAUSES, compare, render

SCALES, SCENE, SENSOR = (0.6, 0.7), 40, (80, 90)
GAIN, LIGHT = 0.1, 600.0
"""DN an electron, and mean light [DN]: as the real captures'."""
PLANE = "gb"


def smooth(draws: np.random.Generator, *shape: int, width: float = 1.5) -> FloatArray:
    values = ndimage.gaussian_filter(draws.standard_normal(shape), width)
    return np.asarray(values / values.std())


def codes_of(values: tuple[FloatArray, FloatArray]) -> Codes:
    """Of one code a side, each of its ``values``."""
    left, right = (Side(sensor, SCENE, scale, 1, True) for sensor, scale in zip(SENSOR, SCALES, strict=True))
    nothing = 0.0, 0.0
    numbers = values[0][None], values[1][None]
    return Codes((left, right), numbers, dict.fromkeys(PLANES, 1.0), np.zeros(1), 1.0, nothing, nothing, nothing)


def made_codes(seed: int = 3) -> Codes:
    draws = np.random.default_rng(seed)
    lengths = (Side(sensor, SCENE, scale, 1, True).length for sensor, scale in zip(SENSOR, SCALES, strict=True))
    left, right = (smooth(draws, length) for length in lengths)
    return codes_of((left, right))


def frame_of(codes: Codes, scene: FloatArray) -> FloatArray:
    left, right = codes.factors(PLANES[PLANE], PLANE)
    return np.asarray(left @ scene @ right.T)


def made(seed: int, codes: Codes) -> Measured:
    """A frame of a made scene without noise."""
    scene = np.clip(0.3 + 0.3 * smooth(np.random.default_rng(seed), SCENE, SCENE, width=1.0), 0, 1)
    return Measured(f"fc_{seed}", PLANE, LIGHT + frame_of(codes, scene), np.zeros(SENSOR), scene, GAIN, 0.0)


def capture(folder: Path, values: np.ndarray, name: str = "fc_6") -> tuple[Path, Path]:
    """Files of a capture and of an image."""
    Image.fromarray(values).save(folder / f"{name}.png")
    image = np.random.default_rng(1).integers(0, 255, (256, 256, 3), dtype=np.uint8)
    Image.fromarray(image).save(folder / f"rec_{name}.png")
    return folder / f"{name}.png", folder / f"rec_{name}.png"


def test_planes_of_a_capture_are_its_own(tmp_path: Path) -> None:
    """Numbers in the high bits, each plane of another light, turned and cut; the scene is of the plane's colour.
    (Planted: gb and gr changed places.)"""
    light = np.array([[100, 200], [300, 400]])  # b gb, gr r
    values = np.tile(light, (512, 640)).astype(np.uint16)
    values += np.random.default_rng(0).integers(0, 20, values.shape, dtype=np.uint16)
    found = {each.plane: each for each in read_captures({"fc_6": capture(tmp_path, values * 64)}, 0)}
    means = {name: each.level.mean() for name, each in found.items()}
    assert means == pytest.approx({"b": 109.5, "gb": 209.5, "gr": 309.5, "r": 409.5}, abs=0.1)
    assert all(each.frame.shape == (500, 620) for each in found.values())
    image = np.array(Image.open(tmp_path / "rec_fc_6.png"))
    assert np.array_equal(found["b"].scene, image[..., 2] / 255)


@pytest.mark.parametrize(
    ("values", "line"),
    [
        (np.zeros((600, 800), dtype=np.uint16), r"capture .*fc_6\.png: is 600 x 800; give the raw frame, 1024 x 1280$"),
        (np.arange(1024 * 1280, dtype=np.uint32).reshape(1024, 1280).astype(np.uint16), "no light in numbers of 10"),
        (np.full((1024, 1280), 640, dtype=np.uint16), r"holds 640 to 640, no light"),
        (np.zeros((1024, 1280, 3), dtype=np.uint8), "capture .*: "),
    ],
    ids=["size", "bits", "even", "colour"],
)
def test_what_is_no_capture_is_refused_in_a_line(tmp_path: Path, values: np.ndarray, line: str) -> None:
    with pytest.raises(MitsimError, match=line) as said:
        read_captures({"fc_6": capture(tmp_path, values)}, 0)
    assert "\n" not in str(said.value)


def test_an_image_of_another_size_is_refused(tmp_path: Path) -> None:
    frame, image = capture(tmp_path, np.tile(np.arange(1280, dtype=np.uint16) % 1000, (1024, 1)))
    for mode, size, line in (
        ("RGB", 200, "is 200 x 200 x 3; give the authors', 256 x 256"),
        ("L", 256, "is 256 x 256;"),
    ):
        Image.new(mode, (size, size)).save(image)
        with pytest.raises(MitsimError, match=line):
            read_captures({"fc_6": (frame, image)}, 0)


def test_codes_are_learned_from_known_scenes_and_predict_another_frame() -> None:
    """From six frames without noise, scenes given turned: the orientation is found, and 95 % of another frame are
    predicted. (Planted: the scene that is predicted left as it is given.)"""
    codes = made_codes()
    planes = [made(seed, codes) for seed in range(6)]
    given = [replace(each, scene=each.scene[::-1, ::-1].copy()) for each in planes]
    learned = Learned.of(given)
    held = made(9, codes)
    seen = learned.see(replace(held, scene=held.scene[::-1, ::-1].copy()))
    assert learned.pose.orientation == "turned" and learned.pose.certain
    left = held.frame - frame_of(learned.codes, seen.scene)
    assert np.square(left).sum() < 0.05 * np.square(held.frame).sum()


def test_noise_of_planes_is_that_of_their_photons() -> None:
    """Of electrons by Poisson's law, and reading: gain to 5 %, over blocks whose light differs threefold; what is drawn
    by these numbers has the variance of the plane's light. (Planted: reading left out of what is drawn.)"""
    draws = np.random.default_rng(0)
    light = np.linspace(200, 700, 400)[:, None] * np.ones(400) / GAIN
    planes = [GAIN * (draws.poisson(light * part) + 20 * draws.standard_normal(light.shape)) for part in (0.5, 1.0)]
    gain, dark = noise_of(planes)
    assert gain == pytest.approx(GAIN, rel=0.05)
    assert dark == pytest.approx((GAIN * 20) ** 2, abs=2.0)
    drawn = draw_noise(planes[1], GAIN, (GAIN * 20) ** 2, 0, "made")
    for rows in np.array_split(np.arange(400), 4):
        expected = GAIN**2 * (light[rows].mean() + 20**2)
        assert drawn[rows].var() == pytest.approx(expected, rel=5 * np.sqrt(2 / drawn[rows].size))


def test_noise_is_turned_and_cut_as_frames_are() -> None:
    """White noise between four pixels: of the variance that bilinear weights leave, between 1 and a quarter."""
    noise = np.random.default_rng(0).standard_normal((512, 640))
    placed = Recipe.load().place(noise)
    assert placed.shape == (500, 620) and 0.3 < placed.var() < 0.6


@pytest.mark.parametrize("plane", ["gb", "r"])
def test_a_rendered_frame_is_the_product_of_its_factors(tmp_path: Path, plane: str) -> None:
    """Mask drawn from codes, sheet, light and camera are those of the model, half a pixel on for the red plane: 5 % of
    the coded part, which is some per cent of all light. (Planted: the mask beside its place by the other sign; the
    plane's half pixel left out: 0.2.)"""
    codes = made_codes()
    measured = replace(made(0, codes), plane=plane)
    electrons = render(measured, codes, tmp_path, DEFAULT_VARIANT)
    left, right = codes.factors(PLANES[plane], plane)
    model = left @ measured.scene @ right.T
    seen = centre_frame(electrons)
    seen *= np.vdot(model, seen) / np.vdot(seen, seen)
    assert electrons.shape == SENSOR
    assert np.linalg.norm(seen - model) < 0.05 * np.linalg.norm(model)


# -------- Causes that are planted


def parts_of(measured: Measured, codes: Codes, frame: FloatArray, noise: float, seed: int) -> dict[str, float]:
    """Energies by cause of a ``frame`` with ``noise`` of that standard deviation, over the clear one's energy, where
    the simulation is the model itself."""
    draws = np.random.default_rng(seed)
    level = LIGHT + frame + noise * draws.standard_normal(SENSOR)
    drawn = centre_frame(noise * np.random.default_rng(seed + 1000).standard_normal(SENSOR))
    shown = replace(measured, level=level, noise=drawn)
    found = compare(shown, codes, 1000 + frame_of(codes, measured.scene), measured.scene).parts
    assert tuple(found) == CAUSES and sum(found.values()) == pytest.approx(1)
    whole = np.square(level - level.mean()).sum() / np.square(measured.frame).sum()
    return {name: part * whole for name, part in found.items()}
