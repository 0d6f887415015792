"""Masks given feature by feature: their terms, grids and residuals against closed forms, and files that are read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsim.core.configuration import validate
from mitsim.core.errors import MitsimError
from mitsim.devices import mask as plate_module
from mitsim.devices.camera import CameraGeometry, MaskProfile, load_mask, make_square, mura, read_drawing
from mitsim.devices.mask import LEFT_OUT, Plate, mls_mask, within


def drawn(kind: str, order: int = 6) -> np.ndarray:
    mask = mls_mask(kind, 0.06, order)
    return sum(weight * np.outer(rows, columns) for weight, rows, columns in mask.terms)


def product(plate: Plate) -> np.ndarray:
    return sum(weight * np.outer(rows, columns) for weight, rows, columns in plate.terms)


@pytest.mark.parametrize(
    ("values", "terms"),
    [(drawn("separable"), 1), (drawn("open"), 1), (drawn("flatcam"), 2), (mura(31), 2), (0.3 * drawn("flatcam"), 2)],
)
def test_masks_of_one_or_two_terms_have_them_exactly(values: np.ndarray, terms: int) -> None:
    """(Planted: the column not divided by the pivot.)"""
    plate = Plate(0.06, values, "it")
    assert plate.crosses is not None and len(plate.terms) == terms
    np.testing.assert_allclose(product(plate), values, rtol=0, atol=1e-15)


def test_any_other_mask_is_its_singular_vectors_but_for_what_is_stated() -> None:
    """Singular values that fall by ten each: as many terms as the bound asks for, and the stated rest is the rest.
    Rows and columns come up to nine times, as in drawings of several pixels a feature. (Planted: no weights.)"""
    rng = np.random.default_rng(0)
    left, right = (np.linalg.qr(rng.normal(size=(20, 20)))[0] for _ in range(2))
    values = (left * 0.1 ** np.arange(20)) @ right
    values = (values - values.min()) / np.ptp(values)
    counts = np.repeat([1, 9], 10)
    values = values.repeat(counts, axis=0).repeat(counts[::-1], axis=1)
    plate = Plate(0.06, values, "it")
    rest = np.linalg.norm(product(plate) - values) / np.linalg.norm(values)
    assert plate.crosses is None and 5 < len(plate.terms) < 12
    assert 0 < rest <= LEFT_OUT


def test_a_mask_whose_rows_are_its_columns_has_terms_of_one_profile() -> None:
    """(Planted: distinct columns in an order of their own.)"""
    upper = np.triu(np.random.default_rng(0).integers(0, 2, (14, 14)))
    values = np.maximum(upper, upper.T).astype(np.float64)
    plate = Plate(1.0, values, "symmetric")
    assert plate.symmetric
    assert all(np.array_equal(row, column) for _, row, column in plate.terms)
    assert sum(weight * np.outer(row, column) for weight, row, column in plate.terms) == pytest.approx(values)


def test_masks_of_many_terms_are_not_decomposed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their terms are their distinct rows, exactly, and what the best separable mask leaves is the same. (Planted: a
    row's number off by one; the product not taken off.)"""
    values = np.random.default_rng(1).integers(0, 2, (30, 30)).astype(np.float64).repeat(2, axis=0).repeat(3, axis=1)
    values = values[:, :60]
    few, many = Plate(0.06, values, "it"), Plate(0.06, values, "it")
    assert not few.many and few.most_terms == 20
    left = few.residuals
    monkeypatch.setattr(plate_module, "_MOST_DECOMPOSED", 19)
    assert many.many
    np.testing.assert_array_equal(product(many), values)
    np.testing.assert_allclose(many.residuals, left, rtol=1e-9)


def test_a_mura_has_an_even_periodic_correlation_with_its_decoding_array() -> None:
    """Gottesman and Fenimore's property: (p^2 - 1) / 2 at no shift, else 0. (Planted: column 0 closed.)"""
    for p in (5, 7, 13, 31):
        array = mura(p)
        decoding = np.where(array == 1, 1.0, -1.0)
        decoding[0, 0] = 1
        found = np.fft.ifft2(np.fft.fft2(array) * np.conj(np.fft.fft2(decoding))).real
        expected = np.zeros((p, p))
        expected[0, 0] = (p * p - 1) / 2
        np.testing.assert_allclose(found, expected, atol=1e-9)


