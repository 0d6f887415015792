"""Types of arrays that several rooms exchange, and of the progress report that long work takes."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
"""Real numbers in double precision."""
Labels = npt.NDArray[np.int64]
"""Index of the class or row that each item belongs to."""
Progress = Callable[[str, float], None]
"""Called with a stage's name and its finished part, 0 to 1."""


def silent(stage: str, fraction: float) -> None:
    """Ignore the progress of ``stage``, its finished ``fraction``: the :data:`Progress` of who wants none."""
