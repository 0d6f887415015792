"""`mitsim study`: a study's name and scenes in; what the terminal shows of its results out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import mitsim
from mitsim.cli.help_page import LIMITS, OUTPUT, QUALITY, WHAT
from mitsim.cli.options import Common, Devices, Patterns, Seed, complete_scene, completing, option, refuse_unused, verb
from mitsim.cli.screen import finish
from mitsim.core.errors import MitsimError
from mitsim.studies import ALL, EXPERIMENTS, STUDIES

if TYPE_CHECKING:
    from mitsim.devices.session import SessionRecipe
    from mitsim.studies.framework.experiment import Scope

_MAIN_PATTERNS, _MAIN_MEASURE = "dots:7", "psnr"
"""What is studied where nothing is said."""
_OF_MERGE = ("name", "scenes", "output", "experiment", "variant", "as_json", "quiet")
"""Parameters that `mitsim study merge` has."""
_OF_SCENES = ("patterns", "camera", "projector", "define", "outside")
"""Those of studies of a scene."""
_WHOLE = "1/1"
"""The only part of a study that is not shared."""


@dataclass(frozen=True)
class Points:
    """What a study varies, and who measures which of its points."""

    PANEL = LIMITS

    quick: bool = option(False, "a few points, for a first look", "--quick", rich_help_panel=QUALITY)
    shard: str = option(_WHOLE, "measure part I of N of the points", metavar="I/N")
    jobs: int | None = option(None, "processes; one a processor if not given")
    scheduler: str | None = option(None, "Dask scheduler that measures the points", metavar="ADDRESS")
    over: list[str] | None = option(
        None, "what sweep varies; may be given again", metavar="NAME=FIRST:LAST:COUNT", rich_help_panel=WHAT
    )
    measure: str = option(
        _MAIN_MEASURE, "what sweep shows: psnr, ssim, misfit, ...", metavar="NAME,...", rich_help_panel=WHAT
    )

    @property
    def are_main(self) -> bool:
        """Whether all of them are measured, here, as the study has them."""
        return replace(self, quick=False, over=self.over or None) == Points()


@dataclass(frozen=True)
class Studied:
    """What frames a study is of, and where it goes."""

    PANEL = WHAT

    output: Path = option(
        Path("study-output"), "folder of the study", "-o", "--output", metavar="DIR", rich_help_panel=OUTPUT
    )
    patterns: Patterns = _MAIN_PATTERNS
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
    --shard. One of your own is a module, named with a dot.

    $ mitsim study patterns -o patterns --quick
    $ mitsim study sweep photograph -o sweep --over sheet_z=390:410:5
    $ mitsim study accuracy cookie_bag -o accuracy
    """
    from mitsim.studies import EXPOSED, OF_CAPTURES, OF_NO_SCENE
    from mitsim.studies.framework.experiment import is_experiment
    from mitsim.studies.framework.run import check_study_folder, find_study

    if name == "merge":
        others = [each for each in context.params if each not in _OF_MERGE]
        refuse_unused(context, others, "on parts, which say themselves what they are of")
    else:
        refuse_unused(context, ["experiment"], "but with merge; give the module as the study's NAME")
    if name not in OF_CAPTURES:
        refuse_unused(context, ["data"], f"but on the studies {' and '.join(OF_CAPTURES)}")
    session, request = recipe_for(name, studied.recipe), mitsim.Request.of(patterns=studied.patterns, seed=studied.seed)
    warnings: Sequence[str] = ()
    with common.job() as job:
        if name == "merge":
            from mitsim.studies.framework.campaign import merge

            result: Any = merge(scenes or (), studied.output, studied.experiment)
        elif is_experiment(name):
            from mitsim.studies.framework.campaign import Where, run_experiment
            from mitsim.studies.framework.run import Shard

            scope = replace(_scope(_only(scenes), devices, common.variant, points.quick), seeds=(studied.seed,))
            scope = scope_of(name, scope, studied.patterns, points.over or (), points.measure)
            if name not in ("sweep", "drift"):
                refuse_unused(context, ["patterns"], f"on the study {name}, which has its own")
            scope = replace(scope, recipe=str(studied.recipe) if studied.recipe else None)
            if points.scheduler is not None:
                refuse_unused(context, ["jobs"], "with --scheduler, whose machines have processes of their own")
            where = Where(Shard.of(points.shard), points.jobs, points.scheduler)
            _check_setup(scope, _only(scenes))
            result = run_experiment(name, scope, studied.output, job, where)
        else:
            settings: dict[str, Any] = {"recipe": session} if session else {}
            if name in OF_CAPTURES:
                from mitsim.studies.twin_files import TwinFiles

                settings = {"files": TwinFiles.find(studied.data, name)}
                settings |= {"variant": common.variant} if name == "twin" else {}
            run_study = find_study(name, **settings)
            if not points.are_main:
                raise MitsimError(
                    f"study {name}: is measured whole, here; leave out --over, --measure, --shard, --jobs, --scheduler"
                )
            refuse_unused(context, ["quick"], f"on the study {name}, which has no points to leave out")
            bench = None
            if name in OF_NO_SCENE:
                if scenes:
                    raise MitsimError(f"study {name} {' '.join(scenes)}: it is of no scene; leave the scene out")
                refuse_unused(context, _OF_SCENES, f"on the study {name}, which is of no scene")
                check_study_folder(studied.output, name)
            else:
                check_study_folder(studied.output, name)
                if name in EXPOSED:
                    devices.check_exposure(request.timing)
                scene = _only(scenes) or "photograph"
                devices.check(scene, studied.patterns)
                bench = devices.open(scene, common.variant, job)
            result = run_study(bench, studied.output, request, job)
            warnings = result.warnings
    return finish(common.as_json, result.payload(), result.lines(), warnings)


