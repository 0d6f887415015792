"""A depth for each projector pixel, held against scenes of several depths in closed form (tests/ideal_sessions.py).

The camera is that of test_focus.py: 40 x 40 pixels of 3 mm at 400 mm, the projector beside it along the columns alone
or above it, too. At 370 mm light lies 1.6 pixels beside where it was calibrated, at 430 mm 1.4 on the other side.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest

from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.runs import Capture, Measurement
from mitsim.devices.patterns import parse_patterns
from mitsim.reconstruct.accumulation import DerivedCapture, accumulate
from mitsim.reconstruct.depth import Arrivals, Depth, PixelDepths, best_depth, depth_map
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.misfit import Cause
from mitsim.reconstruct.reconstruct import Reconstruction, depth_misfit, reconstruct
from tests.ideal_sessions import PEAK, Bench, picture
from tests.ideal_sessions import shadow as plain_shadow
from tests.unit.reconstruct.test_faults import with_frames
from tests.unit.reconstruct.test_focus import BASELINE, PARALLAX, N, shadow

BESIDE = (0.0, BASELINE[1])
"""Baseline [mm] along the columns alone."""
PRINT = picture(n=N)


@dataclass(frozen=True, kw_only=True)
class Layers(Bench):
    """Surfaces at several depths: which pixels (n, n) are of each, and its factors."""

    surfaces: tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...]

    def light(self, shown: np.ndarray) -> np.ndarray:
        return np.asarray(sum(left @ (shown * where) @ right.T for where, left, right in self.surfaces))


def sides(depth: float, baseline: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    return shadow(depth, 0, baseline=baseline), shadow(depth, 1, baseline=baseline)


def shots(depths: np.ndarray, patterns: str, baseline: tuple[float, float] = BESIDE) -> Capture:
    """Of surfaces at ``depths`` (n, n)."""
    parts = tuple((depths == depth, *sides(depth, baseline)) for depth in np.unique(depths))
    return Layers(*sides(400.0, baseline), surfaces=parts).run(patterns, PRINT, 0)


def calibrated(baseline: tuple[float, float] = BESIDE) -> Factors:
    factors = Bench(*sides(400.0, baseline)).calibrated(0)
    parallax = PARALLAX.model_copy(update={"row_mm": (baseline[0],) * 2, "column_mm": (baseline[1],) * 2})
    return replace(factors, manifest=factors.manifest.model_copy(update={"parallax": parallax}))


def cards() -> np.ndarray:
    """A board at 430 mm, before it a card at 370."""
    depths = np.full((N, N), 430.0)
    depths[10:30, 8:26] = 370.0
    return depths


@cache
def mapped_cards(
    patterns: str = "dots:4x8", baseline: tuple[float, float] = BESIDE
) -> tuple[Capture, Factors, Reconstruction]:
    """Return frames and factors of the cards, and their image with a depth for each pixel."""
    run, factors = shots(cards(), patterns, baseline), calibrated(baseline)
    return run, factors, reconstruct(run, factors, focus="map")


def psnr(image: np.ndarray) -> float:
    return -10 * float(np.log10(np.mean(np.square(image - PRINT))))


def test_a_card_before_a_board() -> None:
    """Both depths are found, beside the projector alone and above it, too; the images have some 2 dB less than were
    found, and more than a cubic between columns gave at the true depths (40.4 and 41.1 dB). The true depths give 51.5
    and 57.0 now: what is left to them are pixels beside the card's edges. (Planted: light looked for on the other side;
    the step's sign; edges left as pooled, 12 dB.)"""
    for (run, factors, image), least in ((mapped_cards(), 47.0), (mapped_cards("dots:8", BASELINE), 48.0)):
        found, one = image.depths, reconstruct(run, factors)
        error = np.abs(found.mm - cards())
        assert not found.doubt and np.median(error) < 2 and (error < 5).mean() > 0.95
        assert psnr(found.image) > least and psnr(found.image) > psnr(one.image) + 20
        assert found.reliable.mean() > 0.9


