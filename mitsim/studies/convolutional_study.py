"""Coded illumination with a DiffuserCam: uniform light and 4 to 49 dots, solved by iterations and directly.

Paper, section V-E and figure 12: a convolutional camera has "no simple closed form", its iterative reconstruction takes
ten times as long as the separable one. Here the point spread function is that of a rendered diffuser
(:mod:`mitsim.transport.plugins.diffuser`) and, with `-D psf=FILE`, a measured one besides: the picture of DiffuserCam's
tutorial, which mitsim does not ship. The sensor gets all light; the speed of both solvers is measured on one that ends
where the picture does as well. Lambda is the best one. Times are CPU seconds on one thread, equal error is an error
within 1 % of the direct solution's.

The paper's simulation of coded illumination with a DiffuserCam (its section "Coded Illumination with Nonseparable
Systems"), with the noise and the exposure conventions of :mod:`mitsim.report.lit_scene`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import TYPE_CHECKING

import numpy as np

from mitsim.acquire.reference import rendered_psf
from mitsim.api.bench import Bench
from mitsim.bench.request import Exposure
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import stream
from mitsim.devices.mask_profile import load_psf
from mitsim.devices.patterns import PatternFamily, parse_patterns
from mitsim.devices.sensor import SensorModel
from mitsim.metrics import psnr, relative_error
from mitsim.reconstruct.convolution import Classes, FactorisedClasses, solve_iteratively
from mitsim.reconstruct.point_spread import ShiftedLight
from mitsim.reconstruct.solution import Solution
from mitsim.reconstruct.solver import prepare
from mitsim.report import CONVENTIONS, EQUAL_FRAME, EQUAL_PEAK
from mitsim.report.lit_scene import IdealCamera
from mitsim.report.pages import Mean, Value
from mitsim.sensor.chain import dn_to_electrons, electrons_from_irradiance, expose, exposure_for_peak
from mitsim.studies.framework.claims import Holds, Judged, stated, within
from mitsim.studies.framework.experiment import QUICK_IMAGES, SIDE, Found, Point, Scope, Study, picture
from mitsim.studies.framework.panels import Images, Lines
from mitsim.studies.framework.studio import Studio, flags_of, image_arrays

if TYPE_CHECKING:
    from pandas import DataFrame

MEASURED, TRACED = "measured", "rendered"
PERIODS = (1, 2, 3, 4, 5, 7)
"""The paper's numbers of patterns: 1 to 49."""
EXPOSURES = (EQUAL_PEAK, EQUAL_FRAME)
WHOLE, CROPPED = "all light", "cropped"
_N = 128
"""Pixels a side of the images of test pictures, as the paper's."""
_REDUCE, _SHAPE, _PITCH_MM = 4, (300, 400), 4 * 5.86e-3
"""The public picture, 1200 x 1600, in pixels of four; the traced one has the same, as large as IMX249's."""
_GOAL = 10.0
"""Times that the direct solver is to be faster."""
_MAGNITUDE = 5.0
"""Times from which one speaks of an order of magnitude."""


# ---- What is measured with ----


def _points(scope: Scope) -> Sequence[Point]:
    parameters = dict(scope.setup.parameters)
    measured = parameters.pop("psf", None)
    setup = replace(scope.setup, parameters=tuple(sorted(parameters.items())))
    found = []
    for number, name in enumerate(scope.pictures):
        for psf, file in [(MEASURED, measured)] * (measured is not None) + [(TRACED, None)]:
            for seed in scope.seeds:
                for k in scope.choose(PERIODS, (1, 7)):
                    case: dict[str, Value] = {"psf": psf, "file": file, "patterns": k * k, "seed": seed}
                    found.append(Point.of(setup.with_print(name), **case, part="quality"))
                    sensors = (WHOLE, CROPPED) if number == 0 and seed == scope.seeds[0] else ()
                    found += [
                        Point.of(setup.with_print(name), **case, part="speed", sensor=sensor)
                        for sensor in scope.choose(sensors, sensors[:1])
                    ]
    return found


@cache
def _psf(file: str | None, variant: str) -> FloatArray:
    return rendered_psf(_SHAPE, _PITCH_MM, variant) if file is None else load_psf(file, _REDUCE)


def _truth(studio: Studio, point: Point) -> FloatArray:
    """(n, n) reflectance: of a test image, or what a scene of one's own shows."""
    name = point.setup.picture
    if name is None:
        return studio.lit_scene(point.setup).truth
    block = SIDE // _N
    return np.asarray(picture(name).reshape(_N, block, _N, block).mean(axis=(1, 3)) / 255)


# ---- PSNR and seconds at one point ----


