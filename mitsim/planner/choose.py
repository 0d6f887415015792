"""The cheapest settings that keep an accuracy, with their predicted error and work.

Every combination of effects, anchors, layers and cells is predicted: the error of all that it leaves out or makes
coarse, with signs; the samples that keep the rest of the budget; and the work at fixed unit costs. The cheapest
combination that fits is chosen.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import chain, combinations, product

import numpy as np
import numpy.typing as npt

from mitsim.bench.effects import EFFECTS, names
from mitsim.bench.request import HIGHEST_ACCURACY
from mitsim.core.arrays import FloatArray
from mitsim.light.cost_model import (
    FIXED,
    MIXING,
    Numbers,
    UnitCosts,
    accumulation_seconds,
    checking_seconds,
    entries,
    in_waves,
    optics_seconds,
    sample_costs,
    tells_all,
    traced_for,
    truth_seconds,
)
from mitsim.light.passes import FOLLOWED, PASSES
from mitsim.light.settings import (
    COUNTED,
    GROUPS,
    SURE,
    WIDE,
    Approximation,
    Estimate,
    Number,
    PilotResult,
    SampleCost,
    Settings,
)

_MARGIN = 0.95
"""Part of the accuracy that is planned for, because the pilot's frames differ from the others."""
_MOST_ENTRIES = 2.0**25
"""Most entries of one group's accumulated light: 12 GB in all (:mod:`mitsim.light.cost_model`)."""
_LUCKY = -1.0
"""Standard errors below an estimate at which settings may still keep the accuracy (one in six)."""
_AS_GOOD = 1.1
"""If nothing fits, settings within this factor of the least error are equivalent."""
_ONE_HIT = 0.25
"""Part of the Monte Carlo error that one hit of a small target may be."""
_OFF_BY_HITS = Estimate(0.75, 1.5)
"""Error of a small target's light [hits in a group] that the spread of groups does not show: root mean square of 40
runs with 400 to 1600 hits, and twice that."""
_BOUND_OVER_ERROR = 1.1
"""Ratio of the 95 % bound, by which sampling stops, to the error (measured: 1.04 to 1.3)."""
_UNEVEN_GROUPS = 2.717430025
"""Growth of the squared bound over the error's per relative deviation of the groups' noise: Student's 95 % quantile for
four groups times (4/3)^(1/2)."""
_SETTLED = 8


@dataclass(frozen=True)
class Candidate:
    """Settings with their predicted error and work.

    Attributes
    ----------
    systematic, lacking
        error of all that is left out or made coarse, and light in it that is known to be missing, by its cause.
    target, noise
        Monte Carlo error at which sampling may stop, and the predicted one.
    fits
        True if the total is within the accuracy, apart from errors that no choice avoids.
    work
        seconds at fixed unit costs.
    """

    settings: Settings
    systematic: Estimate
    lacking: Mapping[str, float]
    target: float
    noise: float
    fits: bool
    work: float

    @property
    def total(self) -> Estimate:
        """Predicted total error of the frames."""
        return Estimate(*(math.hypot(error, self.noise) for error in self.systematic))


def cheapest(accuracy: float, pilot_result: PilotResult, switches: Mapping[str, bool], sure: float = SURE) -> Candidate:
    """Return the choice of least work that keeps ``accuracy``, or of least error if none does.

    Errors that no choice avoids are ignored. ``sure`` is the number of standard errors added to each estimate.
    """
    return Candidates(pilot_result, switches).choice(accuracy, sure)


