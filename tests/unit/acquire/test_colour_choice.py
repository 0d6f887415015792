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
from mitsim.bench.request import Request
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


def test_a_grey_sheet_differs_in_colours_by_the_camera(small_scene: Callable[..., Path], variant: str) -> None:
    """Electrons are q lambda of the mean wavelength in mono light, and the mean of q lambda over the lines: a closed
    form for a camera that sees red twice as well as blue. (Planted: photons over the efficiency.)"""
    bench = open_bench(small_scene(mask="open"), variant)
    curve = {"wavelengths_nm": (400.0, 700.0), "efficiency": (0.3, 0.6)}
    sensor = bench.sensor.model_validate(
        {**bench.sensor.model_dump(), "quantum_efficiency": None, "quantum_efficiency_curve": curve}
    )
    projector = bench.projector
    found = replace(bench, devices=replace(bench.devices, sensor=sensor)).choose_colour("uniform", accuracy=0.3)
    lines = np.array(projector.traced_lines.wavelengths_nm)
    counted = np.average(np.interp(lines, *curve.values()) * lines, weights=projector.traced_lines.shares)
    nm = projector.effective_wavelength_nm
    expected = abs(np.interp(nm, *curve.values()) * nm / counted - 1)
    assert found.plan.colour["candidates"][0]["error"] == pytest.approx(expected, rel=0.06) and expected > 0.005


def line(nm: float) -> Any:
    return SimpleNamespace(projector=SimpleNamespace(effective_wavelength_nm=nm))


def test_a_plan_of_lines_is_that_of_the_roughest_one(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """The line whose light differs most from pixel to pixel: beside a tenth of lamps' light it counts for less, of
    equal ones the longest counts, and a dark one never. (Planted: the mean of the lamps' light; a dark line rough.)"""
    slope, lamps = np.repeat([1.0, 1.1, 1.2, 1.3], bench.n**2 // 4), np.full(4, 0.025)

    def roughest(*dilution: float) -> float:
        """Wavelength of the chosen one of two lines of equal slope, of so much lamps' light each, and a dark one."""
        places, sources = np.arange(bench.n**2), (slope, slope, 0 * slope)
        direct = [SimpleNamespace(pixel=places, value=value) for value in sources]
        ambient = [SimpleNamespace(value=slope.sum() * part * lamps) for part in dilution]
        traced = SimpleNamespace(by_line=lambda count: direct[:count]), SimpleNamespace(by_line=lambda count: ambient)

        def trace(light: Any, stream: int, first: int, rays: int) -> Any:
            assert (stream > 100, first, rays) == (True, 0, spectral._RAYS)
            return light

        tracers = [SimpleNamespace(trace=lambda *asked, light=light: trace(light, *asked)) for light in traced]
        made = SimpleNamespace(direct=tracers[0], from_camera=tracers[1])
        monkeypatch.setattr(spectral, "Simulation", lambda *_: made)
        whole = SpectralBench(replace(bench, counted_lamps=cast(Any, "lamps")))
        whole.__dict__["benches"] = (line(450.0), line(550.0), line(650.0))
        return whole.roughest(1, 1.0).projector.effective_wavelength_nm

    assert roughest(0.0, 0.0, 0.0) == 550.0 and roughest(0.0, 1.0, 0.0) == 450.0 and roughest(1.0, 0.0, 0.0) == 550.0


def test_lamps_that_one_line_does_not_need_are_planned_for_the_others(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plan of all lines has lamps where there are any; without lines it is the bench's own. (Planted: planned anew
    without lamps; the plan of lines for a bench that has none.)"""
    planned: list[tuple[Any, Request]] = []

    def plan_request(of: Any, request: Request, lines: int = 1) -> Any:
        planned.append((of, request))
        return replace(plan, request=request)

    plan = bench.plan("uniform", accuracy=0.1)
    assert plan.request is not None and "ambient" not in plan.settings.effects
    request = plan.request
    monkeypatch.setattr(spectral, "plan_request", plan_request)
    assert SpectralBench(bench).plan(request) is not None and planned.pop() == (bench, request) and not planned
    for lamps in (None, "lamps"):
        rough = SimpleNamespace(counted_lamps=lamps)
        whole = SpectralBench(bench, cast(Any, "lines"))
        monkeypatch.setattr(SpectralBench, "check", lambda *_: None)
        monkeypatch.setattr(SpectralBench, "lit_by_lamps", lambda own, *_: own)
        monkeypatch.setattr(SpectralBench, "roughest", lambda *_, rough=rough: rough)
        found = whole.plan(request)
        asked = [each.effects.get("ambient") for _, each in planned]
        assert asked == ([None, True] if lamps else [None]) and found.request is request
        planned.clear()


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path], variant: str) -> Bench:
    return open_bench(shared_scene("grey", n=16), variant)
