"""A short look at a scene before the real work: a bench and a lighting in, numbers that the plan decides by out.

Every error is relative, ``||a - b|| / ||b||``, over up to four shots of the family.
"""

from __future__ import annotations

import math
from dataclasses import replace

from mitsim.capture import effects
from mitsim.capture.bench import Bench
from mitsim.capture.evidence import Evidence, Settings
from mitsim.capture.pilot.direct import AnchoredLight, FineLight
from mitsim.capture.pilot.halves import Sample
from mitsim.capture.pilot.switched import SwitchedEffects
from mitsim.capture.simulation import Simulation
from mitsim.core.errors import MitsimError
from mitsim.core.seeds import integer
from mitsim.rig.patterns import Lighting
from mitsim.scene.darkness import why_dark
from mitsim.transport.left_out import left_out_light
from mitsim.transport.lobes import SharpLight, sharp_light

_LOBE_RAYS = 2**20
"""Rays that look for sharp lobes: a lobe of 1e-4 of the hemisphere is met a hundred times."""
_CAUSTIC_PATHS = 2**20
"""Paths that look for light that is left out: a thousandth of the light that all curved glass sends is met 30 times."""
_FEWEST_HITS = 30.0
"""Below so many hits the pilot's connections do not tell how much light a lobe sends, nor how noisy it is."""
_FAINT = 1e-3
"""Part of the mean light on the sensor below which its centre sees nothing but rounding."""
_ALIGNED = 1e-6
"""Relative distance from the aligned plane that is rounding: the plane keeps its exact cells."""


def measure(bench: Bench, lighting: Lighting, accuracy: float, seed: int) -> Evidence:
    """Trace a few small batches and compare effects and discretisations on a handful of shots.

    Parameters
    ----------
    bench
        what is looked at.
    lighting
        of the family that will be captured.
    accuracy
        where the search for enough anchors, layers and cells may stop.
    seed
        root of the random streams.

    Raises
    ------
    MitsimError
        when no light of the projector reaches the camera.
    """
    sample = Sample.of(lighting)
    present = effects.present(bench)
    first_look = frozenset(present) & effects.names(lambda effect: effect.first_look)
    first = Simulation(bench, Settings(depth=bench.geometry.scene_distance, effects=first_look))
    sharp = _sharp(first, seed)
    depth, light = _depth(first, seed, sharp)
    base = Settings(depth=depth, effects=first_look)
    fine = FineLight(bench, base, sample, accuracy, seed)
    layers = fine.layers()
    layer_error, cell_error = fine.layer_errors(layers), fine.cell_errors()
    switched = SwitchedEffects(bench, replace(base, effects=frozenset(present), subdivision=2), sample, seed)
    anchored = AnchoredLight(bench, base, sample, switched.light, seed)
    return Evidence(
        depth=depth,
        layers=layers,
        anchor_error=anchored.errors(accuracy),
        layer_error=layer_error,
        cell_error=cell_error,
        effect_error=switched.errors(present),
        direct_part=anchored.part,
        direct=fine.effort(switched.light),
        anchored=anchored.effort(fine.pace),
        indirect=switched.effort("indirect"),
        from_camera=switched.effort("from_camera"),
        seconds_per_frame=fine.seconds_per_frame,
        terms=float(len(bench.spectrum.weights) * (2 if bench.geometry.mask == "flatcam" else 1)),
        left_out=_left_out(switched.simulation, seed, light),
        unresolved=sharp.irradiance / (light + sharp.irradiance) if sharp.hits * sample.fine < _FEWEST_HITS else 0.0,
    )


def _sharp(simulation: Simulation, seed: int) -> SharpLight:
    """Direct light over lobes that are too sharp to be met by connections."""
    loaded = simulation.bench.loaded
    if not loaded.glossy:
        return SharpLight(0.0, 0.0, math.inf)
    parts = loaded.scene, loaded.camera, simulation.physics.projector, simulation.physics.geometry
    return sharp_light(*parts, integer(seed, "pilot", "lobes"), max(1, _LOBE_RAYS // simulation.bench.n**2))


def _left_out(simulation: Simulation, seed: int, direct: float) -> float:
    """Light that no tracer finds, over that and ``direct`` light."""
    loaded, physics = simulation.bench.loaded, simulation.physics
    if not loaded.mirrors:
        return 0.0
    samples = max(1, _CAUSTIC_PATHS // (simulation.aim.shape[0] * simulation.aim.shape[1]))
    own = integer(seed, "pilot", "caustics")
    parts = loaded.scene, loaded.camera, physics.projector, simulation.aim
    light = left_out_light(*parts, physics.geometry, own, samples)
    return light / (light + direct) if light else 0.0


def _depth(simulation: Simulation, seed: int, sharp: SharpLight) -> tuple[float, float]:
    """Where the light is seen, 1 / mean(1/z) [mm], and how much of it, from one ray of each projector pixel."""
    bench, own = simulation.bench, integer(seed, "pilot", "depth")
    deposits = simulation.direct.trace(own)
    total = float(deposits.value.sum())
    if not bench.loaded.mirrors and not sharp.irradiance:
        everywhere = Simulation(bench, replace(simulation.settings, anchors=2)).direct.trace(own)
        if total < _FAINT * float(everywhere.value.sum()):
            raise MitsimError(
                "the sensor's centre sees no light of the projector, though other parts of the sensor do: "
                + why_dark(bench.loaded)
            )
    if not total and not bench.loaded.mirrors:
        raise MitsimError(f"no light of the projector reaches the camera: {why_dark(bench.loaded)}")
    # Sums by numpy, here and elsewhere: those of BLAS depend on the number of its threads in the last bits.
    mean = float((deposits.inverse_depth * deposits.value).sum()) / total if total else 0.0
    # A plane is met at its own depth but for rounding; the aligned plane keeps its exact cells.
    flat = abs(mean * bench.geometry.scene_distance - 1) < _ALIGNED
    return bench.geometry.scene_distance if flat or mean <= 0 else 1 / mean, total
