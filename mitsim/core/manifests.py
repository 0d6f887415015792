"""Models of manifest.json, whose fields docs/folders.md lists."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import pydantic
from pydantic import AfterValidator, BaseModel, ConfigDict, FailFast, Field, field_validator, model_validator

from mitsim.core.configuration import LARGEST, NonNegative, Positive, validate
from mitsim.core.errors import MitsimError, cut
from mitsim.core.files import plain, read_json, write_json

if TYPE_CHECKING:  # and where it computes: numpy takes 0.1 s to import, and a refusal needs none of it
    import numpy.typing as npt

    from mitsim.core.arrays import FloatArray

MANIFEST = "manifest.json"
SIDES = ("left", "right")
FORMAT = 1
"""Version of the format that is written, and the newest that is read."""
MOST_PIXELS = 4096
"""Scene pixels a side, and pattern columns; larger manifests would exceed their limit."""
MOST_SHOTS = 1 << 16
"""256 patterns a side."""
_MOST_BINNED = 64**2
"""Pixels that a camera file may bin; a binned pixel's black level and dark current are sums over them."""
UNVERSIONED = "0.3.0"

# Bounds far from any camera, within which products of these numbers stay finite.
Weight = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Row = Annotated[tuple[Weight, ...], Field(strict=False, max_length=MOST_PIXELS), FailFast()]
Rows = Annotated[tuple[Row, ...], Field(strict=False, max_length=MOST_PIXELS), FailFast()]
BinnedSum = Annotated[float, Field(ge=0, le=LARGEST * _MOST_BINNED, allow_inf_nan=False)]
Coordinate = Annotated[float, Field(ge=-1e7, le=1e7, allow_inf_nan=False)]
"""Within 10 km [mm]."""
FARTHEST = 1e10
"""Largest `scene_distance` [mm]."""
Distance = Annotated[float, Field(gt=0, le=FARTHEST, allow_inf_nan=False)]
Texts = Annotated[tuple[str, ...], Field(strict=False)]
Plain = Annotated[dict[str, Any], pydantic.BeforeValidator(plain)]
"""Part that the solver does not read, as JSON."""


def _texts(checksums: dict[str, Any]) -> dict[str, str]:
    """Raise one error, because pydantic would list each of a million entries."""
    wrong = next((name for name, value in checksums.items() if not isinstance(value, str)), None)
    if wrong is not None:
        raise ValueError(f"that of {cut(wrong)!r} is no text; give the SHA-256 of that file, or leave it out")
    return checksums


Checksums = Annotated[dict[str, Any], AfterValidator(_texts)]
FileName = Annotated[str, Field(pattern=r"^[^/\\\x00]+$", max_length=255)]


class _Part(BaseModel):
    # Validators are built at first use: a refusal needs none of the seven, and each takes 3 ms.
    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", defer_build=True)

    @model_validator(mode="before")
    @classmethod
    def _of_0_3_0(cls, data: Any, info: pydantic.ValidationInfo) -> Any:
        """Drop unknown fields of version 0.3.0, which stated no format, because other programs added some."""
        if info.context == UNVERSIONED and isinstance(data, dict):
            return {name: value for name, value in data.items() if name in cls.model_fields}
        return data


# ---- Conversion of numbers to electrons, and patterns ----


