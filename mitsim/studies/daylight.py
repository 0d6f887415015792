"""A scene in a line's light and daylight beside it in; images of noisy exposures, and the least noise of patches, out.

The brightest pixel fills the well in every frame, by daylight too, whose frame is taken off. That frame's noise is the
same in all frames, so in the mean over a region it adds up: it is the mean of as many shots as there are patterns,
which then bring as much noise as the patterns' own frames. (A joint estimate of image and daylight is a few per cent
less noisy; signed patterns need none.)

Of all linear images without bias the least-squares one (lambda = 0) has the least variance (Gauss and Markov). With B =
U S V^T on each side, the mean over a patch of the rows 1_r and columns 1_c has, a = V_L^T 1_r / s_L and b = V_R^T 1_c /
s_R, the variance

    (v |a|^2 |b|^2 + v_0 |(sum_i U_Li) a|^2 |(sum_j U_Rj) b|^2) / pixels^2

with v the variance of a datum and v_0 that of the frame which is taken off.

Measured by two ways to solve the same frames, and the least that any linear image without bias comes to, from which
follows what keeps the goal in more light: repeats, or laser power. Frames of k times the power in k times the daylight
are the same at a k-th of the exposure, so that power counts as less daylight does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product

import numpy as np
from matplotlib.figure import Figure

from mitsim.acquire.exposure import Exposer
from mitsim.core.arrays import FloatArray
from mitsim.core.parallel import single_threaded_blas
from mitsim.devices.chart import ChartPlace
from mitsim.devices.patterns import PatternFamily
from mitsim.reconstruct.colour import ColourModel, chart, delta_e
from mitsim.reconstruct.factorisation import Side
from mitsim.reconstruct.request import MARKOV, TIKHONOV
from mitsim.reconstruct.solver import Prepared, prepare
from mitsim.report import RENDERED, label
from mitsim.report.pages import Mean, Table
from mitsim.report.plots import curves
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.studies.framework.claims import verdict, within
from mitsim.studies.framework.experiment import Claim, Found, PageTable, Scope
from mitsim.studies.framework.setup import Point, Setup
from mitsim.studies.lit_lines import LitLine, expose_rates, peak_seconds

LUMENS_A_WATT = 205.0
"""Of D65, 380 to 780 nm."""
FULL_LX = 2.97 * LUMENS_A_WATT
"""Illuminance of daylight as bright as the projector's white light, which is 2.97 W/m^2 on the chart's middle."""


_DRAWS = 400
"""Of the errors of all patches, of which a mean is taken: its standard error is some 0.5 % of what they add."""
Judge = Callable[[FloatArray], FloatArray]
"""From means (..., patches, lines) to Delta E (..., patches)."""


@dataclass(frozen=True, eq=False)
class DaylitLine:
    """Frames of a line before any exposure.

    Attributes
    ----------
    line
        the scene in its light.
    family
        the patterns.
    lamp
        (m, m') electrons a second of daylight as bright as the projector.
    """

    line: LitLine
    family: PatternFamily
    lamp: FloatArray

    @classmethod
    def of(cls, line: LitLine, light: tuple[FloatArray, float], patterns: str, seed: int) -> DaylitLine:
        """Those of a line beside daylight.

        Parameters
        ----------
        line, patterns, seed
            the scene, the family, and its seed.
        light
            irradiance (m, m') [W m^-2] of daylight as bright as the projector, and wavelength [nm] of its photons.
        """
        bench = line.lit.bench
        return cls(line, bench.family(patterns, seed), electrons_from_irradiance(light[0], 1.0, bench.sensor, light[1]))

    def rates(self) -> list[FloatArray]:
        """(m, m') electrons a second of every shot in the dark."""
        unit = Exposer(self.line.lit.bench.rig, 1.0, 0)
        return [unit.electrons(frame) for frame in self.line.lit.expected(RENDERED, self.family)]

    @cached_property
    def levels(self) -> tuple[FloatArray, float]:
        """(m, m') the brightest shot at each pixel in the dark, and the mean of all [electrons/s]."""
        rates = self.rates()
        return np.maximum.reduce(rates), float(np.mean([rate.mean() for rate in rates]))

    @cached_property
    def model(self) -> Prepared:
        """The factorised model."""
        factors, family = self.line.factors, self.family
        with single_threaded_blas():
            return prepare(*factors.sides, family.left, family.right, centre=factors.manifest.centre)

    @property
    def shots(self) -> int:
        """Shots of the frame that is taken off: as many as patterns."""
        return 0 if self.family.signed else len(self.family.shots)

    def seconds(self, part: float) -> float:
        """Exposure time [s] of each shot in daylight that is so bright a ``part`` of the projector's light."""
        return peak_seconds(self.line.lit.bench.sensor, [self.levels[0] + part * self.lamp])

    def images(
        self, exposures: Sequence[tuple[float, int]], models: Sequence[Prepared], shots: int
    ) -> list[list[FloatArray]]:
        """Of each noisy exposure of all patterns, an image (n, n') by each of some models, with automatic lambda.

        Parameters
        ----------
        exposures
            part of daylight, as for :meth:`seconds`, and seed of the noise, of each.
        models
            the factorised model, and others of the same frames.
        shots
            of the frame that is taken off.
        """
        rates = self.rates()
        with single_threaded_blas():
            return [self._images(rates, each, models, shots) for each in exposures]

    def _images(
        self, rates: Sequence[FloatArray], exposure: tuple[float, int], models: Sequence[Prepared], shots: int
    ) -> list[FloatArray]:
        lamp, sums = exposure[0] * self.lamp, [model.accumulator() for model in models]
        exposer = Exposer(self.line.lit.bench.rig, self.seconds(exposure[0]), self.line.seed(exposure[1]))
        off: FloatArray | float = 0.0
        for shot in range(shots):
            off = off + exposer.rate(exposer.digital(lamp * exposer.exposure_s, "ambient", shot)) / shots
        for measured in expose_rates(exposer, self.family, [rate + lamp for rate in rates], off):
            for each in sums:
                each.add(*measured)
        return [model.solve(each, "auto").image for model, each in zip(models, sums, strict=True)]

    def least_variance(self, part: float, place: ChartPlace) -> FloatArray:
        """(patches,) least variance of the means over a chart's patches that an image without bias has.

        Parameters
        ----------
        part
            of daylight, as for :meth:`seconds`.
        place
            of the patches.
        """
        bench, seconds, lamp = self.line.lit.bench, self.seconds(part), part * self.lamp
        exposer, read = Exposer(bench.rig, seconds, 0), 2 if self.family.signed else 1
        frames, off = ((exposer.sensor_noise((light + lamp) * seconds) / seconds) ** 2 for light in (self.levels[1], 0))
        own, common = self._noise_gain(place)
        return read * frames * own + (off / self.shots * common if self.shots else 0.0)

    def _noise_gain(self, place: ChartPlace) -> tuple[FloatArray, FloatArray]:
        """(patches,) variances of means over a unit of noise in every frame, and in what is taken off all of them."""
        both = []
        for top, bottom, first, last in place.patches:
            sides = _weights(self.model.left, top, bottom), _weights(self.model.right, first, last)
            both.append(np.prod(sides, axis=0) / ((bottom - top) * (last - first)) ** 2)
        own, common = np.array(both).T
        return own, common


def _weights(side: Side, first: int, end: int) -> tuple[float, float]:
    """|a|^2 and |(sum_i U_i) a|^2 of the mean over scene rows ``first`` up to ``end``."""
    a = np.divide(
        side.basis[first:end].sum(axis=0), side.singular, out=np.zeros_like(side.singular), where=side.singular > 0
    )
    return float(a @ a), float(np.square(side.common @ a).sum())


def expected_delta_e(means: FloatArray, variances: FloatArray, judged: Judge) -> float:
    """Mean Delta E that patches come to whose means have independent normal errors.

    Parameters
    ----------
    means, variances
        (patches, lines) without error, and of the error.
    judged
        from means (..., patches, lines) to Delta E.
    """
    errors = np.random.default_rng(0).standard_normal((_DRAWS, *means.shape))
    return float(judged(means + np.sqrt(variances) * errors).mean())


def most(keeps: Callable[[float], bool], low: float, high: float) -> float:
    """The largest number that is kept, to 1 %; 0 where none is.

    Parameters
    ----------
    keeps
        whether a number is; all below one are, none above.
    low, high
        ends of where it is looked for, above 0.
    """
    if keeps(high):
        return high
    if not keeps(low):
        return 0.0
    while high > 1.01 * low:
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if keeps(middle) else (low, middle)
    return low


# -------- Lines and daylight of any brightness in

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


def measure_ladder(lines: Sequence[LitLine], light: tuple[FloatArray, float], point: Point, place: ChartPlace) -> Found:
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
        return expected_delta_e(truth, np.stack(variances, axis=-1), judged)

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
        needed = {"kept_lx": kept, "repeats": repeats(lux), "power": power}
        rows.append(point.row(lux=lux, method=LEAST, mean_delta_e=least(lux), **needed))
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
    chosen = [lux for lux in rows.distinct("lux") if lux in _ASKED_LX]

    def cell(lux: float, family: str, method: str) -> str:
        mean = rows.mean("mean_delta_e", lux=lux, patterns=family, method=method)
        return f"{mean.value:.2f}" if mean.of == 1 else f"{mean.value:.2f} \N{PLUS-MINUS SIGN} {mean.error:.2f}"

    def needs(family: str) -> tuple[str, ...]:
        least = rows.where(patterns=family, method=LEAST)
        by_lux = rows.where(patterns=family, method=MARKOV).means("mean_delta_e", "lux")
        kept = kept_lx(by_lux, least.mean("goal_delta_e").value), least.mean("kept_lx").value
        needed = [(least.numbers("repeats", lux=lux), least.numbers("power", lux=lux)) for lux in chosen]
        return (
            label(family), *map(_digits, kept),
            *(f"{count[0]:g}; {_digits(max(power[0], 1))}" if count and power else "never" for count, power in needed),
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
             *(f"{lux:g} lx: repeats; power" for lux in chosen)),
            tuple(map(needs, families)),
        ),
    )  # fmt: skip
