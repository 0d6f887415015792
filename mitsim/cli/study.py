"""`mitsim study`: a study's name and scenes in; what the terminal shows of its results out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

import mitsim
from mitsim.cli.options import (
    MAIN_MEASURE,
    MAIN_PATTERNS,
    Camera,
    Defines,
    Json,
    Outside,
    Patterns,
    Projector,
    Quiet,
    Seed,
    Variant,
    bench_of,
    check_camera,
    check_setup,
    check_shown,
    job_of,
    recipe_for,
    refuse_unused,
    scope_of,
    swept,
)
from mitsim.cli.screen import finish
from mitsim.core.environment import DEFAULT_VARIANT
from mitsim.core.errors import MitsimError

app = typer.Typer()

_OF_MERGE = ("name", "scenes", "output", "experiment", "variant", "as_json", "quiet")
"""Parameters that `mitsim study merge` has."""
_OF_SCENES = ("patterns", "camera", "projector", "define", "outside")
"""Those of studies of a scene."""
_WHOLE = "1/1"
"""The only part of a study that is not shared."""


@app.command()
def study(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="of the study, or merge", metavar="NAME")],
    scenes: Annotated[
        list[str] | None,
        typer.Argument(help="scene XML, or the name of a shipped scene; of merge, folders", metavar="[SCENE]"),
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="folder of the study")] = Path("study-output"),
    patterns: Patterns = MAIN_PATTERNS,
    seed: Seed = 0,
    camera: Camera = None,
    projector: Projector = None,
    define: Defines = None,
    outside: Outside = False,
    quick: Annotated[bool, typer.Option("--quick", help="a few points, for a first look")] = False,
    shard: Annotated[str, typer.Option(help="measure part I of N of the points", metavar="I/N")] = _WHOLE,
    jobs: Annotated[int | None, typer.Option(help="processes; one a processor if not given")] = None,
    scheduler: Annotated[str | None, typer.Option(help="Dask scheduler that measures the points")] = None,
    over: Annotated[
        list[str] | None, typer.Option(help="what sweep varies; may be given again", metavar="NAME=FIRST:LAST:COUNT")
    ] = None,
    measure: Annotated[str, typer.Option(help="what sweep shows: psnr, ssim, misfit, ...")] = MAIN_MEASURE,
    recipe: Annotated[
        Path | None, typer.Option(help="of calibration and drift: session recipe", metavar="FILE.toml")
    ] = None,
    experiment: Annotated[
        str | None, typer.Option(help="of merge: the module, where the study is one of your own", metavar="MODULE")
    ] = None,
    variant: Variant = DEFAULT_VARIANT,
    as_json: Json = False,
    quiet: Quiet = False,
) -> int:
    """An experiment with figures, CSV and JSON: the paper's, on rendered frames (patterns, distance, or all); `colour`
    of a ColorChecker; what `drift` between calibration and capture costs; `models` of a calibration; `sweep` of any
    knob; what `accuracy` costs in time, on a scene and, of none, in the `solver`; what `diffraction` at the mask does;
    how good a `calibration` session is, and why; `merge` joins the parts of --shard.
    """
    from mitsim.studies import EXPOSED, OF_NO_SCENE
    from mitsim.studies.framework.experiment import is_experiment
    from mitsim.studies.framework.run import check_study_folder, find_study

    if name == "merge":
        others = [each for each in context.params if each not in _OF_MERGE]
        refuse_unused(context, others, "on parts, which say themselves what they are of")
    else:
        refuse_unused(context, ["experiment"], "but with merge; give the module as the study's NAME")
    session, request = recipe_for(name, recipe), mitsim.Request.of(patterns=patterns, seed=seed)
    warnings: Sequence[str] = ()
    with job_of(quiet or as_json) as job:
        if name == "merge":
            from mitsim.studies.framework.campaign import merge

            result: Any = merge(scenes or (), output, experiment)
        elif is_experiment(name):
            from mitsim.studies.framework.campaign import Where, run_experiment
            from mitsim.studies.framework.run import Shard

            scope = scope_of(_only(scenes), variant, camera, projector, define, outside, quick)
            scope = swept(name, replace(scope, seeds=(seed,)), patterns, over or (), measure)
            if name not in ("sweep", "drift"):
                refuse_unused(context, ["patterns"], f"on the study {name}, which has its own")
            scope = replace(scope, recipe=str(recipe) if recipe else None)
            if scheduler is not None:
                refuse_unused(context, ["jobs"], "with --scheduler, whose machines have processes of their own")
            where = Where(Shard.of(shard), jobs, scheduler)
            check_setup(scope, _only(scenes))
            result = run_experiment(name, scope, output, job, where)
        else:
            run_study = find_study(name, **({"recipe": session} if session else {}))
            if over or measure != MAIN_MEASURE or (shard, jobs, scheduler) != (_WHOLE, None, None):
                raise MitsimError(
                    f"study {name}: is measured whole, here; leave out --over, --measure, --shard, --jobs, --scheduler"
                )
            refuse_unused(context, ["quick"], f"on the study {name}, which has no points to leave out")
            bench = None
            if name in OF_NO_SCENE:
                if scenes:
                    raise MitsimError(f"study {name} {' '.join(scenes)}: it is of no scene; leave the scene out")
                refuse_unused(context, _OF_SCENES, f"on the study {name}, which is of no scene")
            else:
                check_study_folder(output, name)
                if name in EXPOSED:
                    check_camera(camera, request.timing)
                check_shown([patterns], _only(scenes) or "photograph", define, outside)
                with job.clock.stage("open scene"):
                    bench = bench_of(_only(scenes) or "photograph", variant, camera, projector, define, outside)
            result = run_study(bench, output, request, job)
            warnings = result.warnings
    return finish(as_json, result.payload(), result.lines(), warnings)


def _only(scenes: list[str] | None) -> str | None:
    """The scene that is studied, where one is given; MitsimError for several."""
    if scenes and len(scenes) > 1:
        raise MitsimError(f"{' '.join(scenes)}: give one scene")
    return scenes[0] if scenes else None
