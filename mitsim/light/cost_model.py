"""Predicted seconds, memory and disk of a capture, before anything is simulated.

Unit costs are fixed, near those of two cores, because the same seed must give the same settings. Only their ratios
matter for a choice.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import names
from mitsim.core.arrays import FloatArray
from mitsim.core.job import Cost
from mitsim.core.worker import workers
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.mask import FEW, MOST_TERMS, Plate
from mitsim.devices.patterns import Lighting
from mitsim.devices.projector import Spectrum
from mitsim.light.passes import PASSES, Simulation
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
from mitsim.optics.fft_shadow import CORRELATION_PRODUCTS, cells_a_side, cells_per_pixel, points_per_cell
from mitsim.optics.frames import PROBES, formed_frames, frames_in_memory, mixes
from mitsim.optics.image_formation import SUMMED_BYTES
from mitsim.transport.records import MOST_PLACES

ROUNDS, CHECKED_SHOTS = 1.5, 16
"""Rounds of sampling, one or two (followed light takes one more), and shots whose error each round checks if there are
many: their errors differ by a few percent, and each takes time."""
MOST_CHECKED = 64
"""Checked shots of followed light, whose heavy paths strike single shots; most classes that form all shots."""
_CHECK = 0.4
"""Ratio of the time of checking a frame's error to that of forming it: 0.36 in corner, 0.44 in cookie_bag."""
MIXING = "black-level"
"""Effect that lights every pixel in every shot, so that shots are no longer single classes."""
_SPLIT, _EDGES = 2.0, 2.0
"""Most layers that share the light of one depth, and the factor of a pixel's cells at an edge (measured: 1.6)."""
_GEOMETRIC_ENTRIES, _MANY_ENTRIES = 0.03, 1.2
"""Ratio of an entry of a geometric shadow of few or many terms to one of a wave-optical shadow."""
_CELL_S = 5e-8
"""Time of a cell of a raster on which waves are squared, which is sharpened and searched for its largest terms."""
_FURTHER_LINE = 0.2
"""Cost of tracing each further line: 0.15 of a mono capture, 0.3 of one line (three lines of photograph)."""
_PASSED = 0.4
"""Ratio of a place of an accumulator, which is emptied and searched, to an entry of light (corner in three lines)."""
SHARED_COST = 6
"""Cost of a path of shared indirect light in ordinary paths: corner 5.7, cookie_bag 3.4."""

TRUTH_PART = 1 / 6
"""Error of the truth relative to that of the frames' own sampling in any image: it adds at most 0.12 dB."""
TRUTH_GROUPS = 4
"""Independent estimates of the truth, whose spread is its standard error; four need 0.7 of the rays of eight."""
TRUTH_SAMPLES, BOARD_SAMPLES = 16, 8
"""First samples for each pixel and group; 64 in all show all but a corner of a hundredth of a pixel."""
MOST_RAYS, MOST_SAMPLES = 2**22, 128
"""Most rays of each flux, or samples for each pixel if that is more: 1.5 s on two cores."""
_ALLOTTED = 0.5
"""Part of the rays that the truth needs, because samples go where they help most (photograph 0.5, gift_card 0.3)."""


_FRAME_S, PRODUCT_S, _ENTRY_S, _ACCUMULATED_S, _RAY_S, _PIXEL_S = 2.2e-3, 2.1e-11, 3.5e-8, 1e-8, 4e-8, 4e-9
"""Time of a frame, a multiplication in a large product, an entry of a shadow, an entry that is accumulated, a ray of
the truth, and a pixel of a frame that is read again."""


