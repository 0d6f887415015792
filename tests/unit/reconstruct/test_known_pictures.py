"""Factors by captures of known pictures: codes that were planted come back, within the error that is stated, however
the pictures lie; lists and pictures that do not fit are refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsim import calibrate_known, load_calibration, load_run, reconstruct
from mitsim.core.colour_files import CALIBRATION, read_colours
from mitsim.core.errors import MitsimError
from mitsim.core.exr import write_frame
from mitsim.core.images import ORIENTATIONS, Preparer, orient
from mitsim.core.manifests import Digital
from mitsim.core.picture_files import Preparation
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.known_pictures import guess_noise, plane_offsets
from mitsim.reconstruct.solver import Verdict
from tests.known_camera import PLANES, SCALES, KnownCamera, factor_error, write_known


def one(listed: Path, output: Path | None = None) -> Factors:
    (factors,) = calibrate_known(listed, output).values()
    return factors


def error_of(factors: Factors, camera: KnownCamera) -> float:
    return float(np.hypot(*factor_error((factors.left, factors.right), camera.factors())))


@pytest.mark.parametrize(
    ("pictures", "patterns", "light"), [(3, "uniform", 3e4), (1, "dots:3", 3e4), (6, "uniform", 3e3)]
)
def test_planted_codes_come_back(tmp_path: Path, pictures: int, patterns: str, light: float) -> None:
    """Some 60 effective numbers a side: the error's own spread is 10 %. Scales that are fitted too add to it."""
    camera = KnownCamera(1, light)
    factors = one(camera.write_session(tmp_path, pictures, patterns=patterns, terms=1))
    result = factors.manifest.result
    assert factors.ok
    assert result["orientation"] == "upright"
    assert result["scale"] == pytest.approx(SCALES, rel=3e-3)
    assert 0.6 < error_of(factors, camera) / result["predicted_phi_error"] < 1.5
    assert result["chi_square"] == pytest.approx(1, abs=0.05)
    assert min(result["rank"]) >= 10


@pytest.mark.parametrize("name", ["mirrored", "upside down"])
def test_pictures_may_lie_any_way_and_images_lie_as_they_do(tmp_path: Path, name: str) -> None:
    camera, turn = KnownCamera(2), partial(orient, orientation=ORIENTATIONS[name])
    factors = one(camera.write_session(tmp_path, 3, turn), tmp_path / "cal")
    assert factors.manifest.result["orientation"] == name
    assert factors.manifest.result["orientation_margin"] > 0.004
    scene = camera.picture()
    run = camera.write_run(tmp_path / "other", scene, "dots:2", turn=turn)
    image = reconstruct(load_run(run), load_calibration(tmp_path / "cal")).image
    assert np.corrcoef(image.ravel(), scene.ravel())[0, 1] > 0.8


def test_transposed_pictures_are_refused_by_what_to_do(tmp_path: Path) -> None:
    listed = KnownCamera(2).write_session(tmp_path, 3, partial(orient, orientation=6))
    with pytest.raises(MitsimError, match=r"lie transposed.* before the camera.*save the pictures transposed"):
        one(listed, tmp_path / "cal")
    assert not (tmp_path / "cal").exists()


@pytest.mark.parametrize(("falloff", "terms"), [(0.0, 1), (0.3, 2)])
def test_held_out_frames_tell_how_many_codes_there_are(tmp_path: Path, falloff: float, terms: int) -> None:
    """A code that loses 30 % from the middle to an edge, and gains as much to the other, is two: c(x) and i c(x)."""
    camera = KnownCamera(5, falloff=falloff)
    factors = one(camera.write_session(tmp_path, 6, orientation="upright"))
    assert factors.manifest.result["terms"] == terms
    assert error_of(factors, camera) < 0.1


def test_all_planes_of_a_sensor_make_one_coloured_calibration(tmp_path: Path) -> None:
    """(Planted: places of BGGR for all mosaics.)"""
    mosaic, camera = "RGGB", KnownCamera(6)
    found = calibrate_known(with_planes(camera, tmp_path, mosaic), tmp_path / "cal")
    assert set(read_colours(tmp_path / "cal", CALIBRATION).names) == set(PLANES[mosaic]) == set(found)
    for name, offset in PLANES[mosaic].items():
        loaded = load_calibration(tmp_path / "cal" / name)
        error = factor_error((loaded.left, loaded.right), camera.factors(offset))
        assert np.hypot(*error) < 1.5 * loaded.manifest.result["predicted_phi_error"], name
    other = next(offset for offset in PLANES[mosaic].values() if offset != PLANES[mosaic]["r"])
    straight = factor_error((found["r"].left, found["r"].right), camera.factors(other))
    assert np.hypot(*straight) > 0.1, "half a pixel aside is another factor"


