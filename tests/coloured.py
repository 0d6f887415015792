"""Coloured folders of an ideal camera that sees the ColorChecker: one mono session for each line, by numpy alone."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mitsim.reconstruct.colour import chart
from mitsim.rig.chart import ChartPlace
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
