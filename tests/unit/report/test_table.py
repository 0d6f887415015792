"""Means of studies with standard errors, against numpy."""

import math

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.report.pages import Mean


def test_a_mean_has_the_standard_error_of_its_numbers() -> None:
    """(Planted: deviation with n in the denominator.)"""
    mean = Mean.of_numbers([20.0, 23.0, 26.0], "psnr_db")
    assert mean.value == 23 and mean.of == 3
    assert mean.error == pytest.approx(np.std([20, 23, 26], ddof=1) / 3**0.5)
    single = Mean.of_numbers([40.0], "psnr_db")
    assert single.value == 40 and math.isnan(single.error) and str(single) == "40.0" and "23.0 ± 1.7" in str(mean)
    with pytest.raises(MitsimError, match="nothing was measured of psnr_db"):
        Mean.of_numbers([], "psnr_db")


def test_an_error_of_a_mean_is_never_nought() -> None:
    """(Planted: one place whatever the error, so 0.04 dB was 0.0.)"""
    assert str(Mean(23.41, 0.04, 2)) == "23.41 \N{PLUS-MINUS SIGN} 0.04"
    assert str(Mean(23.41, 0.94, 2)) == "23.4 \N{PLUS-MINUS SIGN} 0.9" and str(Mean(23.41, math.nan, 1)) == "23.4"
