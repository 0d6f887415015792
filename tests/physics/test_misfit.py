"""Misfit in rendered light: a sheet 2 mm off is flagged, and of 42 runs that fit none is.

Rationale: at 400 mm, 60 mm beside the camera, 2 mm are 0.3 projector pixels of parallax, and 13 dB with 49 dots.
Expectation: flagged in front and behind, by every family but uniform light, which takes a moved image for an
image. Fitting runs are flat matt prints at the calibrated distance, each with noise of its own; a false flag would need
6 deviations of chance.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.misfit import UNEXPLAINED
from mitsim.reconstruct.reconstruct import reconstruct
from mitsim.reconstruct.solver import Verdict

pytestmark = pytest.mark.slow
SEEDS = {"uniform": 4, "dots:4": 4, "dots:7": 4, "hadamard:8": 2}
"""Seeds a family: 14 runs of each of three prints."""


@pytest.fixture(scope="module")
def factors(shipped_bench: Callable[..., object]) -> Factors:
    return shipped_bench("photograph").calibrate(seed=0)


@pytest.mark.parametrize("scene", ["photograph", "colour_chart", "resolution_target"])
def test_fitting_runs_are_not_flagged(shipped_bench: Callable[..., object], factors: Factors, scene: str) -> None:
    light = shipped_bench(scene).light(accuracy=1e-3)
    for patterns, seeds in SEEDS.items():
        for seed in range(seeds):
            image = reconstruct(light.expose(patterns, seed=seed), factors)
            found = image.misfit
            assert found is not None
            print(
                f"{scene} {patterns} {seed}: {found.chi_square:.3f} {found.unexplained:.1e} {found.worst_tile:.1e}",
                flush=True,
            )
            assert image.ok and not found.flagged, f"{patterns}, seed {seed}: {image.status}"
            assert found.unexplained < UNEXPLAINED and found.worst_tile < 1e-2


@pytest.mark.parametrize("z", [398, 402])
def test_a_sheet_2_mm_off_is_flagged(shipped_bench: Callable[..., object], factors: Factors, z: int) -> None:
    light = shipped_bench("photograph", sheet_z=str(z)).light(accuracy=1e-3)
    for patterns in ("dots:4", "dots:7", "hadamard:8"):
        image = reconstruct(light.expose(patterns), factors)
        assert image.misfit is not None, patterns
        print(f"{z} {patterns}: {image.misfit.chi_square:.3f} {image.misfit.unexplained:.1e}", flush=True)
        assert image.status.verdict is Verdict.MISFIT and not image.misfit.faults and not image.misfit.readings
