"""Predict the image of changed frames, its noise, and the scatter of its squared error.

:class:`LinearImage` uses that the solver is linear if lambda is fixed. With B_L = [Phi_L
diag(p_i)]_i = U_L S_L V_L^T (row blocks U_Li of U_L), and likewise on the right, the image of frames Y_ij is

    X^ = V_L [F o W] V_R^T,  W = sum_ij U_Li^T Y_ij U_Rj,  F = s_L s_R^T / (s_L^2 s_R^2^T + lambda).

Changes of the frames affect W as follows (likewise on the right):

* frames L (P_ij o X) R^T of other factors: W = G(L) X G(R)^T with ``G(L) = sum_i U_Li^T L diag(p_i)``;
* gains g_ij of frames: W = sum_ij g_ij G_i X G_j^T, with the terms G_i of G;
* gains of rows, 1 + u_ij d with u_ij of variance 1: the square of each frame's term with diag(d) L in place of L; a
  ripple of the light has two such d, cosine and sine;
* a frame E added to all: W = (sum_i U_Li)^T E (sum_j U_Rj);
* responses that differ by R from the factors: W = sum_ij U_Li^T (R o Y_ij) U_Rj;
* noise of variance v in each datum: variance v of W, as U_L and U_R are orthonormal; in a frame that is subtracted from
  all others v |sum_i U_Li|^2 |sum_j U_Rj|^2, column by column;
* noise of variance nu^2 in each number of the left factor: that of G is nu^2 |sum_i p_i(x) U_Li|^2;
* an error of variance e^2 in each scene pixel's light, equal in all frames: e^2 s_L^2 s_R^2^T;
* columns x of the left factor times 1 + eta_x of variance eta^2: eta^2 sum_x (s_L V_L(x))^2 (X V_R S_R)(x)^2.

A pattern of +-1 is the difference of two frames (1 +- P) / 2: constant additions cancel, noise and flicker add up, and
gains g+ and g- give (g+ + g-) / 2 of the pattern and (g+ - g-) / 2 of uniform light. The expected squared error is that
of the mean plus, as V is orthonormal, the sum of F^2 times these variances.

With b the error that is not noise and C the covariance of normal noise e, |b + e|^2 has the variance 2 tr(C^2) + 4 b^T
C b. In the coefficients above, e = F o dW:

* independent noise of variance v_kl in W: tr(C^2) = sum F_kl^4 v_kl^2;
* noise of variance nu_kx^2 of the left factor's G: row k of W sees scene pixel x through a_x = (X V_R S_R)(x), C_k =
  F_k o (sum_x nu_kx^2 a_x a_x^T) o F_k, hence tr(C_k^2) = nu_k^2^T (K_k o K_k) nu_k^2 with K_k(x, y) = sum_l F_kl^2
  a_xl a_yl; rows are assumed independent, as they are where patterns share no pixels;
* columns of the left factor off by eta_x: tr(C^2) = eta^4 sum_xy (sum_k s_k^2 V_L(x, k) V_L(y, k) K_k(x, y))^2.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass, fields
from functools import cached_property

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.devices.patterns import PatternFamily

Terms = Sequence[tuple[FloatArray, FloatArray]]
Gains = Sequence[float | FloatArray]
"""Root mean squares of independent gains: of a whole frame, or (m,) of its rows."""


class Axis:
    """One side of the camera: (K, m, r) blocks of U, (r,) singular values, (n, r) V and (n, K) patterns."""

    def __init__(self, factor: FloatArray, patterns: FloatArray) -> None:
        stacked = np.concatenate([factor * column for column in patterns.T])
        left, self.singular, right = np.linalg.svd(stacked, full_matrices=False)
        self.slabs, self.basis = left.reshape(patterns.shape[1], *factor.shape[:1], -1), right.T
        self.patterns = patterns

    @cached_property
    def total(self) -> FloatArray:
        return np.asarray(self.slabs.sum(axis=0))

    def terms_of(self, factor: FloatArray, even: bool = False) -> FloatArray:
        """Return the (K, r, n) terms of a ``factor``'s G, under the patterns or in ``even`` light."""
        if even:
            return np.asarray(np.einsum("kmr,mn->krn", self.slabs, factor, optimize=True))
        return np.asarray(np.einsum("kmr,mn,nk->krn", self.slabs, factor, self.patterns, optimize=True))

    @cached_property
    def noise(self) -> FloatArray:
        """Return the (r, n) variance of G if each number in the factor has unit variance."""
        mixed = np.einsum("nk,kmr->nmr", self.patterns, self.slabs, optimize=True)
        return np.asarray(np.square(mixed).sum(axis=1).T)


