"""Global light of an ideal camera in numpy: light that is linear between dots is found to the last digits."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import parse_patterns
from mitsim.reconstruct.solver import prepare
from mitsim.studies.light_studies import separate
from tests.ideal_sessions import picture, shadow

N = 32
FACTOR = shadow(n=N)


@pytest.mark.parametrize("patterns", ["dots:4", "dots:7", "dots:2x4"])
def test_light_that_is_linear_between_dots_is_found_exactly(patterns: str) -> None:
    """A plane that rises along both axes is linear between any nodes. (Planted: the part of lit pixels not taken off;
    half of the common light.)"""
    family, scene = parse_patterns(patterns, N), picture(n=N)
    sides = family.left.astype(np.float64), family.right.astype(np.float64)
    rows, columns = np.mgrid[:N, :N] / N
    haze = FACTOR @ (0.3 + 0.2 * rows + 0.1 * columns - 0.15 * rows * columns) @ FACTOR.T
    frames = [FACTOR @ (family.light(shot) * scene) @ FACTOR.T + haze for shot in family.shots]
    model = prepare(FACTOR, FACTOR, *sides)
    whole = model.accumulator(family.measurements(frames)).sum
    common = separate(model, (FACTOR, FACTOR), sides, whole, np.sum(frames, axis=0))
    np.testing.assert_allclose(common, haze, atol=1e-7 * haze.max())
    rest = model.accumulator(family.measurements(frame - common for frame in frames))
    np.testing.assert_allclose(model.solve(rest, 0).image, scene, atol=1e-6)


def test_uniform_light_shows_no_global_light() -> None:
    """Global light looks like an image there."""
    family = parse_patterns("uniform", N)
    frame, sides = FACTOR @ picture(n=N) @ FACTOR.T, (family.left.astype(float), family.right.astype(float))
    with pytest.raises(MitsimError, match="use dots:K with K of 2"):
        separate(prepare(FACTOR, FACTOR, *sides), (FACTOR, FACTOR), sides, np.ones((N, N)), frame)
