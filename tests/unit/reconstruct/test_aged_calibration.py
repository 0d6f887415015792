"""A calibration that has aged, moved until frames of known pictures fit: a mask that was moved comes back by as much as
it was moved, in the closed form of its shadow; what is no such move is flagged or refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsim import calibrate_known, load_calibration, reconstruct
from mitsim.core.arrays import FloatArray
from mitsim.core.errors import MitsimError
from mitsim.core.manifests import MANIFEST, Parallax
from mitsim.devices.camera import centred_edges
from mitsim.devices.mask import mls_mask
from mitsim.metrics import psnr
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.solution import Verdict
from tests.ideal_sessions import CALIBRATION_ERROR, Bench, picture
from tests.known_camera import PLANES, KnownCamera, write_known
from tests.shadow_factor import scene_factor

N, PIXELS, PITCH, DISTANCE, DEPTH, WIDTH = 32, 128, 0.015, 2.0, 400.0, 120.0
PARALLAX = Parallax(
    depth_mm=DEPTH, row_tan=(-0.15, 0.15), column_tan=(-0.15, 0.15), row_mm=(0.0, 0.0), column_mm=(0.0, 0.0),
    pixel_pitch_mm=PITCH, mask_distance_mm=DISTANCE,
)  # fmt: skip
SMALL = {"mask_rows_um": 0.4, "mask_columns_um": 0.3, "mask_axis_um": 2.0}
"""As calibration/drift.toml has them."""
LARGE = {"mask_rows_um": 4.0, "mask_columns_um": -2.0, "mask_axis_um": -10.0}


def shadow(moved_um: float, axis_um: float) -> FloatArray:
    """(128, 32) closed form of the shadow of a mask that has moved."""
    distance = DISTANCE + 1e-3 * axis_um
    edges = centred_edges(PIXELS, PITCH) - 1e-3 * moved_um / (1 - distance / DEPTH)
    scene = centred_edges(N, WIDTH / N)
    return np.asarray(scene_factor(mls_mask().terms[0][1], 0.06, edges, scene, distance, DEPTH))


def camera_of(drift: dict[str, float], light: float = 1.0) -> Bench:
    rows, columns = (shadow(drift[f"mask_{axis}_um"], drift["mask_axis_um"]) for axis in ("rows", "columns"))
    return Bench(rows, columns, optics=lambda seen: light * seen)


STILL = dict.fromkeys(SMALL, 0.0)


@dataclass
class Aged:
    """A camera that was calibrated and then moved, in a ``folder``: its CAL and a list of two pictures.

    Random numbers are pictures that all of the shadow is told by.
    """

    folder: Path
    seed: int
    drift: dict[str, float]
    light: float = 1.0
    error: float = CALIBRATION_ERROR

    def __post_init__(self) -> None:
        self.now = camera_of(self.drift, self.light)
        old = camera_of(STILL).calibrated(self.seed, self.error)
        self.old = replace(old, manifest=old.manifest.model_copy(update={"parallax": PARALLAX}))
        self.folder.mkdir(exist_ok=True)
        self.old.save(self.folder / "cal")
        runs = []
        for number in range(2):
            scene = np.random.default_rng([self.seed, number]).random((N, N))
            self.now.run("uniform", scene, 10 * self.seed + number).save(self.folder / f"run_{number}")
            runs.append({"run": f"run_{number}", "picture": f"run_{number}/truth.exr"})
        self.listed = write_known(self.folder / "known.json", runs)

    def mended(self, output: Path | None = None) -> Factors:
        (factors,) = calibrate_known(self.listed, output, aged=self.folder / "cal").values()
        return factors

    def psnr(self, factors: Factors) -> float:
        """Of a capture that is no part of the list, `dots:4` of a print."""
        scene = picture(self.seed + 100, N)
        image = reconstruct(self.now.run("dots:4", scene, self.seed + 50), factors).image
        return float(psnr(image, scene))


def deviations(factors: Factors, truth: dict[str, float]) -> list[float]:
    """Standard errors by which what was found is off."""
    moved = factors.manifest.result["moved"]
    return [abs(moved[name]["value"] - value) / moved[name]["standard_error"] for name, value in truth.items()]


@pytest.mark.parametrize(("drift", "seed"), [(SMALL, 0), (SMALL, 1), (LARGE, 0), (LARGE, 1), (STILL, 2)])
def test_a_mask_that_has_moved_is_found_and_mended(tmp_path: Path, drift: dict[str, float], seed: int) -> None:
    """Mask by 4 standard errors (of 15 numbers one is beyond by chance once in 1000 times), light to 1e-3; an image of
    a capture that was not fitted is as good as by a new calibration, whose own noise makes some tenths of a decibel.
    (Planted: the sign of the way; the two sides exchanged; a distance that moves nothing over the scene; light left out
    of the new factors.)"""
    aged = Aged(tmp_path, seed, drift, light=0.95)
    factors = aged.mended(tmp_path / "new")
    assert factors.ok, factors.status
    found = deviations(factors, drift)
    assert max(found) < 4, found
    moved = factors.manifest.result["moved"]
    assert moved["light"]["value"] == pytest.approx(0.95, abs=1e-3)
    loaded = load_calibration(tmp_path / "new")
    assert loaded.manifest.parallax is not None
    assert loaded.manifest.parallax.mask_distance_mm == pytest.approx(
        DISTANCE + 1e-3 * moved["mask_axis_um"]["value"], rel=1e-12
    )
    new = aged.now.calibrated(seed + 5)
    new = replace(new, left=0.95 * new.left)
    old, mended = aged.psnr(aged.old), aged.psnr(loaded)
    assert mended > old + 15
    assert mended > aged.psnr(new) - 2


def test_what_was_left_over_is_said_before_and_after(tmp_path: Path) -> None:
    """Before: as the aged factors leave it, light apart. (Planted: both of moved factors.)"""
    aged = Aged(tmp_path, 3, {**LARGE, "mask_rows_um": 6.0})
    result = aged.mended().manifest.result
    assert result["unexplained_before"] > 0.1
    assert result["unexplained_residual"] < 0.01
    assert result["chi_square_before"] > 1.5
    assert result["chi_square"] == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("error", [CALIBRATION_ERROR, 2e-2])
def test_standard_errors_are_those_of_repeated_sessions(tmp_path: Path, error: float) -> None:
    """Eight sessions of a mask that stays, of factors whose own errors are a part of all noise, or most of it: the root
    mean square deviation of 24 numbers, in standard errors, is 1 to 14 % (one standard deviation). (Planted: without
    the factors' errors.)"""
    found = []
    for seed in range(8):
        aged = Aged(tmp_path / f"{seed}", seed, STILL, error=error)
        found += deviations(aged.mended(), STILL)
    assert 0.6 < float(np.sqrt(np.mean(np.square(found)))) < 1.4


def test_a_mask_that_has_moved_by_features_is_found(tmp_path: Path) -> None:
    """By some of them, along both axes; what comes into view at the sensor's edge is flagged.

    (Planted: steps begin at no shift.)
    """
    aged = Aged(tmp_path, 2, {**STILL, "mask_rows_um": -200.0, "mask_columns_um": 150.0})
    factors = aged.mended()
    assert factors.status.verdict == Verdict.NOT_SEPARABLE
    moved = factors.manifest.result["moved"]
    assert moved["mask_rows_um"]["value"] == pytest.approx(-200, rel=0.01)
    assert moved["mask_columns_um"]["value"] == pytest.approx(150, rel=0.01)


def test_without_parallax_the_shadow_is_told_in_pixels(tmp_path: Path) -> None:
    aged = Aged(tmp_path, 1, SMALL)
    replace(aged.old, manifest=aged.old.manifest.model_copy(update={"parallax": None})).save(tmp_path / "bare")
    (factors,) = calibrate_known(aged.listed, aged=tmp_path / "bare").values()
    moved = factors.manifest.result["moved"]
    assert set(moved) == {"shadow_rows", "shadow_columns", "mask_distance", "light"}
    # A mask at 2 of 400 mm casts a shadow that moves by 1 / (1 - 2/400) of its own way.
    for axis in ("rows", "columns"):
        true = SMALL[f"mask_{axis}_um"] / (1e3 * PITCH) / (1 - DISTANCE / DEPTH)
        assert abs(moved[f"shadow_{axis}"]["value"] - true) < 4 * moved[f"shadow_{axis}"]["standard_error"]


@pytest.mark.parametrize("mosaic", PLANES)
def test_all_planes_of_a_sensor_move_together(tmp_path: Path, mosaic: str) -> None:
    """Codes that were found from two pictures, then pixels that lie a quarter and a half of one further on: the shadow
    moves as far back. (Planted: factors of the first plane for all.)"""
    from tests.unit.reconstruct.test_known_pictures import with_planes

    camera = KnownCamera(6)
    (tmp_path / "old").mkdir()
    before = calibrate_known(with_planes(camera, tmp_path / "old", mosaic), tmp_path / "cal")
    scene = np.stack([camera.picture() for _ in "rgb"], axis=2)
    camera.write_planes(tmp_path / "run", scene, mosaic, further=(0.25, 0.5))
    Image.fromarray(np.rint(255 * scene).astype(np.uint8)).save(tmp_path / "scene.png")
    listed = write_known(tmp_path / "known.json", [{"run": "run", "picture": "scene.png"}])
    after = calibrate_known(listed, tmp_path / "new", aged=tmp_path / "cal")
    assert set(before) == set(after) == set(PLANES[mosaic])
    moved = after["r"].manifest.result["moved"]
    assert moved["shadow_rows"]["value"] == pytest.approx(-0.25, abs=0.03)
    assert moved["shadow_columns"]["value"] == pytest.approx(-0.5, abs=0.03)


# ---- What is flagged ----


def test_frames_of_another_mask_are_flagged(tmp_path: Path) -> None:
    aged = Aged(tmp_path, 4, STILL)
    aged.now = Bench(aged.now.left[::-1], aged.now.right)
    scene = np.random.default_rng(0).random((N, N))
    aged.now.run("uniform", scene, 7).save(tmp_path / "other")
    write_known(aged.listed, [{"run": "other", "picture": "other/truth.exr"}])
    factors = aged.mended()
    assert factors.status.verdict in (Verdict.NOT_CONVERGED, Verdict.NOT_SEPARABLE)
    assert str(factors.status) in factors.warnings


def test_runs_of_other_pictures_are_flagged(tmp_path: Path) -> None:
    """(Planted: a status whatever is left over.)"""
    aged = Aged(tmp_path, 5, SMALL)
    write_known(aged.listed, [{"run": f"run_{k}", "picture": f"run_{1 - k}/truth.exr"} for k in (0, 1)])
    factors = aged.mended()
    assert factors.status.verdict in (Verdict.NOT_CONVERGED, Verdict.NOT_SEPARABLE)
    assert str(factors.status) in factors.warnings


def test_a_mask_that_has_come_off_is_flagged(tmp_path: Path) -> None:
    """A fifth of the sensor; an eighth is looked for."""
    factors = Aged(tmp_path, 6, {**STILL, "mask_rows_um": 0.2 * PIXELS * PITCH * 1e3}).mended()
    assert not factors.ok
    assert factors.status.verdict in (Verdict.NOT_CONVERGED, Verdict.NOT_SEPARABLE)


# ---- What is refused ----


def with_camera(folder: Path) -> None:
    for place in (folder / f"run_{number}" / MANIFEST for number in (0, 1)):
        place.write_text(json.dumps({**json.loads(place.read_text()), "camera": {"name": "another"}}))


def turned(folder: Path) -> None:
    for number in (0, 1):
        scene = np.random.default_rng([7, number]).random((N, N))
        np.save(folder / f"{number}.npy", scene[::-1, ::-1])
    write_known(folder / "known.json", [{"run": f"run_{k}", "picture": f"{k}.npy"} for k in (0, 1)])


def transposed(folder: Path) -> None:
    for number in (0, 1):
        np.save(folder / f"{number}.npy", np.random.default_rng([7, number]).random((N, N)).T)
    write_known(folder / "known.json", [{"run": f"run_{k}", "picture": f"{k}.npy"} for k in (0, 1)])


def listing(**more: object) -> Callable[[Path], None]:
    return lambda folder: (
        (folder / "known.json").write_text(json.dumps({**json.loads((folder / "known.json").read_text()), **more}))
        and None
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (turned, "the calibration's images lie turned beside these pictures"),
        (transposed, "the calibration's images lie transposed beside these pictures"),
        (with_camera, "name is .*another.*calibrate the run's camera"),
        (listing(orientation="upright"), "orientation is of codes.*leave orientation out"),
        (listing(centre=True), "centre is True, but False in calibration"),
        (listing(known=[{"run": "small", "picture": "small/truth.exr"}]), "16 scene pixels.*has 32"),
    ],
)
def test_lists_that_do_not_fit_the_calibration_are_refused(
    tmp_path: Path, change: Callable[[Path], None], message: str
) -> None:
    """(Planted: no check of orientation; of the camera; of the list's own fields.)"""
    aged = Aged(tmp_path, 7, SMALL)
    small = Bench(aged.now.left[:, :16], aged.now.right[:, :16])
    small.run("uniform", np.random.default_rng(0).random((16, 16)), 3).save(tmp_path / "small")
    change(tmp_path)
    with pytest.raises(MitsimError, match=message):
        aged.mended(tmp_path / "new")
    assert not (tmp_path / "new").exists()