def test_what_one_separable_term_leaves() -> None:
    """FlatCam (1 + m m^T)/2 without means is separable; two equal disjoint squares leave 1/sqrt(2) however they are
    weighed against noise. (Planted: singular values not squared.)"""
    flatcam = Plate(0.06, drawn("flatcam"), "it")
    assert min(flatcam.residuals) < 1e-12 and flatcam.centred and flatcam.residuals[0] == pytest.approx(0.7, abs=0.02)
    separable = Plate(0.06, drawn("separable"), "it")
    assert separable.residuals == (0.0, 0.0) and not separable.centred
    assert Plate(0.06, np.kron(np.eye(2), np.ones((3, 3))), "it").residuals[0] == pytest.approx(0.5**0.5)


@pytest.mark.parametrize("values", [drawn("separable"), drawn("flatcam"), mura(31), np.eye(3)])
def test_grids_hold_what_is_open_once(values: np.ndarray) -> None:
    plate = Plate(0.06, values, "it")
    assert plate.grids is not None
    np.testing.assert_array_equal(sum(np.outer(r, c).astype(int) for r, c in plate.openings), values)


@pytest.mark.parametrize("most", [0.0, 5e-324, 1e-300, 1e-12])
def test_a_mask_without_light_is_refused(most: float) -> None:
    """What is rounding beside 1 is no light. (Planted: 0 alone is refused: no term is left of the others.)"""
    with pytest.raises(MitsimError, match="no feature lets light through"):
        Plate(0.06, most * np.eye(3), "it")
    assert len(Plate(0.06, 1e-11 * np.eye(2), "it").terms) == 2
    with pytest.raises(MitsimError, match=r"^it: [^\n]+$"):
        Plate(0.06, np.ones((4097, 4097)), "it")


def test_transmission_at_points_and_outside() -> None:
    plate = Plate(2.0, np.array([[0, 0.25, 0.5], [0.75, 1, 0], [0, 0, 0]]), "it")
    np.testing.assert_array_equal(plate.transmission([-3.1, -2.9, -0.9, 2.9], -0.5), [0, 0.25, 1, 0])
    np.testing.assert_array_equal(plate.transmission(-2.5, [-0.5, 2.5]), [0.25, 0.5])
    np.testing.assert_allclose(plate.amplitude.values**2, plate.values)


def test_only_what_is_out_of_sight_is_cut_off() -> None:
    plate = MaskProfile(kind="random", feature_mm=0.1, features=41).plate(Path())
    part = within(plate, 1.0)
    assert len(part.values) == 21 and len(part.terms) <= 21  # 1.05 mm: whole features
    np.testing.assert_array_equal(part.values, plate.values[10:31, 10:31])
    assert within(plate, 2.05) is plate and within(Plate(0.06, drawn("flatcam"), "it"), 0.5).extent_mm == 63 * 0.06


def test_random_masks_follow_their_seed_and_part() -> None:
    """350^2 draws of p = 0.3: standard deviation 0.0013, five of them."""
    one, other = (MaskProfile(kind="random", feature_mm=0.1, features=350, open_part=0.3, seed=s) for s in (1, 2))
    assert one.plate(Path()) == one.plate(Path()) != other.plate(Path())
    assert one.plate(Path()).values.mean() == pytest.approx(0.3, abs=0.0066)


def test_pictures_and_arrays_are_read_alike(tmp_path: Path) -> None:
    grey = np.array([[0, 51, 255], [102, 204, 153]], np.uint8)
    Image.fromarray(grey).save(tmp_path / "a.png")
    Image.fromarray(grey).save(tmp_path / "a.tiff")
    Image.fromarray(grey.astype(np.uint16) * 257).save(tmp_path / "b.png")
    Image.fromarray((grey / 255).astype(np.float32)).save(tmp_path / "b.tif")
    np.save(tmp_path / "a.npy", grey / 255)
    for name in ("a.png", "a.tiff", "b.png", "b.tif", "a.npy"):
        np.testing.assert_allclose(read_drawing(tmp_path / name), grey / 255, rtol=1e-7)
    Image.fromarray(grey > 100).save(tmp_path / "c.png")
    np.testing.assert_array_equal(read_drawing(tmp_path / "c.png"), grey > 100)


