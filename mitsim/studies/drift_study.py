"""Loss of an image by each kind of drift between calibration and capture, measured and predicted [dB].

*Measured*: noisy frames of the traced light are captured after the drift and solved with the factors and the lambda
from before it. *Predicted* (:mod:`mitsim.studies.causes`): the loss follows from the same factors and the closed-form
shadow of the paper's model, with the truth, the mean noise of a datum and, for lamps, the frame of their light.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mitsim.acquire import exposure
from mitsim.acquire.capture import trace_request
from mitsim.calibrate.board_session import Session
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import CAMERA, DEFAULT_CAMERA, locate, shipped_path
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import PatternFamily, read_name, stripe_signs
from mitsim.devices.sensor import load_sensor
from mitsim.devices.session import DRIFTS, SIDES, Drift, SessionRecipe, load_recipe
from mitsim.light.light import SampledLight
from mitsim.metrics import psnr
from mitsim.optics.shadow import SeparableTerms, ShadowGeometry
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.solver import Prepared, Solution
from mitsim.report import EQUAL_PEAK, RENDERED
from mitsim.report.lit_scene import NONUNIFORMITY, IdealCamera, LitScene, Unexposed, accumulate
from mitsim.sensor.chain import electrons_from_irradiance, ripple_response, specimen
from mitsim.studies.causes import Changed, Expected, Gains, LinearImage, Noise
from mitsim.studies.framework import experiment
from mitsim.studies.framework.claims import Gain, mean_of
from mitsim.studies.framework.panels import Bars, Images
from mitsim.studies.framework.studio import Studio, flags_of, single_precision

if TYPE_CHECKING:
    from pandas import DataFrame

AMBIENT, SESSION = "ambient frame", "session"
OFFSETS = "offset nonuniformity"
_SPLITS = 4
"""Rounds of the fit of rows' and columns' response; each leaves (s2 / s1)^2 of the map's singular values."""
_STEP_MM = 5e-4
"""Shift for a shadow's slope: a twentieth of a pixel."""
_HERMITE = ((-(3**0.5), 1 / 6), (0.0, 2 / 3), (3**0.5, 1 / 6))
"""Gauss-Hermite rule that is exact up to the fifth power: places [deviations] and weights."""


# -------- A drift between calibration and capture: its measured and its predicted effect


