"""Learned methods against classical ones: gains, verdicts, what is kept and resumed; networks that a twin taught."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from mitsim.core.errors import MitsimError
from mitsim.core.imagelist import Crop
from mitsim.learn import verbs
from mitsim.reconstruct.shifted_codes import Pose
from mitsim.reconstruct.solvers import SOLVERS
from mitsim.report import IDEALISED, RENDERED
from mitsim.report.pages import Value
from mitsim.studies import learned_study, twin_study
from mitsim.studies.framework.campaign import Shard, batches
from mitsim.studies.framework.claims import choose_rows, mean_of
from mitsim.studies.framework.experiment import Point, Results, Scope, Setup
from mitsim.studies.framework.studio import Studio
from mitsim.studies.learned_study import (
    AMBIENT,
    AUTHORS,
    BEST,
    DEPTH,
    DIM,
    DRIFT,
    ELSEWHERE,
    FULL,
    GLOSS,
    NONE,
    PICTURES,
    PLACES,
    SIDE,
    STUDY,
    VARIED,
    Budget,
    Case,
    Cell,
    School,
    cells,
    classical_rows,
    compare,
    network_row,
    noise_range,
    place_setup,
    scores,
    transfer,
    twin_camera,
    twin_sums,
)  # fmt: skip  # fmt: skip
from mitsim.studies.twin_study import Learned, Recipe
from tests.ideal_sessions import bench, picture
from tests.unit.learn.pairs import FakeStore
from tests.unit.studies.test_twin_study import SCENE, made, made_codes

PRINTS = {"a": 20.0, "b": 27.0, "c": 34.0}
"""The best classical PSNR of each [dB]: prints differ by more than any gain."""
SEEDS = (0, 1, 2)
JITTER = dict(zip(PRINTS, (-0.1, 0.0, 0.1), strict=True))
"""Of gains, print by print; a 95 % interval of three is 0.25 either way."""
ASIDE = 0.4
"""From a border to where it is decided."""
CONDITIONS = (IDEALISED, RENDERED, DEPTH, DRIFT, DIM, GLOSS, AMBIENT)
Kind = tuple[str, str, str]
"""Training, method and patterns."""
Gains = Callable[[Kind, str], float]


def results(gain: Gains, flagged: Callable[[str], bool] = lambda _: False, detail: float = 0.0) -> Results:
    """All that the study measures: networks that gain so much over the best of two classical methods."""
    found: list[dict[str, Value]] = []
    families = ("uniform", "dots:7")
    for patterns in families:
        for condition in CONDITIONS:
            common: dict[str, Any] = {"patterns": patterns, "condition": condition, "seconds": 0.1}
            for method, less in (("tikhonov", 0.0), ("tv", 5.0)):
                for weight in ("automatic", "best"):
                    named = {**common, "training": NONE, "method": method, "weight": weight, "seed": 0}
                    found += [{**named, "picture": name, "psnr_db": level - less - (weight != BEST), "detail": 0.5}
                              for name, level in PRINTS.items()]  # fmt: skip
            for cell in cells(SEEDS, families, quick=False):
                if cell.patterns == patterns:
                    level = gain((cell.training, cell.method, patterns), condition) + 0.05 * (cell.seed - 1)
                    named = {**common, **vars(cell), "misfit": float(flagged(condition)), "train_s": 60.0}
                    found += [{**named, "picture": name, "psnr_db": PRINTS[name] + level + JITTER[name],
                               "detail": 0.5 + detail + JITTER[name] / 10} for name in PRINTS]  # fmt: skip
    return Results([{**row, "point": f"{number}"} for number, row in enumerate(found)])


def verdicts(found: Results, claim: str) -> set[str]:
    return {each.verdict for each in STUDY.judge(found) if each.claim.startswith(claim)}


# -------- Gains and verdicts


def test_a_gain_is_over_the_best_classical_image_of_the_print() -> None:
    """(Planted: the first classical method, not the best; the best at automatic weight.)"""
    rows = compare(results(lambda kind, condition: 2.0 if condition == DRIFT else 0.0)).frame
    own = choose_rows(rows, {"training": RENDERED, "method": "refined", "patterns": "uniform", "condition": DRIFT})
    assert_allclose(mean_of(own, "gain_db"), (2.0, 0.1 / math.sqrt(3), 3))
    tv = choose_rows(rows, {"method": "tv", "weight": BEST, "condition": DRIFT})
    assert_allclose(mean_of(tv, "gain_db").value, -5)


def test_what_is_below_a_calibrated_bench_is_of_mismatches_alone() -> None:
    """(Planted: images compared with the classical one of their own frames.)"""
    found = results(lambda *_: 0.0)
    moved = [{**row, "psnr_db": float(row["psnr_db"]) - 8 * (row["condition"] in (DRIFT, DIM))}  # type: ignore[arg-type]
             for row in found.rows]  # fmt: skip
    rows = compare(Results(moved)).frame
    for condition, wanted in ((DRIFT, -8.0), (DIM, 0.0)):
        own = choose_rows(rows, {"condition": condition, "method": "refined", "patterns": "uniform"})
        assert_allclose(mean_of(own, "below_db").value, wanted, atol=1e-9)


def test_a_claim_needs_every_training() -> None:
    """Sure in the mean over trainings, unsure by one of them: not confirmed. (Planted: trainings left out.)"""
    found = [{**row, "psnr_db": row["psnr_db"] + 3.0 * (row["seed"] - 1) * (row["training"] != NONE)}  # type: ignore
             for row in results(lambda *_: 2.0).rows]  # fmt: skip
    assert verdicts(Results(found), "A U-Net after least squares removes") == {"not confirmed"}
    assert verdicts(results(lambda *_: 2.0), "A U-Net after least squares removes") == {"confirmed"}


def one(kind: Kind, condition: str, value: float, rest: float = 0.0) -> Gains:
    """One kind gains a ``value`` under one condition, everything else ``rest``."""
    return lambda other, where: value if (other, where) == (kind, condition) else rest


FLAT, UNET = (IDEALISED, "flatnet", "uniform"), (RENDERED, "refined", "uniform")
UNROLLED, CODED = (RENDERED, "unrolled", "uniform"), (IDEALISED, "unrolled", "dots:7")
BORDERS: list[tuple[str, Callable[[float], Gains], float, bool]] = [
    ("Trained and tested on idealised frames, flatnet", lambda x: one(FLAT, IDEALISED, x), 0.0, True),
    ("flatnet of idealised pairs fails", lambda x: one(FLAT, RENDERED, x), -3.0, False),
    ("A U-Net after least squares removes", lambda x: one(UNET, RENDERED, x), 0.0, True),
    ("unrolled of idealised pairs is within", lambda x: one(CODED, RENDERED, x), -3.0, True),
    ("No mismatch costs 10 dB against the best classical image (drift)",
     lambda x: one(UNROLLED, DRIFT, x), -10.0, True),
    ("unrolled of rendered pairs is 1 dB", lambda x: one(UNROLLED, RENDERED, x), 1.0, True),
    ("unrolled of rendered pairs is no worse", lambda x: one((*UNROLLED[:2], "dots:7"), RENDERED, x), -0.5, True),
    ("Benches that vary in training make networks bear a mismatch (uniform)",
     lambda x: lambda kind, _: x if kind[0] == VARIED else 0.0, 0.0, True),
]  # fmt: skip
"""Beginning of a claim, gains by what decides it, its border, and whether it holds above."""


@pytest.mark.parametrize(("claim", "gains", "border", "above"), BORDERS)
def test_verdicts_on_both_sides_of_a_border(
    claim: str, gains: Callable[[float], Gains], border: float, above: bool
) -> None:
    """(Planted: each border moved by 1 dB; ends of a range changed for one another.)"""
    for off, sign in ((ASIDE, True), (-ASIDE, False)):
        assert verdicts(results(gains(border + off)), claim) == {"confirmed" if sign is above else "not confirmed"}


def test_resolution_is_no_gain_of_noise() -> None:
    """A U-Net that gains decibels and detail resolves. (Planted: detail not asked for.)"""
    for detail, said in ((0.0, "confirmed"), (0.2, "not confirmed")):
        assert verdicts(results(lambda *_: 2.0, detail=detail), "A U-Net after least squares resolves") == {said}


def test_flags_are_counted_on_images_that_fail() -> None:
    """(Planted: failures and others changed for one another.)"""

    def gain(kind: Kind, condition: str) -> float:
        return -8.0 if condition == DRIFT else 0.0

    flagged: tuple[Callable[[str], bool], ...] = (lambda name: name == DRIFT, lambda _: False, lambda _: True)
    for flags, caught, few in zip(flagged, ("confirmed", "not confirmed", "confirmed"),
                                  ("confirmed", "confirmed", "not confirmed"), strict=True):  # fmt: skip
        found = results(gain, flags)
        jittered = [{**row, "misfit": row["misfit"] + JITTER[str(row["picture"])] / 10}  # type: ignore[operator]
                    if row["training"] != NONE else row for row in found.rows]  # fmt: skip
        assert verdicts(Results(jittered), "Misfit flags images") == {caught}
        assert verdicts(Results(jittered), "Misfit flags few others") == {few}


@pytest.mark.usefixtures("draft_figures")
def test_the_page_has_every_condition() -> None:
    found = results(lambda *_: 0.0)
    psnr, _, gain = (part for part in STUDY.parts(found) if "PSNR" in part.title or "Gain" in part.title
                     if "49 dots" not in part.title or "Gain" not in part.title)  # fmt: skip
    assert psnr.head[1:] == gain.head[1:] == CONDITIONS
    assert {row[0]: row[2] for row in psnr.rows}["refined, rendered"].startswith("27.0")
    assert {row[0]: row[2] for row in gain.rows}["refined, rendered"] == "0.0 \N{PLUS-MINUS SIGN} 0.1"
    assert set(STUDY.draw(found)) == {f"gain_{condition}.png" for condition in CONDITIONS}


# -------- What is measured


def test_detail_is_recovered_or_invented() -> None:
    """(Planted: detail taken of the whole image.)"""
    rng = np.random.default_rng(1)
    ramp, grain = np.linspace(0, 1, 64)[:, None] * np.ones(64), 0.1 * rng.normal(size=(64, 64))
    assert scores(ramp + 0.1 * rng.normal(size=(64, 64)), ramp + grain)["detail"] < 0.1  # type: ignore[operator]
    assert_allclose(scores(ramp + grain / 2, ramp + grain)["detail_energy"], 0.5, rtol=0.01)


def a_case(patterns: str) -> Case:
    """The frames of an ideal camera as a case of the bench."""
    camera = bench()
    shots, factors = camera.run(patterns, picture(1), 1), camera.calibrated(1)
    prepared = SOLVERS["tikhonov"].init(factors, shots.patterns)
    sums, frames = prepared.accumulator(), list(shots.pattern_measurements())
    for each in frames:
        sums.add(each.frame, each.row, each.column)
    frame = np.asarray(frames[0].frame) if len(frames) == 1 else np.zeros((0, 0))
    return Case(np.asarray(shots.truth), *factors.sides, *shots.patterns, factors.manifest.centre, sums.quarters,
                sums.energy, frame, prepared.left.basis[0])  # fmt: skip


@pytest.mark.parametrize("patterns", ["uniform", "dots:3"])
def test_frames_are_kept_as_what_they_add_up_to(patterns: str, tmp_path: Path) -> None:
    """From a file as from the frames; with neighbours alike too. (Planted: the turn of columns not transposed.)"""
    pytest.importorskip("torch", reason="torch is an extra: pip install 'mitsim[learn]'")
    case = a_case(patterns)
    case.write(tmp_path / "case.npz")
    again = Case.read(tmp_path / "case.npz")
    prepared = again.prepare()
    sums = again.sums(prepared)
    assert_allclose(sums.quarters, case.quarters, rtol=1e-12, atol=1e-9 * abs(case.quarters).max())
    shots = bench().run(patterns, picture(1), 1)
    markov = prepared.with_correlation()
    direct = markov.accumulator()
    for each in shots.pattern_measurements():
        direct.add(each.frame, each.row, each.column)
    rows = list(classical_rows(replace(case, unexplained=0.5)))
    assert all(row["flagged"] and "frames fit no image" in str(row["reason"]) for row, _ in rows)
    found = {(row["method"], row["weight"]): image for row, image in rows}
    assert_allclose(found["markov", "automatic"], markov.solve(direct).image, atol=1e-6)
    assert_allclose(found["tikhonov", "automatic"], prepared.solve(sums).image, atol=1e-9)


def test_sums_of_another_machine_are_refused() -> None:
    case = a_case("dots:3")
    other = replace(case, basis=-case.basis)
    with pytest.raises(MitsimError, match="were added up on another machine"):
        other.sums(other.prepare())


# -------- Networks


def test_cells_have_every_training_and_method() -> None:
    found = cells((0, 1, 2), ("uniform", "dots:4", "dots:7"), quick=False)
    assert len(found) == len(set(found)) == 3 * (27 + 3 + 3 + 3)
    assert {cell.training for cell in found} == {IDEALISED, RENDERED, VARIED, ELSEWHERE, PICTURES}
    assert len(cells((0,), ("uniform",), quick=True)) == 4


TINY = Budget(pairs=24, steps=10, groups=2)
"""Ten looks of one step: a second."""


def school(studio: Studio, patch: pytest.MonkeyPatch) -> School:
    """With pairs of an ideal camera, which nothing is rendered for."""
    stores = {name: FakeStore(TINY.pairs, name) for name in ("uniform", "dots:3")}
    for name, store in stores.items():
        store.folder = Path(name.replace(":", ""))
    patch.setattr(School, "_store", lambda self, training, patterns: stores[patterns])
    patch.setattr(School, "_factors", lambda *_: bench().calibrated(1))
    return School(studio, Setup(), 0, TINY)


def weights(model: Any) -> Mapping[str, Any]:
    return {name: values.numpy() for name, values in model.network.state_dict().items()}


@pytest.fixture
def _one_thread() -> Any:
    torch = pytest.importorskip("torch", reason="torch is an extra: pip install 'mitsim[learn]'")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.slow
@pytest.mark.usefixtures("_one_thread")
def test_a_killed_training_goes_on_to_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And a network that is there is not trained again. (Planted: the unfinished file left where it is not found.)"""
    from mitsim.learn.training import Trainer

    cell, taken, step = Cell(RENDERED, "uniform", "refined", 3), [], Trainer.step
    (tmp_path / "whole").mkdir()
    (tmp_path / "parts").mkdir()
    with Studio(str(tmp_path / "whole")) as studio:
        whole, seconds = school(studio, monkeypatch).network(cell)
    assert seconds is not None

    def killed(self: Trainer, number: int) -> float:
        taken.append(number)
        if taken == [*range(5)]:
            raise KeyboardInterrupt
        return step(self, number)

    monkeypatch.setattr(Trainer, "step", killed)
    with Studio(str(tmp_path / "parts")) as studio, pytest.raises(KeyboardInterrupt):
        school(studio, monkeypatch).network(cell)
    with Studio(str(tmp_path / "parts")) as studio:
        parts, seconds = school(studio, monkeypatch).network(cell)
        assert seconds is None
        before = len(taken)
        again, _ = school(studio, monkeypatch).network(cell)
    assert taken == [*range(5), *range(4, TINY.steps)]
    assert before == len(taken)
    for name, values in weights(whole).items():
        assert_array_equal(weights(parts)[name], values)
        assert_array_equal(weights(again)[name], values)