class Candidates:
    """All combinations that a pilot result permits. Their errors are added up once, for any accuracy."""

    def __init__(self, pilot_result: PilotResult, switches: Mapping[str, bool]) -> None:
        self.pilot_result, self.switches = pilot_result, switches
        self._chosen: dict[tuple[float, float], Candidate] = {}
        counts = [_choices(pilot_result, name, switches) for name in COUNTED]
        rows = np.array(list(product(*counts, (0, 1))), dtype=np.float64)
        if pilot_result.occluded:
            # Light of one anchor is what the sensor's centre sees, of several what all of it does: all pixels, or none.
            rows = rows[(rows[:, 0] > 1) == (rows[:, 4] > 1)]
        given = _omissions(switches)
        self._tables = [
            _Table(math.nan, pilot_result, (effects, cells), rows, given)
            for effects in _subsets(pilot_result, switches)
            for cells in pilot_result.forms(in_waves(effects))
        ]

    def best(self, accuracy: float, sure: float = SURE) -> tuple[_Table, int]:
        tables = [each.at(accuracy, sure) for each in self._tables]
        # Most leave out what no choice of numbers makes up for.
        found = [(table, table.best) for table in tables if table.accurate.any()]
        if not any(table.fits[index] for table, index in found):
            found = [(table, table.best) for table in tables]
        return min(found, key=lambda each: each[0].rank(each[1]))

    def choice(self, accuracy: float, sure: float = SURE) -> Candidate:
        if (accuracy, sure) not in self._chosen:
            table, index = self.best(accuracy, sure)
            self._chosen[accuracy, sure] = table.alone(index).candidate
        return self._chosen[accuracy, sure]

    def seconds(self, accuracy: float) -> tuple[float, bool]:
        """Return seconds of the choice and its truth, and True if it keeps ``accuracy``."""
        table, index = self.best(accuracy)
        truth = truth_seconds(self.pilot_result, table.settings(index), FIXED)
        return float(table.work[index]) + truth, bool(table.fits[index])


def predicted_candidate(
    accuracy: float, pilot_result: PilotResult, settings: Settings, switches: Mapping[str, bool]
) -> Candidate:
    """Predict the error and work of given ``settings``, with new sample counts for the rest of the budget."""
    return _table_of(accuracy, pilot_result, settings, switches).candidate


def _table_of(
    accuracy: float, pilot_result: PilotResult, settings: Settings, switches: Mapping[str, bool], sure: float = SURE
) -> _Table:
    row = np.array([[*counts_of(settings), settings.coarse_layers]], dtype=np.float64)
    drawn = pilot_result.raster[in_waves(settings.effects)]
    cells = (settings.raster_cells or drawn.cells[0]) if settings.raster or drawn.needed else 0
    return _Table(accuracy, pilot_result, (settings.effects, cells), row, _omissions(switches), sure)


def value_of_refining(accuracy: float, candidates: Candidates) -> tuple[float, Approximation]:
    """Return the work that an exact pilot result could save, and the part with the largest uncertainty."""
    careful, hopeful = (candidates.choice(accuracy, sure) for sure in (SURE, 0.0))
    unsure = _table_of(accuracy, candidates.pilot_result, hopeful.settings, candidates.switches, 0.0).unsure
    worst = max(sorted(unsure), key=lambda part: unsure[part], default=Approximation("cells", 1))
    if careful.fits:
        return careful.work - hopeful.work, worst
    lucky = candidates.choice(accuracy, _LUCKY)
    return lucky.work if lucky.fits else 0.0, worst


# -------- Predictions of many candidates


