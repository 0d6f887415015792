"""Twins of real captures: frames, noise and causes of simulated captures come out as they were set, and diffusers are
found by their statistics."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from mitsim.core.arrays import FloatArray
from mitsim.core.environment import DEFAULT_VARIANT
from mitsim.core.errors import MitsimError
from mitsim.core.picture_files import Crop, Preparation
from mitsim.reconstruct.known_pictures import Codes, Pose, Side, plane_offsets
from mitsim.reconstruct.solver import centre_frame
from mitsim.studies import find_files, twin_study
from mitsim.studies.framework.experiment import Point, Results, Scope, Setup
from mitsim.studies.framework.panels import flag_warnings
from mitsim.studies.framework.studio import Studio
from mitsim.studies.twin_study import (
    CAUSES,
    COLUMNS,
    STUDY,
    Learned,
    Measured,
    compare,
    noise_of,
    preparation,
    read_captures,
    read_spread,
    render,
    statistics,
)

SCALES, SCENE, SENSOR = (0.6, 0.7), 40, (80, 90)
GAIN, LIGHT = 0.1, 600.0
"""DN an electron, and mean light [DN]: as the real captures'."""
SIDES = float(np.sqrt(np.prod(SENSOR)))
PLANE = "gb"
OFFSETS = plane_offsets(Preparation(mosaic="BGGR", channel="all"))


def smooth(draws: np.random.Generator, *shape: int, width: float = 1.5) -> FloatArray:
    values = ndimage.gaussian_filter(draws.standard_normal(shape), width)
    return np.asarray(values / values.std())


def codes_of(values: tuple[FloatArray, FloatArray]) -> Codes:
    """Of one code a side, each of its ``values``."""
    left, right = (Side(sensor, SCENE, scale, 1, True) for sensor, scale in zip(SENSOR, SCALES, strict=True))
    nothing = 0.0, 0.0
    numbers = values[0][None], values[1][None]
    return Codes((left, right), numbers, dict.fromkeys(OFFSETS, 1.0), np.zeros(1), 1.0, nothing, nothing, nothing)


def made_codes(seed: int = 3) -> Codes:
    draws = np.random.default_rng(seed)
    lengths = (Side(sensor, SCENE, scale, 1, True).length for sensor, scale in zip(SENSOR, SCALES, strict=True))
    left, right = (smooth(draws, length) for length in lengths)
    return codes_of((left, right))


def frame_of(codes: Codes, scene: FloatArray) -> FloatArray:
    left, right = codes.factors(OFFSETS[PLANE], PLANE)
    return np.asarray(left @ scene @ right.T)


def made(seed: int, codes: Codes) -> Measured:
    """A frame of a made scene without noise."""
    scene = np.clip(0.3 + 0.3 * smooth(np.random.default_rng(seed), SCENE, SCENE, width=1.0), 0, 1)
    level, none = LIGHT + frame_of(codes, scene), np.zeros(SENSOR)
    place = scene, centre_frame(level), 0, PLANE, OFFSETS[PLANE]
    return Measured(*place, capture=f"fc_{seed}", level=level, noise=none)


def capture(folder: Path, values: np.ndarray, name: str = "fc_6") -> tuple[Path, Path]:
    """Files of a capture and of an image."""
    Image.fromarray(values).save(folder / f"{name}.png")
    image = np.random.default_rng(1).integers(0, 255, (256, 256, 3), dtype=np.uint8)
    Image.fromarray(image).save(folder / f"rec_{name}.png")
    return folder / f"{name}.png", folder / f"rec_{name}.png"


def test_planes_of_a_capture_are_its_own(tmp_path: Path) -> None:
    """Numbers in the high bits, each plane of another light, turned and cut; the scene is of the plane's colour.
    (Planted: gb and gr changed places.)"""
    light = np.array([[100, 200], [300, 400]])  # b gb, gr r
    values = np.tile(light, (512, 640)).astype(np.uint16)
    values += np.random.default_rng(0).integers(0, 20, values.shape, dtype=np.uint16)
    found = {each.plane: each for each in read_captures({"fc_6": capture(tmp_path, values * 64)}, 0)}
    means = {name: each.level.mean() for name, each in found.items()}
    assert means == pytest.approx({"b": 109.5, "gb": 209.5, "gr": 309.5, "r": 409.5}, abs=0.1)
    assert all(each.frame.shape == (500, 620) for each in found.values())
    image = np.array(Image.open(tmp_path / "rec_fc_6.png"))
    assert np.array_equal(found["b"].scene, image[..., 2] / 255)


