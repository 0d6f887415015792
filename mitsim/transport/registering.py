"""Plugins of our own and Mitsuba's variants: registration once for each."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi

from mitsim.core.errors import MitsimError

_REGISTERED: set[tuple[str, str]] = set()


def register_once(kind: str, plugin: str, build: Callable[[], type]) -> None:
    """Make a plugin known to the current variant, unless it is.

    Parameters
    ----------
    kind
        "sensor", "emitter" or "bsdf".
    plugin
        name in scene files.
    build
        makes the class: Mitsuba's base classes exist per variant.

    Raises
    ------
    MitsimError
        when no variant is selected.
    """
    variant = mi.variant()
    if variant is None:
        raise MitsimError("no Mitsuba variant is selected; call mitsim.core.environment.load_variant first")
    if (variant, plugin) not in _REGISTERED:
        getattr(mi, f"register_{kind}")(plugin, build())
        _REGISTERED.add((variant, plugin))
