"""Frames of stripes: mixed from frames of lines, or formed in lots, they are the same; no scene is loaded."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.calibrate import board_session as session
from mitsim.core.arrays import FloatArray
from mitsim.devices.patterns import Lighting, hadamard_matrix
from mitsim.optics.frames import Frame

N, ROWS, COLUMNS = 12, 20, 23


class ToyLight:
    """Frames L X R^T; ``removed`` is what the frame of line 3 lost below zero."""

    def __init__(self, removed: float = 0.0) -> None:
        rng = np.random.default_rng(1)
        self.left, self.right, self.removed = rng.random((ROWS, N)), rng.random((COLUMNS, N)), removed
        self.formed = 0

    def frames(self, lighting: Lighting, _: int, leaking: bool = True) -> list[Frame]:
        assert not leaking, "it is added later"
        self.formed += len(lighting.weights)
        return [self._frame(weights[lighting.labels].reshape(N, N)) for weights in lighting.weights]

    def _frame(self, picture: FloatArray) -> Frame:
        alone = picture.sum() == N and picture[3].all()
        return Frame(self.left @ picture @ self.right.T, 0.0, self.removed if alone else 0.0, 0.0)


def found(light: ToyLight, first: int = 1) -> dict[int, FloatArray]:
    lighting = Lighting(np.repeat(np.arange(N), N), (1.0 + hadamard_matrix(N).T) / 2)
    numbered = dict(session.stripe_frames(light, lighting, 0, (ROWS, COLUMNS), first))  # type: ignore[arg-type]
    assert all(frame.variance == frame.removed == frame.heaviest == 0 for frame in numbered.values())
    return {number: frame.irradiance for number, frame in numbered.items()}


@pytest.fixture
def many_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """More lines than frames of a family would be mixed of, in lots of 5 and parts of 64 pixels."""
    monkeypatch.setattr(session, "mixes", lambda *_: False)
    monkeypatch.setattr(session, "at_once", lambda _: 5)
    monkeypatch.setattr(session, "_COLUMNS", 64)


@pytest.mark.usefixtures("many_lines")
@pytest.mark.parametrize("first", [1, 6, 11])
def test_lines_are_mixed_into_the_frames_of_patterns(first: int) -> None:
    """Each line is formed once, and what is mixed has the same bits wherever one goes on. (Planted: the last part of
    pixels left as it was, the weights of the first lot for all, rows for columns.)"""
    light = ToyLight()
    mixed = found(light, first)
    assert light.formed == N and list(mixed) == list(range(first, N))
    whole = found(light)
    for number, sign in enumerate(hadamard_matrix(N).T):
        expected = np.outer(light.left @ ((1 + sign) / 2), light.right.sum(axis=1))
        if number >= first:
            np.testing.assert_allclose(mixed[number], expected, rtol=1e-12)
            assert np.array_equal(mixed[number], whole[number])


@pytest.mark.usefixtures("many_lines")
def test_lines_that_lost_light_are_not_mixed() -> None:
    """Set to zero in a line, it would be missing in every pattern. (Planted: mixed all the same.)"""
    light = ToyLight(removed=1e-9)
    frames = found(light)
    assert light.formed > N and len(frames) == N - 1
    for number, sign in list(enumerate(hadamard_matrix(N).T))[1:]:
        assert np.array_equal(frames[number], light._frame(np.repeat((1 + sign) / 2, N).reshape(N, N)).irradiance)


@pytest.mark.parametrize(
    ("lines", "pixels", "held"),
    [(128, 512, True), (896, 512, True), (897, 512, False), (128, 1024, True), (512, 1024, False), (128, 2048, False)],
)
def test_lines_are_held_up_to_so_many_bytes(lines: int, pixels: int, held: bool) -> None:
    """1.75 GiB. (Planted: 1 GiB less, three times as much.)"""
    assert session.lines_held(lines, lines, pixels) == held
    assert not session.lines_held(lines, lines - 1, pixels)
