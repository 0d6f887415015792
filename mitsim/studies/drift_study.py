"""Loss of an image by each kind of drift between calibration and capture, measured and predicted [dB].

*Measured*: noisy frames of the traced light are captured after the drift and solved with the factors and the lambda
from before it. *Predicted*: frames without noise are formed from these factors and the truth, with the change that the
drift makes in the paper's closed-form shadow, and are data of :class:`mitsim.design.predictor.Predictor`, which adds
the noise. Random gains add the energy of each frame's own part of the image, as the solver is linear at one lambda.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from mitsim.acquire import exposure
from mitsim.acquire.capture import trace_request
from mitsim.calibrate.board_session import Session
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import CAMERA, DEFAULT_CAMERA, locate
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import single_threaded_blas
from mitsim.design.predict import noise_of
from mitsim.design.predictor import Camera, Predictor, Scene, decibels, seen_frame
from mitsim.devices.patterns import PatternFamily, read_name, stripe_signs
from mitsim.devices.sensor import load_sensor
from mitsim.devices.session import DRIFTS, SIDES, Drift, SessionRecipe, load_recipe
from mitsim.light.light import SampledLight
from mitsim.metrics import psnr
from mitsim.optics.shadow import SeparableTerms
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.solver import Pair, Prepared, Solution
from mitsim.report import EQUAL_PEAK, RENDERED
from mitsim.report.lit_scene import IdealCamera, LitScene, Unexposed, accumulate
from mitsim.sensor.chain import ripple_response
from mitsim.studies.framework import experiment
from mitsim.studies.framework.claims import Gain, mean_of
from mitsim.studies.framework.panels import Bars, Images
from mitsim.studies.framework.studio import Studio, flags_of, single_precision

if TYPE_CHECKING:
    from pandas import DataFrame


# -------- A drift between calibration and capture: its measured and its predicted effect


def loss_of(before_db: float, after_db: float, still: float, drifted: float) -> dict[str, float]:
    """Return the columns of a loss: measured PSNR, and predicted mean squared errors, without and with a drift.

    The added squared error is predicted. The error of the prediction is its change if the image without drift were as
    predicted, because the model omits light.
    """
    lost = 10 * math.log10(1 + (drifted - still) * 10 ** (before_db / 10))
    return {
        "before_db": before_db,
        "after_db": after_db,
        "lost_db": before_db - after_db,
        "predicted_before_db": decibels(still),
        "predicted_db": decibels(drifted),
        "predicted_lost_db": lost,
        "predicted_error_db": abs(decibels(still) - decibels(drifted) - lost),
    }


@dataclass(frozen=True, eq=False)
class DriftStand:
    """A scene, a camera that was calibrated before any drift, and patterns."""

    lit: LitScene
    factors: Factors
    recipe: SessionRecipe
    family: PatternFamily
    seed: int

    def outcome(
        self, drift: Drift, session: Factors | None = None, lit: LitScene | None = None
    ) -> tuple[dict[str, float], FloatArray]:
        """Return the columns of a drift's loss and the image with it; MitsimError for one that the bench cannot have.

        ``session`` are factors that drifted, ``lit`` is the scene in light of a moved projector.
        """
        scene, model = lit or self.lit, self.model
        if session is not None:
            model = scene.rendered_frames(session, self.family, self.seed).prepare()
        expected = scene.expected_frames(RENDERED, self.family, bench=exposure.drift_mask(scene.bench, drift))
        ambient = expected.projector_off.irradiance if expected.has_ambient else 0.0
        state = scene.bench.devices, self.exposure_s, self.seed, self.lit.light.speckle(self.family)
        exposer = exposure.DriftedExposer(*state, drift=drift, family=self.family, ambient=ambient)
        (sums,) = accumulate(exposer, self.family, expected, [model])
        image = model.solve(sums, self.before.lam).image
        still, drifted = map(self.predicted, (Drift(), drift))
        return loss_of(self.before_db, psnr(image, scene.truth), still, drifted), image

    @property
    def before_db(self) -> float:
        return psnr(self.before.image, self.lit.truth)

    @cached_property
    def frames(self) -> Unexposed:
        return self.lit.rendered_frames(self.factors, self.family, self.seed)

    @cached_property
    def exposure_s(self) -> float:
        return self.frames.seconds(EQUAL_PEAK)

    @cached_property
    def model(self) -> Prepared:
        return self.frames.prepare()

    @cached_property
    def before(self) -> Solution:
        return self.frames.solve(self.exposure_s)

    def clear(self, factors: Factors, light: SampledLight) -> FloatArray:
        return LitScene(light).rendered_frames(factors, self.family, self.seed).clear(self.before.lam)

    # ---- Prediction

    @single_threaded_blas()
    def predicted(self, drift: Drift) -> float:
        """Return the expected mean squared error of the image after a ``drift``, at the lambda from before it."""
        sides = self.factors.left, self.factors.right
        if drift.session_ramp or drift.session_flicker:
            sides = self.session_factors(drift)
        camera = Camera(sides, sides, [sides], self.factors.manifest.centre)
        patterns = self.family.left.astype(np.float64), self.family.right.astype(np.float64)
        known = self.factors.manifest.noise
        factors = (known.left, known.right) if known else (0.0, 0.0)
        noise = noise_of(self.lit.bench, self.family, self.exposure_s, factors, self._lamps)
        predictor = Predictor(camera, patterns, Scene(self.lit.truth), noise)
        predictor.seen, spread = self.data(predictor.prepared, drift)
        return predictor.errors(self.before.lam).total + spread / self.lit.truth.size

    def session_factors(self, drift: Drift) -> Pair:
        """Return the factors of a session whose power drifts.

        The response to stripes h_i is a difference of shots of powers a and b, so that it is one to ``h_i (a + b) / 2 +
        (a - b) / 2``: the factor is Phi C with ``C = (H diag((a + b) / 2) + 1 ((a - b) / 2)^T) H^T / N``. The responses
        to uniform light scale the vector that all responses of a side share, hence the root of their mean power.
        """
        signs = stripe_signs(self.family.n).astype(np.float64)
        powers = Session(self.lit.bench, self.recipe.model_copy(update={"drift": drift}), self.seed).powers
        found, first = [], []
        for side in SIDES:
            shots = np.array([powers[side, number].mean() for number in range(len(powers) // 2)])
            even, odd = (shots[::2] + shots[1::2]) / 2, (shots[::2] - shots[1::2]) / 2
            found.append((signs * even + odd) @ signs.T / signs.shape[1])
            first.append(even[0] + odd[0])
        scale = float(np.mean(first)) ** -0.5
        return self.factors.left @ (scale * found[0]), self.factors.right @ (scale * found[1])

    def data(self, model: Prepared, drift: Drift) -> tuple[FloatArray, float]:
        """Return the data (r, r') of frames after a ``drift`` without noise, and the image's energy by random gains.

        Both are of the :attr:`factors` in the capture, and of a ``model`` of factors whose session may have drifted.
        """
        shots, lamps, truth = self.family.shots, self._lamps, self.lit.truth
        terms = [(self.factors.left, self.factors.right), *self._terms(drift)]
        gain = model.gain(self.before.lam)
        # Part of a session's light, which lacks the leak of black pixels.
        black = self.lit.light.simulation.physics.black_level
        leak = black / (1 - black) * seen_frame(terms, truth)
        power, lamp = self._gains(drift, "power", drift.power_flicker), self._gains(drift, "lamp", drift.lamp_flicker)
        ramp = exposure.levels(self.seed, "power", len(shots), drift.power_ramp)
        seen, varying, added = np.zeros_like(gain), 0.0, self._added(drift)
        for shot, level in zip(shots, (1 + drift.exposure) * (1 + drift.power) * ramp, strict=True):
            pattern, sign = (shot.row, shot.column), -1 if shot.sign < 0 else 1
            places, lit = model.places(pattern), seen_frame(terms, self.family.light(shot) * truth) + leak
            seen[places] += sign * model.weights(level * lit + added, pattern)
            for varied in (*(rms * lit for rms in power), *(rms * lamps for rms in lamp if lamps is not None)):
                varying += float(np.square(gain[places] * model.weights(varied, pattern)).sum())
        if lamps is not None and not self.family.signed:
            for rms in lamp:  # in the ambient frame, which all frames lose
                common = model.left.common.T @ (rms * lamps) @ model.right.common
                varying += float(np.square(gain * common).sum()) / exposure.ambient_shots(self.family)
        return seen, varying

    @cached_property
    def _lamps(self) -> FloatArray | None:
        expected = self.frames.expected
        return self.frames.exposer(1.0).electrons(expected.projector_off) if expected.has_ambient else None

    def _added(self, drift: Drift) -> FloatArray | float:
        """Return what a ``drift`` adds to every frame [electrons / s]; an ambient frame holds dark current as well."""
        if self._lamps is not None:
            return drift.lamp * self._lamps
        sensor = self.lit.bench.sensor
        dark = exposure.warmer(sensor, drift.temperature_k).superpixel_dark_current_e_per_s * (1 + drift.exposure)
        offset = drift.black_level_dn * sensor.codes / sensor.gain_dn_per_e / self.exposure_s
        return offset + dark - sensor.superpixel_dark_current_e_per_s

    def _gains(self, drift: Drift, source: str, rms: float) -> list[float | FloatArray]:
        """Return the root mean squares of a ``source``'s independent gains: of a whole frame, or (m, 1) of its rows."""
        found: list[float | FloatArray] = [rms] if rms else []
        if source in drift.ripples:
            amplitude, hertz = drift.ripples[source]
            seconds, (rows, _) = self.exposure_s * (1 + drift.exposure), self.lit.bench.geometry.frame_shape
            wave = amplitude / 2**0.5 * ripple_response(self.lit.bench.sensor, seconds, hertz, rows)[:, None]
            found += [wave.real, wave.imag]  # its cosine and its sine
        return found

    def _terms(self, drift: Drift) -> SeparableTerms:
        """Return the terms that the mask's shadow has after a ``drift`` beside the calibrated one [electrons / s]."""
        bench = exposure.drift_projector(exposure.drift_mask(self.lit.bench, drift), drift)
        spectrum, flux = self.lit.light.simulation.physics.spectrum, self.lit.board_flux
        still, moved = (IdealCamera(each, each.geometry.mask, spectrum) for each in (self.lit.bench, bench))
        left, right = still.calibrated(flux)
        return [*(moved.calibrated(flux, term) for term in moved.terms), (-left, right)]


# -------- Each kind of drift alone: the decibels that it costs

_SEEDS = 4
"""Seeds of noise and random drifts."""
_LAMP_SCENE, _LAMP = "lamp_bench", "11.7"
"""Default scene of lamps' drifts, whose lamp is a tenth as bright on the sheet as the projector."""
_BEFORE = "without the drift"
_LINES, _ERRORS = {"lost_db": "measured", "predicted_lost_db": "predicted"}, {"predicted_lost_db": "predicted_error_db"}
_LEAST = 1e-3
"""Least part by which a drift adds to the squared error for an extrapolation; less is rounding."""
AGREE_DB = 0.5
"""Largest useful difference [dB] between predicted and measured loss."""


def _points(scope: experiment.Scope) -> Sequence[experiment.Point]:
    recipe, first = load_recipe(scope.recipe or "drift"), scope.seeds[0]
    read_name(scope.patterns)
    asked = [(kind, experiment.number_of(kind, text)) for kind, texts in scope.sweep for text in texts]
    alone = asked or [(kind, getattr(recipe.drift, kind)) for kind in recipe.drift.kinds]
    amounts = [(kind, getattr(recipe.drift.alone(kind, number), kind)) for kind, number in alone]
    if not amounts:
        raise MitsimError(f"study drift: the table [drift] of {scope.recipe} moves nothing; give amounts in it")
    if recipe.signed_capture != "pair" and any(kind.startswith("session") for kind, _ in amounts):
        raise MitsimError('study drift: drift of a session is studied for signed_capture = "pair"; change the recipe')
    if any(kind.endswith("ripple") for kind, _ in amounts):  # refused before any light is traced
        load_sensor(locate(scope.setup.camera or DEFAULT_CAMERA, "calibration", ".toml", CAMERA)).known_line_time_s()
    sheet = lamp = scope.setup
    if scope.pictures != (None,):
        sheet = replace(scope.setup, picture=experiment.TEST_IMAGES[0])
        lamp = replace(sheet, scene=_LAMP_SCENE).with_parameters(lamp=_LAMP)
    found = []
    for seed in scope.choose(range(first, first + _SEEDS), scope.seeds):
        for kind, amount in amounts:
            (unit, words), shared = DRIFTS[kind], {"recipe": scope.recipe, "patterns": scope.patterns, "kind": kind}
            setup, what = lamp if kind.startswith("lamp") else sheet, f"{words}, {_size(amount, unit)}"
            found.append(experiment.Point.of(setup, **shared, unit=unit, amount=amount, seed=seed, what=what))
    return experiment.group_by_setup(found)


def _measure(studio: Studio, point: experiment.Point) -> experiment.Found:
    setup, seed, kind = point.setup, int(point["seed"]), str(point["kind"])
    recipe, lit = load_recipe(point["recipe"] or "drift"), studio.lit_scene(setup)
    drift = recipe.drift.alone(kind, float(point["amount"]))

    def calibrate(drift: Drift) -> Factors:
        own = recipe.model_copy(update={"drift": drift, "source": ""})
        if own == load_recipe().model_copy(update={"source": ""}):
            return studio.factors(setup, seed)
        return studio.bench(setup).calibrate(seed=seed, recipe=own)

    known = studio.once(
        "drift", 1, (setup, point["recipe"], point["patterns"], seed),
        lambda: DriftStand(lit, calibrate(Drift()), recipe, lit.bench.family(point["patterns"], seed), seed),
    )  # fmt: skip
    session, moved = calibrate(drift) if kind.startswith("session") else None, None
    if kind.startswith("projector"):
        # By the same plan, so that errors of plans cancel.
        moved = studio.once(
            "moved projector", 6, (setup, drift),
            lambda: LitScene(trace_request(exposure.drift_projector(lit.bench, drift), lit.light.plan)),
        )  # fmt: skip
    measured, image = known.outcome(drift, session, moved)
    others = (*lit.light.warnings, *lit.light.unreached, *known.factors.warnings)
    flags = flags_of(known.before.status, others=others)
    shown = {experiment.IMAGE: image, _BEFORE: known.before.image, experiment.TRUTH: lit.truth}
    return experiment.Found((point.row(**measured, **flags),), single_precision(shown))


def three_decibels(rows: DataFrame) -> str:
    """Return the amount of a drift at which 3 dB are lost: squared errors grow with the square of the amount."""
    added = 10 ** (mean_of(rows, "lost_db").value / 10) - 1
    if added < _LEAST:
        return ", too little to say when 3 dB are lost"
    amount = abs(float(rows["amount"].iloc[0])) * ((10**0.3 - 1) / added) ** 0.5
    return f", 3 dB at about {_size(float(f'{amount:.2g}'), str(rows['unit'].iloc[0]))}"


def _size(amount: float, unit: str) -> str:
    return f"{100 * amount:g} %{unit[1:]}" if unit.startswith("1") else f"{amount:g} {unit}"


STUDY = experiment.Study(
    "drift",
    "What drifts between calibration and capture",
    "How many decibels does each kind of drift cost, and is that predicted?",
    points=_points,
    measure=_measure,
    claims=(
        Gain(
            f"{{what}}: loss predicted within {AGREE_DB:g} dB",
            {},
            {},
            each="what",
            column="lost_db",
            other_column="predicted_lost_db",
            other_error="predicted_error_db",
            unit="dB lost",
            at_least=-AGREE_DB,
            at_most=AGREE_DB,
            apart=True,
            note=three_decibels,
        ),
    ),
    panels=(
        Bars("what", file="losses", colour=_LINES, x_label="PSNR lost [dB]", ordered=True, errors=_ERRORS),
        Images(
            {_BEFORE: (_BEFORE, "{before_db:.1f} dB"), experiment.IMAGE: ("with it", "{after_db:.1f} dB")},
            before={experiment.TRUTH: "truth"},
            down=("what",),
        ),
    ),
    about="PSNR that an image loses when one thing moves after the calibration. Measured: frames after the drift, "
    "solved with the factors and lambda from before it, against the same noise without the drift; one standard error "
    "over sessions and noise. Predicted: the image of these factors' frames, the shadow's change and the mean noise; "
    "nothing is drawn. Their uncertainty, the bars of the figure, is what they leave out of the image without a drift, "
    "such as detail inside projector pixels.",
    heads=("", "Predicted", "Measured"),
)
