"""Pairs: pictures, light of white prints times a picture against captures of it, and the store that keeps them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image
from scipy import sparse

import mitsim as ms
from mitsim.acquire.exposure import Exposer
from mitsim.api.bench import Bench, open_bench
from mitsim.bench.request import Request, Task
from mitsim.core.errors import MitsimError
from mitsim.core.seeds import integer, stream
from mitsim.learn import pairs as pairs_module
from mitsim.learn.pair_store import PairStore, PrintPart
from mitsim.learn.pairs import DrawnPictures, FolderPictures, electrons_per_joule, make_pairs, pink_noise
from mitsim.learn.requests import PairsRequest, Variation
from mitsim.optics.frames import Frame

pytestmark = pytest.mark.usefixtures("kept_plans")

N, TEXELS = 16, 256
"""Projector pixels a side, and texels of the 128 mm sheet: 15 of these to a pixel, which begin at the window's edge."""
LENS = 'name = "x"\neffective_wavelength_nm = 562.0\ncontrast_ratio = 50.0\n'
LENS += "aperture_radius_mm = 2.0\nfocus_mm = 380.0\nblur_pixels = 0.7\nansi_contrast = 40.0\n"
"""Of a projector that leaks, blurs and scatters."""
POINT = '<emitter type="point"><point name="position" x="30" y="50" z="100"/>'
POINT += '<spectrum name="intensity" value="300"/></emitter>'
"""A lamp that the camera does not see."""
SECOND = '<shape type="rectangle"><transform name="to_world"><scale x="20" y="20"/><rotate y="1" angle="90"/>'
SECOND += '<translate x="-62" z="380"/></transform><bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>'
"""A wall beside the sheet."""


class Lab:
    """A small scene with a print, and pairs of it."""

    def __init__(self, write: Callable[..., Path], folder: Path, variant: str) -> None:
        self._write, self.folder, self._variant = write, folder, variant

    def bench(self, print_: np.ndarray | None = None, extra: str = "", projector: str = "", **defines: str) -> Bench:
        """Before a sheet that shows ``print_`` (TEXELS, TEXELS)."""
        shown = np.full((TEXELS, TEXELS), 128) if print_ is None else print_
        scene = self._write("scene" if print_ is None else "shown", n=N, reflectance=shown, extra=extra)
        path = self.folder / "projector.toml"
        path.write_text(projector)
        return open_bench(scene, self._variant, projector=path if projector else None, **defines)

    def pairs(
        self,
        count: int = 2,
        name: str = "store",
        resume: bool = False,
        scene: Mapping[str, str] | None = None,
        **asked: Any,
    ) -> PairStore:
        """So many pairs in a folder of that ``name``; ``asked``: fields of a request, or of what pairs are."""
        own = {key: asked.pop(key) for key in ("pictures", "vary") if key in asked}
        request = Request.of(**{"patterns": "dots:2", "accuracy": 2e-3, "seed": 3, **asked})
        wanted = PairsRequest(capture=request, count=count, **own)
        store, self.cost = make_pairs(self.bench(**scene or {}), wanted, Task(self.folder / name, resume))
        return store


def test_programs_make_the_same_pairs(lab: Lab) -> None:
    """As the command line's, and the bench still shows what it showed; refused before any work where one cannot.
    (Planted: another seed; the bench itself, whose print was then white.)"""
    bench, folder = lab.bench(), lab.folder / "own"
    own = ms.make_pairs(bench, folder, 2, "dots:2", accuracy=2e-3, seed=3)
    other = lab.pairs()
    for index in range(2):
        assert_array_equal(own.frames(index), other.frames(index))
    assert float(np.max(bench.capture("dots:1", accuracy=1e-2).truth)) < 0.6
    timed = lab.folder / "timed"
    for output, count, options, words in (
        (folder, 2, {}, "own"),
        (timed, 2, {"pictures": "nowhere"}, "nowhere: is no folder"),
        (timed, 0, {}, "count 0: give a number from 1 to"),
        (timed, 2, {"job": ms.Job(limits=ms.Limits(memory_bytes=1e6))}, "^2 pairs"),
    ):
        with pytest.raises(MitsimError, match=words):
            ms.make_pairs(bench, output, count, "dots:2", **options)
    assert not timed.exists()


