"""A convolutional camera, a reflectance image and a sensor in; noisy frames and the best image they give out.

The paper's simulation of coded illumination with a DiffuserCam (its section "Coded Illumination with Nonseparable
Systems"), with the noise and the exposure conventions of :mod:`mitsim.report.exposures`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from mitsim.api.bench import Bench
from mitsim.bench.request import Exposure
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.seeds import stream
from mitsim.devices.patterns import PatternFamily, parse_patterns
from mitsim.devices.sensor import SensorModel
from mitsim.metrics import psnr, relative_error
from mitsim.reconstruct.convolution import Classes, ConvolutionalCamera, FactorisedClasses, solve_iteratively
from mitsim.reconstruct.solver import prepare
from mitsim.reconstruct.status import Solution
from mitsim.report.exposures import CONVENTIONS, IdealCamera
from mitsim.sensor.chain import dn_to_electrons, electrons_from_irradiance, expose, exposure_for_peak

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
        (patterns, rows, columns) in the unit of ``ConvolutionalCamera.frames``: a white scene is 1.
    exposure_s
        of each shot.
    saturated
        part of all numbers that reached the full well or the converter's end.
    """

    frames: FloatArray
    exposure_s: float
    saturated: float


def take(
    camera: ConvolutionalCamera,
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
        of exposure, one of :data:`mitsim.report.exposures.CONVENTIONS`.
    seed
        of the noise.
    """
    expected = np.maximum(np.stack(list(camera.frames(family, reflectance))), 0.0)  # transforms leave 1e-17 below zero
    peak = float(expected.max())
    if convention != CONVENTIONS[0]:
        peak = max(float(frame.max()) for frame in camera.frames(parse_patterns("uniform", camera.n), reflectance))
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
        near = [solve(best.lam * 10**move) for move in (-step, step)]
        best = max([best, *near], key=lambda solution: psnr(solution.image, truth))
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
    projected = classes.projected(shots.frames)
    return best_by_psnr(lambda lam: classes.factorise(lam).solve(projected), truth, classes.largest)


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
    family = parse_patterns(f"dots:{classes.k}", camera.n)
    lam = best_image(whole, take(whole.camera, family, truth, sensor, seed=seed), truth)[0].lam
    frames = take(camera, family, truth, sensor, seed=seed).frames
    start = time.process_time()
    factorised = Classes(camera, classes.k).factorise(lam)
    prepare_s = time.process_time() - start
    exact, direct_exact_s = _timed(factorised, frames, _TIGHT)
    direct, direct_s = _timed(factorised, frames, _LOOSE)
    marks = _Marks(exact.image, truth, time.process_time())
    iterative = solve_iteratively(camera, family, frames, lam, 0.0, _MOST_STEPS, marks)
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


def _timed(factorised: FactorisedClasses, frames: FloatArray, tolerance: float) -> tuple[Solution, float]:
    """Solution of frames, and its CPU seconds."""
    start = time.process_time()
    solution = factorised.solve(factorised.classes.projected(frames), tolerance)
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