@pytest.mark.parametrize("orientation", range(1, 9))
def test_planes_lie_as_the_frames_were_turned(orientation: int) -> None:
    """A sensor of 4 x 4 pixels, all of it turned, against planes that were turned each alone: the first pixel of each
    lies where its filter is in the first cell. (Planted: the mosaic's own places, orientation or not.)"""
    sensor = np.array([["b", "gb"] * 2, ["gr", "r"] * 2] * 2)
    turned = orient(sensor, orientation)
    for name, place in plane_offsets(Preparation(channel="all", orientation=orientation)).items():
        assert turned[int(2 * place[0]) :: 2, int(2 * place[1]) :: 2].tolist() == [[name] * 2] * 2


def with_planes(camera: KnownCamera, folder: Path, mosaic: str = "BGGR", **more: object) -> Path:
    """A list of two pictures, all planes of each."""
    runs = []
    for number in range(2):
        picture = np.stack([camera.picture() for _ in "rgb"], axis=2)
        camera.write_planes(folder / f"run_{number}", picture, mosaic)
        Image.fromarray(np.rint(255 * picture).astype(np.uint8)).save(folder / f"{number}.png")
        runs.append({"run": f"run_{number}", "picture": f"{number}.png"})
    return write_known(folder / "known.json", runs, **{"terms": 1, **more})


@pytest.mark.parametrize(
    "how", [{"turn_deg": 10.0, "crop": {"row": 100, "column": 100, "rows": 400, "columns": 400}}, {}]
)
def test_noise_of_turned_frames_is_what_interpolation_leaves(how: dict) -> None:
    """White noise, seed 0, turned as by an import: its guessed variance is right to 2 %, because a quarter of a million
    numbers tell a variance to 0.3 %. (Planted: differences of neighbours.)"""
    digital = Digital(exposure_s=1.0, gain_dn_per_e=1.0, black_level_dn=0.0, dark_current_e_per_s=0.0)
    white = np.random.default_rng(0).standard_normal((640, 660))
    frame = Preparer(Preparation.model_validate(how), digital).frame(Path("white"), white).astype(float)
    assert guess_noise(frame) == pytest.approx(frame.var(), rel=0.02)


def test_the_angle_of_turned_frames_goes_with_the_calibration(tmp_path: Path) -> None:
    """An import that names the calibration is held against it. (Planted: looked for beside the preparation.)"""
    camera = KnownCamera(12)
    picture = camera.picture()
    camera.write_run(tmp_path / "run", picture, prepare={"turn_deg": 0.5})
    np.save(tmp_path / "picture.npy", picture)
    runs = [{"run": "run", "picture": "picture.npy"}]
    factors = one(write_known(tmp_path / "known.json", runs, orientation="upright", scale=SCALES, terms=1))
    assert factors.manifest.configuration["turn_deg"] == 0.5


# ---- What is flagged ----


def test_runs_of_other_pictures_are_flagged(tmp_path: Path) -> None:
    listed = KnownCamera(7).write_session(tmp_path, 4, orientation="upright")
    for number in range(4):
        (tmp_path / f"picture_{number}.png").rename(tmp_path / f"old_{number}.png")
    for number in range(4):
        (tmp_path / f"old_{number}.png").rename(tmp_path / f"picture_{(number + 1) % 4}.png")
    factors = one(listed)
    assert factors.status.verdict in (Verdict.NOT_SEPARABLE, Verdict.MOSTLY_NOISE)
    assert f"{factors.status.sentence}; {factors.status.remedy}" in factors.warnings


def test_symmetric_pictures_do_not_tell_how_they_lie(tmp_path: Path) -> None:
    camera = KnownCamera(8)
    half = camera.picture()
    picture = (half + half[:, ::-1]) / 2
    camera.write_run(tmp_path / "run", picture)
    np.save(tmp_path / "picture.npy", picture)
    listed = write_known(tmp_path / "known.json", [{"run": "run", "picture": "picture.npy"}])
    assert any(text.startswith("orientation: ") for text in one(listed).warnings)