def test_the_lambda_that_explains_most_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    """A lambda that blurs all dots must not decide, first or last of those tried. (Seen: one lambda for all scenes,
    under which cookie_bag had no depths. Planted: the first alone; the last alone.)"""
    monkeypatch.setattr(import_module("mitsim.reconstruct.depth"), "_LAMBDAS", (1e2, 1e-5, 1e2))
    run, factors, _ = mapped_cards()
    found = depth_map(run, factors)
    assert not found.doubt and psnr(found.image) > 44


@pytest.mark.parametrize(("patterns", "near", "far"), [("hadamard:2", 1.0, -1.0), ("hadamard:4", 2.5, -2.0)])
def test_no_frame_is_blamed_for_two_depths(patterns: str, near: float, far: float) -> None:
    """Surfaces that move light by pixels [of the scene]: patterns of half that period turn their sign, as halves that
    are exchanged do."""
    where = np.zeros((16, 16), dtype=np.bool_)
    where[4:12, 3:10] = True
    surfaces = tuple((part, plain_shadow(), plain_shadow(by)) for part, by in ((where, near), (~where, far)))
    scene = Layers(plain_shadow(), plain_shadow(), surfaces=surfaces)
    misfit = reconstruct(scene.run(patterns, picture(2), 2), Bench(plain_shadow(), plain_shadow()).calibrated(2)).misfit
    assert misfit.flagged and not misfit.faults and misfit.cause is not Cause.FRAMES


def test_one_depth_of_several_is_flagged() -> None:
    """One depth between those of the scene is found, and what it leaves is called depth; one for each pixel leaves a
    third of it."""
    depths, (run, factors, each) = cards(), mapped_cards()
    one = reconstruct(run, factors, focus="auto")
    assert isinstance(one.focus, Depth) and depths.min() - 1 < one.focus.mm < depths.max() + 1
    assert not one.ok and one.misfit and one.misfit.cause in (Cause.MODEL, Cause.PIXELS)
    assert each.misfit.unexplained < one.misfit.unexplained / 3 and psnr(each.image) > psnr(one.image) + 3


def test_frames_at_fault_are_named() -> None:
    """Exchanged, of two depths, against the factors of one."""
    run, factors, _ = mapped_cards()
    found = reconstruct(with_frames(run, lambda f: [*f[:2], f[6], *f[3:6], f[2], *f[7:]]), factors, focus="map")
    assert not found.ok and found.misfit.cause is Cause.FRAMES
    named = {number for reported in found.misfit.faults for number in reported.numbers}
    assert named >= {2, 6} and len(named) < 5


def test_a_flat_sheet_has_one_depth() -> None:
    """And the image that its own depth gives, less 1.5 dB: twice as many unknowns. At 360 mm light lies half a period
    of 4 beside. (Planted: depths looked for about the calibrated one alone; a part of the sensor left out that knows
    the depths, 2.3 dB.)"""
    depth = 360.0
    run, factors = shots(np.full((N, N), depth), "dots:4"), calibrated()
    image, given = reconstruct(run, factors, focus="map"), reconstruct(run, factors, focus=depth)
    assert np.abs(image.depths.mm - depth).max() < 6
    assert np.median(np.abs(image.depths.mm - depth)) < 1
    assert psnr(image.image) > psnr(given.image) - 1.5
    assert image.misfit.chi_square == pytest.approx(given.misfit.chi_square, rel=0.1)
    assert image.uncertainties is None


