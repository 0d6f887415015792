"""Light behind a diffuser against ray density in closed form, from reliefs that are sums of cosines written out here.

A ray at x lands at X(x) = x + d (n - 1) grad h(x), for small slopes. Where no two rays land at one place, the
irradiance there is T / det(1 + d (n - 1) Hess h), T being the transmittance of two faces; where they cross, it is the
sum over all x. The form leaves out what is of second order in slopes (exact refraction, and the height h beside d):
0.02^2 and 0.01 mm / 8 mm, together below 2e-3. Fixed seeds. Rays are one in each cell of a grid, so that only cells on
an area's edge count at random: of N rays, the square root of 4 sqrt(N) / 6.
"""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.transport.plugins.lens import Diffuser, Relief, point_spread, random_relief

pytestmark = pytest.mark.usefixtures("variant")
SIDE, DISTANCE, INDEX = 3.0, 8.0, 1.5
FACES = (1 - ((INDEX - 1) / (INDEX + 1)) ** 2) ** 2
"""Transmittance at normal incidence; slopes of 0.02 change it by their fourth power."""
WAVES = np.array([[2, 1, 0.3, 1.0], [-1, 3, 1.1, 0.8], [3, 2, 2.0, 0.6], [1, -2, 4.0, 1.0], [-3, 1, 5.0, 0.7]])
"""Periods along x and y of the side, phase, and relative curvature."""


def derivatives(x: np.ndarray, y: np.ndarray, strength: float) -> list[np.ndarray]:
    """h, its first and its second derivatives (xx, yy, xy) at points; ``strength`` is the largest curvature's
    d (n - 1) times."""
    parts = [np.zeros(np.broadcast(x, y).shape) for _ in range(6)]
    for along, across, phase, share in WAVES:
        u, v = 2 * np.pi * along / SIDE, 2 * np.pi * across / SIDE
        size = strength * share / WAVES[:, 3].sum() / ((u * u + v * v) * DISTANCE * (INDEX - 1))
        c, s = np.cos(u * x + v * y + phase), np.sin(u * x + v * y + phase)
        for part, term in zip(parts, (c, -u * s, -v * s, -u * u * c, -v * v * c, -u * v * c), strict=True):
            part += size * term
    return parts


def sheet(strength: float) -> Diffuser:
    across = np.linspace(-SIDE / 2, SIDE / 2, 181)
    height, slope_x, slope_y = derivatives(across[:, None], across[None, :], strength)[:3]
    return Diffuser(Relief(SIDE, height, slope_x, slope_y), INDEX, DISTANCE)


def landed(x: np.ndarray, y: np.ndarray, strength: float) -> tuple[np.ndarray, np.ndarray]:
    _, slope_x, slope_y, *_ = derivatives(x, y, strength)
    return x + DISTANCE * (INDEX - 1) * slope_x, y + DISTANCE * (INDEX - 1) * slope_y


def test_without_crossing_rays_the_light_is_one_over_the_jacobian() -> None:
    """Curvatures of 0.6 at most: each pixel's rays come from one x, found by Newton's method.

    32 x 32 pixels of the middle 1.92 mm, 144 points and 105 rays in each: counting leaves 2.5e-2 of a pixel, 1.1e-3 of
    blocks of 8 x 8. Measured: 2.6e-2 and 1.2e-3, rms, with values of 0.57 to 1.39.
    """
    pitch, strength = 0.06, 0.6
    light = point_spread(sheet(strength), (32, 32), pitch, rays=512)
    offsets = ((np.arange(32 * 12) + 0.5) / 12 - 16) * pitch
    target_y, target_x = -offsets[:, None], -offsets[None, :]
    x, y = np.broadcast_arrays(target_x, target_y)
    for _ in range(12):
        _, a, b, xx, yy, xy = (DISTANCE * (INDEX - 1) * part for part in derivatives(x, y, strength))
        miss_x, miss_y = x + a - target_x, y + b - target_y
        determinant = (1 + xx) * (1 + yy) - xy * xy
        x = x - ((1 + yy) * miss_x - xy * miss_y) / determinant
        y = y - ((1 + xx) * miss_y - xy * miss_x) / determinant
    assert max(np.abs(miss_x).max(), np.abs(miss_y).max()) < 1e-9 and determinant.min() > 0.2
    expected = (FACES / determinant).reshape(32, 12, 32, 12).mean(axis=(1, 3))
    ratio = light / expected - 1
    blocks = ratio.reshape(4, 8, 4, 8).mean(axis=(1, 3))
    figures = float(np.sqrt(np.mean(ratio**2))), float(np.sqrt(np.mean(blocks**2)))
    assert figures[0] < 3e-2 and figures[1] < 3e-3


