"""A run and its calibration in one MATLAB file with FlatCam's variables: folders in, the file out, and back.

FlatCam (Asif et al. 2017, arXiv 1509.00116) has a colour sensor and calibrates each of its four planes: a plane of a
frame, less the means of its rows and columns, is P1 X Q1^T. The loader of https://github.com/tanjasper/flatcam takes
plane b from row 0 and column 0 on, every second one, gb from (0, 1), gr from (1, 0), r from (1, 1). A monochrome frame
has the same four planes, whose factors are every second row of both.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.framefile import Channels, Metadata
from mitsim.core.manifests import SIDES, CalibrationManifest, RunManifest, ShotFile
from mitsim.exchange.matlab import (
    array_in,
    calibration_in,
    dn_per_rate,
    factors_in_dn,
    matrix_in,
    of_folders,
    read_variables,
    run_in,
    text_in,
    write_variables,
)
from mitsim.exchange.packed import FACTORS, Packed, checked_channel, shots_of, unpacked_run
from mitsim.exchange.planes import PLANES, check_channel


def write_flatcam(path: Path, run: Packed[RunManifest], calibration: Packed[CalibrationManifest]) -> None:
    """Write a run with FlatCam's variables, whole or not at all.

    Parameters
    ----------
    path
        of the file.
    run
        with frames of an even number of rows and columns.
    calibration
        that goes with it.

    Raises
    ------
    MitsimError
        for other frames, or more of them than such a file holds.
    """
    factors = factors_in_dn(calibration, dn_per_rate(run.manifest.digital))
    rows, columns = (len(factors[side]) for side in SIDES)
    if rows % 2 or columns % 2:
        raise MitsimError(f"{run.place}: frames are {rows}x{columns}; FlatCam's four planes need even sides, use mat")
    count = len(run.manifest.patterns.captures)
    meas = np.empty((rows, columns, count), order="F")
    for index, (shot, channels, _) in enumerate(shots_of(run)):
        if channels["DN"].shape != (rows, columns):
            raise MitsimError(f"{run.place / shot.file}: is not {rows}x{columns}, as the calibration; calibrate again")
        meas[:, :, index] = channels["DN"]
    variables: dict[str, Any] = {"meas": meas, "dn_class": channels["DN"].dtype.name}
    variables["cSize"], variables["angle"] = np.array([[rows // 2, columns // 2]], float), 0.0
    for name, (row, column) in PLANES.items():
        variables[f"P1{name}"] = _centred(factors["left"][row::2])
        variables[f"Q1{name}"] = _centred(factors["right"][column::2])
    exact = {f"phi_{side}": factor for side, factor in factors.items()}
    left, right = run.manifest.patterns.matrices
    write_variables(path, {**variables, **exact, "PL": left, "PR": right, **of_folders(run, calibration)})


def read_flatcam(path: Path) -> tuple[Packed[RunManifest], Packed[CalibrationManifest] | None]:
    """Run and calibration in the file ``path`` of :func:`write_flatcam`.

    MitsimError for a file that is none, or is damaged.
    """
    variables = read_variables(path)
    manifest = unpacked_run(text_in(variables, "run_manifest", path), path)
    captures = manifest.patterns.captures
    shape = np.asarray(variables.get("meas")).shape[:2]
    meas = array_in(variables, "meas", (*shape, len(captures)), path)
    index = {shot.file: number for number, shot in enumerate(captures)}

    def frame(shot: ShotFile) -> Any:
        """The frame of a ``shot``, (rows, columns)."""
        return meas[:, :, index[shot.file]]

    return run_in(variables, manifest, frame, path), calibration_in(variables, manifest.digital, path)


def flatcam_calibration(path: Path, channel: str) -> Packed[CalibrationManifest]:
    """The factors of one plane of a real FlatCam, from its calibration file.

    Parameters
    ----------
    path
        of the file, with `P1*` and `Q1*`.
    channel
        a key of :data:`mitsim.exchange.planes.PLANES`.

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
    variables = read_variables(path)
    found = {name: f"{stem}{channel}" for name, stem in zip(FACTORS, ("P1", "Q1"), strict=True)}
    sides = {
        name: checked_channel(matrix_in(variables, variable, path).astype(np.float32), variable, path)
        for name, variable in found.items()
    }
    angle = float(matrix_in({"angle": [[0.0]], **variables}, "angle", path)[0, 0])
    warnings = (
        (f"its frames were turned by {angle:g} degrees, and import turns none: turn them before, or shifts remain",)
        if angle
        else ()
    )
    manifest = CalibrationManifest(camera={"name": path.stem, "channel": channel}, centre=True, warnings=warnings)

    def read(name: str) -> tuple[Channels, Metadata]:
        return {"factor": sides[name]}, {}

    return Packed(manifest, "", FACTORS, read, path)


def _centred(factor: FloatArray) -> FloatArray:
    """A ``factor`` (pixels, n) of frames that lose the means of their rows and columns."""
    return np.asarray(factor - factor.mean(axis=0))
