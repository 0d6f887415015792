"""A run in one MATLAB file with the variables of the paper's public script: folders in, the file out, and back.

`phi_left` (P o X) `phi_right`' = `data_coded` - `measBg` in digital numbers, for each pattern P = PL(:, i) PR(:, j)'
(Zheng & Asif, arXiv 2111.12862, section III-B). Files are of version 5, which SciPy, GNU Octave and every MATLAB read.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.manifests import CalibrationManifest, RunManifest, ShotFile
from mitsim.exchange.coloured import Coloured, Filtered, line_of, unpacked_filters
from mitsim.exchange.matlab_file import Variables, array_in, read_variables, text_in, write_variables
from mitsim.exchange.matlab_lines import FILTERED, by_line, calibrations_in, colours_in, endings, lines_in
from mitsim.exchange.matlab_variables import (
    calibration_in,
    calibration_variables,
    dn_per_rate,
    of_folders,
    run_in,
    truth_in,
    truth_variables,
)
from mitsim.exchange.packed import Packed, shots_of, unpacked_run

ELECTRONS = "expected electrons of the frames"
"""What such a file does not hold of a simulated run."""


def write_matlab(path: Path, run: Packed[RunManifest], calibration: Packed[CalibrationManifest] | None) -> None:
    """Write a run with the paper's variables, whole or not at all.

    Parameters
    ----------
    path
        of the file.
    run
        of whole shots, or of signed pairs.
    calibration
        that goes with it; without one `phi_left` and `phi_right` are left out.

    Raises
    ------
    MitsimError
        for a run that mixes whole shots and pairs, or is larger than such a file may be.
    """
    write_variables(path, _variables(run, calibration))


def write_matlab_lines(
    path: Path, run: Coloured[RunManifest] | Filtered, calibration: Coloured[CalibrationManifest] | None
) -> None:
    """Write a run of several lines with the paper's variables, those of a line ending in its name: `phi_left_638nm`.

    Parameters
    ----------
    path
        of the file.
    run
        with lines called as `mitsim capture` calls them. Behind colour filters the frames are those of all lines, and
        only the truths and factors of each line end in its name; `weights` is (4, lines) of what each filter passes.
    calibration
        of the same lines; without one `phi_left_638nm` and so on are left out.

    Raises
    ------
    MitsimError
        for lines whose names cannot end one of a variable, and as for :func:`write_matlab`.
    """
    ends, variables = endings(run.colours.names, path), colours_in(run, calibration)
    if isinstance(run, Filtered):
        variables.update({**_variables(run.shots, None), "weights": np.array(run.colours.weights)})
    for name, end in ends.items():
        if isinstance(run, Filtered):
            held = truth_variables(*run.truths[name]) if name in run.truths else {}
            held.update(calibration_variables(line_of(calibration, name), run.shots.manifest.digital))
        else:
            held = _variables(run.lines[name], line_of(calibration, name))
        variables.update({f"{key}{end}": values for key, values in held.items()})
    write_variables(path, variables)


def read_matlab(path: Path) -> tuple[Packed[RunManifest], Packed[CalibrationManifest] | None]:
    """Run and calibration in the file ``path`` of :func:`write_matlab`.

    MitsimError for a file that is none, or is damaged.
    """
    return _folders_in(read_variables(path), path)


def read_matlab_lines(path: Path) -> tuple[Coloured[RunManifest] | Filtered, Coloured[CalibrationManifest] | None]:
    """Run and calibration in the file ``path`` of :func:`write_matlab_lines`.

    MitsimError for a file that is none, or is damaged.
    """
    variables = read_variables(path)
    if FILTERED in variables:
        return _filtered_in(variables, path)
    return lines_in(variables, lambda name, own: _folders_in(own, path), path)


def _filtered_in(variables: Variables, path: Path) -> tuple[Filtered, Coloured[CalibrationManifest] | None]:
    text, (shots, _) = text_in(variables, FILTERED, path), _folders_in(variables, path)
    colours = unpacked_filters(text, shots, path)
    lines = by_line(variables, colours.names, path)
    truths = {name: truth_in(own, path) for name, own in lines.items() if "truth" in own}
    digital = shots.manifest.digital
    calibrations = {name: calibration_in(own, digital, path) for name, own in lines.items()}
    return Filtered(colours, text, shots, truths), calibrations_in(variables, calibrations, path)


def _variables(run: Packed[RunManifest], calibration: Packed[CalibrationManifest] | None) -> dict[str, Any]:
    variables = _frames(run)
    return {**variables, **of_folders(run, calibration)}


def _folders_in(variables: Variables, path: Path) -> tuple[Packed[RunManifest], Packed[CalibrationManifest] | None]:
    manifest = unpacked_run(text_in(variables, "run_manifest", path), path)
    return _run(variables, manifest, path), calibration_in(variables, manifest.digital, path)


def _frames(run: Packed[RunManifest]) -> dict[str, Any]:
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
    return np.full(shape, digital.black_level_dn + digital.dark_current_e_per_s * dn_per_rate(digital))


def _run(variables: Variables, manifest: RunManifest, path: Path) -> Packed[RunManifest]:
    """The run whose frames are `data_coded`."""
    left, right = manifest.patterns.matrices
    found = np.asarray(variables.get("data_coded"))
    if found.ndim < 2:
        raise MitsimError(f"{path}: data_coded is missing; export it again")
    shape = *found.shape[:2], left.shape[1], right.shape[1]
    data = array_in(variables, "data_coded", shape, path)
    if any(shot.sign for shot in manifest.patterns.captures):
        negative = array_in(variables, "data_negative", shape, path)
        stacks = {1: data + negative, -1: negative}
    else:
        stacks = {0: data}

    def frame(shot: ShotFile) -> npt.NDArray[Any]:
        """The frame of a ``shot``, (rows, columns)."""
        return np.asarray(stacks[shot.sign][:, :, shot.row, shot.column])

    return run_in(variables, manifest, frame, path)
