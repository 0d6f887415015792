"""`mitsim study`: a study's name and scenes in; what the terminal shows of its results out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

import mitsim
from mitsim.cli.options import Common, Devices, Patterns, Seed, is_given, option, verb
from mitsim.cli.screen import finish


@dataclass(frozen=True)
class Points:
    """What a study varies, and who measures which of its points."""

    quick: bool = option(False, "a few points, for a first look", "--quick")
    shard: str = option("1/1", "measure part I of N of the points", metavar="I/N")
    jobs: int | None = option(None, "processes; one a processor if not given")
    scheduler: str | None = option(None, "Dask scheduler that measures the points")
    over: list[str] | None = option(None, "what sweep varies; may be given again", metavar="NAME=FIRST:LAST:COUNT")
    measure: str = option("psnr", "what sweep shows: psnr, ssim, misfit, ...")


@dataclass(frozen=True)
class Studied:
    """What frames a study is of, and where it goes."""

    output: Path = option(Path("study-output"), "folder of the study", "-o", "--output")
    patterns: Patterns = "dots:7"
    seed: Seed = 0
    recipe: Path | None = option(None, "of calibration and drift: session recipe", metavar="FILE.toml")
    data: Path | None = option(None, "of twin and transfer: folder of real captures", metavar="DIR")
    experiment: str | None = option(None, "of merge: the module, where the study is one of your own", metavar="MODULE")


@verb
def study(
    *,
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="of the study, or merge", metavar="NAME")],
    scenes: Annotated[
        list[str] | None,
        typer.Argument(help="scene XML, or the name of a shipped scene; of merge, folders", metavar="[SCENE]"),
    ] = None,
    studied: Studied,
    devices: Devices,
    points: Points,
    common: Common,
) -> int:
    """An experiment with figures, CSV and JSON: the paper's, on rendered frames (patterns, distance, or all); `colour`
    of a ColorChecker; what `drift` between calibration and capture costs; what `learned` methods gain and lose (needs
    torch, takes hours, not in all); `models` of a calibration; `sweep` of any knob; what `accuracy` costs in time, on a
    scene and, of none, in the `solver`; what `diffraction` at the mask does; how good a `calibration` session is, and
    why; `twin`: real captures beside their simulation; `transfer`: networks of that simulation on them (needs torch);
    `merge` joins the parts of --shard.
    """
    named = {"parameters": "define", "allow_outside_files": "outside"}
    words = {**vars(studied), **vars(points), **devices.arguments, "variant": common.variant}
    options = {each: value for each, value in words.items() if is_given(context, named.get(each, each))}
    with common.job() as job:
        result = mitsim.study(name, scenes, **{**options, "output": studied.output}, job=job)
    return finish(common.as_json, result.payload(), result.lines(), result.warnings)
