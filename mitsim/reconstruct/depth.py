"""Shots and factors in; the one depth out whose factors leave least of the measurements unexplained.

Only what lies in the model's range counts, whatever lambda: the energy ||Y||^2 - sum_ij ||U_Li^T Y_ij U_Rj||^2 of
:mod:`mitsim.reconstruct.misfit`. It has a narrow valley at the true depth, and others where dots of period k see their
neighbours' light; so depths are first tried in steps of a pixel of parallax, and the best is refined.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import Capture
from mitsim.reconstruct.alldepths import RANGE, AllDepths
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.focus import stated_parallax
from mitsim.reconstruct.solver import prepare

_STEP = 1.0
"""Projector pixels of parallax between depths that are tried first: the valley is some two wide on either side."""
_RESOLUTION = 0.01
"""Projector pixels of parallax to which the best is refined: 0.06 mm at 400 mm and a baseline of 60 mm; chosen, below
the millimetre that is asked for."""
_FEWEST = 16
"""Steps at least, where there is no baseline and only the sensor's own width tells depth."""
_LEAST_RISE = 1e-4
"""Part of the measurements' energy that a pixel of parallax must add to what is left over, or depth is not told: the
square of 1 %, more than a cubic leaves between columns of 5 um. Uniform light stays below it, and was 5 mm off."""


@dataclass(frozen=True)
class Depth:
    """A depth [mm]; its standard error [mm] where it was found, and why it is not to be trusted, or nothing."""

    mm: float
    error_mm: float | None = None
    doubt: str = ""

    def __str__(self) -> str:
        error = "" if self.error_mm is None else f" +- {self.error_mm:.1g}, by the least misfit"
        return f"focus: {self.mm:.6g} mm{error}"


@single_threaded_blas()
def best_depth(shots: Capture, factors: Factors) -> Depth:
    """The one depth whose factors explain most of the measurements.

    Parameters
    ----------
    shots
        of a scene.
    factors
        of the same camera, with their parallax.

    Raises
    ------
    MitsimError
        for a calibration without parallax, or a frame that cannot be read.
    """
    parallax = stated_parallax(factors)
    search = _Search(shots, factors)
    pixel = 1 / search.reach
    limit = RANGE / parallax.depth_mm
    steps = max(int(np.ceil(limit / (_STEP * pixel))), _FEWEST)
    shifts = np.linspace(-limit, limit, 2 * steps + 1)
    scores = [search.left_over(shift) for shift in shifts]
    best = int(np.argmin(scores))
    ends = shifts[max(best - 1, 0)], shifts[min(best + 1, len(shifts) - 1)]
    result = minimize_scalar(search.left_over, bounds=ends, method="bounded", options={"xatol": _RESOLUTION * pixel})
    shift = float(result.x)
    error, rise = search.certainty(shift, pixel)
    mm = 1 / (1 / parallax.depth_mm + shift)
    doubt = ""
    if best in (0, len(shifts) - 1):
        near, far = (1 / (1 / parallax.depth_mm + end) for end in (limit, -limit))
        doubt = f"The depth that explains most is at the end of what was tried, {near:.0f} to {far:.0f} mm."
    elif not (error < pixel and rise > _LEAST_RISE):
        doubt = "These patterns hardly tell depth: use shifting dots."
    return Depth(mm, float(np.hypot(error, _RESOLUTION * pixel)) * mm**2, doubt)


class _Search:
    """What one depth for the whole scene leaves of all measurements.

    Attributes
    ----------
    reach
        projector pixels of parallax for a change of 1/z by 1/mm, the larger of both axes.
    """

    def __init__(self, shots: Capture, factors: Factors) -> None:
        self._all = AllDepths(shots, factors, RANGE / stated_parallax(factors).depth_mm)
        self.reach = max(self._all.reach(axis) for axis in (0, 1))

    def left_over(self, shift: float) -> float:
        """Energy of the measurements, less a constant, that factors moved by ``shift`` of 1/z leave."""
        prepared = prepare(self._all.side(0, shift), self._all.side(1, shift), *self._all.patterns)
        sums = prepared.accumulator()
        for each in self._all.frames:
            sums.add(each.frame, each.row, each.column)
        problem = prepared.problem(sums)
        return -float(np.square(problem.projected[problem.sigma > 0]).sum())

    def certainty(self, shift: float, pixel: float) -> tuple[float, float]:
        """Standard error of the ``shift`` that leaves least, from a parabola through quarters of a ``pixel``: what is
        left over rises by its own mean over a datum; and how much more is left a pixel beside, over all energy."""
        before, least, after = (self.left_over(shift + part * pixel) for part in (-0.25, 0, 0.25))
        rise = min(self.left_over(shift + pixel), self.left_over(shift - pixel)) - least
        curvature = (before - 2 * least + after) / (pixel / 4) ** 2
        variance = (self._all.energy + least) / max(self._all.data - self._all.shape[0] * self._all.shape[1], 1)
        error = float(np.sqrt(2 * variance / curvature)) if curvature > 0 else float("inf")
        return error, float(rise / self._all.energy)