def _measure(studio: Studio, point: Point) -> Found:
    truth, k, seed = _truth(studio, point), round(point["patterns"] ** 0.5), int(point["seed"])
    psf, bench = _psf(point["file"], point.setup.variant), studio.bench(point.setup)
    whole = ShiftedLight.of(psf, len(truth))
    with single_threaded_blas():
        if point["part"] == "speed":
            camera = replace(whole, sensor=psf.shape) if point["sensor"] == CROPPED else whole
            measured = race(Classes(camera, k), Classes(whole, k), truth, bench.sensor, seed)
            if point["sensor"] == WHOLE:
                measured["separable_s"] = separable_seconds(bench, k)
            return Found((point.row(**measured),))
        rows, arrays = [], {}
        for exposure in EXPOSURES:
            shots = take(whole, bench.family(f"dots:{k}"), truth, bench.sensor, exposure, seed)
            solution, psnr_db = best_image(Classes(whole, k), shots, truth)
            flags = flags_of(solution.status)
            rows.append(point.row(exposure=exposure, psnr_db=psnr_db, exposure_s=shots.exposure_s, **flags))
            if point.setup.picture in (*QUICK_IMAGES, None) and exposure == EQUAL_FRAME:
                arrays = image_arrays(solution.image, truth)
    return Found(tuple(rows), arrays)


# ---- Claims of the paper, figures ----


def _times(rows: DataFrame, column: str, over: str, least: float) -> tuple[str, Holds]:
    """Judge whether a ``column`` of seconds is so many times another at least; patterns stand for repeats."""
    times = rows[column].astype(float) / rows[over].astype(float)
    ends = dict.fromkeys(f"{float(f'{each:.2g}'):g}" for each in (times.min(), times.max()))
    # Seconds vary by factors.
    ratio = Mean.of_numbers(np.log(times).tolist(), f"{column} over {over}")
    return f"{' to '.join(ends)} times as long", within(ratio, low=float(np.log(least)))


def _is_dots(patterns: int) -> bool:
    return patterns != 1


_MODELS = ("psf", MEASURED, TRACED)
_QUALITY = {"part": "quality", "exposure": EXPOSURES}
_SPEED = {"part": "speed", "sensor": WHOLE}
_FRAMES = "number of frames [1]"

STUDY = Study(
    "convolutional",
    "A diffuser for a mask",
    "What do dots bring to a DiffuserCam, and is there no direct solution?",
    points=_points,
    measure=_measure,
    claims=(
        replace(stated("Uniform light: 19 to 24.6 dB", 19.0, 24.6, part="quality", patterns=1), models=_MODELS),
        replace(stated("49 dots: 38.5 to 44.5 dB", 38.5, 44.5, part="quality", patterns=49), models=_MODELS),
        *(
            Judged(
                claim,
                partial(_times, column=column, over=over, least=least),
                where=where,
                paper=paper,
                models=_MODELS,
                optional=where["sensor"] == CROPPED,  # a quick study has none
            )
            for claim, paper, where, column, over, least in (
                (
                    "Iterations take an order of magnitude longer than the separable closed form",
                    "10 times as long",
                    _SPEED,
                    "iterative_s",
                    "separable_s",
                    _MAGNITUDE,
                ),
                (
                    "Dots can be solved directly, and iterations to equal error take ten times as long",
                    "no closed form",
                    {**_SPEED, "patterns": _is_dots},
                    "iterative_s",
                    "direct_s",
                    _GOAL,
                ),
                (
                    "The same where the sensor ends at the picture's edge, prepared once",
                    "no closed form",
                    {**_SPEED, "patterns": _is_dots, "sensor": CROPPED},
                    "iterative_s",
                    "direct_s",
                    _GOAL,
                ),
                ("Even so, it takes longer than the separable closed form", "", _SPEED, "direct_s", "separable_s", 1.0),
            )
        ),
    ),
    panels=(
        Lines(
            "patterns",
            _FRAMES,
            title="PSNR, best lambda",
            where=_QUALITY,
            each="exposure",
            colour="psf",
            facet="",
            log=True,
        ),
        Lines(
            "patterns",
            _FRAMES,
            file="seconds",
            title="Time of the solvers by the number of frames, at equal error",
            y_label="processor time [s]",
            where=_SPEED,
            colour={"iterative_s": "iterative", "direct_s": "direct", "separable_s": "separable camera"},
            facet="psf",
            log=True,
        ),
        Images(
            "patterns",
            title=f"Images by the number of frames, exposure {EQUAL_FRAME}, best lambda",
            where={"part": "quality", "exposure": EQUAL_FRAME, "patterns": (1, 9, 49)},
            down=("picture", "psf"),
        ),
    ),
    heads=("Paper", "Measured", "Rendered"),
    note="A frame is the scene convolved with the camera's point spread function (PSF), that of a rendered diffuser "
    "and, with -D psf=FILE, a measured one besides; no light of a scene is traced. The sensor gets all light. Best "
    "lambda: that of the highest PSNR. Times are processor seconds on one thread.",
    traced=False,
)


