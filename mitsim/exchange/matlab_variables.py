"""A run and its calibration in; variables that MATLAB files of every kind hold of them out, and back: manifests,
patterns, factors, truth and ambient frame.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.framefile import Channel, Channels, Metadata
from mitsim.core.manifests import SIDES, CalibrationManifest, Digital, RunManifest
from mitsim.core.recorders import TRUTH
from mitsim.exchange.matlab_file import Variables, array_in, matrix_in, text_in
from mitsim.exchange.packed import FACTORS, Packed, checked_channel, manifest_text, unpacked


def of_folders(run: Packed[RunManifest], calibration: Packed[CalibrationManifest] | None) -> dict[str, Any]:
    """Variables of every MATLAB file: manifests, patterns, factors, truth and ambient frame.

    Parameters
    ----------
    run, calibration
        that are exported.
    """
    variables: dict[str, Any] = {"run_manifest": manifest_text(run.manifest, run.text)}
    variables["PL"], variables["PR"] = run.manifest.patterns.matrices
    variables.update(calibration_variables(calibration, run.manifest.digital))
    ambient = run.manifest.ambient_frame
    if ambient is not None:
        variables["ambient"] = run.read(ambient.file)[0]["DN"]
    return {**variables, **truth_variables(*run.read(TRUTH))} if TRUTH in run.names else variables


def calibration_variables(calibration: Packed[CalibrationManifest] | None, digital: Digital) -> dict[str, Any]:
    """Factors (pixels, n) [sqrt(DN)] and manifest of a ``calibration``, for frames that are read as ``digital`` says;
    none without one."""
    if calibration is None:
        return {}
    factors = factors_in_dn(calibration, dn_per_rate(digital))
    variables: dict[str, Any] = {f"phi_{side}": factor for side, factor in factors.items()}
    return {**variables, "calibration_manifest": manifest_text(calibration.manifest, calibration.text)}


def truth_variables(channels: Channels, metadata: Metadata) -> dict[str, Any]:
    """A truth, of the ``channels`` (n, n') and ``metadata`` of its file."""
    variables: dict[str, Any] = {"truth": channels["reflectance"]}
    variables["truth_board_reflectance"] = float(metadata.get("board_reflectance", math.nan))
    if "standard_error" in channels:
        variables["truth_standard_error"] = channels["standard_error"]
    return variables


def truth_in(variables: Variables, path: Path) -> tuple[Channels, Metadata]:
    """Channels (n, n') and metadata of the truth in a file.

    Parameters
    ----------
    variables
        of the file, a truth among them.
    path
        of the file, for messages.

    Raises
    ------
    MitsimError
        where it is no image.
    """
    channels = {"reflectance": _image_in(variables, "truth", path)}
    if "truth_standard_error" in variables:
        array_in(variables, "truth_standard_error", channels["reflectance"].shape, path)
        channels["standard_error"] = _image_in(variables, "truth_standard_error", path)
    board = math.nan
    if "truth_board_reflectance" in variables:
        board = float(array_in(variables, "truth_board_reflectance", (1,), path)[0])
    return channels, {} if math.isnan(board) else {"board_reflectance": board}


def _image_in(variables: Variables, name: str, path: Path) -> Channel:
    """The image called ``name``, (rows, columns) float32."""
    return checked_channel(matrix_in(variables, name, path).astype(np.float32), name, path)


def dn_per_rate(digital: Digital) -> float:
    """Digital numbers of a photoelectron a second, in frames that are read as ``digital`` says."""
    return digital.gain_dn_per_e * digital.exposure_s


def factors_in_dn(calibration: Packed[CalibrationManifest], scale: float) -> dict[str, FloatArray]:
    """Both factors [sqrt(DN)] by side, (pixels, n).

    Parameters
    ----------
    calibration
        with factors [sqrt(electrons / s)].
    scale
        as of :func:`dn_per_rate`.
    """
    return {
        side: calibration.read(name)[0]["factor"].astype(np.float64) * math.sqrt(scale)
        for side, name in zip(SIDES, FACTORS, strict=True)
    }


def calibration_in(variables: Variables, digital: Digital, path: Path) -> Packed[CalibrationManifest] | None:
    """The calibration in a file; None where it holds none.

    Parameters
    ----------
    variables
        of the file.
    digital
        of the run in the file, whose unit `phi_left` and `phi_right` have.
    path
        of the file, for messages.

    Raises
    ------
    MitsimError
        for factors that are none.
    """
    if "calibration_manifest" not in variables:
        return None
    text = text_in(variables, "calibration_manifest", path)
    manifest = unpacked(text, CalibrationManifest, path)
    metadata: Metadata = {"unit": "sqrt(e-/s)"}
    if manifest.board_reflectance is not None:
        metadata = {**metadata, "reflectance": manifest.board_reflectance}

    def read(name: str) -> tuple[Channels, Metadata]:
        variable = f"phi_{Path(name).stem}"
        factor = matrix_in(variables, variable, path) / math.sqrt(dn_per_rate(digital))
        # Rounding in double precision is far below half of the last digit in single: the number is the first one.
        return {"factor": checked_channel(factor.astype(np.float32), variable, path)}, metadata

    return Packed(manifest, text, FACTORS, read, path)


def run_in(variables: Variables, manifest: RunManifest, frame: Any, path: Path) -> Packed[RunManifest]:
    """A run in a MATLAB file.

    Parameters
    ----------
    variables
        of the file.
    manifest
        of the run.
    frame
        from a shot to its digital numbers, (rows, columns).
    path
        of the file, for messages.
    """
    captures, ambient = manifest.patterns.captures, manifest.ambient_frame
    shots = {shot.file: shot for shot in captures}
    kind = np.float32 if text_in(variables, "dn_class", path) == "float32" else np.uint32

    def read(name: str) -> tuple[Channels, Metadata]:
        if name in shots:
            shot = shots[name]
            return {"DN": _digital(frame(shot), kind, name, path)}, {
                "row": shot.row,
                "column": shot.column,
                "sign": shot.sign,
                "exposure_s": manifest.digital.exposure_s,
            }
        if ambient is not None and name == ambient.file:
            known: Metadata = {"shots": ambient.shots, "exposure_s": manifest.digital.exposure_s}
            return {"DN": _image_in(variables, "ambient", path)}, known
        return truth_in(variables, path)

    names = (*shots, *([ambient.file] if ambient else ()), *((TRUTH,) if "truth" in variables else ()))
    return Packed(manifest, text_in(variables, "run_manifest", path), names, read, path)


def _digital(values: npt.NDArray[Any], kind: Any, name: str, path: Path) -> Channel:
    """Digital numbers (rows, columns) as a frame holds them, exactly."""
    with np.errstate(invalid="ignore"):
        digital = np.asarray(values).astype(kind)
    if not np.array_equal(digital.astype(np.float64), values):
        raise MitsimError(f"{path}: {name} has numbers that are no {np.dtype(kind).name}; export it again")
    return checked_channel(digital, name, path)
