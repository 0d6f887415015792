"""`mitsim study`: a study's name and scenes in; what the terminal shows of its results out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

import mitsim
from mitsim.cli.help_page import LIMITS, OUTPUT, QUALITY, WHAT
from mitsim.cli.options import Common, Devices, Patterns, Seed, complete_scene, completing, is_given, option, verb
from mitsim.cli.screen import finish
from mitsim.studies import ALL, EXPERIMENTS, STUDIES


@dataclass(frozen=True)
class Points:
    """What a study varies, and who measures which of its points."""

    PANEL = LIMITS

    quick: bool = option(False, "a few points, for a first look", "--quick", rich_help_panel=QUALITY)
    shard: str = option("1/1", "measure part I of N of the points", metavar="I/N")
    jobs: int | None = option(None, "processes; one a processor if not given")
    scheduler: str | None = option(None, "Dask scheduler that measures the points", metavar="ADDRESS")
    over: list[str] | None = option(
        None,
        "what sweep varies: a parameter of the scene, patterns, exposure, seed, accuracy, method; FIRST:LAST:COUNT or "
        "VALUE,VALUE; may be given again",
        metavar="NAME=VALUES",
        rich_help_panel=WHAT,
    )
    measure: str = option("psnr", "what sweep shows: psnr, ssim, misfit, ...", metavar="NAME,...", rich_help_panel=WHAT)


@dataclass(frozen=True)
class Studied:
    """What frames a study is of, and where it goes."""

    PANEL = WHAT

    output: Path = option(
        Path("study-output"), "folder of the study", "-o", "--output", metavar="DIR", rich_help_panel=OUTPUT
    )
    patterns: Patterns = "dots:7"
    seed: Seed = 0
    recipe: Path | None = option(None, "of calibration and drift: session recipe", metavar="FILE.toml")
    data: Path | None = option(None, "of twin and transfer: folder of real captures", metavar="DIR")
    experiment: str | None = option(None, "of merge: the module, where the study is one of your own", metavar="MODULE")


@verb
def study(
    *,
    context: typer.Context,
    name: Annotated[
        str,
        typer.Argument(
            help="of the study, all or merge; of one of your own its file, or its module with a dot",
            metavar="NAME",
            autocompletion=completing(lambda: (*EXPERIMENTS, *STUDIES, ALL, "merge")),
        ),
    ],
    scenes: Annotated[
        list[str] | None,
        typer.Argument(
            help="scene XML, or the name of a shipped scene; of merge, folders",
            metavar="[SCENE]",
            autocompletion=complete_scene,
        ),
    ] = None,
    studied: Studied,
    devices: Devices,
    points: Points,
    common: Common,
) -> int:
    """An experiment with figures, CSV and JSON.

    `mitsim list studies` says what each is for; all is those of the paper on one page, and merge joins the parts of
    --shard. One of your own is a file, or a module named with a dot.

    $ mitsim study patterns -o patterns --quick
    $ mitsim study sweep photograph --over sheet_z=395,400 --over accuracy=0.03
    $ mitsim study accuracy cookie_bag -o accuracy
    """
    named = {"parameters": "define", "allow_outside_files": "outside"}
    words = {**vars(studied), **vars(points), **devices.arguments, "variant": common.variant}
    options = {each: value for each, value in words.items() if is_given(context, named.get(each, each))}
    with common.job() as job:
        result = mitsim.study(name, scenes, **{**options, "output": studied.output}, job=job)
    return finish(common.as_json, result.payload(), result.lines(), result.warnings)
