"""Twins of a FlatCam's captures: codes, noise and causes of simulated frames come out as they were set."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import DEFAULT_VARIANT
from mitsim.core.errors import MitsimError
from mitsim.reconstruct.solver import centre_frame
from mitsim.studies.twin_capture import CROP, TURN_DEG, Code, Measured, learn_codes, noise_of, read_code, turn_plane
from mitsim.studies.twin_files import TwinFiles
from mitsim.studies.twin_frame import CAUSES, compare, render

SCALES, SCENE, SENSOR = (0.6, 0.7), 40, (80, 90)
GAIN, LIGHT = 0.1, 600.0
"""DN an electron, and mean light [DN]: as the real captures'."""


def smooth(draws: np.random.Generator, *shape: int, width: float = 1.5) -> FloatArray:
    values = ndimage.gaussian_filter(draws.standard_normal(shape), width)
    return np.asarray(values / values.std())


def made_codes(seed: int = 3) -> tuple[Code, Code]:
    draws = np.random.default_rng(seed)
    left, right = (
        Code(smooth(draws, sensor + int(scale * (SCENE - 1)) + 1), scale, SCENE)
        for sensor, scale in zip(SENSOR, SCALES, strict=True)
    )
    return left, right


def made(seed: int, codes: tuple[Code, Code], noise: float = 1.0) -> Measured:
    """A frame of a made scene, with white noise of the standard deviation ``noise`` [DN]; the light's is 13."""
    draws = np.random.default_rng(seed)
    scene = np.clip(0.3 + 0.3 * smooth(draws, SCENE, SCENE, width=1.0), 0, 1)
    clear = centre_frame(codes[0].factor @ scene @ codes[1].factor.T)
    level = LIGHT + 13 * clear / clear.std() + noise * draws.standard_normal(SENSOR)
    gain = 13 / clear.std()
    return Measured("made", level, np.full(SENSOR, noise**2), centre_frame(level) / gain, scene, GAIN, 0.0)


def test_codes_are_learned_from_known_scenes_and_predict_another_frame() -> None:
    """From four frames without noise; of a random start, on the third turn."""
    codes = made_codes()
    found = learn_codes([made(seed, codes, 0.0) for seed in range(4)], SCALES)
    held = made(9, codes, 0.0)
    predicted = found[0].factor @ held.scene @ found[1].factor.T
    assert np.linalg.norm(predicted - held.frame) < 0.05 * np.linalg.norm(held.frame)


@pytest.mark.parametrize("reverse", [False, True])
def test_a_code_is_read_from_a_factor(reverse: bool) -> None:
    """Scale to a hundredth of a pixel over the scene, whichever way the scene runs."""
    code = made_codes()[0]
    found, flipped, rest = read_code(code.factor[:, ::-1] if reverse else code.factor)
    assert flipped is reverse and rest < 1e-4
    assert found.scale == pytest.approx(code.scale, abs=1e-3)
    assert np.linalg.norm(found.factor - code.factor) < 1e-2 * np.linalg.norm(code.factor)


def test_a_factor_without_shifts_is_refused() -> None:
    with pytest.raises(MitsimError, match="not one shadow, shifted"):
        read_code(np.outer(smooth(np.random.default_rng(1), 80), np.linspace(1, 2, 40)))


def test_noise_of_planes_is_that_of_their_photons() -> None:
    """Of electrons by Poisson's law, and reading: gain to 5 %, over blocks whose light differs threefold."""
    draws = np.random.default_rng(0)
    light = np.linspace(200, 700, 400)[:, None] * np.ones(400) / GAIN
    planes = [GAIN * (draws.poisson(light * part) + 20 * draws.standard_normal(light.shape)) for part in (0.5, 1.0)]
    gain, dark = noise_of(planes)
    assert gain == pytest.approx(GAIN, rel=0.05)
    assert dark == pytest.approx((GAIN * 20) ** 2, abs=2.0)


def test_a_plane_is_turned_as_the_cameras_program_turns_it() -> None:
    """scipy's rotation, cut. (Planted: the other way round.)"""
    plane = smooth(np.random.default_rng(2), 512, 640, width=3.0)
    theirs = ndimage.rotate(plane, TURN_DEG, reshape=False, order=1, mode="nearest")[CROP]
    assert np.abs(turn_plane(plane) - theirs).max() < 1e-9


