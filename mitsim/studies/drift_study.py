"""What drifts between a calibration and a capture, each kind alone: the decibels that it costs, measured and predicted.

Amounts are those of a recipe's table [drift] (``--recipe``, by default calibration/drift.toml), or those of ``--over``,
of which the first is shown beside the other kinds. The paper has no such figure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from mitsim.acquire.capture import trace_request
from mitsim.acquire.drifting import drift_projector
from mitsim.core.configuration import DEFAULT_CAMERA, locate, shipped
from mitsim.core.errors import MitsimError
from mitsim.devices.drift import UNITS, WORDS, Drift, amount_in_words
from mitsim.devices.patterns import read_name
from mitsim.devices.sensor import load_sensor
from mitsim.devices.session import SessionRecipe, load_recipe
from mitsim.reconstruct.factors import Factors
from mitsim.report.lit_scene import LitScene
from mitsim.report.pages import Mean, Table
from mitsim.report.plots import curves, pair_chart
from mitsim.studies.drift_loss import DriftStand
from mitsim.studies.framework.claims import difference, verdict, within
from mitsim.studies.framework.experiment import Claim, Experiment, Found, Results, Scope, group_by_setup, number_of
from mitsim.studies.framework.setup import TEST_IMAGES, Point, Setup
from mitsim.studies.framework.studio import Studio

_SEEDS = 4
"""Of noise and of what drifts at random: the fewest whose standard error is worth the name, known to 40 %."""
_LAMPS = ("lamp", "lamp_flicker", "lamp_ripple")
_RIPPLES = "power_ripple", "lamp_ripple"
"""Kinds that a rolling shutter sees by its line time."""
_LAMP_SCENE, _LAMP = "lamp_bench", "11.7"
"""Scene with a lamp beside the projector, a tenth as bright on the sheet, for what lamps do where no scene is given."""
_LINES = ("measured", "predicted")
AGREE_DB = 0.5
"""Decibels between predicted and measured loss that a prediction is good for: the issue asks as much of plans."""


def _points(scope: Scope) -> Sequence[Point]:
    drift, first = recipe_of(scope.recipe).drift, scope.seeds[0]
    read_name(scope.patterns)
    amounts = _amounts(scope, drift)
    if not amounts:
        raise MitsimError(f"study drift: the table [drift] of {scope.recipe} moves nothing; give amounts in it")
    if any(kind in _RIPPLES for kind in amounts):  # refused before any light is traced
        load_sensor(locate(scope.setup.camera or DEFAULT_CAMERA, "calibration", ".toml")).known_line_time_s()
    found = [
        Point.of(
            _setup(scope, kind), recipe=scope.recipe, patterns=scope.patterns, kind=kind, unit=UNITS[kind],
            amount=amount, seed=seed,
        )
        for seed in scope.chosen(range(first, first + _SEEDS), scope.seeds)
        for kind, each in amounts.items()
        for amount in each
    ]  # fmt: skip
    return group_by_setup(found)


def _amounts(scope: Scope, drift: Drift) -> Mapping[str, Sequence[float]]:
    """Amounts of each kind: those that the scope asks for, else the one that a ``drift`` states."""
    if not scope.sweep:
        return {kind: (getattr(drift, kind),) for kind in drift.kinds}
    return {
        kind: [getattr(drift.alone(kind, number_of(kind, text)), kind) for text in texts] for kind, texts in scope.sweep
    }


def _setup(scope: Scope, kind: str) -> Setup:
    """The scope's own scene, or a sheet with one print; before a lamp where a lamp is to drift."""
    if scope.pictures == (None,):
        return scope.setup
    setup = scope.setup.printed(TEST_IMAGES[0])
    return replace(setup, scene=_LAMP_SCENE).changed(lamp=_LAMP) if kind in _LAMPS else setup


def recipe_of(path: str | None) -> SessionRecipe:
    """The recipe at ``path``, or the shipped one with a drift; MitsimError as :func:`load_recipe`."""
    return load_recipe(shipped("calibration", "drift.toml") if path is None else Path(path))


