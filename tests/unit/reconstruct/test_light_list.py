"""Lists of point spread functions: volumes, fields, and lists that are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

import mitsim as ms
from mitsim.core.exr import read_frame
from mitsim.reconstruct import point_spread as ps
from mitsim.reconstruct.light_list import blend, load_lights
from tests.unit.reconstruct.test_point_spread import called, record

SENSOR = 36, 38
SHIFTS = (-6.0, -3.0), (6.0, 3.0)


def lights(count: int, mix: float = 0.0) -> np.ndarray:
    """Sums of spots; a share ``mix`` of the spots of each is that of the first."""
    rng = np.random.default_rng(3)
    found = np.zeros((count, 36, 38))
    found[:, 12:24, 13:25] = gaussian_filter(rng.random((count, 12, 12)) ** 16, (0, 0.6, 0.6))
    found /= found.sum(axis=(1, 2), keepdims=True)
    return mix * found[:1] + (1 - mix) * found


def write(folder: Path, pictures: np.ndarray, facts: list[str], name: str = "list.toml") -> Path:
    tables = []
    for number, (picture, fact) in enumerate(zip(pictures, facts, strict=True)):
        np.save(folder / f"{number}.npy", picture)
        tables.append(f'[[psf]]\nfile = "{number}.npy"\n{fact}\n')
    (folder / name).write_text("\n".join(tables))
    return folder / name


def objects(camera: ps.ShiftedLight) -> np.ndarray:
    """A small bright object at each depth, side by side."""
    scene = np.zeros(camera.scene)
    for depth, column in enumerate((4, 22)):
        scene[camera.window][depth, 8:28, column : column + 12] = np.random.default_rng(depth).random((20, 12)) > 0.9
    return 3e5 * scene


def test_a_volume_has_each_object_at_its_depth_and_alike_depths_are_flagged(tmp_path: Path) -> None:
    """Whichever order the list has. One light for both depths loses 10 dB. (Planted: slices in the list's order; no
    depth left out in turn; light of all slices counted, not of one; depths of dark pixels.)"""
    camera = ps.ShiftedLight(lights(2), SENSOR)
    scene = objects(camera)
    shots, truth = record(camera, scene), scene[camera.window]
    listed = write(tmp_path, lights(2)[::-1], ["depth_mm = 200", "depth_mm = 100.5"])

    def error(image: np.ndarray, truth: np.ndarray) -> float:
        return 20 * np.log10(float(truth.max() / np.sqrt(np.mean(np.square(image - truth)))))

    shots.save(tmp_path / "run")
    asked = "reconstruct", tmp_path / "run", "--method", "tv", "--psf"
    status, found = called(*asked, listed, "-o", tmp_path / "image")
    assert status == 0 and found["volume_depths_mm"] == [100.5, 200] == found["focus_range_mm"], found
    assert min(found["misfit"]["without_depth"]) > 1.1 and found["depths"]["most_mm"] > 190
    assert found["depths"]["told_part"] < 0.2, "dark pixels have no depth"
    slices = read_frame(tmp_path / "image" / "volume.exr")[0]
    volume = np.stack([slices["slice_000"], slices["slice_001"]])
    page = ms.report(tmp_path / "image").read_text(encoding="utf-8")
    assert "From left to right at 100.5 mm, 200.0 mm" in page and page.count("electrons/s") > 2
    single = ms.reconstruct_psf(shots, lights(2)[0], method="tv")
    assert error(volume, truth) > 28 and single.volume is None
    assert error(volume.sum(axis=0), truth.sum(axis=0)) > error(single.image, truth.sum(axis=0)) + 10
    alike = ps.ShiftedLight(lights(2, 0.97), SENSOR)
    listed = write(tmp_path, alike.psf, ["depth_mm = 100", "depth_mm = 200"])
    image = ms.reconstruct_psf(record(alike, scene), listed, method="tv")
    assert not image.ok and "explained nearly as well without 1" in str(image.status) and image.depths is None
    assert image.volume is not None and image.volume.slices.shape == (2, *SENSOR)


def test_a_light_that_changes_over_the_field_is_blended_and_centred_pictures_are_flagged(tmp_path: Path) -> None:
    """Pictures have their light at its place, and share one scale. (Planted: light shifted the other way; each of sum
    1; no flag; places not reduced.)"""
    places = np.array(SHIFTS)
    centred = lights(2, 0.5) * np.array([1.0, 0.6])[:, None, None]
    pictures = np.stack([shift(each, place, order=1) for each, place in zip(centred, places, strict=True)])
    facts = [f"place = {[*place]}" for place in SHIFTS]
    listed = write(tmp_path, pictures, facts)
    read = load_lights(listed, 1)
    np.testing.assert_allclose(read.light, centred, atol=1e-9)
    assert read.doubt == "" and load_lights(listed, 2).places.tolist() == [[-3.0, -1.5], [3.0, 1.5]]
    camera = ps.ShiftedLight(centred, SENSOR, places=places)
    scene = np.zeros(camera.scene)
    scene[camera.window][4:-4, 4:-4] = 2e5 * (np.random.default_rng(2).random((28, 30)) > 0.9)
    shots, truth = record(camera, scene), scene[camera.window]
    how = {"method": "nonnegative", "lam": 1e-4}
    image = ms.reconstruct_psf(shots, listed, **how)
    mean = ms.reconstruct_psf(shots, centred.mean(axis=0), **how)
    errors = [float(np.square(each.image - truth).mean()) for each in (image, mean)]
    assert image.focus is None and errors[0] < errors[1] / 10, (str(image.status), errors)
    wrong = load_lights(write(tmp_path, centred, facts), 1).doubt
    assert "not centred" in wrong and "displaced by +0 rows and +0 columns from that of 0.npy" in wrong
    assert "differ by +12 and +6" in wrong
    assert load_lights(write(tmp_path, pictures, facts[::-1]), 1).doubt


def test_weights_are_linear_between_places_and_those_of_the_nearest_edge_outside() -> None:
    """They have sum 1, and give back each point within the triangles (Planted: corners exchanged; nearest corner)."""
    rows, columns = np.linspace(-9, 9, 37), np.linspace(-8, 8, 33)
    for places in ([[-6, -5], [5, -6], [-4, 6], [6, 6], [0, 1]], [[-6, -6], [0, 0], [6, 6]], [[2, 1], [-3, 1]]):
        weights = blend(np.array(places, float), rows, columns)
        assert weights.min() >= 0 and np.abs(weights.sum(axis=0) - 1).max() < 1e-12
        seen = np.stack(np.meshgrid(rows, columns, indexing="ij"))
        nearest = np.tensordot(np.array(places, float).T, weights, axes=1)
        assert np.abs(np.diff(weights, axis=1)).max() < 0.25 and np.abs(np.diff(weights, axis=2)).max() < 0.25
        away = np.linalg.norm(nearest - seen, axis=0)
        if len(places) == 5:
            inside = (np.abs(seen[0]) < 3.5) & (np.abs(seen[1]) < 3.5)
            assert away[inside].max() < 1e-12 and away[0, 0] == pytest.approx(np.hypot(3, 3))
            assert nearest[:, -1, 16] == pytest.approx([5 + 76 / 145, 12 * 76 / 145 - 6])
        else:
            step = (np.array(places[-1]) - places[0]) / np.linalg.norm(np.subtract(places[-1], places[0]))
            along = np.clip(np.tensordot(step, seen, axes=1), *sorted(np.array(places)[[0, -1]] @ step))
            np.testing.assert_allclose(np.tensordot(step, nearest, axes=1), along, atol=1e-12)


PAIR = "depth_mm = 100"


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ([PAIR], "got 1 tables [[psf]]; give 2 to 64"),
        ([PAIR, "place = [1, 2]"], "some have depth_mm and some place"),
        ([PAIR, "depth_mm = 100.0"], "have one depth, 100 mm"),
        ([PAIR, ""], "give depth_mm or place, one of them"),
        ([PAIR, "depth_mm = -5"], "psf.1.depth_mm: got -5; give a number from"),
        ([PAIR, "depth_mm = nan"], "got nan; give a finite number"),
        ([PAIR, 'depth_mm = "5"'], "got '5'; give a number"),
        ([PAIR, "depth_mm = 5\ncolour = 1"], "got 1, no such field; known fields: file, depth_mm, place"),
        (["place = [1, 2]", "place = [1.0, 2.5]"], "less than a pixel apart"),
        (["place = [1, 2]", 'place = ["1", 3]'], "psf.1.place.0: got '1'; give a number"),
        (["place = [1, 2]", "place = [1, 2, 3]"], "at most 2 items"),
        (["place = [1, 2]", "place = [1e9, 2]"], "no light is left"),
        ([PAIR, "depth_mm = 5] ["], "not valid TOML"),
    ],
)
def test_lists_that_are_none_are_refused_in_one_line(tmp_path: Path, facts: list[str], words: str) -> None:
    listed = write(tmp_path, lights(len(facts)), facts)
    with pytest.raises(ms.MitsimError) as refused:
        ms.reconstruct_psf(replace_capture(), listed)
    assert words in str(refused.value) and "\n" not in str(refused.value), refused.value


def replace_capture() -> ms.Capture:
    camera = ps.ShiftedLight(lights(1)[0], SENSOR)
    return record(camera, 100.0 * np.ones(camera.scene))


def test_pictures_of_a_list_are_checked(tmp_path: Path) -> None:
    shots, good = replace_capture(), lights(2)
    colour = np.repeat(good[1][..., None], 3, axis=2)
    for wrong, words in (
        (good[1][:-1], "35 x 38 and 36 x 38 pixels; give one size"),
        (colour, "has 3 channels"),
        (np.where(good[1] > 0, good[1], np.nan), "not finite"),
        (0 * good[1], "nothing is brighter than its edges"),
    ):
        listed = write(tmp_path, good, [PAIR, "depth_mm = 200"])
        np.save(tmp_path / "1.npy", wrong)
        with pytest.raises(ms.MitsimError, match=words):
            ms.reconstruct_psf(shots, listed)
    (tmp_path / "1.npy").unlink()
    with pytest.raises(ms.MitsimError, match=r"1\.npy: cannot be read"):
        ms.reconstruct_psf(shots, listed)


def test_the_preconditioner_of_depths_is_the_inverse_that_is_stated() -> None:
    """On scenes as large as the grid. (Planted: the shared power twice; another sign.)"""
    camera = ps.ShiftedLight(lights(2)[:, 12:23, 13:24], (10, 10))
    assert camera.grid == camera.scene[1:] == (20, 20)
    scene, light = np.random.default_rng(0).normal(size=camera.scene), np.fft.fft2(camera.psf, camera.grid)
    seen = np.fft.fft2(scene)
    bend = 2 - 2 * np.cos(2 * np.pi * np.arange(20) / 20)
    own = np.square(camera.psf).sum() / 2 + 0.3 + 0.1 * (bend[:, None] + bend + 2)
    mixed = np.fft.ifft2(own * seen + light.conj() * (light * seen).sum(axis=0)).real
    np.testing.assert_allclose(camera.preconditioner(0.3, 0.1)(mixed), scene, atol=1e-12)
