"""Lines and daylight of any brightness in; mean Delta E of a chart by illuminance, its claim, figure and tables out.

Measured by two ways to solve the same frames, and the least that any linear image without bias comes to
(:mod:`mitsim.study.colour.daylight`), from which follows what keeps the goal in more light: repeats, or laser power.
Frames of k times the power in k times the daylight are the same at a k-th of the exposure, so that power counts as less
daylight does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise, product

import numpy as np
from matplotlib.figure import Figure

from mitsim.core.arrays import FloatArray
from mitsim.reconstruct.asked import MARKOV, TIKHONOV
from mitsim.reconstruct.colour import ColourModel, chart, delta_e
from mitsim.rig.chart import ChartPlace
from mitsim.study.charts import curves
from mitsim.study.colour.daylight import FULL_LX, DaylitLine, expected, most
from mitsim.study.colour.lit import LitLine
from mitsim.study.compare import label
from mitsim.study.experiment import Claim, Found, PageTable, Point, Scope, Setup
from mitsim.study.table import Mean, Table
from mitsim.study.verdicts import verdict, within

GOAL = 0.5
"""Most that 49 dots may add to the floor's mean Delta E."""
BY_LUX = "D65, by its illuminance"
"""Rows of the mean Delta E under :data:`LADDER_LX`, by ``method``; they have no patches."""
LADDER_LX, DRAWS = (0.0, 5.0, 10.0, 20.0, 60.0, 200.0, 600.0), 3
"""Illuminances of daylight [lx], dark, dusk, a dim room, a bright office; and exposures at each."""
LEAST = "least without bias"
METHODS = TIKHONOV, MARKOV, LEAST
"""Of the column ``method``: two ways to solve the same frames, and what no linear image without bias is below."""
_FEW_LX, _ASKED_LX = (0.0, 60.0), (60.0, 600.0)
"""Of a quick look: the dark, and where the goal is near its end; and those for which the page says what they take."""
_FAMILIES = ("dots:7", "hadamard:8")
_BETWEEN_LX, _VARIANCES = (1e-2, 1e5), (1e-6, 1.0)
"""Where the illuminance that keeps the goal, and the part of one exposure's variance that does, are looked for."""


def points_of(scope: Scope, setup: Setup) -> list[Point]:
    """A point for each family: all of its exposures share its frames.

    Parameters
    ----------
    scope, setup
        how much is wanted, and of what.
    """
    ladder, draws = (_FEW_LX, 2) if scope.quick else (LADDER_LX, DRAWS)
    lux = " ".join(f"{each:g}" for each in ladder)
    return [
        Point.of(setup, way=BY_LUX, patterns=patterns, seed=scope.seeds[0], ladder=lux, draws=draws)
        for patterns in scope.chosen(_FAMILIES, _FAMILIES[:1])
    ]


def measured(lines: Sequence[LitLine], light: tuple[FloatArray, float], point: Point, place: ChartPlace) -> Found:
    """A row for every exposure and method, and one of the least for every illuminance.

    Parameters
    ----------
    lines
        the scene in each line's light.
    light
        daylight as bright as the projector: irradiance (m, m') [W m^-2], and wavelength [nm] of its photons.
    point
        of :func:`points_of`.
    place
        of the chart's patches.
    """
    ladder = [float(lux) for lux in str(point["ladder"]).split()]
    model, known = ColourModel.of_lines([line.wavelength_nm for line in lines]), chart()
    board = lines[0].factors.manifest.board_reflectance or 1.0

    def judged(means: FloatArray) -> FloatArray:
        return delta_e(model.xyz(means * board), known.xyz)

    lit = [DaylitLine.of(line, light, str(point["patterns"]), int(point["seed"])) for line in lines]
    draws = list(product(ladder, range(int(point["draws"]))))
    exposures = [(lux / FULL_LX, draw) for lux, draw in draws]
    images = [each.images(exposures, [each.model, each.model.correlated()], each.shots) for each in lit]
    truth = place.means(np.stack([line.lit.truth for line in lines], axis=-1))
    goal = float(delta_e(model.xyz(known.at(model.wavelengths_nm)), known.xyz).mean()) + GOAL

    def least(lux: float, repeats: float = 1.0) -> float:
        variances = [each.least_variance(lux / FULL_LX, place) / repeats for each in lit]
        return expected(truth, np.stack(variances, axis=-1), judged)

    def repeats(lux: float) -> float | None:
        part = most(lambda part: least(lux, 1 / part) <= goal, *_VARIANCES)
        return float(np.ceil(1 / part)) if part else None

    kept = most(lambda lux: least(lux) <= goal, *_BETWEEN_LX)
    rows = [
        point.row(lux=lux, draw=draw, method=method, mean_delta_e=float(judged(place.means(image)).mean()))
        for (lux, draw), by_line in zip(draws, zip(*images, strict=True), strict=True)
        for method, image in zip((TIKHONOV, MARKOV), np.moveaxis(np.array(by_line), 0, -1), strict=True)
    ]
    for lux in ladder:
        power = lux / kept if kept else None
        told = {"kept_lx": kept, "repeats": repeats(lux), "power": power}
        rows.append(point.row(lux=lux, method=LEAST, mean_delta_e=least(lux), **told))
    return Found(tuple({**row, "goal_delta_e": goal} for row in rows))


