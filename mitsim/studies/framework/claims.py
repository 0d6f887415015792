"""Claims of a study: declared with thresholds, and judged from the table of results.

A claim states that a quantity, such as the difference of two mean PSNR, lies in a range. It is confirmed if the
quantity's confidence interval lies in the range, not confirmed if the interval lies outside, and otherwise not decided:
more prints or seeds would decide it. Sets of images are compared print by print (seed by seed where there is one
print), because prints differ by decibels, and sets often by tenths.

A claim is judged for each model and exposure that were measured, and confirmed only if it holds for all of them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from itertools import product
from typing import TYPE_CHECKING, Any

from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import FAMILIES, is_own
from mitsim.report import IDEALISED, RENDERED, in_text
from mitsim.report.pages import Mean, round_to_error
from mitsim.studies.framework.experiment import MEASURES, Claim, Results

if TYPE_CHECKING:
    from pandas import DataFrame, Series

CONFIRMED, NOT_CONFIRMED, UNDECIDED = "confirmed", "not confirmed", "not decided at this size"
Holds = bool | None
Where = Mapping[str, Any] | str
"""Values by column that choose rows: a value, a sequence of values, or a predicate; a text is the value of the column
patterns."""

# -------- Rows in, means with their standard errors out


def choose_rows(rows: DataFrame, where: Where) -> DataFrame:
    for name, value in _chosen(where).items():
        column: Any = rows[name] if name in rows else rows.index.to_series().map(lambda _: None)
        if callable(value):
            kept = column.map(lambda each, accept=value: bool(accept(each)))
        elif isinstance(value, (list, tuple, set, frozenset)):
            kept = column.map(_number).isin([_number(each) for each in value if each is not None])
            kept = kept | column.isna() if None in value else kept
        else:
            kept = column.isna() if value is None else column.map(_number) == _number(value)
        rows = rows[kept.astype(bool)]
    return rows


def _number(value: Any) -> Any:
    """Return a value as a number if it is one, because a sweep's column may hold "2" where a study states 2.0."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return value


def _chosen(where: Where) -> Mapping[str, Any]:
    return {"patterns": where} if isinstance(where, str) else where


def measured(value: Any) -> bool:
    return isinstance(value, (int, float)) and not math.isnan(value)


def distinct(rows: DataFrame, column: str) -> list[Any]:
    return list(rows[column].dropna().drop_duplicates()) if column in rows else []


def mean_of(
    rows: DataFrame,
    column: str = "psnr_db",
    minus: DataFrame | None = None,
    minus_column: str = "",
    error_column: str = "",
) -> Mean:
    """Return the mean of a column with its standard error, over prints, or over seeds where there is one print.

    ``minus`` are rows of the same prints and seeds, whose values are subtracted; ``error_column`` is an error that all
    rows share, added in quadrature. MitsimError if no shared print (or seed) has a number.
    """
    from pandas import Series, to_numeric

    def keys(table: DataFrame, by: str) -> Series[Any]:
        return table[by].where(table[by].notna(), "") if by in table else table.index.to_series().map(lambda _: "")

    def level(table: DataFrame, name: str) -> Series[float]:
        if name not in table or table.empty:
            return Series(dtype=float)
        return to_numeric(table[name], errors="coerce").groupby(keys(table, by), sort=False).mean().dropna()

    prints = {key for each in (rows, minus) if each is not None for key in keys(each, "picture")}
    by = "picture" if len(prints) > 1 else "seed"
    means = level(rows, column)
    if minus is not None:
        means = (means - level(minus, minus_column or column)).dropna()
    mean = Mean.of_numbers(means.tolist(), column)
    if not error_column:
        return mean
    own = 0.0 if math.isnan(mean.error) else mean.error
    return mean._replace(error=math.hypot(own, mean_of(rows, error_column).value))


def with_intervals(results: Results) -> Results:
    """Add the mean and half of its 95 % interval to each row of a sweep, for each shown measure.

    Means are over all seeds and prints of one setting. A sweep of one seed on one print is returned as it is.
    """
    scope, table = results.scope, results.frame
    if not scope.measures or len(scope.seeds) * len(scope.pictures) == 1:
        return results
    means: dict[tuple[Any, ...], dict[str, float]] = {}
    for row in results.rows:
        setting = {name: row.get(name) for name, _ in scope.sweep}
        if (key := tuple(setting.values())) not in means:
            same = choose_rows(table, setting)
            columns = [name for name in (MEASURES[each][0] for each in scope.measures) if same[name].notna().any()]
            found = {name: mean_of(same, name) for name in columns}
            means[key] = {f"{name}_mean": mean.value for name, mean in found.items()}
            means[key] |= {f"{name}_ci95": mean.reach for name, mean in found.items()}
    rows = [{**row, **means[tuple(row.get(name) for name, _ in scope.sweep)]} for row in results.rows]
    return replace(results, rows=rows)