def test_a_plate_that_is_closed_where_it_is_seen_keeps_few_features() -> None:
    """(Seen to fail: all 999 x 999 kept, whose singular values take seconds; of 4093, over 45 s.)"""
    values = np.random.default_rng(0).integers(0, 2, (999, 999)).astype(float)
    values[499, 499] = 0
    part = within(Plate(1.0, values, "a random mask"), 0.1)
    assert len(part.values) < 9 and part.values.any()
    middle = len(values) // 2 - len(part.values) // 2
    assert np.array_equal(part.values, values[middle : middle + len(part.values), middle : middle + len(part.values)])


def test_drawings_are_squared_about_their_centre() -> None:
    feature, values = make_square(np.ones((2, 4)), 0.1)
    assert feature == 0.1 and values.tolist() == [[0] * 4, [1] * 4, [1] * 4, [0] * 4]
    feature, values = make_square(np.ones((1, 2)), 0.1)
    assert feature == 0.05 and values.sum(axis=1).tolist() == [0, 4, 4, 0]


BAD = {
    "wide.png": lambda path: Image.new("1", (4097, 1)).save(path),
    "odd.png": lambda path: Image.new("1", (4096, 1)).save(path),  # margins of half a pixel would double its sides
    "large.npy": lambda path: np.save(path, np.full((2, 2), 1.5)),
    "nan.npy": lambda path: np.save(path, np.full((2, 2), np.nan)),
}


@pytest.mark.parametrize("name", BAD)
def test_other_files_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    BAD[name](tmp_path / name)
    with pytest.raises(MitsimError, match=rf"^mask drawing .*{name}: [^\n]+$"):
        read_drawing(tmp_path / name)


@pytest.mark.parametrize(
    ("table", "word"),
    [
        *(('kind = "mura"', "features"), ('kind = "random"\nfeatures = 5\norder = 3', "order")),
        *(('kind = "pinhole"', "kind"), ('kind = "separable"\nfeature_mm = 0.0', "feature_mm")),
        *(("dust_per_mm2 = 1.0", "dust_per_mm2"), ("edge_blur_um = -1.0", "edge_blur_um")),
        ("opaque_transmission = 0.5\nclear_transmission = 0.4", "opaque_transmission"),
        *(("rotation_deg = 200.0", "rotation_deg"), ("psf_distance_mm = 400.0", "psf_distance_mm")),
    ],
)
def test_other_tables_are_refused_in_one_line(table: str, word: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    stated = {name: f"{name} = {value}\n" for name, value in (("kind", '"separable"'), ("feature_mm", "0.06"))}
    path.write_text("[mask]\n" + "".join(line for name, line in stated.items() if name not in table) + table)
    with pytest.raises(MitsimError, match=rf"^file .*: mask.*{word}[^\n]*$"):
        load_mask(path)
    path.write_text("mask = 3\n")
    with pytest.raises(MitsimError, match=r"give a table"):
        load_mask(path)


_KNOWN = "scene_distance", "fov", "angular_exponent"


def test_a_camera_wears_a_profile_and_cameras_without_stay_what_they_were() -> None:
    """(Planted: the plate in every identity.)"""
    bare = CameraGeometry(mask_offset_row=0.5)
    known = {name for name in CameraGeometry.model_fields if name.startswith(("mask", "pixel")) or name in _KNOWN}
    known -= {f"mask_{name}" for name in ("offset_column", "plate", "motion", "fft", "cells", "lean_mrad")}
    assert set(bare.identity) == known and bare.mask_terms == 1 and bare.diffracts and not bare.centred
    flatcam = MaskProfile(kind="flatcam", feature_mm=0.05, order=5).put_on(bare, Path())
    assert flatcam == CameraGeometry(mask="flatcam", mask_feature=0.05, mask_order=5, mask_offset_row=0.5)
    random = MaskProfile(kind="random", feature_mm=0.05, features=60).put_on(bare, Path())
    assert random.build_mask() == random.mask_plate and random.mask_offset_row == 0.5 and random.mask_feature == 0.05
    assert random.mask_terms == 60 and random.diffracts and "sha256" in str(random.identity["mask_plate"])
    assert random == MaskProfile(kind="random", feature_mm=0.05, features=60).put_on(bare, Path()) != bare
    assert MaskProfile(kind="mura", feature_mm=0.05, features=61).put_on(bare, Path()).centred
    with pytest.raises(MitsimError, match="mask_thickness"):
        MaskProfile(kind="random", feature_mm=0.05, features=60).put_on(CameraGeometry(mask_thickness=0.1), Path())
    with pytest.raises(MitsimError, match="plate"):
        validate(CameraGeometry, {"mask": "plate"}, "scene")
