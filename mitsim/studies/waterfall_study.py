"""From the paper's idealised model of a scene to its rendered frames, one effect at a time: what each costs [dB].

Each effect three ways: *alone*, added to the idealised model; *in order*, added to it after all effects before it, so
that the steps add up to the whole; *left out* of the whole. The paper has no such figure.

The scene's own effects are taken out of its light (:mod:`mitsim.studies.ablation`). Besides there are three of the
camera: *saturation*, the full well and the end of the ADC; *quantisation*, its steps and its first number; and
*calibration noise*, what the noise of a session's frames leaves in the factors. Shot noise, read noise and dark current
are never off: the paper's model has such noise as well. A frame's exposure is that of equal peak with the effects on.

Images are made with the *model assumed*, the exact factors of the idealised camera, and with the *model calibrated*:
factors that a session before a white board is expected to give with the same effects, and calibration noise as that of
the real session with its seed. Everything on, frames and calibrated factors are those that a user gets, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from textwrap import wrap
from typing import Any

import numpy as np
from matplotlib.figure import Figure

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
from mitsim.report.pages import Mean, Table
from mitsim.report.plots import BLUE, FONT, GREEN, GREY, PALE, ROW, VERMILION, image_grid, label_axes, panels_of
from mitsim.studies import ablation
from mitsim.studies.ablation import Ablation
from mitsim.studies.framework.claims import TOLERANCE_DB, verdict, within
from mitsim.studies.framework.experiment import QUICK_IMAGES, TRUTH, Claim, Found, Point, Results, Scope
from mitsim.studies.framework.legacy import Experiment, difference
from mitsim.studies.framework.studio import Studio, flags_of, single_precision

# -------- A scene, its camera and names of effects in

SATURATION, QUANTISATION, CALIBRATION_NOISE = "saturation", "quantisation", "calibration noise"
EFFECTS = (
    ablation.FALLOFF, ablation.DIFFRACTION, ablation.KEYSTONE, ablation.DEPTH, ablation.OCCLUSION, ablation.DETAIL,
    ablation.INTERREFLECTION, ablation.MIRRORS, ablation.GLOSS, ablation.AMBIENT, ablation.BLACK_LEVEL,
    ablation.DEFOCUS, ablation.SPECKLE, SATURATION, CALIBRATION_NOISE, QUANTISATION, ablation.RENDER_NOISE,
)  # fmt: skip
"""In the order in which they are added: of the devices, of the scene, of light, of the camera, of the simulation."""
ASSUMED, CALIBRATED = MODELS = ("assumed", "calibrated")
_OF_SESSIONS = frozenset({ablation.FALLOFF, ablation.DIFFRACTION, ablation.KEYSTONE, ablation.DEFOCUS})
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
        self._ablation = Ablation(light, light.flux, light.flux, "calibration")
        self._lit = LitSession.of(self._session, light, job)
        self._kept: dict[frozenset[str], Estimate] = {}
        self._effects = _OF_SESSIONS & frozenset(self._ablation.effects)

    @cached_property
    def noisy(self) -> Factors:
        """Those of the real session, as :meth:`mitsim.bench.apparatus.Bench.calibrate` has them."""
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
        found, whole = self._estimate(off), self._estimate(frozenset())
        if not noise:
            return Factors.of(found, self._manifest)
        if not off & (self._effects | {ablation.BLACK_LEVEL}):
            return self.noisy
        noisy = self.noisy
        left = _align(found.left, whole.left) + _align(noisy.left, whole.left) - whole.left
        right = _align(found.right, whole.right) + _align(noisy.right, whole.right) - whole.right
        return replace(Factors.of(replace(found, left=left, right=right), self._manifest), manifest=noisy.manifest)

    def idealised_factors(self, sides: tuple[FloatArray, FloatArray]) -> Factors:
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

    def _estimate(self, off: frozenset[str]) -> Estimate:
        own = off & self._effects
        if own not in self._kept:
            self._kept[own] = self._by_lines(own)
        found, leak = self._kept[own], self._lit.light.simulation.physics.black_level
        # A +-1 pattern is the difference of two shots, in which what black pixels leak cancels, but white ones lose it.
        white = math.sqrt(1.0 - (0.0 if ablation.BLACK_LEVEL in off else leak))
        return replace(found, left=white * found.left, right=white * found.right)

    @single_threaded_blas()
    def _by_lines(self, off: frozenset[str]) -> Estimate:
        """From lines of the projector, each alone: what +-1 stripes come to without noise."""
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
    """Images of a scene with any of its effects.

    Parameters
    ----------
    lit, scene_ablation
        the scene, and its light.
    sessions
        of the camera.
    patterns, seed
        the family, and seed of the frames' noise.
    """

    def __init__(self, lit: LitScene, scene_ablation: Ablation, sessions: Sessions, patterns: str, seed: int) -> None:
        self.lit, self._ablation, self._sessions, self._patterns, self._seed = (
            lit,
            scene_ablation,
            sessions,
            patterns,
            seed,
        )
        camera = IdealCamera(lit.bench, lit.bench.geometry.mask)
        self._assumed = sessions.idealised_factors(camera.calibrated(float(lit.light.apparent.board_flux.mean())))
        fills = fills_well(lit.bench.sensor, lit.light.simulation.physics.speckle)
        own = {SATURATION: fills, QUANTISATION: lit.bench.sensor.bits is not None, CALIBRATION_NOISE: True}
        self.effects = tuple(name for name in EFFECTS if name in scene_ablation.effects or own.get(name, False))

    def images(self, on: frozenset[str]) -> Mapping[str, Solution]:
        """Reconstruct the scene by each model, with the effects ``on`` that the scene has."""
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


def _align(side: FloatArray, like: FloatArray) -> FloatArray:
    """A ``side`` with the sign of one that it should be ``like``: both sides turned round are the same camera."""
    return side if np.vdot(side, like) >= 0 else -side


# -------- From the paper's idealised model of a scene to its rendered frames, one effect at a time

PATTERNS = "dots:7"
ALONE, IN_ORDER, LEFT_OUT = WAYS = ("alone", "in order", "left out")
_FACTORS = {ASSUMED: "the idealised camera", CALIBRATED: "a session with the same effects"}
_SEEN_DB = 0.2
"""Change from which an effect is drawn: three deviations of what another draw of noise makes of two images' difference
(1 % of the squared error of 16384 pixels each, 0.05 dB)."""
_KEPT = 64
"""Levels of a scene that are kept: of 17 effects three ways, and the two ends."""


def _points(scope: Scope) -> Sequence[Point]:
    pictures = [name for name in scope.pictures if name in (*QUICK_IMAGES, None)] or list(scope.pictures)
    setups, ways = map(scope.setup.with_print, scope.choose(pictures, pictures[:1])), scope.choose(WAYS, WAYS[:2])
    fixed = {"patterns": (PATTERNS,)}
    return Point.grid(setups, "patterns seed way effect", seed=scope.repeats, way=ways, effect=EFFECTS, **fixed)


def _measure(studio: Studio, point: Point) -> Found:
    """What the effect changes, and the level that it comes to: without it, for one that is left out."""
    setup, seed, way, effect = point.setup, int(point["seed"]), point["way"], str(point["effect"])
    lit = studio.lit_scene(setup)
    scene_ablation = studio.once("ablation", 1, setup, lambda: Ablation.of(lit.light))
    stand = lit.bench.devices_digest, seed  # what a session sees, whatever is printed
    sessions = studio.once("sessions", 1, stand, lambda: Sessions(lit.bench, seed))
    levels = studio.once(
        "levels", 1, (setup, seed), lambda: Levels(lit, scene_ablation, sessions, str(point["patterns"]), seed)
    )

    def images(on: frozenset[str]) -> Mapping[str, Solution]:
        own = on & frozenset(levels.effects)
        return studio.once("images", _KEPT, (setup, seed, own), lambda: levels.images(own))

    without, having = (images(on) for on in ends(way, effect))
    rows = [
        point.row(
            model=model,
            called_for=effect in levels.effects,
            without_db=(before := psnr(without[model].image, lit.truth)),
            with_db=(after := psnr(having[model].image, lit.truth)),
            change_db=after - before,
            **flags_of(having[model].status),
        )
        for model in MODELS
    ]
    ends_of = {EFFECTS[0]: without, EFFECTS[-1]: having} if way == IN_ORDER else {}
    images_of = {model: found.image for model, found in ends_of.get(effect, {}).items()}
    kept = {**images_of, TRUTH: lit.truth} if images_of else {}
    return Found(tuple(rows), single_precision(kept))


def ends(way: str, effect: str) -> tuple[frozenset[str], frozenset[str]]:
    """Effects that are on without an ``effect`` and with it, one ``way``."""
    if way == ALONE:
        return frozenset(), frozenset({effect})
    if way == LEFT_OUT:
        return frozenset(EFFECTS) - {effect}, frozenset(EFFECTS)
    place = EFFECTS.index(effect)
    return frozenset(EFFECTS[:place]), frozenset(EFFECTS[: place + 1])


def fall(table: Table, model: str) -> Fall:
    """Levels and changes in one ``model`` of a ``table``, means over prints and seeds."""
    rows = table.where(model=model)
    found = [
        Step(
            effect,
            **{
                way.replace(" ", "_"): rows.mean("change_db", way=way, effect=effect)
                for way in WAYS
                if way in rows.distinct("way")
            },
        )
        for effect in EFFECTS
    ]
    first = rows.mean("without_db", way=IN_ORDER, effect=EFFECTS[0])
    return Fall(first, tuple(found), rows.mean("with_db", way=IN_ORDER, effect=EFFECTS[-1]))


def _claims(results: Results) -> Sequence[Claim]:
    assumed, calibrated = (fall(results.table, model) for model in MODELS)
    dearest = min(calibrated.steps, key=lambda step: step.in_order.value)
    ends = {model: results.table.where(model=model, way=IN_ORDER) for model in MODELS}
    last = {model: rows.where(effect=EFFECTS[-1]) for model, rows in ends.items()}
    lost = difference(ends[CALIBRATED].where(effect=EFFECTS[0]), last[CALIBRATED], "without_db", "with_db")
    gained = difference(last[CALIBRATED], last[ASSUMED], "with_db")
    return [
        Claim(
            "A calibrated camera keeps what the idealised model promises (2 dB lost at most)", "",
            f"{calibrated.first} dB", f"{calibrated.last} dB; largest step: {dearest.name}, {dearest.in_order} dB",
            verdict(within(lost, high=TOLERANCE_DB)),
        ),
        Claim(
            "A calibrated model is better than the idealised one", "", f"{assumed.last} dB assumed",
            f"{calibrated.last} dB calibrated", verdict(within(gained, low=0)),
        ),
    ]  # fmt: skip


def _figures(results: Results) -> Mapping[str, Figure]:
    panels = {f"model {model}: factors of {_FACTORS[model]}": fall(results.table, model) for model in MODELS}
    drawn = {"waterfall.png": waterfall(panels, seen=_SEEN_DB)}
    if images := _images(results):
        drawn["images.png"] = image_grid(images, ["truth", "idealised", "model assumed", "model calibrated"])
    return drawn


def _images(results: Results) -> dict[str, list[tuple[FloatArray, str]]]:
    """The truth, the idealised image and both rendered ones of each print, of the first seed."""
    grid = {}
    table = results.table.where(way=IN_ORDER)
    rendered = [(EFFECTS[-1], model, "with_db") for model in MODELS]
    columns = [(EFFECTS[0], CALIBRATED, "without_db"), *rendered]
    for name in (*table.distinct("picture"), None):
        cells = []
        for effect, model, column in columns:
            rows = table.where(picture=name, effect=effect, model=model).rows[:1]
            kept = ((results.array(row, model), f"{row[column]:.1f} dB") for row in rows)
            cells += [(image, caption) for image, caption in kept if image is not None]
        first = table.where(picture=name, effect=EFFECTS[0]).rows[:1]
        truths = [(truth, "") for row in first if (truth := results.array(row, TRUTH)) is not None]
        if truths and len(cells) == len(columns):
            grid[str(name or "scene")] = [*truths, *cells]
    return grid


# -------- Levels and steps as a figure

_MARGIN = 0.12
"""Of the scale, below the lowest level; twice that beside the highest one is room for a number."""
_LETTERS = 122
"""Of a line below a figure, small ones."""


@dataclass(frozen=True)
class Step:
    """Change [dB] that an effect called ``name`` brings: as a step in order, alone, and to the whole without it; None
    where one was not measured."""

    name: str
    in_order: Mean
    alone: Mean | None = None
    left_out: Mean | None = None

    @property
    def largest(self) -> float:
        """Of the three, by size [dB]."""
        return max(abs(mean.value) for mean in (self.in_order, self.alone, self.left_out) if mean)


@dataclass(frozen=True)
class Fall:
    """A waterfall: PSNR of a ``first`` and of a ``last`` level, and the ``steps`` between them."""

    first: Mean
    steps: tuple[Step, ...]
    last: Mean

    def step(self, name: str) -> Step:
        """That of the effect ``name``."""
        return next(step for step in self.steps if step.name == name)

    @property
    def levels(self) -> FloatArray:
        """(steps + 1,) PSNR [dB] before the first step and after each."""
        return self.first.value + np.cumsum([0.0, *(step.in_order.value for step in self.steps)])


def waterfall(panels: Mapping[str, Fall], seen: float) -> Figure:
    """Levels of PSNR from a first to a last one, a bar for each step, in panels below each other on one scale.

    Parameters
    ----------
    panels
        by their titles; the steps' names are the same in all.
    seen
        change [dB] from which a step has a row, if any panel has it; others are named below, and are one bar.
    """
    names = [step.name for step in next(iter(panels.values())).steps]
    change = {name: max(fall.step(name).largest for fall in panels.values()) for name in names}
    large = {name for name in names if change[name] >= seen}
    figure, places = panels_of(len(panels), 1, len(panels) * (ROW * (len(large) + 3) + 0.6) + 0.9, sharex=True)
    levels = np.concatenate([fall.levels for fall in panels.values()])
    low, room = levels.min(), max(np.ptp(levels), 1.0)
    places[0, 0].set_xlim(low - _MARGIN * room, levels.max() + 2 * _MARGIN * room)
    for axes, (title, fall) in zip(places[:, 0], panels.items(), strict=True):
        axes.set_title(title, fontsize=FONT, loc="left", fontweight="bold")
        _draw_fall(axes, fall, large)
        label_axes(axes, "PSNR [dB]" if axes is places[-1, 0] else "", "", grid="x")
    small = ", ".join(name for name in names if 0 < change[name] < seen)
    none = ", ".join(name for name in names if change[name] == 0)
    sentences = ["Changes of PSNR [dB] by each effect: bars in order, beside names alone and to the whole."]
    sentences += [f"Less than {seen:g} dB each, in the bar called others: {small}."] if small else []
    sentences += [f"Nothing at all, as the scene does not call for them: {none}."] if none else []
    lines = [line for sentence in sentences for line in wrap(sentence, _LETTERS)]
    figure.supxlabel("\n".join(lines), fontsize=FONT - 2, color=GREY, x=0.01, ha="left")
    return figure


def _draw_fall(axes: Any, fall: Fall, large: Collection[str]) -> None:
    """Bars of the steps that are ``large``, and one of all others, between those of both ends."""
    others = sum(step.in_order.value for step in fall.steps if step.name not in large)
    steps = [step for step in fall.steps if step.name in large]
    steps += [Step("others", Mean(others, np.nan, 1))] if others else []
    low, changes = axes.get_xlim()[0], [step.in_order.value for step in steps]
    levels = fall.first.value + np.cumsum([0.0, *changes])
    colours = [PALE, *(VERMILION if change < 0 else GREEN for change in changes), BLUE]
    starts, ends = [low, *levels[:-1], low], [fall.first.value, *levels[1:], fall.last.value]
    axes.barh(range(len(starts)), np.subtract(ends, starts), left=starts, color=colours)
    texts = [f"{fall.first} dB", *(_with_sign(step.in_order) for step in steps), f"{fall.last} dB"]
    for row, (end, text) in enumerate(zip(np.maximum(starts, ends), texts, strict=True)):
        axes.annotate(text, (end, row), (5, 0), textcoords="offset points", fontsize=FONT - 2, va="center")
    axes.set_yticks(range(len(starts)), ["idealised", *map(_step_name, steps), "rendered"])
    axes.invert_yaxis()


def _step_name(step: Step) -> str:
    ways = {"alone": step.alone, "left out": step.left_out}
    return ", ".join([step.name, *(f"{way} {_with_sign(mean)}" for way, mean in ways.items() if mean)])


def _with_sign(mean: Mean) -> str:
    return f"{mean:+}".replace("-", "\N{MINUS SIGN}")


EXPERIMENT = Experiment(
    "waterfall",
    "From the idealised model to rendered frames",
    "What does each physical effect cost in decibels: alone, in order, and left out of the whole?",
    _points, _measure, _claims, _figures,
    about="An image of 49 dots, exposed at equal peak, from the idealised model (even light on a plane, the mask's "
    "geometric shadow, factors known) to rendered frames, one physical effect after the other. Model assumed: the "
    "solver keeps the idealised camera's factors. Model calibrated: it has factors of a session with the same "
    "effects.",
    heads=("", "Before", "After"),
)  # fmt: skip
