"""Light of a session's frames in, in the order in which they were taken; the lamp's power in each, and vectors divided by
it, out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mitsim.core.arrays import FloatArray
from mitsim.reconstruct.calibration import FLUX_NOISE
from mitsim.reconstruct.session_findings import Lamp
from mitsim.reconstruct.session_side import SideCheck
from mitsim.rig.order import Half

MATTERS = 0.5
"""Error by the lamp, over that by noise, from which it is corrected and said: both in quadrature are 12 % more."""
STEADY = 8.0
"""Deviations of the trend's two ends from each other that are a drift: noise alone goes so far in no session."""
_FLICKERS = 2.0
"""Robust scatter of the frames' power over that by noise, which is known to 20 %, that is flicker; of few frames, whose
scatter itself is known to 1.2 of it over the root of their number, more."""
_UNEVEN = 0.02
"""Light of a board's lines, rms, as a part of it, that may differ from line to line: as flicker, that over the root of
their number, and no more is said to be one."""
_DEGREE = 5, 8
"""Of the polynomial that the light of scene lines is of, at most: falloff, obliquity and the mask's ends, of sensors
of 120 to 260 pixels 3 to 12 leave no more than noise; and scene lines for each of its numbers, at least."""
_TURNS = 8
"""Times that a trend is fitted again without what is far from it: a fourth changes nothing in most sessions."""


def flickers(scatter: float, noise: float, count: int) -> bool:
    """Whether the robust ``scatter`` of so many powers is more than their ``noise`` makes."""
    return scatter > _FLICKERS * (1 + 3 / np.sqrt(count)) * noise


def trend_of(times: FloatArray, power: FloatArray, wanted: FloatArray) -> tuple[FloatArray, float, float]:
    """A smooth power at the ``wanted`` times, the robust scatter of the ``power`` (frames,) at the ``times`` round it,
    and the deviation of its two ends.

    A parabola, fitted again without what is far from it.
    """
    away = np.abs(power - np.median(power))
    kept = away <= max(6 * float(np.median(away)), 1e-12)
    degree = min(2, max(len(np.unique(times)) - 2, 0))
    found, scatter = np.array([float(np.median(power))]), 0.0
    for _ in range(_TURNS):
        if kept.sum() <= degree + 1:
            break
        found = np.polyfit(times[kept], power[kept], degree)
        away = np.abs(power - np.polyval(found, times))
        scatter = 1.4826 * float(np.median(away))
        again = away <= max(4 * scatter, 1e-12)
        if (again == kept).all():
            break
        kept = again
    return np.polyval(found, wanted), scatter, 3 * scatter / float(np.sqrt(max(kept.sum(), 1)))


def end_to_end(times: FloatArray, trend: FloatArray) -> float:
    """What a ``trend`` (frames,) changes by from the first to the last of the ``times``."""
    first, last = int(np.argmin(times)), int(np.argmax(times))
    return float(trend[last] - trend[first])