def test_light_lies_in_the_pictures_pixel_of_its_own_row_and_column() -> None:
    """Of cells that lie otherwise in rows than in columns, over two anchors a side. (Planted: rows for columns.)"""
    light = sparse.csr_array(([1.0, 2.0, 3.0], [0, 7, 23], [0, 3]), shape=(1, 24))
    optics = SimpleNamespace(shape=(4, 6), cells=(2, 3))
    part = PrintPart(cast(Any, optics), light, np.array([2, 0]), np.array([3, 1, 2]), lamps=False)
    picture = np.arange(16.0).reshape(4, 4)
    (found,) = part.times(picture).groups
    assert found.data.tolist() == [1.0 * picture[2, 3], 2.0 * picture[0, 1], 3.0 * picture[0, 2]]


@pytest.fixture
def lab(small_scene: Callable[..., Path], tmp_path: Path, variant: str) -> Lab:
    return Lab(small_scene, tmp_path, variant)


def on_sheet(picture: np.ndarray) -> np.ndarray:
    """(TEXELS, TEXELS) print that shows a picture in the window, and its edges beyond."""
    pixel = np.clip((np.arange(TEXELS) - 8) // 15, 0, N - 1)
    return picture[np.ix_(pixel, pixel)]


# ---- Frames and truths are those of a capture ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("extra", "projector"),
    [("", ""), pytest.param("", LENS, marks=pytest.mark.slow), pytest.param(POINT, "", marks=pytest.mark.slow)],
    ids=["plain", "lens", "lamp"],
)
def test_frames_and_truth_are_those_of_a_capture_of_the_picture(lab: Lab, extra: str, projector: str) -> None:
    """Both are Monte Carlo estimates of one expectation from streams of their own, each of at most 2e-3: the difference
    stays below 3e-3, where four in a thousand pictures a tenth brighter would differ by more. (Planted: places of the
    light taken for pixels one column on; the square of the reflectance.)"""
    scene = {"extra": extra, "projector": projector}
    store = lab.pairs(scene=scene)
    assert store.manifest.ambient_shots == (16 if extra else 0)
    for index in range(2):
        bench = lab.bench(on_sheet(store.picture(index)), extra, projector)
        shots = bench.capture("dots:2", accuracy=2e-3, seed=70 + index, exposure=1.0)
        known = np.asarray(shots.electrons, dtype=np.float64)
        if extra:
            assert shots.ambient is not None
            known = known - np.asarray(shots.read("ambient.exr")[0]["electrons"], dtype=np.float64)
        difference = np.linalg.norm(store.expected_frames(index) - known) / np.linalg.norm(known)
        assert difference < 3e-3
        assert shots.truth is not None
        assert np.sqrt(np.square(store.truth(index) - shots.truth).mean()) < (4e-3 if projector else 2e-4)


def test_scenes_whose_light_is_no_product_are_refused(lab: Lab) -> None:
    """(Planted: a wall beside the sheet not looked for.)"""
    with pytest.raises(MitsimError, match=r"the scene has 2 surfaces, which light each other; pairs are made of one"):
        lab.pairs(scene={"extra": SECOND})
    assert not (lab.folder / "store").exists()


# ---- Noise -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def drawn(shared_scene: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory, variant: str) -> PairStore:
    """Four pairs of a small scene."""
    lab = Lab(lambda name, **more: shared_scene(f"drawn_{name}", **more), tmp_path_factory.mktemp("drawn"), variant)
    return lab.pairs(4)


def test_frames_are_what_the_camera_exposes_of_what_is_expected(drawn: PairStore, lab: Lab) -> None:
    """Of a run's own exposure with this pair's seed, but for the rounding of what is expected to 32 bits. (Planted:
    one stream for all shots; dark current left in.)"""
    bench, pair = lab.bench(), 2
    exposer = Exposer(bench.devices, drawn.exposure_s(pair), integer(3, "pair", pair))
    unit = electrons_per_joule(bench)
    light = [Frame(frame.astype(np.float64) / unit, 0.0, 0.0, 0.0) for frame in drawn.expected_frames(pair)]
    shots = zip(light, drawn.manifest.family.shots, strict=True)
    exposed = np.stack([exposer.rate(exposer.digital(exposer.electrons(frame), *shot.names)) for frame, shot in shots])
    frames = drawn.frames(pair)
    assert frames.dtype == np.float32
    step = 1 / drawn.manifest.digital.gain_dn_per_e / drawn.exposure_s(pair)
    assert (abs(frames - exposed) > 0.01 * step).mean() < 1e-3, "a count here and there lies between two"
    full_e = bench.devices.sensor.superpixel_full_well_e
    assert drawn.exposure_s(pair) == pytest.approx(full_e * 0.8 / exposed.max(), rel=0.02)


