"""Verbs that exchange runs and light with other programs and real cameras: words of a command line in, files or
folders out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

import mitsim
from mitsim.cli.help_page import DEVICES, OUTPUT, WHAT
from mitsim.cli.options import (
    Common,
    Devices,
    KnownPlan,
    Limited,
    OfPatterns,
    Overwrite,
    Pictured,
    Projector,
    Scene,
    Seed,
    complete_camera,
    complete_list,
    complete_projector,
    given_of,
    option,
    pop_patterns,
    refuse_unused,
    verb,
)
from mitsim.cli.report_verb import finish_folder
from mitsim.cli.screen import finish
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import pattern_names


@dataclass(frozen=True)
class Exported:
    """What a run is written as."""

    PANEL = OUTPUT

    format: str = option(..., "hdf5, mat, torch or png", metavar="FORMAT")
    output: Path = option(..., "file to make; of png, a folder", "-o", "--output", metavar="FILE")
    calibration: Path | None = option(
        None, "folder of `mitsim calibrate` that goes with it", metavar="CAL", rich_help_panel=WHAT
    )
    overwrite: Overwrite = False
    projector: Projector = None


@verb
def export(
    context: typer.Context,
    run: Annotated[Path, typer.Argument(help="folder of `mitsim capture`", metavar="RUN")],
    exported: Exported,
    common: Common,
) -> int:
    """Write a run in a format that other programs read.

    $ mitsim export run --format hdf5 -o run.h5
    $ mitsim export run --format mat -o run.mat --calibration cal
    """
    if exported.format == "png":
        refuse_unused(context, ["overwrite"], "on a folder of pictures, which takes the place of none")
    payload = mitsim.export(run, **vars(exported))
    with_it = f" with {payload['calibration']}" if payload["calibration"] else ""
    lines = [f"{payload['frames']} frames{with_it} as {exported.format}: {payload['output']}", *payload["notes"]]
    return finish(common.as_json, payload, lines, ())


@dataclass(frozen=True)
class Frames:
    """What a person knows of a real camera's frames."""

    PANEL = WHAT

    list: str | None = option(
        None,
        "of frames: list of what is known of them; options take its place",
        metavar="NAME|FILE",
        autocompletion=complete_list,
    )
    patterns: str | None = option(None, "of frames: the family, or patterns.json of export", metavar="NAME|FILE")
    camera: str | None = option(
        None,
        "of frames: camera electronics, name or TOML file",
        metavar="NAME|FILE",
        autocompletion=complete_camera,
    )
    exposure: float | None = option(None, "of frames: seconds of each", metavar="SECONDS")
    calibration: Path | None = option(
        None, "of frames: calibration of the same camera, for its identity", metavar="CAL"
    )
    projector_pixels: int | None = option(
        None, "of frames: projector pixels a side, without a calibration", metavar="N"
    )
    black_level: float | None = option(None, "of frames: number of a pixel without charge; the camera's if not given")
    ambient_frame: Path | None = option(None, "frame, or folder of frames, with the projector off", metavar="PATH")
    ambient_shots: int | None = option(None, "shots that a single such frame is the mean of", metavar="N")
    closing_frame: str | None = option(
        None,
        "the last frame checks lamp, camera and scene: the first one again, or a uniform one",
        metavar="first|uniform",
    )
    closing_exposure: float | None = option(None, "seconds of that frame; those of all if not given", metavar="SECONDS")
    order: str | None = option(
        None, "in which the shots were taken, such as column-major; row-major if not given", metavar="NAME"
    )
    shape: str | None = option(None, "of files without header (.raw, .bin, .dat)", metavar="ROWSxCOLUMNS")
    bits: int | None = option(None, "of a number in such a file", metavar="N")
    byte_order: str = option("little", "of such a file: little or big", metavar="ORDER")
    channel: str | None = option(
        None, "plane of a colour sensor, as FlatCam names it, or all of them", metavar="r|gb|gr|b|all"
    )
    mosaic: str | None = option(
        None, "of frames: filters of the first 2 x 2 pixels; the camera's if not given", metavar="RGGB|BGGR|GRBG|GBRG"
    )
    divide: int | None = option(None, "of frames: factor that all numbers have; found if not given", metavar="N")
    dark_frame: str | None = option(None, "frame, or folder of frames, without any light", metavar="PATH")
    flat_frame: str | None = option(None, "the same of even light without a mask", metavar="PATH")
    flat_dark_frame: str | None = option(None, "the same without light, of the flat's exposure", metavar="PATH")
    orientation: str | None = option(None, "of frames: Exif's, or as the file says", metavar="1..8|file")
    turn: float | None = option(None, "of frames: turned counter-clockwise after that", metavar="DEGREES")
    crop: str | None = option(None, "of frames: part that is taken in the end", metavar="ROW,COLUMN[,ROWS,COLUMNS]")
    seed: Seed = 0


