"""All of mitsim's Mitsuba plugins: one call makes them known to the variant in use."""

from __future__ import annotations

from mitsim.transport.plugins import glass, grating, lens, lensless


def register() -> None:
    """Register every plugin for the current variant; calling it again does nothing.

    Raises
    ------
    MitsimError
        when no variant is selected.
    """
    lensless.register()
    grating.register()
    glass.register()
    lens.register()
