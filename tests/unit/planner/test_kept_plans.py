"""Plans that tests keep are those of the same question: each part of it makes another one."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsim.api.bench import open_bench
from mitsim.devices.patterns import Lighting, parse_patterns
from tests.kept_plans import question

pytestmark = pytest.mark.usefixtures("variant")
SHADES = np.arange(256).reshape(16, 16)


def test_each_part_of_a_question_makes_another(small_scene: Callable[..., Path]) -> None:
    """A scene that is opened again is the same one. (Planted: each part left out.)"""
    path = small_scene(reflectance=SHADES)
    bench, again, uniform = open_bench(path), open_bench(path), Lighting.uniform(16)
    asked = question(bench, uniform, 1e-2, 3, {}, 1)
    assert question(again, uniform, 1e-2, 3, {}, 1) == asked
    dots = parse_patterns("dots:2", 16).lighting
    sensor = bench.sensor.model_copy(update={"read_noise_e": 9.0})
    others = [
        question(bench, dots, 1e-2, 3, {}, 1),
        question(bench, dots.shots([0]), 1e-2, 3, {}, 1),
        question(bench, uniform, 2e-2, 3, {}, 1),
        question(bench, uniform, 1e-2, 4, {}, 1),
        question(bench, uniform, 1e-2, 3, {"blur": False}, 1),
        question(bench.with_board(0.99), uniform, 1e-2, 3, {}, 1),
        question(bench, uniform, 1e-2, 3, {}, 3),
        question(replace(bench, devices=replace(bench.devices, sensor=sensor)), uniform, 1e-2, 3, {}, 1),
        question(open_bench(small_scene(reflectance=SHADES[::-1])), uniform, 1e-2, 3, {}, 1),
    ]
    assert len({asked, *others}) == 1 + len(others)