@verb
def import_(
    context: typer.Context,
    source: Annotated[
        Path, typer.Argument(help="file of `mitsim export`, or frames: a folder of them, or one file", metavar="SOURCE")
    ],
    frames: Frames,
    pictured: Pictured,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="run folder to make", metavar="RUN")] = None,
    calibration_output: Annotated[
        Path | None, typer.Option(help="folder to make of the file's calibration", metavar="CAL")
    ] = None,
) -> int:
    """Make a run of a real camera's frames, or of an exported file.

    $ mitsim import frames -o run --list mine.toml --calibration cal
    $ mitsim import hand.png -o hand --list diffusercam
    $ mitsim import run.h5 -o copy
    """
    from mitsim.exchange.formats import READERS

    if output is None and calibration_output is None:
        raise MitsimError("import: nothing to make; give -o RUN, --calibration-output CAL, or both")
    if source.suffix.lower() in READERS:
        others = [name for name in vars(frames) if name != "channel"]
        refuse_unused(context, others, f"on {source}, which says itself what its frames are")
        payload = mitsim.import_file(source, output, calibration_output, frames.channel)
    elif output is None or calibration_output is not None:
        raise MitsimError(f"{source}: frames hold no calibration; give -o RUN, and no --calibration-output")
    else:
        with pictured.job() as job:
            payload = mitsim.import_frames(source, output, job, **given_of(context, vars(frames)))
    lines = []
    if payload["output"]:
        lines.append(f"{payload['frames']} frame{'s' if payload['frames'] != 1 else ''}: {payload['output']}")
    if payload["calibration_output"]:
        lines.append(f"calibration: {payload['calibration_output']}")
    elif "calibration" in payload["holds"]:
        lines.append("The file holds a calibration too; give --calibration-output to have it")
    lines += payload.get("notes", ())
    if payload["left_out"]:
        lines.append(f"Not known, and left out: {', '.join(payload['left_out'])}")
    if payload["output"]:
        return finish_folder(pictured, Path(payload["output"]), payload, lines, payload["warnings"])
    return finish(pictured.as_json, {**payload, "report": None}, lines, payload["warnings"])


@dataclass(frozen=True)
class Screen:
    """A projector that patterns are drawn for, and its last picture."""

    PANEL = DEVICES

    projector: str = option(
        "mp_cl1",
        "projector of known rows and columns: name or TOML file",
        metavar="NAME|FILE",
        autocompletion=complete_projector,
    )
    projector_pixels: int = option(128, "projector pixels a side of the patterns", min=1, max=4096, metavar="N")
    closing_frame: str | None = option(
        None,
        "last picture, to check lamp, camera and scene: the first one again, or a uniform one",
        metavar="first|uniform",
        rich_help_panel=WHAT,
    )


