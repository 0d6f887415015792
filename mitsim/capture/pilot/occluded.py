"""Projector pixels whose light is hidden from part of the sensor: from a simulation to the pixels."""

from __future__ import annotations

import numpy as np

from mitsim.capture.simulation import Simulation
from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.seeds import integer
from mitsim.transport.direct import DirectTracer
from mitsim.transport.lobes import with_neighbours

_ANCHORS, SMOOTH = 5, 3
"""Anchors a side that tell where light is rough over the sensor, and how many hold all of what is smooth: what a
polynomial of that many coefficients leaves. Falloff leaves 1e-7 of three (`cards`, `cookie_bag`), an edge a third."""
_FIRST, _NEAR = 4, 16
"""Rays of every pixel, and of each near one that is hidden in part: sixteen meet an edge that crosses a tenth of it
four times in five."""
_LEFT = 0.1
"""Part of the accuracy that may stay on the other pixels."""
_MOST = 1 / 16
"""Part of all pixels beyond which light is rough everywhere, which more anchors for all of them serve as well."""


def occluded_pixels(simulation: Simulation, accuracy: float, seed: int) -> tuple[int, ...]:
    """The pixels, increasing, of those that are not traced apart.

    An object's edge hides a pixel's light from a part of the sensor only where its shadow, cast from the sensor, has
    its penumbra: a line of pixels, while all others are smooth over the sensor.

    Parameters
    ----------
    simulation
        the bench.
    accuracy
        relative error asked for.
    seed
        of the rays.
    """
    n, sharp = simulation.bench.n, simulation.settings.sharp
    pixels = np.setdiff1d(np.arange(n**2), sharp.pixels) if sharp else np.arange(n**2)
    rough, whole = _roughness(simulation, pixels, _FIRST, seed)
    rest = (_LEFT * accuracy) ** 2 * whole
    found = pixels[_most(rough, rest)]
    every, looked = np.zeros(n**2), np.zeros(n**2, dtype=bool)
    # Few rays miss what is hidden by a little; it lies beside what is hidden by much.
    while len(near := np.intersect1d(_beside(found, n), pixels[~looked[pixels]])):
        if looked.sum() + len(near) > 9 * _MOST * n**2:
            return ()
        every[near], _ = _roughness(simulation, near, _NEAR, integer(seed, "near", int(looked.sum())))
        looked[near] = True
        found = _most(every, rest)
    return tuple(np.sort(found).tolist()) if len(found) <= _MOST * n**2 else ()


def _beside(found: Labels, n: int) -> Labels:
    """The pixels of ``found`` and their neighbours."""
    chosen = np.zeros(n**2, dtype=bool)
    chosen[found] = True
    return with_neighbours(chosen, n)


def _most(rough: FloatArray, rest: float) -> Labels:
    """Indices of the largest values of ``rough`` whose others sum to no more than the ``rest``."""
    order = np.argsort(-rough, kind="stable")
    left = rough.sum() - np.cumsum(rough[order])
    return order[: int(np.argmax(left <= rest)) + 1] if rough.sum() > rest else order[:0]


def _roughness(simulation: Simulation, pixels: Labels, samples: int, seed: int) -> tuple[FloatArray, float]:
    """(m,) square of what a smooth function of the place on the sensor leaves of each pixel's light, and of all light.

    Parameters
    ----------
    simulation
        the bench.
    pixels
        (m,) of the projector.
    samples
        rays of each.
    seed
        of the rays.
    """
    loaded, physics = simulation.bench.loaded, simulation.physics
    tracer = DirectTracer(loaded.scene, loaded.camera, physics.projector, _ANCHORS, physics.geometry, pixels=pixels)
    seen = tracer.trace(seed, 0, samples)
    place = (np.searchsorted(pixels, seen.pixel) * _ANCHORS + seen.anchor_row) * _ANCHORS + seen.anchor_column
    light = np.bincount(place, seen.value / samples, len(pixels) * _ANCHORS**2).reshape(-1, _ANCHORS, _ANCHORS)
    # Orthonormal polynomials at Chebyshev's nodes, by degree: the discrete cosine transform.
    angle = (np.arange(_ANCHORS) + 0.5) * np.pi / _ANCHORS
    basis = np.cos(np.outer(np.arange(_ANCHORS), angle)) * np.sqrt(2 / _ANCHORS)
    basis[0] /= np.sqrt(2)
    squares = np.square(np.einsum("ka,pab,lb->pkl", basis, light, basis))
    smooth = squares[:, :SMOOTH, :SMOOTH].sum(axis=(1, 2))
    whole = squares.sum(axis=(1, 2))
    return np.asarray(whole - smooth), float(whole.sum())
