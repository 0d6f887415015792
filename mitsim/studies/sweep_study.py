"""Any knob swept: scene parameters, patterns, exposure and accuracy over lists of values; any measure of the images."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import TypeVar

import numpy as np
from matplotlib.figure import Figure

from mitsim.core.configuration import locate
from mitsim.core.errors import MitsimError
from mitsim.report import EQUAL_PEAK, RENDERED
from mitsim.report.pages import DASH, Table, Value, scientific
from mitsim.report.plots import curves
from mitsim.studies.framework.experiment import (
    KNOBS,
    MEASURES,
    NO_SCENE,
    PageTable,
    Point,
    Results,
    Scope,
    Setup,
    check_sweep,
    group_by_setup,
    number_of,
)
from mitsim.studies.framework.legacy import Cell, Experiment, grid_with_truths, kept_images, measure_image


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
            light = {name: setting[name] for name in ("accuracy",) if name in setting}
            found.append(Point.of(setup, model=RENDERED, **{**knobs, "seed": int(str(knobs["seed"])), **light}))
    return group_by_setup(found)


def _setup(setup: Setup, setting: Mapping[str, str]) -> Setup:
    parameters = {name: value for name, value in setting.items() if name not in NO_SCENE}
    changed = setup.with_parameters(**parameters)
    return replace(changed, accuracy=number_of("accuracy", setting["accuracy"])) if "accuracy" in setting else changed


# -------- What a sweep shows

_MOST_SHOWN = 6
"""Images along either side of the grid: more are too small to be compared on a page."""
_OWN_AXES = {"accuracy": "relative rms error of the light [1]", "seed": "of the noise [1]"}
"""What knobs with numbers are that no scene file has."""
_UNIT = re.compile(r"^(mm|um|degrees)\b,?\s*|\s*\[([^]]+)\]")
"""Where the comment on a parameter has a unit: first, or in square brackets."""
_ASIDE = re.compile(r"(, see| \().*")
"""What such a comment says of the file besides."""
Item = TypeVar("Item")


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


def _figures(results: Results) -> Mapping[str, Figure]:
    """The images; and each measure over the first knob that has numbers, a curve for each value of the others."""
    table, knobs, drawn = results.table, _knobs(results), _images(results)
    numeric = [name for name in knobs if all(_is_number(value) for value in table.distinct(name))]
    if not numeric:
        return drawn
    along, others = numeric[0], [name for name in knobs if name != numeric[0]]
    for name in results.scope.measures:
        column, axis = MEASURES[name]
        shown = {}
        for values in product(*(table.distinct(other) for other in others)):
            chosen = table.where(**dict(zip(others, values, strict=True)))
            means = {value: chosen.where(**{along: value}) for value in chosen.distinct(along)}
            shown[_setting(others, values)] = {
                float(value): rows.mean(column) for value, rows in means.items() if rows.numbers(column)
            }
        drawn[f"{name}.png"] = curves({"": shown}, ": ".join(axis_of(results.scope.setup, along)), axis)
    return drawn


def _images(results: Results) -> dict[str, Figure]:
    """A grid: a column for each value of the first knob, a row for each print and setting of the others; the truth
    beside, or above where it differs from column to column."""
    table, (first, *others) = results.table, _knobs(results)
    prints = dict.fromkeys(row.get("picture") for row in table.rows if results.array(row) is not None)
    settings = list(product(prints, *(table.distinct(other) for other in others)))
    columns, grid = table.distinct(first), dict[str, list[Cell]]()
    for picture, *values in _few(settings):
        chosen = table.where(picture=picture, **dict(zip(others, values, strict=True)))
        name = ", ".join(part for part in (picture, _setting(others, values)) if part)
        grid[str(name)] = [
            cell for value in _few(columns) for cell in kept_images(results, chosen.where(**{first: value}))[:1]
        ]
    grid = {name: cells for name, cells in grid.items() if len(cells) == len(_few(columns))}
    if not grid:
        return {}
    titles = [f"{first} {value}" for value in _few(columns)]
    sides = {"columns": len(columns), "rows": len(settings)}
    cut = ", ".join(f"{_MOST_SHOWN} of {count} {side}" for side, count in sides.items() if count > _MOST_SHOWN)
    names = " and ".join(axis_of(results.scope.setup, knob)[0] for knob in (first, *others))
    title = f"Images by {names}{f' ({cut})' if cut else ''}"
    return {"images.png": grid_with_truths(grid, titles, title)}


def _few(items: Sequence[Item]) -> list[Item]:
    """As many of some ``items`` as are shown, both ends among them."""
    count = min(len(items), _MOST_SHOWN)
    return [items[int(place)] for place in np.linspace(0, len(items) - 1, count).round()]


def _message(results: Results) -> str:
    """Where the images are best, and where they are worst."""
    knobs = _knobs(results)
    levels = {
        _setting(knobs, values): rows.mean("psnr_db").value
        for values, rows in _settings(results)
        if rows.numbers("psnr_db")
    }
    best, worst = (choose(levels, key=levels.__getitem__, default=None) for choose in (max, min))
    if best is None or worst is None or best == worst:
        return ""
    return f"PSNR is highest at {best} ({levels[best]:.1f} dB), lowest at {worst} ({levels[worst]:.1f} dB)"


def _settings(results: Results) -> list[tuple[tuple[Value, ...], Table]]:
    """Values of what was varied, and the rows that have them."""
    table, knobs = results.table, _knobs(results)
    every = product(*(table.distinct(name) for name in knobs))
    found = [(values, table.where(**dict(zip(knobs, values, strict=True)))) for values in every]
    return [(values, rows) for values, rows in found if rows.rows]


def _setting(knobs: Sequence[str], values: Sequence[Value]) -> str:
    return ", ".join(f"{knob} {value}" for knob, value in zip(knobs, values, strict=True))


def _tables(results: Results) -> Sequence[PageTable]:
    """Each measure at each setting, and how many images of it are flagged."""
    rows = []
    for values, chosen in _settings(results):
        means = [_mean_text(chosen, MEASURES[name][0]) for name in results.scope.measures]
        count = sum(bool(row.get("flagged")) for row in chosen.rows)
        rows.append((", ".join(map(str, values)), *means, f"{count} of {len(chosen)}"))
    names = ", ".join(axis_of(results.scope.setup, knob)[0] for knob in _knobs(results))
    # Each axis ends with its unit.
    units = {name: axis[axis.rindex("[") :] for name, (_, axis) in MEASURES.items()}
    heads = names, *(f"{name.replace('_', '-')} {units[name]}" for name in results.scope.measures), "flagged"
    return [PageTable("Measures by setting", heads, tuple(rows))]


def _mean_text(rows: Table, column: str) -> str:
    if not rows.numbers(column):
        return DASH
    return str(rows.mean(column)) if column == MEASURES["psnr"][0] else scientific(rows.mean(column).value)


def _knobs(results: Results) -> list[str]:
    """What was varied, in the order of the command; the first of what was not, if nothing was."""
    knobs = list(dict(results.scope.sweep))
    return [name for name in knobs if len(results.table.distinct(name)) > 1] or knobs[:1]


def _is_number(value: Value) -> bool:
    try:
        float(str(value))
    except ValueError:
        return False
    return True


EXPERIMENT = Experiment(
    "sweep",
    f"Sweep of {KNOBS}",
    "What does each value do to the image?",
    _points, measure_image, lambda results: (), _figures, _tables, _message,
    about="Rendered frames with the sensor's noise, exposed at equal peak unless the exposure varies (the brightest "
    "pixel fills the same part of the full well), and the images that mitsim reconstruct makes of them, with "
    "factors calibrated by a session of the same camera. Parameters have the names and units of the scene file, "
    "where lengths are in mm.",
    solved=True,
)  # fmt: skip
