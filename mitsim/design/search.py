"""Search for the separable mask code with the least expected error: relaxation with gradients, then flips.

A start is a random code or an array of pinholes. Relaxation moves transmissions between 0 and 1 (L-BFGS-B), the best
threshold makes them 0 or 1, and flips of single features follow as long as one of them lowers the error, in the order
of the first-order change that the gradient predicts. Each start has its own random stream, so that a search that is
resumed after any number of starts ends as one without a stop.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import minimize

from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.seeds import stream
from mitsim.design.objective import Objective
from mitsim.devices.mask import mls_code
from mitsim.devices.patterns import is_prime

_RELAXED = 40
"""Steps of relaxation: later ones gain less than flips do."""
_THRESHOLDS = 0.2, 0.35, 0.5, 0.65, 0.8
_PARTS = 0.05, 0.1, 0.15, 0.2, 0.3, 0.5
"""Open parts of random codes, in turn."""
_WIDEST = 4
"""Features of the widest pinholes."""
_SHARPNESS = 20.0
"""Exponent of the mean that stands for the largest error, which decides where errors differ by 1 dB."""
_EVERY_CODE = 12
"""Longest period of which all 223 codes are tried, in some seconds."""
_DIGITS = 9
"""Digits of an error's logarithm by which codes are equal."""


@dataclass(frozen=True)
class Found:
    """A code (N,), where it came from, its score (mean squared error), and evaluations spent on it."""

    origin: str
    code: FloatArray
    score: float
    evaluations: int

    @property
    def psnr_db(self) -> float:
        return -10 * math.log10(self.score)


