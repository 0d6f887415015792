"""A run and its calibration in one MATLAB file: folders in, the file out, and back.

With the variables of the paper's public script `phi_left` (P o X) `phi_right`' = `data_coded` - `measBg` in digital
numbers, for each pattern P = PL(:, i) PR(:, j)' (Zheng & Asif, arXiv 2111.12862, section III-B).

Files that are written are of version 5, which SciPy, GNU Octave and every MATLAB read; version 7.3 is read, too. The
calibration of a real FlatCam (Asif et al. 2017, arXiv 1509.00116) is read: a plane of its colour sensor, less the
means of its rows and columns, is P1 X Q1^T.
"""

from __future__ import annotations

import json
import math
import operator
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray, is_hdf5, read_variables, write_variables
from mitsim.core.errors import MitsimError, cut
from mitsim.core.exr import Channel, Channels, Metadata
from mitsim.core.imagelist import ALL, WAVELENGTHS_NM, check_channel
from mitsim.core.manifests import (
    CALIBRATION,
    MOSAIC,
    RUN,
    SIDES,
    CalibrationManifest,
    Digital,
    RunManifest,
    ShotFile,
    lines_of_planes,
)
from mitsim.core.runs import TRUTH
from mitsim.exchange.capture_list import TURNED
from mitsim.exchange.hdf5 import read_matlab
from mitsim.exchange.packed import (
    FACTORS,
    Calibration,
    Content,
    Loaded,
    Packed,
    Run,
    as_channel,
    shots_of,
    unpack,
    unpack_colours,
    unpack_run,
)

ELECTRONS = "expected electrons of the frames"
"""What such a file does not hold of a simulated run."""
Variables = dict[str, Any]
"""Arrays and texts by name."""

# -------- The variables of a file


@dataclass(frozen=True, eq=False)
class MatFile:
    """What a MATLAB file holds, or what it holds of one line; checked as it is asked for.

    Attributes
    ----------
    path
        of the file, for messages.
    values
        arrays and texts by name.
    """

    path: Path
    values: Mapping[str, Any]

    def __contains__(self, name: str) -> bool:
        return name in self.values

    def text(self, name: str) -> str:
        """The text called ``name``; MitsimError where there is none."""
        value = np.asarray(self.values.get(name))
        if value.dtype.kind != "U" or value.size != 1:
            raise MitsimError(
                f"{self.path}: has no text {name}, so it is not of `mitsim export`; it holds "
                f"{', '.join(key for key in self.values if not key.startswith('__'))}"
            )
        return str(value.item())

    def array(self, name: str, shape: tuple[int, ...]) -> npt.NDArray[Any]:
        """The array called ``name``, in a ``shape`` of which MATLAB drops axes of length 1 at the end.

        MitsimError where it is missing, or not of so many real numbers.
        """
        array = np.asarray(self.values.get(name))
        if array.dtype.kind not in "uif" or array.size != math.prod(shape):
            reported = f"is {array.dtype} of shape {array.shape}" if name in self else "is missing"
            raise MitsimError(f"{self.path}: {name} {reported}; numbers of shape {shape} are needed")
        return array.reshape(shape, order="F")

    def matrix(self, name: str) -> FloatArray:
        """The matrix called ``name``, of any size; MitsimError where it is missing, or none of real numbers."""
        matrix = np.asarray(self.values.get(name))
        if matrix.ndim != 2 or matrix.dtype.kind not in "uif":
            reported = "no matrix of numbers" if name in self else "missing"
            raise MitsimError(f"{self.path}: {name} is {reported}; write it again")
        return matrix.astype(np.float64)

    def image(self, name: str, scale: float = 1.0) -> Channel:
        """The matrix called ``name``, over a ``scale``, as a channel: (rows, columns) float32."""
        # Rounding in double precision is far below half of the last digit in single: the number is the one written.
        return as_channel((self.matrix(name) / scale).astype(np.float32), name, self.path)

    def by_line(self, names: Sequence[str]) -> dict[str, MatFile]:
        """What it holds of each of the lines ``names``, by the variables' names without their ending."""
        return {
            name: MatFile(
                self.path, {key.removesuffix(end): each for key, each in self.values.items() if key.endswith(end)}
            )
            for name, end in endings(names, self.path).items()
        }