class _Table:
    """Predictions of many choices with the same effects and raster cells (``form``).

    Each of the ``rows`` (m, 6) has the numbers of ``COUNTED``, and 1 if coarse light has all layers. The ``given``
    parts are left out in any choice.
    """

    def __init__(
        self,
        accuracy: float,
        pilot_result: PilotResult,
        form: tuple[frozenset[str], int],
        rows: FloatArray,
        given: frozenset[Approximation],
        sure: float = SURE,
    ) -> None:
        self.effects, self.raster_cells = form
        self.accuracy, self.pilot_result, self.rows = accuracy, pilot_result, rows
        self.given, self.sure = given, sure
        self.numbers = Numbers.of_counts([*rows.T], self.effects, len(pilot_result.occluded), self.raster_cells)

    def at(self, accuracy: float, sure: float = SURE) -> _Table:
        """Return the same combinations at another ``accuracy``, sharing all that does not depend on it."""
        self._squares_of_given  # noqa: B018 - found once, and copied
        again = copy.copy(self)
        again.accuracy, again.sure = accuracy, sure
        return again

    def alone(self, index: int) -> _Table:
        form = self.effects, self.raster_cells
        return _Table(self.accuracy, self.pilot_result, form, self.rows[[index]], self.given, self.sure)

    def rank(self, index: int) -> tuple[bool, float, float]:
        """Return a key that sorts choices."""
        if not self.fits[index]:
            return True, float(self._avoidable[index]), 0.0
        return False, float(self.work[index]), float(self._avoidable[index])

    @cached_property
    def best(self) -> int:
        if self.fits.any():
            chosen = self.fits
        else:
            error = np.where(self._entries <= max(_MOST_ENTRIES, self._entries.min()), self._avoidable, math.inf)
            chosen = error <= _AS_GOOD * error.min()
        return int(np.lexsort((self._avoidable, self.work, ~chosen))[0])

    def settings(self, index: int) -> Settings:
        numbers = (int(number) for number in self.rows[index])
        anchors, layers, cells, followed, occluded, all_layers = numbers
        return Settings(
            depth=self.pilot_result.depth,
            anchors=anchors,
            layers=self.pilot_result.layers[layers] if layers > 1 else (),
            subdivision=cells,
            effects=self.effects,
            samples={name: float(count[index]) for name, count in self.needed.items()},
            followed_anchors=followed,
            coarse_layers=bool(all_layers),
            shared=self.pilot_result.shared,
            repeats=self.pilot_result.repeats,
            reach=self.pilot_result.reach,
            sharp=self.pilot_result.sharp,
            occluded=self.pilot_result.occluded,
            occluded_anchors=occluded,
            raster=self.raster_cells > 0,
            raster_cells=self.raster_cells,
        )

    @property
    def candidate(self) -> Candidate:
        pilot_result = self.pilot_result
        lacking = {
            "light over sharp lobes": pilot_result.unresolved,
            "light over mirrors or curved glass both ways, or once and a sharp lobe (left out)": pilot_result.left_out,
            "light over small mirrors alone (not resolved)": pilot_result.unresolved_specular,
        }
        missing = min(sum(lacking.values()), 1.0)
        # Errors of the light that is there count for its part of all.
        rest = [float(self._systematic(sure, frozenset())[0]) for sure in (0.0, SURE)]
        if not math.isinf(self.pilot_result.hits):
            one_hit = 1 / (self.pilot_result.hits * float(self.samples["direct"][0]))
            rest = [math.hypot(error, hits * one_hit) for error, hits in zip(rest, _OFF_BY_HITS, strict=True)]
        value, bound = (missing + (1 - missing) * error for error in rest)
        return Candidate(
            settings=self.settings(0),
            systematic=Estimate(value, bound),
            lacking=lacking,
            target=float(self.target[0]),
            noise=float(self.noise[0]),
            fits=bool(self.fits[0]),
            work=float(self.work[0]),
        )

    # ---- errors

    @cached_property
    def _avoidable(self) -> FloatArray:
        return self._systematic(self.sure, self.given)

    @property
    def unsure(self) -> dict[Approximation, float]:
        """Variance that chance may add to the squared error of the only row, by part."""
        weights = {part: float(self._weight(part)[0]) for part in self.pilot_result.changes.parts}
        errors = {part: self.pilot_result.error(part) for part, weight in weights.items() if weight}
        return {part: weights[part] ** 2 * (each.bound**2 - each.value**2) for part, each in errors.items()}

    def _systematic(self, sure: float, ignored: frozenset[Approximation]) -> FloatArray:
        apart = self.pilot_result.apart
        drawn = [
            size**2 for name, size in apart.items() if name not in self.effects and Approximation(name) not in ignored
        ]
        drawn += [self.pilot_result.sharp.left**2] if self.pilot_result.sharp else []
        cells = self.raster_cells
        of_raster = self.pilot_result.raster[in_waves(self.effects)].error_left(cells) if cells else None
        drawn += [of_raster[sure > 0] ** 2] if of_raster else []
        squared, spread = self._squares_of_given if ignored == self.given else self._squares(ignored)
        return np.asarray(np.sqrt(np.maximum(np.maximum(squared, 0) + sure * spread, 0) + sum(drawn)))

    @cached_property
    def _squares_of_given(self) -> tuple[FloatArray, FloatArray]:
        return self._squares(self.given)

    def _squares(self, ignored: frozenset[Approximation]) -> tuple[FloatArray, FloatArray]:
        changes = self.pilot_result.changes
        return changes.squared_errors(
            np.stack([self._weight(part) * (part not in ignored) for part in changes.parts], axis=1)
        )

    def _weight(self, part: Approximation) -> FloatArray:
        """Return the (m,) fraction of a part's change that each row leaves."""
        light, _, what = part.name.rpartition(" ")
        # Errors of even cells are of second order in their size.
        numbers, finer_cells = self.numbers, np.square(1 / self.numbers.coarse[0])
        if not part.count:
            return np.full(len(self.rows), float(part.name not in self.effects))
        if not light:
            left = np.asarray(float(bool(self.effects & FOLLOWED) or not part.name.startswith("followed")))
            if part == WIDE:
                return np.asarray((numbers.followed_anchors > 1) * finer_cells * left)
            return np.asarray((getattr(numbers, part.name) == part.count) * left, dtype=np.float64)
        row = PASSES[light]
        lit = row.connections(numbers) > 0 if row.anchors else numbers.indirect > 0
        # Several layers leave as much of one layer's error as they do of direct light.
        return np.asarray(lit * (finer_cells if what == "cells" else self._left_by_layers))

    @cached_property
    def _left_by_layers(self) -> FloatArray:
        ladder = self.pilot_result.ladders["layers"]
        parts = np.zeros(max(ladder) + 1)
        for count, error in ladder.items():
            parts[count] = min(error.bound / ladder[1].bound, 1.0) if ladder[1].bound else 0.0
        return np.where(self.rows[:, 5] > 0, parts[self.rows[:, 1].astype(int)], 1.0)

    # ---- samples and work

    @cached_property
    def accurate(self) -> npt.NDArray[np.bool_]:
        return self._avoidable < _MARGIN * self.accuracy

    @cached_property
    def fits(self) -> npt.NDArray[np.bool_]:
        return self.accurate & (self._entries <= _MOST_ENTRIES)

    @cached_property
    def target(self) -> FloatArray:
        """(m,) Monte Carlo error at which sampling may stop. Checks of all shots need no margin."""
        forming, left = self.pilot_result.forming, np.square(_MARGIN * self.accuracy) - np.square(self._avoidable)
        margin = _MARGIN if tells_all(forming.classes, forming.shots, forming.pixels) else 1.0
        target = np.where(left > 0, np.sqrt(np.maximum(left, 0)) / margin, _MARGIN * self.accuracy)
        return (
            target
            if math.isinf(self.pilot_result.hits)
            else target * math.sqrt(1 - (_ONE_HIT * _OFF_BY_HITS.bound) ** 2)
        )

    @cached_property
    def _work_of_sample(self) -> dict[str, Number]:
        lines = traced_for(self.pilot_result.forming.lines, self.pilot_result.forming.parted)
        return {
            name: lines * GROUPS * FIXED.passes[name] * sample_cost.paths * PASSES[name].connections(self.numbers)
            for name, sample_cost in sample_costs(self.pilot_result, self.effects).items()
        }

    @cached_property
    def samples(self) -> dict[str, FloatArray]:
        return {name: np.asarray(PASSES[name].whole(count)) for name, count in self.needed.items()}

    @cached_property
    def needed(self) -> dict[str, FloatArray]:
        """(m,) samples of a group, by pass, possibly below one: the least work for a sum of variances."""
        parts = {
            name: np.sqrt(self._by_row(name, lambda cost: cost.variance) * price)
            for name, price in self._work_of_sample.items()
        }
        every = sum(parts.values()) + np.zeros(len(self.rows))
        single = self.target * math.sqrt(GROUPS) / _BOUND_OVER_ERROR
        found = {}
        for name, part in parts.items():
            # Light without noise takes no share; a share of one keeps the division defined.
            share = np.sqrt(np.divide(part, every, out=np.ones(len(every)), where=part > 0))
            needed = self._by_row(name, partial(_samples_for, target=single * share))
            if name == "direct":
                needed = np.maximum(needed, 1 / (self.pilot_result.hits * _ONE_HIT * self.target))
            # What needs no whole sample does not take two when all others grow.
            found[name] = np.where(needed < 1, needed, PASSES[name].whole(needed))
        return found

    @cached_property
    def noise(self) -> FloatArray:
        total = np.zeros(len(self.rows))
        for name, count in self.samples.items():
            left = self._by_row(name, partial(_noise_after, samples=count))
            total = total + (PASSES[name].connections(self.numbers) > 0) * np.square(left) / GROUPS
        return np.sqrt(total)

    def _by_row(self, name: str, of: Callable[[SampleCost], Number]) -> FloatArray:
        found = of(sample_costs(self.pilot_result, self.effects)[name]) + np.zeros(len(self.rows))
        if name == "direct":
            found = np.where(self.rows[:, 0] > 1, of(self.pilot_result.spread), found)
        return np.asarray(found)

    @cached_property
    def _entries(self) -> FloatArray:
        pixels, classes = self.pilot_result.sample_costs["direct"].paths, self.pilot_result.forming.classes
        found = entries(pixels, classes, self.numbers, self.samples)
        return np.asarray(found) + np.zeros(len(self.rows))

    @cached_property
    def work(self) -> FloatArray:
        tracing = sum(self.samples[name] * price for name, price in self._work_of_sample.items())
        forming = self.pilot_result.forming
        accumulating = accumulation_seconds(forming, self.numbers, self._entries, FIXED)
        shown = optics_seconds(forming, self.numbers, FIXED) + checking_seconds(forming, self.numbers, FIXED)
        return np.asarray(tracing + accumulating + shown)


