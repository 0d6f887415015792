"""Light of several lines through dispersive glass, each line beside a capture's of plain glass of its own index.

A child process traces them, for this one has another variant. Lines that part are traced alone, by the random numbers
that a projector of one line has: places and light agree to float32's rounding, in all ways that light is followed.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsim.acquire.capture import reference
from mitsim.acquire.spectral import SpectralBench, line_alone, lit_by_lamps
from mitsim.api.bench import Bench, open_bench
from mitsim.core.colour_files import RUN
from mitsim.core.errors import MitsimError
from mitsim.transport.direct import DirectTracer, FluxTracer
from mitsim.transport.from_camera import FromCameraTracer, LampTracer
from mitsim.transport.integrator import IndirectTracer, Paths
from mitsim.transport.path_reuse import PathReuseTracer
from mitsim.transport.records import Bundle, DeviceAccumulator, PathSamples, aligned_grid
from mitsim.transport.specular import trace_specular_chains
from tests.conftest import write_small_scene
from tests.unit.transport.closed_forms import in_child

N, SAMPLES = 8, 16
LINES, SHARES = (450.0, 530.0, 640.0), (0.5, 0.3, 0.2)
INDEX, ABBE = 1.7, 25.0
"""Of a dense flint."""
GLASS = '<bsdf type="mitsim_glass"><float name="index" value="1.7"/><float name="abbe" value="25"/></bsdf>'
PLAIN = '<bsdf type="dielectric"><float name="int_ior" value="{:.9f}"/><float name="ext_ior" value="1"/></bsdf>'
SLAB = """<shape type="cube"><transform name="to_world"><scale x="90" y="90" z="12"/>
    <rotate y="1" angle="25"/><translate z="220"/></transform>{glass}</shape>"""
BALL = """<shape type="sphere"><point name="center" x="-8" y="2" z="340"/>
    <float name="radius" value="14"/>{glass}</shape>"""
MIRROR = """<shape type="rectangle"><transform name="to_world"><scale x="40" y="40"/>
    <rotate y="1" angle="180"/><translate x="30" z="330"/></transform>
    <bsdf type="conductor"><string name="material" value="none"/></bsdf></shape>"""
LAMP = """<shape type="rectangle"><transform name="to_world"><scale x="15" y="15"/><translate z="320" x="-40"/>
    </transform><emitter type="area"><spectrum name="radiance" value="0.5"/></emitter></shape>"""
SCENES = {"slab": SLAB, "ball": BALL, "specular chain": MIRROR + SLAB, "lamp": SLAB + LAMP}
ROUNDING = 2e-6
"""Of sums of a few thousand paths in float32."""


def index(nm: float) -> float:
    """Cauchy's two terms through n_d and the Abbe number, by the lines d, F and C."""
    slope = (INDEX - 1) / ABBE / (0.48613**-2 - 0.65627**-2)
    return INDEX + slope * ((nm / 1000) ** -2 - 0.58756**-2)


def seen(light: PathSamples) -> list[float]:
    """How much light, from where and how far, and of which pixels."""
    places = (np.ones(len(light.value)), light.row, light.column, light.inverse_depth * 400, light.pixel / N**2)
    return [float(np.sum(light.value * place)) for place in places]


def followed(bench: Bench) -> dict[str, PathSamples]:
    """Light of a bench by the way that it is followed."""
    aim = aligned_grid(*bench.windows, 32, 1, bench.geometry.tan_half_fov + 0.01)
    tracers = {
        "direct": DirectTracer(bench.setup, 2),
        "indirect": IndirectTracer(bench.setup, Paths(True, True)),
        "shared": PathReuseTracer(bench.setup, Paths(True, True)),
        "from camera": FromCameraTracer(bench.setup, aim, Paths(True, True, ())),
    }
    if tracers["indirect"].setup.passage.open:
        del tracers["shared"]
    return {name: tracer.trace(3, 0, SAMPLES) for name, tracer in tracers.items()}


def accumulated(bench: Bench) -> list[list[float]]:
    """(lines, kinds and classes) indirect and direct light that is accumulated on the device."""
    lines = bench.lines
    assert lines is not None
    labels = np.arange(N**2) % 5
    bundle = Bundle(aligned_grid(*bench.windows, N, 1, bench.geometry.tan_half_fov), 1, (400.0,))
    found: list[list[float]] = [[] for _ in lines.shares]
    for tracer in (IndirectTracer(bench.setup, Paths(True, True)), DirectTracer(bench.setup, 1)):
        accumulator = DeviceAccumulator(bundle, labels, tracer.board, len(lines.shares))
        tracer.trace(3, 0, SAMPLES, accumulator)
        for line, sums in zip(found, accumulator.fetch(), strict=True):
            line += np.asarray(sums.light()[0].sum(axis=1)).ravel().tolist()
    return found


