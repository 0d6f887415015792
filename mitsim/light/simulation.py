"""A bench under one choice of settings: its passes traced, their light accumulated, and frames of it formed.

An effect that is off takes its neutral value here and nowhere else: a pinhole for the lens, a thin mask, a geometric
shadow. :mod:`mitsim.planner.pilot` switches effects on and off to see what they are worth; :mod:`mitsim.light.light`
samples the choice that the plan made.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from mitsim.bench.effects import Physics
from mitsim.core.arrays import FloatArray, Labels
from mitsim.devices.patterns import Lighting
from mitsim.light.grids import GRIDS, LightEstimate
from mitsim.light.passes import PASSES, Pass, PassTracer, Tracers
from mitsim.light.settings import PATHS_AT_ONCE
from mitsim.optics.forming import AccumulatedLight
from mitsim.optics.frames import ClassFrames, ExpectedFrames
from mitsim.transport.accumulator import DeviceAccumulator, DeviceSums
from mitsim.transport.direct import DirectTracer
from mitsim.transport.indirect import IndirectTracer
from mitsim.transport.records import DIRECT, INDIRECT, Bundle, PathSamples

_FEWEST_AT_ONCE = 2**18
"""Paths that are held in memory at a time at least, 130 MB: so many take far longer than launching them."""


@dataclass(frozen=True)
class TracedPass:
    """A pass with its tracer, and the samples of a group that the plan predicted."""

    row: Pass
    tracer: PassTracer
    predicted: float

    @property
    def whole(self) -> int:
        """Samples of a group with which the prediction is kept."""
        return int(self.row.whole(self.predicted))

    def trace(self, seed: int, first: int, samples: int, accumulator: DeviceAccumulator | None = None) -> PathSamples:
        """Light of some samples, but for what is added up in the ``accumulator``.

        Parameters
        ----------
        seed, first, samples
            as for :meth:`mitsim.transport.integrator.Tracer.trace`.
        accumulator
            of :meth:`Simulation.accumulator`.
        """
        if accumulator is None:
            return self.tracer.trace(seed, first, samples)
        assert isinstance(self.tracer, DirectTracer | IndirectTracer), "the others have none"
        return self.tracer.trace(seed, first, samples, accumulator)


class Simulation(Tracers):
    """A bench with settings: what is traced of it, and frames of what was accumulated. Its parameters are those of
    :class:`mitsim.light.grids.Grids`.
    """

    @cached_property
    def passes(self) -> Mapping[str, TracedPass]:
        """What is traced, by name, in the order of :data:`mitsim.light.passes.PASSES`."""
        found = {}
        for row in PASSES.values():
            several = not row.anchors or getattr(self.settings, row.anchors) > 1
            if several and (tracer := row.tracer(self)) is not None:
                found[row.name] = TracedPass(row, tracer, row.predicted_samples(self.settings))
        return found

    @cached_property
    def paths_at_once(self) -> int:
        """Paths whose light is held in memory at a time: as many as a pass is predicted to need, within limits; rounds
        that turn out to need more take no more memory."""
        most = max(each.whole * each.tracer.paths_per_sample for each in self.passes.values())
        paths_per_sample = max(each.tracer.paths_per_sample for each in self.passes.values())
        return max(min(max(most, _FEWEST_AT_ONCE), PATHS_AT_ONCE), paths_per_sample)

    def follow(self, seed: int, samples: int) -> PathSamples:
        """Light of :attr:`indirect` and :attr:`from_camera` in ``samples`` of each from ``seed``."""
        tracers = [tracer for tracer in (self.indirect, self.from_camera) if tracer is not None]
        return PathSamples.join([tracer.trace(seed, 0, samples) for tracer in tracers])

    # ---- Accumulation

    def accumulator(self, name: str, labels: Labels, lines: int) -> DeviceAccumulator | None:
        """What light of the lines is added up in on the device; none where the pass has none, or no room.

        Parameters
        ----------
        name
            of the pass.
        labels
            (n^2,) class of each projector pixel.
        lines
            their number.
        """
        each, bundle = self.passes[name], self.grids[PASSES[name].grids[-1]].bundle
        if not each.row.device:
            return None
        assert isinstance(each.tracer, DirectTracer | IndirectTracer), "has sums on the device"
        paths = each.predicted * each.tracer.paths_per_sample if each.row.device == "pays" else math.inf
        if each.row.flux:  # which is told pixel by pixel
            pixels, labels = self._pixels_of(each.row), np.zeros_like(labels)
            labels[pixels] = np.arange(len(pixels))
        if not DeviceAccumulator.holds(bundle, labels, lines, paths):
            return None
        return DeviceAccumulator(bundle, labels, each.tracer.board, lines)

    def accumulate(self, name: str, found: PathSamples | DeviceSums, labels: Labels, samples: int) -> LightEstimate:
        """Light of a pass per sample: by grid, beyond its mean over the anchors where these have a residual.

        Parameters
        ----------
        name
            of the pass.
        found
            paths' light on the host, or sums of an :meth:`accumulator`.
        labels
            (n^2,) class of each projector pixel.
        samples
            that were traced.
        """
        row = PASSES[name]
        if isinstance(found, DeviceSums):
            return self._of_sums(row, found, labels, samples)
        parts = {row.grid: found}
        if row.indirect_grid:
            indirect = found.kind == INDIRECT
            parts = {row.grid: found.where(~indirect), row.indirect_grid: found.where(indirect)}
        light = {grid: self.grids[grid].bundle.accumulate(part, labels, samples) for grid, part in parts.items()}
        bundle = self.grids[row.grid].bundle
        if row.anchors:
            return self._estimate({row.grid: self._residual(bundle, light[row.grid])})
        mean = found if bundle.anchors == 1 else found.average(self.mean_weights(bundle.anchors))
        received, outside = float(mean.value.sum()) / samples, bundle.outside(mean) / samples
        return self._estimate(light, received, outside, self.flux(mean, samples) if row.flux else None)

    def _of_sums(self, row: Pass, found: DeviceSums, labels: Labels, samples: int) -> LightEstimate:
        grid, (light, received, outside) = row.grids[-1], found.light(samples)
        bundle = self.grids[grid].bundle
        if row.anchors:
            return self._estimate({grid: self._residual(bundle, light)})
        if not row.flux:
            return self._estimate({grid: light}, received, outside)
        pixels, weights = self._pixels_of(row), self.mean_weights(bundle.anchors)
        beyond = np.einsum("pab,a,b->p", found.beyond(samples), weights, weights)
        by_pixel = np.asarray(bundle.average(light, weights).sum(axis=1))[: len(pixels)] + beyond
        rows = np.append(labels[pixels], labels.max() + 1 + np.arange(self.lamp_rows))
        shape = int(labels.max()) + 1 + self.lamp_rows, len(rows)
        classes = sparse.csr_array((np.ones(len(rows)), (rows, np.arange(len(rows)))), shape=shape)
        flux = np.zeros(self.bench.n**2)
        flux[pixels] = by_pixel
        light = sparse.csr_array(classes @ light)
        return self._estimate({grid: light}, float(by_pixel.sum()), float(beyond.sum()), flux)

    def _pixels_of(self, row: Pass) -> Labels:
        """Projector pixels that a pass traces."""
        sharp = self.settings.sharp if row.grid == "sharp" else None
        return np.array(sharp.pixels if sharp else range(self.bench.n**2), dtype=np.int64)

    def _residual(self, bundle: Bundle, light: sparse.csr_array) -> sparse.csr_array:
        """``light`` beyond its mean over the sensor."""
        return light - bundle.repeat(bundle.average(light, self.mean_weights(bundle.anchors)))

    def flux(self, mean: PathSamples, samples: int) -> FloatArray:
        """(n^2,) irradiance of each projector pixel's direct light, of a ``mean`` over the sensor in so many
        ``samples``."""
        value = mean.value * (mean.kind == DIRECT) / samples
        return np.asarray(np.bincount(mean.pixel, value, minlength=self.bench.n**2 + 1)[:-1], dtype=np.float64)

    def _estimate(
        self,
        light: Mapping[str, sparse.csr_array],
        received: float = 0.0,
        outside: float = 0.0,
        flux: FloatArray | None = None,
    ) -> LightEstimate:
        """``light`` in some grids, and none in the others; all else as :class:`LightEstimate` has it."""
        rows = next(iter(light.values())).shape[0]
        every = {
            name: light[name] if name in light else sparse.csr_array((rows, grid.bundle.size))
            for name, grid in self.grids.items()
        }
        return LightEstimate(every, received, outside, flux)

    # ---- Frames

    def with_optics(
        self, groups: Sequence[LightEstimate], first: int
    ) -> tuple[list[AccumulatedLight], list[AccumulatedLight]]:
        """Light of the projector and ambient light, with the optics that form their frames.

        Parameters
        ----------
        groups, first
            independent estimates of the light, and the first row of ambient light in them.
        """
        lights = [
            AccumulatedLight(self.grids[row.name].optics, tuple(_rows(group[row.name], 0, first) for group in groups))
            for row in GRIDS.values()
            if row.formed(self.settings, self.physics)
        ]
        return lights, self.of_lamps(groups, first) if self.physics.lamps else []

    def of_lamps(
        self, groups: Sequence[LightEstimate], first: int, bands: slice = slice(None)
    ) -> list[AccumulatedLight]:
        """Lamps' light with the optics that form its frames.

        Parameters
        ----------
        groups, first
            as for :meth:`with_optics`.
        bands
            of which it is, where not of all.
        """
        return [
            AccumulatedLight(grid.optics, tuple(_rows(group[name], row, row + 1) for group in groups))
            for row, grids in list(enumerate(self.by_band, first))[bands]
            for name, grid in grids.items()
            if GRIDS[name].formed(self.settings, self.physics)
        ]

    def specular_frames(self, labels: Labels) -> ClassFrames | None:
        """Frames of the projector's specular chains by class in ``labels`` (n^2,); None without such light.

        It is a pinhole's light, whatever the projector's lens.
        """
        if not self.physics.mirrors:
            return None
        found = self.bench.specular.frames(labels, self.physics.geometry, self.physics.spectrum)
        if found is None or self.places is None:
            return found
        return replace(found, irradiance=found.irradiance[:, self.places[0]][:, :, self.places[1]])


def _rows(light: sparse.csr_array, first: int, last: int) -> sparse.csr_array:
    """Rows ``first`` .. ``last`` - 1 of ``light``, not copied."""
    start, stop = light.indptr[first], light.indptr[last]
    entries = light.data[start:stop], light.indices[start:stop], light.indptr[first : last + 1] - start
    return sparse.csr_array(entries, shape=(last - first, light.shape[1]), copy=False)


def expected_of(
    parts: Sequence[tuple[Simulation, Sequence[LightEstimate]]],
    rows: Labels,
    lighting: Lighting,
    seed: int,
    leaking: bool = True,
    probed: FloatArray | None = None,
    restated: float = 1.0,
) -> ExpectedFrames:
    """Expected frames of light in several parts.

    Parameters
    ----------
    parts
        simulations of the same devices, each with independent estimates of the light that it accumulated; black pixels
        leak as the first says, specular chains are those of the last.
    rows
        (groups' rows,) class of ``lighting`` that each row of the estimates belongs to.
    lighting
        the shots.
    seed
        of the probes that tell the Monte Carlo error.
    leaking
        whether black pixels leak, so that every shot lights all of them; without, shots of few pixels form faster.
    probed, restated
        what the frames of other shots say of the same classes, and the factor of the Monte Carlo error, as
        :class:`ExpectedFrames` takes them.
    """
    light = emission(parts[0][0].physics, lighting, leaking)
    formed = [simulation.with_optics(groups, len(rows)) for simulation, groups in parts]
    lights, ambient = ([each for part in formed for each in part[kind]] for kind in (0, 1))
    specular = parts[-1][0].specular_frames(lighting.labels)
    return ExpectedFrames(lights, Lighting(rows, light), seed, ambient, specular, probed, restated)


def emission(physics: Physics, lighting: Lighting, leaking: bool = True) -> FloatArray:
    """(shots, classes) light of each class of pixels in each shot, as a part of its full power.

    Parameters
    ----------
    physics
        of the projector.
    lighting, leaking
        as for :func:`expected_of`.
    """
    black = physics.black_level if leaking else 0.0
    return np.asarray(black + (1 - black) * lighting.weights)
