"""What each effect of the plan changes in the frames, measured apart from the pilot: bench in, changes and bounds out.

GROUPS independent traces of everything the scene has (own seeds, 3 x 3 anchors, more layers and cells half as large as
the pilot's). Each gives the frames with an effect and without it from the same paths, so what both share cancels. The
squared change is the mean product of two different groups' differences, from which noise drops out; its standard error
is the jackknife's over groups. An effect's change is measured with all others on, where the property speaks of the
plan's own setting: what the plan leaves off changes the frames by about its accuracy, so the two differ in second
order; bounds are widened by 5 % for that.

Anchors: the captures' light at the sensor's centre, scaled at each of 5 x 5 anchors by what uniform light (the same
random numbers for all anchors, twice the pilot's cells a side) does between the centre and the anchor. Which projector
pixel lights a point does not depend on the anchor, so only occlusion is smoothed over. Light of one reflection: that of
more falls off over the sensor like it, and its noise would hide the change.

The frames are those of some captures, not of the whole family, and are formed here from the optics' products alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from mitsim.capture.bench import Bench
from mitsim.capture.pilot import applicable
from mitsim.capture.simulation import Simulation
from mitsim.core.parallel import in_threads
from mitsim.core.seeds import integer
from mitsim.optics.frames import FrameOptics
from mitsim.scene.plan import Settings
from mitsim.transport.histogram import Deposits

GROUPS = 6
STUDENT = 3.36
"""One-sided 99 % of Student's distribution with GROUPS - 1 degrees of freedom."""
_ANCHORS, _DENSE = 3, 5
_LANES_AT_ONCE = 2**21
_LARGEST_RATIO = 4.0
_INTERPLAY = 0.05
"""Part of a change by which it may differ with what else is simulated."""


@dataclass(frozen=True)
class Effort:
    """Samples a cell and anchor of one group, for effects and for anchors; layers of a scene with depth."""

    effects: int
    anchors: int
    layers: int


@dataclass(frozen=True)
class Change:
    """Relative change of the frames, and the bounds that it stays within at 99 % each."""

    size: float
    low: float
    high: float

    @classmethod
    def of(cls, differences: list[np.ndarray], frames: list[np.ndarray], left: float = 0.0) -> Change:
        """From the groups' differences and frames; ``left``: relative error of the finer answer itself."""
        energy = _products(frames)
        products = _products(differences)

        def squared(kept: list[int]) -> float:
            pairs = np.ix_(kept, kept)
            off = ~np.eye(len(kept), dtype=bool)
            return float(products[pairs][off].mean() / energy[pairs][off].mean())

        everyone = list(range(len(frames)))
        found = squared(everyone)
        parts = np.array([squared([i for i in everyone if i != out]) for out in everyone])
        spread = math.sqrt((len(parts) - 1) * float(np.square(parts - parts.mean()).mean()))
        low, size, high = (math.sqrt(max(found + k * STUDENT * spread, 0.0)) for k in (-1, 0, 1))
        left += _INTERPLAY * size
        return cls(size, max(low - left, 0.0), high + left)


def measured(bench: Bench, patterns: str, captures: int, depth: float, seed: int, effort: Effort) -> dict[str, Change]:
    """Change of the frames by each effect that the scene has; ``depth`` [mm] is where one layer is put."""
    labels, weights = bench.family(patterns).classes()
    chosen = weights[np.linspace(0, len(weights) - 1, captures).round().astype(int)]
    names = frozenset(applicable(bench)) - {"speckle"}
    look = _Look(bench, labels, chosen, Settings(depth, effects=names), effort.layers, seed)
    return {**look.effects(effort.effects), "anchors": look.anchors(effort.anchors)}


