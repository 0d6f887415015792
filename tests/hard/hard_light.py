"""Plates before the small scene's sheet, direct light at the unmasked sensor, and what it must be by quadrature.

Direct light is judged by one integral that nothing of mitsim has a part in. The projector at O sends the flux
pi scale dp dq into the tan-angles dp dq, and a lit point P of BSDF f, at distance r from a sensor point, casts
E = f flux cos_P cos_a / r^2 there. Lengths are mm. Gates on Monte Carlo means are five standard deviations (of the t
distribution where few seeds tell it: 7 for eight), plus what is stated; each test asserts that its gate is narrow.
"""

import numpy as np
import pytest

from mitsim.api.bench import Bench
from mitsim.transport.direct import DirectTracer

N, SCALE, PLACE, Z = 16, 111000.0, 60.0, 400.0
SIGMAS, SEVEN = 5.0, 7.0
SLOW = pytest.mark.slow


def gauss(low: float, high: float, count: int = 24) -> tuple[np.ndarray, np.ndarray]:
    node, weight = np.polynomial.legendre.leggauss(count)
    return (low + high) / 2 + node * (high - low) / 2, weight * (high - low) / 2


def plate(place: str, bsdf: str) -> str:
    return f'<shape type="rectangle"><transform name="to_world">{place}</transform>{bsdf}</shape>'


def matt(albedo: float) -> str:
    inner = f'<bsdf type="diffuse"><spectrum name="reflectance" value="{albedo}"/></bsdf>'
    return f'<bsdf type="twosided">{inner}</bsdf>'


def seen_alone(bench: Bench, seeds: int, samples: int, anchors: int = 1, pixels: np.ndarray | None = None):
    """(seeds, anchors, anchors) direct irradiance of the unmasked sensor at each anchor."""
    tracer = DirectTracer(bench.setup, anchors, pixels=pixels)
    totals = np.zeros((seeds, anchors, anchors))
    for seed in range(seeds):
        found = tracer.trace(seed, 0, samples)
        np.add.at(totals[seed], (found.anchor_row, found.anchor_column), found.value / samples)
    return totals


def mean(totals: np.ndarray) -> tuple[float, float]:
    return float(totals.mean()), float(totals.std(ddof=1) / np.sqrt(len(totals)))


MIRROR_Z, HALF = 395.0, 30.0
SPECULAR = np.pi * SCALE / (2 * MIRROR_Z) ** 2
"""Irradiance at the sensor's centre by a perfect mirror there: the mirrored projector faces it at twice that."""


def glossy(alpha: float | None, sheet: bool = True) -> dict[str, object]:
    """A plate of 60 mm in front of the sheet that would mirror the projector into the sensor; None: a mirror."""
    kind = "conductor" if alpha is None else "roughconductor"
    rough = "" if alpha is None else f'<string name="distribution" value="ggx"/><float name="alpha" value="{alpha}"/>'
    bsdf = f'<bsdf type="{kind}"><string name="material" value="none"/>{rough}</bsdf>'
    turned = f'<scale x="{HALF}" y="{HALF}"/><rotate y="1" angle="180"/><translate x="30" z="{MIRROR_Z}"/>'
    return {"extra": plate(turned, bsdf), "sheet_z": Z if sheet else -500}


def lobe(alpha: float, row: float = 0.0, column: float = 0.0) -> float:
    """Irradiance that the plate casts on a sensor point, by quadrature.

    GGX (Walter et al. 2007): f cos_i = D G1 G1 / (4 cos_o), Fresnel 1. Gauss nodes in s, tan-angle = its place at the
    mirror's point + alpha sinh(s), follow the lobe from its core to the plate's edges.
    """
    axes = []
    for centre, low, high in ((PLACE, 0.0, 60.0), (0.0, -HALF, HALF)):
        shift = -column if centre else -row
        middle = ((shift + centre) / 2 - centre) / MIRROR_Z
        limits = ((low - centre) / MIRROR_Z - middle, (high - centre) / MIRROR_Z - middle)
        s, ds = gauss(*(float(np.arcsinh(limit / alpha)) for limit in limits), 200)
        axes.append((centre + MIRROR_Z * (middle + alpha * np.sinh(s)), alpha * np.cosh(s) * ds))
    (x, dp), (y, dq) = axes
    point = np.stack(np.broadcast_arrays(x[:, None], y[None, :], MIRROR_Z), axis=-1)
    to_source = np.array([PLACE, 0, 0]) - point
    to_sensor = np.array([-column, -row, 0]) - point
    r = np.linalg.norm(to_sensor, axis=-1)
    i, o = to_source / np.linalg.norm(to_source, axis=-1)[..., None], to_sensor / r[..., None]
    h = (i + o) / np.linalg.norm(i + o, axis=-1)[..., None]
    cos_i, cos_o, cos_h = -i[..., 2], -o[..., 2], -h[..., 2]
    tan2 = lambda cosine: 1 / cosine**2 - 1  # noqa: E731
    d = 1 / (np.pi * alpha**2 * cos_h**4 * (1 + tan2(cos_h) / alpha**2) ** 2)
    g = [2 / (1 + np.sqrt(1 + alpha**2 * tan2(cosine))) for cosine in (cos_i, cos_o)]
    f = d * g[0] * g[1] / (4 * cos_i * cos_o)
    return float(np.pi * SCALE * dp @ (f * cos_o * cos_o / r**2) @ dq)