def _samples_for(kind: SampleCost, target: Number) -> Number:
    """Return the samples at which the bound on the error reaches ``target``; fewer heavy paths need more."""
    noise = kind.noise
    light = needed = noise.samples_for(target)
    if noise.spread:
        for _ in range(_SETTLED):
            above = 1 + _UNEVEN_GROUPS * np.sqrt(noise.spread * noise.samples / needed)
            needed = light * np.maximum(above / _BOUND_OVER_ERROR**2, 1.0)
    return needed


def _noise_after(kind: SampleCost, samples: Number) -> Number:
    return kind.noise.error_left(samples)


def counts_of(settings: Settings) -> tuple[int, ...]:
    numbers = Numbers.of(settings)
    return tuple(int(getattr(numbers, name)) for name in COUNTED)


def _choices(pilot_result: PilotResult, name: str, switches: Mapping[str, bool]) -> list[int]:
    counts = list(pilot_result.ladders[name])
    if name not in switches or len(counts) == 1:
        return counts
    return [count for count in counts if (count > 1) == switches[name]]


def _omissions(switches: Mapping[str, bool]) -> frozenset[Approximation]:
    off = {name for name, on in switches.items() if not on}
    if "anchors" in off:
        off.add("occluded_anchors")
    return frozenset(Approximation(name, int(name in COUNTED)) for name in off)