@dataclass(frozen=True, eq=False)
class Expected:
    """Mean (n, n') of an image, and the sum of the variances of all its numbers."""

    image: FloatArray
    variance: float = 0.0

    def psnr_db(self, truth: FloatArray) -> float:
        square = (float(np.square(self.image - truth).sum()) + self.variance) / truth.size
        return float("inf") if square == 0 else float(-10 * np.log10(square))


@dataclass(frozen=True, eq=False)
class Changed:
    """Changes of a scene's frames relative to frames by the solver's factors; none by default.

    Attributes
    ----------
    gain, gain_apart
        (K, K') mean gains of the frames; for a difference of two frames, their mean gain and half their difference.
    flicker, added_flicker, added_common
        rms of independent gains of each frame, of ``added`` in each frame, and in all: a number each, or (m,) by row.
    response
        (m, m') relative error of each pixel's response in the factors.
    leak
        part of the light of all pixels that is in every frame.
    added, added_gain
        (m, m') frame that is added to all frames, and its mean gain.
    """

    terms: Terms = ()
    gain: FloatArray | float = 1.0
    gain_apart: FloatArray | float = 0.0
    flicker: Gains = ()
    response: FloatArray | None = None
    leak: float = 0.0
    added: FloatArray | None = None
    added_gain: float = 1.0
    added_flicker: Gains = ()
    added_common: Gains = ()


@dataclass(frozen=True)
class Noise:
    """Variances of independent noise.

    Attributes
    ----------
    datum, ambient
        of each datum of every single frame, and of a frame that is subtracted from all others.
    left, right, left_light, right_light
        of each number of the factors, and of the gain of each column.
    light
        of each scene pixel's light, relative to a white board's, in all frames alike.
    """

    datum: float = 0.0
    ambient: float = 0.0
    left: float = 0.0
    right: float = 0.0
    light: float = 0.0
    left_light: float = 0.0
    right_light: float = 0.0

    def __add__(self, other: Noise) -> Noise:
        return Noise(*map(operator.add, astuple(self), astuple(other)))

    def __sub__(self, other: Noise) -> Noise:
        return Noise(*map(operator.sub, astuple(self), astuple(other)))


