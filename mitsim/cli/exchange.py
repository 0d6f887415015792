"""Verbs that exchange runs and light with other programs and real cameras: words of a command line in, files or
folders out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from mitsim.cli.options import (
    DAY,
    AccuracyOrSeconds,
    Camera,
    Defines,
    Effects,
    Json,
    MaxMemory,
    MaxSeconds,
    Outside,
    Patterns,
    Projector,
    Quiet,
    Scene,
    Seconds,
    Seed,
    Variant,
    bench_of,
    check_shown,
    job_of,
    refuse_unused,
    request_of,
)
from mitsim.cli.screen import finish
from mitsim.core.environment import DEFAULT_VARIANT
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.seeds import check_root
from mitsim.devices.patterns import pattern_names, read_name, takes_seed

app = typer.Typer()

_OF_BARE = ("shape", "bits", "byte_order")
"""Options of `mitsim import` for files without a header."""
_OF_FRAMES = (
    *("patterns", "camera", "exposure", "calibration", "projector_pixels", "black_level"),
    *("ambient_frame", "ambient_shots", *_OF_BARE, "seed"),
)
"""Those for frames, which a file of `mitsim export` does without."""


@app.command("export")
def export(
    context: typer.Context,
    run: Annotated[Path, typer.Argument(help="folder of `mitsim capture`", metavar="RUN")],
    format: Annotated[str, typer.Option(help="hdf5, mat, flatcam, deepinv, torch or png", metavar="FORMAT")],
    output: Annotated[Path, typer.Option("-o", "--output", help="file to make; of png, a folder", metavar="FILE")],
    calibration: Annotated[
        Path | None, typer.Option(help="folder of `mitsim calibrate` that goes with it", metavar="CAL")
    ] = None,
    projector: Projector = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the file")] = False,
    variant: Variant = DEFAULT_VARIANT,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Write a run in a format that other programs read."""
    from mitsim.exchange.formats import export_run

    if format == "png":
        refuse_unused(context, ["overwrite"], "on a folder of pictures, which takes the place of none")
    payload = export_run(run, format, output, calibration, overwrite, projector)
    with_it = f" with {payload['calibration']}" if payload["calibration"] else ""
    lines = [f"{payload['frames']} frames{with_it} as {format}: {payload['output']}", *payload["notes"]]
    return finish(as_json, payload, lines, ())


