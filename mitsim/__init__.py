"""mitsim simulates a lensless camera under coded light, and reconstructs images from its frames.

>>> import mitsim as ms
>>> bench = ms.open_bench("photograph")
>>> shots = bench.capture("dots:7", accuracy=1e-3)
>>> image = ms.reconstruct(shots, bench.calibrate())
>>> ms.psnr(image.image, shots.truth)

Importing this package imports nothing, selects no Mitsuba variant and touches no global state: names are fetched when
they are first used.
"""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path
from types import ModuleType

from mitsim.version import __version__ as __version__

_HOMES = {
    name: home
    for home, name in re.findall(r"from (\S+) import (\w+) as", Path(__file__).with_suffix(".pyi").read_text("utf-8"))
    if not name.startswith("_")
}
"""Module of each name of the face, as the stub beside this file declares them (Scientific Python's SPEC 1)."""
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'mitsim' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


class _Face(ModuleType):
    """Module type whose ``mitsim.reconstruct`` stays the function when Python imports the room of that name."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _HOMES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Face