# -------- A mean and a range in, the verdict out


def within(quantity: Mean, low: float = -math.inf, high: float = math.inf) -> Holds:
    """Return whether a quantity lies in a range, by Student's interval; a single value decides nothing."""
    if quantity.of < 2:
        return None
    reach = quantity.reach
    if low < quantity.value - reach and quantity.value + reach < high:
        return True
    return False if quantity.value + reach < low or quantity.value - reach > high else None


def every(*holds: Holds) -> Holds:
    """Return whether all parts of a claim hold; one part that fails decides."""
    return False if False in holds else None if None in holds else True


def tally(claims: Sequence[Claim]) -> str:
    """Return how many claims are confirmed, in part or not, in words."""
    part, open_ = "confirmed in part", "not decided"
    counts = Counter(
        each if each in (CONFIRMED, NOT_CONFIRMED) else part if each.startswith(CONFIRMED) else open_
        for each in (claim.verdict for claim in claims)
    )
    kinds = [f"{counts[kind]} {kind}" for kind in (CONFIRMED, part, NOT_CONFIRMED, open_) if counts[kind]]
    return f"{len(claims)} claim{'s' * (len(claims) > 1)}: {', '.join(kinds)}" if claims else ""


def value_name(column: str, value: Any, pattern_name: Callable[[str], str] = in_text) -> str:
    if column == "patterns" and (is_own(str(value)) or str(value).partition(":")[0] in FAMILIES):
        return pattern_name(str(value))
    return f"{value:g}" if isinstance(value, float) else str(value).replace("_", " ")


def with_unit(mean: Mean, unit: str, sign: str = "") -> str:
    if unit == "dB":
        return f"{mean:{sign}} dB"
    error = "" if math.isnan(mean.error) else f" \N{PLUS-MINUS SIGN} {round_to_error(mean.error, mean.error)}"
    value = round_to_error(mean.value, mean.error if error else abs(mean.value) / 20)
    return f"{'+' if sign and mean.value >= 0 else ''}{value}{error} {unit}".rstrip()


# -------- Declared claims

_SHOWN = 4


@dataclass(frozen=True)
class Level:
    """Claim that the mean of a ``column`` lies in a range from ``at_least`` to ``at_most`` [``unit``].

    Attributes
    ----------
    claim, paper
        the sentence, in which {column} is the value of ``each``, and the paper's figure.
    where
        rows of the claim.
    each
        column with a claim for each of its values.
    every
        column for each of whose values the claim must hold.
    models
        column of the models, and the two values that replace the idealised and rendered one.
    optional
        True to omit the claim where no row of it was measured, for example on a user's own scene.
    """

    claim: str
    _: KW_ONLY
    paper: str = ""
    where: Where = field(default_factory=dict)
    each: str = ""
    every: str = ""
    optional: bool = False
    models: tuple[str, str, str] = ("model", IDEALISED, RENDERED)
    column: str = "psnr_db"
    unit: str = "dB"
    at_least: float = -math.inf
    at_most: float = math.inf

    def judge(self, results: Results) -> list[Claim]:
        rows = choose_rows(results.frame, self.where)
        if self.optional and any(side.empty for side in self.sides(rows)):
            return []
        if rows.empty:
            raise MitsimError(f"study: nothing was measured of the claim {self.claim!r}")
        if not self.each:
            return [self._judge(rows, self.claim)]
        sentences = {
            value: self.claim.format(**{self.each: value_name(self.each, value)}) for value in distinct(rows, self.each)
        }
        return [self._judge(choose_rows(rows, {self.each: value}), claim) for value, claim in sentences.items()]

    def sides(self, rows: DataFrame) -> tuple[DataFrame, ...]:
        return (rows,)

    def found(self, rows: DataFrame) -> tuple[str, Holds, float]:
        """Return the figures in words, whether the claim holds for ``rows``, and the distance from the border."""
        mean = mean_of(rows, self.column)
        return self._decide(with_unit(mean, self.unit), mean)

    def _decide(self, text: str, mean: Mean) -> tuple[str, Holds, float]:
        margin = min(mean.value - self.at_least, self.at_most - mean.value)
        return text, within(mean, self.at_least, self.at_most), margin

    def _judge(self, rows: DataFrame, claim: str, compared: Collection[str] = ()) -> Claim:
        """Judge ``rows`` by model and exposure, unless the claim has ``compared`` them."""
        column, *both = self.models
        known = {name: [] if name in compared else distinct(rows, name) for name in (column, "exposure")}
        models, exposures = [model for model in both if model in known[column]] or both[1:], known["exposure"] or [None]
        found: dict[tuple[str, Any], tuple[str, Holds]] = {}
        for model, exposure in product(models, exposures):
            where = {column: model} if model in known[column] else {}
            found[model, exposure] = self._found(choose_rows(rows, where if exposure is None else where | {
                "exposure": exposure}))  # fmt: skip
        figures = {
            model: "; ".join(
                found[model, each][0] if len(exposures) == 1 else f"{each}: {found[model, each][0]}"
                for each in exposures
            )
            for model in models
        }
        places = {str(each): every(*(found[model, each][1] for model in models)) for each in exposures}
        holding = [name for name, holds in places.items() if holds]
        undecided = [name for name, holds in places.items() if holds is None]
        if 0 < len(holding) < len(places):
            rest = f", {UNDECIDED} at {' and '.join(undecided)}" if undecided else ""
            decided = f"confirmed only at {' and '.join(holding)}{rest}"
        else:  # undecided at one place and failing at another: the claim may still hold at the first
            decided = CONFIRMED if holding else UNDECIDED if undecided else NOT_CONFIRMED
        if not holding and len(models) > 1:
            by_model = {model: every(*(found[model, each][1] for each in exposures)) for model in models}
            rest = "".join(f", {other} {UNDECIDED}" for other, holds in by_model.items() if holds is None)
            decided = next((f"confirmed only {model}{rest}" for model, holds in by_model.items() if holds), decided)
        return Claim(claim, self.paper, figures.get(both[0], ""), figures.get(both[1], ""), decided)

    def _found(self, rows: DataFrame) -> tuple[str, Holds]:
        if not self.every:
            return self.found(rows)[:2]
        values = sorted(distinct(rows, self.every))
        if not values:
            raise MitsimError(f"study: nothing was measured of the claim {self.claim!r}")
        found = {value: self.found(choose_rows(rows, {self.every: value})) for value in values}
        worst = min(found, key=lambda value: found[value][2])
        shown = found if len(found) <= _SHOWN else {worst: found[worst]}
        text = ", ".join(f"{value_name(self.every, value)}: {found[value][0]}" for value in shown)
        more = f" (worst of {len(found)})" if len(found) > len(shown) else ""
        return f"{text}{more}", every(*(holds for _, holds, _ in found.values()))