@pytest.mark.usefixtures("_one_thread")
def test_a_network_taught_by_pictures_serves_all_patterns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One training; its images are not flagged for noise or camera. (Planted: noise of its pairs kept.)"""
    case = a_case("dots:3")
    with Studio(str(tmp_path)) as studio:
        own = school(studio, monkeypatch)
        for patterns in ("uniform", "dots:3"):
            model, _ = own.network(Cell(PICTURES, patterns, "plug-and-play", 0))
            assert model.manifest.noise == (0.0, math.inf)
        row, image = network_row(model, own.factors_for(case), case)
        assert len(list((tmp_path / "networks").glob("*.pt"))) == 1
    assert image.shape == case.truth.shape
    assert (row["flag_noise"], row["flag_camera"]) == (False, False)
    assert row["flagged"] == bool(row["reason"])


# -------- The study's points


def test_scenes_of_the_bench_are_the_middle_of_shipped_ones(tmp_path: Path) -> None:
    """Each place opens: 64 pixels a side of the photograph's size, and another coat, depth or lamp. (Seen failing: a
    change of a line that the shipped scenes had no longer.)"""
    with Studio(str(tmp_path)) as studio:
        setups = {place: place_setup(studio, Setup(), place) for place in PLACES}
        benches = {place: studio.bench(setup) for place, setup in setups.items()}
    for one in benches.values():
        assert one.n == SIDE
        assert_allclose(np.ptp(one.windows, axis=1), SIDE * 120 / 128 / 400, rtol=1e-4)
    assert (
        "roughplastic" in Path(setups[GLOSS].scene).read_text() and len({each.scene for each in setups.values()}) == 3
    )
    assert dict(setups[DEPTH].parameters)["sheet_z"] == "405.0"


def test_points_share_files_and_not_a_process() -> None:
    """(Planted: batches by setup as of other studies.)"""
    points = [Point.of(Setup(), number=number) for number in range(5)]
    assert [len(batch) for batch in batches(points)] == [5]
    assert [len(batch) for batch in batches(points, kept=True)] == [1] * 5
    assert [len(Shard(number, 2).part(points, kept=True)) for number in (1, 2)] == [3, 2]


def test_without_torch_a_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verbs, "find_spec", lambda name: None)
    with pytest.raises(MitsimError, match=r"torch is not installed, which networks need; type: pip install"):
        STUDY.points(Scope(Setup(), ("page",)))


def test_points_of_a_whole_and_of_a_quick_study(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(verbs, "find_spec", lambda name: name)
    whole = STUDY.points(Scope(Setup(), ("page", "brick")))
    assert len(whole) == len({point.key for point in whole}) == 4 * 2 + 108
    assert whole[-1]["steps"] == FULL.steps
    assert len(STUDY.points(Scope(Setup(), ("page", "chelsea"), quick=True))) == 2 * 2 + 4
    with pytest.raises(MitsimError, match="leave the scene out"):
        STUDY.points(Scope(Setup("cards"), (None,)))
    assert [point["held_out"] for point in STUDY.points(Scope(Setup(), ("page",), data=str(CAPTURES)))] == [
        "fc_6",
        "fc_7",
    ]
    (tmp_path / "diffusercam").mkdir()
    (tmp_path / "diffusercam" / "psf_sample.tif").touch()
    with pytest.raises(MitsimError, match="study learned: needs captures of a FlatCam; give --data FOLDER"):
        STUDY.points(Scope(Setup(), ("page",), data=str(tmp_path)))


# -------- Real captures

CAPTURES = Path(__file__).parents[3] / "captures"
POSE = Pose("turned", (0.4733, 0.4806))
"""As the calibration of docs/bench.md finds it in seconds."""
TORCH = "torch is an extra: pip install 'mitsim[learn]'"


@pytest.mark.slow
@pytest.mark.usefixtures("draft_figures", "_one_thread")
def test_a_capture_is_seen_by_what_the_other_taught(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the reduced captures that ship: codes and noise are of the other capture alone. Images lie as the authors'
    files do, and by Tikhonov green ones are like them (0.93 and 0.90 for fc_7 in docs/bench.md)."""
    recipe = Recipe.load()
    crop = Crop(row=1, column=2, rows=125, columns=155)
    small = replace(recipe, how=recipe.how.model_copy(update={"crop": crop}), n=64)
    monkeypatch.setattr(Recipe, "load", lambda: small)
    monkeypatch.setattr(twin_study, "_RAW", (254, 318))
    monkeypatch.setattr(twin_study, "find_pose", lambda _: POSE)
    monkeypatch.setattr(learned_study, "TEACHING", {"pairs": 8, "steps": 1, "batch": 2})
    known: list[set[str]] = []
    fit = Learned.of

    def watched(planes: list[twin_study.Measured]) -> Learned:
        known.append({each.capture for each in planes})
        return fit(planes)

    monkeypatch.setattr(learned_study.Learned, "of", watched)
    found = {name: transfer(str(CAPTURES), name, 0) for name in ("fc_6", "fc_7")}
    assert known == [{"fc_7"}, {"fc_6"}]
    for name, own in found.items():
        theirs = np.asarray(Image.open(CAPTURES / "flatcam" / f"rec_{name[3:]}.png")) / 255
        assert_allclose(own.arrays[AUTHORS], theirs, atol=1e-6)
    rows: list[Any] = [{**row, "point": name} for name, each in found.items() for row in each.rows]
    assert len(rows) == 2 * 5 * 4
    assert (
        min(row["correlation"] for row in rows if row["method"] == "tikhonov" and row["picture"][:6] == "fc_7 g") > 0.89
    )
    for row in rows:
        assert 0.3 < row["correlation"] < 1 and row["beyond"] >= 0
    arrays = {(name, key): array for name, each in found.items() for key, array in each.arrays.items()}
    (figure,) = STUDY.draw(Results(rows, arrays)).values()
    assert [axes.get_title() for axes in figure.axes[:5]] == [AUTHORS, "tikhonov", "tv", "refined", "unrolled"]
    (claim,) = STUDY.judge(Results(rows))
    assert claim.claim.startswith("On real captures") and len(STUDY.parts(Results(rows))) == 2


