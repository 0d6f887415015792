"""Images of a run by a point spread function, from Python and from the command line: frames, files, refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import mitsim as ms
from mitsim.cli import app
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.exr import read_frame
from mitsim.core.images import lightness, read_image
from mitsim.core.manifests import Digital, Patterns, RunHead, RunManifest
from mitsim.core.runs import Capture, Recorder, frame_name
from mitsim.devices.patterns import parse_patterns
from mitsim.reconstruct.point_spread import ShiftedLight

N = 12


def light_of_a_point() -> np.ndarray:
    light = np.random.default_rng(5).random((40, 44)) ** 12
    light[:15], light[-15:], light[:, :15], light[:, -15:] = 0, 0, 0, 0
    return light / light.sum()


def capture(name: str, sensor: tuple[int, int], saturation: float | None = None) -> tuple[Capture, np.ndarray]:
    """Frames of a scene of two numbers, and the scene."""
    family, memory, psf = parse_patterns(name, N), Recorder(), light_of_a_point()
    rng = np.random.default_rng(1)
    patterns = None if name == "uniform" else (family.left.astype(float), family.right.astype(float))
    light = ShiftedLight(psf, sensor, patterns)
    scene = np.where(np.arange(light.scene[0])[:, None] % 4 < 2, 2000.0, 0.0) * np.ones(light.scene)
    for index, frame in enumerate(light.image_of(scene)):
        memory.write_frame(index, {"DN": rng.poisson(np.maximum(frame, 0) + 10).astype(np.uint32)}, {})
    files = [frame_name(index) for index in range(light.count)]
    head = RunHead.of({"seed": 2})
    digital = Digital(
        exposure_s=1.0, gain_dn_per_e=1.0, black_level_dn=10.0, dark_current_e_per_s=0.0, saturation_dn=saturation
    )
    manifest = RunManifest(
        configuration=head.configuration,
        configuration_sha256=head.configuration_sha256,
        camera={"name": "diffuser"},
        digital=digital,
        patterns=Patterns.of(family, files),
    )
    return memory.finish(manifest), scene[light.window]


def test_dots_find_the_scene_and_uniform_light_all_that_the_sensor_sees() -> None:
    """To the frames' rounding. (Planted: frames in columns' order; patterns passed over.)"""
    shots, scene = capture("dots:3", (30, 31))
    for method, lam in (("tikhonov", 1e-7), ("nonnegative", 1e-7), ("tv", 1e-3)):
        found = ms.reconstruct_psf(shots, light_of_a_point(), lam=lam, method=method)
        assert found.ok, str(found.status)
        assert np.sqrt(np.mean(np.square(found.image - scene))) < 80
        assert found.rank is None and found.uncertainty is None and found.condition_whole is None
    with pytest.raises(MitsimError, match="under uniform light alone"):
        ms.reconstruct_psf(shots, light_of_a_point())
    shots, _ = capture("uniform", (60, 62))
    found = ms.reconstruct_psf(shots, light_of_a_point(), method="nonnegative")
    assert found.image.shape == (60, 62) and found.image.min() >= 0 and found.lam > 0
    reduced = ms.reconstruct_psf(shots, light_of_a_point(), reduce=2)
    assert reduced.image.shape == (30, 31)


def test_saturated_frames_are_flagged() -> None:
    shots, _ = capture("uniform", (60, 62), saturation=100.0)
    found = ms.reconstruct_psf(shots, light_of_a_point())
    assert not found.ok and "readings are at the full well" in str(found.status)


def test_what_is_no_light_is_refused() -> None:
    shots, _ = capture("uniform", (60, 62))
    for wrong in (np.zeros((3, 3)), np.ones(3)):
        with pytest.raises(MitsimError):
            ms.reconstruct_psf(shots, wrong)
    with pytest.raises(MitsimError, match="reduce by less than 61"):
        ms.reconstruct_psf(shots, np.ones((99, 99)), reduce=61)
    for reduce in (0, True, 2.5, 1025):
        with pytest.raises(ArgumentError, match="give a whole number"):
            ms.reconstruct_psf(shots, light_of_a_point(), reduce=reduce)  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match="comes with a calibration"):
        ms.reconstruct_psf(shots, light_of_a_point(), method="markov")


def test_the_command_line_writes_an_image_and_ends_with_1_where_it_is_not_converged(tmp_path: Path) -> None:
    """And a picture of it whose white is the image's largest number. (Planted: 1, as of images by a calibration.)"""
    shots, _ = capture("uniform", (60, 62))
    run = shots.save(tmp_path / "run")
    np.save(tmp_path / "psf.npy", light_of_a_point())

    def call(*words: str) -> tuple[int, dict[str, Any]]:
        done = CliRunner().invoke(app, ["reconstruct", str(run), *words, "--json"], standalone_mode=False)
        if done.exception:
            assert isinstance(done.exception, MitsimError), done.exception
            return 2, {}
        return done.return_value, json.loads(done.stdout)

    psf = "--psf", str(tmp_path / "psf.npy")
    status, found = call(*psf, "--method", "nonnegative", "-o", str(tmp_path / "image"))
    assert status == 0 and found["rank"] is None and found["objective"] > 0 and found["relative_gap"] is None
    image = read_frame(tmp_path / "image" / "image.exr")[0]["reflectance"]
    shown = read_image(tmp_path / "image" / "image.png")
    assert np.abs(shown - 255 * lightness(image / image.max())).max() < 0.51, "rounded"
    assert found["white"] == pytest.approx(image.max())
    result = json.loads((tmp_path / "image" / "result.json").read_text())
    assert result["inputs"].keys() == {"run", "psf", "reduce", "lambda", "method"} and result["iterations"] > 0
    status, found = call(*psf, "--method", "tv", "--bounds", "0:", "--lambda", "1e-9", "-o", str(tmp_path / "tv"))
    assert (status == 1) == str(found["status"]).startswith("Not converged")
    assert json.loads((tmp_path / "tv" / "result.json").read_text())["inputs"]["bounds"] == [0.0, None]
    status, found = call(*psf, "--method", "tv", "--iterations", "6", "-o", str(tmp_path / "short"))
    assert status == 1 and found["iterations"] == 6 and found["status"].startswith("Not converged")
    assert json.loads((tmp_path / "short" / "result.json").read_text())["inputs"]["iterations"] == 6
    refused = [
        (*psf, "--iterations", "9"),
        (),
        ("--reduce", "2"),
        (*psf, "--calibration", "x"),
        (*psf, "--focus", "auto"),
        (*psf, "--bounds", "0:1"),
    ]
    refused += [("--psf", str(tmp_path / "none.npy")), (*psf, "--method", "tv", "--bounds", "1:0")]
    refused += [(*psf, "--bounds", "x", "--method", "tv"), (*psf, "--chart", "x")]
    for words in refused:
        assert call(*words, "-o", str(tmp_path / "no"))[0] == 2 and not (tmp_path / "no").exists(), words
