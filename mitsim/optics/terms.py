"""Shadow of a camera's mask as it is mounted, turned, shaking or tilted, as a sum of separable terms."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product
from typing import Any

import numpy as np

from mitsim.core.arrays import FloatArray, SeparableTerm
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.projector import Spectrum
from mitsim.optics.diffraction import wave_terms
from mitsim.optics.fft_shadow import raster
from mitsim.optics.shadow import (
    Directions,
    Places,
    SeparableTerms,
    ShadowGeometry,
    geometric_terms,
    lagrange_weights,
    nodes_between,
)

# -------- A mask that is mounted askew, and the shadow of any mask
#
# Where a mask's distance grows by alpha along its rows and by beta along its columns, a ray of slope t that would
# cross the even plane at s crosses the mask at s + t (alpha s_row + beta s_col) / (1 - t . (alpha, beta)). Along the
# rows::
#
#     s_row + t_row (alpha s_row + beta s_col) / (1 - alpha t_row)
#
# but for the other axis's part of the slope, beta t_col of the shift, 30 nm of 5 um at 40 mrad. The rows' own tilt
# moves rows alone: the profile stays one. What the other axis adds is a profile that is moved by beta s_col t_row, as
# much as the column says; between Chebyshev's nodes sigma_k of s_col it is interpolated by Lagrange's polynomials
# l_k::
#
#     a(s_row + t_row beta s_col / ..) = sum_k l_k(s_col) a(s_row + t_row beta sigma_k / ..)
#
# so K nodes make K terms of each, and two tilts K L. Waves come from as far as the mask is where the ray crosses it:
# rows are formed at d + beta sigma_k, and interpolated over alpha s_row between those of three distances
# (:mod:`mitsim.optics.diffraction`), which keeps them one profile.


def shadow_terms(
    geometry: CameraGeometry,
    rows: Directions,
    columns: Directions,
    depth: float,
    spectrum: Spectrum | None = None,
    places: Places | None = None,
) -> SeparableTerms:
    """Return the shadow of directions at one depth [mm] as separable terms [(left (m, r), right (m', c)), ...].

    Each value is the mean over a pixel's active area times the fill factor, because irradiance is per pixel area. The
    angular response belongs to the light and is not included. ``spectrum`` has the lines of a wave-optical shadow, each
    with its own terms, and is None for a geometric one. ``places`` are increasing rows and columns of the frame; None
    for all.
    """
    shadow, waves = ShadowGeometry.of(geometry, depth, places), spectrum is not None
    if geometry.is_drawn(waves):
        shadow, spectrum = replace(shadow, mask=raster(geometry, depth, spectrum)), None
    if geometry.mask_motion is not None:
        return _moving_terms(geometry, shadow, rows, columns, depth, spectrum, places)

    def form(shadow: ShadowGeometry) -> SeparableTerms:
        if spectrum is None:
            return geometric_terms(shadow, rows, columns)
        return wave_terms(shadow, rows, columns, spectrum)

    nodes, terms = geometry.tilt_nodes(waves), list[SeparableTerm]()
    if nodes is None:
        terms = form(shadow)
    else:  # a tilted mask
        along, across = geometry.mask_tilt
        by_row, by_column = _crossings(shadow, rows, columns)
        first, second = nodes_between(by_column, nodes[0]), nodes_between(by_row, nodes[1])
        # One evaluation of both axes serves a node of each; the last of fewer nodes is evaluated again.
        padded = [np.pad(each, (0, max(nodes) - len(each)), "edge") for each in (first, second)]
        tilts = [((along, across * float(i)), (across, along * float(j))) for i, j in zip(*padded, strict=True)]
        seen = [form(replace(shadow, tilt=tilt)) for tilt in tilts]
        row_weights, column_weights = lagrange_weights(by_column, first), lagrange_weights(by_row, second)
        for i, j in product(range(nodes[0]), range(nodes[1])):
            both = zip(seen[i], seen[j], strict=True)
            terms += [(left * column_weights[j], right * row_weights[i]) for (left, _), (_, right) in both]
    part = geometry.pixel_fill_factor
    return terms if part == 1 else [(part * left, right) for left, right in terms]


# -------- A mask that is turned in its plane, or shakes
#
# **Turned** by a small angle theta about its centre, a separable mask a(s_row) b(s_col) is
# ``a(s_row + theta s_col) b(s_col - theta s_row)``: at every place the two profiles are shifted, each by what the other
# coordinate says. A profile between two shifts is interpolated from those at nodes delta_k, with weights w_k (hats)::
#
#     a(s_row + delta) = sum_k w_k(delta) a(s_row + delta_k)
#     M = sum_kl [a(s_row + delta_k) w_l(-theta s_row)] [b(s_col + delta_l) w_k(theta s_col)]
#
# so K nodes make K^2 separable terms of each term at rest. In rays and in waves alike: a shadow at one depth depends on
# s alone, and so turns with the mask. Nodes lie :data:`NODE_UM` apart or nearer, over a shadow that a pixel has
# averaged.
#
# **Shaking**, normally and independently along rows and columns, a mask casts the mean of the shadows that it casts
# where it is: of each profile the mean over its shifts, which keeps the number of terms.

NODE_UM = 0.5
"""Shift between nodes: it errs by less than 1 % of the effect of a rotation by 1 mrad."""
_SHAKES = np.linspace(-4.0, 4.0, 25)


def _moving_terms(
    geometry: CameraGeometry, shadow: ShadowGeometry, rows: Directions, columns: Directions, *others: Any
) -> SeparableTerms:
    motion = geometry.mask_motion
    assert motion is not None
    angle, deviation = motion.rotation_mrad / 1e3, motion.vibration_um / 1e3
    weights = np.exp(-np.square(_SHAKES) / 2)
    weights /= weights.sum()

    def shifted(by_mm: float) -> SeparableTerms:
        row, column = geometry.mask_offset
        moved = {"mask_motion": None, "mask_offset_row": row - by_mm, "mask_offset_column": column - by_mm}
        return shadow_terms(geometry.model_copy(update=moved), rows, columns, *others)

    def shaking(by_mm: float) -> SeparableTerms:
        if not deviation:
            return shifted(by_mm)
        # Factors are averaged one by one, because the axes shake independently.
        parts = [shifted(by_mm + float(place) * deviation) for place in _SHAKES]
        return [
            tuple(sum(weight * pair[side] for weight, pair in zip(weights, pairs, strict=True)) for side in (0, 1))
            for pairs in zip(*parts, strict=True)
        ]

    if not angle:
        return shaking(0.0)
    row, column = _crossings(shadow, rows, columns)
    reach = abs(angle) * max(float(np.abs(row).max()), float(np.abs(column).max()))
    nodes = np.linspace(-reach, reach, max(2, 1 + int(np.ceil(2 * reach / (NODE_UM / 1e3)))))
    at_nodes = [shaking(float(node)) for node in nodes]
    places = ((shift - nodes[0]) / (nodes[1] - nodes[0]) for shift in (-angle * row, angle * column))
    by_row, by_column = ([np.maximum(1 - np.abs(place - k), 0.0) for k in range(len(nodes))] for place in places)
    return [
        (left * by_row[second], right * by_column[first])
        for (first, lefts), (second, rights) in product(enumerate(at_nodes), enumerate(at_nodes))
        for (left, _), (_, right) in zip(lefts, rights, strict=True)
    ]


def _crossings(shadow: ShadowGeometry, rows: Directions, columns: Directions) -> list[FloatArray]:
    both = enumerate((rows, columns))
    return [shadow.along(axis).crossings(directions) - shadow.offset_mm[axis] for axis, directions in both]


# -------- Sums of separable terms as operators
#
# Sums of separable terms as operators: differences, and the distance from a single separable term.
#
# The sum of ``L_k (x) R_k`` takes an image X to the frame ``sum_k L_k X R_k^T``. As a matrix from pixels to pixels it
# has (m m') x (n n') entries; written with vec(L_k) and vec(R_k) as columns it is ``A = L R^T`` with as few columns as
# there are terms, and its Frobenius norm and singular values are those of small matrices (Van Loan and Pitsianis,
# 1993). Left and right factors of all terms have one shape each.

_LEFT_OUT = 0.03
"""Part of the residual (rms) that its terms may neglect: a thousandth of its energy."""
_TURNS = 2


@dataclass(frozen=True, eq=False)
class BestTerm:
    """The separable term nearest to an operator A in the Frobenius norm, both factors of equal norm.

    ``residual`` is ||A - left (x) right|| / ||A||.
    """

    left: FloatArray
    right: FloatArray
    residual: float


@dataclass(frozen=True, eq=False)
class Lacking:
    """Part of a camera's operator that its factors lack, but for 3 % (rms), and its relative norm."""

    terms: SeparableTerms
    residual: float


def best_term(terms: SeparableTerms) -> BestTerm:
    """Return the separable term that is closest to the sum of ``terms``, with the sign of the largest term.

    Singular values come from QR factorisations, because Gram matrices would leave 1e-8 where the residual is zero.
    """
    values, split = _singular(terms)
    left, right = split(0)
    largest = max(terms, key=lambda pair: float(np.linalg.norm(pair[0]) * np.linalg.norm(pair[1])))
    sign, energy = 1.0 if np.vdot(left, largest[0]) >= 0 else -1.0, np.square(values)
    return BestTerm(sign * left, sign * right, float(np.sqrt(energy[1:].sum() / energy.sum())))


def lacking(terms: SeparableTerms, left: FloatArray, right: FloatArray) -> Lacking:
    """Return the part of an operator that factors (m, n) and (m', n') estimated from a session's stripes lack.

    Comparing the factors that stripes give of ``terms``, which assume pixels of one brightness, with the found factors
    gives the brightness of each column in the session.
    """
    whole = terms
    for _ in range(_TURNS):
        rows, columns = (
            np.einsum("ij,ij->j", found, own) / np.maximum(np.einsum("ij,ij->j", own, own), np.finfo(np.float64).tiny)
            for found, own in zip((left, right), stripe_term(whole), strict=True)
        )
        whole = [(rows * a, columns * b) for a, b in whole]
    values, split = _singular([*whole, (-left, right)])
    beyond = np.sqrt(np.cumsum(np.square(values[::-1]))[::-1])
    count = int(np.count_nonzero(beyond > _LEFT_OUT * beyond[0]))
    every_left, every_right = (np.stack([np.ravel(pair[side]) for pair in whole]) for side in (0, 1))
    energy = max(float(((every_left @ every_left.T) * (every_right @ every_right.T)).sum()), 0.0)
    return Lacking([split(number) for number in range(count)], float(beyond[0] / np.sqrt(energy)))


def stripe_term(terms: SeparableTerms) -> SeparableTerm:
    """Return the factors that stripes give of an operator (:mod:`mitsim.reconstruct.factors`).

    The uniform response sum_k (L_k 1) (R_k 1)^T splits into a v^T, and stripes h 1^T into u v^T with u = sum_k L_k h
    <R_k 1, v> / |v|^2, so that the left factor is the sum of L_k with these weights.
    """
    uniform = best_term([(a.sum(axis=1, keepdims=True), b.sum(axis=1, keepdims=True)) for a, b in terms])
    split = uniform.left[:, 0], uniform.right[:, 0]
    return (
        sum((a * (np.dot(b.sum(axis=1), split[1]) / np.dot(split[1], split[1])) for a, b in terms), 0 * terms[0][0]),
        sum((b * (np.dot(a.sum(axis=1), split[0]) / np.dot(split[0], split[0])) for a, b in terms), 0 * terms[0][1]),
    )


def _singular(terms: SeparableTerms) -> tuple[FloatArray, Callable[[int], SeparableTerm]]:
    sides = [np.stack([np.ravel(pair[side]) for pair in terms], axis=1) for side in (0, 1)]
    (left, small_left), (right, small_right) = map(np.linalg.qr, sides)
    turn_left, values, turn_right = np.linalg.svd(small_left @ small_right.T)

    def split_term(number: int) -> SeparableTerm:
        root = np.sqrt(values[number])
        parts = root * left @ turn_left[:, number], root * right @ turn_right[number]
        return parts[0].reshape(terms[0][0].shape), parts[1].reshape(terms[0][1].shape)

    return values, split_term


def centre_terms(terms: SeparableTerms) -> SeparableTerms:
    return [(left - left.mean(axis=0), right - right.mean(axis=0)) for left, right in terms]


# -------- A camera as numbers that a fit can vary
#
# Column p of a factor is the mask's shadow of light from projector pixel p, geometric or wave-optical, in closed form,
# times the losses of slanted rays between a flat diffuse board and a flat sensor: both cosines and the square of the
# distance, z^2 / r^4 with r^2 = z^2 (1 + t_row^2 + t_column^2) and t = tau - u / z. As a product of the two axes,
# (1 + t_row^2)^-2 (1 + t_column^2)^-2, the error is at most 2 t_row^2 t_column^2. All projector pixels are assumed to
# be equally bright.
#
# A mask that is turned by a small angle phi from rows toward columns transmits r(s + phi t) c(t - phi s), which is not
# separable. To first order it is L (x) R + phi (dL/ds (x) T o R - S o L (x) dR/dt), with S and T the mask coordinates
# of rays from pixels to directions.

_ANGLE = 2.0
_DERIVED_MM = 5e-4
_KEPT = 12


@dataclass(frozen=True)
class Placement:
    """Positions of mask and projector, and brightness of the board.

    Shifts and distance of the mask are in mm, and ``mask_rotation`` runs from rows toward columns [rad].
    ``magnification`` scales the projector's window, whose shift is a tangent. ``gain`` is in electrons per second from
    a projector pixel on a sensor pixel without the mask.
    """

    mask_distance: float
    mask_shift_row: float = 0.0
    mask_shift_column: float = 0.0
    mask_rotation: float = 0.0
    magnification: float = 1.0
    projector_row: float = 0.0
    projector_column: float = 0.0
    gain: float = 1.0

    def move(self, steps: Mapping[str, float]) -> Placement:
        return replace(self, **{name: getattr(self, name) + step for name, step in steps.items()})


@dataclass(frozen=True, eq=False)
class ModelledCamera:
    """Model of a camera as designed, with tan-angles ``windows`` of the projector on the aligned plane."""

    geometry: CameraGeometry
    windows: tuple[tuple[float, float], tuple[float, float]]
    n: int
    spectrum: Spectrum | None = None

    @property
    def built(self) -> Placement:
        return Placement(self.geometry.mask_distance)

    def factors(self, placement: Placement) -> tuple[FloatArray, FloatArray]:
        left, right = self._cached_factors(replace(placement, gain=1.0, mask_rotation=0.0))
        root = np.sqrt(placement.gain)
        return left * root, right * root

    @cached_property
    def _cached_factors(self) -> Callable[[Placement], tuple[FloatArray, FloatArray]]:
        @lru_cache(maxsize=_KEPT)
        def axis(distance: float, offset: float, directions: Directions) -> SeparableTerms:
            update = {"mask_distance": distance, "mask_offset_row": offset, "mask_offset_column": offset}
            camera, depth = self.geometry.model_copy(update=update), self.geometry.scene_distance
            squared = [np.square(directions.centres - camera.centres(of)[:, None] / depth) for of in (0, 1)]
            by_row, by_column = ((1 + each) ** -_ANGLE * camera.angular_response(each) for each in squared)
            terms = shadow_terms(camera, directions, directions, depth, self.spectrum)
            return [(left * by_row, right * by_column) for left, right in terms]

        @lru_cache(maxsize=_KEPT)
        def form(placement: Placement) -> tuple[FloatArray, FloatArray]:
            shifts = placement.mask_shift_row, placement.mask_shift_column
            offsets = zip(self.geometry.mask_offset, shifts, self._directions(placement), strict=True)
            by_row, by_column = (axis(placement.mask_distance, own + more, each) for own, more, each in offsets)
            terms = [(left, right) for (left, _), (_, right) in zip(by_row, by_column, strict=True)]
            best = best_term(centre_terms(terms) if self.geometry.centred else terms)
            return best.left, best.right

        return form

    def rotation_terms(self, placement: Placement) -> SeparableTerms:
        step = {"mask_shift_row": _DERIVED_MM, "mask_shift_column": _DERIVED_MM}
        ahead = self.factors(placement.move(step))
        behind = self.factors(placement.move({name: -value for name, value in step.items()}))
        # A mask that moves by o is seen at s - o.
        slopes = [(back - on) / (2 * _DERIVED_MM) for on, back in zip(ahead, behind, strict=True)]
        left, right = self.factors(placement)
        geometry, distance = self.geometry, placement.mask_distance
        shifts = placement.mask_shift_row, placement.mask_shift_column
        across, along = (
            (1 - distance / geometry.scene_distance) * geometry.centres(axis)[:, None]
            + distance * each.centres
            - geometry.mask_offset[axis]
            - shifts[axis]
            for axis, each in enumerate(self._directions(placement))
        )
        return [(slopes[0], along * right), (-across * left, slopes[1])]

    def _directions(self, placement: Placement) -> tuple[Directions, Directions]:
        edges = []
        for window, shift in zip(self.windows, (placement.projector_row, placement.projector_column), strict=True):
            middle, half = sum(window) / 2 + shift, (window[1] - window[0]) / 2 * placement.magnification
            edges.append(np.linspace(middle - half, middle + half, self.n + 1))
        return Directions.cells(edges[0]), Directions.cells(edges[1])
