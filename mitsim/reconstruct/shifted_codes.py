"""Pictures that a camera saw and its frames of them in; the two factors, each side a code seen through shifts, out.

A mask before a sensor casts the same shadow from every direction, shifted. Where it fills the view, or ends within it,
a side's factor is one unknown code c on a grid of sensor pixels, seen from scene pixel i through a shift::

    Phi[u, i] = sum_k b_k(i) c_k(u + o + s i)

with s the sensor pixels that one scene pixel shifts the shadow by, o the place of this frame's pixels (planes of a Bayer
sensor lie half a pixel apart), and b_k polynomials over the scene, b_0 = 1. One term is the camera whose directions are
alike; more terms let the code change smoothly over the scene: each side free, but smooth.

*Given one side, the other is linear.* With Z = X Phi_R^T a frame is Y = Phi_L Z, and Phi_L is linear in its codes: least
squares whose normal matrix is the same (w, w) block, added up along the diagonal. Left and right take turns until the
residual stands still. Codes have the prior of a smooth curve, lambda |c''|^2; the residual's noise over what lambda
makes of it is the covariance, of posterior errors, that is stated.

*Where to begin.* By the convolution theorem a frame's spectrum is Y(f, g) = C_L(f) C_R(g) X(-s f, -s' g), up to the
sensor's edges: Y over X is a product of two vectors, and how nearly it is one tells orientation and scale of the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize_scalar

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import single_threaded_blas
from mitsim.reconstruct.solver import centre_columns, centre_frame

Orientation = tuple[bool, bool, bool]
"""Whether a picture is transposed, then turned upside down, then mirrored, to lie as the camera's code runs."""
ORIENTATIONS: tuple[Orientation, ...] = tuple(
    (transposed, upside, mirrored)
    for transposed in (False, True)
    for upside in (False, True)
    for mirrored in (False, True)
)


def turn(picture: FloatArray, orientation: Orientation) -> FloatArray:
    """A ``picture`` (n, n') as it lies in an ``orientation``."""
    transposed, upside, mirrored = orientation
    turned = picture.T if transposed else picture
    return np.ascontiguousarray(turned[:: -1 if upside else 1, :: -1 if mirrored else 1])


@dataclass(frozen=True, eq=False)
class Exposure:
    """A frame and the light that it is of.

    Attributes
    ----------
    scene
        (n, n') picture, times its pattern.
    frame
        (m, m') measurement [electrons/s].
    group
        picture that it is of: frames of one picture are held out together.
    plane
        name of the sensor's plane; planes have gains of their own.
    offset
        of the plane's pixels, down and to the right [pixels].
    """

    scene: FloatArray
    frame: FloatArray
    group: int = 0
    plane: str = ""
    offset: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Shape:
    """What is fixed while codes are fitted.

    Attributes
    ----------
    scales
        s of rows and of columns [sensor pixels / scene pixel].
    terms
        number of codes a side.
    smoothness
        lambda of the codes' second differences, over the mean of the normal matrix' diagonal.
    centre
        whether frames lose row and column means.
    """

    scales: tuple[float, float]
    terms: int = 1
    smoothness: float = 1e-2
    centre: bool = False


# ---- One side ----


