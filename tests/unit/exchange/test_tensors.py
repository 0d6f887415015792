"""Tensors of a run: the measurements that the solver sees, and one line where a package is missing."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import mitsim as ms
from mitsim.core.errors import MitsimError
from mitsim.exchange.formats import export
from tests.exchanged import made


def test_a_missing_package_is_told_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = made(tmp_path)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MitsimError, match=r"torch is not installed .* pip install 'mitsim\[torch\]'"):
        export(bench.run, "torch", tmp_path / "run.pt", bench.calibration)
    assert not (tmp_path / "run.pt").exists()


def test_the_file_holds_what_the_solver_sees(tmp_path: Path) -> None:
    """Measurements, truth, patterns and factors."""
    torch = pytest.importorskip("torch")
    bench = made(tmp_path, signed=True)
    shots, factors = ms.load_run(bench.run), ms.load_calibration(bench.calibration)
    export(bench.run, "torch", tmp_path / "run.pt", bench.calibration)
    held = {name: each.numpy() for name, each in torch.load(tmp_path / "run.pt", weights_only=True).items()}
    columns = shots.patterns[1].shape[1]
    for frame, i, j in shots.measurements():
        assert np.array_equal(held["y"][i * columns + j], frame)
    assert np.array_equal(held["x"][0], shots.truth)
    for name, expected in zip(("P_L", "P_R", "left", "right"), (*shots.patterns, *factors.sides), strict=True):
        assert np.array_equal(held[name], expected)
