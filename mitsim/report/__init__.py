"""Pages, plots and tables of results, and the exposures and models of a scene that studies compare."""

from __future__ import annotations

from mitsim.devices.patterns import FAMILIES, is_own, short_name

EQUAL_PEAK, EQUAL_FRAME, EQUAL_TOTAL = CONVENTIONS = ("equal peak", "equal frame", "equal total")
"""Exposures: see :mod:`mitsim.report.lit_scene`."""
IDEALISED, RENDERED = MODELS = ("idealised", "rendered")
"""The paper's model of a scene with its own exact factors, and its traced light with calibrated ones."""


def label(name: str) -> str:
    """Return the usual name of the patterns ``name``: "49 dots" for ``dots:7``, "7 x 14 dots" for ``dots:7x14``."""
    if is_own(name):
        return short_name(name)
    kind, size, order = (*name.split(":", 2), "", "")[:3]
    count = size.replace("x", " x ") if "x" in size else size and str(int(size) ** 2)
    text = f"{count} {FAMILIES[kind].label}" if count else kind.capitalize()
    return f"{text}, {order}" if order else text


def in_text(name: str) -> str:
    """Return the usual name of the patterns ``name`` inside a sentence: "uniform", "49 dots", "64 Hadamard"."""
    return label(name) if is_own(name) else label(name)[:1].lower() + label(name)[1:]
