"""What frames behind masks cost, by separable terms and by FFT, and what rasters leave; one JSON line each, to stdout.

Processor seconds of one core at the paper's geometry (512 x 512 pixels, 128 x 128 projector pixels over 120 mm at
400 mm). Set OMP_NUM_THREADS=1: frames are formed side by side by as many threads.

    .venv/bin/python benchmarks/masks.py    # some five minutes
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np

from mitsim.optics import closed_form
from mitsim.optics import raster as rasters
from mitsim.optics.closed_form import FrameOptics
from mitsim.optics.shadow import Directions
from mitsim.rig.camera import CameraGeometry
from mitsim.rig.plate import Plate
from mitsim.rig.profile import MaskProfile
from mitsim.rig.projector import Spectrum

N, HALF = 128, 60 / 400
DEPTH_MM = 400.0
LINES = Spectrum(np.array([450.0, 520.0, 638.0]), np.array([0.3, 0.3, 0.4]))


def camera(**mask: object) -> CameraGeometry:
    return MaskProfile.model_validate({"feature_mm": 0.06, **mask}).worn(CameraGeometry.checked("benchmark"), Path())


def of_rank(terms: int) -> CameraGeometry:
    """A camera whose mask is the sum of so many separable terms."""
    random = np.random.default_rng(terms)
    values = random.random((128, terms)) @ random.random((terms, 128)) / terms
    return CameraGeometry.checked("benchmark", mask="plate", mask_plate=Plate(0.06, values, f"{terms} terms"))


def light(subdivision: int, period: int) -> tuple[Directions, np.ndarray, np.ndarray]:
    """Cells, and places and light of dots with that period."""
    side = N * subdivision
    lit = np.repeat(np.arange(N) % period == 0, subdivision)
    places = np.flatnonzero(np.outer(lit, lit))
    cells = Directions.cells(np.linspace(-HALF, HALF, side + 1))
    return cells, places, np.random.default_rng(0).random(len(places))


def costs() -> None:
    masks: dict[str, tuple[CameraGeometry, Spectrum | None]] = {
        f"{terms} terms": (of_rank(terms), None) for terms in (1, 2, 8, 32, 112)
    }
    masks["turned 0.3 degrees, raster"] = camera(kind="separable", rotation_deg=0.3), None
    masks["random, waves of three lines, raster"] = camera(kind="random", features=511), LINES
    for name, (geometry, spectrum) in masks.items():
        for subdivision in (1, 4):
            row: dict[str, object] = {"mask": name, "cells a pixel": subdivision**2}
            for patterns, period in (("uniform", 1), ("dots:7", 7)):
                cells, places, power = light(subdivision, period)
                started = time.process_time()
                optics = FrameOptics(geometry, cells, cells, (DEPTH_MM,), 1, spectrum)
                row.setdefault("prepare_s", round(time.process_time() - started, 2))
                optics.frame(places, power)
                started = time.process_time()
                optics.frame(places, power)
                row[f"{patterns}_s"] = round(time.process_time() - started, 4)
            print(json.dumps(row), flush=True)


def errors() -> None:
    """Against rasters of twice as many cells a side, whose own error is a third to a quarter as large."""
    for degrees in (0.3, 1.0, 7.0):
        geometry = camera(kind="separable", rotation_deg=degrees)
        for patterns, period in (("uniform", 1), ("dots:7", 7)):
            cells, places, power = light(4, period)
            power = np.ones_like(power)
            frames = []
            for count in (4, 8):
                rasters._CELLS_PER_PIXEL = count
                rasters.raster.cache_clear()
                closed_form._correlation.cache_clear()
                frames.append(FrameOptics(geometry, cells, cells, (DEPTH_MM,), 1).frame(places, power))
            coarse, fine = frames
            error = float(np.sqrt(np.mean(np.square(coarse - fine)) / np.mean(np.square(fine))))
            print(
                json.dumps({"degrees": degrees, "patterns": patterns, "relative rms": float(f"{error:.2g}")}),
                flush=True,
            )


if __name__ == "__main__":
    costs()
    errors()
