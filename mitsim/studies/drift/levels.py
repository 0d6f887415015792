"""A scene, its camera and names of effects in; the image that comes out with these effects alone, out.

The scene's own effects are taken out of its light (:mod:`mitsim.studies.accuracy.partial_light`). Besides there are
three of the camera: *saturation*, the full well and the end of the ADC; *quantisation*, its steps and its first number;
and *calibration noise*, what the noise of a session's frames leaves in the factors. Shot noise, read noise and dark
current are never off: the paper's model has such noise as well. A frame's exposure is that of equal peak with the
effects on.

Images are made with the *model assumed*, the exact factors of the idealised camera, and with the *model calibrated*:
factors that a session before a white board is expected to give with the same effects, and calibration noise as that of
the real session with its seed. Everything on, frames and calibrated factors are those that a user gets, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np

from mitsim.acquire.capture import capture
from mitsim.acquire.exposure import Exposer
from mitsim.acquire.spectral import SpectralBench
from mitsim.bench.bench import Apparatus
from mitsim.bench.request import Exposure
from mitsim.calibrate.calibrate import estimate
from mitsim.calibrate.lit_session import LitSession
from mitsim.calibrate.session import Session
from mitsim.core.arrays import FloatArray
from mitsim.core.environment import versions
from mitsim.core.job import Job
from mitsim.core.manifests import CalibrationManifest
from mitsim.core.parallel import single_threaded_blas
from mitsim.devices.patterns import Lighting
from mitsim.devices.sensor import SensorModel, digital_of
from mitsim.devices.session import load_recipe
from mitsim.reconstruct.estimate_factors import Estimate, factors_of_sums, stripe_sums
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.reconstruct.status import Status, Verdict
from mitsim.report.exposures import IdealCamera, LitScene
from mitsim.studies.accuracy import partial_light
from mitsim.studies.accuracy.partial_light import Anatomy

SATURATION, QUANTISATION, CALIBRATION_NOISE = "saturation", "quantisation", "calibration noise"
EFFECTS = (
    partial_light.FALLOFF, partial_light.DIFFRACTION, partial_light.KEYSTONE, partial_light.DEPTH,
    partial_light.OCCLUSION, partial_light.DETAIL, partial_light.INTERREFLECTION, partial_light.MIRRORS,
    partial_light.GLOSS, partial_light.AMBIENT, partial_light.BLACK_LEVEL, partial_light.DEFOCUS, partial_light.SPECKLE,
    SATURATION, CALIBRATION_NOISE, QUANTISATION, partial_light.RENDER_NOISE,
)  # fmt: skip
"""In the order in which they are added: of the rig, of the scene, of light, of the camera, of the simulation."""
ASSUMED, CALIBRATED = MODELS = ("assumed", "calibrated")
_OF_SESSIONS = frozenset(
    {partial_light.FALLOFF, partial_light.DIFFRACTION, partial_light.KEYSTONE, partial_light.DEFOCUS}
)
"""Effects that change what a session's frames are expected to be, but for the black level, a factor for all of them."""
_ROOM = 1024.0
"""Full wells that a sensor without saturation has: no light comes near, and a power of two moves no other number."""
_LARGEST_ADC, _CODES = 24, 2**32
"""Bits of an ADC without saturation, at most, and codes that a frame can hold."""
_SURE = 6.0
"""Deviations of noise by which the brightest pixel stays below saturation: 1e-9 for each pixel and frame."""


class Sessions:
    """Calibration sessions with a bench's camera, with all of their effects or without some.

    Parameters
    ----------
    bench, seed
        whose camera is calibrated, and where light and noise of the session come from.
    """

    def __init__(self, bench: Apparatus, seed: int) -> None:
        self._session, job = Session(bench, load_recipe(), seed), Job()
        light = self._session.trace(self._session.plan(1e-3, job), job)
        self._anatomy = Anatomy(light, light.flux, light.flux, "calibration")
        self._lit = LitSession.of(self._session, light, job)
        self._kept: dict[frozenset[str], Estimate] = {}
        self._effects = _OF_SESSIONS & frozenset(self._anatomy.effects)

    @cached_property
    def noisy(self) -> Factors:
        """Those of the real session, as :meth:`mitsim.bench.bench.Bench.calibrate` has them."""
        return Factors.of(estimate(self._lit, Job())[0], self._manifest)

    def factors(self, off: frozenset[str], noise: bool) -> Factors:
        """Those of a session without some effects.

        Parameters
        ----------
        off
            the effects.
        noise
            whether they have the noise of the real session.
        """
        found, whole = self._expected(off), self._expected(frozenset())
        if not noise:
            return Factors.of(found, self._manifest)
        if not off & (self._effects | {partial_light.BLACK_LEVEL}):
            return self.noisy
        noisy = self.noisy
        left = _aligned(found.left, whole.left) + _aligned(noisy.left, whole.left) - whole.left
        right = _aligned(found.right, whole.right) + _aligned(noisy.right, whole.right) - whole.right
        return replace(Factors.of(replace(found, left=left, right=right), self._manifest), manifest=noisy.manifest)

    def idealised(self, sides: tuple[FloatArray, FloatArray]) -> Factors:
        """Factors with these ``sides``, which nobody measured."""
        return Factors(*sides, self._manifest, Status(Verdict.CALIBRATED, "Factors of the idealised camera"))

    @property
    def _manifest(self) -> CalibrationManifest:
        bench = self._session.bench
        return CalibrationManifest(
            configuration={},
            camera=bench.identity(),
            centre=self._session.centre,
            board_reflectance=self._session.recipe.board_reflectance,
            digital=digital_of(bench.sensor, self._lit.exposure_s),
            parallax=bench.parallax,
            versions=versions(),
        )

    def _expected(self, off: frozenset[str]) -> Estimate:
        """Factors of expected frames."""
        own = off & self._effects
        if own not in self._kept:
            self._kept[own] = self._by_lines(own)
        found, leak = self._kept[own], self._lit.light.simulation.physics.black_level
        # A +-1 pattern is the difference of two shots, in which what black pixels leak cancels, but white ones lose it.
        white = math.sqrt(1.0 - (0.0 if partial_light.BLACK_LEVEL in off else leak))
        return replace(found, left=white * found.left, right=white * found.right)

    @single_threaded_blas()
    def _by_lines(self, off: frozenset[str]) -> Estimate:
        """From lines of the projector, each alone: what +-1 stripes come to without noise."""
        light, n = self._anatomy.without(off), self._session.bench.n
        second = Exposer(self._session.bench.rig, 1.0, self._session.seed)

        def rates(lighting: Lighting) -> Iterator[FloatArray]:
            return (second.electrons(frame) for frame in light.frames(lighting, 0, leaking=False))

        sides = [rates(Lighting(of, np.eye(n))) for of in np.divmod(np.arange(n * n), n)]
        (uniform,) = rates(Lighting.uniform(n))
        both = stripe_sums(next(sides[0]), next(sides[1]), n, self._session.centre, uniform)
        for sums, side in zip(both, sides, strict=True):
            for rate in side:
                sums.add(rate)
        return factors_of_sums(*both, n * np.eye(n), stated_noise=0.0)


