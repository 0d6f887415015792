"""Mitsuba plugins of mitsim, one a file; a call makes all of them known to the variant in use."""

from __future__ import annotations


def register() -> None:
    """Register every plugin for the current variant; calling it again does nothing.

    Raises
    ------
    MitsimError
        when no variant is selected.
    """
    from mitsim.transport.plugins import glass, grating, lens, lensless

    for plugin in (lensless, grating, glass, lens):
        plugin.register()