@app.command("import")
def import_(
    context: typer.Context,
    source: Annotated[
        Path, typer.Argument(help="file of `mitsim export`, or frames: a folder of them, or one file", metavar="SOURCE")
    ],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="run folder to make", metavar="RUN")] = None,
    calibration_output: Annotated[
        Path | None, typer.Option(help="folder to make of the file's calibration", metavar="CAL")
    ] = None,
    patterns: Annotated[
        str | None, typer.Option(help="of frames: the family, or patterns.json of export", metavar="NAME|FILE")
    ] = None,
    camera: Annotated[
        str | None, typer.Option(help="of frames: camera electronics, name or TOML file", metavar="NAME|FILE")
    ] = None,
    exposure: Annotated[float | None, typer.Option(help="of frames: seconds of each", metavar="SECONDS")] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="of frames: calibration of the same camera, for its identity", metavar="CAL")
    ] = None,
    projector_pixels: Annotated[
        int | None, typer.Option(help="of frames: projector pixels a side, without a calibration", metavar="N")
    ] = None,
    black_level: Annotated[
        float | None, typer.Option(help="of frames: number of a pixel without charge; the camera's if not given")
    ] = None,
    ambient_frame: Annotated[
        Path | None, typer.Option(help="frame, or folder of frames, with the projector off", metavar="PATH")
    ] = None,
    ambient_shots: Annotated[
        int | None, typer.Option(help="shots that a single such frame is the mean of", metavar="N")
    ] = None,
    shape: Annotated[
        str | None, typer.Option(help="of files without header (.raw, .bin, .dat)", metavar="ROWSxCOLUMNS")
    ] = None,
    bits: Annotated[int | None, typer.Option(help="of a number in such a file", metavar="N")] = None,
    byte_order: Annotated[str, typer.Option(help="of such a file: little or big")] = "little",
    channel: Annotated[
        str | None, typer.Option(help="plane of a colour sensor, as FlatCam names it", metavar="r|gb|gr|b")
    ] = None,
    seed: Seed = 0,
    variant: Variant = DEFAULT_VARIANT,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Make a run folder of a real camera's frames, or of a file that `mitsim export` wrote."""
    from mitsim.exchange.formats import READERS, import_file

    if output is None and calibration_output is None:
        raise MitsimError("import: nothing to make; give -o RUN, --calibration-output CAL, or both")
    payload: dict[str, Any]
    of_frames = patterns, camera, exposure
    if source.suffix.lower() in READERS:
        refuse_unused(context, _OF_FRAMES, f"on {source}, which says itself what its frames are")
        payload = import_file(source, output, calibration_output, channel)
    else:
        from mitsim.core.imagelist import BARE, Raw
        from mitsim.exchange.real_capture import RealCapture

        if output is None or calibration_output is not None:
            raise MitsimError(f"{source}: frames hold no calibration; give -o RUN, and no --calibration-output")
        for name, value in zip(("patterns", "camera", "exposure"), of_frames, strict=True):
            if value is None:
                raise ArgumentError(name, "is not given, and frames do not say it; give it")
        if patterns is None or camera is None or exposure is None:
            raise AssertionError  # refused above
        bare = any(path.suffix.lower() in BARE for path in (source, *(source.iterdir() if source.is_dir() else ())))
        if shape is None or not bare:
            refuse_unused(context, _OF_BARE, "on files that have a header, or without --shape")
        if not takes_seed(patterns):
            refuse_unused(context, ["seed"], "on patterns that are not drawn at random")
        raw = None if shape is None else Raw.of(shape, bits, byte_order)
        more = calibration, projector_pixels, black_level, ambient_frame, ambient_shots, raw, channel, seed
        known = RealCapture(patterns, camera, exposure, *more)
        known.check(source)  # refused before numpy is imported
        from mitsim.exchange.real import import_frames

        payload = import_frames(source, output, known)
    lines = []
    if payload["output"]:
        lines.append(f"{payload['frames']} frames: {payload['output']}")
    if payload["calibration_output"]:
        lines.append(f"calibration: {payload['calibration_output']}")
    elif "calibration" in payload["holds"]:
        lines.append("The file holds a calibration too; give --calibration-output to have it")
    if payload["left_out"]:
        lines.append(f"Not known, and left out: {', '.join(payload['left_out'])}")
    return finish(as_json, payload, lines, payload["warnings"])


