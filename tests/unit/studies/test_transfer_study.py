"""Networks that a twin taught, on the reduced real captures that ship: nothing of a held-out capture is in what
teaches, and images lie as their authors'."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from mitsim.bench.request import Request
from mitsim.core.errors import MitsimError
from mitsim.core.imagelist import Crop
from mitsim.core.job import Job
from mitsim.learn import verbs
from mitsim.reconstruct.shifted_codes import Pose
from mitsim.studies import transfer_study, twin_study
from mitsim.studies.framework.run import run_study
from mitsim.studies.transfer_study import AUTHORS, METHODS, Budget, Camera, measure, noise_range, twin_sums
from mitsim.studies.twin_files import TwinFiles
from mitsim.studies.twin_study import Learned, Recipe
from tests.unit.studies.test_twin_study import SCENE, made, made_codes

CAPTURES = Path(__file__).parents[3] / "captures"
POSE = Pose("turned", (0.4733, 0.4806))
"""As the calibration of docs/bench.md finds it in seconds."""
TORCH = "torch is an extra: pip install 'mitsim[learn]'"


@pytest.fixture
def reduced(monkeypatch: pytest.MonkeyPatch) -> TwinFiles:
    """The captures that ship, read by the list that docs/bench.md gives for their size."""
    recipe = Recipe.load()
    crop = Crop(row=1, column=2, rows=125, columns=155)
    small = replace(recipe, how=recipe.how.model_copy(update={"crop": crop}), n=64)
    monkeypatch.setattr(Recipe, "load", lambda: small)
    monkeypatch.setattr(twin_study, "_RAW", (254, 318))
    monkeypatch.setattr(twin_study, "find_pose", lambda _: POSE)
    return TwinFiles.find(CAPTURES)


@pytest.mark.slow
@pytest.mark.usefixtures("draft_figures")
def test_a_capture_is_seen_by_what_the_other_taught(
    reduced: TwinFiles, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Codes and noise are of the other capture alone. Images lie as the authors' files do, and by Tikhonov green ones
    are like them (0.93 and 0.90 for fc_7 in docs/bench.md). The page names its figure."""
    pytest.importorskip("torch", reason=TORCH)
    known: list[set[str]] = []
    fit = Learned.of

    def watched(planes: list[twin_study.Measured]) -> Learned:
        known.append({each.capture for each in planes})
        return fit(planes)

    monkeypatch.setattr(transfer_study.Learned, "of", watched)
    found = measure(None, Request.of(seed=0), Job(), reduced, Budget(pairs=8, steps=1, batch=2))
    assert known == [{"fc_7"}, {"fc_6"}]
    for number in (6, 7):
        theirs = np.asarray(Image.open(CAPTURES / "flatcam" / f"rec_{number}.png")) / 255
        (own,) = (each for each in found.held_out if each.capture == f"fc_{number}")
        assert_allclose(own.images[AUTHORS], theirs)
    rows = {(row["frame"], row["method"]): row for row in found.payload()["captures"]}
    assert len(rows) == 10 * len(METHODS)
    assert min(rows[f"fc_7 {plane}", "tikhonov"]["correlation"] for plane in ("gb", "gr")) > 0.89
    for row in rows.values():
        assert 0.3 < row["correlation"] < 1 and row["beyond"] >= 0
    titles = [axes.get_title() for axes in found.figures()["flatcam.png"].axes]
    assert titles == [AUTHORS, *METHODS, *[""] * (1 + len(METHODS))]  # (Planted: rows compared by identity.)
    run_study("transfer", lambda *_: found, None, tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"transfer.json", "transfer.html", "flatcam.png"}


def test_a_twins_sums_are_those_of_its_frames() -> None:
    """Without noise they are what the solver adds up of the product of factors and picture; with noise each differs by
    it, white, of the deviation that the pair is told."""
    pytest.importorskip("torch", reason=TORCH)
    learned = Learned(Pose("upright", (0.6, 0.7)), made_codes())
    camera = Camera.of(made(0, learned.codes), learned)
    truths = np.random.default_rng(2).random((6, SCENE, SCENE), np.float32)
    clean = twin_sums(camera.prepared, (1e-9, 1e-9), truths[:2], seed=5)
    for truth, weights in zip(clean.truths, clean.weights, strict=True):
        frames = camera.prepared.accumulator()
        frames.add(camera.sides[0] @ truth @ camera.sides[1].T, 0, 0)
        assert_allclose(weights, camera.prepared.problem(frames).projected, atol=1e-5 * np.abs(weights).max())
    noisy = twin_sums(camera.prepared, (0.1, 10.0), truths, seed=5)
    expected = camera.prepared.sigma * np.stack([camera.prepared.coefficients(each) for each in noisy.truths])
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


def test_what_is_missing_is_said_in_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder with a point spread function alone; and torch."""
    pytest.importorskip("torch", reason=TORCH)
    with pytest.raises(MitsimError, match="study transfer: needs captures of a FlatCam; give --data FOLDER"):
        measure(None, Request.of(), Job(), TwinFiles({}, Path("psf.tif")))
    with pytest.raises(MitsimError, match="study transfer: needs real captures; give --data FOLDER"):
        TwinFiles.find(None, "transfer")
    monkeypatch.setattr(verbs, "find_spec", lambda _: None)
    with pytest.raises(MitsimError, match="torch is not installed"):
        measure(None, Request.of(), Job(), TwinFiles({}, None))
