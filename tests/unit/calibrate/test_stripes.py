"""Frames of stripes: mixed from frames of lines, or formed in lots, they are the same; no scene is loaded.

What a calibration session is predicted to take, from sizes: worked out by hand; no scene is loaded.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mitsim.calibrate import board_session as session
from mitsim.core.arrays import FloatArray
from mitsim.devices.patterns import Lighting, hadamard_matrix
from mitsim.devices.session import load_recipe
from mitsim.light import cost_model
from mitsim.light.settings import Settings
from mitsim.optics import frames
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
    bench = SimpleNamespace(n=N, geometry=SimpleNamespace(frame_shape=(ROWS, COLUMNS)))
    own: Any = session.Session(bench, load_recipe()), light  # type: ignore[arg-type]
    numbered = dict(session.LitSession(*own, Frame(np.ones(1), 0.0, 0.0, 0.0), 1.0, 0.0).stripes("horizontal", first))
    assert all(frame.variance == frame.removed == frame.heaviest == 0 for frame in numbered.values())
    return {number: frame.irradiance for number, frame in numbered.items()}


@pytest.fixture
def many_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """More lines than frames of a family would be mixed of, in lots of 5 and parts of 64 pixels."""
    monkeypatch.setattr(session, "mixes", lambda *_: False)
    monkeypatch.setattr(session, "at_once", lambda _: 5)
    monkeypatch.setattr(frames, "_COLUMNS", 64)


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
    formed = found(light)
    assert light.formed > N and len(formed) == N - 1
    for number, sign in list(enumerate(hadamard_matrix(N).T))[1:]:
        assert np.array_equal(formed[number], light._frame(np.repeat((1 + sign) / 2, N).reshape(N, N)).irradiance)


@pytest.mark.parametrize(
    ("lines", "pixels", "held"),
    [(128, 512, True), (896, 512, True), (897, 512, False), (128, 1024, True), (512, 1024, False), (128, 2048, False)],
)
def test_lines_are_held_up_to_so_many_bytes(lines: int, pixels: int, held: bool) -> None:
    """1.75 GiB. (Planted: 1 GiB less, three times as much.)"""
    assert session.lines_held(lines, lines, pixels) == held
    assert not session.lines_held(lines, lines - 1, pixels)


# ---- Cost of sessions ----


CELLS, FORMED_S, LIGHT = 80, 7.0, 1e6
HELD, FORMED = (128, 512), (128, 2048)
"""Lines and pixels a side: frames of the lines are held and mixed; those of patterns are formed."""


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What is asked of the price of forming frames, which says 7 s; light takes a megabyte."""
    calls: list[Any] = []
    fine = SimpleNamespace(bundle=SimpleNamespace(cells=(CELLS - 1, CELLS)))
    monkeypatch.setattr(session, "Simulation", lambda *_: SimpleNamespace(grids={"fine": fine}))
    monkeypatch.setattr(cost_model, "forming_seconds", lambda *arguments: calls.append(arguments) or FORMED_S)
    monkeypatch.setattr(cost_model, "light_bytes", lambda board, rows, settings: LIGHT * (rows == board.n**2))
    return calls


def board(n: int, pixels: int, mask: str = "separable") -> Any:
    geometry, spectrum = (
        SimpleNamespace(
            frame_side=pixels,
            frame_shape=(pixels, pixels),
            mask_terms=1 + (mask == "flatcam"),
            diffracts=True,
            is_drawn=lambda waves: False,
        ),
        SimpleNamespace(weights=(0.5, 0.3, 0.2)),
    )
    return SimpleNamespace(n=n, geometry=geometry, spectrum=spectrum)


@pytest.mark.parametrize(("size", "count", "lit", "frames"), [(HELD, 128, 1, 128), (FORMED, 100, 64, 100)])
def test_stripes_are_formed_for_both_sides(
    asked: list[Any], size: tuple[int, int], count: int, lit: float, frames: int
) -> None:
    """Single lines where they are mixed; else patterns, each of half of the lines. Three lines of light, and two terms
    of each with a mask of two."""
    settings, (n, pixels) = Settings(400.0), size
    found = session.session_seconds(board(*size), count, 1000, settings)
    forming, numbers, formed, _ = asked[0]
    assert formed == frames and forming.lit == lit / CELLS and (forming.pixels, forming.cells) == (pixels, CELLS)
    assert forming.terms == 3 and (forming.shots, forming.classes) == (count, n) and numbers.mixed == 0
    each = n * 1.1e-11 + 8e-9 if size == HELD else 1e-8
    assert found["optics"] == pytest.approx(2 * FORMED_S + 2 * count * pixels**2 * each)
    assert found["sensor"] == pytest.approx(1000 * pixels**2 * 1.1e-8) and found.keys() == {"optics", "sensor"}
    session.session_seconds(board(*size, "flatcam"), count, 1000, settings)
    assert asked[1][0].terms == 6


@pytest.mark.usefixtures("asked")
@pytest.mark.parametrize(("size", "lines", "formed", "exposed"), [(HELD, 128, 32, 16), (FORMED, 0, 4, 4)])
def test_memory_is_that_of_light_frames_and_sums(size: tuple[int, int], lines: int, formed: int, exposed: int) -> None:
    """Lines that are held, three lots that are formed, five frames of the session and five of each response that is
    worked on; and eight numbers for each pattern and row."""
    cost = session.session_cost(board(*size), 128, Settings(400.0), 3.0)
    frames, pixels = lines + 3 * formed + 5 + 5 * exposed, size[1]
    assert cost.seconds == 3.0
    assert cost.memory_bytes == pytest.approx(LIGHT + 8 * (frames * pixels**2 + 8 * 128 * pixels))
