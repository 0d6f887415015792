"""Tensors of a run: an exact adjoint, the measurements that the solver sees, one line where a package is missing."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import mitsim as ms
from mitsim.core.errors import MitsimError
from mitsim.exchange import tensors
from mitsim.exchange.formats import export
from tests.exchanged import COLUMNS, ROWS, SCENE, made


@pytest.mark.parametrize("format", ["torch", "deepinv"])
def test_a_missing_package_is_told_in_a_line(format: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = made(tmp_path)
    monkeypatch.setitem(sys.modules, format, None)
    with pytest.raises(MitsimError, match=rf"{format} is not installed .* pip install 'mitsim\[{format}\]'"):
        export(bench.run, format, tmp_path / "run.pt", bench.calibration)
    assert not (tmp_path / "run.pt").exists()


@pytest.mark.parametrize("signed", [False, True])
def test_the_physics_is_the_model_and_its_adjoint(signed: bool, tmp_path: Path) -> None:
    """<A x, y> = <x, A^T y> in double precision, and A x is the solver's own operator."""
    torch = pytest.importorskip("torch")
    pytest.importorskip("deepinv")
    bench = made(tmp_path, signed=signed, ambient=not signed)
    shots, factors = ms.load_run(bench.run), ms.load_calibration(bench.calibration)
    physics = tensors.physics(factors, shots.patterns)
    generator = torch.Generator().manual_seed(1)
    x = torch.randn(2, 1, *SCENE, dtype=torch.float64, generator=generator)
    y = torch.randn(2, len(list(shots.measurements())), ROWS, COLUMNS, dtype=torch.float64, generator=generator)
    forward, backward = (physics.A(x) * y).sum(), (x * physics.A_adjoint(y)).sum()
    assert abs(forward - backward) <= 1e-12 * physics.A(x).norm() * y.norm()
    left, right = shots.patterns
    lit = np.outer(left[:, 1], right[:, 0]) * x[1, 0].numpy()
    assert np.allclose(physics.A(x)[1, right.shape[1]].numpy(), factors.left @ lit @ factors.right.T, rtol=1e-12)


def test_the_file_holds_what_the_solver_sees(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    pytest.importorskip("deepinv")
    bench = made(tmp_path, signed=True)
    shots = ms.load_run(bench.run)
    export(bench.run, "deepinv", tmp_path / "run.pt", bench.calibration)
    physics, held = tensors.load_physics(tmp_path / "run.pt")
    columns = shots.patterns[1].shape[1]
    for frame, i, j in shots.measurements():
        assert np.array_equal(held["y"][i * columns + j].numpy(), frame)
    assert np.array_equal(held["x"][0].numpy(), shots.truth)
    found = physics.A(held["x"][None])[0]
    # Noise alone is between them.
    assert torch.corrcoef(torch.stack([found.ravel(), held["y"].ravel()]))[0, 1] > 0.95
    (tmp_path / "none.pt").write_text("none")
    with pytest.raises(MitsimError, match="no file of"):
        tensors.load_physics(tmp_path / "none.pt")


def test_a_full_disk_is_told_in_a_line(tmp_path: Path) -> None:
    """A file may have 4 KiB. (Planted: torch's own error.)"""
    pytest.importorskip("torch")
    resource, bench = pytest.importorskip("resource"), made(tmp_path)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 12, before[1]))
    try:
        with pytest.raises(
            MitsimError, match=r"run\.pt: cannot be written \(torch: .* choose a writable folder"
        ) as told:
            export(bench.run, "torch", tmp_path / "run.pt", bench.calibration)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert "\n" not in str(told.value) and not (tmp_path / "run.pt").exists()


def test_folders_are_a_data_set(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    runs = [made(tmp_path / name).run for name in "ab"]
    data = tensors.RunDataset(runs)
    x, y = next(iter(torch.utils.data.DataLoader(data, batch_size=2)))
    assert x.shape == (2, 1, *SCENE) and y.shape == (2, 6, ROWS, COLUMNS) and len(data) == 2
    (runs[1] / "truth.exr").unlink()
    with pytest.raises(MitsimError, match="has no truth"):
        tensors.RunDataset(runs)
