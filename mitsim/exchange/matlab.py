"""A run in one MATLAB file with the variables of the paper's public script: folders in, the file out, and back.

`phi_left` (P o X) `phi_right`' = `data_coded` - `measBg` in digital numbers, for each pattern P = PL(:, i) PR(:, j)'
(Zheng & Asif, arXiv 2111.12862, section III-B). Files are of version 5, which SciPy, GNU Octave and every MATLAB read.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.colours import CALIBRATION, RUN
from mitsim.core.errors import MitsimError, cut
from mitsim.core.framefile import Channel, Channels, Metadata
from mitsim.core.manifests import SIDES, CalibrationManifest, Digital, RunManifest, ShotFile
from mitsim.core.output import whole_file
from mitsim.core.plainfile import check_plain
from mitsim.core.recorders import TRUTH
from mitsim.exchange.coloured import Coloured, Filtered, line_of, unpacked_colours, unpacked_filters
from mitsim.exchange.packed import FACTORS, Packed, checked_channel, manifest_text, shots_of, unpacked, unpacked_run

Variables = Mapping[str, Any]
LARGEST_VARIABLE = (1 << 31) - 1
"""Bytes of an array in a file of version 5."""
COLOURED, FILTERED, _CALIBRATED = "colour_run", "mosaic_run", "colour_calibration"
"""Variables that hold the colour.json of a coloured run, of one behind colour filters, and of a calibration."""
_LONGEST_LINE = 31
"""Letters of a line's name: a variable of MATLAB has 63 at most, truth_board_reflectance_ half of them."""
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


def lines_in(
    variables: Variables,
    folders_in: Callable[[str, Variables], tuple[Packed[RunManifest], Packed[CalibrationManifest] | None]],
    path: Path,
) -> tuple[Coloured[RunManifest], Coloured[CalibrationManifest] | None]:
    """Coloured run and calibration in a file.

    Parameters
    ----------
    variables
        of the file.
    folders_in
        from a line's name and the variables that end in it, without that ending, to its run and calibration.
    path
        of the file, for messages.

    Raises
    ------
    MitsimError
        for a line that is missing, and as ``folders_in``.
    """
    text = text_in(variables, COLOURED, path)
    colours = unpacked_colours(text, RUN, path)
    held = {name: folders_in(name, own) for name, own in _by_line(variables, colours.names, path).items()}
    run = Coloured(colours, text, {name: shots for name, (shots, _) in held.items()})
    return run, _calibrations_in(variables, {name: calibration for name, (_, calibration) in held.items()}, path)


def _filtered_in(variables: Variables, path: Path) -> tuple[Filtered, Coloured[CalibrationManifest] | None]:
    text, (shots, _) = text_in(variables, FILTERED, path), _folders_in(variables, path)
    colours = unpacked_filters(text, shots, path)
    lines = _by_line(variables, colours.names, path)
    truths = {name: truth_in(own, path) for name, own in lines.items() if "truth" in own}
    digital = shots.manifest.digital
    calibrations = {name: calibration_in(own, digital, path) for name, own in lines.items()}
    return Filtered(colours, text, shots, truths), _calibrations_in(variables, calibrations, path)


def _calibrations_in(
    variables: Variables, held: Mapping[str, Packed[CalibrationManifest] | None], path: Path
) -> Coloured[CalibrationManifest] | None:
    """The coloured calibration in a file; ``held`` is what is there of each line."""
    if _CALIBRATED not in variables:
        return None
    text = text_in(variables, _CALIBRATED, path)
    colours = unpacked_colours(text, CALIBRATION, path)
    lines = {name: calibration for name, calibration in held.items() if calibration is not None}
    if {*lines} != {*colours.names}:
        raise MitsimError(f"{path}: has calibrations of {', '.join(lines)}, not of {', '.join(colours.names)}")
    return Coloured(colours, text, lines)


def _by_line(variables: Variables, names: Sequence[str], path: Path) -> dict[str, dict[str, Any]]:
    """Variables of each line by its name, without their ending."""
    return {
        name: {key.removesuffix(end): values for key, values in variables.items() if key.endswith(end)}
        for name, end in endings(names, path).items()
    }


def colours_in(
    run: Coloured[RunManifest] | Filtered, calibration: Coloured[CalibrationManifest] | None
) -> dict[str, Any]:
    """Variables that say of which lines a file is: the colour.json of ``run`` and ``calibration``."""
    variables = {FILTERED if isinstance(run, Filtered) else COLOURED: run.text}
    return variables if calibration is None else {**variables, _CALIBRATED: calibration.text}


