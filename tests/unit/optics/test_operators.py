"""Operators and their adjoints are transposes of one another, and compose the mask's own terms."""

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.optics.mask import mls_mask
from mitsim.optics.operators import Separable, SeparableSum, shadow_operator
from mitsim.optics.shadow import centred_edges


def dot_test(operator, seed):
    """<A x, y> = <x, A^T y>, relative to the norms; rounding leaves about 1e-15."""
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=operator.input_shape), rng.normal(size=operator.output_shape)
    forward, backward = np.vdot(operator.forward(x), y), np.vdot(x, operator.adjoint(y))
    scale = np.linalg.norm(operator.forward(x)) * np.linalg.norm(y)
    assert abs(forward - backward) <= 1e-13 * scale


def test_adjoint_of_one_and_of_several_terms():
    rng = np.random.default_rng(0)
    terms = tuple(Separable(rng.normal(size=(7, 4)), rng.normal(size=(9, 5))) for _ in range(3))
    dot_test(terms[0], 1)
    dot_test(SeparableSum(terms), 2)


@pytest.mark.parametrize("kind", ["separable", "flatcam", "open"])
def test_shadow_of_one_cell_is_the_mask_seen_from_there(kind):
    # Cells and pixels much smaller than a feature: the frame of one lit cell is the transmission at
    # s = u (1 - d/z) + d tau, apart from the few pixels on an edge.
    mask = mls_mask(kind, feature_mm=0.5, order=5)
    pixels, cells = centred_edges(60, 0.1), centred_edges(5, 1e-4)
    operator = shadow_operator(mask, pixels, pixels, cells, cells + 0.3, 2.0, 50.0)
    dot_test(operator, 3)
    light = np.zeros((5, 5))
    light[4, 0] = 1.0
    u = (pixels[:-1] + pixels[1:]) / 2 * (1 - 2 / 50)
    expected = mask.transmission((u + 2 * 2e-4)[:, None], (u + 2 * (0.3 - 2e-4))[None, :])
    frame = operator.forward(light)
    clean = (frame < 1e-9) | (frame > 1 - 1e-9)
    assert clean.mean() > 0.6
    np.testing.assert_allclose(frame[clean], expected[clean], atol=1e-9)


def test_wrong_shapes_are_refused():
    operator = Separable(np.ones((3, 2)), np.ones((3, 2)))
    for call in (
        lambda: operator.forward(np.ones((3, 2))),
        lambda: operator.adjoint(np.ones(3)),
        lambda: Separable(np.ones(3), np.ones((3, 2))),
        lambda: SeparableSum((operator, Separable(np.ones((4, 2)), np.ones((3, 2))))),
    ):
        with pytest.raises(MitsimError, match=r"^[^\n]+$"):
            call()
