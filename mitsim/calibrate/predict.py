"""A lit session and its responses without noise in; factors as any exposure and repeats would leave them, out.

Noise of a session's frames is independent from pixel to pixel and shot to shot, and factors are linear in responses:
u_i = Y_i v / |v|^2, Phi_L = U H^T / N. With V[k, l] the variance of a response at a pixel, a number of row k of Phi_L
has variance sum_l V[k, l] v_l^2 / (N |v|^4), and numbers are uncorrelated, since the rows of H are orthogonal. So
factors are drawn without drawing a frame. Where each +-1 pattern is taken from one shot and a uniform one that all
share, the noise of the latter comes into column p of Phi_L by sum_i H[p, i] / N: all of it into the column whose signs
are all +1.

The noise of v enters at second order and is left out, as are noise that a sensor row shares, and speckle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from mitsim.acquire.capture import digital_scale
from mitsim.acquire.exposure import Exposer
from mitsim.bench.request import Exposure
from mitsim.calibrate.session import LitSession
from mitsim.core.arrays import FloatArray
from mitsim.core.job import Job
from mitsim.core.manifests import CalibrationManifest
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import stream
from mitsim.devices.session import SIDES, SessionRecipe
from mitsim.optics.frames import Frame
from mitsim.reconstruct.estimate_factors import Estimate, Seen, StripeSums, factors_of_sums, stripe_sums
from mitsim.reconstruct.factors import Factors
from mitsim.sensor.moments import frame_moments


@dataclass(frozen=True, eq=False)
class Foreseen:
    """A session whose responses are known without noise.

    Attributes
    ----------
    lit
        the session in its light, by any recipe of its board and way of capturing signed patterns.
    sums
        of its noise-free responses, all of them in.
    """

    lit: LitSession
    sums: tuple[StripeSums, StripeSums]

    @classmethod
    @single_threaded_blas()
    def of(cls, lit: LitSession, job: Job) -> Foreseen:
        """Those of a session ``lit``; ``job`` takes the time of forming its responses, and is told how far it is."""
        first = lit.noise_free(lit.white)
        sums = stripe_sums(first, first, lit.session.signs.shape[1], lit.session.centre)
        for side, own in zip(SIDES, sums, strict=True):
            for seen in lit.each(side, partial(_seen, lit, own), job, own.done):
                own.put(seen)
        return cls(lit, sums)

    def by(self, recipe: SessionRecipe) -> LitSession:
        """The session with the exposure and the repeats of a ``recipe``, whose other fields are those it was lit by."""
        lit = self.lit
        exposure = Exposure(None, recipe.exposure_fraction).choose(
            lit.session.bench.rig, float(lit.white.irradiance.max())
        )
        return replace(lit, session=replace(lit.session, recipe=recipe), exposure_s=exposure)

    def estimate(self, lit: LitSession | None, draw: int = 0) -> Estimate:
        """What the noise of a session leaves.

        Parameters
        ----------
        lit
            the session, as :meth:`by` gives it; None: no noise at all.
        draw
            number of the noise: equal numbers draw equal noise, larger or smaller by the recipe.
        """
        signs = self.lit.session.signs
        if lit is None:
            return factors_of_sums(*self.sums, signs, 0.0)
        left, right = (_noisy(lit, sums, draw) for sums in self.sums)
        return factors_of_sums(left, right, signs, lit.response_noise)

    def factors(self, recipe: SessionRecipe | None, draw: int = 0) -> Factors:
        """The same by a ``recipe``, or None, as factors of the camera; ``draw`` as for :meth:`estimate`."""
        lit = None if recipe is None else self.by(recipe)
        session, exposure_s = self.lit.session, (lit or self.lit).exposure_s
        manifest = CalibrationManifest(
            camera=session.bench.identity(),
            centre=session.centre,
            board_reflectance=session.recipe.board_reflectance,
            digital=digital_scale(session.bench, exposure_s),
            parallax=session.bench.parallax,
        )
        return Factors.of(self.estimate(lit, draw), manifest)


def _noisy(lit: LitSession, sums: StripeSums, draw: int) -> StripeSums:
    """The ``sums`` with noise of a session ``lit``."""
    own, shared = _variances(lit)
    weights = np.square(sums.common / np.dot(sums.common, sums.common))
    by_row = own if sums.side == SIDES[0] else own.T
    random = stream(lit.session.seed, "foreseen", sums.side, draw)
    noise = np.sqrt(by_row @ weights)[:, None] * random.standard_normal(sums.vectors.shape)
    if shared is not None:
        by_row = shared if sums.side == SIDES[0] else shared.T
        noise += np.sqrt(by_row @ weights)[:, None] * random.standard_normal((len(sums.vectors), 1))
        own = own + shared
    # One number a row (or column) of each response was fitted.
    energy, fitted = sums.done * float(own.sum()), 1 - 1 / len(sums.common)
    return replace(
        sums,
        vectors=sums.vectors + noise,
        misfit=sums.misfit + fitted * energy,
        energy=sums.energy + energy,
    )


def _seen(lit: LitSession, sums: StripeSums, shown: tuple[int, Frame]) -> Seen:
    return sums.seen(lit.noise_free(shown[1]), shown[0])


def _variances(lit: LitSession) -> tuple[FloatArray, FloatArray | None]:
    """(m, m') noise variance of a +-1 response [(electrons/s)^2]: its own, and what all of a side share.

    Shots of a pattern are taken for half as bright as uniform light: over all patterns, and over a pair, that is exact.
    """
    bench, time, recipe = lit.session.bench, lit.exposure_s, lit.session.recipe
    white = Exposer(bench.rig, time, lit.session.seed).electrons(lit.white)
    unit = recipe.repeats * (bench.sensor.gain_dn_per_e * time) ** 2
    half = frame_moments(white / 2, time, bench.sensor)[1] / unit
    if lit.session.pairs:
        return 2 * half, None
    return 4 * half, frame_moments(white, time, bench.sensor)[1] / unit
