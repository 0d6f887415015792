"""What forming and writing frames takes, before it is begun: from a camera's size and a family to bytes and seconds."""

from __future__ import annotations

from mitsim.capture.bench import Bench
from mitsim.capture.effects import names
from mitsim.capture.evidence import GROUPS, Settings
from mitsim.capture.exposer import FRAMES_AT_ONCE
from mitsim.core.resources import Cost
from mitsim.optics.frames import frames_in_memory
from mitsim.rig.patterns import Lighting

_LANES_BYTES = 380e6
"""Paths in flight, compiled kernels, LLVM; measured about 350e6, once a little above it."""
_ENTRY_BYTES = 36.0
"""An entry of a sparse matrix of light (12), the sum that it is added to, and the mean that frames are formed of."""
_SPLIT = 2
"""Layers, at most, that share the light of one depth."""
_EXPOSING_S, _WRITING_S = 4e-8, 2e-8
"""A pixel; measured on two cores."""
_BYTES_PER_PIXEL = 8
"""Two channels, uncompressed: digital number and expected electrons; truth and its standard error."""
_BYTES_PER_ROW, _HEADER_BYTES = 16, 2000
"""Of an OpenEXR file."""


def frame_seconds(bench: Bench, shots: int) -> dict[str, float]:
    """Seconds of exposing and of writing so many ``shots`` of a ``bench``."""
    pixels = shots * bench.geometry.pixels**2
    return {"sensor": pixels * _EXPOSING_S, "write": pixels * _WRITING_S}


def frames_cost(
    bench: Bench, settings: Settings, lighting: Lighting, seconds: float = 0.0, on_disk: float = 0.0
) -> Cost:
    """Memory, disk and time of a capture.

    Memory is an upper estimate: measured runs take between a third and all of it (tests/hard/test_memory.py).

    Parameters
    ----------
    bench, settings
        what is simulated.
    lighting
        its classes and shots.
    seconds
        that it takes.
    on_disk
        bytes of frames that are there already.
    """
    shots, classes = lighting.weights.shape
    rows = bench.geometry.pixels
    pixels = rows**2
    files = shots * (_BYTES_PER_PIXEL * pixels + _BYTES_PER_ROW * rows + _HEADER_BYTES)
    truth = float(_BYTES_PER_PIXEL * bench.n**2 + _BYTES_PER_ROW * bench.n + _HEADER_BYTES)
    held = frames_in_memory(classes, shots) + 4 * FRAMES_AT_ONCE
    return Cost(
        seconds=seconds,
        memory_bytes=_LANES_BYTES
        + 8.0 * held * pixels
        + GROUPS * _entries(bench.n**2, classes, settings) * _ENTRY_BYTES,
        disk_bytes=max(files + truth - on_disk, 0.0),
    )


def _entries(pixels: int, classes: int, settings: Settings) -> float:
    """Entries of one group's light, at most: a pixel's direct light lies in its own cells, followed light in all."""
    layers = len(settings.depths)
    coarse, coarse_layers = settings.coarse_cells**2, layers if settings.coarse_layers else 1
    several, followed = settings.anchors > 1, settings.followed_anchors > 1
    direct = settings.subdivision**2 * min(layers, _SPLIT) + (
        several * (settings.anchors**2 + 1) * coarse * min(coarse_layers, _SPLIT)
    )
    if not settings.effects & names(lambda effect: effect.followed):
        return float(pixels * direct)
    places = classes * coarse * coarse_layers
    seen = min(settings.indirect_samples * _SPLIT, places)
    at_anchors = followed * (settings.followed_anchors**2 + 1) * min(settings.followed_samples * _SPLIT, places)
    return float(pixels * (direct + seen + at_anchors))
