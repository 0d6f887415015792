"""Mitsuba plugins of mitsim."""

from __future__ import annotations

_REGISTERED: set[str] = set()
"""Variants that know the plugins."""


def register() -> None:
    import mitsuba as mi

    from mitsim.core.errors import MitsimError
    from mitsim.transport.plugins import ies, lens, lensless, materials

    variant = mi.variant()
    if variant is None:
        raise MitsimError("no Mitsuba variant is selected; call mitsim.core.environment.load_variant first")
    if variant in _REGISTERED:
        return
    mi.register_sensor(lensless.PLUGIN, lensless.plugin_class())
    mi.register_emitter(lens.PLUGIN, lens.plugin_class())
    mi.register_emitter(ies.PLUGIN, ies.plugin_class())
    for name, made in materials.plugin_classes().items():
        mi.register_bsdf(name, made)
    _REGISTERED.add(variant)
