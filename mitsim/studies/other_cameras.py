"""Studies of cameras that the paper compares with: a mask that moves in place of the light, and a diffuser for a mask.

*multishot*, section IV-D: the mask moves by -15 to +15 of its features on a grid of k x k places, with as many frames
as dots of period k. SweepCam (Hua, Nakamura, Asif & Sankaranarayanan, TPAMI 2020) moves the mask instead of the light.
Moved by a along the rows and by b along the columns, a separable mask casts Y_ab = Phi_L(a) X Phi_R(b)^T. All frames of
a grid side by side are therefore one frame of a separable camera,

    [Y_ab]_ab = [Phi_L(a)]_a X [Phi_R(b)]_b^T,

which :mod:`mitsim.reconstruct.solver` solves exactly.

*convolutional*, section V-E and figure 12: a DiffuserCam under uniform light and 4 to 49 dots, with the point spread
function of a rendered diffuser (:mod:`mitsim.transport.plugins.lens`) or a measured one (`-D psf=FILE`). The sensor
gets all light. Times are CPU seconds on one thread, at an error within 1 % of the direct solution's.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from mitsim.acquire.capture import rendered_psf
from mitsim.acquire.exposure import Exposer
from mitsim.bench.apparatus import Apparatus
from mitsim.bench.request import Exposure
from mitsim.calibrate.board_session import LitSession, Session
from mitsim.calibrate.calibrate import estimate
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import integer, stream
from mitsim.devices.camera import load_psf
from mitsim.devices.patterns import PatternFamily, parse_patterns
from mitsim.devices.sensor import SensorModel
from mitsim.devices.session import load_recipe
from mitsim.metrics import psnr, relative_error
from mitsim.optics.frames import Frame
from mitsim.reconstruct.point_spread import DotClasses, ShiftedLight, solve_iteratively
from mitsim.reconstruct.solver import Solution, centre_columns, centre_frame, prepare
from mitsim.report import EQUAL_FRAME, EQUAL_PEAK, IDEALISED, MODELS, RENDERED
from mitsim.report.lit_scene import IdealCamera, LitScene, Pair, Unexposed, measured
from mitsim.report.pages import Mean
from mitsim.sensor.chain import dn_to_electrons, electrons_from_irradiance, expose, exposure_for_peak
from mitsim.studies.framework.claims import Gain, Holds, Judged, stated, within
from mitsim.studies.framework.experiment import QUICK_IMAGES, Axes, Found, Point, Scope, Study
from mitsim.studies.framework.panels import Images, Lines
from mitsim.studies.framework.studio import SIDE, Image, Studio, flags_of, image_arrays, picture

if TYPE_CHECKING:
    from pandas import DataFrame

EXPOSURES = (EQUAL_PEAK, EQUAL_FRAME)

# -------- A camera whose mask moves

Places = Mapping[float, Pair]
"""Left and right factor, (pixels, n) each, by the shift of the mask [mm] along both axes."""


def move_mask(bench: Apparatus, row_mm: float, column_mm: float) -> Apparatus:
    offset = {"mask_offset_row": row_mm, "mask_offset_column": column_mm}
    return replace(bench, devices=replace(bench.devices, camera=bench.geometry.model_copy(update=offset)))


def ideal_places(bench: Apparatus, places_mm: Iterable[float], board_flux: float) -> Places:
    """Return factors of the paper's model; a pixel of a white board puts ``board_flux`` on the sensor [W m^-2]."""
    uniform, white = bench.family("uniform"), np.full((bench.n, bench.n), board_flux)

    def camera(row: float, column: float) -> IdealCamera:
        return IdealCamera(move_mask(bench, row, column), bench.geometry.mask)

    sides = {place: camera(place, place).calibrated(board_flux) for place in places_mm}
    return _consistent(sides, bench, lambda *at: next(iter(camera(*at).frames(uniform, white))))


def calibrated_places(bench: Apparatus, places_mm: Sequence[float], seed: int, accuracy: float = 1e-3) -> Places:
    """Return factors as sessions with the mask at each place estimate them, all in one board's light.

    A mask that has moved along both axes determines the left factor of its row and the right one of its column.
    """
    recipe, job = load_recipe(), Job()
    session = Session(bench, recipe, seed)
    (light,) = session.trace(session.plan(accuracy, job), job)

    def lit(row: float, column: float) -> LitSession:
        own = Session(move_mask(bench, row, column), recipe, integer(seed, "mask", f"{row:g}", f"{column:g}"))
        return LitSession.of(own, light.behind(own.board), Job())

    found = {place: estimate(lit(place, place), Job())[0] for place in places_mm}
    sides = {place: (factors.left, factors.right) for place, factors in found.items()}
    return _consistent(sides, bench, lambda *at: lit(*at).white)


