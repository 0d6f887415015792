"""Settings, what the pilot found and unit costs in; seconds of each stage out, before anything is simulated.

The plan compares its choices at :data:`FIXED` unit costs, not at those of this machine and moment: the same seed must
mean the same settings. What the pilot measured only scales the prediction that people read.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from mitsim.bench.effects import names
from mitsim.core.arrays import FloatArray
from mitsim.devices.plate import FEW
from mitsim.light.passes import PASSES
from mitsim.light.settings import (
    CELLS_OF_COARSE,
    FOLLOWED_WIDTH,
    GROUPS,
    Forming,
    Number,
    PilotResult,
    SampleCost,
    Settings,
)
from mitsim.optics.fft_shadow import CORRELATION_PRODUCTS
from mitsim.optics.forming import PROBES
from mitsim.optics.frames import formed_frames, mixes
from mitsim.optics.image_formation import SUMMED_BYTES
from mitsim.transport.accumulator import MOST_PLACES

ROUNDS, CHECKED_SHOTS = 1.5, 16
"""Rounds that sampling takes, one or two, of followed light one more; and shots that each looks at to see the error of
many: shots' errors differ by a few percent, and each costs its look."""
MOST_CHECKED = 64
"""Shots that are looked at where light is followed over several surfaces, as heavy paths strike single ones (cookie_bag
at 1e-3 met its target in eight of 49, and not in all); and classes whose frames tell of all shots, which are formed of
them: what a look finds of them is used again."""
_CHECK = 0.4
"""Time of a look at a frame's error in that of forming the frame: 0.36 in corner, 0.44 in cookie_bag, 0.40 in
gift_card."""
MIXING = "black-level"
"""Effect that lights every pixel in every shot, so that shots are no longer single classes."""
_SPLIT, _EDGES = 2.0, 2.0
"""Layers, at most, that share the light of one depth; and how many times the cells of a pixel its light lies in, at
most, where it lies across an edge or at another depth than the cells are aligned at (measured: 1.6)."""
_GEOMETRIC_ENTRIES = 0.03
"""An entry of a geometric shadow over one of a wave-optical one: a sum over features against samples of a field."""

TRUTH_PART = 1 / 6
"""Of the error that the frames' own sampling leaves in any image, what the truth may be off by: it then adds at most
0.12 dB to the error of the best image that a run could give."""
TRUTH_GROUPS = 4
"""Independent estimates of the truth: their spread is its standard error. An edge's error falls with the samples of one
estimate, but with the root of the number of estimates: four need 0.7 of the rays of eight."""
TRUTH_SAMPLES, BOARD_SAMPLES = 16, 8
"""Samples a pixel that each of these groups begins with. 64 in all show all but a corner of a hundredth of a pixel,
which their spread would not tell of; a board has no corners."""
MOST_RAYS, MOST_SAMPLES = 2**22, 128
"""Rays of each flux, and samples a pixel where that is more, beyond which it is left as it is: some one and a half
seconds on two cores. The standard error tells how good it is then."""
_ALLOTTED = 0.5
"""Part of the rays that the truth takes for its pixels being sampled where that helps most (measured: photograph 0.5,
gift_card 0.3)."""


@dataclass(frozen=True)
class UnitCosts:
    """Seconds of single things.

    Attributes
    ----------
    passes
        a path, or a connection, of each pass by its name.
    frame, product
        a frame, and a multiplication in forming it.
    entry, accumulated
        an entry of a wave-optical shadow, and one of accumulated light.
    ray
        a ray of the truth.
    pixel
        a pixel of a shot that is looked through for its brightest and its energy.
    """

    passes: Mapping[str, float]
    frame: float
    product: float
    entry: float
    accumulated: float
    ray: float
    pixel: float = 0.0


FIXED = UnitCosts(
    passes={name: row.unit_cost for name, row in PASSES.items()},
    frame=2.2e-3,
    product=2.1e-11,
    entry=3.5e-8,
    accumulated=1e-8,
    ray=4e-8,
    pixel=4e-9,
)
"""Chosen near what was measured, as the table's; only their ratios decide."""