def loss_of(before_db: float, after_db: float, predicted_before_db: float, predicted_db: float) -> dict[str, float]:
    """Return the columns of a loss, from the PSNR without and with a drift, measured and predicted at one lambda.

    Added squared errors are predicted. The error of the prediction is its change if the image without drift were as
    predicted, because the model omits light.
    """
    added = squared_error(predicted_db) - squared_error(predicted_before_db)
    lost = 10 * math.log10(1 + added / squared_error(before_db))
    return {
        "before_db": before_db,
        "after_db": after_db,
        "lost_db": before_db - after_db,
        "predicted_before_db": predicted_before_db,
        "predicted_db": predicted_db,
        "predicted_lost_db": lost,
        "predicted_error_db": abs(predicted_before_db - predicted_db - lost),
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
        scene, model = lit or self.lit, self._model
        if session is not None:
            model = scene.rendered_frames(session, self.family, self.seed).prepare()
        bench = scene.bench
        moved = any(drift.mask_mm) or drift.motion is not None or drift.tilt_mrad is not None
        mask = exposure.drift_mask(bench, drift) if moved else None
        expected, base = scene.expected_frames(RENDERED, self.family, bench=mask), self._frames.exposer(self.exposure_s)
        ambient = expected.projector_off.irradiance if expected.has_ambient else 0.0
        shot = base.exposure_s, base.seed, base.speckle
        exposer = exposure.DriftedExposer(bench.devices, *shot, drift=drift, family=self.family, ambient=ambient)
        (sums,) = accumulate(exposer, self.family, expected, [model])
        image = model.solve(sums, self.before.lam).image
        still, predicted = (self.expected_image(each).psnr_db(self.lit.truth) for each in (Drift(), drift))
        return loss_of(self.before_db, psnr(image, scene.truth), still, predicted), image

    @property
    def before_db(self) -> float:
        return psnr(self.before.image, self.lit.truth)

    @cached_property
    def _frames(self) -> Unexposed:
        return self.lit.rendered_frames(self.factors, self.family, self.seed)

    @cached_property
    def exposure_s(self) -> float:
        return self._frames.seconds(EQUAL_PEAK)

    @cached_property
    def _model(self) -> Prepared:
        return self._frames.prepare()

    @cached_property
    def before(self) -> Solution:
        return self._frames.solve(self.exposure_s)

    def session_mixes(self, drift: Drift) -> tuple[FloatArray, FloatArray]:
        """Return the (n, n) matrices that multiply the factors on the right as a session's power drifts.

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
        return scale * found[0], scale * found[1]

    def expected_image(self, drift: Drift) -> Expected:
        image, changed = self.linear, self._frame_changes(drift)
        if drift.session_ramp or drift.session_flicker:
            left, right = self.session_mixes(drift)
            image = replace(image, left=self.factors.left @ left, right=self.factors.right @ right)
            others = [(self.factors.left, self.factors.right), (-image.left, image.right)]
            changed = replace(changed, terms=[*changed.terms, *others])
        return image.expected_image(self.lit.truth, changed, sum(self.noises.values(), Noise()))

    @cached_property
    def fixed(self) -> Mapping[str, FloatArray]:
        """Return the contribution (n, n) of each kind of difference between pixels to the image."""
        still = self.linear.expected_image(self.lit.truth).image
        alone = {NONUNIFORMITY: Changed(response=self._response), OFFSETS: Changed(added=self._fixed_frame)}
        return {name: self.linear.expected_image(self.lit.truth, each).image - still for name, each in alone.items()}

    def clear(self, factors: Factors, light: SampledLight) -> FloatArray:
        return LitScene(light).rendered_frames(factors, self.family, self.seed).clear(self.linear.lam)

    @cached_property
    def linear(self) -> LinearImage:
        factors = self.factors
        return LinearImage(factors.left, factors.right, self.family, self.before.lam, factors.manifest.centre)

    @cached_property
    def noises(self) -> Mapping[str, Noise]:
        frames = self._frames.noises(self.exposure_s)
        found = {name: Noise(datum=variance) for name, variance in frames.items() if name != NONUNIFORMITY}
        if exposure.takes_ambient_frame("auto", self.family, self._frames.expected):
            exposer = self._frames.exposer(self.exposure_s)
            off = exposer.electrons(self._frames.expected.projector_off)
            variance = (exposer.sensor_noise(off) / self.exposure_s) ** 2 / exposure.ambient_shots(self.family)
            found[AMBIENT] = Noise(ambient=variance)
        if known := self.factors.manifest.noise:
            found[SESSION] = Noise(left=known.left**2, right=known.right**2)
        return found

    def _frame_changes(self, drift: Drift) -> Changed:
        count = self.family.left.shape[1], self.family.right.shape[1]
        black = self.lit.light.simulation.physics.black_level
        ramp = exposure.levels(self.seed, "power", len(self.family.shots), drift.power_ramp).reshape(*count, -1)
        gain = (1 + drift.exposure) * (1 + drift.power) * ramp
        changed = Changed(
            terms=self._terms(drift),
            leak=black / (1 - black),  # as a part of a session's light, which lacks the leak of black pixels
            gain=gain.mean(axis=2),
            gain_apart=(gain[:, :, 0] - gain[:, :, -1]) / 2,
            flicker=self._gains(drift, "power", drift.power_flicker),
            response=self._response,
        )
        # An ambient frame holds black level, dark current and offsets too.
        if self._frames.expected.has_ambient:
            exposer = self._frames.exposer(1.0)
            lamps = exposer.electrons(self._frames.expected.projector_off)
            each = self._gains(drift, "lamp", drift.lamp_flicker)
            common = [rms / exposure.ambient_shots(self.family) ** 0.5 for rms in each]
            return replace(changed, added=lamps, added_gain=drift.lamp, added_flicker=each, added_common=common)
        sensor = self.lit.bench.sensor
        dark = exposure.warmer(sensor, drift.temperature_k).superpixel_dark_current_e_per_s * (1 + drift.exposure)
        offset = drift.black_level_dn * sensor.codes / sensor.gain_dn_per_e / self.exposure_s
        frame = np.full(self.lit.bench.geometry.frame_shape, offset + dark - sensor.superpixel_dark_current_e_per_s)
        return replace(changed, added=frame if self._fixed_frame is None else frame + self._fixed_frame)

    @cached_property
    def _response(self) -> FloatArray | None:
        """Return the relative differences (m, m') between the pixels' responses and the factors."""
        response = specimen(self.lit.bench.sensor, self.lit.bench.geometry.frame_shape).response
        if response is None:
            return None
        left, right = (np.square(side.sum(axis=1)) for side in (self.factors.left, self.factors.right))
        columns = np.ones(response.shape[1])
        for _ in range(_SPLITS):
            rows = response @ (right * columns) / (right * np.square(columns)).sum()
            columns = response.T @ (left * rows) / (left * np.square(rows)).sum()
        return np.asarray(response / np.outer(rows, columns) - 1)

    @cached_property
    def _fixed_frame(self) -> FloatArray | None:
        """Return readings (m, m') beyond those that a user subtracts without an ambient frame [electrons/s]."""
        sensor, shape = self.lit.bench.sensor, self.lit.bench.geometry.frame_shape
        own = specimen(sensor, shape)
        if (own.offset_e is None and own.dark_e_per_s is None) or self._frames.expected.has_ambient:
            return None
        frame = np.zeros(shape) if own.offset_e is None else own.offset_e.astype(np.float64) / self.exposure_s
        return frame if own.dark_e_per_s is None else frame + own.dark_e_per_s - sensor.superpixel_dark_current_e_per_s

    def _gains(self, drift: Drift, source: str, rms: float) -> Gains:
        found: list[float | FloatArray] = [rms] if rms else []
        if source in drift.ripples:
            amplitude, hertz = drift.ripples[source]
            seconds, (rows, _) = self.exposure_s * (1 + drift.exposure), self.lit.bench.geometry.frame_shape
            wave = amplitude / 2**0.5 * ripple_response(self.lit.bench.sensor, seconds, hertz, rows)
            found += [wave.real, wave.imag]
        return found

    def _terms(self, drift: Drift) -> SeparableTerms:
        """Return the terms that a drift of mask or projector adds to the calibrated factors' one [electrons/s]."""
        bench, (left, right) = self.lit.bench, self._ideal(Drift()).factors
        at_rest = drift.model_copy(update={"mask_rotation_mrad": 0.0, "vibration_um": 0.0})
        found = [*self._ideal(at_rest).terms, (-left, right)]
        if drift.vibration_um:
            # The mean shadow of a normal motion along both axes at once.
            shifted = [self._shift(place * drift.vibration_um / 1e3) for place, _ in _HERMITE]
            for terms in zip(*shifted, strict=True):
                sides = zip(*terms, strict=True)
                left, right = (sum(w * one for (_, w), one in zip(_HERMITE, side, strict=True)) for side in sides)
                found.append((np.asarray(left), np.asarray(right)))
            found += [(-left, right) for left, right in self._shift(0.0)]
        if drift.mask_rotation_mrad:
            found += self._turn(drift.mask_rotation_mrad / 1e3)
        wavelength_nm = bench.projector.effective_wavelength_nm
        rate = float(electrons_from_irradiance(self.lit.board_flux, 1.0, bench.sensor, wavelength_nm))
        return [(rate * left, right) for left, right in found]

    def _turn(self, angle: float) -> SeparableTerms:
        """Return the shadow's change to first order in the ``angle``: theta (s_col d/d s_row - s_row d/d s_col)."""
        geometry, axes = self.lit.bench.geometry, enumerate(self._ideal(Drift()).directions)
        shadow = ShadowGeometry.of(geometry, geometry.scene_distance)
        row, column = (shadow.along(axis).crossings(each) - geometry.mask_offset[axis] for axis, each in axes)
        found: SeparableTerms = []
        terms = zip(*(self._shift(shift) for shift in (0.0, _STEP_MM, -_STEP_MM)), strict=True)
        for (left, right), ahead, behind in terms:
            down, across = ((after - before) / (2 * _STEP_MM) for after, before in zip(ahead, behind, strict=True))
            found += [(angle * down, column * right), (-angle * row * left, across)]
        return found

    def _shift(self, by_mm: float) -> SeparableTerms:
        return self._ideal(Drift(mask_rows_um=-1e3 * by_mm, mask_columns_um=-1e3 * by_mm)).terms

    def _ideal(self, drift: Drift) -> IdealCamera:
        bench = exposure.drift_projector(exposure.drift_mask(self.lit.bench, drift), drift)
        return IdealCamera(bench, bench.geometry.mask, self.lit.light.simulation.physics.spectrum)


def squared_error(db: float) -> float:
    return float(10 ** (-db / 10))


# -------- Each kind of drift alone: the decibels that it costs

_SEEDS = 4
"""Seeds of noise and random drifts."""
_LAMPS = ("lamp", "lamp_flicker", "lamp_ripple")
_LAMP_SCENE, _LAMP = "lamp_bench", "11.7"
"""Default scene of lamps' drifts, whose lamp is a tenth as bright on the sheet as the projector."""
_BEFORE = "without the drift"
_LINES, _ERRORS = {"lost_db": "measured", "predicted_lost_db": "predicted"}, {"predicted_lost_db": "predicted_error_db"}
_LEAST = 1e-3
"""Least part by which a drift adds to the squared error for an extrapolation; less is rounding."""
AGREE_DB = 0.5
"""Largest useful difference [dB] between predicted and measured loss."""


def _points(scope: experiment.Scope) -> Sequence[experiment.Point]:
    recipe, first = recipe_of(scope.recipe), scope.seeds[0]
    drift, sweep = recipe.drift, dict(scope.sweep)
    read_name(scope.patterns)
    numbers = [(kind, experiment.number_of(kind, text)) for kind, texts in sweep.items() for text in texts]
    asked = [(kind, drift.alone(kind, number)) for kind, number in numbers]
    alone = asked if sweep else [(kind, drift) for kind in drift.kinds]
    amounts = [(kind, getattr(each, kind)) for kind, each in alone]
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
            setup, what = lamp if kind in _LAMPS else sheet, f"{words}, {_size(amount, unit)}"
            found.append(experiment.Point.of(setup, **shared, unit=unit, amount=amount, seed=seed, what=what))
    return experiment.group_by_setup(found)


def recipe_of(path: str | None) -> SessionRecipe:
    """Return the recipe at ``path``, or the shipped one; MitsimError as :func:`load_recipe`."""
    return load_recipe(shipped_path("calibration", "drift.toml") if path is None else Path(path))


def _measure(studio: Studio, point: experiment.Point) -> experiment.Found:
    setup, seed, kind = point.setup, int(point["seed"]), str(point["kind"])
    recipe, lit = recipe_of(point["recipe"]), studio.lit_scene(setup)
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
    "How many decibels does each kind of drift cost, and do closed forms say so?",
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
    "over sessions and noise. Predicted: closed forms of these factors, the truth and the mean noise; no frame is "
    "formed. Their uncertainty, the bars of the figure, is what they leave out of the image without a drift, such as "
    "detail inside projector pixels.",
    heads=("", "Predicted", "Measured"),
)
