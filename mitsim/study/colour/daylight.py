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
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mitsim.capture.exposer import Exposer
from mitsim.core.arrays import FloatArray
from mitsim.core.parallel import single_threaded_blas
from mitsim.reconstruct.sides import Side
from mitsim.reconstruct.solver import Prepared, prepare
from mitsim.reconstruct.uncertainty import common_response
from mitsim.rig.chart import ChartPlace
from mitsim.rig.patterns import PatternFamily
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.study.colour.lit import LitLine
from mitsim.study.colour.shots import exposed, peak_seconds
from mitsim.study.exposures import RENDERED

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
        for measured in exposed(exposer, self.family, [rate + lamp for rate in rates], off):
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
        own, common = self._magnified(place)
        return read * frames * own + (off / self.shots * common if self.shots else 0.0)

    def _magnified(self, place: ChartPlace) -> tuple[FloatArray, FloatArray]:
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
    return float(a @ a), float(np.square(common_response(side) @ a).sum())


def expected(means: FloatArray, variances: FloatArray, judged: Judge) -> float:
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
