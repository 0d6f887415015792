"""The mask's code, its terms and its transmission at points agree with each other."""

import numpy as np
import pytest
from scipy.signal import max_len_seq

from mitsim.core.errors import MitsimError
from mitsim.rig.mask import Mask, mls_mask


@pytest.mark.parametrize(("kind", "open_share"), [("separable", 0.25), ("flatcam", 0.5), ("open", 1.0)])
def test_open_share_and_pointwise_transmission(kind, open_share):
    # Sampled at feature centres the plate is 0/1, equals the sum of its terms, and has the stated open share
    # (up to the one surplus bit of a maximum length sequence, 1 in 511).
    mask = mls_mask(kind)
    s = (np.arange(511) - 255) * mask.feature_mm
    plate = mask.transmission(s[:, None], s[None, :])
    terms = sum(weight * np.outer(rows, columns) for weight, rows, columns in mask.terms)
    assert set(np.unique(plate)) <= {0.0, 1.0}
    np.testing.assert_array_equal(plate, terms)
    assert plate.mean() == pytest.approx(open_share, abs=2 / 511)


def test_code_is_the_stated_sequence_and_cannot_be_changed():
    mask = mls_mask()
    np.testing.assert_array_equal(mask.bits, max_len_seq(9)[0])
    assert mask.extent_mm == pytest.approx(30.66)
    with pytest.raises(ValueError, match="read-only"):
        mask.bits[0] = 1


def test_index_grows_with_the_coordinate_and_outside_is_dark():
    mask = Mask("separable", 2.0, np.array([1, 0, 0]))
    np.testing.assert_array_equal(mask.transmission([-3.1, -2.9, -1.1, -0.9, 2.9], -2.0), [0, 1, 1, 0, 0])
    assert mls_mask("flatcam").transmission(0.0, 15.4) == 0.0


@pytest.mark.parametrize(
    "arguments",
    [
        ("round", 0.06, [1, 0]),
        ("open", 0.0, [1]),
        ("open", float("nan"), [1]),
        ("open", 0.06, [2]),
        ("open", 0.06, []),
    ],
)
def test_bad_masks_are_refused_in_one_line(arguments):
    with pytest.raises(MitsimError, match=r"^[^\n]+$"):
        Mask(*arguments)


@pytest.mark.parametrize("order", [1, 40, 9.0, True])
def test_bad_order_is_refused(order):
    with pytest.raises(MitsimError, match="order"):
        mls_mask(order=order)
