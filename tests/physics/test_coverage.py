"""The stated uncertainty covers the truth: rendered light, the whole sensor chain, a new calibration each session.

Rationale: a standard uncertainty u is right when the errors that it states are normal and as large as stated. What is
drawn anew in each session (noise of the run's frames, of the calibration's 64 shots) averages over sessions; what all
sessions of one print share (print within a pixel, what lambda takes away, rendering) is one draw a print, and averages
over prints. So there are PRINTS prints of SESSIONS sessions each, 200 in all. The brightest pixel fills a tenth of the
well.

Expectation: print within a pixel is stated as that of prints that may have hard edges or none, `detail.PRINT` = 1.95
times the energy of the ramps that these smooth prints are made of (`mitsim.reconstruct.accumulation`). With v^2 = u^2
- (1 - 1 / PRINT) print^2, normal errors lie within 1.96 u in erf(1.96 u / v / sqrt 2) of the pixels: 95.2 to 97.6 % by
print and patterns, and 95 % where nothing is print. (Held against 93 to 97 %, one print of `dots:2` had 97.004 %: 96.8
were to be expected.)

Chance: shared errors have some 16 independent places in 16 x 16 smooth pixels, so their variance scatters by sqrt(2 /
16) = 35 % from print to print. They are a quarter of v^2: 4.4 % of v, which moves coverage by 0.17 of that, 0.76 %;
0.27 % over PRINTS. Sessions scatter by 1.3 to 1.9 %, 0.13 % over 200. Together 0.3 %, and three of these are allowed;
uncertainties that are off by 6 % are seen.

The 64 pixels see 12 features of the mask, so light varies over a frame: `dots:4` had 91.8 % inside (40 sessions) while
the variance of a frame was taken for even, 93.9 % (60 sessions) since its rows and columns count.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import erf

from mitsim.api.bench import Bench, open_bench
from mitsim.calibrate.board_session import LitSession, Session
from mitsim.calibrate.calibrate import estimate
from mitsim.core.job import Job
from mitsim.core.manifests import CalibrationManifest
from mitsim.devices.session import load_recipe
from mitsim.reconstruct.accumulation import PRINT
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.reconstruct.uncertainty import Uncertainty

pytestmark = pytest.mark.slow
PRINTS, SESSIONS, N = 8, 25, 16
ALLOWED = 0.009


def shaded_print(seed: int = 4, size: int = 64) -> np.ndarray:
    """Eight-bit print of smooth shades, four texels a projector pixel."""
    shades = gaussian_filter(np.random.default_rng(seed).standard_normal((size, size)), 8, mode="nearest")
    return 128 + 90 * shades / np.abs(shades).max()


def expected(found: Uncertainty) -> float:
    """Part of the pixels within 1.96 of their uncertainty, of a print of ramps."""
    variance = np.square(found.total)
    actual = variance - (1 - 1 / PRINT) * np.square(found.sources["print_detail"])
    return float(erf(1.96 * np.sqrt(variance / actual / 2)).mean())


def sessions(bench: Bench, patterns: str, seeds: range) -> Iterator[tuple[float, float]]:
    """Part of the pixels that are covered, and that are expected to be, in each session before one print."""
    light = bench.light(patterns=patterns, accuracy=3e-4)
    session, recipe = Session(bench, load_recipe(), 0), load_recipe()
    board = LitSession.of(session, session.trace(session.plan(2e-4, Job()), Job())[0], Job())
    manifest = CalibrationManifest(
        camera=bench.identity(), centre=bench.geometry.centred, board_reflectance=recipe.board_reflectance
    )
    for seed in seeds:
        shots = light.expose(patterns, seed=seed, exposure_fraction=0.1)
        noisy, _ = estimate(replace(board, session=replace(session, seed=1000 + seed)), Job())
        image = reconstruct(shots, Factors.of(noisy, manifest))
        assert image.ok and image.uncertainties is not None and shots.truth is not None
        inside = np.abs(image.image - shots.truth) < 1.96 * image.uncertainties.total
        yield float(inside.mean()), expected(image.uncertainties)


@pytest.mark.parametrize("patterns", ["hadamard:4", "dots:2"])
def test_200_sessions(small_scene: Callable[..., Path], variant: str, patterns: str) -> None:
    found = []
    for index in range(PRINTS):
        scene = small_scene(f"print{index}", reflectance=shaded_print(index), n=N, sheet_z=400)
        seeds = range(SESSIONS * index, SESSIONS * (index + 1))
        found.append(np.mean([*sessions(open_bench(scene, variant), patterns, seeds)], axis=0))
        print(f"{patterns}, print {index}: {found[-1][0]:.2%} inside, {found[-1][1]:.2%} expected")
    covered, wanted = np.mean(found, axis=0)
    print(f"{patterns}: {covered:.2%} inside, {wanted:.2%} expected")
    assert 0.95 <= wanted < 0.98
    assert abs(covered - wanted) < ALLOWED
