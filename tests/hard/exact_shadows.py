"""Step functions and masks in; their means over boxes and their geometric shadows out, in fractions of the floats."""

import math
from fractions import Fraction
from itertools import pairwise

import numpy as np
from hypothesis import strategies as st

from mitsim.devices.mask import Mask
from mitsim.optics.shadow import Directions, ShadowGeometry

EPS = np.finfo(float).eps
power = lambda low, high: st.floats(low, high).map(lambda x: 10.0**x)  # noqa: E731


def exact_mean(edges: list[Fraction], values: list[Fraction], centre: Fraction, a: Fraction, b: Fraction) -> Fraction:
    """Mean of a step function, 0 outside, over two boxes of half-widths a > 0 and b >= 0 one after the other.

    Every edge turns the second antiderivative's slope, as in (x - e)^2 / 2 beyond it, and the first's as in x - e.
    """
    total = Fraction(0)
    for edge, before, after in zip(edges, [Fraction(0), *values], [*values, Fraction(0)], strict=True):
        if before == after:
            continue
        if b == 0:
            part = sum(sign * max(centre + x - edge, Fraction(0)) for sign, x in ((1, a), (-1, -a))) / (2 * a)
        else:
            corners = ((1, a + b), (-1, a - b), (-1, b - a), (1, -a - b))
            part = sum(sign * max(centre + x - edge, Fraction(0)) ** 2 for sign, x in corners) / (8 * a * b)
        total += (after - before) * part
    return total


def mask_edges(mask: Mask) -> list[Fraction]:
    count = len(mask.bits)
    return [(k - Fraction(count, 2)) * Fraction(mask.feature_mm) for k in range(count + 1)]


def exact_shadow(setting: ShadowGeometry, at: Directions, pixel: int, cell: int) -> Fraction:
    """One entry of the thin or thick geometric shadow of a mask's own profile, in rationals of the given floats."""
    u, tau = Fraction(float(setting.pixel_centres_mm[pixel])), Fraction(float(at.centres[cell]))
    d, h = Fraction(setting.distance_mm), Fraction(setting.thickness_mm)
    z = Fraction(setting.depth_mm) if math.isfinite(setting.depth_mm) else None
    shrink = 1 - d / z if z else Fraction(1)
    edges, values = mask_edges(setting.mask), [Fraction(int(bit)) for bit in setting.mask.bits]
    if h:
        scale, shift = 1 - h / (z - d) if z else Fraction(1), h * tau / shrink
        both = sorted({*edges, *((edge - shift) / scale for edge in edges)})

        def at_face(s: Fraction) -> Fraction:
            k = math.floor(s / Fraction(setting.mask.feature_mm) + Fraction(len(values), 2))
            return values[k] if 0 <= k < len(values) else Fraction(0)

        middles = [(low + high) / 2 for low, high in pairwise(both)]
        edges, values = both, [at_face(s) * at_face(scale * s + shift) for s in middles]
    centre = u * shrink + d * tau
    return exact_mean(edges, values, centre, Fraction(setting.active_mm) * shrink / 2, d * Fraction(at.width) / 2)