def test_noise_is_drawn_anew_by_its_seed(drawn: PairStore) -> None:
    """60 draws of 16 384 numbers: their mean within 5 standard errors of what is expected, and their variance within
    1 % of what the manifest states. (Planted: the seed not heeded; noise of the shots' mean.)"""
    assert np.array_equal(drawn.frames(1), drawn.draw(1, drawn.manifest.seed))
    draws = np.stack([drawn.draw(1, 100 + seed) for seed in range(60)]).astype(np.float64)
    expected = drawn.expected_frames(1).astype(np.float64)
    digital = drawn.manifest.digital.model_copy(update={"exposure_s": drawn.exposure_s(1)})
    variance = digital.variance(expected)
    z = (draws.mean(axis=0) - expected) / np.sqrt(variance / 60)
    assert abs(z).max() < 5.5 and abs(z.mean()) < 5 / np.sqrt(z.size)
    assert draws.var(axis=0, ddof=1).mean() == pytest.approx(variance.mean(), rel=0.01)


def test_signed_patterns_are_differences(lab: Lab) -> None:
    """Of what Hadamard patterns measure, sums over all of them are the light of one pixel. (Planted: the negative
    halves alone.)"""
    store = lab.pairs(1, patterns="hadamard:2")
    assert store.manifest.frames == 4 and store.frames(0).shape == (4, 64, 64)
    assert [tuple(each) for each in store.indices] == [(0, 0), (0, 1), (1, 0), (1, 1)]
    expected = store.expected_frames(0)
    assert expected[0].min() >= 0 and expected[1].min() < 0
    assert abs(store.frames(0) - expected).max() < 0.2 * expected.max()


# ---- Benches that vary -----------------------------------------------------------------------------------------------


def test_benches_vary_by_group(lab: Lab) -> None:
    """Mask and exposure are drawn for each group of pairs. (Planted: the mask, or the exposure, of the first.)"""
    variation = Variation.model_validate(
        {"groups": 2, "exposure_fraction": [0.2, 0.8], "mask": {"mask_rows_um": [-50, 50]}}
    )
    still = lab.pairs(4, "still", accuracy=1e-2)
    store = lab.pairs(4, vary=variation, accuracy=1e-2)
    first, second = store.manifest.groups
    assert first != second and first.keys() == {"exposure_fraction", "mask.mask_rows_um"}
    assert [(shard.first, shard.count, shard.group) for shard in store.manifest.shards] == [(0, 2, 0), (2, 2, 1)]
    for index, group in ((1, first), (3, second)):
        assert np.array_equal(store.picture(index), still.picture(index))
        full_e, brightest = lab.bench().sensor.superpixel_full_well_e, store.expected_frames(index).max()
        filled = brightest * store.exposure_s(index) / full_e
        assert filled == pytest.approx(group["exposure_fraction"], rel=0.02), "lamps and dark current bring the rest"
        # The shadow of a sheet at 400 mm behind a mask at 2 mm moves by 400 / 398 of what the mask moves.
        pixels = group["mask.mask_rows_um"] / 11.72 * 400 / 398
        assert shift_of(store.expected_frames(index), still.expected_frames(index)) == pytest.approx(pixels, abs=0.1)


def shift_of(moved: np.ndarray, still: np.ndarray) -> float:
    """Rows by which frames (K, m, m') have moved, to a twentieth: where they are most alike away from the edges."""
    rows, tried = np.arange(8, still.shape[1] - 8), np.arange(-6, 6, 0.05)
    line = np.arange(still.shape[1])

    def off(shift: float) -> float:
        guess = np.apply_along_axis(lambda column: np.interp(rows - shift, line, column), 1, still)
        return float(np.square(moved[:, rows] - guess).sum())

    return float(tried[np.argmin([off(shift) for shift in tried])])


# ---- The folder ------------------------------------------------------------------------------------------------------


