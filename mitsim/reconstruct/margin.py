"""A capture and factors in; the same with cells round the projector's window, for light that comes from there, out.

A wall beside the window scatters light of the projector to the camera, and a lamp lights it: in every frame there is
light of directions that no projector pixel has. A model without them explains it by an image that is not there. Cells
beyond the window cast the shadow that the window's edge casts, moved along the sensor
(:meth:`mitsim.reconstruct.focus.FactorOfDepths.beyond`), so no calibration needs to light them.

They are taken for lit in every pattern. With the padded patterns p_i, q_j the model stays separable, and so takes a
margin's light for ``p_i q_j^T`` there: whole at the corners, and beside the window in the rows, or columns, that are
lit. Light that is the same in all frames is explained so as far as it changes little from cell to cell
(benchmarks/margin.py); that of lamps is better taken off by frames with the projector off.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.manifests import Parallax
from mitsim.core.runs import Capture
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.focus import LEAST_PART, DerivedCapture, FactorOfDepths, MovedFactors, parallax_of


@dataclass(frozen=True, eq=False)
class Margin:
    """``cells`` more on each side of the projector's window, 1 or more."""

    cells: int

    def factors(self, factors: Factors) -> MovedFactors:
        """The ``factors`` with columns of these cells, on the part of the sensor where these are known.

        MitsimError where they do not state their parallax, and for more cells than the window, or the sensor, tells of.
        """
        parallax, sides = parallax_of(factors), (factors.left, factors.right)
        if self.cells > (most := min(factor.shape[1] for factor in sides)):
            raise ArgumentError("margin", f"{self.cells}: give at most {most}, the projector's pixels a side")
        widened = [FactorOfDepths(factor, parallax, axis).beyond(self.cells) for axis, factor in enumerate(sides)]
        part = min((known.stop - known.start) / len(factor) for factor, (_, known) in zip(sides, widened, strict=True))
        if part < LEAST_PART:
            raise ArgumentError(
                "margin",
                f"{self.cells}: {max(part, 0):.0%} of the sensor know the shadow of all these cells; give fewer",
            )
        (left, rows), (right, columns) = widened
        sizes = factors.left.shape[1], factors.right.shape[1]
        manifest = factors.manifest.model_copy(update={"parallax": _wider(parallax, sizes, self.cells)})
        shape = len(factors.left), len(factors.right)
        wider = replace(factors, left=left[rows], right=right[columns], manifest=manifest, lacking=())
        return MovedFactors(wider, rows, columns, shape)

    def of(self, shots: Capture) -> Capture:
        """The ``shots`` with patterns that light these cells always; MitsimError for patterns of -1."""
        if any(shot.sign for shot in shots.manifest.patterns.captures):
            raise MitsimError(
                f"margin {self.cells}: {shots.name} shows patterns of -1, as differences of two frames, in which what "
                "is lit always is not there; leave margin out"
            )
        return _Padded(shots, self.cells)

    def inside(self, image: FloatArray) -> FloatArray:
        """The window's part of an ``image``."""
        return image[self.cells : -self.cells, self.cells : -self.cells]


class _Padded(DerivedCapture):
    """A capture whose patterns light a margin always."""

    def __init__(self, whole: Capture, cells: int) -> None:
        super().__init__(whole)
        self._cells = cells

    @cached_property
    def patterns(self) -> tuple[FloatArray, FloatArray]:
        """P_L (n + 2 cells, K) and P_R (n' + 2 cells, K')."""
        pad = (self._cells, self._cells), (0, 0)
        left, right = (np.pad(side.astype(np.float64), pad, constant_values=1.0) for side in self.whole.patterns)
        return left, right


def _wider(parallax: Parallax, sizes: tuple[int, int], cells: int) -> Parallax:
    """The ``parallax`` of windows of ``sizes`` pixels with so many ``cells`` more on each side."""

    def extended(edges: tuple[float, float], size: int) -> tuple[float, float]:
        more = (edges[1] - edges[0]) * cells / size
        return edges[0] - more, edges[1] + more

    names = ("row_tan", "row_mm"), ("column_tan", "column_mm")
    update = {
        name: extended(getattr(parallax, name), size) for size, own in zip(sizes, names, strict=True) for name in own
    }
    return parallax.model_copy(update=update)
