"""Coloured folders of an ideal camera that sees the ColorChecker: one mono session for each line, by numpy alone."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mitsim.core.colour_files import MosaicManifest
from mitsim.core.manifests import AmbientFile, Digital, Patterns, RunManifest
from mitsim.core.runs import AMBIENT, LineTruth, MosaicCapture, Recorder, frame_name
from mitsim.devices.framelist import ChartPlace
from mitsim.devices.patterns import parse_patterns
from mitsim.reconstruct.colour import chart
from tests import ideal_sessions

N, LINES = 24, (638.0, 520.0, 445.0)
SHARES = (0.4757, 0.3348, 0.1895)
PLACE = ChartPlace(
    spectra="ColorChecker N Ohta",
    patches=tuple((6 * i + 1, 6 * i + 5, 4 * j + 1, 4 * j + 3) for i in range(4) for j in range(6)),
)
"""4 x 6 patches of 6 x 4 pixels, without their borders."""


def scenes() -> dict[str, np.ndarray]:
    """(N, N) reflectance of the chart at each line, by its name."""
    patches = chart().at(LINES).T.reshape(len(LINES), 4, 6)
    return {f"{wave:g}nm": np.kron(each, np.ones((6, 4))) for wave, each in zip(LINES, patches, strict=True)}


def manifest(kind: str, lines: Sequence[float] = LINES) -> dict[str, object]:
    channels = [
        {"name": f"{wave:g}nm", "wavelength_nm": wave, "radiant_share": share}
        for wave, share in zip(lines, SHARES, strict=False)
    ]
    return {"kind": kind, "channels": channels}


def folders(place: Path, patterns: str = "dots:4", peak: float = 3e4) -> tuple[Path, Path]:
    """A coloured run and its calibration in ``place``."""
    side = ideal_sessions.shadow(0.0, N)
    bench = ideal_sessions.Bench(side, side, peak=peak)
    run, calibration = place / "run", place / "cal"
    for folder, kind in ((run, "colour-run"), (calibration, "colour-calibration")):
        folder.mkdir()
        (folder / "colour.json").write_text(json.dumps(manifest(kind)))
    for seed, (name, scene) in enumerate(scenes().items()):
        shots, factors = bench.run(patterns, scene, seed), bench.calibrated(seed, 1e-5)
        camera = {"camera": {"projector": {"n": N, "lines_nm": [LINES[seed]], "radiant_shares": [1.0]}}}
        shots.manifest = shots.manifest.model_copy(update=camera)
        shots.save(run / name)
        replace(factors, manifest=factors.manifest.model_copy(update=camera)).save(calibration / name)
    return run, calibration


WEIGHTS = ((0.10, 0.15, 0.50), (0.06, 0.45, 0.05), (0.06, 0.45, 0.05), (0.36, 0.05, 0.02))
"""Electrons per photon of blue, green, green and red pixels at the lines."""


LAMP = 0.02, 0.06, 0.06, 0.04
"""Of blue, green, green and red pixels: a lamp's part of the brightest pixel under the projector."""


def mosaic_folders(
    place: Path, patterns: str = "dots:4", peak: float = 3e4, truths: bool = True, lamp: bool = False
) -> tuple[Path, Path]:
    """A run of the same chart behind filters BGGR, all lines at once, and its calibration, in ``place``; under an even
    ``lamp`` where that is asked for, with its ambient frame.

    Each line has a shadow of its own, a third of a pixel from the next.
    """
    sides = {
        f"{wave:g}nm": ideal_sessions.shadow(shift, N) for wave, shift in zip(LINES, (-0.3, 0.0, 0.3), strict=True)
    }
    family, rng = parse_patterns(patterns, N), np.random.default_rng(7)
    images = scenes()
    lights = []
    for shot in family.shots:
        light = np.zeros((ideal_sessions.PIXELS,) * 2)
        for number, (name, side) in enumerate(sides.items()):
            seen = side @ (family.light(shot) * images[name]) @ side.T
            for weights, (a, b) in zip(WEIGHTS, ((0, 0), (0, 1), (1, 0), (1, 1)), strict=True):
                light[a::2, b::2] += weights[number] * seen[a::2, b::2]
        lights.append(light)
    always = np.tile(np.reshape(LAMP, (2, 2)), np.array(lights[0].shape) // 2) * max(light.max() for light in lights)
    lights = [light + lamp * always for light in lights]
    gain, memory = peak / max(light.max() for light in lights), Recorder()

    def exposed(light: np.ndarray) -> np.ndarray:
        electrons = rng.poisson(gain * light) + ideal_sessions.READ * rng.standard_normal(light.shape)
        return np.clip(np.rint(ideal_sessions.GAIN * electrons + ideal_sessions.BLACK), 0, 2**13 - 1).astype(np.uint32)

    for index, light in enumerate(lights):
        memory.write_frame(index, {"DN": exposed(light)}, {})
    if lamp:
        memory.write(AMBIENT, {"DN": np.mean([exposed(always) for _ in range(16)], axis=0, dtype=np.float32)}, {})
    digital = Digital(
        exposure_s=gain, gain_dn_per_e=ideal_sessions.GAIN, black_level_dn=ideal_sessions.BLACK,
        dark_current_e_per_s=0.0, read_noise_e=ideal_sessions.READ, step_dn=1.0,
    )  # fmt: skip
    files = [frame_name(index) for index in range(len(lights))]
    ambient = AmbientFile(file=AMBIENT, shots=16) if lamp else None
    held = RunManifest(camera={}, digital=digital, patterns=Patterns.of(family, files), ambient_frame=ambient)
    shots = memory.finish(held)
    named = MosaicManifest.model_validate({**manifest("mosaic-run"), "mosaic": "BGGR", "weights": WEIGHTS})
    known = {name: LineTruth(image, np.full(image.shape, 1e-4), 0.99) for name, image in images.items()}
    run, calibration = place / "run", place / "cal"
    MosaicCapture(shots, named, known if truths else {}).save(run)
    calibration.mkdir()
    (calibration / "colour.json").write_text(json.dumps(manifest("colour-calibration")))
    for seed, (name, side) in enumerate(sides.items()):
        ideal_sessions.Bench(side, side).calibrated(seed, 1e-5).save(calibration / name)
    return run, calibration