@dataclass(frozen=True)
class Numbers:
    anchors: Number
    layers: Number
    cells: Number
    followed_anchors: Number
    occluded_anchors: Number
    coarse_layers: Number
    waves: float = 1.0
    indirect: float = 0.0
    mixed: float = 0.0
    occluded: float = 0.0
    raster_cells: float = 0.0

    @property
    def coarse(self) -> tuple[FloatArray, FloatArray]:
        several = np.asarray(self.coarse_layers) > 0
        cells = np.where(several, np.maximum(self.cells // CELLS_OF_COARSE, 1.0), 1.0)
        return cells, np.where(several, self.layers, 1.0)

    @property
    def cells_of_followed(self) -> FloatArray:
        return self.coarse[0] / FOLLOWED_WIDTH

    @classmethod
    def of_counts(
        cls, counts: Sequence[Number], effects: frozenset[str], occluded: int = 0, raster_cells: int = 0
    ) -> Numbers:
        on = in_waves(effects), "interreflection" in effects, MIXING in effects
        return cls(*counts, *map(float, (*on, occluded, raster_cells)))  # type: ignore[arg-type]

    @classmethod
    def of(cls, settings: Settings) -> Numbers:
        direct = settings.anchors, len(settings.depths), settings.subdivision
        counts = *direct, settings.followed_anchors, settings.occluded_anchors, settings.coarse_layers
        occluded = len(settings.with_own_anchors)
        return cls.of_counts([*map(float, counts)], settings.effects, occluded, settings.raster_cells)


def in_waves(effects: frozenset[str]) -> bool:
    return bool(effects & names(lambda effect: effect.in_shadow))


def sample_costs(pilot_result: PilotResult, effects: frozenset[str]) -> dict[str, SampleCost]:
    found = ((name, pilot_result.sample_costs[name]) for name in PASSES if name in pilot_result.sample_costs)
    return {name: sample_cost for name, sample_cost in found if PASSES[name].called_for(effects)}


# -------- Forming frames, and checking their error


def _by_fft(forming: Forming, numbers: Numbers) -> float:
    """Return the raster cells of a pixel where frames are correlations, else 0."""
    if not (numbers.raster_cells or forming.correlated[bool(numbers.waves)]):
        return 0.0
    return numbers.raster_cells**2 or forming.phases


def forming_seconds(forming: Forming, numbers: Numbers, frames: Number, product_s: float = PRODUCT_S) -> Number:
    phases, pixels, waves = _by_fft(forming, numbers), forming.pixels, bool(numbers.waves)

    def multiplications(lit: Sequence[Number], cells: Number, layers: Number, anchors: Number) -> Number:
        rows, columns = (part * forming.cells * cells * anchors for part in lit)
        # The shorter side is multiplied out first.
        one_term = layers * (pixels * rows * columns + pixels**2 * np.minimum(rows, columns))
        of_probes = layers * GROUPS * (PROBES + 1) * (np.minimum(columns, pixels) + pixels) * rows
        if not phases:
            terms = forming.geometric_terms + (forming.terms - forming.geometric_terms) * numbers.waves
            return cast(Number, terms * (one_term + of_probes))
        correlation = CORRELATION_PRODUCTS * phases * layers * np.square(anchors) * pixels**2
        terms = forming.largest_terms[waves]
        many = np.asarray(terms * 16 * pixels * forming.cells * cells > SUMMED_BYTES)
        held = terms if math.isfinite(terms) else 0.0
        sums, sums_of_probes = (np.where(many, math.inf, count * held) for count in (one_term, of_probes))
        # Frames and their probes are each computed in the cheaper order.
        return cast(Number, np.minimum(correlation, sums) + np.minimum(GROUPS * correlation, sums_of_probes))

    lit, every, coarse = (forming.lit, forming.lit), (1.0, 1.0), numbers.coarse
    # Each occluded pixel lights its own cells, and a frame shows the same part of them as of all pixels.
    most = _EDGES * numbers.occluded * np.square(forming.lit) / forming.cells
    of_occluded = [np.minimum(forming.lit * part, most) for part in forming.occluded]
    by_grid = (
        (1.0, lit, numbers.cells, numbers.layers, 1.0),
        (np.asarray(numbers.anchors) > 1, lit, *coarse, numbers.anchors),
        (np.asarray(numbers.occluded_anchors) > 1, of_occluded, *coarse, numbers.occluded_anchors),
        (numbers.indirect, every, *coarse, 1.0),
        (np.asarray(numbers.followed_anchors) > 1, every, numbers.cells_of_followed, 1.0, numbers.followed_anchors),
    )
    products = sum(formed * multiplications(*grid) for formed, *grid in by_grid)
    if mixes(forming.classes, forming.shots, pixels):
        products = products + numbers.mixed * forming.classes * pixels**2
    return cast(Number, forming.lines * frames * (_FRAME_S + product_s * products))


def optics_seconds(forming: Forming, numbers: Numbers) -> Number:
    phases, waves = _by_fft(forming, numbers), bool(numbers.waves)
    # Entries of all shadows, in wave-optical ones.
    coarse = (np.asarray(numbers.anchors) > 1) + numbers.indirect
    followed = (np.asarray(numbers.followed_anchors) > 1) * numbers.cells_of_followed
    sides = numbers.cells * numbers.layers + coarse * math.prod(numbers.coarse) + followed
    shadows: Number
    if not phases:
        many = forming.geometric_terms > FEW
        geometric = _MANY_ENTRIES * forming.geometric_terms if many else _GEOMETRIC_ENTRIES
        terms = forming.terms * numbers.waves + geometric * (1 - numbers.waves)
        shadows = _ENTRY_S * (2 * forming.pixels * forming.cells * sides * terms)
    else:
        drawing = forming.drawing[waves]
        if not waves:
            drawing *= phases / forming.phases
        else:  # Waves are squared at as many points whatever the cells.
            drawing += _CELL_S * forming.pixels**2 * phases
        # The pilot has drawn a shadow of one layer in the fewest cells if there is no other way. Coarse light of
        # several layers is seen at a depth of its own.
        several = np.asarray(numbers.layers) > 1
        drawn = ~several & (forming.correlated[waves] and phases == forming.phases)
        shadows = cast(Number, drawing * (numbers.layers + several - drawn))
    frames = formed_frames(forming.classes, forming.shots, forming.pixels)
    seen = _PIXEL_S * forming.shots * forming.pixels**2
    return forming.lines * (shadows + seen) + forming_seconds(forming, numbers, frames)


def checking_seconds(forming: Forming, numbers: Numbers) -> Number:
    rounds = ROUNDS + numbers.indirect
    if tells_all(forming.classes, forming.shots, forming.pixels):
        # The result of the last check is reused when frames are formed.
        return forming_seconds(forming, numbers, _CHECK * (rounds - 1) * forming.classes)
    few, many = (min(shots, forming.shots) for shots in (CHECKED_SHOTS, MOST_CHECKED))
    return forming_seconds(forming, numbers, _CHECK * rounds * (few + numbers.indirect * (many - few)))


def tells_all(classes: int, shots: int, pixels: float) -> bool:
    return classes <= MOST_CHECKED and mixes(classes, shots, pixels)


# -------- Tracing, accumulating and the truth


def tracing_seconds(pilot_result: PilotResult, settings: Settings) -> dict[str, float]:
    found, lines = {}, traced_for(pilot_result.forming.lines, pilot_result.forming.parted)
    for name, cost in sample_costs(pilot_result, settings.effects).items():
        row = PASSES[name]
        samples, connections = float(row.whole(row.predicted_samples(settings))), float(row.connections(settings))
        found[name] = lines * GROUPS * samples * cost.paths * row.unit_cost * connections
    return found


def traced_for(lines: int, parted: bool = False) -> float:
    """Return the cost of tracing and accumulating so many ``lines``, relative to one line.

    Lines share their paths unless glass has ``parted`` them.
    """
    return lines if parted else 1 + _FURTHER_LINE * (lines - 1)


def truth_seconds(pilot_result: PilotResult, settings: Settings) -> float:
    """Return the time of the truth's rays for both fluxes (:func:`mitsim.light.light.trace_truths`)."""
    row, direct = PASSES["direct"], pilot_result.sample_costs["direct"]
    rate = (pilot_result.spread if settings.anchors > 1 else direct).rate
    pixels, samples = direct.paths, float(row.whole(row.predicted_samples(settings)))
    first = TRUTH_GROUPS * pixels * (TRUTH_SAMPLES + BOARD_SAMPLES)
    wanted = _ALLOTTED * GROUPS * pixels * samples * float(TRUTH_PART ** (-1 / rate))
    rays = min(first + wanted, max(MOST_RAYS, MOST_SAMPLES * pixels))
    return traced_for(pilot_result.forming.lines, pilot_result.forming.parted) * _RAY_S * rays


def entries(pixels: int, classes: int, numbers: Numbers, samples: Settings | Mapping[str, Number]) -> Number:
    """Return the most entries of one group's light.

    A projector pixel's direct light lies in its own cells, indirect light in all.
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


def accumulation_seconds(forming: Forming, numbers: Numbers, entries_of_group: Number) -> Number:
    cells, layers = numbers.coarse
    accumulator = forming.classes * np.square(forming.cells * cells) * layers
    passed = numbers.indirect * _PASSED * np.where(accumulator < MOST_PLACES, accumulator, 0.0)
    return cast(Number, forming.lines * GROUPS * _ACCUMULATED_S * (entries_of_group + passed))


# -------- Memory and disk of forming, exposing and writing frames

_LAUNCH_BYTES = 220e6
"""Paths in flight, kernels and LLVM; measured 1.0e8 (photograph) to 2.3e8 (compact_disc)."""
_FOLLOWED_BYTES = 200e6
"""Left by the pilot's run of light over several surfaces (cookie_bag 3.8e8, photograph 1.0e8)."""
_ENTRY_BYTES = 45.0
"""Entry of a sparse matrix (12), its sum and its part in frames; measured 32 to 45."""
_PATH_SAMPLE_BYTES = 500.0
_PATH_BYTES, _PART_BYTES = 200.0, 75.0
"""Light of a path shared among more cells: two paths (74 each), and each cell's part, sorted (64)."""
_TERM_BYTES = 3 * 16.0
_EXPOSED = 7
_EXPOSING_S, _WRITING_S = 2e-8, 8e-9
"""Time of a pixel on two processors, and the wait at the end; 49 frames of 512 x 512."""
_BYTES_PER_PIXEL = 8
_BYTES_PER_ROW, _HEADER_BYTES = 16, 2000
FRAMES_AT_ONCE, _BYTES_AT_ONCE = 16, 2**27
"""Enough frames for eight processors, or so many bytes: 4 frames of 2048 pixels."""


def frames_at_once(pixels: int) -> int:
    return max(1, min(FRAMES_AT_ONCE, _BYTES_AT_ONCE // (8 * pixels)))


def frame_seconds(bench: Apparatus, shots: int) -> dict[str, float]:
    pixels = shots * math.prod(bench.geometry.frame_shape)
    return {"sensor": pixels * _EXPOSING_S, "write": pixels * _WRITING_S}


def frames_cost(
    bench: Apparatus, settings: Settings, lighting: Lighting, seconds: float = 0.0, on_disk: float = 0.0, lines: int = 1
) -> Cost:
    """Return memory, disk and time of a capture; frames of ``lines`` are formed one after another.

    Measured runs take a third to all of the memory (tests/hard/test_full_disk.py). ``on_disk`` bytes of frames exist
    already.
    """
    (shots, classes), geometry = lighting.weights.shape, bench.geometry

    def file_bytes(rows: int, columns: int) -> float:
        return float(_BYTES_PER_PIXEL * rows * columns + _BYTES_PER_ROW * rows + _HEADER_BYTES)

    files = shots * file_bytes(*geometry.frame_shape) + file_bytes(bench.n, bench.n)
    pixels = geometry.frame_side
    formed = frames_in_memory(classes, shots, pixels) * (pixels + GROUPS * (PROBES + 1))
    formed_bytes = 8.0 * pixels * (formed + _EXPOSED * frames_at_once(round(pixels**2)) * pixels)
    held = light_bytes(bench, classes, settings, lines) + formed_bytes
    return Cost(seconds=seconds, memory_bytes=held, disk_bytes=max(lines * files - on_disk, 0.0))


def light_bytes(bench: Apparatus, classes: int, settings: Settings, lines: int = 1) -> float:
    held = float(entries(bench.n**2, classes, Numbers.of(settings), settings))
    paths = Simulation(bench, settings).paths_at_once
    followed = bool(settings.effects & names(lambda effect: effect.followed))
    geometry, cells = bench.geometry, bench.n * settings.subdivision * settings.anchors
    terms = geometry.mask_terms if geometry.mask_terms > FEW else 0
    factors = _TERM_BYTES * terms * max(geometry.frame_shape) * cells * len(settings.depths)
    if settings.raster or geometry.is_drawn(geometry.diffracts):
        drawn = raster_bytes(geometry.model_copy(update={"mask_cells": settings.raster_cells}), bench.waves)
        # The largest terms of a drawn shadow: of all cells, and of the cells that a shot lights.
        largest = 2 * min(SUMMED_BYTES, 8.0 * MOST_TERMS * cells * sum(geometry.frame_shape))
        factors = max(0.0 if settings.raster else factors, drawn) + largest
    parts = min(len(settings.depths), 2) * (4 if settings.sharp else 1)
    path_bytes = max(_PATH_SAMPLE_BYTES, _PATH_BYTES + parts * _PART_BYTES)
    held = lines * GROUPS * held * _ENTRY_BYTES + min(lines, workers()) * paths * path_bytes
    return factors + _LAUNCH_BYTES + _FOLLOWED_BYTES * followed + held


# -------- Drawing a mask's shadow on a raster

_MEANS_S, _TURNED_S = 8e-8, 5e-7
"""Time of a cell of a shadow without diffraction, of a straight and of a turned mask."""
_POINT_S, _TERM_S = 9e-9, 8e-11
_AROUND = 2.0
_HELD, _AT_WORK, _BLOCK_BYTES = 10, 14, 1.2e8
_FINER = (4 / 3, 2)
_MOST_BYTES = 2.0**32
"""Memory for more cells than the fewest: twice as many for 320 pixels along an axis, 4 / 3 for 512."""


def cells_to_choose(geometry: CameraGeometry, spectrum: Spectrum | None) -> tuple[int, ...]:
    fewest = cells_per_pixel(geometry)

    def holds(cells: int) -> bool:
        return raster_bytes(geometry.model_copy(update={"mask_cells": cells}), spectrum) <= _MOST_BYTES

    return fewest, *filter(holds, (math.ceil(by * fewest) for by in _FINER))


def drawing_seconds(geometry: CameraGeometry, spectrum: Spectrum | None) -> float:
    mask = geometry.mask_plate
    waves = spectrum is not None
    if mask is None or not (geometry.is_drawn(waves) or geometry.may_be_drawn(waves)):
        return 0.0
    cells, turned = float(cells_a_side(geometry, spectrum)) ** 2, bool(mask.flaws.turn_deg)
    if spectrum is None or mask.irradiance:
        return cells * (_TURNED_S if turned else _MEANS_S)
    seen = geometry.build_mask()
    assert isinstance(seen, Plate)
    step = geometry.pixel_pitch / cells_per_pixel(geometry)
    points = (points_per_cell(float(line), geometry.mask_distance, step) for line in spectrum.wavelengths_nm)
    each = _POINT_S + _TERM_S * seen.amplitude.most_terms
    part = _AROUND if turned else seen.amplitude.uneven_part
    return cells * part * each * sum(count**2 for count in points)


def first_shadow(bench: Apparatus, switches: Mapping[str, bool]) -> Cost:
    geometry = bench.geometry
    waves = geometry.diffracts and switches.get("diffraction") is not False
    if not geometry.is_drawn(waves):
        return Cost()
    spectrum = bench.waves if waves else None
    return Cost(drawing_seconds(geometry, spectrum), raster_bytes(geometry, spectrum))


def raster_bytes(geometry: CameraGeometry, spectrum: Spectrum | None) -> float:
    return 8.0 * (_HELD + _AT_WORK) * cells_a_side(geometry, spectrum) ** 2 + _BLOCK_BYTES
