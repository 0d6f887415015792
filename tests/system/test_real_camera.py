"""Frames of a real camera: folders made by hand with no more than docs/real_camera.md asks for reconstruct as well.

The 'real camera' is numpy: frames of the paper's model with factors of its own, rounded to digital numbers. No part of
mitsim's renderer or sensor is in it, so that scale, sign and order of the documented keys are checked independently.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.exr import read_frame, write_frame
from tests.real_session import RealSession, write_image
from tests.system.refusals import Call, Refused, mentions
from tests.system.test_contract import assert_said_once

CAMERA = {"name": "bench 3"}
DIGITAL = {"exposure_s": 0.02, "black_level_dn": 160, "gain_dn_per_e": 0.125, "dark_current_e_per_s": 4000}
ROWS, COLUMNS, N, K = 40, 36, 12, 3


class Bench3:
    """A camera that mitsim has never seen: 40 x 36 pixels, scene of 12 x 12."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        rng = np.random.default_rng(20)
        self.left = rng.random((ROWS, N)) * 300
        self.right = rng.random((COLUMNS, N)) * 300
        self.scene = rng.random((N, N))

    def digital_numbers(self, pattern: np.ndarray) -> np.ndarray:
        """What the camera reads out, (40, 36)."""
        rate = self.left @ (pattern * self.scene) @ self.right.T + DIGITAL["dark_current_e_per_s"]
        electrons = rate * DIGITAL["exposure_s"]
        return np.rint(electrons * DIGITAL["gain_dn_per_e"] + DIGITAL["black_level_dn"])

    def run(self, signed: bool) -> Path:
        """A RUN folder with shifting dots, or with Hadamard stripes as pairs of which the negative half comes first."""
        folder = self.folder / "run"
        folder.mkdir()
        columns = np.array([[1, 1], [1, -1]])[np.arange(N) % 2] if signed else np.eye(K)[np.arange(N) % K]
        captures = []
        for i in range(columns.shape[1]):
            for j in range(columns.shape[1]):
                pattern = np.outer(columns[:, i], columns[:, j])
                for sign in (-1, 1) if signed else (0,):
                    name = f"shot {i}{j}{sign}.exr"
                    light = (1 + sign * pattern) / 2 if sign else pattern
                    write_frame(folder / name, {"DN": self.digital_numbers(light).astype(np.uint32)}, {})
                    captures.append({"file": name, "row": i, "column": j, "sign": sign})
        patterns = {"P_L": columns.tolist(), "P_R": columns.tolist(), "captures": captures}
        self._manifest(folder, kind="capture", digital=DIGITAL, patterns=patterns)
        return folder

    def calibration(self) -> Path:
        """A CAL folder with the camera's true factors."""
        folder = self.folder / "cal"
        folder.mkdir()
        for name, factor in (("left", self.left), ("right", self.right)):
            write_frame(folder / f"{name}.exr", {"factor": factor.astype(np.float32)}, {})
        self._manifest(folder, kind="calibration")
        return folder

    @staticmethod
    def _manifest(folder: Path, **sections: object) -> None:
        (folder / "manifest.json").write_text(json.dumps({"status": "complete", "camera": CAMERA, **sections}))


@pytest.mark.parametrize("signed", [False, True], ids=["dots", "signed pairs"])
def test_a_folder_made_by_hand_reconstructs(call: Call, tmp_path: Path, signed: bool) -> None:
    bench = Bench3(tmp_path)
    found = call("reconstruct", bench.run(signed), "--calibration", bench.calibration(), "--json").payload
    assert found["psnr"] is None and found["ssim"] is None, "nobody knows the truth"
    assert found["rank"] == N * N and found["output"] == str(tmp_path / "run" / "reconstruction")
    image = read_frame(tmp_path / "run" / "reconstruction" / "image.exr")[0]["reflectance"]
    # Rounding to whole digital numbers is the only noise; a wrong dark current, black level, exposure, gain or sign is
    # at least ten times as much.
    assert np.abs(image - bench.scene).max() < 3e-3
    text = call("reconstruct", tmp_path / "run", "--calibration", tmp_path / "cal")
    assert text.code == 0 and "PSNR" not in text.out


def test_the_example_of_the_documentation(call: Call, tmp_path: Path) -> None:
    """The manifest in docs/real_camera.md can be read."""
    text = (Path(__file__).parents[2] / "docs" / "real_camera.md").read_text(encoding="utf-8")
    section = text[text.index("## A real camera") :]
    manifest = section[section.index("```json") + 7 :]
    run, calibration = tmp_path / "run", tmp_path / "cal"
    for folder in (run, calibration):
        folder.mkdir()
    (run / "manifest.json").write_text(manifest[: manifest.index("```")])
    factor = np.arange(1, 9).reshape(4, 2) ** 2.0
    truth = np.array([[0.2, 0.9], [0.5, 0.4]])
    dn = (factor @ truth @ factor.T + 6) * 0.02 * 0.125 + 160
    write_frame(run / "a.exr", {"DN": dn.astype(np.float32)}, {})
    for name in ("left", "right"):
        write_frame(calibration / f"{name}.exr", {"factor": factor.astype(np.float32)}, {})
    minimal = {"kind": "calibration", "status": "complete", "camera": {"name": "bench 3"}}
    (calibration / "manifest.json").write_text(json.dumps(minimal))
    assert call("reconstruct", run, "--calibration", calibration, "--lambda", 0).code == 0
    image = read_frame(run / "reconstruction" / "image.exr")[0]["reflectance"]
    # Numbers of 160 in float32 carry 1.5e-5 of rounding, which the factors magnify.
    assert np.allclose(image, truth, atol=0.02)


# ---- a calibration from measured frames ------------------------------------------------------------------------------


def test_what_the_command_says_of_measured_frames(call: Call, tmp_path: Path) -> None:
    session = RealSession()
    frames = session.write(tmp_path / "frames")
    done = call("calibrate", "--frames", "frames", "-o", "cal", cwd=tmp_path)
    assert done.code == 0 and done.err == "", done.err
    assert done.out.startswith("Calibrated 4 x 4 pixels, factor error ") and "\nNot known: parallax: " in done.out
    full = session.frame(np.ones((4, 4)))
    full[0, 0] = 4095
    write_image(frames / "f_0.png", full)
    flagged = call("calibrate", "--frames", "frames", "-o", "other", cwd=tmp_path, pictures=True)
    assert flagged.code == 1 and "warning: saturation: 1 of 16 frames" in flagged.err
    assert_said_once(flagged, tmp_path / "other")


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        ((), ["give a scene, --frames DIR with the frames of a real session, or --known LIST"]),
        (("photograph", "--frames", "frames"), ["SCENE: has no effect", "by --frames"]),
        (("--frames", "frames", "--seed", "0"), ["--seed: has no effect"]),
        (("--frames", "frames", "-D", "mask=open"), ["-D: has no effect"]),
        (("--frames", "nowhere"), ["frames nowhere: no such folder"]),
        (("--frames", "frames", "-o", "no/where"), ["no/where", "does not exist"]),
    ],
    ids=" ".join,
)
def test_measured_frames_leave_no_choice(
    refused: Refused, tmp_path: Path, arguments: tuple[str, ...], fragments: list[str]
) -> None:
    RealSession().write(tmp_path / "frames")
    mentions(refused("calibrate", "-o", "new", *arguments), *fragments)
