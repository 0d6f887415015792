"""Versions of what computes: nothing in, names and versions of mitsim, Python and the packages that decide out."""

from __future__ import annotations

import importlib.metadata
import platform
from functools import cache

import mitsim

DECIDING = ("mitsim", "mitsuba", "drjit", "numpy", "scipy")
"""Packages of which another version may give other frames from the same seed."""
_PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "scikit-image", "OpenEXR")


def versions() -> dict[str, str]:
    """Versions of mitsim, Python and the packages that decide the numbers, by name; imports none of them."""
    return dict(_installed())


def deciding_versions() -> dict[str, str]:
    """Of :func:`versions` those of the packages that decide frames: a manifest's configuration holds them."""
    return {name: version for name, version in versions().items() if name in DECIDING}


@cache
def _installed() -> tuple[tuple[str, str], ...]:
    """Read once: it takes 8 ms, and a coloured run states them nine times."""
    by_name = {"mitsim": mitsim.__version__, "python": platform.python_version()}
    for name in _PACKAGES:
        try:
            by_name[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            by_name[name] = "not installed"
    return tuple(by_name.items())
