"""Any knob swept: scene parameters, patterns, exposure and accuracy over lists of values; any measure of the images."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from mitsim.core.configuration import locate
from mitsim.core.errors import MitsimError
from mitsim.report import EQUAL_PEAK, RENDERED
from mitsim.studies.framework.claims import distinct, mean_of
from mitsim.studies.framework.experiment import (
    KNOBS,
    MEASURES,
    NO_SCENE,
    Axes,
    Point,
    Results,
    Scope,
    Setup,
    Study,
    check_sweep,
    number_of,
)  # fmt: skip
from mitsim.studies.framework.panels import Images, Lines, Panel, Part, Pivot, is_number
from mitsim.studies.framework.studio import measure_image

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _points(scope: Scope) -> Sequence[Point]:
    check_sweep(scope.sweep, len(scope.pictures))
    knobs: dict[str, Any] = dict(scope.sweep)
    values = {"patterns": (scope.patterns,), "exposure": (EQUAL_PEAK,)}
    values |= {name: knobs[name] for name in ("patterns", "exposure", "method") if name in knobs}
    scene = {name: each for name, each in knobs.items() if name not in NO_SCENE}
    own = replace(scope, seeds=tuple(int(each) for each in knobs.get("seed", scope.seeds)))
    if "accuracy" not in knobs:
        return Axes({"model": (RENDERED,), **values}, scene)(own)
    points = []
    for accuracy in knobs["accuracy"]:
        setup = replace(scope.setup, accuracy=number_of("accuracy", accuracy))
        points += Axes({"model": (RENDERED,), "accuracy": (accuracy,), **values}, scene)(replace(own, setup=setup))
    return points


def axis_of(setup: Setup, knob: str) -> tuple[str, str]:
    """Return the name of a knob with its unit, and its meaning, from the comment beside its ``<default>``.

    A unit is first in the comment, or in square brackets.
    """
    if knob in NO_SCENE:
        own = {"accuracy": "relative rms error of the light [1]", "seed": "of the noise [1]"}
        return knob, own.get(knob, "")
    try:
        text = locate(setup.scene, "scenes", "scene.xml").read_text(encoding="utf-8", errors="replace")
    except (OSError, MitsimError):  # parts may be merged where the scene is not
        text = ""
    found = re.search(rf'<default\s+name="{re.escape(knob)}"[^>]*>\s*<!--(.*?)-->', text, re.DOTALL)
    comment = " ".join(found[1].split()) if found else ""
    pattern = r"^(mm|um|degrees)\b,?\s*|\s*\[([^]]+)\]"
    unit, meaning = re.search(pattern, comment), re.sub(r"(, see| \().*", "", re.sub(pattern, "", comment, count=1))
    return (f"{knob} [{unit[1] or unit[2]}]", meaning) if unit else (knob, f"{meaning} [as in the scene file]".lstrip())


def _knobs(results: Results) -> list[str]:
    knobs = list(dict(results.scope.sweep))
    return [name for name in knobs if len(distinct(results.frame, name)) > 1] or knobs[:1]


def _panels(results: Results) -> Mapping[str, Figure]:
    first, *others = knobs = _knobs(results)
    axes = {knob: axis_of(results.scope.setup, knob) for knob in knobs}
    names: dict[Any, str] = {(knob, each): f"{knob} {each}" for knob in knobs for each in distinct(results.frame, knob)}
    title = f"Images by {' and '.join(name for name, _ in axes.values())}"
    panels: list[Panel] = [Images(first, title=title, down=("picture", *others), names=names | {None: ""})]
    numeric = [knob for knob in knobs if all(map(is_number, distinct(results.frame, knob)))]
    for measure in results.scope.measures if numeric else ():
        (column, axis), x = MEASURES[measure], numeric[0]
        panels.append(
            Lines(x, ": ".join(axes[x]), file=measure, y=column, y_label=axis, names=names, facet="",
                  colour=[knob for knob in knobs if knob != x])
        )  # fmt: skip
    return {file: figure for panel in panels for file, figure in panel.draw(results).items()}


def _table(results: Results) -> Sequence[Part]:
    columns = {MEASURES[name][0]: f"{name.replace('_', '-')} {MEASURES[name][1].rpartition(' ')[2]}"
               for name in results.scope.measures}  # fmt: skip
    names = {(knob, each): str(each) for knob in _knobs(results) for each in distinct(results.frame, knob)}
    return Pivot(_knobs(results), columns=columns, title="Measures by setting", names=names).parts_of(results)


def _message(results: Results) -> str:
    parts = Panel(names={(knob, each): f"{knob} {each}" for knob in _knobs(results)
                         for each in distinct(results.frame, knob)}).parts(results.frame, _knobs(results))  # fmt: skip
    levels = {name: mean_of(rows).value for name, (rows, _) in parts.items() if rows["psnr_db"].notna().any()}
    if len(levels) < 2:
        return ""
    best, worst = (choose(levels, key=levels.__getitem__) for choose in (max, min))
    return f"PSNR is highest at {best} ({levels[best]:.1f} dB), lowest at {worst} ({levels[worst]:.1f} dB)"


STUDY = Study(
    "sweep",
    f"Sweep of {KNOBS}",
    "What does each value do to the image?",
    points=_points,
    measure=measure_image,
    panels=(_panels,),
    tables=(_table,),
    message=_message,
    about="Rendered frames with the sensor's noise, exposed at equal peak unless the exposure varies (the brightest "
    "pixel fills the same part of the full well), and the images that mitsim reconstruct makes of them, with "
    "factors calibrated by a session of the same camera. Parameters have the names and units of the scene file, "
    "where lengths are in mm.",
    solved=True,
)