def flux(bench: Bench) -> list[list[float]]:
    """(lines, 2) mean irradiance of the sensor, by truth's tracer: all pixels, and the first half of them."""
    tracer = FluxTracer(bench.setup)
    pixels = np.arange(N**2)
    sums = tracer.sums(7, 1, pixels, np.zeros(N**2, dtype=np.int64), 64)[:, 0]
    return [[float(line.sum()), float(line[: N**2 // 2].sum())] for line in sums]


def specular(bench: Bench) -> list[float]:
    """Of beams that reach the sensor: power, and by place."""
    beams = trace_specular_chains(bench.loaded.scene, bench.loaded.camera, bench.projector_optics)
    light = beams.flux * beams.throughput.mean(axis=(1, 2))
    return [float(light.sum()), *(light @ beams.sensor.mean(axis=(1, 2))).tolist()]


def lamps(bench: Bench) -> list[list[float]]:
    """What a camera counts of lamps' light in a narrow band about each line."""
    lit = lit_by_lamps(bench, {}, 1)
    assert lit.counted_lamps is not None
    aim = aligned_grid(*bench.windows, 32, 1, bench.geometry.tan_half_fov + 0.01)
    like = FromCameraTracer(bench.setup, aim, Paths(True, True, bench.loaded.lamps))
    bands = [(nm - 0.01, nm + 0.01) for nm in LINES] + [(830.0, 830.0)]
    found = LampTracer(like, lit.counted_lamps.responses[0], bands, (1.0,)).trace(3, 0, SAMPLES)
    return [seen(found.where(found.pixel == N**2 + band)) for band in range(len(LINES))]


def both(name: str, opened: Callable[[str, str], Bench]) -> dict[str, Any]:
    """Light of a scene by the way that it is followed: of several lines in dispersive glass, and of each in plain
    glass."""
    whole = SpectralBench.of(opened(name, GLASS), RUN).whole
    assert whole.lines is not None
    pairs = zip(LINES, whole.lines.single, strict=True)
    alone = [line_alone(opened(name, PLAIN.format(index(nm))), line) for nm, line in pairs]
    if name == "lamp":
        return {"lamps": [lamps(whole), [lamps(bench)[line] for line, bench in enumerate(alone)]]}
    if name == "specular chain":
        each = np.array([specular(bench) for bench in alone])
        return {"specular chain": [[specular(whole)], [each.sum(axis=0).tolist()]], "line by line": [each.tolist()] * 2}
    together, apart = followed(whole), [followed(bench) for bench in alone]
    found = {
        way: [[seen(line) for line in light.by_line(3)], [seen(one[way]) for one in apart]]
        for way, light in together.items()
    }
    for way, sums in {"accumulated": accumulated, "flux": flux}.items():
        found[way] = [sums(whole), [sums(bench)[0] for bench in alone]]
    return found


def traced(folder: str, *names: str) -> dict[str, Any]:
    """Light of some scenes; its process has a spectral variant for good."""
    place = Path(folder)
    (place / "lines.toml").write_text(
        f'name = "lines"\neffective_wavelength_nm = 550\nwavelengths_nm = {list(LINES)}\n'
        f"radiant_shares = {list(SHARES)}\n"
    )

    def opened(name: str, glass: str) -> Bench:
        path = write_small_scene(place, name, n=N, extra=SCENES[name].format(glass=glass))
        return open_bench(path, "llvm_ad_spectral", None, place / "lines.toml")

    found = {name: both(name, opened) for name in names}
    drawn = opened("slab", GLASS)
    found["refusals"] = {
        "factored": refusal(lambda: followed(drawn)),
        "reference": refusal(lambda: reference(drawn.loaded, 4, 0)),
    }
    return found


def refusal(trace: Callable[[], object]) -> str:
    """What is said where light is not traced."""
    try:
        trace()
    except MitsimError as error:
        return str(error)
    return "traced"


@pytest.fixture(scope="module")
def light(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], dict[str, Any]]:
    """Light of scenes, from a child process: this one has another variant."""

    @cache
    def trace(*names: str) -> dict[str, Any]:
        return in_child("tests.physics.test_dispersion", tmp_path_factory.mktemp("dispersion"), *names)

    return trace


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_each_line_is_bent_by_its_own_index(light: Callable[[str], dict[str, Any]], name: str) -> None:
    """Light, places and pixels of each line are those of a line alone in plain glass of that index.

    By some way the lines differ, beside their power, by more than a hundred times the tolerance.
    """
    apart = []
    for way, (whole, alone) in light(*SCENES)[name].items():
        ours, theirs = np.array(whole), np.array(alone)
        np.testing.assert_allclose(ours, theirs, rtol=ROUNDING, atol=ROUNDING * np.abs(theirs).max(), err_msg=way)
        apart.append(np.ptp(theirs / np.abs(theirs).sum(axis=-1, keepdims=True), axis=-2).max())
    assert max(apart) > 100 * ROUNDING


def test_drawn_wavelengths_are_refused(light: Callable[[str], dict[str, Any]]) -> None:
    """By either estimator: paths of four wavelengths would all be bent as the first is."""
    reported = light()["refusals"]
    assert reported["factored"].startswith("variant llvm_ad_spectral: ") and "colour lines" in reported["factored"]
    assert "got 'mitsim_glass' in <bsdf" in reported["reference"] and "use a mono variant" in reported["reference"]
