"""What benches write: mosaics, turned and cropped pictures, numbers in the high bits, dark and flat frames, in a list
or by options; each kind of file becomes the frames that it is of, or is refused in a line.

Pictures are numpy's, of numbers that show which pixel they are of. What turns and corrects them is held against other
libraries and against closed forms.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image, ImageOps
from scipy import ndimage
from skimage.transform import SimilarityTransform, warp
from typer.testing import CliRunner

import mitsim as ms
from mitsim.cli import app
from mitsim.core.colour_files import CALIBRATION, lines_of_planes, write_colours
from mitsim.core.errors import MitsimError
from mitsim.core.images import Preparer, read_image, read_images
from mitsim.core.manifests import Digital
from mitsim.core.picture_files import PLANES, Crop, Preparation, Wanted, planes_of
from mitsim.devices.framelist import load_frames
from mitsim.exchange.capture_list import load_capture_list
from mitsim.exchange.packed import import_capture
from mitsim.reconstruct.captured_session import calibrate_frames
from tests.exchanged import COLUMNS, DIGITAL, ROWS, made
from tests.real_session import RealSession, write_list
from tests.unit.exchange.test_real import ELECTRONICS, known, refused, written

TWELVE = Digital(
    exposure_s=0.02, gain_dn_per_e=0.125, black_level_dn=160, dark_current_e_per_s=4000, saturation_dn=4095, step_dn=1
)


def prepared(values: np.ndarray, base: Path = Path(), **how: Any) -> np.ndarray:
    """The frame of a file's ``values``."""
    made_by = Preparer.of(Preparation(**how), TWELVE, Wanted(), base)
    return made_by.frame(Path("frame.png"), values)


# -------- Planes, orientations, turns, crops


