"""Frames of a real camera: read as they were written, put under the right pattern, or refused in a line.

The frames are numpy's, of a camera and a scene of which nothing is square; what a file's reader may do to numbers
(scale, invert, swap bytes) is tried on numbers that would show it. The last file may close, and orders bring files to
the right shots.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

import mitsim as ms
from mitsim.core.errors import MitsimError
from mitsim.core.exr import write_frame
from mitsim.core.manifests import CalibrationManifest
from mitsim.core.picture_files import Preparation, Raw, Wanted
from mitsim.devices.patterns import shot_orders
from mitsim.exchange import packed
from mitsim.exchange.capture_list import CaptureList, RealCapture
from mitsim.exchange.formats import export, import_frames, pattern_pictures
from mitsim.exchange.packed import LEFT_OUT, import_capture
from mitsim.reconstruct.factors import Factors
from mitsim.reconstruct.solver import Status, Verdict
from tests.exchanged import COLUMNS, DIGITAL, ROWS, SCENE, Made, bytes_of, made
from tests.unit.devices.test_shot_orders import in_order

ELECTRONICS = f"""
name = "bench 3"
pixel_pitch_um = 5.0
full_well_e = 100000.0
read_noise_e = {DIGITAL.read_noise_e}
dark_current_e_per_s = {DIGITAL.dark_current_e_per_s}
quantum_efficiency = 0.5
gain_dn_per_e = {DIGITAL.gain_dn_per_e}
black_level_dn = {DIGITAL.black_level_dn}
bits = 16
source = "made up"
"""


def known(
    bench: Made, patterns: str = "dots:2x3", black_level_dn: float | None = None, **listed: object
) -> RealCapture:
    camera = bench.run.parent / "camera.toml"
    camera.write_text(ELECTRONICS)
    said = CaptureList(patterns=patterns).model_copy(update=listed)
    return RealCapture(said, str(camera), DIGITAL.exposure_s, bench.calibration, black_level_dn)


def written(folder: Path, kind: str, frames: np.ndarray) -> RealCapture | None:
    """Frames as a real camera's program writes them: shot 10 comes after shot 9."""
    folder.mkdir()
    for index, frame in enumerate(frames):
        stem = folder / f"shot {index + 5}"
        if kind == "raw":
            frame.astype(">u2").tofile(f"{stem}.raw")
        elif kind == "npy":
            np.save(f"{stem}.npy", frame)
        elif kind == "exr":
            write_frame(f"{stem}.exr", {"DN": frame.astype(np.uint32)}, {})
        elif kind == "big-endian tiff":
            values = Image.frombytes("I;16B", frame.shape[::-1], frame.astype(">u2").tobytes())
            values.save(f"{stem}.tif")
        else:
            Image.fromarray(frame.astype(np.uint16)).save(f"{stem}.{kind}")


@pytest.mark.parametrize("kind", ["png", "tif", "big-endian tiff", "npy", "exr", "raw"])
def test_frames_give_the_image_of_the_run_that_they_are_of(kind: str, tmp_path: Path) -> None:
    """To the bit. (Planted: files in the order of the alphabet; bytes of a number changed places.)"""
    bench = made(tmp_path)
    shots = ms.load_run(bench.run)
    written(tmp_path / "frames", kind, shots.dn)
    raw = Raw.of(f"{ROWS}x{COLUMNS}", 16, "big") if kind == "raw" else None
    result = import_capture(tmp_path / "frames", tmp_path / "run 2", known(bench, raw=raw))
    again, factors = ms.load_run(tmp_path / "run 2"), ms.load_calibration(bench.calibration)
    assert result["left_out"] == list(LEFT_OUT) and result["shape"] == [ROWS, COLUMNS] and result["frames"] == 6
    assert np.array_equal(again.dn, shots.dn) and again.dn.dtype == np.uint32
    assert again.truth is None and again.electrons is None and again.plan is None
    assert all(len(value) == 64 for value in again.manifest.checksums.values()) and len(again.manifest.checksums) == 6
    assert again.manifest.digital == shots.manifest.digital.model_copy(
        update={"step_dn": 1.0, "saturation_dn": float(np.floor(1e5 * DIGITAL.gain_dn_per_e + DIGITAL.black_level_dn))}
    )
    assert np.array_equal(ms.reconstruct(again, factors).image, ms.reconstruct(shots, factors).image)


