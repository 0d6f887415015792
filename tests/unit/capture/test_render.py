"""`mitsim render`: what it refuses, and what it flags."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from mitsim.capture.opening import open_bench
from mitsim.core.errors import MitsimError


def test_an_integrator_without_a_camera_side_is_refused(small_scene: Callable[..., Path]) -> None:
    scene = small_scene()
    scene.write_text(scene.read_text().replace('<integrator type="path">', '<integrator type="ptracer">'))
    assert "ptracer" in scene.read_text()
    with pytest.raises(MitsimError, match=r"xml:3: integrator: got 'ptracer' .* use path or volpath"):
        open_bench(scene, for_render=True).render(spp=4)


def test_a_dark_frame_is_flagged(small_scene: Callable[..., Path]) -> None:
    scene = small_scene()
    text = scene.read_text()
    start = text.index("<shape")
    scene.write_text(text[:start] + text[text.rindex("</shape>") + len("</shape>") :])
    result = open_bench(scene, for_render=True).render(spp=4)
    assert not result.mean.any() and any("dark" in warning for warning in result.warnings)


def test_a_sampler_of_dependent_numbers_is_flagged(small_scene: Callable[..., Path]) -> None:
    scene = small_scene()
    assert not open_bench(scene, for_render=True).render(spp=4).warnings
    scene.write_text(scene.read_text().replace('type="independent"', 'type="multijitter"'))
    (warning,) = open_bench(scene, for_render=True).render(spp=4).warnings
    assert "MultijitterSampler" in warning and '<sampler type="independent"/>' in warning