def test_a_flat_sheet_moves_tilted_light_by_snell_s_law() -> None:
    """The shadow of the sheet's square, d times the tangent from where light left it; all of it, less two reflections.

    The middle of 0.02 mm pixels: exact by symmetry where edges fall on pixels' edges, else to a fraction of a pixel.
    """
    flat, tilt = np.zeros((3, 3)), (0.15, 0.1)
    light = point_spread(Diffuser(Relief(0.4, flat, flat, flat), INDEX, DISTANCE), (400, 400), 0.02, tilt, rays=128)
    rows, columns = np.nonzero(light)
    weight = light[rows, columns]
    middle_x = -((columns + 0.5 - 200) * weight).sum() / weight.sum() * 0.02
    middle_y = -((rows + 0.5 - 200) * weight).sum() / weight.sum() * 0.02
    assert (middle_x, middle_y) == pytest.approx((DISTANCE * tilt[0], DISTANCE * tilt[1]), abs=2e-3)
    size = np.hypot(*tilt)
    cosine = 1 / np.sqrt(1 + size**2)
    inside = np.sqrt(1 - (1 - cosine**2) / INDEX**2)
    s, p = (cosine - INDEX * inside) / (cosine + INDEX * inside), (INDEX * cosine - inside) / (INDEX * cosine + inside)
    assert light.sum() * (0.02 / 0.4) ** 2 == pytest.approx((1 - (s**2 + p**2) / 2) ** 2, rel=1e-4)


def test_a_random_relief_has_the_slope_and_correlation_that_were_asked_for() -> None:
    """Slopes of a surface with correlation c have the autocorrelation (1 - r^2 / c^2) exp(-r^2 / (2 c^2)) along r.

    24 correlation lengths a side, seed 5: some 24^2 / 6 independent patches, 10 % of the variance.
    """
    relief = random_relief(6.0, 0.25, 0.03, 5)
    step = relief.side_mm / (len(relief.height_mm) - 1)
    assert np.sqrt((relief.slope_x**2 + relief.slope_y**2).mean() / 2) == pytest.approx(0.03, rel=1e-9)
    differences = np.gradient(relief.height_mm, step)
    for slope, difference in zip((relief.slope_x, relief.slope_y), differences, strict=True):
        # Central differences are off by step^2 / 6 of the third derivative, here 0.4 %.
        inner = (slice(2, -2),) * 2
        assert np.linalg.norm((slope - difference)[inner]) < 8e-3 * np.linalg.norm(slope[inner])
    variance = (relief.slope_x**2).mean()
    for steps in (6, 12, 24):
        r = steps * step / 0.25
        found = (relief.slope_x[steps:] * relief.slope_x[:-steps]).mean() / variance
        assert found == pytest.approx((1 - r**2) * np.exp(-(r**2) / 2), abs=0.1)
    other = random_relief(6.0, 0.25, 0.03, 6)
    assert not np.array_equal(relief.height_mm, other.height_mm)


@pytest.mark.parametrize("values", [(6.0, 2.0, 0.1), (6.0, 0.0, 0.1), (6.0, 0.3, 0.0), (6.0, 0.3, 0.9)])
def test_reliefs_that_are_none_are_refused(values: tuple[float, float, float]) -> None:
    with pytest.raises(MitsimError, match="give a correlation above 0"):
        random_relief(*values, seed=0)
