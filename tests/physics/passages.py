"""What tests of light through holes, panes and filters share: things in the way, and all light that the tracers find.

Means over independent seeds, whose gate of seven standard errors stands for five of the t distribution of eight.
"""

from dataclasses import replace

import numpy as np

from mitsim.api.bench import Bench
from mitsim.transport.direct import DirectTracer
from mitsim.transport.from_camera import FromCameraTracer
from mitsim.transport.integrator import IndirectTracer, Paths
from mitsim.transport.records import aligned_grid

SEEDS, SIGMAS = 8, 7.0
METAL = """<bsdf type="twosided"><bsdf type="roughconductor"><string name="material" value="none"/>
    <float name="alpha" value="0.2"/></bsdf></bsdf>"""
MIRROR = '<bsdf type="twosided"><bsdf type="conductor"><string name="material" value="none"/></bsdf></bsdf>'
THIN = '<bsdf type="thindielectric"/>'
LAMP = """<shape type="rectangle"><transform name="to_world"><scale x="15" y="15"/><translate z="120" x="-40"/>
    </transform>    <emitter type="area"><spectrum name="radiance" value="0.5"/></emitter></shape>"""


def plate(z: float, bsdf: str, half: float = 25.0, x: float = 0.0, turn: float = 0.0) -> str:
    return f"""<shape type="rectangle"><transform name="to_world"><scale x="{half}" y="{half}"/>
        <rotate y="1" angle="{180 + turn}"/><translate x="{x}" z="{z}"/></transform>{bsdf}</shape>"""


def direct_light(bench: Bench, seed: int, samples: int = 64) -> float:
    """Of the projector over one surface, at the sensor's centre."""
    tracer = DirectTracer(bench.setup, 1)
    return float(tracer.trace(seed, 0, samples).value.sum()) / samples


def all_light(bench: Bench, seed: int, samples: int = 128, lens: float = 0.0, focus: float = 400.0) -> np.ndarray:
    """(3,) of each kind at the sensor's centre: ambient, direct, indirect; ``lens`` and ``focus`` of the projector."""
    setup = replace(bench.setup, projector=replace(bench.projector_optics, aperture=lens, focus=focus))
    aim = aligned_grid(*bench.windows, 64, 1, bench.geometry.tan_half_fov + 0.01)
    tracers = (
        (DirectTracer(setup, 1), samples),
        (IndirectTracer(setup, Paths(True, True)), 4 * samples),
        (FromCameraTracer(setup, aim, Paths(True, True, bench.loaded.lamps)), samples),
    )
    light = np.zeros(3)
    for tracer, count in tracers:
        path_samples = tracer.trace(seed, 0, count)
        light += np.bincount(path_samples.kind, path_samples.value / count, minlength=3)
    return light


def mean(values: list[float]) -> tuple[float, float]:
    return float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))