@dataclass(frozen=True)
class Stripes:
    """What a calibration's stripes need beside it."""

    PANEL = DEVICES

    camera: str | None = option(
        None,
        "of stripes: camera electronics, name or TOML file",
        metavar="NAME|FILE",
        autocompletion=complete_camera,
    )
    exposure: float | None = option(None, "of stripes: seconds of each frame", metavar="SECONDS")
    signed_capture: str = option(
        "pair", "of stripes: both halves of each, or one and a uniform frame", metavar="pair|uniform"
    )


@verb
def patterns(
    *,
    context: typer.Context,
    family: Annotated[
        str, typer.Argument(help=f"{pattern_names()}; or stripes, those of a calibration", metavar="PATTERNS|stripes")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="folder to make", metavar="DIR")],
    screen: Screen,
    stripes: Stripes,
    seed: Seed = 0,
    common: Common,
) -> int:
    """Draw patterns as pictures for a real projector.

    Or a calibration's stripes, with the list that its frames need.

    $ mitsim patterns dots:7 -o pictures
    $ mitsim patterns stripes -o stripes --camera imx249 --exposure 0.02
    """
    asked, last = given_of(context, {**vars(stripes), "seed": seed}), screen.closing_frame
    payload = mitsim.pattern_pictures(family, output, **vars(screen), **asked)
    if payload["session"]:
        after = (
            f"Copy {payload['session']} into the folder of their frames; then: mitsim calibrate --frames FRAMES -o CAL"
        )
    else:
        after = (
            f"Their frames are read by: mitsim import FRAMES --patterns {output / 'patterns.json'} --camera NAME "
            f"--exposure SECONDS --calibration CAL -o RUN{f' --closing-frame {last}' if last else ''}"
        )
    from mitsim.exchange.png_files import describe_cells

    where = payload["projector"]
    lines = [
        f"{payload['pictures']} pictures of {where['rows']}x{where['columns']}, {payload['n']}x{payload['n']} cells of "
        f"{describe_cells(where)}: {output}",
        after,
    ]
    return finish(common.as_json, payload, lines, ())


@dataclass(frozen=True)
class Traced(KnownPlan):
    """What is planned already, and whether a file of light is replaced."""

    overwrite: Overwrite = False


@verb
def transport(
    *,
    context: typer.Context,
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="HDF5 file to make", metavar="FILE.h5")],
    sampling: OfPatterns,
    traced: Traced,
    devices: Devices,
    limited: Limited,
) -> int:
    """Trace a scene's light, for frames of any pattern.

    Written by projector pixel, for capture --light and for programs without mitsim.

    $ mitsim transport photograph -o light.h5
    $ mitsim capture photograph -o run --light light.h5 --patterns dots:5
    """
    from mitsim.core.files import check_apart, output_file

    request, known = traced.read(context, vars(sampling))
    patterns = pop_patterns(request, known)
    devices.check(scene, patterns)
    with limited.job() as job, output_file(output, traced.overwrite) as output:
        bench = devices.open(scene, limited.variant, job)
        check_apart(output, (*bench.loaded.files, *devices.models, *filter(None, [traced.plan])))
        light = bench.light(known or patterns, job, **request)
        with job.clock.stage("write"):
            light.save(output)
    size = output.stat().st_size
    payload = {**light.summary(), "bytes": size, "seconds": job.clock.seconds(), "output": str(output)}
    payload["kernels"] = job.clock.kernels()
    shape, taken = payload["shape"], payload["seconds"]
    lines = [
        f"Light of {payload['n']}x{payload['n']} projector pixels to {shape[0]}x{shape[1]} of the sensor in "
        f"{taken['total']:.1f} s, {payload['entries']} numbers, {size / 2**20:.3g} MiB: {output}",
        f"Monte Carlo error {payload['mc_error']:.1e} of the frames of {patterns}, total error up to "
        f"{payload['total_error_bound']:.1e}",
    ]
    return finish(limited.as_json, payload, lines, payload["warnings"])
