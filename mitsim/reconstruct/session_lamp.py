"""Light of a session's frames in, as they were taken; the lamp's power in each, and vectors divided by it, out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt

from mitsim.core.arrays import FloatArray
from mitsim.devices.session import Half
from mitsim.reconstruct.estimate_factors import FLUX_NOISE
from mitsim.reconstruct.session_side import DARK, SLIGHT, SideCheck, robust_scatter

MATTERS = 0.5
"""Error by the lamp, over that by noise, from which it is corrected and said: both in quadrature are 12 % more."""
_STEADY = 8.0
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
_LINES = 32
"""Scene lines from which their light is smooth enough: that of 16 lines of a small sensor is of no such polynomial."""
_SMOOTH = 2.0
"""Scatter that a polynomial leaves, over that of one of two degrees more, up to which what is left is of frames, and
not of lines whose light is not smooth: of sides of good and faulty sessions it is 0.9 to 1.44 (240)."""
_TURNS = 8
"""Times that a trend is fitted again without what is far from it: a fourth changes nothing in most sessions."""


@dataclass(frozen=True)
class Lamp:
    """How the projector's power changes over the session.

    Attributes
    ----------
    drift
        from the session's begin to its end, as a part of its mean.
    flicker
        from frame to frame, rms, as a part of it.
    drift_cost, flicker_cost
        relative error of both factors that each would leave, or leaves, in them.
    remaining
        the error that is left after correction.
    corrected
        whether factors are corrected for it.
    """

    drift: float = 0.0
    flicker: float = 0.0
    drift_cost: float = 0.0
    flicker_cost: float = 0.0
    remaining: float = 0.0
    corrected: bool = False

    def for_manifest(self) -> dict[str, float] | None:
        """The same for a manifest; None of a steady one."""
        return asdict(self) if self.drift or self.flicker else None

    def warnings(self) -> Iterator[str]:
        """What is said of an unsteady lamp."""
        left = "frames are divided by its power" + (f", and {self.remaining:.1e} is left" if self.remaining else "")
        if self.drift:
            yield (
                f"lamp: its power drifts by {self.drift:+.1%} over the session, a factor error of "
                f"{self.drift_cost:.1e} if nothing is done; {left}: let it warm up"
            )
        if self.flicker:
            yield (
                f"lamp: its power flickers by {self.flicker:.2%} from frame to frame, a factor error of "
                f"{self.flicker_cost:.1e} if nothing is done; {left}: use a steadier one, or expose for whole periods"
            )


def flickers(scatter: float, noise: float, count: int) -> bool:
    """Whether the powers of frames are those of a lamp that flickers.

    Parameters
    ----------
    scatter, noise
        of the powers, robust, and what noise makes of it.
    count
        of the frames.
    """
    return scatter > _FLICKERS * (1 + 3 / float(np.sqrt(count))) * noise


def trend_of(times: FloatArray, power: FloatArray) -> tuple[FloatArray, float, float]:
    """A smooth power (frames,) over the times, the robust scatter round it, and the deviation of its two ends.

    A parabola, fitted again without what is far from it.

    Parameters
    ----------
    times
        (frames,).
    power
        (frames,) of the lamp.
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
        scatter = robust_scatter(away)
        again = away <= max(4 * scatter, 1e-12)
        if (again == kept).all():
            break
        kept = again
    return np.polyval(found, times), scatter, 3 * scatter / float(np.sqrt(max(kept.sum(), 1)))


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
        shown = flux + flux[0]
        unit = float(np.median(shown))
        shown = np.where(np.abs(shown) > DARK * np.abs(unit), shown, unit or 1.0)
        powers = np.vander(places - places.mean(), 3)
        # A pattern of coarse stripes is hardly predicted by the light of others, but by the shadow.
        far = own.far()

        def fit(degree: int) -> tuple[FloatArray, FloatArray, FloatArray, npt.NDArray[np.bool_], float]:
            """Lines' polynomials as patterns show them, least squares and their inverse, patterns that count, and the
            robust scatter."""
            lines = own.signs.T @ np.polynomial.legendre.legvander(np.linspace(-1, 1, n), degree) / shown[:, None]
            both, kept = np.hstack([lines, powers]), ~far
            for _ in range(_TURNS):
                inverse = np.linalg.pinv(both[kept])
                found = inverse @ (flux / shown)[kept]
                away = np.abs(flux / shown - both @ found)
                scatter = robust_scatter(away[~far]) * float(np.sqrt(count / (count - both.shape[1])))
                again = ~far & (away <= max(6 * scatter, 1e-12))
                if (again == kept).all():
                    break
                kept = again
            return lines, found, inverse, kept, scatter

        degree = min(_DEGREE[0], n // _DEGREE[1] - 1)
        lines, found, inverse, kept, scatter = fit(degree)
        self.smooth = scatter < _SMOOTH * fit(degree + 2)[-1]
        lines_found, powers_found = np.split(found, [degree + 1])
        lines_inverse, powers_inverse = np.split(inverse, [degree + 1])
        self.own, self.places = own, places
        self.trend = powers @ powers_found
        self.each = flux / shown - lines @ lines_found
        self.kept = kept
        # A response has twice a frame's numbers, whose rounding no noise may make random.
        noise = FLUX_NOISE * float(np.sqrt(own.variance / own.length / len(own.sums.common)))
        self.noise = float(np.hypot(noise, step if own.variance < step**2 else 0.0)) / abs(unit or 1.0)
        ends = powers[int(np.argmax(places))] - powers[int(np.argmin(places))]
        self.drifts = bool(abs(ends @ powers_found) > _STEADY * scatter * np.linalg.norm(ends @ powers_inverse))
        self.flicker = float(np.sqrt(max(scatter**2 - self.noise**2, 0.0)))
        if not flickers(scatter, self.noise, count) or self.flicker * np.sqrt(n) < _UNEVEN:
            self.flicker = 0.0
        self.unknown = np.square(lines @ lines_inverse).sum(axis=1)

    @property
    def light(self) -> FloatArray:
        """(N,) squared length of what each frame shows."""
        return np.asarray(np.square(self.own.vectors + self.own.vectors[:, :1]).sum(axis=0))

    def judge(self, shares: FloatArray) -> None:
        """Find the part of its light that each frame has beyond what ``shares`` say; that of one which is not named
        counts as its error."""
        beyond = np.where(self.kept, 0.0, (self.each - shares) / (1 - shares))
        self.own.parts = 1 / np.maximum(1 - beyond, DARK)
        self.own.errors = (self.flicker**2 + self.noise**2) * self.unknown * self.light
        self.own.extras += np.where(np.abs(self.own.parts - 1) < SLIGHT, np.square(beyond), 0.0) * self.light

    def divide(self, shares: FloatArray, scale: float, unscaled: float) -> None:
        """Divide frames by their power, of which they have ``shares`` (N,) 1 - p_0 / p_i, and all by a ``scale``; what
        flicker leaves counts as their error, and that of the scale, of a variance ``unscaled``."""
        uniform = self.own.vectors[:, :1]
        self.own.vectors = ((self.own.vectors + uniform) * (1 - shares) - uniform) / scale
        self.own.extras += (self.flicker**2 * self.unknown + self.noise**2) * self.light
        self.own.extras += unscaled * np.square(self.own.vectors).sum(axis=0)
        self.own.shaken = self.flicker


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
    if len(sides[0].signs) < _LINES:
        return Lamp()
    places = {half: place / max(len(order) - 1, 1) for place, half in enumerate(order)}
    found = [
        _Frames(own, np.array([places[own.side, index, 1] for index in range(own.sums.done)]), step) for own in sides
    ]
    if not all(each.smooth for each in found):
        return Lamp()
    costs = []
    for each in found:
        # The uniform frame's own power is in every response.
        shaken = each.flicker**2 * float(each.light.sum() + len(each.light) * each.light[0] / 4)
        parts = float(np.square(each.trend) @ each.light), shaken, each.own.noise * len(each.light)
        costs.append(np.array(parts) / float(np.square(each.own.vectors).sum()))
    moved, shaken, noise = (float(part) for part in np.sqrt(np.sum(costs, axis=0)))
    drifts = moved > MATTERS * noise and any(each.drifts for each in found)
    shakes = shaken > MATTERS * noise
    if not drifts and not shakes:
        for each in found:
            each.judge(np.zeros(len(each.places)))
        return Lamp()
    if drifts:  # the uniform frames' powers are those of the responses to the uniform pattern, taken with them
        uniforms = [float(each.own.sums.fluxes[0]) for each in found]
    else:
        uniforms = [1 - float(each.trend.mean()) for each in found]
    mean = float(np.mean([power / (1 - each.trend) for each, power in zip(found, uniforms, strict=True)]))
    uniforms = [power / mean for power in uniforms]
    trends = np.concatenate([power / (1 - each.trend) for each, power in zip(found, uniforms, strict=True)])
    common = float(np.mean(uniforms)) if drifts else 1.0
    flicker = float(np.sqrt(np.mean([each.flicker**2 for each in found]))) if shakes else 0.0
    for each, power in zip(found, uniforms, strict=True):
        # Of both, the latter are of a frame's own power, twice, less the uniform one's.
        shares = np.where(each.kept, each.each, each.trend) if shakes else each.trend
        each.divide(shares, power / np.sqrt(common), (5 if drifts else 1) * flicker**2)
        each.judge(shares)
    left = sum(float(each.own.extras.sum() / np.square(each.own.vectors).sum()) for each in found)
    times = np.concatenate([each.places for each in found])
    drift, moved = (end_to_end(times, trends), moved) if drifts else (0.0, 0.0)
    return Lamp(drift, flicker, moved, shaken if shakes else 0.0, float(np.sqrt(left)), corrected=True)
