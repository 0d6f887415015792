"""A scene, a calibrated camera and patterns in; the decibels that each source of noise and each drift costs, out.

Beside one image that is measured, its squared error E is told by its parts V, which add up. Of noise they are expected,
a perturbation of the solver with its lambda fixed (:mod:`mitsim.studies.perturbation`). What the scene's light has
that factors, measured on an even white board, do not hold - detail inside projector pixels, depth, light over several
surfaces - is found from frames without noise of the light that was traced, solved with factors without noise: of the
same with one cause after another taken out of the light (:mod:`mitsim.studies.causes`), and less what lambda alone
takes away. What is left of E is not explained. Noise is drawn once, so every V and what is left scatter by chance, as
:mod:`mitsim.studies.perturbation` states.

A source costs ``10 log10(E / (E - V))``: what the image would gain without it. These decibels do not add up. A drift
that adds the squared error A costs ``10 log10((E + A) / E)``. Of what is not explained any share may belong to any
source; the uncertainty is what that changes, and what chance does.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from mitsim.calibrate.lit_session import LitSession
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.devices.session import DRIFT_WORDS, SIDES, Drift, amount_in_words
from mitsim.reconstruct.factors import Factors
from mitsim.report.lit_scene import SPECKLE
from mitsim.studies import causes
from mitsim.studies.causes import Ablation
from mitsim.studies.drift_study import AMBIENT, SESSION, DriftStand, Prediction, squared_error
from mitsim.studies.perturbation import Noise, Scatter

CAPTURE, SCENE, DRIFT, SOLVER, UNEXPLAINED = "capture", "scene", "drift", "solver", "unexplained"
"""Where a loss comes from, beside the session."""
RENDERING, LAMBDA, REST = "rendering", "lambda and resolution", "all else"
"""Sampling of simulated light; what the solver takes away of the scene itself; and what no named cause has."""
ERROR_SOURCES = MappingProxyType(
    {
        causes.DETAIL: "detail inside projector pixels",
        causes.DEPTH: "depth beside the board's",
        causes.OCCLUSION: "edges that hide pixels from part of the sensor",
        causes.INTERREFLECTION: "light over several surfaces",
        causes.MIRRORS: "light over mirrors",
        causes.GLOSS: "gloss over the sensor",
        causes.BLACK_LEVEL: "light that black pixels leak",
    }
)
"""Effects of the scene's light that factors do not hold, in the order in which they are taken out, in words. The others
are in the light of the white board as well."""
SURE = 3.0
"""Standard errors from which what is not explained is no chance: 1 of 370 studies has more of normal scatter."""
_LEAST_LEFT = 1e-9
"""Part of an image's error that is left without a source, at least: 90 dB, for images that one source explains."""


@dataclass(frozen=True)
class LossRow:
    """What a ``source`` of noise, or a drift by an ``amount``, costs an image [dB], and how sure that is; ``of``:
    capture, session, scene, drift, the solver, or unexplained; ``squared_error``, mean over the image, that a source
    has, below 0 where the image has more without it, and its ``deviation`` by chance."""

    of: str
    source: str
    amount: str
    lost_db: float
    error_db: float
    squared_error: float = 0.0
    deviation: float = 0.0

    @property
    def name(self) -> str:
        """In words."""
        if self.of == UNEXPLAINED:
            return self.source
        what = DRIFT_WORDS.get(self.source, self.source) if self.of == DRIFT else f"{self.of}: {self.source}"
        return f"{what}, {self.amount}" if self.amount else what


@dataclass(frozen=True)
class _Part:
    """Of an image's squared error, mean over the image: how much, and by how much chance moves it."""

    square: float
    deviation: float = 0.0


@dataclass(frozen=True, eq=False)
class _Budget:
    """Of one image.

    Attributes
    ----------
    parts
        by where they come from and by source.
    scatter, drawn
        of images by factors without noise, and all noise that is drawn.
    steady
        (n, n') error that is no noise.
    """

    parts: dict[tuple[str, str], _Part]
    scatter: Scatter
    drawn: Noise
    steady: FloatArray


def losses(stand: DriftStand, lit: LitSession, clear: Factors) -> tuple[list[LossRow], list[str]]:
    """Rows of the error budget: noise, scene, every drift of the recipe, and the unexplained rest; and what could not
    be predicted.

    Parameters
    ----------
    stand
        the scene in its light, the camera and the patterns; its recipe states the drift.
    lit, clear
        the session that its factors are of, and its factors without noise.
    """
    budget = _budget(stand, lit, clear)
    measured, explained = squared_error(stand.before_db), sum(part.square for part in budget.parts.values())
    found = [
        LossRow(
            of, source, "", *gain_without(part.square, measured, explained, part.deviation), part.square, part.deviation
        )
        for (of, source), part in budget.parts.items()
    ]
    pixels = budget.steady.size
    found.append(_unexplained_row(measured, explained, budget.scatter.deviation(budget.drawn, budget.steady) / pixels))
    rows, refused = _drifts(stand, budget, measured)
    return found + rows, refused