class Digital(_Part):
    """How digital numbers become photoelectrons a second: (DN - black level) / gain / exposure - dark current."""

    exposure_s: Positive
    """Exposure of every frame [s]."""
    gain_dn_per_e: Positive
    """Digital numbers per electron."""
    black_level_dn: BinnedSum
    """Digital number of a (binned) pixel without charge."""
    dark_current_e_per_s: BinnedSum
    """Dark electrons a second and (binned) pixel."""
    read_noise_e: BinnedSum | None = None
    """Standard deviation of a (binned) pixel's reading [electrons]; none: not stated."""
    step_dn: BinnedSum | None = None
    """Step between digital numbers; 0: real output; none: not stated, taken as 0."""
    saturation_dn: BinnedSum | None = None
    """Digital number at the full well or the ADC's end; none: never, or not stated."""
    exposure_uncertainty: float = Field(default=0.0, ge=0, le=1)
    """Relative standard uncertainty of exposure times light."""

    @property
    def noise_is_stated(self) -> bool:
        return self.read_noise_e is not None

    def rate(self, dn: npt.NDArray[Any]) -> FloatArray:
        rate: FloatArray = dn.astype("float64")
        rate -= self.black_level_dn
        rate /= self.gain_dn_per_e
        rate /= self.exposure_s
        rate -= self.dark_current_e_per_s
        return rate

    def variance(self, light: FloatArray | float, shots: int = 1) -> FloatArray:
        """Return the noise variance [(electrons / s)^2] of a sum or difference of shots, after EMVA 1288.

        It includes shot noise of light and dark current, read noise and rounding; quantities that are not stated count
        as 0. ``light`` is the sum of the shots' :meth:`rate`, any shape; with measured light the variance is unbiased.
        """
        import numpy as np

        rounding = (self.step_dn or 0.0) ** 2 / 12 / self.gain_dn_per_e**2
        still = shots * ((self.read_noise_e or 0.0) ** 2 + rounding)
        charge = np.asarray(light) + shots * self.dark_current_e_per_s
        return np.asarray(charge / self.exposure_s + still / self.exposure_s**2)


class ShotFile(_Part):
    """One shot: pattern (row, column), whole (sign 0) or the +1 or -1 half of a signed pattern."""

    file: FileName
    """Name of the frame in the run's folder, without a path."""
    row: int = Field(ge=0)
    """Column i of P_L."""
    column: int = Field(ge=0)
    """Column j of P_R."""
    sign: int = Field(ge=-1, le=1)
    """0, or the half (1 + P)/2 or (1 - P)/2 of a signed pattern P."""


