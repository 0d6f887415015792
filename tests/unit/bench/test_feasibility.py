"""Whether frames of a bench can give an image is known from its geometry: against counts and closed forms."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.bench.layout import layout_of, mask_fault, obstacles, shortage
from mitsim.devices.camera import MaskProfile

pytestmark = pytest.mark.usefixtures("variant")


def masked(bench: Bench, **mask: Any) -> Bench:
    """The bench with another mask."""
    camera = MaskProfile(**mask).put_on(bench.geometry, Path())
    return replace(bench, devices=replace(bench.devices, camera=camera))


def test_a_code_of_two_terms_has_factors_once_it_covers_what_the_sensor_sees(small_scene: Callable[..., Path]) -> None:
    """Pixel centres from -s to s see 2 (s (1 - d/z) + d tan) of the mask's plane. A MURA of fewer
    features than advised leaves an edge, and the next prime none. (Planted: the window's part left out.)"""
    bench = open_bench(small_scene())
    geometry, (low, high) = bench.geometry, bench.windows[0]
    side = float(geometry.centres(0)[-1])
    near = geometry.mask_distance
    seen = 2 * (side * (1 - near / geometry.scene_distance) + near * max(-low, high))
    fault = mask_fault(masked(bench, kind="mura", feature_mm=0.025, features=31))
    assert fault and f"covers 0.78 mm of the {seen:.2g} mm" in fault.reason
    least = int(fault.remedy.split()[3])
    prime = next(n for n in range(least, 2 * least) if all(n % k for k in range(2, n)))
    assert 0.025 * (least - 1) < seen <= 0.025 * least
    assert mask_fault(masked(bench, kind="mura", feature_mm=0.025, features=prime)) is None
    small = mask_fault(open_bench(small_scene(mask="flatcam", mask_order=4)))
    order = int(small.remedy.split()[3]).bit_length() if small else 0
    assert order > 4 and mask_fault(open_bench(small_scene(mask="flatcam", mask_order=order))) is None
    assert mask_fault(open_bench(small_scene(mask="separable", mask_order=4))) is None, "one term has factors anyhow"


@pytest.mark.parametrize(
    ("mask", "reason", "remedy"),
    [
        ({"kind": "random", "features": 127}, "random mask of 127 features", 'use kind = "separable"'),
        ({"kind": "separable", "rotation_deg": 0.5}, "as it is mounted", "mount it straight"),
        ({"kind": "separable", "opaque_transmission": 0.02}, "", ""),
        ({"kind": "mura", "features": 251}, "", ""),
    ],
)
def test_lacking_factors(small_scene: Callable[..., Path], mask: Mapping[str, Any], reason: str, remedy: str) -> None:
    """(Planted: no means taken off, so that a MURA has no factors either.)"""
    fault = mask_fault(masked(open_bench(small_scene()), feature_mm=0.06, **mask))
    if not reason:
        assert fault is None
    else:
        assert fault and reason in fault.reason and remedy in fault.remedy


@pytest.mark.parametrize(
    ("pixels", "patterns", "undetermined"),
    [(16, "uniform", True), (17, "uniform", None), (8, "dots:2", True), (9, "dots:2", None), (4, "dots:3", True),
     (8, "hadamard:4", None), (8, "dots:1x2", True)],
)  # fmt: skip
def test_few_numbers(small_scene: Callable[..., Path], pixels: int, patterns: str, undetermined: bool | None) -> None:
    """16 x 16 unknowns. With as many data, none is left to tell the noise, and an automatic lambda is refused; the
    advice, one pattern more, is enough. (Planted: "at least as many" for "more".)"""
    bench = open_bench(small_scene(pixels=pixels))
    assert bench.geometry.frame_shape == (pixels, pixels)
    short = shortage(bench, bench.family(patterns))
    assert (short and short.lost == 1) is undetermined
    if short:
        rows, _, columns = short.remedy.rpartition("at least ")[2].split()[:3]
        assert shortage(bench, bench.family(f"dots:{rows}x{columns}")) is None


def test_a_pinhole_lights_the_rows_that_it_projects_the_window_on(small_scene: Callable[..., Path]) -> None:
    """Rays to both ends of the window pass beside the hole, and others through it: 16 rows of 64 see d 2 tan and the
    hole's width. (Planted: rows counted by the rays to the window's ends.)"""
    bench = open_bench(small_scene(mask="open", mask_order=2, mask_feature=0.01, mask_distance=0.5))
    (low, high), rows = bench.windows[0], bench.geometry.centres(0) * (1 - 0.5 / 400)
    lit = sum(2 * abs(row) <= 0.5 * (high - low) + 0.03 for row in rows)
    short = shortage(bench, bench.family("uniform"))
    assert lit == 16 and short and f"on {lit} x {lit} sensor pixels" in short.reason


def test_a_scene_that_hardly_meets_the_window_is_told(small_scene: Callable[..., Path]) -> None:
    """At 2 m the window has moved by 240 mm. (Planted: a part of the seen pixels, not of all.)"""
    assert layout_of(open_bench(small_scene())).obstacles == ()
    (few,) = layout_of(open_bench(small_scene(sheet_z=2000))).obstacles
    assert "of 256 projector pixels" in few and "move the scene to 400 mm" in few


@pytest.mark.slow
def test_plan_and_capture_say_what_their_own_patterns_lack(small_scene: Callable[..., Path]) -> None:
    """Light that was planned for too few patterns serves others, and says nothing of its own then. (Planted: the
    plan's warnings kept.)"""
    bench = open_bench(small_scene(pixels=16))
    (said,) = obstacles(bench, bench.family("uniform"))
    assert "noise cannot be distinguished" in said and said in bench.plan("uniform", accuracy=0.1).warnings
    light = bench.light("uniform", accuracy=0.1)
    assert said in light.expose("uniform").warnings
    assert not any("unknowns" in text for text in light.expose("dots:4").warnings)
