"""From the paper's idealised model of a scene to its rendered frames, one effect at a time: the cost of each in dB.

An effect is added *alone* to the idealised model, *in order* after all effects before it, or *left out* of the whole.
Effects of the scene are removed from its light (:mod:`mitsim.studies.causes`). Shot noise, read noise and dark current
are always on, because the paper's model has them. The exposure is that of equal peak. Images are made with the *model
assumed*, the exact factors of the idealised camera, and with the *model calibrated*, factors of a session with the same
effects.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from mitsim.acquire.capture import capture
from mitsim.acquire.exposure import Exposer
from mitsim.acquire.spectral import SpectralBench
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.request import Exposure
from mitsim.calibrate.board_session import Session
from mitsim.calibrate.calibrate import estimate
from mitsim.calibrate.lit_session import LitSession
from mitsim.core.arrays import FloatArray
from mitsim.core.environment import versions
from mitsim.core.job import Job
from mitsim.core.manifests import CalibrationManifest
from mitsim.core.parallel import single_threaded_blas
from mitsim.devices.patterns import Lighting
from mitsim.devices.sensor import SensorModel, digital_of
from mitsim.devices.session import load_recipe
from mitsim.metrics import psnr
from mitsim.reconstruct.factors import Estimate, Factors, factors_of_sums, stripe_sums
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.reconstruct.solution import Solution, Status, Verdict
from mitsim.report.lit_scene import IdealCamera, LitScene
from mitsim.studies import causes
from mitsim.studies.causes import Ablation
from mitsim.studies.framework.claims import TOLERANCE_DB, Gain
from mitsim.studies.framework.experiment import QUICK_IMAGES, TRUTH, Found, Point, Scope, Study
from mitsim.studies.framework.panels import Bars, Images
from mitsim.studies.framework.studio import Studio, flags_of, single_precision

SATURATION, QUANTISATION, CALIBRATION_NOISE = "saturation", "quantisation", "calibration noise"
EFFECTS = (
    causes.FALLOFF, causes.DIFFRACTION, causes.KEYSTONE, causes.DEPTH, causes.OCCLUSION, causes.DETAIL,
    causes.INTERREFLECTION, causes.MIRRORS, causes.GLOSS, causes.AMBIENT, causes.BLACK_LEVEL,
    causes.DEFOCUS, causes.SPECKLE, SATURATION, CALIBRATION_NOISE, QUANTISATION, causes.RENDER_NOISE,
)  # fmt: skip
ASSUMED, CALIBRATED = MODELS = ("assumed", "calibrated")
_IN_SESSIONS = frozenset({causes.FALLOFF, causes.DIFFRACTION, causes.KEYSTONE, causes.DEFOCUS})
"""Effects that change the expected frames of a session."""
_ROOM = 1024.0
"""Full wells of a sensor without saturation: a power of two changes no other number."""
_LARGEST_ADC, _CODES = 24, 2**32
_SURE = 6.0


class Sessions:
    def __init__(self, bench: Apparatus, seed: int) -> None:
        self._session, job = Session(bench, load_recipe(), seed), Job()
        light = self._session.trace(self._session.plan(1e-3, job), job)
        self._ablation = Ablation(light, light.flux, light.flux, "calibration")
        self._lit = LitSession.of(self._session, light, job)
        self._kept: dict[frozenset[str], Estimate] = {}
        self._effects = _IN_SESSIONS & frozenset(self._ablation.effects)
        self.manifest = CalibrationManifest(
            configuration={},
            camera=bench.identity(),
            centre=self._session.centre,
            board_reflectance=self._session.recipe.board_reflectance,
            digital=digital_of(bench.sensor, self._lit.exposure_s),
            parallax=bench.parallax,
            versions=versions(),
        )

    @cached_property
    def noisy(self) -> Factors:
        return Factors.of(estimate(self._lit, Job())[0], self.manifest)

    def factors(self, off: frozenset[str], noise: bool) -> Factors:
        found, whole = self._estimate(off), self._estimate(frozenset())
        if not noise:
            return Factors.of(found, self.manifest)
        noisy = self.noisy
        if not off & (self._effects | {causes.BLACK_LEVEL}):
            return noisy
        left = _align(found.left, whole.left) + _align(noisy.left, whole.left) - whole.left
        right = _align(found.right, whole.right) + _align(noisy.right, whole.right) - whole.right
        return replace(Factors.of(replace(found, left=left, right=right), self.manifest), manifest=noisy.manifest)

    def _estimate(self, off: frozenset[str]) -> Estimate:
        own = off & self._effects
        if own not in self._kept:
            self._kept[own] = self._by_lines(own)
        found, leak = self._kept[own], self._lit.light.simulation.physics.black_level
        # A +-1 pattern is the difference of two shots: the leak of black pixels cancels, but white ones lose it.
        white = math.sqrt(1.0 - (0.0 if causes.BLACK_LEVEL in off else leak))
        return replace(found, left=white * found.left, right=white * found.right)

    @single_threaded_blas()
    def _by_lines(self, off: frozenset[str]) -> Estimate:
        light, n = self._ablation.without(off), self._session.bench.n
        second = Exposer(self._session.bench.devices, 1.0, self._session.seed)

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
    def __init__(self, lit: LitScene, scene_ablation: Ablation, sessions: Sessions, patterns: str, seed: int) -> None:
        self.lit, self._ablation, self._sessions = lit, scene_ablation, sessions
        self._patterns, self._seed = patterns, seed
        sides = IdealCamera(lit.bench, lit.bench.geometry.mask).calibrated(float(lit.light.apparent.board_flux.mean()))
        status = Status(Verdict.CALIBRATED, "Factors of the idealised camera")
        self._assumed = Factors(*sides, sessions.manifest, status)
        fills = fills_well(lit.bench.sensor, lit.light.simulation.physics.speckle)
        own = {SATURATION: fills, QUANTISATION: lit.bench.sensor.bits is not None, CALIBRATION_NOISE: True}
        self.effects = tuple(name for name in EFFECTS if name in scene_ablation.effects or own.get(name, False))

    def images(self, on: frozenset[str]) -> Mapping[str, Solution]:
        off, light = frozenset(self.effects) - on, self.lit.light
        sensor, fraction = sensor_without(light.bench.sensor, off), Exposure().fraction
        fraction = fraction / _ROOM if SATURATION in off else fraction
        bench = replace(light.bench, devices=replace(light.bench.devices, sensor=sensor))
        request = light.plan.request
        assert request is not None
        options = request.with_values(patterns=self._patterns, seed=self._seed, exposure_fraction=fraction)
        shots = capture(SpectralBench(bench), options, lights=[self._ablation.without(off)]).runs[0]
        calibrated = self._sessions.factors(off, CALIBRATION_NOISE not in off)
        found = {}
        for model, factors in zip(MODELS, (self._assumed, calibrated), strict=True):
            fitting = replace(factors, manifest=factors.manifest.model_copy(update={"camera": shots.manifest.camera}))
            found[model] = reconstruct(shots, fitting)
        return found


def sensor_without(sensor: SensorModel, off: frozenset[str]) -> SensorModel:
    changed: dict[str, object] = {}
    if SATURATION in off:
        most = math.floor(math.log2(_CODES / sensor.binning**2))
        changed |= {"full_well_e": sensor.full_well_e * _ROOM, "bits": sensor.bits and min(_LARGEST_ADC, most)}
    if QUANTISATION in off:
        changed["bits"] = None
    return sensor.model_copy(update=changed)


def fills_well(sensor: SensorModel, speckle: float) -> bool:
    """Return True if light at equal peak, under ``speckle``, can saturate a ``sensor``."""
    well, largest = sensor.superpixel_full_well_e, sensor.largest_dn
    if largest is not None:
        well = min(well, (largest - sensor.superpixel_black_level_dn) / sensor.gain_dn_per_e)
    peak = Exposure().fraction * sensor.superpixel_full_well_e
    noise = math.hypot(math.sqrt(peak), sensor.superpixel_reading_noise_e)
    return speckle > 0 or peak + _SURE * noise > well


def _align(side: FloatArray, like: FloatArray) -> FloatArray:
    return side if np.vdot(side, like) >= 0 else -side


# -------- The study

ALONE, IN_ORDER, LEFT_OUT = WAYS = ("alone", "in order", "left out")
_KEPT = 64
_IDEAL = "idealised"
_LAST = {"way": IN_ORDER, "effect": EFFECTS[-1]}


def _points(scope: Scope) -> Sequence[Point]:
    pictures = [name for name in scope.pictures if name in (*QUICK_IMAGES, None)] or list(scope.pictures)
    setups, ways = map(scope.setup.with_print, scope.choose(pictures, pictures[:1])), scope.choose(WAYS, WAYS[:2])
    fixed = {"patterns": ("dots:7",)}
    return Point.grid(setups, "patterns seed way effect", seed=scope.repeats, way=ways, effect=EFFECTS, **fixed)


def _measure(studio: Studio, point: Point) -> Found:
    setup, seed, way, effect = point.setup, int(point["seed"]), point["way"], str(point["effect"])
    lit = studio.lit_scene(setup)
    scene_ablation = studio.once("ablation", 1, setup, lambda: Ablation.of(lit.light))
    camera = lit.bench.devices_digest, seed  # a session depends on these, but on no print
    sessions = studio.once("sessions", 1, camera, lambda: Sessions(lit.bench, seed))
    levels = studio.once(
        "levels", 1, (setup, seed), lambda: Levels(lit, scene_ablation, sessions, str(point["patterns"]), seed)
    )

    def images(on: frozenset[str]) -> Mapping[str, Solution]:
        own = on & frozenset(levels.effects)
        return studio.once("images", _KEPT, (setup, seed, own), lambda: levels.images(own))

    without, having = (images(on) for on in ends(way, effect))
    ideal = images(frozenset())
    rows = [
        point.row(
            model=model,
            called_for=effect in levels.effects,
            ideal_db=psnr(ideal[model].image, lit.truth),
            without_db=(before := psnr(without[model].image, lit.truth)),
            with_db=(after := psnr(having[model].image, lit.truth)),
            change_db=after - before,
            **flags_of(having[model].status),
        )
        for model in MODELS
    ]
    if (way, effect) != (IN_ORDER, EFFECTS[-1]):
        return Found(tuple(rows))
    kept = {_IDEAL: ideal[CALIBRATED].image, **{model: having[model].image for model in MODELS}, TRUTH: lit.truth}
    return Found(tuple(rows), single_precision(kept))


def ends(way: str, effect: str) -> tuple[frozenset[str], frozenset[str]]:
    if way == ALONE:
        return frozenset(), frozenset({effect})
    if way == LEFT_OUT:
        return frozenset(EFFECTS) - {effect}, frozenset(EFFECTS)
    place = EFFECTS.index(effect)
    return frozenset(EFFECTS[:place]), frozenset(EFFECTS[: place + 1])


STUDY = Study(
    "waterfall",
    "From the idealised model to rendered frames",
    "What does each physical effect cost in decibels: alone, in order, and left out of the whole?",
    points=_points,
    measure=_measure,
    claims=(
        Gain(
            "A calibrated camera keeps what the idealised model promises (2 dB lost at most)", {}, {},
            where={"model": CALIBRATED, **_LAST}, column="with_db", other_column="ideal_db", at_least=-TOLERANCE_DB,
            apart=True,
        ),
        Gain(
            "A calibrated model is better than the idealised one", {"model": CALIBRATED}, {"model": ASSUMED},
            where=_LAST, column="with_db", apart=True,
        ),
    ),
    panels=(
        Bars(
            "effect", file="waterfall", title="Change of PSNR by each effect that the scene has", x="change_db",
            x_label="change of PSNR [dB]", colour="way", each="model", where={"called_for": True},
        ),
        Images(
            {
                _IDEAL: ("idealised", "{ideal_db:.1f} dB"), ASSUMED: ("rendered, model assumed", ""),
                CALIBRATED: ("rendered, model calibrated", "{with_db:.1f} dB"),
            },
            before={TRUTH: "truth"}, down=("picture",), where={"model": CALIBRATED, **_LAST},
        ),
    ),
    about="An image of 49 dots, exposed at equal peak, from the idealised model (even light on a plane, the mask's "
    "geometric shadow, factors known) to rendered frames, one physical effect after the other. Model assumed: the "
    "solver keeps the idealised camera's factors. Model calibrated: it has factors of a session with the same "
    "effects.",
    heads=("", "Before", "After"),
)  # fmt: skip
