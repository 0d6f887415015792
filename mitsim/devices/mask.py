"""Coded masks: from a code to the transmission at any point, and masks given feature by feature with their terms.

Coordinates are index coordinates, ``s_row = -y`` and ``s_col = -x`` in mm, centred on the optical axis. A mask is
opaque outside its features. Masks of one or two terms (maximum length sequences, FlatCam, MURA) are exact crosses of
the matrix (Bebendorf, Numerische Mathematik 86, 565, 2000). Other masks are sums of singular vectors.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, lru_cache
from typing import ClassVar, Literal

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import ByValue, FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import stream

MaskKind = Literal["separable", "flatcam", "open"]
CameraMask = Literal["separable", "flatcam", "open", "plate"]
Term = tuple[float, FloatArray, FloatArray]
"""Weight, row profile (N,) and column profile (N,) of a separable part of a transmission."""
BoolArray = npt.NDArray[np.bool_]
# fmt: off
_TAPS = {
    2: (1,), 3: (2,), 4: (3,), 5: (3,), 6: (5,), 7: (6,), 8: (7, 6, 1), 9: (5,), 10: (7,), 11: (9,), 12: (11, 10, 4),
    13: (12, 11, 8), 14: (13, 12, 2), 15: (14,), 16: (15, 13, 4),
}
# fmt: on
"""Feedback taps by order, as in ``scipy.signal.max_len_seq``."""


# ---- Flaws of making and mounting a mask ----
#
# Edge blur is a Gaussian over the transmission of power. The blurred mask is turned in its plane, and tilted to the
# sensor.

_REACH = 8.3


@dataclass(frozen=True)
class Flaws:
    """Flaws of a mask: blur of its edges, turn from rows to columns, and tilt along rows and along columns."""

    blur_mm: float = 0.0
    turn_deg: float = 0.0
    tilt_mrad: tuple[float, float] = (0.0, 0.0)

    @property
    def margin_mm(self) -> float:
        return _REACH * self.blur_mm

    def reach(self, extent_mm: float) -> float:
        angle = np.radians(self.turn_deg)
        # A ray meets a tilted mask farther out than an even one, by less than the tangent of the tilt.
        tilt = 1 + sum(abs(angle) for angle in self.tilt_mrad) * 1e-3
        return float(extent_mm * (abs(np.cos(angle)) + abs(np.sin(angle))) * tilt**2 + 2 * self.margin_mm)

    def turned_back(self, row: FloatArray, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        if not self.turn_deg:
            return row, column
        cosine, sine = np.cos(np.radians(self.turn_deg)), np.sin(np.radians(self.turn_deg))
        return cosine * row + sine * column, cosine * column - sine * row


NO_FLAWS = Flaws()
"""A mask as it is drawn."""


# ---- A mask made from a code ----


@dataclass(frozen=True, eq=False)
class Mask(ByValue):
    """An opaque plate with a square grid of features, each open or closed.

    Attributes
    ----------
    kind
        ``separable``: transmission a(row) a(column) with a the 0/1 bits (25 % open).
        ``flatcam``: (1 + m(row) m(column)) / 2 with m = 2 bits - 1 (50 % open).
        ``open``: every feature open, an aperture of the mask's size.
    bits
        (N,) 0/1 code of rows and columns, read-only.
    """

    kind: MaskKind
    feature_mm: float
    bits: npt.NDArray[np.int8]
    blur_mm: ClassVar[float] = 0.0
    """Standard deviation of its edges, which are sharp."""
    flaws: ClassVar[Flaws] = NO_FLAWS
    irradiance: ClassVar[bool] = False
    many: ClassVar[bool] = False
    """Two terms at most."""
    diffracts: ClassVar[bool] = True

    def __post_init__(self) -> None:
        self._hold(bits=np.array(self.bits, dtype=np.int8))

    @property
    def extent_mm(self) -> float:
        return len(self.bits) * self.feature_mm

    @property
    def lines(self) -> FloatArray:
        return np.asarray((np.arange(len(self.bits) + 1) - len(self.bits) / 2) * self.feature_mm)

    @property
    def terms(self) -> tuple[Term, ...]:
        ones = np.ones(len(self.bits))
        if self.kind == "open":
            return ((1.0, ones, ones),)
        if self.kind == "separable":
            profile = self.bits.astype(np.float64)
            return ((1.0, profile, profile),)
        signed = 2 * self.bits.astype(np.float64) - 1
        return ((0.5, ones, ones), (0.5, signed, signed))

    crosses = terms
    """Both terms are exact."""

    @property
    def centred(self) -> bool:
        return self.kind == "flatcam"

    @property
    def opening_mm(self) -> float:
        is_open = np.ones_like(self.bits) if self.kind == "open" else self.bits
        return mean_opening(is_open[:, None] > 0, np.diff(self.lines))

    @property
    def amplitude(self) -> Mask:
        return self

    @property
    def openings(self) -> tuple[tuple[BoolArray, BoolArray], ...]:
        """Return grids of openings that do not overlap, (N,) rows and (N,) columns each."""
        bits = self.bits.astype(bool)
        if self.kind == "open":
            return ((np.ones_like(bits), np.ones_like(bits)),)
        return ((bits, bits),) if self.kind == "separable" else ((bits, bits), (~bits, ~bits))

    def transmission(self, s_row: npt.ArrayLike, s_col: npt.ArrayLike) -> FloatArray:
        count = len(self.bits)
        row, column = (np.floor(np.asarray(s, dtype=np.float64) / self.feature_mm + count / 2) for s in (s_row, s_col))
        in_rows, in_columns = ((at >= 0) & (at < count) for at in (row, column))
        i, j = np.where(in_rows, row, 0).astype(np.intp), np.where(in_columns, column, 0).astype(np.intp)
        total = sum(weight * rows[i] * columns[j] for weight, rows, columns in self.terms)
        return np.asarray(np.where(in_rows & in_columns, total, 0.0), dtype=np.float64)


def mean_opening(is_open: BoolArray, widths: FloatArray) -> float:
    begins = np.diff(is_open, axis=0, prepend=False) & is_open
    return float((widths @ is_open).sum() / max(np.count_nonzero(begins), 1))


@cache
def mls_code(order: int) -> npt.NDArray[np.int8]:
    """Return the (2**order - 1,) bits of the maximum length sequence of an ``order`` from 2 to 16, read-only.

    They are ``scipy.signal.max_len_seq(order)[0]``, whose import takes a second. Polynomial and phase matter, because
    another sequence changes the condition number by tens of percent.
    """
    bits = [1] * order
    for start in range(2**order - 1 - order):
        bit = bits[start]
        for tap in _TAPS[order]:
            bit ^= bits[start + tap]
        bits.append(bit)
    code = np.array(bits, dtype=np.int8)
    code.flags.writeable = False
    return code


def mls_mask(kind: MaskKind = "separable", feature_mm: float = 0.06, order: int = 9) -> Mask:
    return Mask(kind, feature_mm, mls_code(order))


# -------- Masks feature by feature

LEFT_OUT = 1e-7
"""Part of a transmission (rms) that singular vectors may leave: a tenth of the finest accuracy of a plan."""
RASTER_LEFT_OUT = 1e-4
"""The same for light on a raster; frames of dots err by 1e-5 or less."""
_SKETCHES = 96, 192
"""Directions in which the largest terms are searched; with more terms, correlations are faster."""
MOST_TERMS = _SKETCHES[-1]
"""Of a raster."""
_SMALL = 512
"""Values per side up to which means start at every value: a third of a pixel between means leaves 6e-3 of a frame."""
_TURNS = 2
"""Power iterations of a sketch; a third changes the number of terms by 1 %."""
FEW = 2
_MOST_DECOMPOSED = 1024
"""Most distinct rows and columns for singular vectors: 4096 take six minutes, and correlations are then faster."""
LARGEST = 4096
"""Features a side: a transmission takes 128 MiB."""
_MOST_CELLS = 2 * LARGEST
_ROUNDING = 1e-12
_GRIDS = 4


@dataclass(frozen=True, eq=False)
class Plate(ByValue):
    """A square plate of square features, each with its own transmission; MitsimError for values out of range.

    ``values`` (N, N) are transmissions of power, read-only, or of any size with ``irradiance``: the light behind the
    plate, which includes waves. Light is always averaged over ``averaged`` features, the side of a sensor pixel.
    ``words`` describe the plate in manifests.
    """

    feature_mm: float
    values: FloatArray = field(repr=False)
    words: str
    flaws: Flaws = NO_FLAWS
    irradiance: bool = False
    averaged: int = 1

    def __post_init__(self) -> None:
        values = np.array(self.values, dtype=np.float64)
        most = _MOST_CELLS if self.irradiance else LARGEST
        if values.ndim != 2 or values.shape[0] != values.shape[1] or not 1 <= len(values) <= most:
            raise MitsimError(f"{self.words}: has shape {values.shape}; give a square of 1 to {most} features a side")
        if not values.max() > (0 if self.irradiance else _ROUNDING):
            raise MitsimError(f"{self.words}: no feature lets light through; open some")
        self._hold(values=values)

    def _values(self) -> tuple[object, ...]:
        return self.feature_mm, self.words, self.digest, self.flaws, self.irradiance, self.averaged

    @cached_property
    def digest(self) -> str:
        return hashlib.sha256(np.ascontiguousarray(self.values).tobytes()).hexdigest()

    @property
    def identity(self) -> str:
        return f"{self.words}, features of {self.feature_mm:g} mm, sha256 {self.digest}"

    @property
    def extent_mm(self) -> float:
        return len(self.values) * self.feature_mm

    @cached_property
    def lines(self) -> FloatArray:
        return np.asarray((np.arange(len(self.values) + 1) - len(self.values) / 2) * self.feature_mm)

    @property
    def blur_mm(self) -> float:
        return self.flaws.blur_mm

    @property
    def plain(self) -> bool:
        return self.flaws == NO_FLAWS

    @cached_property
    def opening_mm(self) -> float:
        """Return the mean width of the openings along rows or columns, whichever is less [mm].

        A feature is open if it transmits half as much as the clearest one.
        """
        is_open, widths = self.values >= self.values.max() / 2, np.diff(self.lines)
        return min(mean_opening(is_open, widths), mean_opening(is_open.T, widths))

    @cached_property
    def crosses(self) -> tuple[Term, ...] | None:
        rest = self.values.copy()
        terms: list[Term] = []
        while True:
            row, column = np.unravel_index(np.argmax(np.abs(rest)), rest.shape)
            pivot = rest[row, column]
            if abs(pivot) <= _ROUNDING:
                return tuple(terms)
            if len(terms) == FEW:
                return None
            terms.append((1.0, rest[:, column].copy(), rest[row] / pivot))
            rest -= np.outer(terms[-1][1], terms[-1][2])

    @cached_property
    def terms(self) -> tuple[Term, ...]:
        if self.crosses is not None:
            return self.crosses
        if self.irradiance:
            found = self.largest
            if found.left_out > RASTER_LEFT_OUT:
                found = LargestTerms(self.values, self.averaged, sizes=(len(self.values),))
            return found.terms()
        if self.many:
            patterns, which = np.unique(self.values, axis=0, return_inverse=True)
            return tuple((1.0, (which.ravel() == k) * 1.0, pattern) for k, pattern in enumerate(patterns))
        (rows, columns), weights, weighted = _distinct(self.values)
        if self.symmetric:
            singular, left = np.linalg.eigh(weighted)
            singular, left = (each[..., np.argsort(-np.abs(singular))] for each in (singular, left))
            right = left.T
        else:
            left, singular, right = np.linalg.svd(weighted, full_matrices=False)
        left, right = left / weights[0], right / weights[1]
        beyond = np.sqrt(np.cumsum(np.square(singular[::-1]))[::-1])  # what the terms from each on hold
        count = int(np.count_nonzero(beyond > LEFT_OUT * beyond[0]))
        return tuple((float(singular[k]), left[rows, k], right[k, columns]) for k in range(count))

    @cached_property
    def most_terms(self) -> int:
        if self.crosses is not None:
            return len(self.crosses)
        both = self.values, np.ascontiguousarray(self.values.T)
        return min(len({line.tobytes() for line in lines}) for lines in both)

    @property
    def many(self) -> bool:
        return self.most_terms > _MOST_DECOMPOSED

    @cached_property
    def largest(self) -> LargestTerms:
        return LargestTerms(self.values, self.averaged)

    @cached_property
    def residuals(self) -> tuple[float, float]:
        """Return the relative part beyond one term, of the mask and of the mask without means of rows and columns."""

        def beyond_one(values: FloatArray) -> float:
            *_, weighted = _distinct(values)
            total = np.linalg.norm(weighted)
            if not total:
                return 0.0
            if min(weighted.shape) > _MOST_DECOMPOSED:
                from scipy.sparse.linalg import svds  # here: only the largest masks need it

                left, singular, right = svds(weighted, k=1, v0=np.ones(min(weighted.shape)))
                return float(np.linalg.norm(weighted - singular * left * right) / total)
            singular = np.linalg.svd(weighted, compute_uv=False)
            rest = float(np.linalg.norm(singular[1:]) / total)
            return rest if rest > _ROUNDING * len(values) else 0.0

        centred = self.values - self.values.mean(axis=0)
        return beyond_one(self.values), beyond_one(centred - centred.mean(axis=1, keepdims=True))

    @property
    def centred(self) -> bool:
        plain, without = self.residuals
        return without < plain

    @cached_property
    def amplitude(self) -> Plate:
        return self if self.binary else replace(self, values=np.sqrt(self.values))

    @cached_property
    def binary(self) -> bool:
        return bool(np.isin(self.values, (0, 1)).all())

    @property
    def mirrored(self) -> tuple[bool, bool]:
        return tuple(np.array_equal(self.values, np.flip(self.values, axis)) for axis in (0, 1))  # type: ignore[return-value]

    @cached_property
    def symmetric(self) -> bool:
        return np.array_equal(self.values, self.values.T)

    @property
    def uneven_part(self) -> float:
        return float(0.5 ** (sum(self.mirrored) + self.symmetric))

    @property
    def diffracts(self) -> bool:
        """Return True if diffraction is computed: not for light behind a plate, nor for several blurred terms."""
        sharp = not self.blur_mm or (self.crosses is not None and len(self.crosses) == 1 and not self.flaws.turn_deg)
        return not self.irradiance and sharp

    @cached_property
    def grids(self) -> tuple[tuple[BoolArray, BoolArray], ...] | None:
        """Return at most 4 grids of openings that do not overlap; None for more, and with flaws."""
        if not self.binary or not self.plain:
            return None
        patterns, which = np.unique(self.values[self.values.any(axis=1)], axis=0, return_inverse=True)
        if len(patterns) > _GRIDS:
            return None
        row_of = np.full(len(self.values), -1)
        row_of[self.values.any(axis=1)] = which.ravel()
        return tuple((row_of == k, pattern.astype(bool)) for k, pattern in enumerate(patterns))

    @property
    def openings(self) -> tuple[tuple[BoolArray, BoolArray], ...]:
        """Return grids that hold all openings; with flaws, a square of :attr:`cover`."""
        if self.grids is not None:
            return self.grids
        rows, columns = (np.asarray(self.values.any(axis=axis)) for axis in (1, 0))
        return ((rows, columns),) if self.plain else ((np.ones(self.cover, dtype=bool),) * 2,)

    @property
    def cover(self) -> int:
        return int(np.ceil(self.flaws.reach(self.extent_mm) / self.feature_mm))

    def transmission(self, s_row: npt.ArrayLike, s_col: npt.ArrayLike) -> FloatArray:
        count = len(self.values)
        turned = self.flaws.turned_back(np.asarray(s_row), np.asarray(s_col))
        row, column = (np.floor(np.asarray(s) / self.feature_mm + count / 2) for s in turned)
        inside = (row >= 0) & (row < count) & (column >= 0) & (column < count)
        place = (np.where(inside, at, 0).astype(np.intp) for at in np.broadcast_arrays(row, column))
        return np.asarray(np.where(inside, self.values[tuple(place)], 0.0))


@lru_cache(maxsize=8)
def within(plate: Plate, reach_mm: float) -> Plate:
    flaws = plate.flaws
    if flaws.turn_deg:
        reach_mm *= 2**0.5
    if plate.crosses is not None:
        return plate
    seen = reach_mm + flaws.margin_mm
    beyond, more = int((plate.extent_mm / 2 - seen) / plate.feature_mm), 1
    while beyond > 0:
        part = plate.values[beyond:-beyond, beyond:-beyond]
        if part.any():
            return replace(plate, values=part)
        # The part is closed all over, although no plate is: grow it to the next open feature.
        beyond, more = beyond - more, 2 * more
    return plate


def _distinct(values: FloatArray) -> tuple[tuple[npt.NDArray[np.intp], ...], tuple[FloatArray, ...], FloatArray]:
    """Return the distinct rows and columns of ``values``, weighted by their number.

    The result has the (N,) index of each row and column, roots of the weights, and weighted (rows, columns) values.
    """
    rows, first, row = np.unique(values, axis=0, return_index=True, return_inverse=True)
    if np.array_equal(values, values.T):
        columns, column = rows[:, first], row  # in the rows' order
    else:
        columns, column = np.unique(rows, axis=1, return_inverse=True)
    weights = np.sqrt(np.bincount(row.ravel()))[:, None], np.sqrt(np.bincount(column.ravel()))
    return (row.ravel(), column.ravel()), weights, weights[0] * columns * weights[1]


# -------- The largest terms of a raster


class LargestTerms:
    """Terms of large ``values`` (N, N) that hold means over squares of ``averaged`` values per side up to 1e-4, rms.

    With S the means along an axis, and U sigma W^T the largest singular vectors of S V S^T, the terms are V S^T W
    sigma^-1 U^T S V (Nystroem's approximation). Vectors come from a sketch in random directions (Halko, Martinsson and
    Tropp, SIAM Review 53, 217, 2011). ``sizes`` are tried in order; ``left_out`` is the rms part of the means that is
    missing, above 1e-4 where ``count`` is too small.
    """

    def __init__(self, values: FloatArray, averaged: int = 1, sizes: Sequence[int] = _SKETCHES) -> None:
        self._values, self._averaged = values, averaged
        apart = max(averaged // 3, 1) if len(values) > _SMALL else 1
        self._starts = np.arange(1 - averaged, len(values), apart)
        with single_threaded_blas():
            seen = self._seen = self._means(self._means(values).T).T
            whole = float(np.square(seen).sum())
            for size in sizes:
                directions = stream(0, "terms").standard_normal((len(seen), min(size, len(seen))))
                for _ in range(_TURNS):
                    directions = np.linalg.qr(seen.T @ (seen @ directions))[0]
                along = seen @ directions
                squared, turn = np.linalg.eigh(along.T @ along)
                held = np.cumsum(squared[::-1])
                rest = np.sqrt(np.maximum(whole - held, 0) / whole)
                enough = np.flatnonzero(rest <= RASTER_LEFT_OUT)
                if len(enough) or size >= len(seen):
                    break
        self.count = int(enough[0]) + 1 if len(enough) else len(held)
        self.left_out = float(rest[self.count - 1])
        self._squared, self._turn = squared[::-1][: self.count], directions @ turn[:, ::-1][:, : self.count]

    def terms(self) -> tuple[Term, ...]:
        with single_threaded_blas():
            left = self._values @ self._spread(self._turn)
            right = (self._spread(self._seen @ self._turn) / self._squared).T @ self._values
        return tuple((1.0, left[:, k], right[k]) for k in range(self.count))

    def _means(self, values: FloatArray) -> FloatArray:
        below = np.concatenate((np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)))
        ends = np.minimum(self._starts + self._averaged, len(values))
        return np.asarray((below[ends] - below[np.maximum(self._starts, 0)]) / self._averaged)

    def _spread(self, means: FloatArray) -> FloatArray:
        below = np.concatenate((np.zeros((1, means.shape[1])), np.cumsum(means, axis=0)))
        places = np.arange(len(self._values))
        first, beyond = (np.searchsorted(self._starts, places - less, "right") for less in (self._averaged, 0))
        return np.asarray((below[beyond] - below[first]) / self._averaged)
