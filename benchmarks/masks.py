"""What frames behind masks cost, by separable terms and by FFT, what rasters and nodes of tilts leave, and how far
turned and tilted masks are from separable ones; one JSON line each, to stdout.

Processor seconds of one core at the paper's geometry (512 x 512 pixels, 128 x 128 projector pixels over 120 mm at
400 mm). Set OMP_NUM_THREADS=1: frames are formed side by side by as many threads.

    .venv/bin/python benchmarks/masks.py [costs] [errors] [mounted] [nodes]    # all: some ten minutes
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np

from mitsim.devices.camera import CameraGeometry
from mitsim.devices.mask_profile import MaskProfile
from mitsim.devices.plate import Plate
from mitsim.devices.projector import Spectrum
from mitsim.optics.image_formation import FrameOptics, raster_error
from mitsim.optics.shadow import Directions, ShadowGeometry, geometric_terms
from mitsim.optics.terms import best_term, shadow_terms, tilted_terms

N, HALF = 128, 60 / 400
DEPTH_MM = 400.0
LINES = Spectrum(np.array([450.0, 520.0, 638.0]), np.array([0.3, 0.3, 0.4]))


def camera(**mask: object) -> CameraGeometry:
    return MaskProfile.model_validate({"feature_mm": 0.06, **mask}).put_on(CameraGeometry.build("benchmark"), Path())


def of_rank(terms: int) -> CameraGeometry:
    """A camera whose mask is the sum of so many separable terms."""
    random = np.random.default_rng(terms)
    values = random.random((128, terms)) @ random.random((terms, 128)) / terms
    return CameraGeometry.build("benchmark", mask="plate", mask_plate=Plate(0.06, values, f"{terms} terms"))


def light(subdivision: int, period: int) -> tuple[Directions, np.ndarray, np.ndarray]:
    """Cells, and places and light of dots with that period."""
    side = N * subdivision
    lit = np.repeat(np.arange(N) % period == 0, subdivision)
    places = np.flatnonzero(np.outer(lit, lit))
    cells = Directions.cells(np.linspace(-HALF, HALF, side + 1))
    return cells, places, np.random.default_rng(0).random(len(places))


def reported(**row: object) -> None:
    rounded = {name: float(f"{value:.2g}") if isinstance(value, float) else value for name, value in row.items()}
    print(json.dumps(rounded), flush=True)


def formed(geometry: CameraGeometry, spectrum: Spectrum | None, subdivision: int) -> dict[str, float]:
    """Processor seconds of preparing a shadow, and of frames of two families."""
    row = {}
    for patterns, period in (("uniform", 1), ("dots:7", 7)):
        cells, places, power = light(subdivision, period)
        started = time.process_time()
        optics = FrameOptics(geometry, cells, cells, (DEPTH_MM,), 1, spectrum)
        row.setdefault("prepare_s", time.process_time() - started)
        optics.frame(places, power)
        started = time.process_time()
        optics.frame(places, power)
        row[f"{patterns}_s"] = time.process_time() - started
    return row


def costs() -> None:
    """By number of terms as a sum, and as a correlation; and of shadows that are drawn for want of a sum."""
    for terms in (1, 2, 8, 32, 112):
        for subdivision in (1, 4):
            for fft in (False, True) if terms > 2 else (False,):
                geometry = of_rank(terms).model_copy(update={"mask_fft": fft})
                reported(terms=terms, fft=fft, cells=subdivision**2, **formed(geometry, None, subdivision))
    drawn: dict[str, tuple[CameraGeometry, Spectrum | None]] = {
        "turned 0.3 degrees": (camera(kind="separable", rotation_deg=0.3), None),
        "random, waves of three lines": (camera(kind="random", features=511), LINES),
    }
    for name, (geometry, spectrum) in drawn.items():
        for subdivision in (1, 4):
            reported(mask=name, fft=True, cells=subdivision**2, **formed(geometry, spectrum, subdivision))


def errors() -> None:
    """What a raster leaves as a plan predicts it: against sums, or rasters of half the cells; by cells a pixel."""
    masks = {
        "random": camera(kind="random", features=511),
        "dusty": camera(kind="separable", dust_per_mm2=1.0, dust_radius_um=25.0),
        **{f"turned {angle} degrees": camera(kind="separable", rotation_deg=angle) for angle in (0.3, 1.0, 7.0)},
    }
    for name, geometry in masks.items():
        for patterns, period in (("uniform", 1), ("dots:7", 7)):
            cells, places, _ = light(1, period)
            shown = np.zeros((N, N))
            shown.ravel()[places] = 1
            for count in (6, 8, 12):
                finer = geometry.model_copy(update={"mask_cells": count})
                error, known = raster_error(finer, cells, cells, DEPTH_MM, None, shown)
                reported(
                    mask=name, patterns=patterns, cells=count, left=error, by="sums" if known else "half the cells"
                )


def mounted() -> None:
    """Part of the geometric shadow that the best separable camera leaves, of every eighth pixel and second cell."""
    cells = Directions.cells(np.linspace(-HALF, HALF, N // 2 + 1))
    for name, values in (("rotation_deg", (0.01, 0.03, 0.1, 0.3, 1.0)), ("tilt_row_mrad", (0.3, 1.0, 3.0, 10.0))):
        for value in values:
            geometry = camera(kind="separable", **{name: value})
            terms = shadow_terms(geometry, cells, cells, DEPTH_MM, places=range(0, 512, 8))
            residual = best_term(terms).residual
            reported(flaw=name, value=value, residual=residual, below_dB=round(-20 * float(np.log10(residual)), 1))


def nodes() -> None:
    """What the nodes of a tilt leave of frames of dots, against 48 of them, on every fourth pixel."""
    cells, places, _ = light(1, 7)
    shown = np.zeros((N, N))
    shown.ravel()[places] = 1
    for tilt in (2.0, 5.0, 10.0, 20.0):
        geometry = camera(kind="separable", tilt_row_mrad=tilt)
        shadow = ShadowGeometry.of(geometry, DEPTH_MM)
        shadow = ShadowGeometry(
            shadow.mask, shadow.pixel_centres_mm[::4], shadow.active_mm, shadow.distance_mm, 0.0, DEPTH_MM
        )
        own = geometry.tilt_nodes(waves=False)
        assert own is not None

        def frame(
            count: int, seen: ShadowGeometry = shadow, grows: tuple[float, float] = geometry.mask_tilt
        ) -> np.ndarray:
            terms = tilted_terms(seen, cells, cells, grows, (1, count), lambda one: geometric_terms(one, cells, cells))
            return np.asarray(sum(left @ shown @ right.T for left, right in terms))

        fine = frame(48)
        left = float(np.linalg.norm(frame(own[1]) - fine) / np.linalg.norm(fine))
        reported(tilt_mrad=tilt, nodes=own[1], left=left)


if __name__ == "__main__":
    for part in (costs, errors, mounted, nodes):
        if part.__name__ in sys.argv[1:] or not sys.argv[1:]:
            part()
