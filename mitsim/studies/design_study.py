"""Gain of a designed mask over the best simple mask, against dose and number of frames, predicted and rendered.

At each point a mask is searched (:func:`mitsim.design.masks.run_search`) and proved beside simple masks of the same
exposure and search budget (:func:`mitsim.studies.mask_design.prove`). Each seed has its own search, session and noise.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace

from mitsim.core.job import Job
from mitsim.design.goal import Goal
from mitsim.design.masks import run_search, searches, stand_of, write_camera
from mitsim.report import RENDERED
from mitsim.report.pages import Value
from mitsim.studies.framework.claims import Gain, Level
from mitsim.studies.framework.experiment import TRUTH, Axes, Found, Point, Scope, Study
from mitsim.studies.framework.panels import Images, Lines, Pivot
from mitsim.studies.framework.studio import Studio, flags_of, single_precision
from mitsim.studies.mask_design import prove

PREDICTED = "predicted"
DESIGN, _, PINHOLES, LONGEST = MASKS = "design", "random", "pinholes", "maximum length sequence"
MANY = "dots:7"
_DOSES = 1.0, 0.1, 0.01, 0.001
BRIGHT, TENTH = _DOSES[:2]
AGREE_DB = 0.5
_ACCURACY = 3e-4
"""Sampling error that costs images of 50 dB less than 0.1 dB; that of 1e-3 costs 0.4 dB."""
_CAPTURES = 2
"""Captures of each mask, whose mean counts."""
_MODELS = ("model", PREDICTED, RENDERED)


def _points(scope: Scope) -> list[Point]:
    few = {(MANY, BRIGHT), (MANY, TENTH), ("dots:3", TENTH)}
    axes = Axes(
        {
            "patterns": ("uniform", "dots:2", "dots:3", "dots:4", "dots:5", MANY),
            "dose": _DOSES,
            "evaluations": (400,),
        },
        quick={"evaluations": (60,)},
        prints=(None,),
        kept=lambda values: not scope.quick or (values["patterns"], values["dose"]) in few,
    )
    camera = scope.setup.camera or ("small" if scope.quick else None)
    setup = replace(scope.setup, camera=camera, accuracy=min(scope.setup.accuracy, _ACCURACY))
    return axes(replace(scope, setup=setup, seeds=replace(scope, quick=False).repeats))


def measure(studio: Studio, point: Point) -> Found:
    """Search a mask, and return predicted and rendered PSNR of it and of simple masks."""
    setup, patterns, seed, job = point.setup, str(point["patterns"]), int(point["seed"]), Job()
    bench = studio.bench(setup)
    stand = studio.once("stand", 1, setup, lambda: stand_of(bench, 0))
    own = studio.once("exposure", 6, (setup, patterns), lambda: bench.predict(patterns))
    goal = Goal(
        scene=setup.scene,
        camera=setup.camera,
        patterns=(patterns,),
        exposure_total_s=point["dose"] * own.frames * own.exposure_s,
        feature_um=(1e3 * bench.geometry.mask_feature,),
        starts=2,
        evaluations=point["evaluations"],
        seed=_CAPTURES * seed,
        seeds=_CAPTURES,
        accuracy=setup.accuracy,
    )
    folder, proved = studio.folder(point.key), []
    for each in run_search(goal, folder, job, searches(stand, goal))[0]:
        file = write_camera(folder / each.name.replace(" ", "_"), bench, each)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the bench has said which pixels it has
            own_bench = studio.bench(replace(setup, camera=str(file)))
        proved.append(prove(goal, each, file, job, own_bench))
    rows = list[Mapping[str, Value]]()
    for model, levels in (
        (PREDICTED, [each.predicted for each in proved]),
        (RENDERED, [each.rendered for each in proved]),
    ):
        for each, level in zip(proved, levels, strict=True):
            row = point.row(mask=each.name, model=model, psnr_db=level, frames=own.frames)
            row |= {"exposure_total_s": each.exposures[0], "open_part": float(each.found.code.mean())}
            row["case"] = f"{each.name}, {own.frames} frames, {point['dose']:g} of the light"
            if each.name == DESIGN:
                row["gain_db"] = level - max(levels[1:])
            if model == RENDERED:
                row |= {"off_db": level - each.predicted, **flags_of(others=each.warnings)}
            rows.append(row)
    images = {each.name: each.image for each in proved if each.image is not None}
    return Found(tuple(rows), single_precision({**images, TRUTH: stand.truth}))


_NAMES = {("dose", dose): f"dose {dose:g}" for dose in _DOSES}
_NAMES |= {("frames", step**2): f"{step**2} frames" for step in (1, 2, 3, 4, 5, 7)}
_DOSE, _GAIN = "dose: part of the bright exposure", "gain over the best simple mask [dB]"

STUDY = Study(
    "design",
    "Designed masks",
    "How much better than the best simple mask is a designed one, by dose and frames?",
    points=_points,
    measure=measure,
    claims=(
        Level("49 frames, a tenth of the light: the design beats every simple mask by 1 dB", column="gain_db",
              where={"mask": DESIGN, "patterns": MANY, "dose": TENTH}, at_least=1.0, models=_MODELS),
        Gain("49 frames, bright light: the design beats the maximum length sequence by 4 dB", {"mask": DESIGN},
             {"mask": LONGEST}, where={"patterns": MANY, "dose": BRIGHT}, at_least=4.0, models=_MODELS),
        Gain(f"49 frames, bright light: a pinhole array is within {AGREE_DB:g} dB of the design", {"mask": PINHOLES},
             {"mask": DESIGN}, where={"patterns": MANY, "dose": BRIGHT}, at_least=-AGREE_DB, models=_MODELS),
        Level(f"Rendered less predicted is within {AGREE_DB:g} dB for each mask", column="off_db", every="case",
              where={"model": RENDERED}, at_least=-AGREE_DB, at_most=AGREE_DB, models=_MODELS),
    ),
    panels=(
        Lines("dose", _DOSE, file="gain_by_dose", y="gain_db", y_label=_GAIN, colour="frames", names=_NAMES,
              where={"mask": DESIGN}, log=True),
        Lines("frames", "frames", file="gain_by_frames", y="gain_db", y_label=_GAIN, colour="dose", names=_NAMES,
              where={"mask": DESIGN}, log=True),
        Lines("dose", _DOSE, file="masks", colour="mask", where={"patterns": MANY}, title="49 frames", log=True),
        Images("mask", array="{mask}", down=("frames", "dose"), where={"model": RENDERED}, before={TRUTH: "truth"},
               names=_NAMES),
    ),
    tables=(Pivot(("frames", "dose"), columns=("mask", "model"), title="PSNR [dB]", names=_NAMES),),
    about="Masks are compared at the same patterns, exposure time and search budget. A dose of 1 is the exposure at "
    "which the brightest pixel behind the scene's own mask fills 0.8 of the full well. Simple masks are the best "
    "random code, the best array of equal pinholes, and a maximum length sequence, all of the scene's feature size. "
    "Predicted: closed form without frames. Rendered: frames with the sensor's noise, solved with factors of a "
    "session of the same camera, the mean of two captures. After +-: one standard error over three seeds of search, "
    "session and noise. A quick study has the camera small where none is named, and 60 codes a start instead of 400.",
    heads=("", "Predicted", "Rendered"),
    kept=True,
)  # fmt: skip