@pytest.mark.parametrize(("near", "far", "patterns"), [(330.0, 500.0, "dots:4x5"), (370.0, 430.0, "dots:4")])
def test_parallax_beyond_the_period_is_told_and_the_image_is_as_before(near: float, far: float, patterns: str) -> None:
    """Parallax of 8.2 pixels under dots 5 apart, of 3 under 4 and of 6.2 under 8. (Planted: nothing spared; no
    rivals.)"""
    run, factors = shots(np.where(cards() < 400, near, far), patterns), calibrated()
    image, before = reconstruct(run, factors, focus="map"), reconstruct(run, factors)
    assert "off by a whole period" in str(image.status) and "Use dots of a period of" in str(image.status)
    assert not image.ok and image.depths is None and np.array_equal(image.image, before.image)
    assert image.summary()["depths"] is None and "no depth could be estimated" in str(image.focus)


def flat(depth: float, patterns: str, peak: float = PEAK, dark: int = 0) -> Capture:
    """A sheet; the window's first and last ``dark`` columns show nothing."""
    scene = PRINT.copy()
    scene[:, :dark], scene[:, N - dark :] = 0.0, 0.0
    surfaces = ((np.ones((N, N), bool), *sides(depth, BESIDE)),)
    return Layers(*sides(400.0, BESIDE), surfaces=surfaces, peak=peak).run(patterns, scene, 0)


@pytest.mark.parametrize(
    ("peak", "depth_range", "named"),
    [(PEAK, None, False), (PEAK / 400, None, True), (PEAK / 400, (350.0, 467.0), False)],
)
def test_depths_may_all_be_a_period_away(peak: float, depth_range: tuple[float, float] | None, named: bool) -> None:
    """The true depth and those a period away differ by less than chance where the light is dim and no edge in view,
    unless the range has no others; a bright sheet at the calibrated depth is not doubted, though depths by pixel leave
    no less. (Planted: the plane's alternatives left out; no chance left to the calibrated depth.)"""
    image = reconstruct(flat(400.0, "dots:8x5", peak, 8), calibrated(), focus="map", depth_range=depth_range)
    assert image.ok == (not named) and ("400.0 or 533." in str(image.status)) == named
    assert (image.depths is None) == named


def test_a_range_may_be_narrower_than_the_period() -> None:
    """Of a pixel of parallax; a sheet beside it is flagged. (Planted: two pixels spared as if the dots' period were
    the limit.)"""
    factors = calibrated()
    inside = reconstruct(flat(380.0, "dots:4"), factors, focus="map", depth_range=(370.0, 390.0))
    assert inside.ok and np.median(np.abs(inside.depths.mm - 380)) < 1
    assert inside.summary()["focus_range_mm"] == pytest.approx((370, 390))
    assert not reconstruct(flat(380.0, "dots:4"), factors, focus="map", depth_range=(390.0, 440.0)).ok


def test_dark_pixels_have_no_confidence() -> None:
    dark = np.where(np.arange(N) < 12, 0.0, 1.0)
    bench = Layers(*sides(400.0, BESIDE), surfaces=((dark * np.ones((N, 1)), *sides(380.0, BESIDE)),))
    found = depth_map(bench.run("dots:4x8", PRINT, 0), calibrated())
    assert np.median(found.confidence[:, :8]) < 0.5 < np.quantile(found.confidence[:, 16:], 0.1)


def test_misfit_leaves_noise_and_print_to_the_scene() -> None:
    """Half of what is left beyond the noise may be print: 0.7 of the unexplained part stays, and none if all is.
    (Planted: the sensor's part over the print's energy.)"""
    run, factors, image = mapped_cards("dots:8", BASELINE)
    found, noise = image.depths, accumulate(run, factors).noise
    plain = depth_misfit(found, noise, 0.0, 0.0)
    excess = plain.unexplained**2 * found.energy / found.part
    assert plain.unexplained > 3.5e-3 and plain.flagged and plain.stated
    half = depth_misfit(found, noise, 0.0, excess / 2).unexplained
    assert half == pytest.approx(plain.unexplained / 2**0.5, rel=1e-6)
    assert depth_misfit(found, noise, 0.0, 1.01 * excess).unexplained == 0
    assert depth_misfit(found, noise, excess / found.smoothing, 0.0).unexplained == pytest.approx(0, abs=1e-6)
    assert not depth_misfit(found, noise, None, 0.0).stated


