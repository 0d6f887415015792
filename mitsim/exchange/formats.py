"""RUN and CAL folders are exported to other programs' files here, and made from such files or real frames.

Each format is a row of :data:`FORMATS`; its module is imported when it is used, after the request was checked.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, nullcontext
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mitsim.core import colour_files, configuration, manifests, picture_files
from mitsim.core.configuration import FilePath, Options, option, takes
from mitsim.core.errors import ArgumentError, MitsimError, check_arguments
from mitsim.core.files import check_apart, check_plain, output_file, whole_folder
from mitsim.core.headline import calibration_headline, each_once, frames_headline
from mitsim.core.manifests import MOST_PIXELS, CalibrationManifest, RunManifest
from mitsim.core.seeds import check_root
from mitsim.devices.patterns import read_name, takes_seed
from mitsim.exchange.capture_list import CAMERAS, PROJECTORS, TURNED, FrameFacts, said

if TYPE_CHECKING:
    from mitsim.core.job import Job
    from mitsim.exchange.packed import Run

# ---- Export ----

HDF5, PNG, DATASET = "hdf5", "png", "dataset"
"""Only HDF5 holds several spectral lines; only pictures hold no calibration; a data set is made of pairs, not of a run.
"""
OF_FOLDERS = PNG, DATASET
"""Formats that are a folder, which is never replaced."""
FORMATS = {
    HDF5: "packed.write_hdf5",
    "mat": "other_programs.write_matlab",
    "torch": "other_programs.write_torch",
    PNG: "other_programs.write_pngs",
    DATASET: "dataset.write_dataset",
}
"""Functions that write each format: from place, run, and calibration or projector to notes on the use of the file, or
on parts of the run that it does not hold."""
READERS = {".h5": "packed.load_hdf5", ".hdf5": "packed.load_hdf5", ".mat": "other_programs.load_flatcam"}
"""Functions that open files of `mitsim import`, by suffix: from place and channel to a context of
:data:`mitsim.exchange.packed.Loaded`."""


def _function(name: str) -> Callable[..., Any]:
    module, _, function = name.partition(".")
    found: Callable[..., Any] = getattr(import_module(f"mitsim.exchange.{module}"), function)
    return found


class Exported(Options):
    """Options of an export."""

    PANEL = configuration.OUTPUT
    VERB = "export"

    format: str = option(..., "hdf5, mat, torch, png or dataset", metavar="FORMAT")
    output: FilePath = option(
        ..., "file to make; with png or dataset, a folder", "-o", "--output", metavar="FILE", kind=Path
    )
    calibration: FilePath | None = option(
        None,
        "calibration folder to include in the file; for a dataset, to make its images by",
        metavar="CAL",
        panel=configuration.WHAT,
        kind=Path,
    )
    overwrite: bool = option(False, "replace an existing file")
    projector: str | None = option(
        None, "only with png: projector to use", panel=configuration.DEVICES, metavar="NAME|FILE", complete=PROJECTORS
    )


@takes(Exported)
def export(
    run: Path | str, format: str, output: Path | str, calibration: Path | str | None = None, **options: Any
) -> dict[str, Any]:
    """Write a run, or pairs as a data set, in a format that other programs read.

    Parameters
    ----------
    run
        RUN folder, also a coloured one, or one behind colour filters; for a data set, folder of `mitsim pairs`.
    format
        Key of :data:`FORMATS`.
    output
        File or folder to create.
    calibration
        CAL folder to include; None takes the one in the pairs' folder for a data set.

    Returns
    -------
    dict
        `format`, `output`, `frames` (of all lines), `pairs`, `calibration`, `notes`: the output of the command line.

    Raises
    ------
    MitsimError
        before anything is written, for an unknown format, a missing calibration or one of other lines, an ``output``
        that
        holds something or has another format's suffix, an invalid folder, and a run that the format cannot hold.
    """
    asked = Exported(format=format, output=output, calibration=calibration, **options)
    check_export(run, asked)
    if format == DATASET:
        from mitsim.exchange.dataset import write_dataset

        return {"format": format, **write_dataset(Path(run), Path(output), asked.calibration)}
    with nullcontext() if format == PNG else output_file(Path(output), asked.overwrite):
        from mitsim.exchange.packed import read_content

        shots = read_content(Path(run), colour_files.RUN, colour_files.MOSAIC)
        calibrated = calibration and read_content(Path(calibration), colour_files.CALIBRATION)
        notes = _function(FORMATS[format])(Path(output), shots, asked.projector if format == PNG else calibrated)
    return {
        "format": format,
        "frames": _frames_of(shots),
        "pairs": None,
        "calibration": None if calibration is None else str(calibration),
        "notes": list(notes),
        "output": str(Path(output)),
    }


def check_export(run: Path | str, asked: Exported) -> None:
    """Raise the errors that :func:`export` raises before it writes."""
    check_format(asked)
    if asked.format == DATASET:
        from mitsim.exchange.dataset import open_pairs

        _, place, _ = open_pairs(Path(run), asked.calibration)
        check_apart(Path(asked.output), [Path(run), place])
        return
    lines, kind = colour_files.open_lines(Path(run), colour_files.RUN, colour_files.MOSAIC), asked.format
    calibrated = None if asked.calibration is None else lines.check_calibration(Path(asked.calibration))
    if lines.colours and kind != HDF5:
        raise MitsimError(f"{run}: has several spectral lines, and {kind} holds one; use {HDF5}, or a line's folder")
    for part in lines.parts.values():  # refused before numpy is imported
        manifest = manifests.read_manifest(part, RunManifest)
        if kind == PNG:
            _function("other_programs.check_pictures")(manifest, asked.projector, str(part))
    for part in calibrated.parts.values() if calibrated else ():
        manifests.read_manifest(part, CalibrationManifest)
    check_apart(Path(asked.output), [each.folder for each in (lines, calibrated) if each])


def check_format(asked: Exported) -> None:
    """Raise the errors that :func:`export` raises before it opens a folder."""
    kind, ending = asked.format, Path(asked.output).suffix.lower()
    if kind not in FORMATS:
        raise ArgumentError("format", f"{kind!r}: use {', '.join(FORMATS)}")
    if asked.projector is not None and kind != PNG:
        raise ArgumentError("projector", f"{asked.projector}: is only for png; leave it out with {kind}")
    if asked.calibration is not None and kind == PNG:
        raise ArgumentError("calibration", f"{asked.calibration}: {kind} cannot contain one; leave it out")
    if ending in READERS and ending not in {HDF5: (".h5", ".hdf5"), "mat": (".mat",)}.get(kind, ()):
        raise MitsimError(f"output {asked.output}: files of {kind} do not end in {ending}; choose another name")


# ---- Import ----


@check_arguments
def import_file(
    source: Path | str,
    output: Path | str | None = None,
    calibration_output: Path | str | None = None,
    channel: str | None = None,
) -> dict[str, Any]:
    """Write the folders in an HDF5 file of `mitsim export`, or in a FlatCam's `.mat`, each whole or not at all.

    Parameters
    ----------
    source
        File to read.
    output
        RUN folder to create; None: only the calibration is wanted.
    calibration_output
        CAL folder to create; None: the calibration is not wanted.
    channel
        Plane of a real FlatCam's calibration, or `all`.

    Returns
    -------
    dict
        `frames` (of all lines), `output`, `calibration_output`, `holds`, `left_out`, `notes`, `warnings`: the output
        of the command line.

    Raises
    ------
    MitsimError
        for an unknown or damaged file, a part that it does not hold, or a place that holds something.
    """
    source = Path(source)
    if output is None and calibration_output is None:
        raise MitsimError("import: nothing to make; give output, calibration_output, or both")
    if source.suffix.lower() not in READERS:
        raise ArgumentError("source", f"{source}: give a file that ends in {', '.join(READERS)}, or use import_frames")
    check_plain(source)  # refused before numpy is imported
    if channel is not None:
        picture_files.check_channel(channel)
    from mitsim.core.runs import load_run

    with _function(READERS[source.suffix.lower()])(source, channel) as (run, calibration):
        factors = "calibration_output", calibration_output, calibration
        wanted = {"run": ("output", output, run), "calibration": factors}
        for kind, (argument, place, held) in wanted.items():
            if place is not None and held is None:
                raise ArgumentError(argument, f"{place}: {source} contains no {kind}; leave this option out")
        with ExitStack() as stack:
            folders = [(stack.enter_context(whole_folder(place)), held) for _, place, held in wanted.values() if place]
            for folder, held in folders:
                held.fill(folder)
    parts = {} if calibration is None or calibration_output is None else calibration.parts
    angles = sorted({part.manifest.configuration.get(TURNED, 0) for part in parts.values()})
    turned = [f"Its frames are turned by {each:g} degrees: import them with --turn {each:g}" for each in angles if each]
    taken = {} if run is None or output is None else {name: load_run(Path(output) / name) for name in run.parts}
    flags = [*each_once({line: part.warnings for line, part in taken.items()})]
    shown = frames_headline([part.summary() for part in taken.values()], flags) if taken else ""
    flags += each_once({line: part.manifest.warnings for line, part in parts.items()})
    return {
        "headline": shown or calibration_headline([part.manifest.result for part in parts.values()], flags),
        "frames": None if run is None else _frames_of(run),
        "output": None if output is None else str(output),
        "calibration_output": None if calibration_output is None else str(calibration_output),
        "holds": [kind for kind, (*_, held) in wanted.items() if held],
        "left_out": [],
        "notes": turned,
        "warnings": flags,
    }


def _frames_of(run: Run) -> int:
    return sum(len(part.manifest.patterns.captures) for part in run.parts.values())


@takes(FrameFacts)
def import_frames(
    source: Path | str, output: Path | str, job: Job | None = None, overwrite: bool = False, **known: Any
) -> dict[str, Any]:
    """Make a RUN folder from a real camera's frames, whole or not at all, or with ``point`` an NPY file.

    Parameters
    ----------
    source
        Folder of frames, sorted by the numbers in their names; or one file.
    output
        RUN folder to create; with ``point`` a file that ends in .npy.
    job
        Its command line is recorded in the manifest; None: called from Python.
    overwrite
        With ``point``, whether an earlier file is replaced.

    Returns
    -------
    dict
        `frames`, `shape`, `output`, `left_out`, `divided_by`, `planes`, `notes`, `warnings` and others that the command
        line prints. :func:`mitsim.load_run` reads the folder.

    Raises
    ------
    MitsimError
        for invalid or unused values, frames that are missing, too many, unlike each other or beyond the camera's range,
        or
        a place that holds something.
    """
    facts = FrameFacts(**known).of(Path(source))
    if facts.point:
        from mitsim.exchange.point_source import stack_point

        return stack_point(Path(source), Path(output), facts, overwrite)
    from mitsim.exchange.packed import import_capture

    return import_capture(Path(source), Path(output), facts, None if job is None else job.command)


# ---- Pictures of patterns ----

STRIPES = "stripes"
"""Name of a calibration session's pictures, in place of a family of patterns."""


