"""Any knob swept: scene parameters, patterns, exposure and accuracy over lists of values; any measure of the images."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

from mitsim.core.configuration import locate
from mitsim.core.errors import MitsimError
from mitsim.report import EQUAL_PEAK, RENDERED
from mitsim.report.pages import DASH, Value, scientific
from mitsim.studies.framework.claims import distinct, mean_of
from mitsim.studies.framework.experiment import (
    KNOBS,
    MEASURES,
    NO_SCENE,
    Point,
    Results,
    Scope,
    Setup,
    Study,
    check_sweep,
    group_by_setup,
    number_of,
)
from mitsim.studies.framework.panels import Images, Lines, Panel, Part
from mitsim.studies.framework.studio import measure_image

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame


def _points(scope: Scope) -> Sequence[Point]:
    check_sweep(scope.sweep, len(scope.pictures))
    names, values = [name for name, _ in scope.sweep], [each for _, each in scope.sweep]
    found = []
    for chosen in product(*values):
        setting = dict(zip(names, chosen, strict=True))
        for picture in scope.pictures:
            setup = _setup(scope.setup, setting).with_print(picture)
            fixed: dict[str, Value] = {"patterns": scope.patterns, "exposure": EQUAL_PEAK, "seed": scope.seeds[0]}
            knobs: dict[str, Value] = {name: setting.get(name, other) for name, other in fixed.items()}
            light: dict[str, Value] = {name: setting[name] for name in ("accuracy", "method") if name in setting}
            found.append(Point.of(setup, model=RENDERED, **{**knobs, "seed": int(str(knobs["seed"])), **light}))
    return group_by_setup(found)


def _setup(setup: Setup, setting: Mapping[str, str]) -> Setup:
    parameters = {name: value for name, value in setting.items() if name not in NO_SCENE}
    changed = setup.with_parameters(**parameters)
    return replace(changed, accuracy=number_of("accuracy", setting["accuracy"])) if "accuracy" in setting else changed


# -------- What a sweep shows

_OWN_AXES = {"accuracy": "relative rms error of the light [1]", "seed": "of the noise [1]"}
"""What knobs with numbers are that no scene file has."""
_UNIT = re.compile(r"^(mm|um|degrees)\b,?\s*|\s*\[([^]]+)\]")
"""Where the comment on a parameter has a unit: first, or in square brackets."""
_ASIDE = re.compile(r"(, see| \().*")
"""What such a comment says of the file besides."""


def axis_of(setup: Setup, knob: str) -> tuple[str, str]:
    """Name of a knob with its unit, and what it is; either stands on an axis.

    Parameters
    ----------
    setup
        whose scene file says what a parameter is, in the comment beside its ``<default>``: a unit stands first there,
        or in square brackets.
    knob
        what is swept.
    """
    if knob in NO_SCENE:
        return knob, _OWN_AXES.get(knob, "")
    try:
        text = locate(setup.scene, "scenes", "scene.xml").read_text(encoding="utf-8", errors="replace")
    except (OSError, MitsimError):  # parts may be merged where the scene is not
        text = ""
    found = re.search(rf'<default\s+name="{re.escape(knob)}"[^>]*>\s*<!--(.*?)-->', text, re.DOTALL)
    comment = " ".join(found[1].split()) if found else ""
    unit, said = _UNIT.search(comment), _ASIDE.sub("", _UNIT.sub("", comment, 1))
    return (f"{knob} [{unit[1] or unit[2]}]", said) if unit else (knob, f"{said} [as in the scene file]".lstrip())


def _named(results: Results, with_knob: bool = True) -> dict[tuple[str, str], str]:
    """Return the names of all values that were varied, with or without the knob before them."""
    knobs = _knobs(results)
    return {(knob, each): f"{knob} {each}" if with_knob else str(each) for knob in knobs
            for each in distinct(results.frame, knob)}  # fmt: skip


def _figures(results: Results) -> Mapping[str, Figure]:
    """Draw the images, and each measure over the first knob with numbers, a curve for each setting of the others."""
    (first, *others), names = _knobs(results), _named(results)
    title = f"Images by {' and '.join(axis_of(results.scope.setup, knob)[0] for knob in (first, *others))}"
    panels: list[Panel] = [Images(first, title=title, down=("picture", *others), names=names | {None: ""})]
    numeric = [knob for knob in (first, *others) if all(map(_is_number, distinct(results.frame, knob)))]
    for name in results.scope.measures if numeric else ():
        column, axis = MEASURES[name]
        panels.append(
            Lines(
                numeric[0],
                ": ".join(axis_of(results.scope.setup, numeric[0])),
                file=name,
                y=column,
                y_label=axis,
                colour=[knob for knob in (first, *others) if knob != numeric[0]],
                facet="",
                names=names,
            )
        )
    return {file: figure for panel in panels for file, figure in panel.draw(results).items()}


def _settings(results: Results, with_knob: bool = True) -> dict[str, DataFrame]:
    """Return the rows of each setting by its name."""
    parts = Panel(names=_named(results, with_knob)).parts(results.frame, _knobs(results))
    return {name: rows for name, (rows, _) in parts.items()}


def _message(results: Results) -> str:
    """Return where the images are best, and where they are worst."""
    settings = {
        name: own for name, own in _settings(results).items() if "psnr_db" in own and own["psnr_db"].notna().any()
    }
    levels = {name: mean_of(own).value for name, own in settings.items()}
    best, worst = (choose(levels, key=levels.__getitem__, default=None) for choose in (max, min))
    if best is None or worst is None or best == worst:
        return ""
    return f"PSNR is highest at {best} ({levels[best]:.1f} dB), lowest at {worst} ({levels[worst]:.1f} dB)"


def _tables(results: Results) -> Sequence[Part]:
    """Return each measure at each setting, and how many images of it are flagged."""
    rows = []
    for name, own in _settings(results, with_knob=False).items():
        means = [_mean_text(own, MEASURES[measure][0]) for measure in results.scope.measures]
        count = int(own["flagged"].astype(bool).sum()) if "flagged" in own else 0
        rows.append((name, *means, f"{count} of {len(own)}"))
    names = ", ".join(axis_of(results.scope.setup, knob)[0] for knob in _knobs(results))
    # Each axis ends with its unit.
    units = {name: axis[axis.rindex("[") :] for name, (_, axis) in MEASURES.items()}
    heads = names, *(f"{name.replace('_', '-')} {units[name]}" for name in results.scope.measures), "flagged"
    return [Part("Measures by setting", "", heads, tuple(rows))]


def _mean_text(rows: DataFrame, column: str) -> str:
    if column not in rows or rows[column].isna().all():
        return DASH
    mean = mean_of(rows, column)
    return str(mean) if column == MEASURES["psnr"][0] else scientific(mean.value)


def _knobs(results: Results) -> list[str]:
    """Return what was varied, in the order of the command; the first of what was not, if nothing was."""
    knobs = list(dict(results.scope.sweep))
    return [name for name in knobs if len(distinct(results.frame, name)) > 1] or knobs[:1]


def _is_number(value: Value) -> bool:
    try:
        float(str(value))
    except ValueError:
        return False
    return True


STUDY = Study(
    "sweep",
    f"Sweep of {KNOBS}",
    "What does each value do to the image?",
    points=_points,
    measure=measure_image,
    panels=(_figures,),
    tables=(_tables,),
    message=_message,
    about="Rendered frames with the sensor's noise, exposed at equal peak unless the exposure varies (the brightest "
    "pixel fills the same part of the full well), and the images that mitsim reconstruct makes of them, with "
    "factors calibrated by a session of the same camera. Parameters have the names and units of the scene file, "
    "where lengths are in mm.",
    solved=True,
)