@dataclass(frozen=True, eq=False)
class _Side:
    """One side's geometry: ``sensor`` pixels, ``scene`` pixels, ``scale``, and largest ``offset``."""

    sensor: int
    scene: int
    scale: float
    offset: float
    terms: int
    centre: bool

    @property
    def width(self) -> int:
        """Of the window of the code that one sensor pixel sees."""
        return int(np.floor(self.offset + self.scale * (self.scene - 1))) + 2

    @property
    def length(self) -> int:
        """Of the code."""
        return self.sensor + self.width - 1

    @cached_property
    def weights(self) -> FloatArray:
        """(terms, n) b_k, of mean square 1."""
        place = np.linspace(-1, 1, self.scene) if self.scene > 1 else np.zeros(1)
        return np.stack([np.polynomial.legendre.Legendre.basis(k)(place) * np.sqrt(2 * k + 1) for k in range(self.terms)])

    def hats(self, offset: float) -> FloatArray:
        """(n, width) what each scene pixel takes of its window, by linear interpolation."""
        place = offset + self.scale * np.arange(self.scene)
        first = np.floor(place).astype(int)
        found = np.zeros((self.scene, self.width))
        rows = np.arange(self.scene)
        found[rows, first] = 1 - (place - first)
        found[rows, first + 1] += place - first
        return found

    def factor(self, codes: FloatArray, offset: float) -> FloatArray:
        """Phi (m, n) of ``codes`` (terms, length)."""
        hats, phi = self.hats(offset), np.zeros((self.sensor, self.scene))
        for code, weight in zip(codes, self.weights, strict=True):
            phi += (sliding_window_view(code, self.width) @ hats.T) * weight
        return centre_columns(phi) if self.centre else phi

    def normal(self, offset: float, gram: FloatArray, product: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Normal matrix (terms length, terms length) and right-hand side of the codes.

        Parameters
        ----------
        offset
            of the frames.
        gram, product
            (n, n) sum of Z Z^T, and (m, n) sum of Y Z^T, both over the noise's variance.
        """
        hats, w, k = self.hats(offset), self.width, self.terms
        spread = (self.weights[:, :, None] * hats[None]).transpose(1, 0, 2).reshape(self.scene, k * w)
        block = (spread.T @ gram @ spread).reshape(k, w, k, w)
        side = (product @ spread).reshape(self.sensor, k, w)
        matrix, right = np.zeros((k, self.length, k, self.length)), np.zeros((k, self.length))
        total = np.zeros((self.scene, k, self.length))
        for row in range(self.sensor):
            window = slice(row, row + w)
            matrix[:, window, :, window] += block
            right[:, window] += side[row]
            total[:, :, window] += spread.reshape(self.scene, k, w)
        flat = matrix.reshape(k * self.length, -1)
        if self.centre:
            every = total.reshape(self.scene, -1)
            flat -= every.T @ (gram @ every) / self.sensor
        return flat, right.ravel()

    @cached_property
    def curvature(self) -> FloatArray:
        """(terms length, terms length) sum of the squared second differences of the codes."""
        second = np.diff(np.eye(self.length), 2, axis=0)
        return np.kron(np.eye(self.terms), second.T @ second)


# ---- Both sides ----


@dataclass(frozen=True, eq=False)
class Codes:
    """Codes that were fitted.

    Attributes
    ----------
    shape
        what was fixed.
    left, right
        (terms, length) codes of rows and of columns.
    gains
        of each plane.
    variances
        (exposures,) mean square of what is left of each frame.
    explained
        part of all frames' energy that the fit explains, each frame in units of its noise.
    errors
        standard deviation of a number of the left and of the right factor, rms; gains 1.
    told
        numbers of each side's codes that the frames tell, of all: trace of N (N + lambda E)^-1.
    """

    shape: Shape
    left: FloatArray
    right: FloatArray
    gains: dict[str, float]
    variances: FloatArray
    explained: float
    errors: tuple[float, float] = (0.0, 0.0)
    told: tuple[float, float] = (0.0, 0.0)
    size: tuple[int, int, int, int] = (0, 0, 0, 0)
    offsets: tuple[float, float] = (0.0, 0.0)

    @property
    def sides(self) -> tuple[_Side, _Side]:
        """Geometry of both."""
        return _sides(self.shape, self.size, self.offsets)

    def factors(self, offset: tuple[float, float], plane: str = "") -> tuple[FloatArray, FloatArray]:
        """Phi_L (m, n) and Phi_R (m', n') of a ``plane`` whose pixels are at ``offset``."""
        root = np.sqrt(abs(self.gains[plane]))
        signs = np.sign(self.gains[plane]), 1.0
        left, right = (
            side.factor(codes, place) * root * sign
            for side, codes, place, sign in zip(self.sides, (self.left, self.right), offset, signs, strict=True)
        )
        return left, right


def _sides(shape: Shape, size: tuple[int, int, int, int], offsets: tuple[float, float]) -> tuple[_Side, _Side]:
    left, right = (
        _Side(sensor, scene, scale, offset, shape.terms, shape.centre)
        for sensor, scene, scale, offset in zip(size[:2], size[2:], shape.scales, offsets, strict=True)
    )
    return left, right


_TURNS, _STILL = 12, 1e-4
"""Times that the sides take turns at most, and gain of the explained part at which they have ended."""


@single_threaded_blas()
def fit_codes(exposures: Sequence[Exposure], shape: Shape, start: FloatArray | None = None, turns: int = _TURNS) -> Codes:
    """Codes of both sides.

    Parameters
    ----------
    exposures
        scenes turned as the code runs, frames centred where the ``shape`` says so.
    shape
        what is fixed.
    start
        (length,) code of columns to begin with, in pixels of the sensor; None: that of the spectra.
    turns
        that sides take at most.
    """
    size = (*exposures[0].frame.shape, *exposures[0].scene.shape)
    offsets = max(each.offset[0] for each in exposures), max(each.offset[1] for each in exposures)
    sides = _sides(shape, size, offsets)
    codes = [np.zeros((shape.terms, side.length)) for side in sides]
    first = spectral_start(exposures, shape.scales)[1] if start is None else start
    codes[1][0] = np.interp(np.arange(sides[1].length), np.arange(len(first)), first)
    gains = dict.fromkeys((each.plane for each in exposures), 1.0)
    energies = np.array([np.mean(np.square(each.frame)) for each in exposures])
    if not (energies > 0).all():
        raise MitsimError(f"frame {int(np.argmin(energies))} of the known pictures is zero everywhere")
    variances, explained, before = energies.copy(), 0.0, -1.0
    inverses: list[tuple[FloatArray, FloatArray]] = []
    for _ in range(turns):
        inverses = []
        for axis in (0, 1):
            codes[axis], inverse = _solve_side(exposures, sides, axis, codes[1 - axis], gains, variances, shape)
            inverses.append(inverse)
        gains, variances = _levels(exposures, sides, codes, gains)
        explained = 1 - float(np.mean(variances / energies))
        if explained - before < _STILL:
            break
        before = explained
    balance = np.sqrt(np.linalg.norm(codes[1]) / np.linalg.norm(codes[0]))
    codes = [codes[0] * balance, codes[1] / balance]
    spread = [_spread(side, inverse[0]) for side, inverse in zip(sides, inverses, strict=True)]
    return Codes(
        shape,
        codes[0],
        codes[1],
        gains,
        variances,
        explained,
        (spread[0] * balance, spread[1] / balance),
        (float(inverses[0][1]), float(inverses[1][1])),
        size,
        offsets,
    )


def _solve_side(
    exposures: Sequence[Exposure],
    sides: tuple[_Side, _Side],
    axis: int,
    other: FloatArray,
    gains: dict[str, float],
    variances: FloatArray,
    shape: Shape,
) -> tuple[FloatArray, tuple[FloatArray, float]]:
    """Codes of the side ``axis`` given the ``other``'s; their covariance, and how many of their numbers frames tell."""
    own, across = sides[axis], sides[1 - axis]
    phis = {place: across.factor(other, place) for place in {each.offset[1 - axis] for each in exposures}}
    sums: dict[float, tuple[FloatArray, FloatArray]] = {}
    for each, variance in zip(exposures, variances, strict=True):
        scene, frame = (each.scene, each.frame) if axis == 0 else (each.scene.T, each.frame.T)
        light = gains[each.plane] * (scene @ phis[each.offset[1 - axis]].T)
        gram, product = light @ light.T / variance, frame @ light.T / variance
        one = sums.get(each.offset[axis])
        sums[each.offset[axis]] = (gram, product) if one is None else (one[0] + gram, one[1] + product)
    matrix, right = (sum(parts) for parts in zip(*(own.normal(place, *one) for place, one in sums.items()), strict=True))
    scale = float(np.trace(matrix)) / len(matrix)
    if not scale > 0:
        raise MitsimError("known pictures: are black, or even where frames are centred, and tell nothing of the camera")
    penalised = matrix + scale * (shape.smoothness * own.curvature + _RIDGE * np.eye(len(matrix)))
    factored = cho_factor(penalised)
    inverse = cho_solve(factored, np.eye(len(matrix)))
    return cho_solve(factored, right).reshape(shape.terms, -1), (inverse, float(np.sum(inverse * matrix)))


_RIDGE = 1e-7
"""Of the normal matrix' mean diagonal: what no frame tells is zero, and the matrix is regular in double precision."""


def _levels(
    exposures: Sequence[Exposure], sides: tuple[_Side, _Side], codes: list[FloatArray], gains: dict[str, float]
) -> tuple[dict[str, float], FloatArray]:
    """Gains of the planes, by least squares, and mean squares of what is left of each frame."""
    phis = [
        {place: side.factor(code, place) for place in {each.offset[axis] for each in exposures}}
        for axis, (side, code) in enumerate(zip(sides, codes, strict=True))
    ]
    models = [phis[0][each.offset[0]] @ each.scene @ phis[1][each.offset[1]].T for each in exposures]
    above, below = dict.fromkeys(gains, 0.0), dict.fromkeys(gains, 0.0)
    for each, model in zip(exposures, models, strict=True):
        above[each.plane] += float(np.vdot(model, each.frame))
        below[each.plane] += float(np.vdot(model, model))
    gains = {name: above[name] / below[name] for name in gains}
    left = [np.mean(np.square(each.frame - gains[each.plane] * model)) for each, model in zip(exposures, models, strict=True)]
    return gains, np.asarray(left)


def _spread(side: _Side, covariance: FloatArray) -> float:
    """Standard deviation of a number of the factor, rms, by the ``covariance`` of the codes."""
    hats = side.hats(0.0)
    k, w = side.terms, side.width
    spread = (side.weights[:, :, None] * hats[None]).transpose(1, 0, 2)  # (n, terms, w)
    block = np.zeros((k, w, k, w))
    whole = covariance.reshape(k, side.length, k, side.length)
    for row in range(side.sensor):
        block += whole[:, row : row + w, :, row : row + w]
    total = float(np.einsum("iaw,awbv,ibv->", spread, block, spread, optimize=True))
    return float(np.sqrt(max(total, 0.0) / (side.sensor * side.scene)))


# ---- The start: orientation, scale and codes by spectra ----

_FREQUENCIES = 64
"""Of either sign, lowest first, whose spectra are compared."""


def _waves(count: int, step: float, scale: float) -> FloatArray:
    """(frequencies, count) exp(-2 pi i f x) at places ``scale`` x."""
    frequencies = np.concatenate([np.arange(1, _FREQUENCIES + 1), -np.arange(1, _FREQUENCIES + 1)]) * step
    return np.exp(-2j * np.pi * np.multiply.outer(frequencies, scale * np.arange(count)))


def spectral_start(
    exposures: Sequence[Exposure], scales: tuple[float, float]
) -> tuple[float, FloatArray]:
    """How nearly a product of two vectors the frames' spectra over the scenes' are, 0 to 1, and the code of columns
    that follows (length,).

    Parameters
    ----------
    exposures
        scenes turned as they may lie, frames centred.
    scales
        that may be right [sensor pixels / scene pixel].
    """
    (rows, columns), scene = exposures[0].frame.shape, exposures[0].scene.shape
    lengths = [sensor + scale * count for sensor, scale, count in zip((rows, columns), scales, scene, strict=True)]
    above = below = 0.0
    for each in exposures:
        seen = _waves(rows, 1 / lengths[0], 1.0) @ each.frame @ _waves(columns, 1 / lengths[1], 1.0).T
        lit = (
            np.conj(_waves(scene[0], 1 / lengths[0], scales[0]))
            @ each.scene
            @ np.conj(_waves(scene[1], 1 / lengths[1], scales[1])).T
        )
        above, below = above + seen * np.conj(lit), below + np.square(np.abs(lit))
    ratio = above / np.sqrt(below**2 + below.mean() * below) 
    _, values, right = np.linalg.svd(ratio)
    code = right[0] @ np.conj(_waves(int(np.ceil(lengths[1])) + 2, 1 / lengths[1], 1.0))
    return float(values[0] ** 2 / np.sum(np.square(values))), np.real(code)
