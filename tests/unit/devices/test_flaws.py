"""What goes wrong with masks, against closed forms of open areas and scipy.ndimage's dilation of fine drawings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from mitsim.core.errors import MitsimError
from mitsim.devices.camera import CameraGeometry
from mitsim.devices.mask import Dust, draw_dust, etch
from mitsim.devices.mask_profile import MaskProfile, load_mask
from mitsim.devices.plate import Plate, within

BARE = CameraGeometry(pixels=64)


def made(kind: str = "separable", **fields: object) -> Plate:
    return MaskProfile.model_validate({"kind": kind, "feature_mm": 0.06, "order": 6, **fields}).plate(Path())


@pytest.mark.parametrize("grow", [3.0, -7.0])
def test_an_etched_masks_open_area_is_that_of_longer_or_shorter_runs(grow: float) -> None:
    """A separable mask: each run of open features is 2 e longer. (Planted: grown on one side.)"""
    plate = made(over_etch_um=grow)
    bits = np.concatenate(
        ([0], MaskProfile(kind="separable", feature_mm=0.06, order=6).plate_drawing(Path()).terms[0][1], [0])
    )
    runs = np.count_nonzero(np.diff(bits) > 0)
    assert len(plate.terms) == 1 and plate.crosses is not None
    open_mm = bits.sum() * 0.06 + runs * 2 * grow * 1e-3
    assert plate.open_part * plate.extent_mm**2 == pytest.approx(open_mm**2, rel=1e-12)


@pytest.mark.parametrize("grow", [2, 7, -3, -14])
def test_etching_is_dilation_by_a_square_and_erosion(grow: int) -> None:
    """A random grey mask of 12 units a feature, by a unit's drawing of it; -14 takes openings of one feature, 7 closes
    gaps of one. (Planted: rows alone; the least beyond the mask 1.)"""
    values = np.random.default_rng(1).choice([0, 0.4, 1], (7, 7))
    lines, got = etch(values, 12.0, grow)
    fine = np.pad(values.repeat(12, 0).repeat(12, 1), 20)
    size = 2 * abs(grow) + 1  # a drawn pixel and so many on each side
    expected = (ndimage.grey_dilation if grow > 0 else ndimage.grey_erosion)(fine, (size, size))
    at = np.arange(len(fine)) + 0.5 - len(fine) / 2
    index = np.searchsorted(lines, at) - 1
    inside = (index >= 0) & (index < len(got))
    drawn = got[np.ix_(np.where(inside, index, 0), np.where(inside, index, 0))] * np.outer(inside, inside)
    np.testing.assert_array_equal(drawn, expected)


def test_closed_and_open_parts_let_through_what_is_stated() -> None:
    plate, sharp = made(opaque_transmission=0.02, clear_transmission=0.9), made(over_etch_um=1e-9)
    assert set(np.unique(plate.values)) == {0.02, 0.9}
    assert plate.open_part == pytest.approx(0.02 + 0.88 * sharp.open_part, rel=1e-6)
    assert len(plate.terms) == 2 and plate.crosses is not None and plate.diffracts


def test_quarter_turns_are_numpys_and_no_flaw_is_no_change() -> None:
    """Bit for bit; dust turns with its mask. (Planted: turned the other way; dust left in place.)"""
    profile = MaskProfile(kind="random", feature_mm=0.06, features=31)
    plain = profile.plate(Path())
    for turn, quarters in ((90.0, 1), (-90.0, 3), (180.0, 2)):
        turned = profile.model_copy(update={"rotation_deg": turn}).plate(Path())
        np.testing.assert_array_equal(turned.values, np.rot90(plain.values, quarters))
        assert turned.plain
    dirty = profile.model_copy(update={"dust_per_mm2": 4.0, "dust_radius_um": 40.0})
    quarter = dirty.model_copy(update={"rotation_deg": 90.0})
    one, other = (within(part.plate(Path()), 3.0) for part in (dirty, quarter))
    at = np.random.default_rng(0).uniform(-0.9, 0.9, (2, 500))
    apart = np.abs(other.transmission(-at[1], at[0]) - one.transmission(*at))  # cells at a disc's edge differ
    assert apart.mean() < 2e-3
    assert (one.transmission(*at) != plain.transmission(*at)).sum() > 5
    named = MaskProfile(kind="separable", feature_mm=0.06, rotation_deg=0.0, dust_seed=3)
    assert named.put_on(BARE, Path()) == CameraGeometry(pixels=64)


def test_a_disc_of_dust_takes_its_area() -> None:
    """Before a wholly open mask. (Planted: the diameter for the radius; clear for opaque.)"""
    dust = Dust(np.array([[0.11, -0.23], [-0.4, 0.3]]), 0.03, 0.6)
    lines, values = draw_dust(np.linspace(-1, 1, 21), np.ones((20, 20)), dust, 1.0)
    width = np.diff(lines)
    assert 4 - width @ values @ width == pytest.approx(2 * 0.6 * np.pi * 0.03**2, rel=1e-3)
    plate = Plate(0.1, values, "it", lines)
    assert plate.transmission(0.11, -0.23) == pytest.approx(0.4) and plate.transmission(0.11, -0.19) == 1
    assert plate.transmission(0.11 + 0.7 * 0.03, -0.23 - 0.6 * 0.03) == pytest.approx(0.4)


def test_dust_is_as_dense_as_stated_and_follows_its_seed() -> None:
    """10 discs a square millimetre on 30.66^2: 9400, five standard deviations of 97."""
    one, other = (made(order=9, dust_per_mm2=10.0, dust_seed=seed) for seed in (1, 2))
    assert one.flaws.dust is not None and one == made(order=9, dust_per_mm2=10.0, dust_seed=1) != other
    centres = one.flaws.dust.centres_mm
    assert abs(len(centres) - 10 * 30.66**2) < 500 and np.abs(centres).max() < 15.33
    assert np.abs(centres.mean(axis=0)).max() < 5 * 30.66 / 12**0.5 / 97
    with pytest.raises(MitsimError, match="dust_per_mm2"):
        within(one, 3.0)


def test_lines_that_are_not_even_weigh_by_their_width() -> None:
    """What is left of a mask over the area, not over its lines; the sum of terms is the mask. (Planted: no widths.)"""
    lines = np.array([-1, -0.9, -0.1, 0, 0.7, 1.0])
    values = np.random.default_rng(3).random((5, 5))
    plate = Plate(0.1, values, "it", lines)
    width = np.sqrt(np.diff(lines))
    singular = np.linalg.svd(width[:, None] * values * width, compute_uv=False)
    expected = np.sqrt(np.square(singular[1:]).sum() / np.square(singular).sum())
    assert plate.residuals[0] == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(sum(w * np.outer(r, c) for w, r, c in plate.terms), values, atol=1e-12)
    assert plate.extent_mm == 2.0


@pytest.mark.parametrize(
    ("table", "word"),
    [
        ("over_etch_um = 500.0", "over_etch_um"),
        ("opaque_transmission = 0.5\nclear_transmission = 0.4", "opaque_transmission"),
        ("edge_blur_um = -1.0", "edge_blur_um"),
        ("rotation_deg = 200.0", "rotation_deg"),
        ("dust_radius_um = 0.0", "dust_radius_um"),
        ("psf_distance_mm = 400.0", "psf_distance_mm"),
    ],
)
def test_other_flaws_are_refused_in_one_line(table: str, word: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(f'[mask]\nkind = "separable"\nfeature_mm = 0.06\n{table}\n')
    with pytest.raises(MitsimError, match=rf"^file .*: mask.*{word}[^\n]*$"):
        load_mask(path)


def test_masks_too_large_for_their_flaws_are_refused_in_one_line() -> None:
    for fields, word in (
        ({"order": 13, "edge_blur_um": 1.0}, "up to 12"),
        ({"kind": "random", "features": 2100, "over_etch_um": 1.0}, "over_etch_um"),
    ):
        profile = MaskProfile.model_validate({"kind": "separable", "feature_mm": 0.06, **fields})
        with pytest.raises(MitsimError, match=rf"^[^\n]*{word}[^\n]*$"):
            profile.plate(Path())
    for flaw in ({"edge_blur_um": 1.0}, {"rotation_deg": 1.0}, {"tilt_row_mrad": 1.0}):
        with pytest.raises(MitsimError, match="mask_thickness"):
            MaskProfile.model_validate({"kind": "separable", "feature_mm": 0.06, **flaw}).put_on(
                CameraGeometry(mask_thickness=0.1), Path()
            )
    MaskProfile(kind="separable", feature_mm=0.06, over_etch_um=1.0).put_on(CameraGeometry(mask_thickness=0.1), Path())