def test_signed_pairs_come_as_they_are_shown(tmp_path: Path) -> None:
    """The positive half first, as patterns are drawn; the order of the files decides."""
    bench = made(tmp_path, signed=True)
    shots = ms.load_run(bench.run)
    swapped = shots.dn[np.array([1, 0, 3, 2, 5, 4, 7, 6])]  # the run has the negative half first
    written(tmp_path / "frames", "npy", swapped)
    import_capture(tmp_path / "frames", tmp_path / "run 2", known(bench, "hadamard:2"))
    images = [
        ms.reconstruct(ms.load_run(run), ms.load_calibration(bench.calibration)).image
        for run in (bench.run, tmp_path / "run 2")
    ]
    assert np.array_equal(*images)


def test_frames_with_the_projector_off_are_taken_off(tmp_path: Path) -> None:
    bench = made(tmp_path, ambient=True)
    shots = ms.load_run(bench.run)
    written(tmp_path / "frames", "png", shots.dn)
    rng = np.random.default_rng(3)
    dark = rng.integers(100, 900, (4, ROWS, COLUMNS))
    written(tmp_path / "dark", "png", dark)
    import_capture(tmp_path / "frames", tmp_path / "run 2", known(bench, ambient=tmp_path / "dark"))
    again = ms.load_run(tmp_path / "run 2")
    assert again.ambient is not None and again.ambient.shots == 4
    assert np.array_equal(again.read("ambient.exr")[0]["DN"], dark.mean(axis=0).astype(np.float32))


@pytest.mark.parametrize("signed", [False, True])
def test_pictures_show_each_pattern_in_the_middle_of_the_projector(signed: bool, tmp_path: Path) -> None:
    """Cells of 5 x 5 pixels: 54 rows hold 10 of them, 96 columns 14 and more. (Planted: rows and columns changed
    places; the negative half shown for the positive.)"""
    bench = made(tmp_path, signed=signed)
    projector = tmp_path / "projector.toml"
    projector.write_text('name = "p"\neffective_wavelength_nm = 550.0\ncolumns = 96\nrows = 54\n')
    export(bench.run, "png", tmp_path / "out", projector=str(projector))
    described = json.loads((tmp_path / "out" / "patterns.json").read_text())
    cell = {"cell": 5, "cell_columns": 5, "cell_shape": 1.0}
    assert described["projector"] == {"rows": 54, "columns": 96, **cell, "first_row": 2, "first_column": 13}
    left, right = (np.array(described[name]) for name in ("P_L", "P_R"))
    assert (len(left), len(right)) == SCENE and len(described["shots"]) == (8 if signed else 6)
    for shot in described["shots"]:
        with Image.open(tmp_path / "out" / shot["pattern"]) as picture:
            values = np.array(picture)
        pattern = np.outer(left[:, shot["row"]], right[:, shot["column"]])
        light = (1 + shot["sign"] * pattern) / 2 if signed else pattern
        expected = np.zeros((54, 96))
        for row in range(SCENE[0]):
            for column in range(SCENE[1]):
                expected[2 + 5 * row : 7 + 5 * row, 13 + 5 * column : 18 + 5 * column] = 255 * light[row, column]
        assert np.array_equal(values, expected)
    with Image.open(tmp_path / "out" / "patterns" / "white.png") as picture:
        assert np.array(picture).sum() == 255 * 25 * SCENE[0] * SCENE[1]


def test_a_plane_of_a_colour_sensor_is_cut_as_flatcams_loader_does(tmp_path: Path) -> None:
    """Of a calibration of 40 x 52 pixels and a mosaic of 84 x 110: one row and one column more on every side."""
    bench = made(tmp_path)
    mosaic = np.arange(84 * 110).reshape(84, 110)
    written(tmp_path / "frames", "png", np.stack([mosaic] * 6))
    for channel, corner in {"r": (1, 1), "gb": (0, 1), "gr": (1, 0), "b": (0, 0)}.items():
        import_capture(tmp_path / "frames", tmp_path / channel, known(bench, prepare=Preparation(channel=channel)))
        plane = mosaic[corner[0] :: 2, corner[1] :: 2]
        assert plane.shape == (42, 55)
        assert np.array_equal(ms.load_run(tmp_path / channel).dn[0], plane[1:41, 1:53])


def refused(words: str, tmp_path: Path, source: Path, about: RealCapture) -> None:
    with pytest.raises(MitsimError, match=words):
        import_capture(source, tmp_path / "run 2", about)
    assert not (tmp_path / "run 2").exists()