class _Frames:
    """One side's frames that are shown against a uniform one.

    Their mean light is that of their scene lines, which is a smooth function of the line; and a frame of power p_i
    against a uniform one of p_0 has p_i (u_i + u_0) - p_0 u_0 for its vector. Least squares in a polynomial of the
    line and one of time give 1 - p_0 / p_i, the ``trend`` of it and each frame's own.
    """

    def __init__(self, own: SideCheck, places: FloatArray, step: float) -> None:
        """Of frames at ``places`` (N,) in time; ``step`` between two numbers of a frame."""
        n, count = own.signs.shape
        flux = own.sums.fluxes
        self.own, self.places, self.shown = own, places, flux + flux[0]
        unit = float(np.median(np.abs(self.shown))) or 1.0
        degree = max(min(_DEGREE[0], n // _DEGREE[1] - 1), 0)
        lines = own.signs.T @ np.polynomial.legendre.legvander(np.linspace(-1, 1, n), degree) * (unit / n)
        powers = np.vander(places - places.mean(), 3) * self.shown[:, None]
        both = np.hstack([lines, powers])
        known = np.isin(np.arange(count), list(own.unknown))
        kept = ~known
        for _ in range(_TURNS):
            inverse = np.linalg.pinv(both[kept])
            found = inverse @ flux[kept]
            away = np.abs(flux - both @ found)
            scatter = 1.4826 * float(np.median(away[~known])) * float(np.sqrt(count / (count - both.shape[1])))
            again = ~known & (away <= max(6 * scatter, 1e-12 * unit))
            if (again == kept).all():
                break
            kept = again
        self.trend = powers @ found[degree + 1 :] / self.shown
        each = (flux - lines @ found[: degree + 1]) / self.shown
        self.each = np.where(kept, each, self.trend)
        self.uniform = float(lines[0] @ found[: degree + 1])
        # A response has twice a frame's numbers, whose rounding no noise may make random.
        noise = FLUX_NOISE * np.sqrt(own.variance / own.length / len(own.sums.common))
        self.noise, self.scatter = float(np.hypot(noise, step if own.variance < step**2 else 0.0)) / unit, scatter / unit
        ends = powers[np.argmax(places)] / self.shown[np.argmax(places)] - powers[np.argmin(places)] / self.shown[np.argmin(places)]
        self.steady = scatter * float(np.linalg.norm(ends @ inverse[degree + 1 :]))
        flicker = np.sqrt(max(self.scatter**2 - self.noise**2, 0.0))
        enough = flickers(self.scatter, self.noise, count) and flicker * np.sqrt(n) > _UNEVEN
        self.flicker = float(flicker) if enough else 0.0
        self.unknown = np.square(np.linalg.norm(lines @ inverse[: degree + 1], axis=1))

    @property
    def light(self) -> FloatArray:
        """(N,) squared length of what each frame shows."""
        return np.asarray(np.square(self.own.vectors + self.own.vectors[:, :1]).sum(axis=0))

    def divide(self, shares: FloatArray, scale: float) -> None:
        """Divide frames by their power, of which they have ``shares`` (N,) 1 - p_0 / p_i, and all by a ``scale``; what
        flicker leaves counts as their error."""
        uniform = self.own.vectors[:, :1]
        self.own.vectors = ((self.own.vectors + uniform) * (1 - shares) - uniform) / scale
        self.own.extras += (self.flicker**2 * self.unknown + self.noise**2) * self.light


def lamp_of_frames(sides: Sequence[SideCheck], order: Sequence[Half], step: float) -> Lamp:
    """How steady the lamp is where frames are shown against a uniform one; vectors are divided by its power where that
    matters.

    Parameters
    ----------
    sides
        both, their vectors as they came in.
    order
        frames as they were taken.
    step
        between two numbers of a frame, as the responses have it.
    """
    places = {half: place / max(len(order) - 1, 1) for place, half in enumerate(order)}
    found = [
        _Frames(own, np.array([places[own.side, index, 1] for index in range(own.sums.done)]), step) for own in sides
    ]
    squares = [float(np.square(own.vectors).sum()) for own in sides]
    moved, shaken, noise = (
        float(np.sqrt(np.sum(part)))
        for part in zip(
            *(
                (
                    float(np.square(each.trend) @ each.light) / size,
                    each.flicker**2 * float(each.light.sum() + len(each.light) * each.light[0] / 4) / size,
                    each.own.noise * len(each.light) / size,
                )
                for each, size in zip(found, squares, strict=True)
            ),
            strict=True,
        )
    )
    drifts = moved > MATTERS * noise and any(
        abs(end_to_end(each.places, each.trend)) > STEADY * each.steady for each in found
    )
    shaking = shaken > MATTERS * noise
    if not drifts and not shaking:
        return Lamp()
    # Of each uniform frame, and of all frames, in that of the responses that the factors' scale is taken from.
    first = float(np.mean([each.own.sums.fluxes[0] for each in found]))
    uniforms = [each.uniform / first for each in found]
    shares = [each.each if each.flicker and shaking else each.trend for each in found]
    powers = [power / (1 - share) for power, share in zip(uniforms, shares, strict=True)]
    mean = float(np.mean(powers))
    for each, power, share in zip(found, uniforms, shares, strict=True):
        each.divide(share, power / float(np.sqrt(mean)))
    trends = np.concatenate([power / (1 - each.trend) / mean for each, power in zip(found, uniforms, strict=True)])
    left = sum(
        float(each.own.extras.sum() / np.square(each.own.vectors).sum()) for each in found
    )
    return Lamp(
        drift=end_to_end(np.concatenate([each.places for each in found]), trends) if drifts else 0.0,
        flicker=float(np.sqrt(np.mean([each.flicker**2 for each in found]))) if shaking else 0.0,
        drift_cost=moved if drifts else 0.0,
        flicker_cost=shaken if shaking else 0.0,
        remaining=float(np.sqrt(left)),
        corrected=True,
    )
