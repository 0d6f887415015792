"""What a calibration session is predicted to take, from sizes: worked out by hand; no scene is loaded."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from mitsim.calibrate import board_session as session
from mitsim.light.settings import Settings

CELLS, FORMED_S, LIGHT = 80, 7.0, 1e6
HELD, FORMED = (128, 512), (128, 2048)
"""Lines and pixels a side: frames of the lines are held and mixed; those of patterns are formed."""


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What is asked of the price of forming frames, which says 7 s; light takes a megabyte."""
    calls: list[Any] = []
    fine = SimpleNamespace(bundle=SimpleNamespace(cells=(CELLS - 1, CELLS)))
    monkeypatch.setattr(session, "Simulation", lambda *_: SimpleNamespace(grids={"fine": fine}))
    monkeypatch.setattr(session, "forming_seconds", lambda *arguments: calls.append(arguments) or FORMED_S)
    monkeypatch.setattr(session, "light_bytes", lambda board, rows, settings: LIGHT * (rows == board.n**2))
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


@pytest.mark.usefixtures("asked")
def test_each_exposure_takes_memory() -> None:
    """Weights of three, and two more frames of both others for each response that is worked on."""
    one, three = (session.session_cost(board(*HELD), 128, Settings(400.0), 3.0, count) for count in (1, 3))
    assert three.memory_bytes - one.memory_bytes == pytest.approx(8 * (3 + 2 * 2 * 16) * 512**2)
