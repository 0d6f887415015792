"""`mitsim reconstruct`: a folder of frames and a calibration folder in, an image out.

It reads manifests and frames only, so folders made by hand from a real camera work as well (docs/formats.md). It never
sees the scene or its truth.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from mitsim.core.errors import MitsimError
from mitsim.core.frames import checksum, read_frame
from mitsim.core.manifest import read_json
from mitsim.core.parallel import single_threaded_blas
from mitsim.reconstruct.accumulator import Accumulator
from mitsim.reconstruct.solver import Prepared, Solution, prepare
from mitsim.reconstruct.tv import TVSolution, solve_tv

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Measurements:
    """Frames of one run, as electrons a second.

    ``left``, ``right`` are P_L and P_R, (n, K); ``camera`` is the identity that a calibration must share.
    """

    folder: Path
    camera: Mapping[str, Any]
    left: FloatArray
    right: FloatArray
    digital: Mapping[str, float]
    captures: tuple[Mapping[str, Any], ...]
    checksums: Mapping[str, str]

    def __iter__(self) -> Iterator[tuple[FloatArray, int, int]]:
        """(measurement (m, m'), i, j) for every pattern; the halves of a signed pattern come as their difference."""
        waiting: dict[tuple[int, int], FloatArray] = {}
        for shown in self.captures:
            index, sign = (int(shown["row"]), int(shown["column"])), int(shown["sign"])
            frame = self._rate(str(shown["file"])) * (sign or 1)
            if sign and index not in waiting:
                waiting[index] = frame
                continue
            yield waiting.pop(index, 0.0) + frame, *index
        if waiting:
            raise MitsimError(f"{self.folder}: pattern {next(iter(waiting))} has only one of its two captures")

    def _rate(self, name: str) -> FloatArray:
        path = self.folder / name
        expected = self.checksums.get(name)
        if expected is not None and checksum(path) != expected:
            raise MitsimError(
                f"{path}: the frame is not the one that was captured (checksum); capture it again with --resume"
            )
        channels, _ = read_frame(path)
        if "DN" not in channels:
            raise MitsimError(f"{path}: channels are {', '.join(channels)}; a captured frame has DN")
        digital = self.digital
        electrons = (channels["DN"].astype(np.float64) - digital["black_level_dn"]) / digital["gain_dn_per_e"]
        return electrons / digital["exposure_s"] - digital["dark_current_e_per_s"]


@dataclass(frozen=True)
class Factors:
    """Calibrated Phi_L, Phi_R [sqrt(electrons / s)] and the camera they belong to; ``centre`` for FlatCam masks."""

    left: FloatArray
    right: FloatArray
    camera: Mapping[str, Any]
    centre: bool


def read_run(folder: Path | str) -> Measurements:
    """The run in a folder. MitsimError when it is not a complete capture."""
    folder = Path(folder)
    manifest = _manifest(folder, "capture")
    patterns = _section(manifest, folder, "patterns")
    try:
        digital = {key: float(value) for key, value in _section(manifest, folder, "digital").items()}
        left, right = (np.array(patterns[name], dtype=np.float64) for name in ("P_L", "P_R"))
        captures = tuple(dict(shown) for shown in patterns["captures"])
        for key in ("exposure_s", "black_level_dn", "gain_dn_per_e", "dark_current_e_per_s"):
            digital[key]
    except (KeyError, TypeError, ValueError) as error:
        raise MitsimError(
            f"{folder}/manifest.json: {error} is missing or of the wrong form; see docs/formats.md"
        ) from None
    return Measurements(
        folder,
        _section(manifest, folder, "camera"),
        left,
        right,
        digital,
        captures,
        manifest.get("checksums", {}),
    )


def read_calibration(folder: Path | str) -> Factors:
    """The factors in a calibration folder. MitsimError when it is not a complete calibration."""
    folder = Path(folder)
    manifest = _manifest(folder, "calibration")
    factors = []
    for name in ("left", "right"):
        channels, _ = read_frame(folder / f"{name}.exr")
        if "factor" not in channels:
            raise MitsimError(f"{folder}/{name}.exr: channels are {', '.join(channels)}; a calibration has factor")
        factors.append(channels["factor"].astype(np.float64))
    return Factors(factors[0], factors[1], _section(manifest, folder, "camera"), bool(manifest.get("centre", False)))


def check_fit(run: Measurements, factors: Factors, calibration: Path | str) -> None:
    """Refuse a calibration of another camera, mask, distance or projector, naming the first thing that differs."""
    for part in sorted({*run.camera, *factors.camera}):
        ours, theirs = run.camera.get(part), factors.camera.get(part)
        if ours == theirs:
            continue
        if isinstance(ours, Mapping) and isinstance(theirs, Mapping):
            key = next(key for key in sorted({*ours, *theirs}) if ours.get(key) != theirs.get(key))
            part, ours, theirs = f"{part}.{key}", ours.get(key), theirs.get(key)
        raise MitsimError(
            f"calibration {calibration}: {part} is {theirs}, but {run.folder} has {ours}; calibrate this camera"
        )


def load(run: Measurements, factors: Factors) -> tuple[Prepared, Accumulator]:
    """Factorise the model and add every frame of the run."""
    prepared = prepare(factors.left, factors.right, run.left, run.right, centre=factors.centre)
    frames = prepared.accumulator()
    with single_threaded_blas():
        for measurement, row, column in run:
            frames.add(measurement, row, column)
    return prepared, frames


def solve(prepared: Prepared, frames: Accumulator, lam: float | Literal["auto"], method: str) -> Solution | TVSolution:
    """The image by ``tikhonov`` (closed form) or ``tv``; for TV ``lam`` is the weight of the total variation."""
    if method == "tikhonov":
        return prepared.solve(frames, lam)
    if method == "tv":
        return solve_tv(prepared, frames, lam)
    raise MitsimError(f"--method {method!r}: use tikhonov or tv")


def _manifest(folder: Path, kind: str) -> Mapping[str, Any]:
    if not folder.is_dir():
        raise MitsimError(
            f"{folder}: no such folder; give the output of `mitsim {'capture' if kind == 'capture' else 'calibrate'}`"
        )
    manifest = read_json(folder / "manifest.json")
    if not isinstance(manifest, dict) or manifest.get("kind") != kind:
        found = manifest.get("kind") if isinstance(manifest, dict) else type(manifest).__name__
        raise MitsimError(f"{folder}: holds a {found}, not a {kind}; give the right folder")
    if manifest.get("status") != "complete":
        raise MitsimError(f"{folder}: the {kind} is {manifest.get('status')}; finish it with --resume")
    return manifest


def _section(manifest: Mapping[str, Any], folder: Path, name: str) -> Mapping[str, Any]:
    section = manifest.get(name)
    if not isinstance(section, dict):
        raise MitsimError(f"{folder}/manifest.json: section {name!r} is missing; see docs/formats.md")
    return section
