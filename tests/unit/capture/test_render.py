"""`mitsim render`: what it refuses, and what it flags."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from mitsim.capture.render import render
from mitsim.core.errors import MitsimError


def test_an_integrator_without_a_camera_side_is_refused(small_scene: Callable[..., Path], tmp_path: Path) -> None:
    scene = small_scene()
    scene.write_text(scene.read_text().replace('<integrator type="path">', '<integrator type="ptracer">'))
    assert "ptracer" in scene.read_text()
    with pytest.raises(MitsimError, match="cannot render this sensor"):
        render(scene, tmp_path / "frame.exr", spp=4)
    assert not (tmp_path / "frame.exr").exists()


def test_a_dark_frame_is_flagged(small_scene: Callable[..., Path], tmp_path: Path) -> None:
    scene = small_scene()
    text = scene.read_text()
    start = text.index("<shape")
    scene.write_text(text[:start] + text[text.rindex("</shape>") + len("</shape>") :])
    result = render(scene, tmp_path / "frame.exr", spp=4)
    assert result.mean == 0 and any("dark" in warning for warning in result.warnings)
