"""Pairs of an ideal camera in memory, by the interface of a store: no part of what makes stores is in them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from tests.ideal_sessions import Bench, bench, picture


class FakeStore:
    """``count`` pairs of pictures under ``patterns``."""

    def __init__(
        self, count: int = 24, patterns: str = "uniform", camera: Bench | None = None, photographs: int | None = None
    ) -> None:
        self.photographs = np.arange(count) % (photographs or count)
        runs = [(camera or bench()).run(patterns, picture(seed), seed) for seed in range(100, 100 + count)]
        self.folder, self.patterns = Path("pairs"), runs[0].patterns
        measured = [list(run.pattern_measurements()) for run in runs]
        self.indices = np.array([(each.row, each.column) for each in measured[0]])
        self._frames = [np.stack([each.frame for each in frames]).astype(np.float32) for frames in measured]
        self._truths = [np.asarray(run.truth, np.float32) for run in runs]
        about = {"count": count, "idealised": True}
        self.manifest: Any = SimpleNamespace(
            m=self._frames[0].shape[1:],
            frames=len(self.indices),
            patterns=patterns,
            exposure_s=runs[0].exposure_s,
            model_dump=lambda **_: about,
        )

    def __len__(self) -> int:
        return len(self._frames)

    def frames(self, index: int) -> np.ndarray:
        return self._frames[index]

    def truth(self, index: int) -> np.ndarray:
        return self._truths[index]