class Pictures(Options):
    """Options of pictures: projector, last picture, and the camera that stripes need."""

    PANEL = configuration.DEVICES
    VERB = "pattern_pictures"

    projector: FilePath = option(
        "mp_cl1", "projector with stated rows and columns: name or TOML file", metavar="NAME|FILE", complete=PROJECTORS
    )
    projector_pixels: int = option(128, "rows and columns of the patterns", min=1, max=MOST_PIXELS, metavar="N")
    seed: int | None = said("only for random patterns: seed of their random numbers", panel=configuration.QUALITY)
    closing_frame: Literal["first", "uniform"] | None = said(
        "add a last picture, the first one again or a uniform one, to check that lamp, camera and scene did not change",
        metavar="first|uniform",
        panel=configuration.WHAT,
    )
    camera: FilePath | None = said(
        "only with stripes: camera that records them, name or TOML file", metavar="NAME|FILE", complete=CAMERAS
    )
    exposure: float | None = said("only with stripes: exposure time of each frame [s]", metavar="SECONDS")
    signed_capture: Literal["pair", "uniform"] | None = said(
        "only with stripes: show both signs of each pattern, or one sign and a uniform frame", metavar="pair|uniform"
    )


@takes(Pictures)
def pattern_pictures(patterns: str, output: Path | str, **options: Any) -> dict[str, Any]:
    """Draw patterns, or a calibration's stripes, as pictures to show on a real projector.

    Parameters
    ----------
    patterns
        Name of a family, or ``stripes`` for a calibration.
    output
        Folder to create.

    Returns
    -------
    dict
        `patterns`, `n`, `pictures`, `projector` (rows, columns, and the grid's place), `output`, and `session`, the
        list
        for the frames of stripes.

    Raises
    ------
    MitsimError
        for unknown patterns, patterns that do not fit the projector, invalid or unused values, and a place that holds
        something.
    """
    asked, folder = Pictures(**options), Path(output)
    seed, last, pixels = asked.seed or 0, asked.closing_frame, asked.projector_pixels
    check_root(seed)
    drawn_at_random = patterns != STRIPES and takes_seed(patterns)
    if not drawn_at_random:
        asked.refuse(["seed"], "on patterns that are not drawn at random")
    if patterns == STRIPES:
        asked.refuse(["closing_frame"], "on stripes, whose pairs check the lamp")
        if asked.camera is None or asked.exposure is None:
            missing = "camera" if asked.camera is None else "exposure"
            raise ArgumentError(missing, "is missing; stripes need it for the session file of their frames")
        from mitsim.exchange.other_programs import SESSION, draw_stripes

        mode = asked.signed_capture or "pair"
        drawn = draw_stripes(folder, pixels, str(asked.projector), str(asked.camera), asked.exposure, mode)
        return {**drawn, "session": str(folder / SESSION)}
    read_name(patterns, pixels)  # refused before numpy is imported
    asked.refuse(["signed_capture"], "on patterns, but only on stripes")
    for name in ("camera", "exposure"):
        if (value := getattr(asked, name)) is not None:
            raise ArgumentError(name, f"{value}: is only for stripes; for patterns give it to `mitsim import`")
    from mitsim.exchange.other_programs import draw_family

    drawn = draw_family(folder, patterns, pixels, str(asked.projector), seed, last)
    return {**drawn, "session": None}


patterns = pattern_pictures
