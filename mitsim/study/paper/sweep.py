"""Any knob swept: scene parameters, patterns, exposure and accuracy over lists of values; any measure of the images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

from matplotlib.figure import Figure

from mitsim.study.asked import MEASURES, NO_SCENE, OTHERS, check_sweep, number_of
from mitsim.study.charts import curves
from mitsim.study.experiment import Claim, Experiment, Point, Results, Scope, Setup, grouped
from mitsim.study.exposures import EQUAL_PEAK, RENDERED
from mitsim.study.paper.measure import imaged
from mitsim.study.table import Value


def _points(scope: Scope) -> Sequence[Point]:
    check_sweep(scope.sweep, len(scope.pictures))
    names, values = [name for name, _ in scope.sweep], [each for _, each in scope.sweep]
    found = []
    for chosen in product(*values):
        setting = dict(zip(names, chosen, strict=True))
        for picture in scope.pictures:
            setup = _setup(scope.setup, setting).printed(picture)
            fixed: dict[str, Value] = {"patterns": scope.patterns, "exposure": EQUAL_PEAK, "seed": scope.seeds[0]}
            knobs: dict[str, Value] = {name: setting.get(name, other) for name, other in fixed.items()}
            light = {name: setting[name] for name in ("accuracy",) if name in setting}
            found.append(Point.of(setup, model=RENDERED, **{**knobs, "seed": int(str(knobs["seed"])), **light}))
    return grouped(found)


def _setup(setup: Setup, setting: Mapping[str, str]) -> Setup:
    """The ``setup`` with what a ``setting`` says of the scene and of the light."""
    parameters = {name: value for name, value in setting.items() if name not in NO_SCENE}
    changed = setup.changed(**parameters)
    return replace(changed, accuracy=number_of("accuracy", setting["accuracy"])) if "accuracy" in setting else changed


def _claims(_: Results) -> Sequence[Claim]:
    return ()


def _figures(results: Results) -> Mapping[str, Figure]:
    """Each measure over the first knob that has numbers; a curve for each value of the others."""
    table = results.table
    knobs = [name for name in table.columns if name not in OTHERS and len(table.distinct(name)) > 1]
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
            label = ", ".join(f"{other} {value}" for other, value in zip(others, values, strict=True)) or "all"
            means = {value: chosen.where(**{along: value}) for value in chosen.distinct(along)}
            shown[label] = {float(value): rows.mean(column) for value, rows in means.items() if rows.numbers(column)}
        drawn[f"{name}.png"] = curves({"": shown}, along.replace("_", " "), axis)
    return drawn


def _is_number(value: Value) -> bool:
    try:
        float(str(value))
    except ValueError:
        return False
    return True


EXPERIMENT = Experiment("sweep", "A sweep", "What does a knob do to the image?", _points, imaged, _claims, _figures)