def test_what_does_not_fit_is_refused_and_no_folder_is_left(tmp_path: Path) -> None:
    bench = made(tmp_path)
    dn = ms.load_run(bench.run).dn
    source = tmp_path / "frames"
    written(source, "png", dn)
    refused("holds 6 frames, but patterns 'dots:2' need 4", tmp_path, source, known(bench, "dots:2"))
    refused("dots:99", tmp_path, source, known(bench, "dots:99"))
    refused("projector-pixels", tmp_path, source, replace(known(bench), calibration=None))
    refused("the calibration has 10 x 14", tmp_path, source, known(bench, n=12))
    refused("black_level_dn: got -1", tmp_path, source, known(bench, black_level_dn=-1.0))
    (tmp_path / "empty").mkdir()
    refused("holds no file that ends in", tmp_path, tmp_path / "empty", known(bench))
    written(tmp_path / "small", "png", dn[:, :, 1:])
    refused("is 40x51, but the calibration's frames are 40x52", tmp_path, tmp_path / "small", known(bench))
    written(tmp_path / "fractions", "npy", dn + 0.5)
    refused("holds fractions", tmp_path, tmp_path / "fractions", known(bench))
    written(tmp_path / "below", "npy", dn.astype(int) - 10000)
    refused("has the number -", tmp_path, tmp_path / "below", known(bench))
    twelve = tmp_path / "twelve.toml"
    twelve.write_text(ELECTRONICS.replace("bits = 16", "bits = 12"))
    scaled = replace(known(bench), camera=str(twelve))
    written(tmp_path / "scaled", "npy", dn * 16)
    refused("they were scaled", tmp_path, tmp_path / "scaled", scaled)
    written(tmp_path / "eight", "npy", (dn >> 8).astype(np.uint8))
    refused("holds numbers of 8 bits, but camera bench 3 counts to 4095", tmp_path, tmp_path / "eight", scaled)


@pytest.mark.parametrize(
    ("calibrated", "words"),
    [
        ({"pixel_pitch_um": 2.5, "binning": 2}, None),
        ({"pixel_pitch_um": 5.001, "binning": 1}, None),
        ({"pixel_pitch_um": 5.0, "binning": 2}, r"camera bench 3: has pixels of 5 um, but the calibration's .* 10 um"),
        ({"pixel_pitch_um": 5.0, "row_pitch_um": 6.0, "binning": 1}, "5 um, but the calibration's camera of 6 um"),
    ],
)
def test_pixels_of_another_pitch_than_the_calibrations_are_refused(
    calibrated: dict[str, float], words: str | None, tmp_path: Path
) -> None:
    """(Planted: never looked; rows not looked at; binning left out.)"""
    bench = made(tmp_path)
    manifest = bench.calibration / "manifest.json"
    read = json.loads(manifest.read_text())
    manifest.write_text(json.dumps({**read, "camera": {"sensor": {"name": "bench 3", **calibrated}}}))
    source = tmp_path / "frames"
    written(source, "png", ms.load_run(bench.run).dn)
    if words is None:
        assert import_capture(source, tmp_path / "run 2", known(bench))["frames"] == 6
    else:
        refused(words, tmp_path, source, known(bench))


