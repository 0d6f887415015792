"""A convolutional camera, a reflectance image and a sensor in; noisy frames and the best image they give out.

The paper's simulation of coded illumination with a DiffuserCam (its section "Coded Illumination with Nonseparable
Systems"), with the noise and the exposure conventions of :mod:`mitsim.study.exposures`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mitsim.capture.request import Exposure
from mitsim.core.arrays import FloatArray
from mitsim.core.seeds import stream
from mitsim.reconstruct.convolution import ConvolutionalCamera, ConvolutionSolution
from mitsim.reconstruct.dots import Classes
from mitsim.rig.patterns import PatternFamily, parse_patterns
from mitsim.rig.sensor import SensorModel
from mitsim.sensor.chain import dn_to_electrons, electrons_from_irradiance, expose, exposure_for_peak
from mitsim.study.exposures import CONVENTIONS
from mitsim.study.metrics import psnr

WHITE_W_M2, WAVELENGTH_NM = 0.3, 550.0
"""Irradiance where all light of a white, uniformly lit scene falls: the paper's projector (0.14 W over 120 mm square
at 400 mm) on a bare sensor, 9.7 W m^-2 / pi x 0.0144 m^2 / 0.16 m^2; in green. Exposure follows the peak, so both
only set how much dark current there is."""
_LEAST_LAMBDA = 1e-9
"""Lambda over the largest of S at which the search for the best one ends: shot noise of full wells calls for 1e-7."""
_BEYOND_DB = 2.0
"""Fall of PSNR below the best so far at which the search, from large lambda to small, is over."""
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
        of exposure, one of :data:`mitsim.study.exposures.CONVENTIONS`.
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
    full = sensor.superpixel_full_well_e * sensor.gain_dn_per_e + sensor.superpixel_black_level_dn
    frames, saturated = np.empty_like(expected), 0
    for index, frame in enumerate(expected):
        shot, read = (stream(seed, "diffuser camera", noise, family.name, index) for noise in ("shot", "read"))
        digital = expose(frame * unit, time, sensor, shot, read)
        saturated += int(np.count_nonzero(digital >= min(full, sensor.largest_dn or np.inf)))
        frames[index] = (dn_to_electrons(digital, sensor) - dark) / unit
    return DiffuserShots(frames, time, saturated / frames.size)


def best_by_psnr(
    solve: Callable[[float], ConvolutionSolution], truth: FloatArray, largest: float
) -> tuple[ConvolutionSolution, float]:
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


def best_image(classes: Classes, shots: DiffuserShots, truth: FloatArray) -> tuple[ConvolutionSolution, float]:
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