@app.command()
def patterns(
    context: typer.Context,
    family: Annotated[
        str, typer.Argument(help=f"{pattern_names()}; or stripes, those of a calibration", metavar="PATTERNS|stripes")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="folder to make", metavar="DIR")],
    projector: Annotated[
        str, typer.Option(help="projector of known rows and columns: name or TOML file", metavar="NAME|FILE")
    ] = "mp_cl1",
    projector_pixels: Annotated[
        int, typer.Option(min=1, max=4096, help="projector pixels a side of the patterns", metavar="N")
    ] = 128,
    camera: Annotated[
        str | None, typer.Option(help="of stripes: camera electronics, name or TOML file", metavar="NAME|FILE")
    ] = None,
    exposure: Annotated[float | None, typer.Option(help="of stripes: seconds of each frame", metavar="SECONDS")] = None,
    signed_capture: Annotated[
        str, typer.Option(help="of stripes: both halves of each, or one and a uniform frame", metavar="pair|uniform")
    ] = "pair",
    seed: Seed = 0,
    variant: Variant = DEFAULT_VARIANT,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Draw patterns, or a calibration's stripes, as pictures to show on a real projector."""
    check_root(seed)
    if family != "stripes":
        read_name(family, projector_pixels)  # refused before numpy is imported
    from mitsim.exchange.png_files import SESSION, describe_cells, draw_family, draw_stripes, session_of

    if family != "stripes":
        refuse_unused(context, ["signed_capture"], "on patterns, whose signed ones are pairs; it is for stripes")
    if not takes_seed(family):
        refuse_unused(context, ["seed"], "on patterns that are not drawn at random")
    of_stripes = {"camera": camera, "exposure": exposure}
    if family == "stripes":
        for name, value in of_stripes.items():
            if value is None:
                raise ArgumentError(name, "is not given, and the list of a calibration's frames needs it; give it")
        if camera is None or exposure is None:
            raise AssertionError  # refused above
        listed = session_of(camera, exposure, projector_pixels, signed_capture)
        payload = {**draw_stripes(output, projector, listed), "session": str(output / SESSION)}
        after = (
            f"Copy {output / SESSION} into the folder of their frames; then: mitsim calibrate --frames FRAMES -o CAL"
        )
    else:
        for name, value in of_stripes.items():
            if value is not None:
                raise ArgumentError(name, f"{value}: goes with stripes; give it to `mitsim import`")
        payload = {**draw_family(output, family, projector_pixels, projector, seed), "session": None}
        after = f"Their frames are read by: mitsim import FRAMES --patterns {output / 'patterns.json'} -o RUN"
    where = payload["projector"]
    lines = [
        f"{payload['pictures']} pictures of {where['rows']}x{where['columns']}, {payload['n']}x{payload['n']} cells of "
        f"{describe_cells(where)}: {output}",
        after,
    ]
    return finish(as_json, payload, lines, ())


@app.command()
def transport(
    scene: Scene,
    output: Annotated[Path, typer.Option("-o", "--output", help="HDF5 file to make", metavar="FILE.h5")],
    patterns: Patterns = "dots:7",
    accuracy: AccuracyOrSeconds = None,
    seconds: Seconds = None,
    camera: Camera = None,
    projector: Projector = None,
    effects: Effects = "",
    seed: Seed = 0,
    define: Defines = None,
    outside: Outside = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the file")] = False,
    variant: Variant = DEFAULT_VARIANT,
    max_seconds: MaxSeconds = DAY,
    max_memory: MaxMemory = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Trace a scene's light by projector pixel and write it, for frames of any pattern without mitsim."""
    from mitsim.core.configuration import locate
    from mitsim.core.files import check_apart, output_file

    request = request_of(patterns=patterns, accuracy=accuracy, seconds=seconds, seed=seed, effects=effects)
    check_shown([patterns], scene, define, outside)
    with job_of(quiet or as_json, max_seconds, max_memory) as job, output_file(output, overwrite) as output:
        with job.clock.stage("open scene"):
            bench = bench_of(scene, variant, camera, projector, define, outside)
        devices = (locate(each, "calibration", ".toml") for each in (camera, projector) if each)
        check_apart(output, (*bench.loaded.files, *devices))
        light = bench.light(request.pop("patterns"), job, **request)
        with job.clock.stage("write"):
            light.save(output)
    size = output.stat().st_size
    payload = {**light.summary(), "bytes": size, "seconds": job.clock.seconds(), "output": str(output)}
    shape, taken = payload["shape"], payload["seconds"]
    lines = [
        f"Light of {payload['n']}x{payload['n']} projector pixels to {shape[0]}x{shape[1]} of the sensor in "
        f"{taken['total']:.1f} s, {payload['entries']} numbers, {size / 2**20:.3g} MiB: {output}",
        f"Monte Carlo error {payload['mc_error']:.1e} of the frames of {patterns}, total error up to "
        f"{payload['total_error_bound']:.1e}",
    ]
    return finish(as_json, payload, lines, payload["warnings"])