def _subsets(pilot_result: PilotResult, switches: Mapping[str, bool]) -> Iterator[frozenset[str]]:
    """Yield sets of effects that may be on together."""
    takes_time, present = costly_effects(), frozenset(pilot_result.effects)
    free = [name for name in EFFECTS if name in takes_time & present and name not in switches]
    always = {name for name in EFFECTS if switches.get(name, name in present - takes_time)}
    for several in chain.from_iterable(combinations(free, count) for count in range(len(free) + 1)):
        yield frozenset(always | set(several))


def costly_effects() -> frozenset[str]:
    """Return the names of effects that take time."""
    traced = frozenset[str]().union(*(row.effects for row in PASSES.values()))
    return traced | names(lambda effect: effect.in_shadow) | {MIXING}


def unit_costs_of(pilot_result: PilotResult) -> UnitCosts:
    """Return the measured unit costs, and the fixed ones where nothing was measured."""
    # All matrix work is as much slower or faster as the products.
    slower = (pilot_result.forming.product or FIXED.product) / FIXED.product
    measured = {name: cost.seconds for name, cost in pilot_result.sample_costs.items() if cost.seconds}
    matrices = {name: slower * getattr(FIXED, name) for name in ("frame", "product", "entry", "accumulated", "pixel")}
    ray = pilot_result.spread.seconds * FIXED.ray / FIXED.passes["direct"] or FIXED.ray
    return UnitCosts(passes={**FIXED.passes, **measured}, ray=ray, **matrices)


