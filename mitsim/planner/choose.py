"""Choice of the cheapest settings that keep an accuracy, with their predicted error and work.

For every combination of effects, anchors, layers and cells, the error of all that it leaves out or makes coarse is
predicted with signs, then the samples that keep the rest of the budget, and the work at fixed unit costs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, combinations, product
from typing import NamedTuple

import numpy as np

from mitsim.bench.effects import EFFECTS, names
from mitsim.core.arrays import FloatArray
from mitsim.light import cost_model
from mitsim.light.passes import FOLLOWED, PASSES
from mitsim.light.settings import COUNTED, GROUPS, SURE, WIDE, Approximation, Estimate, Number, PilotResult, Settings

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
"""Error of a small target's light [hits in a group] beyond the spread of groups: rms of 40 runs, and twice that."""
SHARP_LOBES, MIRRORS_TWICE, SMALL_MIRRORS = (
    "light over lobes too sharp to sample, of which the frames lack most",
    "light over a mirror or curved glass twice, or once and a sharp lobe (left out)",
    "light over mirrors and curved glass alone, in beams too fine to be placed on the sensor",
)
"""Light that frames lack."""
_BOUND_OVER_ERROR = 1.1
"""Ratio of the 95 % bound, by which sampling stops, to the error (measured: 1.04 to 1.3)."""