@dataclass(frozen=True, eq=False)
class LinearImage:
    """Solver with its lambda fixed: Phi_L (m, n), Phi_R (m', n'), and whether row and column means are removed."""

    left: FloatArray
    right: FloatArray
    family: PatternFamily
    lam: float
    centre: bool = False

    def expected_image(self, scene: FloatArray, changed: Changed | None = None, noise: Noise | None = None) -> Expected:
        changed, (left, right) = changed or Changed(), self.axes
        cameras = [(self.left, self.right), *changed.terms]  # U has no means where frames are to lose theirs
        weights = np.zeros_like(self.filter)
        gain, apart = (np.broadcast_to(each, self._count) for each in (changed.gain, changed.gain_apart))
        seen = self._terms(cameras)
        for shot in np.ndindex(gain.shape):
            weights += gain[shot] * _together(seen, shot, scene)
        if self.family.signed and apart.any():
            even = self._terms(cameras, even=True)
            for shot in np.ndindex(gain.shape):
                weights += apart[shot] * (1 + 2 * changed.leak) * _together(even, shot, scene)
        if changed.response is not None:
            weights += self._by_response(changed.response, cameras, scene, gain)
        if changed.leak and not self.family.signed:
            uniform = sum(first @ scene @ second.T for first, second in cameras)
            weights += changed.leak * left.total.T @ uniform @ right.total
        if changed.added is not None and not self.family.signed:
            weights += changed.added_gain * left.total.T @ changed.added @ right.total
        variance = sum(self._energy(np.square(term)) for term in self._by_gains(scene, changed))
        variance += self.variance(scene, noise or Noise())
        return Expected(left.basis @ (self.filter * weights) @ right.basis.T, variance)

    def _by_gains(self, scene: FloatArray, changed: Changed) -> Iterator[FloatArray]:
        left, right = self.axes
        cameras = [(self.left, self.right), *changed.terms]
        lit = 1 + 2 * changed.leak
        for rms in changed.flicker:
            varied, evenly = self._terms(cameras, rms=rms), self._terms(cameras, even=True, rms=rms)
            for shot in np.ndindex(self._count):
                term = _together(varied, shot, scene)
                if self.family.signed:  # the gains of two frames
                    uniform = lit * _together(evenly, shot, scene)
                    yield (uniform + term) / 2
                    yield (uniform - term) / 2
                else:
                    yield term
        if changed.added is None:
            return
        for rms in changed.added_flicker:
            varying = _by_row(rms) * changed.added
            for row, column in np.ndindex(self._count):
                term = left.slabs[row].T @ varying @ right.slabs[column]
                yield from [term, -term] if self.family.signed else [term]
        if not self.family.signed:
            for rms in changed.added_common:
                yield left.total.T @ (_by_row(rms) * changed.added) @ right.total

    def _terms(self, cameras: Terms, even: bool = False, rms: float | FloatArray = 1.0) -> Terms:
        left, right = self.axes
        return [(left.terms_of(_by_row(rms) * first, even), right.terms_of(second, even)) for first, second in cameras]

    def _by_response(self, response: FloatArray, cameras: Terms, scene: FloatArray, gain: FloatArray) -> FloatArray:
        left, right = self.axes
        weights = np.zeros_like(self.filter)
        for row, column in np.ndindex(self._count):
            lit = np.outer(left.patterns[:, row], right.patterns[:, column]) * scene
            frame = sum(first @ lit @ second.T for first, second in cameras)
            weights += gain[row, column] * left.slabs[row].T @ (response * frame) @ right.slabs[column]
        return weights

    def variance(self, scene: FloatArray, noise: Noise) -> float:
        units = self.units(scene)
        return self._energy(sum((getattr(noise, name) * unit for name, unit in units.items()), np.zeros((1, 1))))

    def units(self, scene: FloatArray) -> dict[str, FloatArray]:
        """Return the (r, r') variance of W that unit variance of each :class:`Noise` causes."""
        left, right = self.axes
        of_left, of_right = np.square(left.basis * left.singular).T, np.square(right.basis * right.singular)
        seen_right = np.square(scene @ (right.basis * right.singular))
        seen_left = np.square(scene.T @ (left.basis * left.singular)).T
        return {
            "datum": np.full(self.filter.shape, 2.0 if self.family.signed else 1.0),
            "ambient": np.outer(*(np.square(axis.total).sum(axis=0) for axis in (left, right))),
            "left": left.noise @ seen_right,
            "right": seen_left @ right.noise.T,
            "light": np.outer(np.square(left.singular), np.square(right.singular)),
            "left_light": of_left @ seen_right,
            "right_light": seen_left @ of_right,
        }

    @property
    def _count(self) -> tuple[int, int]:
        return len(self.axes[0].slabs), len(self.axes[1].slabs)

    def _energy(self, variance: FloatArray) -> float:
        return float((np.square(self.filter) * variance).sum())

    @cached_property
    def axes(self) -> tuple[Axis, Axis]:
        sides = (side - side.mean(axis=0) if self.centre else side for side in (self.left, self.right))
        shown = (patterns.astype(np.float64) for patterns in (self.family.left, self.family.right))
        left, right = map(Axis, sides, shown)
        return left, right

    @cached_property
    def filter(self) -> FloatArray:
        sigma = np.outer(self.axes[0].singular, self.axes[1].singular)
        return np.asarray(sigma / (np.square(sigma) + self.lam))


