"""The anchor geometry gives the condition numbers it is known by.

Rationale: conditioning hangs on every digit of the geometry (the scene 2 mm further off doubles it), so
three numbers guard mask code, shadow, scale and block structure at once. Expectation: cond(A_L) = 7.03e6
under uniform light, 545 under 25 shifting dots, 92.6 under 64, each within 1 %.
"""

import numpy as np
import pytest

from mitsim.devices.camera import centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.reconstruct.solver import prepare
from tests.shadow_factor import scene_factor


@pytest.mark.parametrize(("k", "condition"), [(1, 7.03e6), (5, 545.0), (8, 92.6)])
def test_condition_numbers(k, condition):
    factor = scene_factor(
        mls_mask().terms[0][1], 0.06, centred_edges(512, 0.01172), centred_edges(128, 120 / 128), 2.0, 400.0
    )
    dots = (np.arange(128)[:, None] % k == np.arange(k)).astype(float)
    assert prepare(factor, factor, dots, dots).condition == pytest.approx(condition, rel=0.01)
