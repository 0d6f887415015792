"""The passes that light is traced in, one row each: what makes its paths, where their light is accumulated, its cost.

:data:`PASSES` is read by all that enumerates light: tracing, accumulation, rounds of sampling, costs, pilot, plans and
files. A new pass is a row here, and its tracer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np

from mitsim.bench.effects import names
from mitsim.light.settings import Number, Settings
from mitsim.light.tracers import PassTracer, Tracers

FOLLOWED = names(lambda effect: effect.followed)
"""Effects whose light is followed over several surfaces or from the camera."""


@dataclass(frozen=True)
class Pass:
    """One pass.

    Attributes
    ----------
    name
        of the pass.
    stream
        name of its random numbers: a seed, so that the same seed gives the same frames as in earlier versions.
    tracer
        makes what traces it; None where there is no such light.
    unit_cost
        seconds of a path, or of a connection to one anchor, by which plans compare their choices.
    grid
        that its light is accumulated in (:data:`mitsim.light.grids.GRIDS`).
    indirect_grid
        that its light over several surfaces is accumulated in, if not there too.
    anchors
        setting that counts its anchors; what is accumulated is then the residual, light beyond its mean over them.
    effects
        of which one at least calls for it; none: it is always traced.
    even
        whether its samples are points of a Sobol sequence alone, so that their number matters: direct light's.
    variance_rate
        power of the samples that its variance falls with.
    flux
        whether it tells the flux of each projector pixel.
    device
        whether its light is added up on the device: wherever the sums have ``room``, or where that ``pays`` too, as its
        paths are many for its cells; none: on the host.
    pilot
        run of the pilot that measures its noise (:mod:`mitsim.planner.pilot`).
    key
        of its samples in plans, where that is not its name.
    """

    name: str
    stream: str
    tracer: Callable[[Tracers], PassTracer | None]
    unit_cost: float
    grid: str
    indirect_grid: str = ""
    anchors: str = ""
    effects: frozenset[str] = frozenset()
    even: bool = False
    variance_rate: float = 1.0
    flux: bool = False
    device: Literal["", "room", "pays"] = ""
    pilot: str = "effects"
    key: str = ""

    @property
    def samples_key(self) -> str:
        """Of its samples in plans."""
        return f"{self.key or self.name}_samples"

    @property
    def grids(self) -> tuple[str, ...]:
        """All that its light is accumulated in; the last is the one on the device."""
        return tuple(filter(None, (self.grid, self.indirect_grid)))

    def called_for(self, effects: frozenset[str]) -> bool:
        """Whether ``effects`` call for it."""
        return not self.effects or bool(self.effects & effects)

    def predicted(self, settings: Settings) -> float:
        """Samples of a group that ``settings`` predict."""
        return settings.samples.get(self.name, 1.0)

    def whole(self, samples: Number) -> Number:
        """Samples that are traced where so many ``samples`` are needed: one at least, and whole."""
        least = np.maximum(samples, 1.0)
        return even(least) if self.even else np.ceil(least)

    def connections(self, counts: object) -> Number:
        """Connections of each path, where ``counts`` has the number of anchors as settings call it; 0 for a residual
        over one anchor."""
        if not self.anchors:
            return 1.0
        count = np.asarray(getattr(counts, self.anchors), dtype=np.float64)
        return np.asarray(count**2 * (count > 1))


def even(samples: Number) -> Number:
    """The least 2^k or 3 * 2^k from ``samples`` on: so many points of a Sobol sequence are spread evenly."""
    power = np.exp2(np.floor(np.log2(np.maximum(samples, 1.0))))
    found = np.where(samples <= power, power, np.where((samples <= 1.5 * power) & (power > 1), 1.5 * power, 2 * power))
    return found if isinstance(samples, np.ndarray) else float(found)


_ROWS = (
    Pass(
        name="direct",
        stream="direct",
        tracer=lambda made: made.direct,
        unit_cost=1.8e-7,
        grid="fine",
        even=True,
        variance_rate=1.5,
        flux=True,
        pilot="cells",
    ),
    Pass(
        name="anchor_residual",
        key="anchored",
        stream="anchored",
        tracer=lambda made: made.anchored,
        unit_cost=1.6e-7,
        grid="anchor_residual",
        anchors="anchors",
        even=True,
        device="pays",
        pilot="anchors",
    ),
    Pass(
        name="penumbra",
        key="occluded",
        stream="occluded",
        tracer=lambda made: made.anchored_occluded,
        unit_cost=5e-7,
        grid="penumbra",
        anchors="occluded_anchors",
        even=True,
        pilot="occluded",
    ),
    Pass(
        name="sharp",
        stream="sharp",
        tracer=lambda made: made.sharp,
        unit_cost=3e-7,
        grid="sharp",
        even=True,
        flux=True,
        device="pays",
    ),
    Pass(
        name="indirect",
        stream="indirect",
        tracer=lambda made: made.indirect,
        unit_cost=1.2e-7,
        grid="fine",
        indirect_grid="indirect",
        effects=FOLLOWED,
        device="room",
    ),
    Pass(
        name="from_camera",
        stream="other",
        tracer=lambda made: made.from_camera,
        unit_cost=2e-7,
        grid="fine",
        indirect_grid="indirect",
        effects=FOLLOWED,
    ),
    Pass(
        name="indirect_residual",
        key="followed",
        stream="indirect at anchors",
        tracer=lambda made: made.at_anchors[0],
        unit_cost=1.3e-7,
        grid="indirect_residual",
        anchors="followed_anchors",
        effects=FOLLOWED,
        device="room",
        pilot="followed",
    ),
    Pass(
        name="camera_residual",
        key="followed_from_camera",
        stream="from camera at anchors",
        tracer=lambda made: made.at_anchors[1],
        unit_cost=1.3e-7,
        grid="indirect_residual",
        anchors="followed_anchors",
        effects=FOLLOWED,
        pilot="followed",
    ),
)
"""In the order in which they are traced and their light is added up. Unit costs were chosen near what was measured of
eight shipped scenes on two cores (plans at 1e-3, November 2026); only their ratios decide. Direct light takes half as
much where one cell a pixel holds it, and more in many fine ones."""


def table_of(*rows: Pass) -> Mapping[str, Pass]:
    """The ``rows`` by name, which is theirs alone, as is their stream."""
    for what in ("name", "stream"):
        values = [getattr(row, what) for row in rows]
        twice = next((value for value in values if values.count(value) > 1), None)
        if twice is not None:
            raise ValueError(f"two passes have the {what} {twice!r}")
    return MappingProxyType({row.name: row for row in rows})


PASSES = table_of(*_ROWS)
"""All passes by name."""
EVEN = frozenset(row.name for row in PASSES.values() if row.even)
"""Passes of direct light; all others follow it further."""