def _measure(studio: Studio, point: Point) -> Found:
    setup, seed, kind = point.setup, int(point["seed"]), str(point["kind"])
    recipe = recipe_of(point["recipe"])
    drift = recipe.drift.alone(kind, float(point["amount"]))
    lit = studio.lit(setup)

    def stand() -> DriftStand:
        family = lit.bench.family(point["patterns"], seed)
        return DriftStand(lit, _session(studio, point, recipe, Drift()), recipe, family, seed)

    known = studio.once("drift", 1, (setup, point["recipe"], point["patterns"], seed), stand)
    session = _session(studio, point, recipe, drift) if kind.startswith("session") else None
    moved = None
    if kind.startswith("projector"):
        moved = studio.once("moved projector", 6, (setup, drift), lambda: _move_projector(lit, drift))
    found = known.outcome(drift, session, moved)
    row = point.row(
        before_db=found.before_db,
        after_db=found.after_db,
        lost_db=found.lost_db,
        lost_auto_db=found.lost_auto_db,
        predicted_before_db=found.predicted_before_db,
        predicted_db=found.predicted_db,
        predicted_lost_db=found.predicted_lost_db,
        predicted_error_db=found.predicted_error_db,
    )
    return Found((row,))


def _session(studio: Studio, point: Point, recipe: SessionRecipe, drift: Drift) -> Factors:
    """What a session by a ``recipe`` finds whose power drifts by ``drift``."""
    seed, own = int(point["seed"]), recipe.model_copy(update={"drift": drift})
    if own.model_copy(update={"source": ""}) == load_recipe().model_copy(update={"source": ""}):
        return studio.factors(point.setup, seed)
    blank = point.setup.printed(None)
    return studio.once(
        "drifting session", 2, (blank, seed, own), lambda: studio.bench(blank).calibrate(seed, recipe=own)
    )


def _move_projector(lit: LitScene, drift: Drift) -> LitScene:
    """The scene in light of a projector that moved, as coarse as its light before: another plan's errors would be in
    one image alone, and would pass for the drift's."""
    return LitScene(trace_request(drift_projector(lit.bench, drift), lit.light.plan))


def _first_amounts(table: Table) -> Mapping[str, Table]:
    """Rows of each kind at its first amount, by kind, amount and unit."""
    found = {}
    for kind in table.distinct("kind"):
        rows = table.where(kind=kind)
        amount = rows.rows[0]["amount"]
        name = f"{WORDS[kind]}, {amount_in_words(str(kind), rows.numbers('amount')[0])}"
        found[name] = rows.where(amount=amount)
    return found


def _both(rows: Table) -> tuple[Mean, Mean]:
    """Measured and predicted loss of some ``rows``, the latter's error with what the model leaves out."""
    measured, predicted = rows.mean("lost_db"), rows.mean("predicted_lost_db")
    error = math.hypot(rows.mean("predicted_error_db").value, np.nan_to_num(predicted.error))
    return measured, predicted._replace(error=error)


def _claims(results: Results) -> Sequence[Claim]:
    return [
        Claim(
            f"{name}: loss predicted within {AGREE_DB:g} dB", "", f"{_text(predicted)} dB lost",
            f"{_text(measured)} dB lost",
            verdict(within(difference(rows, rows, "lost_db", "predicted_lost_db"), -AGREE_DB, AGREE_DB)),
        )
        for name, rows in _first_amounts(results.table).items()
        for measured, predicted in (_both(rows),)
    ]  # fmt: skip


def _text(mean: Mean) -> str:
    known = not math.isnan(mean.error)
    return f"{mean.value:.2f} \N{PLUS-MINUS SIGN} {mean.error:.2f}" if known else f"{mean.value:.2f}"


def _figures(results: Results) -> Mapping[str, Figure]:
    table = results.table
    drawn = {
        "losses.png": pair_chart(
            {name: _both(rows) for name, rows in _first_amounts(table).items()}, _LINES, "PSNR lost [dB]"
        )
    }
    for kind in table.distinct("kind"):
        rows = table.where(kind=kind)
        if len(rows.distinct("amount")) > 1:
            both = {amount: _both(rows.where(amount=amount)) for amount in rows.distinct("amount")}
            lines = {name: {amount: pair[index] for amount, pair in both.items()} for index, name in enumerate(_LINES)}
            drawn[f"{kind}.png"] = curves({"": lines}, f"{WORDS[kind]} [{rows.rows[0]['unit']}]", "PSNR lost [dB]")
    return drawn


EXPERIMENT = Experiment(
    "drift",
    "What drifts between calibration and capture",
    "How many decibels does each kind of drift cost, and do closed forms say so?",
    _points, _measure, _claims, _figures,
    about="PSNR that an image loses when one thing moves after the calibration. Measured: frames after the drift, "
    "solved with the factors and lambda from before it, against the same noise without the drift; one standard error "
    "over sessions and noise. Predicted: closed forms of these factors, the truth and the mean noise; no frame is "
    "formed. Their uncertainty, the bars of the figure, is what they leave out of the image without a drift, such as "
    "detail inside projector pixels.",
    heads=("", "Predicted", "Measured"),
)  # fmt: skip
