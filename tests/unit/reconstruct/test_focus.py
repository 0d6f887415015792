"""Factors of another depth, and the depth itself, held against the closed-form shadow of an ideal camera at that depth.

Nothing here is rendered: the camera is that of tests/ideal_sessions.py with a projector 25 mm above and 60 mm beside
it, whose light at depth z lies 1/z - 1/400 times that beside where the calibration saw it, and shades the sensor by
the mask's shadow from there. That also the sensor's own width makes parallax is in that closed form.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mitsim.core.configuration import validate
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.manifests import Parallax
from mitsim.core.runs import Capture
from mitsim.devices.camera import centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.reconstruct.depth import ColumnSpline, Depth, FactorOfDepths, best_depth, move_factors
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.misfit import Cause
from mitsim.reconstruct.reconstruct import Reconstruction, reconstruct
from tests.ideal_sessions import PEAK, PITCH, PIXELS, Bench, picture
from tests.shadow_factor import scene_factor
from tests.unit.reconstruct.test_faults import dark, with_frames

N = 40
"""Projector pixels a side of images: each 15 um in the mask's plane, a quarter of a feature."""
FINE = 128
"""The same of the paper's projector: 5 um."""
COARSE = 64
"""The same for depths beside each other, whose search takes a second: 9 um."""
DIM = PEAK / 100
"""Electrons of the brightest pixel where noise hides which of two depths is right."""
BASELINE = 25.0, -60.0
WINDOW = 0.3
_ENDS, _PLACES = (-WINDOW / 2, WINDOW / 2), {"row_mm": (BASELINE[0],) * 2, "column_mm": (BASELINE[1],) * 2}
_DEPTHS = {"depth_mm": 400.0, "pixel_pitch_mm": PITCH, "mask_distance_mm": 2.0}
PARALLAX = Parallax(row_tan=_ENDS, column_tan=_ENDS, **_PLACES, **_DEPTHS)


def shadow(depth: float, axis: int, n: int = N, baseline: tuple[float, float] = BASELINE) -> np.ndarray:
    """(PIXELS, n) closed-form factor of a plane at ``depth``."""
    edges = centred_edges(n, WINDOW / n) + baseline[axis] * (1 / depth - 1 / 400)
    return scene_factor(mls_mask().terms[0][1], 0.06, centred_edges(PIXELS, PITCH), depth * edges, 2.0, depth)


def camera(depth: float = 400.0) -> Bench:
    return Bench(shadow(depth, 0), shadow(depth, 1))


def calibrated(seed: int = 0) -> Factors:
    factors = camera().calibrated(seed)
    return replace(factors, manifest=factors.manifest.model_copy(update={"parallax": PARALLAX}))


def shots(depth: float, patterns: str = "dots:4") -> Capture:
    return camera(depth).run(patterns, picture(n=N), 0)


def psnr(image: Reconstruction) -> float:
    return -10 * float(np.log10(np.mean(np.square(image.image - picture(n=N)))))


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("depth", [330.0, 398.0, 520.0])
@pytest.mark.parametrize(("n", "limit"), [(FINE, 3e-4), (N, 1.6e-3)])
def test_moved_columns_are_those_of_the_depth(depth: float, axis: int, n: int, limit: float) -> None:
    """Within 0.03 % of columns of 5 um, and 0.16 % of 15: each row is given its neighbours' places between its own.
    Unmoved ones are 2 to 100 % off."""
    factor, truth = shadow(400.0, axis, n), shadow(depth, axis, n)
    found, known = FactorOfDepths(factor, PARALLAX, axis).at(1 / depth - 1 / 400)

    def error(columns: np.ndarray) -> float:
        return float(np.linalg.norm((columns - truth)[known]) / np.linalg.norm(truth[known]))

    assert error(found) < limit and error(found) < error(factor) / 5
    # Light leaves the window by less than 0.04 rad, 80 um in the mask's plane: four sensor pixels, and one for margin.
    assert 0 < PIXELS - (known.stop - known.start) <= 6


