"""Lamps' light by their own spectra: what a camera counts of them in, deposits of each band of wavelengths out.

A path carries four wavelengths, one of each band, all at the same place in theirs. Places of a cell's paths follow a
scrambled Sobol sequence, so that their mean is the integral over all wavelengths, unbiased for every spectrum::

    sum over bands of L(lambda_b) counts(lambda_b) width_b / 470 nm

A spectrum that is 1 everywhere is 1 W m^-2 (sr^-1) over the 470 nm from 360 to 830 nm, so L / 470 nm is spectral.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsim.core.colours import MOST_LINES
from mitsim.rig.lamplight import SPECTRA_NM, Band, Response
from mitsim.transport.from_camera import FromCameraTracer
from mitsim.transport.histogram import Deposits
from mitsim.transport.sampling import shuffled, stratified


@dataclass(frozen=True, eq=False)
class Counted:
    """How lamps' light is counted.

    Attributes
    ----------
    response
        of the camera.
    bands
        one for each wavelength of a path; of no width where less are wanted.
    units
        irradiance [W m^-2] of each line of the projector that a count of 1 stands for.
    first
        number of the first band among all that lamps' light is told apart by.
    """

    response: Response
    bands: Sequence[Band]
    units: Sequence[float]
    first: int = 0


class LampTracer(FromCameraTracer):
    """Lamps' light alone, at wavelengths of its own. The light of band b is deposited as that of pixel n^2 + b, b from
    the first, as an irradiance of the projector's line, or of each of its lines."""

    of_projector = False
    by_line = True

    def __init__(self, like: FromCameraTracer, counted: Counted) -> None:
        """The paths of a tracer.

        Parameters
        ----------
        like
            what is followed.
        counted
            bands, and what they count.
        """
        super().__init__(like.scene, like.camera, like.projector, like.grid, like.paths, like.geometry, like.points)
        self.counted = counted
        self._alone: mi.UInt32 | None = None

    @property
    def apart(self) -> Sequence[LampTracer]:
        """Itself, or where glass parts wavelengths, the same for each band alone."""
        if not self.projector.parted:
            return [self]
        return [self._of(band) for band, (first, last) in enumerate(self.counted.bands) if last > first]

    def _of(self, band: int) -> LampTracer:
        again = copy(self)
        again._alone = dr.opaque(mi.UInt32, band)
        return again

    def wavelengths(
        self, rng: mi.PCG32, sample: mi.UInt32, shared: mi.PCG32
    ) -> tuple[mi.Color0f, mi.UnpolarizedSpectrum]:
        """Wavelengths of each path, and what its light counts at them.

        Parameters
        ----------
        rng
            not asked.
        sample, shared
            number of each path's sample, and the numbers that all samples of its cell share.
        """
        place = stratified(shuffled(sample, shared), shared).x
        counts = mi.Float(self.counted.response.counts.astype(np.float32))
        steps = len(self.counted.response.counts) - 1
        step = (SPECTRA_NM[1] - SPECTRA_NM[0]) / steps
        wavelengths, weights = [], []
        for first, last in self.counted.bands:
            width = dr.opaque(mi.Float, last - first)
            wavelength = dr.opaque(mi.Float, first) + place * width
            position = (wavelength - SPECTRA_NM[0]) / step
            below = dr.minimum(mi.UInt32(dr.maximum(position, 0)), steps - 1)
            low, high = dr.gather(mi.Float, counts, below), dr.gather(mi.Float, counts, below + 1)
            count = low + (high - low) * (position - mi.Float(below))
            wavelengths.append(wavelength)
            weights.append(MOST_LINES * count * width / (SPECTRA_NM[1] - SPECTRA_NM[0]))
        if self._alone is not None:
            chosen = [self._alone == band for band in range(len(weights))]
            weights = [dr.select(here, weight, 0) for here, weight in zip(chosen, weights, strict=True)]
            own = [dr.select(here, wavelength, 0) for here, wavelength in zip(chosen, wavelengths, strict=True)]
            wavelengths = [sum(own, mi.Float(0))] * len(own)
        return type(dr.zeros(mi.Ray3f).wavelengths)(*wavelengths), mi.Spectrum(*weights)

    def _launch(self, seed: mi.UInt32, sample: mi.UInt32, lane: mi.UInt32) -> list[Deposits]:
        return [self._by_band(found) for found in super()._launch(seed, sample, lane)]

    def _by_band(self, found: Deposits) -> Deposits:
        """An entry for each band of those that were ``found``, path by path."""
        assert found.lines is not None, "told apart by band"
        light = found.lines.T.ravel().astype(np.float64)
        several = Deposits(
            **{
                name: np.repeat(getattr(found, name), MOST_LINES)
                for name in ("anchor_row", "anchor_column", "row", "column", "inverse_depth", "kind")
            },
            pixel=(found.pixel[:, None] + self.counted.first + np.arange(MOST_LINES)).ravel(),
            value=light * self.counted.units[0],
            lane=None if found.lane is None else np.repeat(found.lane, MOST_LINES),
        )
        if not self.projector.by_line:
            return several
        units = np.zeros(MOST_LINES)
        units[: len(self.counted.units)] = self.counted.units
        return replace(several, lines=(units[:, None] * light).astype(np.float32))


class Together:
    """Light that several tracers follow, of the same samples of each."""

    def __init__(self, *tracers: FromCameraTracer) -> None:
        """``tracers`` of one scene."""
        self.tracers = tracers

    @property
    def lanes(self) -> int:
        """Paths in one sample."""
        return sum(tracer.lanes for tracer in self.tracers)

    def trace(self, seed: int, first: int = 0, samples: int = 1) -> Deposits:
        """Light of some samples, their sum; see :meth:`mitsim.transport.paths.Tracer.trace`.

        Parameters
        ----------
        seed, first, samples
            as there.
        """
        return Deposits.joined([tracer.trace(seed, first, samples) for tracer in self.tracers])

    def trace_looks(self, seeds: Sequence[int], samples: int = 1) -> list[Deposits]:
        """``samples`` as :meth:`trace` finds them for each of some ``seeds``."""
        looks = [tracer.trace_looks(seeds, samples) for tracer in self.tracers]
        return [Deposits.joined(parts) for parts in zip(*looks, strict=True)]
