"""A closing frame is compared with the frames before it, in ideal sessions."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.core.runs import ClosingFrame
from mitsim.reconstruct.reconstruct import Reconstruction, reconstruct
from tests.ideal_sessions import bench, picture


def closed(kind: str, patterns: str, power: float, seed: int = 2) -> Reconstruction:
    """Reconstruct a run whose closing frame shows ``power`` times the light of the frames before it."""
    shots = bench().run(patterns, picture(1), seed)
    digital, rng = shots.manifest.digital, np.random.default_rng(seed)
    if kind == "first":
        light = digital.rate(np.asarray(shots.dn[0], dtype=np.float64))
    else:
        light = sum(each.frame for each in shots.pattern_measurements())
    variance = np.maximum(digital.variance(light), 0.0)
    shown = power * light + np.sqrt(variance) * rng.standard_normal(light.shape)
    shots.__dict__["closing"] = ClosingFrame(kind, shown, variance, 0)  # type: ignore[arg-type]
    return reconstruct(shots, bench().calibrated(1))


def test_a_closing_frame_that_decides_nothing() -> None:
    """Random patterns do not add up to even light, which is said. (Planted: nothing said.)"""
    found = closed("uniform", "random:4", 1.0)
    assert not found.ok and "closing frame decides nothing" in str(found.status)


@pytest.mark.parametrize(("kind", "patterns"), [("first", "dots:4"), ("first", "hadamard:4"), ("uniform", "dots:4")])
def test_a_closing_frame_of_another_power(kind: str, patterns: str) -> None:
    """3 % of drift is reported with the power, and none is reported without it. (Planted: a prediction of another
    shot.)"""
    assert closed(kind, patterns, 1.0).ok
    found = closed(kind, patterns, 1.03)
    assert not found.ok and found.misfit is not None
    (fault,) = found.misfit.faults
    assert fault.kind == "closing" and float(fault.words.split("power is ")[1].split()[0]) == pytest.approx(
        1.03, abs=3e-3
    )