def variables_in(path: Path) -> dict[str, Any]:
    """The arrays of real numbers and the texts of the MATLAB file ``path``, of version 5 or 7.3, by name.

    MitsimError for a file that is missing, damaged, of version 4, or that takes more memory than is free.
    """
    return read_matlab(path) if is_hdf5(path) else read_variables(path)


COLOURED, FILTERED, _CALIBRATED = "colour_run", "mosaic_run", "colour_calibration"
"""Variables that hold the colour.json of a coloured run, of one behind colour filters, and of a calibration."""
_LONGEST_LINE = 31
"""Letters of a line's name: a variable of MATLAB has 63 at most, truth_board_reflectance_ half of them."""


def endings(names: Sequence[str], path: Path) -> dict[str, str]:
    """What variables of each line end in, by the line's name: of letters, digits and _, as MATLAB wants it.

    Parameters
    ----------
    names
        of the lines; "" of a run that tells none apart.
    path
        of the file, for messages.

    Raises
    ------
    MitsimError
        for a name that no variable can end in, or two that are the same to MATLAB.
    """
    ends = {name: name and "_" + re.sub(r"[^0-9A-Za-z_]", "_", name) for name in names}
    for name in filter(None, names):
        # Beginning with a digit, they are no end of another variable: truth_standard_error is not of a line `error`.
        if not (name[0].isdigit() and len(name) <= _LONGEST_LINE) or [*ends.values()].count(ends[name]) > 1:
            raise MitsimError(
                f"{path}: a line is called {cut(name)}, which no variable of MATLAB can end in; use the format hdf5"
            )
    return ends


# -------- Folders in, the paper's variables out


def write_matlab(path: Path, run: Run, calibration: Calibration | None) -> tuple[str, ...]:
    """Write a run with the paper's variables, whole or not at all; returns sentences on what is left out.

    Of several lines, the variables of each end in its name: `phi_left_638nm`. Behind colour filters the frames are
    those of all lines, only the truths and factors of each line end in its name, and `weights` is (4, lines) of what
    each filter passes.

    Parameters
    ----------
    path
        of the file.
    run
        of whole shots, or of signed pairs; with lines called as `mitsim capture` calls them.
    calibration
        that goes with it, of the same lines; without one `phi_left` and `phi_right` are left out.

    Raises
    ------
    MitsimError
        for a run that mixes whole shots and pairs, or is larger than such a file may be, and for lines whose names
        cannot end one of a variable.
    """
    ends, variables = endings(run.names, path), _colour_variables(run, calibration)
    if run.filters:
        shots = run.parts[""]
        variables.update(
            {**_coded_frames(shots), **_folder_variables(shots, None), "weights": np.array(run.filters.weights)}
        )
    for name, end in ends.items():
        factors = calibration.parts[name] if calibration else None
        if name in run.parts:
            own = {**_coded_frames(run.parts[name]), **_folder_variables(run.parts[name], factors)}
        else:
            own = _truth_variables(*run.truths[name]) if name in run.truths else {}
            own.update(_calibration_variables(factors, run.of_line(name).manifest.digital))
        variables.update({f"{key}{end}": values for key, values in own.items()})
    write_variables(path, variables)
    without = () if calibration else ("phi_left and phi_right are left out: no calibration was given",)
    return (*without, f"Left out: {ELECTRONS}")


