"""Misfit of fitting and of faulty runs, in sessions drawn by numpy.

The camera is `tests.ideal_sessions`: 96 x 96 pixels, a scene of 16 x 16, 20 000 electrons at the brightest pixel.

Dead and hot pixels: named, left out, and the image as good as without them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mitsim.core.runs import Capture
from mitsim.reconstruct.misfit import UNEXPLAINED, Cause, Misfit, defects_of
from mitsim.reconstruct.reconstruct import Reconstruction, reconstruct
from mitsim.reconstruct.solver import Verdict
from tests.ideal_sessions import BLACK, CODES, PIXELS, Bench, N, bench, picture, shadow
from tests.unit.reconstruct.test_faults import Frames, with_frames

DATA = PIXELS**2
"""Data of a frame."""
SHIFT = 0.3
"""Projector pixels that light moves by when a sheet is 2 mm off 400 mm, seen from 60 mm beside."""
PLACE = np.linspace(-1, 1, PIXELS)
OTHER = Bench(*(np.roll(shadow()[::-1], 31, axis=0) * np.linspace(1, 3, N),) * 2)
"""Another camera, its mask turned and moved."""


def recovered(camera: Bench, patterns: str = "dots:4", seed: int = 0, own: Bench | None = None) -> Reconstruction:
    return reconstruct(camera.run(patterns, picture(seed), seed), (own or bench()).calibrated(seed))


def misfit(image: Reconstruction) -> Misfit:
    assert image.misfit is not None
    return image.misfit


@pytest.mark.parametrize("patterns", ["uniform", "dots:3", "dots:4", "hadamard:4", "random:4"])
def test_a_fitting_session_has_a_chi_square_of_one(patterns: str) -> None:
    """sqrt(2 / data) is one standard deviation of the energy of normal noise that is the same everywhere; shot noise
    is not, and 5 deviations of it are 6. (Planted: the variance of the -1 half forgotten, 1.85 for hadamard:4.)"""
    for seed in range(2):
        image = recovered(bench(), patterns, seed)
        found = misfit(image)
        frames = np.prod([side.shape[1] for side in bench().run(patterns, picture(), seed).patterns])
        assert abs(found.chi_square - 1) < 6 * np.sqrt(2 / (frames * DATA)), patterns
        assert image.ok and not found.flagged and found.cause is None and found.stated
        assert found.tiles.shape == (8, 8) and 0.5 < found.tiles.min() < found.tiles.max() < 2


def test_noisy_factors_are_counted() -> None:
    """A calibration of a tenth of the light moves the frames by more than their own noise, and is no misfit.

    (Planted: their energy left out, a chi-square of 5.)"""
    camera = bench(peak=3.8e4)
    shots = camera.run("dots:3", picture(), 0)
    for error in (0.02, 0.05):
        factors = camera.calibrated(0, error)
        found = misfit(reconstruct(shots, factors))
        # The error of the factors is one draw of 2 x 1536 numbers: its energy varies by sqrt(2 / 1536), 4 %.
        assert abs(found.chi_square - 1) < 0.15, error
        unaware = factors.manifest.model_copy(update={"noise": factors.manifest.noise.model_copy(update={"left": 0.0})})
        assert misfit(reconstruct(shots, replace(factors, manifest=unaware))).chi_square > found.chi_square + 0.15


@pytest.mark.parametrize("patterns", ["dots:3", "dots:4", "hadamard:4"])
@pytest.mark.parametrize("rows", [False, True], ids=["beside", "above"])
def test_depth_is_flagged(patterns: str, rows: bool) -> None:
    camera = bench(SHIFT)
    if rows:
        camera = replace(camera, left=camera.right, right=camera.left)
    image = recovered(camera, patterns)
    found = misfit(image)
    assert not image.ok and image.status.verdict is Verdict.MISFIT and found.cause in (Cause.MODEL, Cause.PIXELS)
    assert found.unexplained > UNEXPLAINED and "fit no image" in str(image.status) and not found.faults


def test_light_of_the_room_is_flagged() -> None:
    """A lamp's light comes from all scene pixels, in every shot. The difference of two shots does not see it."""
    lamp = 0.1 * shadow() @ np.ones((N, N)) @ shadow().T
    lit = bench(optics=lambda light: light + lamp / lamp.max() * 1e3)
    assert not recovered(lit).ok and recovered(lit, "hadamard:4").ok


