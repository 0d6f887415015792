"""A camera's size, a family and settings in; memory, disk and seconds of exposing, writing and drawing shadows out."""

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
"""Paths in flight, compiled kernels, LLVM; measured after plans without a cache of kernels: 1.0e8 (photograph, dots) to
2.3e8 (compact_disc)."""
_FOLLOWED_BYTES = 200e6
"""What the pilot's look at light over several surfaces leaves behind: kernels, lights of four looks at several points
(cookie_bag: 3.8e8 after the plan, photograph 1.0e8)."""
_ENTRY_BYTES = 45.0
"""An entry of a sparse matrix of light (12), the sum that it is added to, and what frames are formed of; measured 32 to
45 where matrices are large."""
_PATH_SAMPLE_BYTES = 500.0
"""A path's light while it is accumulated in one cell or two; measured."""
_PATH_BYTES, _PART_BYTES = 200.0, 75.0
"""The same where it is shared between more: the light of a path that is accumulated, and of one that is traced
meanwhile (74 each); and each cell's part of it, its place, row and light, sorted (64; 382 in all for four, glossy
balls)."""
_TERM_BYTES = 3 * 16.0
"""A pixel and cell of a term of a mask of many: both sides in the shadow, stacked, and picked for a frame."""
_EXPOSED = 7
"""Frames in double precision that each exposed frame takes as much as: its light, electrons, numbers and squares, and
electrons, numbers and encoded file of the chunk before, which is written meanwhile."""
_EXPOSING_S, _WRITING_S = 2e-8, 8e-9
"""A pixel on two processors, of which a part writes files while the next frames are exposed; and what there is left to
wait for. Measured of 49 frames of 512 x 512."""
_BYTES_PER_PIXEL = 8
"""Two channels, uncompressed: digital number and expected electrons; truth and its standard error."""
_BYTES_PER_ROW, _HEADER_BYTES = 16, 2000
"""Of an OpenEXR file."""
FRAMES_AT_ONCE, _BYTES_AT_ONCE = 16, 2**27
"""Frames exposed at a time: enough work for eight processors; and their bytes, where fewer have as many: 4 frames of a
sensor of 2048 pixels."""


def frames_at_once(pixels: int) -> int:
    """Frames of so many ``pixels`` in all that are exposed at a time."""
    return max(1, min(FRAMES_AT_ONCE, _BYTES_AT_ONCE // (8 * pixels)))


def frame_seconds(bench: Apparatus, shots: int) -> dict[str, float]:
    """Seconds of exposing and of writing so many ``shots`` of a ``bench``."""
    pixels = shots * math.prod(bench.geometry.frame_shape)
    return {"sensor": pixels * _EXPOSING_S, "write": pixels * _WRITING_S}


def frames_bytes(classes: int, shots: int, pixels: float) -> float:
    """Memory of frames that are formed, with the probes that tell their error, exposed and written at a time.

    Parameters
    ----------
    classes, shots, pixels
        of the family, and a side of the sensor.
    """
    formed = frames_in_memory(classes, shots, pixels) * (pixels + GROUPS * (PROBES + 1))
    return 8.0 * pixels * (formed + _EXPOSED * frames_at_once(round(pixels**2)) * pixels)


def frames_cost(
    bench: Apparatus, settings: Settings, lighting: Lighting, seconds: float = 0.0, on_disk: float = 0.0, lines: int = 1
) -> Cost:
    """Memory, disk and time of a capture.

    Memory is an upper estimate: measured runs take between a third and all of it (tests/hard/test_memory.py).

    Parameters
    ----------
    bench, settings
        what is simulated.
    lighting
        its classes and shots.
    seconds
        that it takes.
    on_disk
        bytes of frames that are there already.
    lines
        whose light is traced together; their frames are formed one line after another.
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
    """Memory of tracing light, and of accumulating it.

    Parameters
    ----------
    bench, settings
        what is simulated.
    classes
        of projector pixels, that light is accumulated by.
    lines
        that share the paths: the light of each is held.
    """
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
    """Memory of a path's light while it is accumulated with these ``settings``: that of sharp pixels lies in four cells
    of two layers at most."""
    parts = min(len(settings.depths), 2) * (4 if settings.sharp else 1)
    return max(_PATH_SAMPLE_BYTES, _PATH_BYTES + parts * _PART_BYTES)


# -------- Drawing a mask's shadow on a raster

_MEANS_S, _TURNED_S = 8e-8, 5e-7
"""A cell of a shadow without diffraction, of a mask that is straight and of one that is turned; here and below 0.7 of
the processor seconds of 2310 to 3466 cells a side on a busy core (benchmarks/masks.py)."""
_POINT_S, _TERM_S = 9e-9, 8e-11
"""A point at which waves are squared, and a term of their field there."""
_AROUND = 2.0
"""Cells of the light that is turned over those of its turned square."""
_HELD, _AT_WORK, _BLOCK_BYTES = 10, 14, 1.2e8
"""Numbers of 8 bytes that are held for each cell, of the 8 shadows that are kept and of their spectra; that are worked
on while another is made or a frame formed; and what points that are asked for at a time take."""
_FINER = (4 / 3, 2)
"""Times the fewest cells: 8 and 12 for 6."""
_MOST_BYTES = 2.0**32
"""Memory that more cells than the fewest are chosen for: twice as many of 320 pixels a side, 4 / 3 of 512."""


def cells_to_choose(geometry: CameraGeometry, spectrum: Spectrum | None) -> tuple[int, ...]:
    """Raster cells a pixel, fewest first, that a plan may choose for a camera whose mask is drawn.

    Parameters
    ----------
    geometry, spectrum
        as for :func:`drawing_seconds`.
    """
    fewest = cells_per_pixel(geometry)

    def holds(cells: int) -> bool:
        return raster_bytes(geometry.model_copy(update={"mask_cells": cells}), spectrum) <= _MOST_BYTES

    return fewest, *filter(holds, (math.ceil(by * fewest) for by in _FINER))


def drawing_seconds(geometry: CameraGeometry, spectrum: Spectrum | None) -> float:
    """Seconds of drawing the shadow of one depth; 0 for a mask that is never drawn.

    Parameters
    ----------
    geometry
        the camera.
    spectrum
        lines of the light; None: without diffraction.
    """
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
    """Memory of a drawn shadow's largest terms at most [bytes]: those of all cells, and of those that a shot lights.
    Those of further layers take the place of spectra (:data:`_HELD` is of eight shadows).

    Parameters
    ----------
    geometry
        the camera.
    cells
        along an axis, of all anchors.
    """
    return 2 * min(SUMMED_BYTES, 8.0 * MOST_TERMS * cells * sum(geometry.frame_shape))


def first_shadow(bench: Apparatus, switches: Mapping[str, bool]) -> Cost:
    """Time and memory of the first shadow that a plan of a ``bench`` draws, whose effects ``switches`` decide; none
    where it need not draw any."""
    geometry = bench.geometry
    waves = geometry.diffracts and switches.get("diffraction") is not False
    if not geometry.is_drawn(waves):
        return Cost()
    spectrum = bench.waves if waves else None
    return Cost(drawing_seconds(geometry, spectrum), raster_bytes(geometry, spectrum))


def raster_bytes(geometry: CameraGeometry, spectrum: Spectrum | None) -> float:
    """Memory of shadows on rasters behind a camera whose mask is drawn [bytes].

    Parameters
    ----------
    geometry, spectrum
        as for :func:`drawing_seconds`.
    """
    return 8.0 * (_HELD + _AT_WORK) * cells_a_side(geometry, spectrum) ** 2 + _BLOCK_BYTES