def _coded_frames(run: Packed[RunManifest]) -> Variables:
    """`data_coded`, `measBg` and, of signed pairs, `data_negative`: (rows, columns, K, K') each, or (rows, columns)."""
    manifest = run.manifest
    signs = {abs(shot.sign) for shot in manifest.patterns.captures}
    if len(signs) != 1:
        raise MitsimError(f"{run.place}: mixes whole shots and signed pairs; use the format hdf5")
    signed = signs == {1}
    left, right = manifest.patterns.matrices
    stacks: dict[int, FloatArray] = {}
    for shot, channels, _ in shots_of(run):
        dn = channels["DN"]
        if not stacks:
            kind = dn.dtype.name
            shape = *dn.shape, left.shape[1], right.shape[1]
            stacks = {sign: np.empty(shape, order="F") for sign in ((-1, 1) if signed else (0,))}
        stacks[shot.sign][:, :, shot.row, shot.column] = dn
    if not signed:
        return {"data_coded": stacks[0], "dn_class": kind, "measBg": _background(run, stacks[0].shape[:2])}
    difference = stacks[1] - stacks[-1]
    if not np.array_equal(difference + stacks[-1], stacks[1]):
        raise MitsimError(f"{run.place}: differences of its pairs have more digits than a double; use the format hdf5")
    none = np.zeros(difference.shape[:2])
    return {"data_coded": difference, "data_negative": stacks[-1], "dn_class": kind, "measBg": none}


def _background(run: Packed[RunManifest], shape: tuple[int, ...]) -> FloatArray:
    """(rows, columns) digital numbers of a frame without the projector's light."""
    ambient, digital = run.manifest.ambient_frame, run.manifest.digital
    if ambient is not None:
        return run.read(ambient.file)[0]["DN"].astype(np.float64)
    return np.full(shape, digital.black_level_dn + digital.dark_current_e_per_s * _dn_per_rate(digital))


def _colour_variables(run: Run, calibration: Calibration | None) -> Variables:
    """Variables that say of which lines a file is: the colour.json of ``run`` and ``calibration``."""
    variables = {FILTERED if run.filters else COLOURED: run.text} if run.colours else {}
    return {**variables, _CALIBRATED: calibration.text} if calibration and calibration.colours else variables


def _folder_variables(run: Packed[RunManifest], calibration: Packed[CalibrationManifest] | None) -> Variables:
    """Variables of every MATLAB file: manifests, patterns, factors, truth and ambient frame."""
    variables: Variables = {"run_manifest": run.text}
    variables["PL"], variables["PR"] = run.manifest.patterns.matrices
    variables.update(_calibration_variables(calibration, run.manifest.digital))
    variables.update({name: run.read(file)[0]["DN"] for name, file in run.manifest.others.items()})
    return {**variables, **_truth_variables(*run.read(TRUTH))} if TRUTH in run.names else variables


def _calibration_variables(calibration: Packed[CalibrationManifest] | None, digital: Digital) -> Variables:
    """Factors (pixels, n) [sqrt(DN)] and manifest of a ``calibration``, for frames that are read as ``digital`` says;
    none without one."""
    if calibration is None:
        return {}
    named = {f"phi_{side}": factor for side, factor in zip(SIDES, _factors_in_dn(calibration, digital), strict=True)}
    return {**named, "calibration_manifest": calibration.text}


def _truth_variables(channels: Channels, metadata: Metadata) -> Variables:
    """A truth, of the ``channels`` (n, n') and ``metadata`` of its file."""
    variables: Variables = {"truth": channels["reflectance"]}
    variables["truth_board_reflectance"] = float(metadata.get("board_reflectance", math.nan))
    if "standard_error" in channels:
        variables["truth_standard_error"] = channels["standard_error"]
    return variables


def _dn_per_rate(digital: Digital) -> float:
    """Digital numbers of a photoelectron a second, in frames that are read as ``digital`` says."""
    return digital.gain_dn_per_e * digital.exposure_s


def _factors_in_dn(calibration: Packed[CalibrationManifest], digital: Digital) -> tuple[FloatArray, ...]:
    """Left and right factor (pixels, n) of a ``calibration`` [sqrt(electrons / s)] in sqrt(DN)."""
    root = math.sqrt(_dn_per_rate(digital))
    return tuple(calibration.read(name)[0]["factor"].astype(np.float64) * root for name in FACTORS)


# -------- A file in, folders out