def _by_row(rms: float | FloatArray) -> FloatArray:
    return np.reshape(np.asarray(rms, dtype=np.float64), (-1, 1))


def _together(seen: Terms, shot: tuple[int, ...], scene: FloatArray) -> FloatArray:
    """Return the part of W (r, r') of one frame from terms of G, (K, r, n) and (K', r', n')."""
    return np.asarray(sum(first[shot[0]] @ scene @ second[shot[1]].T for first, second in seen))


_KINDS = tuple(each.name for each in fields(Noise))


@dataclass(frozen=True, eq=False)
class Scatter:
    """Scatter of the summed squared error of a ``scene`` (n, n') about its mean; errors are (n, n')."""

    solver: LinearImage
    scene: FloatArray

    def deviation(self, noise: Noise, error: FloatArray) -> float:
        """Return the standard deviation of the squared error with ``noise`` and an ``error`` that is not noise."""
        return math.sqrt(self._variance(noise, error))

    def share(self, noise: Noise, among: Noise, error: FloatArray) -> float:
        """Return the standard deviation due to one source of ``noise`` ``among`` all."""
        return math.sqrt(max(self._variance(among, error) - self._variance(among - noise, error), 0.0))

    def common(self, noise: Noise, error: FloatArray) -> float:
        """Return the standard deviation of the cross term 2 b . e of ``noise`` and ``error``."""
        return math.sqrt(float(self._beside(error) @ astuple(noise)))

    def _variance(self, noise: Noise, error: FloatArray) -> float:
        amounts = np.array(astuple(noise))
        return float(amounts @ self._own @ amounts + self._beside(error) @ amounts)

    def _beside(self, error: FloatArray) -> FloatArray:
        """Return the (kinds,) variance of 2 b . e per unit variance."""
        (left, right), gain = self.solver.axes, self.solver.filter
        off = left.basis.T @ error @ right.basis
        found = 4 * self._energies @ np.square(off).ravel()
        for (side, axis, seen), weights in zip(self._sides, (gain * off, (gain * off).T), strict=True):
            beside = weights @ seen.T  # (r, n)
            found[_KINDS.index(side)] = 4 * float((axis.noise * np.square(beside)).sum())
            light = ((axis.basis * axis.singular).T * beside).sum(axis=0)
            found[_KINDS.index(f"{side}_light")] = 4 * float(np.square(light).sum())
        return np.asarray(found)

    @cached_property
    def _own(self) -> FloatArray:
        """Return tr(C^2) (kinds, kinds) per unit variance of both kinds, doubled."""
        found, gain = 2 * self._energies @ self._energies.T, self.solver.filter
        for (side, axis, seen), filters in zip(self._sides, (gain, gain.T), strict=True):
            square, light, together = 0.0, axis.basis * axis.singular, np.zeros((len(seen), len(seen)))
            for row, weights in enumerate(filters):
                passed, variance = seen * weights, axis.noise[row]  # seen (n, r') is a_x
                kernel = passed @ passed.T
                square += float(variance @ np.square(kernel) @ variance)
                together += np.outer(light[:, row], light[:, row]) * kernel
            for name, each in ((side, square), (f"{side}_light", float(np.square(together).sum()))):
                found[_KINDS.index(name), _KINDS.index(name)] = 2 * each
        return np.asarray(found)

    @cached_property
    def _energies(self) -> FloatArray:
        """Return the (kinds, r r') variance of the image's coefficients per unit variance."""
        units = self.solver.units(self.scene)
        return np.stack([(np.square(self.solver.filter) * units[name]).ravel() for name in _KINDS])

    @property
    def _sides(self) -> tuple[tuple[str, Axis, FloatArray], tuple[str, Axis, FloatArray]]:
        left, right = self.solver.axes
        through_right = self.scene @ (right.basis * right.singular)
        return ("left", left, through_right), ("right", right, self.scene.T @ (left.basis * left.singular))