@pytest.mark.parametrize("patterns", ["uniform", "dots:4", "hadamard:4", "random:4"])
@pytest.mark.parametrize("gain", [0.5, 0.7, 1.05, 1.5, 4.0])
def test_a_wrong_gain_is_noise(patterns: str, gain: float) -> None:
    """Frames of a camera whose gain is ``gain`` times the stated one: flagged as noise, with the measured gain where
    the brightness of tiles differs enough. (Planted: only chi-square above 1 is flagged; the slope over the light
    without the part that the fit takes.)"""
    shots = bench().run(patterns, picture(), 0)
    digital = shots.manifest.digital
    # The same numbers by another gain: what was divided by g is now divided by g / gain.
    stated = digital.model_copy(update={"gain_dn_per_e": digital.gain_dn_per_e / gain})
    other = Capture(shots.manifest.model_copy(update={"digital": stated}), memory=shots._memory)
    image = reconstruct(other, bench().calibrated(0))
    found = misfit(image)
    if gain == 1.05:  # is told by chi-square against the stated noise, and is no fault
        assert image.ok and found.chi_square == pytest.approx(gain, rel=0.03)
        return
    assert not image.ok and found.cause is Cause.NOISE and "measured" not in str(found.faults)
    assert found.noise.ratio == pytest.approx(gain, rel=0.25)
    if found.noise.gain_error < 0.05 * gain:
        assert abs(found.noise.gain - gain) < 5 * found.noise.gain_error
        assert f"stated gain {stated.gain_dn_per_e:.4g}" in str(image.status)


def test_gloss_is_found_on_the_map() -> None:
    """A highlight brightens one side of the sensor's view of every scene pixel."""
    found = misfit(recovered(bench(optics=lambda light: light * (1 + 0.1 * np.outer(PLACE, PLACE)))))
    assert found.flagged and found.cause in (Cause.MODEL, Cause.PIXELS)
    corners, middle = found.tiles[[0, 0, -1, -1], [0, -1, 0, -1]], found.tiles[3:5, 3:5]
    assert corners.min() > 3 * middle.max(), "the map shows where"


def test_a_spot_on_one_tile_is_flagged() -> None:
    """Light on half of 1 of 64 tiles 5 % brighter: less than 3.5e-3 of all measurements."""
    spot = np.ones((PIXELS, PIXELS))
    spot[12:18, 12:18] = 1.05
    image = recovered(bench(optics=lambda light: light * spot))
    found = misfit(image)
    assert not image.ok and found.unexplained < UNEXPLAINED and found.cause is Cause.PIXELS
    assert np.unravel_index(found.tiles.argmax(), found.tiles.shape) == (1, 1)


@pytest.mark.parametrize("late", [False, True])
def test_a_column_that_is_hot(late: bool) -> None:
    """In all frames, or from the middle of the session on."""
    shots = bench(peak=3e3).run("dots:4", picture(1), 1)

    def hot(frames: list[np.ndarray]) -> list[np.ndarray]:
        count = len(frames)
        warm, line = (lambda number: 40.0 * (not late or 2 * number >= count)), np.arange(PIXELS) == 40
        return [np.where(line, frame + warm(number), frame) for number, frame in enumerate(frames)]

    found = reconstruct(with_frames(shots, hot), bench().calibrated(1))
    assert not found.ok or found.misfit.defects is not None
    assert "column" in str(found.status) or "40" in str(found.misfit)


def test_saturation_is_named() -> None:
    found = misfit(recovered(bench(peak=6e4)))
    assert found.flagged and found.cause in (Cause.SATURATION, Cause.FRAMES, Cause.PIXELS)


def test_another_camera_is_flagged() -> None:
    """Factors of another camera that goes by the same name: its mask's features in another order."""
    image = recovered(bench(), own=OTHER)
    assert not image.ok and misfit(image).cause in (Cause.MODEL, Cause.PIXELS)


