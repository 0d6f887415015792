"""What drawing a mask's shadow on a raster takes: from a camera and its light to cells, seconds and bytes."""

from __future__ import annotations

import math

from mitsim.devices.camera import CameraGeometry
from mitsim.devices.plate import Plate
from mitsim.devices.projector import Spectrum
from mitsim.optics.fft_shadow import cells_a_side, cells_per_pixel, points_per_cell

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

    def held(cells: int) -> bool:
        return raster_bytes(geometry.model_copy(update={"mask_cells": cells}), spectrum) <= _MOST_BYTES

    return fewest, *filter(held, (math.ceil(by * fewest) for by in _FINER))


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
    if mask is None or not (geometry.drawn(waves) or geometry.may_be_drawn(waves)):
        return 0.0
    cells, turned = float(cells_a_side(geometry, spectrum)) ** 2, bool(mask.flaws.turn_deg)
    if spectrum is None or mask.irradiance:
        return cells * (_TURNED_S if turned else _MEANS_S)
    seen = geometry.build_mask()
    assert isinstance(seen, Plate)
    step = geometry.pixel_pitch / cells_per_pixel(geometry)
    points = (points_per_cell(float(line), geometry.mask_distance, step) for line in spectrum.wavelengths_nm)
    each = _POINT_S + _TERM_S * len(seen.amplitude.terms)
    return cells * (_AROUND if turned else 1.0) * each * sum(count**2 for count in points)


def raster_bytes(geometry: CameraGeometry, spectrum: Spectrum | None) -> float:
    """Memory of shadows on rasters behind a camera whose mask is drawn [bytes].

    Parameters
    ----------
    geometry, spectrum
        as for :func:`drawing_seconds`.
    """
    return 8.0 * (_HELD + _AT_WORK) * cells_a_side(geometry, spectrum) ** 2 + _BLOCK_BYTES
