"""Verbs that exchange runs with other programs and real cameras: words of a command line in, files or folders out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitsim.cli.options import Json, Quiet, Variant
from mitsim.cli.screen import finish
from mitsim.core.environment import DEFAULT_VARIANT
from mitsim.core.errors import MitsimError

app = typer.Typer()


@app.command("export")
def export(
    run: Annotated[Path, typer.Argument(help="folder of `mitsim capture`", metavar="RUN")],
    format: Annotated[str, typer.Option(help="hdf5", metavar="FORMAT")],
    output: Annotated[Path, typer.Option("-o", "--output", help="file to make", metavar="FILE")],
    calibration: Annotated[
        Path | None, typer.Option(help="folder of `mitsim calibrate` that goes with it", metavar="CAL")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the file")] = False,
    variant: Variant = DEFAULT_VARIANT,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Write a run in a format that other programs read."""
    from mitsim.exchange.export import export_run

    payload = export_run(run, format, output, calibration, overwrite)
    with_it = f" with {payload['calibration']}" if payload["calibration"] else ""
    lines = [f"{payload['frames']} frames{with_it} as {format}: {payload['output']}", *payload["notes"]]
    return finish(as_json, payload, lines, ())


@app.command("import")
def import_(
    source: Annotated[Path, typer.Argument(help="file of `mitsim export`", metavar="FILE")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="run folder to make", metavar="RUN")] = None,
    calibration_output: Annotated[
        Path | None, typer.Option(help="folder to make of the file's calibration", metavar="CAL")
    ] = None,
    variant: Variant = DEFAULT_VARIANT,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Make a run folder of a file that `mitsim export` wrote."""
    from mitsim.exchange.load import READERS, import_file

    if output is None and calibration_output is None:
        raise MitsimError("import: nothing to make; give -o RUN, --calibration-output CAL, or both")
    if source.suffix.lower() not in READERS:
        raise MitsimError(f"{source}: is no file that is read; give one that ends in {', '.join(READERS)}")
    payload = import_file(source, output, calibration_output)
    lines = []
    if payload["output"]:
        lines.append(f"{payload['frames']} frames: {payload['output']}")
    if payload["calibration_output"]:
        lines.append(f"calibration: {payload['calibration_output']}")
    elif "calibration" in payload["holds"]:
        lines.append("The file holds a calibration too; give --calibration-output to have it")
    if payload["left_out"]:
        lines.append(f"Not in the file, and left out: {', '.join(payload['left_out'])}")
    return finish(as_json, payload, lines, ())