@pytest.mark.parametrize("depth", [360.0, 440.0])
def test_columns_of_a_region_of_tall_pixels_are_those_of_the_depth(depth: float) -> None:
    """As above; 120 pixels of 1.5 pitches, 0.9 mm off the axis, from which all parallax is 0.9 mm less. (Planted: the
    pixels' width for their height.)"""
    middle, tall = 0.9, 1.5 * PITCH

    def region(depth: float) -> np.ndarray:
        edges = depth * (centred_edges(FINE, WINDOW / FINE) + BASELINE[0] * (1 / depth - 1 / 400))
        return scene_factor(mls_mask().terms[0][1], 0.06, middle + centred_edges(120, tall), edges, 2.0, depth)

    seen = PARALLAX.model_copy(update={"row_mm": (BASELINE[0] - middle,) * 2, "row_pitch_mm": tall})
    factor, truth = region(400.0), region(depth)
    found, known = FactorOfDepths(factor, seen, 0).at(1 / depth - 1 / 400)
    assert np.linalg.norm((found - truth)[known]) < 0.008 * np.linalg.norm(truth[known])
    assert known.stop - known.start >= 115


@pytest.mark.parametrize("axis", [0, 1])
def test_each_pixel_keeps_its_own_brightness(axis: int) -> None:
    """Seen from its own column, not from that which lends the shadow. (Planted: brightness moves with the shadow, 1.7 %
    at the window's edges; half of the falloff.)"""
    across = np.linspace(-1, 1, FINE)
    falloff = 1 - 0.05 * across**2 + 0.04 * across
    noise = np.random.default_rng(axis).normal(0, 2e-3, (PIXELS, FINE))
    side = FactorOfDepths(shadow(400.0, axis, FINE) * falloff + noise, PARALLAX, axis)
    reported = side.brightness(np.arange(FINE))
    np.testing.assert_allclose(reported / reported.mean() * falloff.mean(), falloff, rtol=2e-3)
    found, known = side.at(1 / 360 - 1 / 400)
    truth = (shadow(360.0, axis, FINE) * falloff)[known]
    gain = (found[known] * truth).sum(axis=0) / np.square(truth).sum(axis=0)
    assert gain == pytest.approx(1.0, abs=4e-3)


def test_without_a_baseline_both_sides_of_the_sensor_are_alike() -> None:
    """Only the place on the sensor moves columns then, from its middle. (Planted: half a sensor pixel off it.)"""
    shared = PARALLAX.model_copy(update={"row_mm": (0.0, 0.0)})
    factor = np.random.default_rng(3).random((PIXELS, N))
    found, known = FactorOfDepths(factor, shared, 0).at(1 / 360 - 1 / 400)
    turned, same = FactorOfDepths(factor[::-1, ::-1], shared, 0).at(1 / 360 - 1 / 400)
    assert (known.start, known.stop) == (PIXELS - same.stop, PIXELS - same.start)
    np.testing.assert_allclose(turned[::-1, ::-1][known], found[known], rtol=1e-9)


def test_the_calibrated_depth_has_the_calibrations_own_factors() -> None:
    factors = calibrated()
    there = move_factors(factors, 400.0)
    assert np.array_equal(there.factors.left, factors.left) and np.array_equal(there.factors.right, factors.right)
    frames, own = shots(400.0), there.of(shots(400.0))
    for a, b in zip(frames.pattern_measurements(), own.pattern_measurements(), strict=True):
        assert np.array_equal(a.frame, b.frame)
    assert np.array_equal(reconstruct(frames, factors, focus=400.0).image, reconstruct(frames, factors).image)


@pytest.mark.parametrize("depth", [360.0, 440.0])
def test_a_plane_off_the_calibrated_distance_comes_into_focus(depth: float) -> None:
    """Within 3 dB of a calibration at its own depth, whether the depth is given or found, and found within 1 mm."""
    frames, factors = shots(depth), calibrated()
    plain, given, found = (reconstruct(frames, factors, focus=focus) for focus in (None, depth, "auto"))
    own = reconstruct(frames, camera(depth).calibrated(0))
    assert psnr(plain) < 20 and plain.misfit and plain.misfit.flagged and "--focus auto" in str(plain.status)
    assert psnr(given) > psnr(own) - 3 and psnr(found) > psnr(own) - 3
    assert plain.focus is None and plain.summary()["focus_mm"] is None
    assert given.focus.mm == given.summary()["focus_mm"] == depth
    assert abs(found.focus.mm - depth) < 1 and found.focus.error_mm < 1
    assert not found.focus.doubt and f"focus: {found.focus.mm:.6g}" in str(found.focus)
    assert found.inputs["focus"] == "auto" and "focus" not in plain.inputs


