"""Mitsuba plugins of mitsim, one a file."""

from __future__ import annotations

_REGISTERED: set[str] = set()
"""Variants that know the plugins."""


def register() -> None:
    import mitsuba as mi

    from mitsim.core.errors import MitsimError
    from mitsim.transport.plugins import glass, grating, lens, lensless, wrappers

    variant = mi.variant()
    if variant is None:
        raise MitsimError("no Mitsuba variant is selected; call mitsim.core.environment.load_variant first")
    if variant in _REGISTERED:
        return
    for kind, plugin in (("sensor", lensless), ("bsdf", grating), ("bsdf", glass), ("emitter", lens)):
        getattr(mi, f"register_{kind}")(plugin.PLUGIN, plugin.plugin_class())
    for name, made in wrappers.plugin_classes().items():
        mi.register_bsdf(name, made)
    _REGISTERED.add(variant)