_MANY_ENTRIES = 1.2
"""An entry of a geometric shadow of many terms over one of a wave-optical one."""
_CELL_S = 5e-8
"""A cell of a raster of light on which waves are squared, beyond these: it is sharpened, and its largest terms are
looked for (a disc at 512 pixels, 6 to 12 cells a pixel)."""
_FURTHER_LINE = 0.2
"""What tracing takes more for each further line: 0.15 of a mono capture's seconds, 0.3 of one line's (three lines of
photograph)."""
_PASSED = 0.4
"""A place of an accumulator, which is emptied and looked through, over an entry of light that is accumulated (corner in
three lines: 4e-9 s)."""
SHARED_COST = 6
"""Paths that a path of shared indirect light takes as long as: corner 5.7, cookie_bag 3.4."""


@dataclass(frozen=True)
class Numbers:
    """Numbers of settings that cost depends on, of one choice or of (m,) choices; the first six are chosen."""

    anchors: Number
    layers: Number
    cells: Number
    followed_anchors: Number
    occluded_anchors: Number
    coarse_layers: Number
    """Whether coarse light has all layers, or one."""
    waves: float = 1.0
    indirect: float = 0.0
    mixed: float = 0.0
    occluded: float = 0.0
    """Pixels of their own anchors."""
    raster_cells: float = 0.0
    """Along a pixel, where frames are correlations by choice; 0: sums, or as few cells as a raster has."""

    @property
    def coarse(self) -> tuple[FloatArray, FloatArray]:
        """Cells a side of a projector pixel, and layers, of coarse light."""
        several = np.asarray(self.coarse_layers) > 0
        return np.where(several, np.maximum(self.cells // CELLS_OF_COARSE, 1.0), 1.0), np.where(
            several, self.layers, 1.0
        )

    @property
    def cells_of_followed(self) -> FloatArray:
        """Cells a side of a projector pixel for what anchors see of followed light, which has one layer."""
        return self.coarse[0] / FOLLOWED_WIDTH

    @classmethod
    def coarsest(cls) -> Numbers:
        """One of everything, and a wave-optical shadow."""
        return cls(*[1.0] * 6)

    @classmethod
    def of_counts(
        cls, counts: Sequence[Number], effects: frozenset[str], occluded: int = 0, raster_cells: int = 0
    ) -> Numbers:
        """Those of the six that are chosen, with ``effects``.

        Parameters
        ----------
        counts
            the first six numbers.
        effects
            that are on.
        occluded, raster_cells
            as above.
        """
        on = in_waves(effects), "interreflection" in effects, MIXING in effects
        return cls(*counts, *map(float, (*on, occluded, raster_cells)))  # type: ignore[arg-type]

    @classmethod
    def of(cls, settings: Settings) -> Numbers:
        """Those of ``settings``."""
        direct = settings.anchors, len(settings.depths), settings.subdivision
        counts = *direct, settings.followed_anchors, settings.occluded_anchors, settings.coarse_layers
        return cls.of_counts(
            [float(count) for count in counts], settings.effects, len(settings.with_own_anchors), settings.raster_cells
        )


def in_waves(effects: frozenset[str]) -> bool:
    """Whether the mask's shadow is wave-optical with these ``effects``."""
    return bool(effects & names(lambda effect: effect.in_shadow))


def sample_costs(pilot_result: PilotResult, effects: frozenset[str]) -> dict[str, SampleCost]:
    """What each pass that ``effects`` call for takes by the ``pilot_result``; connections to anchors: to one."""
    found = ((name, pilot_result.sample_costs[name]) for name in PASSES if name in pilot_result.sample_costs)
    return {name: sample_cost for name, sample_cost in found if PASSES[name].called_for(effects)}


# -------- Forming frames, and checking their error


def _by_fft(forming: Forming, numbers: Numbers) -> bool:
    """Whether frames are correlations, as they must be or as was chosen."""
    return bool(numbers.raster_cells) or forming.correlated[bool(numbers.waves)]


def _phases(forming: Forming, numbers: Numbers) -> float:
    """Raster cells that a pixel has, where frames are correlations."""
    return numbers.raster_cells**2 or forming.phases


def _products(
    forming: Forming, numbers: Numbers, lit: tuple[Number, Number], cells: Number, layers: Number, anchors: Number
) -> Number:
    """Multiplications of one frame, ``lit`` of whose rows and columns of cells hold light, and of the probes that tell
    its error.

    Parameters
    ----------
    forming, numbers
        what it depends on, and whether the shadow is wave-optical, and on a raster.
    lit, cells, layers, anchors
        parts of the rows and of the columns, cells and layers, and anchors.
    """
    rows, columns = (part * forming.cells * cells * anchors for part in lit)
    pixels = forming.pixels
    # The shorter side is multiplied out first.
    one_term = layers * (pixels * rows * columns + pixels**2 * np.minimum(rows, columns))
    of_probes = layers * GROUPS * (PROBES + 1) * (np.minimum(columns, pixels) + pixels) * rows
    if not _by_fft(forming, numbers):
        terms = forming.geometric_terms + (forming.terms - forming.geometric_terms) * numbers.waves
        return cast(Number, terms * (one_term + of_probes))
    correlation = CORRELATION_PRODUCTS * _phases(forming, numbers) * layers * np.square(anchors) * pixels**2
    terms = forming.largest_terms[bool(numbers.waves)]
    many = np.asarray(terms * 16 * pixels * forming.cells * cells > SUMMED_BYTES)
    sums, sums_of_probes = (
        np.where(many, math.inf, count * (terms if math.isfinite(terms) else 0.0)) for count in (one_term, of_probes)
    )
    # Frames and what probes see of them each take the cheaper way.
    return cast(Number, np.minimum(correlation, sums) + np.minimum(GROUPS * correlation, sums_of_probes))


def _entries(forming: Forming, numbers: Numbers) -> Number:
    """Entries of all shadows that are prepared, as many as wave-optical ones take as long."""
    coarse = (np.asarray(numbers.anchors) > 1) + numbers.indirect
    followed = (np.asarray(numbers.followed_anchors) > 1) * numbers.cells_of_followed
    sides = numbers.cells * numbers.layers + coarse * math.prod(numbers.coarse) + followed
    if _by_fft(forming, numbers):
        return cast(Number, 0.0 * sides)
    many = forming.geometric_terms > FEW
    geometric = _MANY_ENTRIES * forming.geometric_terms if many else _GEOMETRIC_ENTRIES
    terms = forming.terms * numbers.waves + geometric * (1 - numbers.waves)
    return cast(Number, 2 * forming.pixels * forming.cells * sides * terms)


def _lit_by_occluded(forming: Forming, numbers: Numbers) -> tuple[Number, Number]:
    """Parts of the rows and of the columns of cells that hold light of occluded pixels in a frame: each pixel lights
    its own, and a frame shows as many of them as of all pixels."""
    most = _EDGES * numbers.occluded * np.square(forming.lit) / forming.cells
    rows, columns = (np.minimum(forming.lit * part, most) for part in forming.occluded)
    return rows, columns


def forming_seconds(forming: Forming, numbers: Numbers, frames: Number, costs: UnitCosts) -> Number:
    """Seconds of forming so many ``frames`` of each line.

    Parameters
    ----------
    forming, numbers
        what it depends on.
    frames
        to be formed of a line.
    costs
        of this machine, or the fixed ones.
    """
    lit, every, coarse = (forming.lit, forming.lit), (1.0, 1.0), numbers.coarse
    of_occluded = _lit_by_occluded(forming, numbers)
    by_grid = (
        (1.0, lit, numbers.cells, numbers.layers, 1.0),
        (np.asarray(numbers.anchors) > 1, lit, *coarse, numbers.anchors),
        (np.asarray(numbers.occluded_anchors) > 1, of_occluded, *coarse, numbers.occluded_anchors),
        (numbers.indirect, every, *coarse, 1.0),
        (np.asarray(numbers.followed_anchors) > 1, every, numbers.cells_of_followed, 1.0, numbers.followed_anchors),
    )
    products = sum(formed * _products(forming, numbers, *grid) for formed, *grid in by_grid)
    if mixes(forming.classes, forming.shots, forming.pixels):
        products = products + numbers.mixed * forming.classes * forming.pixels**2
    return cast(Number, forming.lines * frames * (costs.frame + costs.product * products))


def optics_seconds(forming: Forming, numbers: Numbers, costs: UnitCosts) -> Number:
    """Seconds of all frames of the family, with the shadows that form them.

    Parameters
    ----------
    forming, numbers, costs
        as for :func:`forming_seconds`.
    """
    shadows = costs.entry * _entries(forming, numbers)
    if _by_fft(forming, numbers):
        drawing = forming.drawing[bool(numbers.waves)] * costs.product / FIXED.product
        if not numbers.waves:  # Waves are squared at as many points whatever the cells.
            drawing *= _phases(forming, numbers) / forming.phases
        else:
            drawing += costs.product / FIXED.product * _CELL_S * forming.pixels**2 * _phases(forming, numbers)
        # What must be drawn the pilot has drawn of one layer in the fewest cells; of several, coarse light is seen at a
        # depth of its own.
        several = np.asarray(numbers.layers) > 1
        must = forming.correlated[bool(numbers.waves)] and _phases(forming, numbers) == forming.phases
        drawn = ~several & must
        shadows = cast(Number, shadows + drawing * (numbers.layers + several - drawn))
    frames = formed_frames(forming.classes, forming.shots, forming.pixels)
    seen = costs.pixel * forming.shots * forming.pixels**2
    return forming.lines * (shadows + seen) + forming_seconds(forming, numbers, frames, costs)


def checking_seconds(forming: Forming, numbers: Numbers, costs: UnitCosts) -> Number:
    """Seconds of seeing how large the Monte Carlo error is, while light is traced.

    Parameters
    ----------
    forming, numbers, costs
        as for :func:`forming_seconds`.
    """
    rounds = ROUNDS + numbers.indirect
    if tells_all(forming.classes, forming.shots, forming.pixels):
        # The last look takes its part of forming the frames over.
        return forming_seconds(forming, numbers, _CHECK * (rounds - 1) * forming.classes, costs)
    few, many = (min(shots, forming.shots) for shots in (CHECKED_SHOTS, MOST_CHECKED))
    return forming_seconds(forming, numbers, _CHECK * rounds * (few + numbers.indirect * (many - few)), costs)


def tells_all(classes: int, shots: int, pixels: float) -> bool:
    """Whether looks see all shots, by the frames of their classes.

    Parameters
    ----------
    classes, shots, pixels
        of the family, and a side of the sensor.
    """
    return classes <= MOST_CHECKED and mixes(classes, shots, pixels)


# -------- Tracing, accumulating and the truth


def tracing_seconds(pilot_result: PilotResult, settings: Settings, costs: UnitCosts) -> dict[str, float]:
    """Seconds of tracing the samples in ``settings``, by kind of light.

    Parameters
    ----------
    pilot_result
        paths in a sample.
    settings
        the samples.
    costs
        as for :func:`forming_seconds`.
    """
    return {
        name: traced_for(pilot_result.forming.lines, pilot_result.forming.parted)
        * GROUPS
        * float(PASSES[name].whole(PASSES[name].predicted_samples(settings)))
        * sample_cost.paths
        * costs.passes[name]
        * float(PASSES[name].connections(settings))
        for name, sample_cost in sample_costs(pilot_result, settings.effects).items()
    }


def traced_for(lines: int, parted: bool = False) -> float:
    """Cost of tracing and accumulating so many ``lines``, relative to one line. They share their paths unless glass has
    ``parted`` them."""
    return lines if parted else 1 + _FURTHER_LINE * (lines - 1)


def predicted_rays(pixels: int, samples: float, rate: float) -> float:
    """Rays that truth will take for both fluxes (:mod:`mitsim.light.truth`).

    Parameters
    ----------
    pixels
        of the projector.
    samples, rate
        that each group of the frames' direct light takes a pixel, and the power of their number that its error falls
        with.
    """
    first = TRUTH_GROUPS * pixels * (TRUTH_SAMPLES + BOARD_SAMPLES)
    wanted = _ALLOTTED * GROUPS * pixels * samples * float(TRUTH_PART ** (-1 / rate))
    return min(first + wanted, max(MOST_RAYS, MOST_SAMPLES * pixels))


def entries(pixels: int, classes: int, numbers: Numbers, samples: Settings | Mapping[str, Number]) -> Number:
    """Entries of one group's light, at most: a pixel's direct light lies in its own cells, indirect light in all.

    Parameters
    ----------
    pixels, classes
        of the projector, and of the family.
    numbers, samples
        of the settings; samples by kind of light, or as settings have them.
    """

    def of(name: str) -> Number:
        row = PASSES[name]
        return row.whole(row.predicted_samples(samples) if isinstance(samples, Settings) else samples.get(name, 1.0))

    coarse, coarse_layers = np.square(numbers.coarse[0]), numbers.coarse[1]
    layers = np.minimum(coarse_layers, _SPLIT)

    def at(anchors: Number, name: str, part: Number = 1.0) -> Number:
        seen = _EDGES * np.minimum(of(name), coarse) * layers
        return part * (np.asarray(anchors) > 1) * _EDGES * np.square(anchors) * seen

    # Pixels of the projector, not of all cells: light from beyond its window is a small part.
    places = classes * coarse * coarse_layers
    most = np.maximum(of("indirect_residual"), of("camera_residual"))
    followed = np.minimum(_SPLIT * most, classes * np.square(numbers.cells_of_followed))
    found = (
        np.minimum(of("direct"), _EDGES * np.square(numbers.cells)) * np.minimum(numbers.layers, _SPLIT)
        + at(numbers.anchors, "anchor_residual")
        + at(numbers.occluded_anchors, "penumbra", numbers.occluded / pixels)
        + numbers.indirect * np.minimum(_SPLIT * of("indirect"), places)
        + (np.asarray(numbers.followed_anchors) > 1) * _EDGES * np.square(numbers.followed_anchors) * followed
    )
    return cast(Number, pixels * found)


def accumulation_seconds(forming: Forming, numbers: Numbers, entries_of_group: Number, costs: UnitCosts) -> Number:
    """Seconds of accumulating the light of each line.

    Parameters
    ----------
    forming, numbers, costs
        as for :func:`forming_seconds`.
    entries_of_group
        of one group's light.
    """
    cells, layers = numbers.coarse
    accumulator = forming.classes * np.square(forming.cells * cells) * layers
    passed = numbers.indirect * _PASSED * np.where(accumulator < MOST_PLACES, accumulator, 0.0)
    return cast(Number, forming.lines * GROUPS * costs.accumulated * (entries_of_group + passed))


def truth_seconds(pilot_result: PilotResult, settings: Settings, costs: UnitCosts) -> float:
    """Seconds of tracing what a perfect image would show.

    Parameters
    ----------
    pilot_result, settings, costs
        as for :func:`tracing_seconds`.
    """
    row, direct = PASSES["direct"], pilot_result.sample_costs["direct"]
    rate = (pilot_result.spread if settings.anchors > 1 else direct).noise.rate
    ray = traced_for(pilot_result.forming.lines, pilot_result.forming.parted) * costs.ray
    return ray * predicted_rays(direct.paths, float(row.whole(row.predicted_samples(settings))), rate)
