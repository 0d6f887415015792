"""Calibrations that went wrong say so, and their images carry it: few photons, full wells, keystone, twins.

The camera is numpy: geometric shadows of the anchor geometry on 64 pixels, a 16 x 16 projector, +-1 stripes as two
captures each, Poisson noise and a full well. Nothing of mitsim's renderer or sensor is in it, except in the one session
that is rendered to see its own full frames counted.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import hadamard

from mitsim.core.errors import MitsimError
from mitsim.core.exr import write_frame
from mitsim.devices.camera import centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.reconstruct.factors import LARGEST_ERROR, Estimate
from mitsim.reconstruct.reconstruct import Reconstruction
from mitsim.report.reconstruct_run import reconstruct
from tests.robustness import Recorder
from tests.shadow_factor import scene_factor
from tests.stripes import estimated

pytestmark = pytest.mark.robustness("Calibration")
N, PIXELS = 16, 64
H = hadamard(N).astype(float)


def shadow(distance_mm: float = 2.0, width_mm: float = 120.0, pixels: int = PIXELS, n: int = N) -> np.ndarray:
    """(pixels, n) geometric shadow of the anchor geometry with a scene of this width."""
    sensor, scene = centred_edges(pixels, 512 * 0.01172 / pixels), centred_edges(n, width_mm / n)
    return scene_factor(mls_mask().terms[0][1], 0.06, sensor, scene, distance_mm, 400.0)


class Camera:
    """A board seen through a mask: ``left`` (m, n), or (n, m, n) with one for every column of the projector."""

    def __init__(self, left: np.ndarray, right: np.ndarray) -> None:
        self.left, self.right = left, right

    @classmethod
    def keystoned(cls, share: float) -> Camera:
        """A turned projector: rows are spread by up to +-share/2 more at the left and right ends of its picture."""
        spread = 1 + share * (np.arange(N) - (N - 1) / 2) / (N - 1)
        return cls(np.stack([shadow(width_mm=120 * wide) for wide in spread]), shadow())

    def frame(self, light: np.ndarray) -> np.ndarray:
        if self.left.ndim == 2:
            return self.left @ light @ self.right.T
        columns = zip(self.left, light.T, self.right.T, strict=True)
        return sum(np.outer(left @ column, right) for left, column, right in columns)

    @property
    def peak(self) -> float:
        return float(self.frame(np.ones((N, N))).max())

    def calibrate(
        self, electrons: float | None = None, full_well: float = np.inf, seed: int = 0, stated: bool = True
    ) -> Estimate:
        """A session whose brightest pixel holds ``electrons`` (None: no noise); ``full_well`` in the same share."""
        rng = np.random.default_rng(seed)
        gain = electrons / self.peak if electrons else 1.0

        def shot(light: np.ndarray) -> np.ndarray:
            expected = gain * self.frame(light)
            counts = rng.poisson(expected) if electrons else expected
            return np.minimum(counts, full_well * gain * self.peak) / gain

        def signed(pattern: np.ndarray) -> np.ndarray:
            return shot((1 + pattern) / 2) - shot((1 - pattern) / 2)

        one = np.ones(N)
        noise = float(np.sqrt(self.frame(np.ones((N, N))).mean() / gain)) if electrons else 0.0
        return estimated(
            [signed(np.outer(h, one)) for h in H.T],
            [signed(np.outer(one, h)) for h in H.T],
            H,
            noise=noise if stated else None,
        )


def error_of(found: Estimate, left: np.ndarray, right: np.ndarray) -> float:
    """Larger relative error of the two factors, scales balanced as the estimate's."""
    scale = np.sqrt(np.linalg.norm(right.sum(axis=1)) / np.linalg.norm(left.sum(axis=1)))
    pairs = (found.left, left * scale), (found.right, right / scale)
    return max(float(np.linalg.norm(one - two) / np.linalg.norm(two)) for one, two in pairs)


# ---- the estimate ----------------------------------------------------------------------------------------------------


@settings(max_examples=12, deadline=None, derandomize=True)
@given(power=st.floats(-3, 8), seed=st.integers(0, 999))
def test_few_photons(measured: Recorder, power: float, seed: int) -> None:
    """0.001 to 1e8 electrons in the brightest pixel: finite or refused; ok only where the factors are good.

    2048 numbers tell the size of their noise to 2 %, but it is larger where light is, so 30 % is allowed between the
    error and its prediction. Where nothing arrives at all, the uniform response is zero and that is refused.
    """
    factor = shadow()
    camera = Camera(factor, factor)
    try:
        found = camera.calibrate(10.0**power, seed=seed)
    except MitsimError as refusal:
        assert power < 0 and "zero everywhere" in str(refusal)
        return
    error = error_of(found, factor, factor)
    assert np.isfinite([*found.left.ravel(), *found.right.ravel(), found.separability_residual]).all()
    if found.ok:
        assert error < 1.3 * LARGEST_ERROR and min(found.rank) > 0
    if error < 0.5:
        measured(abs(error / max(found.predicted_error) - 1), at_most=0.3, what="of the prediction")
    if power < 1:
        assert not found.ok and error > LARGEST_ERROR
    if power > 7:
        assert found.ok
    assert str(found.status).endswith(
        f"Factor error {found.predicted_error[0]:.1e} and {found.predicted_error[1]:.1e}, "
        f"rank {found.rank[0]} of {N} and {found.rank[1]} of {N}, condition {found.condition:.1e}."
    )


