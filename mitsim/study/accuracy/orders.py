"""Light over two, three, four and more surfaces: a stand in; what each changes in the frames, and the seconds that
following it takes, out."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import reduce
from operator import add

import numpy as np

from mitsim.capture.evidence import GROUPS, LOOKS, Changes, Part
from mitsim.capture.light import Light, traced_again
from mitsim.capture.orders import MOST, OfOrders
from mitsim.capture.rounds import first_samples
from mitsim.capture.simulation import Simulation
from mitsim.core.arrays import FloatArray
from mitsim.study.accuracy.findings import PartCost
from mitsim.study.accuracy.judge import Judge
from mitsim.study.accuracy.parts import Parts
from mitsim.study.knobs import Stand
from mitsim.study.spreads import Budget, Spread, Timed

PARENT = "interreflection"
"""The effect that this light is a share of."""
_ORDERS = {"2 surfaces": (2, 2), "3 surfaces": (3, 3), "4 surfaces": (4, 4), "5 or more": (5, MOST)}
"""Rows, and the orders of light of each. Each surface keeps its albedo of the light at most: beyond four little is
left."""
_FEWER = 4
"""Times fewer samples than the seconds are measured with tell what light changes in the frames: to a few percent of
itself, as an order is traced alone."""


class Orders:
    """Light by the number of surfaces that turn it, mirrors not counted, where the plan follows it.

    What an order changes is told by light of that order alone, in independent looks; what it takes, by following light
    to that order over following it to the one before, frames of followed light included.

    Parameters
    ----------
    stand, judge
        scene and family, and frames that changes are relative to.
    parts
        whose settings and samples the light has.
    """

    def __init__(self, stand: Stand, judge: Judge, parts: Parts) -> None:
        self._stand, self._judge, self._settings = stand, judge, parts.full.settings
        simulation = Simulation(stand.bench, self._settings)
        self._samples, self._whole_s = first_samples(simulation), parts.seconds
        self._changes: Changes | None = None
        self._followed: dict[int, Timed] = {}

    def measure(self, budget: Budget, share: float) -> None:
        """What each order changes, and then what it takes, as far as the time goes.

        Parameters
        ----------
        budget, share
            time that is left, and the part of it that all of them may take.
        """
        if PARENT not in self._stand.plan(self._stand.accuracy).settings.effects:
            return
        kept, whole = max(budget.left, 0.0) * (1 - share), budget.slower * self._whole_s
        if not budget.allows("light by surfaces", (1 + len(_ORDERS) / _FEWER) * whole, kept=kept):
            return
        # This compiles the one kernel of all orders, too.
        changes = {Part(name): self._looks(*orders) for name, orders in _ORDERS.items()}
        energy = float(np.square(self._judge.frames[self._stand.few_shots]).sum())
        self._changes = Changes.between(changes, energy)
        for last in (1, *(most for _, most in _ORDERS.values())):
            most = "all" if last == MOST else "one" if last == 1 else f"up to {last}"
            if budget.allows(f"time of light followed over {most}", whole, kept=kept):
                timed = self._followed[last] = Timed(self._following(last))
                timed.seconds.append(timed.again())

    @property
    def timed(self) -> list[Timed]:
        """What can be repeated."""
        return list(self._followed.values())

    @property
    def costs(self) -> tuple[PartCost, ...]:
        """What each order buys and takes, the first one first; none where the plan follows no light."""
        if self._changes is None:
            return ()
        return tuple(
            PartCost(
                name,
                *self._changes.estimate([Part(name)]),
                with_it=self._spread(most),
                without=self._spread(fewest - 1),
                in_plan=True,
                of=PARENT,
            )
            for name, (fewest, most) in _ORDERS.items()
        )

    def _spread(self, last: int) -> Spread | None:
        return self._followed[last].spread if last in self._followed else None

    def _light(self, simulation: Simulation, samples: Mapping[str, int]) -> Light:
        again = replace(self._judge.light, seed=self._stand.seed, samples=samples)
        return traced_again(again, simulation, "orders")

    def _looks(self, fewest: int, most: int) -> FloatArray:
        """(LOOKS, shots, pixels, pixels) frames of some shots by light of some orders alone."""
        fewer = {name: max(1, samples // _FEWER) for name, samples in self._samples.items()}
        light = self._light(OfOrders(self._stand.bench, self._settings, fewest, most), fewer)
        looks = [reduce(add, light.groups[look::LOOKS]) / (GROUPS // LOOKS) for look in range(LOOKS)]
        shots = self._stand.family.lighting.shots(self._stand.few_shots)
        formed = [replace(light, groups=(look,)).frames(shots, self._stand.seed) for look in looks]
        return np.array([[frame.irradiance for frame in frames] for frames in formed])

    def _following(self, last: int) -> Callable[[], float]:
        """Seconds of light that is followed over at most so many surfaces, and of its frames."""
        bench, settings = self._stand.bench, self._settings
        if last == 1:
            plain = replace(settings, effects=settings.effects - {PARENT})
            simulation = OfOrders(bench, plain, 0, MOST)
            if not simulation.tracers():
                return lambda: 0.0
            self._light(simulation, dict.fromkeys(self._samples, 1))  # compiles its kernels
        else:
            simulation = OfOrders(bench, settings, 0, last)

        def again() -> float:
            started = time.perf_counter()
            light = self._light(simulation, self._samples)
            for _ in light.frames(self._stand.family.lighting, self._stand.seed):
                pass
            return time.perf_counter() - started

        return again
