"""A run and its calibration in one MATLAB file with FlatCam's variables: folders in, the file out, and back.

FlatCam (Asif et al. 2017, arXiv 1509.00116) has a colour sensor and calibrates each of its four planes: a plane of a
frame, less the means of its rows and columns, is P1 X Q1^T. The loader of https://github.com/tanjasper/flatcam takes
plane b from row 0 and column 0 on, every second one, gb from (0, 1), gr from (1, 0), r from (1, 1). A monochrome frame
has the same four planes, whose factors are every second row of both. A coloured run has a whole frame of each line: it
is a plane of a frame of twice the rows and columns, so that nothing is left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.exr import Channels, Metadata
from mitsim.core.manifests import CalibrationManifest, RunManifest, ShotFile
from mitsim.core.spectral_manifests import RUN, ColourManifest
from mitsim.exchange import matlab
from mitsim.exchange.matlab import Variables
from mitsim.exchange.packed import (
    FACTORS,
    Calibration,
    Coloured,
    Loaded,
    Packed,
    Run,
    as_channel,
    line_of,
    shots_of,
    unpack_colours,
    unpack_run,
)
from mitsim.exchange.real_capture import PLANES, check_channel

_COLOURS = (("r",), ("gr", "gb"), ("b",))
"""Planes of each colour, the longest wavelength first. Either green plane has the whole frame."""


def write_flatcam(path: Path, run: Run, calibration: Calibration) -> tuple[str, ...]:
    """Write a run with FlatCam's variables, whole or not at all; returns a sentence on what is left out.

    Parameters
    ----------
    path
        of the file.
    run
        with frames of an even number of rows and columns; or of three lines, of which the longest is taken for red and
        the shortest for blue, and each plane is the whole frame of a line.
    calibration
        that goes with it, of the same lines.

    Raises
    ------
    MitsimError
        for other frames or lines, lines that differ in the number or size of their frames, and more frames than such a
        file holds.
    """
    own = line_of(calibration, "") if isinstance(run, Packed) else None
    if isinstance(run, Packed) and own is not None:
        variables = _of_one(run, own)
    elif isinstance(run, Coloured) and isinstance(calibration, Coloured):
        variables = _of_lines(path, run, calibration)
    else:
        raise AssertionError  # formats.export_run takes no others
    matlab.write_variables(path, variables)
    return (f"Left out: {matlab.ELECTRONS}",)


def _of_one(run: Packed[RunManifest], calibration: Packed[CalibrationManifest]) -> dict[str, Any]:
    left, right = matlab.factors_in_dn(calibration, matlab.dn_per_rate(run.manifest.digital)).values()
    if len(left) % 2 or len(right) % 2:
        size = f"{len(left)}x{len(right)}"
        raise MitsimError(f"{run.place}: frames are {size}; FlatCam's four planes need even sides, use mat")
    meas = np.empty((len(left), len(right), len(run.manifest.patterns.captures)), order="F")
    kind = _fill(meas, run)
    factors = {name: (left[row::2], right[column::2]) for name, (row, column) in PLANES.items()}
    return {"meas": meas, "dn_class": kind, **_planes(factors), **matlab.of_folders(run, calibration)}


def _of_lines(path: Path, run: Coloured[RunManifest], calibration: Coloured[CalibrationManifest]) -> dict[str, Any]:
    ends, planes = matlab.endings(run.colours.names, path), _lines_of_planes(run.colours, path)
    counts = {name: len(run.lines[name].manifest.patterns.captures) for name in run.colours.names}
    if len({*counts.values()}) > 1:
        reported = ", ".join(f"{count} of {name}" for name, count in counts.items())
        raise MitsimError(f"{path}: frames are {reported}, but FlatCam's planes are of one frame; use mat")
    sides, variables = {}, matlab.colours_in(run, calibration)
    for name, shots in run.lines.items():
        sides[name] = tuple(
            matlab.factors_in_dn(calibration.lines[name], matlab.dn_per_rate(shots.manifest.digital)).values()
        )
    rows, columns = (len(side) for side in sides[planes["r"]])
    meas = np.empty((2 * rows, 2 * columns, counts[planes["r"]]), order="F")
    for plane, name in planes.items():
        row, column = PLANES[plane]
        kind = _fill(meas[row::2, column::2], run.lines[name])
        own = {"dn_class": kind, **matlab.of_folders(run.lines[name], calibration.lines[name])}
        variables.update({f"{key}{ends[name]}": values for key, values in own.items()})
    return {**variables, "meas": meas, **_planes({plane: sides[planes[plane]] for plane in PLANES})}


@contextmanager
def load_mat(path: Path, channel: str | None) -> Iterator[Loaded]:
    """Run and calibration in a MATLAB file of `mitsim export`, with the paper's variables or FlatCam's.

    Parameters
    ----------
    path
        of the file.
    channel
        the file is the calibration of a real FlatCam, of which this plane is taken.

    Raises
    ------
    MitsimError
        for a file that is none of these, or is damaged.
    """
    if channel is not None:
        yield Loaded(None, flatcam_calibration(path, channel))
        return
    variables = matlab.read_variables(path)
    if "meas" not in variables:
        run, calibration = matlab.folders_of(variables, path)
    elif matlab.COLOURED not in variables:
        run, calibration = _folders_in(variables, _meas_in(variables, path), path)
    else:
        meas = _meas_in(variables, path)
        colours = unpack_colours(matlab.text_in(variables, matlab.COLOURED, path), RUN, path)
        planes = {name: plane for plane, name in _lines_of_planes(colours, path).items()}

        def folders_in(name: str, own: Variables) -> tuple[Packed[RunManifest], Packed[CalibrationManifest] | None]:
            """Run and calibration of the line ``name``, whose other variables are its ``own``."""
            row, column = PLANES[planes[name]]
            return _folders_in(own, meas[row::2, column::2], path)

        run, calibration = matlab.lines_in(variables, folders_in, path)
    yield Loaded(run, calibration, (matlab.ELECTRONS,))


def flatcam_calibration(path: Path, channel: str) -> Packed[CalibrationManifest]:
    """The factors of one plane of a real FlatCam, from its calibration file.

    Parameters
    ----------
    path
        of the file, with `P1*` and `Q1*`.
    channel
        a key of :data:`mitsim.exchange.real_capture.PLANES`.

    Returns
    -------
    Packed
        a calibration for frames of that plane; flagged where the frames must be turned first.

    Raises
    ------
    MitsimError
        for a file without that plane.
    """
    check_channel(channel)
    variables = matlab.read_variables(path)
    found = {name: f"{stem}{channel}" for name, stem in zip(FACTORS, ("P1", "Q1"), strict=True)}
    sides = {
        name: as_channel(matlab.matrix_in(variables, variable, path).astype(np.float32), variable, path)
        for name, variable in found.items()
    }
    angle = float(matlab.matrix_in({"angle": [[0.0]], **variables}, "angle", path)[0, 0])
    warnings = (
        (f"its frames were turned by {angle:g} degrees, and import turns none: turn them before, or shifts remain",)
        if angle
        else ()
    )
    manifest = CalibrationManifest(camera={"name": path.stem, "channel": channel}, centre=True, warnings=warnings)

    def read(name: str) -> tuple[Channels, Metadata]:
        return {"factor": sides[name]}, {}

    return Packed(manifest, "", FACTORS, read, path)


def _centre(factor: FloatArray) -> FloatArray:
    """A ``factor`` (pixels, n) of frames that lose the means of their rows and columns."""
    return np.asarray(factor - factor.mean(axis=0))


def _lines_of_planes(colours: ColourManifest, path: Path) -> dict[str, str]:
    """Name of the line that each plane is of."""
    if len(colours.names) != len(_COLOURS):
        raise MitsimError(
            f"{path}: lines are {', '.join(colours.names)}; FlatCam has red, green and blue, so use mat, or export the "
            "folder of a line"
        )
    by_length = sorted(colours.channels, key=lambda line: -line.wavelength_nm)
    return {plane: line.name for line, planes in zip(by_length, _COLOURS, strict=True) for plane in planes}


def _fill(meas: npt.NDArray[Any], run: Packed[RunManifest]) -> str:
    """Put a run's frames into ``meas`` (rows, columns, shots); returns the type of their numbers."""
    for index, (shot, channels, _) in enumerate(shots_of(run)):
        if channels["DN"].shape != meas.shape[:2]:
            rows, columns = meas.shape[:2]
            raise MitsimError(f"{run.place / shot.file}: is not {rows}x{columns}, as the calibration; calibrate again")
        meas[:, :, index] = channels["DN"]
    return channels["DN"].dtype.name