def test_without_stated_noise_only_gross_misfit_is_flagged() -> None:
    plain = bench(stated=False)
    image = recovered(bench(SHIFT / 3, stated=False), own=plain)
    found = misfit(image)
    assert image.ok and not found.stated and found.chi_square > 2
    gross = recovered(plain, own=replace(OTHER, stated=False))
    assert not gross.ok and misfit(gross).cause is Cause.MODEL
    # Few photons leave more than a tenth of the frames unexplained, and are no misfit.
    assert recovered(bench(peak=40.0, stated=False), own=plain).ok


def test_a_bad_verdict_of_the_solver_stays() -> None:
    image = reconstruct(bench(SHIFT).run("dots:4", picture(), 0), bench().calibrated(0), method="tv")
    assert image.status.verdict is Verdict.MISFIT
    twin = bench().calibrated(0)
    twin.left[:, 1] = twin.left[:, 0]
    lost = reconstruct(bench(SHIFT).run("uniform", picture(), 0), twin, 0)
    assert lost.status.verdict is Verdict.RANK_DEFICIENT
    assert lost.rank_sides == (N - 1, N)


def test_no_more_data_than_unknowns_tell_no_misfit() -> None:
    square = Bench(shadow(n=PIXELS), shadow(n=PIXELS))
    image = reconstruct(square.run("uniform", picture(n=PIXELS), 0), square.calibrated(0), 1.0)
    assert image.misfit is None and image.summary()["misfit"] is None


def test_misfit_has_no_unit() -> None:
    """The same digital numbers as electrons of 10^12 seconds: light, noise and image shrink together."""
    shots, factors = bench().run("dots:3", picture(), 0), bench().calibrated(0)
    digital = shots.manifest.digital
    changes = {"exposure_s": digital.exposure_s * 1e12, "dark_current_e_per_s": digital.dark_current_e_per_s / 1e12}
    longer = digital.model_copy(update=changes)
    other = Capture(shots.manifest.model_copy(update={"digital": longer}), memory=shots._memory)
    found, expected = misfit(reconstruct(other, factors)), misfit(reconstruct(shots, factors))
    for name in ("chi_square", "unexplained", "worst_tile"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-6)


@pytest.mark.parametrize("unit", [0.01, 1.0])
def test_a_faulty_frame_is_found_beside_total_variation_in_any_unit(unit: float) -> None:
    """Total variation has no lambda; the picture is that of a lambda in the scale of the factors."""

    def dimmed(frames: list[np.ndarray]) -> list[np.ndarray]:
        return [BLACK + (frame - BLACK) * (0.7 if number == 5 else 1) for number, frame in enumerate(frames)]

    factors = bench().calibrated(0)
    noise = {side: getattr(factors.manifest.noise, side) * unit for side in ("left", "right")}
    manifest = factors.manifest.model_copy(update={"noise": factors.manifest.noise.model_copy(update=noise)})
    other = replace(factors, left=factors.left * unit, right=factors.right * unit, manifest=manifest)
    found = misfit(reconstruct(with_frames(bench().run("dots:4", picture(), 0), dimmed), other, method="tv"))
    assert 5 in {number for reported in found.faults for number in reported.numbers}


# ---- Defective pixels ----


def broken(frames: Frames) -> Frames:
    """A dead pixel, and a hot one that hides it at first."""
    changed = [frame.copy() for frame in frames]
    for frame in changed:
        frame[40, 51], frame[10, 11] = BLACK, CODES - 1
    return changed


@pytest.mark.parametrize("patterns", ["uniform", "dots:4", "hadamard:4", "random:4"])
def test_single_pixels(patterns: str) -> None:
    """As what they are; a good run says nothing."""
    shots, factors = bench().run(patterns, picture(1), 1), bench().calibrated(1)
    good, mended = reconstruct(shots, factors), reconstruct(with_frames(shots, broken), factors)
    assert mended.ok
    assert mended.misfit.defects.places == [(10, 11), (40, 51)]
    assert mended.summary()["misfit"]["defective_pixels"] == {"count": 2, "first": [(10, 11), (40, 51)]}
    assert "2 defective pixels left out, at (row, column) (10, 11), (40, 51)" in mended.trust[0]
    errors = [float(np.sqrt(np.mean(np.square(each.image - picture(1))))) for each in (good, mended)]
    assert errors[1] < 1.02 * errors[0]
    noises = [each.uncertainties.budget["frame_noise"] for each in (mended, good)]
    assert noises[0] == pytest.approx(noises[1], rel=0.02)