def test_a_twins_sums_are_those_of_its_frames() -> None:
    """Without noise they are what the solver adds up of the product of factors and picture; with noise each differs by
    it, white, of the deviation that the pair is told."""
    pytest.importorskip("torch", reason=TORCH)
    learned = Learned(Pose("upright", (0.6, 0.7)), made_codes())
    (left, right), prepared = twin_camera(made(0, learned.codes), learned)
    truths = np.random.default_rng(2).random((6, SCENE, SCENE), np.float32)
    clean = twin_sums(prepared, (1e-9, 1e-9), truths[:2], seed=5)
    for truth, weights in zip(clean.truths, clean.weights, strict=True):
        frames = prepared.accumulator()
        frames.add(left @ truth @ right.T, 0, 0)
        assert_allclose(weights, prepared.problem(frames).projected, atol=1e-5 * np.abs(weights).max())
    noisy = twin_sums(prepared, (0.1, 10.0), truths, seed=5)
    expected = prepared.sigma * np.stack([prepared.coefficients(each) for each in noisy.truths])
    spread = np.square(noisy.weights - expected).mean(axis=(1, 2))
    assert_allclose(spread, noisy.variances, rtol=5 * np.sqrt(2 / expected[0].size))
    assert np.ptp(np.log(noisy.variances)) > 1


def test_noise_reaches_from_the_sensors_to_all_that_is_left() -> None:
    """Of two planes, over their gains, a factor of 1.5 beyond: by hand."""
    codes = replace(made_codes(), gains={"gb": 1.0, "r": 2.0}, variances=np.array([9.0, 64.0]))
    planes = [made(0, codes), replace(made(1, codes), plane="r")]
    noise = np.random.default_rng(0).standard_normal(planes[0].level.shape)
    noise /= noise.std()
    planes = [replace(each, noise=level * noise) for each, level in zip(planes, (2.0, 3.0), strict=True)]
    assert noise_range(planes, Learned(POSE, codes)) == pytest.approx((1.5 / 1.5, 4.0 * 1.5))
