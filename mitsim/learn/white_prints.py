"""Light of a bench whose prints are white in; light, frames and truth of any picture on them out.

Each cell of the light lies in one pixel of the picture, so the picture's light is that of the white print, cell by cell
times the reflectance of its pixel. That holds for light which goes from one flat sheet straight to the sensor, however
the projector blurs, scatters or leaks it; :func:`mitsim.bench.prints.traced_anew` says where it does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from mitsim.bench.apparatus import Apparatus
from mitsim.core.arrays import FloatArray, Labels
from mitsim.devices.patterns import PatternFamily
from mitsim.learn.pair_store import PrintLight, PrintPart
from mitsim.light.light import SampledLight, traced_again
from mitsim.light.simulation import Simulation, emission
from mitsim.optics.image_formation import FrameOptics
from mitsim.report.lit_scene import IdealCamera
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.transport.records import Bundle

_STRAIGHT = ("fine", "anchor_residual")
"""Grids of light from one surface straight to the sensor."""


@dataclass(frozen=True, eq=False)
class WhitePrints:
    """A bench whose prints are white, in its light.

    Attributes
    ----------
    light
        merged into one group.
    white
        (n, n) apparent reflectance of the white prints.
    shares
        (n^2, n^2) part of each projector pixel's direct light that each pixel of the picture sends on.
    warnings
        of the light.
    """

    light: SampledLight
    white: FloatArray
    shares: sparse.csr_array
    warnings: tuple[str, ...]

    @classmethod
    def of(cls, light: SampledLight) -> WhitePrints:
        """Of the ``light`` of a bench with white prints."""
        direct, settings = light, light.plan.settings
        if "glare" in settings.effects:  # which is in no truth
            without = replace(settings, effects=settings.effects - {"glare"})
            direct = traced_again(light, Simulation(light.bench, without))
        pixels, fine = light.bench.n**2, direct.merge()
        bundle = fine.simulation.grids["fine"].bundle
        rows, columns = picture_axes(fine, bundle)
        of_place = (rows[:, None] * light.bench.n + columns).ravel()
        entries = (np.ones(len(of_place)), (np.arange(len(of_place)), of_place))
        seen = fine.groups[0]["fine"][:pixels] @ sparse.csr_array(entries, shape=(len(of_place), pixels))
        total = np.asarray(seen.sum(axis=1))
        inverse = np.divide(1.0, total, out=np.zeros_like(total), where=total > 0)
        shares = sparse.csr_array(sparse.diags_array(inverse) @ seen)
        return cls(light.merge(), light.truth, shares, (*light.warnings, *light.unreached))

    def truth(self, reflectance: FloatArray) -> FloatArray:
        """(n, n) apparent reflectance of prints that show a picture of ``reflectance`` (n, n)."""
        return np.asarray(self.white * (self.shares @ reflectance.ravel()).reshape(self.white.shape))

    def rendered_light(self, bench: Apparatus, family: PatternFamily) -> PrintLight:
        """The light by the classes of a ``family``, before the mask of a ``bench``."""
        light = self.light.behind(bench)
        simulation, estimate, pixels = light.simulation, light.groups[0], bench.n**2
        lighting, unit, parts = family.lighting, electrons_per_joule(bench), list[PrintPart]()
        classes = int(lighting.labels.max()) + 1
        by_class = sparse.csr_array((np.ones(pixels), (lighting.labels, np.arange(pixels))), shape=(classes, pixels))
        lamps = [
            (name, grid, pixels + band) for band, grids in enumerate(simulation.by_band) for name, grid in grids.items()
        ]
        for name, grid, row in [*((name, grid, None) for name, grid in simulation.grids.items()), *lamps]:
            of_grid = estimate[name]
            own = by_class @ of_grid[:pixels] if row is None else of_grid[[row]]
            if own.nnz:
                assert name in _STRAIGHT and len(grid.bundle.depths) == 1, "light of one flat sheet alone"
                own = sparse.csr_array(own * unit)
                own.sort_indices()
                parts.append(PrintPart(grid.optics, own, *picture_axes(light, grid.bundle), row is not None))
        return PrintLight(tuple(parts), emission(simulation.physics, lighting))

    def ideal_light(self, family: PatternFamily) -> PrintLight:
        """The light of the separable model by the classes of a ``family``: even on all pixels, the mask without
        diffraction."""
        bench, lighting = self.light.bench, family.lighting
        pixels, classes = bench.n**2, int(lighting.labels.max()) + 1
        sides = IdealCamera(bench, bench.geometry.mask).directions
        optics = FrameOptics(bench.geometry, *sides, (bench.geometry.scene_distance,), 1, None)
        even = float(self.light.apparent.board_flux.mean()) * electrons_per_joule(bench) * self.white.ravel()
        light = sparse.csr_array((even, (lighting.labels, np.arange(pixels))), shape=(classes, pixels))
        line = np.arange(bench.n)
        return PrintLight((PrintPart(optics, light, line, line, False),), lighting.weights)


def picture_axes(light: SampledLight, bundle: Bundle) -> tuple[Labels, Labels]:
    """Row and column of the picture's pixel that each row and column of a ``bundle``'s cells lies in, in a ``light``:
    beyond the projector's window the nearest."""
    axes = zip((bundle.grid.rows, bundle.grid.columns), light.bench.windows_at(light.plan.settings.depth), strict=True)
    n = light.bench.n
    rows, columns = (
        np.clip(np.floor(((each.edges[:-1] + each.edges[1:]) / 2 - near) / (far - near) * n), 0, n - 1).astype(np.int64)
        for each, (near, far) in axes
    )
    return rows, columns


def electrons_per_joule(bench: Apparatus) -> float:
    """Electrons a second of a pixel in light of 1 W m^-2 on the camera of a ``bench``."""
    wavelength = bench.projector.effective_wavelength_nm
    return float(electrons_from_irradiance(1.0, 1.0, bench.sensor, wavelength))