def endings(names: Sequence[str], path: Path) -> dict[str, str]:
    """What variables of each line end in, by the line's name: of letters, digits and _, as MATLAB wants it.

    Parameters
    ----------
    names
        of the lines.
    path
        of the file, for messages.

    Raises
    ------
    MitsimError
        for a name that no variable can end in, or two that are the same to MATLAB.
    """
    ends = {name: "_" + re.sub(r"[^0-9A-Za-z_]", "_", name) for name in names}
    for name in names:
        # Beginning with a digit, they are no end of another variable: truth_standard_error is not of a line `error`.
        if not (name[0].isdigit() and len(name) <= _LONGEST_LINE) or [*ends.values()].count(ends[name]) > 1:
            raise MitsimError(
                f"{path}: a line is called {cut(name)}, which no variable of MATLAB can end in; use the format hdf5"
            )
    return ends


def _variables(run: Packed[RunManifest], calibration: Packed[CalibrationManifest] | None) -> dict[str, Any]:
    variables = _frames(run)
    return {**variables, **of_folders(run, calibration)}


def _folders_in(variables: Variables, path: Path) -> tuple[Packed[RunManifest], Packed[CalibrationManifest] | None]:
    manifest = unpacked_run(text_in(variables, "run_manifest", path), path)
    return _run(variables, manifest, path), calibration_in(variables, manifest.digital, path)


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
        channels["standard_error"] = _image_in(variables, "truth_standard_error", path)
    board = float(np.asarray(variables.get("truth_board_reflectance", math.nan)).item())
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


def write_variables(path: Path, variables: Variables) -> None:
    """Write ``variables`` to a MATLAB file at ``path``, whole or not at all.

    MitsimError for an array that is larger than such files hold.
    """
    from scipy.io import savemat

    for name, values in variables.items():
        if getattr(values, "nbytes", 0) > LARGEST_VARIABLE:
            raise MitsimError(
                f"{path}: {name} takes {values.nbytes / 2**30:.3g} GiB, and MATLAB files of version 5 hold 2; "
                "use the format hdf5"
            )
    # A descriptor: given a name, savemat puts .mat behind it.
    with whole_file(path) as part, part.open("wb") as file:
        savemat(file, dict(variables), do_compression=True, long_field_names=True)


def names_in(path: Path) -> frozenset[str]:
    """Names of the variables in the MATLAB file ``path``; MitsimError as for :func:`read_variables`."""
    from scipy.io import whosmat

    return frozenset(name for name, *_ in _looked_into(path, whosmat))


def read_variables(path: Path) -> dict[str, Any]:
    """The variables of the MATLAB file ``path``.

    MitsimError for a file that is missing, damaged or of version 7.3.
    """
    from scipy.io import loadmat

    return dict(_looked_into(path, loadmat))


def _looked_into(path: Path, look: Callable[..., Any]) -> Any:
    check_plain(path)
    try:
        with open(path, "rb") as file:
            return look(file)
    except NotImplementedError:
        raise MitsimError(f"{path}: is of version 7.3; save it in MATLAB with -v7") from None
    except Exception as error:  # SciPy's reader raises of all kinds
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MitsimError(f"{path}: damaged, or no MATLAB file ({reason}); write or copy it again") from error


def text_in(variables: Variables, name: str, path: Path) -> str:
    """A text of a file.

    Parameters
    ----------
    variables
        of the file.
    name
        of the one that is wanted.
    path
        of the file, for messages.

    Raises
    ------
    MitsimError
        where there is none.
    """
    value = np.asarray(variables.get(name))
    if value.dtype.kind != "U" or value.size != 1:
        raise MitsimError(
            f"{path}: has no text {name}, so it is not of `mitsim export`; it holds "
            f"{', '.join(key for key in variables if not key.startswith('__'))}"
        )
    return str(value.item())


def array_in(variables: Variables, name: str, shape: tuple[int, ...], path: Path) -> npt.NDArray[Any]:
    """An array of a file.

    Parameters
    ----------
    variables
        of the file.
    name, shape
        of the one that is wanted; MATLAB drops axes of length 1 at the end.
    path
        of the file, for messages.

    Raises
    ------
    MitsimError
        where it is missing, or not of real numbers in that shape.
    """
    array = np.asarray(variables.get(name))
    if array.dtype.kind not in "uif" or array.size != math.prod(shape):
        told = f"is {array.dtype} of shape {array.shape}" if name in variables else "is missing"
        raise MitsimError(f"{path}: {name} {told}; numbers of shape {shape} are needed")
    return array.reshape(shape, order="F")


def matrix_in(variables: Variables, name: str, path: Path) -> FloatArray:
    """A matrix of a file, of any size.

    Parameters
    ----------
    variables
        of the file.
    name
        of the one that is wanted.
    path
        of the file, for messages.

    Raises
    ------
    MitsimError
        where it is missing, or no matrix of real numbers.
    """
    matrix = np.asarray(variables.get(name))
    if matrix.ndim != 2 or matrix.dtype.kind not in "uif":
        raise MitsimError(
            f"{path}: {name} is {'no matrix of numbers' if name in variables else 'missing'}; write it again"
        )
    return matrix.astype(np.float64)


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
