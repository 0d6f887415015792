"""How far from the axis light comes: from a simulation to the largest tan-angle that its cells must hold."""

from __future__ import annotations

from mitsim.capture.simulation import Simulation

_CONNECTIONS = 2**16
"""Connections that look for near surfaces, some 10 ms; what they overlook is counted when the light is filed."""
_FLAT = 1e-4
"""Relative distance of the nearest light from the mean below which the scene is flat: single precision is 1e-7."""


def light_reach(simulation: Simulation, seed: int) -> float | None:
    """Largest tan-angle of direct light at any point of the sensor, seen from its centre; None: that of its depth.

    At the field stop's edge the sensor sees surfaces nearer than the mean depth beyond the cells of a flat scene.
    Found by connections to random points of the sensor, plus a projector pixel for what they did not meet; never more
    than the nearest light can have.

    Parameters
    ----------
    simulation
        with the depth that the cells are made for.
    seed
        of the connections.
    """
    bench, depth = simulation.bench, simulation.settings.depth
    tracer = simulation.spread
    deposits = tracer.trace(seed, 0, max(1, _CONNECTIONS // tracer.lanes))
    if not deposits.value.size:
        return None
    nearest = 1 / float(deposits.inverse_depth.max())
    if nearest > depth * (1 - _FLAT):
        return None
    farthest = max(float(abs(angle).max()) for angle in (deposits.row, deposits.column))
    pixel = max((last - first) / bench.n for first, last in bench.windows_at(depth))
    reach = min(farthest + pixel, simulation.physics.geometry.reach(nearest))
    return reach if reach > simulation.reach else None
