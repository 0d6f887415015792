"""Factors: the whole model as a linear operator with its adjoint, and the CAL folder that they make."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import hadamard

from mitsim.bench.request import Request
from mitsim.core.errors import MitsimError
from mitsim.core.manifests import CalibrationManifest
from mitsim.devices.patterns import PatternFamily, parse_patterns
from mitsim.reconstruct.factors import Factors, load_calibration, rank_above_noise
from mitsim.reconstruct.solver import Status, Verdict
from tests.stripes import estimated

N, ROWS, COLUMNS = 12, 20, 17
FAMILIES = ("uniform", "dots:3", "dots:5", "hadamard:4", "random:3")


def factors(centre: bool = False) -> Factors:
    rng = np.random.default_rng(7)
    manifest = CalibrationManifest(camera={"name": "bench"}, centre=centre, board_reflectance=0.99)
    left, right = rng.random((ROWS, N)), rng.random((COLUMNS, N))
    return Factors(left, right, manifest, Status(Verdict.CALIBRATED, "Calibrated"))


@pytest.mark.parametrize("centre", [False, True], ids=["plain", "centred"])
@pytest.mark.parametrize("patterns", FAMILIES)
def test_the_adjoint_passes_the_dot_test(patterns: str, centre: bool) -> None:
    """<A x, y> = <x, A^H y>. (Planted: rights not transposed in the adjoint's last product.)"""
    operator = factors(centre).operator(patterns)
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=operator.shape[1]), rng.normal(size=operator.shape[0])
    forward, backward = np.vdot(operator @ x, y), np.vdot(x, operator.H @ y)
    assert abs(forward - backward) <= 1e-12 * np.linalg.norm(operator @ x) * np.linalg.norm(y)


@pytest.mark.parametrize("centre", [False, True], ids=["plain", "centred"])
@pytest.mark.parametrize("patterns", FAMILIES)
def test_it_is_the_model_of_each_frame(patterns: str, centre: bool) -> None:
    """Frame (i, j) is Phi_L (P_ij o X) Phi_R^T, written out pixel by pixel of the pattern; centred: C Y C."""
    model, family = factors(centre), parse_patterns(patterns, N)
    image = np.random.default_rng(5).normal(size=(N, N))
    shape = family.left.shape[1], family.right.shape[1], ROWS, COLUMNS
    frames = (model.operator(family) @ image.ravel()).reshape(shape)
    for i in range(family.left.shape[1]):
        for j in range(family.right.shape[1]):
            frame = model.left @ (np.outer(family.left[:, i], family.right[:, j]) * image) @ model.right.T
            if centre:
                frame = frame - frame.mean(axis=0) - frame.mean(axis=1, keepdims=True) + frame.mean()
            np.testing.assert_allclose(frames[i, j], frame, rtol=1e-11, atol=1e-11)


def test_a_scene_may_have_other_numbers_of_rows_and_columns() -> None:
    rng = np.random.default_rng(9)
    model = factors()
    wide = Factors(model.left, rng.random((COLUMNS, 5)), model.manifest, model.status)
    image, family = rng.normal(size=(N, 5)), PatternFamily("own", rng.random((N, 1)), rng.random((5, 2)))
    frames = (wide.operator(family) @ image.ravel()).reshape(1, 2, ROWS, COLUMNS)
    for j in range(2):
        frame = wide.left @ (np.outer(family.left[:, 0], family.right[:, j]) * image) @ wide.right.T
        np.testing.assert_allclose(frames[0, j], frame, rtol=1e-12)


def test_random_patterns_by_name_are_those_of_a_capture_without_a_seed() -> None:
    image = np.ones(N * N)
    by_name, by_seed = factors().operator("random:3"), factors().operator(parse_patterns("random:3", N, Request().seed))
    assert np.array_equal(by_name @ image, by_seed @ image)


def test_factors_are_usable_with_a_good_status_and_no_warnings_alone() -> None:
    good = factors()
    warned = Factors(good.left, good.right, good.manifest.model_copy(update={"warnings": ("saturation",)}), good.status)
    noisy = Factors(good.left, good.right, good.manifest, Status(Verdict.MOSTLY_NOISE, "Factors are mostly noise"))
    assert (good.ok, warned.ok, noisy.ok) == (True, False, False)


def test_patterns_of_another_projector_are_refused() -> None:
    with pytest.raises(MitsimError, match=r"patterns 'dots:3' are for 16 x 16 .* have 12 x 12"):
        factors().operator(parse_patterns("dots:3", 16))


def test_saved_and_loaded_they_are_the_same(tmp_path: Path) -> None:
    signs = hadamard(4).astype(float)
    rng = np.random.default_rng(1)
    left, right = rng.random((9, 4)) + np.eye(9, 4), rng.random((8, 4)) + np.eye(8, 4)
    horizontal = [np.outer(left @ column, right.sum(axis=1)) for column in signs.T]
    vertical = [np.outer(left.sum(axis=1), right @ column) for column in signs.T]
    memory = Factors.of(estimated(horizontal, vertical, signs), CalibrationManifest(camera={"name": "bench"}))
    memory.save(tmp_path / "cal")
    disk = load_calibration(tmp_path / "cal")
    assert np.array_equal(disk.left, memory.left) and np.array_equal(disk.right, memory.right)
    assert disk.fingerprint == memory.fingerprint and disk.condition == memory.condition
    assert disk.status.verdict is memory.status.verdict is Verdict.CALIBRATED and disk.ok
    assert str(disk.status) == str(memory.status)
    for shown in (memory, disk):
        assert shown._repr_html_().count("data:image/png;base64,") == 2


def test_a_rank_counts_directions_above_six_deviations_of_the_noise() -> None:
    """Of a factor of 50 rows whose two small singular values lie 2 % above and below the limit, where an error of a
    tenth has the energy e^2 |Phi|^2 / 150 (50 + 6 sqrt(100)) in a direction. (Planted: the noise of all numbers.)"""
    part = 0.1**2 / 150 * (50 + 6 * np.sqrt(100))
    limit = np.sqrt(part / (1 - 2 * part))
    turned = np.linalg.qr(np.random.default_rng(1).standard_normal((50, 3)))[0]
    assert rank_above_noise(turned * [1.0, 1.02 * limit, 0.98 * limit], 0.1) == 2
    own = factors()
    stated = own.manifest.model_copy(update={"result": {"rank": [7, 5]}})
    assert replace(own, manifest=stated).stated_rank == (7, 5) and own.stated_rank is None
