"""Shared by the hard tests: a bound on memory, good folders to be damaged, and a white sheet."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.hard.hostile.folders import make

ROOM = 3 << 30
"""Bytes of address space beyond what the process has when a case starts; the frames here need 1 kB."""


@pytest.fixture
def bounded() -> Iterator[None]:
    """Address space that ends ``ROOM`` above what is in use: a claim that is believed fails as MemoryError."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, hard))
    yield
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    return make(tmp_path)


@pytest.fixture(scope="module")
def white(shared_scene: Callable[..., Path], variant: str) -> Any:
    from mitsim.api.bench import open_bench  # here: most hard tests do without the renderer

    return open_bench(shared_scene("white_hard"), variant)