class _Look:
    def __init__(
        self, bench: Bench, labels: np.ndarray, weights: np.ndarray, base: Settings, layers: int, seed: int
    ) -> None:
        self.bench, self.labels, self.base, self.count, self.seed = bench, labels, base, layers, seed
        self.weights = weights
        # Light that no capture shows is dropped before it is filed, which takes most of the time.
        self.shown = np.append(weights.any(axis=0)[labels], True)

    @cached_property
    def layers(self) -> tuple[float, ...]:
        """Depths over the whole range that light is seen at; none for a flat scene."""
        simulation = Simulation(self.bench, self.base)
        near = simulation.tracer.trace(integer(self.seed, "range"), 0, 4).inverse_depth
        low, high = max(float(near.min()), 1e-4 / self.base.depth), float(near.max())
        return () if high < low * (1 + 1e-4) else tuple(1 / np.linspace(low, high, self.count))

    def effects(self, samples: int) -> dict[str, Change]:
        """Every effect but anchors."""
        on = self.base.effects
        full = replace(self.base, anchors=_ANCHORS, layers=self.layers, subdivision=2, linear=True)
        everything = Simulation(self.bench, full)
        without = {name: Simulation(self.bench, replace(full, effects=on - {name})) for name in on}
        if self.layers:
            without["layers"] = Simulation(self.bench, replace(full, layers=()))
        frames: list[np.ndarray] = []
        found: dict[str, list[np.ndarray]] = {name: [] for name in without}
        for group in range(GROUPS):
            seed = integer(self.seed, "effects", group)
            lights = self._lights(everything, seed, samples)
            captures = self._formed(everything, lights["all"])
            frames.append(captures)
            for name, simulation in without.items():
                if name == "black-level":
                    found[name].append(everything.black * (self._all_lit(everything, seed) - captures))
                elif name == "interreflection":
                    found[name].append(self._formed(everything, lights["bounced"], exact=False))
                elif name == "ambient":
                    found[name].append(captures - self._formed(simulation, lights["all"]))
                else:
                    same = name in ("diffraction", "mask-thickness")
                    light = lights["all"] if same else self._lights(simulation, seed, samples)["all"]
                    found[name].append(captures - self._formed(simulation, light))
        return {name: Change.of(parts, frames) for name, parts in found.items()}

    def anchors(self, samples: int) -> Change:
        """One anchor against 5 a side.

        What 5 leave is taken as the step from 3 to 5, times its gain over that from 1 to 5.
        """
        base = replace(self.base, effects=self.base.effects - {"interreflection"}, linear=True)
        layers = tuple(self.layers[:: max(self.count // 4, 1)])
        ratios = {
            count: Simulation(self.bench, replace(base, anchors=count), common=True, pixels=self.bench.n // 2)
            for count in (1, 3, _DENSE)
        }
        looks = {count: Simulation(self.bench, replace(base, anchors=count, layers=layers)) for count in ratios}
        frames: list[np.ndarray] = []
        found: dict[int, list[np.ndarray]] = {1: [], 3: []}
        for group in range(GROUPS):
            centre = self._lights(looks[1], integer(self.seed, "centre", group), 16 * samples)["all"]
            captures = sparse.csr_array(self.weights) @ centre[:-1]
            uniform = integer(self.seed, "uniform", group)
            seen = {count: self._uniform(simulation, uniform, samples) for count, simulation in ratios.items()}
            made = {
                count: _products_of(looks[count].optics, self._scaled(captures, looks[count], ratios[1], seen, count))
                for count in looks
            }
            frames.append(made[_DENSE])
            for count in found:
                found[count].append(made[_DENSE] - made[count])
        rough = {count: Change.of(parts, frames) for count, parts in found.items()}
        left = rough[3].size * min(rough[3].size / rough[1].size, 1.0) if rough[1].size else 0.0
        return Change.of(found[1], frames, left)

    def _uniform(self, simulation: Simulation, seed: int, samples: int) -> np.ndarray:
        """(anchors, rows, anchors, columns) light of all classes at the corners of cells."""
        (rows, columns), anchors = simulation.bundle.cells, simulation.settings.anchors
        light = np.zeros(anchors**2 * rows * columns)
        for found in self._traced(simulation, seed, samples):
            for y, x, share in simulation.bundle.shares(found.row, found.column):
                line = found.anchor_row * rows + y
                place = (line * anchors + found.anchor_column) * columns + x
                light += np.bincount(place, found.value * share / samples, minlength=light.size)
        return light.reshape(anchors, rows, anchors, columns)

    def _all_lit(self, simulation: Simulation, seed: int) -> np.ndarray:
        """(pixels, pixels) frame of every projector pixel lit, from one sample: its light is summed over all pixels."""
        light = simulation.file(simulation.tracer.trace(seed), np.zeros_like(self.labels), 1)
        return np.asarray(_products_of(simulation.optics, light[[0]])[0])

    def _scaled(
        self,
        captures: sparse.csr_array,
        look: Simulation,
        coarse: Simulation,
        seen: dict[int, np.ndarray],
        count: int,
    ) -> sparse.csr_array:
        """The captures' light at the centre, at each anchor scaled by how uniform light differs from the centre's."""
        ratio = np.divide(seen[count], seen[1], out=np.zeros(seen[count].shape), where=seen[1] > 0)
        # Cells that the centre sees a corner of only would be noise without end.
        ratio = np.minimum(ratio, _LARGEST_RATIO)
        light = captures.tocoo()
        rows, columns = look.bundle.cells
        layer, place = np.divmod(light.col.astype(np.int64), rows * columns)
        row, column = np.divmod(place, columns)
        tau = look.bundle.rows.centres[row], look.bundle.columns.centres[column]
        beside = coarse.bundle.shares(*tau)
        parts = []
        for a, b in np.ndindex(count, count):
            scale = sum(share * ratio[a, y, b, x] for y, x, share in beside)
            where = ((layer * count + a) * rows + row) * count * columns + b * columns + column
            parts.append((light.data * scale, light.row, where))
        data, lines, where = (np.concatenate(part) for part in zip(*parts, strict=True))
        return sparse.coo_array((data, (lines, where)), shape=(light.shape[0], look.bundle.size)).tocsr()

    def _traced(self, simulation: Simulation, seed: int, samples: int) -> Iterator[Deposits]:
        """All samples, some at a time."""
        at_once = max(1, _LANES_AT_ONCE // simulation.tracer.lanes)
        for first in range(0, samples, at_once):
            yield simulation.tracer.trace(seed, first, min(at_once, samples - first))

    def _lights(self, simulation: Simulation, seed: int, samples: int) -> dict[str, sparse.csr_array]:
        """Light by class, all of it and that of more than one reflection."""
        both: dict[str, list[sparse.csr_array]] = {"all": [], "bounced": []}
        for found in self._traced(simulation, seed, samples):
            found = found.where(self.shown[found.source])
            both["all"].append(simulation.file(found, self.labels, samples))
            both["bounced"].append(simulation.file(found.where(found.order > 1), self.labels, samples))
        return {name: sum(parts[1:], parts[0]) for name, parts in both.items()}

    def _formed(self, simulation: Simulation, light: sparse.csr_array, exact: bool = True) -> np.ndarray:
        """(captures, pixels, pixels) frames without the projector's black."""
        weights, classes = self.weights, self.weights.shape[1]
        frames = _products_of(simulation.optics, sparse.csr_array(sparse.csr_array(weights) @ light[:classes]))
        if simulation.lit_by_lamps:
            frames = frames + _products_of(simulation.ambient_optics, light[[classes]])
        mirrored = simulation.mirrored(self.labels) if exact else None
        if mirrored is not None:
            frames = frames + np.tensordot(weights[:, mirrored.classes], mirrored.irradiance, 1)
        return frames


def _products_of(optics: FrameOptics, light: sparse.csr_array) -> np.ndarray:
    """The frame of each row; nothing is set to zero that came out below it, so differences stay linear."""

    def form(row: int) -> np.ndarray:
        inside = slice(light.indptr[row], light.indptr[row + 1])
        return optics.frame(light.indices[inside].astype(np.int64), light.data[inside])

    return np.stack(in_threads(form, range(light.shape[0])))


def _products(fields: list[np.ndarray]) -> np.ndarray:
    """(groups, groups) inner products."""
    flat = np.stack([field.ravel() for field in fields])
    return flat @ flat.T