def claim_of(rows: Table, patterns: str) -> Claim:
    """Up to which illuminance a family keeps the goal.

    Parameters
    ----------
    rows, patterns
        those of :data:`BY_LUX`, and the family.
    """
    own = rows.where(patterns=patterns)
    by_lux, goal = own.where(method=MARKOV).means("mean_delta_e", "lux"), own.mean("goal_delta_e").value
    kept, last = kept_lx(by_lux, goal), max(by_lux)
    limit = f"the brightest tried, {last:g} lx" if kept == last else f"{_digits(kept)} lx"
    least = own.mean("kept_lx", method=LEAST).value
    holds = within(by_lux[last if kept == last else min(by_lux)], high=goal) if kept in (0, last) else True
    return Claim(
        f"{label(patterns)} add at most {GOAL:g} to the floor's mean Delta E 2000 beside D65 ({MARKOV})", "", "",
        f"kept up to {limit}; without bias at best up to {_digits(least)} lx",
        verdict(holds) if kept in (0, last) else f"confirmed only if D65 has at most {_digits(kept)} lx",
    )  # fmt: skip


def kept_lx(by_lux: Mapping[float, Mean], goal: float) -> float:
    """Illuminance [lx] up to which a mean Delta E is at most a goal; 0 where it never is.

    Parameters
    ----------
    by_lux
        by illuminance [lx]; straight between two over the logarithm, from the dark on over the illuminance itself.
    goal
        the most.
    """
    order = sorted(by_lux)
    if by_lux[order[0]].value > goal:
        return 0.0
    for low, high in pairwise(order):
        first, second = by_lux[low].value, by_lux[high].value
        if second > goal:
            share = (goal - first) / (second - first)
            return float(low * (high / low) ** share if low else high * share)
    return order[-1]


def _digits(value: float) -> str:
    """A ``value`` to two digits, without a power of ten."""
    return f"{float(f'{value:.2g}'):g}"


def figure(rows: Table) -> Figure:
    """Mean Delta E by the illuminance of daylight, measured and least, and what is allowed; ``rows`` of
    :data:`BY_LUX`."""
    panels = {}
    for patterns in rows.distinct("patterns"):
        own = rows.where(patterns=patterns)
        shown = {method: own.where(method=method).means("mean_delta_e", "lux") for method in METHODS}
        shown[f"floor + {GOAL:g}"] = own.means("goal_delta_e", "lux")
        panels[label(patterns)] = {
            name: {lux: mean for lux, mean in curve.items() if lux} for name, curve in shown.items()
        }
    return curves(panels, "D65 on the chart [lx]", "mean Delta E 2000 of 24 patches", log=True)


def tables(rows: Table) -> tuple[PageTable, PageTable]:
    """Mean Delta E by illuminance, and what keeps the goal; ``rows`` of :data:`BY_LUX`."""
    families = [str(patterns) for patterns in rows.distinct("patterns")]
    pairs = list(product(families, METHODS))
    asked = [lux for lux in rows.distinct("lux") if lux in _ASKED_LX]

    def cell(lux: float, family: str, method: str) -> str:
        mean = rows.mean("mean_delta_e", lux=lux, patterns=family, method=method)
        return f"{mean.value:.2f}" if mean.of == 1 else f"{mean.value:.2f} \N{PLUS-MINUS SIGN} {mean.error:.2f}"

    def needs(family: str) -> tuple[str, ...]:
        least = rows.where(patterns=family, method=LEAST)
        by_lux = rows.where(patterns=family, method=MARKOV).means("mean_delta_e", "lux")
        kept = kept_lx(by_lux, least.mean("goal_delta_e").value), least.mean("kept_lx").value
        told = [(least.numbers("repeats", lux=lux), least.numbers("power", lux=lux)) for lux in asked]
        return (
            label(family), *map(_digits, kept),
            *(f"{count[0]:g}; {_digits(max(power[0], 1))}" if count and power else "never" for count, power in told),
        )  # fmt: skip

    count = len(rows.where(method=MARKOV).distinct("draw"))
    return (
        PageTable(
            "Mean Delta E 2000 of 24 patches by the illuminance of D65 on the chart: mean and standard error of "
            f"{count} exposures, less a frame of as many shots as patterns",
            ("D65 [lx]", *(f"{label(family)}, {method}" for family, method in pairs)),
            tuple((f"{lux:g}", *(cell(lux, *pair) for pair in pairs)) for lux in rows.distinct("lux")),
        ),
        PageTable(
            f"What keeps the mean Delta E at most {GOAL:g} above the floor: D65 [lx] with one exposure a pattern; in "
            "more light repeats of all exposures, or times the laser power (the same as a filter that lets through "
            "one over that part of D65), by the least noise without bias",
            ("Patterns", f"Most [lx], {MARKOV}", f"Most [lx], {LEAST}",
             *(f"{lux:g} lx: repeats; power" for lux in asked)),
            tuple(map(needs, families)),
        ),
    )  # fmt: skip
