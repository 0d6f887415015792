"""Every Mitsuba variant through the installed program; another variant than mono needs a process of its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsim.core.exr import read_frame
from tests.system.conftest import ACCURACY
from tests.system.refusals import Call
from tests.unit.transport.test_indirect import MATT
from tests.unit.transport.test_path_reuse import WALL

VARIANTS = ("llvm_ad_rgb", "llvm_ad_spectral")


def channels(path: Path) -> list[np.ndarray]:
    """The colour channels of a rendered frame: one of luminance, or three."""
    found = read_frame(path)[0]
    colours = [found[name].astype(float) for name in ("Y", "R", "G", "B") if name in found]
    assert len(colours) in (1, 3), found.keys()
    return colours


@pytest.mark.slow
@pytest.mark.parametrize("colour", VARIANTS)
def test_the_reference_sees_a_grey_scene_alike_in_every_variant(
    call: Call, shell: Call, lab: Any, tmp_path: Path, colour: str
) -> None:
    """White light on grey paper: colour adds nothing, so the mean irradiance of every channel is that of mono.

    Means differ by their noise, which the frames carry: 5 standard errors, significance 1e-6 a channel.
    """
    options = "--spp", 64, "--json"
    mono = call("render", lab.scene, "-o", tmp_path / "mono.exr", *options).payload
    outcome = shell("render", lab.scene, "-o", tmp_path / "colour.exr", *options, "--variant", colour)
    assert outcome.err == "" and outcome.payload["variant"] == colour
    for frame in channels(tmp_path / "colour.exr"):
        error = np.hypot(mono["mc_error"] * mono["mean"], outcome.payload["mc_error"] * mono["mean"])
        assert abs(frame.mean() - mono["mean"]) < 5 * error / np.sqrt(frame.size)


@pytest.mark.slow
@pytest.mark.parametrize(("colour", "gate"), [(VARIANTS[0], 1e-6), (VARIANTS[1], 2 * float(ACCURACY))])
def test_capture_in_every_variant(shell: Call, lab: Any, tmp_path: Path, colour: str, gate: float) -> None:
    """The same frames as in mono, and the same truth.

    Three channels take mono's paths: the same to float32's rounding. Wavelengths are sampled, so that both estimates
    have the error asked for; seed 0 leaves 3.4e-3 of the frames and 1.6e-3 of the truth.
    """
    options = "-o", tmp_path / "run", "--patterns", "dots:4", "--json", "--variant", colour
    outcome = shell("capture", *lab.arguments, *options)
    assert outcome.err == "" and outcome.payload["variant"] == colour
    frames = [
        np.stack([read_frame(path)[0]["electrons"].astype(float) for path in sorted(run.glob("frame_*.exr"))])
        for run in (tmp_path / "run", lab.run)
    ]
    # The exposures of the two runs differ, each fills the well by its own light.
    ours, theirs = (values / np.linalg.norm(values) for values in frames)
    assert np.linalg.norm(ours - theirs) < gate
    assert outcome.payload["exposure_s"] == pytest.approx(lab.captured.payload["exposure_s"], rel=gate)
    truths = [read_frame(run / "truth.exr")[0]["reflectance"] for run in (tmp_path / "run", lab.run)]
    assert np.sqrt(np.mean((truths[0] - truths[1]) ** 2)) < gate


@pytest.mark.slow
def test_sampled_wavelengths_leave_indirect_light(
    call: Call, shell: Call, shared_scene: Callable[..., Path], tmp_path: Path
) -> None:
    """A corner of two walls, where light is accumulated on the device: frames of both variants keep the accuracy."""
    scene = shared_scene("spectral corner", extra=WALL.format(turn=90, x=-30, bsdf=MATT))
    options = scene, "--patterns", "uniform", "--accuracy", 0.05, "--json", "-o"
    assert call("capture", *options, tmp_path / "mono").code == 0
    outcome = shell("capture", *options, tmp_path / "spectral", "--variant", "llvm_ad_spectral")
    assert outcome.err == "" and outcome.code == 0
    frames = [read_frame(tmp_path / name / "frame_00000.exr")[0]["electrons"] for name in ("spectral", "mono")]
    ours, theirs = (frame.astype(float) / np.linalg.norm(frame.astype(float)) for frame in frames)
    assert 0 < np.linalg.norm(ours - theirs) < 2 * 0.05


def test_a_variant_that_is_not_on_this_machine(shell: Call, lab: Any, tmp_path: Path) -> None:
    """A GPU variant: one line where there is no GPU, the usual frames where there is one."""
    outcome = shell(
        "capture", *lab.arguments, "-o", "run", "--patterns", "uniform", "--variant", "cuda_ad_mono", cwd=tmp_path
    )
    if outcome.code:
        assert "cuda_ad_mono" in outcome.refusal and not (tmp_path / "run").exists()
