"""What runs and frames behind masks cost, by separable terms and by FFT, what rasters and nodes of tilts leave, and how
far turned and tilted masks are from separable ones; one JSON line each, to stdout.

``cases``: one new process a mask, the second of two, so that kernels and byte code are there: seconds on the clock, of
all processors and as predicted, of the plan, memory taken by the process and as predicted, and what the run says.

Processor seconds of one core at the paper's geometry (512 x 512 pixels, 128 x 128 projector pixels over 120 mm at
400 mm). Set OMP_NUM_THREADS=1: frames are formed side by side by as many threads.

    .venv/bin/python benchmarks/masks.py cases               # some three minutes
    .venv/bin/python benchmarks/masks.py [costs] [errors] [mounted] [nodes]    # all: some ten minutes
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.signal import max_len_seq
from skimage import io

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


_PICTURE = {"kind": "psf", "file": "caustics.png", "feature_mm": 0.003, "psf_distance_mm": 400.0, "aperture_mm2": 4.0}
_ZONES = {"kind": "drawing", "file": "zones.png", "feature_mm": 0.01}
_CODE = {"kind": "drawing", "file": "code.png", "feature_mm": 0.06}
_DISC = {"kind": "drawing", "file": "disc.png", "feature_mm": 0.06}
CASES: dict[str, tuple[dict[str, object], str]] = {
    "disc": (_DISC, "capture photograph --patterns dots:4"),
    "zone plate, card of 20 mm": (_ZONES, "capture 10/scene.xml -D mask_distance=3 --patterns uniform"),
    "zone plate, point of 2 mm": (_ZONES, "capture 1/scene.xml -D mask_distance=3 --patterns uniform"),
    "zone plate, photograph": (_ZONES, "capture photograph -D mask_distance=3 --patterns dots:4"),
    "phase mask by its picture": (_PICTURE, "capture photograph --patterns dots:4"),
    "MURA of 101": ({"kind": "mura", "features": 101, "feature_mm": 0.06}, "capture photograph --patterns dots:4"),
    "random, 4096 features, blurred": (
        {"kind": "random", "features": 4096, "feature_mm": 0.003, "edge_blur_um": 0.5},
        "capture photograph --patterns dots:4",
    ),
    "turned by 0.3 degrees": (
        {"kind": "separable", "feature_mm": 0.06, "rotation_deg": 0.3},
        "capture photograph --patterns dots:4",
    ),
    "separable drawing, blurred, calibration": (_CODE | {"edge_blur_um": 3.0}, "calibrate photograph"),
    "separable drawing, turned by 0.1 degrees, calibration": (_CODE | {"rotation_deg": 0.1}, "calibrate photograph"),
    "MURA of 101, calibration": ({"kind": "mura", "features": 101, "feature_mm": 0.06}, "calibrate photograph"),
    "disc, calibration": (_DISC, "calibrate photograph"),
}
"""Masks' tables in a camera file, and what is run behind them."""


def draw(folder: Path) -> None:
    """The cases' drawings, and the photograph as sheets of 20 mm and 2 mm."""
    at, fine = np.arange(64) - 32.0, (np.arange(512) + 0.5 - 256) * 0.01
    squared = fine[:, None] ** 2 + fine**2
    code = max_len_seq(9)[0]
    # Light through a smooth random surface, as a diffuser's caustics.
    waves = np.fft.rfft2(np.random.default_rng(0).normal(size=(600, 600)))
    slow = np.exp(-np.square(np.hypot(np.fft.fftfreq(600)[:, None], np.fft.rfftfreq(600)) / 0.012))
    surface = np.fft.irfft2(waves * slow, (600, 600))
    bent = np.stack(np.gradient(surface / surface.std() * 600)).reshape(2, -1) + np.indices((600, 600)).reshape(2, -1)
    caustics = np.histogram2d(*bent, bins=600, range=((0, 600), (0, 600)))[0]
    drawings = {
        "disc": at[:, None] ** 2 + at**2 <= 14**2,
        "zones": (np.cos(np.pi * squared / 0.23**2) > 0) & (squared < 2.56**2),
        "code": np.outer(code, code),
        "caustics": np.minimum(caustics / np.quantile(caustics, 0.9999), 1),
    }
    for name, values in drawings.items():
        io.imsave(folder / f"{name}.png", np.round(255.0 * values).astype(np.uint8), check_contrast=False)
    shipped = Path("scenes/photograph")
    for half in (10, 1):
        (folder / f"{half}").mkdir()
        for picture in shipped.glob("*.png"):
            (folder / f"{half}" / picture.name).write_bytes(picture.read_bytes())
        scene = (shipped / "scene.xml").read_text().replace('<scale x="64" y="64"', f'<scale x="{half}" y="{half}"')
        (folder / f"{half}/scene.xml").write_text(scene)


def cases() -> None:
    """Runs behind the cases' masks; captures at an accuracy of 3e-3."""
    bare = Path("calibration/imx249.toml").read_text()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        draw(folder)
        for number, (name, (mask, command)) in enumerate(CASES.items()):
            table = "\n".join(f"{key} = {json.dumps(value)}" for key, value in mask.items())
            (folder / f"{number}.toml").write_text(f"{bare}\n[mask]\n{table}\n")
            words = [*command.split(), "--camera", f"{number}.toml", "--json", "--quiet"]
            if command.startswith("capture"):
                words += ["--accuracy", "3e-3"]
            for again in ("first", "second"):
                found = taken([*words, "-o", f"{number}.{again}"], folder)
            reported(case=name, **found)


def taken(words: list[str], folder: Path) -> dict[str, object]:
    """What ``mitsim`` with these ``words`` takes in a process of its own, beside what it predicts, and what it says."""
    printed, message = folder / "printed", folder / "message"
    started = time.perf_counter()
    with printed.open("wb") as out, message.open("wb") as error:
        child = subprocess.Popen(
            [sys.executable, "-m", "mitsim", *words],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(Path.cwd())},
            stdout=out,
            stderr=error,
        )
    _, ended, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(ended)
    found: dict[str, object] = {
        "status": child.returncode,
        "seconds": time.perf_counter() - started,
        "processor_s": usage.ru_utime + usage.ru_stime,
        "process_GiB": usage.ru_maxrss / 2**20,
        "said": message.read_text().strip()[:200],
    }
    if child.returncode in (0, 1):
        told = json.loads(printed.read_text())
        found |= {"plan_s": told["seconds"]["plan"], "predicted_s": told.get("predicted_seconds")}
        found |= {
            f"{key[:-6]}_GiB": told[key] / 2**30 for key in ("memory_bytes", "predicted_memory_bytes") if key in told
        }
        found |= {key: told[key] for key in ("total_error_bound", "factor_error") if key in told}
    return found


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
    for part in (cases, costs, errors, mounted, nodes):
        if part.__name__ in sys.argv[1:] or not sys.argv[1:]:
            part()