# -------- The finest accuracy that a time buys
# Accuracies are tried on a grid, by bisection: more seconds never buy a coarser one.

FIRST_ACCURACY = 1e-3
"""Accuracy of the first pilot run; a looser accuracy takes as long."""
_STEPS, _DECADES = 10, 5
"""Tried accuracies per decade, and decades. The finest, 1e-5, is near the end of the ladders of anchors and cells."""


@dataclass(frozen=True)
class AccuracyForTime:
    """An ``accuracy``, the predicted ``seconds`` of its run, and True if these fit the given time."""

    accuracy: float
    seconds: float
    fits: bool


def accuracies(finest: float) -> list[float]:
    steps = (float(f"{10 ** (-step / _STEPS):.3g}") for step in range(_DECADES * _STEPS + 1))
    return [HIGHEST_ACCURACY, *(each for each in steps if finest <= each < HIGHEST_ACCURACY)]


def accuracy_for_time(candidates: Candidates, seconds: float, finest: float, kept: bool = True) -> AccuracyForTime:
    """Return the finest accuracy whose light, frames and truth take at most ``seconds``, or the loosest."""

    def try_accuracy(accuracy: float) -> AccuracyForTime:
        taken, keeps = candidates.seconds(accuracy)
        return AccuracyForTime(accuracy, taken, taken <= seconds and (keeps or not kept))

    grid = accuracies(finest)
    best, too_fine = try_accuracy(grid[0]), len(grid)
    if not best.fits:
        # What keeps no accuracy at all is for the plan to say; here only time counts.
        return AccuracyForTime(best.accuracy, best.seconds, best.seconds <= seconds)
    coarse = 0
    while too_fine - coarse > 1:
        middle = (coarse + too_fine) // 2
        found = try_accuracy(grid[middle])
        if found.fits:
            best, coarse = found, middle
        else:
            too_fine = middle
    return best


def time_warnings(found: AccuracyForTime, seconds: float, around: float) -> Iterator[str]:
    """Yield a warning if the run needs more than ``seconds``, of which ``around`` are for other stages."""
    if not found.fits:
        yield (
            f"{seconds:g} seconds are too few: even accuracy {found.accuracy:g}, which was taken, is predicted to take "
            f"{found.seconds + around:.1f} s from start to finish; give more"
        )
