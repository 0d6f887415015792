"""A diffuser camera: exposure and noise of its frames, the best lambda, both solvers, and the claims of its study."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.acquire.capture import rendered_psf
from mitsim.core.configuration import shipped_path
from mitsim.core.errors import MitsimError
from mitsim.devices.patterns import parse_patterns
from mitsim.devices.sensor import load_sensor
from mitsim.metrics import psnr
from mitsim.reconstruct.point_spread import DotClasses, ShiftedLight
from mitsim.report import EQUAL_FRAME, EQUAL_PEAK
from mitsim.studies.framework.experiment import Results, Scope, Setup, find_experiment
from mitsim.studies.other_cameras import best_image, race, take

N = 12
STUDY = find_experiment("convolutional")
SENSOR = load_sensor(shipped_path("calibration", "imx249.toml"))
BLUR = np.exp(-np.square(np.arange(-8, 9) / 1.5) / 2)
CAMERA = ShiftedLight.of(np.outer(BLUR, BLUR) / BLUR.sum() ** 2, N)
TRUTH = np.random.default_rng(2).uniform(0.1, 0.9, (N, N))


@pytest.mark.parametrize("convention", [EQUAL_PEAK, EQUAL_FRAME])
def test_exposure_follows_the_convention_and_noise_the_light(convention: str) -> None:
    """Peak: 0.8 of the full well of 129 440 electrons, of the family's own frames or of uniform light's.

    Residuals over their expected deviation sqrt(electrons + read noise^2 + 1/12 DN^2) of 9 x 784 numbers, seed 0: mean
    0 to 5 / sqrt(7056), mean square 1 to 5 sqrt(2 / 7056). Dark current adds some electrons at most.
    """
    family = parse_patterns("dots:3", N)
    frames, _ = take(CAMERA, family, TRUTH, SENSOR, convention)
    own = CAMERA.under(family).image_of(TRUTH)
    uniform = CAMERA.image_of(TRUTH)
    peak = own.max() if convention == "equal peak" else uniform.max()
    electrons = own * 0.8 * 4 * 32360 / peak
    unit = electrons.max() / own.max()
    deviation = np.sqrt(electrons + (2 * 6.7) ** 2 + 1 / 12 / 0.125**2)
    residual = (frames * unit - electrons) / deviation
    assert abs(residual.mean()) < 5 / np.sqrt(residual.size)
    assert np.mean(residual**2) == pytest.approx(1, abs=5 * np.sqrt(2 / residual.size))


def test_the_best_lambda_is_found_to_a_tenth_of_a_decibel() -> None:
    classes = DotClasses(CAMERA, 1)
    frames, _ = take(CAMERA, parse_patterns("uniform", N), TRUTH, SENSOR)
    solution, db = best_image(classes, frames, TRUTH)
    projected = classes.project(frames)
    fine = [
        psnr(classes.solve(projected, classes.largest * 10**exponent).image, TRUTH)
        for exponent in np.arange(-9, 0.01, 0.05)
    ]
    assert db == psnr(solution.image, TRUTH) and max(fine) - 0.1 < db <= max(fine) + 0.05
    assert fine[0] < max(fine) - 0.5 and fine[-1] < max(fine) - 0.5


@pytest.mark.parametrize("k", [1, 3])
def test_both_solvers_come_to_one_image(k: int) -> None:
    """Under uniform light, where lambda matters, and dots. (Planted: lambda doubled for one of them.)"""
    found = race(CAMERA, k, TRUTH, SENSOR, 0)
    assert found["iterations"] > 0 and found["iterative_s"] > 0 and found["direct_s"] > 0
    assert found["psnr_db"] > (12 if k == 1 else 30)


def test_iterations_that_do_not_arrive_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mitsim.studies.other_cameras._MOST_STEPS", 2)
    with pytest.raises(MitsimError, match=r"^iterations did not come to the direct solution at lambda [^\n]+$"):
        race(CAMERA, 3, TRUTH, SENSOR, 0)


def results(psfs: tuple[str, ...], dots_db: float = 41.0, direct_s: float = 0.3) -> Results:
    rows: list[dict[str, object]] = []
    for psf in psfs:
        for patterns, decibels in ((1, 22.0), (49, dots_db)):
            for exposure, more in ((EQUAL_PEAK, 15.0 * (patterns > 1)), (EQUAL_FRAME, 0.0)):
                row = {"part": "quality", "psf": psf, "patterns": patterns, "exposure": exposure}
                rows += [
                    {**row, "psnr_db": decibels + more, "point": "", "picture": name} for name in ("page", "coins")
                ]
        for patterns, seconds in ((1, 0.4), (25, direct_s), (49, direct_s)):
            row = {"part": "speed", "psf": psf, "patterns": patterns, "point": ""}
            rows.append({**row, "iterative_s": 4.0, "direct_s": seconds, "separable_s": 0.2})
    return Results(rows)  # type: ignore[arg-type]


@pytest.mark.parametrize("psfs", [("rendered",), ("measured", "rendered")])
def test_claims_of_invented_results(psfs: tuple[str, ...]) -> None:
    """Dots within the paper's figures at equal frame alone; uniform light, which is no dots, does not count against the
    direct solver. (Planted: uniform light counted; either exposure enough.)"""
    uniform, dots, slower, direct = STUDY.judge(results(psfs))
    assert uniform.verdict == "confirmed" and dots.verdict == "confirmed only at equal frame"
    assert slower.verdict == direct.verdict == "confirmed"
    assert direct.rendered == "13 times as long"
    assert bool(direct.idealised) == (len(psfs) == 2) and "-D psf=FILE" in STUDY.note


def test_a_slow_direct_solver_and_dim_dots_are_told() -> None:
    _, dots, _, direct = STUDY.judge(results(("rendered",), dots_db=30.0, direct_s=0.5))
    assert direct.verdict == "not confirmed" and dots.verdict == "confirmed only at equal peak"
    assert STUDY.judge(results(("rendered",), dots_db=50.0))[1].verdict == "not confirmed"


def test_a_measured_point_spread_function_is_a_parameter_of_the_study_alone() -> None:
    """No scene is given it, or Mitsuba would refuse it."""
    points = STUDY.points(Scope(Setup(parameters=(("psf", "psf.tif"), ("sheet_z", "400"))), ("page",), quick=True))
    assert {point.setup.parameters for point in points} == {(("sheet_z", "400"),)}
    assert {(point["psf"], point["file"]) for point in points} == {("measured", "psf.tif"), ("rendered", None)}


def test_a_rendered_point_spread_function_has_a_sum_of_one(variant: str) -> None:
    psf = rendered_psf((30, 40), 0.234, variant, rays=256)
    assert psf.shape == (30, 40) and psf.sum() == pytest.approx(1) and psf.min() >= 0
    assert psf.max() > 5 * psf.mean(), "caustics"
