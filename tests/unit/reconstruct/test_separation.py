"""Global light of an ideal camera in numpy: linear between nodes it is found to the last digits, spread by an invented
matrix as far as its smoothness goes.

The camera is that of `tests.ideal_sessions` with 32 x 32 pixels on 96 x 96.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import PatternFamily, parse_patterns
from mitsim.reconstruct.focus import Separation, separate
from mitsim.reconstruct.solver import Prepared, prepare
from tests.ideal_sessions import picture, shadow

N = 32
FACTOR = shadow(n=N)


def sides_of(family: PatternFamily) -> tuple[np.ndarray, np.ndarray]:
    return family.left.astype(np.float64), family.right.astype(np.float64)


def separated(family: PatternFamily, frames: list[np.ndarray]) -> tuple[Prepared, Separation, np.ndarray]:
    """The model, what was told apart, and the image once the common part is taken off."""
    model = prepare(FACTOR, FACTOR, *sides_of(family))

    def summed(less: np.ndarray | float) -> object:
        sums = model.accumulator()
        for shot, frame in zip(family.shots, frames, strict=True):
            sums.add(frame - less, shot.row, shot.column)
        return sums

    whole = summed(0.0)
    found = separate(model, (FACTOR, FACTOR), sides_of(family), whole.sum, np.sum(frames, axis=0))
    return model, found, model.solve(summed(found.common), 0).image


def rms(image: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(image))))


@pytest.mark.parametrize("patterns", ["dots:4", "dots:7", "dots:2x4"])
def test_light_that_is_linear_between_dots_is_told_exactly(patterns: str) -> None:
    """A plane that rises along both axes is linear between any nodes. Modes are told to a thousandth, so the solution
    keeps 1e-16 / 1e-3 of its digits. (Planted: lit pixels' part of the sum not taken off, 0.4; part forgotten.)"""
    family = parse_patterns(patterns, N)
    scene = picture(n=N)
    rows, columns = np.mgrid[:N, :N] / N
    haze = 0.3 + 0.2 * rows + 0.1 * columns - 0.15 * rows * columns
    part = family.left.mean() * family.right.mean()
    frames = [FACTOR @ (family.light(shot) * scene + part * haze) @ FACTOR.T for shot in family.shots]
    _, found, image = separated(family, frames)
    np.testing.assert_allclose(found.image, haze, atol=1e-8)
    np.testing.assert_allclose(image, scene, atol=1e-7)
    assert 0 < found.eigenvalues.min() < found.eigenvalues.max() < 1


@pytest.mark.parametrize(("width", "left"), [(3.0, 0.2), (8.0, 0.15), (20.0, 0.15)])
def test_an_invented_global_matrix(width: float, left: float) -> None:
    """Each pixel's light goes on to 0.4 of it in all others, by a normal law of ``width`` pixels: frames differ in
    their global light, and its image has edges at the window's. Under 49 dots an image that takes all light for direct
    is off by most of the global light; once separated, ``left`` of that error remains, 14 to 20 dB less. (Planted: the
    common part of half the frames.)"""
    family, scene = parse_patterns("dots:7", N), picture(n=N)
    lit = [family.light(shot) * scene for shot in family.shots]
    bounced = [0.4 * gaussian_filter(each, width, mode="constant") for each in lit]
    frames = [FACTOR @ (own + more) @ FACTOR.T for own, more in zip(lit, bounced, strict=True)]
    model, found, image = separated(family, frames)
    known = 0.4 * gaussian_filter(scene, width, mode="constant")
    sums = model.accumulator()
    for shot, frame in zip(family.shots, frames, strict=True):
        sums.add(frame, shot.row, shot.column)
    plain = model.solve(sums, 0).image
    assert rms(plain - scene) > 0.75 * rms(known)
    assert rms(image - scene) < left * rms(plain - scene)
    assert rms(found.image - known) < 0.15 * rms(known)


def test_uniform_light_tells_nothing() -> None:
    """Global light looks like an image there."""
    for patterns, reported in (("uniform", "use dots:K with K of 2"), ("hadamard:4", "takes dots")):
        family = parse_patterns(patterns, N)
        frames = [FACTOR @ picture(n=N) @ FACTOR.T for _ in family.shots]
        model = prepare(FACTOR, FACTOR, *sides_of(family))
        weights = np.ones((N, N))
        with pytest.raises(MitsimError, match=reported):
            separate(model, (FACTOR, FACTOR), sides_of(family), weights, np.sum(frames, axis=0))
