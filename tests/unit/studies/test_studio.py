"""A studio: the same images as a user gets step by step, the paper's test images on a scene's print, light kept."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import mitsim as ms
from mitsim.core.errors import MitsimError
from mitsim.core.images import reduce_frame
from mitsim.devices.mask import mls_mask
from mitsim.report import EQUAL_FRAME, EQUAL_PEAK, EQUAL_TOTAL, IDEALISED, RENDERED
from mitsim.report.lit_scene import DIM, DIM_E, Plane
from mitsim.studies.camera_studies import MAP, SEVERAL, UNIFORM, VOLUME, modulation
from mitsim.studies.framework.experiment import TEST_IMAGES, Results, Scope, Setup
from mitsim.studies.framework.studio import SIDE, Image, Studio, picture
from tests.shadow_factor import scene_factor

pytestmark = pytest.mark.usefixtures("kept_plans")


@pytest.fixture(scope="module")
def setup(shared_scene: Callable[..., Path], variant: str) -> Setup:
    print_ = np.random.default_rng(2).integers(20, 230, (48, 48))
    return Setup(str(shared_scene("studio", reflectance=print_)), variant=variant, accuracy=1e-2)


@pytest.fixture(scope="module")
def studio() -> Iterator[Studio]:
    with Studio() as kept:
        yield kept


def test_bars_have_their_frequency_both_ways() -> None:
    """0.25 line pairs a mm: 32 pairs on 128 mm, of 16 texels each, half white. (Planted: bars of twice the width.)"""
    values = picture("bars 0.25")
    left, right = np.split(values.astype(float), 2, axis=1)
    assert not np.ptp(left, axis=0).any() and not np.ptp(right, axis=1).any()
    assert np.count_nonzero(np.diff(left[0]) > 0) == 16 - 1 and np.count_nonzero(np.diff(right[:, 0]) > 0) == 32 - 1
    assert set(np.unique(values)) == {13, 230} and values.mean() == pytest.approx((13 + 230) / 2)
    fine = picture("bars 0.7").astype(float)
    assert fine.mean() == pytest.approx((12.75 + 229.5) / 2, rel=0.01), "texels across an edge are part black"


def test_depths_of_volumes_are_judged_where_light_is_seen() -> None:
    """Of four pixels one is dark and one unseen, the others are off by 3 and 4 mm. Maps win by the median error alone.
    (Planted: all pixels; the side of the range that is left out; the sign of a claim on errors.)"""
    asked, off = dict[str, Any](), {MAP: np.array([0.0, 6.0]), VOLUME: np.array([3.0, 4.0]), UNIFORM: np.full(2, 30.0)}
    depths, gain = np.array([[360.0, 440.0], [400.0, np.nan]]), {MAP: 40.0, VOLUME: 41.0, UNIFORM: 12.0}

    def image(*args: Any, **options: Any) -> Any:
        asked.update(options)
        return SimpleNamespace(image=depths, depths_mm=np.array([[*off[way] + depths[0]], [0, 0]]),
                               row=lambda: {"psnr_db": gain[way]})  # fmt: skip

    scene = SimpleNamespace(truth=np.array([[1.0, 0.5], [0.0, 1.0]]))
    stand: Any = SimpleNamespace(once=lambda *_: depths, image=image, lit_scene=lambda _: scene)
    points, rows = SEVERAL.points(Scope(Setup(), ("coins",))), []
    for point in points:
        way = point["way"]
        rows += SEVERAL.measure(stand, point).rows
        assert asked["focus"] == (MAP if way == MAP else VOLUME)
        assert asked.get("depth_range") == ((0.97 * 360, 1.03 * 440) if way == UNIFORM else None) or way == MAP
    assert rows[1]["rms_mm"] == pytest.approx(12.5**0.5) and rows[1]["median_mm"] == 3.5
    assert len(points) == 27 and len(SEVERAL.points(Scope(Setup(), ("coins",), quick=True))) == 9
    verdicts = [claim.verdict for claim in SEVERAL.judge(Results(rows))]
    assert verdicts == ["confirmed"] * 8 + ["not confirmed"] * 3


@pytest.mark.parametrize("name", TEST_IMAGES)
def test_test_images_are_prints(name: str) -> None:
    values = picture(name)
    assert values.shape == (SIDE, SIDE) and values.dtype == np.uint8
    assert values.min() == round(0.05 * 255) and values.max() == round(0.90 * 255)
    assert values.std() > 15, "a picture"


def test_a_rendered_image_is_what_a_user_gets(studio: Studio, setup: Setup) -> None:
    """Bit-equal to open_bench, light, expose, calibrate and reconstruct."""
    found = studio.image(setup, RENDERED, "dots:4", 3)
    bench = ms.open_bench(setup.scene, variant=setup.variant)
    shots = bench.light(accuracy=1e-2).expose("dots:4", seed=3)
    own = ms.reconstruct(shots, bench.calibrate(seed=3))
    assert np.array_equal(found.image, own.image) and found.lam == own.lam
    assert found.shots == 16 and found.exposure_s == shots.exposure_s and found.flags["flagged"] == (not own.ok)
    assert found.quality.psnr_db == pytest.approx(ms.psnr(own.image, shots.truth))


@pytest.mark.parametrize("model", [IDEALISED, RENDERED])
def test_exposures_follow_their_conventions(studio: Studio, setup: Setup, model: str) -> None:
    """One frame of uniform light is the measure: each of 16 dots as long, or a sixteenth. (Planted: frames counted as
    patterns, which signed pairs are not.)"""
    uniform = studio.image(setup, model, "uniform").exposure_s
    assert studio.image(setup, model, "dots:4", exposure=EQUAL_FRAME).exposure_s == pytest.approx(uniform)
    assert studio.image(setup, model, "dots:4", exposure=EQUAL_TOTAL).exposure_s == pytest.approx(uniform / 16)
    assert studio.image(setup, model, "hadamard:2", exposure=EQUAL_TOTAL).exposure_s == pytest.approx(uniform / 8)
    peak = studio.image(setup, model, "dots:4", exposure=EQUAL_PEAK).exposure_s
    assert peak > 5 * uniform
    dim, well = studio.image(setup, model, "dots:4", exposure=DIM), studio.bench(setup).sensor.superpixel_full_well_e
    assert dim.exposure_s == pytest.approx(peak * DIM_E / (0.8 * well))


def test_light_and_factors_are_made_once(studio: Studio, setup: Setup) -> None:
    assert studio.lit_scene(setup).light is studio.lit_scene(setup).light
    assert studio.factors(setup, 3) is studio.factors(setup, 3)
    assert studio.factors(setup, 3) is not studio.factors(setup, 4)


def test_studios_share_their_calibrations(studio: Studio, setup: Setup, tmp_path: Path) -> None:
    """One studio's session serves another, to the last bit what it would have found itself; an unfinished one does not.
    (Planted: seeds taken for one.)"""
    own = studio.factors(setup, 3)
    with Studio(str(tmp_path)) as first, Studio(str(tmp_path)) as second:
        found = first.factors(setup, 3)
        (place,) = [path for path in (tmp_path / "calibrations").iterdir() if path.is_dir()]
        before = place.stat().st_mtime_ns
        again = second.factors(setup, 3)
        assert place.stat().st_mtime_ns == before
        second.factors(setup, 4)
    for other in (found, again):
        assert np.array_equal(other.left, own.left) and np.array_equal(other.right, own.right)
        assert other.manifest.noise == own.manifest.noise and other.ok == own.ok
        assert other.manifest.parallax == own.manifest.parallax
    assert len([path for path in (tmp_path / "calibrations").iterdir() if path.is_dir()]) == 2


def test_scenes_of_the_same_devices_share_factors(studio: Studio, setup: Setup) -> None:
    """Whatever stands before them; another mask, or a projector that is a micrometre off or a little brighter, is
    another. (Planted: the setup for the key; the projector's light left out of it.)"""
    path = Path(setup.scene)
    turned, moved, masked, lit = (path.with_name(f"{name}.xml") for name in ("turned", "moved", "masked", "lit"))
    turned.write_text(path.read_text().replace('z="1" angle="180"', 'z="1" angle="170"'))
    assert studio.factors(replace(setup, scene=str(turned)), 3) is studio.factors(setup, 3)
    moved.write_text(path.read_text().replace('<translate x="60"/>', '<translate x="60.001"/>'))
    masked.write_text(path.read_text().replace('mask_distance" value="2"', 'mask_distance" value="2.001"'))
    lit.write_text(path.read_text().replace('value="111000"', 'value="111001"'))
    digests = {studio.bench(replace(setup, scene=str(each))).devices_digest for each in (path, moved, masked, lit)}
    assert len(digests) == 4


def test_studios_share_their_plans(setup: Setup, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Light of a plan in a file is that of one in memory. (Planted: each plans for itself.)"""
    with Studio(str(tmp_path)) as first, Studio(str(tmp_path)) as second, Studio() as alone:
        own = alone.lit_scene(setup).light
        found = first.lit_scene(setup).light
        monkeypatch.setattr("mitsim.acquire.spectral.make_plan", lambda *_: 1 / 0)
        again = second.lit_scene(setup).light
    for each in (found, again):
        assert np.array_equal(each.flux, own.flux) and each.sampling_error == own.sampling_error


@pytest.mark.slow
def test_another_picture_is_on_the_print(studio: Studio, shared_scene: Callable[..., Path], variant: str) -> None:
    """Its truth is the picture, averaged over pixels; the scene's own files are as they were."""
    path = shared_scene("printed", reflectance=np.full((48, 48), 100))
    setup = Setup(str(path), "coins", variant=variant, accuracy=1e-2)
    with pytest.raises(MitsimError, match=r"has no reflectance\.png beside it, so there is no print to replace"):
        studio.bench(setup)
    path.write_text(path.read_text().replace("printed_reflectance.png", "reflectance.png"))
    own = path.parent / "printed_reflectance.png"
    before = own.rename(path.parent / "reflectance.png").read_bytes()
    truth = studio.lit_scene(setup).truth
    # The sheet is 128 mm wide, of which the projector's 16 pixels light 120.
    seen = picture("coins")[16:-16, 16:-16].reshape(16, 30, 16, 30).mean(axis=(1, 3)) / 255 / 0.99
    assert np.abs(truth - seen).max() < 0.03 and truth.std() > 0.1
    assert (path.parent / "reflectance.png").read_bytes() == before
    blank = studio.lit_scene(Setup(str(path), variant=variant, accuracy=1e-2)).truth
    assert np.abs(blank - 100 / 255 / 0.99).max() < 0.01


@pytest.mark.parametrize("model", [IDEALISED, RENDERED])
def test_binned_frames_are_those_of_larger_pixels(studio: Studio, setup: Setup, model: str) -> None:
    """Without binning the best lambda is no worse than the automatic one. Of 16 pixels a side, as many as unknowns,
    16 dots lose nothing, and uniform light much. (Planted: rows of one pixel in four instead of their mean.)"""
    best = {
        (patterns, binning): Image.of(frames, frames.seconds(EQUAL_PEAK), "best", binning).quality.psnr_db
        for patterns in ("uniform", "dots:4")
        for frames in [studio.frames(setup, model, patterns)]
        for binning in (1, 4)
    }
    for patterns in ("uniform", "dots:4"):
        automatic = studio.image(setup, model, patterns).quality.psnr_db
        assert automatic - 0.05 < best[patterns, 1] < automatic + 6
    assert best["dots:4", 4] > best["dots:4", 1] - 1
    assert best["uniform", 4] < best["uniform", 1] - 1


def test_frames_that_are_not_square_are_averaged_by_rows_and_columns(studio: Studio, setup: Setup) -> None:
    """And refused where squares do not fill them. (Planted: as many columns as rows; columns not looked at.)"""
    found = reduce_frame(np.arange(24.0).reshape(4, 6), 2)
    assert found.tolist() == [[3.5, 5.5, 7.5], [15.5, 17.5, 19.5]]
    frames = studio.frames(setup, IDEALISED, "dots:4")
    wide = replace(frames, sides=(np.ones((48, 16)), np.ones((84, 16))))
    with pytest.raises(MitsimError, match=r"frames of 48 x 84 pixels: cannot be averaged 8 x 8; .* multiples of 8"):
        wide.prepare(8)


def test_an_idealised_plane_casts_the_shadow_of_its_depth(studio: Studio, setup: Setup) -> None:
    """Frames of 16 dots at 370 mm, lit from 60 mm beside, against factors of that plane in closed form; at the
    calibrated distance they are those without a plane, whatever the baseline. (Planted: light moved the other way.)"""
    lit = studio.lit_scene(setup)
    bench, family = lit.bench, lit.bench.family("dots:4")
    camera, z = bench.geometry, 370.0
    own, there = (
        [frame.irradiance for frame in lit.expected_frames(IDEALISED, family, plane)]
        for plane in (None, Plane(camera.scene_distance, (25.0, -60.0)))
    )
    assert np.allclose(own, there, rtol=1e-12)
    profile = mls_mask(camera.mask, camera.mask_feature, camera.mask_order).terms[0][1]
    sides = []
    for window, baseline in zip(bench.windows, (25.0, -60.0), strict=True):
        edges = z * (np.linspace(*window, bench.n + 1) + baseline * (1 / z - 1 / camera.scene_distance))
        sides.append(scene_factor(profile, camera.mask_feature, camera.pixel_edges, edges, camera.mask_distance, z))
    for shot, frame in zip(family.shots, lit.expected_frames(IDEALISED, family, Plane(z, (25.0, -60.0))), strict=True):
        expected = sides[0] @ (family.light(shot) * lit.truth) @ sides[1].T
        scale = np.vdot(expected, frame.irradiance) / np.vdot(expected, expected)
        assert np.linalg.norm(frame.irradiance - scale * expected) < 1e-6 * np.linalg.norm(frame.irradiance)


@pytest.mark.parametrize("frequency", [0.1, 0.2437, 0.4])
def test_modulation_is_that_of_the_bars_and_not_of_noise(frequency: float) -> None:
    """A sine of amplitude 0.2 about 0.5 is the fundamental of bars of contrast 0.1 pi; noise as strong makes no more
    than a tenth of it. (Planted: the frequency doubled; the mean left out.)"""
    wave = 0.5 + 0.2 * np.sin(2 * np.pi * frequency * np.arange(60) + 0.7)
    assert modulation(np.tile(wave, (40, 1)), 0, frequency) == pytest.approx(0.1 * np.pi, rel=1e-9)
    noise = 0.5 + 0.14 * np.random.default_rng(1).standard_normal((40, 60))
    assert modulation(noise, 0, frequency) < 0.03
