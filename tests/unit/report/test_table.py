"""Rows of a study: means with standard errors against numpy, and a CSV that comes back as it was."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.report.pages import Mean, Table

ROWS = tuple(
    {"model": model, "patterns": patterns, "psnr_db": value, "seed": seed}
    for model, patterns, value, seed in [
        ("idealised", "uniform", 20.0, 0), ("idealised", "uniform", 23.0, 1), ("idealised", "uniform", 26.0, 2),
        ("rendered", "uniform", 21.0, 0), ("rendered", "dots:7", 40.0, 0),
    ]
)  # fmt: skip


def test_a_mean_has_the_standard_error_of_its_rows_alone() -> None:
    """(Planted: deviation with n in the denominator; rows of both models.)"""
    mean = Table(ROWS).mean("psnr_db", model="idealised", patterns="uniform")
    assert mean.value == 23 and mean.of == 3
    assert mean.error == pytest.approx(np.std([20, 23, 26], ddof=1) / 3**0.5)
    single = Table(ROWS).mean("psnr_db", model="rendered", patterns="dots:7")
    assert single.value == 40 and math.isnan(single.error) and str(single) == "40.0" and "23.0 ± 1.7" in str(mean)


def test_what_was_not_measured_is_refused() -> None:
    with pytest.raises(MitsimError, match="nothing was measured of psnr_db with model = idealised, patterns = dots:7"):
        Table(ROWS).mean("psnr_db", model="idealised", patterns="dots:7")


def test_means_by_a_column_keep_its_order() -> None:
    """Values with no number have no mean. (Planted: None among the means.)"""
    more = Table((*ROWS, {"model": "rendered", "patterns": "dots:4", "psnr_db": None, "seed": 0}))
    by = more.where(model="rendered").means("psnr_db", "patterns")
    assert list(by) == ["uniform", "dots:7"] and by["dots:7"].value == 40
    assert Table(ROWS).distinct("seed") == [0, 1, 2] and Table(ROWS).distinct("nothing") == []


def test_a_csv_has_all_columns_and_comes_back(tmp_path: Path) -> None:
    """Rows need not have the same columns."""
    table = Table((*ROWS, {"psnr_db": 1.5, "note": "a, b"}))
    table.write(tmp_path / "t.csv")
    rows = list(csv.DictReader((tmp_path / "t.csv").open(newline="", encoding="utf-8")))
    assert list(rows[0]) == ["model", "patterns", "psnr_db", "seed", "note"]
    assert [float(row["psnr_db"]) for row in rows] == [20, 23, 26, 21, 40, 1.5] and rows[-1]["note"] == "a, b"
    assert rows[0]["note"] == "" and rows[-1]["model"] == ""


def test_an_error_of_a_mean_is_never_nought() -> None:
    """(Planted: one place whatever the error, so 0.04 dB was 0.0.)"""
    assert str(Mean(23.41, 0.04, 2)) == "23.41 \N{PLUS-MINUS SIGN} 0.04"
    assert str(Mean(23.41, 0.94, 2)) == "23.4 \N{PLUS-MINUS SIGN} 0.9" and str(Mean(23.41, math.nan, 1)) == "23.4"
