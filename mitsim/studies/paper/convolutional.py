"""Coded illumination with a DiffuserCam: uniform light and 4 to 49 dots, solved by iterations and directly.

Paper, section V-E and figure 12: a convolutional camera has "no simple closed form", its iterative reconstruction takes
ten times as long as the separable one. Here the point spread function is that of a rendered diffuser
(:mod:`mitsim.transport.plugins.diffuser`) and, with `-D psf=FILE`, a measured one besides: the picture of DiffuserCam's
tutorial, which mitsim does not ship. The sensor gets all light; the speed of both solvers is measured on one that ends
where the picture does as well. Lambda is the best one. Times are CPU seconds on one thread, equal error is an error
within 1 % of the direct solution's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from matplotlib.figure import Figure

from mitsim.acquire.reference import rendered_psf
from mitsim.core.arrays import FloatArray
from mitsim.core.parallel import single_threaded_blas
from mitsim.devices.mask_profile import load_psf
from mitsim.reconstruct.convolution import Classes, ConvolutionalCamera
from mitsim.report.charts import curves, image_grid
from mitsim.report.exposures import EQUAL_FRAME, EQUAL_PEAK
from mitsim.report.table import Mean, Table, Value
from mitsim.studies.diffusercam import best_image, race, separable_seconds, take
from mitsim.studies.framework.experiment import Claim, Experiment, Found, Results, Scope
from mitsim.studies.framework.pictures import QUICK_IMAGES, SIDE, picture
from mitsim.studies.framework.setup import Point
from mitsim.studies.framework.studio import Studio
from mitsim.studies.framework.verdicts import Holds, every, sampled, verdict, verdict_at, within
from mitsim.studies.paper.measure import near, shown

MEASURED, TRACED = "measured", "rendered"
PERIODS = (1, 2, 3, 4, 5, 7)
"""The paper's numbers of patterns: 1 to 49."""
EXPOSURES = (EQUAL_PEAK, EQUAL_FRAME)
WHOLE, CROPPED = "all light", "cropped"
_N = 128
"""Pixels a side of the images of test pictures, as the paper's."""
_REDUCE, _SHAPE, _PITCH_MM = 4, (300, 400), 4 * 5.86e-3
"""The public picture, 1200 x 1600, in pixels of four; the traced one has the same, as large as IMX249's."""
_UNIFORM_DB, _DOTS_DB = (19.0, 24.6), (38.5, 44.5)
"""In the paper's figure 12."""
_GOAL = 10.0
"""Times that the direct solver is to be faster."""
_MAGNITUDE = 5.0
"""Times from which one speaks of an order of magnitude."""
Judge = Callable[[str], tuple[str, Holds]]


def _points(scope: Scope) -> Sequence[Point]:
    parameters = dict(scope.setup.parameters)
    measured = parameters.pop("psf", None)
    setup = replace(scope.setup, parameters=tuple(sorted(parameters.items())))
    found = []
    for number, name in enumerate(scope.pictures):
        for psf, file in [(MEASURED, measured)] * (measured is not None) + [(TRACED, None)]:
            for seed in scope.seeds:
                for k in scope.chosen(PERIODS, (1, 7)):
                    case: dict[str, Value] = {"psf": psf, "file": file, "patterns": k * k, "seed": seed}
                    found.append(Point.of(setup.printed(name), **case, part="quality"))
                    sensors = (WHOLE, CROPPED) if number == 0 and seed == scope.seeds[0] else ()
                    found += [
                        Point.of(setup.printed(name), **case, part="speed", sensor=sensor)
                        for sensor in scope.chosen(sensors, sensors[:1])
                    ]
    return found


@cache
def _psf(file: str | None, variant: str) -> FloatArray:
    """Of a picture, or of a rendered diffuser."""
    return rendered_psf(_SHAPE, _PITCH_MM, variant) if file is None else load_psf(file, _REDUCE)


def _truth(studio: Studio, point: Point) -> FloatArray:
    """(n, n) reflectance: of a test image, or what a scene of one's own shows."""
    name = point.setup.picture
    if name is None:
        return studio.lit(point.setup).truth
    block = SIDE // _N
    return np.asarray(picture(name).reshape(_N, block, _N, block).mean(axis=(1, 3)) / 255)


def _measure(studio: Studio, point: Point) -> Found:
    truth, k, seed = _truth(studio, point), round(point["patterns"] ** 0.5), int(point["seed"])
    psf, bench = _psf(point["file"], point.setup.variant), studio.bench(point.setup)
    whole = ConvolutionalCamera(psf, len(truth))
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
            rows.append(point.row(exposure=exposure, psnr_db=psnr_db, exposure_s=shots.exposure_s))
            if point.setup.picture in (*QUICK_IMAGES, None) and exposure == EQUAL_FRAME:
                arrays = shown(solution.image)
    return Found(tuple(rows), arrays)


