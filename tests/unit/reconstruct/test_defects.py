"""Dead and hot pixels: named, left out, and the image as good as without them."""

from __future__ import annotations

import numpy as np
import pytest

from mitsim.reconstruct.misfit import defects_of
from mitsim.reconstruct.reconstruct import reconstruct
from tests.ideal_sessions import BLACK, CODES, bench, picture
from tests.unit.reconstruct.test_faults import Frames, with_frames


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
    assert mended.ok and mended.misfit is not None and mended.misfit.defects is not None
    assert mended.misfit.defects.places == [(10, 11), (40, 51)]
    assert mended.summary()["misfit"]["defective_pixels"] == {"count": 2, "first": [(10, 11), (40, 51)]}
    assert "2 defective pixels left out, at (row, column) (10, 11), (40, 51)" in mended.trust[0]
    errors = [float(np.sqrt(np.mean(np.square(each.image - picture(1))))) for each in (good, mended)]
    assert errors[1] < 1.02 * errors[0]
    assert good.uncertainties is not None and mended.uncertainties is not None
    assert mended.uncertainties.budget["frame_noise"] == pytest.approx(
        good.uncertainties.budget["frame_noise"], rel=0.02
    )


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
    assert mended.ok and mended.misfit is not None and mended.misfit.defects is not None
    assert mended.misfit.defects.places == [place]


def test_a_dead_line() -> None:
    def dead(frames: Frames) -> Frames:
        return [np.where(np.arange(96)[None, :] == 51, BLACK, frame) for frame in frames]

    shots = bench().run("dots:4", picture(1), 1)
    mended = reconstruct(with_frames(shots, dead), bench().calibrated(1))
    assert mended.ok and mended.misfit is not None and mended.misfit.defects is not None
    assert mended.misfit.defects.places == [(row, 51) for row in range(96)]


def test_noise_alone_makes_no_defects() -> None:
    """A chi-square of one degree of freedom has the longest tail."""
    rng = np.random.default_rng(1)
    for count in (1, 4, 49):
        squares = np.square(rng.standard_normal((count, 512, 512))).sum(axis=0)
        assert defects_of(squares, np.full((512, 512), float(count)), count) is None
        squares[100, 200] += 120.0 + 8 * np.sqrt(2 * count)
        found = defects_of(squares, np.full((512, 512), float(count)), count)
        assert found is not None and found.places == [(100, 200)]


def test_a_spot_of_light_is_no_defect() -> None:
    """Pixels side by side, and more of the sensor than breaks."""
    squares = np.full((64, 64), 4.0)
    squares[20:26, 30:36] = 400.0
    assert defects_of(squares, np.full((64, 64), 4.0), 4) is None
    many = np.where(np.random.default_rng(2).random((64, 64)) < 0.05, 400.0, 4.0)
    assert defects_of(many, np.full((64, 64), 4.0), 4) is None


def test_light_that_fits_nowhere_is_no_defect() -> None:
    """Print finer than a scene pixel leaves five times the noise, and more where shadows of two edges cross; a pixel
    that is dead leaves more by far."""
    squares = np.full((120, 120), 49 * 5.5)
    squares[10::30] += 49 * 3
    squares[:, 20::30] += 49 * 3
    squares[10::30, 20::30] += 49 * 10
    assert defects_of(squares, np.full((120, 120), 49.0), 49) is None
    squares[70, 31] = 49 * 500
    found = defects_of(squares, np.full((120, 120), 49.0), 49)
    assert found is not None and found.places == [(70, 31)]
