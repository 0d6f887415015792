"""Factors that an image is made with, and what its frames differ by, in; the squared error that it is expected to have,
out: no frame is formed, no noise drawn, nothing solved.

With lambda fixed the solver is linear. With B_L = [Phi_L diag(p_i)]_i = U_L S_L V_L^T (row blocks U_Li of U_L), and the
same on the right, it makes of frames Y_ij the image

    X^ = V_L [F o W] V_R^T,  W = sum_ij U_Li^T Y_ij U_Rj,  F = s_L s_R^T / (s_L^2 s_R^2^T + lambda).

What any change of the frames does to W is a product of small matrices:

* frames L (P_ij o X) R^T of other factors: W = G(L) X G(R)^T with ``G(L) = sum_i U_Li^T L diag(p_i)``; of the solver's
  own ones G = S V^T;
* frames times gains g_ij: W = sum_ij g_ij G_i X G_j^T, with the terms of G one by one;
* gains of rows, 1 + u_ij d with a vector d of the rows and u_ij of variance 1 from frame to frame: the square of each
  frame's term of W with diag(d) L in place of L; a ripple of the light has two such d, its cosine and its sine;
* a frame E added to all: W = (sum_i U_Li)^T E (sum_j U_Rj);
* pixels whose responses differ by R from what the factors know: W = sum_ij U_Li^T (R o Y_ij) U_Rj;
* noise of variance v in each datum: the variance of each number of W is v, as U_L and U_R are orthonormal; of a frame
  that is taken off all others v |sum_i U_Li|^2 |sum_j U_Rj|^2, column by column;
* noise of variance nu^2 in each number of the left factor that the frames do not know of: that of G is
  nu^2 |sum_i p_i(x) U_Li|^2, and so on through the product, and the same of the right one;
* an error of variance e^2 in each scene pixel's light, equal in all frames: that of W is e^2 s_L^2 s_R^2^T;
* columns x of the left factor times 1 + eta_x of variance eta^2: eta^2 sum_x (s_L V_L(x))^2 (X V_R S_R)(x)^2; and of
  the right one.

A pattern of +-1 is the difference of two frames (1 +- P) / 2. What is added to both is gone, their noise and their
flicker add up, and with gains g+ and g- it is (g+ + g-) / 2 of the pattern and (g+ - g-) / 2 of uniform light.

The expected squared error of X^ is that of its mean and, as V is orthonormal, the sum of F^2 times these variances.

How far the squared error of one image scatters about what is expected of it: with b the part of an image's error that
is no noise, and C the covariance of the noise in its numbers, the squared error |b + e|^2 of normal e has the variance
2 tr(C^2) + 4 b^T C b. In the coefficients above, e = F o dW,

* noise of data and of the scene's light is independent from one number of W to the next, of variance v_kl, so that
  tr(C^2) = sum F_kl^4 v_kl^2; so are different kinds of noise, whose variances add up;
* noise of variance nu_kx^2 of the left factor's G has row k of W see scene pixel x through a_x = (X V_R S_R)(x): C_k =
  F_k o (sum_x nu_kx^2 a_x a_x^T) o F_k, hence tr(C_k^2) = nu_k^2^T (K_k o K_k) nu_k^2 with K_k(x, y) = sum_l F_kl^2
  a_xl a_yl; rows are taken for independent, as they are where patterns share no pixels;
* columns of the left factor off by eta_x each add one number times s_k V_L(x, k) a_x, so that tr(C^2) = eta^4 sum_xy
  (sum_k s_k^2 V_L(x, k) V_L(y, k) K_k(x, y))^2;
* and the same of the right factor. In b^T C b stands the square of sum_l F_kl b_kl a_xl, weighed likewise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.devices.patterns import PatternFamily

Terms = Sequence[tuple[FloatArray, FloatArray]]
"""Separable terms of a camera, left (m, n) and right (m', n') each."""
Gains = Sequence[float | FloatArray]
"""Root mean squares of gains that know nothing of each other: of a whole frame, or (m,) of its rows."""


# ---- One side of the camera by its singular vectors ----


@dataclass(frozen=True, eq=False)
class Axis:
    """One side.

    Attributes
    ----------
    slabs, singular, basis
        (K, m, r) of U, (r,) of S and (n, r) of V.
    patterns
        (n, K).
    """

    slabs: FloatArray
    singular: FloatArray
    basis: FloatArray
    patterns: FloatArray

    @classmethod
    def of(cls, factor: FloatArray, patterns: FloatArray) -> Axis:
        """Of a side with a ``factor`` (m, n) and ``patterns`` (n, K)."""
        stacked = np.concatenate([factor * column for column in patterns.T])
        left, singular, right = np.linalg.svd(stacked, full_matrices=False)
        return cls(left.reshape(patterns.shape[1], *factor.shape[:1], -1), singular, right.T, patterns)

    @cached_property
    def total(self) -> FloatArray:
        """(m, r) sum of the slabs."""
        return np.asarray(self.slabs.sum(axis=0))

    def terms_of(self, factor: FloatArray) -> FloatArray:
        """(K, r, n) terms of G of a ``factor``."""
        return np.asarray(np.einsum("kmr,mn,nk->krn", self.slabs, factor, self.patterns, optimize=True))

    def seen_evenly(self, factor: FloatArray) -> FloatArray:
        """(K, r, n) the same of a ``factor`` in uniform light."""
        return np.asarray(np.einsum("kmr,mn->krn", self.slabs, factor, optimize=True))

    @cached_property
    def noise(self) -> FloatArray:
        """(r, n) variance of G where each number of the factor has variance 1."""
        mixed = np.einsum("nk,kmr->nmr", self.patterns, self.slabs, optimize=True)
        return np.asarray(np.square(mixed).sum(axis=1).T)


# ---- Frames that are not what factors say, and the image expected of them ----


@dataclass(frozen=True, eq=False)
class Expected:
    """What an image is expected to be: its mean, and the squared error about it.

    Attributes
    ----------
    image
        (n, n') mean.
    variance
        sum of the variances of all its numbers.
    """

    image: FloatArray
    variance: float = 0.0

    def psnr_db(self, truth: FloatArray) -> float:
        """Of the mean squared error against a ``truth`` (n, n'), peak 1; infinite without any."""
        square = (float(np.square(self.image - truth).sum()) + self.variance) / truth.size
        return float("inf") if square == 0 else float(-10 * np.log10(square))


@dataclass(frozen=True, eq=False)
class Changed:
    """Frames of a scene that are not what the solver's factors say; nothing is changed by default.

    Attributes
    ----------
    terms
        what is added to the camera's own separable operator.
    gain, gain_apart
        (K, K') gains of the frames on average; of a pattern that is a difference of two, their mean, and half of what
        the first has more than the second.
    flicker
        rms of further gains of each frame, all independent: a number each, or (m,) numbers, by row.
    response
        (m, m') what each pixel's response differs by from what the factors know, as a part of it; the same in every
        frame.
    leak
        part of the light of all pixels that is in every frame beside the pattern's.
    added
        (m, m') frame that is added to all frames.
    added_gain, added_flicker, added_common
        what it is multiplied by: on average; and rms of further gains, as ``flicker``, from frame to frame and for all
        frames alike.
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


# ---- Noise of independent numbers ----


@dataclass(frozen=True)
class Noise:
    """Noise that is independent in every number, as variances.

    Attributes
    ----------
    datum
        of each datum of a frame; of a pattern that is a difference of two, of each of these.
    ambient
        of each datum of a frame that is taken off all others.
    left, right
        of each number of the factors, as far as frames do not share it.
    light
        of each scene pixel's light, as parts of a white board's, in all frames alike.
    left_light, right_light
        of what each column of a factor is multiplied by.
    """

    datum: float = 0.0
    ambient: float = 0.0
    left: float = 0.0
    right: float = 0.0
    light: float = 0.0
    left_light: float = 0.0
    right_light: float = 0.0

    def __add__(self, other: Noise) -> Noise:
        """Both, of sources that do not know of each other."""
        return Noise(*(getattr(self, each.name) + getattr(other, each.name) for each in fields(self)))

    def __sub__(self, other: Noise) -> Noise:
        """All but an ``other`` that is part of it."""
        return Noise(*(getattr(self, each.name) - getattr(other, each.name) for each in fields(self)))


# ---- A linear solver with its lambda fixed ----


@dataclass(frozen=True, eq=False)
class LinearImage:
    """A solver with its lambda fixed.

    Attributes
    ----------
    left, right
        Phi_L (m, n), Phi_R (m', n').
    family
        the patterns.
    lam
        lambda, above 0.
    centre
        whether means of rows and columns are taken off factors and frames.
    """

    left: FloatArray
    right: FloatArray
    family: PatternFamily
    lam: float
    centre: bool = False

    def expected_image(self, scene: FloatArray, changed: Changed | None = None, noise: Noise | None = None) -> Expected:
        """The image of a scene.

        Parameters
        ----------
        scene
            X (n, n').
        changed, noise
            what its frames differ by from what the factors say; None: nothing.
        """
        changed, noise = changed or Changed(), noise or Noise()
        left, right = self.axes
        cameras = [(self.left, self.right), *changed.terms]  # U has no means where frames are to lose theirs
        weights = np.zeros_like(self.filter)
        gain, apart = (np.broadcast_to(each, self._count) for each in (changed.gain, changed.gain_apart))
        seen = [(left.terms_of(first), right.terms_of(second)) for first, second in cameras]
        for row, column in np.ndindex(gain.shape):
            weights += gain[row, column] * _together(seen, row, column, scene)
        even = [(left.seen_evenly(first), right.seen_evenly(second)) for first, second in cameras]
        lit = 1 + 2 * changed.leak
        if self.family.signed and apart.any():
            for row, column in np.ndindex(gain.shape):
                weights += apart[row, column] * lit * _together(even, row, column, scene)
        if changed.response is not None:
            weights += self._by_response(changed.response, cameras, scene, gain)
        if changed.leak and not self.family.signed:
            uniform = sum(first @ scene @ second.T for first, second in cameras)
            weights += changed.leak * left.total.T @ uniform @ right.total
        if changed.added is not None and not self.family.signed:
            weights += changed.added_gain * left.total.T @ changed.added @ right.total
        variance = sum(self._energy(np.square(term)) for term in self._by_gains(scene, changed))
        variance += self.variance(scene, noise)
        return Expected(left.basis @ (self.filter * weights) @ right.basis.T, variance)

    def scatter(self, scene: FloatArray, changed: Changed, error: FloatArray) -> float:
        """Variance that gains, as they are drawn, bring into the squared error, sum over the image.

        Of independent normal gains that add e_g each to the image, beside an error b: sum_g 4 (b . e_g)^2 + 2 |e_g|^4.

        Parameters
        ----------
        scene, changed
            as for :meth:`expected`.
        error
            (n, n') error b of the image without them.
        """
        left, right = self.axes
        off = self.filter * (left.basis.T @ error @ right.basis)
        terms = self._by_gains(scene, changed)
        return sum(4 * float((off * term).sum()) ** 2 + 2 * self._energy(np.square(term)) ** 2 for term in terms)

    # ---- What gains and pixels' response add to W ----

    def _by_gains(self, scene: FloatArray, changed: Changed) -> Iterator[FloatArray]:
        """(r, r') what each gain that varies adds to W, by its rms."""
        left, right = self.axes
        cameras = [(self.left, self.right), *changed.terms]
        lit = 1 + 2 * changed.leak
        for rms in changed.flicker:
            varied = [(left.terms_of(_by_row(rms) * first), right.terms_of(second)) for first, second in cameras]
            evenly = [(left.seen_evenly(_by_row(rms) * first), right.seen_evenly(second)) for first, second in cameras]
            for row, column in np.ndindex(self._count):
                term = _together(varied, row, column, scene)
                if self.family.signed:  # the gains of two frames
                    uniform = lit * _together(evenly, row, column, scene)
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

    def _by_response(self, response: FloatArray, cameras: Terms, scene: FloatArray, gain: FloatArray) -> FloatArray:
        """What pixels' ``response`` adds to W, in frames of a ``scene`` behind ``cameras`` with a ``gain`` (K, K')
        each."""
        left, right = self.axes
        weights = np.zeros_like(self.filter)
        for row, column in np.ndindex(self._count):
            lit = np.outer(left.patterns[:, row], right.patterns[:, column]) * scene
            frame = sum(first @ lit @ second.T for first, second in cameras)
            weights += gain[row, column] * left.slabs[row].T @ (response * frame) @ right.slabs[column]
        return weights

    # ---- Variance by noise ----

    def variance(self, scene: FloatArray, noise: Noise) -> float:
        """Sum of the variances of all numbers of the image of a ``scene`` (n, n') by ``noise``."""
        units = self.units(scene)
        return self._energy(sum((getattr(noise, name) * unit for name, unit in units.items()), np.zeros((1, 1))))

    def units(self, scene: FloatArray) -> dict[str, FloatArray]:
        """(r, r') variance of each number of W by 1 of each :class:`Noise`, of frames of a ``scene`` (n, n')."""
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
        """Patterns of rows, and of columns."""
        return len(self.axes[0].slabs), len(self.axes[1].slabs)

    def _energy(self, variance: FloatArray) -> float:
        """Sum over the image of what has this ``variance``, or squares, in W."""
        return float((np.square(self.filter) * variance).sum())

    @cached_property
    def axes(self) -> tuple[Axis, Axis]:
        """Left and right."""
        left = Axis.of(self._centre(self.left), self.family.left.astype(np.float64))
        right = Axis.of(self._centre(self.right), self.family.right.astype(np.float64))
        return left, right

    @cached_property
    def filter(self) -> FloatArray:
        """(r, r') F."""
        sigma = np.outer(self.axes[0].singular, self.axes[1].singular)
        return np.asarray(sigma / (np.square(sigma) + self.lam))

    def _centre(self, matrix: FloatArray) -> FloatArray:
        return np.asarray(matrix - matrix.mean(axis=0)) if self.centre else matrix


# ---- Terms of single frames ----


def _by_row(rms: float | FloatArray) -> FloatArray:
    return np.reshape(np.asarray(rms, dtype=np.float64), (-1, 1))


def _together(seen: Terms, row: int, column: int, scene: FloatArray) -> FloatArray:
    """(r, r') part of W of one frame of a scene (n, n'); ``seen`` are terms of G, (K, r, n) and (K', r', n')."""
    return np.asarray(sum(first[row] @ scene @ second[column].T for first, second in seen))


# ---- Scatter of the squared error about its mean ----

_KINDS = tuple(each.name for each in fields(Noise))
"""In the order of all arrays by kind."""


@dataclass(frozen=True, eq=False)
class Scatter:
    """Of the squared error, sum over the image, of a ``scene`` (n, n') as a ``solver`` makes it.

    Errors that are no noise are (n, n') each.
    """

    solver: LinearImage
    scene: FloatArray

    def deviation(self, noise: Noise, error: FloatArray) -> float:
        """Standard deviation with so much ``noise`` beside an ``error`` that is none."""
        return math.sqrt(self._variance(noise, error))

    def share(self, noise: Noise, among: Noise, error: FloatArray) -> float:
        """Standard deviation of what a source adds.

        Parameters
        ----------
        noise, among
            of the source, and of all, the source with them.
        error
            that is no noise.
        """
        return math.sqrt(max(self._variance(among, error) - self._variance(among - noise, error), 0.0))

    def common(self, noise: Noise, error: FloatArray) -> float:
        """Standard deviation of what ``noise`` has in common with an ``error`` that is none, 2 b . e."""
        return math.sqrt(float(self._beside(error) @ _amounts(noise)))

    def _variance(self, noise: Noise, error: FloatArray) -> float:
        amounts = _amounts(noise)
        return float(amounts @ self._own @ amounts + self._beside(error) @ amounts)

    def _beside(self, error: FloatArray) -> FloatArray:
        """(kinds,) variance of 2 b . e by a variance."""
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
        """(kinds, kinds) variance of |e|^2 by the product of two variances."""
        found, gain = 2 * self._energies @ self._energies.T, self.solver.filter
        for (side, axis, seen), weights in zip(self._sides, (gain, gain.T), strict=True):
            for name, square in zip((side, f"{side}_light"), _squares(axis, seen, weights), strict=True):
                found[_KINDS.index(name), _KINDS.index(name)] = 2 * square
        return np.asarray(found)

    @cached_property
    def _energies(self) -> FloatArray:
        """(kinds, r r') variance of the image's coefficients by a variance."""
        units = self.solver.units(self.scene)
        return np.stack([(np.square(self.solver.filter) * units[name]).ravel() for name in _KINDS])

    @property
    def _sides(self) -> tuple[tuple[str, Axis, FloatArray], tuple[str, Axis, FloatArray]]:
        """Each factor, and (n, r') a_x through the other one."""
        left, right = self.solver.axes
        through_right = self.scene @ (right.basis * right.singular)
        return ("left", left, through_right), ("right", right, self.scene.T @ (left.basis * left.singular))


def _amounts(noise: Noise) -> FloatArray:
    return np.array([getattr(noise, name) for name in _KINDS])


def _squares(axis: Axis, seen: FloatArray, gain: FloatArray) -> tuple[float, float]:
    """tr(C^2) of noise of variance 1 in the numbers of a factor, and in what its columns are multiplied by.

    Parameters
    ----------
    axis, seen
        of the factor; and (n, r') a_x through the other one.
    gain
        (r, r') F.
    """
    square, light = 0.0, axis.basis * axis.singular
    together = np.zeros((len(seen), len(seen)))
    for row, weights in enumerate(gain):
        passed, variance = seen * weights, axis.noise[row]
        kernel = passed @ passed.T
        square += float(variance @ np.square(kernel) @ variance)
        together += np.outer(light[:, row], light[:, row]) * kernel
    return square, float(np.square(together).sum())
