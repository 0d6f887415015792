"""Any knob swept: scene parameters, patterns, exposure and accuracy over lists of values; any measure of the images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

from matplotlib.figure import Figure

from mitsim.core.errors import MitsimError
from mitsim.study.charts import curves
from mitsim.study.experiment import Claim, Experiment, Point, Results, Scope, Setup, grouped
from mitsim.study.exposures import CONVENTIONS, EQUAL_PEAK, RENDERED
from mitsim.study.paper.measure import imaged
from mitsim.study.table import Value

MEASURES = {
    "psnr": ("psnr_db", "PSNR [dB]"),
    "ssim": ("ssim", "SSIM [1]"),
    "misfit": ("misfit", "unexplained part of the measurements [1]"),
    "chi_square": ("chi_square", "chi-square a datum [1]"),
    "uncertainty": ("uncertainty", "standard uncertainty, rms [reflectance]"),
    "lambda": ("lambda", "lambda [(electrons/s)^2]"),
}
"""Column of the table and axis, by what people ask for."""
_KNOBS = ("patterns", "exposure", "seed")
"""What may be varied besides scene parameters and the accuracy."""
_MOST = 10_000
"""Points of one sweep: more are a typing error."""
_OTHERS = {"point", "picture", "model", "shots", "exposure_s", "flagged", "lambda", "psnr_db", "ssim"} | {
    column for column, _ in MEASURES.values()
}
"""Columns that are no knob."""


def values_of(text: str) -> tuple[str, tuple[str, ...]]:
    """Name and values of a knob in ``text``: NAME=FIRST:LAST:COUNT, evenly spaced, or NAME=VALUE,VALUE,...

    MitsimError for anything else.
    """
    name, equals, given = text.partition("=")
    ends = given.split(":")
    if not (name and equals and given):
        raise MitsimError(f"--over {text!r}: give NAME=FIRST:LAST:COUNT or NAME=VALUE,VALUE")
    if name in _KNOBS or len(ends) != 3:
        return name, tuple(given.split(","))
    try:
        first, last, count = float(ends[0]), float(ends[1]), int(ends[2])
    except ValueError:
        raise MitsimError(f"--over {text!r}: {given} is not FIRST:LAST:COUNT in numbers") from None
    if not 2 <= count <= _MOST:
        raise MitsimError(f"--over {text!r}: give 2 to {_MOST} values")
    return name, tuple(f"{first + (last - first) * index / (count - 1):.6g}" for index in range(count))


def measures_of(text: str) -> tuple[str, ...]:
    """Measures named in ``text``, separated by commas; MitsimError for one that there is not."""
    names = tuple(text.split(","))
    for name in names:
        if name not in MEASURES:
            raise MitsimError(f"--measure {name!r}: use {', '.join(MEASURES)}")
    return names


def _points(scope: Scope) -> Sequence[Point]:
    if not scope.sweep:
        raise MitsimError(
            "study sweep: nothing is varied; give --over NAME=FIRST:LAST:COUNT, such as roughness=0.1:0.5:5"
        )
    names, values = [name for name, _ in scope.sweep], [each for _, each in scope.sweep]
    if taken := _OTHERS.intersection(names):
        raise MitsimError(f"--over {taken.pop()}: is a column of every study's table; give the parameter another name")
    found = []
    for chosen in product(*values):
        setting = dict(zip(names, chosen, strict=True))
        for picture in scope.pictures:
            setup = _setup(scope.setup, setting).printed(picture)
            fixed: dict[str, Value] = {"patterns": scope.patterns, "exposure": EQUAL_PEAK, "seed": scope.seeds[0]}
            knobs: dict[str, Value] = {name: setting.get(name, other) for name, other in fixed.items()}
            if knobs["exposure"] not in CONVENTIONS:
                raise MitsimError(f"--over exposure={knobs['exposure']}: use {', '.join(CONVENTIONS)}")
            light = {name: setting[name] for name in ("accuracy",) if name in setting}
            found.append(Point.of(setup, model=RENDERED, **{**knobs, "seed": _whole(knobs["seed"]), **light}))
    if len(found) > _MOST:
        raise MitsimError(f"study sweep: {len(found)} points; give at most {_MOST}")
    return grouped(found)


def _setup(setup: Setup, setting: Mapping[str, str]) -> Setup:
    """The ``setup`` with what a ``setting`` says of the scene and of the light."""
    parameters = {name: value for name, value in setting.items() if name not in (*_KNOBS, "accuracy")}
    changed = setup.changed(**parameters)
    return replace(changed, accuracy=_number(setting["accuracy"])) if "accuracy" in setting else changed


def _claims(_: Results) -> Sequence[Claim]:
    return ()


def _figures(results: Results) -> Mapping[str, Figure]:
    """Each measure over the first knob that has numbers; a curve for each value of the others."""
    table = results.table
    knobs = [name for name in table.columns if name not in _OTHERS and len(table.distinct(name)) > 1]
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


def _whole(text: Value) -> int:
    try:
        return int(str(text))
    except ValueError:
        raise MitsimError(f"--over seed={text}: give whole numbers") from None


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise MitsimError(f"--over accuracy={text}: give numbers") from None


def _is_number(value: Value) -> bool:
    try:
        float(str(value))
    except ValueError:
        return False
    return True


EXPERIMENT = Experiment("sweep", "A sweep", "What does a knob do to the image?", _points, imaged, _claims, _figures)
