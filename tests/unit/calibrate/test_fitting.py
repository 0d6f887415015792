"""Where mask and projector are, from a few noisy responses whose camera is known: planted offsets come back.

A model fitted to frames of a traced session, whose mask is not where it was to be.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import mitsim as ms
from mitsim.calibrate.model import Fitted, Shown, fit_placement, model_of
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.mask import mls_mask
from mitsim.devices.patterns import stripe_signs
from mitsim.devices.projector import Spectrum
from mitsim.devices.session import FITTED, UNITS, Modelling, frames_of
from mitsim.optics.terms import ModelledCamera, Placement
from tests.real_session import RealSession, write_list

N = 16
LINE = Spectrum(np.array([550.0]), np.ones(1))
PLANTED = {
    "mask_distance": 0.05,
    "mask_shift_row": 0.037,
    "mask_shift_column": -0.081,
    "mask_rotation": 1e-3,
    "magnification": 0.004,
    "gain": 1999.0,
}


@cache
def camera(spectrum: Spectrum | None = LINE, mask: str = "separable", depth: float = 40.0) -> ModelledCamera:
    """A sensor that is small and near: seen from its edges, a window is shifted, which tells distance from size."""
    geometry = CameraGeometry(pixels=96, mask=mask, scene_distance=depth)
    return ModelledCamera(geometry, ((-0.15, 0.15), (-0.15, 0.15)), N, spectrum)


def shown(
    model: ModelledCamera, placement: Placement, noise: float, which: list[tuple[str, int]], seed: int
) -> list[Shown]:
    """Responses of a camera at a ``placement`` with white ``noise``, a part of their mean under uniform light."""
    signs, even = stripe_signs(N).astype(np.float64), np.ones(N)
    angle = placement.mask_rotation
    terms = [model.factors(placement), *((angle * left, right) for left, right in model.rotation_terms(placement))]
    random, found = np.random.default_rng(seed), []
    level = noise * abs(np.outer(terms[0][0].sum(axis=1), terms[0][1].sum(axis=1))).mean()
    for side, index in which:
        rows, columns = (signs[:, index], even) if side == "horizontal" else (even, signs[:, index])
        frame = sum(np.outer(left @ rows, right @ columns) for left, right in terms)
        found.append(Shown(rows, columns, frame + level * random.standard_normal(frame.shape), level))
    return found


def patterns(frames: int) -> list[tuple[str, int]]:
    signs = stripe_signs(N)
    return Modelling("wave", frames).used_patterns(np.count_nonzero(np.diff(signs, axis=0), axis=0).tolist(), True, 1)


def deviations(fitted: Fitted, truth: Placement) -> FloatArray:
    return np.array(
        [(getattr(fitted.placement, name) - getattr(truth, name)) / fitted.errors[name] for name in fitted.free]
    )


@pytest.mark.parametrize(
    ("mask", "frames"),
    [
        pytest.param("separable", 2, marks=pytest.mark.slow),
        ("separable", 10),
        pytest.param("flatcam", 10, marks=pytest.mark.slow),
    ],
)
def test_planted_offsets_come_back_within_three_of_their_own_standard_errors(mask: str, frames: int) -> None:
    """Distance +50 um, shift 37 and -81 um, 1 mrad, 4e-3 of the window; noise a tenth of the mean frame.

    Six numbers of a normal law lie within three deviations with 98.4 %; the seed is one of these. Errors that are
    stated too large would not be seen by that: their squares' mean is above 0.1 with 99.9 % (chi-square of 6).
    """
    model = camera(mask=mask)
    truth = model.built.move(PLANTED)
    fitted = fit_placement(model, shown(model, truth, 0.1, patterns(frames), 4), FITTED)
    off = deviations(fitted, truth)
    assert np.abs(off).max() < 3 and np.square(off).mean() > 0.1
    assert fitted.errors["mask_shift_row"] < 2e-3 and fitted.errors["mask_rotation"] < 1e-3
    assert fitted.chi_square == pytest.approx(1, abs=0.25)


def test_numbers_that_act_alike_are_refused() -> None:
    """A small sensor far away sees a larger window as it sees a mask further off."""
    model = camera(None, depth=400.0)
    data = shown(model, model.built, 0.01, patterns(2), 0)
    with pytest.raises(
        MitsimError, match=r"mask_distance and magnification cannot be distinguished .* leave one of them out"
    ):
        fit_placement(model, data, FITTED)
    fitted = fit_placement(model, data, [name for name in FITTED if name != "magnification"])
    assert fitted.placement.mask_distance == pytest.approx(2.0, abs=3 * fitted.errors["mask_distance"])


def test_a_mask_far_off_is_refused_and_not_found_elsewhere() -> None:
    model = camera(None)
    away = model.built.move({"mask_shift_column": 0.31})
    with pytest.raises(MitsimError, match=r"mask_shift_column: the mask is off by 0\.3 mm or more"):
        fit_placement(model, shown(model, away, 0.01, patterns(4), 0), FITTED)


def test_what_is_held_stays_and_what_is_missing_shows() -> None:
    """A geometric model of a wave-optical camera leaves a part unexplained, as a shift that is not fitted does."""
    model = camera()
    data = shown(model, model.built.move({"gain": 9.0}), 0.01, patterns(6), 1)
    right = fit_placement(model, data, ("gain",))
    assert right.free == ("gain",) and right.placement == replace(model.built, gain=right.placement.gain)
    assert right.placement.gain == pytest.approx(10, rel=1e-3) and right.unexplained < 0.01
    wrong = fit_placement(camera(None), data, FITTED)
    assert wrong.unexplained > 0.015 and wrong.chi_square > 5
    moved = shown(model, model.built.move({"mask_shift_row": 0.01}), 0.01, patterns(6), 1)
    assert fit_placement(model, moved, ("gain",)).unexplained > 0.03


def test_a_turned_mask_casts_the_shadow_that_rays_through_it_make() -> None:
    """Against rays: each pixel's mean of a transmission, turned by 5 mrad, at 16 x 16 points, toward 4 x 4 points.

    The mask moves by 2 to 4 um, a few of these points' distances of 0.7 um, so single pixels scatter; over all of them
    the change is the model's to a tenth.
    """
    angle, model = 5e-3, camera(None)
    geometry = model.geometry
    fine, points = 16, 4
    u = geometry.centres(0)[:, None] + geometry.pixel_pitch * ((np.arange(fine) + 0.5) / fine - 0.5)
    u = u.ravel()
    width = 0.3 / N
    tau = -0.15 + width * (np.arange(N * points) + 0.5) / points
    d, z = geometry.mask_distance, geometry.scene_distance
    bits = mls_mask("separable", geometry.mask_feature, geometry.mask_order).bits
    half = len(bits) / 2

    def code(s: FloatArray) -> FloatArray:
        return bits[np.floor(s / geometry.mask_feature + half).astype(int)].astype(float)

    def frame(turn: float, row: int, column: int) -> FloatArray:
        total = np.zeros((geometry.pixels, geometry.pixels))
        for a in tau[points * row : points * (row + 1)]:
            for b in tau[points * column : points * (column + 1)]:
                s, t = ((1 - d / z) * u + d * a)[:, None], ((1 - d / z) * u + d * b)[None]
                clear = code(s + turn * t) * code(t - turn * s)
                total += clear.reshape(geometry.pixels, fine, geometry.pixels, fine).mean(axis=(1, 3)) / points**2
        return total

    row, column = 3, 12
    change = frame(angle, row, column) - frame(0.0, row, column)
    reported = sum(
        angle * np.outer(left[:, row], right[:, column]) for left, right in model.rotation_terms(model.built)
    )
    assert np.linalg.norm(reported) > 0.02 * np.linalg.norm(frame(0.0, row, column))
    falloff = np.prod([(1 + tau[points * each : points * (each + 1)].mean() ** 2) ** -2 for each in (row, column)])
    reported = reported / falloff
    assert np.vdot(reported, change) / np.vdot(reported, reported) == pytest.approx(1, abs=0.1)
    assert np.linalg.norm(reported - change) < 0.7 * np.linalg.norm(change)


def test_frames_are_chosen_from_coarse_to_fine_and_counted() -> None:
    changes = [0, 5, 1, 3]
    assert Modelling("wave", 2).used_patterns(changes, True, 1) == [("horizontal", 0)]
    chosen = Modelling("wave", 9).used_patterns(changes, True, 1)
    assert chosen == [("horizontal", 0), ("vertical", 2), ("horizontal", 2), ("vertical", 3)]
    assert frames_of(chosen, True, 1) == 8 and frames_of(chosen, False, 3) == 18
    assert len(Modelling("wave", 8).used_patterns(changes, True, 2)) == 2
    assert len(Modelling("wave", 8).used_patterns(changes, False, 1)) == 6
    assert len(Modelling("wave", 1000).used_patterns(changes, True, 1)) == 7


def test_words_are_checked() -> None:
    for wrong, reported in (
        (
            {"model": "wave", "fitted": ("projector_row", "mask_shift_row")},
            "fit mask_shift_row,projector_row: both move",
        ),
        ({"model": "ray"}, "model 'ray': use geometric or wave"),
        ({"model": "wave", "frames": 1}, "frames_used 1: give 2 or more"),
        ({"model": "wave", "fitted": ("tilt",)}, "fit 'tilt': use names of mask_distance"),
    ):
        with pytest.raises(ArgumentError, match=reported):
            Modelling(**wrong)  # type: ignore[arg-type]
    assert Modelling("wave", fitted=("magnification",)).free == ("magnification", "gain")
    assert tuple(UNITS) == tuple(Placement.__dataclass_fields__)


# ---- Models of simulated sessions ----


FIT = ("mask_distance", "mask_shift_row", "mask_shift_column", "mask_rotation")


@pytest.fixture(scope="module")
def bench(shared_scene: Callable[..., Path], variant: str) -> Any:
    return ms.open_bench(shared_scene("modelled", n=16), variant)


def test_a_rough_model_is_flagged(bench: Any, kept_plans: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """And what is said of it is added up by one thread of BLAS: `predicted_phi_error` differed in its last digit.
    (Planted: so it does.)"""
    asked: list[set[int]] = []

    def look(_: object) -> float:
        asked.append({pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"})
        return 1.0

    monkeypatch.setattr("mitsim.calibrate.model.squared_condition", look)
    with threadpool_limits(2):
        factors = ms.calibrate_model(bench, Modelling("geometric", 8, FIT, 5e-3))
    assert asked == [{1}, {1}]
    assert not factors.ok and "The geometric model does not explain the responses" in factors.warnings[0]
    assert factors.manifest.noise is not None and factors.manifest.noise.unexplained > 0.01
    assert factors.manifest.modelled is not None and factors.manifest.modelled.frames == 8


def test_frames_of_a_real_session_are_fitted_in_their_folder(bench: Any, tmp_path: Path) -> None:
    """Frames of a camera whose mask is off, written as numbers; the scene states it as it was to be."""
    model = model_of(bench, "wave")
    truth = model.built.move({"mask_shift_row": 0.02, "mask_distance": 0.03, "gain": 4e5 / bench.n})
    real = RealSession(n=bench.n)
    real.left, real.right = model.factors(truth)
    factors = ms.calibrate_model(
        bench, Modelling("wave", 10, FIT), real.write(tmp_path / "frames"), output=tmp_path / "cal"
    )
    assert factors.ok and factors.manifest.result["frames"] == 10
    numbers = ms.load_calibration(tmp_path / "cal").manifest.modelled
    assert numbers is not None
    for name in FIT:
        found = numbers.parameters[name]
        assert found.standard_error is not None
        assert found.value == pytest.approx(getattr(truth, name), abs=3 * found.standard_error), name
    write_list(tmp_path / "frames", n=8)
    with pytest.raises(MitsimError, match="frames"):
        ms.calibrate_model(bench, Modelling("wave", 10, FIT), tmp_path / "frames")