def test_saturated_frames_are_named(tmp_path: Path) -> None:
    camera = KnownCamera(9)
    listed = camera.write_session(tmp_path, 2, orientation="upright", terms=1)
    picture = np.asarray(Image.open(tmp_path / "picture_0.png")) / 255
    camera.write_run(tmp_path / "bright", picture, saturation_dn=9000.0)
    fields = json.loads(listed.read_text())
    write_known(listed, [{"run": "bright", "picture": "picture_0.png"}, *fields["known"]], terms=1)
    factors = one(listed)
    assert any("saturation: 1 runs have readings" in text and "bright" in text for text in factors.warnings)


# ---- What is refused ----


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda fields: fields.update(known=[]), "known"),
        (lambda fields: fields.update(gama=2), "gama"),
        (lambda fields: fields.update(terms=9), "terms"),
        (lambda fields: fields["known"].append(fields["known"][0]), "is there twice"),
        (lambda fields: fields["known"].append({"run": "none", "picture": "picture_0.png"}), "no such folder"),
        (lambda fields: fields["known"].append({"run": "small", "picture": "none.png"}), "none.png"),
        (lambda fields: fields["known"][0].update(picture="tiny.npy"), "is 4 x 4 pixels"),
        (lambda fields: fields["known"][0].update(picture="colour.png"), "is in colour"),
        (lambda fields: (fields["known"][0].update(picture="negative.npy"), fields.update(gamma=2.2)), "below 0"),
        (lambda fields: fields["known"][0].update(run="other"), "of another camera"),
        (lambda fields: fields["known"][0].update(picture="black.npy"), "dark or uniform"),
        (lambda fields: fields["known"][1].update(run="cropped"), "imported with another crop"),
    ],
)
def test_lists_that_do_not_fit_are_refused(tmp_path: Path, change: Callable[[dict], None], message: str) -> None:
    camera = KnownCamera(10)
    listed = camera.write_session(tmp_path, 2, orientation="upright", terms=1)
    camera.write_run(tmp_path / "other", camera.picture())
    manifest = json.loads((tmp_path / "other" / "manifest.json").read_text())
    (tmp_path / "other" / "manifest.json").write_text(json.dumps({**manifest, "camera": {"name": "another"}}))
    camera.write_run(tmp_path / "small", camera.picture())
    camera.write_run(tmp_path / "cropped", camera.picture(), prepare={"crop": {"row": 1}})
    for name, values in (("tiny", np.ones((4, 4))), ("negative", -np.ones((20, 20))), ("black", np.zeros((20, 20)))):
        np.save(tmp_path / f"{name}.npy", values)
    Image.fromarray(np.zeros((20, 20, 3), np.uint8)).save(tmp_path / "colour.png")
    fields = json.loads(listed.read_text())
    change(fields)
    if message == "of another camera":
        fields["known"].reverse()
    if message == "dark or uniform":
        fields["known"] = fields["known"][:1]
    listed.write_text(json.dumps(fields))
    with pytest.raises(MitsimError, match=message):
        one(listed, tmp_path / "cal")
    assert not (tmp_path / "cal").exists()


def test_a_truth_is_a_picture(tmp_path: Path) -> None:
    """As `mitsim capture` writes it: a channel of reflectance beside its standard error."""
    camera = KnownCamera(11)
    picture = camera.picture()
    camera.write_run(tmp_path / "run", picture)
    channels = {"reflectance": picture.astype(np.float32), "standard_error": np.zeros((20, 20), np.float32)}
    write_frame(tmp_path / "truth.exr", channels, {})
    runs = [{"run": "run", "picture": "truth.exr"}]
    listed = write_known(tmp_path / "known.json", runs, orientation="upright", scale=SCALES)
    assert error_of(one(listed), camera) < 1


@pytest.mark.parametrize("method", ["markov", "tv"])
def test_an_image_has_no_more_directions_than_its_calibration_states(method: str, tmp_path: Path) -> None:
    """One dim picture tells some directions of the codes alone; under nine patterns the same factors tell all.
    (Planted: the rank of the factors' own numbers.)"""
    camera = KnownCamera(4, light=300.0)
    factors = one(camera.write_session(tmp_path / "cal", 1, orientation="upright", terms=1))
    rows, columns = factors.manifest.result["rank"]
    assert rows * columns < 400 and factors.stated_rank == (rows, columns)
    lacking = "directions are not measured above the calibration's noise"
    runs = (camera.write_run(tmp_path / name, camera.picture(), name) for name in ("uniform", "dots:3"))
    even, dots = (str(reconstruct(load_run(run), factors, method=method).status) for run in runs)
    assert f"{400 - rows * columns} of 400 {lacking}" in even
    assert 3 * rows >= 20 <= 3 * columns and lacking not in dots
