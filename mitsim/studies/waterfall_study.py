"""From the paper's idealised model of a scene to its rendered frames, one effect at a time: the cost of each in dB.

An effect is added *alone* to the idealised model, *in order* after all effects before it, or *left out* of the whole.
Effects of the scene are removed from its light (:mod:`mitsim.studies.causes`). Shot noise, read noise and dark current
are always on, because the paper's model has them. The exposure is that of equal peak. Images are made with the *model
assumed*, the exact factors of the idealised camera. The last image is made again with the *model calibrated*, the
factors of a session (:mod:`mitsim.studies.calibration_study` shares out what this image still loses).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from mitsim.acquire.capture import capture
from mitsim.acquire.spectral import SpectralBench
from mitsim.bench.request import Exposure
from mitsim.core.manifests import CalibrationManifest
from mitsim.devices.sensor import SensorModel
from mitsim.metrics import psnr
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.reconstruct.solution import Solution, Status, Verdict
from mitsim.report import RENDERED
from mitsim.report.lit_scene import IdealCamera, LitScene
from mitsim.studies import causes
from mitsim.studies.causes import Ablation
from mitsim.studies.framework.claims import TOLERANCE_DB, Gain
from mitsim.studies.framework.experiment import QUICK_IMAGES, TRUTH, Found, Point, Scope, Study
from mitsim.studies.framework.panels import Bars, Images
from mitsim.studies.framework.studio import Studio, flags_of, single_precision

SATURATION, QUANTISATION = "saturation", "quantisation"
EFFECTS = (
    causes.FALLOFF, causes.DIFFRACTION, causes.KEYSTONE, causes.DEPTH, causes.OCCLUSION, causes.DETAIL,
    causes.INTERREFLECTION, causes.MIRRORS, causes.GLOSS, causes.AMBIENT, causes.BLACK_LEVEL,
    causes.DEFOCUS, causes.SPECKLE, SATURATION, QUANTISATION, causes.RENDER_NOISE,
)  # fmt: skip
_ROOM = 1024.0
"""Full wells of a sensor without saturation: a power of two changes no other number."""
_LARGEST_ADC, _CODES = 24, 2**32
_SURE = 6.0


class Levels:
    """Images of a scene with any of its effects, by the factors of the idealised camera."""

    def __init__(self, lit: LitScene, patterns: str, seed: int) -> None:
        self.lit, self._patterns, self._seed, self._ablation = lit, patterns, seed, Ablation(lit.light)
        bench = lit.bench
        sides = IdealCamera(bench, bench.geometry.mask).calibrated(float(lit.light.apparent.board_flux.mean()))
        manifest = CalibrationManifest(camera=bench.identity(), centre=bench.geometry.centred, parallax=bench.parallax)
        self._factors = Factors(*sides, manifest, Status(Verdict.CALIBRATED, "Factors of the idealised camera"))
        fills = fills_well(bench.sensor, lit.light.simulation.physics.speckle)
        own = {SATURATION: fills, QUANTISATION: bench.sensor.bits is not None}
        self.effects = tuple(name for name in EFFECTS if name in self._ablation.effects or own.get(name, False))

    def image(self, on: frozenset[str]) -> Solution:
        off, light = frozenset(self.effects) - on, self.lit.light
        sensor, fraction = sensor_without(light.bench.sensor, off), Exposure().fraction
        fraction = fraction / _ROOM if SATURATION in off else fraction
        bench = replace(light.bench, devices=replace(light.bench.devices, sensor=sensor))
        request = light.plan.request
        assert request is not None
        options = request.with_values(patterns=self._patterns, seed=self._seed, exposure_fraction=fraction)
        shots = capture(SpectralBench(bench), options, lights=[self._ablation.without(off)]).runs[0]
        manifest = self._factors.manifest.model_copy(update={"camera": shots.manifest.camera})
        return reconstruct(shots, replace(self._factors, manifest=manifest))


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


# -------- The study

ALONE, IN_ORDER, LEFT_OUT = WAYS = ("alone", "in order", "left out")
_KEPT = 64
_IDEAL, _ASSUMED, _CALIBRATED = "idealised", "assumed", "calibrated"
_LAST = {"way": IN_ORDER, "effect": EFFECTS[-1]}


def _points(scope: Scope) -> Sequence[Point]:
    pictures = [name for name in scope.pictures if name in (*QUICK_IMAGES, None)] or list(scope.pictures)
    return [
        Point.of(replace(scope.setup, picture=name), patterns="dots:7", seed=seed, way=way, effect=effect)
        for name in scope.choose(pictures, pictures[:1])
        for seed in scope.repeats
        for way in scope.choose(WAYS, WAYS[:2])
        for effect in EFFECTS
    ]


def _measure(studio: Studio, point: Point) -> Found:
    setup, seed, patterns = point.setup, int(point["seed"]), str(point["patterns"])
    way, effect, lit = point["way"], str(point["effect"]), studio.lit_scene(setup)
    levels = studio.once("levels", 1, (setup, seed), lambda: Levels(lit, patterns, seed))

    def image(on: frozenset[str]) -> Solution:
        own = on & frozenset(levels.effects)
        return studio.once("images", _KEPT, (setup, seed, own), lambda: levels.image(own))

    ideal, without, having = map(image, (frozenset[str](), *ends(way, effect)))
    before, after = psnr(without.image, lit.truth), psnr(having.image, lit.truth)
    row = point.row(
        called_for=effect in levels.effects, ideal_db=psnr(ideal.image, lit.truth), without_db=before, with_db=after,
        change_db=after - before, **flags_of(having.status),
    )  # fmt: skip
    if (way, effect) != (IN_ORDER, EFFECTS[-1]):
        return Found((row,))
    calibrated = studio.image(setup, RENDERED, patterns, seed)
    kept = {_IDEAL: ideal.image, _ASSUMED: having.image, _CALIBRATED: calibrated.image, TRUTH: lit.truth}
    return Found(({**row, "calibrated_db": calibrated.quality.psnr_db},), single_precision(kept))


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
            "A calibrated camera keeps what the idealised model promises (2 dB lost at most)", {}, {}, where=_LAST,
            column="calibrated_db", other_column="ideal_db", at_least=-TOLERANCE_DB, apart=True,
        ),
        Gain(
            "A calibrated model is better than the idealised one", {}, {}, where=_LAST, column="calibrated_db",
            other_column="with_db", apart=True,
        ),
    ),
    panels=(
        Bars(
            "effect", file="waterfall", title="Change of PSNR by each effect that the scene has", x="change_db",
            x_label="change of PSNR [dB]", colour="way", where={"called_for": True},
        ),
        Images(
            {
                _IDEAL: ("idealised", "{ideal_db:.1f} dB"), _ASSUMED: ("rendered, model assumed", "{with_db:.1f} dB"),
                _CALIBRATED: ("rendered, model calibrated", "{calibrated_db:.1f} dB"),
            },
            before={TRUTH: "truth"}, down=("picture",), where=_LAST,
        ),
    ),
    about="An image of 49 dots, exposed at equal peak, from the idealised model (even light on a plane, the mask's "
    "geometric shadow, factors known) to rendered frames, one physical effect after the other. Model assumed: the "
    "solver keeps the idealised camera's factors. Model calibrated: it has factors of a session.",
    heads=("", "Before", "After"),
)  # fmt: skip