@pytest.mark.parametrize("place", [(40, 51), (10, 11), (70, 30)])
@pytest.mark.parametrize("number", [BLACK, CODES - 1])
def test_a_pixel_that_stands_still(place: tuple[int, int], number: float) -> None:
    """Halves of signed patterns differ by less than noise there; their sum is none of the light."""

    def still(frames: Frames) -> Frames:
        changed = [frame.copy() for frame in frames]
        for frame in changed:
            frame[place] = number
        return changed

    shots = with_frames(bench(peak=300.0).run("hadamard:4", picture(1), 1), still)
    mended = reconstruct(shots, bench().calibrated(1))
    assert mended.ok
    assert mended.misfit.defects.places == [place]


def test_noise_alone_makes_no_defects() -> None:
    """A chi-square of one degree of freedom has the longest tail."""
    rng = np.random.default_rng(1)
    for count in (1, 4, 49):
        squares = np.square(rng.standard_normal((count, 512, 512))).sum(axis=0)
        assert defects_of(squares, np.full((512, 512), float(count)), count) is None
        squares[100, 200] += 120.0 + 8 * np.sqrt(2 * count)
        found = defects_of(squares, np.full((512, 512), float(count)), count)
        assert found.places == [(100, 200)]


def test_a_spot_of_light_is_no_defect() -> None:
    """Pixels side by side, and more of the sensor than breaks."""
    squares = np.full((64, 64), 4.0)
    squares[20:26, 30:36] = 400.0
    assert defects_of(squares, np.full((64, 64), 4.0), 4) is None
    many = np.where(np.random.default_rng(2).random((64, 64)) < 0.05, 400.0, 4.0)
    assert defects_of(many, np.full((64, 64), 4.0), 4) is None


# ---- What a simulated run states of its own light ----


def simulated(patterns: str, change: Callable[[Frames], Frames] = list, **stated: float) -> Reconstruction:
    """Image of frames after a ``change``, whose manifest has ``stated`` errors of the simulation."""
    shots = with_frames(bench().run(patterns, picture(), 0), change)
    plan = {"systematic_error": stated.pop("systematic_error", 0.0)}
    shots.manifest = shots.manifest.model_copy(update={"plan": plan, **stated})
    return reconstruct(shots, bench().calibrated(0))


def test_monte_carlo_errors_of_projector_pixels_leave_no_residual() -> None:
    """An error of a projector pixel's light is one of the image. Sampling that the pixels do not explain, such as that
    of indirect light, counts in full. (Planted: counted in the residual, too, a chi-square of 0.67.)"""
    expected = misfit(recovered(bench())).chi_square
    assert misfit(simulated("dots:4", mc_error=0.01, light_error=0.3)).chi_square == pytest.approx(expected, rel=1e-3)
    assert misfit(simulated("dots:4", mc_error=0.01)).chi_square < 0.8 * expected


@pytest.mark.parametrize(("stated", "flagged"), [(0.0, True), (5e-3, False)])
def test_an_uneven_error_within_the_stated_one_is_no_local_fault(stated: float, flagged: bool) -> None:
    """A sensor column off by a part of the light, as coarse cells may leave it. (Planted: places are compared with the
    sensor's noise alone.)"""

    def column(frames: Frames) -> Frames:
        return [frame * (1 + 0.02 * (np.arange(PIXELS) == 30)) for frame in frames]

    image = simulated("dots:4", column, systematic_error=stated)
    assert misfit(image).flagged is flagged and image.ok is not flagged


def test_no_frame_of_a_coarse_simulation_is_at_fault() -> None:
    """The error of some patterns exceeds that of others; the status names the error of the simulation.
    (Planted: frames are compared with the others in any run.)"""

    def some(frames: Frames) -> Frames:
        light = 0.1 * frames[6].mean() * np.sin(1.7 * np.arange(PIXELS))
        return [frame + light * (index == 6) for index, frame in enumerate(frames)]

    assert misfit(simulated("hadamard:4", some)).cause is Cause.FRAMES
    coarse = simulated("hadamard:4", some, systematic_error=0.01)
    assert misfit(coarse).flagged and misfit(coarse).cause is not Cause.FRAMES
    assert "states an error of 1.0% of its own light" in str(coarse.status)