@pytest.mark.parametrize(
    "values",
    [
        np.zeros((600, 800), dtype=np.uint16),
        np.arange(1024 * 1280, dtype=np.uint32).reshape(1024, 1280).astype(np.uint16),
        np.full((1024, 1280), 640, dtype=np.uint16),
        np.zeros((1024, 1280, 3), dtype=np.uint8),
    ],
    ids=["size", "bits", "even", "colour"],
)
def test_what_is_no_capture_is_refused_in_a_line(tmp_path: Path, values: np.ndarray) -> None:
    with pytest.raises(MitsimError, match=r"capture .*fc_6\.png: ") as said:
        read_captures({"fc_6": capture(tmp_path, values)}, 0)
    assert "\n" not in str(said.value)


def test_an_image_of_another_size_is_refused(tmp_path: Path) -> None:
    frame, image = capture(tmp_path, np.tile(np.arange(1280, dtype=np.uint16) % 1000 * 64, (1024, 1)))
    for mode, size, line in (
        ("RGB", 200, r"is \(200, 200, 3\); give the authors', 256 x 256"),
        ("L", 256, r"is \(256, 256\);"),
    ):
        Image.new(mode, (size, size)).save(image)
        with pytest.raises(MitsimError, match=line):
            read_captures({"fc_6": (frame, image)}, 0)


def test_codes_are_learned_from_known_scenes_and_predict_another_frame() -> None:
    """From six frames without noise, scenes given turned: the orientation is found, and 95 % of another frame are
    predicted. (Planted: the scene that is predicted left as it is given.)"""
    codes = made_codes()
    planes = [made(seed, codes) for seed in range(6)]
    given = [replace(each, scene=each.scene[::-1, ::-1].copy()) for each in planes]
    learned = Learned.of(given)
    held = made(9, codes)
    seen = learned.see(replace(held, scene=held.scene[::-1, ::-1].copy()))
    assert learned.pose.orientation == "turned" and learned.pose.certain
    left = held.frame - frame_of(learned.codes, seen.scene)
    assert np.square(left).sum() < 0.05 * np.square(held.frame).sum()


def test_noise_of_planes_is_that_of_their_photons() -> None:
    """Of electrons by Poisson's law, and reading: gain to 5 %, over blocks whose light differs threefold."""
    draws = np.random.default_rng(0)
    light = np.linspace(200, 700, 400)[:, None] * np.ones(400) / GAIN
    planes = [GAIN * (draws.poisson(light * part) + 20 * draws.standard_normal(light.shape)) for part in (0.5, 1.0)]
    gain, dark = noise_of(planes)
    assert gain == pytest.approx(GAIN, rel=0.05)
    assert dark == pytest.approx((GAIN * 20) ** 2, abs=2.0)


def test_noise_is_turned_and_cut_as_frames_are() -> None:
    """White noise between four pixels: of the variance that bilinear weights leave, between 1 and a quarter."""
    noise = np.random.default_rng(0).standard_normal((512, 640))
    placed = preparation()[0].frame(Path(), noise)
    assert placed.shape == (500, 620) and 0.3 < placed.var() < 0.6


@pytest.mark.parametrize("plane", ["gb", "r"])
def test_a_rendered_frame_is_the_product_of_its_factors(tmp_path: Path, plane: str) -> None:
    """Mask drawn from codes, sheet, light and camera are those of the model, half a pixel on for the red plane: 5 % of
    the coded part, which is some per cent of all light. (Planted: the mask beside its place by the other sign; the
    plane's half pixel left out: 0.2.)"""
    codes = made_codes()
    measured = replace(made(0, codes), plane=plane, offset=OFFSETS[plane])
    electrons = render(measured, codes, tmp_path, DEFAULT_VARIANT)
    left, right = codes.factors(OFFSETS[plane], plane)
    model = left @ measured.scene @ right.T
    seen = centre_frame(electrons)
    seen *= np.vdot(model, seen) / np.vdot(seen, seen)
    assert electrons.shape == SENSOR
    assert np.linalg.norm(seen - model) < 0.05 * np.linalg.norm(model)