@dataclass
class Search:
    """Search over codes of ``objectives``, of which the geometric mean counts, or with ``worst`` the largest error.

    ``open_part`` bounds the part of the features in use that are open. Raises MitsimError if no code meets it.
    """

    objectives: Sequence[Objective]
    open_part: tuple[float, float] = (0.0, 1.0)
    worst: bool = False
    seed: int = 0
    evaluations: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        sides = [side for each in self.objectives for side in each.sides]
        self.features = sides[0].features
        self.used = np.unique(np.concatenate([side.used for side in sides]))
        fewest, most = (part * len(self.used) for part in self.open_part)
        self._fewest, self._most = max(math.ceil(fewest - 1e-9), 1), math.floor(most + 1e-9)
        if self._fewest > self._most:
            raise MitsimError(
                f"open_part: got {self.open_part[0]:g} to {self.open_part[1]:g}, but of {len(self.used)} features that "
                "the sensor sees no whole number of at least 1 lies between; give a wider range or smaller features"
            )

    def score(self, code: FloatArray, slopes: bool = False, lams: Sequence[float | None] = ()) -> Scored:
        """Return the score of a code for rows and columns alike, and with ``slopes`` its gradient."""
        self.evaluations += 1
        known = lams or (None,) * len(self.objectives)
        values = [each((code, code), lam, slopes) for each, lam in zip(self.objectives, known, strict=True)]
        logs = np.log([value.total for value in values])
        weights = np.full(len(logs), 1 / len(logs))
        mean = float(logs.mean())
        if self.worst:
            scaled = np.exp(_SHARPNESS * (logs - logs.max()))
            mean = float(logs.max() + np.log(scaled.mean()) / _SHARPNESS)
            weights = scaled / scaled.sum()
        slope = np.zeros(self.features)
        for weight, value in zip(weights, values, strict=True):
            slope += weight * sum(value.slopes) / value.total  # none without slopes
        return Scored(math.exp(mean), slope, [value.lam for value in values])

    def starts(self) -> Iterator[tuple[str, FloatArray]]:
        """Yield starts without end: the best pinholes, then random codes and pinholes of random period in turn."""
        number = 0
        if (best := self.best_pinholes()) is not None:
            yield best.origin, best.code
        while True:
            random, part = stream(self.seed, "mask search", number), _PARTS[number // 2 % len(_PARTS)]
            if number % 2:
                period = int(random.integers(3, max(len(self.used) // 3, 4)))
                width = int(random.integers(1, max(period // 3, 1) + 1))
                code = self._placed(pinholes(len(self.used), period, width))
                yield f"pinholes of period {period}, width {width}, start {number}", code
            else:
                yield f"random transmissions, start {number}", self._placed(random.random(len(self.used)) * 2 * part)
            number += 1

    def improve(self, origin: str, start: FloatArray, evaluations: int = 400) -> Found:
        """Return the best code near a ``start``, after at most about that many evaluations."""
        begun = self.evaluations
        code = start
        if not (set(np.unique(start)) <= {0.0, 1.0} and self.allows(start)):
            code = self._round(self._relax(start, evaluations // 2))
        here = self.score(code, slopes=True)
        while self.evaluations - begun < evaluations:
            change = (here.slope * (1 - 2 * code))[self.used]
            better = False
            for place in self.used[np.argsort(change, kind="stable")]:
                if self.evaluations - begun >= evaluations:
                    break
                trial = code.copy()
                trial[place] = 1 - trial[place]
                if self.allows(trial) and (found := self.score(trial, lams=here.lams)).score < here.score:
                    code, here, better = trial, Scored(found.score, here.slope, here.lams), True
            if not better:
                break
            here = self.score(code, slopes=True)
        return Found(f"found from {origin}", code, self.score(code).score, self.evaluations - begun)

    def best_random(self, evaluations: int) -> Found:
        """Return the best of that many random codes."""
        random, found = stream(self.seed, "random masks"), list[Found]()
        while len(found) < max(evaluations, 1):
            part = _PARTS[len(found) % len(_PARTS)]
            code = self._placed(np.where(random.random(len(self.used)) < part, 1.0, 0.0))
            if not self.allows(code):
                code = self._bounded(code, random.random(self.features))
            origin, score = f"random, open part {code[self.used].mean():.2f}", self.score(code).score
            found.append(Found(origin, code, score, evaluations))
        return min(found, key=lambda each: each.score)

    def lit_by(self, lit: str) -> Search:
        """Return the search for cyclic patterns of a code."""
        return replace(self, objectives=[each.lit_by(lit) for each in self.objectives])

    def best_patterns(self, code: FloatArray, period: int) -> str:
        """Return the code of a ``period`` whose cyclic patterns have the least error with a mask."""
        return min(cyclic_codes(period), key=lambda lit: round(math.log(self.lit_by(lit).score(code).score), _DIGITS))

    def best_pinholes(self) -> Found | None:
        """Return the best array of equal pinholes, None if no array is within the bounds."""
        found, begun = [], self.evaluations
        for period in range(2, len(self.used) // 2):
            for width in range(1, min(period // 2, _WIDEST) + 1):
                code = self._placed(pinholes(len(self.used), period, width))
                if self.allows(code):
                    score = self.score(code).score
                    found.append(Found(f"pinholes of period {period}, width {width}", code, score, 0))
        best = min(found, key=lambda each: each.score, default=None)
        return best and Found(best.origin, best.code, best.score, self.evaluations - begun)

    def maximum_length(self) -> Found:
        """Return the shortest maximum length sequence that covers the features, cut to them."""
        order = min(max(math.ceil(math.log2(self.features + 1)), 2), 16)
        sequence = mls_code(order).astype(np.float64)
        places = np.arange(self.features) - self.features // 2 + len(sequence) // 2
        code = sequence[places % len(sequence)]
        return Found(f"maximum length sequence of order {order}", code, self.score(code).score, 1)

    def allows(self, code: FloatArray) -> bool:
        """Return True if a code of 0 and 1 has an allowed open part."""
        return bool(self._fewest <= code[self.used].sum() <= self._most)

    def active_bounds(self, code: FloatArray) -> list[str]:
        """Return the bounds that a code has reached."""
        both = (self._fewest, "smallest open_part"), (self._most, "largest open_part")
        return [name for bound, name in both if code[self.used].sum() == bound]

    def _relax(self, start: FloatArray, evaluations: int) -> FloatArray:
        def cost(inside: FloatArray) -> tuple[float, FloatArray]:
            found = self.score(self._placed(inside), slopes=True)
            return math.log(found.score), found.slope[self.used]

        options = {"maxiter": _RELAXED, "maxfun": evaluations}
        bounds = [(0.0, 1.0)] * len(self.used)
        found = minimize(cost, start[self.used], jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        return self._placed(found.x)

    def _placed(self, inside: FloatArray) -> FloatArray:
        code = np.zeros(self.features)
        code[self.used] = inside
        return code

    def _round(self, code: FloatArray) -> FloatArray:
        trials = [self._bounded((code > at).astype(np.float64), code) for at in _THRESHOLDS]
        return min(trials, key=lambda trial: self.score(trial).score)

    def _bounded(self, code: FloatArray, order: FloatArray) -> FloatArray:
        """Open or close features in the ``order`` of transmissions until the open part is allowed."""
        code, ranked = code.copy(), self.used[np.argsort(-order[self.used], kind="stable")]
        count = int(np.clip(code[self.used].sum(), self._fewest, self._most))
        if count != code[self.used].sum():
            code[self.used] = 0
            code[ranked[:count]] = 1
        return code


@dataclass(frozen=True)
class Scored:
    """Mean squared error of a code, its logarithm's gradient (N,), and lambda for each objective."""

    score: float
    slope: FloatArray
    lams: list[float]


def pinholes(count: int, period: int, width: int) -> FloatArray:
    """Return a code (count,) of openings of ``width`` features, a ``period`` apart, about its middle."""
    return ((np.arange(count) - count // 2 + width // 2) % period < width).astype(np.float64)


def cyclic_codes(period: int) -> list[str]:
    """Return texts of 0 and 1 of a ``period``, without rotations and mirror images of others; that of dots is first.

    Mirror images have the same noise but for the order of pixels. Beyond a period of 12, codes are as many 1 as one
    likes, side by side or spread evenly, and difference sets with their complements: squares modulo a prime, and
    maximum length sequences.
    """
    places = range(period)
    if period <= _EVERY_CODE:
        codes = [*itertools.product((0, 1), repeat=period)][1:]
    else:
        codes = [tuple(int(i * step % period < fill) for i in places) for fill in places[1:] for step in (1, fill)]
        sets = [{i * i % period for i in places[1:]}] if is_prime(period) else []
        if (period + 1).bit_count() == 1:
            sets.append(set(np.flatnonzero(mls_code(period.bit_length()))))
        codes += [tuple(int((i in chosen) == inside) for i in places) for chosen in sets for inside in (True, False)]
    texts = ("".join(map(str, code)) for code in codes)
    alike = ((each[i:] + each[:i] for each in (text, text[::-1]) for i in places) for text in texts)
    return list(dict.fromkeys(map(max, alike)))