def _meas_in(variables: Variables, path: Path) -> npt.NDArray[Any]:
    meas = np.asarray(variables["meas"])
    if meas.ndim < 2:
        raise MitsimError(f"{path}: meas is {meas.dtype} of shape {meas.shape}, and no frames; export it again")
    return meas


def _planes(factors: Mapping[str, tuple[FloatArray, ...]]) -> dict[str, Any]:
    """FlatCam's variables of the left and right ``factors`` of each plane."""
    variables: dict[str, Any] = {"angle": 0.0}
    for plane, (left, right) in factors.items():
        variables["cSize"] = np.array([[len(left), len(right)]], float)
        variables.update({f"P1{plane}": _centre(left), f"Q1{plane}": _centre(right)})
    return variables


def _folders_in(
    variables: Variables, meas: npt.NDArray[Any], path: Path
) -> tuple[Packed[RunManifest], Packed[CalibrationManifest] | None]:
    """Run and calibration of whose frames ``meas`` is."""
    manifest = unpack_run(matlab.text_in(variables, "run_manifest", path), path)
    captures = manifest.patterns.captures
    frames = matlab.array_in({"meas": meas}, "meas", (*meas.shape[:2], len(captures)), path)
    index = {shot.file: number for number, shot in enumerate(captures)}

    def frame(shot: ShotFile) -> Any:
        """The frame of a ``shot``, (rows, columns)."""
        return frames[:, :, index[shot.file]]

    return matlab.run_in(variables, manifest, frame, path), matlab.calibration_in(variables, manifest.digital, path)
