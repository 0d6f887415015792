"""What each effect of the plan changes in the frames, measured apart from the pilot: bench in, changes and bounds out.

GROUPS independent traces of everything the scene has (own seeds, more samples, more layers and cells half as large as
the pilot's). Each gives the frames with an effect and without it from the same paths, so what both share cancels. The
squared change is the mean product of two different groups' differences, from which noise drops out; its standard error
is the jackknife's over groups. An effect's change is measured with all others on, where the property speaks of the
plan's own setting: what the plan leaves off changes the frames by about its accuracy, so the two differ in second
order; bounds are widened by 5 % for that.

Anchors: direct light that is connected to 1, 3 and 5 anchors a side from the same points, which is what the switch acts
on: other light is seen from the sensor's centre with and without it.

The frames are those of some captures, not of the whole family, and are formed here from the optics' products alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from mitsim.capture import effects
from mitsim.capture.bench import Bench
from mitsim.capture.evidence import Settings
from mitsim.capture.simulation import FiledLight, Simulation
from mitsim.core.parallel import in_threads
from mitsim.core.seeds import integer
from mitsim.optics.frames import FrameOptics
from mitsim.rig.patterns import Lighting
from mitsim.transport.histogram import AMBIENT, Deposits

GROUPS = 6
STUDENT = 3.36
"""One-sided 99 % of Student's distribution with GROUPS - 1 degrees of freedom."""
_ANCHORS, _ANCHOR_SAMPLES = (1, 3, 5), 8
_TRACED_ANEW = ("mirrors", "aperture", "blur", "pixel-response")
_INTERPLAY = 0.05
"""Part of a change by which it may differ with what else is simulated."""


@dataclass(frozen=True)
class Effort:
    """Samples of one group, a projector pixel of direct light, a pixel or a cell of other light; layers for depth."""

    direct: int
    other: int
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
    lighting = bench.family(patterns).lighting
    chosen = lighting.shots(np.linspace(0, len(lighting.weights) - 1, captures).round().astype(int))
    names = frozenset(effects.present(bench)) - {"speckle"}
    look = _Look(bench, chosen, Settings(depth, effects=names), effort, seed)
    return look.changes()


