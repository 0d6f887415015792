"""`mitsim reconstruct`: a folder of frames and a calibration folder in, an image out.

It reads manifests and frames only, so folders made by hand from a real camera work as well (docs/formats.md). It never
sees the scene or its truth.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, FailFast, Field, StrictBool

from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import validated
from mitsim.core.errors import MitsimError, cut
from mitsim.core.framefile import checksum, read_frame
from mitsim.core.manifest import read_json
from mitsim.core.resources import Cost, Limits
from mitsim.reconstruct.accumulator import Accumulator
from mitsim.reconstruct.solver import Prepared, Solution, prepare
from mitsim.reconstruct.tv import TVSolution, solve_tv

_MOST_PIXELS = 4096
_BYTES_A_NUMBER = 32.0
"""Memory for each number of the factors' slabs: itself, and the copies that factorising makes."""
# Bounds far from any camera, within which products of these numbers stay finite.
Weight = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Row = Annotated[tuple[Weight, ...], Field(max_length=_MOST_PIXELS), FailFast()]
Positive = Annotated[float, Field(ge=1e-12, le=1e12, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=1e12, allow_inf_nan=False)]


def _texts(checksums: dict[str, Any]) -> dict[str, str]:
    """One complaint, where pydantic would list each of a million."""
    wrong = next((name for name, value in checksums.items() if not isinstance(value, str)), None)
    if wrong is not None:
        raise ValueError(f"that of {cut(wrong)!r} is no text")
    return checksums


Checksums = Annotated[dict[str, Any], AfterValidator(_texts)]


class Digital(BaseModel):
    """How digital numbers become photoelectrons a second: (DN - black level) / gain / exposure - dark current."""

    model_config = ConfigDict(frozen=True)

    exposure_s: Positive = Field(description="exposure of every frame [s]")
    gain_dn_per_e: Positive = Field(description="digital numbers per electron")
    black_level_dn: NonNegative = Field(description="digital number without charge")
    dark_current_e_per_s: NonNegative = Field(description="dark electrons a second and pixel")


class Shot(BaseModel):
    """One captured frame: pattern (row, column), whole (sign 0) or the +1 or -1 half of a signed pattern."""

    model_config = ConfigDict(frozen=True)

    file: str = Field(
        pattern=r"^[^/\\\x00]+$", max_length=255, description="name of the frame in the run's folder, without a path"
    )
    row: int = Field(ge=0, description="column i of P_L")
    column: int = Field(ge=0, description="column j of P_R")
    sign: Literal[-1, 0, 1] = Field(description="0, or the half of a signed pattern")


class Patterns(BaseModel):
    """Factors of the patterns, (n, K) each, and the frames that show them."""

    model_config = ConfigDict(frozen=True)

    P_L: Annotated[tuple[Row, ...], FailFast()] = Field(max_length=_MOST_PIXELS, description="(n, K) rows of P_L")
    P_R: Annotated[tuple[Row, ...], FailFast()] = Field(max_length=_MOST_PIXELS, description="(n', K') rows of P_R")
    captures: Annotated[tuple[Shot, ...], FailFast()] = Field(max_length=1 << 16, description="every frame of the run")


class RunManifest(BaseModel):
    """What a run's manifest.json must say; anything else in it is left to others."""

    model_config = ConfigDict(frozen=True)

    camera: dict[str, Any] = Field(description="identity that a calibration must share")
    digital: Digital = Field(description="how frames are read")
    patterns: Patterns = Field(description="what was projected")
    checksums: Checksums = Field(default={}, description="SHA-256 by file name, where known")
    warnings: tuple[str, ...] = Field(default=(), description="why the capture was flagged")


class CalibrationManifest(BaseModel):
    """What a calibration's manifest.json must say."""

    model_config = ConfigDict(frozen=True)

    camera: dict[str, Any] = Field(description="identity that a run must share")
    centre: StrictBool = Field(default=False, description="row and column means are taken out (FlatCam masks)")
    board_reflectance: float | None = Field(
        default=None, gt=0, le=1, description="reflectance of the board that counts as 1 in the image; None: unknown"
    )
    checksums: Checksums = Field(default={}, description="SHA-256 by file name, where known")
    warnings: tuple[str, ...] = Field(default=(), description="why the calibration was flagged")


