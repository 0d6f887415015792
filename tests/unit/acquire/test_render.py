"""`mitsim render`: what it refuses, and what it flags."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest

from mitsim.api.bench import open_bench
from mitsim.core.errors import MitsimError


def test_an_integrator_without_a_camera_side_is_refused(small_scene: Callable[..., Path]) -> None:
    scene = small_scene()
    scene.write_text(scene.read_text().replace('<integrator type="path">', '<integrator type="ptracer">'))
    assert "ptracer" in scene.read_text()
    with pytest.raises(MitsimError, match=r"xml:3: integrator: got 'ptracer' .* use path or volpath"):
        open_bench(scene, for_render=True).render(spp=4)


def test_samples_of_the_scene_are_taken_unless_others_are_asked_for(small_scene: Callable[..., Path]) -> None:
    """(Seen failing: 64 whatever the scene says.)"""
    scene = small_scene(pixels=16, mask="open")
    stated = '<sampler type="independent"><integer name="sample_count" value="$samples"/></sampler>'
    plain = open_bench(scene, for_render=True)
    scene.write_text(
        scene.read_text()
        .replace('<sampler type="independent"/>', stated)
        .replace("<integrator", '<default name="samples" value="16"/><integrator', 1)
    )
    bench, few = (open_bench(scene, for_render=True, **values) for values in ({}, {"samples": 2}))
    assert [one.render().facts["spp"] for one in (plain, bench)] == [64, 16]
    assert bench.render(spp=8).facts["spp"] == 8
    assert (bench.render().mean == bench.render(spp=16).mean).all()
    with pytest.raises(MitsimError, match=r"small.xml: sample_count of its sampler, .* 2: give at least 4"):
        few.render()
    assert few.render(spp=4).facts["spp"] == 4


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


def test_what_the_reference_leaves_out_is_said(small_scene: Callable[..., Path], tmp_path: Path) -> None:
    """(Seen failing: a projector's glare and blur were missing from the frame, and nothing said so.)"""
    soft_file = tmp_path / "soft.toml"
    soft_file.write_text('name = "soft"\neffective_wavelength_nm = 562.0\nblur_pixels = 0.8\nansi_contrast = 40.0\n')
    scene = small_scene(mask="open")
    plain, soft = (open_bench(scene, projector=file, for_render=True) for file in (None, soft_file))
    assert plain.render(spp=4).facts["notes"] == (
        "the reference leaves out diffraction; --estimator factored does not",
    )
    assert "leaves out diffraction, blur, glare;" in soft.render(spp=4).facts["notes"][0]
    assert not soft.render("factored", accuracy=1e-2).facts["notes"]
    unlit = dataclasses.replace(soft, loaded=dataclasses.replace(soft.loaded, projector=None))
    assert not unlit.render(spp=4).facts["notes"]