def test_a_stack_of_many_pages_is_read_page_after_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice in all, not once for every frame before. (Planted: each frame found from the first page on.)"""
    bench = made(tmp_path)
    dn = ms.load_run(bench.run).dn
    tifffile.imwrite(tmp_path / "stack.tif", dn.astype(np.uint16))
    seen: list[int] = []
    looked = packed.read_images

    def counted(path: Path, wanted: Wanted) -> Iterator[np.ndarray]:
        """Pages, each noted as it is read."""
        for page in looked(path, wanted):
            seen.append(1)
            yield page

    monkeypatch.setattr(packed, "read_images", counted)
    import_capture(tmp_path / "stack.tif", tmp_path / "run 2", known(bench))
    assert len(seen) == 2 * len(dn)
    assert np.array_equal(ms.load_run(tmp_path / "run 2").dn, dn)


def test_a_stack_in_another_order_is_read_by_its_pages(tmp_path: Path) -> None:
    """(Seen: page after page, whatever the order.)"""
    bench = made(tmp_path)
    dn = ms.load_run(bench.run).dn
    tifffile.imwrite(tmp_path / "stack.tif", dn[::-1].astype(np.uint16))
    import_capture(tmp_path / "stack.tif", tmp_path / "run 2", known(bench, order="reversed"))
    assert np.array_equal(ms.load_run(tmp_path / "run 2").dn, dn)


def test_frames_are_counted_by_their_headers(tmp_path: Path) -> None:
    """A sparse array of 4096 frames of 64 megapixels is refused at once. (Planted: counted as they are read.)"""
    bench = made(tmp_path)
    np.lib.format.open_memmap(tmp_path / "a.npy", "w+", np.uint16, (4096, 8000, 8000)).flush()
    refused("holds 4096 frames", tmp_path, tmp_path / "a.npy", known(bench))


def test_pictures_as_large_as_flatcams_give_their_scene(tmp_path: Path) -> None:
    """500 x 256 pixels, of a plane and of a whole frame: a factor for each side, and the image is the scene."""
    rng = np.random.default_rng(8)
    sides, scene = [rng.random((pixels, 8)) * 100 for pixels in (500, 256)], rng.random((8, 8))
    manifest = CalibrationManifest(camera={"name": "bench 3"}, digital=DIGITAL)
    left, right = (side.astype(np.float32).astype(np.float64) for side in sides)
    Factors(left, right, manifest, Status(Verdict.CALIBRATED, "Fit")).save(tmp_path / "cal")
    light = left @ scene @ right.T + DIGITAL.dark_current_e_per_s
    dn = np.rint(light * DIGITAL.exposure_s * DIGITAL.gain_dn_per_e + DIGITAL.black_level_dn)
    written(tmp_path / "whole", "png", dn[None])
    written(tmp_path / "planes", "png", np.kron(dn, [[0, 0], [1, 0]])[None])
    bench = Made(tmp_path / "run", tmp_path / "cal", scene)
    for folder, channel in (("whole", None), ("planes", "gr")):
        about = known(bench, "uniform", prepare=Preparation(channel=channel))
        result = import_capture(tmp_path / folder, tmp_path / f"run {folder}", about)
        assert result["shape"] == [500, 256]
        image = ms.reconstruct(ms.load_run(tmp_path / f"run {folder}"), ms.load_calibration(tmp_path / "cal")).image
        assert np.abs(image - scene).max() < 1e-3


# ---- Closing frames and orders of shots ----


PROJECTOR = 'name = "p"\neffective_wavelength_nm = 550.0\ncolumns = 96\nrows = 54\n'


def imported(bench: Made, frames: list[np.ndarray], patterns: str, name: str = "again", **more: object) -> ms.Capture:
    """The run that becomes of ``frames``, files of the camera of a ``bench``."""
    folder = bench.run.parent
    (folder / "camera.toml").write_text(ELECTRONICS)
    source = folder / f"{name} frames"
    source.mkdir()
    for index, frame in enumerate(frames):
        np.save(source / f"{index}.npy", frame)
    facts = {"camera": folder / "camera.toml", "exposure": DIGITAL.exposure_s, "calibration": bench.calibration}
    import_frames(source, folder / name, patterns=patterns, **facts, **more)
    return ms.load_run(folder / name)


@pytest.mark.parametrize("order", ["sequency", "cake-cutting"])
def test_frames_of_a_family_in_another_order_give_the_scene(order: str, tmp_path: Path) -> None:
    """Frames of the paper's model, by the order's definition. (Planted: captures of a family in row-major order.)"""
    bench = made(tmp_path)
    factors, frames = ms.load_calibration(bench.calibration), list[np.ndarray]()
    for pattern in in_order(order, 4):
        shown = pattern[np.ix_(np.arange(SCENE[0]) % 4, np.arange(SCENE[1]) % 4)]
        for light in ((1 + shown) / 2, (1 - shown) / 2):
            electrons = DIGITAL.exposure_s * (factors.left @ (light * bench.scene) @ factors.right.T)
            level = DIGITAL.black_level_dn + DIGITAL.dark_current_e_per_s * DIGITAL.exposure_s * DIGITAL.gain_dn_per_e
            frames.append(np.rint(level + DIGITAL.gain_dn_per_e * electrons).astype(np.uint16))
    run = imported(bench, frames, f"hadamard:4:{order}")
    image = ms.reconstruct(run, factors, lam=0).image
    assert np.linalg.norm(image - bench.scene) < 1e-3 * np.linalg.norm(bench.scene)


@pytest.mark.parametrize("kind", ["first", "uniform"])
@pytest.mark.parametrize("ambient", [False, True])
def test_light_of_a_closing_frame_is_that_of_measurements(kind: str, ambient: bool, tmp_path: Path) -> None:
    """The first frame again, or the sum of all: both to their noise, of 2080 pixels to five standard deviations.

    (Planted: ambient light left in; dark current left in; the run's exposure in the place of the frame's own.)
    """
    shots = ms.load_run(made(tmp_path, ambient=ambient, closing=kind).run)
    found, measured = shots.closing, [frame for frame, _, _ in shots.measurements()]
    assert found is not None and found.kind == kind and found.saturated == 0
    summed = measured[:1] if kind == "first" else measured
    noise = sum(shots.manifest.digital.variance(frame + shots.ambient.rate if ambient else frame) for frame in summed)
    # The ambient frame is one draw, taken off the closing frame once and off the sum once a frame.
    noise = noise + found.variance + (shots.ambient.variance * (len(summed) - 1) ** 2 if ambient else 0.0)
    score = (found.light - sum(summed)) / np.sqrt(noise)
    assert abs(score.mean()) < 5 / np.sqrt(score.size)
    assert abs((score**2).mean() - 1) < 5 * np.sqrt(2 / score.size)


def test_light_of_signed_patterns_keeps_ambient_light_as_their_halves_do(tmp_path: Path) -> None:
    bench = made(tmp_path, signed=True, ambient=True, closing="first")
    shots = ms.load_run(bench.run)
    half = shots.manifest.digital.rate(shots.dn[0])
    score = (shots.closing.light - half) / np.sqrt(2 * shots.closing.variance)
    assert abs(score.mean()) < 5 / np.sqrt(score.size)


def test_the_last_file_closes_a_run_and_its_exposure_may_be_its_own(tmp_path: Path) -> None:
    """A half of the exposure, and a half of the numbers above the dark level: the same light a second.

    (Planted: the dark level of the run's exposure under even response; the closing frame read as the first file.)
    """
    bench = made(tmp_path, closing="uniform")
    shots = ms.load_run(bench.run)
    last = shots.read("closing.exr")[0]["DN"]
    again = imported(bench, [*shots.dn, last], "dots:2x3", closing_frame="uniform")
    assert np.array_equal(again.dn, shots.dn) and np.array_equal(again.closing.light, shots.closing.light)
    black, dark = DIGITAL.black_level_dn, DIGITAL.dark_current_e_per_s * DIGITAL.exposure_s * DIGITAL.gain_dn_per_e
    shorter = np.rint(black + dark / 2 + (last - black - dark) / 2).clip(0).astype(np.uint32)
    response = np.linspace(0.5, 1.5, last.size).reshape(last.shape)
    np.save(tmp_path / "flat.npy", black + dark + 5000 * response)
    for name, more in {"plain": {}, "flat": {"flat_frame": tmp_path / "flat.npy"}}.items():
        facts = {"closing_frame": "uniform", **more}
        whole = imported(bench, [*shots.dn, last], "dots:2x3", name, **facts)
        facts["closing_exposure"] = DIGITAL.exposure_s / 2
        half = imported(bench, [*shots.dn, shorter], "dots:2x3", f"{name} half", **facts)
        rounding = 0.5 / DIGITAL.gain_dn_per_e / (DIGITAL.exposure_s / 2) / (response if more else 1.0)
        assert (
            np.abs(half.closing.light - whole.closing.light) < 1.01 * rounding
        ).all()  # frames under a flat are of single precision
        assert half.manifest.closing_frame.exposure_s == DIGITAL.exposure_s / 2
    images = [ms.reconstruct(run, ms.load_calibration(bench.calibration)).image for run in (shots, again)]
    assert np.array_equal(*images), "a closing frame is no measurement"
    assert again.save(tmp_path / "saved") and bytes_of(tmp_path / "saved") == bytes_of(again.folder)
    without = ms.Capture(shots.manifest.model_copy(update={"closing_frame": None}), shots.folder)
    assert without.fingerprint != shots.fingerprint


def test_a_damaged_closing_frame_is_refused_and_one_that_clips_is_counted(tmp_path: Path) -> None:
    bench = made(tmp_path, closing="uniform")
    shots = ms.load_run(bench.run)
    last = shots.read("closing.exr")[0]["DN"].copy()
    last[3, 4:7] = 65535
    assert imported(bench, [*shots.dn, last], "dots:2x3", closing_frame="uniform").closing.saturated == 3
    (bench.run / "closing.exr").write_bytes((bench.run / "frame_00000.exr").read_bytes())
    with pytest.raises(MitsimError, match=r"closing\.exr"):
        ms.load_run(bench.run).closing  # noqa: B018


def test_what_does_not_fit_a_closing_frame_is_refused_in_a_line(tmp_path: Path) -> None:
    bench = made(tmp_path)
    frames = [*ms.load_run(bench.run).dn]
    np.save(tmp_path / "dark.npy", frames[0])
    refused = {
        "holds 6 frames, but patterns 'dots:2x3' need 6 and a closing frame": (frames, {"closing_frame": "first"}),
        r"holds 7 frames.*if the last one is a closing frame, give --closing-frame": ([*frames, frames[0]], {}),
        "closing_exposure_s is of a closing frame; give closing_frame too": (frames, {"closing_exposure": 0.5}),
        "beside dark frames": (frames, {"closing_frame": "first", "closing_exposure": 0.5,
                                        "dark_frame": tmp_path / "dark.npy"}),
        "closing_frame 'last': give 'first' or 'uniform'": (frames, {"closing_frame": "last"}),
        "order 'snake': give row-major, column-major, reversed": (frames, {"order": "snake"}),
    }  # fmt: skip
    for number, (words, (held, more)) in enumerate(refused.items()):
        with pytest.raises(MitsimError, match=words) as caught:
            imported(bench, held, "dots:2x3", f"refused {number}", **more)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("signed", [False, True])
def test_frames_taken_in_an_order_become_the_run_bit_for_bit(signed: bool, tmp_path: Path) -> None:
    """Factors, frames and image; a closing frame stays the last. (Planted: the inverse permutation; the closing frame
    put into the order; files permuted again at each plane.)"""
    bench = made(tmp_path, signed=signed, closing="first")
    patterns, shots = "hadamard:2" if signed else "dots:2x3", ms.load_run(bench.run)
    in_order = shots.dn.reshape(-1, 2, *shots.dn.shape[1:])[:, ::-1].reshape(shots.dn.shape) if signed else shots.dn
    last = shots.read("closing.exr")[0]["DN"]
    plain = imported(bench, [*in_order, last], patterns, closing_frame="first")
    assert plain.manifest.order is None
    orders = shot_orders(plain.manifest.patterns)
    assert len(orders) == (25 if signed else 3)
    image = ms.reconstruct(plain, ms.load_calibration(bench.calibration)).image
    for name, order in orders.items():
        taken = np.empty_like(in_order)
        taken[order] = in_order  # shot k is file order[k]
        run = imported(bench, [*taken, last], patterns, name, closing_frame="first", order=name)
        assert np.array_equal(run.dn, plain.dn) and np.array_equal(run.closing.light, plain.closing.light)
        assert run.manifest.order == name and run.manifest.configuration["order"] == name
        assert np.array_equal(ms.reconstruct(run, ms.load_calibration(bench.calibration)).image, image), name


@pytest.mark.parametrize("kind", ["first", "uniform"])
def test_pictures_end_with_the_closing_one_and_frames_are_read_again(kind: str, tmp_path: Path) -> None:
    """`patterns` and `export --format png`. (Planted: the last picture for the first; none drawn.)"""
    (tmp_path / "p.toml").write_text(PROJECTOR)
    projector, bench = str(tmp_path / "p.toml"), made(tmp_path / "bench", closing=kind)
    drawn = pattern_pictures(
        "dots:2x3", tmp_path / "drawn", projector=projector, projector_pixels=10, closing_frame=kind
    )
    export(bench.run, "png", tmp_path / "out", projector=projector)
    for folder in ("drawn", "out"):
        files = sorted((tmp_path / folder / "patterns").glob("pattern_*.png"))
        pictures = [np.asarray(Image.open(path)) for path in files]
        assert len(pictures) == drawn["pictures"] == 7
        expected = pictures[0] if kind == "first" else np.asarray(Image.open(files[0].parent / "white.png"))
        assert np.array_equal(pictures[-1], expected) and not np.array_equal(pictures[-1], pictures[-2])
        assert len(json.loads((tmp_path / folder / "patterns.json").read_text())["shots"]) == 6
    shots, frames = ms.load_run(bench.run), sorted((tmp_path / "out" / "frames").iterdir())
    again = imported(bench, [np.asarray(Image.open(path)) for path in frames], str(tmp_path / "out" / "patterns.json"),
                     closing_frame=kind)  # fmt: skip
    assert np.array_equal(again.dn, shots.dn) and np.array_equal(again.closing.light, shots.closing.light)
    with pytest.raises(MitsimError, match="closing_frame has no effect on stripes"):
        pattern_pictures("stripes", tmp_path / "s", projector=projector, projector_pixels=4, closing_frame=kind)
