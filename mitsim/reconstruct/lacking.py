"""Separable terms that factors lack, an image in; out comes what they put into its frames, and into the image itself.

A camera whose shadow is no single product, as of waves behind a FlatCam or MURA mask, adds sum_k L_k (P_ij o X) R_k^T
to the frames that Phi_L (P_ij o X) Phi_R^T explains. With G_kl = L_k^T L_l and H_kl = R_l^T R_k its energy over all
patterns is ::

    sum_kl <X, (G_kl o P_L P_L^T) X (H_kl o P_R P_R^T)>

of which |T|^2 lies in the model's range, T = sum_k (sum_i U_Li^T L_k diag(p_i)) X (sum_j U_Rj^T R_k diag(q_j))^T being
what coefficients W take for image.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mitsim.core.arrays import FloatArray, SeparableTerm
from mitsim.reconstruct.detail import Model
from mitsim.reconstruct.sides import Side


@dataclass(frozen=True, eq=False)
class Lack:
    """What ``terms`` beside a ``model``'s factors, centred as these are, do to its ``image`` (n, n'); one or more."""

    model: Model
    terms: tuple[SeparableTerm, ...]
    image: FloatArray

    @property
    def energy(self) -> float:
        """Energy that they put into all frames outside of the model's range."""
        left, right = (lit @ lit.T for lit in self.model.patterns)
        total = 0.0
        for a, b in self.terms:
            for c, d in self.terms:
                total += float(np.vdot(self.image, ((a.T @ c) * left) @ self.image @ ((d.T @ b) * right)))
        return max(total - float(np.square(self.struck).sum()), 0.0)

    @cached_property
    def struck(self) -> FloatArray:
        """(r, r') what they add to the coefficients W of all frames."""
        sides, patterns = self.model.sides, self.model.patterns
        return np.asarray(
            sum(_seen(sides[0], a, patterns[0]) @ self.image @ _seen(sides[1], b, patterns[1]).T for a, b in self.terms)
        )


def _seen(side: Side, term: FloatArray, patterns: FloatArray) -> FloatArray:
    """(r, n) sum_i U_i^T L diag(p_i), of one side of a ``term`` L (m, n) and its ``patterns`` (n, K)."""
    seen = np.zeros((len(side.singular), term.shape[1]))
    for slab, lit in zip(side.slabs, patterns.T, strict=True):
        seen[slab.columns] += (slab.matrix.T @ term) * lit
    return seen
