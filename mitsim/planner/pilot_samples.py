"""Frames in a few independent replicates: what is compared in, relative changes without the noise's own energy out.

Looks see the same change with independent noise, so the mean product of two different ones estimates its square.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mitsim.bench.apparatus import Apparatus
from mitsim.core.arrays import FloatArray, Labels
from mitsim.core.parallel import in_threads
from mitsim.devices.patterns import Lighting
from mitsim.light.grids import Grid
from mitsim.light.settings import Approximation, Settings
from mitsim.light.simulation import Simulation
from mitsim.optics.image_formation import Entries
from mitsim.optics.shadow import Places
from mitsim.transport.from_camera import CombinedTracer, FromCameraTracer
from mitsim.transport.records import AMBIENT, PathSamples

Known = dict[Hashable, tuple[Sequence[PathSamples], FloatArray]]
"""Frames that were formed, with the light that they show."""
_SHOTS, _MOST_SHOTS, _SHOWN = 4, 16, 1024
"""Shots of the family that the pilot replicates at: patterns of a family differ little, and each costs its forming; but
more where they show fewer pixels than this all together, which are no fair sample of the scene, or a mirror does."""
_PLACES = 96
"""Rows and columns of pixels that the pilot replicates at: a frame's neighbours are alike, and each costs its forming.
Where they meet, changes are told to 1 to 5 %, as by 128, and by 64 to 1 to 8 % (anchors, layers, cells and effects of
photograph, gift_card, compact_disc and metal_blade, against all 512)."""
_GOLDEN = (math.sqrt(5) - 1) / 2
"""Steps by it never meet a mask's features in one phase."""
_DIGITS = 12
"""Of a pattern's light, all but those that rounding makes."""
_SPARSE = 8
"""Places for each entry of light beyond which entries are sorted, and places not counted."""
_PIXELS = 64**2
"""Few pixels are sampled more often, until they take as many samples as so many pixels."""
_MOST_PATHS = 2**20
"""Paths of one replicate that are held at a time: 60 MB."""
_AT_ONCE = 2**19
"""Paths of a longer replicate that are held at a time: 30 MB."""
_CLOSER = 16
"""Times the samples of a replicate that a closer replicate takes at most: its standard errors are a quarter; of four,
they were as large as before in half of the cases (cookie_bag, corner)."""
_SHARP_PATHS = 2**18
"""Paths of sharp pixels in one replicate: each is accumulated in four cells, again and again."""
_MOST_SHARP = 256
"""Samples of a sharp pixel in a replicate: its error is then 3e-3 (plates of roughness 1e-3 and 1e-4)."""
_OCCLUDED, _MOST_OCCLUDED, _FEWEST_OCCLUDED = 2**9, 2**11, 4
"""Points on occluded pixels in a first replicate, each seen from up to 32 x 32 anchors, the most in any (2^21
connections, some 0.5 GB in four replicates), and the fewest of one pixel."""
EVEN_CELLS = 0.25
"""Half as large cells leave this much of the error where light is smooth: they are of second order."""
_UNKNOWN_GAIN = 0.5
"""What a step leaves of the one before where that is not known, or not small."""
GOOD_ENOUGH = 0.3
"""Part of the accuracy below which a finer step is not tried: its square is a tenth of the budget's."""


