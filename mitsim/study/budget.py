"""A scene, a calibrated camera and patterns in; the decibels that each source of noise and each drift costs, out.

All of it is a perturbation of the solver with its lambda fixed (:mod:`mitsim.reconstruct.perturbation`), beside one
image that is measured. With E that image's squared error and V the part of it that a source is predicted to have, the
source costs ``10 log10(E / (E - V))``: what the image would gain without it. A drift that adds the squared error A
costs ``10 log10((E + A) / E)``. What the prediction leaves out of E, such as detail inside projector pixels, may have
any share in V and in A; the uncertainty is what changes if it has none in E.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from mitsim.capture.session import LitSession
from mitsim.core.errors import MitsimError
from mitsim.reconstruct.perturbation import Noise
from mitsim.rig.drift import UNITS, WORDS
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
    capture, session, drift, or the solver."""

    of: str
    source: str
    amount: str
    lost_db: float
    error_db: float

    @property
    def name(self) -> str:
        """In words."""
        what = WORDS.get(self.source, self.source) if self.of == DRIFT else f"{self.of}: {self.source}"
        return f"{what}, {self.amount}" if self.amount else what


def losses(stand: DriftStand, lit: LitSession) -> tuple[list[LossRow], list[str]]:
    """Rows of noise and of every drift of the recipe, and what could not be predicted.

    MitsimError for patterns that predictions are not made for.

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
    parts[SOLVER, LAMBDA] = squared_error(bias) if math.isfinite(bias) else 0.0
    measured, told = squared_error(stand.before_db), sum(parts.values())
    for (of, source), part in parts.items():
        found.append(LossRow(of, source, "", *gained(part, measured, told)))
    refused = []
    drift = stand.recipe.drift
    for kind in drift.kinds:
        try:
            foretold = stand.foretold(drift.alone(kind))
        except MitsimError as error:
            refused.append(f"{kind}: {error}")
            continue
        amount = f"{getattr(drift, kind):g} {UNITS[kind]}".removesuffix(" 1").replace(" 1 rms", " rms")
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
    """Noise by where it comes from and by source; that of the session in the shares that its closed form has."""
    found = dict[tuple[str, str], Noise]()
    for name, noise in stand.noises.items():
        if name == SESSION:
            found.update(((SESSION, source), part) for source, part in _session(noise, lit))
        elif name not in (AMBIENT, SPECKLE) or noise != Noise():
            found[CAPTURE, name] = noise
    light = stand.lit.light
    found[CAPTURE, RENDERING] = Noise(light=light.apparent.error_of(light.flux_error) ** 2)
    return found


def _session(noise: Noise, lit: LitSession) -> Iterator[tuple[str, Noise]]:
    """The factors' ``noise`` by source, as the frames of a session ``lit`` have it."""
    shares = []
    for side in SIDES:
        own, shared = lit.response_variances(side)
        both = {source: float((own[source] + shared[source]).mean()) for source in own}
        whole = sum(both.values())
        shares.append({source: variance / whole if whole else 0.0 for source, variance in both.items()})
    for source in shares[0]:
        yield source, Noise(left=noise.left * shares[0][source], right=noise.right * shares[1][source])
