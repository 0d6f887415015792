"""Mono light or all lines: which keeps half of the accuracy, and the accuracy that is left."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from mitsim.acquire import spectral
from mitsim.acquire.spectral import SpectralBench
from mitsim.api.bench import Bench, open_bench
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


def test_a_plan_of_lines_is_that_of_the_roughest_one(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """The line whose light differs most from pixel to pixel: beside a tenth of lamps' light it counts for less, of
    equal ones the longest counts, and a dark one never. (Planted: the mean of the lamps' light; a dark line rough.)"""
    slope, lamps = np.repeat([1.0, 1.1, 1.2, 1.3], bench.n**2 // 4), np.full(4, 0.025)

    def roughest(*lit: float) -> float:
        """Wavelength of the chosen one of two lines of equal slope, of so much lamps' light each, and a dark one."""
        direct = [SimpleNamespace(pixel=np.arange(bench.n**2), value=value) for value in (slope, slope, 0 * slope)]
        ambient = [SimpleNamespace(value=slope.sum() * part * lamps) for part in lit]
        tracers = [
            SimpleNamespace(trace=lambda seed, *_, light=light: SimpleNamespace(by_line=lambda _: seed and light))
            for light in (direct, ambient)
        ]
        made = SimpleNamespace(direct=tracers[0], from_camera=tracers[1])
        monkeypatch.setattr(spectral, "Simulation", lambda *_: made)
        whole = SpectralBench(replace(bench, counted_lamps=cast(Any, "lamps")))
        projectors = [SimpleNamespace(effective_wavelength_nm=nm) for nm in (450.0, 550.0, 650.0)]
        whole.__dict__["benches"] = [SimpleNamespace(projector=each) for each in projectors]
        return whole.roughest(1, 1.0).projector.effective_wavelength_nm

    assert roughest(0.0, 0.0, 0.0) == 550.0 and roughest(0.0, 1.0, 0.0) == 450.0 and roughest(1.0, 0.0, 0.0) == 550.0


def test_lamps_that_one_line_does_not_need_are_planned_for_the_others(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plan of all lines has lamps where there are any; without lines it is the bench's own. (Planted: planned anew
    without lamps; the plan of lines for a bench that has none.)"""
    plan, asked = bench.plan("uniform", accuracy=0.1), list[Any]()
    monkeypatch.setattr(spectral, "plan_request", lambda *given: asked.append(given) or plan)
    assert plan.request is not None and SpectralBench(bench).plan(plan.request) is plan
    assert asked == [(bench, plan.request)]
    for lamps, ambient in ((None, [None]), ("lamps", [None, True])):
        whole: Any = SimpleNamespace(manifest=1, whole=bench, benches=(), check=lambda _: None)
        rough = SimpleNamespace(counted_lamps=lamps)
        whole.lit_by_lamps = lambda *_, rough=rough: SimpleNamespace(roughest=lambda *_: rough)
        asked.clear()
        assert SpectralBench.plan(whole, plan.request).request is plan.request
        assert [request.effects.get("ambient") for _, request, _ in asked] == ambient


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path], variant: str) -> Bench:
    return open_bench(shared_scene("grey", n=16), variant)
