"""A closing frame is compared with the frames before it, in ideal sessions."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.core.runs import Capture, ClosingFrame
from mitsim.reconstruct.reconstruct import Reconstruction, reconstruct
from tests.ideal_sessions import BLACK, DARK, GAIN, Bench, bench, picture, shadow
from tests.unit.reconstruct.test_faults import with_frames


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


def test_a_saturated_closing_frame_decides_nothing() -> None:
    """The result says so. (Planted: saturated readings not asked for.)"""
    shots = bench().run("dots:4", picture(1), 2)
    light = np.asarray(sum(each.frame for each in shots.pattern_measurements()))
    shots.__dict__["closing"] = ClosingFrame("uniform", light, np.zeros_like(light), 7)
    found = reconstruct(shots, bench().calibrated(1))
    assert not found.ok and "decides nothing, because it is saturated" in str(found.status)


def test_what_dots_leave_undecided_is_stated_until_a_closing_frame_decides_it() -> None:
    """In words and numbers, and only of a real camera. (Planted: stated beside a uniform closing frame, too.)"""
    page = np.where(np.random.default_rng(3).random((32, 32)) < 0.35, 0.1, 0.85)
    camera = Bench(shadow(n=32), shadow(n=32))
    shots, factors = camera.run("dots:4", page, 1), camera.calibrated(1)
    found = reconstruct(shots, factors)
    assert found.ok and found.misfit is not None
    (limit,) = found.summary()["misfit"]["limits"]
    assert "--closing-frame uniform" in limit["words"] and limit["words"] in found.limits[0]
    # Two of three pixels are bright: others hardly tell a pixel of such a page, and each frame has 64 of them.
    assert 0.1 < limit["pixel"] < 0.5 and 0.005 < limit["power"] < 0.1
    simulated = shots.manifest.model_copy(update={"plan": {"systematic_error": 0.0}})
    known = reconstruct(Capture(simulated, memory=shots._memory), factors)
    assert known.misfit is not None and not known.misfit.limits
    light = np.asarray(sum(each.frame for each in shots.pattern_measurements()))
    variance = np.maximum(shots.manifest.digital.variance(light), 0.0)
    shots.__dict__["closing"] = ClosingFrame("uniform", light, variance, 0)
    closed = reconstruct(shots, factors)
    assert closed.misfit is not None and not closed.misfit.limits


def test_a_projector_that_leaks_light() -> None:
    """Signed patterns cancel a leak of 5 %, which darkens the image by as much: its size is stated. (Planted: the leak
    of another pattern than the even one; twice the leak.)"""
    shots = bench().run("hadamard:4", picture(1), 1)
    captures, digital = shots.manifest.patterns.captures, shots.manifest.digital
    bright = next(np.asarray(dn, float) for shot, dn in zip(captures, shots.dn, strict=True) if shot.sign == 1)
    even = BLACK + GAIN * DARK
    leaking = with_frames(shots, lambda frames: [dn + 0.05 * ((bright - even) - (dn - even)) for dn in frames])
    assert digital.black_level_dn == BLACK
    misfit = reconstruct(leaking, bench().calibrated(1)).misfit
    assert misfit is not None and misfit.limits[0]["leak"] == pytest.approx(0.05, rel=0.05)
    known = reconstruct(shots, bench().calibrated(1)).misfit
    assert known is not None and not known.limits