def test_responses_that_cancel_leave_no_factor() -> None:
    """Uniform light alone arrives: the right factor is zero, its error infinite and its rank 0."""
    uniform = np.ones((PIXELS, PIXELS))
    with np.errstate(all="raise"):
        found = estimated([uniform] + [uniform * 0] * (N - 1), [uniform * 0] * N, H)
    assert found.predicted_error[1] == np.inf and found.rank[1] == 0 and not found.ok


def test_full_wells_show_in_the_residual(measured: Recorder) -> None:
    """A full well at 1.2 to 0.3 of the brightest pixel: clipped light is not separable.

    At 0.95 only the uniform frame is cut and the residual is small: it is the session that counts such frames (below).
    From 0.7 of the peak on the residual itself flags.
    """
    camera = Camera(shadow(), shadow())
    found = [camera.calibrate(full_well=share) for share in (1.2, 0.95, 0.7, 0.5, 0.4, 0.3)]
    residuals = [calibration.separability_residual for calibration in found]
    assert residuals[0] < 1e-14 and (np.diff(residuals) > 0).all()
    assert [calibration.ok for calibration in found[:2]] == [True, True]
    for share, calibration in zip((0.7, 0.5, 0.4, 0.3), found[2:], strict=True):
        measured(100 * calibration.separability_residual, what=f"residual at {share} of the peak", unit="%")
        assert not calibration.ok and str(calibration.status).startswith("Responses are not separable")


def test_keystone_shows_in_the_residual(measured: Recorder) -> None:
    """A projector turned ever further: residual zero without, proportional to the turn while it is small, then flagged.

    With noise the residual is larger, and what noise does not explain is the same: it is found at 1e5 electrons too.
    """
    shares = (0.0, 1e-4, 1e-3, 1e-2, 0.1, 0.3)
    found = [Camera.keystoned(share).calibrate() for share in shares]
    residuals = [calibration.separability_residual for calibration in found]
    assert residuals[0] < 1e-14 and found[0].ok
    measured(abs(residuals[2] / residuals[1] / 10 - 1), at_most=0.05, what="from proportional")
    measured(100 * residuals[3], what="residual, keystone of 1e-2", unit="%")
    measured(100 * residuals[4], what="residual, keystone of 0.1", unit="%")
    assert (np.diff(residuals) > 0).all()
    assert [calibration.ok for calibration in found] == [True] * 4 + [False] * 2
    assert "not separable: 1.5%" in str(found[4].status) and "rotated part" in str(found[4].status)
    noisy = Camera.keystoned(0.1).calibrate(1e5)
    assert noisy.unexplained == pytest.approx(residuals[4], rel=0.2) and not noisy.ok
    assert noisy.separability_residual > 1.2 * noisy.unexplained
    assert Camera.keystoned(0.0).calibrate(1e5).unexplained < 0.5 * noisy.unexplained


@settings(max_examples=12, deadline=None, derandomize=True)
@given(twins=st.sets(st.integers(1, 6), max_size=4), dark=st.booleans(), noisy=st.booleans(), seed=st.integers(0, 99))
def test_rank_deficient_factors(twins: set[int], dark: bool, noisy: bool, seed: int) -> None:
    """Equal and dark columns are counted, with noise (which makes every matrix invertible) as without."""
    left, right = shadow(), shadow()
    for column in twins:
        left[:, column] = left[:, 0]
    right[:, 3] *= not dark
    found = Camera(left, right).calibrate(1e9 if noisy else None, seed=seed)
    assert found.rank == (N - len(twins), N - dark)
    assert found.ok == (not dark)
    words = f"rank deficient: 0 scene rows and {dark:d}" if dark else f"leaves {len(twins)} directions of scene rows"
    assert (words in str(found.status)) == bool(dark or twins)
    assert np.isfinite(found.condition) == (noisy or not (twins or dark))


def test_a_dark_column_is_found_in_any_noise() -> None:
    """The limit of noise has room for pixels of unequal noise: with three deviations 5 % of dark columns are missed."""
    dark = shadow()
    dark[:, 3] = 0
    assert not any(Camera(shadow(), dark).calibrate(1e9, seed=seed).ok for seed in range(60))


def test_a_mask_that_is_too_close(measured: Recorder) -> None:
    """20 um to 2 mm: a close mask cannot tell scene rows apart, and the status says how many it can."""
    found = [Camera(*[shadow(distance)] * 2).calibrate(1e9) for distance in (0.02, 0.1, 0.5, 2.0)]
    ranks = [calibration.rank[0] for calibration in found]
    for distance, rank in zip((0.02, 0.1, 0.5, 2.0), ranks, strict=True):
        measured(rank, what=f"rank of {N} at {distance} mm")
    assert ranks == sorted(ranks) and ranks[0] < N and ranks[-1] == N
    assert ["uniform light alone" in str(calibration.status) for calibration in found] == [rank < N for rank in ranks]


