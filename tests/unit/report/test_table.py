"""Means of studies with standard errors against numpy, and a CSV that comes back as it was."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.report.pages import Mean
from mitsim.studies.framework.campaign import write_table


def test_a_mean_has_the_standard_error_of_its_numbers() -> None:
    """(Planted: deviation with n in the denominator.)"""
    mean = Mean.of_numbers([20.0, 23.0, 26.0], "psnr_db")
    assert mean.value == 23 and mean.of == 3
    assert mean.error == pytest.approx(np.std([20, 23, 26], ddof=1) / 3**0.5)
    single = Mean.of_numbers([40.0], "psnr_db")
    assert single.value == 40 and math.isnan(single.error) and str(single) == "40.0" and "23.0 ± 1.7" in str(mean)
    with pytest.raises(MitsimError, match="nothing was measured of psnr_db"):
        Mean.of_numbers([], "psnr_db")


def test_a_csv_has_all_columns_and_comes_back(tmp_path: Path) -> None:
    """Rows need not have the same columns."""
    write_table(tmp_path / "t.csv", [{"model": "idealised", "psnr_db": 20.0}, {"psnr_db": 1.5, "note": "a, b"}])
    rows = list(csv.DictReader((tmp_path / "t.csv").open(newline="", encoding="utf-8")))
    assert list(rows[0]) == ["model", "psnr_db", "note"]
    assert [float(row["psnr_db"]) for row in rows] == [20, 1.5] and rows[-1]["note"] == "a, b"
    assert rows[0]["note"] == "" and rows[-1]["model"] == ""


def test_an_error_of_a_mean_is_never_nought() -> None:
    """(Planted: one place whatever the error, so 0.04 dB was 0.0.)"""
    assert str(Mean(23.41, 0.04, 2)) == "23.41 \N{PLUS-MINUS SIGN} 0.04"
    assert str(Mean(23.41, 0.94, 2)) == "23.4 \N{PLUS-MINUS SIGN} 0.9" and str(Mean(23.41, math.nan, 1)) == "23.4"