# ---- Noisy frames behind a diffuser ----

WHITE_W_M2, WAVELENGTH_NM = 0.3, 550.0
"""Irradiance where all light of a white, uniformly lit scene falls: the paper's projector (0.14 W over 120 mm square
at 400 mm) on a bare sensor, 9.7 W m^-2 / pi x 0.0144 m^2 / 0.16 m^2; in green. Exposure follows the peak, so both
only set how much dark current there is."""
_LEAST_LAMBDA = 1e-9
"""Lambda over the largest of S at which the search for the best one ends: shot noise of full wells calls for 1e-7."""
_BEYOND_DB = 2.0
"""Fall of PSNR below the best so far at which the search, from large lambda to small, is over."""
_EQUAL_ERROR, _EQUAL_ANSWER = 1.01, 1e-6
"""Where iterations have come as far as a direct solution: an error against the truth within 1 % of its own, 0.09 dB;
and their relative difference, of which no image shows anything."""
_LOOSE, _TIGHT = 1e-6, 1e-12
"""Residuals at which conjugate gradients within the direct solver end, for either."""
_MOST_STEPS = 1000
"""Iterations at most: 170 were seen to the equal answer."""
_FINER = (0.5, 0.25)
"""Steps [decades] by which the search then moves: a quarter of a decade changes PSNR by 0.1 dB at most."""


@dataclass(frozen=True, eq=False)
class DiffuserShots:
    """Noisy frames of one family.

    Attributes
    ----------
    frames
        (patterns, rows, columns) in the unit of ``ShiftedLight.image_of``: a white scene is 1.
    exposure_s
        of each shot.
    saturated
        part of all numbers that reached the full well or the converter's end.
    """

    frames: FloatArray
    exposure_s: float
    saturated: float


def take(
    camera: ShiftedLight,
    family: PatternFamily,
    reflectance: FloatArray,
    sensor: SensorModel,
    convention: str = CONVENTIONS[0],
    seed: int = 0,
) -> DiffuserShots:
    """Frames of an image under a family of 0/1 patterns.

    Parameters
    ----------
    camera, family, sensor
        what sees, under which patterns, with which electronics.
    reflectance
        (n, n) of the scene.
    convention
        of exposure, one of :data:`mitsim.report.CONVENTIONS`.
    seed
        of the noise.
    """
    expected = np.maximum(camera.under(family).image_of(reflectance), 0.0)  # transforms leave 1e-17 below zero
    peak = float(expected.max())
    if convention != CONVENTIONS[0]:
        peak = float(camera.under(parse_patterns("uniform", family.n)).image_of(reflectance).max())
    time = exposure_for_peak(peak * WHITE_W_M2, Exposure().fraction, sensor, WAVELENGTH_NM)
    if convention == CONVENTIONS[2]:
        time /= len(expected)
    unit = float(electrons_from_irradiance(WHITE_W_M2, time, sensor, WAVELENGTH_NM))
    dark = sensor.superpixel_dark_current_e_per_s * time
    full = sensor.full_well_dn
    frames, saturated = np.empty_like(expected), 0
    for index, frame in enumerate(expected):
        shot, read = (stream(seed, "diffuser camera", noise, family.name, index) for noise in ("shot", "read"))
        digital = expose(frame * unit, time, sensor, shot, read)
        saturated += int(np.count_nonzero(digital >= min(full, sensor.largest_dn or np.inf)))
        frames[index] = (dn_to_electrons(digital, sensor) - dark) / unit
    return DiffuserShots(frames, time, saturated / frames.size)


# ---- The best lambda ----


def best_by_psnr(solve: Callable[[float], Solution], truth: FloatArray, largest: float) -> tuple[Solution, float]:
    """The solution nearest to the truth over lambda, to a quarter of a decade, and its PSNR [dB].

    Parameters
    ----------
    solve
        from lambda to a solution.
    truth
        (n, n) image.
    largest
        what lambda is relative to, the largest of S.
    """
    relative, best = 1.0, solve(largest)
    reached = psnr(best.image, truth)
    while relative > _LEAST_LAMBDA:
        relative /= 10
        solution = solve(relative * largest)
        found = psnr(solution.image, truth)
        if found < reached - _BEYOND_DB:
            break
        if found > reached:
            best, reached = solution, found
    for step in _FINER:
        beside = [solve(best.lam * 10**move) for move in (-step, step)]
        best = max([best, *beside], key=lambda solution: psnr(solution.image, truth))
    return best, psnr(best.image, truth)


