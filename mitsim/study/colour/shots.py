"""Light of each line in, and filters over the sensor's pixels; frames that show all lines at once, and images, out.

Three ways to images of the lines are compared (:mod:`mitsim.study.colour.ways`), all with factors that were calibrated
line by line, each with its best lambda.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mitsim.capture.exposer import Exposer
from mitsim.core import colours
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import load_model, locate
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import integer
from mitsim.reconstruct.mosaic import behind
from mitsim.rig.patterns import PatternFamily
from mitsim.rig.sensor import SensorModel
from mitsim.study.colour.lit import LitLine
from mitsim.study.colour.ways import MosaicCamera, Solver, solver_of
from mitsim.study.exposures import LAMBDAS
from mitsim.study.metrics import psnr

DEMOSAICED, HALF, JOINT = "demosaiced", "half resolution", "joint"
WAYS = {DEMOSAICED: colours.DEMOSAIC, HALF: colours.HALF, JOINT: colours.JOINT}
"""Names in tables, and those of the ways."""
FILTERS, ARRAY = "ov5647", "RGGB"
"""Camera file whose measured curves the filters have, and their array."""
_COARSE = tuple(float(relative) for relative in np.logspace(-9, -3, 7))
"""Lambdas of the joint solve, of its largest eigenvalue; the best of them is refined by half a decade."""
Lines = Sequence[LitLine]


def installed() -> tuple[str, ...]:
    """Those of :data:`WAYS` that are: demosaicing is an extra."""
    return tuple(name for name, way in WAYS.items() if way in colours.installed_ways())


@dataclass(frozen=True, eq=False)
class MosaicShots:
    """One noisy exposure of a family on a sensor with filters.

    Attributes
    ----------
    lines
        light and factors of each line.
    family
        the patterns.
    frames
        (frame (m, m') [electrons/s], row, column) of every pattern.
    """

    lines: Lines
    family: PatternFamily
    frames: tuple[tuple[FloatArray, int, int], ...]

    @property
    def truth(self) -> FloatArray:
        """(lines, n, n') reflectance at each line."""
        return np.stack([line.lit.truth for line in self.lines])

    def images(self, way: str) -> FloatArray:
        """(lines, n, n') images of the lines by a ``way``, one of :data:`WAYS`, with the best lambda for the truth.

        MitsimError for demosaicing without colour-demosaicing.
        """
        solver = solver_of(WAYS[way], self.camera, patterns_of(self.family))
        with single_threaded_blas():
            return self._best(solver, way)

    def _best(self, solver: Solver, way: str) -> FloatArray:
        for each in self.frames:
            solver.add(*each)
        flat, solved = self.truth.reshape(len(self.lines), -1), dict[float, FloatArray]()

        def quality(lam: float) -> float:
            if lam not in solved:
                solved[lam] = solver.images(lam, relative=True).images
            return psnr(solved[lam].reshape(flat.shape), flat)

        best = max(_COARSE if way == JOINT else LAMBDAS, key=quality)
        if way == JOINT:
            best = max((best, best * 10**0.5, best / 10**0.5), key=quality)
        return solved[best]

    @cached_property
    def camera(self) -> MosaicCamera:
        """Factors of all lines, and filters."""
        factors = [(line.factors.left, line.factors.right) for line in self.lines]
        return MosaicCamera.of(factors, filter_weights(self.lines), ARRAY)


def patterns_of(family: PatternFamily) -> tuple[FloatArray, FloatArray]:
    """P_L (n, K) and P_R (n', K') of a ``family``."""
    return family.left.astype(np.float64), family.right.astype(np.float64)


def mosaic_shots(lines: Lines, patterns: str, seed: int) -> MosaicShots:
    """All lines shown at once, at equal peak, on the scene's camera behind filters.

    Parameters
    ----------
    lines
        light and factors of each line.
    patterns, seed
        the family, and seed of the noise.

    Raises
    ------
    MitsimError
        for a line that the filters' curves do not hold.
    """
    first, family = lines[0].lit, lines[0].lit.bench.family(patterns, seed)
    rig, weights = first.bench.rig, filter_weights(lines)
    # Light, and what is noise of a shot, is of electrons: any time and wavelength between them.
    one_second = [Exposer(line.lit.bench.rig, 1.0, 0) for line in lines]
    expected = [line.lit.expected("rendered", family) for line in lines]
    rates = [
        _behind_filters([unit.electrons(frame) for unit, frame in zip(one_second, shot, strict=True)], weights)
        for shot in zip(*expected, strict=True)
    ]
    frames = exposed(Exposer(rig, peak_seconds(rig.sensor, rates), integer(seed, "mosaic")), family, rates)
    return MosaicShots(lines, family, tuple(frames))


def peak_seconds(sensor: SensorModel, rates: Sequence[FloatArray]) -> float:
    """Exposure time [s] at equal peak: of expected ``rates`` [electrons/s] and dark current the brightest pixel fills
    the default part of the ``sensor``'s full well."""
    from mitsim.capture.request import Exposure

    most = max(float(rate.max()) for rate in rates) + sensor.superpixel_dark_current_e_per_s
    return float(Exposure().fraction * sensor.superpixel_full_well_e / most)


def exposed(
    exposer: Exposer, family: PatternFamily, rates: Sequence[FloatArray], ambient: FloatArray | float = 0.0
) -> Iterator[tuple[FloatArray, int, int]]:
    """Noisy measurement (m, m') [electrons/s] of each pattern, and its indices.

    Parameters
    ----------
    exposer
        the camera.
    family
        of patterns; the halves of a signed one come as their difference.
    rates
        (m, m') expected electrons a second of each shot.
    ambient
        what is taken off every shot that is not one of a pair.
    """
    positive: FloatArray | None = None
    for shot, rate in zip(family.shots, rates, strict=True):
        noisy = exposer.rate(exposer.digital(rate * exposer.exposure_s, *shot.names))
        if shot.sign == 1:
            positive = noisy
            continue
        yield noisy - ambient if positive is None else positive - noisy, shot.row, shot.column
        positive = None


def filter_weights(lines: Lines) -> FloatArray:
    """(4, lines) electrons behind each filter of :data:`ARRAY` over those of the ``lines``' camera without filters."""
    curves = load_model(locate(FILTERS, "calibration", ".toml"), SensorModel)
    sensor = lines[0].lit.bench.sensor
    return np.array(
        [
            [curves.efficiency(line.wavelength_nm, plane) / sensor.efficiency(line.wavelength_nm) for line in lines]
            for plane in ("R", "G", "G", "B")
        ]
    )


def _behind_filters(rates: Sequence[FloatArray], weights: FloatArray) -> FloatArray:
    """(m, m') electrons a second of all lines together, each pixel behind its filter."""
    return np.asarray(np.einsum("lij,lij->ij", behind(weights, rates[0].shape), np.stack(rates)))