def _consistent(factors: Places, bench: Apparatus, white: Callable[[float, float], Frame]) -> Places:
    """Return factors whose products hold between places as well.

    A session leaves the split of its product, and its sign, open; uniform frames of the board through moved masks
    (``white``) determine it.
    """
    first, found = next(iter(factors)), {}
    for place, (left, right) in factors.items():
        modelled = np.outer(left.sum(axis=1), factors[first][1].sum(axis=1))
        measured = Exposer(bench.devices, 1.0, 0).electrons(white(place, first))
        if bench.geometry.centred:
            modelled, measured = centre_frame(modelled), centre_frame(measured)
        share = float(np.vdot(modelled, measured) / np.vdot(measured, measured))
        found[place] = left / share, right * share
    return found


Moved = Mapping[tuple[float, float], Unexposed]
"""Uniform frames by the shift of the mask along rows and columns [mm]."""


def through_moved_mask(lit: LitScene, model: str, factors: Places, along: Sequence[float], seed: int) -> Moved:
    """Return uniform frames of a scene through a mask at all places of a grid, by one of the models of a scene."""
    uniform, found = lit.bench.family("uniform"), {}
    for row, column in product(along, repeat=2):
        sides, own = (factors[row][0], factors[column][1]), integer(seed, "mask", f"{row:g}", f"{column:g}")
        bench, centre = move_mask(lit.bench, row, column), lit.bench.geometry.centred
        found[row, column] = Unexposed(lit, model, uniform, sides, centre, own, bench=bench)
    return found


def frame_of(one: Unexposed, seconds: float) -> FloatArray:
    ((frame, _, _),) = measured(one.exposer(seconds), one.family, one.expected)
    return centre_frame(frame) if one.centre else frame


@single_threaded_blas()
def solve_moved(moved: Moved, exposure: str) -> tuple[Solution, float]:
    """Return the solution of all frames together, and the exposure of each [s]: the brightest one fills the well."""
    seconds = min(each.seconds(exposure) for each in moved.values())
    rows, columns = (list(dict.fromkeys(side)) for side in zip(*moved, strict=True))
    sides = [moved[row, columns[0]].sides[0] for row in rows], [moved[rows[0], column].sides[1] for column in columns]
    centre = moved[rows[0], columns[0]].centre
    left, right = (np.concatenate([centre_columns(each) if centre else each for each in side]) for side in sides)
    uniform = np.ones((left.shape[1], 1))
    model = prepare(left, right, uniform, uniform)
    sums = model.accumulator()
    sums.add(np.block([[frame_of(moved[row, column], seconds) for column in columns] for row in rows]), 0, 0)
    return model.solve(sums), seconds


REACH = 15.0
GRIDS = {2: (0, 6), 3: (0, 3, 6), 4: (0, 2, 4, 6), 7: tuple(range(7))}
"""Indices along an axis of the seven calibrated places, by number of places."""
UNIFORM, SWEPT, DOTS = "uniform frames", "SweepCam", "shifting dots"
_FRAMES = 49


