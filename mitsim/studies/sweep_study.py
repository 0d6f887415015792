"""Any knob swept: scene parameters, patterns, exposure and accuracy over lists of values; any measure of the images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from mitsim.core.configuration import locate, scene_parameters
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import short_name
from mitsim.report import EQUAL_PEAK, RENDERED
from mitsim.studies.framework import experiment
from mitsim.studies.framework.claims import distinct
from mitsim.studies.framework.panels import Images, Lines, Panel, Part, Pivot, is_number
from mitsim.studies.framework.studio import measure_image

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _points(scope: experiment.Scope) -> Sequence[experiment.Point]:
    experiment.check_sweep(scope.sweep, len(scope.pictures) * len(scope.seeds))
    knobs: dict[str, Any] = dict(scope.sweep)
    values = {"patterns": (scope.patterns,), "exposure": (EQUAL_PEAK,)}
    values |= {name: knobs[name] for name in ("patterns", "exposure", "method", experiment.ASKED) if name in knobs}
    scene = {name: each for name, each in knobs.items() if name not in experiment.NO_SCENE}
    own = replace(scope, seeds=tuple(int(each) for each in knobs.get("seed", scope.seeds)))
    points = []
    for accuracy in knobs.get("accuracy", (None,)):
        setup = replace(scope.setup, accuracy=experiment.number_of("accuracy", accuracy)) if accuracy else scope.setup
        varied = {"accuracy": (accuracy,), **values} if accuracy else values
        points += experiment.Axes({"model": (RENDERED,), **varied}, scene)(replace(own, setup=setup))
    return points


def _knobs(results: experiment.Results) -> list[str]:
    knobs = list(dict(results.scope.sweep))
    return [name for name in knobs if len(distinct(results.frame, name)) > 1] or knobs[:1]


def _bars(scope: experiment.Scope) -> str:
    """Return the meaning of the bars; nothing if each mean is of one image."""
    prints, seeds = len(scope.pictures), len(scope.seeds)
    of = f"{prints} pictures" if prints > 1 else f"{seeds} seeds"
    return f"95 % interval of {of}" if prints * seeds > 1 else ""


def _axis(scope: experiment.Scope, knob: str) -> str:
    """Return the name of an axis: the parameter, and its meaning and unit as the scene file's comment states them."""
    if knob in experiment.NO_SCENE:
        return experiment.MEASURES["lambda"][1] if knob == experiment.ASKED else f"{knob} [1]"
    known: dict[str, str] = {}
    with suppress(OSError, MitsimError):  # parts may be merged where the scene is not
        found = scene_parameters(locate(scope.setup.scene, "scenes", "scene.xml"))
        known = {text.partition("=")[0]: words.replace("$", r"\$") for text, words in found}
    return f"{knob} [{known.get(knob) or 'as in the scene file'}]"


def _panels(results: experiment.Results) -> Mapping[str, Figure]:
    first, *others = knobs = _knobs(results)
    values = [(knob, each) for knob in knobs for each in distinct(results.frame, knob)]
    names: dict[Any, str] = {
        (knob, each): f"{knob.removeprefix('asked_')} {short_name(f'{each}')}" for knob, each in values
    }
    seeds, bars = results.scope.seeds, _bars(results.scope)
    title = f"Images by {' and '.join(knobs)}{f', seed {seeds[0]}' if len(seeds) > 1 else ''}"
    panels: list[Panel] = [Images(first, title=title, down=("picture", *others), names=names | {None: ""})]
    numeric = [knob for knob in knobs if all(map(is_number, distinct(results.frame, knob)))]
    for measure in results.scope.measures if numeric else ():
        (column, axis), x = experiment.MEASURES[measure], numeric[0]
        panels.append(
            Lines(x, _axis(results.scope, x), file=measure, y=column, y_label=axis, names=names, facet="",
                  colour=[knob for knob in knobs if knob != x], interval=True, title=f"Mean and {bars}" if bars else "")
        )  # fmt: skip
    return {file: figure for panel in panels for file, figure in panel.draw(results).items()}


def _table(results: experiment.Results) -> Sequence[Part]:
    shown = {name: experiment.MEASURES[name] for name in results.scope.measures}
    columns = {column: f"{name.replace('_', '-')} {axis.rpartition(' ')[2]}" for name, (column, axis) in shown.items()}
    names = {(knob, each): short_name(str(each)) for knob in _knobs(results) for each in distinct(results.frame, knob)}
    bars = _bars(results.scope)
    title = f"Measures by setting{f': mean +- {bars}' if bars else ''}"
    table = Pivot(_knobs(results), columns=columns, title=title, names=names, interval=True)
    return [*table.draw(results).values()]


STUDY = experiment.Study(
    "sweep",
    f"Sweep of {experiment.KNOBS}",
    "What does each value do to the image?",
    points=_points,
    measure=measure_image,
    panels=(_panels,),
    tables=(_table,),
    about="Rendered frames with the sensor's noise, exposed at equal peak unless the exposure varies (the brightest "
    "pixel fills the same part of the full well), and the images that mitsim reconstruct makes of them, with "
    "factors calibrated by a session of the same camera. Parameters have the names and units of the scene file, "
    "where lengths are in mm. Each further seed draws noise, calibration and random patterns anew, in light that is "
    "traced once. After +- and as bars: the 95 % confidence interval of the mean (Student's t).",
)
