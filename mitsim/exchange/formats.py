"""RUN and CAL folders in, a file or folder of a format that other programs read out; and such a file back to folders.

Each format is a row of :data:`FORMATS`. Its module is imported when it is used: what a request says is checked before.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.files import check_apart, check_plain, output_file, whole_folder
from mitsim.core.imagelist import check_channel
from mitsim.core.manifests import CalibrationManifest, RunManifest, read_manifest
from mitsim.core.spectral_manifests import (
    RUN,
    check_lines,
    is_coloured,
    is_mosaic,
    read_colours,
    read_mosaic,
    same_lines,
)
from mitsim.exchange.capture_list import TURNED

if TYPE_CHECKING:
    from mitsim.exchange.packed import Run


@dataclass(frozen=True)
class Format:
    """A format that runs are exported to.

    Attributes
    ----------
    what
        that a user gets, in a few words.
    kind
        whether it is one file or a folder.
    calibration
        whether a calibration is needed, or may be given.
    writer
        module of this room and function: from the place, the run (of one line, coloured or behind filters), and its
        ``calibration`` or, where the format has none, a ``projector``'s name, to sentences on what of the run the
        format does not hold, or how it is used.
    filters
        whether it holds runs behind colour filters.
    """

    what: str
    kind: Literal["file", "folder"]
    calibration: Literal["needed", "optional", "none"]
    writer: str
    filters: bool = True


FORMATS: dict[str, Format] = {
    "hdf5": Format("one HDF5 file, all of RUN and CAL", "file", "optional", "hdf5.write_hdf5"),
    "mat": Format("the paper's variables, for MATLAB and Octave", "file", "optional", "matlab.write_matlab"),
    "flatcam": Format("FlatCam's variables, for its scripts", "file", "needed", "matlab.write_flatcam", False),
    "deepinv": Format("tensors of a deepinv physics", "file", "needed", "tensors.write_deepinv"),
    "torch": Format("tensors for torch.load", "file", "optional", "tensors.write_tensors"),
    "png": Format("pictures of frames, patterns for a real projector", "folder", "none", "png_files.write_pngs", False),
}
"""Formats by the name that `--format` takes."""
READERS = {".h5": "hdf5.load_hdf5", ".hdf5": "hdf5.load_hdf5", ".mat": "matlab.load_mat"}
"""What opens a file that `mitsim import` takes, by the end of its name: from the place and a channel to a context of
:class:`mitsim.exchange.packed.Loaded`."""
_ENDINGS = {".h5": ("hdf5",), ".hdf5": ("hdf5",), ".mat": ("mat", "flatcam")}
"""Formats by how names end that `mitsim import` takes them by."""
_CALLED = {"output": "run", "calibration_output": "calibration"}
"""What the folder of an argument is, in messages."""


def _function(name: str) -> Callable[..., Any]:
    module, _, function = name.partition(".")
    found: Callable[..., Any] = getattr(import_module(f"mitsim.exchange.{module}"), function)
    return found


def export_run(
    run: Path | str,
    format: str,
    output: Path | str,
    calibration: Path | str | None = None,
    overwrite: bool = False,
    projector: str | None = None,
) -> dict[str, Any]:
    """Write a run in a format that other programs read.

    Parameters
    ----------
    run
        RUN folder, a coloured one, or one behind colour filters.
    format
        a key of :data:`FORMATS`.
    output
        file or folder to make.
    calibration
        CAL folder that goes with it.
    overwrite
        whether a file may be replaced.
    projector
        name or TOML file whose raster pictures are drawn for, of `png` alone; None: the run's own.

    Returns
    -------
    dict
        `format`, `output`, `frames` (of all lines), `calibration`, `notes`: what the command line prints.

    Raises
    ------
    MitsimError
        before anything is written, for an unknown format, a missing calibration, a place that holds something or is
        called as one of another format, a folder that is none, or a calibration of other lines; and for a run that the
        format cannot hold.
    """
    if format not in FORMATS:
        raise ArgumentError("format", f"{format!r}: use {', '.join(FORMATS)}")
    chosen = FORMATS[format]
    if projector is not None and format != "png":
        raise ArgumentError("projector", f"{projector}: {format} draws no pictures for one; leave it out")
    if calibration is None and chosen.calibration == "needed":
        raise ArgumentError("calibration", f"is not given, and {format} is of its factors; give a folder of it")
    if calibration is not None and chosen.calibration == "none":
        raise ArgumentError("calibration", f"{calibration}: {format} holds none; leave it out")
    folder, factors, place = Path(run), None if calibration is None else Path(calibration), Path(output)
    if format not in _ENDINGS.get(ending := place.suffix.lower(), (format,)):
        raise MitsimError(
            f"output {place}: {ending} is of {' and '.join(_ENDINGS[ending])}, not of {format}; rename it"
        )
    lines = _lines(folder, factors)
    if is_mosaic(folder) and not chosen.filters:
        able = ", ".join(name for name, other in FORMATS.items() if other.filters)
        raise MitsimError(f"{folder}: is behind colour filters, of which {format} knows nothing; use {able}")
    for line in lines or ("",):  # refused before numpy is imported
        read_manifest(folder if is_mosaic(folder) else folder / line, RunManifest)
        if factors is not None:
            read_manifest(factors / line, CalibrationManifest)
    check_apart(place, [folder, *([factors] if factors else [])])
    with output_file(place, overwrite) if chosen.kind == "file" else nullcontext():
        from mitsim.exchange.packed import calibration_content, run_content

        shots, calibrated = run_content(folder), None if factors is None else calibration_content(factors)
        options = {"projector": projector} if chosen.calibration == "none" else {"calibration": calibrated}
        notes = _function(chosen.writer)(place, shots, **options)
    return {
        "format": format,
        "frames": _frames_of(shots),
        "calibration": None if calibration is None else str(calibration),
        "notes": list(notes),
        "output": str(place),
    }


def _lines(run: Path, calibration: Path | None) -> tuple[str, ...]:
    """Names of a run's lines, which are its calibration's too; none of a run that tells none apart."""
    if is_mosaic(run):
        colours = read_mosaic(run)
        if calibration is not None:
            check_lines(colours, str(run), calibration)
        return colours.names
    if not is_coloured(run):
        if calibration is not None and is_coloured(calibration):
            raise ArgumentError("calibration", f"{calibration}: is coloured, but {run} is not; give a line's folder")
        return ()
    return (read_colours(run, RUN) if calibration is None else same_lines(run, calibration)).names


def import_file(
    source: Path, output: Path | None, calibration_output: Path | None = None, channel: str | None = None
) -> dict[str, Any]:
    """Write the folders that a file of `mitsim export` holds, each whole or not at all.

    Parameters
    ----------
    source
        the file.
    output
        RUN folder to make; None: only the calibration is wanted.
    calibration_output
        CAL folder to make; None: the file's calibration, if it has one, is not wanted.
    channel
        plane of a real FlatCam's calibration that is taken, or `all`.

    Returns
    -------
    dict
        `frames` (of all lines), `output`, `calibration_output`, `holds`, `left_out`, `notes`, `warnings`: what the
        command line prints.

    Raises
    ------
    MitsimError
        for a file that is none or is damaged, a part that it does not hold, or a place that holds something.
    """
    check_plain(source)  # refused before numpy is imported
    if channel is not None:
        check_channel(channel)
    with _function(READERS[source.suffix.lower()])(source, channel) as loaded:
        wanted = {"output": (output, loaded.run), "calibration_output": (calibration_output, loaded.calibration)}
        for argument, (place, held) in wanted.items():
            if place is not None and held is None:
                raise ArgumentError(argument, f"{place}: {source} holds no {_CALLED[argument]}; leave this out")
        with ExitStack() as stack:
            folders = [(stack.enter_context(whole_folder(place)), held) for place, held in wanted.values() if place]
            for folder, held in folders:
                held.fill(folder)
    run, calibration = loaded.run, loaded.calibration
    parts = {} if calibration is None or calibration_output is None else calibration.parts
    angles = sorted({part.manifest.configuration.get(TURNED, 0) for part in parts.values()})
    return {
        "frames": None if run is None else _frames_of(run),
        "output": None if output is None else str(output),
        "calibration_output": None if calibration_output is None else str(calibration_output),
        "holds": [_CALLED[argument] for argument, (_, held) in wanted.items() if held],
        "left_out": list(loaded.left_out),
        "notes": [
            f"Its frames are turned by {angle:g} degrees: import them with --turn {angle:g}"
            for angle in angles
            if angle
        ],
        "warnings": [
            f"{line}: {text}" if line else text for line, part in parts.items() for text in part.manifest.warnings
        ],
    }


def _frames_of(run: Run) -> int:
    return sum(len(part.manifest.patterns.captures) for part in run.parts.values())