def _drifts(stand: DriftStand, budget: _Budget, measured: float) -> tuple[list[LossRow], list[str]]:
    """Rows of drifts beside the squared error that is ``measured``, and what could not be predicted.

    What a drift adds is as the model has it, and so is what that has in common with the error that is there without
    it. But the model's drift does not move what the model leaves out of the scene's light, as the true one does: the
    uncertainty is all of what these have in common, and chance.
    """
    still, found, refused = stand.expected_image(Drift()), list[LossRow](), list[str]()
    target, scene, pixels = still.image - budget.steady, stand.lit.truth, budget.steady.size
    for kind in stand.recipe.drift.kinds:
        drift = stand.recipe.drift.alone(kind)
        try:
            moved = stand.expected_image(drift)
        except MitsimError as error:
            refused.append(f"{kind}: {error}")
            continue
        lost, apart = (
            Prediction(stand.before_db, still.psnr_db(truth), moved.psnr_db(truth)).predicted_lost_db
            for truth in (target, scene)
        )
        # Noise that happens to look like what the drift does, and the draw of what drifts at random.
        alike = budget.scatter.common(budget.drawn, moved.image - still.image) / pixels
        chance = math.hypot(alike, math.sqrt(stand.scatter(drift, budget.steady))) / measured
        sure = math.hypot(lost - apart, 10 * math.log10(1 + chance / 10 ** (lost / 10)))
        amount = amount_in_words(kind, getattr(stand.recipe.drift, kind))
        found.append(LossRow(DRIFT, kind, amount, lost, sure))
    return found, refused


def _unexplained_row(measured: float, explained: float, chance: float) -> LossRow:
    """Squared error that is ``measured`` and not ``told``, which ``chance`` moves by so much."""
    left = measured - explained
    lost = _decibels(left / measured)
    error = abs(_decibels((left + chance) / measured) - lost)
    return LossRow(UNEXPLAINED, "not explained", "", lost, error, left, chance)


def _budget(stand: DriftStand, lit: LitSession, clear: Factors) -> _Budget:
    scene, noises = stand.lit.truth, _noises(stand, lit)
    pixels, found = scene.size, dict[tuple[str, str], _Part]()
    exact = replace(stand.linear, left=clear.left, right=clear.right)
    sampled = sum((noise for (_, name), noise in noises.items() if name == RENDERING), Noise())
    drawn = sum(noises.values(), Noise()) - sampled
    seen = dict(_clear_images(stand, clear))
    whole = next(iter(seen.values()))
    steady = whole + sum(stand.fixed.values(), np.zeros_like(scene)) - scene
    scatter = Scatter(exact, scene)
    for source, noise in noises.items():
        among = drawn + (noise if source[1] == RENDERING else Noise())
        found[source] = _Part(
            stand.linear.variance(scene, noise) / pixels, scatter.share(noise, among, steady) / pixels
        )
    off = whole - scene
    for name, error in stand.fixed.items():
        found[CAPTURE, name] = _Part(_square(off + error) - _square(off))
        off = off + error
    found |= _of_scene(scatter, seen, sampled)
    return _Budget(found, scatter, drawn, off)


def _clear_images(stand: DriftStand, clear: Factors) -> Iterator[tuple[str, FloatArray]]:
    """Images without noise of the scene's light, and of it without one cause after another."""
    scene_ablation, off = Ablation.of(stand.lit.light), frozenset[str]()
    yield "", stand.clear(clear, stand.lit.light)
    for name in ERROR_SOURCES:
        if name in scene_ablation.effects:
            off |= {name}
            yield name, stand.clear(clear, scene_ablation.without(off))


def _of_scene(scatter: Scatter, seen: Mapping[str, FloatArray], sampled: Noise) -> dict[tuple[str, str], _Part]:
    """What the light of a scene has beside that of a white board, by cause, and what lambda takes away.

    ``seen`` are images of the light with its causes, then without one after another; ``sampled`` is the noise of its
    rendering, which all of these have alike.
    """
    exact, scene, found = scatter.solver, scatter.scene, {(SCENE, ERROR_SOURCES[causes.DETAIL]): _Part(0.0)}
    (_, last), *others = seen.items()
    for name, image in others:
        moved = scatter.common(sampled, last - image) / scene.size
        found[SCENE, ERROR_SOURCES[name]] = _Part(_square(last - scene) - _square(image - scene), moved)
        last = image
    bias = _square(exact.expected_image(scene).image - scene)
    rest = _square(last - scene) - bias - exact.variance(scene, sampled) / scene.size
    found[SCENE, REST] = _Part(rest, scatter.deviation(sampled, last - scene) / scene.size)
    found[SOLVER, LAMBDA] = _Part(bias)
    return found


