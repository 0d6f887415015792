"""A short look at a scene before the real work: the error that each discretisation would leave, and the pace.

Numbers in, numbers out: the effect plan (:mod:`mitsim.scene.plan`) reads them and decides. All errors are relative,
``||a - b|| / ||b||``.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from mitsim.core.errors import MitsimError
from mitsim.core.seeds import integer
from mitsim.optics.camera import CameraGeometry
from mitsim.optics.frames import ExpectedFrames, FrameOptics, relative_error
from mitsim.optics.shadow import Directions
from mitsim.transport.cells import CellGrid, aligned_grid
from mitsim.transport.factored import LightSample, Projector, Tracer

FloatArray = npt.NDArray[np.float64]
ANCHOR_CHOICES = (1, 2, 3)
CELL_CHOICES = (1, 2, 4)
_JUDGE_ANCHORS = 5
_COARSE = 4
_PILOT_CAPTURES = 4


@dataclass(frozen=True)
class Evidence:
    """What the pilot measured.

    Attributes
    ----------
    anchor_error
        by anchors a side: error of interpolating the light between them, against 5 a side.
    cell_error
        by cells a side of a projector pixel: error of frames whose light is spread evenly over each cell.
    depth, depth_spread_error
        depth of the light, 1 / mean(1/z) [mm], and the error of putting all of it at that depth.
    sampling_error
        by cells a side of a projector pixel: Monte Carlo error of the frames at one path a cell.
    seconds_per_batch, seconds_per_path
        pace of the tracer once compiled: a batch takes the first, and the second for each path.
    seconds
        time that this pilot took.
    """

    anchor_error: dict[int, float]
    cell_error: dict[int, float]
    depth: float
    depth_spread_error: float
    sampling_error: dict[int, float]
    seconds_per_batch: float
    seconds_per_path: float
    seconds: float


@dataclass(frozen=True)
class View:
    """What the pilot looks at: scene, camera, projector, and the row and column tan-angles of its window."""

    scene: Any
    camera: Any
    projector: Projector
    windows: tuple[tuple[float, float], tuple[float, float]]

    @property
    def geometry(self) -> CameraGeometry:
        """The camera's geometry."""
        geometry: CameraGeometry = self.camera.geometry
        return geometry

    def grid(self, pixels: int, subdivision: int = 1, multiple: int = 1) -> CellGrid:
        """Cells for a window of ``pixels`` a side."""
        return aligned_grid(*self.windows, pixels, subdivision, self.geometry.tan_half_fov, multiple)

    def coarse_grid(self) -> CellGrid:
        """Cells of several projector pixels each."""
        return self.grid(max(self.projector.n // _COARSE, 1))

    def tracer(self, grid: CellGrid, anchors: int = 1, depth: float | None = None, common: bool = False) -> Tracer:
        """A tracer of this scene."""
        return Tracer(self.scene, self.camera, self.projector, grid, anchors, depth, common)


def measure(view: View, labels: npt.NDArray[np.int64], weights: FloatArray, seed: int) -> Evidence:
    """Trace a few small batches and compare discretisations on a handful of the family's captures.

    ``labels`` and ``weights`` describe the family as in :class:`mitsim.optics.frames.ExpectedFrames`.

    Raises
    ------
    MitsimError
        when no light of the projector reaches the camera.
    """
    started = time.perf_counter()
    chosen = np.unique(np.linspace(0, len(weights) - 1, min(len(weights), _PILOT_CAPTURES)).astype(int))
    weights = weights[chosen]
    depth = _depth(view, seed)
    anchor_error = _anchor_errors(view, depth, labels, weights, seed)
    finest = CELL_CHOICES[-1]
    grid = view.grid(view.projector.n, finest, multiple=finest)
    tracer = view.tracer(grid, depth=depth)
    samples = [tracer.batch(integer(seed, "pilot", "cells", 0))]
    warm = time.perf_counter()
    samples.append(tracer.batch(integer(seed, "pilot", "cells", 1)))
    fine = time.perf_counter() - warm
    per_batch = _overhead(view, seed)
    cell_error, sampling_error = _cell_errors(view.geometry, grid, depth, samples, labels, weights, seed)
    spread = float(np.mean([sample.depth_spread for sample in samples]))
    return Evidence(
        anchor_error=anchor_error,
        cell_error=cell_error,
        depth=depth,
        depth_spread_error=_depth_error(view.geometry, grid, depth, spread),
        sampling_error=sampling_error,
        seconds_per_batch=per_batch,
        seconds_per_path=max(fine - per_batch, 0.0) / tracer.lanes,
        seconds=time.perf_counter() - started,
    )


def _depth(view: View, seed: int) -> float:
    """Depth of the light, 1 / mean(1/z) [mm], from one path through each projector pixel."""
    found = view.tracer(view.grid(view.projector.n)).batch(integer(seed, "pilot", "depth"))
    if not found.light.nnz:
        raise MitsimError(
            "no light of the projector reaches the camera; check the scene, the window and the field stop"
        )
    return 1 / found.depth_mean


def _overhead(view: View, seed: int) -> float:
    """Seconds of a batch with hardly any paths, the better of two."""
    tracer = view.tracer(view.coarse_grid())

    def once(index: int) -> float:
        started = time.perf_counter()
        tracer.batch(integer(seed, "pilot", "overhead", index))
        return time.perf_counter() - started

    return min(once(0), once(1))


def _anchor_errors(
    view: View, depth: float, labels: npt.NDArray[np.int64], weights: FloatArray, seed: int
) -> dict[int, float]:
    """Error of the frames with fewer anchors, on coarse cells, with the same random paths from every anchor.

    Frames, not radiance: the falloff's error is odd in the scene's coordinates and mostly cancels in a frame.
    """
    grid = view.coarse_grid()

    def frames(anchors: int) -> FloatArray:
        tracer = view.tracer(grid, anchors, depth, common=True)
        light = tracer.batch(integer(seed, "pilot", "anchors")).light
        optics = FrameOptics(view.geometry, grid.rows.edges, grid.columns.edges, depth, anchors)
        return np.stack([frame.irradiance for frame in ExpectedFrames(optics, [light], labels, weights, seed)])

    judge = frames(_JUDGE_ANCHORS)
    scale = float(np.linalg.norm(judge))
    return {
        anchors: float(np.linalg.norm(frames(anchors) - judge)) / scale if scale else 0.0 for anchors in ANCHOR_CHOICES
    }


def _cell_errors(
    geometry: CameraGeometry,
    grid: CellGrid,
    depth: float,
    samples: list[LightSample],
    labels: npt.NDArray[np.int64],
    weights: FloatArray,
    seed: int,
) -> tuple[dict[int, float], dict[int, float]]:
    """Error of the frames when fine cells are merged, and of their sampling; the finest cells are judged by
    extrapolation, the error falls with the square of a cell's size."""
    finest = CELL_CHOICES[-1]
    frames, sampling = {}, {}
    for choice in CELL_CHOICES:
        merge = finest // choice
        edges = grid.rows.edges[::merge], grid.columns.edges[::merge]
        groups = [_merge(sample.light, grid.shape, merge) for sample in samples]
        expected = ExpectedFrames(FrameOptics(geometry, *edges, depth, 1), groups, labels, weights, seed)
        found = list(expected)
        frames[choice] = np.stack([frame.irradiance for frame in found])
        # Two samples of the pilot: their mean has merge^2 * 2 paths in each merged cell.
        sampling[choice] = relative_error(found) * merge * 2**0.5
    judge = frames[finest]
    scale = float(np.linalg.norm(judge))
    errors = {choice: float(np.linalg.norm(frames[choice] - judge)) / scale for choice in CELL_CHOICES[:-1]}
    errors[finest] = errors[CELL_CHOICES[-2]] / 3
    return {choice: errors[choice] * (1 if choice == finest else 4 / 3) for choice in CELL_CHOICES}, sampling


def _merge(light: sparse.csr_array, shape: tuple[int, int], merge: int) -> sparse.csr_array:
    """The light on cells ``merge`` times as large."""
    coo = light.tocoo()
    row, column = np.divmod(coo.col, shape[1])
    width = shape[1] // merge
    flat = (row // merge) * width + column // merge
    size = (shape[0] // merge) * width
    return sparse.coo_array((coo.data, (coo.row, flat)), shape=(light.shape[0], size)).tocsr()


def _depth_error(geometry: CameraGeometry, grid: CellGrid, depth: float, spread: float) -> float:
    """Change of the mask's shadow between the mean depth and one standard deviation of 1/z from it, both axes."""
    if spread * depth < 1e-6:
        return 0.0
    nearer = 1 / (1 / depth + spread)
    rows, columns = Directions.cells(grid.rows.edges), Directions.cells(grid.columns.edges)
    middle = geometry.shadow_terms(rows, columns, depth)
    moved = geometry.shadow_terms(rows, columns, nearer)
    change = sum(float(np.square(a[0] - b[0]).sum()) for a, b in zip(middle, moved, strict=True))
    return float((2 * change / sum(float(np.square(a[0]).sum()) for a in middle)) ** 0.5)