@dataclass(frozen=True)
class Gain(Level):
    """Claim that some images exceed others by an amount in a range, compared print by print.

    Attributes
    ----------
    one, other
        values that choose the rows of each side.
    column, other_column, unit
        compared column, its name in ``other`` if it differs, and its unit.
    at_least, at_most
        range of the gain of ``one`` over ``other``; by default above 0.
    apart, other_error
        True to state each side under its own head; column of a further error of ``other``.
    note
        Function that returns words on the rows of ``one``, for its own head.
    """

    one: Where
    other: Where
    _: KW_ONLY
    other_column: str = ""
    at_least: float = 0.0
    apart: bool = False
    other_error: str = ""
    note: Callable[[DataFrame], str] | None = None

    def sides(self, rows: DataFrame) -> tuple[DataFrame, ...]:
        return choose_rows(rows, self.one), choose_rows(rows, self.other)

    def _judge(self, rows: DataFrame, claim: str, compared: Collection[str] = ()) -> Claim:
        judged = super()._judge(rows, claim, {*_chosen(self.one), *_chosen(self.other)})
        if not self.apart:
            return judged
        one, other = self.sides(rows)
        before = mean_of(other, self.other_column or self.column, error_column=self.other_error)
        after = with_unit(mean_of(one, self.column), self.unit) + (self.note(one) if self.note else "")
        return replace(judged, idealised=with_unit(before, self.unit), rendered=after)

    def found(self, rows: DataFrame) -> tuple[str, Holds, float]:
        (one, other), other_column = self.sides(rows), self.other_column or self.column
        gain = mean_of(one, self.column, other, other_column)
        means = with_unit(mean_of(one, self.column), self.unit), with_unit(mean_of(other, other_column), self.unit)
        return self._decide(f"{' against '.join(means)}, {with_unit(gain, self.unit, '+')}", gain)


@dataclass(frozen=True)
class Judged(Level):
    """Claim that a function decides from the rows of one model and exposure."""

    decide: Callable[[DataFrame], tuple[str, Any]]

    def found(self, rows: DataFrame) -> tuple[str, Holds, float]:
        return (*self.decide(rows), 0.0)


TOLERANCE_DB = 2.0
"""Allowed distance from the paper's figures, which state neither images nor brightness."""


def stated(claim: str, low: float, high: float, **where: Any) -> Level:
    paper = f"{low:g} to {high:g} dB"
    return Level(claim, paper=paper, where=where, at_least=low - TOLERANCE_DB, at_most=high + TOLERANCE_DB)
