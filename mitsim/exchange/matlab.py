"""A run in one MATLAB file with the variables of the paper's public script: folders in, the file out, and back.

`phi_left` (P o X) `phi_right`' = `data_coded` - `measBg` in digital numbers, for each pattern P = PL(:, i) PR(:, j)'
(Zheng & Asif, arXiv 2111.12862, section III-B). Files are of version 5, which SciPy, GNU Octave and every MATLAB read.
"""

from __future__ import annotations

import math
import os
import re
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError, cut
from mitsim.core.exr import Channel, Channels, Metadata
from mitsim.core.files import check_plain, whole_file
from mitsim.core.job import Cost, Limits
from mitsim.core.manifests import SIDES, CalibrationManifest, Digital, RunManifest, ShotFile
from mitsim.core.runs import TRUTH
from mitsim.core.spectral_manifests import CALIBRATION, RUN
from mitsim.exchange.packed import (
    FACTORS,
    Calibration,
    Coloured,
    Filtered,
    Packed,
    Run,
    as_channel,
    line_of,
    manifest_text,
    shots_of,
    unpack,
    unpack_colours,
    unpack_filters,
    unpack_run,
)

ELECTRONS = "expected electrons of the frames"
"""What such a file does not hold of a simulated run."""


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
    if isinstance(run, Packed):
        variables = _variables(run, line_of(calibration, ""))
    else:
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
    without = () if calibration else ("phi_left and phi_right are left out: no calibration was given",)
    return (*without, f"Left out: {ELECTRONS}")


def folders_of(variables: Variables, path: Path) -> tuple[Run, Calibration | None]:
    """Run and calibration in the ``variables`` of the file ``path`` of :func:`write_matlab`.

    MitsimError for a file that is none, or is damaged.
    """
    if FILTERED in variables:
        return _filtered_in(variables, path)
    if COLOURED in variables:
        return lines_in(variables, lambda name, own: _folders_in(own, path), path)
    return _folders_in(variables, path)


def _filtered_in(variables: Variables, path: Path) -> tuple[Filtered, Coloured[CalibrationManifest] | None]:
    text, (shots, _) = text_in(variables, FILTERED, path), _folders_in(variables, path)
    colours = unpack_filters(text, shots, path)
    lines = by_line(variables, colours.names, path)
    truths = {name: truth_in(own, path) for name, own in lines.items() if "truth" in own}
    digital = shots.manifest.digital
    calibrations = {name: calibration_in(own, digital, path) for name, own in lines.items()}
    return Filtered(colours, text, shots, truths), calibrations_in(variables, calibrations, path)


def _variables(run: Packed[RunManifest], calibration: Packed[CalibrationManifest] | None) -> dict[str, Any]:
    return {**_frames(run), **of_folders(run, calibration)}


def _folders_in(variables: Variables, path: Path) -> tuple[Packed[RunManifest], Packed[CalibrationManifest] | None]:
    manifest = unpack_run(text_in(variables, "run_manifest", path), path)
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


# -------- Arrays and texts by name in

Variables = Mapping[str, Any]
LARGEST_VARIABLE = (1 << 31) - 1
"""Bytes of an array in a file of version 5."""
_HEAD = 128
"""Bytes before the first variable: a text, the version and the order of bytes."""
_HDF5, _HDF5_MARK = 2, b"\x89HDF\r\n\x1a\n"
"""Version of a file that is an HDF5 file behind its head."""
_MATRIX, _COMPRESSED = 14, 15
"""Kinds of elements: an array, and one that is packed."""
_COMPLEX = 0x08
"""Bit of an array's flags: its numbers are complex."""
_BYTES_OF = {4: 4, 6: 8, 7: 4, 8: 1, 9: 1, 10: 2, 11: 2, 12: 4, 13: 4, 14: 8, 15: 8}
"""Bytes of a number that SciPy reads, by class: letters, double, single, whole numbers of 8 to 64 bits."""
_BEGINNING = 4096
"""Bytes of a variable that its flags, shape and name lie in; a name has 63 letters at most."""
_PADDING = 16
"""Bytes after a variable's shape and name that are no numbers: a tag, and what fills up to 8."""
_MOST_VARIABLES = 10_000
"""Of a file; a run in 16 colours has 200."""
_COPIES = 3
"""Arrays of a variable's size that are held at once: as stored, of its class, and as a run's."""


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