class Levels:
    """Images of a scene with any of its effects.

    Parameters
    ----------
    lit, anatomy
        the scene, and its light.
    sessions
        of the camera.
    patterns, seed
        the family, and seed of the frames' noise.
    """

    def __init__(self, lit: LitScene, anatomy: Anatomy, sessions: Sessions, patterns: str, seed: int) -> None:
        self.lit, self._anatomy, self._sessions, self._patterns, self._seed = lit, anatomy, sessions, patterns, seed
        camera = IdealCamera(lit.bench, lit.bench.geometry.mask)
        self._assumed = sessions.idealised(camera.calibrated(float(lit.light.apparent.board_flux.mean())))
        fills = fills_well(lit.bench.sensor, lit.light.simulation.physics.speckle)
        own = {SATURATION: fills, QUANTISATION: lit.bench.sensor.bits is not None, CALIBRATION_NOISE: True}
        self.effects = tuple(name for name in EFFECTS if name in anatomy.effects or own.get(name, False))

    def images(self, on: frozenset[str]) -> Mapping[str, FloatArray]:
        """The image by model, with the effects ``on`` that the scene has."""
        off, light = frozenset(self.effects) - on, self.lit.light
        sensor, fraction = sensor_without(light.bench.sensor, off), Exposure().fraction
        fraction = fraction / _ROOM if SATURATION in off else fraction
        bench = replace(light.bench, rig=replace(light.bench.rig, sensor=sensor))
        request = light.plan.request
        assert request is not None
        asked = request.changed(patterns=self._patterns, seed=self._seed, exposure_fraction=fraction)
        shots = capture(SpectralBench(bench), asked, lights=[self._anatomy.without(off)]).runs[0]
        calibrated = self._sessions.factors(off, CALIBRATION_NOISE not in off)
        found = {}
        for model, factors in zip(MODELS, (self._assumed, calibrated), strict=True):
            fitting = replace(factors, manifest=factors.manifest.model_copy(update={"camera": shots.manifest.camera}))
            found[model] = reconstruct(shots, fitting).image
        return found


def sensor_without(sensor: SensorModel, off: frozenset[str]) -> SensorModel:
    """A ``sensor`` without saturation or quantisation, where these are ``off``."""
    changed: dict[str, object] = {}
    if SATURATION in off:
        most = math.floor(math.log2(_CODES / sensor.binning**2))
        changed |= {"full_well_e": sensor.full_well_e * _ROOM, "bits": sensor.bits and min(_LARGEST_ADC, most)}
    if QUANTISATION in off:
        changed["bits"] = None
    return sensor.model_copy(update=changed)


def fills_well(sensor: SensorModel, speckle: float) -> bool:
    """Whether light at equal peak can saturate a ``sensor``, under ``speckle`` of some contrast."""
    well, largest = sensor.superpixel_full_well_e, sensor.largest_dn
    if largest is not None:
        well = min(well, (largest - sensor.superpixel_black_level_dn) / sensor.gain_dn_per_e)
    peak = Exposure().fraction * sensor.superpixel_full_well_e
    noise = math.hypot(math.sqrt(peak), sensor.superpixel_reading_noise_e)
    return speckle > 0 or peak + _SURE * noise > well


def _aligned(side: FloatArray, like: FloatArray) -> FloatArray:
    """A ``side`` with the sign of one that it should be ``like``: both sides turned round are the same camera."""
    return side if np.vdot(side, like) >= 0 else -side