def test_a_depth_that_is_not_told_is_flagged(fine: Factors) -> None:
    """Uniform light takes a moved image for an image; and of a sheet nearer than all that is tried the end is found."""
    uniform = reconstruct(beside(480.0, "uniform"), fine, 1e-3, focus="auto")
    assert not uniform.ok and "hardly determine depth" in str(uniform.status)
    near = reconstruct(shots(290.0), calibrated(), focus="auto")
    assert not near.ok and "End of range" in str(near.status) and "320 to 533 mm" in str(near.status)


BESIDE = PARALLAX.model_copy(update={"row_mm": (0.0, 0.0)})
"""The projector beside the camera, so that dots a period apart lie on one line."""


def beside(depth: float, patterns: str, peak: float = PEAK, dark: int = 0) -> Capture:
    """The window's first and last ``dark`` columns show nothing."""
    left, right = (shadow(depth, axis, COARSE, (0.0, BASELINE[1])) for axis in (0, 1))
    scene = picture(n=COARSE)
    scene[:, :dark], scene[:, COARSE - dark :] = 0.0, 0.0
    return Bench(left, right, peak=peak).run(patterns, scene, 0)


@pytest.fixture(scope="module")
def fine() -> Factors:
    factors = Bench(*(shadow(400.0, axis, COARSE) for axis in (0, 1))).calibrated(0, error=1e-3)
    return replace(factors, manifest=factors.manifest.model_copy(update={"parallax": BESIDE}))


@pytest.mark.parametrize(("depth", "patterns"), [(480.0, "dots:4"), (450.0, "dots:7"), (353.0, "dots:5")])
def test_a_depth_is_not_taken_for_one_a_period_away(fine: Factors, depth: float, patterns: str) -> None:
    """Without an edge in view. Depths are tried a pixel of parallax apart, and the valley of another may lie nearer to
    one of them. (Planted: the valley of the best depth that was tried is followed alone.)"""
    found = best_depth(beside(depth, patterns, dark=8), fine, (240.0, 900.0))
    assert not found.doubt and not found.alternatives and abs(found.mm - depth) < 2 * found.error_mm < 0.5


def test_two_depths_that_explain_as_much_are_named(fine: Factors) -> None:
    """In dim light and without an edge in view, until a range excludes one. (Planted: one valley followed; chance left
    out; an error without the choice; the range ignored.)"""
    dim, other = beside(480.0, "dots:4", DIM, dark=8), 1 / (1 / 480 + 4 * WINDOW / COARSE / 60)
    image = reconstruct(dim, fine, focus="auto")
    depth = image.focus
    assert isinstance(depth, Depth) and not image.ok and "whole periods of the dots" in str(image.status)
    named = sorted([depth.mm, *(each.mm for each in depth.alternatives)])
    assert any(abs(mm - 480) < 1 for mm in named) and any(abs(mm - other) < 1 for mm in named)
    assert depth.error_mm is not None and depth.error_mm >= max(abs(mm - depth.mm) for mm in named)
    summary = image.summary()
    assert summary["focus_alternatives"][0].keys() == {"mm", "difference"}
    assert summary["focus_range_mm"] == pytest.approx((320, 533.3), abs=0.1)
    known = best_depth(dim, fine, (460.0, 500.0))
    assert not known.doubt and not known.alternatives and abs(known.mm - 480) < 2 * known.error_mm
    assert known.range_mm == pytest.approx((460, 500))


@pytest.mark.parametrize("depth", [308.0, 556.0])
def test_a_depth_beyond_the_range_is_not_taken_for_one_within(fine: Factors, depth: float) -> None:
    """A period of the dots from 308 mm is a depth within the range, and from 556 an end of it. (Planted: nothing beyond
    an end is tried.)"""
    found = best_depth(beside(depth, "dots:4"), fine)
    assert "may lie outside" in found.doubt and "--depth-range" in found.doubt and not found.at_end
    assert abs(found.mm - depth) < 2 * found.error_mm < 0.6


