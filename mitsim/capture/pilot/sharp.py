"""Projector pixels that light sharp lobes: from light that was found by sampling lobes to the pixels to trace apart."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from mitsim.capture.evidence import SharpPixels
from mitsim.capture.simulation import Simulation
from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.seeds import integer
from mitsim.transport.direct import DirectTracer
from mitsim.transport.lobes import SharpLight, with_neighbours

_FEW = 8
"""Anchors a side up to which ordinary light does as well: sharp pixels are traced apart only where that is cheaper."""
_MOST = 384
"""Most anchors a side: they follow lobes down to a fiftieth of the sensor's half-width, as matrices of some 100 MiB."""
_LEFT = 0.25
"""Part of the accuracy that interpolation between anchors may leave, and pixels that are not traced apart may hold."""
_EVEN = 0.1
"""Variance of an ordinary pixel's connection, relative to its square: print and falloff (photograph: 0.05 to 0.2)."""
_WORTH = 0.5
"""Part of the paths that tracing apart must save before it is done for their sake alone; it costs a pass of its own."""
SHARP_RATE = 0.75
"""Power of the samples that the error falls with, as rays are stratified (flat plates of 1e-3 and 1e-4: 0.7 to 0.9)."""
_WELL_MET = 30.0
"""Hits of one connection of each pixel from which even points meet lobes often enough, where few anchors do: in
compact_disc (125 hits) tracing 600 pixels apart took 1.5 times the time for the same error."""
_SEEN = 0.5
"""Hits of one connection of each pixel from which the pilot's ordinary looks, 64 connections or more, tell how a lobe's
light varies over the sensor: they meet it thirty times."""
_TRIAL, _LARGEST_TRIAL = 16, 2**21
"""Samples that tell how noisy the light is, and connections of them, some 0.5 s."""
_AFFORDABLE = 2.0**29
"""Connections, some 100 s, beyond which sharp lobes are left unresolved, and said to be."""
_LOOKS = 64
"""Rays of each pixel that tell which directions its light comes from; what they overlook is counted when filed."""


def sharp_pixels(
    simulation: Simulation, sharp: SharpLight, light: float, accuracy: float, seed: int
) -> SharpPixels | None:
    """The pixels that are better traced apart, or None.

    A lobe of radius w on a sensor of half-width H is analytic but for poles at w from the sensor, so the interpolation
    between N Chebyshev nodes converges as exp(-N asinh(w / H)) (Trefethen, Approximation Theory, theorem 8.2).

    Parameters
    ----------
    simulation, sharp
        the bench, and what sampling its lobes found.
    light
        all other direct light, mean over the sensor [W m^-2].
    accuracy
        relative error asked for.
    seed
        of the rays that tell where the light comes from.
    """
    if not sharp.irradiance:
        return None
    whole, rate = sharp.irradiance + light, math.asinh(sharp.width / simulation.physics.geometry.half_width)
    anchors = max(2, math.ceil(math.log(1 / (_LEFT * accuracy)) / rate))
    if anchors > _MOST or (anchors <= _FEW and sharp.hits >= _WELL_MET):
        return None
    order = np.argsort(-sharp.moments, kind="stable")
    lit = min(int(np.count_nonzero(sharp.moments)), len(order) - 1)
    moments = np.cumsum(sharp.moments[order])[:lit]
    paths = _paths(moments, light**2 / len(order) * _EVEN, len(order), anchors)
    if anchors <= _FEW:
        count = max(int(np.argmin(paths[1:])) + 1, _unseen(sharp, order[:lit], _LEFT * accuracy * whole))
        if paths[count] > _WORTH * paths[0]:
            return None
    else:
        order = np.argsort(-sharp.by_pixel, kind="stable")
        held = np.cumsum(sharp.by_pixel[order])[:lit]
        count = min(int(np.searchsorted(held, sharp.irradiance - _LEFT * accuracy * whole)) + 1, lit)
    # Beside a lobe's light is that of its tails, which ordinary looks meet as seldom where it is small.
    pixels = with_neighbours(np.isin(np.arange(len(order)), order[:count]), simulation.bench.n)
    # One pixel at least stays with the others.
    if len(pixels) == len(order):
        pixels = np.sort(order[:count])
    left = math.exp(-anchors * rate) * sharp.irradiance / whole
    chosen = SharpPixels(tuple(pixels.tolist()), anchors, _window(simulation, pixels, seed), left)
    return chosen if _connections(simulation, chosen, accuracy, seed) <= _AFFORDABLE else None


def _unseen(sharp: SharpLight, order: Labels, negligible: float) -> int:
    """Pixels, the first in ``order``, without which the others' light is ``negligible`` or seen by ordinary looks."""
    held, moments = (np.cumsum(values[order][::-1])[::-1] for values in (sharp.by_pixel, sharp.moments))
    told = (held <= negligible) | (np.square(held) >= _SEEN * moments)
    return int(np.argmax(told)) if told.any() else len(order)


def _connections(simulation: Simulation, chosen: SharpPixels, accuracy: float, seed: int) -> float:
    """Connections that light of ``chosen`` pixels takes to be known to the ``accuracy``, by a short trial."""
    if len(chosen.pixels) * chosen.anchors**2 > _AFFORDABLE:
        return math.inf
    tracer = Simulation(simulation.bench, replace(simulation.settings, sharp=chosen)).apart
    assert tracer is not None
    samples = min(max(_LARGEST_TRIAL // tracer.lanes, 2), _TRIAL)
    seen = [tracer.trace(integer(seed, half), 0, samples) for half in range(2)]
    place = [(light.pixel * chosen.anchors + light.anchor_row) * chosen.anchors + light.anchor_column for light in seen]
    every, where = np.unique(np.concatenate(place), return_inverse=True)
    parts = np.split(where, [len(place[0])])
    first, second = (np.bincount(at, light.value, len(every)) for at, light in zip(parts, seen, strict=True))
    energy = float((first * second).sum())
    noise = math.sqrt(float(np.square(first - second).sum()) / 2 / energy) if energy > 0 else math.inf
    return float(tracer.lanes * samples * (noise / accuracy) ** (1 / SHARP_RATE))


def _paths(moments: FloatArray, even: float, pixels: int, anchors: int) -> FloatArray:
    """(k + 1,) paths for a given error, to a factor, with the first 0..k of ``pixels`` traced apart.

    ``moments`` (k,) are running sums; two kinds of light with variances V and paths P a sample take (sum sqrt(V P))^2.
    """
    count = np.arange(len(moments) + 1)
    apart = np.concatenate([[0.0], moments])
    rest = np.maximum(moments[-1] - apart, 0) + even
    return np.asarray(np.sqrt(rest * (pixels - count)) + np.sqrt(apart * count * anchors**2)) ** 2


def _window(simulation: Simulation, pixels: Labels, seed: int) -> tuple[float, float, float, float]:
    """First and last tan-angle, along rows and along columns, of the surfaces that ``pixels`` light."""
    loaded, physics = simulation.bench.loaded, simulation.physics
    parts = loaded.scene, loaded.camera, physics.projector, 2, physics.geometry
    seen = DirectTracer(*parts, pixels=pixels).trace(seed, 0, _LOOKS)
    if not seen.value.size:
        return (0.0, 0.0, 0.0, 0.0)
    return float(seen.row.min()), float(seen.row.max()), float(seen.column.min()), float(seen.column.max())
