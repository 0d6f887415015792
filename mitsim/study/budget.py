"""A scene, a calibrated camera and patterns in; the decibels that each source of noise and each drift costs, out.

All of it is a perturbation of the solver with its lambda fixed (:mod:`mitsim.reconstruct.perturbation`), beside one
image that is measured. With E that image's squared error and V the part of it that a source is predicted to have, the
source costs ``10 log10(E / (E - V))``: what the image would gain without it. These decibels do not add up, but the V
do, to what E is predicted to be. A drift that adds the squared error A costs ``10 log10((E + A) / E)``. What the
prediction leaves out of E, such as detail inside projector pixels, may have any share in V and in A; the uncertainty
is what changes if it has none in E.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mitsim.capture.session import LitSession
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.reconstruct.perturbation import Noise
from mitsim.rig.drift import WORDS, amount_in_words
from mitsim.rig.order import SIDES
from mitsim.study.drift import AMBIENT, SESSION, DriftStand, squared_error
from mitsim.study.exposures import SPECKLE

CAPTURE, DRIFT, SOLVER = "capture", "drift", "solver"
"""Where a loss comes from, beside the session."""
RENDERING, LAMBDA = "rendering", "lambda and resolution"
"""Sampling of simulated light; and what the solver takes away of the scene itself."""
_LEAST_LEFT = 1e-9
"""Part of an image's error that is left without a source, at least: 90 dB, for images that one source explains."""


@dataclass(frozen=True)
class LossRow:
    """What a ``source`` of noise, or a drift by an ``amount``, costs an image [dB], and how sure that is; ``of``:
    capture, session, drift, or the solver; ``squared_error``, mean over the image, that a source of noise has."""

    of: str
    source: str
    amount: str
    lost_db: float
    error_db: float
    squared_error: float = 0.0

    @property
    def name(self) -> str:
        """In words."""
        what = WORDS.get(self.source, self.source) if self.of == DRIFT else f"{self.of}: {self.source}"
        return f"{what}, {self.amount}" if self.amount else what


def losses(stand: DriftStand, lit: LitSession) -> tuple[list[LossRow], list[str]]:
    """Rows of noise and of every drift of the recipe, and what could not be predicted.

    Parameters
    ----------
    stand
        the scene in its light, the camera and the patterns; its recipe states the drift.
    lit
        the session that its factors are of.
    """
    scene, found = stand.lit.truth, list[LossRow]()
    still = stand.still
    bias = still.psnr_db(scene)
    parts = {source: stand.linear.variance(scene, noise) / scene.size for source, noise in _noises(stand, lit).items()}
    parts |= {(CAPTURE, source): part for source, part in stand.fixed.items()}
    parts[SOLVER, LAMBDA] = squared_error(bias) if math.isfinite(bias) else 0.0
    measured, told = squared_error(stand.before_db), sum(parts.values())
    for (of, source), part in parts.items():
        found.append(LossRow(of, source, "", *gained(part, measured, told), part))
    refused = []
    drift = stand.recipe.drift
    for kind in drift.kinds:
        try:
            foretold = stand.foretold(drift.alone(kind))
        except MitsimError as error:
            refused.append(f"{kind}: {error}")
            continue
        amount = amount_in_words(kind, getattr(drift, kind))
        found.append(LossRow(DRIFT, kind, amount, foretold.predicted_lost_db, foretold.predicted_error_db))
    return found, refused


def gained(part: float, measured: float, told: float) -> tuple[float, float]:
    """Decibels that an image would gain without a source, and how sure that is.

    Parameters
    ----------
    part
        squared error that the source is predicted to have.
    measured, told
        squared error of the image as it is, and as all sources together are predicted to make it.
    """
    lost = _decibels(part / max(measured, told))
    if measured >= told:
        return lost, abs(_decibels(part / told if told else 0.0) - lost)
    # More is predicted than there is: at most, all of what is too much is this source's.
    return lost, abs(_decibels(max(part - (told - measured), 0.0) / measured) - lost)


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
    found[CAPTURE, RENDERING] = Noise(light=light.apparent.error_of(light.flux_error) ** 2)
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
