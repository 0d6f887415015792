"""Light for a family of patterns: from a bench and an accuracy to sampled light, its frames and their error."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import sparse

from mitsim.capture.bench import Bench
from mitsim.core.seeds import integer
from mitsim.optics.frames import ExpectedFrames, FrameOptics, relative_error
from mitsim.scene.plan import Plan, SceneFacts, check_accuracy, decide
from mitsim.transport import pilot
from mitsim.transport.cells import CellGrid, aligned_grid
from mitsim.transport.factored import LightSample, Tracer

__all__ = [
    "Light",
    "Plan",
    "Progress",
    "check_accuracy",
    "collect",
    "grid_for",
    "make_plan",
    "pinhole_view",
    "silent",
    "uniform_light",
]

FloatArray = npt.NDArray[np.float64]
Labels = npt.NDArray[np.int64]
Progress = Callable[[str, float], None]
GROUPS = 8
_CHECKED_CAPTURES = 8
_MOST_PATHS = 2**32
_LARGEST_GROWTH = 8.0


def silent(stage: str, fraction: float) -> None:
    """A progress report that goes nowhere: stage name, and its finished part 0..1."""


@dataclass(frozen=True, eq=False)
class Light:
    """Sampled light of one scene: any pattern family on the same projector can be formed from it.

    Attributes
    ----------
    groups
        independent estimates, (projector pixels, anchors x cells) each [W m^-2].
    optics
        the closed-form part that turns light into frames.
    paths
        rays traced for them.
    sampling_error
        relative Monte Carlo error of the frames that were checked; ``reached`` tells whether it met the plan's target.
    """

    groups: tuple[sparse.csr_array, ...]
    optics: FrameOptics
    paths: int
    sampling_error: float
    reached: bool

    def frames(self, labels: Labels, weights: FloatArray, seed: int) -> ExpectedFrames:
        """Expected frames of the captures that ``labels`` (n^2,) and ``weights`` (captures, classes) describe."""
        return ExpectedFrames(self.optics, self.groups, labels, weights, seed)

    def merged(self) -> Light:
        """The same light as one group: frames come without a variance, and faster."""
        return replace(self, groups=(sum(self.groups[1:], self.groups[0]) / len(self.groups),))

    def flux(self) -> FloatArray:
        """(projector pixels,) irradiance that each pixel's light casts toward the camera, without the mask."""
        return np.asarray(sum(self.optics.total(group) for group in self.groups) / len(self.groups))


def make_plan(bench: Bench, labels: Labels, weights: FloatArray, accuracy: float, seed: int) -> Plan:
    """Look at the scene for a moment and decide what to simulate."""
    view = pilot.View(bench.loaded.scene, bench.loaded.camera, bench.source, bench.windows)
    evidence = pilot.measure(view, labels, weights, seed)
    wavelength = bench.projector.effective_wavelength_nm
    facts = SceneFacts(
        other_emitters=bench.loaded.other_emitters,
        fresnel_number=bench.geometry.fresnel_number(wavelength),
        wavelength_nm=wavelength,
        keystone=bench.loaded.pixels.keystone,
        field_stop_cuts=bench.field_stop_cuts,
    )
    cells = {choice: math.prod(grid_for(bench, choice).shape) for choice in evidence.cell_error}
    return decide(
        accuracy,
        evidence.anchor_error,
        evidence.cell_error,
        evidence.sampling_error,
        cells,
        evidence.seconds_per_batch,
        evidence.seconds_per_path,
        evidence.depth,
        evidence.depth_spread_error,
        len(weights),
        facts,
    )


def grid_for(bench: Bench, subdivision: int) -> CellGrid:
    """Cells aligned with the projector's pixels on the rig's plane, covering the field stop."""
    return aligned_grid(*bench.windows, bench.n, subdivision, bench.geometry.tan_half_fov)


def collect(
    bench: Bench,
    plan: Plan,
    labels: Labels,
    weights: FloatArray,
    seed: int,
    progress: Progress = silent,
    purpose: str = "scene",
) -> Light:
    """Trace until the Monte Carlo error of the frames meets the plan's target, or the limit of 2^32 paths.

    Each group gets the same number of batches; a few captures, evenly spread, are formed to see the error. ``purpose``
    names the random streams: light for two purposes shares none.
    """
    grid = grid_for(bench, plan.subdivision)
    tracer = Tracer(bench.loaded.scene, bench.loaded.camera, bench.source, grid, plan.anchors, plan.depth)
    optics = FrameOptics(bench.geometry, grid.rows.edges, grid.columns.edges, plan.depth, plan.anchors)
    chosen = np.unique(np.linspace(0, len(weights) - 1, min(len(weights), _CHECKED_CAPTURES)).astype(int))
    sums: list[sparse.csr_array | None] = [None] * GROUPS
    done, wanted, error = 0, 1, math.inf
    while True:
        for index in range(done, wanted):
            for group in range(GROUPS):
                sample = tracer.batch(integer(seed, "transport", purpose, group, index))
                sums[group] = _add(sums[group], sample)
        done = wanted
        groups = tuple(total / done for total in sums if total is not None)
        error = relative_error(ExpectedFrames(optics, groups, labels, weights[chosen], seed))
        progress("transport", min(1.0, (plan.sampling_target / error) ** 2) if error > 0 else 1.0)
        paths = done * GROUPS * tracer.lanes
        if error <= plan.sampling_target or paths >= _MOST_PATHS:
            return Light(groups, optics, paths, error, error <= plan.sampling_target)
        growth = min(1.1 * (error / plan.sampling_target) ** 2, _LARGEST_GROWTH)
        most = max(done + 1, _MOST_PATHS // (GROUPS * tracer.lanes))
        wanted = min(max(done + 1, math.ceil(done * growth)), most)


def uniform_light(n: int) -> tuple[Labels, FloatArray]:
    """Labels and weights of one capture with every projector pixel fully lit."""
    return np.zeros(n * n, dtype=np.int64), np.ones((1, 1))


def pinhole_view(bench: Bench, board_reflectance: float, seed: int) -> FloatArray:
    """(rows, columns) apparent reflectance seen from the sensor's centre under uniform light, for people to look at.

    One path a cell, four cells a side of a projector pixel; 0 where the projector does not light the board.
    """
    grid = grid_for(bench, 4)
    one = [
        np.asarray(
            Tracer(b.loaded.scene, b.loaded.camera, b.source, grid, anchors=1)
            .batch(integer(seed, "view"))
            .light.sum(axis=0)
        ).reshape(grid.shape)
        for b in (bench, bench.with_board(board_reflectance))
    ]
    return np.asarray(np.divide(one[0], one[1], out=np.zeros(grid.shape), where=one[1] > 0))


def _add(total: sparse.csr_array | None, sample: LightSample) -> sparse.csr_array:
    return sample.light if total is None else total + sample.light