class _Look:
    def __init__(self, bench: Bench, lighting: Lighting, base: Settings, effort: Effort, seed: int) -> None:
        self.bench, self.effort, self.seed = bench, effort, seed
        self.labels, self.weights = lighting.labels, lighting.weights
        # Light that no capture shows is dropped before it is filed, which takes most of the time.
        self.shown = np.append(self.weights.any(axis=0)[self.labels], True)
        self.full = replace(base, subdivision=2, coarse_cells=2, coarse_layers=True)
        self.full = replace(self.full, layers=self._layers())

    def _layers(self) -> tuple[float, ...]:
        """Depths over the whole range that light is seen at; none for a flat scene."""
        simulation, seed = Simulation(self.bench, self.full), integer(self.seed, "range")
        near = np.append(simulation.direct.trace(seed, 0, 8).inverse_depth, simulation.follow(seed, 8).inverse_depth)
        low, high = max(float(near.min()), 1e-4 / self.full.depth), float(near.max())
        return () if high < low * (1 + 1e-4) else tuple(1 / np.linspace(low, high, self.effort.layers))

    def changes(self) -> dict[str, Change]:
        """Every effect that the scene has."""
        on = self.full.effects
        everything = Simulation(self.bench, self.full)
        without = {name: Simulation(self.bench, replace(self.full, effects=on - {name})) for name in on}
        if self.full.layers:
            without["layers"] = Simulation(self.bench, replace(self.full, layers=()))
        anchored = {count: Simulation(self.bench, replace(self.full, anchors=count)) for count in _ANCHORS}
        frames: list[np.ndarray] = []
        found: dict[str, list[np.ndarray]] = {name: [] for name in without}
        coarser: dict[int, list[np.ndarray]] = {count: [] for count in _ANCHORS[:-1]}
        for group in range(GROUPS):
            seed = integer(self.seed, "group", group)
            deposits = self._traced(everything, seed)
            light = self._filed(everything, deposits)
            captures = self._formed(everything, light)
            frames.append(captures)
            for name, simulation in without.items():
                if name == "black-level":
                    found[name].append(everything.physics.black_level * (self._all_lit(everything, seed) - captures))
                elif name == "interreflection":
                    found[name].append(self._of_classes(everything.smooth.optics, light.smooth))
                else:
                    again = self._traced(simulation, seed) if name in _TRACED_ANEW else deposits
                    found[name].append(captures - self._formed(simulation, self._filed(simulation, again)))
            dense = self._connected(anchored[_ANCHORS[-1]], seed)
            for count, parts in coarser.items():
                parts.append(dense - self._connected(anchored[count], seed))
        changes = {name: Change.of(parts, frames) for name, parts in found.items()}
        # What the most anchors leave: their last step, times its gain over the one before.
        first, last = (Change.of(coarser[count], frames).size for count in coarser)
        left = last * min(last / first, 1.0) if first else 0.0
        return {**changes, "anchors": Change.of(coarser[1], frames, left)}

    def _traced(self, simulation: Simulation, seed: int) -> tuple[Deposits, Deposits]:
        """Direct and other light of pixels that the captures show, and of lamps."""
        direct = simulation.direct.trace(integer(seed, "direct"), 0, self.effort.direct)
        other = simulation.follow(integer(seed, "other"), self.effort.other)
        return direct.where(self.shown[direct.pixel]), other.where(self.shown[other.pixel])

    def _filed(self, simulation: Simulation, deposits: tuple[Deposits, Deposits]) -> FiledLight:
        """What of the deposits a simulation has."""
        direct, other = deposits
        if not simulation.physics.lamps:
            other = other.where(other.kind != AMBIENT)
        light = simulation.file_direct(direct, self.labels, self.effort.direct)
        return light + simulation.file_followed(other, self.labels, self.effort.other)

    def _formed(self, simulation: Simulation, light: FiledLight) -> np.ndarray:
        """(captures, pixels, pixels) frames without the projector's black."""
        frames = self._of_classes(simulation.fine.optics, light.fine)
        frames += self._of_classes(simulation.smooth.optics, light.smooth)
        if simulation.physics.lamps:
            frames += _products_of(simulation.ambient.optics, light.fine[[-1]])
        mirrored = simulation.glint_frames(self.labels)
        if mirrored is not None:
            frames += np.tensordot(self.weights[:, mirrored.classes], mirrored.irradiance, 1)
        return frames

    def _of_classes(self, optics: FrameOptics, light: sparse.csr_array) -> np.ndarray:
        return _products_of(optics, sparse.csr_array(sparse.csr_array(self.weights) @ light[:-1]))

    def _connected(self, simulation: Simulation, seed: int) -> np.ndarray:
        """(captures, pixels, pixels) frames of direct light, the same points connected to every anchor."""
        tracer = simulation.anchored or simulation.direct
        found = tracer.trace(integer(seed, "anchors"), 0, _ANCHOR_SAMPLES)
        found = found.where(self.shown[found.pixel])
        return self._of_classes(simulation.coarse.optics, simulation.coarse.file(found, self.labels, _ANCHOR_SAMPLES))

    def _all_lit(self, simulation: Simulation, seed: int) -> np.ndarray:
        """(pixels, pixels) frame of every projector pixel lit, from a few samples, whose noise all pixels average."""
        one = np.zeros_like(self.labels)
        light = simulation.file_direct(simulation.direct.trace(integer(seed, "direct"), 0, 2), one, 2)
        light += simulation.file_followed(simulation.follow(integer(seed, "other"), 8), one, 8)
        frames = _products_of(simulation.fine.optics, light.fine[[0]])
        frames += _products_of(simulation.smooth.optics, light.smooth[[0]])
        mirrored = simulation.glint_frames(one)
        return np.asarray(frames[0] if mirrored is None else frames[0] + mirrored.irradiance.sum(axis=0))


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