# -------- Causes that are planted


def parts_of(measured: Measured, codes: Codes, frame: FloatArray, noise: float, seed: int) -> dict[str, float]:
    """Energies by cause of a ``frame`` with ``noise`` of that standard deviation, over the clear one's energy, where
    the simulation is the model itself."""
    draws = np.random.default_rng(seed)
    level = LIGHT + frame + noise * draws.standard_normal(SENSOR)
    drawn = centre_frame(noise * np.random.default_rng(seed + 1000).standard_normal(SENSOR))
    shown = replace(measured, frame=centre_frame(level), level=level, noise=drawn)
    row = compare(shown, codes, 1000 + frame_of(codes, measured.scene), measured.scene)
    found = {name: float(str(row[column])) for name, column in zip(CAUSES, COLUMNS, strict=True)}
    assert sum(found.values()) == pytest.approx(1)
    whole = np.square(level - level.mean()).sum() / np.square(measured.frame).sum()
    return {name: part * whole for name, part in found.items()}


def test_causes_are_found_as_they_were_planted() -> None:
    """Another code of either side, noise, and what no scene makes behind such a mask, all at once, in 16 draws, and
    noise alone: the mean of each cause is the energy that was given, to 5 permille of the frame's. (Planted: noise that
    the fit takes left out; noise of half its variance.)"""
    codes = made_codes()
    measured = made(5, codes)
    size = float(np.linalg.norm(measured.frame))
    clear = measured.frame / size
    off = []
    for seed in range(16):
        draws = np.random.default_rng(seed)
        own = [code[0] for code in codes.codes]
        aged = codes_of((own[0] + 0.25 * smooth(draws, len(own[0])), own[1] + 0.25 * smooth(draws, len(own[1]))))
        beyond = smooth(draws, *SENSOR, width=0.5)  # of a mask of these codes
        for axis, factor in enumerate(aged.factors(OFFSETS[PLANE], PLANE)):
            basis = np.linalg.qr(factor)[0]
            beyond = np.moveaxis(np.tensordot(np.eye(SENSOR[axis]) - basis @ basis.T, beyond, (1, axis)), 0, axis)
        beyond = centre_frame(beyond)
        seen = frame_of(aged, measured.scene) / size
        found = parts_of(
            measured, codes, size * (seen + 0.2 * beyond / np.linalg.norm(beyond)), 0.3 * size / SIDES, seed
        )
        light = float(np.vdot(clear, seen))
        noise = 0.3**2 * (1 - 1 / SENSOR[0]) * (1 - 1 / SENSOR[1])
        given = {"explained": light**2, "mask's code": np.square(seen).sum() - light**2, "noise": noise, "rest": 0.2**2}
        off.append([(found[name], given[name]) for name in CAUSES[1:]])
    found, given = np.array(off).transpose(2, 0, 1)
    assert found.mean(axis=0) == pytest.approx(given.mean(axis=0), abs=5e-3)
    runs = [parts_of(measured, codes, measured.frame, 0.3 * size / SIDES, seed) for seed in range(8)]
    assert all(abs(np.mean([run[name] for run in runs])) < 1e-3 for name in ("mask's code", "rest"))


def test_files_are_found_or_a_line_says_where_they_are_from(tmp_path: Path) -> None:
    for folder, words in (
        (None, r"--data FOLDER with flatcam/fc_6\.png.*flatnet"),
        (tmp_path / "none", "no such folder"),
        (tmp_path, "has no captures"),
    ):
        with pytest.raises(MitsimError, match=words):
            find_files(folder)
    (tmp_path / "flatcam").mkdir()
    for name in ("fc_6.png", "rec_6.png", "fc_7.png"):
        (tmp_path / "flatcam" / name).touch()
    with pytest.raises(MitsimError, match=r"rec_7\.png: cannot be read"):
        find_files(tmp_path)
    (tmp_path / "flatcam" / "fc_7.png").unlink()
    with pytest.raises(MitsimError, match="give a second and its image"):
        find_files(tmp_path)
    (tmp_path / "flatcam" / "rec_7.png").touch()
    (tmp_path / "flatcam" / "fc_7.png").touch()
    assert [*find_files(tmp_path)[0]] == ["fc_6", "fc_7"]


# -------- Diffusers, and the study


