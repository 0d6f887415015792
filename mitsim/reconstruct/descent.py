"""Iterations that lower squared misfit with a prior within bounds, for a camera known by its products alone.

Minimised over all X within bounds is 1/2 ||A X - Y||^2 + weight TV(X) + ridge / 2 ||X||^2, with images or volumes X.

Passes of a few steps of conjugate gradients in the pixels that bounds leave free are each followed by a
projection on the bounds (Moré and Toraldo, SIAM J. Optim. 1, 1991). Because |H|^2 spans seven decades, steps are
preconditioned by a division by |H|^2 + mu and start from the image at half the size. TV is quadratic for small slopes,
and in each pass replaced by the quadratic that touches it. The iterations end where the last half of all steps has
lowered the objective by at most ``tolerance`` of itself (Strakos and Tichy, ETNA 13, 2002).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from mitsim.core.images import reduce_frame
from mitsim.reconstruct.solvers import Prior, lengths, slopes_adjoint, slopes_of

Array = npt.NDArray[Any]

_COARSE_STEPS = 60
_SMOOTH = 1e-3
_FIRST_SMOOTH, _SHARPENED = 10.0, 0.3
"""Smoothing slope of the first pass, and its ratio between passes; large weights otherwise need five times the steps.
"""
_PASS, _PASS_UNBOUND = 6, 12
_NOTHING = 1e-300
_FEWEST = 1e-12


class Camera(Protocol):
    """Operator A from scenes to frames, and its adjoint ``correlate``."""

    precision: Any

    @property
    def scene(self) -> tuple[int, ...]: ...

    def image_of(self, scene: Array) -> Array: ...

    def correlate(self, frames: Array) -> Array: ...

    def preconditioner(self, ridge: float, slope_weight: float) -> Callable[[Array], Array]: ...

    def half_size(self) -> Any:
        """Return the camera at half the size, whose image ``double`` turns into one of this camera, or None."""


# ---- The objective at one image --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _State:
    light: Camera
    prior: Prior
    image: Array
    residual: Array
    smooth: float

    @cached_property
    def _slopes(self) -> Array:
        return lengths(slopes_of(self.image))

    @cached_property
    def objective(self) -> float:
        squares = _dot(self.residual, self.residual) + self.prior.ridge * _dot(self.image, self.image)
        if not self.prior.weight:
            return squares / 2
        return squares / 2 + self.prior.weight * float(self._slopes.sum(dtype=np.float64))

    @cached_property
    def smoothed(self) -> float:
        if not self.prior.weight:
            return self.objective
        low = np.minimum(self._slopes, self.smooth)
        flattened = float(low.sum(dtype=np.float64)) - _dot(low, low) / (2 * self.smooth)
        return self.objective - self.prior.weight * flattened

    @cached_property
    def gradient(self) -> Array:
        return self.light.correlate(self.residual) + self.bend(self.image)

    def bend(self, direction: Array) -> Array:
        bent = self.prior.ridge * direction
        if self.prior.weight:
            stiffness = self.prior.weight / np.maximum(self._slopes, self.smooth)
            bent += slopes_adjoint(slopes_of(direction) * stiffness)
        return bent

    @property
    def free(self) -> npt.NDArray[np.bool_]:
        low, high = self.prior.bounds
        free = np.ones(self.image.shape, dtype=bool)
        if math.isfinite(low):
            free &= (self.image > low) | (self.gradient < 0)
        if math.isfinite(high):
            free &= (self.image < high) | (self.gradient > 0)
        return free

    def move(self, direction: Array, seen: Array, length: float) -> _State:
        image = self.image + length * direction
        if not self.prior.bounded:
            return replace(self, image=image, residual=self.residual + length * seen)
        np.clip(image, *self.prior.bounds, out=image)
        return replace(self, image=image, residual=self.residual + self.light.image_of(image - self.image))

    @cached_property
    def divide(self) -> Callable[[Array], Array]:
        slope_weight = self.prior.weight / self.smooth if self.prior.weight else 0.0
        return self.light.preconditioner(self.prior.ridge, slope_weight)


def _dot(first: Array, second: Array) -> float:
    return float(np.vdot(first, second))


# ---- Minimising ------------------------------------------------------------------------------------------------------


class Minimum(NamedTuple):
    """Image (n, n') of the whole scene near the minimum; ``fall`` is the objective's in the last half of the steps."""

    image: Array
    iterations: int
    objective: float
    fall: float


def minimise(light: Camera, frames: Array, prior: Prior, iterations: int, tolerance: float) -> Minimum:
    """Return the image whose objective falls by at most ``tolerance`` of itself in the last half of the steps."""
    state, spent, fall = _descend(_start(light, frames, prior), iterations, tolerance)
    return Minimum(state.image, spent, state.objective, fall)


def _start(light: Any, frames: Array, prior: Prior) -> _State:
    low, high = prior.bounds
    smaller = light.half_size()
    if smaller:
        # Half as many pixels a side: TV of the same scene is a half, squares are a quarter.
        half = replace(prior, weight=prior.weight / 2)
        found = _descend(_start(smaller, reduce_frame(frames, 2), half), _COARSE_STEPS, 0.0)[0]
        image = light.double(found.image)
    else:
        image = np.zeros(light.scene, light.precision)
    image = np.clip(image, low, high)
    start = _State(light, prior, image, light.image_of(image) - frames, 0.0)
    if prior.weight and not smaller:
        # Least squares first: they tell how bright the scene is.
        unweighted = replace(start, prior=replace(prior, weight=0.0))
        found = _descend(unweighted, 2 * _PASS, 0.0)[0]
        start = replace(found, prior=prior)
    peak = float(np.abs(start.image).max())
    return replace(start, smooth=_SMOOTH * peak or _SMOOTH)


def _descend(state: _State, iterations: int, tolerance: float) -> tuple[_State, int, float]:
    sharp, most = state.smooth, _PASS if state.prior.bounded else _PASS_UNBOUND
    state = replace(state, smooth=_FIRST_SMOOTH * sharp)
    spent, fall, objectives = 0, math.inf, [(0, state.objective)]
    while spent < iterations and fall > tolerance:
        direction, seen, promised = _pass(state, min(most, iterations - spent))
        length, following = 1.0, state.move(direction, seen, 1.0)
        while following.smoothed > state.smoothed and length > _FEWEST:
            length /= 2
            following = state.move(direction, seen, length)
        still = promised <= 0 or length <= _FEWEST
        ended = still and state.smooth == sharp
        if not still:
            state, spent = following, min(spent + most, iterations)
            objectives.append((spent, state.objective))
        state = replace(state, smooth=max(_SHARPENED * state.smooth, sharp))
        if ended or (len(objectives) > 2 and state.smooth == sharp):
            earlier = next(objective for steps, objective in reversed(objectives) if 2 * steps <= spent)
            fall = max(earlier - state.objective, promised) / max(state.objective, _NOTHING)
        if ended:
            break
    return state, spent, fall


def _pass(state: _State, steps: int) -> tuple[Array, Array, float]:
    free = state.free
    left = np.where(free, state.gradient, 0)
    total, seen = np.zeros_like(left), np.zeros_like(state.residual)
    direction, power, promised = np.zeros_like(left), math.inf, 0.0
    for step in range(steps):
        turned = state.divide(left) * free
        before, power = power, _dot(left, turned)
        if power <= 0:
            break
        direction = (power / before) * direction - turned
        ahead, bent = state.light.image_of(direction), state.bend(direction)
        length = power / max(_dot(ahead, ahead) + _dot(direction, bent), _NOTHING)
        total += length * direction
        seen += length * ahead
        promised += length * power / 2
        if step < steps - 1:
            bent += state.light.correlate(ahead)
            bent *= free
            left += length * bent
    return total, seen, promised
