"""Any knob swept: scene parameters, patterns, exposure and accuracy over lists of values; any measure of the images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

from matplotlib.figure import Figure

from mitsim.report import EQUAL_PEAK, RENDERED
from mitsim.report.pages import DASH, Table, Value, scientific
from mitsim.report.plots import curves
from mitsim.studies.framework.claims import measure_image
from mitsim.studies.framework.experiment import (
    KNOBS,
    MEASURES,
    NO_SCENE,
    OTHERS,
    Experiment,
    PageTable,
    Point,
    Results,
    Scope,
    Setup,
    check_sweep,
    group_by_setup,
    number_of,
)


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


def _figures(results: Results) -> Mapping[str, Figure]:
    """Each measure over the first knob that has numbers; a curve for each value of the others."""
    table, knobs = results.table, _knobs(results.table)
    numeric = [name for name in knobs if all(_is_number(value) for value in table.distinct(name))]
    if not numeric:
        return {}
    along, others = numeric[0], [name for name in knobs if name != numeric[0]]
    drawn = {}
    for name in results.measures:
        column, axis = MEASURES[name]
        shown = {}
        for values in product(*(table.distinct(other) for other in others)):
            chosen = table.where(**dict(zip(others, values, strict=True)))
            label = ", ".join(f"{other} {value}" for other, value in zip(others, values, strict=True))
            means = {value: chosen.where(**{along: value}) for value in chosen.distinct(along)}
            shown[label] = {float(value): rows.mean(column) for value, rows in means.items() if rows.numbers(column)}
        drawn[f"{name}.png"] = curves({"": shown}, along, axis)
    return drawn


def _tables(results: Results) -> Sequence[PageTable]:
    """Each measure at each setting, and how many images of it are flagged."""
    table, knobs, rows = results.table, _knobs(results.table), []
    for values in product(*(table.distinct(name) for name in knobs)):
        chosen = table.where(**dict(zip(knobs, values, strict=True)))
        if chosen.rows:
            means = [_mean_text(chosen, MEASURES[name][0]) for name in results.measures]
            count = sum(bool(row.get("flagged")) for row in chosen.rows)
            rows.append((", ".join(map(str, values)) or DASH, *means, f"{count} of {len(chosen)}"))
    heads = ", ".join(knobs), *(name.replace("_", "-") for name in results.measures), "flagged"
    return [PageTable("Measures by setting, PSNR in dB", heads, tuple(rows))]


def _mean_text(rows: Table, column: str) -> str:
    if not rows.numbers(column):
        return DASH
    return str(rows.mean(column)) if column == MEASURES["psnr"][0] else scientific(rows.mean(column).value)


def _knobs(table: Table) -> list[str]:
    """Columns of a ``table`` that were varied."""
    return [name for name in table.columns if name not in OTHERS and len(table.distinct(name)) > 1]


def _is_number(value: Value) -> bool:
    try:
        float(str(value))
    except ValueError:
        return False
    return True


EXPERIMENT = Experiment(
    "sweep",
    f"Sweep of {KNOBS}",
    "What do the swept values do to the image?",
    _points, measure_image, lambda results: (), _figures, _tables,
    about="Rendered frames with the sensor's noise, exposed at equal peak unless the exposure varies (the brightest "
    "pixel fills the same part of the full well), and the images that mitsim reconstruct makes of them, with "
    "factors calibrated by a session of the same camera. Parameters have the names and units of the scene file, "
    "where lengths are in mm.",
)  # fmt: skip
