"""Factors of fitted models beside measured ones, by the number of frames of the calibration session.

The camera is not built as it was to be: its mask is 50 um too far from the sensor, and 37 and -21 um off the axis. A
model starts from the plan and is fitted to the first frames of a session; measured factors need all patterns of it, and
more frames by taking each several times, or fewer by one uniform shot instead of a second half of each pair. Measured
factors have the noise of their session in closed form (:mod:`mitsim.calibrate.session_plan`), so one session is formed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from mitsim.api.bench import Bench
from mitsim.calibrate.board_session import Session
from mitsim.calibrate.lit_session import LitSession
from mitsim.calibrate.model import fit_placement, model_of, modelled_factors, simulate_responses
from mitsim.calibrate.session_plan import PredictedSession
from mitsim.core.job import Job
from mitsim.core.manifests import CalibrationManifest
from mitsim.devices.session import Modelling, SessionRecipe, load_recipe
from mitsim.reconstruct.factors import Factors
from mitsim.report import EQUAL_PEAK
from mitsim.report.lit_scene import LitScene
from mitsim.studies.framework.claims import Holds, Judged, choose_rows, distinct, mean_of, within
from mitsim.studies.framework.experiment import Found, Point, Scope, Setup, Study
from mitsim.studies.framework.panels import Lines
from mitsim.studies.framework.studio import Image, Studio, finding

if TYPE_CHECKING:
    from pandas import DataFrame

OFF_MM = {"mask_distance": 0.05, "mask_offset_row": 0.037, "mask_offset_column": -0.021}
"""How the camera differs from its plan: as a mask that is glued on by hand, under a microscope."""
PATTERNS = "dots:7"
MEASURED, WAVE, GEOMETRIC = FACTORS = ("measured", "wave", "geometric")
_FRAMES = (2, 4, 8, 16, 64)
"""That models are fitted to: uniform light alone, and up to a quarter of the stripes of a side."""
_MODES = {"uniform": 1, "pair": 1, "pair x 4": 4}
"""Repeats of measured sessions, by name."""
_EXPOSURES = (0.8, 0.01)
"""Of a session's brightest pixel, as parts of the full well: as bright as it may be, and a dim one."""
_SUFFICES_DB = 0.5
"""Below the most frames' image that measured factors have, an image that is as good."""


def _points(scope: Scope) -> Sequence[Point]:
    seeds = scope.choose((0, 1), scope.seeds[:1])
    return [
        Point.of(
            scope.setup.with_print(name),
            exposure_fraction=fraction,
            factors=factors,
            mode=mode,
            wanted=wanted,
            seed=seed,
        )
        for name in scope.choose(scope.pictures[:2], scope.pictures[:1])
        for fraction in scope.choose(_EXPOSURES, _EXPOSURES[:1])
        for factors in FACTORS
        for mode, wanted in (
            [(mode, 0) for mode in _MODES]
            if factors == MEASURED
            else [("pair", frames) for frames in scope.choose(_FRAMES, (2, 16))]
        )
        for seed in seeds
    ]


def as_built(bench: Bench) -> Bench:
    """The ``bench`` with its mask off its place by :data:`OFF_MM`."""
    camera = bench.geometry
    changed = camera.model_copy(update={name: getattr(camera, name) + off for name, off in OFF_MM.items()})
    return replace(bench, devices=replace(bench.devices, camera=changed))


def _recipe(point: Point) -> SessionRecipe:
    mode = str(point["mode"])
    change = {
        "exposure_fraction": point["exposure_fraction"],
        "signed_capture": mode.partition(" ")[0],
        "repeats": _MODES[mode],
    }
    return load_recipe().model_copy(update=change)


def _measure(studio: Studio, point: Point) -> Found:
    bench, seed, recipe = studio.bench(point.setup), int(point["seed"]), _recipe(point)
    lit = studio.once(
        "as built", 1, point.setup, lambda: LitScene(studio.lit_scene(point.setup).light.behind(as_built(bench)))
    )
    predicted = _session(studio, point.setup, recipe)
    reported: dict[str, Any] = {}
    if point["factors"] == MEASURED:
        factors = predicted.factors(recipe, seed)
        frames = predicted.by(recipe).session.shots
    else:
        session = predicted.by(recipe)
        factors = _model_factors(bench, replace(session, session=replace(session.session, seed=seed)), point)
        frames = int(factors.manifest.result["frames"])
        numbers = factors.manifest.result["parameters"]
        reported = {name: numbers[name]["value"] for name in ("mask_distance", "mask_shift_row", "mask_shift_column")}
        reported["unexplained"] = factors.manifest.result["unexplained_residual"]
    exposed = lit.rendered_frames(factors, lit.bench.family(PATTERNS), seed)
    image = Image.of(exposed, exposed.seconds(EQUAL_PEAK))
    return finding(studio, point, None, **image.row(), frames=frames, **reported)


