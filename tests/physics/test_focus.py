"""Focus in rendered light: a print beside the calibrated distance is found, and comes out as if calibrated there.

Rationale: at 380 mm, with the projector 60 mm beside the camera, parallax is 3.4 projector pixels and costs 30 dB.
Expectation: depth within 0.1 mm (0.02 were seen), no misfit left, and at least 44 dB; calibrations at their own depth
have 46 to 51.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.reconstruction import reconstruct
from mitsim.study.metrics import psnr

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def factors(shipped_bench: Callable[..., object]) -> Factors:
    return shipped_bench("photograph").calibrate(seed=0)


@pytest.mark.parametrize("z", [360, 380, 440])
def test_a_sheet_off_the_calibrated_distance(shipped_bench: Callable[..., object], factors: Factors, z: int) -> None:
    light = shipped_bench("photograph", sheet_z=str(z)).light(accuracy=1e-3)
    shots = light.expose("dots:7")
    assert reconstruct(shots, factors).misfit.flagged
    image = reconstruct(shots, factors, focus="auto")
    print(f"{z}: {image.focus}, {psnr(image.image, light.truth):.1f} dB", flush=True)
    assert image.ok and abs(image.focus.mm - z) < 0.1
    assert psnr(image.image, light.truth) > 44