@contextmanager
def load_mat(path: Path, channel: str | None) -> Iterator[Loaded]:
    """Run and calibration in a MATLAB file of `mitsim export`.

    Parameters
    ----------
    path
        of the file.
    channel
        the file is the calibration of a real FlatCam, of which this plane is taken, or `all`.

    Raises
    ------
    MitsimError
        for a file that is none of these, or is damaged.
    """
    if channel is not None:
        yield Loaded(None, flatcam_calibration(path, channel))
        return
    file = MatFile(path, variables_in(path))
    run, lines = _run_in(file)
    held = {name: _calibration_part(own, run.of_line(name).manifest.digital) for name, own in lines.items()}
    yield Loaded(run, _calibration_in(file, held, run), (ELECTRONS,))


def _run_in(file: MatFile) -> tuple[Run, dict[str, MatFile]]:
    """The run in a ``file``, and what the file holds of each line."""
    if COLOURED not in file:
        shots = _run_part(file)
        if FILTERED not in file:
            return Content({"": shots}), {"": file}
        text = file.text(FILTERED)
        colours = unpack_colours(text, MOSAIC, file.path, shots.names)
        lines = file.by_line(colours.names)
        truths = {name: _truth_in(own) for name, own in lines.items() if "truth" in own}
        return Content({"": shots}, colours, text, truths), lines
    text = file.text(COLOURED)
    colours = unpack_colours(text, RUN, file.path)
    lines = file.by_line(colours.names)
    return Content({name: _run_part(own) for name, own in lines.items()}, colours, text), lines


def _run_part(own: MatFile) -> Packed[RunManifest]:
    """Return the run of the variables ``own``."""
    text = own.text("run_manifest")
    manifest = unpack_run(text, own.path)
    captures, ambient, closing = manifest.patterns.captures, manifest.ambient_frame, manifest.closing_frame
    frame = _frames_of_patterns(own, manifest)
    shots = {shot.file: shot for shot in captures}
    kind = np.float32 if own.text("dn_class") == "float32" else np.uint32

    def read(name: str) -> tuple[Channels, Metadata]:
        known: Metadata = {"exposure_s": manifest.digital.exposure_s}
        if name in shots:
            shot = shots[name]
            place: Metadata = {"row": shot.row, "column": shot.column, "sign": shot.sign}
            return {"DN": _digital(frame(shot), kind, name, own.path)}, {**place, **known}
        if ambient is not None and name == ambient.file:
            return {"DN": own.image("ambient")}, {"shots": ambient.shots, **known}
        if closing is not None and name == closing.file:
            return {"DN": _digital(own.matrix("closing"), kind, name, own.path)}, {"exposure_s": closing.exposure_s}
        return _truth_in(own)

    names = (*shots, *manifest.others.values(), *((TRUTH,) if "truth" in own else ()))
    return Packed(manifest, text, names, read, own.path)


def _frames_of_patterns(own: MatFile, manifest: RunManifest) -> Callable[[ShotFile], npt.NDArray[Any]]:
    """The frame of a shot in `data_coded`, (rows, columns, K, K')."""
    left, right = manifest.patterns.matrices
    coded = np.asarray(own.values.get("data_coded"))
    if coded.ndim < 2:
        raise MitsimError(f"{own.path}: data_coded is missing, or no frames; export it again")
    shape = *coded.shape[:2], left.shape[1], right.shape[1]
    data = own.array("data_coded", shape)
    stacks = {0: data}
    if any(shot.sign for shot in manifest.patterns.captures):
        negative = own.array("data_negative", shape)
        stacks = {1: data + negative, -1: negative}
    return lambda shot: stacks[shot.sign][:, :, shot.row, shot.column]


def _digital(values: npt.NDArray[Any], kind: Any, name: str, path: Path) -> Channel:
    """Digital numbers (rows, columns) as a frame holds them, exactly."""
    with np.errstate(invalid="ignore"):
        digital = np.asarray(values).astype(kind)
    if not np.array_equal(digital.astype(np.float64), values):
        raise MitsimError(f"{path}: {name} has numbers that are no {np.dtype(kind).name}; export it again")
    return as_channel(digital, name, path)


