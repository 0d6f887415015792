"""Planes of a colour sensor's frames, as FlatCam names them."""

from __future__ import annotations

from mitsim.core.errors import ArgumentError

PLANES = {"r": (1, 1), "gb": (0, 1), "gr": (1, 0), "b": (0, 0)}
"""First row and first column of each plane of a frame."""


def check_channel(name: str) -> str:
    """The ``name``, where a plane is called so; MitsimError otherwise."""
    if name not in PLANES:
        raise ArgumentError("channel", f"{name!r}: use {', '.join(PLANES)}")
    return name