class Patterns(_Part):
    """Factors of the patterns, and the shots that show them."""

    family: str | None = None
    """Name of the family, such as `dots:7`, or of the file."""
    n: int | None = Field(default=None, ge=1, le=MOST_PIXELS)
    """Projector pixels a side."""
    P_L: Rows
    """Rows of P_L: for each scene row, one number a pattern column i."""
    P_R: Rows
    """Rows of P_R: for each scene column, one number a pattern column j."""
    captures: Annotated[tuple[ShotFile, ...], FailFast()] = Field(strict=False, max_length=MOST_SHOTS)
    """Every shot; each pattern (i, j) once, or as its two halves."""

    @classmethod
    def of(cls, family: Any, files: Sequence[str]) -> Patterns:
        """Return the patterns of a :class:`mitsim.devices.patterns.PatternFamily` whose shots are in ``files``.

        MitsimError for more pixels or shots than a reader accepts.
        """
        shots = [
            {"file": file, "row": shot.row, "column": shot.column, "sign": shot.sign}
            for file, shot in zip(files, family.shots, strict=True)
        ]
        matrices = {"P_L": family.left.tolist(), "P_R": family.right.tolist()}
        data = {"family": family.name, "n": len(family.left), **matrices, "captures": shots}
        return validate(cls, data, f"patterns {family.name!r}")

    @property
    def matrices(self) -> tuple[FloatArray, FloatArray]:
        """Return P_L (n, K) and P_R (n', K')."""
        import numpy as np

        return np.array(self.P_L, dtype=np.float64), np.array(self.P_R, dtype=np.float64)

    @field_validator("P_L", "P_R")
    @classmethod
    def _rows_of_one_length(cls, rows: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
        lengths = sorted({len(row) for row in rows})
        if len(lengths) != 1 or lengths[0] == 0:
            counts = ", ".join(map(str, lengths)) or "no"
            raise ValueError(f"has rows of {counts} numbers; give one row of K for a scene pixel")
        return rows

    @model_validator(mode="after")
    def _every_pattern_is_captured(self) -> Patterns:
        rows, columns = len(self.P_L[0]), len(self.P_R[0])
        signs: dict[tuple[int, int], list[int]] = {}
        first_of: dict[str, int] = {}
        for number, shot in enumerate(self.captures):
            earlier = first_of.setdefault(shot.file, number)
            if earlier != number:
                raise ValueError(
                    f"captures.{number}: names {cut(shot.file)!r}, as captures.{earlier} does; give each its own frame"
                )
            if shot.row >= rows or shot.column >= columns:
                raise ValueError(
                    f"captures.{number}: got pattern ({shot.row}, {shot.column}); "
                    f"allowed are 0 to {rows - 1} and 0 to {columns - 1}"
                )
            signs.setdefault((shot.row, shot.column), []).append(shot.sign)
        for index, halves in signs.items():
            if sorted(halves) not in ([0], [-1, 1]):
                allowed = "give one of sign 0, or one of +1 and one of -1"
                raise ValueError(f"captures: pattern {index} has frames of signs {halves}; {allowed}")
        if missing := rows * columns - len(signs):
            first = next((i, j) for i in range(rows) for j in range(columns) if (i, j) not in signs)
            raise ValueError(
                f"captures: {missing} of {rows * columns} patterns have no frame, first {first}; capture them all"
            )
        return self


# ---- Runs ----


class _Head(_Part):
    format: int = Field(default=FORMAT, ge=1, le=FORMAT)
    """Version of this format; without a version, unknown fields are ignored, as in version 0.3.0."""
    status: Literal["incomplete", "complete"] = "complete"
    """`complete` if all files are written."""
    configuration: Plain = {}
    """Everything that determines the frames: options, files, devices, versions."""
    warnings: Texts = ()
    """Reasons why the folder is flagged; an image from it is flagged too."""
    versions: dict[str, str] = {}
    """Versions of mitsim, Python and packages."""
    command: str | None = None
    """Command line that finished the folder; none: Python, or not stated."""
    opened: Plain | None = None
    """Arguments for `mitsim run --from`: names of the files of `camera` and `projector` (none: the default ones), and
    `allow_outside_files`; none: not stated."""


class AmbientFile(_Part):
    """The ambient frame, seen with the projector off, which is taken off frames that are not one of a pair."""

    file: FileName
    """Name of the frame in the run's folder, without a path."""
    shots: int = Field(ge=1, le=MOST_SHOTS)
    """Number of averaged shots, each with the exposure of the frames."""
    part: float | None = None
    """Ambient light as a fraction of all light in the frames."""
    noise: float | None = None
    """Noise of the frames without ambient light, relative to the projector's light; closed form."""


ClosingKind = Literal["first", "uniform"]
"""Light of a closing frame: the first shot again, or all projector pixels at full power."""


class ClosingFile(_Part):
    """The closing frame, which is taken after all others to check that lamp, camera and scene stayed the same."""

    kind: ClosingKind
    """`first`: the first shot again; `uniform`: all projector pixels at full power."""
    file: FileName
    """Name of the frame in the run's folder, without a path."""
    exposure_s: Positive
    """Exposure of this frame [s]; shorter than the run's if a uniform frame would saturate."""


class RunHead(_Head):
    """Manifest of an unfinished run, and beginning of a finished run's manifest."""

    kind: Literal["capture"] = "capture"
    """Kind of the folder."""
    configuration_sha256: str = ""
    """Hash of `configuration`; only the same configuration can resume the run."""

    @classmethod
    def of(cls, configuration: Mapping[str, Any]) -> RunHead:
        digest = hashlib.sha256(json.dumps(configuration, sort_keys=True).encode()).hexdigest()
        return cls(status="incomplete", configuration=dict(configuration), configuration_sha256=digest)


class RunManifest(RunHead):
    """Manifest of a capture: how its frames are read, and the projected patterns."""

    camera: Plain
    """Identity that a calibration must share; any value."""
    digital: Digital
    """Conversion of digital numbers to electrons a second."""
    patterns: Patterns
    """Projected patterns, and the files of their shots."""
    ambient_frame: AmbientFile | None = None
    """Frame of the ambient light; none: nothing is subtracted from the frames."""
    closing_frame: ClosingFile | None = None
    """Closing frame; none: none was taken. It is no measurement."""
    order: str | None = None
    """Order in which the imported frames were taken (`mitsim import --order`); none: that of `captures`."""
    checksums: Checksums = {}
    """SHA-256 by file name, if known."""
    plan: Plain | None = None
    """Effect plan, see Plan."""
    mc_error: NonNegative | None = None
    """Relative Monte Carlo error of the expected frames."""
    total_error: float | None = None
    """Relative error of the expected frames: the plan's systematic error and the Monte Carlo error."""
    total_error_bound: float | None = None
    """Upper bound of the total error at 95 %."""
    total_error_of_projector: float | None = None
    """The same bound relative to the projector's light alone, which is larger if lamps are on."""
    mc_to_sensor_noise: float | None = None
    """Largest ratio of Monte Carlo error to a frame's sensor noise."""
    sensor_noise: float | None = None
    """Relative noise of the sensor over all frames, closed form."""
    heaviest_group: float | None = None
    """Largest fraction of the Monte Carlo variance in one group of the light; above 0.72, a few heavy paths cause it.
    """
    truth_error: NonNegative | None = None
    """Standard error of truth.exr, rms over the image; 1 is the board's reflectance."""
    light_error: NonNegative | None = None
    """Standard error of single projector pixels' light in the frames, rms; 1 is the board's."""
    paths: int | None = None
    """Connections and paths traced."""
    lost_light: float | None = None
    """Fraction of the light that came from beyond the plan's directions; it is missing in the frames."""
    seconds: dict[str, float] = {}
    """Seconds by stage; `imports`: of modules that no earlier work needed."""
    kernels: dict[str, int | float] = {}
    """`number` of kernels that were not in a cache, and `seconds` of compiling them, which are included above."""
    predicted_memory_bytes: float | None = None
    """Predicted peak of memory, beyond the memory that the program used before."""

    @property
    def others(self) -> dict[str, str]:
        frames = {"ambient": self.ambient_frame, "closing": self.closing_frame}
        return {name: frame.file for name, frame in frames.items() if frame}

    @model_validator(mode="after")
    def _other_frames_are_no_captures(self) -> RunManifest:
        for name, file in self.others.items():
            if any(shot.file == file for shot in self.patterns.captures):
                raise ValueError(f"{name}_frame: names {cut(file)!r}, a capture's file; give the {name} frame's own")
        if len({*self.others.values()}) < len(self.others):
            raise ValueError("closing_frame: names the ambient frame's file; give its own")
        return self


# ---- Calibrations ----


class FactorNoise(_Part):
    """Deviation of a calibration's factors from the camera's true factors."""

    left: NonNegative
    """Standard deviation of each number of the left factor from noise."""
    right: NonNegative
    """Standard deviation of each number of the right factor from noise."""
    unexplained: NonNegative
    """Fraction of the responses that no separable camera explains, rms."""


Edges = Annotated[tuple[Coordinate, ...], Field(strict=False, min_length=2, max_length=2)]
"""Edges of the first and of the last projector pixel."""


class Parallax(_Part):
    """Motion of a calibration's factors with depth.

    On a plane at distance z, seen from the middle of the frames, the projector's window has its edges at tan-angles
    window + parallax (1/z - 1/depth), in index coordinates.
    """

    depth_mm: Distance
    """Distance from sensor to board [mm]."""
    row_tan: Edges
    """First and last edge of the window's rows on the board."""
    column_tan: Edges
    """First and last edge of the window's columns on the board."""
    row_mm: Edges
    """Parallax of the edges of rows; the baseline, if the projector faces in the direction of the camera."""
    column_mm: Edges
    """Parallax of the edges of columns."""
    pixel_pitch_mm: Distance
    """Distance between columns of (binned) sensor pixels, and between rows."""
    row_pitch_mm: Distance | None = None
    """Distance between rows, if pixels are not square."""
    mask_distance_mm: Distance
    """Distance from sensor to mask."""
    stop_tan: Distance | None = None
    """Tangent at which a square field stop ends, along both axes; none: unknown."""

    @model_validator(mode="after")
    def _a_window_behind_a_mask(self) -> Parallax:
        for name, window in (("row_tan", self.row_tan), ("column_tan", self.column_tan)):
            if not window[1] > window[0]:
                raise ValueError(f"{name} ends at {window[1]:g} and begins at {window[0]:g}; give increasing edges")
        if not self.mask_distance_mm < self.depth_mm:
            raise ValueError(f"mask_distance_mm {self.mask_distance_mm:g} must be below depth_mm {self.depth_mm:g}")
        return self

    def pitch_mm(self, axis: int) -> float:
        return self.pixel_pitch_mm if axis or self.row_pitch_mm is None else self.row_pitch_mm


class FittedNumber(_Part):
    """Parameter of a modelled camera."""

    value: float
    """Value in its unit."""
    standard_error: NonNegative | None = None
    """Standard error from the fit; none: the number was held fixed."""
    unit: str
    """Unit of value and standard error."""


class ModelledFactors(_Part):
    """Fit of modelled factors."""

    model: Literal["geometric", "wave"]
    """Model of the mask's shadow."""
    frames: int = Field(ge=1, le=MOST_SHOTS)
    """Number of frames in the fit."""
    chi_square: NonNegative
    """Chi-square per datum of the fit; 1 for a correct model."""
    parameters: dict[str, FittedNumber]
    """Fitted numbers by name: positions of mask and projector, and the gain."""


class CalibrationManifest(_Head):
    """Manifest of a calibration: its camera, and how its factors are used."""

    kind: Literal["calibration"] = "calibration"
    """Kind of the folder."""
    camera: Plain
    """Identity that a run must share."""
    centre: bool = False
    """True if row and column means are removed from frames and factors (FlatCam masks)."""
    board_reflectance: float | None = Field(default=None, gt=0, le=1)
    """Reflectance of the board that counts as 1 in the image; none: unknown."""
    digital: Digital | None = None
    """Conversion of the session's digital numbers to electrons a second."""
    checksums: Checksums = {}
    """SHA-256 by file name, if known."""
    noise: FactorNoise | None = None
    """Noise of the factors; none: not stated."""
    parallax: Parallax | None = None
    """Motion of the factors with depth; none: unknown, and no `--focus`."""
    modelled: ModelledFactors | None = None
    """Fitted model; none: the factors are measured."""
    result: Plain = {}
    """Results of the session, as in `calibrate --json`."""
    estimate: str | None = None
    """Text of the estimator."""
    verdict: str | None = None
    """Verdict of the estimator, one of `mitsim.reconstruct.solver.Verdict`."""


# ---- Reading and writing ----

Manifest = TypeVar("Manifest", RunManifest, CalibrationManifest)


def read_manifest(folder: Path, model: type[Manifest]) -> Manifest:
    """Return the manifest of a finished work; MitsimError if it is missing, of another kind, unfinished, or invalid."""
    if not folder.is_dir():
        command = "capture" if model is RunManifest else "calibrate"
        raise MitsimError(f"{folder}: no such folder; give the output of `mitsim {command}`")
    return checked_manifest(read_json(folder / MANIFEST), model, folder)


def checked_manifest(data: Any, model: type[Manifest], place: Path) -> Manifest:
    """Return ``data`` as a finished work's manifest; MitsimError if it is of another kind, unfinished, or invalid."""
    kind = model.model_fields["kind"].default
    if not isinstance(data, dict) or data.get("kind") != kind:
        raise MitsimError(f"{place}: holds a {cut(kind_of(data))}, not a {kind}; give the right folder")
    if data.get("status") != "complete":
        raise MitsimError(f"{place}: the {kind} is {cut(str(data.get('status')))}; finish it with resume=True")
    return validate(model, data, f"{place}/{MANIFEST}", None if "format" in data else UNVERSIONED)


def kind_of(data: Any) -> str:
    return str(data.get("kind") if isinstance(data, dict) else type(data).__name__)


def resumable(folder: Path, kind: str) -> dict[str, Any]:
    """Return the manifest of finished or unfinished work; MitsimError if there is none."""
    data = read_json(folder / MANIFEST)
    if not isinstance(data, dict) or data.get("kind") != kind:
        raise MitsimError(f"resume=True: {folder}/{MANIFEST} is not that of a {kind}; use another folder")
    return data


def other_request(place: Path, kind: str, earlier: Mapping[str, Any], own: Mapping[str, Any]) -> MitsimError:
    """Return the refusal to resume work whose ``earlier`` configuration differs from one's ``own``."""
    changed = ", ".join(key for key in {**own, **earlier} if earlier.get(key) != own.get(key)) or "unknown"
    words = f"holds {kind} of another configuration ({changed} differ)"
    return MitsimError(f"resume=True: {place} {words}; use the same options, or another folder")


def write_manifest(folder: Path, manifest: RunHead | CalibrationManifest) -> None:
    # Version 0.10.0 refuses keys that it does not know.
    left_out = {key for key in ("closing_frame", "order") if getattr(manifest, key, None) is None}
    write_json(folder / MANIFEST, manifest.model_dump(exclude=left_out))
