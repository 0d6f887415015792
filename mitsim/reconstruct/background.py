"""Light that no lit pixel sends: taken up by a margin round the projector's window, or told from frames under dots.

*Margin.* A wall beside the window scatters light of the projector to the camera, and a lamp lights it: in every frame
there is light of directions that no projector pixel has. A model without them explains it by an image that is not
there. Cells beyond the window cast the shadow that the window's edge casts, moved along the sensor
(:meth:`mitsim.reconstruct.focus.FactorOfDepths.beyond`), so no calibration needs to light them.

They are taken for lit in every pattern. With the padded patterns p_i, q_j the model stays separable, and so takes a
margin's light for ``p_i q_j^T`` there: whole at the corners, and beside the window in the rows, or columns, that are
lit. Light that is the same in all frames is explained so as far as it changes little from cell to cell
(benchmarks/margin.py); that of lamps is better taken off by frames with the projector off.

*Global light*, in all frames alike, is told from frames under shifting dots. A pixel's direct light is in the frames
that light it, while what other surfaces, haze or lamps add comes from dark pixels too, and hardly changes when the dots
move by less than it takes to change (Nayar, Krishnan, Grossberg and Raskar 2006, where a camera with a lens takes for
each of its pixels the brightest and the darkest frame). A lensless sensor sees all pixels at once, so light of lit and
of dark pixels is told apart by least squares: with P_ij the patterns,

    Y_ij = Phi_L (P_ij o X) Phi_R^T + F,        F = Phi_L H_L g H_R^T Phi_R^T

X is direct, F global light, the same in all K frames, its image H_L g H_R^T linear between nodes as far apart as the
dots. With Phi H = Q R on each side, W = sum_ij U_Li^T Y_ij U_Rj as the solver has it, and A = (sum_i U_i)^T Q what lit
pixels explain of F, the least squares of all frames over X and F = Q_L f Q_R^T have

    K f - A_L^T (A_L f A_R^T) A_R = Q_L^T (sum_ij Y_ij) Q_R - A_L^T W A_R

X being eliminated. **What is told.** An eigenvalue of the left side over K is the part of a mode of F that lit pixels
do not explain: 0 under uniform light, where nothing is told, near 1 where the dots' shadows leave gaps between them. An
even haze is the mode told least: dots nearer than a mask feature is wide in the scene (12 mm, 13 pixels of the anchor)
cast nearly its shadow, and 49 dots tell a 600th of it, enough where the model holds, too little where it does not
(depth). **What is not told**: global light that changes from frame to frame or from dot to dot (near an edge, caustics)
stays in X, and so does what a lit pixel gets of its own light; lamps' light and the projector's black are in all frames
alike, and are taken for global.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.manifests import Parallax
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.runs import Capture
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.focus import LEAST_PART, DerivedCapture, FactorOfDepths, MovedFactors, parallax_of
from mitsim.reconstruct.solver import Prepared

# ---- A margin of cells beside the window -----------------------------------------------------------------------------


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

    def extend(edges: tuple[float, float], size: int) -> tuple[float, float]:
        more = (edges[1] - edges[0]) * cells / size
        return edges[0] - more, edges[1] + more

    names = ("row_tan", "row_mm"), ("column_tan", "column_mm")
    update = {
        name: extend(getattr(parallax, name), size) for size, own in zip(sizes, names, strict=True) for name in own
    }
    return parallax.model_copy(update=update)


# ---- Global light, the same in all frames ----------------------------------------------------------------------------


_LEAST_EIGENVALUE = 1e-3
"""Part of a mode that must remain: noise in it is magnified by the root of one over that, thirtyfold, which the mean
over all frames makes up for."""


@dataclass(frozen=True, eq=False)
class Separation:
    """Light that is in all frames alike.

    Attributes
    ----------
    common
        (m, m') of each frame, in the frames' unit; to be taken off.
    image
        (n, n') reflectance that it looks like under uniform light, all of it from lit pixels.
    eigenvalues
        (modes,) part of each mode of it that lit pixels do not explain, smallest first.
    """

    common: FloatArray
    image: FloatArray
    eigenvalues: FloatArray


@single_threaded_blas()
def separate(
    model: Prepared,
    seen: tuple[FloatArray, FloatArray],
    patterns: tuple[FloatArray, FloatArray],
    weights: FloatArray,
    total: FloatArray,
) -> Separation:
    """Global light of frames under patterns of 0 and 1.

    Parameters
    ----------
    model
        the factorised model of these patterns.
    seen
        Phi_L (m, n + 2 w) and Phi_R (m', n' + 2 w'): factors with w columns beside the window on either side, as
        :meth:`mitsim.reconstruct.focus.FactorOfDepths.beyond` makes them, or none.
    patterns
        P_L (n, K) and P_R (n', K'), shifting dots.
    weights, total
        W (r, r') and the sum (m, m') of all frames.

    Raises
    ------
    MitsimError
        for patterns under which global light looks like an image: uniform light, +-1, a factor of centred frames.
    """
    if model.centre or any((side < 0).any() for side in patterns):
        raise MitsimError("separation: takes dots before a mask that is not centred; use dots:K")
    nodes = [_hats(factor.shape[1], side.shape[1]) for factor, side in zip(seen, patterns, strict=True)]
    bases, triangles = zip(*(np.linalg.qr(side @ hats) for side, hats in zip(seen, nodes, strict=True)), strict=True)
    lit = [side.common.T @ basis for side, basis in zip((model.left, model.right), bases, strict=True)]
    shape = bases[0].shape[1], bases[1].shape[1]
    count = model.left.pattern_count * model.right.pattern_count
    measured = (model.sigma > 0).astype(np.float64)
    target = bases[0].T @ total @ bases[1] - lit[0].T @ (measured * weights) @ lit[1]
    unexplained: FloatArray = np.eye(target.size) - _explained_matrix(lit, measured) / count
    reported, modes = np.linalg.eigh(unexplained)
    if reported[-1] < _LEAST_EIGENVALUE:
        raise MitsimError("separation: these patterns light all pixels in each frame; use dots:K with K of 2 or more")
    inverse = np.divide(1.0, count * reported, out=np.zeros_like(reported), where=reported > _LEAST_EIGENVALUE)
    found = (modes @ (inverse * (modes.T @ target.ravel()))).reshape(shape)
    left, right = (
        _inside(hats, len(side)) @ np.linalg.inv(triangle)
        for hats, side, triangle in zip(nodes, patterns, triangles, strict=True)
    )
    part = float(np.prod([side.mean() for side in patterns]))
    return Separation(bases[0] @ found @ bases[1].T, left @ found @ right.T / part, reported)


def _inside(hats: FloatArray, pixels: int) -> FloatArray:
    """Rows of ``hats`` within the window of so many ``pixels``."""
    margin = (len(hats) - pixels) // 2
    return hats[margin : margin + pixels]


def _hats(pixels: int, period: int) -> FloatArray:
    """(pixels, J) functions that are linear between J nodes ``period`` apart, the outer ones at the window's ends."""
    count = max(2, 1 + -(-(pixels - 1) // period))
    place = np.arange(pixels) * (count - 1) / max(pixels - 1, 1)
    return np.asarray(np.maximum(0.0, 1 - np.abs(place[:, None] - np.arange(count))))


def _explained_matrix(lit: Sequence[FloatArray], measured: FloatArray) -> FloatArray:
    """(J J', J J') matrix of f -> A_L^T (A_L f A_R^T) A_R, of what is ``measured`` (r, r')."""
    pairs = [(side[:, :, None] * side[:, None, :]).reshape(len(side), -1) for side in lit]
    sizes = [side.shape[1] for side in lit]
    product = (pairs[0].T @ measured @ pairs[1]).reshape(sizes[0], sizes[0], sizes[1], sizes[1])
    size = sizes[0] * sizes[1]
    return np.asarray(product.transpose(0, 2, 1, 3).reshape(size, size))