def _truth_in(own: MatFile) -> tuple[Channels, Metadata]:
    """Channels (n, n') and metadata of the truth; MitsimError where it is no image."""
    channels = {"reflectance": own.image("truth")}
    if "truth_standard_error" in own:
        own.array("truth_standard_error", channels["reflectance"].shape)
        channels["standard_error"] = own.image("truth_standard_error")
    board = math.nan
    if "truth_board_reflectance" in own:
        board = float(own.array("truth_board_reflectance", (1,))[0])
    return channels, {} if math.isnan(board) else {"board_reflectance": board}


def _calibration_in(
    file: MatFile, held: Mapping[str, Packed[CalibrationManifest] | None], run: Run
) -> Calibration | None:
    """The calibration in a ``file`` of a ``run``, whose lines' are ``held``; None where it holds none."""
    parts = {name: part for name, part in held.items() if part is not None}
    if not run.colours:
        return Content(parts) if parts else None
    if _CALIBRATED not in file:
        return None
    text = file.text(_CALIBRATED)
    colours = unpack_colours(text, CALIBRATION, file.path)
    if {*parts} != {*colours.names}:
        raise MitsimError(f"{file.path}: has calibrations of {', '.join(parts)}, not of {', '.join(colours.names)}")
    return Content(parts, colours, text)


def _calibration_part(own: MatFile, digital: Digital) -> Packed[CalibrationManifest] | None:
    """The calibration of the variables ``own``, where there is one, of a run whose frames are read as ``digital`` says,
    and whose unit `phi_left` and `phi_right` have."""
    if "calibration_manifest" not in own:
        return None
    text = own.text("calibration_manifest")
    manifest = unpack(text, CalibrationManifest, own.path)
    metadata: Metadata = {"unit": "sqrt(e-/s)"}
    if manifest.board_reflectance is not None:
        metadata = {**metadata, "reflectance": manifest.board_reflectance}
    root = math.sqrt(_dn_per_rate(digital))

    def read(name: str) -> tuple[Channels, Metadata]:
        return {"factor": own.image(f"phi_{Path(name).stem}", root)}, metadata

    return Packed(manifest, text, FACTORS, read, own.path)


def flatcam_calibration(path: Path, channel: str) -> Calibration:
    """The factors of one plane of a real FlatCam, or of all, from its calibration file.

    Parameters
    ----------
    path
        of the file, with `P1*` and `Q1*`.
    channel
        one of :data:`mitsim.core.imagelist.PLANES`, or `all`.

    Returns
    -------
    Content
        a calibration for frames of that plane, of all planes a coloured one. Its manifests' configuration holds the
        angle by which the frames are turned first.

    Raises
    ------
    MitsimError
        for a file without that plane, and for one whose rows and columns are exchanged.
    """
    check_channel(channel)
    file = MatFile(path, {"angle": [[0.0]], **variables_in(path)})
    angle = float(file.matrix("angle")[0, 0])
    size = tuple(map(int, file.matrix("cSize").ravel())) if "cSize" in file else ()

    def part(plane: str) -> Packed[CalibrationManifest]:
        """Of one plane."""
        sides = {name: file.image(f"{stem}{plane}") for name, stem in zip(FACTORS, ("P1", "Q1"), strict=True)}
        pixels, scene = zip(*(side.shape for side in sides.values()), strict=True)
        if size != pixels and all(map(operator.lt, pixels, scene)):
            raise MitsimError(
                f"{path}: P1{plane} and Q1{plane} have {pixels[0]} and {pixels[1]} pixels for {scene[0]} and "
                f"{scene[1]} of the scene: rows and columns are exchanged; a file of version 7.3 holds columns first"
            )
        manifest = CalibrationManifest(
            camera={"name": path.stem, "channel": plane},
            centre=True,
            configuration={TURNED: angle} if angle else {},
        )
        return Packed(manifest, "", FACTORS, lambda name: ({"factor": sides[name]}, {}), path)

    if channel != ALL:
        return Content({"": part(channel)})
    colours = lines_of_planes(CALIBRATION, WAVELENGTHS_NM)
    text = json.dumps(colours.model_dump(mode="json"))
    return Content({name: part(name) for name in colours.names}, colours, text)
