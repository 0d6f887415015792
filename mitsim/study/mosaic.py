"""Light of each line in, and filters over the sensor's pixels; frames that show all lines at once, and images, out.

Three ways to images of the lines, all with factors that were calibrated line by line. *Demosaiced*: every frame becomes
three whole ones (colour-demosaicing), a solve for each channel, and channels are taken apart into lines. *Half
resolution*: a solve for each plane of filters with its own rows of the factors, no pixel interpolated. *Joint*: all
planes for all lines (:mod:`mitsim.reconstruct.mosaic`). A channel or plane that sees several lines has the one factor
that is nearest to them; only the joint solve knows that each line has its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec

import numpy as np

from mitsim.capture.exposer import Exposer
from mitsim.core.arrays import FloatArray
from mitsim.core.configuration import load_model, locate
from mitsim.core.errors import MitsimError
from mitsim.core.parallel import single_threaded_blas
from mitsim.core.seeds import integer
from mitsim.optics.separable import BestTerm, best_term
from mitsim.reconstruct.mosaic import PLANES, JointMosaic
from mitsim.reconstruct.solver import prepare
from mitsim.rig.patterns import PatternFamily
from mitsim.rig.sensor import SensorModel
from mitsim.study.exposures import LAMBDAS
from mitsim.study.lines import LitLine
from mitsim.study.metrics import psnr

DEMOSAICED, HALF, JOINT = WAYS = ("demosaiced", "half resolution", "joint")
FILTERS, ARRAY = "ov5647", "RGGB"
"""Camera file whose measured curves the filters have, and their array."""
_COARSE = tuple(float(relative) for relative in np.logspace(-9, -3, 7))
"""Lambdas of the joint solve, of its largest eigenvalue; the best of them is refined by half a decade."""
Lines = Sequence[LitLine]
Parts = Sequence[FloatArray] | FloatArray
"""Of one frame, for each plane or channel."""


def ways() -> tuple[str, ...]:
    """Those of :data:`WAYS` that are installed: demosaicing is an extra."""
    return WAYS if find_spec("colour_demosaicing") else WAYS[1:]


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
        with single_threaded_blas():
            if way == JOINT:
                return self._joint()
            return self._demosaiced() if way == DEMOSAICED else self._half()

    @cached_property
    def weights(self) -> FloatArray:
        """(4, lines) of each plane."""
        return filter_weights(self.lines)

    def _joint(self) -> FloatArray:
        lefts, rights = (np.stack([getattr(line.factors, name) for line in self.lines]) for name in ("left", "right"))
        patterns = self.family.left.astype(np.float64), self.family.right.astype(np.float64)
        model = JointMosaic(lefts, rights, self.weights, *patterns)
        gathered = np.zeros(model.shape)
        for each in self.frames:
            gathered += model.gathered(*each)
        solved: dict[float, FloatArray] = {}

        def quality(lam: float) -> float:
            if lam not in solved:
                solved[lam] = model.solve(gathered, lam * model.scale).images
            return psnr(solved[lam].reshape(len(self.lines), -1), self.truth.reshape(len(self.lines), -1))

        best = max(_COARSE, key=quality)
        best = max((best, best * 10**0.5, best / 10**0.5), key=quality)
        return solved[best]

    def _demosaiced(self) -> FloatArray:
        terms = [self._term(weights) for weights in self._channels]
        whole = ((np.moveaxis(demosaiced(frame), -1, 0), row, column) for frame, row, column in self.frames)
        return self._apart(self._channels, terms, self._solved(terms, whole))

    def _half(self) -> FloatArray:
        terms = [self._term(weights) for weights in self.weights]
        rows = [
            BestTerm(term.left[a::2], term.right[b::2], term.residual)
            for term, (a, b) in zip(terms, PLANES, strict=True)
        ]
        planes = (([frame[a::2, b::2] for a, b in PLANES], row, column) for frame, row, column in self.frames)
        return self._apart(self.weights, terms, self._solved(rows, planes))

    @property
    def _channels(self) -> FloatArray:
        """(3, lines) of red, green and blue filters."""
        return self.weights[[ARRAY.index(name) for name in "RGB"]]

    def _term(self, weights: FloatArray) -> BestTerm:
        """The one separable camera that is nearest to that of a plane's ``weights`` of all lines."""
        pairs = zip(weights, self.lines, strict=True)
        return best_term([(weight * line.factors.left, line.factors.right) for weight, line in pairs])

    def _solved(
        self, terms: Sequence[BestTerm], frames: Iterator[tuple[Parts, int, int]]
    ) -> Callable[[float], FloatArray]:
        """(terms, n, n') image of each plane or channel, by lambda of the largest sigma^2; ``frames`` have one
        part of each."""
        models = [prepare(term.left, term.right, self.family.left, self.family.right) for term in terms]
        sums = [model.accumulator() for model in models]
        for parts, row, column in frames:
            for total, part in zip(sums, parts, strict=True):
                total.add(part, row, column)
        scales = [model.problem(total).scale for model, total in zip(models, sums, strict=True)]

        def image(lam: float) -> FloatArray:
            pairs = zip(models, sums, scales, strict=True)
            return np.stack([model.solve(total, lam * scale).image for model, total, scale in pairs])

        return image

    def _apart(
        self, weights: FloatArray, terms: Sequence[BestTerm], image: Callable[[float], FloatArray]
    ) -> FloatArray:
        """(lines, n, n') from images of planes, which are mixtures of the lines' by what their factor has of each."""
        mixing = np.array(
            [
                [
                    weight * np.vdot(line.factors.left, term.left) * np.vdot(line.factors.right, term.right)
                    for weight, line in zip(row, self.lines, strict=True)
                ]
                / (np.square(np.linalg.norm(term.left)) * np.square(np.linalg.norm(term.right)))
                for row, term in zip(weights, terms, strict=True)
            ]
        )
        undo = np.linalg.pinv(mixing)
        flat = self.truth.reshape(len(self.lines), -1)
        images = (np.tensordot(undo, image(lam), axes=1) for lam in LAMBDAS)
        return max(images, key=lambda each: psnr(each.reshape(flat.shape), flat))


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


def demosaiced(frame: FloatArray) -> FloatArray:
    """(m, m', 3) red, green and blue of a ``frame`` (m, m') behind :data:`ARRAY` (Menon and others 2007).

    MitsimError without colour-demosaicing.
    """
    try:
        from colour_demosaicing import demosaicing_CFA_Bayer_Menon2007
    except ImportError as error:
        raise MitsimError(
            "demosaicing: colour-demosaicing is not installed; pip install 'mitsim[mosaic]' (Python 3.11 or newer)"
        ) from error
    return np.asarray(demosaicing_CFA_Bayer_Menon2007(frame, ARRAY), dtype=np.float64)


def _behind_filters(rates: Sequence[FloatArray], weights: FloatArray) -> FloatArray:
    """(m, m') electrons a second of all lines together, each pixel behind its filter."""
    frame = np.zeros_like(rates[0])
    for plane, (a, b) in enumerate(PLANES):
        frame[a::2, b::2] = sum(weight * rate[a::2, b::2] for weight, rate in zip(weights[plane], rates, strict=True))
    return frame
