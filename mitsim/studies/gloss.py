"""Light of a glossy scene and of its matt twin in; out comes an image, and its error split by cause.

At one lambda an image R(Y) is linear in the frames Y, so its error against the reflectance L of the matt twin is a sum
of differences that leaves nothing over. With t the apparent reflectance of the glossy scene, its mean over the sensor,

    pixels           = t - L                         brightness that is not the matt one
    sensor           = R(Y_direct) - R(Y_even)       light of a projector pixel that changes over the sensor
    interreflection  = R(Y_all) - R(Y_direct)
    saturation       = R(what the sensor reads of Y_all in the mean) - R(Y_all)
    rest             = R(Y_even) - t and noise       what a matt scene of the same brightness has as well

Y_even is the twin's light, that of each projector pixel times t / L: as bright, from the same places, but matt.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from mitsim.core.arrays import FloatArray
from mitsim.core.parallel import single_threaded_blas
from mitsim.light.grids import LightEstimate
from mitsim.light.light import SampledLight
from mitsim.optics.frames import ExpectedFrames, Frame
from mitsim.reconstruct.solver import Prepared
from mitsim.reconstruct.status import Solution
from mitsim.report.exposures import RENDERED, LitScene, Unexposed
from mitsim.sensor.moments import frame_moments

PIXELS, SENSOR, INTERREFLECTION, SATURATION, REST = CAUSES = (
    "pixels", "sensor", "interreflection", "saturation", "rest",
)  # fmt: skip
_DARK = 1e-3
"""Reflectance below which a pixel of the twin has no light to be scaled: shadows, beyond which sampling decides."""


@dataclass(frozen=True, eq=False)
class Split:
    """The image of one noisy exposure, and its error against the matt twin's reflectance.

    Attributes
    ----------
    solution
        with the image (n, n).
    parts
        (n, n) by :data:`CAUSES`; image and the twin's reflectance are their sum apart.
    """

    solution: Solution
    parts: Mapping[str, FloatArray]


@single_threaded_blas()
def split(frames: Unexposed, twin: LitScene, seconds: float) -> Split:
    """The image of an exposure of so many ``seconds``, and what each cause puts into it.

    Parameters
    ----------
    frames
        rendered, under a family whose every pattern is one shot.
    twin
        the same scene without gloss, in its light.
    seconds
        of each frame.
    """
    model, sums = frames.data(seconds)
    solution, exposer = model.solve(sums), frames.exposer(seconds)
    lit, family = frames.lit, frames.family

    def light(frame: Frame) -> FloatArray:
        return exposer.electrons(frame) / seconds

    def read(frame: Frame) -> FloatArray:
        mean, _ = frame_moments(exposer.electrons(frame), seconds, lit.bench.sensor)
        return exposer.rate(mean)

    def image(expected: ExpectedFrames, seen: Callable[[Frame], FloatArray]) -> FloatArray:
        return _image(model, frames, solution.lam, expected, seen)

    own, matt = lit.truth, twin.truth
    even, direct = (
        LitScene(each).expected(RENDERED, family) for each in (as_bright(twin.light, lit.light), direct_of(lit.light))
    )
    images = [image(even, light), image(direct, light), image(frames.expected, light), image(frames.expected, read)]
    parts = {
        PIXELS: own - matt,
        SENSOR: images[1] - images[0],
        INTERREFLECTION: images[2] - images[1],
        SATURATION: images[3] - images[2],
    }
    return Split(solution, {**parts, REST: solution.image - matt - sum(parts.values())})


def direct_of(light: SampledLight) -> SampledLight:
    """A ``light`` without what was followed over several surfaces."""

    def without(part: LightEstimate) -> LightEstimate:
        return part.with_light({name: sparse.csr_array(part[name].shape) for name in ("indirect", "indirect_residual")})

    return replace(light, groups=tuple(without(group) for group in light.groups))


def as_bright(matt: SampledLight, glossy: SampledLight) -> SampledLight:
    """Direct light of a ``matt`` scene, made as bright as that of a ``glossy`` one, projector pixel by projector pixel.

    By what was traced into the frames, not by the truth: what sampling left in a pixel's brightness is no gloss.
    """
    lit = matt.flux > _DARK * matt.apparent.board_flux
    ratio = np.divide(glossy.flux, matt.flux, out=np.zeros_like(glossy.flux), where=lit)
    rows = sparse.diags_array(np.append(ratio, 1.0))  # the last row is ambient light
    matt = direct_of(matt)
    groups = (
        each.with_light({grid: sparse.csr_array(rows @ light) for grid, light in each.light.items()})
        for each in matt.groups
    )
    return replace(matt, groups=tuple(groups))


def _image(
    model: Prepared, frames: Unexposed, lam: float, expected: ExpectedFrames, seen: Callable[[Frame], FloatArray]
) -> FloatArray:
    """Of ``expected`` frames as they are ``seen`` [electrons/s], without noise."""
    sums = model.accumulator()
    for shot, frame in zip(frames.family.shots, expected, strict=True):
        sums.add(seen(frame), shot.row, shot.column)
    return model.solve(sums, lam).image