def _session(studio: Studio, setup: Setup, recipe: SessionRecipe) -> PredictedSession:
    """The session of the camera as built, by a recipe's way of signed patterns; its light and responses are kept."""

    bench = studio.bench(setup)

    def form() -> PredictedSession:
        job = Job()
        planned = Session(bench, load_recipe(), 0)
        light = planned.trace(planned.plan(setup.accuracy, job), job)
        session = Session(as_built(bench), load_recipe(), 0)
        return PredictedSession.of(LitSession.of(session, light.behind(session.board), job), job)

    kept: PredictedSession = studio.once("session as built", 1, (bench.devices_digest, setup.accuracy), form)
    return PredictedSession(kept.by(recipe), kept.sums)


def _model_factors(bench: Bench, lit: LitSession, point: Point) -> Factors:
    """Factors of a model of the ``bench`` as planned, fitted to frames of the session ``lit``."""
    shown, frames = simulate_responses(lit, Modelling(point["factors"], int(point["wanted"])))
    camera = model_of(bench, point["factors"])
    fitted = fit_placement(camera, shown, Modelling(point["factors"]).free)
    manifest = CalibrationManifest(camera=bench.identity(), centre=bench.geometry.centred)
    return modelled_factors(camera, fitted, frames, manifest, Job())


def _suffices(rows: DataFrame, model: str) -> tuple[str, Holds]:
    """Judge whether a ``model`` of a few frames is as good as measured factors of the longest session."""
    measured_ = choose_rows(rows, {"factors": MEASURED})
    most = max(distinct(measured_, "frames"))
    longest, own = choose_rows(measured_, {"frames": most}), choose_rows(rows, {"factors": model})
    by_frames = {frames: choose_rows(own, {"frames": frames}) for frames in sorted(distinct(own, "frames"))}
    gains = {frames: mean_of(each, "psnr_db", longest) for frames, each in by_frames.items()}
    holds = {frames: within(gain, low=-_SUFFICES_DB) for frames, gain in gains.items()}
    few = next((frames for frames, each in holds.items() if each), max(gains))
    text = f"{mean_of(by_frames[few])} dB with {few} frames; measured factors {mean_of(longest)} dB with {most}"
    return f"{text}: {gains[few]:+} dB", True if holds[few] else None if None in holds.values() else False


STUDY = Study(
    "models",
    "Modelled factors against measured ones",
    "How few frames of a calibration session suffice?",
    points=_points,
    measure=_measure,
    claims=tuple(
        Judged(
            f"A few frames suffice for the {model} model, brightest pixel at {fraction:g} of the full well",
            partial(_suffices, model=model),
            where={"exposure_fraction": fraction},
            optional=True,  # a quick study has one exposure
        )
        for fraction in _EXPOSURES
        for model in (WAVE, GEOMETRIC)
    ),
    panels=(
        Lines(
            "frames",
            "frames of the calibration session [1]",
            title="PSNR by the frames of the calibration session",
            colour="factors",
            facet="exposure_fraction",
            names="brightest pixel at {} of the full well",
            log=True,
        ),
    ),
    about="PSNR of images with three kinds of factors. Measured: each number of them by a session of striped light. "
    "Wave and geometric: the closed-form shadow of the mask, with diffraction and without, whose distance, shift, "
    "rotation, magnification and gain are fitted to a few frames of that session. The mask is 50 um too far off and "
    "37 and 21 um beside its place. A session's brightest pixel fills the stated part of the full well; the images' "
    "frames are bright. Bars are one standard error over seeds. Frames are simulated with the very shadow that the "
    "wave model has: what a real mask has beside it only measured factors hold.",
    heads=("", "", "PSNR"),
)