def test_a_rendered_frame_is_the_product_of_its_factors(tmp_path: Path) -> None:
    """Mask drawn from codes, sheet, light and camera are those of the model: 3 % of the coded part, which is some per
    cent of all light. (Planted: the mask beside its place by the other sign: 0.19 of a FlatCam's frame.)"""
    codes, measured = made_codes(), made(0, made_codes())
    electrons = render(measured.scene, codes, tmp_path, DEFAULT_VARIANT)
    model = codes[0].factor @ measured.scene @ codes[1].factor.T
    seen = centre_frame(electrons)
    seen *= np.vdot(model, seen) / np.vdot(seen, seen)
    assert electrons.shape == SENSOR
    assert np.linalg.norm(seen - model) < 0.05 * np.linalg.norm(model)


def cause_of(measured: Measured, codes: tuple[Code, Code], monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """Parts by cause, where the simulation is the model itself."""
    monkeypatch.setattr("mitsim.studies.twin_frame.draw_noise", lambda measured, seed: np.zeros(SENSOR))
    electrons = 1000 + codes[0].factor @ measured.scene @ codes[1].factor.T
    return compare(measured, codes, electrons, 0).parts


def test_causes_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame of the model with noise alone has no other cause; a smooth field, another scale and another code are
    found as such. (Planted: noise that a fit takes left out.)"""
    codes = made_codes()
    held = made(5, codes, 0.0)
    draws = np.random.default_rng(8)
    noise = 0.3 * held.frame.std()

    def frame(values: FloatArray) -> Measured:
        shown = values + noise * draws.standard_normal(SENSOR)
        return replace(held, frame=centre_frame(shown), level=shown, variance=np.full(SENSOR, noise**2))

    clean = cause_of(frame(held.frame), codes, monkeypatch)
    assert tuple(clean) == CAUSES and sum(clean.values()) == pytest.approx(1)
    assert all(abs(clean[name]) < 0.02 for name in ("scale", "smooth field", "mask's code", "scene's image", "rest"))
    assert clean["noise"] == pytest.approx(0.09 / 1.09, rel=0.1)
    brighter = cause_of(frame(1.5 * held.frame), codes, monkeypatch)
    assert brighter["scale"] == pytest.approx(0.25 / 2.25, rel=0.15)
    ramp = np.outer(np.linspace(-1, 1, SENSOR[0]), np.linspace(-1, 1, SENSOR[1]))
    field = cause_of(frame(held.frame * (1 + 0.5 * ramp) + held.frame.std() * ramp), codes, monkeypatch)
    assert field["smooth field"] > 5 * abs(field["rest"]) and field["smooth field"] > 0.05
    other = made_codes(11)
    moved = tuple(replace(a, values=a.values + 0.4 * b.values) for a, b in zip(codes, other, strict=True))
    code = cause_of(frame(moved[0].factor @ held.scene @ moved[1].factor.T), codes, monkeypatch)
    assert code["mask's code"] > 3 * max(abs(code[name]) for name in ("smooth field", "scene's image", "rest"))


def test_files_are_found_or_a_line_says_where_they_are_from(tmp_path: Path) -> None:
    with pytest.raises(MitsimError, match=r"--data FOLDER with flatcam/fc_6\.png.*flatnet"):
        TwinFiles.find(None)
    with pytest.raises(MitsimError, match="no such folder"):
        TwinFiles.find(tmp_path / "none")
    with pytest.raises(MitsimError, match="has no captures"):
        TwinFiles.find(tmp_path)
    (tmp_path / "flatcam").mkdir()
    for name in ("fc_6.png", "rec_6.png", "fc_7.png"):
        (tmp_path / "flatcam" / name).touch()
    with pytest.raises(MitsimError, match=r"rec_7\.png: cannot be read"):
        TwinFiles.find(tmp_path)
    (tmp_path / "flatcam" / "fc_7.png").unlink()
    with pytest.raises(MitsimError, match="give --calibration CAL"):
        TwinFiles.find(tmp_path)
    assert list(TwinFiles.find(tmp_path, tmp_path).captures) == ["fc_6"]