def read_variables(path: Path) -> dict[str, Any]:
    """The arrays of real numbers and the texts of the MATLAB file ``path``, by name; cells, structures and objects,
    which files of `mitsim export` and FlatCam have none of, are not looked into.

    MitsimError for a file that is missing, damaged, of version 7.3 or 4, or that takes more memory than is free.
    """
    from scipy.io import loadmat

    check_plain(path)
    try:
        with open(path, "rb") as file:
            arrays = _arrays_in(file)
            Cost(memory_bytes=_COPIES * sum(arrays.values())).check(f"{path}", Limits())
            file.seek(0)
            return dict(loadmat(file, variable_names=[*arrays]))
    except MitsimError:
        raise
    except NotImplementedError:
        raise MitsimError(f"{path}: is HDF5 (version 7.3); save it in MATLAB with -v7, or name an export .h5") from None
    except Exception as error:  # SciPy's reader raises of all kinds
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MitsimError(f"{path}: damaged, or no MATLAB file ({reason}); write or copy it again") from error


def _arrays_in(file: BinaryIO) -> dict[str, int]:
    """Bytes that each array of real numbers and each text of an open MATLAB ``file`` takes, by name.

    SciPy's readers allocate what a file claims, and call themselves for each cell within a cell until the process
    ends. Here no more than the beginning of each variable is unpacked, after "MAT-File Format" (MathWorks).
    """
    head = file.read(_HEAD)
    mark = head[_HEAD - 2 :]
    if head.startswith(_HDF5_MARK):
        raise NotImplementedError
    if len(head) < _HEAD or mark not in (b"IM", b"MI"):
        raise ValueError("it does not begin as one of version 5")
    order = "<" if mark == b"IM" else ">"
    if struct.unpack(f"{order}H", head[_HEAD - 4 : _HEAD - 2])[0] >> 8 == _HDF5:
        raise NotImplementedError
    two, found = f"{order}2I", dict[str, int]()
    end = file.seek(0, os.SEEK_END)
    place = _HEAD
    while place + 8 <= end:
        file.seek(place)
        kind, length = struct.unpack(two, file.read(8))
        place += 8 + length
        if place > end:
            raise ValueError("it ends within a variable")
        beginning = file.read(min(length, _BEGINNING))
        if kind == _COMPRESSED:
            beginning = zlib.decompressobj().decompress(beginning, _BEGINNING)
            kind, length = struct.unpack_from(two, beginning)
            beginning = beginning[8:]
        if kind != _MATRIX:
            raise ValueError(f"it holds an element of the kind {kind}")
        named = _array(beginning, length, order)
        if named is not None:
            if named[0] in found or len(found) == _MOST_VARIABLES:
                raise ValueError(f"it holds {named[0]!r} twice, or over {_MOST_VARIABLES} variables")
            found[named[0]] = named[1]
    return found


def _array(beginning: bytes, length: int, order: str) -> tuple[str, int] | None:
    """Name and bytes of an array of real numbers or a text that begins so, of ``length`` bytes in the file; None of
    another. ValueError where it claims other bytes than its shape has."""
    flags, place = _element(beginning, 0, order)
    (flag,) = struct.unpack_from(f"{order}I", flags)
    size = _BYTES_OF.get(flag & 0xFF)
    if size is None or flag >> 8 & _COMPLEX:
        return None
    dimensions, place = _element(beginning, place, order)
    name, place = _element(beginning, place, order)
    sides = struct.unpack(f"{order}{len(dimensions) // 4}i", dimensions)
    count = math.prod(sides)
    if len(sides) < 2 or min(sides) < 0 or count * size > LARGEST_VARIABLE:
        raise ValueError(f"its variable {name[:80]!r} claims a shape of {sides[:8]}")
    # Numbers are stored as the smallest type that holds them, and never as a larger one than they are of.
    stored, _ = _tag(beginning, place, order)
    if stored > count * size or length > place + count * size + _PADDING:
        raise ValueError(f"its variable {name[:80]!r} claims more bytes than its shape has")
    return name.decode("ascii"), count * size


