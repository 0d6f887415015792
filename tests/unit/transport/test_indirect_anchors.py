"""Indirect light that is followed once for several anchors, against the same paths to each of them alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from mitsim.api.bench import Bench, open_bench
from mitsim.transport.connect import SensorPoints
from mitsim.transport.indirect import IndirectTracer
from mitsim.transport.integrator import Paths
from mitsim.transport.records import DIRECT, INDIRECT, Bundle, DeviceAccumulator, PathSamples, aligned_grid
from tests.unit.transport.test_indirect import CORNER, MIRROR, N

if TYPE_CHECKING:
    import mitsuba as mi

BEFORE = MIRROR.replace('x="-40"', 'x="-29" y="40"')
pytestmark = pytest.mark.usefixtures("variant")


@dataclass(frozen=True)
class Alone(SensorPoints):
    """One anchor of several."""

    of_several: SensorPoints | None = None
    index: int = 0

    def at(self, row: mi.UInt32, column: mi.UInt32, rng: mi.PCG32) -> mi.Point3f:
        import drjit as dr

        assert self.of_several is not None
        # Opaque numbers, so that all anchors share one compiled kernel.
        down, right = (dr.opaque(type(row), place) for place in divmod(self.index, self.of_several.anchors))
        return self.of_several.at(row + down, column + right, rng)


@pytest.fixture(scope="module")
def beside(shared_scene: Callable[..., Path], variant: str) -> Bench:
    """A mirror before the upper half of a shiny wall, and a large sensor."""
    return open_bench(
        shared_scene("beside", extra=CORNER + BEFORE, pitch=0.375, mask_feature=0.3), variant, for_render=True
    )


def anchored(bench: Bench, points: SensorPoints) -> IndirectTracer:
    return IndirectTracer(bench.setup, Paths(True, True), points=points)


def compared(bench: Bench) -> tuple[int, list[str]]:
    """Fewest entries of a kind at an anchor, and what differs between paths to all anchors and to each alone."""
    points = SensorPoints(bench.geometry.half_width, 3)
    together, fewest, different = anchored(bench, points).trace(4, 0, 32), 2**30, []
    for index in range(points.count):
        alone = anchored(bench, Alone(points.half_width, of_several=points, index=index)).trace(4, 0, 32)
        at = together.where((together.anchor_row == index // 3) & (together.anchor_column == index % 3))
        for kind in (DIRECT, INDIRECT):
            mine, own = at.where(at.kind == kind), alone.where(alone.kind == kind)
            fewest = min(fewest, mine.value.size)
            names = ("pixel", "value", "row", "column", "inverse_depth", "lines")
            different += [name for name in names if not np.array_equal(getattr(mine, name), getattr(own, name))]
    return fewest, different


def test_a_path_is_the_same_at_every_anchor(beside: Bench) -> None:
    """Followed once for all anchors, it brings each what it would bring it alone, bit for bit. (Planted: the number
    that draws of caustics for that of indirect light; what the first anchor keeps joined to the light of all; the last
    anchor left out.)"""
    fewest, different = compared(beside)
    assert fewest > 100 and not different


@pytest.mark.parametrize("launch", [2**22, 9 * 512 + 5])
def test_accumulators_hold_what_anchors_are_brought(
    beside: Bench, launch: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The light that is handed out, by anchor and class of pixels; the same units however paths are launched. (Planted:
    rows for columns of anchors; launches that begin with the first path again.)"""
    points = SensorPoints(beside.geometry.half_width, 3)
    tracer, labels = anchored(beside, points), np.arange(N**2) % 5
    reach = beside.geometry.reach(beside.geometry.scene_distance)
    bundle = Bundle(aligned_grid(*beside.windows, 2 * N, 1, reach), 3, (400.0, 300.0))
    whole, parts = (DeviceAccumulator(bundle, labels, tracer.board) for _ in range(2))
    caustics, host = tracer.trace(4, 0, 8, whole), tracer.trace(4, 0, 8)
    units = np.array(whole.sums)
    monkeypatch.setattr(IndirectTracer, "paths_per_launch", launch)
    again = PathSamples.join([tracer.trace(4, first, 4, parts) for first in (0, 4)])
    assert units.any() and np.array_equal(np.array(parts.sums), units)
    for name in ("kind", "pixel", "anchor_row", "anchor_column", "value"):
        assert np.array_equal(getattr(again, name), getattr(caustics, name)), name
    assert np.array_equal(caustics.value, host.value[host.kind == DIRECT]) and caustics.value.size
    expected = bundle.accumulate(host.where(host.kind == INDIRECT), labels)
    found = whole.fetch()[0].light()[0]
    # Which layer light is accumulated in is drawn: all layers together are the same.
    by_place = [np.asarray(light.toarray()).reshape(light.shape[0], 2, -1).sum(axis=1) for light in (expected, found)]
    near = np.isclose(*by_place, rtol=1e-5, atol=1e-7 * by_place[0].max())
    # Rounding moves what lies on the edge of a cell.
    assert (by_place[0] > 0).sum() > 500 and near.mean() > 0.999
    assert by_place[1].sum() == pytest.approx(by_place[0].sum(), rel=1e-5)