@dataclass(frozen=True)
class Candidate:
    """Settings with their predicted error and work.

    ``systematic`` is the error of all that is left out or made coarse, and ``lacking`` the missing light in it, by its
    cause. ``fits`` ignores errors that no choice avoids. ``work`` is in seconds at fixed unit costs.
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
        return Estimate(*(math.hypot(error, self.noise) for error in self.systematic))


class Candidates:
    def __init__(self, pilot_result: PilotResult, switches: Mapping[str, bool]) -> None:
        self.pilot_result, self.switches = pilot_result, switches
        self._chosen: dict[tuple[float, float], Candidate] = {}
        counts = []
        for name in COUNTED:
            ladder = list(pilot_result.ladders[name])
            free = name not in switches or len(ladder) == 1
            counts.append(ladder if free else [count for count in ladder if (count > 1) == switches[name]])
        rows = np.array(list(product(*counts, (0, 1))), dtype=np.float64)
        if pilot_result.occluded:
            # Light of one anchor is what the sensor's centre sees, of several what all of it does: all pixels, or none.
            rows = rows[(rows[:, 0] > 1) == (rows[:, 4] > 1)]
        takes_time, present, given = costly_effects(), frozenset(pilot_result.effects), _omissions(switches)
        free_ones = [name for name in EFFECTS if name in takes_time & present and name not in switches]
        always = {name for name in EFFECTS if switches.get(name, name in present - takes_time)}
        subsets = chain.from_iterable(combinations(free_ones, count) for count in range(len(free_ones) + 1))
        self._tables = [
            _Table(pilot_result, frozenset(always | set(several)), cells, rows, given)
            for several in subsets
            for cells in pilot_result.forms(cost_model.in_waves(frozenset(always | set(several))))
        ]

    def choice(self, accuracy: float, sure: float = SURE) -> Candidate:
        """Return the choice of least work that keeps ``accuracy``, or of least error if none does.

        Errors that no choice avoids are ignored. ``sure`` is the number of standard errors added to each estimate.
        """
        if (accuracy, sure) not in self._chosen:
            # Most combinations omit light for which no choice of numbers compensates.
            most = _MARGIN * accuracy
            accurate = [table for table in self._tables if (table.systematic(sure, table.given) < most).any()]
            found = [table.predict(accuracy, sure) for table in accurate]
            if all(each.rank[0] for each in found):
                found = [table.predict(accuracy, sure) for table in self._tables]
            _, table, row, *_ = min(found, key=lambda each: each.rank)
            one = _Table(self.pilot_result, table.effects, table.raster_cells, table.rows[[row]], table.given)
            self._chosen[accuracy, sure] = one.candidate(accuracy, sure)
        return self._chosen[accuracy, sure]


def table_of(pilot_result: PilotResult, settings: Settings, switches: Mapping[str, bool]) -> _Table:
    row = np.array([[*counts_of(settings), settings.coarse_layers]], dtype=np.float64)
    drawn = pilot_result.raster[cost_model.in_waves(settings.effects)]
    cells = (settings.raster_cells or drawn.cells[0]) if settings.raster or drawn.needed else 0
    return _Table(pilot_result, settings.effects, cells, row, _omissions(switches))


def value_of_refining(accuracy: float, candidates: Candidates) -> tuple[float, Approximation]:
    careful, hopeful = (candidates.choice(accuracy, sure) for sure in (SURE, 0.0))
    result, unsure = candidates.pilot_result, dict[Approximation, float]()
    table = table_of(result, hopeful.settings, candidates.switches)
    for part in result.changes.parts:
        if weight := float(table.weight(part)[0]):
            unsure[part] = weight**2 * (result.error(part).bound ** 2 - result.error(part).value ** 2)
    worst = max(sorted(unsure), key=lambda part: unsure[part], default=Approximation("cells", 1))
    if careful.fits:
        return careful.work - hopeful.work, worst
    lucky = candidates.choice(accuracy, _LUCKY)
    return lucky.work if lucky.fits else 0.0, worst


# -------- Predictions of many candidates


class _Prediction(NamedTuple):
    """Best row of a table at an accuracy, with its rank among the tables' best ones.

    ``needed`` samples (1,) may be below one.
    """

    rank: tuple[bool, float, float]
    table: _Table
    row: int
    target: float
    work: float
    needed: Mapping[str, FloatArray]
    samples: Mapping[str, FloatArray]


class _Table:
    """Choices with the same effects and raster cells.

    Each of the ``rows`` (m, 6) has the numbers of ``COUNTED``, and 1 if coarse light has all layers. The ``given``
    parts are left out in any choice.
    """

    def __init__(
        self,
        pilot_result: PilotResult,
        effects: frozenset[str],
        raster_cells: int,
        rows: FloatArray,
        given: frozenset[Approximation],
    ) -> None:
        self.pilot_result, self.effects, self.raster_cells = pilot_result, effects, raster_cells
        self.rows, self.given = rows, given
        self.numbers = cost_model.Numbers.of_counts([*rows.T], effects, len(pilot_result.occluded), raster_cells)

    # ---- errors

    def systematic(self, sure: float, ignored: frozenset[Approximation]) -> FloatArray:
        result, cells = self.pilot_result, self.raster_cells
        drawn = [
            size**2
            for name, size in result.apart.items()
            if name not in self.effects and Approximation(name) not in ignored
        ]
        drawn += [result.sharp.left**2] if result.sharp else []
        of_raster = result.raster[cost_model.in_waves(self.effects)].error_left(cells) if cells else None
        drawn += [of_raster[sure > 0] ** 2] if of_raster else []
        squared, spread = self._squares_of_given if ignored == self.given else self._squares(ignored)
        return np.asarray(np.sqrt(np.maximum(np.maximum(squared, 0) + sure * spread, 0) + sum(drawn)))

    @cached_property
    def _squares_of_given(self) -> tuple[FloatArray, FloatArray]:
        return self._squares(self.given)

    def _squares(self, ignored: frozenset[Approximation]) -> tuple[FloatArray, FloatArray]:
        changes = self.pilot_result.changes
        weights = [self.weight(part) * (part not in ignored) for part in changes.parts]
        return changes.squared_errors(np.stack(weights, axis=1))

    def weight(self, part: Approximation) -> FloatArray:
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
        if what == "cells":
            return np.asarray(lit * finer_cells)
        # Several layers leave as much of one layer's error as they do of direct light.
        ladder = self.pilot_result.ladders["layers"]
        parts = np.zeros(max(ladder) + 1)
        for count, error in ladder.items():
            parts[count] = min(error.bound / ladder[1].bound, 1.0) if ladder[1].bound else 0.0
        return np.asarray(lit * np.where(self.rows[:, 5] > 0, parts[self.rows[:, 1].astype(int)], 1.0))

    # ---- samples and work

    def predict(self, accuracy: float, sure: float) -> _Prediction:
        result, forming, numbers = self.pilot_result, self.pilot_result.forming, self.numbers
        avoidable, none = self.systematic(sure, self.given), np.zeros(len(self.rows))

        # ---- Monte Carlo error at which sampling may stop; checks of all shots need no margin
        left = np.square(_MARGIN * accuracy) - np.square(avoidable)
        margin = _MARGIN if cost_model.tells_all(forming.classes, forming.shots, forming.pixels) else 1.0
        target = np.where(left > 0, np.sqrt(np.maximum(left, 0)) / margin, _MARGIN * accuracy)
        if not math.isinf(result.hits):
            target = target * math.sqrt(1 - (_ONE_HIT * _OFF_BY_HITS.bound) ** 2)

        # ---- Samples of a group: the least work for a sum of variances
        lines = cost_model.traced_for(forming.lines, forming.parted)
        work_of_sample = {
            name: lines * GROUPS * PASSES[name].unit_cost * cost.paths * PASSES[name].connections(numbers)
            for name, cost in cost_model.sample_costs(result, self.effects).items()
        }
        parts = {
            name: np.sqrt(self._by_row(name, lambda cost: cost.variance) * price)
            for name, price in work_of_sample.items()
        }
        every, single = sum(parts.values()) + none, target * math.sqrt(GROUPS) / _BOUND_OVER_ERROR
        found = {}
        for name, part in parts.items():
            # Light without noise takes no share; a share of one keeps the division defined.
            share = np.sqrt(np.divide(part, every, out=np.ones(len(every)), where=part > 0))
            needed = self._by_row(name, lambda cost, most: cost.samples_for(most), single * share)
            if name == "direct":
                needed = np.maximum(needed, 1 / (result.hits * _ONE_HIT * target))
            # A pass that needs less than one sample does not get two when all others grow.
            found[name] = np.where(needed < 1, needed, PASSES[name].whole(needed))
        samples = {name: np.asarray(PASSES[name].whole(count)) for name, count in found.items()}

        # ---- Work, and the best row
        held = (
            np.asarray(cost_model.entries(result.sample_costs["direct"].paths, forming.classes, numbers, samples))
            + none
        )
        tracing = sum(samples[name] * price for name, price in work_of_sample.items())
        accumulating = cost_model.accumulation_seconds(forming, numbers, held)
        shown = cost_model.optics_seconds(forming, numbers) + cost_model.checking_seconds(forming, numbers)
        work = np.asarray(tracing + accumulating + shown)
        fits = (avoidable < _MARGIN * accuracy) & (held <= _MOST_ENTRIES)
        chosen = fits
        if not fits.any():
            error = np.where(held <= max(_MOST_ENTRIES, held.min()), avoidable, math.inf)
            chosen = error <= _AS_GOOD * error.min()
        best = int(np.lexsort((avoidable, work, ~chosen))[0])
        least, seconds = float(avoidable[best]), float(work[best])
        rank = (False, seconds, least) if fits[best] else (True, least, 0.0)
        counts = ({name: count[[best]] for name, count in each.items()} for each in (found, samples))
        return _Prediction(rank, self, best, float(target[best]), seconds, *counts)

    def candidate(self, accuracy: float, sure: float) -> Candidate:
        """Return the settings of a table of one row, with their predicted error and work."""
        result, found = self.pilot_result, self.predict(accuracy, sure)
        noise = np.zeros(len(self.rows))
        for name, count in found.samples.items():
            left = self._by_row(name, lambda cost, own: cost.error_left(own), count)
            noise = noise + (PASSES[name].connections(self.numbers) > 0) * np.square(left) / GROUPS
        lacking = {
            SHARP_LOBES: result.unresolved,
            MIRRORS_TWICE: result.left_out,
            SMALL_MIRRORS: result.unresolved_specular,
        }
        missing = min(sum(lacking.values()), 1.0)
        # Errors of the light that is there count for its part of all.
        rest = [float(self.systematic(each, frozenset())[0]) for each in (0.0, SURE)]
        if not math.isinf(result.hits):
            one_hit = 1 / (result.hits * float(found.samples["direct"][0]))
            rest = [math.hypot(error, hits * one_hit) for error, hits in zip(rest, _OFF_BY_HITS, strict=True)]
        anchors, layers, cells, followed, occluded, all_layers = (int(number) for number in self.rows[0])
        settings = Settings(
            **{name: getattr(result, name) for name in ("depth", "shared", "repeats", "reach", "sharp", "occluded")},
            anchors=anchors,
            layers=result.layers[layers] if layers > 1 else (),
            subdivision=cells,
            effects=self.effects,
            samples={name: float(count[0]) for name, count in found.needed.items()},
            followed_anchors=followed,
            coarse_layers=bool(all_layers),
            occluded_anchors=occluded,
            raster=self.raster_cells > 0,
            raster_cells=self.raster_cells,
        )
        systematic = Estimate(*(missing + (1 - missing) * error for error in rest))
        left_noise = float(np.sqrt(noise)[0])
        return Candidate(settings, systematic, lacking, found.target, left_noise, not found.rank[0], found.work)

    def _by_row(self, name: str, of: Callable[..., Number], *by: Number) -> FloatArray:
        found = of(cost_model.sample_costs(self.pilot_result, self.effects)[name], *by) + np.zeros(len(self.rows))
        if name == "direct":
            found = np.where(self.rows[:, 0] > 1, of(self.pilot_result.spread, *by), found)
        return np.asarray(found)


def counts_of(settings: Settings) -> tuple[int, ...]:
    numbers = cost_model.Numbers.of(settings)
    return tuple(int(getattr(numbers, name)) for name in COUNTED)


def _omissions(switches: Mapping[str, bool]) -> frozenset[Approximation]:
    off = {name for name, on in switches.items() if not on}
    if "anchors" in off:
        off.add("occluded_anchors")
    return frozenset(Approximation(name, int(name in COUNTED)) for name in off)


def costly_effects() -> frozenset[str]:
    traced = frozenset[str]().union(*(row.effects for row in PASSES.values()))
    return traced | names(lambda effect: effect.in_shadow) | {cost_model.MIXING}
