"""The mask's code, its terms and its transmission at points agree with each other."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.signal import max_len_seq

from mitsim.devices.mask import Mask, mls_code, mls_mask


@pytest.mark.parametrize(("kind", "open_share"), [("separable", 0.25), ("flatcam", 0.5), ("open", 1.0)])
def test_open_share_and_pointwise_transmission(kind, open_share):
    # Sampled at feature centres the plate is 0/1, equals the sum of its terms, and has the stated open share
    # (up to the one surplus bit of a maximum length sequence, 1 in 511).
    mask = mls_mask(kind)
    s = (np.arange(511) - 255) * mask.feature_mm
    plate = mask.transmission(s[:, None], s[None, :])
    terms = sum(weight * np.outer(rows, columns) for weight, rows, columns in mask.terms)
    assert set(np.unique(plate)) <= {0.0, 1.0} and not mask.bits.flags.writeable
    np.testing.assert_array_equal(plate, terms)
    assert plate.mean() == pytest.approx(open_share, abs=2 / 511)
    # The grids of openings neither overlap nor leave a place out.
    np.testing.assert_array_equal(plate, sum(np.outer(rows, columns).astype(int) for rows, columns in mask.openings))


@pytest.mark.parametrize("order", range(2, 17))
def test_codes_are_scipys_to_the_last_bit(order):
    code = mls_code(order)
    assert code.dtype == np.int8 and not code.flags.writeable
    np.testing.assert_array_equal(code, max_len_seq(order)[0])


def test_index_grows_with_the_coordinate_and_outside_is_dark():
    mask = Mask("separable", 2.0, np.array([1, 0, 0]))
    np.testing.assert_array_equal(mask.transmission([-3.1, -2.9, -1.1, -0.9, 2.9], -2.0), [0, 1, 1, 0, 0])
    assert mls_mask("flatcam").transmission(0.0, 15.4) == 0.0


def test_codes_do_without_scipys_signal_package():
    """It takes a second to import, and only the code's register was needed."""
    program = "import sys, mitsim.devices.mask as m; m.mls_mask(); assert 'scipy.signal' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True)