def test_an_interrupted_store_is_resumed_bit_equal(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    """And its cost is that of the missing pairs. (Planted: pictures numbered within their shard; a resumed store that
    begins anew; the cost of all pairs.)"""
    monkeypatch.setattr(pairs_module, "SHARD", 2)
    whole, shadow = lab.pairs(5, "whole"), 40 * (64 + 64) * N  # of each shard
    assert lab.cost.disk_bytes == 5 * 4 * N**2 + 3 * shadow
    draw = pairs_module.DrawnPictures.draw

    def fail(self: Any, number: int, n: int) -> Any:
        if number == 3:
            raise KeyboardInterrupt
        return draw(self, number, n)

    with monkeypatch.context() as broken, pytest.raises(KeyboardInterrupt):
        broken.setattr(pairs_module.DrawnPictures, "draw", fail)
        lab.pairs(5, "cut")
    folder = whole.folder.parent / "cut"
    assert sorted(path.name for path in folder.glob("pairs*")) == ["pairs.json", "pairs_00000.h5"]
    with pytest.raises(MitsimError, match="its pairs are incomplete"):
        PairStore.open(folder)
    kept = (folder / "pairs_00000.h5").stat().st_mtime_ns
    again = lab.pairs(5, "cut", resume=True)
    assert lab.cost.disk_bytes == 3 * 4 * N**2 + 2 * shadow
    assert (folder / "pairs_00000.h5").stat().st_mtime_ns == kept and len(again) == 5
    files = [{path.name: path.read_bytes() for path in each.iterdir()} for each in (whole.folder, folder)]
    assert files[0].keys() == files[1].keys() == {"pairs.json", *(f"pairs_0000{k}.h5" for k in range(3))}
    assert files[0] == files[1]


def test_a_store_of_another_request_is_not_resumed(lab: Lab) -> None:
    lab.pairs(1)
    with pytest.raises(MitsimError, match=r"another configuration \(count differ\)"):
        lab.pairs(2, resume=True)
    with pytest.raises(MitsimError, match="holds files already"):
        lab.pairs(1)


def test_a_picture_that_cannot_be_shown_is_refused_before_any_work(lab: Lab) -> None:
    """As a store of other pictures is not resumed. (Planted: pictures read when their turn comes.)"""
    folder = lab.folder / "pictures"
    folder.mkdir()
    for name in ("a.npy", "b.npy"):
        np.save(folder / name, np.full((N, N) if name == "a.npy" else (N - 1, N), 0.5))
    with pytest.raises(MitsimError, match=r"b\.npy: has 15 pixels on its shorter side, and 16 are shown"):
        lab.pairs(3, pictures=folder)
    assert not (lab.folder / "store").exists()
    assert len(lab.pairs(1, pictures=folder)) == 1, "which does not show the other"


def test_a_damaged_store_is_refused_in_a_line(drawn: PairStore, tmp_path: Path) -> None:
    with pytest.raises(MitsimError, match=r"holds no pairs\.json"):
        PairStore.open(tmp_path)
    with pytest.raises(MitsimError, match="index 4: the store holds pairs 0 to 3"):
        drawn.frames(4)
    copy = tmp_path / "copy"
    copy.mkdir()
    (copy / "pairs.json").write_bytes((drawn.folder / "pairs.json").read_bytes())
    with pytest.raises(MitsimError, match=r"lacks pairs_00000\.h5"):
        PairStore.open(copy)
    data = bytearray((drawn.folder / "pairs_00000.h5").read_bytes())
    data[len(data) // 2 :] = bytes(len(data) - len(data) // 2)
    (copy / "pairs_00000.h5").write_bytes(data)
    with pytest.raises(MitsimError, match="damaged, or no HDF5 file"):
        PairStore.open(copy).frames(3)
    (copy / "pairs_00000.h5").write_bytes((drawn.folder / "pairs_00000.h5").read_bytes())
    with h5py.File(copy / "pairs_00000.h5", "a") as file:
        del file["light"]  # as stores of earlier versions that traced light for each picture
    with pytest.raises(MitsimError, match=r"keeps frames in place of light .*, which is not read; make new pairs"):
        PairStore.open(copy).frames(3)
    more = {**json.loads((drawn.folder / "pairs.json").read_text()), "count": 5}
    (copy / "pairs.json").write_text(json.dumps(more))
    with pytest.raises(MitsimError, match=r"shards do not hold pairs 0 to 4, each once"):
        PairStore.open(copy)
    (copy / "pairs.json").write_text("{}")
    with pytest.raises(MitsimError, match="is no manifest of pairs"):
        PairStore.open(copy)


@pytest.mark.parametrize(
    ("own", "words"),
    [
        ({"count": 0}, "count 0: give a number from 1 to"),
        ({"vary": Variation(groups=3)}, "3 groups of 2 pairs"),
        ({"vary": Variation(groups=1, exposure_fraction=(0.1, 2.0))}, "exposure_fraction 2.0: give a part of"),
        ({"vary": {"groups": 1, "mask": {"mask_rows_um": [0.0, 1e5]}}}, "mask_rows_um: got 100000.0"),
        ({"vary": {"groups": 1, "mask": {"power": [0.0, 0.1]}}}, "'power' is no motion of a mask"),
        ({"vary": {"groups": 1, "exposure_fraction": [0.5, 0.1]}}, "give the least number first"),
        ({"vary": {"groups": 1, "scene": {"sheet_z": [390.0, 410.0]}}}, "extra inputs are not permitted"),
        ({"exposure": 0.1, "vary": Variation(groups=1, exposure_fraction=(0.1, 0.2))}, "exposure_fraction varies"),
    ],
)
def test_a_request_that_cannot_be_served_is_refused(own: dict[str, Any], words: str) -> None:
    kept = {key: own.pop(key) for key in ("count", "vary") if key in own}
    request = Request.of(**{key: value for key, value in own.items() if value is not None})
    with pytest.raises(MitsimError, match=words):
        PairsRequest(capture=request, **{"count": 2, **kept})


# ---- Pictures --------------------------------------------------------------------------------------------------------

SIDE = 64


def test_a_picture_hangs_on_the_seed_and_its_number_alone() -> None:
    """(Planted: the stream of all pictures of a seed.)"""
    one, other = DrawnPictures(1), DrawnPictures(2)
    third = one.draw(3, SIDE)
    assert third.dtype == np.uint8 and third.shape == (SIDE, SIDE)
    one.draw(0, SIDE)
    assert np.array_equal(one.draw(3, SIDE), third)
    assert not np.array_equal(one.draw(4, SIDE), third) and not np.array_equal(other.draw(3, SIDE), third)


def test_drawn_pictures_are_as_natural_ones_are() -> None:
    """Over 40 of them: reflectances as print has them; power that falls with frequency: most of it lies below an eighth
    of a cycle a pixel, in 5 % of all frequencies; soft edges: few steps from pixel to pixel exceed a third. (Planted:
    edges a hundredth of a pixel wide, and leaves of black and white.)"""
    pictures = np.array([DrawnPictures(5).draw(number, SIDE) for number in range(40)]) / 255
    assert pictures.min() >= 0.03 - 1 / 255 and pictures.max() <= 0.95 + 1 / 255
    assert 0.3 < pictures.mean() < 0.6 and 0.08 < pictures.std(axis=(1, 2)).mean() < 0.25
    frequency = np.hypot(np.fft.fftfreq(SIDE)[:, None], np.fft.fftfreq(SIDE)[None])
    power = np.square(abs(np.fft.fft2(pictures - pictures.mean(axis=(1, 2), keepdims=True)))).mean(axis=0)
    assert power[frequency < 1 / 8].sum() > 0.6 * power.sum()
    assert (abs(np.diff(pictures, axis=1)) > 1 / 3).mean() < 0.01


def test_the_amplitude_of_texture_falls_as_one_over_the_frequency() -> None:
    """The mean over 30 fields, to 5 % in its slope. (Planted: the power, not the amplitude.)"""
    fields = np.array([pink_noise(SIDE, stream(0, "field", number)) for number in range(30)])
    assert fields.std() == pytest.approx(1, rel=1e-6) and abs(fields.mean()) < 1e-9
    amplitude = np.sqrt(np.square(abs(np.fft.fft2(fields))).mean(axis=0))
    frequency = np.hypot(np.fft.fftfreq(SIDE)[:, None], np.fft.fftfreq(SIDE)[None])
    inside = (frequency > 0) & (frequency < 0.4)
    slope = np.polyfit(np.log(frequency[inside]), np.log(amplitude[inside]), 1)[0]
    assert slope == pytest.approx(-1, abs=0.05)


def test_pictures_of_a_folder_are_middle_squares_then_crops(tmp_path: Path) -> None:
    """Of a ramp along the columns each part's mean is known. (Planted: the upper left square.)"""
    ramp = np.broadcast_to(np.arange(0, 240, 2, dtype=np.uint8), (90, 120))
    Image.fromarray(np.ascontiguousarray(ramp)).save(tmp_path / "b.png")
    colours = np.stack([ramp, 0 * ramp, 0 * ramp], axis=2)
    Image.fromarray(np.ascontiguousarray(colours)).save(tmp_path / "a.png")
    (tmp_path / "letter.txt").write_text("mine")
    pictures = FolderPictures(tmp_path, seed=1)
    assert [path.name for path in pictures.files] == ["a.png", "b.png"] and pictures.source.startswith("2 files of ")
    # 90 columns from the 15th on, in 16 parts of 5.625: the middle of each part.
    middles = 30 + 2 * (5.625 * (np.arange(16) + 0.5) - 0.5)
    assert abs(pictures.draw(1, 16) - middles[None]).max() <= 0.5 + 1e-9
    assert abs(pictures.draw(0, 16) - middles[None] / 3).max() <= 0.5 + 1e-9
    crops = [pictures.draw(number, 16) for number in (3, 5)]
    assert not np.array_equal(*crops) and np.array_equal(FolderPictures(tmp_path, 1).draw(5, 16), crops[1])
    steps = [sorted(abs(np.diff(crop.astype(float), axis=axis)).mean() for axis in (0, 1)) for crop in crops]
    assert all(still == 0 and step > 0 for still, step in steps), "turned by quarters"


def test_equal_files_are_one_photograph(tmp_path: Path) -> None:
    """By what they hold, whatever they are called. (Planted: names compared.)"""
    for name, level in (("a.png", 10), ("b.png", 20), ("c.png", 10)):
        Image.fromarray(np.full((16, 16), level, np.uint8)).save(tmp_path / name)
    assert FolderPictures(tmp_path, 0).photographs == (0, 1, 0) and DrawnPictures(0).photographs == ()


def test_pairs_of_a_photograph_are_known_by_its_file(drawn: PairStore) -> None:
    """Of numbers in the manifest, and of how many files there are where an earlier version made the store. (Planted:
    every pair a photograph of its own.)"""
    known, before = {"photographs": (0, 1, 0)}, {"pictures": "3 files of there"}
    for change, shown in (({}, [0, 1, 2, 3]), (known, [0, 1, 0, 0]), (before, [0, 1, 2, 0])):
        store = PairStore(drawn.folder, drawn.manifest.model_copy(update=change))
        assert store.photographs.tolist() == shown


def test_pictures_of_any_kind_of_file_are_read(tmp_path: Path) -> None:
    """Of sixteen bits, without transparency, and a grey JPEG but for what its packing changes."""
    Image.fromarray(np.full((20, 20), 257 * 77, np.uint16)).save(tmp_path / "a.png")
    opaque = np.full((20, 20, 4), 77, np.uint8)
    opaque[..., 3] = 255
    Image.fromarray(opaque).save(tmp_path / "b.png")
    Image.fromarray(np.full((40, 60), 77, np.uint8)).save(tmp_path / "c.JPG")
    assert all(abs(FolderPictures(tmp_path, 0).draw(each, 8).astype(int) - 77).max() <= each // 2 for each in range(3))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.png", np.zeros((8, 9), np.uint8), "has 8 pixels on its shorter side, and 16 are shown"),
        ("a.npy", np.full((20, 20), 1.5), "its numbers reach from 1.5 to 1.5; give 0 to 1"),
        ("a.jpg", None, "cannot be read as a JPEG"),
        ("a.png", np.full((20, 20, 4), 128, np.uint8), "has transparent pixels"),
        ("a.png", np.full((20, 20, 2), 128, np.uint8), "is no grey PNG"),
    ],
)
def test_a_picture_that_cannot_be_shown_is_refused(
    tmp_path: Path, name: str, content: np.ndarray | None, words: str
) -> None:
    path = tmp_path / name
    if content is None:
        path.write_bytes(b"no picture")
    elif name.endswith("npy"):
        np.save(path, content)
    else:
        Image.fromarray(content).save(path)
    with pytest.raises(MitsimError, match=words) as refusal:
        FolderPictures(tmp_path, 0).draw(0, 16)
    assert str(path) in str(refusal.value) and "\n" not in str(refusal.value)


def test_a_folder_without_pictures_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MitsimError, match="holds no file that ends in"):
        FolderPictures(tmp_path, 0).draw(0, 16)
    with pytest.raises(MitsimError, match="is no folder"):
        FolderPictures(tmp_path / "none", 0).draw(0, 16)
    (tmp_path / "a.png").symlink_to(tmp_path / "gone.png")
    with pytest.raises(MitsimError, match=r"picture .*a\.png: cannot be read"):
        FolderPictures(tmp_path, 0).source  # noqa: B018 - found when it is asked for
