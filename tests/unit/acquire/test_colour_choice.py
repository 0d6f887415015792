"""Mono light or all lines: which keeps half of the accuracy, and the accuracy that is left."""

from collections.abc import Callable
from pathlib import Path

import pytest

from mitsim.api.bench import open_bench
from mitsim.core.colour_files import spectral_of
from mitsim.core.errors import ArgumentError

pytestmark = pytest.mark.usefixtures("variant")


def test_a_sheet_in_colours_is_mono_where_that_keeps_half_of_the_accuracy(
    small_scene: Callable[..., Path], variant: str
) -> None:
    """An even sheet of reflectance 0.6 beyond 580 nm and 0.5 below, without a mask: frames differ by the photons that
    come back. The error is taken off the accuracy in squares. (Planted: the whole accuracy for both; no error.)"""
    scene = small_scene(mask="open")
    options = {"albedo": "400:0.5, 579:0.5, 581:0.6, 700:0.6"}
    found = open_bench(scene, variant, **options).choose_colour("dots:2", accuracy=0.3)
    mono = found.plan.colour["candidates"][0]["error"]
    assert found.mono and found.bench.variant == variant and 0.01 < mono < 0.15
    assert found.plan.accuracy**2 + mono**2 == pytest.approx(0.09) and found.plan.request.accuracy == 0.3
    lines = open_bench(scene, variant, **options).choose_colour("dots:2", accuracy=1.9 * mono)
    assert not lines.mono and lines.bench.variant == spectral_of(variant) and lines.plan.accuracy == 1.9 * mono
    assert lines.plan.colour["chosen"] == "lines"


def test_greys_are_mono_without_a_look(small_scene: Callable[..., Path], variant: str) -> None:
    bench = open_bench(small_scene(), variant)
    found = bench.choose_colour("uniform", accuracy=0.1)
    assert found.mono and found.bench is bench and found.plan.colour["candidates"][0]["error"] == 0.0
    for wrong, options in ((bench, {"seconds": 5.0}), (bench.in_variant(spectral_of(variant)), {})):
        with pytest.raises(ArgumentError, match=r"^colour auto: give an accuracy"):
            wrong.choose_colour("uniform", **options)
