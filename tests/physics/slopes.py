"""The reference against the factored estimator, by what differs over the sensor alone."""

from __future__ import annotations

import numpy as np

from mitsim.api.bench import Bench

SEEDS = 8
"""Of the reference: their spread tells the standard error to a quarter."""


def slope_of_reference(bench: Bench) -> tuple[float, float, float, float]:
    """Slope of the reference's frame on the factored one less its mean, and its standard error, of seeds of 128 samples
    a pixel; means of both frames. Without diffraction and black level, which the reference has not."""
    factored = bench.render("factored", effects={"diffraction": False, "black-level": False}).mean
    contrast = factored - factored.mean()
    seeds = [bench.render("reference", spp=128, seed=seed).mean for seed in range(SEEDS)]
    slopes = np.array([np.vdot(frame, contrast) / np.vdot(contrast, contrast) for frame in seeds])
    error = float(slopes.std(ddof=1) / SEEDS**0.5)
    return float(slopes.mean()), error, float(np.mean(seeds)), float(factored.mean())