def best_image(classes: Classes, shots: DiffuserShots, truth: FloatArray) -> tuple[Solution, float]:
    """The image that is nearest to the truth over lambda, as :func:`best_by_psnr`, and its PSNR [dB].

    Parameters
    ----------
    classes, shots
        camera and period of dots, and their frames.
    truth
        (n, n) image.
    """
    projected = classes.project(shots.frames)
    return best_by_psnr(lambda lam: classes.factorise(lam).solve(projected), truth, classes.largest)


# ---- Iterations against the direct solver ----


@dataclass
class _Marks:
    """CPU seconds and iterations after which an image comes within the error of an ``exact`` one, and near it."""

    exact: FloatArray
    truth: FloatArray
    start: float
    steps: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    iterations: dict[str, int] = field(default_factory=dict)

    def __call__(self, image: FloatArray) -> bool:
        self.steps += 1
        spent, truth = time.process_time() - self.start, self.truth
        equal = {
            "error": relative_error(image, truth) <= _EQUAL_ERROR * relative_error(self.exact, truth),
            "answer": relative_error(image, self.exact) <= _EQUAL_ANSWER,
        }
        for name in (name for name, reached in equal.items() if reached and name not in self.seconds):
            self.seconds[name], self.iterations[name] = spent, self.steps
        return len(self.seconds) == len(equal)


def race(classes: Classes, whole: Classes, truth: FloatArray, sensor: SensorModel, seed: int) -> dict[str, float]:
    """CPU seconds of conjugate gradients on all frames, and of the direct solver, from the same frames at equal peak.

    Parameters
    ----------
    classes
        camera and period of dots.
    whole
        the same camera with a sensor that gets all light, whose best lambda both take.
    truth, sensor, seed
        the image, the electronics, and the seed of the noise.

    Returns
    -------
    ``prepare_s`` once for a camera, dots and lambda; ``direct_s`` and ``iterative_s`` for every image, to equal error;
    ``direct_exact_s`` and ``iterative_exact_s`` to equal answers; ``iterations`` and ``iterations_exact``; ``psnr_db``
    of the direct one; ``difference`` of both, relative.

    Raises
    ------
    MitsimError
        where iterations do not come to the direct solution.
    """
    camera = classes.camera
    family = parse_patterns(f"dots:{classes.k}", len(truth))
    lam = best_image(whole, take(whole.camera, family, truth, sensor, seed=seed), truth)[0].lam
    frames = take(camera, family, truth, sensor, seed=seed).frames
    start = time.process_time()
    factorised = Classes(camera, classes.k).factorise(lam)
    prepare_s = time.process_time() - start
    exact, direct_exact_s = _time(factorised, frames, _TIGHT)
    direct, direct_s = _time(factorised, frames, _LOOSE)
    marks = _Marks(exact.image, truth, time.process_time())
    iterative = solve_iteratively(camera.under(family), frames, lam, 0.0, _MOST_STEPS, marks)
    if len(marks.seconds) < len(("error", "answer")):
        raise MitsimError(f"iterations did not come to the direct solution at lambda {lam:g}: {iterative.status}")
    return {
        "prepare_s": prepare_s,
        "direct_s": direct_s,
        "direct_exact_s": direct_exact_s,
        "iterative_s": marks.seconds["error"],
        "iterative_exact_s": marks.seconds["answer"],
        "iterations": marks.iterations["error"],
        "iterations_exact": marks.iterations["answer"],
        "psnr_db": psnr(direct.image, truth),
        "difference": relative_error(iterative.image, exact.image),
    }


def _time(factorised: FactorisedClasses, frames: FloatArray, tolerance: float) -> tuple[Solution, float]:
    start = time.process_time()
    solution = factorised.solve(factorised.classes.project(frames), tolerance)
    return solution, time.process_time() - start


def separable_seconds(bench: Bench, k: int) -> float:
    """CPU seconds of the separable closed form for the frames of dots of period ``k`` with the camera of a ``bench``,
    its factors prepared before; they hang on sizes alone."""
    family, camera = bench.family(f"dots:{k}"), IdealCamera(bench, bench.geometry.mask)
    left, right = camera.factors
    model = prepare(left, right, family.left, family.right)
    frames = stream(0, "separable frames").random((k, k, len(left), len(right)))
    start = time.process_time()
    sums = model.accumulator()
    for row in range(k):
        for column in range(k):
            sums.add(frames[row, column], row, column)
    model.solve(sums, model.problem(sums).scale * _LEAST_LAMBDA)
    return time.process_time() - start