def test_files_and_the_summary_have_the_depths(tmp_path: object) -> None:
    from pathlib import Path

    from mitsim.core.exr import read_frame

    run, factors, image = mapped_cards()
    folder = image.save(Path(str(tmp_path)) / "image")
    channels, _ = read_frame(folder / "depth.exr")
    assert set(channels) == {"depth_mm", "confidence"}
    np.testing.assert_allclose(channels["depth_mm"], image.depths.mm, rtol=1e-6)
    reported = image.summary()["depths"]
    assert reported["least_mm"] < 380 and reported["most_mm"] > 420 and 0.9 < reported["told_part"] <= 1
    assert "mm, median" in str(image.focus) and "depth of each pixel" in image._repr_html_()
    reconstruct(run, factors).save(folder, overwrite=True)
    assert not (folder / "depth.exr").exists()


@pytest.mark.parametrize(
    ("patterns", "changes", "fragment"),
    [
        ("hadamard:2", {}, "needs shifting dots"),
        ("random:3", {}, "needs shifting dots"),
        ("dots:4", {"row_mm": (0.0, 0.0), "column_mm": (0.0, 0.0)}, "have no baseline"),
    ],
)
def test_what_cannot_tell_depths_is_refused(patterns: str, changes: dict[str, object], fragment: str) -> None:
    run, factors = shots(np.full((N, N), 400.0), patterns), calibrated()
    parallax = factors.manifest.parallax.model_copy(update=changes)
    factors = replace(factors, manifest=factors.manifest.model_copy(update={"parallax": parallax}))
    with pytest.raises(MitsimError, match=fragment):
        depth_map(run, factors)


def test_other_methods_have_no_depths() -> None:
    with pytest.raises(ArgumentError, match="tikhonov alone"):
        reconstruct(shots(np.full((N, N), 400.0), "dots:4"), calibrated(), method="tv", focus="map")
    with pytest.raises(MitsimError, match="does not state its parallax"):
        depth_map(shots(cards(), "dots:4"), Bench(*sides(400.0, BESIDE)).calibrated(0))


class Cubic(SimpleNamespace):
    """Factors that change with depth as a cubic does, which is what lies between those that are computed."""

    limit = 1e-4

    def __init__(self, size: int, period: int) -> None:
        rng = np.random.default_rng(8)
        self.parts = [rng.random((4, 24, size)) for _ in range(2)]
        family = parse_patterns(f"dots:{period}", size)
        super().__init__(patterns=(family.left.astype(float), family.right.astype(float)), data=10_000, outside=3.0)

    def side(self, axis: int, shift: float) -> np.ndarray:
        return np.tensordot((shift / self.limit) ** np.arange(4), self.parts[axis], axes=1)

    def frame(self, image: np.ndarray, shift: float, row: int, column: int) -> Measurement:
        left, right = (self.side(axis, shift) for axis in (0, 1))
        light = left @ (np.outer(self.patterns[0][:, row], self.patterns[1][:, column]) * image) @ right.T
        return Measurement(light, row, column, light, 1, 0)


def test_columns_that_change_as_a_cubic_are_exact() -> None:
    """Between those that are computed. (Planted: a line between them.)"""
    depths, pixels, shift = Cubic(6, 3), np.arange(6), np.linspace(-9e-5, 9e-5, 6)
    model = PixelDepths(depths, depths.limit, 2.5e-5)  # type: ignore[arg-type]
    powers, place = np.arange(4), shift / depths.limit
    for axis in (0, 1):
        exact = np.einsum("kp,krp->pr", place ** powers[:, None], depths.parts[axis])
        np.testing.assert_allclose(model.columns(axis, pixels, shift), exact, rtol=1e-9, atol=1e-12)