def _only(scenes: list[str] | None) -> str | None:
    """The scene that is studied, where one is given; MitsimError for several."""
    if scenes and len(scenes) > 1:
        raise MitsimError(f"{' '.join(scenes)}: give one scene")
    return scenes[0] if scenes else None


def _scope(scene: str | None, devices: Devices, variant: str, quick: bool) -> Scope:
    """How much of a study a command line asks for: eight test images on the photograph's sheet (two, where it is
    ``quick``), or one ``scene``."""
    from mitsim.studies.framework.experiment import QUICK_IMAGES, TEST_IMAGES, Scope, Setup

    parameters = tuple(sorted(devices.parameters.items()))
    where = devices.camera, devices.projector, variant, devices.outside
    pictures: tuple[str | None, ...] = (None,) if scene else QUICK_IMAGES if quick else TEST_IMAGES
    return Scope(Setup(scene or "photograph", None, parameters, *where), pictures, quick=quick)


def scope_of(name: str, scope: Scope, patterns: str, over: Sequence[str], measure: str) -> Scope:
    """The ``scope`` of a study with what a sweep varies and shows; other studies take nothing of it.

    Parameters
    ----------
    name, scope
        of the study.
    patterns, over, measure
        as the options say.

    Raises
    ------
    MitsimError
        for options that the study does not have, or that cannot be read.
    """
    from mitsim.devices.patterns import read_name
    from mitsim.studies.framework.experiment import check_drifts, check_sweep, measures_of, values_of

    varied = tuple(values_of(text) for text in over)
    if name == "sweep":
        check_sweep(varied, len(scope.pictures))
        read_name(patterns)
        return replace(scope, sweep=varied, measures=measures_of(measure), patterns=patterns)
    if name == "drift" and measure == _MAIN_MEASURE:
        check_drifts(varied)
        read_name(patterns)
        return replace(scope, sweep=varied, patterns=patterns)
    if over or patterns != _MAIN_PATTERNS or measure != _MAIN_MEASURE:
        others = "--measure is for sweep, --over and --patterns for drift and sweep"
        raise MitsimError(f"study {name}: has its own points and measures; {others}")
    return scope


def _check_setup(scope: Scope, scene: str | None) -> None:
    """MitsimError where the files that a ``scope`` names cannot be used, before the renderer is imported; a study
    without a ``scene`` of its own may take others."""
    from mitsim.bench.apparatus import check_devices, check_scene
    from mitsim.bench.request import Exposure
    from mitsim.core.configuration import load_model
    from mitsim.devices.sensor import load_sensor
    from mitsim.studies.framework.experiment import NO_SCENE

    camera, projector = check_devices(scope.setup.camera, scope.setup.projector)
    # A study in colour may see through colour filters; all fill a part of the full well.
    Exposure().check(load_sensor(camera).model_copy(update={"mosaic": None}), camera)
    if scene or scope.measures:
        knobs = dict(scope.sweep) if scope.measures else {}
        varied = {name: values[0] for name, values in knobs.items() if name not in NO_SCENE}
        shown = knobs.get("patterns", (scope.patterns,) if scope.measures else ())
        check_scene(scope.setup.scene, {**dict(scope.setup.parameters), **varied}, scope.setup.outside, shown)
    from mitsim.devices.projector import ProjectorModel  # last: it imports numpy

    load_model(projector, ProjectorModel)


def recipe_for(name: str, recipe: Path | None) -> SessionRecipe | None:
    """The session in the file ``recipe`` that the study ``name`` is of, where one is given.

    MitsimError for a study that takes none, and for a file that is no recipe.
    """
    from mitsim.devices.session import load_recipe

    if recipe is None:
        return None
    if name not in ("calibration", "drift"):
        raise MitsimError(f"study {name}: has no session of its own; --recipe is for calibration and drift")
    return load_recipe(recipe)
