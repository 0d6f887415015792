"""Mitsuba plugins of mitsim, one a file; a call makes all of them known to the variant in use."""

from __future__ import annotations

_REGISTERED: set[tuple[str, str]] = set()
"""Variants and plugins that are known to them."""


def register() -> None:
    """Register every plugin for the current variant; calling it again does nothing.

    Raises
    ------
    MitsimError
        when no variant is selected.
    """
    import mitsuba as mi

    from mitsim.core.errors import MitsimError
    from mitsim.transport.plugins import glass, grating, lens, lensless

    variant = mi.variant()
    if variant is None:
        raise MitsimError("no Mitsuba variant is selected; call mitsim.core.environment.load_variant first")
    for kind, plugin in (("sensor", lensless), ("bsdf", grating), ("bsdf", glass), ("emitter", lens)):
        if (variant, plugin.PLUGIN) not in _REGISTERED:
            getattr(mi, f"register_{kind}")(plugin.PLUGIN, plugin.plugin_class())
            _REGISTERED.add((variant, plugin.PLUGIN))