@dataclass(frozen=True)
class Measurements:
    """Frames of one run, as electrons a second; ``left``, ``right`` are P_L and P_R, (n, K)."""

    folder: Path
    manifest: RunManifest
    left: FloatArray
    right: FloatArray

    def frames(self, shape: tuple[int, int]) -> Iterator[tuple[FloatArray, int, int]]:
        """(measurement of ``shape``, i, j) for every pattern; the halves of a signed one come as their difference."""
        waiting: dict[tuple[int, int], FloatArray] = {}
        for shot in self.manifest.patterns.captures:
            index = (shot.row, shot.column)
            frame = self._rate(shot.file, shape) * (shot.sign or 1)
            if shot.sign and index not in waiting:
                waiting[index] = frame
                continue
            yield waiting.pop(index, 0.0) + frame, *index

    def _rate(self, name: str, shape: tuple[int, int]) -> FloatArray:
        path = self.folder / name
        verify(self.folder, name, self.manifest.checksums, "capture it again with --resume")
        values = _channel(path, "DN")
        if values.shape != shape:
            raise MitsimError(f"{path}: the frame is {_size(values.shape)}, but the calibration's are {_size(shape)}")
        digital = self.manifest.digital
        electrons = (values - digital.black_level_dn) / digital.gain_dn_per_e
        return electrons / digital.exposure_s - digital.dark_current_e_per_s


@dataclass(frozen=True)
class Factors:
    """Calibrated Phi_L (m, n), Phi_R (m', n') [sqrt(electrons / s)] and what the calibration says of them."""

    left: FloatArray
    right: FloatArray
    manifest: CalibrationManifest


def read_run(folder: Path | str) -> Measurements:
    """The run in a folder. MitsimError when it is not a complete capture."""
    folder = Path(folder)
    where = f"{folder}/manifest.json"
    manifest = validated(RunManifest, _manifest(folder, "capture"), where)
    left = _matrix(where, "P_L", manifest.patterns.P_L)
    right = _matrix(where, "P_R", manifest.patterns.P_R)
    _check_captures(where, manifest.patterns.captures, left.shape[1], right.shape[1])
    return Measurements(folder, manifest, left, right)


def read_calibration(folder: Path | str) -> Factors:
    """The factors in a calibration folder. MitsimError when it is not a complete calibration."""
    folder = Path(folder)
    manifest = validated(CalibrationManifest, _manifest(folder, "calibration"), f"{folder}/manifest.json")
    factors = []
    for name in ("left.exr", "right.exr"):
        verify(folder, name, manifest.checksums, "calibrate again")
        factors.append(_channel(folder / name, "factor"))
    return Factors(factors[0], factors[1], manifest)


def verify(folder: Path, name: str, checksums: Mapping[str, str], remedy: str) -> None:
    """MitsimError when a file is not the one whose checksum was noted; files without one are taken as they are."""
    if not (folder / name).resolve().is_relative_to(folder.resolve()):
        raise MitsimError(f"{folder / name}: leads out of its folder; copy the file there")
    expected = checksums.get(name)
    if expected is not None and checksum(folder / name) != expected:
        raise MitsimError(f"{folder / name}: not the file that was written (its checksum differs); {remedy}")


def check_fit(run: Measurements, factors: Factors, calibration: Path | str) -> None:
    """Refuse a calibration of another camera, mask, distance or projector, naming the first thing that differs."""
    ours_all, theirs_all = run.manifest.camera, factors.manifest.camera
    for part in sorted({*ours_all, *theirs_all}):
        ours, theirs = ours_all.get(part), theirs_all.get(part)
        if ours == theirs:
            continue
        if isinstance(ours, Mapping) and isinstance(theirs, Mapping):
            key = next(key for key in sorted({*ours, *theirs}) if ours.get(key) != theirs.get(key))
            part, ours, theirs = f"{part}.{key}", ours.get(key), theirs.get(key)
        raise MitsimError(
            f"calibration {calibration}: {cut(part)} is {cut(str(theirs))}, but {run.folder} has {cut(str(ours))}; "
            "calibrate this camera"
        )
    for side, pattern, factor in (("P_L", run.left, factors.left), ("P_R", run.right, factors.right)):
        if len(pattern) != factor.shape[1]:
            raise MitsimError(
                f"{run.folder}/manifest.json: patterns.{side} has {len(pattern)} scene pixels, but calibration "
                f"{calibration} has {factor.shape[1]}; calibrate with this projector"
            )


