"""Predict memory, disk and time of forming, exposing and writing frames, and of drawing the mask's shadow."""

from __future__ import annotations

import math
from collections.abc import Mapping

from mitsim.bench.apparatus import Apparatus
from mitsim.bench.effects import names
from mitsim.core.job import Cost
from mitsim.core.worker import workers
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.patterns import Lighting
from mitsim.devices.plate import FEW, MOST_TERMS, Plate
from mitsim.devices.projector import Spectrum
from mitsim.light.cost_model import Numbers, entries
from mitsim.light.settings import GROUPS, Settings
from mitsim.light.simulation import Simulation
from mitsim.optics.fft_shadow import cells_a_side, cells_per_pixel, points_per_cell
from mitsim.optics.forming import PROBES
from mitsim.optics.frames import frames_in_memory
from mitsim.optics.image_formation import SUMMED_BYTES

_LAUNCH_BYTES = 220e6
"""Paths in flight, kernels and LLVM; measured 1.0e8 (photograph) to 2.3e8 (compact_disc)."""
_FOLLOWED_BYTES = 200e6
"""What the pilot's run of light over several surfaces leaves (cookie_bag 3.8e8, photograph 1.0e8)."""
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


def frames_bytes(classes: int, shots: int, pixels: float) -> float:
    formed = frames_in_memory(classes, shots, pixels) * (pixels + GROUPS * (PROBES + 1))
    return 8.0 * pixels * (formed + _EXPOSED * frames_at_once(round(pixels**2)) * pixels)


def frames_cost(
    bench: Apparatus, settings: Settings, lighting: Lighting, seconds: float = 0.0, on_disk: float = 0.0, lines: int = 1
) -> Cost:
    """Return memory, disk and time of a capture.

    Measured runs take a third to all of the memory (tests/hard/test_memory.py). `on_disk` bytes of frames exist
    already; frames of `lines` are formed one after another.
    """
    shots, classes = lighting.weights.shape
    rows, pixels = bench.geometry.frame_shape[0], math.prod(bench.geometry.frame_shape)
    files = shots * (_BYTES_PER_PIXEL * pixels + _BYTES_PER_ROW * rows + _HEADER_BYTES)
    truth = float(_BYTES_PER_PIXEL * bench.n**2 + _BYTES_PER_ROW * bench.n + _HEADER_BYTES)
    return Cost(
        seconds=seconds,
        memory_bytes=light_bytes(bench, classes, settings, lines)
        + frames_bytes(classes, shots, bench.geometry.frame_side),
        disk_bytes=max(lines * (files + truth) - on_disk, 0.0),
    )


def light_bytes(bench: Apparatus, classes: int, settings: Settings, lines: int = 1) -> float:
    """Return the memory of tracing and accumulating light by classes; the light of each of `lines` is held."""
    held = float(entries(bench.n**2, classes, Numbers.of(settings), settings))
    paths = Simulation(bench, settings).paths_at_once
    followed = bool(settings.effects & names(lambda effect: effect.followed))
    geometry, cells = bench.geometry, bench.n * settings.subdivision * settings.anchors
    terms = geometry.mask_terms if geometry.mask_terms > FEW else 0
    factors = _TERM_BYTES * terms * max(geometry.frame_shape) * cells * len(settings.depths)
    if settings.raster or geometry.is_drawn(geometry.diffracts):
        factors = max(
            0.0 if settings.raster else factors,
            raster_bytes(geometry.model_copy(update={"mask_cells": settings.raster_cells}), bench.waves),
        ) + largest_terms_bytes(geometry, cells)
    held = lines * GROUPS * held * _ENTRY_BYTES + min(lines, workers()) * paths * path_sample_bytes(settings)
    return factors + _LAUNCH_BYTES + _FOLLOWED_BYTES * followed + held


def path_sample_bytes(settings: Settings) -> float:
    parts = min(len(settings.depths), 2) * (4 if settings.sharp else 1)
    return max(_PATH_SAMPLE_BYTES, _PATH_BYTES + parts * _PART_BYTES)


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
    """Return the raster cells for each pixel, fewest first, that a plan may choose."""
    fewest = cells_per_pixel(geometry)

    def holds(cells: int) -> bool:
        return raster_bytes(geometry.model_copy(update={"mask_cells": cells}), spectrum) <= _MOST_BYTES

    return fewest, *filter(holds, (math.ceil(by * fewest) for by in _FINER))


def drawing_seconds(geometry: CameraGeometry, spectrum: Spectrum | None) -> float:
    """Return the time of drawing the shadow of one depth; 0 if the mask is never drawn."""
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


def largest_terms_bytes(geometry: CameraGeometry, cells: int) -> float:
    """Return the largest memory of a drawn shadow's terms: of all cells, and of the cells that a shot lights."""
    return 2 * min(SUMMED_BYTES, 8.0 * MOST_TERMS * cells * sum(geometry.frame_shape))


def first_shadow(bench: Apparatus, switches: Mapping[str, bool]) -> Cost:
    geometry = bench.geometry
    waves = geometry.diffracts and switches.get("diffraction") is not False
    if not geometry.is_drawn(waves):
        return Cost()
    spectrum = bench.waves if waves else None
    return Cost(drawing_seconds(geometry, spectrum), raster_bytes(geometry, spectrum))


def raster_bytes(geometry: CameraGeometry, spectrum: Spectrum | None) -> float:
    return 8.0 * (_HELD + _AT_WORK) * cells_a_side(geometry, spectrum) ** 2 + _BLOCK_BYTES
