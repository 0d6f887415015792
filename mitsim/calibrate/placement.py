"""Responses to striped light and a camera's model in; where its mask and projector are, with standard errors, out.

Model frames are sums of few products u v^T, so are their changes with every number that is fitted: a response is
replaced by its coefficients in the few directions of sensor rows and columns that these span (which is all that the fit
can use of it, and leaves white noise white), and the sum of squares over all coefficients is made least by
:func:`scipy.optimize.least_squares`, with variables in units of a step each, and bounded, as these directions hold for
small steps only. They are taken anew where the fit has ended, until it stays. The covariance of what is fitted is (J^T
J)^-1 for data in units of their noise, times chi-square a datum where that is above 1.

A mask that is off by more than half a feature looks like another one: the shift is first looked for over some features.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import single_threaded_blas
from mitsim.optics.camera_model import ModelledCamera, Placement
from mitsim.optics.shadow import SeparableTerms

STEPS = {
    "mask_distance": 2e-3,
    "mask_shift_row": 5e-4,
    "mask_shift_column": 5e-4,
    "mask_rotation": 1e-4,
    "magnification": 1e-4,
    "projector_row": 2.5e-4,
    "projector_column": 2.5e-4,
}
"""Of each number, in its unit: half a micrometre on the mask or less, where shadows are averaged over ten."""
GAIN_STEP = 0.01
"""That of the gain, as a part of it: the model is linear in it."""
_ALIKE = 0.9999
"""Correlation of two numbers from which they count as one: each is told 70 times worse than if the other were known."""
_FEATURES = 5
"""Of the mask that it may be off by, along either axis: 0.3 mm of a mask of 60 um, more than a holder is off."""
_REACH = 10.0
"""Steps of each number within which directions hold what a response would become: half a pixel on the mask, or less."""
_PASSES, _STILL = 20, 0.05
"""Times that directions are taken at most, and standard errors that the fit may still move by at the end."""


@dataclass(frozen=True, eq=False)
class Shown:
    """A response and what was shown.

    Attributes
    ----------
    rows, columns
        (n,) weights: the pattern is their product.
    rate
        (m, m') response [electrons / s], centred where the camera's factors are.
    noise
        standard deviation of a number of it.
    """

    rows: FloatArray
    columns: FloatArray
    rate: FloatArray
    noise: float


@dataclass(frozen=True, eq=False)
class Fitted:
    """A camera as responses show it.

    Attributes
    ----------
    placement
        that explains them best.
    free
        names of what was fitted, and the rest held.
    covariance
        (free, free) of these numbers.
    chi_square
        a datum, of what the fit uses of the responses: 1 for a right model.
    unexplained
        part of the responses, rms, that neither model nor stated noise explain.
    """

    placement: Placement
    free: tuple[str, ...]
    covariance: FloatArray
    chi_square: float
    unexplained: float

    @property
    def errors(self) -> dict[str, float]:
        """Standard error of each number that was fitted."""
        return dict(zip(self.free, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


@single_threaded_blas()
def fit_placement(camera: ModelledCamera, shown: Sequence[Shown], free: Sequence[str]) -> Fitted:
    """Where mask and projector are.

    Parameters
    ----------
    camera
        as it was to be built, from which the search starts.
    shown
        responses; the first one to uniform light.
    free
        names of what is fitted, ``gain`` among them; the rest is held.

    Raises
    ------
    MitsimError
        for numbers that these responses cannot tell apart, and a mask that is off too far to be found.
    """
    at = _first_guess(camera, shown[0], free)
    for _ in range(_PASSES):
        pass_ = _Pass.of(camera, shown, free, at)
        bounds = -_REACH, _REACH
        done = least_squares(pass_.residual, np.zeros(len(free)), pass_.jacobian, bounds, xtol=1e-6, ftol=1e-10)
        jacobian = pass_.jacobian(done.x)
        inverse = _inverse(jacobian, free)
        at = pass_.placement(done.x)
        if np.all(np.abs(done.x) <= _STILL * np.sqrt(np.diag(inverse))):
            break
    chi_square = 2 * float(done.cost) / (len(done.fun) - len(free))
    scale = np.array([*pass_.steps.values()])
    covariance = max(chi_square, 1.0) * inverse * scale[:, None] * scale
    return Fitted(at, tuple(free), covariance, chi_square, _unexplained_part(pass_.terms(at), shown))


@dataclass(frozen=True, eq=False)
class _Pass:
    """One least-squares problem: coefficients of responses, in directions that are right near ``start``."""

    camera: ModelledCamera
    start: Placement
    steps: dict[str, float]
    turned: SeparableTerms
    shown: Sequence[Shown]
    directions: list[tuple[FloatArray, FloatArray]]
    data: FloatArray

    @classmethod
    def of(cls, camera: ModelledCamera, shown: Sequence[Shown], free: Sequence[str], start: Placement) -> _Pass:
        """The problem near ``start``; other parameters as for :func:`fit_placement`."""
        steps = {name: STEPS.get(name, GAIN_STEP * start.gain) for name in free}
        turned = camera.turned(start) if "mask_rotation" in free else []
        empty = cls(camera, start, steps, turned, shown, [], np.zeros(0))
        far = [(name, sign * _REACH * step) for name, step in steps.items() if name != "gain" for sign in (-1, 1)]
        near = [start, *(start.moved({name: step}) for name, step in far)]
        # A rotation of 0 would leave out its directions.
        spanning = [*turned, *(term for place in near for term in empty.terms(place)[:1])]
        directions, data = [], []
        for each in shown:
            lefts, rights = (np.stack(vectors, axis=1) for vectors in zip(*_vectors_of(spanning, each), strict=True))
            across, along = np.linalg.qr(lefts)[0], np.linalg.qr(rights)[0]
            directions.append((across, along))
            data.append((across.T @ each.rate @ along / each.noise).ravel())
        return cls(camera, start, steps, turned, shown, directions, np.concatenate(data))

    def placement(self, x: FloatArray) -> Placement:
        """That of variables ``x``, in steps from the start."""
        return self.start.moved(
            {name: step * float(value) for (name, step), value in zip(self.steps.items(), x, strict=True)}
        )

    def terms(self, placement: Placement) -> SeparableTerms:
        """The model's operator, from projector pixels to sensor pixels."""
        angle = placement.mask_rotation
        return [self.camera.factors(placement), *((angle * left, right) for left, right in self.turned)]

    def residual(self, x: FloatArray) -> FloatArray:
        """Model less data, in units of the noise."""
        terms, model = self.terms(self.placement(x)), []
        for each, (across, along) in zip(self.shown, self.directions, strict=True):
            frame = sum(np.multiply.outer(across.T @ left, along.T @ right) for left, right in _vectors_of(terms, each))
            model.append(np.ravel(frame) / each.noise)
        return np.asarray(np.concatenate(model) - self.data)

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Its derivatives, over one step each."""
        here = self.residual(x)
        return np.stack([self.residual(x + one) - here for one in np.eye(len(x))], axis=1)


def _vectors_of(terms: SeparableTerms, shown: Shown) -> Iterable[tuple[FloatArray, FloatArray]]:
    """u (pixels,) and v (pixels,) of the frame of each term under what was shown."""
    return [(left @ shown.rows, right @ shown.columns) for left, right in terms]


def _inverse(jacobian: FloatArray, free: Sequence[str]) -> FloatArray:
    """(J^T J)^-1; MitsimError where two numbers act alike."""
    lengths = np.linalg.norm(jacobian, axis=0)
    if not lengths.all():
        raise MitsimError(
            f"{free[int(np.argmin(lengths))]}: changes nothing in these responses; leave it out of the fit"
        )
    inverse = np.linalg.pinv(jacobian / lengths, rcond=1e-12)
    covariance = inverse @ inverse.T
    spread = np.sqrt(np.diag(covariance))
    alike = np.abs(covariance / np.outer(spread, spread)) - np.eye(len(free))
    first, second = map(int, np.unravel_index(int(np.argmax(alike)), alike.shape))
    if alike[first, second] > _ALIKE:
        raise MitsimError(
            f"{free[first]} and {free[second]} cannot be told apart by these responses (correlation "
            f"{alike[first, second]:.5f}); leave one of them out of the fit"
        )
    return np.asarray(covariance / np.outer(lengths, lengths))


def _first_guess(camera: ModelledCamera, uniform: Shown, free: Sequence[str]) -> Placement:
    """The built placement, its mask moved to where the response to ``uniform`` light is most like the model's, with
    the gain that fits."""
    shifts = np.zeros(1)
    if {"mask_shift_row", "mask_shift_column"} & {*free}:
        shifts = camera.geometry.mask_feature * np.arange(-_FEATURES, _FEATURES + 0.125, 0.25)
    geometric = replace(camera, spectrum=None)  # a shadow's fringes move with it
    lefts, rights = [], []
    for shift in shifts:
        (pair,) = _vectors_of([geometric.factors(camera.built.moved(dict.fromkeys(_SHIFTS, float(shift))))], uniform)
        lefts.append(pair[0])
        rights.append(pair[1])
    products = np.stack(lefts) @ uniform.rate @ np.stack(rights).T
    norms = np.multiply.outer(np.linalg.norm(lefts, axis=1), np.linalg.norm(rights, axis=1))
    row, column = np.unravel_index(int(np.argmax(products / norms)), products.shape)
    for name, index in zip(_SHIFTS, (row, column), strict=True):
        if name in free and len(shifts) > 1 and index in (0, len(shifts) - 1):
            raise MitsimError(
                f"{name}: the mask is off by {abs(shifts[-1]):g} mm or more; state mask_offset_row and "
                "mask_offset_column in the scene, within some features"
            )
    gain = float(products[row, column] / norms[row, column] ** 2)
    if not gain > 0:
        raise MitsimError("the response to uniform light has nothing of the camera's shadow; check mask and geometry")
    moves = {name: float(shifts[index]) for name, index in zip(_SHIFTS, (row, column), strict=True) if name in free}
    return camera.built.moved({**moves, "gain": gain - camera.built.gain})


_SHIFTS = ("mask_shift_row", "mask_shift_column")
"""That are looked for before the fit."""


def _unexplained_part(terms: SeparableTerms, shown: Sequence[Shown]) -> float:
    """Part of the responses, rms, that ``terms`` and the stated noise leave."""
    left = energy = 0.0
    for each in shown:
        frame = sum(np.multiply.outer(*pair) for pair in _vectors_of(terms, each))
        left += float(np.square(each.rate - frame).sum()) - each.rate.size * each.noise**2
        energy += float(np.square(each.rate).sum())
    return float(np.sqrt(max(left, 0.0) / energy))
