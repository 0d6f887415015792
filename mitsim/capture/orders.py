"""A bench, settings and orders of light in; a simulation of the followed light of these orders alone, out."""

from __future__ import annotations

from dataclasses import replace

from mitsim.capture.bench import Bench
from mitsim.capture.evidence import Settings
from mitsim.capture.simulation import Simulation, Stage
from mitsim.core.arrays import Labels
from mitsim.optics.frames import ClassFrames
from mitsim.transport.paths import ANY, FollowingTracer

MOST = ANY
"""The order of light over any number of surfaces."""


class OfOrders(Simulation):
    """Followed light of the orders ``fewest`` to ``most`` (:class:`mitsim.transport.paths.FollowingTracer`) alone: no
    direct light, no glint."""

    def __init__(self, bench: Bench, settings: Settings, fewest: int, most: int) -> None:
        """What is followed.

        Parameters
        ----------
        bench, settings
            as for :class:`Simulation`.
        fewest, most
            orders of the light that is kept.
        """
        super().__init__(bench, settings)
        self._orders = fewest, most

    def tracers(self) -> dict[str, Stage]:
        """Those that follow light, by the name of their stage."""
        found = {}
        for name, stage in super().tracers().items():
            if isinstance(stage.tracer, FollowingTracer):
                found[name] = replace(stage, tracer=stage.tracer.of_orders(*self._orders))
        return found

    def glint_frames(self, labels: Labels) -> ClassFrames | None:
        """None, whatever the ``labels``: glint is not followed by any of these tracers."""
        return None