def _multishot_measure(studio: Studio, point: Point) -> Found:
    model, method, seed, count = point["model"], point["patterns"], int(point["seed"]), int(point["frames"])
    lit, side = studio.lit_scene(point.setup), round(count**0.5)
    bench, noise_seed = lit.bench, seed if model == RENDERED else seed + 1
    places = tuple(float(place) for place in np.linspace(-REACH, REACH, 7) * bench.geometry.mask_feature)
    if model == IDEALISED:
        factors = ideal_places(bench, places, lit.board_flux)
    else:
        key = bench.devices_digest, places, seed  # a session does not depend on the print
        factors = studio.once("places", 1, key, lambda: calibrated_places(bench, places, seed))
    images: dict[str, Image] = {}
    if method == SWEPT:
        along = tuple(places[index] for index in GRIDS[side])
        moved = through_moved_mask(lit, model, factors, along, noise_seed)
        for exposure in EXPOSURES:
            found, seconds = solve_moved(moved, exposure)
            flags = flags_of(found.status)
            images[exposure] = Image(found.image, lit.quality(found.image), found.lam, count, seconds, flags)
    else:
        ones = np.ones((bench.n, 1), np.int8)
        still = PatternFamily(UNIFORM, ones.repeat(count, axis=1), ones)
        family = bench.family(f"dots:{side}") if method == DOTS else still
        frames = Unexposed(lit, model, family, factors[0.0], bench.geometry.centred, noise_seed)
        images = {exposure: Image.of(frames, frames.seconds(exposure)) for exposure in EXPOSURES}
    kept = point.setup.picture in (*QUICK_IMAGES, None) and side in (1, 7)
    arrays = image_arrays(images[EQUAL_FRAME].image, lit.truth) if kept else {}
    return Found(tuple(point.row(exposure=exposure, **image.row()) for exposure, image in images.items()), arrays)


_gain = partial(Gain, where={"frames": _FRAMES}, at_least=0.5)
MULTISHOT = Study(
    "multishot",
    "The mask moved, or the light",
    "Do dots beat as many uniform frames through a mask that moves?",
    points=Axes(
        {"patterns": (UNIFORM, SWEPT, DOTS), "frames": (1, *(side**2 for side in GRIDS)), "model": MODELS},
        quick={"frames": (1, _FRAMES)},
        quick_prints=1,
        kept=lambda values: values["frames"] != 1 or values["patterns"] == UNIFORM,
    ),
    measure=_multishot_measure,
    claims=(
        stated("One uniform frame gives 21.3 to 22.9 dB", 21.3, 22.9, patterns=UNIFORM, frames=1),
        stated("SweepCam with 49 frames gives 24.9 to 26.8 dB, here on a grid", 24.9, 26.8, patterns=SWEPT, frames=49),
        stated("49 shifting dots give 34 to 35.5 dB", 34.0, 35.5, patterns=DOTS, frames=_FRAMES),
        _gain("49 dots beat SweepCam's 49 frames", DOTS, SWEPT, paper="higher"),
        _gain("SweepCam's 49 frames beat 49 frames through a mask at rest", SWEPT, UNIFORM),
    ),
    panels=(
        Lines("frames", "number of frames [1]", each="exposure", shared={"patterns": UNIFORM, "frames": 1}, log=True),
        Images("patterns", title=f"Images of 49 frames, exposure {EQUAL_FRAME}", columns=(UNIFORM, SWEPT, DOTS),
               where={"exposure": EQUAL_FRAME, "frames": _FRAMES}),
    ),
)  # fmt: skip

# -------- A diffuser for a mask: noisy frames, the image nearest to the truth, and the speed of both solvers

MEASURED, TRACED = "measured", "rendered"
PERIODS = (1, 2, 3, 4, 5, 7)
_N = 128
_REDUCE, _SHAPE, _PITCH_MM = 4, (300, 400), 4 * 5.86e-3
"""Binning, shape and pitch of the public picture (1200 x 1600); the traced one is as large."""
WHITE_W_M2, WAVELENGTH_NM = 0.3, 550.0
"""Irradiance of a white scene's light at one point of a bare sensor [W m^-2], 9.7 / pi x 0.0144 m^2 / 0.16 m^2, from
the paper's projector (0.14 W over 120 mm square at 400 mm), in green. Exposure follows the peak, so that both only
determine the dark current."""
_LEAST_LAMBDA = 1e-9
_BEYOND_DB = 2.0
_FINER = (0.5, 0.25)
"""Further steps of the search [decades]."""
_EQUAL_ERROR = 1.01
"""Factor of equal error against the truth (0.09 dB)."""
_MOST_STEPS = 1000