def _tag(data: bytes, place: int, order: str) -> tuple[int, int]:
    """Bytes of an element's content at a ``place``, and where it begins."""
    kind, length = struct.unpack_from(f"{order}2I", data, place)
    return (kind >> 16, place + 4) if kind >> 16 else (length, place + 8)


def _element(data: bytes, place: int, order: str) -> tuple[bytes, int]:
    """Content of an element at a ``place``, and where the next one begins."""
    length, start = _tag(data, place, order)
    if start + length > len(data):
        raise ValueError(f"a name or shape in it takes {length} bytes")
    return data[start : start + length], place + 8 if start == place + 4 else start + -(-length // 8) * 8


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
        reported = f"is {array.dtype} of shape {array.shape}" if name in variables else "is missing"
        raise MitsimError(f"{path}: {name} {reported}; numbers of shape {shape} are needed")
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


# -------- A run and a calibration of several lines in

COLOURED, FILTERED, _CALIBRATED = "colour_run", "mosaic_run", "colour_calibration"
"""Variables that hold the colour.json of a coloured run, of one behind colour filters, and of a calibration."""
_LONGEST_LINE = 31
"""Letters of a line's name: a variable of MATLAB has 63 at most, truth_board_reflectance_ half of them."""


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
    colours = unpack_colours(text, RUN, path)
    held = {name: folders_in(name, own) for name, own in by_line(variables, colours.names, path).items()}
    run = Coloured(colours, text, {name: shots for name, (shots, _) in held.items()})
    return run, calibrations_in(variables, {name: calibration for name, (_, calibration) in held.items()}, path)


def calibrations_in(
    variables: Variables, held: Mapping[str, Packed[CalibrationManifest] | None], path: Path
) -> Coloured[CalibrationManifest] | None:
    """The coloured calibration in a file; None where it holds none.

    Parameters
    ----------
    variables
        of the file.
    held
        the calibration of each line, where there is one, by its name.
    path
        of the file, for messages.

    Raises
    ------
    MitsimError
        where some line has none.
    """
    if _CALIBRATED not in variables:
        return None
    text = text_in(variables, _CALIBRATED, path)
    colours = unpack_colours(text, CALIBRATION, path)
    lines = {name: calibration for name, calibration in held.items() if calibration is not None}
    if {*lines} != {*colours.names}:
        raise MitsimError(f"{path}: has calibrations of {', '.join(lines)}, not of {', '.join(colours.names)}")
    return Coloured(colours, text, lines)


def by_line(variables: Variables, names: Sequence[str], path: Path) -> dict[str, dict[str, Any]]:
    """Variables of each line by its name, without their ending.

    Parameters
    ----------
    variables
        of the file.
    names
        of the lines.
    path
        of the file, for messages.

    Raises
    ------
    MitsimError
        as :func:`endings`.
    """
    return {
        name: {key.removesuffix(end): values for key, values in variables.items() if key.endswith(end)}
        for name, end in endings(names, path).items()
    }


def colours_in(run: Coloured[RunManifest] | Filtered, calibration: Calibration | None) -> dict[str, Any]:
    """Variables that say of which lines a file is: the colour.json of ``run`` and ``calibration``."""
    variables = {FILTERED if isinstance(run, Filtered) else COLOURED: run.text}
    return {**variables, _CALIBRATED: calibration.text} if isinstance(calibration, Coloured) else variables


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


# -------- A run and its calibration in


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
    return as_channel(matrix_in(variables, name, path).astype(np.float32), name, path)


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
    manifest = unpack(text, CalibrationManifest, path)
    metadata: Metadata = {"unit": "sqrt(e-/s)"}
    if manifest.board_reflectance is not None:
        metadata = {**metadata, "reflectance": manifest.board_reflectance}

    def read(name: str) -> tuple[Channels, Metadata]:
        variable = f"phi_{Path(name).stem}"
        factor = matrix_in(variables, variable, path) / math.sqrt(dn_per_rate(digital))
        # Rounding in double precision is far below half of the last digit in single: the number is the first one.
        return {"factor": as_channel(factor.astype(np.float32), variable, path)}, metadata

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
    return as_channel(digital, name, path)