@pytest.mark.parametrize("depth_range", [None, (400.0, 550.0)])
def test_faulty_frames_are_named_at_the_end_of_a_range(fine: Factors, depth_range: tuple[float, float] | None) -> None:
    """Beside it, not taken for depth."""
    run = with_frames(beside(556.0, "dots:4"), lambda frames: [*frames[:5], dark(frames[5]), *frames[6:]])
    image = reconstruct(run, fine, focus="auto", depth_range=depth_range)
    assert image.misfit and image.misfit.cause is Cause.FRAMES
    assert "frame 5" in str(image.status) and "may lie outside" in str(image.status)


@pytest.mark.parametrize("patterns", ["hadamard:4", "random:6"])
def test_other_patterns_tell_depth(fine: Factors, patterns: str, tmp_path: Path) -> None:
    """Without a period, so that none is named; of dots along columns alone all is tried beyond the range."""
    found = best_depth(beside(440.0, patterns), fine)
    assert not found.doubt and not found.alternatives and abs(found.mm - 440) < 2 * found.error_mm < 1
    row, column = np.indices((COARSE, COARSE))
    own = [(column % 4 == dot) & (row % step == 0) for step in (1, 2) for dot in range(4)]
    np.save(tmp_path / "own.npy", np.array(own, dtype=np.uint8) * 255)
    assert abs(best_depth(beside(720.0, str(tmp_path / "own.npy")), fine).mm - 720) < 2


def test_light_of_a_lamp_does_not_move_depth(fine: Factors) -> None:
    """A tenth of the light comes from all pixels in all shots, and is not called depth."""
    left, right = (shadow(440.0, axis, COARSE, (0.0, BASELINE[1])) for axis in (0, 1))
    lamp = left @ np.ones((COARSE, COARSE)) @ right.T
    lit = Bench(left, right, optics=lambda light: light + 0.1 * PEAK * lamp / lamp.max())
    image = reconstruct(lit.run("dots:5", picture(n=COARSE), 0), fine, focus="auto")
    assert isinstance(image.focus, Depth) and image.focus.error_mm is not None
    assert abs(image.focus.mm - 440) < 2 * image.focus.error_mm
    assert not image.ok and image.misfit and image.misfit.cause is Cause.MODEL


@pytest.mark.parametrize(
    ("depth_range", "focus", "fragment"),
    [
        ((450.0, 350.0), "auto", "smaller one first"),
        ((350.0,), "map", "two numbers"),
        ((350.0, 450.0), None, "focus auto, map or volume"),
        ((1.0, 450.0), "auto", "where the mask is"),
        ((60.0, 450.0), "auto", "nearer to the calibrated 400 mm"),
    ],
)
def test_a_range_that_is_none_is_refused(depth_range: object, focus: str | float | None, fragment: str) -> None:
    with pytest.raises(ArgumentError, match=fragment) as caught:
        reconstruct(shots(400.0), calibrated(), focus=focus, depth_range=depth_range)  # type: ignore[arg-type]
    assert caught.value.argument == "depth_range" and "\n" not in str(caught.value)


def test_the_field_stop_cuts_what_moves_beyond_it() -> None:
    """A stop at 0.16: at 330 mm light of the window's edge, 0.15 as calibrated, comes from 0.18. Columns are as bright
    in the mean as a board there would be, with their light on the part of the sensor that sees them. (Planted: no
    stop.)"""
    stopped = PARALLAX.model_copy(update={"stop_tan": 0.16})
    factor, shift = np.ones((PIXELS, FINE)), 1 / 330 - 1 / 400
    side = FactorOfDepths(factor, stopped, 1)
    found, hidden = side.at(shift)[0], side.hidden_part(shift)
    place = (np.arange(PIXELS) - (PIXELS - 1) / 2) * PITCH
    centre = (np.arange(FINE) + 0.5) * WINDOW / FINE - WINDOW / 2
    tangent = centre + BASELINE[1] * shift - place[:, None] / 330
    seen = np.clip((0.16 - np.abs(tangent)) / (WINDOW / FINE) + 0.5, 0, 1)
    np.testing.assert_allclose(hidden, 1 - seen.mean(axis=0), atol=1e-9)
    lit = hidden < 1
    np.testing.assert_allclose(found[:, lit], (seen / np.maximum(seen.mean(axis=0), 1e-9))[:, lit], atol=1e-6)
    assert not found[:, ~lit].any() and 0 < (hidden > 0.5).sum() < FINE / 4
    unstated = FactorOfDepths(factor, PARALLAX, 1)
    assert not unstated.hidden_part(shift).any() and not side.hidden_part(0.0).any()