def take(
    camera: ShiftedLight, family: PatternFamily, reflectance: FloatArray, sensor: SensorModel,
    convention: str = EQUAL_PEAK, seed: int = 0,
) -> tuple[FloatArray, float]:  # fmt: skip
    """Return noisy frames of an (n, n) reflectance under a family of 0/1 patterns, and the exposure of each [s].

    The frames are (patterns, rows, columns) in the unit of ``ShiftedLight.image_of``: a white scene is 1.
    """
    expected = np.maximum(camera.under(family).image_of(reflectance), 0.0)  # transforms leave 1e-17 below zero
    peak = float(expected.max())
    if convention != EQUAL_PEAK:
        peak = float(camera.under(parse_patterns("uniform", family.n)).image_of(reflectance).max())
    seconds = exposure_for_peak(peak * WHITE_W_M2, Exposure().fraction, sensor, WAVELENGTH_NM)
    unit = float(electrons_from_irradiance(WHITE_W_M2, seconds, sensor, WAVELENGTH_NM))
    dark, frames = sensor.superpixel_dark_current_e_per_s * seconds, np.empty_like(expected)
    for index, frame in enumerate(expected):
        shot, read = (stream(seed, "diffuser camera", noise, family.name, index) for noise in ("shot", "read"))
        frames[index] = (dn_to_electrons(expose(frame * unit, seconds, sensor, shot, read), sensor) - dark) / unit
    return frames, seconds


def best_image(classes: DotClasses, frames: FloatArray, truth: FloatArray) -> tuple[Solution, float]:
    projected = classes.project(frames)

    def solve(lam: float) -> tuple[Solution, float]:
        solution = classes.solve(projected, lam)
        return solution, psnr(solution.image, truth)

    relative, best = 1.0, solve(classes.largest)
    while relative > _LEAST_LAMBDA:
        relative /= 10
        found = solve(relative * classes.largest)
        if found[1] < best[1] - _BEYOND_DB:
            break
        best = max(best, found, key=lambda each: each[1])
    for step in _FINER:
        beside = [solve(best[0].lam * 10**move) for move in (-step, step)]
        best = max([best, *beside], key=lambda each: each[1])
    return best


def race(camera: ShiftedLight, k: int, truth: FloatArray, sensor: SensorModel, seed: int) -> dict[str, float]:
    """Time conjugate gradients on all frames and on classes, from the same frames at equal peak [CPU seconds].

    Both have the best lambda, and the iterations on frames end at equal error; MitsimError if they do not come there.
    """
    classes, family, clock = DotClasses(camera, k), parse_patterns(f"dots:{k}", len(truth)), time.process_time
    frames, _ = take(camera, family, truth, sensor, seed=seed)
    lam = best_image(classes, frames, truth)[0].lam
    start = clock()
    direct = classes.solve(classes.project(frames), lam).image
    direct_s = clock() - start
    enough = _EQUAL_ERROR * relative_error(direct, truth)
    start = clock()
    iterative = solve_iteratively(
        camera.under(family), frames, lam, 0.0, _MOST_STEPS, lambda image: relative_error(image, truth) <= enough
    )
    iterative_s = clock() - start
    if relative_error(iterative.image, truth) > enough:
        raise MitsimError(f"iterations did not come to the direct solution at lambda {lam:g}: {iterative.status}")
    return {
        "direct_s": direct_s, "iterative_s": iterative_s, "iterations": iterative.iterations,
        "psnr_db": psnr(direct, truth),
    }  # fmt: skip


def separable_seconds(bench: Apparatus, k: int) -> float:
    family, (left, right) = bench.family(f"dots:{k}"), IdealCamera(bench, bench.geometry.mask).factors
    model = prepare(left, right, family.left, family.right)
    frames = stream(0, "separable frames").random((k, k, len(left), len(right)))
    start = time.process_time()
    sums = model.accumulator()
    for row, column in product(range(k), repeat=2):
        sums.add(frames[row, column], row, column)
    model.solve(sums, model.problem(sums).scale * _LEAST_LAMBDA)
    return time.process_time() - start


@cache
def _psf(file: str | None) -> FloatArray:
    return rendered_psf(_SHAPE, _PITCH_MM) if file is None else load_psf(file, _REDUCE)


def _convolutional_points(scope: Scope) -> Sequence[Point]:
    parameters = dict(scope.setup.parameters)
    measured = parameters.pop("psf", None)
    setup, found = replace(scope.setup, parameters=tuple(sorted(parameters.items()))), []
    psfs = [(MEASURED, measured)] * (measured is not None) + [(TRACED, None)]
    for name, (psf, file), seed, k in product(scope.pictures, psfs, scope.seeds, scope.choose(PERIODS, (1, 7))):
        at = partial(Point.of, replace(setup, picture=name), psf=psf, file=file, patterns=k * k, seed=seed)
        raced = name == scope.pictures[0] and seed == scope.seeds[0]
        found += [at(part="quality"), *([at(part="speed")] if raced else [])]
    return found