def test_a_spread_of_light_by_hand() -> None:
    """Of one bright pixel in 400: contrast sqrt(399), all light in the brightest twentieth."""
    point = np.zeros((20, 20))
    point[3, 4] = 1
    assert statistics(point) == pytest.approx((399**0.5, 1))


def test_a_spread_is_the_lit_square_of_a_grey_picture(tmp_path: Path) -> None:
    path = tmp_path / "psf.tif"
    Image.new("RGB", (300, 300)).save(path)
    with pytest.raises(MitsimError, match=r"psf\.tif: is in colour; give"):
        read_spread(path)
    for half, refused in ((80, True), (440, False)):
        light = np.zeros((1200, 1600), np.uint16)
        light[600 - half : 600 + half, 800 - half : 800 + half] = 1000
        Image.fromarray(light).save(path)
        if refused:
            with pytest.raises(MitsimError, match="its lit part is"):
                read_spread(path)
        else:
            found = read_spread(path)
            assert min(found.shape) >= 140 and np.ptp(found) < 1e-12


def reduce_captures(patch: pytest.MonkeyPatch) -> None:
    """Read the reduced captures that ship, by the list that docs/bench.md gives for their size."""
    preparer, _ = preparation()
    crop = Crop(row=1, column=2, rows=125, columns=155)
    small = replace(preparer, how=preparer.how.model_copy(update={"crop": crop})), 64
    patch.setattr(twin_study, "preparation", lambda: small)
    patch.setattr(twin_study, "_RAW", (254, 318))
    patch.setattr(twin_study, "find_pose", lambda _: Pose("turned", (0.4733, 0.4806)))


@pytest.mark.usefixtures("draft_figures")
def test_shipped_captures_are_predicted_by_their_own_scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Claims, figures and columns of two planes. A frame whose image is another's, or that is rendered badly, is
    flagged with the reason. (Planted: the other scene's correlation left out of the comparison.)"""
    reduce_captures(monkeypatch)
    shutil.copytree(Path(__file__).parents[3] / "captures" / "flatcam", tmp_path / "flatcam")
    scope = Scope(Setup(variant=DEFAULT_VARIANT), (None,), data=str(tmp_path))
    points = [point for point in STUDY.points(scope) if point["plane"] == "gb"]
    assert [point["capture"] for point in points] == ["fc_6", "fc_7"]
    with Studio() as studio:
        found = {point.key: STUDY.measure(studio, point) for point in points}
        rows = [{**row, "point": key} for key, each in found.items() for row in each.rows]
        results = Results(
            rows, {(key, name): array for key, each in found.items() for name, array in each.arrays.items()}, scope
        )
        assert STUDY.judge(results)[0].verdict == "confirmed"
        assert STUDY.draw(results).keys() == {"frames.png", "causes.png"}
        for row in rows:
            assert row["orientation"] == "turned" and not row["flagged"]
            assert float(str(row["correlation"])) > 0.6 and float(str(row["render_error"])) < 0.1
        monkeypatch.setattr(twin_study, "_RENDERED", 0.0)
        monkeypatch.setattr(Learned, "see", lambda _, measured: replace(measured, scene=measured.scene[::-1].copy()))
        (bad,) = STUDY.measure(studio, points[0]).rows
    assert bad["flagged"] and "off the product of its factors" in str(bad["reason"])
    assert "2 of" not in "".join(flag_warnings("twin", Results([bad])))


def test_a_diffuser_is_compared_by_its_statistics(monkeypatch: pytest.MonkeyPatch) -> None:
    """A row for each diffuser; claims compare the measured one with the simulated ones."""
    draws = np.random.default_rng(0)
    lights = [1 + 0.3 * draws.random((160, 160)) for _ in range(7)]
    monkeypatch.setattr(twin_study, "simulated_spreads", lambda *_: lights[1:])
    point = Point.of(Setup(), data="", capture="diffuser", plane="", seed=0)
    found = twin_study._measure_diffuser(point, lights[0], 0)
    arrays = {(point.key, name): array for name, array in found.arrays.items()}
    results = Results([{**row, "point": point.key} for row in found.rows], arrays)
    assert len(found.rows) == 7 and STUDY.draw(results).keys() == {"diffuser.png"}
    assert [claim.verdict for claim in STUDY.judge(results)] == ["confirmed", "confirmed"]
