"""One map from the projector's pixels to rays, areas and flux: its uses in the renderer's and in NumPy's numbers agree.

Planted: rows and columns exchanged in ``pixel_at``, and an area of the canvas instead of a pixel, fail.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsim.transport.connect import PinholeRays, ProjectorConnector, ProjectorOptics, ProjectorRays
from mitsim.transport.plugins.base import generator
from tests.unit.transport.closed_forms import stock_projector

pytestmark = pytest.mark.usefixtures("variant")
N, PLACE = 16, (60.0, -5.0, 2.0)


@pytest.fixture
def projector(variant: str) -> ProjectorOptics:
    """A turned one, every texel of another brightness; the window lies off the canvas's centre."""
    canvas = np.random.default_rng(2).uniform(0.2, 1, (N + 4, 2 * (N + 4)))
    return ProjectorOptics(stock_projector(N + 4, 111000.0, PLACE, 7.0, canvas), N, 3, 21, canvas.shape)


def test_rays_areas_and_flux_are_of_one_map(projector: ProjectorOptics) -> None:
    pixel = np.arange(N * N)
    paths_per_sample, rng = mi.UInt32(pixel), generator(mi.UInt32(1), mi.UInt32(0))
    wavelengths = dr.zeros(mi.Ray3f).wavelengths
    rays, pinhole = ProjectorRays(projector), PinholeRays(projector, [None])
    ray = rays.sample(paths_per_sample, mi.Point2f(0.5), rng, wavelengths)
    centres = np.stack(np.divmod(pixel, N), axis=1) + 0.5
    direction = np.array(ray.d, dtype=np.float64).T
    assert np.abs(direction - pinhole.directions(centres)).max() < 2e-7
    flux = np.array(rays.flux(paths_per_sample, wavelengths), dtype=np.float64).ravel()
    assert flux == pytest.approx(pinhole.power[:, 0] * pinhole.area, rel=2e-5)
    assert len(np.unique(flux)) == N * N
    si = dr.zeros(mi.SurfaceInteraction3f, N * N)
    si.p = mi.Point3f((pinhole.origin + 500 * direction).T.astype(np.float32))
    connection = ProjectorConnector(projector).connect(si, rng, mi.Bool(True))
    assert np.array_equal(np.array(connection.pixel), pixel)
