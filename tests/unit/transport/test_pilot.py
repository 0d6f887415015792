"""The pilot's predictions come true: what it says a discretisation leaves is what a careful run finds."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.capture.bench import Bench, open_bench
from mitsim.capture.light import grid_for
from mitsim.core.errors import MitsimError
from mitsim.core.seeds import integer
from mitsim.optics.frames import ExpectedFrames, FrameOptics, relative_error
from mitsim.scene.patterns import parse_patterns
from mitsim.transport import pilot
from mitsim.transport.factored import Tracer
from mitsim.transport.pilot import Evidence

pytestmark = pytest.mark.usefixtures("variant")
N = 16
SHOWN = [0, 5, 10, 15]  # the captures of dots:4 that the pilot looks at: evenly spread


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path], variant: str) -> Bench:
    print_ = np.random.default_rng(4).integers(20, 256, (48, 48))
    return open_bench(shared_scene("pilot", reflectance=print_), variant)


@pytest.fixture(scope="module")
def evidence(bench: Bench) -> Evidence:
    return measured(bench, seed=3)


def measured(bench: Bench, seed: int) -> Evidence:
    labels, weights = parse_patterns("dots:4", N).classes()
    loaded = bench.loaded
    view = pilot.View(loaded.scene, loaded.camera, bench.source, bench.windows)
    return pilot.measure(view, labels, weights, seed)


def frames(bench: Bench, subdivision: int, batches: int) -> ExpectedFrames:
    labels, weights = parse_patterns("dots:4", N).classes()
    grid = grid_for(bench, subdivision)
    tracer = Tracer(bench.loaded.scene, bench.loaded.camera, bench.source, grid, 1)
    groups = [tracer.batch(integer(77, "check", subdivision, index)).light for index in range(batches)]
    optics = FrameOptics(bench.geometry, grid.rows.edges, grid.columns.edges, 400.0, 1)
    return ExpectedFrames(optics, groups, labels, weights[SHOWN], 0)


def test_every_choice_is_measured(evidence: Evidence) -> None:
    assert set(evidence.anchor_error) == set(pilot.ANCHOR_CHOICES)
    assert set(evidence.cell_error) == set(evidence.sampling_error) == set(pilot.CELL_CHOICES)
    assert 0 < evidence.seconds_per_batch < evidence.seconds and 0 <= evidence.seconds_per_path < 1e-3
    for errors in (evidence.anchor_error, evidence.cell_error):
        assert list(errors.values()) == sorted(errors.values(), reverse=True), "finer has to be better"
        assert all(value >= 0 for value in errors.values())


def test_depth(evidence: Evidence) -> None:
    assert evidence.depth == pytest.approx(400, rel=1e-6)
    assert evidence.depth_spread_error < 1e-6


def test_cell_errors_come_true(bench: Bench, evidence: Evidence) -> None:
    judge = np.stack([frame.irradiance for frame in frames(bench, 16, 24)])
    for choice in (1, 2):
        found = np.stack([frame.irradiance for frame in frames(bench, choice, 400)])
        error = np.linalg.norm(found - judge) / np.linalg.norm(judge)
        assert evidence.cell_error[choice] == pytest.approx(error, rel=0.35)


@pytest.mark.parametrize("choice", pilot.CELL_CHOICES)
def test_sampling_errors_come_true(bench: Bench, evidence: Evidence, choice: int) -> None:
    batches = 32
    found = relative_error(frames(bench, choice, batches)) * batches**0.5
    # The pilot estimates it from two samples: one degree of freedom for each of few modes.
    assert 0.5 < evidence.sampling_error[choice] / found < 2.0


def test_the_pilot_is_reproducible(bench: Bench, evidence: Evidence) -> None:
    again = measured(bench, seed=3)
    assert again.cell_error == evidence.cell_error and again.anchor_error == evidence.anchor_error
    assert again.sampling_error == evidence.sampling_error
    assert measured(bench, seed=4).cell_error != evidence.cell_error


def test_depth_spread_is_seen(small_scene: Callable[..., Path]) -> None:
    ball = """<shape type="sphere"><point name="center" x="0" y="0" z="300"/> <float name="radius" value="40"/>
        <bsdf type="diffuse"><spectrum name="reflectance" value="0.8"/></bsdf></shape>"""
    # 24 mm of sensor: its edge moves by 12 mm x 2 mm x (1/260 - 1/400) = 32 um between ball and sheet.
    path = small_scene(extra=ball, pixels=64, pitch=0.375)
    found = measured(open_bench(path, check_camera=False), seed=0)
    assert 260 < found.depth < 399
    assert found.depth_spread_error > 0.01


def test_a_scene_without_light_is_refused(small_scene: Callable[..., Path]) -> None:
    away = open_bench(small_scene(projector_turn='<rotate y="1" angle="180"/>'))
    with pytest.raises(MitsimError, match="no light of the projector reaches the camera"):
        measured(away, seed=0)
    black = open_bench(small_scene("black"), defines={"albedo": "0"})
    with pytest.raises(MitsimError, match="no light of the projector reaches the camera"):
        measured(black, seed=0)
