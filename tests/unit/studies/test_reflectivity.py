"""The error of an image of shiny surfaces split by cause, and global light of an ideal camera in numpy.

One small bench for all of gloss: 16 x 16 projector pixels, 64 x 64 sensor pixels of 90 um, so that a mirror image moves
over it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import open_bench
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import parse_patterns
from mitsim.reconstruct.solver import prepare
from mitsim.report import EQUAL_PEAK
from mitsim.report.lit_scene import IdealCamera, LitScene, Unexposed
from mitsim.studies.light_studies import ERROR_SOURCES, INTERREFLECTION, PIXELS, SENSOR, separate, split
from tests.ideal_sessions import picture, shadow

pytestmark = pytest.mark.usefixtures("kept_plans")

BOARD = 0.99
"""Reflectance that counts as 1."""
CAMERA = """name = "wide"
pixel_pitch_um = 90.0
full_well_e = 1e6
read_noise_e = 5.0
quantum_efficiency = 0.6
gain_dn_per_e = 0.05
bits = 16
source = "invented for a test"
"""
GLOSS = """<bsdf type="blendbsdf"><float name="weight" value="{weight}"/>
    <bsdf type="diffuse"><spectrum name="reflectance" value="$albedo"/></bsdf>
    <bsdf type="roughconductor"><string name="material" value="none"/> <string name="distribution" value="ggx"/>
        <float name="alpha" value="{alpha}"/></bsdf></bsdf>"""
PAINT = '<bsdf type="diffuse"><spectrum name="reflectance" value="$albedo"/></bsdf>'


@pytest.fixture
def lit(small_scene: Callable[..., Path], variant: str, tmp_path: Path) -> Callable[..., LitScene]:
    """The sheet in its light, of an ``albedo``, or with another ``bsdf``."""
    camera = tmp_path / "wide.toml"
    camera.write_text(CAMERA)

    def light(albedo: float = 0.4, bsdf: str = PAINT) -> LitScene:
        path = small_scene(pitch=0.09, mask_order=8)
        text = path.read_text()
        assert PAINT in text
        path.write_text(text.replace(PAINT, bsdf))
        bench = open_bench(path, variant, camera, albedo=albedo)
        return LitScene(bench.light("dots:4", accuracy=3e-3))

    return light


def frames_of(scene: LitScene) -> Unexposed:
    """Of 16 dots, with the ideal camera's factors."""
    camera = IdealCamera(scene.bench, scene.bench.geometry.mask)
    sides = camera.calibrated(float(scene.light.apparent.board_flux.mean()))
    return Unexposed(scene, "rendered", scene.bench.family("dots:4"), sides, camera.centre, 0)


def rms(parts: dict[str, np.ndarray]) -> dict[str, float]:
    return {cause: float(np.sqrt(np.mean(np.square(part)))) for cause, part in parts.items()}


def test_brighter_paint_is_all_brightness(lit: Callable[..., LitScene]) -> None:
    """Paint of 0.6 against paint of 0.3: what is left over the sensor is what sampling leaves, below the accuracy of
    3e-3. (Planted: the twin's light left as it is, 0.3.)"""
    bright, dull = frames_of(lit(0.6)), lit(0.3)
    solution, found = split(bright, dull, bright.seconds(EQUAL_PEAK))
    parts = rms(found)
    # The truth's standard error is below 1e-4 in most pixels; prints are even.
    np.testing.assert_allclose(found[PIXELS], 0.3 / BOARD, atol=2e-3)
    assert parts[SENSOR] < 3e-3 and parts[INTERREFLECTION] < 1e-9
    assert tuple(found) == ERROR_SOURCES
    np.testing.assert_allclose(sum(found.values()), solution.image - dull.truth, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [0.3, 0.1])
def test_a_highlight_has_the_brightness_of_its_lobe(lit: Callable[..., LitScene], alpha: float) -> None:
    """Where the surface mirrors the projector into the camera, at x = 30 mm here, GGX without Fresnel is f = 1 / (4 pi
    alpha^2) but for cosines and shadowing of 4.3 degrees, 1 %; half vectors turn by a 400th of a millimetre, so the
    pixel of 7.5 mm beside that place has a mean of (1 + 2.3e-4 / alpha^2)^-2 of it. Apparent reflectance is (1 - w) rho
    + w pi f. (Planted: w for 1 - w.)"""
    weight, turned = 0.05, 2 * (7.5**2 / 3) / 400**2
    scene, matt = lit(bsdf=GLOSS.format(weight=weight, alpha=alpha)), lit(0.4 * (1 - weight))
    lobe = weight / (4 * alpha**2) * (1 + turned / alpha**2) ** -2
    assert scene.truth.max() == pytest.approx(((1 - weight) * 0.4 + lobe) / BOARD, rel=0.015)
    frames = frames_of(scene)
    _, found = split(frames, matt, frames.seconds(EQUAL_PEAK))
    assert found[PIXELS].max() == pytest.approx(lobe / BOARD, rel=0.015)
    row, column = np.unravel_index(scene.truth.argmax(), scene.truth.shape)
    # The window's columns run from x = 60 to -60 mm; 30 mm lies between columns 3 and 4.
    assert row in (7, 8) and column in (3, 4)


N = 32
FACTOR = shadow(n=N)


@pytest.mark.parametrize("patterns", ["dots:4", "dots:7", "dots:2x4"])
def test_light_that_is_linear_between_dots_is_found_exactly(patterns: str) -> None:
    """A plane that rises along both axes is linear between any nodes. (Planted: the part of lit pixels not taken off;
    half of the common light.)"""
    family, scene = parse_patterns(patterns, N), picture(n=N)
    sides = family.left.astype(np.float64), family.right.astype(np.float64)
    rows, columns = np.mgrid[:N, :N] / N
    haze = FACTOR @ (0.3 + 0.2 * rows + 0.1 * columns - 0.15 * rows * columns) @ FACTOR.T
    frames = [FACTOR @ (family.light(shot) * scene) @ FACTOR.T + haze for shot in family.shots]
    model = prepare(FACTOR, FACTOR, *sides)
    whole = model.accumulator(family.measurements(frames)).sum
    common = separate(model, (FACTOR, FACTOR), sides, whole, np.sum(frames, axis=0))
    np.testing.assert_allclose(common, haze, atol=1e-7 * haze.max())
    rest = model.accumulator(family.measurements(frame - common for frame in frames))
    np.testing.assert_allclose(model.solve(rest, 0).image, scene, atol=1e-6)


def test_uniform_light_shows_no_global_light() -> None:
    """Global light looks like an image there."""
    family = parse_patterns("uniform", N)
    frame, sides = FACTOR @ picture(n=N) @ FACTOR.T, (family.left.astype(float), family.right.astype(float))
    with pytest.raises(MitsimError, match="use dots:K with K of 2"):
        separate(prepare(FACTOR, FACTOR, *sides), (FACTOR, FACTOR), sides, np.ones((N, N)), frame)