# ---- the folders -----------------------------------------------------------------------------------------------------

DIGITAL = {"exposure_s": 1.0, "black_level_dn": 0, "gain_dn_per_e": 1.0, "dark_current_e_per_s": 0}


@pytest.fixture
def bench(tmp_path: Path) -> Callable[..., tuple[Path, Path]]:
    """Writes a RUN of one frame and a CAL by hand; ``factor`` replaces the right one, the rest goes into manifests."""

    def write(
        factor: np.ndarray | None = None, capture: tuple[str, ...] = (), calibration: tuple[str, ...] = ()
    ) -> tuple[Path, Path]:
        run, cal = tmp_path / "run", tmp_path / "cal"
        left = 100 * shadow(n=8)
        scene = np.random.default_rng(0).random((8, 8))
        for folder in (run, cal):
            folder.mkdir()
        write_frame(run / "a.exr", {"DN": (left @ scene @ left.T).astype(np.float32)}, {})
        for name, values in (("left", left), ("right", left if factor is None else factor)):
            write_frame(cal / f"{name}.exr", {"factor": values.astype(np.float32)}, {})
        common = {"status": "complete", "camera": {"name": "bench 4"}}
        shots = [{"file": "a.exr", "row": 0, "column": 0, "sign": 0}]
        patterns = {"P_L": [[1]] * 8, "P_R": [[1]] * 8, "captures": shots}
        for folder, manifest in (
            (run, {"kind": "capture", "digital": DIGITAL, "patterns": patterns, "warnings": capture}),
            (cal, {"kind": "calibration", "warnings": calibration}),
        ):
            (folder / "manifest.json").write_text(json.dumps(common | manifest))
        return run, cal

    return write


def image_of(run: Path, cal: Path) -> Reconstruction:
    return reconstruct(run, cal, run / "image", lam=0.0).reconstruction


def test_flags_of_folders_reach_the_image(bench: Callable[..., tuple[Path, Path]]) -> None:
    """A capture or calibration that was flagged flags its image, in the status and in result.json."""
    run, cal = bench(capture=("3 frames have pixels at the full well",), calibration=("Factors are noise.", "b"))
    found = image_of(run, cal)
    assert not found.ok and found.rank == 64
    for sentence in (
        "In the capture, 3 frames have pixels at the full well",
        "In the calibration, factors are noise",
        "In the calibration, b",
    ):
        assert sentence in str(found.status)
    assert str(found.status).startswith("Solved: ") and "Rank 64 of 64" in str(found.status)
    assert json.loads((run / "image" / "result.json").read_text())["status"] == str(found.status)


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (np.full((64, 8), 1e35), "1.0e\\+35; allowed are"),
        (np.full((64, 8), 1e-35), "1.0e-35; allowed are"),
        (np.zeros((64, 8)), "all zero"),
        (np.full((64, 8), np.nan), "not finite"),
        (np.full((64, 8), np.inf), "not finite"),
        (np.ones((63, 8)), "calibration's are 64x63"),
        (np.ones((64, 7)), "has 8 scene pixels"),
    ],
    ids=["huge", "tiny", "zero", "nan", "infinite", "short", "narrow"],
)
def test_absurd_factors_are_refused(bench: Callable[..., tuple[Path, Path]], factor: np.ndarray, words: str) -> None:
    """In one line, and no folder is left behind."""
    run, cal = bench(factor)
    with pytest.raises(MitsimError, match=words) as caught:
        image_of(run, cal)
    assert "\n" not in str(caught.value) and not (run / "image").exists()


def test_a_saturated_session_is_flagged(
    small_scene: Callable[..., Path], variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rendered: an ADC of 8 bits ends at 6 % of the full well; the folder says how many frames reached it.

    (That no frame is counted without cause: tests/unit/calibrate/test_session.py::test_the_folder.)
    """
    from mitsim.api.bench import open_bench
    from mitsim.bench.effects import EFFECTS
    from mitsim.planner.planner import make_plan

    def simple_plan(*arguments: object) -> object:
        return make_plan(*arguments, switches=dict.fromkeys(EFFECTS, False))

    monkeypatch.setattr("mitsim.calibrate.board_session.make_plan", simple_plan)
    camera = tmp_path / "camera.toml"
    camera.write_text(
        'name = "short"\npixel_pitch_um = 5.86\nbinning = 2\nfull_well_e = 32360.0\nread_noise_e = 6.7\n'
        'quantum_efficiency = 0.75\ngain_dn_per_e = 0.125\nbits = 8\nsource = "made for a test"\n'
    )
    bench = open_bench(small_scene(n=8), variant, camera=camera)
    found = bench.calibrate(accuracy=2e-2, output=tmp_path / "cal")
    [reported] = [warning for warning in found.warnings if "full well or the ADC's end" in warning]
    assert reported.startswith("saturation: 30 of 32 frames") and not found.ok
    manifest = json.loads((tmp_path / "cal" / "manifest.json").read_text())
    assert tuple(manifest["warnings"]) == found.warnings and manifest["estimate"] == str(found.status)
