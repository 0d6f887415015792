"""What a calibration session takes: its bench, shots and settings in, seconds by stage and bytes out, before it begins.

The reason of each figure is how :class:`mitsim.capture.responses.LitSession` works.
"""

from __future__ import annotations

from dataclasses import replace

from mitsim.capture.bench import Bench
from mitsim.capture.cost import frame_seconds, light_bytes
from mitsim.capture.evidence import Forming, Settings
from mitsim.capture.exposer import frames_at_once
from mitsim.capture.prices import FIXED, Numbers, forming_seconds
from mitsim.capture.simulation import Simulation
from mitsim.capture.stripes import lines_held
from mitsim.core.resources import Cost
from mitsim.optics.frames import at_once

_PACES = replace(FIXED, product=1.1e-11)
"""A multiplication of products as large as those of stripes: half of what it takes in small ones (2048 pixels a side,
two processors)."""
_MIXED_S, _FORMED_S = 3e-8, 1e-8
"""A pixel of a frame that is mixed or formed beside its multiplications: memory that is read and taken anew (sensors of
512 and 1024 pixels mixed, of 2048 formed; processor seconds, halved for two processors)."""
_HELD, _AT_WORK = 5.0, 5.0
"""Frames in double precision: those that a session holds (the uniform one, its rate, a pair's both shots together, two
noisy uniform ones), and what each response takes that is worked on (light of two shots, their numbers, rates)."""
_OF_AN_EXPOSURE = 2.0
"""Frames more of a response for each exposure beyond the first: numbers of two shots, and one shot's electrons."""
_SUMS = 8.0
"""Numbers of a side's sums for each pattern and pixel of a side of the sensor: of two sides and two kinds of responses,
and once more while they are saved."""


def session_seconds(board: Bench, count: int, shots: int, settings: Settings) -> dict[str, float]:
    """Seconds of forming the stripes of a session, and of exposing its shots and adding up responses.

    Parameters
    ----------
    board
        the bench with the board.
    count, shots
        +-1 patterns of a side, and frames of the whole session.
    settings
        what is simulated.
    """
    n, pixels = board.n, board.geometry.frame_side
    cells = max(Simulation(board, settings).fine.bundle.cells)
    mixed = lines_held(n, count, pixels)
    forming = Forming(
        pixels=pixels,
        cells=cells,
        # Single lines that are mixed, or the half of all that is +1.
        lit=(1 if mixed else n / 2) / cells,
        terms=float(len(board.spectrum.weights) * board.geometry.mask_terms),
        shots=count,
        classes=n,
        geometric_terms=float(board.geometry.mask_terms),
        correlated=(board.geometry.drawn(waves=False), board.geometry.drawn(board.geometry.diffracts)),
    )
    numbers = replace(Numbers.of(settings), mixed=0.0)  # what black pixels leak is added to frames
    seconds = 2 * float(forming_seconds(forming, numbers, n if mixed else count, _PACES))
    each = n * _PACES.product + _MIXED_S if mixed else _FORMED_S
    return {"optics": seconds + 2 * count * pixels**2 * each, "sensor": frame_seconds(board, shots)["sensor"]}


def session_cost(board: Bench, count: int, settings: Settings, seconds: float, exposures: int = 1) -> Cost:
    """Memory, an upper estimate, and time of a session.

    Parameters
    ----------
    board, count, settings
        as for :func:`session_seconds`.
    seconds
        that it takes.
    exposures
        of every frame.
    """
    n, pixels = board.n, board.geometry.frame_side
    lines = n if lines_held(n, count, pixels) else 0
    at_work = _AT_WORK + _OF_AN_EXPOSURE * (exposures - 1)
    held = _HELD + (exposures if exposures > 1 else 0)  # and a pixel's weights
    frames = lines + 3 * at_once(pixels) + held + at_work * frames_at_once(round(pixels**2))
    memory_bytes = 8.0 * (frames * pixels**2 + _SUMS * count * pixels)
    return Cost(seconds=seconds, memory_bytes=light_bytes(board, n * n, settings) + memory_bytes)
