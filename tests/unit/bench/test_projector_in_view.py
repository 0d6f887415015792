"""A projector that shines on the sensor itself is in the frame, or the run is flagged; so is a frame of one path."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.acquire import capture
from mitsim.api.bench import Bench, open_bench
from mitsim.planner.planner import SceneFacts


@pytest.fixture
def facing(small_scene: Callable[..., Path]) -> Path:
    """A projector on the camera's axis, 800 mm away, that faces the sensor past a small sheet."""
    turn = '<rotate y="1" angle="180"/><translate x="-60" z="800"/>'
    path = small_scene(mask="open", projector_turn=turn, sheet_z=300)
    small = '<scale x="2" y="2"/> <translate x="20"/>'
    path.write_text(path.read_text().replace('<scale x="64" y="64"/>', small))
    return path


def test_the_reference_and_a_lens_are_flagged(facing: Path) -> None:
    """The reference has no light of a lamp but over surfaces; a lens would blur the mask's shadow by 4 a / 800 mm."""
    bench = open_bench(facing, for_render=True)
    assert bench.loaded.in_view and bench.loaded.mirrors
    (warning,) = (text for text in bench.render("reference", spp=16).warnings if "shines" in text)
    assert "the reference has no light of it but over surfaces" in warning

    def lens(bench: Bench, switches: dict[str, bool] | None = None) -> list[str]:
        return [text for text in SceneFacts.of(bench, switches).warnings if "as a pinhole, without its lens" in text]

    light = bench.projector.model_copy(update={"aperture_radius_mm": 10.0})
    wide = replace(bench, devices=replace(bench.devices, projector=light))
    (warning,) = lens(wide)
    assert "blur the mask's shadow by 0.05 mm" in warning
    assert not lens(bench) and not lens(wide, {"mirrors": False})


def test_a_frame_of_one_path_is_flagged(small_scene: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """One of four passes met light once: its standard error is the light itself. (Planted: no such question.)"""
    light = np.zeros((64, 64, 1))
    light[3, 5] = 1.0
    bench = open_bench(small_scene(), for_render=True)
    monkeypatch.setattr(capture, "reference", lambda *_: (light, light))
    (warning,) = bench.render("reference", spp=4).warnings
    assert "too few paths met light" in warning
    monkeypatch.setattr(capture, "reference", lambda *_: (light, light / 2))
    assert not bench.render("reference", spp=4).warnings