def _square(error: FloatArray) -> float:
    return float(np.square(error).mean())


def gain_without(part: float, measured: float, explained: float, deviation: float = 0.0) -> tuple[float, float]:
    """Decibels that an image would gain without a source, and how sure that is.

    Parameters
    ----------
    part
        squared error that the source is predicted to have.
    measured, explained
        squared error of the image as it is, and as all sources together are predicted to make it.
    deviation
        by which chance moves the source's part.
    """
    most = max(measured, explained)
    lost = _decibels(part / most)
    chance = abs(_decibels((part + deviation) / most) - lost)
    if measured >= explained:
        return lost, math.hypot(chance, _decibels(part / explained if explained else 0.0) - lost)
    # More is predicted than there is: at most, all of what is too much is this source's.
    return lost, math.hypot(chance, _decibels(max(part - (explained - measured), 0.0) / measured) - lost)


def _decibels(part: float) -> float:
    """That an image gains without a ``part`` of its squared error."""
    return -10 * math.log10(max(1 - part, _LEAST_LEFT)) if part else 0.0


def _noises(stand: DriftStand, lit: LitSession) -> Mapping[tuple[str, str], Noise]:
    """Noise by where it comes from and by source."""
    found = dict[tuple[str, str], Noise]()
    for name, noise in stand.noises.items():
        if name != SESSION and (name not in (AMBIENT, SPECKLE) or noise != Noise()):
            found[CAPTURE, name] = noise
    light, factors = stand.lit.light, (stand.factors.left, stand.factors.right)
    # The truth's own sampling is in the error as much as that of the light.
    sampled = light.apparent.error_of(light.flux_error) ** 2 + light.apparent.error**2
    found[CAPTURE, RENDERING] = Noise(light=sampled)
    left, right = (entry_variances(lit, factors, side) for side in SIDES)
    for source, variance in left.items():
        found[SESSION, source] = Noise(left=float(variance.mean()), right=float(right[source].mean()))
    found[SESSION, RENDERING] = session_rendering(lit.light.flux, lit.light.flux_error, factors)
    return found


def session_rendering(flux: FloatArray, flux_error: FloatArray, factors: tuple[FloatArray, FloatArray]) -> Noise:
    """What sampling of a session's light leaves in its ``factors``.

    Where pixel (x, y) of the board is lit by 1 + e_xy of its light, column x of the left factor is multiplied by
    1 + sum_y e_xy w_y, w_y = Phi_R(y) . v / |v|^2, v the sum of all columns of Phi_R.

    Parameters
    ----------
    flux, flux_error
        (n^2,) of each projector pixel, and its standard error.
    factors
        left and right, (m, n) and (m', n').
    """
    lit = flux > 0
    error = float(np.mean(np.square(flux_error[lit] / flux[lit]))) if lit.any() else 0.0
    spread = []
    for factor in factors:
        common = factor.sum(axis=1)
        spread.append(float(np.square(common @ factor / np.dot(common, common)).sum()))
    return Noise(left_light=error * spread[1], right_light=error * spread[0])


def entry_variances(lit: LitSession, factors: tuple[FloatArray, FloatArray], side: str) -> dict[str, FloatArray]:
    """(m, n) predicted variance of the entries of a factor by source.

    u_i = Y_i v / |v|^2 has the variance sum_c V_rc v_c^2 / |v|^4 in row r, V being that of a response's pixels, and
    U H^T / N averages N of them with signs. Noise that all responses share comes into column p by the mean of its
    signs: all of it where they are all +1, and nothing elsewhere.

    Parameters
    ----------
    lit, factors
        the session, and left and right factor.
    side
        whose stripes give the factor.
    """
    signs, common = lit.session.signs, (factors[1] if side == SIDES[0] else factors[0]).sum(axis=1)

    def spread(part: FloatArray) -> FloatArray:
        variance = np.broadcast_to(part, lit.uniform_rate.shape)
        weights = np.square(common) / np.dot(common, common) ** 2
        return np.asarray((variance if side == SIDES[0] else variance.T) @ weights)

    own, shared = lit.response_variances(side)
    even, first = np.full(len(signs), 1 / signs.shape[1]), np.square(signs.mean(axis=1))
    return {source: np.outer(spread(own[source]), even) + np.outer(spread(shared[source]), first) for source in own}
