"""Shots that are exposed in chunks while files of the chunk before are written, on devices of plain numbers."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.acquire.exposure import Shooting
from mitsim.core.errors import MitsimError
from mitsim.core.job import Job
from mitsim.core.runs import Recorder
from mitsim.devices.patterns import parse_patterns
from mitsim.light import cost_model
from tests.unit.acquire.test_exposer import PIXELS, exposer, frame

FAMILY = parse_patterns("dots:5", 10)
FRAMES = [frame(1e-6 * (2 + index)) for index in range(25)]


def shot(recorder: Recorder) -> Shooting:
    shooting = Shooting(FAMILY, recorder, exposer(), None, np.zeros((PIXELS, PIXELS)))
    shooting.shoot(FRAMES, Job())
    return shooting


@pytest.mark.parametrize("together", [1, 7, 100])
def test_shots_are_the_same_however_many_are_exposed_at_a_time(together: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit by bit, and with them what is told of all. (Planted: noise named by the place in the chunk; the last chunk's
    files not waited for; its sums left out.)"""
    one, other = Recorder(), Recorder()
    first = shot(one)
    monkeypatch.setattr(cost_model, "FRAMES_AT_ONCE", together)
    second = shot(other)
    assert one.files.keys() == other.files.keys() and len(one.files) == 25
    for name, (channels, metadata) in one.files.items():
        assert metadata == other.files[name][1]
        assert all(np.array_equal(values, other.files[name][0][channel]) for channel, values in channels.items())
    for reported in ("sensor_noise", "saturated", "noise_ratio", "dilution", "ambient_part", "noise_to_signal"):
        assert getattr(first, reported) == getattr(second, reported)
    electrons = np.array([channels["electrons"] for channels, _ in one.files.values()], dtype=np.float64)
    assert first.sensor_noise**2 * np.square(electrons).sum() == pytest.approx((electrons + 9).sum(), rel=1e-6)


def test_a_file_that_cannot_be_written_ends_the_shooting(monkeypatch: pytest.MonkeyPatch) -> None:
    """In one line, whichever of the chunks it is in; frames that are not begun are not written either."""
    monkeypatch.setattr(cost_model, "FRAMES_AT_ONCE", 4)
    for bad in ("frame_00000.exr", "frame_00024.exr"):

        class Full(Recorder):
            def write(self, name, channels, metadata, bad=bad) -> None:
                if name == bad:
                    raise MitsimError(f"file {name}: cannot be written (No space left on device)")
                super().write(name, channels, metadata)

        recorder = Full()
        with pytest.raises(MitsimError, match=f"^file {bad}: cannot be written"):
            shot(recorder)
        assert bad not in recorder.files and len(recorder.files) <= (24 if bad.endswith("24.exr") else 8)
