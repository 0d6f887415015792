"""What people read of a run: pages, plots, tables; and the exposures and models of a scene that they compare."""

from __future__ import annotations

EQUAL_PEAK, EQUAL_FRAME, EQUAL_TOTAL = CONVENTIONS = ("equal peak", "equal frame", "equal total")
"""Exposures: see :mod:`mitsim.report.lit_scene`."""
IDEALISED, RENDERED = MODELS = ("idealised", "rendered")
"""The paper's model of a scene with its own exact factors, and its traced light with calibrated ones."""
