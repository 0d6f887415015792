"""Plans of one question are made once in a test process: the pilot takes nine tenths of a small capture's time.

Only where the plan is not the point. That a plan made anew is the same is held where programs resume what other
processes began (``system/test_resume.py``), and by ``hard/test_reproducibility.py``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import wraps
from typing import Any

import pytest

USERS = ("mitsim.acquire.spectral", "mitsim.calibrate.board_session", "mitsim.acquire.capture")
"""Modules that plan."""
_kept: dict[str, Any] = {}


def question(bench: Any, lighting: Any, accuracy: float, seed: int, switches: Mapping[str, bool], lines: int) -> str:
    """A digest of all that decides a plan: what is seen, by which devices, in which light, and how well."""
    from mitsim.core.exr import checksum

    files = sorted(checksum(path) for path in bench.loaded.files)
    light = lighting.labels.tobytes(), lighting.weights.tobytes(), lighting.weights.shape
    seen = str(bench.loaded.scene), files, bench.variant, repr(bench.devices)
    return hashlib.sha256(repr((seen, light, accuracy, seed, sorted(switches.items()), lines)).encode()).hexdigest()


def keeping(make_plan: Callable[..., Any]) -> Callable[..., Any]:
    """``make_plan`` that answers the same question from memory."""

    @wraps(make_plan)
    def kept(
        bench: Any,
        lighting: Any,
        accuracy: float,
        seed: int,
        switches: Mapping[str, bool] | None = None,
        lines: int = 1,
    ) -> Any:
        asked = question(bench, lighting, accuracy, seed, switches or {}, lines)
        if asked not in _kept:
            _kept[asked] = make_plan(bench, lighting, accuracy, seed, switches, lines)
        return _kept[asked]

    return kept


@contextmanager
def plans_kept() -> Iterator[None]:
    """Within, captures, calibrations and renders take plans that are there already."""
    from mitsim.planner.planner import make_plan

    kept = keeping(make_plan)
    with pytest.MonkeyPatch.context() as patch:
        for module in USERS:
            patch.setattr(f"{module}.make_plan", kept)
        yield