def _claims(results: Results) -> Sequence[Claim]:
    quality, races = results.table.where(part="quality"), results.table.where(part="speed")
    dots = Table(tuple(row for row in races.rows if row["patterns"] != 1))
    speed = races.where(sensor=WHOLE)

    def times(rows: Table, column: str, over: str, least: float) -> Judge:
        def judge(psf: str) -> tuple[str, Holds]:
            found = np.divide(rows.numbers(column, psf=psf), rows.numbers(over, psf=psf))
            ends = dict.fromkeys(f"{float(f'{each:.2g}'):g}" for each in (found.min(), found.max()))
            # Seconds vary by factors; numbers of patterns stand for repeats.
            ratio = Mean.of_numbers(list(np.log(found)), f"{column} over {over}")
            return f"{' to '.join(ends)} times as long", within(ratio, low=float(np.log(least)))

        return judge

    def directly(claim: str, sensor: str) -> list[Claim]:
        rows = dots.where(sensor=sensor)
        return (
            [_judged(rows, claim, "no closed form", times(rows, "iterative_s", "direct_s", _GOAL))] if rows.rows else []
        )

    return [
        _stated(quality.where(patterns=1), "Uniform light", _UNIFORM_DB),
        _stated(quality.where(patterns=49), "49 dots", _DOTS_DB),
        _judged(
            speed, "Iterations take an order of magnitude longer than the separable closed form", "10 times as long",
            times(speed, "iterative_s", "separable_s", _MAGNITUDE),
        ),
        *directly("Dots can be solved directly, and iterations to equal error take ten times as long", WHOLE),
        *directly("The same where the sensor ends at the picture's edge, prepared once", CROPPED),
        _judged(
            speed, "Even so, it takes longer than the separable closed form", "",
            times(speed, "direct_s", "separable_s", 1.0),
        ),
    ]  # fmt: skip


def _stated(rows: Table, name: str, band: tuple[float, float]) -> Claim:
    """A claim of PSNR within a ``band`` [dB] of what is called ``name``, at each way of exposing."""
    means = {
        (psf, exposure): sampled(rows.where(psf=psf, exposure=exposure), "psnr_db")
        for psf in rows.distinct("psf")
        for exposure in EXPOSURES
    }
    at = {
        exposure: every(*(near(mean, band) for (_, each), mean in means.items() if each == exposure))
        for exposure in EXPOSURES
    }

    def said(psf: str) -> tuple[str, Holds]:
        return "; ".join(f"{exposure}: {means[psf, exposure]} dB" for exposure in EXPOSURES), None

    claim = _judged(rows, f"{name}: {band[0]:g} to {band[1]:g} dB", f"{band[0]:g} to {band[1]:g} dB", said)
    return replace(claim, verdict=verdict_at(at))


def _judged(rows: Table, claim: str, paper: str, judge: Judge) -> Claim:
    """A claim judged with each point spread function that was measured with; the measured one stands under "idealised".

    Parameters
    ----------
    rows
        what was measured.
    claim, paper
        what the paper says.
    judge
        from a point spread function to what is said of it, and whether the claim holds for it.
    """
    said = {psf: judge(psf) for psf in rows.distinct("psf")}
    told = {psf: f"{psf} PSF: {text}" for psf, (text, _) in said.items()}
    holds = verdict(every(*(each for _, each in said.values())))
    return Claim(claim, paper, told.get(MEASURED, ""), told[TRACED], holds)


def _figures(results: Results) -> Mapping[str, Figure]:
    quality, speed = results.table.where(part="quality"), results.table.where(part="speed")
    psfs = quality.distinct("psf")
    drawn = {}
    for exposure in EXPOSURES:
        rows = quality.where(exposure=exposure)
        lines = {f"{psf} point spread function": rows.where(psf=psf).means("psnr_db", "patterns") for psf in psfs}
        drawn[f"psnr_{exposure.replace(' ', '_')}.png"] = curves(
            {"": lines},
            "frames",
            log=True,
            title=f"PSNR by the number of frames, exposure {exposure}, best lambda",
        )
    drawn["seconds.png"] = _seconds(speed, psfs)
    few = [each for each in quality.distinct("patterns") if each in (1, 9, 49)]
    grid = {}
    for psf in psfs:
        for name in (*QUICK_IMAGES, None):
            rows = quality.where(psf=psf, picture=name, exposure=EQUAL_FRAME)
            cells = [(results.array(row), row) for each in few for row in rows.where(patterns=each).rows[:1]]
            kept = [(image, f"{row['psnr_db']:.1f} dB") for image, row in cells if image is not None]
            if len(kept) == len(few):
                grid[f"{name or 'scene'}, {psf}"] = kept
    if grid:
        columns = [f"{count} frame{'s' if count > 1 else ''}" for count in few]
        drawn["images.png"] = image_grid(grid, columns, f"Images, exposure {EQUAL_FRAME}, best lambda")
    return drawn


def _seconds(speed: Table, psfs: Sequence[str]) -> Figure:
    """CPU seconds of both solvers and of a separable camera's, by the number of dots."""
    panels = {}
    for psf in psfs:
        rows = speed.where(psf=psf, sensor=WHOLE)
        names = {"iterative": "iterative_s", "direct": "direct_s", "separable camera": "separable_s"}
        panels[f"{psf} point spread function"] = {
            name: rows.means(column, "patterns") for name, column in names.items()
        }
    figure = curves(
        panels,
        "frames",
        "processor time [s]",
        log=True,
        title="Time of the solvers by the number of frames, at equal error",
    )
    for axes in figure.axes:
        axes.set_yscale("log")
    return figure


EXPERIMENT = Experiment(
    "convolutional",
    "A diffuser for a mask",
    "What do dots bring to a DiffuserCam, and is there no direct solution?",
    _points, _measure, _claims, _figures,
    note="A frame is the scene convolved with the camera's point spread function (PSF), that of a rendered diffuser "
    "and, with -D psf=FILE, a measured one besides, which then stands under Idealised; no light of a scene is "
    "traced. The sensor gets all light. Best lambda: that of the highest PSNR. Times are processor seconds on one "
    "thread.",
    traced=False,
)  # fmt: skip
