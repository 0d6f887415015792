"""`mitsim reconstruct`: folders of a run and a calibration in; what the terminal shows of their image out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from mitsim.cli.colour import mosaic_options, reconstruct_lines
from mitsim.cli.options import Json, Quiet, Variant, number_of
from mitsim.cli.screen import finish
from mitsim.core.environment import DEFAULT_VARIANT
from mitsim.core.errors import ArgumentError, MitsimError

app = typer.Typer()


@app.command()
def reconstruct(
    run: Annotated[Path, typer.Argument(help="folder of `mitsim capture`", metavar="RUN")],
    calibration: Annotated[Path, typer.Option(help="folder of `mitsim calibrate`", metavar="CAL")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="folder for the image; RUN/reconstruction if not given")
    ] = None,
    lam: Annotated[str, typer.Option("--lambda", help="regularisation, or auto", metavar="auto|VALUE")] = "auto",
    method: Annotated[
        str, typer.Option(help="tikhonov, markov (neighbouring pixels alike: for noisy frames) or tv")
    ] = "tikhonov",
    focus: Annotated[
        str | None,
        typer.Option(
            help="depth of the scene; auto: found; map: one for each pixel, by dots; the calibrated one if not given",
            metavar="auto|MM|map",
        ),
    ] = None,
    depth_range: Annotated[
        str | None,
        typer.Option(
            "--depth-range",
            help="nearest and farthest depth that auto and map look for; 1/z within a quarter of the calibrated one's "
            "if not given",
            metavar="A:B",
        ),
    ] = None,
    margin: Annotated[
        int,
        typer.Option(
            min=0,
            help="cells round the window that are solved for too: they take up light from outside it",
            metavar="K",
        ),
    ] = 0,
    chart: Annotated[
        str | None,
        typer.Option(
            help="of a coloured run: the chart in the image that colours are fitted on, a scene's name or a file",
            metavar="NAME|FILE.json",
        ),
    ] = None,
    mosaic: Annotated[
        str | None,
        typer.Option(
            help="of a run behind colour filters: how its images are found",
            metavar="joint|half|demosaic",
            show_default="joint",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace an earlier image in the folder")] = False,
    variant: Variant = DEFAULT_VARIANT,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Recover the image from frames and a calibration alone; of coloured folders, one of each line, and in colour."""
    from mitsim.core.files import check_output
    from mitsim.core.manifests import CalibrationManifest, RunManifest, read_manifest
    from mitsim.core.spectral_manifests import JOINT, is_coloured, is_mosaic
    from mitsim.reconstruct.request import IMAGE_FILE, ImageRequest, check_parallax

    strength = number_of("lambda", lam)
    depth = None if focus is None else number_of("focus", focus, ("auto", "map"))
    limits = None if depth_range is None else _two_depths(depth_range)
    place: dict[str, Any] = {"focus": depth, "margin": margin, "depth_range": limits}
    output = output or run / "reconstruction"
    if not is_mosaic(run):
        ImageRequest(strength, method, depth, margin, limits)
    if is_coloured(run):
        options = {"lam": strength, "method": method, "overwrite": overwrite, **place}
        if is_mosaic(run):
            options = mosaic_options(options, mosaic or JOINT)
        elif mosaic is not None:
            raise MitsimError(f"--mosaic {mosaic}: {run} has a run for each line; leave out --mosaic")
        return reconstruct_lines(run, calibration, output, chart, options, as_json)
    for option, value in (("--chart", chart), ("--mosaic", mosaic)):
        if value is not None:
            raise MitsimError(f"{option} {value}: {run} is not coloured; leave out {option}")
    # Refused before the solver is imported, which takes half a second.
    read_manifest(run, RunManifest)
    manifest = read_manifest(calibration, CalibrationManifest)
    if depth is not None or margin:
        check_parallax(manifest.parallax, str(calibration))
    check_output(output, overwrite=(output / IMAGE_FILE).is_file())
    from mitsim.core.resources import memory_from_here, memory_since
    from mitsim.report.quality import reconstruct as reconstruct_folder

    held = memory_from_here()
    result = reconstruct_folder(run, calibration, output, strength, method, overwrite, **place)
    payload = {**result.summary(), "memory_bytes": memory_since(held)}
    lines = [payload["status"]]
    if result.quality is not None:
        lines.append(str(result.quality))
    lines.append(
        f"lambda {payload['lambda']:.3g}, rank {payload['rank']}, condition {payload['condition_whole']:.3g}, "
        f"residual {payload['residual']:.1e}: {payload['output']}"
    )
    if result.reconstruction.focus is not None:
        lines.append(str(result.reconstruction.focus))
    lines += result.reconstruction.trust
    return finish(as_json, payload, lines, () if result.reconstruction.ok else (payload["status"],))


def _two_depths(text: str) -> tuple[float, float]:
    """The two numbers of A:B."""
    near, colon, far = text.partition(":")
    try:
        if colon:
            return float(near), float(far)
    except ValueError:
        pass
    raise ArgumentError("depth_range", f"{text!r}: give the nearest and the farthest depth [mm], such as 350:450")