@pytest.mark.parametrize("mosaic", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_planes_are_named_by_the_filters_in_their_rows(mosaic: str) -> None:
    """gb is the green in the rows of blue. (Planted: by columns.)"""
    found = planes_of(mosaic)
    assert [*found] == [*PLANES] and sorted(found.values()) == [(0, 0), (0, 1), (1, 0), (1, 1)]
    for name, (row, column) in found.items():
        assert mosaic[2 * row + column].lower() == name[0]
        assert len(name) == 1 or mosaic[2 * row + 1 - column].lower() == name[1]


@pytest.mark.parametrize("number", range(1, 9))
def test_the_eight_orientations_are_those_of_exif(number: int, tmp_path: Path) -> None:
    """As Pillow shows them; a file that states one is refused. (Planted: 6 and 8 changed places.)"""
    stored = np.arange(12, dtype=np.uint8).reshape(3, 4) * 9
    picture = Image.fromarray(stored)
    picture.getexif()[274] = number
    assert np.array_equal(prepared(stored, orientation=number), np.array(ImageOps.exif_transpose(picture)))
    picture.save(tmp_path / "a.png", exif=picture.getexif())
    for packed in (None, "zlib"):
        tags = [(274, "H", 1, number, True)]
        pages = np.stack([stored, stored + 1]).astype(np.uint16)
        place = tmp_path / f"{packed}.tif"
        tifffile.imwrite(place, pages, photometric="minisblack", compression=packed, extratags=tags)
    for path in tmp_path.iterdir():
        if number != 1:
            with pytest.raises(MitsimError, match=f"has the orientation {number}: .* --orientation 2 to 8"):
                next(read_images(path))
        else:
            assert np.array_equal(next(read_images(path)), stored)


def test_a_plane_is_taken_before_it_is_oriented_and_cropped() -> None:
    """Crops count rows of what is seen. (Planted: the orientation before the plane, which makes red of blue.)"""
    stored = np.arange(80).reshape(8, 10)
    plane = np.rot90(stored[1::2, 0::2], -1)
    found = prepared(stored, channel="gr", orientation=6, crop=Crop(row=1, column=2, rows=3))
    assert np.array_equal(found, plane[1:4, 2:])
    with pytest.raises(MitsimError, match=r"its plane is 5x4, and crop takes rows 1 to 5 and columns 0 to 3"):
        prepared(stored, channel="gr", orientation=6, crop=Crop(row=1, rows=5))
    with pytest.raises(MitsimError, match="crop"):
        prepared(stored, crop=Crop(row=8))


@pytest.mark.parametrize("degrees", [0.1, -7.5, 40.0])
def test_turns_are_those_of_two_other_libraries(degrees: float) -> None:
    """About the middle as scipy.ndimage.rotate, about the first pixel as skimage's warp: counter-clockwise, bilinear.
    (Planted: the other sense; about the corner of the first pixel.)"""
    rng = np.random.default_rng(2)
    stored = rng.integers(200, 3000, (61, 80)).astype(np.uint16)
    part = Crop(row=24, column=30, rows=12, columns=16)
    found = prepared(stored, turn_deg=degrees, crop=part)
    whole = ndimage.rotate(stored.astype(float), degrees, reshape=False, order=1)
    assert found.dtype == np.float32 and np.abs(found - whole[24:36, 30:46]).max() < 1e-3
    if abs(degrees) < 1:
        turned = warp(stored.astype(float), SimilarityTransform(rotation=np.deg2rad(degrees)))
        about = prepared(stored, turn_deg=degrees, turn_about="corner", crop=part)
        assert np.abs(about - turned[24:36, 30:46]).max() < 1e-3


@pytest.mark.parametrize("about", ["centre", "corner"])
def test_a_turn_beyond_the_picture_needs_a_crop(about: str) -> None:
    stored = np.arange(60 * 80, dtype=np.uint16).reshape(60, 80)
    with pytest.raises(MitsimError, match=f"turned by 2 degrees about its {about}, a part of it lies beyond"):
        prepared(stored, turn_deg=2.0, turn_about=about)
    crop = Crop.of("5,5,50,70")
    assert prepared(stored, turn_deg=2.0, turn_about=about, crop=crop).shape == (crop.rows, crop.columns)


# -------- Numbers


def test_what_is_saturated_stays_so_and_nothing_else_becomes_it(tmp_path: Path) -> None:
    """By dark and flat frames and a turn. (Planted: the end of the scale left where it was.)"""
    rng = np.random.default_rng(4)
    response, dark = rng.uniform(0.6, 1.4, (20, 24)), rng.uniform(100, 220, (20, 24))
    written(tmp_path / "dark", "npy", dark[None])
    written(tmp_path / "flat", "npy", (dark + 1500 * response)[None])
    stored = np.full((20, 24), 4094, np.uint16)
    stored[7, 9] = 4095
    how = {"dark": "dark", "flat": "flat"}
    maker = Preparer.of(Preparation(**how), TWELVE, Wanted(), tmp_path)
    full = maker.frame(Path("a"), stored) >= maker.digital.saturation_dn
    assert full.sum() == 1 and full[7, 9]
    turning = Preparation(**how, turn_deg=3.0, crop=Crop(row=4, column=4, rows=12, columns=16))
    maker = Preparer.of(turning, TWELVE, Wanted(), tmp_path)
    turned = maker.frame(Path("a"), stored) >= maker.digital.saturation_dn
    assert 1 <= turned.sum() <= 4 and turned[2:5, 4:7].any()


def test_dark_and_flat_frames_leave_the_light(tmp_path: Path) -> None:
    """Frames of pixels that differ in dark signal and response are those of even pixels, to rounding: the level that
    the camera's file states stays. (Planted: the flat's dark frames not taken off; the whole mean for a plane's.)"""
    rng = np.random.default_rng(5)
    light, colour = rng.uniform(500, 2500, (20, 24)), np.tile([[1.0, 0.5], [0.5, 0.25]], (10, 12))
    response = rng.uniform(0.8, 1.2, (20, 24))
    dark, hot = rng.uniform(100, 220, (20, 24)), rng.uniform(300, 320, (20, 24))
    for name, frames in (("dark", [dark - 3, dark + 3]), ("under", [hot]), ("flat", [hot + 2000 * response * colour])):
        written(tmp_path / name, "npy", np.stack(frames))
    stored = dark + light * response
    how = {"dark": "dark", "flat": "flat", "flat_dark": "under"}
    level = 160 + 4000 * 0.02 * 0.125
    row, column = planes_of("BGGR")["r"]
    own = response[row::2, column::2]
    found = prepared(stored, tmp_path, **how, channel="r")
    assert np.allclose(found, level + light[row::2, column::2] * own.mean(), rtol=1e-6)
    assert np.allclose(prepared(stored, tmp_path, dark="dark"), level + light * response, rtol=1e-6)
    with pytest.raises(MitsimError, match="no more light than its dark frames"):
        prepared(stored, tmp_path, flat="dark", flat_dark="under")
    with pytest.raises(MitsimError, match="is 19x24, but dark frames 20x24"):
        prepared(stored[1:], tmp_path, dark="dark")
    dead = hot + 2000 * response
    dead[3, 5] = hot[3, 5]
    written(tmp_path / "dead", "npy", dead[None])
    maker = Preparer.of(Preparation(**{**how, "flat": "dead"}), TWELVE, Wanted(), tmp_path)
    assert maker.unlit == 1 and maker.frame(Path("a"), stored)[3, 5] == pytest.approx(
        level + light[3, 5] * response[3, 5], rel=1e-6
    )


def twelve(folder: Path) -> str:
    camera = folder / "twelve.toml"
    camera.write_text(ELECTRONICS.replace("bits = 16", "bits = 12"))
    return str(camera)


def test_numbers_in_the_high_bits_are_found_and_named(tmp_path: Path) -> None:
    """12 bits in 16, 8 bits spread over 16 (times 257), in frames and the ambient frame. What a camera writes into the
    first pixels, as DiffuserCam's does, is named. (Planted: the factor of the first frame alone; any number of others
    taken for a stamp.)"""
    bench = made(tmp_path)
    dn = np.minimum(ms.load_run(bench.run).dn, 4095)
    about = replace(known(bench), camera=twelve(tmp_path))
    written(tmp_path / "a", "png", dn * 16)
    np.save(tmp_path / "dark.npy", dn[0] * 16 / 3)
    result = import_capture(
        tmp_path / "a",
        tmp_path / "run a",
        replace(known(bench, ambient=tmp_path / "dark.npy"), camera=twelve(tmp_path)),
    )
    again = ms.load_run(tmp_path / "run a")
    assert np.array_equal(again.dn, dn) and result["divided_by"] == 16 and not result["warnings"]
    assert "divided by 16, because all are multiples of it" in result["notes"][0]
    assert np.allclose(again.read("ambient.exr")[0]["DN"], dn[0] / 3)
    odd = dn * 16
    odd[:, 0, :2] = 24123, 36053
    written(tmp_path / "stamped", "png", odd)
    refused("they were scaled, contain more than light", tmp_path, tmp_path / "stamped", about)
    for frames in (slice(-1, None), slice(None)):
        odd = dn * 16
        odd[frames, 1] += 1
        written(tmp_path / f"odd {frames.start}", "png", odd)
        refused("they were scaled", tmp_path, tmp_path / f"odd {frames.start}", about)
    eight = tmp_path / "eight.toml"
    eight.write_text(ELECTRONICS.replace("bits = 16", "bits = 8"))
    written(tmp_path / "b", "png", dn // 16 * 257)
    about = replace(known(bench, black_level_dn=10.0), camera=str(eight))
    result = import_capture(tmp_path / "b", tmp_path / "run b", about)
    assert np.array_equal(ms.load_run(tmp_path / "run b").dn, dn // 16) and result["divided_by"] == 257


def test_a_factor_within_the_cameras_range_is_doubted_unless_it_is_stated(tmp_path: Path) -> None:
    """Nobody knows whether the camera counts so."""
    bench = made(tmp_path)
    dn = ms.load_run(bench.run).dn // 4
    written(tmp_path / "a", "png", dn * 4)
    result = import_capture(tmp_path / "a", tmp_path / "run a", known(bench))
    assert "multiples of 4, and are used unchanged" in result["warnings"][0] and result["divided_by"] == 1
    for factor, kept in ((4, dn), (2, 2 * dn), (1, 4 * dn)):
        about = known(bench, prepare=Preparation(divide_by=factor))
        result = import_capture(tmp_path / "a", tmp_path / f"by {factor}", about)
        assert not result["warnings"] and np.array_equal(ms.load_run(tmp_path / f"by {factor}").dn, kept)
    refused("the numbers' common factor is 4", tmp_path, tmp_path / "a", known(bench, prepare=Preparation(divide_by=8)))


# -------- Folders: all planes, sessions, lists


def coloured(folder: Path) -> tuple[Path, np.ndarray, dict[str, np.ndarray]]:
    """Frames of a mosaic of 2 ROWS x 2 COLUMNS pixels, whose planes are the run's frames, each of another brightness;
    and a calibration of all planes."""
    bench, colours = made(folder / "bench"), lines_of_planes(CALIBRATION, (610.0, 550.0, 450.0))
    dn, scale = ms.load_run(bench.run).dn, {"r": 1.0, "gb": 0.5, "gr": 0.25, "b": 0.75}
    planes = {name: np.rint((dn - 200) * part + 200).astype(int) for name, part in scale.items()}
    mosaic = np.zeros((len(dn), 2 * ROWS, 2 * COLUMNS), int)
    for name, (row, column) in planes_of("GRBG").items():
        mosaic[:, row::2, column::2] = planes[name]
        ms.load_calibration(bench.calibration).save(folder / "cals" / name)
    write_colours(folder / "cals", colours)
    return folder / "cals", mosaic, planes


def test_all_planes_are_a_coloured_run_with_one_colour_image(tmp_path: Path) -> None:
    """By a list as an editor of Windows begins it. (Planted: its byte order mark taken for a word.)"""
    (tmp_path / "cals").mkdir()
    calibration, mosaic, planes = coloured(tmp_path)
    written(tmp_path / "frames", "png", mosaic)
    (tmp_path / "camera.toml").write_text(ELECTRONICS)
    (tmp_path / "list.toml").write_text(
        '\ufeffpatterns = "dots:2x3"\n[prepare]\nchannel = "all"\nmosaic = "GRBG"\n'
        "wavelengths_nm = [610.0, 550.0, 450.0]\n"
    )
    words = f"import {tmp_path / 'frames'} -o {tmp_path / 'run'} --list {tmp_path / 'list.toml'} --exposure 0.0213"
    words += f" --camera {tmp_path / 'camera.toml'} --calibration {calibration} --json"
    result = CliRunner().invoke(app, words.split())
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["planes"] == [*PLANES] and found["frames"] == 24 and found["shape"] == [ROWS, COLUMNS]
    for name in PLANES:
        assert np.array_equal(ms.load_run(tmp_path / "run" / name).dn, planes[name])
    result = CliRunner().invoke(app, f"reconstruct {tmp_path / 'run'} --calibration {calibration} --json".split())
    assert result.exit_code in (0, 1), result.output
    assert (tmp_path / "run" / "reconstruction" / "image.png").is_file()
    assert [each["name"] for each in json.loads(result.stdout)["channels"]] == [*PLANES]
    other = lines_of_planes(CALIBRATION, (600.0, 540.0, 460.0))
    write_colours(calibration, other)
    result = CliRunner().invoke(app, words.replace("/run ", "/run2 ").split())
    assert "its lines are" in str(result.exception) and not (tmp_path / "run2").exists()


def test_a_session_of_a_mosaic_is_calibrated_plane_by_plane(tmp_path: Path) -> None:
    """Numbers in the high bits, turned by a half: factors are those of the plain session. (Planted: planes
    exchanged.)"""
    session = RealSession()
    plain = session.write(tmp_path / "plain")
    folder = tmp_path / "mosaic"
    folder.mkdir()
    for path in plain.glob("*.png"):
        frame = np.rot90(read_image(path).astype(np.uint16), 2) * 16
        mosaic = np.repeat(np.repeat(frame, 2, 0), 2, 1)
        mosaic[0::2, 0::2] = frame // 2 // 16 * 16
        Image.fromarray(mosaic).save(folder / path.name)
    write_list(folder, prepare={"channel": "all", "orientation": 3})
    result = CliRunner().invoke(app, f"calibrate --frames {folder} -o {tmp_path / 'cals'} --json".split())
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert [each["name"] for each in found["channels"]] == [*PLANES]
    assert found["channels"][0]["divided_by"] == 16
    factors = calibrate_frames(plain)
    for name in ("r", "gr", "gb"):
        own = ms.load_calibration(tmp_path / "cals" / name)
        assert np.allclose(own.left, factors.left, rtol=1e-5) and own.manifest.camera == {
            "name": "bench 3",
            "channel": name,
        }
    assert not np.allclose(ms.load_calibration(tmp_path / "cals" / "b").left, factors.left, rtol=0.1)
    write_list(folder, prepare={"channel": "gr", "orientation": 3})
    assert np.allclose(calibrate_frames(folder).left, factors.left, rtol=1e-5)


LISTS = {
    "a camera's name": ("imx249", "no shipped list has that name; shipped lists are diffusercam, flatcam"),
    "a camera's file": ("full_well_e = 1e4\n", "is a camera's file; give it to --camera"),
    "a session's list": ('signed_capture = "pair"\n', "is the list of a calibration's frames"),
    "a mistyped field of prepare": ("[prepare]\nturn = 1.0\n", "list.toml: prepare.turn: .* did you mean turn_deg"),
    "no TOML": ("patterns = dots\n", "not valid TOML"),
    "a plane of no mosaic": ('[prepare]\nchannel = "green"\n', "prepare.channel: got 'green'; give 'r'"),
    "a quarter turn": ("[prepare]\nturn_deg = 90.0\n", r"prepare.turn_deg: got 90.0; give a number from -45 to 45"),
    "a flat's dark alone": ('[prepare]\nflat_dark = "a"\n', "flat_dark is taken off a flat; give flat too"),
    "numbers of no camera": (
        "digital = {exposure_s = 1.0, gain_dn_per_e = 1.0, black_level_dn = 0.0, dark_current_e_per_s = 0.0}\n",
        "digital is of a camera; give camera, its name, too",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LISTS)
def test_a_lists_mistake_is_told_with_its_cause(name: str, tmp_path: Path) -> None:
    text, words = LISTS[name]
    path = tmp_path / "list.toml"
    path.write_text(text)
    with pytest.raises(MitsimError, match=words):
        load_capture_list(text if name == "a camera's name" else path)


def test_a_sessions_list_says_what_is_wrong(tmp_path: Path) -> None:
    """Files that do not count, names with a folder, and one that is nearly right."""
    folder = RealSession().write(tmp_path / "frames", name="f_{}.png".format)
    (folder / "f_3.png").rename(folder / "f_3.jpg")
    with pytest.raises(MitsimError, match=r"holds 15 frames, .* \(not counted: f_3\.jpg\)"):
        load_frames(folder)
    (folder / "f_3.jpg").rename(folder / "F_3.png")
    shown = [{"side": s, "index": i, "sign": sign} for s, i, sign, _ in RealSession().shown("pair")]
    write_list(folder, frames=[{"file": f"f_{number}.png", **each} for number, each in enumerate(shown)])
    with pytest.raises(MitsimError, match=r"f_3\.png is listed, but no file of that name is there; did you mean"):
        load_frames(folder)
    write_list(folder, frames=[{"file": "frames/f_0.png", **shown[0]}])
    with pytest.raises(MitsimError, match=r"frames\.0\.file: got 'frames/f_0.png'; give a name without folders"):
        load_frames(folder)


def test_a_list_says_what_options_do_not(tmp_path: Path) -> None:
    """Paths are from its folder; an option takes the place of what it says. (Planted: paths from where the command
    runs.)"""
    bench = made(tmp_path)
    dn = ms.load_run(bench.run).dn
    written(tmp_path / "frames", "png", dn)
    folder = tmp_path / "lists"
    folder.mkdir()
    written(folder / "dark", "npy", dn[:2] / 4)
    stated = {
        "camera": "bench 3",
        "bits": 16,
        "digital": DIGITAL.model_dump(exclude_none=True),
        "patterns": "dots:2x3",
        "ambient": "dark",
        "prepare": {"orientation": 3},
    }
    (folder / "list.json").write_text(json.dumps(stated))
    words = f"import {tmp_path / 'frames'} --list {folder / 'list.json'} --calibration {bench.calibration} --json"
    result = CliRunner().invoke(app, f"{words} --orientation 1 -o {tmp_path / 'run2'}".split())
    assert result.exit_code == 0, result.output
    again = ms.load_run(tmp_path / "run2")
    assert np.array_equal(again.dn, dn) and again.ambient is not None and again.ambient.shots == 2
    assert again.manifest.camera == ms.load_run(bench.run).manifest.camera
    result = CliRunner().invoke(app, f"{words} -o {tmp_path / 'run3'}".split())
    assert np.array_equal(ms.load_run(tmp_path / "run3").dn, dn[:, ::-1, ::-1])
    stated["centre"] = True
    (folder / "list.json").write_text("\ufeff" + json.dumps(stated))
    result = CliRunner().invoke(app, f"{words} -o {tmp_path / 'run4'}".split())
    assert "its centre is false, and the list's true" in str(result.exception)
