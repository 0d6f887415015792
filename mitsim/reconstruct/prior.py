"""One side of a factorised model in, whose scene pixels are taken for independent; the same with neighbours alike, out.

Tikhonov's lambda ||X||^2 says that every pixel is near black and knows nothing of the next one. Where the frames are
noisy lambda then darkens the image, its large even parts too. Pictures are not so: with the covariance rho^|p - p'|
along rows and along columns (a separable first-order Markov field; Jain, Fundamentals of Digital Image Processing,
1989, chapter 2) an even part of many pixels has many times the variance of a single pixel, and is kept.

With C = F F^T on each side the image is X = F_L Z F_R^T, Z independent numbers, so that the penalty lambda ||Z||^2 is
Tikhonov's of the model B F in the place of B = U S V^T. From the SVD S V^T F = U' S' V'^T follow U U', S', and the
columns F V' that make an image of coefficients: all that was a closed form stays one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.reconstruct.sides import Side, Slab

NEIGHBOURS = 0.9
"""rho, correlation of neighbouring pixels: chosen on scenes/colour_checker under 49 dots and 64 Hadamard patterns, in
the dark and in two daylights, where 0.8 to 0.98 are within 0.7 dB of each other (docs/decisions/0005-neighbours.md)."""


def covariance_root(size: int) -> FloatArray:
    """F (n, n), n = ``size``, lower triangular, with F F^T the covariance rho^|p - p'| of a row of pixels."""
    place = np.arange(size)
    return np.asarray(np.linalg.cholesky(NEIGHBOURS ** np.abs(place[:, None] - place)))


def correlated(side: Side) -> Side:
    """A ``side`` whose scene pixels are correlated with their neighbours. MitsimError for one of Gram matrices."""
    if not side.projected:
        raise MitsimError("method gram: has no image of correlated pixels; prepare by svd")
    root = covariance_root(side.scene_size)
    turned, singular, right = np.linalg.svd(side.response.T @ root, full_matrices=False)
    singular[singular <= singular.max() * side.scene_size * np.finfo(np.float64).eps] = 0.0
    # The dual of F V' is F^-T V': both made with the triangular root, neither with an inverse of C.
    return replace(
        side,
        basis=root @ right.T,
        dual=np.linalg.solve(root.T, right.T),
        singular=singular,
        slabs=tuple(Slab(slice(0, len(singular)), slab.matrix @ turned[slab.columns]) for slab in side.slabs),
        n_blocks=1,
        spread=float(np.linalg.cond(root)),
    )