def test_an_image_at_given_depths_is_the_tikhonov_image_of_them() -> None:
    """In closed form, at a lambda that takes half of it; and what it leaves, over the data less two unknowns a pixel.
    (Planted: lambda taken off.)"""
    depths, image = Cubic(4, 2), np.random.default_rng(10).random((4, 4)) + 0.5
    depths.frames = tuple(depths.frame(image, 2e-5, *key) for key in np.ndindex(2, 2))
    model, expected, left = PixelDepths(depths, depths.limit, 2.5e-5), np.zeros((4, 4)), 3.0  # type: ignore[arg-type]
    for each in depths.frames:
        lit = np.ix_(np.arange(each.row, 4, 2), np.arange(each.column, 4, 2))
        columns = np.kron(depths.side(0, 2e-5)[:, each.row :: 2], depths.side(1, 2e-5)[:, each.column :: 2])
        part = np.linalg.solve(columns.T @ columns + 50 * np.eye(4), columns.T @ each.frame.ravel())
        expected[lit] = part.reshape(2, 2)
        left += float(np.square(each.frame.ravel() - columns @ part).sum())
    found = model.solve(np.full((4, 4), 2e-5), 50.0)
    np.testing.assert_allclose(found.image, expected, rtol=1e-9)
    assert found.left_over == pytest.approx(left, rel=1e-9)
    assert model.variance(found) == pytest.approx(left / (10_000 - 2 * 16), rel=1e-9)


def test_frames_of_too_many_pixels_are_refused() -> None:
    """65 x 65 of a frame are lit by the first of two dots along 130 pixels."""
    with pytest.raises(MitsimError, match="4225 pixels are lit at a time"):
        PixelDepths(Cubic(130, 2), 1e-4, 1e-4)  # type: ignore[arg-type]


COLUMNS = 32


class Narrow(DerivedCapture):
    """A capture of a window of fewer columns: the others are black."""

    patterns = property(lambda self: (self.whole.patterns[0], self.whole.patterns[1][:COLUMNS]))  # type: ignore[assignment]


def test_an_oblong_window_has_a_depth_for_each_pixel() -> None:
    """40 x 32 pixels at 430 mm, by one depth and by one for each; the projector above the camera, so that columns tell
    none. (Planted: as many columns as rows; rows' singular values for columns'; columns without parallax apart.)"""
    above = BASELINE[1], 0.0
    scene = np.where(np.arange(N) < COLUMNS, PRINT, 0.0)
    surface = ((np.ones((N, N), bool), *sides(430.0, above)),)
    run = Narrow(Layers(*sides(400.0, above), surfaces=surface).run("dots:8x4", scene, 0))
    square = calibrated(above)
    first, last = square.manifest.parallax.column_tan
    parallax = square.manifest.parallax.model_copy(update={"column_tan": (first, first + (last - first) * COLUMNS / N)})
    manifest = square.manifest.model_copy(update={"parallax": parallax})
    factors = replace(square, right=square.right[:, :COLUMNS], manifest=manifest)
    assert best_depth(run, factors).mm == pytest.approx(430, abs=1)
    found = depth_map(run, factors)
    assert found.mm.shape == (N, COLUMNS) and not found.doubt
    assert np.median(np.abs(found.mm - 430)) < 2


@pytest.mark.parametrize("axis", [0, 1])
def test_a_pixel_of_parallax_is_that_of_the_axis_that_moves_more(axis: int) -> None:
    """The window as wide along both axes, of 40 rows and 32 columns. (Planted: columns as narrow as rows.)"""
    baseline = (60.0, 0.0) if axis == 0 else (0.0, 60.0)
    square = calibrated(baseline)
    factors = replace(square, right=square.right[:, :COLUMNS])
    run = Narrow(shots(np.full((N, N), 400.0), "dots:8", baseline))
    pixel = 0.3 / (N, COLUMNS)[axis] / 60
    assert Arrivals(run, factors, (-2e-4, 2e-4), 0.0).pixel == pytest.approx(pixel)