def test_light_that_the_field_stop_hides_is_told() -> None:
    """(Planted: no stop; no flag.)"""
    factors = calibrated()
    stopped = PARALLAX.model_copy(update={"stop_tan": 0.16})
    factors = replace(factors, manifest=factors.manifest.model_copy(update={"parallax": stopped}))
    image = reconstruct(shots(395.0), factors)
    assert move_factors(factors, 395.0).hidden == 0 and "field stop" not in str(image.status)
    image = reconstruct(shots(340.0), factors, focus=340.0)
    assert not image.ok and "the field stop takes most of the light" in str(image.status)


def test_noise_of_moved_columns_is_stated() -> None:
    """Less than that of the calibrated ones, since each number is fitted to many; measured with another draw, 5 %.
    (Planted: that of the calibrated ones stated.)"""
    white = np.random.default_rng(7).standard_normal((PIXELS, N))
    side = FactorOfDepths(1000 + white, PARALLAX, 0)
    shift = 1 / 360 - 1 / 400
    found, known = side.at(shift)
    noise = float(np.std((found - 1000)[known]))
    assert side.noise(shift) == pytest.approx(noise, rel=0.1) and noise < 0.8
    moved, own = move_factors(calibrated(), 360.0).factors.manifest.noise, calibrated().manifest.noise
    assert moved.left == pytest.approx(own.left * side.noise(shift))


def test_the_ambient_frame_loses_the_same_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    there = move_factors(calibrated(), 360.0)
    ambient = SimpleNamespace(rate=np.arange(PIXELS**2.0).reshape(PIXELS, -1), variance=np.ones((PIXELS, PIXELS)))
    ambient.shots = 16
    monkeypatch.setattr(Capture, "ambient", ambient)
    part = there.of(shots(360.0)).ambient
    assert part.shots == 16 and part.rate.shape == part.variance.shape
    assert part.rate[0, 0] == ambient.rate[there.rows.start, there.columns.start]
    assert part.rate.shape == (len(there.factors.left), len(there.factors.right)) != (PIXELS, PIXELS)


@pytest.mark.parametrize(
    ("field", "value", "fragment"),
    [("row_tan", (0.1, 0.1), "increasing"), ("mask_distance_mm", 400.0, "below depth_mm"), ("column_mm", (1.0,), "2")],
)
def test_a_parallax_that_cannot_be_is_refused(field: str, value: object, fragment: str) -> None:
    with pytest.raises(MitsimError, match=fragment) as caught:
        validate(Parallax, {**PARALLAX.model_dump(), field: value}, "cal/manifest.json")
    assert "\n" not in str(caught.value)


def test_a_depth_without_factors_is_refused() -> None:
    frames = shots(400.0, "uniform")
    for depth, fragment in ((1.5, "where the mask is"), (40.0, "nearer to the calibrated 400 mm")):
        with pytest.raises(ArgumentError, match=fragment):
            reconstruct(frames, calibrated(), focus=depth)
    with pytest.raises(MitsimError, match="does not state its parallax"):
        reconstruct(frames, camera().calibrated(0), focus=380.0)
    small = replace(calibrated(), left=np.ones((PIXELS, 3)))
    with pytest.raises(MitsimError, match="3 x 40 projector pixels"):
        move_factors(small, 380.0)


@pytest.mark.parametrize("rows", [1, 2, 3, 5, 9])
def test_few_rows_are_each_given_those_there_are(rows: int) -> None:
    """A ramp is told exactly. (Planted: rows beyond the last.)"""
    ramp = np.arange(12.0) + 0.5 * np.arange(rows)[:, None]
    spline = ColumnSpline(ramp, 0.5)
    column = np.linspace(0, 11, 45)
    found = spline.at(np.repeat(np.arange(rows)[:, None], 45, axis=1), np.tile(column, (rows, 1)))
    np.testing.assert_allclose(found, column + 0.5 * np.arange(rows)[:, None], atol=1e-6)