def _convolutional_measure(studio: Studio, point: Point) -> Found:
    name, k, seed = point.setup.picture, round(point["patterns"] ** 0.5), int(point["seed"])
    psf, bench = _psf(point["file"]), studio.bench(point.setup)
    if name is None:
        truth = studio.lit_scene(point.setup).truth
    else:
        block = SIDE // _N
        truth = np.asarray(picture(name).reshape(_N, block, _N, block).mean(axis=(1, 3)) / 255)
    whole = ShiftedLight.of(psf, len(truth))
    with single_threaded_blas():
        if point["part"] == "speed":
            measured = race(whole, k, truth, bench.sensor, seed)
            return Found((point.row(**measured, separable_s=separable_seconds(bench, k)),))
        rows, arrays = [], {}
        for exposure in EXPOSURES:
            frames, seconds = take(whole, bench.family(f"dots:{k}"), truth, bench.sensor, exposure, seed)
            solution, psnr_db = best_image(DotClasses(whole, k), frames, truth)
            rows.append(point.row(exposure=exposure, psnr_db=psnr_db, exposure_s=seconds, **flags_of(solution.status)))
            if name in (*QUICK_IMAGES, None) and exposure == EQUAL_FRAME:
                arrays = image_arrays(solution.image, truth)
    return Found(tuple(rows), arrays)


def _times(rows: DataFrame, column: str, over: str, least: float) -> tuple[str, Holds]:
    times = rows[column].astype(float) / rows[over].astype(float)
    ends = dict.fromkeys(f"{float(f'{each:.2g}'):g}" for each in (times.min(), times.max()))
    # Seconds vary by factors.
    ratio = Mean.of_numbers(np.log(times).tolist(), f"{column} over {over}")
    return f"{' to '.join(ends)} times as long", within(ratio, low=float(np.log(least)))


_MODELS = ("psf", MEASURED, TRACED)
_QUALITY, _SPEED = {"part": "quality", "exposure": EXPOSURES}, {"part": "speed"}
_SPEED_OF_DOTS = _SPEED | {"patterns": lambda patterns: patterns != 1}
_SOLVERS = {"iterative_s": "iterative", "direct_s": "direct", "separable_s": "separable camera"}
_by_frames = partial(Lines, "patterns", "number of frames [1]", log=True)
CONVOLUTIONAL = Study(
    "convolutional",
    "A diffuser for a mask",
    "What do dots bring to a DiffuserCam, and is there no direct solution?",
    points=_convolutional_points,
    measure=_convolutional_measure,
    claims=(
        replace(stated("Uniform light: 19 to 24.6 dB", 19.0, 24.6, part="quality", patterns=1), models=_MODELS),
        replace(stated("49 dots: 38.5 to 44.5 dB", 38.5, 44.5, part="quality", patterns=49), models=_MODELS),
        Judged("Iterations take an order of magnitude longer than the separable closed form",
               partial(_times, column="iterative_s", over="separable_s", least=5.0), where=_SPEED, models=_MODELS,
               paper="10 times as long"),
        Judged("Dots can be solved directly, and iterations to equal error take ten times as long",
               partial(_times, column="iterative_s", over="direct_s", least=10.0), where=_SPEED_OF_DOTS,
               models=_MODELS, paper="no closed form"),
    ),
    panels=(
        _by_frames(title="PSNR, best lambda", where=_QUALITY, each="exposure", colour="psf", facet=""),
        _by_frames(file="seconds", y_label="processor time to equal error [s]", where=_SPEED, colour=_SOLVERS,
                   facet="psf"),
        Images("patterns", title=f"Images by the number of frames, exposure {EQUAL_FRAME}, best lambda",
               where={"part": "quality", "exposure": EQUAL_FRAME, "patterns": (1, 9, 49)}, down=("picture", "psf")),
    ),
    heads=("Paper", "Measured", "Rendered"),
    note="A frame is the scene convolved with the camera's point spread function (PSF), that of a rendered diffuser "
    "and, with -D psf=FILE, a measured one besides; no light of a scene is traced. The sensor gets all light. Best "
    "lambda: that of the highest PSNR. Times are processor seconds on one thread.",
    traced=False,
)  # fmt: skip

STUDIES = {each.name: each for each in (MULTISHOT, CONVOLUTIONAL)}