@dataclass(frozen=True)
class Sample:
    """The shots that the pilot replicates at, the rows and columns of pixels, and how many samples it takes.

    ``times`` multiplies the samples of the first, shortest replicate.
    """

    lighting: Lighting
    places: Places
    times: int = 1

    @classmethod
    def of(cls, lighting: Lighting, shape: tuple[int, int], mirrors: bool) -> Sample:
        """A few shots of a family, and rows and columns of the sensor, evenly spread.

        Parameters
        ----------
        lighting
            the family.
        shape
            rows and columns of a frame.
        mirrors
            whether a shot's light may be that of few of the pixels that it shows, in a mirror.
        """
        shots = len(lighting.weights)
        lit = np.bincount(lighting.labels, minlength=lighting.weights.shape[1]) @ (lighting.weights[0] != 0)
        few = _MOST_SHOTS if mirrors else _SHOWN // max(int(lit), 1)
        wanted = min(max(_SHOTS, few), _MOST_SHOTS, shots)
        chosen = np.unique(np.linspace(0, shots - 1, wanted).astype(int))
        return cls(lighting.shots(chosen), (_spread(shape[0]), _spread(shape[1])))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns that are looked at."""
        return len(self.places[0]), len(self.places[1])

    @property
    def rows(self) -> Labels:
        """Class of each row of light that is accumulated by class."""
        return np.arange(self.lighting.weights.shape[1])

    @property
    def shown(self) -> Labels:
        """Projector pixels that the shots show."""
        return np.flatnonzero((self.lighting.weights != 0).any(axis=0)[self.lighting.labels])

    @property
    def fine(self) -> int:
        """Samples a shown pixel to tell cells and layers apart, in each replicate."""
        return self._within(4 * self.times * max(1, _PIXELS // len(self.shown)), len(self.shown))

    @property
    def anchored(self) -> int:
        """Samples a shown pixel to tell anchors apart, in each replicate."""
        return max(1, self.fine // 4)

    @property
    def direct(self) -> int:
        """Samples a projector pixel to tell effects apart, in each replicate."""
        pixels = len(self.lighting.labels)
        return self._within(2 * self.times * max(1, _PIXELS // pixels), pixels)

    @property
    def followed(self) -> int:
        """Samples a projector pixel of indirect light, and a cell of light that is followed from the camera."""
        return max(1, self.direct // 2)

    def closer(self, paths: int) -> int:
        """Samples of so many ``paths`` that a closer replicate at followed light takes at most."""
        return self._within(_CLOSER * self.followed, paths)

    def samples_of_occluded(self, pixels: int) -> int:
        """Samples of each of so many occluded ``pixels``, in each replicate."""
        return max(_FEWEST_OCCLUDED, min(self.times * _OCCLUDED, _MOST_OCCLUDED) // max(pixels, 1))

    def sharp(self, simulation: Simulation) -> int:
        """Samples of each pixel that a ``simulation`` traces apart, in each replicate."""
        paths = simulation.sharp.paths_per_sample if simulation.sharp else 1
        return min(max(_SHARP_PATHS // paths, 4), _MOST_SHARP)

    def _within(self, samples: int, pixels: int) -> int:
        return max(1, min(samples, _MOST_PATHS // pixels))

    def simulation(self, bench: Apparatus, settings: Settings, one_line: bool = False) -> Simulation:
        """A simulation whose frames are formed at the sample's pixels.

        Parameters
        ----------
        bench, settings, one_line
            as for :class:`mitsim.light.grids.Grids`.
        """
        made = Simulation(bench, settings, one_line=one_line, places=self.places)
        made.divides = False
        return made

    def frames(
        self,
        grid: Grid,
        replicates: Sequence[PathSamples],
        samples: int,
        emitted: FloatArray | None = None,
        known: Known | None = None,
    ) -> FloatArray:
        """(replicates, shots, rows, columns) frames of light in each replicate, nothing set to zero that came out below
        it.

        A shot's pattern and what all pixels emit at least make a frame each.

        Parameters
        ----------
        grid
            where the light is accumulated.
        replicates
            light of each.
        samples
            that it is divided by.
        emitted
            (shots, classes) part of its full power that each class emits; None: what the shots show.
        known
            holds what was formed, and is not formed again.
        """
        emitted = self.lighting.weights if emitted is None else emitted
        least, most = emitted.min(axis=1), emitted.max(axis=1)
        span = np.where(most > least, most - least, 1.0)
        pattern = (emitted - least[:, None]) / span[:, None]
        of_all = np.ones((int(least.any()), emitted.shape[1]))
        seen = self._class_frames(grid, replicates, np.concatenate([pattern, of_all]), known)
        frames = span[:, None, None] * seen[:, : len(pattern)]
        if len(of_all):
            frames += least[:, None, None] * seen[:, len(pattern) :]
        return frames / samples

    def lamps(
        self, grid: Grid, replicates: Sequence[PathSamples], samples: int, known: Known | None = None
    ) -> FloatArray:
        """(replicates, 1, places, places) frames of lamps' light in each replicate.

        Parameters
        ----------
        grid, replicates, samples, known
            as for :meth:`frames`.
        """
        pattern = np.zeros((1, self.lighting.weights.shape[1] + 1))
        pattern[:, -1] = 1
        return self._class_frames(grid, replicates, pattern, known) / samples

    def _class_frames(
        self, grid: Grid, replicates: Sequence[PathSamples], patterns: FloatArray, known: Known | None
    ) -> FloatArray:
        """(replicates, patterns, rows, columns) frames of classes that are lit in ``patterns`` (patterns, classes),
        where lamps are the last class; else as for :meth:`frames`."""
        known = {} if known is None else known
        classes = self.lighting.weights.shape[1]
        patterns = np.pad(patterns, ((0, 0), (0, classes + 1 - patterns.shape[1])))
        light = grid.key, *map(id, replicates)
        keys = [(*light, np.round(row, _DIGITS).tobytes()) for row in patterns]
        missing = [place for place, key in enumerate(keys) if key not in known]
        classes_of = np.append(self.lighting.labels, [classes] * grid.bundle.lamps)
        size = grid.bundle.size
        entries = in_threads(grid.bundle.entries, replicates) if missing else []
        optics = grid.optics if any(len(place) for place, *_ in entries) else None

        def form(row: int) -> None:
            frames = np.zeros((len(replicates), *self.shape))
            if optics:
                share = patterns[row][classes_of]
                seen = optics.probe(
                    [gather_places(place, value * share[pixel], size) for place, value, pixel in entries]
                )
                frames = np.moveaxis(seen.reshape(len(frames[0]), len(frames), -1), 1, 0)
            # The replicates are held with the frames: their numbers must not be given to others.
            known[keys[row]] = replicates, frames

        in_threads(form, missing)
        return np.stack([known[key][1] for key in keys], axis=1)


def _spread(count: int) -> tuple[int, ...]:
    """Some of so many rows or columns, evenly spread."""
    some = min(count, _PLACES)
    places = (np.arange(some) + (np.arange(some) * _GOLDEN) % 1) * count / some
    return tuple(places.astype(int).tolist())


def ladder(
    steps: Iterable[int], frames: Callable[[int], FloatArray], first: int, tolerance: float, least_gain: float = 0.0
) -> Mapping[int, FloatArray]:
    """Change of the frames from each step to what ever finer ones come to.

    Each step is taken to gain as much over the one before as the last two did: what the finest leaves of the sum.

    Parameters
    ----------
    steps
        numbers from coarse to fine.
    frames
        (replicates, ...) of a step.
    first
        index of the step that judges at first; finer ones are tried until what the judge leaves is good enough.
    tolerance
        norm of the change by all finer steps below which none is tried.
    least_gain
        what a step leaves at least of the one before, where that is known.
    """
    counts = list(steps)
    tried = {count: frames(count) for count in counts[: first + 1]}
    while True:
        *earlier, before, judge = tried
        last = tried[judge] - tried[before]
        gain = _gain(norm(last), norm(tried[before] - tried[earlier[-1]])) if earlier else _UNKNOWN_GAIN
        rest = max(gain, least_gain) / (1 - max(gain, least_gain))
        # Two steps tell what the judge leaves; one alone, what the step before it does.
        if (rest if earlier else 1 + rest) * norm(last) <= tolerance or judge == counts[-1]:
            break
        following = counts[counts.index(judge) + 1]
        tried[following] = frames(following)
    limit = tried[judge] + rest * last
    return {count: limit - found for count, found in tried.items()}


def _gain(last: float, before: float) -> float:
    """Size of the last step over the one before; at most as much as noise may feign."""
    return min(last / before, _UNKNOWN_GAIN) if before > 0 else _UNKNOWN_GAIN


def coarsening_changes(
    name: str, frames: Callable[[int, tuple[float, ...]], FloatArray], layers: tuple[float, ...]
) -> dict[Approximation, FloatArray]:
    """Change of the frames by one coarse cell a pixel for light called ``name``, and by one layer for it.

    Parameters
    ----------
    name
        of the light.
    frames
        (replicates, ...) that it makes in so many coarse cells a side of a pixel and such layers.
    layers
        depths [mm] that judge the one; none for a flat scene.
    """
    one, two = frames(1, ()), frames(2, ())
    changes = {Approximation(f"{name} cells", 1): (two - one) / (1 - EVEN_CELLS)}
    return {**changes, Approximation(f"{name} layers", 1): frames(1, layers) - one} if layers else changes


def gather_places(places: Labels, values: FloatArray, size: int) -> Entries:
    """Distinct places that hold light, increasing, and the light of each.

    Parameters
    ----------
    places, values
        of light in any order.
    size
        number of all places.
    """
    lit = values != 0
    places, values = places[lit], values[lit]
    if size > _SPARSE * len(places):
        found, index = np.unique(places, return_inverse=True)
        return found, np.bincount(index, values, len(found)).astype(np.float64)
    light = np.bincount(places, values, size).astype(np.float64)
    found = np.flatnonzero(light)
    return found, light[found]


def product(one: FloatArray, other: FloatArray) -> float:
    """Inner product of ``one`` and the ``other`` (replicates, ...), mean over pairs of different replicates."""
    replicates = len(one)
    # Sums by numpy: those of BLAS depend on the number of its threads in the last bits.
    whole = float((one.sum(axis=0) * other.sum(axis=0)).sum())
    return (whole - float((one * other).sum())) / (replicates * (replicates - 1))


def norm(seen: FloatArray) -> float:
    """Norm of frames ``seen`` in replicates, without their noise."""
    return math.sqrt(max(product(seen, seen), 0.0))


def heavy_paths(tracer: FromCameraTracer | CombinedTracer, seed: int, samples: int) -> PathSamples:
    """The projector's light, a few samples at a time: few paths bring any, but lamps shine on all of them.

    Parameters
    ----------
    tracer, seed, samples
        from the camera's side, the root of its random numbers, and how many are traced.
    """
    each = max(1, _AT_ONCE // tracer.paths_per_sample)
    parts = [tracer.trace(seed, first, min(each, samples - first)) for first in range(0, samples, each)]
    return PathSamples.join([part.where(part.kind != AMBIENT) for part in parts])


def noise(seen: FloatArray) -> float:
    """Norm of the error of one replicate of frames ``seen``."""
    return math.sqrt(float(np.square(seen - seen.mean(axis=0)).sum()) / (len(seen) - 1))