def inherited(run: Measurements, factors: Factors) -> tuple[str, ...]:
    """Sentences on why the run or the calibration was flagged: an image made of them is flagged too."""
    return tuple(
        f"The {what} was flagged: {' '.join(warning.split()).rstrip('.')}."
        for what, manifest in (("capture", run.manifest), ("calibration", factors.manifest))
        for warning in manifest.warnings
    )


def load(run: Measurements, factors: Factors) -> tuple[Prepared, Accumulator]:
    """Factorise the model and add every frame of the run. MitsimError when that takes more memory than is free."""
    sides = (factors.left, run.left), (factors.right, run.right)
    numbers = sum(len(factor) * np.count_nonzero(patterns) + factor.size for factor, patterns in sides)
    Cost(memory_bytes=_BYTES_A_NUMBER * float(numbers)).check(f"{run.folder}: factorising its patterns", Limits())
    prepared = prepare(factors.left, factors.right, run.left, run.right, centre=factors.manifest.centre)
    frames = prepared.accumulator()
    for measurement, row, column in run.frames((len(factors.left), len(factors.right))):
        frames.add(measurement, row, column)
    return prepared, frames


def solve(prepared: Prepared, frames: Accumulator, lam: float | Literal["auto"], method: str) -> Solution | TVSolution:
    """The image by ``tikhonov`` (closed form) or ``tv``; for TV ``lam`` is the weight of the total variation."""
    if method == "tikhonov":
        return prepared.solve(frames, lam)
    if method == "tv":
        return solve_tv(prepared, frames, lam)
    raise MitsimError(f"--method {method!r}: use tikhonov or tv")


def _manifest(folder: Path, kind: str) -> dict[str, Any]:
    if not folder.is_dir():
        raise MitsimError(
            f"{folder}: no such folder; give the output of `mitsim {'capture' if kind == 'capture' else 'calibrate'}`"
        )
    manifest = read_json(folder / "manifest.json")
    if not isinstance(manifest, dict) or manifest.get("kind") != kind:
        found = manifest.get("kind") if isinstance(manifest, dict) else type(manifest).__name__
        raise MitsimError(f"{folder}: holds a {cut(str(found))}, not a {kind}; give the right folder")
    if manifest.get("status") != "complete":
        raise MitsimError(f"{folder}: the {kind} is {cut(str(manifest.get('status')))}; finish it with --resume")
    return manifest


def _channel(path: Path, name: str) -> FloatArray:
    """One channel of a frame, all of it finite."""
    channels, _ = read_frame(path)
    if name not in channels:
        raise MitsimError(f"{path}: channels are {', '.join(channels)}; {name} is needed")
    values = channels[name].astype(np.float64)
    bad = int(np.count_nonzero(~np.isfinite(values)))
    if bad:
        raise MitsimError(f"{path}: {bad} values are not finite; capture or calibrate again")
    return values


def _matrix(where: str, name: str, rows: tuple[tuple[float, ...], ...]) -> FloatArray:
    lengths = sorted({len(row) for row in rows})
    if len(lengths) != 1 or lengths[0] == 0:
        found = ", ".join(map(str, lengths)) or "no"
        raise MitsimError(f"{where}: patterns.{name} has rows of {found} numbers; give one row of K for a scene pixel")
    return np.array(rows, dtype=np.float64)


def _check_captures(where: str, captures: tuple[Shot, ...], rows: int, columns: int) -> None:
    """Every pattern once, or as its two halves."""
    signs: dict[tuple[int, int], list[int]] = {}
    for number, shot in enumerate(captures):
        if shot.row >= rows or shot.column >= columns:
            raise MitsimError(
                f"{where}: patterns.captures.{number}: got pattern ({shot.row}, {shot.column}); "
                f"allowed are 0 to {rows - 1} and 0 to {columns - 1}"
            )
        signs.setdefault((shot.row, shot.column), []).append(shot.sign)
    for (row, column), found in signs.items():
        if sorted(found) not in ([0], [-1, 1]):
            raise MitsimError(
                f"{where}: patterns.captures: pattern ({row}, {column}) has frames of signs {found}; "
                "give one of sign 0, or one of +1 and one of -1"
            )
    missing = rows * columns - len(signs)
    if missing:
        first = next((i, j) for i in range(rows) for j in range(columns) if (i, j) not in signs)
        raise MitsimError(
            f"{where}: patterns.captures: {missing} of {rows * columns} patterns have no frame, "
            f"first {first}; capture them all"
        )


def _size(shape: tuple[int, ...]) -> str:
    return "x".join(map(str, shape))
