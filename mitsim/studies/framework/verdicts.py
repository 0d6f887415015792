"""Quantities with standard errors in; what becomes of a claim out: confirmed, not confirmed, or not decided.

A claim is that a quantity, such as the difference of two mean PSNR, lies in a range. It holds where the quantity's
confidence interval lies in the range, fails where the interval lies outside, and is not decided where a border of the
range lies in the interval: more prints or more seeds would decide it. Two mean PSNR are compared by the differences of
the images of each print (and of each seed of the noise where there is one print): prints differ by decibels, what is
compared often by tenths.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from scipy.special import stdtrit

from mitsim.report.exposures import IDEALISED, MODELS, RENDERED
from mitsim.report.table import Mean, Table, Value
from mitsim.studies.framework.experiment import Claim

CONFIRMED, NOT_CONFIRMED, UNDECIDED = "confirmed", "not confirmed", "not decided at this size"
CONFIDENCE = 0.95
"""Of the interval of a quantity: chosen, as the uncertainty of images is stated."""
Holds = bool | None
"""Whether a claim holds; None: not decided."""
Judge = Callable[[Table], tuple[str, Holds]]
"""From the rows of one model and exposure to what they say, and whether the claim holds for them."""


def sampled(rows: Table, column: str) -> Mean:
    """Mean of a ``column`` over prints, or over seeds of the noise where there is one print; MitsimError where the
    ``rows`` have no number."""
    return _mean(rows, rows, column, column, lambda one, _: one)


def difference(one: Table, other: Table, column: str, other_column: str | None = None) -> Mean:
    """Mean of paired differences, image by image.

    Parameters
    ----------
    one, other
        rows of the same prints and seeds.
    column, other_column
        of ``one``, and of ``other`` if it has another name.

    Raises
    ------
    MitsimError
        where no print, or no seed of the only one, is in both.
    """
    return _mean(one, other, column, other_column or column, lambda first, second: first - second)


def _mean(one: Table, other: Table, column: str, other_column: str, combine: Callable[[float, float], float]) -> Mean:
    prints = {row.get("picture") for row in (*one.rows, *other.rows)}
    by = "picture" if len(prints) > 1 else "seed"
    first, second = (_by(by, rows, name) for rows, name in ((one, column), (other, other_column)))
    return Mean.of_numbers([combine(value, second[key]) for key, value in first.items() if key in second], column)


def _by(by: str, rows: Table, column: str) -> dict[Value, float]:
    """Mean of a ``column`` for each value of another."""
    keys = dict.fromkeys(row.get(by) for row in rows.rows)
    return {key: rows.mean(column, **{by: key}).value for key in keys if rows.numbers(column, **{by: key})}


def within(quantity: Mean, low: float = -math.inf, high: float = math.inf) -> Holds:
    """Whether a quantity lies in a range, by Student's interval; never decided of a single value.

    Parameters
    ----------
    quantity
        mean of independent values; their number less one is the degrees of freedom.
    low, high
        ends of the range.
    """
    if quantity.of < 2:
        return None
    reach = float(stdtrit(quantity.of - 1, (1 + CONFIDENCE) / 2)) * quantity.error
    if low < quantity.value - reach and quantity.value + reach < high:
        return True
    return False if quantity.value + reach < low or quantity.value - reach > high else None


def every(*holds: Holds) -> Holds:
    """Whether all of these ``holds``: one that fails decides."""
    if False in holds:
        return False
    return None if None in holds else True


def verdict(holds: Holds) -> str:
    """On a claim that ``holds``, does not, or is not decided."""
    return UNDECIDED if holds is None else CONFIRMED if holds else NOT_CONFIRMED


def verdict_at(places: Mapping[str, Holds]) -> str:
    """On a claim that was judged at several ``places``, such as ways of exposing, by their names."""
    holding = [name for name, holds in places.items() if holds]
    if len(holding) in (0, len(places)):
        # Not decided anywhere it may hold: that it fails elsewhere does not end the claim.
        return verdict(True if holding else None if None in places.values() else False)
    undecided = [name for name, holds in places.items() if holds is None]
    rest = f", {UNDECIDED} at {' and '.join(undecided)}" if undecided else ""
    return f"confirmed only at {' and '.join(holding)}{rest}"


def judged(table: Table, claim: str, paper: str, judge: Judge) -> Claim:
    """What becomes of a claim at each way of exposing, in each model.

    Parameters
    ----------
    table
        what was measured.
    claim, paper
        what the paper says.
    judge
        from the rows of one model and exposure: what they say, and whether the claim holds for them.
    """
    exposures: list[Value] = table.distinct("exposure") or [None]
    found = {
        (model, each): judge(table.where(model=model) if each is None else table.where(model=model, exposure=each))
        for model in MODELS
        for each in exposures
    }
    figures = {
        model: "; ".join(
            found[model, each][0] if len(exposures) == 1 else f"{each}: {found[model, each][0]}" for each in exposures
        )
        for model in MODELS
    }
    decided = verdict_at({str(each): every(*(found[model, each][1] for model in MODELS)) for each in exposures})
    if decided in (NOT_CONFIRMED, UNDECIDED):
        models = {model: every(*(found[model, each][1] for each in exposures)) for model in MODELS}
        holding = [model for model, holds in models.items() if holds]
        rest = [f", {other} {UNDECIDED}" for other, holds in models.items() if holds is None]
        decided = f"confirmed only {holding[0]}{''.join(rest)}" if holding else decided
    return Claim(claim, paper, figures[IDEALISED], figures[RENDERED], decided)
